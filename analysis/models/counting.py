"""Why gamma differs from ln 2: the parts due to counting, to single blocks' habits and to coupling, relative to ln 2.

    gamma / ln 2 - 1 = counting + habits + coupling

    counting    pool - coin          as many blocks without memory, of which finitely many can let go (`models.pool`)
    habits      rotation - pool      the runs' own blocks, which have memory and differ, but ignore each other
    coupling    runs - rotation      what rotating each block's series in time breaks (`nulls.rotated`)

For independent blocks, with or without memory, coupling is zero; for equal blocks without memory, habits are zero
too.

Lulls, which are stretches longer than `LULL` in which no block sticks, are cut out first. Nothing can let go in a
lull, yet it would count as time in which fewer blocks stick, and rotation would fill it with events of other blocks.
Every block slips at both ends of a lull, so its series continue across the cut.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stickslip.analysis.models import pool
from stickslip.analysis.series.cascades import EVENTS, Window, sums
from stickslip.analysis.series.nulls import BlockSteps, rotations
from stickslip.analysis.series.windows import Windows
from stickslip.analysis.stats import estimates
from stickslip.analysis.stats.estimates import LN2, Statistic, ratio

LULL = 20.0  # dimensionless: longer than a period of the slowest block of the paper's systems, about 15


#: Columns of `run_sums`, a numerator and a denominator each: total size and number of cascades of the run, the same
#: of its rotations, integral of n_stick and time, and the sums of the slope.
OBSERVED, ROTATED, MEAN, SLOPE = (slice(k, k + 2) for k in (0, 2, 4, 6))
N_COLUMNS = 8


def lulls(runs: Windows) -> np.ndarray:
    """Length of each lull at its place among the levels of n_stick, shape (M,), and 0 elsewhere."""
    return np.where((runs.lasted > LULL) & (runs.level == 0), runs.lasted, 0.0)


def without_lulls(win: Window, steps: BlockSteps) -> tuple[Window, BlockSteps, float]:
    """A window and its blocks' changes with the lulls cut out, and the total length of the lulls."""
    edges = np.concatenate(([win.t_start], win.t, [win.t_stop]))
    cut = np.concatenate(([0.0], np.cumsum(lulls(win.alone))))
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
    """Sums of products and of squares, for the slope of P(the next change is an exit | n_stick) within a run.

    Squares about a run's own mean are too small by the variance of that mean, a share 2 tau / T; squares about the
    means of its halves are too small by twice as much. Their difference is added, which leaves an error of second
    order in tau / T.
    """
    before, is_exit = win.path()[:-1].astype(np.float64), win.step < 0
    if len(before) < 2:
        return np.zeros(2)
    before -= before.mean()
    first, second = np.array_split(before, 2)
    apart = len(before) * (first.mean() - second.mean()) ** 2 / 4
    return np.array([before @ (is_exit - is_exit.mean()), before @ before + apart])


def run_sums(win: Window, steps: BlockSteps, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Sums of a run without lulls, shape (N_COLUMNS,), which add over runs and matrices.

    Parameters
    ----------
    win : Window
    steps : BlockSteps
        The same changes, block by block.
    draws : int
        Number of rotations.
    rng : Generator
    """
    span = win.t_stop - win.t_start
    observed, rotated = sums(win.step)[EVENTS], rotations(steps, (), draws, rng).sums[EVENTS]
    return np.concatenate([observed, rotated, [win.time_mean() * span, span], slope_sums(win)])


def of_pool(n: int, of: Callable[[int, float], float], rows: np.ndarray) -> np.ndarray:
    """`pool.gamma` or `pool.slope` at the mean n_stick of each row of sums."""
    means = ratio(rows[:, MEAN])
    if not all(pool.is_one(n, mean) for mean in means):
        raise estimates.Undefined("no block sticks, or all do: there is no such pool")
    return np.array([of(n, mean) for mean in means])


def parts(n: int) -> dict[str, Statistic]:
    """The excess of gamma over ln 2 and its parts by name, as statistics of rows of `run_sums`."""

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
