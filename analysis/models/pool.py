"""The null of a finite pool, in closed form: n independent blocks that stick and let go at constant rates.

A stuck block lets go at rate 1 - p and a slipping block sticks at rate p = m / n, so that m blocks stick on average;
the unit of time does not matter for cascades by `events`. n_stick is a birth-death chain with a binomial law. At an
exit, J ~ Binomial(n - 1, p) of the other blocks stick (size-biasing), and the next event is an entry with probability

    u(J) = p (n - J) / (p (n - J) + (1 - p) J).

The mean size is 1 / E u(J), so gamma = -log(1 - E u(J)). With x = J - n p and s2 = n p (1 - p), which is the variance
of n_stick,

    u = 1/2 (1 - x / (2 s2) + (1 - 2 p) x^2 / (4 s2^2) + ...),    E x = -p,    E x^2 = s2 + O(1),

so that E u = 1/2 (1 + 1 / (4 s2)), and for large s2

    gamma = ln 2 + 1 / (4 s2),      variance of the sizes = m (m - 1) (1 - 1 / s2)      to first order.

The excess of gamma over ln 2 is thus an effect of counting: relative to ln 2 it is (1 / (4 ln 2)) / s2 = 0.36 / s2,
and it vanishes for large n.

Its cause is that an exit is more likely the more blocks stick. If n_stick neither rises nor falls in the long run, as
many changes go from k + 1 to k as back, so an exit finds one more block sticking than an entry does. The slope of
P(the next change is an exit | n_stick) by least squares over changes is therefore 1 / (4 V), with V the variance of
n_stick before a change, whether or not there is memory or coupling. In the pool, V = (n - 1) p (1 - p) + 1/4
(`slope`).

Which null answers which question:

- fair order, gamma = ln 2: is it like the toss of a coin?
- the pool: does gamma differ from ln 2 by more than the finite number of blocks explains?
- rotation (`nulls.rotated`): do blocks, each with its own rhythm, act on each other?
"""

from __future__ import annotations

import numpy as np
from scipy import special


def _entry_next(n: int, p: float) -> np.ndarray:
    """Probability u(j) that the next event is an entry, if j = 0..n - 1 blocks stick after an exit."""
    j = np.arange(n)
    return p * (n - j) / (p * (n - j) + (1 - p) * j)


def is_one(n: int, mean: float | None) -> bool:
    """Whether such a pool has cascades: it has none with a single block, or if all blocks always stick or slip."""
    return n > 1 and mean is not None and 0 < mean < n


def _others(n: int, p: float) -> np.ndarray:
    """Binomial probability that k = 0..n - 1 of the other n - 1 blocks stick."""
    k, m = np.arange(n), n - 1
    ways = special.gammaln(m + 1) - special.gammaln(k + 1) - special.gammaln(m - k + 1)
    return np.exp(ways + special.xlogy(k, p) + special.xlog1py(m - k, -p))


def gamma(n: int, mean: float) -> float:
    """gamma by `events` of a pool of n blocks, of which `mean` stick on average."""
    return float(-np.log1p(-_others(n, mean / n) @ _entry_next(n, mean / n)))


def slope(n: int, mean: float) -> float:
    """Slope, per block, of P(the next change is an exit | n_stick) in the pool, by least squares over changes."""
    p = mean / n
    return 1 / (1 + 4 * (n - 1) * p * (1 - p))


def law(n: int, mean: float, k_max: int) -> np.ndarray:
    """P(size = k), k = 1..k_max, of the pool's cascades by `events`; it sums to one if k_max = n.

    A cascade begins with an exit that follows an entry. The law of the number of stuck blocks is carried from exit to
    exit: if j blocks stick after one, the next event is an exit, to j - 1, with probability 1 - u(j).
    """
    p = mean / n
    entry = _entry_next(n, p)
    # The chain is reversible: after an entry as many stick as before an exit, J + 1. If an exit follows, it begins a
    # cascade.
    stuck = np.arange(1, n + 1)
    exit_next = (1 - p) * stuck / (p * (n - stuck) + (1 - p) * stuck)
    stuck_then = _others(n, p) * exit_next
    stuck_then /= stuck_then.sum()
    probabilities = np.zeros(k_max)
    for k in range(k_max):
        probabilities[k] = stuck_then @ entry
        stuck_then = np.append((stuck_then * (1 - entry))[1:], 0.0)
    return probabilities
