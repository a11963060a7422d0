# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
See it work: play a recording through the real node, leave its result in a video and a plot.

Player and node run as processes of their own, as on a robot; this one listens to what they
publish. DEMO_SECONDS in the environment ends the playing early.
"""

from contextlib import contextmanager, ExitStack
import os
from pathlib import Path
import signal
import subprocess
import sys
from time import monotonic

from geometry_msgs.msg import QuaternionStamped
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CompressedImage
from sph_stab_ros import plots
from sph_stab_ros.command_line import Parser, run
from sph_stab_ros.evaluation import align, compare, EvaluationError
from sph_stab_ros.frame import Frame
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.images import image_from_message
from sph_stab_ros.recording.output import partial_output
from sph_stab_ros.recording.video_writer import VideoWriter
from sph_stab_ros.ros.messages import rotation_from_message, stamp_ns
from sph_stab_ros.side_by_side import side_by_side
from sph_stab_ros.stabilization import StabilizedFrame
from sph_stab_ros.trackers import TrackingStatus
from sph_stab_ros.trajectory import Trajectory
from sph_stab_ros.truth import find_truth_topic, read_truth
from tqdm import tqdm

NAMESPACE = 'demo'
STARTUP_S = 30.
# The node has worked off everything when it is silent for so long after the end.
SILENCE_S = 2.
# Deep enough to lose nothing here.
QOS = QoSProfile(depth=1000)
HFOV_RAD = np.deg2rad(90)


class Listener:
    """Keeps the images that the player sends and the orientations that the node finds."""

    def __init__(self):
        self.images, self.orientations = {}, {}
        self.heard_s = monotonic()
        self._node = rclpy.create_node('demo', namespace=NAMESPACE)
        self._node.create_subscription(CompressedImage, 'image/compressed', self._on_image, QOS)
        self._node.create_subscription(QuaternionStamped, 'orientation', self._on_orientation, QOS)

    def _on_image(self, msg):
        self.images[stamp_ns(msg.header.stamp)] = msg

    def _on_orientation(self, msg):
        self.heard_s = monotonic()
        self.orientations[stamp_ns(msg.header.stamp)] = rotation_from_message(msg)

    def listen_while(self, condition):
        """Take in messages while a condition holds."""
        while condition():
            rclpy.spin_once(self._node, timeout_sec=0.05)

    def node_is_ready(self):
        """Tell whether somebody else subscribes to the images and publishes orientations."""
        return (self._node.count_subscribers('image/compressed') > 1
                and self._node.count_publishers('orientation') > 0)

    def frames(self):
        """Yield a StabilizedFrame for each orientation, in the order of time."""
        for time_ns in sorted(self.images.keys() & self.orientations.keys()):
            frame = Frame(image_from_message(self.images[time_ns]), time_ns)
            yield StabilizedFrame(frame, self.orientations[time_ns], TrackingStatus.OK)

    def trajectory(self):
        """Return the Trajectory of the orientations."""
        stamps_ns = sorted(self.orientations)
        return Trajectory(np.array(stamps_ns), Rotation.concatenate(
            [self.orientations[time_ns] for time_ns in stamps_ns]))


@contextmanager
def process(module, *args):
    """Run an executable of the package in the demo's namespace until the block ends."""
    # Not its entry point: this also works where the package is not installed.
    started = subprocess.Popen((
        sys.executable, '-m', f'sph_stab_ros.{module}', *args, '-r', f'__ns:=/{NAMESPACE}'))
    try:
        yield started
    finally:
        started.send_signal(signal.SIGINT)
        started.wait()


def play(path, seconds):
    """Play a recording through the node for so long; return the Listener."""
    listener = Listener()
    with ExitStack() as stack:
        node = stack.enter_context(process(
            'stabilizer', '--ros-args', '-p', 'image_transport:=compressed'))
        end_s = monotonic() + STARTUP_S
        listener.listen_while(
            lambda: node.poll() is None and monotonic() < end_s and not listener.node_is_ready())
        player = stack.enter_context(process(
            'player', str(path), '--wait', '--compressed', '--ros-args'))
        end_s = monotonic() + seconds
        listener.listen_while(
            lambda: node.poll() is player.poll() is None and monotonic() < end_s)
        player.send_signal(signal.SIGINT)
        listener.listen_while(
            lambda: node.poll() is None and monotonic() < listener.heard_s + SILENCE_S)
    if node.returncode or player.returncode:
        raise RecordingError(f'{path} could not be played, see above')
    if not listener.orientations:
        raise RecordingError('the node has not published any orientation')
    return listener


def demonstrate(path, folder, seconds):
    """Play a recording and write ``demo.mp4`` and ``orientation.png`` into a folder."""
    recording = open_recording(path)
    truth = read_truth(recording, find_truth_topic(recording))
    listener = play(path, seconds)
    folder.mkdir(parents=True, exist_ok=True)
    with partial_output(folder / 'demo.mp4', force=True) as partial, VideoWriter(partial) as video:
        for stabilized in tqdm(listener.frames(), 'video', len(listener.orientations),
                               unit=' frames', disable=None):
            video.write(side_by_side(stabilized, Rotation.identity(), HFOV_RAD),
                        stabilized.stamp_ns)
    estimate = listener.trajectory()
    errors = compare(truth, estimate, align(truth, estimate))
    plots.orientation_figure(recording.name, {'node': errors}).savefig(
        folder / 'orientation.png', dpi=plots.DPI)
    print(f'{folder}/demo.mp4 and {folder}/orientation.png: {len(errors.time_s)} of '
          f'{len(listener.images)} frames stabilised live, orientation off by '
          f'{errors.geodesic_deg.mean():.2f} deg on average, '
          f'{errors.geodesic_deg.max():.2f} deg at most')


def main(argv=None):
    """Run the command line; return the exit status."""
    parser = Parser(prog='demo', description=__doc__)
    parser.add_argument('recording', metavar='REC', type=Path, help='a bag with a truth topic')
    parser.add_argument('folder', metavar='DIR', type=Path, help='where to leave the results')
    args = parser.parse_args(argv)
    try:
        seconds = float(os.environ.get('DEMO_SECONDS') or 'inf')
    except ValueError:
        parser.error('DEMO_SECONDS is not a number')

    def command():
        rclpy.init(args=[])
        try:
            demonstrate(args.recording, args.folder, seconds)
        except ExternalShutdownException:
            raise KeyboardInterrupt from None
        except EvaluationError as error:
            raise RecordingError(str(error)) from error
        finally:
            rclpy.try_shutdown()

    return run('demo', command)


if __name__ == '__main__':
    sys.exit(main())
