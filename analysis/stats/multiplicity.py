"""The rule for multiple comparisons.

Primary questions are declared beforehand and tested in the declared order, each at the full level, until one is not
rejected: the family-wise error is at most alpha (Maurer, Hothorn and Lehmacher 1995). All other comparisons are a
second family, under Holm's rule, with an error of at most alpha of its own. A finding there is only a hint, whatever
the first family says.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def adjusted(primary: Sequence[float], others: Sequence[float] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Adjusted p-values of the primary comparisons and of the others, to be compared with alpha directly.

    A primary one becomes the largest up to it in the declared order; the others are adjusted by Holm's rule.
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
