"""How long runs take to leave, by the size of what was changed; runs that end in motion are censored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats.compare import wilson
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.stats.fates import Curve, median, survival


@dataclass(frozen=True)
class Escape:
    """Escape of the runs of one size.

    Attributes
    ----------
    size : float
    curve : Curve
        Survival with interval and incidence by end.
    median : Estimate
        Time by which half have left. An end that is not reached in the data is None, and low without high is a lower
        bound.
    share : Estimate
        Runs that left while they were watched, with Wilson's interval.
    """

    size: float
    curve: Curve
    median: Estimate
    share: Estimate


def by_size(sizes: Sequence[float], times: np.ndarray, ends: Sequence[str], confidence: float) -> list[Escape]:
    """Escape times by size, ascending; the runs of one size are independent (one a matrix).

    The interval of the median holds the times at which the interval of the survival contains one half (Brookmeyer and
    Crowley 1982, Biometrics 38, 29).

    Parameters
    ----------
    sizes : sequence of float, shape (m,)
    times, ends : shape (m,)
        As `fates.survival` takes them: what is no end is censored.
    confidence : float

    Raises
    ------
    ValueError
        If there are no runs or the lengths differ.
    """
    of_size, at, how = (
        np.asarray(sizes, dtype=np.float64),
        np.asarray(times, dtype=np.float64),
        np.asarray(ends, object),
    )
    if not len(at) or not of_size.shape == at.shape == how.shape:
        raise ValueError(f"sizes, times, ends: expected one length > 0, got {len(of_size)}, {len(at)}, {len(how)}")
    found = []
    for size in np.unique(of_size):
        some = of_size == size
        curve = survival(at[some], list(how[some]), confidence)
        low, high = wilson(curve.n_ends, curve.n_runs, confidence)
        found.append(Escape(float(size), curve, median(curve), Estimate(curve.n_ends / curve.n_runs, low, high)))
    return found
