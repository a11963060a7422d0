# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Trackers: frames in, the camera's orientation in the world out."""

from sph_stab_ros.tracking.base import no_gyro, TrackedOrientation, Tracker, TrackingStatus
from sph_stab_ros.tracking.factory import (
    check_mask, make_tracker, MakeTracker, working_width)

__all__ = ['check_mask', 'make_tracker', 'MakeTracker', 'no_gyro', 'TrackedOrientation', 'Tracker',
           'TrackingStatus', 'working_width']
