"""The exact engine: set-valued Coulomb friction, event by event, Taylor series between events.

Between events a sticking block moves with the belt (z linear in t: nothing to integrate) and a slipping one obeys
a linear equation: `stickslip.sim.engines.coulomb.taylor` expands them all. The next event is the first root of

    sigma (w - v)     of a slipping block,
    m + sigma F       of a sticking one, F = R v + K z = -mu lambda, for either sigma;

m is the static friction, mu if no other is given.

At an event every block with w = v is decided anew from |F| and m. Where the two are equal, as at every exit, the
first coefficient of F that does not vanish decides, order by order, while the series is built. Until a block is
decided its motion is the same in either mode, so simultaneous events, folds, cusps and tangencies of any order need
no special cases.

An event changes the equation of one block. That block's own series changes from the second order on, those of the
others from the fourth, by a column of K: `taylor.correct` carries most events over in O(n) an order, and one
expansion serves a window of several events. Damping between blocks, of which F = R v + K z + N w has a term more,
changes those of the others from the third order on: a new expansion follows on each event.

The series are explicit: R h is about 5 at most. Blocks with far larger R are followed on their slow motion, once they
have reached it: `stickslip.sim.engines.coulomb.overdamped`.
"""

from __future__ import annotations

from typing import NamedTuple

from stickslip.sim.engines import course
from stickslip.sim.engines.coulomb import control
from stickslip.sim.engines.coulomb.events import NEVER, enclose, next_event
from stickslip.sim.engines.coulomb.expansion import Expansion
from stickslip.sim.engines.coulomb.expansion import Window as Series
from stickslip.sim.engines.coulomb.model import Model
from stickslip.sim.engines.coulomb.overdamped import follow
from stickslip.sim.engines.coulomb.sticking import force_rounding, known, push
from stickslip.sim.engines.coulomb.taylor import correct, error_after, expand, shift
from stickslip.sim.engines.coulomb.windows import Run, evaluate, note, sample, stalls
from stickslip.sim.engines.course import Events
from stickslip.sim.engines.frame import Way, frame
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arithmetic import ROUNDING, largest


class Window(NamedTuple):
    """The time over which one expansion holds. An event in it is carried over if that is possible, else it ends."""

    is_open: bool
    is_cut: bool  #: whether it ends before it was to end
    is_slow: bool  #: whether its series are those of `overdamped`
    order: int  #: of the series
    left: float  #: how far they hold from here on
    span: float  #: and held at the start
    age: float  #: the time since then
    allowed: float  #: the error of w allowed
    error: float  #: that of w at the start


@inner
def _first_event(model: Model, expansion: Expansion, order: int, h: float) -> tuple[float, int]:
    """Time to the first root of any event function within h, and its block; (h, -1) if there is none."""
    series, mode, zeros, side = expansion.series, expansion.mode, expansion.zeros, expansion.side
    reach, block = expansion.reach, -1
    enclose(series, expansion.slips, order, h, reach, len(mode))
    for i in range(len(mode)):
        face = mode[i], zeros[i], side[i]
        time = next_event(model, expansion, i, face, series, i, reach[i], (order, h))
        if time < NEVER:
            h, block = time, i
    return h, block


@inner
def _on_the_edge(run: Run[None], z_max: float, block: int, order: int, step: float, has_forces: bool) -> int:
    """Mark the slipping blocks with w = v up to rounding; returns how many blocks this instant concerns.

    Of them, with a static friction above the kinetic, a block that has just left goes on: w' is the difference of the
    two then, and at most 0 if it comes. The instant is a `step` into the series. If the forces at it are known,
    sticking blocks with |F| = m count too.
    """
    model, expansion, noise, w = run.model, run.work.expansion, run.work.expansion.near, run.state.w
    v, mode, touching, series = model.belt_speed, expansion.mode, expansion.touching, expansion.series
    static, friction, damping, leaves = model.static, model.friction, model.damping, expansion.leaves
    row_sums, closed, count = model.row_sums, model.closed, 0
    for i in range(len(mode)):
        touching[i] = mode[i] != 0 and mode[i] * (w[i] - v[i]) <= noise[i]
        jump = static[i] - friction[i]
        if touching[i] and jump > 0.0:
            w_dot = 0.0
            for k in range(order, 1, -1):
                w_dot = w_dot * step + k * (k - 1) * series[k, i]
            leaves[i] = mode[i] if mode[i] * w_dot > 0.5 * jump else 0
        concerned = touching[i] or i == block
        if mode[i] == 0 and has_forces:
            drag = damping[i] * v[i]
            slack = force_rounding(drag, row_sums[i] * z_max, static[i], known(model, 0, i))
            concerned = concerned or push(closed[i], drag + series[0, i]) >= static[i] - slack
        count += concerned
    if block >= 0:
        touching[block] = mode[block] != 0
    return count


@inner
def _blank() -> Window:
    return Window(False, False, False, 0, 0.0, 0.0, 0.0, 0.0, 0.0)


@inner
def _open(run: Run[None], window: Window, remaining: float) -> Window:
    """Expand all series, and decide the modes of blocks at their belt's speed, unless the last window goes on."""
    if window.is_open:
        return window
    model, work, goal, state = run.model, run.work, run.goal, run.state
    target = control.next_window(state.clock, remaining)
    order, h, allowed, n_products = follow(work.slow, model, work.expansion, goal, state, target)
    state.counters[course.N_PRODUCTS] += n_products
    is_slow = order > 0
    if not is_slow:
        target = min(target, control.SPAN / goal.rate) if goal.rate > 0.0 else target
        order, h, allowed, n_products = expand(model, work.expansion, goal, state, target)
        state.counters[course.N_PRODUCTS] += n_products
    is_cut = work.expansion.shape is not None and h < target
    return Window(True, is_cut, is_slow, order, h, h, 0.0, allowed, state.clock[course.ERROR])


@inner
def _at(run: Run[None], window: Window, t: float) -> None:
    sample(run.work.expansion, run.model.belt_speed, None, window.order, t, t, run.state)


@inner
def _pass_event(run: Run[None], window: Window, block: int, step: float, left: float) -> float:
    """Go to an event, and carry the series over it; returns how far they hold from there on, 0 if not at all."""
    model, expansion, state = run.model, run.work.expansion, run.state
    v, mode, z, w, order = model.belt_speed, state.mode, state.z, state.w, window.order
    series, stuck_z = expansion.series, expansion.stuck_z
    shift(expansion, order, step, v)
    for i in range(len(z)):
        z[i], w[i] = (stuck_z[i], v[i]) if mode[i] == 0 else (series[0, i], series[1, i])
    z_max = largest(z)
    if _on_the_edge(run, z_max, block, order, 0.0, True) > 1:
        return 0.0
    of_series = Series(order, window.span, window.allowed, z_max)
    h, n_products = correct(model, expansion, block, of_series, left, run.goal.rate)
    state.counters[course.N_PRODUCTS] += n_products
    expansion.touching[block] = mode[block] != 0  # so that a new expansion, if it comes first, decides the same
    return h


@inner
def _carry(
    run: Run[None], window: Window, is_after_event: bool, events: Events, n_recorded: int
) -> tuple[Window, int, bool]:
    """Go on to the next event, or to the end of the window; see `frame.Way`."""
    model, work, goal, state = run.model, run.work, run.goal, run.state
    expansion, noise, v, order = work.expansion, work.expansion.near, model.belt_speed, window.order
    z, w, clock, counters = state.z, state.w, state.clock, state.counters
    series, reach = expansion.series, expansion.reach
    t, remaining = clock[course.TIME], goal.t_end - clock[course.TIME]
    step, block = _first_event(model, expansion, order, window.left)
    if not goal.is_last and remaining - step <= ROUNDING * goal.t_end:
        step = remaining  # an event that rounding cannot tell from the end belongs to the next piece
    counters[course.N_STEPS] += 1
    if block >= 0:
        counters[course.LAST_BLOCK] = block
    for i in range(len(z)):
        noise[i] = ROUNDING * (abs(series[1, i] - v[i]) + abs(2.0 * series[2, i] * window.left) + reach[i])
    t_next, lacking = course.later(t, clock[course.LACKING], step, goal.t_end)
    sample(expansion, v, None, order, t, t_next, state)
    age, left = window.age + step, window.left - step
    of_series = Series(order, window.span, window.allowed, 0.0)
    clock[course.ERROR] = error_after(model, expansion, goal, of_series, age, window.error)
    is_linear = expansion.shape is None and not window.is_slow and model.cross is None
    if block >= 0 and left > 0.0 and is_linear and len(z) >= control.CARRIED:
        h = _pass_event(run, window, block, step, left)
        is_cut, is_open = window.is_cut or h < left, h > 0.0
    else:
        evaluate(expansion, v, None, order, step, z, w)
        _on_the_edge(run, 0.0, block, order, step, False)
        h, is_cut, is_open = 0.0, window.is_cut or block >= 0, False
    clock[course.TIME], clock[course.LACKING] = t_next, lacking
    clock[control.EXPOSURE] += step
    if not is_open:
        control.note_window(clock, is_cut)
    window = Window(is_open, is_cut, window.is_slow, order, h, window.span, age, window.allowed, window.error)
    return window, n_recorded, stalls(goal, counters, t_next - t, t, not is_after_event)


advance = frame(Way(_blank, _open, note, _at, _carry), __name__)
