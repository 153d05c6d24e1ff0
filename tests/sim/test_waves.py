"""The exact law by waveform relaxation: against a method that shares no code, and against series.

Only large systems are run so; here small ones are too, by `by_waves`, so that the independent method can follow.
"""

import numpy as np
import pytest
from scipy.sparse import csc_array

from stickslip.sim import Harmonic, IntegrationError, Piecewise, Rational, System, draw_system, simulate
from stickslip.sim.engines import course
from stickslip.sim.engines.coulomb import settings, waves
from tests import independent
from tests.sim.test_touches import slipping
from tests.systems import draw_case, made

BOUND = 20.0  # error over the tolerance, the largest speed and the sensitivity
WAVES, SERIES = "waveform relaxation", "Taylor series"


SHORT, LIGHT, STORAGE = settings.SHORT, settings.LIGHT, settings.Coulomb.is_sparse


@pytest.fixture(autouse=True)
def however_short(monkeypatch):
    """Runs as short as most here, and lightly damped ones, are left to series for their cost alone."""
    monkeypatch.setattr(settings, "SHORT", 0.0)
    monkeypatch.setattr(settings, "LIGHT", -np.inf)


@pytest.fixture
def by_waves(monkeypatch):
    for name, value in {
        "SIZE_OF_WAVES": 1,
        "MANY_ENTRIES": 0,
        "OF_JUMPS": (0.0, 0.0, 1e-10),
        "MOST_MEMORY": np.inf,
    }.items():
        monkeypatch.setattr(settings, name, value)


def large(rng, n, static=1.0, **terms):
    """A dense system of many blocks, and a start."""
    seed = int(rng.integers(2**31))
    system = draw_system("antisymmetric", n, seed, kappa=0.2)
    system = system.changed(static=system.friction * static, **terms)
    return system, rng.normal(size=n), np.where(rng.random(n) < 0.5, system.belt_speed, rng.normal(size=n))


def scale(system, run, w0):
    return max(system.fastest_belt, np.abs(w0).max(), np.abs(run.samples.w).max(initial=0.0))


def error(run, other):
    at_end = max(np.abs(run.z - other.z).max(), np.abs(run.w - other.w).max())
    sampled = (run.samples.z - other.samples.z, run.samples.w - other.samples.w)
    return max(at_end, *(np.abs(apart).max(initial=0.0) for apart in sampled))


def test_small_systems_are_as_a_method_that_shares_no_code_has_them(by_waves, rng):
    """With masses and static friction, and blocks that start on their belt."""
    followed, beyond = 0, []
    for _ in range(30):
        case = draw_case(rng, (1, 6), belt_speed=(-0.2, 0.3, -1.0), terms=("static", "mass"), on_belt=0.3)
        system, tol, t_end = made(case), float(10.0 ** -rng.integers(3, 7)), float(rng.uniform(1.0, 6.0))
        if not settings.Coulomb(tol=tol).is_by_waves(system):
            continue
        times = np.sort(rng.uniform(0.0, t_end, 5))
        run = simulate(system, case.z0, case.w0, t_end, tol=tol, t_eval=times, stop_early=False)
        try:
            z, w = independent.follow(case, t_end).at(times)
            moved = 0.0
            for size in (1e-6, -1e-6):
                shift = size * rng.choice([-1.0, 1.0], system.n)
                near = independent.follow(independent.replace(case, z0=case.z0 + shift), t_end)
                moved = max(moved, *(np.abs(a - b).max() / 1e-6 for a, b in zip(near.at(times), (z, w), strict=True)))
        except independent.Undecided:
            continue
        unit = max(np.abs(w).max(), np.abs(case.w0).max(), system.fastest_belt) * max(1.0, moved)
        found = max(np.abs(run.samples.z - z).max(), np.abs(run.samples.w - w).max()) / (tol * unit)
        if found >= BOUND:
            beyond.append((found, system, case.z0, case.w0, tol))
        followed += run.stats.method == WAVES
    assert followed > 2  # of some fifteen
    assert len(beyond) <= 1, beyond  # one of 10,000 is let go, or not, by less than its tolerance


@pytest.mark.parametrize("damping", [-2.0, 3.0])
def test_a_block_that_grows_or_fades_within_a_step_is_followed_throughout(by_waves, damping):
    """Under the steady pull of one that sticks; F is then a straight line, which limits no step. Closed form."""
    v, mu, pull, tol, times = 0.2, 0.3, 1.0, 1e-6, np.linspace(0.05, 12.0, 201)
    system = System([[0.0, -pull], [0.0, 0.0]], [damping, 0.0], [mu, 2.0], v)
    run = simulate(system, [0.0, 2.0], [1.0, v], 12.0, tol=tol, t_eval=times, stop_early=False)
    assert run.stats.method == WAVES
    assert len(run.events) == 0
    # w' = -R w + pull (2 + v t) - mu
    slope, r = pull * v, damping
    steady = (2.0 * pull - mu) / r - slope / r**2
    w = steady + slope / r * times + (1.0 - steady) * np.exp(-r * times)
    z = steady * times + slope / r * times**2 / 2 + (1.0 - steady) * (1 - np.exp(-r * times)) / r
    assert (np.abs(run.samples.w[:, 0] - w) / np.maximum(1.0, np.abs(w))).max() < BOUND * tol
    assert (np.abs(run.samples.z[:, 0] - z) / np.maximum(1.0, np.abs(z))).max() < BOUND * tol


@pytest.mark.parametrize("damping", [20.0, 50.0])
def test_a_block_that_creeps_meets_its_belt_within_a_step_far_longer_than_its_damping_takes(by_waves, damping):
    """K = 1, on its slow motion w = w0 exp(-s t), of s + 1 / s = R: a series about an instant is good for 1 / R."""
    v, mu, tol, s = 0.01, 0.2, 1e-5, 2.0 / (damping + np.sqrt(damping**2 - 4.0))
    w0 = s * (2.0 - mu)
    caught = np.log(w0 / v) / s
    run = simulate(System([[1.0]], damping, mu, v), -2.0, w0, caught + 3.0, tol=tol, stop_early=False)
    assert (run.stats.method, run.events.mode.tolist()) == (WAVES, [0])
    assert abs(run.events.t[0] - caught) < BOUND * tol * w0 / (s * v)  # the error of w over w'
    assert run.z[0] == pytest.approx(-mu - v / s + 3.0 * v, abs=BOUND * tol)


def test_a_block_that_is_let_go_soon_after_the_start_leaves_then(by_waves, rng):
    """F passes static friction at the rate K v; nothing else moves."""
    v, soon = 0.2, 10.0 ** rng.uniform(-8, -3)
    run = simulate(System([[1.0]], 0.0, 1.0, v), 1.0 - v * soon, v, 1.0, tol=1e-3)
    assert run.stats.method == WAVES
    assert run.events.t[0] == pytest.approx(soon, rel=1e-6, abs=1e-14)


@pytest.mark.parametrize(("static", "least", "tols"), [(1.0, 80, (1e-3, 1e-6)), (1.3, 70, (1e-3, 1e-5))])
def test_large_systems_are_as_series_have_them(static, least, tols, rng):
    """Events, until paths part; the error about the tolerance times the sensitivity."""
    n, t_end = least + int(rng.integers(46)), 12.0
    system, z, w = large(rng, n, static)
    times = np.linspace(0.0, t_end, 7)
    exact = simulate(system, z, w, t_end, t_eval=times, tol=1e-12, stop_early=False)
    assert exact.stats.method == SERIES
    shift = 1e-7 * rng.choice([-1.0, 1.0], n)
    near = simulate(system, z + shift, w, t_end, t_eval=times, tol=1e-12, stop_early=False)
    sensitivity = error(near, exact) / 1e-7
    for tol in tols:
        run = simulate(system, z, w, t_end, t_eval=times, tol=tol, stop_early=False)
        assert run.stats.method == WAVES
        assert error(run, exact) < BOUND * tol * scale(system, exact, w) * max(1.0, sensitivity)
    half = range(len(exact.events) // 2)
    there = [np.abs(run.events.t[run.events.block == exact.events.block[k]] - exact.events.t[k]) for k in half]
    assert np.mean([(gaps < 1e3 * tols[-1]).any() for gaps in there]) > 0.95  # a touch more or less is none lost


def test_the_error_is_a_small_share_of_the_tolerance_where_damping_fades_it():
    """The same systems each time: the geometric mean of their errors was 0.03 tolerances."""
    tol, times, errors = 1e-5, np.linspace(0.5, 4.0, 8), []
    for seed in range(6):
        system, z, w = large(np.random.default_rng(seed), 64)
        exact = simulate(system, z, w, 4.0, tol=1e-13, t_eval=times)
        run = simulate(system, z, w, 4.0, tol=tol, t_eval=times)
        assert (run.stats.method, exact.stats.method) == (WAVES, SERIES)
        errors.append(error(run, exact) / (tol * scale(system, exact, w)))
    assert np.exp(np.log(errors).mean()) < 0.1


@pytest.mark.parametrize(("damping", "tol"), [(0.02, 1e-3), (1.0, 1e-5)])
def test_touches_are_told_by_an_error_that_is_that_of_the_run(damping, tol, monkeypatch, rng):
    """The median of eight runs: it was 0.4 to 1.7 of the estimate; `tol` itself is 0.3 to 5 times the error."""
    shares, errors, go_on = [], [], waves._Waves.go_on

    def keeping(self, k):
        run = go_on(self, k)
        errors.append(self.states.clock[k, course.ERROR])
        return run

    monkeypatch.setattr(waves._Waves, "go_on", keeping)
    for _ in range(8):
        root = rng.normal(size=(66, 132))
        system = System(root @ root.T / 132, damping, 1.0, -0.2)
        z, w = rng.normal(size=(2, 66))
        exact = simulate(system, z, w, 10.0, tol=1e-11, stop_early=False)
        run = simulate(system, z, w, 10.0, tol=tol, stop_early=False)
        assert run.stats.method == WAVES
        shares.append(
            np.abs(run.w - exact.w)[run.events.mode_at(10.0) == exact.events.mode_at(10.0)].max() / errors[-1]
        )
    assert 0.1 < np.median(shares) < 5.0


def undamped(rng, n, damping):
    """Springs that are symmetric and positive, so that errors neither grow nor fade but by damping."""
    root = rng.normal(size=(n, n)) / np.sqrt(n)
    stiffness = 0.5 * root @ root.T + 0.5 * np.eye(n)
    return System(stiffness, damping, 1.0, -0.2), rng.normal(size=n) * 2.0, rng.normal(size=n)


@pytest.mark.parametrize("tol", [1e-3, 1e-5])
def test_errors_that_nothing_fades_stay_below_the_tolerance(tol):
    """Over 300 units of time, by whichever method; by waves alone they were up to 30 tolerances."""
    for damping in (0.0, 0.01):
        system, z, w = undamped(np.random.default_rng(3), 66, damping)
        exact = simulate(system, z, w, 300.0, tol=1e-13, stop_early=False)
        run = simulate(system, z, w, 300.0, tol=tol, stop_early=False)
        assert error(run, exact) < tol * scale(system, exact, w)
        assert run.events.block.tolist() == exact.events.block.tolist()


def test_how_long_errors_add_up():
    system = System(4.0 * np.eye(2), [0.5, 1.0], 1.0, -0.2)
    add_up = settings.Coulomb.accumulation
    assert add_up(system, 1e6) == 1.0  # 2 / 0.5 is forgotten
    assert add_up(system.changed(damping=[0.01, 1.0]), 1e6) == pytest.approx(
        100.0 * system.rates.max() / 50.0, rel=0.1
    )
    assert add_up(system.changed(damping=0.0), 500.0) == pytest.approx(20.0)
    assert add_up(system.changed(damping=-1.0), 500.0) == pytest.approx(20.0, rel=0.5)


def test_a_run_that_stalls_is_begun_anew_and_counted(monkeypatch, rng):
    system, z, w = large(rng, 66)
    with monkeypatch.context() as without_waves:
        without_waves.setattr(settings, "SIZE_OF_WAVES", 100)
        series = simulate(system, z, w, 1.0, tol=1e-5)
    assert (series.stats.method, series.stats.n_restarts) == (SERIES, 0)

    def stalls(stack, events, first, slices):
        stack.state.counters[0, course.N_PRODUCTS] = 1000
        slices[0, 0] = course.STALLED

    monkeypatch.setattr(waves._Waves, "is_of_one_type", False)  # else it is machine code
    monkeypatch.setattr(waves._Waves, "kernel", staticmethod(stalls))
    run = simulate(system, z, w, 1.0, tol=1e-5)
    assert (run.stats.method, run.stats.n_restarts) == (SERIES, 1)
    assert run.stats.n_products == series.stats.n_products + 1000
    assert run.z.tobytes() == series.z.tobytes()


def test_what_ends_a_run_otherwise_is_said(monkeypatch, rng):
    def leaves_float64(stack, events, first, slices):
        stack.state.z[:] = np.nan
        slices[0, 0] = course.DIVERGED

    monkeypatch.setattr(waves._Waves, "is_of_one_type", False)
    monkeypatch.setattr(waves._Waves, "kernel", staticmethod(leaves_float64))
    system, z, w = large(rng, 66)
    with pytest.raises(IntegrationError, match="the state is not finite"):
        simulate(system, z, w, 1.0, tol=1e-5)


@pytest.mark.parametrize(("length", "time"), [(1e-200, 1.0), (1.0, 1e60), (1e60, 1e-20)])
def test_single_precision_keeps_to_its_range(length, time):
    """|K| from 1e-120 to 1e50, and lengths beyond float32: the same motion in other units."""
    system, z, w = undamped(np.random.default_rng(5), 66, 0.3)
    unit = length / time
    other = System(system.stiffness / time**2, system.damping / time, unit / time, system.belt_speed * unit)
    run = simulate(other, z * length, w * unit, 15.0 * time, tol=2e-6, stop_early=False)
    exact = simulate(system, z, w, 15.0, tol=1e-12, stop_early=False)
    assert run.stats.method == WAVES
    assert len(run.events) == len(exact.events)
    np.testing.assert_allclose(run.z / length, exact.z, rtol=0, atol=5e-6)


def test_stick_slip_of_one_block_has_the_period_of_the_closed_form(by_waves):
    """K = 1, R = 0: it sticks for 2 drop / (K v), and slips for 2 (pi - arctan(drop / v)); drop = m - mu."""
    drop, v = 0.3, 0.2
    system = System([[1.0]], 0.0, 1.0, -v, static=1.0 + drop)
    run = simulate(system, 0.0, -v, 100.0, tol=3e-6)
    assert run.stats.method == WAVES
    exits = run.events.t[run.events.is_exit]
    period = 2 * drop / v + 2 * (np.pi - np.arctan(drop / v))
    np.testing.assert_allclose(np.diff(exits), period, rtol=1e-5)


def test_a_slip_far_below_the_error_is_a_touch_and_one_far_above_counts(by_waves):
    for over, modes in ((2e-6, []), (1e-2, [-1, 0])):
        run, events = slipping(over, 1e-5)
        assert (run.stats.method, events.mode.tolist()) == (WAVES, modes)


def test_blocks_that_all_stick_are_noted(by_waves):
    """A stiff pair that its belt carries: both stick from time to time."""
    system = System([[2.0, -1.0], [-1.0, 2.0]], 0.1, 1.0, -0.1, static=[1.3, 1.4])
    waves, series = (simulate(system, [0.1, -0.2], -0.1, 60.0, tol=tol) for tol in (1e-6, 1e-12))
    assert (waves.stats.method, series.stats.method) == (WAVES, SERIES)
    assert len(waves.stills.t) == len(series.stills.t) > 4
    np.testing.assert_allclose(waves.stills.t, series.stills.t, atol=1e-4)
    np.testing.assert_allclose(waves.stills.total, series.stills.total, atol=1e-4)


OTHERS = {
    "few blocks": lambda s: draw_system("antisymmetric", 63, 1, kappa=0.2),
    "a force": lambda s: s.changed(force=Harmonic(0.1, 1.0)),
    "a belt that changes": lambda s: s.changed(belt_speed=Piecewise([0.0, 1.0], [-0.1, -0.2])),
    "weakening": lambda s: s.changed(weakening=Rational(0.5)),
    "no back slip": lambda s: s.changed(back_slip=False),
    "belts at rest": lambda s: s.changed(belt_speed=0.0),
    "heavy damping": lambda s: s.changed(damping=np.where(np.arange(s.n) == 3, 1e5, s.damping)),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_what_it_does_not_take_is_run_by_series(kind):
    system = OTHERS[kind](draw_system("antisymmetric", 64, 1, kappa=0.2))
    assert not settings.Coulomb(tol=1e-5).is_by_waves(system)
    assert simulate(system, 0.1, "belt", 0.5, tol=1e-5).stats.method == SERIES


def test_a_sparse_array_of_many_entries_a_row_is_run_as_the_dense_one(rng):
    """Their products differ by rounding, and those of the dense one are in single precision after the first."""
    system, z0, w0 = large(rng, 128)
    stiffness = np.where(rng.random((128, 128)) < 0.1, system.stiffness, 0.0) + np.diag(system.stiffness.diagonal())
    sparse = system.changed(stiffness=csc_array(stiffness))
    runs = [simulate(one, z0, w0, 2.0, tol=1e-6) for one in (system.changed(stiffness=stiffness), sparse)]
    assert [run.stats.method for run in runs] == [WAVES, WAVES]
    assert len(runs[0].events) == len(runs[1].events) > 10
    assert error(*runs) < 10 * 1e-6 * scale(system, runs[0], w0)


def test_tighter_tolerances_take_more_blocks():
    for n, least in ((64, 6e-7), (95, 1e-7), (258, 1e-9), (425, 1e-10), (2000, 1e-10)):
        system = System(np.eye(n) + 0.01, 1.0, 1.0, -0.2)
        assert settings.Coulomb(tol=least).is_by_waves(system)
        assert not settings.Coulomb(tol=0.9 * least).is_by_waves(system)


def test_jumps_of_friction_are_left_to_series_but_at_loose_tolerances():
    for n, tol, by_waves in ((64, 3.6e-6, True), (64, 3.5e-6, False), (212, 1e-7, True), (212, 0.9e-7, False)):
        system = System(np.eye(n) + 0.01, 1.0, 1.0, -0.2, static=1.3)
        assert settings.Coulomb(tol=tol).is_by_waves(system) == by_waves


def test_a_start_on_the_edge_between_two_modes_is_left_to_series(rng):
    """|F| = m at the belt's speed: the first derivative of F that does not vanish decides."""
    n = 64
    system = System(np.eye(n) + 0.01, 0.0, 1.0, -0.2)
    z = np.full(n, 1.0 / system.row_sums[0])
    assert simulate(system, z, -0.2, 1.0, tol=1e-5).stats.method == SERIES
    assert simulate(system, z + 0.1 * rng.random(n), -0.2, 1.0, tol=1e-5).stats.method == WAVES
    modes = np.zeros(n, dtype=int)
    assert simulate(system, 0.5 * z, -0.2, 1.0, tol=1e-5, modes=modes).stats.method == SERIES


def test_many_equal_blocks_stay_together():
    """Blocks that rounding alone tells apart have their events within the tolerance of each other."""
    n, tol = 256, 1e-4
    system = System(np.eye(n) + 0.0025, 0.1, 1.0, -0.2, static=1.3)
    run = simulate(system, 0.3, -0.2, 25.0, tol=tol)
    assert run.stats.method == WAVES
    assert len(run.events) % n == 0
    assert len(run.events) > 2 * n
    assert np.ptp(run.events.t.reshape(-1, n), axis=1).max() < tol
    assert np.ptp(run.z) < tol


def test_short_runs_are_left_to_series_and_lightly_damped_ones_at_tight_tolerances(monkeypatch):
    """100 blocks, rates of 2: from 25 units of time on; a damping of a quarter of the rates is light."""
    monkeypatch.setattr(settings, "SHORT", SHORT)
    system, engine = System(np.eye(100) / 101.0 + 1.0 / 101.0, 1.0, 1.0, -0.2), settings.Coulomb(tol=1e-6)
    assert system.fastest_rate == pytest.approx(2.0)
    assert [engine.is_by_waves(system, length) for length in (1e-4, 24.0, 26.0)] == [True, False, True]
    monkeypatch.setattr(settings, "LIGHT", LIGHT)
    light = system.changed(damping=0.33)
    assert [settings.Coulomb(tol=tol).is_by_waves(light, 100.0) for tol in (1e-6, 1e-5)] == [False, True]


def test_storage_of_k_decides_nothing(monkeypatch, rng):
    """A chain, and a K of all entries: the same to the last bit, by local updates and without."""
    monkeypatch.setattr(settings, "LIGHT", LIGHT)
    monkeypatch.setattr(settings.Coulomb, "is_sparse", staticmethod(STORAGE))
    for n, method, stiffness in (
        (120, SERIES, 2.0 * np.eye(120) - np.eye(120, k=1) - np.eye(120, k=-1)),
        (20, SERIES, np.eye(20) + rng.normal(size=(20, 20)) / 20.0),
        (100, WAVES, np.eye(100) + rng.normal(size=(100, 100)) / 100.0),
    ):
        system = System(stiffness, 0.3, 1.0, -0.2)
        z, w = rng.uniform(-1.0, 1.0, (2, n))
        sparse = system.changed(stiffness=csc_array(stiffness))
        runs = [simulate(one, z, w, 5.0, tol=1e-5) for one in (system, sparse)]
        assert runs[0].stats == runs[1].stats
        assert runs[0].stats.method == method
        np.testing.assert_array_equal(runs[0].z, runs[1].z)
        np.testing.assert_array_equal(runs[0].events.t, runs[1].events.t)
    is_sparse = settings.Coulomb.is_sparse
    assert [is_sparse(System(np.eye(n) + np.eye(n, k=1), 1.0), False) for n in (40, 100)] == [False, True]
    assert not is_sparse(draw_system("antisymmetric", 100, 0), True)


def test_few_entries_a_row_are_waves_at_loose_tolerances(monkeypatch):
    n = 400
    grid = System(csc_array(5.0 * np.eye(n) - sum(np.eye(n, k=k) for k in (-20, -1, 1, 20))), 2.0, 1.0, -0.2)
    assert settings.Coulomb(tol=1e-6).is_by_waves(grid)
    assert not settings.Coulomb(tol=0.9e-6).is_by_waves(grid)
    monkeypatch.setattr(settings, "LIGHT", LIGHT)
    assert not settings.Coulomb(tol=1e-5).is_by_waves(grid.changed(damping=0.3))
