"""What a function of a user's own declares that it measures: fields of a named tuple, with types and words."""

from __future__ import annotations

import inspect
import numbers
import sys
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

from stickslip.pipeline.design.units import DIMENSIONS
from stickslip.pipeline.errors import SceneError, foreign
from stickslip.pipeline.own.function import OwnFunction

#: The types that a field may have.
TYPES = (float, int, bool, str)

#: Name of the argument by which a function asks for states.
SAMPLES = "samples"

_MOST = sys.float_info.max
#: What a field may say of its values.
_SAID = ("least", "most", "absent", "since", "dimension")
_FORM = (
    "write `def share(run, system, window) -> Measured`, with class Measured(NamedTuple) and a line as in `quiet:"
    ' Annotated[float, "what it is"]` for each column'
)


def declared(function: OwnFunction, measure: Callable[..., Any]) -> dict[str, Any]:
    """The columns of a function that measures runs, as plain values, and whether it asks for states.

    `measure` is the function itself, as `use` hands it to its work. Raises `SceneError` if it takes other arguments,
    or does not declare what it returns.
    """
    where, parameters = f"{function.key}: {function.name}", inspect.signature(measure).parameters
    is_sampled = SAMPLES in parameters
    try:
        inspect.signature(measure).bind(*"rsw", **({SAMPLES: ()} if is_sampled else {}))
    except TypeError:
        raise SceneError(
            f"{where}: expected the arguments (run, system, window), and `{SAMPLES}` or none, got"
            f" ({', '.join(parameters)}); change them"
        ) from None
    try:
        returned = typing.get_type_hints(measure, include_extras=True).get("return")
        fields = getattr(returned, "_fields", ())
        hints = typing.get_type_hints(returned, include_extras=True) if returned and fields else {}
    except (NameError, TypeError, AttributeError) as error:  # names that only a checker of types has
        raise SceneError(f"{where}: its annotations cannot be read ({foreign(error)}); {_FORM}") from None
    if not fields:
        got = "none" if returned is None else getattr(returned, "__name__", str(returned))
        raise SceneError(f"{where}: expected it to declare that it returns a NamedTuple, got {got}; {_FORM}")
    return {"is_sampled": is_sampled, "columns": {field: _column(where, field, hints.get(field)) for field in fields}}


def _column(where: str, field: str, hint: Any) -> dict[str, Any]:
    """The column of a field, by its annotation."""
    kind, *notes = typing.get_args(hint) if typing.get_origin(hint) is typing.Annotated else (hint,)
    words = " ".join(next((note for note in notes if isinstance(note, str)), "").split())
    if not words or not words.isprintable():
        raise SceneError(f"{where}: expected words for {field}, got {words or 'none'!a}; {_FORM}")
    kinds = typing.get_args(kind) if typing.get_origin(kind) in (typing.Union, types.UnionType) else (kind,)
    plain = [kind_name for kind_name in kinds if kind_name is not type(None)]
    if len(plain) != 1 or plain[0] not in TYPES:
        names = ", ".join(kind_name.__name__ for kind_name in TYPES)
        raise SceneError(
            f"{where}: expected one of {names} for {field}, with `| None` if it may have no value, got"
            f" {getattr(kind, '__name__', kind)}; change it"
        )
    column = {"type": plain[0].__name__, "words": words, "is_optional": len(kinds) > 1}
    return column | _meaning(where, field, column, [note for note in notes if isinstance(note, Mapping)])


def _meaning(where: str, field: str, column: Mapping[str, Any], notes: Sequence[Mapping[Any, Any]]) -> dict[str, Any]:
    """What a field says of its values besides its words: below what they never are, and why a run may have none."""
    meaning = {key: value for note in notes for key, value in note.items()}
    odd = next((key for key in meaning if key not in _SAID), None)
    if odd is not None:
        listed = f"{', '.join(map(repr, _SAID[:-1]))} or {_SAID[-1]!r}"
        raise SceneError(f"{where}: expected {listed} for {field}, got {odd!r:.80}; remove it")
    column_facts: dict[str, Any] = {}

    def take(key: str, is_right: bool, expected: str, got: str, value: object) -> None:
        if not is_right:
            raise SceneError(f"{where}: expected {expected}, got {got}; change it")
        column_facts[key] = value

    if "least" in meaning:
        lower, is_number = meaning["least"], column["type"] in ("float", "int")
        got = f"{lower!r:.80}" if is_number else f"a {column['type']}"
        expected = f"a finite number as 'least' of {field}, a number"
        take("least", is_number and _is_number(lower, -_MOST), expected, got, _float(lower))
    if "most" in meaning:
        upper, is_from_0 = meaning["most"], column_facts.get("least") == 0.0
        got = f"{upper!r:.80}" if is_from_0 else "another 'least', or none"
        is_right = is_from_0 and _is_number(upper) and upper > 0
        take("most", is_right, f"a number > 0 as 'most' of {field}, with 'least' 0", got, _float(upper))
    if "absent" in meaning:
        absent, is_optional = meaning["absent"], column["is_optional"]
        got = f"{absent!r:.80}" if is_optional else "a type without it"
        is_right = is_optional and isinstance(absent, str) and bool(absent.strip()) and absent.isprintable()
        expected = f"words as 'absent' of {field}, whose type has `| None`"
        take("absent", is_right, expected, got, " ".join(str(absent).split()))
    if "dimension" in meaning:
        dimension, is_float = meaning["dimension"], column["type"] == "float"
        is_right = is_float and isinstance(dimension, str) and dimension in DIMENSIONS
        got = f"{dimension!r:.80}" if is_float else f"a {column['type']}"
        take("dimension", is_right, f"one of {', '.join(DIMENSIONS)} as 'dimension' of {field}", got, dimension)
    if "since" in meaning:
        since, is_time = meaning["since"], column["type"] == "float" and column["is_optional"]
        got = f"{since!r:.80}" if is_time else "another type"
        expected = f"a time >= 0, or \"t_burn\", as 'since' of {field}, of type float | None"
        is_start = isinstance(since, str) and since == "t_burn"
        take(
            "since", is_time and (is_start or _is_number(since)), expected, got, since if is_start else _float(since)
        )
        column_facts.setdefault("least", 0.0)
        column_facts.setdefault("dimension", "time")
    return column_facts


def _is_number(value: object, lower: float = 0.0) -> bool:
    is_real = isinstance(value, numbers.Real) and not isinstance(value, bool)
    return is_real and lower <= cast("float", value) <= _MOST


def _float(value: object) -> float | None:
    """A number as a float; None if it is none."""
    return float(cast("float", value)) if _is_number(value, -_MOST) else None
