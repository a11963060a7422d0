# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Play a recording through the node: ``ros2 launch sph_stab_ros demo.launch.py recording:=my_bag``.

Arguments of stabilizer.launch.py can be given too. RViz comes along with ``rviz:=true``.
"""

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction, Shutdown)
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('sph_stab_ros')
ARGUMENTS = (
    DeclareLaunchArgument(
        'recording', description='rosbag2 folder, .mcap, .db3, ROS 1 .bag, or a video file'),
    DeclareLaunchArgument(
        'rate', default_value='1.0', description='How many times as fast as recorded'),
    DeclareLaunchArgument(
        'loop', default_value='true', choices=['true', 'false'],
        description='Start again at the end'),
    DeclareLaunchArgument(
        'rviz', default_value='false', choices=['true', 'false'], description='Start RViz too'),
    # JPEG gets through with the middleware's defaults, raw images do not.
    DeclareLaunchArgument(
        'image_transport', default_value='compressed', choices=['raw', 'compressed'],
        description='How the images travel from player to node'),
)


def player(context):
    """Return the player."""
    def argument(name):
        return LaunchConfiguration(name).perform(context)

    flags = ['--wait', '--now', '--rate', argument('rate')]
    if argument('loop') == 'true':
        flags.append('--loop')
    if argument('image_transport') == 'compressed':
        flags.append('--compressed')
    return [Node(package='sph_stab_ros', executable='player', namespace=argument('namespace'),
                 arguments=[argument('recording'), *flags], output='screen',
                 remappings=[('image', argument('image'))],
                 on_exit=Shutdown(reason='the player has ended'))]


def generate_launch_description():
    """Return what ``ros2 launch`` starts."""
    stabilizer = IncludeLaunchDescription(PythonLaunchDescriptionSource(
        PathJoinSubstitution([SHARE, 'launch', 'stabilizer.launch.py'])))
    rviz = Node(
        package='rviz2', executable='rviz2', condition=IfCondition(LaunchConfiguration('rviz')),
        namespace=LaunchConfiguration('namespace'),
        arguments=['-d', PathJoinSubstitution([SHARE, 'config', 'stabilizer.rviz'])])
    return LaunchDescription([*ARGUMENTS, stabilizer, OpaqueFunction(function=player), rviz])
