"""Families of laws of a discrete size: exponential, power law, and both combined; fitted by maximum likelihood.

Every law is conditional on k_min <= size <= k_max: smaller sizes are left out, and no size can exceed k_max, the
number of blocks. All are exponential families, so that the likelihood has one maximum:

    ln P(k) = base(k) - theta . T(k) - ln Z(theta),    score E T - T(k),    information cov T.

==================  ==========================  ====================================
family              weight of k                 T
==================  ==========================  ====================================
exponential         exp(-gamma k)               k
power law           k^-alpha                    ln k
cut-off power law   k^-alpha exp(-lambda k)     ln k, k; lambda >= 0
==================  ==========================  ====================================

The last contains the two others. On maximum likelihood: Clauset, Shalizi and Newman (2009), SIAM Review 51, 661.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stickslip.analysis import arguments
from stickslip.analysis.stats.estimates import Estimate, Undefined, jackknife_estimate

MOST_STEPS, EPS = 100, 1e-13  # steps of Newton's method, which takes about ten; its tolerance in nats a cascade


@dataclass(frozen=True)
class Family:
    """A family of laws.

    Attributes
    ----------
    terms : callable
        T, from sizes of shape (K,) to shape (K, p).
    bounded : tuple of int
        The components of theta that must not be negative.
    base : callable
        From sizes of shape (K,) to shape (K,).
    """

    name: str
    terms: Callable[[np.ndarray], np.ndarray]
    bounded: tuple[int, ...] = ()
    base: Callable[[np.ndarray], np.ndarray] = lambda k: np.zeros(len(k))


EXPONENTIAL = Family("exponential", lambda k: k[:, None])
POWER_LAW = Family("power law", lambda k: np.log(k)[:, None])
CUT_OFF = Family("cut-off power law", lambda k: np.column_stack([np.log(k), k]), bounded=(1,))


@dataclass(frozen=True)
class Fit:
    """A law at the maximum of its likelihood.

    Attributes
    ----------
    theta : ndarray, shape (p,)
    sizes : ndarray, shape (K,), float64
        k_min .. k_max.
    log_likelihood : float
        Of the whole histogram.
    free : list of int
        The components of theta that do not lie on their bound.
    """

    family: Family
    theta: np.ndarray
    sizes: np.ndarray
    log_likelihood: float
    free: list[int]

    def shares(self) -> np.ndarray:
        """P(k) for each size, shape (K,)."""
        return np.exp(log_shares(self.family, self.sizes, self.theta))

    def scores(self) -> np.ndarray:
        """d ln P(k) / d theta of the free components, for each size, shape (K, f)."""
        terms = self.family.terms(self.sizes)[:, self.free]
        return self.shares() @ terms - terms

    def information(self) -> np.ndarray:
        """Fisher information of one cascade on the free components, shape (f, f)."""
        scores = self.scores()
        return (self.shares() * scores.T) @ scores


def log_shares(family: Family, sizes: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """ln P(k) on k_min..k_max, shape (K,)."""
    weights = family.base(sizes) - family.terms(sizes) @ np.asarray(theta, dtype=np.float64)
    above = weights - weights.max()
    return above - np.log(np.exp(above).sum())


def maximise(family: Family, sizes: np.ndarray, counts: np.ndarray) -> Fit:
    """The law of a family at the maximum of its likelihood; a parameter beyond its bound is held there.

    Parameters
    ----------
    sizes, counts : ndarray, shape (K,)
        Sizes k_min .. k_max as float64, and how many cascades have each.

    Raises
    ------
    ValueError
        If a number of cascades is negative or not finite, or there are not as many as sizes.
    Undefined
        If there are no more different sizes than parameters, so that the likelihood has no maximum.
    """
    counts = arguments.counts("counts", counts)
    if counts.shape != np.shape(sizes):
        raise ValueError(
            f"counts: expected one for each of the {len(sizes)} sizes, got shape {counts.shape}; sum over matrices"
        )
    total, n_different = counts.sum(), np.count_nonzero(counts)
    n_parameters = family.terms(sizes).shape[1]
    if n_different <= n_parameters:
        raise Undefined("no cascade" if total == 0 else f"{('one size', 'two sizes')[n_different - 1]} only")
    free = list(range(n_parameters))
    fit = _climb(family, sizes, counts / total, free)
    below = [i for i in family.bounded if fit.theta[i] < 0]
    if below:
        fit = _climb(family, sizes, counts / total, [i for i in free if i not in below])
    return replace(fit, log_likelihood=total * fit.log_likelihood)


def _climb(family: Family, sizes: np.ndarray, shares: np.ndarray, free: list[int]) -> Fit:
    """Maximise the mean log likelihood, which is concave, by Newton's method; the other parameters are zero."""

    def at(theta: np.ndarray) -> Fit:
        return Fit(family, theta, sizes, float(shares @ log_shares(family, sizes, theta)), free)

    fit = at(np.zeros(family.terms(sizes).shape[1]))
    for _ in range(MOST_STEPS):
        score, step = shares @ fit.scores(), np.zeros(len(fit.theta))
        step[free] = np.linalg.solve(fit.information(), score)
        gain, next_fit = score @ step[free], at(fit.theta + step)
        while next_fit.log_likelihood < fit.log_likelihood - EPS:
            step = step / 2
            next_fit = at(fit.theta + step)
        fit = next_fit
        if gain < EPS:
            return fit
    raise Undefined("the maximum of the likelihood was not found")


def parameter(fit: Fit, which: int, counts: np.ndarray, confidence: float) -> Estimate:
    """A parameter with its jackknife-t interval over matrices, leaving out each by one Newton step from the fit.

    It has no interval if it lies on its bound, or if there is one matrix.
    """
    value, n = float(fit.theta[which]), len(counts)
    if which not in fit.free or n < 2:
        return Estimate(value, reason="one matrix" if n < 2 else "on its bound")
    remainder = counts.sum() - counts.sum(axis=1)
    shifts = -np.linalg.solve(fit.information(), fit.scores().T @ counts.T)[fit.free.index(which)] / remainder
    return jackknife_estimate(np.append(value, value + shifts), confidence)
