"""Scales between SI units and dimensionless numbers.

Blocks of masses m_i in kg, springs k in N/m, dampings c_i in N s/m, friction F_i = mu_i N_i in N and belts at V_i in
m/s obey

    m_i x_i'' + c_i x_i' + (k x)_i + F_i lambda_i = f_i(t),    lambda_i in Sign(x_i' - V_i).

With x = L z and t = T s, division by a force F leaves the same equation, dimensionless, for any L, T and F:

    mass m_i L / (F T^2),   R_i = c_i L / (F T),   K = k L / F,   mu_i = F_i / F,   v_i = V_i T / L,   f_i(T s) / F.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stickslip.sim.numerics.arguments import number
from stickslip.sim.systems.drive import Harmonic, Piecewise, Term

if TYPE_CHECKING:
    from stickslip.sim.systems.system import System

#: The least scale and the largest: float64 holds their quotients, with room for numbers in them.
_LEAST, _MOST = 1e-60, 1e60


@dataclass(frozen=True)
class Scales:
    """What one dimensionless unit is: of length in m, of time in s, of force in N.

    A dimensionless number times its scale is in SI units: ``run.events.t * scales.time``, ``run.z * scales.length``,
    ``run.w * scales.speed``. A quantity in SI units over its scale is dimensionless.

    Raises
    ------
    TypeError, ValueError
        If one is no number from 1e-60 to 1e60.
    """

    length: float
    time: float
    force: float

    def __post_init__(self) -> None:
        for name in ("length", "time", "force"):
            value = number(name, getattr(self, name), above=0)
            if not _LEAST <= value <= _MOST:
                raise ValueError(f"{name}: expected a scale from {_LEAST:g} to {_MOST:g}, got {value:g}; correct it")
            object.__setattr__(self, name, value)

    @property
    def speed(self) -> float:
        """In m/s."""
        return self.length / self.time

    @property
    def mass(self) -> float:
        """In kg."""
        return self.force * self.time**2 / self.length

    @property
    def stiffness(self) -> float:
        """In N/m."""
        return self.force / self.length

    @property
    def damping(self) -> float:
        """In N s/m."""
        return self.force * self.time / self.length

    @property
    def energy(self) -> float:
        """In J."""
        return self.force * self.length

    @property
    def power(self) -> float:
        """In W."""
        return self.energy / self.time

    @property
    def frequency(self) -> float:
        """In 1/s."""
        return 1.0 / self.time

    @property
    def angular_frequency(self) -> float:
        """In radians a second."""
        return 1.0 / self.time

    @property
    def slowness(self) -> float:
        """In s/m."""
        return 1.0 / self.speed

    @classmethod
    def of(cls, system: System) -> Scales:
        """Scales in which the mean mass, diagonal entry of K and kinetic friction of a system in SI units are 1.

        Time is that of a block on its springs, sqrt(m / k), and length how far friction stretches them, F / k: so
        motions, and what errors are compared with, are of the order of one.

        Raises
        ------
        ValueError
            If the mean diagonal entry or friction is not above 0.
        """
        force, stiffness = float(system.friction.mean()), float(np.mean(system.stiffness.diagonal()))
        for name, mean, what in (("friction", force, "friction"), ("stiffness", stiffness, "diagonal entry")):
            if not mean > 0.0:
                raise ValueError(
                    f"{name}: expected a mean {what} above 0, by which to scale, got {mean:g}; pass"
                    " scales=Scales(length, time, force)"
                )
        return cls(force / stiffness, float(np.sqrt(system.mass.mean() / stiffness)), force)

    def dimensionless(self, system: System) -> System:
        """The system whose numbers are in SI units, in these scales."""
        belt = system.belt_speed
        return system.changed(
            stiffness=system.stiffness / self.stiffness,
            damping=system.damping_matrix / self.damping,
            friction=system.friction / self.force,
            static=system.static / self.force if system.has_static else None,
            belt_speed=self._term(belt, self.speed) if isinstance(belt, Piecewise) else belt / self.speed,
            mass=system.mass / self.mass,
            force=[self._term(term, self.force) for term in system.force],
            weakening=None if system.weakening is None else system.weakening.in_units(self.speed),
        )

    def _term(self, term: Term, scale: float) -> Any:
        if isinstance(term, Harmonic):
            return Harmonic(term.amplitude / scale, term.frequency * self.time, term.phase)
        return Piecewise(term.times / self.time, term.values / scale)
