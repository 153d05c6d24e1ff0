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
from scipy.linalg import expm
from scipy.sparse import csc_array

from stickslip.sim import System, simulate

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
    for store, word in ((np.array, ""), (csc_array, ", in a sparse K")):
        copies = System(store(0.5 * np.eye(5) + 0.1), 0.1, 1.0, -0.2)
        yield case("five identical blocks" + word, copies, 3.0, 1.0, 20.0, (1,) * 5, five)
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


def among(name, v, friction, z0, w0, t_end, modes, events):
    """Uncoupled blocks, K = 1 and R = 0, alone, and beside others on the belt, where events are passed on."""
    for rest, store, word in (
        (0, np.array, ""),
        (63, np.array, " of many"),
        (63, csc_array, " of many, in a sparse K"),
    ):
        stiffness = np.diag(np.r_[np.ones(len(modes)), np.zeros(rest)])
        system = System(store(stiffness), 0.0, np.r_[friction, np.ones(rest)], v)
        start = np.r_[z0, np.zeros(rest)], np.r_[w0, np.full(rest, v)]
        yield case(name + word, system, *start, t_end, (*modes, *[0] * rest), events)


def at_the_edge():
    """Where a block comes to its belt |F| = m, or F' is as small as the error of F: derivatives of F decide."""
    size, enters = math.sqrt(4.04), math.atan(0.1)  # z = -1 + size cos t passes 1 at the speed -0.2, t = atan 0.1
    events = ((enters, 0, 0), (enters + 10.0, 0, 1))
    yield from among("carried in from the edge", -0.2, 1.0, size - 1.0, 0.0, 11.0, (1,), events)
    start, events = (-1.0 + size * math.cos(1.0), size * math.sin(1.0)), ((1.0 - enters, 0, -1),)
    yield from among("carried out from the edge", 0.2, 1.0, *start, 5.0, (1,), events)
    # z = -1 + 2^-27 (1 - t / 2), beside a swing of 1000 whose error F' is below
    v = -(2.0**-28)
    start = [-1.0 + 2.0**-27, -1e3 * math.cos(0.3)], [v, 1e3 * math.sin(0.3)]
    yield from among("leaves a belt that hardly moves", v, [1.0, 0.0], *start, 2.5, (0, 1), ((2.0, 0, 1),))


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


CASES = {one.name: one for some in (grazing, free, edges, several, at_the_edge, extremes) for one in some()}


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
    case = CASES[name]
    run = simulate(
        case.system, case.z0, case.w0, case.t_end, engine="sigmoid", eps=1.0, ratio=case.delta, rtol=TOLERANCE,
        atol=TOLERANCE * case.scale, stop_early=case.outcome != "finished",
    )  # fmt: skip
    assert run.outcome == case.outcome
    if run.outcome != "diverged":
        allowed = LAYERS * case.delta.max() / case.scale + TOLERANCES * TOLERANCE
        np.testing.assert_allclose(run.z / case.scale, case.z_at(run.t_end) / case.scale, rtol=0, atol=allowed)
