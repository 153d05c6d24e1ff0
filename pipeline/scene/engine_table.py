"""[[engine]]: a table of a scene for each engine, with the keys that its settings ask for."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, Union, get_args

from pydantic import AfterValidator, BeforeValidator, Field, PrivateAttr, WrapValidator, create_model, model_validator

from stickslip.pipeline.design.values import short
from stickslip.pipeline.scene.toml import Count, PositiveNumbers, StrictTable, as_tuple, listed, once, optional
from stickslip.sim.engines import ENGINES, SETTINGS
from stickslip.sim.engines.contract import Choice, Engine, Number, Numbers, Purpose, Ratios, Setting
from stickslip.sim.systems.couplings import Reading

#: Tolerances of the engines where a scene gives none, by what it asks for.
TOLERANCES: dict[Purpose, dict[str, float]] = {
    purpose: {
        name: setting.picked[purpose]
        for name, setting in SETTINGS.items()
        if isinstance(setting, Number) and setting.picked
    }
    for purpose in get_args(Purpose)
}


Readings = Annotated[
    tuple[Reading, ...],
    BeforeValidator(as_tuple, json_schema_input_type=Reading | list[Reading]),
    AfterValidator(partial(once, n_least=0)),
]


class EngineTable(StrictTable):
    """A table [[engine]]: what all share; `_table` adds the settings of one engine."""

    readings: Readings | None = optional(
        "readings of [perturbation] that this engine runs; all of them if left out", ["scale"]
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
        """How many draws of them each system is run with; never enumerated, as it may be absurd."""
        return self.ratio_draws if self.is_drawn else 1

    @property
    def draws(self) -> Sequence[int | None]:
        """These draws by number; None: no draw."""
        return range(self.n_draws) if self.is_drawn else (None,)

    @property
    def settings(self) -> dict[str, Any]:
        """The engine's settings that apply, given the others, by name."""
        values = {}
        for name, setting in self.engine.settings().items():
            if setting.only_with is None or getattr(self, setting.only_with[0]) == setting.only_with[1]:
                value = getattr(self, name)
                values[name] = self.engine.defaults()[name] if value is None else value
        return values

    @property
    def picked_for(self) -> Purpose | None:
        """What a tolerance was picked for; None if the scene gives them all."""
        return self._picked_for

    @property
    def tolerances(self) -> dict[str, float]:
        """The engine's tolerances, by key; all of them once it is part of a scene."""
        keys = (key for key in TOLERANCES["paths"] if key in type(self).model_fields)
        return {key: value for key in keys if (value := getattr(self, key)) is not None}

    def words(self, ratio_draw: int | None) -> list[str]:
        """Its words in a member's name, with a draw of `draws`."""
        words = [self.name]
        for name, value in self.settings.items():
            about = self.engine.settings()[name]
            if isinstance(about, Ratios):
                words.append("one" if ratio_draw is None else f"u{ratio_draw}")
            elif about.in_id is not None:
                words.append(about.in_id + short(value))
        return words

    def complete(self, purpose: Purpose) -> Self:
        """This table with no tolerance missing."""
        picked = {key: value for key, value in TOLERANCES[purpose].items() if key in type(self).model_fields}
        if len(self.tolerances) == len(picked):
            return self
        table = self.model_copy(update=picked | self.tolerances)
        table.__pydantic_fields_set__ = self.model_fields_set  # what was picked was not written
        table._picked_for = purpose
        return table

    @model_validator(mode="after")
    def _only_what_applies(self) -> Self:
        for name, setting in self.engine.settings().items():
            key, (owner, value) = name, setting.only_with or ("", None)
            if isinstance(setting, Ratios):
                key, owner, value = "ratio_draws", "ratio", "uniform"
            if owner and key in self.model_fields_set and getattr(self, owner) != value:
                raise ValueError(
                    f'{key}: expected only with {owner} = "{value}", got {owner} = "{getattr(self, owner)}"; '
                    f"remove `{key}` or change `{owner}`"
                )
        if problem := self.engine.problem(self.settings):
            raise ValueError(problem)
        return self


def _keys(name: str, setting: Setting, default: Any) -> dict[str, Any]:
    """The keys of a scene that are for one setting of an engine, as pydantic's fields."""
    example = [default if setting.example is None else setting.example]
    match setting:
        case Number(picked=picked):
            low, high = (bound if math.isfinite(bound) else None for bound in (setting.above, setting.below))
            bounds = {"exclusiveMinimum": low, "exclusiveMaximum": high}
            schema = {"type": "number"} | {name: bound for name, bound in bounds.items() if bound is not None}
            kind = Annotated[float, Field(gt=low, lt=high), listed(schema)]
            key = Field(default=None if picked else default, description=setting.words, examples=example)
            return {name: (kind | None if picked else kind, key)}
        case Choice():
            return {name: (Literal[setting.choices], Field(default=default, description=setting.words))}
        case Numbers():
            return {name: (PositiveNumbers | None, Field(default=None, description=setting.words, examples=example))}
        case Ratios():
            about = "the r_i: 1, or drawn uniform in (0, 1]"
            draws = "number of draws of the r_i for each system"
            return {
                "ratio": (Literal["one", "uniform"], Field(default="one", description=about)),
                "ratio_draws": (Count, Field(default=1, description=draws)),
            }
    raise TypeError(f"{name}: expected a setting of a known kind, got {type(setting).__name__}")


def _table(engine: type[Engine]) -> type[EngineTable]:
    """The table [[engine]] of one engine, with the keys that its settings ask for."""
    keys: dict[str, Any] = {"name": (Literal[engine.name], ...)}
    for name, setting in engine.settings().items():
        keys |= _keys(name, setting, engine.defaults()[name])
    about = f'[[engine]] name = "{engine.name}": {engine.about}'
    return create_model(engine.__name__, __base__=EngineTable, __doc__=about, **keys)


def _each_of_lists(table: Any, parse: Callable[[Any], EngineTable]) -> tuple[EngineTable, ...]:
    """The tables that a table [[engine]] stands for: where numbers of the engine are lists, one for each choice."""
    engine = ENGINES.get(table["name"]) if isinstance(table, dict) and isinstance(table.get("name"), str) else None
    numbers = [name for name, setting in engine.settings().items() if isinstance(setting, Number)] if engine else []
    lists = {name: table[name] for name in numbers if isinstance(table.get(name), list | tuple)}
    for name, several in lists.items():
        try:
            once(several)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
    choices = itertools.product(*lists.values())
    return tuple(parse({**table, **dict(zip(lists, choice, strict=True))} if lists else table) for choice in choices)


if TYPE_CHECKING:
    AnyEngine = EngineTable
else:
    AnyEngine = Annotated[
        Union[*map(_table, ENGINES.values())], Field(discriminator="name"), WrapValidator(_each_of_lists)
    ]

Engines = Annotated[
    tuple[AnyEngine, ...],
    Field(min_length=1),
    BeforeValidator(as_tuple, json_schema_input_type=AnyEngine | Annotated[list[AnyEngine], Field(min_length=1)]),
    AfterValidator(lambda tables: tuple(itertools.chain.from_iterable(tables))),
]
