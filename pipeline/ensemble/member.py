"""What a member is: a source, terms, a change, a start and a method; from these its draws, its system and its run."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stickslip import sim
from stickslip.pipeline.design.values import (
    BELT,
    END,
    Course,
    Distribution,
    Measured,
    Named,
    OnBlocks,
    Push,
    Pushes,
    Ratio,
    Value,
)
from stickslip.pipeline.scene.ends import Ends
from stickslip.pipeline.scene.systems import SystemFile, SystemFunction, make, read, read_measured
from stickslip.sim.engines import ENGINES, contract
from stickslip.sim.engines.adiabatic import Adiabatic
from stickslip.sim.engines.contract import Engine
from stickslip.sim.simulation import as_engine, as_task, loading, with_names
from stickslip.sim.systems.couplings import draw_constants
from stickslip.sim.systems.terms import OF_BLOCKS, TERMS
from stickslip.sim.systems.weakening import LAWS

# What a random draw is for: the first word of every seed's key; the other purposes are those of `TERMS`. Never
# renumber: all data depend on it.
MATRIX, PERTURBATION, RATIO, TWIN, START_Z, START_W = 0, 1, 2, 3, 6, 7
#: The purpose of each draw for the blocks, by the argument of `sim.System`, or of a force, that it gives.
_PURPOSES = {term.name: term.purpose for term in TERMS if term.purpose is not None}
_OF_DRIVE = tuple(term.key for term in TERMS if term.table == "drive")
_OF_FORCE = tuple(term.name for term in TERMS if term.table == "force")
_OF_LAWS = [(law, tuple(law.parameters())) for law in LAWS.values()]
#: The arrays of a file, by the purpose of the draw that each replaces.
_ARRAYS = {_PURPOSES[name]: name for name in OF_BLOCKS} | {START_Z: "z0", START_W: "w0"}


#: What a term or a start may be instead of one number.
NO_NUMBER = (Distribution, Course, Measured, Named, Ratio, OnBlocks, Pushes)

#: z and w, each of shape (n,).
State = tuple[np.ndarray, np.ndarray]


class Source(NamedTuple):
    """Where a system comes from: `matrix` is its number among those of an ensemble, a file or a function."""

    n: int
    coupling: str
    matrix: int
    seed: int
    origin: SystemFile | SystemFunction | None  #: the user's file or function, if it comes from one
    parameters: tuple[tuple[str, float], ...]  #: of that function, or that file
    names: tuple[str, ...] = ()  #: of the blocks


class Change(NamedTuple):
    """How a member differs from the system and the start of its matrix: moved constants, or a moved start."""

    reading: str | None = None
    size: float = 0.0
    draw: int | None = None
    twin_size: float | None = None


class Start(NamedTuple):
    """The state that a member starts from; `ends`: the dataset at whose ends it starts, if it starts at one."""

    z0: Value
    w0: Value
    draw: int | None
    ends: Ends | None


class Neighbour(NamedTuple):
    """The point beside a member's on the axis that is refined: the numbers of both, and what systems have there."""

    values: tuple[float, float]
    terms: tuple[tuple[str, Any], ...]
    parameters: tuple[tuple[str, float], ...]


class Method(NamedTuple):
    """The engine by name, and those of its settings that apply; `ratio` is "one" or "uniform"."""

    engine: str
    settings: tuple[tuple[str, Any], ...]
    ratio_draw: int | None
    picked_for: str | None
    load: str | None = None  #: how the belt loads, if it does not move at its speed


@dataclass(frozen=True, slots=True)
class Member:
    """One run of an ensemble: all that determines it, and nothing else."""

    #: Built from its own values alone: more matrices, sizes, draws or engines in the scene do not rename it.
    member_id: str
    source: Source
    #: What its system is given, by the names of `stickslip.sim.systems.terms.TERMS`.
    terms: tuple[tuple[str, Any], ...]
    change: Change
    begin: Start
    method: Method
    t_end: float  #: dimensionless
    #: What records take for it, and its part of what is computed once for several members.
    shared_cost: float = field(default=0.0, compare=False)
    #: Below and above, where the scene refines between them.
    neighbours: tuple[Neighbour | None, Neighbour | None] = field(default=(None, None), compare=False)
    #: What one dimensionless unit is in the units of `terms` and `begin`; None if these are dimensionless.
    units: sim.Scales | None = None

    @property
    def n(self) -> int:
        """Number of blocks."""
        return self.source.n

    @property
    def engine(self) -> str:
        """The engine's name."""
        return self.method.engine

    @property
    def settings(self) -> tuple[tuple[str, Any], ...]:
        """The engine's settings."""
        return self.method.settings

    @property
    def ratio_draw(self) -> int | None:
        """Number of the draw of the ratios r_i, if they are drawn."""
        return self.method.ratio_draw

    def term(self, name: str) -> Any:
        """A term of its system; None if it has none."""
        return dict(self.terms).get(name)

    @property
    def series(self) -> list[Measured]:
        """What of its terms is read from files of times and values."""
        values = [value for _, value in self.terms]
        values += [push.course for pushes in values if isinstance(pushes, Pushes) for push in pushes.parts]
        return [value for value in values if isinstance(value, Measured)]

    def row(self) -> dict[str, Any]:
        """Its own values, by column of a dataset; null where there is not one number."""
        source, change, begin, method = self.source, self.change, self.begin, self.method
        return (
            dict(source.parameters)
            | dict(method.settings)
            | {name: _plain(value) for name, value in self.terms}
            | {
                "member_id": self.member_id, "n": source.n, "coupling": source.coupling, "matrix": source.matrix,
                "seed": source.seed, "file": source.origin.name if isinstance(source.origin, SystemFile) else None,
                "perturbation_reading": change.reading, "perturbation_size": change.size,
                "perturbation_draw": change.draw, "twin_size": change.twin_size, "engine": method.engine,
                "ratio_draw": method.ratio_draw, "picked_for": method.picked_for, "load": method.load,
                "z0": _plain(begin.z0), "w0": _plain(begin.w0), "start_draw": begin.draw, "drawn": self.drawn,
                "t_end": self.t_end,
            }
        )  # fmt: skip

    def _key(self, purpose: int, *draw: int | None) -> tuple[int, ...]:
        """What one draw means: members that share it share its numbers."""
        return (purpose, self.n, self.source.matrix, *(number for number in draw if number is not None))

    def _seed(self, purpose: int, *draw: int | None) -> np.random.SeedSequence:
        """Seed of one draw."""
        return np.random.SeedSequence(self.source.seed, spawn_key=self._key(purpose, *draw))

    @property
    def state_scales(self) -> tuple[float, float]:
        """What a dimensionless unit of z, and of w, is in its units."""
        return (1.0, 1.0) if self.units is None else (self.units.length, self.units.speed)

    @property
    def scales(self) -> dict[str, Any]:
        """What its coupling is drawn by: arguments of `sim.draw_system`."""
        values = {name: self.term(name) for name in ("kappa", "leaf", "degree", "rewiring")}
        return {
            name: self._by_block(value, _PURPOSES.get(name, 0))
            for name, value in values.items()
            if value is not None or name == "kappa"
        }

    def _by_block(self, value: Value, purpose: int, *draw: int | None) -> Any:
        """A number itself, the draw of a distribution or the array of a file, shape (n,)."""
        if isinstance(value, float):
            return value
        if isinstance(value, Course):
            return sim.Piecewise(value.times, value.values)
        if isinstance(value, Measured):
            return read_measured(value)
        if isinstance(value, Ratio):
            return self._by_block(value.factor, purpose, *draw)
        if isinstance(value, Distribution):
            return _drawn(value, self.source.seed, self._key(purpose, *draw), self.n)
        if not isinstance(value, Named):
            return value
        if value == BELT:
            system = self.system()
            return system.at_rest(0.0)
        assert isinstance(self.source.origin, SystemFile)
        return np.asarray(read(self.source.origin)[_ARRAYS[purpose]], dtype=np.float64)

    @property
    def drawn(self) -> str | None:
        """What is drawn for each block, or read from a file, as text; None: nothing."""
        return _words_of(self.terms, self.begin.z0, self.begin.w0)

    def system(self) -> sim.System:
        """Draw the member's system: the matrix's own, then moved if the member is a perturbed one.

        The matrix is the same under every engine, stiffness and perturbation. A perturbation's direction is the
        same for every size: draw 2 at size 0.05 goes five times as far as draw 2 at size 0.01, the same way.
        """
        values = self.source, self.terms, self.change._replace(twin_size=None), self.units
        return _latest(_moved_system, self, values)

    def towards(self, neighbour: Neighbour) -> Callable[[float], sim.System]:
        """Its system at 0, and at 1 that of a neighbour, of the same draws; numbers between go along a line."""

        def mixed(pairs: tuple[tuple[str, Any], ...], others: tuple[tuple[str, Any], ...], share: float) -> Any:
            other_values = dict(others)
            return tuple(
                (key, value if other_values[key] == value else (1.0 - share) * value + share * other_values[key])
                for key, value in pairs
            )

        def system_at(share: float) -> sim.System:
            parameters = mixed(self.source.parameters, neighbour.parameters, share)
            terms = mixed(self.terms, neighbour.terms, share)
            return replace(self, terms=terms, source=self.source._replace(parameters=parameters)).system()

        return system_at

    def start(self, end: State | None = None) -> tuple[float | np.ndarray, float | np.ndarray]:
        """z and w at t = 0; a twin's is moved by `twin_size`, the root of the mean over blocks of dz^2 + dw^2.

        Parameters
        ----------
        end : tuple of two ndarray, shape (n,), optional
            State at which it starts, the end of another run: see `stickslip.pipeline.running.ends.end_of`.

        Raises
        ------
        ValueError
            If it starts at an end, and none is given.
        """
        starts = (self.begin.z0, START_Z), (self.begin.w0, START_W)
        if end is None and self.begin.ends is not None:
            raise ValueError(
                f"end: expected the state that {self.member_id} starts from, got none; pass what"
                " stickslip.pipeline.running.ends.end_of(member) returns"
            )
        z, w = (
            end[k]
            if end is not None and value == END
            else self._by_block(value, purpose, self.begin.draw) / (1.0 if value == BELT else self.state_scales[k])
            for k, (value, purpose) in enumerate(starts)
        )
        if self.change.twin_size is None:
            return z, w
        offsets = np.random.default_rng(self._seed(TWIN, self.begin.draw)).standard_normal((2, self.n))
        offsets *= self.change.twin_size * math.sqrt(self.n) / np.linalg.norm(offsets)
        return z + offsets[0], w + offsets[1]

    @property
    def base(self) -> Member | None:
        """The member that this one is a changed copy of: without its change, or else without its drawn ratios."""
        if self.change != _UNMOVED:
            return replace(self, change=_UNMOVED)
        if self.ratio_draw is None:
            return None
        settings = tuple((dict(self.settings) | {"ratio": "one"}).items())
        return replace(self, method=self.method._replace(settings=settings, ratio_draw=None))

    def ratios(self) -> float | np.ndarray:
        """Stiffness ratios r_i of the sigmoid: 1, or shape (n,) uniform in (0, 1]."""
        if self.ratio_draw is None:
            return 1.0
        return 1.0 - np.random.default_rng(self._seed(RATIO, self.ratio_draw)).random(self.n)

    def task(
        self,
        system: sim.System,
        start: tuple[float | np.ndarray, float | np.ndarray],
        t_eval: ArrayLike = (),
        stop_early: bool | str = True,
    ) -> tuple[Engine | Adiabatic, contract.Task]:
        """Its engine, one for all members of the same settings, and what that is to run.

        `t_eval` and `stop_early` are as in `stickslip.sim.simulate`.
        """
        if self.ratio_draw is None:
            engine = _engine(self.engine, self.settings)
        else:
            engine = as_engine(self.engine, dict(self.settings) | {"ratio": self.ratios()})
        task = as_task(engine, system, *start, t_end=self.t_end, t_eval=t_eval, stop_early=stop_early)
        return engine if self.method.load is None else loading(self.method.load, engine), task

    def simulate(self, t_eval: ArrayLike = (), end: State | None = None) -> sim.Run:
        """Draw the system and run it; `end` as in `start`."""
        engine, task = self.task(self.system(), self.start(end), t_eval)
        return with_names(engine.integrate(task), self.source.names)

    @property
    def cost(self) -> float:
        """Estimated work, about seconds of one core; constants measured from n = 5 to 400, eps = 0.0003 to 0.3.

        The number of steps follows that of the events, whose rate grows with n. A step has products with K, which
        grow with n^2. With a sparse K they cost little beside a pass over the blocks, each of which takes as long as
        some 50 entries.
        """
        origin = self.source.origin
        is_sparse = self.source.coupling not in sim.COUPLINGS if origin is None else origin.is_sparse
        a_row = min(self.n, 50) if is_sparse else self.n
        rate = ENGINES[self.engine].cost(2.5e-7 * self.n + 3.7e-11 * self.n**2 * a_row, dict(self.settings))
        certificate = min(1.7e-6 * self.n**2, 0.02)  # that a collapse is final
        return 1e-3 + certificate + self.t_end * rate + self.shared_cost


_UNMOVED = Change()


def _plain(value: Any) -> Any:
    return None if isinstance(value, NO_NUMBER) else value


@lru_cache(maxsize=8)
def _engine(name: str, settings: tuple[tuple[str, Any], ...]) -> Engine:
    """An engine with a member's settings; its ratios, if it has any, are one."""
    return as_engine(name, {key: 1.0 if key == "ratio" else value for key, value in settings})


@lru_cache(maxsize=8)  # most members have the terms of their neighbours
def _words_of(terms: tuple[tuple[str, Any], ...], z0: Value, w0: Value) -> str | None:
    """As `Member.drawn`."""
    values = dict(terms)
    texts = {key: values[key] for key in _PURPOSES if key in values}
    texts |= {"force": values.get("forces", values.get("force_course")), "force_blocks": values.get("force_blocks")}
    texts |= {"drive_speed": values.get("drive_speed"), "z": z0, "w": w0}
    special = {key: value for key, value in texts.items() if isinstance(value, NO_NUMBER)}
    return "; ".join(f"{key} = {value}" for key, value in special.items()) or None


@lru_cache(maxsize=8)  # engines follow on each other
def _drawn(value: Distribution, seed: int, key: tuple[int, ...], n: int) -> np.ndarray:
    """What is drawn for the blocks, shape (n,), read-only."""
    array = value.draw(np.random.SeedSequence(seed, spawn_key=key), n)
    array.flags.writeable = False
    return array


#: The last system that each function made, after the values that it depends on.
_made: dict[Callable[[Member], sim.System], tuple[tuple[Any, ...], sim.System]] = {}


def _latest(make: Callable[[Member], sim.System], member: Member, values: tuple[Any, ...]) -> sim.System:
    """A member's system, made once for the members that share it, which follow on each other."""
    latest = _made.get(make)
    if latest is None or latest[0] != values:
        latest = _made[make] = values, make(member)
    return latest[1]


def _moved_system(member: Member) -> sim.System:
    """A member's system, moved if it is a perturbed one, and dimensionless."""
    system, change = _latest(_measured_system, member, (member.source, member.terms)), member.change
    if change.reading is not None:
        system = sim.perturb_system(
            system,
            member.source.coupling,
            change.size,
            member._seed(PERTURBATION, change.draw),
            reading=change.reading,
            **member.scales,
            rho=member.term("rho") or 0.0,  # not used without: see Scene._consistent
        )
    return system if member.units is None else member.units.dimensionless(system)


def _measured_system(member: Member) -> sim.System:
    """The system of a member's matrix, not moved, in its units."""
    system, names, contacts = _of_terms(member), member.source.names, member.term("contacts")
    if names:
        system = system.changed(names=names)
    if contacts is not None:
        rubs = contacts.among(member.n)
        static = np.where(rubs, system.static, 0.0) if system.has_static else None
        system = system.changed(friction=np.where(rubs, system.friction, 0.0), static=static)
    return system if member.term("drive_block") is None else _driven(member, system)


def _driven(member: Member, system: sim.System) -> sim.System:
    """The system in the frame of the member's drive, whose spring has the damping of a stiffness, b of Rayleigh's."""
    numbers = {name: member._by_block(member.term(f"drive_{name}"), 0) for name in _OF_DRIVE}
    damping = (member.term("rayleigh_stiffness") or 0.0) * numbers["spring"]
    driven = system.driven(member.term("drive_block"), damping=damping, **numbers)
    return driven if member.term("back_slip") is None else driven.changed(back_slip=False)


def _of_terms(member: Member) -> sim.System:
    """The system that a member's terms make, as it stands on the ground."""
    source, seed = member.source, member._seed(MATRIX)
    pattern = _pattern(source.coupling, source.n, member.terms) if source.origin is None else None
    if pattern is None:
        return _made_alone(member, seed)
    return pattern(*draw_constants(source.coupling, source.n, seed, member.term("kappa"), member.term("rho")))


@lru_cache(maxsize=64)  # as many points of a grid; a small system is run in the time that it takes to make one
def _pattern(
    coupling: str, n: int, terms: tuple[tuple[str, Any], ...]
) -> Callable[[np.ndarray, np.ndarray], sim.System] | None:
    """Makes systems that differ in K and R alone, from these; None if more is drawn for each."""
    is_same = not any(key == "rayleigh_mass" or isinstance(value, NO_NUMBER) for key, value in terms)
    if not (is_same and coupling in sim.COUPLINGS and {"kappa", "rho"} <= dict(terms).keys()):
        return None
    anywhere, anyhow = Start(0.0, 0.0, None, None), Method("", (), None, None)
    member = Member("", Source(n, coupling, 0, 0, None, ()), terms, _UNMOVED, anywhere, anyhow, 0.0)
    system = _made_alone(member, member._seed(MATRIX))
    return system.pattern() if isinstance(system.stiffness, np.ndarray) else None


def _arguments(member: Member) -> dict[str, Any]:
    """What `sim.System` is given beside K, by a member's terms, before ratios are applied."""
    terms = dict(member.terms)
    arguments: dict[str, Any] = {
        name: member._by_block(terms[name], _PURPOSES[name]) for name in OF_BLOCKS if terms.get(name) is not None
    }
    if terms.get("force_amplitude") is not None or terms.get("force_course") is not None:
        harmonic = tuple(terms.get(name) for name in _OF_FORCE)
        arguments["force"] = _force(member, Push(harmonic, terms.get("force_course"), terms.get("force_blocks")))
    if isinstance(several := terms.get("forces"), Pushes):
        arguments["force"] = [_force(member, push, k) for k, push in enumerate(several.parts)]
    for law, keys in _OF_LAWS:
        numbers = {key: terms.get(f"weakening_{key}") for key in keys}
        if None not in numbers.values():
            arguments["weakening"] = law(**numbers)
    if terms.get("weakening_curve") is not None:
        arguments["weakening"] = terms["weakening_curve"]
    if terms.get("back_slip") is not None and terms.get("drive_block") is None:
        arguments["back_slip"] = False
    return arguments


def _made_alone(member: Member, seed: np.random.SeedSequence) -> sim.System:
    """As `_of_terms`, whatever is drawn for each block."""
    terms, origin, arguments = dict(member.terms), member.source.origin, _arguments(member)
    base_system = None
    if isinstance(origin, SystemFunction):
        base_system = make(
            origin,
            member.n,
            np.random.default_rng(seed),
            dict(member.source.parameters),
            realisation=member.source.matrix,
        )
    for name, value in terms.items():
        if isinstance(value, Ratio):
            arguments[name] = arguments[name] * (
                arguments[value.of] if value.of in arguments else getattr(base_system, value.of)
            )
    if (of_mass := terms.get("rayleigh_mass")) is not None:
        undamped = _of_source(member, seed, base_system, {**arguments, "damping": 0.0})
        return _with_rayleigh(undamped, of_mass, terms["rayleigh_stiffness"])
    return _of_source(member, seed, base_system, arguments)


def _with_rayleigh(system: sim.System, of_mass: float, of_stiffness: float) -> sim.System:
    """The system with C = a M + b K."""
    damping: Any = of_stiffness * system.stiffness
    if isinstance(damping, np.ndarray):
        damping += np.diag(of_mass * system.mass)
    else:
        from scipy.sparse import diags_array  # a sparse K has loaded it

        damping = damping + diags_array(of_mass * system.mass)
    return system.changed(damping=damping)


def _of_source(
    member: Member, seed: np.random.SeedSequence, base_system: sim.System | None, arguments: dict[str, Any]
) -> sim.System:
    """The system of a member's source, from the one that its function made if it has one, with these arguments."""
    if base_system is not None:
        return base_system.changed(**arguments)
    origin, rho = member.source.origin, member.term("rho")
    if isinstance(origin, SystemFile):
        if rho is not None:
            arguments["damping"] = np.random.default_rng(seed).uniform(rho, 2 * rho, member.n)
        if origin.is_graph:
            return sim.System.from_graph(read(origin)["edges"], **member.scales, **arguments)
        return sim.System(read(origin)["stiffness"], **arguments)
    return sim.draw_system(member.source.coupling, member.n, seed, **member.scales, rho=rho, **arguments)


def _force(member: Member, push: Push, *number: int) -> sim.Harmonic | sim.Piecewise:
    """A force; `number` is that of one of several, which has draws of its own."""
    blocks = push.blocks
    acts = 1.0 if blocks is None else blocks.among(member.n).astype(np.float64)
    if push.course is not None:
        course = member._by_block(push.course, 0)
        return sim.Piecewise(course.times, np.multiply.outer(course.values, acts))
    numbers = (
        member._by_block(value, _PURPOSES[name], *number)
        for name, value in zip(_OF_FORCE, push.harmonic, strict=True)
    )
    amplitude, frequency, phase = numbers
    return sim.Harmonic(amplitude * acts, frequency, phase)
