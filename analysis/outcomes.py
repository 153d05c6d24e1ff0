"""Contrasts of several settings with one reference, grouped by how they come out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby
from textwrap import fill
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from stickslip.analysis.answer import Picture
from stickslip.analysis.contrast import Contrast
from stickslip.analysis.findings.finding import Form, Level, Outcomes, Scale, Verdict
from stickslip.analysis.findings.numbers import signs
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.style import BLUE, EXACT, GREEN, GREY, ORANGE, PURPLE, SMOOTHED, panel
from stickslip.pipeline.design.values import text

EQUAL, DIFFERENT, UNDECIDED = "equal", "different", "undecided"
_HUES = (EXACT, SMOOTHED, GREEN, PURPLE, ORANGE, BLUE, "#8c564b", "#e377c2", "#17becf", "#bcbd22")
_LETTERS = 24  # of a line of a name
MOST_ROWS = 36  # in one figure


class Setting(NamedTuple):
    """What is set beside a reference.

    Attributes
    ----------
    name : str
        A noun phrase; empty if the symbol is one.
    symbol : str
        What tells it from others of that name by its value; empty if there are none.
    value : float, optional
    suffix : str
        What follows the value, as a unit.
    """

    name: str
    symbol: str = ""
    value: float | None = None
    suffix: str = ""

    @property
    def text(self) -> str:
        """The value."""
        return "" if self.value is None else f"{text(self.value)}{self.suffix}"


class Beside(NamedTuple):
    """A contrast of a setting with its reference, and where: the group that it is of."""

    contrast: Contrast
    where: Place


def outcomes(other: str, settings: Mapping[Setting, Sequence[Beside]], unit: str, scope: str = "") -> list[Outcomes]:
    """How settings come out beside a reference: those that differ, those that agree and the others, as far as any do.

    A setting differs if one of its statistics is shown to; else it is equal if all that have a margin, which the
    scene declares, are within. Each finding has the largest difference of its settings.
    """
    by_setting = {setting: outcome([one.contrast for one in some]) for setting, some in settings.items()}
    found = []
    for name in (DIFFERENT, EQUAL, UNDECIDED):
        of = {setting: some for setting, some in settings.items() if by_setting[setting] == name}
        if not of:
            continue
        level, setting = largest(other, of, unit)
        (most,) = in_words({setting: ""}, "")
        others = in_words(by_setting | {setting: ""}, DIFFERENT) if name == DIFFERENT and level is not None else ()
        words = {name: in_words(by_setting, name)}
        found.append(Outcomes(other, **words, largest=level, at_largest=most, others=others, scope=scope))
    return found


def outcome(contrasts: Sequence[Contrast]) -> str:
    """How some contrasts come out together."""
    if any(contrast.is_shown for contrast in contrasts):
        return DIFFERENT
    judged = [
        contrast.verdict for contrast in contrasts if contrast.difference.margin is not None or contrast.is_same
    ]
    return EQUAL if judged and {*judged} <= {Verdict.EQUAL, Verdict.SAME} else UNDECIDED


def largest(other: str, settings: Mapping[Setting, Sequence[Beside]], unit: str) -> tuple[Level | None, Setting]:
    """The largest difference that is shown or, if none is, of those with a margin, or of all; and its setting."""
    pairs = [(one.contrast, setting) for setting, some in settings.items() for one in some]
    best, setting = max(pairs, key=lambda pair: (pair[0].is_shown, pair[0].has_margin, _apart(pair[0])))
    return best.level(EVERYWHERE, other, unit), setting


def _apart(contrast: Contrast) -> float:
    """How large a difference is beside the first value, with an interval or without."""
    before, after = contrast.first.value, contrast.second.value
    if contrast.is_same or before is None or after is None:
        return 0.0
    if contrast.statistic.is_share or not before:
        return abs(after - before)
    return abs(after / before - 1.0)


def in_words(by_setting: Mapping[Setting, str], name: str) -> tuple[str, ...]:
    """The settings with an outcome; of settings that differ in one number, ranges of it."""
    found: list[str] = []
    for _, some in groupby(by_setting, key=lambda setting: (setting.name, setting.symbol)):
        found += _ranges([(setting, by_setting[setting] == name) for setting in some])
    return tuple(found)


def _ranges(settings: Sequence[tuple[Setting, bool]]) -> Iterator[str]:
    """Of settings with ascending values, the ranges of those that are wanted."""
    start = 0
    for is_wanted, some in groupby(settings, key=lambda pair: pair[1]):
        part = [setting for setting, _ in some]
        first, last, end = part[0], part[-1], start + len(part)
        if is_wanted and not first.symbol:
            yield from (setting.name for setting in part)
        elif is_wanted:
            value = f"= {first.text}" if first.name else f"of {first.text}"
            if len(part) > 1:
                value = f"{value} to {last.text}"
                if start == 0 and end < len(settings):
                    value = f"up to {last.text}"
                elif start > 0 and end == len(settings):
                    value = f"from {first.text} on"
            yield f"{first.name} with {first.symbol} {value}" if first.name else f"{first.symbol} {value}"
        start = end


def forest(rows: Sequence[Beside], what: str) -> dict[str, Picture]:
    """The figure of differences in per cent with their intervals, by its name; none of fewer than two."""
    shown = [one for one in rows if in_per_cent(one.contrast) and one.contrast.difference.estimate.low is not None]
    bands = "; bands are declared margins" * any(one.contrast.has_margin for one in shown)
    picture = Picture(partial(differences, shown[:MOST_ROWS]), f"{what}, filled where one is shown{bands}.")
    return {"contrasts": picture} if len(shown) > 1 else {}


def differences(rows: Sequence[Beside]) -> Figure:
    """Differences with their intervals: a line a statistic, a hue a setting, and declared margins as bands.

    Marks are filled where a difference is shown. An arrowhead marks one beyond the axis.
    """
    height = 1.2 + 0.14 * len(rows) + 0.16 * len({one.contrast.statistic.name for one in rows})
    return panel(height)(_differences)(rows)


def _differences(ax: Axes, rows: Sequence[Beside]) -> None:
    names = list(dict.fromkeys(one.contrast.statistic.quantity.name for one in rows))
    settings = list(dict.fromkeys(str(one.where) for one in rows))
    ends = np.array([_per_cent(one) for one in rows])
    reach = np.abs(ends).max(axis=1)
    widest = 1.08 * min(reach.max(), 4.0 * float(np.median(reach))) or 1.0
    ax.axvline(0, color=GREY, linewidth=0.8)
    for one, (value, low, high) in zip(rows, ends, strict=True):
        k, line = settings.index(str(one.where)), names.index(one.contrast.statistic.quantity.name)
        y = line + 0.7 * ((k + 0.5) / len(settings) - 0.5)
        margin, colour = one.contrast.difference.margin, _HUES[k % len(_HUES)]
        if margin is not None:
            ax.barh(line, 200.0 * margin, left=-100.0 * margin, height=0.8, color="#ececec", zorder=0)
        mark = "o" if abs(value) <= widest else ">" if value > 0 else "<"
        cut = [(end, arrow) for end, arrow in ((high, ">"), (low, "<")) if abs(end) > widest and mark == "o"]
        for end, arrow in cut:  # of an interval
            ax.plot([np.copysign(widest, end)], [y], arrow, color=colour, markersize=3, clip_on=False, gid="cut")
        ax.plot([low, high], [y, y], color=colour, linewidth=1.4)
        ax.plot(
            [min(max(value, -widest), widest)], [y], mark, color=colour, markersize=4, clip_on=False,
            markerfacecolor=colour if one.contrast.is_shown else "white",
        )  # fmt: skip
    ax.set(xlim=(-widest, widest), ylim=(len(names) - 0.5, -0.5), xlabel="difference in %")
    ax.set_yticks(range(len(names)), [fill(name, _LETTERS) for name in names])
    ax.tick_params(axis="y", length=0)
    if len(settings) > 1:
        marks = [Line2D([], [], color=_HUES[k % len(_HUES)], label=signs(name)) for k, name in enumerate(settings)]
        ax.figure.legend(
            handles=marks, loc="outside upper center", ncols=2 if max(map(len, settings)) < _LETTERS else 1
        )


def _per_cent(one: Beside) -> tuple[float, float, float]:
    """A difference and the ends of its interval, in per cent or percentage points."""
    estimate = one.contrast.difference.estimate
    assert estimate.value is not None
    assert estimate.low is not None
    assert estimate.high is not None
    return 100.0 * estimate.value, 100.0 * estimate.low, 100.0 * estimate.high


def in_per_cent(contrast: Contrast) -> bool:
    """Whether a difference is one of per cent or percentage points."""
    return contrast.difference.scale is Scale.RELATIVE or contrast.statistic.quantity.form is Form.SHARE
