"""Other processes: with one thread each, for as long as this one needs them."""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

from stickslip.pipeline.machine.signals import blocked

# One thread each: threaded products in several processes fight for the cores, and threads that share a sum round
# it differently. Libraries read these when they are loaded, so they must be set before.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


@contextlib.contextmanager
def environment_kept() -> Iterator[None]:
    """Undo what the with-block changes in this process's environment, and nothing else."""
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
def loading() -> Iterator[None]:
    """Within: modules are loaded. They stay, so the garbage collector skips them, now and later."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


@contextlib.contextmanager
def frugal() -> Iterator[None]:
    """Within: libraries that are loaded, here or in processes that are started, have one thread each.

    And Arrow gives memory back when it is freed: its own allocator keeps as much as members were read with, 200 bytes
    each.
    """
    with environment_kept():
        os.environ.update(ONE_THREAD)
        os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
        yield


def n_cores() -> int:
    """The cores that this process may use, where the system says so; else those of the machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


#: How `multiprocessing` is to start local workers.
start_method = "spawn"


@contextlib.contextmanager
def forked_workers() -> Iterator[None]:
    """Within: local workers are forked from a process that loads what they need while this one goes on.

    Only for our own program: a process has one such server, which keeps the environment that it began with. Not on
    macOS, whose libraries may crash after a fork.
    """
    if sys.platform != "linux":
        yield
        return
    from multiprocessing import forkserver

    global start_method
    server: Any = forkserver._forkserver
    with environment_kept(), blocked():
        os.environ |= _environment() | {"PYTHONSAFEPATH": "1"}  # nothing is loaded from the working directory
        server.set_forkserver_preload(["stickslip.pipeline.running.preload"])
        server.ensure_running()
    start_method = "forkserver"
    try:
        yield
    finally:
        start_method = "spawn"
        os.kill(server._forkserver_pid, signal.SIGKILL)


# ---------------------------------------------------------------------------------------------- a child


#: Seconds that a child takes to end once it has closed its pipe.
_LAST_SECONDS = 10.0


class ChildDied(RuntimeError):
    """A child ended instead of answering; the message says how: an exit code or a signal."""


class Child:
    """A function that is called in a process of its own, with one thread; a context manager.

    The process ignores Ctrl-C, which its parent handles, and outlives neither the with-block nor the parent. Whatever
    else it prints goes to its standard error.

    Parameters
    ----------
    function : callable
        Named at the top of a module. It is called with one argument at a time, which is pickled, as is its result.
    shows_errors : bool
        Whether what the process writes to its standard error is seen here.
    """

    def __init__(self, function: Callable[[Any], Any], shows_errors: bool = False) -> None:
        self._process = subprocess.Popen(
            # -P: it is not to look into the working directory first
            [sys.executable, "-P", "-c", _SERVE, function.__module__, function.__qualname__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=None if shows_errors else subprocess.DEVNULL,
            env=_environment() | ONE_THREAD,
            start_new_session=True,
        )
        self.pid = self._process.pid

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(BrokenPipeError):  # of what it no longer reads
                assert pipe is not None
                pipe.close()

    def __call__(self, argument: object) -> Any:
        """The function's result for an argument.

        Raises
        ------
        ChildDied
            If the process ends first, as it does when the function raises.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            pickle.dump(argument, self._process.stdin)
            self._process.stdin.flush()
            return pickle.load(self._process.stdout)
        # perhaps in the middle of an answer, or it is of a class that only the process knows
        except (OSError, EOFError, pickle.UnpicklingError, ImportError, AttributeError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_LAST_SECONDS)
            self.kill()
            code = self._process.returncode
            raise ChildDied(f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}") from error

    def kill(self) -> None:
        """End the process, whatever it is at, and what it has started."""
        if self._process.returncode is None:  # else the number may be another's
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()


def _environment() -> dict[str, str]:
    """This process's environment, in which Python finds the same modules as here."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}


_SERVE = "import sys; from stickslip.pipeline.machine.processes import serve; serve(*sys.argv[1:])"


def serve(module: str, name: str) -> None:
    """Be a child: call a function with each argument that comes in, until no more can come."""
    arguments, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    asked: queue.SimpleQueue[Any] = queue.SimpleQueue()
    function = getattr(importlib.import_module(module), name)

    def listen() -> None:
        try:
            while True:
                asked.put(pickle.load(arguments))
        except EOFError:  # the parent is dead, or has no more use for this process
            pass
        finally:
            os._exit(1)

    threading.Thread(target=listen, daemon=True).start()
    while True:
        pickle.dump(function(asked.get()), answers)
        answers.flush()
