"""What runs settle on: shares, basins in the plane of the starts, and what changes along swept keys.

Starts are no part of a setting here: runs that differ in their start alone are one group, drawn or swept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from stickslip.analysis.answer import Answer, F, I, Question, Recipe, Row, S, frame
from stickslip.analysis.ensemble import Study
from stickslip.analysis.grid import MOST_SETTINGS, axes_of, dtype, place_of, settings
from stickslip.analysis.groups import Group
from stickslip.analysis.models.attractors import (
    ESCAPING,
    IRREGULAR,
    KINDS,
    ONE_CYCLE,
    PERIODIC,
    TORUS,
    UNDECIDED,
    Along,
    Cycle,
    Range,
    Turn,
    alike,
    on_grid,
    plane,
    ranges,
    turn,
)
from stickslip.analysis.questions.runs import attractor_figures as figures_of
from stickslip.analysis.questions.runs.attractor_figures import Look, Points, Scale, Sections
from stickslip.analysis.series.runs import by_number
from stickslip.analysis.stats.compare import share_over_matrices, wilson
from stickslip.pipeline.design.design import Axis, in_words
from stickslip.pipeline.design.labels import labels
from stickslip.pipeline.design.values import Value, ranks

NO_RECORD = "no record"  # in this ensemble
NONE_EXACT = "none exact"  # no run that has one
_MOST_BARS = 24
_MOST_CYCLES = 4  # that are named apart
_MOST_DIAGRAMS = 3  # of bifurcations, at values of a second key
_ONE_DOT = 1e-3  # of the range of values: what is closer is drawn once
_LEAST_UNITS = 4  # for a bound on a share that is 1
_SCHEMA = {
    "group": S, "attractor": S, "cycle": I, "n_runs": I, "of": I, "share": F, "share_low": F, "share_high": F,
    "exits": I, "period_least": F, "period_median": F, "period_most": F, "multiplier": F,
}  # fmt: skip
_RANGES = {
    "setting": S, "key": S, "first": S, "last": S, "attractors": S, "n_runs": I, "n_undecided": I, "least_share": F,
    "multiplier_first": F, "multiplier_last": F,
}  # fmt: skip
_NUMBERS = ("period", "multiplier", "exits_per_period", "events_per_period")
#: A kind, and the number of the cycle among those of its system: 0 for those that are not told apart.
_What = tuple[str, int]


class Runs(NamedTuple):
    """Runs that have an attractor: arrays of a length.

    Numbers of a cycle are NaN for what is none; `cycle` tells apart the cycles of one system, 0 where they are not.
    """

    member_id: np.ndarray
    matrix: np.ndarray
    unit: np.ndarray
    attractor: np.ndarray
    reason: np.ndarray
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
    def what(self) -> list[_What]:
        """What each run settles on."""
        return list(zip(self.attractor.tolist(), self.cycle.tolist(), strict=True))

    def at(self, which: np.ndarray) -> Runs:
        return Runs(*(column[which] for column in self))

    def n_of(self, kind: str) -> int:
        return int((self.attractor == kind).sum())


class _Line(NamedTuple):
    """The runs along a swept key at one value of each other key, `others`, and of the scene's other settings."""

    setting: str
    is_exact: bool
    others: dict[Axis, tuple[Value, ...]]
    along: list[tuple[Value, ...]]
    own: list[Runs]

    @property
    def ticks(self) -> list[str]:
        return [in_words(value) for value in self.along]


def answer(study: Study) -> Answer | None:
    if "attractor" not in study.data.table.own:
        return Answer(lack=NO_RECORD) if "attractors" in study.settings.question else None
    groups = _regardless_of_start(study)
    if not groups:
        return Answer(lack=NONE_EXACT)
    runs = {group.label: _runs(study, group) for group in groups}
    by_group = {name: list(_rows(study, name, some)) for name, some in runs.items()}
    rows = [row for some in by_group.values() for row in some]
    found = [{"group": name, "of": some.n, "rows": by_group[name], "is_one_system": some.is_one_system}
             for name, some in runs.items()]  # fmt: skip
    basin, along = _basin(study, runs), _along(study, groups, runs)
    facts: dict[str, Any] = {
        "groups": found, "rows": rows, "t_burn": study.settings.t_burn,
        "n_undecided": sum(row["n_runs"] for row in rows if row["attractor"] == UNDECIDED),
        "why_undecided": _reasons([some.reason[some.attractor == UNDECIDED] for some in runs.values()]),
        "n_runs": sum(some.n for some in runs.values()), "most_bars": _MOST_BARS,
        "level": f"{100 * study.settings.confidence:g}%", "basin": _without(basin, "drawn"),
        "along": _without(along, "drawn", "keys"), "one_cycle": ONE_CYCLE,
    }  # fmt: skip
    tables = {"attractors": frame(_SCHEMA, rows)}
    figures: dict[str, Recipe] = {}
    if basin is not None:
        figures["basin_of_attractors"] = basin["drawn"]
    if along is not None:
        tables["attractor_ranges"] = frame(along["keys"] | _RANGES, along["ranges"])
        figures |= along["drawn"]
    elif len(runs) > 1 or basin is None:
        shares: dict[str, dict[str, float]] = {name: dict.fromkeys(KINDS, 0.0) for name in runs}
        for row in rows:
            shares[row["group"]][row["attractor"]] += row["share"]
        figures["attractors"] = partial(figures_of.bars, dict(list(shares.items())[:_MOST_BARS]))
    return Answer(facts | {"figures": list(figures)}, tables=tables, figures=figures)


def _without(row: Row | None, *names: str) -> Row | None:
    """A row without what only figures and tables need."""
    return None if row is None else {name: value for name, value in row.items() if name not in names}


# ------------------------------------------------------------------------------------------------- runs and shares


def _regardless_of_start(study: Study) -> list[Group]:
    """The groups of the study, those that differ in their starts alone as one, of the runs that have an attractor."""
    found: dict[tuple[Any, ...], list[Group]] = {}
    for group in study.groups:
        found.setdefault(tuple((group.key | {"z0": None, "w0": None}).values()), []).append(group)
    known, swept = [], []
    for key, some in found.items():
        rows = np.concatenate([one.rows for one in some])
        has = study.data.table.own["attractor"].iloc[rows].notna().to_numpy()
        if has.any():
            known.append((dict(zip(study.groups[0].key, key, strict=True)), rows[has]))
            values = study.data.table.design.swept(some[0].point)
            swept.append({name: value for name, value in values.items() if name not in ("z", "w")})
    names = labels([key for key, _ in known], swept)
    return [Group(name, key, study.data.table, rows) for name, (key, rows) in zip(names, known, strict=True)]


def _runs(study: Study, group: Group) -> Runs:
    """The runs of a group; cycles are told apart where all are of one system."""
    members = group.members
    names = members["member_id"].to_numpy(object)
    period, multiplier, exits, events = (study.number(name)[group.rows] for name in _NUMBERS)
    reason = members["attractor_reason"]
    found = Runs(
        names, members["matrix"].to_numpy(), members["unit"].to_numpy(), members["attractor"].to_numpy(object),
        reason.astype(object).where(reason.notna(), None).to_numpy(), period, multiplier, exits, events,
        np.zeros(len(names), dtype=np.int64),
    )  # fmt: skip
    return _numbered(study, found) if found.is_one_system else found


def _numbered(study: Study, runs: Runs) -> Runs:
    """The runs of one system with the number of the cycle of each."""
    which = np.flatnonzero(runs.attractor == PERIODIC)
    section_z, section_w = (study.data.lists[name] for name in ("section_z", "section_w"))
    columns = (runs.member_id, runs.events_per_period, runs.exits_per_period, runs.period)
    rows = zip(*(column[which] for column in columns), strict=True)
    cycles = [Cycle(int(events), int(exits), float(period), section_z[name], section_w[name])
              for name, events, exits, period in rows]  # fmt: skip
    number = np.zeros(runs.n, dtype=np.int64)
    number[which] = [one if one <= _MOST_CYCLES else 0 for one in alike(cycles)]
    return runs._replace(cycle=number)


def _rows(study: Study, name: str, runs: Runs) -> Iterator[Row]:
    """A row for each attractor of a group: its share of the runs, and what its cycles are like."""
    units = np.arange(runs.n) if runs.is_one_system else np.unique(runs.unit, return_inverse=True)[1]
    of = np.bincount(units)
    for what in _attractors(runs):
        kind, cycle = what
        has = (runs.attractor == kind) & (runs.cycle == cycle)
        counts = np.column_stack([np.bincount(units, has), of])
        share, low, high, _ = share_over_matrices(counts, study.settings.confidence)
        own = runs.at(has)
        exits = np.unique(_known(own.exits_per_period))
        known = _known(own.period)
        least, median, most = np.percentile(known, (0, 50, 100)).tolist() if len(known) else 3 * [None]
        yield {
            "group": name, "attractor": kind, "cycle": cycle or None, "n_runs": own.n, "of": runs.n,
            "share": share, "share_low": low, "share_high": high, "exits": int(exits[0]) if len(exits) == 1 else None,
            "period_least": least, "period_median": median, "period_most": most,
            "multiplier": _most(own.multiplier), "what": what,
        }  # fmt: skip


def _attractors(runs: Runs) -> list[_What]:
    """What runs settle on, in the order of the page; cycles in the order of their numbers, the others last."""
    return sorted(set(runs.what), key=lambda what: (KINDS.index(what[0]), what[1] or _MOST_CYCLES + 1))


def _known(numbers: np.ndarray) -> np.ndarray:
    return numbers[~np.isnan(numbers)]


def _most(numbers: np.ndarray) -> float | None:
    known = _known(numbers)
    return float(known.max()) if len(known) else None


def _reasons(reasons: Sequence[np.ndarray]) -> list[tuple[str, int]]:
    """Why runs are undecided, the commonest reason first, with how many.

    What differs from run to run, in brackets, is left out; dots stand for other numbers that do.
    """
    words = pd.Series([str(one) for some in reasons for one in some if one is not None], dtype=object)
    words = words.str.removesuffix("; lengthen the run").str.replace(r" \([^)]*\)$", "", regex=True)
    kinds = words.groupby(words.str.replace(r"[-+]?\d[\d.]*(?:e[-+]?\d+)?", "…", regex=True))
    found = [(str(some.iloc[0] if len(some.unique()) == 1 else plain), len(some)) for plain, some in kinds]
    return sorted(found, key=lambda one: -one[1])


# ------------------------------------------------------------------------------------------------- basins


def _basin(study: Study, runs: Mapping[str, Runs]) -> Row | None:
    """The starts of one system by what they settle on; None if all settle on one, or not one or two numbers vary.

    Of several systems, that of which most runs settle on others than the commonest.
    """
    lists = study.data.lists
    if not lists.get("start_z"):  # a dataset of before
        return None
    systems = [
        (name, some.at(rows)) for name, some in runs.items() for rows in by_number(some.matrix) if len(rows) > 1
    ]
    if not systems:
        return None
    name, own = max(systems, key=lambda one: one[1].n - max(Counter(one[1].what).values()))
    own = _numbered(study, own)
    found = _attractors(own)
    z, w = (np.array([lists[key][one] for one in own.member_id]) for key in ("start_z", "start_w"))
    varies = plane(z, w)
    if len(found) == 1 or varies is None:
        return None
    number = np.array([found.index(one) for one in own.what])
    row_of = {row["what"]: row for row in _rows(study, name, own)}
    entries = [(_look(what), _entry(row_of[what])) for what in found]
    grid = on_grid(varies.points) if len(varies.names) == 2 else None
    if len(varies.names) == 1:
        drawn = partial(figures_of.strip, varies.names[0], varies.points[:, 0], number, entries)
    elif grid is not None:
        drawn = partial(figures_of.cells, varies.names, grid, number, entries)
    else:
        drawn = partial(figures_of.scatter, varies.names, varies.points, number, entries)
    return {
        "group": name, "n": own.n, "is_grid": grid is not None, "names": varies.names, "n_systems": len(systems),
        "drawn": drawn,
    }  # fmt: skip


def _look(what: _What) -> Look:
    kind, cycle = what
    if kind != PERIODIC:
        return figures_of.LOOKS[kind]
    return figures_of.CYCLES[cycle - 1] if cycle else figures_of.OTHERS


def _entry(row: Row) -> str:
    """An attractor in a legend, with its share and the interval."""
    words = figures_of.WORDS[row["attractor"]]
    if row["cycle"] is not None:
        words = f"cycle, period {row['period_median']:.4g}"
        if row["exits"] is not None and row["exits"] > 1:
            words += f", {row['exits']} exits"
    elif row["attractor"] == PERIODIC:
        words = "other cycles"
    low, high = (f"{100 * row[f'share_{end}']:.1f}" for end in ("low", "high"))
    return f"{words}: {100 * row['share']:.1f}% ({low} to {high})"


# ------------------------------------------------------------------------------------------------- along a key


def _along(study: Study, groups: Sequence[Group], runs: Mapping[str, Runs]) -> Row | None:
    """What runs settle on along the swept key of most values, a line for each value of the others; None without."""
    by_setting, axes = settings(groups), axes_of(groups)
    if not axes:
        return None
    axis, *others = axes
    lines = [line for setting, some in by_setting.items() for line in _lines(setting, some, axes, runs)]
    told = [_told(study, axis, line, len(by_setting) > 1) for line in lines]
    name_of = {key: dtype(axis, k) for axis in others for k, key in enumerate(axis.keys)}
    found = {
        "name": axis.name, "others": [one.name for one in others],
        "columns": [(key, key, "g" if kind == F else None) for key, kind in name_of.items()],
        "has_settings": len(by_setting) > 1, "lines": told, "turns": _turns_by_setting(axis, others, lines, told),
        "is_of_starts": all(some.is_one_system for line in lines for some in line.own), "tally": _tally(lines),
        "ranges": [row | {"key": axis.name, "setting": line.setting if len(by_setting) > 1 else None}
                   | {key: value for one, at in line.others.items() for key, value in zip(one.keys, at, strict=True)}
                   for line, one_told in zip(lines, told, strict=True) for row in one_told["ranges"]],
        "keys": name_of,
    }  # fmt: skip
    return found | _figures(study, axes, lines, told)


def _lines(setting: str, groups: Sequence[Group], axes: Sequence[Axis], runs: Mapping[str, Runs]) -> Iterator[_Line]:
    """The lines of a setting along the first axis, in the order of the values of the others."""
    axis, *others = axes
    at_others: dict[tuple[tuple[Value, ...], ...], list[tuple[tuple[Value, ...], Runs]]] = {}
    for group in groups:
        at = place_of(axes, group)
        at_others.setdefault(tuple(at[one] for one in others), []).append((at[axis], runs[group.label]))
    for here in sorted(at_others, key=lambda at: [*map(ranks, at)]):
        values, own = zip(*sorted(at_others[here], key=lambda one: ranks(one[0])), strict=True)
        yield _Line(setting, groups[0].is_exact, dict(zip(others, here, strict=True)), list(values), list(own))


def _told(study: Study, axis: Axis, line: _Line, has_settings: bool) -> Row:
    """What is said of a line: its place, its values, and where along it runs settle on something else."""
    ticks, x = line.ticks, _numbers(line.along)
    by_exits = _ranges(study, ticks, line.own, _kind_and_exits)
    at = [f"{one.name} = {in_words(value)}" for one, value in line.others.items()]
    return {
        "at": ", ".join([*([line.setting] if has_settings else []), *at]), "within": ", ".join(at), "ticks": ticks,
        "told": _ranges(study, ticks, line.own, lambda runs: runs.attractor.tolist()), "ranges": by_exits,
        "changes": _changes_of_exits(by_exits, ticks, x) if x is not None else [],
        "places": [axis.rows.index(value) for value in line.along],
    }  # fmt: skip


def _numbers(values: Sequence[tuple[Value, ...]]) -> list[float] | None:
    """Values of an axis as numbers; None where one is a distribution."""
    found = [value[0] for value in values if isinstance(value[0], float)]
    return found if len(found) == len(values) else None


def _kind_and_exits(runs: Runs) -> list[str]:
    """What each run settles on, and of a cycle the exits a period."""
    return [f"{kind}, {exits:g} exit{'' if exits == 1 else 's'} a period" if kind == PERIODIC else kind
            for kind, exits in zip(runs.attractor.tolist(), runs.exits_per_period.tolist(), strict=True)]  # fmt: skip


def _decided(found: Sequence[str]) -> tuple[str, ...]:
    """On what runs settle, each once, but for those that are undecided."""
    return tuple(sorted(set(found) - {UNDECIDED}, key=lambda one: (KINDS.index(one.split(",")[0]), len(one), one)))


def _ranges(
    study: Study, ticks: Sequence[str], own: Sequence[Runs], of: Callable[[Runs], Sequence[str]]
) -> list[Row]:
    """Rows of ranges of a key; where all runs settle on one attractor, with the least share that has this in reach.

    The share is over starts, of one system, or else over systems; all values share their draws, which count once.
    """
    rows: list[Row] = []
    for one in ranges([_decided(of(some)) for some in own]):
        listed = own[one.first : one.last + 1]
        n_undecided = sum(some.n_of(UNDECIDED) for some in listed)
        n_units = max(some.n if some.is_one_system else len(np.unique(some.unit)) for some in listed)
        is_all = len(one.on) == 1 and not n_undecided and n_units >= _LEAST_UNITS
        multipliers = [_most(some.multiplier) for some in listed]
        by_run = [np.array(of(some), dtype=object) for some in listed]
        rows.append({
            "shares": [_bounds([float((found == kind).mean()) for found in by_run]) for kind in one.on],
            "is_by_system": all(map(_is_by_system, listed, by_run)),
            "first": ticks[one.first], "last": ticks[one.last], "on": one.on, "attractors": "; ".join(one.on),
            "n_cycles": max(int(some.cycle.max(initial=0)) for some in listed),
            "n_values": len(listed), "n_runs": sum(some.n for some in listed), "n_undecided": n_undecided,
            "least_share": wilson(n_units, n_units, study.settings.confidence)[0] if is_all else None,
            "place": (one.first, one.last), "multipliers": multipliers, "multiplier_first": multipliers[0],
            "multiplier_last": multipliers[-1],
        })  # fmt: skip
    return rows


def _bounds(shares: Sequence[float]) -> tuple[float, float]:
    return min(shares), max(shares)


def _is_by_system(runs: Runs, found: np.ndarray) -> bool:
    """Whether runs are of several systems, some of them with several starts, and all of a system do the same."""
    if runs.is_one_system:
        return False
    n_runs, n_kinds = (pd.Series(found).groupby(runs.unit).agg(how) for how in ("size", "nunique"))
    return bool(n_runs.max() > 1 and n_kinds.max() == 1)


def _changes_of_exits(found: Sequence[Row], ticks: Sequence[str], x: Sequence[float]) -> list[Row]:
    """Where along a key the cycle of all runs gets another number of exits, and where its multiplier comes to one.

    The latter by a line through the last two values before it, if that is where it has to be.
    """
    rows = []
    for one, other in pairwise(found):
        if any(len(some["on"]) > 1 or not some["on"][0].startswith(PERIODIC) for some in (one, other)):
            continue
        (_, last), (first, _) = one["place"], other["place"]
        at, before = None, one["multipliers"][-2:]
        if len(before) == 2 and None not in before and before[0] < before[1] < 1.0:
            at = x[last] + (1.0 - before[1]) * (x[last] - x[last - 1]) / (before[1] - before[0])
        exits = [some["on"][0].removeprefix(f"{PERIODIC}, ").split()[0] for some in (one, other)]
        rows.append({
            "before": exits[0], "after": exits[1], "last": ticks[last], "first": ticks[first],
            "at": at if at is not None and at <= x[first] else None,
        })  # fmt: skip
    return rows


def _turns_by_setting(axis: Axis, others: Sequence[Axis], lines: Sequence[_Line], told: Sequence[Row]) -> list[Row]:
    """The turns of each of few settings, or those of all lines together."""
    named = dict.fromkeys(line.setting for line in lines)
    if not 1 < len(named) <= MOST_SETTINGS or len(lines) == len(named):
        return [row | {"setting": ""} for row in _turns(axis, others, told, len(named) > 1)]
    return [
        row | {"setting": name}
        for name in named
        for row in _turns(axis, others, [one for line, one in zip(lines, told, strict=True) if line.setting == name])
    ]


def _turns(axis: Axis, others: Sequence[Axis], told: Sequence[Row], has_settings: bool = False) -> list[Row]:
    """How the value up to which, and that from which on, all runs settle on one thing moves from line to line."""
    ends = []
    for row in told:
        places = row["places"]
        found = [Range(places[one["place"][0]], places[one["place"][1]], one["on"]) for one in row["told"]]
        ends.append(Along(found, (places[0], places[-1])))
    turns = [turn(ends, is_last) for is_last in (False, True)] if len(told) > 1 else []
    return [_turn_row(axis, others, told, one, has_settings) for one in turns if one is not None]


def _turn_row(axis: Axis, others: Sequence[Axis], told: Sequence[Row], one: Turn, has_settings: bool) -> Row:
    is_in_order = len(others) == 1 and not has_settings
    known = [(line, place) for line, place in enumerate(one.places) if place is not None]
    least, most = (of(known, key=lambda pair: pair[1]) for of in (min, max))
    steps = [second[1] - first[1] for first, second in pairwise(known)]
    way = "" if not is_in_order else "rises" if min(steps, default=0) >= 0 else "falls" if max(steps) <= 0 else ""
    ends = (known[0], known[-1]) if way else (least, most)
    return {
        "kind": one.kind, "is_last": one.is_last, "way": way, "is_same": least[1] == most[1],
        "ends": [{"value": axis.texts[place], "at": told[line]["at" if has_settings else "within"]}
                 for line, place in ends],
        "n": len(known), "n_whole": one.n_whole, "of": len(told),
        "lines": f"values of {others[0].name}" if is_in_order else "lines",
    }  # fmt: skip


def _tally(lines: Sequence[_Line]) -> Row:
    """At how many settings all decided runs settle on one thing, by kind; on several; and none is decided."""
    on = [_decided(some.attractor.tolist()) for line in lines for some in line.own]
    alone = Counter(one[0] for one in on if len(one) == 1)
    return {
        "n": len(on), "alone": [(kind, alone[kind]) for kind in KINDS if alone[kind]],
        "several": sum(len(one) > 1 for one in on), "none": sum(not one for one in on),
    }  # fmt: skip


# ------------------------------------------------------------------------------------------------- figures


def _figures(study: Study, axes: Sequence[Axis], lines: Sequence[_Line], told: Sequence[Row]) -> Row:
    """Shares along the one key or a map over the first two, and bifurcation diagrams; and which values they are at.

    Each setting has its own: those of the exact law first, and of these those of most lines.
    """
    n_lines = Counter(line.setting for line in lines)
    is_exact = {line.setting: line.is_exact for line in lines}
    named = sorted(n_lines, key=lambda name: (not is_exact[name], -n_lines[name]))
    drawn: dict[str, Recipe] = {}
    maps, diagrams = list[Row](), list[Row]()
    for name in named[:MOST_SETTINGS]:
        own = [k for k, line in enumerate(lines) if line.setting == name]
        one = _pictures(study, axes, [lines[k] for k in own], [told[k]["at"] for k in own], len(named) > 1)
        maps.append({"figure": _nth("attractors", len(maps)), "at": one.at})
        drawn[maps[-1]["figure"]] = one.map
        for recipe, facts in one.diagrams:
            diagrams.append({"figure": _nth("bifurcation", len(diagrams)), **facts})
            drawn[diagrams[-1]["figure"]] = recipe
    return {"drawn": drawn, "maps": maps, "diagrams": diagrams, "n_undrawn": len(named) - len(maps)}


def _nth(name: str, n_before: int) -> str:
    return f"{name}_{n_before + 1}" if n_before else name


class _Pictures(NamedTuple):
    """What is drawn of one setting: shares along the one key, or a map, and where that is; and diagrams."""

    map: Recipe
    at: str
    diagrams: list[tuple[Recipe, Row]]


def _pictures(
    study: Study, axes: Sequence[Axis], lines: Sequence[_Line], named: Sequence[str], has_settings: bool
) -> _Pictures:
    """The pictures of the lines of one setting, at the first values of further keys than two."""
    axis, *others = axes
    further = [(one, min((line.others[one] for line in lines), key=ranks)) for one in others[1:]]
    chosen = [k for k, line in enumerate(lines) if all(line.others[one] == value for one, value in further)]
    if others:
        whole = _map(axis, others[0], [lines[k] for k in chosen])
    else:
        line = lines[chosen[0]]
        whole = partial(
            figures_of.shares_along, Scale(axis.name, _numbers(line.along), line.ticks), _stacked(line.own)
        )
    at = [lines[0].setting] * has_settings + [f"{one.name} = {in_words(value)}" for one, value in further]
    if len(chosen) > _MOST_DIAGRAMS:
        chosen = [chosen[round(k)] for k in np.linspace(0, len(chosen) - 1, _MOST_DIAGRAMS)]
    diagrams: list[tuple[Recipe, Row]] = []
    for k in chosen:
        own, x = lines[k].own, _numbers(lines[k].along)
        sections = None if x is None else _sections(study, x, own)
        if sections is not None:
            along = Scale(axis.name, x, lines[k].ticks)
            recipe = partial(figures_of.bifurcation, along, sections, named[k])
            away = sum(some.n_of(ESCAPING) for some in own)
            diagrams.append((recipe, {"at": named[k], "n_left_out": _n_left_out(study, own), "n_away": away}))
    return _Pictures(whole, ", ".join(at), diagrams)


def _stacked(own: Sequence[Runs]) -> dict[str, list[float]]:
    """The share of each kind at each value of a key."""
    return {kind: shares for kind in KINDS if any(shares := [some.n_of(kind) / some.n for some in own])}


def _map(axis: Axis, up: Axis, lines: Sequence[_Line]) -> Recipe:
    """The picture of what most runs settle on over two keys."""
    what = np.full((len(up.texts), len(axis.texts)), -1)
    is_mixed = np.zeros(what.shape, dtype=np.bool_)
    for line in lines:
        row = up.rows.index(line.others[up])
        for value, some in zip(line.along, line.own, strict=True):
            counts = [some.n_of(kind) for kind in KINDS]
            place = row, axis.rows.index(value)
            what[place], is_mixed[place] = int(np.argmax(counts)), np.count_nonzero(counts) > 1
    across, upwards = (Scale(one.name, one.x, one.texts) for one in (axis, up))
    return partial(figures_of.over_two_keys, across, upwards, what, is_mixed)


def _n_left_out(study: Study, own: Sequence[Runs]) -> int:
    """Number of runs that a bifurcation diagram has nothing of: those that are undecided or run away."""
    exits_z, section_z = study.data.lists["exits_z"], study.data.lists["section_z"]
    return sum(name not in exits_z and name not in section_z for some in own for name in some.member_id)


def _sections(study: Study, x: Sequence[float], own: Sequence[Runs]) -> Sections | None:
    """What a bifurcation diagram shows; None if no run is on a cycle or a torus, or irregular."""
    if not any(some.n_of(PERIODIC) + some.n_of(TORUS) + some.n_of(IRREGULAR) for some in own):
        return None
    exits_z, section_z = study.data.lists["exits_z"], study.data.lists["section_z"]
    members = study.data.table.own
    block_of = dict(zip(members["member_id"], members["exits_block"], strict=True))
    at: dict[tuple[int, str], tuple[list[float], list[float]]] = {}
    without: list[tuple[float, str, str]] = []
    for value, runs in zip(x, own, strict=True):
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
    both = [np.concatenate([getattr(some, name) for some in own]) for name in ("multiplier", "period")]
    every = np.repeat(x, [some.n for some in own])
    return Sections(
        {key: _apart(*some) for key, some in sorted(at.items())},
        {kind: _apart(*states[kind]) for kind in KINDS if kind in states}, block,
        *(_apart(every[~np.isnan(one)], _known(one)) for one in both),
    )  # fmt: skip


def _apart(x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray) -> Points:
    """Points of which none lies on another: many runs have one cycle."""
    both = np.column_stack([x, y]).astype(np.float64)
    extent = np.ptp(both[:, 1]) if len(both) else 0.0
    near = np.round(both[:, 1] / (_ONE_DOT * max(extent, 1e-9 * np.abs(both[:, 1]).max(initial=1.0))))
    _, first = np.unique(np.column_stack([both[:, 0], near]), axis=0, return_index=True)
    return Points(*both[np.sort(first)].T)


QUESTION = Question(answer, rank=2, beside=("fates",))
