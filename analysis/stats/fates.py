"""Fates of runs, and how long motion lasts.

A collapse is one that is certified. A run whose blocks all slip for the last quarter without a certificate is kept
apart as silent: such runs have been seen to stick again after thousands of units. A runaway is a fate of its own and
never a collapse.
"""

from __future__ import annotations

import numpy as np

from stickslip.analysis.stats import student
from stickslip.analysis.stats.compare import wilson
from stickslip.analysis.stats.estimates import Estimate

COLLAPSED, SILENT, DIVERGED, SUSTAINED, FAILED = "collapsed", "silent", "diverged", "sustained", "failed"
ENDS = (COLLAPSED, SILENT, DIVERGED)
QUIET_SHARE = 0.25  # of a run: silent if no block sticks in this last part of it, held if all do throughout


#: Of `kaplan_meier`: times, share that has not ended, and the ends of its interval, each (m,), each from its time on.
Curve = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def kaplan_meier(times: np.ndarray, ended: np.ndarray, confidence: float) -> Curve:
    """Share that has not ended by a time, with Greenwood's interval on the log-log scale.

    Parameters
    ----------
    times : ndarray, shape (m,), float64
    ended : ndarray, shape (m,), bool
        Whether it ended then, or was only watched until then.
    confidence : float

    Returns
    -------
    t, share, low, high : ndarray
        From 0 and each time of an end on. Where the share is 0 or 1 that interval has no width, and Wilson's stands
        in its place.
    """
    t = np.union1d(0.0, times[ended])  # some may end at 0
    # how many are not before each t, and how many of them do not end then
    n_at_risk = (len(times) - np.searchsorted(np.sort(times), t, side="left")).astype(np.float64)
    at_end = np.sort(times[ended])
    n_stay = n_at_risk - (np.searchsorted(at_end, t, side="right") - np.searchsorted(at_end, t, side="left"))
    share = np.cumprod(n_stay / np.maximum(n_at_risk, 1))
    with np.errstate(divide="ignore", invalid="ignore"):  # where there is no width
        variance = np.cumsum((n_at_risk - n_stay) / (n_at_risk * n_stay))
        half = student.half_width(confidence, np.inf) * np.sqrt(variance) / np.log(share)
        low, high = share ** np.exp(-half), share ** np.exp(half)
    for k in np.flatnonzero((share == 0) | (share == 1)):
        low[k], high[k] = wilson(share[k] * len(times), len(times), confidence)
    return t, share, low, high


def median(t: np.ndarray, share: np.ndarray, low: np.ndarray, high: np.ndarray) -> Estimate:
    """Time by which half have ended, of what `kaplan_meier` returns; None where half are never seen to.

    The interval holds the times of ends at which that of the share contains one half (Brookmeyer and Crowley 1982,
    Biometrics 38, 29); an end of it that the data do not reach is None.
    """

    def first(below: np.ndarray) -> float | None:
        below = below & (share < 1)  # no end is at 0 otherwise
        return float(t[np.argmax(below)]) if below.any() else None

    value = first(share <= 0.5)
    reason = "fewer than half have ended" if value is None else ""
    return Estimate(value, first(low <= 0.5), first(high < 0.5), reason)


def fate(outcome: str, series: tuple[np.ndarray, np.ndarray] | None, t_end: float) -> str:
    """Fate of a run, from its outcome and, if it finished, from the last of its change points."""
    if outcome != "finished" or series is None:
        return {"collapsed": COLLAPSED, "diverged": DIVERGED}.get(outcome, FAILED)
    t, n_stick = series
    return SILENT if n_stick[-1] == 0 and t[-1] <= (1 - QUIET_SHARE) * t_end else SUSTAINED


def is_held(last: tuple[float, float], n: int, t_end: float) -> bool:
    """Whether all n blocks stick throughout the last quarter, from the last change point: t and n_stick.

    Such a run counts as in motion: a belt may load its blocks until one lets go. On a belt at rest it is at rest.
    """
    t, n_stick = last
    return n_stick == n and t <= (1 - QUIET_SHARE) * t_end
