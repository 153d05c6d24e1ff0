"""What a record is: columns, what it needs of a run, and how it is computed.

A record is a subclass of `Record` in a file of its own, named in `stickslip.pipeline.records.RECORDS`. The key by
which a scene asks for it, the columns of datasets and their words, what a run is sampled for, its cost and the pages
of the guide follow.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.design.design import Axis
from stickslip.sim.engines import ENGINES
from stickslip.sim.engines.contract import Engine
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs.blocks import numbered
from stickslip.sim.runs.run import Run, Samples
from stickslip.sim.runs.series import EventSeries
from stickslip.sim.systems.system import System

_NONE = np.empty(0)


class NotKeptError(RuntimeError):
    """A row of a dataset does not hold what a record reads of the run."""


class Member(Protocol):
    """What a record may ask of a member: see `stickslip.pipeline.ensemble.member.Member`."""

    @property
    def n(self) -> int: ...
    @property
    def engine(self) -> str: ...
    @property
    def settings(self) -> tuple[tuple[str, Any], ...]: ...
    @property
    def ratio_draw(self) -> int | None: ...
    @property
    def t_end(self) -> float: ...
    @property
    def cost(self) -> float: ...
    @property
    def base(self) -> Member | None: ...
    @property
    def neighbours(self) -> tuple[Any, Any]: ...
    def towards(self, neighbour: Any) -> Callable[[float], System]: ...
    def ratios(self) -> float | np.ndarray: ...


@dataclass(frozen=True, eq=False)
class Made:
    """A member that was run, or as a row of a dataset has it: what records are computed from."""

    #: Whether all of the run is there; of a row, reading what it does not hold is a `NotKeptError`.
    is_whole: ClassVar[bool] = True
    member: Member
    system: System
    run: Run  #: sampled at the times that the records' `times` ask for
    start: tuple[Any, Any]  #: z and w at t = 0, a number or an array of shape (n,)
    #: Runs another member, sampled at some times: `again(member, times)` gives its `Samples`.
    again: Callable[[Any, tuple[float, ...]], Samples]
    found: dict[str, Any]  #: what records before this one computed, by column
    #: As in `stickslip.simulate`, for what runs it again: a test for collapse may change the last digits.
    stop_early: bool | str

    @cached_property
    def events(self) -> EventSeries:
        """The run's events, to its end."""
        return self.run.events

    @property
    def contact_events(self) -> EventSeries:
        """The run's events of the blocks that have friction."""
        return self.events.of_blocks(self.system.has_friction)

    def samples(self, times: Floats) -> Samples:
        """The run's state at times that a record asked for, as far as the run goes."""
        samples = self.run.samples
        rows = np.searchsorted(samples.t, times[times <= samples.t[-1]] if len(samples) else times[:0])
        return Samples(samples.t[rows], samples.z[rows], samples.w[rows])


class Sharing(NamedTuple):
    """How many members of a scene share what is computed once for them."""

    copies: int  #: changed ones of a run
    draws: int  #: of the engine's ratios
    engines: int


class Facts(NamedTuple):
    """What a record has to know of a scene to say whether it applies."""

    n: int  #: of the largest system
    t_end: float
    engines: tuple[type[Engine], ...]
    has_changes: bool  #: whether members are changed copies of others
    axis: Axis | None  #: between whose numbers there may be something to find
    load: str | None = None  #: how the belt loads, if it does not move at its speed


class Memory(NamedTuple):
    """What a record takes of a worker at once."""

    n_bytes: float
    what: str  #: what takes it, as in "finding eigenvalues"
    remedy: str


@dataclass(frozen=True)
class Record(ABC):
    """A thing that is kept of a run."""

    name: ClassVar[str]  #: its own, and the key under [record], which is true or false
    words: ClassVar[str]  #: of that key, for schemas and the guide
    example: ClassVar[object] = True
    asked_by: ClassVar[str]  #: the line by which a scene asks for it
    columns: ClassVar[tuple[Column, ...]]
    is_step: ClassVar[bool] = False  #: whether the value of its key is a step of time instead
    is_named: ClassVar[bool] = False  #: whether it is names of functions instead
    #: Whether it is about each run's own path, so that tolerances are picked for paths.
    is_of_paths: ClassVar[bool] = False
    is_shared: ClassVar[bool] = False  #: whether most of its cost is computed once for several members
    #: Whether it needs runs that are tested for collapse whenever all blocks slip.
    is_certified: ClassVar[bool] = False
    is_of_exact: ClassVar[bool] = False  #: whether it is of runs of the exact law alone
    #: Whether it reads `Run.stills`, which all engines of a scene have to keep then.
    needs_stills: ClassVar[bool] = False
    #: Whether it leaves out blocks without friction; how many have some is then kept beside it.
    is_of_contacts: ClassVar[bool] = False
    #: That of one block, with {} for its name, if the key may also be names of blocks.
    of_block: ClassVar[Column | None] = None
    #: Whether it has a meaning under adiabatic loading, where events take no time of the run.
    takes_load: ClassVar[bool] = False
    #: What `of` reads: "run" if it reads of the run what no record keeps, such as samples; else the names of the
    #: records that keep all that it reads of it, such as "events"; and "system" if it reads the system or the start.
    #: `stickslip extend` computes a record that does not need "run" from the rows of a dataset.
    needs: ClassVar[frozenset[str]] = frozenset({"run"})

    def __init_subclass__(cls) -> None:
        if "name" in vars(cls) and "asked_by" not in vars(cls):
            cls.asked_by = f"`{cls.name} = true` under [record]"

    @classmethod
    def asked(cls, keys: Mapping[str, Any], settings: Mapping[str, Any]) -> Self | None:
        """The record, if a scene asks for it by [record] or by the settings of an engine; else None.

        Its fields are keys by their names; one that is no key has the value of the record's own.
        """
        value = keys[cls.name]
        return cls(**{field.name: keys.get(field.name, value) for field in fields(cls)}) if value else None

    @property
    def kept(self) -> tuple[Column, ...]:
        """Its columns in a dataset, which may depend on the scene."""
        return self.columns

    @property
    def is_sampled(self) -> bool:
        """Whether it reads states of a run, at its `times`."""
        return False

    def times(self, member: Member) -> Floats:
        """When a run is sampled for it, shape (m,)."""
        return _NONE

    def cost(self, member: Member, sharing: Sharing) -> float:
        """What it takes beyond the run, in the unit of `Member.cost`.

        The same for all members of one n, source, engine and change: only the first of them is asked.
        """
        return 0.0

    def applies(self, member: Member) -> bool:
        """Whether a member has values of it; without, they are null."""
        return not self.is_of_exact or ENGINES[member.engine].is_exact

    def problem(self, facts: Facts) -> str:
        """Why it does not apply to a scene, what came and what to do, for a line that begins with its key."""
        if facts.load is not None and not self.takes_load:
            return f'expected none with load = "{facts.load}", under which events take no time, got it; remove it'
        without = [engine.name for engine in facts.engines if self.needs_stills and not engine.keeps_stills]
        if without:
            return f"expected engines that keep `stills`, got {without[0]!r} without; remove it, or that engine"
        if not self.is_of_exact or any(engine.is_exact for engine in facts.engines):
            return ""
        exact = " or ".join(f'"{name}"' for name, engine in ENGINES.items() if engine.is_exact)
        return (
            f"expected an engine of the exact law, got {facts.engines[0].name!r} alone; add [[engine]] name ="
            f" {exact}, or remove it"
        )

    def memory(self, facts: Facts) -> Memory | None:
        """What it takes of a worker beyond the run, if that may be much."""
        return None

    @abstractmethod
    def of(self, result: Made) -> dict[str, Any]:
        """The values of its columns; those left out are null."""


@dataclass(frozen=True)
class WindowRecord(Record):
    """A record of what a run does after `t_burn`; its key is true, and [record] has the time."""

    t_burn: float
    #: Names and numbers of blocks, if it is of these, each with a column of its own.
    blocks: tuple[tuple[str, int], ...] = field(default=(), kw_only=True)

    @classmethod
    def asked(cls, keys: Mapping[str, Any], settings: Mapping[str, Any]) -> Self | None:
        named, names = keys[cls.name], keys["names"]
        blocks = tuple(
            (name, numbered(f"record.{cls.name}", name, names, len(names)))
            for name in (named if isinstance(named, tuple) else ())
        )
        return super().asked({**keys, "blocks": blocks}, settings)

    @property
    def kept(self) -> tuple[Column, ...]:
        if not self.blocks or self.of_block is None:
            return self.columns
        said = ("name", "words", "title")
        return tuple(
            self.of_block._replace(**{key: getattr(self.of_block, key).format(name) for key in said})
            for name, _ in self.blocks
        )

    def by_block(self, value_of: Callable[[int], float]) -> dict[str, Any]:
        """The values of its columns, from that of a block by number."""
        return {column.name: float(value_of(k)) for column, (_, k) in zip(self.kept, self.blocks, strict=True)}


@dataclass(frozen=True)
class StateRecord(WindowRecord):
    """A record of the states after `t_burn`, sampled every `dt`."""

    dt: float

    @property
    def is_sampled(self) -> bool:
        return True

    def times(self, member: Member) -> Floats:
        return steps(self.t_burn, member.t_end, self.dt)

    def of(self, result: Made) -> dict[str, Any]:
        samples = result.samples(self.times(result.member))
        return self.of_states(samples, result.system) if len(samples) > 1 else {}

    @abstractmethod
    def of_states(self, samples: Samples, system: System) -> dict[str, Any]:
        """The values of its columns, from two or more states."""

    def memory(self, facts: Facts) -> Memory:
        return sampling(facts, self.t_burn, self.dt)


def stop_early(records: Iterable[Record]) -> bool | str:
    """As in `stickslip.simulate`: when runs of which some records are kept are tested for collapse."""
    return "always" if any(record.is_certified for record in records) else True


def steps(t_burn: float, t_end: float, dt: float) -> Floats:
    """t_burn, t_burn + dt ... to t_end."""
    n_steps = math.floor((t_end - t_burn) / dt * (1 + 1e-12))
    return np.minimum(t_burn + dt * np.arange(n_steps + 1), t_end)


def mean_in_time(values: Floats, samples: Samples) -> float:
    """The mean of numbers at the times of samples, shape (m,), by trapezoids."""
    return float(np.trapezoid(values, samples.t) / (samples.t[-1] - samples.t[0]))


def sampling(facts: Facts, t_burn: float, dt: float) -> Memory:
    """What states every `dt` take: z and w, and what is computed of them."""
    n_bytes = 4.0 * 8 * facts.n * (facts.t_end - t_burn) / dt
    return Memory(n_bytes, "sampling a run", "lengthen record.dt")
