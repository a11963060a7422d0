# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Accuracy on recordings of known truth, held by what has been measured.

``test/ledger.json`` has the figures and ``make ledger`` writes them. Worse ones fail; better ones
pass, with a warning that the ledger can be tightened.
"""

from copy import deepcopy
import json
import warnings

import pytest
import tracking_accuracy
from tracking_accuracy import CASES, improvements, main, read_ledger, updated, violations

HELD = {'frames': 60, 'lost_frames': 1,
        'per_frame_deg': {'median': 0.01, 'p95': 0.02, 'max': 0.03},
        'geodesic_deg': {'mean': 0.05, 'max': 0.1, 'end': 0.02}}


@pytest.mark.parametrize('case', [
    pytest.param(case, marks=pytest.mark.slow if case.slow else pytest.mark.thorough, id=case.name)
    for case in CASES])
def test_no_estimator_gets_worse(case):
    if not case.path.exists():
        pytest.skip(f'{case.recording} is not there')
    held, measured = read_ledger()[case.recording][case.variant], case.measure()
    assert not violations(measured, held)
    for line in improvements(measured, held):
        warnings.warn(f'{case.name}: {line}; make ledger tightens it')


def test_the_ledger_has_all_that_is_measured_and_nothing_else():
    assert {f'{recording}: {variant}' for recording, variants in read_ledger().items()
            for variant in variants} == {case.name for case in CASES}


def changed(part, figure, value):
    figures = deepcopy(HELD)
    figures[part][figure] = value
    return figures


def test_what_was_measured_passes_and_needs_no_tightening():
    assert violations(HELD, HELD) == improvements(HELD, HELD) == []


@pytest.mark.parametrize('part, figure, worse, hardly, better', (
    ('per_frame_deg', 'median', 0.0121, 0.0119, 0.008),
    ('geodesic_deg', 'mean', 0.0701, 0.0699, 0.029)))
def test_only_what_is_worse_fails(part, figure, worse, hardly, better):
    assert len(violations(changed(part, figure, worse), HELD)) == 1
    assert len(violations(changed(part, figure, float('nan')), HELD)) == 1
    for value in (hardly, better):
        assert violations(changed(part, figure, value), HELD) == []
    assert len(improvements(changed(part, figure, better), HELD)) == 1
    for value in (hardly, worse):
        assert improvements(changed(part, figure, value), HELD) == []


def test_large_errors_are_held_by_their_size():
    held = changed('geodesic_deg', 'mean', 2.)
    assert violations(changed('geodesic_deg', 'mean', 2.39), held) == []
    assert len(violations(changed('geodesic_deg', 'mean', 2.41), held)) == 1


@pytest.mark.parametrize('other', ({'lost_frames': 2}, {'frames': 59}))
def test_frames_lost_or_left_out_fail(other):
    assert len(violations(HELD | other, HELD)) == 1
    assert violations(HELD | {'lost_frames': 0}, HELD) == []


def test_other_figures_stay_and_those_of_nothing_go():
    ledger, case = read_ledger(), CASES[0]
    expected = deepcopy(ledger)
    expected[case.recording][case.variant] = HELD
    ledger[case.recording]['an estimator that is gone'] = HELD
    assert updated(ledger, {case: HELD}) == expected


def test_the_command_writes_the_ledger(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tracking_accuracy.Case, 'measure', lambda case: HELD)
    monkeypatch.setattr(tracking_accuracy, 'LEDGER', tmp_path / 'ledger.json')
    assert main(['bags/drone', 'anchored', 'of 2']) == 0
    assert json.loads((tmp_path / 'ledger.json').read_text()) == {
        'bags/drone': {'anchored, 300 frames, 1 of 2': HELD}}
    assert 'nothing -> 0.01 per frame, 0.05 in the mean' in capsys.readouterr().out
    assert main(['no such estimator']) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
