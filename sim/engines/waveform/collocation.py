"""One block on one step, by collocation: formulas on several blocks side by side.

    z' = w,    w' = -R w - N w - K z - mu phi((w - v) / delta)        (N: off the diagonal of the damping, if given)

The coupling force, F = R v + K z + N w, is smooth, since z is friction integrated twice; all stiffness, up to
mu / delta, is within the blocks. With F the polynomial through the nodes of the Radau IIA method of five
stages, known there by the waveform iteration (`step.py`), each block by itself solves

    u' = -R u - F - mu phi(u / delta),    u = w - v,

in one step of that method where it is accurate enough, else in substeps (`substeps.py`) with the same error test.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any

from stickslip.sim.engines.sigmoid_law import (
    Law,
    Peaked,
    SetValued,
    open_sign,
    peaked_sign,
    shape_of,
)
from stickslip.sim.engines.waveform import control
from stickslip.sim.numerics.lanes import NARROW, Lane, absolute, dot, greater, less, on_rows, total, where
from stickslip.sim.numerics.radau import (
    ALL_AT_PLACES,
    AT_PLACES,
    INVERSE,
    LAST,
    NODES,
    OF_RATE,
    PLACES,
    STAGES,
    TO_BERNSTEIN,
    TO_LEGENDRE,
    WEIGHTS,
)


def _friction(block: Any, law: Law) -> Callable[[Lane], tuple[Lane, Lane]]:
    """The friction law of these blocks."""
    c = block.hidden
    if law is Peaked:
        return lambda x: peaked_sign(x, c)
    far, weakening, closed = block.far, block.weakening, block.closed
    return lambda x: open_sign(law, x, c, far, weakening, closed)


def _largest(values: list[Lane]) -> Lane:
    """The largest magnitude; it may lose a NaN."""
    return reduce(greater, map(absolute, values))


def _least(values: list[Lane]) -> Lane:
    """The least magnitude; it may lose a NaN."""
    return reduce(less, map(absolute, values))


def _is_near_peak(block: Any) -> Lane:
    return absolute(block.u0) < block.peak * control.NEAR_PEAK


def _passes_peak(block: Any) -> Lane:
    """Whether a block comes to its layer in a step, or is held there by a force that may let it go."""
    reach = block.peak * control.NEAR_PEAK
    may_leave = (absolute(block.u0) < reach) & (_largest(block.f) > block.static * control.LOADED)
    comes = (absolute(block.u0) > reach) & (absolute(block.u[-1]) < reach)
    return (may_leave | comes) & (block.fine < 1.0)


def _allowed(block: Any) -> Lane:
    """The error allowed in a step."""
    return block.tolerance * where(_is_near_peak(block), block.fine, 1.0)


def _solve(matrix: list[list[Lane | float]], right: list[Lane]) -> None:
    """Solve linear equations in place, without pivoting.

    Both matrices here have diagonals that only grow; beyond a peak of friction a step for which this fails is too
    long anyway.
    """
    pivots: list[Lane] = []
    for k in range(STAGES):
        pivots.append(1.0 / matrix[k][k])  # type: ignore[arg-type]
        for i in range(k + 1, STAGES):
            factor = pivots[k] * matrix[i][k]
            for j in range(k + 1, STAGES):
                matrix[i][j] = matrix[i][j] - factor * matrix[k][j]
            right[i] = right[i] - factor * right[k]
    for k in reversed(range(STAGES)):
        for j in range(k + 1, STAGES):
            right[k] = right[k] - right[j] * matrix[k][j]
        right[k] = right[k] * pivots[k]


def _newton(block: Any, law: Law) -> Lane:
    """One Newton iteration for u at the nodes: INVERSE (u - u0) + h (R u + F + mu phi(u / delta)) = 0.

    Returns the mask of blocks that are done.
    """
    h, u0, steep, mu, done = block.h, block.u0, block.steep, block.friction, block.done
    stages = range(STAGES)
    u, f = block.u, block.f
    change_of_u = [x - u0 for x in u]
    damping, friction = block.damping, _friction(block, law)
    residual: list[Lane] = []
    matrix: list[list[Lane | float]] = []
    for k in stages:
        phi, slope = friction(u[k] * steep)
        force = damping * u[k] + f[k] + mu * phi
        residual.append(-(dot(INVERSE[k], change_of_u) + h * force))
        row: list[Lane | float] = [float(a) for a in INVERSE[k]]
        row[k] = h * (damping + mu * steep * slope) + row[k]
        matrix.append(row)
    _solve(matrix, residual)
    still, change, finite = done < 0.5, _largest(residual), total(residual)
    block.u = [where(still, u[k] + residual[k], u[k]) for k in stages]
    x = change * steep
    out_of_layer = _least(u) * steep - x > control.OUT_OF_LAYER
    if shape_of(law) is not None:  # it has curvature there too
        bend = x * block.weakening
        out_of_layer = out_of_layer & (h * mu * bend * bend < _allowed(block) * control.SOLVED)
    inside = (x * change < _allowed(block) * control.SOLVED) & ((x < control.IN_LAYER) | out_of_layer)
    rounding = change < (_largest(u) + absolute(u0) + h * _largest(f)) * control.NEWTON_ROUNDING
    solved = (inside | rounding) & (absolute(finite) < 1e300) | (done > 0.5)
    block.done = where(solved, h * 0.0 + 1.0, 0.0)
    return solved


def _error(values: list[Lane], to_legendre: Any = TO_LEGENDRE) -> Lane:
    """Magnitude of the last Legendre coefficients of a function given at the nodes, or, by `OF_RATE`, of h u'."""
    last, last_but_one = (absolute(dot(to_legendre[k], values)) for k in (-1, -2))
    return greater(last, last_but_one * control.LAST_BUT_ONE)


def _finish(block: Any, law: Law) -> Lane:
    """From u at the nodes: z there, and the error by the nodes. Returns the mask of the accepted blocks."""
    h, u0, z0, belt = block.h, block.u0, block.z0, block.belt
    u = block.u
    block.z = [z0 + h * (dot(WEIGHTS[k], u) + belt * float(NODES[k])) for k in range(STAGES)]
    error = block.error = _error([x - u0 for x in u], OF_RATE)
    return (block.done > 0.5) & (error < _allowed(block))


def _probe(block: Any, law: Law) -> Lane:
    """The error off the nodes, and whether u may have passed the layer undetected. Returns the mask of the accepted.

    Off the nodes friction differs from its polynomial through the nodes: the error is this defect divided by the
    stiffness there, or, with a peak, by the least stiffness of the step, since beyond the peak errors grow. The error
    of a step that jumped the layer is as large at its end, where it is otherwise far less than between the nodes.

    A polynomial is suspect if its hull goes deeper into the layer than any place at which it was evaluated, or if it
    comes near a peak with an error of more than a share of that, or of the distance. Where |F| lies between kinetic
    and static friction the layer holds a block, but a step that missed it shows no defect behind it. A force next to
    which friction is rounding is not held.
    """
    h, u0, steep, mu, damping = block.h, block.u0, block.steep, block.friction, block.damping
    stages = range(STAGES)
    u, f = block.u, block.f
    change_of_u, values = [x - u0 for x in u], [u0, *u]
    # friction at the nodes, times -h, by the equations
    pull = [dot(INVERSE[k], change_of_u) + h * (damping * u[k] + f[k]) for k in stages]
    low, high = u0, u0
    for x in u:
        low, high = less(low, x), greater(high, x)
    error, friction = block.error, _friction(block, law)
    most, softest = h * 0.0, h * 0.0 + 1e300
    for m in range(len(PLACES)):
        value = dot(ALL_AT_PLACES[m], values) if m > 0 else u0
        phi, slope = friction(value * steep)
        bent = damping * (value - dot(AT_PLACES[m], u)) + mu * phi
        defect = absolute(h * bent + dot(AT_PLACES[m], pull)) * (1.0 if m > 0 else control.AT_START)
        error = greater(error, defect / (1.0 + h * (damping + mu * steep * greater(slope, 0.0))))
        most, softest = greater(most, defect), less(softest, slope)
        low, high = less(low, value), greater(high, value)
    at_softest = most / (1.0 + h * (damping + mu * steep * greater(softest, 0.0)))
    error = where(block.peak < 1e300, greater(error, at_softest), error)
    behind = where(u[-1] > 0.0, u0, u0 * -1.0)
    jumped = (behind * steep < control.IN) & (absolute(u[-1]) * steep > control.OUT)
    error = where(jumped, error * block.passed, error)
    hull_low, hull_high = _bounds(values)
    block.error = error
    reach = block.reach
    under = (low * steep - hull_low * steep > 1.0) & (hull_low * steep < reach) & (low * steep > -reach)
    over = (hull_high * steep - high * steep > 1.0) & (hull_high * steep > -reach) & (high * steep < reach)
    peak = block.peak
    away = less(absolute(absolute(u0) - peak), absolute(absolute(u[-1]) - peak))
    allowed = greater(less(peak * control.OF_PEAK, away * control.OF_DISTANCE), peak * block.at_peak)
    may_hold = block.static > _least(f) * control.ROUNDING
    comes_near = (low < peak * control.NEAR_PEAK) & (high > peak * -control.NEAR_PEAK)
    suspect = under | over | (comes_near & (error > allowed) & may_hold)
    block.suspect = where(suspect, h * 0.0 + 1.0, 0.0)
    may_err = block.allowed = _allowed(block)
    return (error < may_err) & (where(suspect, h * 0.0 + 1.0, 0.0) < 0.5)


def _force(is_change: bool) -> Callable[[Any, Law], None]:
    """F, or its change, from products of K; the changes of w by that of F and by its tail."""

    def formula(block: Any, law: Law) -> None:
        drag, before, product, change = block.drag, block.f, block.product, block.change
        after = [change[k] + (before[k] if is_change else product[k] + drag) for k in range(STAGES)]
        most = _largest([x - y for x, y in zip(after, before, strict=True)])
        block.f = after
        scale = (greater(block.h, block.lag) if law is SetValued else block.h) / block.tolerance
        tail, noise, of_tail = _error(after), block.noise, scale
        if law is not SetValued:
            stays = control.SWIFT / greater(_least(after) - block.static, control.SWIFT)
            scale = scale * where(_is_near_peak(block) & (block.fine < 1.0), greater(stays / block.h, 1.0), 1.0)
            of_tail = where(_passes_peak(block), scale * block.of_tail, scale)
        block.moved = where(most < noise, scale * 0.0, (most - noise) * scale)
        block.tail = where(tail < noise, scale * 0.0, (tail - noise) * of_tail)

    return formula


def _bounds(values: list[Lane]) -> tuple[Lane, Lane]:
    """Bounds of the polynomial with these values at the start and the nodes, by its Bernstein coefficients."""
    low, high = values[0], values[0]
    for j in range(1, STAGES + 1):
        coefficient = dot(TO_BERNSTEIN[j], values)
        low, high = less(low, coefficient), greater(high, coefficient)
    return low, high


def _slide(block: Any, _: Law) -> Lane:
    """A step under the set-valued law in which no mode changes: the equations of `_newton` are linear then.

    Returns the mask of blocks for which that is so, by the hulls of u and F, and the step accurate enough.
    """
    h, u0, z0, belt, mode = block.h, block.u0, block.z0, block.belt, block.mode
    damping, f, static = block.damping, block.f, block.static
    stages = range(STAGES)
    pull = damping * u0 + block.friction * mode
    change_of_u = [-(h * (pull + f[k])) for k in stages]
    drag = h * damping
    matrix: list[list[Lane | float]] = []
    for k in stages:
        row: list[Lane | float] = [float(a) for a in INVERSE[k]]
        row[k] = drag + row[k]
        matrix.append(row)
    _solve(matrix, change_of_u)
    sticks = absolute(mode) < 0.5
    u = block.u = [where(sticks, 0.0 * u0, u0 + x) for x in change_of_u]
    block.z = [z0 + h * (dot(WEIGHTS[k], u) + belt * float(NODES[k])) for k in stages]
    error = _error([x - u0 for x in u], OF_RATE)
    low, high = _bounds([where(sticks, force, x) for force, x in zip([block.force0, *f], [u0, *u], strict=True)])
    block.lag = h * 0.0
    least = less(u[-1] * mode, where(mode > 0.0, low, high * -1.0))
    is_followed = (absolute(drag) < control.SOFT) | (error < block.tolerance * control.COLLOCATED)
    slips_on = (least > absolute(belt) * control.AT_BELT) & is_followed
    holds = (low + static > 0.0) & (high - static < 0.0)
    yes, no = h * 0.0 + 1.0, h * 0.0
    return where(sticks, where(holds, yes, no), where(slips_on, yes, no)) > 0.5


def _view(block: Any, _: Law) -> None:
    """Bounds of u and of F on the step."""
    block.low, block.high = _bounds([block.u0, *block.u])
    block.low_force, block.high_force = _bounds([block.force0, *block.f])


def _ahead(row: list[Lane], values: list[Lane]) -> Lane:
    """The value at a node of this step of the polynomial with these at the nodes of the last."""
    return total([w * x for w, x in zip(row, values, strict=True)])


def _stray(block: Any, shared: Any) -> None:
    """How far z is off its prediction at the nodes, and the sum of the squares."""
    z, kept = block.z, block.kept_z
    change = block.change = [x - _ahead(row, kept) for row, x in zip(shared.weights, z, strict=True)]
    block.error = total([x * x for x in change])


def _predict(block: Any, shared: Any) -> None:
    """Begin a macro step: its tolerance, and F and u at the nodes, extrapolated from the last step."""
    h, atol, rtol, weights = shared.h, shared.atol, shared.rtol, shared.weights
    block.h = h
    speed = greater(absolute(block.u0 + block.belt), block.speed_before)
    tolerance = less(atol + rtol * speed, (atol + rtol * absolute(block.z0)) / shared.unit)
    block.tolerance = tolerance * shared.safety
    block.noise = (block.row_sum * shared.size + absolute(block.force0)) * control.ROUNDING
    f, u, u0 = block.kept_f, block.kept_u, block.u0
    leads_nowhere = block.was_split > 0.5  # the polynomial of a block that took substeps
    block.f = [_ahead(row, f) for row in weights]
    block.u = [where(leads_nowhere, u0, _ahead(row, u)) for row in weights]


def _prepare(block: Any, law: Law) -> None:
    """F at the nodes of a substep, and a first guess of u there."""
    start, length, h, u0 = block.start, block.length, block.h, block.u0
    powers = block.g

    def force(x: Lane) -> Lane:
        value = powers[-1]
        for p in reversed(range(STAGES - 1)):
            value = value * x + powers[p]
        return value

    phi, slope = _friction(block, law)(u0 * block.steep)
    rate = -(block.damping * u0 + force(start) + block.friction * phi)
    stiffness = block.damping + block.friction * block.steep * greater(slope, 0.0)
    after = [h * float(NODES[k]) for k in range(STAGES)]
    block.f = [force(start + length * float(NODES[k])) for k in range(STAGES)]
    block.u = [u0 + s * rate / (1.0 + s * stiffness) for s in after]


def _add_moments(block: Any, moments: list[Lane], change: list[Lane]) -> list[Lane]:
    """The integrals of x^p y(x) over the macro step, plus those over an accepted substep, from y at its nodes."""
    start, length, taken = block.start, block.length, block.taken
    for k in range(STAGES):
        x = start + length * float(NODES[k])
        weight = where(taken > 0.0, change[k] * taken * float(LAST[k]), 0.0)
        for p in range(STAGES):
            moments[p] = moments[p] + weight
            weight = weight * x
    return moments


def _gather(block: Any, _: Law) -> None:
    """Add the part of an accepted substep to the integrals of x^p (z(x) - z(0)).

    Of the change alone: from moments to values at the nodes rounding grows a thousandfold.
    """
    since = block.z_macro
    block.moment = _add_moments(block, block.moment, [z - since for z in block.z])


def _gather_u(block: Any, _: Law) -> None:
    """The same of u."""
    since = block.u_macro
    block.moment_u = _add_moments(block, block.moment_u, [u - since for u in block.u])


#: For kernels: on macro steps, and on substeps.
newton, finish, probe, view = on_rows(_newton), on_rows(_finish), on_rows(_probe), on_rows(_view)
predict, stray, slide, force, force_changed = map(on_rows, (_predict, _stray, _slide, _force(False), _force(True)))
prepare, newton_of, finish_of, probe_of, gather, gather_u = (
    on_rows(formula, NARROW) for formula in (_prepare, _newton, _finish, _probe, _gather, _gather_u)
)
