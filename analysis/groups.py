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

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.members import ENGINE_KEYS, SYSTEM_KEYS, Members
from stickslip.analysis.models.fates import FAILED, MOVING, QUIET
from stickslip.analysis.models.motion import COLUMNS, EFFECTIVE, Motion
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Estimate, UnitSums, over_matrices, ratio, within
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.sim.engines import ENGINES, SETTINGS, place

#: Numbers that differ by less, relatively, are shown as one.
_ROUNDING = 1e-14

#: A number, whose sign is no hyphen in a word; and a distribution.
_NUMBER = re.compile(r"(?:(?<!\w)[-+])?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_DRAWN = re.compile(r"(uniform|normal)\(([^,()]+), ([^,()]+)\)")

#: Keys that separate settings and are not swept.
FIXED = ("n", "coupling", "file", "back_slip", "t_end", "perturbation_size")
#: Columns of motion whose sums a group keeps for each unit.
_TOTALS = tuple(name for name in COLUMNS if name not in (*EFFECTIVE, "short"))
_LISTS = ("drawn", "parameters")  # settings that hold several, each "name = value"
_SWEPT = tuple(name for name in SYSTEM_KEYS if name not in (*FIXED, *_LISTS))
Value = float | str
#: A key to sort values by.
Order = tuple[int, str, tuple[float, ...]]


@dataclass
class Group:
    """Members that differ only in what is drawn, with the sums of their runs in motion, one row a unit.

    A run is in motion if it finished and a block sticks in its last quarter, or if it is in a lull there
    (`models.fates`). A run at rest has no steady state, and whether a quiet run is at rest is not known.

    Attributes
    ----------
    label : str
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
        Sums over runs of each of `motion.COLUMNS`, by name, but of those in `effective` and `n_short`.
    effective : ndarray, shape (4,)
        Sums over units of their means over runs of `effective.rows`.
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

    label: str
    key: dict[str, Any]
    table: Members
    rows: np.ndarray
    units: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    totals: dict[str, np.ndarray] = field(default_factory=lambda: {name: np.zeros(0) for name in _TOTALS})
    effective: np.ndarray = field(default_factory=lambda: np.zeros(4))
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
    def unit(self) -> str:
        """What the units are: `MATRIX`, `START` or `FILE`."""
        return str(self.table.settings[int(self.column("setting").iloc[0])]["unit_is"])

    @cached_property
    def at(self) -> dict[str, Value]:
        """Value of each key that a scene may sweep, by its name there: a number, or a distribution to draw from."""
        drawn, given = (
            dict(part.split(" = ", 1) for part in (self.key[name] or "").split("; ") if part) for name in _LISTS
        )
        found: dict[str, Value] = {key: float(text) for key, text in given.items()}
        for column in _SWEPT:
            key, number = column.removesuffix("0"), self.key[column]
            if column == "kappa" and self.key["file"] is not None:
                continue  # it is the scale of the file's K, which is not swept
            if number is not None or key in drawn:
                found[key] = drawn[key] if number is None else float(number)
        return found

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
        """Sums over runs of the integral of n_stick and of the time without lulls (`models.counting`), shape (G, 2).

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
        found = numbers[self.rows]
        known = np.isfinite(found)
        sums = UnitSums.of(self.column("unit").to_numpy()[known], np.column_stack([found, known])[known])
        return replace(sums, rows=sums.rows / sums.rows[:, 1:])

    def mean(self, confidence: float) -> Estimate:
        """Mean n_stick."""
        return within(over_matrices(ratio, self.by_unit("mean", "runs"), confidence), 0.0)

    def drift(self, confidence: float) -> Estimate:
        """Mean n_stick in the second half of the window minus that in the first, paired over units."""
        first, second, runs = self.by_unit("first_half", "second_half", "runs").T
        return over_matrices(ratio, np.column_stack([second - first, runs]), confidence)

    def basis(self, confidence: float) -> enough.Basis:
        """Whether a statistic that assumes a stationary law may be judged."""
        n_cascades = int(self.of("cascades").sum())
        return enough.basis(self.by_unit("first_half", "second_half", "variance"), n_cascades, confidence)


def groups(members: Members, some: np.ndarray) -> list[Group]:
    """Some members, by their rows, as groups: unperturbed ones first, then by n, engine and settings, by value."""

    def order(part: tuple[dict[str, Any], np.ndarray]) -> tuple[Any, ...]:
        key = part[0]
        return (key["perturbation_size"], key["n"], place(key["engine"]), [by_value(value) for value in key.values()])

    keys = (*SYSTEM_KEYS, *ENGINE_KEYS)
    parts = sorted(members.places(keys, some), key=order)
    names = labels([key for key, _ in parts])
    return [
        Group(name, key, members, _by_unit(members, rows)) for name, (key, rows) in zip(names, parts, strict=True)
    ]


def _by_unit(members: Members, rows: np.ndarray) -> np.ndarray:
    """Rows in the order of their units and, within one, of member_id."""
    units = members.own["unit"].to_numpy()[rows]
    if (units[1:] > units[:-1]).all():
        return rows
    return members.own[["unit", "member_id"]].iloc[rows].sort_values(["unit", "member_id"]).index.to_numpy()


def by_value(value: object) -> Order:
    """Sorts settings: numbers by their value, then None, then words, and of the same words by the numbers in them.

    Distributions are sorted by their width first: that of an interval, or a standard deviation.
    """
    if isinstance(value, (int, float, np.number)):
        return 0, "", (float(value),)
    if value is None:
        return 1, "", ()
    text = _DRAWN.sub(_by_width, str(value))
    return 2, _NUMBER.sub("", text), tuple(map(float, _NUMBER.findall(text)))


def _by_width(found: re.Match[str]) -> str:
    name, first, second = found[1], float(found[2]), float(found[3])
    return f"{name}({round(second - first, 12) if name == 'uniform' else second:.15g}, {first:.15g})"


def parts_of(label: str) -> list[str]:
    """What the name of a group consists of; a distribution is one part."""
    return re.split(r", (?![^()]*\))", label)


def apart(labels: Sequence[str], always: int = 0) -> list[str]:
    """What tells each of some groups from the others, after so many of the first parts of its name."""
    parts = [parts_of(label) for label in labels]
    shared = set.intersection(*map(set, parts)) if parts else set()
    return [", ".join([*own[:always], *(part for part in own[always:] if part not in shared)]) for own in parts]


def engine_name(engine: str) -> str:
    """The name of an engine on pages."""
    return ENGINES[engine].title


def labels(keys: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of groups: n, engine, its rule of sticking, and whatever distinguishes each from the others."""
    values: dict[tuple[str, str], set[Any]] = {}
    for key in keys:
        for name, value in key.items():
            values.setdefault((key["engine"], name), set()).add(value)
    differ = {place for place, some in values.items() if len(some) > 1}
    if all("w0" in key and key["w0"] == key["belt_speed"] for key in keys):
        differ -= {(key["engine"], "w0") for key in keys}  # all start on the belt
    lists = {place: set.intersection(*map(_parts, some)) for place, some in values.items() if place[1] in _LISTS}
    return [_label(key, differ, lists) for key in keys]


def _parts(text: str | None) -> set[str]:
    """What a setting of `_LISTS` holds."""
    return set((text or "").split("; "))


def _label(
    key: Mapping[str, Any], differ: Collection[tuple[str, str]], shared: Mapping[tuple[str, str], set[str]]
) -> str:
    """Name of a group; `differ` holds engine and name of each setting in which groups of that engine differ.

    `shared` has by engine and name what all of them have of settings that are lists.
    """
    parts = [f"n = {key['n']}", engine_name(key["engine"])]
    defaults = ENGINES[key["engine"]].defaults()
    for name in key:
        if name in ("n", "engine", "perturbation_size") or key[name] is None:
            continue
        rule = SETTINGS[name].in_label if name in SETTINGS else "if it differs"
        is_said = rule == "always" or (rule == "unless default" and key[name] != defaults[name])
        if name in _LISTS:
            parts += [part for part in key[name].split("; ") if part not in shared[key["engine"], name]]
        elif is_said or (key["engine"], name) in differ:
            parts.append(f"{name} = {_plain(key[name])}")
    if key["perturbation_size"] > 0:
        parts.append(f"perturbed by {_plain(key['perturbation_size'])}")
    return ", ".join(parts)


def _plain(value: object) -> str:
    return short(value) if isinstance(value, float) else str(value)


def short(value: float) -> str:
    """A number in few digits, but in all that it has: numbers that differ by more than rounding stay apart."""
    text = f"{value:g}"
    return text if abs(float(text) - value) <= _ROUNDING * abs(value) else f"{value:.15g}"


def fill(found: Sequence[Group], given: Iterable[tuple[np.ndarray, Motion]]) -> None:
    """Fill in the sums of groups from what their members give.

    Parameters
    ----------
    found : sequence of Group
        Of members of one table.
    given : iterable of (ndarray, Motion)
        Every member once: rows of the table, by their numbers, and what they give.
    """
    filling = [_Filling(group) for group in found]
    number, place = (np.zeros(len(found[0].table), dtype=np.int32) for _ in range(2))
    for k, group in enumerate(found):
        number[group.rows], place[group.rows] = k, np.arange(len(group))
    for rows, part in given:
        order = np.argsort(number[rows], kind="stable")  # by group
        rows, by_group = rows[order], part.in_order(order)
        ends = [*(np.flatnonzero(np.diff(number[rows])) + 1).tolist(), len(rows)]
        for first, end in pairwise([0, *ends]):
            filling[number[rows[first]]].add(place[rows[first:end]], by_group.part(first, end))
    while filling:
        filling.pop(0).finish()


class _Filling:
    """A group whose sums are being filled in, a row a unit of its members."""

    def __init__(self, group: Group) -> None:
        self._group = group
        self._units, row = np.unique(group.column("unit").to_numpy(), return_inverse=True)
        self._row = row.astype(np.int32)
        self._sums = {name: np.zeros(len(self._units)) for name in COLUMNS}
        self._counts = np.zeros((len(self._units), 0), dtype=np.int64)
        group.fates, group.last = np.full(len(group), FAILED, dtype=object), np.full((len(group), 2), np.nan)

    def add(self, places: np.ndarray, given: Motion) -> None:
        """Add what the members at some places give."""
        self._group.fates[places] = given.fates
        self._group.last[places] = given.last
        moves = np.flatnonzero(given.sums[:, COLUMNS["runs"]])
        rows = self._row[places[moves]]
        for name, k in COLUMNS.items():
            np.add.at(self._sums[name], rows, given.sums[moves, k])
        run, size, n_times = given.sizes.T
        if (more := int(size.max(initial=0)) - self._counts.shape[1]) > 0:
            self._counts = np.pad(self._counts, ((0, 0), (0, more)))
        np.add.at(self._counts, (self._row[places[run]], size - 1), n_times)

    def finish(self) -> None:
        """Hand the sums of the units in motion to the group."""
        group, moves = self._group, self._sums["runs"] > 0
        group.units, group.counts = self._units[moves], self._counts[moves]
        del self._counts
        group.n_short = int(self._sums.pop("short").sum())
        for name in [*self._sums]:  # each is given up as it is handed over: they take most of the memory
            group.totals[name] = self._sums.pop(name)[moves]
        group.effective = group.by_unit("variance", *EFFECTIVE).sum(axis=0)
        for name in EFFECTIVE:
            del group.totals[name]
        group.n_quiet = int((group.fates == QUIET).sum())
