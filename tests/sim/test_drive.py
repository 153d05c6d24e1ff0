"""Mass, belts by block, and forces from outside."""

import math
from fractions import Fraction

import numpy as np
import pytest

from stickslip import Harmonic, Piecewise, System, draw_system, simulate
from stickslip.sim.engines import forcing
from tests.independent import Case, Ramp, follow

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
    for _ in range(4):
        stiffness, damping, t_start = rng.uniform(0.5, 4), rng.uniform(0, 1), rng.uniform(-20, 20)
        force = (10 ** rng.uniform(-2, 4), 10 ** rng.uniform(-2, 2), rng.uniform(0, 6))
        z, w = (x.real for x in oscillation(*force, stiffness, damping)(t_start))
        system = System([[stiffness]], damping, 0.0, 0.0, force=Harmonic(*force))
        run = simulate(system, z, w, t_start + 5.0, t_start=t_start, **settings)
        z, w = (x.real for x in oscillation(*force, stiffness, damping)(t_start + 5.0))
        allowed = 1e-8 * (max(abs(z), abs(w), force[0] / stiffness) + (settings == FINE))  # atol counts there too
        assert abs(run.z[0] - z) < allowed
        assert abs(run.w[0] - w) < allowed


@pytest.mark.parametrize("frequency", [0.0, 1e-3, 1.0, 1e4])
def test_a_block_at_rest_leaves_when_the_force_passes_static_friction(frequency):
    """On a belt at rest: f = 2 sin(frequency t) passes 1.5, if it ever does."""
    system = System([[1.0]], 0.2, 1.0, 0.0, 1.5, force=Harmonic(2.0, frequency, -np.pi / 2))
    leaves = np.arcsin(0.75) / frequency if frequency > 0 else np.inf
    run = simulate(system, 0.0, 0.0, min(1.1 * leaves, 1000.0))
    assert run.events.t[:1] == pytest.approx([leaves] if frequency > 0 else [], rel=1e-9)
    assert run.events.mode[:1].tolist() == ([1] if frequency > 0 else [])


@pytest.mark.parametrize(("frequency", "share"), [(0.8, 0.3), (2.0, 0.4)])
def test_den_hartogs_steady_response(frequency, share):
    """Amplitude (V^2 - (U F / P)^2)^(1/2) P, V = 1 / (1 - b^2), U = tan(pi / 2 b) / b, without stops.

    J. P. Den Hartog, Trans. ASME 53 (1931) 107-115. Here K = m = 1, R = 0, P = 1, F = `share`.
    """
    system = System([[1.0]], 0.0, share, 0.0, force=Harmonic(1.0, frequency))
    first = simulate(system, 1.0, 0.0, 2000.0)
    turns = first.events.t[-6:]
    run = simulate(system, 1.0, 0.0, 2000.0, t_eval=turns)
    v, u = 1 / (1 - frequency**2), np.tan(np.pi / (2 * frequency)) / frequency
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


EXACT = {"tol": 1e-13, "stop_early": False}


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


def test_more_pieces_change_nothing(rng):
    system, z, _ = driven(rng)
    cuts = np.unique(np.concatenate([system.belt_speed.times, rng.uniform(0.0, 10.0, 20)]))
    cut = system.changed(belt_speed=Piecewise(cuts, system.belt_speed.at(cuts)))
    t = np.linspace(0.0, 10.0, 101)
    # started each on its own belt, as rounding of its speed would be a slip
    whole, pieces = (simulate(s, z, s.belt_speed_at(0.0), 10.0, t_eval=t, **EXACT) for s in (system, cut))
    assert np.array_equal(whole.events.block, pieces.events.block)
    assert np.array_equal(whole.events.mode, pieces.events.mode)
    np.testing.assert_allclose(whole.events.t, pieces.events.t, atol=1e-8)
    np.testing.assert_allclose(whole.samples.z, pieces.samples.z, atol=1e-9)
    np.testing.assert_allclose(whole.samples.w, pieces.samples.w, atol=1e-9)


@pytest.mark.parametrize("jump", [1e-1, 1e-3, 1e-5])
def test_a_block_that_has_left_before_its_belt_brakes_does_not_stick_again(jump):
    """Its F falls below the static friction, not the kinetic, at an instant at which it has hardly gained speed."""
    v, static = 0.3, 0.5 + jump
    leaves = 3.0
    for apart in range(-200, 2000, 100):
        bend = leaves + apart * np.spacing(leaves)
        belt = Piecewise([bend, bend + 1.0], [v, v - 0.1 * jump])
        events = simulate(System([[1.0]], 0.0, 0.5, belt, static), static - leaves * v, v, 3.5, **EXACT).events
        assert events.mode.tolist() == [-1]


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


def test_a_force_has_its_phase_at_any_time(rng):
    """By exact products: frequency t as a sum of two numbers, whose cosines the library has to rounding."""
    for _ in range(10):
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


# series of many values


def test_a_measured_series_is_followed_value_by_value(rng):
    """Belts and forces of 150 values each, by a method that shares no code."""
    n, k = 3, 150
    t, other = (np.cumsum(rng.uniform(0.02, 0.2, k)) - 1.0 for _ in range(2))
    belt, push = -0.3 + 0.2 * rng.uniform(-1.0, 1.0, (k, n)), rng.uniform(-1.0, 1.0, (k, n))
    stiffness = np.diag(rng.uniform(1.0, 2.0, n)) + 0.3 * rng.uniform(-1.0, 1.0, (n, n))
    damping, static, z, end = rng.uniform(0.1, 0.5, n), 1.2, rng.normal(size=n), min(t[-1], other[-1])
    system = System(stiffness, damping, 1.0, Piecewise(t, belt), static, force=Piecewise(other, push))
    w = system.belt_speed_at(0.0)
    path = follow(
        Case.of(stiffness, damping, 1.0, Ramp(t, belt), z, w, static, push=Ramp(other, push)), float(end) + 0.01
    )
    samples = np.linspace(0.0, end, 61)
    run = simulate(system, z, w, float(end) + 0.01, t_eval=samples, tol=1e-12)
    assert len(run.events) > 10
    assert run.events.block.tolist() == path.block
    assert run.events.mode.tolist() == path.mode
    np.testing.assert_allclose(run.events.t, path.t, atol=1e-8)
    for states, reference in zip((run.samples.z, run.samples.w), path.at(samples), strict=True):
        np.testing.assert_allclose(states, reference, atol=1e-9)


@pytest.mark.parametrize("settings", [EXACT, FINE])
def test_a_run_to_a_bend_is_the_same_however_many_pieces_are_prepared_at_once(settings, rng, monkeypatch):
    system, z, w = driven(rng)
    cuts = np.unique(np.concatenate([system.belt_speed.times, rng.uniform(0.0, 10.0, 20), [10.0]]))
    cut, runs = system.changed(belt_speed=Piecewise(cuts, system.belt_speed.at(cuts))), []
    for at_once in (2, 7, 1024):
        monkeypatch.setattr(forcing, "_AT_ONCE", at_once)
        runs.append(simulate(cut, z, w, 10.0, t_eval=np.linspace(0.0, 10.0, 101), **settings))
    for run in runs[:2]:
        assert run.events.block.tolist() == runs[2].events.block.tolist()
        assert run.stats == runs[2].stats
        for found, expected in zip(
            (run.events.t, run.samples.z, run.samples.w, run.z, run.stills.t, run.stills.total),
            (
                runs[2].events.t,
                runs[2].samples.z,
                runs[2].samples.w,
                runs[2].z,
                runs[2].stills.t,
                runs[2].stills.total,
            ),
            strict=True,
        ):
            np.testing.assert_allclose(found, expected, atol=1e-11)


def test_events_of_a_late_series_have_the_clock_of_their_piece():
    """Without springs each of 40 teeth of a force lets a block go, and friction stops it, as at t = 0."""
    late, tooth = 1e9, np.arange(81)
    force = Piecewise(late + 0.5 * tooth, np.where(tooth % 2 == 1, 1.25, 0.0))
    system = System([[0.0]], 0.0, 1.0, 0.0, force=force)
    run = simulate(system, 0.0, 0.0, late + 40.0, t_start=late, tol=1e-12, stop_early=False)
    expected = late + np.arange(40)[:, None] + [0.4, 0.6 + math.sqrt(0.02)]
    np.testing.assert_allclose(run.events.t, expected.ravel(), rtol=np.finfo(float).eps)
    assert run.events.mode.tolist() == [1, 0] * 40
    assert run.z[0] == pytest.approx(40 * (0.0025 + 0.05 / 3 * math.sqrt(0.02)), rel=1e-9)
