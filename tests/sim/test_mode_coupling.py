"""Mode coupling: two degrees of freedom, one contact, friction that does not fall with speed.

The minimal model of N. Hoffmann, M. Fischer, R. Allgaier and L. Gaul, Mechanics Research Communications 29 (2002)
197-205: a mass on a belt, its motion x along the belt coupled to y across it, the normal force N = N0 + k3 y.
While it slips against the belt, mu k3 is part of an asymmetric K, and friction is mu N0; so it is too where the belt
drags it out of stick.
"""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.integrate import solve_ivp

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
    for _ in range(5):
        brake = drawn(rng)
        assert brake.boundary > 0
        assert started(brake._replace(mu=0.97 * brake.boundary)).kind == "sliding"
        above = started(brake._replace(mu=1.03 * brake.boundary))
        assert above.kind == "periodic", (brake, above.reason)
        assert above.multiplier < 1


def round_once(brake, x, y, w):
    """From a stick on: the time until the next, the state there, and the least and largest y; by DOP853.

    The normal force follows y in stick and in slip, as in the model itself.
    """

    def normal(y):
        return brake.normal + brake.contact * y

    def pull(y, x):
        return brake.along * x + brake.between * y + brake.damping * brake.belt

    def sticking(_, s):
        x, y, w = s
        return [brake.belt, w, -brake.between * x - brake.across * y - brake.damping * w]

    def slips(_, s):
        return pull(s[1], s[0]) - brake.mu * normal(s[1])

    def slipping(_, s):
        x, y, u, w = s
        friction = brake.mu * normal(y)
        return [u, w, -brake.along * x - brake.between * y - brake.damping * u + friction,
                -brake.between * x - brake.across * y - brake.damping * w]  # fmt: skip

    def sticks(_, s):
        return s[2] - brake.belt

    how = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13, "dense_output": True}
    slips.terminal = sticks.terminal = True
    slips.direction = sticks.direction = 1
    held = solve_ivp(sticking, (0.0, 200.0), [x, y, w], events=slips, **how)
    (x, y, w) = held.y_events[0][0]
    # it leaves as the belt drags it: a little later it is slower, and the event is the next one
    free = solve_ivp(slipping, (0.0, 200.0), [x, y, brake.belt * (1 - 1e-15), w], events=sticks, **how)
    ends = free.t_events[0]
    assert len(ends) == 1
    heights = [one.sol(np.linspace(*one.t[[0, -1]], 4001))[1] for one in (held, free)]
    x, y = held.sol(np.linspace(*held.t[[0, -1]], 50))[:2]
    force = pull(y, x) + brake.mu * normal(y)
    least, low, high = float(force.min()), float(np.min(heights)), float(np.max(heights))
    assert least > 0  # it would not leave on the other side
    assert normal(np.array([low, high])).min() > 0  # nor lift off
    after = free.y_events[0][0]
    return held.t[-1] + ends[0], after[[0, 1, 3]], (low, high)


def test_the_limit_cycle_is_that_of_another_integrator_with_its_normal_force(rng):
    """For brakes that stick once a round."""
    tried = 0
    for _ in range(30):
        brake = drawn(rng)
        brake = brake._replace(mu=1.1 * brake.boundary)
        found = started(brake)
        assert found.kind == "periodic"
        if len(found.events) > 2:
            continue
        tried += 1
        k = found.events.mode.tolist().index(0)
        z, w = found.states.z[k], found.states.w[k]
        period, after, (low, high) = round_once(brake, *z, w[1])
        assert period == pytest.approx(found.period, rel=1e-8)
        np.testing.assert_allclose(after, [*z, w[1]], rtol=0, atol=1e-8)
        times = np.linspace(0, found.period, 4001)
        run = simulate(brake.system, z, [brake.belt, w[1]], found.period, t_eval=times, modes=[0, -1], tol=1e-12)
        y = run.samples.z[:, 1]
        assert [y.min(), y.max()] == pytest.approx([low, high], abs=1e-5)  # of 4001 samples each
        if tried == 3:
            return
    assert tried == 3
