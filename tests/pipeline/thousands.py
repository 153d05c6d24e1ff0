"""Ten thousand members of 20 blocks: time, memory, disk, and what questions take.

``python -m tests.pipeline.thousands run DIR [WORKERS]``, then ``... ask DIR``; ``... profile`` says where the time of
a batch goes. Minutes; not part of the tests.
"""

from __future__ import annotations

import cProfile
import os
import pstats
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

from stickslip import pipeline
from stickslip.pipeline import Progress, batches, expand, parse_scene, run_scene
from stickslip.pipeline.ledger import read_commits
from stickslip.pipeline.schema import Recording
from stickslip.pipeline.storage import DATA
from stickslip.pipeline.worker import compute

SOURCE = b"""\
title = "Ten thousand members"
[system]
coupling = "antisymmetric"
n = 20
[start]
z = -0.7
w = -0.4
[run]
t_end = 200.0
matrices = 1000
purpose = "statistics"
[[engine]]
name = "coulomb"
[[engine]]
name = "sigmoid"
[perturbation]
sizes = [0.01, 0.05]
draws = 2
[analysis]
t_burn = 20.0
dt = 1.0
"""


def run(path: Path, workers: int) -> None:
    """Run the scene; print wall time, seconds of a core by process, memory and disk.

    Where others use the machine too, wall time says little; seconds of a core say what is to be done.
    """
    seen: list[tuple[float, float]] = []
    used: dict[int, tuple[float, float]] = {}

    def watch(progress: Progress) -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        seen.append((progress.elapsed, pages * resource.getpagesize() / 1e6))
        used.update({child: _core_seconds(child) for child in _children()})

    start, own_start = time.perf_counter(), time.process_time()
    status = run_scene(parse_scene(SOURCE), SOURCE, path, workers=workers, on_progress=watch)
    wall, own = time.perf_counter() - start, time.process_time() - own_start
    commits = list(read_commits(path))
    computing = sum(commit.seconds for commit in commits)
    print(f"{status.n_members} members, {status.n_shards} shards, {workers} workers: {wall:.1f} s")
    print(
        f"computing {computing:.1f} s of workers: {1 - computing / workers / wall:.1%} of the time is something else"
    )
    first, last = seen[1][0], seen[-1][0]
    batch = sum(commit.seconds for commit in commits[:workers]) / workers
    print(f"to the first batch {first - batch:.1f} s, on to the last commit {last - first + batch:.1f} s, ", end="")
    print(f"end {wall - last:.1f} s")
    for pid in {commit.pid for commit in commits}:
        start_up, whole = used[pid]
        print(f"worker {whole:.1f} s of a core, {start_up:.1f} s of them starting and talking")
    print(f"driver {own:.1f} s of a core")
    memory = ", ".join(f"{seen[k][1]:.0f}" for k in (0, len(seen) // 2, -1))
    peaks = (resource.getrusage(who).ru_maxrss / 1e3 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(
        f"driver at start, middle, end: {memory} MB; peak of driver {{:.0f}}, of a worker {{:.0f}} MB".format(*peaks)
    )
    files = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    print(f"{status.n_bytes / status.n_members:.0f} bytes a member in shards, {files / status.n_members:.0f} in all")


def _children() -> list[int]:
    return [
        int(child) for task in Path("/proc/self/task").iterdir() for child in (task / "children").read_text().split()
    ]


def _core_seconds(pid: int) -> tuple[float, float]:
    """Of a worker's main thread, which starts it and talks to the scheduler, and of all its threads."""

    def of(stat: Path) -> float:
        user, system = stat.read_text().rpartition(")")[2].split()[11:13]
        return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")

    process = Path(f"/proc/{pid}")
    return of(process / "task" / str(pid) / "stat"), of(process / "stat")


def ask(path: Path) -> None:
    """Print what questions take, the median of five, beside reading all with pandas."""
    import pandas as pd  # workers, which import this module too, need none of these
    import pyarrow.dataset as ds

    query = pipeline.query

    def everything() -> pd.DataFrame:
        return ds.dataset(str(path / DATA), format="parquet").to_table().to_pandas()

    some = query.members(path, ["member_id"])["member_id"][7000]
    two = [("perturbation_size", "=", 0.05), ("engine", "=", "sigmoid")]
    grouped = "SELECT engine, perturbation_size, count(*), avg(n_exits) FROM members GROUP BY ALL"
    questions: dict[str, Callable[[], object]] = {
        "one member, n_stick": lambda: query.n_stick(path, some),
        "filter on two parameters": lambda: query.members(path, filters=two),
        "filter on two parameters, two columns": lambda: query.members(path, ["member_id", "n_exits"], filters=two),
        "group-by over all, SQL": lambda: query.sql(path, grouped),
        "cascades of all by size, SQL": lambda: query.sql(path, "SELECT size, count(*) FROM cascades GROUP BY size"),
        "mean over all, dask": lambda: query.dask_members(path, ["n_exits"])["n_exits"].mean().compute(),
        "members, all scalars": lambda: query.members(path),
        "everything, pandas": everything,
        "everything, pandas, then the group-by": lambda: (
            everything().groupby(["engine", "perturbation_size"])["n_exits"].mean()
        ),
    }
    for name, question in questions.items():
        question()
        took = []
        for _ in range(5):
            start = time.perf_counter()
            question()
            took.append(time.perf_counter() - start)
        print(f"{name:40} {1e3 * sorted(took)[2]:8.1f} ms")


def profile() -> None:
    """Print where the time of some batches goes."""
    scene = parse_scene(SOURCE)
    packed = batches(expand(scene), scene.hash)
    recording = Recording.of(scene)
    compute(packed[0], recording)  # kernels
    with cProfile.Profile() as profiler:
        for batch in packed[1:3]:
            compute(batch, recording)
    pstats.Stats(profiler).sort_stats("cumulative").print_stats(28)
    start = time.perf_counter()
    compute(packed[1], recording)
    whole = time.perf_counter() - start
    start = time.perf_counter()
    for member in packed[1].members:
        member.simulate()
    print(f"a batch {whole:.3f} s, its runs alone {time.perf_counter() - start:.3f} s")


if __name__ == "__main__":
    if sys.argv[1] == "run":
        run(Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 2)
    elif sys.argv[1] == "ask":
        ask(Path(sys.argv[2]))
    else:
        profile()
