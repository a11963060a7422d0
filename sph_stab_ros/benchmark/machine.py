# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What timings depend on besides the code."""

import os
from pathlib import Path
import platform
from typing import Any

import cv2
import numpy as np
import scipy

# Of the pictures that are timed.
MAX_WIDTH = 7680


def machine() -> dict[str, Any]:
    """Return what the figures depend on besides the code."""
    model = platform.processor()
    if Path('/proc/cpuinfo').exists():
        names = [line.partition(':')[2].strip()
                 for line in Path('/proc/cpuinfo').read_text().splitlines()
                 if line.startswith('model name')]
        model = names[0] if names else model
    return {'cpu': model, 'cores': os.cpu_count(), 'opencv_threads': cv2.getNumThreads(),
            'load_before': os.getloadavg()[0], 'system': platform.platform(terse=True),
            'python': platform.python_version(), 'opencv': cv2.__version__,
            'numpy': np.__version__, 'scipy': scipy.__version__}
