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

from sim.compile import kernel
from sim.kernels import largest, one_product

#: |z| or |w| beyond which a run is not followed: far from any state of a scene, and from overflow.
BEYOND = 1e12
_NEWTON_MAX = 100


@kernel
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
    """A step is one scalar equation a block, (1 + h R / 2) w + (h mu / 2) tanh((w - v) / delta) = b: guarded Newton."""
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


@kernel
def _moreau_jean(law, z, w, h, n_steps):  # type: ignore[no-untyped-def]
    columns, damping, friction, _, v = law
    n = len(z)
    moving = np.empty(n, dtype=np.int64)
    middle, pull = np.empty(n), np.empty(n)
    for step in range(n_steps):
        for i in range(n):
            middle[i] = z[i] + 0.5 * h * w[i]
        one_product(columns, middle, pull, moving)
        for i in range(n):
            a, b = 1.0 + 0.5 * h * damping[i], h * friction[i]
            free = w[i] - h * (0.5 * damping[i] * w[i] + pull[i]) - a * v  # a (w - v) without friction
            new = v + math.copysign(max(abs(free) - b, 0.0), free) / a
            z[i] += 0.5 * h * (w[i] + new)
            w[i] = new
        if not max(largest(z), largest(w)) <= BEYOND:
            return step
    return n_steps


#: By name: the law solved, the steps, and the products with K in one step.
STEPPERS: dict[str, tuple[Literal["coulomb", "sigmoid"], Callable[..., int], int]] = {
    "RK4": ("sigmoid", _rk4, 4),
    "trapezoid": ("sigmoid", _trapezoid, 2),
    "Moreau-Jean": ("coulomb", _moreau_jean, 1),
}
