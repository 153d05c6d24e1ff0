"""Pairs of a member and its changed copy: a displaced start, changed constants or redrawn stiffness ratios.

A changed run is compared with its base: the unchanged run of the same matrix, under the same engine and settings. The
pairs of one setting with one kind and size of change make a `Comparison`. Its matrices are the independent units;
several draws of one matrix are not independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from stickslip.analysis.answer import Row, records
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import labels, short
from stickslip.analysis.members import ENGINE_KEYS, SYSTEM_KEYS, Members
from stickslip.analysis.models.fates import DIVERGED, FAILED, SETTLED
from stickslip.analysis.series import parting
from stickslip.analysis.series.runs import Ended, Runs
from stickslip.sim.engines import place

START, CONSTANTS, RATIOS = "start", "constants", "ratios"  # kinds of change
#: How a perturbation is read if the members do not say: it moves every constant by up to a share of its scale.
DEFAULT_READING = "scale"
CURVE_POINTS = 70  # of the means of gaps
_CHANGING = ("perturbation_size", "ratio")  # settings in which a changed member differs from its base
_SETTING = tuple(name for name in (*SYSTEM_KEYS, *ENGINE_KEYS) if name not in _CHANGING)
_COLUMNS = [*_CHANGING, "member_id", "matrix", "ratio_draw", "perturbation_reading", "twin_size", "start_draw"]


@dataclass(frozen=True, order=True)
class Change:
    """How a copy differs from its base: the kind, how `size` is read (for constants), the size (0 for ratios)."""

    kind: str
    reading: str | None = None
    size: float = 0.0

    def __str__(self) -> str:
        if self.kind == START:
            return f"start by {short(self.size)}"
        if self.kind == RATIOS:
            return "ratios redrawn"
        how = "" if self.reading == DEFAULT_READING else f" ({self.reading})"
        return f"constants by {100 * self.size:.3g}%{how}"


@dataclass(frozen=True)
class Pair:
    """A changed member and its base, by their rows in the table of members; both have the same matrix."""

    matrix: int
    base: int
    changed: int


@dataclass(frozen=True)
class Comparison:
    """All pairs of one setting and one change, sorted by matrix."""

    change: Change
    pairs: tuple[Pair, ...]

    @property
    def changed(self) -> np.ndarray:
        """Rows of the changed members."""
        return np.array([pair.changed for pair in self.pairs])


@dataclass(frozen=True)
class Setting:
    """Members that differ in matrix and change only: `bases`, the row of one a matrix, and comparisons with them."""

    label: str
    key: dict[str, Any]
    bases: dict[int, int]
    comparisons: tuple[Comparison, ...]


@dataclass(frozen=True, eq=False)
class Followed:
    """Pairs that were followed until the shorter of their runs ends, P of them.

    Attributes
    ----------
    matrix : ndarray of int, shape (P,)
    t_stop : ndarray, shape (P,)
        Until when.
    t : ndarray, shape (P,)
        When the changed run had parted from its base; NaN if it had not.
    times, means : ndarray, shape (K,) and (P, K)
        Middles of intervals that are longer later, and means of `parting.gap` over them; NaN beyond t_stop.
    """

    matrix: np.ndarray
    t_stop: np.ndarray
    t: np.ndarray
    times: np.ndarray
    means: np.ndarray

    def __len__(self) -> int:
        return len(self.t)

    @property
    def has_parted(self) -> np.ndarray:
        """Whether each has, shape (P,)."""
        return ~np.isnan(self.t)


def level(study: Study, setting: Setting) -> float | None:
    """Mean |n_stick difference| of two different matrices after t_burn (`parting.level`), however their runs end.

    None if it is zero, or if most runs slip for good or are quiet, since it then vanishes with time.
    """
    rows = np.array([*setting.bases.values()])
    fates = study.motion.fates[rows]
    rows, fates = rows[fates != FAILED], fates[fates != FAILED]
    if len(rows) < 2 or 2 * np.isin(fates, SETTLED).sum() > len(rows):
        return None
    counts = partial(_counts, int(setting.key["n"]), float(setting.key["t_end"]))
    return parting.level(study.total(counts, rows)) or None


def _counts(n: int, t_end: float, runs: Runs, some: Ended) -> np.ndarray:
    return parting.counts(map(runs.points, some.member_id), _known(some, t_end), n, runs.t_burn, t_end)


def _known(some: Ended, t_end: float) -> np.ndarray:
    """Until when runs are known: a collapsed run stays as it is; one that ran away is followed until it did."""
    return np.where(some.outcome == DIVERGED, np.minimum(some.t_stop, t_end), t_end)


def follow(study: Study, comparisons: Sequence[Comparison], level: float, t_end: float) -> list[Followed]:
    """The pairs of each comparison, followed up to t_end at most; pairs with a failed run are left out."""
    every = [(k, one.matrix, one.base, one.changed) for k, some in enumerate(comparisons) for one in some.pairs]
    outcomes = study.data.table.own["outcome"].to_numpy(object)
    number, matrix, base, changed = np.array(every).T
    has_run = (outcomes[base] != FAILED) & (outcomes[changed] != FAILED)
    number, matrix, base, changed = (some[has_run] for some in (number, matrix, base, changed))
    t_stop = np.minimum(*(_known(study.ended(rows), t_end) for rows in (base, changed)))
    longest = parting.gap_times(parting.n_gaps(t_stop.max(initial=0.0)))
    edges = np.unique(np.geomspace(1, len(longest) + 1, CURVE_POINTS).astype(int)) - 1
    times = np.array([longest[a:b].mean() for a, b in pairwise(edges)])
    order = np.argsort(changed)  # shards are read one after the other
    given = study.each(partial(_followed, level, t_end, edges), changed[order], base[order])
    found = np.empty((len(changed), len(edges)))
    found[order] = given.reshape(found.shape)
    own = [number == k for k in range(len(comparisons))]
    return [Followed(matrix[some], t_stop[some], found[some, 0], times, found[some, 1:]) for some in own]


def _followed(level: float, t_end: float, edges: np.ndarray, runs: Runs, some: Ended, beside: Ended) -> np.ndarray:
    """When each run has parted from the one beside it, NaN if it has not, and means of their gap between edges."""
    found = np.full((len(some), len(edges)), np.nan)
    t_stop = np.minimum(_known(some, t_end), _known(beside, t_end)).tolist()
    for row, base, changed, t in zip(found, beside.member_id, some.member_id, t_stop, strict=True):
        gaps = parting.gap(runs.points(base), runs.points(changed), t)
        t_parted = parting.parted_at(gaps, level)
        row[0] = np.nan if t_parted is None else t_parted
        for k, (begin, end) in enumerate(pairwise(edges[edges <= len(gaps)]), 1):
            row[k] = gaps[begin:end].mean()
    return found


def settings(members: Members) -> list[Setting]:
    """Settings of an ensemble, each with the comparisons of changed members with their bases.

    A base is unchanged. For the sigmoid it has equal stiffness ratios or, if no member has, the first draw of the
    ratios. Changes of constants and of the start are compared under the same ratios. A member that was changed in two
    ways at once, or has no base, is in no comparison.

    Parameters
    ----------
    members : Members

    Returns
    -------
    list of Setting
        Sorted by n and engine; settings without an unchanged member are left out. None at all if no member is
        changed.
    """
    if not any(
        one["perturbation_size"] > 0 or one["twin_size"] is not None or one["ratio"] not in (None, "one")
        for one in members.settings
    ):
        return []
    parts = [
        (key | {"perturbation_size": 0.0}, records(members.at(some).together[_COLUMNS].assign(row=some)))
        for key, some in members.places(_SETTING, np.arange(len(members)))
    ]
    names = labels([key for key, _ in parts])
    found = [Setting(name, key, *_compared(own)) for name, (key, own) in zip(names, parts, strict=True)]
    return sorted((one for one in found if one.bases), key=lambda s: (s.key["n"], place(s.key["engine"]), s.label))


def _change(row: Row) -> Change | None:
    """The change of the start or the constants; None if neither was changed."""
    if row["twin_size"]:
        return Change(START, None, float(row["twin_size"]))
    if row["perturbation_size"]:
        return Change(CONSTANTS, row["perturbation_reading"] or DEFAULT_READING, float(row["perturbation_size"]))
    return None


def _ratios(row: Row) -> tuple[bool, int]:
    """Whether a member's stiffness ratios are drawn, and the number of the draw. The exact engine has equal ones."""
    return row["ratio"] not in (None, "one"), int(row["ratio_draw"] or 0)


def _compared(rows: Sequence[Row]) -> tuple[dict[int, int], tuple[Comparison, ...]]:
    """The base of each matrix of a setting, and the comparisons with bases."""
    original = [row for row in rows if _change(row) is None]
    first = min(map(_ratios, original), default=(False, 0))
    bases: dict[int, int] = {}
    for row in sorted(original, key=lambda row: (row["matrix"], row["member_id"])):
        if _ratios(row) == first:
            bases.setdefault(int(row["matrix"]), int(row["row"]))
    unchanged = {(row["matrix"], row["start_draw"], _ratios(row)): int(row["row"]) for row in original}
    pairs: dict[Change, list[Pair]] = {}
    for row in sorted(rows, key=lambda row: (row["matrix"], row["member_id"])):
        if row["twin_size"] and row["perturbation_size"]:
            continue
        change = _change(row)
        base = unchanged.get((row["matrix"], row["start_draw"], _ratios(row) if change else first))
        if base is not None and base != row["row"]:
            pairs.setdefault(change or Change(RATIOS), []).append(Pair(int(row["matrix"]), base, int(row["row"])))
    order = (START, RATIOS, CONSTANTS)
    return bases, tuple(
        Comparison(change, tuple(pairs[change]))
        for change in sorted(pairs, key=lambda c: (order.index(c.kind), c.reading or "", c.size))
    )
