"""The progress of a run: a bar, or a line now and then; and what `stickslip status` prints of it."""

from __future__ import annotations

import socket
import sys
import time
from collections import Counter
from typing import TYPE_CHECKING, TextIO

from tqdm import tqdm

from stickslip.pipeline.dataset.opened import Opened, open_dataset, rows_that_failed
from stickslip.pipeline.dataset.status import Status, status
from stickslip.pipeline.errors import command, printable
from stickslip.pipeline.places.place import Where
from stickslip.workflows.printed import unescaped

if TYPE_CHECKING:
    from stickslip.pipeline import Progress

#: Seconds between two lines where there is no terminal.
EVERY = 10.0
#: Seconds between two looks at a run in a terminal.
_LOOK = 2.0


def clock(seconds: float) -> str:
    """Seconds as m:ss or h:mm:ss."""
    return str(tqdm.format_interval(max(seconds, 0.0)))


def pace(rate: float | None, eta: float | None) -> str:
    """Members a second and the time to go, if these are known, to follow other words."""
    return "" if rate is None or eta is None else f", {rate:.3g} members/s, {clock(eta)} to go"


class Watch:
    """Shows the `Progress` of a run into a directory, then that of its report; a context manager.

    It is a bar in a terminal or a notebook, and a line now and then elsewhere.
    """

    def __init__(self, directory: Where, stream: TextIO | None = None) -> None:
        self._directory = directory
        self._stream = unescaped(sys.stderr if stream is None else stream)
        self._bar: tqdm | None = None
        self._said: float | None = None  # when a line was
        self._last: Progress | None = None
        self._opened: Opened | None = None

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the bar; later output appears below it."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def __call__(self, progress: Progress) -> None:
        if self._last is None and progress.n_done and progress.n_done < progress.n_members:
            self._print(f"{progress.n_done} of {progress.n_members} members are there already")
        if self._last is not None and progress.dashboard is not None and self._last.dashboard is None:
            self._print(f"dask    {progress.dashboard}")
        if self._last is not None and progress.last_shard is not None and progress.n_failed > self._last.n_failed:
            self._opened = open_dataset(self._directory) if self._opened is None else self._opened.again()
            failed = rows_that_failed(self._opened, [progress.last_shard])
            for reason, count in Counter(reason for _, reason in failed).most_common():
                self._print(f"failed  {count}: {reason}")
        is_news = self._last is None or progress.waiting != self._last.waiting
        self._last = progress
        if self._has_bar:
            # measured in cost: members of different size make even progress
            self._draw(progress.cost_done, progress.cost, self._words(progress))
        elif is_news or progress.waiting is None:  # a queue may take hours
            self._line(progress, at_once=is_news)

    def answered(self, n: int, n_all: int) -> None:
        """Show how many of a report's questions are answered; the bar is removed at the end."""
        words, now = f"report: {n}/{n_all} questions", time.monotonic()
        if self._has_bar:
            self._draw(n, n_all, words).leave = False
        elif self._said is None:
            self._said = now  # most reports are done before the first line
        elif now - self._said >= EVERY:
            self._said = now
            print(words, file=self._stream, flush=True)

    @property
    def _has_bar(self) -> bool:
        return self._stream.isatty() or type(self._stream).__module__.startswith("ipykernel.")

    @property
    def elapsed(self) -> float:
        """Seconds that the run took so far."""
        return self._last.elapsed if self._last is not None else 0.0

    def _words(self, progress: Progress) -> str:
        failed = f", {progress.n_failed} failed" if progress.n_failed else ""
        shards = f"{progress.n_shards_done}/{progress.n_shards} shards"
        waiting = f", waiting for {progress.waiting}" if progress.waiting is not None else ""
        elapsed = f"{clock(progress.elapsed)}{pace(progress.rate, progress.eta)}{waiting}"
        return f"{progress.n_done}/{progress.n_members} members, {shards}{failed}, {elapsed}"

    def _print(self, line: str) -> None:
        tqdm.write(printable(line), file=self._stream)  # above the bar, if there is one

    def _draw(self, done: float, total: float, words: str) -> tqdm:
        if self._bar is None:
            self._bar = tqdm(file=self._stream, bar_format="{percentage:3.0f}% |{bar}| {postfix}")
        self._bar.n, self._bar.total = done, total
        self._bar.set_postfix_str(words)
        return self._bar

    def _line(self, progress: Progress, at_once: bool) -> None:
        now = time.monotonic()
        if at_once or self._said is None or now - self._said >= EVERY or progress.is_complete:
            self._said = now
            print(self._words(progress), file=self._stream, flush=True)


# ---------------------------------------------------------------------------------------- of a run elsewhere


def say(directory: Where) -> Status:
    """Print the status of a dataset, and return it."""
    state = status(directory)
    print("\n".join(_status_lines(state)))
    return state


def watch(directory: Where) -> Status:
    """Print the status of a dataset repeatedly until no process writes it, and return the last one."""
    opened = open_dataset(directory)
    last: list[str] = []
    while True:
        opened = opened.again()
        state = status(opened)
        lines = _status_lines(state)
        if sys.stdout.isatty() and last:
            print(f"\x1b[{len(last)}F\x1b[J", end="", file=unescaped(sys.stdout))  # over the last ones
        if lines != last or sys.stdout.isatty():
            print("\n".join(lines), flush=True)
        last = lines
        if state.running is None:
            return state
        time.sleep(_LOOK if sys.stdout.isatty() else EVERY)


def _status_lines(state: Status) -> list[str]:
    outcomes = ", ".join(f"{count} {outcome}" for outcome, count in state.outcomes.items()) or "none yet"
    lines = [
        f"members {state.n_done} of {state.n_members} done: {outcomes}",
        f"shards  {state.n_shards_done} of {state.n_shards}, {state.n_bytes / 1e6:.2f} MB",
    ]
    if state.n_damaged:
        which = command("verify", state.path)
        lines.append(
            f"damaged {state.n_damaged} of these shards, or missing, with {state.n_lost} of the members:"
            f" `{which}` says which"
        )
    if state.running is not None:
        elapsed = clock(time.time() - state.running.began)
        # a store's lock is a lease, which its owner renews
        is_seen = "://" in state.path or state.running.owner.endswith(f" on {socket.gethostname()}")
        said = "" if is_seen else ", as its lock says: only there it can be seen to live"
        lines.append(f"running {state.running.owner}{said}, {elapsed}{pace(state.rate, state.eta)}")
        lines += [f"dask    {state.running.dashboard}"] * (state.running.dashboard is not None)
    elif not state.is_complete:
        lines.append("running nothing: rerun the scene to resume")
    return lines + [f"failed  {count}: {printable(reason)}" for reason, count in state.failures.items()]
