"""What engines share as settings: tolerances, with values picked where only the purpose is given, widths and steps.

For statistics the scene `statistics` finds 1e-3 tight enough (n = 200, 20 matrices, eps = 0.03); the value picked is
two decades tighter, at half the cost of paths.
"""

from __future__ import annotations

from stickslip.sim.engines.contract import Coarseness, Number

TOL = Number(
    words="truncation error of a step",
    in_id="",
    in_all=True,
    above=1e-16,
    below=1e-2,
    picked={"statistics": 1e-5, "paths": 1e-10},
    coarseness=Coarseness.RELATIVE,
)
RTOL = Number(
    words="relative tolerance",
    in_id="",
    in_all=True,
    above=0,
    below=0.1,
    picked={"statistics": 1e-5, "paths": 1e-8},
    coarseness=Coarseness.RELATIVE,
)
ATOL = Number(
    words="absolute tolerance",
    example=1e-8,
    in_id="",
    in_all=True,
    above=0,
    picked={"statistics": 1e-5, "paths": 1e-8},
    coarseness=Coarseness.ABSOLUTE,
)
WIDTH = Number(
    words="width of the sigmoid",
    column="width of the sigmoid",
    in_id="",
    in_label="always",
    in_all=True,
    above=0,
    coarseness=Coarseness.WIDTH,
)
STEP = Number(words="longest step", in_id="h", in_label="always", above=0, coarseness=Coarseness.STEP)
