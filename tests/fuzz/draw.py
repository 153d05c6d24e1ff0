"""Cases: which system, start, length, engine and settings, from a seed and a number alone."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.linalg import expm

from tests.independent import Case, Floats, Ramp

Rng = np.random.Generator


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

    def rng(self) -> Rng:
        """For what the checks draw."""
        return np.random.default_rng([self.seed, self.number, 1])

    def words(self) -> str:
        """Lines of Python that run it."""
        case = self.case
        k, r, mu, z, w = (x.tolist() for x in (case.stiffness, case.damping, case.friction, case.z0, case.w0))
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


def _grounded(springs: Floats, ground: Floats) -> Floats:
    """Springs between blocks (symmetric) and to the ground, eq. (6)."""
    return np.diag(ground + springs.sum(axis=1)) - springs


def _chain(rng: Rng, n: int) -> Floats:
    springs = np.zeros((n, n))
    for i in range(n - 1):
        springs[i, i + 1] = springs[i + 1, i] = rng.choice([1.0, rng.uniform(0.2, 3)])
    ground = rng.uniform(0, 1, n) if rng.random() < 0.5 else np.eye(n)[0]
    return _grounded(springs, ground)


def _stiff(rng: Rng, n: int) -> Floats:
    springs = np.triu(10 ** rng.uniform(2, 3, (n, n)) * (rng.random((n, n)) < 0.6), 1)
    ground = np.where(rng.random(n) < 0.5, 10 ** rng.uniform(2, 3, n), rng.uniform(0, 1, n))
    return _grounded(springs + springs.T, ground)


def _antisymmetric(rng: Rng, n: int) -> Floats:
    u = rng.uniform(-1, 1, (n, n)) * rng.choice([0.2, 1.0, 3.0])
    return (u - u.T) / 2 + np.diag(np.abs(np.diag(u)))


def _symmetric(rng: Rng, n: int) -> Floats:
    a = rng.normal(size=(n, n))
    return a @ a.T / n if rng.random() < 0.7 else (a + a.T) / 2


def _singular(rng: Rng, n: int) -> Floats:
    rank = int(rng.integers(0, n)) if n > 1 else 0
    left = rng.normal(size=(n, rank))
    return left @ (left.T if rng.random() < 0.5 else rng.normal(size=(rank, n)))


def _nilpotent(rng: Rng, n: int) -> Floats:
    order = rng.permutation(n)
    return np.triu(rng.normal(size=(n, n)), 1)[np.ix_(order, order)]


def _sparse(rng: Rng, n: int) -> Floats:
    k = rng.normal(size=(n, n)) * (rng.random((n, n)) < 0.3)
    return k + np.diag(rng.choice([0.0, 1.0, 2.0], n))


def _identical(rng: Rng, n: int) -> Floats:
    a, b = rng.uniform(0.1, 2), rng.uniform(-0.5, 0.5)
    return a * np.eye(n) + b * np.ones((n, n))


def _integers(rng: Rng, n: int) -> Floats:
    k = rng.integers(-1, 2, (n, n)) * 1.0
    k = np.triu(k) + np.triu(k, 1).T if rng.random() < 0.5 else k
    return k + np.diag(rng.integers(0, 4, n) * 1.0)


def _full(rng: Rng, n: int) -> Floats:
    return rng.normal(size=(n, n)) + rng.choice([0.0, 2.0]) * np.eye(n)


FAMILIES: dict[str, Callable[[Rng, int], Floats]] = {
    "antisymmetric": _antisymmetric,
    "chain": _chain,
    "full": _full,
    "identical": _identical,
    "integers": _integers,
    "nilpotent": _nilpotent,
    "singular": _singular,
    "sparse": _sparse,
    "stiff": _stiff,
    "symmetric": _symmetric,
}
#: Of the cases, in this order over and over: each engine meets each family.
_ENGINES: tuple[Literal["coulomb", "sigmoid"], ...] = ("coulomb", "coulomb", "sigmoid")
_GROWN = 1e6  # what grows by more can hardly be judged
_TURNS = 1500.0  # time times rate: what the references do in a second


def _size(rng: Rng) -> int:
    sizes = ((1, 2), (2, 3), (3, 4), (4, 7), (7, 13), (13, 21))
    return int(rng.integers(*sizes[rng.choice(len(sizes), p=[0.25, 0.25, 0.15, 0.25, 0.07, 0.03])]))


def _damping(rng: Rng, n: int) -> Floats:
    kind = rng.choice(["none", "weak", "paper", "wide", "negative", "some"], p=[0.2, 0.25, 0.2, 0.15, 0.08, 0.12])
    if kind == "none":
        return np.zeros(n)
    if kind == "paper":
        return rng.uniform(3.5, 7, n)
    if kind == "wide":
        return 10 ** rng.uniform(-8, np.log10(50), n)
    if kind == "negative":
        return np.where(rng.random(n) < 0.5, -(10 ** rng.uniform(-2, -0.5, n)), rng.uniform(0, 1, n))
    return rng.uniform(0, 1, n) * (rng.random(n) < (0.5 if kind == "some" else 1.0))


def _friction(rng: Rng, n: int) -> Floats:
    kind = rng.choice(["equal", "mixed", "some", "none"], p=[0.45, 0.3, 0.2, 0.05])
    if kind == "equal":
        return np.full(n, rng.choice([1.0, rng.uniform(0.1, 3)]))
    return rng.uniform(0, 2, n) * (rng.random(n) < {"mixed": 1.0, "some": 0.6, "none": 0.0}[kind])


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
        k, r = case.stiffness[np.ix_(free, free)] / (m[:, None] * case.rate), np.diag(r[free] / m)
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


def _static(rng: Rng, mu: Floats) -> Floats:
    """Static friction above the kinetic, of all blocks or some; by a ratio, but where there is no kinetic."""
    above = rng.choice([0.25, 0.01, 1.0, rng.uniform(0.0, 2.0)], len(mu)) * (rng.random(len(mu)) < 0.8)
    return mu * (1 + above)


#: What is drawn beside eq. (10), each in half of the cases: static friction above the kinetic, forces, belts of
#: different speeds or such as change, masses, friction that falls with speed, no back slip.
TERMS = ("static", "force", "belt", "mass", "weakening", "back_slip")
_CURVED_MAX = 6  # blocks; more are slow to follow where the motion is not linear
_LATEST = 60.0  # of a knot


def _ramps(rng: Rng, n: int, size: Callable[[tuple[int, int]], Floats], whole: bool) -> Ramp:
    """By block or for all blocks: constant or piecewise linear; knots at whole times or anywhere."""
    k = int(rng.choice([1, 2, 3, 6]))
    latest = _LATEST if rng.random() < 0.3 else 6.0
    times = rng.choice(np.arange(0.0, 12.0), k, replace=False) if whole else rng.uniform(0, latest, k)
    values = size((k, n)) if rng.random() < 0.6 else size((k, 1)).repeat(n, axis=1)
    if k > 2 and rng.random() < 0.4:
        values[1] = values[0]
    return Ramp(np.sort(times), values)


def _with_terms(rng: Rng, case: Case, terms: Collection[str], whole: bool, alike: bool) -> Case:
    """With the terms, each by a coin; in whole or half numbers, or alike for all blocks."""
    n = case.n
    draws = dict(zip(TERMS, rng.spawn(len(TERMS)), strict=True))
    chosen = {term: own for term, own in draws.items() if own.random() < 0.5 and term in terms}
    if own := chosen.get("static"):
        halves = own.integers(0, 2, n) / 2 * (case.friction > 0)
        above = _static(own, case.friction[:1]).repeat(n) if alike else _static(own, case.friction)
        case = replace(case, static=case.friction + halves if whole else above)
    if own := chosen.get("mass"):
        mass = own.choice([0.5, 1.0, 2.0, 4.0], n) if whole else 10 ** own.uniform(-1.5, 1.5, n)
        case = replace(case, mass=mass[:1].repeat(n) if alike else mass)
    if own := chosen.get("belt"):
        v = case.belt.values[0, 0]
        size = own.choice([abs(v), 1.0, 0.2])

        def speeds(shape: tuple[int, int]) -> Floats:
            if whole:
                return own.integers(-2, 3, shape) / 2
            return np.where(own.random(shape) < 0.3, v, size * own.normal(size=shape))

        belt = _ramps(own, n, speeds, whole)
        case = replace(case, belt=Ramp(belt.times, belt.values[:, :1].repeat(n, axis=1)) if alike else belt)
    if own := chosen.get("force"):
        size = own.choice([0.3, 1.0, 3.0])

        def pushes(shape: tuple[int, int]) -> Floats:
            return (
                own.integers(-1, 2, shape) * 1.0
                if whole
                else size * own.normal(size=shape) * (own.random(shape) < 0.7)
            )

        push = _ramps(own, n, pushes, whole) if own.random() < 0.6 else Ramp.of(0.0, n)
        count = own.choice([0, 1, 2]) if push.values.any() else 1
        waves = np.stack(
            [
                pushes((count, n)) if own.random() < 0.6 else pushes((count, 1)).repeat(n, axis=1),
                (own.choice([0.5, 1.0, 2.0], (count, 1)) if whole else 10 ** own.uniform(-1.5, 1, (count, 1))).repeat(
                    n, axis=1
                ),
                own.choice([0.0, np.pi / 2, own.uniform(0, 7)], (count, 1)).repeat(n, axis=1),
            ],
            axis=1,
        )
        if count and not whole and own.random() < 0.3:
            waves[:, 1] *= own.uniform(0.5, 1.0, (count, n))
        if alike:
            push, waves = Ramp(push.times, push.values[:, :1].repeat(n, axis=1)), waves[:, :, :1].repeat(n, axis=2)
        case = replace(case, push=push, waves=waves)
    speeds_of_slip = [0.5, 1.0, 2.0] if whole else [0.1, 1.0, 3.0]
    if (own := chosen.get("weakening")) and case.n <= _CURVED_MAX:
        case = replace(case, falls=(own.choice(["rational", "exponential"]), float(own.choice(speeds_of_slip))))
    if "back_slip" in chosen and (case.near > 0).all() and (case.belt.values * case.belt.values[0] > 0).all():
        case = replace(case, closed=np.sign(case.belt.values[0]))
    return case


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
    r, mu = _damping(rng, n), _friction(rng, n)
    whole, alike = family == "integers", family == "identical"
    if whole:
        v = float(rng.integers(-2, 3)) / 2
        r, mu = rng.integers(0, 3, n) / 2, rng.choice([0.0, 1.0, 1.0, 2.0], n)
    elif alike:
        r, mu = np.full(n, r[0]), np.full(n, mu[0])
    other = np.random.default_rng([seed, number, 2])  # what else is drawn stays as it is without
    case = _with_terms(other, Case.of(k, r, mu, v, 0.0, v), terms, whole, alike)
    at_start = case.belt.line(0.0)[0]
    if whole:
        z = rng.integers(-2, 3, n) * 1.0
        w = np.where(rng.random(n) < 0.6, at_start, rng.integers(-2, 3, n) * 1.0)
    else:
        kinds = rng.integers(0, rng.integers(1, 3), n) if alike else np.arange(n)  # one kind of start, or two
        drag = case.holding(np.zeros(1), np.zeros((1, n)))[0]
        z, w = (x[kinds] if n > 1 else x[:1] for x in _start(rng, k, case.static, at_start, drag))
    case = replace(case, z0=z, w0=np.where(case.closed * (w - at_start) > 0, at_start, w))
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
