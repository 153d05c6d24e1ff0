"""The stiff engine against an independent method, and its limit eps -> 0."""

import numpy as np
import pytest

from stickslip.sim import System, draw_system, simulate

START = (-0.7, -0.4)


def test_rtol_counts_where_values_are_large_and_atol_where_they_are_small():
    """The same free oscillation, z = size cos t, from far out and from close by."""
    system = System([[1.0]], 0.0, 0.0, 0.0)

    def steps(size, rtol, atol):
        run = simulate(system, size, 0.0, 20.0, engine="sigmoid", rtol=rtol, atol=atol)
        assert abs(run.z[0] - size * np.cos(20.0)) < 100 * (atol + rtol * size)
        return run.stats.n_steps

    of_rtol, of_atol = {"rtol": 1e-5, "atol": 1e-9}, {"rtol": 1e-9, "atol": 1e-5}
    assert 2 * steps(1e3, **of_rtol) < steps(1e3, **of_atol)
    assert 2 * steps(1e-3, **of_atol) < steps(1e-3, **of_rtol)


def test_the_error_of_z_is_kept_too():
    """A slow oscillation, z = 100 sin(t / 100), w = cos(t / 100): what w errs by, z errs by a hundredfold."""
    run = simulate(System([[1e-4]], 0.0, 0.0, 0.0), 0.0, 1.0, 500.0, engine="sigmoid", rtol=1e-12, atol=1e-6)
    assert abs(run.z[0] - 100 * np.sin(5.0)) < 3e-5


def errors_against_coulomb(system, eps, t_end):
    """Largest error of the state, and of the times of exits and of entries."""
    exact = simulate(system, *START, t_end, tol=1e-13, stop_early=False)
    run = simulate(system, *START, t_end, engine="sigmoid", eps=eps, rtol=1e-9, atol=1e-9, stop_early=False)
    state = max(np.abs(run.z - exact.z).max(), np.abs(run.w - exact.w).max())
    ours, theirs = (each.events.by_block for each in (run, exact))
    np.testing.assert_array_equal(run.events.block[ours], exact.events.block[theirs])
    np.testing.assert_array_equal(run.events.mode[ours], exact.events.mode[theirs])
    late = np.abs(run.events.t[ours] - exact.events.t[theirs])
    enters = exact.events.mode[theirs] == 0
    return state, late[~enters].max(), late[enters].max()


def test_converges_to_coulomb():
    """The error of state and exits is O(eps); entries see the band eps ln(1/eps), over the speed of approach."""
    system, eps = draw_system("antisymmetric", 20, seed=3), np.array([0.01, 0.003, 0.001, 0.0003])
    state, exits, entries = np.array([errors_against_coulomb(system, each, 25.0) for each in eps]).T
    assert (np.diff(entries) < 0).all()
    for error in (state, exits):
        assert 0.85 < np.polyfit(np.log(eps), np.log(error), 1)[0] < 1.15


def test_the_plain_threshold_does_not_converge():
    """|w - v| < c delta means |lambda| < tanh c: with c = 1 exits stay early by (1 - tanh 1) / |lambda'|."""
    system = System([[1.0]], damping=0.1)  # |lambda'| = kappa |v| = 0.2; sticks from the start at z = 0
    exact = simulate(system, 0.0, -0.2, 8.0, tol=1e-13).events
    assert exact.mode.tolist() == [1]
    for eps in (1e-3, 1e-4):
        run = simulate(system, 0.0, -0.2, 8.0, engine="sigmoid", eps=eps, stick="threshold", rtol=1e-9, atol=1e-9)
        assert run.events.mode.tolist() == [1]
        assert exact.t[0] - run.events.t[0] == pytest.approx((1 - np.tanh(1)) / 0.2, rel=0.02)
