"""Starts and systems on the edge: folds, cusps, tangencies, twins, no friction, no stiffness, no belt."""

import numpy as np
import pytest
import scipy.sparse
from scipy.linalg import expm

from stickslip.sim import Stribeck, System, draw_system, simulate
from stickslip.sim.engines import certificates
from tests.independent import Case, follow

EXACT = {"tol": 1e-15, "stop_early": False}


def listed(run):
    return [(float(t), int(i), int(m)) for t, i, m in zip(*run_arrays(run), strict=True)]


def run_arrays(run):
    return run.events.t, run.events.block, run.events.mode


def assert_follows_reference(system, z0, w0, t_end):
    case = Case.of(system.stiffness, system.damping, system.friction, system.belt_speed, z0, w0)
    expected = follow(case, t_end)
    run = simulate(system, z0, w0, t_end, **EXACT)
    assert tuple(run.events.initial_mode) == expected.initial_mode
    assert run.events.block.tolist() == expected.block
    assert run.events.mode.tolist() == expected.mode
    np.testing.assert_allclose(run.events.t, expected.t, rtol=0, atol=1e-10)
    np.testing.assert_allclose(run.z, expected.z, rtol=0, atol=1e-10)
    np.testing.assert_allclose(run.w, expected.w, rtol=0, atol=1e-10)
    return expected


# A block that starts on the belt. One block: F = R v + K z, F' = K v.


@pytest.mark.parametrize(
    ("force", "mode"),
    [(0.0, 0), (0.99, 0), (-0.99, 0), (1.01, -1), (-1.01, 1)],
    ids=["centre", "inside above", "inside below", "beyond above", "beyond below"],
)
def test_one_block_on_the_belt(force, mode):
    system = System([[0.5]], 0.25, belt_speed=-0.5)
    z0 = (force + 0.125) / 0.5
    assert assert_follows_reference(system, z0, -0.5, 3.0).initial_mode == (mode,)


@pytest.mark.parametrize("v", [-0.5, 0.5])
def test_a_block_without_friction_on_the_belt_goes_to_the_side_to_which_its_force_will_pull(v):
    """F = 0 = m: the first derivative of F decides between both sides. z = v sin t."""
    run = simulate(System([[1.0]], 0.0, 0.0, v), 0.0, v, 3.0, **EXACT)
    assert (run.events.initial_mode.tolist(), listed(run)) == ([-np.sign(v)], [])
    assert (run.z[0], run.w[0]) == pytest.approx((v * np.sin(3.0), v * np.cos(3.0)), abs=1e-13)


def test_a_force_beyond_mu_by_more_than_rounding_lets_go():
    """F - mu = e: e'' = -k e from e = 2e-13, e' = k v, on a belt so slow that it takes a while."""
    k, v = 0.5, -2e-13
    run = simulate(System([[k]], 0.0, 1.0, v), (1 + 2e-13) / k, v, 5.0, **EXACT)
    assert run.events.initial_mode.tolist() == [-1]
    # w - v = -(integral of e) is back at 0 where tan(sqrt(k) t / 2) = 2 sqrt(k); z itself is known to 500 ulps
    assert listed(run)[0] == (pytest.approx(2 / np.sqrt(k) * np.arctan(2 * np.sqrt(k)), rel=1e-2), 0, 0)


@pytest.mark.parametrize(("stiffness", "v"), [(0.5, -0.5), (0.5, 0.5), (-0.5, -0.5), (-0.5, 0.5)])
@pytest.mark.parametrize("side", [-1, 1])
def test_one_block_at_its_fold_leaves_if_the_force_grows(stiffness, v, side):
    z0 = (side - 0.25 * v) / stiffness  # F = side exactly: every number is dyadic
    expected = assert_follows_reference(System([[stiffness]], 0.25, belt_speed=v), z0, v, 2.0)
    assert expected.initial_mode == (-side if side * stiffness * v > 0 else 0,)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("acceleration", [-0.5, 0.0, 0.5])
@pytest.mark.parametrize("jerk", [-1, 1])
def test_tangency_and_cusp(side, acceleration, jerk):
    """F_1 = side mu and F_1' = 0 at the start; F_1'' = -w_2'/2, and where that vanishes F_1''' = -w_2''/2 decides."""
    z2, w2 = 0.5, -2.0  # block 2 slips left
    z1 = side + 0.25 + 0.5 * z2  # F_1 = -0.25 + z1 - z2 / 2
    # w_2' = -R_2 w_2 - c z1 - d z2 + mu_2 and w_2'' = -R_2 w_2' + c + 2 d
    c = 0.25 * jerk
    mu2 = 1.0
    d = (mu2 + 2 * 0.125 - c * z1 - acceleration) / z2
    system = System([[1.0, -0.5], [c, d]], [0.25, 0.125], [1.0, mu2], -1.0)
    turn = -0.5 * acceleration if acceleration != 0 else -0.5 * (c + 2 * d)
    assert turn != 0
    expected = assert_follows_reference(system, [z1, z2], [-1.0, w2], 1.5)
    assert expected.initial_mode == (-side if side * turn > 0 else 0, -1)


def test_a_force_that_rests_at_its_bound_holds():
    """K (1, 1) = 0: two blocks ride with F_1 = mu for ever."""
    system = System([[1.0, -1.0], [-1.0, 1.0]], 0.0, [1.0, 1.0], -0.5)
    run = simulate(system, [1.0, 0.0], -0.5, 1000.0, **EXACT)
    assert run.events.initial_mode.tolist() == [0, 0]
    assert len(run.events) == 0
    np.testing.assert_allclose(run.z, [-499.0, -500.0], rtol=1e-14)


@pytest.mark.parametrize("coupling", [0.0, 0.25])
def test_two_blocks_that_reach_their_bounds_at_one_instant_both_leave(coupling):
    """Riding at v = -1/2, F = K z falls to -1 at t = 2 in both; all numbers are dyadic. A third swings on its own."""
    pair = np.array([[1.0, coupling], [coupling, 0.5]])
    stiffness = np.diag([1.0, 0.5, 1 / 64])
    stiffness[:2, :2] = pair
    z0 = np.append(np.linalg.solve(pair, [-1.0, -1.0]) + 1.0, 1.0)
    run = simulate(System(stiffness, 0.0, [1.0, 1.0, 0.0], -0.5), z0, [-0.5, -0.5, 1.0], 2.5, **EXACT)
    t, block, mode = run_arrays(run)
    assert (run.events.initial_mode.tolist(), block.tolist(), mode.tolist()) == ([0, 0, 1], [0, 1], [1, 1])
    np.testing.assert_allclose(t, 2.0, rtol=1e-15)
    assert run.events.change_points()[1].tolist() == [2, 0]


# Mirror images


@pytest.mark.parametrize("store", [np.asarray, scipy.sparse.csr_array])
def test_a_mirror_image_has_the_same_bytes_where_either_edge_of_friction_may_come_first(rng, store):
    """Without damping, and with K of a few entries, both edges have a root within a step."""
    n_events = 0
    for _ in range(60):
        n = int(rng.integers(2, 6))
        stiffness = np.triu(rng.normal(size=(n, n)) * (rng.random((n, n)) < 0.5), 1)
        system = System(store(stiffness), 0.0, rng.random(n), 0.0)
        z, w = 3 * rng.normal(size=n), rng.normal(size=n)
        run, mirror = simulate(system, z, w, 5.0, tol=1e-10), simulate(system, -z, -w, 5.0, tol=1e-10)
        assert run.events.t.tolist() == mirror.events.t.tolist()
        assert run.events.block.tolist() == mirror.events.block.tolist()
        np.testing.assert_array_equal(run.z, -mirror.z)
        n_events += len(run.events)
    assert n_events > 60


# Where a run begins and ends


@pytest.mark.parametrize("engine", ["coulomb", "sigmoid"])
def test_no_time_at_all(engine):
    run = simulate(System(np.eye(2), 0.1), [1.0, 0.0], [0.5, -0.2], 3.0, t_start=3.0, engine=engine)
    assert (run.outcome, run.t_end, len(run.events)) == ("finished", 3.0, 0)
    assert run.events.initial_mode.tolist() == [1, 0]
    assert run.n_stick(3.0) == 1
    np.testing.assert_array_equal(run.z, [1.0, 0.0])
    np.testing.assert_array_equal(run.w, [0.5, -0.2])


def test_an_event_at_the_end_belongs_to_the_run():
    """w = 3 - 2 t reaches v = -1 at t = 2 exactly."""
    system = System([[0.0]], 0.0, 2.0, -1.0)
    run = simulate(system, 0.0, 3.0, 2.0, **EXACT)
    assert listed(run) == [(2.0, 0, 0)]
    assert run.n_stick([np.nextafter(2.0, 0), 2.0]).tolist() == [0, 1]
    resumed = simulate(system, run.z, run.w, 4.0, t_start=2.0, **EXACT)
    assert resumed.events.initial_mode.tolist() == [0]  # what happened at t_start is not told twice
    assert len(resumed.events) == 0


@pytest.mark.parametrize("engine", ["coulomb", "sigmoid"])
def test_divergence_is_an_outcome_and_the_series_ends_there(engine):
    system = System([[-4.0]], 0.0, 1.0, -0.2)
    run = simulate(system, 3.0, 0.0, 50.0, engine=engine)
    assert run.outcome == "diverged"
    assert "grows at the rate 2 " in run.reason
    assert run.t_end < 50
    assert run.events.t_end == run.t_end
    assert np.isfinite(run.z).all()
    assert np.isfinite(run.w).all()
    with pytest.raises(ValueError, match="times"):
        run.n_stick(run.t_end + 1)


@pytest.mark.parametrize("engine", ["coulomb", "sigmoid"])
def test_a_run_that_is_to_go_on_ends_only_where_numbers_do(engine):
    """z'' = 4 z - mu: exp(2 t) at t = 50 is 1e43, at t = 200 1e174."""
    system = System([[-4.0]], 0.0, 1.0, -0.2)
    run = simulate(system, 3.0, 0.0, 50.0, engine=engine, stop_early=False)
    assert (run.outcome, run.t_end, run.reason) == ("finished", 50.0, "")
    assert run.z[0] == pytest.approx((3.0 - 0.25) * np.cosh(100.0), rel=1e-3)
    far = simulate(system, 3.0, 0.0, 200.0, engine=engine, stop_early=False)
    assert (far.outcome, "block 0" in far.reason) == ("diverged", True)
    assert "block 0 passed 1e+100 at" in far.reason
    assert 110 < far.t_end < 120


@pytest.mark.parametrize("weakening", [None, Stribeck(0.3)])
@pytest.mark.parametrize(("engine", "tol"), [("coulomb", 1e-8), ("sigmoid", 1e-5)])
def test_blocks_that_swing_for_ever_wider_are_followed_to_where_numbers_end(rng, engine, tol, weakening):
    """With |w| they pass their belts in no time, and are linear to rounding: friction is no part of 1e20."""
    n = int(rng.integers(1, 4))
    springs = rng.normal(size=(n, n))
    system = System(springs @ springs.T + np.eye(n), -1.0, 1.0, 0.0, static=1.5, weakening=weakening)
    times = np.arange(0.0, 430.0, 5.0)
    run = simulate(system, rng.uniform(2, 4, n), 0.0, 1000.0, t_eval=times, engine=engine, stop_early=False)
    assert (run.outcome, "passed 1e+100" in run.reason) == ("diverged", True)
    assert 420 < run.t_end < 500
    state = np.hstack([run.samples.z, run.samples.w])
    large = np.abs(state).max(axis=1) > 1e13
    expected = state @ expm(5.0 * system.slip_matrix()).T
    error = np.abs(state[1:] - expected[:-1]).max(axis=1) / np.abs(state[1:]).max(axis=1)
    assert large.sum() > 60
    assert error[large[:-1]].max() < tol


def test_riding_the_belt_is_no_escape():
    """Blocks that stick for ever go as far as the belt does; one of them would grow if it slipped."""
    system = System(np.zeros((2, 2)), (0.0, -0.01), (1.0, 5.0), -0.2)
    for stop_early in (True, False):
        run = simulate(system, 0.0, -0.2, 1e7, stop_early=stop_early)
        assert (run.outcome, run.t_end, run.n_stick(1e7)) == ("finished", 1e7, 2)
        np.testing.assert_allclose(run.z, -2e6, rtol=1e-12)


def test_the_escape_of_one_block_is_certified_where_friction_can_no_longer_hold_it():
    """z'' = 4 z - mu lambda: the mode c = 2 z + w grows for ever once |c| > mu / 2; it is first asked for at 30."""
    system = System([[-4.0]], 0.0, 100.0, -0.2)
    assert certificates.escape(system, np.array([20.0]), np.array([9.0])) == ""  # c = 49
    assert "1.02 times" in certificates.escape(system, np.array([20.0]), np.array([11.0]))  # c = 51


@pytest.mark.parametrize(("n", "damping"), [(20, 0.1), (12, 0.01)])
def test_modes_that_are_almost_one_are_no_proof_of_escape(n, damping):
    """A chain coupled one way: all eigenvalues have the real part -R / 2; as n are one, rounding makes some > 0."""
    system = System(np.eye(n) - np.eye(n, k=-1), damping, 1.0, -0.2)
    assert np.linalg.eigvals(system.slip_matrix()).real.max() > 0
    assert not certificates.grows(system)
    assert certificates.escape(system, 1e6 * np.cos(np.arange(n)), np.zeros(n)) == ""
    run = simulate(system, np.cos(np.arange(n)), 0.0, 300.0)
    assert (run.outcome, run.t_end) == ("finished", 300.0)


@pytest.mark.parametrize("n", [2, 5])
def test_free_blocks_that_drift_do_not_escape(n):
    """A chain tied to nothing, without friction or damping: its centre moves on at its speed."""
    stiffness = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    stiffness[0, 0] = stiffness[-1, -1] = 1
    z0 = 0.1 * np.arange(n) ** 2
    run = simulate(System(stiffness, 0.0, 0.0, -0.2), z0, 1.0, 200.0)
    assert run.outcome == "finished"
    assert run.z.mean() == pytest.approx(z0.mean() + 200.0)


def test_what_is_certain_to_escape_never_comes_back():
    """`full` diverges at n = 20 (AUDIT, section 4): followed on, the certified mode grows all the way."""
    system = draw_system("full", 20, 0)
    certain = simulate(system, -0.7, -0.4, 2000.0)
    assert (certain.outcome, "grows at the rate" in certain.reason) == ("diverged", True)
    t_far = certain.t_end + 10.0 / np.linalg.eigvals(system.slip_matrix()).real.max()
    times = np.linspace(certain.t_end, t_far, 200)[:-1]
    later = simulate(system, -0.7, -0.4, t_far, t_eval=times, stop_early=False).samples
    rates, modes = np.linalg.eig(system.slip_matrix())
    size = np.abs(np.linalg.solve(modes, np.hstack([later.z, later.w]).T))
    held = np.abs(np.linalg.inv(modes)[:, 20:]).sum(axis=1)
    growing = [j for j in range(40) if rates[j].real > 0 and size[j, 0] * rates[j].real > 1.01 * held[j]]
    assert growing
    assert all((np.diff(size[j]) > 0).all() for j in growing)


def test_a_distant_end_hides_no_event():
    """Block 1 is free and at rest; block 2 has w = 1 - t."""
    run = simulate(System(np.zeros((2, 2)), 0.0, [0.0, 1.0], 0.0), 0.0, [0.0, 1.0], 1e12)
    assert listed(run) == [(pytest.approx(1.0), 1, 0)]


def test_events_of_one_time_are_in_order_of_the_blocks():
    system = System(np.eye(2), 0.1, 1.0, -0.2)
    run = simulate(system, [-0.5 + 1e-12, -0.5], -0.2, 1e6 + 20, t_start=1e6, stop_early=False)
    assert run.events.t[0] == run.events.t[1]
    assert run.events.block.tolist() == [0, 1]


@pytest.mark.parametrize("form", ["csr", "csc", "coo"])
def test_a_sparse_matrix_whose_entries_are_in_any_order_is_left_alone(form, rng):
    entries, (rows, columns) = rng.uniform(1.0, 2.0, 6), np.array([[3, 0, 2, 0, 1, 3], [0, 0, 0, 0, 1, 1]])
    dense = np.zeros((4, 4))
    np.add.at(dense, (rows, columns), entries)
    order = np.lexsort((-columns, rows))  # of compressed rows, each from its end
    indptr = np.searchsorted(rows[order], np.arange(5))
    matrix = scipy.sparse.csr_array((entries[order], columns[order], indptr), (4, 4))
    if form == "csc":
        matrix = scipy.sparse.csc_array((matrix.data, matrix.indices, matrix.indptr), (4, 4)).copy()
        dense = dense.T
    elif form != "csr":
        matrix = matrix.asformat(form)
    for _ in range(2):
        np.testing.assert_allclose(System(matrix, 0.0).stiffness.toarray(), dense, rtol=1e-15)
    np.testing.assert_allclose(matrix.toarray(), dense, rtol=1e-15)


# ---------------------------------------------------------------------------------------------- to nothing


def test_crossings_are_found_however_far_the_motion_has_decayed():
    """One block without friction on a belt at rest: it crosses every pi / omega, down to 1e-300."""
    damping, omega = 1.0, np.sqrt(1.0 - 0.25)
    run = simulate(System([[1.0]], damping, 0.0, 0.0), 1.0, 0.0, 1350.0, stop_early=False)
    gaps = np.diff(run.events.t)
    assert len(run.events) > 1340.0 / (np.pi / omega)
    np.testing.assert_allclose(gaps, np.pi / omega, rtol=1e-8)


def test_a_motion_that_has_decayed_to_nothing_goes_on(rng):
    """Two blocks that nothing holds or drives, one at rest: exp(-R t) falls below the smallest number."""
    for _ in range(3):
        damping, t_end = rng.uniform(1, 3, 2), rng.uniform(690, 760)
        run = simulate(System(np.zeros((2, 2)), damping, 0.0, 0.0), 0.0, [1.0, 0.0], t_end, stop_early=False)
        assert run.outcome == "finished"
        assert run.z == pytest.approx([1.0 / damping[0], 0.0], rel=1e-9)


def test_many_blocks_decay_beyond_what_float32_can_be_scaled_to():
    """z'' + 4 z' + 3 z = 0 of 48 alike, z = z0 exp(-t): products are in single precision while they may be."""
    times, z0 = np.linspace(1.0, 45.0, 12), 1e-290
    run = simulate(System(np.full((48, 48), 3.0 / 48), 4.0, 0.0, 0.0), z0, -z0, 45.0, t_eval=times, stop_early=False)
    assert (
        np.abs(run.samples.z - z0 * np.exp(-times)[:, np.newaxis]).max() < 1e-300
    )  # the least error that is allowed


@pytest.mark.parametrize("engine", [{}, {"engine": "sigmoid", "eps": 0.01}])
def test_a_fast_block_does_not_run_away_for_being_fast(engine):
    """A mass of 2e-13 swings back from 1 at 2e6, far beyond its belt; the block with negative damping sticks."""
    system = System(np.identity(2), [1e-7, -1.0], [0.01, 1.0], -0.2, mass=[2e-13, 1.0])
    run = simulate(system, [1.0, 0.0], [0.0, -0.2], 3e-4, **engine)
    assert (run.outcome, run.t_end) == ("finished", 3e-4)
    assert abs(run.z[0]) < 0.01
