"""What both ways by series share: their workspace, evaluating series, samples, recorded events, stalls."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import loop
from stickslip.sim.engines.coulomb import control
from stickslip.sim.engines.coulomb.model import coupling
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.arithmetic import ROUNDING, copy
from stickslip.sim.numerics.horner import values_and_slopes


class Goal(NamedTuple):
    """What a piece is run to: its end, the tolerance, and bounds. Of a stack: arrays of what is each run's own."""

    t_end: float | Floats  #: from the start of the piece
    is_last: bool
    instant: float  #: none: -1
    tol: float | Floats
    rate: float | Floats  #: bounds |eigenvalues|
    decay: float | Floats  #: the rate at which errors fade, at least
    bound: float | Floats  #: of |z_i| and |w_i|; beyond it Python decides whether the run diverges


@loop.by_run("known_mode", "initial_mode")
class Search(NamedTuple):
    """The modes recorded so far, and the workspace of the search for events, for n blocks."""

    known_mode: NDArray[np.int8]  #: as recorded so far
    initial_mode: NDArray[np.int8]
    reach: Floats  #: how far a block's event function can deviate in a step from its tangent at the start
    near: Floats  #: the rounding of w - v in a step
    poly: Floats
    found: Floats

    @classmethod
    def of(cls, mode: NDArray[np.int8]) -> Search:
        """Of a stack, whose workspace is shared; `mode` has shape (m, n)."""
        reach, near = np.empty((2, mode.shape[-1]))
        return cls(mode.copy(), mode.copy(), reach, near, np.empty(control.ORDER_MAX + 1), np.empty(1))


@inner
def evaluate(expansion, v, origin, order, s, z, w):  # type: ignore[no-untyped-def]
    """z and w at an instant; each block's series is about its own `origin`, if that is given."""
    mode, steps, values, held = expansion.mode, expansion.steps, expansion.values, expansion.held
    for i in range(len(z)):
        steps[i] = s if origin is None else s - origin[i]
    values_and_slopes(expansion.series, order, steps, values)
    for i in range(len(z)):
        z[i], w[i] = values[0, i], values[1, i]
        if mode[i] == 0:
            z[i], w[i] = held[i] + v[i] * steps[i], v[i]


@inner
def sample(expansion, v, origin, order, t, t_next, state):  # type: ignore[no-untyped-def]
    """Record the state at all sample times up to t_next; s is the time since t."""
    samples = state.samples
    k = state.counters[loop.N_SAMPLED]
    while k < len(samples.t) and samples.t[k] <= t_next:
        evaluate(expansion, v, origin, order, samples.t[k] - t, samples.z[k], samples.w[k])
        k += 1
    state.counters[loop.N_SAMPLED] = k


@inner
def touch(model, series, i, before, mode, error):  # type: ignore[no-untyped-def]
    """As of `loop.touch`, at an event of block i, about which its series now is.

    With a static friction above the kinetic a change of mode may last any time: a touch sticks there, until F has
    gone from the kinetic to the static.
    """
    if model.static[i] > model.friction[i]:
        return 0.0
    damping, friction, c1, c2 = model.damping[i], model.friction[i], series[1, i], series[2, i]
    if mode == 0:  # it is the series of F - R v
        slope, braked = c1, damping * model.belt_speed[i] + series[0, i] + before * friction
    else:
        slope, braked = 6.0 * series[3, i] + 2.0 * damping * c2, 2.0 * c2 + (mode - before) * friction
    pull, drag = model.row_sums[i], coupling(model.cross, i)
    if drag > 0.0:
        pull = (math.sqrt(pull) + drag) ** 2
    return loop.touch(before, mode, slope, braked, pull, control.TOLD * error)


@inner
def note(model, work, goal, state, events, n_recorded):  # type: ignore[no-untyped-def]
    """Record the modes that have changed; returns how many events are recorded, and whether all modes agree."""
    clock, counters, mode, known_mode = state.clock, state.counters, state.mode, work.search.known_mode
    if counters[loop.N_STEPS] == 0:
        copy(mode, work.search.initial_mode)
        copy(mode, known_mode)
    before, same = n_recorded, True
    for i in range(len(mode)):
        if mode[i] != known_mode[i]:
            n_recorded = record(model, work, clock, (i, known_mode[i]), clock[loop.ERROR], events, n_recorded)
        same = same and mode[i] == mode[0]
    if n_recorded > before:
        loop.note_event(clock, counters)
    loop.note_all_stuck_at(same and mode[0] == 0, clock[loop.TIME], state.z, events, counters)
    return n_recorded, same


@inner
def record(model, work, clock, change, error, events, n_recorded):  # type: ignore[no-untyped-def]
    """Record an event now: a block, and its mode before. Returns how many events are recorded."""
    (block, before), mode = change, work.expansion.mode
    events.t[n_recorded] = clock[loop.TIME]
    events.block[n_recorded] = block
    events.mode[n_recorded] = mode[block]
    events.touch[n_recorded] = touch(model, work.expansion.series, block, before, mode[block], error)
    work.search.known_mode[block] = mode[block]
    return n_recorded + 1


@inner
def instant(goal, t):  # type: ignore[no-untyped-def]
    """The distance at which rounding cannot tell two times near t apart."""
    return ROUNDING * max(min(1.0, goal.t_end), t)


@inner
def stalls(goal, counters, moved, t, is_without_event):  # type: ignore[no-untyped-def]
    """Whether too many steps in a row were too short; the last one, at t, had the length `moved`."""
    least = instant(goal, t)
    if is_without_event and goal.rate > 0.0:
        # rounding can also make touches of a block that feels one far larger than itself: an end, but no event
        least = max(least, control.CRAWL / goal.rate)
    counters[loop.N_STALLED] = counters[loop.N_STALLED] + 1 if moved <= least else 0
    return counters[loop.N_STALLED] > control.STALL
