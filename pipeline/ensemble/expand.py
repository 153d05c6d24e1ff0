"""A scene expanded into its members."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import accumulate, groupby, product
from operator import eq
from typing import Any, overload

from stickslip.pipeline.ensemble.member import Change, Member, Method, Source, Start
from stickslip.pipeline.records.record import Sharing
from stickslip.pipeline.scene.quantity import BELT, END, FILE, Ratio, Value, short, word
from stickslip.pipeline.scene.scene import Scene
from stickslip.pipeline.scene.system_table import QUANTITIES, ForceTable
from stickslip.pipeline.scene.systems import SystemFile, SystemFunction
from stickslip.sim.systems.couplings import READINGS
from stickslip.sim.systems.terms import OF_BLOCKS

#: The readings of a perturbation in a member's name. Never change them: stored members have these names.
_READINGS: dict[str, str] = dict(zip(READINGS, "prc", strict=True))

#: The order of a member's terms, whatever a scene sweeps.
_TERMS = (*QUANTITIES, "back_slip", "force_blocks", "forces")

#: Kinds of members that are cached: each matrix goes through them again.
_KINDS = 4096


def expand(scene: Scene) -> Members:
    """All members of a scene, which caches them.

    Sorted by n, matrix, point of the grid, draw of the start, change (none first), engine (as in the file) and ratio
    draw.
    """
    if scene._members is None:
        everything = _Ensemble(scene)
        scene._members = Members(everything, range(len(everything)))
    return scene._members


class Members(Sequence[Member]):
    """Members of an ensemble, each made when it is asked for, or all before they are sent to another process.

    Slices and `at` select members of the same ensemble. Ids and costs are found without making a member.
    """

    def __init__(self, ensemble: _Ensemble | _Made, places: Sequence[int]) -> None:
        self._ensemble, self._places = ensemble, places

    @staticmethod
    def of(*members: Member) -> Members:
        """Members that exist already."""
        return Members(_Made(members), range(len(members)))

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, k: int) -> Member: ...
    @overload
    def __getitem__(self, k: slice) -> Members: ...
    def __getitem__(self, k: int | slice) -> Member | Members:
        if isinstance(k, slice):
            return Members(self._ensemble, self._places[k])
        return self._ensemble.member(self._places[k])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Members) and len(self) == len(other) and all(map(eq, self, other))

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Callable[..., Members], tuple[Member, ...]]:
        return Members.of, tuple(self)

    def at(self, which: Sequence[int]) -> Members:
        """The members at some places of this sequence."""
        return Members(self._ensemble, [self._places[k] for k in which])

    def ids(self) -> Iterator[str]:
        """The `member_id` of each."""
        return self._ensemble.ids(self._places)

    def costs(self) -> Iterator[float]:
        """The `cost` of each."""
        return self._ensemble.costs(self._places)

    def firsts(self) -> list[Member]:
        """The first member of each pair of an origin of systems and an engine."""
        firsts: dict[Hashable, Member] = {}
        for member in (some[0] for some in self.by_variant()):
            firsts.setdefault((member.source.origin, member.engine), member)
        return list(firsts.values())

    def by_variant(self) -> list[Members]:
        """Those that are run the same way, of systems from one source, together: they have one cost."""
        return [Members(self._ensemble, places) for places in self._ensemble.by_variant(self._places)]


class _Made:
    """Members that exist already, by number, with the methods of `_Ensemble`."""

    def __init__(self, members: tuple[Member, ...]) -> None:
        self._members = members

    def member(self, k: int) -> Member:
        return self._members[k]

    def ids(self, places: Sequence[int]) -> Iterator[str]:
        return (self._members[k].member_id for k in places)

    def costs(self, places: Sequence[int]) -> Iterator[float]:
        return (self._members[k].cost for k in places)

    def by_variant(self, places: Sequence[int]) -> Iterator[Sequence[int]]:
        return ([k] for k in places)


@dataclass(frozen=True)
class _Variant:
    """What is run of a matrix at a point of the grid: a change, an engine, a draw of its ratios."""

    change: Change
    method: Method
    sharing: Sharing
    words: tuple[str, ...]


class _Ensemble:
    """The members of a scene by number: source, matrix, point of the grid, draw of the start, variant."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.sources = scene.sources
        self.points = [_Point(swept, at) for swept, at in scene.points()]
        self.draws = [scene.start_draws(point.at) for point in self.points]
        self.ends = list(accumulate(map(len, self.draws)))
        self.variants = list(_variants(scene))
        self.kind = lru_cache(_KINDS)(self._kind)
        self.of_run = lru_cache(_KINDS)(self._of_run)

    def __len__(self) -> int:
        return len(self.sources) * self.scene.run.matrices * self.ends[-1] * len(self.variants)

    def _split(self, k: int) -> tuple[int, int, int, int]:
        """The numbers of a member's source, matrix, place (a point with a draw of the start) and variant."""
        rest, variant = divmod(k, len(self.variants))
        rest, place = divmod(rest, self.ends[-1])
        return *divmod(rest, self.scene.run.matrices), place, variant

    def member(self, k: int) -> Member:
        source, matrix, place, variant = self._split(k)
        kind, origin = self.kind(source, place, variant), self.sources[source][1]
        number = matrix if origin is None else origin.matrix(matrix)
        name = self._of_system(source, matrix) + self.of_run(place, variant)
        return replace(kind, member_id=name, source=kind.source._replace(matrix=number))

    def ids(self, places: Sequence[int]) -> Iterator[str]:
        """The `member_id` of each; the runs of a matrix are handled together."""
        n_variants, a_matrix = len(self.variants), self.ends[-1] * len(self.variants)
        for of_matrix, some in groupby(places, lambda k: k // a_matrix):
            system = self._of_system(*divmod(of_matrix, self.scene.run.matrices))
            for k in some:
                yield system + self.of_run(*divmod(k - of_matrix * a_matrix, n_variants))

    def costs(self, places: Sequence[int]) -> Iterator[float]:
        """The `cost` of each."""
        n_variants = len(self.variants)
        for source, some in groupby(places, lambda k: k // (n_variants * self.ends[-1] * self.scene.run.matrices)):
            of_variant = [self.kind(source, 0, variant).cost for variant in range(n_variants)]
            yield from (of_variant[k % n_variants] for k in some)

    def _of_system(self, source: int, matrix: int) -> str:
        """The first part of a member's name."""
        n, origin = self.sources[source]
        return f"n{n}-{'' if origin is None else origin.word + '-'}m{matrix:03d}"

    def _of_run(self, place: int, variant: int) -> str:
        """The rest of it."""
        point, draw = self._place(place)
        drawn = () if draw is None else (f"s{draw}",)
        ends = self.scene.ends
        started = () if ends is None or not point.is_at_end else (ends.word,)
        return "".join(f"-{word}" for word in (*point.words, *drawn, *started, *self.variants[variant].words))

    def by_variant(self, places: Sequence[int]) -> Iterator[Sequence[int]]:
        """The places of those with one source and one variant together, without going through all of a range."""
        n_variants, a_source = len(self.variants), self.ends[-1] * len(self.variants) * self.scene.run.matrices
        if not isinstance(places, range) or places.step != 1:
            found: dict[tuple[int, int], list[int]] = {}
            for k in places:
                found.setdefault((k // a_source, k % n_variants), []).append(k)
            yield from found.values()
            return
        for source in range(places.start // a_source, -(-places.stop // a_source)):
            begin, end = max(places.start, source * a_source), min(places.stop, (source + 1) * a_source)
            for k in range(begin, min(end, begin + n_variants)):
                yield range(k, end, n_variants)

    def _place(self, place: int) -> tuple[_Point, int | None]:
        k = bisect_right(self.ends, place)
        return self.points[k], self.draws[k][place - self.ends[k] + len(self.draws[k])]

    def _kind(self, source: int, place: int, variant: int) -> Member:
        """A member without its id and its matrix."""
        scene, (n, origin), chosen = self.scene, self.sources[source], self.variants[variant]
        point, draw = self._place(place)
        given = point.at | _of_file(origin)
        z0, w0, seed = given.pop("z"), given.pop("w"), given.pop("seed")
        if w0 == BELT and isinstance(given["belt_speed"], float):
            w0 = given["belt_speed"]
        given = {name: _multiplied(value, given) for name, value in given.items()}
        parameters = tuple((name, given.pop(name)) for name in scene.system.parameters or ())
        if not scene.system.back_slip:
            given["back_slip"] = "barred"
        given["forces"] = scene.system.pushes
        if isinstance(scene.system.force, ForceTable):
            given["force_blocks"] = scene.system.force.on_blocks
        terms = tuple((name, given[name]) for name in _TERMS if given.get(name) is not None)
        begin = Start(z0, w0, draw, scene.ends if point.is_at_end else None)
        of = Source(n, scene.system.coupling, 0, seed, origin, parameters)
        kind = Member("", of, terms, chosen.change, begin, chosen.method, scene.run.t_end)
        return replace(kind, shared_cost=sum(record.cost(kind, chosen.sharing) for record in scene.records))


def _multiplied(value: Any, given: Mapping[str, Any]) -> Any:
    """A ratio of one number to another as their product; anything else as it is."""
    if isinstance(value, Ratio) and isinstance(value.factor, float) and isinstance(given[value.of], float):
        return value.factor * given[value.of]
    return value


def _of_file(origin: SystemFile | SystemFunction | None) -> dict[str, Any]:
    """What a file gives in place of the scene."""
    if not isinstance(origin, SystemFile):
        return {}
    of_file: dict[str, Any] = {"kappa": origin.scale} | {name: FILE for name in OF_BLOCKS if name in origin.arrays}
    return of_file | ({"rho": None} if "damping" in origin.arrays else {})


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
            method = Method(engine.name, tuple(engine.settings.items()), draw, engine.picked_for)
            yield _Variant(change, method, sharing, (*_words_of(change), *engine.words(draw)))


class _Point:
    """A point of the grid: the value of all that may be swept, and the words of what is swept."""

    def __init__(self, swept: dict[str, Value], at: dict[str, Any]) -> None:
        self.at = at
        self.words = tuple(f"{key}={word(value)}" for key, value in swept.items())
        self.is_at_end = END in (at["z"], at["w"])


def _words_of(change: Change) -> list[str]:
    """A change's words in a member's name."""
    if change.reading is not None:
        return [f"{_READINGS[change.reading]}{short(change.size)}", f"d{change.draw}"]
    return [] if change.twin_size is None else [f"t{short(change.twin_size)}"]
