"""The independent engine itself, against closed forms and energy."""

from itertools import pairwise

import numpy as np
import pytest

from tests.independent import Case, Path, Ramp, follow


def listed(path: Path) -> list[tuple[float, int, int]]:
    return [(pytest.approx(t, abs=1e-12), i, m) for t, i, m in zip(path.t, path.block, path.mode, strict=True)]


def run(*system: object, t_end: float) -> Path:
    return follow(Case.of(*system), t_end)  # type: ignore[arg-type]


def test_one_block_crosses_and_sticks():
    events = [(0.29075098367384344, 0, -1), (3.231881443452085, 0, 0), (4.104721534065557, 0, 1)]
    assert listed(run([[1.0]], 0.1, 1, -0.2, 3, 1, t_end=9.0)) == [
        (pytest.approx(t, abs=1e-12), i, m) for t, i, m in events
    ]


def test_two_blocks():
    """Figure 2: rho = 0.1, kappa = 1.1, 1.6, kappa12 = 0.5, v = -1."""
    path = run([[1.6, -0.5], [-0.5, 2.1]], 0.1, 1, -1, 0, -1, t_end=30.0)
    expected = [(0.5625, 1, 1), (0.8162276148517664, 0, 1), (6.168800188684988, 0, 0), (6.287311406713242, 0, 1)]
    assert listed(path) == expected
    np.testing.assert_allclose(path.z, [-1.0401911196217937, -0.8589369248824921], rtol=0, atol=1e-13)


def test_a_graze_is_no_event_and_a_dip_is_two():
    assert run([[1.0]], 0, 0, -1, 1, 0, t_end=20.0).t == []  # w = -sin t
    half = np.arccos(1 - 1e-6)
    path = run([[1.0]], 0, 0, 1e-6 - 1, 1, 0, t_end=3.0)
    np.testing.assert_allclose(path.t, [np.pi / 2 - half, np.pi / 2 + half], rtol=0, atol=1e-9)
    assert path.mode == [-1, 1]


def test_twins_change_together_and_what_rests_at_its_bound_holds():
    path = run(np.eye(3) * 1.4 + 0.3, 0.1, 1, -0.2, 3, 1, t_end=20.0)
    assert path.block == [0, 1, 2] * (len(path.t) // 3)
    assert path.t[::3] == path.t[1::3] == path.t[2::3]
    held = run([[1, -1], [-1, 1]], 0, 1, -0.5, [1, 0], -0.5, t_end=50.0)
    assert (held.initial_mode, held.t) == ((0, 0), [])


def test_nilpotent_stiffness_is_a_polynomial():
    """z_2 is free, w_2 = 1; z_1'' = -3 z_2 while block 1 is free too."""
    path = run([[0, 3], [0, 0]], 0, 0, -50, 0, [0, 1], t_end=7.0)
    np.testing.assert_allclose(path.z, [-(7.0**3) / 2, 7.0], rtol=1e-13)


def test_energy_is_lost_to_damping_and_friction_only():
    """v = 0, K symmetric: d/dt (w^2 + z K z) / 2 = -R w^2 - mu |w|."""
    rng = np.random.default_rng(3)
    a = rng.normal(size=(4, 4))
    k, r, mu = a @ a.T, rng.uniform(0, 0.2, 4), rng.uniform(0, 1, 4)
    path = follow(Case.of(k, r, mu, 0, 3 * rng.normal(size=4), 3 * rng.normal(size=4)), 6.0)
    edges = np.unique([0.0, *path.t, 6.0])
    nodes, weights = np.polynomial.legendre.leggauss(40)
    lost = 0.0
    for low, high in pairwise(edges):
        _, w = path.at(low + (high - low) * (nodes + 1) / 2)
        lost += (high - low) / 2 * weights @ ((r * w**2).sum(axis=1) + np.abs(w) @ mu)
    z, w = path.at([0.0, 6.0])
    energy = ((w**2).sum(axis=1) + np.einsum("ti,ij,tj->t", z, k, z)) / 2
    assert len(path.t) > 10
    assert energy[0] - energy[1] == pytest.approx(lost, abs=1e-11)


@pytest.mark.parametrize(("drop", "v"), [(0.01, 0.5), (2.0, -1.0)])
def test_the_period_of_one_block_with_static_friction(drop, v):
    """K = 1, R = 0: stuck over 2 drop at the belt's speed, then the larger part of a circle."""
    path = follow(Case.of([[1.0]], 0.0, 1.0, v, 0.0, v, 1.0 + drop), 150.0)
    exits = np.array(path.t)[np.array(path.mode) != 0]
    period = 2 * drop / abs(v) + 2 * (np.pi - np.arctan(drop / abs(v)))
    np.testing.assert_allclose(np.diff(exits), period, rtol=0, atol=1e-12)


def test_a_block_that_leaves_with_a_jump_takes_along_what_it_holds_at_the_edge():
    """Both at F = -static with F' = 0; F'' = 0 unless the other leaves, which pulls: then the second follows.

    Block 0 is pushed outward at the second order by a third, which slips; block 1 feels block 0 alone.
    """
    k = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    z = np.array([1.5, 0.0, 1.5])  # F_0 = -z_2, F_1 = -z_0
    case = Case.of(k, 0.0, [1.0, 1.0, 0.0], 0.0, z, 0.0, [1.5, 1.5, 0.0])
    held = follow(case, 1.0)
    assert (list(held.initial_mode), held.t) == ([0, 0, 0], [])  # nothing moves: all rest at the edge
    k[2, 2] = -0.1  # block 2 is pushed outward: its z grows at the second order
    assert list(follow(Case.of(k, 0.0, [1.0, 1.0, 0.0], 0.0, z, 0.0, [1.5, 1.5, 0.0]), 0.1).initial_mode) == [1, 1, 1]


def test_a_free_block_under_a_harmonic_force():
    """z'' + z / 2 = 3 cos(2 t + 1) / 2, of mass 2: a particular solution and the rest of the start."""
    case = Case.of([[1.0]], 0, 0, -50, 1.0, 0.0, mass=2.0, waves=[(3.0, 2.0, 1.0)])
    path = follow(case, 200.0)
    t, own, a = np.linspace(0.0, 200.0, 999), np.sqrt(0.5), 1.5 / (0.5 - 4.0)
    z = a * np.cos(2 * t + 1) + (1 - a * np.cos(1)) * np.cos(own * t) + 2 * a * np.sin(1) / own * np.sin(own * t)
    np.testing.assert_allclose(path.at(t)[0][:, 0], z, rtol=0, atol=1e-12)


def test_a_block_is_carried_until_its_belt_pulls_away():
    """v rises by 2 a unit of time between 1 and 2, or falls: mass 1 needs that much force, friction holds 1 or 3."""
    for side in (1, -1):
        belt = Ramp(np.array([1.0, 2.0]), side * np.array([[0.0], [2.0]]))
        weak = follow(Case.of([[0.0]], 0, 1, belt, 0, 0), 4.0)
        assert (weak.t, weak.mode) == ([1.0, pytest.approx(3.0, abs=1e-13)], [-side, 0])  # w = t - 1 meets v = 2
        assert weak.z == pytest.approx([side * (2.0 + 2.0)], abs=1e-13)
        held = follow(Case.of([[0.0]], 0, 3, belt, 0, 0), 4.0)
        assert held.t == []
        assert held.z == pytest.approx([side * (1.0 + 4.0)], abs=1e-13)


def test_a_force_that_rises_moves_a_block_when_it_passes_static_friction():
    """f = t / 2 on a belt at rest: static friction 1.5 until t = 3, then w' = f - 1."""
    push = Ramp(np.array([0.0, 8.0]), np.array([[0.0], [4.0]]))
    path = follow(Case.of([[0.0]], 0, 1, 0, 0, 0, 1.5, push=push), 5.0)
    assert (path.t, path.mode) == ([pytest.approx(3.0, abs=1e-13)], [1])
    assert path.w == pytest.approx([(5.0**2 - 3.0**2) / 4 - 2.0], abs=1e-12)


@pytest.mark.parametrize("mass", [1.0, 2.5])
def test_a_block_that_weakening_friction_stops(mass):
    """m u' = -1 / (1 + a u), or -(1 + d exp(-u / s)): u + a u^2 / 2, or s ln(exp(u / s) + d), falls by t / m."""
    u, a, d, s = 2.0, 3.0, 0.5, 0.7
    rational = follow(Case.of([[0.0]], 0, 1, -0.2, 0, u - 0.2, mass=mass, falls=("rational", a)), 40.0)
    assert (rational.t, rational.mode) == ([pytest.approx(mass * (u + a * u**2 / 2), abs=1e-12)], [0])
    falls = ("exponential", s)
    exponential = follow(Case.of([[0.0]], 0, 1, -0.2, 0, u - 0.2, 1 + d, mass=mass, falls=falls), 40.0)
    t = mass * s * np.log((np.exp(u / s) + d) / (1 + d))
    assert (exponential.t, exponential.mode) == ([pytest.approx(t, abs=1e-12)], [0])


def test_a_block_that_may_not_slip_ahead_is_held_there_and_leaves_behind():
    """K = 1, v = 1, no damping: carried from z = -5 to F = 1, behind through half a circle and back to the belt."""
    path = follow(Case.of([[1.0]], 0, 1, 1, -5, 1, back_slip=False), 20.0)
    assert listed(path) == [(6.0, 0, -1)]
    path = follow(Case.of([[1.0]], 0, 1, 1, -5, 1, 1.5, back_slip=False), 12.0)
    slip = 2 * (np.pi - np.arctan(0.5))
    assert listed(path) == [(6.5, 0, -1), (6.5 + slip, 0, 0)]
