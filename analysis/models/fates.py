"""Fates of runs, and how long motion lasts.

Only two ends are certain: a collapse is certified, and a runaway left every bound. A run in which no block sticks
over the last quarter need not have ended, since such runs have stuck again after thousands of units. If the linear
growth rate of the state in which all blocks slip is positive, that state does not last: the run is in a lull, which
is part of its motion. If the rate is not positive or not known, the run is quiet: whether a block sticks again cannot
be told. A run in which all blocks stick from its start to its end has not moved, and is in no motion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import special

from stickslip.analysis.stats import student
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.stats.shares import Scatter, share_over_matrices, wilson, wilsons
from stickslip.sim.systems.sliding import RATE_ROUNDING

COLLAPSED, DIVERGED, SUSTAINED, LULL, QUIET, UNMOVED, FAILED = (
    "collapsed", "diverged", "sustained", "lull", "quiet", "unmoved", "failed",
)  # fmt: skip
ENDS = (COLLAPSED, DIVERGED)
MOVING = (SUSTAINED, LULL)
SETTLED = (COLLAPSED, QUIET)  # no block sticks at the end, either for good or as far as is known
WATCHED = (*ENDS, QUIET, *MOVING, UNMOVED)  # the fates of runs that did not fail
_CERTAIN = {"collapsed": COLLAPSED, "diverged": DIVERGED}  # by outcome
LAST_SHARE = 0.25  # last part of a run: lull or quiet if no block sticks in it, held if all stick throughout
SHARE_ROUNDING = 1e-9  # of a product of shares, such as 5/6 4/5 3/4, which is one half
ROUNDING = 1e-12  # of a sum over units, relative to its terms


#: A number, or one of each run.
Many = np.ndarray | float
#: Result of `kaplan_meier`: times, share that has not ended, lower and upper end of its interval, each (m,); the
#: values hold from their time on.
Curve = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def kaplan_meier(times: np.ndarray, ended: np.ndarray, confidence: float, units: np.ndarray | None = None) -> Curve:
    """Share that has not ended by a time, with Greenwood's interval on the log-log scale.

    Of runs of the same unit, which are not independent, the interval is Wilson's for an effective number of runs, as
    of `compare.share_over_matrices`: whatever did not end is then to be followed until the last end.

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
        Values from time 0 and from the time of each end on. Where the share is 0 or 1, Greenwood's interval has no
        width and Wilson's replaces it.
    """
    t, n_at_risk, n_ends, share = risks(times, ended)
    if units is not None and _are_shared(units):
        trials = _scatter(t, share, times, ended, units).at(student.half_width(confidence, np.inf))
        return t, share, *wilsons(share, trials, confidence)
    with np.errstate(divide="ignore", invalid="ignore"):  # where the interval has no width
        variance = np.cumsum(n_ends / (n_at_risk * (n_at_risk - n_ends)))
        half = student.half_width(confidence, np.inf) * np.sqrt(variance) / np.log(share)
        low, high = share ** np.exp(-half), share ** np.exp(half)
    for k in np.flatnonzero((share == 0) | (share == 1)):
        low[k], high[k] = wilson(share[k] * len(times), len(times), confidence)
    return t, share, low, high


def risks(times: np.ndarray, ended: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time 0 and each time of an end; how many are at risk then, how many end, and the share left from then on.

    The parameters are those of `kaplan_meier`.
    """
    t = np.union1d(0.0, times[ended])  # an end may be at 0
    n_at_risk = (len(times) - np.searchsorted(np.sort(times), t, side="left")).astype(np.float64)
    at_end = np.sort(times[ended])
    n_ends = np.searchsorted(at_end, t, side="right") - np.searchsorted(at_end, t, side="left")
    return t, n_at_risk, n_ends, np.cumprod((n_at_risk - n_ends) / np.maximum(n_at_risk, 1))


def _are_shared(units: np.ndarray) -> bool:
    """Whether a unit has several runs."""
    return not pd.Index(units).is_unique


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


class Survival(NamedTuple):
    """The share of runs that have not ended by a time, and when half of them have ended."""

    curve: Curve
    median: Estimate


def survival(
    fates: np.ndarray,
    t_last: np.ndarray,
    t_stop: np.ndarray,
    t_end: np.ndarray,
    confidence: float,
    units: np.ndarray | None = None,
) -> Survival:
    """`kaplan_meier` and `median` of the results of `ends_at`.

    Quiet runs count as ended at their last events: those that lack a certificate are no random part of all, and
    to censor them would be to say that they go on. The upper ends of intervals take them as not ended.

    Parameters
    ----------
    fates : ndarray of str, shape (m,)
        Fates of runs that did not fail.
    t_last, t_stop, t_end : ndarray, shape (m,)
        Of each run: its last event; when it was certified or left every bound; and the end that was asked for.
    units : ndarray of int, shape (m,), optional
        As in `kaplan_meier`.
    """
    (times, has_ended), is_quiet = ends_at(fates, t_last, t_stop, t_end), fates == QUIET
    lower = np.where(is_quiet, t_last, times), has_ended | is_quiet, confidence, units
    upper = times, has_ended, confidence, units
    half = replace(median(*lower), high=median(*upper).high)
    curve = kaplan_meier(*lower)
    if is_quiet.any():
        bound = kaplan_meier(*upper)
        t = np.union1d(curve[0], bound[0])
        (share, low), (high,) = (
            [column[np.searchsorted(source[0], t, side="right") - 1] for column in columns]
            for source, columns in ((curve, (curve[1], curve[2])), (bound, (bound[3],)))
        )
        curve = t, share, low, high
    return Survival(curve, half)


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
    if units is not None and _are_shared(units):
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


def is_unstable(growth_rate: Many) -> np.ndarray | bool:
    """Whether the state in which all blocks slip is known to be linearly unstable; a rate of NaN is not known."""
    return growth_rate > RATE_ROUNDING


def fates(
    outcomes: np.ndarray,
    t_last: np.ndarray,
    n_last: np.ndarray,
    t_end: np.ndarray,
    growth_rate: np.ndarray,
    n: np.ndarray,
) -> np.ndarray:
    """Fates of runs, each one of `WATCHED` or `FAILED`, shape (m,), of objects.

    Parameters
    ----------
    outcomes : ndarray of str, shape (m,)
        "finished", "collapsed", "diverged" or "failed".
    t_last, n_last : ndarray, shape (m,)
        t and n_stick of the last change point; anything where a run failed.
    t_end : ndarray, shape (m,)
    growth_rate : ndarray, shape (m,)
        The linear growth rate of the state in which all blocks slip; NaN if it is not known.
    n : ndarray, shape (m,)
        Number of blocks; NaN if it is not known.
    """
    names = np.full(len(outcomes), FAILED, dtype=object)  # a mask is given one word, which is then held once
    for outcome, how in _CERTAIN.items():
        names[outcomes == outcome] = how
    is_finished, slips, is_lull = outcomes == "finished", is_all_slip(t_last, n_last, t_end), is_unstable(growth_rate)
    names[is_finished & ~slips] = SUSTAINED
    names[is_finished & (n_last == n) & (t_last <= 0)] = UNMOVED
    names[is_finished & slips & is_lull] = LULL
    names[is_finished & slips & ~is_lull] = QUIET
    return names


def fate(
    outcome: str,
    series: tuple[np.ndarray, np.ndarray] | None,
    t_end: float,
    growth_rate: float | None = None,
    n: int | None = None,
) -> str:
    """Fate of one run, as `fates`, from its change points, t and n_stick; None if it failed.

    Without the number of blocks n a run that has not moved is taken for one in motion.
    """
    if series is None:
        return FAILED
    t, n_stick = series
    rate, blocks = (np.nan if value is None else value for value in (growth_rate, n))
    columns = (np.array([value]) for value in (outcome, t[-1], n_stick[-1], t_end, rate, blocks))
    return str(fates(*columns)[0])


def ends_at(
    fates: np.ndarray, t_last: np.ndarray, t_stop: np.ndarray, t_end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """When runs ended or were censored, and whether they ended, shape (m,): the input of `kaplan_meier`.

    A collapsed run ends at `t_last`, its last event. Its certificate, at `t_stop`, comes later: when the engine
    checks and the motion has decayed far enough. A runaway ends at `t_stop`, when it left every bound. All others are
    censored at t_end. A run that ended without being certified by then is quiet or, if it ended in the last quarter,
    seems in motion. In that quarter shares are therefore too high; before it, the interval of `survival` covers both
    possible fates of quiet runs.
    """
    is_collapsed, is_diverged = fates == COLLAPSED, fates == DIVERGED
    return np.where(is_collapsed, t_last, np.where(is_diverged, t_stop, t_end)), is_collapsed | is_diverged


def is_all_slip(t_last: Many, n_last: Many, t_end: Many) -> np.ndarray | bool:
    """Whether no block sticks in the last quarter, from the t and n_stick of the last change point of one or many."""
    return (n_last == 0) & (t_last <= (1 - LAST_SHARE) * t_end)


def is_held(t_last: Many, n_last: Many, n: int, t_end: Many) -> np.ndarray | bool:
    """Whether all n blocks stick throughout the last quarter, from the t and n_stick of the last change point.

    Such a run counts as in motion, since a belt may load its blocks until one lets go. On a belt at rest it is at
    rest.
    """
    return (n_last == n) & (t_last <= (1 - LAST_SHARE) * t_end)


def bounded_share(counts: np.ndarray, confidence: float) -> Estimate:
    """Share of runs with a property that is unknown for some runs.

    The value counts these runs as lacking it. The interval reaches from the lower end of that share to the upper end
    of the share that counts them as having it; both ends are those of `compare.share_over_matrices`.

    Parameters
    ----------
    counts : ndarray, shape (G, 3)
        One row a matrix: runs with the property, runs for which it is unknown, and all runs.
    """
    has, untold, n_runs = np.asarray(counts, dtype=np.float64).T
    share, low, _, _ = share_over_matrices(np.column_stack([has, n_runs]), confidence)
    _, _, high, _ = share_over_matrices(np.column_stack([has + untold, n_runs]), confidence)
    return Estimate(share, low, high)
