"""The paper's system of 200 blocks: what makes a long run believable."""

import numpy as np
import pytest

from stickslip.sim import draw_system, simulate
from stickslip.sim.systems.couplings import COUPLINGS

START = (-0.7, -0.4)


@pytest.fixture(scope="module")
def system():
    return draw_system("antisymmetric", 200, seed=1)


def test_n_stick_of_an_independent_integration(system):
    """Counts by DOP853 at 1e-12 between events located one by one, a program that shares nothing with ours."""
    run = simulate(system, *START, 50.0)
    assert run.n_stick([1, 5, 10, 20, 50]).tolist() == [86, 46, 24, 48, 35]


def test_tolerance_does_not_change_the_order_of_thousands_of_events(system):
    run, finer = (simulate(system, *START, 300.0, tol=tol) for tol in (1e-12, 1e-14))
    assert run.outcome == "finished"
    assert len(finer.events) > 2500
    np.testing.assert_array_equal(run.events.block, finer.events.block)
    np.testing.assert_array_equal(run.events.mode, finer.events.mode)
    np.testing.assert_allclose(run.events.t, finer.events.t, rtol=0, atol=1e-6)
    np.testing.assert_allclose(run.z, finer.z, rtol=0, atol=1e-6)


def test_the_structure_of_each_ensemble():
    """One seed draws one U, uniform in [-kappa, kappa], which `full` shows as it is."""
    k = {name: draw_system(name, 30, seed=2).stiffness for name in COUPLINGS}
    assert all((draw_system(name, 30, seed=2).stiffness == k[name]).all() for name in COUPLINGS)
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
