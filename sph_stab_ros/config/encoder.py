# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How a video is encoded."""

from dataclasses import dataclass

from sph_stab_ros.config.options import Checked, ConfigError, option

BY_DEPTH, H264, H265, AV1 = 'auto', 'h264', 'h265', 'av1'
# By FFmpeg's names, from quick to small; those of AV1 are SVT-AV1's.
PRESETS = ('ultrafast', 'superfast', 'veryfast', 'faster', 'fast', 'medium', 'slow', 'slower',
           'veryslow')
AV1_PRESETS = tuple(map(str, range(13, -1, -1)))
# Visually lossless at the smallest cost in time: CRF and preset.
DEFAULTS = {H264: (20, 'veryfast'), H265: (22, 'veryfast'), AV1: (27, '10')}
# In graphics cards and other chips: how FFmpeg's names of their encoders begin, by the codec, and
# by the end of the names what tells them to keep a quality.
HARDWARE_CODECS = {'h264': H264, 'hevc': H265, 'av1': AV1}
HARDWARE_QUALITY = {
    'nvenc': ('cq', {'rc': 'vbr', 'b': '0'}), 'qsv': ('global_quality', {}),
    'amf': ('qvbr_quality_level', {'rc': 'qvbr'}), 'vaapi': ('qp', {'rc_mode': 'CQP'}),
    'videotoolbox': ('global_quality', {'flags': '+qscale'})}
HARDWARE_ENCODERS = tuple(
    f'{codec}_{kind}' for codec in HARDWARE_CODECS for kind in HARDWARE_QUALITY)

# Those of live video, and what they are told so that each picture comes out at once.
LIVE_ENCODERS: dict[str, dict[str, str]] = {
    'h264_nvenc': {'preset': 'p3', 'tune': 'ull', 'zerolatency': '1', 'delay': '0', 'rc': 'cbr'},
    'h264_qsv': {'preset': 'veryfast', 'async_depth': '1'},
    'h264_amf': {'usage': 'ultralowlatency', 'rc': 'cbr'},
    'h264_vaapi': {'async_depth': '1'}, 'h264_videotoolbox': {'realtime': '1'},
    'h264_v4l2m2m': {}}


@dataclass(frozen=True)
class EncoderConfig(Checked):
    """The codec of a video, and how much time and room it may take."""

    codec: str = option(
        BY_DEPTH, 'Codec of the video: auto is h264, or h265 for pictures of more than eight '
        'bits, of which h265 and av1 keep ten', choices=(BY_DEPTH, *DEFAULTS))
    quality: int = option(
        0, 'Constant rate factor (CRF) of the codec, the smaller the better and the larger the '
        'file; 0 leaves it to the codec: 20 for h264, 22 for h265, 27 for av1', minimum=0,
        maximum=51)
    preset: str = option(
        '', "How much time the encoder takes for a small file, by FFmpeg's names: ultrafast to "
        'veryslow, for av1 13 to 0; veryfast and 10 where none is given')

    encoder: str = option(
        '', "FFmpeg's encoder in a graphics card or another chip: h264, hevc or av1, then _nvenc, "
        '_qsv, _amf, _vaapi or _videotoolbox; software encodes where it cannot be used here')

    def __post_init__(self) -> None:
        """Check each option's value, and that the codec knows the preset and the encoder."""
        super().__post_init__()
        if self.encoder not in ('', *HARDWARE_ENCODERS):
            raise ConfigError(f"encoder is one of {', '.join(HARDWARE_ENCODERS)}, not "
                              f"'{self.encoder}'")
        if self.encoder and self.codec not in (BY_DEPTH, self.codec_for(False)):
            raise ConfigError(f'encoder {self.encoder} is none of {self.codec}')
        known = AV1_PRESETS if self.codec_for(False) == AV1 else PRESETS
        if self.preset not in ('', *known):
            raise ConfigError(f'preset of {self.codec_for(False)} is one of {", ".join(known)}, '
                              f"not '{self.preset}'")

    def codec_for(self, is_deep: bool) -> str:
        """Return the codec of pictures of eight bits, or of more."""
        if self.encoder:
            return HARDWARE_CODECS[self.encoder.partition('_')[0]]
        if self.codec != BY_DEPTH:
            return self.codec
        return H265 if is_deep else H264

    def options(self, codec: str) -> dict[str, str]:
        """Return what FFmpeg's software encoder of a codec is told."""
        quality, preset = DEFAULTS[codec]
        return {'crf': str(self.quality or quality), 'preset': self.preset or preset}

    @property
    def hardware_options(self) -> dict[str, str]:
        """Return what the encoder in hardware is told; its presets are its own."""
        prefix, _, kind = self.encoder.partition('_')
        name, more = HARDWARE_QUALITY[kind]
        return {**more, name: str(self.quality or DEFAULTS[HARDWARE_CODECS[prefix]][0])}
