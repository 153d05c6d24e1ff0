"""Files that change behind the program's back."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

from stickslip.pipeline import Progress, StoreError, parse_scene, query, run_ensemble, status, verify
from stickslip.pipeline.places.manifest import Commit
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


@fault(quick=6, full=300)
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


@fault(quick=4, full=60)
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


def _with_record(world: World, count: int, name: str) -> int:
    """A file and the record both damaged, each way with each."""
    ways = (*_WAYS, _remove)
    for k in range(count):
        out = world.copy()
        ways[k % len(ways)](world, out / name)
        ways[k // len(ways) % len(ways)](world, out / "timings.jsonl")
        world.resume(out)
    return count


@fault(quick=0, full=40)
def damaged_manifest_and_record(world: World, count: int) -> int:
    """Manifest and record both damaged: what neither confirms is computed again."""
    return _with_record(world, count, "manifest.json")


@fault(quick=0, full=40)
def damaged_scene_and_record(world: World, count: int) -> int:
    """The copy of the scene and the record damaged: written again."""
    return _with_record(world, count, "scene.toml")


#: Questions that together need all of a shard, and a scene's own keys; each ends in one line, whatever became of it.
_QUESTIONS = (
    lambda out: query.table(out).to_pydict(),
    lambda out: query.sql(
        out, "SELECT engine, count(*) AS many, sum(n_exits) AS exits FROM members GROUP BY ALL ORDER BY ALL"
    ),
    lambda out: query.sql(out, "SELECT count(*) AS many, max(t) AS last FROM n_stick"),
    lambda out: [(member_id, t.tolist(), n.tolist()) for member_id, (t, n) in query.series(out).items()],
    lambda out: query.dask_members(out).compute(scheduler="sync"),
    status,
)


def _ask(out: Path) -> list[str]:
    """What each question is told, in text."""
    told = []
    for question in _QUESTIONS:
        try:
            told.append(repr(question(out)).replace(str(out), "OUT"))
        except StoreError as error:
            told.append(f"refused: {error}")
    return told


def _asked(world: World, outs: list[Path]) -> list[list[str]]:
    """What each dataset's questions are told, in a process that has seen none of them before."""
    said = world.directory / "told.json"
    assert world.fork(lambda: said.write_text(json.dumps([_ask(out) for out in outs]))) == 0
    return json.loads(said.read_text())


def _right_or_refused(world: World, count: int, spoil: Callable[[Path], Path]) -> int:
    """Spoil a copy by `spoil`, which names the file: each answer is the undisturbed one or a line that names it."""
    for first in range(0, count, 50):
        outs = [world.copy(f"out{k}") for k in range(first, min(first + 50, count))]
        files = [spoil(out) for out in outs]
        right, *found = _asked(world, [world.undisturbed, *outs])
        assert not any(told.startswith("refused") for told in right), right
        for out, file, answers in zip(outs, files, found, strict=True):
            for told, want in zip(answers, right, strict=True):
                is_refusal = told.startswith(f"refused: {file}: ") and "\n" not in told and "rerun" in told
                is_counted = (
                    re.sub(r"n_damaged=1, n_lost=\d+", "n_damaged=0, n_lost=0", told) == want
                )  # by the status
                assert told == want or is_refusal or is_counted, (file, told[:500])
            world.resume(out)
            shutil.rmtree(out)
    return count


@fault(quick=10, full=500)
def flipped_footer_asked(world: World, count: int) -> int:
    """A bit flipped in the footer of a shard, which Parquet's checksums do not cover."""

    def spoil(out: Path) -> Path:
        file = world.random.choice(sorted((out / "data").iterdir()))
        spoilt = bytearray(file.read_bytes())
        length = 8 + int.from_bytes(spoilt[-8:-4], "little")
        spoilt[-world.random.randint(1, length)] ^= 1 << world.random.randrange(8)
        file.write_bytes(spoilt)
        return file

    return _right_or_refused(world, count, spoil)


@fault(quick=10, full=500)
def flipped_anywhere_asked(world: World, count: int) -> int:
    """A bit flipped anywhere in a dataset."""

    def spoil(out: Path) -> Path:
        files = sorted(file for file in out.rglob("*") if file.is_file())
        (file,) = world.random.choices(files, [file.stat().st_size for file in files])
        _flip(world, file)
        return file

    return _right_or_refused(world, count, spoil)


@fault(quick=2, full=40)
def swapped_shard_asked(world: World, count: int) -> int:
    """A shard of the same members under another seed, or a neighbour, in the place of one."""
    other = world.directory / "other"
    source = world.source.replace(b"seed = 7", b"seed = 8")
    assert source != world.source
    assert world.fork(lambda: run_ensemble(parse_scene(source), other, workers=0)) == 0
    shards = sorted((world.undisturbed / "data").iterdir())
    foreign = sorted((other / "data").iterdir())
    done = 0

    def spoil(out: Path) -> Path:
        nonlocal done
        done += 1
        k = world.random.randrange(1, len(shards))
        file = out / "data" / shards[k].name
        shutil.copy(foreign[k] if done % 2 else shards[k - 1], file)
        return file

    return _right_or_refused(world, count, spoil)


@fault(quick=3, full=60)
def damaged_record_of_a_killed_run(world: World, count: int) -> int:
    """A run is killed and its record truncated or flipped: what is told holds of a run that goes on; then it does."""
    for k in range(count):
        out = world.directory / "killed"
        shutil.rmtree(out, ignore_errors=True)
        n_shards = world.random.randint(2, len(world.reference) - 3)

        def killed(out: Path = out, n_shards: int = n_shards) -> None:
            def look(progress: Progress) -> None:
                if progress.n_shards_done == n_shards:
                    os.kill(os.getpid(), signal.SIGKILL)

            run_ensemble(world.scene, out, workers=0, on_progress=look)

        assert world.fork(killed) == -signal.SIGKILL
        before, earlier = world.copy("before", out), world.copy("earlier", out)
        record = out / "timings.jsonl"
        (_truncate, _flip)[k % 2](world, record)
        # a last line without its newline is one that a crash cut short; it counts if all of it is there
        left = record.read_bytes()
        end = left.rfind(b"\n") + 1
        os.truncate(earlier / record.name, end if Commit.parse(left[end:]) is None else len(left))
        (whole, cut), (told,) = _asked(world, [before, earlier]), _asked(world, [out])
        for answer, *right in zip(told, whole, cut, strict=True):
            is_refusal = answer.startswith(f"refused: {record}: ") and "rerun" in answer
            assert answer in right or is_refusal, answer[:500]
        world.resume(out)
    return count


@fault(quick=1, full=1)
def foreign_files(world: World, count: int) -> int:
    """Files of others: named by the audit where shards are, never touched; leftovers of ours are removed."""
    out = world.copy()
    foreign = [
        out / "notes.txt",
        out / ".tmp-notes",
        out / "data" / "shard-notes.parquet",
        out / "data" / "notes.txt",
        out / "data" / "shard-x.csv",
        out / "data" / "old" / "a.parquet",
    ]
    ours = [
        out / ".tmp-manifest.json-elsewhere-77-0123456789abcdef",
        out / "data" / ".tmp-shard-00099-0123456789ab.parquet-elsewhere-77-0123456789abcdef",
        out / "data" / "shard-00099-0123456789ab.parquet",
    ]
    (out / "data" / "old").mkdir()
    for file in foreign + ours:
        file.write_bytes(b"mine")

    def audit() -> None:
        found = {line.split(": ")[0] for line in verify(out)}
        assert found == {str(file) for file in [*foreign[1:5], out / "data" / "old", *ours]}, found

    assert world.fork(audit) == 0
    assert world.fork(lambda: world.run(out)) == 0
    assert content(out) == world.reference | {str(file.relative_to(out)): b"mine" for file in foreign}
    return count
