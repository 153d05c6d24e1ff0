"""What a weakening law is: kinetic friction that falls as a block slips faster on its belt.

    mu(u) = far + (near - far) S(x),    x = steepness |u|,    u = w - v

near is the kinetic friction of a block that begins to slip, far that at the limit of fast slip; the shape S falls
from S(0) = 1 to 0. S and its first two derivatives are at most about one, and the poles of S are about 1 + x or more
away from x: the quadrature of `stickslip.sim.energy` and the longest steps of the exact engine depend on it.

A law is a subclass of `Weakening`. Its forms are plain functions that the engines compile with their kernels, and an
engine refuses a law that lacks the form it needs. A law that scenes know by name has a file here and a line in
`LAWS`. One from elsewhere is passed to `System`; its kernels are kept by a digest of its forms and what these use.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import namedtuple
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property
from typing import Any, ClassVar, Self

import numpy as np

from stickslip.sim.kernels.digest import code_digest
from stickslip.sim.numerics.arguments import Floats, apart, number
from stickslip.sim.systems.weakening.pieces import FASTEST, Pieces, sampled

#: Of S(0), and of kinetic friction over that of a block that begins to slip.
_ROUNDING, _ROUNDED = 1e-14, 1e-12


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
    on_lanes : function or None
        For the sigmoid engine: S and its derivative, of a `Lane` x >= 0. It imports from
        ``stickslip.sim.numerics.lanes`` inside, since systems load no numba.
    recurrence : function or None
        For the exact engine: ``recurrence(k, z, x0, scale, series)`` puts the Taylor coefficients S_k of all blocks,
        k >= 1, into ``series[0, k]``. `series` has shape (n_series, orders, n); the law may keep others behind the
        first. x has the coefficients x_0 = `x0` and x_j = `scale` (j + 1) z_{j+1}; `x0` and `scale` have shape (n,).
        Where S_0 is zero, all S_k must be. Loops over orders are `while` loops: inside a `for` loop LLVM does not
        vectorise the loop over blocks, which then takes twice as long.
    n_series : int
        The number of series that `recurrence` keeps.
    is_entire : bool
        Whether S has no pole at all, as exp(-x): its terms may then rise before they fall.
    """

    name: ClassVar[str]
    formula: ClassVar[str]
    falls_from_static: ClassVar[bool] = False
    on_lanes: ClassVar[Any] = None
    recurrence: ClassVar[Any] = None
    n_series: ClassVar[int] = 1
    is_entire: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        if "shape" in vars(cls):  # an inherited form is that of another shape
            for form in {"on_lanes", "recurrence"} - vars(cls).keys():
                setattr(cls, form, None)

    def __post_init__(self) -> None:
        for one in fields(self):
            number(one.name, getattr(self, one.name), above=0)

    @property
    @abstractmethod
    def steepness(self) -> float:
        """The factor of the speed of slip in x."""

    @cached_property
    def pieces(self) -> Pieces:
        """S by polynomials, for an engine that lacks a form of its own.

        Raises
        ------
        ValueError
            If S(0) is not 1, or S is not finite, jumps, or bends too often.
        """
        law = type(self)
        _require_start(law)
        return sampled(self.shape, FASTEST, f"weakening: {law.__name__}")

    @cached_property
    def is_data(self) -> bool:
        """Whether an engine knows it by its `pieces`."""
        return type(self).on_lanes is None or type(self).recurrence is None

    @cached_property
    def steepest(self) -> float:
        """A bound of |dS / du|."""
        return self.steepness * (self.pieces.steepest if self.is_data else 1.0)

    @cached_property
    def largest(self) -> float:
        """A bound of S."""
        return self.pieces.range[1] if self.is_data else 1.0

    def bends(self, low: Floats, high: Floats) -> Floats:
        """In how many parts, at least, x from `low` to `high` is to be divided so that S is smooth on each."""
        if self.is_data:
            first, last = (np.searchsorted(self.pieces.start, x) for x in (low, high))
            return np.asarray(last - first, dtype=np.float64) + 1.0
        return np.asarray((high - low) / (1.0 + low))

    @abstractmethod
    def ends(self, friction: Floats, static: Floats) -> tuple[Floats, Floats]:
        """near and far, shape (n,) each, from the `friction` and `static` of a `System`."""

    @staticmethod
    @abstractmethod
    def shape(x: Any) -> Any:
        """S of x >= 0: an array of any shape or, in the exact engine's kernels, a number.

        `System.kinetic_slope` takes it at complex x, whose imaginary part is tiny.
        """

    @classmethod
    def parameters(cls) -> dict[str, dict[str, Any]]:
        """Words, column and example of each parameter, by name."""
        return {one.name: one.metadata["said"] for one in fields(cls)}

    def in_units(self, speed: float) -> Self:
        """The same law, where speeds are measured in units of `speed`; TypeError if its powers do not say how."""
        powers = {one.name: one.metadata.get("power", 0) for one in fields(self)}
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


#: The laws for which kernels are compiled, by the types that stand for them there.
LAW_OF: dict[type[Any], type[Weakening]] = {}


@cache
def kind_of(law: type[Weakening]) -> type[Any]:
    """The type, an empty named tuple, that stands for a law in kernels that are compiled for it alone.

    Its name, which is part of the key of a kept kernel, has a digest of the law's forms; and a kernel that is loaded
    finds it here.

    Raises
    ------
    TypeError
        If a form uses something of which it cannot be said whether it changes.
    ValueError
        If S(0) is not 1, or `recurrence` does not give the series of `shape`.
    """
    _check_shape(law)
    try:
        name = f"{law.__name__}_{code_digest(law.shape, law.on_lanes, law.recurrence)}"
    except TypeError as error:
        raise TypeError(f"weakening: {law.__name__}: {error}; give the forms what they use as a number") from None
    if name not in globals():  # else the law is defined a second time, as in a notebook
        kind = globals()[name] = namedtuple(name, (), module=__name__)
        LAW_OF[kind] = law
    return globals()[name]


def _require_start(law: type[Weakening]) -> None:
    """ValueError if S(0) is not 1."""
    start = float(np.asarray(law.shape(np.zeros(1)))[0])
    if abs(start - 1.0) > _ROUNDING:
        raise ValueError(
            f"weakening: expected a law with S(0) = 1, got {apart(start, 1.0)[0]} from the shape of {law.__name__}"
        )


def _check_shape(law: type[Weakening]) -> None:
    """ValueError if a law's shape is none, or the sum of its series is not the shape at a nearby x."""
    _require_start(law)
    if law.recurrence is None:
        return
    x0, t, orders = np.array([0.1, 0.5, 1.0, 3.0]), 0.05, 14
    z, series = np.zeros((orders + 1, len(x0))), np.full((law.n_series, orders, len(x0)), np.nan)
    z[2], series[0, 0] = 0.5, law.shape(x0)  # x(t) = x0 + t
    for k in range(1, orders):
        law.recurrence(k, z, x0, np.ones(len(x0)), series)
    found, expected = np.polynomial.polynomial.polyval(t, series[0]), law.shape(x0 + t)
    if not np.allclose(found, expected, rtol=1e-9, atol=1e-12):
        k = int(np.argmax(~np.isclose(found, expected, rtol=1e-9, atol=1e-12)))
        raise ValueError(
            f"weakening: expected a `recurrence` of {law.__name__} that gives the series of its shape, got"
            f" {found[k]:.12g} for S({x0[k] + t:g}) = {expected[k]:.12g}; correct it, or the shape"
        )
