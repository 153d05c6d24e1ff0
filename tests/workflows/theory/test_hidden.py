"""Hidden dynamics: modes, basins and exits inside a discontinuity, against closed forms and AUDIT's figures.

Two blocks are those of figure 2 and of AUDIT's row "Hidden dynamics": rho = 0.1, kappa = 1.1, 1.6,
kappa12 = 0.5, mu = 1, v = -1, couplings of eq. (6) as printed.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp, trapezoid
from scipy.optimize import brentq, fsolve

from stickslip.sim import IntegrationError, System, simulate
from stickslip.workflows.gallery.theory.blowup import Blowup, continuations
from stickslip.workflows.gallery.theory.laws import Coulomb, Modified, StaticAboveKinetic
from stickslip.workflows.gallery.theory.slow_time import run_with_law
from tests.workflows.theory.smooth import SmoothLaw

PAIR = System([[1.6, -0.5], [-0.5, 2.1]], damping=0.1, belt_speed=-1.0)
ONE = System([[1.0]], damping=0.1, belt_speed=-0.2)
#: where F1 = -F2 = 0.5
Z_HALF = [0.3408360128617363, -0.10932475884244373]
STUCK = np.zeros(2, dtype=np.int8)


def modified(curvature=2.0, **options):
    """The modified law as a user would give it; every second derivative is at most 2 in the box."""
    law = Modified()
    return SmoothLaw(law.resistance, law.slope, curvature, 2, **options)


LAWS = {"coulomb": Coulomb(), "static": StaticAboveKinetic(1.4), "modified": Modified(), "smooth": modified()}


# --- laws ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_jacobian_is_the_derivative_of_the_accelerations(law):
    rng = np.random.default_rng(0)
    force, friction, lam, step = rng.normal(size=2), np.array([0.7, 1.3]), rng.uniform(-1, 1, 2), 1e-6
    columns = [
        (law.accelerations(force, friction, lam + d) - law.accelerations(force, friction, lam - d)) / (2 * step)
        for d in step * np.eye(2)
    ]
    np.testing.assert_allclose(law.jacobian(friction, lam), np.column_stack(columns), atol=1e-8)


@pytest.mark.parametrize(
    "law", [Coulomb(), StaticAboveKinetic(1.4), Modified()], ids=["coulomb", "static", "modified"]
)
def test_slipping_friction_is_the_kinetic(law):
    """Section 5: where the blocks slip the hidden terms vanish."""
    for lam in ([1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]):
        np.testing.assert_array_equal(law.resistance(np.array(lam)), lam)


@pytest.mark.parametrize("ratio", [1.0, 1.0001, 1.2, 2.0, 10.0])
def test_static_law_reaches_its_ratio_at_the_turning_point(ratio):
    law = StaticAboveKinetic(ratio)
    lam = np.linspace(-1, 1, 20001)
    s = law.resistance(lam)
    assert s.max() == pytest.approx(ratio, abs=1e-7 * ratio)
    rising = np.diff(s) > 0
    inner = np.abs(lam[:-1] + lam[1:]) / 2 < law.turning_point - 1e-4
    outer = np.abs(lam[:-1] + lam[1:]) / 2 > law.turning_point + 1e-4
    assert rising[inner].all()
    assert not rising[outer].any()
    if ratio > 1:
        assert law.c > 0.5
        assert 4 * (1 + law.c) ** 3 == pytest.approx(27 * ratio**2 * law.c, rel=1e-12)


def test_hidden_term_up_to_one_half_leaves_friction_monotone():
    lam = np.linspace(-1, 1, 2001)
    assert (np.diff(lam + 0.5 * lam * (1 - lam**2)) > 0).all()
    assert (np.diff(lam + 0.6 * lam * (1 - lam**2)) < 0).any()


def test_static_law_of_ratio_one_is_coulombs():
    np.testing.assert_array_equal(StaticAboveKinetic(1.0).resistance(np.array([0.3, -0.8])), [0.3, -0.8])
    runs = [run_with_law(PAIR, law, [0.1, 1.2], -1.0, 2.0) for law in (StaticAboveKinetic(1.0), Coulomb())]
    assert [(e.kind, e.block) for e in runs[0].events] == [(e.kind, e.block) for e in runs[1].events]
    np.testing.assert_array_equal(*[[e.t for e in run.events] for run in runs])


def test_canopy_cannot_express_the_modified_law():
    """AUDIT (12): the corners of the modified law are Coulomb's, and so is their canopy, linear in each lambda."""
    law, (x, y) = Modified(), (-0.5, 0.0)
    canopy = sum(
        (1 + a * x) / 2 * (1 + b * y) / 2 * law.resistance(np.array([a, b])) for a in (-1.0, 1.0) for b in (-1.0, 1.0)
    )
    np.testing.assert_allclose(canopy, [x, y], atol=1e-15)
    assert np.abs(law.resistance(np.array([x, y])) - canopy).max() == pytest.approx(0.5)


# --- sticking modes ------------------------------------------------------------------------------------------


def test_coulomb_has_one_mode():
    """AUDIT, hidden dynamics: lambda = -F, eigenvalues -1, -1 as (13) is printed, times (1 - lambda^2) / eps."""
    (mode,) = Blowup(Coulomb(), [1.0, 1.0], eps=[1.0, 0.5]).sticking_modes([0.3, -0.6])
    np.testing.assert_array_equal(mode.lam, [-0.3, 0.6])
    assert (mode.kind, mode.is_stable) == ("node", True)
    np.testing.assert_allclose(mode.eigenvalues, [-(1 - 0.09), -2 * (1 - 0.36)], rtol=1e-14)
    assert Blowup(Coulomb(), [1.0, 1.0]).sticking_modes([0.3, -1.1]) == ()


def printed(mode):
    """Eigenvalues of (13) without its factors, of the modified law at mu = 1, rising."""
    return np.sort(np.linalg.eigvals(Modified().jacobian(np.ones(2), mode.lam)).real)


@pytest.mark.parametrize("g", [0.05, 0.3, 0.5, 0.7, 0.9])
def test_modified_law_on_the_antidiagonal(g):
    """AUDIT, hidden dynamics: F1 = -F2 = G; eigenvalues as (13) is printed, and the factors that it leaves out."""
    modes = Blowup(Modified(), [1.0, 1.0]).sticking_modes([g, -g])
    first, saddle, second = modes
    np.testing.assert_allclose(first.lam, [-g, 0], atol=1e-14)
    np.testing.assert_allclose(second.lam, [0, g], atol=1e-14)
    root = np.sqrt(1 - g * g)
    for mode in (first, second):
        assert (mode.kind, mode.is_stable) == ("node", True)
        np.testing.assert_allclose(printed(mode), [-1 - root, -1 + root], atol=1e-12)
    q = saddle.lam[0]
    assert q**3 - 2 * q == pytest.approx(g, abs=1e-14)
    assert saddle.lam[1] == pytest.approx(-q, abs=1e-15)
    assert (saddle.kind, saddle.is_stable) == ("saddle", False)
    np.testing.assert_allclose(printed(saddle), [-2 + 3 * q * q, q * q], atol=1e-12)
    np.testing.assert_allclose(saddle.eigenvalues, (1 - q * q) * printed(saddle)[::-1], atol=1e-12)


def test_modified_law_at_one_half():
    """AUDIT, hidden dynamics: the figures at G = 0.5 and the state that has it."""
    force = PAIR.holding_force(Z_HALF)
    np.testing.assert_allclose(force, [0.5, -0.5], atol=1e-12)
    at_half = np.linalg.solve(PAIR.stiffness, [0.5, -0.5] - PAIR.damping * PAIR.belt_speed)
    np.testing.assert_allclose(at_half, Z_HALF, atol=1e-12)
    first, saddle, _ = Blowup(Modified(), PAIR.friction).sticking_modes(force)
    np.testing.assert_allclose(printed(first), [-1.8660254038, -0.1339745962], atol=1e-10)
    assert saddle.lam[0] == pytest.approx(-0.258652022504152763, abs=1e-12)


def test_three_modes_in_a_share_of_the_parallelogram():
    """F is affine in z, so a share of the square |F_i| < 1 is the share of (7): 2.6172%.

    AUDIT, hidden dynamics, has 2.67%, which neither way below gives. (i) Exact: with (a, b) = -F = (h - g, h + g),
    det s' = 3 (xy)^2 + 4 xy + x^2 + y^2 = 0 is a curve in polar angle; its image bounds the three modes where it
    is inside the square. (ii) One point in each of 632^2 cells, roots as eigenvalues of companion matrices:
    standard deviation below 0.01.
    """

    def g_h(angle):
        c, d = np.cos(angle), np.sin(angle)
        r = np.sqrt(np.maximum(4 * c * d - 1, 0) / 3) / (c * d)
        a, b = Modified().resistance(np.array([-r * c, r * d]))
        return (b - a) / 2, (a + b) / 2

    first = np.pi / 12  # sin(2 angle) = 1/2: where r = 0
    cut = brentq(lambda angle: sum(g_h(angle)) - 1, first, first + 0.1)  # where b = 1
    angles = first + (cut - first) * np.linspace(0, 1, 20001) ** 2
    g, h = np.array([g_h(angle) for angle in angles]).T
    exact = 2 * (trapezoid(h, g) + (1 - g[-1]) ** 2 / 2)
    assert 100 * exact == pytest.approx(2.617166, abs=1e-5)

    rng, side = np.random.default_rng(5), 632
    a, b = (np.indices((side, side)) + rng.uniform(size=(2, side, side))).reshape(2, -1) / side * 2 - 1
    near = np.abs(a + b) < 0.12  # h < 0.056 where it counts
    a, b = a[near], b[near]
    companion = np.zeros((a.size, 5, 5))
    companion[:, 1:, :-1] = np.eye(4)
    companion[:, :, -1] = -np.stack([a + b, -(a**2), a - 2 * b, np.full_like(a, -2), b], axis=1)
    x = np.linalg.eigvals(companion)
    real = np.where(np.abs(x.imag) < 1e-9, x.real, 2.0)
    y = (real - a[:, None]) / (1 - real**2)
    count = ((np.abs(real) < 1) & (np.abs(y) < 1)).sum(axis=1)
    assert 100 * np.count_nonzero(count == 3) / side**2 == pytest.approx(100 * exact, abs=0.03)
    chosen = np.concatenate([rng.choice(a.size, 100), rng.choice(np.flatnonzero(count == 3), 100)])
    blowup = Blowup(Modified(), [1.0, 1.0])
    assert [len(blowup.sticking_modes([-a[k], -b[k]])) for k in chosen] == count[chosen].tolist()


@pytest.mark.parametrize(
    ("force", "expected"),
    [
        # on faces and corners of the box: s_1 = -+1 holds on all of lambda_1 = -+1
        ([1.0, -1.0], [[-1, 0], [-1, 1], [-(np.sqrt(5) - 1) / 2, (np.sqrt(5) - 1) / 2], [0, 1]]),
        ([-1.0, -1.0], [[1, 1]]),
        ([0.0, 0.0], [[0, 0]]),
    ],
)
def test_modified_law_on_faces(force, expected):
    modes = Blowup(Modified(), [1.0, 1.0]).sticking_modes(force)
    np.testing.assert_allclose([m.lam for m in modes], expected, atol=1e-14)


@pytest.mark.parametrize(
    ("target", "roots", "stable"), [(0.0, 1, 1), (0.999, 1, 1), (1.001, 2, 1), (1.399, 2, 1), (1.401, 0, 0)]
)
def test_static_law_has_the_planted_counts(target, roots, stable):
    """s rises to its ratio at lambda_* and falls to 1: one root below 1, two up to the ratio, none beyond."""
    law = StaticAboveKinetic(1.4)
    for sign in (1, -1):
        modes = Blowup(law, [1.0]).sticking_modes(-sign * target)
        assert len(modes) == roots
        assert sum(m.is_stable for m in modes) == stable
        for mode in modes:
            assert law.resistance(mode.lam)[0] == pytest.approx(sign * target, abs=1e-14)
            assert mode.is_stable == (abs(mode.lam[0]) < law.turning_point)
    modes = Blowup(law, [1.0, 2.0]).sticking_modes([-1.2, 2 * 1.2])
    assert len(modes) == 4
    assert sorted(m.kind for m in modes) == ["node", "node", "saddle", "saddle"]  # the fourth is a source


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_mode_and_the_saddle_of_the_static_law_that_meet_are_one(side):
    law = StaticAboveKinetic(1.5)
    ((meeting,),) = law.zeros(np.array([1.5 * side]), STUCK[:1])
    assert meeting == pytest.approx(side * law.turning_point, rel=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_subdivision_finds_planted_zeros(seed):
    """s_1 and s_2 products of 2 and 3 lines: the zeros are where a line of the one meets a line of the other."""
    rng = np.random.default_rng(seed)
    normal = rng.uniform(-1, 1, (5, 2))
    through = rng.uniform(-0.9, 0.9, (5, 2))
    groups = [range(2), range(2, 5)]

    def values(lam):
        return ((lam - through) * normal).sum(axis=1)

    def s(lam):
        return np.array([np.prod(values(lam)[list(g)]) for g in groups])

    def ds(lam):
        line = values(lam)
        return np.array([sum(normal[i] * np.prod([line[j] for j in g if j != i]) for i in g) for g in groups])

    planted = []
    for i in groups[0]:
        for j in groups[1]:
            rows = normal[[i, j]]
            planted.append(np.linalg.solve(rows, (rows * through[[i, j]]).sum(axis=1)))
    planted = np.array([p for p in planted if np.abs(p).max() <= 1])
    # |line| <= 4 on the box and 1/16 beyond; 6 products of two normals and one line make a second derivative
    law = SmoothLaw(s, ds, 6 * 4.0, 2)
    found = law.zeros(np.zeros(2), STUCK)
    assert len(found) == len(planted)
    for zero in planted:
        assert np.abs(found - zero).max(axis=1).min() < 1e-11


@pytest.mark.parametrize("slip", [[0, 0], [0, 1], [-1, 0], [1, -1]])
def test_subdivision_agrees_with_the_closed_forms(slip):
    slip = np.array(slip, dtype=np.int8)
    rng = np.random.default_rng(8)
    counts = set()
    for _ in range(30):
        target = np.array([-1, 1]) * rng.uniform(-1.3, 1.3) + 0.02 * rng.normal(size=2)
        exact = Modified().zeros(target, slip)
        found = modified().zeros(target, slip)
        assert len(found) == len(exact)
        counts.add(len(exact))
        for zero in exact:
            assert np.abs(found - zero).max(axis=1).min() < 1e-11
    assert len(counts) > 1 or slip.all()


def test_subdivision_refuses_a_degenerate_zero():
    law = SmoothLaw(lambda lam: lam**2, lambda lam: np.diag(2 * lam), 2.0, 1)
    with pytest.raises(IntegrationError, match="not decided at resolution"):
        law.zeros(np.zeros(1), STUCK[:1])


# --- the fast system -----------------------------------------------------------------------------------------


def test_basins_of_the_modified_law():
    """AUDIT, hidden dynamics: (1, 1) -> (0, 0.5), (-1, -1) -> (-0.5, 0); the line lambda2 = -lambda1 separates."""
    blowup, force = Blowup(Modified(), [1.0, 1.0]), [0.5, -0.5]
    np.testing.assert_allclose(blowup.settle(force, [1, 1]).lam, [0, 0.5], atol=1e-10)
    np.testing.assert_allclose(blowup.settle(force, [-1, -1]).lam, [-0.5, 0], atol=1e-10)
    for x in (-1.0, -0.7, 0.0, 0.4, 1.0):
        on_line = blowup.settle(force, [x, -x])
        assert not on_line.is_stable
        np.testing.assert_allclose(on_line.lam, [-0.258652022504152763, 0.258652022504152763], atol=1e-10)
        for side, mode in ((1, [0, 0.5]), (-1, [-0.5, 0])):
            entry = np.clip(np.array([x, -x]) + 0.01 * side, -1, 1)
            settled = blowup.settle(force, entry)
            assert settled.is_stable
            np.testing.assert_allclose(settled.lam, mode, atol=1e-10)


def test_right_hand_side_keeps_the_factors():
    """Eq. (13) with phi' / eps: by hand at one point."""
    blowup = Blowup(Modified(), [1.0, 1.0], eps=[0.1, 0.2])
    f = -np.array([0.5, -0.5]) - np.array([0.5 - 0.2 * 0.75, 0.2 - 0.5 * 0.96])
    rhs = blowup.rhs(np.array([0.5, -0.5]), np.array([0.5, 0.2]))
    np.testing.assert_allclose(rhs, [0.75 / 0.1 * f[0], 0.96 / 0.2 * f[1]], rtol=1e-14)


def test_fast_system_leaves_through_a_face():
    settled = Blowup(Coulomb(), [1.0, 1.0]).settle([-1.5, 0.4], [0.0, 0.0])
    assert settled.slip.tolist() == [1, 0]
    np.testing.assert_allclose(settled.lam, [1, -0.4], atol=1e-9)
    crossed = Blowup(Coulomb(), [1.0]).settle(1.5, 1.0)  # from right slip to left slip, without a mode
    assert crossed.slip.tolist() == [-1]


def test_fast_system_that_cycles_is_named():
    """An unstable focus inside, all faces repelling: no rest."""
    turn = np.array([[-0.3, 2.0], [-2.0, -0.3]])
    law = SmoothLaw(
        lambda lam: turn @ lam + 1.3 * lam**3, lambda lam: turn + np.diag(3.9 * lam**2), 1.3 * 6 * 17 / 16, 2
    )
    blowup = Blowup(law, [1.0, 1.0])
    (mode,) = blowup.sticking_modes(0.0)
    assert (mode.kind, mode.is_stable) == ("focus", False)
    np.testing.assert_allclose(mode.eigenvalues, [0.3 + 2j, 0.3 - 2j], atol=1e-12)
    with pytest.raises(IntegrationError, match="does not come to rest"):
        blowup.settle(0.0, [0.3, 0.1])


# --- slow time -----------------------------------------------------------------------------------------------


def test_mode_dies_in_a_saddle_node_and_jumps():
    """AUDIT, hidden dynamics: from G = 0.5 with v = -1, t = 0.0047988; to 1e-10 against Newton on f = det = 0."""
    law, rate = Modified(), PAIR.stiffness @ [-1.0, -1.0]

    def fold(unknown):
        lam = unknown[:2]
        residual = -(np.array([0.5, -0.5]) + rate * unknown[2]) - law.resistance(lam)
        return [*residual, np.linalg.det(law.slope(lam))]

    exact = fsolve(fold, [-0.4, 0.1, 0.005], xtol=1e-13)
    run = run_with_law(PAIR, law, Z_HALF, -1.0, 0.32, entry=[-0.5, 0.0])
    jump, leave = run.events
    assert (jump.kind, jump.cause, jump.block) == ("jump", "fold", -1)
    assert jump.t == pytest.approx(0.0047988, abs=5e-8)  # the digits that the row has
    assert jump.t == pytest.approx(exact[2], abs=1e-10)
    np.testing.assert_allclose(jump.lam_before, exact[:2], atol=1e-5)
    assert jump.lam[1] > 0.5  # on the other mode, which has moved on from (0, 0.5)
    assert (leave.kind, leave.cause, leave.block, leave.slip.tolist()) == ("exit", "face", 1, [0, 1])
    assert leave.t == pytest.approx(0.3125, abs=1e-10)


def test_other_mode_exits_through_its_face():
    """AUDIT, hidden dynamics: (0, 0.5) leaves through lambda2 = +1 at t = 0.3125."""
    run = run_with_law(PAIR, Modified(), Z_HALF, -1.0, 0.32, entry=[0.0, 0.5])
    (leave,) = run.events
    assert (leave.kind, leave.block, leave.slip[1]) == ("exit", 1, 1)
    assert leave.t == pytest.approx(0.3125, abs=1e-10)
    np.testing.assert_allclose(run.segments[1].z, np.array(Z_HALF) - 0.3125, atol=1e-10)  # stuck blocks ride the belt


def test_blocks_exit_when_their_force_reaches_the_static_one():
    """F moves at rate K v: block i exits at the first (-r - F_i) / (K v)_i; r = 1 and 1.3."""
    system = System([[1.0, -0.3], [-0.3, 1.2]], damping=0.1, belt_speed=-0.5)
    z = [0.1, 0.2]
    for law, ratio, cause in ((Coulomb(), 1.0, "face"), (StaticAboveKinetic(1.3), 1.3, "fold")):
        due = (-ratio - system.holding_force(z)) / (system.stiffness @ np.full(2, -0.5))
        leave = run_with_law(system, law, z, -0.5, 1.01 * due.min()).events[0]
        assert (leave.t, leave.block) == (pytest.approx(due.min(), abs=1e-10), np.argmin(due))
        assert (leave.cause, leave.slip[leave.block]) == (cause, 1)


def test_mode_that_loses_stability_by_a_complex_pair():
    """-s' = [[a - x, -2], [2 - y, a - x]]: a focus, lost where x = a; there F_2 = 2 a, reached at t = 0.4 exactly.

    The trace with the factors 1 - lambda^2 has the same zero.
    """
    a = 0.2

    def s(lam):
        x, y = lam
        return np.array([x * x / 2 - a * x + 2 * y, -2 * x + (x - a) * y])

    def ds(lam):
        x, y = lam
        return np.array([[x - a, 2.0], [y - 2.0, x - a]])

    law, system = SmoothLaw(s, ds, 1.0, 2), System(np.diag([0.01, 1.0]), damping=0.0, belt_speed=-1.0)
    start = np.array([0.4, 0.0])
    z = -s(start) / np.diag(system.stiffness)
    assert run_with_law(system, law, z, -1.0, 0.399, entry=start).events == ()
    # at this point the fast system has no mode to go to: it circles, and the message says when
    with pytest.raises(IntegrationError, match=r"t = 0\.(4|40000+\d*|39999+\d*): .*fast system"):
        run_with_law(system, law, z, -1.0, 0.5, entry=start)


@pytest.mark.parametrize(
    ("z0", "w0", "t_end"),
    [([0.0, 0.0], [-1.0, -1.0], 10.0), ([0.1, 1.2], [-1.0, -1.0], 2.0), ([0.3, -0.2], [0.7, -2.0], 10.0)],
)
def test_coulomb_run_is_the_exact_engines(z0, w0, t_end):
    """AUDIT, two blocks: the first two starts; events to 1e-8 (asked), 1e-10 (promised)."""
    run = run_with_law(PAIR, Coulomb(), z0, w0, t_end)
    exact = simulate(PAIR, z0, w0, t_end, tol=1e-15, stop_early=False)
    np.testing.assert_allclose([e.t for e in run.events], exact.events.t, rtol=0, atol=1e-10)
    assert [e.block for e in run.events] == exact.events.block.tolist()
    assert [e.slip[e.block] for e in run.events] == exact.events.mode.tolist()
    assert run.segments[0].slip.tolist() == exact.events.initial_mode.tolist()
    np.testing.assert_allclose(np.concatenate([run.z, run.w]), np.concatenate([exact.z, exact.w]), atol=1e-10)


@pytest.mark.parametrize(("z0", "w0"), [(3.0, 1.0), (0.0, -0.2)])
def test_two_equal_blocks_do_the_same_at_the_same_instant(z0, w0):
    twins, alone = System(np.eye(2), 0.1), run_with_law(ONE, Coulomb(), z0, w0, 6.0)
    both = run_with_law(twins, Coulomb(), z0, w0, 6.0)
    assert len(alone.events) > 0
    for block in (0, 1):
        mine = [e for e in both.events if e.block == block]
        assert [e.kind for e in mine] == [e.kind for e in alone.events]
        np.testing.assert_allclose([e.t for e in mine], [e.t for e in alone.events], atol=1e-10)


def test_users_law_runs_as_the_offered_one():
    runs = [run_with_law(PAIR, law, Z_HALF, -1.0, 3.0, entry=[-0.5, 0]) for law in (Modified(), modified())]
    assert [e.kind for e in runs[0].events] == [e.kind for e in runs[1].events] == ["jump", "exit", "exit"]
    np.testing.assert_allclose(*[[e.t for e in run.events] for run in runs], atol=1e-10)


def test_static_friction_makes_one_block_stick_and_slip_for_ever():
    """Sticks to z = -(r + rho v) / kappa, slips a closed-form arc, sticks again: under Coulomb it never would.

    Slip from rest on the belt: z + 1 is a damped oscillation, and w = v again at the time below.
    """
    ratio, rho, v = 1.5, 0.1, -0.2
    run = run_with_law(ONE, StaticAboveKinetic(ratio), 0.0, v, 29.0)
    assert [e.kind for e in run.events] == ["exit", "entry"] * 3
    start = -ratio - rho * v
    assert run.events[0].t == pytest.approx(start / v, abs=1e-10)
    omega = np.sqrt(1 - rho**2 / 4)

    def speed(t):
        a, b = start + 1, (v + rho * (start + 1) / 2) / omega
        decay, c, s = np.exp(-rho * t / 2), np.cos(omega * t), np.sin(omega * t)
        return decay * ((b * omega - rho * a / 2) * c - (a * omega + rho * b / 2) * s)

    slip = run.events[1].t - run.events[0].t
    assert speed(slip) == pytest.approx(v, abs=1e-10)
    period = np.diff([e.t for e in run.events][::2])
    np.testing.assert_allclose(period[1:], period[0], atol=1e-9)


@pytest.mark.parametrize(
    ("law", "entry", "kinds", "order"),
    [
        (Modified(), [0.9, 0.9], ["exit", "exit"], 1),
        (Modified(), [-0.9, -0.9], ["jump", "exit", "exit"], 1),
        (StaticAboveKinetic(1.2), [0.0, 0.0], ["exit", "exit"], 2 / 3),
    ],
)
def test_run_is_the_limit_of_thin_layers(law, entry, kinds, order):
    """Independent of the blow-up: the whole system with lambda = tanh((w - v) / eps), stiff, eps -> 0.

    The gap closes as eps where modes end at faces, as eps^(2/3) where the last exit is a fold (passage of a
    saddle-node in slow time).
    """
    run = run_with_law(PAIR, law, Z_HALF, -1.0, 2.0, entry=entry)
    assert [e.kind for e in run.events] == kinds
    gaps = []
    for eps in (1e-3, 1e-4):

        def full(_, x, eps=eps):
            z, w = x[:2], x[2:]
            force = PAIR.damping * w + PAIR.stiffness @ z
            return np.concatenate([w, law.accelerations(force, PAIR.friction, np.tanh((w + 1) / eps))])

        x0 = np.concatenate([Z_HALF, -1 + eps * np.arctanh(entry)])
        x = solve_ivp(full, (0, 2.0), x0, "LSODA", rtol=1e-9, atol=1e-11).y[:, -1]
        gaps.append(np.abs(x - np.concatenate([run.z, run.w])).max())
    assert gaps[1] < 0.01
    assert np.log10(gaps[0] / gaps[1]) == pytest.approx(order, abs=0.15)


# --- determinacy ---------------------------------------------------------------------------------------------


def test_static_friction_leaves_the_future_open():
    """AUDIT, uniqueness: a law that is not monotone has states with several forward solutions."""
    law = StaticAboveKinetic(1.5)
    stick, slip = continuations(ONE, law, -1.2, -0.2)  # F = -1.22: between kinetic and static friction
    assert (stick.slip.tolist(), slip.slip.tolist()) == ([0], [1])
    assert stick.is_stable
    assert [len(continuations(ONE, law, z, -0.2)) for z in (0.0, -1.2, -1.6)] == [1, 2, 1]
    slips = {tuple(m.slip) for m in continuations(System(np.eye(2), 0.1), law, [-1.2, 1.3], -0.2)}
    assert slips == {(0, 0), (1, 0), (0, -1), (1, -1)}
    # each is a run: what the block does depends on lambda, which the state does not hold
    ends = [run_with_law(ONE, law, -1.2, -0.2, 0.5, entry=lam).segments[0].slip[0] for lam in (0.0, 0.99)]
    assert ends == [0, 1]


def test_coulomb_determines_the_future():
    """AUDIT, uniqueness: -Sign is monotone, so every state has one forward solution."""
    rng = np.random.default_rng(2)
    for z in rng.uniform(-2, 2, (40, 2)):
        for w in ([-1.0, -1.0], [-1.0, 0.3], [-1.4, -1.0]):
            assert len(continuations(PAIR, Coulomb(), z, w)) == 1


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_at_a_fold_the_slip_is_left_out(side):
    """|F| = mu: kinetic friction balances the force, and nothing carries the block away."""
    assert Blowup(Coulomb(), [1.0]).continuations(side) == ()
    assert [mode.slip.tolist() for mode in Blowup(StaticAboveKinetic(1.5), [1.0]).continuations(side)] == [[0]]


def test_modified_law_has_two_futures_inside():
    """Section 5, figure 6(b): two stable modes; a block beside a slipping one is held to F1 = 5/4 on one side."""
    modes = continuations(PAIR, Modified(), Z_HALF, -1.0)
    assert [m.slip.tolist() for m in modes] == [[0, 0], [0, 0]]
    blowup = Blowup(Modified(), [1.0, 1.0])
    assert len(blowup.sticking_modes([1.24, 0.0], [0, 1])) == 2
    assert len(blowup.sticking_modes([1.26, 0.0], [0, 1])) == 0


# --- errors --------------------------------------------------------------------------------------------------


def test_entry_between_basins_is_an_error():
    with pytest.raises(IntegrationError, match="ends in the unstable mode"):
        run_with_law(PAIR, Modified(), Z_HALF, -1.0, 1.0, entry=0.0)
