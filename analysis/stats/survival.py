"""The share that has not ended by a time, where some were only followed for a while: Kaplan and Meier."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from scipy import special

from stickslip.analysis.stats import student
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.stats.shares import Scatter, wilsons

SHARE_ROUNDING = 1e-9  # of a product of shares, such as 5/6 4/5 3/4, which is one half
ROUNDING = 1e-12  # of a sum over units, relative to its terms

#: Result of `kaplan_meier`: times, share that has not ended, lower and upper end of its interval, each (m,); the
#: values hold from their time on.
Curve = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def kaplan_meier(times: np.ndarray, ended: np.ndarray, confidence: float, units: np.ndarray | None = None) -> Curve:
    """Share that has not ended by a time, with Wilson's interval for an effective number of runs.

    The number is that of a share which scatters as far as Greenwood's formula says (Rothman 1978): all, if none is
    censored before the last end. Of runs of the same unit, which are not independent, it is that of
    `shares.share_over_matrices`: whatever did not end is then to be followed until the last end.

    Parameters
    ----------
    times : ndarray, shape (m,), float64
    ended : ndarray, shape (m,), bool
        Whether it ended then, or was only followed until then (censored).
    units : ndarray of int, shape (m,), optional
        The unit of each; left out, each is one by itself.

    Returns
    -------
    t, share, low, high : ndarray
        Values from time 0 and from the time of each end on.
    """
    t, n_at_risk, n_ends, share = risks(times, ended)
    if units is not None and not pd.Index(units).is_unique:
        trials = _scatter(t, share, times, ended, units).at(student.half_width(confidence, np.inf))
    else:
        with np.errstate(divide="ignore", invalid="ignore"):  # a share of 0 or 1 does not scatter
            variance = np.cumsum(n_ends / (n_at_risk * (n_at_risk - n_ends)))  # over the share squared
            trials = np.where((share > 0) & (share < 1), (1 - share) / (share * variance), len(times))
    return t, share, *wilsons(share, trials, confidence)


def risks(times: np.ndarray, ended: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time 0 and each time of an end; how many are at risk then, how many end, and the share left from then on.

    The parameters are those of `kaplan_meier`.
    """
    t = np.union1d(0.0, times[ended])  # an end may be at 0
    n_at_risk = (len(times) - np.searchsorted(np.sort(times), t, side="left")).astype(np.float64)
    at_end = np.sort(times[ended])
    n_ends = np.searchsorted(at_end, t, side="right") - np.searchsorted(at_end, t, side="left")
    return t, n_at_risk, n_ends, np.cumprod((n_at_risk - n_ends) / np.maximum(n_at_risk, 1))


def _scatter(t: np.ndarray, share: np.ndarray, times: np.ndarray, ended: np.ndarray, units: np.ndarray) -> Scatter:
    """How far units scatter about the share left at each t."""
    place = np.unique(units, return_inverse=True)[1]
    n_of, in_time = np.bincount(place).astype(np.float64), np.argsort(times[ended], kind="stable")
    of_end = place[ended][in_time]
    order = np.argsort(of_end, kind="stable")
    group_start = np.searchsorted(of_end[order], of_end[order])
    n_before = np.empty(len(order))
    n_before[order] = np.arange(len(order)) - group_start  # ends of the same unit before each
    n_left = n_of[of_end] - n_before
    n_ends = np.searchsorted(times[ended][in_time], t, side="right")

    def moved(power: int) -> np.ndarray:
        """The sum over units of what each moves the share by, to a power."""
        total = np.zeros(len(t))
        for k in range(power + 1):  # what is left to the power k, from each end on
            falls = ((n_left - 1.0) ** k - n_left**k) * n_of[of_end] ** (power - k)
            sums = np.append(0.0, np.cumsum(falls))[n_ends] + np.sum(n_of**power)
            total += special.binom(power, k) * (-share) ** (power - k) * sums
        return np.where(total > ROUNDING * np.sum(n_of**power), total, 0.0) / float(len(times)) ** power

    squares, fourths = moved(2), moved(4)
    concentration = np.divide(fourths, squares**2, out=np.zeros(len(t)), where=squares > 0)
    return Scatter.of(share, squares, concentration, n_of, float(len(times)))


def median_of_known(times: np.ndarray, confidence: float, units: np.ndarray | None = None) -> Estimate:
    """Median of times that nothing cuts off, with the interval of `median`; of two middle ones it is their mean."""
    half = median(times, np.full(len(times), True), confidence, units)
    return replace(half, value=float(np.median(times)))


def median(times: np.ndarray, ended: np.ndarray, confidence: float, units: np.ndarray | None = None) -> Estimate:
    """Time by which half have ended, by Kaplan and Meier; None if fewer than half are seen to end.

    Of an even number it is the lower of the two middle times. The interval is one of order statistics, the k-th
    smallest time to the k-th largest, with the largest k for which P(B < k) <= (1 - confidence) / 2, B being binomial
    with as many trials as there are times and the chance 1/2. It covers with at least the confidence for any law of
    the times; at 95% it takes six of them. For its lower end what was censored counts as ended then, for its upper
    end as never ended, so it holds whatever censored them. An end that the data do not reach is None. If units have
    several runs, it is from when on, and until when, the interval of the share of either holds one half.

    Parameters
    ----------
    times, ended, confidence, units
        As in `kaplan_meier`.
    """
    if not len(times):
        return Estimate(reason="nothing was followed")
    t, share, _, _ = kaplan_meier(times, ended, confidence)
    is_reached = (share <= 0.5 + SHARE_ROUNDING) & (share < 1)  # before the first end nothing counts
    value = float(t[np.argmax(is_reached)]) if is_reached.any() else None
    reason = "fewer than half have ended" if value is None else ""
    never = np.where(ended, times, np.inf)
    if units is not None and not pd.Index(units).is_unique:
        t, _, below, _ = kaplan_meier(times, np.ones(len(times), dtype=bool), confidence, units)
        until, _, _, above = kaplan_meier(never, ended, confidence, units)
        below_half, above_half = np.flatnonzero(below <= 0.5), np.flatnonzero(above > 0.5)
        n_above = int(above_half[-1]) + 1 if len(above_half) else 0
        ends = (
            float(t[below_half[0]]) if len(below_half) else None,
            float(until[n_above]) if n_above < len(until) else None,
        )
        return Estimate(value, *ends, reason)
    k = int(np.sum(special.bdtr(np.arange(len(times)), len(times), 0.5) <= (1 - confidence) / 2))
    low = float(np.sort(times)[k - 1]) if k else None
    high = float(np.sort(never)[-k]) if k else np.inf
    return Estimate(value, low, high if np.isfinite(high) else None, reason)
