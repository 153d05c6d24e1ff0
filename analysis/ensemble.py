"""An ensemble as the statistics see it, and its members sorted into groups of like members.

A group holds the members that differ in what is drawn only: the matrix, the start, the stiffness ratios of a sigmoid.
Only members in motion at t_end enter a statistic, those in a lull too (`models.fates`): to leave these out would
select the runs by how they ended. The others are counted, with outcome and reason.

The runs of a group are not independent of each other: its units are (`with_units`). They are its matrices; where
there is one matrix and several starts they are the starts, and what is inferred holds over starts of this system. A K
from a file is a system of its own, apart from other files; but files with one draw and one start each are units, as
matrices are.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import repeat
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.models.counting import lulls
from stickslip.analysis.models.fates import MOVING, QUIET, fate
from stickslip.analysis.series.cascades import Law, Window, sizes, window
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.stats import effective, enough
from stickslip.analysis.stats.estimates import Estimate, add_histograms, is_short, over_matrices, ratio
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.sim.engines import ENGINES, SETTINGS
from stickslip.sim.engines.contract import Number, Numbers
from stickslip.sim.systems.terms import TERMS

OUTCOMES = ("finished", "collapsed", "diverged", "failed")
#: Terms of a system that every table of members says.
_ALWAYS = ("belt_speed", "kappa", "rho")
#: Columns of members that may be left out, as if null: what a scene may sweep or draw.
OPTIONAL = (
    "file",
    "parameters",
    *(term.name for term in TERMS if term.name not in _ALWAYS),
    *("back_slip", "z0", "w0", "drawn"),
)
#: What the units of a group may be.
MATRIX, START, FILE = "matrix", "start", "file"
SYSTEM_KEYS = ("n", "coupling", *_ALWAYS, *OPTIONAL, "t_end", "perturbation_size")
#: Columns that there may not be, of draws, changes and engines that a scene does without.
_NOT_EVERYWHERE = ("step", "ratio_draw", "perturbation_reading", "twin_size", "start_draw", "growth_rate")
TOLERANCES = tuple(name for name, setting in SETTINGS.items() if isinstance(setting, Number) and setting.picked)
ENGINE_KEYS = (
    "engine",
    *(name for name, setting in SETTINGS.items() if name not in TOLERANCES and not isinstance(setting, Numbers)),
    *TOLERANCES,
)
#: Columns that are null unless friction hangs on the speed of slip.
HANG_ON_SPEED = ("eps", *(term.name for term in TERMS if term.table == "weakening"))
REQUIRED = (
    *(key for key in SYSTEM_KEYS if key not in OPTIONAL),
    *(key for key in ENGINE_KEYS if key not in _NOT_EVERYWHERE),
    "member_id",
    "matrix",
    "outcome",
    "reason",
    "t_stop",
)
EVENTS = Law("events")

#: Change points of n_stick of a run: t, shape (m,), and n_stick, shape (m,), n_stick[k] on [t[k], t[k+1]).
ChangePoints = tuple[np.ndarray, np.ndarray]
#: Events of a run: t float64, block int32, mode int8 (-1, 0, +1 after the event), each (m,); and initial_mode (n,).
Events = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
#: Distance of a run's state from its unperturbed twin's: times, shape (m,), and distance, shape (m,).
Separation = tuple[np.ndarray, np.ndarray]
Series = Mapping[str, ChangePoints]


@dataclass(frozen=True)
class Data:
    """An ensemble as the statistics see it. All mappings are by member_id, and may load lazily.

    Attributes
    ----------
    members : DataFrame
        One row a member; the columns in `REQUIRED`, null where a setting does not apply. `with_units` and
        `with_starts` add their own, `with_rates` makes null what does not hold.
    series : mapping to ChangePoints
        Of every member that did not fail.
    events : mapping to Events
        Empty if the scene does not record them.
    separations : mapping to Separation
        Of members that are a changed copy of another; empty if the scene does not record them.
    thresholds : mapping to mapping of float to ChangePoints
        n_stick of a sigmoid run by threshold, under further definitions |w - v| < threshold r_i eps.
    episodes : DataFrame, optional
        A row an episode: member_id, start, end, size, moment. None if the scene does not record them.
    """

    members: pd.DataFrame
    series: Series
    events: Mapping[str, Events] = field(default_factory=dict)
    separations: Mapping[str, Separation] = field(default_factory=dict)
    thresholds: Mapping[str, Mapping[float, ChangePoints]] = field(default_factory=dict)
    episodes: pd.DataFrame | None = None

    def __post_init__(self) -> None:
        absent = [name for name in (*OPTIONAL, *_NOT_EVERYWHERE) if name not in self.members]
        whole = self.members.assign(**dict.fromkeys(absent))
        object.__setattr__(self, "members", with_rates(with_starts(with_units(whole))))


@dataclass
class Group:
    """Members alike in everything but what is drawn, with what their runs in motion give, a row a unit.

    In motion are those that finished and stick in the last quarter, or are in a lull there (`models.fates`): a run at
    rest has no steady state, and of a quiet one nobody knows whether it is at rest.

    Attributes
    ----------
    label : str
        n, engine and whatever tells it from the others.
    key : dict
        The values that its members share, by `SYSTEM_KEYS` and `ENGINE_KEYS`.
    members : DataFrame
    units : list of int
        Of the members in motion, ascending: the rows of all arrays.
    means : ndarray, shape (G, 5)
        Sums over runs of the time mean of n_stick, of that in each half of the window, of the variance in time, of 1
    quantities : dict of str to ndarray, shape (G, 2)
        Sums over runs of `QUANTITIES`, by name.
    stuck : ndarray, shape (G, 2)
        Sums over runs of the integral of n_stick, and of the time without lulls (`models.counting`): their quotient
        is the mean n_stick of the pool that the runs are held against.
    histograms : list of ndarray
        Cascades by `events`: histogram[k] of size k.
    effective : ndarray, shape (G, 4)
        `effective.row`, of several runs of one unit their mean.
    fates : list of str
        Of each member, as `models.fates.fate` has it.
    last : ndarray, shape (len(members), 2)
        Time of the last change of n_stick of each member, and n_stick from then on; NaN if it failed.
    moving : DataFrame
        The members in motion.
    n_quiet : int
        Finished, but quiet.
    n_short : int
        In motion, but too short for a correlation time.
    """

    label: str
    key: dict[str, Any]
    members: pd.DataFrame
    units: list[int] = field(default_factory=list)
    means: np.ndarray = field(default_factory=lambda: np.zeros((0, 5)))
    quantities: dict[str, np.ndarray] = field(default_factory=dict)
    stuck: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    histograms: list[np.ndarray] = field(default_factory=list)
    effective: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    fates: list[str] = field(default_factory=list)
    last: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    moving: pd.DataFrame = field(default_factory=pd.DataFrame)
    n_quiet: int = 0
    n_short: int = 0

    @property
    def unit(self) -> str:
        """What its units are: `MATRIX`, `START` or `FILE`."""
        return str(self.members["unit_is"].iloc[0])

    @property
    def finished(self) -> pd.DataFrame:
        return self.members[self.members["outcome"] == "finished"]

    @property
    def n_runs(self) -> int:
        return int(self.means[:, 4].sum())

    @property
    def sums(self) -> np.ndarray:
        """Total size and number of cascades by `events`, shape (G, 2)."""
        return self.quantities["gamma"]

    @property
    def pool_mean(self) -> float | None:
        """Mean n_stick without lulls, of the pool that the runs are held against; None where no block ever sticks."""
        stuck, time = self.stuck.sum(axis=0)
        return float(stuck / time) if stuck else None

    @property
    def counts(self) -> np.ndarray:
        """Cascades of each size from 1 on, shape (G, K)."""
        longest = max((len(h) for h in self.histograms), default=1)
        found = np.zeros((len(self.histograms), longest), dtype=np.int64)
        for row, one in zip(found, self.histograms, strict=True):
            row[: len(one)] = one
        return found[:, 1:]

    def by_unit(self) -> np.ndarray:
        """`means` averaged over the runs of each unit: every unit weighs the same."""
        return self.means / self.means[:, 4:] if len(self.means) else self.means

    def mean(self, confidence: float) -> Estimate:
        """Mean n_stick."""
        return over_matrices(ratio, self.by_unit()[:, [0, 4]], confidence)

    def drift(self, confidence: float) -> Estimate:
        """Mean n_stick in the second half of the window minus the first, paired over units."""
        rows = self.by_unit()
        return over_matrices(ratio, np.column_stack([rows[:, 2] - rows[:, 1], rows[:, 4]]), confidence)

    def basis(self, confidence: float) -> enough.Basis:
        """Whether a statistic that assumes a stationary law may be judged."""
        return enough.basis(self.by_unit()[:, 1:4], int(self.sums[:, 1].sum()), confidence)


@dataclass
class Study:
    """What every question is given: the data, what was declared before, and the groups."""

    data: Data
    settings: AnalysisSettings

    def __post_init__(self) -> None:
        check(self.data.members, self.data.series, self.settings)

    @cached_property
    def groups(self) -> list[Group]:
        """Of the members that are no changed copy of another, filled; by n and engine."""
        found = groups(unchanged(self.data.members))
        for group in found:
            _fill(group, self.data.series, self.settings)
        return found

    @property
    def margins(self) -> dict[str, float]:
        """By how much runs may differ and be equivalent; where episodes are recorded, gamma is not asked about."""
        left_out = {"gamma"} if self.data.episodes is not None else set[str]()
        return {name: margin for name, margin in self.settings.margins.items() if name not in left_out}

    @property
    def unit(self) -> str:
        """What most groups have for units."""
        return Counter(group.unit for group in self.groups).most_common(1)[0][0]

    def fate(self, member_id: str) -> str:
        """Fate of a member, as `models.fates.fate` has it."""
        outcome, t_end, rate = self._fated[member_id]
        points = None if outcome == "failed" else self.data.series[member_id]
        return fate(outcome, points, t_end, rate)

    @cached_property
    def _fated(self) -> Mapping[str, tuple[str, float, float]]:
        """Outcome, t_end and growth rate of each member."""
        columns = (self.data.members[name] for name in ("member_id", "outcome", "t_end", "growth_rate"))
        return {name: (outcome, float(t_end), rate) for name, outcome, t_end, rate in zip(*columns, strict=True)}

    @cached_property
    def ends(self) -> Mapping[str, tuple[str, float]]:
        """Outcome and t_stop of each member."""
        table = self.data.members
        return dict(zip(table["member_id"], zip(table["outcome"], table["t_stop"], strict=True), strict=True))

    def window(self, member_id: str, t_end: float) -> Window:
        """n_stick of a member on [t_burn, t_end].

        Raises
        ------
        ValueError
            If its series is not one, naming the member.
        """
        return _window(self.data.series[member_id], member_id, self.settings.t_burn, t_end)

    def by_threshold(self, member_id: str, t_end: float) -> dict[float, Window]:
        """The same under each further threshold; raises as `window`."""
        found = self.data.thresholds.get(member_id, {})
        return {c: _window(points, member_id, self.settings.t_burn, t_end) for c, points in found.items()}

    def judged(self) -> list[Group]:
        """Groups whose runs allow a statistic of a steady state.

        First those all of whose runs stay in motion, which are no survivors; of these the largest n first.
        """
        found = [one for one in self.groups if one.basis(self.settings.confidence).code in enough.JUDGED]
        return sorted(found, key=lambda one: (len(one.moving) < len(one.members), -int(one.key["n"])))

    def refusal(self) -> tuple[str, dict[str, Any]]:
        """Why no group is judged, a code of `stats.enough`, and the facts that ``basis.html`` says of it."""
        best = max((one.basis(self.settings.confidence) for one in self.groups), key=lambda one: one.n_cascades)
        return best.code, {"best": best, "t_burn": self.settings.t_burn}

    def windows(self, group: Group) -> Iterator[tuple[int, str, Window]]:
        """Row (unit), member_id and n_stick on [t_burn, t_end] of each run in motion of a filled group.

        Raises
        ------
        ValueError
            If a series is not one, naming the member.
        """
        row_of = {unit: row for row, unit in enumerate(group.units)}
        columns = (group.moving[name] for name in ("unit", "member_id", "t_end"))
        for unit, member_id, t_end in zip(*columns, strict=True):
            yield row_of[int(unit)], str(member_id), self.window(str(member_id), float(t_end))

    def generator(self, member_id: str) -> np.random.Generator:
        """Random numbers of a member depend on its name alone, not on its place in the table."""
        words = np.frombuffer(hashlib.sha256(member_id.encode()).digest(), dtype="<u4")
        return np.random.default_rng(np.random.SeedSequence([self.settings.seed, *words.tolist()]))


def check(members: pd.DataFrame, series: Series, settings: AnalysisSettings) -> None:
    """Refuse input that cannot mean what it says.

    Raises
    ------
    ValueError
        Naming the column, member or setting, what was expected and what came.
    """
    missing = [name for name in REQUIRED if name not in members.columns]
    if missing:
        raise ValueError(f"members: missing column(s) {', '.join(missing)}")
    if members.empty:
        raise ValueError("members: expected at least one row, got none")
    if not members["member_id"].is_unique:
        twice = members.loc[members["member_id"].duplicated(), "member_id"].iloc[0]
        raise ValueError(f"members: member_id {twice!r} occurs more than once")
    unknown = sorted({str(outcome) for outcome in members["outcome"]} - set(OUTCOMES))
    if unknown:
        raise ValueError(f"members: outcome must be one of {', '.join(OUTCOMES)}, got {unknown[0]!r}")
    if settings.t_burn >= members["t_end"].min():
        raise ValueError(
            f"t_burn: expected less than t_end = {members['t_end'].min():g}, got {settings.t_burn:g}; "
            "no time is left for statistics"
        )
    for member_id, outcome in zip(members["member_id"], members["outcome"], strict=True):
        if outcome != "failed" and member_id not in series:
            raise ValueError(
                f"series: no change points for the {outcome} member {member_id!r}; every member that did not fail "
                "has some, be it the start alone"
            )


def with_units(members: pd.DataFrame) -> pd.DataFrame:
    """Members with the columns `unit`, a number, and `unit_is`, which of `MATRIX`, `START` and `FILE` it is.

    Where files are the units, `file` and `kappa`, the scale of a file's K, are null: they tell no groups apart.
    """
    found = members.assign(unit=members["matrix"].astype("int64"), unit_is=MATRIX)
    starts = found["start_draw"]
    by = [found["n"], found["file"]]
    is_one = found["matrix"].groupby(by, dropna=False).transform("nunique") == 1
    n_starts = starts.groupby(by, dropna=False).transform("nunique")
    of_file = found["file"].notna()
    of_file &= (is_one & (n_starts <= 1)).groupby([of_file, found["n"]]).transform("all")
    of_start = is_one & (n_starts > 1) & starts.notna()
    found.loc[of_file, "unit_is"], found.loc[of_start, "unit_is"] = FILE, START
    found.loc[of_start, "unit"] = starts[of_start].astype("int64")
    if of_file.any():
        found[["file", "kappa"]] = found[["file", "kappa"]].mask(of_file)
    return found


def with_starts(members: pd.DataFrame) -> pd.DataFrame:
    """Members with the columns `z_start` and `w_start`, where every block starts; null where blocks differ.

    What is drawn tells no groups apart: `z0` and `w0` are null where `drawn` says from what.
    """
    found = members.assign(z_start=members["z0"].astype("float64"), w_start=members["w0"].astype("float64"))
    drawn = found["drawn"].astype("string").fillna("")
    for key, column in (("z", "z0"), ("w", "w0")):
        found[column] = found[column].mask(drawn.str.contains(rf"(?:^|; ){key} = "))
    return found


def with_rates(members: pd.DataFrame) -> pd.DataFrame:
    """Members with `growth_rate` as a number, null where friction hangs on the speed of slip.

    It is the rate of the state in which all blocks slip under constant friction. Smoothing and weakening change it.
    """
    hangs = members[list(HANG_ON_SPEED)].notna().any(axis=1)
    return members.assign(growth_rate=members["growth_rate"].astype("float64").mask(hangs))


def unchanged(members: pd.DataFrame) -> pd.DataFrame:
    """Members with the constants and the start of the original of their matrix; all of them where none has."""
    changed = (members["perturbation_size"] > 0) | members["twin_size"].notna()
    return members if changed.all() else members[~changed]


def split(members: pd.DataFrame, keys: Sequence[str]) -> list[tuple[dict[str, Any], pd.DataFrame]]:
    """Members alike in some columns, null as None, with the values that they share."""
    # most columns hold one value, which then stands for all
    differ = {name: len(members[name].unique()) > 1 for name in keys}
    short = {name: members[name] if differ[name] else members[name].iloc[:1] for name in keys}
    plain = {name: column.astype(object).where(column.notna(), None) for name, column in short.items()}
    at: dict[tuple[Any, ...], list[int]] = {}
    columns = (plain[name] if differ[name] else repeat(plain[name].iloc[0], len(members)) for name in keys)
    for k, row in enumerate(zip(*columns, strict=True) if len(members) else ()):
        at.setdefault(row, []).append(k)
    return [(dict(zip(keys, row, strict=True)), members.iloc[some]) for row, some in at.items()]


def groups(members: pd.DataFrame) -> list[Group]:
    """Split members into groups, unperturbed ones first, then by n and engine."""

    def order(part: tuple[dict[str, Any], pd.DataFrame]) -> tuple[Any, ...]:
        key = part[0]
        return (key["perturbation_size"], key["n"], key["engine"], [str(value) for value in key.values()])

    parts = sorted(split(members, (*SYSTEM_KEYS, *ENGINE_KEYS)), key=order)
    keys = [key for key, _ in parts]
    return [Group(label(key, keys), key, alike.sort_values(["unit", "member_id"])) for key, alike in parts]


def law(engine: str) -> str:
    """What pages call an engine."""
    return "exact" if engine == "coulomb" else engine


def label(key: Mapping[str, Any], rivals: Sequence[Mapping[str, Any]]) -> str:
    """Name of a group: n, engine, how it decides what sticks, and whatever sets it apart from the others."""
    parts = [f"n = {key['n']}", law(key["engine"])]
    defaults = ENGINES[key["engine"]].defaults()
    for name in key:
        if name in ("n", "engine", "perturbation_size") or key[name] is None:
            continue
        values = {rival[name] for rival in rivals if rival["engine"] == key["engine"]}
        rule = SETTINGS[name].in_label if name in SETTINGS else "if it differs"
        is_said = rule == "always" or (rule == "unless default" and key[name] != defaults[name])
        if is_said or len(values) > 1:
            parts.append(_plain(key[name]) if name in ("drawn", "parameters") else f"{name} = {_plain(key[name])}")
    if key["perturbation_size"] > 0:
        parts.append(f"perturbed by {_plain(key['perturbation_size'])}")
    return ", ".join(parts)


def _plain(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _fill(group: Group, series: Series, settings: AnalysisSettings) -> None:
    """Read each run of a group once and keep the sums of those in motion."""
    group.units = [int(unit) for unit in group.finished["unit"].unique()]
    n_rows = len(group.units)
    group.means, group.effective, group.stuck = (np.zeros((n_rows, k)) for k in (5, 4, 2))
    group.quantities = {name: np.zeros((n_rows, 2)) for name in QUANTITIES}
    group.histograms = [np.zeros(1, np.int64)] * n_rows
    group.last = np.full((len(group.members), 2), np.nan)
    row_of = {unit: row for row, unit in enumerate(group.units)}
    columns = (group.members[name] for name in ("unit", "member_id", "outcome", "t_end", "growth_rate"))
    for k, (unit, member_id, outcome, t_end, rate) in enumerate(zip(*columns, strict=True)):
        points = None if outcome == "failed" else series[member_id]
        group.fates.append(fate(outcome, points, float(t_end), rate))
        if points is None:
            continue
        group.last[k] = points[0][-1], points[1][-1]
        if group.fates[k] not in MOVING:
            continue
        row, win = row_of[int(unit)], _window(points, str(member_id), settings.t_burn, float(t_end))
        given = {name: quantity.sums(win) for name, quantity in QUANTITIES.items()}
        for name, two in given.items():
            group.quantities[name][row] += two
        first, second, variance = enough.halves(win)
        group.means[row] += [0.5 * (first + second), first, second, variance, 1.0]
        span = win.t_stop - win.t_start
        group.stuck[row] += [0.5 * (first + second) * span, span - lulls(win).sum()]
        tau, is_known = given["correlation_time"]
        group.effective[row] += effective.row(win, tau)
        group.n_short += not is_known or is_short(win, tau)
        found = sizes(win, EVENTS)
        group.histograms[row] = add_histograms(group.histograms[row], np.bincount(found))
    group.n_quiet = group.fates.count(QUIET)
    group.moving = group.members[[how in MOVING for how in group.fates]]
    kept = np.flatnonzero(group.means[:, 4])
    group.units, group.histograms = [group.units[k] for k in kept], [group.histograms[k] for k in kept]
    group.means, group.quantities = group.means[kept], {name: of[kept] for name, of in group.quantities.items()}
    group.stuck = group.stuck[kept]
    group.effective = group.effective[kept] / group.means[:, 4:]


def _window(points: ChangePoints, member_id: str, t_burn: float, t_end: float) -> Window:
    try:
        return window(*points, t_burn, t_end)
    except ValueError as error:
        raise ValueError(f"series of member {member_id!r}: {error}") from error
