# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Messages of rclpy, made of what ``recording.messages`` says, and the core's values of them."""

from array import array
from dataclasses import is_dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.rotations import is_unit_quaternion
from sph_stab_ros.images.codec import fill_message
from sph_stab_ros.stabilization.steering import Rates


@cache
def message_type(name: str) -> type[Any]:
    """Return the class of, for example, ``sensor_msgs/msg/Image``; ImportError without it."""
    package, _, message = name.split('/')
    module = import_module(f'{package}.msg')
    try:
        found: type[Any] = getattr(module, message)
    except AttributeError:
        raise ImportError(f'{package} has no {message}') from None
    return found


def make(type_name: str, **fields: Any) -> Any:
    """Return the message of a type with these fields."""
    arrays = {name: fields.pop(name) for name, value in tuple(fields.items())
              if isinstance(value, np.ndarray)}
    return fill_message(message_type(type_name)(**fields), arrays)


def rotation_from_message(msg: Any) -> Rotation:
    """Return the Rotation of a QuaternionStamped; ValueError where it is not a unit one."""
    quaternion = msg.quaternion.x, msg.quaternion.y, msg.quaternion.z, msg.quaternion.w
    if not is_unit_quaternion(quaternion):
        raise ValueError('({:g}, {:g}, {:g}, {:g}) is not a unit quaternion'.format(*quaternion))
    return Rotation.from_quat(quaternion)


def rates_from_twist(msg: Any) -> Rates:
    """
    Return the Rates of a Twist; ValueError where one that counts is not finite.

    Yaw and pitch are those of REP 103's body: ``angular.z`` turns left, ``angular.y`` *down*.
    ``linear.z`` turns up, in rad/s too, and ``linear.x`` zooms in.
    """
    counting = msg.angular.z, msg.angular.y, msg.linear.z, msg.linear.x
    if not np.isfinite(counting).all():
        raise ValueError('angular.z, angular.y, linear.z, linear.x are ({:g}, {:g}, {:g}, {:g})'
                         .format(*counting))
    return Rates(msg.angular.z, msg.linear.z - msg.angular.y, msg.linear.x)


def copy_fields(source: Any, target: Any) -> Any:
    """Fill a fresh rclpy message from one of the bag reader, and return it."""
    for name in target.get_fields_and_field_types():
        value = getattr(source, name)
        if is_dataclass(value):
            copy_fields(value, getattr(target, name))
        elif isinstance(getattr(target, name), array):
            # Assigning checks each element, which takes seconds for an image.
            getattr(target, name).frombytes(value.tobytes())
        else:
            setattr(target, name, value)
    return target
