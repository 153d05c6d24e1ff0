"""Processes that die: the driver, its workers, the scheduler."""

from __future__ import annotations

import builtins
import contextlib
import hashlib
import json
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from stickslip.pipeline import expand, extend, run_ensemble
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.dataset.writer import Store
from stickslip.pipeline.places import plain
from stickslip.pipeline.running.extend import with_records
from stickslip.pipeline.running.worker import compute
from stickslip.workflows import reporting
from stickslip.workflows.fresh import is_current
from tests.faults.registry import fault
from tests.faults.world import INJECT, ROOT, TARGET_COST, World, children, content, end_of, wait
from tests.processes import dask_by_hand, until


@fault(quick=3, full=200)
def driver_killed_at_random(world: World, count: int) -> int:
    """SIGKILL at a random moment, five at most for one run, which is then resumed."""
    done, out = 0, world.directory / "out"
    while done < count:
        shutil.rmtree(out, ignore_errors=True)
        for _ in range(world.random.randint(1, 5)):
            child = world.start(lambda: world.run(out))
            time.sleep(world.random.uniform(0.0, world.seconds))
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
            done += wait(child) == -signal.SIGKILL  # or it was quicker
            if done == count:
                break
        world.resume(out)
    return done


#: What a commit is made of, as the driver calls it.
_STEPS = ("open", "fsync", "replace", "write", "close", "unlink", "truncate")


def _deadly(moment: int, is_before: bool, calls: list[int]) -> None:
    """From now on the process dies before or after its `moment`-th call of the system; `calls` counts them."""
    turn = threading.Lock()  # shards that are committed together are written by threads

    def of(operation: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            with turn:
                calls[0] += 1
                dies = calls[0] == moment
            if dies and is_before:
                os.kill(os.getpid(), signal.SIGKILL)
            try:
                return operation(*args, **kwargs)
            finally:  # also after a call that fails, as of a file that is not there
                if dies:
                    os.kill(os.getpid(), signal.SIGKILL)

        return call

    for name in _STEPS:
        setattr(os, name, of(getattr(os, name)))
    plain.open = _torn(of(builtins.open), calls)  # type: ignore[attr-defined]


def _torn(opened: Callable[..., Any], calls: list[int]) -> Callable[..., Any]:
    """An `open` whose files are written in two halves: a process may die between."""

    def call(*args: Any, **kwargs: Any) -> Any:
        stream = opened(*args, **kwargs)
        write = stream.write

        class Torn:
            def __enter__(self) -> Any:
                return self

            def __exit__(self, *error: object) -> None:
                stream.close()

            def write(self, content: bytes) -> None:
                write(content[: len(content) // 2])
                stream.flush()
                os.write(os.open(os.devnull, os.O_WRONLY), b"")  # a call, to die in
                write(content[len(content) // 2 :])

            flush, fileno, close = stream.flush, stream.fileno, stream.close

        return Torn()

    return call


@fault(quick=4, full=10_000)
def driver_killed_at_each_step(world: World, count: int) -> int:
    """Dead before and after each call of the system that a run makes; the full count is all of them."""
    return _killed_at_each_step(world, world.run, count)


@fault(quick=6, full=10_000)
def driver_killed_amid_shards_that_come_together(world: World, count: int) -> int:
    """The same where results are there three at a time, in whatever order their threads get on."""

    def run(out: Path) -> None:
        with Store(out, world.scene) as store:
            for some in (store.todo[k : k + 3] for k in range(0, len(store.todo), 3)):
                store.commit(*(compute(batch) for batch in some))

    return _killed_at_each_step(world, run, count)


def _killed_at_each_step(world: World, run: Callable[[Path], None], count: int) -> int:
    moments = _moments(world, run, count)
    world.check(world.directory / "counted")
    for moment, is_before in moments:
        out = world.directory / "out"
        shutil.rmtree(out, ignore_errors=True)

        def killed(moment: int = moment, is_before: bool = is_before, out: Path = out) -> None:
            _deadly(moment, is_before, [0])
            run(out)

        assert world.fork(killed) == -signal.SIGKILL
        world.resume(out)
    return len(moments)


def _moments(world: World, act: Callable[[Path], object], count: int) -> list[tuple[int, bool]]:
    """Calls of the system of an act on the directory `counted`, each before and after; `count` of them at most."""
    tally = world.directory / "tally"

    def counted() -> None:
        calls = [0]
        _deadly(0, True, calls)
        act(world.directory / "counted")
        tally.write_text(json.dumps(calls[0]))

    assert world.fork(counted) == 0
    moments = [(k + 1, is_before) for k in range(json.loads(tally.read_text())) for is_before in (True, False)]
    return moments if count >= len(moments) else world.random.sample(moments, count)


def _report(out: Path) -> dict[str, bytes]:
    """Every byte of a report, by file."""
    found = [out / "report.html", *(out / "report").rglob("*")]
    return {str(file.relative_to(out)): file.read_bytes() for file in found if file.is_file()}


def _with_an_earlier_report(world: World, told: Path) -> Path:
    """A copy of a dataset whose report is that of another version, with a table of its own."""
    out = world.copy(of=told)
    (out / "report.html").write_text("of another version")
    content = b"of a question that nobody asks any more"
    (out / "report" / "earlier.csv").write_bytes(content)
    with open(out / "report" / "files.txt", "a") as listed:
        listed.write(f"{hashlib.sha256(content).hexdigest()}  report/earlier.csv\n")
    return out


@fault(quick=0, full=60)
def report_killed_at_random(world: World, count: int) -> int:
    """SIGKILL to a report and its processes, four at most; then it is made."""
    done, told = 0, world.copy("told")
    start = time.perf_counter()
    assert end_of(world.command("report", told))[0] == 0
    seconds = time.perf_counter() - start
    while done < count:
        out = world.copy() if world.random.random() < 0.5 else _with_an_earlier_report(world, told)
        for _ in range(world.random.randint(1, 4)):
            process = world.command("report", out)
            time.sleep(world.random.uniform(0.0, seconds))
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            done += end_of(process)[0] == -signal.SIGKILL
        assert end_of(world.command("report", out))[0] == 0
        assert _report(out) == _report(told)
        world.check(out)
    return done


@fault(quick=6, full=10_000)
def report_killed_at_each_step(world: World, count: int) -> int:
    """Dead before and after each call of the system by which a report takes the place of an earlier one."""
    told = world.copy("told")
    built = reporting.report(told)
    reporting.write(built, told)
    moments = _moments(world, lambda out: reporting.write(built, _with_an_earlier_report(world, told)), count)
    for moment, is_before in moments:
        out = _with_an_earlier_report(world, told)

        def killed(moment: int = moment, is_before: bool = is_before, out: Path = out) -> None:
            _deadly(moment, is_before, [0])
            reporting.write(built, out)

        assert world.fork(killed) == -signal.SIGKILL
        opened = open_dataset(out)
        assert not is_current(opened) or _report(out) == _report(told)
        reporting.write(built, out)
        assert is_current(opened)
        assert _report(out) == _report(told), sorted(_report(out).keys() ^ _report(told).keys())
        world.check(out)
    return len(moments)


@fault(quick=4, full=10_000)
def extension_killed_at_each_step(world: World, count: int) -> int:
    """Dead before or after each call of the system while records are added: the old dataset stays, and it goes on."""

    def act(out: Path) -> None:
        extend(world.undisturbed, {"end": True}, out, workers=0)

    new = world.directory / "new"
    scene = with_records(open_dataset(world.undisturbed), {"end": True})
    assert world.fork(lambda: run_ensemble(scene, new, workers=0) and None) == 0
    moments = _moments(world, act, count)
    assert content(world.directory / "counted") == content(new)
    for moment, is_before in moments:
        out = world.directory / "out"
        shutil.rmtree(out, ignore_errors=True)

        def killed(moment: int = moment, is_before: bool = is_before, out: Path = out) -> None:
            _deadly(moment, is_before, [0])
            act(out)

        assert world.fork(killed) == -signal.SIGKILL
        assert world.fork(lambda out=out: act(out)) == 0  # type: ignore[misc]
        assert content(out) == content(new), (moment, is_before)
        world.check(world.undisturbed)
    return len(moments)


@fault(quick=1, full=6)
def workers_killed_by_a_member(world: World, count: int) -> int:
    """Exit, signal, segfault: the member gets a row that says so, its neighbours theirs; then it is tried again."""
    ends = [("segfault", "signal SIGSEGV"), ("exit", "exit code 3"), ("kill", "signal SIGKILL")]
    names = [member.member_id for member in expand(world.scene)]
    for k in range(count):
        how, words = ends[k % len(ends)]
        out = world.directory / f"{how}{k}"
        victims = world.random.sample(names, 1 + k // len(ends))
        arguments = ["run", str(world.scene_file), "--out", str(out), "--workers", "1" if k < len(ends) else "2"]
        code, _, err = end_of(world.command(*arguments, victims=dict.fromkeys(victims, how)))
        assert code == 1, err
        assert f"failed  {len(victims)}: its worker died ({words})" in err, err
        assert "--retry-failed" in err
        assert f"stickslip run {out / 'scene.toml'} --only {min(victims, key=names.index)}" in err
        world.check_no_strays(out)
        code, _, err = end_of(world.command(*arguments, "--retry-failed"))
        assert code == 0, err
        world.check(out)
    return count


@fault(quick=0, full=6)
def workers_killed_from_outside(world: World, count: int) -> int:
    """A worker gets a signal in the middle of its work: nobody is blamed, nothing is missing."""
    for k in range(count):
        out = world.directory / f"out{k}"
        number = [signal.SIGKILL, signal.SIGTERM, signal.SIGSEGV][k % 3]
        process = world.command("run", str(world.scene_file), "--out", str(out), "--workers", "2", sleep=0.15)
        until(lambda out=out: any(out.glob("data/shard-*")))
        for _ in range(1 + k // 3):
            workers = children(process.pid)
            with contextlib.suppress(ProcessLookupError):
                os.kill(world.random.choice(workers), number)
            time.sleep(0.5)
        code, _, err = end_of(process)
        assert code == 0, err
        world.check(out)
    return count


@fault(quick=0, full=2)
def worker_killed_again_as_it_comes_back(world: World, count: int) -> int:
    """Again 15 seconds after the first time, when dask looks whether it has come back."""
    for k in range(count):
        out = world.directory / f"out{k}"
        process = world.command("run", str(world.scene_file), "--out", str(out), "--workers", "1", sleep=1.5)
        until(lambda out=out: any(out.glob("data/shard-*")))
        os.kill(children(process.pid)[0], signal.SIGKILL)
        again = time.monotonic() + 14.9
        until(lambda process=process: bool(children(process.pid)))
        time.sleep(max(0.0, again - time.monotonic()))
        os.kill(children(process.pid)[0], signal.SIGKILL)
        code, _, err = end_of(process)
        assert code == 0, err
        world.check(out)
    return count


@fault(quick=0, full=2)
def scheduler_lost(world: World, count: int) -> int:
    """A cluster whose scheduler is killed: one clear message, what is done is kept, and another goes on."""
    variables = {
        "PYTHONPATH": f"{INJECT}{os.pathsep}{ROOT}",
        "STICKSLIP_FAULTS": json.dumps({"target_cost": TARGET_COST, "sleep": 0.15}),
    }
    for k in range(count):
        out = world.directory / f"out{k}"
        arguments = ("run", str(world.scene_file), "--out", str(out), "--scheduler")
        with dask_by_hand(world.directory, "--nthreads", "1", **variables) as (address, (scheduler, _)):
            driver = world.command(*arguments, address)
            until(lambda out=out: len(list(out.glob("data/shard-*"))) > 1)
            scheduler.kill()
            code, _, err = end_of(driver)
        assert code == 1, err
        assert "expected the scheduler to stay until the end, lost it" in err, err
        assert "Traceback" not in err, err
        world.check_no_strays(out)
        with dask_by_hand(world.directory, "--nthreads", "1", **variables) as (address, _):
            code, _, err = end_of(world.command(*arguments, address))
        assert code == 0, err
        world.check(out)
    return count


def _signalled(world: World, count: int, number: signal.Signals, times: int) -> int:
    """Signals to a run that would never end by itself, nor in order if it waited for what its workers are at."""
    for k in range(count):
        out = world.directory / f"out{k}"
        arguments = ["run", str(world.scene_file), "--out", str(out), "--workers", "2"]
        process = world.command(*arguments, sleep=0.3, victims=world.hung)
        until(lambda out=out: (out / "manifest.json").exists())
        time.sleep(world.random.uniform(0.0, 4.0))
        os.killpg(process.pid, number)  # as a terminal does: to the workers too
        if times == 2:
            time.sleep(world.random.uniform(0.0, 0.3))
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, number)
        code, _, err = end_of(process)
        # by the signal itself, which a shell shows as the same number, if Python was all but gone
        assert code in (128 + number, -number)[:times], (code, err)
        assert f"Resume with:\n  stickslip {' '.join(arguments)}\n" in err, err
        assert not any(word in err for word in ("Traceback", "distributed", "leaked")), err
        world.check_no_strays(out)
        world.resume(out)
    return count


@fault(quick=1, full=10)
def interrupted_once(world: World, count: int) -> int:
    """SIGINT ends a run in order, whatever its workers are at."""
    return _signalled(world, count, signal.SIGINT, 1)


@fault(quick=0, full=10)
def interrupted_twice(world: World, count: int) -> int:
    """A second SIGINT ends it at once."""
    return _signalled(world, count, signal.SIGINT, 2)


@fault(quick=0, full=10)
def terminated(world: World, count: int) -> int:
    """SIGTERM, as SIGINT."""
    return _signalled(world, count, signal.SIGTERM, 1)


@fault(quick=1, full=10)
def hung_up(world: World, count: int) -> int:
    """SIGHUP, as SIGINT: the terminal is closed."""
    return _signalled(world, count, signal.SIGHUP, 1)


def _in_room(world: World, count: int) -> Iterator[tuple[Path, Path, Callable[[], subprocess.Popen]]]:
    """A TMPDIR in which nothing may be left, directories for runs, and what starts each of these."""
    room = world.directory / "room"
    room.mkdir()
    for k in range(count):
        out = world.directory / f"out{k}"
        arguments = ("run", str(world.scene_file), "--out", str(out), "--workers", "2")
        yield room, out, partial(world.command, *arguments, environment={"TMPDIR": str(room)}, sleep=0.3)
        assert not any(room.iterdir()), [*room.rglob("*")]


@fault(quick=3, full=30)
def signalled_as_it_starts(world: World, count: int) -> int:
    """A first signal, at any moment until the first shard is there: it ends, and leaves nothing in TMPDIR."""
    for k, (room, out, start) in enumerate(_in_room(world, count)):
        number = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP][k % 3]
        process = start()
        until(lambda room=room: any(room.iterdir()))  # before, Python loads what this package injects
        time.sleep(world.random.uniform(0.0, 5.0))
        process.send_signal(number)
        code, _, err = end_of(process)
        assert code == 128 + number, err
        assert not any(word in err for word in ("Traceback", "distributed", "leaked")), err
        world.resume(out)
    return count


@fault(quick=1, full=5)
def driver_killed_leaves_room(world: World, count: int) -> int:
    """What a killed driver left in TMPDIR goes with the next."""
    for room, out, start in _in_room(world, count):
        killed = start()
        until(lambda out=out: (out / "manifest.json").exists())
        time.sleep(world.random.uniform(0.0, 3.0))
        killed.kill()
        end_of(killed)
        assert any(room.iterdir())
        code, _, err = end_of(start())
        assert code == 0, err
        world.check(out)
    return count
