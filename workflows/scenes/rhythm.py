"""How slow common motion changes along the keys that a scene sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import Answer, Picture
from stickslip.analysis.by_key import by_key
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import (
    Basis,
    Change,
    Difference,
    Family,
    Form,
    KeyChange,
    Lack,
    Quantity,
    Reason,
    Scale,
    Verdict,
)
from stickslip.analysis.findings.numbers import signs
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import listed
from stickslip.analysis.grid import is_negative
from stickslip.analysis.members import noun
from stickslip.analysis.models.common_motion import Number
from stickslip.analysis.questions.slips.slow_motion import Slow, misfits, slow_motions
from stickslip.analysis.stats.compare import Compared
from stickslip.analysis.stats.estimates import jackknife_error, jackknife_estimate, with_ends
from stickslip.analysis.stats.multiplicity import holm
from stickslip.analysis.style import HUES, bars, panel
from stickslip.pipeline.design.values import shown

KEYS = ("n", "kappa", "rho", "belt_speed")
NUMBERS = {
    Number.PERIOD: Quantity("period", "natural period of slow common motion", more="longer", less="shorter"),
    Number.QUALITY: Quantity("quality", "Q of slow common motion"),
    Number.SHARE: Quantity(
        "share",
        "share of the variance of the number of sticking blocks that comes from slow common motion",
        Form.SHARE,
    ),
}
WHAT = "changes of slow common motion"


class Along(NamedTuple):
    """Groups that differ in one key only, sorted by it; `at` is what they share of the other swept keys."""

    key: str
    at: Place
    groups: Sequence[Slow]

    @property
    def ends(self) -> tuple[float, float]:
        """The first and the last value of the key."""
        first, *_, last = (float(motion.group.key[self.key]) for motion in self.groups)
        return first, last


def question(study: Study) -> Answer:
    """How does slow common motion depend on the number of blocks and the speed of the belt?

    The last value of a key is compared with the first, system by system, and averaged over the settings of the other
    keys at which these are the ends. Verdicts are adjusted for the number of comparisons (Holm). Where a damped
    oscillator misses the spectrum there is no number to compare.
    """
    motions = slow_motions(study, WHAT)
    if isinstance(motions, Lack):
        return Answer(findings=[motions])
    slow = [motion for motion in motions if motion.is_shown]
    missed = misfits(slow, study.settings.confidence)  # what is fitted there is no number of the motion
    lines = [line for key in KEYS for line in along(key, [motion for motion in slow if motion not in missed])]
    if not lines:
        return Answer(findings=[Lack(WHAT, Reason.ONE_VALUE if slow else Reason.NOT_SHOWN)])
    confidence = study.settings.confidence
    changed = changes(lines, noun(study.unit), confidence)
    is_shown, order = {Verdict.MORE, Verdict.LESS}, [*NUMBERS.values()]
    changed.sort(key=lambda change: (change.difference.verdict not in is_shown, order.index(change.quantity)))
    shown_lines = [line for line in lines if line.key == lines[0].key]
    gaps = " No point is where a damped oscillator misses the spectrum." * bool(missed)
    caption = f"{_trend(changed, shown_lines[0].key)}. Bars are {100 * confidence:g}% intervals.{gaps}"
    return Answer(
        findings=changed, n_lead=2, figures={"rhythm_period": Picture(partial(periods, shown_lines), caption)}
    )


def _trend(changed: Sequence[Change], key: str) -> str:
    """What the figure of natural periods along a key shows."""
    period = NUMBERS[Number.PERIOD]
    along = [change for change in changed if (change.quantity, change.keys[0].key) == (period, key)]
    verdicts = {change.difference.verdict for change in along} & {Verdict.MORE, Verdict.LESS}
    (said, *_), (of_size, *_) = along[0].keys[0].said, (change.keys[0].is_of_size for change in along)
    if len(verdicts) != 1:
        return f"The {period.name} shows no one trend with {said}"
    side = f"as {said} decreases" if of_size else f"with {said}"
    places = [change.where.tail for change in along if change.difference.verdict in verdicts]
    only = " and".join(places) if len(places) < len(along) else ""
    return f"The {period.name} {'rises' if verdicts == {Verdict.MORE} else 'falls'} {side}{only}"


# --------------------------------------------------------------------------------------------------- changes


def along(key: str, slow: Sequence[Slow]) -> list[Along]:
    """Sets of two or more groups that differ in one key only, sorted by it."""
    varied = [name for name in KEYS if len({motion.group.key[name] for motion in slow}) > 1 and name != key]
    with_key = [motion for motion in slow if motion.group.key[key]]
    sets = by_key(with_key, lambda motion: tuple(value for other, value in motion.group.key.items() if other != key))
    return [
        Along(
            key,
            Place(tuple((name, shown(groups[0].group.key[name])) for name in varied)),
            sorted(groups, key=lambda motion: float(motion.group.key[key])),
        )
        for groups in sets.values()
        if len(groups) > 1
    ]


def changes(lines: Sequence[Along], unit: str, confidence: float) -> list[Change]:
    """Changes from the first to the last value of a key, averaged over the lines that have the same ends.

    To pick the largest of several lines would overstate it. The p-values are adjusted by Holm's rule.
    """
    sets = [*by_key(lines, lambda line: (line.key, line.ends)).values()]
    sets.sort(key=len, reverse=True)
    tested = [(number, of_set, *_averaged(number, of_set)) for number in NUMBERS for of_set in sets]
    rises = [last - first for *_, first, last in tested]
    tests = [Compared(float(rise[0]), jackknife_error(rise[1:]), len(rise) - 2) for rise in rises]
    adjusted = holm([test.p_different for test in tests]).tolist()
    changed = []
    for (number, of_set, first, last), rise, p in zip(tested, rises, adjusted, strict=True):
        is_share, size = number is Number.SHARE, jackknife_estimate(rise, confidence)
        scale = Scale.ABSOLUTE if is_share else Scale.RELATIVE
        difference = Difference(
            size if is_share else size.under(np.expm1), scale, family=Family(len(tested), p, alpha=1 - confidence)
        )
        key, (old, new) = of_set[0].key, of_set[0].ends
        keys = (KeyChange(key, shown(old), shown(new), is_negative(old, new)),)
        before, after = (jackknife_estimate(side, confidence) for side in (first, last))
        if not is_share:
            before, after = before.under(np.exp), after.under(np.exp)
        basis = Basis(min(len(motion.units) for line in of_set for motion in (line.groups[0], line.groups[-1])), unit)
        changed.append(Change(NUMBERS[number], keys, before, after, difference, _averaged_over(of_set), basis))
    return changed


def _averaged(number: Number, lines: Sequence[Along]) -> np.ndarray:
    """A number at both ends of some lines, averaged over these: a share, or the logarithm of another number.

    Of shape (2, 1 + G): from all systems, and with each of G left out of all settings at once, as they share draws;
    along n they do not, which adds no error.
    """
    units = sorted({unit for line in lines for k in (0, -1) for unit in line.groups[k].units})
    logs = np.array([[line.groups[k].logs(number, units) for line in lines] for k in (0, -1)])
    return np.asarray((np.exp(logs) if number is Number.SHARE else logs).mean(axis=1))


def _averaged_over(lines: Sequence[Along]) -> Place:
    """Where a change holds: the setting of one line, or over which of them it is an average."""
    if len(lines) == 1:
        return lines[0].at
    keys = {key for line in lines for key, _ in line.at.parts}
    if len(keys) > 1:
        return Place.words(f"averaged over {len(lines)} settings of the other keys")
    values = sorted((value for line in lines for _, value in line.at.parts), key=lambda value: abs(float(value)))
    return Place.words(f"averaged over {keys.pop()} = {listed(values)}")


# ------------------------------------------------------------------------------------------------- the figure


@panel()
def periods(ax: Axes, lines: Sequence[Along]) -> None:
    """Natural period along one key, one line for each setting of the others."""
    is_of_size = is_negative(*(motion.group.key[line.key] for line in lines for motion in line.groups))
    sign = -1.0 if is_of_size else 1.0
    for k, line in enumerate(lines):
        x = [sign * float(motion.group.key[line.key]) for motion in line.groups]
        periods = with_ends(motion.fit.estimates[Number.PERIOD] for motion in line.groups)
        colour, form = HUES[k % len(HUES)], f"{'os^Dv'[k % 5]}-"
        bars(ax, x, periods, fmt=form, color=colour, markersize=3.5, linewidth=0.9, label=signs(str(line.at)))
    ax.set(xlabel=f"|{lines[0].key}|" if is_of_size else lines[0].key, ylabel="natural period")
    if len(lines) > 1:
        ax.figure.legend(loc="outside lower center", ncols=2)
