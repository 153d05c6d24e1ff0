"""Which blocks stick under the smoothed law, and when that changes: events and samples on a macro step.

`stickslip.sim.engines.sigmoid.settings` defines sticking. u = w - v and F are polynomials of degree five on a macro
step; u of a block that takes substeps is one on each of these.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from stickslip.sim.engines import course
from stickslip.sim.engines.course import Buffers, Events
from stickslip.sim.engines.sigmoid_law import sign_of_number
from stickslip.sim.engines.waveform.collocation import view
from stickslip.sim.engines.waveform.layout import Blocks, Exact, Model, Run, Span, Workspace, blocks
from stickslip.sim.engines.waveform.pieces import slip_at
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.arithmetic import copy, room
from stickslip.sim.numerics.lanes import WIDTH
from stickslip.sim.numerics.radau import ALL_NODES, ALL_TO_POWERS, BARYCENTRIC, NODES, STAGES, TO_BERNSTEIN, WEIGHTS
from stickslip.sim.numerics.roots import horner, insert_roots

#: The most crossings of bounds by a block in a step: the roots of eleven polynomials of degree five, and the start.
PASSES = 11 * STAGES + 1
_MARKS, _NODES = PASSES + 1, STAGES + 1


class Hold(NamedTuple):
    """What holds a block, by one definition of sticking."""

    band: float  #: it sticks below this |u|
    by_force: bool  #: and, if this is set, below static friction
    static: float
    closed: float  #: the side to which it does not slip; 0: none


class Motion(NamedTuple):
    """u and F of a block on a step, by values at the start and the nodes."""

    u: Floats
    force: Floats


@inner
def _hold_of(model: Model, block: Blocks, d: int, i: int) -> Hold:
    """What holds block i by definition d."""
    return Hold(model.bands[d, i], model.by_force[d], block.static[i], block.closed[i])


@inner
def mode_of(mode: int, gap: float, force: float, hold: Hold, kinetic: float, peak: float) -> int:
    """Mode of a block under the smoothed law, from its mode before, w - v and F.

    `peak` is the w - v at which the law has its peak: a block that slips beyond it is not held while F, above kinetic
    friction, pushes it on.
    """
    if kinetic > 0.0 and abs(gap) < hold.band and (not hold.by_force or abs(force) < hold.static):
        is_pushed = mode != 0 and abs(gap) > peak and -force * math.copysign(1.0, gap) > kinetic
        if not (hold.by_force and is_pushed):
            return 0
    return 1 if gap > 0.0 else (-1 if gap < 0.0 else 0)


@inner
def _hull(values: Floats, bernstein: Floats) -> tuple[float, float]:
    """Bernstein coefficients, from values at the start and the nodes; returns their bounds."""
    low, high = values[0], values[0]
    bernstein[0] = values[0]
    for j in range(1, STAGES + 1):
        coefficient = 0.0
        for k in range(STAGES + 1):
            coefficient += TO_BERNSTEIN[j, k] * values[k]
        bernstein[j] = coefficient
        low, high = min(low, coefficient), max(high, coefficient)
    return low, high


@inner
def _powers(values: Floats, poly: Floats) -> None:
    """Coefficients of powers, from values at the start and the nodes."""
    for p in range(STAGES + 1):
        poly[p] = 0.0
        for k in range(STAGES + 1):
            poly[p] += ALL_TO_POWERS[p, k] * values[k]


@inner
def _marks(poly: Floats, bernstein: Floats, bound: float, marks: Floats, n_marks: int, places: Floats) -> int:
    """Insert the places in (0, 1] at which a polynomial passes a bound into `marks`, which rise."""
    above, below = False, False
    for j in range(STAGES + 1):
        above, below = above or bernstein[j] >= bound, below or bernstein[j] <= bound
    if not (above and below):
        return n_marks
    at_start = poly[0]
    poly[0] -= bound
    n_marks = insert_roots(poly, STAGES, marks, n_marks, places)
    poly[0] = at_start
    return n_marks


@inner
def _at(values: Floats, x: float) -> float:
    """Value at x of the polynomial with these values at the start and the nodes: Neville's scheme, barycentric."""
    above, below = 0.0, 0.0
    for k in range(STAGES + 1):
        if x == ALL_NODES[k]:
            return values[k]
        weight = BARYCENTRIC[k] / (x - ALL_NODES[k])
        above += weight * values[k]
        below += weight
    return above / below


@inner
def _to_open(closed: float, gap: float, force: float) -> tuple[float, float]:
    """w - v and F, with w - v cut off at zero on a closed side, and F where it pushes there."""
    if closed < 0.0:
        return max(gap, 0.0), min(force, 0.0)
    if closed > 0.0:
        return min(gap, 0.0), max(force, 0.0)
    return gap, force


@inner
def _keeps(hold: Hold, gaps: tuple[float, float], forces: tuple[float, float], mode: int) -> bool:
    """Whether the mode cannot change while u and F are between these bounds."""
    low, low_force = _to_open(hold.closed, gaps[0], forces[0])
    high, high_force = _to_open(hold.closed, gaps[1], forces[1])
    band, static = hold.band, hold.static
    if mode == 0:
        is_within = not hold.by_force or (low_force > -static and high_force < static)
        return low > -band and high < band and is_within
    if (low >= band) if mode > 0 else (high <= -band):
        return True
    slides = hold.by_force and (low_force >= static or high_force <= -static)
    return slides and (low > 0.0 if mode > 0 else high < 0.0)


@inner
def _all_marks(hold: Hold, mu: float, peak: float, bears: float, scratch: Floats) -> int:
    """Find the places, in rising order, at which u or F pass a bound that may change the mode; returns how many."""
    of_u, of_force, poly_u, poly_force = scratch[0], scratch[1], scratch[2], scratch[3]
    marks, places = scratch[4], scratch[5]
    n_marks = _marks(poly_u, of_u, 0.0, marks, 0, places)
    if mu > 0.0:
        for sign in (-1.0, 1.0):
            n_marks = _marks(poly_u, of_u, sign * hold.band, marks, n_marks, places)
            n_marks = _marks(poly_force, of_force, sign * bears, marks, n_marks, places)
            if hold.by_force:
                n_marks = _marks(poly_force, of_force, sign * hold.static, marks, n_marks, places)
                if peak < hold.band:
                    n_marks = _marks(poly_u, of_u, sign * peak, marks, n_marks, places)
                    n_marks = _marks(poly_force, of_force, sign * mu, marks, n_marks, places)
    return n_marks


@inner
def _on_step(
    model: Model, work: Workspace, d: int, i: int, motion: Motion, span: Span, events: Events, n_recorded: int
) -> int:
    """Record the changes of mode of block i by definition d on a step or substep; returns how many are recorded.

    Only a force above friction and damping at the edge of the band pushes a block out of it: an exit with less force,
    by no more than the error allowed in a step, is an overshoot of the polynomial.
    """
    block, scratch = blocks(work.table), room(6, _MARKS)
    poly_u, poly_force, marks = scratch[2], scratch[3], scratch[4]
    mode = int(work.modes[d, i])
    hold = _hold_of(model, block, d, i)
    mu, peak, band = block.friction[i], block.peak[i], hold.band
    gaps, forces = _hull(motion.u, scratch[0]), _hull(motion.force, scratch[1])
    if _keeps(hold, gaps, forces, mode):
        return n_recorded
    _powers(motion.u, poly_u)
    _powers(motion.force, poly_force)
    bears = model.borne[d, i] * sign_of_number(band * block.steep[i], block.hidden[i]) + block.damping[i] * band
    n_marks = _all_marks(hold, mu, peak, bears, scratch)
    for k in range(n_marks + 1):
        left = marks[k - 1] if k > 0 else 0.0
        right = marks[k] if k < n_marks else 1.0
        if right <= left:
            continue
        middle = 0.5 * (left + right)
        gap, pull = _to_open(hold.closed, horner(poly_u, STAGES, middle), horner(poly_force, STAGES, middle))
        new = mode_of(mode, gap, pull, hold, mu, peak)
        is_borne = mode == 0 and mu > 0.0 and -new * pull < bears and (not hold.by_force or abs(pull) < hold.static)
        if new != mode and not (is_borne and abs(gap) < band + block.tolerance[i]):
            # rounding may pass the end of the piece
            events.t[n_recorded] = min(span.start + span.length * left, span.end)
            events.block[n_recorded] = d * len(work.is_split) + i
            events.mode[n_recorded] = new
            mode = new
            n_recorded += 1
    work.modes[d, i] = mode
    return n_recorded


@inner
def step_events(model: Model, work: Workspace, n_substeps: int, span: Span, events: Events, n_recorded: int) -> int:
    """Record all changes of mode on a macro step, by every definition of sticking; returns how many are recorded.

    By definition d, block i is labelled i + d n.
    """
    block, n, substeps = blocks(work.table), len(work.is_split), work.substeps
    nodes = room(4, _NODES)
    u, force, of_substep, bernstein = nodes[0], nodes[1], nodes[2], nodes[3]
    for first in range(0, n, WIDTH):
        view(block, first, model.law)
    copy(work.modes[0], work.modes_before)
    for d in range(len(model.bands)):
        for i in range(n):
            hold = _hold_of(model, block, d, i)
            gaps, forces = (block.low[i], block.high[i]), (block.low_force[i], block.high_force[i])
            if work.is_split[i] or _keeps(hold, gaps, forces, int(work.modes[d, i])):
                continue
            u[0], force[0] = block.u0[i], block.force0[i]
            for k in range(STAGES):
                u[k + 1], force[k + 1] = block.u[k, i], block.f[k, i]
            n_recorded = _on_step(model, work, d, i, Motion(u, force), span, events, n_recorded)
        last = -1
        for k in range(n_substeps):
            i, start, length = substeps.block[k], substeps.start[k], substeps.length[k]
            hold = _hold_of(model, block, d, i)
            gaps, forces = _hull(substeps.u[k], bernstein), (block.low_force[i], block.high_force[i])
            if _keeps(hold, gaps, forces, int(work.modes[d, i])):
                continue
            if i != last:
                last = i
                force[0] = block.force0[i]
                for j in range(STAGES):
                    force[j + 1] = block.f[j, i]
            for j in range(STAGES + 1):
                of_substep[j] = _at(force, start + length * ALL_NODES[j])
            span_of_substep = Span(span.start + span.length * start, span.length * length, span.end)
            n_recorded = _on_step(
                model, work, d, i, Motion(substeps.u[k], of_substep), span_of_substep, events, n_recorded
            )
    return n_recorded


@inner
def until(instant: float, first: int, n_recorded: int, events: Events) -> int:
    """Drop the events, from the first on, that are after an instant; returns how many are recorded then."""
    n_kept = first
    for k in range(first, n_recorded):
        if events.t[k] <= instant:
            events.t[n_kept], events.block[n_kept], events.mode[n_kept] = events.t[k], events.block[k], events.mode[k]
            n_kept += 1
    return n_kept


@inner
def _next(events: Events, first: int, n_recorded: int, k: int) -> int:
    """The event that follows k in time, among those from the first on, or -1; the earliest follows -1."""
    t, best = events.t, -1
    for j in range(first, n_recorded):
        is_later = k < 0 or t[j] > t[k] or (t[j] == t[k] and j > k)
        if is_later and (best < 0 or t[j] < t[best]):
            best = j
    return best


@inner
def note_all_stuck(run: Run, n_substeps: int, span: Span, first: int, n_recorded: int, events: Events) -> None:
    """Record where the blocks are when all come to stick, or one leaves, at the events of a macro step from `first`.

    The modes before the step become those after it.
    """
    model, work, counters = run.model, run.work, run.state.counters
    mode, n, count = work.modes_before, len(work.is_split), 0
    for i in range(n):
        count += mode[i] == 0
    if counters[course.N_STEPS] == 1:
        course.note_all_stuck_at(count == n, span.start, blocks(work.table).z0[:n], events, counters)
    most = count
    for k in range(first, n_recorded):
        most += events.block[k] < n and events.mode[k] == 0
    if n_recorded == first or most < n:
        return
    k = _next(events, first, n_recorded, -1)
    while k >= 0:
        i, t = events.block[k], events.t[k]
        if i < n:
            count += int(events.mode[k] == 0) - int(mode[i] == 0)
            mode[i] = events.mode[k]
        k = _next(events, first, n_recorded, k)
        is_last = k < 0 or events.t[k] > t
        if is_last and (count == n) != (counters[course.IS_ALL_STUCK] == 1):
            work.there.t[0] = t
            sample(model, work, n_substeps, span, work.there, 0)
            course.note_all_stuck_at(count == n, t, work.there.z[0], events, counters)


@inner
def _of_substep(exact: Exact | None, work: Workspace, place: int, inside: float, h: float) -> tuple[float, float]:
    """u at a share of a substep, and by how much z has moved since it began, on a macro step of length h."""
    substeps, length, belt = work.substeps, h * work.substeps.length[place], blocks(work.table).belt
    belt_speed = belt[substeps.block[place]]
    if exact is None:
        weights, of_u = room(1, _NODES)[0], substeps.u[place]
        for k in range(STAGES + 1):
            weights[k] = horner(ALL_TO_POWERS[:, k], STAGES, inside)
        u, travel = weights[0] * of_u[0], 0.0
        for k in range(STAGES):
            u += weights[k + 1] * of_u[k + 1]
            of_node = NODES[k] * belt_speed
            for j in range(STAGES):
                of_node += WEIGHTS[k, j] * of_u[j + 1]
            travel += weights[k + 1] * of_node
        return u, travel * length
    else:
        u, mean = slip_at(work.changes, place, inside)
        return u, (belt_speed + mean) * inside * length


@inner
def sample(model: Model, work: Workspace, n_substeps: int, span: Span, samples: Buffers, m: int) -> int:
    """Record the state at all sample times of a macro step, from number m on; returns the next number."""
    block, substeps = blocks(work.table), work.substeps
    weights = room(1, _NODES)[0]
    while m < len(samples.t) and samples.t[m] <= span.end:
        x = min((samples.t[m] - span.start) / span.length, 1.0)
        for k in range(STAGES + 1):
            weights[k] = horner(ALL_TO_POWERS[:, k], STAGES, x)
        for i in range(len(work.is_split)):
            z, u = weights[0] * block.z0[i], weights[0] * block.u0[i]
            for k in range(STAGES):
                z += weights[k + 1] * block.z[k, i]
                u += weights[k + 1] * block.u[k, i]
            if not work.is_split[i]:
                samples.z[m, i], samples.w[m, i] = z, block.belt[i] + u
        for place in range(n_substeps):
            i, inside = substeps.block[place], (x - substeps.start[place]) / substeps.length[place]
            if 0.0 <= inside <= 1.0 + 1e-9:
                u, travel = _of_substep(model.exact, work, place, inside, span.length)
                samples.z[m, i], samples.w[m, i] = substeps.z[place] + travel, block.belt[i] + u
        m += 1
    return m
