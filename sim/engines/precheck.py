"""The pre-check of collapse: kernels see for themselves that a state is too far out to be certified."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats


class Precheck(NamedTuple):
    """The eigenmodes of the all-slip system, as `Collapse` has them, and the bound that |w_i| must stay below."""

    inverse: Floats  #: T^-1, its real and imaginary parts: complex numbers take a second to compile
    sizes: Floats  #: |T_{w_i, j}|, shape (n, 2n)
    rest: Floats
    slip: int  #: the direction in which blocks may slip for ever; 0: in none
    limit: float  #: that bound; 0: not known yet
    growth: float
    cost: float  #: of a certificate, in products; 0: it is asked for whenever it may be had
    room: Floats  #: shape (2n,)

    @classmethod
    def blank(cls, slip: int, cost: float) -> Precheck:
        """Before more than the direction is known, and what a certificate costs."""
        return cls(_NO_INVERSE, _NO_SIZES, _NO_ROW, slip, 0.0, 0.0, cost, _NO_ROW)

    @classmethod
    def of(
        cls, inverse: NDArray[np.complex128], sizes: Floats, rest: Floats, slip: int, limit: float, growth: float
    ) -> Precheck:
        """With all that is known: T^-1, and the rest as the attributes have it."""
        return cls(
            np.array([inverse.real, inverse.imag]), sizes, rest, slip, limit, growth, 0.0, np.empty(len(inverse))
        )


_NO_INVERSE, _NO_SIZES, _NO_ROW = np.empty((2, 0, 0)), np.empty((0, 0)), np.empty(0)


@inner
def too_far(precheck: Precheck, z: Floats, w: Floats) -> float:
    """The time after which to ask again if no collapse can be certified of this state, else 0; see `Collapse`."""
    if precheck.limit == 0.0:
        return 0.0
    inverse, rest, sizes, n = precheck.inverse, precheck.rest, precheck.room, len(z)
    for j in range(2 * n):
        real, imaginary = 0.0, 0.0
        for k in range(n):
            real += inverse[0, j, k] * (z[k] - rest[k]) + inverse[0, j, n + k] * w[k]
            imaginary += inverse[1, j, k] * (z[k] - rest[k]) + inverse[1, j, n + k] * w[k]
        sizes[j] = math.hypot(real, imaginary)
    reach = 0.0
    for i in range(n):
        bound = 0.0
        for j in range(2 * n):
            bound += precheck.sizes[i, j] * sizes[j]
        reach = max(reach, bound)
    return 0.25 * math.log(reach / precheck.limit) / -precheck.growth if reach > precheck.limit else 0.0
