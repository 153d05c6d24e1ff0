"""Whether runs suffice to judge a statistic that assumes a steady state: one of a closed set of codes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.series.windows import Windows
from stickslip.analysis.stats.compare import Compared
from stickslip.analysis.stats.estimates import Estimate, Statistic, Undefined, jackknife

CODES = ("enough", "few matrices", "few cascades", "drifts", "drift unknown", "few blocks")
ENOUGH, FEW_MATRICES, FEW_CASCADES, DRIFTS, DRIFT_UNKNOWN, FEW_BLOCKS = CODES
JUDGED = (ENOUGH, DRIFT_UNKNOWN)
LEAST_MATRICES = 4  # with fewer, a jackknife-t interval has two degrees of freedom or less; from 4 on it covers
LEAST_CASCADES = 200  # in all runs: gamma is then known to about a tenth
#: Harmless drift of the mean from half to half, in standard deviations of n_stick in time: a steady drift of d adds
#: d^2 / 3 to the variance, 2% at 0.25. That is below the error of a variance from 1,000 independent samples, 4%.
MARGIN = 0.25


@dataclass(frozen=True)
class Basis:
    """Whether the data suffice.

    Attributes
    ----------
    code : str
        The first of `CODES` after `ENOUGH` that applies, else `ENOUGH`; the last one is set by `Group.basis`.
    n_matrices, n_cascades : int
    drift : Estimate
        Mean n_stick of the second half of the window minus that of the first, in standard deviations of n_stick in
        time, with a jackknife-t interval over matrices.
    """

    code: str
    n_matrices: int
    n_cascades: int
    drift: Estimate


def halves(runs: Windows, period: np.ndarray) -> np.ndarray:
    """Time means of n_stick in the first and the second half, and its variance in time, shape (R, 3).

    `period` as of `over_periods`.
    """
    return np.column_stack([over_periods(runs, period, runs.means(2), 0.5, np.floor), runs.variance])


def over_periods(
    runs: Windows, period: np.ndarray, means: np.ndarray, share: float, rounded: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Time means of n_stick in the first part and in the last half of each window, over whole periods of a force.

    What a force drives has another mean in a part of its period than in the rest, at the same phase in all systems:
    that is no drift. As in `means` where no period is known, or the window has not two of them.

    Parameters
    ----------
    period : ndarray, shape (R,)
        Of the force on each run, NaN where none is known.
    means : ndarray, shape (R, 2)
    share : float
        Of the window that is its first part.
    rounded : callable
        How the number of periods of the first part is rounded.
    """
    (driven,) = np.nonzero(runs.span >= 2.0 * period)
    if len(driven):
        n_periods, length = runs.span[driven] / period[driven], period[driven]
        first, last = length * rounded(share * n_periods), length * np.floor(n_periods / 2)
        means[driven] = runs.take(driven).means_of_ends(first, last)
    return means


def _drift(sums: np.ndarray) -> np.ndarray:
    if (sums[:, 2] <= 0).any():
        raise Undefined("n_stick does not change")
    # summed over G rows, the difference and the variance are each G times their mean
    return (sums[:, 1] - sums[:, 0]) / np.sqrt(sums[:, 2] * sums[:, 3])


def basis(rows: np.ndarray, n_cascades: int, confidence: float, of: Statistic = _drift) -> Basis:
    """Whether there are enough matrices and cascades, and no drift.

    Drift is excluded where one-sided tests exclude one beyond `MARGIN`, shown where there is a drift and the
    estimate is beyond `MARGIN`, and unknown otherwise.

    Parameters
    ----------
    rows : ndarray, shape (G, c)
        `halves`, or the columns that `of` takes; one row a matrix.
    n_cascades : int
        Complete cascades of all runs.
    of : callable
        Computes the drift from summed rows, whose last column is their number.
    """
    g = len(rows)
    if g < 2:
        return Basis(FEW_MATRICES, g, n_cascades, Estimate(reason="fewer than two matrices"))
    try:
        value, error = jackknife(of, np.column_stack([rows, np.ones(g)]))
    except Undefined as undefined:
        return Basis(FEW_CASCADES, g, n_cascades, Estimate(reason=str(undefined)))
    test = Compared(value, error, g - 1)
    low, high = test.interval(confidence)
    drift = Estimate(value, low, high)
    is_within = all(abs(end) < MARGIN for end in test.interval(2 * confidence - 1))  # as two one-sided tests
    is_beyond = not low <= 0.0 <= high and abs(value) > MARGIN
    if g < LEAST_MATRICES:
        code = FEW_MATRICES
    elif n_cascades < LEAST_CASCADES:
        code = FEW_CASCADES
    else:
        code = ENOUGH if is_within else DRIFTS if is_beyond else DRIFT_UNKNOWN
    return Basis(code, g, n_cascades, drift)
