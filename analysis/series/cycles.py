"""Cycles of a map, from the points of an orbit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

#: A cycle is seen once it has come round so often.
_ROUNDS = 3


def period(points: ArrayLike, tolerance: float, most: int) -> int | None:
    """Length of the cycle that an orbit ends in; None if it is in none, of at most so many points.

    Parameters
    ----------
    points : array_like, shape (m,) or (m, k)
        The orbit, in order.
    tolerance : float
        Points that differ by less, in every coordinate, are one.
    most : int
    """
    orbit = np.asarray(points, dtype=np.float64)
    for length in range(1, min(most, len(orbit) // _ROUNDS) + 1):
        rounds = orbit[len(orbit) - _ROUNDS * length :]
        if (np.abs(rounds[length:] - rounds[:-length]) < tolerance).all():
            return length
    return None


def slope(step: Callable[[float], float], at: float, width: float) -> float:
    """Derivative of a map of a number by central differences; of a cycle, their product is its multiplier."""
    return (step(at + width) - step(at - width)) / (2 * width)
