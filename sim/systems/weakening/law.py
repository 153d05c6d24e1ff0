"""What a friction law is: kinetic friction as a function of the speed at which a block slips on its belt.

    mu(u) = far + (near - far) S(x),    x = steepness |u|,    u = w - v

near is the kinetic friction of a block that begins to slip, S(0) = 1. Where S tends to 0, far is that at the limit of
fast slip. Friction may fall and rise, but not below zero.

A law is a subclass of `Weakening`. Engines know S as data, by its `Pieces`, so that a law of the user's compiles
nothing. They know laws of the package by code, which is faster: there |S'| and |S''| are at most one, and poles of S
are about 1 + x or more away from x. A law that scenes know by name has a file here and a line in `LAWS`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import namedtuple
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from stickslip.sim.numerics.arguments import Floats, apart, number
from stickslip.sim.systems.weakening.pieces import FASTEST, Pieces, sampled

#: Of S(0), and of kinetic friction over that of a block that begins to slip.
_ROUNDING, _ROUNDED = 1e-14, 1e-12


Law = TypeVar("Law", bound="Weakening")


def parameter(words: str = "", column: str = "", example: float = 1.0, *, power: int) -> Any:
    """A field of a law, a number > 0: its words in a scene's keys and in a dataset's columns, and an example.

    `power` is that of a speed in its unit: 1 for a speed, -1 for what multiplies one, 0 for a plain number. The laws
    share a table of a scene, and its keys say which of them it means: no two have a parameter of one name.
    """
    return field(metadata={"said": {"words": words, "column": column, "example": example}, "power": power})


@dataclass(frozen=True)
class Weakening(ABC):
    """How kinetic friction falls with the speed of slip. A subclass is a frozen dataclass of `parameter` fields.

    Attributes
    ----------
    name, formula : str
        Its name in scenes, and kinetic friction in their words; of a law of `LAWS`.
    falls_from_static : bool
        Whether it needs a static friction to fall from.
    on_lanes : function
        Of a law that is `known_by_code`, for the sigmoid engine: S and its derivative, of a `Lane` x >= 0. It imports
        from ``stickslip.sim.numerics.lanes`` inside, since systems load no numba.
    recurrence : function
        The same for the exact engine: ``recurrence(k, z, x0, scale, series)`` puts the Taylor coefficients S_k of all
        blocks, k >= 1, into ``series[0, k]``, shape (n,). x has the coefficients x_0 = `x0` and x_j = `scale` (j + 1)
        z_{j+1}; `x0` and `scale` have shape (n,). Where S_0 is zero, all S_k must be. Loops over orders are `while`
        loops: inside a `for` loop LLVM does not vectorise the loop over blocks, which then takes twice as long.
    is_entire : bool
        Whether S has no pole at all, as exp(-x): its terms may then rise before they fall.
    """

    name: ClassVar[str]
    formula: ClassVar[str]
    falls_from_static: ClassVar[bool] = False
    on_lanes: ClassVar[Any]
    recurrence: ClassVar[Any]
    is_entire: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for entry in fields(self):
            number(entry.name, getattr(self, entry.name), above=0)

    @property
    @abstractmethod
    def steepness(self) -> float:
        """The factor of the speed of slip in x."""

    @cached_property
    def pieces(self) -> Pieces:
        """S by polynomials.

        Raises `ValueError` if S(0) is not 1, or S is not finite, jumps, or bends too often.
        """
        law = type(self)
        start = float(_values(law, np.zeros(1))[0])
        if not abs(start - 1.0) <= _ROUNDING:
            got = f"{apart(start, 1.0)[0]} from the shape of {law.__name__}"
            raise ValueError(f"weakening: expected a law with S(0) = 1, got {got}")
        return sampled(partial(_values, law), FASTEST, f"weakening: {law.__name__}")

    @cached_property
    def is_data(self) -> bool:
        """Whether engines know it by its `pieces`."""
        return type(self) not in LAW_OF.values()

    @cached_property
    def steepest(self) -> float:
        """A bound of |dS / du|."""
        return self.steepness * (self.pieces.steepest if self.is_data else 1.0)

    @cached_property
    def largest(self) -> float:
        """A bound of S."""
        return self.pieces.range[1] if self.is_data else 1.0

    def bends(self, low: Floats, high: Floats) -> Floats:
        """In how many parts, at least, x from `low` to `high` is to be divided so that quadrature resolves S."""
        if self.is_data:
            start = self.pieces.start
            length = np.append(np.diff(start), np.inf)
            first, last = (length[np.searchsorted(start, x, side="right") - 1] for x in (low, high))
            return np.asarray((high - low) / np.maximum(first, last))
        return np.asarray((high - low) / (1.0 + low))

    @abstractmethod
    def ends(self, friction: Floats, static: Floats) -> tuple[Floats, Floats]:
        """near and far, shape (n,) each, from the `friction` and `static` of a `System`."""

    def checked_ends(self, friction: Floats, static: Floats) -> tuple[Floats, Floats]:
        """What `ends` gives; TypeError or ValueError if it is no friction of these blocks, or the steepness none."""
        number(f"steepness of {type(self).__name__}", self.steepness, above=0)
        ends = self.ends(friction, static)
        if not isinstance(ends, tuple) or [np.shape(end) for end in ends] != [friction.shape] * 2:
            raise TypeError(
                f"weakening: expected two arrays of shape {friction.shape}, near and far, from the ends of"
                f" {type(self).__name__}, got {ends!r}"
            )
        for end in ends:
            if not (np.isfinite(end) & (end >= 0.0)).all():
                block = int(np.argmin(np.where(np.isfinite(end), end, -np.inf)))
                raise ValueError(
                    f"weakening: expected kinetic friction of at least 0 from the ends of {type(self).__name__}, got"
                    f" {end[block]:g} at block {block}"
                )
        return ends

    @staticmethod
    @abstractmethod
    def shape(x: Any) -> Any:
        """S of x >= 0: an array of any shape or, in the exact engine's kernels, a number.

        `System.kinetic_slope` takes it at complex x, whose imaginary part is tiny.
        """

    @classmethod
    def parameters(cls) -> dict[str, dict[str, Any]]:
        """Words, column and example of each parameter, by name."""
        return {entry.name: entry.metadata["said"] for entry in fields(cls)}

    def in_units(self, speed: float) -> Self:
        """The same law, where speeds are measured in units of `speed`; TypeError if its powers do not say how."""
        powers = {entry.name: entry.metadata.get("power", 0) for entry in fields(self)}
        law = replace(self, **{name: getattr(self, name) / speed**power for name, power in powers.items()})
        if not math.isclose(law.steepness, self.steepness * speed, rel_tol=1e-9):
            raise TypeError(
                f"weakening: expected powers of a speed that make the steepness one over a speed, got {powers} of"
                f" {type(self).__name__}; correct them, each in a field `rate: float = parameter(power=-1)`"
            )
        return law

    def require_friction(self, near: Floats, far: Floats) -> None:
        """ValueError if S takes the friction of a block below zero."""
        if not self.is_data:
            return
        least, _, x = self.pieces.range
        below = far + (near - far) * least
        if (below < -_ROUNDED * near).any():
            block = int(np.argmin(below))
            raise ValueError(
                f"weakening: expected kinetic friction of at least 0, got {below[block]:.3g} for block {block} at the"
                f" speed {x / self.steepness:.3g} from {self}; raise its shape"
            )

    @classmethod
    def require_static(cls, static: object) -> None:
        """ValueError if the law falls from the static friction, and none is given."""
        if cls.falls_from_static and static is None:
            raise ValueError(
                f"static: expected with the law of {cls.__name__}, which falls from the static friction to the"
                " kinetic, found nothing; add e.g. `static = 1.3`"
            )


#: The laws that kernels know by code, each by the empty named tuple that stands for it there.
LAW_OF: dict[type[Any], type[Weakening]] = {}


def known_by_code(law: type[Law]) -> type[Law]:
    """Let kernels know a law of the package by its `on_lanes`, `recurrence` and `shape`, and not by its pieces."""
    kind = globals()[law.__name__] = namedtuple(law.__name__, (), module=__name__)  # where a kept kernel finds it
    LAW_OF[kind] = law
    return law


def _values(law: type[Weakening], x: Floats) -> Floats:
    """S of some x; TypeError if the shape gives no real number for each, or raises."""
    name = f"weakening: shape of {law.__name__}"
    try:
        with np.errstate(all="ignore"):
            y = np.asarray(law.shape(x))
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise TypeError(
            f"{name}: expected a number for each x, got {type(error).__name__}: {error}; correct it"
        ) from error
    if y.shape != x.shape or y.dtype.kind not in "fiu":
        raise TypeError(f"{name}: expected a real number for each of {x.size} x, got {y.dtype} of shape {y.shape}")
    return y.astype(np.float64)
