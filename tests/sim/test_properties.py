"""What holds for every system beside agreement with the reference and symmetries, which the fuzz holds."""

import copy
import gc
import pickle
import weakref

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp, trapezoid
from scipy.linalg import expm

from stickslip.sim import EventSeries, System, draw_system, simulate
from stickslip.sim.engines import certificates
from stickslip.sim.runs.series import without_returns
from tests import independent
from tests.systems import TERMS, draw_case, draw_run, made


def assert_same(run, t, block, mode, atol=1e-9):
    """The events of a run are these, in any order of the blocks at one instant."""
    order = np.lexsort((block, t))
    t, block, mode = (np.asarray(x)[order] for x in (t, block, mode))
    assert run.events.block.tolist() == list(block)
    assert run.events.mode.tolist() == list(mode)
    np.testing.assert_allclose(run.events.t, t, rtol=0, atol=atol)


SMOOTH = {"engine": "sigmoid", "eps": 0.02, "rtol": 1e-7, "atol": 1e-7}


@pytest.mark.parametrize(
    ("law", "cross"),
    [
        ({"engine": "coulomb", "tol": 1e-12}, 0.0),
        (SMOOTH, 0.3),
        (SMOOTH | {"stick": "threshold", "threshold": 3.0}, 0.0),
    ],
    ids=["coulomb", "cross damping", "threshold"],
)
def test_nothing_happens_after_a_certified_collapse(law, cross):
    n_collapsed = n_stable = 0
    for seed in range(200):
        system, z0, w0 = draw_run(
            np.random.default_rng([seed, 7]), (1, 5), "antisymmetric", damping=(0.2, 3.0), friction=(0.2, 1.0),
            belt_speed=(-0.5, -0.2, 0.3), cross=cross,
        )  # fmt: skip
        if n_stable == 20 or np.linalg.eigvals(system.slip_matrix()).real.max() > -0.02:
            continue
        n_stable += 1
        run = simulate(system, z0, w0, 150.0, stop_early="always", **law)
        if run.outcome != "collapsed":
            continue
        n_collapsed += 1
        full = simulate(system, z0, w0, 150.0, stop_early=False, **law)
        assert full.outcome == "finished"
        assert_same(full, run.events.t, run.events.block, run.events.mode)
        assert run.n_stick(150.0) == 0
        assert run.t_end == 150.0
        assert run.t_collapse < 150.0
        np.testing.assert_allclose(run.z, full.z, rtol=0, atol=1e-5)
        np.testing.assert_allclose(run.w, full.w, rtol=0, atol=1e-5)
    assert n_collapsed > 12


def test_the_bound_of_a_certificate_on_what_forces_do(rng):
    """The response to any force of size 1 is at most the integral of the size of the impulse response."""
    bound = certificates._eigenmodes(System([[2.0]], 3.0)).response()  # eigenvalues -1 and -2
    np.testing.assert_allclose(bound[:, 0], [1.5, 2.0], rtol=1e-14)
    bound = certificates._eigenmodes(System([[1.01]], 0.2)).response()  # -0.1 +- i: 1 / (0.1 x 1) of z
    np.testing.assert_allclose(bound[0, 0], 10.0, rtol=1e-12)
    n_stable = 0
    while n_stable < 5:
        system, _, _ = draw_run(rng, (1, 4), "antisymmetric", damping=(0.05, 2.0))
        a, n = system.slip_matrix(), system.n
        values = np.linalg.eigvals(a)
        if values.real.max() > -0.02:
            continue
        n_stable += 1
        t = np.arange(0.0, 12.0 / -values.real.max(), 0.1 / abs(values).max())
        step, impulse = expm(a * t[1]), np.eye(2 * n)[:, n:]
        sizes = np.empty((len(t), 2 * n, n))
        for one in sizes:
            one[:], impulse = abs(impulse), step @ impulse
        least = trapezoid(sizes, t, axis=0)
        assert (certificates._eigenmodes(system).response() > 0.99 * least).all()


@pytest.mark.parametrize("law", [{"engine": "coulomb", "tol": 1e-10}, {"engine": "sigmoid", "eps": 0.03}])
def test_a_run_is_the_same_whoever_sees_that_it_is_too_early_for_a_certificate(law, monkeypatch, rng):
    """Kernels do, with what the first look left them; Python would, where they know nothing."""
    systems = [draw_system("antisymmetric", n, seed=int(rng.integers(2**31))) for n in (1, 2, 5, 20)]
    asked, ask = [], certificates.Collapse.certify
    monkeypatch.setattr(certificates.Collapse, "certify", lambda *state: asked.append(1) or ask(*state))
    runs = [simulate(system, -0.7, -0.4, 200.0, stop_early="always", **law) for system in systems]
    n_asked = len(asked)
    first = property(lambda self: vars(self)["first"], lambda self, found: vars(self).setdefault("first", found))
    monkeypatch.setattr(certificates.Collapse, "precheck", first, raising=False)
    for run, system in zip(runs, systems, strict=True):
        other = simulate(system, -0.7, -0.4, 200.0, stop_early="always", **law)
        assert (run.outcome, run.t_collapse, run.stats) == (other.outcome, other.t_collapse, other.stats)
        for one, same in ((run.z, other.z), (run.w, other.w), (run.events.t, other.events.t)):
            np.testing.assert_array_equal(one, same)
    assert 2 * n_asked < len(asked)


# The series


@settings(max_examples=20, database=None)
@given(st.integers(0, 2**32 - 1))
def test_series_against_a_walk_through_its_events(seed):
    """Times on a coarse grid, so that many events share an instant."""
    rng = np.random.default_rng(seed)
    n, t_start, t_end = int(rng.integers(1, 7)), -1.0, 4.0
    initial = rng.integers(-1, 2, n).astype(np.int8)
    modes, rows = initial.copy(), []
    walk = [(t_start, initial.copy())]
    counts = {"n_entries": 0, "n_exits": 0, "n_crossings": 0}
    previous = []
    for t in np.arange(t_start, t_end, 0.25):
        for i in range(n):
            if rng.random() < 0.4:
                new = int(rng.choice([m for m in (-1, 0, 1) if m != modes[i]]))
                kind = "n_entries" if new == 0 else ("n_exits" if modes[i] == 0 else "n_crossings")
                counts[kind] += 1
                previous.append(int(modes[i]))
                rows.append((t, i, new))
                modes[i] = new
        walk.append((t, modes.copy()))
    t, block, mode = (list(column) for column in zip(*rows, strict=True)) if rows else ([], [], [])
    series = EventSeries(
        np.array(t, dtype=float),
        np.array(block, dtype=np.int32),
        np.array(mode, dtype=np.int8),
        initial,
        t_start,
        t_end,
    )
    assert series.counts() == counts
    assert series.previous_mode.tolist() == previous
    times = np.concatenate((rng.uniform(t_start, t_end, 20), [t_start, t_end], np.arange(t_start, t_end, 0.25)))
    for time in times:
        at = [m for s, m in walk if s <= time][-1]
        np.testing.assert_array_equal(series.mode_at(time), at)
        assert series.n_stick(time) == np.count_nonzero(at == 0)
    change_t, n_stick = series.change_points()
    assert change_t[0] == t_start
    assert (np.diff(change_t) > 0).all()
    assert (np.diff(n_stick) != 0).all()
    for k, start in enumerate(change_t):  # n_stick[k] holds on [t[k], t[k+1])
        end = change_t[k + 1] if k + 1 < len(change_t) else np.nextafter(t_end, np.inf)
        assert set(series.n_stick([start, 0.5 * (start + end), np.nextafter(end, t_start)])) == {n_stick[k]}
    for outside in (np.nextafter(t_start, -np.inf), np.nextafter(t_end, np.inf)):
        with pytest.raises(ValueError, match="times"):
            series.n_stick(outside)


# The stiff engine


def field(system, delta):
    n = system.n

    def rate(_, y):
        w = y[n:]
        pull = system.friction * np.tanh((w - system.belt_speed) / delta)
        return np.concatenate((w, -system.damping * w - system.stiffness @ y[:n] - pull))

    return rate


def test_order_five_of_the_state_and_of_the_times_of_events():
    """A law that is smooth on the scale of the motion: state by DOP853, 32 entries and exits on its dense output."""
    system = System([[4.0, 1.0], [-1.0, 9.0]], 0.1, [0.5, 0.3], -0.3)
    z0, w0 = np.array([1.0, -1.0]), np.array([0.5, 0.2])
    delta, threshold = np.array([2.0, 2.0]), 0.05
    reference = solve_ivp(
        field(system, delta), (0, 10), np.concatenate((z0, w0)), method="DOP853", rtol=1e-13, atol=1e-13,
        dense_output=True, max_step=0.02,
    )  # fmt: skip
    initial, rows = located(system, threshold * delta, reference.sol, 10.0)
    t, block, mode = zip(*rows, strict=True)
    assert len(rows) == 32
    steps, errors, late = [], [], []
    for tol in 10.0 ** -np.arange(7.0, 11.1, 0.5):
        run = simulate(
            system, z0, w0, 10.0, engine="sigmoid", eps=2.0, stick="threshold", threshold=threshold, rtol=tol,
            atol=tol, stop_early=False,
        )  # fmt: skip
        assert run.events.initial_mode.tolist() == initial.tolist()
        assert (run.events.block.tolist(), run.events.mode.tolist()) == (list(block), list(mode))
        steps.append(run.stats.n_steps)
        errors.append(np.abs(np.concatenate((run.z, run.w)) - reference.y[:, -1]).max())
        late.append(np.abs(run.events.t - t).mean())
    for error in (errors, late):
        order = -np.polyfit(np.log(steps), np.log(error), 1)[0]
        print(order)
        assert order > 4.8


def test_the_exact_engine_is_of_order_one_in_its_tolerance_across_events():
    """Some 70 located events a run; state and times err like tol over eight decades, in the mean over draws."""
    tolerances = 10.0 ** -np.arange(4, 12)
    errors, late = [], []
    for seed in range(6):
        system = draw_system("antisymmetric", 50, seed=seed)
        exact = simulate(system, -0.7, -0.4, 20.0, tol=1e-15, stop_early=False)
        assert len(exact.events) > 50
        runs = [simulate(system, -0.7, -0.4, 20.0, tol=tol, stop_early=False) for tol in tolerances]
        for run in runs:
            np.testing.assert_array_equal(run.events.block, exact.events.block)
        errors.append([max(np.abs(run.z - exact.z).max(), np.abs(run.w - exact.w).max()) for run in runs])
        late.append([np.abs(run.events.t - exact.events.t).max() for run in runs])
    for error in (errors, late):
        mean = np.log(error).mean(axis=0)
        assert np.polyfit(np.log(tolerances), mean, 1)[0] == pytest.approx(1, abs=0.15)


def located(system, band, sol, t_end):
    """Changes of mode on a dense reference, by bisection of the definition of sticking."""
    n = system.n

    def modes(t):
        y = sol(t)
        gap = y[n:] - system.belt_speed
        held = (system.friction > 0) & (np.abs(gap) < band)
        return np.where(held, 0, np.where(gap > 0, 1, -1))

    rows = []
    grid = np.linspace(0.0, t_end, 4001)
    seen = [modes(t) for t in grid]
    for k in range(len(grid) - 1):
        for i in np.flatnonzero(seen[k] != seen[k + 1]):
            low, high, old = grid[k], grid[k + 1], seen[k][i]
            while high - low > 1e-13:
                middle = 0.5 * (low + high)
                low, high = (middle, high) if modes(middle)[i] == old else (low, middle)
            rows.append((high, int(i), int(seen[k + 1][i])))
    return seen[0], sorted(rows)


# Touches


def test_an_event_that_is_taken_back_at_once_is_none():
    """By hand: block 0 has a short pair, and a pair about another (its ends meet); block 1's pair is long enough."""
    t = np.array([1.0, 1.001, 2.0, 3.0, 3.001, 3.002, 3.003, 4.0, 5.0])
    block = np.array([0, 0, 1, 0, 0, 0, 0, 1, 0], dtype=np.int32)
    mode = np.array([0, 1, 0, 0, -1, 0, 1, 1, -1], dtype=np.int8)
    series = EventSeries(t, block, mode, np.array([1, 1], dtype=np.int8), 0.0, 6.0)

    def filtered(*shortest, series=series, piece=0):
        of_event = np.array(shortest)[series.block]
        return without_returns(series, np.broadcast_to(piece, len(series)), series.t, of_event)

    left = filtered(0.01, 0.01)
    assert left.t.tolist() == [2.0, 4.0, 5.0]
    assert left.block.tolist() == [1, 1, 0]
    assert left.mode.tolist() == [0, 1, -1]
    assert filtered(0.0, 0.0) is series
    assert len(filtered(0.01, 3.0)) == 1
    # a bend between the events of a short pair makes it none
    assert filtered(0.01, 0.01, piece=np.array([0, 1, 1, 1, 1, 1, 1, 1, 1])).t.tolist() == [1.0, 1.001, 2.0, 4.0, 5.0]
    at_once = EventSeries(t[[0, 0]], block[:2], mode[:2], np.array([1, 1], dtype=np.int8), 0.0, 6.0)
    assert len(filtered(0.0, 0.0, series=at_once)) == 0


def test_sticks_that_are_short_for_their_block_alone_are_events():
    """A block of the rate 1e-3, shaken by one of the rate 100: it sticks 32 times, for 0.03 each, in one unit."""
    stiffness, friction = [[0, 1e-6], [0, 1e4]], [1e-6, 0.0]
    run = simulate(System(stiffness, 0.0, friction, -0.2), [0, 0], [-0.2, 200.0], 1.0)
    found = independent.follow(independent.Case.of(stiffness, 0.0, friction, -0.2, [0, 0], [-0.2, 200.0]), 1.0)
    assert run.events.mode.tolist() == found.mode
    np.testing.assert_allclose(run.events.t, found.t, atol=1e-6)


def test_the_loosest_tolerances_are_one():
    """Looser runs would cost more."""
    system = draw_system("antisymmetric", n=20, seed=0)
    loose, bound = (simulate(system, -0.7, -0.4, 20.0, tol=tol) for tol in (9e-3, 1e-3))
    assert loose.stats == bound.stats
    assert np.array_equal(loose.events.t, bound.events.t)


@pytest.mark.parametrize("engine", ["coulomb", "sigmoid", "moreau"])
def test_systems_and_runs_go_with_their_last_user(engine):
    """Without waiting for Python's collector of cycles, which counts objects, not what large systems weigh."""

    def gone():
        system = draw_system("antisymmetric", 5, 0, mass=2.0)
        return [weakref.ref(one) for one in (system, simulate(system, -0.7, -0.4, 5.0, engine=engine))]

    gone()  # what compiles kernels may keep their first arguments
    gc.disable()
    try:
        assert [one() for one in gone()] == [None, None]
    finally:
        gc.enable()


@pytest.mark.parametrize("law", [{"tol": 1e-6}, {"engine": "sigmoid", "eps": 0.01, "rtol": 1e-6, "atol": 1e-6}])
def test_a_collapse_is_certified_where_that_saves_steps(law, rng):
    """Of a long run by default, of a short one where asked for; without, nothing differs from no test at all."""
    outcomes = []
    for _ in range(3):
        system = draw_system("antisymmetric", 10, rng.integers(2**32))
        for t_end in (200.0, 10000.0):
            run = simulate(system, -0.7, -0.4, t_end, **law)
            plain = simulate(system, -0.7, -0.4, t_end, stop_early=False, **law)
            outcomes.append(
                (t_end, run.outcome, simulate(system, -0.7, -0.4, t_end, stop_early="always", **law).outcome)
            )
            if run.outcome == "finished":
                assert run.z.tobytes() == plain.z.tobytes()
                assert run.stats == plain.stats
            else:
                assert run.stats.n_products < plain.stats.n_products
    assert all(default == always == "collapsed" for t_end, default, always in outcomes if t_end > 1000)
    assert {default for t_end, default, _ in outcomes if t_end < 1000} == {"finished"}
    assert "collapsed" in {always for t_end, _, always in outcomes if t_end < 1000}


@pytest.mark.parametrize("again", [lambda system: pickle.loads(pickle.dumps(system)), copy.deepcopy])
def test_a_copy_is_the_system_and_cannot_be_written_to(rng, again):
    for sparse in (False, True) * 10:
        case = draw_case(rng, terms=TERMS)
        system = made(case, sparse=sparse)
        size = len(pickle.dumps(system))
        runs = [simulate(system, case.z0, case.w0, t_end=3.0)]
        assert len(pickle.dumps(system)) < 1.1 * size  # what followed from it does not travel
        other = again(system)
        with pytest.raises(ValueError, match="read-only"):
            (other.stiffness.data if sparse else other.stiffness)[:1] = 1.0
        runs.append(simulate(other, case.z0, case.w0, t_end=3.0))
        for name in ("t", "block", "mode"):
            np.testing.assert_array_equal(*(getattr(run.events, name) for run in runs))
        np.testing.assert_array_equal(*(np.array([run.z, run.w]) for run in runs))
