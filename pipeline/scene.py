"""The scene file: which ensemble, run how, kept and analysed how.

All quantities are dimensionless.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, Union, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PrivateAttr,
    WithJsonSchema,
    create_model,
    model_validator,
)

from stickslip.pipeline.quantity import (
    AnyNumber,
    Axis,
    BlockNumber,
    BlockScale,
    Distribution,
    FromFile,
    Quantity,
    Scale,
    Value,
    as_written,
    axes,
    points,
    size,
    values,
)
from stickslip.pipeline.systems import SystemFile, with_files
from stickslip.pipeline.toml import (
    BlockNumbers,
    Blocks,
    Count,
    Natural,
    Positive,
    PositiveNumbers,
    StrictTable,
    as_scene,
    as_tuple,
    parse_toml,
    read_source,
)
from stickslip.sim.arguments import did_you_mean
from stickslip.sim.couplings import COUPLINGS
from stickslip.sim.engines import ENGINES, SETTINGS
from stickslip.sim.engines.contract import Choice, Engine, Number, Numbers, Purpose, Ratios, Setting
from stickslip.sim.graphs import GRAPHS

#: A scene may not hold more members than this: more is taken for a typing error, before anything is expanded.
MAX_MEMBERS = 1_000_000

#: Nor may a series in time have more values than this.
MAX_SAMPLES = 10_000_000


_LIST = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)

#: The name of the coupling whose systems are read from files.
OF_FILE = "file"


def _coupling(name: str) -> str:
    known = (*COUPLINGS, *GRAPHS, OF_FILE)
    if name not in known:
        raise ValueError(f"expected one of {', '.join(known)}, got {name!r}{did_you_mean(name, known)}")
    return name


class FileTable(StrictTable):
    """A file that a system is read from, as it was when the scene was read; see `pipeline.systems`."""

    at: str
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    n: Blocks
    scale: Natural
    entries: Count
    is_sparse: bool
    arrays: Annotated[tuple[str, ...], _LIST]


class SystemTable(StrictTable):
    """[system]: what the systems are drawn from."""

    coupling: Annotated[str, AfterValidator(_coupling)] = Field(
        description="name of the ensemble, or of the graph that springs lie along; or that K is read from a file",
        examples=["antisymmetric"],
        json_schema_extra={"enum": [*COUPLINGS, *GRAPHS, OF_FILE]},
    )
    n: BlockNumbers = Field(description="number of blocks, or a list of numbers", examples=[200])
    path: str | None = Field(
        default=None,
        description="file of K, .npz, .npy or Matrix Market, beside the scene; or several, by a pattern",
        examples=["K.npz"],
    )
    kappa: Scale | None = Field(
        default=0.2, description="scale of the stiffnesses; of a graph the springs between neighbours", examples=[0.2]
    )
    leaf: BlockScale | None = Field(default=0.1, description="leaf spring of every block in a graph", examples=[0.1])
    degree: Scale | None = Field(
        default=4.0, description="mean number of neighbours in the graph `network`", examples=[4.0]
    )
    rho: Scale | None = Field(default=3.5, description="scale of the dampings", examples=[3.5])
    damping: BlockScale | None = Field(
        default=None, description="damping R of every block, in the place of `rho`", examples=[0.0]
    )
    friction: BlockScale = Field(default=1.0, description="kinetic friction mu of every block", examples=[1.0])
    belt_speed: AnyNumber = Field(default=-0.2, description="speed v of the belt", examples=[-0.2])
    files: Annotated[dict[str, FileTable] | None, WithJsonSchema({"type": "object"})] = Field(
        default=None, description="what the files were when the scene was read: written by stickslip"
    )

    @property
    def readings(self) -> tuple[str, ...]:
        """The readings of a perturbation that keep what the system is."""
        kept = COUPLINGS[self.coupling].readings if self.coupling in COUPLINGS else ()
        return kept if self.damping is None else tuple(set(kept) & {"relative"})  # there is no scale of R

    @property
    def bytes_of_system(self) -> float:
        """About what drawing the largest system takes."""
        n = max(self.n)
        if self.coupling in COUPLINGS:
            return 3.0 * 8 * math.prod(COUPLINGS[self.coupling].shape(n))  # a draw, its transpose and their sum
        if self.coupling == OF_FILE:
            return max((100.0 if file.is_sparse else 24.0) * file.entries for file in self.known_files.values())
        return 100.0 * n * (1.0 + size(self.degree or 4.0))

    @property
    def known_files(self) -> dict[str, FileTable]:
        """The files that systems are read from, by their names beside the scene."""
        return self.files or {}

    def _files_apply(self) -> None:
        if self.coupling != OF_FILE:
            if self.path is not None or self.files is not None:
                raise ValueError(f'path: expected none with coupling = "{self.coupling}"; remove it, or write "file"')
            return
        if self.path is None:
            raise ValueError('path: expected the file of K, found nothing; add `path = "K.npz"`')
        if not self.files:
            raise ValueError("files: expected what `load_scene` and the command write here, found nothing; use these")
        if "kappa" in self.model_fields_set and self.kappa is not None:
            raise ValueError('kappa: expected none with coupling = "file", which has K itself; remove it')
        object.__setattr__(self, "kappa", None)
        for name, file in self.files.items():
            if file.n not in self.n:
                raise ValueError(f"n: expected that of {name}, {file.n}, got {list(self.n)}; write `n = {file.n}`")
            given = {key for key in self.model_fields_set if getattr(self, key) is not None}
            for array, keys in (("friction", {"friction"}), ("damping", {"damping", "rho"})):
                if array in file.arrays and keys & given:
                    key = sorted(keys & given)[0]
                    raise ValueError(f"{key}: expected none beside the array `{array}` of {name}, got one; remove it")
            same = [other for other in self.files if self.files[other].sha256 == file.sha256 and other != name]
            if same:
                raise ValueError(
                    f"path: expected files that differ, got {name} and {same[0]}, which are equal; remove one"
                )
        alone = set(self.n) - {file.n for file in self.files.values()}
        if alone:
            raise ValueError(f"n: expected the numbers of blocks of the files, got {min(alone)} of none; remove it")

    @model_validator(mode="after")
    def _only_what_applies(self) -> Self:
        """What is not used is refused, and no part of the data."""
        for key, has_it in (("leaf", self.coupling in GRAPHS), ("degree", self.coupling == "network")):
            if not has_it:
                if key in self.model_fields_set and getattr(self, key) is not None:
                    raise ValueError(f'{key}: expected none with coupling = "{self.coupling}"; remove it')
                object.__setattr__(self, key, None)
        self._files_apply()
        if self.damping is not None:
            if "rho" in self.model_fields_set and self.rho is not None:
                raise ValueError("damping: expected either `damping` or `rho`, got both; remove one")
            object.__setattr__(self, "rho", None)
        if self.degree is not None and size(self.degree) > min(self.n) - 1:
            most = f"n - 1 = {min(self.n) - 1}, all the others"
            raise ValueError(f"degree: expected at most {most}, got {size(self.degree):g}; lower it")
        return self


class StartTable(StrictTable):
    """[start]: the state that every block starts from."""

    z: BlockNumber = Field(description="displacement at t = 0", examples=[-0.7])
    w: BlockNumber = Field(description="velocity at t = 0", examples=[-0.4])
    draws: Count | None = Field(
        default=None,
        description="number of starts drawn for each system, where z or w is a distribution; 1 if left out",
        examples=[300],
    )

    @model_validator(mode="after")
    def _only_what_is_drawn(self) -> Self:
        if self.draws is not None and not any(
            isinstance(one, Distribution) for one in (*values(self.z), *values(self.w))
        ):
            raise ValueError(
                "draws: expected only with z or w a distribution, e.g. `z = {uniform = [-1, 1]}`; remove it"
            )
        return self


class RunTable(StrictTable):
    """[run]: how long, how many, from which seed."""

    t_end: Positive = Field(description="end of each run", examples=[1000.0])
    matrices: Count = Field(description="number of random systems for each n", examples=[20])
    seed: int = Field(default=0, ge=0, lt=2**63, description="seed of all random draws", examples=[0])
    zip: Annotated[tuple[Annotated[tuple[str, ...], _LIST], ...], _LIST] | None = Field(
        default=None,
        description="keys whose lists go together, value by value, in place of a grid",
        examples=[[["kappa", "rho"]]],
    )
    purpose: Purpose | None = Field(
        default=None,
        description="what the tolerances left out are picked for; default: chosen from what the scene records",
        examples=["statistics"],
    )


#: Tolerances of the engines where a scene gives none, by what it asks for.
TOLERANCES: dict[Purpose, dict[str, float]] = {
    purpose: {
        name: setting.picked[purpose]
        for name, setting in SETTINGS.items()
        if isinstance(setting, Number) and setting.picked
    }
    for purpose in get_args(Purpose)
}


Reading = Literal["scale", "relative", "damping matrix"]


def _once(values: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(values)) < len(values):
        raise ValueError(f"expected each value once, got {list(values)!r}; remove the duplicates")
    return values


Readings = Annotated[
    tuple[Reading, ...],
    BeforeValidator(as_tuple, json_schema_input_type=Reading | list[Reading]),
    AfterValidator(_once),
]


class EngineTable(StrictTable):
    """A table [[engine]]: what all share; `_table` adds the settings of one engine."""

    readings: Readings | None = Field(
        default=None,
        description="readings of [perturbation] that this engine runs; all of them if left out",
        examples=[["scale"]],
    )
    twins: bool = Field(default=True, description="whether to run [twins] with this engine", examples=[False])
    _picked_for: Purpose | None = PrivateAttr(default=None)

    if TYPE_CHECKING:
        name: str
        ratio_draws: int

    @property
    def engine(self) -> type[Engine]:
        """The engine that the table is of."""
        return ENGINES[self.name]

    @property
    def is_drawn(self) -> bool:
        """Whether its stiffness ratios are drawn for each system."""
        return getattr(self, "ratio", "one") == "uniform"

    @property
    def n_draws(self) -> int:
        """With how many draws of them each system is run; may be absurd, and is counted, not enumerated."""
        return self.ratio_draws if self.is_drawn else 1

    @property
    def draws(self) -> Sequence[int | None]:
        """These draws by number; None: no draw."""
        return range(self.n_draws) if self.is_drawn else (None,)

    @property
    def settings(self) -> dict[str, Any]:
        """The engine's settings that mean something beside the others, by name."""
        found = {}
        for name, one in self.engine.settings().items():
            if one.only_with is None or getattr(self, one.only_with[0]) == one.only_with[1]:
                value = getattr(self, name)
                found[name] = self.engine.defaults()[name] if value is None else value
        return found

    @property
    def picked_for(self) -> Purpose | None:
        """What a tolerance was picked for; None if the scene gives them all."""
        return self._picked_for

    @property
    def tolerances(self) -> dict[str, float]:
        """The engine's tolerances, by key; all of them once it is part of a scene."""
        keys = (key for key in TOLERANCES["paths"] if key in type(self).model_fields)
        return {key: value for key in keys if (value := getattr(self, key)) is not None}

    def complete(self, purpose: Purpose) -> Self:
        """This table with no tolerance missing."""
        picked = {key: value for key, value in TOLERANCES[purpose].items() if key in type(self).model_fields}
        if len(self.tolerances) == len(picked):
            return self
        found = self.model_copy(update=picked | self.tolerances)
        found._picked_for = purpose
        return found

    @model_validator(mode="after")
    def _only_what_applies(self) -> Self:
        for name, one in self.engine.settings().items():
            key, (owner, value) = name, one.only_with or ("", None)
            if isinstance(one, Ratios):
                key, owner, value = "ratio_draws", "ratio", "uniform"
            if owner and key in self.model_fields_set and getattr(self, owner) != value:
                raise ValueError(
                    f'{key}: expected only with {owner} = "{value}", got {owner} = "{getattr(self, owner)}"; '
                    f"remove `{key}` or change `{owner}`"
                )
        if problem := self.engine.problem(self.settings):
            raise ValueError(problem)
        return self


def _keys(name: str, one: Setting, default: Any) -> dict[str, Any]:
    """The keys of a scene that are for one setting of an engine, as pydantic's fields."""
    example = [default if one.example is None else one.example]
    match one:
        case Number(picked=picked):
            low, high = (bound if math.isfinite(bound) else None for bound in (one.above, one.below))
            kind = Annotated[float, Field(gt=low, lt=high)]
            key = Field(default=None if picked else default, description=one.words, examples=example)
            return {name: (kind | None if picked else kind, key)}
        case Choice():
            return {name: (Literal[one.choices], Field(default=default, description=one.words))}
        case Numbers():
            return {name: (PositiveNumbers | None, Field(default=None, description=one.words, examples=example))}
        case Ratios():
            law = "law of the r_i: 1, or uniform in (0, 1]"
            draws = "number of draws of the r_i for each system"
            return {
                "ratio": (Literal["one", "uniform"], Field(default="one", description=law, examples=["one"])),
                "ratio_draws": (Count, Field(default=1, description=draws, examples=[1])),
            }
    raise TypeError(f"{name}: expected a setting of a known kind, got {type(one).__name__}")


def _table(engine: type[Engine]) -> type[EngineTable]:
    """The table [[engine]] of one engine, with the keys that its settings ask for."""
    keys: dict[str, Any] = {"name": (Literal[engine.name], ...)}
    for name, one in engine.settings().items():
        keys |= _keys(name, one, engine.defaults()[name])
    about = f'[[engine]] name = "{engine.name}": {engine.about}'
    return create_model(engine.__name__, __base__=EngineTable, __doc__=about, **keys)


if TYPE_CHECKING:
    AnyEngine = EngineTable
else:
    AnyEngine = Annotated[Union[*map(_table, ENGINES.values())], Field(discriminator="name")]


class PerturbationTable(StrictTable):
    """[perturbation]: each system again with its constants moved; size 0, unmoved, is always run once."""

    readings: Readings = Field(
        default=("scale",),
        min_length=1,
        description="what moves by how much: see `stickslip.sim.perturb_system`",
        examples=[["scale", "relative"]],
    )
    sizes: PositiveNumbers = Field(description="relative sizes of the change", examples=[[0.01, 0.05]])
    draws: Count = Field(default=1, description="number of random changes of each size", examples=[3])


class TwinsTable(StrictTable):
    """[twins]: each system again from a start moved in a random direction, the same for every size."""

    sizes: PositiveNumbers = Field(
        description="distances between the starts: root mean square over the blocks", examples=[[1e-8, 1e-2]]
    )


class RecordTable(StrictTable):
    """[record]: what is kept beside the change points of n_stick, which always are."""

    events: bool = Field(default=False, description="whether to keep every event", examples=[False])
    growth_rate: bool = Field(
        default=False,
        description="whether to keep the growth rate of the all-slip state; its eigenvalues cost as much as a run",
        examples=[False],
    )
    separation: Positive | None = Field(
        default=None,
        description="time step at which the distance of a changed run from the unchanged one is kept",
        examples=[5.0],
    )


class MarginsTable(StrictTable):
    """[analysis.margins]: by how much a changed run may differ from its original and count as equivalent.

    Shares of the original's value, `distribution` of its standard deviation in time.
    """

    mean: Positive = Field(default=0.1, description="margin of the time mean of n_stick", examples=[0.1])
    variance: Positive = Field(default=0.25, description="margin of its variance in time", examples=[0.25])
    rate: Positive = Field(default=0.1, description="margin of the rate of its changes", examples=[0.1])
    gamma: Positive = Field(default=0.05, description="margin of gamma by events", examples=[0.05])
    correlation_time: Positive = Field(default=0.5, description="margin of its correlation time", examples=[0.5])
    band: Positive = Field(default=0.5, description="margin of its power at periods 15 to 25", examples=[0.5])
    distribution: Positive = Field(default=0.5, description="margin of its stationary distribution", examples=[0.5])


#: What a report can be asked first: the names of `analysis.questions`.
QuestionName = Literal[
    "cascades", "exponential", "definitions", "clustering", "fates", "engines", "sensitivity", "robustness"
]


class AnalysisTable(StrictTable):
    """[analysis]: handed to the statistics; without influence on the data."""

    t_burn: Natural = Field(description="time before which nothing is counted", examples=[600.0])
    dt: PositiveNumbers = Field(description="sampling steps", examples=[[0.1, 1.0]])
    map_dt: PositiveNumbers | None = Field(
        default=None, description="sampling steps of the map of gamma; those of dt if left out", examples=[[0.1]]
    )
    tau: PositiveNumbers = Field(
        default=(0.02, 0.05, 0.1, 0.2, 0.5, 1.0), description="gaps of pairs of exits", examples=[[0.05]]
    )
    smallest: Count = Field(default=1, description="smallest cascade that the law is fitted to", examples=[1])
    resamples: int = Field(
        default=200, ge=2, description="most surrogates of a member for what chance gives", examples=[200]
    )
    confidence: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.95, description="level of the intervals", examples=[0.95]
    )
    margins: MarginsTable = MarginsTable()
    question: Annotated[
        tuple[QuestionName, ...],
        BeforeValidator(as_tuple, json_schema_input_type=QuestionName | list[QuestionName]),
    ] = Field(
        default=(),
        description="questions that lead the report, in this order; what the data are about if left out",
        examples=[["cascades"]],
    )


#: What a scene says of its own cost, an ensemble's or a chart's.
MINUTES = "what it took on two cores with its report, in minutes: `stickslip scenes` shows it"

#: Keys without influence on the data.
_WORDS = {"title", "about", "minutes", "analysis"}


class Scene(StrictTable):
    """A scene: everything that determines an ensemble's data, and what to make of them."""

    title: str = Field(default="", description="one line for the report's head")
    about: str = Field(default="", description="what the scene is for")
    minutes: Positive | None = Field(default=None, description=MINUTES, examples=[1.0])
    system: SystemTable
    start: StartTable
    run: RunTable
    engines: Annotated[
        tuple[AnyEngine, ...],
        Field(min_length=1),
        BeforeValidator(as_tuple, json_schema_input_type=AnyEngine | Annotated[list[AnyEngine], Field(min_length=1)]),
    ] = Field(alias="engine", description="one or more tables [[engine]]")
    perturbation: PerturbationTable | None = None
    twins: TwinsTable | None = None
    record: RecordTable = RecordTable()
    analysis: AnalysisTable

    @property
    def purpose(self) -> Purpose:
        """What the scene asks to know; if it does not say, paths if it keeps events or has runs to compare."""
        asks_paths = self.record.events or self.record.separation is not None
        asks_paths = asks_paths or self.perturbation is not None or self.twins is not None
        return self.run.purpose or ("paths" if asks_paths else "statistics")

    @property
    def records(self) -> tuple[str, ...]:
        """Which of the optional parts of a dataset there are."""
        thresholds = any(engine.settings.get("thresholds") for engine in self.engines)
        drawn = (one for quantity in self.quantities.values() for one in values(quantity))
        in_files = any(file.arrays for file in self.system.known_files.values())
        asked = {
            "file": self.system.coupling == OF_FILE,
            "graph": self.system.coupling in GRAPHS,
            "damping": self.system.damping is not None or in_files,
            "drawn": any(not isinstance(one, float) for one in drawn) or in_files,
            "growth_rate": self.record.growth_rate,
            "events": self.record.events,
            "separation": self.record.separation is not None,
            "thresholds": thresholds,
        }
        return tuple(name for name, is_asked in asked.items() if is_asked)

    @model_validator(mode="after")
    def _consistent(self) -> Scene:
        # frozen for everybody else: a scene that exists has all its tolerances
        object.__setattr__(self, "engines", tuple(engine.complete(self.purpose) for engine in self.engines))
        settings = [engine.model_dump(exclude={"readings", "twins"}) for engine in self.engines]
        for i, setting in enumerate(settings):
            if setting in settings[:i]:
                raise ValueError(
                    f"engine[{i}]: expected settings that differ from engine[{settings.index(setting)}], "
                    f"got the same; remove it"
                )
        if self.analysis.t_burn >= self.run.t_end:
            raise ValueError(
                f"analysis.t_burn: expected less than run.t_end = {self.run.t_end}, "
                f"got {self.analysis.t_burn}; shorten the burn-in or lengthen the runs"
            )
        readings = self.perturbation.readings if self.perturbation is not None else ()
        kept = self.system.readings
        if set(readings) - set(kept):
            remedy = f"write readings = {json.dumps(kept)}" if kept else "remove [perturbation]"
            what = f'coupling = "{self.system.coupling}"' + " with `damping`" * (self.system.damping is not None)
            raise ValueError(
                f"perturbation.readings: expected those that keep what {what} is,"
                f" {json.dumps(kept)}, got {json.dumps(readings)}; {remedy}"
            )
        for key, array in (("z", "z0"), ("w", "w0")):
            lacking = [name for name, file in self.system.known_files.items() if array not in file.arrays]
            if isinstance(getattr(self.start, key), FromFile) and (lacking or self.system.coupling != OF_FILE):
                where = lacking[0] if lacking else f'coupling = "{self.system.coupling}"'
                raise ValueError(
                    f"start.{key}: expected a file with the array `{array}`, got {where} without; write a number"
                )
        self._changes_apply()
        self._steps_and_changes_are_resolved()
        try:
            n_members = self.n_members
        except ValueError as error:
            raise ValueError(f"run.zip: {error}") from None
        if n_members > MAX_MEMBERS:
            raise ValueError(
                f"run.matrices: expected a scene of at most {MAX_MEMBERS} members, got {n_members} "
                f"(n x lists x starts x matrices x perturbations x engines); lower `matrices`, the lists or the "
                f"number of draws"
            )
        return self

    @property
    def quantities(self) -> dict[str, Quantity | None]:
        """The keys that may hold lists and distributions: those of [system], then those of [start]."""
        one, other = self.system, self.start
        keys = ("kappa", "leaf", "degree", "rho", "damping", "friction", "belt_speed")
        return {name: getattr(one, name) for name in keys} | {"z": other.z, "w": other.w}

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The lists of the scene, as axes of a grid."""
        return axes(self.quantities, self.run.zip or ())

    @property
    def extent(self) -> str:
        """How many values there are of what is swept, and of starts that are drawn; "" if nothing is."""
        drawn = any(isinstance(one, Distribution) for key in ("z", "w") for one in values(self.quantities[key]))
        starts = [f"{self.start.draws or 1} draws of the start"] if drawn else []
        return " x ".join([*map(str, self.axes), *starts])

    def points(self) -> Iterator[tuple[dict[str, Value], dict[str, Value | None]]]:
        """Each point of the grid: the swept keys there, and all `quantities`."""
        single: dict[str, Any] = {name: one for name, one in self.quantities.items() if not isinstance(one, tuple)}
        for swept in points(self.axes):
            yield swept, single | swept

    def start_draws(self, at: Mapping[str, Value | None]) -> Sequence[int | None]:
        """The draws of the start, by number, that are run at a point of the grid; None: nothing is drawn."""
        is_drawn = isinstance(at["z"], Distribution) or isinstance(at["w"], Distribution)
        return range(self.start.draws or 1) if is_drawn else (None,)

    def _changes_apply(self) -> None:
        """What is changed must be what the engines can run, and what is recorded of changes must have some."""
        known = self.perturbation.readings if self.perturbation is not None else ()
        for i, engine in enumerate(self.engines):
            unknown = sorted(set(engine.readings or ()) - set(known))
            if unknown:
                raise ValueError(
                    f"engine[{i}].readings: expected some of [perturbation]'s readings, {list(known)}, got"
                    f" {unknown[0]!r}; add it there, or remove it here"
                )
            if "damping matrix" in self.readings_of(engine) and not engine.engine.takes_damping_matrix:
                others = [reading for reading in known if reading != "damping matrix"]
                raise ValueError(
                    f'engine[{i}].readings: expected no "damping matrix" with the engine "{engine.name}", whose'
                    f" dampings are diagonal; list the others there, as readings = {others}"
                )
        changed = self.perturbation is not None or self.twins is not None
        changed = changed or any(engine.is_drawn for engine in self.engines)
        if self.record.separation is not None and not changed:
            raise ValueError(
                "record.separation: expected a scene with changed runs, got none; add [perturbation] or [twins],"
                ' or a sigmoid with ratio = "uniform"'
            )

    def _steps_and_changes_are_resolved(self) -> None:
        """Changes must be more than rounding, and steps of time not so short that their series fill a memory."""
        twins = max(math.ulp(max(size(self.start.z), size(self.start.w))), math.sqrt(sys.float_info.min))  # squared
        step, steps = self.run.t_end / MAX_SAMPLES, f"run.t_end / {MAX_SAMPLES}"
        for key, known, least, why in (
            ("twins.sizes", self.twins and self.twins.sizes, twins, "what float64 resolves beside [start]"),
            (
                "perturbation.sizes",
                self.perturbation and self.perturbation.sizes,
                sys.float_info.epsilon,
                "what float64 resolves beside 1",
            ),
            ("record.separation", self.record.separation and (self.record.separation,), step, steps),
            ("analysis.dt", self.analysis.dt, step, steps),
            ("analysis.map_dt", self.analysis.map_dt, step, steps),
        ):
            if known and known[0] < least:
                raise ValueError(f"{key}: expected at least {least:.2g}, {why}, got {known[0]}; enlarge it")

    @property
    def n_members(self) -> int:
        """Number of members, counted without expanding the scene."""
        runs = sum((1 + self.n_changes(engine)) * engine.n_draws for engine in self.engines)
        starts = math.prod(len(axis.rows) for axis in self.axes)
        if starts <= MAX_MEMBERS:
            starts = sum(len(self.start_draws(at)) for _, at in self.points())
        return len(self.sources) * self.run.matrices * starts * runs

    @property
    def sources(self) -> list[tuple[int, SystemFile | None]]:
        """The numbers of blocks that systems are drawn for; or the files that they are read from, with theirs."""
        if self.system.coupling != OF_FILE:
            return [(n, None) for n in self.system.n]
        files = self.system.known_files
        named = sorted(files, key=lambda name: (files[name].n, name))
        return [(files[name].n, SystemFile(name=name, **files[name].model_dump(exclude={"n"}))) for name in named]

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
            keys["system"]["files"] = {name: file.sha256 for name, file in self.system.files.items()}
            del keys["system"]["path"]
        for axis in self.axes:  # the order in the file means nothing
            for key, column in zip(axis.keys, zip(*axis.rows, strict=True), strict=True):
                keys["start" if key in ("z", "w") else "system"][key] = as_written(column)
        return keys

    @property
    def hash(self) -> str:
        """sha256 of `data_keys` in canonical JSON: the same for scenes that give the same data."""
        text = json.dumps(self.data_keys(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()


def load_scene(path: str | Path) -> Scene:
    """Read a scene file.

    Raises
    ------
    SceneError
        If the file cannot be read, is not TOML, or is not a scene; one line a problem.
    """
    return parse_scene(scene_source(path), str(path))


def scene_source(path: str | Path) -> bytes:
    """The bytes of a scene file, with what the files that it names are: all that a scene is known by.

    Raises
    ------
    SceneError
        If the file, or one that it names, cannot be read or holds something else.
    """
    source = read_source(path)
    return with_files(parse_toml(source, str(path)), source, Path(path).parent)


def parse_scene(source: bytes, name: str = "scene") -> Scene:
    """A scene from the bytes of a scene file; `name` is what errors call it.

    Raises
    ------
    SceneError
        As `load_scene`.
    """
    return as_scene(Scene, parse_toml(source, name), name)
