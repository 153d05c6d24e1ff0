"""A scene expanded into members: ids, seeds, systems, and the batches they are computed in."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stickslip import sim
from stickslip.pipeline.scene.ends import Ends
from stickslip.pipeline.scene.quantity import BELT, END, Course, Distribution, Named, Value
from stickslip.pipeline.scene.systems import SystemFile, SystemFunction, make, read
from stickslip.sim.engines import ENGINES, contract
from stickslip.sim.engines.contract import Engine
from stickslip.sim.simulation import as_engine, as_task
from stickslip.sim.systems.friction import Rational, Stribeck
from stickslip.sim.systems.terms import OF_BLOCKS, TERMS

# What a random draw is for: the first word of every seed's key; the other purposes are those of `TERMS`. Never
# renumber: the data hang on it.
MATRIX, PERTURBATION, RATIO, TWIN, START_Z, START_W = 0, 1, 2, 3, 6, 7
#: What a draw for each block is for, by the argument of `sim.System`, or of a force, that it gives.
_PURPOSES = {term.name: term.purpose for term in TERMS if term.purpose is not None}
_OF_FORCE = tuple(term.name for term in TERMS if term.table == "force")
_GIVEN = (*OF_BLOCKS, *_OF_FORCE)
#: What a file holds, by what a draw in its place would be for.
_ARRAYS = {_PURPOSES[name]: name for name in OF_BLOCKS} | {START_Z: "z0", START_W: "w0"}


#: z and w, each of shape (n,).
State = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, slots=True)
class Member:
    """One run of an ensemble: all that determines it. Dimensionless; None where a setting does not apply.

    `member_id` is built from the member's own values alone: more matrices, sizes, draws or engines in the scene
    do not rename it.
    """

    member_id: str
    n: int
    coupling: str
    kappa: float | None
    leaf: Value | None
    degree: float | None
    rho: float | None
    damping: Value | None
    friction: Value | None
    static: Value | None
    mass: Value | None
    belt_speed: Value | None
    force_amplitude: Value | None
    force_frequency: Value | None
    force_phase: Value | None
    force_course: Value | None
    weakening_rate: float | None
    weakening_speed: float | None
    back_slip: str | None
    parameters: tuple[tuple[str, float], ...]
    matrix: int
    #: The file or the function of the user's that its system comes from, if one does.
    origin: SystemFile | SystemFunction | None
    perturbation_reading: str | None
    perturbation_size: float
    perturbation_draw: int | None
    twin_size: float | None
    engine: str
    #: Those of the engine's settings that mean something beside the others, by name; `ratio` is "one" or "uniform".
    settings: tuple[tuple[str, Any], ...]
    ratio_draw: int | None
    picked_for: str | None
    z0: Value
    w0: Value
    start_draw: int | None
    #: The dataset at whose ends it starts, if it does.
    start_from: Ends | None
    t_end: float
    seed: int
    #: Its part of work that is done once for several members; no part of what it is.
    shared_cost: float = field(default=0.0, compare=False)

    def _seed(self, purpose: int, *draw: int | None) -> np.random.SeedSequence:
        """Seed of one draw, keyed by its meaning, so that members that share a draw share its numbers."""
        known = [number for number in draw if number is not None]
        return np.random.SeedSequence(self.seed, spawn_key=(purpose, self.n, self.matrix, *known))

    @property
    def scales(self) -> dict[str, Any]:
        """What its coupling is drawn by: arguments of `sim.draw_system`."""
        leaf = {} if self.leaf is None else {"leaf": self._by_block(self.leaf, _PURPOSES["leaf"])}
        return {"kappa": self.kappa} | leaf | ({} if self.degree is None else {"degree": self.degree})

    def _by_block(self, value: Value, purpose: int, *draw: int | None) -> Any:
        """A number as it is; of a distribution its draw, of a file its array, shape (n,)."""
        if isinstance(value, float):
            return value
        if isinstance(value, Course):
            return sim.Piecewise(value.times, value.values)
        if isinstance(value, Distribution):
            return value.draw(self._seed(purpose, *draw), self.n)
        if not isinstance(value, Named):
            return value
        if value == BELT:
            system = self.system()
            return system.belt_speed if system.has_one_belt else system.belt_speed_at(0.0)
        assert isinstance(self.origin, SystemFile)
        return np.asarray(read(self.origin)[_ARRAYS[purpose]], dtype=np.float64)

    @property
    def file(self) -> str | None:
        """The name of the file that its system is read from."""
        return self.origin.name if isinstance(self.origin, SystemFile) else None

    @property
    def drawn(self) -> str | None:
        """What is drawn for each block, or read from a file, as text; None: nothing."""
        own = {key: getattr(self, key) for key in _PURPOSES}
        own |= {"force": self.force_course, "z": self.z0, "w": self.w0}
        given = {key: one for key, one in own.items() if isinstance(one, Distribution | Course | Named)}
        return "; ".join(f"{key} = {one}" for key, one in given.items()) or None

    def system(self) -> sim.System:
        """Draw the member's system: the matrix's own, then moved if the member is a perturbed one.

        The matrix is the same under every engine, stiffness and perturbation. A perturbation's direction is the
        same for every size: draw 2 at size 0.05 goes five times as far as draw 2 at size 0.01, the same way.
        """
        return _latest(
            _own_system if self.perturbation_draw is None else _moved_system, self, _values_of_system(self)
        )

    def start(self, end: State | None = None) -> tuple[float | np.ndarray, float | np.ndarray]:
        """z and w at t = 0; a twin's is moved by `twin_size`, the root of the mean over blocks of dz^2 + dw^2.

        Parameters
        ----------
        end : tuple of two ndarray, shape (n,), optional
            Where the run ended at whose end it starts: see `stickslip.pipeline.running.ends.end_of`.

        Raises
        ------
        ValueError
            If it starts at an end, and none is given.
        """
        given = (self.z0, START_Z), (self.w0, START_W)
        if end is None and self.start_from is not None:
            raise ValueError(
                f"end: expected the state that {self.member_id} starts from, got none; pass what"
                " stickslip.pipeline.running.ends.end_of(member) returns"
            )
        z, w = (
            end[k] if end is not None and value == END else self._by_block(value, purpose, self.start_draw)
            for k, (value, purpose) in enumerate(given)
        )
        if self.twin_size is None:
            return z, w
        moved = np.random.default_rng(self._seed(TWIN, self.start_draw)).standard_normal((2, self.n))
        moved *= self.twin_size * math.sqrt(self.n) / np.linalg.norm(moved)
        return z + moved[0], w + moved[1]

    @property
    def base(self) -> Member | None:
        """What this member is a changed copy of: without its perturbation, its own start or else its ratios."""
        if self.perturbation_draw is not None or self.twin_size is not None:
            return replace(self, **_UNMOVED, twin_size=None)
        if self.ratio_draw is None:
            return None
        return replace(self, settings=tuple((dict(self.settings) | {"ratio": "one"}).items()), ratio_draw=None)

    def ratios(self) -> float | np.ndarray:
        """Stiffness ratios r_i of the sigmoid: 1, or shape (n,) uniform in (0, 1]."""
        if self.ratio_draw is None:
            return 1.0
        return 1.0 - np.random.default_rng(self._seed(RATIO, self.ratio_draw)).random(self.n)

    def task(
        self, system: sim.System, t_eval: ArrayLike = (), end: State | None = None
    ) -> tuple[Engine, contract.Task]:
        """What is run of its system, and by what, one engine for the same settings; `end` as in `start`."""
        if self.ratio_draw is None:
            engine = _engine(self.engine, self.settings)
        else:
            engine = as_engine(self.engine, dict(self.settings) | {"ratio": self.ratios()})
        return engine, as_task(engine, system, *self.start(end), t_end=self.t_end, t_eval=t_eval)

    def simulate(self, t_eval: ArrayLike = (), end: State | None = None) -> sim.Run:
        """Draw the system and run it; `end` as in `start`."""
        engine, task = self.task(self.system(), t_eval, end)
        return engine.integrate(task)

    @property
    def cost(self) -> float:
        """Estimated work, about seconds of one core; constants measured from n = 5 to 400, eps = 0.0003 to 0.3.

        Steps follow the events, whose rate grows with n, and each holds products with K, which grow with n^2; of a
        sparse K they are nothing beside a look at every block, which takes as long as some 50 entries.
        """
        is_sparse = self.coupling not in sim.COUPLINGS if self.origin is None else self.origin.is_sparse
        a_row = min(self.n, 50) if is_sparse else self.n
        rate = ENGINES[self.engine].cost(2.5e-7 * self.n + 3.7e-11 * self.n**2 * a_row, dict(self.settings))
        certificate = min(1.7e-6 * self.n**2, 0.02)  # that a collapse is final
        return 1e-3 + certificate + self.t_end * rate + self.shared_cost


#: What a system does not depend on.
_OF_A_RUN = ("member_id", "engine", "settings", "ratio_draw", "picked_for", "twin_size", "t_end", "z0", "w0",
             "start_draw", "start_from")  # fmt: skip
_UNMOVED: dict[str, Any] = {"perturbation_reading": None, "perturbation_size": 0.0, "perturbation_draw": None}
#: The others.
_OF_A_SYSTEM = tuple(one.name for one in fields(Member) if one.compare and one.name not in _OF_A_RUN)
_values_of_system = attrgetter(*_OF_A_SYSTEM)


@lru_cache(maxsize=8)
def _engine(name: str, settings: tuple[tuple[str, Any], ...]) -> Engine:
    """An engine with a member's settings, whose ratios, if it has such, are one."""
    return as_engine(name, {key: 1.0 if key == "ratio" else value for key, value in settings})


#: The last system that each function made, behind what it depends on.
_made: dict[Callable[[Member], sim.System], tuple[tuple[Any, ...], sim.System]] = {}


def _latest(make: Callable[[Member], sim.System], member: Member, values: tuple[Any, ...]) -> sim.System:
    """A member's system: those that share one come one after the other, it is made once."""
    made = _made.get(make)
    if made is None or made[0] != values:
        made = _made[make] = values, make(member)
    return made[1]


def _own_system(member: Member) -> sim.System:
    """The system of a member's matrix, not moved."""
    seed = member._seed(MATRIX)
    given: dict[str, Any] = {
        name: member._by_block(value, _PURPOSES[name])
        for name in _GIVEN
        if (value := getattr(member, name)) is not None
    }
    if member.force_amplitude is not None:
        given["force"] = sim.Harmonic(*(given.pop(name) for name in _OF_FORCE))
    if isinstance(member.force_course, Course):
        given["force"] = sim.Piecewise(member.force_course.times, member.force_course.values)
    if member.weakening_rate is not None:
        given["weakening"] = Rational(member.weakening_rate)
    if member.weakening_speed is not None:
        given["weakening"] = Stribeck(member.weakening_speed)
    if member.back_slip is not None:
        given["back_slip"] = False
    if isinstance(member.origin, SystemFunction):
        made = make(member.origin, member.n, np.random.default_rng(seed), dict(member.parameters))
        return made.changed(**given)
    if member.origin is not None:
        if member.rho is not None:
            given["damping"] = np.random.default_rng(seed).uniform(member.rho, 2 * member.rho, member.n)
        return sim.System(read(member.origin)["stiffness"], **given)
    return sim.draw_system(member.coupling, member.n, seed, **member.scales, rho=member.rho, **given)


def _moved_system(member: Member) -> sim.System:
    assert member.perturbation_reading is not None
    assert member.perturbation_draw is not None
    own = tuple(_UNMOVED.get(name, getattr(member, name)) for name in _OF_A_SYSTEM)
    return sim.perturb_system(
        _latest(_own_system, member, own),
        member.coupling,
        member.perturbation_size,
        member._seed(PERTURBATION, member.perturbation_draw),
        reading=member.perturbation_reading,
        **member.scales,
        rho=0.0 if member.rho is None else member.rho,  # not used then: see Scene._consistent
    )
