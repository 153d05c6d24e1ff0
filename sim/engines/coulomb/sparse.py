"""The exact engine's steps where K is sparse: an event is a local update of the blocks near it.

Every block has a series about an instant of its own in the window, and the time of its next event, the first of which
a tournament tree finds. An event changes the series of its block from the second order on, those of its neighbours
from the fourth, those of their neighbours from the sixth, or the third and fourth where damping couples them:
the update ends after so many ties that the rest is far below the tolerance, and at blocks that stick. So the cost of
an event does not depend on the number of blocks, and a window holds any number of events.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import course
from stickslip.sim.engines.coulomb import control
from stickslip.sim.engines.coulomb.events import NEVER, enclose, next_event
from stickslip.sim.engines.coulomb.expansion import Expansion, Window
from stickslip.sim.engines.coulomb.model import Cross, Model
from stickslip.sim.engines.coulomb.sticking import force_rounding, known, push
from stickslip.sim.engines.coulomb.taylor import UNDECIDED, curvature, decide, error_after, expand, pull_of
from stickslip.sim.engines.coulomb.windows import Run, evaluate, instant, note, record, sample, stalls
from stickslip.sim.engines.course import Events
from stickslip.sim.engines.frame import Way, frame
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.arithmetic import ROUNDING, largest
from stickslip.sim.numerics.horner import shift_rows
from stickslip.sim.numerics.sparse import Columns
from stickslip.sim.systems.system import System


class Local(NamedTuple):
    """Per-block data of a window, and the workspace of a local update: the blocks near an event."""

    pull: float  #: the largest row sum of |K|
    drag: float  #: and of |N|
    origin: Floats  #: the instant about which a block's series is, from the start of the window
    due: Floats  #: a tournament tree: the next event of block i at size + i, at k the earlier of 2 k and 2 k + 1
    place: NDArray[np.int64]  #: of a block among the members; -1: it is none
    members: NDArray[np.int64]  #: the blocks near the event, its own first
    series: Floats  #: of the members, about the event
    pulls: Floats  #: the coefficients of the change of F
    changes: Floats  #: of the coefficients of z, by the event
    step: Floats
    reach: Floats
    slips: Floats
    damping: Floats
    mode: NDArray[np.int8]
    ends: NDArray[np.int64]  #: the number of members at most k ties away from the event

    @classmethod
    def of(cls, system: System) -> Local:
        """For the blocks of a system."""
        n = system.n
        size, most = 1 << (n - 1).bit_length(), min(n, max(control.FEW, n // control.SHARE))
        return cls(
            pull=float(system.row_sums.max()),
            drag=float(system.cross_sums.max()),
            origin=np.zeros(n),
            due=np.full(2 * size, NEVER),
            place=np.full(n, -1),
            members=np.zeros(most, np.int64),
            series=np.zeros((control.ORDER_MAX + 1, most)),
            pulls=np.zeros((control.ORDER_MAX + 1, most)),
            changes=np.zeros((control.ORDER_MAX + 1, most)),
            step=np.zeros(most),
            reach=np.zeros(most),
            slips=np.zeros(most),
            damping=np.zeros(most),
            mode=np.zeros(most, np.int8),
            ends=np.zeros(control.ORDER_MAX, np.int64),
        )


class Opened(NamedTuple):
    """A window, and how long it was to be."""

    series: Window
    target: float


@inner
def _schedule(due: Floats, i: int, time: float) -> None:
    """Set the time of block i's next event."""
    k = len(due) // 2 + i
    due[k] = time
    while k > 1:
        k //= 2
        due[k] = min(due[2 * k], due[2 * k + 1])


@inner
def _winner(due: Floats) -> int:
    """The block with the first event."""
    size = len(due) // 2
    k = 1
    while k < size:
        k = 2 * k if due[2 * k] == due[k] else 2 * k + 1
    return k - size


@inner
def _schedule_all(run: Run[Local], order: int, h: float) -> None:
    """Find every block's next event within h; all series are about the start of a window."""
    expansion, reach, due = run.work.expansion, run.work.expansion.reach, run.work.local.due
    series, mode, n, size = expansion.series, expansion.mode, len(expansion.mode), len(due) // 2
    zeros, side = expansion.zeros, expansion.side
    enclose(series, expansion.slips, order, h, reach, n)
    for i in range(n):
        face = mode[i], zeros[i], side[i]
        due[size + i] = next_event(run.model, expansion, i, face, series, i, reach[i], (order, h))
    for k in range(size - 1, 0, -1):
        due[k] = min(due[2 * k], due[2 * k + 1])


@inner
def _bring(model: Model, expansion: Expansion, local: Local, order: int, s: float, first: int, last: int) -> None:
    """Shift the series of the members in these places to an instant of the window."""
    series, step, members, origin = local.series, local.step, local.members, local.origin
    of_all, damping, slips, mode = expansion.series, model.damping, expansion.slips, expansion.mode
    of_members, slips_there, mode_there = local.damping, local.slips, local.mode
    for a in range(first, last):
        i = members[a]
        step[a] = s - origin[i]
        mode_there[a], of_members[a], slips_there[a] = mode[i], damping[i], slips[i]
        for k in range(order + 1):
            series[k, a] = of_all[k, i]
    shift_rows(series, first, last, order, step)


@inner
def _list_tied(columns: Columns, j: int, local: Local, count: int) -> tuple[int, bool]:
    """Add the blocks that a matrix ties to block j to the members; their number, and whether there was room."""
    indptr, indices, place, members = columns.indptr, columns.indices, local.place, local.members
    for p in range(indptr[j], indptr[j + 1]):
        i = indices[p]
        if place[i] < 0:
            if count == len(members):
                return count, False
            place[i] = count
            members[count] = i
            count += 1
    return count, True


@inner
def _list_dragged(cross: Cross | None, j: int, local: Local, count: int) -> tuple[int, bool]:
    if cross is None:
        return count, True
    return _list_tied(cross.columns, j, local, count)


@inner
def _gather(
    model: Model, expansion: Expansion, local: Local, window: Window, jump: float, left: float
) -> tuple[int, float]:
    """List the blocks to which an event is carried over, behind its own; shorten the window where they are too many.

    `jump` bounds the change of its block's w', by the event, in the rest of the window. Returns the number of ties to
    the last ones, and the rest of the window.
    """
    order, allowed = window.order, window.allowed
    members, place, ends, mode = local.members, local.place, local.ends, expansion.mode
    first, count, ties = 0, 1, 0
    ends[0] = count
    # the error of w if the update ends here, over the one allowed; z of the last ties changes from this order on
    share, lowest = 0.5 * jump * left / (control.passed_on(len(mode)) * allowed), 2
    while share > 1.0 and first < count and lowest <= order:
        for a in range(first, ends[ties]):
            j = members[a]
            if a > 0 and mode[j] == 0:
                continue
            count, has_room = _list_tied(model.columns, j, local, count)
            if has_room:
                count, has_room = _list_dragged(model.cross, j, local, count)
            if not has_room:
                for b in range(ends[ties], count):
                    place[members[b]] = -1
                return ties, left * share ** (-1.0 / (lowest - 1))
        first = ends[ties]
        ties += 1
        ends[ties] = count
        if model.cross is None:
            lowest += 2
            share *= local.pull * left * left / ((lowest - 1) * lowest)
        else:
            lowest += 1
            share *= left * (local.drag + local.pull * left / (lowest + 1)) / lowest
    return ties, left


@inner
def _drag(cross: Cross | None, local: Local, k: int, count: int) -> None:
    """Add what the changes of w make of N w at order k to the changes of F."""
    if cross is None or k == 0:
        return
    columns, place, pulls, changes = cross.columns, local.place, local.pulls, local.changes
    for a in range(min(count, local.ends[k - 1])):
        j = local.members[a]
        for p in range(columns.indptr[j], columns.indptr[j + 1]):
            b = place[columns.indices[p]]
            if b >= 0:
                pulls[k, b] += columns.data[p] * ((k + 1) * changes[k + 1, a])


@inner
def _pass_on(model: Model, local: Local, order: int, start: float, count: int, pull: Floats, was_stuck: bool) -> None:
    """The series of the members from the event on; `start` is c_2 of its own block, whose F - R v was `pull`.

    The changes of the others obey their own equations, without constant terms.
    """
    members, place, ends = local.members, local.place, local.ends
    indptr, indices, data = model.columns.indptr, model.columns.indices, model.columns.data
    series, pulls, changes, slips, damping = local.series, local.pulls, local.changes, local.slips, local.damping
    changes[1, :count] = 0.0
    for k in range(order - 1):
        for a in range(count):
            pulls[k, a] = 0.0
        if k >= 2:
            n_ties = (k - 2) // 2 if model.cross is None else k - 2
            for a in range(min(count, ends[n_ties])):
                j = members[a]
                for p in range(indptr[j], indptr[j + 1]):
                    b = place[indices[p]]
                    if b >= 0:
                        pulls[k, b] += data[p] * changes[k, a]
        _drag(model.cross, local, k, count)
        factor = -1.0 / ((k + 2) * (k + 1))
        pull[k] += pulls[k, 0]
        old = 0.0 if was_stuck else series[k + 2, 0]
        c = slips[0] * factor * (damping[0] * (k + 1) * series[k + 1, 0] + pull[k]) if k > 0 else start
        series[k + 2, 0], changes[k + 2, 0] = c, c - old
        for a in range(1, count):
            changes[k + 2, a] = slips[a] * factor * (damping[a] * (k + 1) * changes[k + 1, a] + pulls[k, a])
            series[k, a] += (1.0 - slips[a]) * pulls[k, a]
            series[k + 2, a] += changes[k + 2, a]


@inner
def _is_alone(model: Model, local: Local, h: float, count: int, z_max: float) -> bool:
    """Whether no other member is at the edge of its mode."""
    series, mode, members, reach, v = local.series, local.mode, local.members, local.reach, model.belt_speed
    damping, static, row_sums, closed = local.damping, model.static, model.row_sums, model.closed
    for a in range(1, count):
        i = members[a]
        if mode[a] == 0:
            drag = damping[a] * v[i]
            slack = force_rounding(drag, row_sums[i] * z_max, static[i], known(model, 0, i))
            if push(closed[i], drag + series[0, a]) >= static[i] - slack:
                return False
        else:
            gap = series[1, a] - v[i]
            if mode[a] * gap <= ROUNDING * (abs(gap) + abs(2.0 * series[2, a] * h) + reach[a]):
                return False
    return True


@inner
def _put_back(run: Run[Local], order: int, span: tuple[float, float], count: int, n_zeros: int) -> None:
    """Copy the series of the members back, and find the next event of each in a span from s, of length h."""
    model, expansion, local, (s, h) = run.model, run.work.expansion, run.work.local, span
    series, mode, members, reach = local.series, local.mode, local.members, local.reach
    of_all, stuck_z, origin, due, v = expansion.series, expansion.stuck_z, local.origin, local.due, model.belt_speed
    for a in range(count):
        i = members[a]
        zeros = n_zeros if a == 0 and mode[a] != 0 else 0
        for k in range(order + 1):
            of_all[k, i] = series[k, a]
        stuck_z[i] += v[i] * (s - origin[i])
        origin[i] = s
        face = mode[a], zeros, 0
        time = next_event(model, expansion, i, face, series, a, reach[a], (order, h))
        _schedule(due, i, s + time)


@inner
def _pass_on_from(run: Run[Local], window: Window, block: int, span: tuple[float, float]) -> float:
    """Carry the series over an event of one block at the start of a span, if no other event is near it then.

    Returns the end of the window, at most that of the span; less than its start if a new expansion is to decide (then
    nothing has changed).
    """
    model, expansion, local = run.model, run.work.expansion, run.work.local
    (s, end), order, allowed = span, window.order, window.allowed
    members, place, series, pull = local.members, local.place, local.series, expansion.pull
    left, v = end - s, model.belt_speed[block]
    members[0] = block
    _bring(model, expansion, local, order, s, 0, 1)
    was_stuck = local.mode[0] == 0
    pull_of(model, block, local.mode[0], series, 0, order, pull)
    force = model.damping[block] * v + pull[0]
    new = decide(model, block, was_stuck, force, pull[1], window, run.goal.rate)
    if new == UNDECIDED or left <= 0.0:
        return -1.0
    start = curvature(model, block, was_stuck, new, force)
    jump, power = 2.0 * abs(start if was_stuck else start - series[2, 0]), left
    for k in range(1, order - 1):
        jump += power * abs(pull[k])
        power *= left
    local.mode[0] = new
    local.slips[0] = 1.0 if new != 0 else 0.0
    place[block] = 0
    ties, left = _gather(model, expansion, local, window, control.GROWTH * jump, left)
    count = local.ends[ties]
    for k in range(ties + 1, len(local.ends)):
        local.ends[k] = count
    _bring(model, expansion, local, order, s, 1, count)
    z = expansion.stuck_z[block] + v * (s - local.origin[block]) if was_stuck else series[0, 0]
    _pass_on(model, local, order, start, count, pull, was_stuck)
    series[0, 0], series[1, 0] = z, v
    for k in (order, order - 1):  # two, since one can vanish, by parity as in `expand`
        for a in range(count):
            tail = k * abs(series[k, a]) * left ** (k - 1)
            if tail > allowed:
                left *= (allowed / tail) ** (1.0 / (k - 1))
    if new == 0:
        for k in range(order - 1):
            series[k, 0] = pull[k]
    enclose(series, local.slips, order, left, local.reach, count)
    is_carried = _is_alone(model, local, left, count, window.z_max)
    for a in range(count):
        place[members[a]] = -1
    if not is_carried:
        return -1.0
    expansion.mode[block] = new
    expansion.slips[block] = local.slips[0]
    n_zeros = 2 if was_stuck and model.static[block] == model.friction[block] else 1
    _put_back(run, order, (s, left), count, n_zeros)
    expansion.stuck_z[block] = z
    return s + left


@inner
def _close(run: Run[Local], window: Window, s: float, block: int) -> None:
    """The state at the end of a window, and which blocks are to be decided there."""
    model, work, state = run.model, run.work, run.state
    expansion, noise, v, order = work.expansion, work.expansion.near, model.belt_speed, window.order
    z, w, n, power = state.z, state.w, len(state.z), window.span
    series, mode, touching = expansion.series, expansion.mode, expansion.touching
    for i in range(n):
        noise[i] = abs(series[1, i] - v[i])
    for k in range(2, order + 1):
        for i in range(n):
            noise[i] += power * abs(k * series[k, i])
        power *= window.span
    evaluate(expansion, v, work.local.origin, order, s, z, w)
    for i in range(n):
        touching[i] = mode[i] != 0 and mode[i] * (w[i] - v[i]) <= ROUNDING * noise[i]
    if block >= 0:
        touching[block] = mode[block] != 0


@inner
def _blank() -> Opened:
    return Opened(Window(0, 0.0, 0.0, 0.0), 0.0)


@inner
def _open(run: Run[Local], window: Opened, remaining: float) -> Opened:
    """Expand all series, and decide the modes of blocks at their belt's speed; `carry` leaves no window open."""
    model, work, goal, state = run.model, run.work, run.goal, run.state
    target = control.next_window(state.clock, remaining)
    target = min(target, control.SPARSE_SPAN / goal.rate) if goal.rate > 0.0 else target
    order, h, allowed, n_products = expand(model, work.expansion, goal, state, target)
    state.counters[course.N_PRODUCTS] += n_products
    work.local.origin[:] = 0.0
    return Opened(Window(order, h, allowed, largest(state.z) + h * allowed / goal.tol), target)


@inner
def _at(run: Run[Local], window: Opened, t: float) -> None:
    sample(run.work.expansion, run.model.belt_speed, run.work.local.origin, window.series.order, t, t, run.state)


@inner
def _pass_event(run: Run[Local], window: Window, block: int, span: tuple[float, float]) -> float:
    """Carry the series over an event at the start of a span, if no other is due then; returns as `_pass_on_from`."""
    due, s = run.work.local.due, span[0]
    _schedule(due, block, NEVER)
    if due[1] <= s + instant(run.goal, run.state.clock[course.TIME]):
        return -1.0
    return _pass_on_from(run, window, block, span)


@inner
def _carry(
    run: Run[Local], opened: Opened, is_after_event: bool, events: Events, n_recorded: int
) -> tuple[Opened, int, bool]:
    """Go on to the end of the window, from event to event; see `frame.Way`."""
    model, work, goal, state = run.model, run.work, run.goal, run.state
    expansion, local, clock, counters, mode = work.expansion, work.local, state.clock, state.counters, state.mode
    window, target, n, n_slip = opened.series, opened.target, len(mode), 0
    t, lacked, error_before = clock[course.TIME], clock[course.LACKING], clock[course.ERROR]
    _schedule_all(run, window.order, window.span)
    for i in range(n):
        n_slip += abs(mode[i])
    error = error_after(model, expansion, goal, window, window.span, error_before)
    s, end, block, goes_on = 0.0, window.span, -1, True
    while goes_on:
        counters[course.N_STEPS] += 1
        is_event, goes_on = local.due[1] <= end, False
        length = min(local.due[1], end) - s
        s = min(local.due[1], end)
        clock[course.TIME], clock[course.LACKING] = course.later(t, lacked, s, goal.t_end)
        sample(expansion, model.belt_speed, local.origin, window.order, t, clock[course.TIME], state)
        if stalls(goal, counters, length, clock[course.TIME], not is_after_event):
            return opened, n_recorded, True
        block = -1
        if is_event:
            block = _winner(local.due)
            counters[course.LAST_BLOCK] = block
            was = mode[block]
            # while none slips, nothing is expanded yet
            carried_to = _pass_event(run, window, block, (s, end)) if n_slip > 0 else -1.0
            if carried_to >= s:
                end, is_after_event = min(end, carried_to), True
                n_recorded = record(run, (block, was), error, events, n_recorded)
                course.note_event(clock, counters)
                n_slip += abs(mode[block]) - abs(was)
                is_asked = n_slip == n and course.is_check_due(state, mode, run.precheck, goal.t_end - t - s)
                goes_on = n_slip > 0 and not is_asked and n_recorded + n <= len(events.t)
    clock[course.ERROR] = error_after(model, expansion, goal, window, s, error_before)
    _close(run, window, s, block)
    clock[control.EXPOSURE] += min(s, target)
    control.note_window(clock, s < target)
    return opened, n_recorded, False


advance = frame(Way(_blank, _open, note, _at, _carry), __name__)
