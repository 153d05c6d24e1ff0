"""Kernels of the engine `moreau`: steps of fixed length, and what they record."""

from __future__ import annotations

import math
from typing import NamedTuple

from stickslip.sim.engines.course import N_SAMPLED, N_STEPS, Events, State, note_all_stuck_at
from stickslip.sim.kernels.compile import inner, kernel
from stickslip.sim.numerics.arguments import Floats, Ints
from stickslip.sim.numerics.arithmetic import copy, largest
from stickslip.sim.numerics.products import one_product
from stickslip.sim.numerics.sparse import Columns

#: |z| or |w| beyond which a run is not followed: far from any state of a scene, and from overflow.
BEYOND = 1e12


class Model(NamedTuple):
    """What is constant in a run."""

    columns: Columns  #: of K
    damping: Floats
    friction: Floats
    static: Floats
    belt_speed: float


class Work(NamedTuple):
    """Workspace of a step: the state before it, K z in its middle, and the blocks that move."""

    z: Floats
    w: Floats
    middle: Floats
    pull: Floats
    moving: Ints


def whole_steps(span: float, longest: float) -> int:
    """The least number of equal steps of at most that length; rounding of the quotient adds none."""
    return math.ceil(span / longest * (1.0 - 1e-12))


@inner
def step_of(model: Model, z: Floats, w: Floats, h: float, work: Work) -> bool:
    """One step in place; False if the state passed `BEYOND`. A block that ends on the belt has w == v exactly."""
    damping, friction, static, v, n = model.damping, model.friction, model.static, model.belt_speed, len(z)
    middle, pull = work.middle, work.pull
    for i in range(n):
        middle[i] = z[i] + 0.5 * h * w[i]
    one_product(model.columns, middle, pull, work.moving)
    for i in range(n):
        a, b = 1.0 + 0.5 * h * damping[i], h * friction[i]
        free = w[i] - h * (0.5 * damping[i] * w[i] + pull[i]) - a * v  # a (w - v) without friction
        new = v + math.copysign(max(abs(free) - b, 0.0), free) / a
        if w[i] == v and abs(free) <= h * static[i]:
            new = v
        if (w[i] - v) * (new - v) < 0.0 and abs(damping[i] * v + pull[i]) <= static[i]:  # it passes the belt's speed
            new = v
        z[i] += 0.5 * h * (w[i] + new)
        w[i] = new
    return max(largest(z), largest(w)) <= BEYOND


@kernel
def advance(model: Model, work: Work, state: State, h: float, n_steps: int, events: Events) -> tuple[int, bool]:
    """Steps until the end, until the state passes `BEYOND`, or until one more might not fit what is recorded.

    Times are numbers of steps. Returns how many events are recorded, and whether the state is within.
    """
    z, w, mode, v, n = state.z, state.w, state.mode, model.belt_speed, len(state.z)
    samples, counters = state.samples, state.counters
    recorded = 0
    for step in range(counters[N_STEPS], n_steps):
        if recorded + n > len(events.t):
            return recorded, True
        copy(z, work.z)
        copy(w, work.w)
        if not step_of(model, z, w, h, work):
            return recorded, False
        counters[N_STEPS] = step + 1
        n_stick = 0
        for i in range(n):
            new = int(w[i] > v) - int(w[i] < v)
            n_stick += new == 0
            if new != mode[i]:
                events.t[recorded], events.block[recorded] = step + (mode[i] != 0), i
                events.mode[recorded] = new
                mode[i] = new
                recorded += 1
        if n_stick == n:
            note_all_stuck_at(True, step + 1.0, z, events, counters)
        else:
            note_all_stuck_at(False, float(step), work.z, events, counters)
        k = counters[N_SAMPLED]
        while k < len(samples.t) and (step + 1 == n_steps or samples.t[k] <= (step + 1) * h):
            past = min(max(samples.t[k] - step * h, 0.0), h)
            for i in range(n):
                change = w[i] - work.w[i]
                samples.z[k, i] = work.z[i] + past * (work.w[i] + 0.5 * past / h * change)
                samples.w[k, i] = work.w[i] + past / h * change
            k += 1
        counters[N_SAMPLED] = k
    return recorded, True
