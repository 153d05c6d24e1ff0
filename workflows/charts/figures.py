"""What the charts show: error against cost, bias against cost, growth with size, where methods fail."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from stickslip.analysis.report.figures import BLUE, CYCLE, GREEN, GREY, ORANGE, PURPLE, STYLE, subplots

Row = Mapping[str, Any]


class Curve(NamedTuple):
    """A method's points: costs, errors, whether an error is a bound, and the least a cost could be, if known."""

    name: str
    is_ours: bool
    products: Sequence[float]
    errors: Sequence[float]
    is_bound: Sequence[bool]
    floor: Sequence[float] = ()


_PEERS = (GREEN, PURPLE, "#E69F00", "#56B4E9", GREY, "black")
_MARKERS = "^vDPX<>phd"


def speed_accuracy(panels: Sequence[tuple[str, Sequence[Curve], float | None, int | None]]) -> Figure:
    """Error against cost, one panel a problem; the engines in the foreground.

    Parameters
    ----------
    panels : sequence of (title, curves, floor, n_events)
        `floor`: errors below it cannot be told from zero; `n_events`: where one product an event would lie. None
        where there is none. An error that is a bound is drawn hollow, the floor of the costs as a thin line.
    """
    names = list(dict.fromkeys((curve.name, curve.is_ours) for _, curves, *_ in panels for curve in curves))
    style: dict[str, dict[str, Any]] = {}
    for is_front in (True, False):
        for k, name in enumerate(name for name, is_ours in names if is_ours == is_front):
            front = {"color": CYCLE[k % 2], "marker": "os"[k % 2], "linewidth": 2.2, "markersize": 5, "zorder": 3}
            behind = {"color": _PEERS[k % 6], "marker": _MARKERS[k % 10], "linewidth": 0.9, "markersize": 4}
            style[name] = front if is_front else behind | {"linestyle": "-" if k < 6 else "--"}
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(rows, columns, 0.9 + 2.7 * rows, sharex=True, sharey=True)
        for ax in axes.flat[len(panels) :]:
            ax.set_axis_off()
        for ax, (title, curves, floor, n_events) in zip(axes.flat, panels, strict=False):
            ax.set(title=title, xscale="log", yscale="log")
            for curve in curves:
                mine = style[curve.name]
                ax.plot(curve.products, curve.errors, label=curve.name, **mine)
                known = zip(curve.products, curve.errors, curve.is_bound, strict=True)
                bounds = [(x, y) for x, y, is_bound in known if is_bound]
                if bounds:
                    hollow = mine | {"linestyle": "none", "markerfacecolor": "white", "zorder": 4}
                    ax.plot(*zip(*bounds, strict=True), **hollow)
                if curve.floor:
                    ax.plot(curve.floor, curve.errors, color=mine["color"], linewidth=0.8)
            if floor is not None:
                ax.axhline(floor, color=GREY, linestyle=":", linewidth=0.8)
            if n_events:
                ax.axvline(n_events, color=GREY, linestyle="--", linewidth=0.8)
        for ax in axes[:, 0]:
            ax.set_ylabel("error, max |z − z$_{ref}$|")
        for ax in axes[-1]:
            ax.set_xlabel("cost, products of K with a vector")
        drawn: dict[str, Any] = {}
        for ax in axes.flat:
            drawn |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
        in_order = [name for name, _ in names if name in drawn]
        figure.legend([drawn[name] for name in in_order], in_order, loc="outside lower center", ncols=5)
    return figure


class Biases(NamedTuple):
    """A method's points: costs, biases with the ends of their intervals, and what stands beside each point."""

    name: str
    is_ours: bool
    products: Sequence[float]  # from the tightest setting to the loosest
    values: Sequence[float]
    lows: Sequence[float]
    highs: Sequence[float]
    labels: Sequence[str]


def statistics_cost(
    rows: Sequence[tuple[str, Sequence[tuple[Sequence[Biases], tuple[float, float, float] | None]]]],
    titles: Sequence[str],
) -> Figure:
    """Bias of statistics against cost, one row a statistic, one column a law, all in units of the sampling error.

    Parameters
    ----------
    rows : sequence of (statistic, panels)
        One panel a law: its methods, and another law's difference from it (value, low, high) or None.
    titles : sequence of str
        Of the columns.
    """
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(len(rows), len(titles), 1.0 + 1.75 * len(rows), sharex="col", sharey=True)
        for i, (statistic, panels) in enumerate(rows):
            for j, (methods, difference) in enumerate(panels):
                ax = axes[i, j]
                ax.axhspan(-1.0, 1.0, color=GREY, alpha=0.18, linewidth=0, label="sampling error")
                if difference is not None:
                    value, low, high = difference
                    ax.axhspan(low, high, color=PURPLE, alpha=0.15, linewidth=0)
                    ax.axhline(value, color=PURPLE, linestyle="--", label="sigmoid minus exact law, with interval")
                for points in methods:
                    _biases(ax, points)
                # linear where it is judged, logarithmic beyond
                ax.set_yscale("symlog", linthresh=2.0, linscale=1.2)
                ax.set(xscale="log", title=titles[j] if i == 0 else "")
                ax.set_yticks(
                    ticks := [-100, -10, -2, -1, 0, 1, 2, 10, 100], [f"{tick}".replace("-", "−") for tick in ticks]
                )
                ax.minorticks_off()
            axes[i, 0].set_ylabel(f"{statistic}\nbias / sampling error")
        shown = [edge for _, panels in rows for methods, _ in panels for m in methods for edge in (*m.lows, *m.highs)]
        reach = 4.0 * max([2.0, *map(abs, shown)])
        axes[0, 0].set_ylim(-reach, reach)
        for ax in axes[-1]:
            ax.set_xlabel("cost of a run, products of K with a vector")
        drawn: dict[str, Any] = {}
        for ax in axes.flat:
            drawn |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
        figure.legend(drawn.values(), drawn, loc="outside lower center", ncols=3)
    return figure


def _biases(ax: Axes, points: Biases) -> None:
    colour, marker = (BLUE, "o") if points.is_ours else (ORANGE, "s")
    below = [value - low for value, low in zip(points.values, points.lows, strict=True)]
    above = [high - value for value, high in zip(points.values, points.highs, strict=True)]
    ax.errorbar(
        points.products, points.values, yerr=[below, above], color=colour, marker=marker, markersize=3.5,
        linewidth=0.8, elinewidth=1.2, label=points.name,
    )  # fmt: skip
    cheapest = float("inf")
    for x, label in zip(points.products, points.labels, strict=True):
        # from the tightest on: a looser one that costs more would stand on the label of a tighter one
        y, side = (0.02, "bottom") if x > cheapest else (0.98, "top")
        cheapest = min(x, cheapest)
        ax.text(
            x, y, label, transform=ax.get_xaxis_transform(), rotation=90, ha="center", va=side,
            fontsize=6.5, color=colour,
        )  # fmt: skip


#: Cost at each n: (n, value, least, most, whether it counts for the exponent).
Points = Sequence[tuple[int, float, float, float, bool]]


def scaling(
    panels: Sequence[tuple[str, Sequence[tuple[str, Points, float | None]], float]],
    shared: Sequence[tuple[int, float]],
) -> Figure:
    """Cost against the number of blocks, log-log; and what a product costs each of the vectors that share it.

    Parameters
    ----------
    panels : sequence of (label, curves, slope)
        Each curve is (name, points, exponent): a point that does not count for the exponent is drawn hollow, the
        exponent, None if there is none, as the dashed line through the others' mean. A dotted line has `slope`.
    shared : sequence of (number of vectors, share)
        Time for each vector over that of one product alone.
    """
    names = list(dict.fromkeys(name for _, curves, _ in panels for name, *_ in curves))
    drawn: dict[str, Any] = {}
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, len(panels) + 1, 3.1)
        for ax, (label, curves, slope) in zip(axes[0], panels, strict=False):
            ax.set(title=label, xscale="log", yscale="log", xlabel="number of blocks n")
            for i, (name, points, exponent) in enumerate(curves):
                k = names.index(name)
                drawn[name] = _growth(ax, points, exponent, CYCLE[k], "osD^v<"[k])
                if exponent is not None:
                    ax.text(
                        0.05, 0.97 - 0.08 * i, f"$n^{{{exponent:.2f}}}$", transform=ax.transAxes, va="top",
                        color=CYCLE[k],
                    )  # fmt: skip
            _guide(ax, slope)
        ax = axes[0, -1]
        ax.axhline(1.0, color=GREY, linestyle=":", linewidth=0.8)
        ax.plot(*zip(*shared, strict=True), color="black", marker="o", markersize=3.5)
        ax.set_xscale("log", base=2)
        ax.set_xticks([m for m, _ in shared], [str(m) for m, _ in shared])
        ax.set(title="shared product, for each vector", xlabel="vectors in a product", ylim=(0, None))
        figure.legend(drawn.values(), drawn, loc="outside lower center", ncols=3)
    return figure


def _growth(ax: Axes, points: Points, exponent: float | None, colour: str, marker: str) -> Any:
    """The points of one curve and the line of its exponent; returns what stands for it in the legend."""
    for n, value, least, most, counts in points:
        bars = [[max(value - least, 0.0)], [max(most - value, 0.0)]]
        ax.errorbar(
            [n], [value], yerr=bars, fmt=marker, color=colour, markersize=4, linewidth=0.9,
            markerfacecolor=colour if counts else "white",
        )  # fmt: skip
    fitted = [(n, value) for n, value, *_, counts in points if counts]
    if exponent is not None:
        log_n, log_value = np.log(fitted).T
        line = np.exp(log_value.mean() + exponent * (log_n - log_n.mean()))
        ax.plot(np.exp(log_n), line, color=colour, linestyle="--", linewidth=0.9)
    (handle,) = ax.plot([], [], color=colour, marker=marker, markersize=4, linestyle="--", linewidth=0.9)
    return handle


def _guide(ax: Axes, slope: float) -> None:
    """A line of a given slope along the lower edge of what is drawn."""
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    ends = np.array([np.sqrt(left * right), right / 1.3])
    line = low * 1.3 * (ends / ends[0]) ** slope
    ax.plot(ends, line, color=GREY, linestyle=":", linewidth=1.0)
    ax.annotate(f"$n^{{{slope:g}}}$", (ends[0], line[0]), ha="right", va="bottom", color=GREY, fontsize=8)
    ax.set(xlim=(left, right), ylim=(low, max(high, line[1])))


class Map(NamedTuple):
    """One method's cells: (stiffness, setting, outcome, error or None); `limit` is a line of (stiffness, setting)."""

    title: str
    xlabel: str
    is_step: bool
    stiffness: Sequence[float]
    settings: Sequence[float]
    cells: Sequence[tuple[float, float, str, float | None]]
    limit: Sequence[tuple[float, float]] = ()


#: Fill, ink and mark of each outcome; apart in grey too, and by their marks. The first three show the error.
_OUTCOMES = {
    "right": ("#CFE4F2", "black", None, "right"),
    "rough": ("#F2C14E", "black", None, "rough"),
    "wrong": ("#A83200", "white", None, "wrong, reported as a success"),
    "failed": ("#777777", "white", "×", "failed with a message"),
    "too slow": ("white", "#777777", "…", "too slow"),
    "not judged": ("white", "#777777", "?", "not judged"),
}


def stability_maps(maps: Sequence[Map], columns: int = 4) -> Figure:
    """What came of each method over stiffness and tolerance or step; in a cell the power of ten of its error.

    Parameters
    ----------
    maps : sequence of Map
        One panel each; a line of theory is dashed.
    columns : int
        Panels in a row.
    """
    rows = -(-len(maps) // columns)
    with matplotlib.rc_context(STYLE | {"xtick.labelsize": 7, "ytick.labelsize": 7}):
        figure, axes = subplots(rows, columns, 0.75 + 1.75 * rows)
        for ax in axes.flat[len(maps) :]:
            ax.set_axis_off()
        for k, (ax, one) in enumerate(zip(axes.flat, maps, strict=False)):
            _map(ax, one)
            if k % columns == 0 or one.is_step != maps[k - 1].is_step:
                ax.set_ylabel("step h" if one.is_step else "tolerance")
            if k + columns >= len(maps):
                ax.set_xlabel(one.xlabel)
        seen = {outcome for one in maps for *_, outcome, _ in one.cells}
        handles: list[Any] = [
            Patch(facecolor=fill, edgecolor=GREY, linewidth=0.5, label=words if mark is None else f"{words} ({mark})")
            for outcome, (fill, _, mark, words) in _OUTCOMES.items()
            if outcome in seen
        ]
        if any(one.limit for one in maps):
            handles.append(Line2D([], [], color="black", linestyle="--", label="limit by theory"))
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def _map(ax: Axes, one: Map) -> None:
    column = {stiffness: k for k, stiffness in enumerate(one.stiffness)}
    row = {setting: k for k, setting in enumerate(one.settings)}
    for stiffness, setting, outcome, error in one.cells:
        fill, ink, mark, _ = _OUTCOMES[outcome]
        x, y = column[stiffness], row[setting]
        ax.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=fill, edgecolor="white", linewidth=0.5))
        text = mark if mark else (f"{np.log10(error):.0f}".replace("-", "−") if error else "∞")
        ax.text(x, y, text, color=ink, fontsize=6 if len(column) < 9 else 5, ha="center", va="center_baseline")
    if one.limit:
        x_line, y_line = np.log10(np.array(one.limit)).T
        at = (
            np.interp(x_line, np.log10(one.stiffness), range(len(column))),
            np.interp(y_line, np.log10(one.settings), range(len(row))),
        )
        ax.plot(*at, color="black", linestyle="--", linewidth=1.2)
    ax.set(xlim=(-0.5, len(column) - 0.5), ylim=(-0.5, len(row) - 0.5), title=one.title)
    for axis, values in ((ax.xaxis, list(column)), (ax.yaxis, list(row))):
        powers = np.log10(values)
        places = [k for k, power in enumerate(powers) if abs(power - round(power)) < 1e-9]
        places = places[::2] if axis is ax.xaxis and len(places) > 6 else places
        axis.set_ticks(places, [f"$10^{{{powers[k]:.0f}}}$" for k in places])
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)


def linear_theory(
    factors: Sequence[tuple[str, bool, Sequence[float], Sequence[float]]],
    errors: Sequence[tuple[str, bool, bool, Sequence[float], Sequence[float]]],
) -> Figure:
    """|R(-x)| of each method over x = h mu / delta, and error against step of a stiff equation's smooth solution.

    Parameters
    ----------
    factors : sequence of (name, is_ours, x, |R|)
    errors : sequence of (name, is_ours, is_stiff, h, error)
        Dashed where the equation is not stiff.
    """
    names = list(dict.fromkeys(name for name, *_ in factors))
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, 2, 3.0)
        left, right = axes[0]
        for name, is_ours, x, size in factors:
            left.plot(x, size, label=name, color=CYCLE[names.index(name) % 6], linewidth=2.2 if is_ours else 1.2)
        left.axhline(1.0, color=GREY, linestyle=":", linewidth=0.8)
        left.set(xscale="log", yscale="log", ylim=(1e-4, 1e1), xlabel="x = h μ / δ", ylabel="|R(−x)|",
                 title="what a step leaves of a disturbance")  # fmt: skip
        for name, is_ours, is_stiff, h, error in errors:
            right.plot(
                h, error, color=CYCLE[names.index(name) % 6], linestyle="-" if is_stiff else "--", marker="o",
                markersize=3, linewidth=2.2 if is_ours else 1.2,
            )  # fmt: skip
        right.set(xscale="log", yscale="log", xlabel="step h", ylabel="error at t = 1",
                  title="order: stiff (solid), not stiff (dashed)")  # fmt: skip
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=6)
    return figure
