# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Serve a test picture by GStreamer's RTSP server: ``gst_rtsp_server.py ENCODER PAYLOADER``.

For the system's own Python, which has GStreamer where Debian's gir1.2-gst-rtsp-server-1.0 and the
plug-ins are installed. Prints the port.
"""

import sys

import gi
gi.require_version('Gst', '1.0')
gi.require_version('GstRtspServer', '1.0')
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402


def main():
    """Serve until killed."""
    Gst.init(None)
    encoder, payloader = sys.argv[1:]
    for name in encoder.split()[0], payloader:
        if Gst.ElementFactory.find(name) is None:
            sys.exit(f'GStreamer has no {name}')
    server = GstRtspServer.RTSPServer(service='0', address='127.0.0.1')
    factory = GstRtspServer.RTSPMediaFactory(shared=True)
    factory.set_launch(
        '( videotestsrc is-live=true '
        '! video/x-raw,format=I420,width=256,height=128,framerate=30/1 '
        f'! {encoder} ! {payloader} name=pay0 )')
    server.get_mount_points().add_factory('/sphere', factory)
    server.attach(None)
    print(server.get_bound_port(), flush=True)
    GLib.MainLoop().run()


if __name__ == '__main__':
    main()
