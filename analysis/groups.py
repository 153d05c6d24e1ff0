"""Groups of like members, with the sums of their runs in motion, one row a unit.

A group holds members that differ only in what is drawn: the matrix, the start, the stiffness ratios of a sigmoid.
Only members in motion at t_end enter a statistic, including those in a lull (`models.fates`): leaving these out would
select runs by how they ended. The other members are counted, with outcome and reason.

The runs of a group are not independent of each other, but its units are (`members.with_units`). The units are the
matrices. Where one matrix has several starts, the units are the starts, and inference holds over starts of this
system. A K from a file is a system by itself, apart from other files; but files with one draw and one start each are
units, as matrices are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.members import ENGINE_KEYS, SYSTEM_KEYS, Members, shift_unit
from stickslip.analysis.models.fates import FAILED, MOVING, QUIET
from stickslip.analysis.models.motion import COLUMNS, Motion
from stickslip.analysis.series.runs import by_number
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Estimate, UnitSums, over_matrices, ratio, within
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.pipeline.design.design import Point, Unit
from stickslip.pipeline.design.labels import Label, labels
from stickslip.pipeline.design.values import rank, ranks
from stickslip.sim.engines import ENGINES, place
from stickslip.sim.numerics.arguments import did_you_mean

#: Columns of motion whose sums a group keeps for each unit.
_TOTALS = tuple(name for name in COLUMNS if name != "short")


class _Setting(dict[str, float | str]):
    """The values of keys, which says what there is instead of a key that is not there."""

    def __missing__(self, key: str) -> float | str:
        raise KeyError(
            f"at: expected n or a key of the scene that may be swept, {', '.join(self)}, got {key!r}"
            f"{did_you_mean(key, self)}; ask `group.key` for settings of the engine, `group.members` for columns"
        )


@dataclass
class Group:
    """Members that differ only in what is drawn, with the sums of their runs in motion, one row a unit.

    A run is in motion if it finished and a block sticks in its last quarter, or if it is in a lull there
    (`models.fates`). A run at rest has no steady state, and whether a quiet run is at rest is not known.

    Attributes
    ----------
    label : Label
        n, engine and whatever distinguishes it from the others.
    key : dict
        The values that all members share, for `SYSTEM_KEYS` and `ENGINE_KEYS`.
    table : Members
        Of the ensemble.
    rows : ndarray of int, shape (R,)
        Rows of the group's own members among them, by unit and then by member_id.
    units : ndarray of int, shape (G,)
        Units of the members in motion, ascending: the rows of all arrays.
    totals : dict of str to ndarray, shape (G,)
        Sums over runs of each of `motion.COLUMNS`, by name, but of `n_short`.
    counts : ndarray of int, shape (G, K)
        Number of cascades of each size from 1 on, by the definition `events`.
    fates : ndarray of str, shape (R,)
        Fate of each member, from `models.fates.fates`.
    last : ndarray, shape (R, 2)
        Time of the last change of n_stick of each member, and n_stick from then on; NaN if it failed.
    n_quiet : int
        Members that finished, but are quiet.
    n_short : int
        Members in motion whose window is too short for a correlation time.
    """

    label: Label
    key: dict[str, Any]
    table: Members
    rows: np.ndarray
    units: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    totals: dict[str, np.ndarray] = field(default_factory=lambda: {name: np.zeros(0) for name in _TOTALS})
    counts: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.int64))
    fates: np.ndarray = field(default_factory=lambda: np.zeros(0, object))
    last: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    n_quiet: int = 0
    n_short: int = 0

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def members(self) -> pd.DataFrame:
        """One row a member, without the columns that are in `key`, but for t_end."""
        return self.table.own.iloc[self.rows].assign(t_end=self.key["t_end"])

    def column(self, name: str) -> pd.Series:
        """A column of `members`."""
        return self.table.own[name].iloc[self.rows]

    @property
    def has_onsets(self) -> bool:
        """Whether each slip onset shows in n_stick: see `Engine.locates_events`."""
        return ENGINES[self.key["engine"]].locates_events

    @property
    def is_exact(self) -> bool:
        """Whether its runs follow the exact law, event by event."""
        return ENGINES[self.key["engine"]].is_exact

    @cached_property
    def is_moving(self) -> np.ndarray:
        """Whether each member is in motion, shape (R,)."""
        return np.isin(self.fates, MOVING)

    @property
    def moving(self) -> pd.DataFrame:
        """The members in motion."""
        return self.members[self.is_moving]

    @property
    def n_moving(self) -> int:
        return int(self.is_moving.sum())

    @cached_property
    def setting(self) -> Mapping[str, Any]:
        """That of one of its members: they differ in their seeds alone."""
        return self.table.settings[int(self.column("setting").iloc[0])]

    @cached_property
    def shift_unit(self) -> float:
        """By whole multiples of what its blocks may be shifted in time: see `members.shift_unit`."""
        return shift_unit(self.setting)

    @property
    def system(self) -> tuple[Any, ...]:
        """The values of `SYSTEM_KEYS`, the same in groups of the same systems."""
        return tuple(self.key[name] for name in SYSTEM_KEYS)

    @property
    def unit(self) -> Unit:
        """What the units are."""
        unit: Unit = self.setting["unit_is"]
        return unit

    @cached_property
    def point(self) -> Point:
        """Its point in the design."""
        return self.table.design.point(self.setting["point"])

    @property
    def at(self) -> dict[str, float | str]:
        """n, and each key that a scene may sweep, by its name there: a number, or a distribution in words."""
        columns = {name.removesuffix("0"): value for name, value in self.key.items()}
        values = {
            key: value if columns.get(key) is None else columns[key]
            for key, value in self.table.design.values(self.point).items()
        }
        words = {key: value if isinstance(value, float) else str(value) for key, value in values.items()}
        return _Setting({"n": self.key["n"], **words})

    @property
    def is_finished(self) -> np.ndarray:
        """Whether each member finished, shape (R,)."""
        return np.asarray(self.column("outcome") == "finished")

    @property
    def finished(self) -> pd.DataFrame:
        return self.members[self.is_finished]

    def of(self, *names: str) -> np.ndarray:
        """Some of `totals` side by side, shape (G, number of names)."""
        return np.column_stack([self.totals[name] for name in names])

    @property
    def n_runs(self) -> int:
        return int(self.of("runs").sum())

    def sums(self, quantity: str) -> UnitSums:
        """The two sums of one of `QUANTITIES`."""
        return UnitSums(self.units, self.of(*QUANTITIES[quantity].parts))

    @property
    def stuck(self) -> np.ndarray:
        """Sums over runs of the integral of n_stick and of the time without lulls (`models.motion`), shape (G, 2).

        Their quotient is the mean n_stick of the pool with which the runs are compared.
        """
        return self.of("stuck", "active")

    @property
    def pool_mean(self) -> float | None:
        """Mean n_stick without lulls, which the pool shares; None if no block ever sticks."""
        stuck, time = self.stuck.sum(axis=0)
        return float(stuck / time) if stuck else None

    def by_unit(self, *names: str) -> np.ndarray:
        """Some of `totals` averaged over the runs of each unit, so that every unit has the same weight."""
        return self.of(*names) / self.of("runs")

    def sums_of(self, numbers: np.ndarray) -> UnitSums:
        """By unit, the mean of a number over its runs that have one, and 1, so that every unit has the same weight.

        Parameters
        ----------
        numbers : ndarray
            Of each member of the ensemble, by its row. A run has none if it is not finite.
        """
        values = numbers[self.rows]
        is_known = np.isfinite(values)
        sums = UnitSums.of(self.column("unit").to_numpy()[is_known], np.column_stack([values, is_known])[is_known])
        return replace(sums, rows=sums.rows / sums.rows[:, 1:])

    def mean(self, confidence: float) -> Estimate:
        """Mean n_stick."""
        return within(over_matrices(ratio, self.by_unit("mean", "runs"), confidence), 0.0)

    def basis(self, confidence: float) -> enough.Basis:
        """Whether a statistic that assumes a stationary law may be judged: any law fits cascades of two sizes."""
        n_cascades = int(self.of("cascades").sum())
        basis = enough.basis(self.by_unit("first_half", "second_half", "variance"), n_cascades, confidence)
        is_of_few = self.counts.shape[1] < 3 and basis.code in (*enough.JUDGED, enough.DRIFTS)
        return replace(basis, code=enough.FEW_BLOCKS) if is_of_few else basis


def groups(members: Members, some: np.ndarray) -> list[Group]:
    """Some members, by their rows, as groups: unperturbed ones first, then by n, engine and settings, by value."""
    places: dict[tuple[Any, ...], int] = {}
    of_setting = np.array(
        [
            places.setdefault((setting["point"], setting["method"], setting["perturbation_size"]), len(places))
            for setting in members.settings
        ]
    )
    by_setting = [some[rows] for rows in by_number(of_setting[members.own["setting"].to_numpy()[some]])]
    shared = [members.settings[members.own["setting"].iloc[rows[0]]] for rows in by_setting]
    keys = [{name: setting[name] for name in (*SYSTEM_KEYS, *ENGINE_KEYS)} for setting in shared]
    unordered = [
        Group(name, key, members, _by_unit(members, rows))
        for name, key, rows in zip(labels(keys), keys, by_setting, strict=True)
    ]
    return sorted(unordered, key=_place)


def _place(group: Group) -> tuple[Any, ...]:
    """Sorts groups."""
    key, swept = group.key, group.table.design.swept(group.point)
    values = [ranks(swept.values()) if name == "values" else rank(value) for name, value in key.items()]
    return key["perturbation_size"], key["n"], place(key["engine"]), values


def _by_unit(members: Members, rows: np.ndarray) -> np.ndarray:
    """Rows in the order of their units and, within one, of member_id."""
    units = members.own["unit"].to_numpy()[rows]
    if (units[1:] > units[:-1]).all():
        return rows
    return members.own[["unit", "member_id"]].iloc[rows].sort_values(["unit", "member_id"]).index.to_numpy()


def fill(found: Sequence[Group], given: Iterable[tuple[np.ndarray, Motion]]) -> None:
    """Fill in the sums of groups from what their members give.

    Parameters
    ----------
    found : sequence of Group
        Of members of one table.
    given : iterable of (ndarray, Motion)
        Every member once: rows of the table, by their numbers, and what they give.
    """
    number, place, row = (np.zeros(len(found[0].table), dtype=np.int32) for _ in range(3))
    for k, group in enumerate(found):
        number[group.rows], place[group.rows] = k, np.arange(len(group))
        group.units, row[group.rows] = np.unique(group.column("unit").to_numpy(), return_inverse=True)
        group.totals = {name: np.zeros(len(group.units)) for name in COLUMNS}
        group.counts = np.zeros((len(group.units), 0), dtype=np.int64)
        group.fates, group.last = np.full(len(group), FAILED, dtype=object), np.full((len(group), 2), np.nan)
    for rows, motion in given:
        order = np.argsort(number[rows], kind="stable")  # by group
        rows, by_group = rows[order], motion.in_order(order)
        ends = [*(np.flatnonzero(np.diff(number[rows])) + 1).tolist(), len(rows)]
        for start, end in pairwise([0, *ends]):
            members = rows[start:end]
            _add(found[number[members[0]]], place[members], row[members], by_group.part(start, end))
    for group in found:
        _finish(group)


def _add(group: Group, places: np.ndarray, rows: np.ndarray, given: Motion) -> None:
    """Add what the members at some places give to the sums of their units, by row."""
    group.fates[places], group.last[places] = given.fates, given.last
    moves = np.flatnonzero(given.sums[:, COLUMNS["runs"]])
    for name, k in COLUMNS.items():
        np.add.at(group.totals[name], rows[moves], given.sums[moves, k])
    run, size, n_times = given.sizes.T
    if (n_more := int(size.max(initial=0)) - group.counts.shape[1]) > 0:
        group.counts = np.pad(group.counts, ((0, 0), (0, n_more)))
    np.add.at(group.counts, (rows[run], size - 1), n_times)


def _finish(group: Group) -> None:
    """Leave out units without a run in motion."""
    moves = group.totals["runs"] > 0
    group.units, group.counts = group.units[moves], group.counts[moves]
    group.n_short = int(group.totals.pop("short").sum())
    for name in group.totals:  # one after the other: they take most of the memory
        group.totals[name] = group.totals[name][moves]
    group.n_quiet = int((group.fates == QUIET).sum())
