# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The operator's page: a web server that brings the camera to a browser and the look direction back.

``page/`` is what the browser runs: it derotates the camera's own picture and looks around in it.
``pairing``, ``protocol``, ``client`` and ``server`` know no ROS; ``robot`` is the other end, and
``robot_interface`` what the server asks of it. Pictures go to a browser as files or as a ``video``
(``h264``), no more of them than it can take (``flow_control``, ``rate_control``).
"""
