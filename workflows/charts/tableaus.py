"""Runge-Kutta methods by their tableaus, on linear equations: where they are stable, and of what order when stiff.

On y' = -x / h y one step is the factor R(-x), x = h mu / delta in a layer. Dimensionless.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.integrate import DOP853, RK45
from scipy.linalg import solve_triangular
from scipy.optimize import brentq

from stickslip.sim.engines.radau import WEIGHTS
from stickslip.workflows.charts.peers import Floats

#: Where the search for the end of stability looks, and how finely.
_STABLE_MAX, _GRID = 20.0, 2000
#: How fast the smooth solution turns on which orders are measured: fast enough that errors are not rounding.
_TURNS = 10.0
_S6 = math.sqrt(6.0)


@dataclass(frozen=True, eq=False)
class Tableau:
    """Stage weights, shape (s, s), and weights of the step, shape (s,)."""

    name: str
    stages: Floats
    weights: Floats
    is_ours: bool = False

    def factor(self, x: float) -> float:
        """R(-x) = 1 - x b (I + x A)^-1 1: what a step multiplies by."""
        if math.isinf(x):
            return self.at_infinity
        values = self._stages(x)
        # the last stage is the step: no cancellation at large x
        return float(values[-1] if self._is_stiffly_accurate else 1.0 - x * self.weights @ values)

    def _stages(self, x: float) -> Floats:
        """The stage values g of y = 1: (I + x A) g = 1."""
        matrix, ones = np.eye(len(self.weights)) + x * self.stages, np.ones(len(self.weights))
        is_full = np.triu(self.stages, 1).any()
        return np.asarray(np.linalg.solve(matrix, ones) if is_full else solve_triangular(matrix, ones, lower=True))

    @property
    def _is_stiffly_accurate(self) -> bool:
        return bool(np.array_equal(self.stages[-1], self.weights))

    @property
    def at_infinity(self) -> float:
        """R(-inf): of a stiffly accurate method implicit stages vanish, but for what an explicit first one leaves."""
        if not self._is_stiffly_accurate:
            return math.inf
        if self.stages[0].any():
            return 0.0
        return float(-np.linalg.solve(self.stages[1:, 1:], self.stages[1:, 0])[-1])

    @cached_property
    def stable_to(self) -> float:
        """The x > 0 at which |R(-x)| passes 1 for good; infinite for an A-stable method."""
        grid = np.linspace(0.0, _STABLE_MAX, _GRID + 1)[1:]
        sizes = np.array([abs(self.factor(x)) for x in grid])
        beyond = np.flatnonzero(sizes > 1.0)
        if not len(beyond):
            return math.inf
        return float(
            brentq(lambda x: abs(self.factor(x)) - 1.0, grid[beyond[0]] - _STABLE_MAX / _GRID, grid[beyond[0]])
        )

    def error(self, stiffness: float, h: float) -> float:
        """|y - sin at| at t = 1 of y' = -stiffness (y - sin at) + a cos at, y = sin at, a = 10, in steps of about h.

        A. Prothero and A. Robinson, Math. Comp. 28 (1974) 145-162, doi:10.1090/S0025-5718-1974-0331793-2: the
        smooth solution that stiffness pulls to, as friction pulls a sticking block to the belt's speed.
        """
        n_steps = math.ceil(1.0 / h * (1 - 1e-12))
        h = 1.0 / n_steps
        s, nodes = len(self.weights), self.stages.sum(axis=1)
        inverse = np.linalg.inv(np.eye(s) + h * stiffness * self.stages)
        y = 0.0  # y - sin at, which has no cancellation: its exact value is 0
        for k in range(n_steps):
            t = k * h + nodes * h
            turned = np.sin(_TURNS * t) - math.sin(_TURNS * k * h)
            slope = inverse @ (-stiffness * (y - turned) + _TURNS * np.cos(_TURNS * t))
            y += h * float(self.weights @ slope) - (math.sin(_TURNS * (k + 1) * h) - math.sin(_TURNS * k * h))
        return abs(y)

    def order(self, stiffness: float, h: float) -> float:
        """The slope of that error from h to h / 4."""
        return 0.5 * math.log2(self.error(stiffness, h) / self.error(stiffness, 0.25 * h))


def _scipy_tableau(name: str, solver: Any) -> Tableau:
    s = len(solver.B)
    stages = np.zeros((s, s))
    stages[:, : solver.A.shape[1]] = solver.A
    return Tableau(name, stages, np.asarray(solver.B, dtype=np.float64))


#: Radau IIA of order 5: E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (1996), section IV.5.
_RADAU = np.array(
    [
        [(88 - 7 * _S6) / 360, (296 - 169 * _S6) / 1800, (-2 + 3 * _S6) / 225],
        [(296 + 169 * _S6) / 1800, (88 + 7 * _S6) / 360, (-2 - 3 * _S6) / 225],
        [(16 - _S6) / 36, (16 + _S6) / 36, 1 / 9],
    ]
)
_RK4 = np.array([[0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1.0, 0]])

TABLEAUS = {
    tableau.name: tableau
    for tableau in (
        Tableau("sigmoid engine (Radau, 5 stages)", WEIGHTS, WEIGHTS[-1], is_ours=True),
        Tableau("Radau, 3 stages", _RADAU, _RADAU[-1]),
        Tableau("trapezoid", np.array([[0, 0], [0.5, 0.5]]), np.array([0.5, 0.5])),
        Tableau("RK4", _RK4, np.array([1, 2, 2, 1]) / 6),
        _scipy_tableau("RK45", RK45),
        _scipy_tableau("DOP853", DOP853),
    )
}
