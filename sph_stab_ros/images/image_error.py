# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""What is said of a picture that cannot be used."""


class ImageError(ValueError):
    """
    A picture that cannot be used.

    ``reason`` is one of a few fixed phrases, by which such pictures are counted; the text adds
    what is wrong with this one.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f'{reason}: {detail}')
        self.reason = reason


class DecoderMissing(ImageError):
    """Pictures that could be used, were a decoder installed; ``why`` says which and how."""

    def __init__(self, name: str, why: str) -> None:
        super().__init__(f'no decoder of {name}', f'{name} in messages {why}')
