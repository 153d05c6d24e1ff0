"""What is printed for people, in which names of others may be: a terminal obeys control characters."""

from __future__ import annotations

import codecs
import contextlib
import sys
from collections.abc import Iterator
from typing import IO, Any, TextIO

from stickslip.pipeline.errors import printable


class Printed:
    """A stream of text in which control characters are written as Python writes them, but for the ends of lines.

    Attributes
    ----------
    unescaped : TextIO
        The stream below, for what moves a cursor.
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
    with (
        contextlib.redirect_stdout(Printed(sys.stdout)),
        contextlib.redirect_stderr(Printed(sys.stderr)),
    ):
        yield


class Terminal:
    """A stream of bytes to a terminal, to which a text in UTF-8 is written as `Printed` writes it."""

    closed = False

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._decoded = codecs.getincrementaldecoder("utf-8")("replace").decode

    def write(self, content: bytes) -> int:
        """Write a part of the text."""
        self._stream.write(printable(self._decoded(bytes(content))).encode())
        return len(content)

    def flush(self) -> None:
        """Have the terminal show it."""
        self._stream.flush()
