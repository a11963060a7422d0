# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Many recordings stabilised at once: on this machine's cores, or on a cluster.

``__main__`` is the command, ``discovery`` finds recordings, ``results`` knows which are done and
puts whole results in their places, ``worker`` is the process in which one recording is stabilised,
``tasks`` starts it, and ``local`` and ``cluster`` do so for many; ``segments`` are those of long
recordings.
"""
