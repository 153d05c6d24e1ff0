"""Laws of a cascade's size: families on k_min..k_max and their maximum of likelihood from a histogram.

Every family is conditional on k_min <= size <= k_max: the sizes below the cut-off are left out, and no size can pass
k_max, the number of blocks. With x = k - k_min the weights w(k), P(k) = w(k) / (sum of w over k_min..k_max), are

==================  =================================================  =========================================
family              w(k)                                               the exponential within it
==================  =================================================  =========================================
exponential         exp(-gamma k)
power law           k^-alpha                                           none
cut-off power law   k^-alpha exp(-lambda k), lambda >= 0               alpha = 0
stretched           S(x) - S(x + 1), S(x) = exp(-(x / tau)^beta)       beta = 1
negative binomial   Gamma(r + x) / x! (m / (m + r))^x                  r = 1 (m: mean of x without truncation)
lognormal           exp(-(ln k - mu)^2 / (2 sigma^2)) / k              none
==================  =================================================  =========================================

Clauset, Shalizi and Newman (2009), SIAM Review 51, 661, set out the rivals of a discrete law and why likelihood is to
be used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import special

from stickslip.analysis.stats.estimates import Undefined

#: Log of the weights: sizes, shape (K,), and internal parameters, shape (p,), to shape (K,).
LogWeights = Callable[[np.ndarray, np.ndarray], np.ndarray]


STEP = 1e-4  # of internal parameters, in differences of the likelihood
FLAT = 0.01  # nats of the whole histogram: a border as near to the maximum as this is where the likelihood runs to


@dataclass(frozen=True)
class Family:
    """A family of laws in internal coordinates, in which its likelihood is well behaved.

    Attributes
    ----------
    name : str
    log_weights : callable
    bounds : tuple of (low, high)
        Of each internal parameter.
    starts : tuple of tuple of float
        Where the search begins; the best end is kept.
    natural : callable
        Internal parameters to the named ones of the table above.
    null : int or None
        Which internal parameter is 0 for the law that it is held against, as a rule the exponential; None if it does
        not hold that.
    borders : mapping of (parameter, side) to str
        What the law becomes where internal parameter i runs to its lower (0) or upper (1) bound.
    """

    name: str
    log_weights: LogWeights
    bounds: tuple[tuple[float, float], ...]
    starts: tuple[tuple[float, ...], ...]
    natural: Callable[[np.ndarray], dict[str, float]]
    null: int | None
    borders: Mapping[tuple[int, int], str]


def _stretched(k: np.ndarray, theta: np.ndarray) -> np.ndarray:
    log_tau, log_beta = theta
    x = k - k[0]
    with np.errstate(over="ignore"):  # a hazard beyond 1e308 is a weight of zero, as it should be
        low, high = ((np.maximum(at, 0.0) * np.exp(-log_tau)) ** np.exp(log_beta) for at in (x, x + 1.0))
        low, high = np.minimum(low, 1e200), np.minimum(high, 1e200)
        return -low + np.log(-np.expm1(-np.maximum(high - low, 1e-300)))


def _negative_binomial(k: np.ndarray, theta: np.ndarray) -> np.ndarray:
    log_m, log_r = theta
    x, r = k - k[0], np.exp(log_r)
    log_q = -np.log1p(np.exp(log_r - log_m))
    return special.gammaln(r + x) - special.gammaln(r) - special.gammaln(x + 1.0) + x * log_q


def _lognormal(theta: np.ndarray) -> dict[str, float]:
    slope, curvature = map(float, theta)  # at curvature = 0, the power law, mu and sigma are infinite
    return {"mu": (1.0 - slope) / (2.0 * curvature), "sigma": (2.0 * curvature) ** -0.5} if curvature else {}


EXPONENTIAL = Family(
    "exponential", lambda k, p: -p[0] * k, ((-50.0, 50.0),), ((0.7,),), lambda p: {"gamma": float(p[0])}, None, {}
)
POWER_LAW = Family(
    "power law", lambda k, p: -p[0] * np.log(k), ((-50.0, 50.0),), ((2.0,),),
    lambda p: {"alpha": float(p[0])}, None, {},
)  # fmt: skip
CUT_OFF = Family(
    "cut-off power law", lambda k, p: -p[0] * np.log(k) - p[1] * k, ((-50.0, 50.0), (0.0, 50.0)),
    ((0.0, 0.7), (2.0, 0.01)), lambda p: {"alpha": float(p[0]), "lambda": float(p[1])}, 0,
    {(1, 0): "power law"},
)  # fmt: skip
STRETCHED = Family(
    "stretched exponential", _stretched, ((-15.0, 15.0), (-3.0, 3.0)), ((0.4, 0.0), (0.0, -1.0), (2.0, 0.5)),
    lambda p: {"tau": float(np.exp(p[0])), "beta": float(np.exp(p[1]))}, 1,
    {(1, 0): "heavier than exponential", (1, 1): "one or two sizes"},
)  # fmt: skip
NEGATIVE_BINOMIAL = Family(
    "negative binomial", _negative_binomial, ((-15.0, 15.0), (-7.0, 9.0)), ((0.0, 0.0), (0.0, -2.0), (1.0, 3.0)),
    lambda p: {"mean": float(np.exp(p[0])), "r": float(np.exp(p[1]))}, 1,
    {(1, 0): "logarithmic series", (1, 1): "Poisson law",
     (0, 1): "unbounded mean"},
)  # fmt: skip
LOGNORMAL = Family(
    "lognormal", lambda k, p: -p[0] * np.log(k) - p[1] * np.log(k) ** 2, ((-80.0, 80.0), (0.0, 80.0)),
    ((1.0, 0.5), (2.0, 0.01)), _lognormal, None, {(1, 0): "power law"},
)  # fmt: skip
RIVALS = (CUT_OFF, STRETCHED, NEGATIVE_BINOMIAL, POWER_LAW, LOGNORMAL)


@dataclass(frozen=True)
class Fit:
    """A law at the maximum of its likelihood.

    Attributes
    ----------
    family : Family
    theta : ndarray, shape (p,)
        Internal parameters.
    sizes : ndarray, shape (K,), float64
        k_min .. k_max.
    log_likelihood : float
        Of the whole histogram.
    border : str
        What the law has run to, if the likelihood grows up to a bound; else empty.
    free : tuple of int
        Internal parameters that do not lie on a bound.
    """

    family: Family
    theta: np.ndarray
    sizes: np.ndarray
    log_likelihood: float
    border: str
    free: tuple[int, ...]

    @property
    def parameters(self) -> dict[str, float]:
        """The named parameters of the family's formula."""
        return self.family.natural(self.theta)

    def __repr__(self) -> str:
        values = ", ".join(f"{name} = {value:.6g}" for name, value in self.parameters.items())
        return f"Fit({self.family.name}: {values}{self.border and f'; {self.border}'})"

    def log_shares(self) -> np.ndarray:
        """ln P(k) for each size, shape (K,)."""
        return log_shares(self.family, self.sizes, self.theta)


def log_shares(family: Family, sizes: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """ln P(k) on k_min..k_max, shape (K,)."""
    weights = family.log_weights(sizes, np.asarray(theta, dtype=np.float64))
    above = weights - weights.max()
    return above - np.log(np.exp(above).sum())


def truncate(histogram: np.ndarray, k_min: int, k_max: int) -> tuple[np.ndarray, np.ndarray]:
    """Sizes k_min..k_max as float64, and the last axis of a histogram cut to them.

    Parameters
    ----------
    histogram : ndarray, shape (..., m)
        [..., k] cascades of size k.
    k_min, k_max : int
        1 <= k_min < k_max.

    Raises
    ------
    ValueError
        If the cut-off is out of range, or a size is larger than k_max.
    """
    if not 1 <= k_min < k_max:
        raise ValueError(f"k_min: expected 1 <= k_min < k_max = {k_max}, got {k_min}")
    counts = np.asarray(histogram)
    if counts[..., k_max + 1 :].any():
        largest = int(np.flatnonzero(counts.reshape(-1, counts.shape[-1]).any(axis=0))[-1])
        raise ValueError(f"k_max: expected at least the largest size, {largest}, got {k_max}")
    kept = np.zeros((*counts.shape[:-1], k_max - k_min + 1))
    seen = counts[..., k_min : k_max + 1]
    kept[..., : seen.shape[-1]] = seen
    return np.arange(k_min, k_max + 1, dtype=np.float64), kept


def maximise(family: Family, sizes: np.ndarray, counts: np.ndarray) -> Fit:
    """Maximum of the likelihood of a family.

    Quasi-Newton from several starts within bounds, then Newton's method on what is not on a bound; then each border
    is tried.

    Parameters
    ----------
    family : Family
    sizes, counts : ndarray, shape (K,)
        As `truncate` gives them.

    Raises
    ------
    Undefined
        If there are fewer than two different sizes: every family then runs to a single size.
    """
    from scipy import optimize  # a tenth of a second to load, and few reports come here

    total = counts.sum()
    if np.count_nonzero(counts) < 2:
        raise Undefined("no cascade" if total == 0 else "one size only")
    shares = counts / total

    def cost(theta: np.ndarray) -> float:
        return -float(np.dot(shares, log_shares(family, sizes, theta)))

    def slope(theta: np.ndarray) -> np.ndarray:
        return np.array([cost(theta + step) - cost(theta - step) for step in STEP * np.eye(len(theta))]) / (2 * STEP)

    found = [
        optimize.minimize(cost, start, jac=slope, method="L-BFGS-B", bounds=family.bounds) for start in family.starts
    ]
    theta = min(found, key=lambda one: one.fun).x
    every = tuple(range(len(theta)))
    at = {i: side for i in every for side in (0, 1) if abs(theta[i] - family.bounds[i][side]) < 1e-9}
    theta = _polish(family, sizes, shares, theta, tuple(i for i in every if i not in at))
    for i, side in family.borders:  # a likelihood may be flat long before the bound
        if i in at:
            continue
        rest = tuple(j for j in every if j != i and j not in at)
        pinned = theta.copy()
        pinned[i] = family.bounds[i][side]
        pinned = _polish(family, sizes, shares, pinned, rest)
        if total * (cost(pinned) - cost(theta)) < FLAT:
            theta, at[i] = pinned, side
    border = "; ".join(family.borders.get(one, "a bound of the search") for one in sorted(at.items()))
    free = tuple(i for i in every if i not in at)
    return Fit(family, theta, sizes, -cost(theta) * total, border, free)


def _polish(
    family: Family, sizes: np.ndarray, shares: np.ndarray, theta: np.ndarray, free: tuple[int, ...]
) -> np.ndarray:
    """Newton's steps on the free parameters for as long as they raise the likelihood."""
    low, high = np.array(family.bounds).T
    best = float(np.dot(shares, log_shares(family, sizes, theta)))
    for _ in range(20):
        score, information = derivatives(family, sizes, theta, free)
        try:
            step = np.linalg.solve(np.tensordot(shares, information, 1), shares @ score)
        except np.linalg.LinAlgError:
            return theta
        moved = theta.copy()
        moved[list(free)] += step
        moved = np.clip(moved, low, high)
        value = float(np.dot(shares, log_shares(family, sizes, moved)))
        if not value > best:
            return theta
        theta, best = moved, value
    return theta


def derivatives(
    family: Family, sizes: np.ndarray, theta: np.ndarray, free: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Score and information of one cascade of each size in the free internal parameters.

    Central differences with steps `STEP` of internal parameters of order one: the score, of order four, errs by some
    1e-12, the information by some 1e-8.

    Returns
    -------
    score : ndarray, shape (K, f)
        d ln P(k) / d theta.
    information : ndarray, shape (K, f, f)
        -d^2 ln P(k) / d theta^2.
    """
    steps = STEP * np.eye(len(theta))[list(free)]

    def at(move: np.ndarray) -> np.ndarray:
        return log_shares(family, sizes, theta + move)

    f = len(free)
    score = np.empty((len(sizes), f))
    information = np.empty((len(sizes), f, f))
    centre = at(np.zeros(len(theta)))
    for i in range(f):
        up, down = at(steps[i]), at(-steps[i])
        score[:, i] = (8 * (up - down) - (at(2 * steps[i]) - at(-2 * steps[i]))) / (12 * STEP)
        information[:, i, i] = -(up - 2 * centre + down) / STEP**2
        for j in range(i):
            mixed = at(steps[i] + steps[j]) - at(steps[i] - steps[j]) - at(steps[j] - steps[i])
            information[:, i, j] = information[:, j, i] = -(mixed + at(-steps[i] - steps[j])) / (4 * STEP**2)
    return score, information
