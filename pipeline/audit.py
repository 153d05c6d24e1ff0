"""Looking at a dataset: how far it is, and whether it is what it should be."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.manifest import DATA, TEMPORARY, StoreError, dataset_scene, read_manifest
from pipeline.members import batches, expand
from pipeline.shards import SCHEMA_VERSION, shard_schema


@dataclass(frozen=True)
class Status:
    """How far a dataset is. n_done = sum of `outcomes`; `failures` counts failed members by reason."""

    path: Path
    n_members: int
    n_done: int
    outcomes: dict[str, int]
    failures: dict[str, int]
    n_shards: int
    n_bytes: int

    @property
    def is_complete(self) -> bool:
        """Whether every member has its row, whatever its outcome."""
        return self.n_done == self.n_members


def status(path: str | Path) -> Status:
    """Count what is done; good to call while the dataset is being written.

    Raises
    ------
    StoreError
        If there is no readable dataset.
    """
    path = Path(path)
    scene, manifest = dataset_scene(path), read_manifest(path)
    outcomes: Counter[str] = Counter()
    failures: Counter[str] = Counter()
    for name in manifest.shards:
        for row in _read(path / DATA / name, ["outcome", "reason"]).to_pylist():
            outcomes[row["outcome"]] += 1
            if row["outcome"] == "failed":
                failures[row["reason"]] += 1
    return Status(
        path=path,
        n_members=scene.n_members,
        n_done=sum(shard.rows for shard in manifest.shards.values()),
        outcomes=dict(sorted(outcomes.items())),
        failures=dict(failures.most_common()),
        n_shards=len(manifest.shards),
        n_bytes=sum(shard.bytes for shard in manifest.shards.values()),
    )


def verify(path: str | Path) -> list[str]:
    """Check a dataset that nobody is writing; one line a problem, an empty list if there is none.

    Missing, damaged and stray files, wrong row counts, wrong schemas, and members other than the scene's. An
    unfinished dataset is no problem. Running its scene again computes what is missing or damaged, only that.

    Raises
    ------
    StoreError
        If there is no readable dataset.
    """
    path = Path(path)
    scene, manifest = dataset_scene(path), read_manifest(path)
    expected = {batch.name: batch for batch in batches(expand(scene), manifest.scene_hash)}
    schema = shard_schema(manifest.scene_hash, scene.record.events)
    problems = []
    for name, shard in sorted(manifest.shards.items()):
        file = path / DATA / name
        problem = shard.damage(file)
        if not problem and name not in expected:
            problem = "not a shard of this scene"
        elif not problem:
            ids = [member.member_id for member in expected[name].members]
            entry = (shard.rows, shard.first, shard.last)
            if entry != (len(ids), ids[0], ids[-1]):
                problem = f"expected {len(ids)} rows, {ids[0]} to {ids[-1]}, in the manifest, got {entry}"
            problem = problem or _content(file, schema, ids)
        if problem:
            problems.append(f"{file}: {problem}")
    data = path / DATA
    files = list(data.iterdir()) if data.is_dir() else []
    files += [file for file in path.iterdir() if file.name.startswith(TEMPORARY)]
    strays = [file for file in sorted(files) if file.name not in manifest.shards]
    return problems + [f"{file}: stray file, not in the manifest" for file in strays]


def _content(file: Path, schema: pa.Schema, ids: list[str]) -> str:
    """What is wrong inside a shard whose bytes are as they were written: "" if nothing."""
    try:
        table = _read(file)
    except StoreError as error:
        return str(error)
    if not table.schema.equals(schema, check_metadata=True):
        return f"expected the columns of schema version {SCHEMA_VERSION} and this scene, got others"
    if table.num_rows != len(ids):
        return f"expected {len(ids)} rows, got {table.num_rows}"
    found = table["member_id"].to_pylist()
    wrong = [(a, b) for a, b in zip(ids, found, strict=True) if a != b]
    return f"expected member {wrong[0][0]}, got {wrong[0][1]}" if wrong else ""


def _read(file: Path, columns: list[str] | None = None) -> pa.Table:
    try:
        return pq.ParquetFile(file, page_checksum_verification=True).read(columns)
    except (OSError, pa.ArrowException) as error:
        raise StoreError(f"{file}: cannot be read ({error}); run the scene again to compute it anew") from error
