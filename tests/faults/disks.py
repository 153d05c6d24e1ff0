"""Disks that are full or cannot be written, and a compile cache that is spoilt."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

from tests.faults.registry import fault
from tests.faults.world import PATIENCE, World, end_of, remount, small_disk
from tests.processes import until


def _one_clear_refusal(words: str, reason: str) -> None:
    lines = words.strip().splitlines()
    last = lines[-1]
    assert last.startswith("stickslip.pipeline.errors.StoreError: "), words
    assert reason in last, words
    assert "rerun the scene: finished shards are kept" in last, words


@fault(quick=3, full=60)
def disk_full(world: World, count: int) -> int:
    """No space left at some write of a shard, the manifest, the record or the scene, by how much room there is."""
    # what a finished dataset takes; to be made, it needs more
    size = sum(-(-len(content) // 4096) * 4096 for content in world.reference.values())
    said = world.directory / "said"
    with small_disk("1m") as disk:
        out, ballast = disk / "out", disk / "ballast"
        for k in range(count):
            shutil.rmtree(out, ignore_errors=True)
            room = size * (k + 0.5) / count
            free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
            ballast.write_bytes(bytes(max(0, int(free - room))))
            assert world.fork(lambda: world.run(out), said) == 1, "there was room enough"
            _one_clear_refusal(said.read_text(), "No space left on device")
            ballast.unlink()
            if (out / "manifest.json").exists():
                world.check_no_strays(out)
            world.resume(out)
    return count


@fault(quick=2, full=8)
def disk_read_only(world: World, count: int) -> int:
    """A directory that cannot be written, new or half done: refused, unchanged, resumed when it can be."""
    said = world.directory / "said"
    with small_disk("4m") as disk:
        for k in range(count):
            out = disk / f"out{k}"
            if k % 2:
                shutil.copytree(world.undisturbed, out)
                world.random.choice(sorted((out / "data").iterdir())).unlink()
            remount(disk, "ro")
            assert world.fork(lambda out=out: world.run(out), said) == 1
            remount(disk, "rw")
            _one_clear_refusal(said.read_text(), "Read-only file system")
            world.resume(out)
    return count


@fault(quick=0, full=3)
def cache_disk(world: World, count: int) -> int:
    """The disk of the compile cache is too small, full, or read-only: kernels are compiled and not kept."""
    with small_disk("300k") as disk:
        for k in range(count):
            if k == 1:
                (disk / "ballast").write_bytes(bytes(290_000))
            if k == 2:
                remount(disk, "ro")
            out = world.directory / f"out{k}"
            code, _, err = end_of(_cold(world, disk, out))
            assert code == 0, err
            assert "kernels are compiled anew in every process" in err, err
            world.check(out)
    return count


def _cold(world: World, cache: Path, out: Path, workers: int = 1) -> subprocess.Popen:
    arguments = ["run", str(world.scene_file), "--out", str(out), "--workers", str(workers)]
    return world.command(*arguments, environment={"NUMBA_CACHE_DIR": str(cache)})


@fault(quick=0, full=4)
def cache_spoilt(world: World, count: int) -> int:
    """The driver is killed while kernels are compiled; then kept kernels are truncated, emptied, flipped: healed."""
    cache = world.directory / "cache"
    for k in range(count):
        out = world.directory / f"out{k}"
        kernels = sorted(cache.rglob("*.nbc"))
        if k == 0:
            process = _cold(world, cache, out, workers=2)
            until(lambda out=out: (out / "manifest.json").exists())
            time.sleep(6.0)
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate(timeout=PATIENCE)
        for file in kernels:
            if k == 1:
                os.truncate(file, file.stat().st_size // 2)
            elif k == 2:
                os.truncate(file, 0)
            else:
                spoilt = bytearray(file.read_bytes())
                spoilt[world.random.randrange(len(spoilt))] ^= 1 << world.random.randrange(8)
                file.write_bytes(spoilt)
        code, _, err = end_of(_cold(world, cache, out, workers=2))
        assert code == 0, err
        world.check(out)
        # each kernel was compiled by one process for both: one file a kernel, nothing half-written
        healed = [file for file in cache.rglob("*") if file.is_file() and file.suffix != ".lock"]
        assert all(file.suffix == ".nbc" for file in healed), healed
        own = [file for file in healed if not file.name.startswith("program.")]  # the digest of the program, a line
        assert all(file.stat().st_size > 100_000 for file in own), own
        assert len({file.name for file in own}) == len(own) >= 2
    return count
