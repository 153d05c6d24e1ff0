"""Whether two quantities agree within a margin declared beforehand: two one-sided tests, and one rule for verdicts.

Not seeing a difference is no evidence of equivalence: equivalence has to be shown, just as a difference has to be
(Schuirmann 1987, J. Pharmacokinet. Biopharm. 15, 657). With d the difference, m the margin and e the error:

    p_equivalent = max(P(T > (d + m) / e), P(T < (d - m) / e)),    p_different = 2 P(T > |d| / e).

p_equivalent < alpha just when the 1 - 2 alpha interval lies within the margins.

`verdict` makes every verdict on a difference, whether from chance, between engines or of a changed system, so that
the margin means the same everywhere. Only the words differ (`Words`).
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from stickslip.analysis.stats import arguments, student
from stickslip.analysis.stats.estimates import Statistic, Undefined, jackknife, paired_difference

_Numbers = TypeVar("_Numbers", float, np.ndarray)
AGREE, DIFFER, UNKNOWN = "agree", "differ", "cannot be told"
MOST_ERRORS = 8.0  # of the intervals that tests invert: p-values below 1e-15 are not told apart
_HALVINGS = 40  # of these, which leave 1e-11 of a standard error
WITHIN = "within"  # pages add the margin: "within 1%"


@dataclass(frozen=True)
class Words:
    """The words of the three verdicts other than `UNKNOWN`.

    Attributes
    ----------
    same : str
        A difference beyond the margin is excluded; a smaller one may exist.
    more, less : str
        There is a difference, of this sign, and the estimate is beyond the margin.
    """

    same: str = AGREE
    more: str = DIFFER
    less: str = DIFFER


ALIKE = Words()


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

    def verdict(self, level: float, words: Words = ALIKE) -> str:
        """Verdict on this comparison alone, by the rule of this module."""
        return verdict(self.p_equivalent, self.p_different, 1 - level, self.difference, self.margin, words)


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


def verdict(
    p_equivalent: float, p_different: float, alpha: float, difference: float, margin: float, words: Words = ALIKE
) -> str:
    """Verdict on a difference: one of `words` or `UNKNOWN`.

    It is `words.same` if p_equivalent < alpha; `words.more` or `words.less`, by the sign of the difference, if
    p_different < alpha and the estimate is beyond the margin; else `UNKNOWN`. The p-values may be adjusted ones.

    If the estimate is within the margin but its interval is not, the verdict is `UNKNOWN` however surely the
    difference is not zero, since more data may still show equivalence.
    """
    if p_equivalent < alpha:
        return words.same
    if p_different >= alpha or abs(difference) <= margin:
        return UNKNOWN
    return words.more if difference > 0 else words.less


def against(of: Statistic, rows: np.ndarray, margin: float) -> Compared:
    """Tests of a difference that is itself a statistic of sums, one row a matrix; jackknife-t as in `over_matrices`.

    Raises
    ------
    Undefined
        If it has no value on all rows, or with one row left out, or if there is only one row.
    """
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
    if not (0 < trials < np.inf and 0 <= successes <= trials):
        raise ValueError(
            f"successes, trials: expected 0 <= successes <= trials > 0, got {successes} of {trials}; give how many "
            "have the property, and how many there are"
        )
    low, high = wilsons(np.array([successes / trials]), np.array([trials]), confidence)
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


def share_over_matrices(counts: ArrayLike, confidence: float) -> tuple[float, float, float, float]:
    """Share of runs with a property, with Wilson's interval for an effective number of trials.

    Runs of one matrix are not independent. The trials are p (1 - p) / (variance of p over matrices), but at least the
    number of matrices and at most the number of runs.

    Parameters
    ----------
    counts : array_like, shape (G, 2)
        One row a matrix: runs with the property, and runs.
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
    share, trials, _ = _effective(rows)
    low, high = wilson(share * trials, trials, confidence)
    return share, low, high, trials


def _effective(counts: np.ndarray) -> tuple[float, float, np.ndarray]:
    """A share, its effective number of trials, and by how much each matrix moves it, shape (G,)."""
    n_matrices, n_runs = len(counts), float(counts[:, 1].sum())
    share = float(counts[:, 0].sum()) / n_runs
    moved = (counts[:, 0] - share * counts[:, 1]) / n_runs
    trials = float(n_matrices)
    if 0 < share < 1 and n_matrices > 1:
        variance = n_matrices / (n_matrices - 1) * float(np.sum(moved**2))
        trials = float(np.clip(share * (1 - share) / variance, n_matrices, n_runs)) if variance > 0 else n_runs
    return share, trials, moved


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


def share_difference(first: np.ndarray, second: np.ndarray, paired: bool, margin: float) -> Inverted:
    """Share of runs in `second` minus that in `first`, with Newcombe's interval from the two of Wilson.

    The distance to an end is that of the two shares to the ends that count there, added as errors are: method 10 in
    Newcombe (1998), Stat. Med. 17, 873 and 2635. Runs of one matrix count as their effective number, as in
    `share_over_matrices`. If paired, phi is the correlation over matrices of what moves the two shares, less
    Newcombe's correction, half a trial of their covariance.

    Parameters
    ----------
    first, second : ndarray, shape (G, 2) and (H, 2)
        Runs with the property, and runs, one row a matrix; G = H where paired.
    """
    (p, trials_p, moved_p), (q, trials_q, moved_q) = _effective(first), _effective(second)
    phi = correlation(moved_p, moved_q) if paired else 0.0
    if phi > 0.0:
        phi = max(phi - 0.5 / np.sqrt(trials_p * trials_q * p * (1.0 - p) * q * (1.0 - q)), 0.0)

    def distance(one: float, other: float) -> float:
        return max(one * one - 2.0 * phi * one * other + other * other, 0.0) ** 0.5

    def ends(z: float) -> tuple[float, float]:
        (middle_p, half_p), (middle_q, half_q) = _middle(p, trials_p, z), _middle(q, trials_q, z)
        low = distance(q - middle_q + half_q, middle_p + half_p - p)
        return q - p - low, q - p + distance(middle_q + half_q - q, p - middle_p + half_p)

    return Inverted(q - p, margin, ends)
