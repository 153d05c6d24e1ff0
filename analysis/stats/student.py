"""Student's t distribution: half-widths of intervals, quantiles and tails.

They call the functions beneath `scipy.stats.t` at a hundredth of its cost: a report needs thousands of values.
`dof`, the degrees of freedom, must be > 0, else a ValueError is raised; infinity gives the normal distribution.
"""

from __future__ import annotations

from scipy import special

from stickslip.analysis.stats.arguments import level


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


def _valid(dof: float) -> float:
    if not dof > 0:
        raise ValueError(f"dof: expected degrees of freedom > 0, got {dof!r}")
    return dof
