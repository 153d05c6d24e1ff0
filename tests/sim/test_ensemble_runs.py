"""The paper's system of 200 blocks: what makes a long run believable."""

import numpy as np
import pytest

from stickslip.sim import EventSeries, System, draw_system, simulate
from stickslip.sim.systems.couplings import COUPLINGS

START = (-0.7, -0.4)


@pytest.fixture(scope="module")
def system():
    return draw_system("antisymmetric", 200, seed=1)


@pytest.fixture(scope="module")
def long_run(system):
    return simulate(system, *START, 1000.0, tol=1e-12)


def assert_same_events(a: EventSeries, b: EventSeries, atol: float):
    assert len(a) == len(b)
    np.testing.assert_array_equal(a.block, b.block)
    np.testing.assert_array_equal(a.mode, b.mode)
    np.testing.assert_allclose(a.t, b.t, rtol=0, atol=atol)


def test_n_stick_of_an_independent_integration(system):
    """Counts by DOP853 at 1e-12 between events located one by one, a program that shares nothing with ours."""
    run = simulate(system, *START, 50.0)
    assert run.n_stick([1, 5, 10, 20, 50]).tolist() == [86, 46, 24, 48, 35]


def test_tolerance_does_not_change_the_order_of_ten_thousand_events(system, long_run):
    finer = simulate(system, *START, 1000.0, tol=1e-14)
    assert long_run.outcome == "finished"
    assert len(finer.events) > 9000
    assert_same_events(long_run.events, finer.events, atol=1e-6)
    assert np.abs(long_run.z - finer.z).max() < 1e-6


def test_renumbered_blocks_give_the_renumbered_run(system, long_run):
    order = np.random.default_rng(3).permutation(system.n)
    renumbered = System(system.stiffness[np.ix_(order, order)], system.damping[order])
    run = simulate(renumbered, *START, 1000.0, tol=1e-12)
    back = EventSeries(run.events.t, order[run.events.block], run.events.mode, run.events.initial_mode, 0.0, 1000.0)
    assert_same_events(long_run.events, back, atol=1e-6)
    assert np.abs(long_run.z[order] - run.z).max() < 1e-6


def test_a_run_split_in_two_is_the_run(system, long_run):
    first = simulate(system, *START, 500.0, tol=1e-12)
    second = simulate(system, first.z, first.w, 1000.0, t_start=500.0, tol=1e-12)
    np.testing.assert_array_equal(first.events.mode_at(500.0), second.events.initial_mode)
    joined = EventSeries(
        np.concatenate((first.events.t, second.events.t)),
        np.concatenate((first.events.block, second.events.block)),
        np.concatenate((first.events.mode, second.events.mode)),
        first.events.initial_mode,
        0.0,
        1000.0,
    )
    assert_same_events(long_run.events, joined, atol=1e-6)
    assert np.abs(long_run.z - second.z).max() < 1e-6


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_a_draw_is_fixed_by_its_seed_and_in_range(coupling):
    a, b, c = (draw_system(coupling, 7, seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(a.stiffness, b.stiffness)
    assert not np.array_equal(a.stiffness, c.stiffness)
    assert ((a.damping >= 3.5) & (a.damping <= 7)).all()


def test_the_structure_of_each_ensemble():
    """One seed draws one U, uniform in [-kappa, kappa], which `full` shows as it is."""
    k = {name: draw_system(name, 30, seed=2).stiffness for name in COUPLINGS}
    u, off = k["full"], ~np.eye(30, dtype=bool)
    assert 0.19 < u.max() <= 0.2
    assert -0.19 > u.min() >= -0.2
    upper = np.triu(u, 1)
    for name, expected in (
        ("antisymmetric", (u - u.T) / 2),
        ("signed_diagonal", (u - u.T) / 2),
        ("symmetric", (u + u.T) / 2),
        ("antisymmetric_triangle", upper - upper.T),
        ("springs", -np.abs(upper + upper.T)),
    ):
        np.testing.assert_array_equal(k[name][off], expected[off], name)
        if name != "springs":
            diagonal = np.diag(u) if name == "signed_diagonal" else np.abs(np.diag(u))
            np.testing.assert_array_equal(np.diag(k[name]), diagonal, name)
    np.testing.assert_allclose(k["springs"].sum(axis=1), np.abs(np.diag(u)))  # grounding springs remain
    assert np.linalg.eigvalsh(k["springs"]).min() > 0


def test_most_events_of_a_large_system_cost_no_product():
    """A window of one expansion (at least a dozen products) serves many events, and more the larger n is."""
    shares = []
    for n in (100, 800):
        system = draw_system(
            "antisymmetric", n, seed=1, kappa=0.2 * np.sqrt(200 / n)
        )  # the same strength of coupling
        stats = simulate(system, *START, 4.0, stop_early=False).stats
        assert stats.n_events > n / 2
        shares.append(stats.n_products / stats.n_events)
    assert shares[1] < 6
    assert shares[1] < shares[0] / 2
