"""What many members cost the driver: `python docs/scale.py plan`, `commit` or `tasks`; see guide/scale.md."""

from __future__ import annotations

import os
import sys
import tempfile
import time
import tracemalloc
from itertools import islice
from pathlib import Path

from distributed import Client, LocalCluster, as_completed

from stickslip.pipeline import parse_scene
from stickslip.pipeline.ensemble import pack
from stickslip.pipeline.places.locate import place_of

#: A shard of small runs.
SHARD = os.urandom(50_000)
LINE = os.urandom(422)


def plan(n_members: int) -> None:
    """Processor time and memory of the members of a scene, before anything runs."""
    source = (Path(__file__).parent / "scale.toml").read_text()
    scene = parse_scene(source.replace("matrices = 5000", f"matrices = {n_members // 2}").encode())
    started = time.process_time()
    packed = [batch for batch, _ in pack.tasks(scene)]
    seconds = time.process_time() - started
    del packed
    tracemalloc.start()
    packed = [batch for batch, _ in pack.tasks(scene.changed())]  # which has not kept its members yet
    memory = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    cost = sum(batch.cost for batch in packed)
    print(f"{n_members} members: {seconds:.2f} s, {memory / n_members:.0f} bytes a member, {len(packed)} shards of")
    print(f"{cost / len(packed):.2f} s each by estimate")


def commit(n_shards: int) -> None:
    """Time from one commit to the next: a shard that is on the disk, and its line of the record."""
    with tempfile.TemporaryDirectory(dir=".") as folder:
        place = place_of(folder)
        (Path(folder) / "data").mkdir()
        with place.record("timings.jsonl") as append:
            started = time.perf_counter()
            for k in range(n_shards):
                place.replace(f"data/{k}", SHARD)
                append(LINE)
            print(f"{1e3 * (time.perf_counter() - started) / n_shards:.1f} ms a commit")


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


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["plan"]:
            plan(10_000)
            plan(100_000)
        case ["commit"]:
            commit(300)
        case ["tasks"]:
            tasks(1500)
        case _:
            sys.exit(__doc__)
