"""Whether a dataset is, byte for byte, what was written."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from stickslip.pipeline.dataset.opened import Opened, open_dataset, reading
from stickslip.pipeline.dataset.schema import is_of, schema_of
from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.own.files import ChangedError
from stickslip.pipeline.own.function import look_again
from stickslip.pipeline.places.directory import Directory
from stickslip.pipeline.places.manifest import SCHEMA_VERSION
from stickslip.pipeline.places.place import DATA, TEMPORARY, Where


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
    found = open_dataset(path)
    place, shards = found.place, sorted(found.manifest.shards.items())
    expected = {batch.name: (batch, recording) for batch, recording in found.tasks}
    problems = []
    for function in found.scene.own_functions if isinstance(place, Directory) else ():
        try:
            look_again(replace(function, at=str(Path(str(place)).resolve())))
        except ChangedError as error:
            problems.append(str(error))
        except SceneError:  # data that were moved are complete without it
            break
    with reading(place):
        files = place.names()
        contents = place.read_each([f"{DATA}/{name}" for name, _ in shards])
        for (name, shard), content in zip(shards, contents, strict=True):
            problem = shard.damage(content)
            if not problem and name not in expected:
                problem = "not a shard of this scene"
            elif not problem:
                batch, recording = expected[name]
                ids = list(batch.members.ids())
                entry = (shard.rows, shard.first, shard.last)
                if entry != (len(ids), ids[0], ids[-1]):
                    problem = f"expected {len(ids)} rows, {ids[0]} to {ids[-1]}, in the manifest, got {entry}"
                problem = problem or _content(content or b"", schema_of(recording), ids, shard.outcomes)
            if problem:
                problems.append(f"{place.named(f'{DATA}/{name}')}: {problem}")
    known = {f"{DATA}/{name}" for name in found.manifest.known}
    strays = [name for name in files if name.startswith((f"{DATA}/", TEMPORARY)) and name not in known]
    return problems + [
        f"{place.named(name)}: stray file, not in the manifest: nothing reads it; delete it" for name in strays
    ]


def _content(content: bytes, schema: pa.Schema, ids: list[str], outcomes: Mapping[str, int]) -> str:
    """What is wrong inside a shard whose bytes are as they were written; "" if nothing is."""
    try:
        # a thread of Arrow's may outlive its library, and end the process
        table = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True).read(use_threads=False)
    except (OSError, pa.ArrowException) as error:
        return f"cannot be read ({error}); rerun the scene to rebuild it"
    if not is_of(table.schema, schema) or table.schema.metadata != schema.metadata:
        return f"expected the columns of schema version {SCHEMA_VERSION} and this scene, got others"
    if table.num_rows != len(ids):
        return f"expected {len(ids)} rows, got {table.num_rows}"
    found = table["member_id"].to_pylist()
    wrong = [(a, b) for a, b in zip(ids, found, strict=True) if a != b]
    if wrong:
        return f"expected member {wrong[0][0]}, got {wrong[0][1]}"
    counted = dict(Counter(table["outcome"].to_pylist()))
    return "" if counted == outcomes else f"expected the outcomes {outcomes}, got {counted}"
