"""What a weakening law is: kinetic friction that falls as a block slips faster on its belt.

    mu(u) = far + (near - far) S(x),    x = steepness |u|,    u = w - v

near is the kinetic friction of a block that begins to slip, far that at the limit of fast slip; the shape S falls
from S(0) = 1 to 0. S and its first two derivatives are at most about one, and the poles of S are about 1 + x or more
away from x: the quadrature of `stickslip.sim.energy` and the longest steps of the exact engine depend on it.

A law is a subclass of `Weakening` in a file of its own, and a line in `LAWS`. Its forms are plain functions that the
engines compile with their kernels. An engine refuses a law that lacks the form it needs, and one that is not in
`LAWS`: compiled kernels are kept by a digest of the sources of `sim`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import namedtuple
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

from stickslip.sim.numerics.arguments import Floats, number


def parameter(words: str, column: str, example: float) -> Any:
    """A field of a law, a number > 0: its words in a scene's keys and in a dataset's columns, and an example.

    The laws share a table of a scene, and its keys say which of them it means: no two have a parameter of one name.
    """
    return field(metadata={"words": words, "column": column, "example": example})


@dataclass(frozen=True)
class Weakening(ABC):
    """How kinetic friction falls with the speed of slip. A subclass is a frozen dataclass of `parameter` fields.

    Attributes
    ----------
    name : str
        Its name in scenes.
    formula : str
        Kinetic friction, in the words of scenes.
    falls_from_static : bool
        Whether it needs a static friction to fall from.
    on_lanes : function or None
        For the sigmoid engine: S and its derivative, of a `Lane` x >= 0. It imports from
        `stickslip.sim.numerics.lanes` inside, since systems load no numba.
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
    kind : empty named tuple
        The type that stands for the law in kernels of the sigmoid engine, which are compiled for it.
    """

    name: ClassVar[str]
    formula: ClassVar[str]
    falls_from_static: ClassVar[bool] = False
    on_lanes: ClassVar[Any] = None
    recurrence: ClassVar[Any] = None
    n_series: ClassVar[int] = 1
    is_entire: ClassVar[bool] = False
    kind: ClassVar[type[Any]]

    def __init_subclass__(cls) -> None:
        kind = namedtuple(cls.__name__, (), module=cls.__module__)  # type: ignore[misc]
        kind.__qualname__ = f"{cls.__qualname__}.kind"  # where a kernel that is loaded finds it
        cls.kind = kind

    def __post_init__(self) -> None:
        for name in self.parameters():
            number(name, getattr(self, name), above=0)

    @property
    @abstractmethod
    def steepness(self) -> float:
        """The factor of the speed of slip in x."""

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
        return {one.name: dict(one.metadata) for one in fields(cls)}

    @classmethod
    def require_static(cls, static: object) -> None:
        """ValueError if the law falls from the static friction, and none is given."""
        if cls.falls_from_static and static is None:
            raise ValueError(
                f"static: expected with the law of {cls.__name__}, which falls from the static friction to the"
                " kinetic, found nothing; add e.g. `static = 1.3`"
            )
