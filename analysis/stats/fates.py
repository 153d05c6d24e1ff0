"""Fates of runs, and how long motion lasts.

A collapse is one that is certified. A run whose blocks all slip for the last quarter without a certificate is kept
apart as silent: such runs have been seen to stick again after thousands of units. A runaway is a fate of its own and
never a collapse. The fates compete: the share that has met one of them by t is the cumulative incidence of Aalen and
Johansen (1978, Scand. J. Statist. 5, 141),

    C_k(t) = sum over times s <= t of S(s-) d_k(s) / r(s),

d_k(s) the runs that meet fate k at s, r(s) those still in motion and watched, S Kaplan and Meier's survival.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats import student
from stickslip.analysis.stats.compare import wilson
from stickslip.analysis.stats.estimates import Estimate

COLLAPSED, SILENT, DIVERGED, SUSTAINED, FAILED = "collapsed", "silent", "diverged", "sustained", "failed"
ENDS = (COLLAPSED, SILENT, DIVERGED)
QUIET_SHARE = 0.25  # of a run: silent if nothing changes in this last part of it


@dataclass(frozen=True)
class Curve:
    """Survival of self-sustained motion and the cumulative incidence of each end.

    Attributes
    ----------
    t : ndarray, shape (m,)
        0 and the times of ends, ascending; every value holds from its time on.
    survival, low, high : ndarray, shape (m,)
        Of `kaplan_meier`.
    incidence : dict of str to ndarray, shape (m,)
        By end, one of `ENDS`; with the survival they add up to one.
    """

    t: np.ndarray
    survival: np.ndarray
    low: np.ndarray
    high: np.ndarray
    incidence: dict[str, np.ndarray]


def survival(times: np.ndarray, ends: Sequence[str], confidence: float) -> Curve:
    """Survival curve of independent runs.

    Parameters
    ----------
    times : array_like, shape (m,)
        When motion ended, or when the run was last seen in motion.
    ends : sequence of str
        `COLLAPSED`, `SILENT` or `DIVERGED`; anything else is censored at its time.
    confidence : float

    Raises
    ------
    ValueError
        If there are no runs or the lengths differ.
    """
    at, how = np.asarray(times, dtype=np.float64), np.asarray(ends, dtype=object)
    if at.ndim != 1 or at.shape != how.shape or not len(at):
        raise ValueError(f"times, ends: expected two non-empty arrays of one length, got {at.shape} and {how.shape}")
    by_end = {end: at[how == end] for end in ENDS}
    t, alive, low, high = kaplan_meier(at, np.isin(how, ENDS), confidence)
    before = np.concatenate(([1.0], alive[:-1]))
    hazard = before / np.maximum(_at_risk(at, t), 1)
    incidence = {end: np.cumsum(hazard * _at(some, t)) for end, some in by_end.items()}
    return Curve(t, alive, low, high, incidence)


def kaplan_meier(
    times: np.ndarray, ended: np.ndarray, confidence: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
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
    t = np.concatenate(([0.0], np.unique(times[ended])))
    n_at_risk = _at_risk(times, t)
    n_stay = n_at_risk - _at(times[ended], t)
    share = np.cumprod(n_stay / np.maximum(n_at_risk, 1))
    with np.errstate(divide="ignore", invalid="ignore"):  # where there is no width
        variance = np.cumsum((n_at_risk - n_stay) / (n_at_risk * n_stay))
        half = student.half_width(confidence, np.inf) * np.sqrt(variance) / np.log(share)
        low, high = share ** np.exp(-half), share ** np.exp(half)
    for k in np.flatnonzero((share == 0) | (share == 1)):
        low[k], high[k] = wilson(share[k] * len(times), len(times), confidence)
    return t, share, low, high


def _at_risk(times: np.ndarray, t: np.ndarray) -> np.ndarray:
    """How many of the times are not before each t."""
    return (len(times) - np.searchsorted(np.sort(times), t, side="left")).astype(np.float64)


def _at(times: np.ndarray, t: np.ndarray) -> np.ndarray:
    """How many of the times are each t."""
    listed = np.sort(times)
    return np.searchsorted(listed, t, side="right") - np.searchsorted(listed, t, side="left")


def median(t: np.ndarray, share: np.ndarray, low: np.ndarray, high: np.ndarray) -> Estimate:
    """Time by which half have ended, of what `kaplan_meier` returns; None where half are never seen to.

    The interval holds the times of ends at which that of the share contains one half (Brookmeyer and Crowley 1982,
    Biometrics 38, 29); an end of it that the data do not reach is None.
    """

    def first(below: np.ndarray) -> float | None:
        return float(t[1:][np.argmax(below)]) if below.any() else None

    value = first(share[1:] <= 0.5)
    reason = "fewer than half have ended" if value is None else ""
    return Estimate(value, first(low[1:] <= 0.5), first(high[1:] < 0.5), reason)


def fate(outcome: str, series: tuple[np.ndarray, np.ndarray] | None, t_end: float) -> str:
    """Fate of a run, from its outcome and, if it finished, from the last of its change points."""
    if outcome != "finished" or series is None:
        return {"collapsed": COLLAPSED, "diverged": DIVERGED}.get(outcome, FAILED)
    t, n_stick = series
    return SILENT if n_stick[-1] == 0 and t[-1] <= (1 - QUIET_SHARE) * t_end else SUSTAINED
