"""Another way to the zeros of a switching law: by subdivision of the box, from a bound of its second derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from stickslip.sim import IntegrationError
from stickslip.sim.numerics.arguments import Floats, number
from stickslip.workflows.gallery.theory.laws import ON_FACE, Slips, SwitchingLaw


@dataclass(frozen=True, eq=False)
class SmoothLaw(SwitchingLaw):
    """A user's own smooth s, whose zeros are found by subdivision of the box.

    Promise: given that `curvature` bounds every |d2 s_i / dlambda_j dlambda_k| on the box and 1/16 beyond, `zeros`
    returns every zero in the closed box, once, or raises. A cell is discarded when the bound excludes a zero; it is
    decided when Newton-Kantorovich, with the same bound, allows one zero only. A case that is undecided in cells
    `resolution` wide, a zero whose Jacobian is singular or nearly so (|J^-1| above about
    1 / (8 m^2 curvature resolution)), raises IntegrationError. Not promised: anything if the bound is too small, or
    s of order 1e4 (residuals are judged at 1e-12); zeros within 1e-12 of a face may count as on it; the arithmetic
    is rounded, not interval.

    Parameters
    ----------
    s, ds : callables of lambda, shape (m,)
        The resistance, shape (m,), and its slope ds_i / dlambda_j, shape (m, m).
    curvature : float
    size : int
        m.
    resolution : float
        Half-width of the smallest cell.
    """

    s: Callable[[Floats], Floats]
    ds: Callable[[Floats], Floats]
    curvature: float
    size: int
    resolution: float = 1e-6

    def __post_init__(self) -> None:
        if not number("curvature", self.curvature) >= 0:
            raise ValueError(f"curvature: expected a bound >= 0 on the second derivatives of s, got {self.curvature}")
        number("resolution", self.resolution, 0.0, 1.0)

    def resistance(self, lam: Floats) -> Floats:
        return np.asarray(self.s(lam), dtype=np.float64)

    def slope(self, lam: Floats) -> Floats:
        return np.asarray(self.ds(lam), dtype=np.float64)

    def zeros(self, target: Floats, slip: Slips) -> Floats:
        return _subdivide(self, target, slip, self.curvature, self.resolution)


def _subdivide(law: SwitchingLaw, target: Floats, slip: Slips, curvature: float, resolution: float) -> Floats:
    """All zeros of s - target over the free components; see `SmoothLaw` for what is promised."""
    free = np.flatnonzero(slip == 0)
    m, lam = len(free), slip.astype(np.float64)
    if not m:
        return lam[None]
    zeros: list[Floats] = []

    def residual(centre: Floats) -> tuple[Floats, Floats]:
        lam[free] = centre
        return law.resistance(lam)[free] - target[free], law.slope(lam)[np.ix_(free, free)]

    cells = [(np.zeros(m), 1.0)]
    while cells:
        centre, half = cells.pop()
        value, slope = residual(centre)
        if (np.abs(value) > half * np.abs(slope).sum(axis=1) + curvature * (m * half) ** 2 / 2 + ON_FACE).any():
            continue
        try:
            inverse = np.linalg.inv(slope)
        except np.linalg.LinAlgError:
            inverse = None
        # |1 - J(c)^-1 J| on the cell, per half-width; on twice the cell below 1/4 every zero of the cell is unique
        bend = np.inf if inverse is None else np.abs(inverse).sum(axis=1).max() * curvature * m * m * half
        if inverse is not None and bend < 1 / 8:
            if np.abs(inverse @ value).max() <= (1 + bend) * half + ON_FACE:
                zero = _newton(residual, centre)
                if np.abs(zero - centre).max() <= 2 * half and np.abs(residual(zero)[0]).max() < ON_FACE:
                    zeros.append(zero)  # of a cell that holds a zero Newton's method always comes here
        elif half < resolution:
            raise IntegrationError(
                f"zeros of the law near lambda = {centre.round(9).tolist()}: not decided at resolution"
                f" {resolution:g}; an equilibrium there is degenerate or nearly so: move the state, or refine"
            )
        else:
            cells += [(centre + half / 2 * np.array(sign), half / 2) for sign in product((-1.0, 1.0), repeat=m)]
    distinct: list[Floats] = []
    for zero in zeros:  # zeros are unique in cells far wider than this
        if not any(np.abs(zero - neighbour).max() < 1e-10 for neighbour in distinct):
            distinct.append(zero)
    table = np.tile(slip.astype(np.float64), (len(distinct), 1))
    table[:, free] = np.array(distinct).reshape(-1, m)
    return np.clip(table[(np.abs(table) <= 1 + ON_FACE).all(axis=1)], -1.0, 1.0)


def _newton(residual: Callable[[Floats], tuple[Floats, Floats]], lam: Floats) -> Floats:
    """Newton's method from inside the region where Kantorovich's condition holds."""
    for _ in range(30):
        value, slope = residual(lam)
        step = np.linalg.solve(slope, value)
        lam = lam - step
        if np.abs(step).max() < 1e-15:
            break
    return lam
