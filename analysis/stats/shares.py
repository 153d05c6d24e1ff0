"""Shares with Wilson's interval, for runs that are independent and for those that matrices have in common."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from stickslip.analysis import arguments
from stickslip.analysis.stats import student
from stickslip.analysis.stats.estimates import Estimate, with_data

_Numbers = TypeVar("_Numbers", float, np.ndarray)


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

    Returns
    -------
    Estimate
        With a reason instead of an interval for a single matrix.
    """
    rows = with_data(rows)
    if not len(rows):
        return Estimate(reason="no matrix has data")
    proportion = Proportion.of(rows / [most, 1.0], is_counted)
    if len(rows) == 1:
        return Estimate(most * proportion.share, reason="one matrix")
    low, high = proportion.ends(student.half_width(confidence, np.inf))
    return Estimate(most * proportion.share, most * low, most * high)


def mean_share(rows: np.ndarray, most: float, confidence: float) -> Estimate:
    """Mean over matrices of a share of blocks or of time, as `mean_within`; exact where all have nothing, or all.

    Such a share is no count of yes and no: Wilson's interval would be of matrices that have it throughout, or never.
    """
    mean = mean_within(rows, most, confidence)
    is_alike = mean.low is not None and mean.value in (0.0, most)
    return Estimate(mean.value, mean.value, mean.value) if is_alike else mean
