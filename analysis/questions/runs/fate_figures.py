"""Pictures of how runs end and of what they settle on: shares, maps over two keys, basins and survival."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import PercentFormatter

from stickslip.analysis.answer import Picture
from stickslip.analysis.by_key import by_key
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Form
from stickslip.analysis.findings.numbers import signs, with_interval
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import listed
from stickslip.analysis.models import attractors, fates
from stickslip.analysis.questions.runs.settled import OUTCOMES, Grid, Portion, Runs, Setting, portions, told_apart
from stickslip.analysis.series.runs import by_number
from stickslip.analysis.stats.survival import Curve
from stickslip.analysis.style import PANEL, hues, panel
from stickslip.pipeline.design.design import Axis, in_words
from stickslip.pipeline.design.units import DIMENSIONLESS, Units

MOST_CURVES = 8  # in one figure
MOST_STEPS = 2000  # of one curve: each is then a quarter of a dot wide
MOST_MAPS = 3
_VECTORS = 2000  # more marks than this are a bitmap inside the SVG
_MOST_TICKS = 12  # of a map
_MOST_NAMES, _NAME = 40, 0.16  # bars with names of their own; inches that each takes
_SHORT = 24  # of names in a legend of two columns
_LONGEST = 60  # of the names of what one curve stands for


class Look(NamedTuple):
    """How an outcome is drawn, and its name: colours differ in lightness as well, for black and white."""

    colour: str
    mark: str
    hatch: str
    words: str = ""


LOOKS = {
    attractors.REST: Look("#9ECAE1", "D", "...", "rest"),
    attractors.SLIDING: Look("#0072B2", "s", "", "steady sliding"),
    attractors.PERIODIC: Look("#E69F00", "o", "", "cycle"),
    attractors.TORUS: Look("#009E73", "h", "++", "torus"),
    attractors.IRREGULAR: Look("#6A3D9A", "X", "xxx", "irregular"),
    attractors.ESCAPING: Look("black", "*", "", "growth without limit"),
    fates.QUIET: Look("#56B4E9", "D", "...", "sliding, may stick again"),
    fates.SUSTAINED: Look("#E69F00", "o", "", "sticking and slipping"),
    fates.LULL: Look("#CC79A7", "v", "xxx", "sliding, will stick again"),
    fates.UNMOVED: Look("#D9D9D9", "X", "///", "stuck"),
    attractors.UNDECIDED: Look("#D9D9D9", ".", "///", "undecided"),
}
#: Of the cycles of one system, and of all that come after these.
CYCLES = (LOOKS[attractors.PERIODIC], Look("#7F2704", "^", ""), Look("#F0E442", "v", ""), Look("#D55E00", "P", ""))
OTHERS = Look("#FDD0A2", "p", "\\\\\\")


def pictures(study: Study, grid: Grid, curves: Mapping[Place, Curve]) -> dict[str, Picture]:
    """Shares at each setting, or what most runs do over two keys; basins; and survival, if some runs ended.

    `curves` are those of survival, by where a setting is.
    """
    figures: dict[str, Picture] = {}
    settings = grid.settings
    if len({setting.kinds for setting in settings} | {(kind,) for setting in settings for kind in setting.kinds}) > 1:
        if len(grid.axes) > 1:
            figures |= _maps(grid, study.settings.units)
        elif len(settings) > 1:
            counts = {kind: [setting.runs.n_of(kind) for setting in settings] for kind in OUTCOMES}
            caption = "Shares of runs by what they do at the end."
            key, values = _names(grid, settings)
            figures["fates"] = Picture(
                partial(shares, study.settings.units.label_of_key(key), values, counts), caption
            )
    figures |= _basin(study, grid)
    if any(curve[1][-1] < 1.0 for curve in curves.values()):
        figures["survival"] = _survival(study, grid, curves)
    return figures


def _names(grid: Grid, settings: Sequence[Setting]) -> tuple[str, list[str]]:
    """The one key that tells settings apart, and its values; an empty name if there is no such key."""
    if len(grid.axes) == 1 and len({setting.method for setting in settings}) == 1:
        return grid.axes[0].name, [in_words(setting.at[0]) for setting in settings]
    return "", [str(setting.where) for setting in settings]


@panel()
def shares(ax: Axes, key: str, values: Sequence[str], counts: Mapping[str, Sequence[float]]) -> None:
    """Shares of runs by outcome, a bar for each value of a key, from above; `counts` are the runs at each value."""
    total, edge = np.maximum(np.sum([*counts.values()], axis=0), 1), np.zeros(len(values))
    for outcome, numbers in counts.items():
        if any(numbers):
            look, width = LOOKS[outcome], np.array(numbers) / total
            bars = ax.barh(
                range(len(values)), width, 0.8, edge, color=look.colour, hatch=look.hatch, label=look.words
            )
            for bar in bars:
                bar.set(edgecolor="white", linewidth=0.3)
            edge += width
    ax.set(xlim=(0, 1), ylim=(len(values) - 0.4, -0.6), xlabel="share of runs", ylabel=key)
    ax.xaxis.set_major_formatter(PercentFormatter(1.0))
    step = -(-len(values) // _MOST_NAMES)
    ax.set_yticks(range(0, len(values), step), values[::step])
    figure = ax.get_figure(root=True)
    assert figure is not None  # it is drawn on one
    figure.set_figheight(max(PANEL[1], 1.0 + _NAME * min(len(values), _MOST_NAMES)))
    ax.figure.legend(loc="outside upper left", ncols=2, handlelength=1.2)


# ------------------------------------------------------------------------------------------------- over two keys


def _maps(grid: Grid, units: Units) -> dict[str, Picture]:
    """What most runs settle on or do over the first two axes, at the first value of the others, of each method."""
    across, up, *further = grid.axes
    figures: dict[str, Picture] = {}
    for method, settings in [*grid.methods.items()][:MOST_MAPS]:
        further_rows = settings[0].at[2:]
        runs_at = {setting.at[:2]: setting.runs for setting in settings if setting.at[2:] == further_rows}
        what = np.full((len(up.rows), len(across.rows)), -1)
        is_mixed = np.zeros(what.shape, dtype=np.bool_)
        for (x, y), runs in runs_at.items():
            counts = [runs.n_of(kind) for kind in OUTCOMES]
            place = up.rows.index(y), across.rows.index(x)
            what[place], is_mixed[place] = int(np.argmax(counts)), np.count_nonzero(counts) > 1
        further_by_row = zip(further, further_rows, strict=True)
        where = Place(tuple((axis.name, in_words(row)) for axis, row in further_by_row)) + Place.of(method)
        caption = f"Dots mark settings where runs differ. What most runs do{f' ({where})' if where else ''}."
        name = f"fates_{len(figures) + 1}" if figures else "fates"
        figures[name] = Picture(partial(over_two_keys, across, up, what, is_mixed, units), caption)
    return figures


@panel(3.4)
def over_two_keys(
    ax: Axes, across: Axis, up: Axis, what: np.ndarray, is_mixed: np.ndarray, units: Units = DIMENSIONLESS
) -> None:
    """A cell for each pair of values of two keys, by what most of its runs do.

    `what`, shape (len(up.rows), len(across.rows)), is a place in `OUTCOMES`, and -1 where there is no run. A dot
    marks cells, where `is_mixed`, whose runs do different things.
    """
    looks = [LOOKS[kind] for kind in OUTCOMES]
    ax.pcolormesh(
        np.ma.masked_less(what, 0),
        cmap=ListedColormap([look.colour for look in looks]),
        vmin=-0.5,
        vmax=len(looks) - 0.5,
        edgecolors="white",
        linewidth=0.5,
        rasterized=what.size > _VECTORS,
    )
    rows, columns = np.nonzero(is_mixed)
    size = float(np.clip(60.0 / max(what.shape), 1.2, 4.0))
    ax.plot(columns + 0.5, rows + 0.5, "o", color="white", markersize=size, markeredgecolor="black",
            markeredgewidth=0.4, rasterized=len(rows) > _VECTORS)  # fmt: skip
    for axis, key in ((ax.xaxis, across), (ax.yaxis, up)):
        step = -(-len(key.rows) // _MOST_TICKS)
        axis.set_ticks(np.arange(0, len(key.rows), step) + 0.5, key.texts[::step])
    ax.set(xlabel=units.label_of_key(across.name), ylabel=units.label_of_key(up.name))
    shown_looks = [looks[k] for k in np.unique(what[what >= 0])]
    handles = [Patch(facecolor=look.colour, label=look.words) for look in shown_looks]
    ax.figure.legend(handles=handles, loc="outside upper left", ncols=3, handlelength=1.2)


# ------------------------------------------------------------------------------------------------- basins


def _basin(study: Study, grid: Grid) -> dict[str, Picture]:
    """The starts of one system by what they settle on; nothing if all settle on one, or not one or two numbers vary.

    Of several systems, that of which most runs settle on others than the commonest.
    """
    systems = [*_systems(study, grid)]
    if not systems:
        return {}
    setting, runs = max(systems, key=lambda pair: _n_apart(pair[1]))
    runs = told_apart(study, runs)
    starts = _starts(study, runs)
    rows = portions(study, runs)
    if starts is None or len(rows) == 1:
        return {}
    numbers = np.select([runs.in_outcome(row.outcome, row.cycle) for row in rows], range(len(rows)))
    which = str(setting.where) if len(grid.settings) > 1 else ""
    which = which or ("the system whose starts differ most" if len(systems) > 1 else "")
    caption = f"Each colour is a basin. Final state by initial condition{f' ({which})' if which else ''}."
    return {"basin": Picture(partial(scatter, starts, numbers, [*map(_entry, rows)]), caption)}


def _systems(study: Study, grid: Grid) -> Iterator[tuple[Setting, Runs]]:
    """Each system of which there are several runs, with its setting."""
    matrices = study.data.table.own["matrix"].to_numpy()
    for setting in grid.settings:
        for places in by_number(matrices[setting.runs.rows]):
            if len(places) > 1:
                yield setting, setting.runs.at(places)


def _n_apart(runs: Runs) -> int:
    """How many runs have another outcome than most."""
    return len(runs.rows) - max(Counter(zip(runs.kinds, runs.cycles, strict=True)).values())


def _starts(study: Study, runs: Runs) -> attractors.Plane | None:
    """What varies of the starts of some runs; None if that is nothing, or more than two numbers, or not stored."""
    lists, members = study.data.lists, study.data.table.own
    names = members["member_id"].to_numpy(object)[runs.rows]
    if lists.get("start_z"):
        z, w = (np.array([lists[key][name] for name in names]) for key in ("start_z", "start_w"))
    else:
        z, w = (members[key].to_numpy(np.float64, na_value=np.nan)[runs.rows, None] for key in ("z_start", "w_start"))
    return None if np.isnan(z).any() or np.isnan(w).any() else attractors.plane(z, w, study.settings.names)


def _entry(row: Portion) -> tuple[Look, str]:
    """How an outcome is drawn, and its entry in a legend, with its share and the interval."""
    look = LOOKS[row.outcome]
    words = look.words
    if row.outcome == attractors.PERIODIC and row.cycle is None:
        look, words = OTHERS, "other cycles"
    elif row.cycle is not None:
        look, words = CYCLES[row.cycle - 1], f"cycle, period {row.period:.4g}"
    return look, f"{words}: {with_interval(row.share, Form.SHARE)}"


@panel(3.5)
def scatter(ax: Axes, starts: attractors.Plane, numbers: np.ndarray, entries: Sequence[tuple[Look, str]]) -> None:
    """Starts in their plane or along a line, a mark each, by what they settle on, an index of `entries`."""
    points = np.column_stack([starts.points, np.zeros(len(starts.points))])[:, :2]
    size = float(np.clip(170.0 / np.sqrt(len(points)), 1.5, 6.0))  # marks fill the plane
    handles = []
    for k, (look, words) in enumerate(entries):
        x, y = points[numbers == k].T
        (marks,) = ax.plot(x, y, look.mark, color=look.colour, markersize=size, markeredgewidth=0.2)
        marks.set(markeredgecolor="black" if size > 3 else "none", rasterized=len(points) > _VECTORS)
        handles.append(Line2D([], [], linestyle="", marker=look.mark, color=look.colour, markersize=5, label=words))
    ax.margins(0.03)
    ax.set_xlabel(f"{starts.names[0]} at start")
    if len(starts.names) > 1:
        ax.set_ylabel(f"{starts.names[1]} at start")
    else:
        ax.set_yticks([])
    ax.figure.legend(handles=handles, loc="outside upper left", ncols=1, handletextpad=0.4)


# ------------------------------------------------------------------------------------------------- survival


def _survival(study: Study, grid: Grid, curves: Mapping[Place, Curve]) -> Picture:
    """Curves of survival of some settings; those that coincide are one."""
    settings = [setting for setting in grid.settings if setting.where in curves]
    places = np.unique(np.linspace(0, len(settings) - 1, MOST_CURVES).round().astype(int))
    chosen = [settings[k] for k in places]
    key, values = _names(grid, chosen)
    unit = study.settings.units.of_key(key)
    tail = f" {unit}" if unit else ""

    def course(k: int) -> tuple[bytes, bytes]:
        t, share, _, _ = curves[chosen[k].where]
        return t.tobytes(), share.tobytes()

    def name(same: Sequence[int]) -> str:
        names = [values[k] for k in same]
        if len(listed(names)) > _LONGEST:
            names = [names[0], f"{len(names) - 1} others"]
        return f"{key} = " * bool(key) + listed(names) + tail

    alike = [*by_key(range(len(chosen)), course).values()]
    named_curves = {name(same): curves[chosen[same[0]].where] for same in alike}
    t_end = max(setting.t_end for setting in settings)
    kinds = {kind for setting in chosen for kind in setting.runs.kinds}
    level = f"; bands: {100 * study.settings.confidence:g}% intervals, of curves that end between 0 and 100%"
    level += "; their upper ends count runs that may stick again as still going" * (fates.QUIET in kinds)
    level *= any(map(_has_band, named_curves.values()))
    slides = "at the last event of each run that slides at its end"
    slides += " (unless it will stick again)" * (fates.LULL in kinds)
    ends = [slides] * bool(kinds & {attractors.SLIDING, fates.QUIET})
    ends += ["where motion grows without limit"] * (attractors.ESCAPING in kinds)
    see = f"Curves step down {listed(ends)}. " if ends else ""
    count = f" {len(chosen)} of {len(settings)} settings are drawn." * (len(chosen) < len(settings))
    caption = f"{see}Share of runs still going{level}.{count}"
    colours = hues(study, [chosen[same[0]].groups[0].label for same in alike])
    return Picture(partial(survival_curves, named_curves, colours, t_end, study.settings.units), caption)


def _has_band(curve: Curve) -> bool:
    """Of curves that end between none and all: bands of the others lie over each other."""
    return bool(0.0 < curve[1][-1] < 1.0)


@panel(3.4)
def survival_curves(
    ax: Axes, curves: Mapping[str, Curve], colours: Sequence[str], t_end: float, units: Units
) -> None:
    """Share of runs that have not ended against time, a hue for each setting; with its interval where some ended."""
    for (label, curve), hue in zip(curves.items(), colours, strict=True):
        steps = np.unique(np.linspace(0, len(curve[0]) - 1, MOST_STEPS).astype(np.int64))
        t = np.append(curve[0][steps], t_end)
        share, low, high = (np.append(column[steps], column[-1]) for column in curve[1:])
        ax.step(t, share, where="post", color=hue, label=signs(label))
        if _has_band(curve):
            ax.fill_between(t, low, high, share < 1.0, step="post", color=hue, alpha=0.15, linewidth=0)
    ax.set(xlim=(0, t_end), ylim=(-0.02, 1.04), ylabel="share of runs still going")
    ax.set_xlabel(units.label("time t", "time"))
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    if len(curves) > 1:
        n_columns = 2 if max(map(len, curves)) <= _SHORT else 1
        ax.figure.legend(loc="outside upper left", ncols=n_columns, handlelength=1.2)
