"""What both ways by series share: their workspace, evaluating series, samples, recorded events, stalls."""

from __future__ import annotations

import math
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

from stickslip.sim.engines import course
from stickslip.sim.engines.coulomb import control
from stickslip.sim.engines.coulomb.control import Goal
from stickslip.sim.engines.coulomb.expansion import Expansion
from stickslip.sim.engines.coulomb.model import Model, coupling
from stickslip.sim.engines.coulomb.overdamped import Slow
from stickslip.sim.engines.course import Events, State
from stickslip.sim.engines.stacks import Stack
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats, Ints
from stickslip.sim.numerics.arithmetic import ROUNDING, copy
from stickslip.sim.numerics.horner import values_and_slopes

#: `sparse.Local`, of a stack of one where an event is a local update; else None.
Near = TypeVar("Near", covariant=True)


@course.by_run("expansion")
class Work(NamedTuple, Generic[Near]):
    """What changes in a run, beside its state."""

    expansion: Expansion
    slow: Slow | None  #: of a stack of one: where blocks are heavily damped
    local: Near


#: Some runs as a stack, and one of them.
Runs: TypeAlias = Stack[Model, Work[Near], Goal[Floats], Ints]
Run: TypeAlias = Stack[Model, Work[Near], Goal[float], int]


@inner
def evaluate(
    expansion: Expansion, v: Floats, origin: Floats | None, order: int, s: float, z: Floats, w: Floats
) -> None:
    """z and w at an instant; each block's series is about its own `origin`, if that is given."""
    mode, steps, values, stuck_z = expansion.mode, expansion.steps, expansion.values, expansion.stuck_z
    for i in range(len(z)):
        steps[i] = s if origin is None else s - origin[i]
    values_and_slopes(expansion.series, order, steps, values)
    for i in range(len(z)):
        z[i], w[i] = values[0, i], values[1, i]
        if mode[i] == 0:
            z[i], w[i] = stuck_z[i] + v[i] * steps[i], v[i]


@inner
def sample(
    expansion: Expansion, v: Floats, origin: Floats | None, order: int, t: float, t_next: float, state: State
) -> None:
    """Record the state at all sample times up to t_next; s is the time since t."""
    samples = state.samples
    k = state.counters[course.N_SAMPLED]
    while k < len(samples.t) and samples.t[k] <= t_next:
        evaluate(expansion, v, origin, order, samples.t[k] - t, samples.z[k], samples.w[k])
        k += 1
    state.counters[course.N_SAMPLED] = k


@inner
def touch(model: Model, series: Floats, i: int, before: int, mode: int, error: float) -> float:
    """As of `course.touch`, at an event of block i, about which its series now is.

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
    return course.touch(before, mode, slope, braked, pull, control.TOLD * error)


@inner
def note(run: Run[Any], events: Events, n_recorded: int) -> tuple[int, bool]:
    """Record the modes that have changed; returns how many events are recorded, and whether all modes agree."""
    work, state = run.work, run.state
    clock, counters, mode, known_mode = state.clock, state.counters, state.mode, work.expansion.known_mode
    if counters[course.N_STEPS] == 0:
        copy(mode, work.expansion.initial_mode)
        copy(mode, known_mode)
    before, same = n_recorded, True
    for i in range(len(mode)):
        if mode[i] != known_mode[i]:
            n_recorded = record(run, (i, known_mode[i]), clock[course.ERROR], events, n_recorded)
        same = same and mode[i] == mode[0]
    if n_recorded > before:
        course.note_event(clock, counters)
    course.note_all_stuck_at(same and mode[0] == 0, clock[course.TIME], state.z, events, counters)
    return n_recorded, same


@inner
def record(run: Run[Any], change: tuple[int, int], error: float, events: Events, n_recorded: int) -> int:
    """Record an event now: a block, and its mode before. Returns how many events are recorded."""
    (block, before), expansion = change, run.work.expansion
    new = expansion.mode[block]
    events.t[n_recorded] = run.state.clock[course.TIME]
    events.block[n_recorded] = block
    events.mode[n_recorded] = new
    events.touch[n_recorded] = touch(run.model, expansion.series, block, before, new, error)
    expansion.known_mode[block] = new
    return n_recorded + 1


@inner
def instant(goal: Goal[float], t: float) -> float:
    """The distance at which rounding cannot tell two times near t apart."""
    return ROUNDING * max(min(1.0, goal.t_end), t)


@inner
def stalls(goal: Goal[float], counters: Ints, length: float, t: float, is_without_event: bool) -> bool:
    """Whether too many steps in a row were too short; the last one, at t, had this length."""
    least = instant(goal, t)
    if is_without_event and goal.rate > 0.0:
        # rounding can also make touches of a block that feels one far larger than itself: an end, but no event
        least = max(least, control.CRAWL / goal.rate)
    counters[course.N_STALLED] = counters[course.N_STALLED] + 1 if length <= least else 0
    return counters[course.N_STALLED] > control.STALL
