"""Deviations from a motion whose friction falls with speed, carried along it many at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.kernels.compile import kernel
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.arithmetic import copy

#: Terms of the series of a step.
ORDER = 14


@kernel
def carry(
    pull: Floats, drags: Floats, slips: NDArray[np.bool_], lengths: Floats, moved: Floats, series: Floats
) -> None:
    """Carry deviations (z, w), the columns of `moved`, shape (2n, m), over steps in place, by their Taylor series.

    Of a block that slips, z' = w and w' = A (z, w) - d w; else w' = 0. A is `pull`, shape (n, 2n), and d, by powers
    of the share of a step that is over, `drags`, shape (steps, powers, n). `series` is workspace, shape (ORDER + 1,
    2n, m).
    """
    n, m = len(pull), moved.shape[1]
    for q in range(len(lengths)):
        for i in range(2 * n):
            copy(moved[i], series[0, i])
        for order in range(1, ORDER + 1):
            share, last, term = lengths[q] / order, series[order - 1], series[order]
            for i in range(n):
                z, w = term[i], term[n + i]
                for k in range(m):
                    z[k], w[k] = share * last[n + i, k], 0.0
                for j in range(2 * n if slips[q, i] else 0):
                    factor, there = share * pull[i, j], last[j]
                    for k in range(m if factor != 0.0 else 0):
                        w[k] += factor * there[k]
                for power in range(min(order, drags.shape[1]) if slips[q, i] else 0):
                    factor, there = share * drags[q, power, i], series[order - 1 - power, n + i]
                    for k in range(m):
                        w[k] -= factor * there[k]
                for k in range(m):
                    moved[i, k] += z[k]
                    moved[n + i, k] += w[k]
