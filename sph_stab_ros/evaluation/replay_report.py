# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a replay tells in one file: figures, pictures and numbers that open without a network."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from importlib.metadata import PackageNotFoundError, version
import io
import platform
from string import Template
from typing import Any

import cv2
from matplotlib.figure import Figure

from sph_stab_ros import __version__
from sph_stab_ros.config import Settings
from sph_stab_ros.config.options import get_option
from sph_stab_ros.evaluation.replay_figures import figures
from sph_stab_ros.evaluation.replay_log import ReplayLog
from sph_stab_ros.geometry.arrays import Image
from sph_stab_ros.images.codec import encode_jpeg

LIBRARIES = ('numpy', 'scipy', 'av', 'matplotlib')
JPEG_QUALITY = 85
DPI = 110
PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>$title</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 0 auto; padding: 1em;
       color: #222; background: #fff; }
h1 { font-size: 1.5em; } h2 { font-size: 1.2em; margin-top: 2em; }
figure { margin: 1.5em 0; } figcaption { color: #555; }
img { max-width: 100%; display: block; }
.pairs { display: grid; grid-template-columns: repeat(2, 1fr); gap: 0.8em; }
.pairs figure { margin: 0; }
table { border-collapse: collapse; }
td { padding: 0.15em 1.2em 0.15em 0; vertical-align: top; overflow-wrap: anywhere; }
</style>
</head>
<body>
<h1>$title</h1>
$summary
$figures
<h2>Pictures</h2>
<p>The sphere as recorded on the left, as shown on the right.</p>
<div class="pairs">
$pictures
</div>
<h2>Settings</h2>
$settings
<h2>Versions</h2>
$versions
</body>
</html>
""")


def page(name: str, log: ReplayLog, lines: Sequence[str], settings: Settings,
         flags: Mapping[str, Any]) -> str:
    """Return the page of a replay of the recording ``name``; ``lines`` tell of it already."""
    return PAGE.substitute(
        title=escape(name),
        summary='\n'.join(f'<p>{escape(line)}</p>' for line in lines),
        figures='\n'.join(captioned(inline_figure(figure), caption)
                          for caption, figure in figures(log)),
        pictures='\n'.join(
            captioned(inline_picture(picture), f'{time_s:.1f} s, {which}')
            for time_s, recorded, stabilised in log.thumbnails
            for which, picture in (('recorded', recorded), ('stabilised', stabilised))),
        settings=table(changed(settings) | {**flags}) + '<p>All others are as by default.</p>',
        versions=table(versions()))


def changed(settings: Settings) -> dict[str, Any]:
    """Return the options that are not as by default, by name."""
    found = {}
    for name, option in settings.parameters.items():
        view, _, key = name.partition('.')
        value = (get_option(settings.views[view], key) if view in settings.views else
                 get_option(settings.config, option.name))
        if value != option.default:
            found[name] = value
    return found


def versions() -> dict[str, str]:
    """Return the versions of what has made it."""
    found = {'sph_stab_ros': __version__, 'Python': platform.python_version(),
             'system': platform.platform(), 'opencv': cv2.__version__}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = 'not known'
    return found


def table(rows: Mapping[str, Any]) -> str:
    """Return a table of names and values."""
    return '<table>' + ''.join(f'<tr><td>{escape(name)}</td><td>{escape(str(value))}</td></tr>'
                               for name, value in rows.items()) + '</table>'


def captioned(source: str, caption: str) -> str:
    """Return a figure of a picture."""
    return (f'<figure><img src="{source}" alt="{escape(caption)}">'
            f'<figcaption>{escape(caption)}</figcaption></figure>')


def inline_figure(figure: Figure) -> str:
    """Return a Figure as a data URI."""
    file = io.BytesIO()
    figure.savefig(file, format='png', dpi=DPI)
    return inline('image/png', file.getvalue())


def inline_picture(picture: Image) -> str:
    """Return a picture as a data URI."""
    return inline('image/jpeg', encode_jpeg(picture, JPEG_QUALITY).tobytes())


def inline(kind: str, data: bytes) -> str:
    """Return a data URI."""
    return f'data:{kind};base64,{base64.b64encode(data).decode()}'
