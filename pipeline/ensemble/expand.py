"""A scene expanded into its members."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

from stickslip.pipeline.ensemble.member import Change, Member, Method, Source, Start
from stickslip.pipeline.records.record import Sharing
from stickslip.pipeline.scene.engine_table import EngineTable
from stickslip.pipeline.scene.quantity import BELT, END, FILE, Value, short, word
from stickslip.pipeline.scene.scene import Scene
from stickslip.pipeline.scene.system_table import QUANTITIES
from stickslip.pipeline.scene.systems import SystemFile, SystemFunction
from stickslip.sim.engines.contract import Ratios
from stickslip.sim.systems.couplings import READINGS
from stickslip.sim.systems.terms import OF_BLOCKS

#: The readings of a perturbation in a member's name. The data hang on it too.
_READINGS: dict[str, str] = dict(zip(READINGS, "prc", strict=True))

#: In the order of a member's terms, whatever a scene sweeps.
_TERMS = (*QUANTITIES, "back_slip")


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
                source = member.source._replace(matrix=number)
                yield replace(member, member_id=f"{before}-m{matrix:03d}-{after}", source=source)


#: What stands in a member's id before its matrix, and after; and the member, but for its id and its matrix.
_Kind = tuple[str, str, Member]


def _kinds(scene: Scene, n: int, origin: SystemFile | SystemFunction | None) -> Iterator[_Kind]:
    """All that is run with each matrix of n blocks, or of a file or function, in order."""
    before = f"n{n}" if origin is None else f"n{n}-{origin.word}"
    of_file: dict[str, Any] = {}
    if isinstance(origin, SystemFile):
        of_file = {"kappa": origin.scale}
        of_file |= {name: FILE for name in OF_BLOCKS if name in origin.arrays}
        of_file |= {"rho": None} if "damping" in origin.arrays else {}
    changes = [Change()]
    if scene.perturbation is not None:
        table = scene.perturbation
        moves = product(table.readings, table.sizes, range(table.draws))
        changes += [Change(reading, size, draw) for reading, size, draw in moves]
    if scene.twins is not None:
        changes += [Change(twin_size=size) for size in scene.twins.sizes]
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
        parameters = tuple((name, of_system.pop(name)) for name in scene.system.parameters or ())
        if not scene.system.back_slip:
            of_system["back_slip"] = "barred"
        terms = tuple((name, of_system[name]) for name in _TERMS if of_system.get(name) is not None)
        begin = Start(z0, w0, place.start_draw, scene.ends if END in (z0, w0) else None)
        source = Source(n, scene.system.coupling, 0, seed, origin, parameters)
        for draw, of_engine in words[engine].items():
            method = Method(engine.name, tuple(engine.settings.items()), draw, engine.picked_for)
            member = Member("", source, terms, change, begin, method, scene.run.t_end)
            cost = _shared_cost(scene, member, engine)
            started = [] if begin.ends is None else [begin.ends.word]
            after = "-".join([*place.words, *started, *_words_of(change), *of_engine])
            yield before, after, replace(member, shared_cost=cost)


def _shared_cost(scene: Scene, member: Member, engine: EngineTable) -> float:
    """What records take beyond a member's run: its part of what is computed once for several."""
    sharing = Sharing(scene.n_changes(engine), len(engine.draws), len(scene.engines))
    return sum(record.cost(member, sharing) for record in scene.records)


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


def _words_of(change: Change) -> list[str]:
    """A change's words in a member's name."""
    if change.reading is not None:
        return [f"{_READINGS[change.reading]}{short(change.size)}", f"d{change.draw}"]
    return [] if change.twin_size is None else [f"t{short(change.twin_size)}"]


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
