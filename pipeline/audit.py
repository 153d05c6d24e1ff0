"""Looking at a dataset: how far it is, and whether it is what it should be."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.manifest import DATA, TEMPORARY, StoreError, dataset_scene, read_manifest, read_tasks
from pipeline.shards import SCHEMA_VERSION


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
    first_failed: str | None  #: a failed member, to be run alone

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
    failed: list[str] = []
    for name, shard in sorted(manifest.shards.items()):
        outcomes.update(shard.outcomes)
        if shard.n_failed:
            rows = _read(path / DATA / name, ["member_id", "outcome", "reason"]).to_pylist()
            failures.update(row["reason"] for row in rows if row["outcome"] == "failed")
            failed += [row["member_id"] for row in rows if row["outcome"] == "failed"]
    return Status(
        path=path,
        n_members=scene.n_members,
        n_done=sum(shard.rows for shard in manifest.shards.values()),
        outcomes=dict(sorted(outcomes.items())),
        failures=dict(failures.most_common()),
        n_shards=len(manifest.shards),
        n_bytes=sum(shard.bytes for shard in manifest.shards.values()),
        first_failed=failed[0] if failed else None,
    )


def verify(path: str | Path) -> list[str]:
    """Check a dataset that nobody is writing; one line a problem, an empty list if there is none.

    Missing, damaged and stray files, wrong row counts, outcomes and schemas, and members other than the scene's. An
    unfinished dataset is no problem. Running its scene again computes what is missing or damaged, only that.

    Raises
    ------
    StoreError
        If there is no readable dataset.
    """
    path = Path(path)
    manifest = read_manifest(path)
    expected = {batch.name: (batch, recording) for batch, recording in read_tasks(path, manifest)}
    problems = []
    for name, shard in sorted(manifest.shards.items()):
        file = path / DATA / name
        problem = shard.damage(file)
        if not problem and name not in expected:
            problem = "not a shard of this scene"
        elif not problem:
            batch, recording = expected[name]
            ids = [member.member_id for member in batch.members]
            entry = (shard.rows, shard.first, shard.last)
            if entry != (len(ids), ids[0], ids[-1]):
                problem = f"expected {len(ids)} rows, {ids[0]} to {ids[-1]}, in the manifest, got {entry}"
            problem = problem or _content(file, recording.schema, ids, shard.outcomes)
        if problem:
            problems.append(f"{file}: {problem}")
    data = path / DATA
    files = list(data.iterdir()) if data.is_dir() else []
    files += [file for file in path.iterdir() if file.name.startswith(TEMPORARY)]
    strays = [file for file in sorted(files) if file.name not in manifest.shards]
    return problems + [f"{file}: stray file, not in the manifest" for file in strays]


def _content(file: Path, schema: pa.Schema, ids: list[str], outcomes: Mapping[str, int]) -> str:
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
    if wrong:
        return f"expected member {wrong[0][0]}, got {wrong[0][1]}"
    counted = dict(Counter(table["outcome"].to_pylist()))
    return "" if counted == outcomes else f"expected the outcomes {outcomes}, got {counted}"


def _read(file: Path, columns: list[str] | None = None) -> pa.Table:
    try:
        return pq.ParquetFile(file, page_checksum_verification=True).read(columns)
    except (OSError, pa.ArrowException) as error:
        raise StoreError(f"{file}: cannot be read ({error}); run the scene again to compute it anew") from error
