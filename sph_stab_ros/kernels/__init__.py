# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The inner loops of the tracker, the warp and videos' colours, built where there is a C compiler.

The Python functions that call them have the same in NumPy, for elsewhere. Called by ctypes: no
other thread waits for them, and they need neither Python's headers nor another package.
"""

import ctypes
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class _Array:
    """Passes arrays by address, dense and in C order: one that is not is copied to be read."""

    _ANYTHING = ctypes.c_char * 0

    def __init__(self, dtype: DTypeLike, written: bool = False) -> None:
        self._dtype, self._written = dtype, written

    def __call__(self, array: NDArray[Any]) -> Any:
        dense: Any = np.ascontiguousarray(array, self._dtype)
        if self._written and dense is not array:
            raise TypeError('only dense arrays of the right type can be written to')
        if not dense.flags.writeable:
            return dense.ctypes.data_as(ctypes.c_void_p)
        # A third of the time that ndarray.ctypes takes.
        return ctypes.byref(self._ANYTHING.from_buffer(dense))


# What a letter stands for. Capitals are written to.
_TYPES: dict[str, Any] = {
    'b': _Array(np.uint8), 'd': _Array(np.float64), 'f': _Array(np.float32),
    'l': _Array(np.int64), 'B': _Array(np.uint8, True), 'D': _Array(np.float64, True),
    'F': _Array(np.float32, True),
    'i': ctypes.c_int, 'x': ctypes.c_float, 'y': ctypes.c_double,
}
# As in kernels.c.
MAX_CELL, MAX_CHANNELS = 8, 4
# As the functions there take them.
_ARGUMENTS = {
    'equirect_pixels': 'ifffiFF',
    'doubled': 'iibB',
    'warp_equirect': 'iiffbfffiiibiiB',
    'read_pixels': 'ibiiffF',
    'settle_patches': 'ilddddbiiifffiixixxxDFF',
    'pose_residuals': 'idddddddD',
    'fit_pose': 'idddddddyiiyyyiyyyDDDDDDDD',
    'fit_depths': 'iddddddiyddD',
    'bundle_residuals': 'illlddddddD',
    'bundle_equations': 'iiilllldddddddDDDDD',
}


class _Function:
    """
    A function of the library, with its arguments' types by letters.

    ctypes would convert arguments too, but make another exception of a Ctrl-C meanwhile.
    """

    def __init__(self, function: Any, letters: str) -> None:
        function.restype = None
        self._function, self._types = function, [_TYPES[letter] for letter in letters]

    def __call__(self, *arguments: Any) -> None:
        self._function(*[as_type(one) for as_type, one
                         in zip(self._types, arguments, strict=True)])


def _load() -> Any:
    """Return the library's functions, None where it was not built."""
    spec = find_spec('sph_stab_ros.kernels._kernels')
    if spec is None:
        return None
    functions = ctypes.CDLL(spec.origin)
    return SimpleNamespace(**{name: _Function(getattr(functions, name), letters)
                              for name, letters in _ARGUMENTS.items()})


library = _load()
