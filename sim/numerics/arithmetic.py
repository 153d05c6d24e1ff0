"""Arithmetic that the kernels share: a bound of rounding, the largest of an array, a copy; and arrays for it."""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
from numba import types
from numpy.typing import DTypeLike, NDArray

from stickslip.sim.kernels.compile import inner
from stickslip.sim.kernels.emit import emitted
from stickslip.sim.kernels.emit import room as room
from stickslip.sim.numerics.arguments import Floats

#: A bound of the rounding of a sum, relative to the sum of the magnitudes of its terms
ROUNDING = 32 * np.finfo(np.float64).eps
_LINE = 64  # the bytes of a line of the cache

Entry = TypeVar("Entry", bound=np.generic)


def aligned_zeros(shape: tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Zeros that begin with a line of the cache: a load of eight numbers then never takes two lines.

    Products of K took 17% longer with arrays where numpy puts them (n = 200, AVX-512).
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    room = np.zeros(size + _LINE, np.uint8)
    first = -room.__array_interface__["data"][0] % _LINE
    return room[first : first + size].view(dtype).reshape(shape)


#: The 64 bits of a float64 as an integer, of floats >= 0 in the order of the floats; and the float64 with such bits.
_bits = emitted(lambda code, x: code.word(x), types.int64)
_as_float = emitted(lambda code, word: code.number(word), types.float64)


@inner
def largest(x: Floats) -> float:
    """max |x_i|, NaN if there is one: by their bits, since a maximum of floats does not vectorise."""
    most = np.int64(0)
    for i in range(len(x)):
        bits = _bits(abs(x[i]))
        most = bits if bits > most else most
    return _as_float(most)


@inner
def copy(source: NDArray[Entry], target: NDArray[Entry]) -> None:
    """target = source: as a loop, since an assignment of arrays takes ten times as long to compile."""
    for i in range(len(source)):
        target[i] = source[i]
