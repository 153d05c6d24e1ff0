"""Heavily damped blocks under the exact law: closed forms, the independent engine, a limit, and short steps."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from stickslip.sim import Harmonic, Piecewise, System, simulate
from stickslip.sim.engines.coulomb import integrate
from stickslip.sim.engines.coulomb.overdamped import Slow
from tests import independent
from tests.systems import draw_case, made


def slipping(damping, stiffness, friction, z0, w0, t):
    """z and w at t of a block that slips right throughout."""
    fast = -0.5 * (damping + np.sqrt(damping**2 - 4 * stiffness))
    slow = stiffness / fast
    y = z0 + friction / stiffness
    a = (w0 - slow * y) / (fast - slow)
    b = y - a
    there = a * np.exp(fast * t), b * np.exp(slow * t)
    return sum(there) - friction / stiffness, fast * there[0] + slow * there[1]


@pytest.mark.parametrize("damping", [1e3, 1e5, 1e8])
def test_one_block(damping, rng):
    z0, w0 = rng.uniform(-10, -1), rng.uniform(0, 3)
    times = np.concatenate(([1.0, 20.0, 0.5 * damping], rng.uniform(0, 20, 5) / damping))
    times.sort()
    run = simulate(System([[0.7]], damping, 0.4, -1.0), z0, w0, times[-1], t_eval=times, tol=1e-12, stop_early=False)
    z, w = slipping(damping, 0.7, 0.4, z0, w0, times)
    assert (np.abs(run.samples.z[:, 0] - z) < 1e-12 * (10 + times)).all()  # an error of w, for so long
    np.testing.assert_allclose(run.samples.w[:, 0], w, rtol=0, atol=1e-11)
    assert run.stats.n_steps < 100


def test_creep_meets_its_belt():
    """w of a block on its slow motion falls like exp(slow t): it is caught when that is the belt's speed."""
    damping, v = 1e6, 1e-7
    run = simulate(System([[1.0]], damping, 0.2, v), -2.0, 0.5, 1e7, tol=1e-12)
    slow = -2.0 / (damping + np.sqrt(damping**2 - 4))
    _, w = slipping(damping, 1.0, 0.2, -2.0, 0.5, 1.0)
    caught = 1.0 + np.log(v / w) / slow
    assert run.events.mode.tolist() == [0, -1]
    assert abs(run.events.t[0] / caught - 1) < 1e-4  # w errs by tol of the largest w there is: 5e-13, of 1e-7


def test_a_block_that_is_held_leaves_when_a_force_says_so_however_slow_its_neighbour(rng):
    """The series of the one that creeps end early, and z of the other is constant; F on it is a wave throughout."""
    damping, stiffness, friction, z0 = 10 ** rng.uniform(3, 6), rng.uniform(0.5, 2.0), rng.uniform(0.3, 1.0), 5.0
    static, frequency = rng.uniform(0.5, 1.0), rng.uniform(0.5, 2.0)
    size = static * rng.uniform(1.02, 1.2)
    slow = -2.0 * stiffness / (damping + np.sqrt(damping**2 - 4.0 * stiffness))
    force = Harmonic([0.0, size], frequency, -0.5 * np.pi)
    system = System(np.diag([stiffness, 1.0]), [damping, 0.0], [friction, static], 0.0, force=force)
    leaves = np.arcsin(static / size) / frequency
    run = simulate(system, [z0, 0.0], [slow * (z0 - friction / stiffness), 0.0], 1.2 * leaves, tol=1e-10)
    assert (run.events.block.tolist(), run.events.mode.tolist()) == ([1], [1])
    assert run.events.t[0] == pytest.approx(leaves, rel=0, abs=1e-8)
    assert run.z[0] == pytest.approx(friction / stiffness + (z0 - friction / stiffness) * np.exp(slow * run.t_end))


def draw(rng, damping):
    """Blocks of which some are heavily damped, on belts on which they stick, or that they leave behind."""
    speeds = (-0.2, 0.0, 0.1 / damping, 1.0 / damping)
    case = draw_case(
        rng, (1, 4), "full", damping=(0.5, 2.0), friction=(0.3, 1.5), belt_speed=speeds, terms=["static"], on_belt=0.5
    )
    heavy = rng.random(case.n) < rng.choice([0.3, 1.0])
    heavy[rng.integers(case.n)] = True
    return replace(case, damping=np.where(heavy, damping * rng.uniform(1, 3, case.n), case.damping))


def test_against_the_independent_engine(rng):
    for _ in range(5):
        case = draw(rng, 1e3)
        wave = rng.normal(size=case.n), np.full(case.n, rng.uniform(0.5, 3)), rng.uniform(0, 6, case.n)
        case = replace(case, waves=np.array([wave]))
        found, system = independent.follow(case, 2.0), made(case)
        size = max(np.abs(x).max() for x in (case.z0, case.w0, found.z, found.w))
        assert Slow.of(system, 3.0) is not None
        run = simulate(system, case.z0, case.w0, 2.0, tol=1e-12, stop_early=False)
        assert np.abs(run.z - found.z).max() < 1e-8 * size
        assert np.abs(run.w - found.w).max() < 1e-8 * size


def test_a_block_with_damping_without_end_is_a_wall(rng):
    """Between two others it stays where it is: they move as if tied to a wall, each for itself."""
    z0 = rng.uniform(-2, 2, 3)
    chain = [[1.0, -0.8, 0.0], [-0.8, 1.6, -0.8], [0.0, -0.8, 1.0]]
    run = simulate(System(chain, [0.1, 1e10, 0.1], 0.5, -0.2), z0, [-0.2, 0.0, -0.2], 50.0)
    for i in (0, 2):
        alone = simulate(System([[1.0]], 0.1, 0.5, -0.2, force=[0.8 * z0[1]]), z0[i], -0.2, 50.0)
        mine = run.events.block == i
        assert run.events.mode[mine].tolist() == alone.events.mode.tolist()
        np.testing.assert_allclose(run.events.t[mine], alone.events.t, rtol=0, atol=1e-6)
        assert abs(run.z[i] - alone.z[0]) < 1e-7
    assert abs(run.z[1] - z0[1]) < 1e-7
    assert run.stats.n_steps < 2000


def beside(rng, damping):
    """Blocks that hinder nobody from slow motion: without friction and at rest, and fast ones that stick."""
    n = int(rng.integers(1, 4))
    is_idle = rng.random(n) < 0.5
    stiffness = np.where(is_idle, rng.choice([0.0, 1.0], n), (damping * 10 ** rng.uniform(-1, 1, n)) ** 2)
    return stiffness, rng.uniform(0, 2, n), np.where(is_idle, 0.0, rng.uniform(0.5, 2, n))


@pytest.mark.filterwarnings("ignore:.* while blocks slip")
def test_blocks_that_rest_keep_nobody_from_slow_motion(rng):
    """Beside a heavily damped one in closed form; coupled or not, v = 0, and the first stays on its side."""
    for _ in range(8):
        damping = 10 ** rng.uniform(3, 8)
        stiffness, light, friction = beside(rng, damping)
        rest = np.zeros(len(light))
        z0, w0 = rng.uniform(-10, -2), rng.uniform(0.1, 3)
        k = np.diag([0.7, *stiffness])
        if rng.random() < 0.5:  # what sticks is pulled by less than its friction
            # beside springs of 1e12, K z is not known to tell that: steps are then short
            np.fill_diagonal(k[1:, 1:], np.minimum(stiffness, 1e10))
            k[1:, 0] = np.where(friction > 0, 0.04 * rng.uniform(-1, 1, len(light)), 0.0)
        order = rng.permutation(len(k))
        system = System(k[np.ix_(order, order)], np.r_[damping, light][order], np.r_[0.4, friction][order], 0.0)
        t_end = 10 ** rng.uniform(0, 0.1)
        run = simulate(system, np.r_[z0, rest][order], np.r_[w0, rest][order], t_end, tol=1e-12, stop_early=False)
        z, w = slipping(damping, 0.7, 0.4, z0, w0, t_end)
        first = order == 0
        assert abs(run.z[first][0] - z) < 1e-10
        assert abs(run.w[first][0] - w) < 1e-10
        assert not run.z[~first].any()
        assert run.stats.n_steps < 200


def test_a_light_block_that_nothing_pulls_keeps_nobody_from_slow_motion(rng):
    """It has no rate but its own R, far above all others: while it slows down, and as a force grows from nothing."""
    for _ in range(4):
        damping, light, t_end = 10 ** rng.uniform(5, 8), rng.uniform(0.05, 0.5), 20.0
        z0, w0, pull = rng.uniform(-10, -2), rng.choice([0.0, 1.0]) * rng.uniform(0.1, 3, 2), rng.normal()
        force = Piecewise([0.0, t_end], [[0.0, 0.0], [0.0, pull * t_end]])
        system = System(np.diag([0.7, 0.0]), [damping, light], [0.4, 0.0], -1.0, force=force)
        run = simulate(system, [z0, 0.0], w0, t_end, tol=1e-12, stop_early=False)
        z, w = slipping(damping, 0.7, 0.4, z0, w0[0], t_end)
        far = (w0[1] + pull / light**2) * np.exp(-light * t_end) + pull * (t_end / light - 1 / light**2)
        assert abs(run.z[0] - z) < 1e-10
        assert abs(run.w[0] - w) < 1e-10
        assert abs(run.w[1] - far) < 1e-9
        assert run.stats.n_steps < 1000


@pytest.mark.parametrize(("stiffness", "t_end"), [(1.0, 3.0), (1e6, 0.01)])
def test_a_light_block_at_rest_is_pulled_along_by_a_heavily_damped_one(stiffness, t_end):
    """F is 0 as it starts, so that nothing tells its rate: that of the slow motion is far too slow for its series."""
    damping = 1e5
    k, start = np.array([[stiffness, -stiffness], [0.0, 1.0]]), np.array([1.0, 1.0, 0.0, -1.0 / damping])
    run = simulate(System(k, [0.5, damping], 0.0, -5.0), start[:2], start[2:], t_end, tol=1e-12)
    expected = expm(t_end * np.block([[np.zeros((2, 2)), np.eye(2)], [-k, -np.diag([0.5, damping])]])) @ start
    np.testing.assert_allclose(np.r_[run.z, run.w], expected, rtol=0, atol=1e-11)


def test_slow_motion_past_the_belt_is_no_motion_before_it(rng):
    """A block a hair before its belt, which a ramp carries past it: by its series, less exact, it is past already."""
    for _ in range(4):
        damping, mu, length, v = rng.uniform(2e3, 5e3), rng.uniform(0.5, 1.5), 2e-5, -rng.uniform(0.1, 1.0) * 1e-3
        system = System([[1.0]], damping, mu, Piecewise([0.0, length], [v, v + 0.1]))
        gap = 10 ** rng.uniform(-14, -12)
        w0 = v + gap
        z0 = -mu - damping * w0 + rng.uniform(1.0, 10.0) * 1e-10 * damping  # slower by so little in its slow motion
        run = simulate(system, z0, w0, 2 * length, tol=1e-7)
        assert run.events.initial_mode[0] == 1
        assert run.events.mode.tolist() == [-1]
        assert run.events.t[0] < 1e-12


def test_heavy_blocks_beside_light_ones_against_the_matrix_exponential(rng):
    """No friction, any coupling: x(t) = exp(A t) x(0)."""
    for _ in range(6):
        n = int(rng.integers(2, 6))
        coupling = rng.choice([0.0, 0.1]) * rng.normal(size=(n, n))
        stiffness = np.diag(10 ** rng.uniform(-1, 3, n)) + coupling
        damping = np.where(rng.random(n) < 0.5, 10 ** rng.uniform(3, 5, n), rng.uniform(0, 1, n))
        x0 = rng.normal(size=2 * n) * np.where(rng.random(n) < 0.3, 0.0, 1.0).repeat(2).reshape(n, 2).T.ravel()
        system = System(stiffness, damping, 0.0, float(rng.choice([0.0, -5.0])))
        run = simulate(system, x0[:n], x0[n:], 1.0, tol=1e-12, stop_early=False)
        matrix = np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, -np.diag(damping)]])
        expected = expm(matrix) @ x0
        np.testing.assert_allclose(np.r_[run.z, run.w], expected, rtol=0, atol=1e-8 * (1 + np.abs(x0).max()))


def test_a_run_that_short_steps_make_long_says_so(monkeypatch):
    """Also where heavily damped blocks are there, which are followed on their slow motion."""
    monkeypatch.setattr(integrate, "_MANY", 1e3)
    for stiffness, damping in (([1.0], 30.0), ([1.0, 900.0], [1e7, 0.1])):
        with pytest.warns(RuntimeWarning, match=r"allow steps of 2e-01 while blocks slip, 3e\+03 of them to t = 500"):
            simulate(System(np.diag(stiffness), damping, belt_speed=-1.0), 0.0, 0.0, 500.0)
