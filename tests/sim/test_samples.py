"""Samples of the state, and further definitions of sticking: read off a run that they do not change."""

import numpy as np
import pytest

from stickslip.sim import System, draw_system, simulate

ENGINES = {
    "coulomb": {"engine": "coulomb", "tol": 1e-12},
    "sigmoid": {"engine": "sigmoid", "rtol": 1e-8, "atol": 1e-8},
}


@pytest.fixture(scope="module", params=ENGINES)
def settings(request):
    return ENGINES[request.param]


@pytest.fixture(scope="module")
def system():
    return draw_system("antisymmetric", 30, 4)


def test_a_block_between_stick_and_rest():
    """One block (AUDIT, first row): on the belt to t = 3.956..., then an overdamped return in closed form."""
    rho, kappa, v, t_exit, z_exit = 3.5, 0.2, -0.2, 3.9564549379897342, -1.5
    t = np.array([0.0, 1.0, 3.0, t_exit, 5.0, 40.0])
    kept = simulate(System([[kappa]], rho, 1.0, v), -0.7, -0.4, 50.0, t_eval=t, tol=1e-13, stop_early=False).samples
    fast, slow = (-0.5 * (rho + sign * np.sqrt(rho**2 - 4 * kappa)) for sign in (1, -1))
    late = t[3:] - t_exit
    # z - z_eq = a exp(fast t) + b exp(slow t); z_eq = -1/kappa, slope v at the exit
    b = (v - fast * (z_exit + 5.0)) / (slow - fast)
    a = z_exit + 5.0 - b
    expected = a * np.exp(fast * late) + b * np.exp(slow * late) - 5.0
    np.testing.assert_array_equal(kept.t, t)
    assert (kept.z[0, 0], kept.w[0, 0]) == (-0.7, -0.4)
    np.testing.assert_allclose(kept.z[1:3, 0], z_exit - v * (t_exit - t[1:3]), rtol=1e-12)
    np.testing.assert_allclose(kept.w[1:3, 0], v, rtol=1e-14)
    np.testing.assert_allclose(kept.z[3:, 0], expected, rtol=1e-11)


@pytest.mark.parametrize("n", [3, 20])
def test_a_collapsed_run_is_the_one_that_goes_on(settings, n, rng):
    """Past a collapse the motion is that of the modes: the same states, to the end, as step by step."""
    saved = 0
    for k in range(16):  # three of ten save nothing
        if k >= 4 and saved:
            break
        system = draw_system("antisymmetric", n, rng.integers(2**32))
        start = rng.normal(size=(2, n))
        run, full = (
            simulate(system, *start, 800.0, t_eval=np.linspace(0.0, 800.0, 81), stop_early=stop_early, **settings)
            for stop_early in ("always", False)
        )
        if run.outcome != "collapsed":  # one in some hundreds takes longer
            continue
        assert run.t_collapse < run.t_end == 800.0
        assert full.outcome == "finished"
        assert full.t_collapse is None
        bound = (1e-9 if settings["engine"] == "coulomb" else 1e-5) * max(1.0, np.abs(full.samples.z).max())
        np.testing.assert_allclose(run.z, full.z, rtol=0, atol=bound)
        np.testing.assert_allclose(run.samples.z, full.samples.z, rtol=0, atol=bound)
        np.testing.assert_allclose(run.samples.w, full.samples.w, rtol=0, atol=bound)
        saved += full.stats.n_products - run.stats.n_products
    assert saved > 0


def test_a_collapse_ends_no_definition_of_sticking_early():
    """|w - v| < c delta with c delta = 0.15, and 0.21 > |v|: blocks enter the first late, the second for good."""
    system = draw_system("antisymmetric", 20, 0)
    run, full = (
        simulate(system, -0.7, -0.4, 1000.0, engine="sigmoid", thresholds=[5.0, 7.0], stop_early=stop_early)
        for stop_early in ("always", False)
    )
    assert run.outcome == "collapsed"
    for c, at_the_end in ((5.0, 0), (7.0, 20)):
        assert full.by_threshold[c].n_stick(1000.0) == at_the_end
        np.testing.assert_array_equal(run.by_threshold[c].block, full.by_threshold[c].block)
        np.testing.assert_array_equal(run.by_threshold[c].mode, full.by_threshold[c].mode)


def test_of_a_run_without_length(system, settings):
    kept = simulate(system, -0.7, -0.4, 2.0, t_start=2.0, t_eval=[2.0, 2.0], **settings).samples
    np.testing.assert_array_equal(kept.z, np.full((2, 30), -0.7))
    np.testing.assert_array_equal(kept.w, np.full((2, 30), -0.4))


def test_further_definitions_are_those_of_runs_of_their_own(system):
    ratio = 1.0 - np.random.default_rng(3).random(30)
    common = {**ENGINES["sigmoid"], "ratio": ratio, "stop_early": False}
    run = simulate(system, -0.7, -0.4, 20.0, thresholds=[2.0, 0.5], **common)
    assert list(run.by_threshold) == [2.0, 0.5]
    for threshold, series in run.by_threshold.items():
        own = simulate(system, -0.7, -0.4, 20.0, stick="threshold", threshold=threshold, **common).events
        np.testing.assert_array_equal(series.block, own.block)
        np.testing.assert_array_equal(series.mode, own.mode)
        np.testing.assert_array_equal(series.initial_mode, own.initial_mode)
        np.testing.assert_allclose(series.t, own.t, atol=1e-5)
    plain = simulate(system, -0.7, -0.4, 20.0, **common)
    np.testing.assert_array_equal(run.events.t, plain.events.t)
    assert run.stats == plain.stats
