"""Macro steps: predict, solve, test, complete.

All blocks share a macro step with the nodes of the Radau IIA method of five stages, at which F, the coupling force,
is predicted. Each block is solved by itself with that F, by a smooth law in `substeps.py`, by the set-valued one in
`pieces.py`; its z at the nodes gives a new F, by one product of K with all nodes at once, and this is iterated until
F has converged. A. Logg, SIAM J. Sci. Comput. 24 (2003) 1879-1902, doi:10.1137/S1064827501389722, calls such methods
multi-adaptive; the iteration is waveform relaxation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stickslip.sim.engines import course
from stickslip.sim.engines.course import Events, State
from stickslip.sim.engines.forcing import BELT, DRAG, JUMP, value_at
from stickslip.sim.engines.frame import Way
from stickslip.sim.engines.waveform import control as limits
from stickslip.sim.engines.waveform.collocation import force, force_changed, predict, stray
from stickslip.sim.engines.waveform.control import (
    Control,
    Solution,
    grow,
    is_in_single_range,
    next_step,
    shrink,
    single_limit,
)
from stickslip.sim.engines.waveform.events import note_all_stuck, sample, step_events, until
from stickslip.sim.engines.waveform.layout import Blocks, Exact, Model, Run, Shared, Span, Workspace, blocks, shared
from stickslip.sim.engines.waveform.matrices import Matrix
from stickslip.sim.engines.waveform.pieces import record_changes, solve_exactly
from stickslip.sim.engines.waveform.substeps import keep_substeps, probe_blocks, solve_blocks
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats, Ints
from stickslip.sim.numerics.arithmetic import copy, largest
from stickslip.sim.numerics.lanes import WIDTH
from stickslip.sim.numerics.panels import SINGLE_HEIGHT, listed_products, products
from stickslip.sim.numerics.radau import NODES, STAGES, TO_POWERS
from stickslip.sim.numerics.roots import horner

_first_step = inner(limits.first_step)
_products, _single_products = products(STAGES), products(STAGES, single=True)
_listed_products = listed_products(STAGES, SINGLE_HEIGHT, single=True)


@inner
def _set_tolerance(exact: Exact | None, block: Blocks, common: Shared, n: int) -> None:
    """Under the set-valued law the error allowed is that of w, over the fastest of all blocks and belts."""
    if exact is not None:
        common.unit[0] = 1.0
        fastest = exact.fastest_belt
        for i in range(n):
            fastest = max(fastest, abs(block.u0[i] + block.belt[i]), block.speed_before[i])
        common.atol[0] = exact.tol * fastest


@inner
def _predict_step(model: Model, work: Workspace, clock: Floats, h: float) -> None:
    """Begin a macro step after the last one: predict F and u at the nodes, and mark blocks that take substeps."""
    block, common, n = blocks(work.table), shared(work.shared), len(work.is_split)
    for k in range(STAGES):
        x = 1.0 + NODES[k] * h / clock[limits.KEPT_STEP]
        for j in range(STAGES):
            common.weights[k, j] = horner(TO_POWERS[:, j], STAGES - 1, x)
    common.h[0] = common.unit[0] = h
    _set_tolerance(model.exact, block, common, n)
    common.size[0] = largest(block.z0[:n])
    for first in range(0, n, WIDTH):
        predict(block, first, common)
    for k in range(len(work.forcing)):
        value_at(model.forcing, clock[course.TIME] + NODES[k] * h, work.forcing[k])
        for i in range(n):
            block.f[k, i] -= work.forcing[k, i]
    for i in range(n):  # no layer damps the error of a step that leaves one
        work.is_split[i] = clock[limits.JUMPED] > 0.0 and abs(block.u0[i]) * block.steep[i] < block.reach[i]
        if work.is_split[i]:  # it settles in its layer, or leaves it, on the time scale of the layer
            work.next_h[i] = min(work.next_h[i], 1.0 / max(block.friction[i] * block.steep[i], 1.0))
        work.begins[i] = -1
    copy(work.next_h, work.next_h_before)


@inner
def _times(matrix: Matrix, x: Floats, y: Floats) -> None:
    """y_k = K x_k at all nodes, K in panels or, when these are none, by sparse rows."""
    if len(matrix.panels) > 0:
        _products(matrix.panels, x, y)
        return
    indptr, indices, data = matrix.indptr, matrix.indices, matrix.data
    for i in range(len(indptr) - 1):
        a, b, c, d, e = 0.0, 0.0, 0.0, 0.0, 0.0
        for place in range(indptr[i], indptr[i + 1]):
            j, value = indices[place], data[place]
            a += value * x[0, j]
            b += value * x[1, j]
            c += value * x[2, j]
            d += value * x[3, j]
            e += value * x[4, j]
        y[0, i], y[1, i], y[2, i], y[3, i], y[4, i] = a, b, c, d, e


@inner
def _product_of_change(model: Model, work: Workspace, control: Control[float], m: int, limit: float) -> bool:
    """K times `change` in single precision; False, with no result, if it would not be accurate enough.

    Only of the first `m` blocks listed, if `m` is not zero.
    """
    single, single_product = work.single, work.single_product
    n, change, most = len(work.is_split), blocks(work.table).change, 0.0
    for k in range(STAGES):
        most = max(most, largest(change[k, :n]))
    if not (most < limit and is_in_single_range(control, most)):
        return False
    for k in range(STAGES):
        for i in range(n):
            single[k, i] = np.float32(change[k, i])
    if m > 0:
        _listed_products(model.stiffness.single_panels, single, single_product, work.split, m)
    else:
        _single_products(model.stiffness.single_panels, single, single_product)
    for k in range(STAGES):
        for i in range(n):
            change[k, i] = single_product[k, i]
    return True


@inner
def _couple_changed(model: Model, exact: Exact | None, work: Workspace, control: Control[float], h: float) -> int:
    """Add to F what blocks do whose z is off its prediction, by the columns of K that are theirs alone.

    These are the blocks with an event in this step or the last. Returns how many there are, 0 if F is as it was.
    """
    if exact is None or len(model.stiffness.single_panels) == 0 or len(work.is_split) < limits.FEWEST:
        return 0
    else:
        block, common, n, m = blocks(work.table), shared(work.shared), len(work.is_split), 0
        for first in range(0, n, WIDTH):
            stray(block, first, common)
        least = limits.OFF * math.sqrt(n) * common.atol[0] / (h * largest(block.row_sum[:n]))
        for i in range(n):
            if block.error[i] > least * least:
                work.split[m] = i
                m += 1
        if m == 0 or m > limits.MOST_OFF * n or not _product_of_change(model, work, control, m, np.inf):
            return 0
        for first in range(0, n, WIDTH):
            force_changed(block, first, model.law)
        return m


@inner
def _add_cross(model: Model, work: Workspace) -> None:
    """Add N times u, of a block that took substeps its L2 projection, to the change of F."""
    block, product, n = blocks(work.table), work.product, len(work.is_split)
    for k in range(STAGES):
        for i in range(n):
            block.mean_u[k, i] = block.mean_u[k, i] if work.is_split[i] else block.u[k, i]
    _times(model.cross, block.mean_u, product)
    for k in range(STAGES):
        for i in range(n):
            block.change[k, i] += product[k, i]


@inner
def _couple(model: Model, work: Workspace, control: Control[float], h: float, is_first: bool) -> None:
    """F from z (and u) at the nodes; under a smooth law the first one is in double precision."""
    block, n, change = blocks(work.table), len(work.is_split), blocks(work.table).change
    may_add = len(model.stiffness.single_panels) > 0 and not (is_first and model.exact is None)
    for k in range(STAGES):
        for i in range(n):
            block.z_before[k, i] = block.z[k, i]
            change[k, i] = block.z[k, i] - block.z_near[k, i]
    limit = single_limit(control, shared(work.shared).atol[0], h, largest(block.lag[:n]))
    if not (may_add and _product_of_change(model, work, control, 0, limit)):
        _times(model.stiffness, block.z, block.product)
        for k in range(STAGES):
            for i in range(n):
                block.z_near[k, i], change[k, i] = block.z[k, i], 0.0
    if model.has_cross:
        _add_cross(model, work)
    for k in range(len(work.forcing)):
        for i in range(n):
            change[k, i] -= work.forcing[k, i]
    for first in range(0, n, WIDTH):
        force(block, first, model.law)


@inner
def _solve_blocks(
    model: Model, exact: Exact | None, work: Workspace, h: float, is_last: bool, n_before: int
) -> tuple[int, int]:
    """By the law: see `substeps.solve_blocks`. A smooth one repeats the substeps of the last iteration."""
    if exact is None:
        keep_substeps(work, n_before)
        return solve_blocks(model, work, h, is_last)
    else:
        return solve_exactly(model, work, h)


@inner
def _probe_blocks(model: Model, exact: Exact | None, work: Workspace, n_split: int) -> int:
    """By the law: see `substeps.probe_blocks`. Nothing bends the set-valued law between the nodes."""
    if exact is None:
        return probe_blocks(model.law, work, n_split)
    else:
        return n_split


@inner
def _step_events(
    run: Run, exact: Exact | None, solution: Solution, span: Span, events: Events, n_recorded: int
) -> int:
    """By the law: see `events.step_events`. Under the set-valued law the error of w goes on."""
    if exact is None:
        return step_events(run.model, run.work, solution.n_substeps, span, events, n_recorded)
    else:
        work, clock = run.work, run.state.clock
        error = limits.AT_END * (1.0 + solution.tail) * shared(work.shared).atol[0]
        # they have no common sign
        clock[course.ERROR] = math.hypot(clock[course.ERROR] / (1.0 + exact.decay * span.length), error)
        return record_changes(work, span, clock[course.ERROR], events, n_recorded)


@inner
def _solve_waveform(
    model: Model, work: Workspace, control: Control[float], clock: Floats, counters: Ints, h: float
) -> Solution:
    """Iterate: solve the blocks, and compute F from them, until F has converged.

    The last iteration takes no product if the contraction makes the next change of F too small to matter. If the tail
    is too large the step is given up: iterations hardly change it.
    """
    most_left = min(1.0, (limits.ITERATED / control.safety) ** 2)
    faster = 1.0 if model.exact is None else limits.FASTER
    block, n = blocks(work.table), len(work.is_split)
    tail, contraction, last = 0.0, clock[limits.CONTRACTION], np.inf
    n_substeps, n_split, is_last, converged = 0, 0, False, False
    for iteration in range(limits.MOST_ITERATIONS):
        n_split_before = n_split
        n_split, n_substeps = _solve_blocks(model, model.exact, work, h, is_last, n_substeps)
        if n_substeps < 0:
            break
        if is_last and n_split == n_split_before:
            converged = True
            break
        n_columns = _couple_changed(model, model.exact, work, control, h) if iteration == 0 else 0
        if n_columns > 0:
            counters[course.N_PRODUCTS] += STAGES * n_columns // n
        else:
            _couple(model, work, control, h, iteration == 0)
            counters[course.N_PRODUCTS] += STAGES * (2 if model.has_cross else 1)
        moved, tail = largest(block.moved[:n]) * control.safety, largest(block.tail[:n]) * control.safety
        if not tail < limits.TAIL:
            break
        now = min(moved / last, limits.SLOWEST) if iteration > 0 else contraction
        enough = most_left * (1.0 - now) * (limits.AT_ONCE if iteration == 0 else 1.0)
        if moved < enough and n_columns == 0 and _probe_blocks(model, model.exact, work, n_split) == n_split:
            converged = True
            break
        is_last = iteration > 0 and moved * now * faster < enough
        last, contraction = moved, now
    return Solution(converged, tail, contraction, n_substeps)


@inner
def _reject(work: Workspace, clock: Floats, counters: Ints, solution: Solution, h: float) -> None:
    """Shorten the step, note which block caused its failure, and undo its changes."""
    counters[course.N_REJECTED] += 1
    counters[course.LAST_BLOCK] = _worst(work) if solution.n_substeps >= 0 else -1 - solution.n_substeps
    shrink(clock, h, solution.tail)
    copy(work.next_h_before, work.next_h)


@inner
def _worst(work: Workspace) -> int:
    """The block whose F has the largest error."""
    block, worst, most = blocks(work.table), 0, 0.0
    for i in range(len(work.is_split)):
        here = max(block.moved[i], block.tail[i])
        if not here <= most and most == most:  # NaN is worst
            worst, most = i, here
    return worst


@inner
def _accept(work: Workspace, state: State, h: float) -> None:
    """Go to the end of a macro step."""
    block, n = blocks(work.table), len(work.is_split)
    for i in range(n):
        block.speed_before[i] = abs(block.u0[i] + block.belt[i])
        block.was_split[i] = 1.0 if work.is_split[i] else 0.0
        if work.is_split[i]:
            block.u0[i], block.z0[i], block.mode[i] = work.end_u[i], work.end_z[i], work.end_mode[i]
        else:
            block.u0[i], block.z0[i] = block.u[STAGES - 1, i], block.z[STAGES - 1, i]
            work.next_h[i] = max(work.next_h[i], h)
        state.z[i], state.w[i] = block.z0[i], block.u0[i] + block.belt[i]
    copy(block.f[STAGES - 1], block.force0)
    for k in range(STAGES):
        copy(block.f[k], block.kept_f[k])
        copy(block.u[k], block.kept_u[k])
        copy(block.z_before[k], block.kept_z[k])
        for i in range(n if len(work.forcing) > 0 else 0):
            block.kept_f[k, i] += work.forcing[k, i]


class Window(NamedTuple):
    """A macro step."""

    h: float  #: its length
    may_grow: bool  #: whether the next may be longer; not after a failure


@inner
def _blank() -> Window:
    return Window(0.0, True)


@inner
def _open(run: Run, window: Window, remaining: float) -> Window:
    return Window(next_step(run.goal, run.state.clock), window.may_grow)


@inner
def _note(run: Run, events: Events, n_recorded: int) -> tuple[int, bool]:
    """Whether all blocks slip in one direction; a macro step records its events itself."""
    mode = run.state.mode
    same = mode[0] != 0
    for i in range(len(mode)):
        same = same and mode[i] == mode[0]
    return n_recorded, same


@inner
def _at(run: Run, window: Window, t: float) -> None:
    model, work, samples, counters = run.model, run.work, run.state.samples, run.state.counters
    counters[course.N_SAMPLED] = sample(model, work, 0, Span(t, 1.0, t), samples, counters[course.N_SAMPLED])


@inner
def _enter(run: Run) -> None:
    """u is continuous, and F jumps where the slopes of belt speeds change; F + g is kept in the new frame."""
    model, work, state = run.model, run.work, run.state
    block, table, clock, atol = blocks(work.table), model.forcing.table, state.clock, shared(work.shared).atol[0]
    most = largest(table[JUMP])
    step = _first_step(atol, most)
    clock[limits.STEP] = min(clock[limits.STEP], step)
    value_at(model.forcing, 0.0, work.forcing[0])
    for i in range(len(state.z)):
        block.z0[i], block.belt[i], block.drag[i] = state.z[i], table[BELT, i], table[DRAG, i]
        block.force0[i] += table[JUMP, i]
        moved = block.force0[i] + work.forcing[0, i] - block.kept_f[STAGES - 1, i]
        for k in range(STAGES):
            block.kept_f[k, i] += moved
        work.next_h[i] = min(work.next_h[i], limits.FIRST_SUBSTEP * step)
        if abs(table[JUMP, i]) > limits.JUMP * block.friction[i]:
            clock[limits.JUMPED] = 1.0


@inner
def _carry(
    run: Run, window: Window, is_after_event: bool, events: Events, n_recorded: int
) -> tuple[Window, int, bool]:
    """Take a macro step, if it can be solved; see `frame.Way`."""
    model, work, goal, state = run.model, run.work, run.goal, run.state
    clock, counters, t, h = state.clock, state.counters, state.clock[course.TIME], window.h
    _predict_step(model, work, clock, h)
    solution = _solve_waveform(model, work, goal, clock, counters, h)
    if not solution.converged:
        _reject(work, clock, counters, solution, h)
        is_shortest = clock[limits.STEP] <= limits.SHORTEST * max(min(1.0, goal.t_end), t)
        return Window(h, False), n_recorded, is_shortest
    counters[course.N_STEPS] += 1
    end, lacking = course.later(t, clock[course.LACKING], h, goal.t_end)
    span, first_event, n_substeps = Span(t, h, end), n_recorded, solution.n_substeps
    n_recorded = _step_events(run, model.exact, solution, span, events, n_recorded)
    if goal.instant >= 0.0:
        n_recorded = until(goal.instant, first_event, n_recorded, events)
    note_all_stuck(run, n_substeps, span, first_event, n_recorded, events)
    if goal.instant < 0.0:
        n_sampled = counters[course.N_SAMPLED]
        counters[course.N_SAMPLED] = sample(model, work, n_substeps, span, state.samples, n_sampled)
        _accept(work, state, h)
        grow(clock, h, solution, window.may_grow)
        copy(work.modes[0], state.mode)
        clock[course.TIME], clock[course.LACKING] = end, lacking
        for k in range(first_event, n_recorded):
            if events.block[k] < len(state.mode):  # by the first definition of sticking
                course.note_event(clock, counters)
    return Window(h, True), n_recorded, False


way = Way(_blank, _open, _note, _at, _carry, _enter)
