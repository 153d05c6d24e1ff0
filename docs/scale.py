"""What many members cost the driver: `python docs/scale.py plan`, `commit` or `tasks`; see guide/large-runs.md."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import logging
import os
import resource
import subprocess
import sys
import tempfile
import time
import tracemalloc
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import dask
import psutil
from distributed import Client, LocalCluster, as_completed
from fsspec.implementations.memory import MemoryFileSystem

from stickslip.pipeline import Progress, parse_scene, run_ensemble
from stickslip.pipeline.dataset.program import program
from stickslip.pipeline.ensemble import pack
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.manifest import Commit, Result, Shard
from stickslip.pipeline.places.object_store import Prefix
from stickslip.pipeline.running import worker
from stickslip.pipeline.running.cluster import QuietWorker

#: A shard of small runs.
SHARD = os.urandom(50_000)
LINE = os.urandom(422)


def plan(n_members: int) -> None:
    """Processor time and memory of the members of a scene, before anything runs."""
    source = (Path(__file__).parent / "scale.toml").read_text()
    scene = parse_scene(source.replace("matrices = 5000", f"matrices = {n_members // 2}").encode())
    started = time.process_time()
    packed = pack.tasks(scene)
    seconds = time.process_time() - started
    del packed
    tracemalloc.start()
    packed = pack.tasks(scene.changed())  # which has not kept its members yet
    memory = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    cost = sum(batch.cost for batch in packed)
    print(f"{n_members} members: {seconds:.2f} s, {memory / n_members:.0f} bytes a member, {len(packed)} shards of")
    print(f"{cost / len(packed):.2f} s each by estimate")


class _Slow(MemoryFileSystem):
    """An object store that answers after 30 ms."""

    def pipe_file(self, *arguments: Any, **keywords: Any) -> None:
        time.sleep(0.03)
        super().pipe_file(*arguments, **keywords)


def commit(n_shards: int) -> None:
    """Time of a commit of a shard and its line of the record, on the disk and to a store, one by one and together."""
    with tempfile.TemporaryDirectory(dir=".") as folder:
        (Path(folder) / "data").mkdir()
        for name, place in (("disk", place_of(folder)), ("store", Prefix("memory://out", _Slow(), "/out"))):
            for together in (1, 16):
                with place.record("timings.jsonl") as append:
                    started = time.perf_counter()
                    for k in range(0, n_shards, together):
                        place.replace_each({f"data/{k + one}": SHARD for one in range(together)})
                        append(LINE * together)
                    took = time.perf_counter() - started
                print(f"{name}, {together} together: {1e3 * took / n_shards:.1f} ms a commit")


def _result(k: int) -> bytes:
    return SHARD


def tasks(n_tasks: int) -> None:
    """Processor time of scheduler and client together for a task that does nothing and sends a shard."""
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        waiting = iter(range(n_tasks))
        started = time.process_time()
        running = as_completed(client.submit(_result, k, pure=False) for k in islice(waiting, 8))
        for done in running:
            done.result()
            done.release()
            for k in islice(waiting, 1):
                running.add(client.submit(_result, k, pure=False))
        print(f"{1e3 * (time.process_time() - started) / n_tasks:.1f} ms a task")


def _farm(address: str, n_workers: int, seconds: float, size: int) -> None:
    """Workers in one process that wait instead of computing, and send as many random bytes."""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (files, files))
    shard = os.urandom(size)
    sha256 = hashlib.sha256(shard).hexdigest()

    def wait(order: worker.Order) -> Result:
        batch, *_ = order
        first, *_, last = batch.members.ids()
        time.sleep(seconds)
        outcomes = {"finished": len(batch.members)}
        entry = Shard(sha256=sha256, rows=len(batch.members), bytes=size, first=first, last=last, outcomes=outcomes)
        return Result(
            shard, Commit(shard=batch.name, entry=entry, program=program(), seconds=seconds, host="farm", pid=0)
        )

    worker.compute_there = wait  # the driver names it, and sends no code

    async def live() -> None:
        with tempfile.TemporaryDirectory() as folder:
            workers = [
                QuietWorker(address, nthreads=1, memory_limit=0, local_directory=folder, name=k)
                for k in range(n_workers)
            ]
            for k in range(0, n_workers, 50):
                await asyncio.gather(*workers[k : k + 50])
            await asyncio.gather(*(one.finished() for one in workers))

    often = ("worker.profile.enabled", "admin.tick.interval", "admin.system-monitor.interval")  # each worker would
    dask.config.set({f"distributed.{name}": value for name, value in zip(often, (False, "1h", "1h"), strict=True)})
    logging.disable()
    asyncio.run(live())


def waiting(n_workers: int, seconds: float, size: int, out: str) -> None:
    """Shards a second of a driver, and processor time of each process, with workers that only wait."""
    source = (Path(__file__).parent / "scale.toml").read_text()
    for old, new in (("matrices = 5000", "matrices = 5000000"), ("t_end = 20.0", "t_end = 12000.0")):
        source = source.replace(old, new)
    scene = parse_scene(source.encode())
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as held:
        file = Path(folder) / "scheduler.json"
        command = ["dask", "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show"]
        scheduler = subprocess.Popen([*command, "--scheduler-file", file], stderr=subprocess.DEVNULL)
        held.callback(scheduler.kill)
        while not file.exists():
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        farm = get_context("spawn").Process(target=_farm, args=(address, n_workers, seconds, size))
        farm.start()
        held.callback(farm.kill)
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(n_workers)
        of = {
            "driver": psutil.Process(),
            "scheduler": psutil.Process(scheduler.pid),
            "workers": psutil.Process(farm.pid),
        }
        marks: list[tuple[float, int, dict[str, float]]] = []

        def look(progress: Progress) -> None:
            if not marks or time.monotonic() - marks[-1][0] > 10:
                used = {name: sum(one.cpu_times()[:2]) for name, one in of.items()}
                marks.append((time.monotonic(), progress.n_shards_done, used))
                if len(marks) > 2:
                    (since, before, then), (now, done, used) = marks[-2:]
                    shards = done - before
                    print(f"{shards / (now - since):.0f} shards a second; each: ", end="")
                    print(
                        ", ".join(f"{name} {1e3 * (used[name] - then[name]) / shards:.1f} ms" for name in of), end=""
                    )
                    print("; driver", of["driver"].memory_info().rss // 10**6, "MB", flush=True)

        run_ensemble(scene, out, scheduler=address, on_progress=look)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["plan"]:
            plan(10_000)
            plan(100_000)
        case ["commit"]:
            commit(160)
        case ["tasks"]:
            tasks(1500)
        case ["waiting", n_workers, seconds, size, out]:
            waiting(int(n_workers), float(seconds), int(size), out)
        case _:
            sys.exit(__doc__)
