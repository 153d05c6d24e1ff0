"""Processes beside a test: waiting for them, with patience that ends, and a dask cluster of them."""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from stickslip import pipeline


def until(is_so: Callable[[], bool], timeout: float = 500.0) -> None:
    """Wait for something to come true."""
    end = time.monotonic() + timeout
    while not is_so():
        assert time.monotonic() < end, "it never came true"
        time.sleep(0.01)


def python(*arguments: str, **more: Any) -> subprocess.CompletedProcess:
    """A Python, run to its end; `more` as `subprocess.run` takes it."""
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, **more)


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


def listening(pids: Iterable[int]) -> set[tuple[str, int]]:
    """The addresses at which processes listen, as the kernel's tables of TCP have them."""
    inodes = set()
    for pid in pids:
        for entry in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(FileNotFoundError):  # closed since, as the listing of the directory is
                if found := re.fullmatch(r"socket:\[(\d+)\]", os.readlink(entry)):
                    inodes.add(found[1])
    places = set()
    for table, family in (("tcp", socket.AF_INET), ("tcp6", socket.AF_INET6)):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                host, port = fields[1].split(":")
                words = bytes.fromhex(host)
                network = b"".join(words[k : k + 4][::-1] for k in range(0, len(words), 4))
                places.add((socket.inet_ntop(family, network), int(port, 16)))
    return places


def computed_here(patch: pytest.MonkeyPatch) -> None:
    """Have commands compute members, and answer questions, in this process: others take seconds to start."""
    patch.setattr("stickslip.workflows.asking.MOST_PROCESSES", 1)
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
            process.wait(timeout=500)
