# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Packages that some options need, asked for before all the work is done."""

from importlib import import_module

from sph_stab_ros.recording import RecordingError


def see_that_figures_can_be_drawn(flag: str) -> None:
    """Raise RecordingError if those that a flag asks for cannot."""
    try:
        import_module('matplotlib')
    except ImportError:
        raise RecordingError(
            f"{flag} needs Matplotlib: pip install 'sph_stab_ros[plots]'") from None
