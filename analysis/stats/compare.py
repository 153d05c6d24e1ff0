"""Whether two quantities agree within a margin declared beforehand: two one-sided tests, and one rule for verdicts.

Not seeing a difference is no evidence of equivalence: equivalence has to be shown, just as a difference has to be
(Schuirmann 1987, J. Pharmacokinet. Biopharm. 15, 657). With d the difference, m the margin and e the error:

    p_equivalent = max(P(T > (d + m) / e), P(T < (d - m) / e)),    p_different = 2 P(T > |d| / e).

p_equivalent < alpha just when the 1 - 2 alpha interval lies within the margins.

`verdict` makes every verdict on a difference, whether from chance, between engines or of a changed system, so that
the margin means the same everywhere. Only the words differ (`Words`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from stickslip.analysis.stats import student
from stickslip.analysis.stats.estimates import Statistic, Undefined, jackknife, paired_difference

AGREE, DIFFER, UNKNOWN = "agree", "differ", "cannot be told"
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
        half = student.half_width(level, self.dof) * self.error
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


def share_difference(first: np.ndarray, second: np.ndarray, paired: bool) -> tuple[float, float, float]:
    """Share of ones in `second` minus that in `first`, its adjusted Wald error, and infinite degrees of freedom.

    Each group is given two more runs, one of each outcome: Agresti and Min (2005, Stat. Med. 24, 729) if paired,
    Agresti and Caffo (2000, Am. Stat. 54, 280) if independent. If paired, an entry may be the share of several runs.

    Parameters
    ----------
    first, second : ndarray of 0 and 1, shape (G,) and (H,)
    """
    n_a, n_b = len(first), len(second)
    if paired:
        n, change = n_a + 2.0, second - first
        moved = change.sum() / n
        return float(moved), float(np.sqrt((np.sum(change**2) + 1.0) / n - moved**2) / np.sqrt(n)), np.inf
    p, q = (first.sum() + 1) / (n_a + 2), (second.sum() + 1) / (n_b + 2)
    return float(q - p), float(np.sqrt(p * (1 - p) / (n_a + 2) + q * (1 - q) / (n_b + 2))), np.inf


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
        If there are no trials, or the successes are not between 0 and the trials.
    """
    if not (trials > 0 and 0 <= successes <= trials):
        raise ValueError(f"successes, trials: expected 0 <= successes <= trials > 0, got {successes} of {trials}")
    low, high = wilsons(np.array([successes / trials]), np.array([trials]), confidence)
    return float(low[0]), float(high[0])


def wilsons(shares: np.ndarray, trials: np.ndarray, confidence: float) -> tuple[np.ndarray, np.ndarray]:
    """`wilson` of many shares, shape (m,) as all arrays here."""
    z = float(special.ndtri(0.5 + confidence / 2))
    z2 = z * z / trials
    centre = (shares + z2 / 2) / (1 + z2)
    half = z / (1 + z2) * np.sqrt(shares * (1 - shares) / trials + z2 / (4 * trials))
    # exact at the ends, where rounding would leave about 1e-17
    low, high = np.where(shares > 0, centre - half, 0.0), np.where(shares < 1, centre + half, 1.0)
    return np.maximum(low, 0.0), np.minimum(high, 1.0)


def share_over_matrices(counts: np.ndarray, confidence: float) -> tuple[float, float, float, float]:
    """Share of runs with a property, with Wilson's interval for an effective number of trials.

    Runs of one matrix are not independent. The trials are p (1 - p) / (variance of p over matrices), but at least the
    number of matrices and at most the number of runs.

    Parameters
    ----------
    counts : ndarray, shape (G, 2)
        One row a matrix: runs with the property, and runs.

    Returns
    -------
    share, low, high, trials : float
    """
    counts = np.asarray(counts, dtype=np.float64)
    n_matrices, n_runs = len(counts), float(counts[:, 1].sum())
    share = float(counts[:, 0].sum()) / n_runs
    trials = float(n_matrices)
    if 0 < share < 1 and n_matrices > 1:
        residual = counts[:, 0] - share * counts[:, 1]
        variance = n_matrices / (n_matrices - 1) * float(np.sum(residual**2)) / n_runs**2
        trials = float(np.clip(share * (1 - share) / variance, n_matrices, n_runs)) if variance > 0 else n_runs
    low, high = wilson(share * trials, trials, confidence)
    return share, low, high, trials
