"""Whether two quantities agree within a margin declared beforehand: two one-sided tests.

Not seeing a difference is no evidence of equivalence: equivalence has to be shown, just as a difference has to be
(Schuirmann 1987, J. Pharmacokinet. Biopharm. 15, 657). With d the difference, m the margin and e the error:

    p_equivalent = max(P(T > (d + m) / e), P(T < (d - m) / e)),    p_different = 2 P(T > |d| / e).

p_equivalent < alpha just when the 1 - 2 alpha interval lies within the margins.

The verdict on a difference is that of its interval, `findings.finding.Difference.verdict`.
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
UNKNOWN = "cannot be told"
MOST_ERRORS = 8.0  # of the intervals that tests invert: p-values below 1e-15 are not told apart
_HALVINGS = 40  # of these, which leave 1e-11 of a standard error


@dataclass(frozen=True)
class Compared:
    """An estimated difference and its two tests; errors have `dof` degrees of freedom.

    Attributes
    ----------
    difference, error, margin : float
        In one unit; the margins are -margin and +margin.
    p_equivalent, p_different : float
        The larger p-value of the two one-sided tests, and that of the two-sided test of no difference.
    """

    difference: float
    error: float
    dof: float
    margin: float
    p_equivalent: float
    p_different: float

    def interval(self, level: float) -> tuple[float, float]:
        """Ends of the interval difference +- t error at a level of confidence."""
        half = student.quantile(0.5 + level / 2, self.dof) * self.error
        return self.difference - half, self.difference + half

    def is_within(self, level: float) -> bool:
        """Whether a difference beyond the margin is excluded; a smaller one may exist."""
        return self.p_equivalent < 1 - level

    def is_beyond(self, level: float) -> bool:
        """Whether there is a difference, and the estimate is beyond the margin."""
        return self.p_different < 1 - level and abs(self.difference) > self.margin


def equivalence_test(difference: float, error: float, dof: float, margin: float) -> Compared:
    """Tests of a difference with a t-distributed error >= 0: against zero, and against the margins.

    With a margin of 0 nothing is equivalent.
    """
    size = abs(difference)
    if error == 0:
        return Compared(difference, error, dof, margin, float(size >= margin), float(size == 0))
    p_equivalent = student.below((size - margin) / error, dof)
    return Compared(difference, error, dof, margin, p_equivalent, student.two_sided(size / error, dof))


def mean_difference(of: Statistic, first: np.ndarray, second: np.ndarray, paired: bool) -> tuple[float, float, float]:
    """A statistic of `second` minus that of `first`, its standard error and degrees of freedom.

    Paired: jackknife over pairs of rows. Independent: a jackknife of each, with Welch's degrees of freedom.

    Parameters
    ----------
    of : callable
    first, second : ndarray, shape (G, 2) and (H, 2)
        Sums, one row a matrix; G = H where paired.

    Raises
    ------
    Undefined
        If the statistic has no value on all rows, or with one row left out.
    """
    if paired:
        value, error = jackknife(paired_difference(of), np.hstack([second, first]))
        return value, error, len(first) - 1.0
    (before, error_a), (after, error_b) = jackknife(of, first), jackknife(of, second)
    return after - before, *_welch(error_a, error_b, len(first), len(second))


def relative_difference(
    of: Statistic, first: np.ndarray, second: np.ndarray, paired: bool
) -> tuple[float, float, float]:
    """(second - first) / |first| of a statistic, its standard error and degrees of freedom, as `mean_difference`.

    Independent errors are propagated to the quotient to first order.
    """

    def quotient(after: np.ndarray, before: np.ndarray) -> np.ndarray:
        if (before == 0).any():
            raise Undefined("the first value is zero, so there is no relative difference")
        return (after / before - 1.0) * np.sign(before)

    if paired:
        value, error = jackknife(lambda s: quotient(of(s[:, 2:]), of(s[:, :2])), np.hstack([first, second]))
        return value, error, len(first) - 1.0
    (before, error_a), (after, error_b) = jackknife(of, first), jackknife(of, second)
    value = float(quotient(np.array([after]), np.array([before]))[0])
    return value, *_welch(error_a * after / before**2, error_b / before, len(first), len(second))


def _welch(error_a: float, error_b: float, n_a: int, n_b: int) -> tuple[float, float]:
    """Standard error of a sum of two independent terms, and its degrees of freedom."""
    parts = np.array([error_a**2, error_b**2])
    if not parts.sum():
        return 0.0, n_a + n_b - 2.0
    return float(np.sqrt(parts.sum())), float(parts.sum() ** 2 / (parts**2 / [n_a - 1, n_b - 1]).sum())


def against(of: Statistic, rows: np.ndarray, margin: float) -> Compared:
    """Tests of a difference that is itself a statistic of sums, one row a matrix; jackknife-t as in `over_matrices`.

    Raises
    ------
    Undefined
        If it has no value on all rows, or with one row left out, or if there is only one row.
    """
    rows = with_data(rows)
    if len(rows) < 2:
        raise Undefined("fewer than two matrices")
    value, error = jackknife(of, rows)
    return equivalence_test(value, error, len(rows) - 1.0, margin)


def wilson(successes: float, trials: float, confidence: float) -> tuple[float, float]:
    """Wilson's interval of a share (Wilson 1927); `trials` may be an effective number.

    Raises
    ------
    ValueError
        If there are no trials, the successes are not between 0 and the trials, or the confidence is none.
    """
    has, of = (arguments.number(name, value) for name, value in (("successes", successes), ("trials", trials)))
    if not (0 < of < np.inf and 0 <= has <= of):
        raise ValueError(
            f"successes, trials: expected 0 <= successes <= trials > 0, got {successes} of {trials}; give how many "
            "have the property, and how many there are"
        )
    low, high = wilsons(np.array([has / of]), np.array([of]), confidence)
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
        n, least = len(sizes), float(sizes.sum() ** 2 / np.sum(sizes**2))
        spread = np.asarray(share * (1 - share) * (1 - 1 / n))  # if 0, nothing says how far matrices scatter
        trials = np.divide(spread, squares, out=np.full_like(spread, np.inf), where=squares > 0)
        return cls(np.where(spread > 0, trials, 0.0), student.dof_of_scatter(n, concentration), least, most)

    def at(self, z: float) -> Any:
        """The trials that the interval takes at a normal quantile, 1.96 for 95%."""
        return np.minimum(np.maximum(self.trials * student.worth(z, self.dof), self.least), self.most)


@dataclass(frozen=True)
class Proportion:
    """A mean over matrices of what lies between 0 and 1.

    Attributes
    ----------
    share : float
    scatter : Scatter
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
        moved = (rows[:, 0] - share * rows[:, 1]) / n
        squares = float(np.sum(moved**2))
        concentration = float(np.sum((moved**2 / squares) ** 2)) if squares else 0.0
        most = n if is_counted else np.inf
        return cls(share, Scatter.of(share, squares, concentration, rows[:, 1], most), moved)

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
    most, confidence : float
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
    """A difference with an interval that is not symmetric; its tests invert the interval.

    Attributes
    ----------
    difference, margin : float
    ends : callable
        The ends of the interval at a normal quantile, 1.96 for 95%; the interval widens with it.
    """

    difference: float
    margin: float
    ends: Callable[[float], tuple[float, float]]

    def interval(self, level: float) -> tuple[float, float]:
        """Ends of the interval at a level of confidence."""
        return self.ends(student.quantile(0.5 + level / 2, np.inf))

    @property
    def p_different(self) -> float:
        """p-value of the two-sided test of no difference: it excludes zero at all levels below 1 - p."""
        return 2.0 * self._p(lambda low, high: low > 0.0 or high < 0.0)

    @property
    def p_equivalent(self) -> float:
        """The larger p-value of the two one-sided tests against the margins: within them below the level 1 - 2 p."""
        return self._p(lambda low, high: -self.margin < low and high < self.margin)

    def _p(self, holds: Callable[[float, float], bool]) -> float:
        """The upper tail beyond the largest quantile at which something holds of the interval; 1/2 if at none."""
        low, high = 0.0, MOST_ERRORS
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            low, high = (middle, high) if holds(*self.ends(middle)) else (low, middle)
        return student.below(-low, np.inf)


def correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Correlation of the parts by which units move two estimates, shape (G,); 0 where one does not vary."""
    size = float(np.sqrt(np.sum(first**2) * np.sum(second**2)))
    return float(np.sum(first * second)) / size if size else 0.0


def bounded_difference(
    first: np.ndarray, second: np.ndarray, paired: bool, margin: float, most: float = 1.0, is_counted: bool = False
) -> Compared | Inverted:
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
    if paired and not is_counted and (test := _of_pairs(q.share - p.share, q.moved - p.moved, most, margin)):
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

    return Inverted(most * (q.share - p.share), margin, ends)


def bounded_ratio(
    first: np.ndarray, second: np.ndarray, paired: bool, margin: float, most: float
) -> Compared | Inverted:
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
    if paired and (test := _of_pairs(r - 1.0, (q.moved - r * p.moved) / p.share, 1.0, margin)):
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

    return Inverted(r - 1.0, margin, ends)


def _of_pairs(value: float, moved: np.ndarray, unit: float, margin: float) -> Compared | None:
    """Tests of a difference from what each matrix moves it by, shape (G,), both in a unit; None if nothing does."""
    n, squares = len(moved), float(np.sum(moved**2))
    if n < 2 or not squares:
        return None
    dof = float(student.dof_of_scatter(n, np.sum((moved**2 / squares) ** 2)))
    return equivalence_test(unit * value, unit * (n / (n - 1) * squares) ** 0.5, dof, margin)


def _distance(one: float, other: float, phi: float) -> float:
    return max(one * one - 2.0 * phi * one * other + other * other, 0.0) ** 0.5
