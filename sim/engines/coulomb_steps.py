"""The exact engine: set-valued Coulomb friction, event by event, Taylor series between events.

Between events a sticking block moves with the belt (z linear in t: nothing to integrate) and a slipping one obeys
a linear law: `stickslip.sim.engines.taylor` expands them all. The next event is the first root of

    sigma (w - v)     of a slipping block,
    m + sigma F       of a sticking one, F = R v + K z = -mu lambda, for either sigma;

m is the static friction, mu if there is no other.

A bound by the sum of |coefficients| dismisses most blocks; the rest go to `sim.engines.roots`, which misses no
root. At an event every block with w = v is decided anew from |F| against m; when they are equal (every exit
starts there) the first coefficient of F that does not vanish decides, order by order, while the series is
being built: until a block is decided its motion is the same under either mode, so simultaneous events, folds,
cusps and tangencies of any order need no case of their own.

An event changes the law of one block. That block's own series changes from the second order on, those of the
others from the fourth, by a column of K: `sim.engines.taylor.correct` carries most events over in O(n), without a
product, and one expansion serves a window of several events.

The series are explicit: R h is about 5 at most. Blocks of far larger R are followed on their slow motion, once they
are there: `stickslip.sim.engines.overdamped`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.arguments import Floats
from stickslip.sim.engines import loop
from stickslip.sim.engines.arithmetic import ROUNDING, copy, largest
from stickslip.sim.engines.certificates import Collapse
from stickslip.sim.engines.compile import inner, kernel
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.loop import Events, Law, State
from stickslip.sim.engines.outside import Drive
from stickslip.sim.engines.overdamped import Slow, follow
from stickslip.sim.engines.products import Pairs
from stickslip.sim.engines.roots import roots
from stickslip.sim.engines.sticking import UNDECIDED_BOTH, force_rounding, known, push
from stickslip.sim.engines.taylor import (
    ORDER_MAX,
    SPAN,
    Expansion,
    correct,
    expand,
    shift,
)
from stickslip.sim.engines.watch import too_far
from stickslip.sim.run import Run
from stickslip.sim.system import require_diagonal_damping

#: A window aims at this many mean lengths: what lies beyond is cut off before it pays.
REACH = 1.2
#: What is left of a window is used if it is more than this share of the mean length.
_WORTH = 0.1
#: Memory of that mean.
DECAY = 0.9

#: This many instants in a row, each closer to the last than rounding can tell, are an accumulation of events.
STALL = 1000
#: So are as many steps in a row without an event, each below this share of the shortest time scale.
CRAWL = 1e-6

#: A touch w - v = a s^2 / 2, off by the tolerance, reads as two events 2 (2 tol |v| / a)^(1/2) apart, a being about
#: |v| rate^2, or as none: this many tol^(1/2) / rate are taken for a touch.
_TOUCH = 4.0
#: So many steps are announced.
_MANY = 1e8
#: The loosest tolerance that is worked with. A looser one leaves events undecided: they end windows, and cost more.
_LOOSEST = 1e-3
#: The motion after a collapse is that of the modes if a bound of their rounding, some hundred times what it comes to,
#: is below the tolerance, or below this.
_FOLLOWED = 1e-10
#: So many tolerances, of its terms, F may be off at an event where a run was cut.
_AT_EVENTS = 100.0

# behind the common clocks: decaying sums for the mean length of a window, time and number of windows cut short
EXPOSURE, CUTS = loop.N_CLOCKS, loop.N_CLOCKS + 1


class _Goal(NamedTuple):
    """How far to go, whether the run ends there, how closely, and the fastest rate there is."""

    t_end: float  #: from the start of the piece
    is_last: bool
    tol: float
    rate: float


class _Search(NamedTuple):
    """What the search for events keeps of n blocks, and room to work in."""

    known_mode: NDArray[np.int8]  #: as recorded so far
    initial_mode: NDArray[np.int8]
    reach: Floats  #: how far a block's event function can stray in a step from its tangent at the start
    near: Floats  #: what rounding does to w - v in a step
    poly: Floats
    found: Floats

    @classmethod
    def of(cls, mode: NDArray[np.int8]) -> _Search:
        n = len(mode)
        reach, near = np.zeros((2, n))
        return cls(mode.copy(), mode.copy(), reach, near, np.zeros(ORDER_MAX + 1), np.zeros(1))


@inner
def stray(series, forces, slips, order, h, reach, n):  # type: ignore[no-untyped-def]
    """How far the event functions of n blocks can stray in h from their tangents, by the sizes of their terms."""
    for i in range(n):
        reach[i] = 0.0
    power = h * h
    for k in range(2, order - 1):
        for i in range(n):
            reach[i] += power * abs(slips[i] * (k + 1) * series[k + 1, i] + (1.0 - slips[i]) * forces[k, i])
        power *= h
    for i in range(n):  # F has two orders less: it is needed to the accuracy of w', not of w
        reach[i] += power * abs(slips[i] * order * series[order, i])


@inner
def is_quiet(mode, zeros, side, w, half_slope, pull, pull_slope, h, v, drag, static, closed, reach):  # type: ignore[no-untyped-def]
    """Whether a block's event functions, which stray by at most `reach` from their tangents, have no root within h.

    `pull` is (K z)_i. It takes numbers, not the law: what is not inlined is passed field by field, for each block.
    """
    if mode != 0:
        gap = mode * (w - v)
        return zeros == 0 and min(gap, gap + mode * 2.0 * half_slope * h) > reach
    force = drag + pull
    return side == 0 and max(push(closed, force), push(closed, force + pull_slope * h)) + reach < static


@inner
def root(law, i, series, forces, at, mode, zeros, side, order, h, poly, found):  # type: ignore[no-untyped-def]
    """Time to the first root of block i's event functions within h, and whether there is one; see `is_quiet` first.

    Its series are the columns `at`.
    """
    v, static, closed, is_found = law.belt_speed[i], law.static[i], law.closed[i], False
    if mode != 0:
        degree = order - 1 - zeros
        power = 1.0
        for k in range(degree + 1):
            j = k + zeros
            c = (j + 1) * series[j + 1, at]
            if j == 0:
                c -= v
            poly[k] = mode * c * power
            power *= h
        if roots(poly, degree, found) > 0:
            h *= found[0]
            is_found = True
        return h, is_found
    force = law.damping[i] * v + forces[0, at]
    first = h
    for sigma in (-1, 1):  # both within h, so that a mirror image has the same bytes
        if sigma == closed:
            continue
        skip = zeros if side in (sigma, UNDECIDED_BOTH) else 0
        degree = order - 2 - skip
        if degree < 1:
            continue
        if skip == 0:
            poly[0] = static + sigma * force
        else:
            poly[0] = sigma * forces[skip, at]
        power = h
        for k in range(1, degree + 1):
            poly[k] = sigma * forces[k + skip, at] * power
            power *= h
        if poly[0] != 0.0 and roots(poly, degree, found) > 0:
            first = min(first, h * found[0])
            is_found = True
    return first, is_found


@inner
def _first_event(law, expansion, search, order, h):  # type: ignore[no-untyped-def]
    """Time to the first root of any block's event function within h, and the block; (h, -1) if there is none."""
    series, forces, mode, poly, found = expansion.series, expansion.forces, expansion.mode, search.poly, search.found
    zeros, side, reach = expansion.zeros, expansion.side, search.reach
    damping, static, closed, v = law.damping, law.static, law.closed, law.belt_speed
    stray(series, forces, expansion.slips, order, h, reach, len(mode))
    block = -1
    for i in range(len(mode)):
        if is_quiet(
            mode[i], zeros[i], side[i], series[1, i], series[2, i], forces[0, i], forces[1, i], h, v[i],
            damping[i] * v[i], static[i], closed[i], reach[i],
        ):  # fmt: skip
            continue
        h, is_found = root(law, i, series, forces, i, mode[i], zeros[i], side[i], order, h, poly, found)
        block = i if is_found else block
    return h, block


@inner
def record(t, mode, known_mode, events, n_recorded):  # type: ignore[no-untyped-def]
    """Write down, by block, which modes are not those known; returns the events recorded, and whether all agree."""
    same = True
    for i in range(len(mode)):
        if mode[i] != known_mode[i]:
            events.t[n_recorded] = t
            events.block[n_recorded] = i
            events.mode[n_recorded] = mode[i]
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
def _sample(series, order, t, t_next, state):  # type: ignore[no-untyped-def]
    """Keep the state at all sample times up to t_next, from the series about t."""
    samples = state.samples
    k = state.counters[loop.N_SAMPLED]
    while k < len(samples.t) and samples.t[k] <= t_next:
        _evaluate(series, order, samples.t[k] - t, samples.z[k], samples.w[k])
        k += 1
    state.counters[loop.N_SAMPLED] = k


@inner
def _on_the_edge(law, expansion, near, z_max, w, block, has_forces):  # type: ignore[no-untyped-def]
    """Find the slipping blocks with w = v up to rounding; returns how many blocks this instant concerns.

    With the forces of this instant known, sticking blocks with |F| = mu count too.
    """
    v, mode, touching = law.belt_speed, expansion.mode, expansion.touching
    count = 0
    for i in range(len(mode)):
        touching[i] = mode[i] != 0 and mode[i] * (w[i] - v[i]) <= near[i]
        concerned = touching[i] or i == block
        if mode[i] == 0 and has_forces:
            force = law.damping[i] * v[i] + expansion.forces[0, i]
            noise = known(law.outside, 0, i)
            slack = force_rounding(law.damping[i] * v[i], law.row_sums[i] * z_max, law.static[i], noise)
            concerned = concerned or push(law.closed[i], force) >= law.static[i] - slack
        count += concerned
    if block >= 0:
        touching[block] = mode[block] != 0
    return count


@inner
def stalls(counters, moved, least):  # type: ignore[no-untyped-def]
    """Whether too many steps in a row were too short."""
    counters[loop.N_STALLED] = counters[loop.N_STALLED] + 1 if moved <= least else 0
    return counters[loop.N_STALLED] > STALL


@kernel
def _advance(law, goal, state, expansion, search, slow, events, bound, watch):  # type: ignore[no-untyped-def]
    """Steps until the end, or until Python has something to do; goes on where it stopped when called again.

    A window is the reach of one expansion. An event inside it is carried over by `correct` where that can be done,
    else it ends the window.
    """
    t_end, rate, v = goal.t_end, goal.rate, law.belt_speed
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
            order, h, allowed, n_products = follow(slow, law, expansion, z, w, t, target, goal.tol)
            counters[loop.N_PRODUCTS] += n_products
            is_slow = order > 0
            if not is_slow:
                target = min(target, SPAN / rate) if rate > 0.0 else target
                order, h, allowed, n_products = expand(law, expansion, z, w, t, target, remaining, goal.tol, rate)
                counters[loop.N_PRODUCTS] += n_products
            span = h
            is_open, is_cut = True, law.fall is not None and h < target
        if counters[loop.N_STEPS] == 0:
            copy(mode, search.initial_mode)
            copy(mode, search.known_mode)
        before = n_recorded
        n_recorded, same = record(t, mode, search.known_mode, events, n_recorded)
        loop.note_still(same and mode[0] == 0, t, z, events, counters)
        if remaining <= 0.0:
            _sample(series, order, t, t, state)  # of a run that has no length
            return loop.DONE, n_recorded
        if same and mode[0] != 0 and t > clock[loop.CHECK + (mode[0] > 0)]:
            later = too_far(watch, z, w, mode[0])
            if later == 0.0:
                return loop.ALL_SLIP, n_recorded
            clock[loop.CHECK + (mode[0] > 0)] = t + later
            if n_recorded > 0:
                return loop.PAUSED, n_recorded
            n_left, is_open = loop.STEPS_A_SLICE, False  # as a slice begins: it is the same who answered
            continue

        step, block = _first_event(law, expansion, search, order, h)
        if not goal.is_last and remaining - step <= ROUNDING * t_end:
            step = remaining  # what rounding cannot tell from the end, the next piece decides
        counters[loop.N_STEPS] += 1
        if block >= 0:
            counters[loop.LAST_BLOCK] = block
        for i in range(n):
            near[i] = ROUNDING * (abs(series[1, i] - v[i]) + abs(2.0 * series[2, i] * h) + search.reach[i])
        t_next = t_end if step == remaining else min(t + step, t_end)
        _sample(series, order, t, t_next, state)
        left = h - step
        is_inside = block >= 0 and left > 0.0 and law.fall is None and not is_slow  # else it ends the window
        if is_inside:
            shift(series, order, step)
            shift(expansion.forces, order - 2, step)
            copy(series[0], z)
            copy(series[1], w)
            h = 0.0
            if _on_the_edge(law, expansion, near, largest(z), w, block, is_inside) == 1:
                h = correct(law, expansion, block, order, span, left, allowed, rate)
                touching[block] = mode[block] != 0  # should a new expansion come first, it decides the same
            is_cut = is_cut or h < left
            is_open = h > _WORTH * clock[EXPOSURE] / clock[CUTS]
        else:
            _evaluate(series, order, step, z, w)
            _on_the_edge(law, expansion, near, 0.0, w, block, is_inside)
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
        if not (largest(z) <= bound and largest(w) <= bound):  # in a maximum one that is not a number may be lost
            return loop.DIVERGED, n_recorded
    return loop.PAUSED, n_recorded


def runs(tasks: Sequence[Task], tol: float) -> list[Callable[[], Run]]:
    """The runs of a task, or of several with plain systems of as many blocks: see `Engine.prepare`.

    Raises
    ------
    ValueError
        Of a run: if the system has cross damping, or a block starts ahead of its belt where that is barred.
    IntegrationError
        Of a run: if events accumulate at one instant.
    """
    tol, systems = min(tol, _LOOSEST), [task.system for task in tasks]
    # from here on by task and block
    rates, static, near = (
        np.array(rows)
        for rows in zip(*((one.rates, one.static, one.slip_friction[0]) for one in systems), strict=True)
    )
    # with static friction above the kinetic a touch sticks, for as long as F takes from the one to the other
    is_touch = (rates > 0) & (static == near)
    shortest = np.divide(_TOUCH * math.sqrt(tol), rates, out=np.zeros_like(rates), where=is_touch)
    of_runs = zip(tasks, Pairs.of(systems), rates.max(axis=1).tolist(), shortest, strict=True)
    return [partial(_integrate, tol, *of_run) for of_run in of_runs]


def _integrate(tol: float, task: Task, pairs: Pairs, rate: float, shortest: Floats) -> Run:
    """Run a task. `rate` bounds |eigenvalues|; how far the series of a force is of use, `expand` sees for itself."""
    system = task.system
    require_diagonal_damping(system, "engine='coulomb'")
    drive = Drive(system, task.t_start, task.t_end, ORDER_MAX + 1)
    law, v = Law.of(system, pairs, drive), drive.belt_speed
    near, far = system.slip_friction
    if law.fall is not None:
        rate += law.fall.steepness * float((near - far).max())
    mode = np.sign(task.w0 - v).astype(np.int8)
    if not system.back_slip:
        _refuse_closed(system.closed * (task.w0 - v), tol * system.fastest_belt)
        mode[mode * system.closed > 0] = 0
    exposure = 1.0 / rate if rate > 0 else max(task.t_end - task.t_start, 1.0)
    state = State.at_start(task, task.z0.copy(), task.w0.copy(), mode, exposure, 1.0)
    expansion, search = Expansion.blank(mode, law.fall is not None), _Search.of(mode)
    if task.modes is not None:
        expansion.leaves[:] = np.where(mode == 0, task.modes, 0)
    collapse = Collapse(system, max(tol * system.fastest_belt, _FOLLOWED))
    slow = Slow.of(system, drive.fastest) if law.fall is None else None
    _warn_of_short_steps(task, rate if slow is None else slow.rate)
    is_local = len(law.columns.dense) == 0 and law.outside is None and law.fall is None and slow is None

    def advance(events: Events, bound: float) -> tuple[int, int]:
        goal = _Goal(drive.length, drive.is_last, tol, rate)
        if is_local:
            found = nearby.advance(law, goal, state, expansion, search, room, events, bound, collapse.watch, pull)
        else:
            found = _advance(law, goal, state, expansion, search, slow, events, bound, collapse.watch)
        if task.modes is not None:
            _require_modes(task, task.modes, search.initial_mode, tol)
        return found

    if is_local:
        from stickslip.sim.engines import nearby  # it builds on this module

        room, pull = nearby.Nearby.of(system.n), float(system.row_sums.max())
    return loop.complete(
        task,
        state,
        drive,
        advance,
        collapse,
        stalled=f"more than {STALL} instants that rounding cannot tell apart; this start is degenerate:"
        " perturb it, or use engine='sigmoid'",
        events_a_step=system.n,
        initial_modes=search.initial_mode[np.newaxis],
        shortest=shortest,
        touch=_TOUCH * math.sqrt(tol),
    )


def _warn_of_short_steps(task: Task, rate: float) -> None:
    """RuntimeWarning if blocks that move at this rate throughout make a run as long as few would wait for."""
    n_steps = rate * (task.t_end - task.t_start) / SPAN
    if n_steps > _MANY:
        fastest = f"damping up to {task.system.damping.max():g}, stiffness up to {task.system.row_sums.max():g} a row"
        warnings.warn(
            f"system: {fastest} allow steps of {SPAN / rate:.0e} while blocks slip, {n_steps:.0e} of them to"
            f" t = {task.t_end:g}: a minute or more for each 1e8; engine='sigmoid' takes long ones under damping",
            RuntimeWarning,
            stacklevel=2,
        )


def _require_modes(task: Task, asked: NDArray[np.int8], found: NDArray[np.int8], tol: float) -> None:
    """ValueError if a block cannot start in the mode that was asked for, by more than the tolerance."""
    if (asked == found).all():
        return
    s, z, t = task.system, task.z0, task.t_start
    v, force = s.belt_speed_at(t), s.holding_force(z, task.w0, t)
    # a run that was cut at an event has |F| at static friction to its own tolerance
    size = np.abs(s.damping * v) + s.row_sums * np.abs(z).max() + np.abs(s.force_at(t)) + s.static
    allowed = _AT_EVENTS * tol * size
    is_at_edge = (np.abs(task.w0 - v) <= tol * s.fastest_belt) & (np.abs(np.abs(force) - s.static) <= allowed)
    # but friction does not push, and no block slips to a side that is barred
    is_at_edge &= (asked * s.closed <= 0) & ((asked * force <= 0.0) | (s.static <= allowed))
    if ((asked != found) & ~is_at_edge).any():
        block = int(np.argmax((asked != found) & ~is_at_edge))
        raise ValueError(
            f"modes: expected what the state allows, got {asked[block]} for block {block}, which begins with"
            f" {found[block]}: off the belt's speed a block slips to its side, on it one sticks if |F| is at most"
            " its static friction, and slips, against F, if it is above its kinetic"
        )


def _refuse_closed(beyond: Floats, allowed: float) -> None:
    """ValueError if a block starts ahead of its belt by more than is allowed: no force can have brought it there."""
    if (beyond > allowed).any():
        block = int(np.argmax(beyond))
        raise ValueError(
            f"w0: expected no block ahead of its belt with back_slip=False, got block {block} ahead by"
            f" {beyond[block]:g}; start it at the belt's speed"
        )
