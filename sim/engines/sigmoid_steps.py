"""Steps of the sigmoid engine: how its macro steps are solved, controlled and put together; see `collocation.py`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from stickslip.sim import weakening
from stickslip.sim.arguments import Floats
from stickslip.sim.engines import certificates, loop
from stickslip.sim.engines.arithmetic import copy, largest
from stickslip.sim.engines.collocation import (
    AT_PEAK,
    BELT,
    CLOSED,
    DAMPING,
    DONE,
    DRAG,
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
    ROW_SUM,
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
from stickslip.sim.engines.compile import inner, kernel
from stickslip.sim.engines.contract import Ratios, Task
from stickslip.sim.engines.friction import Exponential, Peaked, Plain, Rational, Steady
from stickslip.sim.engines.lanes import ALL, WIDTH
from stickslip.sim.engines.layer import (
    PASSES,
    PIECE,
    PIECE_AT,
    PIECE_H,
    PIECE_NEXT,
    PIECE_U,
    PIECE_Z,
    note_stills,
    sample,
    step_events,
)
from stickslip.sim.engines.outside import Drive, value_at
from stickslip.sim.engines.panels import HEIGHT, ROUGH, SINGLE_HEIGHT, panels, products
from stickslip.sim.engines.radau import NODES, PROJECT, STAGES, TO_POWERS
from stickslip.sim.engines.roots import horner
from stickslip.sim.engines.sigmoid import Sigmoid
from stickslip.sim.engines.watch import too_far
from stickslip.sim.run import Run
from stickslip.sim.system import System
from stickslip.sim.theory.laws import hidden_term, turning_point

#: The most sweeps over F, Newton's iterations of a macro step in the first sweep, and of a step of a block's own.
_SWEEPS, _NEWTON, _NEWTON_OWN = 8, 5, 8
#: The tolerances inside over those asked for: so chosen that random systems err by what was asked for.
_CALIBRATION = 5.0
#: Of tolerance: what the leading coefficient of F may change w by in a step, and what the iteration over F may leave,
#: as (_SWEPT / boost)^2 of the boost below. What it leaves has one sign, that of what a prediction errs by: on
#: a cycle of stick and slip it adds up step by step, and the steps for tight tolerances are many.
_TAIL, _SWEPT = 3.0, 3.0
#: The share of that for a first sweep to be the last: what a prediction errs by has one sign, step by step.
_AT_ONCE = 0.1
#: The share of tolerance that K in float32 may cost in w.
_ROUGH_SHARE = 0.05
#: A block's own steps have the tolerance _BOOST tol^_POWER: superconvergence makes the error at their end far less
#: than that of the polynomial.
_BOOST, _POWER = 3.0, 0.85
#: But not where a step has passed the layer: its error counts by so many times the boost.
_PASSED = 3.0
#: What a step may err by at a peak of friction, over the root of what was asked for: F there is within the square of
#: static friction.
_OF_ROOT = 0.5
#: The share of a step's tolerance that is for leaving a peak of friction, over delta^(2/3): see `NEAR_PEAK`.
_FINE = 0.1
#: Slower than at this rate, in units of time, what has left a peak of friction by weakening alone is no matter.
_STEEP = 10.0
#: A step changes by these factors at most. A prediction is good for little more than its own length: _GROW_FAST is
#: for steps far below what is allowed.
_SAFETY, _SHRINK, _GROW, _GROW_FAST, _GROW_OWN = 0.9, 0.2, 1.25, 2.0, 5.0
_FAR_BELOW = 1e-2
#: Of friction: by how much F jumps where a belt's speed begins to change by another rate, if it is no rounding.
_JUMP = 1e-9
#: The laws of weakening whose shapes the engine knows.
_SHAPES: dict[type[weakening.Weakening], type[Rational] | type[Exponential]] = {
    weakening.Rational: Rational,
    weakening.Stribeck: Exponential,
}

# behind the common clocks: the next step to try, the one whose polynomials are kept, what a sweep leaves of a change,
# and whether F has jumped since the last step
_STEP, _KEPT, _SLOW, _JUMPED = range(loop.N_CLOCKS, loop.N_CLOCKS + 4)

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
def _advance(  # type: ignore[no-untyped-def]
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
        macro = min(clock[_STEP], longest)
        if macro >= 0.999 * remaining:
            macro = remaining
        elif macro > 0.5 * remaining:
            macro = 0.5 * remaining
        _begin(table, n, macro, clock[_KEPT], numbers)
        for k in range(len(pushes)):
            value_at(outside, t + NODES[k] * macro, pushes[k])
        copy(next_h, before)
        for i in range(n):  # what a step that leaves a layer errs by, no layer takes back
            flags[i] = clock[_JUMPED] > 0.0 and abs(table[U0, i]) * table[STEEP, i] < table[REACH, i]
        rough = _ROUGH_SHARE * atol / (max(1.0, macro) * macro * rough_rate)
        swept, tail, slow, n_pieces = _sweep(
            table, own, n, matrices, macro, boost, rough, clock[_SLOW], flags, listed, next_h, before, ends, pieces,
            piece_block, begins, old, work, pushes, numbers, law, counters,
        )  # fmt: skip
        if not swept:
            counters[loop.N_REJECTED] += 1
            counters[loop.LAST_BLOCK] = _worst(table, n) if n_pieces >= 0 else -1 - n_pieces
            factor = max(_SAFETY * (_TAIL / tail) ** (1.0 / 3.0), _SHRINK) if tail > _TAIL else 0.5
            clock[_STEP], clock[_SLOW] = macro * factor, 0.0
            grown = False
            if clock[_STEP] <= 1e-14 * max(min(1.0, t_end), t):
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
        clock[loop.TIME], clock[_KEPT], clock[_SLOW], clock[_JUMPED] = t_next, macro, slow, 0.0
        clock[_STEP] = macro * min(max(factor, _SHRINK), most if grown else 1.0)
        grown = True
        if not (largest(z) <= bound and largest(w) <= bound):  # in a maximum one that is not a number may be lost
            return loop.DIVERGED, n_recorded
    return loop.PAUSED, n_recorded


def runs(tasks: Sequence[Task], engine: Sigmoid) -> list[Callable[[], Run]]:
    """The runs of a task, or of several with plain systems of as many blocks: see `Engine.prepare`.

    Raises
    ------
    ValueError
        If there is not one ratio a block, the layer is too wide for its definition of sticking, or a block has
        static friction alone.
    IntegrationError
        Of a run: if the step shrinks to rounding.
    """
    systems = [task.system for task in tasks]
    system, n = systems[0], systems[0].n  # where it is not plain, it is the only one
    delta = Ratios.for_blocks("ratio", engine.ratio, n) * engine.eps
    is_manifold = engine.stick == "manifold"
    if is_manifold and not (delta < 1).all():
        raise ValueError(
            f"eps, ratio: stick='manifold' needs ratio * eps < 1, got {delta.max():g}; use stick='threshold'"
        )
    band = delta * np.log(1 / delta) if is_manifold else engine.threshold * delta
    by_force = np.array([is_manifold, *(False for _ in engine.thresholds)])
    rtol, atol = _CALIBRATION * engine.rtol, _CALIBRATION * engine.atol
    boost = max(1.0, _BOOST * (atol + rtol) ** (_POWER - 1.0))
    allowed = engine.atol + engine.rtol * np.array([one.fastest_belt for one in systems])
    law, hidden, peak = _law(system)
    if system.weakening is not None:
        peak = _peak(system, delta, hidden)

    # from here on by task and block, or by task, definition of sticking and block
    drives = [Drive(task.system, task.t_start, task.t_end, 0) for task in tasks]
    v = np.array([drive.belt_speed for drive in drives])
    z, w = np.array([task.z0 for task in tasks]), np.array([task.w0 for task in tasks])
    damping, friction, static, closed = (
        np.array([getattr(one, name) for one in systems]) for name in ("damping", "friction", "static", "closed")
    )
    near, far = (np.array(rows) for rows in zip(*(one.slip_friction for one in systems), strict=True))
    bands = np.array([band, *(c * delta for c in engine.thresholds)])
    bands = bands * (near > 0.0)[:, np.newaxis]  # without friction no block sticks
    kinetic = np.empty_like(bands)
    for k, one in enumerate(systems):
        kinetic[k] = one.kinetic(bands[k])
    drag, pull = (np.array(rows) for rows in zip(*map(_forces, systems, drives, z, w), strict=True))
    u = w - v
    modes = _modes(u, pull, bands, is_manifold, peak * delta, near, static, closed)
    table = _table(z, w, u, delta, damping, near, drag, pull)
    table[:, BELT, :n], table[:, STATIC, :n], table[:, CLOSED, :n] = v, static, closed
    table[:, PASSED, :n], table[:, AT_PEAK, :n] = _PASSED * boost, _OF_ROOT * np.sqrt(engine.atol + engine.rtol)
    table[:, HIDDEN, :n], table[:, PEAK, :n] = hidden, peak * delta
    table[:, ROW_SUM, :n] = np.array([one.row_sums for one in systems])
    table[:, FINE, :n] = np.where(peak < np.inf, np.minimum(_FINE * delta ** (2.0 / 3.0), 1.0), 1.0)
    if system.weakening is not None:
        table[:, FALL, :n] = system.weakening.steepness * delta
        table[:, FAR, :n] = np.divide(far, near, out=np.ones_like(near), where=near > 0)
    # how deep in the layer friction differs from kinetic by what counts
    table[:, REACH, :n] = 1.0 + 0.5 * np.log1p(2.0 * near * (1.0 + 2.0 * hidden) / (boost * atol))
    fastest = np.abs(np.array([w, damping * u + pull, friction])).max(axis=(0, 2)).tolist()
    matrices, widest = _matrices(systems), bands.max(axis=(1, 2)).tolist()
    pulls = np.array([one.row_sums for one in systems]).max(axis=1).tolist()
    n_pieces = 16 * n + 256

    def first_step(speed: float) -> float:
        return (atol**0.2) * 0.3 / speed if speed > 0 else np.inf

    @cache
    def smoothed(speed: float, widest: float) -> certificates.Smoothed:
        return certificates.Smoothed(speed, delta, hidden, float(band.max()), widest)

    def run(k: int) -> Run:
        task, system, drive, own = tasks[k], systems[k], drives[k], table[k]
        z, w, next_h = task.z0.copy(), task.w0.copy(), np.empty(n)
        step = min(drive.length, 0.1, first_step(fastest[k]))
        next_h[:] = step / 4
        state = loop.State.at_start(task, z, w, modes[k, 0], step, 1.0, 0.0, 0.0)
        state.counters[loop.N_PRODUCTS] = 1 if system.cross_damping is None else 2
        numbers = np.zeros((STAGES + 1, STAGES))
        numbers[STAGES, STEP_H + 1 :] = atol, rtol, boost, 0.0
        single = np.zeros((2, STAGES, -(-n // SINGLE_HEIGHT) * SINGLE_HEIGHT), np.float32)
        pushes = np.zeros((0 if drive.outside is None else STAGES, n))
        arguments = (
            own, np.zeros((N_ROWS, WIDTH)), numbers, law, matrices[k], ROUGH * pulls[k],
            (np.zeros((STAGES, own.shape[1])), single[0], single[1]),
            (bands[k], kinetic[k], by_force, modes[k]),
            np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.int64), next_h,
            np.empty((n_pieces, PIECE)), np.zeros(n_pieces, dtype=np.int64), np.empty(n, dtype=np.int64),
            np.empty((n_pieces, PIECE)), z, w, state.clock, state.counters, tuple(state.samples),
        )  # fmt: skip
        collapse = certificates.Collapse(system, allowed[k], smoothed(system.fastest_belt, widest[k]))
        longest = np.pi / drive.fastest if drive.fastest > 0 else np.inf

        def jumped() -> None:
            """F is not what friction was: blocks in the layer settle there, or leave it, in a time of its own."""
            state.clock[_JUMPED] = 1.0
            is_in = np.abs(own[U0, :n]) * own[STEEP, :n] < own[REACH, :n]
            np.minimum(next_h, 1.0 / np.maximum(own[FRICTION, :n] * own[STEEP, :n], 1.0), out=next_h, where=is_in)

        jumped()

        def go_on() -> None:
            """At the start of a piece: u is what it was; F jumps where belts' speeds change by another rate."""
            before = own[FORCE0, :n].copy()
            own[Z0, :n], own[BELT, :n] = z, drive.belt_speed
            own[DRAG, :n], own[FORCE0, :n] = _forces(system, drive, z, w)
            jump = np.abs(own[FORCE0, :n] - before)
            step = first_step(float(jump.max()))
            state.clock[_STEP] = min(state.clock[_STEP], step)
            next_h[:] = np.minimum(next_h, step / 4)
            if (jump > _JUMP * own[FRICTION, :n]).any():
                jumped()

        return loop.complete(
            task,
            state,
            drive,
            lambda events, bound: _advance(
                *arguments,
                drive.ahead if drive.is_instant else drive.length,
                drive.instant if drive.is_instant else -1.0,
                longest,
                drive.outside,
                pushes,
                atol,
                boost,
                tuple(events),
                bound,
                collapse.watch,
            ),
            collapse,
            stalled=f"the step fell to the rounding of time (rtol = {engine.rtol:g}, atol = {engine.atol:g}); use"
            " engine='coulomb', or raise rtol and atol by tens, which helps unless a belt or a force jumps",
            events_a_step=PASSES * (n + n_pieces) * len(by_force),
            initial_modes=modes[k].copy(),
            thresholds=engine.thresholds,
            go_on=go_on,
        )

    return [partial(run, k) for k in range(len(tasks))]


def _forces(system: System, drive: Drive, z: Floats, w: Floats) -> tuple[Floats, Floats]:
    """What belts give F by damping, and F, at the start of a piece."""
    v, cross = drive.belt_speed, system.cross_damping
    drag, pull = system.damping * v, system.damping * v + system.stiffness @ z
    if cross is not None:
        drag += cross.sum(axis=1) * v[0] if system.has_one_belt else cross @ v
        pull += cross @ w
    if drive.outside is not None:
        pull -= drive.value()
    return drag, pull


def _law(system: System) -> tuple[NamedTuple, Floats, Floats]:
    """The friction law, its c by block, and the x at which it has its peak.

    Raises
    ------
    ValueError
        If a block without kinetic friction has a static one, or a side that is closed.
    """
    friction, falls = system.slip_friction[0], system.weakening
    law: NamedTuple = Peaked() if system.is_static_above else Plain()
    if falls is not None:
        law = weakening.registered(_SHAPES, falls, "sigmoid")()
    elif not system.back_slip:
        law = Steady()
    if not system.back_slip and (friction[system.closed != 0] == 0).any():
        block = int(np.flatnonzero((friction == 0) & (system.closed != 0))[0])
        raise ValueError(
            f"back_slip: engine='sigmoid' bars a side by friction that grows, got none at block {block}; give it a"
            " small kinetic friction"
        )
    if not system.is_static_above:
        return law, np.zeros(system.n), np.full(system.n, np.inf)
    if (friction[system.static > friction] == 0).any():
        block = int(np.flatnonzero((friction == 0) & (system.static > 0))[0])
        raise ValueError(
            f"static: engine='sigmoid' smooths the ratio of static to kinetic friction, got {system.static[block]:g}"
            f" above 0 at block {block}; give it a small kinetic friction"
        )
    ratio = np.divide(system.static, friction, out=np.ones(system.n), where=friction > 0)
    hidden = hidden_term(ratio)
    lam = turning_point(hidden)
    return law, hidden, np.arctanh(lam, out=np.full(system.n, np.inf), where=lam < 1)


def _peak(system: System, delta: Floats, hidden: Floats) -> Floats:
    """The x at which a law that falls with the speed of slip has its peak; infinite where that counts for nothing."""
    assert system.weakening is not None
    near, far = system.slip_friction
    low, high = np.zeros(system.n), np.full(system.n, 20.0)
    for _ in range(6):  # to some 1e-8
        x = np.linspace(low, high, 64)
        lam = np.tanh(x)
        best = ((lam + hidden * lam * (1.0 - lam * lam)) * system.kinetic(delta * x)).argmax(axis=0)
        step = (high - low) / 63
        low, high = low + step * np.maximum(best - 1, 0), low + step * np.minimum(best + 1, 63)
    is_steep = (near - far) * system.weakening.steepness > _STEEP
    return np.where(is_steep | (hidden > 0.0), 0.5 * (low + high), np.inf)


def _modes(
    u: Floats,
    pull: Floats,
    bands: Floats,
    is_manifold: bool,
    peak: Floats,
    kinetic: Floats,
    static: Floats,
    closed: Any,
) -> NDArray[np.int8]:
    """Who sticks at the start, by each definition."""
    if closed.any():
        u, pull = np.where(u * closed > 0, 0.0, u), np.where(pull * closed < 0, 0.0, pull)
    held = np.abs(u)[:, np.newaxis] < bands
    if is_manifold:
        is_driven = (np.abs(u) > peak) & (-pull * np.sign(u) > kinetic)
        held[:, 0] &= (np.abs(pull) < static) & ~is_driven
    side = np.where(u != 0, np.sign(u), -np.sign(pull))  # on the belt's speed, where it goes next
    return np.where(held, 0, side[:, np.newaxis]).astype(np.int8)


def _table(
    z: Floats, w: Floats, u: Floats, delta: Floats, damping: Floats, friction: Floats, drag: Floats, pull: Floats
) -> Floats:
    """What formulas read and write, at the start; columns that are no block have numbers that are harmless."""
    several, n = z.shape
    table = np.zeros((several, N_ROWS, -(-n // HEIGHT) * HEIGHT))
    table[:, [STEEP, H, DONE, TOLERANCE]] = 1.0
    table[:, U0, :n], table[:, Z0, :n], table[:, SPEED_BEFORE, :n] = u, z, np.abs(w)
    table[:, DAMPING, :n], table[:, FRICTION, :n], table[:, STEEP, :n] = damping, friction, 1.0 / delta
    table[:, DRAG, :n], table[:, FORCE0, :n] = drag, pull
    table[:, KEPT_F : KEPT_F + STAGES, :n], table[:, KEPT_U : KEPT_U + STAGES, :n] = (
        pull[:, np.newaxis],
        u[:, np.newaxis],
    )
    return table


def _matrices(systems: Sequence[System]) -> list[tuple[Any, Any, bool]]:
    """K and N as `_times` takes them, and whether there is an N."""
    if len(systems) == 1:
        system, cross = systems[0], systems[0].cross_damping
        if system not in _MATRICES:
            kept = _matrix(system.stiffness), _NONE if cross is None else _matrix(cross), cross is not None
            _MATRICES[system] = kept
        return [_MATRICES[system]]
    dense, single, *no_rows = _matrix(np.array([one.stiffness for one in systems]))
    return [((dense[k], single[k], *no_rows), _NONE, False) for k in range(len(systems))]


def _matrix(matrix: Any) -> tuple[NDArray[Any], ...]:
    """Panels in float64 and float32 if it is dense, or dense ones, shape (m, n, n); else its rows."""
    if isinstance(matrix, np.ndarray):
        no_index = np.empty(0, dtype=np.int32)
        dense, single = panels(matrix, HEIGHT, np.float64), panels(matrix, SINGLE_HEIGHT, np.float32)
        return dense, single, no_index, no_index, np.empty(0)
    rows = matrix.tocsr()
    no_panels = np.empty((0, 0, HEIGHT)), np.empty((0, 0, SINGLE_HEIGHT), np.float32)
    return *no_panels, rows.indptr.astype(np.int32), rows.indices.astype(np.int32), rows.data.astype(np.float64)


_NONE = _matrix(np.empty((0, 0)))
#: Of systems that are run by themselves, as large ones are, from many starts: panels take as long as 30 products.
_MATRICES: WeakKeyDictionary[System, tuple[Any, Any, bool]] = WeakKeyDictionary()
