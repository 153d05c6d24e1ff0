"""A dataset with more records than another: what that one keeps of its runs is not computed again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stickslip.pipeline.dataset.opened import Opened, open_dataset
from stickslip.pipeline.dataset.status import Status
from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.own.modules import folder_with
from stickslip.pipeline.places.place import Where
from stickslip.pipeline.records.own import OwnRecord, look_at_functions, named_functions
from stickslip.pipeline.running.driver import run_ensemble
from stickslip.pipeline.scene.scene import Scene, parse_scene
from stickslip.pipeline.scene.source import parse_toml
from stickslip.pipeline.scene.toml import plain, written


def extend(path: Where | Opened, record: Mapping[str, Any], out: Where, workers: int = 2, **options: Any) -> Status:
    """Run the scene of a dataset with more records into another one, or what is missing of it.

    A record is computed from what the dataset keeps of a run, as its events, if it needs no more; else the member is
    run again. The dataset itself stays as it is.

    Parameters
    ----------
    path : str, Path, Place or Opened
        Directory of the dataset, or its address in an object store.
    record : mapping of str to value
        Keys under [record] of its scene: ``{"waiting": True, "t_burn": 50.0}``. The module of functions of a user's
        own, ``{"own": ["mine:quiet_share"]}``, lies beside the dataset, above it, or in the working directory.
    out : str, Path or Place
        Directory of the new dataset, or its address.
    workers, **options
        As `run_ensemble`.

    Raises
    ------
    SceneError
        If a key is unknown or does not apply, or adds nothing; or as `run_ensemble`.
    StoreError
        If the dataset is damaged; or as `run_ensemble`.
    ValueError, AddressError, ScheduleError
        As `run_ensemble`.
    """
    opened = open_dataset(path)
    return run_ensemble(with_records(opened, record), out, workers, kept=opened, **options)


def with_records(opened: Opened, record: Mapping[str, Any]) -> Scene:
    """The scene of a dataset with more keys under [record].

    Where a scene leaves tolerances out, records of paths pick finer ones. Here the runs stay what they are: what the
    tolerances were picked for is written down as the scene's `purpose`. Raises `SceneError` if a key is unknown or
    does not apply, or adds nothing.
    """
    scene, folder = opened.scene, opened.folder
    tables = parse_toml(scene.source, "scene")
    old_keys = tables.get("record", {})
    new_keys = plain(record)
    keys = old_keys | new_keys
    if names := named_functions(new_keys.get(OwnRecord.name)):
        names = [*dict.fromkeys([*named_functions(old_keys.get(OwnRecord.name)), *names])]
        folder = folder_with(names[0].partition(":")[0], folder)
        keys |= {OwnRecord.name: names, "functions": look_at_functions(names, folder)}

    def parsed(tables: Mapping[str, Any]) -> Scene:
        return parse_scene(written(tables), "with these records", folder)

    tables["record"] = keys
    extended = parsed(tables)
    if extended.engines != scene.engines:
        extended = parsed(tables | {"run": tables["run"] | {"purpose": scene.purpose}})
    if all(record in scene.records for record in extended.records):
        raise SceneError(
            f"record: expected a record that the data lack, got {', '.join(new_keys) or 'none'}, which they have;"
            " name another, as in `waiting = true`"
        )
    return extended
