# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How `make docs` builds the site from these pages, the option schema and the docstrings."""

from pathlib import Path
import re
import sys

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE / 'extensions')]

import sph_stab_ros  # noqa: E402

project = 'sph_stab_ros'
author = 'The sph_stab_ros developers'
project_copyright = f'2026, {author}'
release = sph_stab_ros.__version__

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon', 'from_the_package']
exclude_patterns = ['requirements.txt']
# Links to headings within pages, as GitHub makes them.
myst_heading_anchors = 3
autodoc_member_order = 'bysource'
autodoc_typehints = 'description'
html_theme = 'furo'
html_title = f'sph_stab_ros {release}'


def name_pages_elsewhere(_app, docname, source):
    """Name pages of the repository that are not in the site, instead of leading there."""
    out_of_docs = r'\.\./' * (docname.count('/') + 1)
    source[0] = re.sub(rf'\[([^]]+)\]\({out_of_docs}([^)#]*\.md)[^)]*\)',
                       r'\1 (`\2` in the repository)', source[0])


def setup(app):
    """Tell Sphinx of the above."""
    app.connect('source-read', name_pages_elsewhere)
