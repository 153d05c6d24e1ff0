"""The unit in which charts count cost, which holds on any machine: one product of K with a vector."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from statistics import median
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

#: A batch of products takes about so many seconds: long beside the clock, short beside the machine's moods.
_BATCH, _BATCHES = 3e-4, 5

Found = TypeVar("Found")


class Product:
    """One product of a matrix with a vector, by numpy (float64)."""

    def __init__(self, matrix: NDArray[np.float64]) -> None:
        n = len(matrix)
        self._matrix, self._x, self._out = np.ascontiguousarray(matrix), np.ones(n), np.empty(n)
        self._n = 16
        while (seconds := self._batch()) < _BATCH:
            self._n = max(2 * self._n, int(self._n * _BATCH / max(seconds, 1e-9)))

    def _batch(self) -> float:
        matrix, x, out = self._matrix, self._x, self._out
        start = time.perf_counter()
        for _ in range(self._n):
            np.dot(matrix, x, out=out)
        return time.perf_counter() - start

    def seconds(self) -> float:
        """Seconds of one product, now: the median of a few batches."""
        return median(self._batch() for _ in range(_BATCHES)) / self._n


class Timing(NamedTuple):
    """Wall times of runs in seconds, and in products of the same moment: medians, with the least and the most."""

    n_runs: int
    seconds: float
    seconds_min: float
    seconds_max: float
    product_seconds: float | None
    products: float | None
    products_min: float | None
    products_max: float | None


def timed(
    run: Callable[[], Found], product: Product | None, repeats: int, longest: float = math.inf
) -> tuple[Found, Timing]:
    """The last result of repeated runs, and their times, each between two measurements of the product, if any.

    A run that takes more than `longest` seconds is the last.
    """
    times: list[float] = []
    units: list[float] = []
    while True:
        cost_before = product.seconds() if product else 0.0
        start = time.perf_counter()
        result = run()
        times.append(time.perf_counter() - start)
        units += [0.5 * (cost_before + product.seconds())] if product else []
        if len(times) >= repeats or times[-1] > longest:
            break
    costs = [seconds / unit for seconds, unit in zip(times, units, strict=True)] if units else []
    in_products = (median(units), median(costs), min(costs), max(costs)) if units else (None,) * 4
    return result, Timing(len(times), median(times), min(times), max(times), *in_products)
