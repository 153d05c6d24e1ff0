"""Slow common motion of a group: its fit and the spectrum beside which it stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from stickslip.analysis.answer import lack
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Lack, Reason
from stickslip.analysis.groups import Group
from stickslip.analysis.models import common_motion
from stickslip.analysis.models.common_motion import (
    LEAST_HARMONICS,
    LEAST_PERIODS,
    CommonMotion,
    Goodness,
    Number,
    Shown,
    Spectra,
)
from stickslip.analysis.series.nulls import whole_periods
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats.effects import over_null
from stickslip.analysis.stats.estimates import Estimate

CYCLES = 3.0  # of a block: motion of longer periods is slow


class Band(NamedTuple):
    """Power of n_stick over that of time-shifted blocks between two periods, and that of the fit if there is one."""

    group: str
    above: float
    upto: float
    ratio: Estimate
    model: float | None = None

    @property
    def middle(self) -> float:
        return float(np.sqrt(self.above * self.upto))


@dataclass(frozen=True, eq=False)
class Slow:
    """A group's spectra, the mean cycle of a block, from exit to exit, and the fit; None if windows are short."""

    group: Group
    units: list[int]
    data: Spectra
    cycle: float
    motion: CommonMotion | None

    @property
    def shown(self) -> Shown:
        """Whether slow common motion is shown."""
        return Shown.SHORT if self.motion is None else self.motion.shown

    @property
    def is_shown(self) -> bool:
        return self.shown is Shown.SLOW

    @property
    def fit(self) -> CommonMotion:
        """The fit, if slow common motion is shown."""
        assert self.motion is not None
        return self.motion

    @property
    def goodness(self) -> Goodness:
        """Of the fit, if slow common motion is shown."""
        assert self.fit.goodness is not None
        return self.fit.goodness

    def logs(self, number: Number, units: Sequence[int]) -> list[float]:
        """Logarithm of a number from all units and with each of `units` left out; others change nothing."""
        total, *left_out = np.log(self.fit.values[number]).tolist()
        without = dict(zip(self.units, left_out, strict=True))
        return [total, *(without.get(unit, total) for unit in units)]

    def needed(self, t_burn: float) -> float:
        """The t_end that may suffice where this one is too short."""
        if self.motion is None:
            return t_burn + LEAST_HARMONICS * CYCLES * self.cycle
        return t_burn + 2 * LEAST_PERIODS * (self.motion.period or self.data.span)

    def bands(self, confidence: float) -> list[Band]:
        """Bands of harmonics."""
        data, bands, begin = self.data, list[Band](), 0
        while self.motion is not None and begin < len(data.frequency):
            end = min(begin + 1 + begin // 5, len(data.frequency))
            harmonics = slice(begin, end)
            power, null = (p[:, harmonics].sum(axis=1, keepdims=True) for p in (data.observed, data.independent))
            ratio = over_null(lambda sums: sums[:, 0], power, null, confidence).ratio
            above, upto = (data.span / (0.5 + edge) for edge in (end, begin))
            bands.append(Band(self.group.label, above, upto, ratio, self._model(harmonics)))
            begin = end
        return bands

    def _model(self, harmonics: slice) -> float | None:
        """Power of the fit, as windows of that length show it, over time-shifted blocks; None if there is no fit."""
        if not self.is_shown:
            return None
        variance, period, quality, share = (
            self.fit.values[number][0] for number in (Number.VARIANCE, Number.PERIOD, Number.QUALITY, Number.LEFT)
        )
        power = variance * common_motion.expected(self.data.frequency[harmonics], self.data.span, period, quality)
        return float(share + power.mean() / self.data.independent[:, harmonics].mean())


def slow_motions(study: Study, what: str) -> list[Slow] | Lack:
    """Slow common motion of each group that may be judged; or why something, a noun phrase, cannot be told of any."""
    if not study.data.events:
        return Lack(what, Reason.NOT_RECORDED, "set events = true under [record]")
    judged = [group for group in study.judged() if study.can_shift(group)]
    if not judged and study.judged():
        return Lack(what, Reason.NO_SHIFT)
    motions = [motion for group in judged if (motion := study.once(slow_motion, group)) is not None]
    return motions if judged else lack(study, what)


def misfits(fitted: Sequence[Slow], confidence: float) -> list[Slow]:
    """The groups, the worst first, without which damped oscillators fit the spectra of the others together.

    To adjust the p-value of each for their number would let fits pass that no group alone refutes.
    """
    in_order = sorted(fitted, key=lambda motion: motion.goodness.p_value)
    n_missed = 0
    while n_missed < len(in_order) and together(in_order[n_missed:]).p_value < 1 - confidence:
        n_missed += 1
    return in_order[:n_missed]


def together(fitted: Sequence[Slow]) -> Goodness:
    """How far the spectra of several groups lie from their fits."""
    return Goodness(*map(sum, zip(*(motion.goodness for motion in fitted), strict=True)))


def slow_motion(study: Study, group: Group) -> Slow | None:
    """The spectra and the slow common motion of a group; None if fewer than two units have exits.

    Slow is slower than a force too: at its frequency the phase is no motion of the blocks' own.
    """
    t_end = float(group.key["t_end"])
    t_start, n_periods = whole_periods(study.settings.t_burn, t_end, group.shift_unit)
    span = t_end - t_start
    cycles, n_runs = study.sums(group, _cycle, 1).T
    has_exits = n_runs > 0
    if np.count_nonzero(has_exits) < 2:
        return None
    cycle = float(cycles.sum() / n_runs.sum())
    m = common_motion.n_harmonics(span, CYCLES * cycle)
    m = min(m, n_periods - 1) if n_periods else m
    sums = study.sums(group, partial(_spectrum, m), 2 * m + 1)[has_exits]
    n_runs = sums[:, -1]
    means = sums[:, : 2 * m].reshape(-1, 2, m) / n_runs[:, None, None]
    data = Spectra(span, means[:, 0], means[:, 1], sums[:, 2 * m] / n_runs, n_runs)
    rng = study.generator(f"rhythm of {group.label}")
    motion = common_motion.common_motion(data, study.settings.confidence, rng) if m >= LEAST_HARMONICS else None
    return Slow(group, np.asarray(group.units)[has_exits].tolist(), data, cycle, motion)


def _cycle(run: Run) -> np.ndarray | None:
    """Time in which each block that slips does so once, on average; None for a run without exits or events."""
    if run.shiftable is None or not len(run.shiftable.exits[0]):
        return None
    t, block = run.shiftable.exits
    return np.array([np.count_nonzero(np.bincount(block)) * run.shiftable.span / len(t)])


def _spectrum(m: int, run: Run) -> np.ndarray | None:
    """`periodogram` of a run, and its variance in time; None as `_cycle`."""
    if run.shiftable is None or not len(run.shiftable.exits[0]):
        return None
    return np.append(common_motion.periodogram(run.shiftable, m), run.win.time_variance())
