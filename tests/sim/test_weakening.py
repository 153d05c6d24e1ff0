"""Friction that falls with the speed of slip, and blocks that do not get ahead of their belt."""

import numba
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from stickslip.sim import Piecewise, Rational, Stribeck, System, draw_system, perturb_system, simulate
from stickslip.sim.energy import energy
from stickslip.sim.engines.waveform import friction
from stickslip.sim.numerics.lanes import on_number
from stickslip.sim.systems.weakening import LAWS, kind_of
from tests.scenes import own_law
from tests.systems import draw_run

# the system


def test_the_laws():
    u = np.array([[0.0], [-0.5], [2.0]])
    rational = System(np.eye(2), 0.1, [1.0, 0.5], static=1.3, weakening=Rational(3.0))
    np.testing.assert_allclose(rational.kinetic(u), np.array([1.0, 0.5]) / (1 + 3 * abs(u)), rtol=1e-15)
    assert rational.is_static_above
    stribeck = System(np.eye(2), 0.1, [1.0, 0.5], static=1.3, weakening=Stribeck(0.5))
    mu = np.array([1.0, 0.5])
    np.testing.assert_allclose(stribeck.kinetic(u), mu + (1.3 - mu) * np.exp(-abs(u) / 0.5), rtol=1e-15)
    assert not stribeck.is_static_above  # it begins to slip with its static friction
    assert "static 1.3, Stribeck(speed=0.5), no back slip" in repr(stribeck.changed(back_slip=False))
    assert "Rational(rate=3.0)" in rational._repr_html_()


def test_they_go_where_the_system_goes():
    system = draw_system("antisymmetric", 4, 0).changed(weakening=Rational(2.0), back_slip=False)
    other = perturb_system(system, "antisymmetric", 0.01, 1)
    assert other.weakening == Rational(2.0)
    assert other.closed.tolist() == [-1] * 4


def test_the_closed_side_is_ahead_of_the_belt():
    assert System(np.eye(2), 0.1, belt_speed=0.3, back_slip=False).closed.tolist() == [1, 1]
    assert System(np.eye(2), 0.1, belt_speed=[0.3, -0.1], back_slip=False).closed.tolist() == [1, -1]
    stops = Piecewise([0.0, 1.0], [0.0, -0.2])
    assert System(np.eye(2), 0.1, belt_speed=stops, back_slip=False).closed.tolist() == [-1, -1]
    assert System(np.eye(2), 0.1).back_slip


# against an independent method


def follow(system, z0, w0, t_end):
    """Events (t, block, mode) and the state at the end: DOP853 from event to event, laws written out."""
    n, v, law = system.n, system.belt_speed, system.weakening
    mu, static, damping, stiffness = system.friction, system.static, system.damping, system.stiffness
    ahead = 0.0 if system.back_slip else np.sign(v)

    def kinetic(u):
        if isinstance(law, Rational):
            return mu / (1 + law.rate * abs(u))
        return mu if law is None else mu + (static - mu) * np.exp(-abs(u) / law.speed)

    def pulls(z):  # what drives a block that sticks out, to a side that is open
        force = damping * v + stiffness @ z
        return abs(force) if ahead == 0 else ahead * force

    z, w, t, events = np.array(z0, dtype=float), np.array(w0, dtype=float), 0.0, []
    mode = np.sign(w - v).astype(int)
    leaves = (mode == 0) & (pulls(z) > static)
    mode[leaves] = -np.sign(damping * v + stiffness @ z)[leaves]

    def rate(t, y):
        z, w = y[:n], y[n:]
        slips = -damping * w - stiffness @ z - kinetic(w - v) * mode
        return np.concatenate([np.where(mode == 0, v, w), np.where(mode == 0, 0.0, slips)])

    def watch(i):
        def function(t, y):
            return mode[i] * (y[n + i] - v) if mode[i] else static[i] - pulls(y[:n])[i]

        function.terminal, function.direction = True, -1
        return function

    def off_its_zero(t, y):  # a first step too short to change w would find the event that has just been again
        found = solve_ivp(rate, (t, t + 1e-6), y, "DOP853", rtol=1e-13, atol=1e-16)
        return found.t[-1], found.y[:, -1].copy()

    y = np.concatenate([z, w])
    if leaves.any():
        t, y = off_its_zero(t, y)
    while True:
        found = solve_ivp(
            rate, (t, t_end), y, "DOP853", rtol=1e-12, atol=1e-13, events=[watch(i) for i in range(n)], max_step=0.02
        )
        t, y = found.t[-1], found.y[:, -1].copy()
        if found.status == 0:
            return events, y[:n], y[n:]
        i = next(k for k in range(n) if len(found.t_events[k]))
        side = -int(np.sign((damping * v + stiffness @ y[:n])[i]))
        was_stuck, y[n + i] = mode[i] == 0, v
        mode[i] = side if was_stuck or pulls(y[:n])[i] > static[i] else 0
        events.append((t, i, mode[i]))
        assert len(events) < 1000, f"the independent method does not go on at t = {t}"
        if mode[i]:
            t, y = off_its_zero(t, y)


@pytest.mark.parametrize("n", [1, 2])
def test_the_exact_engine_against_an_independent_method(n, rng):
    late = [0.0]
    for _ in range(8):
        system, z, w = draw_run(
            rng, n, "chain", damping=(0.0, 0.3), friction=(0.5, 1.5), belt_speed=(-0.5, -0.2, 0.1, 0.4),
            terms=["static", "weakening", "back_slip"], on_belt=0.5,
        )  # fmt: skip
        run = simulate(system, z, w, 15.0, tol=1e-12)
        events, z_end, w_end = follow(system, z, w, 15.0)
        print(system, len(events))
        assert [(block, mode) for _, block, mode in events] == list(
            zip(run.events.block.tolist(), run.events.mode.tolist(), strict=True)
        )
        late.extend(np.abs(run.events.t - [t for t, _, _ in events]))
        # the errors of `follow`, amplified: runs at tol = 1e-12 and 1e-14 differ by 1e-12 where it is off by 4e-9
        np.testing.assert_allclose(run.z, z_end, rtol=0, atol=3e-8)
        np.testing.assert_allclose(run.w, w_end, rtol=0, atol=3e-8)
    assert np.median(late) < 3e-9  # near a tangency an error of the state moves an event as far as one likes


# the exact engine


def test_a_block_without_springs_stops_as_its_closed_form_says():
    """u' = -mu / (1 + a u): u + a u^2 / 2 falls as mu t. u' = -(mu + (m - mu) exp(-u / s)): so does s log(...)."""
    u, mu = 0.8, 0.7
    run = simulate(System([[0.0]], 0.0, mu, 0.1, weakening=Rational(3.0)), 0.0, 0.1 + u, 10.0, tol=1e-13)
    assert run.events.mode.tolist() == [0]
    assert run.events.t[0] == pytest.approx((u + 1.5 * u * u) / mu, rel=1e-12)
    system = System([[0.0]], 0.0, mu, 0.1, 1.5, weakening=Stribeck(0.3))
    stop = simulate(system, 0.0, 0.1 + u, 10.0, tol=1e-13).events.t[0]
    assert stop == pytest.approx(0.3 / mu * np.log((mu * np.exp(u / 0.3) + 1.5 - mu) / 1.5), rel=1e-12)


def test_a_law_that_hardly_falls_is_constant_friction():
    system = draw_system("antisymmetric", 20, 0, static=1.2)
    plain = simulate(system, -0.7, -0.4, 20.0)
    weak = simulate(system.changed(weakening=Rational(1e-11)), -0.7, -0.4, 20.0)
    np.testing.assert_allclose(weak.z, plain.z, rtol=0, atol=1e-7)
    assert weak.events.mode.tolist() == plain.events.mode.tolist()
    assert weak.outcome == "finished"  # no certificate holds for friction that is not constant


def test_no_block_gets_ahead_of_its_belt():
    """Pulled ahead with 30 times its static friction it sticks; from the other side it leaves as ever."""
    system = System([[1.0]], 0.0, 1.0, -0.2, 1.3, back_slip=False)
    run = simulate(system, 40.0, -0.2, 195.0)
    assert len(run.events) == 0
    assert run.events.initial_mode[0] == 0
    run = simulate(system, 40.0, -0.2, 210.0, tol=1e-13)
    assert run.events.mode.tolist() == [1]
    assert run.events.t[0] == pytest.approx(41.3 / 0.2, rel=1e-13)
    with pytest.raises(ValueError, match=r"w0: expected no block ahead .* got block 0 ahead by 0.1"):
        simulate(system, 0.0, -0.3, 1.0)


@pytest.mark.parametrize("law", [Rational(5.0), Stribeck(0.2)])
def test_energy_balances(law, rng):
    system = draw_system("chain", 4, int(rng.integers(2**32)), kappa=0.7, leaf=1.0, rho=0.2, static=1.4)
    system, z = system.changed(weakening=law), rng.uniform(-0.3, 0.3, 4)
    run = simulate(system, z, -0.2, 20.0, tol=1e-13)
    account = energy(system, run, z, -0.2, tol=1e-13)
    assert account.heat[-1] > 1.0
    assert np.abs(account.imbalance).max() < 1e-10


def test_without_bound_no_escape_is_certified():
    """A spring that pushes away: ahead of its belt a block is held for ever, the other way it escapes."""
    system = System([[-1.0]], 0.0, 1.0, -0.2, back_slip=False)
    held = simulate(system, -100.0, -0.2, 50.0)
    assert (held.outcome, len(held.events)) == ("finished", 0)
    assert simulate(system.changed(back_slip=True), -100.0, -0.2, 50.0).outcome == "diverged"


# the field's numbers


def basin(nx, ny, **engine):
    """Share of starts, midpoints of a grid over [-2, 2] x [0, 2], from which one block comes to slide steadily.

    The friction oscillator of bSTAB (Stender and Hoffmann, doi:10.1007/s11071-021-06786-5): damping ratio 0.05, mu
    from 1 to 0.5 on the speed 0.5, belt 1.5.
    """
    system = System([[1.0]], 0.1, 0.5, 1.5, 1.0, weakening=Stribeck(0.5))
    count = 0
    for z in -2 + 4 * (np.arange(nx) + 0.5) / nx:
        for w in 2 * (np.arange(ny) + 0.5) / ny:
            series = simulate(system, z, w, 60.0, **engine).events
            count += not (series.mode == 0).any()  # who sticks once is on the cycle of stick and slip
    return count / (nx * ny)


def test_the_basin_of_steady_sliding():
    """Its border is the unstable cycle, found by reversing time: 0.30713 of the region."""
    coarse = basin(24, 12, tol=1e-6)
    print(coarse)
    assert abs(coarse - 0.30713) < 0.015


# the sigmoid engine

FINE = {"engine": "sigmoid", "rtol": 1e-9, "atol": 1e-9}


@pytest.mark.parametrize(("law", "static", "order"), [
    (Rational(3.0), 1.0, 1.0), (Stribeck(0.5), 1.4, 1.0), (Rational(3.0), 1.3, 2 / 3), (None, 1.0, 1.0),
    (None, 1.3, 2 / 3),
])  # fmt: skip
@pytest.mark.parametrize("back_slip", [True, False])
def test_the_smoothed_laws_tend_to_the_exact_ones(law, static, order, back_slip):
    """As eps log(1 / eps), or, where a block leaves with a jump, as eps^(2/3)."""
    system = draw_system("chain", 5, 3, kappa=0.7, leaf=1.0, rho=0.2, static=static)
    system, z = system.changed(weakening=law, back_slip=back_slip), np.linspace(-0.3, 0.3, 5)
    exact = simulate(system, z, -0.2, 9.0, tol=1e-12)
    errors, widths = [], np.array([1e-3, 1e-4, 1e-5])
    for eps in widths:
        run = simulate(system, z, -0.2, 9.0, eps=eps, **FINE)
        errors.append(max(np.abs(run.z - exact.z).max(), np.abs(run.w - exact.w).max()))
    print(len(exact.events), errors)
    assert len(exact.events) > 3
    assert run.events.mode.tolist() == exact.events.mode.tolist()
    assert order - 0.25 < np.polyfit(np.log(widths), np.log(errors), 1)[0] < order + 0.2


@pytest.mark.parametrize("falls", [Rational(5e3), Stribeck(1e-4), Stribeck(1e-2), None], ids=str)
def test_a_block_that_its_belt_does_not_hold_leaves_a_thin_layer_in_time(falls, rng):
    """From w = v with |F| beyond friction; or, where it falls fast, held at first by what is left between both."""
    for _ in range(12):
        mu, over, v = 10 ** rng.uniform(-1, 0.5), rng.uniform(1.02, 1.5), -rng.choice([0.0, 0.2, 1.0])
        k, delta, tol = 10 ** rng.uniform(-1, 1), 10 ** rng.uniform(-7, -5), 10 ** rng.uniform(-9, -5)
        top = mu * (1.5 if isinstance(falls, Stribeck) else 1.0)
        system = System([[k]], 0.0, mu, v, static=top, weakening=falls)
        z = -over * top / k

        def rates(t, x, system=system, delta=delta, k=k, v=v):
            u = x[1]
            return [u + v, -k * x[0] - np.tanh(u / delta) * float(system.kinetic(np.array([u]))[0])]

        t_end = 0.3 / np.sqrt(k)
        options = {"method": "Radau", "rtol": 1e-11, "atol": 1e-13, "first_step": 1e-3 * delta}
        expected = solve_ivp(rates, (0.0, t_end), [z, 0.0], **options).y[:, -1] + [0.0, v]
        run = simulate(system, z, v, t_end, engine="sigmoid", eps=delta, rtol=tol, atol=tol)
        error = np.abs([run.z[0], run.w[0]] - expected).max() / (tol * (1.0 + np.abs(expected).max()))
        print(system, delta, tol, error)
        assert error < 40


@pytest.mark.parametrize("falls", [Rational(1.0), Stribeck(0.5)])
@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-5])
@pytest.mark.parametrize("tol", [1e-4, 1e-7, 1e-10])
def test_terms_that_vanish_where_damping_makes_up_for_the_fall_of_friction_end_no_series(falls, off, tol):
    """A block without springs on a belt that gains speed: u of the order of t^2 has no terms in t^3 and t^4."""
    mass, static = 4.0, 1.5 if isinstance(falls, Stribeck) else 1.0
    belt = Piecewise([0.0, 4.0], [-1.0, 0.5])
    system = System([[0.0]], 1.0 + off, 1.0, belt, static, mass=mass, weakening=falls)
    leaves = (static / (1.0 + off) - mass * 0.375 / (1.0 + off) + 1.0) / 0.375  # m v' + R v is the static friction

    def rates(t, x):
        u = max(-1.0 + 0.375 * t - x[0], 0.0)
        return [(-(1.0 + off) * x[0] + float(system.kinetic(np.array([-u]))[0])) / mass]

    exact = solve_ivp(rates, (leaves, 4.0), [-1.0 + 0.375 * leaves], method="DOP853", rtol=1e-12, atol=1e-13)
    run = simulate(system, 0.0, -1.0, 4.0, tol=tol)
    assert run.events.mode.tolist() == [-1]
    assert run.events.t[0] == pytest.approx(leaves, abs=1e-9)
    assert run.w[0] == pytest.approx(exact.y[0, -1], rel=0, abs=tol + 1e-11)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_barred_side_holds_in_the_limit(side):
    """What is pulled ahead of its belt with 30 times its friction creeps there, by 30 eps, and sticks."""
    v, z = side * 0.2, side * -30.0
    system = System([[1.0]], 0.0, 1.0, v, back_slip=False)
    for eps in (1e-2, 1e-3, 1e-4):
        run = simulate(system, z, v, 1.0, eps=eps, **FINE)
        assert (len(run.events), run.events.initial_mode[0]) == (0, 0)
        assert run.w[0] - v == pytest.approx(-run.z[0] * eps, rel=0.01)
        away = simulate(system.changed(back_slip=True), z, v, 1.0, eps=eps, **FINE)
        assert away.events.mode_at(1.0)[0] == side


@pytest.mark.parametrize("law", [None, Rational(2.0)])
def test_the_mirror_image_of_a_smoothed_run_with_a_barred_side_has_the_same_bytes(law, rng):
    system = draw_system("chain", 6, int(rng.integers(2**32)), kappa=0.5, leaf=1.0, rho=0.1, static=1.5)
    system, z = system.changed(weakening=law, back_slip=False), rng.uniform(-0.5, 0.5, 6)
    mirror = system.changed(belt_speed=0.2, back_slip=False)
    more = {"eps": 1e-2, "thresholds": (2.0,), **FINE}
    run, image = simulate(system, z, -0.2, 20.0, **more), simulate(mirror, -z, 0.2, 20.0, **more)
    for one, other in ((run.events, image.events), (run.by_threshold[2.0], image.by_threshold[2.0])):
        assert len(one) > 0
        np.testing.assert_array_equal(other.t, one.t)
        np.testing.assert_array_equal(other.mode, -one.mode)
        np.testing.assert_array_equal(other.initial_mode, -one.initial_mode)
    np.testing.assert_array_equal(image.z, -run.z)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_thresholds_of_sticking_see_the_open_side_alone(side):
    v, z = side * 0.2, side * -3.0
    system = System([[1.0]], 0.0, 1.0, v, weakening=Rational(2.0), back_slip=False)
    run = simulate(system, z, v, 25.0, eps=1e-3, stick="threshold", thresholds=(2.0,), **FINE)
    for threshold, series in ((1.0, run.events), (2.0, run.by_threshold[2.0])):
        assert series.initial_mode.tolist() == [0]
        assert series.mode.tolist()[:1] == [-side]  # when it has come to F = -mu tanh(threshold), not before
        assert series.t[0] == pytest.approx((3.0 + np.tanh(threshold)) / 0.2, abs=0.3)


# every law of `LAWS`, and that of the guide, by its forms


def of_the_guide():
    made = {"__name__": "lorentz"}
    exec(own_law(), made)
    return made["Lorentz"]


FORMS = (*LAWS.values(), of_the_guide())


@pytest.mark.parametrize("law", FORMS)
def test_the_law_and_its_slope(law):
    """Of the smoothed law, against the formula, and differences."""
    kind = kind_of(law)
    x = np.concatenate([np.geomspace(1e-6, 3000.0, 300), -np.geomspace(1e-6, 3000.0, 300)])
    c, far, fall = 0.7, 0.4, 0.3
    for closed in (-1.0, 0.0, 1.0):
        rest = c, far, fall, closed
        formula = on_number(lambda x, rest=rest: friction.open_sign(kind, x, *(x * 0.0 + y for y in rest)))
        apply = numba.njit(lambda x, formula=formula: formula(x))
        lam = np.tanh(x)
        value = (lam + c * lam * (1 - lam**2)) * (far + (1 - far) * law.shape(fall * abs(x)))
        value = np.where(x * closed > 0, (1 + c) * x, value)
        np.testing.assert_allclose([apply(one)[0] for one in x], value, rtol=1e-13, atol=1e-15)
        h = 1e-5 * np.maximum(abs(x), 1e-2)
        slope = [(apply(one + d)[0] - apply(one - d)[0]) / (2 * d) for one, d in zip(x, h, strict=True)]
        smooth = abs(x) > 1e-4  # second derivatives jump at 0
        np.testing.assert_allclose(np.array([apply(one)[1] for one in x])[smooth], np.array(slope)[smooth], atol=1e-6)


@pytest.mark.parametrize("law", FORMS)
def test_the_recurrence_gives_the_series_of_the_shape(law, rng):
    """The sum of S_k t^k against S(x(t)), within a third of the distance of a pole; S_0 = 0 makes all of it zero."""
    orders, n = 81, 20
    z, x0, scale = np.zeros((orders + 1, n)), rng.uniform(0.0, 5.0, n), rng.uniform(-2.0, 2.0, n)
    z[2:5] = rng.uniform(-0.1, 0.1, (3, n))
    series = np.full((law.n_series, orders, n), np.nan)
    series[0, 0] = np.where(np.arange(n) == 0, 0.0, law.shape(x0))
    for k in range(1, orders):
        law.recurrence(k, z, x0, scale, series)
    t = 0.5
    x = x0 + scale * sum((j + 1) * z[j + 1] * t**j for j in range(1, 4))
    expected = np.where(np.arange(n) == 0, 0.0, law.shape(x))
    np.testing.assert_allclose(np.polynomial.polynomial.polyval(t, series[0]), expected, rtol=1e-12, atol=1e-13)


def test_laws_and_their_parameters_have_names_of_their_own():
    """A scene and a dataset know a law by its parameters alone."""
    names = [key for law in LAWS.values() for key in law.parameters()]
    assert len(set(names)) == len(names)
    assert all(name == law.name for name, law in LAWS.items())


# what engines do not know


class Formless(Rational):
    """A law that is known, but not in the forms that engines need."""

    recurrence = on_lanes = None


@pytest.mark.parametrize(("engine", "form"), [("coulomb", "recurrence"), ("sigmoid", "on_lanes")])
def test_an_engine_names_the_form_that_a_law_lacks(engine, form):
    expected = f"^weakening: expected a law with the form `{form}`, which engine='{engine}' needs and .* has, got"
    with pytest.raises(TypeError, match=expected):
        simulate(System([[1.0]], 0.1, weakening=Formless(1.0)), 0.0, 0.0, 1.0, engine=engine)
