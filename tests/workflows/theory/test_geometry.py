"""Sticking regions, folds and corners: against AUDIT's tables, closed forms, and the exact engine."""

from itertools import combinations, product
from math import comb

import numpy as np
import pytest
import scipy.sparse

from stickslip.sim import System, simulate
from stickslip.workflows.gallery.theory.folds import (
    can_stick,
    corners,
    parallelogram,
    stick_interval,
    sticking_lambda,
    two_blocks,
)
from tests.systems import draw_run

EXACT = {"tol": 1e-15, "stop_early": False}
FIGURE_2 = {"kappa1": 1.1, "kappa2": 1.6, "kappa12": 0.5, "rho": 0.1, "mu": 1.0, "v": -1.0}
ONE_BLOCK = [(3.5, 0.2, -0.2), (3.5, 0.2, 0.2), (0.1, 1.0, -0.2)]


def draw(seed, n_max=6):
    """A system of any kind of K, with independent rows."""
    rng = np.random.default_rng(seed)
    speeds = (-1.0, -0.2, 0.7)
    return draw_run(rng, (1, n_max), "full", damping=(-0.2, 2.0), friction=(0.3, 2.0), belt_speed=speeds)[0], rng


def place(system, share):
    """z at which lambda = share."""
    return np.linalg.solve(system.stiffness, -share * system.friction - system.damping * system.belt_speed)


def modes_at_once(system, z):
    """What the exact engine decides for blocks on the belt, before any time has passed."""
    return simulate(system, z, system.belt_speed, 0.0, **EXACT).events.initial_mode


# One block


@pytest.mark.parametrize(("rho", "kappa", "v"), ONE_BLOCK)
def test_stick_interval_and_exit(rho, kappa, v):
    """AUDIT, one block: z in [(-mu - rho v) / kappa, (mu - rho v) / kappa], exit at (sgn(v) mu - rho v) / kappa."""
    system = System([[kappa]], rho, belt_speed=v)
    interval = stick_interval(system)
    assert interval.low == pytest.approx((-1 - rho * v) / kappa, abs=1e-12)
    assert interval.high == pytest.approx((1 - rho * v) / kappa, abs=1e-12)
    assert interval.exit == pytest.approx((np.sign(v) - rho * v) / kappa, abs=1e-12)
    np.testing.assert_allclose(sticking_lambda(system, [[interval.low], [interval.high]])[:, 0], [1, -1], atol=1e-12)


def test_a_negative_spring_turns_the_sides_but_not_the_drift():
    interval = stick_interval(System([[-0.5]], 0.25, 1.0, -0.5))
    assert (interval.low, interval.high, interval.exit) == (-2.25, 1.75, -2.25)
    assert stick_interval(System([[-0.5]], 0.25, 1.0, 0.0)).exit is None


# Two blocks

CORNERS = [
    (+1, (1, 1), (-0.752411575562701, -0.6077170418006431)),
    (+1, (1, -1), (-0.43086816720257237, 0.4212218649517685)),
    (+1, (-1, 1), (0.5980707395498392, -0.2861736334405145)),
    (+1, (-1, -1), (0.9196141479099679, 0.7427652733118971)),
    (-1, (1, 1), (-1.3170731707317074, -0.21951219512195122)),
    (-1, (1, -1), (-3.7560975609756095, 2.707317073170732)),
    (-1, (-1, 1), (4.048780487804878, -2.658536585365854)),
    (-1, (-1, -1), (1.6097560975609757, 0.2682926829268293)),
]


@pytest.mark.parametrize(("s", "sides", "z"), CORNERS)
def test_corners_of_figure_2(s, sides, z):
    """AUDIT, table of two blocks: corner and folds of block 1, 2; {+,+} is the only double exit, {-,-} an entry."""
    (corner,) = (corner for corner in parallelogram(two_blocks(**FIGURE_2, s=s)) if corner.sides == sides)
    np.testing.assert_allclose(corner.point, z, rtol=0, atol=1e-12)
    assert corner.visibility == tuple("visible" if side > 0 else "invisible" for side in sides)


@pytest.mark.parametrize("s", [1, -1])
def test_third_derivative_at_the_corners(s):
    """AUDIT, misprints, "curvature": z_i''' = -kappa_i v with both blocks stuck, for either s (eq. 9).

    From the double exit w - v = z''' t^2 / 2 + O(t^3).
    """
    system, t = two_blocks(**FIGURE_2, s=s), 1e-4
    run = simulate(system, next(corners(system)).point, -1.0, t, **EXACT)
    np.testing.assert_allclose((run.w + 1.0) / (t**2 / 2), [1.1, 1.6], rtol=1e-3)


@pytest.mark.parametrize("s", [1, -1])
@pytest.mark.parametrize("seed", range(5))
def test_corners_by_the_corrected_formula(s, seed):
    """AUDIT, misprints, (8): the corrected corner with exits g1, g2."""
    k1, k2, k12, rho1, rho2, mu1, mu2 = np.random.default_rng(seed).uniform(0.2, 2.0, 7)
    v = -0.6
    det = k1 * k2 + s * k12 * (k1 + k2)
    for corner in corners(two_blocks(k1, k2, k12, [rho1, rho2], [mu1, mu2], v, s)):
        g1, g2 = corner.sides
        expected = -(rho1 * v + g1 * mu1) / det * np.array([k2 + s * k12, s * k12])
        expected -= (rho2 * v + g2 * mu2) / det * np.array([s * k12, k1 + s * k12])
        np.testing.assert_allclose(corner.point, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("s", [1, -1])
def test_folds_of_two_blocks(s):
    """AUDIT, misprints, section 3: (kappa1 + s kappa12) z1 - s kappa12 z2 = -+mu1 - rho1 v; 1, 2 exchanged for 2."""
    system = two_blocks(1.1, 1.6, 0.5, [0.1, 0.2], [1.0, 0.8], -1.0, s)
    for side, z2 in product((1, -1), (-2.0, 0.3)):
        z1 = (-side * 1.0 + 0.1 + s * 0.5 * z2) / (1.1 + s * 0.5)
        assert sticking_lambda(system, [z1, z2])[0] == pytest.approx(side, abs=1e-14)
        z1 = (-side * 0.8 + 0.2 + s * 0.5 * z2) / (1.6 + s * 0.5)
        assert sticking_lambda(system, [z2, z1])[1] == pytest.approx(side, abs=1e-14)


@pytest.mark.parametrize("k12", [0.5, -0.5, -0.9])
def test_the_parallelogram_runs_round_counter_clockwise(k12):
    """At kappa12 = -0.9 the determinant is negative, and lambda runs the other way."""
    system = two_blocks(1.1, 1.6, k12, 0.1, [1.0, 0.4], -1.0)
    vertices = parallelogram(system)
    x, y = np.array([corner.point for corner in vertices]).T
    assert vertices[0].sides == (1, 1)
    area = (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    # the box of forces 2 mu1 x 2 mu2, mapped by K^-1
    assert area == pytest.approx(4 * 0.4 / abs(np.linalg.det(system.stiffness)), rel=1e-12)
    np.testing.assert_allclose(x[0] + x[2], x[1] + x[3], atol=1e-12)


# Any number of blocks


@pytest.mark.parametrize("seed", range(5))
def test_membership_is_what_the_engine_holds(seed):
    system, rng = draw(seed)
    share = rng.uniform(-1.6, 1.6, (40, system.n))
    z = np.array([place(system, s) for s in share])
    np.testing.assert_allclose(sticking_lambda(system, z), share, atol=1e-9)
    inside = can_stick(system, z)
    np.testing.assert_array_equal(inside, np.abs(share) <= 1)
    for state, holds in zip(z, inside, strict=True):
        np.testing.assert_array_equal(modes_at_once(system, state) == 0, holds)


def test_lambda_of_blocks_without_friction():
    system = System(np.eye(3), 0.0, 0.0, -1.0)
    np.testing.assert_array_equal(sticking_lambda(system, [0.0, 2.0, -2.0]), [0.0, -np.inf, np.inf])
    np.testing.assert_array_equal(can_stick(system, [0.0, 2.0, -2.0]), [True, False, False])


@pytest.mark.parametrize("seed", range(8))
def test_from_a_corner_blocks_leave_whose_folds_are_visible(seed):
    system, _ = draw(seed, 4)
    for corner in corners(system):
        np.testing.assert_allclose(sticking_lambda(system, corner.point), corner.sides, atol=1e-9)
        leaves = np.array(corner.visibility) == "visible"
        np.testing.assert_array_equal(modes_at_once(system, corner.point), np.where(leaves, corner.sides, 0))


def test_counts_by_enumeration():
    """AUDIT, misprints, section 4 counts: C(r, k) 2^k strata, of dimension 2n - r - k by rank."""
    system, _ = draw(3)
    n = system.n
    velocities, forces = np.eye(2 * n)[n:], np.hstack([system.stiffness, np.diag(system.damping)])
    for r in range(n + 1):
        for k in range(r + 1):
            strata = list(product(combinations(range(r), k), product((-1, 1), repeat=k)))
            assert len(strata) == comb(r, k) * 2**k
            for blocks, _ in strata:
                conditions = np.vstack([velocities[:r], forces[list(blocks)]])
                assert 2 * n - np.linalg.matrix_rank(conditions) == 2 * n - r - k


def test_folds_that_do_not_meet():
    for stiffness, rank in (([[1.0, -1.0], [-2.0, 2.0]], 1), (np.zeros((2, 2)), 0)):
        with pytest.raises(np.linalg.LinAlgError, match=f"rank {rank} for 2 blocks"):
            parallelogram(System(stiffness, 0.1))


def test_sparse_is_dense():
    dense = two_blocks(**FIGURE_2)
    sparse = System(scipy.sparse.csr_array(dense.stiffness), 0.1, 1.0, -1.0)
    for a, b in zip(corners(dense), corners(sparse), strict=True):
        np.testing.assert_array_equal(a.point, b.point)
        assert a.visibility == b.visibility
    assert stick_interval(System(scipy.sparse.csr_array([[0.2]]), 3.5)) == stick_interval(System([[0.2]], 3.5))
    states = np.random.default_rng(0).normal(size=(5, 2))
    np.testing.assert_allclose(sticking_lambda(sparse, states), sticking_lambda(dense, states), rtol=1e-14)


@pytest.mark.parametrize("factor", [-1.0, 8.0, -0.125])
def test_mirror_and_scale(factor):
    """z and v times a factor, mu times its size: points times the factor, sides by its sign."""
    system, turn = draw(1, 4)[0], int(np.sign(factor))
    other = System(system.stiffness, system.damping, abs(factor) * system.friction, factor * system.belt_speed)
    found = {corner.sides: corner for corner in corners(other)}
    for corner in corners(system):
        image = found[tuple(turn * side for side in corner.sides)]
        np.testing.assert_allclose(image.point, factor * corner.point, rtol=1e-9, atol=1e-12)
        assert image.visibility == corner.visibility
