# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Between ROS and the core: parameters, topics, messages and diagnostics of the node."""
