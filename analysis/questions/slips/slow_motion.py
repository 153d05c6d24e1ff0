"""Slow common motion of a group: its fit and the spectrum beside which it stands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from stickslip.analysis.answer import F, Row, S, named
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.models import common_motion
from stickslip.analysis.models.common_motion import (
    LEAST_HARMONICS,
    LEAST_PERIODS,
    NUMBERS,
    SHORT,
    SLOW,
    CommonMotion,
    Goodness,
    Spectra,
)
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats.effects import over_null
from stickslip.analysis.stats.estimates import Estimate

CYCLES = 3.0  # of a block: motion of longer periods is slow
TABLE: Mapping[str, str] = {
    "group": S, "verdict": S, "p_value": F, "p_floor": F, "cycle": F, "n_windows": F, "span": F, "needed": F,
    **{f"{name}{end}": F for name in NUMBERS for end in ("", "_low", "_high")}, "deviance": F, "dof": F, "p_fit": F,
    "reason": S,
}  # fmt: skip
SPECTRUM: Mapping[str, str] = {"group": S, "above": F, "upto": F, "ratio": F, "low": F, "high": F, "model": F}


@dataclass(frozen=True)
class Slow:
    """A group's spectra, the mean cycle of a block, from exit to exit, and the fit; None if windows are short."""

    group: Group
    units: list[int]
    data: Spectra
    cycle: float
    motion: CommonMotion | None

    @property
    def verdict(self) -> str:
        """Whether slow common motion is shown."""
        return SHORT if self.motion is None else self.motion.verdict

    @property
    def is_shown(self) -> bool:
        return self.verdict == SLOW

    @property
    def goodness(self) -> Goodness:
        """Of the fit, if slow common motion is shown."""
        assert self.motion is not None
        assert self.motion.goodness is not None
        return self.motion.goodness

    def estimate(self, name: str) -> Estimate:
        """One of `NUMBERS`, if slow common motion is shown."""
        return Estimate() if self.motion is None else self.motion.estimates.get(name, Estimate())

    def logs(self, name: str, units: Sequence[int]) -> list[float]:
        """Logarithm of one of `NUMBERS` from all units and with each of `units` left out; others change nothing."""
        assert self.motion is not None
        whole, *left_out = np.log(self.motion.values[name]).tolist()
        of = dict(zip(self.units, left_out, strict=True))
        return [whole, *(of.get(unit, whole) for unit in units)]

    def needed(self, t_burn: float) -> float | None:
        """The t_end that may suffice where this one does not."""
        if self.motion is None:
            return t_burn + LEAST_HARMONICS * CYCLES * self.cycle
        if self.verdict != SHORT:
            return None
        return t_burn + 2 * LEAST_PERIODS * (self.motion.period or self.data.span)

    def row(self, t_burn: float) -> Row:
        """Row of the table `rhythm`."""
        motion = self.motion
        row: Row = {
            "group": self.group.label, "verdict": self.verdict, "cycle": self.cycle, "span": self.data.span,
            "n_windows": float(self.data.n_runs.sum()), "needed": self.needed(t_burn),
            "p_value": motion and motion.p, "p_floor": motion and common_motion.P_FLOOR,
        }  # fmt: skip
        estimates = {name: self.estimate(name) for name in NUMBERS}
        for name, estimate in estimates.items():
            row |= named(name, estimate)
        if motion is not None and motion.goodness is not None:
            fit = motion.goodness
            row |= {"deviance": fit.deviance, "dof": fit.dof, "p_fit": fit.p_value}
        return row | {
            "reason": next((self.estimate(name).reason for name in NUMBERS if self.estimate(name).reason), None)
        }

    def bands(self, confidence: float) -> list[Row]:
        """Power over that of time-shifted blocks in bands of harmonics, beside that of the fit: `rhythm_spectrum`."""
        data, rows, begin = self.data, list[Row](), 0
        while self.motion is not None and begin < len(data.frequency):
            band = slice(begin, end := min(begin + 1 + begin // 5, len(data.frequency)))
            observed, own = (power[:, band].sum(axis=1, keepdims=True) for power in (data.observed, data.independent))
            ratio = over_null(lambda sums: sums[:, 0], observed, own, confidence).ratio
            above, upto = (data.span / (0.5 + edge) for edge in (end, begin))
            rows.append({"group": self.group.label, "above": above, "upto": upto, "ratio": ratio.value,
                         "low": ratio.low, "high": ratio.high, "model": self._model(band)})  # fmt: skip
            begin = end
        return rows

    def _model(self, band: slice) -> float | None:
        """Power of the fit in a band of harmonics, as windows of that length show it, over time-shifted blocks."""
        if not self.is_shown or self.motion is None:
            return None
        names = ("variance", "period", "quality", "left")
        variance, period, quality, left = (self.motion.values[name][0] for name in names)
        power = variance * common_motion.expected(self.data.frequency[band], self.data.span, period, quality)
        return float(left + power.mean() / self.data.independent[:, band].mean())


def slow_motion(study: Study, group: Group) -> Slow | None:
    """The spectra and the slow common motion of a group; None if fewer than two units have exits."""
    span = float(group.key["t_end"]) - study.settings.t_burn
    cycles, n_runs = study.sums(group, _cycle, 1).T
    seen = n_runs > 0
    if np.count_nonzero(seen) < 2:
        return None
    cycle = float(cycles.sum() / n_runs.sum())
    m = common_motion.n_harmonics(span, CYCLES * cycle)
    sums = study.sums(group, partial(_spectrum, m), 2 * m + 1)[seen]
    n_runs = sums[:, -1]
    means = sums[:, : 2 * m].reshape(-1, 2, m) / n_runs[:, None, None]
    data = Spectra(span, means[:, 0], means[:, 1], sums[:, 2 * m] / n_runs, n_runs)
    rng = study.generator(f"rhythm of {group.label}")
    motion = common_motion.common_motion(data, study.settings.confidence, rng) if m >= LEAST_HARMONICS else None
    units = [unit for unit, is_seen in zip(group.units, seen, strict=True) if is_seen]
    return Slow(group, units, data, cycle, motion)


def _cycle(run: Run) -> np.ndarray | None:
    """Time in which each block that slips does so once, on average; None for a run without exits or events."""
    if run.steps is None or not (run.steps.step < 0).any():
        return None
    return np.array([len(np.unique(run.steps.exits[1])) * run.steps.span / np.sum(run.steps.step < 0)])


def _spectrum(m: int, run: Run) -> np.ndarray | None:
    """`periodogram` of a run, and its variance in time; None as `_cycle`."""
    if run.steps is None or not (run.steps.step < 0).any():
        return None
    return np.append(common_motion.periodogram(run.steps, m), run.win.time_variance())
