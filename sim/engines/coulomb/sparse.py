"""The exact engine's steps where K is sparse: an event concerns the blocks near it, and no others.

Every block keeps a series about an instant of its own in the window, and the time of its own next event; the first of
all is the winner of a tournament tree. An event changes the block's own series from the second order on, those tied
to it from the fourth, those one tie further from the sixth: after so many ties that the rest is far below the
tolerance, or at blocks that stick, it ends. So an event costs what its surroundings cost, however many blocks there
are, and a window holds as many events as fall into it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import loop
from stickslip.sim.engines.coulomb.events import enclose, excluded, root
from stickslip.sim.engines.coulomb.sticking import force_rounding, push
from stickslip.sim.engines.coulomb.taylor import ORDER_MAX, PASSED_ON, UNDECIDED, Window, decide, expand
from stickslip.sim.engines.coulomb.windows import (
    CRAWL,
    CUTS,
    DECAY,
    EXPOSURE,
    REACH,
    evaluate,
    record,
    sample,
    stalls,
)
from stickslip.sim.kernels.compile import inner, kernel
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.arithmetic import ROUNDING, copy, largest

#: A window is at most this long, in units of 1 / |eigenvalue|: orders are cheap for all blocks together, not for each
#: event alone.
_SPAN = 2.0
#: An event is carried over to at most this share of the blocks, or to this many: beyond, a new expansion costs less.
_SHARE, _FEW = 8, 24
#: By how much more the effect of an event may grow in a window.
_GROWTH = math.exp(_SPAN)
_NEVER = math.inf


class Nearby(NamedTuple):
    """What is kept of n blocks through a window, and room for an event and the blocks near it."""

    pull: float  #: the largest row sum of |K|
    origin: Floats  #: the instant about which a block's series is, from the start of the window
    due: Floats  #: a tournament tree: block i's next event at size + i, the earlier of 2 k and 2 k + 1 at k
    place: NDArray[np.int64]  #: of a block among the members; -1 if it is none
    members: NDArray[np.int64]  #: the blocks near the event, its own first
    series: Floats  #: of the members, about the event
    forces: Floats
    changes: Floats  #: by what the event changes the coefficients
    step: Floats
    reach: Floats
    slips: Floats
    damping: Floats
    mode: NDArray[np.int8]
    ends: NDArray[np.int64]  #: how many members are at most k ties away from the event

    @classmethod
    def of(cls, n: int, pull: float) -> Nearby:
        """Room for n blocks."""
        size, most = 1 << (n - 1).bit_length(), min(n, max(_FEW, n // _SHARE))
        return cls(
            pull=pull,
            origin=np.zeros(n),
            due=np.full(2 * size, _NEVER),
            place=np.full(n, -1),
            members=np.zeros(most, np.int64),
            series=np.zeros((ORDER_MAX + 1, most)),
            forces=np.zeros((ORDER_MAX + 1, most)),
            changes=np.zeros((ORDER_MAX + 1, most)),
            step=np.zeros(most),
            reach=np.zeros(most),
            slips=np.zeros(most),
            damping=np.zeros(most),
            mode=np.zeros(most, np.int8),
            ends=np.zeros(ORDER_MAX, np.int64),
        )


@inner
def _schedule(due, i, time):  # type: ignore[no-untyped-def]
    """Enter block i's next event."""
    k = len(due) // 2 + i
    due[k] = time
    while k > 1:
        k //= 2
        due[k] = min(due[2 * k], due[2 * k + 1])


@inner
def _winner(due):  # type: ignore[no-untyped-def]
    """The block whose event is the first."""
    size = len(due) // 2
    k = 1
    while k < size:
        k = 2 * k if due[2 * k] == due[k] else 2 * k + 1
    return k - size


@inner
def _open(model, expansion, search, nearby, order, h):  # type: ignore[no-untyped-def]
    """Begin a window: all series are about its start, and every block's next event within h is found."""
    series, forces, mode, due = expansion.series, expansion.forces, expansion.mode, nearby.due
    zeros, side, reach, room = expansion.zeros, expansion.side, search.reach, (search.poly, search.found)
    damping, static, closed, v = model.damping, model.static, model.closed, model.belt_speed
    n, size = len(mode), len(due) // 2
    enclose(series, forces, expansion.slips, order, h, reach, n)
    for i in range(n):
        due[size + i] = _NEVER
        face, motion = (mode[i], zeros[i], side[i]), (series[1, i], series[2, i], forces[0, i], forces[1, i])
        if excluded(face, motion, (v[i], damping[i] * v[i], static[i], closed[i]), h, reach[i]):
            continue
        time, is_found = root(model, i, series, forces, i, face, (order, h), room)
        due[size + i] = time if is_found else _NEVER
    for k in range(size - 1, 0, -1):
        due[k] = min(due[2 * k], due[2 * k + 1])


@inner
def _bring(model, expansion, nearby, order, s, first, last):  # type: ignore[no-untyped-def]
    """Move the series of the members in these places to an instant of the window."""
    series, forces, step = nearby.series, nearby.forces, nearby.step
    for a in range(first, last):
        i = nearby.members[a]
        step[a] = s - nearby.origin[i]
        nearby.mode[a] = expansion.mode[i]
        nearby.damping[a] = model.damping[i]
        nearby.slips[a] = expansion.slips[i]
        for k in range(order + 1):
            series[k, a] = expansion.series[k, i]
        for k in range(order - 1):
            forces[k, a] = expansion.forces[k, i]
    for k in range(order):
        for j in range(order - 1, k - 1, -1):
            for a in range(first, last):
                series[j, a] += step[a] * series[j + 1, a]
    for k in range(order - 2):
        for j in range(order - 3, k - 1, -1):
            for a in range(first, last):
                forces[j, a] += step[a] * forces[j + 1, a]


@inner
def _gather(model, expansion, nearby, window, jump, left):  # type: ignore[no-untyped-def]
    """List the blocks to which an event is carried over, behind its own, and cut the window to what they allow.

    `jump` bounds by what the event changes its block's w' in what is left of the window. Returns how many ties away
    the last are, and what is left.
    """
    order, allowed = window.order, window.allowed
    columns, members, place, ends = model.columns, nearby.members, nearby.place, nearby.ends
    first, count, ties = 0, 1, 0
    ends[0] = count
    share = 0.5 * jump * left / (PASSED_ON * allowed)  # what w errs by if the event ends here, over what it may
    while share > 1.0 and first < count and 2 * ties + 2 <= order:
        for a in range(first, ends[ties]):
            j = members[a]
            if a > 0 and expansion.mode[j] == 0:
                continue
            for p in range(columns.indptr[j], columns.indptr[j + 1]):
                i = columns.indices[p]
                if place[i] < 0:
                    if count == len(members):
                        for b in range(ends[ties], count):
                            place[members[b]] = -1
                        return ties, left * share ** (-1.0 / (2 * ties + 1))
                    place[i] = count
                    members[count] = i
                    count += 1
        first = ends[ties]
        ties += 1
        ends[ties] = count
        share *= nearby.pull * left * left / ((2 * ties + 1) * (2 * ties + 2))
    return ties, left


@inner
def _pass_on(model, nearby, order, start, count):  # type: ignore[no-untyped-def]
    """The series of the members from the event on; `start` is c_2 of its own block."""
    columns, members, place, ends = model.columns, nearby.members, nearby.place, nearby.ends
    series, forces, changes, slips = nearby.series, nearby.forces, nearby.changes, nearby.slips
    series[1, 0] = model.belt_speed[members[0]]
    for k in range(order - 1):
        if k >= 2:
            for a in range(min(count, ends[(k - 2) // 2])):
                j = members[a]
                for p in range(columns.indptr[j], columns.indptr[j + 1]):
                    b = place[columns.indices[p]]
                    if b >= 0:
                        forces[k, b] += columns.data[p] * changes[k, a]
        factor = -1.0 / ((k + 2) * (k + 1))
        for a in range(min(count, ends[k // 2])):
            c = slips[a] * factor * (nearby.damping[a] * (k + 1) * series[k + 1, a] + forces[k, a])
            if k == 0:
                c = start
            changes[k + 2, a] = c - series[k + 2, a]
            series[k + 2, a] = c


@inner
def _is_alone(model, nearby, h, count, z_max):  # type: ignore[no-untyped-def]
    """Whether no other member is at the edge of its mode."""
    series, mode, v = nearby.series, nearby.mode, model.belt_speed
    for a in range(1, count):
        i = nearby.members[a]
        if mode[a] == 0:
            drag = model.damping[i] * v[i]
            slack = force_rounding(drag, model.row_sums[i] * z_max, model.static[i], 0.0)
            if push(model.closed[i], drag + nearby.forces[0, a]) >= model.static[i] - slack:
                return False
        else:
            gap = series[1, a] - v[i]
            if mode[a] * gap <= ROUNDING * (abs(gap) + abs(2.0 * series[2, a] * h) + nearby.reach[a]):
                return False
    return True


@inner
def _put_back(model, expansion, search, nearby, order, span, count, n_zeros):  # type: ignore[no-untyped-def]
    """Take over the series of the members, and find the next event of each in a span from s, of length h."""
    s, h = span
    series, forces, mode, reach = nearby.series, nearby.forces, nearby.mode, nearby.reach
    room = search.poly, search.found
    damping, static, closed, v = model.damping, model.static, model.closed, model.belt_speed
    for a in range(count):
        i = nearby.members[a]
        zeros = n_zeros if a == 0 and mode[a] != 0 else 0
        for k in range(order + 1):
            expansion.series[k, i] = series[k, a]
        for k in range(order - 1):
            expansion.forces[k, i] = forces[k, a]
        nearby.origin[i] = s
        due = _NEVER
        face, motion = (mode[a], zeros, 0), (series[1, a], series[2, a], forces[0, a], forces[1, a])
        if not excluded(face, motion, (v[i], damping[i] * v[i], static[i], closed[i]), h, reach[a]):
            time, is_found = root(model, i, series, forces, a, face, (order, h), room)
            due = s + time if is_found else _NEVER
        _schedule(nearby.due, i, due)


@inner
def _carry(model, goal, expansion, search, nearby, window, block, span):  # type: ignore[no-untyped-def]
    """Carry the series over an event of one block at the start of a span, if nothing else happens near it then.

    Returns until when the window holds, at most to the end of the span; less than its start if a new expansion is to
    decide (then nothing has changed).
    """
    (s, end), order, allowed = span, window.order, window.allowed
    members, place, series, forces = nearby.members, nearby.place, nearby.series, nearby.forces
    left = end - s
    members[0] = block
    _bring(model, expansion, nearby, order, s, 0, 1)
    was_stuck = nearby.mode[0] == 0
    friction, static = model.friction[block], model.static[block]
    force = model.damping[block] * model.belt_speed[block] + forces[0, 0]
    new = decide(model, block, was_stuck, force, forces[1, 0], window, goal.rate)
    if new == UNDECIDED or left <= 0.0:
        return -1.0
    start = 0.0
    if was_stuck:
        start = 0.5 * (static - friction) * new
    elif new != 0:
        start = -0.5 * (force + friction * new)
    jump, power = 2.0 * abs(start - series[2, 0]), left
    for k in range(1, order - 1):
        jump += power * abs(forces[k, 0])
        power *= left
    nearby.mode[0] = new
    nearby.slips[0] = 1.0 if new != 0 else 0.0
    place[block] = 0
    ties, left = _gather(model, expansion, nearby, window, _GROWTH * jump, left)
    count = nearby.ends[ties]
    for k in range(ties + 1, len(nearby.ends)):
        nearby.ends[k] = count
    _bring(model, expansion, nearby, order, s, 1, count)
    _pass_on(model, nearby, order, start, count)
    for k in (order, order - 1):  # two, since one can vanish, by parity as in `expand`
        for a in range(count):
            tail = k * abs(series[k, a]) * left ** (k - 1)
            if tail > allowed:
                left *= (allowed / tail) ** (1.0 / (k - 1))
    enclose(series, forces, nearby.slips, order, left, nearby.reach, count)
    is_carried = _is_alone(model, nearby, left, count, window.z_max)
    for a in range(count):
        place[members[a]] = -1
    if not is_carried:
        return -1.0
    expansion.mode[block] = new
    expansion.slips[block] = nearby.slips[0]
    n_zeros = 2 if was_stuck and static == friction else 1
    _put_back(model, expansion, search, nearby, order, (s, left), count, n_zeros)
    return s + left


@inner
def _close(model, state, expansion, search, origin, window, s, block):  # type: ignore[no-untyped-def]
    """The state at an instant at which a window ends, and who is to be decided there."""
    z, w, order, h = state.z, state.w, window.order, window.span
    series, near, v = expansion.series, search.near, model.belt_speed
    n = len(z)
    for i in range(n):
        near[i] = abs(series[1, i] - v[i])
    power = h
    for k in range(2, order + 1):
        for i in range(n):
            near[i] += power * abs(k * series[k, i])
        power *= h
    evaluate(series, origin, order, s, z, w)
    for i in range(n):
        mode = expansion.mode[i]
        expansion.touching[i] = mode != 0 and mode * (w[i] - v[i]) <= ROUNDING * near[i]
    if block >= 0:
        expansion.touching[block] = expansion.mode[block] != 0


@kernel
def advance(model, goal, state, expansion, search, nearby, events, watch):  # type: ignore[no-untyped-def]
    """Windows until the end, or until Python has something to do; goes on where it stopped when called again."""
    t_end, rate = goal.t_end, goal.rate
    z, w, mode, clock, counters = state.z, state.w, state.mode, state.clock, state.counters
    due = nearby.due
    n = len(z)
    n_recorded = 0
    n_last = counters[loop.N_STEPS] + loop.STEPS_A_SLICE
    while counters[loop.N_STEPS] < n_last:
        if n_recorded + n > len(events.t):
            return loop.BUFFER_FULL, n_recorded
        t = clock[loop.TIME]
        remaining = t_end - t
        if remaining <= 0.0 and not goal.is_last:
            return loop.DONE, n_recorded  # what sticks from here on, the next piece decides
        target = min(remaining, REACH * clock[EXPOSURE] / clock[CUTS])
        target = min(target, _SPAN / rate) if rate > 0.0 else target
        order, h, allowed, n_products = expand(model, expansion, goal, state, target)
        counters[loop.N_PRODUCTS] += n_products
        nearby.origin[:] = 0.0
        if counters[loop.N_STEPS] == 0:
            copy(mode, search.initial_mode)
            copy(mode, search.known_mode)
        before = n_recorded
        n_recorded, same = record(t, mode, search.known_mode, events, n_recorded)
        loop.note_all_stuck_at(same and mode[0] == 0, t, z, events, counters)
        if remaining <= 0.0:
            sample(expansion.series, nearby.origin, order, t, t, state)  # of a run that has no length
            return loop.DONE, n_recorded
        if same and loop.is_check_due(clock, mode) and loop.may_collapse(state, mode, watch):
            return loop.ALL_SLIP, n_recorded

        _open(model, expansion, search, nearby, order, h)
        n_slip = 0
        for i in range(n):
            n_slip += abs(mode[i])
        window = Window(order, h, allowed, largest(z) + h * allowed / goal.tol)
        s, end, block = 0.0, h, -1
        while True:
            counters[loop.N_STEPS] += 1
            is_event = due[1] <= end
            moved = min(due[1], end) - s
            s = min(due[1], end)
            now = t_end if s == remaining else min(t + s, t_end)
            sample(expansion.series, nearby.origin, order, t, now, state)
            clock[loop.TIME] = now
            # rounding can also make touches of a block that feels one far larger than itself: an end, but no event
            unseen = CRAWL / rate if rate > 0.0 and n_recorded == before else 0.0
            instant = ROUNDING * max(min(1.0, t_end), now)
            before = n_recorded
            if stalls(counters, moved, max(instant, unseen)):
                return loop.STALLED, n_recorded
            if not is_event:
                block = -1
                break
            block = _winner(due)
            counters[loop.LAST_BLOCK] = block
            was = mode[block]
            _schedule(due, block, _NEVER)
            if n_slip == 0 or due[1] <= s + instant:  # nothing is expanded yet, or others are due too
                break
            held = _carry(model, goal, expansion, search, nearby, window, block, (s, end))
            if held < s:
                break
            end = min(end, held)
            events.t[n_recorded] = now
            events.block[n_recorded] = block
            events.mode[n_recorded] = mode[block]
            search.known_mode[block] = mode[block]
            n_recorded += 1
            n_slip += abs(mode[block]) - abs(was)
            is_asked = n_slip == n and now > min(clock[loop.CHECK], clock[loop.CHECK + 1])
            if n_slip == 0 or is_asked or n_recorded + n > len(events.t) or counters[loop.N_STEPS] >= n_last:
                break
        _close(model, state, expansion, search, nearby.origin, window, s, block)
        clock[EXPOSURE] = DECAY * (clock[EXPOSURE] + min(s, target))
        clock[CUTS] = DECAY * (clock[CUTS] + (1.0 if s < target else 0.0))
        if not (
            largest(z) <= goal.bound and largest(w) <= goal.bound
        ):  # in a maximum one that is not a number may be lost
            return loop.DIVERGED, n_recorded
    return loop.PAUSED, n_recorded
