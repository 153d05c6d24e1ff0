"""Methods of a fixed step, compiled: what a user would write down first, set up so that products with K dominate.

    RK4           the classical explicit method on the sigmoid's equations; stable for h mu / delta < 2.785
    trapezoid     Crank-Nicolson with K z explicit, second order as well: A-stable in the layer, not L-stable
    Moreau-Jean   time stepping for the exact law, the engine `moreau` without its record of events

Every step is t_end / N, N the least number of steps of at most the length asked for. Dimensionless.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np

from stickslip.sim.engines.arithmetic import largest
from stickslip.sim.engines.compile import inner, kernel
from stickslip.sim.engines.moreau_steps import BEYOND, step_of
from stickslip.sim.engines.products import one_product

_NEWTON_MAX = 100


@inner
def _rate(law, z, w, rate, moving):  # type: ignore[no-untyped-def]
    columns, damping, friction, delta, v = law
    one_product(columns, z, rate, moving)
    for i in range(len(z)):
        rate[i] = -(rate[i] + damping[i] * w[i] + friction[i] * math.tanh((w[i] - v) / delta[i]))


@kernel(counts=True)
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


@kernel(counts=True)
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


@kernel(counts=True)
def _moreau_jean(law, z, w, h, n_steps):  # type: ignore[no-untyped-def]
    columns, damping, friction, _, v = law
    n = len(z)
    middle, pull, moving = np.empty(n), np.empty(n), np.empty(n, dtype=np.int64)
    for step in range(n_steps):
        if not step_of((columns, damping, friction, friction, v), z, w, h, middle, pull, moving):
            return step
    return n_steps


#: By name: the law solved, the steps, and the products with K in one step.
STEPPERS: dict[str, tuple[Literal["coulomb", "sigmoid"], Callable[..., int], int]] = {
    "RK4": ("sigmoid", _rk4, 4),
    "trapezoid": ("sigmoid", _trapezoid, 2),
    "Moreau-Jean": ("coulomb", _moreau_jean, 1),
}
