"""Kinetic friction that falls as a block slips faster on its belt.

    mu(u) = far + (near - far) shape(steepness |u|),    u = w - v

near is the kinetic friction of a block that begins to slip, far that of one whose slip has no bound; shape falls from
shape(0) = 1 to 0. A law is a subclass of `Weakening`, and its shape in the engines' own words: a formula in
`stickslip.sim.engines.sigmoid.friction`, a recurrence in `stickslip.sim.engines.coulomb.taylor`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from stickslip.sim.numerics.arguments import Floats, number

Known = TypeVar("Known")


class Weakening(ABC):
    """How kinetic friction falls with the speed of slip."""

    @property
    @abstractmethod
    def steepness(self) -> float:
        """What the speed is multiplied by in the shape: the steepest fall is (near - far) steepness, at no slip."""

    @abstractmethod
    def ends(self, friction: Floats, static: Floats) -> tuple[Floats, Floats]:
        """near and far, shape (n,) each, from the `friction` and `static` of a `System`."""

    @abstractmethod
    def shape(self, x: Floats) -> Floats:
        """Of x >= 0, any shape."""


@dataclass(frozen=True)
class Rational(Weakening):
    """mu / (1 + rate |u|): the law of Carlson and Langer, Phys. Rev. A 40 (1989) 6470.

    Static friction is what it is without weakening: a block that leaves stick drops to mu at once, if that is less.
    Theirs is static 1, friction 1 - sigma, rate 2 alpha / (1 - sigma), without back slip.

    Raises
    ------
    TypeError, ValueError
        If the rate is no number > 0.
    """

    rate: float

    def __post_init__(self) -> None:
        number("rate", self.rate, above=0)

    @property
    def steepness(self) -> float:
        return self.rate

    def ends(self, friction: Floats, static: Floats) -> tuple[Floats, Floats]:
        return friction, np.zeros_like(friction)

    def shape(self, x: Floats) -> Floats:
        return np.asarray(1.0 / (1.0 + x))


@dataclass(frozen=True)
class Stribeck(Weakening):
    """mu + (static - mu) exp(-|u| / speed): from the static friction, without a jump, to the kinetic.

    Where the static friction is the kinetic, nothing is left of it.

    Raises
    ------
    TypeError, ValueError
        If the speed is no number > 0.
    """

    speed: float

    def __post_init__(self) -> None:
        number("speed", self.speed, above=0)

    @property
    def steepness(self) -> float:
        return 1.0 / self.speed

    def ends(self, friction: Floats, static: Floats) -> tuple[Floats, Floats]:
        return static, friction

    def shape(self, x: Floats) -> Floats:
        return np.asarray(np.exp(-x))


def registered(laws: Mapping[type[Weakening], Known], weakening: Weakening, engine: str) -> Known:
    """What an engine has registered for a law; TypeError if that is nothing, as for a subclass."""
    if type(weakening) not in laws:
        known = " or ".join(law.__name__ for law in laws)
        raise TypeError(f"weakening: expected {known}, all that engine={engine!r} knows, got {weakening!r}")
    return laws[type(weakening)]


def require_static(law: type, static: object) -> None:
    """ValueError if a law falls from the static friction, and none is given."""
    if issubclass(law, Stribeck) and static is None:
        raise ValueError(
            "static: expected with the law of Stribeck, which falls from the static friction to the kinetic, found"
            " nothing; add e.g. `static = 1.3`"
        )


def hidden_term(ratio: ArrayLike) -> Floats:
    """The c with which s(lambda) = lambda + c lambda (1 - lambda^2) has the largest value `ratio`, of any shape."""
    r = np.asarray(ratio, dtype=np.float64)
    return np.asarray(np.where(r == 1.0, 0.0, 3 * r * np.cos(np.arccos(-1 / r) / 3) - 1))


def turning_point(c: ArrayLike) -> Floats:
    """The lambda at which that s is largest, by its c, of any shape; 1 without a hidden term."""
    c = np.asarray(c, dtype=np.float64)
    return np.sqrt(np.divide(1 + c, 3 * c, out=np.ones_like(c), where=c > 0.5))
