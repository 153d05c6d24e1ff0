"""All keys of a scene in words, from the schema that checks it: for `stickslip schema --keys` and for the guide."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from stickslip.workflows.scaffold import schema

_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


@dataclass(frozen=True)
class Key:
    """A key of a scene: what it means, what may be written, and what holds if nothing is, as TOML or in words."""

    name: str
    meaning: str
    values: str
    default: str


@dataclass(frozen=True)
class KeyTable:
    """A table of a scene: its place as a path ("" above all tables), how a file begins it, what it is, its keys."""

    path: str
    head: str
    about: str
    keys: tuple[Key, ...]


def key_tables(chart: str | None) -> list[KeyTable]:
    """The tables of an ensemble's scene, or of one kind of chart's, in the order of the schema."""
    whole = schema(chart)
    top = KeyTable("", "", "above all tables", _keys(whole))
    return [top, *_below(whole, whole.get("$defs", {}), "")]


def lines(chart: str | None) -> list[str]:
    """A line for each key under the head of its table: path, default, meaning and in brackets the values."""
    tables = key_tables(chart)
    named = {f"{table.path}{key.name}": len(key.default) for table in tables for key in table.keys}
    width, wide = max(map(len, named)), max(named.values())
    found = ["key, default, meaning (values)"]
    if chart is None:
        found[0] += "; picked: for statistics or for paths, see `purpose`"
    for table in tables:
        found += ["", f"{table.head}: {table.about}" if table.head else table.about]
        found += [
            f"{table.path + key.name:{width}}  {key.default:{wide}}  {key.meaning} ({key.values})"
            for key in table.keys
        ]
    return found


def _below(table: Mapping[str, Any], kept: Mapping[str, Any], path: str) -> Iterator[KeyTable]:
    for name, field in table["properties"].items():
        for reference in dict.fromkeys(_references(field)):
            below = kept[reference]
            head, _, about = below["description"].partition("\n")[0].partition(": ")
            yield KeyTable(f"{path}{name}.", head, about, _keys(below))
            yield from _below(below, kept, f"{path}{name}.")


def _references(field: Any) -> Iterator[str]:
    """The names of the tables that may stand at a key."""
    if isinstance(field, dict):
        if "$ref" in field:
            yield field["$ref"].rpartition("/")[2]
        for part in ("oneOf", "anyOf", "items"):
            yield from _references(field.get(part))
    elif isinstance(field, list):
        for part in field:
            yield from _references(part)


def _keys(table: Mapping[str, Any]) -> tuple[Key, ...]:
    return tuple(
        Key(name, field["description"], _values(field), _default(name, field, name in table.get("required", ())))
        for name, field in table["properties"].items()
        if not any(_references(field)) and name != "name"  # the name of an engine stands in the head of its table
    )


def _default(name: str, field: Mapping[str, Any], is_required: bool) -> str:
    from stickslip.pipeline.scene import TOLERANCES

    if "default" in field:
        return json.dumps(field["default"])
    if is_required:
        return f"required, e.g. {json.dumps(field['examples'][0])}"
    picked = [f"{tolerances[name]:g}" for tolerances in TOLERANCES.values() if name in tolerances]
    return f"picked, {' or '.join(picked)}" if picked else "left out"


def _values(field: Mapping[str, Any]) -> str:
    """What may be written: choices, or a type with its bounds."""
    if "anyOf" in field:  # one value, or a list of such
        return f"{_values(field['anyOf'][0])}; or a list"
    if "enum" in field or "const" in field:
        return ", ".join(json.dumps(choice) for choice in field.get("enum", [field.get("const")]))
    if field["type"] == "array":
        return f"list of: {_values(field['items'])}"
    if field["type"] in ("boolean", "string"):
        return {"boolean": "true, false", "string": "text"}[field["type"]]
    bounds = ", ".join(f"{sign} {field[word]}" for word, sign in _BOUNDS.items() if word in field)
    return f"{field['type']} {bounds}".rstrip()
