"""A scene expanded into its members."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import accumulate, groupby, product
from operator import eq
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np

from stickslip.pipeline.design import design as designs
from stickslip.pipeline.design.design import Axis, Coordinates, Design, Unit, axis_of_numbers
from stickslip.pipeline.design.values import BELT, END, FILE, Distribution, Ratio, Value, short, word
from stickslip.pipeline.ensemble.member import Change, Member, Method, Neighbour, Source, Start
from stickslip.pipeline.records.record import Sharing
from stickslip.pipeline.records.refine import Refine
from stickslip.pipeline.scene.scene import Scene, parse_scene
from stickslip.pipeline.scene.source import REALISATION
from stickslip.pipeline.scene.system_table import QUANTITIES, ForceTable
from stickslip.pipeline.scene.systems import SystemFile, SystemFunction
from stickslip.sim.systems.couplings import READINGS
from stickslip.sim.systems.terms import OF_BLOCKS

_Number = TypeVar("_Number", int, np.ndarray)

#: The readings of a perturbation in a member's name. Never change them: stored members have these names.
_READINGS: dict[str, str] = dict(zip(READINGS, "prc", strict=True))

#: The order of a member's terms, whatever a scene sweeps.
_TERMS = (*QUANTITIES, "weakening_curve", "back_slip", "force_blocks", "forces", "drive_block", "contacts")

#: Kinds of members that are cached: each matrix goes through them again.
_KINDS = 4096


def expand(scene: Scene) -> Members:
    """All members of a scene, which caches them.

    Sorted by n, matrix, point of the grid, draw of the start, change (none first), engine (as in the file) and ratio
    draw.
    """
    if scene._members is None:
        everything = Ensemble(scene)
        scene._members = Members(everything, range(len(everything)))
    return scene._members


class Members(Sequence[Member]):
    """Members of an ensemble, each made when it is asked for, in whatever process.

    Slices and `at` select members of the same ensemble. Ids and costs are found without making a member.
    """

    def __init__(self, ensemble: Ensemble, places: Sequence[int]) -> None:
        self.ensemble, self._places = ensemble, places

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, k: int) -> Member: ...
    @overload
    def __getitem__(self, k: slice) -> Members: ...
    def __getitem__(self, k: int | slice) -> Member | Members:
        if isinstance(k, slice):
            return Members(self.ensemble, self._places[k])
        return self.ensemble.member(self._places[k])

    def __eq__(self, members: object) -> bool:
        return isinstance(members, Members) and len(self) == len(members) and all(map(eq, self, members))

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Callable[..., Members], tuple[str, Path, Sequence[int]]]:
        """Pickled as the scene and their numbers."""
        scene = self.ensemble.scene
        return _members, (scene.source, scene.folder.resolve(), self._places)

    def at(self, which: Sequence[int]) -> Members:
        """The members at some places of this sequence."""
        return Members(self.ensemble, [self._places[k] for k in which])

    def ids(self) -> Iterator[str]:
        """The `member_id` of each; the runs of a matrix are handled together."""
        ensemble = self.ensemble
        n_variants, a_matrix = ensemble.n_variants, ensemble.a_matrix
        for of_matrix, group in groupby(self._places, lambda k: k // a_matrix):
            system = ensemble.of_system(*divmod(of_matrix, ensemble.n_matrices))
            for k in group:
                yield system + ensemble.of_run(*divmod(k - of_matrix * a_matrix, n_variants))

    def costs(self) -> Iterator[float]:
        """The `cost` of each: that of its source and its variant at the first point."""
        ensemble = self.ensemble
        for source, group in groupby(self._places, lambda k: k // ensemble.a_source):
            of_variant: dict[int, float] = {}
            for variant in (k % ensemble.n_variants for k in group):
                if variant not in of_variant:
                    of_variant[variant] = ensemble.kind(source, 0, variant).cost
                yield of_variant[variant]

    @property
    def places(self) -> np.ndarray:
        """The numbers of each in the expansion of its scene, int64, shape (R,)."""
        return np.asarray(self._places, dtype=np.int64)

    def rows(self) -> Iterator[tuple[dict[str, Any], str, int, int | None]]:
        """The `row` of each, as one of its kind has it, and what is its own: name, matrix and draw of the start."""
        kinds: dict[tuple[int, int, int], dict[str, Any]] = {}
        for k, name in zip(self._places, self.ids(), strict=True):
            source, matrix, place, variant = self.ensemble.split(k)
            point, draw = self.ensemble.at(place)
            if (source, point, variant) not in kinds:
                kinds[source, point, variant] = self.ensemble.kind(source, point, variant).row()
            yield kinds[source, point, variant], name, self.ensemble.number_of(source, matrix), draw

    def firsts(self) -> list[Member]:
        """The first member of each pair of an origin of systems and an engine."""
        firsts: dict[Hashable, Member] = {}
        for member in (members[0] for members in self.by_variant()):
            firsts.setdefault((member.source.origin, member.engine), member)
        return list(firsts.values())

    def by_variant(self) -> Iterator[Members]:
        """Those that are run the same way, of systems from one source, together: they have one cost.

        Found without going through all of a range.
        """
        ensemble, places = self.ensemble, self._places
        n_variants, a_source = ensemble.n_variants, ensemble.a_source
        if not isinstance(places, range) or places.step != 1:
            groups: dict[tuple[int, int], list[int]] = {}
            for k in places:
                groups.setdefault((k // a_source, k % n_variants), []).append(k)
            yield from (Members(ensemble, group) for group in groups.values())
            return
        for source in range(places.start // a_source, -(-places.stop // a_source)):
            begin, end = max(places.start, source * a_source), min(places.stop, (source + 1) * a_source)
            for k in range(begin, min(end, begin + n_variants)):
                yield Members(ensemble, range(k, end, n_variants))


@lru_cache(maxsize=2)
def _ensemble(source: str, folder: Path) -> Ensemble:
    """The ensemble of a scene that came from another process."""
    return Ensemble(parse_scene(source, folder=folder))


def _members(source: str, folder: Path, places: Sequence[int]) -> Members:
    return Members(_ensemble(source, folder), places)


@dataclass(frozen=True)
class _Variant:
    """What is run of a matrix at a point of the grid: a change, an engine, a draw of its ratios."""

    change: Change
    method: Method
    sharing: Sharing
    words: tuple[str, ...]


class Ensemble:
    """Members of a scene by number: source, matrix, place (point with draw of the start), variant; their design."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.points = [_Point(swept, indices) for swept, indices in scene.points()]
        self.draws = [scene.start_draws(point.at) for point in self.points]
        self.ends = list(accumulate(map(len, self.draws)))
        self.variants = list(_variants(scene))
        self.sources, self.n_matrices = scene.sources, scene.run.matrices
        self.n_places, self.n_variants = self.ends[-1], len(self.variants)
        self.a_matrix = self.n_places * self.n_variants
        self.a_source = self.n_matrices * self.a_matrix
        self.kind = lru_cache(_KINDS)(self._kind)
        self.of_run = lru_cache(_KINDS)(self._of_run)

    def __len__(self) -> int:
        return len(self.sources) * self.a_source

    def split(self, k: _Number) -> tuple[_Number, _Number, _Number, _Number]:
        """The numbers of a member's source, matrix, place and variant; of several members as arrays."""
        return k // self.a_source, k // self.a_matrix % self.n_matrices, *divmod(k % self.a_matrix, self.n_variants)

    def member(self, k: int) -> Member:
        source, matrix, place, variant = self.split(k)
        point, draw = self.at(place)
        kind, name = self.kind(source, point, variant), self.of_system(source, matrix) + self.of_run(place, variant)
        system_source = kind.source._replace(matrix=self.number_of(source, matrix))
        begin = kind.begin if draw is None else kind.begin._replace(draw=draw)
        return replace(kind, member_id=name, source=system_source, begin=begin)

    def number_of(self, source: int, matrix: int) -> int:
        """The number of a system that a member says, by its source and its draw."""
        origin = self.sources[source][1]
        return matrix if origin is None else origin.matrix(matrix)

    def of_system(self, source: int, matrix: int) -> str:
        """The first part of a member's name."""
        n, origin = self.sources[source]
        return f"n{n}-{'' if origin is None else origin.word + '-'}m{matrix:03d}"

    @cached_property
    def unit(self) -> Unit:
        """What is independent where the start is drawn; elsewhere that is no start."""
        n_systems, n_starts = self.n_matrices * (int(self._seed.max()) + 1), max(map(len, self.draws))
        of_points = [(n, self._of_file(origin)) for n, origin in self.sources]
        if self._of_files and len({*of_points}) < len(of_points):  # files are realisations of one point
            return Unit.FILE
        if n_systems > 1:
            return Unit.MATRIX
        return Unit.START if n_starts > 1 else Unit.FILE if self.scene.system.is_of_files else Unit.MATRIX

    @cached_property
    def design(self) -> Design:
        """What its members were made to differ in."""
        fixed = [k for k, draws in zip(self._grid.tolist(), self.draws, strict=True) if None in draws]
        n_grid, n_of_files = (math.prod(len(axis.rows) for axis in axes) for axes in (self._axes, self._of_files))
        return Design(
            (*self._of_files, *self._axes),
            tuple(self._constants),
            tuple(dict.fromkeys(self._origins)),
            frozenset(n_grid * j + k for j in range(n_of_files) for k in fixed if self.unit is Unit.START),
            tuple(dict.fromkeys(map(_method, self.variants))),
            tuple(dict.fromkeys(map(_change, self.variants))),
        )

    @cached_property
    def _of_files(self) -> tuple[Axis, ...]:
        """An axis for each number that the files carry, but that of their realisations."""
        parameters = [origin.facts.parameters for _, origin in self.sources if isinstance(origin, SystemFile)]
        names = [name for name in (parameters[0] if parameters else ()) if name != REALISATION]
        return tuple(
            Axis((name,), tuple((x,) for x in sorted({numbers[name] for numbers in parameters}))) for name in names
        )

    def _of_file(self, origin: SystemFile | SystemFunction | None) -> tuple[int, ...]:
        """The place of a file on each of its axes."""
        parameters = origin.facts.parameters if isinstance(origin, SystemFile) else {}
        return tuple(axis.rows.index((parameters[axis.keys[0]],)) for axis in self._of_files)

    @property
    def _constants(self) -> Iterator[tuple[str, Value]]:
        """The keys that are not swept, and what files have in their place."""
        arrays = {
            name for _, origin in self.sources if isinstance(origin, SystemFile) for name in origin.facts.arrays
        }
        for key, value in self.scene.quantities.items():
            if key in arrays and value is None:
                yield key, FILE
            elif value is not None and not isinstance(value, tuple):
                yield key, value

    @property
    def _origins(self) -> list[designs.Source]:
        """What of each source separates points: files that are units are realisations of one point."""
        files = [origin.name if isinstance(origin, SystemFile) else None for _, origin in self.sources]
        files = [None] * len(files) if self.unit is Unit.FILE or self._of_files else files
        return [designs.Source(n, file, self.unit) for (n, _), file in zip(self.sources, files, strict=True)]

    @cached_property
    def _axes(self) -> tuple[Axis, ...]:
        """Those of the scene, without seeds."""
        unseeded = [[k for k, key in enumerate(axis.keys) if key != "seed"] for axis in self.scene.axes]
        return tuple(
            Axis(tuple(axis.keys[k] for k in columns), tuple(tuple(row[k] for k in columns) for row in axis.rows))
            for axis, columns in zip(self.scene.axes, unseeded, strict=True)
            if columns
        )

    @cached_property
    def _grid(self) -> np.ndarray:
        """The number of each point of the scene's grid on that of the design, which has no axis of seeds."""
        shape = (1, *(len(axis.rows) for axis in self.scene.axes))
        places = np.unravel_index(np.arange(len(self.points)), shape)
        unseeded = [k for k, axis in enumerate(((), *(axis.keys for axis in self.scene.axes))) if axis != ("seed",)]
        return np.ravel_multi_index([places[k] for k in unseeded], [shape[k] for k in unseeded])

    @cached_property
    def _seed(self) -> np.ndarray:
        """The number of the seed at each point of the scene's grid."""
        seeds = self.scene.run.seed if isinstance(self.scene.run.seed, tuple) else (self.scene.run.seed,)
        return np.array([seeds.index(point.at["seed"]) for point in self.points])

    @cached_property
    def _matrices(self) -> np.ndarray:
        """The number of each system, by its source, if that is a file, and by its draw."""
        draws = range(self.n_matrices)
        files = [origin for _, origin in self.sources if isinstance(origin, SystemFile)]
        if self.unit is Unit.FILE:  # whatever is drawn of one
            numbers = [file.matrix(0) if file.realisation is None else file.realisation for file in files]
            return np.repeat(np.array(numbers)[:, None], self.n_matrices, axis=1)
        return np.array([[file.matrix(k) for k in draws] for file in files] or [[*draws]])

    def coordinates(self, places: np.ndarray) -> Coordinates:
        """Where members stand in the design, by their numbers, shape (R,)."""
        design = self.design
        source, matrix, place, variant = self.split(places)
        point, draw = self.start_of(place)
        grid = self._grid[point]
        shape = (len(design.sources), *(len(axis.rows) for axis in self._of_files))
        of_files = [self._of_file(origin) for _, origin in self.sources]
        places_of = zip(_numbers(design.sources, self._origins), of_files, strict=True)
        group = np.ravel_multi_index(
            np.array([(number, *places_on_axes) for number, places_on_axes in places_of]).T, shape
        )[source]
        matrices = self._matrices
        unit = matrices[source % len(matrices), matrix]
        unit = unit if self.unit is Unit.FILE else unit + self.n_matrices * self._seed[point]
        if self.unit is Unit.START:
            # files whose draws have one number share their starts
            n_files, n_draws = (len(matrices) if self._of_files else 1), max(map(len, self.draws))
            numbers = matrices[:n_files, 0].tolist()
            file = _numbers([*dict.fromkeys(numbers)], numbers)[source % n_files]
            is_fixed = np.isin(grid, [*design.fixed])
            unit = np.where(is_fixed, n_draws * n_files + file, n_draws * file + draw)
        unchanged = {
            of_variant.method: k for k, of_variant in enumerate(self.variants) if of_variant.change == Change()
        }
        base = np.array([unchanged[of_variant.method] for of_variant in self.variants])
        return Coordinates(
            group * math.prod(design.shape[len(shape) :]) + grid,
            unit,
            _numbers(design.methods, map(_method, self.variants))[variant],
            _numbers(design.changes, map(_change, self.variants))[variant],
            places - variant + base[variant],
        )

    @property
    def firsts(self) -> np.ndarray:
        """The place of one member of each source, point of the scene's grid and variant."""
        sources, variants = np.arange(len(self.sources)), np.arange(self.n_variants)
        points = np.array([0, *self.ends[:-1]])
        systems = sources[:, None, None] * self.n_matrices
        return ((systems * self.n_places + points[:, None]) * self.n_variants + variants).ravel()

    def places_of(self, ensemble: Ensemble) -> np.ndarray:
        """The places here of the members of another scene, in the order of theirs.

        Raises `KeyError` if one is not here.
        """
        source, matrix, place, variant = ensemble.split(np.arange(len(ensemble)))
        sources, points, variants = map(_numbers, self._words, ensemble._words)
        point, draw = ensemble.start_of(place)
        firsts = np.array([0, *self.ends])
        place = firsts[points[point]] + draw
        if ensemble.n_matrices > self.n_matrices or (place >= firsts[points[point] + 1]).any():
            raise KeyError("matrices or draws of the start")
        systems = sources[source] * self.n_matrices + matrix
        return (systems * self.n_places + place) * self.n_variants + variants[variant]

    def start_of(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The point of the scene's grid of some places, and the number of the draw of the start."""
        point = np.searchsorted(self.ends, place, side="right")
        return point, place - np.array([0, *self.ends])[point]

    @property
    def _words(self) -> tuple[Sequence[Hashable], ...]:
        """What stands for each source, point and variant in the names of members."""
        sources = [self.of_system(source, 0) for source in range(len(self.sources))]
        return sources, [point.words for point in self.points], [variant.words for variant in self.variants]

    def at(self, place: int) -> tuple[int, int | None]:
        """The point of a place, and the draw of the start."""
        k = bisect_right(self.ends, place)
        return k, self.draws[k][place - self.ends[k] + len(self.draws[k])]

    def _of_run(self, place: int, variant: int) -> str:
        """The last part of a member's name."""
        number, draw = self.at(place)
        point = self.points[number]
        draw_word = () if draw is None else (f"s{draw}",)
        ends = self.scene.ends
        started = () if ends is None or not point.is_at_end else (ends.word,)
        return "".join(f"-{word}" for word in (*point.words, *draw_word, *started, *self.variants[variant].words))

    def _kind(self, source: int, number: int, variant: int) -> Member:
        """A member without its id, its matrix and the draw of its start."""
        scene, (n, origin), chosen = self.scene, self.sources[source], self.variants[variant]
        point = self.points[number]
        z0, w0, seed, terms, parameters = self._values(source, number)
        begin = Start(z0, w0, None, scene.ends if point.is_at_end else None)
        system_source = Source(n, scene.system.coupling, 0, seed, origin, parameters, scene.system.block_names)
        t_end, scales = scene.time(scene.run.t_end), scene.scales
        kind = Member("", system_source, terms, chosen.change, begin, chosen.method, t_end, units=scales)
        if scene.keeps(Refine):
            below, above = (self._neighbour(source, number, step) for step in (-1, 1))
            kind = replace(kind, neighbours=(below, above))
        return replace(kind, shared_cost=sum(record.cost(kind, chosen.sharing) for record in scene.records))

    def _neighbour(self, source: int, number: int, step: int) -> Neighbour | None:
        """The point of the grid a step along the axis that is refined; None beyond its ends."""
        axes = self.scene.axes
        axis = axis_of_numbers(axes)
        assert axis is not None  # or the record refuses the scene
        shape, along = tuple(len(swept.rows) for swept in axes), axes.index(axis)
        place = [int(k) for k in np.unravel_index(number, shape)]
        k = place[along]
        if not 0 <= k + step < shape[along]:
            return None
        place[along] += step
        *_, terms, parameters = self._values(source, int(np.ravel_multi_index(place, shape)))
        assert axis.x is not None
        return Neighbour((axis.x[k], axis.x[k + step]), terms, parameters)

    def _values(self, source: int, number: int) -> tuple[Any, Any, int, tuple[Any, ...], tuple[Any, ...]]:
        """The start, the seed, the terms and the parameters of systems from a source at a point of the grid."""
        scene, origin = self.scene, self.sources[source][1]
        values_here = self.points[number].at | _of_file(origin)
        z0, w0, seed = values_here.pop("z"), values_here.pop("w"), values_here.pop("seed")
        system, belt = scene.system, values_here["belt_speed"]
        is_plain = system.drive is None and system.contacts is None and _all_rub(values_here["friction"])
        if w0 == BELT and isinstance(belt, float) and is_plain:
            w0 = belt
        values_here = {name: _multiplied(value, values_here) for name, value in values_here.items()}
        parameters = tuple((name, values_here.pop(name)) for name in scene.system.parameters or ())
        parameters += tuple(origin.facts.parameters.items()) if isinstance(origin, SystemFile) else ()
        if scene.system.weakening is not None:
            values_here["weakening_curve"] = scene.system.weakening.curve
        if not scene.system.back_slip:
            values_here["back_slip"] = "barred"
        values_here["forces"] = scene.system.pushes
        if isinstance(scene.system.force, ForceTable):
            values_here["force_blocks"] = scene.system.force.on_blocks
        if system.drive is not None:
            values_here["drive_block"] = system.drive.block
        values_here["contacts"] = system.rubbing
        terms = tuple((name, scene.placed(values_here[name])) for name in _TERMS if values_here.get(name) is not None)
        return z0, w0, seed, terms, parameters


def _numbers(listed_values: Sequence[Hashable], values: Iterable[Hashable]) -> np.ndarray:
    """The place of each value among those that are known."""
    place = {value: k for k, value in enumerate(listed_values)}
    return np.array([place[value] for value in values])


def _method(variant: _Variant) -> designs.Method:
    return designs.Method(variant.method.engine, variant.method.settings)


def _change(variant: _Variant) -> designs.Change:
    change = variant.change
    if change.twin_size is not None:
        return designs.Change(designs.Kind.START, None, change.twin_size)
    if change.reading is not None:
        return designs.Change(designs.Kind.CONSTANTS, change.reading, change.size)
    return designs.Change()


def _all_rub(friction: Value | None) -> bool:
    """Whether each block has friction, as far as the scene says; a file or a function may give some blocks none."""
    return isinstance(friction, Distribution) or (isinstance(friction, float) and friction > 0.0)


def _multiplied(value: Any, numbers: Mapping[str, Any]) -> Any:
    """A ratio of one number to another as their product; anything else as it is."""
    if isinstance(value, Ratio) and isinstance(value.factor, float) and isinstance(numbers[value.of], float):
        return value.factor * numbers[value.of]
    return value


def _of_file(origin: SystemFile | SystemFunction | None) -> dict[str, Any]:
    """What a file gives in place of the scene."""
    if not isinstance(origin, SystemFile):
        return {}
    of_file: dict[str, Any] = {name: FILE for name in OF_BLOCKS if name in origin.facts.arrays}
    if not origin.is_graph:
        of_file["kappa"] = origin.facts.scale
    return of_file | ({"rho": None} if "damping" in origin.facts.arrays else {})


def _variants(scene: Scene) -> Iterator[_Variant]:
    """All that is run of a matrix at a point of the grid, in order."""
    changes = [Change()]
    if scene.perturbation is not None:
        table = scene.perturbation
        moves = product(table.readings, table.sizes, range(table.draws))
        changes += [Change(reading, size, draw) for reading, size, draw in moves]
    if scene.twins is not None:
        changes += [Change(twin_size=size) for size in scene.twins.sizes]
    for change, engine in product(changes, scene.engines):
        if change.reading is not None and change.reading not in scene.readings_of(engine):
            continue
        if change.twin_size is not None and not engine.twins:
            continue
        sharing = Sharing(scene.n_changes(engine), len(engine.draws), len(scene.engines))
        for draw in engine.draws:
            settings = tuple(engine.settings.items())
            method = Method(engine.name, settings, draw, engine.picked_for, scene.run.load)
            yield _Variant(change, method, sharing, (*_words_of(change), *engine.words(draw)))


class _Point:
    """A point of the grid: the value of all that may be swept, and the words of what is swept."""

    def __init__(self, swept: dict[str, Value], values_here: dict[str, Any]) -> None:
        self.at = values_here
        self.words = tuple(f"{key}={word(value)}" for key, value in swept.items())
        self.is_at_end = END in (values_here["z"], values_here["w"])


def _words_of(change: Change) -> list[str]:
    """A change's words in a member's name."""
    if change.reading is not None:
        return [f"{_READINGS[change.reading]}{short(change.size)}", f"d{change.draw}"]
    return [] if change.twin_size is None else [f"t{short(change.twin_size)}"]
