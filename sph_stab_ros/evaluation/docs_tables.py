# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""
Write tables of what was measured into the pages that show them.

A page marks a table's place, what it tells and of which results::

    <!-- errors drone -->
    …
    <!-- end -->

``FOLDER/drone.json`` is what ``evaluate --json`` wrote, or a benchmark, or ``coverage json``.
Tables whose results are not there, or tell nothing of it, stay as they are. Times differ from run
to run and have tables of their own.
"""

from collections.abc import Iterable, Sequence
import json
from pathlib import Path
import re
import sys

from sph_stab_ros.command_line import Parser, run
from sph_stab_ros.evaluation import accuracy_tables, benchmark_tables
from sph_stab_ros.evaluation.accuracy_tables import Row, Table
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.recording.partial_output import partial_output

BLOCK = re.compile(r'(<!-- (\w+)((?: [\w/-]+)+) -->\n).*?(<!-- end -->)', re.DOTALL)
TABLES: dict[str, Table] = {**accuracy_tables.TABLES, **benchmark_tables.TABLES}


def filled(page: str, folder: Path) -> str:
    """Return a page with the tables of a folder's results in their places."""
    def block(match: re.Match[str]) -> str:
        start, kind, names, end = match.groups()
        files = [folder / f'{name}.json' for name in names.split()]
        if kind not in TABLES:
            raise RecordingError(f"there is no table '{kind}', but {', '.join(TABLES)}")
        if not all(file.exists() for file in files):
            return match.group()
        results = [json.loads(file.read_text()) for file in files]
        head, *body = TABLES[kind](results)
        return start + markdown(head, body) + end if body else match.group()
    return BLOCK.sub(block, page)


def markdown(head: Row, body: Iterable[Row]) -> str:
    """Return a Markdown table of rows of cells."""
    lines = [head, ['---'] * len(head), *body]
    return '\n' + ''.join(f'| {" | ".join(cells)} |\n' for cells in lines) + '\n'


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = Parser(prog='python3 -m sph_stab_ros.evaluation.docs_tables',
                    description='Write tables of what was measured into the pages that show them.')
    parser.add_argument('folder', metavar='FOLDER', type=Path, help='where the results are')
    parser.add_argument('pages', metavar='PAGE', type=Path, nargs='+', help='Markdown to fill in')
    args = parser.parse_args(argv)

    def command() -> None:
        for page in args.pages:
            try:
                text = filled(page.read_text(), args.folder)
            except OSError as error:
                raise RecordingError(f'{page} cannot be read: {error.strerror}') from error
            with partial_output(page, force=True) as partial:
                partial.write_text(text)

    return run('docs_tables', command)


if __name__ == '__main__':
    sys.exit(main())
