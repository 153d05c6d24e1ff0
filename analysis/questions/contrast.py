"""How far two settings lie apart in each statistic of the report: paired where they share their random systems.

Every statistic is a function of two sums a matrix, so that one estimator serves all of them. A difference is relative
to the first setting; of shares of runs it is the difference itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.questions.survival_section import COLLAPSED, DIVERGED, SILENT, fate
from stickslip.analysis.report import words
from stickslip.analysis.report.section import ChangePoints, Data
from stickslip.analysis.stats import compare as equivalence
from stickslip.analysis.stats import estimates
from stickslip.analysis.stats.cascades import Law, Window, laws, sizes_of_path, window
from stickslip.analysis.stats.compare import Compared
from stickslip.analysis.stats.estimates import (
    Estimate,
    Undefined,
    correlation_time,
    gamma,
    jackknife,
    over_matrices,
    ratio,
)

#: of shares of runs, which a scene declares no margin for: one run in five, which twenty matrices can show
SHARE_MARGIN = 0.2
#: Why the difference of two shares is not that of the numbers beside it: said wherever both stand.
SHARES_ADJUSTED = (
    "as if each setting had two runs more, one with that end and one without, so that none of few is not read "
    "as never"
)
_NONE = Estimate()
#: The sigmoid engine certifies no collapse: laws are compared in what went quiet, certified or not.
CERTIFIED = "share collapsed (certified)"
_FATES = {
    CERTIFIED: (COLLAPSED,),
    "share gone quiet": (COLLAPSED, SILENT),
    "share run away": (DIVERGED,),
}


@dataclass(frozen=True)
class Statistic:
    """A statistic by name: how it follows from two sums, and by how much it may differ."""

    name: str
    of: estimates.Statistic
    margin: float
    is_share: bool = False


@dataclass(frozen=True)
class Sample:
    """What one setting gives.

    Attributes
    ----------
    label : str
    sums : dict of str to dict of int to ndarray, shape (2,)
        By statistic and matrix. Only runs that reached t_end enter, but for shares, where each matrix has its first
        run that did not fail: 1 or 0, and 1.
    reasons : dict of str to str
        By statistic, why it is not to be judged.
    """

    label: str
    sums: dict[str, dict[int, np.ndarray]] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)

    def rows(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Matrices in ascending order, and their sums, shape (G, 2); those in which nothing was counted left out."""
        found = self.sums.get(name, {})
        kept = sorted(matrix for matrix, row in found.items() if row[1] > 0)
        return np.array(kept, dtype=np.int64), np.array([found[matrix] for matrix in kept]).reshape(-1, 2)


def statistics(dt: tuple[float, ...], margins: Mapping[str, float]) -> list[Statistic]:
    """What two settings are compared in: what has a margin (gamma's is that of every definition), and shares."""
    named = [
        Statistic(label, ratio, margins[name])
        for name, label in (
            ("mean", "mean n_stick"),
            ("variance", "variance of n_stick in time"),
            ("rate", "exit rate"),
            ("correlation_time", "correlation time"),
        )
        if name in margins
    ]
    by_law = [Statistic(_gamma(law), gamma, margins["gamma"]) for law in laws(dt) if "gamma" in margins]
    return [*named, *by_law, *(Statistic(name, ratio, SHARE_MARGIN, True) for name in _FATES)]


def _gamma(law: Law) -> str:
    return f"gamma ({law})"


def sample(
    label: str,
    members: pd.DataFrame,
    data: Data,
    t_burn: float,
    dt: tuple[float, ...],
    series: Mapping[str, ChangePoints] | None = None,
) -> Sample:
    """Read each run of a setting once.

    Parameters
    ----------
    label : str
    members : DataFrame
        Of the setting.
    data : Data
    t_burn : float
    dt : tuple of float
    series : mapping to ChangePoints, optional
        In place of the members' own, for another definition of sticking; members without are left out.
    """
    found = Sample(label)
    known = data.series if series is None else series
    columns = (members[name] for name in ("member_id", "matrix", "outcome", "t_end"))
    judged: set[int] = set()
    n_runs = n_short = 0
    for member_id, matrix, outcome, t_end in sorted(zip(*columns, strict=True), key=lambda row: row[:2]):
        own = data.series[member_id] if outcome == "finished" else None
        if outcome != "failed" and matrix not in judged:
            judged.add(int(matrix))
            ended = fate(str(outcome), own, float(t_end))
            for name, ends in _FATES.items():
                _add(found, name, int(matrix), [ended in ends, 1.0])
        if outcome == "finished" and member_id in known:
            win = window(*known[member_id], t_burn, float(t_end))
            for name, row in _run(win, dt):
                _add(found, name, int(matrix), row)
            n_runs, n_short = n_runs + 1, n_short + bool(correlation_time(win).reason)
    if 2 * n_short > n_runs:
        found.reasons["correlation time"] = (
            f"in {n_short} of {words.count(n_runs, 'run')} the window is too short for it: fewer than "
            f"{estimates.SHORT_WINDOW:g} correlation times, or no change"
        )
    return found


def _run(win: Window, dt: tuple[float, ...]) -> Iterable[tuple[str, Sequence[float]]]:
    span = win.t_stop - win.t_start
    yield "mean n_stick", [win.time_mean(), 1.0]
    yield "variance of n_stick in time", [win.time_variance(), 1.0]
    yield "exit rate", [float(np.maximum(-win.step, 0).sum()) / span, 1.0]
    tau = correlation_time(win)
    if tau.value is not None:
        yield "correlation time", [tau.value, 1.0]
    for law, sizes in sizes_of_path(win.path(), {step: win.grid_index(step) for step in dt}).items():
        yield _gamma(law), [float(sizes.sum()), float(len(sizes))]


def _add(found: Sample, name: str, matrix: int, row: Sequence[float]) -> None:
    held = found.sums.setdefault(name, {})
    held[matrix] = held.get(matrix, np.zeros(2)) + np.array(row, dtype=np.float64)


@dataclass(frozen=True)
class Contrast:
    """One statistic of two settings.

    Attributes
    ----------
    statistic : Statistic
    n_first, n_second : int
        Matrices; the same ones where paired.
    first, second, difference : Estimate
        Values, and second minus first, in the statistic's unit.
    test : Compared or None
        Of the relative difference (of shares: of the difference) against the margin; None with a reason.
    reason : str
    """

    statistic: Statistic
    n_first: int
    n_second: int
    first: Estimate = _NONE
    second: Estimate = _NONE
    difference: Estimate = _NONE
    test: Compared | None = None
    reason: str = ""


def contrast(one: Statistic, first: Sample, second: Sample, paired: bool, confidence: float) -> Contrast:
    """Second against first in one statistic.

    Paired: jackknife over the matrices that both have. Independent: each setting's jackknife by itself, the errors
    carried over to the quotient to first order, Welch's degrees of freedom. Shares of runs, where none or all may
    have ended, have the adjusted Wald errors of Agresti and Min (2005, Stat. Med. 24, 729), paired, and of Agresti
    and Caffo (2000, Am. Stat. 54, 280), independent.

    Measured on planted data (20 matrices, values that scatter by 14%, 10 points of it their matrix's own; 1500 each)
    at 5%, not adjusted: no difference was called different in 5.0% paired and 5.7% independent, one at the upper or
    lower margin of 10% equivalent in 5.2 and 4.4%, and 5.9 and 2.7%. Shares of 0.3 and 0.3 were called different in
    5.6 and 4.3%, of 0.3 and 0.5 equivalent, at the margin, in 0.7 and 0.0%, of 0.05 and 0.25 in 7.6 and 3.0%.
    """
    (mine, a), (theirs, b) = first.rows(one.name), second.rows(one.name)
    if paired:
        both = np.intersect1d(mine, theirs)
        a, b = a[np.isin(mine, both)], b[np.isin(theirs, both)]
    unjudged = first.reasons.get(one.name) or second.reasons.get(one.name)
    if unjudged and not (paired and np.array_equal(a, b)):  # the same numbers are the same, whatever they mean
        return Contrast(one, len(a), len(b), reason=unjudged)
    if min(len(a), len(b)) < 2:
        fewest = words.count(min(len(a), len(b)), "matrix")
        which = f"{fewest} in which both have" if paired else f"{fewest} in one of the two with"
        return Contrast(one, len(a), len(b), reason=f"{which} something to count; two are needed")
    estimate = _share if one.is_share else over_matrices
    before, after = (estimate(one.of, rows, confidence) for rows in (a, b))
    undefined = before.reason if before.value is None else after.reason if after.value is None else ""
    if undefined:
        return Contrast(one, len(a), len(b), before, after, reason=undefined)
    try:
        if one.is_share:
            moved, error, dof = _share_difference(a[:, 0], b[:, 0], paired)
            test = equivalence.compare(moved, error, dof, one.margin)
            difference = Estimate(moved, *test.interval(confidence))
        else:
            relative, error, dof = _difference(one.of, a, b, paired, is_relative=True)
            test = equivalence.compare(relative, error, dof, one.margin)
            moved, error, dof = _difference(one.of, a, b, paired, is_relative=False)
            absolute = equivalence.compare(moved, error, dof, one.margin)
            difference = Estimate(moved, *absolute.interval(confidence))
    except Undefined as why:
        return Contrast(one, len(a), len(b), before, after, reason=str(why))
    return Contrast(one, len(a), len(b), before, after, difference, test)


def _difference(
    of: estimates.Statistic, a: np.ndarray, b: np.ndarray, paired: bool, is_relative: bool
) -> tuple[float, float, float]:
    """Difference, its standard error and degrees of freedom."""
    if paired:

        def apart(sums: np.ndarray) -> np.ndarray:
            before, after = of(sums[:, :2]), of(sums[:, 2:])
            return _over(after, before) - 1.0 if is_relative else after - before

        value, error = jackknife(apart, np.hstack([a, b]))
        return value, error, len(a) - 1.0
    (before, error_a), (after, error_b) = jackknife(of, a), jackknife(of, b)
    if is_relative:
        value = float(_over(np.array([after]), np.array([before]))[0]) - 1.0
        error_a, error_b = error_a * after / before**2, error_b / before
    else:
        value = after - before
    parts = np.array([error_a**2, error_b**2])
    if not parts.sum():
        return value, 0.0, len(a) + len(b) - 2.0
    return value, float(np.sqrt(parts.sum())), float(parts.sum() ** 2 / (parts**2 / [len(a) - 1, len(b) - 1]).sum())


def _over(after: np.ndarray, before: np.ndarray) -> np.ndarray:
    if (before == 0).any():
        raise Undefined("the first value is zero, so there is no relative difference")
    return after / before


def _share(_: estimates.Statistic, rows: np.ndarray, confidence: float) -> Estimate:
    low, high = equivalence.wilson(float(rows[:, 0].sum()), float(len(rows)), confidence)
    return Estimate(float(rows[:, 0].mean()), low, high)


def _share_difference(a: np.ndarray, b: np.ndarray, paired: bool) -> tuple[float, float, float]:
    """Difference of two shares, adjusted Wald error, and infinite degrees of freedom: the normal distribution."""
    n_a, n_b = len(a), len(b)
    if paired:
        gained, lost, n = np.sum(b > a) + 0.5, np.sum(a > b) + 0.5, n_a + 2.0
        moved = (gained - lost) / n
        return float(moved), float(np.sqrt((gained + lost) / n - moved**2) / np.sqrt(n)), np.inf
    p, q = (a.sum() + 1) / (n_a + 2), (b.sum() + 1) / (n_b + 2)
    return float(q - p), float(np.sqrt(p * (1 - p) / (n_a + 2) + q * (1 - q) / (n_b + 2))), np.inf


def in_words(row: Mapping[str, Any]) -> str:
    """The verdict on a row of `judged`: the difference, its interval, and what was allowed."""
    if row["p_equivalent"] is None:
        return f"{equivalence.OPEN}: {row['reason']}"
    low, high = row["relative_low"], row["relative_high"]
    if row["verdict"] == equivalence.EQUIVALENT and row["relative"] == low == high == 0:
        return f"{equivalence.EQUIVALENT}: the same number in every matrix"
    return equivalence.verdict_words(row, size_in_words(row), low, high, margin_in_words(row))


def margin_in_words(row: Mapping[str, Any]) -> str:
    """The margin of a row, in the unit of `size_in_words`."""
    return f"{100 * row['margin']:.0f} points" if row["is_share"] else words.percent(row["margin"])


def size_in_words(row: Mapping[str, Any]) -> str:
    """The relative difference of a row with its interval; of shares the difference, in points of a hundred."""
    show = _points if row["is_share"] else words.signed_percent
    return f"{show(row['relative'])} ({show(row['relative_low'])} to {show(row['relative_high'])})"


def _points(value: float) -> str:
    return f"{100 * min(max(value, -1.0), 1.0):+.0f} points"


def judged(found: Sequence[Contrast], alpha: float) -> list[dict[str, Any]]:
    """Rows with verdicts, adjusted by Holm's rule over all of them, each kind of test by itself."""
    rows = [_row(one, alpha) for one in found]
    equivalence.judge_together(rows, alpha)
    return rows


def _row(one: Contrast, alpha: float) -> dict[str, Any]:
    row: dict[str, Any] = {
        "quantity": one.statistic.name, "n_first": one.n_first, "n_second": one.n_second,
        "margin": one.statistic.margin, "is_share": one.statistic.is_share, "verdict": equivalence.OPEN,
        "p_equivalent": None, "p_different": None, "reason": one.reason or None,
    }  # fmt: skip
    for name, value in (("first", one.first), ("second", one.second), ("difference", one.difference)):
        row |= {name: value.value, f"{name}_low": value.low, f"{name}_high": value.high}
    if one.test is not None:
        (low, high), (narrow_low, narrow_high) = one.test.interval(1 - alpha), one.test.interval(1 - 2 * alpha)
        row |= {
            "relative": one.test.difference, "relative_low": low, "relative_high": high, "narrow_low": narrow_low,
            "narrow_high": narrow_high, "p_equivalent": one.test.p_equivalent, "p_different": one.test.p_different,
        }  # fmt: skip
    return row
