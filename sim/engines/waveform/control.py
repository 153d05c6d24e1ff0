"""The control of steps: all constants that their lengths and errors depend on, and how one step follows another.

A constant without a unit is a share or a number. Where nothing else is said, it was chosen and not measured alone:
all together are tested against a method of order 13 on random systems (`tests/sim/test_sigmoid_accuracy.py`, which
prints the errors).
"""

from __future__ import annotations

from typing import Generic, NamedTuple

import numpy as np

from stickslip.sim.engines import course
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.panels import SINGLE_ERROR
from stickslip.sim.numerics.radau import STAGES

# ------------------------------------------------------------------------------------------------- tolerances inside

#: The internal tolerances over those of the settings, such that errors of random systems are about the latter.
CALIBRATION = 5.0
#: A substep has the tolerance SUBSTEP tol^POWER, and the safety factor is that over tol: by superconvergence the
#: error at its end is far less than that of the polynomial. By the error that is delivered, n = 200 with ratios in
#: (0, 1], twice as much takes up to 15% longer at 1e-6.
SUBSTEP, POWER = 1.5, 0.85
#: The error of w allowed for K in single precision, over tolerance: under a smooth law, and under the set-valued one.
SINGLE_SHARE, EXACT_SINGLE_SHARE = 0.05, 0.25
#: The sizes of numbers, at least and at most, whose products in single precision neither underflow nor overflow.
SINGLE_LEAST, SINGLE_MOST = 1e-30, 1e30
#: The rounding of F, over F and the sum of the magnitudes of the terms of K z: eight units in the last place.
ROUNDING = 8.0 * 2.0**-52

# ----------------------------------------------------------------------------------------------- waveform iteration

#: The most waveform iterations, and the most Newton iterations of a macro step in each.
MOST_ITERATIONS, MOST_NEWTON = 8, 5
#: In tolerances: the change of w in a step allowed for the leading coefficient of F.
TAIL = 3.0
#: The residual allowed in the waveform iteration is (ITERATED / safety factor)^2 tolerances. It has the sign of the
#: error of the prediction, always the same: on a stick-slip cycle it adds up step by step, over the many steps of
#: tight tolerances.
ITERATED = 1.5
#: Under the set-valued law the first iteration has products of those blocks alone whose z is off its prediction, of
#: so many at least, unless more than a share of all are: off by so many tolerances, over the step and what signs at
#: random leave of the largest row sum of |K|, a share of n^(-1/2).
FEWEST, MOST_OFF, OFF = 100, 0.25, 20.0
#: The share of that at which the first iteration is the last, since the error of a prediction keeps its sign.
AT_ONCE = 0.1
#: The contraction of an iteration counts as at most this.
SLOWEST = 0.9
#: Under the set-valued law the contraction of the next iteration over that of this one: what it repeats is an
#: integral over time, so that k of them have a factor of 1 / k!, or, without damping, of 1 / (2 k)!.
FASTER = 0.5

# ------------------------------------------------------------------------------------------------------ macro steps

#: The usual safety factor of step sizes: a step aims at this share of the one that its error allows.
SAFETY = 0.9
#: A step changes by these factors at most. A prediction is good for little more than the length of the last step:
#: GROW_FAST is for steps whose tail is below FAR_BELOW of the one allowed.
SHRINK, GROW, GROW_FAST = 0.2, 1.25, 2.0
FAR_BELOW = 1e-2
#: The factor of a step that failed for another reason than its tail.
HALVE = 0.5
#: A step that covers this share of the rest of a piece takes all of it; one that covers more than half takes half.
TAKES_ALL = 0.999
#: The shortest step, over the time (of at most 1 before t = 1): shorter ones are lost in rounding.
SHORTEST = 1e-14
#: The first step, and the first after a jump of F, is FIRST atol^(1 / 5) over the fastest change, and at most
#: LONGEST_FIRST (units of time). The first substep is FIRST_SUBSTEP of that.
FIRST, LONGEST_FIRST, FIRST_SUBSTEP = 0.3, 0.1, 0.25
#: A block at rest creeps by the rounding of friction, at this share of the width of its layer at most: a step is so
#: long that it goes no further than atol, and a slice goes not much further.
CREEP = 1e-14
#: Over friction: a jump of F, where the slope of a belt's speed changes, that is more than rounding.
JUMP = 1e-9

# --------------------------------------------------------------------------------------------------------- substeps

#: The most Newton iterations of a substep, and the largest and smallest ratio to the one before.
MOST_NEWTON_OF_SUBSTEP = 8
GROW_SUBSTEP, SHRINK_SUBSTEP = 5.0, 0.1
#: The factor of a substep whose iteration failed; one that failed the error test is cut by HALVE at least.
SHRINK_UNSOLVED = 0.25
#: As `TAKES_ALL`, of the macro step.
SUBSTEP_TAKES_ALL = 0.97
#: Over the macro step: a substep that is too short, and a rest that is rounding.
SHORTEST_SUBSTEP, NOTHING_LEFT = 1e-13, 1e-12

# --------------------------------------------------------------------------------------------- the error of one step

#: The error left by Newton's method, over the tolerance of a step.
SOLVED = 0.05
#: Newton's method has converged at a change within rounding, over the size of its terms; with a quadratic error that
#: is small enough, also at a change that leaves a block so many delta out of its layer, or, within the layer, at one
#: of less than so many delta.
NEWTON_ROUNDING, OUT_OF_LAYER, IN_LAYER = 1e-15, 20.0, 0.1
#: The weight of the last but one coefficient in the error, since the last may vanish by parity.
LAST_BUT_ONE = 0.05
#: The weight of the defect at the start, where it is extrapolated from the nodes and larger than between them.
AT_START = 0.3
#: A step that begins within IN delta of the belt's speed, or on its other side, and ends beyond OUT delta has jumped
#: the layer. The weight of its error is PASSED times the safety factor.
IN, OUT, PASSED = 2.0, 10.0, 3.0

# ---------------------------------------------------------------------------------------------- at a peak of friction

#: A block nearer to the belt's speed than so many times its peak may be about to leave stick. At the peak F, which
#: changes at a rate a, moves w - v on the scale delta^(4/3) for a time of the scale delta^(2/3): an error of w - v
#: becomes one of the exit time, delta^(-2/3) times as large, and an error of F becomes one that is 1 / a times as
#: large.
NEAR_PEAK = 3.0
#: The error allowed in a step that leaves a peak of friction, over its tolerance and delta^(2/3).
FINE = 0.1
#: But a force that exceeds static friction by this or more takes the block past the peak, in this over the force.
SWIFT = 1e3
#: The error allowed in a step that comes near a peak, over the peak: a larger one may pass the layer undetected. Of
#: 40,000 sets of blocks that reach their layer at speed two were wrong, whose F was within the tolerance of static
#: friction.
OF_PEAK = 0.05
#: Also over the distance of u from the peak;
OF_DISTANCE = 0.1
#: but at least this, over the root of the tolerance: F is then within the square of that of static friction.
OF_ROOT = 0.5
#: Over the safety factor: the weight of the tail of F where a block comes to its layer, or, held by more than LOADED
#: of static friction, may leave it. The polynomial of F is off there by about its tail, since z of each block that
#: leaves or comes has a kink; it moves the time at which a block leaves, which nothing corrects: a cycle keeps all
#: such errors, and most have one sign.
OF_TAIL, LOADED = 150.0, 0.9
#: The rate (per unit of time) below which the peak of a law that peaks by weakening alone does not matter.
STEEP = 0.05

# ------------------------------------------------------------------------------------------------ the set-valued law

#: A block slips through a step by collocation if |R| h is below SOFT, or the leading coefficient of u' changes u by
#: less than so many tolerances; else by series.
SOFT, COLLOCATED = 0.25, 4.0
#: The largest |R| h of a series, and the most pieces of a block in a macro step.
LONGEST_SERIES, MOST_PIECES = 1.0, 24
#: Below this |u| over |v|, w cannot be told from v.
AT_BELT = 2.0**-51
#: The error allowed in w, over the tolerance of the settings and the scale of w.
EXACT_CALIBRATION = 5.0
#: The error of w that a step leaves, over its tail and the tolerance that iterations leave. Measured, damping 0.02
#: to 1 and tolerances 1e-3 to 1e-6: the error of runs was 0.4 to 1.7 of what follows in the median, 5 at most.
AT_END = 0.03

#: What a certificate of collapse costs for few blocks, see `certificates.cost_of`.
CERTIFICATE = 2500.0

#: Clocks behind those that every engine keeps: the next step to try, the one whose polynomials are kept, the
#: contraction of an iteration, and whether F has jumped since the last step.
STEP, KEPT_STEP, CONTRACTION, JUMPED = range(course.N_CLOCKS, course.N_CLOCKS + 4)


class Control(NamedTuple, Generic[course.Number]):
    """The end of a piece, and the tolerances: a goal of `frame`."""

    t_end: course.Number  #: from the start of the piece
    is_last: bool  #: whether the run ends there
    instant: float  #: if not negative: take one step to record the events by then, and keep the state
    bound: course.Number  #: of |z_i| and |w_i|
    longest: float  #: the longest step, by the frequencies of forces
    safety: float  #: the safety factor, tolerance of a substep over that of the run
    single_rate: course.Number  #: the error of K z in single precision, over the change of z and the share allowed


class Solution(NamedTuple):
    """The result of a macro step."""

    converged: bool
    tail: float  #: the change of w by the leading coefficient of F, at most, over tolerance
    contraction: float  #: of an iteration
    n_substeps: int  #: or -1 - i if block i could not be solved


def safety_factor(tolerance: float) -> float:
    """The safety factor, from the internal atol + rtol."""
    return max(1.0, SUBSTEP * tolerance ** (POWER - 1.0))


def first_step(atol: float, speed: float) -> float:
    """The length of a step before which only a rate of change is known."""
    return (atol**0.2) * FIRST / speed if speed > 0 else float("inf")


@inner
def next_step(control: Control[float], clock: Floats) -> float:
    """Length of the next macro step, such that no rest of a piece is much shorter than the step before it."""
    remaining = control.t_end - clock[course.TIME]
    h = min(clock[STEP], control.longest)
    if h >= TAKES_ALL * remaining:
        return remaining
    return 0.5 * remaining if h > 0.5 * remaining else h


@inner
def single_limit(control: Control[float], atol: float, h: float, lag: float) -> float:
    """The largest change of z in a step whose product with K may be in single precision."""
    return atol / (max(1.0, h) * max(h, lag) * control.single_rate)


@inner
def is_in_single_range(control: Control[float], size: float) -> bool:
    """Whether a change of this size, and its product with K, are within single precision."""
    product = size * control.single_rate / SINGLE_ERROR
    return size == 0.0 or (min(size, product) > SINGLE_LEAST and max(size, product) < SINGLE_MOST)


@inner
def shrink(clock: Floats, h: float, tail: float) -> None:
    """Set the step to try after one that failed; the tail of F scales with h^3 there."""
    factor = max(SAFETY * (TAIL / tail) ** (1.0 / 3.0), SHRINK) if tail > TAIL else HALVE
    clock[STEP], clock[CONTRACTION] = h * factor, 0.0


@inner
def grow(clock: Floats, h: float, solution: Solution, may_grow: bool) -> None:
    """Set the step to try after one that was accepted; after a failure it does not grow at once."""
    factor = SAFETY * (TAIL / max(solution.tail, 1e-300)) ** (1.0 / STAGES)
    most = GROW_FAST if solution.tail < FAR_BELOW * TAIL else GROW
    clock[KEPT_STEP], clock[CONTRACTION], clock[JUMPED] = h, solution.contraction, 0.0
    clock[STEP] = h * min(max(factor, SHRINK), most if may_grow else 1.0)


def single_rate(pull: Floats) -> Floats:
    """The error of K z in single precision, over the change of z, from the largest row sum of each |K|.

    It is infinite if K leaves the range of single precision.
    """
    return np.where((pull > SINGLE_LEAST) & (pull < SINGLE_MOST), SINGLE_ERROR * pull, np.inf)
