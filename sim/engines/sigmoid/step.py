"""Steps of the sigmoid engine: how its macro steps are solved, controlled and put together; see `collocation.py`."""

from __future__ import annotations

import numpy as np

from stickslip.sim.engines import loop
from stickslip.sim.engines.forcing import value_at
from stickslip.sim.engines.sigmoid.collocation import (
    AT_PEAK,
    BELT,
    CLOSED,
    DAMPING,
    DONE,
    ERROR,
    FALL,
    FAR,
    FINE,
    FLAGGED,
    FORCE0,
    FRICTION,
    HIDDEN,
    KEPT_F,
    KEPT_U,
    LENGTH,
    MEAN_U,
    MOMENT,
    MOMENT_U,
    MOVED,
    N_ROWS,
    NEAR_PEAK,
    PASSED,
    PEAK,
    PRODUCT,
    REACH,
    SIZE,
    SPEED_BEFORE,
    START,
    STATIC,
    STEEP,
    STEP_H,
    SUSPECT,
    TAIL,
    TAKEN,
    TOLERANCE,
    U0,
    U_MACRO,
    Z0,
    Z_BEFORE,
    Z_MACRO,
    F,
    G,
    H,
    U,
    Z,
    finish,
    force,
    force_changed,
    gather,
    gather_u,
    newton,
    predict,
    prepare,
    probe,
    view,
)
from stickslip.sim.engines.sigmoid.layer import (
    PASSES,
    PIECE_AT,
    PIECE_H,
    PIECE_NEXT,
    PIECE_U,
    PIECE_Z,
    note_stills,
    sample,
    step_events,
)
from stickslip.sim.engines.watch import too_far
from stickslip.sim.kernels.compile import inner, kernel
from stickslip.sim.numerics.arithmetic import copy, largest
from stickslip.sim.numerics.lanes import ALL, WIDTH
from stickslip.sim.numerics.panels import products
from stickslip.sim.numerics.radau import NODES, PROJECT, STAGES, TO_POWERS
from stickslip.sim.numerics.roots import horner

#: The most sweeps over F, Newton's iterations of a macro step in the first sweep, and of a step of a block's own.
_SWEEPS, _NEWTON, _NEWTON_OWN = 8, 5, 8
#: Of tolerance: what the leading coefficient of F may change w by in a step, and what the iteration over F may leave,
#: as (_SWEPT / boost)^2 of the boost below. What it leaves has one sign, that of what a prediction errs by: on
#: a cycle of stick and slip it adds up step by step, and the steps for tight tolerances are many.
_TAIL, _SWEPT = 3.0, 3.0
#: The share of that for a first sweep to be the last: what a prediction errs by has one sign, step by step.
_AT_ONCE = 0.1
#: The share of tolerance that K in float32 may cost in w.
_ROUGH_SHARE = 0.05
#: A block's own steps have the tolerance BOOST tol^POWER: superconvergence makes the error at their end far less
#: than that of the polynomial.
BOOST, POWER = 3.0, 0.85
#: A step changes by these factors at most. A prediction is good for little more than its own length: _GROW_FAST is
#: for steps far below what is allowed.
_SAFETY, _SHRINK, _GROW, _GROW_FAST, _GROW_OWN = 0.9, 0.2, 1.25, 2.0, 5.0
_FAR_BELOW = 1e-2
# behind the common clocks: the next step to try, the one whose polynomials are kept, what a sweep leaves of a change,
# and whether F has jumped since the last step
STEP, _KEPT, _SLOW, JUMPED = range(loop.N_CLOCKS, loop.N_CLOCKS + 4)
#: Rows that a block keeps in steps of its own.
_OF_BLOCK = (
    U0, Z0, DAMPING, STEEP, FRICTION, BELT, TOLERANCE, REACH, HIDDEN, PEAK, FINE, FAR, FALL, CLOSED, PASSED, AT_PEAK,
    STATIC,
)  # fmt: skip
_products, _single_products = products(STAGES), products(STAGES, single=True)


@inner
def _begin(table, n, macro, kept, numbers):  # type: ignore[no-untyped-def]
    """Begin a macro step at the end of the one that is kept."""
    for k in range(STAGES):
        x = 1.0 + NODES[k] * macro / kept
        for j in range(STAGES):
            numbers[k, j] = horner(TO_POWERS[:, j], STAGES - 1, x)
    numbers[STAGES, STEP_H] = macro
    numbers[STAGES, SIZE] = largest(table[Z0, :n])
    for first in range(0, n, WIDTH):
        predict(table, first, numbers)


@inner
def _flag(first, n, well, flags, listed, n_listed):  # type: ignore[no-untyped-def]
    """Flag and list those of `WIDTH` blocks that are not well; returns how many are listed."""
    for lane in range(min(WIDTH, n - first)):
        if flags[first + lane] or not (well >> lane) & 1:
            flags[first + lane] = True
            listed[n_listed] = first + lane
            n_listed += 1
    return n_listed


@inner
def _together(table, n, flags, listed, iterations, law):  # type: ignore[no-untyped-def]
    """All blocks in one step; those for which that does not do are flagged, and listed. Returns how many."""
    n_listed, some = np.int64(0), False
    for i in range(n):
        table[DONE, i] = 1.0 if flags[i] else 0.0
        some = some or flags[i]
    for first in range(0, n, WIDTH):
        for _ in range(iterations):
            if newton(table, first, law) == ALL:
                break
        well = finish(table, first, law)
        if some or well != ALL:
            n_listed = _flag(first, n, well, flags, listed, n_listed)
    return n_listed


@inner
def _strayed(table, n, flags, listed, n_listed, law):  # type: ignore[no-untyped-def]
    """Flag and list those whose one step does not do off the nodes; returns how many are listed."""
    for first in range(0, n, WIDTH):
        well = probe(table, first, law)
        if well != ALL:
            for lane in range(min(WIDTH, n - first)):
                if not flags[first + lane] and not (well >> lane) & 1:
                    flags[first + lane] = True
                    listed[n_listed] = first + lane
                    n_listed += 1
    return n_listed


@inner
def _fine(own, lane):  # type: ignore[no-untyped-def]
    """What part of its tolerance a step may err by."""
    return own[FINE, lane] if abs(own[U0, lane]) < NEAR_PEAK * own[PEAK, lane] else 1.0


@inner
def _factor(own, lane):  # type: ignore[no-untyped-def]
    """By how much the next step may be longer."""
    if own[DONE, lane] < 0.5:
        return 0.25
    allowed = own[TOLERANCE, lane] * _fine(own, lane)
    return min(max(_SAFETY * (allowed / max(own[ERROR, lane], 1e-300)) ** (1.0 / STAGES), 0.1), _GROW_OWN)


@inner
def _project(own, of, since, lane, table, to, i):  # type: ignore[no-untyped-def]
    """At the nodes of the macro step, the polynomial next to what a lane has the moments of in the mean square."""
    for k in range(STAGES):
        value = own[since, lane]
        for p in range(STAGES):
            value += PROJECT[k, p] * own[of + p, lane]
        table[to + k, i] = value


@inner(counts=True)
def _apart(  # type: ignore[no-untyped-def]
    table, own, listed, n_listed, macro, with_u, next_h, ends, pieces, piece_block, begins, old, numbers, law
):
    """The listed blocks in steps of their own, side by side. Returns how many pieces, or -1 - i if i cannot.

    A block takes the steps of the sweep before, `old` from `begins`, from where they led, as long as they will do.
    """
    n_pieces = np.int64(0)
    block, again, last = np.full(WIDTH, -1), np.full(WIDTH, -1), np.full(WIDTH, -1)
    waiting, active = 0, 0
    for lane in range(WIDTH):
        for row in range(N_ROWS):
            own[row, lane] = 0.0
        own[H, lane] = 1.0
        own[STEEP, lane] = 1.0
    while True:
        for lane in range(WIDTH):
            if block[lane] < 0 and waiting < n_listed:
                i = listed[waiting]
                waiting += 1
                active += 1
                block[lane], again[lane], last[lane] = i, begins[i], -1
                for row in _OF_BLOCK:
                    own[row, lane] = table[row, i]
                for p in range(STAGES):
                    value = 0.0
                    for k in range(STAGES):
                        value += TO_POWERS[p, k] * table[F + k, i]
                    own[G + p, lane] = value
                    own[MOMENT + p, lane] = 0.0
                    own[MOMENT_U + p, lane] = 0.0
                own[START, lane] = 0.0
                own[Z_MACRO, lane], own[U_MACRO, lane] = table[Z0, i], table[U0, i]
                own[LENGTH, lane] = min(next_h[i] / macro, 1.0)
        if active == 0:
            return n_pieces
        for lane in range(WIDTH):
            own[DONE, lane] = 1.0 if block[lane] < 0 else 0.0
            if block[lane] >= 0:
                rest = 1.0 - own[START, lane]
                length = own[LENGTH, lane]
                if again[lane] >= 0:
                    length = old[again[lane], PIECE_H]
                elif length > 0.97 * rest:
                    length = rest
                elif length > 0.5 * rest:
                    length = 0.5 * rest
                own[LENGTH, lane] = length
                own[H, lane] = length * macro
        prepare(own, 0, law)
        for lane in range(WIDTH):
            if again[lane] >= 0:
                for k in range(STAGES):
                    own[U + k, lane] = old[again[lane], PIECE_U + 1 + k]
        for _ in range(_NEWTON_OWN):
            if newton(own, 0, law) == ALL:
                break
        finish(own, 0, law)
        probe(own, 0, law)
        for lane in range(WIDTH):
            does = block[lane] >= 0 and own[DONE, lane] > 0.5 and own[SUSPECT, lane] < 0.5
            does = does and own[ERROR, lane] <= own[TOLERANCE, lane] * _fine(own, lane)
            own[TAKEN, lane] = own[LENGTH, lane] if does else 0.0
        gather(own, 0, numbers)
        if with_u:
            gather_u(own, 0, numbers)
        for lane in range(WIDTH):
            i = block[lane]
            if i < 0:
                continue
            length = own[LENGTH, lane]
            if own[TAKEN, lane] == 0.0:
                own[LENGTH, lane] = length * min(_factor(own, lane), 0.5)
                again[lane] = -1
                if not length > 1e-13:
                    return -1 - i
                continue
            if n_pieces == len(piece_block):
                return -1 - i
            piece = pieces[n_pieces]
            piece_block[n_pieces] = i
            piece[PIECE_NEXT] = -1.0
            if last[lane] < 0:
                begins[i] = n_pieces
            else:
                pieces[last[lane], PIECE_NEXT] = n_pieces
            last[lane] = n_pieces
            n_pieces += 1
            if again[lane] >= 0:
                again[lane] = np.int64(old[again[lane], PIECE_NEXT])
            start = own[START, lane]
            piece[PIECE_AT], piece[PIECE_H] = start, length
            piece[PIECE_Z], piece[PIECE_U] = own[Z0, lane], own[U0, lane]
            for k in range(STAGES):
                piece[PIECE_U + 1 + k] = own[U + k, lane]
            if again[lane] < 0:
                own[LENGTH, lane] = length * _factor(own, lane)
            own[U0, lane] = own[U + STAGES - 1, lane]
            own[Z0, lane] = own[Z + STAGES - 1, lane]
            own[START, lane] = start + length
            if own[START, lane] >= 1.0 - 1e-12:
                ends[0, i], ends[1, i] = own[U0, lane], own[Z0, lane]
                next_h[i] = own[LENGTH, lane] * macro
                _project(own, MOMENT, Z_MACRO, lane, table, Z, i)
                if with_u:
                    _project(own, MOMENT_U, U_MACRO, lane, table, MEAN_U, i)
                block[lane], again[lane] = -1, -1
                active -= 1
                own[H, lane] = 1.0
                own[STEEP, lane] = 1.0
                own[FRICTION, lane] = 0.0
                for k in range(STAGES):
                    own[G + k, lane] = 0.0


@inner(counts=True)
def _times(matrix, x, y):  # type: ignore[no-untyped-def]
    """y_k = K x_k at all nodes, K in panels or, when these are none, by sparse rows (indptr, indices, data)."""
    dense, _, indptr, indices, data = matrix
    if len(dense) > 0:
        _products(dense, x, y)
        return
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


@inner(counts=True)
def _couple(table, n, matrices, flags, is_first, rough, work, pushes, law):  # type: ignore[no-untyped-def]
    """F from z (and u) at the nodes. Returns what w may change by, and the tail of F, both over tolerance."""
    matrix, cross, with_cross = matrices
    product, single, single_product = work
    changed = False
    if not is_first and len(matrix[1]) > 0 and not with_cross:
        for k in range(Z, Z + STAGES):
            for i in range(n):
                table[PRODUCT + k - Z, i] = table[k, i] - table[Z_BEFORE + k - Z, i]
        most = 0.0
        for k in range(PRODUCT, PRODUCT + STAGES):
            most = max(most, largest(table[k, :n]))
        changed = most < rough
        if changed:
            for k in range(STAGES):
                for i in range(n):
                    single[k, i] = np.float32(table[PRODUCT + k, i])
            _single_products(matrix[1], single, single_product)
            for k in range(STAGES):
                for i in range(n):
                    table[PRODUCT + k, i] = single_product[k, i]
    if not changed:
        _times(matrix, table[Z : Z + STAGES], table[PRODUCT : PRODUCT + STAGES])
    if with_cross:
        for k in range(STAGES):
            for i in range(n):
                table[MEAN_U + k, i] = table[MEAN_U + k, i] if flags[i] else table[U + k, i]
        _times(cross, table[MEAN_U : MEAN_U + STAGES], product)
        for k in range(STAGES):
            for i in range(n):
                table[PRODUCT + k, i] += product[k, i]
    if not changed:
        for k in range(len(pushes)):
            for i in range(n):
                table[PRODUCT + k, i] -= pushes[k, i]
    for k in range(STAGES):
        for i in range(n):
            table[Z_BEFORE + k, i] = table[Z + k, i]
    for first in range(0, n, WIDTH):
        if changed:
            force_changed(table, first, law)
        else:
            force(table, first, law)
    return largest(table[MOVED, :n]), largest(table[TAIL, :n])


@inner
def _worst(table, n):  # type: ignore[no-untyped-def]
    """The block whose F is least known."""
    worst, most = 0, 0.0
    for i in range(n):
        here = max(table[MOVED, i], table[TAIL, i])
        if not here <= most and most == most:  # what is not a number is worst
            worst, most = i, here
    return worst


@inner(counts=True)
def _sweep(  # type: ignore[no-untyped-def]
    table, own, n, matrices, macro, boost, rough, slow, flags, listed, next_h, before, ends, pieces, piece_block,
    begins, old, work, pushes, numbers, law, counters,
):  # fmt: skip
    """Sweep over the blocks until F stays. Returns whether it does, the tail of F, `slow`, and how many pieces.

    `slow` is what a sweep leaves of a change, as seen before. The last sweep needs no product if what it leaves of
    the last change of F does not count. If the tail is too large the step is given up: sweeps hardly change it.
    """
    swept_below = min(1.0, (_SWEPT / boost) ** 2)
    tail, n_pieces, n_listed, last, is_last = 0.0, np.int64(0), np.int64(0), np.inf, False
    for i in range(n):
        begins[i] = -1
    for sweep in range(_SWEEPS):
        for k in range(n_pieces):
            copy(pieces[k], old[k])
        n_before = n_listed
        n_listed = _together(table, n, flags, listed, _NEWTON, law)
        if is_last:
            n_listed = _strayed(table, n, flags, listed, n_listed, law)
        for k in range(n_listed):
            next_h[listed[k]] = before[listed[k]]
        n_pieces = _apart(
            table, own, listed, n_listed, macro, matrices[2], next_h, ends, pieces, piece_block, begins, old, numbers,
            law,
        )  # fmt: skip
        if n_pieces < 0:
            break
        if is_last and n_listed == n_before:
            return True, tail, slow, n_pieces
        moved, tail = _couple(table, n, matrices, flags, sweep == 0, rough, work, pushes, law)
        counters[loop.N_PRODUCTS] += STAGES * (2 if matrices[2] else 1)
        moved, tail = moved * boost, tail * boost
        if not tail < _TAIL:
            break
        now = min(moved / last, 0.9) if sweep > 0 else slow
        enough = swept_below * (1.0 - now) * (_AT_ONCE if sweep == 0 else 1.0)
        if moved < enough and _strayed(table, n, flags, listed, n_listed, law) == n_listed:
            return True, tail, slow, n_pieces
        is_last = sweep > 0 and moved * now < enough
        last, slow = moved, now
    return False, tail, slow, n_pieces


@inner
def _accept(table, n, flags, macro, next_h, ends, z, w):  # type: ignore[no-untyped-def]
    """Go to the end of a macro step."""
    for i in range(n):
        table[SPEED_BEFORE, i] = abs(table[U0, i] + table[BELT, i])
        table[FLAGGED, i] = 1.0 if flags[i] else 0.0
        if flags[i]:
            table[U0, i], table[Z0, i] = ends[0, i], ends[1, i]
        else:
            table[U0, i], table[Z0, i] = table[U + STAGES - 1, i], table[Z + STAGES - 1, i]
            next_h[i] = max(next_h[i], macro)
        z[i], w[i] = table[Z0, i], table[U0, i] + table[BELT, i]
    copy(table[F + STAGES - 1], table[FORCE0])
    for k in range(STAGES):
        copy(table[F + k], table[KEPT_F + k])
        copy(table[U + k], table[KEPT_U + k])


@inner
def _first_instant(events, first, n_recorded, instant):  # type: ignore[no-untyped-def]
    """Of events from the first on, keep those up to an instant; returns how many are recorded then."""
    at, block, to, _ = events
    n_kept = first
    for k in range(first, n_recorded):
        if at[k] <= instant:
            at[n_kept], block[n_kept], to[n_kept] = at[k], block[k], to[k]
            n_kept += 1
    return n_kept


@kernel(counts=True)
def advance(  # type: ignore[no-untyped-def]
    table, own, numbers, law, matrices, rough_rate, work, definitions, flags, listed, next_h, pieces, piece_block,
    begins, old, z, w, clock, counters, samples, t_end, instant, longest, outside, pushes, atol, boost, events, bound,
    watch,
):  # fmt: skip
    """Steps until the end, or until Python has something to do; goes on where it stopped when called again.

    With an `instant` >= 0, one step to see what happens by then, and the state stays as it is.
    """
    n = len(z)
    mode = definitions[3][0]
    ends, before, mode_before = np.empty((2, n)), np.empty(n), np.empty(n, dtype=np.int8)
    n_recorded = np.int64(0)
    grown = True
    n_left = loop.STEPS_A_SLICE
    while n_left > 0:
        n_left -= 1
        t = clock[loop.TIME]
        remaining = t_end - t
        if remaining <= 0.0:  # a run of no length may want its samples
            sample(table, n, flags, pieces, piece_block, np.int64(0), (t, 1.0, t), samples, counters)
            return loop.DONE, n_recorded
        if n_recorded + PASSES * (n + len(piece_block)) * len(definitions[0]) > len(events[0]):
            return loop.BUFFER_FULL, n_recorded
        if mode[0] != 0 and t > clock[loop.CHECK + (mode[0] > 0)]:
            same = True
            for i in range(n):
                same = same and mode[i] == mode[0]
            if same:
                later = too_far(watch, z, w, mode[0])
                if later == 0.0:
                    return loop.ALL_SLIP, n_recorded
                clock[loop.CHECK + (mode[0] > 0)] = t + later
                if n_recorded > 0:
                    return loop.PAUSED, n_recorded
                n_left, grown = loop.STEPS_A_SLICE, True  # as a slice begins: it is the same who answered
        macro = min(clock[STEP], longest)
        if macro >= 0.999 * remaining:
            macro = remaining
        elif macro > 0.5 * remaining:
            macro = 0.5 * remaining
        _begin(table, n, macro, clock[_KEPT], numbers)
        for k in range(len(pushes)):
            value_at(outside, t + NODES[k] * macro, pushes[k])
        copy(next_h, before)
        for i in range(n):  # what a step that leaves a layer errs by, no layer takes back
            flags[i] = clock[JUMPED] > 0.0 and abs(table[U0, i]) * table[STEEP, i] < table[REACH, i]
        rough = _ROUGH_SHARE * atol / (max(1.0, macro) * macro * rough_rate)
        swept, tail, slow, n_pieces = _sweep(
            table, own, n, matrices, macro, boost, rough, clock[_SLOW], flags, listed, next_h, before, ends, pieces,
            piece_block, begins, old, work, pushes, numbers, law, counters,
        )  # fmt: skip
        if not swept:
            counters[loop.N_REJECTED] += 1
            counters[loop.LAST_BLOCK] = _worst(table, n) if n_pieces >= 0 else -1 - n_pieces
            factor = max(_SAFETY * (_TAIL / tail) ** (1.0 / 3.0), _SHRINK) if tail > _TAIL else 0.5
            clock[STEP], clock[_SLOW] = macro * factor, 0.0
            grown = False
            if clock[STEP] <= 1e-14 * max(min(1.0, t_end), t):
                return loop.STALLED, n_recorded
            copy(before, next_h)
            continue
        counters[loop.N_STEPS] += 1
        t_next = t_end if macro == remaining else t + macro
        span = t, macro, t_next
        for first in range(0, n, WIDTH):
            view(table, first, numbers)
        copy(mode, mode_before)
        first_event = n_recorded
        n_recorded = step_events(
            table, n, flags, pieces, piece_block, n_pieces, definitions, span, events, n_recorded
        )
        if instant >= 0.0:
            n_recorded = _first_instant(events, first_event, n_recorded, instant)
        note_stills(
            table, n, flags, pieces, piece_block, n_pieces, span, mode_before, first_event, n_recorded, events,
            counters,
        )  # fmt: skip
        if instant >= 0.0:
            return loop.DONE, n_recorded
        sample(table, n, flags, pieces, piece_block, n_pieces, span, samples, counters)
        _accept(table, n, flags, macro, next_h, ends, z, w)
        factor = _SAFETY * (_TAIL / max(tail, 1e-300)) ** (1.0 / STAGES)
        most = _GROW_FAST if tail < _FAR_BELOW * _TAIL else _GROW
        clock[loop.TIME], clock[_KEPT], clock[_SLOW], clock[JUMPED] = t_next, macro, slow, 0.0
        clock[STEP] = macro * min(max(factor, _SHRINK), most if grown else 1.0)
        grown = True
        if not (largest(z) <= bound and largest(w) <= bound):  # in a maximum one that is not a number may be lost
            return loop.DIVERGED, n_recorded
    return loop.PAUSED, n_recorded
