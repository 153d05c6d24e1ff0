"""The tables of a scene that are no system and no engine: [start], [run], [record], [analysis] and what changes."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    WithJsonSchema,
    WrapValidator,
    create_model,
    model_validator,
)

from stickslip.pipeline.design.units import DIMENSIONS
from stickslip.pipeline.design.values import END, LEAST_RANGE, Distribution, values
from stickslip.pipeline.own.function import PATTERN
from stickslip.pipeline.records import RECORDS
from stickslip.pipeline.records.record import Record, StateRecord, WindowRecord
from stickslip.pipeline.scene.engine_table import Readings
from stickslip.pipeline.scene.quantity import PAIR, Displacement, Velocity
from stickslip.pipeline.scene.toml import (
    Count,
    List,
    Natural,
    Positive,
    PositiveNumbers,
    StrictTable,
    as_tuple,
    listed,
    once,
    optional,
    shown,
)
from stickslip.sim.engines.contract import Purpose


def _seeds(value: Any, parse: Callable[[Any], int]) -> int | tuple[int, ...]:
    if not isinstance(value, list | tuple):
        return parse(value)
    return once([parse(seed) for seed in value])  # in the order of the file, for `zip`


if TYPE_CHECKING:
    Seeds = int | tuple[int, ...]
else:
    Seeds = Annotated[
        int,
        Field(ge=0, lt=2**63),
        WrapValidator(_seeds),
        PlainSerializer(lambda seed: seed),
        listed({"type": "integer", "minimum": 0, "exclusiveMaximum": 2**63}),
    ]


class EndsTable(StrictTable):
    """The dataset at whose ends members start, as it was when the scene was read; see `pipeline.running.ends`."""

    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


def _either_a_dataset(schema: dict[str, Any]) -> None:
    """Let editors accept a start without z and w, if it names a dataset."""
    schema |= {"if": {"required": ["dataset"]}, "else": {"required": schema.pop("required")}}


class StartTable(StrictTable):
    """[start]: the state that every block starts from."""

    model_config = ConfigDict(json_schema_extra=_either_a_dataset)
    z: Displacement = Field(description="displacement at t = 0", examples=[-0.7])
    w: Velocity = Field(
        description='velocity at t = 0; "belt": that of the belt, 0 of a block without friction', examples=[-0.4]
    )
    draws: Count | None = optional(
        "number of starts drawn for each system, where z or w is a distribution; 1 if left out", 300
    )
    dataset: str | None = optional(
        'dataset, beside the scene, at whose ends the same members start; z and w are "end" then', "runs/first"
    )
    ends: Annotated[EndsTable | None, WithJsonSchema({"type": "object"})] = optional(
        "what the dataset was when the scene was read: written by stickslip"
    )

    @model_validator(mode="before")
    @classmethod
    def _ends_of_a_dataset(cls, table: Any) -> Any:
        return {"z": "end", "w": "end", **table} if isinstance(table, dict) and "dataset" in table else table

    @model_validator(mode="after")
    def _only_what_applies(self) -> Self:
        starts = (*values(self.z), *values(self.w))
        if (END in starts) != (self.dataset is not None):
            raise ValueError('dataset: expected with z or w = "end", and only with these; write both, or none')
        if self.dataset is not None and self.ends is None:
            raise ValueError("ends: expected what `load_scene` and the command write, found nothing; use these")
        if (
            self.draws is not None
            and END not in starts
            and not any(isinstance(start, Distribution) for start in starts)
        ):
            raise ValueError(
                "draws: expected only with z or w a distribution, e.g. `z = {uniform = [-1, 1]}`; remove it"
            )
        return self


def _rest(value: object) -> object:
    if isinstance(value, str) and value != "rest":
        raise ValueError(
            f'expected "rest" or a table, got {value!r}; write `start = "rest"`, or [start] and its keys'
        )
    return {"z": 0.0, "w": "belt"} if value == "rest" else value


Start = Annotated[StartTable, BeforeValidator(_rest, json_schema_input_type=Literal["rest"] | StartTable)]


class RunTable(StrictTable):
    """[run]: how long, how many, from which seed."""

    t_end: Positive = Field(description="end of each run", examples=[1000.0])
    matrices: Count = Field(description="number of random systems for each n", examples=[20])
    seed: Seeds = Field(default=0, description="seed of all random draws")
    zip: Annotated[tuple[Annotated[tuple[str, ...], List], ...], List] | None = optional(
        "keys whose lists go together, value by value, in place of a grid", [["kappa", "rho"]]
    )
    load: Literal["adiabatic"] | None = optional(
        '"adiabatic": the belt waits while a block slips, and then goes to the next instability at once', "adiabatic"
    )
    purpose: Purpose | None = optional(
        "what the tolerances left out are picked for; default: chosen from what the scene records", "statistics"
    )


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


class ColumnTable(StrictTable):
    """A column of a function of the user's own: its type, words, and whether a run may be without; see `Column`."""

    type: Literal["float", "int", "bool", "str"]
    words: str
    is_optional: bool
    least: float | None = None
    most: Annotated[float, Field(gt=0.0)] | None = None
    absent: str = ""
    since: Annotated[float, Field(ge=0.0)] | Literal["t_burn"] | None = None
    dimension: Literal["", *DIMENSIONS] = ""  # type: ignore[valid-type]


class FunctionTable(StrictTable):
    """A function that measures runs, as it was when the scene was read; see `pipeline.records.own`."""

    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    is_sampled: bool
    columns: dict[str, ColumnTable]
    beside: dict[str, str] = Field(default_factory=dict)


def _functions(names: tuple[str, ...]) -> tuple[str, ...]:
    for name in names:
        if re.match(PATTERN, name) is None:
            raise ValueError(
                f"expected module:function, as in mine:quiet_share, got {name!r}; name a file mine.py so"
            )
    return once(names, n_least=0)


_Name = Annotated[str, WithJsonSchema({"type": "string", "pattern": PATTERN})]
_Names = Annotated[
    tuple[_Name, ...],
    BeforeValidator(as_tuple, json_schema_input_type=_Name | list[_Name]),
    AfterValidator(_functions),
]


def _blocks(value: object) -> object:
    if isinstance(value, bool):
        return value
    names: Any = as_tuple(value)
    if not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f'expected true, false or names of blocks, got {value!r}; write e.g. ["bit"]')
    return once(names)


#: Of all blocks, or of those that it names.
_BlocksOrAll = Annotated[
    bool | tuple[str, ...], BeforeValidator(_blocks, json_schema_input_type=bool | str | list[str])
]


def _key(record: type[Record]) -> tuple[Any, Any]:
    """The type of a record's key under [record], and pydantic's field for it."""
    examples = None if record.example is None else [record.example]
    if record.of_block is not None:
        return _BlocksOrAll, Field(default=False, description=record.words, examples=examples)
    if record.is_named:
        return _Names, Field(default=(), description=record.words, examples=examples)
    if record.is_step:
        return Positive | None, Field(default=None, description=record.words, examples=examples)
    return bool, Field(default=False, description=record.words, examples=examples)


#: A key for each record that is asked for under [record], not by another table.
_KEYS: dict[str, Any] = {record.name: _key(record) for record in RECORDS if record.words}
_Records: Any = create_model("_Records", __base__=StrictTable, **_KEYS)


class RecordTable(_Records):  # type: ignore[misc]
    """[record]: what is kept in addition to the change points of n_stick, which always are."""

    t_burn: Natural | None = optional(
        "time from which records measure that leave out the start; that of [analysis] if left out", 600.0
    )
    dt: Positive | None = optional("time step at which the state is sampled for records that need it", 0.1)
    functions: Annotated[dict[str, FunctionTable] | None, WithJsonSchema({"type": "object"})] = optional(
        "what the functions of `own` were when the scene was read: written by stickslip"
    )

    @property
    def own_functions(self) -> dict[str, FunctionTable]:
        """The functions of `own`, in this order."""
        return {name: (self.functions or {})[name] for name in self.own}

    @property
    def of(self) -> list[type[Record]]:
        """The records that its keys ask for."""
        return [record for record in RECORDS if record.words and getattr(self, record.name)]

    @model_validator(mode="after")
    def _only_what_applies(self) -> Self:
        lacking = [name for name in self.own if name not in (self.functions or {})]
        if lacking:
            raise ValueError(
                f"functions: expected what `load_scene` and the command write here for {lacking[0]}, found nothing;"
                " remove the key, and use these"
            )
        sampled = [f"own = {name!r}" for name, record in self.own_functions.items() if record.is_sampled]
        for key, kind, alternatives in (("t_burn", WindowRecord, []), ("dt", StateRecord, sampled)):
            if (
                getattr(self, key) is not None
                and not alternatives
                and not any(issubclass(record, kind) for record in self.of)
            ):
                names = ", ".join(record.name for record in RECORDS if issubclass(record, kind))
                raise ValueError(f"{key}: expected only with some of {names}, found none; remove it")
        taking = [record.name for record in self.of if issubclass(record, StateRecord)] + sampled
        if taking and self.dt is None:
            raise ValueError(f"dt: expected with `{taking[0]}`, found nothing; write e.g. dt = 0.1")
        return self


class _Declared(StrictTable):
    @property
    def declared(self) -> dict[str, float]:
        """The numbers that the scene declares, by key."""
        return {name: number for name, number in self if number is not None}


class MarginsTable(_Declared):
    """[analysis.margins]: by how much a changed run may differ from its original and count as equivalent.

    Shares of the original's value; without one nothing counts as equivalent.
    """

    mean: Positive | None = optional("margin of the time mean of n_stick", 0.05)
    variance: Positive | None = optional("margin of its variance in time", 0.25)
    rate: Positive | None = optional("margin of the rate of its changes", 0.05)
    gamma: Positive | None = optional("margin of gamma by events", 0.01)
    correlation_time: Positive | None = optional("margin of its correlation time", 0.5)


Share = Annotated[float, Field(ge=0.0, le=1.0)]


class PublishedTable(_Declared):
    """[analysis.published]: shares of runs by what they settle on, as others report them.

    The shares of a record of attractors are set beside them.
    """

    rest: Share | None = optional("published share that comes to rest", 0.1)
    sliding: Share | None = optional("published share of steady sliding", 0.3)
    periodic: Share | None = optional("published share on a cycle", 0.6)
    torus: Share | None = optional("published share on a torus", 0.1)
    irregular: Share | None = optional("published share of chaos", 0.1)
    escaping: Share | None = optional("published share without limit", 0.1)


#: The name of a question, or of a function of the user's own that answers one. The pipeline does not know which there
#: are: whoever makes the report refuses others.
QuestionName = Annotated[str, Field(pattern=rf"^[a-z]\w*$|{PATTERN}")]


def _magnitudes(value: Any, parse: Callable[[Any], tuple[float, float]]) -> tuple[float, float]:
    """A range of magnitudes that is wide enough."""
    with contextlib.suppress(ValueError):  # one message says what may stand here
        least, most = parse(as_tuple(value))
        if least + LEAST_RANGE <= most:
            return least, most
    raise ValueError(
        f"expected two magnitudes, the second by {LEAST_RANGE} or more the larger, got {shown(value)}; write e.g."
        " [-1.0, 0.5]"
    )


class AnalysisTable(StrictTable):
    """[analysis]: settings of the statistics; without influence on the data."""

    t_burn: Natural = Field(description="time before which nothing is counted", examples=[600.0])
    dt: PositiveNumbers = Field(description="sampling steps", examples=[[0.1, 1.0]])
    map_dt: PositiveNumbers | None = optional("sampling steps of the map of gamma; those of dt if left out", [0.1])
    tau: PositiveNumbers = Field(
        default=(0.02, 0.05, 0.1, 0.2, 0.5, 1.0), description="gaps of pairs of exits", examples=[[0.05]]
    )
    smallest: Count = Field(default=1, description="smallest cascade that the law is fitted to")
    magnitude_range: Annotated[tuple[float, float], WrapValidator(_magnitudes), WithJsonSchema(PAIR)] | None = (
        optional("range of magnitudes that b is of; found in the data if left out", [-1.0, 0.5])
    )
    resamples: int = Field(default=200, ge=2, description="most surrogates of a member for what chance gives")
    confidence: Annotated[float, Field(ge=0.5, le=0.999999)] = Field(
        default=0.95, description="level of the intervals"
    )
    margins: MarginsTable = MarginsTable()
    published: PublishedTable = PublishedTable()
    question: Annotated[
        tuple[QuestionName, ...], BeforeValidator(as_tuple, json_schema_input_type=QuestionName | list[QuestionName])
    ] = Field(
        default=(),
        description="questions that lead the report, in this order, or module:function of one of your own; what the"
        " data are about if left out",
        examples=[["cascades"]],
    )
