# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What the pages show of the package as it is, so that they cannot be out of date.

``parameters`` are those of the node; ``command-help NAME`` is what ``NAME --help`` writes;
``public-api`` documents what ``sph_stab_ros`` exports. First and last need ``{eval-rst}`` around.
"""

import os
from pathlib import Path
import subprocess
import sys

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
import sph_stab_ros
from sph_stab_ros.config import NODE_PARAMETERS
from sph_stab_ros.config.parameter_file import allowed, yaml_value
from sphinx.util.docutils import SphinxDirective

# Nodes start in an environment that has ROS 2 itself only.
PYTHON = os.environ.get('PACKAGE_PYTHON', sys.executable)
REPOSITORY = Path(__file__).resolve().parents[2]


class Parameters(SphinxDirective):
    """All parameters of the node with their defaults."""

    def run(self):
        """Return a list of definitions."""
        lines = []
        for name, option in NODE_PARAMETERS.items():
            when = '' if option.live else ' *At start only.*'
            lines += [f'``{name}``: ``{yaml_value(option.default)}``',
                      f'   {option.description}{allowed(option)}.{when}', '']
        return parsed(self, lines)


class CommandHelp(Directive):
    """What an executable says of itself."""

    required_arguments = 1

    def run(self):
        """Return it as a literal block; a command that fails ends the build."""
        name, = self.arguments
        environment = {**os.environ, 'COLUMNS': '88'}
        # ROS 2's wheels would take themselves for set up by this very process.
        environment.pop('_ROS_WHEELS_BOOTSTRAP_COMPLETE', None)
        said = subprocess.run(
            [PYTHON, '-m', f'sph_stab_ros.{name}', '--help'], cwd=REPOSITORY, text=True,
            check=True, capture_output=True, env=environment).stdout
        return [nodes.literal_block(said, said, language='text')]


class PublicApi(SphinxDirective):
    """All that ``sph_stab_ros`` exports, in the order of the alphabet."""

    def run(self):
        """Return their documentation."""
        lines = []
        for name in sph_stab_ros.__all__:
            value = getattr(sph_stab_ros, name)
            kind, members = 'function', []
            if isinstance(value, type):
                kind = 'exception' if issubclass(value, Exception) else 'class'
                members = ['   :members:']
            lines += [f'.. auto{kind}:: sph_stab_ros.{name}', *members, '']
        return parsed(self, lines)


def parsed(directive, lines):
    """Return the nodes of lines of reStructuredText."""
    node = nodes.Element()
    directive.state.nested_parse(StringList(lines, source=__file__), 0, node)
    return node.children


def setup(app):
    """Tell Sphinx of the directives."""
    app.add_directive('parameters', Parameters)
    app.add_directive('command-help', CommandHelp)
    app.add_directive('public-api', PublicApi)
    return {'parallel_read_safe': True}
