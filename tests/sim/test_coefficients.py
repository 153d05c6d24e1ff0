"""Friction laws that are data: a formula, a table, a function of the speed of slip, in both engines."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from stickslip import Curve, Harmonic, System, Table, Weakening, simulate
from stickslip.sim.systems.weakening import parameter

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
        time = sum(quad(lambda u: mass / (load * mu(u)), *ends, epsabs=1e-14)[0] for ends in pairwise(places))
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
        path = solve_ivp(rates, (t, t_end), y0, method="DOP853", rtol=1e-12, atol=1e-13, events=ends, max_step=0.05)
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
    for n in (2, 4):
        a = rng.normal(size=(n, n))
        stiffness, load = a @ a.T / n + np.diag(rng.uniform(0.3, 1.0, n)), rng.uniform(0.6, 1.5, n)
        system = System(
            stiffness, rng.uniform(0.1, 0.5, n), load, -rng.uniform(0.1, 0.3, n), load * mu(0.0) * 1.1,
            mass=rng.uniform(0.5, 2.0, n), force=Harmonic(rng.uniform(0.0, 0.2, n), 1.3), weakening=law,
        )  # fmt: skip
        z, w = 0.5 * rng.normal(size=n), 0.3 * rng.normal(size=n)
        z_end, w_end, series = event_driven(system, mu, knots, z, w, 8.0)
        errors = []
        for tol in (1e-6, 1e-9, 1e-12):
            run = simulate(system, z, w, 8.0, tol=tol)
            errors.append(max(np.abs(run.z - z_end).max(), np.abs(run.w - w_end).max()))
        assert list(zip(run.events.block.tolist(), run.events.mode.tolist(), strict=True)) == [
            (i, mode) for _, i, mode in series
        ]
        assert errors[0] < 1e-3
        assert errors[1] < 1e-6
        assert errors[2] < 1e-8
