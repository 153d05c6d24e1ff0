"""Processes beside a test: waiting for them, with patience that ends, and a dask cluster of them."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from stickslip import pipeline


def until(is_so: Callable[[], bool], timeout: float = 60.0) -> None:
    """Wait for something to come true."""
    end = time.monotonic() + timeout
    while not is_so():
        assert time.monotonic() < end, "it never came true"
        time.sleep(0.01)


def is_running(pid: int) -> bool:
    """Whether there is such a process, and not just what is left of one until somebody asks how it ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def seconds_of(pid: int) -> float:
    """Time of a processor that a process has had: it goes slower on a busy machine, as the process does."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def computed_here(patch: pytest.MonkeyPatch) -> None:
    """Have commands compute members in this process: the workers that they ask for take seconds to start."""
    run = pipeline.run_ensemble
    for place in ("stickslip.pipeline", "stickslip.workflows.dataset"):
        patch.setattr(
            f"{place}.run_ensemble", lambda scene, out, workers, *more, **by: run(scene, out, 0, *more, **by)
        )


@contextlib.contextmanager
def dask_by_hand(directory: Path, *worker: str, **variables: str) -> Iterator[tuple[str, list[subprocess.Popen]]]:
    """A scheduler and a worker, started as the guide says: the address, and the two processes."""
    file = directory / f"scheduler-{time.monotonic_ns()}.json"
    # what pytest was started with is not the worker's
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")} | variables
    running: list[subprocess.Popen] = []
    try:
        for name, *more in (
            ("scheduler", "--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"),
            ("worker", *worker),
        ):
            command = [sys.executable, "-m", f"distributed.cli.dask_{name}", "--scheduler-file", str(file), *more]
            quiet = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
            running.append(subprocess.Popen(command, cwd=directory, env=environment, **quiet))
        until(lambda: file.exists() and file.read_text().endswith("}"))  # it is not written at once
        yield json.loads(file.read_text())["address"], running
    finally:
        for process in reversed(running):
            process.terminate()
            process.wait(timeout=60)
