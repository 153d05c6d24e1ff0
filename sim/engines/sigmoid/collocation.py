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

from stickslip.sim.engines.sigmoid.friction import SHAPES, Law, Peaked, Plain, open_sign, peaked_sign, smooth_sign
from stickslip.sim.numerics.lanes import Lane, Numbers, Rows, absolute, dot, greater, less, on_rows, total, where
from stickslip.sim.numerics.radau import (
    ALL_AT_PLACES,
    AT_PLACES,
    INVERSE,
    LAST,
    NODES,
    PLACES,
    STAGES,
    TO_BERNSTEIN,
    TO_LEGENDRE,
    WEIGHTS,
)

#: What a formula reads and writes, by rows of a table: a column is a block, on the step that it is taking. First one
#: row each, then one row a node. H is the step, U0 and Z0 are u and z at its start, TOLERANCE is what it may err by;
#: the friction has its peak STATIC at u = PEAK, HIDDEN is its c, and near it a step may err by FINE of that. It falls
#: to FAR of FRICTION, by FALL as steeply as it rises; CLOSED is the side to which no block slips, or 0. TAKEN is
#: LENGTH of a step that will do, else 0. PASSED is by what the error counts more of a step that has passed the layer,
#: AT_PEAK what one may err by at the peak, over its u. F is known to no more than NOISE; ROW_SUM is that of |K|.
#: Z_MACRO and U_MACRO are z and u at the start of the macro step.
(
    H, U0, Z0, DAMPING, STEEP, FRICTION, BELT, DRAG, TOLERANCE, REACH, DONE, ERROR, SUSPECT, LOW, HIGH,
    LOW_FORCE, HIGH_FORCE, FORCE0, SPEED_BEFORE, FLAGGED, MOVED, TAIL, START, LENGTH, PEAK, HIDDEN, STATIC, FINE,
    FAR, FALL, CLOSED, TAKEN, PASSED, AT_PEAK, ROW_SUM, NOISE, Z_MACRO,
    U_MACRO,
) = range(38)  # fmt: skip
F, U, Z, KEPT_F, KEPT_U, Z_BEFORE, PRODUCT, MEAN_U, G, MOMENT, MOMENT_U = range(38, 38 + 11 * STAGES, STAGES)
N_ROWS = 38 + 11 * STAGES
#: Numbers that a formula reads, the same for all: weights of a prediction, and in a last row these. SIZE is the
#: largest |z| at the start.
STEP_H, ATOL, RTOL, TO_TOLERANCE, SIZE = range(5)

#: A block nearer to the belt's speed than so many times its peak may be about to leave stick. At the peak F, which
#: changes by a dt, moves w - v on the scale delta^(4/3) for a time of the scale delta^(2/3): what w - v errs by then,
#: the time of leaving errs by delta^(-2/3) times as much, and what F errs by, by 1 / a times.
NEAR_PEAK = 3.0
#: But a force that is beyond static friction by so much or more takes it past the peak, in this over the force.
_SWIFT = 1e3
#: What a step that comes near to a peak may err by, over the peak: more, and it may pass the layer unseen.
_OF_PEAK = 0.05
#: And over the distance of u from there, as far beyond which a block is let go; but at least AT_PEAK.
_OF_DISTANCE = 0.1
#: A step from within so many delta of the belt's speed, or from the other side, to beyond so many has passed it.
_IN, _OUT = 2.0, 10.0
#: The share of a step's tolerance that Newton's method may leave.
_SOLVED = 0.05
#: So many units in the last place of F, and of what K z is a sum of, may be rounding.
_ROUNDING = 8.0 * 2.0**-52
#: The next to last coefficient counts by this: by parity the last may vanish.
_LAST_BUT_ONE = 0.05
#: The defect at the start counts by this: extrapolated to there from the nodes, it is larger than between them.
_AT_START = 0.3


def _friction(rows: Rows, law: Law) -> Callable[[Lane], tuple[Lane, Lane]]:
    """The law of these blocks."""
    if law is Plain:
        return smooth_sign
    c = rows[HIDDEN]
    if law is Peaked:
        return lambda x: peaked_sign(x, c)
    far, fall, closed = rows[FAR], rows[FALL], rows[CLOSED]
    return lambda x: open_sign(law, x, c, far, fall, closed)


def _stiff(slope: Lane, law: Law) -> Lane:
    """What of a slope of friction holds a block back: nothing beyond a peak."""
    return slope if law is Plain else greater(slope, 0.0)


def _is_near_peak(rows: Rows) -> Lane:
    return absolute(rows[U0]) < rows[PEAK] * NEAR_PEAK


def _allowed(rows: Rows, law: Law) -> Lane:
    """What a step may err by."""
    tolerance = rows[TOLERANCE]
    return tolerance if law is Plain else tolerance * where(_is_near_peak(rows), rows[FINE], 1.0)


def _newton(rows: Rows, law: Law) -> Lane:
    """One iteration for u at the nodes: INVERSE (u - u0) + h (R u + F + mu phi(u / delta)) = 0. Gives who is done."""
    h, u0, steep, mu, done = rows[H], rows[U0], rows[STEEP], rows[FRICTION], rows[DONE]
    stages = range(STAGES)
    u, f = [rows[U + k] for k in stages], [rows[F + k] for k in stages]
    moved = [x - u0 for x in u]
    damping, friction = rows[DAMPING], _friction(rows, law)
    residual: list[Lane] = []
    matrix: list[list[Lane | float]] = []
    nearest = absolute(u[0])
    for k in stages:
        phi, slope = friction(u[k] * steep)
        force = damping * u[k] + f[k] + mu * phi
        residual.append(-(dot(INVERSE[k], moved) + h * force))
        row: list[Lane | float] = [float(a) for a in INVERSE[k]]
        row[k] = h * (damping + mu * steep * slope) + row[k]
        matrix.append(row)
        nearest = less(nearest, absolute(u[k]))
    pivots: list[Lane] = []
    for k in stages:  # no pivoting: the diagonal only grows; beyond a peak a step that this fails is too long anyway
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
    outside = nearest * steep - x > 20.0
    if law in SHAPES:  # it is bent there too
        bend = x * rows[FALL]
        outside = outside & (h * mu * bend * bend < _allowed(rows, law) * _SOLVED)
    inside = (x * change < _allowed(rows, law) * _SOLVED) & ((x < 0.1) | outside)
    rounding = change < (size + absolute(u0) + h * scale) * 1e-15
    solved = (inside | rounding) & (absolute(finite) < 1e300) | (done > 0.5)
    rows[DONE] = where(solved, h * 0.0 + 1.0, 0.0)
    return solved


def _error(rate: list[Lane]) -> Lane:
    """Size of the last Legendre coefficients of what is given at the nodes."""
    return greater(absolute(dot(TO_LEGENDRE[-1], rate)), absolute(dot(TO_LEGENDRE[-2], rate)) * _LAST_BUT_ONE)


def _finish(rows: Rows, law: Law) -> Lane:
    """From u at the nodes: z there, and the error by the nodes. Gives who is done within it."""
    h, u0, z0, belt = rows[H], rows[U0], rows[Z0], rows[BELT]
    stages = range(STAGES)
    u = [rows[U + k] for k in stages]
    moved = [x - u0 for x in u]
    rate = [dot(INVERSE[k], moved) for k in stages]  # times h
    for k in stages:
        rows[Z + k] = z0 + h * (dot(WEIGHTS[k], u) + belt * float(NODES[k]))
    error = _error(rate)
    rows[ERROR] = error
    return (rows[DONE] > 0.5) & (error < _allowed(rows, law))


def _probe(rows: Rows, law: Law) -> Lane:
    """The error off the nodes, and whether u may have strayed unseen. Gives who is well.

    Off the nodes the friction is not what the nodes make of it: the error is this defect divided by the stiffness
    there; with a peak by the least stiffness of the step, for what leaves a peak is not taken back. What a step that
    has passed the layer errs by is the same at its end, where otherwise it is far less than between the nodes.

    A polynomial is suspect whose hull goes deeper into the layer than any place that was looked at; and one that
    comes to a peak and errs by more than a share of it, or of the distance. Where |F| lies between kinetic and static
    friction the layer holds a block, but behind it nothing contradicts a step that missed it. A force beside which
    friction is rounding is held by none.
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
    error, friction = rows[ERROR], _friction(rows, law)
    most, softest = h * 0.0, h * 0.0 + 1e300
    for m in range(len(PLACES)):
        there = dot(ALL_AT_PLACES[m], values) if m > 0 else u0
        phi, slope = friction(there * steep)
        bent = damping * (there - dot(AT_PLACES[m], u)) + mu * phi
        defect = absolute(h * bent + dot(AT_PLACES[m], pull)) * (1.0 if m > 0 else _AT_START)
        error = greater(error, defect / (1.0 + h * (damping + mu * steep * _stiff(slope, law))))
        most, softest = greater(most, defect), less(softest, slope)
        low, high = less(low, there), greater(high, there)
    if law is not Plain:
        held = most / (1.0 + h * (damping + mu * steep * _stiff(softest, law)))
        error = where(rows[PEAK] < 1e300, greater(error, held), error)
    behind = where(u[-1] > 0.0, u0, u0 * -1.0)
    error = where((behind * steep < _IN) & (absolute(u[-1]) * steep > _OUT), error * rows[PASSED], error)
    hull_low, hull_high = _bounds(values)
    rows[ERROR] = error
    reach = rows[REACH]
    under = (low * steep - hull_low * steep > 1.0) & (hull_low * steep < reach) & (low * steep > -reach)
    over = (hull_high * steep - high * steep > 1.0) & (hull_high * steep > -reach) & (high * steep < reach)
    suspect = under | over
    if law is not Plain:
        peak = rows[PEAK]
        away = less(absolute(absolute(u0) - peak), absolute(absolute(u[-1]) - peak))
        allowed = greater(less(peak * _OF_PEAK, away * _OF_DISTANCE), peak * rows[AT_PEAK])
        least = absolute(rows[F])
        for k in range(1, STAGES):
            least = less(least, absolute(rows[F + k]))
        may_hold = rows[STATIC] > least * _ROUNDING
        suspect = suspect | ((low < peak * NEAR_PEAK) & (high > peak * -NEAR_PEAK) & (error > allowed) & may_hold)
    rows[SUSPECT] = where(suspect, h * 0.0 + 1.0, 0.0)
    return (error < _allowed(rows, law)) & (where(suspect, h * 0.0 + 1.0, 0.0) < 0.5)


def _force(is_change: bool) -> Callable[[Rows, Law], None]:
    """F from the products of K, of all of z or of what it changed by; what w may change by, and the tail of F."""

    def formula(rows: Rows, law: Law) -> None:
        drag = rows[DRAG]
        before = [rows[F + k] for k in range(STAGES)]
        after = [rows[PRODUCT + k] + (before[k] if is_change else drag) for k in range(STAGES)]
        most = absolute(after[0] - before[0])
        for k in range(1, STAGES):
            most = greater(most, absolute(after[k] - before[k]))
        for k in range(STAGES):
            rows[F + k] = after[k]
        scale = rows[H] / rows[TOLERANCE]
        if law is not Plain:
            least = absolute(after[0])
            for k in range(1, STAGES):
                least = less(least, absolute(after[k]))
            stays = _SWIFT / greater(least - rows[STATIC], _SWIFT)
            scale = scale * where(_is_near_peak(rows) & (rows[FINE] < 1.0), greater(stays / rows[H], 1.0), 1.0)
        tail, noise = _error(after), rows[NOISE]
        rows[MOVED] = where(most < noise, scale * 0.0, (most - noise) * scale)
        rows[TAIL] = where(tail < noise, scale * 0.0, (tail - noise) * scale)

    return formula


def _bounds(values: list[Lane]) -> tuple[Lane, Lane]:
    """Of the polynomial with these values at the start and the nodes, by the hull of its Bernstein coefficients."""
    low, high = values[0], values[0]
    for j in range(1, STAGES + 1):
        coefficient = dot(TO_BERNSTEIN[j], values)
        low, high = less(low, coefficient), greater(high, coefficient)
    return low, high


def _view(rows: Rows, _: Numbers) -> None:
    """Bounds of u and of F on the step."""
    rows[LOW], rows[HIGH] = _bounds([rows[U0], *(rows[U + k] for k in range(STAGES))])
    rows[LOW_FORCE], rows[HIGH_FORCE] = _bounds([rows[FORCE0], *(rows[F + k] for k in range(STAGES))])


def _predict(rows: Rows, numbers: Numbers) -> None:
    """Begin a macro step: its tolerance, and F and u at the nodes by the polynomials of the last."""
    h = numbers[STAGES, STEP_H]
    atol, rtol = numbers[STAGES, ATOL], numbers[STAGES, RTOL]
    rows[H] = h
    speed = greater(absolute(rows[U0] + rows[BELT]), rows[SPEED_BEFORE])
    tolerance = less(atol + rtol * speed, (atol + rtol * absolute(rows[Z0])) / h)
    rows[TOLERANCE] = tolerance * numbers[STAGES, TO_TOLERANCE]
    rows[NOISE] = (rows[ROW_SUM] * numbers[STAGES, SIZE] + absolute(rows[FORCE0])) * _ROUNDING
    f, u, u0 = ([rows[KEPT_F + k] for k in range(STAGES)], [rows[KEPT_U + k] for k in range(STAGES)], rows[U0])
    leads_nowhere = rows[FLAGGED] > 0.5  # the polynomial of a block with steps of its own
    for k in range(STAGES):
        weights = [numbers[k, j] for j in range(STAGES)]
        rows[F + k] = total([w * x for w, x in zip(weights, f, strict=True)])
        rows[U + k] = where(leads_nowhere, u0, total([w * x for w, x in zip(weights, u, strict=True)]))


def _prepare(rows: Rows, law: Law) -> None:
    """F at the nodes of a step of a block's own, and a first guess of u there."""
    start, length, h, u0 = rows[START], rows[LENGTH], rows[H], rows[U0]
    powers = [rows[G + p] for p in range(STAGES)]

    def force(x: Lane) -> Lane:
        value = powers[-1]
        for p in reversed(range(STAGES - 1)):
            value = value * x + powers[p]
        return value

    phi, slope = _friction(rows, law)(u0 * rows[STEEP])
    rate = -(rows[DAMPING] * u0 + force(start) + rows[FRICTION] * phi)
    stiffness = rows[DAMPING] + rows[FRICTION] * rows[STEEP] * _stiff(slope, law)
    for k in range(STAGES):
        rows[F + k] = force(start + length * float(NODES[k]))
        after = h * float(NODES[k])
        rows[U + k] = u0 + after * rate / (1.0 + after * stiffness)


def _gather(of: int, since: int, to: int) -> Callable[[Rows, Numbers], None]:
    """Add what the step taken has of the integrals of x^p (z(x) - z(0)), or of u, over the macro step.

    Of the change alone: from moments to the values at the nodes rounding grows a thousandfold.
    """

    def formula(rows: Rows, _: Numbers) -> None:
        start, length, taken = rows[START], rows[LENGTH], rows[TAKEN]
        moments = [rows[to + p] for p in range(STAGES)]
        for k in range(STAGES):
            x = start + length * float(NODES[k])
            weight = where(taken > 0.0, (rows[of + k] - rows[since]) * taken * float(LAST[k]), 0.0)
            for p in range(STAGES):
                moments[p] = moments[p] + weight
                weight = weight * x
        for p in range(STAGES):
            rows[to + p] = moments[p]

    return formula


#: For kernels.
newton, finish, probe, view = on_rows(_newton), on_rows(_finish), on_rows(_probe), on_rows(_view)
predict, prepare = on_rows(_predict), on_rows(_prepare)
gather, gather_u = on_rows(_gather(Z, Z_MACRO, MOMENT)), on_rows(_gather(U, U_MACRO, MOMENT_U))
force, force_changed = on_rows(_force(False)), on_rows(_force(True))
