"""Products of one matrix with several vectors at once.

One product is bound by memory: each entry of K is read for one multiplication. Several vectors share that read. K is
kept in panels of rows; the sums of a panel, for every vector, stay in registers while K streams by.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stickslip.sim.kernels.compile import inner
from stickslip.sim.kernels.emit import Array, Code, Index, emitted
from stickslip.sim.numerics.arguments import Ints
from stickslip.sim.numerics.arithmetic import aligned_zeros

#: Rows of a panel: sums of 8 float64 or 16 float32 fill two registers of AVX2 a vector.
HEIGHT, SINGLE_HEIGHT = 8, 16
#: The same for panels for two vectors, whose sums leave more registers.
PAIR_HEIGHT, SINGLE_PAIR_HEIGHT = 16, 32
#: Terms are summed in groups of so many, so that rounding does not grow with n.
SUMMED = 128
#: The error of (K x)_i in float32, relative to sum_j |K_ij| max |x|: roundings of K, x and their products, and of the
#: sum. With terms of random signs it was 0.05 of this at most, n = 48 to 3,000, with terms of one sign 0.4.
SINGLE_ERROR = 8 * float(np.finfo(np.float32).eps)
_SINGLE_MAX = float(np.finfo(np.float32).max)

Real = TypeVar("Real", np.float64, np.float32)


def panels(matrix: NDArray[np.float64], height: int, dtype: DTypeLike) -> NDArray[Any]:
    """A square matrix, or several, shape (..., n, n), in panels of `height` rows, each stored by columns.

    Rows of zeros are added to fill the last panel. Shape (..., number of panels, n, height).
    """
    *several, n, _ = matrix.shape
    stored, n_full = aligned_zeros((*several, -(-n // height), n, height), dtype), n // height
    if dtype == np.float32:  # what is beyond its range is not used, but infinity would be warned of
        matrix = np.clip(matrix, -_SINGLE_MAX, _SINGLE_MAX)
    if n_full:
        rows = matrix[..., : n_full * height, :].reshape(*several, n_full, height, n)
        stored[..., :n_full, :, :] = rows.swapaxes(-1, -2)
    if n % height:
        stored[..., n_full, :, : n % height] = matrix[..., n_full * height :, :].swapaxes(-1, -2)
    return stored


def _panel(n_vectors: int, height: int, single: bool, listed: bool = False) -> Any:
    """The code for some columns of one panel, from a `first` of m on.

    ``f(panels, p, x, y, first, m)`` adds rows p height ... of their K x_k to y_k, k < n_vectors. If `listed`, it is
    ``f(panels, p, x, y, first, m, columns)``, and they are those in these places of `columns`.
    """

    def multiply(
        code: Code, panels: Array, p: Index, x: Array, y: Array, m: Index, column: Callable[[Index], Index]
    ) -> None:
        sums = [code.cell(code.zeros(height, np.float32 if single else np.float64)) for _ in range(n_vectors)]
        first_row = p * (panels.shape[1] * height)

        def add(k: Index) -> None:
            j = column(k)
            entries = panels.load(first_row + j * height, height)
            for v, partial in enumerate(sums):
                factor = code.spread(x[x.shape[1] * v + j], height)
                partial.value = code.fused(entries, factor, partial.value)

        code.loop(m, add)
        for v, partial in enumerate(sums):
            place = y.shape[1] * v + p * height
            y.store(place, y.load(place, height) + partial.value)

    def of_all(code: Code, panels: Array, p: Index, x: Array, y: Array, first: Index, m: Index) -> None:
        multiply(code, panels, p, x, y, m, lambda k: first + k)

    def of_listed(
        code: Code, panels: Array, p: Index, x: Array, y: Array, first: Index, m: Index, columns: Array
    ) -> None:
        multiply(code, panels, p, x, y, m, lambda k: columns[first + k])

    return emitted(of_listed if listed else of_all)


def products(n_vectors: int, single: bool = False) -> Any:
    """For kernels: ``f(panels, x, y)`` makes y_k = K x_k for the `n_vectors` rows of x and y.

    x and y, shape (n_vectors, m), are as long as the panels are high, at least; panels are made by `panels` with
    `HEIGHT` and float64, or with `SINGLE_HEIGHT` and float32 if `single`.
    """
    panel = _panel(n_vectors, SINGLE_HEIGHT if single else HEIGHT, single)

    @inner
    def apply(panels: NDArray[Real], x: NDArray[Real], y: NDArray[Real]) -> None:
        n = panels.shape[1]
        y[:] = 0.0
        for p in range(len(panels)):
            for first in range(0, n, SUMMED):
                panel(panels, p, x, y, first, min(SUMMED, n - first))

    return apply


def listed_products(n_vectors: int, height: int, single: bool) -> Any:
    """For kernels: ``f(panels, x, y, columns, m)``, as `products`, but over the first m columns listed.

    x_j of a column that is not listed counts as zero; y alone is as long as the panels are high.
    """
    panel = _panel(n_vectors, height, single, listed=True)

    @inner
    def apply(panels: NDArray[Real], x: NDArray[Real], y: NDArray[Real], columns: Ints, m: int) -> None:
        y[:] = 0.0
        for p in range(len(panels)):
            for first in range(0, m, SUMMED):
                panel(panels, p, x, y, first, min(SUMMED, m - first), columns)

    return apply
