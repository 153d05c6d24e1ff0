"""Tests by flipping signs: if there is no effect, the contribution of each system is as likely with either sign.

All 2^n patterns of signs of n systems are tried where they are at most `PATTERNS`, and else so many random ones.
With few systems the least possible p-value, the floor, is far above zero: 2 / 2^n for a statistic without sign.
A p-value at its floor says that nothing more extreme could have been seen, and not how extreme it is.
"""

from __future__ import annotations

import numpy as np

PATTERNS = 10_000  # an error of 0.2 points on a p-value of 0.05


def patterns(n: int, rng: np.random.Generator) -> np.ndarray:
    """Signs of n systems, shape (m, n), one row a pattern; the first row is as observed, without a flip."""
    if 2**n <= PATTERNS:
        bits = np.arange(2**n)[:, np.newaxis] >> np.arange(n) & 1
        return 1.0 - 2.0 * bits
    signs = rng.choice([-1.0, 1.0], (PATTERNS, n))
    signs[0] = 1.0
    return signs


def floor(n: int) -> float:
    """The least possible p-value of n systems: two patterns of signs give the most extreme statistic."""
    return max(2 / 2**n, 1 / PATTERNS)


def p_value(values: np.ndarray, least: float) -> float:
    """Share of the values that are as large as the first, up to rounding, but no less than the `floor`.

    Parameters
    ----------
    values : ndarray, shape (m,)
        A statistic under each of `patterns`.
    """
    share = float(np.mean(values >= values[0] - 1e-12 * abs(values[0])))
    return max(share, least)


def suffice(n: int, confidence: float) -> bool:
    """Whether the `floor` of n systems is as low as a test at a level of confidence needs."""
    return n >= 1 + int(np.ceil(-np.log2(1.0 - confidence)))
