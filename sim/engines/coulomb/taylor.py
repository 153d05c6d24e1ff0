"""The Taylor series of all blocks between events: expanded, shifted, and carried over an event.

With z(t0 + s) = sum_k c_k s^k, a slipping block has

    (k + 2)(k + 1) c_{k+2} = -R (k + 1) c_{k+1} - K c_k - [k = 0] mu sigma        sigma = +-1: direction of slip

and a sticking one c_1 = v and no more; the coefficients of an external force are subtracted from K c_k, and those of
the damping between blocks, (k + 1) N c_{k+1}, added, which takes one more product an order. Where
friction falls with the speed of slip, mu is a series too, near (f + (1 - f) S(x)), f = far / near, x = a sigma (w -
v), a the steepness; S_k follow from x_0 .. x_k, x_j = a sigma (j + 1) c_{j+1}, by the recurrence of the law.

`expand` builds the series with one product an order, two to a pass over K, and decides on the way which blocks with
w = v stick. From then on a block is known by one polynomial: z while it slips, the force on it, F - R v, while it
sticks, where z moves with the belt. `correct` carries them over an event of one block without a new expansion if
friction does not fall: the others then respond by linear equations.
"""

from __future__ import annotations

import math

import numpy as np

from stickslip.sim.engines import course
from stickslip.sim.engines.coulomb import control
from stickslip.sim.engines.coulomb.control import Goal
from stickslip.sim.engines.coulomb.expansion import Expansion, Shape, Window
from stickslip.sim.engines.coulomb.model import SERIES_OF, Cross, Model, SpeedWeakening, coupling, fastest_belt
from stickslip.sim.engines.coulomb.sticking import force_rounding, known, push, settle, settle_by_order
from stickslip.sim.engines.course import State
from stickslip.sim.engines.forcing import acts, begin, may_change, take_off
from stickslip.sim.engines.polynomials import Polynomials, begin_series, extend_series, left_at, place_of, value_of
from stickslip.sim.kernels.compile import inner, one_of
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.arithmetic import ROUNDING, copy, largest
from stickslip.sim.numerics.horner import shift_rows
from stickslip.sim.numerics.panels import SINGLE_ERROR
from stickslip.sim.numerics.products import list_moving, one_product, two_products, two_single_products
from stickslip.sim.numerics.sparse import Columns

UNDECIDED = 2  #: in the place of a mode


_recurrence = one_of([law.recurrence for law in SERIES_OF])
_shape_of_law = one_of([law.shape for law in SERIES_OF])


@inner
def _shape_of(pieces: Polynomials | None, law: int, x: float) -> float:
    """S of x, by the law's pieces or its code."""
    if pieces is None:
        return _shape_of_law(law, x)
    return value_of(pieces, x)


@inner
def _extend_by(
    pieces: Polynomials | None, law: int, k: int, z: Floats, x0: Floats, scale: Floats, shape: Floats
) -> None:
    """S_k of all blocks, k >= 1, by the law's pieces or its code."""
    if pieces is None:
        _recurrence(law, k, z, x0, scale, shape)
    else:
        extend_series(k, z, scale, shape)


@inner
def _begin_by(pieces: Polynomials | None, x0: Floats, shape: Floats) -> None:
    """Begin the series of S, of pieces."""
    if pieces is not None:
        begin_series(pieces, x0, shape)


@inner
def _share_of(pieces: Polynomials | None, is_entire: bool, x0: float, left: float, slope: float) -> float:
    """One over the change of x within which the series of S is of use, in units of `control.TO_POLE`."""
    if pieces is None:
        return left if is_entire or left == 0.0 else 1.0 / (1.0 + x0)
    if left == 0.0:
        return 0.0
    place = place_of(pieces, x0)
    return control.TO_POLE / (pieces.high[place] - x0 if slope > 0.0 else x0 - pieces.low[place])


@inner
def _is_lost(law: SpeedWeakening, model: Model, expansion: Expansion, i: int) -> bool:
    """Whether the most that a block's friction may fall by is below the rounding of its other forces.

    Such a block passes its belt in so short a time that the series of friction in time leaves float64.
    """
    force = model.damping[i] * expansion.series[1, i] + expansion.forces[0, i]
    return model.friction[i] * (1.0 - law.far[i]) <= ROUNDING * abs(force)


@inner
def _extend_shape(shape: Shape, model: Model, expansion: Expansion, k: int) -> None:
    """S_k of all blocks."""
    law, series, of_shape, scale, x0 = shape.law, expansion.series, shape.series, shape.scale, shape.x0
    for i in range(len(scale)):
        scale[i] = law.steepness * expansion.mode[i]
    if k > 0:
        _extend_by(law.pieces, law.law, k, series, x0, scale, of_shape)
        return
    for i in range(len(scale)):
        x0[i] = scale[i] * (series[1, i] - model.belt_speed[i])
        of_shape[0, 0, i] = _shape_of(law.pieces, law.law, x0[i])
    _begin_by(law.pieces, x0, of_shape)
    for i in range(len(scale)):
        if _is_lost(law, model, expansion, i):
            of_shape[:, 0, i] = 0.0  # and by the recurrence all other S_k


@inner
def _resist(shape: Shape | None, model: Model, expansion: Expansion, k: int) -> None:
    """Add friction at order k, less the constant part that `_expand` has, to the coefficients k + 2."""
    if shape is None:
        return
    series, mode, slips = expansion.series, expansion.mode, expansion.slips
    _extend_shape(shape, model, expansion, k)
    factor = -1.0 / ((k + 2) * (k + 1))
    for i in range(len(mode)):
        less = model.friction[i] * (1.0 - shape.law.far[i]) * (shape.series[0, k, i] - (1.0 if k == 0 else 0.0))
        series[k + 2, i] += slips[i] * factor * less * mode[i]


@inner
def _known_within(shape: Shape | None, expansion: Expansion) -> float:
    """The time over which the series of S is of use: until x, at its present slope, is half of the way to a pole.

    If S has no pole, until S would change by half of S(0), as exp(-x) at its present slope would.
    """
    time = np.inf
    if shape is None:
        return time
    law = shape.law
    for i in range(len(expansion.mode)):
        left = shape.series[0, 0, i]
        slope = expansion.mode[i] * expansion.series[2, i]
        share = _share_of(law.pieces, law.is_entire, shape.x0[i], left, slope)
        rise = abs(2.0 * law.steepness * expansion.series[2, i] * share)
        if rise * time > control.TO_POLE:
            time = control.TO_POLE / rise
    return time


@inner
def _within_pieces(
    pieces: Polynomials | None, shape: Shape, model: Model, expansion: Expansion, order: int, h: float
) -> float:
    """The time, at most h, at which x of a block first leaves the piece of S from which its series is."""
    if pieces is None:
        return h
    for i in range(len(expansion.mode)):
        if expansion.mode[i] != 0 and not _is_lost(shape.law, model, expansion, i):
            h = left_at(pieces, expansion.series, shape.scale[i], shape.x0[i], i, order, h)
    return h


@inner
def _within(shape: Shape | None, model: Model, expansion: Expansion, order: int, h: float) -> float:
    """The part of a step h in which friction is as its series are."""
    if shape is None:
        return h
    return _within_pieces(shape.law.pieces, shape, model, expansion, order, h)


@inner
def _is_friction_known(
    shape: Shape | None, model: Model, expansion: Expansion, order: int, h: float, allowed: float
) -> bool:
    """Whether, up to h, friction is what the series up to this order say."""
    if shape is None:
        return True
    h = _within(shape, model, expansion, order, h)
    return _is_shape(shape, model, expansion, order, h, allowed) and (
        not shape.law.is_entire or _weakens_less(shape.law, model, expansion, order, h, allowed)
    )


@inner
def _weakens_less(
    law: SpeedWeakening, model: Model, expansion: Expansion, order: int, h: float, allowed: float
) -> bool:
    """Whether, up to h, the terms of an S without a pole fall beyond this order, or are too small to matter.

    Where x is large the first terms of exp(-x) are far below any tolerance, yet x may fall by more than the order.
    """
    series, mode = expansion.series, expansion.mode
    for i in range(len(mode)):
        drop = model.friction[i] * (1.0 - law.far[i]) * h
        if mode[i] == 0 or drop == 0.0 or _is_lost(law, model, expansion, i):
            continue
        change, power = 0.0, law.steepness
        for k in range(1, order):
            power *= h
            change += (k + 1) * abs(series[k + 1, i]) * power
        x = law.steepness * mode[i] * (series[1, i] - model.belt_speed[i])
        least = max(x - change, 0.0)
        rest = drop * _shape_of(law.pieces, law.law, least)
        if change > control.RISING * order and rest > control.OF_FEW * allowed:
            return False
    return True


@inner
def _is_shape(shape: Shape, model: Model, expansion: Expansion, order: int, h: float, allowed: float) -> bool:
    """Whether at h the series of S has come to S, but for what is allowed.

    Terms of some orders may vanish though those beyond do not, as where R makes up for the fall of friction. The
    error of w is that of friction, from its first term that lacks. Of a block that comes to its belt an earlier
    instant is looked at.
    """
    series, law = expansion.series, shape.law
    for i in range(len(expansion.mode)):
        drop = model.friction[i] * (1.0 - law.far[i]) * h
        if expansion.mode[i] == 0 or drop == 0.0 or shape.series[0, 0, i] == 0.0:  # the last: see `_is_lost`
            continue
        x, s = -1.0, 2.0 * h
        for _ in range(4):
            if x >= 0.0:
                break
            s *= 0.5
            x, size, approximation, power = shape.x0[i], 1.0, shape.series[0, 0, i], 1.0
            for k in range(1, order):
                power *= s
                term = shape.scale[i] * (k + 1) * series[k + 1, i] * power
                x += term
                size += abs(term)
                approximation += shape.series[0, k, i] * power if k < order - 1 else 0.0
        if x >= 0.0:
            lacking = abs(_shape_of(law.pieces, law.law, x) - approximation) - ROUNDING * size
            if drop * lacking > order * allowed:
                return False
    return True


@inner
def _may_be_single(model: Model, k: int, sizes: Floats, h: float, allowed: float) -> bool:
    """Whether products of K with c_k and c_{k+1}, of these sizes, may be in single precision.

    An error e of K c_k, relative to the row sums of K, is one of h^k e in F and of h^(k + 1) e in w. The error of F
    may be what an error `allowed` of w makes it.
    """
    if len(model.pairs.single_panels) == 0:
        return False
    power = SINGLE_ERROR * h**k * max(1.0 / h, largest(model.row_sums) * h)
    low, high = sizes[0], h * sizes[1]
    if 0.0 < low <= control.TINY or 0.0 < high <= control.TINY:  # they cannot be scaled
        return False
    return power * max(low, high) <= control.ROUNDED_OFF * allowed


@inner
def _drag_along(cross: Cross | None, series: Floats, k: int, forces: Floats) -> None:
    """Add the k-th coefficient of N w to that of K z, and bound its rounding."""
    if cross is None:
        return
    one_product(cross.columns, series[k + 1], cross.product, cross.moving)
    most = (k + 1) * largest(series[k + 1])
    for i in range(len(forces)):
        forces[i] += (k + 1) * cross.product[i]
        cross.noise[k, i] = cross.row_sums[i] * most


@inner
def _products_to(model: Model, k: int) -> int:
    """The number of products up to order k: of K two orders at a time, of N each."""
    of_stiffness = k + 1 + (k + 1) % 2
    return of_stiffness if model.cross is None else of_stiffness + k + 1


@inner
def expand(
    model: Model, expansion: Expansion, goal: Goal[float], state: State, target: float
) -> tuple[int, float, float, int]:
    """Expand the series of all blocks at the present instant, and decide the modes of those with w = v on the way.

    Returns the order reached, the step on which the series holds to `tol`, the error of w that `tol` allows, and
    the number of products.
    """
    n_products = 0
    while True:
        order, h, allowed, n_more = _expand(model, expansion, goal, state, target)
        n_products += n_more
        if order > 0:
            expansion.leaves[:] = 0
            h = _within(expansion.shape, model, expansion, order, h)
            hold(expansion, order)
            return order, h, allowed, n_products


@inner
def _begin(model: Model, expansion: Expansion, state: State) -> tuple[int, float]:
    """The coefficients of z up to the second order.

    Returns how many blocks are not decided yet, and what a force pushes in the next order.
    """
    damping, friction, v, t = model.damping, model.friction, model.belt_speed, state.clock[course.TIME]
    series, forces, mode, slips = expansion.series, expansion.forces, expansion.mode, expansion.slips
    z, w = state.z, state.w
    for i in range(len(z)):
        if expansion.touching[i] or mode[i] == 0:
            w[i] = v[i]
    copy(z, series[0])
    copy(w, series[1])
    m = list_moving(series[0], series[1], expansion.room.columns)
    two_products(model.columns, model.pairs, expansion.room, m, series[:2], forces[:2])
    begin(model.forcing, t)
    take_off(model.forcing, t, 0, forces[0])
    pushed = take_off(model.forcing, t, 1, forces[1])
    _drag_along(model.cross, series, 0, forces[0])
    n_undecided = settle(model, largest(z), expansion)
    for i in range(len(z)):
        slips[i] = 1.0 if mode[i] != 0 else 0.0
        series[2, i] = -0.5 * slips[i] * (damping[i] * w[i] + forces[0, i] + friction[i] * mode[i])
    _resist(expansion.shape, model, expansion, 0)
    return n_undecided, pushed


@inner
def _pull(model: Model, expansion: Expansion, k: int, m: int, may_be_single: bool, h: float, allowed: float) -> bool:
    """K times the coefficients k and k + 1 of z, m of which move; returns whether single precision rounds them."""
    series, forces, sizes = expansion.series[k : k + 2], expansion.forces[k : k + 2], expansion.sizes
    if may_be_single and _may_be_single(model, k, sizes, h, allowed):
        two_single_products(model.pairs, expansion.room, m, series, sizes, forces)
        return max(sizes[0], sizes[1]) > 0.0  # products of nothing are exact
    two_products(model.columns, model.pairs, expansion.room, m, series, forces)
    return False


@inner
def _extend(model: Model, expansion: Expansion, k: int) -> float:
    """The coefficients k + 2 of z, from those of F; returns the largest."""
    series, forces, slips, damping = expansion.series, expansion.forces, expansion.slips, model.damping
    factor, sizes = -1.0 / ((k + 2) * (k + 1)), expansion.sizes
    for i in range(len(slips)):
        series[k + 2, i] = slips[i] * factor * (damping[i] * (k + 1) * series[k + 1, i] + forces[k, i])
    _resist(expansion.shape, model, expansion, k)
    sizes[0], sizes[1] = sizes[1], largest(series[k + 2])
    return sizes[1]


@inner
def _known_step(
    model: Model, expansion: Expansion, order: int, last: float, before: float, target: float, allowed: float
) -> float:
    """The step, at most `target`, on which the last two terms, of these sizes, and friction are as allowed."""
    h = target
    if last > 0.0:
        h = min(h, (allowed / (order * last)) ** (1.0 / (order - 1)))
    if before > 0.0:
        h = min(h, (allowed / ((order - 1) * before)) ** (1.0 / (order - 2)))
    while h > 0.0 and not _is_friction_known(expansion.shape, model, expansion, order, h, allowed):
        h *= control.SHRINK
    return h


@inner
def _expand(
    model: Model, expansion: Expansion, goal: Goal[float], state: State, target: float
) -> tuple[int, float, float, int]:
    """As `expand`; the order is 0 if it is to begin again, now that a block is known to leave."""
    series, forces, slips, sizes = expansion.series, expansion.forces, expansion.slips, expansion.sizes
    shape, forcing, t = expansion.shape, model.forcing, state.clock[course.TIME]
    n_undecided, pushed_next = _begin(model, expansion, state)
    target = min(target, _known_within(shape, expansion))
    # the error of w allowed in this step: relative to w, the belt and the change of w; that of z is then smaller
    allowed = goal.tol * max(largest(state.w), fastest_belt(model), 2.0 * largest(series[2]) * target)
    allowed = max(allowed, goal.tol * target * may_change(forcing, t, target), control.LEAST_ALLOWED)
    n_small, last, before, pushed, is_single, m = 0, 0.0, 0.0, 0.0, False, -1
    sizes[1] = largest(series[2])
    for k in range(1, control.ORDER_MAX - 1):
        if k % 2 == 0:
            m = list_moving(slips, slips, expansion.room.columns) if m < 0 else m
            is_single = _pull(model, expansion, k, m, n_undecided == 0, target, allowed) or is_single
            pushed = take_off(forcing, t, k, forces[k])
            pushed_next = take_off(forcing, t, k + 1, forces[k + 1])
        else:
            pushed = pushed_next
        _drag_along(model.cross, series, k, forces[k])
        if n_undecided > 0:
            n_decided, is_repeated = settle_by_order(model, k, largest(series[k]), expansion)
            if is_repeated:
                return 0, 0.0, 0.0, _products_to(model, k)
            n_undecided, m = n_undecided - n_decided, -1
            for i in range(len(slips)):
                slips[i] = 1.0 if expansion.mode[i] != 0 else 0.0
            if k == 1:
                sizes[1] = largest(series[2])
        size, order = _extend(model, expansion, k), k + 2
        if order > control.ORDER_MIN and not size < control.HUGE:  # the terms before it determine the step
            order -= 1
            break
        if order > control.ORDER_MIN and 0.0 < size * min(1.0, goal.rate * goal.rate) < control.FAINT:
            before, last = last, max(size, control.FAINT)
            break
        if pushed > 0.0:  # the truncated series of a force counts where it moves a block, and where friction holds it
            size = max(size, pushed * max(1.0 / (order * (order - 1)), 1.0 / (order * (goal.rate * target) ** 2)))
        n_products = _products_to(model, k)
        # the last term of w decides; two in a row, since one can vanish by chance
        is_polynomial = size == 0.0 and last == 0.0 and order >= control.ORDER_MIN
        if is_polynomial and _is_friction_known(shape, model, expansion, order, target, allowed):
            # exact at any distance
            is_exact = not is_single and (shape is None or largest(slips) == 0.0)
            speed = max(largest(forces[1]), largest(series[2]))
            far = goal.t_end - t if speed == 0.0 else min(goal.t_end - t, control.FAR / speed)
            return order, far if is_exact else target, allowed, n_products
        n_small = n_small + 1 if order * size * target ** (order - 1) <= allowed else 0
        # below order = rate * target the terms of a small state may still rise
        is_enough = n_small >= 2 and n_undecided == 0 and order >= max(control.ORDER_MIN, goal.rate * target)
        if is_enough and _is_friction_known(shape, model, expansion, order, target, allowed):
            return order, target, allowed, n_products
        before, last = last, size
    return order, _known_step(model, expansion, order, last, before, target, allowed), allowed, n_products


@inner
def error_after(
    model: Model, expansion: Expansion, goal: Goal[float], window: Window, step: float, error: float
) -> float:
    """The error of w a step into a window, from that before it: what the series leave out by then, and rounding.

    The terms left out first follow from the last two, which have come to the error allowed at most, wherever in the
    window a block's series begins. A window is at most `control.SPAN` long at the rates of its series, which leave
    the transients of heavily damped blocks out (`overdamped`). What an event that was carried over leaves out, and
    the rounding of products in single precision, grow like the fifth power of the time, at least; the former like its
    square where damping couples blocks.
    """
    series, damping, order = expansion.series, model.damping, window.order
    reach = min(goal.rate * step, control.SPAN)
    left_out, coupled = 0.0, reach * reach / (order * (order - 1))
    power = step ** (order - 2)
    for i in range(len(damping)):
        low, high = abs(series[order - 1, i]), abs(series[order, i])
        if low + high > 0.0:
            low = min((order - 1) * power * low, window.allowed)
            high = min(order * power * step * high, window.allowed)
            damped = min(abs(damping[i]) * step, reach) if model.cross is None else reach
            left_out = max(left_out, damped / order * high + coupled * (low + high))
    share = control.passed_on(len(damping))
    share += control.LIKELY * control.ROUNDED_OFF if len(model.pairs.single_panels) > 0 else 0.0
    passed = min(1.0, step / window.span)
    carried = share * window.allowed * (passed**5 if model.cross is None else passed * passed)
    rounding = ROUNDING * window.allowed / goal.tol
    return error * math.exp(-goal.decay * step) + left_out + carried + rounding


@inner
def hold(expansion: Expansion, order: int) -> None:
    """Know blocks that stick by the force on them from here on, of two orders less than z: the last two are zero."""
    series, forces, mode = expansion.series, expansion.forces, expansion.mode
    for i in range(len(mode)):
        if mode[i] == 0:
            expansion.stuck_z[i] = series[0, i]
            for k in range(order - 1):
                series[k, i] = forces[k, i]
            series[order - 1, i], series[order, i] = 0.0, 0.0


@inner
def shift(expansion: Expansion, order: int, step: float, v: Floats) -> None:
    """Shift the origin of all series by a step."""
    stuck_z, steps = expansion.stuck_z, expansion.steps
    for i in range(len(stuck_z)):
        stuck_z[i] += step * v[i]
        steps[i] = step
    shift_rows(expansion.series, 0, len(stuck_z), order, steps)


@inner
def pull_of(model: Model, i: int, mode: int, series: Floats, column: int, order: int, pull: Floats) -> None:
    """The coefficients of F - R v of block i, whose series, in this mode, is this column."""
    for k in range(order - 1):
        pull[k] = series[k, column]
        if mode != 0:
            pull[k] = -(k + 1) * ((k + 2) * series[k + 2, column] + model.damping[i] * series[k + 1, column])
    if mode != 0:
        pull[0] -= model.friction[i] * mode


@inner
def decide(model: Model, i: int, was_stuck: bool, force: float, slope: float, window: Window, rate: float) -> int:
    """Mode of block i after its event, from F and its slope; UNDECIDED if that takes more accurate series."""
    span, allowed, z_max = window.span, window.allowed, window.z_max
    most, row_sum = model.static[i], model.row_sums[i]
    is_pushed = acts(model.forcing) or model.cross is not None
    rate_error = max(row_sum, rate * rate) * allowed if is_pushed else row_sum * allowed
    drag, noise = model.damping[i] * model.belt_speed[i], known(model, 0, i)
    # the last: a series that was shifted lacks a term of C w
    of_drag = (model.damping[i] + coupling(model.cross, i)) * allowed
    error = rate_error * span + force_rounding(drag, row_sum * z_max, most, noise) + of_drag
    doubt = control.DOUBT * error
    new = -1 if force > 0.0 else 1
    if was_stuck:
        if abs(abs(force) - most) > doubt or -slope * new <= control.DOUBT * rate_error:
            new = UNDECIDED
    elif push(model.closed[i], force) < most - doubt:
        new = 0
    elif push(model.closed[i], force) <= most + doubt:
        new = UNDECIDED
    return new


@inner
def curvature(model: Model, i: int, was_stuck: bool, new: int, force: float) -> float:
    """c_2 of block i from its event on, in its new mode, under this F; one that has stuck leaves with F at m."""
    if new == 0:
        return 0.0
    if was_stuck:
        return 0.5 * (model.static[i] - model.friction[i]) * new
    return -0.5 * (force + model.friction[i] * new)


@inner
def _copy_column(columns: Columns, i: int, column: Floats) -> None:
    """Column i of K, dense or sparse."""
    if len(columns.dense) > 0:
        copy(columns.dense[i], column)
        return
    column[:] = 0.0
    for k in range(columns.indptr[i], columns.indptr[i + 1]):
        column[columns.indices[k]] = columns.data[k]


@inner
def _change_own(model: Model, expansion: Expansion, i: int, new: int, order: int, diagonal: float) -> None:
    """The series of block i from its event on, at the belt's speed, and how it changes z; `diagonal` is K_ii."""
    series, stuck_z, pull, change = expansion.series, expansion.stuck_z, expansion.pull, expansion.change
    damping, v, was_stuck = model.damping[i], model.belt_speed[i], expansion.mode[i] == 0
    z = stuck_z[i] if was_stuck else series[0, i]
    for k in range(order - 1):
        old = 0.0 if was_stuck else series[k + 2, i]
        if k == 0:
            c = curvature(model, i, was_stuck, new, damping * v + pull[0])
        elif new == 0:
            c = 0.0
        else:
            c = -(damping * (k + 1) * series[k + 1, i] + pull[k]) / ((k + 2) * (k + 1))
        series[k + 2, i], change[k + 2] = c, c - old
        if k + 2 <= order - 2:
            pull[k + 2] += diagonal * change[k + 2]
    series[0, i], series[1, i] = z, v
    if new == 0:
        stuck_z[i] = z
        for k in range(order - 1):
            series[k, i] = pull[k]
    expansion.mode[i] = new
    expansion.slips[i] = 1.0 if new != 0 else 0.0


@inner
def _change_others(model: Model, expansion: Expansion, order: int, h: float, limit: float) -> tuple[float, int]:
    """The series of the others from an event on, by its block's `change` and `column`, whose own entry is zero.

    Where it is worth two products in single precision, K times the first two coefficients of the others is included:
    without it 200 to 400 blocks took 5 to 25% longer at 1e-10 and below (`python -m tests.pieces`).

    Returns the time until what is left out makes an error of w at the limit, at most h, and the number of products.
    """
    series, slips, damping, last = expansion.series, expansion.slips, model.damping, expansion.last
    column, change, sizes = expansion.column, expansion.change, expansion.sizes
    passed, more = expansion.forces[:2], expansion.forces[2:4]  # their first two coefficients, and K times these
    last[:] = 0.0
    row_sum, passed_on, power, degree, n_products = largest(model.row_sums), 0.0, h**5, 5.0, 0
    for k in range(2, order - 1):
        factor, has_more = -1.0 / ((k + 2) * (k + 1)), n_products > 0 and k < 6
        for j in range(len(last)):
            pull = column[j] * change[k] + (more[k - 4, j] if has_more else 0.0)
            last[j] = slips[j] * factor * (damping[j] * (k + 1) * last[j] + pull)
            series[k, j] += (1.0 - slips[j]) * pull
            series[k + 2, j] += last[j]
        passed_on += largest(last) * power
        power *= h
        if k < 4:
            copy(last, passed[k - 2])
            sizes[k - 2] = largest(last)
        if k != 3 or len(model.pairs.single_panels) == 0 or min(sizes[0], sizes[1]) <= control.TINY:
            continue
        if limit < row_sum * passed_on / degree < limit / SINGLE_ERROR:
            m = list_moving(passed[0], passed[1], expansion.room.columns)
            two_single_products(model.pairs, expansion.room, m, passed, sizes, more)
            passed_on, degree, n_products = 0.0, 7.0, 2
    error = row_sum * passed_on / degree  # grows like h^degree
    return h if error <= limit else h * (limit / error) ** (1.0 / degree), n_products


@inner
def correct(
    model: Model, expansion: Expansion, block: int, window: Window, h: float, rate: float
) -> tuple[float, int]:
    """Carry the series over an event of one block, without a new expansion.

    From the event on, block i moves by its new equation, z_i + delta, where delta starts at second order. The others
    feel K_ji delta, from fourth order on. What they pass on in turn is left out and bounded: its effect on w grows
    like h^5, or h^7 if their first two coefficients are passed on, and h is cut to where that stays below the
    tolerance.

    Returns that h, and the number of products; h = 0 if the event cannot be decided to the accuracy of the series
    (then nothing has changed, and a new expansion decides).
    """
    series, mode, column, pull = expansion.series, expansion.mode, expansion.column, expansion.pull
    i, order, allowed = block, window.order, window.allowed
    was_stuck = mode[i] == 0
    pull_of(model, i, mode[i], series, i, order, pull)
    force = model.damping[i] * model.belt_speed[i] + pull[0]
    new = decide(model, i, was_stuck, force, pull[1], window, rate)
    if new == UNDECIDED:
        return 0.0, 0
    _copy_column(model.columns, i, column)
    diagonal = column[i]
    column[i] = 0.0
    _change_own(model, expansion, i, new, order, diagonal)
    expansion.zeros[:] = 0
    expansion.side[:] = 0
    if new != 0:
        expansion.zeros[i] = 2 if was_stuck and model.static[i] == model.friction[i] else 1
    h, n_products = _change_others(model, expansion, order, h, control.passed_on(len(column)) * allowed)
    for k in (order, order - 1):  # two, since one can vanish by parity, as in `expand`
        tail = k * abs(series[k, i]) * h ** (k - 1)
        if tail > allowed:
            h *= (allowed / tail) ** (1.0 / (k - 1))
    return h, n_products
