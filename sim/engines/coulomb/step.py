"""The exact engine: set-valued Coulomb friction, event by event, Taylor series between events.

Between events a sticking block moves with the belt (z linear in t: nothing to integrate) and a slipping one obeys
a linear equation: `stickslip.sim.engines.coulomb.taylor` expands them all. The next event is the first root of

    sigma (w - v)     of a slipping block,
    m + sigma F       of a sticking one, F = R v + K z = -mu lambda, for either sigma;

m is the static friction, mu if there is no other.

At an event every block with w = v is decided anew from |F| against m; when they are equal (every exit
starts there) the first coefficient of F that does not vanish decides, order by order, while the series is
being built: until a block is decided its motion is the same under either mode, so simultaneous events, folds,
cusps and tangencies of any order need no case of their own.

An event changes the equation of one block. That block's own series changes from the second order on, those of the
others from the fourth, by a column of K: `taylor.correct` carries most events over in O(n), without a product, and
one expansion serves a window of several events.

The series are explicit: R h is about 5 at most. Blocks of far larger R are followed on their slow motion, once they
are there: `stickslip.sim.engines.coulomb.overdamped`.
"""

from __future__ import annotations

from stickslip.sim.engines import loop
from stickslip.sim.engines.coulomb.events import enclose, excluded, root
from stickslip.sim.engines.coulomb.overdamped import follow
from stickslip.sim.engines.coulomb.sticking import force_rounding, known, push
from stickslip.sim.engines.coulomb.taylor import SPAN, correct, expand, shift
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
from stickslip.sim.numerics.arithmetic import ROUNDING, copy, largest

#: What is left of a window is used if it is more than this share of the mean length.
_WORTH = 0.1


@inner
def _first_event(model, expansion, search, order, h):  # type: ignore[no-untyped-def]
    """Time to the first root of any block's event function within h, and the block; (h, -1) if there is none."""
    series, forces, mode, room = expansion.series, expansion.forces, expansion.mode, (search.poly, search.found)
    zeros, side, reach = expansion.zeros, expansion.side, search.reach
    damping, static, closed, v = model.damping, model.static, model.closed, model.belt_speed
    enclose(series, forces, expansion.slips, order, h, reach, len(mode))
    block = -1
    for i in range(len(mode)):
        face, motion = (mode[i], zeros[i], side[i]), (series[1, i], series[2, i], forces[0, i], forces[1, i])
        if excluded(face, motion, (v[i], damping[i] * v[i], static[i], closed[i]), h, reach[i]):
            continue
        h, is_found = root(model, i, series, forces, i, face, (order, h), room)
        block = i if is_found else block
    return h, block


@inner
def _on_the_edge(model, expansion, near, z_max, w, block, has_forces):  # type: ignore[no-untyped-def]
    """Find the slipping blocks with w = v up to rounding; returns how many blocks this instant concerns.

    With the forces of this instant known, sticking blocks with |F| = mu count too.
    """
    v, mode, touching = model.belt_speed, expansion.mode, expansion.touching
    count = 0
    for i in range(len(mode)):
        touching[i] = mode[i] != 0 and mode[i] * (w[i] - v[i]) <= near[i]
        concerned = touching[i] or i == block
        if mode[i] == 0 and has_forces:
            force = model.damping[i] * v[i] + expansion.forces[0, i]
            noise = known(model.forcing, 0, i)
            slack = force_rounding(model.damping[i] * v[i], model.row_sums[i] * z_max, model.static[i], noise)
            concerned = concerned or push(model.closed[i], force) >= model.static[i] - slack
        count += concerned
    if block >= 0:
        touching[block] = mode[block] != 0
    return count


@kernel
def advance(model, goal, state, expansion, search, slow, events, watch):  # type: ignore[no-untyped-def]
    """Steps until the end, or until Python has something to do; goes on where it stopped when called again.

    A window is the reach of one expansion. An event inside it is carried over by `correct` where that can be done,
    else it ends the window.
    """
    t_end, rate, v = goal.t_end, goal.rate, model.belt_speed
    z, w, mode, clock, counters = state.z, state.w, state.mode, state.clock, state.counters
    series, touching, near = expansion.series, expansion.touching, search.near
    n = len(z)
    n_recorded = 0
    is_open, is_cut, is_slow = False, False, False
    order, h, span, allowed = 0, 0.0, 0.0, 0.0
    n_left = loop.STEPS_A_SLICE
    while n_left > 0:
        n_left -= 1
        if n_recorded + n > len(events.t):
            return loop.BUFFER_FULL, n_recorded
        t = clock[loop.TIME]
        remaining = t_end - t
        if remaining <= 0.0 and not goal.is_last:
            return loop.DONE, n_recorded  # what sticks from here on, the next piece decides
        if not is_open:
            target = min(remaining, REACH * clock[EXPOSURE] / clock[CUTS])
            order, h, allowed, n_products = follow(slow, model, expansion, goal, state, target)
            counters[loop.N_PRODUCTS] += n_products
            is_slow = order > 0
            if not is_slow:
                target = min(target, SPAN / rate) if rate > 0.0 else target
                order, h, allowed, n_products = expand(model, expansion, goal, state, target)
                counters[loop.N_PRODUCTS] += n_products
            span = h
            is_open, is_cut = True, model.weakening is not None and h < target
        if counters[loop.N_STEPS] == 0:
            copy(mode, search.initial_mode)
            copy(mode, search.known_mode)
        before = n_recorded
        n_recorded, same = record(t, mode, search.known_mode, events, n_recorded)
        loop.note_all_stuck_at(same and mode[0] == 0, t, z, events, counters)
        if remaining <= 0.0:
            sample(series, None, order, t, t, state)  # of a run that has no length
            return loop.DONE, n_recorded
        if same and loop.is_check_due(clock, mode):
            if loop.may_collapse(state, mode, watch):
                return loop.ALL_SLIP, n_recorded
            if n_recorded > 0:
                return loop.PAUSED, n_recorded
            n_left, is_open = loop.STEPS_A_SLICE, False  # as a slice begins: no result depends on the slicing
            continue

        step, block = _first_event(model, expansion, search, order, h)
        if not goal.is_last and remaining - step <= ROUNDING * t_end:
            step = remaining  # what rounding cannot tell from the end, the next piece decides
        counters[loop.N_STEPS] += 1
        if block >= 0:
            counters[loop.LAST_BLOCK] = block
        for i in range(n):
            near[i] = ROUNDING * (abs(series[1, i] - v[i]) + abs(2.0 * series[2, i] * h) + search.reach[i])
        t_next = t_end if step == remaining else min(t + step, t_end)
        sample(series, None, order, t, t_next, state)
        left = h - step
        is_inside = block >= 0 and left > 0.0 and model.weakening is None and not is_slow  # else it ends the window
        if is_inside:
            shift(series, order, step)
            shift(expansion.forces, order - 2, step)
            copy(series[0], z)
            copy(series[1], w)
            h = 0.0
            if _on_the_edge(model, expansion, near, largest(z), w, block, is_inside) == 1:
                h = correct(model, expansion, block, order, span, left, allowed, rate)
                touching[block] = mode[block] != 0  # should a new expansion come first, it decides the same
            is_cut = is_cut or h < left
            is_open = h > _WORTH * clock[EXPOSURE] / clock[CUTS]
        else:
            evaluate(series, None, order, step, z, w)
            _on_the_edge(model, expansion, near, 0.0, w, block, is_inside)
            is_open = False
            is_cut = is_cut or block >= 0
        clock[loop.TIME] = t_next
        clock[EXPOSURE] += step
        if not is_open:
            clock[EXPOSURE] *= DECAY
            clock[CUTS] = DECAY * (clock[CUTS] + (1.0 if is_cut else 0.0))
        # rounding can also make touches of a block that feels one far larger than itself: an end, but no event
        unseen = CRAWL / rate if rate > 0.0 and n_recorded == before else 0.0
        if stalls(counters, clock[loop.TIME] - t, max(ROUNDING * max(min(1.0, t_end), t), unseen)):
            return loop.STALLED, n_recorded
        if not (
            largest(z) <= goal.bound and largest(w) <= goal.bound
        ):  # in a maximum one that is not a number may be lost
            return loop.DIVERGED, n_recorded
    return loop.PAUSED, n_recorded
