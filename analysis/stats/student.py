"""Student's t distribution: half-widths of intervals, quantiles and tails.

They call the functions beneath `scipy.stats.t` at a hundredth of its cost: a report needs thousands of values.
`dof`, the degrees of freedom, must be > 0, else a ValueError is raised; infinity gives the normal distribution.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from stickslip.analysis.arguments import level

_LEAST_Z = 1e-4  # a quotient of quantiles nearer to the middle is that at this one, where rounding does not show


def half_width(confidence: float, dof: float) -> float:
    """Half-width of the two-sided interval, in standard errors."""
    return quantile(0.5 + level(confidence) / 2, dof)


def quantile(share: float, dof: float) -> float:
    """The t below which a given share of the distribution lies."""
    return float(special.stdtrit(_valid(dof), share))


def below(t: float, dof: float) -> float:
    """The share of the distribution that lies below t, any real number."""
    return float(special.stdtr(_valid(dof), t))


def two_sided(t: float, dof: float) -> float:
    """The share that lies at least as far from 0 as t: a two-sided p-value."""
    return 2 * below(-abs(t), dof)


def worth(z: float, dof: Any) -> Any:
    """(z / t)^2, with t as far in the tail as z of the normal distribution: what an error is worth."""
    z = max(z, _LEAST_Z)
    return (z / special.stdtrit(_valid(dof), special.ndtr(-z))) ** 2


def dof_of_scatter(n: int, concentration: Any) -> Any:
    """Degrees of freedom of the variance of n numbers: n - 1 if they are normal, about 2 if one makes all of it.

    Between, by their kurtosis: a variance has the variance (kurtosis - 1) / n of its square.

    Parameters
    ----------
    concentration : float, or ndarray
        The fourth powers of their distances from the mean, summed, over the square of the squares' sum.
    """
    normal = 3.0 * (n - 1) / (n + 1)  # the kurtosis of n normal numbers, on average
    return max(n - 1, 1) / (1.0 + np.maximum(n * concentration - normal, 0.0) / max(normal - 1.0, 0.5))


def _valid(dof: Any) -> Any:
    if not np.all(dof > 0):
        raise ValueError(f"dof: expected degrees of freedom > 0, got {dof!r}")
    return dof
