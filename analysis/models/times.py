"""Times of runs until something happens, which the end of a run may cut off: medians and restricted means.

The mean over the runs in which it happened is wrong, and the more so the shorter the runs are. Two numbers are right
however long they are: the median by Kaplan and Meier, where half of the runs have it, and the mean of the time up to
a limit that all runs are followed to, the area under the curve of Kaplan and Meier (Irwin 1949; Royston and Parmar
2013, BMC Med. Res. Methodol. 13, 152). Systems are independent, runs of one system are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np

from stickslip.analysis.stats import student
from stickslip.analysis.stats.compare import Compared, correlation
from stickslip.analysis.stats.estimates import Estimate, Undefined, UnitSums
from stickslip.analysis.stats.survival import median, risks

_QUANTILE = student.quantile(0.975, np.inf)


@dataclass(frozen=True)
class Times(UnitSums):
    """Times of runs until something happens; `rows` are the times followed and the runs, added up by unit.

    Attributes
    ----------
    of_unit : ndarray of int, shape (R,)
        The unit of each run.
    times : ndarray, shape (R,), float64
        When it happened, or until when the run was followed.
    ended : ndarray of bool, shape (R,)
        Whether it happened.
    """

    of_unit: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    times: np.ndarray = field(default_factory=lambda: np.zeros(0))
    ended: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))

    @classmethod
    def of_runs(cls, units: np.ndarray, times: np.ndarray, ended: np.ndarray) -> Self:
        """Of runs, shape (R,) each."""
        sums = UnitSums.of(units, np.column_stack([times, np.ones(len(times))]))
        return cls(sums.units, sums.rows, np.asarray(units, dtype=np.int64), times, ended)

    def joined(self, others: Sequence[UnitSums]) -> Self:
        together = [self, *(times for times in others if isinstance(times, Times))]
        return self.of_runs(
            *(np.concatenate([getattr(times, name) for times in together]) for name in ("of_unit", "times", "ended"))
        )

    def within(self, other: UnitSums) -> Self:
        is_shared = np.isin(self.of_unit, other.units)
        return (
            self
            if is_shared.all()
            else self.of_runs(self.of_unit[is_shared], self.times[is_shared], self.ended[is_shared])
        )

    @property
    def n_censored(self) -> int:
        """How many runs were followed to an end without it."""
        return int((~self.ended).sum())

    @cached_property
    def _risks(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return risks(self.times, self.ended)

    def _moved(self, weights: np.ndarray) -> np.ndarray:
        """By how much each unit moves a number, shape (G,): the influence of its runs, summed.

        With Greenwood's terms, so that where nothing is cut off a run moves a mean by its own distance from that.

        Parameters
        ----------
        weights : ndarray, shape (m,)
            By how much the number falls with the hazard at each time of `stats.survival.risks`.
        """
        t, n_at_risk, n_ends, _ = self._risks
        n_left = n_at_risk - n_ends
        at_end = np.append(0.0, np.divide(weights, n_left, out=np.zeros(len(t)), where=n_left > 0))
        due = np.cumsum(at_end * np.append(0.0, n_ends / n_at_risk))
        place = np.searchsorted(t, self.times, side="right")
        shifts = due[place] - np.where(self.ended, at_end[place], 0.0)
        return np.bincount(np.searchsorted(self.units, self.of_unit), shifts, len(self.units))

    # ------------------------------------------------------------------------------------------------- median

    def median(self, confidence: float) -> Estimate:
        """The time by which half of the runs have it, by `stats.survival.median`; else why there is none."""
        half = median(self.times, self.ended, confidence, self.of_unit)
        if half.value is None:
            return replace(half, reason=self._not_reached)
        return replace(half, reason="the runs do not reach an end of it" if None in (half.low, half.high) else "")

    @property
    def _not_reached(self) -> str:
        if not len(self.times):
            return "nothing was followed"
        return f"not reached: {self._risks[3][-1]:.0%} without it at t = {self.times.max():g}"

    def _at_half(self) -> tuple[float, float, np.ndarray]:
        """The median, its standard error, and by how much each unit moves the share left there, shape (G,)."""
        t, _, n_ends, shares = self._risks
        value = median(self.times, self.ended, 0.5).value
        if value is None:
            raise Undefined(self._not_reached)
        share = float(shares[t <= value][-1])
        shifts = self._moved(np.where(t <= value, share, 0.0))
        variance = len(shifts) / (len(shifts) - 1) * float(np.sum(shifts**2))
        # as many independent runs have this variance, and one half has the error that they give it
        trials = min(share * (1.0 - share) / variance, len(self.times)) if variance else len(shifts)
        error = _QUANTILE * 0.5 / float(np.sqrt(trials))
        middle = (np.append(1.0, shares[:-1]) + shares) / 2  # of each step of the curve, between which it is read
        beyond, falls = np.inf if shares[-1] > 0.0 else t[-1], n_ends > 0
        low, high = np.interp([-0.5 - error, error - 0.5], -middle[falls], t[falls], right=beyond)
        if not np.isfinite(high):
            raise Undefined("an end of the interval lies beyond what the runs were followed to")
        return value, float(high - low) / (2.0 * _QUANTILE), shifts

    # ----------------------------------------------------------------------------------------- restricted mean

    def reaches(self, limit: float) -> bool:
        """Whether a run is followed to a limit, or all have had it before."""
        return bool(self.times.max(initial=0.0) >= limit or self._risks[3][-1] == 0.0)

    def restricted(self, limit: float) -> UnitSums:
        """Sums whose mean over units is the mean time up to a limit, and whose scatter is its error's.

        They are pseudo-values, what a unit adds to the area under the curve: the time itself where nothing is cut off
        (Andersen, Klein and Rosthoj 2003, Biometrika 90, 15, here to first order). Where both are of the same units
        their differences are paired.

        Raises `ValueError` if the limit is no time > 0, or no run is followed to it while some have not had it.
        """
        if not (0.0 < limit < np.inf and self.reaches(limit)):
            raise ValueError(
                f"limit: expected a time > 0 that a run is followed to, at most {self.times.max(initial=0.0):g}, got"
                f" {limit:g}; change it"
            )
        t, _, _, share = self._risks
        steps = np.minimum(np.append(t, np.inf), limit)
        areas = (np.diff(steps) * share)[::-1].cumsum()[::-1]  # under the curve from each time to the limit
        values = areas[0] + len(self.units) * self._moved(areas)
        return UnitSums(self.units, np.column_stack([values, np.ones(len(values))]))


def median_difference(first: Times, second: Times, paired: bool, is_relative: bool = False) -> Compared:
    """The median of `second` minus that of `first`, or relative to it.

    The error of a median is the width of its 95% interval in normal quantiles, which needs no density (Bonett and
    Price 2002, Psychol. Methods 7, 370). That interval is of the times at which the share left is one half, within
    its error over units. If paired, both have the same units, over which the two shares are correlated.

    Raises `Undefined` if a median is not reached, the runs are not followed to an end of its interval, or the first
    is zero and the difference is to be relative to it.
    """
    medians, errors, shifts = zip(*(times._at_half() for times in (first, second)), strict=True)
    shared = correlation(*shifts) if paired else 0.0
    start, end = medians
    a, b = errors
    if is_relative and start == 0.0:
        raise Undefined("the first value is zero, so there is no relative difference")
    if is_relative:
        a, b = a * end / start**2, b / start
    error = float(np.sqrt(max(a * a - 2.0 * shared * a * b + b * b, 0.0)))
    difference = end / start - 1.0 if is_relative else end - start
    return Compared(difference, error, min(len(first), len(second)) - 1.0)
