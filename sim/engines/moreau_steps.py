"""Kernels of the engine `moreau`: steps of fixed length, and what they record."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from stickslip.sim.engines.arithmetic import largest
from stickslip.sim.engines.compile import inner, kernel
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.moreau import whole_steps
from stickslip.sim.engines.products import one_product
from stickslip.sim.run import IntegrationError, Run, Stats, Stills
from stickslip.sim.series import EventSeries, without_returns

#: |z| or |w| beyond which a run is not followed: far from any state of a scene, and from overflow.
BEYOND = 1e12
_DONE, _STILLS, _SAMPLED, _IS_STILL, _N_COUNTERS = range(5)


@inner
def step_of(law, z, w, h, middle, pull, moving):  # type: ignore[no-untyped-def]
    """One step in place; False if the state passed `BEYOND`. A block that ends on the belt has w == v exactly."""
    columns, damping, friction, static, v = law
    n = len(z)
    for i in range(n):
        middle[i] = z[i] + 0.5 * h * w[i]
    one_product(columns, middle, pull, moving)
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
def _note_still(is_still, step, z, stills, counters):  # type: ignore[no-untyped-def]
    """Keep where the blocks are if from this step on, and not before, all of them stick, or the other way round."""
    counters[_IS_STILL] = is_still
    stills[0, counters[_STILLS]], stills[1, counters[_STILLS]] = step, z.sum()
    counters[_STILLS] += 1


@kernel(counts=True)
def _advance(law, state, grid, samples, events, counters):  # type: ignore[no-untyped-def]
    """Steps until the end, until the state passes `BEYOND`, or until one more might not fit what is recorded."""
    z, w, mode = state
    h, n_steps = grid
    times, sampled_z, sampled_w = samples
    at, block, to, stills = events
    v, n = law[4], len(z)
    middle, pull, moving = np.empty(n), np.empty(n), np.empty(n, dtype=np.int64)
    z_before, w_before = np.empty(n), np.empty(n)
    recorded = 0
    for step in range(counters[_DONE], n_steps):
        if recorded + n > len(at) or counters[_STILLS] + 2 > stills.shape[1]:
            return recorded, True
        z_before[:] = z
        w_before[:] = w
        is_within = step_of(law, z, w, h, middle, pull, moving)
        if not is_within:
            return recorded, False
        counters[_DONE] = step + 1
        n_stick = 0
        for i in range(n):
            new = (w[i] > v) - (w[i] < v)
            n_stick += new == 0
            if new != mode[i]:
                at[recorded], block[recorded], to[recorded] = step + (mode[i] != 0), i, new
                mode[i] = new
                recorded += 1
        if counters[_IS_STILL] and n_stick < n:
            _note_still(0, step, z_before, stills, counters)
        elif n_stick == n and not counters[_IS_STILL]:
            _note_still(1, step + 1, z, stills, counters)
        while counters[_SAMPLED] < len(times) and (
            step + 1 == n_steps or times[counters[_SAMPLED]] <= (step + 1) * h
        ):
            k = counters[_SAMPLED]
            past = min(max(times[k] - step * h, 0.0), h)
            for i in range(n):
                change = w[i] - w_before[i]
                sampled_z[k, i] = z_before[i] + past * (w_before[i] + 0.5 * past / h * change)
                sampled_w[k, i] = w_before[i] + past / h * change
            counters[_SAMPLED] += 1
    return recorded, True


def integrate(task: Task, longest: float) -> Run:
    """Run a task in equal steps of at most that length."""
    system = task.system
    if system.cross_damping is not None:
        raise ValueError('damping: expected its diagonal, all that engine="moreau" takes, got a full matrix')
    n, span = system.n, task.t_end - task.t_start
    n_steps = whole_steps(span, longest)
    h = span / n_steps if n_steps else longest
    law = (system.columns, system.damping, system.friction, system.static, float(system.belt_speed))
    z, w = task.z0.copy(), task.w0.copy()
    mode = np.sign(w - system.belt_speed).astype(np.int8)
    initial_mode = mode.copy()
    samples, counters = task.samples, np.zeros(_N_COUNTERS, dtype=np.int64)
    since_start = samples.t - task.t_start
    n_first = int(np.searchsorted(samples.t, task.t_start, side="right"))
    samples.z[:n_first], samples.w[:n_first], counters[_SAMPLED] = z, w, n_first
    capacity = max(2 * n, 4096)
    at, block, to = np.empty(capacity, np.int64), np.empty(capacity, np.int32), np.empty(capacity, np.int8)
    stills = np.empty((2, capacity))
    if not mode.any():
        stills[:, 0] = 0, z.sum()
        counters[[_IS_STILL, _STILLS]] = 1
    parts = []
    is_within = True
    while counters[_DONE] < n_steps and is_within:
        recorded, is_within = _advance(
            law, (z, w, mode), (h, n_steps), (since_start, samples.z, samples.w),
            (at, block, to, stills), counters,
        )  # fmt: skip
        n_stills = counters[_STILLS]
        kept = (at[:recorded], block[:recorded], to[:recorded], stills[:, :n_stills])
        parts.append(tuple(one.copy() for one in kept))
        counters[_STILLS] = 0
    if not np.isfinite(z).all() or not np.isfinite(w).all():
        raise IntegrationError(f"the state is not finite after t = {task.t_start + counters[_DONE] * h:g}")
    no_events = at[:0], block[:0], to[:0], stills[:, : counters[_STILLS]]
    steps, blocks, modes, noted = (np.concatenate(part, axis=-1) for part in zip(no_events, *parts, strict=True))
    is_first = steps == 0  # what leaves at once does not stick
    initial_mode[blocks[is_first]] = modes[is_first]
    steps, blocks, modes = steps[~is_first], blocks[~is_first], modes[~is_first]
    order = np.lexsort((blocks, steps))  # stable: a block enters before it leaves at the same instant
    reached = task.t_start + int(counters[_DONE]) * h if counters[_DONE] < n_steps else task.t_end
    done = int(counters[_DONE])
    # on the clock of the run until nothing is compared any more
    series = _crossed(EventSeries(steps[order] * h, blocks[order], modes[order], initial_mode, 0.0, span))
    series = without_returns(series, np.zeros(len(series), np.intp), series.t, np.zeros(len(series)))
    series = replace(series, t=np.minimum(task.t_start + series.t, reached), t_start=task.t_start, t_end=reached)
    return Run(
        z=z,
        w=w,
        t_end=reached,
        events=series,
        outcome="finished" if is_within else "diverged",
        reason="" if is_within else f"|z| or |w| passed {BEYOND:g} after t = {reached:.4g}",
        stats=Stats(n_steps=done, n_rejected=0, n_products=done, n_events=len(series)),
        samples=samples.first(int(counters[_SAMPLED])),
        stills=Stills(np.minimum(task.t_start + noted[0] * h, reached), noted[1]),
    )


def _crossed(series: EventSeries) -> EventSeries:
    """A block that ends a step on the belt and leaves to the other side at once has crossed it."""
    order = series.by_block
    block, t, mode = series.block[order], series.t[order], series.mode[order]
    passes = (block[1:] == block[:-1]) & (t[1:] == t[:-1]) & (mode[:-1] == 0)
    passes &= mode[1:] == -series.previous_mode[order][:-1]
    kept = np.ones(len(series), dtype=bool)
    kept[order[:-1][passes]] = False
    return EventSeries(
        series.t[kept], series.block[kept], series.mode[kept], series.initial_mode, series.t_start, series.t_end
    )
