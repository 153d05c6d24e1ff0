"""Episodes: how often, how large and how regular they are, and the law of their moments.

The magnitude of an episode is M = log10 of the size of its moment. Sums of runs add over the runs of a system; what
is estimated is a function of sums over systems, as everywhere here. Dimensionless.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats.estimates import Statistic, Undefined, ratio
from stickslip.analysis.stats.families import Family

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
    """

    t_start: float
    t_stop: float
    start: np.ndarray
    duration: np.ndarray
    size: np.ndarray
    moment: np.ndarray
    slip: float

    @property
    def magnitude(self) -> np.ndarray:
        """log10 of the sizes of the moments, shape (m,)."""
        return np.log10(np.abs(self.moment))

    def halves(self) -> np.ndarray:
        """How many begin in the first and in the second half, shape (2,)."""
        late = int(np.count_nonzero(self.start >= 0.5 * (self.t_start + self.t_stop)))
        return np.array([len(self.start) - late, late], dtype=np.float64)


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


def _recurrence(found: Catalogue, _: float) -> tuple[float, float]:
    """Squared deviations of recurrence times in units of the run's own mean, and their number."""
    gaps = np.diff(found.start)
    if len(gaps) < 2:
        return 0.0, 0.0
    n = len(gaps)
    return float(n / (n - 1) * np.sum((gaps / gaps.mean() - 1.0) ** 2)), float(n)


RATE, SLIP, B_VALUE, RECURRENCE = "rate of episodes", "share of slip in episodes", "b", "recurrence"
#: By name. `RECURRENCE` is the coefficient of variation of the times from start to start: 1 for a Poisson process.
QUANTITIES: Mapping[str, Quantity] = {
    RATE: Quantity(lambda one, _: (float(len(one.start)), one.t_stop - one.t_start)),
    "mean size": Quantity(lambda one, _: (float(one.size.sum()), float(len(one.start)))),
    "mean duration": Quantity(lambda one, _: (float(one.duration.sum()), float(len(one.start)))),
    B_VALUE: Quantity(_b_value),
    RECURRENCE: Quantity(_recurrence, lambda sums: np.sqrt(ratio(sums))),
    SLIP: Quantity(lambda one, _: (float(one.moment.sum()), one.slip)),
}


def drift(sums: np.ndarray) -> np.ndarray:
    """Episodes of the second half over those of the first, less 1; of the sums of `Catalogue.halves`."""
    if (sums[:, 0] == 0).any():
        raise Undefined("no episode in the first half")
    return sums[:, 1] / sums[:, 0] - 1.0
