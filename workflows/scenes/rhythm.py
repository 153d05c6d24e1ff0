"""How slow common motion changes along the keys that a scene sweeps, and whether as a power of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from scipy import special

from stickslip.analysis.answer import Answer, F, Picture, S, frame, lack, named, systems
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import (
    Basis,
    Change,
    Difference,
    Family,
    Finding,
    Fit,
    Form,
    KeyChange,
    Lack,
    Law,
    Level,
    Quantity,
    Reason,
    Verdict,
)
from stickslip.analysis.findings.place import Place
from stickslip.analysis.questions.slips.slow_motion import Slow, slow_motion
from stickslip.analysis.stats import student
from stickslip.analysis.stats.compare import Compared, equivalence_test
from stickslip.analysis.stats.estimates import Estimate, jackknife_error
from stickslip.analysis.stats.multiplicity import holm
from stickslip.analysis.style import EXACT, GREEN, ORANGE, PURPLE, SMOOTHED, panel
from stickslip.pipeline.design.values import shown

KEYS = ("n", "kappa", "rho", "belt_speed")
NUMBERS = {
    "period": Quantity("period", "natural period of slow common motion", more="longer", less="shorter"),
    "quality": Quantity("quality", "Q of slow common motion"),
    "share": Quantity("share", "share of the variance of n_stick that is due to slow common motion", Form.SHARE),
}
_PLURAL = {"period": "natural periods", "quality": "values of Q", "share": "shares of the variance"}
EXPONENT = Quantity("exponent", "power")
LEAST_POINTS = 3  # to fit a power
LEAST_FACTOR = 2.0  # least ratio of the largest to the smallest value of a key, to speak of a power of it
WHAT = "changes of slow common motion"
_CHANGES: Mapping[str, str] = {
    "number": S, "key": S, "at": S, "first_value": S, "last_value": S, "first": F, "last": F, "change": F, "low": F,
    "high": F, "p_value": F, "p_adjusted": F, "verdict": S,
}  # fmt: skip
_POWERS: Mapping[str, str] = {
    "number": S, "key": S, "first_value": F, "last_value": F, "n_points": F, "exponent": F, "exponent_low": F,
    "exponent_high": F, "p_value": F, "p_misfit": F, "p_apart": F,
}  # fmt: skip


class Along(NamedTuple):
    """Groups that differ in one key only, sorted by it; `at` is what they share of the other swept keys."""

    key: str
    at: Place
    groups: Sequence[Slow]


class Changed(NamedTuple):
    """How a number changes from the first group of a line to the last; `p_value` is not adjusted."""

    number: str
    line: Along
    difference: Difference
    p_value: float

    def finding(self, basis: Basis) -> Change:
        key, first, last = self.line.key, self.line.groups[0], self.line.groups[-1]
        values = shown(first.group.key[key]), shown(last.group.key[key])
        estimates = first.estimate(self.number), last.estimate(self.number)
        return Change(
            NUMBERS[self.number], (KeyChange(key, *values),), *estimates, self.difference, self.line.at, basis
        )

    def row(self) -> Mapping[str, object]:
        """Row of the table `rhythm_changes`."""
        change, size, family = self.finding(Basis(0)), self.difference.estimate, self.difference.family
        (along,) = change.keys
        return {
            "number": self.number, "key": along.key, "at": str(change.where) or None, "first_value": along.first,
            "last_value": along.second, "first": change.before.value, "last": change.after.value,
            "change": size.value, "low": size.low, "high": size.high, "p_value": self.p_value,
            "p_adjusted": None if family is None else family.p_different, "verdict": self.difference.verdict.value,
        }  # fmt: skip


class Power(NamedTuple):
    """A number as a power of |key|, with an exponent common to all settings of the other keys.

    Attributes
    ----------
    p_value, p_misfit : float
        Of the exponent 0, and of the points' scatter about one power.
    p_apart : float, optional
        Of one exponent at all settings (Hotelling's T^2); None for one setting.
    """

    number: str
    key: str
    first_value: float
    last_value: float
    n_points: int
    exponent: Estimate
    p_value: float
    p_misfit: float
    p_apart: float | None

    def fits(self, alpha: float) -> bool:
        """Whether one power, with one exponent, fits all points."""
        return min(self.p_misfit, 1.0 if self.p_apart is None else self.p_apart) >= alpha

    def finding(self, alpha: float) -> Law:
        where = Place.key(f"|{self.key}|", f"{shown(self.first_value)} to {shown(self.last_value)}")
        fit = Fit.HOLDS if self.fits(alpha) else Fit.FAILS
        return Law(
            _PLURAL[self.number], f"follow a power law in |{self.key}|", Level(EXPONENT, self.exponent, where), fit
        )


def question(study: Study) -> Answer:
    """How does slow common motion depend on what is swept?

    The last value of a key is compared with the first, all else equal, with intervals from leaving out one system
    everywhere at once, and adjusted for the number of comparisons. A power is fitted by weighted least squares of
    logarithms where a key spans a factor of two.
    """
    if not study.data.events:
        return Answer(findings=[Lack(WHAT, Reason.NOT_RECORDED, "set events = true under [record]")])
    judged = study.judged()
    if not judged:
        return Answer(findings=[lack(study, WHAT)])
    slow = [motion for group in judged if (motion := slow_motion(study, group)) is not None and motion.is_shown]
    lines = [line for key in KEYS for line in along(key, slow)]
    if not lines:
        return Answer(findings=[Lack(WHAT, Reason.ONE_VALUE if slow else Reason.NOT_SHOWN)])
    confidence = study.settings.confidence
    found = changes(lines, confidence)
    found.sort(
        key=lambda change: change.difference.verdict not in (Verdict.MORE, Verdict.LESS)
    )  # what is shown leads
    powers = [power for key in KEYS for name in NUMBERS if (power := power_law(name, key, lines, confidence))]
    basis = Basis(max(len(motion.units) for motion in slow), systems(study))
    findings: list[Finding] = [one.finding(basis) for one in found]
    wide = [power for power in powers if power.last_value >= LEAST_FACTOR * power.first_value]
    findings += [power.finding(1 - confidence) for power in wide]
    findings += [
        Level(NUMBERS["period"], motion.estimate("period"), Place.of(motion.group.name), basis=basis)
        for motion in slow
    ]
    tables = {
        "rhythm_changes": frame(_CHANGES, (one.row() for one in found)),
        "rhythm_laws": frame(_POWERS, (
            power._asdict() | named("exponent", power.exponent) for power in powers
        )),
    }  # fmt: skip
    drawn = [line for line in lines if line.key == lines[0].key]
    caption = f"How the natural period of slow common motion changes along {drawn[0].key}, with intervals."
    picture = Picture(partial(periods, drawn), caption)
    return Answer(findings=findings, n_lead=2, tables=tables, figures={"rhythm_period": picture})


# --------------------------------------------------------------------------------------------------- changes


def along(key: str, slow: Sequence[Slow]) -> list[Along]:
    """Sets of two or more groups that differ in one key only, sorted by it."""
    varied = [name for name in KEYS if len({motion.group.key[name] for motion in slow}) > 1 and name != key]
    sets: dict[tuple[object, ...], list[Slow]] = {}
    for motion in slow:
        if motion.group.key[key]:
            others = tuple(value for other, value in motion.group.key.items() if other != key)
            sets.setdefault(others, []).append(motion)
    return [
        Along(
            key,
            Place(tuple((name, shown(groups[0].group.key[name])) for name in varied)),
            sorted(groups, key=lambda motion: float(motion.group.key[key])),
        )
        for groups in sets.values()
        if len(groups) > 1
    ]


def changes(lines: Sequence[Along], confidence: float) -> list[Changed]:
    """Changes from the first to the last value of each line; their p-values are adjusted by Holm's rule."""
    tested = [(name, line, _logarithm(name, line)) for name in NUMBERS for line in lines]
    adjusted = holm([test.p_different for *_, test in tested])
    found = []
    for (name, line, test), p in zip(tested, adjusted, strict=True):
        value, low, high = np.expm1([test.difference, *test.interval(confidence)]).tolist()
        family = Family(len(tested), float(p), alpha=1 - confidence)
        found.append(Changed(name, line, Difference(Estimate(value, low, high), family=family), test.p_different))
    return found


def _logarithm(name: str, line: Along) -> Compared:
    """Tests of the logarithm of the last value over the first.

    For its error a system is left out of both at once, as they share draws.
    """
    first, last = line.groups[0], line.groups[-1]
    units = sorted({*first.units, *last.units})
    logs = np.array(last.logs(name, units)) - np.array(first.logs(name, units))
    return equivalence_test(float(logs[0]), jackknife_error(logs[1:]), len(units) - 1, 0.0)


# ---------------------------------------------------------------------------------------------------- powers


def power_law(name: str, key: str, lines: Sequence[Along], confidence: float) -> Power | None:
    """A number as a power of |key|, from all lines along it; None for fewer than `LEAST_POINTS` values.

    By least squares of the logarithms, weighted by the errors of the points. Errors come from leaving out a system
    everywhere at once, as groups share draws.
    """
    sets = [line.groups for line in lines if line.key == key]
    points = [(motion, k) for k, groups in enumerate(sets) for motion in groups]
    at = np.array([abs(float(motion.group.key[key])) for motion, _ in points])
    if len(set(at.tolist())) < LEAST_POINTS:
        return None
    units = sorted({unit for motion, _ in points for unit in motion.units})
    x, y = np.log(at), np.array([motion.logs(name, units) for motion, _ in points])
    weight = np.array([jackknife_error(np.array(motion.logs(name, motion.units)[1:])) ** -2 for motion, _ in points])
    own = np.array([k for _, k in points])[:, None] == np.arange(len(sets))  # each set has a level of its own
    share = own * weight[:, None] / (weight @ own)
    x, y = x - own @ (share.T @ x), y - own @ (share.T @ y)
    by_set = (own.T @ (weight[:, None] * x[:, None] * y)) / (own.T @ (weight * x**2))[:, None]
    slopes = (weight * x) @ y / (weight @ x**2)
    slope, error, dof = float(slopes[0]), jackknife_error(slopes[1:]), len(units) - 1
    half, n_free = student.half_width(confidence, dof) * error, len(points) - len(sets) - 1
    misfit = float(special.chdtrc(n_free, weight @ (y[:, 0] - slope * x) ** 2))
    exponent, p_value = Estimate(slope, slope - half, slope + half), student.two_sided(slope / error, dof)
    return Power(
        name, key, float(at.min()), float(at.max()), len(points), exponent, p_value, misfit, _p_apart(by_set)
    )


def _p_apart(slopes: np.ndarray) -> float | None:
    """p-value of the null that some sets have one slope, from slopes of shape (k, 1 + G).

    Columns are the slopes from all systems, and with each left out. None for one set, or too few systems.
    """
    apart, n = slopes[1:] - slopes[0], slopes.shape[1] - 1
    k = len(apart)
    if not 0 < k < n:
        return None
    off = apart[:, 1:] - apart[:, 1:].mean(axis=1, keepdims=True)
    square = apart[:, 0] @ np.linalg.solve((n - 1) / n * off @ off.T, apart[:, 0])
    return float(special.fdtrc(k, n - k, (n - k) / (k * (n - 1)) * square))


# ------------------------------------------------------------------------------------------------- the figure


@panel()
def periods(ax: Axes, lines: Sequence[Along]) -> None:
    """Natural period along one key, one line for each setting of the others."""
    for k, line in enumerate(lines):
        x = [float(motion.group.key[line.key]) for motion in line.groups]
        y = np.array([motion.estimate("period").value for motion in line.groups], dtype=np.float64)
        ends = [(motion.estimate("period").low, motion.estimate("period").high) for motion in line.groups]
        off = np.abs(np.array(ends, dtype=np.float64) - y[:, None]).T
        colour, form = (EXACT, SMOOTHED, GREEN, PURPLE, ORANGE)[k % 5], f"{'os^Dv'[k % 5]}-"
        ax.errorbar(x, y, off, fmt=form, color=colour, markersize=3.5, linewidth=0.9, label=line.at)
    ax.set(xlabel=lines[0].key, ylabel="natural period")
    if len(lines) > 1:
        ax.figure.legend(loc="outside lower center", ncols=2)
