"""The smoothed law by collocation, every block on steps of its own.

    z' = w,    w' = -R w - N w - K z - mu phi((w - v) / delta)        (N: off the diagonal of the damping, if given)

What couples the blocks, F = R v + K z + N w, is smooth, since z is two integrals behind the friction; all stiffness,
up to mu / delta, sits in each block alone. So all blocks share a *macro step* with the nodes of the Radau IIA method
of five stages, at which F is known, and each block by itself solves

    u' = -R u - F - mu phi(u / delta),    u = w - v,

with F the polynomial through the nodes: in one step of that method where this is accurate enough, else in steps of
its own. Its z at the nodes (of a block with steps of its own, the polynomial next to its z in the mean square: what
is left is orthogonal to degree four and hardly reaches the others) gives a new F, by one product of K with all nodes
at once, and the blocks are swept until F stays. A. Logg, SIAM J. Sci. Comput. 24 (2003) 1879-1902,
doi:10.1137/S1064827501389722, calls such methods multi-adaptive; the sweeps are waveform relaxation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from stickslip.sim.engines import certificates, loop
from stickslip.sim.engines.arithmetic import copy, largest
from stickslip.sim.engines.compile import inner, kernel
from stickslip.sim.engines.contract import Ratios, Task
from stickslip.sim.engines.lanes import (
    ALL,
    WIDTH,
    Lane,
    Numbers,
    Rows,
    absolute,
    dot,
    greater,
    less,
    on_number,
    on_rows,
    smooth_sign,
    total,
    where,
)
from stickslip.sim.engines.panels import HEIGHT, SINGLE_HEIGHT, panels, products
from stickslip.sim.engines.products import ROUGH
from stickslip.sim.engines.radau import (
    ALL_AT_PLACES,
    ALL_NODES,
    ALL_TO_POWERS,
    AT_PLACES,
    BARYCENTRIC,
    INVERSE,
    LAST,
    NODES,
    PLACES,
    PROJECT,
    STAGES,
    TO_BERNSTEIN,
    TO_LEGENDRE,
    TO_POWERS,
    WEIGHTS,
)
from stickslip.sim.engines.roots import horner, insert_roots
from stickslip.sim.engines.sigmoid import Sigmoid
from stickslip.sim.engines.sticking import mode_of
from stickslip.sim.run import Run
from stickslip.sim.system import System

#: What a formula reads and writes, by rows of a table: a column is a block, on the step that it is taking. First one
#: row each, then one row a node. H is the step, U0 and Z0 are u and z at its start, TOLERANCE is what it may err by.
(
    H, U0, Z0, DAMPING, STEEP, FRICTION, BELT, DRAG, TOLERANCE, REACH, DONE, RATE, ERROR, SUSPECT, LOW, HIGH,
    LOW_FORCE, HIGH_FORCE, FORCE0, SPEED_BEFORE, FLAGGED, MOVED, TAIL, START, LENGTH,
) = range(25)  # fmt: skip
F, U, Z, KEPT_F, KEPT_U, Z_BEFORE, PRODUCT, MEAN_U, G, MOMENT, MOMENT_U = range(25, 25 + 11 * STAGES, STAGES)
N_ROWS = 25 + 11 * STAGES
#: Numbers that a formula reads, the same for all blocks: weights of a prediction, and in a last row these.
_STEP_H, _V, _ATOL, _RTOL, _TO_TOLERANCE = range(5)

#: The most sweeps over F, Newton's iterations of a macro step in the first sweep, and of a step of a block's own.
_SWEEPS, _NEWTON, _NEWTON_OWN = 8, 5, 8
#: The share of a step's tolerance that Newton's method may leave.
_SOLVED = 0.05
#: The tolerances inside over those asked for: so chosen that random systems err by what was asked for.
_CALIBRATION = 3.0
#: Of tolerance: what the leading coefficient of F may change w by in a step, and what a sweep may still. What sweeps
#: leave adds up step by step, and the steps for tight tolerances are many: then it is _SWEPT over the boost below.
_TAIL, _SWEPT = 3.0, 20.0
#: The share of that for a first sweep to be the last: what a prediction errs by has one sign, step by step.
_AT_ONCE = 0.1
#: The share of tolerance that K in float32 may cost in w.
_ROUGH_SHARE = 0.05
#: A block's own steps have the tolerance _BOOST tol^_POWER: superconvergence makes the error at their end far less
#: than that of the polynomial.
_BOOST, _POWER = 3.0, 0.85
#: The next to last coefficient counts by this: by parity the last may vanish.
_LAST_BUT_ONE = 0.05
#: The defect at the start counts by this: extrapolated to there from the nodes, it is larger than between them.
_AT_START = 0.3
#: A step changes by these factors at most. A prediction is good for little more than its own length: _GROW_FAST is
#: for steps far below what is allowed.
_SAFETY, _SHRINK, _GROW, _GROW_FAST, _GROW_OWN = 0.9, 0.2, 1.25, 2.0, 5.0
_FAR_BELOW = 1e-2
#: Pieces are t, h (of the macro step), z, u at the start, u at the nodes.
_PIECE = 4 + STAGES
#: Places on the bounds of a band that a block can pass in a piece: seven polynomials of degree five, and the start.
_PASSES = 7 * STAGES + 1

# behind the common clocks: the next step to try, the one whose polynomials are kept, where on it the next one starts
_STEP, _KEPT, _FROM, _SLOW = range(loop.N_CLOCKS, loop.N_CLOCKS + 4)

friction_law = smooth_sign
_law = on_number(friction_law)
_products, _single_products = products(STAGES), products(STAGES, single=True)


# ---- formulas


def _newton_formula(rows: Rows, _: Numbers) -> Lane:
    """One iteration for u at the nodes: INVERSE (u - u0) + h (R u + F + mu phi(u / delta)) = 0. Gives who is done."""
    h, u0, steep, mu, done = rows[H], rows[U0], rows[STEEP], rows[FRICTION], rows[DONE]
    stages = range(STAGES)
    u, f = [rows[U + k] for k in stages], [rows[F + k] for k in stages]
    moved = [x - u0 for x in u]
    damping = rows[DAMPING]
    residual: list[Lane] = []
    matrix: list[list[Lane | float]] = []
    nearest = absolute(u[0])
    for k in stages:
        phi, slope = friction_law(u[k] * steep)
        force = damping * u[k] + f[k] + mu * phi
        residual.append(-(dot(INVERSE[k], moved) + h * force))
        row: list[Lane | float] = [float(a) for a in INVERSE[k]]
        row[k] = h * (damping + mu * steep * slope) + row[k]
        matrix.append(row)
        nearest = less(nearest, absolute(u[k]))
    pivots: list[Lane] = []
    for k in stages:  # no pivoting: the diagonal only grows
        pivots.append(1.0 / matrix[k][k])  # type: ignore[arg-type]
        for i in range(k + 1, STAGES):
            factor = pivots[k] * matrix[i][k]
            for j in range(k + 1, STAGES):
                matrix[i][j] = matrix[i][j] - factor * matrix[k][j]
            residual[i] = residual[i] - factor * residual[k]
    for k in reversed(stages):
        for j in range(k + 1, STAGES):
            residual[k] = residual[k] - residual[j] * matrix[k][j]
        residual[k] = residual[k] * pivots[k]
    still = done < 0.5
    change, size = absolute(residual[0]), absolute(u[0])
    scale = absolute(f[0])
    for k in range(1, STAGES):
        change, size = greater(change, absolute(residual[k])), greater(size, absolute(u[k]))
        scale = greater(scale, absolute(f[k]))
    finite = total(residual)
    for k in stages:
        rows[U + k] = where(still, u[k] + residual[k], u[k])
    x = change * steep
    inside = (x * change < rows[TOLERANCE] * _SOLVED) & ((x < 0.1) | (nearest * steep - x > 20.0))
    rounding = change < (size + absolute(u0) + h * scale) * 1e-15
    solved = (inside | rounding) & (absolute(finite) < 1e300) | (done > 0.5)
    rows[DONE] = where(solved, h * 0.0 + 1.0, 0.0)
    return solved


def _error(rate: list[Lane]) -> Lane:
    """Size of the last Legendre coefficients of what is given at the nodes."""
    return greater(absolute(dot(TO_LEGENDRE[-1], rate)), absolute(dot(TO_LEGENDRE[-2], rate)) * _LAST_BUT_ONE)


def _finish_formula(rows: Rows, _: Numbers) -> Lane:
    """From u at the nodes: z there, the rate at the end and the error by the nodes. Gives who is done within it."""
    h, u0, z0, belt = rows[H], rows[U0], rows[Z0], rows[BELT]
    stages = range(STAGES)
    u = [rows[U + k] for k in stages]
    moved = [x - u0 for x in u]
    rate = [dot(INVERSE[k], moved) for k in stages]  # times h
    for k in stages:
        rows[Z + k] = z0 + h * (dot(WEIGHTS[k], u) + belt * float(NODES[k]))
    rows[RATE] = rate[-1] / h
    error = _error(rate)
    rows[ERROR] = error
    return (rows[DONE] > 0.5) & (error < rows[TOLERANCE])


def _probe_formula(rows: Rows, _: Numbers) -> Lane:
    """The error off the nodes, and whether u may have strayed unseen. Gives who is well.

    Off the nodes the friction is not what the nodes make of it: the error is this defect divided by the stiffness
    there. A polynomial is suspect whose hull goes deeper into the layer than any place that was looked at.
    """
    h, u0, steep, mu, damping = rows[H], rows[U0], rows[STEEP], rows[FRICTION], rows[DAMPING]
    stages = range(STAGES)
    u = [rows[U + k] for k in stages]
    moved, values = [x - u0 for x in u], [u0, *u]
    # friction at the nodes, times -h, by the equations
    pull = [dot(INVERSE[k], moved) + h * (damping * u[k] + rows[F + k]) for k in stages]
    low, high = u0, u0
    for x in u:
        low, high = less(low, x), greater(high, x)
    error = rows[ERROR]
    for m in range(len(PLACES)):
        there = dot(ALL_AT_PLACES[m], values) if m > 0 else u0
        phi, slope = friction_law(there * steep)
        bent = damping * (there - dot(AT_PLACES[m], u)) + mu * phi
        defect = absolute(h * bent + dot(AT_PLACES[m], pull)) * (1.0 if m > 0 else _AT_START)
        error = greater(error, defect / (1.0 + h * (damping + mu * steep * slope)))
        low, high = less(low, there), greater(high, there)
    hull_low, hull_high = _bounds(values)
    rows[ERROR] = error
    reach = rows[REACH]
    under = (low * steep - hull_low * steep > 1.0) & (hull_low * steep < reach) & (low * steep > -reach)
    over = (hull_high * steep - high * steep > 1.0) & (hull_high * steep > -reach) & (high * steep < reach)
    suspect = under | over
    rows[SUSPECT] = where(suspect, h * 0.0 + 1.0, 0.0)
    return (error < rows[TOLERANCE]) & (where(suspect, h * 0.0 + 1.0, 0.0) < 0.5)


def _force_formula(is_change: bool) -> Callable[[Rows, Numbers], None]:
    """F from the products of K, of all of z or of what it changed by; what w may change by, and the tail of F."""

    def formula(rows: Rows, _: Numbers) -> None:
        drag = rows[DRAG]
        before = [rows[F + k] for k in range(STAGES)]
        after = [rows[PRODUCT + k] + (before[k] if is_change else drag) for k in range(STAGES)]
        most = absolute(after[0] - before[0])
        for k in range(1, STAGES):
            most = greater(most, absolute(after[k] - before[k]))
        for k in range(STAGES):
            rows[F + k] = after[k]
        scale = rows[H] / rows[TOLERANCE]
        rows[MOVED], rows[TAIL] = most * scale, _error(after) * scale

    return formula


def _bounds(values: list[Lane]) -> tuple[Lane, Lane]:
    """Of the polynomial with these values at the start and the nodes, by the hull of its Bernstein coefficients."""
    low, high = values[0], values[0]
    for j in range(1, STAGES + 1):
        coefficient = dot(TO_BERNSTEIN[j], values)
        low, high = less(low, coefficient), greater(high, coefficient)
    return low, high


def _view_formula(rows: Rows, _: Numbers) -> None:
    """Bounds of u and of F on the step."""
    rows[LOW], rows[HIGH] = _bounds([rows[U0], *(rows[U + k] for k in range(STAGES))])
    rows[LOW_FORCE], rows[HIGH_FORCE] = _bounds([rows[FORCE0], *(rows[F + k] for k in range(STAGES))])


def _predict_formula(rows: Rows, numbers: Numbers) -> None:
    """Begin a macro step: its tolerance, and F and u at the nodes by the polynomials of the last."""
    h, v = numbers[STAGES, _STEP_H], numbers[STAGES, _V]
    atol, rtol = numbers[STAGES, _ATOL], numbers[STAGES, _RTOL]
    rows[H] = h
    speed = greater(absolute(rows[U0] + v), rows[SPEED_BEFORE])
    tolerance = less(atol + rtol * speed, (atol + rtol * absolute(rows[Z0])) / h)
    rows[TOLERANCE] = tolerance * numbers[STAGES, _TO_TOLERANCE]
    f, u, u0 = ([rows[KEPT_F + k] for k in range(STAGES)], [rows[KEPT_U + k] for k in range(STAGES)], rows[U0])
    leads_nowhere = rows[FLAGGED] > 0.5  # the polynomial of a block with steps of its own
    for k in range(STAGES):
        weights = [numbers[k, j] for j in range(STAGES)]
        rows[F + k] = total([w * x for w, x in zip(weights, f, strict=True)])
        rows[U + k] = where(leads_nowhere, u0, total([w * x for w, x in zip(weights, u, strict=True)]))


def _prepare_formula(rows: Rows, _: Numbers) -> None:
    """F at the nodes of a step of a block's own, and a first guess of u there."""
    start, length, h, u0 = rows[START], rows[LENGTH], rows[H], rows[U0]
    powers = [rows[G + p] for p in range(STAGES)]

    def force(x: Lane) -> Lane:
        value = powers[-1]
        for p in reversed(range(STAGES - 1)):
            value = value * x + powers[p]
        return value

    phi, slope = friction_law(u0 * rows[STEEP])
    rate = -(rows[DAMPING] * u0 + force(start) + rows[FRICTION] * phi)
    stiffness = rows[DAMPING] + rows[FRICTION] * rows[STEEP] * slope
    for k in range(STAGES):
        rows[F + k] = force(start + length * float(NODES[k]))
        after = h * float(NODES[k])
        rows[U + k] = u0 + after * rate / (1.0 + after * stiffness)


_newton, _finish, _probe = on_rows(_newton_formula), on_rows(_finish_formula), on_rows(_probe_formula)
_view, _predict = on_rows(_view_formula), on_rows(_predict_formula)
_prepare, _force, _force_changed = (
    on_rows(_prepare_formula),
    on_rows(_force_formula(False)),
    on_rows(_force_formula(True)),
)


# ---- a macro step


@inner
def _begin(table, n, macro, kept, start, numbers):  # type: ignore[no-untyped-def]
    """Begin a macro step that starts at the place `start` of the one that is kept."""
    for k in range(STAGES):
        x = start + NODES[k] * macro / kept
        for j in range(STAGES):
            numbers[k, j] = horner(TO_POWERS[:, j], STAGES - 1, x)
    numbers[STAGES, _STEP_H] = macro
    for first in range(0, n, WIDTH):
        _predict(table, first, numbers)


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
def _together(table, n, flags, listed, iterations, numbers):  # type: ignore[no-untyped-def]
    """All blocks in one step; those for which that does not do are flagged, and listed. Returns how many."""
    n_listed, some = np.int64(0), False
    for i in range(n):
        table[DONE, i] = 1.0 if flags[i] else 0.0
        some = some or flags[i]
    for first in range(0, n, WIDTH):
        for _ in range(iterations):
            if _newton(table, first, numbers) == ALL:
                break
        well = _finish(table, first, numbers)
        if some or well != ALL:
            n_listed = _flag(first, n, well, flags, listed, n_listed)
    return n_listed


@inner
def _strayed(table, n, flags, numbers):  # type: ignore[no-untyped-def]
    """Flag those whose one step does not do off the nodes; returns how many."""
    n_strayed = 0
    for first in range(0, n, WIDTH):
        well = _probe(table, first, numbers)
        if well != ALL:
            for lane in range(min(WIDTH, n - first)):
                if not flags[first + lane] and not (well >> lane) & 1:
                    flags[first + lane] = True
                    n_strayed += 1
    return n_strayed


@inner
def _apart(table, own, listed, n_listed, macro, with_u, next_h, end_z, end_u, pieces, piece_block, numbers):  # type: ignore[no-untyped-def]
    """The listed blocks in steps of their own, side by side. Returns how many pieces, or -1 - i if i cannot."""
    n_pieces = np.int64(0)
    block = np.full(WIDTH, -1)
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
                block[lane] = i
                for row in (U0, Z0, DAMPING, STEEP, FRICTION, BELT, TOLERANCE, REACH):
                    own[row, lane] = table[row, i]
                for p in range(STAGES):
                    value = 0.0
                    for k in range(STAGES):
                        value += TO_POWERS[p, k] * table[F + k, i]
                    own[G + p, lane] = value
                    own[MOMENT + p, lane] = 0.0
                    own[MOMENT_U + p, lane] = 0.0
                own[START, lane] = 0.0
                own[LENGTH, lane] = min(next_h[i] / macro, 1.0)
        if active == 0:
            return n_pieces
        for lane in range(WIDTH):
            own[DONE, lane] = 1.0 if block[lane] < 0 else 0.0
            if block[lane] >= 0:
                rest = 1.0 - own[START, lane]
                length = own[LENGTH, lane]
                if length > 0.97 * rest:
                    length = rest
                elif length > 0.5 * rest:
                    length = 0.5 * rest
                own[LENGTH, lane] = length
                own[H, lane] = length * macro
        _prepare(own, 0, numbers)
        for _ in range(_NEWTON_OWN):
            if _newton(own, 0, numbers) == ALL:
                break
        _finish(own, 0, numbers)
        _probe(own, 0, numbers)
        for lane in range(WIDTH):
            i = block[lane]
            if i < 0:
                continue
            length, allowed = own[LENGTH, lane], own[TOLERANCE, lane]
            error = own[ERROR, lane]
            if own[DONE, lane] < 0.5:
                factor = 0.25
            else:
                factor = min(max(_SAFETY * (allowed / max(error, 1e-300)) ** (1.0 / STAGES), 0.1), _GROW_OWN)
            if own[DONE, lane] < 0.5 or own[SUSPECT, lane] > 0.5 or not error <= allowed:
                own[LENGTH, lane] = length * min(factor, 0.5)
                if not length > 1e-13:
                    return -1 - i
                continue
            if n_pieces == len(piece_block):
                return -1 - i
            piece = pieces[n_pieces]
            piece_block[n_pieces] = i
            n_pieces += 1
            start = own[START, lane]
            piece[0], piece[1], piece[2], piece[3] = start, length, own[Z0, lane], own[U0, lane]
            for k in range(STAGES):
                piece[4 + k] = own[U + k, lane]
                x = start + NODES[k] * length
                weight = LAST[k] * length * own[Z + k, lane]
                for p in range(STAGES):
                    own[MOMENT + p, lane] += weight
                    weight *= x
                if with_u:
                    weight = LAST[k] * length * own[U + k, lane]
                    for p in range(STAGES):
                        own[MOMENT_U + p, lane] += weight
                        weight *= x
            own[U0, lane] = own[U + STAGES - 1, lane]
            own[Z0, lane] = own[Z + STAGES - 1, lane]
            own[START, lane] = start + length
            own[LENGTH, lane] = length * factor
            if own[START, lane] >= 1.0 - 1e-12:
                end_u[i], end_z[i] = own[U0, lane], own[Z0, lane]
                next_h[i] = length * factor * macro
                for k in range(STAGES):
                    value, mean = 0.0, 0.0
                    for p in range(STAGES):
                        value += PROJECT[k, p] * own[MOMENT + p, lane]
                        mean += PROJECT[k, p] * own[MOMENT_U + p, lane]
                    table[Z + k, i] = value
                    table[MEAN_U + k, i] = mean
                block[lane] = -1
                active -= 1
                own[H, lane] = 1.0
                own[STEEP, lane] = 1.0
                own[FRICTION, lane] = 0.0
                for k in range(STAGES):
                    own[G + k, lane] = 0.0


@inner
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


@inner
def _couple(table, n, matrix, cross, flags, is_first, rough, product, single, single_product, numbers):  # type: ignore[no-untyped-def]
    """F from z (and u) at the nodes. Returns what w may change by, and the tail of F, both over tolerance."""
    with_cross = len(cross[0]) > 0
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
    for k in range(STAGES):
        for i in range(n):
            table[Z_BEFORE + k, i] = table[Z + k, i]
    for first in range(0, n, WIDTH):
        if changed:
            _force_changed(table, first, numbers)
        else:
            _force(table, first, numbers)
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


# ---- events and samples


@inner
def _marks(values, bernstein, bound, marks, n_marks, poly, found):  # type: ignore[no-untyped-def]
    """Add the places in (0, 1] where a polynomial passes a bound, in rising order."""
    above, below = False, False
    for b in bernstein:
        above, below = above or b >= bound, below or b <= bound
    if not (above and below):
        return n_marks
    for p in range(STAGES + 1):
        poly[p] = 0.0
        for k in range(STAGES + 1):
            poly[p] += ALL_TO_POWERS[p, k] * values[k]
    poly[0] -= bound
    return insert_roots(poly, STAGES, marks, n_marks, found)


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
def _stays(low, high, low_force, high_force, mu, band, by_force, mode):  # type: ignore[no-untyped-def]
    """Whether u and F between these bounds keep to the mode."""
    if mode == 0:
        return low > -band and high < band and (not by_force or (low_force > -mu and high_force < mu))
    if (low >= band) if mode > 0 else (high <= -band):
        return True
    slides = by_force and (low_force >= mu or high_force <= -mu)
    return slides and (low > 0.0 if mode > 0 else high < 0.0)


@inner
def _hold(table, i, band):  # type: ignore[no-untyped-def]
    """The force that friction and damping bear at the edge of the band."""
    return table[FRICTION, i] * _law(band * table[STEEP, i])[0] + table[DAMPING, i] * band


@inner
def _events_of_piece(  # type: ignore[no-untyped-def]
    u, force, mu, band, hold, strays, by_force, mode, t, h, t_next, label, event_t, event_block, event_mode,
    n_recorded, work, marks,
):  # fmt: skip
    """Record the changes of mode of one block on [t, t + h]; u and F by values at the start and the nodes.

    Only a force above `hold` drives a block out of its band: what seems to leave it with less, and no farther than a
    step may err by, is an overshoot of the polynomial.
    """
    low, high = _hull(u, work[0])
    low_force, high_force = _hull(force, work[1])
    if _stays(low, high, low_force, high_force, mu, band, by_force, mode):
        return mode, n_recorded
    n_marks = _marks(u, work[0], 0.0, marks, np.int64(0), work[2], work[3])
    if mu > 0.0:
        for sign in (-1.0, 1.0):
            n_marks = _marks(u, work[0], sign * band, marks, n_marks, work[2], work[3])
            n_marks = _marks(force, work[1], sign * hold, marks, n_marks, work[2], work[3])
            if by_force:
                n_marks = _marks(force, work[1], sign * mu, marks, n_marks, work[2], work[3])
    for k in range(n_marks + 1):
        left = marks[k - 1] if k > 0 else 0.0
        right = marks[k] if k < n_marks else 1.0
        if right <= left:
            continue
        middle = 0.5 * (left + right)
        gap, pull = _at(u, middle), _at(force, middle)
        new = mode_of(gap, pull, mu, band, by_force)
        is_held = mode == 0 and mu > 0.0 and -new * pull < hold and (not by_force or abs(pull) < mu)
        if new != mode and not (is_held and abs(gap) < band + strays):
            event_t[n_recorded] = min(t + h * left, t_next)  # rounding may pass the end of the run
            event_block[n_recorded] = label
            event_mode[n_recorded] = new
            mode = new
            n_recorded += 1
    return mode, n_recorded


@inner
def _events(  # type: ignore[no-untyped-def]
    table, n, flags, pieces, piece_block, n_pieces, bands, by_force, modes, t, macro, t_next, event_t,
    event_block, event_mode, work, marks, n_recorded,
):  # fmt: skip
    """Record all changes of mode on a macro step, by every definition of sticking."""
    u, force, of_piece = work[4], work[5], work[6]
    for d in range(len(bands)):
        mode, band = modes[d], bands[d]
        for i in range(n):
            mu = table[FRICTION, i]
            wide = band[i] if mu > 0.0 else 0.0
            if flags[i] or _stays(
                table[LOW, i],
                table[HIGH, i],
                table[LOW_FORCE, i],
                table[HIGH_FORCE, i],
                mu,
                wide,
                by_force[d],
                mode[i],
            ):
                continue
            u[0], force[0] = table[U0, i], table[FORCE0, i]
            for k in range(STAGES):
                u[k + 1], force[k + 1] = table[U + k, i], table[F + k, i]
            mode[i], n_recorded = _events_of_piece(
                u, force, mu, wide, _hold(table, i, wide), table[TOLERANCE, i], by_force[d], mode[i],
                t, macro, t_next, d * n + i, event_t, event_block,
                event_mode, n_recorded, work, marks,
            )  # fmt: skip
        last = -1
        for k in range(n_pieces):
            i, piece = piece_block[k], pieces[k]
            mu = table[FRICTION, i]
            wide = band[i] if mu > 0.0 else 0.0
            if i != last:
                last = i
                force[0] = table[FORCE0, i]
                for j in range(STAGES):
                    force[j + 1] = table[F + j, i]
            for j in range(STAGES + 1):
                of_piece[j] = _at(force, piece[0] + piece[1] * ALL_NODES[j])
            mode[i], n_recorded = _events_of_piece(
                piece[3:], of_piece, mu, wide, _hold(table, i, wide), table[TOLERANCE, i], by_force[d], mode[i],
                t + macro * piece[0], macro * piece[1], t_next,
                d * n + i, event_t, event_block, event_mode, n_recorded, work, marks,
            )  # fmt: skip
    return n_recorded


@inner
def _sample(  # type: ignore[no-untyped-def]
    table, n, flags, pieces, piece_block, n_pieces, t, macro, t_next, v, counters, sample_t, sample_z, sample_w
):
    """Keep the state at all sample times up to t_next."""
    m = counters[loop.N_SAMPLED]
    weights = np.empty(STAGES + 1)
    while m < len(sample_t) and sample_t[m] <= t_next:
        x = min((sample_t[m] - t) / macro, 1.0)
        for k in range(STAGES + 1):
            weights[k] = horner(ALL_TO_POWERS[:, k], STAGES, x)
        for i in range(n):
            z, u = weights[0] * table[Z0, i], weights[0] * table[U0, i]
            for k in range(STAGES):
                z += weights[k + 1] * table[Z + k, i]
                u += weights[k + 1] * table[U + k, i]
            if not flags[i]:
                sample_z[m, i], sample_w[m, i] = z, v + u
        for place in range(n_pieces):
            piece = pieces[place]
            inside = (x - piece[0]) / piece[1]
            if not 0.0 <= inside <= 1.0 + 1e-9:
                continue
            for k in range(STAGES + 1):
                weights[k] = horner(ALL_TO_POWERS[:, k], STAGES, inside)
            z, u = piece[2], weights[0] * piece[3]
            for k in range(STAGES):
                u += weights[k + 1] * piece[4 + k]
                moved = NODES[k] * v
                for j in range(STAGES):
                    moved += WEIGHTS[k, j] * piece[4 + j]
                z += weights[k + 1] * moved * piece[1] * macro
            i = piece_block[place]
            sample_z[m, i], sample_w[m, i] = z, v + u
        m += 1
    counters[loop.N_SAMPLED] = m


@kernel
def _advance(  # type: ignore[no-untyped-def]
    matrix, cross, rough_rate, bands, by_force, table, own, numbers, product, single, single_product,
    modes, z, w, flags, listed, next_h, pieces, piece_block, clock, counters, t_end, v, rtol, atol, boost,
    bound, sample_t, sample_z, sample_w, event_t, event_block, event_mode,
):  # fmt: skip
    """Steps until the end, or until Python has something to do; goes on where it stopped when called again."""
    n = len(z)
    mode = modes[0]
    work, marks = np.empty((7, STAGES + 1)), np.empty(_PASSES + 1)
    end_z, end_u, h_before = np.empty(n), np.empty(n), np.empty(n)
    n_recorded = np.int64(0)
    with_cross = len(cross[0]) > 0
    grown = True
    for _ in range(loop.STEPS_A_SLICE):
        t = clock[loop.TIME]
        remaining = t_end - t
        if remaining <= 0.0:
            _sample(
                table,
                n,
                flags,
                pieces,
                piece_block,
                np.int64(0),
                t,
                1.0,
                t,
                v,
                counters,
                sample_t,
                sample_z,
                sample_w,
            )
            return loop.DONE, n_recorded
        if n_recorded + _PASSES * (n + len(piece_block)) * len(bands) > len(event_t):
            return loop.BUFFER_FULL, n_recorded
        if mode[0] != 0 and t > clock[loop.CHECK + (mode[0] > 0)]:
            same = True
            for i in range(n):
                same = same and mode[i] == mode[0]
            if same:
                return loop.ALL_SLIP, n_recorded
        macro = clock[_STEP]
        if macro >= 0.999 * remaining:
            macro = remaining
        elif macro > 0.5 * remaining:
            macro = 0.5 * remaining
        _begin(table, n, macro, clock[_KEPT], clock[_FROM], numbers)
        least = boost * atol / max(1.0, macro)
        for i in range(n):
            h_before[i] = next_h[i]
            flags[i] = False
        rough = _ROUGH_SHARE * least / (boost * macro * rough_rate)
        swept_below = min(1.0, _SWEPT / boost)
        swept, tail, n_pieces = False, 0.0, np.int64(0)
        before = np.inf
        for sweep in range(_SWEEPS):
            n_listed = _together(table, n, flags, listed, _NEWTON, numbers)
            for k in range(n_listed):
                next_h[listed[k]] = h_before[listed[k]]
            n_pieces = _apart(
                table, own, listed, n_listed, macro, with_cross, next_h, end_z, end_u, pieces, piece_block, numbers
            )
            if n_pieces < 0:
                break
            moved, tail = _couple(
                table, n, matrix, cross, flags, sweep == 0, rough, product, single, single_product, numbers
            )
            counters[loop.N_PRODUCTS] += STAGES * (2 if with_cross else 1)
            moved, tail = moved * boost, tail * boost
            if not tail < 100.0 * _TAIL:
                break
            slow = clock[_SLOW] if sweep == 0 else min(moved / before, 0.9)
            enough = swept_below * (1.0 - slow) * (_AT_ONCE if sweep == 0 else 1.0)
            if moved < enough and _strayed(table, n, flags, numbers) == 0:
                swept = True
                break
            before = moved
            clock[_SLOW] = slow
        if not swept or tail > _TAIL:
            counters[loop.N_REJECTED] += 1
            counters[loop.LAST_BLOCK] = _worst(table, n) if n_pieces >= 0 else -1 - n_pieces
            factor = 0.5
            if tail > _TAIL:
                factor = max(_SAFETY * (_TAIL / tail) ** (1.0 / 3.0), _SHRINK)
            clock[_STEP] = macro * factor
            clock[_SLOW] = 0.0
            grown = False
            if clock[_STEP] <= 1e-14 * max(1.0, abs(t)):
                return loop.STALLED, n_recorded
            for i in range(n):
                next_h[i] = h_before[i]
            continue
        counters[loop.N_STEPS] += 1
        t_next = t_end if macro == remaining else t + macro
        for first in range(0, n, WIDTH):
            _view(table, first, numbers)
        n_recorded = _events(
            table, n, flags, pieces, piece_block, n_pieces, bands, by_force, modes, t, macro, t_next, event_t,
            event_block, event_mode, work, marks, n_recorded,
        )  # fmt: skip
        _sample(
            table,
            n,
            flags,
            pieces,
            piece_block,
            n_pieces,
            t,
            macro,
            t_next,
            v,
            counters,
            sample_t,
            sample_z,
            sample_w,
        )
        for i in range(n):
            table[SPEED_BEFORE, i] = abs(table[U0, i] + v)
            table[FLAGGED, i] = 1.0 if flags[i] else 0.0
            if flags[i]:
                table[U0, i], table[Z0, i] = end_u[i], end_z[i]
            else:
                table[U0, i], table[Z0, i] = table[U + STAGES - 1, i], table[Z + STAGES - 1, i]
                next_h[i] = max(next_h[i], macro)
            z[i], w[i] = table[Z0, i], table[U0, i] + v
        copy(table[F + STAGES - 1], table[FORCE0])
        for k in range(STAGES):
            copy(table[F + k], table[KEPT_F + k])
            copy(table[U + k], table[KEPT_U + k])
        clock[loop.TIME] = t_next
        clock[_KEPT], clock[_FROM] = macro, 1.0
        factor = _SAFETY * (_TAIL / max(tail, 1e-300)) ** (1.0 / STAGES)
        most = _GROW_FAST if tail < _FAR_BELOW * _TAIL else _GROW
        clock[_STEP] = macro * min(max(factor, _SHRINK), most if grown else 1.0)
        grown = True
        if not max(largest(z), largest(w)) <= bound:
            return loop.DIVERGED, n_recorded
    return loop.PAUSED, n_recorded


def integrate(task: Task, engine: Sigmoid) -> Run:
    """Run a task under the rules of `stickslip.sim.engines.contract`.

    Raises
    ------
    ValueError
        If there is not one ratio a block, or the layer is too wide for its definition of sticking.
    IntegrationError
        If the step shrinks to rounding.
    """
    system, z0, w0, t_start, t_end, samples, _ = task
    eps, stick, threshold = engine.eps, engine.stick, engine.threshold
    rtol, atol = _CALIBRATION * engine.rtol, _CALIBRATION * engine.atol
    also = np.array(engine.thresholds, dtype=np.float64)
    n = system.n
    delta = Ratios.for_blocks("ratio", engine.ratio, n) * eps
    if stick == "manifold" and not (delta < 1).all():
        raise ValueError(
            f"eps, ratio: stick='manifold' needs ratio * eps < 1, got {delta.max():g}; use stick='threshold'"
        )
    band = delta * np.log(1 / delta) if stick == "manifold" else threshold * delta
    bands = np.vstack([band, np.multiply.outer(also, delta)])
    by_force = np.array([stick == "manifold"] + [False] * len(also))
    v, friction, cross = system.belt_speed, system.friction, system.cross_damping

    z, w = z0.copy(), w0.copy()
    force = system.damping * v + system.stiffness @ z
    drag = system.damping * v
    if cross is not None:
        force += cross @ w
        drag += cross.sum(axis=1) * v
    rate = -system.damping * (w - v) - force - friction * np.tanh((w - v) / delta)
    held = (friction > 0) & (np.abs(w - v) < bands)
    held[by_force] &= np.abs(force) < friction
    side = np.where(w != v, np.sign(w - v), np.sign(rate))  # on the belt's speed, where it goes next
    modes = np.where(held, 0, side).astype(np.int8)
    initial_modes = modes.copy()

    width = -(-n // HEIGHT) * HEIGHT
    boost = max(1.0, _BOOST * (atol + rtol) ** (_POWER - 1.0))
    table = np.zeros((N_ROWS, width))
    table[STEEP], table[H], table[DONE] = 1.0, 1.0, 1.0
    table[U0, :n], table[Z0, :n], table[DAMPING, :n], table[STEEP, :n] = w - v, z, system.damping, 1.0 / delta
    table[FRICTION, :n], table[BELT] = friction, v
    table[REACH, :n] = 1.0 + 0.5 * np.log1p(2.0 * friction / (boost * atol))
    table[DRAG, :n], table[TOLERANCE] = drag, 1.0
    table[KEPT_F : KEPT_F + STAGES, :n], table[KEPT_U : KEPT_U + STAGES, :n] = force, w - v
    table[FORCE0, :n], table[SPEED_BEFORE, :n] = force, np.abs(w)
    numbers, product = np.zeros((STAGES + 1, STAGES)), np.zeros((STAGES, width))
    numbers[STAGES] = 0.0, v, atol, rtol, boost
    single, single_product = (
        np.zeros((STAGES, -(-n // SINGLE_HEIGHT) * SINGLE_HEIGHT), np.float32) for _ in range(2)
    )
    rough_rate = float(ROUGH) * float(system.row_sums.max())
    speed = max(float(np.abs(w).max()), float(np.abs(rate).max()))
    step = min(t_end - t_start, 0.1, (atol**0.2) * 0.3 / speed if speed > 0 else 0.1)
    state = loop.State.at_start(task, z, w, modes[0], step, 1.0, 1.0, 0.0)
    state.counters[loop.N_PRODUCTS] = 1 if cross is None else 2
    strays = engine.atol + engine.rtol * abs(v)
    collapse = certificates.Collapse(system, strays, float(band.max()), float(bands.max()), delta)
    n_pieces = 16 * n + 256
    flags, listed, next_h = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.int64), np.full(n, step / 4)
    pieces, piece_block = np.empty((n_pieces, _PIECE)), np.zeros(n_pieces, dtype=np.int64)
    matrix, cross_matrix = _matrices(system)
    own = np.zeros((N_ROWS, WIDTH))

    def advance(events: loop.Events, bound: float) -> tuple[int, int]:
        return _advance(
            matrix, cross_matrix, rough_rate, bands, by_force, table, own, numbers, product, single,
            single_product, modes, z, w, flags, listed, next_h, pieces, piece_block,
            state.clock, state.counters, t_end, v, rtol, atol, boost, bound, samples.t, samples.z, samples.w, *events,
        )  # fmt: skip

    return loop.complete(
        task,
        state,
        advance,
        collapse,
        stalled=f"the step fell to rounding (rtol = {engine.rtol:g}, atol = {engine.atol:g}); ask for less accuracy,"
        " or use engine='coulomb'",
        events_a_step=_PASSES * (n + n_pieces) * len(bands),
        initial_modes=initial_modes,
        thresholds=engine.thresholds,
    )


_MATRICES: WeakKeyDictionary[System, tuple[Any, Any]] = WeakKeyDictionary()


def _matrices(system: System) -> tuple[Any, Any]:
    """K and N as `_times` takes them."""
    if system not in _MATRICES:
        _MATRICES[system] = _matrix(system.stiffness), _matrix(system.cross_damping)
    return _MATRICES[system]


def _matrix(stiffness: Any) -> Any:
    none = np.empty(0, dtype=np.int32)
    no_panels, no_single = np.empty((0, 0, HEIGHT)), np.empty((0, 0, SINGLE_HEIGHT), np.float32)
    if stiffness is None:
        return no_panels, no_single, none, none, np.empty(0)
    if isinstance(stiffness, np.ndarray):
        dense = panels(stiffness, HEIGHT, np.float64), panels(stiffness, SINGLE_HEIGHT, np.float32)
        return *dense, none, none, np.empty(0)
    rows = stiffness.tocsr()
    return (
        no_panels,
        no_single,
        rows.indptr.astype(np.int32),
        rows.indices.astype(np.int32),
        rows.data.astype(np.float64),
    )
