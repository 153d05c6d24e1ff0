"""What scene files of ensembles and charts share: strict tables of TOML; errors name the key."""

from __future__ import annotations

import contextlib
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, TypeVar, get_args

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, WithJsonSchema
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import ErrorDetails, core_schema

from stickslip.pipeline.design.values import as_written
from stickslip.pipeline.errors import SceneError, shortened
from stickslip.sim.numerics.arguments import did_you_mean

#: A dense K of this many blocks is 80 GB.
MAX_BLOCKS = 100_000

#: Values of one key at most: nobody reads a report of more.
MAX_VALUES = 1000


# ---------------------------------------------------------------------------------------------- tables


class StrictTable(BaseModel):
    """A table of a TOML file: nothing unknown, nothing converted, nothing infinite."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


Value = TypeVar("Value", int, float)
Table = TypeVar("Table", bound=StrictTable)


def as_tuple(value: object) -> object:
    """A single number stands for a list of one; a list becomes a tuple, as frozen models hold."""
    if isinstance(value, list):
        return tuple(value)
    return value if isinstance(value, tuple) else (value,)


def once(values: Sequence[Any], n_least: int = 1) -> tuple[Any, ...]:
    """The values of a key, not too many and none of them twice."""
    if not n_least <= len(values) <= MAX_VALUES:
        between = f"{n_least} to" if n_least else "at most"
        raise ValueError(f"expected {between} {MAX_VALUES} values, got {len(values)}; write some, or fewer")
    twice = [value for k, value in enumerate(values) if value in values[:k]]
    if twice:
        raise ValueError(
            f"expected each value once, got {_value(as_written(twice[0]))} more than once; remove the duplicates"
        )
    return tuple(values)


def distinct(values: tuple[Value, ...]) -> tuple[Value, ...]:
    """Ascending and without duplicates: the order in the file means nothing."""
    return tuple(sorted(once(values, n_least=0)))


#: Tags of a key that holds one table or a list of such, which are no part of its path.
SINGLE, SEVERAL = "(single)", "(several)"

#: A list of the file; frozen models hold tuples.
List = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)

Blocks = Annotated[int, Field(ge=1, le=MAX_BLOCKS)]
Positive = Annotated[float, Field(gt=0)]
Natural = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]
BlockNumbers = Annotated[
    tuple[Blocks, ...],
    Field(min_length=1),
    BeforeValidator(as_tuple, json_schema_input_type=Blocks | Annotated[list[Blocks], Field(min_length=1)]),
    AfterValidator(distinct),
]
PositiveNumbers = Annotated[
    tuple[Positive, ...],
    Field(min_length=1),
    BeforeValidator(as_tuple, json_schema_input_type=Positive | Annotated[list[Positive], Field(min_length=1)]),
    AfterValidator(distinct),
]


def optional(description: str, *examples: Any) -> Any:
    """A key that may be left out: pydantic's field of what is then None."""
    return Field(default=None, description=description, examples=[*examples] or None)


def listed(schema: dict[str, Any]) -> WithJsonSchema:
    """The schema of a value, or of a list of values."""
    return WithJsonSchema({"anyOf": [schema, {"type": "array", "items": schema, "minItems": 1}]})


# ---------------------------------------------------------------------------------------------- reading


def as_scene(kind: type[Table], tables: dict[str, Any], name: str) -> Table:
    """A scene of one kind from what its file holds.

    Raises `SceneError` if that is no scene; one line a problem.
    """
    with explained(kind, f"{name}: "):
        return kind.model_validate(tables)


@contextlib.contextmanager
def explained(kind: type[BaseModel], head: str) -> Iterator[None]:
    """Turn what pydantic finds wrong with a scene into a `SceneError`, whose lines begin with `head`."""
    try:
        yield
    except ValidationError as error:
        raise SceneError("\n".join(f"{head}{line}" for line in _problems(error, kind))) from None


def plain(value: Any, path: str = "") -> Any:
    """Tables from Python as a file has them: arrays, ranges, and tables that are objects, written out.

    Raises `SceneError` if a text at `path`, or below it, cannot be written.
    """
    if isinstance(value, str):
        return _text(value, path)
    if hasattr(value, "__array__"):  # NumPy's arrays and numbers, series of pandas
        return plain(np.asarray(value).tolist(), path)
    if isinstance(value, BaseModel):
        return plain(value.model_dump(mode="json", by_alias=True, exclude_unset=True), path)
    if isinstance(value, Mapping):
        below = {_text(str(key), path or "a key"): entry for key, entry in value.items() if entry is not None}
        return {key: plain(entry, f"{path}.{key}" if path else key) for key, entry in below.items()}
    if isinstance(value, list | tuple | range):
        return [plain(entry, f"{path}[{k}]") for k, entry in enumerate(value)]
    return value


def _text(text: str, path: str) -> str:
    """A text that UTF-8 can hold; the name of a file in another encoding, as Python gives it, is none."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise SceneError(
            f"{path}: expected text, got {text!a}, which holds half of a character; write it without"
        ) from None
    return text


def written(tables: Mapping[str, Any], above: str = "") -> str:
    """Tables as TOML: what `parse_toml` reads back, without None. `above`: "system." for tables in it."""
    arrays = {key: value for key, value in tables.items() if _is_array_of_tables(value)}
    inner = {key: value for key, value in tables.items() if isinstance(value, Mapping)}
    lines = _pairs({key: value for key, value in tables.items() if key not in arrays | inner})
    for key, table in inner.items():
        lines += ["", f"[{above}{_name(key)}]", *_pairs(table)]
    for key, entries in arrays.items():
        for table in entries:
            lines += ["", f"[[{above}{_name(key)}]]", *_pairs(table)]
    return "\n".join([*lines, ""])


def _is_array_of_tables(value: object) -> bool:
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(entry, Mapping) for entry in value)


def _pairs(table: Mapping[str, Any]) -> list[str]:
    return [f"{_name(key)} = {_value(value)}" for key, value in table.items() if value is not None]


def _name(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _value(key)


def _value(value: object) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case Mapping():
            return f"{{{', '.join(_pairs(value))}}}"
        case list() | tuple():
            return f"[{', '.join(map(_value, value))}]"
    return repr(value)


class _OfToml(GenerateJsonSchema):
    """JSON Schema of TOML, which has no null: what may be null may be left out."""

    def nullable_schema(self, schema: core_schema.NullableSchema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        property_schema = super().default_schema(schema)
        if isinstance(property_schema.get("default"), dict | None):  # of a table the keys have their own
            property_schema.pop("default", None)
        return property_schema

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False  # the names of the keys with a capital


def json_schema(kind: type[StrictTable]) -> dict[str, Any]:
    """JSON Schema (draft 7) of the scene files of one kind, for editors.

    It has keys, types, ranges, choices, defaults and examples. Conditions between keys are left to
    `as_scene`, which refuses all that the schema refuses, and more.
    """
    return {"$schema": "http://json-schema.org/draft-07/schema#", **kind.model_json_schema(schema_generator=_OfToml)}


# ---------------------------------------------------------------------------------------------- errors


def shown(value: object) -> str:
    """A value in a message, cut short where it is long."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def unquoted(value: object, kind: type[int] | type[float] = float) -> str:
    """What to do about a text that holds a number, as the end of a message; "" if it holds none."""
    try:
        is_number = isinstance(value, str) and math.isfinite(kind(value))
    except ValueError:
        return ""
    return f"; write it without quotes: {value}" if is_number else ""


def _keys(table: type[BaseModel]) -> dict[str, Any]:
    return {field.alias or name: field for name, field in table.model_fields.items()}


def _tables(annotation: Any) -> dict[str, type[BaseModel]]:
    """The tables that may stand at a key, by what their key `name` has to be; "" where there is no choice."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        name = annotation.model_fields.get("name")
        return dict.fromkeys(get_args(name.annotation) if name else ("",), annotation)
    tables: dict[str, type[BaseModel]] = {}
    for argument in get_args(annotation):
        tables |= _tables(argument)
    return tables


def _place(location: tuple[int | str, ...], table: type[BaseModel]) -> tuple[str, type[BaseModel], str | None]:
    """Path as the file has it, the table it is in, and the key there (None: the table itself is meant)."""
    path, key = "", None
    choices: dict[str, type[BaseModel]] = {}
    for step in location:
        if isinstance(step, int):
            path += f"[{step}]"
        elif step in choices:  # the name that chose among several is no part of the path
            table, key, choices = choices[step], None, {}
        elif step in (SINGLE, SEVERAL):
            continue
        else:
            name = shortened(step, 60) or "''"  # as TOML writes an empty key
            path += f".{name}" if path else name
            field = _keys(table).get(step)
            choices = _tables(field.annotation) if field else {}
            table, key = (choices.pop(""), None) if "" in choices else (table, step)
    return path, table, key


def _problems(error: ValidationError, kind: type[BaseModel]) -> Iterator[str]:
    """One line a problem: key, expected, got, remedy."""
    for detail in error.errors():
        if detail["type"] == "too_short" and detail["input"]:  # its values were wrong, and have their own lines
            continue
        path, table, key = _place(detail["loc"], kind)
        yield _problem(path, table, key, detail)


def _problem(path: str, table: type[BaseModel], key: str | None, detail: ErrorDetails) -> str:
    kind, value = detail["type"], detail["input"]
    fields = _keys(table)
    field = fields.get(key) if key is not None else None
    # an example is the default where nothing else is said
    examples = (field.examples or [field.default]) if field else []
    is_plain = bool(examples) and isinstance(examples[0], bool | int | float | str | list | tuple)
    example = f"`{key} = {json.dumps(examples[0])}`" if is_plain and examples[0] not in ("", ()) else ""

    if kind == "value_error":  # our own message; where a whole table was checked, it begins with the key
        message = str(detail["ctx"]["error"])
        is_whole = key is not None or message.startswith("expected")
        return f"{path}: {message}" if is_whole else f"{path}.{message}".lstrip(".")
    if kind == "extra_forbidden":
        parent, _, word = path.rpartition(".")
        remedy = did_you_mean(word, tuple(fields)) or f"; remove it, or use one of {', '.join(fields)}"
        return f"{path}: unknown key of {f'[{parent}]' if parent else 'a scene'}{remedy}"
    if kind == "missing" and example:
        what = field.description if field and field.description else str(key)
        article = "" if what.startswith(("the ", "a ", "an ")) else "the "
        return f"{path}: expected {article}{what}, found nothing; add {example}"
    if kind == "missing":
        return f"{path}: expected a table, found none; add {f'[[{path}]]' if key else f'[{path}]'} and its keys"
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        names, name = tuple(_tables(field.annotation)) if field else (), value.get("name")
        remedy = did_you_mean(name, names) or f'; write `name = "{names[0]}"`'
        return f"{path}.name: expected one of {', '.join(names)}, got {shown(name)}{remedy}"
    if kind in ("model_type", "model_attributes_type"):
        table_line = f"[[{key}]]" if key else f"[{path}]"
        return f"{path}: expected a table, got {shown(value)}; write {table_line} on a line, its keys below"

    expected = (
        "at least one value"
        if kind == "too_short"
        else detail["msg"].removeprefix("Input should be ").replace("tuple", "list")
    )
    if expected.startswith(("greater", "less")):  # pydantic writes a bound of 1e-16 with all its zeros
        words, _, bound = expected.rpartition(" ")
        expected = f"a value {words} {float(bound):g}" if "." in bound else f"a value {expected}"
    got = shown(list(value) if isinstance(value, tuple) else value)
    remedy = f"; {f'e.g. {example}' if example else f'`{key}`'} ({field.description})" if field else ""
    if kind == "literal_error":
        remedy = did_you_mean(value, re.findall(r"'([^']*)'", expected)) or remedy
    if kind in ("int_type", "float_type"):
        remedy = unquoted(value, int if kind == "int_type" else float) or remedy
    if isinstance(value, list) and kind.endswith("_type") and not path.endswith("]"):
        array = re.fullmatch(rf"(\w+)\[\d+\]\.{key}", path)
        advice = (
            f" here, and a table [[{array[1]}]] of its own for each other" if array else ": this key takes no list"
        )
        remedy = f"; write one value{advice}"
    return f"{path}: expected {expected}, got {got}{remedy}"
