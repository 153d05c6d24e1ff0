"""The rule for multiple comparisons."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np


def holm(p: Sequence[float]) -> np.ndarray:
    """p-values adjusted by Holm's step-down rule: the family-wise error is at most alpha where adjusted p < alpha."""
    values = np.asarray(p, dtype=np.float64)
    order = np.argsort(values, kind="stable")
    steps = np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1))
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(steps, 1.0)
    return adjusted


def together(p_values: Iterable[float | None]) -> list[float | None]:
    """p-values of comparisons that are made together, by Holm's rule; one that has none is no comparison."""
    alone = list(p_values)
    adjusted = iter(holm([p for p in alone if p is not None]).tolist())
    return [None if p is None else next(adjusted) for p in alone]
