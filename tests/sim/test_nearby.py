"""The exact engine where K is sparse beside the same K kept dense, whose steps share no search of events with it."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from stickslip import Harmonic, System, draw_system, simulate

TOL, T = 1e-11, 20.0


def pair(rng):
    """A chain, ring, grid or network, damped or not, with one friction or two, at rest on the belt or not."""
    n = int(rng.choice([3, 8, 40, 100]))
    coupling = str(rng.choice(["chain", "ring", "grid"] if n == 100 else ["chain", "ring"]))
    drawn = draw_system(
        coupling,
        n=n,
        seed=int(rng.integers(2**31)),
        kappa=float(rng.uniform(0.3, 3.0)),
        leaf=float(rng.uniform(0.05, 1.0)),
        damping=float(rng.choice([0.0, 0.1, 3.0])),
        belt_speed=float(rng.choice([-0.3, 0.1])),
    )
    static = rng.uniform(1.0, 1.6, n) if rng.random() < 0.6 else None
    kept = drawn.changed(static=static, friction=rng.uniform(0.7, 1.0, n))
    dense = System(kept.stiffness.toarray(), kept.damping, kept.friction, kept.belt_speed, static)
    w0 = kept.belt_speed if rng.random() < 0.5 else rng.uniform(-0.5, 0.5, n)
    return kept, dense, rng.uniform(-1.0, 1.0, n), w0


def by_block(run):
    return (
        run.events.block[run.events.by_block],
        run.events.mode[run.events.by_block],
        run.events.t[run.events.by_block],
    )


@pytest.mark.parametrize("trial", range(4))
def test_sparse_and_dense_have_the_same_events(trial, rng):
    sparse, dense, z0, w0 = pair(rng)
    few, all_ = (simulate(system, z0, w0, T, tol=TOL, stop_early=False) for system in (sparse, dense))
    (blocks, modes, times), (others, wanted, known) = by_block(few), by_block(all_)
    np.testing.assert_array_equal(blocks, others)
    np.testing.assert_array_equal(modes, wanted)
    np.testing.assert_allclose(times, known, atol=1e-6)  # tol, and what T amplifies it by
    np.testing.assert_allclose(few.z, all_.z, atol=1e-6)


@pytest.mark.parametrize(("coupling", "n", "force"), [("grid", 49, None), ("chain", 70, 1.3)])
def test_sparse_and_dense_have_the_same_events_where_many_are_tied_or_a_force_acts(coupling, n, force, rng):
    """More are tied to an event than a local update takes; under a force there is none, but K is read by columns."""
    sparse = draw_system(coupling, n=n, seed=1, kappa=1.0, leaf=0.3, damping=0.1, belt_speed=-0.3)
    if force:
        sparse = sparse.changed(force=Harmonic(0.3 * rng.normal(size=n), force))
    dense, z0 = sparse.changed(stiffness=sparse.stiffness.toarray()), rng.uniform(-1.0, 1.0, n)
    few, all_ = (simulate(system, z0, -0.1, 5.0, tol=TOL, stop_early=False) for system in (sparse, dense))
    (blocks, modes, times), (others, wanted, known) = by_block(few), by_block(all_)
    assert (blocks.tolist(), modes.tolist()) == (others.tolist(), wanted.tolist())
    assert len(blocks) > n
    np.testing.assert_allclose(times, known, atol=1e-8)
    np.testing.assert_allclose(few.z, all_.z, atol=1e-9)


def test_what_rests_at_its_bound_leaves_with_the_block_that_it_is_tied_to():
    """Three in a row on a belt at rest: F of the first is -mu until the second leaves, pulled by the third.

    That one moves from 1 at the speed 4, friction and a force of z - 1 from the second against it.
    """
    stiffness = np.array([[1.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    start = np.array([-1.0, 0.0, 1.0]), np.array([0.0, 0.0, 4.0])
    for k in (stiffness, csr_array(stiffness)):
        system = System(k, 0.0, 1.0, 0.0)
        run = simulate(system, *start, 0.6, tol=TOL)
        # z = -1 + 2 cos t + 4 sin t comes to 2, where F of the second is -mu
        leaves = np.arctan2(4.0, 2.0) - np.arccos(3.0 / np.sqrt(20.0))
        np.testing.assert_allclose(run.events.t, [leaves, leaves], atol=1e-9)
        assert sorted(run.events.block) == [0, 1]
        assert run.events.mode.tolist() == [1, 1]


def test_no_certificate_is_asked_of_many_blocks(monkeypatch):
    """With more than 500 the eigenvalues would cost more than the run."""
    monkeypatch.setattr(np.linalg, "eig", lambda _: pytest.fail("it was asked"))
    chain = draw_system("chain", 501, seed=1, kappa=1.0, leaf=0.3, damping=2.0)
    run = simulate(chain, -0.7, -0.4, 40.0, tol=1e-6)
    assert (run.outcome, run.events.mode_at(40.0).all()) == ("finished", True)
