"""Times between large events: how regular they are, when the next is due, and what the small ones do around them.

A time between runs from the end of a large event to the start of the next; the one after the last of a run is cut off
by its end, at which it counts as followed so far. All quantities are dimensionless; times in bins are in units of the
mean time between.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from stickslip.analysis.models.episodes import Catalogue
from stickslip.analysis.stats.estimates import Estimate, Undefined, jackknife_estimate, over_matrices, ratio, within
from stickslip.analysis.stats.survival import risks

HAZARD = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0)  # edges of bins of the time since the last large event
AROUND = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # of the time before or after a large event
FEWEST = 10  # times between that ended, for a mean
LEAST_SPAN = 5.0  # mean times that each run lasts at least: a share of exp(-5) of a Poisson process's is never seen


class Bin(NamedTuple):
    """A rate in a bin of times, in units of the mean time between, over the rate of a Poisson process.

    `what` is "hazard", of the next large event since the last, or "before" and "after": of small events around large.
    """

    what: str
    low: float
    high: float
    n_events: int
    relative: Estimate


class Recurrence(NamedTuple):
    """Times between events of at least a magnitude.

    Attributes
    ----------
    n_times, n_cut : int
        Times that ended, and those that the ends of runs cut off.
    mean, cv : Estimate
        Mean and coefficient of variation by Kaplan and Meier: the latter is 0 of a clock, 1 of a Poisson process.
    before, after : Estimate
        Rank correlation of moments with the time before (slip-predictable: positive), and after (time-predictable),
        within runs.
    bins : list of Bin
    """

    least: float
    n_times: int
    n_cut: int
    mean: Estimate
    cv: Estimate
    before: Estimate
    after: Estimate
    bins: list[Bin]


class _Gaps(NamedTuple):
    """Times after each large event of a system, shape (m,): how long, whether ended, and the small events in them."""

    time: np.ndarray
    ended: np.ndarray
    after: np.ndarray  # times of small events since the last large one
    before: np.ndarray  # and until the next one, which is seen
    until: np.ndarray  # times before large events that were followed: from the one before, or the begin of a run
    ranks: np.ndarray  # sums of squares and products of ranks, shape (2, 3)


def recurrence(systems: Sequence[Sequence[Catalogue]], least: float, confidence: float) -> Recurrence:
    """Times between the events of at least a magnitude in the runs of some systems.

    Parameters
    ----------
    systems : sequence of sequence of Catalogue
        The runs of each system.
    """
    gaps = [_joined([_gaps(run, least) for run in runs]) for runs in systems]
    n_times = int(sum(gap.ended.sum() for gap in gaps))
    n_cut = sum(len(gap.ended) for gap in gaps) - n_times
    span = min((run.t_stop - run.t_start for runs in systems for run in runs), default=0.0)
    mean, cv = _mean_and_cv(gaps, span, confidence)
    ranks = np.array([gap.ranks for gap in gaps])
    before, after = (within(over_matrices(_correlation, ranks[:, k], confidence), -1.0, 1.0) for k in (0, 1))
    bins = [] if mean.value is None else _bins(gaps, mean.value, confidence)
    return Recurrence(least, n_times, n_cut, mean, cv, before, after, bins)


def _gaps(run: Catalogue, least: float) -> _Gaps:
    is_large = run.magnitude >= least
    start = run.start[is_large]
    end = start if run.is_loaded else start + run.duration[is_large]
    small = run.start[~is_large]
    time = np.maximum(np.append(start[1:], run.t_stop) - end, 0.0)
    ended = np.append(np.ones(max(len(start) - 1, 0), dtype=bool), np.zeros(min(len(start), 1), dtype=bool))
    place = np.searchsorted(start, small, side="right")
    since = small[place > 0] - end[place[place > 0] - 1]
    left = start[place[place < len(start)]] - small[place < len(start)]
    until = start - np.append(run.t_start, end[:-1])[: len(start)]
    waits, moment = time[ended], np.abs(run.moment[is_large])
    ranks = np.array([_products(moment[1:], waits), _products(moment[:-1], waits)])
    return _Gaps(time[: len(start)], ended, since[since >= 0], left, until, ranks)


def _products(size: np.ndarray, time: np.ndarray) -> tuple[float, float, float]:
    """Sums of squares and products of ranks about their mean; 0 of fewer than three."""
    if len(size) < 3:
        return 0.0, 0.0, 0.0
    ranks = (pd.Series(values).rank().to_numpy() for values in (size, time))  # equal values share the mean of theirs
    x, y = ((rank - (len(rank) + 1) / 2) / len(rank) for rank in ranks)
    return float(x @ x), float(y @ y), float(x @ y)


def _correlation(sums: np.ndarray) -> np.ndarray:
    if (sums[:, :2] <= 0).any():
        raise Undefined("fewer than three times between in every run")
    return np.asarray(sums[:, 2] / np.sqrt(sums[:, 0] * sums[:, 1]))


def _joined(runs: Sequence[_Gaps]) -> _Gaps:
    *lists, ranks = zip(*runs, strict=True)
    time, ended, after, before, until = (np.concatenate(values) for values in lists)
    return _Gaps(time, ended, after, before, until, np.sum(ranks, axis=0))


def _mean_and_cv(gaps: Sequence[_Gaps], span: float, confidence: float) -> tuple[Estimate, Estimate]:
    """By Kaplan and Meier, with jackknife-t intervals over systems."""
    full = [gap for gap in gaps if len(gap.time)]
    if sum(gap.ended.sum() for gap in full) < FEWEST:
        reason = f"fewer than {FEWEST} times between"
        return Estimate(reason=reason), Estimate(reason=reason)
    time, ended = (np.concatenate([getattr(gap, name) for gap in full]) for name in ("time", "ended"))
    number = np.repeat(np.arange(len(full)), [len(gap.time) for gap in full])
    try:
        values = _moments(time, ended)
        if span < LEAST_SPAN * values[0]:
            raise Undefined("runs are too short for the times between")
        if len(full) < 2:
            return Estimate(values[0], reason="one system"), Estimate(values[1], reason="one system")
        left = np.array([_moments(time[number != k], ended[number != k]) for k in range(len(full))])
    except Undefined as why:
        return Estimate(reason=str(why)), Estimate(reason=str(why))
    mean, cv = (within(jackknife_estimate(x, confidence), 0.0) for x in np.vstack([values, left]).T)
    return mean, cv


def _moments(time: np.ndarray, ended: np.ndarray) -> tuple[float, float]:
    """Mean and coefficient of variation of times of which some are cut off."""
    t, _, _, shares = risks(time, ended)
    edges, left = np.append(0.0, t), np.append(1.0, shares[:-1])
    mean = float(np.sum(left * np.diff(edges)))
    square = float(np.sum(left * np.diff(edges**2)))
    return mean, float(np.sqrt(max(square - mean**2, 0.0)) / mean)


def _bins(gaps: Sequence[_Gaps], mean: float, confidence: float) -> list[Bin]:
    small = sum(len(gap.after) for gap in gaps) / max(sum(gap.time.sum() for gap in gaps), 1e-300)
    bins = []
    for what, edges, of_poisson, events, followed in (
        ("hazard", HAZARD, 1 / mean, [gap.time[gap.ended] for gap in gaps], [gap.time for gap in gaps]),
        ("after", AROUND, small, [gap.after for gap in gaps], [gap.time for gap in gaps]),
        ("before", AROUND, small, [gap.before for gap in gaps], [gap.until for gap in gaps]),
    ):
        for low, high in itertools.pairwise(edges):
            rows = np.array(
                [
                    (
                        np.count_nonzero((times >= low * mean) & (times < high * mean)),
                        of_poisson * np.sum(np.clip(span, low * mean, high * mean) - low * mean),
                    )
                    for times, span in zip(events, followed, strict=True)
                ]
            )
            n_events, expected = rows.sum(axis=0)
            if expected > 0:
                relative = within(over_matrices(ratio, rows, confidence), 0.0)
                if not n_events:  # systems do not scatter: the limit of a Poisson count
                    relative = Estimate(0.0, 0.0, float(-np.log((1 - confidence) / 2) / expected))
                bins.append(Bin(what, low, high, int(n_events), relative))
    return bins
