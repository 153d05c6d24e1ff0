"""Other processes: with one thread each, for as long as this one needs them."""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import queue
import select
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from stickslip.pipeline.machine.scratch import scratch
from stickslip.pipeline.machine.signals import blocked, last_act

# One thread each: threaded products in several processes fight for the cores, and threads that share a sum round
# it differently. Libraries read these when they are loaded, so they must be set before.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


@contextlib.contextmanager
def environment_kept() -> Iterator[None]:
    """Undo what the with-block changes in this process's environment, and nothing else."""
    variables = dict(os.environ)
    try:
        yield
    finally:
        for name in os.environ.keys() | variables.keys():
            if name not in variables:
                del os.environ[name]
            elif os.environ.get(name) != variables[name]:
                os.environ[name] = variables[name]


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """Within: modules are loaded. They stay, so the garbage collector skips them, now, later and at the end."""
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


#: The standard streams that this process was started without.
closed_streams: set[str] = set()


def open_streams() -> None:
    """Open those of the three standard streams that this process was started without, as by ``2>&-``, on nothing.

    Otherwise a file or a connection gets the number, and what is printed.
    """
    while (opened := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(opened, True)
    os.close(opened)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            closed_streams.add(name)
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115  for good


def n_cores() -> int:
    """The cores that this process may use, where the system says so; else those of the machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class ErrorStream:
    """What processes write to their standard error: held back as they start, then passed on to this one's.

    A context manager; what is still held at its end is dropped.
    """

    def __init__(self) -> None:
        reading, self._writing = os.pipe()
        self._error = os.dup(2)
        self._held: deque[bytes] | None = deque(maxlen=_MOST_HELD)
        self._turn = threading.Lock()
        self._copying = threading.Thread(target=self._copy, args=(reading,), daemon=True)
        self._copying.start()

    def __enter__(self) -> ErrorStream:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()
        with self._turn:  # who goes on copying, copies to nobody
            self._held = deque(maxlen=0)
            os.close(self._error)

    @contextlib.contextmanager
    def instead(self) -> Iterator[None]:
        """Within: processes that are started have it as their standard error."""
        os.dup2(self._writing, 2)
        try:
            yield
        finally:
            os.dup2(self._error, 2)

    def pass_on(self) -> None:
        """Pass on what was held, and from now on all that comes."""
        with self._turn:
            chunks, self._held = self._held, None
            for chunk in chunks or ():
                self._pass(chunk)

    def last_lines(self) -> list[str]:
        """The last lines of what was held, once the processes have ended; of a traceback, its end."""
        self._end()
        lines = b"".join(self._held or ()).decode(errors="replace").splitlines()
        return [line for line in lines if line.strip() and not line.startswith("Traceback ")][-_LAST_LINES:]

    def _end(self) -> None:
        if self._writing >= 0:
            os.close(self._writing)
            self._writing = -1
            self._copying.join(_ENDING)  # a process that goes on writing is not waited for

    def _copy(self, reading: int) -> None:
        with open(reading, "rb", buffering=0) as stream:
            while chunk := stream.read(_PART):
                with self._turn:
                    if self._held is None:
                        self._pass(chunk)
                    else:
                        self._held.append(chunk)

    def _pass(self, chunk: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody reads it any more
            os.write(self._error, chunk)


#: Of an `ErrorStream`: bytes that are read at once, parts that are held, lines that are shown, seconds to its end.
_PART, _MOST_HELD, _LAST_LINES, _ENDING = 2**16, 64, 5, 1.0


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Within: what processes that are started write to their standard error is dropped."""
    error, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    os.close(nothing)
    try:
        yield
    finally:
        os.dup2(error, 2)
        os.close(error)


class Forks:
    """The process that local workers are forked from."""

    def __init__(self, pid: int, errors: ErrorStream) -> None:
        self._pid, self.errors = pid, errors

    @property
    def has_died(self) -> bool:
        """Whether it has ended: it is not waited for, for that is the business of `multiprocessing`."""
        try:
            return os.waitid(os.P_PID, self._pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
        except ChildProcessError:  # `multiprocessing` has seen its end
            return True


#: What local workers are forked from; None: each is started anew.
forks: Forks | None = None


@contextlib.contextmanager
def forked_workers() -> Iterator[None]:
    """Within: local workers are forked from a process that loads what they need while this one goes on.

    Only for our own program: a process has one such server, which keeps the environment that it began with. Not on
    macOS, whose libraries may crash after a fork.
    """
    if sys.platform != "linux":
        yield
        return
    from multiprocessing import current_process, forkserver

    global forks
    server: Any = forkserver._forkserver
    settings: dict[str, Any] = current_process()._config  # type: ignore[attr-defined]
    with scratch() as own, ErrorStream() as errors, environment_kept():
        # nothing is loaded from the working directory; what a killed worker leaves goes with the others'
        os.environ |= _environment() | {"PYTHONSAFEPATH": "1", "TMPDIR": own.path}
        settings["tempdir"] = own.pinned  # however long its path, a socket's has 107 bytes
        server.set_forkserver_preload(["stickslip.pipeline.running.preload"])
        with _silent(), blocked():  # starts what removes semaphores: of those of a process that ends at once, no word
            pass
        with blocked(), errors.instead():
            server.ensure_running()
        forks = Forks(server._forkserver_pid, errors)

        def kill() -> None:  # else one that was stopped would outlive this process
            if server._forkserver_pid is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(server._forkserver_pid, signal.SIGKILL)

        try:
            with last_act(kill):
                yield
        finally:
            forks = None
            del settings["tempdir"]
            kill()


# ---------------------------------------------------------------------------------------------- a child


#: Seconds that a child has to start, and takes to end once it has closed its pipe.
_FIRST_SECONDS, _LAST_SECONDS = 60.0, 10.0


_T = TypeVar("_T")


class ChildDied(RuntimeError):
    """A child ended instead of answering; the message says how: an exit code or a signal."""


class Child:
    """A process of its own, with one thread, in which functions are called; a context manager.

    The process ignores Ctrl-C, which its parent handles, and outlives neither the with-block nor the parent. Whatever
    else it prints goes to its standard error.

    Parameters
    ----------
    shows_errors : bool
        Whether what the process writes to its standard error is seen here.
    """

    def __init__(self, shows_errors: bool = False) -> None:
        self._process = subprocess.Popen(
            # -P: it is not to look into the working directory first
            [sys.executable, "-P", "-c", _SERVE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=None if shows_errors else subprocess.DEVNULL,
            env=_environment() | ONE_THREAD,
            start_new_session=True,
        )
        self.pid = self._process.pid
        self._has_started = False

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(BrokenPipeError):  # of what it no longer reads
                assert pipe is not None
                pipe.close()

    def __call__(self, function: Callable[..., _T], *arguments: Any) -> _T:
        """What a function, named at the top of a module, gives of some arguments; all are pickled.

        Raises `ChildDied` if the process ends first, as it does when the function raises, or does not start.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            if not self._has_started:
                starting = select.poll()
                starting.register(self._process.stdout)
                if not starting.poll(1000.0 * _FIRST_SECONDS):
                    self.kill()
                self._has_started = pickle.load(self._process.stdout)
            pickle.dump((function, arguments), self._process.stdin)
            self._process.stdin.flush()
            result: _T = pickle.load(self._process.stdout)
            return result
        # perhaps in the middle of an answer, or it is of a class that only the process knows
        except (OSError, EOFError, pickle.UnpicklingError, ImportError, AttributeError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_LAST_SECONDS)
            self.kill()
            code = self._process.returncode
            raise ChildDied(f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}") from error

    @contextlib.contextmanager
    def within(self, seconds: float) -> Iterator[threading.Event]:
        """Within: the process is killed after so many seconds, which the event tells."""
        is_late = threading.Event()

        def end() -> None:
            is_late.set()
            self.kill()

        limit = threading.Timer(seconds, end)
        limit.start()
        try:
            yield is_late
        finally:
            limit.cancel()

    def kill(self) -> None:
        """End the process, whatever it is at, and what it has started."""
        if self._process.returncode is None:  # else the number may be another's
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()


def _environment() -> dict[str, str]:
    """This process's environment, in which Python finds the same modules as here."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}


_SERVE = "from stickslip.pipeline.machine.processes import serve; serve()"


def serve() -> None:
    """Be a child: call each function that comes in with its arguments, until no more can come."""
    reading, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    questions: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def listen() -> None:
        try:
            while True:
                questions.put(pickle.load(reading))
        except EOFError:  # the parent is dead, or has no more use for this process
            pass
        finally:
            os._exit(1)

    threading.Thread(target=listen, daemon=True).start()
    answer: Any = True  # it has started
    while True:
        pickle.dump(answer, answers)
        answers.flush()
        function, arguments = questions.get()
        answer = function(*arguments)
