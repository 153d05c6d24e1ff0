"""Mode coupling: two degrees of freedom, one contact, friction that does not fall with speed.

The minimal model of N. Hoffmann, M. Fischer, R. Allgaier and L. Gaul, Mechanics Research Communications 29 (2002)
197-205: a mass on a belt, its motion x along the belt coupled to y across it, the normal force N = N0 + k3 y.
While it slips against the belt, mu k3 is part of an asymmetric K, and friction is mu N0; so it is too where the belt
drags it out of stick.
"""

from typing import NamedTuple

import numpy as np

from stickslip.sim import System, simulate
from stickslip.sim.attractors import attractor


class Brake(NamedTuple):
    """The stiffnesses, damping of both motions, friction coefficient, normal force at rest, and speed of the belt."""

    along: float
    across: float
    between: float
    contact: float
    damping: float
    mu: float
    normal: float = 1.0
    belt: float = 0.02

    @property
    def system(self):
        """y has no friction; its belt is so fast that it never comes up with it."""
        stiffness = [[self.along, self.between - self.mu * self.contact], [self.between, self.across]]
        return System(stiffness, self.damping, [self.mu * self.normal, 0.0], [self.belt, 100.0], back_slip=False)

    @property
    def boundary(self):
        """The friction coefficient from which on steady sliding flutters.

        The eigenvalues of K are a +- i b there; s^2 + R s + a +- i b = 0 has a root of no decay where b^2 = R^2 a.
        """
        a, half = (self.along + self.across) / 2, (self.across - self.along) / 2
        product = -(half**2) - self.damping**2 * a  # of the elements beside the diagonal
        return (self.between - product / self.between) / self.contact


def drawn(rng):
    between = -rng.uniform(0.3, 0.8)
    along, across = 1 + rng.uniform(0.2, 1.0, 2)
    return Brake(along - between, across - between, between, -rng.uniform(1.0, 2.0), rng.uniform(0.02, 0.1), 0.0)


def started(brake, off=1e-3):
    """The run from near steady sliding, and what it settles on."""
    system = brake.system
    rest = np.linalg.solve(system.stiffness, [brake.mu * brake.normal, 0.0])
    run = simulate(system, rest + off, 0.0, 4000.0, tol=1e-12)
    return attractor(run, system, 2000.0, tol=1e-12)


def test_steady_sliding_flutters_from_the_closed_form_boundary_on(rng):
    for _ in range(3):
        brake = drawn(rng)
        assert brake.boundary > 0
        assert started(brake._replace(mu=0.97 * brake.boundary)).kind == "sliding"
        above = started(brake._replace(mu=1.03 * brake.boundary))
        assert above.kind == "periodic", (brake, above.reason)
        assert above.multiplier < 1
