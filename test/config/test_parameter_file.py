# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The node's parameter files: what is read is what was written, as ROS itself reads it."""

from pathlib import Path

from parameter_values import other_value
import pytest
from sph_stab_ros.config import ConfigError, NODE_PARAMETERS, Settings, settings_of
from sph_stab_ros.config.parameter_file import parameter_file, read_parameter_files
from sph_stab_ros.config.ros_yaml import parse_yaml

# By the order of their sections, the names of nodes and the way in which names nest.
FILES = {
    'shared': '/**:\n  ros__parameters: {jpeg_quality: 1, view: {width: 100, yaw_deg: 5.0}}\n',
    'own': 'stabilizer:\n  ros__parameters:\n    jpeg_quality: 2\n    view.width: 200\n',
    'shared, own': '/**:\n  ros__parameters: {jpeg_quality: 3}\n'
                   '/stabilizer:\n  ros__parameters: {jpeg_quality: 4}\n',
    'own, shared': 'stabilizer: {ros__parameters: {jpeg_quality: 5}}\n'
                   '/**: {ros__parameters: {jpeg_quality: 6, view.width: 600}}\n',
    'others': 'camera: {ros__parameters: {jpeg_quality: 70, gain: 1}}\n'
              'arm: {camera: {ros__parameters: {nonsense: 1}}}\n'
              '/*: {ros__parameters: {jpeg_quality: 8}}\n',
    'slash': '/stabilizer: {ros__parameters: {jpeg_quality: 9, flow: dis}}\n',
    'twice': '/**/stabilizer: {ros__parameters: {view: {width: 90}, view.width: 91}}\n',
}
SCALARS = (
    'yes', 'y', 'N', 'Off', 'TRUE', 'tRue', '010', '09', '-0x1F', '+3', '1_000', '1:30',
    '2020-01-01', 'null', '~', '1e3', '.5', '1.', 'inf', '-.inf', "'5'", '"on"', '"a\\tb"',
    '[a, b]', '[1, 2]', '[on, off]', 'lat:-90,-60', '9223372036854775807', '9223372036854775808',
    '-9223372036854775808', '0b11', '0o17', 'a b', '5 # five', '1.5.2', 'e5')


def written(folder, *texts):
    """Write files and return their paths."""
    paths = []
    for number, text in enumerate(texts):
        paths.append(folder / f'{number}.yaml')
        paths[-1].write_text(text)
    return paths


def overrides(*args):
    """Return the parameters that ROS itself gives to the node."""
    rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed')
    context = rclpy.context.Context()
    rclpy.init(context=context, args=['stabilizer', '--ros-args', *args])
    node = rclpy.create_node('stabilizer', context=context, enable_rosout=False,
                             start_parameter_services=False)
    found = {name: one.value for name, one in node._parameter_overrides.items()}
    node.destroy_node()
    context.try_shutdown()
    return found


def values(parameters):
    return {name: value for name, (_, value) in parameters.items()}


def test_the_file_of_all_defaults_gives_the_defaults(tmp_path):
    given = read_parameter_files(written(tmp_path, parameter_file()))
    assert given.keys() == NODE_PARAMETERS.keys()
    assert settings_of(given) == Settings()


@pytest.mark.parametrize('nested', (True, False))
def test_every_parameter_is_read_as_it_was_written(tmp_path, nested):
    wanted = {name: other_value(name) for name in NODE_PARAMETERS}
    lines = ['stabilizer:', '  ros__parameters:']
    for name, value in wanted.items():
        if nested:
            *groups, name = name.split('.')
            name = ''.join(f'{group}: {{' for group in groups) + name
        lines.append(f'    {name}: {value!r}' + '}' * name.count('{'))
    # Groups that stand several times are one.
    paths = [written(tmp_path, '\n'.join([*lines[:2], line]) + '\n')[0].rename(
        tmp_path / f'{number}_.yaml') for number, line in enumerate(lines[2:])]
    given = read_parameter_files(paths)
    assert values(given) == wanted
    assert settings_of(given) == Settings().changed(wanted) != Settings()


@pytest.mark.parametrize('text', SCALARS)
def test_values_are_what_ros_takes_them_for(text):
    value, theirs = parse_yaml(text), overrides('-p', f'mask:={text}')['mask']
    assert (type(value), value) == (type(theirs), theirs)


@pytest.mark.parametrize('names', (
    *((name,) for name in FILES), *((a, b) for a in FILES for b in FILES if a != b)),
    ids=lambda names: ' then '.join(names))
def test_files_are_merged_as_ros_merges_them(tmp_path, names):
    paths = written(tmp_path, *(FILES[name] for name in names))
    theirs = overrides(*(word for path in paths for word in ('--params-file', str(path))))
    given = read_parameter_files(paths)
    assert values(given) == theirs
    # And each knows where it is from.
    assert {source for source, _ in given.values()} <= {f"'{path}'" for path in paths}


def test_a_namespace_of_the_robot_does_not_matter(tmp_path):
    for text in ('/ns/stabilizer: {ros__parameters: {flow: dis}}',
                 'ns: {stabilizer: {ros__parameters: {flow: dis}}}',
                 '/ns/*: {ros__parameters: {flow: dis}}'):
        assert values(read_parameter_files(written(tmp_path, text))) == {'flow': 'dis'}


@pytest.mark.parametrize('text, reason', (
    ('', 'has no parameters of the stabilizer'),
    ('camera: {ros__parameters: {gain: 1}}', 'has no parameters of the stabilizer'),
    ('{', 'not YAML in line 1'), ('- 1', 'no ros__parameters'),
    ('stabilizer: {flow: dis}', 'stabilizer/flow has no ros__parameters'),
    ('stabilizer: {ros__parameters: 3}', 'ros__parameters of stabilizer have no names'),
    ('stabilizer: {ros__parameters: {flow: }}', 'no value in line 1'),
    ('/a/stabilizer: {ros__parameters: {flow: dis}}\n/b/stabilizer: {ros__parameters: {mask: a}}',
     'several nodes: /a/stabilizer, /b/stabilizer'),
    ('/**: {ros__parameters: {estimatr: pts}}', "there is no parameter 'estimatr'"),
    ('/**: {ros__parameters: {view: {zoom: 1}}}', "there is no parameter 'view.zoom'"),
    ('/**: {ros__parameters: {view: 1}}', "there is no parameter 'view'"),
    ('/**: {ros__parameters: {rear.yaw_deg: 1.0}}', "there is no parameter 'rear.yaw_deg'"),
    ('/**: {ros__parameters: {view: {width: wide}}}', "view.width is a int, not 'wide'"),
    ('/**: {ros__parameters: {view.hfov_deg: 500}}', 'view.hfov_deg must lie within 10 and 150'),
    ('/**: {ros__parameters: {smoothing: {mode: magic}}}', 'smoothing.mode is one of lock, '),
    ('/**: {ros__parameters: {views: front}}', 'views is a list of names'),
    ('/**: {ros__parameters: {views: [on]}}', "'True' cannot be a view"),
    ('/**: {ros__parameters: {working_width: 5}}', 'working_width is 0 or at least 128'),
))
def test_what_is_wrong_is_said_with_the_file(tmp_path, text, reason):
    path, = written(tmp_path, text)
    with pytest.raises(ConfigError) as error:
        settings_of(read_parameter_files([path]))
    assert str(error.value).startswith(f"'{path}'") and reason in str(error.value)
    assert '\n' not in str(error.value)


def test_files_that_are_no_texts_are_refused(tmp_path):
    (tmp_path / 'binary').write_bytes(b'\xff\xfe\x00')
    for path, reason in ((tmp_path / 'none', 'No such file'), (tmp_path, 'directory'),
                         (tmp_path / 'binary', 'not a text')):
        with pytest.raises(ConfigError, match=reason):
            read_parameter_files([path])


def test_what_any_node_may_be_told_is_left_out(tmp_path):
    path, = written(tmp_path, '/**: {ros__parameters: {use_sim_time: true, qos_overrides: '
                    '{/image: {subscription: {depth: 1}}}}}')
    assert settings_of(read_parameter_files([path])) == Settings()


def test_each_view_has_parameters_of_its_own(tmp_path):
    path, = written(tmp_path, '/**: {ros__parameters: {rear: {yaw_deg: 180.0}, view: {width: 99},'
                    ' views: [front, rear]}}')
    settings = settings_of(read_parameter_files([path]))
    assert list(settings.views) == ['front', 'rear']
    assert settings.views['rear'].yaw_deg == 180 and settings.views['front'].yaw_deg == 0
    assert [view.frame_id for view in settings.views.values()] == [
        'front_optical', 'rear_optical']
    # The one that there is by default is described by files of all defaults, and not there.
    assert settings.config.view == Settings().config.view


@pytest.mark.parametrize('frame_id', ('stabilized_optical', '/stabilized_optical', '/'))
def test_the_frames_must_be_told_apart(frame_id):
    same = {'view.frame_id': ('-p', frame_id)}
    with pytest.raises(ConfigError, match='must be different names'):
        settings_of(same)
    # In whatever order they are said.
    settings_of({'virtual_frame': ('-p', 'stabilized_optical'),
                 'stabilized_frame': ('-p', 'virtual_optical')})


def test_the_package_s_own_files_are_read():
    for path in (Path(__file__).resolve().parents[2] / 'config').glob('*.yaml'):
        settings_of(read_parameter_files([path]))
