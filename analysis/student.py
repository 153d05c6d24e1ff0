"""Student's t: half-widths of intervals, and tails.

By the functions that `scipy.stats.t` is made of: a report asks thousands of times, and each time costs a hundredth.
"""

from __future__ import annotations

from scipy import special


def half_width(confidence: float, dof: float) -> float:
    """Of the two-sided interval, in standard errors."""
    return quantile(0.5 + confidence / 2, dof)


def quantile(share: float, dof: float) -> float:
    """The t that a share of the distribution lies below."""
    return float(special.stdtrit(dof, share))


def below(t: float, dof: float) -> float:
    """The share of the distribution that lies below t."""
    return float(special.stdtr(dof, t))


def two_sided(t: float, dof: float) -> float:
    """The share that lies as far from 0 as t, or farther: a p-value."""
    return 2 * below(-abs(t), dof)
