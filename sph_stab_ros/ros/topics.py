# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Topics, and image topics as image_transport has them: ``image``, ``image/compressed``, ….

Remapping ``image`` takes ``image/compressed`` along, unless that is remapped itself. All quality
of service can be overridden by parameters (``qos_overrides.<topic>.publisher.depth``, …).
"""

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from sph_stab_ros.config import ConfigError
from sph_stab_ros.recording.messages import (
    COMPRESSED_IMAGE, COMPRESSED_VIDEO, FFMPEG_PACKET, IMAGE)
from sph_stab_ros.ros.messages import message_type
from sph_stab_ros.stabilization.outputs import COMPRESSED

# What the topics of each transport end with, and the type of their messages.
TRANSPORTS = {'raw': ('', IMAGE), 'compressed': (COMPRESSED, COMPRESSED_IMAGE),
              'ffmpeg': ('/ffmpeg', FFMPEG_PACKET), 'foxglove': ('/foxglove', COMPRESSED_VIDEO)}
# Of raw images the newest counts; of video, which compressed ones may be, all do.
IMAGE_DEPTH, COMPRESSED_DEPTH = 5, 30
POLICIES = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
            QoSPolicyKind.DURABILITY)
# The middleware counts in 32 bits.
MAX_DEPTH = 2**31 - 1


def subscribe_to_images(node: Node, topic: str, transport: str,
                        callback: Callable[[Any], None]) -> Subscription:
    """Subscribe to ``topic`` by one of the TRANSPORTS, as sensor data; ConfigError without."""
    ending, type_name = TRANSPORTS[transport]
    try:
        msg_type = message_type(type_name)
    except ImportError:
        package, _, _ = type_name.partition('/')
        raise ConfigError(
            f'image_transport {transport} needs {package}, which is not installed') from None
    return subscribe(
        node, msg_type, transported_topic(node, topic, ending), callback,
        QoSProfile(depth=COMPRESSED_DEPTH if ending else IMAGE_DEPTH,
                   reliability=ReliabilityPolicy.BEST_EFFORT))


def subscribe(node: Node, msg_type: type[Any], topic: str, callback: Callable[[Any], None],
              qos: QoSProfile | int = 10, **options: Any) -> Subscription:
    """Return a subscription; ``qos`` is a QoSProfile or the depth of a reliable one."""
    return node.create_subscription(
        msg_type, topic, callback, qos, qos_overriding_options=_overriding(), **options)


def advertise(node: Node, msg_type: type[Any], topic: str, depth: int = 5) -> Publisher:
    """Return a publisher, reliable so that every subscriber matches (REP 2003)."""
    return node.create_publisher(
        msg_type, topic, QoSProfile(depth=depth), qos_overriding_options=_overriding())


def is_wanted(publisher: Publisher) -> bool:
    """Tell whether anybody subscribes to a publisher's topic, or may later and wants the last."""
    return (publisher.get_subscription_count() > 0
            or publisher.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL)


def compressed_topic(node: Node, topic: str) -> str:
    """Return where the compressed images of ``topic`` are, remappings considered."""
    return transported_topic(node, topic, COMPRESSED)


def transported_topic(node: Node, topic: str, ending: str) -> str:
    """Return where the images of ``topic`` are by a transport, remappings considered."""
    name = topic + ending
    if not ending or node.resolve_topic_name(name) != node.resolve_topic_name(
            name, only_expand=True):
        return name
    return node.resolve_topic_name(topic) + ending


def _overriding() -> QoSOverridingOptions:
    return QoSOverridingOptions(POLICIES, callback=_checked)


def _checked(qos: QoSProfile) -> SetParametersResult:
    """Refuse what rclpy lets pass and the middleware then fails at."""
    if not 1 <= qos.depth <= MAX_DEPTH:
        return SetParametersResult(
            successful=False, reason=f'a depth is at least 1 and at most {MAX_DEPTH}')
    if 'UNKNOWN' in (qos.history.name, qos.reliability.name, qos.durability.name):
        return SetParametersResult(successful=False, reason="no policy can be 'unknown'")
    return SetParametersResult(successful=True)
