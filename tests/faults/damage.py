"""Files that change behind the program's back."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from pipeline import verify
from tests.faults.registry import fault
from tests.faults.world import World, content


def _truncate(world: World, file: Path) -> None:
    os.truncate(file, world.random.randrange(file.stat().st_size))


def _empty(world: World, file: Path) -> None:
    os.truncate(file, 0)


def _flip(world: World, file: Path) -> None:
    spoilt = bytearray(file.read_bytes())
    spoilt[world.random.randrange(len(spoilt))] ^= 1 << world.random.randrange(8)
    file.write_bytes(spoilt)


def _remove(world: World, file: Path) -> None:
    file.unlink()


_WAYS: tuple[Callable[[World, Path], None], ...] = (_truncate, _empty, _flip)


@fault(quick=6, full=300, timeout=900)
def damaged_shards(world: World, count: int) -> int:
    """One to three shards of a copy truncated, emptied or with a bit flipped: found, they alone computed again."""
    done = 0
    while done < count:
        out = world.copy()
        shards = sorted((out / "data").iterdir())
        victims = world.random.sample(shards, min(world.random.randint(1, 3), count - done))
        for file in victims:
            _WAYS[done % len(_WAYS)](world, file)
            done += 1
        kept = {file: file.stat().st_mtime_ns for file in shards if file not in victims}

        def audit(out: Path = out, victims: list[Path] = victims) -> None:
            assert sorted(line.split(": ")[0] for line in verify(out)) == sorted(map(str, victims))

        assert world.fork(audit) == 0
        world.resume(out)
        assert {file: file.stat().st_mtime_ns for file in kept} == kept
    return done


@fault(quick=4, full=60, timeout=300)
def damaged_manifest(world: World, count: int) -> int:
    """The manifest truncated, emptied, with a bit flipped, or missing: made again, nothing computed."""
    ways = (*_WAYS, _remove)
    for k in range(count):
        out = world.copy()
        ways[k % len(ways)](world, out / "manifest.json")
        kept = {file: file.stat().st_mtime_ns for file in (out / "data").iterdir()}
        world.resume(out)
        assert {file: file.stat().st_mtime_ns for file in kept} == kept
    return count


@fault(quick=0, full=40, timeout=300)
def damaged_manifest_and_record(world: World, count: int) -> int:
    """Manifest and record both damaged: what neither confirms is computed again."""
    ways = (*_WAYS, _remove)
    for k in range(count):
        out = world.copy()
        ways[k % len(ways)](world, out / "manifest.json")
        ways[k // len(ways) % len(ways)](world, out / "timings.jsonl")
        world.resume(out)
    return count


@fault(quick=0, full=40, timeout=300)
def damaged_scene_and_record(world: World, count: int) -> int:
    """The copy of the scene and the record damaged: written again."""
    ways = (*_WAYS, _remove)
    for k in range(count):
        out = world.copy()
        ways[k % len(ways)](world, out / "scene.toml")
        ways[k // len(ways) % len(ways)](world, out / "timings.jsonl")
        world.resume(out)
    return count


@fault(quick=1, full=1, timeout=60)
def foreign_files(world: World, count: int) -> int:
    """Files of others: named by the audit where shards are, never touched; leftovers of ours are removed."""
    out = world.copy()
    foreign = [
        out / "notes.txt",
        out / "data" / "notes.txt",
        out / "data" / "shard-x.csv",
        out / "data" / "old" / "a.parquet",
    ]
    ours = [
        out / ".tmp-manifest.json",
        out / "data" / ".tmp-shard",
        out / "data" / "shard-00099-0123456789ab.parquet",
    ]
    (out / "data" / "old").mkdir()
    for file in foreign + ours:
        file.write_bytes(b"mine")

    def audit() -> None:
        found = {line.split(": ")[0] for line in verify(out)}
        assert found == {str(file) for file in [*foreign[1:3], out / "data" / "old", *ours]}, found

    assert world.fork(audit) == 0
    assert world.fork(lambda: world.run(out)) == 0
    assert content(out) == world.reference | {str(file.relative_to(out)): b"mine" for file in foreign}
    return count
