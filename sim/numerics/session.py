"""What a session has told NumPy stays outside."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np

#: A context, and decorator, in which arithmetic has NumPy's own rules, whatever `seterr` has said: a number that
#: underflows is zero. It costs a microsecond, which runs of small systems notice.
numpy_arithmetic = partial(np.errstate, divide="warn", over="warn", under="ignore", invalid="warn")


@contextmanager
def numpy_defaults() -> Iterator[None]:
    """The same for texts too, whatever `set_printoptions` has said: that of a number has all its digits."""
    with numpy_arithmetic(), np.printoptions(legacy=False):
        yield
