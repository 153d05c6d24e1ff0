"""The magnitudes of a catalogue: their power law, its range and exponent, and the peak of large events, if any.

The magnitude of an event is M = log10 |moment|. (Carlson and Langer, Phys. Rev. A 40 (1989) 6470, take the natural
logarithm. The exponent b is the same: N(>= m) ~ m^-b for moments m, and N(>= M) ~ 10^(-b M) here.) A model's
catalogue is complete, so no event is missing at the small end: a power law begins where the model's does.

1. A **peak** of large events: the density on M falls and then rises again. Shown if the likelihood that some window
   is emptier than ones of its width below and above it outweighs equality by `RISE`, counts being as dispersed as
   between systems. The peak begins in the middle of the emptiest such window; what is above it is in no fit.
2. The **range**: from the least magnitude at which the distance D of Kolmogorov and Smirnov is small, D < `SMALL`, or
   one that chance gives, D sqrt(n) < `BY_CHANCE` (A. Deluca and A. Corral, Acta Geophys. 61 (2013) 1351), to the
   largest event below the peak. Chance alone would shorten the range as events become more. It spans a `DECADE` and
   `FEWEST` events at least; without one there is no power law. An atom of equal moments at the foot, of single
   blocks, is left out. A declared range is taken as it is, so that b of two catalogues is of the same magnitudes.
3. The **law**: m^-b on that range, times exp(-m / m_c) where the 99% interval of 1 / m_c is above 0, and the range is
   not declared. Vuong's ratio, the mean of the log likelihood over that of a log-normal law or an exponential, is an
   estimate over systems. How well the law fits is said by D with its interval, `misfit`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from stickslip.analysis.models.largest_gap import distance
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Estimate, Undefined, over_matrices, ratio, within
from stickslip.analysis.stats.families import Family, Fit, log_shares, maximise, parameter

#: Width of the classes in which laws are fitted. The moment at the middle stands for the class, and the error of that
#: grows with the square of the width: in classes of 0.1 the exponent of 4e5 exponential moments is off by 0.04, with
#: a standard error of 0.03.
WIDTH = 0.02
DECADE = 1.0  # least width of the range of a power law
FEWEST = enough.LEAST_CASCADES  # least number of events in it
RISE = 15.0  # nats: of some 1,000 windows of a falling density none rises so by chance more often than in 1e-3
WINDOWS = (5, 10, 20, 40)  # widths of windows, in classes
STEP = 5  # classes between ends of the range that are tried
_TURN, _NEWTON = 1e-3, 6  # of b, for a derivative; steps
BY_CHANCE = 0.9  # D sqrt(n), which 92 to 98% of planted catalogues fall below
SMALL = 0.02  # D of a law that fits, however many events there are
TESTS = 5  # by which laws are told from each other: each has that part of the chance to be wrong


class Picture(StrEnum):
    """Which of the field's known pictures a catalogue shows."""

    POWER = "power law"
    CUT_OFF = "power law with a cut-off"
    PEAK = "power law with a peak of large events"
    DECLARED = "slope on the declared range"
    NONE = "no power law"
    OPEN = "open"


@dataclass(frozen=True)
class Magnitudes:
    """What the magnitudes of some systems are like.

    Attributes
    ----------
    picture : Picture
    why : str
        Why there is no power law, or why that is open.
    least, most : float
        The range of the law; NaN without one.
    begins : float or None
        The magnitude at which the peak begins.
    n_fitted : int
        Number of events in the range.
    atom : float
        The share of events with one moment at the foot, of single blocks; 0 if these are not most of the small ones.
    b : Estimate
    cut_off : Estimate
        log10 of m_c; no value where it is not shown to be finite.
    ratios : dict of str to Estimate
        Vuong's ratio of the law over another, in nats an event.
    counts : ndarray, shape (G, K)
        Of each system in the classes of the range.
    """

    picture: Picture
    why: str = ""
    least: float = np.nan
    most: float = np.nan
    begins: float | None = None
    n_fitted: int = 0
    atom: float = 0.0
    b: Estimate = field(default_factory=Estimate)
    cut_off: Estimate = field(default_factory=Estimate)
    ratios: Mapping[str, Estimate] = field(default_factory=dict)
    counts: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    fit: Fit | None = None

    @property
    def has_b(self) -> bool:
        """Whether there is a b: the magnitudes have a power law, or a range is declared."""
        return self.picture in (Picture.POWER, Picture.CUT_OFF, Picture.PEAK, Picture.DECLARED)

    @property
    def law(self) -> int:
        """Which of `laws` is theirs: that with a cut-off only where one is shown."""
        return 1 if self.cut_off.value is None else 0


def laws(least: float, mean: float) -> tuple[Family, Family, Family, Family]:
    """Laws of moments in classes of `WIDTH` from `least` on: with a cut-off, without, log-normal, exponential.

    The first contains the second and the last. The width of a class is proportional to its moment m, so a density
    m^(-1 - b) exp(-lambda m / mean) has shares m^-b exp(-lambda m / mean).

    Parameters
    ----------
    least : float
        Magnitude at which the first class begins.
    mean : float
        Scale of the cut-off: a moment of the same order.
    """

    def moments(k: np.ndarray) -> np.ndarray:
        return 10.0 ** (least + WIDTH * (k - 0.5)) / mean

    def logs(k: np.ndarray) -> np.ndarray:
        return np.log(moments(k))

    return (
        Family("cut-off power law", lambda k: np.column_stack([logs(k), moments(k)])),
        Family("power law", lambda k: logs(k)[:, None]),
        Family("log-normal", lambda k: np.column_stack([logs(k), logs(k) ** 2]), bounded=(1,)),
        Family("exponential", lambda k: moments(k)[:, None], base=logs),
    )


def magnitudes_of(
    systems: Sequence[np.ndarray], confidence: float, declared: tuple[float, float] | None = None
) -> Magnitudes:
    """The picture of the magnitudes of some systems, shape (m_g,) each, by the three steps above.

    `declared` is the range of magnitudes on which b is wanted; by default it is found.
    """
    pooled = np.concatenate([*systems]) if len(systems) else np.zeros(0)
    if len(systems) < enough.LEAST_MATRICES or len(pooled) < FEWEST:
        return Magnitudes(Picture.OPEN, "too few systems or events")
    start, atom = _foot(np.sort(pooled))
    n_classes = int((float(pooled.max()) - start) / WIDTH + 1e-9) + 1
    counts = np.array([in_classes(values, start, n_classes) for values in systems], dtype=np.float64)
    total = counts.sum(axis=0)
    middle = _peak(counts)
    begins = None if middle is None else start + WIDTH * middle
    if declared is not None:
        return replace(_declared(systems, declared, confidence), begins=begins, atom=atom)
    # up to the largest event: given that, the others follow the law below it
    top = int(np.flatnonzero(total if middle is None else total[:middle])[-1])
    first = _range(total[:top], start)
    if first is None:
        why = "their moments span less than a decade" if top * WIDTH < DECADE else "it fits no range of a decade"
        return Magnitudes(Picture.NONE, why, begins=begins, atom=atom)
    magnitudes = _judged(counts[:, first:top], start + WIDTH * first, begins, confidence)
    return replace(magnitudes, atom=atom)


def _declared(systems: Sequence[np.ndarray], limits: tuple[float, float], confidence: float) -> Magnitudes:
    """b of the law without a cut-off on a range that is declared."""
    counts = _within(systems, limits).astype(np.float64)
    try:
        fit = _fitted(counts.sum(axis=0), limits[0], 1)
    except Undefined:
        return Magnitudes(Picture.OPEN, "too few events in the declared range")
    n, b = int(counts.sum()), parameter(fit, 0, counts, confidence)
    if n < FEWEST or b.low is None:
        return Magnitudes(Picture.OPEN, "too few events in the declared range")
    return Magnitudes(Picture.DECLARED, "", *limits, n_fitted=n, b=b, counts=counts, fit=fit)


def _within(systems: Sequence[np.ndarray], limits: tuple[float, float]) -> np.ndarray:
    """Number of magnitudes in the classes of a range, of each system, shape (G, K)."""
    least, most = limits
    return np.array([in_classes(values, least, round((most - least) / WIDTH)) for values in systems])


def in_classes(magnitudes: np.ndarray, least: float, n_classes: int) -> np.ndarray:
    """Number of magnitudes in each class of width `WIDTH` from `least` on, shape (n_classes,)."""
    k = np.floor((magnitudes - least) / WIDTH + 1e-9).astype(np.int64)
    return np.bincount(k[(k >= 0) & (k < n_classes)], minlength=n_classes)


def _foot(ordered: np.ndarray) -> tuple[float, float]:
    """The least magnitude above the atom at the foot, and the share of events in that; the least of all, and 0.

    An atom are equal moments, more than there are in the half decade above them.
    """
    n_equal, n_near = np.searchsorted(ordered, ordered[0] + np.array([WIDTH / 2, DECADE / 2]), side="right")
    is_atom = n_near - n_equal < n_equal < len(ordered)
    return (float(ordered[n_equal]), float(n_equal / len(ordered))) if is_atom else (float(ordered[0]), 0.0)


def _peak(counts: np.ndarray) -> int | None:
    """The class in which a peak begins, the middle of the emptiest window before a rise; None: no rise is shown."""
    n_systems, best, middle = len(counts), RISE, None
    total = counts.sum(axis=0)
    first = int(DECADE / WIDTH)
    for width in WINDOWS:
        if len(total) <= first + 2 * width:
            break
        window = np.lib.stride_tricks.sliding_window_view(total, width).sum(axis=1)
        valley = window[first:-width]
        before = np.maximum.accumulate(window)[first - width : len(valley) + first - width]
        later = np.maximum.accumulate(window[::-1])[::-1][first + width :]
        gain = np.minimum(_gain(before, valley), _gain(later, valley))
        k = int(gain.argmax())
        place = first + k + width + int(window[first + k + width :].argmax())
        of_peak = counts[:, place : place + width].sum(axis=1)
        dispersion = max(1.0, float(of_peak.var(ddof=1) / max(of_peak.mean(), 1.0 / n_systems)))
        if gain[k] / dispersion > best:
            best, middle = float(gain[k]) / dispersion, first + k + width // 2
    return middle


def _gain(full: np.ndarray, empty: np.ndarray) -> np.ndarray:
    """Log likelihood of two Poisson means over that of one for both, where the first count is the larger; else 0."""
    return np.where(full > empty, _nats(full) + _nats(empty) - 2 * _nats((full + empty) / 2), 0.0)


def _nats(n: np.ndarray) -> np.ndarray:
    """n ln n."""
    return n * np.log(np.maximum(n, 1.0))


def _range(total: np.ndarray, start: float) -> int | None:
    """The first class of the range of the law with a cut-off; or None."""
    last = len(total) - int(DECADE / WIDTH)
    for first in (*range(min(STEP, last)), *range(STEP, last + 1, STEP)):
        counts = total[first:]
        if counts.sum() < FEWEST:
            break
        with suppress(Undefined):
            law = _fitted(counts, start + WIDTH * first, 0).shares()
            gap = np.abs(np.cumsum(counts) / counts.sum() - np.cumsum(law)).max()
            if gap < max(SMALL, BY_CHANCE / np.sqrt(counts.sum())):
                return first
    return None


def _fitted(counts: np.ndarray, least: float, law: int) -> Fit:
    sizes = np.arange(1.0, len(counts) + 1)
    mean = float(np.average(10.0 ** (least + WIDTH * (sizes - 0.5)), weights=counts))
    return maximise(laws(least, mean)[law], sizes, counts)


def _judged(counts: np.ndarray, least: float, begins: float | None, confidence: float) -> Magnitudes:
    """The picture of a range, by the intervals of the law's cut-off and exponent, and of its ratios."""
    total = counts.sum(axis=0)
    fit = _fitted(total, least, 0)
    strict = 1 - (1 - confidence) / TESTS
    decay = parameter(fit, 1, counts, strict)
    mean = float(np.average(10.0 ** (least + WIDTH * (fit.sizes - 0.5)), weights=total))
    usual = parameter(fit, 1, counts, confidence)
    cut_off = _cut_off(decay, usual, mean)
    if cut_off.value is None:
        # by the same interval as the name: a law chosen at 95% covers b in 56% of the catalogues in which it is wrong
        fit = _fitted(total, least, 1)
    b = parameter(fit, 0, counts, confidence)
    ratios = {}
    for law in (2, 3):
        with suppress(Undefined):
            other = _fitted(total, least, law)
            more = log_shares(fit.family, fit.sizes, fit.theta) - log_shares(other.family, fit.sizes, other.theta)
            rows = np.column_stack([counts @ more, counts.sum(axis=1)])
            ratios[other.family.name] = over_matrices(ratio, rows, strict)
    picture, why = _named(begins, b, cut_off, decay, ratios)
    most, n = least + WIDTH * len(total), int(total.sum())
    return Magnitudes(picture, why, least, most, begins, n, 0.0, b, cut_off, ratios, counts, fit)


def _named(
    begins: float | None, b: Estimate, cut_off: Estimate, decay: Estimate, ratios: Mapping[str, Estimate]
) -> tuple[Picture, str]:
    """The picture, and why it is none of a power law; the first that applies."""
    for name, estimate in ratios.items():
        if estimate.high is not None and estimate.high < 0:
            return Picture.NONE, f"the {name} law is likelier"
    if b.low is None or b.high is None:
        return Picture.OPEN, "b has no interval"
    if b.high <= 0:
        is_exponential = cut_off.value is not None and b.low <= -1.0 <= b.high
        return Picture.NONE, "they fall off exponentially" if is_exponential else "b is not positive"
    if b.low <= 0:
        return Picture.OPEN, "b may be zero"
    if begins is not None:
        return Picture.PEAK, ""
    if decay.high is not None and decay.high < 0:
        return Picture.NONE, "there are more large events than it has"
    return (Picture.POWER if cut_off.value is None else Picture.CUT_OFF), ""


def _cut_off(strict: Estimate, decay: Estimate, mean: float) -> Estimate:
    """log10 of m_c = mean / lambda, where lambda is shown to be positive."""
    if strict.low is None or strict.low <= 0:
        return Estimate(reason="no cut-off is shown")
    value, low, high = (float(np.log10(mean / (end or np.nan))) for end in (decay.value, decay.high, decay.low))
    return Estimate(value, low, high)


def common_range(catalogues: Iterable[Magnitudes]) -> tuple[float, float] | None:
    """The magnitudes that are in the ranges of all power laws; None if these span less than a `DECADE`.

    Exponents are compared there: that of a law which bends changes with its range, which is found anew in each.
    """
    ranges = [(magnitudes.least, magnitudes.most) for magnitudes in catalogues if magnitudes.has_b]
    least, most = max((low for low, _ in ranges), default=0.0), min((high for _, high in ranges), default=0.0)
    return (least, most) if most - least >= DECADE else None


def b_rows(magnitudes: Magnitudes, systems: Sequence[np.ndarray], limits: tuple[float, float] | None) -> np.ndarray:
    """Sums of each system whose `ratio` is b, on limits or on the range of the law, with its jackknife, shape (G, 2).

    As of numbers whose mean it is, by the influence function of the law without a cut-off: what is compared has one
    law, and whether a cut-off is shown depends on how much is known. Raises `Undefined` if there are fewer than
    `FEWEST` events.
    """
    least, counts = magnitudes.least, magnitudes.counts
    if limits is not None:
        least, counts = limits[0], _within(systems, limits)
    if counts.sum() < FEWEST:
        raise Undefined("too few events")
    fit = _fitted(counts.sum(axis=0).astype(np.float64), least, 1)
    n = counts.sum(axis=1)
    moved = np.linalg.solve(fit.information(), fit.scores().T @ counts.T)[0]
    return np.column_stack([n * fit.theta[0] + moved, n])


def bends(magnitudes: Magnitudes, confidence: float) -> bool:
    """Whether the logarithm of the density is shown to be curved along the range, so that b depends on the range.

    By the interval of the square's coefficient. With many events a law may bend and be close to a power law yet; one
    with a cut-off bends by its law.
    """
    fit, counts = magnitudes.fit, magnitudes.counts
    if fit is None or not magnitudes.has_b or magnitudes.cut_off.value is not None:
        return False
    curved = replace(laws(magnitudes.least, 10.0**magnitudes.least)[2], bounded=())
    try:
        square = parameter(maximise(curved, fit.sizes, counts.sum(axis=0)), 1, counts, 1 - (1 - confidence) / TESTS)
    except Undefined:
        return False
    return square.low is not None and square.high is not None and not square.low <= 0 <= square.high


def by_least(magnitudes: Magnitudes, confidence: float) -> list[tuple[float, int, Estimate]]:
    """b on the upper part of the range, from its least magnitude and from every half above it: (least, events, b)."""
    rows: list[tuple[float, int, Estimate]] = []
    for first in range(0, magnitudes.counts.shape[1] - int(DECADE / 2 / WIDTH), round(0.5 / WIDTH)):
        counts, least = magnitudes.counts[:, first:], magnitudes.least + WIDTH * first
        n = int(counts.sum())
        if n < FEWEST:
            break
        with_b = magnitudes.b
        if first:
            try:
                with_b = parameter(_fitted(counts.sum(axis=0), least, magnitudes.law), 0, counts, confidence)
            except Undefined:
                break
        rows.append((least, n, with_b))
    return rows


def b_positive(magnitudes: Magnitudes, sequences: Sequence[Sequence[np.ndarray]], confidence: float) -> Estimate:
    """b from the magnitudes of the range that are larger than the one before (N. J. van der Elst, JGR 126 (2021)).

    If successive magnitudes are independent, their positive differences have one mean for each b, the range being
    what it is: b by that mean, from the b of the law. Without a value where a cut-off is shown.

    Parameters
    ----------
    sequences : sequence of sequence of ndarray
        The magnitudes of each run of each system, in order of time.
    """
    if (
        magnitudes.fit is None
        or not magnitudes.has_b
        or magnitudes.b.value is None
        or magnitudes.cut_off.value is not None
    ):
        return Estimate(reason=magnitudes.why or "a cut-off is shown")
    inside = [[run[(run >= magnitudes.least) & (run < magnitudes.most)] for run in runs] for runs in sequences]
    steps = [np.concatenate([np.diff(run) for run in runs]) for runs in inside]
    sums = np.array([(step[step > 0].sum(), np.count_nonzero(step > 0)) for step in steps])
    b, n_rises = magnitudes.b.value, sums[:, 1]
    if not n_rises.any():
        return Estimate(reason="no two magnitudes in its range follow each other")
    for _ in range(_NEWTON):
        low, expected, high = (_mean_rise(magnitudes.fit, b + turn) for turn in (-_TURN, 0.0, _TURN))
        moved = (sums[:, 0] - expected * n_rises) * 2 * _TURN / (high - low)
        last, b = b, b + float(moved.sum() / n_rises.sum())
    return over_matrices(ratio, np.column_stack([last * n_rises + moved, n_rises]), confidence)


def _mean_rise(fit: Fit, b: float) -> float:
    """The mean of the positive differences of two magnitudes of a power law on the range of a fit."""
    shares, at = np.exp(log_shares(fit.family, fit.sizes, b * np.eye(len(fit.theta))[0])), WIDTH * fit.sizes
    below = np.cumsum(shares) - shares
    apart = float(shares @ (at * below - np.cumsum(shares * at) + shares * at)) + WIDTH / 6 * float(shares @ shares)
    return 2 * apart  # of half of all pairs


def misfit(magnitudes: Magnitudes, confidence: float, rng: np.random.Generator) -> Estimate:
    """Distance of Kolmogorov and Smirnov between the magnitudes of the range and their law, over systems.

    A system adds to it by its own magnitudes, and by how they move the law. `rng` is for `stats.flips`.
    """
    fit, counts = magnitudes.fit, magnitudes.counts
    if fit is None or not magnitudes.has_b:
        return Estimate(reason=magnitudes.why)
    scores, weights = fit.scores(), counts.sum(axis=1) / counts.sum()
    moved = counts / counts.sum() @ np.linalg.solve(fit.information(), scores.T).T
    slopes = np.cumsum(fit.shares()[:, None] * scores, axis=0)  # of the law's distribution function
    shares = np.cumsum(counts / counts.sum() - weights[:, None] * fit.shares(), axis=1) - moved @ slopes.T
    try:
        return distance(shares, weights, confidence, rng).size
    except Undefined as why:
        return Estimate(reason=str(why))


def shares_between(
    limits: tuple[float, float], systems: Sequence[np.ndarray], confidence: float
) -> tuple[Estimate, Estimate]:
    """The share of events, and of their moment, from one magnitude up to another, over systems."""
    of_events, of_moment = [], []
    for values in systems:
        moments, is_large = 10.0**values, (values >= limits[0]) & (values < limits[1])
        of_events.append((np.count_nonzero(is_large), len(values)))
        of_moment.append((moments[is_large].sum(), moments.sum()))
    events, moment = (
        within(over_matrices(ratio, np.array(rows, dtype=np.float64), confidence), 0.0, 1.0)
        for rows in (of_events, of_moment)
    )
    return events, moment
