"""Episodes: how often, how large and how regular they are, and the law of their moments.

The magnitude of an episode is M = log10 |moment|. The sums of runs add over the runs of a system, and every estimate
is a function of sums over systems. All quantities are dimensionless.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats.estimates import Estimate, Statistic, Undefined, over_matrices, ratio
from stickslip.analysis.stats.families import Family, Fit
from stickslip.analysis.stats.student import half_width

B_STEP = 0.5  # between the least magnitudes from which b is shown
CLASS = 0.1  # width of a class of magnitudes, as catalogues round them
ATOM = 0.5  # share of `atom` above which magnitudes have no slope: a b would describe the next ones at most
#: Width of the classes in which laws are fitted. The moment at the middle stands for the class, and the error of that
#: grows with the square of the width: in classes of 0.1 the exponent of 4e5 exponential moments is off by 0.04, with
#: a standard error of 0.03.
FITTED = 0.02
_LOG10_E = math.log10(math.e)


@dataclass(frozen=True)
class Catalogue:
    """Episodes of one run that began on [t_start, t_stop], in order of time.

    Attributes
    ----------
    start, duration, moment : ndarray, shape (m,)
        moment is never zero; it is negative where blocks slip on the whole with the belt, as forces can make them do.
    size : ndarray of int, shape (m,)
    slip : float
        Total slip of all blocks if they slipped as far as the belt travels, n |v| (t_stop - t_start); NaN if v is
        zero or differs between blocks.
    moving : float
        The time in which some block slips, also in episodes that begin before t_start, or do not end.
    carried : ndarray, shape (m,), optional
        How far the belt has carried the blocks when each episode begins, summed over the blocks: their z along its
        motion. Unless given it is not known.
    is_loaded : bool
        Whether loading is adiabatic: durations are then by the clock of the motion, and take no time of the run.
    """

    t_start: float
    t_stop: float
    start: np.ndarray
    duration: np.ndarray
    size: np.ndarray
    moment: np.ndarray
    slip: float
    moving: float = np.nan
    carried: np.ndarray | None = None
    is_loaded: bool = False

    @property
    def travel(self) -> float:
        """The part of `slip` between the begins of the first and the last episode; 0 if these are one, or none."""
        return self.slip * float(np.ptp(self.start)) / (self.t_stop - self.t_start) if len(self.start) else 0.0

    @property
    def slipped(self) -> float:
        """The moments of the episodes but the last, which are the slip in episodes in that time."""
        return float(self.moment[:-1].sum())

    @property
    def stored(self) -> float:
        """What the belt carried the blocks on in that time, which is strain of the springs; NaN if not known."""
        if self.carried is None:
            return np.nan
        return float(self.carried[-1] - self.carried[0]) if len(self.carried) else 0.0

    @property
    def magnitude(self) -> np.ndarray:
        """log10 |moment|, shape (m,)."""
        return np.log10(np.abs(self.moment))

    @property
    def quiet(self) -> np.ndarray:
        """Quiet times, from the end of each episode to the start of the next, shape (m - 1,).

        Times from start to start would contain the durations. Where episodes fill much of the time, this dead time
        would make any process look regular, and any large episode seem to delay the next.
        """
        return np.diff(self.start) if self.is_loaded else self.start[1:] - (self.start + self.duration)[:-1]

    def halves(self) -> np.ndarray:
        """Number of episodes that begin in the first half and in the second, shape (2,)."""
        is_late = self.start >= 0.5 * (self.t_start + self.t_stop)
        return np.bincount(is_late.astype(np.int64), minlength=2).astype(np.float64)


def atom(magnitudes: np.ndarray) -> float:
    """The largest share of magnitudes that lie within the width of a fitted class of each other; 0 of none."""
    if not len(magnitudes):
        return 0.0
    in_order = np.sort(magnitudes)
    n_near = np.searchsorted(in_order, in_order + FITTED, side="right") - np.arange(len(in_order))
    return float(n_near.max() / len(in_order))


def in_classes(magnitudes: np.ndarray, least: float, n_classes: int) -> np.ndarray:
    """Number of magnitudes in each class of width `FITTED` from `least` on, shape (n_classes,)."""
    k = np.floor((magnitudes - least) / FITTED + 1e-9).astype(np.int64)
    return np.bincount(k[(k >= 0) & (k < n_classes)], minlength=n_classes)


def laws_of_moments(least: float, mean: float) -> tuple[Family, Family, Family]:
    """Laws of moments in the classes of `in_classes`: a power law N(M) ~ 10^(-b M), with a cut-off, an exponential.

    The laws are bounded by the first and the last class. Aki's estimate of b, in contrast, assumes no upper bound.

    The second contains the two others. The width of a class is proportional to its moment m, so a density
    m^(-1 - b) exp(-lambda m / mean) has shares m^-b exp(-lambda m / mean).

    Parameters
    ----------
    least : float
        Magnitude at which the first class begins.
    mean : float
        Scale of the cut-off: a moment of the same order.
    """

    def moments(k: np.ndarray) -> np.ndarray:
        return 10.0 ** (least + FITTED * (k - 0.5)) / mean

    return (
        Family("power law", lambda k: np.log(moments(k))[:, None]),
        Family("cut-off power law", lambda k: np.column_stack([np.log(moments(k)), moments(k)]), bounded=(1,)),
        Family("exponential", lambda k: moments(k)[:, None], base=lambda k: np.log(moments(k))),
    )


# ---------------------------------------------------------------------------------------------- quantities


@dataclass(frozen=True)
class Quantity:
    """A statistic of episodes: two sums of a run, from its catalogue and a least magnitude, and their statistic."""

    sums: Callable[[Catalogue, float], tuple[float, float]]
    of: Statistic = ratio


def _b_value(found: Catalogue, least: float) -> tuple[float, float]:
    """Sums of Aki's b = log10(e) / (mean M - least): K. Aki, Bull. Earthq. Res. Inst. 43 (1965) 237-239."""
    above = found.magnitude[found.magnitude >= least] - least
    return _LOG10_E * len(above), float(above.sum())


def _spread(found: Catalogue, _: float) -> tuple[float, float]:
    """Sum of squared deviations of quiet times, in units of the run's own mean, and their number."""
    gaps = found.quiet
    if len(gaps) < 2:
        return 0.0, 0.0
    n = len(gaps)
    return float(n / (n - 1) * np.sum((gaps / gaps.mean() - 1.0) ** 2)), float(n)


RATE, SLIP, B_VALUE, QUIET = "rate of episodes", "share of slip in episodes", "b by Aki", "CV of quiet times"
STORED, CREEP = "share of stored strain", "share of creep"
SIZE, DURATION = "mean size", "mean duration"
OCCUPANCY, BY_WAY = "share of time in episodes", "episodes by block and way"


@dataclass(frozen=True)
class BValue:
    """Aki's b of the episodes from a magnitude on, their number, and the b that a fitted law predicts."""

    least: float
    n_episodes: int
    b: Estimate
    predicted: float


#: By name. `QUIET` is the coefficient of variation of quiet times: 1 for a Poisson process.
QUANTITIES: Mapping[str, Quantity] = {
    RATE: Quantity(lambda one, _: (float(len(one.start)), one.t_stop - one.t_start)),
    SIZE: Quantity(lambda one, _: (float(one.size.sum()), float(len(one.start)))),
    DURATION: Quantity(lambda one, _: (float(one.duration.sum()), float(len(one.start)))),
    B_VALUE: Quantity(_b_value),
    QUIET: Quantity(_spread, lambda sums: np.sqrt(ratio(sums))),
    SLIP: Quantity(lambda one, _: (one.slipped, one.travel)),
}
#: Where the rest of the belt's travel went, which with `SLIP` is all of it: the belt carried the blocks on, which is
#: strain of the springs, or they crept while all counted as stuck, as they cannot by the exact law.
REST: Mapping[str, Quantity] = {
    STORED: Quantity(lambda one, _: (one.stored, one.travel)),
    CREEP: Quantity(lambda one, _: (one.travel - one.slipped - one.stored, one.travel)),
}
#: Quantities that show whether the drive is slow for the chain: episodes then fill little of the time, and their
#: number is proportional to the belt's travel.
SLOW_DRIVE: Mapping[str, Quantity] = {
    OCCUPANCY: Quantity(lambda one, _: (one.moving, one.t_stop - one.t_start)),
    BY_WAY: Quantity(lambda one, _: (float(len(one.start)), one.slip)),
}


def b_values(
    runs: Sequence[Sequence[Catalogue]], law: Fit, least: float, fewest: int, confidence: float
) -> list[BValue]:
    """Aki's b from `least` on, and from every half a magnitude above it with at least `fewest` episodes.

    Parameters
    ----------
    runs : sequence of sequence of Catalogue
        The catalogues of each system.
    law : Fit
        One of `laws_of_moments`, fitted in the classes of `in_classes`.
    """
    quantity, shares = QUANTITIES[B_VALUE], law.shares()
    values: list[BValue] = []
    for edge in itertools.count(least, B_STEP):
        sums = np.array([np.sum([quantity.sums(run, edge) for run in catalogues], axis=0) for catalogues in runs])
        n_above = round(float(sums[:, 0].sum()) / _LOG10_E)
        above = shares[round((edge - least) / FITTED) :]
        if n_above < fewest or not len(above):
            break
        mean = FITTED * float(np.average(np.arange(len(above)) + 0.5, weights=above))
        values.append(BValue(float(edge), n_above, over_matrices(quantity.of, sums, confidence), _LOG10_E / mean))
    return values


def follows(found: Sequence[BValue], n_systems: int, confidence: float) -> bool:
    """Whether there are two or more values of b, none of which is shown to differ from its prediction (Bonferroni).

    The first is not tested: it is as predicted because the law was fitted to the same magnitudes.
    """
    if len(found) < 2:
        return False
    dof = n_systems - 1
    wider = half_width(1 - (1 - confidence) / (len(found) - 1), dof) / half_width(confidence, dof)
    return all(
        value.b.value is not None
        and value.b.high is not None
        and abs(value.b.value - value.predicted) <= wider * (value.b.high - value.b.value)
        for value in found[1:]
    )


def drift(sums: np.ndarray) -> np.ndarray:
    """Number of episodes in the second half over that in the first, minus 1, from sums of `Catalogue.halves`."""
    if (sums[:, 0] == 0).any():
        raise Undefined("no episode in the first half")
    return sums[:, 1] / sums[:, 0] - 1.0
