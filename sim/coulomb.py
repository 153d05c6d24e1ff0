"""The exact engine: set-valued Coulomb friction, event by event, Taylor series between events.

Between events a sticking block moves with the belt (z linear in t: nothing to integrate) and a slipping one
obeys a linear law, so with z(t0 + s) = sum_k c_k s^k

    (k + 2)(k + 1) c_{k+2} = -R (k + 1) c_{k+1} - K c_k - [k = 0] mu sigma        sigma = +-1: direction of slip

One product with K an order gives the series of every block and, as K c_k, that of lambda of the sticking ones.
The next event is the first root of

    sigma (w - v)     of a slipping block,
    mu + sigma F      of a sticking one, F = R v + K z = -mu lambda, for either sigma.

A bound by the sum of |coefficients| dismisses most blocks; the rest go to `sim.kernels.roots`, which misses no
root. At an event every block with w = v is decided anew from |F| against mu; when they are equal (every exit
starts there) the first coefficient of F that does not vanish decides, order by order, while the series is
being built: until a block is decided its motion is the same under either mode, so simultaneous events, folds,
cusps and tangencies of any order need no case of their own.

An event changes the law of one block. That block's own series changes from the second order on, those of the
others from the fourth, by a column of K: most events are carried over in O(n) by `_correct`, without a product,
and one expansion serves a window of several events.
"""

from __future__ import annotations

import numpy as np

from sim import drive, fate
from sim.arguments import Floats, flag, number
from sim.compile import kernel
from sim.kernels import ROUNDING, largest, roots, two_products
from sim.run import Run
from sim.system import System

#: Highest order of the series, and the longest step in units of 1 / |eigenvalue|. There the last term is below
#: 1e-13 and rounding is amplified by less than exp(5); a longer step loses more to rounding than it gains.
ORDER_MAX = 32
_SPAN = 5.0
_ORDER_MIN = 4

#: A window aims at this many mean lengths: what lies beyond is cut off before it pays.
_REACH = 1.2
#: The share of the tolerance that each event carried over may leave out: the truncation of a series stays about as
#: far below the tolerance.
_PASSED_ON = 0.002
#: What is left of a window is used if it is more than this share of the mean length.
_WORTH = 0.1
#: Memory of that mean.
_DECAY = 0.9

#: This many instants in a row, each closer to the last than rounding can tell, are an accumulation of events.
_STALL = 1000

# behind the common clocks: decaying sums for the mean length of a window, time and number of windows cut short
_EXPOSURE, _CUTS = drive.N_CLOCKS, drive.N_CLOCKS + 1

_UNDECIDED_BOTH = 2  # a block without friction with w = v and F = 0: either side is open
_IDENTICALLY_ZERO = 10 * ORDER_MAX


@kernel
def _settle(law, z_max, forces, z, w, mode, touching, zeros, side):  # type: ignore[no-untyped-def]
    """Decide every block with w = v from |F| against mu; returns how many have |F| = mu and stay undecided."""
    _, row_sums, damping, friction, v = law
    n_undecided = 0
    for i in range(len(z)):
        zeros[i] = 0
        side[i] = 0
        if touching[i] or mode[i] == 0:
            mu = friction[i]
            drag = damping[i] * v
            force = drag + forces[0, i]
            slack = ROUNDING * (abs(drag) + row_sums[i] * z_max + mu)
            if abs(force) > mu + slack:
                mode[i] = -1 if force > 0.0 else 1
                zeros[i] = 1
            else:
                mode[i] = 0
                if abs(force) >= mu - slack:
                    n_undecided += 1
                    zeros[i] = _IDENTICALLY_ZERO
                    side[i] = _UNDECIDED_BOTH if mu <= slack else (-1 if force > 0.0 else 1)
    return n_undecided


@kernel
def _settle_by_order(law, k, c_max, forces, mode, zeros, side):  # type: ignore[no-untyped-def]
    """Decide blocks with |F| = mu whose F has its first coefficient at order k; returns how many that are."""
    _, row_sums, _, _, _ = law
    n_decided = 0
    for i in range(len(mode)):
        if side[i] != 0 and zeros[i] == _IDENTICALLY_ZERO:
            push = -forces[k, i]
            if abs(push) > ROUNDING * row_sums[i] * c_max:
                n_decided += 1
                if side[i] == _UNDECIDED_BOTH:
                    side[i] = 1 if push > 0.0 else -1
                if push * side[i] > 0.0:
                    mode[i] = side[i]
                    zeros[i] = k + 1
                else:
                    zeros[i] = k
    return n_decided


@kernel
def _expand(law, z, w, mode, slips, touching, series, forces, zeros, side, target, remaining, tol, rate, moving):  # type: ignore[no-untyped-def]
    """Series of all blocks at the present instant, deciding the modes of those with w = v on the way.

    `series[k]` and `forces[k]` receive c_k and K c_k; `zeros[i]`, `side[i]`: how many leading coefficients of
    block i's event function (on that side) vanish. Returns the order reached, the step on which the series
    holds to `tol`, and the number of products.
    """
    columns, _, damping, friction, v = law
    n = len(z)
    for i in range(n):
        if touching[i] or mode[i] == 0:
            w[i] = v
    series[0] = z
    series[1] = w
    two_products(columns, series[0], series[1], forces[0], forces[1], moving)
    w_max = largest(w)
    n_undecided = _settle(law, largest(z), forces, z, w, mode, touching, zeros, side)
    for i in range(n):
        slips[i] = 1.0 if mode[i] != 0 else 0.0
        series[2, i] = -0.5 * slips[i] * (damping[i] * w[i] + forces[0, i] + friction[i] * mode[i])
    # what w may err in this step, by what w and the belt are, or w becomes in it; z then errs less
    allowed = tol * max(w_max, abs(v), 2.0 * largest(series[2]) * target)

    n_small = 0
    last = 0.0
    for k in range(1, ORDER_MAX - 1):
        if k % 2 == 0:
            two_products(columns, series[k], series[k + 1], forces[k], forces[k + 1], moving)
        if n_undecided > 0:
            n_undecided -= _settle_by_order(law, k, largest(series[k]), forces, mode, zeros, side)
            for i in range(n):
                slips[i] = 1.0 if mode[i] != 0 else 0.0
        factor = -1.0 / ((k + 2) * (k + 1))
        for i in range(n):
            series[k + 2, i] = slips[i] * factor * (damping[i] * (k + 1) * series[k + 1, i] + forces[k, i])
        size = largest(series[k + 2])
        order = k + 2
        n_products = k + 1 + (k + 1) % 2
        # the last term's share of w decides; two in a row, since one can vanish by chance
        if size == 0.0 and last == 0.0 and order >= _ORDER_MIN:
            return order, remaining, allowed, n_products  # a polynomial: exact however far
        if order * size * target ** (order - 1) <= allowed:
            n_small += 1
            # before order = rate * target the terms of a small state may still be on their way up
            if n_small >= 2 and n_undecided == 0 and order >= max(_ORDER_MIN, rate * target):
                return order, target, allowed, n_products
        else:
            n_small = 0
        before = last
        last = size
    h = target
    order = ORDER_MAX
    if last > 0.0:
        h = min(h, (allowed / (order * last)) ** (1.0 / (order - 1)))
    if before > 0.0:
        h = min(h, (allowed / ((order - 1) * before)) ** (1.0 / (order - 2)))
    return order, h, allowed, n_products


@kernel
def _first_event(law, mode, slips, series, forces, zeros, side, order, h, reach, poly, found):  # type: ignore[no-untyped-def]
    """Time to the first root of any block's event function within h, and the block; (h, -1) if there is none.

    `reach[i]` receives how far block i's event function can stray within h from its tangent at the start.
    """
    _, _, damping, friction, v = law
    n = len(mode)
    for i in range(n):
        reach[i] = 0.0
    power = h * h
    for k in range(2, order - 1):
        for i in range(n):
            reach[i] += power * abs(slips[i] * (k + 1) * series[k + 1, i] + (1.0 - slips[i]) * forces[k, i])
        power *= h
    for i in range(n):  # F has two orders less: it is needed to the accuracy of w', not of w
        reach[i] += power * abs(slips[i] * order * series[order, i])
    block = -1
    for i in range(n):
        if mode[i] != 0:
            gap = mode[i] * (series[1, i] - v)
            if zeros[i] == 0 and min(gap, gap + mode[i] * 2.0 * series[2, i] * h) > reach[i]:
                continue
            degree = order - 1 - zeros[i]
            power = 1.0
            for k in range(degree + 1):
                j = k + zeros[i]
                c = (j + 1) * series[j + 1, i]
                if j == 0:
                    c -= v
                poly[k] = mode[i] * c * power
                power *= h
            if roots(poly, degree, True, found) > 0:
                h *= found[0]
                block = i
            continue
        force = damping[i] * v + forces[0, i]
        if side[i] == 0 and max(abs(force), abs(force + forces[1, i] * h)) + reach[i] < friction[i]:
            continue
        for sigma in (-1, 1):
            skip = zeros[i] if side[i] == sigma or side[i] == _UNDECIDED_BOTH else 0
            degree = order - 2 - skip
            if degree < 1:
                continue
            if skip == 0:
                poly[0] = friction[i] + sigma * force
            else:
                poly[0] = sigma * forces[skip, i]
            power = h
            for k in range(1, degree + 1):
                poly[k] = sigma * forces[k + skip, i] * power
                power *= h
            if poly[0] != 0.0 and roots(poly, degree, True, found) > 0:
                h *= found[0]
                block = i
    return h, block


@kernel
def _shift(series, order, step):  # type: ignore[no-untyped-def]
    """Move the origin of all series by a step: Horner's scheme, repeated (c_k <- sum_m C(m, k) c_m step^(m - k))."""
    n = series.shape[1]
    for k in range(order):
        for m in range(order - 1, k - 1, -1):
            for i in range(n):
                series[m, i] += step * series[m + 1, i]


@kernel
def _correct(law, block, mode, slips, series, forces, zeros, side, order, h, allowed, column, change, last):  # type: ignore[no-untyped-def]
    """Carry the series over an event of one block, in O(n order) instead of the products of a new expansion.

    From the event on, block i moves by its new law, z_i + delta; delta starts at second order. The others feel
    K_ji delta, from fourth order on. What they pass on in turn is left out, and bounded: its effect on w grows
    like h^5, and cuts h to where it stays below the tolerance. Returns that h; 0 if the event cannot be decided
    to the accuracy of the series (then nothing has changed, and a new expansion decides).
    """
    columns, row_sums, damping, friction, v = law
    i = block
    n = len(mode)
    mu = friction[i]
    force = damping[i] * v + forces[0, i]
    doubt = 1e3 * (allowed + ROUNDING * (abs(damping[i] * v) + mu + row_sums[i] * largest(series[0])))
    new = -1 if force > 0.0 else 1
    if mode[i] == 0:
        if abs(abs(force) - mu) > doubt or -forces[1, i] * new <= doubt:
            return 0.0
    elif abs(force) < mu - doubt:
        new = 0
    elif abs(force) <= mu + doubt:
        return 0.0

    dense, _, indptr, indices, data = columns
    if len(dense) == 0:
        column[:] = 0.0
        for k in range(indptr[i], indptr[i + 1]):
            column[indices[k]] = data[k]
    else:
        column[:] = dense[i]
    own = column[i]
    column[i] = 0.0
    was_stuck = mode[i] == 0
    series[1, i] = v
    for k in range(order - 1):
        c = 0.0
        if new != 0:
            c = -(damping[i] * (k + 1) * series[k + 1, i] + forces[k, i]) / ((k + 2) * (k + 1))
            if k == 0:
                c = 0.0 if was_stuck else c - 0.5 * mu * new
        change[k + 2] = c - series[k + 2, i]
        series[k + 2, i] = c
        if k + 2 <= order - 2:
            forces[k + 2, i] += own * change[k + 2]
    mode[i] = new
    slips[i] = 1.0 if new != 0 else 0.0
    zeros[:] = 0
    side[:] = 0
    zeros[i] = 0 if new == 0 else (2 if was_stuck else 1)

    last[:] = 0.0
    passed_on = 0.0
    power = h**4
    for k in range(2, order - 1):
        factor = -1.0 / ((k + 2) * (k + 1))
        for j in range(n):
            pull = column[j] * change[k]
            forces[k, j] += pull
            last[j] = slips[j] * factor * (damping[j] * (k + 1) * last[j] + pull)
            series[k + 2, j] += last[j]
        passed_on += largest(last) * power
        power *= h
    error = largest(row_sums) * passed_on * h / 5.0
    if error > _PASSED_ON * allowed:
        h *= (_PASSED_ON * allowed / error) ** 0.2
    tail = order * abs(series[order, i]) * h ** (order - 1)
    if tail > allowed:
        h *= (allowed / tail) ** (1.0 / (order - 1))
    return h


@kernel
def _record(t, mode, known_mode, n_recorded, event_t, event_block, event_mode):  # type: ignore[no-untyped-def]
    """Write down, by block, which modes are not those known; returns the events recorded, and whether all agree."""
    same = True
    for i in range(len(mode)):
        if mode[i] != known_mode[i]:
            event_t[n_recorded] = t
            event_block[n_recorded] = i
            event_mode[n_recorded] = mode[i]
            known_mode[i] = mode[i]
            n_recorded += 1
        same = same and mode[i] == mode[0]
    return n_recorded, same


@kernel
def _evaluate(series, order, step, z, w):  # type: ignore[no-untyped-def]
    """z and w after a step."""
    n = len(z)
    z[:] = series[order]
    for i in range(n):
        w[i] = order * series[order, i]
    for k in range(order - 1, 0, -1):
        for i in range(n):
            z[i] = z[i] * step + series[k, i]
            w[i] = w[i] * step + k * series[k, i]
    for i in range(n):
        z[i] = z[i] * step + series[0, i]


@kernel
def _on_the_edge(law, mode, z_max, w, forces, block, has_forces, near, touching):  # type: ignore[no-untyped-def]
    """Find the slipping blocks with w = v up to rounding; returns how many blocks this instant concerns.

    With the forces of this instant known, sticking blocks with |F| = mu count too.
    """
    _, row_sums, damping, friction, v = law
    count = 0
    for i in range(len(mode)):
        touching[i] = mode[i] != 0 and mode[i] * (w[i] - v) <= near[i]
        concerned = touching[i] or i == block
        if mode[i] == 0 and has_forces:
            drag = damping[i] * v
            slack = ROUNDING * (abs(drag) + row_sums[i] * z_max + friction[i])
            concerned = concerned or abs(drag + forces[0, i]) >= friction[i] - slack
        count += concerned
    if block >= 0:
        touching[block] = mode[block] != 0
    return count


@kernel
def _advance(  # type: ignore[no-untyped-def]
    law, z, w, mode, known_mode, initial_mode, touching, clock, counters, t_end, tol, rate, bound,
    event_t, event_block, event_mode, series, forces,
):  # fmt: skip
    """Steps until the end, or until Python has something to do; goes on where it stopped when called again.

    A window is the reach of one expansion. An event inside it is carried over by `_correct` where that can be done,
    else it ends the window.
    """
    v = law[4]
    n = len(z)
    zeros, side = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    reach, near, slips, column, last = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    moving = np.zeros(n, dtype=np.int64)
    poly, change, found = np.zeros(ORDER_MAX + 1), np.zeros(ORDER_MAX + 1), np.zeros(1)
    n_recorded = 0
    is_open, is_cut = False, False
    order, h, allowed = 0, 0.0, 0.0
    for _ in range(drive.STEPS_A_SLICE):
        if n_recorded + n > len(event_t):
            return drive.BUFFER_FULL, n_recorded
        t = clock[drive.TIME]
        remaining = t_end - t
        if not is_open:
            target = min(remaining, _REACH * clock[_EXPOSURE] / clock[_CUTS])
            target = min(target, _SPAN / rate) if rate > 0.0 else target
            order, h, allowed, n_products = _expand(
                law, z, w, mode, slips, touching, series, forces, zeros, side, target, remaining, tol, rate, moving
            )  # fmt: skip
            counters[drive.N_PRODUCTS] += n_products
            is_open, is_cut = True, False
        if counters[drive.N_STEPS] == 0:
            initial_mode[:] = mode
            known_mode[:] = mode
        before = n_recorded
        n_recorded, same = _record(t, mode, known_mode, n_recorded, event_t, event_block, event_mode)
        counters[drive.N_EVENTS] += n_recorded - before
        if remaining <= 0.0:
            return drive.DONE, n_recorded
        if same and mode[0] != 0 and t >= clock[drive.CHECK]:
            return drive.ALL_SLIP, n_recorded

        step, block = _first_event(law, mode, slips, series, forces, zeros, side, order, h, reach, poly, found)
        counters[drive.N_STEPS] += 1
        if block >= 0:
            counters[drive.LAST_BLOCK] = block
        for i in range(n):  # what rounding does to w - v in this step
            near[i] = ROUNDING * (abs(series[1, i] - v) + abs(2.0 * series[2, i] * h) + reach[i])
        left = h - step
        if block >= 0 and left > 0.0:
            _shift(series, order, step)
            _shift(forces, order - 2, step)
            z[:] = series[0]
            w[:] = series[1]
            h = 0.0
            if _on_the_edge(law, mode, largest(z), w, forces, block, True, near, touching) == 1:
                h = _correct(
                    law, block, mode, slips, series, forces, zeros, side, order, left, allowed, column, change,
                    last,
                )  # fmt: skip
                touching[block] = mode[block] != 0  # should a new expansion come first, it decides the same
            is_cut = is_cut or h < left
            is_open = h > _WORTH * clock[_EXPOSURE] / clock[_CUTS]
        else:
            _evaluate(series, order, step, z, w)
            _on_the_edge(law, mode, 0.0, w, forces, block, False, near, touching)
            is_open = False
            is_cut = is_cut or block >= 0
        clock[drive.TIME] = t_end if step == remaining else t + step
        clock[_EXPOSURE] += step
        if not is_open:
            clock[_EXPOSURE] *= _DECAY
            clock[_CUTS] = _DECAY * (clock[_CUTS] + (1.0 if is_cut else 0.0))
        if clock[drive.TIME] - t <= ROUNDING * max(1.0, abs(t)):
            counters[drive.N_STALLED] += 1
            if counters[drive.N_STALLED] > _STALL:
                return drive.STALLED, n_recorded
        else:
            counters[drive.N_STALLED] = 0
        if not max(largest(z), largest(w)) <= bound:
            return drive.DIVERGED, n_recorded
    return drive.PAUSED, n_recorded


def integrate(
    system: System,
    z0: Floats,
    w0: Floats,
    t_start: float,
    t_end: float,
    *,
    tol: float = 1e-10,
    stop_early: bool = True,
) -> Run:
    """Run the exact engine under the contract of `sim.run`.

    Parameters
    ----------
    system : System
    z0, w0 : ndarray, shape (n,)
    t_start, t_end : float
    tol : float
        Truncation error of w in a step, relative to max(1, |z|, |w|). The error at the end is that of all steps,
        as the system amplifies it; cost grows with log(1 / tol) only.
    stop_early : bool
        End a run once its collapse is certain.

    Raises
    ------
    ValueError
        If `tol` is not in (1e-16, 1e-2).
    IntegrationError
        If events accumulate at one instant.
    """
    tol = number("tol", tol, 1e-16, 1e-2)
    stop_early = flag("stop_early", stop_early)
    n = system.n
    v = system.belt_speed
    law = (system.columns, system.row_sums, system.damping, system.friction, v)
    z, w = z0.copy(), w0.copy()
    mode = np.sign(w - v).astype(np.int8)
    touching = mode == 0
    known_mode, initial_mode = mode.copy(), mode.copy()
    rate = float((np.abs(system.damping) + np.sqrt(system.row_sums)).max())  # bounds |eigenvalues|
    clock = np.zeros(drive.N_CLOCKS + 2)
    clock[drive.TIME], clock[drive.CHECK] = t_start, t_start if stop_early else np.inf
    clock[_EXPOSURE], clock[_CUTS] = (1.0 / rate if rate > 0 else max(t_end - t_start, 1.0)), 1.0
    counters = np.zeros(drive.N_COUNTERS, dtype=np.int64)
    # NaN: a coefficient used before it was computed would show
    series, forces = np.full((ORDER_MAX + 1, n), np.nan), np.full((ORDER_MAX + 1, n), np.nan)

    def advance(buffers: drive.Buffers, bound: float) -> tuple[int, int]:
        return _advance(
            law, z, w, mode, known_mode, initial_mode, touching, clock, counters, t_end, tol, rate, bound,
            *buffers, series, forces,
        )  # fmt: skip

    return drive.complete(
        system,
        advance,
        certify=lambda slip: fate.collapse(system, z, w, slip),
        stalled=f"more than {_STALL} instants that rounding cannot tell apart; this start is degenerate:"
        " perturb it, or use engine='sigmoid'",
        events_a_step=n,
        t_start=t_start, t_end=t_end, z=z, w=w, mode=mode, initial_mode=initial_mode,
        clock=clock, counters=counters,
    )  # fmt: skip
