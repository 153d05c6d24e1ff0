"""Static friction above the kinetic as a smooth function, s(lambda) = lambda + c lambda (1 - lambda^2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from stickslip.sim.numerics.arguments import Floats


def over_kinetic(lam: Floats, c: Floats | float) -> Floats:
    """s: friction over the kinetic, of any shape."""
    return np.asarray(lam + c * lam * (1.0 - lam * lam))


def hidden_term(ratio: ArrayLike) -> Floats:
    """The c with which s has the largest value `ratio`, of any shape."""
    r = np.asarray(ratio, dtype=np.float64)
    return np.asarray(np.where(r == 1.0, 0.0, 3 * r * np.cos(np.arccos(-1 / r) / 3) - 1))


def turning_point(c: ArrayLike) -> Floats:
    """The lambda at which s is largest, by its c, of any shape; 1 without a hidden term."""
    c = np.asarray(c, dtype=np.float64)
    return np.sqrt(np.divide(1 + c, 3 * c, out=np.ones_like(c), where=c > 0.5))
