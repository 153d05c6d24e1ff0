"""One block under a harmonic force, without a belt: closed forms, and runs of the exact engine beside them.

    z'' + R z' + z + S lambda = cos(Omega t + phase),    lambda in Sign(z')

A half-cycle without stops, from z = x0, z' = 0 to -x0, is given in closed form by J. P. Den Hartog, Forced vibrations
with combined viscous and Coulomb damping, Philosophical Magazine 9 (1930) 801-817, here with R = 0:

    x0^2 = V^2 - (S U)^2,    V = 1 / (1 - Omega^2),    U = sin(pi / Omega) / (Omega (1 + cos(pi / Omega)))

It has no stops while x0 >= S H, H the most of ((sin t) / Omega + U (cos Omega t - cos t)) / sin Omega t, 0 < t < pi /
Omega: while S <= |V| / (U^2 + H^2)^(1/2). Where Omega = 1 / (2 n) U is 0, and cycles about z = a, |a| up to that less
S, are cycles too. Dimensionless.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip import sim

TOL = 1e-13
_GRID = 20_001  # of the half-cycle on which H is looked for, before its top is taken from a parabola


class State(NamedTuple):
    """Where the block is, and the phase of the force."""

    z: float
    w: float
    phase: float


@dataclass(frozen=True)
class Forced:
    """The block: `frequency` Omega, `friction` S, `damping` R."""

    frequency: float
    friction: float
    damping: float = 0.0

    @property
    def cycle(self) -> float:
        """Of the force."""
        return 2 * np.pi / self.frequency

    def run(self, start: State, cycles: float, t_eval: Sequence[float] | NDArray[np.float64] = ()) -> sim.Run:
        """So many cycles of the force from a start."""
        force = sim.Harmonic(1.0, self.frequency, start.phase)
        system = sim.System([[1.0]], self.damping, self.friction, belt_speed=0.0, force=force)
        return sim.simulate(system, start.z, start.w, cycles * self.cycle, tol=TOL, stop_early=False, t_eval=t_eval)

    def after(self, start: State, cycles: float = 1.0) -> State:
        """The state so many cycles later."""
        run = self.run(start, cycles)
        return State(float(run.z[0]), float(run.w[0]), start.phase + 2 * np.pi * cycles)

    def stops(self, start: State, settle: int, counted: int) -> list[int]:
        """How often the block comes to rest in each of some cycles, after others in which it settles."""
        run = self.run(start, settle + counted)
        entries = run.events.t[run.events.mode == 0]
        return np.histogram(entries / self.cycle, settle + np.arange(counted + 1))[0].tolist()

    def multipliers(self, start: State, width: float = 1e-6) -> NDArray[np.complex128]:
        """Of the map from one cycle of the force to the next, at a state that it maps to itself, by differences."""
        columns = []
        for move in ((width, 0.0), (0.0, width)):
            plus, minus = (
                self.after(State(start.z + s * move[0], start.w + s * move[1], start.phase)) for s in (1, -1)
            )
            columns.append([(plus.z - minus.z) / (2 * width), (plus.w - minus.w) / (2 * width)])
        return np.linalg.eigvals(np.transpose(columns))


def shape(frequency: float) -> tuple[float, float, float]:
    """V, U and H of a frequency."""
    half = np.pi / frequency
    v = 1.0 / (1.0 - frequency**2)
    u = np.tan(half / 2) / frequency

    t = np.linspace(0.0, half, _GRID)[1:-1]
    values = (np.sin(t) / frequency + u * (np.cos(frequency * t) - np.cos(t))) / np.sin(frequency * t)
    k = int(np.argmax(values))
    top = float(values[k])
    if 0 < k < len(t) - 1:
        low, high = values[k - 1], values[k + 1]
        curve = low - 2 * top + high
        top -= (high - low) ** 2 / (8 * curve) if curve else 0.0
    return float(v), float(u), max(top, 1.0 / frequency**2)


def most_friction(frequency: float) -> float:
    """The largest S at which the block does not stop (Den Hartog)."""
    v, u, h = shape(frequency)
    return float(abs(v) / np.hypot(u, h))


def sliding_cycle(block: Forced) -> State:
    """A state of the cycle without stops, R = 0: at z = x0, where it turns; S at most `most_friction`."""
    v, u, _ = shape(block.frequency)
    x0 = np.sqrt(v**2 - (block.friction * u) ** 2)
    return State(float(x0), 0.0, float(np.arctan2(-block.friction * u / v, x0 / v)))
