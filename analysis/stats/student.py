"""Student's t: half-widths of intervals, and tails.

By the functions that `scipy.stats.t` is made of: a report asks thousands of times, and each time costs a hundredth.
`dof`, the degrees of freedom, is a number > 0, else a ValueError is raised; infinity gives the normal distribution.
"""

from __future__ import annotations

from scipy import special


def half_width(confidence: float, dof: float) -> float:
    """Of the two-sided interval, in standard errors."""
    return quantile(0.5 + confidence / 2, dof)


def quantile(share: float, dof: float) -> float:
    """The t that a share of the distribution lies below."""
    return float(special.stdtrit(_valid(dof), share))


def below(t: float, dof: float) -> float:
    """The share of the distribution that lies below t, any real number."""
    return float(special.stdtr(_valid(dof), t))


def two_sided(t: float, dof: float) -> float:
    """The share that lies as far from 0 as t, or farther: a p-value."""
    return 2 * below(-abs(t), dof)


def _valid(dof: float) -> float:
    if not dof > 0:
        raise ValueError(f"dof: expected degrees of freedom > 0, got {dof!r}")
    return dof
