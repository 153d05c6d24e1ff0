"""Ten thousand members of 20 blocks: time, memory, disk, and what questions take.

``python -m tests.pipeline.thousands run DIR [WORKERS]``, then ``... ask DIR``; ``... profile`` says where the time of
a batch goes. Minutes; not part of the tests.
"""

from __future__ import annotations

import cProfile
import pstats
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pyarrow.dataset as ds

from pipeline import Progress, batches, expand, parse_scene, query, run_scene
from pipeline.manifest import DATA, read_commits
from pipeline.shards import Recording, compute

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
    """Run the scene; print wall time, its parts, memory and disk."""
    seen: list[tuple[float, float]] = []

    def watch(progress: Progress) -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        seen.append((progress.elapsed, pages * resource.getpagesize() / 1e6))

    start = time.perf_counter()
    status = run_scene(parse_scene(SOURCE), SOURCE, path, workers=workers, on_progress=watch)
    wall = time.perf_counter() - start
    commits = list(read_commits(path / "timings.jsonl"))
    computing = sum(commit.seconds for commit in commits)
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3
    print(f"{status.n_members} members, {status.n_shards} shards, {workers} workers: {wall:.1f} s")
    print(f"computing {computing:.1f} s of workers")
    first, last = seen[1][0], seen[-1][0]
    print(f"to the first commit {first:.1f} s, on to the last {last - first:.1f} s, end {wall - last:.1f} s")
    memory = ", ".join(f"{seen[k][1]:.0f}" for k in (0, len(seen) // 2, -1))
    print(f"driver at start, middle, end: {memory} MB, peak {own:.0f} MB; largest worker {children:.0f} MB")
    files = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    print(f"{status.n_bytes / status.n_members:.0f} bytes a member in shards, {files / status.n_members:.0f} in all")


def ask(path: Path) -> None:
    """Print what questions take, the median of five, beside reading all with pandas."""

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
