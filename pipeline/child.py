"""Processes of this program beside this one, which talk to it in pickles."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import IO, Any


class Child(subprocess.Popen[bytes]):
    """A Python process that imports what this one does, and runs `code`.

    It reads from `to_it` and writes to `from_it`: one that ends when it finds nothing more to read outlives nobody.
    It is deaf to Ctrl-C, which is this process's to answer.
    """

    def __init__(self, code: str) -> None:
        super().__init__(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
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
