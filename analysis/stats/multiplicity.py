"""One rule for many comparisons.

Primary questions are declared beforehand, in order, and tested in that order, each at the full level, until one is
not rejected: the family-wise error is at most alpha (Maurer, Hothorn and Lehmacher 1995). What else is looked at is a
second family, under Holm's rule, with its own error of at most alpha. A finding there is a hint, whatever the first
family says.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def adjusted(primary: Sequence[float], others: Sequence[float] = ()) -> tuple[np.ndarray, np.ndarray]:
    """p-values that may be held against alpha as they are.

    Of the primary ones, in the declared order, the largest so far; of the others Holm's.
    """
    return np.maximum.accumulate(np.asarray(primary, dtype=np.float64)), holm(others)


def holm(p: Sequence[float]) -> np.ndarray:
    """p-values adjusted by Holm's step-down rule: the family-wise error is at most alpha where adjusted p < alpha."""
    values = np.asarray(p, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    steps = np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1))
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(steps, 1.0)
    return adjusted
