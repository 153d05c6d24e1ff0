"""The scene file: which ensemble, run how, kept and analysed how.

All quantities are dimensionless.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field, PrivateAttr, model_validator

from stickslip.pipeline.design.design import Axis, axis_of_numbers
from stickslip.pipeline.design.units import DIMENSIONLESS, Units
from stickslip.pipeline.design.values import (
    BELT,
    END,
    FILE,
    Course,
    Distribution,
    Measured,
    Pushes,
    Quantity,
    Ratio,
    Value,
    as_written,
    lowest,
    size,
    values,
)
from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.own.function import OwnFunction, resolve
from stickslip.pipeline.records import RECORDS
from stickslip.pipeline.records.own import OwnRecord, look_at_functions, named_functions
from stickslip.pipeline.records.record import Facts, Record, WindowRecord
from stickslip.pipeline.scene.columns import OF_GRAPHS, OF_SETTINGS, PARTS, Recording, misnamed
from stickslip.pipeline.scene.ends import Ends, look_at_dataset, place_beside
from stickslip.pipeline.scene.engine_table import Engines, EngineTable
from stickslip.pipeline.scene.grid import axes
from stickslip.pipeline.scene.meaning import meaning
from stickslip.pipeline.scene.source import parse_toml, read_source
from stickslip.pipeline.scene.system_table import OF_FILES, OF_GRAPH, SystemTable, is_function
from stickslip.pipeline.scene.systems import (
    KEY,
    FilePart,
    SystemFile,
    SystemFunction,
    is_path,
    located,
    look_at_files,
    look_at_series,
    read,
    read_friction_table,
    tried_function,
)
from stickslip.pipeline.scene.tables import AnalysisTable, PerturbationTable, RecordTable, RunTable, Start, TwinsTable
from stickslip.pipeline.scene.toml import Positive, StrictTable, as_scene, explained, optional, plain, shown, written
from stickslip.pipeline.scene.units import UNSCALED, UnitsTable, scales_of
from stickslip.sim.engines.adiabatic import TAKES as LOADABLE
from stickslip.sim.engines.contract import Purpose
from stickslip.sim.numerics.arguments import apart
from stickslip.sim.systems.couplings import Reading, draw_system
from stickslip.sim.systems.scales import Scales
from stickslip.sim.systems.system import BEYOND, System
from stickslip.sim.systems.terms import TERMS
from stickslip.sim.systems.weakening import LAWS

#: Of keys of [system] that are called otherwise among what a system may have beyond eq. (10).
_BEYOND_OF = {"rayleigh": "damping matrix", "drive": "force"}
#: A scene of more members than this is run if the user says yes: else that is taken for a typing error.
MANY_MEMBERS = 10_000_000

#: Lists may not span a grid of more points than this, nor may a start be run more often, nor a series in time have
#: more values: these are gone through one by one.
MAX_POINTS = MAX_RUNS = MAX_SAMPLES = 10_000_000

#: What a scene says of its own cost, an ensemble's or a chart's.
MINUTES = "what it took on two cores with its report, in minutes: `stickslip scenes` shows it"

#: Keys without influence on the data.
_WORDS = {"title", "about", "licence", "minutes", "analysis"}

#: Keys of [record] that are times.
_TIMES = ("t_burn", "dt", "separation")

#: Records as old as the oldest datasets. At its default the key of any other is no part of a scene's hash, so that a
#: record that comes into being leaves datasets what they are; so it is with `back_slip`.
_OLDEST_RECORDS = {"events", "growth_rate"}


class Scene(StrictTable):
    """A scene: everything that determines an ensemble's data, and what to make of them."""

    title: str = Field(default="", description="one line for the report's head")
    about: str = Field(default="", description="what the scene is for")
    licence: str = Field(default="", description="licence of the data, which they carry", examples=["CC-BY-4.0"])
    minutes: Positive | None = optional(MINUTES, 1.0)
    system: SystemTable
    units: UnitsTable | None = optional("the units that its numbers are in; all is dimensionless if left out")
    start: Start = Field(description='the state that runs start from; "rest": z = 0, and w as the belt')
    run: RunTable
    engines: Engines = Field(alias="engine", description="one or more tables [[engine]]")
    perturbation: PerturbationTable | None = None
    twins: TwinsTable | None = None
    record: RecordTable = RecordTable()
    analysis: AnalysisTable
    _source: str | None = PrivateAttr(default=None)
    _folder: Path = PrivateAttr(default=Path())
    _members: Any = PrivateAttr(default=None)  # as `pipeline.ensemble.expand` gives them

    def __init__(self, **tables: Any) -> None:
        """A scene from its tables, as a file has them; files that it names are looked for in the working directory.

        Raises `SceneError` if they are no scene; one line a problem.
        """
        tables = plain(tables)
        with explained(type(self), ""):
            super().__init__(**_merged(tables, _look(tables, Path(), "")))

    def changed(self, **tables: Any) -> Scene:
        """A copy with other keys, as in ``scene.changed(run={"t_end": 50.0})``; None leaves a key out.

        Keys of a table that are not given stay; engines are given as a whole.

        Raises
        ------
        SceneError
            If that is no scene; one line a problem.
        """
        tables_here = self.model_dump(mode="json", by_alias=True, exclude_unset=True)
        tables_here["system"] = {
            key: value for key, value in tables_here["system"].items() if key not in ("files", "module")
        }
        tables_here["start"] = {key: value for key, value in tables_here["start"].items() if key != "ends"}
        tables_here.get("record", {}).pop("functions", None)
        if tables.get("units"):  # other units have other scales
            tables_here.pop("units", None)
        for name, changes in tables.items():
            old = tables_here.get(name)
            tables_here[name] = {**old, **changes} if isinstance(old, dict) and isinstance(changes, dict) else changes
        tables_here = plain(tables_here)
        with explained(type(self), ""):
            scene = type(self).model_validate(_merged(tables_here, _look(tables_here, self._folder, "")))
        scene._folder = self._folder
        return scene

    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]  # `as_scene` goes another way

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as its source: the classes of its tables are made when they are loaded, and have no names."""
        return parse_scene, (self.source, "scene", self._folder)

    @property
    def source(self) -> str:
        """The text of the scene as a file: the one that it was read from, or one written from what it was made of."""
        if self._source is not None:
            return self._source
        return written(self.model_dump(mode="json", by_alias=True, exclude_unset=True))

    @property
    def from_source(self) -> Scene:
        """The scene as its `source` gives it: itself if it was read from there.

        Raises `ValueError` if its source is that of other data.
        """
        if self._source is not None:
            return self
        scene = parse_scene(self.source, "source", self._folder)
        if scene.hash != self.hash:
            raise ValueError(
                f"source: expected the file of the scene (hash {self.hash[:12]}), got that of another (hash "
                f"{scene.hash[:12]}); write the scene as a file"
            )
        return scene

    @property
    def purpose(self) -> Purpose:
        """What the scene asks to know; if it does not say, paths if it keeps events or has runs to compare."""
        asks_paths = any(record.is_of_paths for record in self.records)
        asks_paths = asks_paths or self.perturbation is not None or self.twins is not None
        return self.run.purpose or ("paths" if asks_paths else "statistics")

    @property
    def records(self) -> tuple[Record, ...]:
        """What is kept of a run, in addition to n_stick."""
        keys = self.record.model_dump() | {"t_burn": self.record_t_burn, "folder": self._folder}
        keys |= {name: self.time(keys[name]) for name in _TIMES if keys[name] is not None}
        keys |= {"names": self.system.block_names, "load": self.run.load}
        settings = {name: value for engine in self.engines for name, value in engine.settings.items() if value}
        return tuple(chosen for record in RECORDS if (chosen := record.asked(keys, settings)) is not None)

    @property
    def records_in_order(self) -> list[Record]:
        """`records`, in the order in which the scene asks for them."""
        names = [*parse_toml(self.source, "scene").get("record", {})]
        return sorted(
            self.records, key=lambda record: names.index(record.name) if record.name in names else len(names)
        )

    @property
    def record_t_burn(self) -> float:
        """From when on records measure that leave out the start."""
        return self.analysis.t_burn if self.record.t_burn is None else self.record.t_burn

    @property
    def recording(self) -> Recording:
        """What its datasets keep."""
        words = meaning(self.system, self.run.seed, self.run.load)
        return Recording(self.hash, self.parts, self.records, self.parameters, self.unit_names, self.scales, words)

    @property
    def unit_names(self) -> Units:
        """The units that it is in; none if it is dimensionless."""
        return DIMENSIONLESS if self.units is None else self.units.units

    @property
    def scales(self) -> Scales | None:
        """What one dimensionless unit is in its units; None if it is dimensionless."""
        return None if self.units is None else self.units.sizes

    def time(self, measured: float) -> float:
        """A time of the scene, dimensionless."""
        return measured if self.scales is None else measured / self.scales.time

    @property
    def parameters(self) -> tuple[str, ...]:
        """The numbers that a function of the user's is given, or that its files carry, by name."""
        return tuple(
            self.system.parameters or next((file.parameters for file in self.system.known_files.values()), ())
        )

    def keeps(self, record: type[Record]) -> bool:
        """Whether a record is asked for."""
        return any(isinstance(kept_record, record) for kept_record in self.records)

    @property
    def parts(self) -> tuple[str, ...]:
        """Which of `pipeline.scene.columns.PARTS` its datasets have."""
        system, quantities = self.system, self.system.quantities
        several = isinstance(system.force, tuple) or any(force.blocks for force in system.forces)
        draws = (value for quantity in self.quantities.values() for value in values(quantity) if value != BELT)
        in_files = any(file.arrays for file in system.known_files.values())
        conditions = {
            "file": system.is_of_files,
            "long_matrix": any(file.version > 1 for file in system.known_files.values()),
            "function": system.is_own,
            "damping": in_files,
            "belts": any(not isinstance(value, float) for value in values(system.belt_speed))
            or in_files
            or system.drive is not None
            or system.contacts is not None,
            "force": system.force is not None,
            "load": self.run.load is not None,
            "back_slip": not system.back_slip,
            "drawn": any(not isinstance(draw, float) for draw in draws) or in_files or several,
            **{name: any(name in engine.settings for engine in self.engines) for name in OF_SETTINGS},
        }
        of_terms = {term.part for term in TERMS if term.part and quantities.get(term.name) is not None}
        return tuple(name for name in PARTS if conditions.get(name) or name in of_terms)

    @model_validator(mode="after")
    def _consistent(self) -> Scene:
        # frozen for everybody else: a scene that exists has all its tolerances
        object.__setattr__(self, "engines", tuple(engine.complete(self.purpose) for engine in self.engines))
        words_of = [engine.words(engine.draws[0]) for engine in self.engines]
        for i, words in enumerate(words_of):
            if words in words_of[:i]:
                raise ValueError(
                    f"engine[{i}]: expected settings that give its members other names than those of"
                    f" engine[{words_of.index(words)}], got none; remove it, put both into one table, or change eps"
                    " or a tolerance"
                )
        for table, t_burn in (("analysis", self.analysis.t_burn), ("record", self.record_t_burn)):
            if t_burn >= self.run.t_end:
                raise ValueError(
                    f"{table}.t_burn: expected less than run.t_end = {self.run.t_end}, "
                    f"got {t_burn}; shorten the burn-in or lengthen the runs"
                )
        readings = self.perturbation.readings if self.perturbation is not None else ()
        allowed = self.system.readings
        if set(readings) - set(allowed):
            remedy = f"write readings = {json.dumps(allowed)}" if allowed else "remove [perturbation]"
            also = [f"`{key}`" for key in ("damping", "rayleigh") if getattr(self.system, key) is not None]
            what = " with ".join([f'coupling = "{self.system.coupling}"', *also])
            raise ValueError(
                f"perturbation.readings: expected those that keep what {what} is,"
                f" {json.dumps(allowed)}, got {json.dumps(readings)}; {remedy}"
            )
        for key, array in (("z", "z0"), ("w", "w0")):
            lacking = [name for name, file in self.system.known_files.items() if array not in file.arrays]
            if getattr(self.start, key) == FILE and (lacking or not self.system.is_of_files):
                where = lacking[0] if lacking else f'coupling = "{self.system.coupling}"'
                raise ValueError(
                    f"start.{key}: expected a file with the array `{array}`, got {where} without; write a number"
                )
        try:
            n_points = math.prod(len(axis.rows) for axis in self.axes)
        except ValueError as error:
            raise ValueError(f"run.zip: {error}") from None
        self._changes_apply()
        self._steps_and_changes_are_resolved()
        if n_points > MAX_POINTS:
            raise ValueError(f"lists: expected a grid of at most {MAX_POINTS} points, got {n_points}; shorten some")
        if self._n_runs > MAX_RUNS:
            raise ValueError(
                f"engine.ratio_draws, perturbation.draws: expected at most {MAX_RUNS} runs of a start (perturbations "
                f"x engines x ratios), got {self._n_runs}; lower the number of draws"
            )
        self._static_holds()
        self._names_are_columns()
        return self

    def _static_holds(self) -> None:
        """Static friction is at least the kinetic at every point of the grid; for files and functions, runs tell."""
        weakening = self.system.weakening
        first = weakening.coefficients[0] if weakening is not None and weakening.coefficients else 1.0
        for _, values_here in self.points() if self.system.static is not None else ():
            static, kinetic = values_here["static"], values_here["friction"]
            if (
                static is not None
                and not isinstance(static, Ratio)
                and kinetic is not None
                and lowest(static) < size(kinetic) * first
            ):
                raise ValueError(
                    f"system.static: expected at least the kinetic friction at each point of the grid, got {static}"
                    f" with friction = {kinetic}; raise it, or name both in `zip`, whose lists go together"
                )

    def _names_are_columns(self) -> None:
        """Each parameter of a function, each field that one returns, and each record of a block is a column."""
        parameters = self.parameters
        of_blocks = [
            column.name
            for record in self.records
            if isinstance(record, WindowRecord) and record.blocks
            for column in record.kept
        ]
        fields = [field for function in self.record.own_functions.values() for field in function.columns]
        for key, clash, where in (
            (
                "system.parameters",
                misnamed([name for name in parameters if name not in OF_GRAPHS]),
                "here and in the function",
            ),
            ("record.own", misnamed(fields, parameters, "another field"), "in the module"),
            ("system.names", misnamed(of_blocks, (*parameters, *fields)), "and in [record]"),
        ):
            if clash is not None:
                raise ValueError(
                    f"{key}: expected names for columns of their own, got {shown(clash[0])}: {clash[1]}; choose"
                    f" another, {where}"
                )

    def check_engines(self) -> None:
        """Refuse engines that cannot run what the scene asks; for a file or a function, its runs tell.

        Called before a scene is run, not when it is read: data with members that failed so can still be read. Raises
        `SceneError` if one cannot.
        """
        system, quantities = self.system, self.system.quantities
        pushes = [push for force in system.forces for push in (force.amplitude, force.course) if push is not None]
        belts = [
            value
            for value in values(quantities["belt_speed"])
            if isinstance(value, Distribution) or (isinstance(value, Course) and len(set(value.values)) > 1)
        ]
        forces = [force.model_dump(exclude_none=True) for force in system.forces] if any(map(size, pushes)) else None
        optional_terms = [term.name for term in TERMS if term.is_argument and term.default is None]
        demands = (
            ("force", forces and (forces if isinstance(system.force, tuple) else forces[0]), "none"),
            ("belt_speed", belts[0] if belts else None, "one number for all blocks and times"),
            ("rayleigh", system.rayleigh, "none"),
            ("drive", system.drive, "none"),
            ("weakening", system.weakening, "none"),
            ("back_slip", None if system.back_slip else "false", "true"),
            *((name, quantities[name], "none") for name in optional_terms),
        )
        if self.run.load is not None:
            self._check_load(demands)
        for i, engine in enumerate(self.engines):
            if self.run.load is not None and not engine.engine.is_exact:
                raise SceneError(
                    f'engine[{i}]: expected one of the exact law with load = "{self.run.load}", got "{engine.name}";'
                    " remove it, or `load`"
                )
            for key, demand, expected in demands:
                beyond = _BEYOND_OF.get(key, key)
                if demand is not None and beyond in BEYOND and beyond not in engine.engine.taken():
                    got = demand.model_dump(exclude_none=True) if isinstance(demand, BaseModel) else demand
                    raise SceneError(
                        f'system.{key}: expected {expected}, all that [[engine]] name = "{engine.name}" takes, got'
                        f" {got}; change it, or remove that engine"
                    )

    def _check_load(self, demands: Sequence[tuple[str, Any, str]]) -> None:
        """Refuse what a belt that waits cannot load; for a file or a function, its runs tell."""
        system, where = self.system, f'with load = "{self.run.load}"'
        for key, demand, expected in demands:
            beyond = _BEYOND_OF.get(key, key)
            if demand is not None and beyond in BEYOND and beyond not in LOADABLE:
                raise SceneError(f"system.{key}: expected {expected} {where}, got one; remove it, or `load`")
        law = system.weakening
        if law is not None and law.law in LAWS and LAWS[law.law].falls_from_static:
            raise SceneError(
                f"system.weakening: expected a law that begins below static friction {where}, got {law.law}, by which"
                " blocks creep after the belt, in no event; choose another, or remove `load`"
            )
        is_given = not (system.is_of_files or system.is_own)
        first = law.coefficients[0] if law is not None and law.coefficients else 1.0
        for _, values_here in self.points():
            static, kinetic = values_here["static"], values_here["friction"]
            came = str(static or "none")
            if isinstance(static, Ratio) and isinstance(static.factor, float):
                came = f"{static.factor:g} times it"
                static, kinetic = static.factor, 1.0
            are_equal = isinstance(static, float) and isinstance(kinetic, float) and static <= kinetic * first
            if are_equal or (static is None and is_given):
                raise SceneError(
                    f"system.static: expected above the kinetic friction {where}, got {came}, as else blocks creep"
                    " after the belt, in no event; raise it, or remove `load`"
                )
            if values_here["belt_speed"] == 0.0:
                raise SceneError(f"system.belt_speed: expected one that loads {where}, got 0; change it")

    @property
    def quantities(self) -> dict[str, Quantity | None]:
        """The keys that may hold lists and distributions: those of [system], its parameters, those of [start]."""
        return self.system.quantities | {"z": self.start.z, "w": self.start.w}

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The lists of the scene, as axes of a grid."""
        return axes(self.quantities | {"seed": self.run.seed}, self.run.zip or ())

    @property
    def extent(self) -> str:
        """How many values there are of what is swept, and of starts that are drawn; "" if nothing is."""
        is_drawn = any(
            isinstance(value, Distribution) for key in ("z", "w") for value in values(self.quantities[key])
        )
        draws = self.start.draws or 1
        starts = [f"{draws} draw{'s' * (draws > 1)} of the start"] if is_drawn else []
        tables = [f"{len(self.engines)} engines"] if len(self.engines) > 1 else []
        numbers = [file.parameters for file in self.system.known_files.values()]
        of_files = [f"{len({of_file[name] for of_file in numbers})} {name}" for name in (numbers or [{}])[0]]
        words = [*of_files, *map(str, self.axes), *starts]
        return " x ".join(words + tables) if words else ""

    def points(self) -> Iterator[tuple[dict[str, Value], dict[str, Value | None]]]:
        """Each point of the grid: the swept keys there, and all `quantities`."""
        all_keys = self.quantities | {"seed": self.run.seed}
        single: dict[str, Any] = {
            name: quantity for name, quantity in all_keys.items() if not isinstance(quantity, tuple)
        }
        keys = [key for axis in self.axes for key in axis.keys]
        for rows in itertools.product(*(axis.rows for axis in self.axes)):
            swept = dict(zip(keys, itertools.chain.from_iterable(rows), strict=True))
            yield swept, single | swept

    def start_draws(self, values_here: Mapping[str, Value | None]) -> Sequence[int | None]:
        """The draws of the start, by number, that are run at a point of the grid; None: nothing is drawn."""
        is_drawn = isinstance(values_here["z"], Distribution) or isinstance(values_here["w"], Distribution)
        is_drawn = is_drawn or (self.start.draws is not None and END in (values_here["z"], values_here["w"]))
        return range(self.start.draws or 1) if is_drawn else (None,)

    def _changes_apply(self) -> None:
        """What is changed must be what the engines can run, and what is recorded of changes must have some."""
        readings = self.perturbation.readings if self.perturbation is not None else ()
        for i, engine in enumerate(self.engines):
            unknown = sorted(set(engine.readings or ()) - set(readings))
            if unknown:
                raise ValueError(
                    f"engine[{i}].readings: expected some of [perturbation]'s readings, {list(readings)}, got"
                    f" {unknown[0]!r}; add it there, or remove it here"
                )
            if "damping matrix" in self.readings_of(engine) and "damping matrix" not in engine.engine.takes:
                remaining = [reading for reading in readings if reading != "damping matrix"]
                raise ValueError(
                    f'engine[{i}].readings: expected no "damping matrix" with the engine "{engine.name}", whose'
                    f" dampings are diagonal; list the others there, as readings = {remaining}"
                )
        facts = self.facts
        for record in self.records:
            if problem := record.problem(facts):
                raise ValueError(f"record.{record.name}: {problem}")

    @property
    def facts(self) -> Facts:
        """What records have to know of it."""
        changed = self.perturbation is not None or self.twins is not None
        changed = changed or any(engine.is_drawn for engine in self.engines)
        engines = tuple(engine.engine for engine in self.engines)
        t_end, axis = self.time(self.run.t_end), axis_of_numbers(self.axes)
        return Facts(max(self.system.n), t_end, engines, changed, axis, self.run.load)

    def _steps_and_changes_are_resolved(self) -> None:
        """Changes must be more than rounding, and steps of time not so short that their series fill a memory."""
        twins = max(math.ulp(max(size(self.start.z), size(self.start.w))), math.sqrt(sys.float_info.min))  # squared
        step, steps = self.run.t_end / MAX_SAMPLES, f"run.t_end / {MAX_SAMPLES}"
        for key, numbers, resolution, why in (
            ("twins.sizes", self.twins and self.twins.sizes, twins, "what float64 resolves beside [start]"),
            (
                "perturbation.sizes",
                self.perturbation and self.perturbation.sizes,
                sys.float_info.epsilon,
                "what float64 resolves beside 1",
            ),
            ("analysis.dt", self.analysis.dt, step, steps),
            ("record.dt", self.record.dt and (self.record.dt,), step, steps),
            ("record.separation", self.record.separation and (self.record.separation,), step, steps),
            ("analysis.map_dt", self.analysis.map_dt, step, steps),
        ):
            if numbers and numbers[0] < resolution:
                bound, smallest = apart(resolution, numbers[0], digits=2)
                raise ValueError(f"{key}: expected at least {bound}, {why}, got {smallest}; enlarge it")

    @property
    def n_members(self) -> int:
        """Number of members, counted without expanding the scene."""
        starts = sum(len(self.start_draws(values_here)) for _, values_here in self.points())
        return len(self.system.files or self.system.n) * self.run.matrices * starts * self._n_runs

    @property
    def _n_runs(self) -> int:
        """Runs of a start of a matrix."""
        return sum((1 + self.n_changes(engine)) * engine.n_draws for engine in self.engines)

    def check_size(self, yes: bool) -> None:
        """Refuse a scene of many members, before anything is expanded, unless the user says yes.

        Raises `SceneError`.
        """
        if self.n_members > MANY_MEMBERS and not yes:
            raise SceneError(
                f"run.matrices: expected at most {MANY_MEMBERS} members, got {self.n_members} (n x lists x starts x "
                "matrices x perturbations x engines); lower `matrices`, the lists or the number of draws, or run it "
                "with --yes (in Python yes=True)"
            )

    @property
    def sources(self) -> list[tuple[int, SystemFile | SystemFunction | None]]:
        """The numbers of blocks that systems are drawn or made for; or those of the files that they are read from."""
        system = self.system
        if not system.is_of_files:
            return [(n, self._function) for n in system.n]
        is_graph, n_copies = system.coupling == OF_GRAPH, Counter[str]()
        sources: list[tuple[int, SystemFile | SystemFunction | None]] = []
        for name, facts in sorted(system.known_files.items(), key=lambda file: (file[1].n, file[0])):
            files = {"stiffness": (name, facts.variable), **facts.others}
            parts = tuple(FilePart(array, located(file, self._folder), word) for array, (file, word) in files.items())
            sha256, copy = facts.sha256, n_copies[facts.sha256]
            sources.append((facts.n, SystemFile(name, sha256, facts.version, is_graph, copy, facts, parts)))
            n_copies[sha256] += 1
        return sources

    @property
    def _function(self) -> SystemFunction | None:
        """The function that makes the systems, if one does."""
        module = self.system.module
        if module is None:
            return None
        folder, files_read = str(self._folder.resolve()), tuple(sorted(module.beside.items()))
        return SystemFunction(
            KEY, self.system.coupling, module.sha256, folder, files_read, is_sparse=module.is_sparse
        )

    @property
    def own_record(self) -> OwnRecord | None:
        """What functions of the user's own measure of runs, if any do."""
        return next((record for record in self.records if isinstance(record, OwnRecord)), None)

    @property
    def own_functions(self) -> list[OwnFunction]:
        """All functions of the user's own that it names."""
        record = self.own_record
        functions = [] if self._function is None else [self._function]
        return functions + ([] if record is None else [function.function for function in record.functions])

    @property
    def ends(self) -> Ends | None:
        """The dataset at whose ends members start, if any do."""
        if self.start.dataset is None or self.start.ends is None:
            return None
        return Ends(self.start.dataset, self.start.ends.sha256, place_beside(self.start.dataset, self._folder))

    @property
    def folder(self) -> Path:
        """Where the files are looked for that it names."""
        return self._folder

    def n_changes(self, engine: EngineTable) -> int:
        """Number of changed copies, by perturbation and twins, of each unchanged run of an engine."""
        changes = len(self.twins.sizes) if self.twins is not None and engine.twins else 0
        if self.perturbation is not None:
            changes += len(self.readings_of(engine)) * len(self.perturbation.sizes) * self.perturbation.draws
        return changes

    def readings_of(self, engine: EngineTable) -> tuple[Reading, ...]:
        """The readings of a perturbation that an engine of this scene runs."""
        if self.perturbation is None:
            return ()
        return self.perturbation.readings if engine.readings is None else engine.readings

    def data_keys(self) -> dict[str, Any]:
        """What determines the data, as plain values: all but the words about it and [analysis]."""
        keys = self.model_dump(mode="json", by_alias=True, exclude=_WORDS, exclude_none=True)
        for table, engine in zip(keys["engine"], self.engines, strict=True):
            if engine.picked_for is not None:
                table["picked_for"] = engine.picked_for
        if self.system.files is not None:
            keys["system"]["files"] = {
                name: file.sha256 if file.version == 1 else f"{file.sha256}, version {file.version}"
                for name, file in self.system.files.items()
            }
            del keys["system"]["path"]
        if self.system.module is not None:
            keys["system"]["module"] = self.system.module.sha256
            if self.system.module.beside:
                keys["system"]["beside"] = self.system.module.beside
        if any(isinstance(record, WindowRecord) for record in self.records):
            keys["record"]["t_burn"] = self.record_t_burn  # else [analysis] has no influence on the data
        keys["record"].pop("functions", None)
        if self.record.own:
            keys["record"]["functions"] = {
                name: {"sha256": function.sha256, "beside": function.beside}
                for name, function in self.record.own_functions.items()
            }
        for record in RECORDS:
            if keys["record"].get(record.name) in (False, []) and record.name not in _OLDEST_RECORDS:
                del keys["record"][record.name]
        if self.system.weakening is not None:
            keys["system"]["weakening"].pop("table", None)
        for table in self._of_series(keys["system"]):
            del table["table"]
        if keys["system"]["back_slip"]:
            del keys["system"]["back_slip"]
        if self.start.ends is not None:
            keys["start"]["ends"] = self.start.ends.sha256
            del keys["start"]["dataset"]
        for axis in self.axes:  # the order in the file means nothing
            for key, column in zip(axis.keys, zip(*axis.rows, strict=True), strict=True):
                where = "start" if key in ("z", "w") else "run" if key == "seed" else "system"
                table, name = self.system.place_of(key, keys[where]) if where == "system" else (keys[where], key)
                table[name] = as_written(column)
        return keys

    @staticmethod
    def _of_series(system: dict[str, Any]) -> list[dict[str, Any]]:
        """The tables of series of files, in a dump of [system]."""
        forces = system.get("force")
        places = [system.get("belt_speed"), system.get("drive", {}).get("speed")]
        places += forces if isinstance(forces, list) else [forces]
        return [table for table in places if isinstance(table, dict) and "series" in table]

    def placed(self, value: Any) -> Any:
        """A value of a key, where it is a series of a file with the place of that."""
        if isinstance(value, Pushes):
            return Pushes(tuple(replace(push, course=self.placed(push.course)) for push in value.parts))
        if not isinstance(value, Measured):
            return value
        return replace(value, at=located(value.table, self._folder))

    @property
    def hash(self) -> str:
        """sha256 of `data_keys` in canonical JSON: the same for scenes that give the same data."""
        text = json.dumps(self.data_keys(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()


def load_scene(path: str | Path) -> Scene:
    """Read a scene file, and look at the files that it names; a function that makes systems is tried.

    Raises
    ------
    SceneError
        If the file cannot be read, is not TOML, or is not a scene, or what it names is not what it should be; one
        line a problem.
    """
    path = Path(path)
    source, name = read_source(path), str(path)
    tables = parse_toml(source, name)
    facts = _look(tables, path.parent, name)
    if facts:
        text = "".join(written(facts_of_table, f"{table}.") for table, facts_of_table in facts.items())
        source = source.rstrip() + f"\n\n# What was there when this was read; written by stickslip.{text}".encode()
    try:
        scene = parse_scene(source, name, path.parent)
    except SceneError:
        if not facts:
            raise
        # to a table within a line nothing can be added
        scene = parse_scene(written(_merged(tables, facts)), name, path.parent)
    return scene


def _merged(tables: Mapping[str, Any], facts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    merged = {table: {**tables[table], **facts_of_table} for table, facts_of_table in facts.items() if facts_of_table}
    return {**tables, **merged}


def _look(tables: Mapping[str, Any], folder: Path, name: str) -> dict[str, dict[str, Any]]:
    """What a scene keeps of the files and datasets that it names, by table and key."""
    start, record, system, run = (_table(tables, key) for key in ("start", "record", "system", "run"))
    law = _table(system, "weakening")
    units: Any = tables.get("units")
    facts: dict[str, dict[str, Any]] = {}
    if "functions" not in record and (names := named_functions(record.get("own"))):
        facts["record"] = {"functions": look_at_functions(names, folder)}
    if isinstance(start.get("dataset"), str) and "ends" not in start:
        facts["start"] = {"ends": {"sha256": look_at_dataset(start["dataset"], folder)}}
    is_unscaled = isinstance(units, dict) and "scales" not in units
    if is_unscaled:
        facts["units"] = {"scales": UNSCALED}
    of_system = facts["system"] = dict[str, Any]()
    if isinstance(law.get("table"), str) and not law.keys() & {"speeds", "coefficients"}:
        of_system["weakening"] = law | read_friction_table(law["table"], folder)
    of_system |= _look_at_series(system, folder, run.get("t_end"))
    # a function is tried in a scene, which has its ends then
    of_system |= _look_at_systems(_merged(tables, facts), folder, name)
    if is_unscaled:
        facts["units"] = {"scales": _scales_of(as_scene(Scene, _merged(tables, facts), name), units, folder)}
    if not isinstance(units, dict) and "module" in of_system:
        del of_system["module"]["means"]
    return {table: facts_of_table for table, facts_of_table in facts.items() if facts_of_table}


def _table(tables: Mapping[str, Any], key: str) -> dict[str, Any]:
    """The table at a key; empty if none is there, or something else, which is refused later."""
    table = tables.get(key)
    return table if isinstance(table, dict) else {}


def _scales_of(scene: Scene, table: Mapping[str, Any], folder: Path) -> dict[str, float]:
    """The scales of a scene with units: those of `Scales.of` of its first values, as powers of two."""
    scene._folder = folder
    n, origin = scene.sources[0]
    first = {key: values(quantity)[0] for key, quantity in scene.quantities.items() if values(quantity)}
    numbers: dict[str, Any] = {
        key: value.middle if isinstance(value, Distribution) else value for key, value in first.items()
    }
    known: dict[str, Any] = {key: numbers[key] for key in ("mass", "friction") if numbers.get(key) is not None}
    means = scene.system.module.means if scene.system.module is not None else {}
    of_graph = {key: numbers[key] for key in ("kappa", "leaf", "degree", "rewiring") if numbers.get(key) is not None}
    if isinstance(origin, SystemFile):
        arrays = read(origin)
        is_graph = origin.is_graph
        stiffness = System.from_graph(arrays["edges"], **of_graph).stiffness if is_graph else arrays["stiffness"]
        known |= {key: arrays[key] for key in ("mass", "friction") if key in arrays}
    elif means:
        stiffness = means["stiffness"] * np.eye(n)
        known = {key: means[key] for key in ("mass", "friction")} | known
    else:
        stiffness = draw_system(scene.system.coupling, n, 0, rho=0.0, **of_graph).stiffness
    try:
        system = System(stiffness, 0.0, known.pop("friction", 1.0), 0.0, **known)
        if scene.system.rubbing is not None:
            rubs = scene.system.rubbing.among(n)
            system = system.changed(friction=np.where(rubs, system.friction, 0.0))
        return scales_of(system, table)
    except ValueError as error:
        raise SceneError(
            f"units: {error} under [units], in its units: e.g. scales = {{length = 1e-3, time = 1e-3, force = 100.0}}"
        ) from None


def _look_at_series(system: Mapping[str, Any], folder: Path, t_end: object) -> dict[str, Any]:
    """The keys of [system] that name a file of a series, with what it holds, from 0 to `t_end`."""

    def seen(key: str, table: Any) -> Any:
        if isinstance(table, list):
            return [seen(key, each) for each in table]
        is_new = isinstance(table, dict) and isinstance(table.get("table"), str) and "series" not in table
        return look_at_series(f"system.{key}", table, folder, t_end) if is_new else table

    keys = {key: seen(key, system[key]) for key in ("belt_speed", "force") if key in system}
    drive = _table(system, "drive")
    if "speed" in drive:
        keys["drive"] = drive | {"speed": seen("drive.speed", drive["speed"])}
    return {key: table for key, table in keys.items() if table != system[key]}


def _look_at_systems(tables: Mapping[str, Any], folder: Path, name: str) -> dict[str, Any]:
    system = _table(tables, "system")
    if "files" in system or "module" in system:
        return {}
    coupling, path = system.get("coupling"), system.get("path")
    if coupling in OF_FILES and is_path(path):
        return {"files": look_at_files(path, folder, system, coupling == OF_GRAPH)}
    if not isinstance(coupling, str) or not is_function(coupling):
        return {}
    sha256 = resolve(coupling, folder, KEY).sha256
    facts: dict[str, Any] = {"sha256": sha256, "is_sparse": False, "entries_by_block": 0.0}
    # what may name blocks is for later: the function says their names
    later = ("force", "contacts", "drive", "record")
    nameless = {key: value for key, value in system.items() if key not in later} | {"module": facts}
    unrecorded = {key: value for key, value in tables.items() if key not in later}
    scene = as_scene(Scene, unrecorded | {"system": nameless}, name)
    scene._folder = folder
    parameters: dict[str, Any] = {key: values(value)[0] for key, value in (scene.system.parameters or {}).items()}
    n, function = min(scene.system.n), scene._function
    assert function is not None
    return {"module": facts | tried_function(function, n, parameters)}


def parse_scene(source: bytes | str, name: str = "scene", folder: Path = Path()) -> Scene:
    """A scene from the bytes or the text of a scene file.

    `name` is what errors call it, `folder` where files that it names lie.

    Raises
    ------
    SceneError
        If it is not TOML, or not a scene.
    """
    scene = as_scene(Scene, parse_toml(source, name), name)
    scene._source = source if isinstance(source, str) else source.decode()
    scene._folder = folder
    return scene
