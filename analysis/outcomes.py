"""Contrasts of several settings with one reference, grouped by how they come out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from stickslip.analysis.answer import Picture
from stickslip.analysis.by_key import by_key
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Outcomes, Scale, Verdict
from stickslip.analysis.findings.numbers import signs
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.stats.estimates import with_ends
from stickslip.analysis.steps import Kind, Step, Variant
from stickslip.analysis.style import GREY, HUES, hues, panel

EQUAL, DIFFERENT, UNDECIDED = "equal", "different", "undecided"
_LETTERS = 24  # of a line of a name
MOST_ROWS = 36  # in one figure


def outcomes(
    other: str, steps: Sequence[Step], unit: str, noun: str, scope: str = "", where: Place = EVERYWHERE
) -> list[Outcomes]:
    """How settings come out beside a reference: those that differ; and those that agree, with those undecided.

    A setting differs if one of its statistics is shown to; else it is equal if all that have a margin, which the
    scene declares, are within. Each finding has the largest difference of its settings, or of those undecided.
    Where all are undecided they are named by their noun: "any change".
    """
    settings = by_key(steps, lambda step: step.name)
    by_setting = {setting: outcome(of_setting) for setting, of_setting in settings.items()}
    findings = []
    for names in ((DIFFERENT,), (UNDECIDED, EQUAL)):
        alike = [[step for step in steps if by_setting[step.name] == name] for name in names]
        if any(alike):
            best = max(next(filter(None, alike)), key=_size)
            (at_largest,) = in_words({best.name: ""}, "")
            further = in_words(by_setting | {best.name: ""}, DIFFERENT) if DIFFERENT in names else ()
            level = replace(best, where=EVERYWHERE).level(other, unit)
            words = {name: in_words(by_setting, name) for name in names}
            if len(alike[0]) == len(steps) and len(words.get(UNDECIDED, ())) > 1:
                words[UNDECIDED] = (f"any {noun}",)
            findings.append(
                Outcomes(
                    other,
                    equal=words.get(EQUAL, ()),
                    different=words.get(DIFFERENT, ()),
                    undecided=words.get(UNDECIDED, ()),
                    largest=level,
                    at_largest=at_largest,
                    others=further,
                    scope=scope,
                    where=where,
                )
            )
    return findings


def outcome(steps: Sequence[Step]) -> str:
    """How some steps come out together."""
    if any(step.contrast.is_shown for step in steps):
        return DIFFERENT
    judged = {step.contrast.verdict for step in steps if step.contrast.has_margin or step.contrast.is_same}
    return EQUAL if judged and judged <= {Verdict.EQUAL, Verdict.SAME} else UNDECIDED


def _size(step: Step) -> tuple[bool, bool, bool, float]:
    """Sorts steps: those that are shown come last, then those with a margin, with an interval, and that are large."""
    contrast = step.contrast
    start, end = contrast.first.value, contrast.second.value
    size = 0.0
    if not contrast.is_same and start is not None and end is not None:
        is_absolute = contrast.statistic.is_share or not start
        size = abs(end - start) if is_absolute else abs(end / start - 1.0)
    has_interval = contrast.difference.estimate.low is not None
    return contrast.is_shown, contrast.has_margin, has_interval, size


def in_words(by_setting: Mapping[Variant, str], name: str) -> tuple[str, ...]:
    """The settings with an outcome; of settings that differ in one number, ranges of it."""
    words: list[str] = []
    for _, alike in groupby(by_setting, key=lambda setting: (setting.name, setting.symbol)):
        words += _ranges([(setting, by_setting[setting] == name) for setting in alike])
    return tuple(words)


def _ranges(settings: Sequence[tuple[Variant, bool]]) -> Iterator[str]:
    """Of settings with ascending values, the ranges of those that are wanted."""
    start = 0
    for is_wanted, run in groupby(settings, key=lambda pair: pair[1]):
        alike = [setting for setting, _ in run]
        low, high, end = alike[0], alike[-1], start + len(alike)
        if is_wanted and not low.symbol:
            yield from (setting.name for setting in alike)
        elif is_wanted:
            value = f"= {low.text}" if low.name else f"of {low.text}"
            if len(alike) > 1:
                value = f"{value} to {high.text}"
                if start == 0 and end < len(settings):
                    value = f"up to {high.text}"
                elif start > 0 and end == len(settings):
                    value = f"≥ {low.text}"
            yield f"{low.name} with {low.symbol} {value}" if low.name else f"{low.symbol} {value}"
        start = end


def forest(study: Study | None, steps: Sequence[Step], what: str, name: str = "contrasts") -> dict[str, Picture]:
    """Figures of relative differences and of shares with their intervals, by name; none of fewer than two."""
    known = [step for step in steps if step.contrast.difference.estimate.low is not None]
    relative = [step for step in known if step.contrast.difference.scale is Scale.RELATIVE]
    of_shares = [step for step in known if step not in relative and step.contrast.statistic.is_share]
    figures = {name: relative, f"{name}_of_shares": of_shares}
    return {key: _forest(study, rows, what) for key, rows in figures.items() if len(rows) > 1}


def _forest(study: Study | None, rows: Sequence[Step], what: str) -> Picture:
    top = rows[:MOST_ROWS]
    ends, widest = _axis(top)
    margins = " that may exceed declared margins (bands)" * any(step.contrast.has_margin for step in top)
    cut = " Arrowheads: beyond the axis." * bool((np.abs(ends) > widest).any())
    see = "Filled marks are" if any(step.contrast.is_shown for step in top) else "There are no"
    labels = {str(step.where): step.setting if step.kind is Kind.LAW else str(step.where) for step in top}
    caption = f"{see} significant {what}{margins}; bars are intervals.{cut}"
    return Picture(partial(differences, top, hues(study, [*labels.values()])), caption)


def _axis(steps: Sequence[Step]) -> tuple[np.ndarray, float]:
    """Differences with the ends of their intervals in per cent, shape (k, 3), and where the axis ends: beyond all."""
    ends = 100.0 * with_ends(step.contrast.difference.estimate for step in steps).T
    reach = np.abs(ends).max(axis=1)
    limit = max(1.5 * np.abs(ends[:, 0]).max(), 4.0 * float(np.median(reach)))
    return ends, 1.08 * min(reach.max(), limit) or 1.0


def differences(steps: Sequence[Step], colours: Sequence[str] = HUES) -> Figure:
    """Differences with their intervals: a line a statistic, a hue a setting, and declared margins as bands.

    Marks of significant differences are filled. An arrowhead marks an interval that goes on beyond the axis.
    """
    height = 1.2 + 0.14 * len(steps) + 0.16 * len({step.statistic for step in steps})
    return panel(height)(_differences)(steps, colours)


def _differences(ax: Axes, steps: Sequence[Step], colours: Sequence[str]) -> None:
    names = list(dict.fromkeys(step.contrast.statistic.quantity.name for step in steps))
    settings = list(dict.fromkeys(str(step.where) for step in steps))
    ends, widest = _axis(steps)
    ax.axvline(0, color=GREY, linewidth=0.8)
    for step, (value, low, high) in zip(steps, ends, strict=True):
        k, line = settings.index(str(step.where)), names.index(step.contrast.statistic.quantity.name)
        y, colour = line + 0.7 * ((k + 0.5) / len(settings) - 0.5), colours[k]
        if (margin := step.contrast.difference.margin) is not None:
            ax.barh(line, 200.0 * margin, left=-100.0 * margin, height=0.8, color="#ececec", zorder=0)
        ax.plot([low, high], [y, y], color=colour, linewidth=1.4)
        for end, arrow in ((high, ">"), (low, "<")):
            if abs(end) > widest:
                ax.plot([np.copysign(widest, end)], [y], arrow, color=colour, markersize=3, clip_on=False, gid="cut")
        face = colour if step.contrast.is_shown else "white"
        ax.plot([value], [y], "o", color=colour, markersize=4, clip_on=False, markerfacecolor=face)
    unit = "percentage points" if steps[0].contrast.statistic.is_share else "%"
    ax.set(xlim=(-widest, widest), ylim=(len(names) - 0.5, -0.5), xlabel=f"difference in {unit}")
    ax.set_yticks(range(len(names)), [fill(name, _LETTERS) for name in names])
    ax.tick_params(axis="y", length=0)
    if len(settings) > 1:
        marks = [Line2D([], [], color=hue, label=signs(name)) for name, hue in zip(settings, colours, strict=False)]
        n_columns = 2 if max(map(len, settings)) < _LETTERS else 1
        ax.figure.legend(handles=marks, loc="outside upper center", ncols=n_columns)
