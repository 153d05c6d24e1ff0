"""Mass, belts by block, and forces from outside."""

import math
from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse

from stickslip import Harmonic, Piecewise, System, draw_system, perturb_system, simulate
from stickslip.sim.energy import energy
from stickslip.sim.episodes import episodes, spans

# the system


def test_what_is_left_out_changes_nothing():
    system = System(np.eye(3), 0.1)
    assert system.mass.tolist() == [1.0] * 3
    assert system.force == ()
    assert system.has_one_belt
    assert not system.has_mass
    assert not system.changes
    nothing = System(np.eye(3), 0.1, belt_speed=[-0.2] * 3, mass=1, force=[Harmonic(0.0, 3.0), 0.0])
    assert System(np.eye(3), 0.1, force=[]).force == ()
    assert repr(nothing) == repr(system)
    assert nothing._repr_html_() == system._repr_html_()
    assert nothing.belt_speed == -0.2


def test_forces_add_up():
    force = [1.0, Harmonic([1.0, 2.0], 3.0, 0.5), Piecewise([0.0, 2.0], [0.0, 4.0]), Harmonic(2.0, 0.0, 0.0)]
    system = System(np.eye(2), 0.1, force=force)
    t = np.array([-1.0, 0.5, 1.0, 3.0])
    linear = np.array([0.0, 1.0, 2.0, 4.0])
    expected = 3.0 + np.outer(np.cos(3 * t + 0.5), [1.0, 2.0]) + linear[:, None]
    np.testing.assert_allclose(system.force_at(t), expected, rtol=1e-15)
    np.testing.assert_allclose(system.force_at(0.5), expected[1], rtol=1e-15)
    assert [term.is_constant for term in system.force] == [True, False, False]
    assert system.changes
    assert not System(np.eye(2), 0.1, force=[1.0, 2.0]).changes


def test_a_start_on_the_belt_is_the_speed_of_each_belt_then():
    several = System(np.eye(2), 0.1, belt_speed=Piecewise([0.0, 8.0], [[-0.25, 0.5], [-0.5, 0.25]]))
    for system, t_start, w in ((several, 4.0, [-0.375, 0.375]), (System(np.eye(2), 0.1), 0.0, -0.2)):
        one, two = (simulate(system, 0.5, w0, 20.0, t_start=t_start) for w0 in ("belt", w))
        assert one.events.t.tolist() == two.events.t.tolist()
        assert one.w.tolist() == two.w.tolist()
    with pytest.raises(ValueError, match='w0: expected a number, 2 numbers or "belt", got \'rest\'; write w0="belt"'):
        simulate(several, 0.0, "rest", 1.0)


def test_belts_are_one_or_one_a_block():
    several = System(np.eye(2), 0.1, belt_speed=[-0.2, 0.3])
    assert not several.has_one_belt
    assert not several.changes
    assert several.belt_speed_at([0.0, 1.0]).tolist() == [[-0.2, 0.3]] * 2
    moving = System(np.eye(2), 0.1, belt_speed=Piecewise([0.0, 1.0], [0.0, -0.5]))
    assert moving.changes
    assert moving.belt_speed.values.shape == (2, 2)
    assert moving.belt_speed_at(0.5).tolist() == [-0.25, -0.25]
    assert System(np.eye(2), 0.1, belt_speed=Piecewise([0.0, 1.0], [-0.5, -0.5])).belt_speed == -0.5


def test_a_system_says_what_drives_it():
    system = System(
        np.eye(2), 0.1, mass=[1, 2], force=[Harmonic(1.0, 0.5), 2.0], belt_speed=Piecewise([0, 1], [0, -1])
    )
    assert repr(system) == (
        "System(n=2, K dense, mass 1 to 2, force 2 + 1 cos(0.5 t), belt_speed=-1 to 0 in 2 times)"
    )
    assert "<th>mass</th><td>1 to 2</td>" in system._repr_html_()
    assert repr(Harmonic(1, [0.5, 2])) == "Harmonic(amplitude=1, frequency=[0.5, 2. ], phase=0)"
    assert repr(Piecewise([0, 1], [0, 2])) == "Piecewise(times=[0., 1.], values=[0., 2.])"


def test_what_drives_a_system_goes_where_it_goes():
    drive = {"mass": 2.0, "force": [Harmonic(1.0, 2.0)], "belt_speed": [-0.1, 0.2, 0.0, 1.0], "static": 1.5}
    system = draw_system("antisymmetric", 4, 0, **drive)
    for other in (perturb_system(system, "antisymmetric", 0.01, 1), system.changed(damping=3.0)):
        assert other.mass.tolist() == [2.0] * 4
        assert other.static.tolist() == [1.5] * 4
        assert other.belt_speed.tolist() == [-0.1, 0.2, 0.0, 1.0]
        np.testing.assert_array_equal(other.force_at(0.3), system.force_at(0.3))


FINE = {"engine": "sigmoid", "eps": 0.01, "rtol": 1e-9, "atol": 1e-9}


def test_what_friction_holds_on_a_belt_that_gains_speed():
    """m v' + R v + K z - f."""
    system = System([[2.0]], 0.5, 1.0, Piecewise([0.0, 2.0], [1.0, 2.0]), mass=3.0, force=Harmonic(4.0, np.pi))
    assert system.holding_force(0.25, t=1.0) == pytest.approx([3.0 * 0.5 + 0.5 * 1.5 + 0.5 + 4.0])
    with pytest.raises(ValueError, match="t: expected the time"):
        system.holding_force(0.25)
    with pytest.raises(ValueError, match="force: expected a constant one"):
        system.rest_state(1.0)
    still = System([[2.0]], 0.5, 0.75, mass=3.0, force=4.0)
    assert still.rest_state(1.0) == pytest.approx([1.625])
    assert still.slip_matrix() == pytest.approx(np.array([[0.0, 1.0], [-2 / 3, -0.5 / 3]]))


# closed forms


def oscillation(amplitude, frequency, phase, stiffness, damping):
    """The lasting answer of m = 1 to a harmonic force, as a function of time: displacement and speed."""
    answer = amplitude * np.exp(1j * phase) / (stiffness - frequency**2 + 1j * frequency * damping)
    return lambda t: (answer * np.exp(1j * frequency * t), 1j * frequency * answer * np.exp(1j * frequency * t))


@pytest.mark.parametrize("settings", [{}, FINE])
def test_a_block_without_friction_swings_as_it_must(rng, settings):
    for _ in range(10):
        stiffness, damping, t_start = rng.uniform(0.5, 4), rng.uniform(0, 1), rng.uniform(-20, 20)
        force = (10 ** rng.uniform(-2, 4), 10 ** rng.uniform(-2, 2), rng.uniform(0, 6))
        z, w = (x.real for x in oscillation(*force, stiffness, damping)(t_start))
        system = System([[stiffness]], damping, 0.0, 0.0, force=Harmonic(*force))
        run = simulate(system, z, w, t_start + 5.0, t_start=t_start, **settings)
        z, w = (x.real for x in oscillation(*force, stiffness, damping)(t_start + 5.0))
        allowed = 1e-8 * (max(abs(z), abs(w), force[0] / stiffness) + (settings == FINE))  # atol counts there too
        assert abs(run.z[0] - z) < allowed
        assert abs(run.w[0] - w) < allowed


@pytest.mark.parametrize("frequency", [0.0, 1e-3, 1.0, 50.0, 1e4])
def test_a_block_at_rest_leaves_when_the_force_passes_static_friction(frequency):
    """On a belt at rest: f = 2 sin(frequency t) passes 1.5, if it ever does."""
    system = System([[1.0]], 0.2, 1.0, 0.0, 1.5, force=Harmonic(2.0, frequency, -np.pi / 2))
    leaves = np.arcsin(0.75) / frequency if frequency > 0 else np.inf
    run = simulate(system, 0.0, 0.0, min(1.1 * leaves, 1000.0))
    assert run.events.t[:1] == pytest.approx([leaves] if frequency > 0 else [], rel=1e-9)
    assert run.events.mode[:1].tolist() == ([1] if frequency > 0 else [])


@pytest.mark.parametrize("settings", [{}, FINE])
def test_a_force_that_is_weaker_than_friction_moves_nothing(settings):
    for frequency in (0.1, 1e3):
        run = simulate(System([[1.0]], 0.0, 1.0, 0.0, force=Harmonic(0.9, frequency)), 0.0, 0.0, 5.0, **settings)
        assert len(run.events) == 0
        assert abs(run.z[0]) < (1e-2 * 5.0 * 2.0 if settings else 1e-300)


@pytest.mark.parametrize(("frequency", "share"), [(0.8, 0.3), (1.3, 0.2), (2.0, 0.4)])
def test_den_hartogs_steady_response(frequency, share):
    """Amplitude (V^2 - (U F / P)^2)^(1/2) P, V = 1 / (1 - b^2), U = tan(pi / 2 b) / b, without stops.

    J. P. Den Hartog, Trans. ASME 53 (1931) 107-115. Here K = m = 1, R = 0, P = 1, F = `share`.
    """
    system = System([[1.0]], 0.0, share, 0.0, force=Harmonic(1.0, frequency))
    first = simulate(system, 1.0, 0.0, 2000.0)
    turns = first.events.t[-6:]
    run = simulate(system, 1.0, 0.0, 2000.0, t_eval=turns)
    v, u = 1 / (1 - frequency**2), np.tan(np.pi / (2 * frequency)) / frequency
    print(np.abs(run.samples.z[:, 0]) - np.sqrt(v**2 - (u * share) ** 2))
    np.testing.assert_allclose(np.abs(run.samples.z[:, 0]), np.sqrt(v**2 - (u * share) ** 2), rtol=1e-8)
    np.testing.assert_allclose(np.diff(turns), np.pi / frequency, rtol=1e-8)
    assert first.events.counts()["n_entries"] < 10


def test_a_block_stays_on_a_belt_that_gains_speed_slowly():
    """K = R = 0: it is carried as long as m v' is below its friction, and its speed is the belt's to the last bit."""
    belt = Piecewise([0.0, 5.0, 1e4], [0.0, 1.0, 50.0])
    t = np.linspace(0.0, 9000.0, 7)
    run = simulate(System([[0.0]], 0.0, 1.0, belt, mass=4.9), 1.0, 0.0, 9000.0, t_eval=t)
    assert len(run.events) == 0
    np.testing.assert_array_equal(run.samples.w[:, 0], belt.at(t))
    np.testing.assert_allclose(run.samples.z[:, 0], 1.0 + belt.integral(t), rtol=1e-13)
    slips = simulate(System([[0.0]], 0.0, 1.0, belt, mass=5.1), 1.0, 0.0, 4.0)
    assert slips.events.initial_mode.tolist() == [-1]
    assert slips.w[0] == pytest.approx(4.0 / 5.1)


# the same, said in other words


def driven(rng, n=6, **others):
    """A chain with all that there is, started on its belts."""
    belt = Piecewise(np.sort(rng.uniform(-5.0, 15.0, 4)), rng.uniform(-0.5, 0.2, (4, n)))
    force = [
        Harmonic(rng.uniform(0, 1, n), rng.uniform(0.2, 4, n), rng.uniform(0, 6, n)),
        Piecewise(np.sort(rng.uniform(-5.0, 15.0, 3)), rng.normal(size=(3, n))),
        rng.normal(size=n) * 0.3,
    ]
    arguments = {"belt_speed": belt, "force": force, "mass": rng.uniform(0.3, 3, n), "static": 1.3} | others
    system = draw_system("chain", n, int(rng.integers(2**32)), kappa=1.0, leaf=0.5, rho=0.1, **arguments)
    return system, rng.normal(size=n), system.belt_speed_at(0.0)


def assert_same(one, other, tolerance=1e-8):
    assert len(one.events) == len(other.events)
    assert np.array_equal(one.events.block, other.events.block)
    assert np.array_equal(one.events.mode, other.events.mode)
    np.testing.assert_allclose(one.events.t, other.events.t, atol=tolerance)
    np.testing.assert_allclose(one.z, other.z, atol=tolerance)
    np.testing.assert_allclose(one.w, other.w, atol=tolerance)


EXACT = {"tol": 1e-13, "stop_early": False}


def test_masses_are_a_scaling_of_rows(rng):
    system, z, w = driven(rng)
    m = system.mass
    scaled = System(
        scipy.sparse.diags_array(1 / m) @ system.stiffness, system.damping / m, system.friction / m,
        system.belt_speed, system.static / m, force=[term.scaled(1 / m) for term in system.force],
    )  # fmt: skip
    assert_same(simulate(system, z, w, 10.0, **EXACT), simulate(scaled, z, w, 10.0, **EXACT))


def test_belts_that_agree_are_one(rng):
    system, z, _ = driven(rng, belt_speed=-0.2)
    several = system.changed(belt_speed=[-0.2] * 6)
    assert simulate(system, z, -0.2, 10.0).events.t.tobytes() == simulate(several, z, -0.2, 10.0).events.t.tobytes()


@pytest.mark.parametrize("settings", [EXACT, FINE])
def test_a_belt_that_gains_speed_is_a_force(rng, settings):
    """In the frame of the belts, y = z - s(t), they rest, and f - m v' - R v - K s stands for f: here a parabola."""
    n, gain = 4, 0.1
    k, r = np.diag(rng.uniform(0.5, 2.0, n)), rng.uniform(0.1, 0.5, n)
    start, static = rng.normal(size=n), 1.2
    moving = System(k, r, 1.0, Piecewise([0.0, 8.0], [0.0, 8.0 * gain]), static, mass=2.0)
    t = np.linspace(0.0, 8.0, 4001)  # a polygon, off the parabola by k gain (8 / 4000)^2 / 8
    push = -2.0 * gain - np.outer(t, r * gain) - np.outer(t**2 / 2, np.diag(k) * gain)
    resting = System(k, r, 1.0, 0.0, static, mass=2.0, force=Piecewise(t, push))
    settings = settings | ({"eps": 0.1} if "eps" in settings else {})
    one, other = (simulate(system, start, 0.0, 8.0, **settings) for system in (moving, resting))
    early, late = (run.events.t[run.events.t < 8.0] for run in (one, other))  # the belt bends at the end itself
    np.testing.assert_allclose(early, late, atol=1e-4)
    np.testing.assert_allclose(one.z - gain * 32.0, other.z, atol=1e-5)
    np.testing.assert_allclose(one.w - gain * 8.0, other.w, atol=1e-5)


@pytest.mark.parametrize("settings", [EXACT, {**FINE, "thresholds": (0.5, 2.0)}])
def test_more_pieces_change_nothing(rng, settings):
    system, z, _ = driven(rng)
    cuts = np.sort(rng.uniform(0.0, 10.0, 20))
    at = np.unique(np.concatenate([system.belt_speed.times, cuts]))
    cut = system.changed(belt_speed=Piecewise(at, system.belt_speed.at(at)))
    t = np.linspace(0.0, 10.0, 101)
    # started each on its own belt, as rounding of its speed would be a slip
    one, other = (simulate(s, z, s.belt_speed_at(0.0), 10.0, t_eval=t, **settings) for s in (system, cut))
    if "tol" in settings:
        assert_same(one, other)
    np.testing.assert_allclose(one.samples.z, other.samples.z, atol=1e-4 if "eps" in settings else 1e-9)
    np.testing.assert_allclose(one.samples.w, other.samples.w, atol=1e-3 if "eps" in settings else 1e-9)


def test_bends_at_events_change_nothing(rng):
    system, z, w = driven(rng)
    whole = simulate(system, z, w, 10.0, **EXACT)
    at = np.unique(np.concatenate([system.belt_speed.times, whole.events.t]))
    cut = system.changed(belt_speed=Piecewise(at, system.belt_speed.at(at)))
    assert_same(whole, simulate(cut, z, cut.belt_speed_at(0.0), 10.0, **EXACT))


@pytest.mark.parametrize("jump", [1e-1, 1e-3, 1e-5])
def test_a_block_that_has_left_before_its_belt_brakes_does_not_stick_again(jump):
    """Its F falls below the static friction, not the kinetic, at an instant at which it has hardly gained speed."""
    v, static = 0.3, 0.5 + jump
    leaves = 3.0
    for apart in range(-200, 2000, 20):
        bend = leaves + apart * np.spacing(leaves)
        belt = Piecewise([bend, bend + 1.0], [v, v - 0.1 * jump])
        events = simulate(System([[1.0]], 0.0, 0.5, belt, static), static - leaves * v, v, 3.5, **EXACT).events
        assert events.mode.tolist() == [-1]


@pytest.mark.parametrize("settings", [EXACT, FINE])
def test_a_driven_run_goes_on_from_its_end(rng, settings):
    system, z, w = driven(rng)
    whole = simulate(system, z, w, 10.0, t_eval=np.linspace(3.0, 5.0, 201), **settings)
    # a block on its way out of the layer of the smoothed law still sticks in a run, but not at a start
    x = np.abs(whole.samples.w - [system.belt_speed_at(t) for t in whole.samples.t]) / FINE["eps"]
    middle = float(whole.samples.t[~((x > 1.0) & (x < np.log(100.0))).any(axis=1)][0])
    first = simulate(system, z, w, middle, **settings)
    second = simulate(system, first.z, first.w, 10.0, t_start=middle, **settings)
    assert np.array_equal(second.events.initial_mode, first.events.mode_at(middle))
    assert len(first.events) + len(second.events) == len(whole.events)
    np.testing.assert_allclose(second.z, whole.z, atol=1e-4 if "eps" in settings else 1e-9)


def test_a_force_that_comes_after_the_end_is_none(rng):
    system = draw_system("antisymmetric", 60, int(rng.integers(2**32)))
    later = system.changed(force=Piecewise([50.0, 51.0], [0.0, 7.0]))
    one, other = (simulate(s, -0.7, -0.4, 20.0, tol=1e-12, stop_early=False) for s in (system, later))
    assert_same(one, other, 1e-7)


def test_products_in_float32_serve_driven_blocks(rng):
    """n = 60, dense, where panels in float32 are used, against the same K kept sparse, where there are none."""
    n = 60
    system = draw_system("antisymmetric", n, int(rng.integers(2**32)), kappa=0.3, rho=0.5)
    force = [Harmonic(rng.uniform(0, 1, n), rng.uniform(0.1, 3, n), rng.uniform(0, 6, n))]
    dense = system.changed(force=force, belt_speed=rng.uniform(-0.3, 0.1, n), mass=rng.uniform(0.5, 2, n))
    sparse = dense.changed(stiffness=scipy.sparse.csc_array(dense.stiffness))
    runs = [simulate(s, 0.0, 0.0, 10.0, tol=1e-10, stop_early=False) for s in (dense, sparse)]
    assert runs[0].stats.n_events > 50
    assert_same(*runs, 1e-6)


# certificates


def test_a_constant_force_shifts_the_rest_after_a_collapse():
    run = simulate(System([[1.0]], 1.0, 0.3, force=0.5), 0.0, 0.0, 100.0, stop_early="always")
    assert run.outcome == "collapsed"
    assert run.z == pytest.approx([0.2])


@pytest.mark.parametrize("drive", [{"force": Harmonic(0.1, 1.0)}, {"belt_speed": Piecewise([0, 50], [-0.2, -0.1])}])
def test_no_collapse_is_certain_where_something_changes(drive):
    run = simulate(System([[1.0]], 1.0, 0.3).changed(**drive), 0.0, 0.0, 100.0, stop_early="always")
    assert run.outcome == "finished"


def test_an_escape_is_certain_whatever_the_force():
    system = System([[-1.0]], 0.0, 1.0, -0.1, force=Harmonic(1.0, 2.0))
    assert simulate(system, 3.0, 0.0, 100.0).outcome == "diverged"
    held = simulate(system, 1.0, -0.1, 10.0)
    assert held.outcome in ("finished", "diverged")
    assert simulate(system.changed(force=1e6), 1.0, -0.1, 3.0).z[0] > 1e5


def test_a_block_that_a_force_swings_far_out_comes_back():
    """It is let go of at the rate 0.01; the force moves it 2 / 0.15^2 out and back, which friction hardly minds."""
    system = System([[-1e-4]], 0.0, 1e-3, -0.2, force=Harmonic(1.0, 0.15))
    turn = 2 * np.pi / 0.15
    run = simulate(system, 0.0, 0.0, turn, t_eval=[0.5 * turn])
    assert run.outcome == "finished"
    assert run.samples.z[0] == pytest.approx([2 / 0.15**2], rel=0.15)
    assert abs(run.z[0]) < 0.2 * run.samples.z[0]


def test_a_nearly_free_block_slips_where_its_belt_brakes(rng):
    """R is too small to matter: it slips ahead, and friction brakes it by mu / m to the new speed of the belt."""
    mu, m, brake, slow = rng.uniform(0.5, 1.0), rng.uniform(1.0, 3.0), rng.uniform(0.02, 0.1), rng.uniform(0.0, 0.2)
    belt = Piecewise([5.0, 5.0 + brake], [0.4, slow])
    events = simulate(System([[0.0]], 1e-9, mu, belt, mass=m), 0.0, 0.4, 10.0).events
    np.testing.assert_allclose(events.t, [5.0, 5.0 + (0.4 - slow) * m / mu], rtol=1e-6)
    assert events.mode.tolist() == [1, 0]


# energy and episodes


def test_the_balance_closes_with_all_that_drives(rng):
    n = 30
    force = [
        Harmonic(rng.uniform(0, 1, n), rng.uniform(0.2, 3, n), rng.uniform(0, 6, n)),
        Piecewise([50.0, 200.0, 260.0], rng.normal(size=(3, n))),
        0.1,
    ]
    system = draw_system(
        "chain", n, int(rng.integers(2**32)), kappa=2.0, leaf=1.0, rho=0.01, static=1.5, force=force,
        mass=rng.uniform(0.5, 2, n), belt_speed=Piecewise([0.0, 300.0, 350.0], rng.uniform(-0.4, 0.1, (3, n))),
    )  # fmt: skip
    start = rng.normal(size=n), system.belt_speed_at(0.0)
    run = simulate(system, *start, 1000.0, **EXACT)
    found = energy(system, run, *start, **EXACT)
    turnover = sum(np.abs(flow).max() for flow in (found.belt, found.outside, found.damping, found.heat))
    print(len(run.events), turnover, np.abs(found.imbalance).max() / turnover)
    assert len(run.events) > 5000
    assert np.abs(found.imbalance).max() < 1e-12 * turnover
    assert (np.diff(found.heat) >= 0).all()


def test_episodes_on_belts_of_several_speeds():
    """Two blocks that do not feel each other, each as one block alone: the moments add up."""
    ramp = Piecewise([0.0, 60.0], [[-0.1, -0.2], [-0.3, -0.2]])
    pair = System(np.eye(2), 0.0, 1.0, ramp, 1.3)
    run = simulate(pair, 0.0, ramp.values[0], 60.0)
    found = episodes(run, ramp)
    assert len(found) > 1
    at = spans(run.events)
    sampled = simulate(pair, 0.0, ramp.values[0], 60.0, t_eval=at.ravel()).samples
    on_belt = (sampled.z - ramp.integral(sampled.t)).sum(axis=1).reshape(-1, 2)
    np.testing.assert_allclose(found.moment, on_belt[:, 1] - on_belt[:, 0], rtol=1e-9)
    assert (found.moment > 0).all()


def test_a_force_has_its_phase_at_any_time(rng):
    """By exact products: frequency t as a sum of two numbers, whose cosines the library has to rounding."""
    for _ in range(50):
        frequency, t, phase = rng.uniform(0.01, 10), float(10.0 ** rng.uniform(0, 13)), rng.uniform(0, 6)
        product = Fraction(frequency) * Fraction(t)
        high = float(product)
        low = float(product - Fraction(high)) + phase
        exact = math.cos(high) * math.cos(low) - math.sin(high) * math.sin(low)
        one, each = Harmonic(1.0, frequency, phase), Harmonic([1.0, 2.0], [frequency, 1.0], phase)
        assert one.at(t) == pytest.approx(exact, abs=1e-14)
        assert one.at([[t, 0.0]]).shape == (1, 2)
        assert each.at([t, t])[1, 0] == pytest.approx(exact, abs=1e-14)


def test_a_block_without_friction_starts_at_rest_and_not_on_its_belt():
    """z'' = -z from z = 1, w = 0, whatever its belt does; the block beside it rides its own."""
    system = System(np.eye(2), 0.0, friction=[0.0, 1.0], belt_speed=[50.0, 0.1])
    run = simulate(system, [1.0, 0.0], "belt", 3.0, tol=1e-12)
    np.testing.assert_allclose((run.z[0], run.w[0]), (np.cos(3.0), -np.sin(3.0)), atol=1e-9)
    np.testing.assert_allclose((run.z[1], run.w[1]), (0.3, 0.1), atol=1e-12)


def test_the_series_of_some_blocks(rng):
    """Their modes at any time are those that they have among all."""
    run = simulate(draw_system("antisymmetric", n=12, seed=int(rng.integers(2**31))), -0.7, -0.4, 60.0)
    chosen = rng.uniform(size=12) < 0.5
    some, times = run.events.of_blocks(chosen), np.linspace(0.0, 60.0, 200)
    np.testing.assert_array_equal(some.modes_at(times), run.events.modes_at(times)[:, chosen])
    assert len(some) == np.count_nonzero(chosen[run.events.block])
    assert run.events.of_blocks(np.full(12, True)) is run.events
    assert run.events.of_blocks(np.full(12, False)).n == 0
