"""Cases: which system, start, length, engine and settings, from a seed and a number alone."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any, Literal
from unittest.mock import patch

import numpy as np
from scipy.linalg import expm

from stickslip.sim.engines.coulomb import settings as coulomb
from tests.independent import Case, Floats, Ramp
from tests.systems import FAMILIES, TERMS, Rng, any_damping, any_friction, started, with_terms


@dataclass(frozen=True)
class Trial:
    """A case, how long it runs, under which engine, and the seed of what the checks draw."""

    seed: int
    number: int
    family: str
    engine: Literal["coulomb", "sigmoid"]
    case: Case
    t_end: float
    settings: dict[str, Any]
    terms: Collection[str] = ()
    is_by_waves: bool = False  #: whether it is made by waveform relaxation, which by default only large systems are

    @property
    def method(self) -> str:
        return "waves" if self.is_by_waves else self.engine

    def rng(self) -> Rng:
        """For what the checks draw."""
        return np.random.default_rng([self.seed, self.number, 1])

    def words(self) -> str:
        """Lines of Python that run it."""
        case = self.case
        c = np.diag(case.damping) + case.cross if case.cross.any() else case.damping
        k, r, mu, z, w = (x.tolist() for x in (case.stiffness, c, case.friction, case.z0, case.w0))
        settings = "".join(f", {name}={_plain(value)}" for name, value in self.settings.items())
        drive = f", static={case.static.tolist()}" if (case.static > case.friction).any() else ""
        drive += f", weakening={_LAWS[case.falls[0]]}({case.falls[1]!r})" if case.falls else ""
        drive += ", back_slip=False" if case.closed.any() else ""
        drive += f", mass={case.mass.tolist()}" if (case.mass != 1).any() else ""
        push = [_ramp(case.push)] if case.push.values.any() else []
        force = ", ".join([*push, *(f"Harmonic({', '.join(str(x.tolist()) for x in wave)})" for wave in case.waves)])
        drive += f", force=[{force}]" if force else ""
        return (
            f"system = System({k}, {r}, {mu}, {_ramp(case.belt)}{drive})\n"
            f"run = simulate(system, {z}, {w}, {self.t_end!r}, engine={self.engine!r}{settings})"
        )


_LAWS = {"rational": "Rational", "exponential": "Stribeck"}


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _ramp(ramp: Ramp) -> str:
    if (ramp.values == ramp.values[0, 0]).all():
        return repr(float(ramp.values[0, 0]))
    if len(ramp.times) == 1:
        return str(ramp.values[0].tolist())
    return f"Piecewise({ramp.times.tolist()}, {ramp.values.tolist()})"


#: Of the cases, in this order over and over: each engine meets each family.
_ENGINES: tuple[Literal["coulomb", "sigmoid"], ...] = ("coulomb", "coulomb", "sigmoid")
TERMS_OF_WAVES = ("static", "mass")  # the others are run by series
_GROWN = 1e6  # what grows by more can hardly be judged
_TURNS = 1500.0  # time times rate: what the references do in a second


def _size(rng: Rng) -> int:
    sizes = ((1, 2), (2, 3), (3, 4), (4, 7), (7, 13), (13, 21))
    return int(rng.integers(*sizes[rng.choice(len(sizes), p=[0.25, 0.25, 0.15, 0.25, 0.07, 0.03])]))


def _start(rng: Rng, k: Floats, mu: Floats, v: Floats, drag: Floats) -> tuple[Floats, Floats]:
    """`v` is the speed of each belt at the start, `drag` what F is there at z = 0."""
    n = len(mu)
    kinds = ["anywhere", "on the belt", "some on the belt", "at the edge", "at rest"]
    kind = rng.choice(kinds, p=[0.4, 0.2, 0.15, 0.15, 0.1])
    z = rng.normal(size=n) * rng.choice([0.3, 1.0, 3.0])
    w = rng.normal(size=n)
    if kind == "on the belt":
        w = v.copy()
    if kind == "some on the belt":
        w = np.where(rng.random(n) < 0.5, v, w)
    if kind == "at the edge":  # F = R v + K z = +-mu, for all blocks or some
        force = rng.choice([-1.0, 1.0], n) * mu * np.where(rng.random(n) < 0.7, 1.0, rng.random(n))
        z, w = np.linalg.lstsq(k, force - drag, rcond=None)[0], v.copy()
    if kind == "at rest":
        z, w = rng.choice([0.0, 1.0]) * z, np.zeros(n)
    return z, w


def _growth(case: Case, t: float) -> float:
    """How much the motion grows in a time t, all blocks slipping, or each held, or each alone."""
    n = case.n

    def of(free: Floats) -> float:
        m, r = case.mass[free], case.damping - case.drop * case.steepness / 2
        k = case.stiffness[np.ix_(free, free)] / (m[:, None] * case.rate)
        r = (np.diag(r) + case.cross)[np.ix_(free, free)] / m[:, None]
        a = np.block([[np.zeros_like(k), case.rate * np.eye(len(k))], [-k, -r]])
        with np.errstate(all="ignore"):  # what overflows has grown too much
            return float(np.nan_to_num(np.abs(expm(a * t)), nan=np.inf).max())

    every = np.arange(n)
    parts = [every, *([np.delete(every, i) for i in range(n)] if n > 1 else []), *([i] for i in range(n))]
    return max(of(np.asarray(part)) for part in parts)


def longest(case: Case, t: float) -> float:
    """t, or what of it can be judged."""
    t = min(t, _TURNS / case.rate)
    while _growth(case, t) > _GROWN:
        t *= 0.8
    return t


def sort_of(number: int) -> tuple[str, Literal["coulomb", "sigmoid"]]:
    """Family and engine of case `number` of any seed."""
    return list(FAMILIES)[number % len(FAMILIES)], _ENGINES[number // len(FAMILIES) % len(_ENGINES)]


def draw(seed: int, number: int, terms: Collection[str] = TERMS) -> Trial:
    """Case `number` of a seed, with some of the terms."""
    rng = np.random.default_rng([seed, number])
    family, engine = sort_of(number)
    n = _size(rng)
    k = FAMILIES[family](rng, n)
    speeds = [-0.2, 0.2, -1.0, 1.0, 0.0, 30.0, -30.0, rng.normal()]
    v = float(rng.choice(speeds, p=[0.35, 0.12, 0.1, 0.1, 0.1, 0.03, 0.03, 0.17]))
    r, mu = any_damping(rng, n), any_friction(rng, n)
    whole, alike = family == "integers", family == "identical"
    if whole:
        v = float(rng.integers(-2, 3)) / 2
        r, mu = rng.integers(0, 3, n) / 2, rng.choice([0.0, 1.0, 1.0, 2.0], n)
    elif alike:
        r, mu = np.full(n, r[0]), np.full(n, mu[0])
    other = np.random.default_rng([seed, number, 2])  # what else is drawn stays as it is without
    case = with_terms(other, Case.of(k, r, mu, v, 0.0, v), terms, whole, alike)
    at_start = case.belt.line(0.0)[0]
    if whole:
        z = rng.integers(-2, 3, n) * 1.0
        w = np.where(rng.random(n) < 0.6, at_start, rng.integers(-2, 3, n) * 1.0)
    else:
        kinds = rng.integers(0, rng.integers(1, 3), n) if alike else np.arange(n)  # one kind of start, or two
        drag = case.holding(np.zeros(1), np.zeros((1, n)), at_start[None])[0]
        z, w = (x[kinds] if n > 1 else x[:1] for x in _start(rng, k, case.static, at_start, drag))
    case = started(case, z, w)
    lengths = [10 ** rng.uniform(-1, 0.7), rng.uniform(5, 60), 10 ** rng.uniform(1.8, 2.7)]
    length = rng.choice(lengths, p=[0.25, 0.6, 0.15])
    t_end = longest(case, float(length))
    settings: dict[str, Any]
    if engine == "coulomb":
        settings = {"tol": float(rng.choice([1e-10, 1e-6, 1e-8, 1e-12, 1e-13], p=[0.75, 0.07, 0.08, 0.05, 0.05]))}
    else:
        tol = float(10.0 ** -rng.integers(3, 9))
        settings = {"eps": float(10 ** rng.uniform(-5, -1)), "rtol": tol, "atol": tol}
        if rng.random() < 0.3:
            settings["ratio"] = rng.uniform(0.1, 1, n)
        if rng.random() < 0.5:
            settings["thresholds"] = [0.5, 3.0]
    return Trial(seed, number, family, engine, case, t_end, settings, terms)


def by_waves() -> AbstractContextManager[object]:
    """While it lasts, waveform relaxation takes systems of any size at any tolerance; by default only large ones."""
    sizes = {
        "SIZE_OF_WAVES": 1,
        "SHORT": 0.0,
        "MANY_ENTRIES": 0,
        "OF_JUMPS": (0.0, 0.0, 1e-10),
        "MOST_MEMORY": np.inf,
    }
    return patch.multiple(coulomb, **sizes)


def draw_for_waves(seed: int, number: int, terms: Collection[str] = TERMS) -> Trial:
    """Case `number` of a seed as waveform relaxation takes it: with those of the terms, and at a loose tolerance."""
    trial = draw(seed, number, [term for term in terms if term in TERMS_OF_WAVES])
    tol = float(10.0 ** -np.random.default_rng([seed, number, 5]).uniform(3, 7))
    return replace(trial, engine="coulomb", settings={"tol": tol}, is_by_waves=True)
