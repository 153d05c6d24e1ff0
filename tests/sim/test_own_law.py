"""A law of friction from a user's file: against quadrature in both engines, and how its kernels are kept."""

import os
import subprocess
import sys
from dataclasses import dataclass

import numba
import numpy as np
import pytest
from scipy.integrate import quad

from stickslip import Piecewise, Rational, System, draw_system, simulate
from stickslip.sim.energy import energy
from stickslip.sim.kernels.digest import code_digest
from stickslip.sim.systems.weakening import LAW_OF, Weakening, kind_of
from tests.scenes import own_law


@pytest.fixture(scope="module")
def lorentz():
    made = {"__name__": __name__}
    exec(own_law(), made)
    return made["Lorentz"]


class Braked:
    """A free block that friction brakes from |w - v| = u, m u' = -mu / (1 + (b u)^2): scipy's quadrature of that."""

    def __init__(self, rng, law):
        self.b, self.mu, self.m = rng.uniform(0.5, 4.0), rng.uniform(0.5, 2.0), rng.uniform(0.5, 2.0)
        self.v, self.side, self.u = rng.uniform(-1.0, 1.0), rng.choice([-1.0, 1.0]), rng.uniform(0.5, 3.0)
        self.system = System([[0.0]], 0.0, self.mu, self.v, mass=self.m, weakening=law(self.b))
        self.start = 0.0, self.v + self.side * self.u

    def _slowness(self, x):
        return self.m * (1.0 + (self.b * x) ** 2) / self.mu

    def time(self, least=0.0):
        """The time until |w - v| is `least`."""
        return quad(self._slowness, least, self.u, epsabs=1e-13, epsrel=1e-13)[0]

    def way(self):
        """The way until it sticks."""
        return quad(lambda x: (self.v + self.side * x) * self._slowness(x), 0.0, self.u, epsabs=1e-13, epsrel=1e-13)[
            0
        ]


def test_a_block_is_braked_to_its_belt_in_the_time_and_way_of_the_quadrature(lorentz, rng):
    for _ in range(5):
        block = Braked(rng, lorentz)
        time = block.time()
        run = simulate(block.system, *block.start, time + 0.5, tol=1e-13)
        assert run.events.mode[0] == 0
        assert run.events.t[0] == pytest.approx(time, rel=1e-10)
        assert simulate(block.system, *block.start, time, tol=1e-13).z[0] == pytest.approx(block.way(), abs=1e-9)


@pytest.mark.long
def test_the_smoothed_block_comes_to_the_layer_in_that_time(lorentz, rng):
    """It sticks below |u| = eps ln(1 / eps), and friction lacks 2 exp(-2 |u| / eps) of mu: an error of eps."""
    for _ in range(5):
        block = Braked(rng, lorentz)
        for eps in (1e-3, 1e-4, 1e-5):
            time = block.time(eps * np.log(1 / eps))
            run = simulate(block.system, *block.start, time + 0.5, engine="sigmoid", eps=eps, rtol=1e-10, atol=1e-10)
            assert abs(run.events.t[0] - time) < eps


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


class Same(Rational):
    """The law of another class, from here."""


@pytest.mark.long
@pytest.mark.parametrize("settings", [{"tol": 1e-12}, {"engine": "sigmoid", "eps": 1e-3, "rtol": 1e-8, "atol": 1e-8}])
def test_a_law_of_the_package_is_the_same_from_outside(settings, rng):
    system = draw_system("chain", 5, int(rng.integers(2**32)), kappa=0.5, leaf=0.3, rho=0.1, static=1.5)
    z, belt = rng.uniform(-0.5, 0.5, 5), Piecewise([0.0, 30.0], [-0.2, -0.3])
    inside, outside = (
        simulate(system.changed(weakening=law(3.0), belt_speed=belt), z, "belt", 40.0, **settings)
        for law in (Rational, Same)
    )
    assert len(inside.events) > 5
    np.testing.assert_allclose(outside.events.t, inside.events.t, rtol=0, atol=1e-9)
    np.testing.assert_allclose(outside.z, inside.z, rtol=0, atol=1e-9)


# what kernels are kept by


SCRIPT = """
from lorentz import Lorentz
from stickslip import System, simulate

system = System([[1.0]], 0.1, static=1.3, weakening=Lorentz(3.0))
print(*simulate(system, 0.0, "belt", 20.0).events.t, sep=",")
"""


@pytest.mark.long
def test_kernels_are_compiled_once_for_each_source(tmp_path):
    (tmp_path / "run.py").write_text(SCRIPT)
    (tmp_path / "cache").mkdir(mode=0o700)

    def run(law):
        (tmp_path / "lorentz.py").write_text(law)
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        done = subprocess.run(
            [sys.executable, "run.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        )
        kept = {file: file.stat().st_mtime_ns for file in (tmp_path / "cache").rglob("*.nbc")}
        return done.stdout, kept

    first, kept = run(own_law())
    again, still = run(f"# a comment\n{own_law()}")
    assert again == first
    assert still == kept
    assert len(kept) == 1


FACTOR = 2.0
ROW = np.arange(3.0)


def helper(x):
    return FACTOR * x


@numba.njit
def compiled(x):
    return helper(x)


def with_closure(k):
    return lambda x: k * x


def test_a_digest_is_of_all_that_a_function_uses(monkeypatch):
    def uses(x):
        return helper(x) + ROW[0] + compiled(x) + np.exp(x)

    before = code_digest(uses)
    assert code_digest(uses) == before
    for name, value in (("FACTOR", 3.0), ("ROW", np.arange(4.0)), ("helper", with_closure(1.0))):
        with monkeypatch.context() as patch:
            patch.setitem(globals(), name, value)
            assert code_digest(uses) != before, name
    assert code_digest(uses) == before
    assert code_digest(with_closure(1.0)) == code_digest(with_closure(1.0)) != code_digest(with_closure(2.0))
    assert len({code_digest(uses, None), code_digest(None, uses), before}) == 3


def test_a_function_that_calls_itself_has_a_digest():
    def down(x):
        return down(x - 1) if x > 0 else x

    assert code_digest(down) == code_digest(down)


def test_a_law_that_is_defined_again_is_the_same_and_a_changed_one_another(lorentz):
    made = {"__name__": "elsewhere"}
    exec(own_law(), made)
    assert kind_of(made["Lorentz"]) is kind_of(lorentz)
    exec(own_law().replace("-(2.0 * x * value * value)", "x * value * value * -2.0"), made)
    assert kind_of(made["Lorentz"]) is not kind_of(lorentz)
    assert LAW_OF[kind_of(made["Lorentz"])] is made["Lorentz"]


TABLE = {"a": 1.0}


@dataclass(frozen=True)
class Looked(Rational):
    @staticmethod
    def shape(x):
        return TABLE["a"] / (1.0 + x)

    recurrence = Rational.recurrence


def test_what_may_change_unseen_is_refused():
    with pytest.raises(
        TypeError, match=r"^weakening: Looked: expected functions that use numbers, .*, got \{'a': 1\.0\}; "
    ):
        simulate(System([[1.0]], 0.1, weakening=Looked(1.0)), 0.0, 0.0, 1.0)


class Doubled(Rational):
    @staticmethod
    def shape(x):
        return 2.0 / (1.0 + x)

    recurrence = Rational.recurrence


class Steeper(Rational):
    @staticmethod
    def shape(x):
        return 1.0 / (1.0 + x) ** 2

    recurrence = Rational.recurrence


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (Doubled, r"expected a law with S\(0\) = 1, got 2 from the shape of Doubled"),
        (Steeper, r"expected a `recurrence` of Steeper .*, got 0\.79\d* for S\(0\.15\) = 0\.756143667297;"),
    ],
)
def test_forms_that_are_not_of_one_law_are_refused(law, words):
    with pytest.raises(ValueError, match=rf"^weakening: {words}"):
        simulate(System([[1.0]], 0.1, weakening=law(1.0)), 0.0, 0.0, 1.0)


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
