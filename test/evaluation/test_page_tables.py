# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tables of results in the pages that show them."""

import json
from pathlib import Path

import pytest

from sph_stab_ros.evaluation.page_tables import BLOCK, filled, main, TABLES
from sph_stab_ros.recording import RecordingError

ROOT = Path(__file__).resolve().parents[2]


def figures(scale):
    return {
        'mean_abs_error_deg': {'roll': 1 * scale, 'pitch': 2 * scale, 'yaw': 3 * scale},
        'geodesic_deg': {'mean': 4 * scale, 'max': 5 * scale, 'end': 6 * scale},
        'per_frame_deg': {'median': 0.7 * scale, 'p95': 0.8 * scale, 'max': 0.9 * scale},
        'ms_per_frame': 10.4 * scale, 'frames': 100, 'lost_frames': 1, 'clip_turn_deg': 11 * scale,
        'over_time': {'time_s': [59.98, 120.], 'geodesic_deg': [0.1 * scale, 0.2 * scale]}}


@pytest.fixture
def folder(tmp_path):
    for name, scale in (('drone', 1), ('walk', 2)):
        (tmp_path / f'{name}.json').write_text(json.dumps({
            'recording': name, 'injected_seed': 7, 'body': '', 'mask': 'lat:-90,-60',
            'estimators': {
                method: figures(scale) for method in (
                    'pts', 'moment/farneback', 'moment/dis', 'pts_epipolar/farneback',
                    'pts_epipolar/dis')}}))
    (tmp_path / 'known.json').write_text(json.dumps({
        'recording': 'known', 'injected_seed': 7,
        'estimators': {'anchored': figures(1), 'anchored/offline': figures(2)}}))
    (tmp_path / 'coverage.json').write_text(json.dumps({'files': {
        f'package/{name}.py': {'summary': {
            'covered_lines': lines, 'num_statements': 10, 'covered_branches': 0,
            'num_branches': branches, 'percent_covered_display': '7'}}
        for name, lines, branches in (
            ('run', 9, 2), ('deep/one', 1, 0), ('deep/down/two', 4, 0))}}))
    return tmp_path


@pytest.mark.parametrize('block, said', [
    ('errors drone',
     '| `pts` | 1.00, 2.00, 3.00° | 4.00, 5.00, 6.00° | 0.700, 0.900° | 1 of 100 |'),
    ('beside drone walk', '| `pts` | 4.00°; 0.700° | 8.00°; 1.400° |'),
    ('times drone walk', '| `moment/dis` | 10 ms | 21 ms |'),
    ('paper drone', '| `pts` | 6.29, 4.09, 9.84° | 1.00, 2.00, 3.00° | 1.00, 2.00, 3.00° |'),
    ('over_time walk', '| geodesic after | 60 s | 120 s |'),
    ('offline known known',
     '| known, turned by seed 7 | 4.000, 5.000° | 8.000, 10.000° | 0.700, 0.900° | '
     '1.400, 1.800° |'),
    ('offline known known', '| **mean of all** | 4.000° | 8.000° | 0.700° | 1.400° |'),
    ('covered coverage', '| `deep` | 25 % | – |\n| executables | 90 % | 0 % |'),
    ('injected drone walk', '| `pts` | 7 | – | `lat:-90,-60` | 22.0° | 8.00, 10.00° |'),
])
def test_tables_are_filled_in_between_their_marks_only(folder, block, said):
    page = f'before\n\n<!-- {block} -->\nold\n<!-- end -->\n\nafter <!-- end -->\n'
    new = filled(page, folder)
    assert said in new and 'old' not in new
    assert new.startswith(f'before\n\n<!-- {block} -->\n\n|')
    assert new.endswith('|\n\n<!-- end -->\n\nafter <!-- end -->\n')
    assert filled(new, folder) == new
    rows = [line for line in new.splitlines() if line.startswith('|')]
    assert len({row.count('|') for row in rows}) == 1


def test_without_results_a_table_stays_as_it_is(folder):
    page = '<!-- times drone nothing -->\nold\n<!-- end -->\n<!-- other remark -->\n'
    assert filled(page, folder) == page


def test_an_unknown_table_is_named(folder):
    with pytest.raises(RecordingError, match="no table 'magic'"):
        filled('<!-- magic drone -->\n<!-- end -->', folder)


def test_the_command_fills_in_pages_and_names_those_that_are_not_there(folder, capsys):
    page = folder / 'page.md'
    page.write_text('<!-- errors walk -->\n<!-- end -->\n')
    assert main([str(folder), str(page)]) == 0
    assert '| `pts` | 2.00, 4.00, 6.00° |' in page.read_text()
    assert main([str(folder), str(folder / 'none.md')]) == 1
    line, = capsys.readouterr().err.splitlines()
    assert 'none.md cannot be read' in line


@pytest.mark.parametrize('page', ['docs/evaluation.md'])
def test_every_table_of_the_page_is_a_known_one(page):
    blocks = BLOCK.findall((ROOT / page).read_text())
    assert blocks and {kind for _, kind, _, _ in blocks} <= TABLES.keys()
