"""What runs do in the end: the outcome of each, by setting, and settings grouped by them. Part of `fates`.

The outcome of a run is its attractor, where one is recorded, else its fate. Starts are no part of a setting here:
runs that differ in their start alone are of one setting, drawn or swept.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from stickslip.analysis.by_key import by_key
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Basis, Regime
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import by_ends, listed, plural
from stickslip.analysis.grid import axes_of
from stickslip.analysis.groups import Group
from stickslip.analysis.members import DRAWN, ENGINE_KEYS, noun
from stickslip.analysis.models import attractors, fates
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.stats.shares import wilson
from stickslip.pipeline.design.design import Axis, Unit, in_words
from stickslip.pipeline.design.design import Row as KeyValues
from stickslip.pipeline.design.labels import Label, apart, labels
from stickslip.pipeline.design.values import Amount, Named, Value, Values, ranks

MOST_STRETCHES = 3  # of values of a key, that a finding names
MOST_LEADING = 3  # findings
MOST_CYCLES = 4  # of one system, that are told apart
LEAST_UNITS = 4  # for a bound on a share that is 1
_START = ("z", "w")
#: What runs do, by kind of outcome: verb phrases in the plural, with {} for when, where it may yet change.
PREDICATES = {
    attractors.REST: "come to rest",
    attractors.SLIDING: "end in steady sliding",
    attractors.PERIODIC: "end on a limit cycle",
    attractors.TORUS: "end on a torus",
    attractors.IRREGULAR: "stay irregular",
    attractors.ESCAPING: "grow without limit",
    fates.QUIET: "slide{} but may stick again",
    fates.SUSTAINED: "still stick and slip{}",
    fates.LULL: "slide{} but will stick again",
    fates.UNMOVED: "are stuck{}",
    attractors.UNDECIDED: "are undecided",
}
OUTCOMES = (*PREDICATES,)  # in the order of pages


class Outcome(NamedTuple):
    """What a run does in the end: the kind and, of a cycle, its exits per period; 0 where these tell none apart."""

    kind: str
    exits: int = 0


class Runs(NamedTuple):
    """Runs whose outcome is known, shape (m,) each: their rows among the members; units are independent.

    `cycles` are numbers of the cycles of a system, 0 for those that are not told apart.
    """

    rows: np.ndarray
    units: np.ndarray
    kinds: np.ndarray
    exits: np.ndarray
    cycles: np.ndarray

    def at(self, chosen: np.ndarray) -> Runs:
        return Runs(*(column[chosen] for column in self))

    def n_of(self, kind: str) -> int:
        return int(np.sum(self.kinds == kind))

    def in_outcome(self, kind: str, cycle: int | None) -> np.ndarray:
        """Which runs have an outcome."""
        return np.asarray((self.kinds == kind) & (self.cycles == (cycle or 0)))

    def may_be(self, kind: str) -> np.ndarray:
        """Which runs of unknown outcome may have this one: sliding without a proof is steady, or sticks again."""
        unproved = (self.kinds == fates.QUIET) & (kind in (attractors.SLIDING, fates.SUSTAINED))
        return unproved | ((self.kinds == attractors.UNDECIDED) & (kind != attractors.UNDECIDED))


@dataclass(frozen=True, eq=False)
class Setting:
    """Runs that differ only in their start and in what is drawn.

    Attributes
    ----------
    groups : tuple of Group
        One for each start that is swept.
    label, method : Label
        What tells its system, and its engine, from those of other settings.
    at : tuple of KeyValues
        Its values along the axes of `Grid`.
    of_starts : bool
        Whether its units are starts of one system.
    is_recorded : bool
        Whether it is recorded what its runs settle on.
    """

    groups: tuple[Group, ...]
    label: Label
    method: Label
    at: tuple[KeyValues, ...]
    runs: Runs
    of_starts: bool
    is_recorded: bool

    @property
    def where(self) -> Place:
        return Place.of(self.label) + Place.of(self.method)

    @property
    def t_end(self) -> float:
        return float(self.groups[0].key["t_end"])

    @property
    def n_units(self) -> int:
        return len(np.unique(self.runs.units))

    @cached_property
    def kinds(self) -> tuple[Outcome, ...]:
        """What its runs do in the end, each once."""
        known = {*self.runs.kinds.tolist()} - {attractors.UNDECIDED}
        return tuple(Outcome(kind) for kind in OUTCOMES if kind in known)

    @cached_property
    def exits(self) -> tuple[Outcome, ...]:
        """As `kinds`, with cycles told apart by their exits per period."""
        exits = np.unique(self.runs.exits[self.runs.kinds == attractors.PERIODIC]).tolist()
        by_kind = {attractors.PERIODIC: [Outcome(attractors.PERIODIC, n) for n in exits]}
        return tuple(outcome for kind in self.kinds for outcome in by_kind.get(kind.kind, [kind]))


class Grid(NamedTuple):
    """The settings of a study, by value, and the axes along which they differ, the longest first."""

    settings: list[Setting]
    axes: list[Axis]

    @property
    def methods(self) -> dict[Label, list[Setting]]:
        """Settings by method."""
        return by_key(self.settings, lambda setting: setting.method)

    def beside(self, setting: Setting) -> Place:
        """Where the line of a setting lies among those of its method."""
        axes = zip(self.axes[1:], setting.at[1:], strict=True)
        return Place(tuple((axis.name, in_words(row)) for axis, row in axes))

    @property
    def recorded_lines(self) -> Iterator[list[Setting]]:
        """Lines along numbers, method by method, of settings of which it is recorded what their runs settle on."""
        if self.axes and self.axes[0].x is not None:
            for settings in self.methods.values():
                recorded = [setting for setting in settings if setting.is_recorded]
                yield from self.lines(recorded) if recorded else ()

    def lines(self, settings: Sequence[Setting]) -> list[list[Setting]]:
        """Settings of a method along the first axis, at each row of the others."""
        if not self.axes:
            return [[*settings]]
        in_order = sorted(settings, key=lambda setting: [*map(ranks, setting.at[1:]), ranks(setting.at[0])])
        return [[*line] for _, line in groupby(in_order, key=lambda setting: setting.at[1:])]


def grid_of(study: Study) -> Grid:
    """The unchanged runs of a study by setting; settings of which all runs failed are left out."""
    like = by_key(study.groups, lambda group: tuple(_regardless_of_start(group).values()))
    firsts = [groups[0] for groups in like.values()]
    names = apart(labels([_regardless_of_start(group) for group in firsts]))
    axes = _axes(firsts)
    settings = [
        setting
        for name, groups in zip(names, like.values(), strict=True)
        if len((setting := _setting(study, name, groups, axes)).runs.rows)
    ]
    return Grid(settings, axes)


def _regardless_of_start(group: Group) -> dict[str, Any]:
    """The key of a group, without where its runs begin."""
    values = Values(pair for pair in group.key["values"] if pair[0] not in _START)
    return group.key | {"z0": None, "w0": None, "values": values}


def _axes(groups: Sequence[Group]) -> list[Axis]:
    """Along which some groups differ: the number of blocks or the file, and what is swept."""
    swept = [axis for axis in axes_of(groups) if not {*axis.keys} <= {*_START}]
    source = "file" if len({group.point.file for group in groups}) > 1 else "n"
    rows = sorted({(_values(group)[source],) for group in groups}, key=ranks)
    axes = [Axis((source,), tuple(rows)), *swept] if len(rows) > 1 else swept
    return sorted(axes, key=lambda axis: (axis.keys == ("file",), -len(axis.rows)))  # files have no order


def _values(group: Group) -> dict[str, Value]:
    """What a group has of each key that an axis may have."""
    source: dict[str, Value] = {"n": group.point.n, "file": Named(group.key["file"] or "")}
    return source | group.table.design.swept(group.point)


def _setting(study: Study, name: Label, groups: Sequence[Group], axes: Sequence[Axis]) -> Setting:
    of_method = {"", *ENGINE_KEYS}
    method, label = (
        Label.of([symbol for symbol in name.parts if (symbol[0] in of_method) == is_of_method])
        for is_of_method in (True, False)
    )
    rows = np.concatenate([group.rows for group in groups])
    kinds = np.concatenate([_fates(group) for group in groups])
    members = study.data.table.own
    is_known, is_recorded = kinds != fates.FAILED, False
    if "attractor" in members and members["attractor"].iloc[rows].notna().any():
        kinds = members["attractor"].iloc[rows].to_numpy(object)
        is_known, is_recorded = members["attractor"].iloc[rows].notna().to_numpy(), True
    rows, kinds = rows[is_known], kinds[is_known]
    matrices, units = (members[column].to_numpy()[rows] for column in ("matrix", "unit"))
    is_alone = len(np.unique(matrices)) == 1
    of_starts = is_alone and (groups[0].unit == Unit.START or len(groups) > 1 or (is_recorded and len(rows) > 1))
    nothing = np.zeros(len(rows), dtype=np.int64)
    exits = np.nan_to_num(study.number("exits_per_period")[rows]).astype(np.int64) if is_recorded else nothing
    runs = Runs(rows, np.arange(len(rows)) if of_starts else units, kinds, exits, nothing)
    values = _values(groups[0])
    position = tuple(tuple(values[key] for key in axis.keys) for axis in axes)
    runs = told_apart(study, runs) if is_alone else runs
    return Setting(tuple(groups), label, method, position, runs, of_starts, is_recorded)


def _fates(group: Group) -> np.ndarray:
    """The fate of each run of a group as a kind of outcome, or `fates.FAILED`."""
    kinds = group.fates.copy()
    t_last, n_last = group.last.T
    is_stuck = fates.is_held(t_last, n_last, int(group.key["n"]), float(group.key["t_end"]))
    kinds[(kinds == fates.SUSTAINED) & is_stuck] = fates.UNMOVED
    kinds[kinds == fates.COLLAPSED], kinds[kinds == fates.DIVERGED] = attractors.SLIDING, attractors.ESCAPING
    return kinds


def told_apart(study: Study, runs: Runs) -> Runs:
    """The runs of one system with the numbers of their cycles."""
    which = np.flatnonzero(runs.kinds == attractors.PERIODIC)
    if not len(which):
        return runs
    section_z, section_w = (study.data.lists[name] for name in ("section_z", "section_w"))
    names = study.data.table.own["member_id"].to_numpy(object)[runs.rows[which]]
    events, periods = (study.number(name)[runs.rows[which]] for name in ("events_per_period", "period"))
    columns = zip(names, events, runs.exits[which], periods, strict=True)
    cycles = [
        attractors.Cycle(int(n_events), int(n_exits), float(period), section_z[name], section_w[name])
        for name, n_events, n_exits, period in columns
    ]
    numbers = runs.cycles.copy()
    numbers[which] = [number if number <= MOST_CYCLES else 0 for number in attractors.alike(cycles)]
    return runs._replace(cycles=numbers)


# ------------------------------------------------------------------------------------------------- words


def predicates(study: Study, outcomes: Sequence[Outcome], settings: Sequence[Setting]) -> tuple[str, ...]:
    """What runs at some settings do, a verb phrase each; the first that may yet change says when."""
    words = [*map(_words, outcomes)]
    ends = {setting.t_end for setting in settings}
    when = f" at t = {study.settings.at(ends.pop())}" if len(ends) == 1 else " at their end"
    place = next((k for k, word in enumerate(words) if "{}" in word), 0)
    return tuple(word.format(when if k == place else "") for k, word in enumerate(words))


def _words(outcome: Outcome) -> str:
    exits = f" of {plural(outcome.exits, 'exit')} per period" if outcome.exits else ""
    return PREDICATES[outcome.kind] + exits


def unit(study: Study, settings: Iterable[Setting]) -> str:
    """What is independent at some settings, in the singular."""
    return "start" if all(setting.of_starts for setting in settings) else noun(study.unit)


def things(basis: Basis) -> str:
    """What runs are called, in the plural."""
    return "starts" if basis.unit == "start" else "runs"


# ------------------------------------------------------------------------------------------------- shares


@dataclass(frozen=True)
class Portion:
    """The runs of a setting that have an outcome: how many, and their share.

    Of cycles, `cycle` is the number among those of the system, the period a median, the multiplier the largest.
    """

    setting: str
    outcome: str
    cycle: int | None
    n_runs: int
    of: int
    share: Estimate
    period: float | None = None
    multiplier: float | None = None


def portions(study: Study, runs: Runs, name: str = "", besides: Iterable[str] = ()) -> list[Portion]:
    """The outcomes of some runs in the order of pages, and kinds besides, with no runs if no run has them.

    A share is of the runs that are shown to have an outcome, its interval also of those that may (`Runs.may_be`).
    """
    outcomes = {*zip(runs.kinds.tolist(), runs.cycles.tolist(), strict=True)}
    outcomes |= {(kind, 0) for kind in {*besides} - {*runs.kinds.tolist()}}
    order = sorted(outcomes, key=lambda pair: (OUTCOMES.index(pair[0]), pair[1] or MOST_CYCLES + 1))
    rows = []
    for kind, cycle in order:
        has = runs.in_outcome(kind, cycle)
        share = share_of(has, runs.may_be(kind), runs.units, study.settings.confidence)
        row = Portion(name, kind, cycle or None, int(has.sum()), len(has), share)
        if kind == attractors.PERIODIC and has.any():
            period, multiplier = (study.number(number)[runs.rows[has]] for number in ("period", "multiplier"))
            row = replace(row, period=float(np.median(period)), multiplier=float(multiplier.max()))
        rows.append(row)
    return rows


def share_of(has: np.ndarray, untold: np.ndarray, units: np.ndarray, confidence: float) -> Estimate:
    """Share of runs that have something, which is unknown of others; dependent in one unit: that has no interval."""
    place = np.unique(units, return_inverse=True)[1]
    counts = np.column_stack([np.bincount(place, has), np.bincount(place, untold), np.bincount(place)])
    share = fates.bounded_share(counts, confidence)
    return share if len(counts) > 1 else Estimate(share.value)


def together(settings: Sequence[Setting]) -> Runs:
    """The runs of some settings; those that share what is drawn are of one unit."""
    if len(settings) == 1:
        return settings[0].runs
    draws = [tuple(setting.groups[0].key[name] for name in DRAWN) for setting in settings]
    numbers = np.repeat([*map(draws.index, draws)], [len(setting.runs.rows) for setting in settings])
    columns = map(np.concatenate, zip(*(setting.runs for setting in settings), strict=True))
    rows, units, kinds, exits, cycles = columns
    units = np.unique(np.column_stack([numbers, units]), axis=0, return_inverse=True)[1]
    return Runs(rows, units, kinds, exits, 0 * cycles)


# ------------------------------------------------------------------------------------------------- regimes


def stretches(outcomes: Sequence[tuple[Outcome, ...]]) -> list[slice]:
    """Neighbouring settings of the same outcomes; what is not known is in one only if it goes on beyond."""
    decided = [(k, outcome) for k, outcome in enumerate(outcomes) if outcome]
    numbers = [[k for k, _ in group] for _, group in groupby(decided, lambda pair: pair[1])]
    return [slice(group[0], group[-1] + 1) for group in numbers]


def regimes(
    study: Study, grid: Grid, line: Sequence[Setting], outcomes: Sequence[tuple[Outcome, ...]], method: Place
) -> list[tuple[Regime, Sequence[Setting]]]:
    """A line by what its runs do, with the settings: at which values, or of many stretches at how many.

    Of more outcomes than lead a page, those come first that all runs of a setting share.
    """
    axis = grid.axes[0]
    by_outcome = by_key(stretches(outcomes), lambda stretch: outcomes[stretch.start])
    line_place = grid.beside(line[0]) + method
    in_order = [*by_outcome]
    if len(in_order) > MOST_LEADING:
        in_order.sort(key=lambda outcome: len(outcome) > 1)
    rows: list[tuple[Regime, Sequence[Setting]]] = []
    for outcome in in_order:
        alike_stretches = by_outcome[outcome]
        settings = [setting for stretch in alike_stretches for setting in line[stretch]]
        if len(outcome) > 1 and len(settings) <= MOST_STRETCHES:  # each has a share of its own
            alone = [(Place.key(axis.name, in_words(setting.at[0])), setting) for setting in settings]
            rows += [(_regime(study, where + line_place, [setting], outcome), [setting]) for where, setting in alone]
            continue
        names = [[in_words(setting.at[0]) for setting in line[stretch]] for stretch in alike_stretches]
        texts = [text for neighbours in names for text in by_ends(neighbours)]
        where = Place.key(axis.name, listed(texts) if axis.x is None else Amount(listed(texts)))
        if len(alike_stretches) > MOST_STRETCHES:
            where = Place.words(f"at {len(settings)} of {len(line)} values of {axis.name}")
        rows.append((_regime(study, where + line_place, settings, outcome), settings))
    return rows


def _regime(study: Study, where: Place, settings: Sequence[Setting], outcomes: Sequence[Outcome]) -> Regime:
    """What runs do at some settings, with the share that is shown to have the first outcome."""
    runs, level = together(settings), study.settings.confidence
    in_order = sorted(outcomes, key=lambda outcome: "{}" in _words(outcome))
    has = (runs.kinds == in_order[0].kind) & ((runs.exits == in_order[0].exits) | (in_order[0].exits == 0))
    n_units = max(setting.n_units for setting in settings)
    share, is_of_each = Estimate(float(has.mean())), False
    if n_units >= LEAST_UNITS:  # settings that share their draws count once
        share = share_of(has, runs.may_be(in_order[0].kind), runs.units, level)
        if has.all():
            is_of_each = len(settings) > 1
            share = Estimate(1.0, wilson(n_units, n_units, level)[0], 1.0)
    undecided = [Outcome(attractors.UNDECIDED)] * bool(runs.n_of(attractors.UNDECIDED))
    words = predicates(study, [*in_order, *undecided], settings)
    basis = Basis(n_units, unit(study, settings))
    return Regime(in_order[0].kind, things(basis), words, int(has.sum()), len(has), share, where, basis, is_of_each)
