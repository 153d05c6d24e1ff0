"""What an engine is: the rules that it keeps, the tasks that it is given, and its settings, for all floors.

An engine is a subclass of `Engine`, named in `stickslip.sim.engines.ENGINES`, whose runs keep these rules:

1. the state is float64, arguments are not changed, and the same arguments give the same run;
2. the series holds every change of mode on [t_start, t_end], in order of time and, at one instant, of block;
3. everything at one instant is decided together: the order of the blocks does not matter, and renumbering the blocks
   renumbers the run;
4. a run is `finished` at the t_end asked for; `collapsed` when no block can stick again (proved, see
   `sim.engines.certificates`): its motion from there is linear, and followed to t_end; `diverged` when it escapes
   for ever (proved, or beyond every bound): then, and only then, the run ends early. A proof of collapse is sought
   where it pays, counted in products, or whenever all blocks slip, if the task asks for that; so the outcome depends
   on the task alone, and on no clock or machine;
5. what the engine cannot carry through raises `IntegrationError`, which names the time and the block;
6. samples of the state are interpolated within the steps, so asking for them changes nothing else;
7. two opposite changes of a block's mode that are closer than the error of the run can tell apart are a touch, and no
   events.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import Enum
from functools import cache, partial
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.numerics.arguments import Floats, floats, number
from stickslip.sim.runs.run import Run, Samples
from stickslip.sim.systems.system import System

#: What an ensemble is for: statistics of all its runs, or the path of each.
Purpose = Literal["statistics", "paths"]


#: So many blocks are enough to have the kernels of small systems compiled.
SMALL = 3


class Task(NamedTuple):
    """A run to be made: the start as arrays, shape (n,); the times of samples, and buffers for them."""

    system: System
    z0: Floats
    w0: Floats
    t_start: float
    t_end: float
    samples: Samples
    stop_early: bool  #: whether a run ends once its escape is certain, or beyond doubt
    certify: bool  #: whether it is tested for collapse whenever all blocks slip, and not only where that pays
    modes: NDArray[np.int8] | None = None  #: at the start; None: what the state says

    @property
    def length(self) -> float:
        """The time that it takes."""
        return self.t_end - self.t_start


@dataclass(frozen=True, kw_only=True)
class Setting(ABC):
    """A setting of an engine beside its name and default."""

    words: str  #: what it is, in a scene's keys
    column: str = ""  #: what it is, in a dataset's columns; default: the words and the engines that have it
    example: Any = None  #: for scenes; default: the setting's own default
    in_id: str | None = None  #: the prefix of its value in a member's id; None: the id leaves it out
    #: When the label of a report's group has it: "always", "unless default", or "if it differs" between groups.
    in_label: Literal["always", "unless default", "if it differs"] = "if it differs"
    #: Another setting and the value of it that this one needs to have a meaning.
    only_with: tuple[str, str] | None = None
    #: Whether every dataset has its column, also one without such an engine; a setting that is added later has none.
    in_all: bool = False

    @abstractmethod
    def checked(self, name: str, value: Any) -> Any:
        """The value as engines take it; TypeError or ValueError, naming the setting, if it is not valid."""


class Coarseness(Enum):
    """What a number makes coarse: the smaller it is, the nearer a run is to that of the exact law."""

    WIDTH = "width of a smoothed law"
    STEP = "length of a step"
    RELATIVE = "relative tolerance"
    ABSOLUTE = "absolute tolerance"


@dataclass(frozen=True, kw_only=True)
class Number(Setting):
    """A number in the open interval (above, below)."""

    above: float = -math.inf
    below: float = math.inf
    #: Its value where only the purpose of a run is given; a tolerance has one for each purpose.
    picked: Mapping[Purpose, float] = field(default_factory=dict)
    coarseness: Coarseness | None = None  #: what it makes coarse; None: nothing

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
    """Any number of distinct numbers > 0. Each has an event series of its own, and no column in a dataset."""

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
        return value  # it is checked against a system


def setting(default: Any, about: Setting) -> Any:
    """A field of an engine."""
    return field(default=default, metadata={"setting": about})


@dataclass(frozen=True, kw_only=True, eq=False)
class Engine(ABC):
    """A method of integration with its settings.

    A subclass is a frozen dataclass whose fields are made by `setting`. From them follow what `simulate` takes, the
    tables and keys of scenes, the columns of datasets, the ids of members and the labels of groups.
    """

    name: ClassVar[str]  #: as in ``engine="..."``
    title: ClassVar[str]  #: on pages of a report; default: its name
    noun: ClassVar[str] = ""  #: where that is no noun
    about: ClassVar[str]  #: one line for scenes, and for pages that name it
    #: The package of its compiled kernels, which the module `integrate` there loads; "" if it has none.
    kernels: ClassVar[str] = ""
    sizes: ClassVar[tuple[int, ...]] = (SMALL,)  #: numbers of blocks for each of which other kernels may be needed
    #: Whether it keeps the exact, set-valued friction law and locates every event of it. Records of the exact law are
    #: of such runs alone, other engines are compared with them, and they take `Task.modes`.
    is_exact: ClassVar[bool] = False
    #: Whether events have times of their own. Where they have those of steps, slip onsets and arrests of one step
    #: cancel in n_stick, and neither the rate of slip onsets nor cascades can be read off that.
    locates_events: ClassVar[bool] = True
    #: Whether its runs have `Run.stills`, from which the moments of episodes are.
    keeps_stills: ClassVar[bool] = False
    #: What it runs beyond eq. (10), by the names in `stickslip.sim.systems.system.BEYOND`; systems with anything else
    #: there are refused. Masses are divided out before.
    takes: ClassVar[frozenset[str]] = frozenset()

    def __init_subclass__(cls) -> None:
        own = vars(cls)
        if "name" in own:  # an inherited title is that of another engine
            cls.title = own.get("title", cls.name)

    def __post_init__(self) -> None:
        for name, about in self.settings().items():
            object.__setattr__(self, name, about.checked(name, getattr(self, name)))

    @abstractmethod
    def integrate(self, task: Task) -> Run:
        """Run a task under the rules of this module."""

    def prepare(self, tasks: Sequence[Task]) -> list[Callable[[], Run]]:
        """Functions that run the tasks when called, each once, with the result of `integrate` to the last bit.

        An engine may begin several at once: a call from Python takes longer than a small system runs. They may share
        workspace, so all are called in one thread.
        """
        return [partial(self.integrate, task) for task in tasks]

    @property
    def tolerances(self) -> dict[str, float]:
        """Its tolerances, by name."""
        known = self.settings().items()
        return {name: getattr(self, name) for name, about in known if isinstance(about, Number) and about.picked}

    @classmethod
    def taken(cls) -> frozenset[str]:
        """What systems that it is given may have beyond eq. (10)."""
        return cls.takes | {"mass"}

    @classmethod
    @cache  # small systems run in a fraction of a millisecond
    def settings(cls) -> dict[str, Setting]:
        """The settings, by name."""
        return {field.name: field.metadata["setting"] for field in fields(cls)}

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """The default of each setting, by name."""
        return {field.name: field.default for field in fields(cls)}

    @staticmethod
    def cost(rate: float, settings: Mapping[str, Any]) -> float:
        """The cost of a unit of time, from `rate`, the cost of its events and products alone."""
        return rate

    @staticmethod
    def problem(settings: Mapping[str, Any]) -> str:
        """Why settings of an ensemble are incompatible, whatever is drawn; empty if they are not."""
        return ""
