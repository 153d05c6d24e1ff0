"""Figures of a sweep: a statistic along a key, over two keys, and how runs end along a key."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from itertools import count

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.ticker import FixedLocator, MaxNLocator

from stickslip.analysis.answer import Picture
from stickslip.analysis.findings.finding import Verdict
from stickslip.analysis.findings.numbers import signs
from stickslip.analysis.findings.words import capital
from stickslip.analysis.grid import MOST_SETTINGS, Grid, Point, points_at
from stickslip.analysis.measures import IN_MOTION, KEYS, MOTION, Measure
from stickslip.analysis.models.fates import MOVING
from stickslip.analysis.questions.runs.fate_figures import FATES, shares
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.steps import Step
from stickslip.analysis.style import EXACT, GREY, panel
from stickslip.pipeline.design.design import Axis, in_words
from stickslip.pipeline.design.labels import Label

MOST_LINES = 6  # in one figure
MOST_FIGURES = 8  # of statistics along a key
MOST_DECADES = 4.0  # of an axis: what lies further below the largest value is below the axis
DECADES = 30.0  # largest over least value from which an axis is logarithmic
_FEW_TICKS = 4  # so few values of a key are its ticks
_LETTERS, _LINES = 36, 20  # of the ticks of a map, side by side and above each other
Line = tuple[str, Sequence[Estimate]]


def figures(grid: Grid, order: Sequence[str], steps: Sequence[Step]) -> dict[str, Picture]:
    """Each measure along the key of the step that leads, in an order, and a map of the first over two keys.

    Over several keys some settings have figures of their own: the one that leads, then those of the exact law.
    """
    lead, *others = grid.settings
    leading = [step for step in steps if (step.statistic, step.setting) == (order[0], lead)] or steps
    axes = sorted(grid.axes, key=lambda axis: axis.keys != leading[0].key_names)
    if len(axes) > 1 and len(axes[1].rows) > max(MOST_LINES, len(axes[0].rows)):
        axes[:2] = axes[1::-1]  # a line for each of the few values, not of the many
    settings = [lead]
    if len(axes) > 1:
        others.sort(key=lambda setting: not grid.points[setting][0].group.is_exact)
        settings = [lead, *others][:MOST_SETTINGS]
    pictures: dict[str, Picture] = {}
    for setting, number in zip(settings, count(1), strict=False):
        of_setting = _of_setting(grid, setting, axes, order, [step for step in steps if step.setting == setting])
        suffix = f"-{number}" if number > 1 else ""  # no measure has a hyphen
        pictures |= {f"{name}{suffix}": picture for name, picture in of_setting.items()}
    return pictures


def _of_setting(
    grid: Grid, setting: Label, axes: Sequence[Axis], order: Sequence[str], steps: Sequence[Step]
) -> dict[str, Picture]:
    """The figures of a setting, or of all along the only key."""
    axis, points = axes[0], grid.points[setting]
    at = f" at {setting}" if len(axes) > 1 and grid.where(setting) else ""
    by_name = {measure.name: measure for measure in grid.asked}
    may_be_log = any(measure.is_recorded for measure in grid.asked)
    pictures: dict[str, Picture] = {}
    for name in order[:MOST_FIGURES]:
        if name == IN_MOTION:
            at_value = [points_at(points, axis, value) for value in axis.rows]
            counts = {end: [sum(point.fates[end] for point in some) for some in at_value] for end in FATES}
            if any(any(numbers) for end, numbers in counts.items() if end not in MOVING):
                caption = f"How runs end, along {axis.name}{at}: shares of all runs."
                pictures["sweep_fates"] = Picture(partial(shares, axis.name, axis.texts, counts), caption)
            continue
        lines = _lines(grid, setting, axes, by_name[name])
        if sum(estimate.value is not None for _, line in lines for estimate in line) > 1:
            title, key = by_name[name].statistic.quantity.name, by_name[name].key
            recipe = partial(curves, title, axis.name, axis.x, axis.texts, lines, may_be_log)
            trend = _trend([step for step in steps if (step.statistic, step.key_names) == (name, axis.keys)])
            caption = f"{capital(title)} {trend} {axis.name}{at}. Bars are {100 * grid.confidence:g}% intervals."
            pictures[f"sweep_{key}" if name in KEYS else f"sweep_of_{key}"] = Picture(recipe, caption)
    first = MOTION if order[0] == IN_MOTION else by_name[order[0]]
    if len(axes) > 1:
        up, throughout, title = axes[1], _throughout(first.name, points, axes), first.statistic.quantity.name
        cells = [[one.value for one in grid.along(first, points_at(throughout, up, row), axis)] for row in up.rows]
        if any(value is not None for row in cells for value in row):
            recipe = partial(heat_map, title, (axis.name, axis.texts), (up.name, up.texts), cells, may_be_log)
            pictures["sweep_map"] = Picture(recipe, f"{capital(title)} over {axis.name} and {up.name}{at}.")
    return pictures


def _trend(steps: Sequence[Step]) -> str:
    """What a figure of a statistic along a key shows: a verb and a preposition."""
    verdicts = {step.contrast.verdict for step in steps} & {Verdict.MORE, Verdict.LESS}
    if len(verdicts) != 1:
        return "against"
    return "rises with" if verdicts == {Verdict.MORE} else "falls with"


def _throughout(name: str, points: Sequence[Point], axes: Sequence[Axis]) -> list[Point]:
    """Points at those values of the axes from the third on at which most points have a measure.

    Averages over some values here and others there would differ by what these are like.
    """
    rest = [tuple(point.place[axis] for axis in axes[2:]) for point in points]
    n_known = Counter(place for place, point in zip(rest, points, strict=True) if len(point.sums(name)))
    most = max(n_known.values(), default=0)
    return [point for place, point in zip(rest, points, strict=True) if n_known[place] == most]


def _lines(grid: Grid, setting: Label, axes: Sequence[Axis], measure: Measure) -> list[Line]:
    """Lines along the first axis, one for each value of the second, or for each setting."""
    parts: list[tuple[str, list[Point]]] = [(name, grid.points[name]) for name in grid.settings[:MOST_LINES]]
    if len(axes) > 1:
        along, points = axes[1], _throughout(measure.name, grid.points[setting], axes)
        n_lines = min(len(along.rows), MOST_LINES)
        rows = [along.rows[k] for k in np.linspace(0, len(along.rows) - 1, n_lines).round().astype(int)]
        parts = [(f"{along.name} = {in_words(row)}", points_at(points, along, row)) for row in rows]
    return [(name, grid.along(measure, points, axes[0])) for name, points in parts]


@panel()
def curves(
    ax: Axes,
    what: str,
    key: str,
    x: Sequence[float] | None,
    ticks: Sequence[str],
    lines: Sequence[Line],
    may_be_log: bool = False,
) -> None:
    """A statistic against a key, with intervals, one line for each value of another key.

    `x` is None if the key's values are not numbers, and they are then evenly spaced. An axis whose values span
    decades is logarithmic, if it may be; below it a statistic is an open triangle at its end.
    """
    places = np.arange(len(ticks), dtype=float) if x is None else np.array(x)
    is_log = may_be_log and x is not None and _spans_decades(places)
    ends = np.array([[(e.value, e.low, e.high) for e in line] for _, line in lines], dtype=float)  # NaN: none
    known = ends[..., 0][np.isfinite(ends[..., 0])]
    is_decades = may_be_log and _spans_decades(known)
    floor = known.max() / 10.0**MOST_DECADES if is_decades else -np.inf
    colours = [EXACT] if len(lines) == 1 else matplotlib.colormaps["viridis"](np.linspace(0, 0.85, len(lines)))
    for k, ((name, _), (value, low, high)) in enumerate(zip(lines, ends.transpose(0, 2, 1), strict=True)):
        has = np.isfinite(value)
        bars = np.abs([low - value, high - value])[:, has]
        mark, colour = f"{'os^Dv<'[k % 6]}-", colours[k]
        ax.errorbar(places[has], value[has], bars, fmt=mark, markersize=3.5, color=colour, label=signs(name))
        below = has & (value < floor)
        ax.plot(places[below], np.full(below.sum(), floor), "v", color=colour, markerfacecolor="white")
    if x is None:
        ax.set_xticks(places, [*map(signs, ticks)])
    elif not is_log:
        ax.xaxis.set_major_locator(FixedLocator(places.tolist()) if len(places) <= _FEW_TICKS else MaxNLocator(6))
    margin = 0.05 * np.ptp(places)
    ax.set(xlim=(places.min() - margin, places.max() + margin), xlabel=key, ylabel=what)
    if is_log:
        ax.set(xscale="log", xlim=(places.min() / 1.2, 1.2 * places.max()))
    if is_decades:  # an interval that reaches zero goes down to the axis
        ax.set_yscale("log", nonpositive="clip")
        ax.set_ylim(max(known.min(), floor) / 2, 2 * known.max())
    if len(lines) > 1:
        ax.figure.legend(loc="outside upper center", ncols=min(len(lines), 3), handlelength=1.2)


def _spans_decades(values: np.ndarray) -> bool:
    """Whether values are positive and some `DECADES` apart."""
    return bool(values.min() > 0 and values.max() >= DECADES * values.min())


@panel()
def heat_map(
    ax: Axes,
    what: str,
    across: tuple[str, Sequence[str]],
    up: tuple[str, Sequence[str]],
    cells: Sequence[Sequence[float | None]],
    may_be_log: bool = False,
) -> None:
    """A statistic at each point of a grid of two keys, one row for each value of `up`; grey where it has no value."""
    shown = np.ma.masked_invalid(np.array(cells, dtype=float))
    known = shown.compressed()
    is_log = may_be_log and len(known) > 0 and _spans_decades(known)
    least = max(known.min(), known.max() / 10.0**MOST_DECADES) if is_log else None
    norm = LogNorm(least, known.max(), clip=True) if is_log else None
    ax.set_facecolor("#d8d8d8")
    image = ax.imshow(shown, cmap="viridis", aspect="auto", origin="lower", norm=norm)
    steps = 1 + sum(len(text) + 2 for text in across[1]) // _LETTERS, 1 + len(up[1]) // _LINES
    for axis, (name, ticks), step in zip((ax.xaxis, ax.yaxis), (across, up), steps, strict=True):
        axis.set_label_text(name)
        axis.set_ticks(range(0, len(ticks), step), [*map(signs, ticks[::step])])
    ax.figure.colorbar(image, ax=ax, label=what).outline.set_edgecolor(GREY)
