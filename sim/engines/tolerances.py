"""The tolerances of the engines: their meaning, bounds, and values picked where only the purpose is given.

For statistics the scene `statistics` finds 1e-3 tight enough (n = 200, 20 matrices, eps = 0.03); the value picked is
two decades tighter, at half the cost of paths.
"""

from __future__ import annotations

from stickslip.sim.engines.contract import Number

TOL = Number(
    words="truncation error of a step", in_id="", above=1e-16, below=1e-2, picked={"statistics": 1e-5, "paths": 1e-10}
)
RTOL = Number(words="relative tolerance", in_id="", above=0, below=0.1, picked={"statistics": 1e-5, "paths": 1e-8})
ATOL = Number(words="absolute tolerance", example=1e-8, in_id="", above=0, picked={"statistics": 1e-5, "paths": 1e-8})
