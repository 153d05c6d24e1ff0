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

from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.stats.shares import share_over_matrices
from stickslip.analysis.stats.survival import Curve, kaplan_meier, median
from stickslip.sim.systems.sliding import RATE_ROUNDING

COLLAPSED, DIVERGED, SUSTAINED, LULL, QUIET, UNMOVED, FAILED = (
    "collapsed", "diverged", "sustained", "lull", "quiet", "unmoved", "failed",
)  # fmt: skip
ENDS = (COLLAPSED, DIVERGED)
MOVING = (SUSTAINED, LULL)
SETTLED = (COLLAPSED, QUIET)  # no block sticks at the end, either for good or as far as is known
WATCHED = (*ENDS, QUIET, *MOVING, UNMOVED)  # the fates of runs that did not fail
LAST_SHARE = 0.25  # last part of a run: lull or quiet if no block sticks in it, held if all stick throughout


#: A number, or one of each run.
Many = np.ndarray | float


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
    for certain in ENDS:  # outcomes have the same names
        names[outcomes == certain] = certain
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
    of the share that counts them as having it; both ends are those of `shares.share_over_matrices`.

    Parameters
    ----------
    counts : ndarray, shape (G, 3)
        One row a matrix: runs with the property, runs for which it is unknown, and all runs.
    """
    has, untold, n_runs = np.asarray(counts, dtype=np.float64).T
    share, low, _, _ = share_over_matrices(np.column_stack([has, n_runs]), confidence)
    _, _, high, _ = share_over_matrices(np.column_stack([has + untold, n_runs]), confidence)
    return Estimate(share, low, high)
