"""A scene expanded into members: ids, seeds, systems, and the batches they are computed in."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache, partial
from itertools import islice, product
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stickslip import sim
from stickslip.pipeline.ends import Ends, end_of
from stickslip.pipeline.engine_table import EngineTable
from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.quantity import BELT, END, FILE, Course, Distribution, Named, Value, short, word
from stickslip.pipeline.scene import Scene, parse_scene
from stickslip.pipeline.schema import Recording
from stickslip.pipeline.system_table import QUANTITIES
from stickslip.pipeline.systems import OF_BLOCKS, SystemFile, SystemFunction, make, read
from stickslip.sim.engines import ENGINES, contract
from stickslip.sim.engines.contract import Engine, Ratios
from stickslip.sim.simulation import as_engine, as_task
from stickslip.sim.systems.couplings import READINGS
from stickslip.sim.systems.friction import Rational, Stribeck

# What a random draw is for: the first word of every seed's key. Never renumber: the data hang on it.
MATRIX, PERTURBATION, RATIO, TWIN, FRICTION, DAMPING, START_Z, START_W, LEAF = range(9)
STATIC, MASS, BELT_SPEED, FORCE_AMPLITUDE, FORCE_FREQUENCY, FORCE_PHASE = range(9, 15)

#: What a draw for each block is for, by the argument of `sim.System`, or of a force, that it gives.
_ARGUMENTS = dict(zip(OF_BLOCKS, (DAMPING, FRICTION, STATIC, MASS, BELT_SPEED), strict=True))
_OF_FORCE = {"force_amplitude": FORCE_AMPLITUDE, "force_frequency": FORCE_FREQUENCY, "force_phase": FORCE_PHASE}
_DRAWN = _ARGUMENTS | _OF_FORCE

#: What a file holds, by what a draw in its place would be for.
_ARRAYS = {purpose: name for name, purpose in _ARGUMENTS.items()} | {START_Z: "z0", START_W: "w0"}

#: The readings of a perturbation in a member's name. The data hang on it too.
_READINGS: dict[str, str] = dict(zip(READINGS, "prc", strict=True))

#: Work in a batch, in units of `Member.cost` (about a second each), and how many times as much in a scene of more
#: than so many batches. Not chosen by the number of workers, on which the shards' names and bytes would then depend.
TARGET_COST = 1.0
_LARGER, _MANY = 5.0, 500
#: A batch is at most such a part of what is left, so that workers end together; but not below such a part of a batch.
_OF_REST, _SMALLEST = 0.25, 0.25


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
        leaf = {} if self.leaf is None else {"leaf": self._by_block(self.leaf, LEAF)}
        return {"kappa": self.kappa} | leaf | ({} if self.degree is None else {"degree": self.degree})

    def _by_block(self, value: Value, purpose: int, *draw: int | None) -> Any:
        """A number as it is; of a distribution its draw, of a file or another run's end its array, shape (n,)."""
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
        if value == END:
            assert self.start_from is not None
            return end_of(self.start_from, self)[purpose - START_Z]
        assert isinstance(self.origin, SystemFile)
        return np.asarray(read(self.origin)[_ARRAYS[purpose]], dtype=np.float64)

    @property
    def file(self) -> str | None:
        """The name of the file that its system is read from."""
        return self.origin.name if isinstance(self.origin, SystemFile) else None

    @property
    def drawn(self) -> str | None:
        """What is drawn for each block, or read from a file, as text; None: nothing."""
        own = {key: getattr(self, key) for key in ("leaf", *_ARGUMENTS, *_OF_FORCE)}
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

    def start(self) -> tuple[float | np.ndarray, float | np.ndarray]:
        """z and w at t = 0; a twin's is moved by `twin_size`, the root of the mean over blocks of dz^2 + dw^2."""
        z, w = (self._by_block(*one, self.start_draw) for one in ((self.z0, START_Z), (self.w0, START_W)))
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

    def task(self, system: sim.System, t_eval: ArrayLike = ()) -> tuple[Engine, contract.Task]:
        """What is run of its system, and by what: members with the same settings have one engine."""
        if self.ratio_draw is None:
            engine = _engine(self.engine, self.settings)
        else:
            engine = as_engine(self.engine, dict(self.settings) | {"ratio": self.ratios()})
        return engine, as_task(engine, system, *self.start(), t_end=self.t_end, t_eval=t_eval)

    def simulate(self, t_eval: ArrayLike = ()) -> sim.Run:
        """Draw the system and run it."""
        engine, task = self.task(self.system(), t_eval)
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
        name: member._by_block(value, purpose)
        for name, purpose in _DRAWN.items()
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


def expand(scene: Scene) -> tuple[Member, ...]:
    """All members of a scene, which keeps them.

    Sorted by n, matrix, point of the grid, draw of the start, change (none first), engine (as in the file) and ratio
    draw.
    """
    if scene._members is None:
        scene._members = tuple(_members(scene))
    return scene._members


def _members(scene: Scene) -> Iterator[Member]:
    for n, origin in scene.sources:
        kinds = list(_kinds(scene, n, origin))
        for matrix in range(scene.run.matrices):
            number = matrix if origin is None else origin.matrix(matrix)
            for before, after, member in kinds:
                yield member(member_id=f"{before}-m{matrix:03d}-{after}", matrix=number)


#: What stands in a member's id before its matrix, and after; and all that the member is, but for the two.
_Kind = tuple[str, str, Callable[..., Member]]


def _kinds(scene: Scene, n: int, origin: SystemFile | SystemFunction | None) -> Iterator[_Kind]:
    """All that is run with each matrix of n blocks, or of a file or function, in order."""
    before = f"n{n}" if origin is None else f"n{n}-{origin.word}"
    of_file: dict[str, Any] = {}
    if isinstance(origin, SystemFile):
        of_file = {"kappa": origin.scale}
        of_file |= {name: FILE for name in _ARGUMENTS if name in origin.arrays}
        of_file |= {"rho": None} if "damping" in origin.arrays else {}
    changes = [_Change()]
    if scene.perturbation is not None:
        table = scene.perturbation
        moves = product(table.readings, table.sizes, range(table.draws))
        changes += [_Change(reading, size, draw) for reading, size, draw in moves]
    if scene.twins is not None:
        changes += [_Change(twin_size=size) for size in scene.twins.sizes]
    words = {engine: {draw: _words(engine, draw) for draw in engine.draws} for engine in scene.engines}
    places = [_Place(swept, at, draw) for swept, at in scene.points() for draw in scene.start_draws(at)]
    for place, change, engine in product(places, changes, scene.engines):
        if change.reading is not None and change.reading not in scene.readings_of(engine):
            continue
        if change.twin_size is not None and not engine.twins:
            continue
        of_system = place.at | of_file
        z0, w0, seed = of_system.pop("z"), of_system.pop("w"), of_system.pop("seed")
        if w0 == BELT and isinstance(of_system["belt_speed"], float):
            w0 = of_system["belt_speed"]
        start_from = scene.ends if END in (z0, w0) else None
        parameters = tuple((name, of_system.pop(name)) for name in scene.system.parameters or ())
        of_system = dict.fromkeys(QUANTITIES) | of_system
        for draw, of_engine in words[engine].items():
            member = partial(
                Member,
                n=n,
                coupling=scene.system.coupling,
                **of_system,
                back_slip=None if scene.system.back_slip else "barred",
                parameters=parameters,
                origin=origin,
                perturbation_reading=change.reading,
                perturbation_size=change.size,
                perturbation_draw=change.draw,
                twin_size=change.twin_size,
                z0=z0,
                w0=w0,
                start_draw=place.start_draw,
                start_from=start_from,
                t_end=scene.run.t_end,
                seed=seed,
                engine=engine.name,
                settings=tuple(engine.settings.items()),
                ratio_draw=draw,
                picked_for=engine.picked_for,
            )
            cost = _shared_cost(scene, member(member_id="", matrix=0), engine)
            started = [] if start_from is None else [start_from.word]
            after = "-".join([*place.words, *started, *change.words, *of_engine])
            yield before, after, partial(member, shared_cost=cost)


def _shared_cost(scene: Scene, member: Member, engine: EngineTable) -> float:
    """A member's part of the unchanged run that it is compared with, and of its system's eigenvalues."""
    cost = 0.0
    copies = scene.n_changes(engine)
    if scene.record.separation is not None and (base := member.base) is not None:
        is_changed = base.ratio_draw == member.ratio_draw
        cost += base.cost / (copies if is_changed else len(engine.draws))
    if scene.record.energy and engine.engine.is_exact:
        cost += 10.0 * member.cost
    if scene.record.growth_rate:
        sharing = len(scene.engines) * len(engine.draws)
        cost += 1e-8 * member.n**3 / sharing
    return cost


@dataclass(frozen=True)
class _Place:
    """A point of the grid with a draw of the start: the swept keys, and all that may be."""

    swept: dict[str, Value]
    at: dict[str, Any]
    start_draw: int | None

    @cached_property
    def words(self) -> list[str]:
        drawn = [] if self.start_draw is None else [f"s{self.start_draw}"]
        return [*(f"{key}={word(value)}" for key, value in self.swept.items()), *drawn]


@dataclass(frozen=True)
class _Change:
    """How a member differs from the system and start of its matrix."""

    reading: str | None = None
    size: float = 0.0
    draw: int | None = None
    twin_size: float | None = None

    @property
    def words(self) -> list[str]:
        if self.reading is not None:
            return [f"{_READINGS[self.reading]}{short(self.size)}", f"d{self.draw}"]
        return [] if self.twin_size is None else [f"t{short(self.twin_size)}"]


def _words(engine: EngineTable, ratio_draw: int | None) -> list[str]:
    """An engine's words in a member's name."""
    words: list[str] = [engine.name]
    for name, value in engine.settings.items():
        about = engine.engine.settings()[name]
        if isinstance(about, Ratios):
            words.append("one" if ratio_draw is None else f"u{ratio_draw}")
        elif about.in_id is not None:
            words.append(about.in_id + short(value))
    return words


@dataclass(frozen=True, slots=True)
class Batch:
    """Consecutive members that are computed together and kept in one shard, `name`."""

    name: str
    members: tuple[Member, ...]

    @property
    def cost(self) -> float:
        """Estimated work, about seconds of one core."""
        return sum(member.cost for member in self.members)


def _sizes(members: Sequence[Member]) -> list[int]:
    """The numbers of members of the batches."""
    costs = [member.cost for member in members]
    rest = sum(costs)
    largest = min(max(TARGET_COST, rest / _MANY), _LARGER * TARGET_COST)
    sizes: list[int] = []
    room = -math.inf
    for cost in costs:
        if cost > room:
            sizes.append(0)
            room = min(largest, max(_OF_REST * rest, _SMALLEST * largest))
        sizes[-1] += 1
        room -= cost
        rest -= cost
    return sizes


def as_batch(number: int, members: tuple[Member, ...], scene_hash: str) -> Batch:
    """The batch of some members; `number` is its place among the dataset's shards."""
    content = "\n".join([scene_hash, *(member.member_id for member in members)])
    return Batch(f"shard-{number:05d}-{hashlib.sha256(content.encode()).hexdigest()[:12]}.parquet", members)


# ---------------------------------------------------------------------------------------------- shards

#: A shard to be: its members, and what to keep of them.
Task = tuple[Batch, Recording]


class PlanError(ValueError):
    """The members that are planned are not those of the scene."""


def tasks(scene: Scene, earlier: Sequence[str] = (), packing: Sequence[Sequence[int]] | None = None) -> list[Task]:
    """The shards of a dataset, in order.

    Parameters
    ----------
    scene : Scene
    earlier : sequence of str
        Sources of the scenes that it grew from, the first one first.
    packing : sequence of sequences of int
        For each of these and for `scene`: the number of members of each shard that it added; left out, as `pack`
        packs `scene` alone.

    Raises
    ------
    PlanError
        If the numbers are not those of the scenes' members, or an earlier scene cannot be read.
    """
    try:
        scenes = [*(parse_scene(source.encode(), folder=scene.folder) for source in earlier), scene]
    except SceneError as error:
        raise PlanError(str(error)) from error
    planned: list[Task] = []
    known: set[str] = set()
    packing = [pack(scene, known)] if packing is None else packing
    for stage, sizes in zip(scenes, packing, strict=True):
        new = added(stage, known)
        if sum(sizes) != len(new):
            raise PlanError(f"expected shards of {len(new)} members together, got {sum(sizes)}")
        rest, recording = iter(new), Recording.of(stage)
        for size in sizes:
            batch = as_batch(len(planned), tuple(islice(rest, size)), recording.scene_hash)
            planned.append((batch, recording))
        known.update(member.member_id for member in new)
    return planned


def added(scene: Scene, known: set[str]) -> list[Member]:
    """The members of a scene that are not yet known by their ids."""
    return [member for member in expand(scene) if member.member_id not in known]


def pack(scene: Scene, known: set[str]) -> tuple[int, ...]:
    """The number of members of each shard that a scene adds to the known members."""
    return tuple(_sizes(added(scene, known)))


def grows(stored: Scene, wanted: Scene) -> bool:
    """Whether all that the stored scene says holds for the wanted one too, which adds members and changes none."""
    one, other = Recording.of(stored), Recording.of(wanted)
    if one != replace(other, scene_hash=one.scene_hash) or wanted.n_members <= stored.n_members:
        return False
    members = {member.member_id: member for member in expand(wanted)}
    return all(members.get(member.member_id) == member for member in expand(stored))
