"""A law of friction from a user's file: against a closed form, and what is asked of it."""

from dataclasses import dataclass

import numpy as np
import pytest

from stickslip import Rational, System, draw_system, simulate
from stickslip.sim.energy import energy
from stickslip.sim.systems.weakening import Weakening
from tests.scenes import own_law


@pytest.fixture(scope="module")
def lorentz():
    made = {"__name__": __name__}
    exec(own_law(), made)
    return made["Lorentz"]


def test_a_block_is_braked_to_its_belt_in_the_time_and_way_of_the_closed_form(lorentz, rng):
    """A free block that friction brakes from |w - v| = u: m u' = -mu / (1 + (b u)^2), by integrals of powers of u."""
    for side in (-1.0, 1.0):
        b, mu, m, v, u = rng.uniform([0.5, 0.5, 0.5, -1.0, 0.5], [4.0, 2.0, 2.0, 1.0, 3.0])
        time = m / mu * (u + b**2 * u**3 / 3)
        way = v * time + side * m / mu * (u**2 / 2 + b**2 * u**4 / 4)
        system = System([[0.0]], 0.0, mu, v, mass=m, weakening=lorentz(b))
        run = simulate(system, 0.0, v + side * u, time + 0.5, t_eval=[time], tol=1e-13)
        assert run.events.mode[0] == 0
        assert run.events.t[0] == pytest.approx(time, rel=1e-10)
        assert run.samples.z[0, 0] == pytest.approx(way, abs=1e-9)


def test_the_balance_of_energy_closes_which_knows_the_shape_alone(lorentz, rng):
    n = 6
    system = draw_system("chain", n, int(rng.integers(2**32)), kappa=0.5, leaf=0.3, rho=0.1, static=1.5).changed(
        weakening=lorentz(rng.uniform(1.0, 5.0)), back_slip=False, mass=rng.uniform(0.5, 2.0, n)
    )
    z = rng.uniform(-0.5, 0.5, n)
    run = simulate(system, z, "belt", 40.0, tol=1e-12)
    assert len(run.events) > 5
    balance = energy(system, run, z, -0.2, tol=1e-12)
    assert abs(balance.imbalance).max() < 1e-9


class Doubled(Rational):
    @staticmethod
    def shape(x):
        return 2.0 / (1.0 + x)


def test_a_shape_that_does_not_begin_with_one_is_refused():
    with pytest.raises(ValueError, match=r"^weakening: expected a law with S\(0\) = 1, got 2 from .* Doubled"):
        System([[1.0]], 0.1, weakening=Doubled(1.0))


@dataclass(frozen=True)
class Unitless(Weakening):
    rate: float

    steepness = Rational.steepness
    ends = Rational.ends
    shape = staticmethod(Rational.shape)


def test_units_are_asked_of_each_parameter(lorentz):
    given = {"stiffness": [[100.0]], "damping": 0.1, "friction": 3.0, "belt_speed": 0.1, "mass": 2.0}
    system, scales = System.from_physical(**given, weakening=lorentz(4.0))
    assert system.weakening.sharpness == pytest.approx(4.0 * scales.speed)
    with pytest.raises(TypeError, match=r"^weakening: expected powers .*'rate': 0\} of Unitless; .*power=-1"):
        System.from_physical(**given, weakening=Unitless(4.0))


def _falling(law, friction, static):
    return friction, 0.0 * friction


def _shape(x):
    return 1.0 / (1.0 + x * x)


#: What is wrong of a law, and what is said of it.
WRONG = [
    ("ends", lambda law, mu, static: (-mu, mu), "of at least 0 .* got -1 at block 0"),
    ("ends", lambda law, mu, static: (mu, np.nan * mu), "of at least 0 .* got nan at block 0"),
    ("ends", lambda law, mu, static: mu, "two arrays of shape .* near and far"),
    ("ends", lambda law, mu, static: (mu[:0], mu), "two arrays of shape .* near and far"),
    ("shape", staticmethod(lambda x: np.ones(3)), "for each of 1 x, got float64 of shape"),
    ("shape", staticmethod(lambda x: "0.3"), "for each of 1 x, got <U3"),
    ("shape", staticmethod(lambda x: np.exp(-x) + 0j), "for each of 1 x, got complex128"),
    ("shape", staticmethod(lambda x: {}["x"]), "got KeyError: 'x'"),
    ("steepness", np.nan, "got nan"),
]


@pytest.mark.parametrize(("form", "value", "words"), WRONG)
@pytest.mark.parametrize("engine", ["coulomb", "sigmoid"])
def test_a_law_that_gives_no_friction_is_refused(form, value, words, engine):
    forms = {"steepness": 3.0, "ends": _falling, "shape": staticmethod(_shape), form: value}
    law = type("Wrong", (Weakening,), forms)
    with pytest.raises((TypeError, ValueError), match=words):
        simulate(System([[1.0]], 0.1, 1.0, -0.2, weakening=law()), 0.0, 0.0, 5.0, engine=engine)
