"""Folds, exit points and corners: against AUDIT's tables, against enumeration, and against the exact engine."""

from collections import Counter
from itertools import product

import numpy as np
import pytest
import scipy.sparse

from stickslip.sim import System, draw_system, simulate
from stickslip.workflows.gallery.theory.folds import (
    can_stick,
    drift_exit,
    folds,
    stick_interval,
    sticking_lambda,
    two_blocks,
    visibility,
)
from stickslip.workflows.gallery.theory.strata import corners, n_strata, parallelogram, strata
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


def modes_at_once(system, z, w):
    """What the exact engine decides for a start, before any time has passed."""
    return simulate(system, z, w, 0.0, **EXACT).events.initial_mode


# One block


@pytest.mark.parametrize(("rho", "kappa", "v"), ONE_BLOCK)
def test_stick_interval_and_exit(rho, kappa, v):
    """AUDIT, one block: z in [(-mu - rho v) / kappa, (mu - rho v) / kappa], exit at (sgn(v) mu - rho v) / kappa."""
    found = stick_interval(System([[kappa]], rho, belt_speed=v))
    assert found.low == pytest.approx((-1 - rho * v) / kappa, abs=1e-12)
    assert found.high == pytest.approx((1 - rho * v) / kappa, abs=1e-12)
    assert found.exit == pytest.approx((np.sign(v) - rho * v) / kappa, abs=1e-12)


@pytest.mark.parametrize(
    ("rho", "kappa", "v", "z0", "w0", "stick", "leave"),
    [
        (3.5, 0.2, -0.2, -0.7, -0.4, 0.09197880284020456, 3.9564549379897342),
        (3.5, 0.2, +0.2, -0.7, -0.4, 0.49802862992843305, 11.540118914788621),
        (0.1, 1.0, -0.2, 3.0, 1.0, 3.231881443452085, 4.104721534065557),
    ],
)
def test_one_block_leaves_at_the_time_of_the_table(rho, kappa, v, z0, w0, stick, leave):
    """AUDIT, table of one block: from where the engine has it stick, the drift ends at the exit of the table."""
    system = System([[kappa]], rho, belt_speed=v)
    end = drift_exit(system, simulate(system, z0, w0, stick, tol=1e-15).z)
    assert end.time == pytest.approx(leave - stick, abs=1e-11)
    assert end.z[0] == pytest.approx(stick_interval(system).exit, abs=1e-12)
    assert (end.blocks, end.sides) == ((0,), (-np.sign(v),))


def test_the_exit_of_figure_3s_block():
    """AUDIT, table of one block, first row: stick at z = -0.727104772970094, exit at z = -1.5."""
    system = System([[0.2]], 3.5, belt_speed=-0.2)
    assert stick_interval(system).exit == pytest.approx(-1.5, abs=1e-12)
    end = drift_exit(system, -0.727104772970094)
    assert end.time == pytest.approx(3.9564549379897342 - 0.09197880284020456, abs=1e-12)


@pytest.mark.parametrize(("rho", "kappa", "v"), ONE_BLOCK)
def test_lambda_grows_by_what_the_drift_pulls(rho, kappa, v):
    """AUDIT, one block: lambda' = -kappa v / mu; and lambda = +-1 at the ends of the interval."""
    mu = 0.7
    system = System([[kappa]], rho, mu, v)
    ends = stick_interval(system)
    first, later = sticking_lambda(system, [[0.3], [0.3 + v]])
    assert later - first == pytest.approx(-kappa * v / mu, abs=1e-12)
    np.testing.assert_allclose(sticking_lambda(system, [[ends.low], [ends.high]])[:, 0], [1, -1], atol=1e-12)


def test_a_negative_spring_turns_the_sides_but_not_the_drift():
    system = System([[-0.5]], 0.25, 1.0, -0.5)
    found = stick_interval(system)
    assert (found.low, found.high, found.exit) == (-2.25, 1.75, -2.25)
    assert drift_exit(system, 0.0).sides == (-1,)
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
KINDS = {
    (1, 1): ("exit", "visible-visible"),
    (1, -1): ("mixed", "mixed"),
    (-1, 1): ("mixed", "mixed"),
    (-1, -1): ("entry", "invisible-invisible"),
}


@pytest.mark.parametrize(("s", "sides", "z"), CORNERS)
def test_corners_of_figure_2(s, sides, z):
    """AUDIT, table of two blocks: corner and folds of block 1, 2; {+,+} is the only double exit, {-,-} an entry."""
    (corner,) = (c for c in parallelogram(two_blocks(**FIGURE_2, s=s)) if c.sides == sides)
    np.testing.assert_allclose(corner.point, z, rtol=0, atol=1e-12)
    assert corner.visibility() == tuple("visible" if side > 0 else "invisible" for side in sides)
    assert (corner.kind(), corner.two_fold()) == KINDS[sides]
    assert corner.dimension == 0


@pytest.mark.parametrize("s", [1, -1])
def test_third_derivative_at_the_corners(s):
    """AUDIT, misprints, "curvature": z_i''' = -kappa_i v with both blocks stuck, for either s (eq. 9)."""
    system = two_blocks(**FIGURE_2, s=s)
    for corner in corners(system):
        found = visibility(system, corner.point, -1.0, [0, 0])
        assert [(c.block, c.side, c.order) for c in found] == [(0, corner.sides[0], 3), (1, corner.sides[1], 3)]
        np.testing.assert_allclose([c.derivative for c in found], [1.1, 1.6], atol=1e-12)
        assert tuple(c.visibility for c in found) == corner.visibility()


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
    found = list(folds(system))
    assert [(f.block, f.side) for f in found] == [(0, 1), (0, -1), (1, 1), (1, -1)]
    for f in found:
        normal = [1.1 + s * 0.5, -s * 0.5] if f.block == 0 else [-s * 0.5, 1.6 + s * 0.5]
        np.testing.assert_allclose(f.normal, normal, rtol=1e-15)
        assert f.offset == pytest.approx(-f.side * (1.0, 0.8)[f.block] + (0.1, 0.2)[f.block], abs=1e-15)


@pytest.mark.parametrize("k12", [0.5, -0.5, -0.9])
def test_the_parallelogram_runs_round_counter_clockwise(k12):
    """At kappa12 = -0.9 the determinant is negative, and lambda runs the other way."""
    system = two_blocks(1.1, 1.6, k12, 0.1, [1.0, 0.4], -1.0)
    vertices = parallelogram(system)
    x, y = np.array([c.point for c in vertices]).T
    assert vertices[0].sides == (1, 1)
    area = (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    # the box of forces 2 mu1 x 2 mu2, mapped by K^-1
    assert area == pytest.approx(4 * 0.4 / abs(np.linalg.det(system.stiffness)), rel=1e-12)
    np.testing.assert_allclose(x[0] + x[2], x[1] + x[3], atol=1e-12)


def test_first_exits_of_figure_2():
    """AUDIT, two blocks: from (0, 0) block 2 leaves at 0.5625 for either s; at (0.1, 1.2) block 2 cannot stick."""
    for s in (1, -1):
        end = drift_exit(two_blocks(**FIGURE_2, s=s), 0.0)
        assert end.time == pytest.approx(0.5625, abs=1e-12)
        np.testing.assert_allclose(end.z, -0.5625, atol=1e-12)
        assert (end.blocks, end.sides) == ((1,), (1,))
    system = two_blocks(**FIGURE_2)
    np.testing.assert_array_equal(can_stick(system, [[0.0, 0.0], [0.1, 1.2]]), [[True, True], [True, False]])
    with pytest.raises(ValueError, match=r"^z: .* for block 1"):
        drift_exit(system, [0.1, 1.2])


# Regions and folds of any number of blocks


@pytest.mark.parametrize("seed", range(5))
def test_membership_is_what_the_engine_holds(seed):
    system, rng = draw(seed)
    share = rng.uniform(-1.6, 1.6, (40, system.n))
    z = np.array([place(system, s) for s in share])
    np.testing.assert_allclose(sticking_lambda(system, z), share, atol=1e-9)
    inside = can_stick(system, z)
    np.testing.assert_array_equal(inside, np.abs(share) <= 1)
    for state, holds in zip(z, inside, strict=True):
        np.testing.assert_array_equal(modes_at_once(system, state, system.belt_speed) == 0, holds)
        np.testing.assert_array_equal(can_stick(system, state), holds)


def test_lambda_of_blocks_without_friction():
    system = System(np.eye(3), 0.0, 0.0, -1.0)
    np.testing.assert_array_equal(sticking_lambda(system, [0.0, 2.0, -2.0]), [0.0, -np.inf, np.inf])
    np.testing.assert_array_equal(can_stick(system, [0.0, 2.0, -2.0]), [True, False, False])


@pytest.mark.parametrize("seed", range(8))
def test_heights_over_the_folds(seed):
    """Of the sign of the side where a block sticks; zero where lambda = side, with all that it says of the exit."""
    system, rng = draw(seed)
    z = place(system, rng.uniform(-1, 1, system.n))
    assert all(f.side * f.height(z) > 0 for f in folds(system))
    end = drift_exit(system, z)
    at = [(f.block, f.side) for f in folds(system) if abs(f.height(end.z)) < 1e-9]
    assert at == list(zip(end.blocks, end.sides, strict=True))


def test_a_drift_that_changes_no_force_meets_no_fold():
    assert drift_exit(System([[1.0, -1.0], [-1.0, 1.0]], 0.25, 1.0, -1.0), 0.0) is None  # K (1, 1) = 0
    assert drift_exit(System(np.eye(2), 0.1, 1.0, 0.0), 0.5) is None  # the belt rests


# The drift with all blocks stuck, against the exact engine


@pytest.mark.parametrize("seed", range(25))
@pytest.mark.parametrize("is_sparse", [False, True])
def test_the_drift_ends_where_the_engine_has_the_first_exit(seed, is_sparse):
    system, rng = draw(seed, 12)
    z = place(system, rng.uniform(-1, 1, system.n))
    if is_sparse:
        stiffness = scipy.sparse.csr_array(system.stiffness)
        system = System(stiffness, system.damping, system.friction, system.belt_speed)
    end = drift_exit(system, z)
    run = simulate(system, z, system.belt_speed, end.time * 1.0001, **EXACT)
    assert run.events.t[0] == pytest.approx(end.time, rel=1e-9, abs=1e-9)
    assert (int(run.events.block[0]), int(run.events.mode[0])) == (*end.blocks, *end.sides)
    np.testing.assert_allclose(simulate(system, z, system.belt_speed, end.time, **EXACT).z, end.z, atol=1e-9)


def test_two_hundred_blocks():
    system = draw_system("antisymmetric", 200, seed=3)
    z = place(system, np.random.default_rng(0).uniform(-1, 1, 200))
    end = drift_exit(system, z)
    run = simulate(system, z, system.belt_speed, 1.001 * end.time, **EXACT)
    assert run.events.t[0] == pytest.approx(end.time, rel=1e-9)
    assert (run.events.block[0], run.events.mode[0]) == (end.blocks[0], end.sides[0])


@pytest.mark.parametrize("seed", range(10))
def test_what_leaves_together_is_reported_together(seed):
    """A drift aimed at a stratum of exits, from a time T before."""
    system, rng = draw(100 + seed)
    n, t = system.n, 0.05
    k = int(rng.integers(1, n + 1))
    stratum = next(s for s in strata(system, k) if s.kind() == "exit")
    end = drift_exit(system, stratum.inner_point - system.belt_speed * t)
    assert end.time == pytest.approx(t, abs=1e-9)
    assert (end.blocks, end.sides) == (stratum.blocks, stratum.sides)
    np.testing.assert_allclose(end.z, stratum.inner_point, atol=1e-9)


@pytest.mark.parametrize(("rests", "blocks"), [([1.0, 1.0], (0, 1, 2)), ([1.0, -1.0], (0, 1)), ([-1.0, 1.0], (0,))])
def test_one_that_leaves_takes_along_what_rested_on_its_fold(rests, blocks):
    """A chain in which only block 1 feels the drift, with blocks 2 and 3 at lambda = rests all the time."""
    system = System([[1.0, 0.0, 0.0], [-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]], 0.0, 1.0, -1.0)
    z = place(system, np.array([0.5, *rests]))
    end = drift_exit(system, z)
    run = simulate(system, z, -1.0, 0.6, **EXACT)
    assert (end.time, end.blocks, end.sides) == (0.5, blocks, (1,) * len(blocks))
    assert run.events.t.tolist() == [0.5] * len(blocks)
    assert tuple(run.events.block) == blocks


# Visibility, against the exact engine


@pytest.mark.parametrize("seed", range(40))
def test_a_block_leaves_its_fold_if_it_is_visible(seed):
    """Some blocks at folds, some that stick, some that slip at any velocity."""
    system, rng = draw(seed)
    role = rng.integers(0, 3, system.n)
    role[0] = 0
    share = np.where(role == 0, rng.choice([-1.0, 1.0], system.n), rng.uniform(-0.9, 0.9, system.n))
    z = place(system, share)
    w = np.where(role == 2, rng.normal(size=system.n), system.belt_speed)
    mode = np.where(role == 2, np.sign(w - system.belt_speed), 0)
    found = visibility(system, z, w, mode)
    assert [c.block for c in found] == np.flatnonzero(role == 0).tolist()
    decided = modes_at_once(system, z, w)
    third = -(system.stiffness @ w)
    for c in found:
        assert c.side == share[c.block]
        assert (c.order, c.derivative) == (3, pytest.approx(third[c.block]))
        assert decided[c.block] == (c.side if c.visibility == "visible" else 0)


def draw_cusps(seed):
    """Small dyadic numbers; on the belt many blocks at their folds, many of them with (K w)_i = 0."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    v = rng.choice([-1.0, 0.5])
    z, w = rng.choice([-1.0, -0.5, 0.0, 0.5, 1.0], n), rng.choice([v, v, v, -1.0, 0.5], n)
    k = rng.choice([-1.0, -0.5, 0.0, 0.0, 0.5, 1.0], (n, n))
    is_cusp = (w == v) & (rng.random(n) < 0.7)
    k[is_cusp, is_cusp] -= (k @ w)[is_cusp] / v
    damping, friction = rng.choice([0.0, 0.5, 1.0], n), rng.choice([0.0, 0.5, 1.0], n)
    force = damping * v + k @ z
    friction = np.where(rng.random(n) < 0.7, np.abs(force), friction)
    mode = np.where(w == v, np.where(np.abs(force) <= friction, 0, -np.sign(force)), np.sign(w - v))
    return System(k, damping, friction, v), z, w, mode


def test_degenerate_folds_are_decided_as_the_engine_decides_them():
    """Folds, cusps and tangencies of higher order, several at once, blocks without friction."""
    seen = Counter()
    for seed in range(800):
        system, z, w, mode = draw_cusps(seed)
        decided = modes_at_once(system, z, w)
        contacts = visibility(system, z, w, mode)
        leaving = {c.block: c.side for c in contacts if c.visibility == "visible"}
        for c in contacts:
            assert decided[c.block] == leaving.get(c.block, 0)
            seen[c.order, c.visibility] += 1
    assert all(seen[order, name] > 5 for order, name in product((3, 4, 5, 6), ("visible", "invisible")))
    assert seen[0, "degenerate"] > 50


@pytest.mark.parametrize("sides", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_one_that_leaves_takes_others_along(sides):
    """A chain; only block 1 feels the drift: z_1''' = 1 makes z_2^(5) = 1, and if that leaves, z_3^(7) = 1."""
    system = System([[1.0, 0.0, 0.0], [-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]], 0.0, 1.0, -1.0)
    z = np.cumsum([-1.0, *(-side for side in sides)])  # F = -sides
    found = visibility(system, z, -1.0, [0, 0, 0])
    third = ("degenerate", 0, 0.0) if sides[0] < 0 else ("visible" if sides[1] > 0 else "invisible", 7, 1.0)
    assert [(c.visibility, c.order, c.derivative) for c in found] == [
        ("visible", 3, 1.0),
        ("visible" if sides[0] > 0 else "invisible", 5, 1.0),
        third,
    ]


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(("acceleration", "jerk"), [(0.5, 1), (-0.5, 1), (0.0, 1), (0.0, -1)])
def test_a_cusp_is_decided_by_the_next_order(side, acceleration, jerk):
    """Block 1 at its fold with (K w)_1 = 0: z_1'''' = w_2'/2, and where that vanishes the fifth is w_2''/2."""
    z2, w2, c = 0.5, -2.0, 0.25 * jerk
    z1 = -side + 0.25 + 0.5 * z2  # F_1 = -0.25 + z1 - z2 / 2 = -side
    d = (1.0 + 2 * 0.125 - c * z1 - acceleration) / z2  # w_2' = -R_2 w_2 - c z1 - d z2 + mu_2
    system = System([[1.0, -0.5], [c, d]], [0.25, 0.125], 1.0, -1.0)
    (contact,) = visibility(system, [z1, z2], [-1.0, w2], [0, -1])
    order, value = (4, 0.5 * acceleration) if acceleration else (5, 0.5 * (c + 2 * d))
    assert (contact.block, contact.side, contact.order) == (0, side, order)
    assert contact.derivative == pytest.approx(value, abs=1e-12)
    assert contact.visibility == ("visible" if side * value > 0 else "invisible")


def test_a_force_that_rests_at_its_bound_is_degenerate():
    system = System([[1.0, -1.0], [-1.0, 1.0]], 0.0, 1.0, -0.5)
    found = visibility(system, [1.0, 0.0], -0.5, [0, 0])
    assert [(c.block, c.side, c.visibility, c.order, c.derivative) for c in found] == [
        (0, -1, "degenerate", 0, 0.0),
        (1, 1, "degenerate", 0, 0.0),
    ]
    assert next(strata(system, 1)).kind() == "degenerate"


@pytest.mark.parametrize("seed", range(5))
def test_a_block_that_touches_its_fold_from_slip_is_at_it_too(seed):
    system, rng = draw(seed)
    side = rng.choice([-1, 1], system.n)
    z, v = place(system, side.astype(float)), system.belt_speed
    assert visibility(system, z, v, side) == visibility(system, z, v, 0)


def test_a_block_without_friction_has_both_folds_in_one_place():
    found = visibility(System([[2.0]], 0.0, 0.0, -1.0), 0.0, -1.0, [0])
    assert [(c.side, c.visibility) for c in found] == [(1, "visible"), (-1, "invisible")]


# Strata


@pytest.mark.parametrize(("r", "k"), [(r, k) for r in range(6) for k in range(r + 1)])
def test_counts_by_enumeration(r, k):
    """AUDIT, misprints, section 4 counts: C(r, k) 2^k. Brute force: each block off its folds, or on either."""
    brute = [sides for sides in product((-1, 0, 1), repeat=r) if np.count_nonzero(sides) == k]
    assert n_strata(r, k) == len(brute)
    if k > 0:
        stuck = [2 * i for i in reversed(range(r))]
        system = System(np.eye(2 * r), 0.1)
        listed = [dict(zip(s.blocks, s.sides, strict=True)) for s in strata(system, k, stuck)]
        expected = [{2 * i: side for i, side in enumerate(sides) if side} for sides in brute]
        assert len(listed) == len(expected)
        assert all(item in listed for item in expected)


def test_counts_are_exact_and_nothing_is_built_for_them():
    assert n_strata(200, 100) == n_strata(200, 99) * 2 * 101 // 100
    assert n_strata(200, 200) == 2**200
    system = draw_system("antisymmetric", 200, seed=0)
    first = next(strata(system, 100))
    assert (first.blocks, set(first.sides)) == (tuple(range(100)), {1})


@pytest.mark.parametrize("seed", range(10))
def test_the_equations_of_a_stratum(seed):
    """AUDIT, misprints, section 4 counts: dimension 2n - r - k; points on the folds, directions along them."""
    system, rng = draw(seed)
    n = system.n
    stuck = rng.permutation(n)[: rng.integers(1, n + 1)].tolist()
    for k in range(1, len(stuck) + 1):
        for s in strata(system, k, stuck):
            assert s.dimension == 2 * n - len(stuck) - k
            assert s.basis.shape == (n - k, n)
            np.testing.assert_allclose(s.basis @ s.basis.T, np.eye(n - k), atol=1e-12)
            np.testing.assert_allclose(s.basis @ s.point, 0.0, atol=1e-9)  # least norm: no part along the stratum
            for z in (s.point, s.inner_point, s.point + rng.normal(size=n - k) @ s.basis):
                np.testing.assert_allclose(sticking_lambda(system, z)[list(s.blocks)], s.sides, atol=1e-8)
            others = [i for i in s.stuck if i not in s.blocks]
            np.testing.assert_allclose(sticking_lambda(system, s.inner_point)[others], 0.0, atol=1e-8)


@pytest.mark.parametrize("seed", range(8))
def test_what_leaves_from_a_stratum(seed):
    """The exact engine from a point of each: of an exit all blocks leave at once, of an entry none."""
    system, rng = draw(seed, 4)
    n, v = system.n, system.belt_speed
    stuck = rng.permutation(n)[: rng.integers(1, n + 1)]
    w = rng.normal(size=n)
    w[stuck] = v
    kinds = set()
    for k in range(1, len(stuck) + 1):
        for s in strata(system, k, stuck):
            expected = np.sign(w - v)
            for i, side, seen in zip(s.blocks, s.sides, s.visibility(w), strict=True):
                expected[i] = side if seen == "visible" else 0
            np.testing.assert_array_equal(modes_at_once(system, s.inner_point, w), expected)
            unread = np.where(np.isin(np.arange(n), stuck), rng.normal(size=n), w)
            assert s.visibility(unread) == s.visibility(w)
            leaves = {"exit": k, "entry": 0}.get(s.kind(w), np.count_nonzero(expected[list(s.blocks)]))
            assert np.count_nonzero(expected[list(s.blocks)]) == leaves
            kinds.add(s.kind(w))
    assert {"exit", "entry"} <= kinds


def test_dependent_folds():
    """Rows (1, -1) and (-2, 2): two folds coincide or never meet."""
    system = System([[1.0, -1.0], [-2.0, 2.0]], 0.0, [1.0, 2.0], -0.5)
    same, apart = (next(s for s in strata(system, 2) if s.sides == sides) for sides in ((1, -1), (1, 1)))
    np.testing.assert_allclose(same.point, [-0.5, 0.5], atol=1e-15)
    np.testing.assert_allclose(np.abs(same.basis), np.sqrt([[0.5, 0.5]]), atol=1e-15)
    assert same.dimension == 1
    with pytest.raises(np.linalg.LinAlgError, match=r"^blocks: .* those of \(0, 1\)"):
        _ = apart.point
    with pytest.raises(np.linalg.LinAlgError, match="rank 1 for 2 blocks"):
        corners(system)
    with pytest.raises(np.linalg.LinAlgError, match="rank 0"):
        parallelogram(System(np.zeros((2, 2)), 0.1))


def test_rows_of_very_different_size_are_independent():
    system = System(np.diag([1e-20, 1.0]), 0.0, 1.0)
    np.testing.assert_allclose(next(corners(system)).point, [-1e20, -1.0], rtol=1e-14)


def test_corners_of_a_thin_region_keep_their_digits():
    """z1 + e z2 and z1 - e z2 held: (-1, 0) where both are -1, (0, -1 / e) where they differ."""
    e = 2.0**-40
    points = {c.sides: c.point for c in corners(System([[1.0, e], [1.0, -e]], 0.0, 1.0))}
    np.testing.assert_allclose(points[1, 1], [-1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(points[1, -1], [0.0, -1 / e], rtol=1e-14, atol=1e-15)


def test_sparse_is_dense():
    dense = two_blocks(**FIGURE_2)
    sparse = System(scipy.sparse.csr_array(dense.stiffness), 0.1, 1.0, -1.0)
    for a, b in zip(corners(dense), corners(sparse), strict=True):
        np.testing.assert_array_equal(a.point, b.point)
        assert visibility(dense, a.point, -1.0, [0, 0]) == visibility(sparse, b.point, -1.0, [0, 0])
    assert stick_interval(System(scipy.sparse.csr_array([[0.2]]), 3.5)) == stick_interval(System([[0.2]], 3.5))
    states = np.random.default_rng(0).normal(size=(5, 2))
    np.testing.assert_allclose(sticking_lambda(sparse, states), sticking_lambda(dense, states), rtol=1e-14)


# Invariances


def described(system, z, w, mode):
    """Everything that the geometry says of a state, in numbers that can be compared."""
    end = drift_exit(system, z)
    contacts = [(c.block, c.side, c.visibility, c.order) for c in visibility(system, z, w, mode)]
    stuck = np.flatnonzero(mode == 0).tolist()
    found = {(s.blocks, s.sides): (s.point, s.kind(w)) for k in (1, 2) for s in strata(system, k, stuck)}
    return end, contacts, found


def start_at_a_fold(seed):
    rng = np.random.default_rng(seed)
    system, *_ = draw_run(rng, 4, "full", damping=(0.0, 1.0), friction=(0.5, 2.0), belt_speed=[-0.4])
    share = rng.uniform(-0.8, 0.8, 4)
    w = np.array([-0.4, -0.4, -0.4, 0.9])
    share[0] = 1.0
    return system, place(system, share), w, np.array([0, 0, 0, 1]), rng


@pytest.mark.parametrize("seed", range(4))
def test_renumbering_the_blocks_renumbers_the_geometry(seed):
    system, z, w, mode, rng = start_at_a_fold(seed)
    order = rng.permutation(4)
    home = np.argsort(order)
    other = System(
        system.stiffness[np.ix_(order, order)], system.damping[order], system.friction[order], system.belt_speed
    )
    a_end, a_contacts, a_found = described(system, z, w, mode)
    b_end, b_contacts, b_found = described(other, z[order], w[order], mode[order])
    assert b_end.time == pytest.approx(a_end.time, abs=1e-10)
    assert b_end.blocks == tuple(home[list(a_end.blocks)])
    assert b_contacts == [(home[i], *rest) for i, *rest in a_contacts]
    for (blocks, sides), (point, kind) in a_found.items():
        moved = sorted(zip(home[list(blocks)].tolist(), sides, strict=True))
        b_point, b_kind = b_found[tuple(i for i, _ in moved), tuple(side for _, side in moved)]
        np.testing.assert_allclose(b_point, point[order], atol=1e-9)
        assert b_kind == kind


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("factor", [-1.0, 8.0, -0.125])
def test_mirror_and_scale(seed, factor):
    """z, w, v times a factor, mu times its size: the same times, points times the factor, sides by its sign."""
    system, z, w, mode, _ = start_at_a_fold(seed)
    turn = int(np.sign(factor))
    other = System(system.stiffness, system.damping, abs(factor) * system.friction, factor * system.belt_speed)
    a_end, a_contacts, a_found = described(system, z, w, mode)
    b_end, b_contacts, b_found = described(other, factor * z, factor * w, turn * mode)
    assert b_end.time == pytest.approx(a_end.time, abs=1e-12)
    np.testing.assert_allclose(b_end.z, factor * a_end.z, atol=1e-12)
    assert b_end.sides == tuple(turn * side for side in a_end.sides)
    assert b_contacts == [(i, turn * side, seen, k) for i, side, seen, k in a_contacts]
    for (blocks, sides), (point, kind) in a_found.items():
        b_point, b_kind = b_found[blocks, tuple(turn * side for side in sides)]
        np.testing.assert_allclose(b_point, factor * point, rtol=1e-12)
        assert b_kind == kind


@pytest.mark.parametrize("rate", [4.0, 0.25])
def test_a_clock_that_runs_faster(rate):
    """t / rate, w and v times rate, K and mu times rate^2, R times rate: the same planes, times / rate."""
    system, z, w, mode, _ = start_at_a_fold(0)
    other = System(
        rate**2 * system.stiffness, rate * system.damping, rate**2 * system.friction, rate * system.belt_speed
    )
    a_end, a_contacts, a_found = described(system, z, w, mode)
    b_end, b_contacts, b_found = described(other, z, rate * w, mode)
    assert b_end.time * rate == pytest.approx(a_end.time, abs=1e-12)
    assert b_contacts == a_contacts
    for key, (point, kind) in a_found.items():
        np.testing.assert_allclose(b_found[key][0], point, atol=1e-9)
        assert b_found[key][1] == kind
