"""Cycles of a map, from the points of an orbit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

#: How often a cycle must come round to be accepted.
_ROUNDS = 3


def period(points: ArrayLike, tolerance: float, most: int) -> int | None:
    """Length of the cycle in which an orbit ends; None if it is in no cycle of at most `most` points.

    Parameters
    ----------
    points : array_like, shape (m,) or (m, k)
        The orbit, in order.
    tolerance : float
        Points that differ by less in every coordinate count as the same.
    most : int
    """
    orbit = np.asarray(points, dtype=np.float64)
    for length in range(1, min(most, len(orbit) // _ROUNDS) + 1):
        rounds = orbit[len(orbit) - _ROUNDS * length :]
        if (np.abs(rounds[length:] - rounds[:-length]) < tolerance).all():
            return length
    return None


def slope(step: Callable[[float], float], at: float, width: float) -> float:
    """Derivative of a scalar map by central differences; the product along a cycle is the cycle's multiplier."""
    return (step(at + width) - step(at - width)) / (2 * width)
