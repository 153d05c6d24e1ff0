"""Random systems for any test that needs no special one; the fuzz draws its own, wider ones, from the same parts."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import csc_array

from stickslip.sim import Harmonic, Piecewise, Rational, Stribeck, System
from tests.independent import Case, Floats, Ramp

Rng = np.random.Generator
Range = tuple[float, float]


def draw_case(
    rng: Rng,
    n: int | tuple[int, int] = (1, 6),
    family: str | None = None,
    *,
    damping: Range | None = None,
    friction: Range | None = None,
    belt_speed: Sequence[float] = (-0.2,),
    terms: Collection[str] = (),
    on_belt: float = 0.0,
) -> Case:
    """A random system with a random start, z and w normal.

    Parameters
    ----------
    n : int, or the least and the most
    family : str, optional
        One of `FAMILIES`; by default any.
    damping, friction : pair of float, optional
        Uniform in this range; by default as wide as the fuzz draws them, which includes zero.
    belt_speed : sequence of float
        One of these.
    terms : collection of str
        Of `TERMS`, each in half of the systems; weakening in those of at most 6 blocks.
    on_belt : float
        Probability that a block starts at the speed of its belt.
    """
    least, most = (n, n) if isinstance(n, int) else n
    n = int(rng.integers(least, most + 1))
    k = FAMILIES[family or rng.choice(list(FAMILIES))](rng, n)
    v = float(rng.choice(belt_speed))
    r = any_damping(rng, n) if damping is None else rng.uniform(*damping, n)
    mu = any_friction(rng, n) if friction is None else rng.uniform(*friction, n)
    case = with_terms(rng, Case.of(k, r, mu, v, 0.0, v), terms)
    z, w = rng.normal(size=(2, n))
    return started(case, z, np.where(rng.random(n) < on_belt, case.belt.line(0.0)[0], w))


def draw_run(rng: Rng, *args: Any, cross: float = 0.0, **options: Any) -> tuple[System, Floats, Floats]:
    """The system and the start, z and w, of `draw_case`; with `cross`, also cross damping, normal with this scale."""
    case = draw_case(rng, *args, **options)
    system = made(case)
    if cross:
        full = cross * rng.normal(size=(case.n, case.n))
        np.fill_diagonal(full, case.damping)
        system = system.changed(damping=full)
    return system, case.z0, case.w0


def started(case: Case, z: Floats, w: Floats) -> Case:
    """The case with another start; blocks that may not get ahead of their belts start at most as fast."""
    v = case.belt.line(0.0)[0]
    return replace(case, z0=z, w0=np.where(case.closed * (w - v) > 0, v, w))


def made(case: Case, sparse: bool = False) -> System:
    """The system of a case."""
    k = csc_array(case.stiffness) if sparse else case.stiffness
    force: Any = [Piecewise(case.push.times, case.push.values), *(Harmonic(*wave) for wave in case.waves)]
    laws = {"rational": Rational, "exponential": Stribeck}
    c: Any = np.diag(case.damping) + case.cross if case.cross.any() else case.damping
    return System(
        k,
        csc_array(c) if sparse and c.ndim == 2 else c,
        case.friction,
        _drive(case.belt),
        case.static,
        mass=case.mass,
        force=force,
        weakening=laws[case.falls[0]](case.falls[1]) if case.falls else None,
        back_slip=not case.closed.any(),
    )


def _drive(ramp: Ramp) -> Floats | Piecewise:
    return ramp.values[0] if len(ramp.times) == 1 else Piecewise(ramp.times, ramp.values)


# K


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


# R, mu and the terms


def any_damping(rng: Rng, n: int) -> Floats:
    """R of all kinds: none, of some blocks, as in the paper, over many scales, of either sign."""
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


def any_friction(rng: Rng, n: int) -> Floats:
    """mu of all kinds: equal, different, of some blocks, none."""
    kind = rng.choice(["equal", "mixed", "some", "none"], p=[0.45, 0.3, 0.2, 0.05])
    if kind == "equal":
        return np.full(n, rng.choice([1.0, rng.uniform(0.1, 3)]))
    return rng.uniform(0, 2, n) * (rng.random(n) < {"mixed": 1.0, "some": 0.6, "none": 0.0}[kind])


def _static(rng: Rng, mu: Floats) -> Floats:
    """Static friction above the kinetic, of all blocks or some; by a ratio, but where there is no kinetic."""
    above = rng.choice([0.25, 0.01, 1.0, rng.uniform(0.0, 2.0)], len(mu)) * (rng.random(len(mu)) < 0.8)
    return mu * (1 + above)


#: What is drawn beside eq. (10), each in half of the cases: static friction above the kinetic, forces, belts of
#: different speeds or such as change, masses, friction that falls with speed, no back slip, damping between blocks.
TERMS = ("static", "force", "belt", "mass", "weakening", "back_slip", "cross")
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


def _coupled(rng: Rng, case: Case, whole: bool, alike: bool) -> Case:
    """With damping between blocks: N in proportion to K, of dashpots, or of any kind, of some pairs or of all."""
    n, size = case.n, rng.choice([0.1, 0.5, 2.0])
    kind = rng.choice(["proportional", "dashpots", "any"])
    tied = rng.random((n, n)) < rng.choice([0.4, 1.0])
    if whole or alike:
        cross = np.full((n, n), 0.5)
    elif kind == "proportional":
        cross = size * case.stiffness / max(np.abs(case.stiffness).max(), 1.0)
    else:
        cross = size * rng.normal(size=(n, n)) * tied
    if kind == "dashpots":
        springs = np.abs(np.triu(cross, 1))
        cross = -(springs + springs.T)
        case = replace(case, damping=case.damping - cross.sum(axis=1))
    return replace(case, cross=cross - np.diag(np.diag(cross)))


def with_terms(rng: Rng, case: Case, terms: Collection[str], whole: bool = False, alike: bool = False) -> Case:
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
    if own := chosen.get("cross"):
        case = _coupled(own, case, whole, alike)
    return case
