"""A scene with more records: what its dataset is extended to."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.records import RECORDS
from stickslip.pipeline.records.own import OwnRecord
from stickslip.pipeline.records.record import Record, WindowRecord
from stickslip.pipeline.scene.scene import Scene, parse_scene
from stickslip.pipeline.scene.source import parse_toml
from stickslip.pipeline.scene.tables import RecordTable, RunTable
from stickslip.pipeline.scene.toml import plain, written

#: The keys that each ask for a record.
_NAMES = frozenset(record.name for record in RECORDS)


def with_records(scene: Scene, keys: Mapping[str, Any], folder: Path = Path()) -> Scene:
    """A scene with more keys under [record], and the same runs.

    Where a scene leaves tolerances out, records of paths pick finer ones. Here the runs stay what they are: what the
    tolerances were picked for is written down as the scene's `purpose`.

    Parameters
    ----------
    scene : Scene
    keys : mapping of str to value
        As a file has them under [record]; a list is added to one that is there.
    folder : Path
        Where files are looked for that the scene names.

    Raises
    ------
    SceneError
        If a key is unknown or does not apply, or a record is there already, or would change one that is.
    """
    tables = parse_toml(scene.source, "scene")
    there = tables.get("record", {})
    if others := [key for key in keys if key in RunTable.model_fields and key not in RecordTable.model_fields]:
        raise SceneError(
            f"record.{others[0]}: expected a key under [record], got one under [run]; change it in the scene, and run"
            " that with this directory: it computes what is new"
        )
    new = {key: _joined(there.get(key), value) for key, value in plain(keys).items()}
    for key, value in new.items():
        if there.get(key) == value and key in _NAMES:
            raise SceneError(
                f"record.{key}: expected a record that the data lack, got one that they have; leave it out"
            )
    found = _parsed(scene, tables | {"record": there | new}, folder)
    if found.engines != scene.engines:
        run = tables["run"] | {"purpose": scene.purpose}
        found = _parsed(scene, tables | {"record": there | new, "run": run}, folder)
    _check(scene, found)
    return found


def _joined(before: Any, value: Any) -> Any:
    """The value of a key that gets more: lists and tables are joined."""
    if isinstance(value, list):
        return [*dict.fromkeys([*([before] if isinstance(before, str) else before or []), *value])]
    return {**(before or {}), **value} if isinstance(value, dict) else value


def has_records(scene: Scene, keys: Mapping[str, Any]) -> bool:
    """Whether a scene has these keys under [record]."""
    there = parse_toml(scene.source, "scene").get("record", {})
    return all(_holds(there.get(key), value) for key, value in plain(keys).items())


def _holds(before: Any, value: Any) -> bool:
    """Whether the value of a key is there already: lists and tables, in what is there."""
    if isinstance(before, list) or isinstance(value, list):
        return set(_joined(value, [])) <= set(_joined(before, []))
    return value.items() <= (before or {}).items() if isinstance(value, dict) else before == value


def lines_between(before: Scene, wanted: Scene) -> list[str]:
    """The keys, with values, by which `with_records` gives the records of another scene; none if it cannot."""
    there, asked = before.record.model_dump(exclude_unset=True), wanted.record.model_dump(exclude_unset=True)
    keys = {key: value for key, value in asked.items() if there.get(key) != value}
    try:
        if with_records(before, keys, before.folder).records != wanted.records:
            return []
    except SceneError:
        return []
    own = [*keys.pop("own", ())] if keys.pop("functions", None) else []  # `extend` looks at functions itself
    return own + [key if value is True else _line(key, value).replace(" = ", "=") for key, value in keys.items()]


def with_only(scene: Scene, records: Sequence[Record], folder: Path = Path()) -> Scene:
    """The scene with the same runs, of which no more is kept than some of its records."""
    tables = parse_toml(scene.source, "scene")
    dropped = {name for name in _NAMES if name not in {one.name for one in records}}
    if OwnRecord.name in dropped:
        dropped.add("functions")
    if not any(isinstance(one, WindowRecord) for one in records):
        dropped.add("t_burn")
    if not any(one.is_sampled for one in records):
        dropped.add("dt")
    kept = {key: value for key, value in tables["record"].items() if key not in dropped}
    return _parsed(scene, tables | {"record": kept, "run": tables["run"] | {"purpose": scene.purpose}}, folder)


def _line(key: str, value: Any) -> str:
    return written({key: value}).strip()


def _parsed(scene: Scene, tables: Mapping[str, Any], folder: Path) -> Scene:
    """The scene of some tables: with the words of its file, where these can be kept, else written anew."""
    found = parse_scene(written(tables), "with these records", folder)
    text = _edited(scene.source, tables)
    return found if text is None else parse_scene(text, "with these records", folder)


def _edited(text: str, tables: Mapping[str, Any]) -> str | None:
    """A scene's file with lines added under [record] and [run], if that makes it one of `tables`; else None."""
    before = parse_toml(text, "scene")
    for name in ("run", "record"):
        lines = [_line(key, value) for key, value in tables[name].items() if key not in before.get(name, {})]
        added = "".join(f"{line}\n" for line in lines)
        if not added:
            continue
        # a table, up to the next one
        table = re.search(rf"^\[{name}\].*?(?=\s*(^\[|\Z))", text, flags=re.MULTILINE | re.DOTALL)
        if table is None:
            text = f"{text.rstrip()}\n\n[{name}]\n{added}"
        else:
            text = f"{text[: table.end()]}\n{added}{text[table.end() :].removeprefix(chr(10))}"
    try:
        return text if parse_toml(text, "scene") == tables else None
    except SceneError:  # a table within a line
        return None


def _check(before: Scene, found: Scene) -> None:
    """See that a scene has the records of the other, unchanged, and more."""
    of_name = {record.name: record for record in found.records}
    for record in before.records:
        other = of_name.get(record.name)
        if other is None:
            raise SceneError(
                f"record.{record.name}: expected records that the data lack, got none for one that they have; records"
                " are only added: leave it out, or run the scene without it into another directory"
            )
        if other != record:
            raise SceneError(
                f"record.{record.name}: expected what the data have, {_of(record)}, got {_of(other)}; leave out what"
                " changes it, or run the scene into another directory"
            )
    for record in found.records:
        if record.is_certified and record.name not in {one.name for one in before.records}:
            raise SceneError(
                f"record.{record.name}: expected a record that changes no other column, got one for which more runs"
                " are tested for collapse; run the scene with it into another directory"
            )
    if found.records == before.records:
        raise SceneError("record: expected a record that the data lack, got none; name one, as in `waiting = true`")


def _of(record: Record) -> str:
    """A record with its settings, in words."""
    return ", ".join(f"{key} = {value}" for key, value in vars(record).items()) or record.name
