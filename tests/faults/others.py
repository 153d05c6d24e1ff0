"""Other users of the machine: one works in a directory that another may write, who sets traps in it."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import socket
import stat
import time
from collections.abc import Callable
from pathlib import Path

from stickslip.pipeline import QueryError, SceneError, StoreError, query, run_ensemble, status, verify
from stickslip.pipeline.places.directory import Directory
from stickslip.workflows.export import whole
from tests.faults.registry import fault
from tests.faults.world import PATIENCE, Unshown, World, wait

#: Two users without rights, who need no entry in a list of users.
USER, OTHER = 64_001, 64_002
#: What only the first may read, as it would show in a message, a file or a lock.
MARKER = b"for-my-eyes-only"
_Act = Callable[[random.Random], object]
#: Acts on one copy of a dataset, which an attack may spoil for good.
_ROUND = 20


def _become(user: int) -> None:
    os.setgroups([])
    os.setgid(user)
    os.setuid(user)
    os.environ["HOME"] = "/nonexistent"


def _tree(folder: Path) -> dict[str, tuple[int, bytes]]:
    files = {str(file): file for file in folder.rglob("*") if not file.is_symlink() and file.is_file()}
    return {name: (stat.S_IMODE(file.stat().st_mode), file.read_bytes()) for name, file in files.items()}


def _shared(world: World) -> tuple[Path, Path]:
    """A dataset of the first user that others may write, and what is the first user's alone."""
    if os.geteuid():
        raise Unshown("needs the right to become other users")
    world.directory.chmod(0o755)
    private = world.directory / "private"
    shutil.rmtree(private, ignore_errors=True)
    shutil.copytree(world.undisturbed, private / "dataset")
    (private / "folder" / "figures").mkdir(parents=True)
    for name in ("precious", "folder/files.txt", "folder/keep.csv", "dataset/data/shard-notes.parquet"):
        (private / name).write_bytes(MARKER + b"\nreport/keep.csv\nno end")
    out = world.copy("shared")
    for place, folder_mode, mode in ((private, 0o700, 0o600), (out, 0o777, 0o666)):
        for path in (place, *place.rglob("*")):
            os.chown(path, USER, USER)
            path.chmod(folder_mode if path.is_dir() else mode)
    return out, private


def _attacked(
    world: World,
    count: int,
    act: Callable[[random.Random], object],
    attack: Callable[[random.Random], None],
    place: Path,
) -> int:
    """How many of so many acts of the first user are done while the other attacks; nothing private is told."""

    def others() -> None:
        _become(OTHER)
        chance = random.Random(seed)
        while True:
            with contextlib.suppress(OSError):
                attack(chance)

    def work() -> None:
        _become(USER)
        chance = random.Random(seed)
        for _ in range(count):
            signal.alarm(int(PATIENCE))
            try:
                told = str(act(chance))
                os.write(writer, b"1")
            except (StoreError, QueryError, SceneError, OSError) as error:
                told = str(error)
            signal.alarm(0)
            assert MARKER.decode() not in told, told

    seed, (reader, writer) = world.random.random(), os.pipe()
    attacker = world.start(others)
    try:
        assert wait(world.start(work), _ROUND * PATIENCE) == 0
    finally:
        os.kill(attacker, signal.SIGKILL)
        os.waitpid(attacker, 0)
    os.close(writer)
    with open(reader, "rb") as done:
        n_done = len(done.read())
    leaks = [name for name, (_, content) in _tree(place).items() if MARKER in content]
    assert not leaks, leaks
    return n_done


@fault(quick=60, full=1000)
def parts_of_others(world: World, count: int) -> int:
    """Parts exchanged for links to what is private, and for pipes, while the owner reads and writes."""
    out, private = _shared(world)
    before = _tree(private)
    world.run(world.directory / "loaded")  # all kernels: the users have no cache
    shard = min((out / "data").iterdir()).name
    n_done = 0
    targets = {
        "scene.toml": "precious",
        "manifest.json": "precious",
        "timings.jsonl": "precious",
        "datapackage.json": "precious",
        ".lock": "precious",
        "report.html": "precious",
        "report": "folder",
        "data": "dataset/data",
        f"data/{shard}": "precious",
    }

    def attack(chance: random.Random) -> None:
        path = out / chance.choice([*targets])
        trap, aside = out / f"trap-{chance.random()}", out / f"aside-{path.name}"
        if chance.random() < 0.7:
            trap.symlink_to(private / targets[str(path.relative_to(out))])
        else:
            os.mkfifo(trap, 0o666)
        with contextlib.suppress(OSError):
            os.rename(path, aside)
        os.rename(trap, path)
        time.sleep(chance.choice((0.0, 0.0, 0.001)))
        os.rename(path, trap)
        with contextlib.suppress(OSError):
            os.rename(aside, path)
        os.unlink(trap)
        time.sleep(chance.uniform(0.0, 0.02))

    def write_a_report() -> None:
        place = Directory(out)
        place.remove_left()
        earlier = [line.split()[-1] for line in place.read("report/files.txt").decode().splitlines()]
        place.replace("report/files.txt", b"0  report/new.csv\n")
        written = ("report/new.csv", "report/figures/x.svg", "report.html")
        place.replace_all(dict.fromkeys(written, lambda: b"mine"))
        for name in earlier:
            place.remove(name)

    def resume() -> None:
        Directory(out).remove(f"data/{shard}")
        run_ensemble(world.scene, out, workers=0)

    acts = [
        lambda: status(out),
        lambda: verify(out),
        lambda: query.members(out).to_csv(),
        lambda: query.sql(out, "SELECT * FROM shards").to_csv(),
        write_a_report,
        resume,
    ]
    for _ in range(0, count, _ROUND):
        _shared(world)
        n_done += _attacked(world, _ROUND, lambda chance: chance.choice(acts)(), attack, out)
        assert _tree(private) == before
    assert 0 < n_done < count, n_done
    return count


@fault(quick=60, full=1000)
def names_of_others(world: World, count: int) -> int:
    """Links and pipes under the names of an answer and of its unfinished copy, and in their places."""
    _, private = _shared(world)
    before = _tree(private)
    group = world.directory / "group"
    group.mkdir()
    group.chmod(0o777)
    out = group / "answer.csv"

    def attack(chance: random.Random) -> None:
        kind = chance.randrange(4)
        with contextlib.suppress(FileNotFoundError):
            os.unlink(out)
        if kind == 0:
            out.symlink_to(private / "precious")
        elif kind == 1:
            os.mkfifo(out, 0o666)
        elif kind == 2:  # as names once were
            for pid in range(os.getpid() - 3, os.getpid() + 6):
                with contextlib.suppress(FileExistsError):
                    (group / f".tmp-{out.name}-{socket.gethostname()}-{pid}").symlink_to(private / "precious")
        for begun in group.glob(".tmp-*-*-*-*"):
            os.unlink(begun)
            begun.symlink_to(private / "precious")

    def answer(_: random.Random) -> str:
        with whole(out, world.undisturbed) as stream:
            stream.write(b"mine")
        return ""

    def alone() -> None:
        _become(USER)
        answer(random.Random())

    _attacked(world, count, answer, attack, group)  # how many are done is the scheduler's affair
    assert _tree(private) == before
    for left in group.iterdir():
        left.unlink()
    assert wait(world.start(alone)) == 0
    assert out.read_bytes() == b"mine"
    return count
