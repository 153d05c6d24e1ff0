"""The compiled kernel of runs by series."""

from __future__ import annotations

from typing import NamedTuple

from stickslip.sim.engines.coulomb import sparse, step
from stickslip.sim.engines.coulomb.overdamped import Slow
from stickslip.sim.engines.coulomb.taylor import Expansion
from stickslip.sim.engines.coulomb.windows import Search
from stickslip.sim.engines.loop import by_run
from stickslip.sim.kernels.compile import inner, kernel


@by_run("expansion", "search")
class Work(NamedTuple):
    """What changes in a run, beside its state."""

    expansion: Expansion
    search: Search
    slow: Slow | None  #: of a stack of one: where blocks are heavily damped
    local: sparse.Local | None  #: of a stack of one: where an event is a local update


@inner
def _take(local, stack, events, precheck, first, slices):  # type: ignore[no-untyped-def]
    """By the way that runs are followed."""
    if local is None:
        step.take(stack, events, precheck, first, slices)
    else:
        sparse.take(stack, events, precheck, first, slices)


@kernel
def advance(stack, events, precheck, first, slices):  # type: ignore[no-untyped-def]
    """See `frame`."""
    _take(stack.work.local, stack, events, precheck, first, slices)
