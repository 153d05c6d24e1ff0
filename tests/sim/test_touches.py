"""Blocks that come back to touch the belt: a stick counts if it is deeper than the error of the run.

One block without damping, K = k: it slips to the right with z = -mu / k + (a / omega) cos(omega t), so that w = -a
sin(omega t), a = |v| + d. Where w comes to v, at omega t = asin(|v| / a), it sticks, since |F| < mu, until F has gone
to -mu: for (a^2 - v^2)^(1/2) / (omega |v|). From then on it swings with the belt's speed, and touches it once a
period, for ever, which is no event.
"""

import itertools
import math

import numpy as np
import pytest

from stickslip.sim import System, simulate
from stickslip.sim.engines import course
from stickslip.sim.engines.coulomb import integrate
from tests import independent

V, MU = 0.2, 1.0


def planted(depth, stiffness, tol, t_end=300.0):
    """The run of a block whose first stick is so deep, over |v|, and the times of its two events."""
    omega, speed = math.sqrt(stiffness), V * (1.0 + depth)
    system = System([[stiffness]], 0.0, MU, -V)
    start = -MU / stiffness + speed / omega
    run = simulate(system, start, 0.0, t_end / omega, tol=tol, stop_early=False)
    entry = math.asin(V / speed) / omega
    return run, (entry, entry + math.sqrt(speed**2 - V**2) / (omega * V))


@pytest.mark.parametrize("stiffness", [0.04, 1.0, 90.0])
@pytest.mark.parametrize(("tol", "depth"), [(1e-3, 5e-6), (1e-5, 5e-6), (1e-8, 5e-9), (1e-10, 5e-11)])
def test_a_stick_half_a_tolerance_deep_counts_and_the_touches_after_it_do_not(stiffness, tol, depth):
    run, times = planted(depth, stiffness, tol)
    assert run.events.mode.tolist() == [0, 1]
    np.testing.assert_allclose(run.events.t, times, rtol=0, atol=0.1 * (times[1] - times[0]))


@pytest.mark.parametrize("tol", [1e-3, 1e-5, 1e-8])
def test_a_stick_far_below_the_error_is_a_touch(tol):
    """Its two events would be rounding, or the error of the run."""
    run, _ = planted(1e-4 * min(tol, 1e-5), 1.0, tol)
    assert len(run.events) == 0


def slipping(over, tol):
    """A run, and the events of a block on a belt at rest that a frictionless one pushes at t = pi beyond friction.

    By so much: it slips from (2 over / 0.1)^(1/2) before until twice as long after. The third block is carried along.
    """
    system = System([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.1]], 0.0, [1.0, 0.0, 1.0], [0.0, 0.0, V])
    run = simulate(system, [0.9 + over, -1.0, 0.0], [0.0, 0.0, V], 6.0, tol=tol, stop_early=False)
    return run, run.events.of_blocks(np.arange(3) == 0)


@pytest.mark.parametrize("tol", [1e-5, 1e-8])
def test_a_slip_far_below_the_error_is_a_touch_and_one_far_above_counts(tol):
    assert not len(slipping(1e-3 * tol, tol)[1])
    (_, events), before = slipping(100 * tol, tol), math.sqrt(200 * tol / 0.1)
    assert events.mode.tolist() == [-1, 0]
    np.testing.assert_allclose(events.t, [math.pi - before, math.pi + 2 * before], rtol=0, atol=0.1 * before)


@pytest.fixture
def made(monkeypatch):
    """The runs that are made, with the estimate of their error."""
    made = []
    runs = integrate._Runs.__init__

    def keeping(self, *args):
        runs(self, *args)
        made.append(self)

    monkeypatch.setattr(integrate._Runs, "__init__", keeping)
    return made


@pytest.mark.parametrize("stiffness", [0.04, 1.0, 90.0])
@pytest.mark.parametrize("tol", [1e-5, 1e-7, 1e-9])
def test_a_stick_six_times_as_deep_as_the_error_counts_and_one_of_a_third_does_not(stiffness, tol, made):
    """The least that counts is a few times the error's estimate, not some ten times."""
    planted(0.0, stiffness, tol, t_end=1.5)  # until just before w comes to v, at omega t = pi / 2
    error = made[-1].states.clock[0, course.ERROR] / V
    for times, n_events in ((6.0, 2), (1.0 / 3.0, 0)):
        run, _ = planted(times * error, stiffness, tol, t_end=2.0)
        assert len(run.events) == n_events


@pytest.mark.parametrize("tol", [1e-5, 1e-7, 1e-9])
def test_the_error_that_tells_touches_bounds_the_error_of_a_run(tol, made):
    """Without damping errors add up; also in windows with events. It was 0.9 of it at most in 2,900."""
    for seed in (1, 5, 7, 21, 64, 93, 110):
        stiffness, v, z, w = undamped(seed)
        system = System(stiffness, 0.0, MU, v)
        exact, run = (simulate(system, z, w, 25.0, tol=each, stop_early=False) for each in (3e-14, tol))
        if run.events.mode.tolist() == exact.events.mode.tolist():
            assert np.abs(run.w - exact.w).max() <= made[-1].states.clock[0, course.ERROR]


def test_the_error_that_tells_touches_is_a_small_share_of_the_tolerance_where_damping_fades_it(made):
    """It was 0.03 of it at most."""
    for damping, tol, t_end in itertools.product((0.5, 1.0, 4.0), (1e-4, 1e-6, 1e-9), (1.0, 3.0, 10.0)):
        simulate(System([[1.0]], damping, 0.0, 0.0), 1.0, 0.0, t_end, tol=tol, stop_early=False)
        assert 0.0 < made[-1].states.clock[0, course.ERROR] < 0.1 * tol


def undamped(seed):
    """A few blocks of wide springs and belts, far from rest: many come back to the belt, and stick for short."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 8))
    root = rng.normal(size=(n, n))
    stiffness, v = root @ root.T / n + 0.3 * np.eye(n), -V * 10.0 ** rng.uniform(-1.0, 0.5)
    return stiffness, v, rng.normal(size=n) * 3.0, rng.normal(size=n)


def chain_on_the_belt(seed):
    """A chain of wide springs that starts at the belt's speed: of some blocks F' is small where they touch it."""
    rng = np.random.default_rng([55, seed])
    n = int(rng.integers(2, 8))
    springs = 10.0 ** rng.uniform(-1, 1, n - 1)
    ground = rng.uniform(0, 1, n) if rng.random() < 0.5 else np.eye(n)[0]
    stiffness = np.diag(ground + np.append(springs, 0.0) + np.append(0.0, springs))
    stiffness -= np.diag(springs, 1) + np.diag(springs, -1)
    v = -V * 10.0 ** rng.uniform(-1, 0.5)
    return stiffness, v, rng.normal(size=n) * rng.choice([0.3, 1.0, 3.0]), np.full(n, v)


PAIR = ([[2.2, -1.2], [-1.2, 2.2]], -V, [3.0, 1.0], [0.0, 0.0])  # 17 events, of which three sticks of at most 0.07


@pytest.mark.parametrize(
    "given",
    [PAIR, *map(undamped, (9, 14, 21, 29, 36, 50, 70)), *map(chain_on_the_belt, (2, 47, 103, 130, 217, 233, 258))],
)
def test_short_sticks_count_and_touches_do_not_at_every_tolerance(given):
    """As a method that shares no code has them. With errors of 1e-3 each of the first lost events.

    The chains have touches that look like sticks if F' is taken to be large, and events at which it is zero.
    """
    stiffness, v, z, w = given
    path = independent.follow(independent.Case.of(stiffness, 0.0, MU, v, z, w), 100.0)
    expected = sorted(zip(path.block, path.t, path.mode, strict=True))
    for tol in (1e-3, 1e-5, 1e-7, 1e-8, 1e-10):
        events = simulate(System(stiffness, 0.0, MU, v), z, w, 100.0, tol=tol, stop_early=False).events
        listed = sorted(zip(events.block.tolist(), events.t.tolist(), events.mode.tolist(), strict=True))
        assert [(block, mode) for block, _, mode in listed] == [(block, mode) for block, _, mode in expected]
