#!/bin/bash
# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
#
# Build sdist and wheel into dist/, install the wheel and then the sdist each into a bare environment,
# the sdist without a compiler too, and stabilise some frames of a recording with each.
# usage: check_packages.sh [PYTHON], which needs the module build

set -euo pipefail
cd "$(dirname "$0")/.."
python=${1:-python3}
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

rm -rf dist
"$python" -m build --outdir dist . > "$scratch/build.log" 2>&1 || { cat "$scratch/build.log"; exit 1; }
ls -l dist

check() {
  name=$1 package=$2
  "$python" -m venv "$scratch/$name"
  "$scratch/$name/bin/pip" install --quiet "$package"
  # Away from the sources, which would be imported instead.
  (
    cd "$scratch"
    "$name/bin/replay" "$OLDPWD/bags/drone" --trajectory "$name.tum" --max-frames 5
    test "$(wc -l < "$name.tum")" = 5
    "$name/bin/python" -c "
from sph_stab_ros import kernels
print('$name: kernels are', 'compiled' if kernels.library else 'in NumPy')"
  )
}

check wheel dist/*.whl
check sdist dist/*.tar.gz
CC=/nonexistent/compiler check sdist_without_compiler dist/*.tar.gz
