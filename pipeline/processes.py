"""Processes of this program beside this one, which import what it does."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import IO, Any

# One thread each: threaded products in several processes fight for the cores, and threads that share a sum round
# it differently. Libraries read these when they are loaded, so they must be set before.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


def python() -> list[str]:
    """The beginning of a command that runs Python, which is not to look into the working directory first."""
    return [sys.executable, "-P"]


def environment() -> dict[str, str]:
    """This process's environment, by which Python finds the modules that it has found here."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(place or os.getcwd() for place in sys.path)}


@contextlib.contextmanager
def environment_kept() -> Iterator[None]:
    """Take back what the with-block changes of this process's environment, and touch nothing else of it."""
    before = dict(os.environ)
    try:
        yield
    finally:
        for name in os.environ.keys() | before.keys():
            if name not in before:
                del os.environ[name]
            elif os.environ.get(name) != before[name]:
                os.environ[name] = before[name]


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Within: libraries that are loaded, here or in processes that are started, have one thread each."""
    with environment_kept():
        os.environ.update(ONE_THREAD)
        yield


class Child(subprocess.Popen[bytes]):
    """A Python process that runs `code`, which ignores Ctrl-C; the parent handles it.

    It reads from `to_it` and writes to `from_it`. One that ends when it finds nothing more to read, or that calls
    `end_with_the_parent`, outlives nobody.
    """

    def __init__(self, code: str) -> None:
        super().__init__(
            [*python(), "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment(),
            start_new_session=True,
        )

    @property
    def to_it(self) -> IO[bytes]:
        """What it reads."""
        assert self.stdin is not None
        return self.stdin

    @property
    def from_it(self) -> IO[bytes]:
        """What it writes."""
        assert self.stdout is not None
        return self.stdout


def answering() -> IO[Any]:
    """In a child: where its answers go; whatever a library prints is none."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return answers


def end_with_the_parent() -> None:
    """In a child that has read all it was to read: end, whatever it is at, when nobody can write to it any more."""

    def wait() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
