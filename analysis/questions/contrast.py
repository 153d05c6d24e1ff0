"""How far two settings lie apart in each statistic of the report: paired where they share their random systems.

Every statistic is a function of two sums a matrix, so that one estimator serves all of them. A difference is relative
to the first setting; of shares of runs it is the difference itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.report import words
from stickslip.analysis.report.section import ChangePoints, Data
from stickslip.analysis.stats import estimates
from stickslip.analysis.stats.cascades import window
from stickslip.analysis.stats.compare import (
    DIFFERENT,
    EQUIVALENT,
    OPEN,
    Compared,
    equivalence_test,
    judge_together,
    mean_difference,
    relative_difference,
    share_difference,
    wilson,
)
from stickslip.analysis.stats.estimates import Estimate, Undefined, is_short, over_matrices, ratio
from stickslip.analysis.stats.fates import COLLAPSED, DIVERGED, SILENT, fate
from stickslip.analysis.stats.quantities import QUANTITIES

#: of shares of runs, which a scene declares no margin for: one run in five, which twenty matrices can show
SHARE_MARGIN = 0.2
#: Why the difference of two shares is not that of the numbers beside it: said wherever both stand.
SHARES_ADJUSTED = (
    "as if each setting had two runs more, one with that end and one without, so that none of few is not read "
    "as never"
)
_NONE = Estimate()
COMPARED = {name: one for name, one in QUANTITIES.items() if name != "band"}  # the paper's question is of changes
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


def statistics(margins: Mapping[str, float]) -> list[Statistic]:
    """What two settings are compared in: what has a margin, and shares."""
    named = [Statistic(one.label, one.of, margins[name]) for name, one in COMPARED.items() if name in margins]
    return [*named, *(Statistic(name, ratio, SHARE_MARGIN, True) for name in _FATES)]


def sample(
    label: str,
    members: pd.DataFrame,
    data: Data,
    t_burn: float,
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
            sums = {name: one.sums(win) for name, one in COMPARED.items()}
            for name, row in sums.items():
                _add(found, COMPARED[name].label, int(matrix), row)
            tau, is_known = sums["correlation_time"]
            n_runs, n_short = n_runs + 1, n_short + (not is_known or is_short(win, tau))
    if 2 * n_short > n_runs:
        found.reasons["correlation time"] = (
            f"in {n_short} of {words.count(n_runs, 'run')} the window is too short for it: fewer than "
            f"{estimates.SHORT_WINDOW:g} correlation times, or no change"
        )
    return found


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

    Paired: over the matrices that both have.
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
            test = equivalence_test(*share_difference(a[:, 0], b[:, 0], paired), one.margin)
            absolute = test
        else:
            test = equivalence_test(*relative_difference(one.of, a, b, paired), one.margin)
            absolute = equivalence_test(*mean_difference(one.of, a, b, paired), one.margin)
    except Undefined as why:
        return Contrast(one, len(a), len(b), before, after, reason=str(why))
    difference = Estimate(absolute.difference, *absolute.interval(confidence))
    return Contrast(one, len(a), len(b), before, after, difference, test)


def _share(_: estimates.Statistic, rows: np.ndarray, confidence: float) -> Estimate:
    low, high = wilson(float(rows[:, 0].sum()), float(len(rows)), confidence)
    return Estimate(float(rows[:, 0].mean()), low, high)


def verdict_words(row: Mapping[str, Any], value: str, low: float, high: float, margin: str) -> str:
    """The verdict on a row that was judged: what was found (`value`), what was allowed, and what adjusting changed.

    Parameters
    ----------
    row : mapping
        As `judge_together` leaves it, with `margin` in the unit of `low` and `high`.
    value, margin : str
        Difference with its interval, and margin, as they are read.
    low, high : float
        Interval of the difference, not adjusted.
    """
    if row["verdict"] == EQUIVALENT:
        is_seen = not low <= 0 <= high
        return f"{EQUIVALENT} within {margin}: {value}" + (", a difference within the margin" if is_seen else "")
    by_itself = row["by_itself"]
    not_after = ""
    if by_itself not in (row["verdict"], OPEN):
        p_value = words.p_is(row["p_equivalent_holm" if by_itself == EQUIVALENT else "p_different_holm"])
        not_after = (
            f"{by_itself} by itself, not after adjustment for {words.count(row['n_tests'], 'comparison')} "
            f"(adjusted {p_value})"
        )
    if row["verdict"] == DIFFERENT:
        is_beyond = low > row["margin"] or high < -row["margin"]
        open_end = not_after or f"whether by more than {margin} is open"
        return f"{DIFFERENT}: {value}, " + (f"beyond the margin of {margin}" if is_beyond else open_end)
    return f"{OPEN}: {value} against a margin of {margin}" + (f"; {not_after}" if not_after else "")


def in_words(row: Mapping[str, Any]) -> str:
    """The verdict on a row of `judged`: the difference, its interval, and what was allowed."""
    if row["p_equivalent"] is None:
        return f"{OPEN}: {row['reason']}"
    low, high = row["relative_low"], row["relative_high"]
    if row["verdict"] == EQUIVALENT and row["relative"] == low == high == 0:
        return f"{EQUIVALENT}: the same number in every matrix"
    return verdict_words(row, size_in_words(row), low, high, margin_in_words(row))


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
    judge_together(rows, alpha)
    return rows


def _row(one: Contrast, alpha: float) -> dict[str, Any]:
    row: dict[str, Any] = {
        "quantity": one.statistic.name, "n_first": one.n_first, "n_second": one.n_second,
        "margin": one.statistic.margin, "is_share": one.statistic.is_share, "verdict": OPEN,
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
