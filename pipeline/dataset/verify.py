"""Whether a dataset is, byte for byte, what was written."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from stickslip.pipeline.dataset.opened import Opened, open_dataset, reading
from stickslip.pipeline.dataset.pages import UnsoundError
from stickslip.pipeline.dataset.schema import is_of_scene, schema_of
from stickslip.pipeline.dataset.sound import check_counts, told_of, wrong_columns
from stickslip.pipeline.errors import SceneError, StoreError, printable
from stickslip.pipeline.own.files import ChangedError
from stickslip.pipeline.places.directory import Directory
from stickslip.pipeline.places.manifest import read_shards
from stickslip.pipeline.places.place import DATA, PACKAGE, TEMPORARY, Where


def verify(path: Where | Opened) -> list[str]:
    """Check a dataset that nobody is writing; one line a problem, an empty list if there is none.

    Problems are missing, damaged and stray files, wrong row counts, outcomes and schemas, members other than the
    scene's, and a changed function of the user's, or module beside it. An unfinished dataset is no problem. Running
    its scene again computes what is missing or damaged, and only that.

    Raises
    ------
    StoreError
        If there is no readable dataset.
    """
    opened = open_dataset(path)
    place, shards = opened.place, dict(sorted(opened.manifest.shards.items()))
    expected = {batch.name: batch for batch in opened.tasks}
    problems = []
    for function in opened.scene.own_functions if isinstance(place, Directory) else ():
        try:
            replace(function, at=str(Path(str(place)).resolve())).look_again()
        except ChangedError as error:
            problems.append(str(error))
        except SceneError:  # data that were moved are complete without it
            break
    with reading(place):
        files = place.names()
        for name, content, problem in read_shards(place, shards):
            shard = shards[name]
            if not problem and name not in expected:
                problem = "not a shard of this scene"
            elif not problem:
                ids = list(expected[name].members.ids())
                entry = (shard.rows, shard.first, shard.last)
                if entry != (len(ids), ids[0], ids[-1]):
                    problem = f"expected {len(ids)} rows, {ids[0]} to {ids[-1]}, in the manifest, got {entry}"
            if problem:
                problems.append(printable(f"{opened.file(name)}: {problem}"))
                continue
            try:
                _check_content(opened, name, content, schema_of(expected[name].recording))
            except StoreError as error:
                problems.append(str(error))
    if fault := opened.manifest.fault_of_package(place):
        problems.append(printable(f"{place.named(PACKAGE)}: {fault}; rerun the scene to rewrite it"))
    names = {f"{DATA}/{name}" for name in opened.manifest.shards}
    strays = [name for name in files if name.startswith((f"{DATA}/", TEMPORARY)) and name not in names]
    return problems + [
        printable(f"{place.named(name)}: stray file, not in the manifest: nothing reads it; delete it")
        for name in strays
    ]


def _check_content(opened: Opened, name: str, content: bytes, schema: pa.Schema) -> None:
    """Raise `StoreError` if something is wrong inside a shard whose bytes are as they were written."""
    table = opened.read(name, content, schema.names)
    with told_of(opened.file(name)):
        if not is_of_scene(pq.read_metadata(pa.BufferReader(content)).metadata, schema):
            raise wrong_columns(table.schema, schema)
    opened.check_members(name, table)
    with told_of(opened.file(name)):
        check_counts(table)
        counted, outcomes = dict(Counter(table["outcome"].to_pylist())), opened.manifest.shards[name].outcomes
        if counted != outcomes:
            raise UnsoundError(f"expected the outcomes {outcomes}, got {counted}")
