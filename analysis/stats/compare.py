"""Differences of two quantities and their tests, and shares with Wilson's interval.

With d a difference and e its error, p_different = 2 P(T > |d| / e). The verdict on a difference is that of its
interval, `findings.finding.Difference.verdict`.
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from stickslip.analysis import arguments
from stickslip.analysis.stats import student
from stickslip.analysis.stats.estimates import (
    Estimate,
    Statistic,
    Undefined,
    jackknife,
    paired_difference,
    with_data,
)

_Numbers = TypeVar("_Numbers", float, np.ndarray)
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
        return Compared(*jackknife(paired_difference(of), np.hstack([second, first])), len(first) - 1.0)
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

    Raises
    ------
    Undefined
        If it has no value on all rows, or with one row left out, or if there is only one row.
    """
    rows = with_data(rows)
    if len(rows) < 2:
        raise Undefined("fewer than two matrices")
    return Compared(*jackknife(of, rows), len(rows) - 1.0)


def wilson(successes: float, trials: float, confidence: float) -> tuple[float, float]:
    """Wilson's interval of a share (Wilson 1927); `trials` may be an effective number.

    Raises
    ------
    ValueError
        If there are no trials, the successes are not between 0 and the trials, or the confidence is none.
    """
    has, n_trials = (arguments.number(name, value) for name, value in (("successes", successes), ("trials", trials)))
    if not (0 < n_trials < np.inf and 0 <= has <= n_trials):
        raise ValueError(
            f"successes, trials: expected 0 <= successes <= trials > 0, got {successes} of {trials}; give how many "
            "have the property, and how many there are"
        )
    low, high = wilsons(np.array([has / n_trials]), np.array([n_trials]), confidence)
    return float(low[0]), float(high[0])


def wilsons(shares: np.ndarray, trials: np.ndarray, confidence: float) -> tuple[np.ndarray, np.ndarray]:
    """`wilson` of many shares, shape (m,) as all arrays here."""
    centre, half = _middle(shares, trials, student.half_width(confidence, np.inf))
    # exact at the ends, where rounding would leave about 1e-17
    low, high = np.where(shares > 0, centre - half, 0.0), np.where(shares < 1, centre + half, 1.0)
    return np.maximum(low, 0.0), np.minimum(high, 1.0)


def _middle(share: _Numbers, trials: _Numbers, z: float) -> tuple[_Numbers, _Numbers]:
    """The middle of Wilson's interval, and half of its width."""
    z2 = z * z / trials
    return (share + z2 / 2) / (1 + z2), z / (1 + z2) * (share * (1 - share) / trials + z2 / (4 * trials)) ** 0.5


class Scatter(NamedTuple):
    """How far matrices scatter about a share: what the share is worth, as far as that is known; numbers, or arrays.

    Wilson's interval of a share takes trials p (1 - p) / (variance of p over matrices). They are an estimate: with
    Student's quantile in place of the normal one the interval is that of fewer trials, `at`. There are at least as
    many as matrices, which agree within themselves at worst.

    Attributes
    ----------
    trials : float
        As many independent ones scatter as far; infinite if nothing scatters.
    dof : float
        Degrees of freedom of the scatter.
    least, most : float
        How many trials there are at least and at most.
    """

    trials: Any
    dof: Any
    least: Any
    most: float

    @classmethod
    def of(cls, share: Any, squares: Any, concentration: Any, sizes: np.ndarray, most: float) -> Scatter:
        """Of a share, and of the squares of what each matrix moves it by.

        Parameters
        ----------
        share, squares, concentration : float, or ndarray of one shape
            The last as of `student.dof_of_scatter`.
        sizes : ndarray, shape (G,)
            What matrices weigh: runs of each, say.
        most : float
            Trials that there are at most: runs, where runs have a property or not.
        """
        n, fewest = len(sizes), float(sizes.sum() ** 2 / np.sum(sizes**2))
        spread = np.asarray(share * (1 - share) * (1 - 1 / n))  # if 0, nothing says how far matrices scatter
        trials = np.divide(spread, squares, out=np.full_like(spread, np.inf), where=squares > 0)
        return cls(np.where(spread > 0, trials, 0.0), student.dof_of_scatter(n, concentration), fewest, most)

    def at(self, z: float) -> Any:
        """The trials that the interval takes at a normal quantile, 1.96 for 95%."""
        return np.minimum(np.maximum(self.trials * student.worth(z, self.dof), self.least), self.most)


@dataclass(frozen=True)
class Proportion:
    """A mean over matrices of what lies between 0 and 1.

    Attributes
    ----------
    moved : ndarray, shape (G,)
        By how much each matrix moves it.
    """

    share: float
    scatter: Scatter
    moved: np.ndarray

    @classmethod
    def of(cls, rows: np.ndarray, is_counted: bool = False) -> Proportion:
        """Of the totals of what lies between 0 and 1 and how much there is of it, shape (G, 2).

        `is_counted`: of runs that have a property or not, of which no more can be independent than there are.
        """
        n = float(rows[:, 1].sum())
        share = min(max(float(rows[:, 0].sum()) / n, 0.0), 1.0)
        shifts = (rows[:, 0] - share * rows[:, 1]) / n
        squares = float(np.sum(shifts**2))
        concentration = float(np.sum((shifts**2 / squares) ** 2)) if squares else 0.0
        ceiling = n if is_counted else np.inf
        return cls(share, Scatter.of(share, squares, concentration, rows[:, 1], ceiling), shifts)

    def ends(self, z: float) -> tuple[float, float]:
        """Wilson's interval at a normal quantile."""
        middle, half = _middle(self.share, float(self.scatter.at(z)), z)
        return max(middle - half, 0.0) if self.share > 0 else 0.0, min(middle + half, 1.0) if self.share < 1 else 1.0


def share_over_matrices(counts: ArrayLike, confidence: float) -> tuple[float, float, float, float]:
    """Share of runs with a property, with Wilson's interval for an effective number of trials.

    Runs of one matrix are not independent. The trials are p (1 - p) / (variance of p over matrices), fewer as that
    variance is an estimate (`Scatter`), but at least the number of matrices and at most the number of runs.

    Parameters
    ----------
    counts : array_like, shape (G, 2)
        One row a matrix: runs with the property, and runs. Rows without a run are left out.
    confidence : float
        Between 0 and 1.

    Returns
    -------
    share, low, high, trials : float

    Raises
    ------
    ValueError
        If `counts` are no such rows, there is no run, or the confidence is none.
    """
    rows = arguments.sums(counts, 2, "counts")
    if not rows[:, 1].sum() or (rows[:, 0] < 0).any() or (rows[:, 0] > rows[:, 1]).any():
        raise ValueError(
            "counts: expected 0 <= runs with the property <= runs in each row, and a run at least, got"
            f" {reprlib.repr(rows.tolist())}; give a row for each matrix"
        )
    z = student.half_width(confidence, np.inf)
    proportion = Proportion.of(with_data(rows), is_counted=True)
    return proportion.share, *proportion.ends(z), float(proportion.scatter.at(z))


def mean_within(rows: np.ndarray, most: float, confidence: float, is_counted: bool = False) -> Estimate:
    """Mean over matrices of what lies between 0 and `most`, as a share of blocks or of time, by Wilson.

    As `share_over_matrices`, but what lies between scatters less than what is all or nothing: there may be any number
    of trials. Student's interval is too short if most matrices have nothing, and has no width if all have.

    Parameters
    ----------
    rows : ndarray, shape (G, 2)
        One row a matrix: the total of the numbers, and how many.
    is_counted : bool
        Whether they are runs that have a property, of all runs: there are then no more trials than runs.
    """
    rows = with_data(rows)
    if not len(rows):
        return Estimate(reason="no matrix has data")
    proportion = Proportion.of(rows / [most, 1.0], is_counted)
    low, high = proportion.ends(student.half_width(confidence, np.inf))
    return Estimate(most * proportion.share, most * low, most * high)


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

    Raises
    ------
    Undefined
        If the first is zero.
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
