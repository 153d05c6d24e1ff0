"""The control of steps: all constants that the lengths and errors of steps depend on, and the length of a window.

A constant without a unit is a share or a number. "Chosen" says that there is no measurement of it alone. Where it was
varied alone, the change in products of K with a vector is given, unless other blocks are named, for 200 blocks of
`antisymmetric` to t = 200 and 20 to t = 400, at tolerances 1e-5, 1e-8 and 1e-10. All together are tested against
methods that share no code, on random systems (`tests/independent.py`, `python -m tests.fuzz`).
"""

from __future__ import annotations

import math
from typing import Generic, NamedTuple

from stickslip.sim.engines import course
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats

# ------------------------------------------------------------------------------------------------------ the series

#: The highest order, and the longest step, in units of 1 / |eigenvalue|. At that step the last term is below 1e-13,
#: and rounding is amplified by less than exp(5); a longer one loses more to rounding than it gains. With 20 blocks
#: SPAN = 3 took -13% to +37% products, and SPAN = 7 some +10% with errors up to 9 times as large; with 200 windows
#: are shorter.
ORDER_MAX, SPAN = 32, 5.0
#: The lowest order. Chosen.
ORDER_MIN = 4
#: The least error that is allowed: a motion that has decayed to nothing would allow none, and no step would do.
LEAST_ALLOWED = 1e-300
#: A coefficient of this size, and those behind it, are not used: they would leave float64.
HUGE = 1e250
#: Nor is one that would be below this with one order more: those behind it vanish by underflow, and not because the
#: motion is a polynomial.
FAINT = 1e-300
#: How far a polynomial is followed at once: by this change of its first coefficient.
FAR = 1e290
#: The error of products in single precision, over the error allowed. With 0.01 and 0.2 products
#: were the same, errors within 4%, times within the noise. A vector whose size is below TINY is out of range.
#: TINY was chosen.
ROUNDED_OFF, TINY = 0.05, 1e-200
#: The error of a product in single precision, where the terms of its sums have random signs, over its bound.
LIKELY = 0.05

# ------------------------------------------------------------------------------------------------------- weakening

#: A step is at most the time in which x, at its present slope, goes this share of the way to a pole of the shape: the
#: terms of the series then fall by about this factor. 0.25 took up to 2% fewer products and 1% more steps, 0.8 up to
#: 1% more products (20 blocks to t = 100, Rational(3) and Stribeck(0.3), static friction 1.3).
TO_POLE = 0.5
#: The terms of a shape without a pole fall beyond an order if x changes by less than this share of the order. With
#: 0.25 and 1 nothing changed (the same blocks).
RISING = 0.5
#: The factor of a step until they do. Chosen.
SHRINK = 0.7

# --------------------------------------------------------------------------------------------------------- windows

#: A window aims at this many mean lengths: what lies beyond is mostly cut off. REACH = 0.8 took -3% to +8% products,
#: 1.8 took -1% to +11%.
REACH = 1.2
#: The weight of older windows in that mean, one window on. 0.8 took up to 4% more products, 0.95 up to 1% fewer.
DECAY = 0.9
#: The error that an event carried over may leave out, over the error allowed: the truncation error of a series is
#: about as far below it. With 0.002, 100 to 400 dense blocks took 5 to 16% more time at 1e-10, with errors of 3e-14
#: where they are 2e-13 now.
PASSED_ON = 0.02
#: That of fewer blocks than `CARRIED`: with 0.02 short sticks of a slow block that a fast one shakes were taken for
#: touches.
OF_FEW = 0.002
#: The fewest blocks with which events are carried over. With 10 a new expansion at each took 0.9 of the time, with 50
#: 0.8 to 1, with 200 1.2 to 1.3, with 400 2.1 to 2.6 times as long.
CARRIED = 64
#: An event is decided by its series if the force is this many times its error away from another decision. With 3
#: and 30 products changed by 0.1% at most.
DOUBT = 10.0

# -------------------------------------------------------------------------------------------------------- sparse K

#: The longest window, in units of 1 / |eigenvalue|: high orders are cheap for all blocks together, not for each
#: event. With a chain of 1000 blocks to t = 150, 1 took 1.4 times as long, and 4 some 0.85 of the time, with errors
#: up to 2.5 times as large.
SPARSE_SPAN = 2.0
#: A local update has at most this share of the blocks (one in SHARE), or FEW: beyond, a new expansion costs less.
#: Chosen. (Of the chain, SHARE decides, and another FEW changes nothing.)
SHARE, FEW = 8, 24
#: A bound of the growth of the effect of an event within a window.
GROWTH = math.exp(SPARSE_SPAN)

# ---------------------------------------------------------------------------------------------------- heavy damping

#: A block is heavily damped if its R is this many times all rates without it: for smaller R short steps cost no more.
#: With R = 1e4 at 5 of 20 blocks, 30 and 300 changed nothing.
HEAVY = 100.0
#: Its series have converged when an iteration changes w by less than the error allowed, within so many iterations,
#: each of which gains a factor of HEAVY.
MOST_ITERATIONS = 15
#: The factor of a step whose series do not end by the highest order, and how often it is applied. Chosen.
SHORTER, MOST_SHORTER = 0.6, 4
#: After failures 1, 2, 4, ... steps of `taylor.expand` come first, at most this many. Chosen.
MOST_PATIENCE = 64

# ---------------------------------------------------------------------------------------------------------- stalls

#: So many instants in a row, each closer to the last than rounding can tell, are an accumulation of events. Chosen.
STALL = 1000
#: So are as many steps in a row without an event, each below this share of the shortest time scale. Chosen.
CRAWL = 1e-6

#: What a certificate of collapse costs for few blocks, see `certificates.cost_of`.
CERTIFICATE = 5000.0

#: Touches are told by so many times the estimate of the error of w (`taylor.error_after`). Measured: the error was
#: up to 1.9 of it at the first touches of 16,000 runs of three undamped, uncoupled blocks, tolerances 1e-4 to 1e-13.
TOLD = 4.0

#: Clocks behind those that every engine keeps: decaying sums, for the mean length of a window, of their time and of
#: the number of windows that were cut short.
EXPOSURE, CUTS = range(course.N_CLOCKS, course.N_CLOCKS + 2)


class Goal(NamedTuple, Generic[course.Number]):
    """What a piece is run to: its end, the tolerance, and bounds."""

    t_end: course.Number  #: from the start of the piece
    is_last: bool
    instant: float  #: none: -1
    tol: course.Number
    rate: course.Number  #: bounds |eigenvalues|
    decay: course.Number  #: the rate at which errors fade, at least
    bound: course.Number  #: of |z_i| and |w_i|; beyond it Python decides whether the run diverges


@inner
def next_window(clock: Floats, remaining: float) -> float:
    """Length of the next window."""
    return min(remaining, REACH * clock[EXPOSURE] / clock[CUTS])


@inner
def passed_on(n: int) -> float:
    """The share of the error allowed that n blocks may leave out at an event."""
    return PASSED_ON if n >= CARRIED else OF_FEW


@inner
def note_window(clock: Floats, is_cut: bool) -> None:
    """Take a window, whose time is in the clock, into the mean length."""
    clock[EXPOSURE] *= DECAY
    clock[CUTS] = DECAY * (clock[CUTS] + (1.0 if is_cut else 0.0))
