# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Small recordings for tests: a textured sphere seen by a turning camera."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.warp import rotate_equirect
from sph_stab_ros.recording.bag_writer import BagWriter

IMAGE_TOPIC = '/theta/image_raw/compressed'
START_NS = 1_700_000_000_123_456_789
PERIOD_NS = 33_333_333
WIDTH = 256


def textured_sphere(width=WIDTH, seed=0):
    """Return a BGR sphere (W/2, W, 3) with texture at several scales, continuous at the seam."""
    rng = np.random.default_rng(seed)
    image = np.zeros((width // 2, width, 3))
    for cells in (width // 64, width // 32, width // 16):
        noise = rng.normal(size=(cells, 2 * cells, 3))
        noise = np.hstack((noise, noise[:, :1]))
        image += cv2.resize(noise, (width + width // (2 * cells), width // 2),
                            interpolation=cv2.INTER_CUBIC)[:, :width]
    return np.clip(128 + 45 * image, 0, 255).astype(np.uint8)


def turning_spheres(count, width=WIDTH, step_deg=1.5):
    """Return the spheres that a turning camera sees, and its R_world_camera."""
    world = textured_sphere(width)
    angles_deg = step_deg * np.arange(count)
    R_world_camera = Rotation.from_euler(
        'YX', np.column_stack((angles_deg, 0.3 * angles_deg)), degrees=True)
    return [rotate_equirect(world, R) for R in R_world_camera], R_world_camera


def stamps_of(count):
    """Return (N,) stamps in ns at 30 Hz."""
    return START_NS + PERIOD_NS * np.arange(count, dtype=np.int64)


def write_bag(path, images, stamps_ns=None, topic=IMAGE_TOPIC):
    """Write a rosbag2 folder with JPEG images and their header stamps; return the path."""
    if stamps_ns is None:
        stamps_ns = stamps_of(len(images))
    with BagWriter(path) as bag:
        for stamp_ns, image in zip(stamps_ns, images):
            bag.write_jpeg(topic, int(stamp_ns), 'theta_camera', image)
    return path


def write_imu(bag, topic, sample, received_ns=None, **fields):
    """Write an ImuSample, or what is like one, as a sensor_msgs Imu into a BagWriter."""
    def vector(values):
        return bag.type('geometry_msgs/msg/Vector3')(**dict(zip('xyz', map(float, values))))
    covariances = {f'{name}_covariance': np.zeros(9) for name in (
        'orientation', 'angular_velocity', 'linear_acceleration')}
    bag.write(topic, bag.type('sensor_msgs/msg/Imu')(**{
        'header': bag.header(sample.stamp_ns, 'imu'),
        'orientation': bag.type('geometry_msgs/msg/Quaternion')(x=0., y=0., z=0., w=1.),
        'angular_velocity': vector(sample.angular_velocity_rad_s),
        'linear_acceleration': vector(sample.specific_force_m_s2), **covariances, **fields}),
        sample.stamp_ns if received_ns is None else received_ns)


def write_video(path, images, stamps_ns=None):
    """Write an MP4 file; return the path."""
    from sph_stab_ros.recording.video_writer import VideoWriter
    if stamps_ns is None:
        stamps_ns = stamps_of(len(images))
    with VideoWriter(path) as video:
        for stamp_ns, image in zip(stamps_ns, images):
            video.write(image, int(stamp_ns))
    return path
