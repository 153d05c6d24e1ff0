"""Which members are changed copies of which: a displaced start, moved constants, redrawn stiffness ratios.

A changed run is compared with the run of the same matrix, under the same engine and settings, that was not changed,
its base. The pairs of one setting, kind and size of change make a `Comparison`; its matrices are the independent
units, and several draws of one matrix are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.answer import Row, records
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import label
from stickslip.analysis.members import ENGINE_KEYS, SYSTEM_KEYS, split
from stickslip.analysis.models.fates import DIVERGED, FAILED, SETTLED
from stickslip.analysis.series import parting

START, CONSTANTS, RATIOS = "start", "constants", "ratios"  # kinds of change
#: what a perturbation moves, if the members do not say: every constant by up to a share of its scale
DEFAULT_READING = "scale"
_CHANGING = ("perturbation_size", "ratio")  # settings in which a changed member differs from its base
_SETTING = tuple(name for name in (*SYSTEM_KEYS, *ENGINE_KEYS) if name not in _CHANGING)
_COLUMNS = [*_CHANGING, "member_id", "matrix", "ratio_draw", "perturbation_reading", "twin_size", "start_draw"]


@dataclass(frozen=True, order=True)
class Change:
    """What was done to the base: a kind, for constants how `size` is read, and the size (0 for redrawn ratios)."""

    kind: str
    reading: str | None = None
    size: float = 0.0

    def __str__(self) -> str:
        if self.kind == START:
            return f"start by {self.size:g}"
        if self.kind == RATIOS:
            return "ratios redrawn"
        how = "" if self.reading == DEFAULT_READING else f" ({self.reading})"
        return f"constants by {100 * self.size:.3g}%{how}"


@dataclass(frozen=True)
class Pair:
    """A changed member and its base, by member_id; both of one matrix."""

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
    """Members alike in everything but matrix and change: `bases` (one a matrix) and what was made of them."""

    label: str
    key: dict[str, Any]
    bases: dict[int, str]
    comparisons: tuple[Comparison, ...]


@dataclass(frozen=True)
class Watched:
    """A pair up to t_stop, the end of the run that was watched for less long.

    Attributes
    ----------
    gaps : ndarray
        `parting.gap` of the two.
    t : float or None
        When the changed run had parted from its base.
    """

    pair: Pair
    t_stop: float
    gaps: np.ndarray
    t: float | None


def level(study: Study, setting: Setting) -> float | None:
    """What two different matrices show after t_burn, however they end, see `parting.level`.

    None if they show nothing, or if most have come to slip for good or are quiet: it then falls to nothing with time.
    """
    bases = {base: how for base in setting.bases.values() if (how := study.fate(base)) != FAILED}
    n_settled = sum(how in SETTLED for how in bases.values())
    if len(bases) < 2 or 2 * n_settled > len(bases):
        return None
    t_end = float(setting.key["t_end"])
    watched = [study.ends[base][1] if how == DIVERGED else t_end for base, how in bases.items()]
    return parting.level([study.data.series[base] for base in bases], watched, study.settings.t_burn, t_end) or None


def watch(study: Study, comparison: Comparison, level: float, t_end: float) -> list[Watched]:
    """The pairs of a comparison up to t_end at most; those of which a run failed are left out.

    A collapsed run stays as it is; one that ran away is watched until then.
    """
    found = []
    for pair in comparison.pairs:
        two = [study.ends[member] for member in (pair.base, pair.changed)]
        if any(outcome == "failed" for outcome, _ in two):
            continue
        t_stop = min([t_end, *(t for outcome, t in two if outcome == "diverged")])
        gaps = parting.gap(study.data.series[pair.base], study.data.series[pair.changed], t_stop)
        found.append(Watched(pair, t_stop, gaps, parting.parted_at(gaps, level)))
    return found


def settings(members: pd.DataFrame) -> list[Setting]:
    """Sort members into settings and, in each, changed members into comparisons with their base.

    A base has no change at all. For the sigmoid it has equal stiffness ratios; if no member has, the first draw of
    the ratios is the base. Constants and start are compared under the same ratios. A member changed in two ways
    at once, or without base, is in no comparison.

    Parameters
    ----------
    members : DataFrame
        As `analysis.ensemble.Data` has them.

    Returns
    -------
    list of Setting
        Sorted by n and engine; settings without an unchanged member are left out.
    """
    parts = [(key | {"perturbation_size": 0.0}, records(some[_COLUMNS])) for key, some in split(members, _SETTING)]
    keys = [key for key, _ in parts]
    found = [Setting(label(key, keys), key, *_compared(rows)) for key, rows in parts]
    return sorted((one for one in found if one.bases), key=lambda s: (s.key["n"], s.key["engine"], s.label))


def _change(row: Row) -> Change | None:
    """The change of start or constants; None for neither."""
    if row["twin_size"]:
        return Change(START, None, float(row["twin_size"]))
    if row["perturbation_size"]:
        return Change(CONSTANTS, row["perturbation_reading"] or DEFAULT_READING, float(row["perturbation_size"]))
    return None


def _ratios(row: Row) -> tuple[bool, int]:
    """Which stiffness ratios a member has: equal ones, as under the exact law, or which draw."""
    return row["ratio"] not in (None, "one"), int(row["ratio_draw"] or 0)


def _compared(rows: Sequence[Row]) -> tuple[dict[int, str], tuple[Comparison, ...]]:
    """Of a setting, the base of each matrix, and the comparisons with bases."""
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
