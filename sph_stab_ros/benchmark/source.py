# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Measure the node with a source: from the picture in the sender to the orientation on its topic.

Pictures of a recording, enlarged, are encoded as H.264 and sent by RTSP at their rate, from a
process of its own; the node reads them by its parameter ``source``. Latency is from when a picture
was given to the encoder to the receipt of its orientation. Which picture that is tells the stamp,
which is of the sender's clock (RTCP).
"""

from argparse import Namespace
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from fractions import Fraction
from itertools import chain, cycle, islice
import json
import multiprocessing
from pathlib import Path
import socket
import sys
import time
from typing import Any

import cv2
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped
import numpy as np
import rclpy
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import CompressedImage
from sph_stab_ros.benchmark.machine import machine
from sph_stab_ros.benchmark.node import NAMESPACE, percentiles, ros_node, SILENCE_S, STARTUP_S
from sph_stab_ros.command_line import Parser, run
from sph_stab_ros.command_line.arguments import whole_number
from sph_stab_ros.command_line.processes import cpu_s, running
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.geometry.conventions import NS_PER_S, stamp_ns
from sph_stab_ros.live.capture_clock import SENDER
from sph_stab_ros.recording import decoded_frames, open_recording, RecordingError
from sph_stab_ros.recording.partial_output import partial_output

KEY = 'source'
PICTURES = 60
WARM_UP_S, SPARE_S = 3., 1.
VIEW_WH = 960, 540
LISTEN_S = 9
ENCODER = {'preset': 'ultrafast', 'tune': 'zerolatency', 'threads': '1'}


def send(args: Namespace, url: str) -> tuple[int, list[int], float]:
    """
    Send the pictures once somebody listens.

    Return when the muxer's time began, when each picture was taken, and CPU percent.
    """
    import av
    width, height = args.width, args.width // 2
    pictures = [
        av.VideoFrame.from_ndarray(
            cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_CUBIC),
            format='bgr24').reformat(format='yuv420p')
        for frame in islice(decoded_frames(open_recording(args.recording)), PICTURES)]
    rate = Fraction(args.rate).limit_denominator(1000)
    end_s = time.monotonic() + STARTUP_S
    while True:
        try:
            with av.open(url, 'w', format='rtsp', options={'rtsp_transport': 'tcp'}) as container:
                stream: Any = container.add_stream('libx264', rate=rate, options=ENCODER)
                stream.width, stream.height, stream.pix_fmt = width, height, 'yuv420p'
                stream.codec_context.gop_size = round(args.rate)
                stream.time_base = stream.codec_context.time_base = 1 / rate
                # From here on the muxer counts its time.
                container.start_encoding()
                start_ns, used_s = time.time_ns(), time.process_time()
                there_and_back = cycle(chain(pictures, pictures[-2:0:-1]))
                taken_ns: list[int] = []
                for index, picture in enumerate(islice(there_and_back, sent_frames(args))):
                    picture.pts = index
                    due_ns = start_ns + round(index / args.rate * NS_PER_S)
                    time.sleep(max(due_ns - time.time_ns(), 0) / NS_PER_S)
                    taken_ns.append(time.time_ns())
                    container.mux(stream.encode(picture))
                wall_s = (time.time_ns() - start_ns) / NS_PER_S
                return start_ns, taken_ns, 100 * (time.process_time() - used_s) / wall_s
        except av.ConnectionRefusedError:
            if time.monotonic() > end_s:
                raise
            time.sleep(0.1)


def sent_frames(args: Namespace) -> int:
    """Return how many pictures are sent: those of warming up, those that count, and spare ones."""
    return round((WARM_UP_S + SPARE_S) * args.rate) + args.frames


def measure(args: Namespace) -> Figures:
    """Return what became of the pictures."""
    with socket.create_server(('127.0.0.1', 0)) as one:
        url = f'rtsp://127.0.0.1:{one.getsockname()[1]}/sphere'
    # By the stamp when it was received.
    orientations: dict[int, int] = {}
    views: dict[int, int] = {}
    said: dict[str, str] = {}

    def takes_down(received_ns: dict[int, int]) -> Callable[[Any], None]:
        return lambda msg: received_ns.update({stamp_ns(msg.header.stamp): time.time_ns()})

    def on_diagnostics(msg: DiagnosticArray) -> None:
        for status in msg.status:
            if status.name.startswith(f'/{NAMESPACE}/'):
                said.update({pair.key: pair.value for pair in status.values})

    pool = ProcessPoolExecutor(1, multiprocessing.get_context('spawn'))
    with pool, ros_node('subscriber') as node, running(
            'stabilizer', '--ros-args', '-r', f'__ns:=/{NAMESPACE}', '-p', f'source:={url}',
            '-p', f'source_options:=listen_timeout={LISTEN_S}',
            '-p', f'view.width:={VIEW_WH[0]}', '-p', f'view.height:={VIEW_WH[1]}') as process:
        node.create_subscription(QuaternionStamped, 'orientation', takes_down(orientations),
                                 QoSProfile(depth=100))
        if args.view:
            node.create_subscription(CompressedImage, 'view/image/compressed', takes_down(views),
                                     qos_profile_sensor_data)
        node.create_subscription(DiagnosticArray, '/diagnostics', on_diagnostics, 10)
        while not said:
            rclpy.spin_once(node, timeout_sec=0.1)
        sending = pool.submit(send, args, url)
        used_s: list[tuple[float, float]] = []
        while not sending.done():
            rclpy.spin_once(node, timeout_sec=0.1)
            if orientations:
                used_s.append((time.monotonic(), cpu_s(process.pid)))
        end_s = time.monotonic() + SILENCE_S
        while time.monotonic() < end_s:
            rclpy.spin_once(node, timeout_sec=0.1)
        start_ns, taken_ns, sender_percent = sending.result()
    if said.get('source_stamps') != SENDER:
        # From PyAV 17 on they are, unless one of them is two seconds behind.
        raise RecordingError("the stamps are not of the sender's clock: no picture is recognised")
    result = figures(args, start_ns, taken_ns, orientations, views)
    if len(used_s) > 1:
        wall_s, node_s = np.subtract(used_s[-1], used_s[0])
        result['cpu_percent'] = {'node': 100 * node_s / wall_s, 'sender': sender_percent}
    return {**result, 'diagnostics': said}


def figures(args: Namespace, start_ns: int, taken_ns: Sequence[int],
            orientations: dict[int, int], views: dict[int, int]) -> Figures:
    """Return what became of those pictures that count, given when they were taken."""
    first = round(WARM_UP_S * args.rate)
    result: Figures = {'width': args.width, 'rate_hz': args.rate, 'frames': args.frames}
    for name, received_ns in ('orientations', orientations), ('views', views):
        latency_ms = {}
        for stamp, received in received_ns.items():
            index = round((stamp - start_ns) * args.rate / NS_PER_S)
            if first <= index < first + args.frames:
                latency_ms[index] = (received - taken_ns[index]) / 1e6
        result[name] = len(latency_ms)
        result[f'{name}_latency_ms'] = percentiles([*latency_ms.values()])
    return result


def arguments(argv: Sequence[str] | None) -> Namespace:
    """Return the parsed command line; exit 2 on a usage error."""
    parser = Parser(prog='benchmark_source', description=__doc__)
    parser.add_argument('recording', metavar='REC', type=Path, nargs='?',
                        default=Path('bags/drone'),
                        help='where the pictures come from (default: %(default)s)')
    parser.add_argument('--width', metavar='PX', type=int, default=1920)
    parser.add_argument('--rate', metavar='HZ', type=float, default=30.)
    parser.add_argument('--frames', metavar='N', type=whole_number(1), default=300,
                        help='pictures that count (default: %(default)s)')
    parser.add_argument('--view', action='store_true',
                        help='subscribe to the view of 960x540 too, as JPEG')
    parser.add_argument('--add-to', metavar='FILE', type=Path,
                        help=f"add all figures to those in a JSON file, as '{KEY}', or "
                             f"'{KEY}_view' with --view")
    args = parser.parse_args(argv)
    if not (args.rate > 0 and args.width > 0 and args.width % 4 == 0):
        parser.error('--rate is positive, --width a multiple of four')
    return args


def benchmark(args: Namespace) -> None:
    """Do what the command line says."""
    about = machine()
    result = {'machine': about, **measure(args)}
    print(f'source, H.264 by RTSP, {args.width} columns at {args.rate:g} Hz; load before '
          f'{about["load_before"]:.1f}')
    for name in ('orientations', 'views') if args.view else ('orientations',):
        latency = ', '.join(f'{which} {value:.0f}'
                            for which, value in result[f'{name}_latency_ms'].items())
        print(f'{name} {result[name]}/{args.frames}, latency in ms: {latency}')
    print('CPU in percent: ' + ', '.join(
        f'{who} {percent:.0f}' for who, percent in result.get('cpu_percent', {}).items()))
    if args.add_to:
        others = json.loads(args.add_to.read_text()) if args.add_to.exists() else {}
        key = f'{KEY}_view' if args.view else KEY
        with partial_output(args.add_to, force=True) as path:
            path.write_text(json.dumps({**others, key: result}, indent=2) + '\n')


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    args = arguments(argv)
    return run('benchmark_source', lambda: benchmark(args))


if __name__ == '__main__':
    sys.exit(main())
