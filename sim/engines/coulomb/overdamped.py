"""Heavily damped blocks in the exact engine: their slow motion, without steps as short as 1 / R.

A slipping block with w' = -R w + G(t) has a transient, exp(-R t) times the deviation of w at the start, and a motion
as slow as G. The coefficients of the latter are

    w_k = (G_k - (k + 1) w_{k+1}) / R,    G = -(K z) - mu sigma plus an external force.

Where R is far above all other rates, this recurrence converges in a few iterations, with w_{k+1} from the last one:
each gains a factor of those rates over R. A block follows its slow motion once its deviation from it is below the
tolerance. Until then, when a block leaves the belt, and where the iteration does not converge, the step is that of
`taylor.expand`. A block with a transient counts as not heavily damped; blocks of far larger R still move slowly.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import course
from stickslip.sim.engines.coulomb import control
from stickslip.sim.engines.coulomb.control import Goal
from stickslip.sim.engines.coulomb.expansion import Expansion
from stickslip.sim.engines.coulomb.model import Model, fastest_belt
from stickslip.sim.engines.coulomb.sticking import IDENTICALLY_ZERO, known, settle
from stickslip.sim.engines.coulomb.taylor import hold
from stickslip.sim.engines.course import State
from stickslip.sim.engines.forcing import begin, may_change, take_off
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.arithmetic import ROUNDING, copy, largest
from stickslip.sim.numerics.products import one_product
from stickslip.sim.systems.once import once_a_system
from stickslip.sim.systems.system import System

#: Places in `patience`: the steps of `expand` still to take, and how many come after the next failure.
_LEFT, _NEXT = 0, 1


class Slow(NamedTuple):
    """What is known of heavily damped blocks."""

    damping: Floats
    pull: Floats  #: row sums of |K|
    fastest: float  #: the largest frequency of a force
    most: float  #: the largest damping
    rate: float  #: of the slow motion if all blocks move
    moves: NDArray[np.bool_]  #: whether a block moves now
    decays: NDArray[np.bool_]  #: whether it has a transient
    patience: NDArray[np.int64]

    @classmethod
    def of(cls, system: System, fastest: float) -> Slow | None:
        """None if there are no such blocks; `fastest` is the largest frequency of a force."""
        damping, pull = system.damping, system.row_sums
        if not (has_heavy(system) and is_heavy(damping, pull, fastest).any()):
            return None
        all_move, decays = np.ones(system.n, dtype=np.bool_), np.zeros(system.n, dtype=np.bool_)
        most = float(damping.max())
        slow = cls(damping.copy(), pull.copy(), fastest, most, 0.0, all_move, decays, np.array([0, 1]))
        _, rate = _pace_of(slow)
        return slow._replace(rate=rate)


@once_a_system
def has_heavy(system: System) -> bool:
    """Whether a block may be heavily damped: one is without forces."""
    return bool(is_heavy(system.damping, system.row_sums, 0.0).any())


def is_heavy(damping: Floats, pull: Floats, fastest: float) -> NDArray[np.bool_]:
    """Whether R is far above all other rates of a block: see `Slow`, whose arguments these are."""
    return damping > control.HEAVY * np.maximum(np.sqrt(pull), fastest)


def _pace_of(slow: Slow) -> tuple[float, float]:
    """The least R of a heavily damped block, with the blocks that move now, and the rate of the slow motion.

    A block is heavily damped if its R is far above that rate, which is the largest of all blocks that are not: it is
    found from below.
    """
    damping, pull, least = slow.damping, slow.pull, control.HEAVY * slow.fastest
    while True:
        rate = slow.fastest
        for i in range(len(damping)):
            if slow.moves[i] or slow.decays[i]:
                frequency = math.sqrt(pull[i])
                is_heavy = damping[i] >= least and damping[i] > control.HEAVY * frequency and not slow.decays[i]
                rate = max(rate, pull[i] / damping[i] if is_heavy else abs(damping[i]) + frequency)
        if control.HEAVY * rate <= least:
            return least, rate
        least = control.HEAVY * rate


_pace = inner(_pace_of)


@inner
def _iterate(
    model: Model, expansion: Expansion, slow: Slow, least: float, t: float, h: float, rate: float, allowed: float
) -> tuple[int, float]:
    """Iterate the series of all blocks, with those of heavily damped ones from the iteration before.

    Returns the order at which they are truncated to the error allowed in w, 0 if there is none, and the change of w
    within h.
    """
    damping, friction, mode, forcing = model.damping, model.friction, expansion.mode, model.forcing
    series, forces, slips = expansion.series, expansion.forces, expansion.slips
    begin(forcing, t)
    n_small, change, power = 0, 0.0, 1.0
    for k in range(control.ORDER_MAX - 1):
        one_product(model.columns, series[k], forces[k], expansion.room.columns)
        pushed = take_off(forcing, t, k, forces[k])
        for i in range(len(mode)):
            pull = -slips[i] * (forces[k, i] + (friction[i] * mode[i] if k == 0 else 0.0))
            if slips[i] == 0.0 or damping[i] < least:
                series[k + 2, i] = (pull - slips[i] * damping[i] * (k + 1) * series[k + 1, i]) / ((k + 2) * (k + 1))
            else:
                w = (pull - (k + 2) * (k + 1) * series[k + 2, i]) / damping[i]
                change = max(change, abs(w - (k + 1) * series[k + 1, i]) * power)
                series[k + 1, i] = w / (k + 1)
        term = power * (k + 1) * largest(series[k + 1])
        if pushed > 0.0:  # as in `expand`: where it moves a block, and where friction holds it
            term = max(term, power * pushed * max(h / (k + 1), 1.0 / (h * slow.rate * slow.rate)))
        n_small = n_small + 1 if term <= allowed else 0  # two in a row, since one can vanish by chance
        if n_small >= 2 and k + 1 >= max(control.ORDER_MIN, rate * h):
            return k + 1, change
        power *= h
    return 0, change


@inner
def _stays(model: Model, expansion: Expansion, moves: NDArray[np.bool_], order: int) -> bool:
    """Whether, by their series, blocks at rest stay at rest, and blocks with |F| = m keep it."""
    series, forces, zeros = expansion.series, expansion.forces, expansion.zeros
    for k in range(1, order - 1):
        c_max = largest(series[k])
        for i in range(len(zeros)):
            noise = ROUNDING * (model.row_sums[i] * c_max + known(model, k, i))
            if zeros[i] == IDENTICALLY_ZERO and abs(forces[k, i]) > noise:
                return False
            if not moves[i] and series[k + 1, i] != 0.0:
                return False
    return True


@inner
def _passed(series: Floats, mode: NDArray[np.int8], v: Floats) -> bool:
    """Whether the series of a block begins beyond the belt's speed, where no root would be found."""
    is_past = False
    for i in range(len(mode)):
        is_past = is_past or (mode[i] != 0 and mode[i] * (series[1, i] - v[i]) <= 0.0)
    return is_past


@inner
def _settled(
    slow: Slow,
    model: Model,
    expansion: Expansion,
    goal: Goal[float],
    state: State,
    target: float,
    pace: tuple[float, float],
) -> tuple[int, float, float, int]:
    """As `follow`, for a given pace; order 0 if the series do not converge, -1 if transients were found."""
    series, mode, moves, v = expansion.series, expansion.mode, slow.moves, model.belt_speed
    z, w, t, tol, (least, rate) = state.z, state.w, state.clock[course.TIME], goal.tol, pace
    n, n_products, n_shorter = len(z), 0, 0
    h = min(target, control.SPAN / rate) if rate > 0.0 else target
    for k in range(2, control.ORDER_MAX + 1):
        for i in range(n):
            series[k, i] = 0.0
    copy(z, series[0])
    copy(w, series[1])
    allowed = max(tol * max(largest(w), fastest_belt(model)), control.LEAST_ALLOWED)
    # if nothing moves yet
    allowed = max(allowed, tol * h * may_change(model.forcing, t, h) / (1.0 + h * largest(model.damping)))
    for _ in range(control.MOST_ITERATIONS):
        order, change = _iterate(model, expansion, slow, least, t, h, rate, allowed)
        n_products += order if order > 0 else control.ORDER_MAX - 1
        allowed = max(allowed, tol * 2.0 * largest(series[2]) * h)
        is_transient = False
        for i in range(n):
            if abs(w[i] - series[1, i]) > allowed + change:
                slow.decays[i], is_transient = True, True
        if is_transient:
            return -1, 0.0, 0.0, n_products
        if n_shorter == control.MOST_SHORTER:
            break
        if order == 0:
            h *= control.SHORTER
            n_shorter += 1
        elif change <= allowed:
            if not _stays(model, expansion, moves, order) or _passed(series, mode, v):
                break
            return order, h, allowed, n_products
    return 0, 0.0, 0.0, n_products


@inner
def follow(
    slow: Slow | None, model: Model, expansion: Expansion, goal: Goal[float], state: State, target: float
) -> tuple[int, float, float, int]:
    """As `expand`, if no heavily damped block that slips has a transient or leaves the belt; else of order 0."""
    if slow is None:
        return 0, 0.0, 0.0, 0
    v, mode, touching, forcing = model.belt_speed, expansion.mode, expansion.touching, model.forcing
    forces, zeros, patience = expansion.forces, expansion.zeros, slow.patience
    z, w, t = state.z, state.w, state.clock[course.TIME]
    n, n_products = len(z), 1
    failed = 0, 0.0, 0.0
    for i in range(n):
        if touching[i] or mode[i] == 0:
            w[i] = v[i]
    one_product(model.columns, z, forces[0], expansion.room.columns)
    begin(forcing, t)
    take_off(forcing, t, 0, forces[0])
    settle(model, largest(z), expansion)
    is_free, moves = True, slow.moves
    for i in range(n):
        slips = mode[i] != 0
        expansion.slips[i] = 1.0 if slips else 0.0
        touching[i] = touching[i] or zeros[i] > 0  # so that `expand` decides the same
        is_free = is_free and (zeros[i] == 0 or zeros[i] == IDENTICALLY_ZERO)  # see `_stays`
        force = model.damping[i] * w[i] + forces[0, i] + model.friction[i] * mode[i]
        moves[i] = slips and (w[i] != 0.0 or force != 0.0)
        slow.decays[i] = False
    least, rate = _pace(slow)
    if slow.most < least:  # short steps cost no more
        return (*failed, n_products)
    if not is_free or patience[_LEFT] > 0:
        patience[_LEFT] = max(patience[_LEFT] - 1, 0)
        return (*failed, n_products)
    while slow.most >= least:
        order, h, allowed, n_more = _settled(slow, model, expansion, goal, state, target, (least, rate))
        n_products += n_more
        if order > 0:
            patience[_NEXT] = 1
            hold(expansion, order)
            return order, h, allowed, n_products
        if order == 0:
            break
        least, rate = _pace(slow)
    patience[_LEFT] = patience[_NEXT]
    patience[_NEXT] = min(2 * patience[_NEXT], control.MOST_PATIENCE)
    return (*failed, n_products)
