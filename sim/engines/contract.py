"""What an engine is: the rules that it keeps, what it is asked, and its settings, which all floors read off here.

An engine is a subclass of `Engine`, named in `stickslip.sim.engines.ENGINES`, whose runs keep these rules:

1. the state is float64, arguments are not changed, and the same arguments give the same run;
2. the series holds every change of mode on [t_start, t_end], in order of time and, at one instant, of block;
3. what happens at one instant is decided together: no order of the blocks enters, and renumbering the blocks
   renumbers the run;
4. a run is `finished` at the t_end asked for; `collapsed` when no block can stick again (proved, see
   `sim.engines.certificates`): its motion from there is linear, and followed to t_end; `diverged` when it escapes
   for ever (proved, or beyond every bound): then, and only then, the run ends early;
5. what the engine cannot carry through raises `IntegrationError`, which names the time and the block;
6. samples of the state are read off the steps, by series or cubics: asking for them changes nothing else;
7. an event has a length: what a block takes back sooner than the tolerance can tell from a touch is none.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache, partial
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.numerics.arguments import Floats, floats, number, per_block
from stickslip.sim.runs.run import Run, Samples
from stickslip.sim.systems.system import System

#: What is asked of an ensemble: numbers of all its runs, or each run's own path.
Purpose = Literal["statistics", "paths"]


class Task(NamedTuple):
    """What an engine is asked to run: the start as arrays, shape (n,); the times of samples, and room for them."""

    system: System
    z0: Floats
    w0: Floats
    t_start: float
    t_end: float
    samples: Samples
    stop_early: bool  #: whether a run whose escape is certain, or past doubt, ends there
    modes: NDArray[np.int8] | None = None  #: at the start; None: what the state says


@dataclass(frozen=True, kw_only=True)
class Setting(ABC):
    """A setting of an engine beside its name and default.

    Attributes
    ----------
    words : str
        What it is, in a scene's keys.
    column : str
        What it is, in a dataset's columns; default: the words and the engines that have it.
    example : object
        Of a scene; default: the setting's own default.
    in_id : str or None
        What stands before its value in a member's id; None: it is no part of it.
    in_label : str
        When a report's group says it: "always", "unless default", or "if it differs" between groups.
    only_with : (str, str) or None
        Another setting, and the value of that without which this one means nothing.
    """

    words: str
    column: str = ""
    example: Any = None
    in_id: str | None = None
    in_label: Literal["always", "unless default", "if it differs"] = "if it differs"
    only_with: tuple[str, str] | None = None

    @abstractmethod
    def checked(self, name: str, value: Any) -> Any:
        """A value as engines take it; TypeError or ValueError that names the setting otherwise."""


@dataclass(frozen=True, kw_only=True)
class Number(Setting):
    """A number in the open interval (above, below).

    `picked` is what it is where only the purpose of a run is said.
    """

    above: float = -math.inf
    below: float = math.inf
    picked: Mapping[Purpose, float] = field(default_factory=dict)

    def checked(self, name: str, value: Any) -> float:
        return number(name, value, self.above, self.below)


@dataclass(frozen=True, kw_only=True)
class Choice(Setting):
    """One of some words."""

    choices: tuple[str, ...]

    def checked(self, name: str, value: Any) -> str:
        if value not in self.choices:
            raise ValueError(f"{name}: expected one of {', '.join(self.choices)}, got {value!r}")
        return str(value)


@dataclass(frozen=True, kw_only=True)
class Numbers(Setting):
    """Any number of different numbers > 0; no column of a dataset, but series of their own."""

    def checked(self, name: str, value: ArrayLike) -> tuple[float, ...]:
        array = floats(name, value, "an array of numbers")
        numbers = tuple(array.ravel().tolist())
        if array.ndim != 1 or not all(0 < x < math.inf for x in numbers) or len(set(numbers)) < len(numbers):
            raise ValueError(f"{name}: expected different finite numbers > 0, got {value!r}")
        return numbers


@dataclass(frozen=True, kw_only=True)
class Ratios(Setting):
    """The stiffness ratios r_i > 0, one a block or one for all; a setting of this kind is called `ratio`.

    In an ensemble they are 1, or drawn uniform in (0, 1].
    """

    def checked(self, name: str, value: ArrayLike) -> ArrayLike:
        return value  # what is right for a system, `for_blocks` can tell

    @staticmethod
    def for_blocks(name: str, value: ArrayLike, n: int) -> Floats:
        """A number for each of n blocks, shape (n,), from what was set."""
        return per_block(name, value, n, "r_i > 0")


def setting(default: Any, about: Setting) -> Any:
    """A field of an engine."""
    return field(default=default, metadata={"setting": about})


@cache  # small systems run in a fraction of a millisecond
def _settings(engine: type[Engine]) -> dict[str, Setting]:
    return {one.name: one.metadata["setting"] for one in fields(engine)}


@dataclass(frozen=True, kw_only=True, eq=False)
class Engine(ABC):
    """A method of integration with its settings.

    A subclass is a frozen dataclass whose fields are made by `setting`. From them follow what `simulate` takes, the
    tables and keys of scenes, the columns of datasets, the ids of members and the labels of groups.

    Attributes
    ----------
    name : str
        As in ``engine="..."``.
    about : str
        One line for scenes.
    kernels : str
        The package with the kernels that it compiles, whose module `integrate` loads them; "" if it has none.
    is_exact : bool
        Whether its law is the exact one, of which `stickslip.sim.energy` knows the balance.
    takes_damping_matrix : bool
        Whether it runs systems with a full damping matrix.
    takes_static : bool
        Whether it runs systems with static friction above the kinetic.
    takes_drive : bool
        Whether it runs systems with forces from outside, and belts of several or changing speeds. Masses are divided
        out before.
    takes_weakening : bool
        Whether it runs systems whose friction weakens with the speed of slip, or that bar one side to it.
    """

    name: ClassVar[str]
    about: ClassVar[str]
    kernels: ClassVar[str] = ""
    is_exact: ClassVar[bool] = False
    takes_damping_matrix: ClassVar[bool] = True
    takes_static: ClassVar[bool] = False
    takes_drive: ClassVar[bool] = False
    takes_weakening: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for name, about in self.settings().items():
            object.__setattr__(self, name, about.checked(name, getattr(self, name)))

    @abstractmethod
    def integrate(self, task: Task) -> Run:
        """Run a task under the rules of this module."""

    def prepare(self, tasks: Sequence[Task]) -> list[Callable[[], Run]]:
        """The runs of tasks, each of which starts when it is called, and is the one of `integrate` to the last bit.

        Their systems are plain, see `System.is_plain`, and of as many blocks: an engine may set them up at once.
        """
        return [partial(self.integrate, task) for task in tasks]

    @classmethod
    def settings(cls) -> dict[str, Setting]:
        """What there is to set, by name."""
        return _settings(cls)

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """What holds where nothing is said, by name."""
        return {one.name: one.default for one in fields(cls)}

    @staticmethod
    def cost(rate: float, settings: Mapping[str, Any]) -> float:
        """What a unit of time costs if its events and products alone make it cost `rate`."""
        return rate

    @staticmethod
    def problem(settings: Mapping[str, Any]) -> str:
        """What is wrong with settings of an ensemble that do not go together, whatever is drawn; empty if nothing."""
        return ""
