# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
See it work: play a recording through the real node, look around in it with a browser.

Player, node and the operator's page run as processes of their own, as on a robot; this one listens
to what they publish and leaves it in a video and a plot. In a terminal the recording is then
played over and over until Ctrl-C; elsewhere it is played once, or for DEMO_SECONDS.
"""

# Before all that takes time to import.
if __name__ == '__main__':
    from sph_stab_ros.executable import start
    raise SystemExit(start('demo'))

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from importlib.util import find_spec
from itertools import chain
import os
from pathlib import Path
import signal
from subprocess import Popen
import sys
from time import monotonic
from typing import Any

from geometry_msgs.msg import QuaternionStamped
import numpy as np
import rclpy
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CompressedImage
from sph_stab_ros.command_line import Parser, run
from sph_stab_ros.command_line.processes import running
from sph_stab_ros.evaluation import plots
from sph_stab_ros.evaluation.alignment import align_trajectories, EvaluationError
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.evaluation.orientation_errors import compare
from sph_stab_ros.geometry.conventions import stamp_ns
from sph_stab_ros.geometry.trajectory import Trajectory
from sph_stab_ros.images.codec import ImageError
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.message_decoder import MessageDecoder
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.images.side_by_side import side_by_side
from sph_stab_ros.recording import open_recording, Recording, RecordingError
from sph_stab_ros.recording.partial_output import partial_output
from sph_stab_ros.recording.video_writer import VideoWriter
from sph_stab_ros.ros.messages import rotation_from_message
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame
from sph_stab_ros.tracking import TrackingStatus
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

    def __init__(self) -> None:
        # By stamp in ns.
        self.images: dict[int, CompressedImage] = {}
        self.orientations: dict[int, Rotation] = {}
        self.heard_s = monotonic()
        self._node = rclpy.create_node('demo', namespace=NAMESPACE)
        self._subscriptions = [
            self._node.create_subscription(
                CompressedImage, 'image/compressed', self._on_image, QOS),
            self._node.create_subscription(
                QuaternionStamped, 'orientation', self._on_orientation, QOS)]

    def close(self) -> None:
        """Take in nothing more."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def _on_image(self, msg: CompressedImage) -> None:
        self.images[stamp_ns(msg.header.stamp)] = msg

    def _on_orientation(self, msg: QuaternionStamped) -> None:
        self.heard_s = monotonic()
        self.orientations[stamp_ns(msg.header.stamp)] = rotation_from_message(msg)

    def listen_while(self, condition: Callable[[], bool]) -> None:
        """Take in messages while a condition holds."""
        while condition():
            rclpy.spin_once(self._node, timeout_sec=0.05)

    def node_is_ready(self) -> bool:
        """Tell whether somebody else subscribes to the images and publishes orientations."""
        return (self._node.count_subscribers('image/compressed') > 1
                and self._node.count_publishers('orientation') > 0)

    def frames(self) -> Iterator[StabilizedFrame]:
        """Yield a StabilizedFrame for each orientation, in the order of time."""
        decoder: MessageDecoder[int] = MessageDecoder(lambda text: None)
        for time_ns, source in chain(
                *(decoder.decode(msg, time_ns, Stamp(time_ns))
                  for time_ns, msg in self.images.items()), decoder.flush()):
            if time_ns in self.orientations and not isinstance(source, ImageError):
                yield StabilizedFrame(
                    Frame(source, time_ns), self.orientations[time_ns], TrackingStatus.OK)

    def trajectory(self) -> Trajectory:
        """Return the Trajectory of the orientations."""
        stamps_ns = sorted(self.orientations)
        return Trajectory(np.array(stamps_ns), Rotation.concatenate(
            [self.orientations[time_ns] for time_ns in stamps_ns]))


def run_in_demo(module: str, *args: str) -> AbstractContextManager[Popen[Any]]:
    """Run an executable of the package in the demo's namespace; a context of its Popen."""
    ros = () if '--ros-args' in args else ('--ros-args',)
    return running(module, *args, *ros, '-r', f'__ns:=/{NAMESPACE}')


def listen(listener: Listener, node: Popen[Any], player: Popen[Any], seconds: float,
           frame_count: float) -> bool:
    """
    Listen until the recording was played once, or for so long, or until Ctrl-C.

    Tells whether it was Ctrl-C, which in a terminal reaches the other processes too.
    """
    def go_on(until_s: float) -> bool:
        return node.poll() is player.poll() is None and monotonic() < until_s

    try:
        start_s = monotonic()
        listener.listen_while(lambda: go_on(start_s + STARTUP_S) and not listener.images)
        first_s = monotonic()
        listener.listen_while(lambda: go_on(first_s + seconds)
                              and len(listener.images) < frame_count)
    except KeyboardInterrupt:
        return True
    return False


def demonstrate(path: Path, folder: Path, seconds: float, forever: bool) -> None:
    """
    Play a recording and write ``demo.mp4`` and ``orientation.png`` into a folder.

    With ``forever`` it is played on, for the page, until Ctrl-C.
    """
    recording = open_recording(path)
    # A damaged bag does not tell.
    frame_count = recording.frame_count or float('inf')
    truth = read_truth(recording, find_truth_topic(recording))
    listener = Listener()
    with ExitStack() as stack:
        if find_spec('aiohttp'):
            stack.enter_context(run_in_demo('operator'))
        else:
            print("demo: without aiohttp there is no operator's page", file=sys.stderr)
        node = stack.enter_context(run_in_demo(
            'stabilizer', '--ros-args', '-p', 'image_transport:=compressed'))
        end_s = monotonic() + STARTUP_S
        listener.listen_while(
            lambda: node.poll() is None and monotonic() < end_s and not listener.node_is_ready())
        player = stack.enter_context(run_in_demo(
            'player', str(path), '--wait', '--compressed', *(['--loop'] if forever else [])))
        ending = listen(listener, node, player, seconds, frame_count)
        if not forever:
            player.send_signal(signal.SIGINT)
        listener.listen_while(lambda: not ending and node.poll() is None
                              and len(listener.orientations) < frame_count
                              and monotonic() < listener.heard_s + SILENCE_S)
        listener.close()
        if node.poll() or player.poll():
            raise RecordingError(f'{path} could not be played, see above')
        if not listener.orientations:
            raise RecordingError('the node has not published any orientation')
        if not forever:
            # The node would tell for as long as nothing comes any more.
            stack.close()
        write_results(recording, truth, listener, folder)
        if forever and not ending:
            print('demo: playing on until Ctrl-C', flush=True)
            with suppress(KeyboardInterrupt):
                player.wait()


def write_results(
        recording: Recording, truth: Trajectory, listener: Listener, folder: Path) -> None:
    """Write what was heard, and say how exact it is."""
    folder.mkdir(parents=True, exist_ok=True)
    with partial_output(folder / 'demo.mp4', force=True) as partial, VideoWriter(partial) as video:
        for stabilized in tqdm(listener.frames(), 'video', len(listener.orientations),
                               unit=' frames', disable=None):
            video.write(side_by_side(stabilized, Rotation.identity(), HFOV_RAD),
                        stabilized.stamp_ns)
    estimate = listener.trajectory()
    # The stamps are of one clock; a few seconds of motion would not tell an offset.
    alignment = align_trajectories(truth, estimate, clock_offset_ns=0)
    errors = compare(truth, estimate, alignment)
    plots.orientation_figure(recording.name, {'node': errors}).savefig(
        folder / 'orientation.png', dpi=plots.DPI)
    exactness = (f'orientation off by {errors.geodesic_deg.mean():.2f} deg on average, '
                 f'{errors.geodesic_deg.max():.2f} deg at most' if alignment.mount_solved
                 else 'too little motion to tell how exactly')
    # On a busy machine this process misses pictures that the node has seen.
    played = len(listener.images.keys() | listener.orientations.keys())
    print(f'{folder}/demo.mp4 and {folder}/orientation.png: {len(errors.time_s)} of '
          f'{played} frames stabilised live, {exactness}', flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(prog='demo', description=__doc__)
    parser.add_argument('recording', metavar='REC', type=Path, help='a bag with a truth topic')
    parser.add_argument('folder', metavar='DIR', type=Path, help='where to leave the results')
    args = parser.parse_args(argv)
    try:
        seconds = float(os.environ.get('DEMO_SECONDS') or 'inf')
    except ValueError:
        parser.error('DEMO_SECONDS is not a number')

    forever = sys.stdin.isatty() and 'DEMO_SECONDS' not in os.environ

    def command() -> None:
        # Ctrl-C comes as KeyboardInterrupt.
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        try:
            demonstrate(args.recording, args.folder, seconds, forever)
        except EvaluationError as error:
            raise RecordingError(str(error)) from error
        finally:
            rclpy.try_shutdown()

    return run('demo', command)
