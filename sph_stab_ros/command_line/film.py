# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Arguments for what a video shows, how fast, and how it is encoded."""

import argparse

from sph_stab_ros.command_line.arguments import period_argument, whole_number
from sph_stab_ros.config import ConfigError, EncoderConfig, options

ENCODER_OPTIONS = tuple(one.name for one in options(EncoderConfig))
# What only a video can have.
FILM_OPTIONS = ('side_by_side', 'hyperlapse', 'directions', 'stills', *ENCODER_OPTIONS)


def add_film(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    group = parser.add_argument_group('the video', 'All need a video as output.')
    group.add_argument('--side-by-side', action='store_true',
                       help='show sphere, front and back view, recorded and stabilised')
    group.add_argument('--directions', metavar='FILE.yaml|TOPIC',
                       help='a view that looks where a list of {time_s, yaw_deg, pitch_deg} says, '
                       "or a bag's topic such as view/direction, and turns smoothly in between")
    group.add_argument('--hyperlapse', metavar='N', type=whole_number(2, 1000),
                       help='show every N-th picture, N times as fast, without sound')
    group.add_argument('--stills', metavar='SECONDS', type=period_argument,
                       help='write a picture every so many seconds into OUT_stills/, too')
    for one in options(EncoderConfig):
        group.add_argument(f'--{one.name}', type=type(one.default), choices=one.choices,
                           metavar='|'.join(one.choices or ()) or one.name.upper(),
                           help=one.description)


def check_film(parser: argparse.ArgumentParser, args: argparse.Namespace, is_video: bool,
               wanted: str) -> None:
    """Exit 2 where a video's options are given without one, or are not allowed."""
    for name in FILM_OPTIONS:
        if getattr(args, name) and not is_video:
            parser.error(f'--{name.replace("_", "-")} needs {wanted}')
    if args.directions and args.view:
        parser.error('--directions says where the view looks: leave out --view')
    args.encoding = encoder_of(parser, args)


def encoder_of(parser: argparse.ArgumentParser, args: argparse.Namespace) -> EncoderConfig:
    """Return the EncoderConfig that parsed arguments give; exit 2 where one is not allowed."""
    try:
        return EncoderConfig(**{name: getattr(args, name) for name in ENCODER_OPTIONS
                                if getattr(args, name) is not None})
    except ConfigError as error:
        parser.error(f'--{error}')
