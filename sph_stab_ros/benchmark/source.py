# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Measure the node with a source: from the packet in the sender to the orientation on its topic.

Pictures of a recording, enlarged, are encoded as H.264 beforehand, as a camera's chip costs the
robot nothing, and sent by RTSP at their rate, from a process of its own; the node reads them by
its parameter ``source``. Latency is from when a picture's packet was given to the muxer to the
receipt of its orientation. Which picture that is tells the stamp, which is of the sender's clock
(RTCP).
"""

from argparse import Namespace
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from fractions import Fraction
from itertools import chain, cycle, islice
import multiprocessing
from pathlib import Path
import socket
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any, TYPE_CHECKING

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
from sph_stab_ros.recording.partial_output import add_to_json

if TYPE_CHECKING:
    import av

KEY = 'source'
PICTURES = 60
WARM_UP_S, SPARE_S = 3., 1.
VIEW_WH = 960, 540
LISTEN_S = 9
RTP_TICK_S = Fraction(1, 90_000)
ENCODER = {'preset': 'ultrafast', 'tune': 'zerolatency', 'threads': '1'}


def encode(args: Namespace, path: Path) -> None:
    """Write the pictures as a film, there and back again."""
    import av
    width, height = args.width, args.width // 2
    pictures = [
        av.VideoFrame.from_ndarray(
            cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_CUBIC),
            format='bgr24').reformat(format='yuv420p')
        for frame in islice(decoded_frames(open_recording(args.recording)), PICTURES)]
    rate = Fraction(args.rate).limit_denominator(1000)
    with av.open(path, 'w', format='mp4') as container:
        stream: Any = container.add_stream('libx264', rate=rate, options=ENCODER)
        stream.width, stream.height, stream.pix_fmt = width, height, 'yuv420p'
        stream.codec_context.gop_size = round(args.rate)
        for picture in chain(pictures, pictures[-2:0:-1]):
            picture.pts = None
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def send(args: Namespace, path: Path, url: str) -> tuple[list[int], float]:
    """
    Send the packets of a film, over and over, once somebody listens.

    Return when each was given to the muxer, and CPU percent.
    """
    import av
    with av.open(path) as film:
        video = film.streams.video[0]
        packets = [bytes(packet) for packet in film.demux(video) if packet.size]
        end_s = time.monotonic() + STARTUP_S
        while True:
            try:
                with av.open(url, 'w', format='rtsp',
                             options={'rtsp_transport': 'tcp'}) as container:
                    stream = container.add_stream_from_template(video)
                    # From here on the muxer counts its time.
                    container.start_encoding()
                    return send_packets(args, packets, container, stream)
            except av.ConnectionRefusedError:
                if time.monotonic() > end_s:
                    raise
                time.sleep(0.1)


def send_packets(
        args: Namespace, packets: Sequence[bytes], container: 'av.container.OutputContainer',
        stream: 'av.VideoStream') -> tuple[list[int], float]:
    """Send packets at their rate, and return as ``send`` does."""
    import av
    start_ns, used_s = time.time_ns(), time.process_time()
    taken_ns: list[int] = []
    for index, data in enumerate(islice(cycle(packets), sent_frames(args))):
        due_ns = start_ns + round(index / args.rate * NS_PER_S)
        time.sleep(max(due_ns - time.time_ns(), 0) / NS_PER_S)
        taken_ns.append(time.time_ns())
        packet = av.Packet(data)
        packet.stream, packet.time_base = stream, RTP_TICK_S
        # Not when it was due: a sender that is held up is not what is measured.
        packet.pts = packet.dts = round((taken_ns[-1] - start_ns) / NS_PER_S / RTP_TICK_S)
        container.mux(packet)
    wall_s = (time.time_ns() - start_ns) / NS_PER_S
    return taken_ns, 100 * (time.process_time() - used_s) / wall_s


def sent_frames(args: Namespace) -> int:
    """Return how many pictures are sent: those of warming up, those that count, and spare ones."""
    return round((WARM_UP_S + SPARE_S) * args.rate) + args.frames


def measure(args: Namespace) -> Figures:
    """Encode the pictures, send them, and return what became of them."""
    with (ProcessPoolExecutor(1, multiprocessing.get_context('spawn')) as pool,
          TemporaryDirectory() as folder):
        film = Path(folder) / 'film.mp4'
        pool.submit(encode, args, film).result()
        return measured(args, film, pool)


def measured(args: Namespace, film: Path, pool: ProcessPoolExecutor) -> Figures:
    """Return what became of the pictures of a film that a process of the pool sends."""
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

    with ros_node('subscriber') as node, running(
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
        sending = pool.submit(send, args, film, url)
        used_s: list[tuple[float, float]] = []
        while not sending.done():
            rclpy.spin_once(node, timeout_sec=0.1)
            if orientations:
                used_s.append((time.monotonic(), cpu_s(process.pid)))
        end_s = time.monotonic() + SILENCE_S
        while time.monotonic() < end_s:
            rclpy.spin_once(node, timeout_sec=0.1)
        taken_ns, sender_percent = sending.result()
    if said.get('source_stamps') != SENDER:
        # From PyAV 17 on they are, unless one of them is two seconds behind.
        raise RecordingError("the stamps are not of the sender's clock: no picture is recognised")
    result = figures(args, taken_ns, orientations, views)
    if len(used_s) > 1:
        wall_s, node_s = np.subtract(used_s[-1], used_s[0])
        result['cpu_percent'] = {'node': 100 * node_s / wall_s, 'sender': sender_percent}
    return {**result, 'diagnostics': said}


def figures(args: Namespace, taken_ns: Sequence[int], orientations: dict[int, int],
            views: dict[int, int]) -> Figures:
    """Return what became of those pictures that count, given when they were taken."""
    first = round(WARM_UP_S * args.rate)
    result: Figures = {'width': args.width, 'rate_hz': args.rate, 'frames': args.frames}
    for name, received_ns in ('orientations', orientations), ('views', views):
        latency_ms = {}
        for stamp, received in received_ns.items():
            index = int(np.argmin(np.abs(np.subtract(taken_ns, stamp))))
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
                        help=f"add all figures to those in a JSON file, as '{KEY}_PX', or "
                             f"'{KEY}_PX_view' with --view")
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
        key = f'{KEY}_{args.width}' + ('_view' if args.view else '')
        add_to_json(args.add_to, **{key: result})


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    args = arguments(argv)
    return run('benchmark_source', lambda: benchmark(args))


if __name__ == '__main__':
    sys.exit(main())
