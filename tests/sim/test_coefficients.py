"""Friction laws that are data: a formula, a table, a function of the speed of slip, in both engines."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numba
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from stickslip import Curve, Harmonic, Rational, System, Table, Weakening, simulate
from stickslip.sim.energy import energy
from stickslip.sim.engines.polynomials import Polynomials, left_at
from stickslip.sim.systems.weakening import parameter
from tests.independent import follow
from tests.systems import draw_case, made

FINE = {"engine": "sigmoid", "rtol": 1e-9, "atol": 1e-10}


@dataclass(frozen=True)
class TwoExponentials(Weakening):
    """mu (0.6 exp(-b u) + 0.4 exp(-5 b u))."""

    rate: float = parameter(power=-1)

    @property
    def steepness(self):
        return self.rate

    def ends(self, friction, static):
        return friction, np.zeros_like(friction)

    @staticmethod
    def shape(x):
        return 0.6 * np.exp(-x) + 0.4 * np.exp(-5.0 * x)


def stribeck(u):
    """It falls, and rises again from u = 0.2 on."""
    return 0.3 + 0.25 * np.exp(-u / 0.1) + 0.05 * u


SPEEDS = np.append(0.0, np.geomspace(0.01, 3.0, 29))
LAWS = {
    "formula": (TwoExponentials(2.0), []),
    "function": (Curve(stribeck), []),
    "table": (Table(SPEEDS, stribeck(SPEEDS) * (1.0 + 0.03 * np.cos(17.0 * np.arange(30)))), SPEEDS),
}


def coefficient(law):
    """mu by |u|, of a block with friction 1, as NumPy has it."""
    system = System([[1.0]], 0.0, 1.0, weakening=law)
    return lambda u: float(system.kinetic([u])[0])


# in both engines, against quadrature


@pytest.mark.parametrize("name", LAWS)
def test_a_free_block_is_braked_in_the_time_of_the_integral(name, rng):
    law, knots = LAWS[name]
    mu, mass, load, v = coefficient(law), *rng.uniform(0.5, 2.0, 2), rng.choice([-0.3, 0.2])
    for u in rng.uniform(0.3, 2.5, 2):
        places = np.unique([0.0, u, *(knot for knot in knots if knot < u)])
        parts = [quad(lambda u: mass / (load * mu(u)), *ends, epsrel=1e-13, limit=500) for ends in pairwise(places)]
        time = sum(part for part, _ in parts)
        system = System([[0.0]], 0.0, load, v, mass=mass, weakening=law)
        exact = simulate(system, 0.0, v + u, time + 1.0, tol=1e-13)
        assert exact.events.mode.tolist() == [0]
        assert exact.events.t[0] == pytest.approx(time, rel=1e-11)
        half = simulate(system, 0.0, v + u, 0.5 * time, tol=1e-13).w[0]
        errors = [abs(simulate(system, 0.0, v + u, 0.5 * time, eps=eps, **FINE).w[0] - half) for eps in (1e-2, 1e-5)]
        assert errors[1] < 1e-7  # the layer is behind it


# against an own event-driven integration


def event_driven(system, mu, knots, z, w, t_end):
    """z, w and events at the end, by DOP853 from event to event, and from knot to knot of the law; v is constant."""
    n, v, load = system.n, np.broadcast_to(system.belt_speed, system.n), system.friction
    damping = np.diag(system.damping) + (0.0 if system.cross_damping is None else system.cross_damping)
    knots = [*(knot for knot in knots if knot > 0.0), np.inf]

    def pull(t, z, w):
        return damping @ w + system.stiffness @ z - system.force_at(t)

    def new_mode(t, z, w, i):
        force = pull(t, z, w)[i]
        return 0 if abs(force) <= system.static[i] else -int(np.sign(force))

    mode = np.sign(w - v).astype(int)
    mode = np.array([m if m else new_mode(0.0, z, w, i) for i, m in enumerate(mode)])
    t, series = 0.0, []
    rung = np.searchsorted(knots, np.abs(w - v), side="right")
    while True:
        slips = mode.copy()

        def rates(t, y, slips=slips):
            z, w = y[:n], np.where(slips == 0, v, y[n:])
            friction = [load[i] * mu(max(slips[i] * (w[i] - v[i]), 0.0)) * slips[i] for i in range(n)]
            return np.append(w, np.where(slips == 0, 0.0, (-pull(t, z, w) - friction) / system.mass))

        ends, owners = [], []
        for i in range(n):
            functions = (
                [lambda t, y, i=i, s=slips[i]: s * (y[n + i] - v[i])]
                if slips[i]
                else [lambda t, y, i=i, s=s: system.static[i] - s * pull(t, y[:n], y[n:])[i] for s in (1, -1)]
            )
            for function in functions:
                function.terminal, function.direction = True, -1
                ends.append(function)
                owners.append((i, "mode"))
            if slips[i] and len(knots) > 1:
                for k in (rung[i] - 1, rung[i]):
                    if 0 <= k < len(knots) - 1:
                        way = 1 if k == rung[i] else -1

                        def passes(t, y, i=i, s=slips[i], knot=knots[k]):
                            return s * (y[n + i] - v[i]) - knot

                        passes.terminal, passes.direction = True, way
                        ends.append(passes)
                        owners.append((i, way))
        y0 = np.append(z, np.where(slips == 0, v, w))
        path = solve_ivp(rates, (t, t_end), y0, method="DOP853", rtol=1e-13, atol=1e-15, events=ends, max_step=0.05)
        t, z, w = path.t[-1], path.y[:n, -1], np.where(slips == 0, v, path.y[n:, -1])
        if path.status == 0:
            return z, w, series
        for (i, kind), times in zip(owners, path.t_events, strict=True):
            if len(times) and kind == "mode":
                w[i] = v[i]
                mode[i] = new_mode(t, z, w, i) if slips[i] else -int(np.sign(pull(t, z, w)[i]))
                rung[i] = 0
                series.append((t, i, mode[i]))
            elif len(times):
                rung[i] += kind


@pytest.mark.parametrize("name", LAWS)
def test_coupled_blocks_against_an_event_driven_integration(name, rng):
    law, knots = LAWS[name]
    mu = coefficient(law)
    for n in (2,) if len(knots) else (2, 5):
        a = rng.normal(size=(n, n))
        stiffness, load = a @ a.T / n + np.diag(rng.uniform(0.3, 1.0, n)), rng.uniform(0.6, 1.5, n)
        system = System(
            stiffness, rng.uniform(0.1, 0.5, n), load, -rng.uniform(0.1, 0.3, n), load * mu(0.0) * 1.1,
            mass=rng.uniform(0.5, 2.0, n), force=Harmonic(rng.uniform(0.0, 0.2, n), 1.3), weakening=law,
        )  # fmt: skip
        z, w = 0.5 * rng.normal(size=n), 0.3 * rng.normal(size=n)
        t_end = 3.0 if len(knots) else 8.0
        z_end, w_end, series = event_driven(system, mu, knots, z, w, t_end)
        errors = []
        for tol in (1e-6, 1e-9, 1e-12):
            run = simulate(system, z, w, t_end, tol=tol)
            errors.append(max(np.abs(run.z - z_end).max(), np.abs(run.w - w_end).max()))
        assert list(zip(run.events.block.tolist(), run.events.mode.tolist(), strict=True)) == [
            (i, mode) for _, i, mode in series
        ]
        assert errors[0] < 1e-3
        assert errors[1] < 1e-6
        assert errors[2] < 1e-8


@pytest.mark.parametrize("terms", [
    ("static", "force", "belt", "mass", "back_slip"),
    pytest.param(("static", "force", "belt", "mass", "cross"), marks=pytest.mark.long),
])  # fmt: skip
def test_random_systems_with_all_terms_against_an_independent_method(terms, rng):
    """The law of Carlson and Langer, which the method knows, as data."""
    for k in range(3):
        case = draw_case(rng, (1, 3), "chain", damping=(0.0, 0.5), friction=(0.5, 1.5), terms=terms, on_belt=0.3)
        rate = float(rng.choice([0.3, 1.0, 3.0]))
        law = Curve(lambda u, a=rate: 1.0 / (1.0 + a * u)) if k % 2 else Fast(rate)
        system, path = made(case).changed(weakening=law), follow(replace(case, falls=("rational", rate)), 8.0)
        run = simulate(system, case.z0, case.w0, 8.0, tol=1e-12, stop_early=False)  # some grow without limit
        size = 1.0 + max(np.abs(path.z).max(), np.abs(path.w).max())
        np.testing.assert_allclose(run.z, path.z, rtol=0, atol=1e-8 * size)
        np.testing.assert_allclose(run.w, path.w, rtol=0, atol=1e-8 * size)


class Fast(Rational):
    """The law of Carlson and Langer by its formula alone."""

    @staticmethod
    def shape(x):
        return 1.0 / (1.0 + x)


@pytest.mark.parametrize("name", LAWS)
def test_the_smoothed_law_tends_to_the_exact_one(name):
    """In proportion to eps, of blocks that leave stick without a jump."""
    law, _ = LAWS[name]
    stiffness = np.array([[1.3, -0.5, 0.0], [-0.5, 1.4, -0.5], [0.0, -0.5, 1.1]])
    system = System(stiffness, 0.6, [1.0, 0.8, 1.2], -0.2, weakening=law)
    exact = simulate(system, [0.5, -0.3, 0.2], -0.2, 13.0, tol=1e-12)
    errors, widths = [], np.array([1e-3, 1e-4, 1e-5])
    for eps in widths:
        run = simulate(system, [0.5, -0.3, 0.2], -0.2, 13.0, eps=eps, **FINE)
        errors.append(max(np.abs(run.z - exact.z).max(), np.abs(run.w - exact.w).max()))
    assert len(exact.events) > 2
    assert run.events.mode.tolist() == exact.events.mode.tolist()
    assert 0.7 < np.polyfit(np.log(widths), np.log(errors), 1)[0] < 1.2


def test_the_balance_of_energy_closes(rng):
    for law, allowed in ((LAWS["formula"][0], 1e-9), (LAWS["function"][0], 1e-9), (LAWS["table"][0], 1e-6)):
        system = System([[1.0, -0.4], [-0.4, 0.9]], 0.1, [1.0, 0.7], -0.2, mass=[1.5, 0.7], weakening=law)
        z = rng.uniform(-0.5, 0.5, 2)
        run = simulate(system, z, "belt", 20.0, tol=1e-12)
        assert len(run.events) > 3
        assert abs(energy(system, run, z, -0.2, tol=1e-12).imbalance).max() < allowed


# the laws themselves


def test_a_function_is_followed_to_rounding(rng):
    for function in (
        stribeck,
        lambda u: 1.0 / (1.0 + (3.0 * u) ** 2),
        lambda u: 0.4 - 0.1 * np.tanh(5.0 * u) + 0.02 * np.arctan(u),
        lambda u: 0.5 * np.exp(-((u / 0.3) ** 2)) + 0.2,
    ):
        scale = 10.0 ** rng.uniform(-3.0, 3.0)
        law = Curve(lambda u, f=function, s=scale: f(u / s))
        u = scale * np.append(rng.uniform(0.0, 3.0, 500), np.geomspace(1e-6, 1e2, 500))
        truth = np.array([function(x) for x in u / scale])
        np.testing.assert_allclose(law.curve.at(u), truth, rtol=0, atol=5e-14 * np.abs(truth).max())
        assert law.curve.error < 1e-13


def test_a_kink_is_an_end_of_pieces():
    law = Curve(lambda u: 0.3 + abs(u - 0.4))
    u = np.linspace(0.0, 2.0, 1001)
    np.testing.assert_allclose(law.curve.at(u), 0.3 + abs(u - 0.4), rtol=0, atol=1e-9)
    run = simulate(System([[0.0]], 0.0, 1.0, 0.0, weakening=law), 0.0, 1.5, 10.0, tol=1e-12)
    assert run.events.t[0] == pytest.approx(np.log(0.7 / 0.3) + np.log(1.4 / 0.3), rel=1e-8)


def test_a_table_is_passed_at_once_where_springs_pull_by_more_than_friction_changes_their_last_digit():
    """z = z0 cos t to rounding, in steps of the swing and not of the pieces."""
    law, z0 = Table([0.0, 0.1, 0.3, 1.0], [1.0, 0.8, 0.7, 0.9]), 1e16
    run = simulate(System([[1.0]], 0.0, 1.0, -0.2, weakening=law), z0, 0.0, 1.0)
    assert run.z[0] == pytest.approx(z0 * np.cos(1.0), rel=1e-13)
    assert run.stats.n_steps < 10


@numba.njit
def leaving(pieces, series, x0):
    return left_at(pieces, series, 1.0, x0, 0, 3, 1.0)


def test_a_speed_that_leaves_its_piece_and_turns_back_between_two_looks_is_seen():
    """x = 1.0001 - (0.53 - s)^2 is above 1 from s = 0.52 to 0.54, between the eighths of the step."""
    pieces = Polynomials.of(Table([0.0, 1.0, 2.0, 3.0], [1.0, 0.8, 0.7, 0.7]).curve)
    series = np.array([0.0, 0.0, 0.53, -1.0 / 3.0])[:, np.newaxis]  # those of (k + 1) c_k+1 s^k
    assert leaving(pieces, series, 1.0001 - 0.53**2) == pytest.approx(0.52, abs=1e-6)
    assert leaving(pieces, series, 0.9999 - 0.53**2) == 1.0


def test_a_table_goes_through_its_values_and_rises_and_falls_as_they_do(rng):
    for _ in range(20):
        m = int(rng.integers(4, 60))
        x, y = np.append(0.0, np.cumsum(10.0 ** rng.uniform(-3.0, 0.0, m - 1))), rng.uniform(0.0, 1.0, m)
        y[0], y[1:] = 0.5, np.where(rng.random(m - 1) < 0.2, 0.0, y[1:])
        law = Table(x, y)
        np.testing.assert_allclose(law.curve.at(x), y, rtol=0, atol=1e-14)
        for k in range(m - 1):
            inside = law.curve.at(np.linspace(x[k], x[k + 1], 200))
            assert inside.min() >= -1e-13
            turns = [not 0 < i < m - 1 or (y[i] - y[i - 1]) * (y[i + 1] - y[i]) <= 0 for i in (k, k + 1)]
            if not any(turns):
                assert (np.diff(inside) * np.sign(y[k + 1] - y[k]) >= -1e-13).all()
        assert law.curve.at(x[-1] + 1.0) == y[-1]


def test_the_error_of_a_table_falls_as_the_third_power_at_least_and_is_stated():
    errors, stated, u = [], [], np.linspace(0.0, 2.0, 4001)
    for m in (41, 81, 161):
        x = np.linspace(0.0, 2.0, m)
        law = Table(x, stribeck(x))
        errors.append(np.abs(law.curve.at(u) - stribeck(u)).max())
        stated.append(law.error)
    assert np.log2(errors[0] / errors[-1]) / 2.0 > 3.0
    assert (np.array(stated) > errors).all()


def test_static_friction_left_out_is_that_of_a_block_that_begins_to_slip():
    law = LAWS["table"][0]
    system = System(np.eye(2), 0.1, [2.0, 3.0], weakening=law)
    np.testing.assert_allclose(system.static, np.array([2.0, 3.0]) * law.coefficients[0], rtol=1e-15)
    assert not system.is_static_above
    np.testing.assert_array_equal(system.changed(friction=1.0).static, law.coefficients[0])
    given = System(np.eye(2), 0.1, 1.0, static=law.coefficients[0], mass=[0.3, 0.7], weakening=law)
    assert not given.of_unit_mass.is_static_above
    with pytest.raises(ValueError, match="static: expected at least the kinetic friction"):
        System(np.eye(2), 0.1, 1.0, static=0.9 * law.coefficients[0], weakening=law)


def test_laws_keep_their_motion_in_other_units():
    given = {"stiffness": [[1e4]], "damping": 1.0, "friction": 50.0, "belt_speed": -0.01, "mass": 2.0}
    x = np.append(0.0, np.geomspace(1e-3, 0.3, 20))
    for law in (Table(x, stribeck(30.0 * x)), Curve(lambda u: stribeck(30.0 * u))):
        system, scales = System.from_physical(**given, weakening=law)
        physical = System(**given, weakening=law)
        run = simulate(physical, 0.0, -0.01, 1.0, tol=1e-12)
        other = simulate(system, 0.0, -0.01 / scales.speed, 1.0 / scales.time, tol=1e-12)
        assert len(run.events) > 1
        np.testing.assert_allclose(other.events.t * scales.time, run.events.t, rtol=1e-9)


def test_a_law_that_rises_without_bound_certifies_no_escape():
    """Negative damping of 0.1 against friction that rises as 0.5 u: it comes to rest."""
    law = Curve(lambda u: 1.0 + 0.5 * u)
    run = simulate(System([[1.0]], -0.1, 1.0, -0.1, weakening=law), 100.0, 0.0, 100.0, stop_early=True)
    assert run.outcome != "diverged"
    assert abs(run.w[0]) < 1.0


@pytest.mark.parametrize(("speeds", "coefficients", "words"), [
    ([0.0, 1.0, 2.0], [0.5, 0.4, 0.3], r"speeds: expected 4 to 255 numbers, got shape \(3,\)"),
    ([0.1, 1.0, 2.0, 3.0], [0.5, 0.4, 0.3, 0.3], r"speeds: expected numbers that rise from 0, got 0\.1 in place 0"),
    ([0.0, 1.0, 1.0, 3.0], [0.5, 0.4, 0.3, 0.3], r"got 1 after 1 in place 2"),
    ([0.0, 1.0, 2.0, np.nan], [0.5, 0.4, 0.3, 0.3], r"speeds: expected finite numbers, got nan"),
    ([0.0, 1.0, 2.0, 3.0], [0.5, 0.4, np.inf, 0.3], r"coefficients: expected finite numbers, got inf"),
    ([0.0, 1.0, 2.0, 3.0], [1e308, 1.0, 0.0, 1e308], r"coefficients: expected values that cubics .* can join"),
    ([0.0, 1e-300, 2e-300, 3e-300], [0.5, 0.4, 0.4, 0.3], r"coefficients: .* can join, got up to 0\.5 at .* 3e-300"),
    ([0.0, 1.0, 2.0, 3.0], [0.5, 0.4, -0.1, 0.3], r"coefficients: expected at least 0, got -0\.1 at the speed 2"),
    ([0.0, 1.0, 2.0, 3.0], [0.0, 0.4, 0.1, 0.3], r"coefficients: expected a coefficient above 0 at rest, got 0;"),
    ([0.0, 1.0, 2.0, 3.0], [0.5, 0.4, 0.1], r"coefficients: expected one for each of 4 speeds, got shape \(3,\)"),
])  # fmt: skip
def test_what_is_no_table_is_refused(speeds, coefficients, words):
    with pytest.raises(ValueError, match=words):
        Table(speeds, coefficients)


@pytest.mark.parametrize(("function", "words"), [
    (lambda u: 0.5 - 0.1 * u, r"function: expected coefficients of at least 0, got -"),
    (lambda u: 0.5 if u < 0.1 else 0.3, r"function: expected a continuous curve, got one that changes by 0\.[0-9]+"),
    (lambda u: 0.5 + 1e-3 * np.sin(1e6 * u), r"function: expected a curve that 255 polynomials"),
    (lambda u: 0.5 + 0.1 * np.sin(u), r"function: expected a curve that 255 polynomials .*; lower `fastest`"),
    (lambda u: np.nan, r"function: expected finite friction, got nan at 0"),
    (lambda u: {}[u], r"function: expected a number at the speed"),
    (lambda u: u, r"function: expected a coefficient above 0 at rest, got 0"),
])  # fmt: skip
def test_what_is_no_curve_is_refused(function, words):
    with pytest.raises(ValueError, match=words):
        Curve(function)


def test_a_function_that_is_rough_is_followed_to_an_error_that_is_stated():
    law = Curve(lambda u: 0.5 - 0.1 * min(u, 1.0) ** 0.5)
    u = np.linspace(0.0, 2.0, 1001)
    np.testing.assert_allclose(law.curve.at(u), 0.5 - 0.1 * np.minimum(u, 1.0) ** 0.5, atol=law.curve.error)
    assert 1e-9 < law.curve.error < 1e-4


def test_a_function_that_waves_is_followed_to_a_speed():
    assert Curve(lambda u: 0.5 + 0.1 * np.sin(u), fastest=50.0).curve.error < 1e-13


@dataclass(frozen=True)
class Below(TwoExponentials):
    @staticmethod
    def shape(x):
        return 1.5 * np.exp(-x) - 0.5


def test_a_shape_that_takes_friction_below_zero_is_refused():
    with pytest.raises(ValueError, match=r"weakening: expected kinetic friction of at least 0, got -0\.5 for block"):
        System([[1.0]], 0.1, weakening=Below(1.0))


def test_two_tables_and_two_functions_are_told_apart():
    x = np.linspace(0.0, 3.0, 40)
    assert repr(Table(x, stribeck(x))) != repr(Table(x, 1.0001 * stribeck(x)))
    assert repr(Curve(stribeck)) == repr(Curve(stribeck)) != repr(Curve(lambda u: 1.0001 * stribeck(u)))
    assert str(Table(x, stribeck(x))) == "Table(40 coefficients from 0.324571 to 0.55, speeds to 3)"
