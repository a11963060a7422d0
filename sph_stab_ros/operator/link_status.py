# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""How well the browsers get their pictures, for /diagnostics."""

from collections.abc import Sequence
from dataclasses import asdict

from sph_stab_ros.operator.robot_interface import Watcher

# Of a Link, as diagnostics name them.
NAMES = {'drawn': 'drawn_hz', 'dropped': 'dropped_hz', 'mbit_s': 'received_mbit_s',
         'latency_ms': 'latency_ms', 'latency_p95_ms': 'latency_p95_ms',
         'round_trip_ms': 'round_trip_ms'}


def link_status(watchers: Sequence[Watcher]) -> tuple[str, dict[str, str]]:
    """
    Return the message of a DiagnosticStatus and its values, by key.

    Of each browser it has what its page shows of the link, numbered in the order in which they
    came; what is unknown is left out. Latencies are from the camera's stamp to the drawn picture.
    """
    values = {'browsers': str(len(watchers))}
    for number, watcher in enumerate(watchers, 1):
        values[f'browser {number}'] = f"{watcher.address}{', steers' if watcher.steers else ''}"
        for name, value in asdict(watcher.link).items() if watcher.link else ():
            if value is not None:
                values[f'browser {number}: {NAMES[name]}'] = f'{value:.1f}'
    message = {0: 'nobody watches', 1: '1 browser'}.get(len(watchers), f'{len(watchers)} browsers')
    return message, values
