# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Let the node run for long: memory must not grow, the heartbeat not stop, the end be clean.

A player loops a recording while parameters change every second, bad values among them, and
subscribers come and go, alone and with a participant of their own. Prints a line for each check
that fails and ends with status 1 then.

Memory is what the node has for itself: shared memory is the middleware's and comes and goes with
its peers. A straight line is fitted through it from the second minute on; it must not rise by more
than MAX_GROWTH of where it starts. Runs of less than five minutes do not judge memory.
"""

from argparse import Namespace
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
import sys
from time import monotonic

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import Imu
from sph_stab_ros.benchmark.soak_visitors import Comings, Participant
from sph_stab_ros.command_line import Parser, run
from sph_stab_ros.command_line.arguments import file_argument, whole_number
from sph_stab_ros.command_line.processes import memory_mb, running
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.geometry.conventions import NS_PER_S, stamp_ns
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.recording.partial_output import write_json
from sph_stab_ros.stabilization.imu import NOT_MEASURED
from sph_stab_ros.stabilization.level import GRAVITY_M_S2
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from tqdm import tqdm

NAMESPACE = 'soak'
STARTUP_S = 30.
WARM_UP_S = 60
# Shorter runs hold too few rounds of CHANGES to tell growth from their ups and downs.
MIN_MEMORY_S = 300
MAX_GROWTH = 0.05
# Beats come every second; at two one was left out.
MAX_GAP_S = 2.
# Parameter, value, and whether the node is to take it; one a second, over and over.
CHANGES = (
    ('view.yaw_deg', 90., True), ('view.hfov_deg', 60., True), ('estimator', 'moment', True),
    ('flow', 'dis', True), ('view.width', 960, True), ('view.height', 540, True),
    ('estimator', 'magic', False), ('estimator', 'pts', True), ('view.pitch_deg', -30., True),
    ('mask', 'lat:-90,-62', True), ('estimator', 'pts_epipolar', True), ('flow_updates', 1, True),
    ('view.hfov_deg', 500., False), ('estimator', 'anchored', True), ('mask', 'none.png', False),
    ('working_width', 480, True), ('view.roll_deg', 20., True), ('jpeg_quality', 50, True),
    ('mask', '', True), ('working_width', 0, True), ('flow_updates', 0, True),
    ('flow', 'farneback', True), ('jpeg_quality', 90, True), ('view.hfov_deg', 100., True),
    ('view.width', 640, True), ('view.height', 480, True), ('smoothing.mode', 'follow', True),
    ('level', 'imu', True), ('level', 'sideways', False), ('smoothing.mode', 'yaw_follow', True),
    ('level', 'first_frame', True), ('smoothing.mode', 'lock', True), ('view.yaw_deg', 0., True),
    ('view.pitch_deg', 0., True), ('view.roll_deg', 0., True), ('view.hfov_deg', 90., True))
RESET_PERIOD_S = 45


class Soak:
    """What is done to the node, second by second, and what is seen of it."""

    def __init__(self) -> None:
        self.failures: list[str] = []
        # Stamp in s and count of frames of each heartbeat; memory_mb of each second.
        self.beats: list[tuple[float, int]] = []
        self.memory: list[dict[str, float]] = []
        self.host = Participant('host', NAMESPACE)
        self._comings = Comings(self.host)
        self._changes = cycle(CHANGES)
        node = self.host.node
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_beat, 10)
        self._parameters = AsyncParameterClient(node, 'stabilizer')
        self._reset = node.create_client(Trigger, 'stabilizer/reset')
        self._imu = node.create_publisher(Imu, 'imu', 10)

    def _on_beat(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            if status.name.startswith(f'/{NAMESPACE}/'):
                values = {pair.key: pair.value for pair in status.values}
                self.beats.append((stamp_ns(msg.header.stamp) / NS_PER_S, int(values['frames'])))

    def wait_for_frames(self) -> None:
        """Return when the node is there and images flow; RecordingError if that never happens."""
        end_s = monotonic() + STARTUP_S
        while not (self.beats and self.beats[-1][1] and self._parameters.services_are_ready()):
            if monotonic() > end_s:
                raise RecordingError('the node does not work')
            self.host.serve(0.1)
        self.beats = self.beats[-1:]

    def second(self, number: int) -> None:
        """Change a parameter, and let subscribers come and go."""
        end_s = monotonic() + 1
        name, value, good = next(self._changes)
        answer = self._parameters.set_parameters([Parameter(name, value=value)])
        if number % RESET_PERIOD_S == 0:
            self._reset.call_async(Trigger.Request())
        self._comings.turn(number)
        while monotonic() < end_s or (not answer.done() and monotonic() < end_s + STARTUP_S):
            self._imu.publish(self._gravity())
            self.host.serve(max(0., min(0.02, end_s - monotonic())))
            self._comings.serve()
        if not answer.done():
            self.failures.append(f'second {number}: no answer when {name} was set to {value!r}')
        elif answer.result().results[0].successful != good:
            self.failures.append(f"second {number}: {name} was {'refused' if good else 'set to'} "
                                 f'{value!r}')

    def _gravity(self) -> Imu:
        """Return what an accelerometer without a gyro says at rest."""
        msg = Imu(header=Header(stamp=self.host.node.get_clock().now().to_msg()))
        msg.linear_acceleration.z = GRAVITY_M_S2
        msg.angular_velocity_covariance[0] = NOT_MEASURED
        return msg

    def close(self) -> None:
        """Leave the node alone."""
        self._comings.close()
        self.host.leave()


def soak(recording: Path, seconds: int) -> tuple[Soak, int | None, int | None]:
    """Return the Soak of so many seconds, and the exit statuses of node and player."""
    transport = '--ros-args', '-p', 'image_transport:=compressed', '-r', f'__ns:=/{NAMESPACE}'
    with running('stabilizer', *transport) as node, \
            running('player', str(recording), '--loop', '--now', '--compressed', '--wait',
                    '--ros-args', '-r', f'__ns:=/{NAMESPACE}') as player:
        seen = Soak()
        try:
            seen.wait_for_frames()
            for number in tqdm(range(seconds), 'soak', unit=' s', disable=None):
                seen.second(number)
                for process, name in ((node, 'node'), (player, 'player')):
                    if process.poll() is not None:
                        raise RecordingError(f'the {name} ended with status {process.returncode} '
                                             f'in second {number}')
                seen.memory.append(memory_mb(node.pid))
        finally:
            seen.close()
    return seen, node.returncode, player.returncode


def fitted_line(memory_mb: Sequence[float]) -> tuple[float, float]:
    """Return where a line fitted through evenly spaced samples starts, and how much it rises."""
    rise, start = np.polyfit(np.linspace(0, 1, len(memory_mb)), memory_mb, 1)
    return float(start), float(rise)


def summary(seen: Soak, statuses: Sequence[int | None]) -> Figures:
    """Return the report of a Soak; no memory figures where it was too short for them."""
    stamps_s, frames = zip(*seen.beats)
    report = {
        'seconds': len(seen.memory), 'frames': frames[-1], 'heartbeats': len(frames),
        'longest_gap_s': float(np.max(np.diff(stamps_s), initial=0)),
        'beats_without_frames': int((np.diff(frames) == 0).sum()),
        'exit_status': dict(zip(('node', 'player'), statuses)), 'failures': seen.failures,
        'received': dict(seen.host.received), 'memory_mb_every_10_s': seen.memory[::10]}
    if len(seen.memory) >= MIN_MEMORY_S:
        report['memory_mb'], report['memory_growth_mb'] = fitted_line(
            [held_mb['private'] for held_mb in seen.memory[WARM_UP_S:]])
    return report


def failures(report: Figures) -> list[str]:
    """Return a line for each check that a report fails."""
    lines = list(report['failures'])
    if not report['longest_gap_s'] < MAX_GAP_S:
        lines.append(f"heartbeats were {report['longest_gap_s']:.2f} s apart")
    if report['beats_without_frames']:
        lines.append(f"{report['beats_without_frames']} heartbeats without a new frame")
    if report.get('memory_growth_mb', 0) > MAX_GROWTH * report.get('memory_mb', 0):
        lines.append(f"memory grew by {report['memory_growth_mb']:.1f} MB "
                     f"from {report['memory_mb']:.1f} MB")
    return lines + [f'{name} ended with status {status}'
                    for name, status in report['exit_status'].items() if status]


def arguments(argv: Sequence[str] | None) -> Namespace:
    """Return the parsed command line; exit 2 on a usage error."""
    parser = Parser(prog='soak', description=__doc__)
    parser.add_argument('recording', metavar='REC', type=Path, nargs='?',
                        default=Path('bags/drone'), help='what to play (default: %(default)s)')
    parser.add_argument('--seconds', metavar='S', type=whole_number(3), default=600,
                        help='for how long (default: %(default)s)')
    parser.add_argument('--json', metavar='FILE', type=file_argument, help='write a report')
    args = parser.parse_args(argv)
    if not args.recording.exists():
        parser.error(f'{args.recording} does not exist')
    return args


def command(args: Namespace) -> bool:
    """Do what the command line says; RecordingError where a check fails."""
    try:
        seen, *statuses = soak(args.recording, args.seconds)
    except ExternalShutdownException:
        raise KeyboardInterrupt from None
    report = summary(seen, statuses)
    lines = failures(report)
    if args.json:
        write_json(args.json, {**report, 'failed': lines})
    for line in lines:
        print(f'soak: {line}', file=sys.stderr)
    memory = (f"{report['memory_mb']:.0f} MB {report['memory_growth_mb']:+.1f} MB"
              if 'memory_mb' in report else 'not judged in so short a time')
    print(f"{report['seconds']} s, {report['frames']} frames, {report['heartbeats']} heartbeats "
          f"at most {report['longest_gap_s']:.2f} s apart, memory {memory}: "
          f"{'failed' if lines else 'passed'}")
    return bool(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    args = arguments(argv)
    failed: list[bool] = []
    return run('soak', lambda: failed.append(command(args))) or int(failed[0])


if __name__ == '__main__':
    sys.exit(main())
