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

from sph_stab_ros.evaluation.docs_tables import BLOCK, filled, main, TABLES
from sph_stab_ros.recording import RecordingError

ROOT = Path(__file__).resolve().parents[2]


def figures(scale):
    return {
        'mean_abs_error_deg': {'roll': 1 * scale, 'pitch': 2 * scale, 'yaw': 3 * scale},
        'geodesic_deg': {'mean': 4 * scale, 'max': 5 * scale, 'end': 6 * scale},
        'per_frame_deg': {'median': 0.7 * scale, 'p95': 0.8 * scale, 'max': 0.9 * scale},
        'ms_per_frame': 10.4 * scale, 'frames': 100, 'lost_frames': 1, 'clip_turn_deg': 11 * scale,
        'over_time': {'time_s': [59.98, 120.], 'geodesic_deg': [0.1 * scale, 0.2 * scale]}}


PERCENTILES = {'p50': 50.2, 'p95': 95.4, 'p99': 99.}
PAGE = {'pictures': 'camera', 'video': 'jpeg', 'rate_hz': 30., 'link': None, 'mbit_s': 31.04,
        'drawn': 298, 'frames': 300, 'latency_ms': PERCENTILES,
        'cpu_percent': {'stabilizer': 60., 'operator': 9.}}
SOURCE = {'width': 1920, 'rate_hz': 30., 'frames': 300, 'orientations': 299, 'views': 0,
          'orientations_latency_ms': PERCENTILES, 'views_latency_ms': {},
          'cpu_percent': {'node': 38., 'sender': 28.}, 'machine': {'load_before': 0.04}}
COST = {'width': 1920, 'kind': 'H.264', 'frames': 150, 'cpu_s': 2880., 'peak_rss_mb': 224.4,
        'read_bytes': 3_300_000_000, 'written_bytes': 7_000_000}
BENCHMARKS = {
    'ros': {
        'scenarios': {'raw, profile': {
            'frames': 300, 'orientations': 271, 'images': 247, 'latency_ms': PERCENTILES,
            'orientation_latency_ms': PERCENTILES,
            'cpu_percent': {'player': 15., 'node': 126., 'subscriber': 14.}}},
        'source_1920': SOURCE,
        'source_1920_view': {**SOURCE, 'views': 286, 'views_latency_ms': PERCENTILES},
        'operator_page': PAGE,
        'operator_page_link': {**PAGE, 'video': 'h264', 'link': [6., 0.04, 0.01]},
        'operator_page_slow': {**PAGE, 'pictures': 'stabilizer', 'latency_ms': {}}},
    'soak': {'seconds': 600, 'frames': 14439, 'heartbeats': 606, 'longest_gap_s': 1.008,
             'memory_mb': 143.4, 'memory_growth_mb': 7.04, 'failed': []},
    'stages': {
        'recording': 'drone', 'targets': [
            {'what': 'cost', 'target': '<= 10 ms', 'measured': '12.0 ms', 'met': False}],
        'projections': {'cubemap': {'sphere': {'cpu_ms': 26.4}, 'view': {'cpu_ms': 4.},
                                    'grey': {'cpu_ms': 5.}}},
        'growth': {'frames': 2000,
                   'first_tenth': {'median_ms': 6., 'memory_mb': 100., 'keyframes': 48},
                   'last_tenth': {'median_ms': 8., 'memory_mb': 108., 'keyframes': 48}},
        'references': {'COLMAP': {'frames': 99, 'lost_frames': 1, 'ms_per_frame': 2016.,
                                  'geodesic_deg': {'mean': 0.137, 'max': 0.27}}}},
    'batch': {
        'hour': [{**COST, 'writes': 'trajectory'}, {**COST, 'writes': 'bag'}],
        'split': {'one run': {'cpu_s': [6.2], 'geodesic_deg': {'mean': 0.054, 'max': 0.11},
                              'per_frame_deg': {'max': 0.07}}}},
    'parts': {'as it is': {
        name: {'geodesic_mean_deg': mean_deg, 'per_frame_median_deg': 0.02}
        for name, mean_deg in (
            ('drone', 0.05), ('pioneer', 0.4), ('pioneer_4', 0.1), ('pioneer_12', 0.3))}},
    'others': {'about': {}, 'columns': ['recording', 'ours'], 'rows': [['a flight', '**0.1**']]},
}


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
    for name, figures_of_it in BENCHMARKS.items():
        (tmp_path / f'{name}.json').write_text(json.dumps(figures_of_it))
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
    ('node ros', '| raw, profile | 271/300 | 247/300 | 50, 95 | 50, 95, 99 | 15, 126, 14 % |'),
    ('source ros', '| 299/300 | 50, 95, 99 | – | – | 38, 28 % | 0.0 |'),
    ('source ros', '| 299/300 | 50, 95, 99 | 286/300 | 50, 95, 99 | 38, 28 % | 0.0 |'),
    ('page ros', '| JPEG | 30 Hz | none | 31.0 | 298 of 300 | 50, 95 | 9, 60 % |'),
    ('page ros', '| H.264 | 30 Hz | 6 Mbit/s, 40 ms, 1 % lost |'),
    ('page ros', '| JPEG, derotated by the node | 30 Hz | none | 31.0 | 298 of 300 | – |'),
    ('soak soak', '| 600 | 14439 | 606, 1.01 s | 143 MB, +7.0 MB | passed |'),
    ('targets stages', '| cost | <= 10 ms | 12.0 ms | *missed* |'),
    ('targets stages', '| no growth | 6.0, 8.0 ms; +8 MB at 48 keyframes |'),
    ('projections stages', '| `cubemap` | 26 | 4 | 5 |'),
    ('references stages drone', '| drone | COLMAP | 99 of 100 | 0.14, 0.27° | 2.016 |'),
    ('hour batch', '| 1920 (H.264) | trajectory | 0.8 | 224 MB | 3.3 GB | 7 MB |'),
    ('workers batch', '| 1920, trajectory | 33.3 days | 3.3 days | 0.3 days | 1.1 GB, 2 MB |'),
    ('split batch', '| one run | 6.2 s | 0.054, 0.11° | 0.070° |'),
    ('ablation parts', '| as it is | 0.05, 0.020° | 0.40, 0.020° | 0.20, 0.020°; 0.30 |'),
    ('stated others', '| a flight | **0.1** |'),
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
    # Results that are of other things.
    for kind in ('page', 'source', 'references'):
        page = f'<!-- {kind} soak -->\nold\n<!-- end -->\n'
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


def pages():
    """Return the pages that have tables to fill in."""
    paths = ROOT / 'README.md', *sorted((ROOT / 'docs').rglob('*.md'))
    return [str(path.relative_to(ROOT)) for path in paths if BLOCK.search(path.read_text())]


@pytest.mark.parametrize('page', pages())
def test_every_table_of_a_page_is_a_known_one_and_some_target_fills_it_in(page):
    blocks = BLOCK.findall((ROOT / page).read_text())
    assert {kind for _, kind, _, _ in blocks} <= TABLES.keys()
    filling = [line for line in (ROOT / 'Makefile').read_text().splitlines()
               if 'DOCS_TABLES)' in line and page in line.split()]
    assert filling


@pytest.mark.parametrize('page', pages())
def test_tables_are_those_of_the_committed_results(page):
    """Those of results that are not committed only the targets can tell."""
    text = (ROOT / page).read_text()
    assert filled(text, ROOT / 'docs/measured') == text


def test_every_committed_result_is_shown():
    shown = {name for page in pages() for _, _, names, _ in BLOCK.findall(
        (ROOT / page).read_text()) for name in names.split()}
    assert {path.stem for path in (ROOT / 'docs/measured').glob('*.json')} <= shown
