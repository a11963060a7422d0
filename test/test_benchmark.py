# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The benchmark's figures are there and whole; how large they are is the machine's business."""

from itertools import islice
import json
import sys

import numpy as np
import pytest
from sph_stab_ros.benchmark import inputs, main, medians, stage_calls, WIDTHS, widths_argument
from sph_stab_ros.image_pair import METHODS
from tiny_recordings import write_bag

STAGES = ('decode JPEG', 'grey, resize', 'flow farneback', 'flow dis', 'features A-KAZE',
          'fit essential', 'fit moment', 'fit epipolar', 'track anchored', 'warp sphere',
          'warp view', 'encode JPEG')
ESTIMATORS = ('anchored', *METHODS)


@pytest.fixture(scope='module')
def outcome(turning_bag, tmp_path_factory):
    """Return the JSON of a run at two widths, one above and one below the recording's."""
    path = tmp_path_factory.mktemp('benchmark') / 'benchmark.json'
    assert main([str(turning_bag), '--widths', '192,288', '--repeats', '1',
                 '--json', str(path)]) == 0
    return json.loads(path.read_text())


def figures_of(outcome):
    """Yield name and figures of each call at each width."""
    for groups in outcome['widths'].values():
        for members in groups.values():
            yield from members.items()


def test_every_stage_and_pipeline_is_there_at_every_width(outcome):
    assert list(outcome['widths']) == ['192', '288']
    for groups in outcome['widths'].values():
        assert set(STAGES) <= set(groups['stages']) <= {*STAGES, 'fill message'}
        assert set(groups['pipelines']) == {
            name + pictures for name in ESTIMATORS for pictures in ('', ' + pictures')}


def test_all_figures_are_finite_and_positive(outcome):
    for name, figures in figures_of(outcome):
        numbers = [value for value in figures.values() if not isinstance(value, str)]
        assert np.isfinite(numbers).all() and min(numbers) > 0, name


def test_ratios_are_those_to_the_calls_named(outcome):
    for groups in outcome['widths'].values():
        everything = groups['bare'] | groups['pipelines']
        for one in (groups['stages'] | groups['pipelines']).values():
            base = everything[one['base']]
            assert one['ratio'] == pytest.approx(one['wall_ms'] / base['wall_ms'])
            assert one['cpu_ratio'] == pytest.approx(one['cpu_ms'] / base['cpu_ms'])


def test_the_machine_and_the_pictures_are_described(outcome):
    assert outcome['recorded_width'] == 256 and outcome['repeats'] == 1
    assert {'cpu', 'cores', 'opencv', 'numpy', 'python'} <= set(outcome['machine'])


def test_the_table_has_a_line_for_each_call(turning_bag, capsys):
    assert main([str(turning_bag), '--widths', '160', '--repeats', '1']) == 0
    lines = capsys.readouterr().out.splitlines()
    for name in (*STAGES, *ESTIMATORS, 'copy', 'cv2 remap sphere'):
        assert any(line.startswith(f'  {name}  ') for line in lines), name


def test_without_ros_the_message_is_left_out(turning, monkeypatch):
    monkeypatch.setitem(sys.modules, 'sensor_msgs.msg', None)
    first = next(inputs(turning[0], 192, 192))
    assert tuple(stage_calls(first, 192)) == STAGES


def test_pictures_follow_each_other_there_and_back(turning):
    images = turning[0][:3]
    given = [one.frame.image for one in islice(inputs(images, 256, 256), 5)]
    for image, expected in zip(given, (1, 2, 1, 0, 1), strict=True):
        np.testing.assert_array_equal(image, images[expected])


def test_calls_take_turns_and_the_first_round_does_not_count():
    order = []
    calls = {name: lambda one, name=name: order.append((name, one)) for name in 'ab'}
    figures = medians(calls, iter(range(3)))
    assert order == [(name, one) for one in range(3) for name in 'ab']
    assert {one['repeats'] for one in figures.values()} == {2}


def test_a_call_beyond_its_budget_is_not_repeated(monkeypatch):
    monkeypatch.setattr('sph_stab_ros.benchmark.BUDGET_S', 0.)
    assert medians({'slow': np.sum}, iter(range(9)))['slow']['repeats'] == 1


def test_the_default_widths_are_accepted():
    assert tuple(widths_argument(','.join(map(str, WIDTHS)))) == WIDTHS


@pytest.mark.parametrize('arguments', (
    ['--widths', '641'], ['--widths', '64'], ['--widths', '9000'], ['--widths', 'wide'],
    ['--widths', ''], ['--repeats', '0'], ['--json', '.'], ['--json', 'no/such/folder/file']))
def test_wrong_calls_are_refused_in_one_line(arguments, capsys):
    with pytest.raises(SystemExit, match='2'):
        main(arguments)
    assert capsys.readouterr().err.count('\n') == 1


@pytest.mark.parametrize('pictures', (1, 3))
def test_pictures_of_nothing_are_refused_in_one_line(pictures, tmp_path, capsys):
    bag = write_bag(tmp_path / 'bag', [np.zeros((128, 256, 3), np.uint8)] * pictures)
    assert main([str(bag), '--widths', '192', '--json', str(tmp_path / 'out.json')]) == 1
    assert capsys.readouterr().err.count('\n') == 1
    assert not (tmp_path / 'out.json').exists()


def test_a_missing_recording_is_refused(tmp_path, capsys):
    assert main([str(tmp_path / 'none')]) == 1
    assert 'does not exist' in capsys.readouterr().err
