# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Blender's panoramic camera on the package's conventions, its motion within the exposure.

Blender's camera looks along its own -z with y up; the package's optical frame looks along z with
y down. `R_OPTICAL_BLENDER` is the half turn about x between them; the panorama's centre then is
the optical axis and its longitude grows to the right.
"""

import bpy
import cv2
from mathutils import Quaternion
from movers import Mover
from movers import pose_matrix
import numpy as np
from scipy.spatial.transform import Rotation

R_OPTICAL_BLENDER = Rotation.from_euler('x', 180, degrees=True)
SHUTTER = 0.5  # the exposure in Blender's frames; keyframes stretch it to the wanted seconds


def setup(width, samples, readout_share=0.0):
    """
    Set up an empty scene with Cycles and the panoramic camera; return the camera's object.

    `readout_share` is the part of the shutter's span in which the rows start one after the
    other from the top (rolling shutter); zero exposes all rows at once.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    render, cycles = scene.render, scene.cycles
    render.engine = 'CYCLES'
    render.resolution_x, render.resolution_y = width, width // 2
    render.resolution_percentage = 100
    render.image_settings.file_format = 'PNG'
    render.image_settings.color_mode = 'RGB'
    render.image_settings.compression = 30
    render.use_persistent_data = True
    render.use_motion_blur = True
    render.motion_blur_position = 'CENTER'
    render.motion_blur_shutter = SHUTTER
    cycles.device = 'CPU'
    cycles.samples = samples
    cycles.use_adaptive_sampling = False
    cycles.use_light_tree = False  # with a dozen lamps it costs more than it gains
    cycles.use_denoising = True
    cycles.denoiser = 'OPENIMAGEDENOISE'
    cycles.denoising_input_passes = 'RGB_ALBEDO_NORMAL'
    cycles.denoising_prefilter = 'FAST'
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 3, 3, 2
    cycles.transmission_bounces = cycles.volume_bounces = 0
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_indirect = 2.0
    cycles.blur_glossy = 1.0
    cycles.filter_width = 1.5
    if readout_share:
        cycles.rolling_shutter_type = 'TOP'
        cycles.rolling_shutter_duration = 1.0 - readout_share
    scene.world = bpy.data.worlds.new('world')
    scene.world.use_nodes = True
    scene.world.node_tree.nodes['Background'].inputs['Strength'].default_value = 0.0
    lens = bpy.data.cameras.new('camera')
    lens.type, lens.panorama_type = 'PANO', 'EQUIRECTANGULAR'
    lens.clip_start = 0.005
    camera = bpy.data.objects.new('camera', lens)
    scene.collection.objects.link(camera)
    scene.camera = camera
    return camera


def follow(camera, flight):
    """Return the mover that keeps the camera on its flight."""
    def pose(t_s):
        return pose_matrix(flight.R_mocap_camera(t_s) * R_OPTICAL_BLENDER,
                           flight.p_mocap_camera(t_s))
    camera.cycles.motion_steps = 2
    return Mover(camera, pose)


def expose(movers, index, t_s, span_s):
    """Keyframe everything around the frame `index`: `span_s` seconds, centred on `t_s`."""
    for mover in movers:
        mover.thing.animation_data_clear()
        mover.thing.rotation_mode = 'QUATERNION'
        last = None
        for share in (-0.5, -0.25, 0.0, 0.25, 0.5):
            position, turn, _ = mover.pose(t_s + share * span_s).decompose()
            if last is not None and last.dot(turn) < 0.0:
                turn = Quaternion([-q for q in turn])
            last = turn
            mover.thing.location, mover.thing.rotation_quaternion = position, turn
            for channel in ('location', 'rotation_quaternion'):
                mover.thing.keyframe_insert(channel, frame=index + share * SHUTTER)
    for action in list(bpy.data.actions):
        if action.users == 0:
            bpy.data.actions.remove(action)
    bpy.context.scene.frame_set(index)


def stitch(image, error_rad, blend_rad=0.03):
    """
    Turn what the rear lens sees (z < 0) by `error_rad` about an oblique axis.

    Around the seam the two lenses are blended, which leaves ghosts as real stitching does.
    """
    height, width = image.shape[:2]
    lon = (np.arange(width) + 0.5) / width * 2 * np.pi - np.pi
    lat = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    lon, lat = np.meshgrid(lon, lat)
    bearing = np.stack([np.cos(lat) * np.sin(lon), -np.sin(lat), np.cos(lat) * np.cos(lon)], -1)
    turn = Rotation.from_rotvec(error_rad * np.array([0.8, 0.5, 0.33]))
    x, y, z = np.moveaxis(turn.apply(bearing.reshape(-1, 3)).reshape(bearing.shape), -1, 0)
    u = (np.arctan2(x, z) + np.pi) / (2 * np.pi) * width - 0.5
    v = (np.pi / 2 + np.arcsin(np.clip(y, -1, 1))) / np.pi * height - 0.5
    padded = cv2.copyMakeBorder(image, 1, 1, 0, 0, cv2.BORDER_REPLICATE)
    padded = cv2.copyMakeBorder(padded, 0, 0, 2, 2, cv2.BORDER_WRAP)
    rear = cv2.remap(padded, (u + 2).astype(np.float32), (v + 1).astype(np.float32),
                     cv2.INTER_CUBIC)
    front = np.clip(bearing[..., 2:] / blend_rad + 0.5, 0.0, 1.0)
    return np.round(front * image + (1.0 - front) * rear).astype(np.uint8)
