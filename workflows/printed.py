"""What is printed for people, in which names of others may be: a terminal obeys control characters."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import Any, TextIO

from stickslip.pipeline.errors import printable


class Printed:
    """A stream of text in which control characters are written as Python writes them, but for the ends of lines.

    What moves a cursor is written to `unescaped`, the stream below.
    """

    def __init__(self, stream: TextIO) -> None:
        self.unescaped = stream

    def write(self, text: str) -> int:
        """Write a text."""
        return self.unescaped.write(printable(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.unescaped, name)


def unescaped(stream: Any) -> TextIO:
    """The stream itself, for what moves a cursor."""
    return getattr(stream, "unescaped", stream)


@contextlib.contextmanager
def printed() -> Iterator[None]:
    """Within: what is printed, by whatever library, has no control characters."""
    out, err = (None if stream is None else Printed(stream) for stream in (sys.stdout, sys.stderr))
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        yield
