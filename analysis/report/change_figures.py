"""Pictures of pairs of runs and of fates: how they part, how their statistics differ, how long motion lasts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from stickslip.analysis.questions.growth_rates import GROWS, SHRINKS
from stickslip.analysis.report.figures import CYCLE, GREY, STYLE, subplots
from stickslip.analysis.report.section import Picture
from stickslip.analysis.stats.compare import DIFFERENT, EQUIVALENT, OPEN

if TYPE_CHECKING:
    from stickslip.analysis.stats.fates import Curve

Row = Mapping[str, Any]
Line = tuple[str, str, np.ndarray, np.ndarray]  # family (one colour), label, times, values
Panel = tuple[str, Sequence[Line], Sequence[Line], float | None]  # setting, distances, differences, level
_DASHES = ("-", "--", "-.", ":")
_MARKS = {EQUIVALENT: ("o", CYCLE[0]), DIFFERENT: ("s", CYCLE[1]), OPEN: ("D", GREY)}
#: Of figures whose colours are verdicts and whose intervals are those of single tests.
HOW_TO_READ = (
    "Intervals are of each comparison by itself, colours are the verdicts, which are adjusted for the number of "
    "comparisons: a grey bar may lie beyond the band, or clear of zero. Arrowheads: beyond the axis."
)
_WIDEST = 6.0  # margins to each side: what lies further out would leave no room for the others
_NARROW = ("narrow_low", "narrow_high")


def parting(panels: Sequence[Panel]) -> Picture:
    """Distance of states (log), if recorded, and difference of n_stick against time; one row a setting.

    Parameters
    ----------
    panels : sequence of (label, distances, differences, level)
        Medians over matrices; `level` is the late difference of two matrices.
    """
    with_states = any(distances for _, distances, *_ in panels)
    left = "Left: distance of a changed run's state from its base, median over matrices. Right: "
    return Picture(
        partial(_parting, panels),
        (left if with_states else "")
        + "|Difference of n_stick|, mean over pairs in windows of time; dotted, what two different matrices give "
        "after t_burn.",
        f"Curves of {'distance and of ' if with_states else ''}the difference of n_stick over time, one for each "
        "kind and size of change.",
    )


def _parting(panels: Sequence[Panel]) -> Figure:
    lines = [line for _, *both, _ in panels for some in both for line in some]
    style = _styles(list(dict.fromkeys((family, label) for family, label, *_ in lines)))
    with_states = any(distances for _, distances, *_ in panels)
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(len(panels), 1 + with_states, 1.1 + 2.0 * len(panels), sharex=True)
        for row, (title, distances, differences, level) in zip(axes, panels, strict=True):
            right = row[-1]
            for ax, some in zip(row, (distances, differences) if with_states else (differences,), strict=True):
                for _, label, t, values in some:
                    ax.plot(t, values, linewidth=1.0, label=label, **style[label])
            if level:
                right.axhline(level, color="black", linestyle=":", linewidth=1.0)
            row[0].set_title(title)
            right.set_ylabel("mean |difference of $n_{stick}$|")
            right.set_ylim(bottom=0)
            if with_states:
                row[0].set_ylabel("distance of states")
                if any((values > 0).any() for *_, values in distances):  # copies that never left it are no curve
                    row[0].set_yscale("log")
        for ax in axes[-1]:
            ax.set_xlabel("time t (dimensionless)")
        handles: list[Any] = [Line2D([], [], label=label, **look) for label, look in style.items()]
        handles.append(Line2D([], [], color="black", linestyle=":", label="two different matrices, late"))
        figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=7)
    return figure


def growth_rates(groups: Sequence[tuple[Row, Sequence[Row]]]) -> Picture:
    """Growth rate of each draw with its own error, and the mean over draws; one column a setting.

    Parameters
    ----------
    groups : sequence of (row of the table `growth`, its rows of `growth_rates`)
    """
    return Picture(
        partial(_growth_rates, groups),
        "Growth rate of small differences of the start by draw of the matrix, each with the interval of its own "
        "error, in order of size; runaway draws have none and are counted below.",
        "Growth rate of each draw, one column for each setting.",
    )


def _growth_rates(groups: Sequence[tuple[Row, Sequence[Row]]]) -> Figure:
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, 1, 3.0)
        ax = axes[0, 0]
        ax.axhline(0, color=GREY, linewidth=0.6)
        for k, (row, draws) in enumerate(groups):
            known = sorted((draw for draw in draws if draw["rate"] is not None), key=lambda draw: draw["rate"])
            x = k + 0.6 * (np.arange(len(known)) / max(len(known) - 1, 1) - 0.5)
            for at, draw in zip(x, known, strict=True):
                is_beyond = draw["verdict"] in (GROWS, SHRINKS)
                ax.plot([at, at], [draw["low"], draw["high"]], color=CYCLE[k % 6], linewidth=0.8, alpha=0.6)
                ax.plot([at], [draw["rate"]], "o", color=CYCLE[k % 6], markersize=4,
                        markerfacecolor=CYCLE[k % 6] if is_beyond else "white")  # fmt: skip
            if row["low"] is not None:
                ax.plot([k + 0.4] * 2, [row["low"], row["high"]], color="black", linewidth=1.4)
            ax.plot([k + 0.4], [row["rate"]], "D", color="black", markersize=4)
        names = [
            _wrapped(row["setting"]) + (f"\n{row['n_runaway']} run away" if row["n_runaway"] else "")
            for row, _ in groups
        ]
        ax.set_xticks(range(len(groups)), names)
        ax.set_xlim(-0.6, len(groups) - 0.4)
        ax.set_ylabel("growth rate per unit time")
        handles: list[Any] = [
            Line2D([], [], marker="o", linestyle="", color=GREY, markersize=4, label="a draw, beyond its own error"),
            Line2D([], [], marker="o", linestyle="", color=GREY, markersize=4, markerfacecolor="white",
                   label="a draw, within it"),
            Line2D([], [], marker="D", color="black", markersize=4, label="mean over draws, interval"),
        ]  # fmt: skip
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def _styles(names: Sequence[tuple[str, str]]) -> dict[str, dict[str, Any]]:
    """A colour and a dash for each family, lighter from one label of it to the next."""
    families = list(dict.fromkeys(family for family, _ in names))
    found = {}
    for k, family in enumerate(families):
        labels = [label for other, label in names if other == family]
        for j, label in enumerate(labels):
            dark = np.array(to_rgb(CYCLE[k % 6]))
            light = 0.6 * (len(labels) - 1 - j) / max(len(labels) - 1, 1)
            found[label] = {"color": tuple(dark + (1 - dark) * light), "linestyle": _DASHES[k % 4]}
    return found


def forest(panels: Sequence[tuple[str, Sequence[Row]]]) -> Picture:
    """Relative differences in units of their margins with intervals, beside what a redraw of the matrix gives.

    Parameters
    ----------
    panels : sequence of (setting, rows)
        Rows of the table `robustness` that have a difference.
    """
    return Picture(
        partial(_forest, panels),
        "Differences between changed runs and their bases in units of the declared margin (band), with the "
        f"interval of the equivalence test. {HOW_TO_READ} Ticks: how far two different matrices typically "
        "lie apart.",
        "Forest plot: one row for each change, one column for each quantity.",
    )


def _forest(panels: Sequence[tuple[str, Sequence[Row]]]) -> Figure:
    quantities = list(dict.fromkeys(row["quantity"] for _, rows in panels for row in rows))
    n_lines = [len({row["change"] for row in rows}) for _, rows in panels]
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(
            len(panels), len(quantities), 0.9 + 0.55 * len(panels) + 0.2 * sum(n_lines), sharey="row",
            gridspec_kw={"height_ratios": [n + 1.5 for n in n_lines]},
        )  # fmt: skip
        for row_axes, (label, rows) in zip(axes, panels, strict=True):
            changes = list(dict.fromkeys(row["change"] for row in rows))
            for ax, quantity in zip(row_axes, quantities, strict=True):
                ax.axvspan(-1, 1, color=GREY, alpha=0.15, linewidth=0)
                ax.axvline(0, color=GREY, linewidth=0.6)
                some = [row for row in rows if row["quantity"] == quantity]
                widest = min(max([1.3, *(_reach(row) for row in some)]), _WIDEST)
                ax.set_xlim(-widest, widest)
                for row in some:
                    y, redraw = -changes.index(row["change"]), row["redraw"]
                    _bar(ax, y, row["difference"], row, widest)
                    if redraw is not None:
                        ends = [-redraw / row["margin"], redraw / row["margin"]]
                        ax.plot(ends, [y, y], "|", color="black", markersize=5)
                ax.xaxis.set_major_locator(MaxNLocator(3, integer=True))  # narrow panels
                ax.set_title(quantity.replace("_", "\n"), fontsize=8)
                ax.tick_params(axis="y", length=0)
            row_axes[0].set_yticks([-k for k in range(len(changes))], [_short(change) for change in changes])
            row_axes[0].set_ylabel(_wrapped(label), fontsize=8)
        for ax in axes[-1]:
            ax.set_xlabel("difference\n/ margin")
        handles: list[Any] = [
            Line2D([], [], marker=mark, color=colour, markersize=4, label=verdict)
            for verdict, (mark, colour) in _MARKS.items()
        ]
        handles.append(Line2D([], [], marker="|", linestyle="", color="black", label="a redraw of the matrix"))
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


_FATES = {
    "collapsed": ("slips for good (certified)", CYCLE[0], "s"), "silent": ("silent, not certified", CYCLE[5], "D"),
    "sustained": ("in motion at the end", CYCLE[2], "o"), "diverged": ("ran away", CYCLE[1], "^"),
    "failed": ("failed", GREY, "x"),
}  # fmt: skip


_ENDS: dict[str, Any] = {"collapsed": "--", "silent": "-.", "diverged": ":"}


def fates(rows: Sequence[Row], draws: Sequence[Row]) -> Picture:
    """Shares of the fates by setting, and below the linear growth rate of each draw, marked by its fate.

    Parameters
    ----------
    rows : sequence of mapping
        Rows of the table `survival`.
    draws : sequence of mapping
        Rows of the table `fates`.
    """
    return Picture(
        partial(_fates, rows, draws),
        "Above: what became of the runs. Below: largest real part of the eigenvalues of the state in which all "
        "blocks slip, one mark a draw in order of size; above zero that state is linearly unstable.",
        "Bars of the fates of runs by number of blocks, and growth rates of the draws marked by fate.",
    )


def _fates(rows: Sequence[Row], draws: Sequence[Row]) -> Figure:
    labels = [row["setting"] for row in rows]
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(2, 1, 4.6, sharex=True)
        (top,), (low,) = axes
        floor = np.zeros(len(rows))
        shown = [name for name in _FATES if name != "failed" and any(row[f"n_{name}"] for row in rows)]
        for name in shown:
            share = np.array([row[f"n_{name}"] / row["n_runs"] for row in rows])
            top.bar(range(len(rows)), share, 0.7, floor, color=_FATES[name][1])
            floor += share
        top.set_ylabel("share of runs")
        low.axhline(0, color=GREY, linewidth=0.6)
        for name, (_, colour, marker) in _FATES.items():
            some = [draw for draw in draws if draw["fate"] == name and draw["setting"] in labels]
            x = [labels.index(draw["setting"]) + _place(draw, draws) for draw in some]
            low.plot(x, [draw["growth_rate"] for draw in some], marker, color=colour, markersize=3.5, linestyle="")
        low.set_ylabel("linear growth rate\nof the all-slip state")
        names = [f"n = {row['n']}\n$\\kappa n$ = {row['kappa_n']:g}" for row in rows]
        if len({row["n"] for row in rows}) < len(rows):
            names = [_wrapped(label) for label in labels]
        low.set_xticks(range(len(rows)), names)
        handles: list[Any] = [
            Line2D([], [], marker=_FATES[name][2], linestyle="", color=_FATES[name][1], label=_FATES[name][0])
            for name in shown
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def _place(draw: Row, draws: Sequence[Row]) -> float:
    """Where a draw stands in its column, from -0.3 to 0.3 in order of the growth rate."""
    rates = [other["growth_rate"] for other in draws if other["setting"] == draw["setting"]]
    rank = sum(rate < draw["growth_rate"] for rate in rates)
    return 0.6 * (rank / max(len(rates) - 1, 1) - 0.5)


def contrasts(panels: Sequence[tuple[str, Sequence[Row]]], caption: str) -> Picture:
    """Differences in units of their margins, a panel a setting and a line a statistic.

    Parameters
    ----------
    panels : sequence of (label, rows)
        Rows of `stickslip.analysis.questions.contrast.judged` that have a difference.
    caption : str
    """
    return Picture(
        partial(_contrasts, panels), caption, "Forest plot: one panel for each setting, one line for each statistic."
    )


def _contrasts(panels: Sequence[tuple[str, Sequence[Row]]]) -> Figure:
    by_length = sorted(panels, key=lambda panel: -len(panel[1]))  # the fullest panel has the order of the table
    names = list(dict.fromkeys(row["quantity"] for _, rows in by_length for row in rows))
    columns = min(len(panels), 3)
    n_rows = -(-len(panels) // columns)
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(n_rows, columns, n_rows * (0.6 + 0.17 * len(names)) + 0.5, sharey=True)
        for ax, (label, rows) in zip(axes.flat, panels, strict=False):
            ax.axvspan(-1, 1, color=GREY, alpha=0.15, linewidth=0)
            ax.axvline(0, color=GREY, linewidth=0.6)
            widest = min(
                max(1.3, *(1.08 * abs(row[end]) / row["margin"] for row in rows for end in _NARROW)), _WIDEST
            )
            ax.set_xlim(-widest, widest)
            for row in rows:
                _bar(ax, names.index(row["quantity"]), row["relative"], row, widest)
            ax.set_title(_wrapped(label), fontsize=8)
            ax.tick_params(axis="y", length=0)
            ax.set_xlabel("difference / margin")
        for ax in axes.flat[len(panels) :]:
            ax.set_axis_off()
        axes[0, 0].set_yticks(range(len(names)), names)
        axes[0, 0].set_ylim(len(names) - 0.5, -0.5)
        handles: list[Any] = [
            Line2D([], [], marker=mark, color=colour, markersize=4, label=verdict)
            for verdict, (mark, colour) in _MARKS.items()
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def _bar(ax: Axes, y: float, value: float, row: Row, widest: float) -> None:
    """A difference with its interval in units of the margin; an arrowhead at the edge where it lies further out."""
    mark, colour = _MARKS[row["verdict"]]
    x, *ends = (one / row["margin"] for one in (value, row["narrow_low"], row["narrow_high"]))
    ax.plot(ends, [y, y], color=colour, linewidth=1.4)
    if abs(x) > widest:
        mark = ">" if x > 0 else "<"
    ax.plot([min(max(x, -widest), widest)], [y], mark, color=colour, markersize=4, clip_on=False)


def _reach(row: Row) -> float:
    ends = [abs(row["narrow_low"]), abs(row["narrow_high"]), row["redraw"] or 0.0]
    return 1.08 * float(max(ends)) / float(row["margin"])


def _short(change: str) -> str:
    return change.replace("constants changed by ", "constants ").replace("start displaced by ", "start ")


def _wrapped(label: str) -> str:
    return label.replace(", ", "\n", 1).replace(", ", ",\n")


def survival_curves(panels: Sequence[tuple[str, Curve, float]]) -> Picture:
    """Share of runs in self-sustained motion with its interval, and of each end, against time; a panel a setting.

    Parameters
    ----------
    panels : sequence of (label, curve, t_end)
    """
    return Picture(
        partial(_survival_curves, panels),
        "Share of runs in self-sustained motion, Kaplan and Meier's estimate with its interval, and the shares that "
        "have met each end, over time (dimensionless).",
        "Survival curves and cumulative incidences, one panel for each setting.",
    )


def _survival_curves(panels: Sequence[tuple[str, Curve, float]]) -> Figure:
    columns = min(len(panels), 4)
    n_rows = -(-len(panels) // columns)
    ends = [end for end in ("collapsed", "silent", "diverged") if any(c.incidence[end][-1] > 0 for _, c, _ in panels)]
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(n_rows, columns, 0.7 + 1.7 * n_rows, sharex=True, sharey=True)
        for ax, (label, curve, t_end) in zip(axes.flat, panels, strict=False):
            t, colour = np.append(curve.t, t_end), _FATES["sustained"][1]
            ax.step(t, _held(curve.survival), where="post", color=colour)
            ax.fill_between(
                t, _held(curve.low), _held(curve.high), step="post", color=colour, alpha=0.15, linewidth=0
            )
            for end in ends:
                if curve.incidence[end][-1] > 0:
                    ax.step(t, _held(curve.incidence[end]), where="post", color=_FATES[end][1], linestyle=_ENDS[end])
            ax.set_title(_wrapped(label), fontsize=8)
        for ax in axes.flat[len(panels) :]:
            ax.set_axis_off()
        axes[0, 0].set(ylim=(-0.02, 1.04), xlim=(0, None))
        for ax in axes[:, 0]:
            ax.set_ylabel("share of runs")
        for ax in axes.flat[max(len(panels) - columns, 0) : len(panels)]:
            ax.tick_params(labelbottom=True)
            ax.set_xlabel("time t")
        handles: list[Any] = [Line2D([], [], color=_FATES["sustained"][1], label="in motion, with interval")]
        handles += [Line2D([], [], color=_FATES[end][1], linestyle=_ENDS[end], label=_FATES[end][0]) for end in ends]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def _held(values: np.ndarray) -> np.ndarray:
    return np.append(values, values[-1])
