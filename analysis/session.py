"""What a session has told NumPy and pandas stays outside."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

import pandas as pd

from stickslip.sim.numerics.session import numpy_defaults

#: Options of pandas on which values, or their types, depend, as pandas has them by itself.
_OPTIONS = {
    "compute.use_bottleneck": True,
    "compute.use_numba": False,
    "compute.use_numexpr": True,
    "future.distinguish_nan_and_na": False,
    "mode.string_storage": "auto",
}


@contextmanager
def defaults() -> Iterator[None]:
    """A context, and decorator, in which tables and numbers are those of a fresh session."""
    with numpy_defaults(), ExitStack() as stack:
        for name, value in _OPTIONS.items():
            with suppress(pd.errors.OptionError):  # another version of pandas may not have it
                stack.enter_context(pd.option_context(name, value))
        yield
