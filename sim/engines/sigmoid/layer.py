"""Who sticks under the smoothed law, and when that changes: events and samples on a macro step.

`stickslip.sim.engines.sigmoid.settings` says what the definitions of sticking are. u = w - v and F are polynomials of
degree five on a macro step, u of a block on steps of its own on each of these *pieces*.
"""

from __future__ import annotations

import math

import numpy as np

from stickslip.sim.engines import loop
from stickslip.sim.engines.sigmoid.collocation import (
    BELT,
    CLOSED,
    DAMPING,
    FORCE0,
    FRICTION,
    HIDDEN,
    HIGH,
    HIGH_FORCE,
    LOW,
    LOW_FORCE,
    PEAK,
    STATIC,
    STEEP,
    TOLERANCE,
    U0,
    Z0,
    F,
    U,
    Z,
)
from stickslip.sim.engines.sigmoid.friction import sign_of_number
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arithmetic import room
from stickslip.sim.numerics.radau import ALL_NODES, ALL_TO_POWERS, BARYCENTRIC, NODES, STAGES, TO_BERNSTEIN, WEIGHTS
from stickslip.sim.numerics.roots import horner, insert, insert_roots, refine

#: A piece: where it starts and how long it is, as shares of the macro step; z at its start, which piece of
#: its block is next; u at its start and its nodes.
PIECE_AT, PIECE_H, PIECE_Z, PIECE_NEXT, PIECE_U = range(5)
PIECE = PIECE_U + 1 + STAGES
#: Places on the bounds of a band that a block can pass in a piece: eleven polynomials of degree five, and the start.
PASSES = 11 * STAGES + 1
_MARKS, _NODES = PASSES + 1, STAGES + 1


@inner
def mode_of(mode, gap, force, friction, band, by_force):  # type: ignore[no-untyped-def]
    """Mode of a block under the smoothed law, from its mode before, w - v and F.

    `friction` is kinetic, static, and the w - v at which the law has its peak: a block that slips beyond it is not
    held while F drives it on.
    """
    kinetic, static, peak = friction
    if kinetic > 0.0 and abs(gap) < band and (not by_force or abs(force) < static):
        is_driven = mode != 0 and abs(gap) > peak and -force * math.copysign(1.0, gap) > kinetic
        if not (by_force and is_driven):
            return 0
    return 1 if gap > 0.0 else (-1 if gap < 0.0 else 0)


@inner
def _hull(values, bernstein):  # type: ignore[no-untyped-def]
    """Coefficients of Bernstein's polynomials from values at the start and the nodes; their bounds."""
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
def _powers(values, poly):  # type: ignore[no-untyped-def]
    """Coefficients of powers from values at the start and the nodes."""
    for p in range(STAGES + 1):
        poly[p] = 0.0
        for k in range(STAGES + 1):
            poly[p] += ALL_TO_POWERS[p, k] * values[k]


@inner
def _marks(poly, bernstein, bound, marks, n_marks, found):  # type: ignore[no-untyped-def]
    """Add the places in (0, 1] where a polynomial passes a bound, in rising order."""
    above, below, changes = False, False, 0
    for j in range(STAGES + 1):
        above, below = above or bernstein[j] >= bound, below or bernstein[j] <= bound
        changes += j > 0 and (bernstein[j] > bound) != (bernstein[j - 1] > bound)
    if not (above and below):
        return n_marks
    at_start = poly[0]
    poly[0] -= bound
    if changes == 1 and bernstein[0] != bound and bernstein[STAGES] != bound:
        n_marks = insert(refine(poly, STAGES, 0.0, 1.0, bernstein[0] < bound), marks, n_marks)
    else:
        n_marks = insert_roots(poly, STAGES, marks, n_marks, found)
    poly[0] = at_start
    return n_marks


@inner
def _at(values, x):  # type: ignore[no-untyped-def]
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
def _to_open(closed, gap, force):  # type: ignore[no-untyped-def]
    """w - v and F, without what they are beyond the belt's speed or push to on a side that is closed."""
    if closed < 0.0:
        return max(gap, 0.0), min(force, 0.0)
    if closed > 0.0:
        return min(gap, 0.0), max(force, 0.0)
    return gap, force


@inner
def _keeps(closed, low, high, low_force, high_force, static, band, by_force, mode):  # type: ignore[no-untyped-def]
    """Whether u and F between these bounds keep to the mode, if one side may be closed."""
    low, low_force = _to_open(closed, low, low_force)
    high, high_force = _to_open(closed, high, high_force)
    return _stays(low, high, low_force, high_force, static, band, by_force, mode)


@inner
def _stays(low, high, low_force, high_force, static, band, by_force, mode):  # type: ignore[no-untyped-def]
    """Whether u and F between these bounds keep to the mode."""
    if mode == 0:
        return low > -band and high < band and (not by_force or (low_force > -static and high_force < static))
    if (low >= band) if mode > 0 else (high <= -band):
        return True
    slides = by_force and (low_force >= static or high_force <= -static)
    return slides and (low > 0.0 if mode > 0 else high < 0.0)


@inner
def _of_piece(u, force, table, i, band, borne, by_force, mode, span, label, events, n_recorded, work):  # type: ignore[no-untyped-def]
    """Record the changes of mode of block i on a piece; u and F by values at the start and the nodes.

    Only a force above what friction and damping bear at the edge of the band drives a block out of it: what seems to
    leave it with less, and no farther than a step may err by, is an overshoot of the polynomial.
    """
    of_u, of_force, poly_u, poly_force, marks, found = work[0], work[1], work[2], work[3], work[4], work[5]
    mu, static, peak, strays = table[FRICTION, i], table[STATIC, i], table[PEAK, i], table[TOLERANCE, i]
    low, high = _hull(u, of_u)
    low_force, high_force = _hull(force, of_force)
    closed = table[CLOSED, i]
    if _keeps(closed, low, high, low_force, high_force, static, band, by_force, mode):
        return mode, n_recorded
    t, h, t_next = span
    at, block, to, _ = events
    _powers(u, poly_u)
    _powers(force, poly_force)
    n_marks = _marks(poly_u, of_u, 0.0, marks, np.int64(0), found)
    bears = borne * sign_of_number(band * table[STEEP, i], table[HIDDEN, i]) + table[DAMPING, i] * band
    if mu > 0.0:
        for sign in (-1.0, 1.0):
            n_marks = _marks(poly_u, of_u, sign * band, marks, n_marks, found)
            n_marks = _marks(poly_force, of_force, sign * bears, marks, n_marks, found)
            if by_force:
                n_marks = _marks(poly_force, of_force, sign * static, marks, n_marks, found)
                if peak < band:
                    n_marks = _marks(poly_u, of_u, sign * peak, marks, n_marks, found)
                    n_marks = _marks(poly_force, of_force, sign * mu, marks, n_marks, found)
    for k in range(n_marks + 1):
        left = marks[k - 1] if k > 0 else 0.0
        right = marks[k] if k < n_marks else 1.0
        if right <= left:
            continue
        middle = 0.5 * (left + right)
        gap, pull = _to_open(closed, horner(poly_u, STAGES, middle), horner(poly_force, STAGES, middle))
        new = mode_of(mode, gap, pull, (mu, static, peak), band, by_force)
        is_borne = mode == 0 and mu > 0.0 and -new * pull < bears and (not by_force or abs(pull) < static)
        if new != mode and not (is_borne and abs(gap) < band + strays):
            at[n_recorded] = min(t + h * left, t_next)  # rounding may pass the end of the run
            block[n_recorded] = label
            to[n_recorded] = new
            mode = new
            n_recorded += 1
    return mode, n_recorded


@inner
def step_events(table, n, flags, pieces, piece_block, n_pieces, definitions, span, events, n_recorded):  # type: ignore[no-untyped-def]
    """Record all changes of mode on a macro step, by every definition of sticking; returns how many are recorded.

    `span` is where the step starts, how long it is and where it ends; of definition d blocks are labelled i + d n.
    """
    bands, borne, by_force, modes = definitions
    t, macro, t_next = span
    work, nodes = room(6, _MARKS), room(3, _NODES)
    u, force, of_piece = nodes[0], nodes[1], nodes[2]
    for d in range(len(bands)):
        mode, band = modes[d], bands[d]
        for i in range(n):
            if flags[i] or _keeps(
                table[CLOSED, i], table[LOW, i], table[HIGH, i], table[LOW_FORCE, i], table[HIGH_FORCE, i],
                table[STATIC, i], band[i], by_force[d], mode[i],
            ):  # fmt: skip
                continue
            u[0], force[0] = table[U0, i], table[FORCE0, i]
            for k in range(STAGES):
                u[k + 1], force[k + 1] = table[U + k, i], table[F + k, i]
            mode[i], n_recorded = _of_piece(
                u, force, table, i, band[i], borne[d, i], by_force[d], mode[i], span, d * n + i, events, n_recorded,
                work,
            )  # fmt: skip
        last = -1
        for k in range(n_pieces):
            i, piece = piece_block[k], pieces[k]
            low, high = _hull(piece[PIECE_U:], work[0])
            if _keeps(
                table[CLOSED, i], low, high, table[LOW_FORCE, i], table[HIGH_FORCE, i], table[STATIC, i], band[i],
                by_force[d], mode[i],
            ):  # fmt: skip
                continue
            if i != last:
                last = i
                force[0] = table[FORCE0, i]
                for j in range(STAGES):
                    force[j + 1] = table[F + j, i]
            for j in range(STAGES + 1):
                of_piece[j] = _at(force, piece[PIECE_AT] + piece[PIECE_H] * ALL_NODES[j])
            mode[i], n_recorded = _of_piece(
                piece[PIECE_U:], of_piece, table, i, band[i], borne[d, i], by_force[d], mode[i],
                (t + macro * piece[PIECE_AT], macro * piece[PIECE_H], t_next), d * n + i, events, n_recorded, work,
            )  # fmt: skip
    return n_recorded


@inner(counts=True)
def note_stills(  # type: ignore[no-untyped-def]
    table, n, flags, pieces, piece_block, n_pieces, span, mode, first, n_recorded, events, counters
):
    """Keep where the blocks are when all come to stick, or one leaves, among the events of a macro step from `first`.

    `mode` is of before it, and becomes that of after it.
    """
    count = 0
    for i in range(n):
        count += mode[i] == 0
    if counters[loop.N_STEPS] == 1:
        loop.note_still(count == n, span[0], table[Z0, :n], events, counters)
    most = count
    for k in range(first, n_recorded):
        most += events[1][k] < n and events[2][k] == 0
    if n_recorded == first or most < n:
        return
    where, z, w = np.zeros(loop.N_COUNTERS, dtype=np.int64), np.empty((1, n)), np.empty((1, n))
    order = np.arange(first, n_recorded)
    for place in range(1, len(order)):  # by time; few, and to compile NumPy's own sort takes a second
        k = order[place]
        while place > 0 and events[0][order[place - 1]] > events[0][k]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = k
    for place in range(len(order)):
        k = order[place]
        i = events[1][k]
        if i < n:
            count += (events[2][k] == 0) - (mode[i] == 0)
            mode[i] = events[2][k]
        t = events[0][k]
        is_last = place + 1 == len(order) or events[0][order[place + 1]] > t
        if is_last and (count == n) != (counters[loop.IS_STILL] == 1):
            where[loop.N_SAMPLED] = 0
            sample(table, n, flags, pieces, piece_block, n_pieces, span, (np.full(1, t), z, w), where)
            loop.note_still(count == n, t, z[0], events, counters)


@inner
def sample(table, n, flags, pieces, piece_block, n_pieces, span, samples, counters):  # type: ignore[no-untyped-def]
    """Keep the state at all sample times of a macro step."""
    t, macro, t_next = span
    times, z_there, w_there = samples
    m = counters[loop.N_SAMPLED]
    weights = room(1, _NODES)[0]
    while m < len(times) and times[m] <= t_next:
        x = min((times[m] - t) / macro, 1.0)
        for k in range(STAGES + 1):
            weights[k] = horner(ALL_TO_POWERS[:, k], STAGES, x)
        for i in range(n):
            z, u = weights[0] * table[Z0, i], weights[0] * table[U0, i]
            for k in range(STAGES):
                z += weights[k + 1] * table[Z + k, i]
                u += weights[k + 1] * table[U + k, i]
            if not flags[i]:
                z_there[m, i], w_there[m, i] = z, table[BELT, i] + u
        for place in range(n_pieces):
            piece, i = pieces[place], piece_block[place]
            inside = (x - piece[PIECE_AT]) / piece[PIECE_H]
            if not 0.0 <= inside <= 1.0 + 1e-9:
                continue
            for k in range(STAGES + 1):
                weights[k] = horner(ALL_TO_POWERS[:, k], STAGES, inside)
            z, u = piece[PIECE_Z], weights[0] * piece[PIECE_U]
            for k in range(STAGES):
                u += weights[k + 1] * piece[PIECE_U + 1 + k]
                moved = NODES[k] * table[BELT, i]
                for j in range(STAGES):
                    moved += WEIGHTS[k, j] * piece[PIECE_U + 1 + j]
                z += weights[k + 1] * moved * piece[PIECE_H] * macro
            z_there[m, i], w_there[m, i] = z, table[BELT, i] + u
        m += 1
    counters[loop.N_SAMPLED] = m
