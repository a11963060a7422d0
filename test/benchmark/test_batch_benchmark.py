# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The benchmark of batch counts what it says, and fills the tables of its page."""

import json

import pytest

pytest.importorskip('av')

from sph_stab_ros.benchmark import batch  # noqa: E402, I100
from sph_stab_ros.evaluation.docs_tables import filled  # noqa: E402
from sph_stab_ros.simulation.__main__ import main as simulate  # noqa: E402

FRAMES = 15


@pytest.mark.slow
def test_an_hour_is_scaled_up_and_the_tables_are_filled(tmp_path, monkeypatch):
    monkeypatch.setattr(batch, 'ENLARGED', {512: 4})
    bag = tmp_path / 'bag'
    assert simulate(['synthetic', str(bag), '--frames-limit', str(FRAMES), '--every', '2',
                     '--width', '256']) == 0
    path = tmp_path / 'batch.json'
    assert batch.main([str(bag), '--json', str(path)]) == 0
    outcome = json.loads(path.read_text())
    assert [(one['width'], one['writes'], one['frames']) for one in outcome['hour']] == [
        (256, 'trajectory', FRAMES), (256, 'bag', FRAMES), (256, 'mp4', FRAMES),
        (512, 'trajectory', 4), (512, 'mp4', 4)]
    assert outcome['hour'][0]['read_bytes'] == round(
        batch.HOUR_FRAMES / FRAMES * batch.size(bag))
    assert all(one['written_bytes'] > 0 and one['cpu_s'] > 0 for one in outcome['hour'])
    # Too short to be split.
    assert outcome['split']['one run']['geodesic_deg'] == outcome['split']['in segments'][
        'geodesic_deg']
    for kind in ('hour', 'workers', 'split'):
        page = f'<!-- {kind} batch -->\n<!-- end -->'
        assert filled(page, tmp_path) != page


@pytest.mark.parametrize('arguments', (['--frames', '1'], ['--json', 'no/such/folder/file']))
def test_wrong_calls_are_refused_in_one_line(arguments, capsys):
    with pytest.raises(SystemExit, match='2'):
        batch.main(arguments)
    assert capsys.readouterr().err.count('\n') == 1
