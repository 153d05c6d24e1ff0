"""The paper's formulas as printed, against the equations that govern: rows of workflows/paper.md."""

import numpy as np
import pytest

from stickslip.sim import draw_system, simulate
from stickslip.workflows.gallery.theory.blowup import Blowup
from stickslip.workflows.gallery.theory.folds import can_stick, two_blocks
from stickslip.workflows.gallery.theory.laws import Modified

K1, K2, K12, RHO, MU, V = 1.1, 1.6, 0.5, 0.1, 1.0, -1.0
START = (-0.7, -0.4)


def pair(s):
    return two_blocks(K1, K2, K12, RHO, MU, V, s)


def states(m):
    return np.random.default_rng(0).uniform(-3, 3, (m, 2))


def held(first, second):
    return np.column_stack([np.abs(first) < MU, np.abs(second) < MU])


def test_eq_7_as_printed_is_the_other_sign_of_eq_6():
    """Held by the engine, and by (7) as printed, alike for s = -1; for s = +1 kappa12 changes its sign."""
    z = states(2000)
    printed = held(RHO * V + (K1 - K12) * z[:, 0] + K12 * z[:, 1], RHO * V + K12 * z[:, 0] + (K2 - K12) * z[:, 1])
    np.testing.assert_array_equal(can_stick(pair(-1), z), printed)
    assert (can_stick(pair(1), z) != printed).any(axis=1).mean() > 0.1
    for state in z[:20]:
        for s in (1, -1):
            mode = simulate(pair(s), state, V, 0.0).events.initial_mode
            np.testing.assert_array_equal(mode == 0, can_stick(pair(s), state))


def test_the_second_stick_condition_has_kappa_2_times_z_2():
    """Section 3 prints kappa2 z1 - kappa12 (z2 - z1); with kappa2 z2 it is that of (7)."""
    z = states(2000)
    first = RHO * V + K1 * z[:, 0] + K12 * (z[:, 1] - z[:, 0])
    printed, meant = (RHO * V + K2 * z[:, k] - K12 * (z[:, 1] - z[:, 0]) for k in (0, 1))
    sticks = can_stick(pair(-1), z)
    np.testing.assert_array_equal(sticks, held(first, meant))
    assert (sticks != held(first, printed)).any(axis=1).mean() > 0.1


def test_the_factors_of_eq_13_move_basins_and_no_mode():
    """Layers of unequal width: the same modes, the same entry, another destination."""
    force, entry = [0.5, -0.5], [-0.6, 0.5]
    even, uneven = (Blowup(Modified(), [1.0, 1.0], eps=eps) for eps in ([1.0, 1.0], [0.05, 1.0]))
    a, b = ([mode.lam for mode in blowup.sticking_modes(force)] for blowup in (even, uneven))
    np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(even.settle(force, entry).lam, [-0.5, 0.0], atol=1e-10)
    np.testing.assert_allclose(uneven.settle(force, entry).lam, [0.0, 0.5], atol=1e-10)


@pytest.mark.parametrize(
    ("coupling", "outcomes"),
    [
        ("antisymmetric", {"collapsed"}),
        ("signed_diagonal", {"diverged"}),
        ("full", {"diverged"}),
        ("symmetric", {"diverged"}),
    ],
)
def test_of_the_readings_of_section_4_one_comes_to_rest_at_20_blocks(coupling, outcomes):
    """Figure 3 (i): all slip in the end. Three draws of each reading."""
    runs = [simulate(draw_system(coupling, 20, seed), *START, 2000.0) for seed in range(3)]
    assert {run.outcome for run in runs} == outcomes


def test_strictly_triangular_draws_are_too_strong():
    """Entries up to kappa, not halved with their mirror: 100 blocks do not come to rest, unlike figure 3 (ii)."""
    runs = [simulate(draw_system("antisymmetric_triangle", 100, seed), *START, 400.0) for seed in range(2)]
    for run in runs:
        assert run.outcome == "finished"
        assert run.n_stick(np.linspace(200, 400, 50)).mean() > 5


def test_springs_are_always_stable():
    """The couplings of (6) on any graph: no draw can sustain itself, whatever n."""
    for n in (20, 100, 200):
        growth = np.linalg.eigvals(draw_system("springs", n, seed=0).slip_matrix()).real.max()
        assert growth < 0


def test_the_distance_of_two_runs_never_grows_for_springs():
    """K symmetric and positive: |w - w'|^2 + (z - z')^T K (z - z') falls, since -Sign is monotone."""
    system = draw_system("springs", 12, seed=1)
    rng = np.random.default_rng(0)
    one, other = ((START[0] + rng.normal(size=12), START[1] + rng.normal(size=12)) for _ in range(2))
    before = np.inf
    for k in range(60):
        dz, dw = one[0] - other[0], one[1] - other[1]
        distance = dw @ dw + dz @ system.stiffness @ dz
        assert distance <= before * (1 + 1e-9)
        before = distance
        runs = [simulate(system, z, w, k + 1.0, t_start=float(k), stop_early=False) for z, w in (one, other)]
        one, other = ((run.z, run.w) for run in runs)
