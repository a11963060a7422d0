# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Every option once: ROS parameters, command lines and parameter files are made from here."""

from sph_stab_ros.config.encoder import EncoderConfig, H264, LIVE_ENCODERS
from sph_stab_ros.config.options import (
    ConfigError, get_option, Option, options, with_option)
from sph_stab_ros.config.projection import (
    CropConfig, CROPPED_EQUIRECT, CUBEMAP, CubemapConfig, DUAL_FISHEYE, EQUI_ANGULAR_CUBEMAP,
    EQUIDISTANT, EQUIRECT, EQUISOLID, FISHEYE, FisheyeConfig, GOPRO_MAX, LENS_MODELS, LensConfig,
    MIN_WIDTH, PROJECTIONS, STRETCHED_EQUIRECT)
from sph_stab_ros.config.schema import (
    ANCHORED, AUTO, COLUMNS, FIRST_FRAME, FLOWS, FOLLOW, HALF_SPHERE, IMAGE_TRANSPORTS, IMU,
    ImuConfig, JOINS, LEFT_RIGHT, LEVELS, LOCK, METHODS, MODES, MONO, NODE_PARAMETERS, NodeConfig,
    NOT_JOINED, PICTURE_LAYOUTS, READ_IN, RESERVED, ROWS, SmoothingConfig, StabilizerConfig,
    TOP_BOTTOM, TrackerConfig, VIEW, VIEW_NAME, view_parameters, ViewConfig, VR180, YAW_FOLLOW)
from sph_stab_ros.config.settings import frame_in_tf, Settings, settings_of

__all__ = [
    'ANCHORED', 'AUTO', 'COLUMNS', 'ConfigError', 'CropConfig', 'CROPPED_EQUIRECT',
    'CUBEMAP', 'CubemapConfig', 'DUAL_FISHEYE', 'EQUI_ANGULAR_CUBEMAP', 'EQUIDISTANT', 'EQUIRECT',
    'EncoderConfig', 'EQUISOLID', 'FIRST_FRAME', 'FISHEYE', 'FisheyeConfig', 'FLOWS', 'FOLLOW',
    'frame_in_tf', 'get_option', 'GOPRO_MAX', 'H264', 'HALF_SPHERE', 'IMAGE_TRANSPORTS', 'IMU',
    'ImuConfig', 'JOINS', 'LEFT_RIGHT', 'LENS_MODELS', 'LensConfig', 'LEVELS', 'LIVE_ENCODERS',
    'LOCK', 'METHODS', 'MIN_WIDTH', 'MODES', 'MONO', 'NODE_PARAMETERS', 'NodeConfig', 'NOT_JOINED',
    'Option', 'options', 'PICTURE_LAYOUTS', 'PROJECTIONS', 'READ_IN', 'RESERVED', 'ROWS',
    'Settings', 'settings_of', 'SmoothingConfig', 'StabilizerConfig', 'STRETCHED_EQUIRECT',
    'TOP_BOTTOM', 'TrackerConfig', 'VIEW', 'VIEW_NAME', 'view_parameters', 'ViewConfig', 'VR180',
    'with_option', 'YAW_FOLLOW']
