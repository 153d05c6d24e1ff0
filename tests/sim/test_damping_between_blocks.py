"""A full damping matrix C = diag(R) + N under the exact law: F = R v + K z + N w.

Against `tests/independent.py`, closed forms, own return maps and the balance of energy.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csc_array

from stickslip.sim import Stribeck, System, simulate
from stickslip.sim.attractors import attractor, continued
from stickslip.sim.energy import energy
from stickslip.sim.engines.coulomb.settings import Coulomb
from tests.independent import Case, follow
from tests.systems import draw_case, made

TERMS = ("static", "force", "belt", "mass", "weakening", "back_slip")


def laplacian(springs):
    """Of a chain whose neighbours are tied by these springs, or dashpots."""
    ends = np.append(springs, 0.0), np.append(0.0, springs)
    return np.diag(sum(ends)) - np.diag(springs, 1) - np.diag(springs, -1)


def listed(path):
    return list(zip(path.block, path.mode, strict=True))


def test_a_sparse_matrix_that_lists_entries_twice_and_out_of_order_stays_as_it_is():
    """It is summed and sorted in a copy."""
    data, rows, ends = np.array([3.0, 1.0, 2.0, 0.5, 4.0]), np.array([1, 0, 1, 0, 1]), np.array([0, 3, 5])
    matrix = csc_array((data.copy(), rows.copy(), ends.copy()), (2, 2))
    system = System(np.eye(2), matrix, 1.0, -0.2)
    np.testing.assert_array_equal(system.damping_matrix.toarray(), [[1.0, 0.5], [5.0, 4.0]])
    np.testing.assert_array_equal(matrix.data, data)
    np.testing.assert_array_equal(matrix.indices, rows)
    np.testing.assert_array_equal(matrix.indptr, ends)


@pytest.mark.parametrize("number", range(8))
def test_against_an_engine_that_shares_no_code(number):
    """Each event in turn, and the state at the end; every other draw with all terms."""
    rng = np.random.default_rng([number, 60])
    case = draw_case(rng, (2, 6), "antisymmetric", damping=(0.0, 1.0), terms=TERMS if number % 2 else ())
    case = replace(case, cross=0.3 * rng.normal(size=(case.n, case.n)) * (1 - np.eye(case.n)))
    path = follow(case, 8.0)
    scale = np.abs(path.z).max() + np.abs(path.w).max() + 1.0
    for is_sparse in (False, True):
        run = simulate(made(case, is_sparse), case.z0, case.w0, 8.0, tol=1e-12, stop_early=False)
        assert [*zip(run.events.block.tolist(), run.events.mode.tolist(), strict=True)] == listed(path)
        np.testing.assert_allclose(run.events.t, path.t, rtol=0, atol=1e-8)
        np.testing.assert_allclose(np.append(run.z, run.w), np.append(path.z, path.w), rtol=0, atol=1e-9 * scale)


@pytest.mark.parametrize("static", [1.0, 1.3])
def test_local_updates_of_a_chain_are_those_of_all_blocks(static, rng):
    n = 48
    stiffness, damping = laplacian(rng.uniform(0.5, 2.0, n - 1)), laplacian(rng.uniform(0.1, 0.6, n - 1))
    z0 = rng.uniform(-2.0, 2.0, n)
    systems = [
        System(form(stiffness + 0.3 * np.eye(n)), form(damping + 0.1 * np.eye(n)), 1.0, -0.3, static)
        for form in (np.array, csc_array)
    ]
    whole, local = (simulate(system, z0, -0.3, 4.0, tol=1e-11, stop_early=False) for system in systems)
    assert local.stats.n_products < 0.5 * whole.stats.n_products
    np.testing.assert_array_equal(local.events.block, whole.events.block)
    np.testing.assert_allclose(local.events.t, whole.events.t, rtol=0, atol=1e-9)
    np.testing.assert_allclose(local.w, whole.w, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("drag", "leaves"), [(1.0, True), (3.0, False)])
def test_an_exit_that_another_makes_at_the_same_instant(drag, leaves):
    """Both have F = -m at t = 1; block 0 leaves with w' = 0.5, and so F_1' = -1 + drag / 2 decides block 1."""
    system = System(np.eye(2), [[0.0, 0.0], [drag, 0.0]], [0.5, 1.0], -1.0, static=[1.0, 1.0])
    run = simulate(system, [0.0, drag], -1.0, 1.5, tol=1e-12, stop_early=False)
    assert run.events.t[:1] == pytest.approx([1.0], abs=1e-12)
    at_once = run.events.block[run.events.t < 1.0 + 1e-9].tolist()
    assert at_once == ([0, 1] if leaves else [0])
    path = follow(Case.of(np.eye(2), system.damping_matrix, [0.5, 1.0], -1.0, [0.0, drag], -1.0, [1.0, 1.0]), 1.5)
    assert [*zip(run.events.block.tolist(), run.events.mode.tolist(), strict=True)] == listed(path)
    np.testing.assert_allclose(run.w, path.w, rtol=0, atol=1e-10)


def test_flutter_of_two_degrees_of_freedom_begins_at_the_bound_of_hurwitz():
    """x^4 + a_3 x^3 + a_2 x^2 + a_1 x + a_0 has all roots on the left if a_3 a_2 a_1 > a_1^2 + a_3^2 a_0."""
    c = np.array([[0.2, -0.1], [-0.05, 0.15]])

    def margin(s):
        k = np.array([[2.0, -s], [0.6 * s, 1.5]])
        a3, a2, a0 = np.trace(c), np.trace(k) + np.linalg.det(c), np.linalg.det(k)
        a1 = c[0, 0] * k[1, 1] + c[1, 1] * k[0, 0] - c[0, 1] * k[1, 0] - c[1, 0] * k[0, 1]
        return a3 * a2 * a1 - a1**2 - a3**2 * a0

    low, high = 0.0, 2.0
    assert margin(low) > 0.0 > margin(high)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if margin(middle) > 0.0 else (low, middle)
    outcomes = []
    for s in (low * 0.9999, low * 1.0001):
        system = System([[2.0, -s], [0.6 * s, 1.5]], c, 1.0, -1.0)
        start = system.rest_state([1, 1])
        run = simulate(system, start + np.array([1e-3, 0.0]), 0.0, 50.0, stop_early="always")
        outcomes.append(run.outcome)
    assert outcomes == ["collapsed", "finished"]


@pytest.mark.parametrize("terms", [{}, {"mass": [1.5, 0.8, 1.0], "force": [0.1, 0.0, -0.2]}])
def test_a_cycle_has_the_period_and_the_multiplier_of_its_return_map(terms):
    """By the independent engine, from half way between two events, in central differences."""
    k, c = laplacian([1.0, 0.7]) + np.diag([1.0, 0.8, 1.2]), laplacian([0.08, 0.15]) + 0.02 * np.eye(3)
    c[0, 2] = 0.05
    system = System(csc_array(k), csc_array(c), 0.5, -0.3, static=[1.0, 0.9, 0.8], **terms)
    run = simulate(system, [0.5, -0.3, 0.8], -0.3, 400.0, tol=1e-11)
    cycle = attractor(run, system, 200.0, tol=1e-11)
    assert cycle.kind == "periodic"
    own = {"push" if name == "force" else name: value for name, value in terms.items()}
    case = Case.of(k, c, 0.5, -0.3, cycle.states.z[0], cycle.states.w[0], [1.0, 0.9, 0.8], **own)
    path = follow(case, cycle.period)
    edges = np.array([0.0, *path.t, cycle.period])
    longest = int(np.argmax(np.diff(edges)))
    z, w = (part[0] for part in path.at(0.5 * (edges[longest] + edges[longest + 1])))
    sticks = np.abs(w + 0.3) < 1e-9
    x, free = np.append(z, np.where(sticks, -0.3, w)), np.flatnonzero(np.append(np.full(3, True), ~sticks))

    def once(start):
        path = follow(replace(case, z0=start[:3], w0=start[3:]), cycle.period)
        return np.append(path.z, path.w)

    np.testing.assert_allclose(once(x), x, rtol=0, atol=1e-8)
    shifts = 1e-6 * np.identity(6)[free]
    matrix = np.array([(once(x + shift) - once(x - shift))[free] / 2e-6 for shift in shifts]).T
    multipliers = np.linalg.eigvals(matrix)
    others = np.delete(multipliers, np.argmin(np.abs(multipliers - 1.0)))
    assert cycle.multiplier == pytest.approx(np.abs(others).max(), abs=1e-5)


@pytest.mark.parametrize("is_sparse", [False, True])
def test_the_balance_of_energy(is_sparse, rng):
    case = draw_case(rng, 5, "symmetric", damping=(0.1, 1.0), terms=TERMS)
    case = replace(case, cross=0.2 * rng.normal(size=(5, 5)) * (1 - np.eye(5)))
    system, settings = made(case, is_sparse), {"tol": 1e-13, "stop_early": False}
    run = simulate(system, case.z0, case.w0, 10.0, **settings)
    found = energy(system, run, case.z0, case.w0, **settings)
    turnover = sum(np.abs(getattr(found, name)).max() for name in ("kinetic", "elastic", "belt", "outside", "heat"))
    assert np.abs(found.imbalance).max() < 1e-9 * turnover


def test_a_sparse_damping_matrix_is_the_dense_one():
    c = np.array([[1.0, 0.5, 0.0], [-0.25, 2.0, 0.0], [0.0, 0.0, 0.0]])
    dense, sparse = System(np.eye(3), c), System(csc_array(np.eye(3)), csc_array(c))
    for name in ("damping", "cross_sums", "rates", "least_damping"):
        np.testing.assert_array_equal(getattr(sparse, name), getattr(dense, name))
    halved = sparse.changed(mass=2.0).of_unit_mass.cross_damping
    np.testing.assert_array_equal(halved.toarray(), 0.5 * dense.cross_damping)
    np.testing.assert_array_equal(sparse.damping_matrix.toarray(), c)
    assert System(np.eye(2), csc_array(np.eye(2))).cross_damping is None
    with pytest.raises(ValueError, match=r"damping: expected a matrix of shape \(2, 2\), got shape \(3, 3\)"):
        System(np.eye(2), csc_array(c))


def test_the_force_of_damping_is_that_of_the_matrix(rng):
    for form in (np.asarray, csc_array):
        c, w = rng.normal(size=(4, 4)), rng.normal(size=(3, 2, 4))
        for system in (System(np.eye(4), form(c)), System(np.eye(4), np.diag(c))):
            matrix = c if system.cross_damping is not None else np.diag(np.diag(c))
            np.testing.assert_allclose(system.damping_force(w), w @ matrix.T, rtol=1e-14, atol=1e-14)
            np.testing.assert_allclose(system.damping_force(w[0, 0]), matrix @ w[0, 0], rtol=1e-14, atol=1e-14)


def test_no_motion_is_faster_than_the_rate_whichever_blocks_slip(rng):
    """And it is far below the sum of a row where entries of a dense C differ in sign."""
    n = 60
    c = 3.0 * rng.normal(size=(n, n))
    system = System(rng.normal(size=(n, n)), c)
    for slips in (np.full(n, True), *(rng.random((5, n)) < 0.5)):
        both = np.append(slips, slips)
        fastest = np.abs(np.linalg.eigvals(system.slip_matrix()[np.ix_(both, both)])).max()
        assert fastest <= system.fastest_rate
    assert system.fastest_rate < 0.5 * np.abs(c).sum(axis=1).max()


def test_steady_sliding_of_two_tied_blocks_lasts_to_its_bound_in_closed_form():
    """Their common motion is damped by a - b, and friction falls with speed: R_common > exp(-v / 0.5)."""
    a, b = 0.3, 0.2
    tied = System(np.eye(2), [[a, -b], [-b, a]], 0.5, 1.5, static=1.0, weakening=Stribeck(0.5))
    speeds = np.array([2.0, 1.6, 1.3, 1.2, 1.1])
    fates = continued([tied.changed(belt_speed=v) for v in speeds], 0.5, 0.0, t_end=1500.0, t_burn=1000.0)
    least = 0.5 * np.log(1.0 / (a - b))
    assert [one.kind == "sliding" for one in fates] == [v > least for v in speeds]


def test_series_run_what_damping_couples():
    """F has kinks where others stick or let go: no system of waves."""
    n = 300
    plain = System(np.eye(n) + 0.01, 0.5)
    assert Coulomb(tol=1e-5).is_by_waves(plain)
    assert not Coulomb(tol=1e-5).is_by_waves(plain.changed(damping=np.eye(n) + 0.01))
