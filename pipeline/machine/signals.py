"""How a program ends when it is told to.

The first SIGINT, SIGTERM or SIGHUP ends it in order, between two commits, if that takes no longer than a grace; the
second ends it at once.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FrameType

#: Those that may reach every process of a group, and those that end a program.
_OF_GROUPS = (signal.SIGINT, signal.SIGTERM)
_SIGNALS = (*_OF_GROUPS, signal.SIGHUP)

#: Seconds that a program has to end in order.
_GRACE = 2.5


class Interrupted(KeyboardInterrupt):
    """A signal asked the program to end; `exit_code` is what a shell expects then."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number


@dataclass
class _State:
    asked: int | None = None  #: the first signal
    raised: bool = False  #: whether it has been
    held: int = 0  #: how many `unbroken` blocks we are in


_state = _State()
_last_acts: list[Callable[[], None]] = []


@contextlib.contextmanager
def interruptible(is_program: bool = False) -> Iterator[None]:
    """Within: the first signal raises `Interrupted`; the second does the last acts and ends the process.

    To be entered once, by the main thread; elsewhere it does nothing. SIGHUP stays ignored in a process that was
    started so, as by nohup.

    Parameters
    ----------
    is_program : bool
        Whether the process is to end: it then does so a grace after the first signal, whatever it is at.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _state.asked, _state.raised, _state.held = None, False, 0
    is_ignored = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    previous = {n: signal.signal(n, _answer) for n in _SIGNALS if not (n == signal.SIGHUP and is_ignored)}
    unwatch = _watch() if is_program else None
    try:
        yield
    finally:
        if _state.asked is None:  # else the program is ending, and a second signal may still come
            for number, handler in previous.items():
                signal.signal(number, handler)
            if unwatch is not None:
                unwatch()


def _watch() -> Callable[[], None]:
    """Have a thread end the process a grace after a signal; what is returned ends the thread.

    The system tells it of the signal. Python's handler waits for the main thread, which may be in compiled code.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    earlier = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    threading.Thread(target=_end_after_grace, args=(reading,), daemon=True).start()

    def unwatch() -> None:
        signal.set_wakeup_fd(earlier)
        os.close(writing)

    return unwatch


def _end_after_grace(reading: int) -> None:
    with open(reading, "rb", buffering=0) as signals:
        while number := signals.read(1):
            if number[0] in _SIGNALS:
                time.sleep(_GRACE)
                end_at_once(number[0])


def _answer(number: int, frame: FrameType | None) -> None:
    if _state.asked is not None:
        end_at_once(number)
    _state.asked = number
    if not _state.held:
        _raise()


def _raise() -> None:
    if _state.asked is not None and not _state.raised:
        _state.raised = True
        raise Interrupted(_state.asked)


def leave(code: int) -> None:
    """End the process if a signal asked it to: Python's own end takes seconds, and no thread can break it off."""
    if _state.asked is not None:
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):  # nobody reads it any more
                stream.flush()
        os._exit(code)


def end_at_once(number: int) -> None:
    """Do the last acts, the newest first, and end the process without any other ceremony."""
    for act in reversed(_last_acts):
        with contextlib.suppress(Exception):
            act()
    os._exit(128 + number)


@contextlib.contextmanager
def unbroken() -> Iterator[None]:
    """Within: the first signal waits until the block is left."""
    _state.held += 1
    try:
        yield
    finally:
        _state.held -= 1
    if not _state.held:
        _raise()


@contextlib.contextmanager
def blocked() -> Iterator[None]:
    """Within: threads and processes that this thread starts ignore SIGINT and SIGTERM, as does what they start.

    Both may reach every process of a group: this one alone answers them, and ends the others.
    """
    from multiprocessing import resource_tracker  # here, and so in `processes`, so that --help is quick

    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGHUP,))
    resource_tracker.ensure_running()  # it outlives a closed terminal; started later, it would unblock the others
    signal.pthread_sigmask(signal.SIG_SETMASK, {*before, *_OF_GROUPS})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def last_act(act: Callable[[], None]) -> Iterator[None]:
    """Within: a second signal calls `act` before the process ends."""
    _last_acts.append(act)
    try:
        yield
    finally:
        _last_acts.remove(act)
