"""The dataset in an object store: requests that fail, drivers that die, two at once, a lock that a crash left."""

from __future__ import annotations

import contextlib
import os
import signal
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from urllib.error import HTTPError

from stickslip.pipeline import verify
from stickslip.pipeline.places import object_store
from tests.faults.bucket import ask, bucket
from tests.faults.registry import fault
from tests.faults.world import World, end_of, wait
from tests.processes import until

#: Seconds that a lock outlives its owner here; a minute in earnest.
_LEASE = 2.0


class Cloud:
    """A world whose datasets lie in a bucket."""

    def __init__(self, world: World, address: str) -> None:
        import s3fs  # noqa: F401  loaded before anything forks

        self.world, self._address = world, address
        object_store.LEASE, object_store.SETTLE, object_store.PAUSES = _LEASE, 0.2, (0.02,) * 12
        start = time.perf_counter()
        assert world.fork(lambda: self.run("timed")) == 0
        self.seconds = time.perf_counter() - start
        self.check("timed")

    def run(self, name: str) -> None:
        self.world.run(f"s3://bucket/{name}")

    def fail(self, share: float) -> int:
        """From now on let so many requests fail; how many have, since the last call."""
        return int(ask(f"{self._address}/_share/{self.world.random.random()}/{share}/503", "PUT"))

    def content(self, name: str) -> dict[str, bytes]:
        """Every byte of a dataset but the timings, by object; one deleted since it was listed is not there."""
        listed = ElementTree.fromstring(ask(f"{self._address}/bucket?list-type=2&prefix={name}/"))
        keys = [key.text or "" for key in listed.iter("{http://s3.amazonaws.com/doc/2006-03-01/}Key")]
        names = {key.removeprefix(f"{name}/"): key for key in keys if "/timings" not in key}
        found: dict[str, bytes] = {}
        for rest, key in names.items():
            try:
                found[rest] = ask(f"{self._address}/bucket/{key}")
            except HTTPError as error:
                if error.code != 404:
                    raise
        return found

    def check(self, name: str) -> None:
        """The dataset is, byte for byte, the undisturbed local one; there is no other object; the audit is clean."""
        found = self.content(name)
        assert found.keys() == self.world.reference.keys(), sorted(found.keys() ^ self.world.reference.keys())
        differing = [rest for rest in found if found[rest] != self.world.reference[rest]]
        assert not differing, differing

        def audit() -> None:
            assert verify(f"s3://bucket/{name}") == []

        assert self.world.fork(audit) == 0

    def resume(self, name: str) -> None:
        """Run the scene to its end, undisturbed, when a lock that a crash left has run out, and check it."""
        if ".lock" in self.content(name):
            time.sleep(_LEASE + 0.1)
        assert self.world.fork(lambda: self.run(name)) == 0
        self.check(name)


@contextlib.contextmanager
def _cloud(world: World) -> Iterator[Cloud]:
    with bucket() as address:
        yield Cloud(world, address)


@fault(quick=1, full=20)
def object_store_with_errors(world: World, count: int) -> int:
    """A share of all requests is answered with an error, before or after it took effect: the run goes on."""
    with _cloud(world) as cloud:
        for k in range(count):
            cloud.fail(world.random.uniform(0.1, 0.35))
            assert world.fork(lambda k=k: cloud.run(f"out{k}")) == 0
            assert cloud.fail(0.0) > 0
            cloud.check(f"out{k}")
    return count


@fault(quick=0, full=10)
def object_store_lost(world: World, count: int) -> int:
    """From some moment on every request fails: one clear refusal, and the next run goes on."""
    said = world.directory / "said"
    with _cloud(world) as cloud:
        for k in range(count):
            child = world.start(lambda k=k: cloud.run(f"out{k}"), said)
            time.sleep(world.random.uniform(0.2, 0.9) * cloud.seconds)
            cloud.fail(1.0)
            code = wait(child)
            cloud.fail(0.0)
            assert code in (0, 1)  # it may have been quicker
            if code:
                last = said.read_text().strip().splitlines()[-1]
                assert last.startswith("stickslip.pipeline.errors.StoreError: s3://bucket/"), last
                assert "Service is unable to handle request" in last or "(Service Unavailable)" in last, last
                # as it writes, or, once all is written, as it counts
                assert "rerun the scene: finished shards are kept" in last or "cannot be read" in last, last
            cloud.resume(f"out{k}")
    return count


@fault(quick=0, full=60)
def object_store_driver_killed(world: World, count: int) -> int:
    """SIGKILL at a random moment, on a steady store or one that fails now and then; the lock runs out."""
    done = 0
    with _cloud(world) as cloud:
        while done < count:
            name = f"out{done}-{world.random.random()}"
            cloud.fail(0.2 * (done % 2))
            child = world.start(lambda name=name: cloud.run(name))
            time.sleep(world.random.uniform(0.0, cloud.seconds))
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
            done += wait(child) == -signal.SIGKILL  # or it was quicker
            cloud.fail(0.0)
            cloud.resume(name)
    return done


@fault(quick=0, full=30)
def object_store_two_drivers(world: World, count: int) -> int:
    """Three drivers at once, where nothing is or where a crash left a lock that has run out: one writes."""
    with _cloud(world) as cloud:
        for k in range(count):
            name = f"out{k}"
            if k % 2:
                child = world.start(lambda name=name: cloud.run(name))
                time.sleep(world.random.uniform(0.3, 0.8) * cloud.seconds)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
                wait(child)
                time.sleep(_LEASE + 0.1)
            said = [world.directory / f"said{i}" for i in range(3)]
            for file in said:
                file.write_text("")
            drivers = [world.start(lambda name=name: cloud.run(name), file) for file in said]
            codes = [wait(driver) for driver in drivers]
            for code, file in zip(codes, said, strict=True):
                if code:
                    assert "expected to be its only writer, got a lock held by" in file.read_text(), file.read_text()
            assert 0 in codes, codes
            assert ".lock" not in cloud.content(name)
            cloud.check(name)
    return count


@fault(quick=1, full=5)
def object_store_lock_left_by_a_crash(world: World, count: int) -> int:
    """Whoever comes before the lease has run out is told when it does; after it, the run goes on."""
    said: Path = world.directory / "said"
    with _cloud(world) as cloud:
        for k in range(count):
            name = f"out{k}"
            child = world.start(lambda name=name: cloud.run(name))
            while ".lock" not in cloud.content(name):
                time.sleep(0.005)
            os.kill(child, signal.SIGKILL)
            assert wait(child) == -signal.SIGKILL
            before = cloud.content(name)
            assert world.fork(lambda name=name: cloud.run(name), said) == 1
            last = said.read_text().strip().splitlines()[-1]
            assert f"got a lock held by process {child} on" in last, last
            assert "if it has died, its lease ends in " in last, last
            assert cloud.content(name) == before
            cloud.resume(name)
    return count


@fault(quick=0, full=20)
def object_store_driver_stopped(world: World, count: int) -> int:
    """SIGSTOP for longer than the lease, while another driver does it all: who wakes up sees that, and ends."""
    said = world.directory / "said"
    with _cloud(world) as cloud:
        for k in range(count):
            name = f"out{k}"
            child = world.start(lambda name=name: cloud.run(name), said)
            time.sleep(world.random.uniform(0.2, 0.9) * cloud.seconds)
            os.kill(child, signal.SIGSTOP)
            time.sleep(_LEASE + 0.1)
            assert world.fork(lambda name=name: cloud.run(name)) == 0
            os.kill(child, signal.SIGCONT)
            if wait(child):  # or it had ended, or not yet begun to write
                last = said.read_text().strip().splitlines()[-1]
                assert "lost the lock to a process that has ended" in last, last
            cloud.resume(name)
    return count


@fault(quick=0, full=6)
def object_store_interrupted(world: World, count: int) -> int:
    """SIGINT or SIGTERM to the command and its workers: nothing is left of it, and the next run need not wait."""
    with _cloud(world) as cloud:
        for k in range(count):
            name, number = f"out{k}", (signal.SIGINT, signal.SIGTERM)[k % 2]
            arguments = ["run", str(world.scene_file), "--out", f"s3://bucket/{name}", "--workers", "2"]
            process = world.command(*arguments, sleep=0.3)
            until(lambda name=name: "manifest.json" in cloud.content(name))
            time.sleep(world.random.uniform(0.0, 4.0))
            os.killpg(process.pid, number)
            code, _, err = end_of(process)
            assert code == 128 + number, (code, err)
            assert f"Resume with:\n  stickslip {' '.join(arguments)}\n" in err, err
            assert "Traceback" not in err, err
            assert ".lock" not in cloud.content(name)
            cloud.resume(name)
    return count
