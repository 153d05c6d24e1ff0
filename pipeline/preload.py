"""What the process loads that local workers are forked from; imported there for its effect."""

from importlib import import_module

import numba

from stickslip.pipeline import cluster, worker  # noqa: F401
from stickslip.sim import engines

for engine in engines.ENGINES.values():
    if engine.kernels:
        import_module(f"{engines.__name__}.{engine.kernels}")
# the first function that is compiled, or loaded, takes half a second: numba prepares itself
numba.njit("void()")(lambda: None)
