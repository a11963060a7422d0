# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Measure the node end to end: player, node and subscriber, each a process of its own.

The player sends pictures of a recording, enlarged, from memory: reading and decoding them is not
what is measured, and no camera does it either. Latency is from the time at which a picture was
due, its stamp, to the receipt of what became of it. Pictures count once all have found each other,
and after a second of warming up.
"""

from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
import json
import multiprocessing
import os
from pathlib import Path
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from sph_stab_ros.benchmark.machine import machine, MAX_WIDTH
from sph_stab_ros.benchmark.node_scenario import (
    MemoryRecording, ORIENTATION, OUTPUTS, Scenario, WIDTH)
from sph_stab_ros.command_line import Parser, run
from sph_stab_ros.command_line.arguments import file_argument, whole_number
from sph_stab_ros.command_line.process_setup import set_up_process
from sph_stab_ros.command_line.processes import cpu_s, running
from sph_stab_ros.config import MIN_WIDTH
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.geometry.conventions import stamp_ns
from sph_stab_ros.player import Player
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.recording.partial_output import add_to_json, write_json

PROFILE_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
NAMESPACE = 'benchmark'
STARTUP_S = 30.
SILENCE_S = 2.
PERCENTILES = (50, 95, 99)


@dataclass
class Heard:
    """What a subscriber received: time of receipt in ns by stamp; CPU in percent by process."""

    orientations: dict[int, int] = field(default_factory=dict)
    images: dict[int, int] = field(default_factory=dict)
    diagnostics: dict[str, str] = field(default_factory=dict)
    cpu_percent: dict[str, float] = field(default_factory=dict)


@contextmanager
def ros_node(name: str) -> Iterator[Node]:
    """Give a rclpy node in the benchmark's namespace."""
    set_up_process()
    rclpy.init(args=[])
    try:
        yield rclpy.create_node(name, namespace=NAMESPACE)
    finally:
        rclpy.try_shutdown()


def play(scenario: Scenario) -> tuple[int, float]:
    """Send the pictures once all are there; return the first one's time in ns and CPU percent."""
    recording = MemoryRecording(scenario)
    with ros_node('player') as node:
        player = Player(node, recording)
        end_s = time.monotonic() + STARTUP_S
        while not all(map(node.count_subscribers, filter(None, (
                scenario.topic('image'), ORIENTATION, scenario.image_topic)))):
            if time.monotonic() > end_s:
                raise RecordingError('node and subscriber did not find each other')
            time.sleep(0.05)
        player.wait_for_subscriber()
        wall_s, used_s = time.monotonic(), time.process_time()
        player.play()
        percent = 100 * (time.process_time() - used_s) / (time.monotonic() - wall_s)
    return recording.start_ns, percent


def listen(scenario: Scenario, node_pid: int) -> Heard:
    """Return what is Heard until it is silent."""
    heard = Heard()
    # Time and CPU seconds of the node and of this process, at each message.
    used_s: list[tuple[float, float, float]] = []

    def takes_down(received_ns: dict[int, int]) -> Callable[[Any], None]:
        def take_down(msg: Any) -> None:
            received_ns[stamp_ns(msg.header.stamp)] = time.time_ns()
            used_s.append((time.monotonic(), cpu_s(node_pid), time.process_time()))
        return take_down

    def on_diagnostics(msg: DiagnosticArray) -> None:
        for status in msg.status:
            if status.name.startswith(f'/{NAMESPACE}/'):
                heard.diagnostics = {pair.key: pair.value for pair in status.values}

    with ros_node('subscriber') as node:
        node.create_subscription(QuaternionStamped, ORIENTATION,
                                 takes_down(heard.orientations), QoSProfile(depth=100))
        if scenario.image_topic:
            node.create_subscription(
                scenario.image_type, scenario.image_topic, takes_down(heard.images),
                qos_profile_sensor_data)
        node.create_subscription(DiagnosticArray, '/diagnostics', on_diagnostics, 10)
        silent_s = time.monotonic() + STARTUP_S
        while time.monotonic() < silent_s:
            rclpy.spin_once(node, timeout_sec=0.1)
            if used_s:
                silent_s = used_s[-1][0] + SILENCE_S
    if len(used_s) > 1:
        wall_s, node_s, own_s = np.subtract(used_s[-1], used_s[0])
        heard.cpu_percent = {'node': 100 * node_s / wall_s, 'subscriber': 100 * own_s / wall_s}
    return heard


def measure(scenario: Scenario) -> Figures:
    """Return the figures of a scenario."""
    # All processes started from here inherit it.
    os.environ.pop(PROFILE_VARIABLE, None)
    if scenario.profile:
        os.environ[PROFILE_VARIABLE] = scenario.profile
    pool = ProcessPoolExecutor(2, multiprocessing.get_context('spawn'))
    with pool, running('stabilizer', '--ros-args', '-r', f'__ns:=/{NAMESPACE}',
                       '-p', f'image_transport:={scenario.transport}') as node:
        hearing = pool.submit(listen, scenario, node.pid)
        playing = pool.submit(play, scenario)
        start_ns, player_percent = playing.result()
        heard = hearing.result()
        if node.poll() is not None:
            raise RecordingError(f'{scenario.name}: the node has ended with {node.returncode}')
    heard.cpu_percent['player'] = player_percent
    return figures(scenario, scenario.stamps_ns(start_ns), heard)


def figures(scenario: Scenario, sent_ns: Sequence[int], heard: Heard) -> Figures:
    """Return what became of the pictures sent with these stamps."""
    stamps_ns = counted(scenario, sent_ns, heard)
    orientation_ms, image_ms = (
        [(received_ns[due_ns] - due_ns) / 1e6 for due_ns in stamps_ns if due_ns in received_ns]
        for received_ns in (heard.orientations, heard.images))
    said = {name: int(heard.diagnostics[name])
            for name in ('frames', 'dropped', 'not_drawn', 'refused')}
    return {'frames': len(stamps_ns), 'orientations': len(orientation_ms),
            'images': len(image_ms), 'latency_ms': percentiles(image_ms),
            'orientation_latency_ms': percentiles(orientation_ms),
            'cpu_percent': heard.cpu_percent, 'drops': said['dropped'],
            # Of all that were sent.
            'lost': {
                'before_counting': sent_ns.index(stamps_ns[0]) if stamps_ns else len(sent_ns),
                'player_to_node': len(sent_ns) - said['frames'] - said['dropped']
                - said['refused'],
                'dropped_by_node': said['dropped'], 'not_drawn_by_node': said['not_drawn'],
                'orientations_to_subscriber': said['frames'] - len(heard.orientations),
                'images_to_subscriber': (said['frames'] - said['not_drawn'] - len(heard.images)
                                         if scenario.image_topic else 0)},
            'diagnostics': heard.diagnostics}


def counted(scenario: Scenario, sent_ns: Sequence[int], heard: Heard) -> Sequence[int]:
    """Return the stamps of the pictures that count, from the first one that went all the way."""
    images = heard.images if scenario.image_topic else heard.orientations
    whole_way = (n for n, due_ns in enumerate(sent_ns)
                 if due_ns in heard.orientations and due_ns in images)
    first = next(whole_way, len(sent_ns)) + scenario.warm_up_frames
    # Pictures at the end are all that is left where discovery took too long.
    return sent_ns[min(first, len(sent_ns) - scenario.frames):][:scenario.frames]


def percentiles(values: Sequence[float]) -> dict[str, float]:
    """Return the PERCENTILES of some values by name, {} of none."""
    return {f'p{q}': float(np.percentile(values, q)) for q in PERCENTILES if values}


def scenarios(args: Namespace) -> list[Scenario]:
    """Return the scenarios to measure, the one of the headline first."""
    profiles = [str(args.profile.resolve())] if args.profile else []
    if not (args.profile and args.add_to):
        profiles.append('')
    return [Scenario(args.recording, args.width, args.rate, args.frames, args.output, transport,
                     profile)
            for transport in args.transports.split(',') for profile in profiles]


def table(results: Mapping[str, Figures]) -> Iterator[str]:
    """Yield the lines of a table of figures by scenario."""
    wide = max(map(len, results)) + 2
    yield (' ' * wide + 'orientations   images   latency ms p50   p95   p99'
           '   CPU % player  node  subscriber   lost on the way in, dropped, on the way out')
    for name, result in results.items():
        p50, p95, p99 = (result['latency_ms'].get(f'p{q}', np.nan) for q in PERCENTILES)
        cpu = [result['cpu_percent'].get(who, np.nan) for who in ('player', 'node', 'subscriber')]
        frames, lost = result['frames'], result['lost']
        yield (f'{name:<{wide}}{result["orientations"]:8}/{frames}{result["images"]:5}/'
               f'{frames}{p50:17.0f}{p95:6.0f}{p99:6.0f}{cpu[0]:15.0f}{cpu[1]:6.0f}'
               f'{cpu[2]:12.0f}{lost["player_to_node"]:21}{lost["dropped_by_node"]:9}'
               f'{lost["images_to_subscriber"]:16}')


def arguments(argv: Sequence[str] | None) -> Namespace:
    """Return the parsed command line; exit 2 on a usage error."""
    parser = Parser(prog='benchmark_ros', description=__doc__)
    parser.add_argument('recording', metavar='REC', type=Path, nargs='?',
                        default=Path('bags/drone'),
                        help='where the pictures come from (default: %(default)s)')
    parser.add_argument('--profile', metavar='FILE', type=Path,
                        help="a Fast DDS profile to measure with, beside Fast DDS's defaults")
    parser.add_argument('--transports', metavar='T,...', default='raw,compressed',
                        choices=('raw', 'compressed', 'raw,compressed'),
                        help='how pictures travel, in and out (default: %(default)s)')
    parser.add_argument('--output', default='stabilized/image',
                        choices=tuple(OUTPUTS),
                        help='which output is subscribed to; orientation always, or alone '
                             '(default: %(default)s)')
    parser.add_argument('--width', metavar='PX', type=int, default=WIDTH,
                        help='width of the pictures (default: %(default)s)')
    parser.add_argument('--rate', metavar='HZ', type=float, default=30.,
                        help='pictures per second (default: %(default)s)')
    parser.add_argument('--frames', metavar='N', type=whole_number(1), default=300,
                        help='pictures that count (default: %(default)s)')
    written = parser.add_mutually_exclusive_group()
    written.add_argument('--json', metavar='FILE', type=file_argument, help='write all figures')
    written.add_argument('--add-to', metavar='FILE', type=Path,
                         help='add the scenarios to those in a JSON file, with a profile that one '
                              'alone')
    args = parser.parse_args(argv)
    if args.profile and not args.profile.is_file():
        parser.error(f'there is no file {args.profile}')
    if args.add_to and not args.add_to.is_file():
        parser.error(f'there is no file {args.add_to}')
    if not args.rate > 0:
        parser.error('--rate must be positive')
    if args.width % 2 or not MIN_WIDTH <= args.width <= MAX_WIDTH:
        parser.error(f'--width must be even, between {MIN_WIDTH} and {MAX_WIDTH}')
    return args


def benchmark(args: Namespace) -> None:
    """Do what the command line says."""
    about = {'machine': machine(), 'recording': str(args.recording), 'width': args.width,
             'rate_hz': args.rate, 'output': args.output}
    results = {}
    for scenario in scenarios(args):
        results[scenario.name] = measure(scenario)
    load = about['machine']['load_before']
    print(f'{args.output}, {args.width} columns at {args.rate:g} Hz; load before {load:.1f}')
    print('\n'.join(table(results)))
    if args.json:
        # The first scenario's figures stand for the whole.
        headline = next(iter(results.values()))
        write_json(args.json, {**about, **headline, 'scenarios': results})
    if args.add_to:
        known = json.loads(args.add_to.read_text())['scenarios']
        add_to_json(args.add_to, scenarios={**known, **results})


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    args = arguments(argv)
    return run('benchmark_ros', lambda: benchmark(args))


if __name__ == '__main__':
    sys.exit(main())
