"""Linear stability of steady sliding: the mode that grows fastest, or decays slowest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.session import numpy_arithmetic
from stickslip.sim.systems.drive import Piecewise
from stickslip.sim.systems.system import CARRIED, System, is_within

#: A growth rate above this counts as positive: rounding moves a double eigenvalue of a matrix of order one by as
#: much.
RATE_ROUNDING = 1e-8


class CriticalMode(NamedTuple):
    """The mode of steady sliding with the largest growth rate.

    Attributes
    ----------
    rate : float
        Its growth rate, the real part of the eigenvalue.
    frequency : float
        Its angular frequency; 0 if it does not swing.
    shape : float64, shape (n,)
        The amplitude of z of each block, the largest of them 1.
    """

    rate: float
    frequency: float
    shape: Floats

    @property
    def is_stable(self) -> bool:
        """Whether no small deviation grows."""
        return self.rate <= RATE_ROUNDING


def steady_matrix(system: System) -> Floats | None:
    """The matrix of small deviations from the state in which all blocks slip at the speeds of their belts, (2n, 2n).

    None where friction depends on the speed of a belt that changes, or a term is not in the matrix.
    """
    moves = system.weakening is not None and isinstance(system.belt_speed, Piecewise)
    if moves or not is_within(CARRIED, system):
        return None
    return system.slip_matrix(system.kinetic_slope(system.belt_speed_at(0.0)))


@numpy_arithmetic()
def critical_mode(system: System) -> CriticalMode | None:
    """The critical mode of the state in which all blocks slip at the speeds of their belts, w = 0.

    Of z'' M + (C + mu'(|v|)) z' + K z = 0, mu' the slope of friction there, by all 2 n eigenvalues. None as
    for `steady_matrix`.
    """
    if (matrix := steady_matrix(system)) is None:
        return None
    rates, modes = np.linalg.eig(matrix)
    size = np.abs(modes[: system.n])
    k = int(np.argmax(rates.real))
    most = size[:, k].max()
    return CriticalMode(float(rates[k].real), float(abs(rates[k].imag)), size[:, k] / (most if most > 0.0 else 1.0))
