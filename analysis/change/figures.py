"""Pictures of pairs of runs and of fates: how they part, how their statistics differ, how long motion lasts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.figures import CYCLE, GREY, STYLE, WIDTH
from analysis.section import Picture

if TYPE_CHECKING:
    from analysis.change.survival import Curve

Row = Mapping[str, Any]
Line = tuple[str, str, np.ndarray, np.ndarray]  # family (one colour), label, times, values
_DASHES = ("-", "--", "-.", ":")


def _figure(rows: int, columns: int, height: float, **kwargs: Any) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **kwargs)


def parting(panels: Sequence[tuple[str, Sequence[Line], Sequence[Line], float | None]]) -> Picture:
    """Distance of states (log) and difference of n_stick against time; one row a setting.

    Parameters
    ----------
    panels : sequence of (label, distances, differences, level)
        Medians over matrices; `level` is the late difference of two matrices.
    """
    lines = [line for _, *both, _ in panels for some in both for line in some]
    style = _styles(list(dict.fromkeys((family, label) for family, label, *_ in lines)))
    with matplotlib.rc_context(STYLE):
        figure, axes = _figure(len(panels), 2, 1.1 + 2.0 * len(panels), sharex=True)
        for (left, right), (title, distances, differences, level) in zip(axes, panels, strict=True):
            for ax, some in ((left, distances), (right, differences)):
                for _, label, t, values in some:
                    ax.plot(t, values, linewidth=1.0, label=label, **style[label])
            if level:
                right.axhline(level, color="black", linestyle=":", linewidth=1.0)
            left.set_title(title)
            left.set_ylabel("distance of states")
            if any((values > 0).any() for *_, values in distances):  # copies that never left it are no curve
                left.set_yscale("log")
            right.set_ylabel("mean |difference of $n_{stick}$|")
            right.set_ylim(bottom=0)
        for ax in axes[-1]:
            ax.set_xlabel("time t (dimensionless)")
        handles: list[Any] = [Line2D([], [], label=label, **look) for label, look in style.items()]
        handles.append(Line2D([], [], color="black", linestyle=":", label="two different matrices, late"))
        figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=7)
    return Picture(
        figure,
        "Left: distance of a changed run's state from its base, median over matrices. Right: difference of n_stick, "
        "mean over pairs in windows of time; dotted, what two different matrices give after t_burn.",
        "Curves of distance and of the difference of n_stick over time, one for each kind and size of change.",
    )


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
    marks = {"equivalent": ("o", CYCLE[0]), "different": ("s", CYCLE[1]), "not enough data": ("D", GREY)}
    quantities = list(dict.fromkeys(row["quantity"] for _, rows in panels for row in rows))
    n_lines = [len({row["change"] for row in rows}) for _, rows in panels]
    with matplotlib.rc_context(STYLE):
        figure, axes = _figure(
            len(panels), len(quantities), 0.9 + 0.55 * len(panels) + 0.2 * sum(n_lines), sharey="row",
            gridspec_kw={"height_ratios": [n + 1.5 for n in n_lines]},
        )  # fmt: skip
        for row_axes, (label, rows) in zip(axes, panels, strict=True):
            changes = list(dict.fromkeys(row["change"] for row in rows))
            for ax, quantity in zip(row_axes, quantities, strict=True):
                ax.axvspan(-1, 1, color=GREY, alpha=0.15, linewidth=0)
                ax.axvline(0, color=GREY, linewidth=0.6)
                for row in rows:
                    if row["quantity"] != quantity:
                        continue
                    y, m = -changes.index(row["change"]), row["margin"]
                    mark, colour = marks[row["verdict"]]
                    ax.plot([row["narrow_low"] / m, row["narrow_high"] / m], [y, y], color=colour, linewidth=1.4)
                    ax.plot([row["difference"] / m], [y], mark, color=colour, markersize=4)
                    redraw = row["redraw"]
                    if redraw is not None:
                        ax.plot([-redraw / m, redraw / m], [y, y], "|", color="black", markersize=5)
                reach = max([1.3, *(_reach(row) for row in rows if row["quantity"] == quantity)])
                ax.set_xlim(-min(reach, 6), min(reach, 6))
                ax.set_title(quantity.replace("_", "\n"), fontsize=8)
                ax.tick_params(axis="y", length=0)
            row_axes[0].set_yticks([-k for k in range(len(changes))], [_short(change) for change in changes])
            row_axes[0].set_ylabel(_wrapped(label), fontsize=8)
        for ax in axes[-1]:
            ax.set_xlabel("difference\n/ margin")
        handles: list[Any] = [
            Line2D([], [], marker=mark, color=colour, markersize=4, label=verdict)
            for verdict, (mark, colour) in marks.items()
        ]
        handles.append(Line2D([], [], marker="|", linestyle="", color="black", label="a redraw of the matrix"))
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return Picture(
        figure,
        "Differences between changed runs and their bases in units of the declared margin (band), with the "
        "interval of "
        "the equivalence test (not adjusted for the number of tests). Ticks: how far two different matrices "
        "typically "
        "lie apart.",
        "Forest plot: one row for each change, one column for each quantity.",
    )


def _reach(row: Row) -> float:
    ends = [abs(row["narrow_low"]), abs(row["narrow_high"]), row["redraw"] or 0.0]
    return 1.08 * float(max(ends)) / float(row["margin"])


def _short(change: str) -> str:
    return change.replace("constants changed by ", "constants ").replace("start displaced by ", "start ")


def _wrapped(label: str) -> str:
    return label.replace(", ", "\n", 1).replace(", ", ",\n")


def survival_curves(panels: Sequence[tuple[str, Curve, float]]) -> Picture:
    """Share of runs in self-sustained motion against time with intervals; runaways dashed, as their own curve.

    Parameters
    ----------
    panels : sequence of (label, curve, t_end)
    """
    with matplotlib.rc_context(STYLE):
        figure, axes = _figure(1, 1, 3.0)
        ax = axes[0, 0]
        for k, (label, curve, t_end) in enumerate(panels):
            colour, dash = CYCLE[k % 6], _DASHES[k // 6 % 4]
            t = np.append(curve.t, t_end)
            ax.step(t, _held(curve.survival), where="post", color=colour, linestyle=dash, label=label)
            ax.fill_between(
                t, _held(curve.low), _held(curve.high), step="post", color=colour, alpha=0.12, linewidth=0
            )
            away = curve.incidence["diverged"]
            if away[-1] > 0:
                ax.step(t, _held(away), where="post", color=colour, linestyle=":", label=f"{label}: run away")
        ax.set(xlabel="time t (dimensionless)", ylabel="share of runs in motion", ylim=(-0.02, 1.04), xlim=(0, None))
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return Picture(
        figure,
        "Share of runs in self-sustained motion, Kaplan and Meier's estimate with its interval; dotted, the share "
        "that "
        "has run away, where any has.",
        "Survival curves, one for each setting.",
    )


def _held(values: np.ndarray) -> np.ndarray:
    return np.append(values, values[-1])
