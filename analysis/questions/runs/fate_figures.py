"""Pictures of how runs end and of what they settle on: survival, shares, basins, maps and bifurcation diagrams."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import PercentFormatter

from stickslip.analysis.answer import Recipe
from stickslip.analysis.models.attractors import (
    ESCAPING,
    IRREGULAR,
    KINDS,
    PERIODIC,
    REST,
    SLIDING,
    TORUS,
    UNDECIDED,
    Plane,
    edges,
    on_grid,
)
from stickslip.analysis.models.fates import COLLAPSED, DIVERGED, LULL, QUIET, SUSTAINED, UNMOVED, Curve
from stickslip.analysis.style import EXACT, GREY, PANEL, panel
from stickslip.sim.numerics.arguments import Floats

FROM_ZERO = 0.8  # least over largest n_stick up to which its axis begins at 0
_VECTORS = 2000  # more marks than this are a bitmap inside the SVG
_DECADES = 30.0  # largest over least value from which an axis is logarithmic
_MOST_TICKS = 12  # of values that are no numbers
_MOST_NAMES, _NAME = 40, 0.16  # bars with names of their own; inches that each takes
#: Of curves, as many as there may be: Okabe and Ito's.
_HUES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "black", "#999999")
_SHORT = 24  # of names in a legend of two columns


class Look(NamedTuple):
    """How an outcome is drawn, and its name: colours differ in lightness as well, for black and white."""

    colour: str
    mark: str
    hatch: str
    words: str = ""


LOOKS = {
    REST: Look("#9ECAE1", "D", "...", "rest"), SLIDING: Look("#0072B2", "s", "", "steady sliding"),
    PERIODIC: Look("#E69F00", "o", "", "cycle"), TORUS: Look("#009E73", "h", "++", "torus"),
    IRREGULAR: Look("#6A3D9A", "X", "xxx", "irregular"), ESCAPING: Look("black", "*", "", "growth without limit"),
    UNDECIDED: Look("#D9D9D9", ".", "///", "undecided"),
}  # fmt: skip
#: Of the cycles of one system, and of all that come after these.
CYCLES = (LOOKS[PERIODIC], Look("#7F2704", "^", ""), Look("#F0E442", "v", ""), Look("#D55E00", "P", ""))
OTHERS = Look("#FDD0A2", "p", "\\\\\\")
#: Of the fates of runs whose attractors are not known.
FATES = {
    COLLAPSED: LOOKS[SLIDING], QUIET: Look("#56B4E9", "D", "...", "sliding (not certified)"),
    SUSTAINED: Look("#E69F00", "o", "", "sticking and slipping"),
    LULL: Look("#CC79A7", "v", "xxx", "unstable sliding"), DIVERGED: LOOKS[ESCAPING],
    UNMOVED: Look("#D9D9D9", "X", "///", "stuck"),
}  # fmt: skip
#: How exits of one block are drawn in a bifurcation diagram, by the order of the blocks: colour and mark.
_BLOCKS = (("black", "o"), ("#D55E00", "s"), ("#0072B2", "^"), ("#CC79A7", "D"))
#: How the state of what has no exits is drawn there, and its name.
_AT_SECTION = {
    PERIODIC: ("#E69F00", "+", "cycle without exits, one event"), SLIDING: ("#0072B2", "x", "steady sliding"),
    REST: ("#9ECAE1", "D", "at rest"),
}  # fmt: skip


class Points(NamedTuple):
    """Values against a key: at which of its values, shape (m,), and what."""

    x: Floats
    y: Floats


class Sections(NamedTuple):
    """A bifurcation diagram.

    Attributes
    ----------
    exits : mapping of (int, str) to Points
        z of a block at exits, by block and kind.
    states : mapping of str to Points
        z of the block `block` on what has no exits, by kind.
    block : int
    multiplier, period : Points
        Of cycles.
    """

    exits: Mapping[tuple[int, str], Points]
    states: Mapping[str, Points]
    block: int
    multiplier: Points
    period: Points


# ------------------------------------------------------------------------------------------------- basins


def basin(starts: Plane, number: np.ndarray, entries: Sequence[tuple[Look, str]]) -> Recipe:
    """Starts by the outcome of their runs, an index of `entries`: along a line, in cells of a grid, or scattered."""
    if len(starts.names) == 1:
        return partial(strip, starts.names[0], starts.points[:, 0], number, entries)
    grid = on_grid(starts.points)
    if grid is not None:
        return partial(cells, starts.names, grid, number, entries)
    return partial(scatter, starts.names, starts.points, number, entries)


@panel(3.5)
def scatter(
    ax: Axes, names: Sequence[str], points: Floats, number: np.ndarray, entries: Sequence[tuple[Look, str]]
) -> None:
    """Starts in their plane, a mark each, by what they settle on."""
    size = float(np.clip(170.0 / np.sqrt(len(points)), 1.5, 6.0))  # marks fill the plane
    for k, (look, _) in enumerate(entries):
        x, y = points[number == k].T
        ax.plot(x, y, look.mark, color=look.colour, markersize=size, markeredgewidth=0.2,
                markeredgecolor="black" if size > 3 else "none", rasterized=len(points) > _VECTORS)  # fmt: skip
    ax.margins(0.03)
    ax.set(xlabel=f"{names[0]} at start", ylabel=f"{names[1]} at start")
    marks = [Line2D([], [], linestyle="", marker=look.mark, color=look.colour, markeredgecolor="black",
                    markeredgewidth=0.3, markersize=5, label=words) for look, words in entries]  # fmt: skip
    _explain(ax, marks)


@panel(3.5)
def cells(
    ax: Axes,
    names: Sequence[str],
    grid: tuple[Floats, Floats, np.ndarray],
    number: np.ndarray,
    entries: Sequence[tuple[Look, str]],
) -> None:
    """A cell for each start of a grid, by what it settles on, with a line between different ones."""
    x, y, place = grid
    _mesh(ax, edges(x), edges(y), number[place], [look for look, _ in entries])
    ax.set(xlabel=f"{names[0]} at start", ylabel=f"{names[1]} at start")
    _explain(ax, [_patch(look, words) for look, words in entries])


def _mesh(ax: Axes, left: Floats, low: Floats, what: np.ndarray, looks: Sequence[Look]) -> None:
    """Cells coloured by what each holds, an index of `looks`, with a line between different ones; white below 0."""
    shown = np.ma.masked_less(what, 0)
    ax.pcolormesh(left, low, shown, cmap=ListedColormap([look.colour for look in looks]), vmin=-0.5,
                  vmax=len(looks) - 0.5, rasterized=what.size > _VECTORS)  # fmt: skip
    upright = [[(left[k + 1], low[j]), (left[k + 1], low[j + 1])]
               for j, k in zip(*np.nonzero(what[:, 1:] != what[:, :-1]), strict=True)]  # fmt: skip
    level = [[(left[k], low[j + 1]), (left[k + 1], low[j + 1])]
             for j, k in zip(*np.nonzero(what[1:] != what[:-1]), strict=True)]  # fmt: skip
    lines = [*upright, *level]
    ax.add_collection(LineCollection(lines, colors="black", linewidths=0.5, rasterized=len(lines) > _VECTORS))


def _patch(look: Look, words: str) -> Patch:
    return Patch(facecolor=look.colour, edgecolor="black", linewidth=0.3, label=words)


@panel(1.9)
def strip(ax: Axes, name: str, start: Floats, number: np.ndarray, entries: Sequence[tuple[Look, str]]) -> None:
    """Starts along a line, each coloured, as far as half way to the next, by what it settles on."""
    order = np.argsort(start, kind="stable")
    _mesh(ax, edges(start[order]), np.array([0.0, 1.0]), number[order][np.newaxis], [look for look, _ in entries])
    ax.set(xlabel=f"{name} at start", yticks=[])
    ax.spines["left"].set_visible(False)
    _explain(ax, [_patch(look, words) for look, words in entries])


def _explain(ax: Axes, handles: Sequence[Any]) -> None:
    """One entry a line above the axes: shares and intervals are long."""
    ax.figure.legend(handles=handles, loc="outside upper left", ncols=1, handletextpad=0.4)


# ------------------------------------------------------------------------------------------------- along keys


class Scale(NamedTuple):
    """A swept key: its name, its values as numbers, None if one is a distribution, and as texts."""

    name: str
    x: Sequence[float] | None
    ticks: Sequence[str]


def _beside(key: Scale) -> tuple[Floats, str]:
    """Edges of cells around the values of a key, evenly spaced if they are no numbers, and the scale of its axis."""
    x = key.x
    if x is None:
        return np.arange(-0.5, len(key.ticks)), "linear"
    if len(x) == 1:
        return x[0] + max(abs(x[0]), 1.0) * np.array([-0.5, 0.5]), "linear"
    if x[0] > 0 and x[-1] > _DECADES * x[0]:
        return np.exp(edges(np.log(x))), "log"
    return edges(np.array(x, dtype=np.float64)), "linear"


@panel()
def shares_along(ax: Axes, along: Scale, shares: Mapping[str, Sequence[float]]) -> None:
    """Stacked shares at each value of a key, each as wide as to half way to the next."""
    bounds, scale = _beside(along)
    floor = np.zeros(len(along.ticks))
    for kind, some in shares.items():
        look = LOOKS[kind]
        ax.bar(bounds[:-1], some, np.diff(bounds), floor, align="edge", color=look.colour, hatch=look.hatch,
               edgecolor="white", linewidth=0.3, label=look.words)  # fmt: skip
        floor += some
    if along.x is None:
        ax.set_xticks(range(len(along.ticks)), along.ticks, rotation=30, ha="right")
    ax.set(xscale=scale, xlim=(bounds[0], bounds[-1]), ylim=(0, 1), xlabel=along.name, ylabel="share of runs")
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    ax.figure.legend(loc="outside upper left", ncols=3, handlelength=1.2)


@panel(3.4)
def over_two_keys(ax: Axes, across: Scale, up: Scale, what: np.ndarray, is_mixed: np.ndarray) -> None:
    """A cell for each pair of values of two keys, by what most of its runs settle on.

    `what`, shape (len(up.ticks), len(across.ticks)), is a place in `KINDS`, and -1 where there is no run. A dot marks
    cells, where `is_mixed`, whose runs settle on different things.
    """
    (left, of_x), (low, of_y) = (_beside(one) for one in (across, up))
    seen = [k for k in range(len(KINDS)) if (what == k).any()]
    looks = [LOOKS[KINDS[k]] for k in seen]
    place = np.full(len(KINDS) + 1, -1)
    place[seen] = range(len(seen))
    _mesh(ax, left, low, place[what], looks)
    middles = [np.sqrt(one[1:] * one[:-1]) if scale == "log" else (one[1:] + one[:-1]) / 2
               for one, scale in ((left, of_x), (low, of_y))]  # fmt: skip
    rows, columns = np.nonzero(is_mixed)
    size = float(np.clip(60.0 / max(what.shape), 1.2, 4.0))
    ax.plot(middles[0][columns], middles[1][rows], "o", color="white", markersize=size, markeredgecolor="black",
            markeredgewidth=0.4, rasterized=len(rows) > _VECTORS)  # fmt: skip
    for axis, one in ((ax.xaxis, across), (ax.yaxis, up)):
        if one.x is None:
            step = -(-len(one.ticks) // _MOST_TICKS)
            axis.set_ticks(range(0, len(one.ticks), step), one.ticks[::step])
    ax.set(xscale=of_x, yscale=of_y, xlim=(left[0], left[-1]), ylim=(low[0], low[-1]), xlabel=across.name,
           ylabel=up.name)  # fmt: skip
    handles: list[Any] = [_patch(look, look.words) for k, look in zip(seen, looks, strict=True)]
    if len(rows):
        handles.append(_handle("white", "o", "not all alike", edge=0.4))
    if (what < 0).any():
        handles.append(Patch(facecolor="white", edgecolor="black", linewidth=0.3, label="no run"))
    ax.figure.legend(handles=handles, loc="outside upper left", ncols=3, handlelength=1.2)


def _handle(colour: str, mark: str, words: str, edge: float = 0.0) -> Line2D:
    is_line = mark in "+x"
    return Line2D([], [], linestyle="", marker=mark, markersize=4, color=colour,
                  markeredgecolor=colour if is_line else "black", markeredgewidth=0.8 if is_line else edge,
                  label=words)  # fmt: skip


@panel(5.2, nrows=3, sharex=True, gridspec_kw={"height_ratios": (3, 1, 1)})
def bifurcation(axes: Sequence[Axes], along: Scale, found: Sections, title: str = "") -> None:
    """z at exits against a key, and z of what has none, above multipliers and periods of cycles.

    `along` has numbers.
    """
    above, middle, below = axes
    total = sum(len(one.x) for one in chain(found.exits.values(), found.states.values()))
    size = float(np.clip(60.0 / np.sqrt(total), 0.8, 3.0))
    is_many = total > _VECTORS
    blocks = sorted({block for block, _ in found.exits})
    handles = []
    for kind, one in found.states.items():
        colour, mark, words = _AT_SECTION[kind]
        above.plot(one.x, one.y, mark, color=colour, markersize=max(size, 2.0), markeredgewidth=0.7 * (mark in "+x"),
                   rasterized=is_many)  # fmt: skip
        handles.append(_handle(colour, mark, words))
    for (block, kind), one in found.exits.items():
        colour, mark = _BLOCKS[blocks.index(block) % len(_BLOCKS)]
        is_cycle = kind == PERIODIC
        above.plot(one.x, one.y, mark, color=colour, markersize=size if is_cycle else 0.5 * size, markeredgewidth=0,
                   alpha=1.0 if is_cycle else 0.4, rasterized=is_many)  # fmt: skip
    of_blocks = [_handle(*_BLOCKS[k % len(_BLOCKS)], f"exits of block {block}") for k, block in enumerate(blocks)]
    if len(blocks) == 1:
        of_blocks = [_handle(*_BLOCKS[0], "at exits")]
    if len(of_blocks) + len(handles) > 1:
        above.figure.legend(handles=[*of_blocks, *handles], loc="outside upper left", ncols=3,
                            handletextpad=0.1)  # fmt: skip
    is_one = {*blocks} <= {found.block}
    above.set_ylabel(f"z of block {found.block}" if is_one else "z")
    if title:
        above.set_title(title)
    for ax, key, points in ((middle, "multiplier", found.multiplier), (below, "period", found.period)):
        ax.plot(*points, "o", color="black", markersize=1.8, markeredgewidth=0, rasterized=len(points.x) > _VECTORS)
        ax.set_ylabel(key)
        top = max(points.y.max(initial=0.0), float(key == "multiplier")) or 1.0
        ax.set_ylim(-0.08 * top, 1.1 * top)
    middle.axhline(1.0, color=GREY, linewidth=0.8, linestyle="--")
    bounds, scale = _beside(along)
    below.set(xlabel=along.name, xscale=scale, xlim=(bounds[0], bounds[-1]))
    above.figure.align_ylabels(list(axes))


# ------------------------------------------------------------------------------------------------- by setting


@panel()
def shares(
    ax: Axes,
    key: str,
    values: Sequence[str],
    counts: Mapping[str, Sequence[float]],
    looks: Mapping[str, Look] = FATES,
) -> None:
    """Shares of runs by outcome, a bar for each value of a key, from above; `counts` are the runs at each value."""
    total, left = np.maximum(np.sum([*counts.values()], axis=0), 1), np.zeros(len(values))
    for outcome, numbers in counts.items():
        if any(numbers):
            look, width = looks[outcome], np.array(numbers) / total
            ax.barh(range(len(values)), width, 0.8, left, color=look.colour, hatch=look.hatch, edgecolor="white",
                    linewidth=0.3, label=look.words)  # fmt: skip
            left += width
    ax.set(xlim=(0, 1), ylim=(len(values) - 0.4, -0.6), xlabel="share of runs", ylabel=key)
    ax.xaxis.set_major_formatter(PercentFormatter(1.0))
    _name(ax, values)
    ax.figure.legend(loc="outside upper left", ncols=2, handlelength=1.2)


def _name(ax: Axes, names: Sequence[str]) -> None:
    """Names of settings beside an axis that goes down, on a figure that has room for them; none beside very many."""
    is_few = len(names) <= _MOST_NAMES
    ax.set_yticks(range(len(names)) if is_few else [], names if is_few else [])
    figure = ax.get_figure(root=True)
    assert figure is not None  # it is drawn on one
    figure.set_figheight(max(PANEL[1], 1.0 + _NAME * len(names) * is_few))


def has_bands(curves: Mapping[str, Curve]) -> bool:
    """Whether some curves of survival are drawn with their intervals."""
    return any(_has_band(share) for _, share, _, _ in curves.values())


def _has_band(share: np.ndarray) -> bool:
    """Of curves that end between none and all: bands of the others lie over each other."""
    return bool(0.0 < share[-1] < 1.0)


@panel(3.4)
def survival_curves(ax: Axes, curves: Mapping[str, Curve], t_end: float) -> None:
    """Share of runs that have not ended against time, a hue for each setting; with its interval where some ended."""
    for (label, (times, *values)), hue in zip(curves.items(), _HUES, strict=False):
        t = np.append(times, t_end)
        left, low, high = (np.append(value, value[-1]) for value in values)
        ax.step(t, left, where="post", color=hue, label=label)
        if _has_band(left):
            ax.fill_between(t, low, high, left < 1.0, step="post", color=hue, alpha=0.15, linewidth=0)
    ax.set(xlim=(0, t_end), ylim=(-0.02, 1.04), xlabel="time t", ylabel="share of runs not ended")
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    columns = 2 if max(map(len, curves)) <= _SHORT else 1
    if len(curves) > 1:
        ax.figure.legend(loc="outside upper left", ncols=columns, handlelength=1.2)


@panel()
def all_runs(ax: Axes, paths: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    """n_stick of runs, in means over blocks of time."""
    for t, mean in paths:
        ax.plot(t, mean, color=EXACT, alpha=0.35, linewidth=0.7)
    ax.set(xlabel="time t", ylabel="$n_{stick}$")
    least, most = ax.dataLim.intervaly
    if least <= FROM_ZERO * most:  # else it would be a flat line at the top
        ax.set_ylim(0, None)
