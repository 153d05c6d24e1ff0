"""Runs of the sigmoid engine that come to rest, w = 0, go on to any time, and only those."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from stickslip.sim import Harmonic, Piecewise, Rational, System, simulate
from stickslip.sim.engines.certificates import Friction, Settling

K = np.array([[2.0, -1.0], [-1.0, 2.0]])
START = ([3.0, 1.0], 0.0)


def settled(system, z, t_end=1e300, **settings):
    run = simulate(system, z, START[1], t_end, engine="sigmoid", **settings)
    assert run.outcome in ("finished", "collapsed")
    assert run.t_end == t_end
    return run


RESTING = {  # the system, and K z at rest: the force less that of friction at the belt's speed
    "a resting belt": (System(K, 0.1, 1.0, 0.0), [0.0, 0.0]),
    "static friction": (System(K, 0.1, 1.0, 0.0, 1.5), [0.0, 0.0]),
    "weakening": (System(K, 0.1, 1.0, 0.0, weakening=Rational(2.0)), [0.0, 0.0]),
    "a force": (System(K, 0.1, 1.0, 0.0, force=[0.3, -0.2]), [0.3, -0.2]),
    "a belt that stops": (System(K, 0.3, 1.0, Piecewise([0.0, 1.0], [-0.2, 0.0])), [0.0, 0.0]),
    "a moving belt": (System(K, 0.3, 1.0, -0.2), [-np.tanh(0.2 / 0.03)] * 2),
    "sliding under weakening": (
        System(K, 0.9, 1.0, -0.2, weakening=Rational(0.1)),
        [-np.tanh(0.2 / 0.03) / 1.02] * 2,
    ),
    "two belts": (System(K, 0.3, 1.0, [-0.2, 0.3]), [-np.tanh(0.2 / 0.03), np.tanh(0.3 / 0.03)]),
    "cross damping": (System(K, [[0.3, 0.1], [-0.1, 0.3]], 1.0, 0.0), [0.0, 0.0]),
}


@pytest.mark.parametrize("case", RESTING)
def test_blocks_that_come_to_rest_are_there_at_any_later_time(case):
    """A run to t = 5e7 took 5 s, one to 1e300 did not end."""
    system, pull = RESTING[case]
    run = settled(system, START[0], t_eval=[0.0, 1e100, 1e300])
    np.testing.assert_allclose(K @ run.z, pull, rtol=0, atol=1e-5)
    np.testing.assert_allclose(run.w, 0.0, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(run.samples.z[-1], run.z)
    np.testing.assert_array_equal(run.samples.z[0], START[0])


def test_the_motion_that_is_followed_is_that_of_the_equations():
    """In the layer a block creeps by z' = -delta (K z) / mu: it is followed where steps would follow it."""
    system, times = System(K, 0.1, 1.0, 0.0), np.array([3e5, 4e5, 1e6])
    settings = {"eps": 1e-2, "t_eval": times, "rtol": 1e-7, "atol": 1e-7}
    early, late = (settled(system, START[0], times[-1], stop_early=stop, **settings) for stop in (True, False))
    assert early.stats.n_steps < late.stats.n_steps
    np.testing.assert_allclose(early.samples.z, late.samples.z, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(early.events.t, late.events.t)


@pytest.mark.parametrize("allowed", [1e-3, 1e-6])
def test_the_farthest_start_that_is_followed_is_followed_within_the_error_allowed(allowed):
    """A block creeps by w' = -0.1 w - z - tanh(w / 0.01): by Radau's method, which shares no code."""
    delta, times = 0.01, np.linspace(0.0, 500.0, 101)
    friction = Friction(lambda u: np.tanh(u / delta), lambda u: 1.0 / (delta * np.cosh(u / delta) ** 2))
    settling = Settling(System([[1.0]], 0.1, 1.0, 0.0), np.zeros(1), np.zeros(1), friction, allowed)
    starts = [(z, -delta * np.arctanh(z)) for z in np.geomspace(1e-3, 0.5, 40)]
    flows = [settling.flow(np.array([z]), np.array([w])) for z, w in starts]
    farthest = max(k for k, flow in enumerate(flows) if flow is not None)
    assert farthest < len(starts) - 1
    motion = solve_ivp(
        lambda _, y: [y[1], -0.1 * y[1] - y[0] - np.tanh(y[1] / delta)],
        (0.0, times[-1]), starts[farthest], "Radau", times, rtol=1e-9, atol=1e-12,
    )  # fmt: skip
    assert np.abs(flows[farthest][0].at(times)[0][:, 0] - motion.y[0]).max() < allowed


def test_blocks_that_no_spring_holds_rest_where_they_come_to_rest():
    """Two blocks on a spring between them keep z_1 + z_2 while both slip one way; a free block runs out."""
    pair = System([[1.0, -1.0], [-1.0, 1.0]], 0.1, 1.0, 0.0)
    np.testing.assert_allclose(settled(pair, START[0]).z, settled(pair, START[0], 1000.0).z, rtol=0, atol=1e-5)
    free = System([[0.0]], 0.1, 1.0, 0.0)
    one, other = (simulate(free, 3.0, 1.0, t_end, engine="sigmoid") for t_end in (1000.0, 1e300))
    np.testing.assert_allclose(one.z, other.z, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    "system",
    [
        System([[1.0]], 0.01, 1.0, -0.2, weakening=Rational(1.0)),  # steady sliding is a source
        System([[1.0]], 0.3, 1.0, 0.0, force=Harmonic(1e-3, 0.01)),  # no rest
    ],
)
def test_a_rest_that_repels_or_moves_is_not_certain(system):
    """From its rest a run goes on by steps."""
    z = -np.tanh(abs(system.belt_speed) / 0.03) * system.kinetic(np.abs([system.belt_speed]))
    one, other = (simulate(system, z, 0.0, t_end, engine="sigmoid").stats.n_steps for t_end in (2e4, 4e4))
    assert other > 1.5 * one


def test_no_collapse_is_certain_while_a_block_may_come_back_into_a_wide_layer():
    """It swings about its rest, w from 0.925 down at the rate R / 2, and sticks within 0.1 of the belt's speed of 1.

    Friction is the kinetic one there: what keeps a certificate away is the layer alone.
    """
    layer = {"eps": 0.01, "stick": "threshold", "threshold": 10.0, "rtol": 1e-9, "atol": 1e-9}
    damping = 0.02
    system = System([[1.0]], damping, 1.0, -1.0)
    run = simulate(system, 0.925 - 1.0, 0.0, 60.0, engine="sigmoid", stop_early="always", **layer)
    fastest = 0.925 * np.exp(-damping / 2 * (np.pi / 2 + 2 * np.pi * np.arange(9)))
    assert (run.events.mode == 0).sum() == (fastest > 0.9).sum() == 1
    assert run.t_collapse > run.events.t.max()
