# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The real node in a process of its own, and a peer that talks to it through the middleware."""

from collections import defaultdict, deque
from contextlib import contextmanager
from fcntl import flock, LOCK_EX, LOCK_NB
from itertools import count
import os
import signal
import subprocess
import sys
from tempfile import gettempdir
import time

import cv2
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import (
    PoseWithCovarianceStamped, QuaternionStamped, Twist, Vector3)
import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.images.codec import fill_compressed, fill_image
from std_srvs.srv import Trigger
from tiny_recordings import textured_sphere

NODE = '-m', 'sph_stab_ros.stabilizer'
# By the ends of topics.
TYPES = {
    'orientation': QuaternionStamped,
    'orientation_covariance': PoseWithCovarianceStamped,
    '/image': Image,
    '/compressed': CompressedImage,
    '/camera_info': CameraInfo,
    '/diagnostics': DiagnosticArray,
}
# Generous: only what fails waits so long.
TIMEOUT_S = 30.
SETTLING_S = 0.5
GOODBYES_S = 1.
COMPRESSED = ('-p', 'image_transport:=compressed')
# Best effort may lose any image, and raw ones that exceed the 0.5 MB of Fast DDS's shared memory
# by default often: whoever waits for the answer to one image would wait in vain.
RELIABLE = 'qos_overrides./{}.subscription.reliability:=reliable'
# So do raw views of the usual size, whose lost parts come again, but three seconds later.
SMALL_VIEW = ('-p', 'view.width:=320', '-p', 'view.height:=240')


def free_domains():
    """Yield domains in which no other test's nodes live, nor those of other runs here."""
    held = deque(maxlen=20)
    for n in count(os.getpid() * 7):
        domain = 1 + n % 100
        lock = open(f'{gettempdir()}/sph_stab_ros_test_domain_{domain}.lock', 'w')
        try:
            flock(lock, LOCK_EX | LOCK_NB)
        except OSError:
            lock.close()
        else:
            held.append(lock)
            yield domain


DOMAINS = free_domains()

os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


class Peer:
    """
    What surrounds a stabilizer node: a camera, subscribers, a user who sets parameters.

    ``received`` holds all messages of the topics subscribed to, by topic.
    """

    def __init__(self, process, log, domain, topics, compressed, namespace, views, camera):
        self.process = process
        self._log = log
        self.received = defaultdict(list)
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node('peer', context=self._context, namespace=namespace)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._parameters = AsyncParameterClient(self._node, 'stabilizer')
        self._reset = self._node.create_client(Trigger, 'stabilizer/reset')
        self._level = self._node.create_client(Trigger, 'stabilizer/level')
        self._home = self._node.create_client(Trigger, 'stabilizer/look_at_home')
        self._imu = self._node.create_publisher(Imu, 'imu', 100)
        self._clock = self._node.create_publisher(Clock, '/clock', 10)
        self._directions = {view: self._node.create_publisher(
            QuaternionStamped, f'{view}/direction', 10) for view in views}
        self._velocities = {view: self._node.create_publisher(
            Twist, f'{view}/cmd_vel', 10) for view in views}
        if camera:
            self._images = self._node.create_publisher(
                CompressedImage if compressed else Image,
                'image/compressed' if compressed else 'image', 10)
        for topic in topics:
            self._subscribe(topic)
        if camera:
            self.wait_until(self._images.get_subscription_count)
        self.wait_until(self._parameters.services_are_ready)
        self.wait_until(self._reset.service_is_ready)
        self.wait_until(self._level.service_is_ready)
        self.wait_until(self._home.service_is_ready)
        for publisher in (*self._directions.values(), *self._velocities.values()):
            self.wait_until(publisher.get_subscription_count)
        # There is no way to ask the node whether it knows of our subscriptions yet.
        self.spin_for(SETTLING_S)

    def close(self):
        """Leave the middleware."""
        leave(self._node, self._executor)

    def _subscribe(self, topic):
        """Subscribe to a topic; ``received`` fills from now on."""
        msg_type, = (TYPES[end] for end in TYPES if topic.endswith(end))
        self.subscribe(msg_type, topic, self.received[topic].append)

    def subscribe(self, msg_type, topic, callback, qos=10):
        """Subscribe to a topic of any type, once it is published; return what unsubscribes."""
        subscription = self._node.create_subscription(msg_type, topic, callback, qos)
        self.wait_until(lambda: self._node.count_publishers(topic))
        return lambda: self._node.destroy_subscription(subscription)

    def advertise(self, msg_type, topic, qos=10):
        """Announce a topic of any type; return the publisher."""
        return self._node.create_publisher(msg_type, topic, qos)

    def spin_for(self, seconds):
        """Serve the middleware for so long."""
        end_s = time.monotonic() + seconds
        self.wait_until(lambda: time.monotonic() > end_s)

    def wait_until(self, condition, timeout_s=TIMEOUT_S):
        """Serve the middleware until a condition holds; return its value."""
        end_s = time.monotonic() + timeout_s
        while not (value := condition()):
            assert time.monotonic() < end_s, f'waited in vain; the node said:\n{self.output()}'
            assert self.process.poll() is None, f'the node has ended:\n{self.output()}'
            self._executor.spin_once(timeout_sec=0.02)
        return value

    def output(self):
        """Return what the node has written so far."""
        return self._log.read_text()

    def send(self, image, stamp_ns, frame_id='camera'):
        """Publish an image, an array or a message that is ready."""
        if isinstance(image, (Image, CompressedImage)):
            msg = image
        elif self._images.msg_type is CompressedImage:
            msg = fill_compressed(CompressedImage(), image)
        else:
            msg = fill_image(Image(), image)
        msg.header.stamp = Time(nanoseconds=int(stamp_ns)).to_msg()
        msg.header.frame_id = frame_id
        self._images.publish(msg)

    def stabilize(self, image, stamp_ns):
        """Publish an image, wait for the answer on every topic, and return the orientation."""
        watched = [topic for topic in self.received if topic != '/diagnostics']
        counts = [len(self.received[topic]) for topic in watched]
        self.send(image, stamp_ns)
        self.wait_until(lambda: all(
            len(self.received[topic]) > n for topic, n in zip(watched, counts)))
        return rotation(self.received['orientation'][-1])

    def qos(self, topic):
        """Return the QoS of what the node publishes or subscribes to under a whole name."""
        ends = (self._node.get_publishers_info_by_topic(topic)
                + self._node.get_subscriptions_info_by_topic(topic))
        profile, = (end.qos_profile for end in ends if end.node_name == 'stabilizer')
        return profile

    def subscribers(self, topic):
        """Return the names of the nodes that subscribe to a topic of a whole name."""
        return [end.node_name for end in self._node.get_subscriptions_info_by_topic(topic)]

    def look(self, quaternion_xyzw, frame_id='', view='view'):
        """Publish a view direction."""
        msg = QuaternionStamped()
        msg.header.frame_id = frame_id
        (msg.quaternion.x, msg.quaternion.y, msg.quaternion.z,
         msg.quaternion.w) = map(float, quaternion_xyzw)
        self._directions[view].publish(msg)

    def turn(self, view='view', linear=(0, 0, 0), angular=(0, 0, 0)):
        """Publish a Twist of linear and angular x, y, z."""
        linear, angular = (
            Vector3(**dict(zip('xyz', map(float, xyz)))) for xyz in (linear, angular))
        self._velocities[view].publish(Twist(linear=linear, angular=angular))

    def feel(self, *samples, **fields):
        """Publish ImuSamples, the messages with these fields, to a node that listens."""
        self.wait_until(self._imu.get_subscription_count)
        for sample in samples:
            msg = Imu(**fields)
            msg.header.stamp = Time(nanoseconds=int(sample.stamp_ns)).to_msg()
            for vector, values in ((msg.linear_acceleration, sample.specific_force_m_s2),
                                   (msg.angular_velocity, sample.angular_velocity_rad_s)):
                if values is not None:
                    vector.x, vector.y, vector.z = map(float, values)
            self._imu.publish(msg)

    def tell_time(self, time_ns):
        """Publish a simulated time."""
        self._clock.publish(Clock(clock=Time(nanoseconds=int(time_ns)).to_msg()))

    def look_at_home(self):
        """Call ~/look_at_home."""
        return self._call(self._home.call_async(Trigger.Request()))

    def level(self):
        """Call ~/level."""
        return self._call(self._level.call_async(Trigger.Request()))

    def reset(self):
        """Call ~/reset."""
        return self._call(self._reset.call_async(Trigger.Request()))

    def set_parameters(self, **values):
        """Set parameters (``__`` for a dot) and return the reasons of refusal, '' where set."""
        answer = self._call(self._parameters.set_parameters([
            Parameter(name.replace('__', '.'), value=value) for name, value in values.items()]))
        return [result.reason for result in answer.results]

    def get_parameters(self, *names):
        """Return the values of parameters."""
        answer = self._call(self._parameters.get_parameters(list(names)))
        return [rclpy.parameter.parameter_value_to_python(value) for value in answer.values]

    def describe_parameters(self, *names):
        """Return the descriptors of parameters."""
        return self._call(self._parameters.describe_parameters(list(names))).descriptors

    def list_parameters(self):
        """Return the names of all parameters."""
        return set(self._call(self._parameters.list_parameters([], 10)).result.names)

    def diagnostics(self, condition):
        """Return the values of the first status of the node from now on that meets a condition."""
        self.received['/diagnostics'].clear()

        def found():
            for msg in self.received['/diagnostics']:
                values = {pair.key: pair.value for pair in msg.status[0].values}
                values['level'], values['message'] = msg.status[0].level, msg.status[0].message
                if condition(values):
                    return values
        return self.wait_until(found)

    def call_in_vain(self, service_type, service, request):
        """Call a service that may not answer."""
        client = self._node.create_client(service_type, service)
        self.wait_until(client.service_is_ready)
        client.call_async(request)
        self.spin_for(SETTLING_S)
        self._node.destroy_client(client)

    def _call(self, future):
        self.wait_until(future.done)
        return future.result()


def leave(node, executor):
    """
    Take a node with a Context of its own out of the middleware, after others have left.

    Fast DDS may spin for minutes when participants leave at once, see ``bounded_ending``. What was
    killed is not waited for.
    """
    end_s = time.monotonic() + GOODBYES_S
    while len(node.get_node_names()) > 1 and time.monotonic() < end_s:
        time.sleep(0.02)
    executor.shutdown()
    node.destroy_node()
    node.context.try_shutdown()


@contextmanager
def stabilizer(tmp_path, *arguments, topics=('orientation',), compressed=False, namespace='',
               views=('view',), domain=None, camera=True, reliable=True, program=NODE):
    """
    Run the node with ROS arguments; give a Peer, with a camera, and leave neither behind.

    Unless ``reliable`` is False, no image is lost on the way. ``program`` runs the node.
    """
    domain = domain or next(DOMAINS)
    arguments = (*SMALL_VIEW, *arguments)
    if compressed:
        arguments = (*COMPRESSED, *arguments)
    if reliable:
        arguments = ('-p', RELIABLE.format('image/compressed' if compressed else 'image'),
                     *arguments)
    log = tmp_path / f'node{namespace}.log'
    if namespace:
        arguments += ('-r', f'__ns:=/{namespace}')
    with open(log, 'w') as log_file:
        process = subprocess.Popen(
            [sys.executable, *program, '--ros-args', *arguments],
            env={**os.environ, 'ROS_DOMAIN_ID': str(domain)}, stdout=log_file, stderr=log_file)
    peer = None
    try:
        peer = Peer(process, log, domain, topics, compressed, namespace, views, camera)
        yield peer
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
        finally:
            if peer:
                peer.close()


def rotation(msg):
    """Return the Rotation of a QuaternionStamped."""
    q = msg.quaternion
    return Rotation.from_quat((q.x, q.y, q.z, q.w))


def stamp_ns(msg):
    """Return a message's header stamp in nanoseconds."""
    return msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec


def pixels(msg):
    """Return the picture (H, W, 3) of a perspective or spherical image message."""
    if isinstance(msg, CompressedImage):
        assert msg.format == 'bgr8; jpeg compressed bgr8'
        return cv2.imdecode(np.frombuffer(msg.data, np.uint8), cv2.IMREAD_COLOR)
    return np.frombuffer(msg.data, np.uint8).reshape(msg.height, msg.width, 3)


def compass_sphere(width=512):
    """Return a sphere whose colours are the bearings, with texture to hold on to."""
    image = 128 + 100 * bearing_grid(width)
    texture = textured_sphere(width).astype(float).mean(axis=-1, keepdims=True) - 128
    # Not where tests look.
    quiet = np.abs(bearing_grid(width)).max(axis=-1, keepdims=True) > 0.98
    return np.clip(image + np.where(quiet, 0, 0.2 * texture), 0, 255).astype(np.uint8)


def shown_direction(msg):
    """Return the bearing that the centre of a view of ``compass_sphere`` shows."""
    image = pixels(msg).astype(float)
    centre = image[image.shape[0] // 2, image.shape[1] // 2]
    return (centre - 128) / 100
