"""The quantities of a run's window: each has two sums, which add over runs and matrices, and a statistic of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.series.windows import Windows
from stickslip.analysis.stats.effective import correlation_times
from stickslip.analysis.stats.estimates import Statistic, gamma, ratio

Sums = Callable[[Windows], np.ndarray]  # of R runs, shape (R, 2)


def _once(of: Callable[[Windows], np.ndarray]) -> Sums:
    """A number of each run, and 1: their quotient is a mean over runs."""
    return lambda runs: np.column_stack([of(runs), np.ones(len(runs))])


def _cascades(runs: Windows) -> np.ndarray:
    run, depth = runs.falls
    return np.column_stack([np.bincount(run, depth, len(runs)), np.bincount(run, minlength=len(runs))])


def _correlation(runs: Windows) -> np.ndarray:
    taus = correlation_times(runs)  # of a window in which n_stick does not change there is none, which is not counted
    return np.column_stack([taus, taus > 0])


@dataclass(frozen=True)
class Quantity:
    """A quantity: its name for readers, its two sums over each window, and the statistic of the sums."""

    label: str
    sums: Sums
    of: Statistic = ratio


#: By the name under which a scene declares a margin.
QUANTITIES: Mapping[str, Quantity] = {
    "mean": Quantity("mean n_stick", _once(lambda runs: runs.mean)),
    "variance": Quantity("variance of n_stick in time", _once(lambda runs: runs.variance)),
    "rate": Quantity("exit rate", _once(lambda runs: runs.exits / runs.span)),
    "gamma": Quantity("gamma", _cascades, gamma),
    "correlation_time": Quantity("correlation time", _correlation),
}
