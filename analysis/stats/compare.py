"""Differences of two quantities and their tests.

With d a difference and e its error, p_different = 2 P(T > |d| / e). The verdict on a difference is that of its
interval, `findings.finding.Difference.verdict`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats import student
from stickslip.analysis.stats.estimates import Statistic, Undefined, jackknife, with_data
from stickslip.analysis.stats.shares import Proportion

MOST_ERRORS = 8.0  # of the intervals that tests invert: p-values below 1e-15 are not told apart
_HALVINGS = 40  # of these, which leave 1e-11 of a standard error


@dataclass(frozen=True)
class Compared:
    """An estimated difference with a t-distributed error >= 0 of `dof` degrees of freedom."""

    difference: float
    error: float
    dof: float

    def interval(self, level: float) -> tuple[float, float]:
        """Ends of the interval difference +- t error at a level of confidence."""
        half = student.quantile(0.5 + level / 2, self.dof) * self.error
        return self.difference - half, self.difference + half

    @property
    def p_different(self) -> float:
        """p-value of the two-sided test of no difference."""
        if self.error == 0:
            return float(self.difference == 0)
        return student.two_sided(self.difference / self.error, self.dof)


def mean_difference(of: Statistic, first: np.ndarray, second: np.ndarray, paired: bool) -> Compared:
    """A statistic of `second` minus that of `first`.

    Paired: jackknife over pairs of rows. Independent: a jackknife of each, with Welch's degrees of freedom.

    Parameters
    ----------
    first, second : ndarray, shape (G, 2) and (H, 2)
        Sums, one row a matrix; G = H where paired.

    Raises
    ------
    Undefined
        If the statistic has no value on all rows, or with one row left out.
    """
    if paired:
        side_by_side = np.hstack([second, first])
        return Compared(*jackknife(lambda s: of(s[:, :2]) - of(s[:, 2:]), side_by_side), len(first) - 1.0)
    (start, error_a), (end, error_b) = jackknife(of, first), jackknife(of, second)
    return Compared(end - start, *_welch(error_a, error_b, len(first), len(second)))


def relative_difference(of: Statistic, first: np.ndarray, second: np.ndarray, paired: bool) -> Compared:
    """(second - first) / |first| of a statistic, as `mean_difference`.

    Independent errors are propagated to the quotient to first order.
    """

    def quotient(after: np.ndarray, before: np.ndarray) -> np.ndarray:
        if (before == 0).any():
            raise Undefined("the first value is zero, so there is no relative difference")
        return (after / before - 1.0) * np.sign(before)

    if paired:
        side_by_side = np.hstack([first, second])
        return Compared(*jackknife(lambda s: quotient(of(s[:, 2:]), of(s[:, :2])), side_by_side), len(first) - 1.0)
    (before, error_a), (after, error_b) = jackknife(of, first), jackknife(of, second)
    value = float(quotient(np.array([after]), np.array([before]))[0])
    return Compared(value, *_welch(error_a * after / before**2, error_b / before, len(first), len(second)))


def _welch(error_a: float, error_b: float, n_a: int, n_b: int) -> tuple[float, float]:
    """Standard error of a sum of two independent terms, and its degrees of freedom."""
    variances = np.array([error_a**2, error_b**2])
    if not variances.sum():
        return 0.0, n_a + n_b - 2.0
    return float(np.sqrt(variances.sum())), float(variances.sum() ** 2 / (variances**2 / [n_a - 1, n_b - 1]).sum())


def against(of: Statistic, rows: np.ndarray) -> Compared:
    """A difference that is itself a statistic of sums, one row a matrix; jackknife-t as in `over_matrices`.

    Raises `Undefined` if it has no value on all rows, or with one row left out, or if there is only one row.
    """
    rows = with_data(rows)
    if len(rows) < 2:
        raise Undefined("fewer than two matrices")
    return Compared(*jackknife(of, rows), len(rows) - 1.0)


@dataclass(frozen=True)
class Inverted:
    """A difference with an interval that is not symmetric; its test inverts the interval.

    Attributes
    ----------
    ends : callable
        The ends of the interval at a normal quantile, 1.96 for 95%; the interval widens with it.
    """

    difference: float
    ends: Callable[[float], tuple[float, float]]

    def interval(self, level: float) -> tuple[float, float]:
        """Ends of the interval at a level of confidence."""
        return self.ends(student.quantile(0.5 + level / 2, np.inf))

    @property
    def p_different(self) -> float:
        """p-value of the two-sided test of no difference: the interval excludes zero at all levels below 1 - p."""
        low_z, high_z = 0.0, MOST_ERRORS
        for _ in range(_HALVINGS):
            middle = (low_z + high_z) / 2
            low, high = self.ends(middle)
            low_z, high_z = (middle, high_z) if low > 0.0 or high < 0.0 else (low_z, middle)
        return 2.0 * student.below(-low_z, np.inf)


Test = Compared | Inverted


def correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Correlation of the parts by which units move two estimates, shape (G,); 0 where one does not vary."""
    size = float(np.sqrt(np.sum(first**2) * np.sum(second**2)))
    return float(np.sum(first * second)) / size if size else 0.0


def bounded_difference(
    first: np.ndarray, second: np.ndarray, paired: bool, most: float = 1.0, is_counted: bool = False
) -> Test:
    """A mean of what lies between 0 and `most` in `second` minus that in `first`, by Newcombe from two of Wilson.

    The distance to an end is that of the two shares to the ends that count there, added as errors are: method 10 in
    Newcombe (1998), Stat. Med. 17, 873 and 2635. Of runs that have a property phi, if paired, is the correlation over
    matrices of what moves the two shares, less Newcombe's correction, half a trial of their covariance. Other paired
    numbers have Student's interval instead, with the degrees of freedom of their scatter, unless no pair differs.

    Parameters
    ----------
    first, second : ndarray, shape (G, 2) and (H, 2)
        One row a matrix: the total of the numbers, and how many; G = H where paired.
    is_counted : bool
        Whether they are runs that have a property, of all runs.
    """
    p, q = (Proportion.of(rows / [most, 1.0], is_counted) for rows in (first, second))
    if paired and not is_counted and (test := _of_pairs(q.share - p.share, q.moved - p.moved, most)):
        return test
    phi = correlation(p.moved, q.moved) if paired else 0.0
    within = p.share * (1.0 - p.share) * q.share * (1.0 - q.share)

    def ends(z: float) -> tuple[float, float]:
        (low_p, high_p), (low_q, high_q), rho = p.ends(z), q.ends(z), phi
        if phi > 0.0:
            rho = max(phi - 0.5 / (p.scatter.at(z) * q.scatter.at(z) * within) ** 0.5, 0.0)
        low = _distance(q.share - low_q, high_p - p.share, rho)
        high = _distance(high_q - q.share, p.share - low_p, rho)
        return most * (q.share - p.share - low), most * (q.share - p.share + high)

    return Inverted(most * (q.share - p.share), ends)


def bounded_ratio(first: np.ndarray, second: np.ndarray, paired: bool, most: float) -> Test:
    """(second - first) / first of such means, from the same two intervals; parameters as in `bounded_difference`.

    Its ends are where an end of the interval of second - r first is zero (Donner and Zou 2012, Stat. Methods Med.
    Res. 21, 347). Paired numbers have Student's interval, as there.

    Raises `Undefined` if the first is zero.
    """
    p, q = (Proportion.of(rows / [most, 1.0]) for rows in (first, second))
    if not p.share:
        raise Undefined("the first value is zero, so there is no relative difference")
    r = q.share / p.share
    if paired and (test := _of_pairs(r - 1.0, (q.moved - r * p.moved) / p.share, 1.0)):
        return test

    def terms(off_p: float, off_q: float) -> tuple[float, float, float]:
        a, b, c = p.share**2 - off_p**2, p.share * q.share, q.share**2 - off_q**2
        return a, c, b + max(b * b - a * c, 0.0) ** 0.5

    def ends(z: float) -> tuple[float, float]:
        (low_p, high_p), (low_q, high_q) = p.ends(z), q.ends(z)
        _, c, root = terms(high_p - p.share, q.share - low_q)
        low = c / root if c > 0.0 else 0.0
        a, _, root = terms(p.share - low_p, high_q - q.share)
        return low - 1.0, (root / a if a > 0.0 else np.inf) - 1.0

    return Inverted(r - 1.0, ends)


def _of_pairs(value: float, moved: np.ndarray, unit: float) -> Compared | None:
    """A difference from what each matrix moves it by, shape (G,), both in a unit; None if nothing does."""
    n, squares = len(moved), float(np.sum(moved**2))
    if n < 2 or not squares:
        return None
    dof = float(student.dof_of_scatter(n, np.sum((moved**2 / squares) ** 2)))
    return Compared(unit * value, unit * (n / (n - 1) * squares) ** 0.5, dof)


def _distance(one: float, other: float, phi: float) -> float:
    return max(one * one - 2.0 * phi * one * other + other * other, 0.0) ** 0.5
