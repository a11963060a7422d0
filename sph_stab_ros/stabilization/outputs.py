# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
What is published of each stabilised frame: the node's topics, and what a bag of results holds.

Nothing is drawn or put into a message before somebody asks for it.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import frame_in_tf, NodeConfig, ViewConfig
from sph_stab_ros.geometry.arrays import Image
from sph_stab_ros.images.front_marker import mark_sphere, mark_view
from sph_stab_ros.recording import messages
from sph_stab_ros.stabilization.pipeline import view_direction
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame
from sph_stab_ros.stabilization.steering import Look

TRANSFORMS_TOPIC = '/tf'
COMPRESSED = '/compressed'
SAME_FRAME_RAD = 1e-9


@dataclass(frozen=True)
class VirtualCamera:
    """A view of a name, and where it looks."""

    name: str
    view: ViewConfig
    look: Look

    @property
    def size_wh(self) -> tuple[int, int]:
        """Width and height of its picture."""
        return self.view.width, self.view.height


@dataclass(frozen=True)
class Output:
    """
    A message to publish on a topic.

    ``message(make)`` makes it, see ``recording.messages``; ``draw()`` does the most of that before
    where it is of a picture, which is drawn once for all its messages.
    """

    topic: str
    message: Callable[[messages.Make], Any]
    draw: Callable[[], Image] | None = None


def topics(view_names: Iterable[str]) -> dict[str, str]:
    """Return the type of the messages on each topic, by its name."""
    pictures = {f'{name}/image': messages.IMAGE for name in ('stabilized', *view_names)}
    return {
        'orientation': messages.QUATERNION,
        'orientation_covariance': messages.POSE_WITH_COVARIANCE,
        'virtual_orientation': messages.QUATERNION,
        TRANSFORMS_TOPIC: messages.TRANSFORMS,
        **pictures,
        **{topic + COMPRESSED: messages.COMPRESSED_IMAGE for topic in pictures},
        **{f'{name}/camera_info': messages.CAMERA_INFO for name in view_names}}


def configured_look(view: ViewConfig) -> Look:
    """Return the Look that a ViewConfig says."""
    return Look(view_direction(view), float(np.deg2rad(view.hfov_deg)))


def configured_camera(name: str, view: ViewConfig) -> VirtualCamera:
    """Return the VirtualCamera of a view that looks where its ViewConfig says."""
    return VirtualCamera(name, view, configured_look(view))


def orientation_outputs(stabilized: StabilizedFrame, config: NodeConfig,
                        cameras: Sequence[VirtualCamera]) -> Iterator[Output]:
    """Yield the Outputs of a StabilizedFrame that cost little, under a NodeConfig."""
    stamp_ns, world = stabilized.stamp_ns, config.stabilized_frame
    R_world_camera = stabilized.R_world_camera
    in_world = partial(messages.orientation, stamp_ns=stamp_ns, frame_id=world)
    yield Output('orientation', partial(in_world, R_frame_other=R_world_camera))
    yield Output(
        'virtual_orientation', partial(in_world, R_frame_other=stabilized.R_world_virtual))
    if stabilized.covariance is not None:
        yield Output('orientation_covariance', partial(
            messages.pose, stamp_ns=stamp_ns, frame_id=world, R_world_camera=R_world_camera,
            covariance=stabilized.covariance))
    if config.publish_tf and fits_into_tree(stabilized.frame.frame_id, config, cameras):
        yield Output(TRANSFORMS_TOPIC, lambda make: messages.transforms(
            make, stamp_ns, rotations_in_tree(stabilized, config, cameras)))


def picture_outputs(stabilized: StabilizedFrame, config: NodeConfig,
                    cameras: Sequence[VirtualCamera], raw: bool = True) -> Iterator[Output]:
    """Yield the Outputs of a StabilizedFrame that show something; also ``raw`` images or not."""
    stamp_ns = stabilized.stamp_ns
    pictures = partial(_picture_outputs, stamp_ns=stamp_ns, quality=config.jpeg_quality, raw=raw)
    is_turned = stabilized.R_world_virtual.magnitude() > SAME_FRAME_RAD
    yield from pictures(
        'stabilized/image', partial(draw_sphere, stabilized, config),
        frame_id=config.virtual_frame if is_turned else config.stabilized_frame)
    for camera in cameras:
        frame_id = camera.view.frame_id
        yield from pictures(f'{camera.name}/image', partial(draw_view, stabilized, config, camera),
                            frame_id=frame_id)
        yield Output(f'{camera.name}/camera_info', partial(
            messages.camera_info, stamp_ns=stamp_ns, frame_id=frame_id,
            hfov_rad=camera.look.hfov_rad, size_wh=camera.size_wh))


def fits_into_tree(
        frame_id: str, config: NodeConfig, cameras: Sequence[VirtualCamera]) -> bool:
    """Tell whether the images' frame can be the root: it has a name, and none of those below."""
    below = (config.stabilized_frame, config.virtual_frame,
             *(camera.view.frame_id for camera in cameras))
    return frame_in_tf(frame_id) not in ('', *map(frame_in_tf, below))


def rotations_in_tree(stabilized: StabilizedFrame, config: NodeConfig,
                      cameras: Sequence[VirtualCamera]) -> dict[tuple[str, str], Rotation]:
    """
    Return R_parent_child by (parent, child): from the camera to the world, from there to others.

    No frame of the robot's tree gets another parent: the stabilised frame is a child of the
    image's frame, wherever that hangs, and the virtual cameras are children of the stabilised one.
    """
    world, R_world_virtual = config.stabilized_frame, stabilized.R_world_virtual
    return {(stabilized.frame.frame_id, world): stabilized.R_world_camera.inv(),
            (world, config.virtual_frame): R_world_virtual,
            **{(world, camera.view.frame_id): R_world_virtual * camera.look.R_virtual_view
               for camera in cameras}}


def _picture_outputs(topic: str, draw: Callable[[], Image], frame_id: str, stamp_ns: int,
                     quality: int, raw: bool) -> Iterator[Output]:
    draw = cache(draw)
    if raw:
        yield Output(
            topic, lambda make: messages.image(make, stamp_ns, frame_id, draw()), draw)
    yield Output(topic + COMPRESSED, lambda make: messages.compressed_image(
        make, stamp_ns, frame_id, draw(), quality), draw)


def draw_sphere(stabilized: StabilizedFrame, config: NodeConfig) -> Image:
    """Return the virtual camera's sphere, with the front marked where it is wanted."""
    image = stabilized.sphere()
    if config.front_marker == 'all':
        mark_sphere(image, stabilized.R_camera_virtual.inv(), np.deg2rad(config.front_yaw_deg))
    return image


def draw_view(stabilized: StabilizedFrame, config: NodeConfig, camera: VirtualCamera) -> Image:
    """Return the picture of a view, with the front marked where it is wanted."""
    look = camera.look
    image = stabilized.view(look.R_virtual_view, look.hfov_rad, camera.size_wh)
    if config.front_marker != 'none':
        R_camera_view = stabilized.R_camera_virtual * look.R_virtual_view
        mark_view(image, R_camera_view.inv(), np.deg2rad(config.front_yaw_deg), look.hfov_rad)
    return image
