"""Looking at a dataset: how far it is, and whether it is what it should be."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import pyarrow as pa
import pyarrow.parquet as pq

from stickslip.pipeline.dataset import rows_that_failed
from stickslip.pipeline.errors import StoreError
from stickslip.pipeline.ledger import dataset_scene, read_manifest, read_tasks
from stickslip.pipeline.schema import SCHEMA_VERSION
from stickslip.pipeline.storage import DATA, TEMPORARY, Place, Where, place_of


@dataclass(frozen=True)
class Status:
    """How far a dataset is. n_done = sum of `outcomes`; `failures` counts failed members by reason."""

    path: str  #: the directory, or the address
    n_members: int
    n_done: int
    outcomes: dict[str, int]
    failures: dict[str, int]
    n_shards: int
    n_bytes: int
    n_missing: int  #: of the shards that are done, those whose files are gone
    first_failed: str | None  #: a failed member, to be run alone

    @property
    def is_complete(self) -> bool:
        """Whether every member has its row, whatever its outcome."""
        return self.n_done == self.n_members


def status(path: Where) -> Status:
    """Count what is done; good to call while the dataset is being written.

    Raises
    ------
    StoreError
        If there is no readable dataset, or a shard with failed members is not what was written.
    """
    place = place_of(path)
    scene, manifest = dataset_scene(place), read_manifest(place)
    with _readable(place):  # after the manifest: a shard is there before it is listed
        files = set(place.names())
    outcomes: Counter[str] = Counter()
    for shard in manifest.shards.values():
        outcomes.update(shard.outcomes)
    with_failed = [name for name, shard in sorted(manifest.shards.items()) if shard.n_failed]
    there = [name for name in with_failed if f"{DATA}/{name}" in files]
    failed = rows_that_failed(place, there) if there else []
    return Status(
        path=str(place),
        n_members=scene.n_members,
        n_done=sum(shard.rows for shard in manifest.shards.values()),
        outcomes=dict(sorted(outcomes.items())),
        failures=dict(Counter(reason for _, reason in failed).most_common()),
        n_shards=len(manifest.shards),
        n_bytes=sum(shard.bytes for shard in manifest.shards.values()),
        n_missing=sum(f"{DATA}/{name}" not in files for name in manifest.shards),
        first_failed=failed[0][0] if failed else None,
    )


def verify(path: Where) -> list[str]:
    """Check a dataset that nobody is writing; one line a problem, an empty list if there is none.

    Missing, damaged and stray files, wrong row counts, outcomes and schemas, and members other than the scene's. An
    unfinished dataset is no problem. Running its scene again computes what is missing or damaged, only that.

    Raises
    ------
    StoreError
        If there is no readable dataset.
    """
    place = place_of(path)
    manifest = read_manifest(place)
    expected = {batch.name: (batch, recording) for batch, recording in read_tasks(place, manifest)}
    problems = []
    shards = sorted(manifest.shards.items())
    with _readable(place):
        files = place.names()
    contents = place.read_each([f"{DATA}/{name}" for name, _ in shards])
    for name, shard in shards:
        with _readable(place):
            content = next(contents)
        problem = shard.damage(content)
        if not problem and name not in expected:
            problem = "not a shard of this scene"
        elif not problem:
            batch, recording = expected[name]
            ids = [member.member_id for member in batch.members]
            entry = (shard.rows, shard.first, shard.last)
            if entry != (len(ids), ids[0], ids[-1]):
                problem = f"expected {len(ids)} rows, {ids[0]} to {ids[-1]}, in the manifest, got {entry}"
            problem = problem or _content(content, recording.schema, ids, shard.outcomes)
        if problem:
            problems.append(f"{place.named(f'{DATA}/{name}')}: {problem}")
    known = {f"{DATA}/{name}" for name in manifest.shards}
    strays = [name for name in files if name.startswith((f"{DATA}/", TEMPORARY)) and name not in known]
    return problems + [f"{place.named(name)}: stray file, not in the manifest" for name in strays]


@contextlib.contextmanager
def _readable(place: Place) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreError(f"{error.filename or place}: cannot be read ({error.strerror}); {place.remedy}") from error


def _content(content: bytes | None, schema: pa.Schema, ids: list[str], outcomes: Mapping[str, int]) -> str:
    """What is wrong inside a shard whose bytes are as they were written: "" if nothing."""
    try:
        table = pq.ParquetFile(pa.BufferReader(content or b""), page_checksum_verification=True).read()
    except (OSError, pa.ArrowException) as error:
        return f"cannot be read ({error}); run the scene again to rebuild it"
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
