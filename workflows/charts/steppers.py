"""Methods of a fixed step, compiled: what a user would write down first, set up so that products with K dominate.

    RK4           the classical explicit method on the sigmoid's equations; stable for h mu / delta < 2.785
    trapezoid     Crank-Nicolson with K z explicit, second order as well: A-stable in the layer, not L-stable
    Moreau-Jean   time stepping for the exact law: the midpoint rule, friction implicit; each block's velocity is
                  projected on the belt's. J. J. Moreau, in: Nonsmooth Mechanics and Applications (1988) 1-82.

Every step is t_end / N, N the least number of steps of at most the length asked for. Dimensionless.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np

from stickslip import sim
from stickslip.sim.engines.arithmetic import largest
from stickslip.sim.engines.compile import inner, kernel
from stickslip.sim.engines.products import one_product

#: |z| or |w| beyond which a run is not followed: far from any state of a scene, and from overflow.
BEYOND = 1e12
_NEWTON_MAX = 100


@inner
def _rate(law, z, w, rate, moving):  # type: ignore[no-untyped-def]
    columns, damping, friction, delta, v = law
    one_product(columns, z, rate, moving)
    for i in range(len(z)):
        rate[i] = -(rate[i] + damping[i] * w[i] + friction[i] * math.tanh((w[i] - v) / delta[i]))


@kernel
def _rk4(law, z, w, h, n_steps):  # type: ignore[no-untyped-def]
    n = len(z)
    moving = np.empty(n, dtype=np.int64)
    stage_z, stage_w, rate, sum_z, sum_w = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for step in range(n_steps):
        stage_z[:] = z
        stage_w[:] = w
        sum_z[:] = 0.0
        sum_w[:] = 0.0
        for s in range(4):
            _rate(law, stage_z, stage_w, rate, moving)
            weight = 1.0 / 6.0 if s in (0, 3) else 1.0 / 3.0
            reach = h if s == 2 else 0.5 * h
            for i in range(n):
                sum_z[i] += weight * stage_w[i]
                sum_w[i] += weight * rate[i]
                stage_z[i] = z[i] + reach * stage_w[i]
                stage_w[i] = w[i] + reach * rate[i]
        for i in range(n):
            z[i] += h * sum_z[i]
            w[i] += h * sum_w[i]
        if not max(largest(z), largest(w)) <= BEYOND:
            return step
    return n_steps


@kernel
def _trapezoid(law, z, w, h, n_steps):  # type: ignore[no-untyped-def]
    """A step is one scalar equation a block, a w + b tanh((w - v) / delta) = right: guarded Newton."""
    columns, damping, friction, delta, v = law
    n = len(z)
    moving = np.empty(n, dtype=np.int64)
    rate, ahead, pull = np.empty(n), np.empty(n), np.empty(n)
    for step in range(n_steps):
        _rate(law, z, w, rate, moving)
        for i in range(n):
            ahead[i] = z[i] + h * (w[i] + 0.5 * h * rate[i])
        one_product(columns, ahead, pull, moving)
        for i in range(n):
            a, b = 1.0 + 0.5 * h * damping[i], 0.5 * h * friction[i]
            right = w[i] + 0.5 * h * (rate[i] - pull[i])
            low, high = (right - b) / a, (right + b) / a  # tanh is within [-1, 1]
            new = min(max(w[i], low), high)
            for _ in range(_NEWTON_MAX):
                tanh = math.tanh((new - v) / delta[i])
                residual = a * new + b * tanh - right
                if residual > 0.0:
                    high = new
                else:
                    low = new
                last = new
                new -= residual / (a + b / delta[i] * (1.0 - tanh * tanh))
                if not (low < new < high):
                    new = 0.5 * (low + high)
                if abs(new - last) <= 1e-14 * max(abs(new), abs(v)):
                    break
            z[i] += 0.5 * h * (w[i] + new)
            w[i] = new
        if not max(largest(z), largest(w)) <= BEYOND:
            return step
    return n_steps


@inner
def _moreau_jean_step(law, z, w, h, middle, pull, moving):  # type: ignore[no-untyped-def]
    """One step in place; False if the state passed `BEYOND`. A block that ends on the belt has w == v exactly."""
    columns, damping, friction, _, v = law
    n = len(z)
    for i in range(n):
        middle[i] = z[i] + 0.5 * h * w[i]
    one_product(columns, middle, pull, moving)
    for i in range(n):
        a, b = 1.0 + 0.5 * h * damping[i], h * friction[i]
        free = w[i] - h * (0.5 * damping[i] * w[i] + pull[i]) - a * v  # a (w - v) without friction
        new = v + math.copysign(max(abs(free) - b, 0.0), free) / a
        z[i] += 0.5 * h * (w[i] + new)
        w[i] = new
    return max(largest(z), largest(w)) <= BEYOND


@kernel
def _moreau_jean(law, z, w, h, n_steps):  # type: ignore[no-untyped-def]
    n = len(z)
    middle, pull, moving = np.empty(n), np.empty(n), np.empty(n, dtype=np.int64)
    for step in range(n_steps):
        if not _moreau_jean_step(law, z, w, h, middle, pull, moving):
            return step
    return n_steps


@kernel
def _moreau_jean_recorded(law, z, w, h, first, n_steps, mode, at, block, to):  # type: ignore[no-untyped-def]
    """From step `first` on, each change of a block's mode into (at, block, to); `at` counts the steps done by then.

    Returns the steps done, the changes recorded, and whether the state is within bounds; ends early when the changes
    of one more step might not fit.
    """
    v, n = law[4], len(z)
    middle, pull, moving = np.empty(n), np.empty(n), np.empty(n, dtype=np.int64)
    recorded = 0
    for step in range(first, n_steps):
        if recorded + n > len(at):
            return step, recorded, True
        if not _moreau_jean_step(law, z, w, h, middle, pull, moving):
            return step, recorded, False
        for i in range(n):
            new = (w[i] > v) - (w[i] < v)
            if new != mode[i]:
                at[recorded], block[recorded], to[recorded] = step + 1, i, new
                mode[i] = new
                recorded += 1
    return n_steps, recorded, True


def whole_steps(t_end: float, longest: float) -> int:
    """The least number of equal steps of at most that length; rounding of the quotient adds none."""
    return math.ceil(t_end / longest * (1.0 - 1e-12))


def moreau_jean(system: sim.System, z0: float, w0: float, t_end: float, step: float) -> sim.Run:
    """Moreau-Jean with its changes of mode, each at the end of the step that made it; from t = 0.

    A block sticks after a step if its velocity is the belt's. What enters and leaves within a step is not seen; a
    crossing that a step ends on is seen as a stick of one step.

    Parameters
    ----------
    system : sim.System
    z0, w0 : float
        Start of every block.
    t_end, step : float
        The end and the longest step, > 0.

    Returns
    -------
    sim.Run
        "diverged", up to the last step within bounds, if |z| or |w| passes `BEYOND`.
    """
    n, n_steps = system.n, whole_steps(t_end, step)
    law = (system.columns, system.damping, system.friction, np.ones(n), system.belt_speed)
    z, w = np.full(n, z0), np.full(n, w0)
    mode = np.sign(w - system.belt_speed).astype(np.int8)
    initial_mode = mode.copy()
    capacity = max(2 * n, 4096)
    at, block, to = np.empty(capacity, np.int64), np.empty(capacity, np.int32), np.empty(capacity, np.int8)
    parts: list[tuple[np.ndarray, ...]] = []
    done, is_within = 0, True
    while done < n_steps and is_within:
        done, recorded, is_within = _moreau_jean_recorded(
            law, z, w, t_end / n_steps, done, n_steps, mode, at, block, to
        )
        parts.append((at[:recorded] / n_steps * t_end, block[:recorded].copy(), to[:recorded].copy()))
    t, blocks, modes = (np.concatenate(part) for part in zip(*parts, strict=True))
    reached = done / n_steps * t_end
    return sim.Run(
        z=z,
        w=w,
        t_end=reached,
        events=sim.EventSeries(t, blocks, modes, initial_mode, 0.0, reached),
        outcome="finished" if is_within else "diverged",
        reason="" if is_within else f"|z| or |w| passed {BEYOND:g} after t = {reached:.4g}",
        stats=sim.Stats(n_steps=done, n_rejected=0, n_products=done, n_events=len(t)),
    )


#: By name: the law solved, the steps, and the products with K in one step.
STEPPERS: dict[str, tuple[Literal["coulomb", "sigmoid"], Callable[..., int], int]] = {
    "RK4": ("sigmoid", _rk4, 4),
    "trapezoid": ("sigmoid", _trapezoid, 2),
    "Moreau-Jean": ("coulomb", _moreau_jean, 1),
}
