# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Start the stabilizer node; ``ros2 launch sph_stab_ros stabilizer.launch.py -s`` explains how."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = (
    DeclareLaunchArgument(
        'params_file',
        default_value=PathJoinSubstitution(
            [FindPackageShare('sph_stab_ros'), 'config', 'stabilizer.yaml']),
        description='YAML file of the parameters'),
    DeclareLaunchArgument('namespace', default_value='', description='Namespace of the node'),
    DeclareLaunchArgument(
        'image', default_value='image',
        description='Topic of the images; with the transport behind it where image_transport is '
                    'not raw'),
    DeclareLaunchArgument(
        'image_transport', default_value='',
        choices=['', 'raw', 'compressed', 'ffmpeg', 'foxglove'],
        description='How the images come; empty: as params_file says'),
    DeclareLaunchArgument(
        'source', default_value='',
        description='Camera or stream to read in place of the image topic; empty: as params_file '
                    'says'),
    DeclareLaunchArgument(
        'imu', default_value='imu',
        description='Topic of the IMU, listened to where the parameter level is imu'),
    DeclareLaunchArgument(
        'projection', default_value='',
        description="How a picture shows the sphere, the node's parameter projection; empty: as "
                    'params_file says'),
    DeclareLaunchArgument(
        'use_sim_time', default_value='', choices=['', 'true', 'false'],
        description='Take the time from /clock; empty: as params_file says'),
)


def stabilizer(context):
    """Return the node; an argument left empty does not override the file's parameter."""
    def argument(name):
        return LaunchConfiguration(name).perform(context)

    # launch would only warn and take the defaults.
    if not Path(argument('params_file')).is_file():
        raise RuntimeError(f"params_file: there is no file {argument('params_file')}")
    given = {name: argument(name) for name in ('image_transport', 'source', 'projection')
             if argument(name)}
    if argument('use_sim_time'):
        given['use_sim_time'] = argument('use_sim_time') == 'true'
    return [Node(
        package='sph_stab_ros', executable='stabilizer', name='stabilizer',
        namespace=argument('namespace'), output='screen',
        parameters=[argument('params_file'), given],
        remappings=[(topic, argument(topic)) for topic in ('image', 'imu')])]


def generate_launch_description():
    """Return what ``ros2 launch`` starts."""
    return LaunchDescription([*ARGUMENTS, OpaqueFunction(function=stabilizer)])
