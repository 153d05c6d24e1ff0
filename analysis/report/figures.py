"""The style of every plot, and the plots of cascades: colour-blind safe, legible, the same bytes for like data."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from stickslip.analysis.report.words import PAPER_GAMMA

Row = Mapping[str, Any]
Cascade = tuple[int, float, float]  # size, first exit, last exit

# Okabe and Ito's palette: distinguishable with every common form of colour blindness, and in grey.
BLUE, ORANGE, GREEN, PURPLE, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#666666"
CYCLE = (BLUE, ORANGE, GREEN, PURPLE, "#E69F00", "#56B4E9")
STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "svg.hashsalt": "stickslip",  # fixed ids: the same figure is the same bytes
}
WIDTH = 7.2  # inches: the text width of the report


def svg(figure: Figure) -> str:
    """A figure as SVG text, without date: a function of the figure alone."""
    buffer = io.StringIO()
    with matplotlib.rc_context(STYLE):
        FigureCanvasSVG(figure)
        layout = figure.get_layout_engine()
        if layout is not None:  # left in place, it would have the figure drawn twice
            layout.execute(figure)
            figure.set_layout_engine("none")
        figure.savefig(buffer, format="svg", dpi=160, metadata={"Date": None})
    return buffer.getvalue()


def embedded(figure: Figure) -> str:
    """A figure as the address of an image that is part of a page."""
    # As an image, not inline: two inline SVGs would share, and mix up, the ids of their glyphs and clips.
    encoded = base64.b64encode(svg(figure).encode("utf-8")).decode("ascii")
    return f"data:image/svg+xml;base64,{encoded}"


def blank(height: float) -> Figure:
    """A figure as wide as the page's text, `height` inches high, that lays itself out."""
    return Figure(figsize=(WIDTH, height), layout="constrained")


def subplots(rows: int, columns: int, height: float, **kwargs: Any) -> tuple[Figure, np.ndarray]:
    """Such a figure and its axes, shape (rows, columns)."""
    figure = blank(height)
    return figure, figure.subplots(rows, columns, squeeze=False, **kwargs)


def legend(figure: Figure, columns: int, axes: Iterable[Axes] | None = None) -> None:
    """One legend below the figure for the curves of its axes, or of some of them, each name once."""
    drawn: dict[str, Any] = {}
    for ax in figure.axes if axes is None else axes:
        drawn |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    figure.legend(drawn.values(), drawn, loc="outside lower center", ncols=columns)


PANEL = (4.2, 3.0)  # inches: half of the page, side by side on wide screens
EXACT, SMOOTHED = "#1f4e79", "#c4561a"  # the two laws, as filled circles and open squares


def one_run(t: np.ndarray, n_stick: np.ndarray, t_stop: float, t_burn: float, cascade: Cascade | None) -> Figure:
    """n_stick(t) of one run, what is left out shaded, and one cascade enlarged.

    Parameters
    ----------
    t, n_stick : ndarray, shape (m,)
        Change points, the last value holding to t_stop.
    cascade : (size, first exit, last exit), optional
    """
    t, n_stick = np.append(t, t_stop), np.append(n_stick, n_stick[-1])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=PANEL, layout="constrained")
        ax = figure.subplots()
        ax.step(t, n_stick, where="post", color=EXACT, linewidth=0.5, rasterized=True)
        ax.axvspan(0, t_burn, color=GREY, alpha=0.13, linewidth=0)
        ax.text(t_burn / 2, 0.02, "left out", transform=ax.get_xaxis_transform(), ha="center", color=GREY, fontsize=7)
        ax.set(
            xlim=(0, max(t_stop, t_burn)), ylim=(0, None), xlabel="time t", ylabel="blocks that stick, $n_{stick}$"
        )
        if cascade is not None:
            size, first, last = cascade
            wide = max(4 * (last - first), 1e-6)
            seen = (t >= first - wide) & (t <= last + wide)
            ax.set_ylim(0, 2.1 * n_stick[t > t_burn].max())
            inset = ax.inset_axes((0.38, 0.6, 0.6, 0.36))
            inset.step(t[seen], n_stick[seen], where="post", color=EXACT, linewidth=0.9)
            let_go = (t >= first) & (t <= last)
            start = np.flatnonzero(let_go)[0]
            inset.step(
                np.append(first, t[let_go]), np.append(n_stick[start - 1], n_stick[let_go]), where="post",
                color=SMOOTHED, linewidth=1.8,
            )  # fmt: skip
            inset.set_title(f"one cascade, size {size}", color=SMOOTHED, fontsize=7, loc="right")
            inset.tick_params(labelsize=6)
            inset.xaxis.set_major_locator(MaxNLocator(nbins=3))
            inset.yaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))
    return figure


def size_law(laws: Sequence[tuple[str, Sequence[Row]]], rates: Sequence[Row]) -> Figure:
    """Share of cascades of each size on a log axis for some groups, with fit and chance, and all over chance below.

    Parameters
    ----------
    laws : sequence of (label, rows)
        Rows of the table `sizes`, by events, of each group.
    rates : sequence of mapping
        Of each group `gamma`, `gamma_low` and `gamma_high`.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=PANEL, layout="constrained")
        top, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
        largest = 1
        for k, (label, rows) in enumerate(laws):
            seen = [row for row in rows if row["n_cascades"] >= 5 and row["share_low"]]
            if not seen:
                continue
            sizes = np.array([row["size"] for row in seen], dtype=float)
            share, less, more = (np.array([row["share" + end] for row in seen]) for end in ("", "_low", "_high"))
            largest, chance = max(largest, int(sizes[-1])), 0.5**sizes
            form: Any = {"fmt": "os"[k % 2], "color": (EXACT, SMOOTHED)[k % 2], "markersize": 3, "linewidth": 0.8}
            form["markerfacecolor"] = form["color"] if k % 2 == 0 else "white"
            at = sizes + 0.12 * k
            top.errorbar(at, share, yerr=[share - less, more - share], label=label, **form)
            below.errorbar(at, share / chance, yerr=[(share - less) / chance, (more - share) / chance], **form)
        grid = np.arange(1, largest + 1)
        rate = rates[0]
        fit, low, high = (
            None if rate[name] is None else -np.expm1(-rate[name]) * np.exp(-rate[name] * (grid - 1))
            for name in ("gamma", "gamma_low", "gamma_high")
        )
        if fit is not None:
            top.plot(grid, fit, color=EXACT, linewidth=1, label="fit")
            below.plot(grid, fit * 2.0**grid, color=EXACT, linewidth=1)
        if low is not None and high is not None:
            below.fill_between(grid, low * 2.0**grid, high * 2.0**grid, color=EXACT, alpha=0.2, linewidth=0)
        top.plot(grid, 0.5**grid, "--", color=GREY, linewidth=1, label="chance")
        below.axhline(1.0, linestyle="--", color=GREY, linewidth=1)
        top.set_yscale("log")
        top.yaxis.set_minor_locator(NullLocator())
        top.set_ylabel("share, f")
        below.set(ylabel="f / chance", xlabel="cascade size s, blocks let go")
        size_axis(below, largest)
        top.legend(loc="upper right", fontsize=7)
    return figure


def trajectories(
    panels: Sequence[tuple[str, Sequence[tuple[str, np.ndarray, np.ndarray, float]]]], t_burn: float
) -> Figure:
    """n_stick(t): one row a group, one column a draw; the time before t_burn is shaded.

    Parameters
    ----------
    panels : sequence of (label, draws)
        Each draw is (title, t, n_stick, t_stop): change points, the last value holding to t_stop.
    t_burn : float
        Start of the statistics (dimensionless).
    """
    columns = max(len(draws) for _, draws in panels)
    t_last = max(t_stop for _, draws in panels for *_, t_stop in draws)
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(len(panels), columns, 0.5 + 1.45 * len(panels), sharex=True, sharey="row")
        for i, (label, draws) in enumerate(panels):
            for j in range(columns):
                ax = axes[i, j]
                if j >= len(draws):
                    ax.set_axis_off()
                    continue
                title, t, n_stick, t_stop = draws[j]
                # Thousands of steps: a picture inside the SVG keeps the report small.
                ax.step(
                    np.append(t, t_stop), np.append(n_stick, n_stick[-1]), where="post", color=BLUE,
                    linewidth=0.6, rasterized=True,
                )  # fmt: skip
                ax.axvspan(0, t_burn, color=GREY, alpha=0.15, linewidth=0)
                ax.set_title(f"{label}\n{title}" if j == 0 else title)
            axes[i, 0].set_ylim(
                bottom=0
            )  # shared by the row; set earlier, it would fix the top for the draws to come
            axes[i, 0].set_ylabel("$n_{stick}$")
        for ax in axes[-1]:
            ax.set_xlabel("time t (dimensionless)")
        axes[0, 0].set_xlim(0, max(t_last, t_burn))  # shared by all panels
    return figure


def distributions(rows: Sequence[Row], titles: Mapping[str, str]) -> Figure:
    """Share of cascades by size on a log axis: observed with intervals over matrices, fit, and chance.

    Parameters
    ----------
    rows : sequence of mapping
        Rows of the table `sizes` of one group, one dt for each definition.
    titles : mapping of definition to str
        One panel each, in this order.
    """
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, len(titles), 2.5, sharey=True)
        for ax, (definition, title) in zip(axes[0], titles.items(), strict=True):
            _distribution(ax, [row for row in rows if row["definition"] == definition])
            ax.set_title(title)
            ax.set_xlabel("size")
        axes[0, 0].set_ylabel("share of cascades")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def _distribution(ax: Axes, rows: Sequence[Row]) -> None:
    ax.set_yscale("log")
    ax.yaxis.set_minor_locator(NullLocator())  # over many decades they are a blur, and most of the drawing
    seen = [row for row in rows if row["n_cascades"]]
    if not seen:
        ax.set_xticks([])
        ax.text(0.5, 0.5, "no cascade", transform=ax.transAxes, ha="center", color=GREY)
        return
    floor = 0.5 * min(row["share"] for row in seen)
    fitted = [row for row in rows if row["share_fit"] is not None and row["share_fit"] > floor]
    chance = [row for row in rows if row["share_chance"] is not None and row["share_chance"] > floor]
    sizes = [row["size"] for row in seen]
    share = np.array([row["share"] for row in seen])
    low = np.array([row["share"] if row["share_low"] is None else max(row["share_low"], floor) for row in seen])
    high = np.array([row["share"] if row["share_high"] is None else row["share_high"] for row in seen])
    ax.plot(
        [row["size"] for row in chance], [row["share_chance"] for row in chance],
        color=ORANGE, linestyle="--", label="chance (random order)",
    )  # fmt: skip
    ax.plot(
        [row["size"] for row in fitted], [row["share_fit"] for row in fitted],
        color=BLUE, label="exponential fit",
    )  # fmt: skip
    ax.errorbar(
        sizes, share, yerr=[np.maximum(share - low, 0), np.maximum(high - share, 0)], fmt="o", markersize=3,
        color="black", linewidth=0.8, label="observed, interval over matrices",
    )  # fmt: skip
    ax.set_ylim(0.8 * floor, 1.3)
    size_axis(ax, max(row["size"] for row in [*seen, *fitted, *chance]))


def size_axis(ax: Axes, largest: int) -> None:
    """An axis of sizes, 1 to `largest`: whole numbers, be there one alone."""
    ax.set_xlim(0.5, largest + 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(nbins="auto", integer=True, min_n_ticks=1))


def forest(rows: Sequence[Row]) -> Figure:
    """gamma by definition and dt for each group, with intervals, beside chance and the paper's value.

    Parameters
    ----------
    rows : sequence of mapping
        Rows of the table `law`; those without a value of gamma leave their line empty.
    """
    laws = list(dict.fromkeys((row["definition"], row["dt"]) for row in rows))
    groups = list(dict.fromkeys(row["group"] for row in rows))
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, 1, 1.4 + 0.16 * len(laws) * (len(groups) + 0.8))
        ax = axes[0, 0]
        for k, group in enumerate(groups):
            offset = 0.0 if len(groups) == 1 else 0.5 * (k / (len(groups) - 1) - 0.5)
            some = [row for row in rows if row["group"] == group and row["gamma"] is not None]
            y = np.array([laws.index((row["definition"], row["dt"])) + offset for row in some])
            value = np.array([row["gamma"] for row in some], dtype=float)
            half = [0.0 if row["gamma_low"] is None else row["gamma"] - row["gamma_low"] for row in some]
            colour = CYCLE[k % len(CYCLE)]
            ax.errorbar(value, y, xerr=half, fmt="o", markersize=3.5, color=colour, linewidth=1, label=group)
            chance = [(row["gamma0"], at) for row, at in zip(some, y, strict=True) if row["gamma0"] is not None]
            ax.plot(
                [rate for rate, _ in chance], [at for _, at in chance], "|", color="black",
                markersize=8, label="chance (random order)" if k == len(groups) - 1 else None,
            )  # fmt: skip
        for between in range(1, len(laws)):
            ax.axhline(between - 0.5, color=GREY, alpha=0.25, linewidth=0.5)
        ax.axvline(PAPER_GAMMA, color=GREY, linestyle=":", label=f"paper: {PAPER_GAMMA}, dt not stated")
        ax.set_yticks(range(len(laws)), [name if dt is None else f"{name}, dt = {dt:g}" for name, dt in laws])
        ax.set_ylim(len(laws) - 0.5, -0.5)
        ax.set_xlim(left=0)
        ax.set_xlabel("gamma, per unit of size (dimensionless)")
        figure.legend(loc="outside lower center", ncols=2)
    return figure
