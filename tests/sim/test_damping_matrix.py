"""A full damping matrix C = diag(R) + N under the sigmoid engine, and the readings of a perturbation.

z'' + C z' + K z + mu tanh((z' - v) / delta) = 0
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from stickslip.sim import COUPLINGS, System, draw_system, perturb_system, simulate
from tests.systems import draw_run

FINE = {"engine": "sigmoid", "rtol": 1e-9, "atol": 1e-9, "stop_early": False}


def draw(seed, cross=1.0):
    """A system with entries of N of size `cross`, and a start."""
    rng = np.random.default_rng([seed, 19])
    return *draw_run(rng, (2, 6), "antisymmetric", damping=(0.0, 3.0), belt_speed=[-0.3], cross=cross), rng


def full(system):
    """C."""
    n = system.n
    return np.diag(system.damping) + (np.zeros((n, n)) if system.cross_damping is None else system.cross_damping)


def by_scipy(system, z0, w0, delta, t_end, method, tol, **settings):
    """Dense output of an implicit, or explicit, method of SciPy."""
    n, c = system.n, full(system)

    def rate(_, y):
        z, w = y[:n], y[n:]
        pull = system.friction * np.tanh((w - system.belt_speed) / delta)
        return np.concatenate((w, -c @ w - system.stiffness @ z - pull))

    start = np.concatenate((z0, w0))
    return solve_ivp(rate, (0.0, t_end), start, method=method, rtol=tol, atol=tol, dense_output=True, **settings).sol


# the system


def test_the_diagonal_and_the_rest_of_a_damping_matrix():
    c = np.array([[1.0, 0.5], [-0.25, 2.0]])
    system = System(np.eye(2), c)
    np.testing.assert_array_equal(system.damping, [1.0, 2.0])
    np.testing.assert_array_equal(system.cross_damping, [[0.0, 0.5], [-0.25, 0.0]])
    assert c[0, 0] == 1.0
    for array in (system.damping, system.cross_damping):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 3.0
    assert "C full" in repr(system)
    assert System(np.eye(2), np.diag([1.0, 2.0])).cross_damping is None
    assert System([[1.0]], [[0.5]]).damping.tolist() == [0.5]
    drawn = draw_system("antisymmetric", 30, 4)
    same = System(drawn.stiffness, np.diag(drawn.damping))
    one, other = (simulate(s, -0.7, -0.4, 20.0, engine="sigmoid") for s in (drawn, same))
    assert (one.z.tobytes(), one.stats) == (other.z.tobytes(), other.stats)


def test_force_and_all_slip_motion():
    system, z, w, _ = draw(1)
    force = system.damping * system.belt_speed + system.stiffness @ z + (full(system) - np.diag(system.damping)) @ w
    np.testing.assert_allclose(system.holding_force(z, w), force, rtol=1e-14)
    slip = np.ones(system.n)
    moved = system.slip_matrix() @ np.concatenate((z, w))
    np.testing.assert_allclose(moved, np.concatenate((w, -full(system) @ w - system.stiffness @ z)), rtol=1e-13)
    np.testing.assert_allclose(system.stiffness @ system.rest_state(slip), -system.friction, atol=1e-12)
    with pytest.raises(ValueError, match="w: expected the velocities"):
        system.holding_force(z)


# the engine


def test_twenty_blocks_against_an_explicit_method():
    """The reading "damping matrix" at 10%: DOP853 at 1e-11, and the state on the way."""
    base = draw_system("antisymmetric", 20, 3)
    system = perturb_system(base, "antisymmetric", 0.1, 1, reading="damping matrix")
    times = np.linspace(0.0, 25.0, 26)
    y = by_scipy(system, np.full(20, -0.7), np.full(20, -0.4), 0.03, 25.0, "DOP853", 1e-11)(times)
    run = simulate(system, -0.7, -0.4, 25.0, t_eval=times, eps=0.03, **FINE)
    np.testing.assert_allclose(run.samples.z, y[:20].T, rtol=0, atol=1e-7)
    np.testing.assert_allclose(run.samples.w, y[20:].T, rtol=0, atol=2e-6)  # cubics between steps
    np.testing.assert_allclose(run.z, y[:20, -1], rtol=0, atol=1e-8)


def test_entries_and_exits_see_the_force_with_its_cross_damping():
    """F = R v + K z + N w and |w - v| on a fine grid of the reference: what sticks there is what the run says."""
    eps = 0.03
    n_events = 0
    for seed in range(3):
        system, z0, w0, _ = draw(seed, 0.3)
        sol = by_scipy(system, z0, w0, eps, 6.0, "DOP853", 1e-9)
        run = simulate(system, z0, w0, 6.0, eps=eps, **FINE)
        times = np.linspace(0.0, 6.0, 2001)
        z, w = sol(times)[: system.n], sol(times)[system.n :]
        drag = (system.damping * system.belt_speed)[:, None]
        force = drag + system.stiffness @ z + system.cross_damping @ w
        near = np.abs(w - system.belt_speed) < eps * np.log(1 / eps)
        held = near & (np.abs(force) < system.friction[:, None]) & (system.friction[:, None] > 0)
        n_events += len(run.events)
        late = 0
        for k, t in enumerate(times):
            away = np.abs(run.events.t - t).min(initial=1.0) > 1e-5
            late += away and not np.array_equal(run.events.mode_at(t) == 0, held[:, k])
        assert late == 0
    assert n_events > 8


def test_growth_by_cross_damping_alone_is_seen():
    """Blocks that feed each other: R = 0.5 on the diagonal, -1 off it, so that one mode of w grows with rate 1/2."""
    system = System(1e-3 * np.eye(2), [[0.5, -1.0], [-1.0, 0.5]], 0.1)
    run = simulate(system, 0.0, [2.0, 2.0], 200.0, engine="sigmoid")
    assert run.outcome == "diverged"


# the readings


def rows(system):
    """Every constant of the system in one row."""
    return np.concatenate((np.ravel(full(system)), np.ravel(system.stiffness)))


@pytest.mark.parametrize("coupling", [name for name, one in COUPLINGS.items() if "scale" in one.readings])
def test_what_scale_drew_before_it_draws_still(coupling):
    """The formula: R + dR, K + S(dU), dR and dU from one generator in this order; to the bit."""
    base = draw_system(coupling, 9, 5)
    rng = np.random.default_rng(7)
    dr, du = rng.uniform(-0.05 * 3.5, 0.05 * 3.5, 9), rng.uniform(-0.05 * 0.2, 0.05 * 0.2, (9, 9))
    if coupling == "antisymmetric_triangle":
        du = np.triu(du) - np.triu(du, 1).T
    elif coupling != "full":
        skew = -1.0 if coupling in ("antisymmetric", "signed_diagonal") else 1.0
        du = np.where(np.eye(9, dtype=bool), du, (du + skew * du.T) / 2)
    for settings in ({}, {"reading": "scale"}):
        moved = perturb_system(base, coupling, 0.05, 7, **settings)
        np.testing.assert_array_equal(moved.damping, base.damping + dr)
        np.testing.assert_array_equal(moved.stiffness, base.stiffness + du)
    noisy = perturb_system(base, coupling, 0.05, 7, reading="damping matrix")
    np.testing.assert_array_equal(noisy.damping, moved.damping)
    np.testing.assert_array_equal(noisy.stiffness, moved.stiffness)


@pytest.mark.parametrize(
    ("coupling", "reading"), [(name, reading) for name, one in COUPLINGS.items() for reading in one.readings]
)
def test_one_draw_goes_one_way(coupling, reading):
    base = draw_system(coupling, 8, 5)

    def way(size, seed=1):
        return (rows(perturb_system(base, coupling, size, seed, reading=reading)) - rows(base)) / size

    np.testing.assert_allclose(way(0.01), way(0.5), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(way(0.1), way(0.1))
    assert np.abs(way(0.1) - way(0.1, seed=2)).max() > 0.1
    np.testing.assert_array_equal(rows(perturb_system(base, coupling, 0.0, 1, reading=reading)), rows(base))


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_relative_keeps_structure_signs_and_zeros(coupling):
    drawn = draw_system(coupling, 60, 5)
    holed = drawn.stiffness * ~np.isin(np.add.outer(np.arange(60), np.arange(60)), (20, 77))
    if coupling == "springs":  # no spring there; the one to the ground stays
        holed[np.diag_indices(60)] += drawn.stiffness.sum(axis=1) - holed.sum(axis=1)
    base = System(holed, drawn.damping)
    moved = perturb_system(base, coupling, 0.3, 11, reading="relative")
    assert moved.cross_damping is None
    k, off = moved.stiffness, ~np.eye(60, dtype=bool)
    np.testing.assert_array_equal((k == 0)[off], (holed == 0)[off])
    factors = [moved.damping / base.damping]
    if coupling == "full":
        factors += [k[holed != 0] / holed[holed != 0]]
        assert not np.allclose(k[0, 1] / holed[0, 1], k[1, 0] / holed[1, 0])
    else:
        sign = 1.0 if coupling in ("symmetric", "springs") else -1.0
        np.testing.assert_array_equal(k[off], sign * k.T[off])
        kept = np.triu(holed != 0, 1)
        factors += [k[kept] / holed[kept]]
        if coupling == "springs":
            factors += [k.sum(axis=1) / holed.sum(axis=1)]
            assert np.linalg.eigvalsh(k).min() > 0
        else:
            kept = np.diag(np.diag(holed) != 0)
            factors += [k[kept] / holed[kept]]
    together = np.concatenate(factors)
    assert np.abs(together - 1.0).max() <= 0.3 + 1e-9
    for part in factors:  # uniform in 1 -+ 0.3: standard deviation 0.3 / sqrt 3
        assert abs(part.mean() - 1.0) < 5 * 0.3 / np.sqrt(3 * len(part))
        assert part.std() == pytest.approx(0.3 / np.sqrt(3), rel=0.25)


def test_noise_off_the_diagonal_of_the_damping():
    base = draw_system("antisymmetric", 100, 5)
    noise = perturb_system(base, "antisymmetric", 0.1, 3, reading="damping matrix", rho=2.0).cross_damping
    off = noise[~np.eye(100, dtype=bool)]
    assert (np.diag(noise) == 0).all()
    assert 0.199 < np.abs(off).max() <= 0.2
    assert off.std() == pytest.approx(0.2 / np.sqrt(3), rel=0.02)
    assert abs(np.corrcoef(noise[np.triu_indices(100, 1)], noise.T[np.triu_indices(100, 1)])[0, 1]) < 0.06
