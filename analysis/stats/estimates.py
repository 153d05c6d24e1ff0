"""Estimates and their intervals.

Matrices are the independent units: the cascades of one run, and the runs of one matrix, depend on each other.
Every estimate here is a function of sums over matrices, and every interval comes from leaving out one matrix
at a time; resampling cascades or time samples would give intervals far too short.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from stickslip.analysis import arguments
from stickslip.analysis.stats import student

_ROUNDING = 1e-9  # of totals that are means over surrogates
_TOGETHER = 1 << 16  # rows that are left out in turn at once, so that few copies of them are in memory
LN2 = float(np.log(2.0))  # gamma of P(k) = 2^-k: exits and entries equally likely and independent


class Undefined(ArithmeticError):
    """Raised where a statistic has no value on some data; the message is the reason, in words for a reader."""


@dataclass(frozen=True)
class Estimate:
    """A number with its interval. What is missing is None, never NaN, and `reason` says why."""

    value: float | None = None
    low: float | None = None
    high: float | None = None
    reason: str = ""

    def __post_init__(self) -> None:
        for name in ("value", "low", "high"):
            number = getattr(self, name)
            if number is not None and np.isnan(arguments.number(name, number, "a number or None")):
                raise ValueError(f"{name}: expected a number or None, got nan; give None, and the reason")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ValueError(f"low, high: expected low <= high, got {self.low!r} and {self.high!r}; swap them")

    def __repr__(self) -> str:
        value = "no value" if self.value is None else f"{self.value:.6g}"
        interval = "" if self.low is None or self.high is None else f" ({self.low:.6g} to {self.high:.6g})"
        return f"Estimate({value}{interval}{self.reason and f': {self.reason}'})"

    def under(self, function: Callable[[float], float]) -> Estimate:
        """The estimate of an increasing function of the number."""
        ends = (self.value, self.low, self.high)
        value, low, high = (None if end is None else float(function(end)) for end in ends)
        return Estimate(value, low, high, self.reason)


def with_ends(estimates: Iterable[Estimate]) -> np.ndarray:
    """Values, lower and upper ends of estimates, shape (3, m), with NaN for none."""
    rows = [(estimate.value, estimate.low, estimate.high) for estimate in estimates]
    return np.array(rows, dtype=np.float64).reshape(-1, 3).T


def within(estimate: Estimate, least: float | None = None, most: float | None = None) -> Estimate:
    """An estimate whose interval does not go beyond what the number can be, by what it is.

    A t interval is symmetric and may; what is cut off cannot be covered, so the coverage stays what it is.
    """
    low, high = estimate.low, estimate.high
    if least is not None and low is not None:
        low = max(low, least)
    if most is not None and high is not None:
        high = min(high, most)
    return replace(estimate, low=low, high=high)


def non_negative(estimate: Estimate) -> Estimate:
    """An estimate of what cannot be negative: no more than an upper limit, if its interval holds zero.

    Where the whole interval lies below, that is by chance, and there is none.
    """
    low, high = estimate.low, estimate.high
    if low is None or high is None or low > 0.0:
        return estimate
    return Estimate(high=high) if high > 0.0 else Estimate(reason="the interval lies below zero")


@dataclass(frozen=True)
class UnitSums:
    """Two sums of each of some independent units, from which a statistic follows.

    Attributes
    ----------
    units : ndarray of int, shape (G,)
        Their numbers, ascending.
    rows : ndarray, shape (G, 2)
    """

    units: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    rows: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))

    @classmethod
    def of(cls, units: ArrayLike, rows: ArrayLike) -> UnitSums:
        """The rows of runs, shape (R, 2), added up by unit in their order."""
        numbers, place = np.unique(np.asarray(units, dtype=np.int64), return_inverse=True)
        columns = np.asarray(rows, dtype=np.float64).reshape(-1, 2).T
        return cls(numbers, np.column_stack([np.bincount(place, column, len(numbers)) for column in columns]))

    @staticmethod
    def together(some: Iterable[UnitSums]) -> UnitSums:
        """Several of one kind added up by unit."""
        tables = list(some)
        return tables[0].joined(tables[1:]) if tables else UnitSums()

    def joined(self, others: Sequence[UnitSums]) -> UnitSums:
        """These and others of their kind, added up by unit."""
        together = [self, *others]
        return UnitSums.of(
            np.concatenate([sums.units for sums in together]), np.concatenate([sums.rows for sums in together])
        )

    def __len__(self) -> int:
        return len(self.units)

    @property
    def counted(self) -> UnitSums:
        """Without units in which nothing was counted, whose second sum is zero."""
        return self._where(self.rows[:, 1] > 0)

    def within(self, other: UnitSums) -> UnitSums:
        """The units that the other has too."""
        return self._where(np.isin(self.units, other.units, assume_unique=True))

    def _where(self, kept: np.ndarray) -> UnitSums:
        return self if kept.all() else UnitSums(self.units[kept], self.rows[kept])


Statistic = Callable[[np.ndarray], np.ndarray]  # sums, shape (m, c) -> values, shape (m,); may raise Undefined


def ratio(sums: np.ndarray) -> np.ndarray:
    """First column over the second, which is a mean if the second is a count.

    Raises
    ------
    ValueError
        If `sums` are not of shape (m, 2), finite, and the second >= 0.
    Undefined
        If a second is 0.
    """
    sums = arguments.sums(sums, 2)
    if (sums[:, 1] == 0).any():
        raise Undefined("nothing was counted")
    return sums[:, 0] / sums[:, 1]


def per_event(sums: np.ndarray) -> np.ndarray:
    """Second column over the first: the time per event, of events and times; raises as `ratio`."""
    if (sums[:, 0] <= 0).any():
        raise Undefined("no event")
    return 1.0 / ratio(sums)


def gamma(sums: np.ndarray) -> np.ndarray:
    """Maximum-likelihood rate of the discrete exponential P(k) = (1 - q) q^(k-1), k >= 1, q = exp(-gamma).

    gamma = -log(1 - 1/mean): the likelihood depends on the sizes through their mean alone.

    Parameters
    ----------
    sums : ndarray, shape (m, 2)
        Total of the sizes, and number of cascades.

    Raises
    ------
    ValueError
        If `sums` are no such sums: sizes themselves, say, or fewer blocks than cascades.
    Undefined
        If there are no cascades, or all sizes are 1 (the likelihood then increases with gamma without bound).
    """
    total, count = arguments.sums(sums, 2).T
    if (total < count * (1.0 - _ROUNDING)).any():
        row = int(np.flatnonzero(total < count * (1.0 - _ROUNDING))[0])
        raise ValueError(
            f"sums: expected sizes >= 1, whose total is at least their number, got a total of {total[row]:g} for "
            f"{count[row]:g} in row {row}; the columns are the total of the sizes and their number"
        )
    if (count == 0).any():
        raise Undefined("no complete cascade")
    if (total <= count).any():
        raise Undefined("every cascade has size 1, so gamma has no finite value")
    return -np.log1p(-count / total)


def jackknife(statistic: Statistic, sums: np.ndarray) -> tuple[float, float]:
    """Value of a statistic of the summed rows, and its standard error from leaving out one row at a time.

    Parameters
    ----------
    sums : ndarray, shape (rows, c)
        At least two rows, independent of each other.
    """
    total = sums.sum(axis=0, keepdims=True)
    batches = (sums[k : k + _TOGETHER] for k in range(0, len(sums), _TOGETHER))
    return float(statistic(total)[0]), jackknife_error(
        np.concatenate([statistic(total - batch) for batch in batches])
    )


def jackknife_error(left_out: np.ndarray) -> float:
    """Standard error, sqrt((G-1)/G sum (x - mean)^2), from the values with one of G matrices left out, shape (G,)."""
    n_rows = len(left_out)
    return float(np.sqrt((n_rows - 1) / n_rows * np.sum((left_out - left_out.mean()) ** 2)))


def jackknife_estimate(values: np.ndarray, confidence: float) -> Estimate:
    """A number with its jackknife-t interval, from its values of shape (1 + G,): of all matrices, each left out."""
    value, half = float(values[0]), student.half_width(confidence, len(values) - 2) * jackknife_error(values[1:])
    return Estimate(value, value - half, value + half)


def with_data(rows: np.ndarray) -> np.ndarray:
    """Rows of sums without those of zeros alone: a matrix in which nothing was counted is none of an ensemble."""
    return rows[rows.any(axis=1)]


def over_matrices(statistic: Statistic, sums: np.ndarray, confidence: float) -> Estimate:
    """A statistic of the whole ensemble with a jackknife-t interval over matrices.

    value +- t(G - 1) * jackknife standard error, with G the number of rows. For a mean this is the t interval.

    Parameters
    ----------
    statistic : callable
        Maps sums, shape (m, c), to values, shape (m,); raises `Undefined` with a reason.
    sums : ndarray, shape (G, c)
        One row a matrix; the statistic is that of their sum. A row of zeros is a matrix without data, and none of G.
    confidence : float
        Between 0 and 1.

    Returns
    -------
    Estimate
        With a reason instead of an interval for a single matrix.

    Raises
    ------
    ValueError
        If `sums` are no such rows, or not finite, or the confidence is none.
    """
    statistic = arguments.called("statistic", statistic, "`gamma` or `ratio`")
    sums, confidence = with_data(arguments.sums(sums)), arguments.level(confidence)
    if len(sums) == 0:
        return Estimate(reason="no matrix has data")
    try:
        value = float(statistic(sums.sum(axis=0, keepdims=True))[0])
    except Undefined as undefined:
        return Estimate(reason=str(undefined))
    if len(sums) == 1:
        return Estimate(value, reason="one matrix")
    try:
        _, error = jackknife(statistic, sums)
    except Undefined as undefined:
        return Estimate(value, reason=f"one left out: {undefined}")
    half = student.half_width(confidence, len(sums) - 1) * error
    return Estimate(value, value - half, value + half)
