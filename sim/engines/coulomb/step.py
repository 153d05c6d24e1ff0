"""The exact engine: set-valued Coulomb friction, event by event, Taylor series between events.

Between events a sticking block moves with the belt (z linear in t: nothing to integrate) and a slipping one obeys
a linear equation: `stickslip.sim.engines.coulomb.taylor` expands them all. The next event is the first root of

    sigma (w - v)     of a slipping block,
    m + sigma F       of a sticking one, F = R v + K z = -mu lambda, for either sigma;

m is the static friction, mu if no other is given.

At an event every block with w = v is decided anew from |F| and m. Where the two are equal, as at every exit, the
first coefficient of F that does not vanish decides, order by order, while the series is built. Until a block is
decided its motion is the same in either mode, so simultaneous events, folds, cusps and tangencies of any order need
no special cases.

An event changes the equation of one block. That block's own series changes from the second order on, those of the
others from the fourth, by a column of K: `taylor.correct` carries most events over in O(n) an order, and one
expansion serves a window of several events.

The series are explicit: R h is about 5 at most. Blocks with far larger R are followed on their slow motion, once they
have reached it: `stickslip.sim.engines.coulomb.overdamped`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import loop
from stickslip.sim.engines.coulomb import control
from stickslip.sim.engines.coulomb.events import enclose, excluded, root
from stickslip.sim.engines.coulomb.model import Model, model_of
from stickslip.sim.engines.coulomb.overdamped import follow
from stickslip.sim.engines.coulomb.sticking import force_rounding, known, push
from stickslip.sim.engines.coulomb.taylor import Expansion, Window, correct, error_after, expand, expansion_of, shift
from stickslip.sim.engines.coulomb.windows import (
    Goal,
    Search,
    evaluate,
    goal_of,
    record,
    sample,
    search_of,
    stalls,
)
from stickslip.sim.engines.precheck import precheck_of
from stickslip.sim.engines.stacks import note_found, rest_of
from stickslip.sim.kernels.compile import inner, kernel
from stickslip.sim.numerics.arithmetic import ROUNDING, copy, largest


@inner
def _first_event(model, expansion, search, order, h):  # type: ignore[no-untyped-def]
    """Time to the first root of any event function within h, and its block; (h, -1) if there is none."""
    series, mode, room = expansion.series, expansion.mode, (search.poly, search.found)
    zeros, side, reach = expansion.zeros, expansion.side, search.reach
    damping, static, closed, v = model.damping, model.static, model.closed, model.belt_speed
    enclose(series, expansion.slips, order, h, reach, len(mode))
    block = -1
    for i in range(len(mode)):
        face, first = (mode[i], zeros[i], side[i]), (series[0, i], series[1, i], series[2, i])
        bounds = v[i], damping[i] * v[i], static[i], closed[i]
        if excluded(face, first, bounds, h, reach[i]):
            continue
        h, is_found = root(face, series, i, bounds, (order, h), room)
        block = i if is_found else block
    return h, block


@inner
def _on_the_edge(model, expansion, near, z_max, w, block, order, step, has_forces):  # type: ignore[no-untyped-def]
    """Mark the slipping blocks with w = v up to rounding; returns how many blocks this instant concerns.

    Of them, with a static friction above the kinetic, a block that has just left goes on: w' is the difference of the
    two then, and at most 0 if it comes. The instant is a `step` into the series. If the forces at it are known,
    sticking blocks with |F| = m count too.
    """
    v, mode, touching, series = model.belt_speed, expansion.mode, expansion.touching, expansion.series
    count = 0
    for i in range(len(mode)):
        touching[i] = mode[i] != 0 and mode[i] * (w[i] - v[i]) <= near[i]
        jump = model.static[i] - model.friction[i]
        if touching[i] and jump > 0.0:
            w_dot = 0.0
            for k in range(order, 1, -1):
                w_dot = w_dot * step + k * (k - 1) * series[k, i]
            expansion.leaves[i] = mode[i] if mode[i] * w_dot > 0.5 * jump else 0
        concerned = touching[i] or i == block
        if mode[i] == 0 and has_forces:
            force = model.damping[i] * v[i] + series[0, i]
            noise = known(model.forcing, 0, i)
            slack = force_rounding(model.damping[i] * v[i], model.row_sums[i] * z_max, model.static[i], noise)
            concerned = concerned or push(model.closed[i], force) >= model.static[i] - slack
        count += concerned
    if block >= 0:
        touching[block] = mode[block] != 0
    return count


@inner
def _advance(model, goal, state, expansion, search, slow, events, precheck):  # type: ignore[no-untyped-def]
    """Take steps until the end, or until Python has something to do; a second call goes on from there.

    A window is the time over which one expansion holds. An event in it is carried over by `correct` where that is
    possible, else it ends the window.
    """
    t_end, rate, v = goal.t_end, goal.rate, model.belt_speed
    z, w, mode, clock, counters = state.z, state.w, state.mode, state.clock, state.counters
    series, touching, near = expansion.series, expansion.touching, search.near
    n = len(z)
    n_recorded = 0
    is_open, is_cut, is_slow = False, False, False
    order, h, span, allowed, age, error = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    n_left = loop.STEPS_A_SLICE
    while n_left > 0:
        n_left -= 1
        if n_recorded + n > len(events.t):
            return loop.BUFFER_FULL, n_recorded
        t = clock[loop.TIME]
        remaining = t_end - t
        if remaining <= 0.0 and not goal.is_last:
            return loop.DONE, n_recorded  # the next piece decides which blocks stick from here on
        if not is_open:
            target = control.next_window(clock, remaining)
            order, h, allowed, n_products = follow(slow, model, expansion, goal, state, target)
            counters[loop.N_PRODUCTS] += n_products
            is_slow = order > 0
            if not is_slow:
                target = min(target, control.SPAN / rate) if rate > 0.0 else target
                order, h, allowed, n_products = expand(model, expansion, goal, state, target)
                counters[loop.N_PRODUCTS] += n_products
            span, age, error = h, 0.0, clock[loop.ERROR]
            is_open, is_cut = True, model.weakening is not None and h < target
        if counters[loop.N_STEPS] == 0:
            copy(mode, search.initial_mode)
            copy(mode, search.known_mode)
        before = n_recorded
        n_recorded, same = record(model, expansion, clock, search.known_mode, events, n_recorded)
        if n_recorded > before:
            loop.note_event(clock, counters)
        loop.note_all_stuck_at(same and mode[0] == 0, t, z, events, counters)
        if remaining <= 0.0:
            sample(expansion, v, None, order, t, t, state)  # a run of no length
            return loop.DONE, n_recorded
        if same and loop.is_check_due(state, mode, precheck, remaining):
            if loop.may_collapse(state, mode, precheck):
                return loop.ALL_SLIP, n_recorded
            if n_recorded > 0:
                return loop.PAUSED, n_recorded
            # as at the start of a slice: the result does not depend on the slicing
            n_left, is_open = loop.STEPS_A_SLICE, False
            continue

        step, block = _first_event(model, expansion, search, order, h)
        if not goal.is_last and remaining - step <= ROUNDING * t_end:
            step = remaining  # an event that rounding cannot tell from the end belongs to the next piece
        counters[loop.N_STEPS] += 1
        if block >= 0:
            counters[loop.LAST_BLOCK] = block
        for i in range(n):
            near[i] = ROUNDING * (abs(series[1, i] - v[i]) + abs(2.0 * series[2, i] * h) + search.reach[i])
        t_next, lacking = loop.later(t, clock[loop.LACKING], step, t_end)
        sample(expansion, v, None, order, t, t_next, state)
        age += step
        clock[loop.ERROR] = error_after(model, expansion, goal, Window(order, span, allowed, 0.0), age, error)
        left = h - step
        # else the event ends the window
        is_inside = block >= 0 and left > 0.0 and model.weakening is None and not is_slow
        if is_inside:
            shift(expansion, order, step, v)
            for i in range(n):
                sticks = mode[i] == 0
                z[i], w[i] = (expansion.held[i], v[i]) if sticks else (series[0, i], series[1, i])
            h, z_max = 0.0, largest(z)
            if _on_the_edge(model, expansion, near, z_max, w, block, order, 0.0, True) == 1:
                window = Window(order, span, allowed, z_max)
                h, n_products = correct(model, expansion, block, window, left, rate, clock)
                counters[loop.N_PRODUCTS] += n_products
                touching[block] = mode[block] != 0  # so that a new expansion, if it comes first, decides the same
            is_cut = is_cut or h < left
            is_open = control.is_worth_using(clock, h)
            clock[control.CARRIED] += 1.0 if is_open else 0.0
        else:
            evaluate(expansion, v, None, order, step, z, w)
            _on_the_edge(model, expansion, near, 0.0, w, block, order, step, False)
            is_open = False
            is_cut = is_cut or block >= 0
        clock[loop.TIME], clock[loop.LACKING] = t_next, lacking
        clock[control.EXPOSURE] += step
        if not is_open:
            control.note_window(clock, is_cut)
        if stalls(goal, counters, clock[loop.TIME] - t, t, n_recorded == before):
            return loop.STALLED, n_recorded
        if not loop.is_within(state, goal.bound):
            return loop.DIVERGED, n_recorded
    return loop.PAUSED, n_recorded


class Stack(NamedTuple):
    """Runs that are advanced by one call: by run, what `_advance` takes."""

    model: Model
    goal: Goal
    state: loop.State
    expansion: Expansion
    search: Search
    slip: NDArray[np.int64]  #: of the pre-check


@kernel
def advance(stack, slow, events, precheck, first, found):  # type: ignore[no-untyped-def]
    """Advance runs of a stack, from the first on, by a slice; see `stacks`."""
    for row in range(len(found)):
        k = first + row
        state = loop.state_of(stack.state, k)
        expansion, search = expansion_of(stack.expansion, k), search_of(stack.search, k)
        status, n_recorded = _advance(
            model_of(stack.model, k), goal_of(stack.goal, k), state, expansion, search, slow,
            rest_of(events, found, row), precheck_of(precheck, stack.slip[k]),
        )  # fmt: skip
        note_found(found, row, status, n_recorded, state.counters)
