# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A simulated world with exact truth: flights, a quick renderer, recordings."""
