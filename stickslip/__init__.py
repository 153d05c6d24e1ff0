"""Blocks held by dry friction: `from stickslip import draw_system, simulate` is all that a single run needs.

The physics is in `stickslip.sim`, ensembles in `stickslip.pipeline`, their statistics in `stickslip.analysis`, the
command in `stickslip.workflows`; it is also ``python -m stickslip``.
"""

import os

import lazy_loader

if os.name != "posix":
    raise ImportError(
        f"stickslip runs on Linux and macOS, not on {os.name!r}: its locks, signals and workers are those of POSIX; "
        f"on Windows install it inside WSL, the Windows Subsystem for Linux"
    )

# Loaded when a name of it is first asked for: numba and pandas take seconds. The names are in __init__.pyi.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
