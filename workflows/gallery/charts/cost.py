"""The unit in which charts count cost, which holds on any machine: one product of K with a vector."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from timeit import Timer
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import sparray

#: A batch of products takes about so many seconds: long beside the clock, short beside the machine's moods.
_BATCH, _BATCHES = 3e-4, 5

Found = TypeVar("Found")


class Product:
    """One product of a matrix with a vector (float64), by numpy, or by SciPy if it is sparse."""

    def __init__(self, matrix: NDArray[np.float64] | sparray) -> None:
        n = matrix.shape[0]
        statement, names = "matrix @ x", {"matrix": matrix, "x": np.ones(n)}
        if isinstance(matrix, np.ndarray):
            statement = "dot(matrix, x, out=out)"
            names |= {"dot": np.dot, "matrix": np.ascontiguousarray(matrix), "out": np.empty(n)}
        self._timer, self._n = Timer(statement, globals=names), 16
        while (seconds := self._timer.timeit(self._n)) < _BATCH:
            self._n = max(2 * self._n, int(self._n * _BATCH / max(seconds, 1e-9)))

    def seconds(self) -> float:
        """Seconds of one product, now: the median of a few batches."""
        return median(self._timer.repeat(_BATCHES, self._n)) / self._n


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Wall times of runs in seconds, and in products of the same moment: medians, with the least and the most.

    Null where nothing ran; `products` where no product was measured.
    """

    n_runs: int = 0
    seconds: float | None = None
    seconds_min: float | None = None
    seconds_max: float | None = None
    product_seconds: float | None = None
    products: float | None = None
    products_min: float | None = None
    products_max: float | None = None


def timed(
    run: Callable[[], Found], product: Product | None, repeats: int, longest: float = math.inf
) -> tuple[Found, Timing]:
    """The last result of repeated runs, and their times, each between two measurements of the product, if any.

    A run that takes more than `longest` seconds is the last.
    """
    times: list[float] = []
    units: list[float] = []
    while not times or (len(times) < repeats and times[-1] <= longest):
        cost_before = product.seconds() if product else 0.0
        start = time.perf_counter()
        result = run()
        times.append(time.perf_counter() - start)
        units += [0.5 * (cost_before + product.seconds())] if product else []
    costs = [seconds / unit for seconds, unit in zip(times, units, strict=bool(product))]
    spread = {
        f"{name}{end}": of(values)
        for name, values in (("seconds", times), ("products", costs))
        for end, of in (("", median), ("_min", min), ("_max", max))
        if values
    }
    return result, Timing(n_runs=len(times), product_seconds=median(units) if units else None, **spread)
