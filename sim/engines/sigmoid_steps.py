"""The stiff engine: the sign smoothed to mu tanh((w - v) / delta_i), delta_i = ratio_i eps.

    z' = w,    w' = -R w - N w - K z - mu tanh((w - v) / delta)        (N: off the diagonal of the damping, if given)

All stiffness (up to mu / delta) sits in one scalar function a block, and what couples the blocks is small beside
1 / h^2. So an L-stable, stiffly accurate ESDIRK method needs no linear algebra: with each block's own spring K_ii
implicit, and the rest of K z taken at a predicted stage value (off by (h gamma) K times the predictor's error, O(h^5)
in w), each stage is one monotone scalar equation a block,

    a x + b tanh x = beta,   x = (w - v) / delta,   a = delta (1 + h gamma R + (h gamma)^2 K_ii),   b = h gamma mu,

which Newton's method solves from any start: no Newton failure, however small delta. One product with K a stage.

A full damping matrix C = diag(R) + N couples the velocities of a stage. Its scalar equations are solved with N w of
a predicted w, and again with N times their own w until it stays. A sweep takes one product with N; since the root x
depends on beta with slope below 1 / a, it multiplies the error of w, in the Euclidean norm, by at most
h gamma |N| / (1 + h gamma min R) for every delta, and the step is kept so short that this is 1/2.

The method is in `stickslip.sim.engines.esdirk`, the search for entries and exits in `stickslip.sim.engines.layer`.
When a block sticks: see `stickslip.sim.engines.sigmoid.Sigmoid`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.arguments import Floats
from stickslip.sim.engines import loop
from stickslip.sim.engines.arithmetic import ROUNDING, copy, largest, tanh_positive
from stickslip.sim.engines.certificates import Collapse
from stickslip.sim.engines.compile import inner, kernel
from stickslip.sim.engines.contract import Ratios, Task
from stickslip.sim.engines.esdirk import ERROR, GAMMA, PREDICT, STAGES, WEIGHTS
from stickslip.sim.engines.layer import PASSES, UNRESOLVED, Point, Smooth, Sticking, between, step_events
from stickslip.sim.engines.loop import Law, State
from stickslip.sim.engines.products import ROUGH, one_product, rough_product, two_products
from stickslip.sim.engines.sigmoid import Sigmoid
from stickslip.sim.run import Run
from stickslip.sim.system import System

#: Step control: the embedded error is O(h^4); a step changes by a factor in [_SHRINK, _GROW].
_EXPONENT = 1.0 / 4.0
_SAFETY, _SHRINK, _GROW = 0.9, 0.1, 4.0
#: A stage is solved when its residual is this share of the tolerance, or rounding (the last Newton step squares it).
_SOLVED = 1e-2
#: The share of the tolerance that K in float32 may cost in w.
_ROUGH_SHARE = 0.05
#: The error over tolerance put down for a step that passed through an attracting layer: it is about halved.
_MISSED = 10.0
#: A layer |w - v| < _WIDE delta is a jump to a step in which w moves by more than _SHARP delta, however it moves: a
#: block driven by |F| > mu passes in a time delta / |w'|, which no stage need fall into.
_WIDE, _SHARP = 2.0, 4.0
#: The least error put down for a step across such a layer, as a share of h times the jump J of the friction. J at the
#: fraction theta of a step leaves h J |1 - theta - sum of b_j, c_j > theta|, at most h J / 4, and the embedded
#: estimate vanishes for some theta: now and then a step would err by thousands of tolerances and be accepted.
_CROSSED = 0.02
_NEWTON_MAX = 400
#: What a sweep over N may leave of the error of a stage, and how many there may be: from any error to rounding.
_CONTRACTION = 0.5
_SWEEPS_MAX = 60

# behind the common clocks: the next step to try, and the error of the last one
_STEP, _LAST_ERROR = loop.N_CLOCKS, loop.N_CLOCKS + 1


class _Work(NamedTuple):
    """Room for a step's stages, by rows, and for what is known of each block in one."""

    stage_w: Floats
    stage_rate: Floats
    base: Floats  #: what w is without the stage's own w'
    coupling: Floats  #: K z + N w with what is predicted
    fixed: Floats  #: K z of it
    guess: Floats  #: of w, with which z was predicted
    change: Floats  #: of w since the start of the step, as guessed or last solved
    x: Floats  #: (w - v) / delta; at the end of a step its error over tolerance
    beta: Floats
    low: Floats
    moving: NDArray[np.int64]
    single: NDArray[np.float32]

    @classmethod
    def blank(cls, n: int) -> _Work:
        # NaN: a value used before it was computed would show
        stages, rows = np.full((2, STAGES, n), np.nan), np.full((8, n), np.nan)
        return cls._make([*stages, *rows, np.zeros(n, np.int64), np.zeros((2, n), np.float32)])


@inner
def _solve_stage(smooth, work, s, h, allowed):  # type: ignore[no-untyped-def]
    """Solve w = base + h gamma w'(w) in stage s for all blocks from a guess x of (w - v) / delta.

    Each block's own spring is taken at w itself, not at the guess. In |x| the function
    a |x| + b tanh |x| - |beta| is concave and rising: from the left Newton's method climbs to the root, from the
    right its first step lands left of it, and `low` bounds how far left.
    """
    damping, friction, v = smooth.law.damping, smooth.law.friction, smooth.law.belt_speed
    delta, springs = smooth.delta, smooth.springs
    base, coupling, guess, x, beta, low = work.base, work.coupling, work.guess, work.x, work.beta, work.low
    w, rate = work.stage_w[s], work.stage_rate[s]
    n = len(w)
    step = h * GAMMA
    for i in range(n):
        pull = step * step * springs[i]
        grow = 1.0 + step * damping[i] + pull
        a, b = delta[i] * grow, step * friction[i]
        beta[i] = base[i] - step * coupling[i] + pull * guess[i] - v * grow
        size = abs(beta[i])
        linear, saturated = size / (a + b), (size - b) / a
        low[i] = saturated if saturated > linear else linear
        y = math.copysign(1.0, beta[i]) * x[i]
        x[i] = y if y > low[i] else low[i]
    unsolved = n
    for _ in range(_NEWTON_MAX):
        unsolved = 0  # counted, since a maximum of floats would keep the loop from being vectorised
        for i in range(n):
            a, b = delta[i] * (1.0 + step * damping[i] + step * step * springs[i]), step * friction[i]
            y = x[i]
            tanh = tanh_positive(y)
            residual = a * y + b * tanh - abs(beta[i])
            y -= residual / (a + b * (1.0 - tanh * tanh))
            x[i] = y if y > low[i] else low[i]
            unsolved += 1 if abs(residual) > allowed + ROUNDING * abs(beta[i]) else 0
        if unsolved == 0:
            break
    for i in range(n):
        w[i] = v + delta[i] * math.copysign(x[i], beta[i])
        rate[i] = (w[i] - base[i]) / step
    return unsolved == 0


@inner
def _touches(y0, d0, y1, d1, wide):  # type: ignore[no-untyped-def]
    """Whether a cubic that begins and ends on one side of a layer comes into it between."""
    side = math.copysign(1.0, y0)
    if min(side * (y0 + d0 / 3.0), side * (y1 - d1 / 3.0)) > wide:
        return False
    closest = wide + 1.0
    for k in range(1, 8):
        closest = min(closest, side * between(y0, d0, y1, d1, 0.125 * k))
    return closest <= wide


@inner
def _step(smooth, work, band, h, now, new, counters):  # type: ignore[no-untyped-def]
    """One trial step from `now` to `new`. Returns the largest error over tolerance and its block."""
    columns, cross, rtol, atol = smooth.law.columns, smooth.cross, smooth.rtol, smooth.atol
    damping, friction, v, delta = smooth.law.damping, smooth.law.friction, smooth.law.belt_speed, smooth.delta
    z, w, rate, force, new_z, new_w = now.z, now.w, now.rate, now.force, new.z, new.w
    stage_w, stage_rate, base, x, beta = work.stage_w, work.stage_rate, work.base, work.x, work.beta
    coupling, fixed, guess, change = work.coupling, work.fixed, work.guess, work.change
    moving, single = work.moving, work.single
    n = len(z)
    copy(w, stage_w[0])
    copy(rate, stage_rate[0])
    is_coupled = len(cross.dense) > 0
    for s in range(1, STAGES):
        for i in range(n):
            base[i] = w[i]
            new_z[i] = 0.0
            new_w[i] = w[i]
        for j in range(s):
            a = h * WEIGHTS[s, j]
            p = h * PREDICT[s, j]
            for i in range(n):
                base[i] += a * stage_rate[j, i]
                new_z[i] += a * stage_w[j, i]
                new_w[i] += p * stage_rate[j, i]
        for i in range(n):
            change[i] = new_w[i] - w[i]
            guess[i] = new_w[i]
            new_w[i] = new_z[i] + h * GAMMA * new_w[i]
            # the layer moves with its block: the last stage is the best guess inside it, harmless outside
            x[i] = (stage_w[s - 1, i] - v) / delta[i]
        # K z is known at the start of the step; K times what z moves is small, and may be rough
        if h * smooth.rough * largest(new_w) <= _ROUGH_SHARE * atol:
            rough_product(columns, new_w, coupling, moving, single)
        else:
            one_product(columns, new_w, coupling, moving)
        for i in range(n):
            coupling[i] += force[i]
        copy(coupling, fixed)
        for _ in range(_SWEEPS_MAX if is_coupled else 1):
            if is_coupled:  # N w at the start is in `force`; `change` is what w moves by, as guessed or last solved
                one_product(cross, change, coupling, moving)
                counters[loop.N_PRODUCTS] += 1
                for i in range(n):
                    coupling[i] += fixed[i]
            if not _solve_stage(smooth, work, s, h, _SOLVED * atol):
                return np.inf, 0
            is_solved = True
            if is_coupled:
                for i in range(n):
                    new_w[i] = (stage_w[s, i] - w[i]) - change[i]
                    change[i] = stage_w[s, i] - w[i]
                    x[i] = (stage_w[s, i] - v) / delta[i]
                is_solved = largest(new_w) <= _SOLVED * atol + ROUNDING * largest(beta)
            if is_solved:
                break
        if not is_solved:
            return np.inf, 0
    last = STAGES - 1
    new_rate = stage_rate[last]
    for i in range(n):
        new_z[i] = z[i] + (new_z[i] + h * GAMMA * stage_w[last, i])
        new_w[i] = stage_w[last, i]
        error_z, error_w = 0.0, 0.0
        for j in range(STAGES):
            error_z += ERROR[j] * stage_w[j, i]
            error_w += ERROR[j] * stage_rate[j, i]
        allowed_z = atol + rtol * max(abs(z[i]), abs(new_z[i]))
        allowed_w = atol + rtol * max(abs(w[i]), abs(new_w[i]))
        x[i] = max(abs(h * error_z) / allowed_z, abs(h * error_w) / allowed_w)
        # While |F| < mu the layer attracts: a step that reaches it ends in it, or its stages missed the turn, which
        # the embedded error need not show.
        drag = damping[i] * v
        attracted, attracts = abs(drag + force[i]) < friction[i], abs(drag + coupling[i]) < friction[i]
        gap, new_gap = w[i] - v, new_w[i] - v
        least, most = gap, gap
        for j in range(1, STAGES):
            least, most = min(least, stage_w[j, i] - v), max(most, stage_w[j, i] - v)
        wide = _WIDE * delta[i]
        if friction[i] > 0.0 and most - least > _SHARP * delta[i]:
            passed = min(max(most, -wide), wide) - min(max(least, -wide), wide)
            jump = friction[i] * passed / wide
            if jump == 0.0 and _touches(gap, h * rate[i], new_gap, h * new_rate[i], wide):
                jump = 2.0 * friction[i]
            # of a block held at the start or the end, w keeps no error: friction bends there, or w is drawn to v
            if (attracts and abs(new_gap) < band[i]) or (attracted and abs(gap) < band[i]):
                x[i] = max(x[i], _CROSSED * h * h * jump / allowed_z)
            else:
                x[i] = max(x[i], _CROSSED * h * jump / allowed_w)
        if attracted and attracts and abs(new_gap) > band[i] and h * friction[i] > UNRESOLVED * delta[i]:
            reached = gap * new_gap < 0.0
            for j in range(STAGES):
                reached = reached or abs(stage_w[j, i] - v) < band[i]
            x[i] = max(x[i], _MISSED) if reached else x[i]
    worst = largest(x)
    block = 0
    for i in range(n):
        block = i if x[i] == worst else block
    return worst, block


@inner
def _sample(h, now, new, slope0, slope1, t, t_next, state):  # type: ignore[no-untyped-def]
    """Keep the state at all sample times up to t_next: cubics in each block's z, and quartics in w.

    The quartic has the values and slopes of w at both ends, and what z moves by as its integral.
    """
    z, w, new_z, new_w, samples = now.z, now.w, new.z, new.w, state.samples
    k = state.counters[loop.N_SAMPLED]
    while k < len(samples.t) and samples.t[k] <= t_next:
        x = min((samples.t[k] - t) / h, 1.0)
        for i in range(len(z)):
            samples.z[k, i] = between(z[i], h * w[i], new_z[i], h * new_w[i], x)
            samples.w[k, i] = between(w[i], slope0[i], new_w[i], slope1[i], x)
            mean = (new_z[i] - z[i]) / h - 0.5 * (w[i] + new_w[i]) - (slope0[i] - slope1[i]) / 12.0
            samples.w[k, i] += 30.0 * (x * (1.0 - x)) ** 2 * mean
        k += 1
    state.counters[loop.N_SAMPLED] = k


@kernel
def _advance(smooth, sticking, state, now, new, work, events, bound):  # type: ignore[no-untyped-def]
    """Steps until the end, or until Python has something to do; goes on where it stopped when called again."""
    law, cross, t_end = smooth.law, smooth.cross, smooth.t_end
    mode, clock, counters = state.mode, state.clock, state.counters
    slope0, slope1 = sticking.slope0, sticking.slope1
    n, n_definitions = len(mode), len(sticking.bands)
    n_recorded = np.int64(0)  # a literal would have what it is passed to compiled twice
    rejected = False
    for _ in range(loop.STEPS_A_SLICE):
        t = clock[loop.TIME]
        remaining = t_end - t
        if remaining <= 0.0:
            _sample(1.0, now, now, now.rate, now.rate, t, t, state)  # a run of no length
            return loop.DONE, n_recorded
        if n_recorded + PASSES * n * n_definitions > len(events.t):
            return loop.BUFFER_FULL, n_recorded
        if mode[0] != 0 and t > clock[loop.CHECK + (mode[0] > 0)]:
            same = True
            for i in range(n):
                same = same and mode[i] == mode[0]
            if same:
                return loop.ALL_SLIP, n_recorded
        h = min(clock[_STEP], smooth.longest)
        if h >= 0.99 * remaining:  # not a last step of almost nothing
            h = remaining
        worst, block = _step(smooth, work, sticking.bands[0], h, now, new, counters)
        counters[loop.N_PRODUCTS] += STAGES - 1
        if not worst <= 1.0:
            counters[loop.N_REJECTED] += 1
            counters[loop.LAST_BLOCK] = block
            factor = _SAFETY * worst**-_EXPONENT if worst < np.inf else _SHRINK
            clock[_STEP] = h * max(_SHRINK, factor)
            rejected = True
            if clock[_STEP] <= 1e-15 * max(1.0, abs(t)):
                return loop.STALLED, n_recorded
            continue
        counters[loop.N_STEPS] += 1
        two_products(law.columns, new.z, new.w, new.force, new.force_rate, work.moving)
        counters[loop.N_PRODUCTS] += 2
        if len(cross.dense) > 0:
            # two_products would save a pass over N, and cost a second of compilation in a second place
            one_product(cross, new.w, work.fixed, work.moving)
            one_product(cross, new.rate, work.change, work.moving)
            counters[loop.N_PRODUCTS] += 2
            for i in range(n):
                new.force[i] += work.fixed[i]
                new.force_rate[i] += work.change[i]
        t_next = t_end if h == remaining else t + h
        for d in range(n_definitions - 1, -1, -1):  # the run's own last: its slopes are the samples'
            n_recorded = step_events(smooth, sticking, d, h, now, new, t, t_next, events, n_recorded)
        _sample(h, now, new, slope0, slope1, t, t_next, state)
        for i in range(n):
            now.z[i] = new.z[i]
            now.w[i] = new.w[i]
            now.rate[i] = new.rate[i]
            now.force[i] = new.force[i]
            now.force_rate[i] = new.force_rate[i]
        clock[loop.TIME] = t_next
        worst = max(worst, 1e-4)
        factor = _SAFETY * worst ** (-0.7 * _EXPONENT) * clock[_LAST_ERROR] ** (0.4 * _EXPONENT)
        clock[_LAST_ERROR] = worst
        clock[_STEP] = h * min(max(factor, _SHRINK), 1.0 if rejected else _GROW)
        rejected = False
        if not max(largest(now.z), largest(now.w)) <= bound:
            return loop.DIVERGED, n_recorded
    return loop.PAUSED, n_recorded


def integrate(task: Task, settings: Sigmoid) -> Run:
    """Run a task with these settings; IntegrationError if the step shrinks to rounding."""
    system, v, n = task.system, task.system.belt_speed, task.system.n
    delta = Ratios.for_blocks("ratio", settings.ratio, n) * settings.eps
    is_manifold = settings.stick == "manifold"
    if is_manifold and not (delta < 1).all():
        raise ValueError(
            f"eps, ratio: stick='manifold' needs ratio * eps < 1, got {delta.max():g}; use stick='threshold'"
        )
    band = delta * np.log(1 / delta) if is_manifold else settings.threshold * delta
    bands = np.vstack([band, np.multiply.outer(np.array(settings.thresholds, dtype=np.float64), delta)])
    rtol, atol = settings.rtol, settings.atol
    smooth = Smooth(
        law=Law.of(system),
        delta=delta,
        springs=np.maximum(np.asarray(system.stiffness.diagonal(), dtype=np.float64), 0.0),
        cross=system.cross_columns,
        rough=float(ROUGH * float(system.row_sums.max())),
        longest=_longest_step(system),
        rtol=rtol,
        atol=atol,
        t_end=task.t_end,
    )
    now, n_products = _start(task, delta)
    work = _Work.blank(n)
    sticking = _sticking(system, now, bands, np.array([is_manifold] + [False] * len(settings.thresholds)), work)
    speed = max(float(np.abs(now.w).max()), float(np.abs(now.rate).max()))
    step = min(task.t_end - task.t_start, 0.1, (atol**0.25) * 0.1 / speed if speed > 0 else 0.1)
    state = State.at_start(task, now.z, now.w, sticking.modes[0], step, 1.0)
    state.counters[loop.N_PRODUCTS] = n_products
    blank = np.full((4, n), np.nan)
    new = Point(z=blank[0], w=blank[1], rate=work.stage_rate[-1], force=blank[2], force_rate=blank[3])
    return loop.complete(
        task,
        state,
        lambda events, bound: _advance(smooth, sticking, state, now, new, work, events, bound),
        Collapse(system, atol + rtol * abs(v), float(band.max()), float(bands.max()), delta),
        stalled=f"the step fell to rounding (rtol = {rtol:g}, atol = {atol:g}); ask for less accuracy,"
        " or use engine='coulomb'",
        events_a_step=PASSES * bands.size,
        initial_modes=sticking.modes.copy(),
        thresholds=settings.thresholds,
    )


def _longest_step(system: System) -> float:
    """The longest step with which the sweeps over N contract; infinite without it."""
    if system.cross_damping is None:
        return math.inf
    excess = np.linalg.norm(system.cross_damping, 2) - _CONTRACTION * system.damping.min()
    return float(_CONTRACTION / (GAMMA * excess)) if excess > 0 else math.inf


def _start(task: Task, delta: Floats) -> tuple[Point, int]:
    """The start of a task, and how many products with K and N it took to know what pulls there."""
    system, z, w = task.system, task.z0.copy(), task.w0.copy()
    cross = system.cross_damping
    force, force_rate = system.stiffness @ z, system.stiffness @ w
    if cross is not None:
        force += cross @ w
    rate = -system.damping * w - force - system.friction * np.tanh((w - system.belt_speed) / delta)
    if cross is not None:
        force_rate += cross @ rate
    return Point(z, w, rate, force, force_rate), 2 if cross is None else 4


def _sticking(system: System, now: Point, bands: Floats, by_force: NDArray[np.bool_], work: _Work) -> Sticking:
    """Who sticks at the start, by each definition."""
    v, n = system.belt_speed, system.n
    held = (system.friction > 0) & (np.abs(now.w - v) < bands)
    held[by_force] &= np.abs(system.damping * v + now.force) < system.friction
    side = np.where(now.w != v, np.sign(now.w - v), np.sign(now.rate))  # on the belt's speed, where it goes next
    modes = np.where(held, 0, side).astype(np.int8)
    return Sticking(bands, by_force, modes, np.zeros(n, dtype=np.bool_), work.base, work.x)
