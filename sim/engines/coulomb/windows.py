"""What the dense and the sparse loop share: how far a window reaches, and what of it is recorded."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import loop
from stickslip.sim.engines.coulomb.taylor import ORDER_MAX
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.arithmetic import copy

#: A window aims at this many mean lengths: what lies beyond is cut off before it pays.
REACH = 1.2
#: Memory of that mean.
DECAY = 0.9

#: This many instants in a row, each closer to the last than rounding can tell, are an accumulation of events.
STALL = 1000
#: So are as many steps in a row without an event, each below this share of the shortest time scale.
CRAWL = 1e-6

# behind the common clocks: decaying sums for the mean length of a window, time and number of windows cut short
EXPOSURE, CUTS = loop.N_CLOCKS, loop.N_CLOCKS + 1


class Goal(NamedTuple):
    """How far to go, whether the run ends there, how closely, and the fastest rate there is."""

    t_end: float  #: from the start of the piece
    is_last: bool
    tol: float
    rate: float
    bound: float  #: of |z_i| and |w_i|: beyond it Python decides whether the run diverges


class Search(NamedTuple):
    """What the search for events keeps of n blocks, and room to work in."""

    known_mode: NDArray[np.int8]  #: as recorded so far
    initial_mode: NDArray[np.int8]
    reach: Floats  #: how far a block's event function can stray in a step from its tangent at the start
    near: Floats  #: what rounding does to w - v in a step
    poly: Floats
    found: Floats

    @classmethod
    def of(cls, mode: NDArray[np.int8]) -> Search:
        n = len(mode)
        reach, near = np.zeros((2, n))
        return cls(mode.copy(), mode.copy(), reach, near, np.zeros(ORDER_MAX + 1), np.zeros(1))


@inner
def _since(origin, s, i):  # type: ignore[no-untyped-def]
    """From the instant about which block i's series is, to s; without an origin s is counted from there."""
    if origin is None:
        return s
    return s - origin[i]


@inner
def evaluate(series, origin, order, s, z, w):  # type: ignore[no-untyped-def]
    """z and w at an instant; each block's series is about its `origin`, if there is one."""
    n = len(z)
    copy(series[order], z)
    for i in range(n):
        w[i] = order * series[order, i]
    for k in range(order - 1, 0, -1):
        for i in range(n):
            step = _since(origin, s, i)
            z[i] = z[i] * step + series[k, i]
            w[i] = w[i] * step + k * series[k, i]
    for i in range(n):
        z[i] = z[i] * _since(origin, s, i) + series[0, i]


@inner
def sample(series, origin, order, t, t_next, state):  # type: ignore[no-untyped-def]
    """Keep the state at all sample times up to t_next, s being counted from t."""
    samples = state.samples
    k = state.counters[loop.N_SAMPLED]
    while k < len(samples.t) and samples.t[k] <= t_next:
        evaluate(series, origin, order, samples.t[k] - t, samples.z[k], samples.w[k])
        k += 1
    state.counters[loop.N_SAMPLED] = k


@inner
def record(t, mode, known_mode, events, n_recorded):  # type: ignore[no-untyped-def]
    """Write down, by block, which modes are not those known; returns the events recorded, and whether all agree."""
    same = True
    for i in range(len(mode)):
        if mode[i] != known_mode[i]:
            events.t[n_recorded] = t
            events.block[n_recorded] = i
            events.mode[n_recorded] = mode[i]
            known_mode[i] = mode[i]
            n_recorded += 1
        same = same and mode[i] == mode[0]
    return n_recorded, same


@inner
def stalls(counters, moved, least):  # type: ignore[no-untyped-def]
    """Whether too many steps in a row were too short."""
    counters[loop.N_STALLED] = counters[loop.N_STALLED] + 1 if moved <= least else 0
    return counters[loop.N_STALLED] > STALL
