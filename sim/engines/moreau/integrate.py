"""A run of the engine `moreau`: its steps, and what is recorded of them as a series of events."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.course import (
    IS_ALL_STUCK,
    N_ALL_STUCK,
    N_COUNTERS,
    N_SAMPLED,
    N_STEPS,
    Buffers,
    Events,
    State,
)
from stickslip.sim.engines.moreau.step import BEYOND, Model, Work, advance, whole_steps
from stickslip.sim.numerics.arguments import apart
from stickslip.sim.numerics.sparse import Columns
from stickslip.sim.runs.run import IntegrationError, Run, Stats, Stills
from stickslip.sim.runs.series import EventSeries, part_of, without_returns


def integrate(task: Task, longest: float) -> Run:
    """Run a task in equal steps of at most that length."""
    system = task.system
    n, span = system.n, task.t_end - task.t_start
    n_steps = whole_steps(span, longest)
    h = span / n_steps if n_steps else longest
    if (least := system.least_damping) * h <= -2.0:
        most, step = apart(-2.0 / least, longest)
        raise ValueError(f"step: expected less than {most}, 2 over the most negative damping, got {step}")
    columns, v = Columns.of(system.stiffness), float(system.belt_speed)
    model = Model(columns, system.damping, system.friction, system.static, v)
    z, w = task.z0.copy(), task.w0.copy()
    initial_mode = np.sign(w - system.belt_speed).astype(np.int8)
    samples, counters = task.samples, np.zeros(N_COUNTERS, dtype=np.int64)
    buffers = Buffers(samples.t - task.t_start, samples.z, samples.w)
    n_first = int(np.searchsorted(samples.t, task.t_start, side="right"))
    samples.z[:n_first], samples.w[:n_first], counters[N_SAMPLED] = z, w, n_first
    state = State(z, w, initial_mode.copy(), np.empty(0), counters, buffers)
    z_before, w_before, middle, pull = np.empty((4, n))
    work, events = Work(z_before, w_before, middle, pull, np.empty(n, np.int64)), Events.blank(max(2 * n, 4096))
    if not initial_mode.any():
        events.all_stuck[:, 0] = 0, z.sum()
        counters[[IS_ALL_STUCK, N_ALL_STUCK]] = 1
    parts, is_within, n_done = list[Events](), True, -1
    while n_done < n_steps and is_within:
        n_recorded, is_within = advance(model, work, state, h, n_steps, events)
        parts.append(events.first(n_recorded, int(counters[N_ALL_STUCK])))
        counters[N_ALL_STUCK], n_done = 0, int(counters[N_STEPS])
    if not np.isfinite(z).all() or not np.isfinite(w).all():
        raise IntegrationError(f"the state is not finite after t = {task.t_start + n_done * h:g}")
    steps, blocks, modes, _, noted = Events.joined(parts)
    is_first = steps == 0  # what leaves at once does not stick
    initial_mode[blocks[is_first]] = modes[is_first]
    steps, blocks, modes = steps[~is_first], blocks[~is_first], modes[~is_first]
    order = np.lexsort((blocks, steps))  # stable: a block enters before it leaves at the same instant
    reached = task.t_start + n_done * h if n_done < n_steps else task.t_end
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
        stats=Stats(n_steps=n_done, n_rejected=0, n_products=n_done, n_events=len(series)),
        samples=samples.first(int(counters[N_SAMPLED])),
        stills=Stills(np.minimum(task.t_start + noted[0] * h, reached), noted[1]),
    )


def _crossed(series: EventSeries) -> EventSeries:
    """A block that ends a step on the belt and leaves to the other side at once has crossed it."""
    order = series.by_block
    block, t, mode = series.block[order], series.t[order], series.mode[order]
    passes = (block[1:] == block[:-1]) & (t[1:] == t[:-1]) & (mode[:-1] == 0)
    passes &= mode[1:] == -series.previous_mode[order][:-1]
    is_kept = np.ones(len(series), dtype=bool)
    is_kept[order[:-1][passes]] = False
    return part_of(series, is_kept)
