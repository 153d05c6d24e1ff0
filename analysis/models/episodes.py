"""Episodes: how often, how large and how regular they are, and the law of their moments.

The magnitude of an episode is M = log10 of the size of its moment. Sums of runs add over the runs of a system; what
is estimated is a function of sums over systems, as everywhere here. Dimensionless.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats.estimates import Estimate, Statistic, Undefined, over_matrices, ratio
from stickslip.analysis.stats.families import Family, Fit
from stickslip.analysis.stats.student import half_width

B_STEP = 0.5  # from least magnitude to least magnitude at which b is shown
CLASS = 0.1  # width of a class of magnitudes, as catalogues round them
#: Width of those that laws are fitted in. The moment of a class is that at its middle, and what this errs by grows
#: with the square of the width: in classes of 0.1 the exponent of 4e5 exponential moments is off by 0.04, its
#: standard error 0.03.
FITTED = 0.02
_LOG10_E = float(np.log10(np.e))


@dataclass(frozen=True)
class Catalogue:
    """Episodes of one run that began on [t_start, t_stop], in order of time.

    Attributes
    ----------
    t_start, t_stop : float
    start, duration, moment : ndarray, shape (m,)
        moment is zero nowhere; below it where blocks slip on the whole with the belt, as forces can make them.
    size : ndarray of int, shape (m,)
    slip : float
        What the belt would have all blocks slip in that time, n |v| (t_stop - t_start); NaN if v is not one
        number, or zero.
    first_block : ndarray of int, shape (m,)
        The block that left first.
    """

    t_start: float
    t_stop: float
    start: np.ndarray
    duration: np.ndarray
    size: np.ndarray
    moment: np.ndarray
    slip: float
    first_block: np.ndarray

    @property
    def magnitude(self) -> np.ndarray:
        """log10 of the sizes of the moments, shape (m,)."""
        return np.log10(np.abs(self.moment))

    @property
    def quiet(self) -> np.ndarray:
        """Quiet times, from the end of each to the start of the next, shape (m - 1,).

        Those from start to start hold the durations: where episodes fill much of the time, as dead time they make
        any process look regular, and any size look as if it put off the next.
        """
        return self.start[1:] - (self.start + self.duration)[:-1]

    @property
    def sizes_and_quiets(self) -> np.ndarray:
        """Of each but the last its size, and the quiet time after it, shape (m - 1, 2)."""
        return np.column_stack([self.size[:-1], self.quiet])

    def is_late(self) -> np.ndarray:
        """Which of them begin in the second half, shape (m,)."""
        return np.asarray(self.start >= 0.5 * (self.t_start + self.t_stop))

    def halves(self) -> np.ndarray:
        """How many begin in the first and in the second half, shape (2,)."""
        return np.bincount(self.is_late().astype(np.int64), minlength=2).astype(np.float64)

    def first_blocks(self, n: int) -> np.ndarray:
        """How often each of n blocks leaves first, in the first half and in the second, shape (2, n)."""
        return np.bincount(self.is_late() * n + self.first_block, minlength=2 * n).reshape(2, n)


def completeness(magnitudes: np.ndarray) -> float:
    """Upper edge of the fullest class of magnitudes: the least one that a law is fitted to (maximum curvature).

    S. Wiemer and M. Wyss, Bull. Seismol. Soc. Am. 90 (2000) 859-869. The fullest class may be full in part, if the
    least moments lie in it, so that a law begins one class higher: J. Woessner and S. Wiemer, Bull. Seismol. Soc. Am.
    95 (2005) 684-698, doi:10.1785/0120040007.

    Raises
    ------
    Undefined
        If there are none.
    """
    if not len(magnitudes):
        raise Undefined("no episode")
    classes, counts = np.unique(np.floor(magnitudes / CLASS), return_counts=True)
    return float((classes[counts.argmax()] + 1) * CLASS)


def in_classes(magnitudes: np.ndarray, least: float, n_classes: int) -> np.ndarray:
    """How many there are in each class of width `FITTED` from `least` on, shape (n_classes,)."""
    k = np.floor((magnitudes - least) / FITTED + 1e-9).astype(np.int64)
    return np.bincount(k[(k >= 0) & (k < n_classes)], minlength=n_classes)


def laws_of_moments(least: float, mean: float) -> tuple[Family, Family, Family]:
    """Of moments, in the classes of `in_classes`: N(M) ~ 10^(-b M), that with a cut-off, and an exponential.

    All are laws from the first class up to the last one: b is that of a bounded law, which Aki's estimate is not.

    The second holds the others. A class is as wide as its moment m, so a density m^(-1 - b) exp(-lambda m / mean) has
    shares m^-b exp(...).

    Parameters
    ----------
    least : float
        Magnitude at which the first class begins.
    mean : float
        A moment of the order of those that the cut-off acts on.
    """

    def moments(k: np.ndarray) -> np.ndarray:
        return 10.0 ** (least + FITTED * (k - 0.5)) / mean

    def over(p: float) -> float:
        return mean / p if p else np.inf

    return (
        Family("power law", lambda k: np.log(moments(k))[:, None], lambda p: {"b": float(p[0])}),
        Family("cut-off power law", lambda k: np.column_stack([np.log(moments(k)), moments(k)]),
               lambda p: {"b": float(p[0]), "cut-off": over(float(p[1]))}, bounded=(1,)),
        Family("exponential", lambda k: moments(k)[:, None], lambda p: {"mean": over(float(p[0]))},
               base=lambda k: np.log(moments(k))),
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------- quantities


@dataclass(frozen=True)
class Quantity:
    """A statistic of episodes: two sums of a run, and what they come to; `least` is that of `completeness`."""

    sums: Callable[[Catalogue, float], tuple[float, float]]
    of: Statistic = ratio


def _b_value(found: Catalogue, least: float) -> tuple[float, float]:
    """Aki's estimate b = log10(e) / (mean M - least): K. Aki, Bull. Earthq. Res. Inst. 43 (1965) 237-239."""
    above = found.magnitude[found.magnitude >= least] - least
    return _LOG10_E * len(above), float(above.sum())


def _spread(found: Catalogue, _: float) -> tuple[float, float]:
    """Squared deviations of quiet times in units of the run's own mean, and their number."""
    gaps = found.quiet
    if len(gaps) < 2:
        return 0.0, 0.0
    n = len(gaps)
    return float(n / (n - 1) * np.sum((gaps / gaps.mean() - 1.0) ** 2)), float(n)


def _counts(found: Catalogue, _: float) -> tuple[float, float]:
    """Variance and mean of the numbers of episodes in `WINDOWS` windows of equal quiet time, so no dead time."""
    took = np.cumsum(found.duration)
    quiet = found.t_stop - found.t_start - float(found.duration.sum())
    counts = np.histogram(found.start - found.t_start - took + found.duration, WINDOWS, (0.0, max(quiet, 0.0)))[0]
    return float(counts.var(ddof=1)), float(counts.mean())


RATE, SLIP, B_VALUE, QUIET = "rate of episodes", "share of slip in episodes", "b by Aki", "CV of quiet times"
SIZE, OCCUPANCY, BY_WAY, FANO = "mean size", "share of time in episodes", "episodes by block and way", "Fano factor"
WINDOWS = 20  # of a run's quiet time, in which episodes are counted


@dataclass(frozen=True)
class BValue:
    """Aki's b of the episodes from a magnitude on, how many these are, and what a fitted law predicts for it."""

    least: float
    n_episodes: int
    b: Estimate
    predicted: float


#: By name. `QUIET` is the coefficient of variation of quiet times: 1 for a Poisson process.
QUANTITIES: Mapping[str, Quantity] = {
    RATE: Quantity(lambda one, _: (float(len(one.start)), one.t_stop - one.t_start)),
    SIZE: Quantity(lambda one, _: (float(one.size.sum()), float(len(one.start)))),
    "mean duration": Quantity(lambda one, _: (float(one.duration.sum()), float(len(one.start)))),
    B_VALUE: Quantity(_b_value),
    QUIET: Quantity(_spread, lambda sums: np.sqrt(ratio(sums))),
    SLIP: Quantity(lambda one, _: (float(one.moment.sum()), one.slip)),
}
#: Whether the drive is slow and the chain large: then episodes fill little of the time, and come by the belt's way.
#: `FANO` is the variance of counts over their mean: 1 for a Poisson process in windows of any length, as no CV shows.
SLOW_DRIVE: Mapping[str, Quantity] = {
    OCCUPANCY: Quantity(lambda one, _: (float(one.duration.sum()), one.t_stop - one.t_start)),
    BY_WAY: Quantity(lambda one, _: (float(len(one.start)), one.slip)),
    FANO: Quantity(_counts),
}


def b_values(
    runs: Sequence[Sequence[Catalogue]], law: Fit, least: float, fewest: int, confidence: float
) -> list[BValue]:
    """Aki's b from `least` on, and from each multiple of half a magnitude above, while there are `fewest` episodes.

    runs: the catalogues of each system; law: one of `laws_of_moments`, fitted in the classes of `in_classes`.
    """
    of, shares = QUANTITIES[B_VALUE], law.shares()
    found: list[BValue] = []
    for edge in itertools.chain([least], itertools.count(np.ceil(least / B_STEP + 0.5) * B_STEP, B_STEP)):
        sums = np.array([np.sum([of.sums(run, edge) for run in some], axis=0) for some in runs])
        n_above = round(float(sums[:, 0].sum()) / _LOG10_E)
        above = shares[round((edge - least) / FITTED) :]
        if n_above < fewest or not len(above):
            break
        mean = FITTED * float(np.average(np.arange(len(above)) + 0.5, weights=above))
        found.append(BValue(float(edge), n_above, over_matrices(of.of, sums, confidence), _LOG10_E / mean))
    return found


def follows(found: Sequence[BValue], n_systems: int, confidence: float) -> bool:
    """Whether there are two or more, none shown to be off what the law predicts (Bonferroni).

    The first is as predicted where the law was fitted to the same magnitudes.
    """
    if len(found) < 2:
        return False
    dof = n_systems - 1
    wider = half_width(1 - (1 - confidence) / (len(found) - 1), dof) / half_width(confidence, dof)
    return all(
        one.b.value is not None
        and one.b.high is not None
        and abs(one.b.value - one.predicted) <= wider * (one.b.high - one.b.value)
        for one in found[1:]
    )


def drift(sums: np.ndarray) -> np.ndarray:
    """Episodes of the second half over those of the first, less 1; of the sums of `Catalogue.halves`."""
    if (sums[:, 0] == 0).any():
        raise Undefined("no episode in the first half")
    return sums[:, 1] / sums[:, 0] - 1.0
