"""Long-term robustness: do changed runs have the statistics of their base, to within declared margins?

Every quantity is taken on [t_burn, t_end] of each run, set against the base of the same matrix, and beside it stand
two yardsticks in the same unit: what two equal runs of one matrix would show by the length of the window alone
(`noise`), and what a complete redraw of the matrix gives (`redraw`). Without them "robust" may only mean that
any matrix would do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stickslip.analysis.pairs import Comparison
from stickslip.analysis.stats import student
from stickslip.analysis.stats.cascades import Window
from stickslip.analysis.stats.compare import Compared, equivalence_test, relative_difference
from stickslip.analysis.stats.estimates import Undefined, is_short, jackknife, jackknife_error
from stickslip.analysis.stats.quantities import DISTRIBUTION, QUANTITIES

BAND_FACTOR = 2.0  # "period near 20": the band's share is more than so many times the base's
FLIPS = 9999  # random exchanges: the least p-value is still below 0.05 after adjusting for 400 tests
_INDEX = {name: k for k, name in enumerate(QUANTITIES)}


@dataclass(frozen=True)
class Summary:
    """What one run gives on a window: the whole and its two halves.

    Attributes
    ----------
    whole : ndarray, shape (q, 2)
        Sums of each of `QUANTITIES`.
    halves : ndarray, shape (2, q, 2)
    shares : ndarray, shape (n + 1,)
        Share of time at each n_stick.
    half_shares : ndarray, shape (2, n + 1)
    is_short : bool
        The window holds too few correlation times for the correlation time itself.
    """

    whole: np.ndarray
    halves: np.ndarray
    shares: np.ndarray
    half_shares: np.ndarray
    is_short: bool


def summary(win: Window, n: int) -> Summary | None:
    """Summary of a run's window; None if n_stick hardly changes: no change in one half, or no complete cascade."""
    middle = 0.5 * (win.t_start + win.t_stop)
    parts = [win, win.part(win.t_start, middle), win.part(middle, win.t_stop)]
    rows = np.array([[one.sums(part) for one in QUANTITIES.values()] for part in parts])
    if not (rows[:, [_INDEX["gamma"], _INDEX["correlation_time"]], 1] > 0).all():
        return None
    shares = np.array([time_shares(part, n) for part in parts])
    return Summary(rows[0], rows[1:], shares[0], shares[1:], is_short(win, rows[0, _INDEX["correlation_time"], 0]))


def time_shares(win: Window, n: int) -> np.ndarray:
    """Share of time that n_stick spends at 0, 1, ..., n; exact."""
    edges = np.concatenate(([win.t_start], win.t, [win.t_stop]))
    return np.bincount(win.path(), np.diff(edges), n + 1) / (win.t_stop - win.t_start)


def wasserstein(first: np.ndarray, second: np.ndarray) -> float:
    """Wasserstein-1 distance of two distributions on 0, 1, ..., n: sum |F - G|, in blocks."""
    return float(np.abs(np.cumsum(first - second)).sum())


def distribution_test(
    changed: np.ndarray, base: np.ndarray, scale: float, margin: float, rng: np.random.Generator
) -> Compared:
    """Are the stationary distributions of the two ensembles the same? One row a matrix, paired.

    The distance is Wasserstein's between the mean distributions, in units of `scale`. p_different compares it with
    `FLIPS` random exchanges of changed and base within matrices, which needs no model of how n_stick depends on its
    past. p_equivalent takes the jackknife's error and no allowance for the distance's being too large by chance:
    it errs on the side of "not enough data".

    Parameters
    ----------
    changed, base : ndarray, shape (G, n + 1)
        Shares of time at each n_stick.
    scale, margin : float
    rng : numpy.random.Generator
    """
    gaps = np.cumsum(changed - base, axis=1)  # of the distribution functions

    def distance(sums: np.ndarray) -> np.ndarray:
        return np.abs(sums[:, :-1] / sums[:, -1:]).sum(axis=1) / scale

    value, error = jackknife(distance, np.column_stack([gaps, np.ones(len(gaps))]))
    signs = rng.choice([-1.0, 1.0], (FLIPS, len(gaps)))
    by_chance = np.abs(signs @ gaps / len(gaps)).sum(axis=1) / scale
    n_larger = np.count_nonzero(by_chance >= value * (1 - 1e-9))  # an exchange of all gives the value itself
    test = equivalence_test(value, error, len(gaps) - 1, margin)
    return replace(test, p_different=(1 + n_larger) / (1 + FLIPS))


@dataclass(frozen=True)
class Result:
    """One quantity of one comparison; differences relative to the base (of `distribution`: to the base's spread).

    Attributes
    ----------
    quantity : str
    n_matrices : int
    base, changed : float or None
        Values of the two groups; for `distribution` None.
    test : Compared or None
        None with a reason.
    typical : float or None
        Root mean square over matrices of the relative difference of the pair; for `distribution` mean distance.
    noise : float or None
        What `typical` would be by the length of the window alone.
    redraw : float or None
        What `typical` is for two different matrices.
    against_redraw, against_low, against_high : float or None
        typical / redraw with a jackknife interval.
    reason : str
    """

    quantity: str
    n_matrices: int
    base: float | None = None
    changed: float | None = None
    test: Compared | None = None
    typical: float | None = None
    noise: float | None = None
    redraw: float | None = None
    against_redraw: float | None = None
    against_low: float | None = None
    against_high: float | None = None
    reason: str = ""


def value_of(quantity: str, rows: np.ndarray) -> np.ndarray:
    """A quantity of each of some runs, shape (m,), from their rows of `Summary.whole`, shape (m, q, 2)."""
    sums = rows[:, _INDEX[quantity]]
    if quantity == "gamma":  # with cascades of size 1 alone, that of one more of size 2, so that it stays finite
        sums = np.column_stack([np.maximum(sums[:, 0], sums[:, 1] + 1.0), sums[:, 1]])
    return QUANTITIES[quantity].of(sums)


def compare(
    comparison: Comparison,
    runs: Mapping[str, Summary],
    quantity: str,
    margin: float,
    confidence: float,
    rng: np.random.Generator,
) -> Result:
    """One quantity of the changed runs against their bases, paired by matrix; draws of one matrix are averaged.

    The relative difference is (sum over matrices of changed) / (sum of base) - 1, its error the jackknife's over
    matrices with G - 1 degrees of freedom; for `distribution` see `distribution_test`.

    Parameters
    ----------
    comparison : Comparison
        Pairs of which a run has no summary are left out.
    runs : mapping of member_id to Summary
    quantity : str
        One of `QUANTITIES`.
    margin : float
        Relative to the base; for `distribution` to the base's standard deviation in time.
    confidence : float
        Of the interval of `against_redraw`.
    rng : numpy.random.Generator
        Of the random exchanges for `distribution`.
    """
    by_matrix: dict[int, list[tuple[Summary, Summary]]] = {}
    for pair in comparison.pairs:
        if pair.base in runs and pair.changed in runs:
            by_matrix.setdefault(pair.matrix, []).append((runs[pair.changed], runs[pair.base]))
    matrices = list(by_matrix.values())
    if len(matrices) < 2:
        return Result(
            quantity,
            len(matrices),
            reason=f"matrices with both runs in motion: {len(matrices)}; two are needed",
        )
    base = changed = None
    if quantity == DISTRIBUTION:
        shares = [np.array([np.mean([pair[k].shares for pair in some], axis=0) for some in matrices]) for k in (0, 1)]
        test = distribution_test(shares[0], shares[1], _spread(matrices), margin, rng)
    else:
        after, before = (
            np.array([np.mean([pair[k].whole[_INDEX[quantity]] for pair in some], axis=0) for some in matrices])
            for k in (0, 1)
        )
        of = QUANTITIES[quantity].of
        try:
            test = equivalence_test(*relative_difference(of, before, after, True), margin)
        except Undefined as undefined:
            return Result(quantity, len(matrices), reason=str(undefined))
        base, changed = (float(of(side.sum(axis=0, keepdims=True))[0]) for side in (before, after))
    typical, noise, apart = _yardsticks(quantity, matrices)
    root = quantity != DISTRIBUTION  # squares of differences, but plain distances of distributions
    spreads = [typical, noise, apart[~np.eye(len(apart), dtype=bool)]]
    sizes_of = [float(np.sqrt(np.mean(spread)) if root else np.mean(spread)) for spread in spreads]
    against, low, high = _against(typical, apart, root, confidence)
    return Result(
        quantity, len(matrices), base, changed, test, sizes_of[0], sizes_of[1], sizes_of[2], against, low, high
    )


def _spread(matrices: Sequence[Sequence[tuple[Summary, Summary]]]) -> float:
    """Standard deviation in time of the bases, mean over matrices."""
    return float(np.mean([np.sqrt(pairs[0][1].whole[_INDEX["variance"], 0]) for pairs in matrices]))


def _yardsticks(
    quantity: str, matrices: Sequence[Sequence[tuple[Summary, Summary]]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By matrix, in relative units: change and noise, shape (G,), and how far apart the bases are, shape (G, G).

    Squares of differences; for `distribution` distances. Halves of a run are half as long as the run, so they differ
    by sqrt(2) times as much as two runs of one stationary law. That needs no block length: a block bootstrap of
    n_stick saw distances of 0.8 (blocks of 10 units) to 1.2 (80) where runs of one matrix whose paths had parted
    differed by 2.3 and halves over sqrt(2) by 2.2 (20 matrices of 200 blocks, t = 600 to 1000).
    """
    first_bases = [pairs[0][1] for pairs in matrices]
    if quantity == DISTRIBUTION:
        scale = _spread(matrices)
        typical = [np.mean([wasserstein(a.shares, b.shares) for a, b in pairs]) for pairs in matrices]
        noise = [
            np.mean([wasserstein(*run.half_shares) for pair in pairs for run in pair]) / np.sqrt(2.0)
            for pairs in matrices
        ]
        cumulated = np.cumsum([base.shares for base in first_bases], axis=1)
        apart = np.abs(cumulated[:, None] - cumulated[None]).sum(axis=2)
        return np.array(typical) / scale, np.array(noise) / scale, apart / scale
    values = value_of(quantity, np.array([base.whole for base in first_bases]))
    scale = float(values.mean())

    def square(rows: Sequence[np.ndarray]) -> float:
        first, second = value_of(quantity, np.array(rows))
        return float((first - second) ** 2) / scale**2

    typical = [np.mean([square([a.whole, b.whole]) for a, b in pairs]) for pairs in matrices]
    # halves differ with twice the variance of two whole runs: each is half as long
    noise = [np.mean([square(list(run.halves)) / 2 for pair in pairs for run in pair]) for pairs in matrices]
    return np.array(typical), np.array(noise), (values[:, None] - values[None]) ** 2 / scale**2


def _against(
    typical: np.ndarray, apart: np.ndarray, root: bool, confidence: float
) -> tuple[float | None, float | None, float | None]:
    """typical / redraw with a jackknife-t interval over matrices; None where the bases do not differ."""
    g = len(typical)
    if g < 3 or not apart.sum() > 0:
        return None, None, None
    left = np.array([apart.sum() - 2 * apart[i].sum() for i in range(g)]) / ((g - 1) * (g - 2))
    ratio = typical.mean() / (apart.sum() / (g * (g - 1)))
    ratios = (typical.sum() - typical) / (g - 1) / left
    if root:
        ratio, ratios = np.sqrt(ratio), np.sqrt(ratios)
    half = student.half_width(confidence, g - 1) * jackknife_error(ratios)
    return float(ratio), max(float(ratio - half), 0.0), float(ratio + half)


def redrawn(bases: Sequence[Summary], quantity: str, margin: float) -> Compared | None:
    """The same test where every matrix is drawn anew: every second matrix against the others, independent of them.

    None with fewer than four matrices, and for `DISTRIBUTION`, which is paired.
    """
    if len(bases) < 4 or quantity == DISTRIBUTION:
        return None
    rows = np.array([base.whole[_INDEX[quantity]] for base in bases])
    try:
        return equivalence_test(*relative_difference(QUANTITIES[quantity].of, rows[0::2], rows[1::2], False), margin)
    except Undefined:
        return None


def period_counts(comparison: Comparison, runs: Mapping[str, Summary]) -> np.ndarray:
    """By matrix: changed runs whose share of variance in `BAND` is over `BAND_FACTOR` times the base's, and runs.

    Shape (G, 2), runs without summary left out.
    """
    counts: dict[int, np.ndarray] = {}
    for pair in comparison.pairs:
        if pair.base in runs and pair.changed in runs:
            is_near = (
                runs[pair.changed].whole[_INDEX["band"], 0] > BAND_FACTOR * runs[pair.base].whole[_INDEX["band"], 0]
            )
            counts[pair.matrix] = counts.get(pair.matrix, np.zeros(2)) + np.array([is_near, 1])
    return np.array(list(counts.values())).reshape(-1, 2)


def period_by_redraw(bases: Sequence[Summary]) -> float | None:
    """How often a matrix passes for "period near 20" beside another, over all ordered pairs of different ones."""
    if len(bases) < 2:
        return None
    share = np.array([base.whole[_INDEX["band"], 0] for base in bases])
    is_near = share[:, None] > BAND_FACTOR * share[None]  # never on the diagonal
    return float(is_near.sum()) / (len(share) * (len(share) - 1))
