"""Why gamma is not ln 2: what is counting, what single blocks' habits, what coupling; each as a share of ln 2.

    gamma / ln 2 - 1 = counting + habits + coupling

    counting    pool - coin          as many blocks without memory: finitely many can let go (`models.pool`)
    habits      rotation - pool      the runs' own blocks, which have memory and differ, but ignore each other
    coupling    runs - rotation      what turning each block's series in time breaks (`nulls.rotated`)

Of independent blocks, with memory or without, coupling is zero; of alike blocks without memory, habits are too.

Lulls, stretches of more than `LULL` in which no block sticks, are cut out first: nothing can let go in them, yet they
would count as time in which fewer blocks stick, and turned in time they would fill up with events of other blocks.
Every block slips at both ends of a lull, so its series go on from the one to the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stickslip.analysis.models import pool
from stickslip.analysis.series.cascades import EVENTS, Window, sums
from stickslip.analysis.series.nulls import BlockSteps, rotations
from stickslip.analysis.stats import estimates
from stickslip.analysis.stats.estimates import LN2, Statistic, ratio

LULL = 20.0  # dimensionless: longer than a period of the slowest block of the paper's systems, about 15


#: Columns of `run_sums`, numerator and denominator each: sizes and numbers of cascades of the run and of its
#: rotations, the integral of n_stick and the time, and the sums of the slope.
OBSERVED, ROTATED, MEAN, SLOPE = (slice(k, k + 2) for k in (0, 2, 4, 6))
N_COLUMNS = 8


def lulls(win: Window) -> np.ndarray:
    """How long n_stick stays at each value of its path, shape (m + 1,), where that is a lull; else 0."""
    lengths = np.diff(win.t, prepend=win.t_start, append=win.t_stop)
    return np.where((lengths > LULL) & (win.path() == 0), lengths, 0.0)


def without_lulls(win: Window, steps: BlockSteps) -> tuple[Window, BlockSteps, float]:
    """A window and its blocks' changes with its lulls cut out, and how long these are together."""
    edges = np.concatenate(([win.t_start], win.t, [win.t_stop]))
    cut = np.concatenate(([0.0], np.cumsum(lulls(win))))
    total = float(cut[-1])
    if not total:
        return win, steps, 0.0
    t_stop = win.t_stop - total
    of_steps = cut[np.searchsorted(edges, steps.t, side="right") - 1]
    return (
        Window(win.t_start, t_stop, win.level, win.t - cut[1:-1], win.step),
        replace(steps, t_stop=t_stop, t=np.minimum(steps.t - of_steps, t_stop)),
        total,
    )


def slope_sums(win: Window) -> np.ndarray:
    """Of the slope of P(the next change is an exit | n_stick), within a run: sums of products and of squares.

    Squares from a run's own mean are too small by the variance of that mean, a share 2 tau / T; those of its halves
    are by twice as much. What they differ by is added: the error left is of second order in tau / T.
    """
    before, is_exit = win.path()[:-1].astype(np.float64), win.step < 0
    if len(before) < 2:
        return np.zeros(2)
    before -= before.mean()
    first, second = np.array_split(before, 2)
    apart = len(before) * (first.mean() - second.mean()) ** 2 / 4
    return np.array([before @ (is_exit - is_exit.mean()), before @ before + apart])


def run_sums(win: Window, steps: BlockSteps, draws: int, rng: np.random.Generator) -> np.ndarray:
    """What a run without lulls gives, shape (N_COLUMNS,); it adds over runs and matrices.

    Parameters
    ----------
    win : Window
    steps : BlockSteps
        The same changes, block by block.
    draws : int
        Rotations.
    rng : Generator
    """
    span = win.t_stop - win.t_start
    observed, rotated = sums(win.step)[EVENTS], rotations(steps, (), draws, rng)[EVENTS]
    return np.concatenate([observed, rotated, [win.time_mean() * span, span], slope_sums(win)])


def of_pool(n: int, of: Callable[[int, float], float], rows: np.ndarray) -> np.ndarray:
    """`pool.gamma` or `pool.slope` at the mean n_stick of rows of sums."""
    means = ratio(rows[:, MEAN])
    if not all(pool.is_one(n, mean) for mean in means):
        raise estimates.Undefined("no block sticks, or all do: there is no such pool")
    return np.array([of(n, mean) for mean in means])


def parts(n: int) -> dict[str, Statistic]:
    """By name, the excess of gamma over ln 2 and what it is made of, as statistics of rows of `run_sums`."""

    def runs(rows: np.ndarray) -> np.ndarray:
        return estimates.gamma(rows[:, OBSERVED]) / LN2 - 1

    def independent(rows: np.ndarray) -> np.ndarray:
        return estimates.gamma(rows[:, ROTATED]) / LN2 - 1

    def counting(rows: np.ndarray) -> np.ndarray:
        return of_pool(n, pool.gamma, rows) / LN2 - 1

    return {
        "excess": runs,
        "independent": independent,
        "counting": counting,
        "habits": lambda rows: independent(rows) - counting(rows),
        "coupling": lambda rows: runs(rows) - independent(rows),
        "slope": lambda rows: ratio(rows[:, SLOPE]),
        "over_slope": lambda rows: ratio(rows[:, SLOPE]) / of_pool(n, pool.slope, rows) - 1,
    }
