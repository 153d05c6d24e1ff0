"""Pairs of a member and its changed copy: a displaced start, changed constants or redrawn stiffness ratios.

A changed run is compared with its base: the unchanged run of the same matrix, under the same engine and settings. The
pairs of one setting with one kind and size of change make a `Comparison`. Its matrices are the independent units;
several draws of one matrix are not independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip.analysis.answer import Row, records
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import labels, short
from stickslip.analysis.members import ENGINE_KEYS, SYSTEM_KEYS, Members
from stickslip.analysis.models.fates import DIVERGED, FAILED, SETTLED
from stickslip.analysis.series import parting

START, CONSTANTS, RATIOS = "start", "constants", "ratios"  # kinds of change
#: How a perturbation is read if the members do not say: it moves every constant by up to a share of its scale.
DEFAULT_READING = "scale"
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
    """A changed member and its base, by member_id; both have the same matrix."""

    matrix: int
    base: str
    changed: str


@dataclass(frozen=True)
class Comparison:
    """All pairs of one setting and one change, sorted by matrix."""

    change: Change
    pairs: tuple[Pair, ...]


@dataclass(frozen=True)
class Setting:
    """Members that differ in matrix and change only: `bases`, one a matrix, and the comparisons with them."""

    label: str
    key: dict[str, Any]
    bases: dict[int, str]
    comparisons: tuple[Comparison, ...]


@dataclass(frozen=True)
class Followed:
    """A pair that was followed up to t_stop, where the shorter of its runs ends.

    Attributes
    ----------
    gaps : ndarray
        `parting.gap` of the two.
    t : float or None
        When the changed run had parted from its base; None if it had not.
    """

    pair: Pair
    t_stop: float
    gaps: np.ndarray
    t: float | None


def level(study: Study, setting: Setting) -> float | None:
    """Mean |n_stick difference| of two different matrices after t_burn (`parting.level`), however their runs end.

    None if it is zero, or if most runs slip for good or are quiet, since it then vanishes with time.
    """
    bases = {base: how for base in setting.bases.values() if (how := study.fate(base)) != FAILED}
    n_settled = sum(how in SETTLED for how in bases.values())
    if len(bases) < 2 or 2 * n_settled > len(bases):
        return None
    t_end = float(setting.key["t_end"])
    until = [study.ends[base][1] if how == DIVERGED else t_end for base, how in bases.items()]
    return parting.level([study.runs.points(base) for base in bases], until, study.settings.t_burn, t_end) or None


def follow(study: Study, comparison: Comparison, level: float, t_end: float) -> list[Followed]:
    """The pairs of a comparison, followed up to t_end at most; pairs with a failed run are left out.

    A collapsed run stays as it is; a run that ran away is followed until it did.
    """
    found = []
    for pair in comparison.pairs:
        two = [study.ends[member] for member in (pair.base, pair.changed)]
        if any(outcome == "failed" for outcome, _ in two):
            continue
        t_stop = min([t_end, *(t for outcome, t in two if outcome == "diverged")])
        gaps = parting.gap(study.runs.points(pair.base), study.runs.points(pair.changed), t_stop)
        found.append(Followed(pair, t_stop, gaps, parting.parted_at(gaps, level)))
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
        (key | {"perturbation_size": 0.0}, records(members.at(some).together[_COLUMNS]))
        for key, some in members.places(_SETTING, np.arange(len(members)))
    ]
    names = labels([key for key, _ in parts])
    found = [Setting(name, key, *_compared(own)) for name, (key, own) in zip(names, parts, strict=True)]
    return sorted((one for one in found if one.bases), key=lambda s: (s.key["n"], s.key["engine"], s.label))


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


def _compared(rows: Sequence[Row]) -> tuple[dict[int, str], tuple[Comparison, ...]]:
    """The base of each matrix of a setting, and the comparisons with bases."""
    original = [row for row in rows if _change(row) is None]
    first = min(map(_ratios, original), default=(False, 0))
    bases: dict[int, str] = {}
    for row in sorted(original, key=lambda row: (row["matrix"], row["member_id"])):
        if _ratios(row) == first:
            bases.setdefault(int(row["matrix"]), str(row["member_id"]))
    unchanged = {(row["matrix"], row["start_draw"], _ratios(row)): str(row["member_id"]) for row in original}
    pairs: dict[Change, list[Pair]] = {}
    for row in rows:
        if row["twin_size"] and row["perturbation_size"]:
            continue
        change = _change(row)
        base = unchanged.get((row["matrix"], row["start_draw"], _ratios(row) if change else first))
        if base is not None and base != row["member_id"]:
            pairs.setdefault(change or Change(RATIOS), []).append(Pair(int(row["matrix"]), base, row["member_id"]))
    order = (START, RATIOS, CONSTANTS)
    return bases, tuple(
        Comparison(change, tuple(sorted(pairs[change], key=lambda pair: (pair.matrix, pair.changed))))
        for change in sorted(pairs, key=lambda c: (order.index(c.kind), c.reading or "", c.size))
    )
