"""The effect of a change relative to that of another matrix: variance components with replicates.

A quantity of matrix i is known from its base run and from replicates: runs of the same matrix from other starts that
have parted from the base. With y_ij = mu + b_i + e_ij, replicates separate the variance of b_i (between matrices)
from that of e_ij (due to the finite window). A changed run c_i of the same matrix has y = mu + b_i + d_i + e_ic.
Squared differences have the expectations

    A  change      (c_i - y_ij)^2    E d^2 + 2 var e
    B  replicates  (y_ij - y_ik)^2           2 var e
    C  redraw      (y_ij - y_kl)^2   2 var b + 2 var e

The effect of the change relative to a redraw is theta = (A - B) / (C - B): 0 for no effect, 1 for that of a fresh
matrix. The estimate may be negative. Its interval is Fieller's, {theta : |(A - B) - theta (C - B)| <= t error}, with
the jackknife error over matrices. It is unbounded where matrices cannot be told apart from replicates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from stickslip.analysis.stats import student
from stickslip.analysis.stats.estimates import Estimate


@dataclass(frozen=True)
class Against:
    """Effect of a change, in units of that of a redraw of the matrix.

    Attributes
    ----------
    theta : Estimate
        (A - B) / (C - B); without an interval if matrices cannot be told apart from replicates.
    change, replicate, redraw : float
        A, B and C.
    """

    theta: Estimate
    change: float
    replicate: float
    redraw: float


def against_redraw(values: np.ndarray, changed: np.ndarray, confidence: float) -> Against:
    """Effect of a change of the matrix relative to a redraw of the matrix.

    Parameters
    ----------
    values : ndarray, shape (G, k)
        Base and replicates; G >= 3, k >= 2.
    changed : ndarray, shape (G, c)
        Changed runs of the same matrices.
    """
    y, c = np.asarray(values, dtype=np.float64), np.asarray(changed, dtype=np.float64)
    g = len(y)
    change = np.mean((c[:, :, None] - y[:, None, :]) ** 2, axis=(1, 2))
    replicate = 2 * y.var(axis=1, ddof=1)
    # mean over pairs of different matrices of (y_ij - y_kl)^2, from first and second moments
    means, second = y.mean(axis=1), (y**2).mean(axis=1)

    def redraw_of(keep: np.ndarray) -> float:
        m = keep.sum()
        cross = (means[keep].sum() ** 2 - np.sum(means[keep] ** 2)) / (m * (m - 1))
        return float(2 * second[keep].mean() - 2 * cross)

    all_units = np.ones(g, dtype=bool)
    but_one = [all_units & (np.arange(g) != i) for i in range(g)]
    a, b, redraw = change.mean(), replicate.mean(), redraw_of(all_units)
    without = np.array([[change[keep].mean(), replicate[keep].mean(), redraw_of(keep)] for keep in but_one])
    top, bottom = a - b, redraw - b
    tops, bottoms = without[:, 0] - without[:, 1], without[:, 2] - without[:, 1]
    covariance = (g - 1) ** 2 / g * np.cov(tops, bottoms)
    t2 = student.half_width(confidence, g - 1) ** 2
    value = float(top / bottom) if bottom > 0 else None
    interval = _fieller(top, bottom, t2 * covariance)
    theta = Estimate(value, *interval) if interval else Estimate(value, reason="matrices cannot be told apart")
    return Against(theta, float(a), float(b), redraw)


def between(values: np.ndarray, errors: np.ndarray, dof: int, confidence: float) -> Estimate:
    """Share of the variance over systems that lies between them, and that longer runs would not reduce.

    It is 1 - 1 / F, with F the variance of the values over their mean squared error; the interval is exact for normal
    values (Fisher 1925), but for what is beyond 0 and 1.

    Parameters
    ----------
    values, errors : ndarray, shape (G,)
        Of each system its value, and the standard error from its own run alone.
    dof : int
        Degrees of freedom of each error.
    """
    g, within = len(values), float(np.mean(errors**2))
    if g < 2 or within == 0:
        return Estimate(reason="no error of one system")
    f, tail = float(values.var(ddof=1)) / within, (1 - confidence) / 2
    quantiles = (1.0, special.fdtri(g - 1, g * dof, 1 - tail), special.fdtri(g - 1, g * dof, tail))
    value, low, high = (1 - quantile / f if f > quantile else 0.0 for quantile in map(float, quantiles))
    return Estimate(value, low, high)


def _fieller(top: float, bottom: float, v: np.ndarray) -> tuple[float, float] | None:
    """Roots of (top - x bottom)^2 = v00 - 2 x v01 + x^2 v11, the ends of the interval; None if it is unbounded."""
    a, b, c = bottom**2 - v[1, 1], top * bottom - v[0, 1], top**2 - v[0, 0]
    if a <= 0 or bottom <= 0:
        return None
    root = np.sqrt(max(b * b - a * c, 0.0))
    return float((b - root) / a), float((b + root) / a)
