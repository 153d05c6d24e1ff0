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

from stickslip.analysis.ensemble import ENGINE_KEYS, SYSTEM_KEYS, Study, label, split
from stickslip.analysis.stats import parting

START, CONSTANTS, RATIOS = "start", "constants", "ratios"  # kinds of change
#: what a perturbation moves, if the members do not say: every constant by up to a share of its scale
DEFAULT_READING = "scale"
_CHANGING = ("perturbation_size", "ratio")  # settings in which a changed member differs from its base
_SETTING = tuple(name for name in (*SYSTEM_KEYS, *ENGINE_KEYS) if name not in _CHANGING)


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

    setting: str
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
    """What two different matrices show after t_burn, see `parting.level`; None if they show nothing."""
    ends = study.ends
    bases = [study.data.series[base] for base in setting.bases.values() if ends[base][0] == "finished"]
    if len(bases) < 2:
        return None
    return parting.level(bases, study.settings.t_burn, float(setting.key["t_end"])) or None


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
        Columns of `analysis.ensemble.REQUIRED`; `ratio_draw`, `perturbation_reading` and `twin_size` may be missing
        and then count as null.

    Returns
    -------
    list of Setting
        Sorted by n and engine; settings without an unchanged member are left out.
    """
    parts = [(key | {"perturbation_size": 0.0}, _rows(some)) for key, some in split(members, _SETTING)]
    keys = [key for key, _ in parts]
    found = []
    for key, some in parts:
        bases = _bases(some)
        if bases:
            name = label(key, keys)
            found.append(Setting(name, key, bases, _comparisons(name, some)))
    return sorted(found, key=lambda s: (s.key["n"], s.key["engine"], s.label))


def _rows(members: pd.DataFrame) -> list[dict[str, Any]]:
    """Members as plain values, null as None, optional columns filled in."""
    names = [*_CHANGING, "member_id", "matrix"]
    empty = dict.fromkeys(("ratio_draw", "perturbation_reading", "twin_size", "start_draw"))
    optional = [name for name in empty if name in members]
    table = members[[*names, *optional]].astype(object)
    rows = table.where(table.notna(), None).to_dict(orient="records")
    return [empty | {str(name): value for name, value in row.items()} for row in rows]


def _change(row: dict[str, Any]) -> Change | None:
    """The change of start or constants; None for neither."""
    if row["twin_size"]:
        return Change(START, None, float(row["twin_size"]))
    if row["perturbation_size"]:
        return Change(CONSTANTS, row["perturbation_reading"] or DEFAULT_READING, float(row["perturbation_size"]))
    return None


def _ratios(row: dict[str, Any]) -> tuple[str | None, int | None]:
    """Which stiffness ratios a member has; the exact law has none."""
    draw = row["ratio_draw"]
    if row["ratio"] in (None, "one"):
        return None, None
    return str(row["ratio"]), 0 if draw is None else int(draw)


def _first(unchanged: Sequence[dict[str, Any]]) -> tuple[str | None, int | None]:
    """The ratios of the bases: equal ones if there are such members, else the first draw."""
    return min({_ratios(row) for row in unchanged}, key=lambda r: (r[0] is not None, r[1] or 0))


def _bases(rows: Sequence[dict[str, Any]]) -> dict[int, str]:
    """The unchanged member of each matrix: equal ratios if there are such members, else the first draw."""
    unchanged = [row for row in rows if _change(row) is None]
    if not unchanged:
        return {}
    first = _first(unchanged)
    chosen = sorted((row for row in unchanged if _ratios(row) == first), key=lambda row: str(row["member_id"]))
    return {
        int(row["matrix"]): str(row["member_id"]) for row in sorted(reversed(chosen), key=lambda row: row["matrix"])
    }


def _comparisons(label: str, rows: Sequence[dict[str, Any]]) -> tuple[Comparison, ...]:
    original = [row for row in rows if _change(row) is None]
    unchanged = {(row["matrix"], row["start_draw"], _ratios(row)): str(row["member_id"]) for row in original}
    first = _first(original)
    pairs: dict[Change, list[Pair]] = {}
    for row in rows:
        matrix, member_id, change = int(row["matrix"]), str(row["member_id"]), _change(row)
        if row["twin_size"] and row["perturbation_size"]:
            continue
        if change is not None:
            base = unchanged.get((matrix, row["start_draw"], _ratios(row)))
        else:
            change, base = Change(RATIOS), unchanged.get((matrix, row["start_draw"], first))
        if base is not None and base != member_id:
            pairs.setdefault(change, []).append(Pair(matrix, base, member_id))
    order = {START: 0, RATIOS: 1, CONSTANTS: 2}
    return tuple(
        Comparison(label, change, tuple(sorted(pairs[change], key=lambda pair: (pair.matrix, pair.changed))))
        for change in sorted(pairs, key=lambda c: (order[c.kind], c.reading or "", c.size))
    )
