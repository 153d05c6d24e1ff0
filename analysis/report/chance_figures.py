"""Drawings of the map gamma(dt, c) and of clustering, in the style of `stickslip.analysis.report.figures`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, NullLocator, StrMethodFormatter

from stickslip.analysis.report.figures import BLUE, CYCLE, GREY, ORANGE, STYLE, subplots
from stickslip.analysis.report.words import PAPER_GAMMA
from stickslip.analysis.stats.cascades import SAMPLED

Row = Mapping[str, Any]
_PLAIN = StrMethodFormatter("{x:g}")


def gamma_curves(rows: Sequence[Row]) -> Figure:
    """gamma against dt (tau for `clusters`), one panel a definition, beside what chance gives.

    Parameters
    ----------
    rows : sequence of mapping
        Rows of the table `gamma_map` with the members' own definition of sticking.
    """
    groups = list(dict.fromkeys(row["group"] for row in rows))
    known = {row["definition"] for row in rows if row["gamma"] is not None}  # a log axis needs a number
    names = [name for name in (*SAMPLED, "clusters") if name in known]
    n_rows = -(-(len(names) + 1) // 3)
    with matplotlib.rc_context(STYLE):
        figure, grid = subplots(n_rows, 3, 0.7 + 2.1 * n_rows, sharey=True)
        axes = list(grid.flat)
        for name, ax in zip(names, axes, strict=False):
            for k, group in enumerate(groups):
                some = [row for row in rows if (row["group"], row["definition"]) == (group, name)]
                _curve(ax, [row for row in some if row["gamma"] is not None], CYCLE[k % len(CYCLE)])
            ax.axhline(PAPER_GAMMA, color=GREY, linestyle=":")
            scale = "gap tau" if name == "clusters" else "sampling step dt"
            ax.set(title=name, xscale="log", yscale="log", xlabel=scale)
            ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            ax.yaxis.set_major_formatter(_PLAIN)
            ax.yaxis.set_minor_locator(NullLocator())
            ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
            ax.xaxis.set_major_formatter(_PLAIN)
            ax.xaxis.set_minor_locator(NullLocator())
        for ax in axes[len(names) :]:
            ax.set_axis_off()
        for ax in axes[::3]:
            ax.set_ylabel("gamma")
        handles = [Line2D([], [], color=CYCLE[k % len(CYCLE)], marker="o", markersize=3) for k in range(len(groups))]
        handles += [
            Line2D([], [], color="black", linestyle="--", linewidth=0.9),
            Line2D([], [], color="black", linestyle="-.", linewidth=0.7),
            Line2D([], [], color=GREY, linestyle=":"),
        ]
        nulls = list(dict.fromkeys(row["null"] for row in rows if row["null"] is not None))
        labels = [*groups, "chance: independent exits and entries", f"chance: {' or '.join(nulls)}"]
        labels.append(f"paper: {PAPER_GAMMA}, dt not stated")
        axes[len(names)].legend(handles, [_folded(label) for label in labels], loc="center left")
    return figure


def _folded(label: str) -> str:
    """A group's label over several lines, for a legend as narrow as a panel."""
    words, lines = label.split(" "), [""]
    for word in words:
        if len(lines[-1]) + len(word) > 30:
            lines.append("")
        lines[-1] += word + " "
    return "\n".join(line.strip() for line in lines)


def _curve(ax: Axes, rows: Sequence[Row], colour: str) -> None:
    x = [row["dt"] if row["tau"] is None else row["tau"] for row in rows]
    gamma = np.array([row["gamma"] for row in rows], dtype=float)
    low = [row["gamma"] if row["gamma_low"] is None else max(row["gamma_low"], 1e-3) for row in rows]
    high = [row["gamma"] if row["gamma_high"] is None else row["gamma_high"] for row in rows]
    ax.errorbar(
        x,
        gamma,
        yerr=[np.maximum(gamma - low, 0), high - gamma],
        color=colour,
        marker="o",
        markersize=3,
        elinewidth=0.8,
    )
    for key, line, width in (("gamma_independent", "--", 0.9), ("gamma_null", "-.", 0.7)):
        chance = np.array([np.nan if row[key] is None else row[key] for row in rows])  # a gap in the line
        ax.plot(x, chance, color=colour, linestyle=line, linewidth=width)


def gamma_map(rows: Sequence[Row]) -> Figure:
    """gamma over dt and threshold, one panel a definition; the paper's value as a contour, and where chance has it.

    Parameters
    ----------
    rows : sequence of mapping
        Rows of the table `gamma_map` of one group with a threshold.
    """
    names = [name for name in SAMPLED if any(row["definition"] == name for row in rows)]
    dts = sorted({row["dt"] for row in rows if row["dt"] is not None})
    thresholds = sorted({row["threshold"] for row in rows})
    shown = [row["gamma"] for row in rows if row["gamma"] is not None and row["dt"] is not None]
    norm = LogNorm(min(shown), max(shown))
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(2, 2, 5.2, sharex=True, sharey=True)
        image = None
        for name, ax in zip(names, axes.flat, strict=False):
            cell = {(row["threshold"], row["dt"]): row for row in rows if row["definition"] == name}
            gamma, chance = (
                np.ma.masked_invalid(
                    [[_plain(cell.get((c, dt)), key) for dt in dts] for c in thresholds]
                )
                for key in ("gamma", "gamma_independent")
            )  # fmt: skip
            image = ax.pcolormesh(_edges(dts), _edges(thresholds), gamma, norm=norm, cmap="viridis")
            if len(dts) > 1 and len(thresholds) > 1:
                _contour(ax, dts, thresholds, gamma, "white", "-")
                _contour(ax, dts, thresholds, chance, ORANGE, "--")
            ax.set(title=name, xscale="log", yscale="log")
            for axis in (ax.xaxis, ax.yaxis):
                axis.set_major_formatter(_PLAIN)
                axis.set_minor_formatter(NullFormatter())
            ax.set_yticks(thresholds, [f"{c:g}" for c in thresholds])
        for ax in axes[-1]:
            ax.set_xlabel("sampling step dt")
        for ax in axes[:, 0]:
            ax.set_ylabel("threshold c")
        if image is not None:
            bar = figure.colorbar(image, ax=axes, label="gamma", format=_PLAIN)
            bar.ax.yaxis.set_minor_formatter(NullFormatter())
            bar.ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        handles = [
            Patch(facecolor="white", edgecolor=GREY, label=f"observed gamma = {PAPER_GAMMA}"),
            Line2D([], [], color=ORANGE, linestyle="--", label=f"chance gives {PAPER_GAMMA}"),
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def _edges(middles: Sequence[float]) -> np.ndarray:
    """Edges of cells around values on a log axis."""
    at = np.log(middles)
    gaps = np.diff(at) if len(at) > 1 else np.array([np.log(2.0)])
    return np.exp(np.concatenate(([at[0] - gaps[0] / 2], at[:-1] + gaps[: len(at) - 1] / 2, [at[-1] + gaps[-1] / 2])))


def _plain(row: Row | None, key: str) -> float:
    """A value of a cell, NaN for the mask where there is none."""
    return float("nan") if row is None or row[key] is None else row[key]


def _contour(
    ax: Axes, x: Sequence[float], y: Sequence[float], values: np.ma.MaskedArray, colour: str, line: str
) -> None:
    if values.count() and values.min() < PAPER_GAMMA < values.max():
        ax.contour(x, y, values, levels=[PAPER_GAMMA], colors=colour, linestyles=line, linewidths=1.6)


def clustering(panels: Sequence[tuple[str, Sequence[Row], Sequence[Row], Sequence[Row]]]) -> Figure:
    """Excess of pairs of exits and Fano factor, one row a group, beside the positive control.

    Parameters
    ----------
    panels : sequence of (label, pairs, fano, control)
        Rows of the tables of those names of one group, the pairs of one null model.
    """
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(len(panels), 2, 0.6 + 2.4 * len(panels))
        for (left, right), (label, pair_rows, fano_rows, control_rows) in zip(axes, panels, strict=True):
            _effects(left, pair_rows, "tau", "excess", "excess_low", "excess_high", "observed, with interval")
            _effects(right, fano_rows, "window", "fano", "fano_low", "fano_high", "observed, with interval")
            _controls(left, control_rows, "pairs", 100.0)
            _controls(right, control_rows, "fano", 1.0)
            left.axhline(0.0, color="black", linewidth=0.8)
            right.plot(
                [row["window"] for row in fano_rows], [row["fano_null"] for row in fano_rows], color="black",
                linewidth=0.8, label="chance",
            )  # fmt: skip
            right.axhline(1.0, color=GREY, linestyle=":", label="Poisson")
            left.set_yscale("symlog", linthresh=2.0)
            left.yaxis.set_major_formatter(_PLAIN)
            left.set(title=label, ylabel="excess of pairs of exits, %", xlabel="pairs less than tau apart")
            right.set(ylabel="Fano factor of exits", xlabel="length of windows")
            for ax in (left, right):
                ax.set_xscale("log")
                ax.xaxis.set_major_formatter(_PLAIN)
                ax.xaxis.set_minor_locator(NullLocator())
        drawn: dict[str, Any] = {}
        for ax in axes.flat:
            drawn |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
        figure.legend(drawn.values(), drawn, loc="outside lower center", ncols=3)
    return figure


def _effects(ax: Axes, rows: Sequence[Row], at: str, value: str, low: str, high: str, label: str) -> None:
    known = [row for row in rows if row[value] is not None]
    scale = 100.0 if at == "tau" else 1.0
    middle = scale * np.array([row[value] for row in known], dtype=float)
    ends = [
        scale * np.array([row[value] if row[end] is None else row[end] for row in known], dtype=float)
        for end in (low, high)
    ]
    ax.errorbar(
        [row[at] for row in known], middle, yerr=[middle - ends[0], ends[1] - middle], fmt="o", markersize=3.5,
        color=BLUE, elinewidth=1.2, label=label, zorder=3,
    )  # fmt: skip


def _controls(ax: Axes, rows: Sequence[Row], statistic: str, scale: float) -> None:
    shares = sorted({row["share"] for row in rows})
    for k, share in enumerate(shares):
        some = [row for row in rows if (row["share"], row["statistic"]) == (share, statistic)]
        some = [row for row in some if row["value"] is not None]
        ax.plot(
            [row["scale"] for row in some], [scale * row["value"] for row in some], color=ORANGE,
            linestyle=("-", "--", "-.", ":")[k % 4], linewidth=0.9, label=f"if {100 * share:g}% were triggered",
        )  # fmt: skip


def tails(panels: Sequence[tuple[str, np.ndarray, np.ndarray, np.ndarray, np.ndarray]]) -> Figure:
    """Share of durations or waiting times that exceed x, in units of their mean, on a log axis.

    Parameters
    ----------
    panels : sequence of (label, x, observed, chance, exponential)
        `chance` is what rotation (or independence) gives, each at the same x.
    """
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(-(-len(panels) // 2), 2, 0.5 + 2.2 * -(-len(panels) // 2), sharey=True)
        for ax, (label, x, observed, chance, exponential) in zip(axes.flat, panels, strict=False):
            ax.plot(x, exponential, color=GREY, linestyle=":", label="exponential of the same mean")
            ax.plot(x, chance, color="black", linewidth=0.8, label="chance")
            ax.plot(x, observed, color=BLUE, linestyle="none", marker="o", markersize=2.5, label="observed")
            ax.set(title=label, yscale="log", ylim=(2e-4, 1.3), xlabel="length / mean length")
            ax.yaxis.set_minor_locator(NullLocator())
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        for ax in axes[:, 0]:
            ax.set_ylabel("share that is longer")
        for ax in list(axes.flat)[len(panels) :]:
            ax.set_axis_off()
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure
