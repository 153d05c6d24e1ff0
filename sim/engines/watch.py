"""How far blocks that all slip are from a certain collapse: what kernels see for themselves, not asking Python."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.arguments import Floats
from stickslip.sim.engines.compile import inner


class Watch(NamedTuple):
    """The modes of the all-slip system, as `Collapse` has them, and what every |w_i| must stay below by them."""

    inverse: NDArray[np.complex128]  #: T^-1
    sizes: Floats  #: |T_{w_i, j}|, shape (n, 2n)
    rest: Floats
    slip: int  #: the direction in which blocks may slip for ever; 0: in none
    limit: float  #: 0: not known yet
    growth: float

    @classmethod
    def blank(cls, slip: int) -> Watch:
        """Before more than the direction is known."""
        return cls(_NO_INVERSE, _NO_SIZES, _NO_REST, slip, 0.0, 0.0)


_NO_INVERSE, _NO_SIZES, _NO_REST = np.empty((0, 0), np.complex128), np.empty((0, 0)), np.empty(0)


@inner(counts=True)
def too_far(watch, z, w, slip):  # type: ignore[no-untyped-def]
    """After how long to ask again, if no collapse can be certain of this state; else 0. See `Collapse.certify`."""
    if slip != watch.slip:
        return np.inf
    if watch.limit == 0.0:
        return 0.0
    n = len(z)
    sizes = np.empty(2 * n)
    for j in range(2 * n):
        c = 0.0j
        for k in range(n):
            c += watch.inverse[j, k] * (z[k] - watch.rest[k]) + watch.inverse[j, n + k] * w[k]
        sizes[j] = abs(c)
    reach = 0.0
    for i in range(n):
        bound = 0.0
        for j in range(2 * n):
            bound += watch.sizes[i, j] * sizes[j]
        reach = max(reach, bound)
    return 0.25 * math.log(reach / watch.limit) / -watch.growth if reach > watch.limit else 0.0
