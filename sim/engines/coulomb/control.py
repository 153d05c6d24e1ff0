"""The control of steps: all constants that the lengths and errors of steps depend on."""

from __future__ import annotations

import math

from stickslip.sim.engines import loop
from stickslip.sim.kernels.compile import inner

ORDER_MAX = 32
SPAN = 5.0
ORDER_MIN = 4
LOOSEST = 1e-3
HUGE = 1e250
ROUNDED_OFF = 0.05
TINY = 1e-200
TO_POLE = 0.5
RISING = 0.5
SHRINK = 0.7
REACH = 1.2
DECAY = 0.9
WORTH = 0.1
PASSED_ON = 0.002
DOUBT = 10.0
SPARSE_SPAN = 2.0
SHARE, FEW = 8, 24
GROWTH = math.exp(SPARSE_SPAN)
HEAVY = 100.0
SETTLED, MOST_ITERATIONS = 0.01, 15
SHORTER, MOST_SHORTER = 0.6, 4
MOST_PATIENCE = 64
STALL = 1000
CRAWL = 1e-6

# behind the common clocks: decaying sums for the mean length of a window, time and number of windows cut short
EXPOSURE, CUTS = loop.N_CLOCKS, loop.N_CLOCKS + 1


@inner
def next_window(clock, remaining):  # type: ignore[no-untyped-def]
    """How long the next window is to be."""
    return min(remaining, REACH * clock[EXPOSURE] / clock[CUTS])


@inner
def is_worth_using(clock, left):  # type: ignore[no-untyped-def]
    """Whether what is left of a window is used."""
    return left > WORTH * clock[EXPOSURE] / clock[CUTS]


@inner
def note_window(clock, is_cut):  # type: ignore[no-untyped-def]
    """Take a window, whose time is in the clock, into the mean length."""
    clock[EXPOSURE] *= DECAY
    clock[CUTS] = DECAY * (clock[CUTS] + (1.0 if is_cut else 0.0))
