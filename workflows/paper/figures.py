"""The paper's figures, drawn from plain numbers in the style of `report.figures`. All axes are dimensionless."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from stickslip.analysis.report.figures import BLUE, CYCLE, GREEN, GREY, ORANGE, PURPLE, STYLE, blank, subplots
from stickslip.analysis.report.words import PAPER_GAMMA

#: Line styles beside the colours, so that grey print tells curves apart.
_DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))


# ---------------------------------------------------------------------------------------------- figure 1


class Portrait(NamedTuple):
    """One block's phase plane: title, v, ends of the stick interval, exit point, paths of (z, w, is the exit's)."""

    title: str
    v: float
    stick: tuple[float, float]
    exit: float
    paths: Sequence[tuple[Sequence[float], Sequence[float], bool]]


def phase_portraits(portraits: Sequence[Portrait]) -> Figure:
    """Figure 1: z against z' for each v; the stick interval thick, the exit point E marked, its path bold."""
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, len(portraits), 3.4, sharey=True)
        for ax, one in zip(axes[0], portraits, strict=True):
            ax.axhline(one.v, color=GREY, linestyle="--", linewidth=0.9)
            for z, w, is_exit in one.paths:
                ax.plot(z, w, color=ORANGE if is_exit else BLUE, linewidth=2.4 if is_exit else 0.9,
                        zorder=3 if is_exit else 2)  # fmt: skip
                _arrow(ax, z, w, ORANGE if is_exit else BLUE)
            ax.plot(one.stick, [one.v, one.v], color="black", linewidth=3.0, solid_capstyle="butt", zorder=4)
            ax.plot([one.exit], [one.v], "o", color=ORANGE, markeredgecolor="black", markersize=6, zorder=5)
            ax.annotate("E", (one.exit, one.v), xytext=(0, 8 if one.v > 0 else -14), textcoords="offset points",
                        ha="center", fontweight="bold")  # fmt: skip
            ax.set(title=one.title, xlabel="displacement z")
        axes[0, 0].set_ylabel("velocity z'")
        handles = [
            axes[0, 0].plot([], [], color=colour, linewidth=width, linestyle=dash, label=label)[0]
            for colour, width, dash, label in (
                ("black", 3.0, "-", "sticks, z' = v"),
                (GREY, 0.9, "--", "z' = v, crossed"),
                (BLUE, 0.9, "-", "paths"),
                (ORANGE, 2.4, "-", "path from the exit point E"),
            )
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def _arrow(ax: Axes, x: Sequence[float], y: Sequence[float], colour: str) -> None:
    """The direction of a path, a tenth of its points from the start."""
    k = max(1, len(x) // 10)
    if k + 1 < len(x):
        ax.annotate("", (x[k + 1], y[k + 1]), (x[k], y[k]), arrowprops={"arrowstyle": "-|>", "color": colour})


# ---------------------------------------------------------------------------------------------- figure 2


class Path(NamedTuple):
    """A run of two blocks: its case, times, z and w of each block, events (t, block, mode)."""

    case: str
    t: Sequence[float]
    z: Sequence[Sequence[float]]
    w: Sequence[Sequence[float]]
    events: Sequence[tuple[float, int, int]]


class Parallelogram(NamedTuple):
    """Where two blocks stick: title, v, corners in order (label, z_1, z_2, kind), paths."""

    title: str
    v: float
    corners: Sequence[tuple[str, float, float, str]]
    paths: Sequence[Path]


#: In the plane of displacements paths are drawn for so long: how they leave, not where they end.
_LEAVING = 1.5
_KINDS = {"double exit": ("o", ORANGE), "mixed": ("D", "white"), "double entry": ("s", BLUE)}


def parallelograms(signs: Sequence[Parallelogram]) -> Figure:
    """Figure 2: (z_1, z_2) with folds, corners and the three cases, a column a sign; below, z' - v of the first sign.

    Solid edges are visible folds (exits), dashed ones invisible (entries).
    """
    first = signs[0]
    with matplotlib.rc_context(STYLE):
        figure = blank(6.0)
        grid = figure.add_gridspec(2, 6, height_ratios=[1.7, 1.0])
        for k, one in enumerate(signs):
            ax = figure.add_subplot(grid[0, 3 * k : 3 * k + 3])
            _region(ax, one)
            if k == 0:
                ax.set_ylabel("displacement z₂")
        below: list[Axes] = []
        for k, path in enumerate(first.paths):
            ax = figure.add_subplot(grid[1, 2 * k : 2 * k + 2], sharey=below[0] if below else None)
            below.append(ax)
            for block, w in enumerate(path.w):
                ax.plot(path.t, np.asarray(w) - first.v, color=CYCLE[block], linestyle=_DASHES[block],
                        linewidth=1.6, label=f"block {block + 1}")  # fmt: skip
            for t, block, mode in path.events:
                ax.axvline(t, color=CYCLE[block], linestyle=":" if mode else "-", linewidth=0.8)
            ax.set(title=f"({path.case}) {first.title.split(',')[0]}", xlabel="time t")
        below[0].set_ylabel("relative velocity z' − v")
        below[0].legend()
        drawn: dict[str, Any] = {}
        for ax in figure.axes[: len(signs)]:
            drawn |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
        figure.legend(drawn.values(), drawn, loc="outside lower center", ncols=4)
    return figure


def _region(ax: Axes, one: Parallelogram) -> None:
    z = np.array([corner[1:3] for corner in one.corners])
    span = np.ptp(z, axis=0)
    ax.fill(*z.T, color=GREY, alpha=0.15, linewidth=0)
    for k, (label, *_) in enumerate(one.corners):
        after = (k + 1) % len(one.corners)
        # of two neighbours one lambda is the same: that block's fold is the edge between them
        block = 0 if label[0] == one.corners[after][0][0] else 1
        leaves = (label[block] == "+") == (one.v < 0)
        ax.plot(*z[[k, after]].T, color="black", linewidth=1.4, linestyle="-" if leaves else "--",
                label="visible fold" if leaves else "invisible fold")  # fmt: skip
        along = (z[after] - z[k]) / span
        outward = np.array([along[1], -along[0]]) / np.hypot(*along)  # corners run counter-clockwise
        x, y = z[[k, after]].mean(axis=0) + 0.06 * outward * span
        slope = np.degrees(np.arctan2(z[after, 1] - z[k, 1], z[after, 0] - z[k, 0]))
        ax.text(x, y, f"fold of {block + 1}", fontsize=7, ha="center", va="center", rotation_mode="anchor",
                rotation=(slope + 90) % 180 - 90, transform_rotates_text=True)  # fmt: skip
    for label, x, y, kind in one.corners:
        marker, colour = _KINDS[kind]
        ax.plot([x], [y], marker, color=colour, markeredgecolor="black", markersize=7, linestyle="none", zorder=5,
                label=kind)  # fmt: skip
        right = x > z[:, 0].mean()
        ax.annotate(f"{{{label[0]},{label[1]}}}".replace("-", "−"), (x, y), xytext=(9 if right else -9, 5),
                    textcoords="offset points", ha="left" if right else "right", va="bottom", fontsize=8)  # fmt: skip
    for k, path in enumerate(one.paths):
        colour = (BLUE, ORANGE, PURPLE)[k % 3]
        shown = int(np.searchsorted(path.t, _LEAVING, side="right"))
        ax.plot(path.z[0][:shown], path.z[1][:shown], color=colour, linewidth=1.8, zorder=4,
                linestyle=_DASHES[k], label=f"path ({path.case})")  # fmt: skip
        ax.plot(path.z[0][0], path.z[1][0], ".", color=colour, zorder=6)
    low, high = z.min(axis=0), z.max(axis=0)
    margin = 0.3 * (high - low)
    ax.set(title=one.title, xlabel="displacement z₁", xlim=(low[0] - margin[0], high[0] + margin[0]),
           ylim=(low[1] - margin[1], high[1] + margin[1]))  # fmt: skip
    start = low - margin + np.array([0.66, 0.96]) * (span + 2 * margin)
    ax.annotate("", start + 0.2 * float(span.min()) * np.sign(one.v), start,
                arrowprops={"arrowstyle": "-|>", "color": GREY})  # fmt: skip
    ax.annotate("drift (v, v)", start, xytext=(4, 0), textcoords="offset points", fontsize=7, color=GREY, va="center")


# ---------------------------------------------------------------------------------------------- figures 3 to 5


#: A curve of n_stick: label, change points t, n_stick on [t[k], t[k+1]), and where the last value ends.
Curve = tuple[str, Sequence[float], Sequence[int], float]


def n_stick_panels(panels: Sequence[tuple[str, Sequence[Curve]]], columns: int = 1) -> Figure:
    """Figures 3 and 4: n_stick(t), one panel each with a legend of its curves; the first curve thick and grey if more
    than two are drawn, as what the others are held against.
    """
    rows = -(-len(panels) // columns)
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(rows, columns, 0.4 + 1.9 * rows)
        for ax in axes.flat[len(panels) :]:
            ax.set_axis_off()
        for ax, (title, curves) in zip(axes.flat, panels, strict=False):
            _curves(ax, curves)
            ax.set(title=title, xlabel="time t")
            ax.set_ylabel("$n_{stick}$")
            ax.legend(loc="upper right", ncols=2 if len(curves) > 3 else 1, fontsize=7, handlelength=1.6)
    return figure


def _curves(ax: Axes, curves: Sequence[Curve]) -> None:
    with_base = len(curves) > 2
    for k, (label, t, n_stick, stop) in enumerate(curves):
        is_base = with_base and k == 0
        # thousands of steps: a picture inside the SVG keeps the report small
        ax.step(
            np.append(t, stop), np.append(n_stick, n_stick[-1]), where="post", label=label, rasterized=True,
            color=GREY if is_base else CYCLE[(k - with_base) % len(CYCLE)], linewidth=2.0 if is_base else 0.8,
            alpha=0.55 if is_base else 1.0,
        )  # fmt: skip
    ax.set_xlim(0, max(stop for *_, stop in curves))
    high = max(max(n_stick) for _, _, n_stick, _ in curves)
    ax.set_ylim(0, max(1.0, 1.35 * high))
    ax.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=5))


def long_runs(
    runs: Sequence[tuple[str, Curve]], laws: Sequence[tuple[str, Sequence[tuple[str, Sequence[int]]], float | None]]
) -> Figure:
    """Figure 5: (i) n_stick over long times; (ii) cascades of each size on a log axis, a panel a definition.

    Parameters
    ----------
    runs : sequence of (title, curve)
    laws : sequence of (title, series, gamma)
        Each series is (label, number of cascades of size 1, 2, ...); lines of slope -gamma, the fitted one, and of
        the paper's are drawn through the mean of the sizes 1. None: no fit, no line.
    """
    with matplotlib.rc_context(STYLE):
        figure = blank(1.0 + 1.05 * len(runs) + 2.6)
        grid = figure.add_gridspec(len(runs) + 1, len(laws), height_ratios=[1.0] * len(runs) + [2.3])
        above: list[Axes] = []
        for k, (title, curve) in enumerate(runs):
            ax = figure.add_subplot(grid[k, :], sharex=above[0] if above else None)
            above.append(ax)
            _curves(ax, [curve])
            ax.set(title=title, ylabel="$n_{stick}$")
        if above:
            above[-1].set_xlabel("time t")
        for k, (title, series, gamma) in enumerate(laws):
            ax = figure.add_subplot(grid[-1, k])
            ax.set(title=title, yscale="log", xlabel="size of cascade Δ$n_{stick}$")
            for j, (label, counts) in enumerate(series):
                seen = [(size, count) for size, count in enumerate(counts, 1) if count]
                ax.plot(*zip(*seen, strict=True), "os^v"[j % 4], color=CYCLE[j], markersize=3.5, label=label)
            level = np.mean([counts[0] for _, counts in series])
            top = max(len(counts) for _, counts in series)
            sizes = np.array([1.0, top])
            lines = [(PAPER_GAMMA, GREY, "--", f"paper, γ = {PAPER_GAMMA}")]
            if gamma is not None:
                lines.insert(0, (gamma, "black", "-", f"fit, γ = {gamma:.2f}"))
            for rate, colour, dash, label in lines:
                ax.plot(sizes, level * np.exp(-rate * (sizes - 1)), color=colour, linestyle=dash, label=label)
            ax.set_ylim(0.6, 2.0 * max(max(counts) for _, counts in series))
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
            ax.legend(fontsize=7)
            if k == 0:
                ax.set_ylabel("number of cascades f")
    return figure


# ---------------------------------------------------------------------------------------------- figure 6, claims


def blow_ups(
    panels: Sequence[tuple[str, Sequence[float], np.ndarray, Sequence[tuple[float, float, bool]]]],
) -> Figure:
    """Figure 6: the fast flow in the box of (lambda_1, lambda_2), stable modes filled, others open.

    Parameters
    ----------
    panels : sequence of (title, axis, rate, modes)
        `rate`, shape (2, m, m): lambda_1' and lambda_2' at rate[:, j, i] for lambda = (axis[i], axis[j]).
    """
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, len(panels), 3.7, sharey=True)
        for ax, (title, axis, rate, modes) in zip(axes[0], panels, strict=True):
            ax.streamplot(
                np.asarray(axis), np.asarray(axis), *rate, color=BLUE, density=0.7, linewidth=0.8,
                broken_streamlines=False,
            )  # fmt: skip
            for x, y, is_stable in modes:
                ax.plot([x], [y], "o", color=ORANGE if is_stable else "white", markeredgecolor="black",
                        markersize=8, zorder=5)  # fmt: skip
            ax.set(title=title, xlabel="λ₁", xlim=(-1, 1), ylim=(-1, 1), aspect="equal")
            ax.set_xticks(ticks := [-1.0, -0.5, 0.0, 0.5, 1.0])
            ax.set_yticks(ticks)
            ax.spines[["top", "right"]].set_visible(True)
        axes[0, 0].set_ylabel("λ₂")
        handles = [
            axes[0, 0].plot([], [], "o", color=colour, markeredgecolor="black", markersize=8, label=label)[0]
            for colour, label in ((ORANGE, "sticking mode, stable"), ("white", "sticking mode, saddle"))
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def slow_modes(
    points: Sequence[tuple[float, float, float, bool]],
    runs: Sequence[tuple[str, Sequence[float], Sequence[Sequence[float]]]],
) -> Figure:
    """lambda_2 of the sticking modes in slow time: about the saddle-node, and up to the exit.

    Parameters
    ----------
    points : sequence of (t, lambda_1, lambda_2, is stable)
        All modes at all times.
    runs : sequence of (label, t, (lambda_1, lambda_2))
    """
    t_end = max(t[-1] for _, t, _ in runs)
    lost = max((t for t, *_, is_stable in points if not is_stable), default=0.0)
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, 2, 3.0, sharey=True)
        kinds = ((True, "o", 3.5, "mode, stable"), (False, "x", 3.0, "mode, saddle"))
        panels = (("(c) at first", 2.0 * lost or t_end), ("(d) to the exit", 1.05 * t_end))
        for ax, (title, end) in zip(axes[0], panels, strict=True):
            for is_wanted, marker, size, label in kinds:
                seen = [(t, y) for t, _, y, is_stable in points if is_stable == is_wanted and t <= end]
                ax.plot(*np.array(seen).reshape(-1, 2).T, marker, color=GREY, markersize=size, alpha=0.4, label=label)
            for k, (label, t, lam) in enumerate(runs):
                ax.plot(t, lam[1], color=CYCLE[k], linestyle=_DASHES[k], linewidth=2.2, label=label)
            ax.axhline(1.0, color="black", linewidth=0.8)
            ax.set(title=title, xlabel="time t", xlim=(-0.03 * end, end))
        axes[0, 0].set_ylabel("λ₂")
        axes[0, 1].annotate("face λ₂ = 1: exit", (0.0, 1.0), xytext=(4, -10), textcoords="offset points", fontsize=7)
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def futures(
    law: tuple[Sequence[float], Sequence[float], float, Sequence[tuple[float, bool]]],
    v: float,
    paths: Sequence[tuple[str, Sequence[float], Sequence[float]]],
) -> Figure:
    """A friction law that is not monotone: where it balances a force, and the runs that begin in one state.

    Parameters
    ----------
    law : (lambda, s, target, modes)
        s on an axis of lambda, the value that holds the block, and (lambda, is stable) where s has that value.
    v : float
    paths : sequence of (label, t, z')
    """
    axis, resistance, target, modes = law
    with matplotlib.rc_context(STYLE):
        figure = blank(2.9)
        left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.7])
        left.plot(axis, resistance, color=BLUE, label="s(λ)")
        left.axhline(target, color=GREY, linestyle="--", linewidth=0.9, label="−F/μ")
        for lam, is_stable in modes:
            left.plot([lam], [target], "o", color=ORANGE if is_stable else "white", markeredgecolor="black",
                      markersize=7, zorder=5)  # fmt: skip
        left.set(title="(e) static above kinetic", xlabel="λ", ylabel="friction / μ, s(λ)", xlim=(-1, 1))
        left.legend(loc="lower right")
        for k, (label, t, w) in enumerate(paths):
            right.plot(t, np.asarray(w) - v, color=CYCLE[k], linestyle=_DASHES[k], linewidth=1.6, label=label)
        right.set(title="(f) runs from one state", xlabel="time t", ylabel="relative velocity z' − v")
        right.set_ylim(top=1.35 * right.get_ylim()[1])
        right.legend(loc="upper right", ncols=2)
    return figure


class Share(NamedTuple):
    """Share of the draws at one n, with its interval."""

    n: int
    value: float
    low: float
    high: float


def survival(moving: Sequence[Share], stable: Sequence[Share], diverged: Sequence[Share], t_end: float) -> Figure:
    """Share of draws still moving at t_end, of those whose all-slip state is stable, and of those diverged."""
    curves = (
        (moving, BLUE, "o", "-", f"still moving at t = {t_end:g}"),
        (stable, GREEN, "s", "--", "all-slip state linearly stable"),
        (diverged, ORANGE, "^", ":", "diverged"),
    )
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, 1, 2.9)
        ax = axes[0, 0]
        for k, (shares, colour, marker, dash, label) in enumerate(curves):
            value = np.array([share.value for share in shares])
            bars = [value - [share.low for share in shares], [share.high for share in shares] - value]
            n = np.array([share.n for share in shares]) + 2.0 * (k - 1)  # side by side, so that bars can be seen
            ax.errorbar(n, value, yerr=np.maximum(bars, 0.0), color=colour, marker=marker, linestyle=dash,
                        markersize=4, elinewidth=0.9, capsize=2, label=label)  # fmt: skip
        ax.set(xlabel="number of blocks n", ylabel="share of draws", ylim=(-0.03, 1.03))
        figure.legend(loc="outside lower center", ncols=3)
    return figure
