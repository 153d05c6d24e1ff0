"""The exact engine: set-valued Coulomb friction, event by event, Taylor series between events.

Between events a sticking block moves with the belt (z linear in t: nothing to integrate) and a slipping one obeys
a linear law: `stickslip.sim.engines.taylor` expands them all. The next event is the first root of

    sigma (w - v)     of a slipping block,
    mu + sigma F      of a sticking one, F = R v + K z = -mu lambda, for either sigma.

A bound by the sum of |coefficients| dismisses most blocks; the rest go to `sim.engines.roots`, which misses no
root. At an event every block with w = v is decided anew from |F| against mu; when they are equal (every exit
starts there) the first coefficient of F that does not vanish decides, order by order, while the series is
being built: until a block is decided its motion is the same under either mode, so simultaneous events, folds,
cusps and tangencies of any order need no case of their own.

An event changes the law of one block. That block's own series changes from the second order on, those of the
others from the fourth, by a column of K: `sim.engines.taylor.correct` carries most events over in O(n), without a
product, and one expansion serves a window of several events.

The series are explicit: a damping far above the other rates (R h about 5 limits the step) calls for engine="sigmoid".
"""

from __future__ import annotations

import math

import numpy as np

from stickslip.sim.engines import certificates, loop
from stickslip.sim.engines.arithmetic import ROUNDING, copy, largest
from stickslip.sim.engines.compile import inner, kernel
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.roots import roots
from stickslip.sim.engines.taylor import ORDER_MAX, SPAN, UNDECIDED_BOTH, correct, expand, force_rounding, shift
from stickslip.sim.run import Run
from stickslip.sim.system import require_diagonal_damping

#: A window aims at this many mean lengths: what lies beyond is cut off before it pays.
_REACH = 1.2
#: What is left of a window is used if it is more than this share of the mean length.
_WORTH = 0.1
#: Memory of that mean.
_DECAY = 0.9

#: This many instants in a row, each closer to the last than rounding can tell, are an accumulation of events.
_STALL = 1000
#: So are as many steps in a row without an event, each below this share of the shortest time scale.
_CRAWL = 1e-6

#: A touch w - v = a s^2 / 2, off by the tolerance, reads as two events 2 (2 tol |v| / a)^(1/2) apart, a being about
#: |v| rate^2, or as none: this many tol^(1/2) / rate are taken for a touch.
_TOUCH = 4.0
#: The motion after a collapse is that of the modes if a bound of their rounding, some hundred times what it comes to,
#: is below the tolerance, or below this.
_FOLLOWED = 1e-10

# behind the common clocks: decaying sums for the mean length of a window, time and number of windows cut short
_EXPOSURE, _CUTS = loop.N_CLOCKS, loop.N_CLOCKS + 1


@inner
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
            if roots(poly, degree, found) > 0:
                h *= found[0]
                block = i
            continue
        force = damping[i] * v + forces[0, i]
        if side[i] == 0 and max(abs(force), abs(force + forces[1, i] * h)) + reach[i] < friction[i]:
            continue
        for sigma in (-1, 1):
            skip = zeros[i] if side[i] == sigma or side[i] == UNDECIDED_BOTH else 0
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
            if poly[0] != 0.0 and roots(poly, degree, found) > 0:
                h *= found[0]
                block = i
    return h, block


@inner
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


@inner
def _evaluate(series, order, step, z, w):  # type: ignore[no-untyped-def]
    """z and w after a step."""
    n = len(z)
    copy(series[order], z)
    for i in range(n):
        w[i] = order * series[order, i]
    for k in range(order - 1, 0, -1):
        for i in range(n):
            z[i] = z[i] * step + series[k, i]
            w[i] = w[i] * step + k * series[k, i]
    for i in range(n):
        z[i] = z[i] * step + series[0, i]


@inner
def _sample(series, order, t, t_next, counters, sample_t, sample_z, sample_w):  # type: ignore[no-untyped-def]
    """Keep the state at all sample times up to t_next, from the series about t."""
    k = counters[loop.N_SAMPLED]
    while k < len(sample_t) and sample_t[k] <= t_next:
        _evaluate(series, order, sample_t[k] - t, sample_z[k], sample_w[k])
        k += 1
    counters[loop.N_SAMPLED] = k


@inner
def _on_the_edge(law, mode, z_max, w, forces, block, has_forces, near, touching):  # type: ignore[no-untyped-def]
    """Find the slipping blocks with w = v up to rounding; returns how many blocks this instant concerns.

    With the forces of this instant known, sticking blocks with |F| = mu count too.
    """
    _, _, damping, friction, v = law
    count = 0
    for i in range(len(mode)):
        touching[i] = mode[i] != 0 and mode[i] * (w[i] - v) <= near[i]
        concerned = touching[i] or i == block
        if mode[i] == 0 and has_forces:
            force = damping[i] * v + forces[0, i]
            concerned = concerned or abs(force) >= friction[i] - force_rounding(law, i, z_max)
        count += concerned
    if block >= 0:
        touching[block] = mode[block] != 0
    return count


@kernel
def _advance(  # type: ignore[no-untyped-def]
    law, z, w, mode, known_mode, initial_mode, touching, clock, counters, t_end, tol, rate, bound,
    sample_t, sample_z, sample_w, event_t, event_block, event_mode, series, forces,
):  # fmt: skip
    """Steps until the end, or until Python has something to do; goes on where it stopped when called again.

    A window is the reach of one expansion. An event inside it is carried over by `correct` where that can be done,
    else it ends the window.
    """
    v = law[4]
    n = len(z)
    zeros, side = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    reach, near, slips, column, last = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    moving = np.zeros(n, dtype=np.int64)
    poly, change, found = np.zeros(ORDER_MAX + 1), np.zeros(ORDER_MAX + 1), np.zeros(1)
    n_recorded = np.int64(0)  # a literal would have what it is passed to compiled twice
    is_open, is_cut = False, False
    order, h, span, allowed = 0, 0.0, 0.0, 0.0
    for _ in range(loop.STEPS_A_SLICE):
        if n_recorded + n > len(event_t):
            return loop.BUFFER_FULL, n_recorded
        t = clock[loop.TIME]
        remaining = t_end - t
        if not is_open:
            target = min(remaining, _REACH * clock[_EXPOSURE] / clock[_CUTS])
            target = min(target, SPAN / rate) if rate > 0.0 else target
            order, h, allowed, n_products = expand(
                law, z, w, mode, slips, touching, series, forces, zeros, side, target, remaining, tol, rate, moving
            )  # fmt: skip
            counters[loop.N_PRODUCTS] += n_products
            span = h
            is_open, is_cut = True, False
        if counters[loop.N_STEPS] == 0:
            copy(mode, initial_mode)
            copy(mode, known_mode)
        before = n_recorded
        n_recorded, same = _record(t, mode, known_mode, n_recorded, event_t, event_block, event_mode)
        if remaining <= 0.0:
            _sample(series, order, t, t, counters, sample_t, sample_z, sample_w)  # of a run that has no length
            return loop.DONE, n_recorded
        if same and mode[0] != 0 and t > clock[loop.CHECK + (mode[0] > 0)]:
            return loop.ALL_SLIP, n_recorded

        step, block = _first_event(law, mode, slips, series, forces, zeros, side, order, h, reach, poly, found)
        counters[loop.N_STEPS] += 1
        if block >= 0:
            counters[loop.LAST_BLOCK] = block
        for i in range(n):  # what rounding does to w - v in this step
            near[i] = ROUNDING * (abs(series[1, i] - v) + abs(2.0 * series[2, i] * h) + reach[i])
        t_next = t_end if step == remaining else min(t + step, t_end)
        _sample(series, order, t, t_next, counters, sample_t, sample_z, sample_w)
        left = h - step
        is_inside = block >= 0 and left > 0.0
        if is_inside:
            shift(series, order, step)
            shift(forces, order - 2, step)
            copy(series[0], z)
            copy(series[1], w)
            h = 0.0
            if _on_the_edge(law, mode, largest(z), w, forces, block, is_inside, near, touching) == 1:
                h = correct(
                    law, block, mode, slips, series, forces, zeros, side, order, span, left, allowed, column, change,
                    last,
                )  # fmt: skip
                touching[block] = mode[block] != 0  # should a new expansion come first, it decides the same
            is_cut = is_cut or h < left
            is_open = h > _WORTH * clock[_EXPOSURE] / clock[_CUTS]
        else:
            _evaluate(series, order, step, z, w)
            _on_the_edge(law, mode, 0.0, w, forces, block, is_inside, near, touching)
            is_open = False
            is_cut = is_cut or block >= 0
        clock[loop.TIME] = t_next
        clock[_EXPOSURE] += step
        if not is_open:
            clock[_EXPOSURE] *= _DECAY
            clock[_CUTS] = _DECAY * (clock[_CUTS] + (1.0 if is_cut else 0.0))
        # rounding can also make touches of a block that feels one far larger than itself: an end, but no event
        unseen = _CRAWL / rate if rate > 0.0 and n_recorded == before else 0.0
        crawls = clock[loop.TIME] - t <= max(ROUNDING * max(1.0, abs(t)), unseen)
        if crawls:
            counters[loop.N_STALLED] += 1
            if counters[loop.N_STALLED] > _STALL:
                return loop.STALLED, n_recorded
        else:
            counters[loop.N_STALLED] = 0
        if not max(largest(z), largest(w)) <= bound:
            return loop.DIVERGED, n_recorded
    return loop.PAUSED, n_recorded


def integrate(task: Task, tol: float) -> Run:
    """Run a task to the tolerance `tol`; IntegrationError if events accumulate at one instant."""
    system, t_start, t_end, samples = task.system, task.t_start, task.t_end, task.samples
    require_diagonal_damping(system, "engine='coulomb'")
    n = system.n
    v = system.belt_speed
    law = (system.columns, system.row_sums, system.damping, system.friction, v)
    z, w = task.z0.copy(), task.w0.copy()
    mode = np.sign(w - v).astype(np.int8)
    touching = mode == 0
    known_mode, initial_mode = mode.copy(), mode.copy()
    rate = float(system.rates.max())  # bounds |eigenvalues|
    shortest = np.divide(_TOUCH * math.sqrt(tol), system.rates, out=np.zeros(n), where=system.rates > 0)
    clock = np.zeros(loop.N_CLOCKS + 2)
    clock[loop.TIME] = t_start
    clock[loop.CHECK : loop.CHECK + 2] = -np.inf if task.stop_early else np.inf
    clock[_EXPOSURE], clock[_CUTS] = (1.0 / rate if rate > 0 else max(t_end - t_start, 1.0)), 1.0
    counters = np.zeros(loop.N_COUNTERS, dtype=np.int64)
    collapse = certificates.Collapse(system, max(tol * abs(v), _FOLLOWED))
    # NaN: a coefficient used before it was computed would show
    series, forces = np.full((ORDER_MAX + 1, n), np.nan), np.full((ORDER_MAX + 1, n), np.nan)

    def advance(buffers: loop.Buffers, bound: float) -> tuple[int, int]:
        return _advance(
            law, z, w, mode, known_mode, initial_mode, touching, clock, counters, t_end, tol, rate, bound,
            samples.t, samples.z, samples.w, *buffers, series, forces,
        )  # fmt: skip

    return loop.complete(
        system,
        advance,
        certify=lambda slip: collapse.certify(z, w, slip),
        stalled=f"more than {_STALL} instants that rounding cannot tell apart; this start is degenerate:"
        " perturb it, or use engine='sigmoid'",
        events_a_step=n,
        t_start=t_start, t_end=t_end, z=z, w=w, mode=mode, initial_mode=initial_mode[np.newaxis],
        clock=clock, counters=counters, samples=samples, stop_early=task.stop_early, shortest=shortest,
    )  # fmt: skip
