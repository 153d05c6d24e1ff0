"""Kernels of the engine `moreau`: steps of fixed length, and what they record."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines.course import Buffers
from stickslip.sim.kernels.compile import inner, kernel
from stickslip.sim.numerics.arguments import Floats, Ints
from stickslip.sim.numerics.arithmetic import largest
from stickslip.sim.numerics.products import one_product
from stickslip.sim.numerics.sparse import Columns

#: |z| or |w| beyond which a run is not followed: far from any state of a scene, and from overflow.
BEYOND = 1e12
DONE, N_ALL_STUCK, SAMPLED, IS_ALL_STUCK, N_COUNTERS = range(5)


class Model(NamedTuple):
    """What is constant in a run."""

    columns: Columns  #: of K
    damping: Floats
    friction: Floats
    static: Floats
    belt_speed: float


class State(NamedTuple):
    """The state of a run; changed in place."""

    z: Floats
    w: Floats
    mode: NDArray[np.int8]


class Events(NamedTuple):
    """Buffers for events, and for when all blocks come to stick or one leaves, and the sum of z then."""

    step: Ints
    block: NDArray[np.int32]
    mode: NDArray[np.int8]
    all_stuck: Floats  #: shape (2, m)

    def first(self, n: int, n_all_stuck: int) -> Events:
        """A copy of the first events, and the first all-stuck intervals."""
        step, block, mode, all_stuck = self
        return Events(step[:n].copy(), block[:n].copy(), mode[:n].copy(), all_stuck[:, :n_all_stuck].copy())


def whole_steps(span: float, longest: float) -> int:
    """The least number of equal steps of at most that length; rounding of the quotient adds none."""
    return math.ceil(span / longest * (1.0 - 1e-12))


@inner
def step_of(model: Model, z: Floats, w: Floats, h: float, middle: Floats, pull: Floats, moving: Ints) -> bool:
    """One step in place; False if the state passed `BEYOND`. A block that ends on the belt has w == v exactly."""
    damping, friction, static, v, n = model.damping, model.friction, model.static, model.belt_speed, len(z)
    for i in range(n):
        middle[i] = z[i] + 0.5 * h * w[i]
    one_product(model.columns, middle, pull, moving)
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


@inner(counts=True)
def _note_all_stuck_at(is_all_stuck: int, step: int, z: Floats, all_stuck: Floats, counters: Ints) -> None:
    """Keep where the blocks are if from this step on, and not before, all of them stick, or the other way round."""
    counters[IS_ALL_STUCK] = is_all_stuck
    all_stuck[0, counters[N_ALL_STUCK]], all_stuck[1, counters[N_ALL_STUCK]] = step, z.sum()
    counters[N_ALL_STUCK] += 1


@kernel(counts=True)
def advance(
    model: Model, state: State, h: float, n_steps: int, samples: Buffers, events: Events, counters: Ints
) -> tuple[int, bool]:
    """Steps until the end, until the state passes `BEYOND`, or until one more might not fit what is recorded."""
    z, w, mode, v, n = state.z, state.w, state.mode, model.belt_speed, len(state.z)
    times, all_stuck = samples.t, events.all_stuck
    middle, pull, moving = np.empty(n), np.empty(n), np.empty(n, dtype=np.int64)
    z_before, w_before = np.empty(n), np.empty(n)
    recorded = 0
    for step in range(counters[DONE], n_steps):
        if recorded + n > len(events.step) or counters[N_ALL_STUCK] + 2 > all_stuck.shape[1]:
            return recorded, True
        z_before[:] = z
        w_before[:] = w
        is_within = step_of(model, z, w, h, middle, pull, moving)
        if not is_within:
            return recorded, False
        counters[DONE] = step + 1
        n_stick = 0
        for i in range(n):
            new = int(w[i] > v) - int(w[i] < v)
            n_stick += new == 0
            if new != mode[i]:
                events.step[recorded], events.block[recorded] = step + (mode[i] != 0), i
                events.mode[recorded] = new
                mode[i] = new
                recorded += 1
        if counters[IS_ALL_STUCK] and n_stick < n:
            _note_all_stuck_at(0, step, z_before, all_stuck, counters)
        elif n_stick == n and not counters[IS_ALL_STUCK]:
            _note_all_stuck_at(1, step + 1, z, all_stuck, counters)
        while counters[SAMPLED] < len(times) and (step + 1 == n_steps or times[counters[SAMPLED]] <= (step + 1) * h):
            k = counters[SAMPLED]
            past = min(max(times[k] - step * h, 0.0), h)
            for i in range(n):
                change = w[i] - w_before[i]
                samples.z[k, i] = z_before[i] + past * (w_before[i] + 0.5 * past / h * change)
                samples.w[k, i] = w_before[i] + past / h * change
            counters[SAMPLED] += 1
    return recorded, True
