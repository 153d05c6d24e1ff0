"""Hard cases: starts and systems at which methods are known to slip, each with an answer known beforehand.

The answer is the series of events under the exact law, in closed form, and z between them by the exponential of the
linear motion; two cases, which have no closed form, take it from another method. The smoothed law is off by O(eps),
so its engine is held to `LAYERS` widths.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from stickslip.sim import System, draw_system, simulate

from .reference import follow

#: The width of the layers, and the tolerance of each engine.
EPS, TOLERANCE, EXACT_TOLERANCE = 1e-4, 1e-9, 1e-12
#: Errors of z that are right: of the exact law; of the smoothed one in widths, and over the tolerance.
ALLOWED, LAYERS, TOLERANCES = 1e-8, 20.0, 100.0
#: Errors of the exact law's event times that are right: a root that is nearly double is known to less.
ALLOWED_TIME = 1e-6


@dataclass(frozen=True, eq=False)
class Case:
    """`events` are (t, block, mode), None where any number of events of no duration is right; `scale` is z's."""

    name: str
    system: System
    z0: np.ndarray
    w0: np.ndarray
    t_end: float
    z_at: Callable
    events: tuple | None
    delta: np.ndarray
    scale: float = 1.0
    outcome: str = "finished"


def motion(system, z0, w0, modes, events):
    """z(t) of the exact law, given the modes at the start and every change of them.

    Between events x' = A x + c: a slipping block has w' = -R w - K z - mu mode, a sticking one w' = 0 with w = v.
    """

    def z_at(t):
        x, now, mode = np.concatenate((z0, w0, [1.0])), 0.0, np.array(modes)
        for when, block, new in (*(event for event in events if event[0] <= t), (t, 0, None)):
            x = expm((when - now) * _generator(system, mode)) @ x
            now = when
            if new is not None:
                mode[block] = new
                x[system.n + block] = system.belt_speed
        return x[: system.n]

    return z_at


def _generator(system, mode):
    n = system.n
    generator = np.zeros((2 * n + 1, 2 * n + 1))
    generator[:-1, :-1] = system.slip_matrix()
    generator[n:-1, -1] = -system.friction * mode
    generator[n:-1][mode == 0] = 0.0
    return generator


def case(name, system, z0, w0, t_end, modes, events, scale=1.0, outcome="finished", any_events=False):
    z, w = np.zeros(system.n) + z0, np.zeros(system.n) + w0
    z_at = motion(system, z, w, modes, events)
    delta = np.full(system.n, EPS * scale)
    return Case(name, system, z, w, t_end, z_at, None if any_events else events, delta, scale, outcome)


def grazing():
    """z = -1 + cos t slips right, w = -sin t; |F| = mu at the touch. Once held, z falls until F = -mu again."""
    for gap, word in ((-1e-8, "just missing, by 1e-8"), (0.0, "touching"), (1e-8, "crossing, by 1e-8")):
        speed, events = 1.0 - gap, ()
        if gap > 0:
            entry = 0.5 * math.pi - 2.0 * math.asin(math.sqrt(0.5 * gap))
            events = ((entry, 0, 0), (entry + math.cos(entry) / speed, 0, 1))
        system = System([[1.0]], 0.0, 1.0, -speed)
        yield case(f"graze: {word}", system, 0.0, 0.0, 5.0, (1,), events, any_events=gap == 0)


def free():
    """z = cos t crosses w = v at sin t = -v."""
    for name, gap in (("no friction", 0.5), ("no friction, two crossings 3e-4 apart", 1e-8)):
        half = math.pi / 2 - math.asin(0.5) if gap == 0.5 else 2.0 * math.asin(math.sqrt(0.5 * gap))
        middles = [math.pi / 2 + 2 * math.pi * k for k in range(2)]
        events = tuple(event for t in middles for event in ((t - half, 0, -1), (t + half, 0, 1)))
        yield case(name, System([[1.0]], 0.0, 0.0, gap - 1.0), 1.0, 0.0, 10.0, (1,), events)


def edges():
    """F_1 = side mu, F_1' = 0 at the start; F_1" = -w_2' / 2 decides, and where that is 0 its derivative."""
    for side, acceleration in ((1, 0.5), (1, -0.5), (1, 0.0), (-1, 0.0)):
        z2, c = 0.5, 0.25
        z1 = side + 0.25 + 0.5 * z2
        d = (1.25 - c * z1 - acceleration) / z2
        turn = side * (-acceleration if acceleration else -(c + 2.0 * d))
        word = "fold, F' = 0" if acceleration else "cusp, F' = F'' = 0"
        system = System([[1.0, -0.5], [c, d]], [0.25, 0.125], 1.0, -1.0)
        modes = (-side if turn > 0 else 0, -1)
        name = f"{word}: {'leaves' if turn > 0 else 'holds'}"
        yield case(name, system, [z1, z2], [-1.0, -2.0], 0.25, modes, ())


#: R = 0.1, K = 1, v = -0.2 from z = 3, w = 1: the damped oscillator's own times, to 40 digits.
ONE_BLOCK = ((0.29075098367384344, 0, -1), (3.231881443452085, 0, 0), (4.104721534065557, 0, 1))


def several():
    five = tuple((t, block, mode) for t, _, mode in ONE_BLOCK for block in range(5))
    copies = System(0.5 * np.eye(5) + 0.1, 0.1, 1.0, -0.2)
    yield case("five identical blocks", copies, 3.0, 1.0, 20.0, (1,) * 5, five)
    # a half swing loses 2 mu / K
    swing = tuple(
        (math.pi * k, block, (0 if k == 2 else 1) * sign) for k in (1, 2) for block, sign in enumerate((1, -1))
    )
    mirror = System([[1.5, 0.5], [0.5, 1.5]], 0.0, 1.0, 0.0)
    yield case("mirror images, v = 0", mirror, [4.5, -4.5], 0.0, 20.0, (-1, 1), swing)
    slow, events = System([[1.0]], 0.0, 1.0, -1e-12), ((1e-12 / 5.5, 0, -1), (math.pi, 0, 1), (2 * math.pi, 0, 0))
    yield case("hardly a belt, v = -1e-12", slow, 4.5, 0.0, 20.0, (1,), events)
    apart = System(np.diag([1.0, 1e6]), [0.1, 0.0], [1.0, 0.0], -0.2)
    every = tuple(sorted((*ONE_BLOCK, *crossings(1000.0, 2e-4, 5.0))))
    yield case("K of 1 and 1e6", apart, [3.0, 1.0], [1.0, 0.0], 5.0, (1, 1), every)


def crossings(omega, ratio, t_end):
    """Events of block 1, z = cos(omega t): w passes v = -ratio omega down at omega t = a + 2 pi k, up at pi - a."""
    a = math.asin(ratio)
    for k in range(math.ceil(t_end * omega / (2.0 * math.pi))):
        for phase, mode in ((a, -1), (math.pi - a, 1)):
            t = (phase + 2.0 * math.pi * k) / omega
            if t <= t_end:
                yield t, 1, mode


def extremes():
    for scale in (1e8, 1e-8):
        system = System([[1.0]], 0.1, scale, -0.2 * scale)
        # the same motion in other units
        yield case(f"scale {scale:g}", system, 3.0 * scale, scale, 20.0, (1,), ONE_BLOCK, scale)
    # w' = -R w + mu - K z with z at its start: w reaches v after log((w0 - c) / (v - c)) / R, c = (mu - K z) / R
    rate, z0 = 1e6, -0.7
    c = (1.0 - z0) / rate
    passes = ((math.log((-0.4 - c) / (-0.2 - c)) / rate, 0, 1),)
    yield case("overdamped, R = 1e6", System([[1.0]], rate, 1.0, -0.2), z0, -0.4, 0.1, (-1,), passes)
    unit = System([[1.0]], 0.1, 1.0, -0.2)
    yield case("t_end = 1e6", unit, 3.0, 1.0, 1e6, (1,), ONE_BLOCK, outcome="collapsed")
    # like exp(0.99 t): z passes the largest float64 before t_end
    runaway = System([[1.0, -3.0], [3.0, 1.0]], 0.1, 1.0, -0.2)
    yield case(
        "growth without bound", runaway, [1.0, 0.0], 0.0, 1000.0, (1, 1), (), outcome="diverged", any_events=True
    )


CASES = {one.name: one for some in (grazing, free, edges, several, extremes) for one in some()}
#: What the 34-digit reference takes seconds for, or what ends before its end.
SLOW = {"K of 1 and 1e6", "overdamped, R = 1e6", "t_end = 1e6", "growth without bound", "five identical blocks"}


# ---------------------------------------------------------------------------------------------- what is known


@pytest.mark.parametrize("name", sorted(set(CASES) - SLOW))
def test_what_is_known_is_what_the_reference_finds(name):
    one, scale = CASES[name], CASES[name].scale
    system = System(
        one.system.stiffness, one.system.damping, one.system.friction / scale, one.system.belt_speed / scale
    )
    t_end = min(one.t_end, 8.0)
    found = follow(system, one.z0 / scale, one.w0 / scale, t_end)
    np.testing.assert_allclose(found.z, one.z_at(t_end) / scale, rtol=0, atol=1e-10)
    if one.events is None:
        return
    known = sorted(event for event in one.events if event[0] <= t_end)
    listed = sorted(zip(found.t, found.block, found.mode, strict=True))
    assert [event[1:] for event in listed] == [event[1:] for event in known]
    np.testing.assert_allclose([event[0] for event in listed], [event[0] for event in known], rtol=0, atol=1e-11)


def test_five_copies_are_one_block():
    copies, one = CASES["five identical blocks"], CASES["t_end = 1e6"]
    for t in (0.2, 1.0, 3.5, 15.0):
        np.testing.assert_allclose(copies.z_at(t), np.full(5, one.z_at(t)), atol=1e-12)


def test_the_overdamped_block_passes_the_belt_when_it_should():
    """From 40 digits of the same linear motion: at the known time w = v up to what neglecting K (z - z0) costs."""
    one = CASES["overdamped, R = 1e6"]
    ((t, *_),) = one.events
    h = 1e-9  # a thousandth of 1 / R
    w = (one.z_at(t)[0] - one.z_at(t - h)[0]) / h
    assert w == pytest.approx(-0.2, abs=2e-4)


def test_the_fast_block_is_a_cosine():
    one = CASES["K of 1 and 1e6"]
    for t in (0.3, 5.0):
        assert one.z_at(t)[1] == pytest.approx(np.cos(1000 * t), abs=1e-9)
    times = [t for t, block, _ in one.events if block == 1]
    np.testing.assert_allclose(-1000 * np.sin(1000 * np.array(times)), -0.2, atol=1e-8)
    assert len(times) == np.count_nonzero(np.diff(np.sign(-1000 * np.sin(1000 * np.linspace(0, 5, 200_001)) + 0.2)))


def test_growth_is_what_the_eigenvalues_say():
    one = CASES["growth without bound"]
    growth = np.linalg.eigvals(one.system.slip_matrix()).real.max()
    assert growth == pytest.approx(0.99, abs=0.01)
    assert growth * one.t_end > np.log(np.finfo(float).max)


# ---------------------------------------------------------------------------------------------- the engines


def smooth(one, stop_early=False):
    return simulate(
        one.system, one.z0, one.w0, one.t_end, engine="sigmoid", eps=1.0, ratio=one.delta, rtol=TOLERANCE,
        atol=TOLERANCE * one.scale, stop_early=stop_early,
    )  # fmt: skip


def width_of(one):
    return LAYERS * one.delta.max() / one.scale + TOLERANCES * TOLERANCE


@pytest.mark.parametrize("name", CASES)
def test_the_exact_engine_is_right(name):
    one = CASES[name]
    stop_early = one.outcome != "finished"
    run = simulate(one.system, one.z0, one.w0, one.t_end, tol=EXACT_TOLERANCE, stop_early=stop_early)
    assert run.outcome == one.outcome
    if run.outcome == "diverged":
        return
    np.testing.assert_allclose(run.z / one.scale, one.z_at(run.t_end) / one.scale, rtol=0, atol=ALLOWED)
    if one.events is None:
        return
    order = np.argsort(run.events.block, kind="stable")  # events of one instant have no order between blocks
    expected = sorted(one.events, key=lambda event: event[1])
    modes = zip(run.events.block[order].tolist(), run.events.mode[order].tolist(), strict=True)
    assert list(modes) == [(block, mode) for _, block, mode in expected]
    np.testing.assert_allclose(run.events.t[order], [t for t, *_ in expected], rtol=0, atol=ALLOWED_TIME)


@pytest.mark.parametrize("name", sorted(set(CASES) - {"scale 1e+08"}))
def test_the_sigmoid_engine_is_right_within_what_the_laws_differ_by(name):
    one = CASES[name]
    run = smooth(one, one.outcome != "finished")
    assert run.outcome == one.outcome
    if run.outcome != "diverged":
        np.testing.assert_allclose(run.z / one.scale, one.z_at(run.t_end) / one.scale, rtol=0, atol=width_of(one))


def test_layers_wider_than_one_are_refused():
    with pytest.raises(ValueError, match=r"needs ratio \* eps < 1, got 10000"):
        smooth(CASES["scale 1e+08"])


def of_an_ensemble(n, delta):
    return Case(
        "", draw_system("antisymmetric", n=n, seed=0), np.full(n, -0.7), np.full(n, -0.4), 10.0, None, None, delta
    )


def test_layers_from_1e_2_to_1e_8_in_one_system_of_seven():
    """Against SciPy's Radau."""
    one = of_an_ensemble(7, 10.0 ** -np.linspace(2, 8, 7))
    system, n = one.system, 7

    def rate(t, y):
        z, w = y[:n], y[n:]
        push = system.friction * np.tanh((w - system.belt_speed) / one.delta)
        return np.concatenate([w, -system.stiffness @ z - system.damping * w - push])

    def jacobian(t, y):
        cosh = np.cosh(np.minimum(np.abs((y[n:] - system.belt_speed) / one.delta), 300.0))
        drag = np.diag(system.damping + system.friction / one.delta / cosh**2)
        return np.block([[np.zeros((n, n)), np.eye(n)], [-system.stiffness, -drag]])

    start = np.concatenate([one.z0, one.w0])
    found = solve_ivp(rate, (0.0, one.t_end), start, "Radau", rtol=1e-10, atol=1e-10, jac=jacobian)
    np.testing.assert_allclose(smooth(one).z, found.y[:n, -1], rtol=0, atol=TOLERANCES * TOLERANCE)


def test_layers_of_1e_8_are_the_exact_law():
    """Of 20 blocks; the laws differ by O(eps)."""
    one = of_an_ensemble(20, np.full(20, 1e-8))
    exact = simulate(one.system, one.z0, one.w0, one.t_end, tol=1e-14, stop_early=False)
    np.testing.assert_allclose(smooth(one).z, exact.z, rtol=0, atol=width_of(one))
