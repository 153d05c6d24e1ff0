"""Pairs of a member and its changed copy: a displaced start, changed constants or redrawn stiffness ratios.

A changed run is compared with its base: the unchanged run of the same matrix, under the same engine and settings. The
pairs of one setting with one kind and size of change make a `Comparison`. Its matrices are the independent units;
several draws of one matrix are not independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from functools import partial
from typing import Any

import numpy as np

from stickslip.analysis.by_key import by_key
from stickslip.analysis.ensemble import Study
from stickslip.analysis.members import ENGINE_KEYS, SYSTEM_KEYS, Members, records
from stickslip.analysis.models.fates import DIVERGED, FAILED, SETTLED
from stickslip.analysis.series import parting
from stickslip.analysis.series.runs import Ended, Runs
from stickslip.pipeline.design.design import Change, Kind, Method
from stickslip.pipeline.design.labels import Label, labels
from stickslip.sim.engines import place

START, CONSTANTS, RATIOS = Kind.START, Kind.CONSTANTS, Kind.RATIOS
#: What all members of a setting share.
_SETTING = tuple(name for name in (*SYSTEM_KEYS, *ENGINE_KEYS) if name not in ("perturbation_size", "ratio"))


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

    def of(self, matrix: int) -> list[int]:
        """Rows of the changed members of a matrix."""
        return [pair.changed for pair in self.pairs if pair.matrix == matrix]


@dataclass(frozen=True)
class PairSet:
    """Members that differ in matrix and change only: `bases`, the row of one a matrix, and comparisons with them."""

    label: Label
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
    """

    matrix: np.ndarray
    t_stop: np.ndarray
    t: np.ndarray

    def __len__(self) -> int:
        return len(self.t)

    @property
    def has_parted(self) -> np.ndarray:
        """Whether each has, shape (P,)."""
        return ~np.isnan(self.t)


def level(study: Study, setting: PairSet) -> float | None:
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


def _counts(n: int, t_end: float, runs: Runs, ended: Ended) -> np.ndarray:
    unit, points = runs.unit, map(runs.dimensionless, ended.member_id)
    return parting.counts(points, _until(ended, t_end) / unit, n, runs.t_burn / unit, t_end / unit)


def _until(ended: Ended, t_end: float) -> np.ndarray:
    """Until when runs are known: a collapsed run stays as it is; one that ran away is followed until it did."""
    return np.where(ended.outcome == DIVERGED, np.minimum(ended.t_stop, t_end), t_end)


def follow(study: Study, comparisons: Sequence[Comparison], level: float, t_end: float) -> list[Followed]:
    """The pairs of each comparison, followed up to t_end at most; pairs with a failed run are left out."""
    numbered = [(k, *astuple(pair)) for k, comparison in enumerate(comparisons) for pair in comparison.pairs]
    number, matrix, base, changed = np.array(numbered).T
    outcomes = study.data.table.own["outcome"].to_numpy(object)
    has_run = (outcomes[base] != FAILED) & (outcomes[changed] != FAILED)
    number, matrix, base, changed = (column[has_run] for column in (number, matrix, base, changed))
    t_stop = np.minimum(*(_until(study.ended(rows), t_end) for rows in (base, changed)))
    order = np.argsort(changed)  # shards are read one after the other
    t = np.empty(len(changed))
    t[order] = study.each(partial(_parted_at, level, t_end), changed[order], base[order])
    of_comparison = [number == k for k in range(len(comparisons))]
    return [Followed(matrix[rows], t_stop[rows], t[rows]) for rows in of_comparison]


def _parted_at(level: float, t_end: float, runs: Runs, changed: Ended, base: Ended) -> np.ndarray:
    """When each run has parted from its base, NaN if it has not."""
    t_stop = np.minimum(_until(changed, t_end), _until(base, t_end)).tolist()
    times = np.full(len(changed), np.nan)
    for k, (name, original, t) in enumerate(zip(changed.member_id, base.member_id, t_stop, strict=True)):
        gaps = parting.gap(runs.dimensionless(original), runs.dimensionless(name), t / runs.unit)
        t_parted = parting.parted_at(gaps, level)
        if t_parted is not None:
            times[k] = t_parted * runs.unit
    return times


def settings(members: Members) -> list[PairSet]:
    """Settings of an ensemble, each with the comparisons of changed members with their bases.

    A base is unchanged. For the sigmoid it has equal stiffness ratios or, if no member has, the first draw of the
    ratios. Changes of constants and of the start are compared under the same ratios. A member that was changed in two
    ways at once, or has no base, is in no comparison.

    Returns
    -------
    list of PairSet
        Sorted by n and engine; settings without an unchanged member are left out. None at all if no member is
        changed.
    """
    design = members.design
    if len(design.changes) == 1 and not any(map(_is_drawn, design.methods)):
        return []

    def regardless_of_ratios(k: int) -> tuple[Any, ...]:
        method = design.methods[members.settings[k]["method"]]
        fixed = tuple(pair for pair in method.settings if pair[0] != "ratio")
        return members.settings[k]["point"], method.engine, fixed

    numbers = by_key(range(len(members.settings)), regardless_of_ratios)
    firsts = [members.settings[alike[0]] for alike in numbers.values()]
    keys = [{name: values[name] for name in _SETTING} | {"perturbation_size": 0.0} for values in firsts]
    names = labels(keys)
    number = members.own["setting"].to_numpy()
    all_settings = [
        PairSet(name, key, *_compared(members, np.flatnonzero(np.isin(number, alike))))
        for name, key, alike in zip(names, keys, numbers.values(), strict=True)
    ]
    with_bases = [setting for setting in all_settings if setting.bases]
    return sorted(with_bases, key=lambda setting: (setting.key["n"], place(setting.key["engine"]), setting.label))


def _is_drawn(method: Method) -> bool:
    """Whether the stiffness ratios are drawn; the exact engine has equal ones."""
    return dict(method.settings).get("ratio") not in (None, "one")


def _compared(members: Members, rows: np.ndarray) -> tuple[dict[int, int], tuple[Comparison, ...]]:
    """The base of each unit of a setting, and the comparisons with bases."""
    design = members.design
    changes = np.array([values["change"] for values in members.settings])
    is_drawn = np.array([_is_drawn(design.methods[values["method"]]) for values in members.settings])
    table = members.own[["member_id", "unit", "base", "matrix", "start_draw", "ratio_draw", "setting"]].iloc[rows]
    number = table["setting"].to_numpy()
    # equal ratios come before drawn ones, which are numbered
    ratios = np.where(is_drawn[number], 1 + table["ratio_draw"].fillna(0).to_numpy(np.int64), 0)
    start = table["start_draw"].fillna(-1)
    table = table.assign(row=rows, change=changes[number], ratios=ratios, start_draw=start)
    runs = records(table.sort_values(["unit", "member_id"]))
    unchanged = [run for run in runs if not run["change"]]
    original = {run["base"]: run["row"] for run in unchanged}
    fewest = min((run["ratios"] for run in unchanged), default=0)
    of_draws = {(run["matrix"], run["start_draw"]): run["row"] for run in unchanged if run["ratios"] == fewest}
    bases: dict[int, int] = {}
    pairs: dict[Change, list[Pair]] = {}
    for run in runs:
        change, base = design.changes[run["change"]], original.get(run["base"])
        if not run["change"]:
            change, base = Change(RATIOS), of_draws.get((run["matrix"], run["start_draw"]))
            if run["ratios"] == fewest:
                bases.setdefault(run["unit"], run["row"])
        if base is not None and base != run["row"]:
            pairs.setdefault(change, []).append(Pair(run["unit"], base, run["row"]))
    order = (START, RATIOS, CONSTANTS)
    in_order = sorted(pairs, key=lambda change: (order.index(change.kind), change.reading or "", change.size))
    return bases, tuple(Comparison(change, tuple(pairs[change])) for change in in_order)
