"""Friction that falls with the speed of slip, and blocks that do not get ahead of their belt."""

from functools import partial

import numba
import numpy as np
import pytest
from numba import types
from scipy.integrate import solve_ivp

from stickslip.sim import Piecewise, Rational, Stribeck, System, draw_system, simulate
from stickslip.sim.engines import sigmoid_law
from stickslip.sim.kernels.emit import emitted
from stickslip.sim.systems.weakening import LAW_OF, LAWS
from tests.independent import follow
from tests.systems import draw_case, made

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


def test_the_closed_side_is_ahead_of_the_belt():
    assert System(np.eye(2), 0.1, belt_speed=0.3, back_slip=False).closed.tolist() == [1, 1]
    assert System(np.eye(2), 0.1, belt_speed=[0.3, -0.1], back_slip=False).closed.tolist() == [1, -1]
    stops = Piecewise([0.0, 1.0], [0.0, -0.2])
    assert System(np.eye(2), 0.1, belt_speed=stops, back_slip=False).closed.tolist() == [-1, -1]
    assert System(np.eye(2), 0.1).back_slip


# against an independent method


@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_exact_engine_against_an_independent_method(n, rng):
    for _ in range(4):
        case = draw_case(
            rng, n, "chain", damping=(0.0, 0.3), friction=(0.5, 1.5), belt_speed=(-0.5, -0.2, 0.1, 0.4),
            terms=["static", "weakening", "back_slip"], on_belt=0.5,
        )  # fmt: skip
        run, path = simulate(made(case), case.z0, case.w0, 15.0, tol=1e-12), follow(case, 15.0)
        assert [(block, mode) for block, mode in zip(path.block, path.mode, strict=True)] == list(
            zip(run.events.block.tolist(), run.events.mode.tolist(), strict=True)
        )
        np.testing.assert_allclose(run.z, path.z, rtol=0, atol=1e-8)
        np.testing.assert_allclose(run.w, path.w, rtol=0, atol=1e-8)


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


def test_without_bound_no_escape_is_certified():
    """A spring that pushes away: ahead of its belt a block is held for ever, the other way it escapes."""
    system = System([[-1.0]], 0.0, 1.0, -0.2, back_slip=False)
    held = simulate(system, -100.0, -0.2, 50.0)
    assert (held.outcome, len(held.events)) == ("finished", 0)
    assert simulate(system.changed(back_slip=True), -100.0, -0.2, 50.0).outcome == "diverged"


# the sigmoid engine

FINE = {"engine": "sigmoid", "rtol": 1e-9, "atol": 1e-9}


@pytest.mark.parametrize(("law", "static", "order"), [
    (Rational(3.0), 1.0, 1.0), (Stribeck(0.5), 1.4, 1.0), (Rational(3.0), 1.3, 2 / 3), (None, 1.0, 1.0),
    (None, 1.3, 2 / 3),
])  # fmt: skip
def test_the_smoothed_laws_tend_to_the_exact_ones(law, static, order):
    """As eps log(1 / eps), or, where a block leaves with a jump, as eps^(2/3)."""
    system = draw_system("chain", 5, 3, kappa=0.7, leaf=1.0, rho=0.2, static=static)
    system, z = system.changed(weakening=law, back_slip=static > 1.0), np.linspace(-0.3, 0.3, 5)
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
    for _ in range(4):
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


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_thresholds_of_sticking_see_the_open_side_alone(side):
    v, z = side * 0.2, side * -3.0
    system = System([[1.0]], 0.0, 1.0, v, weakening=Rational(2.0), back_slip=False)
    run = simulate(system, z, v, 25.0, eps=1e-3, stick="threshold", thresholds=(2.0,), **FINE)
    for threshold, series in ((1.0, run.events), (2.0, run.by_threshold[2.0])):
        assert series.initial_mode.tolist() == [0]
        assert series.mode.tolist()[:1] == [-side]  # when it has come to F = -mu tanh(threshold), not before
        assert series.t[0] == pytest.approx((3.0 + np.tanh(threshold)) / 0.2, abs=0.3)


# every law that kernels know by code


@pytest.mark.parametrize(("kind", "law"), LAW_OF.items())
def test_the_law_and_its_slope(kind, law):
    """Of the smoothed law, against the formula, and differences."""
    x = np.concatenate([np.geomspace(1e-6, 3000.0, 300), -np.geomspace(1e-6, 3000.0, 300)])
    c, far, fall = 0.7, 0.4, 0.3

    def piece(code, x, closed):
        return sigmoid_law.open_sign(kind, x, *(x * 0.0 + y for y in (c, far, fall)), closed)

    formula = emitted(piece, types.UniTuple(types.float64, 2))
    of_both = numba.njit(lambda x, closed: formula(x, closed))
    for closed in (-1.0, 0.0, 1.0):
        apply = partial(of_both, closed=closed)
        lam = np.tanh(x)
        value = (lam + c * lam * (1 - lam**2)) * (far + (1 - far) * law.shape(fall * abs(x)))
        value = np.where(x * closed > 0, (1 + c) * x, value)
        np.testing.assert_allclose([apply(one)[0] for one in x], value, rtol=1e-13, atol=1e-15)
        h = 1e-5 * np.maximum(abs(x), 1e-2)
        slope = [(apply(one + d)[0] - apply(one - d)[0]) / (2 * d) for one, d in zip(x, h, strict=True)]
        smooth = abs(x) > 1e-4  # second derivatives jump at 0
        np.testing.assert_allclose(np.array([apply(one)[1] for one in x])[smooth], np.array(slope)[smooth], atol=1e-6)


@pytest.mark.parametrize("law", LAW_OF.values())
def test_the_recurrence_gives_the_series_of_the_shape(law, rng):
    """The sum of S_k t^k against S(x(t)), within a third of the distance of a pole; S_0 = 0 makes all of it zero."""
    orders, n = 81, 20
    z, x0, scale = np.zeros((orders + 1, n)), rng.uniform(0.0, 5.0, n), rng.uniform(-2.0, 2.0, n)
    z[2:5] = rng.uniform(-0.1, 0.1, (3, n))
    series = np.full((1, orders, n), np.nan)
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
