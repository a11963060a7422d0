#!/bin/bash
# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
#
# Build a virtual environment that holds the package (editable), ROS 2, colcon and the test tools.
# usage: setup_venv.sh VENV CONSTRAINTS PYTHON

set -euo pipefail
venv=$1 constraints=$2 python=$3

fail() {
  echo "setup: $1" >&2
  exit 1
}

cd "$(dirname "$0")/.."
command -v "$python" > /dev/null || fail "there is no $python here; name another with PYTHON=..."
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
  fail "$python is Python $version, 3.10 or newer is needed; name another with PYTHON=..."
"$python" -c 'import ensurepip, venv' 2> /dev/null ||
  fail "$python lacks the venv module; on Debian and Ubuntu: sudo apt install python3-venv"
if grep -q '^numpy==1' "$constraints"; then
  "$python" -c 'import sys; sys.exit(sys.version_info >= (3, 13))' ||
    fail "NumPy 1.26 has no wheels for Python $version; name a 3.10 to 3.12 with PYTHON=..."
fi

echo "Building $venv with Python $version (a download of 220 MB, 1.1 GB on disk) ..."
export PIP_DISABLE_PIP_VERSION_CHECK=1
"$python" -m venv --clear "$venv"
pip=("$venv/bin/python" -m pip install --quiet --constraint "$constraints")
"${pip[@]}" setuptools wheel
# Without isolation the build uses the pinned setuptools instead of fetching the newest one.
"${pip[@]}" --no-build-isolation --editable '.[cluster,datagrams,operator,plots,ros,test,video]'

if ! "$venv/bin/python" -c 'import rclpy' 2> /dev/null; then
  echo "setup: no wheels of ROS 2 for $(uname -sm): everything works except the node and player;" \
    'for these install ROS 2 Jazzy and build with colcon' >&2
fi
touch "$venv/complete"
