"""What a session has told NumPy stays outside."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np


@contextmanager
def numpy_defaults() -> Iterator[None]:
    """A context, and decorator, in which NumPy has its own rules, whatever `seterr` and `set_printoptions` have said.

    A number that underflows is zero, and the text of a number has all its digits.
    """
    with (
        np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"),
        np.printoptions(legacy=False),
    ):
        yield
