# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Send numbered pictures as a camera does: ``live_sender.py URL FORMAT CODEC``, one after the other.

Run as a process of its own, which a test may kill as a camera is unplugged.
"""

from argparse import ArgumentParser
from contextlib import contextmanager
from fractions import Fraction
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import av
import cv2
from tiny_recordings import turning_spheres

RATE, KEY_PERIOD, BITS = 30, 10, 12
# In place of the first number: pictures are numbered, and sent, by the clock of all senders.
BY_CLOCK = -1
TICKS = 1000
CONNECTING_S = 20
OPTIONS = {'libx264': {'preset': 'ultrafast', 'tune': 'zerolatency'}}
PIX_FMT = {'mjpeg': 'yuvj420p'}


def paint(image, number):
    """Paint a number into the upper edge, a block for each bit."""
    block = image.shape[1] // BITS
    for bit in range(BITS):
        image[:block, bit * block:(bit + 1) * block] = 255 * (number >> bit & 1)


def painted_number(grey):
    """Return the number in a grey picture."""
    block = grey.shape[1] // BITS
    inner = slice(block // 4, 3 * block // 4)
    return sum(1 << bit for bit in range(BITS)
               if grey[inner, bit * block:(bit + 1) * block][:, inner].mean() > 128)


def send(url, form, codec, width, height, frames, first):
    """Send pictures at their rate, the first of which has this number."""
    spheres = turning_spheres(12, width)[0]
    with av.open(url, 'w', format=form, options={'flush_packets': '1'}) as container:
        stream = container.add_stream(codec, rate=RATE, options=OPTIONS.get(codec, {}))
        stream.width, stream.height = width, height
        stream.pix_fmt = PIX_FMT.get(codec, 'yuv420p')
        stream.codec_context.gop_size = KEY_PERIOD
        stream.time_base = stream.codec_context.time_base = Fraction(1, RATE * TICKS)
        late = 0
        if first == BY_CLOCK:
            # From here on the muxer's time counts.
            container.start_encoding()
            first, late = divmod(round(time.time() * RATE * TICKS), TICKS)
            first += 1
            late -= TICKS
        start_s = time.monotonic() - late / TICKS / RATE
        for index in range(frames):
            # There and back again.
            image = cv2.resize(spheres[min(index % 22, 22 - index % 22)], (width, height))
            paint(image, (first + index) % (1 << BITS))
            picture = av.VideoFrame.from_ndarray(image, format='bgr24').reformat(
                format=stream.pix_fmt)
            picture.pts = index * TICKS - late
            time.sleep(max(start_s + index / RATE - time.monotonic(), 0))
            container.mux(stream.encode(picture))
            if index == 0 and not late:
                # The clock that RTP tells of begins with its header: nothing is sent before that.
                start_s = time.monotonic()
        container.mux(stream.encode())


@contextmanager
def sending(url, form, codec='libx264', size_wh=(256, 128), frames=3000, first=0, **streams):
    """Send from a process that the end of the block kills; give it."""
    process = subprocess.Popen(
        [sys.executable, __file__, url, form, codec, *map(str, (*size_wh, frames, first))],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(
            [str(Path(__file__).parent), *sys.path])}, **streams)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        if process.stdout:
            process.stdout.close()


if __name__ == '__main__':
    parser = ArgumentParser()
    for name in 'url', 'form', 'codec':
        parser.add_argument(name)
    for name in 'width', 'height', 'frames', 'first':
        parser.add_argument(name, type=int)
    given = vars(parser.parse_args())
    end_s = time.monotonic() + CONNECTING_S
    while True:
        try:
            send(**given)
            break
        except av.ConnectionRefusedError as error:
            if time.monotonic() > end_s:
                sys.exit(str(error))
            time.sleep(0.1)
        except av.FFmpegError as error:
            # Nobody listens any more.
            sys.exit(str(error))
