"""Figures of a sweep: a measure along a key, and how runs end along it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from textwrap import fill

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, MaxNLocator

from stickslip.analysis.answer import Picture
from stickslip.analysis.findings.finding import Verdict
from stickslip.analysis.findings.numbers import signs
from stickslip.analysis.findings.words import MOST_TURNS, capital, extrema, listed
from stickslip.analysis.grid import Sweep, is_negative, points_at
from stickslip.analysis.measures import KEYS, STICKING, Measure
from stickslip.analysis.stats.estimates import Estimate, with_ends
from stickslip.analysis.steps import Step
from stickslip.analysis.style import EXACT, panel
from stickslip.pipeline.design.design import Axis, in_words
from stickslip.pipeline.design.units import Units

MOST_LINES = 6  # in one figure
MOST_FIGURES = 8  # of statistics along a key
MOST_DECADES = 4.0  # of an axis: what lies further below the largest value is below the axis
DECADES = 30.0  # largest over least value from which an axis is logarithmic
_LETTERS = 32  # of a line along an axis, and of a legend's name of which two fit beside each other
_FEW_TICKS = 4  # so few values of a key are its ticks
Line = tuple[str, Sequence[Estimate]]


def figures(grid: Sweep, order: Sequence[str], steps: Sequence[Step], units: Units) -> dict[str, Picture]:
    """Each measure along the key of the step that leads, in an order; over more keys, of the setting that leads."""
    lead = grid.settings[0]
    leading = [step for step in steps if (step.statistic, step.setting) == (order[0], lead)] or steps
    axes = sorted(grid.axes, key=lambda axis: axis.keys != leading[0].key_names)
    if len(axes) > 1 and len(axes[1].rows) > max(MOST_LINES, len(axes[0].rows)):
        axes[:2] = axes[1::-1]  # a line for each of the few values, not of the many
    axis = axes[0]
    tail = grid.where[lead].tail if len(axes) > 1 else ""
    x, is_of_size = axis.x, len(axis.keys) == 1 and is_negative(*(row[0] for row in axis.rows))
    if x is not None and is_of_size:
        x = [-value for value in x]
    key = f"|{axis.name}|" if is_of_size else axis.name
    by_name = {measure.name: measure for measure in grid.asked}
    pictures: dict[str, Picture] = {}
    for name in [name for name in order if name != STICKING][:MOST_FIGURES]:
        lines = _lines(grid, axes, by_name[name])
        if any(sum(estimate.value is not None for estimate in line) > 1 for _, line in lines):
            title, file = by_name[name].statistic.quantity.name, by_name[name].key
            shown_settings = grid.settings[:1] if len(axes) > 1 else grid.settings[:MOST_LINES]
            along = [step for step in steps if (step.statistic, step.key_names) == (name, axis.keys)]
            trend = _trend(grid, [step for step in along if step.setting in shown_settings], key, is_of_size)
            caption = f"{capital(title)} {trend}{tail}. Bars are {100 * grid.confidence:g}% intervals."
            what = units.label(title, by_name[name].statistic.dimension)
            recipe = partial(curves, what, units.label_of_key(axis.name, key), x, axis.texts, lines)
            pictures[f"sweep_{file}" if name in KEYS else f"sweep_of_{file}"] = Picture(recipe, caption)
    return pictures


def _trend(grid: Sweep, steps: Sequence[Step], key: str, is_of_size: bool) -> str:
    """What a figure of a statistic along a key shows; of negative values, with their size."""
    told_apart = [step for step in steps if step.contrast.is_shown]
    verdicts = {step.contrast.verdict for step in told_apart}
    if not any(step.contrast.p_different is not None for step in steps):
        return f"against {key}"
    if not verdicts:
        return f"shows no significant change with {key}"
    turning = [step for step in steps if step.turns]
    if turning and len({step.setting for step in steps}) == 1 and len(turning[-1].turns) <= MOST_TURNS:
        return f"has {extrema(turning[-1].turns)}"
    if len(verdicts) > 1 or turning:
        return f"changes in both directions along {key}"
    settings, changing = ({step.setting for step in steps_here} for steps_here in (steps, told_apart))
    names = [place.phrase for label, place in grid.where.items() if str(label) in changing]
    only = f" (significant {listed(names)})" if len(names) < len(settings) else ""
    side = f"as {key} decreases" if is_of_size else f"with {key}"
    return f"{'rises' if verdicts == {Verdict.MORE} else 'falls'} {side}{only}"


def _lines(grid: Sweep, axes: Sequence[Axis], measure: Measure) -> list[Line]:
    """Lines along the first axis, one for each value of the second, or for each setting.

    Of more axes, at those of their values at which most points have the measure: averages over some values here and
    others there would differ by what these are like.
    """
    curves = [(str(grid.where[name] or name), grid.points[name]) for name in grid.settings[:MOST_LINES]]
    if len(axes) > 1:
        up, points = axes[1], grid.points[grid.settings[0]]
        places = [tuple(point.place[axis] for axis in axes[2:]) for point in points]
        n_known = Counter(place for place, point in zip(places, points, strict=True) if len(point.sums(measure.name)))
        n_most = max(n_known.values(), default=0)
        points = [point for place, point in zip(places, points, strict=True) if n_known[place] == n_most]
        n_lines = min(len(up.rows), MOST_LINES)
        rows = [up.rows[k] for k in np.linspace(0, len(up.rows) - 1, n_lines).round().astype(int)]
        curves = [(f"{up.name} = {in_words(row)}", points_at(points, up, row)) for row in rows]
    return [(name, grid.along(measure, points, axes[0])) for name, points in curves]


@panel()
def curves(
    ax: Axes,
    what: str,
    key: str,
    x: Sequence[float] | None,
    ticks: Sequence[str],
    lines: Sequence[Line],
) -> None:
    """A statistic against a key, with intervals, one line for each value of another key.

    `x` is None if the key's values are not numbers, and they are then evenly spaced. An axis whose values span
    decades is logarithmic; a statistic below it is an open triangle at its end.
    """
    places = np.arange(len(ticks), dtype=float) if x is None else np.array(x)
    is_log = x is not None and _spans_decades(places)
    ends = np.array([with_ends(line) for _, line in lines])
    values = ends[:, 0][np.isfinite(ends[:, 0])]
    is_decades = _spans_decades(values)
    floor = values.max() / 10.0**MOST_DECADES if is_decades else -np.inf
    colours = [EXACT] if len(lines) == 1 else matplotlib.colormaps["viridis"](np.linspace(0, 0.85, len(lines)))
    for k, ((name, _), (value, low, high)) in enumerate(zip(lines, ends, strict=True)):
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
    ax.set(xlim=(places.min() - margin, places.max() + margin), xlabel=key, ylabel=fill(what, _LETTERS))
    if is_log:
        ax.set(xscale="log", xlim=(places.min() / 1.2, 1.2 * places.max()))
    if is_decades:  # an interval that reaches zero goes down to the axis
        ax.set_yscale("log", nonpositive="clip")
        ax.set_ylim(max(values.min(), floor) / 2, 2 * values.max())
    if len(lines) > 1:
        longest = max(len(name) for name, _ in lines)
        columns = min(len(lines), 3 if longest < _LETTERS // 2 else 2 if longest < _LETTERS else 1)
        ax.figure.legend(loc="outside upper center", ncols=columns, handlelength=1.2)


def _spans_decades(values: np.ndarray) -> bool:
    """Whether values are positive and some `DECADES` apart."""
    return bool(values.min() > 0 and values.max() >= DECADES * values.min())
