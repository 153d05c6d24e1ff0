"""Cases judged in processes of their own, which may hang or die."""

from __future__ import annotations

import multiprocessing
import resource
import signal
import time
from collections.abc import Callable, Collection, Iterator
from multiprocessing.connection import Connection, wait

from tests.fuzz.draw import TERMS, draw
from tests.fuzz.judge import Verdict, judge

PATIENCE = 600.0  # seconds that a case may take before its process is killed
_WORK = 120.0  # seconds of its own time; a busy machine stops no case
_MEMORY = 4 << 30  # bytes of address space beyond what the process starts with


Judged = Callable[[int], Verdict]


def judge_case(seed: int, number: int, terms: Collection[str] = TERMS) -> Verdict:
    """Of one case; the run goes on if the fuzz itself fails."""
    try:
        return judge(draw(seed, number, terms))
    except Exception as error:  # noqa: BLE001  reported as a failure of the case
        return Verdict(failures=[f"the fuzz itself: {type(error).__name__}: {error}"])


def _serve(pipe: Connection, judged: Judged) -> None:
    """In a process of its own: answer the numbers that come."""
    with open("/proc/self/statm") as file:
        size = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + _MEMORY, size + _MEMORY))
    while True:
        number = pipe.recv()
        signal.setitimer(signal.ITIMER_VIRTUAL, _WORK)  # without a handler it kills, also inside a kernel
        pipe.send(judged(number))


class _Worker:
    """A process that judges one case after another, and is replaced when it does not answer."""

    def __init__(self, judged: Judged, patience: float) -> None:
        self._judged, self._patience = judged, patience
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._judged), daemon=True)
        self._process.start()
        theirs.close()

    def ask(self, number: int) -> None:
        self.number, self._deadline = number, time.monotonic() + self._patience
        self.pipe.send(number)

    def answer(self) -> Verdict | None:
        """None while it is at work."""
        try:
            if self.pipe.poll():
                return self.pipe.recv()
            if time.monotonic() < self._deadline:
                return None
            words = f"still at work after {self._patience:.0f} s: killed"
        except (EOFError, ConnectionResetError):
            self._process.join()
            words = f"its process died: exit code {self._process.exitcode}"
            if self._process.exitcode == -signal.SIGVTALRM:
                words = f"still at work after {_WORK:.0f} s of its own: killed"
        self.stop()
        self._start()
        return Verdict(failures=[words])

    def stop(self) -> None:
        self._process.kill()
        self._process.join()


def verdicts(
    judged: Judged, numbers: Iterator[int], n_workers: int, until: float, patience: float = PATIENCE
) -> Iterator[tuple[int, Verdict]]:
    """Of the cases, as they come, until the clock says so; `judged` is sent to the processes."""
    workers = [_Worker(judged, patience) for _ in range(n_workers)]
    try:
        busy = []
        for worker, number in zip(workers, numbers, strict=False):
            worker.ask(number)
            busy.append(worker)
        while busy:
            wait([worker.pipe for worker in busy], timeout=1.0)
            for worker in list(busy):
                verdict = worker.answer()
                if verdict is None:
                    continue
                yield worker.number, verdict
                number = next(numbers, None) if time.monotonic() < until else None
                if number is None:
                    busy.remove(worker)
                else:
                    worker.ask(number)
    finally:
        for worker in workers:
            worker.stop()
