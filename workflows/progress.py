"""What a person sees while a scene runs: a bar in a terminal, a line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TextIO

from tqdm import tqdm

from pipeline import Progress

#: Seconds between two lines where there is no terminal.
_EVERY = 10.0


def clock(seconds: float) -> str:
    """Seconds as m:ss or h:mm:ss."""
    return str(tqdm.format_interval(seconds))


class Watch:
    """Shows `Progress` as it comes; a context manager, called with each."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._bar: tqdm | None = None
        self._said = -_EVERY
        self._last: Progress | None = None

    def __enter__(self) -> Watch:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, progress: Progress) -> None:
        if self._last is None and progress.n_done and progress.n_done < progress.n_members:
            print(f"{progress.n_done} of {progress.n_members} members are there already", file=self._stream)
        self._last = progress
        if self._stream.isatty():
            self._draw(progress)
        else:
            self._line(progress)

    @property
    def elapsed(self) -> float:
        """Seconds that the run took so far."""
        return self._last.elapsed if self._last is not None else 0.0

    def _words(self, progress: Progress) -> str:
        failed = f", {progress.n_failed} failed" if progress.n_failed else ""
        eta = "" if progress.eta is None else f", {clock(progress.eta)} to go"
        return f"{progress.n_done}/{progress.n_members} members{failed}, {clock(progress.elapsed)}{eta}"

    def _draw(self, progress: Progress) -> None:
        if self._bar is None:
            # measured in cost: members of different size make even progress
            self._bar = tqdm(
                total=progress.cost, file=self._stream, bar_format="{percentage:3.0f}% |{bar}| {postfix}"
            )
        self._bar.n = progress.cost_done
        self._bar.set_postfix_str(self._words(progress))

    def _line(self, progress: Progress) -> None:
        now = time.monotonic()
        if now - self._said >= _EVERY or progress.n_done == progress.n_members:
            self._said = now
            print(self._words(progress), file=self._stream, flush=True)
