"""What runs settle on: shares, basins in the plane of the starts, and what changes along a swept key.

Starts are no part of a setting here: runs that differ in their start alone are one group, drawn or swept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import PercentFormatter

from stickslip.analysis.answer import Answer, F, I, Question, Recipe, Row, S, frame
from stickslip.analysis.ensemble import Study
from stickslip.analysis.grid import as_text, axes_of, order, place_of, settings
from stickslip.analysis.groups import Group, label
from stickslip.analysis.models.attractors import (
    ESCAPING,
    IRREGULAR,
    KINDS,
    ONE_CYCLE,
    PERIODIC,
    REST,
    SLIDING,
    UNDECIDED,
    Cycle,
    alike,
    edges,
    on_grid,
    plane,
    ranges,
)
from stickslip.analysis.stats.compare import share_over_matrices, wilson
from stickslip.analysis.style import GREY, panel
from stickslip.sim.numerics.arguments import Floats

NO_RECORD = "no record"  # in this ensemble
NONE_EXACT = "none exact"  # no run that has one
_MOST_BARS = 24
_MOST_CYCLES = 4  # that are named apart
_VECTORS = 2000  # more marks than this are a bitmap inside the SVG
_ONE_DOT = 1e-3  # of the range of values: what is closer is drawn once
_DECADES = 30.0  # largest over least value from which an axis is logarithmic
_LEAST_UNITS = 4  # for a bound on a share that is 1
_SCHEMA = {
    "group": S, "attractor": S, "cycle": I, "n_runs": I, "of": I, "share": F, "share_low": F, "share_high": F,
    "exits": I, "period_least": F, "period_median": F, "period_most": F, "multiplier": F,
}  # fmt: skip
_RANGES = {
    "key": S, "first": S, "last": S, "attractors": S, "n_runs": I, "n_undecided": I, "least_share": F,
    "multiplier_first": F, "multiplier_last": F,
}  # fmt: skip


class Look(NamedTuple):
    """How an attractor is drawn: colours differ in lightness as well, for black and white."""

    colour: str
    mark: str
    hatch: str


_LOOKS = {
    REST: Look("#9ECAE1", "D", "..."), SLIDING: Look("#0072B2", "s", ""), PERIODIC: Look("#E69F00", "o", ""),
    IRREGULAR: Look("#6A3D9A", "X", "xxx"), ESCAPING: Look("black", "*", ""), UNDECIDED: Look("#D9D9D9", ".", "///"),
}  # fmt: skip
#: Of the cycles of one system, and of all that come after these.
_CYCLES = (_LOOKS[PERIODIC], Look("#7F2704", "^", ""), Look("#F0E442", "v", ""), Look("#D55E00", "P", ""))
_OTHERS = Look("#FDD0A2", "p", "\\\\\\")
_WORDS = {
    REST: "come to rest", SLIDING: "slide steadily", PERIODIC: "settle on a cycle", IRREGULAR: "stay irregular",
    ESCAPING: "run away", UNDECIDED: "undecided",
}  # fmt: skip
#: A kind, and the number of the cycle among those of its system: 0 for those that are not told apart.
_What = tuple[str, int]


def answer(study: Study) -> Answer | None:
    if "attractor" not in study.data.members:
        return Answer(lack=NO_RECORD) if "attractors" in study.settings.question else None
    groups = _regardless_of_start(study)
    if not groups:
        return Answer(lack=NONE_EXACT)
    runs = {group.label: _runs(study, group) for group in groups}
    rows = [row for group in groups for row in _rows(study, group.label, runs[group.label])]
    found = [{"group": name, "of": len(some), "rows": [row for row in rows if row["group"] == name],
              "is_one_system": _is_one_system(some)} for name, some in runs.items()]  # fmt: skip
    basin, along = _basin(study, runs), _along(study, groups, runs)
    facts: dict[str, Any] = {
        "groups": found, "rows": rows, "t_burn": study.settings.t_burn,
        "n_undecided": sum(row["n_runs"] for row in rows if row["attractor"] == UNDECIDED),
        "why_undecided": _reasons(pd.concat(runs.values())),
        "n_runs": sum(map(len, runs.values())), "most_bars": _MOST_BARS,
        "level": f"{100 * study.settings.confidence:g}%", "basin": _without(basin, "drawn"),
        "along": _without(along, "shares", "sections"), "one_cycle": ONE_CYCLE,
    }  # fmt: skip
    tables = {"attractors": frame(_SCHEMA, rows)}
    figures: dict[str, Recipe] = {}
    if basin is not None:
        figures["basin_of_attractors"] = basin["drawn"]
    if along is not None:
        tables["attractor_ranges"] = frame(_RANGES, ({"key": along["name"]} | row for row in along["ranges"]))
        figures["attractors"] = partial(_shares_along, *(along[key] for key in ("name", "x", "ticks", "shares")))
        if along["sections"] is not None:
            figures["bifurcation"] = partial(_bifurcation, *(along[key] for key in ("name", "x", "sections")))
    elif len(runs) > 1 or basin is None:
        shares: dict[str, dict[str, float]] = {name: dict.fromkeys(KINDS, 0.0) for name in runs}
        for row in rows:
            shares[row["group"]][row["attractor"]] += row["share"]
        figures["attractors"] = partial(_bars, dict(list(shares.items())[:_MOST_BARS]))
    return Answer(facts | {"figures": list(figures)}, tables=tables, figures=figures)


def _without(row: Row | None, *names: str) -> Row | None:
    """A row without what only figures need."""
    return None if row is None else {name: value for name, value in row.items() if name not in names}


# ------------------------------------------------------------------------------------------------- runs and shares


def _regardless_of_start(study: Study) -> list[Group]:
    """The groups of the study, those that differ in their starts alone as one, of the runs that have an attractor."""
    found: dict[tuple[Any, ...], list[Group]] = {}
    for group in study.groups:
        found.setdefault(tuple((group.key | {"z0": None, "w0": None}).values()), []).append(group)
    members = [pd.concat([one.members for one in some]) for some in found.values()]
    known = [(key, some[some["attractor"].notna()]) for key, some in zip(found, members, strict=True)]
    keys = [dict(zip(study.groups[0].key, key, strict=True)) for key, some in known if len(some)]
    return [Group(label(key, keys), key, some)
            for key, some in zip(keys, (some for _, some in known if len(some)), strict=True)]  # fmt: skip


def _runs(study: Study, group: Group) -> pd.DataFrame:
    """The runs of a group: member_id, matrix, unit, attractor, reason, numbers of a cycle, and which cycle it is.

    Cycles are told apart where all runs are of one system.
    """
    found = group.members[["member_id", "matrix", "unit", "attractor"]].copy()
    found["reason"] = group.members["attractor_reason"]
    for name in ("period", "multiplier", "exits_per_period", "events_per_period"):
        _, numbers = study.data.recorded[name]
        found[name] = np.array([numbers[one] for one in found["member_id"]], dtype=np.float64)
    found["cycle"] = 0
    return _numbered(study, found) if _is_one_system(found) else found


def _numbered(study: Study, runs: pd.DataFrame) -> pd.DataFrame:
    """The runs of one system with the number of the cycle of each."""
    is_cycle = runs["attractor"] == PERIODIC
    section_z, section_w = (study.data.lists[name] for name in ("section_z", "section_w"))
    columns = ["member_id", "events_per_period", "exits_per_period", "period"]
    cycles = [Cycle(int(events), int(exits), period, section_z[name], section_w[name])
              for name, events, exits, period in runs.loc[is_cycle, columns].itertuples(index=False)]  # fmt: skip
    number = np.zeros(len(runs), dtype=np.int64)
    number[is_cycle.to_numpy()] = [one if one <= _MOST_CYCLES else 0 for one in alike(cycles)]
    return runs.assign(cycle=number)


def _is_one_system(runs: pd.DataFrame) -> bool:
    return len(runs["matrix"].unique()) == 1


def _rows(study: Study, name: str, runs: pd.DataFrame) -> Iterator[Row]:
    """A row for each attractor of a group: its share of the runs, and what its cycles are like."""
    units = runs["member_id"] if _is_one_system(runs) else runs["unit"]
    for kind, cycle in _attractors(runs):
        has = (runs["attractor"] == kind) & (runs["cycle"] == cycle)
        counts = has.groupby(units).agg(["sum", "count"]).to_numpy()
        share, low, high, _ = share_over_matrices(counts, study.settings.confidence)
        own = runs[has]
        exits = own["exits_per_period"].dropna().unique()
        row: Row = {
            "group": name, "attractor": kind, "cycle": cycle or None, "n_runs": len(own), "of": len(runs),
            "share": share, "share_low": low, "share_high": high, "exits": int(exits[0]) if len(exits) == 1 else None,
            "multiplier": _most(own["multiplier"]), "what": (kind, cycle),
        }  # fmt: skip
        known = own["period"].dropna()
        least, median, most = np.percentile(known, (0, 50, 100)).tolist() if len(known) else 3 * [None]
        yield row | {"period_least": least, "period_median": median, "period_most": most}


def _attractors(runs: pd.DataFrame) -> list[_What]:
    """What runs settle on, in the order of the page; cycles in the order of their numbers, the others last."""
    found = set(zip(runs["attractor"], runs["cycle"].tolist(), strict=True))
    return sorted(found, key=lambda what: (KINDS.index(what[0]), what[1] or _MOST_CYCLES + 1))


def _most(numbers: pd.Series) -> float | None:
    known = numbers.dropna()
    return float(known.max()) if len(known) else None


def _reasons(runs: pd.DataFrame) -> list[tuple[str, int]]:
    """Why runs are undecided, the commonest reason first, with how many; dots stand for numbers that differ."""
    words = runs.loc[runs["attractor"] == UNDECIDED, "reason"].dropna().str.removesuffix("; lengthen the run")
    kinds = words.groupby(words.str.replace(r"[-+]?\d[\d.]*(?:e[-+]?\d+)?", "…", regex=True))
    found = [(str(some.iloc[0] if len(some.unique()) == 1 else plain), len(some)) for plain, some in kinds]
    return sorted(found, key=lambda one: -one[1])


# ------------------------------------------------------------------------------------------------- basins


def _basin(study: Study, runs: Mapping[str, pd.DataFrame]) -> Row | None:
    """The starts of one system by what they settle on; None if all settle on one, or not one or two numbers vary.

    Of several systems, that of which most runs settle on others than the commonest.
    """
    lists = study.data.lists
    if not lists.get("start_z"):  # a dataset of before
        return None
    systems = [(name, own) for name, some in runs.items() for _, own in some.groupby("matrix")]
    name, own = max(systems, key=lambda one: len(one[1]) - one[1].value_counts(["attractor", "cycle"]).iloc[0])
    own = _numbered(study, own)
    order = _attractors(own)
    z, w = (np.array([lists[key][one] for one in own["member_id"]]) for key in ("start_z", "start_w"))
    varies = plane(z, w)
    if len(order) == 1 or varies is None:
        return None
    number = np.array([order.index(one) for one in zip(own["attractor"], own["cycle"].tolist(), strict=True)])
    row_of = {row["what"]: row for row in _rows(study, name, own)}
    entries = [(_look(what), _entry(row_of[what])) for what in order]
    grid = on_grid(varies.points) if len(varies.names) == 2 else None
    if len(varies.names) == 1:
        drawn = partial(_strip, varies.names[0], varies.points[:, 0], number, entries)
    elif grid is not None:
        drawn = partial(_cells, varies.names, grid, number, entries)
    else:
        drawn = partial(_scatter, varies.names, varies.points, number, entries)
    return {
        "group": name, "n": len(own), "is_grid": grid is not None, "names": varies.names, "n_systems": len(systems),
        "drawn": drawn,
    }  # fmt: skip


def _look(what: _What) -> Look:
    kind, cycle = what
    if kind != PERIODIC:
        return _LOOKS[kind]
    return _CYCLES[cycle - 1] if cycle else _OTHERS


def _entry(row: Row) -> str:
    """An attractor in a legend, with its share and the interval."""
    words = _WORDS[row["attractor"]]
    if row["cycle"] is not None:
        words = f"cycle, period {row['period_median']:.4g}"
        if row["exits"] is not None and row["exits"] > 1:
            words += f", {row['exits']} exits"
    elif row["attractor"] == PERIODIC:
        words = "other cycles"
    low, high = (f"{100 * row[f'share_{end}']:.1f}" for end in ("low", "high"))
    return f"{words}: {100 * row['share']:.1f}% ({low} to {high})"


@panel(3.5)
def _scatter(
    ax: Axes, names: Sequence[str], points: Floats, number: np.ndarray, entries: Sequence[tuple[Look, str]]
) -> None:
    """Starts in their plane, a mark each, by what they settle on."""
    size = float(np.clip(170.0 / np.sqrt(len(points)), 1.5, 6.0))  # marks fill the plane
    for k, (look, _) in enumerate(entries):
        x, y = points[number == k].T
        ax.plot(x, y, look.mark, color=look.colour, markersize=size, markeredgewidth=0.2,
                markeredgecolor="black" if size > 3 else "none", rasterized=len(points) > _VECTORS)  # fmt: skip
    ax.margins(0.01)
    ax.set(xlabel=f"{names[0]} at start", ylabel=f"{names[1]} at start")
    marks = [Line2D([], [], linestyle="", marker=look.mark, color=look.colour, markeredgecolor="black",
                    markeredgewidth=0.3, markersize=5, label=words) for look, words in entries]  # fmt: skip
    _explain(ax, marks)


@panel(3.5)
def _cells(
    ax: Axes,
    names: Sequence[str],
    grid: tuple[Floats, Floats, np.ndarray],
    number: np.ndarray,
    entries: Sequence[tuple[Look, str]],
) -> None:
    """A cell for each start of a grid, by what it settles on, with a line between different ones."""
    x, y, place = grid
    left, low, what = edges(x), edges(y), number[place]
    colours = ListedColormap([look.colour for look, _ in entries])
    ax.pcolormesh(left, low, what, cmap=colours, vmin=-0.5, vmax=len(entries) - 0.5, rasterized=what.size > _VECTORS)
    upright = [[(left[k + 1], low[j]), (left[k + 1], low[j + 1])]
               for j, k in zip(*np.nonzero(what[:, 1:] != what[:, :-1]), strict=True)]  # fmt: skip
    level = [[(left[k], low[j + 1]), (left[k + 1], low[j + 1])]
             for j, k in zip(*np.nonzero(what[1:] != what[:-1]), strict=True)]  # fmt: skip
    lines = [*upright, *level]
    ax.add_collection(LineCollection(lines, colors="black", linewidths=0.5, rasterized=len(lines) > _VECTORS))
    ax.set(xlabel=f"{names[0]} at start", ylabel=f"{names[1]} at start")
    _explain(ax, [Patch(facecolor=look.colour, edgecolor="black", linewidth=0.3, label=words)
                  for look, words in entries])  # fmt: skip


@panel(1.9)
def _strip(ax: Axes, name: str, start: Floats, number: np.ndarray, entries: Sequence[tuple[Look, str]]) -> None:
    """Starts along a line, each coloured, as far as half way to the next, by what it settles on."""
    order = np.argsort(start, kind="stable")
    bounds = edges(start[order])
    for k, (look, _) in enumerate(entries):
        own = np.flatnonzero(number[order] == k)
        ax.bar(bounds[own], 1.0, np.diff(bounds)[own], align="edge", color=look.colour, hatch=look.hatch, linewidth=0,
               rasterized=len(start) > _VECTORS)  # fmt: skip
    change = np.flatnonzero(np.diff(number[order]) != 0) + 1
    ax.vlines(bounds[change], 0, 1, color="black", linewidth=0.5, rasterized=len(change) > _VECTORS)
    ax.set(xlim=(bounds[0], bounds[-1]), ylim=(0, 1), xlabel=f"{name} at start", yticks=[])
    ax.spines["left"].set_visible(False)
    _explain(ax, [Patch(facecolor=look.colour, hatch=look.hatch, label=words) for look, words in entries])


def _explain(ax: Axes, handles: Sequence[Any]) -> None:
    """One entry a line above the axes: shares and intervals are long."""
    ax.figure.legend(handles=handles, loc="outside upper left", ncols=1, fontsize=7, handletextpad=0.4)


# ------------------------------------------------------------------------------------------------- along a key


def _along(study: Study, groups: Sequence[Group], runs: Mapping[str, pd.DataFrame]) -> Row | None:
    """What runs settle on along the swept key of most values, at the first values of the others; None without one."""
    by_setting = settings(groups)
    axes = axes_of(by_setting)
    if not axes:
        return None
    axis, *others = axes
    setting, some = max(by_setting.items(), key=lambda one: len(one[1]))
    placed = [(place_of(axes, group), group) for group in some]
    here = min((tuple(at[other] for other in others) for at, _ in placed), key=lambda at: [*map(order, at)])
    line = sorted(((at[axis], runs[group.label]) for at, group in placed if tuple(at[one] for one in others) == here),
                  key=lambda one: order(one[0]))  # fmt: skip
    ticks = [as_text(value) for value, _ in line]
    own = [some for _, some in line]
    x = [value[0] for value, _ in line if isinstance(value[0], float)]
    is_numeric = len(x) == len(line)  # no distributions
    by_exits = _ranges(study, ticks, own, _kind_and_exits)
    return {
        "name": axis.name,
        "at": ", ".join(f"{one.name} = {as_text(at)}" for one, at in zip(others, here, strict=True)),
        "setting": setting if len(by_setting) > 1 else "", "ticks": ticks, "x": x if is_numeric else None,
        "told": _ranges(study, ticks, own, lambda runs: runs["attractor"]), "ranges": by_exits,
        "changes": _changes_of_exits(by_exits, ticks, x) if is_numeric else [],
        "is_of_starts": all(map(_is_one_system, own)), "shares": _stacked(own),
        "sections": _sections(study, x, own) if is_numeric else None,
    }  # fmt: skip


def _kind_and_exits(runs: pd.DataFrame) -> pd.Series:
    """What each run settles on, and of a cycle the exits a period."""
    of = runs["exits_per_period"].map(lambda exits: f", {exits:g} exit{'' if exits == 1 else 's'} a period")
    return runs["attractor"].where(runs["attractor"] != PERIODIC, runs["attractor"] + of)


def _decided(found: pd.Series) -> tuple[str, ...]:
    """On what runs settle, each once, but for those that are undecided."""
    return tuple(sorted(set(found) - {UNDECIDED}, key=lambda one: (KINDS.index(one.split(",")[0]), len(one), one)))


def _ranges(
    study: Study, ticks: Sequence[str], own: Sequence[pd.DataFrame], of: Callable[[pd.DataFrame], pd.Series]
) -> list[Row]:
    """Rows of ranges of a key; where all runs settle on one attractor, with the least share that has this in reach.

    The share is over starts, of one system, or else over systems; all values share their draws, which count once.
    """
    rows: list[Row] = []
    for one in ranges([_decided(of(some)) for some in own]):
        listed = own[one.first : one.last + 1]
        n_runs = sum(map(len, listed))
        n_undecided = sum(int((some["attractor"] == UNDECIDED).sum()) for some in listed)
        n_units = max(len(some) if _is_one_system(some) else some["unit"].nunique() for some in listed)
        is_all = len(one.on) == 1 and not n_undecided and n_units >= _LEAST_UNITS
        rows.append({
            "first": ticks[one.first], "last": ticks[one.last], "on": one.on, "attractors": "; ".join(one.on),
            "n_values": len(listed), "n_runs": n_runs, "n_undecided": n_undecided,
            "least_share": wilson(n_units, n_units, study.settings.confidence)[0] if is_all else None,
            "place": (one.first, one.last), "multipliers": [_most(some["multiplier"]) for some in listed],
        })  # fmt: skip
        rows[-1] |= {"multiplier_first": rows[-1]["multipliers"][0], "multiplier_last": rows[-1]["multipliers"][-1]}
    return rows


def _changes_of_exits(found: Sequence[Row], ticks: Sequence[str], x: Sequence[Any]) -> list[Row]:
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


def _stacked(own: Sequence[pd.DataFrame]) -> dict[str, list[float]]:
    """The share of each kind at each value of a key."""
    return {kind: shares for kind in KINDS
            if any(shares := [float((some["attractor"] == kind).mean()) for some in own])}  # fmt: skip


class _Points(NamedTuple):
    """Values against a key: at which of its values, shape (m,), and what."""

    x: Floats
    y: Floats


def _sections(study: Study, x: Sequence[float], own: Sequence[pd.DataFrame]) -> dict[str, Any] | None:
    """z of the blocks at exits, by block and kind, and multipliers and periods of cycles; None if nothing exits."""
    exits_z, block_of = study.data.lists["exits_z"], study.data.members.set_index("member_id")["exits_block"]
    at: dict[tuple[int, str], tuple[list[float], list[float]]] = {}
    for value, runs in zip(x, own, strict=True):
        for name, kind in zip(runs["member_id"], runs["attractor"], strict=True):
            if name in exits_z:
                xs, zs = at.setdefault((int(block_of[name]), str(kind)), ([], []))
                xs += [value] * len(exits_z[name])
                zs += exits_z[name].tolist()
    if not at:
        return None
    found: dict[str, Any] = {"z": {key: _apart(*both) for key, both in sorted(at.items())}}
    every = pd.concat([runs.assign(x=value) for value, runs in zip(x, own, strict=True)])
    for name in ("multiplier", "period"):
        known = every[every[name].notna()]
        found[name] = _apart(known["x"], known[name])
    return found


def _apart(x: Sequence[float] | pd.Series, y: Sequence[float] | pd.Series) -> _Points:
    """Points of which none lies on another: many runs have one cycle."""
    both = np.column_stack([x, y]).astype(np.float64)
    extent = np.ptp(both[:, 1]) if len(both) else 0.0
    near = np.round(both[:, 1] / (_ONE_DOT * max(extent, 1e-9 * np.abs(both[:, 1]).max(initial=1.0))))
    _, first = np.unique(np.column_stack([both[:, 0], near]), axis=0, return_index=True)
    return _Points(*both[np.sort(first)].T)


def _beside(x: Sequence[float]) -> tuple[Floats, str]:
    """Edges of cells around the values of a key, and the scale of its axis."""
    if x[0] > 0 and x[-1] > _DECADES * x[0]:
        return np.exp(edges(np.log(x))), "log"
    return edges(np.array(x, dtype=np.float64)), "linear"


@panel()
def _shares_along(
    ax: Axes, name: str, x: Sequence[float] | None, ticks: Sequence[str], shares: Mapping[str, Sequence[float]]
) -> None:
    """Stacked shares at each value of a key, each as wide as to half way to the next."""
    bounds, scale = _beside(range(len(ticks)) if x is None else x)
    floor = np.zeros(len(ticks))
    for kind, some in shares.items():
        look = _LOOKS[kind]
        ax.bar(bounds[:-1], some, np.diff(bounds), floor, align="edge", color=look.colour, hatch=look.hatch,
               edgecolor="white", linewidth=0.3, label=_WORDS[kind])  # fmt: skip
        floor += some
    if x is None:
        ax.set_xticks(range(len(ticks)), ticks, rotation=30, ha="right")
    ax.set(xscale=scale, xlim=(bounds[0], bounds[-1]), ylim=(0, 1), xlabel=name, ylabel="share of runs")
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    ax.figure.legend(loc="outside upper left", ncols=3, fontsize=7, handlelength=1.2)


#: How exits of one block are drawn in a bifurcation diagram, by the order of the blocks: colour and mark.
_BLOCKS = (("black", "o"), ("#D55E00", "s"), ("#0072B2", "^"), ("#CC79A7", "D"))


@panel(5.2, nrows=3, sharex=True, gridspec_kw={"height_ratios": (3, 1, 1)})
def _bifurcation(axes: Sequence[Axes], name: str, x: Sequence[float], found: Mapping[str, Any]) -> None:
    """z at exits of cycles and of irregular runs against a key, above the multipliers and periods of the cycles."""
    above, middle, below = axes
    total = sum(len(one.x) for one in found["z"].values())
    size = float(np.clip(60.0 / np.sqrt(total), 0.8, 3.0))
    blocks = sorted({block for block, _ in found["z"]})
    for (block, kind), one in found["z"].items():
        colour, mark = _BLOCKS[blocks.index(block) % len(_BLOCKS)]
        is_cycle = kind == PERIODIC
        above.plot(one.x, one.y, mark, color=colour, markersize=size if is_cycle else 0.5 * size, markeredgewidth=0,
                   alpha=1.0 if is_cycle else 0.4, rasterized=total > _VECTORS)  # fmt: skip
    handles = [Line2D([], [], linestyle="", marker=_BLOCKS[k % len(_BLOCKS)][1], markersize=4, markeredgewidth=0,
                      color=_BLOCKS[k % len(_BLOCKS)][0], label=f"block {block}")
               for k, block in enumerate(blocks)]  # fmt: skip
    if len(blocks) > 1:
        above.figure.legend(handles=handles, loc="outside upper left", ncols=4, fontsize=7, handletextpad=0.1)
    above.set_ylabel("z at exits" + (f", block {blocks[0]}" if len(blocks) == 1 else ""))
    for ax, key in ((middle, "multiplier"), (below, "period")):
        is_many = len(found[key].x) > _VECTORS
        ax.plot(*found[key], "o", color="black", markersize=1.8, markeredgewidth=0, rasterized=is_many)
        ax.set_ylabel(key)
        ax.set_ylim(*np.array([-0.08, 1.1]) * max(found[key].y.max(initial=0.0), float(key == "multiplier")))
    middle.axhline(1.0, color=GREY, linewidth=0.8, linestyle="--")
    bounds, scale = _beside(x)
    below.set(xlabel=name, xscale=scale, xlim=(bounds[0], bounds[-1]))
    above.figure.align_ylabels(list(axes))


# ------------------------------------------------------------------------------------------------- by group


@panel()
def _bars(ax: Axes, shares: Mapping[str, Mapping[str, float]]) -> None:
    """A stacked bar a group, from below in the order of the page."""
    labels: Sequence[str] = list(shares)[::-1]
    left = np.zeros(len(labels))
    for kind, look in _LOOKS.items():
        width = np.array([shares[label].get(kind, 0.0) for label in labels])
        if width.any():
            ax.barh(labels, width, left=left, color=look.colour, hatch=look.hatch, edgecolor="white", linewidth=0.3,
                    label=_WORDS[kind])  # fmt: skip
        left += width
    ax.set(xlim=(0, 1), xlabel="share of runs")
    ax.xaxis.set_major_formatter(PercentFormatter(1.0))
    ax.figure.legend(loc="outside upper left", ncols=3, fontsize=7, handlelength=1.2)


QUESTION = Question(answer, rank=2, beside=("fates",))
