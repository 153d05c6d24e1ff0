"""Adiabatic loading: closed forms, an own quasi-static integration, and the limit of slow belts."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from stickslip import Harmonic, Rational, System, simulate
from stickslip.sim.episodes import episodes
from stickslip.sim.runs.run import IntegrationError


def chain(n, rng, belt_speed=-1e-3, sign=1.0, **terms):
    stiffness = 2.0 * (2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)) + np.eye(n)
    stiffness[[0, -1], [0, -1]] -= 2.0
    arguments = {"damping": 0.1, "friction": 1.0, "static": rng.uniform(1.1, 1.5, n)} | terms
    return System(stiffness, belt_speed=sign * belt_speed, **arguments)


def first_change(system, y, mode, step):
    """The state at the first change of a block's mode, which block it is of, and how long it took.

    Motion is linear until then, by matrix exponentials; what a block does and undoes within a step is not seen.
    """
    n, slips = system.n, np.diag(mode != 0).astype(float)
    generator = np.zeros((2 * n + 1, 2 * n + 1))
    generator[:n, n:-1], generator[n:-1, :n] = slips, -slips @ system.stiffness
    generator[n:-1, n:-1], generator[n:-1, -1] = -slips * system.damping, -mode * system.friction

    def room(y):  # of a slipping block its speed, of one that sticks the force that it can still bear
        return np.where(mode != 0, y[..., n:-1] * mode, system.static - np.abs(y[..., :n] @ system.stiffness.T))

    steps = [np.eye(2 * n + 1), expm(step * generator)]
    while len(steps) <= 256:
        steps.append(steps[-1] @ steps[1])
    path, clock = np.array(steps) @ np.append(y, 1.0), 0.0
    while not (left := room(path[1:]) < 0).any():
        path, clock = np.array(steps) @ path[-1], clock + 256 * step
        assert clock < 100.0
    k = int(np.argmax(left.any(axis=1)))
    times = {}
    for i in np.flatnonzero(left[k]):
        times[i] = brentq(lambda t, i=i: room(expm(t * generator) @ path[k])[i], 0, step, xtol=1e-16)
    i = min(times, key=times.get)
    return (expm(times[i] * generator) @ path[k])[:-1], i, clock + k * step + times[i]


def slow_events(system, z, distance, step):
    """Event by event: loading in closed form, motion by `first_change`."""
    n, way = system.n, np.sign(system.belt_speed)
    found, travel = [], 0.0
    while True:
        force, pull = system.stiffness @ z, system.stiffness @ np.full(n, way)
        room = np.where(pull > 0, system.static - force, system.static + force) / np.abs(pull)
        first = int(np.argmin(room))
        if (travel := travel + room[first]) > distance:
            return found
        z = z + room[first] * way
        before, clock, slipped = z.sum(), 0.0, {first}
        mode = np.zeros(n)
        mode[first] = -np.sign((system.stiffness @ z)[first])
        y = np.concatenate((z, np.zeros(n)))
        while mode.any():
            y, k, lasted = first_change(system, y, mode, step)
            clock += lasted
            force = (system.stiffness @ y[:n])[k]
            y[n + k] = 0.0
            is_held = mode[k] != 0 and abs(force) <= system.static[k]
            mode[k] = 0.0 if is_held else -np.sign(force)
            slipped |= {k}
        z = y[:n]
        found.append((travel, first, len(slipped), -way * (z.sum() - before), clock))


def test_events_are_those_of_an_own_quasi_static_integration(rng):
    for sign in (1.0, -1.0):
        system = chain(5, rng, sign=sign)
        z = rng.uniform(-0.05, 0.05, 5)
        expected, again = (np.array(slow_events(system, z, 4.0, step)) for step in (2e-3, 1.5e-3))
        loaded = simulate(system, z, "belt", 4.0 / 1e-3, load="adiabatic", tol=1e-12).loaded
        events = np.column_stack([1e-3 * loaded.t, loaded.first_block, loaded.size, loaded.moment, loaded.elapsed])
        n = min(len(expected), len(again))  # until they differ: where a block hardly slips, rounding and steps decide
        apart = np.flatnonzero(np.abs(expected[:n] - again[:n]).max(axis=1) > 1e-8)
        if len(apart) or len(expected) != len(again):
            n = apart[0] if len(apart) else n
            expected, events = expected[:n], events[:n]
        np.testing.assert_allclose(events, expected, rtol=1e-5)


def test_one_block_slips_by_twice_the_drop_after_it_was_loaded_by_as_much():
    """K = 1, R = 0: to the static friction, then half a period on a circle about the kinetic."""
    system = System([[1.0]], 0.0, 1.0, belt_speed=-0.2, static=1.3)
    times = [0.0, 6.4, 6.5, 7.5, 100.0]
    run = simulate(system, 0.0, "belt", 100.0, load="adiabatic", t_eval=times)
    np.testing.assert_allclose(run.loaded.t, 6.5 + 3.0 * np.arange(32), rtol=1e-13)
    np.testing.assert_allclose(run.loaded.moment, 0.6, rtol=1e-9)
    np.testing.assert_allclose(run.loaded.elapsed, np.pi, rtol=1e-9)
    np.testing.assert_allclose(run.samples.z[:, 0], [0.0, -1.28, -0.7, -0.9, -0.8], rtol=1e-9)
    assert run.events.mode.tolist() == [1, 0] * 32
    assert run.n_stick(50.0) == 1
    found = episodes(run, -0.2)
    np.testing.assert_array_equal(found.start, found.end)
    np.testing.assert_array_equal(found.duration, run.loaded.elapsed)


@pytest.mark.parametrize("more", [0.0, 1e-12, 1e-3])
def test_only_blocks_that_give_way_at_one_instant_leave_together(more):
    """Two by themselves, loaded from 0 to their static frictions, of which one is `more` than the other."""
    system = System(np.eye(2), 0.1, 1.0, -0.25, static=[1.5, 1.5 + 1.5 * more])
    loaded = simulate(system, 0.0, "belt", 7.0, load="adiabatic").loaded
    assert loaded.t == pytest.approx([6.0, 6.0 + 6.0 * more] if more else [6.0], rel=1e-14)
    assert loaded.size.tolist() == ([1, 1] if more else [2])


def test_slow_belts_have_these_events_in_the_limit():
    """With an error in proportion to the speed, as long as chaos has not told them apart."""
    rng = np.random.default_rng(1)
    n, static, z = 12, rng.uniform(1.1, 1.5, 12), rng.uniform(-0.1, 0.1, 12)
    limit = simulate(chain(n, rng, static=static), z, "belt", 2000.0, load="adiabatic", tol=1e-12).loaded
    errors = []
    for speed in (1e-4, 1e-5, 1e-6):
        system = chain(n, rng, belt_speed=-speed, static=static)
        found = episodes(simulate(system, z, "belt", 2.0 / speed, tol=1e-12), -speed)
        np.testing.assert_array_equal(found.first_block[:5], limit.first_block[:5])
        np.testing.assert_array_equal(found.size[:5], limit.size[:5])
        errors.append(np.abs(speed * found.start[:5] - 1e-3 * limit.t[:5]).max())
    order = np.log10(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(order, 1.0, atol=0.15)


def test_weakening_without_back_slip_loads_to_the_open_side(rng):
    system = chain(20, rng, static=1.0, friction=0.99, weakening=Rational(3.0), damping=0.0, back_slip=False)
    run = simulate(system, rng.uniform(-0.01, 0.01, 20), "belt", 2000.0, load="adiabatic", tol=1e-8)
    assert len(run.loaded.t) > 5  # 37, within 11
    assert set(run.events.mode.tolist()) == {0, 1}
    assert (run.loaded.moment > 0).all()
    travel = 20 * 1e-3 * (run.loaded.t[-1] - run.loaded.t[0])
    stored = -(run.loaded.z_sum[-1] - run.loaded.z_sum[0])
    assert run.loaded.moment[:-1].sum() + stored == pytest.approx(travel, rel=1e-9)


@pytest.mark.parametrize(("terms", "options", "words"), [
    ({"static": 1.0}, {}, "static: expected above the kinetic friction of every block .* got 1 at block 0"),
    ({"belt_speed": [-0.1, -0.2]}, {}, "belt_speed: expected one constant number, all that load='adiabatic'"),
    ({"belt_speed": 0.0}, {}, "belt_speed: expected one that loads"),
    ({"force": Harmonic(0.1, 1.0)}, {}, "force: expected none, all that load='adiabatic'"),
    ({}, {"modes": 0.0}, "modes: expected"),
    ({}, {"engine": "sigmoid"}, "load: expected an engine of the exact law"),
    ({}, {"load": "slow"}, "load: expected \"adiabatic\" or None, got 'slow'"),
])  # fmt: skip
def test_what_a_belt_that_waits_cannot_load_is_refused_by_name(terms, options, words):
    system = System(np.eye(2), **{"damping": 0.1, "friction": 1.0, "static": 1.3, "belt_speed": -0.1} | terms)
    if "modes" in options:
        options = {"modes": np.zeros(2)}
    with pytest.raises(ValueError, match=words):
        simulate(system, 0.0, "belt", 1.0, **{"load": "adiabatic"} | options)


def test_a_motion_that_does_not_end_is_an_error_that_says_when():
    system = System([[1.0]], -1.5, 1.0, static=1.3, belt_speed=-0.2)
    with pytest.raises(IntegrationError, match=r"at t = 6\.5.* does not come to rest .* block 0 slips"):
        simulate(system, 0.0, "belt", 100.0, load="adiabatic")
    still = System([[0.0]], 0.1, 1.0, static=1.3, belt_speed=-0.2)
    assert len(simulate(still, 0.0, "belt", 100.0, load="adiabatic").loaded.t) == 0
