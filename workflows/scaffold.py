"""Before the first run: the scenes that ship, a new scene, and all keys of a scene."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from stickslip.pipeline.errors import command
from stickslip.pipeline.places.directory import Directory
from stickslip.workflows.scenes import shipped

#: The schema that a new scene's first line names, beside the scene.
SCHEMA = "stickslip.schema.json"

_HEAD = """#:schema ./{schema}
# A scene: which systems, run how, what is kept, and what to make of it. All quantities are dimensionless.
# `stickslip schema --keys` lists all keys; `{run} --dry-run` says what the scene would take.
"""


class NotWritten(ValueError):
    """A file that cannot be written where it was asked for; the message says why and what to do."""


def listing() -> list[str]:
    """A line for each scene that ships: name, members, time, purpose."""
    lines = [f"{'scene':16}{'members':>8}{'time':>8}  about"]
    for name, file in shipped().items():
        table = tomllib.loads(file.read_text(encoding="utf-8"))
        lines.append(
            f"{name:16}{_members(table, file):>8}{_time(table.get('minutes')):>8}  {table.get('about', '')}".rstrip()
        )
    return [*lines, "\ntime: on two cores, with the report and without compilation; a chart has no members"]


def _members(table: dict[str, Any], file: Path) -> str:
    if "chart" in table:
        return "chart"
    from stickslip.pipeline import load_scene

    return str(load_scene(file).n_members)


def _time(minutes: float | None) -> str:
    if minutes is None:
        return ""
    return f"{60 * minutes:.0f} s" if minutes < 1 else f"{minutes:g} min"


def new_scene(file: Path) -> list[str]:
    """Write a commented scene to start from, and the schema by which an editor completes it; lines that say so.

    A name that does not end in .toml is given that ending, without which it would not be found as a scene.

    Raises `NotWritten` if there is a file or a directory of that name; `OSError` if it cannot be written.
    """
    if file.is_dir():
        raise NotWritten(f"FILE: expected the name of a new file, got the directory {str(file)!r}; name a file in it")
    if file.suffix != ".toml":
        file = file.with_name(f"{file.name}.toml")
    if os.path.lexists(file):
        raise NotWritten(
            f"FILE: expected a name that is free, got {str(file)!r}, which exists; choose another, or remove it"
        )
    beside, run = file.with_name(SCHEMA), command("run", str(file))
    files = {file.name: lambda: (_HEAD.format(schema=SCHEMA, run=command("run", file.name)) + _body()).encode()}
    if not os.path.lexists(beside):
        files[SCHEMA] = lambda: schema_text(None).encode()
    Directory(file.parent).replace_all(files)
    return [
        f"scene   {file}",
        f"schema  {beside}: editors with a TOML language server complete and check the scene by it",
        "next    edit the scene, then",
        f"  {run} --dry-run    what it would take",
        f"  {run}              run it, into runs/{file.stem}",
    ]


def _body() -> str:
    """The scene `quick` without its head comment and the time it took, which describe `quick` alone."""
    lines = shipped()["quick"].read_text(encoding="utf-8").splitlines(keepends=True)
    first = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    return "".join(line for line in lines[first:] if not line.startswith("minutes"))


def schema(chart: str | None) -> dict[str, Any]:
    """JSON Schema of an ensemble's scene, or of the scene of one kind of chart."""
    from stickslip.pipeline import Scene
    from stickslip.pipeline.scene.toml import json_schema
    from stickslip.workflows.gallery import chart as scene_of

    if chart is not None:
        return json_schema(scene_of(chart))
    tables = json_schema(Scene)
    _name_the_questions(tables)
    return tables


def _name_the_questions(schema: dict[str, Any]) -> None:
    """Put into the schema of an ensemble which questions a report answers; pipeline does not know them."""
    from stickslip.analysis.questions import QUESTIONS

    one, several = schema["$defs"]["AnalysisTable"]["properties"]["question"]["anyOf"]
    for name in (one, several["items"]):
        own = name.pop("pattern")
        name |= {"anyOf": [{"enum": list(QUESTIONS)}, {"pattern": own}]}


def schema_text(chart: str | None) -> str:
    """The same as the text of a file."""
    return json.dumps(schema(chart), indent=1) + "\n"


# ---------------------------------------------------------------------------------------------- the keys

_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


class Key(NamedTuple):
    """A key of a scene: its path, meaning, allowed values and default."""

    path: str
    meaning: str
    values: str
    default: str


def key_tables(chart: str | None) -> list[tuple[str, str, list[Key]]]:
    """The tables of a scene, of an ensemble or a kind of chart: head as in a file, description, keys."""
    whole = schema(chart)
    top = whole | {"description": ": above all tables"}
    return list(_tables("", top, whole.get("$defs", {})))


def _tables(path: str, table: dict[str, Any], known: dict[str, Any]) -> Iterator[tuple[str, str, list[Key]]]:
    head, _, about = table["description"].partition("\n")[0].partition(": ")
    keys, below = [], []
    for name, field in table["properties"].items():
        others = dict.fromkeys(re.findall(r'"#/\$defs/(\w+)"', json.dumps(field)))
        below += [(f"{path}{name}.", known[other]) for other in others]
        if not others and name != "name":  # the name of an engine stands in the head of its table
            default = _default(name, field, name in table.get("else", table).get("required", ()))
            keys.append(Key(path + name, field["description"], _values(field), default))
    yield head, about, keys
    for inner, other in below:
        yield from _tables(inner, other, known)


def _default(name: str, field: dict[str, Any], is_required: bool) -> str:
    from stickslip.pipeline.scene.engine_table import TOLERANCES

    if "default" in field:
        return json.dumps(field["default"])
    if is_required:
        return f"required, e.g. {json.dumps(field['examples'][0])}"
    picked = [f"{tolerances[name]:g}" for tolerances in TOLERANCES.values() if name in tolerances]
    return f"picked, {' or '.join(picked)}" if picked else "left out"


def _values(field: dict[str, Any]) -> str:
    """The allowed values: choices, or a type with its bounds."""
    from stickslip.pipeline.design.values import DISTRIBUTIONS

    if "anyOf" in field:  # one value, or a list of such; or what each block is drawn from, or a word for it
        first, *others = field["anyOf"]
        ways = ["a list"] if any(choice.get("type") == "array" for choice in others) else []
        tables = [choice["properties"] for choice in others if "properties" in choice]
        pairs = [{key: "[numbers]" if "type" in value else "1.2" for key, value in table.items()} for table in tables]
        inside = (
            ", ".join(f"{key} = {DISTRIBUTIONS.get(key, value)}" for key, value in pair.items()) for pair in pairs
        )
        ways += [f"{{{keys}}}" for keys in inside]
        ways += [json.dumps(choice["const"]) for choice in others if "const" in choice]
        ways += ["module:function" for choice in others if "pattern" in choice]
        return f"{_values(first)}; or {', '.join(ways)}"
    if "enum" in field or "const" in field:
        return ", ".join(json.dumps(choice) for choice in field.get("enum", [field.get("const")]))
    if field["type"] == "array":
        return f"list of: {_values(field['items'])}"
    if field["type"] in ("boolean", "string"):
        return {"boolean": "true, false", "string": "text"}[field["type"]]
    bounds = ", ".join(f"{sign} {field[word]}" for word, sign in _BOUNDS.items() if word in field)
    return f"{field['type']} {bounds}".rstrip()


def key_lines(chart: str | None) -> list[str]:
    """A line for each key under the head of its table: path, default, meaning and in brackets the values."""
    tables = key_tables(chart)
    width, wide = (max(len(key[k]) for _, _, keys in tables for key in keys) for k in (0, 3))
    picked = "" if chart is not None else "; picked: for statistics or for paths, see `purpose`"
    lines = [f"key, default, meaning (values){picked}"]
    for head, about, keys in tables:
        lines += ["", f"{head}: {about}" if head else about]
        lines += [f"{key.path:{width}}  {key.default:{wide}}  {key.meaning} ({key.values})" for key in keys]
    return lines
