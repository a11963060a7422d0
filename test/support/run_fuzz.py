# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Run the tests in ``test/fuzz`` over and over, each time with fresh seeds, until the time is over.

Inputs that fail stay behind in a folder: ``NAME-HASH.input`` with the traceback beside it, or
``NAME.hang.input`` and ``NAME.crash.input`` where the process did not live to tell. ``make fuzz``.
"""

from argparse import ArgumentParser
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from itertools import count, cycle
import os
from pathlib import Path
import resource
import secrets
import subprocess
import sys
from threading import Lock
import time

ROOT = Path(__file__).resolve().parents[2]
# The laws of stamps are stated on random sequences, too.
TESTS = [*sorted((ROOT / 'test' / 'fuzz').glob('test_fuzz_*.py')),
         ROOT / 'test' / 'images' / 'test_picture_clock.py']
# For so long an input may be tried.
HANG_S = 120.
# All that a process may map, libraries included.
ADDRESS_SPACE = 6 * 2**30


def limit_memory():
    """Let allocations fail where an input makes too much of them."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))


def run_once(test, seed, folder, end_s):
    """Run a file of tests with a seed; return its output where it fails, '' else, and examples."""
    own = folder / f'{test.stem}-{seed}'
    own.mkdir()
    environment = {**os.environ, 'FUZZ_FOLDER': str(own)}
    process = subprocess.Popen(
        [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', str(test),
         '--hypothesis-profile=fuzz', f'--hypothesis-seed={seed}'],
        cwd=ROOT, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        preexec_fn=limit_memory)
    how = 'crash'
    while True:
        try:
            output, _ = process.communicate(timeout=1)
            break
        except subprocess.TimeoutExpired:
            if time.monotonic() > end_s:
                how = 'end'
                process.kill()
            elif any(age_s > HANG_S for age_s in present(own).values()):
                how = 'hang'
                process.kill()
    counted = own / 'examples'
    examples = int(counted.read_text()) if counted.exists() else 0
    for one in present(own):
        # Unless the time was over, nobody has told of this one.
        one.rename(folder / f'{one.stem}.{how}.input') if how != 'end' else one.unlink()
    for one in own.glob('*-*'):
        one.rename(folder / one.name)
    counted.unlink(missing_ok=True)
    own.rmdir()
    return ('' if how == 'end' or process.returncode == 0 else output), examples


def present(folder):
    """Return for how many seconds inputs have been tried, by file; they come and go."""
    ages_s = {}
    for one in folder.glob('*.present'):
        try:
            ages_s[one] = time.time() - one.stat().st_mtime
        except FileNotFoundError:
            continue
    return ages_s


def main():
    """Run the command line."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=600.)
    parser.add_argument('--jobs', type=int, default=os.cpu_count())
    parser.add_argument('--folder', type=Path, default=ROOT / 'results' / 'fuzz')
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    end_s, lock, failures = time.monotonic() + args.seconds, Lock(), 0
    turns, totals, runs = zip(count(), cycle(TESTS)), dict.fromkeys(TESTS, 0), Counter()

    def work(_):
        nonlocal failures
        while time.monotonic() < end_s:
            with lock:
                _, test = next(turns)
            seed = secrets.randbelow(2**32)
            output, examples = run_once(test, seed, args.folder, end_s)
            with lock:
                totals[test] += examples
                runs[test] += 1
                if output:
                    failures += 1
                    print(f'{test.name} fails with --hypothesis-seed={seed}:\n{output[-3000:]}',
                          flush=True)

    with ThreadPoolExecutor(args.jobs) as workers:
        list(workers.map(work, range(args.jobs)))
    for test, examples in totals.items():
        # Laws that are not of files do not count theirs.
        print(f'{test.name}: {runs[test]} runs, {examples} examples counted')
    kept = sorted(one.name for one in args.folder.glob('*.input'))
    print(f'{failures} failures; inputs kept in {args.folder}: {", ".join(kept) or "none"}')
    return 1 if failures else 0


if __name__ == '__main__':
    sys.exit(main())
