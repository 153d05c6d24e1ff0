"""How a run ends when it is told to: the first SIGINT or SIGTERM ends it between two commits, the second at once."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


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
def interruptible() -> Iterator[None]:
    """Within: the first SIGINT or SIGTERM raises `Interrupted`; the second does the last acts and ends the process.

    To be entered once, by the program's main thread; elsewhere it does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _state.asked, _state.raised, _state.held = None, False, 0
    previous = {number: signal.signal(number, _answer) for number in _SIGNALS}
    try:
        yield
    finally:
        if _state.asked is None:  # else the program is ending, and a second signal may still come
            for number, handler in previous.items():
                signal.signal(number, handler)


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

    resource_tracker.ensure_running()  # started later, it would unblock the signals
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
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
