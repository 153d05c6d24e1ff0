"""Late starts and short ramps lose no digits; what happens at a bend of belts or forces is in every run to it."""

import itertools

import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from stickslip import Harmonic, Piecewise, Stribeck, System, draw_system, simulate
from stickslip.sim.systems.friction import hidden_term

N = 200
BEFORE, AFTER = 0.04, 0.05
EPS = 0.03
EXACT = {"tol": 1e-8}
SMOOTHED = {"engine": "sigmoid", "eps": EPS, "rtol": 1e-8, "atol": 1e-8}
LAWS = {"plain": {}, "static": {"static": 1.4}, "weakening": {"static": 1.4, "weakening": Stribeck(0.3)}}


def ramp(rng, low, high):
    """The times of a random ramp, and the start and end of a run across it, in floats."""
    start = 10.0 ** rng.uniform(-1, 4)
    end = start + 10.0 ** rng.uniform(low, high)
    while not end > start:
        end = np.nextafter(end, np.inf)
    return start - BEFORE, start, end, end + AFTER


def independent(rng, **drive):
    return System(np.diag(rng.uniform(0.5, 2.0, N)), rng.uniform(0.1, 1.0, N), 1.0, **drive)


def slid(system, z, w, s, pushes):
    """z and w of blocks apart after a slip of length s, by power series; `pushes` on the blocks, by powers of s."""
    k, r = np.diag(system.stiffness), system.damping
    terms = [z, w]
    for j in range(30):
        push = pushes[j] if j < len(pushes) else 0.0
        terms.append((push - r * (j + 1) * terms[j + 1] - k * terms[j]) / ((j + 1) * (j + 2)))
    return sum(c * s**j for j, c in enumerate(terms)), sum(j * c * s ** (j - 1) for j, c in enumerate(terms) if j)


def errors(run, z, w, tolerance):
    return max(np.abs(run.z - z).max(), np.abs(run.w - w).max()) / tolerance


def passed(rng, low, high):
    """A belt that goes from 0.5 to -0.5 or so, and passes every block; worst errors of the state and of events."""
    t = ramp(rng, low, high)
    v = rng.uniform(0.45, 0.6), rng.uniform(-0.6, -0.45)
    system = independent(rng, belt_speed=Piecewise(t[1:3], v))
    z0, w0 = rng.uniform(-0.2, 0.2, N), rng.uniform(-0.2, 0.2, N)
    run = simulate(system, z0, w0, t[3], t_start=t[0], **EXACT)
    length, mu = t[2] - t[1], system.friction
    slope = (v[1] - v[0]) / length
    z, w = slid(system, z0, w0, t[1] - t[0], [mu])
    early, late = np.zeros(N), np.full(N, length)
    for _ in range(80):  # where w = v
        middle = 0.5 * (early + late)
        is_below = slid(system, z, w, middle, [mu])[1] < v[0] + slope * middle
        early, late = np.where(is_below, middle, early), np.where(is_below, late, middle)
    z, w = slid(system, z, w, early, [mu])
    z, w = slid(system, z, w, length - early + (t[3] - t[2]), [-mu])
    events = run.events
    assert (events.mode == 1).all()
    assert np.array_equal(np.sort(events.block), np.arange(N))
    assert ((events.t >= t[1]) & (events.t <= t[2])).all()
    off = np.abs(events.t - (t[1] + early[events.block])).max()
    return errors(run, z, w, EXACT["tol"]), off / (np.spacing(t[2]) + EXACT["tol"] * length)


def pushed(rng, low, high):
    """A force that grows to 3 or so and tears every block off its belt at a time of its own."""
    t, v = ramp(rng, low, high), 0.1
    mu = rng.uniform(0.3, 1.0, N)
    force = np.array([np.zeros(N), rng.uniform(2.0, 3.0, N)])
    system = independent(rng, belt_speed=v, force=Piecewise(t[1:3], force)).changed(friction=mu, static=mu)
    z0 = rng.uniform(-0.05, 0.05, N)
    run = simulate(system, z0, v, t[3], t_start=t[0], **EXACT)
    k, r = np.diag(system.stiffness), system.damping
    length, before = t[2] - t[1], t[1] - t[0]
    slope = force[1] / length
    leaves = (mu + r * v + k * (z0 + v * before)) / (slope - k * v)
    push, rest = -mu + slope * leaves, length - leaves
    z, w = slid(system, z0 + v * (before + leaves), np.full(N, v), rest, [push, slope])
    z, w = slid(system, z, w, t[3] - t[2], [force[1] - mu])
    events = run.events
    assert (events.mode == 1).all()
    assert np.array_equal(np.sort(events.block), np.arange(N))
    off = np.abs(events.t - (t[1] + leaves[events.block])).max()
    return errors(run, z, w, EXACT["tol"]), off / (np.spacing(t[2]) + EXACT["tol"] * length)


def smoothed(rng, law, of_belt, low, high):
    """The same in the smoothed law, against an integrator of another kind that has each piece as [0, 1]."""
    t = ramp(rng, low, high)
    if of_belt:
        drive, start = {"belt_speed": Piecewise(t[1:3], [0.5, -0.5])}, rng.uniform(-0.2, 0.2, N)
    else:
        drive = {"belt_speed": 0.1, "force": Piecewise(t[1:3], [np.zeros(N), rng.uniform(2.0, 3.0, N)])}
        start = np.full(N, 0.1)
    system = independent(rng, **drive, **LAWS[law])
    z0 = rng.uniform(-0.05, 0.05, N)
    run = simulate(system, z0, start, t[3], t_start=t[0], **SMOOTHED)
    k, r = np.diag(system.stiffness), system.damping
    ratio = system.static / system.slip_friction[0]
    hidden = hidden_term(ratio) if law != "plain" else np.zeros(N)
    x = np.concatenate([z0, start])
    for first, last in itertools.pairwise(t):
        length = last - first
        v0, v1 = (system.belt_speed_at(at) for at in (first, last))
        f0, f1 = (system.force_at(at) for at in (first, last))

        def motion(share, x, length=length, v=(v0, v1), f=(f0, f1)):
            z, w = x[:N], x[N:]
            gap = w - (v[0] + share * (v[1] - v[0]))
            lam = np.tanh(gap / EPS)
            friction = system.kinetic(gap) * (lam + hidden * lam * (1.0 - lam**2))
            return length * np.concatenate([w, f[0] + share * (f[1] - f[0]) - r * w - k * z - friction])

        x = solve_ivp(motion, (0.0, 1.0), x, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return errors(run, x[:N], x[N:], 1e-8)


@pytest.mark.parametrize("case", [passed, pushed])
def test_exact_events_on_ramps_of_any_length_at_any_time(rng, case):
    assert np.max([case(rng, low, low + 1) for low in range(-11, -1, 3)]) < 100


@pytest.mark.parametrize(("law", "of_belt"), [("plain", True), ("static", False), ("weakening", True)])
def test_smoothed_runs_across_ramps_of_any_length_at_any_time(rng, law, of_belt):
    assert np.max([smoothed(rng, law, of_belt, low, low + 2) for low in (-11, -5)]) < 100


@pytest.mark.parametrize("settings", [EXACT, SMOOTHED])
def test_the_phase_of_a_force_is_known_at_late_times(rng, settings):
    """cos(omega t + phase) at t of 1e9, by the exact value of the product omega t, in fractions and digits of pi.

    t is odd and so has thirty digits of two: a product with fewer is exact where one with all may not be.
    """
    late, omega, phase = float(2 * rng.integers(2**28, 2**29) + 1), rng.uniform(0.5, 3.0), rng.uniform(0.0, 6.0)
    with mpmath.workdps(50):
        there = float(mpmath.fmod(mpmath.mpf(omega) * mpmath.mpf(late) + mpmath.mpf(phase), 2 * mpmath.pi))
    runs = [
        simulate(System([[1.0]], 0.2, 0.3, force=Harmonic(2.0, omega, at)), 0.0, 0.0, t + 10.0, t_start=t, **settings)
        for at, t in ((phase, late), (there, 0.0))
    ]
    np.testing.assert_allclose(runs[0].z, runs[1].z, atol=1e-8)
    np.testing.assert_allclose(runs[0].w, runs[1].w, atol=1e-8)
    np.testing.assert_allclose(runs[0].events.t - late, runs[1].events.t, atol=2 * np.spacing(late))


# ends at bends


def carried(rng, start):
    """Blocks on belts that brake and speed up by jerks, some of which throw them off; their start; the bends."""
    n, knots = 6, start + np.array([-1.0, 1.0, 1.5, 3.0, 3.2, 4.0, 6.0])
    belt = Piecewise(knots, np.cumsum(rng.choice([-0.6, 0.0, 0.6], (7, n)) * rng.uniform(0.2, 1.0, (7, n)), axis=0))
    force = Piecewise(knots[[0, 2, 4]], rng.uniform(-0.5, 0.5, (3, n)))
    system = draw_system("chain", n, int(rng.integers(2**32)), kappa=0.5, leaf=0.5, rho=0.1)
    system = system.changed(belt_speed=belt, force=force, static=system.friction * rng.choice([1.0, 1.4]))
    return system, 0.3 * rng.normal(size=n), system.belt_speed_at(start), knots[1:-1]


@pytest.mark.parametrize("settings", [{"tol": 1e-12}, {"engine": "sigmoid", "eps": 0.01, "thresholds": (1.0,)}])
def test_a_run_to_a_bend_has_all_that_one_through_it_has(rng, settings):
    n_there = 0  # of some systems the first step after a bend is rejected
    for start in (0.0,) * 10 + (rng.uniform(0.0, 1e5),):
        system, z, w, knots = carried(rng, start=start)
        whole = simulate(system, z, w, start + 7.0, t_start=start, **settings)
        for knot in knots:
            part = simulate(system, z, w, knot, t_start=start, **settings)
            for one, all_of in zip(
                (part.events, *part.by_threshold.values()), (whole.events, *whole.by_threshold.values()), strict=True
            ):
                upto = all_of.t <= knot
                n_there += (all_of.t == knot).sum()
                assert one.t.tobytes() == all_of.t[upto].tobytes()
                assert one.block.tobytes() == all_of.block[upto].tobytes()
                assert one.mode.tobytes() == all_of.mode[upto].tobytes()
                assert one.n_stick(knot) == all_of.n_stick(knot)
    assert n_there > 0


def test_modes_at_an_exit_are_taken_on_belts_that_speed_up(rng):
    """What holds a block is m v' too: where that is at static friction to the tolerance, either mode may be asked."""
    for _ in range(3):
        mass, start = rng.uniform(0.5, 2.0), rng.uniform(0.0, 100.0)
        gain = rng.choice([-1, 1]) * rng.uniform(0.1, 2.0)
        belt = Piecewise([start - 1.0, start + 2.0], [0.1, 0.1 + 3.0 * gain])
        system = System([[1.0]], 0.2, belt_speed=belt, mass=mass)
        v = belt.at(start)
        z = 1.0 - 1e-9 - mass * gain - 0.2 * v
        for modes in ([0], [-1]):
            run = simulate(system, z, v, start + 1.0, t_start=start, modes=modes, tol=1e-6)
            again = simulate(system, z, v, start + 1.0, t_start=start, tol=1e-6)
            assert run.z.tobytes() == again.z.tobytes()
        with pytest.raises(ValueError, match="modes: expected what the state allows"):
            simulate(system, z - 0.1, v, start + 1.0, t_start=start, modes=[-1], tol=1e-6)


@pytest.mark.parametrize("v", [0.0, -0.3])
def test_a_force_that_turns_at_static_friction_moves_nothing(rng, v):
    """F touches -mu at a bend, up to rounding: a belt at rest, or one without springs. To the bend and through it."""
    for start in (0.0, rng.uniform(0.0, 1e4)):
        mu, damping, bend = rng.uniform(0.5, 1.5), rng.uniform(0.0, 1.0), start + rng.uniform(0.5, 8.0)
        top, end = mu + damping * v, bend + 0.7 * (bend - start)
        force = Piecewise([start, bend, 2 * bend - start], [0.0, top, -top])
        system = System([[0.0]], damping, mu, v, force=force)
        for t_end in (bend, end):
            run = simulate(system, 0.0, v, t_end, t_start=start)
            assert len(run.events) == 0
            assert run.n_stick(t_end) == 1


def test_a_run_on_a_ramp_goes_on_from_any_event_with_the_modes_there(rng):
    """Where it is cut, |F| with the ramp's part m v' is at static friction to the tolerance, above it or below."""
    for start in (0.0, rng.uniform(0.0, 1e3)):
        belt = Piecewise([start, start + 50.0], [-0.2, -0.2 - 50.0 * rng.uniform(0.002, 0.01)])
        stiffness = np.diag(rng.uniform(1.1, 2.6, 3)) - 0.3 * (np.eye(3, k=1) + np.eye(3, k=-1))
        system = System(stiffness, 0.0, 1.0, belt, static=rng.uniform(1.2, 2.0), weakening=Stribeck(0.5))
        end, z = start + 30.0, rng.uniform(-0.3, 0.3, 3)
        whole = simulate(system, z, -0.2, end, t_start=start)
        assert len(whole.events) > 3
        for k, t in enumerate(whole.events.t):
            part = simulate(system, z, -0.2, t, t_start=start)
            rest = simulate(system, part.z, part.w, end, t_start=t, modes=part.events.mode_at(t))
            assert len(rest.events) - (len(whole.events) - k - 1) in (0, 1)  # it may leave an instant later
            np.testing.assert_allclose([*rest.z, *rest.w], [*whole.z, *whole.w], atol=1e-6)
        with pytest.raises(ValueError, match="modes: expected what the state allows, got 1 for block 0"):
            simulate(system, z, -0.2, end, t_start=start, modes=[1, 0, 0])


def test_the_clock_of_a_long_run_does_not_drift(rng):
    """One undamped block with static friction: the time of its last exit in closed form, after a million units.

    Each step adds to the time: half a unit in its last place, of one sign for many steps, would come to 1e-6.
    """
    mp = mpmath.mp.clone()
    mp.dps = 40
    k, kinetic, v = (float(rng.uniform(*ends)) for ends in ((1.0, 2.0), (0.5, 1.0), (0.1, 0.3)))
    static = kinetic + float(rng.uniform(0.1, 0.4))
    run = simulate(System([[k]], 0.0, kinetic, -v, static=static), 0.0, -v, 1e6, tol=1e-13)
    leaves = run.events.t[run.events.is_exit]
    drop, rate = mp.mpf(static) - mp.mpf(kinetic), mp.sqrt(mp.mpf(k))
    period = 2 * drop / (mp.mpf(k) * v) + 2 / rate * (mp.pi - mp.atan(drop * rate / (mp.mpf(k) * v)))
    expected = mp.mpf(static) / (mp.mpf(k) * v) + (len(leaves) - 1) * period
    assert abs(float(leaves[-1] - expected)) < 1e-8
