"""Who computes, in what order, and who may write: none of it shows in the bytes."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import time

from stickslip.pipeline.dataset.writer import Store
from tests.faults.registry import fault
from tests.faults.world import PATIENCE, World, end_of, wait
from tests.processes import until


@fault(quick=4, full=60)
def two_drivers(world: World, count: int) -> int:
    """Three drivers at once: one writes, the others are refused; or the owner is killed, and another goes on."""
    out = world.directory / "out"
    for k in range(count):
        shutil.rmtree(out, ignore_errors=True)
        said = [world.directory / f"said{i}" for i in range(3)]
        drivers = [world.start(lambda: world.run(out), file) for file in said]
        if k % 2:  # the owner is killed at a random moment; who asks then may go on
            time.sleep(world.random.uniform(0.0, world.seconds))
            with contextlib.suppress(OSError, ValueError, IndexError):
                owner = int((out / ".lock").read_text().split()[1])
                if owner in drivers:
                    os.kill(owner, signal.SIGKILL)
        codes = [wait(driver) for driver in drivers]
        for code, file in zip(codes, said, strict=True):
            if code == 1:
                assert "expected to be its only writer, got a lock held by" in file.read_text(), file.read_text()
        assert all(code in (0, 1, -signal.SIGKILL) for code in codes), codes
        assert k % 2 or 0 in codes
        world.resume(out)
    return count


@fault(quick=0, full=4)
def driver_with_workers_killed_then_another(world: World, count: int) -> int:
    """A driver is refused while another runs with workers; that one is killed; the next goes on at once."""
    for k in range(count):
        out = world.directory / f"out{k}"
        arguments = ("run", str(world.scene_file), "--out", str(out), "--workers", "2")
        first = world.command(*arguments, victims=world.hung)  # it would never end
        until(lambda out=out: any(out.glob("data/shard-*")))
        code, _, err = end_of(world.command(*arguments))
        assert code == 1
        assert f"lock held by process {first.pid} on" in err, err
        first.kill()
        code, _, err = end_of(world.command(*arguments))  # while the orphans may still be dying
        assert code == 0, err
        first.communicate(timeout=PATIENCE)
        world.check(out)
    return count


@fault(quick=2, full=40)
def shuffled(world: World, count: int) -> int:
    """Batches come in in any order."""
    out = world.directory / "out"
    for _ in range(count):
        seed = world.random.random()
        shutil.rmtree(out, ignore_errors=True)

        def in_disorder(seed: float = seed) -> None:
            opened = Store.__enter__

            def enter(store: Store) -> Store:
                opened(store)
                world.random.seed(seed)
                world.random.shuffle(store.todo)
                return store

            Store.__enter__ = enter  # type: ignore[method-assign]
            world.run(out)

        assert world.fork(in_disorder) == 0
        world.check(out)
    return count


@fault(quick=0, full=3)
def one_two_four_workers(world: World, count: int) -> int:
    """The number of workers does not show."""
    for k, workers in enumerate((4, 2, 1)[:count]):
        out = world.directory / f"out{k}"
        command = world.command("run", str(world.scene_file), "--out", str(out), "--workers", str(workers))
        code, _, err = end_of(command)
        assert code == 0, err
        world.check(out)
    return count
