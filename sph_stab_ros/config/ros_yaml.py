# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
YAML as ROS reads parameters: scalars by its own rules, and nothing but mappings and lists else.

``yes``, ``on`` and ``Y`` are true, ``010`` is eight, ``1_000`` and dates are texts; what is quoted
is a text always.
"""

from pathlib import Path
import re
from typing import Any
import warnings

from sph_stab_ros.config.options import ConfigError

TRUE = ('Y', 'y', 'yes', 'Yes', 'YES', 'true', 'True', 'TRUE', 'on', 'On', 'ON')
FALSE = ('N', 'n', 'no', 'No', 'NO', 'false', 'False', 'FALSE', 'off', 'Off', 'OFF')
HEXADECIMAL = re.compile(r'[-+]?0[xX][0-9a-fA-F]+')
OCTAL = re.compile(r'[-+]?0[0-7]+')
DECIMAL = re.compile(r'[-+]?(0|[1-9][0-9]*)')
FRACTION = re.compile(r'[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?')
NO_NUMBER = re.compile(r'[-+]?\.?(inf|Inf|INF|nan|NaN|NAN)')
INT64_LIMIT = 2**63
# With zeros before it that say nothing.
MOST_DIGITS = 100


def read_yaml(path: Path) -> Any:
    """Return what a file of YAML holds, None where it is empty; ConfigError, without its name."""
    try:
        return parse_yaml(path.read_text('utf-8-sig'))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(getattr(error, 'strerror', None) or 'not a text') from None


def parse_yaml(text: str) -> Any:
    """Return what a text of YAML holds, None where it is empty, or raise ConfigError."""
    # Not at the top: the node reads no YAML and starts without the library.
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    try:
        with warnings.catch_warnings():
            # Anchors of one name, in several lines.
            warnings.simplefilter('ignore')
            node = YAML(typ='safe', pure=True).compose(text)
        return None if node is None else _value(node, set())
    except YAMLError as error:
        mark = getattr(error, 'problem_mark', None)
        raise ConfigError(f'not YAML in line {mark.line + 1}' if mark else 'not YAML') from None
    except RecursionError:
        raise ConfigError('nested too deeply') from None


def _value(node: Any, known: set[int]) -> Any:
    """Return the value of a node of the composed tree; ``known`` are the ids of those before."""
    if id(node) in known:
        raise ConfigError(f'an alias of line {node.start_mark.line + 1}, which ROS does not read')
    known.add(id(node))
    if node.id == 'scalar':
        return _scalar(node)
    if node.id == 'sequence':
        return [_value(item, known) for item in node.value]
    # As in ROS the last one counts of a key's values.
    return {_key(key): _value(value, known) for key, value in node.value}


def _key(node: Any) -> str:
    if node.id != 'scalar':
        raise ConfigError(f'no name in line {node.start_mark.line + 1}')
    return str(node.value)


def _scalar(node: Any) -> str | bool | int | float:
    text: str = node.value
    if node.style in ('"', "'"):
        return text
    if not text:
        raise ConfigError(f'no value in line {node.start_mark.line + 1}')
    if text in TRUE or text in FALSE:
        return text in TRUE
    for pattern, base in ((HEXADECIMAL, 16), (OCTAL, 8), (DECIMAL, 10)):
        if (len(text) <= MOST_DIGITS and pattern.fullmatch(text)
                and -INT64_LIMIT <= (number := int(text, base)) < INT64_LIMIT):
            return number
    if FRACTION.fullmatch(text):
        return float(text)
    if NO_NUMBER.fullmatch(text):
        return float(text.replace('.', ''))
    return text
