# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Measure what an hour of footage costs ``batch``, and what tracking in segments does to it.

A recording as it is, and its first pictures enlarged to H.264 videos, are given to ``batch`` one
after the other. What the manifests say of CPU time and memory, and what lies on the disk, is
scaled up to an hour at 30 pictures a second, the start of the process included.
"""

from argparse import Namespace
from collections.abc import Iterator, Sequence
from itertools import islice
import json
from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory

import cv2
from sph_stab_ros.benchmark.machine import machine
from sph_stab_ros.command_line import Parser, run
from sph_stab_ros.command_line.arguments import file_argument, whole_number
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.recording import decoded_frames, open_recording, RecordingError
from sph_stab_ros.recording.partial_output import write_json
from sph_stab_ros.recording.video_writer import VideoWriter

HOUR_FRAMES = 3600 * 30
# By width how many pictures: longer ones would take as long as the machine is slow.
ENLARGED = {1920: 150, 3840: 90}
# Seconds, of a recording at least half as long again.
SPLIT_S = 10


def enlarged(recording: Path, path: Path, width: int, frames: int) -> Path:
    """Write the first pictures of a recording as an H.264 video of a width; return its path."""
    with VideoWriter(path, spheres=True) as writer:
        for frame in islice(decoded_frames(open_recording(recording)), frames):
            writer.write(cv2.resize(frame.image, (width, width // 2),
                                    interpolation=cv2.INTER_CUBIC), frame.stamp_ns)
    return path


def batch(recording: Path, out: Path, *options: str) -> Path:
    """Have ``batch`` do a recording; return the folder of its result."""
    done = subprocess.run(
        [sys.executable, '-m', 'sph_stab_ros.batch', str(recording), '--out', str(out),
         '--jobs', '1', *options], capture_output=True, text=True)
    results = [path.parent for path in out.glob('*/manifest.json')]
    if done.returncode or len(results) != 1:
        raise RecordingError(f'batch has ended with {done.returncode}: {done.stderr.strip()}')
    return results[0]


def hour(recording: Path, writes: str, kind: str, folder: Path) -> Figures:
    """Return what an hour of pictures like a recording's costs."""
    with TemporaryDirectory(dir=folder) as out:
        result = batch(recording, Path(out), '--write', writes)
        manifest = json.loads((result / 'manifest.json').read_text())
        written = size(result)
    scale = HOUR_FRAMES / manifest['frames']
    first = next(decoded_frames(open_recording(recording)))
    return {'width': first.image.shape[1], 'kind': kind, 'writes': writes,
            'frames': manifest['frames'], 'cpu_s': scale * manifest['cost']['cpu_s'],
            'peak_rss_mb': manifest['cost']['peak_rss_mb'],
            'read_bytes': round(scale * size(recording)), 'written_bytes': round(scale * written)}


def size(path: Path) -> int:
    """Return the bytes of a file, or of all files in a folder."""
    files = path.rglob('*') if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def hours(recording: Path, folder: Path, frames: int | None) -> Iterator[Figures]:
    """Yield what an hour costs, by width and by what is written."""
    for writes in ('trajectory', 'bag', 'mp4'):
        yield hour(recording, writes, 'as it is', folder)
    for width, count in ENLARGED.items():
        video = enlarged(recording, folder / f'{width}.mp4', width, frames or count)
        for writes in ('trajectory', 'mp4'):
            yield hour(video, writes, 'H.264', folder)


def split(recording: Path, folder: Path) -> Figures:
    """Return the errors of one run and of one in segments, and the CPU time of each task."""
    figures = {}
    for name, options in (('one run', ()), ('in segments', ('--split', str(SPLIT_S)))):
        with TemporaryDirectory(dir=folder) as out:
            result = batch(recording, Path(out), '--write', 'trajectory', '--evaluate', *options)
            manifest = json.loads((result / 'manifest.json').read_text())
            errors = json.loads((result / 'evaluation.json').read_text())
        if 'geodesic_deg' not in errors:
            raise RecordingError(f'{recording} has no truth to compare with')
        figures[name] = {
            'cpu_s': [cost['cpu_s'] for cost in (*manifest.get('segments', ()), manifest['cost'])],
            **{key: errors[key] for key in ('geodesic_deg', 'per_frame_deg')}}
    return figures


def arguments(argv: Sequence[str] | None) -> Namespace:
    """Return the parsed command line; exit 2 on a usage error."""
    parser = Parser(prog='benchmark_batch', description=__doc__)
    parser.add_argument('recording', metavar='REC', type=Path, nargs='?',
                        default=Path('bags/drone'),
                        help='where the pictures come from (default: %(default)s)')
    parser.add_argument('--frames', metavar='N', type=whole_number(2),
                        help='pictures of the videos (default: '
                        f'{", ".join(f"{n} of {width}" for width, n in ENLARGED.items())})')
    parser.add_argument('--json', metavar='FILE', type=file_argument, help='write all figures')
    return parser.parse_args(argv)


def benchmark(args: Namespace) -> None:
    """Do what the command line says."""
    figures: Figures = {'machine': machine(), 'recording': str(args.recording)}
    with TemporaryDirectory() as folder:
        figures['hour'] = []
        for one in hours(args.recording, Path(folder), args.frames):
            figures['hour'].append(one)
            print(f'{one["width"]} columns ({one["kind"]}), {one["writes"]}: an hour takes '
                  f'{one["cpu_s"] / 3600:.2f} core hours, {one["peak_rss_mb"]:.0f} MB', flush=True)
        figures['split'] = split(args.recording, Path(folder))
    for name, one in figures['split'].items():
        print(f'{name}: {sum(one["cpu_s"]):.1f} s of CPU, {one["geodesic_deg"]["mean"]:.3f}°')
    if args.json:
        write_json(args.json, figures)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    args = arguments(argv)
    return run('benchmark_batch', lambda: benchmark(args))


if __name__ == '__main__':
    sys.exit(main())
