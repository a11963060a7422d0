# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Measure the operator's page: from publishing the camera's picture to its pixels in the browser.

Pictures of a recording, enlarged, are published with their number painted into the middle as
black and white blocks; a headless Chromium shows the page, and a script in it reads the blocks off
the canvas as soon as they are drawn. What the display needs to show the canvas is not included.
The page shows the raw picture, whose middle stays in the middle; it takes the same way.
"""

from argparse import ArgumentParser
from contextlib import nullcontext
from itertools import chain, cycle, islice
import os
from pathlib import Path
import shutil
import socket
import sys
import tempfile
import time

import cv2
import numpy as np
import rclpy
from rclpy.qos import QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import CompressedImage, Image
from sph_stab_ros.benchmark.machine import machine
from sph_stab_ros.command_line.processes import cpu_s, running
from sph_stab_ros.images.codec import fill_compressed, fill_image
from sph_stab_ros.recording import decoded_frames, open_recording
from sph_stab_ros.recording.partial_output import add_to_json

sys.path.append(str(Path(__file__).resolve().parents[1] / 'test/support'))
from bad_link import BadLink, why_not  # noqa: E402, I100
from operator_browser import Browser, free_port, SIZE_WH, wait_until  # noqa: E402

NAMESPACE = 'benchmark'
PICTURES = 60
WARM_UP_S = 3.
# Bits of the number, and the same bits inverted, to tell a number from anything else.
BITS = 8
BLOCK_RAD = 2 * np.pi / 160
FOV_RAD = np.deg2rad(100)
PERCENTILES = (50, 95, 99)
KEY = 'operator_page'
TOKEN = 'sesame'
SAMPLES_PER_S = 2
# The attribute is set by whoever has just drawn; observers are called before the canvas goes to
# the display.
PROBE = """columns => {
    const place = document.getElementById('picture'), canvas = place.querySelector('canvas');
    const flat = canvas.getContext('2d'), gl = canvas.getContext('webgl2');
    window.drawn = [];
    window.mbit_s = [];
    setInterval(() => window.mbit_s.push(parseFloat(
        document.querySelector('[data-figure=mbit_s]').textContent)), 500);
    new MutationObserver(() => {
        const {width, height} = canvas;
        const row = flat ? flat.getImageData(0, height >> 1, width, 1).data
            : new Uint8Array(4 * width);
        gl?.readPixels(0, height >> 1, width, 1, gl.RGBA, gl.UNSIGNED_BYTE, row);
        const time_ms = performance.timeOrigin + performance.now();
        const seen = columns.map(x => row[4 * Math.round(x * width / innerWidth) + 1] > 128);
        window.drawn.push([time_ms, place.dataset.stampNs, seen.map(Number)]);
    }).observe(place, {attributeFilter: ['data-stamp-ns']});
}"""


def numbered(image, number):
    """Return a copy of a sphere (H, W, 3) with the blocks of a number in its middle."""
    height, width = image.shape[:2]
    block_px = round(BLOCK_RAD * width / (2 * np.pi))
    bits = [number >> bit & 1 for bit in range(BITS)]
    blocks = np.array([*bits, *(1 - bit for bit in bits)], np.uint8) * 255
    pattern = np.kron(blocks, np.ones((3 * block_px, block_px), np.uint8))[..., None]
    image = image.copy()
    top, left = height // 2 - pattern.shape[0] // 2, width // 2 - pattern.shape[1] // 2
    image[top:top + pattern.shape[0], left:left + pattern.shape[1]] = pattern
    return image


def columns_px():
    """Return where the page shows the middles of the blocks, in columns of the window."""
    lon = BLOCK_RAD * (np.arange(2 * BITS) - BITS + 0.5)
    focal_px = SIZE_WH[0] / 2 / np.tan(FOV_RAD / 2)
    return np.rint((SIZE_WH[0] - 1) / 2 + focal_px * np.tan(lon)).astype(int).tolist()


def number_of(bits):
    """Return the number that blocks show, or None."""
    if any(a == b for a, b in zip(bits[:BITS], bits[BITS:])):
        return None
    return sum(bit << n for n, bit in enumerate(bits[:BITS]))


def messages(args):
    """Return messages of as many pictures as there are numbers, played there and back."""
    pictures = [cv2.resize(frame.image, (args.width, args.width // 2))
                for frame in islice(decoded_frames(open_recording(args.recording)), PICTURES)]
    there_and_back = cycle(chain(pictures, pictures[-2:0:-1]))
    compressed = args.transport == 'compressed'
    return [fill_compressed(CompressedImage(), numbered(image, number)) if compressed
            else fill_image(Image(), numbered(image, number))
            for number, image in enumerate(islice(there_and_back, 2 ** BITS))]


def publish(args, node, publisher, msgs):
    """Publish all pictures, each when it is due; return {stamp in ns: number}."""
    sent = {}
    start_s = time.monotonic()
    for n in range(round(WARM_UP_S * args.rate) + args.frames):
        time.sleep(max(0, start_s + n / args.rate - time.monotonic()))
        number = n % 2 ** BITS
        stamp_ns = time.time_ns()
        msgs[number].header.stamp = Time(nanoseconds=stamp_ns).to_msg()
        msgs[number].header.frame_id = 'camera'
        publisher.publish(msgs[number])
        sent[stamp_ns] = number
    return sent


def figures(args, sent, drawn, mbit_s, cpu_percent):
    """Return what became of the pictures after the warm-up."""
    counted = dict(islice(sent.items(), round(WARM_UP_S * args.rate), None))
    # Date's clock and the page's are the same machine's.
    latencies_ms, wrong = {}, 0
    for time_ms, stamp_ns, bits in drawn:
        stamp_ns = int(stamp_ns)
        if stamp_ns in counted:
            wrong += number_of(bits) != counted[stamp_ns]
            latencies_ms.setdefault(stamp_ns, time_ms - stamp_ns / 1e6)
    values = list(latencies_ms.values())
    return {
        'machine': machine(), 'pictures': args.pictures, 'transport': args.transport,
        'width': args.width, 'rate_hz': args.rate, 'frames': len(counted), 'drawn': len(values),
        'wrong_numbers': wrong, 'cpu_percent': cpu_percent,
        'video': args.video, 'link': args.link, 'mbit_s': float(np.mean(mbit_s)),
        'latency_ms': {f'p{q}': float(np.percentile(values, q)) for q in PERCENTILES if values}}


def measure(args, chromium):
    """Return the figures; ``chromium`` is the browser's path."""
    with BadLink(*args.link) if args.link else nullcontext() as link, \
            tempfile.NamedTemporaryFile('w', suffix='.token') as token_file:
        token_file.write(TOKEN)
        token_file.flush()
        return measure_over(link, token_file.name, args, chromium)


def measure_over(link, token_file, args, chromium):
    """Return the figures over a BadLink, or without one."""
    msgs = messages(args)
    ros = ('--ros-args', '-r', f'__ns:=/{NAMESPACE}')
    host, port = link.near if link else '127.0.0.1', free_port()
    rclpy.init()
    node = rclpy.create_node('camera', namespace=NAMESPACE)
    publisher = node.create_publisher(
        CompressedImage if args.transport == 'compressed' else Image,
        'image/compressed' if args.transport == 'compressed' else 'image', QoSProfile(depth=5))
    transport = '-p', f'image_transport:={args.transport}'
    page_arguments = ('--host', host, '--port', str(port), '--token-file', token_file,
                      '--pictures', args.pictures)
    with running('stabilizer', *ros, *transport) as stabilizer, \
            running('operator', *page_arguments, *ros) as server, \
            Browser(chromium, link) as browser:
        wait_until(lambda: socket.socket().connect_ex((host, port)) == 0)
        with browser.page() as page:
            page.goto(f"http{'s' if link else ''}://{host}:{port}/?token={TOKEN}"
                      + ('&video=jpeg' if args.video == 'jpeg' else ''))
            wanted = 2 if args.pictures == 'camera' else 1
            wait_until(lambda: publisher.get_subscription_count() >= wanted)
            # The first picture, for the page to be ready.
            wait_until(lambda: publish_one(publisher, msgs[0]) or page.evaluate(
                'document.documentElement.dataset.situation === "stabilized"'))
            page.keyboard.press('b')
            page.evaluate(PROBE, columns_px())
        before_s = [time.monotonic(), *map(cpu_s, (stabilizer.pid, server.pid))]
        sent = publish(args, node, publisher, msgs)
        spent_s = np.subtract([time.monotonic(), *map(cpu_s, (stabilizer.pid, server.pid))],
                              before_s)
        with browser.page() as page:
            mbit_s = page.evaluate('window.mbit_s')[round(SAMPLES_PER_S * WARM_UP_S):]
            time.sleep(2)
            drawn = page.evaluate('window.drawn')
    rclpy.try_shutdown()
    percent = 100 * spent_s[1:] / spent_s[0]
    return figures(args, sent, drawn, mbit_s,
                   dict(zip(('stabilizer', 'operator'), percent.tolist())))


def publish_one(publisher, msg):
    """Publish a picture."""
    msg.header.stamp = Time(nanoseconds=time.time_ns()).to_msg()
    publisher.publish(msg)
    time.sleep(0.1)


def main():
    """Run the command line."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument('recording', metavar='REC', type=Path, nargs='?',
                        default=Path('bags/drone'),
                        help='where the pictures come from (default: %(default)s)')
    parser.add_argument('--pictures', choices=('camera', 'stabilizer'), default='camera',
                        help='whose pictures the page shows (default: %(default)s)')
    parser.add_argument('--transport', choices=('compressed', 'raw'), default='compressed',
                        help='how the camera publishes (default: %(default)s)')
    parser.add_argument('--width', metavar='PX', type=int, default=1920,
                        help='width of the pictures (default: %(default)s)')
    parser.add_argument('--rate', metavar='HZ', type=float, default=30.,
                        help='pictures per second (default: %(default)s)')
    parser.add_argument('--frames', metavar='N', type=int, default=300,
                        help='pictures that count (default: %(default)s)')
    parser.add_argument('--video', choices=('h264', 'jpeg'), default='h264',
                        help='what the page asks for (default: %(default)s)')
    parser.add_argument('--link', metavar='X', nargs=3, type=float,
                        help='over a bad link: Mbit/s, seconds of round trip, share of packets '
                             'that get lost (6 0.04 0.01); takes root')
    parser.add_argument('--add-to', metavar='FILE', type=Path,
                        help=f"add all figures to those in a JSON file, as '{KEY}', or "
                             f"'{KEY}_link' with --link")
    parser.add_argument('--key', metavar='NAME', help=f"add them as '{KEY}_NAME' instead")
    args = parser.parse_args()
    chromium = shutil.which(os.environ.get('CHROMIUM') or 'chromium')
    if not chromium:
        sys.exit('operator_latency: there is no chromium; name one with CHROMIUM=...')
    if args.link and why_not():
        sys.exit(f'operator_latency: no bad link here: {why_not()}')
    result = measure(args, chromium)
    latency = ', '.join(f'{name} {value:.0f}' for name, value in result['latency_ms'].items())
    cpu = ', '.join(f'{name} {value:.0f}' for name, value in result['cpu_percent'].items())
    over = ' over {:g} Mbit/s, {:g} s, loss {:g}'.format(*args.link) if args.link else ''
    print(f"operator's page, {args.pictures}, {args.transport}, {args.width} columns at "
          f"{args.rate:g} Hz, {args.video}{over}: {result['mbit_s']:.1f} Mbit/s, "
          f"{result['drawn']}/{result['frames']} drawn, "
          f"{result['wrong_numbers']} with a wrong number; latency ms {latency}; CPU % {cpu}; "
          f"load before {result['machine']['load_before']:.1f}")
    if args.add_to:
        name = args.key or ('link' if args.link else '')
        key = f'{KEY}_{name}' if name else KEY
        add_to_json(args.add_to, **{key: result})


if __name__ == '__main__':
    main()
