"""What runs settle on, where that is recorded: shares, basins, and what changes along swept keys. Part of `fates`.

Starts are no part of a setting here: runs that differ in their start alone are one group, drawn or swept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from stickslip.analysis.answer import Answer, F, I, Picture, Row, S, Table, frame, named, systems
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import (
    Alike,
    Basis,
    Comparison,
    Difference,
    Finding,
    Quantity,
    Regimes,
    Scale,
    Share,
)
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.findings.words import based_on, plural
from stickslip.analysis.grid import MOST_SETTINGS, axes_of, dtype, place_of, settings
from stickslip.analysis.groups import Group
from stickslip.analysis.models.attractors import (
    ESCAPING,
    IRREGULAR,
    KINDS,
    PERIODIC,
    REST,
    SLIDING,
    TORUS,
    UNDECIDED,
    Cycle,
    alike,
    plane,
)
from stickslip.analysis.questions.runs import fate_figures as figures
from stickslip.analysis.questions.runs.fate_figures import CYCLES, LOOKS, OTHERS, Look, Points, Sections
from stickslip.analysis.questions.runs.regimes import Tally, least_share, regimes, stretches_of
from stickslip.analysis.series.runs import by_number
from stickslip.analysis.stats.compare import share_over_matrices
from stickslip.analysis.stats.estimates import Estimate
from stickslip.pipeline.design.design import Axis, in_words
from stickslip.pipeline.design.labels import Label, labels
from stickslip.pipeline.design.values import Value, ranks

_MOST_BARS, _MOST_LINES = 24, 12
_MOST_CYCLES = 4  # that are named apart
_MOST_DIAGRAMS = 3  # of bifurcations, at values of a second key
_ONE_DOT = 1e-3  # of the range of values: what is closer is drawn once
_SCHEMA = {
    "group": S, "attractor": S, "cycle": I, "n_runs": I, "of": I, "share": F, "share_low": F, "share_high": F,
    "exits": I, "period_least": F, "period_median": F, "period_most": F, "multiplier": F,
}  # fmt: skip
_RANGES = {
    "setting": S, "key": S, "first": S, "last": S, "attractors": S, "n_runs": I, "n_undecided": I, "least_share": F,
    "multiplier_first": F, "multiplier_last": F,
}  # fmt: skip
_NUMBERS = ("period", "multiplier", "exits_per_period", "events_per_period")
PERIOD = Quantity("period", "period of the cycle")
PREDICATES = {
    REST: "come to rest", SLIDING: "settle into steady sliding", PERIODIC: "settle on a cycle",
    TORUS: "settle on a torus",
    IRREGULAR: "stay irregular", ESCAPING: "grow without limit", UNDECIDED: "are undecided",
}  # fmt: skip
METHOD = (
    "Each run is followed on from its end: a cycle repeats its events and comes back to its state, steady sliding and"
    " rest are certified, and small deviations grow at a steady rate in irregular motion. Shares have Wilson's"
    " interval, for as many independent runs as the scatter between systems allows."
)


class Settled(NamedTuple):
    """What a run settles on: the kind and, of a cycle, its exits per period and its number among those of its system.

    The number is 0 for cycles that are not told apart.
    """

    kind: str
    exits: int = 0
    cycle: int = 0

    @property
    def predicate(self) -> str:
        """A verb phrase in the plural."""
        if self.kind != PERIODIC:
            return PREDICATES[self.kind]
        return f"settle on a cycle of {plural(self.exits, 'exit')} per period"

    @property
    def words(self) -> str:
        """For a table."""
        return f"{self.kind}, {plural(self.exits, 'exit')} per period" if self.kind == PERIODIC else self.kind


class Runs(NamedTuple):
    """Runs that have an attractor: arrays of a length; numbers of a cycle are NaN for what is none."""

    member_id: np.ndarray
    matrix: np.ndarray
    unit: np.ndarray
    attractor: np.ndarray
    period: np.ndarray
    multiplier: np.ndarray
    exits_per_period: np.ndarray
    events_per_period: np.ndarray
    cycle: np.ndarray

    @property
    def n(self) -> int:
        return len(self.member_id)

    @property
    def is_one_system(self) -> bool:
        return bool((self.matrix == self.matrix[0]).all())

    @property
    def n_units(self) -> int:
        """How many are independent: starts of one system, or else units."""
        return self.n if self.is_one_system else len(np.unique(self.unit))

    @property
    def cycles(self) -> list[Settled]:
        """What each settles on, with cycles told apart by their numbers."""
        return [Settled(kind, 0, int(cycle)) for kind, cycle in zip(self.attractor, self.cycle, strict=True)]

    @property
    def exits(self) -> list[Settled]:
        """What each settles on, with cycles told apart by their exits per period."""
        pairs = zip(self.attractor, np.nan_to_num(self.exits_per_period), strict=True)
        return [Settled(kind, int(exits)) for kind, exits in pairs]

    def at(self, which: np.ndarray) -> Runs:
        return Runs(*(column[which] for column in self))

    def n_of(self, kind: str) -> int:
        return int((self.attractor == kind).sum())


@dataclass(frozen=True)
class Attractor:
    """An attractor of a group: its share of the runs, and what its cycles are like; None for what is no cycle.

    Attributes
    ----------
    what : Settled
    n_runs, of : int
    share : Estimate
    exits : int, optional
        Per period, if all have as many.
    period : tuple of float, optional
        The least, the median and the largest.
    multiplier : float, optional
        The largest.
    """

    what: Settled
    n_runs: int
    of: int
    share: Estimate
    exits: int | None
    period: tuple[float, float, float] | None
    multiplier: float | None

    def predicate(self, is_only_cycle: bool) -> str:
        if self.what.kind != PERIODIC or is_only_cycle:
            return PREDICATES[self.what.kind]
        if not self.what.cycle or self.period is None:
            return "settle on other cycles"
        return f"settle on the cycle of period {self.period[1]:.4g}"

    def row(self, group: str) -> Row:
        periods = self.period or (None, None, None)
        return {
            "group": group, "attractor": self.what.kind, "cycle": self.what.cycle or None, "n_runs": self.n_runs,
            "of": self.of, **named("share", self.share), "exits": self.exits, "multiplier": self.multiplier,
            **dict(zip(("period_least", "period_median", "period_most"), periods, strict=True)),
        }  # fmt: skip


class _Line(NamedTuple):
    """The runs along a swept key at one value of each other key, `others`, and of the scene's other settings."""

    setting: Label
    is_exact: bool
    others: dict[Axis, tuple[Value, ...]]
    along: list[tuple[Value, ...]]
    runs: list[Runs]

    @property
    def texts(self) -> list[str]:
        return [in_words(value) for value in self.along]

    def where(self, has_settings: bool) -> Place:
        """At which values of the other keys it lies, and in which of several settings."""
        at = Place(tuple((axis.name, in_words(value)) for axis, value in self.others.items()))
        return Place.of(self.setting) + at if has_settings else at


def settled(study: Study) -> Answer | None:
    """What runs settle on; None where no run has a record of it."""
    members = study.data.table.own
    groups = regardless_of_start(study, members["attractor"].notna().to_numpy()) if "attractor" in members else []
    if not groups:
        return None
    runs = {group.name: _runs(study, group) for group in groups}
    attractors = {name: list(_attractors(study, part, study.settings.published)) for name, part in runs.items()}
    tables: dict[str, Table] = {
        "attractors": frame(_SCHEMA, (row.row(name) for name, rows in attractors.items() for row in rows))
    }
    by_setting, axes = settings(groups), axes_of(groups)
    basin, pictures = _basin(study, runs), dict[str, Picture]()
    if axes:
        lines = [line for setting, part in by_setting.items() for line in _lines(setting, part, axes, runs)]
        findings, n_lead = _along(study, axes[0], lines, len(by_setting) > 1)
        columns, rows = _range_rows(study, axes, lines, len(by_setting) > 1)
        tables["attractor_ranges"] = frame(columns | _RANGES, rows)
        pictures = _pictures_along(study, axes, lines)
    else:
        shares = [_findings(study, Place.of(name) if len(runs) > 1 else EVERYWHERE, attractors[name], runs[name])
                  for name in list(runs)[:_MOST_LINES]]  # fmt: skip
        findings = [finding for part in shares for finding in part]
        n_lead = 1 + (len(next(iter(attractors.values()))) > 2)  # of two, one says both
        if len(runs) > 1:
            pictures["attractors"] = _bars(runs)
    return Answer(findings=findings, n_lead=n_lead, tables=tables, figures={**pictures, **basin}, method=METHOD)


def n_undecided(study: Study) -> tuple[int, int]:
    """How many runs that have an attractor are undecided, and how many have one."""
    members = study.data.table.own
    if "attractor" not in members:
        return 0, 0
    kinds = members["attractor"].iloc[study.data.table.unchanged]
    return int((kinds == UNDECIDED).sum()), int(kinds.notna().sum())


# ------------------------------------------------------------------------------------------------- runs and shares


def regardless_of_start(study: Study, has: np.ndarray) -> list[Group]:
    """The groups of the study, those that differ in their starts alone as one, of some members by their rows."""
    alike_but_start: dict[tuple[Any, ...], list[Group]] = {}
    for group in study.groups:
        alike_but_start.setdefault(tuple((group.key | {"z0": None, "w0": None}).values()), []).append(group)
    keys, swept, rows = [], [], []
    for values, groups in alike_but_start.items():
        members = np.concatenate([group.rows for group in groups])
        if has[members].any():
            rows.append(members[has[members]])
            keys.append(dict(zip(study.groups[0].key, values, strict=True)))
            at = study.data.table.design.swept(groups[0].point)
            swept.append({name: value for name, value in at.items() if name not in ("z", "w")})
    parts = zip(labels(keys, swept), keys, rows, strict=True)
    return [Group(name, key, study.data.table, members) for name, key, members in parts]


def _runs(study: Study, group: Group) -> Runs:
    """The runs of a group; cycles are told apart where all are of one system."""
    members = group.members
    names = members["member_id"].to_numpy(object)
    period, multiplier, exits, events = (study.number(name)[group.rows] for name in _NUMBERS)
    runs = Runs(
        names, members["matrix"].to_numpy(), members["unit"].to_numpy(), members["attractor"].to_numpy(object),
        period, multiplier, exits, events, np.zeros(len(names), dtype=np.int64),
    )  # fmt: skip
    return _numbered(study, runs) if runs.is_one_system else runs


def _numbered(study: Study, runs: Runs) -> Runs:
    """The runs of one system with the number of the cycle of each."""
    which = np.flatnonzero(runs.attractor == PERIODIC)
    section_z, section_w = (study.data.lists[name] for name in ("section_z", "section_w"))
    columns = (runs.member_id, runs.events_per_period, runs.exits_per_period, runs.period)
    rows = zip(*(column[which] for column in columns), strict=True)
    cycles = [Cycle(int(events), int(exits), float(period), section_z[name], section_w[name])
              for name, events, exits, period in rows]  # fmt: skip
    number = np.zeros(runs.n, dtype=np.int64)
    number[which] = [cycle if cycle <= _MOST_CYCLES else 0 for cycle in alike(cycles)]
    return runs._replace(cycle=number)


def _attractors(study: Study, runs: Runs, named: Iterable[str] = ()) -> Iterator[Attractor]:
    """The attractors of a group in the order of the page, and those named, with no runs if no run settles on them."""
    units = np.arange(runs.n) if runs.is_one_system else np.unique(runs.unit, return_inverse=True)[1]
    of = np.bincount(units)
    for what in _in_order([*runs.cycles, *(Settled(kind) for kind in {*named} - {*runs.attractor})]):
        has = (runs.attractor == what.kind) & (runs.cycle == what.cycle)
        counts = np.column_stack([np.bincount(units, has), of])
        share, low, high, _ = share_over_matrices(counts, study.settings.confidence)
        part = runs.at(has)
        exits, periods = np.unique(_known(part.exits_per_period)), _known(part.period)
        least, median, most = np.percentile(periods, (0, 50, 100)).tolist() if len(periods) else 3 * [0.0]
        yield Attractor(
            what, part.n, runs.n, Estimate(share, low, high), int(exits[0]) if len(exits) == 1 else None,
            (least, median, most) if len(periods) else None, _most(part.multiplier),
        )  # fmt: skip


def _in_order(settled_on: Sequence[Settled]) -> list[Settled]:
    """Each once, in the order of the page: cycles by their exits and numbers, those without a number last."""
    order = {what: (KINDS.index(what.kind), what.exits, what.cycle or _MOST_CYCLES + 1) for what in settled_on}
    return sorted(order, key=order.__getitem__)


def _known(numbers: np.ndarray) -> np.ndarray:
    return numbers[~np.isnan(numbers)]


def _most(numbers: np.ndarray) -> float | None:
    known = _known(numbers)
    return float(known.max()) if len(known) else None


def _findings(study: Study, where: Place, attractors: Sequence[Attractor], runs: Runs) -> list[Finding]:
    """The share of each attractor of a group, and the period that all cycles share."""
    things = "starts" if runs.is_one_system and runs.n > 1 else "runs"
    n_cycles = sum(attractor.what.kind == PERIODIC for attractor in attractors)
    basis = Basis(runs.n_units, _unit(study, [runs]))
    shares: list[Finding] = [
        Share(
            attractor.what.kind, things, attractor.predicate(n_cycles == 1), attractor.share, where,
            _published(study, attractor, n_cycles), basis,
        )
        for attractor in attractors
    ]  # fmt: skip
    cycle = next((attractor for attractor in attractors if attractor.what == Settled(PERIODIC, 0, 1)), None)
    if n_cycles == 1 and cycle is not None and cycle.period is not None and cycle.n_runs > 1:
        among = Basis(cycle.n_runs, things[:-1])
        shares.append(Alike(PERIOD, cycle.period[1], f"from all {based_on(among)}", where, among))
    return shares


def _unit(study: Study, runs: Sequence[Runs]) -> str:
    """What is independent of some runs."""
    if all(part.is_one_system for part in runs):
        return "start"
    return systems(study)


def _published(study: Study, attractor: Attractor, n_cycles: int) -> Comparison | None:
    """The share of an attractor beside the one that the scene names as published."""
    value = study.settings.published.get(attractor.what.kind)
    share = attractor.share
    is_part = attractor.what.kind == PERIODIC and n_cycles > 1
    if value is None or share.value is None or share.low is None or share.high is None or is_part:
        return None
    difference = Estimate(share.value - value, share.low - value, share.high - value)
    return Comparison(f"the published {100 * value:g}%", Difference(difference, Scale.ABSOLUTE))


def _bars(runs: Mapping[Label, Runs]) -> Picture:
    drawn = list(runs.items())[:_MOST_BARS]
    counts = {kind: [part.n_of(kind) for _, part in drawn] for kind in KINDS}
    more = f", of the first {_MOST_BARS} settings" if len(runs) > _MOST_BARS else ""
    recipe = partial(figures.shares, "", [name for name, _ in drawn], counts, LOOKS)
    return Picture(recipe, f"One colour: all runs settle alike. Shares of runs by setting{more}.")


# ------------------------------------------------------------------------------------------------- basins


def _basin(study: Study, runs: Mapping[Label, Runs]) -> dict[str, Picture]:
    """The starts of one system by what they settle on; nothing if all settle on one, or not one or two numbers vary.

    Of several systems, that of which most runs settle on others than the commonest.
    """
    lists = study.data.lists
    systems = [
        (name, part.at(rows)) for name, part in runs.items() for rows in by_number(part.matrix) if len(rows) > 1
    ]
    if not systems or not lists.get("start_z"):  # a dataset of before
        return {}
    name, system = max(systems, key=lambda pair: pair[1].n - max(Counter(pair[1].cycles).values()))
    system = _numbered(study, system)
    z, w = (np.array([lists[key][member] for member in system.member_id]) for key in ("start_z", "start_w"))
    starts, attractors = plane(z, w), list(_attractors(study, system))
    if len(attractors) == 1 or starts is None:
        return {}
    kinds = [attractor.what for attractor in attractors]
    number = np.array([kinds.index(what) for what in system.cycles])
    entries = [_entry(attractor) for attractor in attractors]
    which = name if len(runs) > 1 else "the system whose starts differ most" if len(systems) > 1 else ""
    caption = (
        f"Each colour is a basin of attraction. Attractors by start, with their shares{f' ({which})' * bool(which)}."
    )
    return {"basin_of_attractors": Picture(figures.basin(starts, number, entries), caption)}


def _entry(attractor: Attractor) -> tuple[Look, str]:
    """How an attractor is drawn, and its entry in a legend, with its share and the interval."""
    what, share = attractor.what, attractor.share
    look = LOOKS[what.kind]
    words = look.words
    if what.kind == PERIODIC:
        look = CYCLES[what.cycle - 1] if what.cycle else OTHERS
        words = "other cycles"
        if what.cycle and attractor.period is not None:
            exits = attractor.exits or 0
            words = f"cycle, period {attractor.period[1]:.4g}" + (f", {exits} exits" if exits > 1 else "")
    value, low, high = (f"{100 * (end or 0.0):.1f}" for end in (share.value, share.low, share.high))
    return look, f"{words}: {value}% ({low} to {high})"


# ------------------------------------------------------------------------------------------------- along a key


def _lines(
    setting: Label, groups: Sequence[Group], axes: Sequence[Axis], runs: Mapping[Label, Runs]
) -> Iterator[_Line]:
    """The lines of a setting along the first axis, in the order of the values of the others."""
    axis, *others = axes
    at_others: dict[tuple[tuple[Value, ...], ...], list[tuple[tuple[Value, ...], Runs]]] = {}
    for group in groups:
        at = place_of(axes, group)
        at_others.setdefault(tuple(at[other] for other in others), []).append((at[axis], runs[group.name]))
    for here in sorted(at_others, key=lambda at: [*map(ranks, at)]):
        values, line = zip(*sorted(at_others[here], key=lambda pair: ranks(pair[0])), strict=True)
        yield _Line(setting, groups[0].is_exact, dict(zip(others, here, strict=True)), list(values), list(line))


def _places(line: _Line, has_exits: bool) -> list[Tally]:
    """What runs settle on at each value of a line: kinds alone, or cycles by their exits too."""
    places = []
    for runs in line.runs:
        decided = [what for what in _in_order(runs.exits) if what.kind != UNDECIDED]
        outcomes = (what.predicate if has_exits else PREDICATES[what.kind] for what in decided)
        places.append(Tally(tuple(dict.fromkeys(outcomes)), runs.n - runs.n_of(UNDECIDED), runs.n, runs.n_units))
    return places


def _along(study: Study, axis: Axis, lines: Sequence[_Line], has_settings: bool) -> tuple[list[Finding], int]:
    """Where along a key what runs settle on changes, and how many of these findings lead: of the first and the last.

    Of a single line also where the exits of its cycle per period change.
    """
    unit = _unit(study, [runs for line in lines for runs in line.runs])
    things = "starts" if unit == "start" else "runs"
    kinds: list[Finding] = []
    cycles: list[Finding] = []
    drawn = lines if len(lines) < _MOST_LINES else [*lines[: _MOST_LINES - 1], lines[-1]]
    for line in [drawn[0], *drawn[:0:-1][:1], *drawn[1:-1]]:
        by_kind, by_exits = (_places(line, has_exits) for has_exits in (False, True))
        for findings, places in ((kinds, by_kind), (cycles, by_exits)):
            if places is by_kind or stretches_of(by_kind) != stretches_of(by_exits):
                along = regimes(axis.name, line.texts, places, study.settings.confidence, unit)
                findings.append(Regimes(things, along, line.where(has_settings)))
    return [*kinds, *cycles], 1 + len(cycles) if len(lines) == 1 else 2


def _range_rows(
    study: Study, axes: Sequence[Axis], lines: Sequence[_Line], has_settings: bool
) -> tuple[dict[str, str], list[Row]]:
    """The table `attractor_ranges`: columns of the other keys, and rows."""
    axis, *others = axes
    columns = {key: dtype(other, k) for other in others for k, key in enumerate(other.keys)}
    rows: list[Row] = []
    for line in lines:
        keys = {key: value for other, at in line.others.items() for key, value in zip(other.keys, at, strict=True)}
        places = _places(line, True)
        for stretch in stretches_of(places):
            here = places[stretch.first : stretch.last + 1]
            multipliers = [_most(runs.multiplier) for runs in line.runs[stretch.first : stretch.last + 1]]
            n_runs = sum(place.of for place in here)
            rows.append(keys | {
                "setting": line.setting if has_settings else None, "key": axis.name,
                "first": line.texts[stretch.first], "last": line.texts[stretch.last],
                "attractors": "; ".join(what.words for what in _in_order(line.runs[stretch.first].exits)
                                        if what.kind != UNDECIDED),
                "n_runs": n_runs,
                "n_undecided": n_runs - sum(place.n for place in here),
                "least_share": least_share(here, study.settings.confidence),
                "multiplier_first": multipliers[0], "multiplier_last": multipliers[-1],
            })  # fmt: skip
    return columns, rows


# ------------------------------------------------------------------------------------------------- figures


def _pictures_along(study: Study, axes: Sequence[Axis], lines: Sequence[_Line]) -> dict[str, Picture]:
    """Shares along the one key or a map over the first two, and bifurcation diagrams.

    Each of few settings has its own: those of the exact law first, and of these those of most lines.
    """
    n_lines = Counter(line.setting for line in lines)
    is_exact = {line.setting: line.is_exact for line in lines}
    names = sorted(n_lines, key=lambda name: (not is_exact[name], -n_lines[name]))[:MOST_SETTINGS]
    maps, diagrams = dict[str, Picture](), dict[str, Picture]()
    for name in names:
        part = [line for line in lines if line.setting == name]
        further = [(axis, min((line.others[axis] for line in part), key=ranks)) for axis in axes[2:]]
        chosen = [line for line in part if all(line.others[axis] == value for axis, value in further)]
        at = [name] * (len(n_lines) > 1) + [f"{axis.name} = {in_words(value)}" for axis, value in further]
        maps[_nth("attractors", len(maps))] = _map(axes, chosen, f" ({', '.join(at)})" if at else "")
        for k in np.unique(np.linspace(0, len(chosen) - 1, min(len(chosen), _MOST_DIAGRAMS)).round()).astype(int):
            diagram = _diagram(study, axes[0], chosen[k], str(chosen[k].where(len(n_lines) > 1)))
            if diagram is not None:
                diagrams[_nth("bifurcation", len(diagrams))] = diagram
    return maps | diagrams


def _nth(name: str, n_before: int) -> str:
    return f"{name}_{n_before + 1}" if n_before else name


def _map(axes: Sequence[Axis], lines: Sequence[_Line], at: str) -> Picture:
    """What runs settle on along the one key, or what most of them settle on over two."""
    axis, *others = axes
    if not others:
        (line,) = lines
        shares = {kind: [runs.n_of(kind) / runs.n for runs in line.runs] for kind in KINDS}
        along = figures.Scale(axis.name, _numbers(line.along), line.texts)
        recipe = partial(figures.shares_along, along, {kind: part for kind, part in shares.items() if any(part)})
        return Picture(recipe, f"Colours change where another attractor takes over. Share of runs by attractor{at}.")
    up = others[0]
    what = np.full((len(up.texts), len(axis.texts)), -1)
    is_mixed = np.zeros(what.shape, dtype=np.bool_)
    for line in lines:
        row = up.rows.index(line.others[up])
        for value, runs in zip(line.along, line.runs, strict=True):
            counts = [runs.n_of(kind) for kind in KINDS]
            place = row, axis.rows.index(value)
            what[place], is_mixed[place] = int(np.argmax(counts)), np.count_nonzero(counts) > 1
    across, upwards = (figures.Scale(key.name, key.x, key.texts) for key in (axis, up))
    recipe = partial(figures.over_two_keys, across, upwards, what, is_mixed)
    return Picture(recipe, f"Dots mark settings with several attractors. Attractor of most runs{at}.")


def _numbers(values: Sequence[tuple[Value, ...]]) -> list[float] | None:
    """Values of an axis as numbers; None where one is a distribution."""
    numbers = [value[0] for value in values if isinstance(value[0], float)]
    return numbers if len(numbers) == len(values) else None


def _diagram(study: Study, axis: Axis, line: _Line, at: str) -> Picture | None:
    """The bifurcation diagram of a line; None if there is nothing to show, or the values are no numbers."""
    x = _numbers(line.along)
    sections = None if x is None else _sections(study, x, line.runs)
    if x is None or sections is None:
        return None
    lists = (study.data.lists["exits_z"], study.data.lists["section_z"])
    names = [name for runs in line.runs for name in runs.member_id]
    n_left_out = sum(all(name not in listed for listed in lists) for name in names)
    left_out = f" Left out: {plural(n_left_out, 'run')}, undecided or without limit." if n_left_out else ""
    caption = (
        f"Branches split where a cycle gets more exits. z of the block with most exits, at its exits;"
        f" below, the largest multiplier and the period of each cycle{f' ({at})' if at else ''}.{left_out}"
    )
    return Picture(partial(figures.bifurcation, figures.Scale(axis.name, x, line.texts), sections, at), caption)


def _sections(study: Study, x: Sequence[float], line: Sequence[Runs]) -> Sections | None:
    """What a bifurcation diagram shows; None if no run is on a cycle or a torus, or irregular."""
    if not any(runs.n_of(PERIODIC) + runs.n_of(TORUS) + runs.n_of(IRREGULAR) for runs in line):
        return None
    exits_z, section_z = study.data.lists["exits_z"], study.data.lists["section_z"]
    members = study.data.table.own
    block_of = dict(zip(members["member_id"], members["exits_block"], strict=True))
    at: dict[tuple[int, str], tuple[list[float], list[float]]] = {}
    without: list[tuple[float, str, str]] = []
    for value, runs in zip(x, line, strict=True):
        for name, kind in zip(runs.member_id, runs.attractor, strict=True):
            if name in exits_z:
                xs, zs = at.setdefault((int(block_of[name]), kind), ([], []))
                xs += [value] * len(exits_z[name])
                zs += exits_z[name].tolist()
            elif name in section_z:
                without.append((value, kind, name))
    n_exits = Counter({block: 0 for block, _ in at})
    for (block, _), (xs, _) in at.items():
        n_exits[block] += len(xs)
    block = n_exits.most_common(1)[0][0] if n_exits else 0
    states: dict[str, tuple[list[float], list[float]]] = {}
    for value, kind, name in without:
        xs, zs = states.setdefault(kind, ([], []))
        xs.append(value)
        zs.append(float(section_z[name][block]))
    numbers = [np.concatenate([getattr(runs, name) for runs in line]) for name in ("multiplier", "period")]
    every = np.repeat(x, [runs.n for runs in line])
    return Sections(
        {key: _apart(*points) for key, points in sorted(at.items())},
        {kind: _apart(*states[kind]) for kind in KINDS if kind in states}, block,
        *(_apart(every[~np.isnan(column)], _known(column)) for column in numbers),
    )  # fmt: skip


def _apart(x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray) -> Points:
    """Points of which none lies on another: many runs have one cycle."""
    both = np.column_stack([x, y]).astype(np.float64)
    extent = np.ptp(both[:, 1]) if len(both) else 0.0
    near = np.round(both[:, 1] / (_ONE_DOT * max(extent, 1e-9 * np.abs(both[:, 1]).max(initial=1.0))))
    _, first = np.unique(np.column_stack([both[:, 0], near]), axis=0, return_index=True)
    return Points(*both[np.sort(first)].T)
