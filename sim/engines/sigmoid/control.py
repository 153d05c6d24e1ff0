"""The control of steps: all constants that their lengths and errors depend on, and how one follows from the last.

A constant without a unit is a share or a number. Where nothing else is said, it was not measured alone: all together
are held against a method of order 13 on random systems (`tests/sim/test_sigmoid_accuracy.py`; the figures are in
`docs/guide/sigmoid-engine.md`).
"""

from __future__ import annotations

from typing import NamedTuple

from stickslip.sim.engines import loop
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.panels import SINGLE_ERROR
from stickslip.sim.numerics.radau import STAGES

# ------------------------------------------------------------------------------------------------- tolerances inside

#: The tolerances inside over those asked for: so chosen that random systems err by what was asked for.
CALIBRATION = 5.0
#: A substep has the tolerance SUBSTEP tol^POWER, over tol the safety factor: superconvergence makes the error at its
#: end far less than that of the polynomial.
SUBSTEP, POWER = 3.0, 0.85
#: The share of tolerance that K in single precision may cost in w.
SINGLE_SHARE = 0.05
#: So many units in the last place of F, and of what K z is a sum of, may be rounding.
ROUNDING = 8.0 * 2.0**-52

# ----------------------------------------------------------------------------------------------- waveform iteration

#: The most iterations of F, and Newton's of a macro step in each.
MOST_ITERATIONS, MOST_NEWTON = 8, 5
#: Of tolerance: what the leading coefficient of F may change w by in a step.
TAIL = 3.0
#: Of tolerance: what the iteration of F may leave, as (ITERATED / safety factor)^2. What it leaves has one sign, that
#: of what a prediction errs by: on a cycle of stick and slip it adds up step by step, and the steps for tight
#: tolerances are many.
ITERATED = 3.0
#: The share of that for a first iteration to be the last: what a prediction errs by has one sign, step by step.
AT_ONCE = 0.1
#: No iteration is taken to leave more than this of a change.
SLOWEST = 0.9

# ------------------------------------------------------------------------------------------------------ macro steps

#: A step aims at this share of what its error allows.
SAFETY = 0.9
#: A step changes by these factors at most. A prediction is good for little more than its own length: GROW_FAST is for
#: steps whose tail is below FAR_BELOW of what is allowed.
SHRINK, GROW, GROW_FAST = 0.2, 1.25, 2.0
FAR_BELOW = 1e-2
#: By how much a step is cut that failed for another reason than its tail.
HALVE = 0.5
#: A step that covers this share of what is left of a piece takes all of it; one of more than half takes half.
TAKES_ALL = 0.999
#: Shorter, over the time itself (at most 1 before t = 1), steps are lost in rounding.
SHORTEST = 1e-14
#: The first step, and the first after a jump of F: FIRST atol^(1 / 5) over the fastest change, and LONGEST_FIRST, in
#: units of time, at most. A substep is FIRST_SUBSTEP of that.
FIRST, LONGEST_FIRST, FIRST_SUBSTEP = 0.3, 0.1, 0.25
#: Of friction: by how much F jumps where a belt's speed begins to change by another rate, if it is no rounding.
JUMP = 1e-9

# --------------------------------------------------------------------------------------------------------- substeps

#: Newton's iterations of a substep, and by how much one may be longer than the one before, or shorter.
MOST_NEWTON_OF_SUBSTEP = 8
GROW_SUBSTEP, SHRINK_SUBSTEP = 5.0, 0.1
#: By how much a substep is cut whose iteration failed; one that erred is cut by HALVE at least.
SHRINK_UNSOLVED = 0.25
#: As `TAKES_ALL`, of the macro step.
SUBSTEP_TAKES_ALL = 0.97
#: Of the macro step: shorter is no step, and what is left by rounding none either.
SHORTEST_SUBSTEP, NOTHING_LEFT = 1e-13, 1e-12

# --------------------------------------------------------------------------------------------- the error of one step

#: The share of a step's tolerance that Newton's method may leave.
SOLVED = 0.05
#: Newton's method is done, of the size of its terms, at a change by rounding; and, in units of delta, at one that
#: leaves a block this far out of its layer, or, within, at one that is this small.
NEWTON_ROUNDING, OUT_OF_LAYER, IN_LAYER = 1e-15, 20.0, 0.1
#: The weight of the last but one coefficient: by parity the last may vanish.
LAST_BUT_ONE = 0.05
#: The weight of the defect at the start: extrapolated to there from the nodes, it is larger than between them.
AT_START = 0.3
#: A step that begins within so many delta of the belt's speed, or on the other side, and ends beyond so many has
#: passed the layer. Its error counts by PASSED times the safety factor.
IN, OUT, PASSED = 2.0, 10.0, 3.0

# ---------------------------------------------------------------------------------------------- at a peak of friction

#: A block nearer to the belt's speed than so many times its peak may be about to leave stick. At the peak F, which
#: changes by a dt, moves w - v on the scale delta^(4/3) for a time of the scale delta^(2/3): what w - v errs by then,
#: the time of leaving errs by delta^(-2/3) times as much, and what F errs by, by 1 / a times.
NEAR_PEAK = 3.0
#: The share of a step's tolerance that is for leaving a peak of friction, over delta^(2/3).
FINE = 0.1
#: But a force that is beyond static friction by so much or more takes it past the peak, in this over the force.
SWIFT = 1e3
#: What a step that comes near to a peak may err by, over the peak: more, and it may pass the layer unseen. Of 40,000
#: sets of blocks that come to their layer at speed two were off, whose F was within the tolerance of static friction.
OF_PEAK = 0.05
#: And over the distance of u from there, as far beyond which a block is let go;
OF_DISTANCE = 0.1
#: but at least this over the root of what was asked for: F there is within the square of static friction.
OF_ROOT = 0.5
#: Slower than at this rate, in units of time, what has left a peak of friction by weakening alone is no matter.
STEEP = 10.0

#: Clocks behind those that every engine keeps: the next step to try, the one whose polynomials are kept, what an
#: iteration leaves of a change, and whether F has jumped since the last step.
STEP, KEPT_STEP, CONTRACTION, JUMPED = range(loop.N_CLOCKS, loop.N_CLOCKS + 4)


class Control(NamedTuple):
    """How far to go, and how closely."""

    t_end: float  #: from the start of the piece
    instant: float  #: from 0 on: take one step to see what happens by then, and leave the state as it is
    longest: float  #: step, by the frequencies of forces
    atol: float  #: inside, of w
    safety: float  #: the safety factor, tolerance of a substep over that of the run
    single_rate: float  #: what single precision makes K z err by, over a change of z


class Found(NamedTuple):
    """What came of a macro step."""

    converged: bool
    tail: float  #: what the leading coefficient of F may change w by, over tolerance
    contraction: float  #: what an iteration leaves of a change
    n_substeps: int  #: or -1 - i if block i could not be solved


def safety_factor(tolerance: float) -> float:
    """The safety factor, from atol + rtol inside."""
    return max(1.0, SUBSTEP * tolerance ** (POWER - 1.0))


def first_step(atol: float, speed: float) -> float:
    """The length of a step of which is known only how fast something changes."""
    return (atol**0.2) * FIRST / speed if speed > 0 else float("inf")


@inner
def next_step(control, clock):  # type: ignore[no-untyped-def]
    """Length of the next macro step: no rest of a piece is much shorter than the step before it."""
    remaining = control.t_end - clock[loop.TIME]
    h = min(clock[STEP], control.longest)
    if h >= TAKES_ALL * remaining:
        return remaining
    return 0.5 * remaining if h > 0.5 * remaining else h


@inner
def single_limit(control, h):  # type: ignore[no-untyped-def]
    """The largest change of z in a step whose product with K may be in single precision."""
    return SINGLE_SHARE * control.atol / (max(1.0, h) * h * control.single_rate)


@inner
def shrink(clock, h, tail):  # type: ignore[no-untyped-def]
    """Set the step to try after one that failed; the tail of F goes with h^3 there."""
    factor = max(SAFETY * (TAIL / tail) ** (1.0 / 3.0), SHRINK) if tail > TAIL else HALVE
    clock[STEP], clock[CONTRACTION] = h * factor, 0.0


@inner
def grow(clock, h, found, may_grow):  # type: ignore[no-untyped-def]
    """Set the step to try after one that was accepted; after a failure it does not grow at once."""
    factor = SAFETY * (TAIL / max(found.tail, 1e-300)) ** (1.0 / STAGES)
    most = GROW_FAST if found.tail < FAR_BELOW * TAIL else GROW
    clock[KEPT_STEP], clock[CONTRACTION], clock[JUMPED] = h, found.contraction, 0.0
    clock[STEP] = h * min(max(factor, SHRINK), most if may_grow else 1.0)


def single_rate(pull: float) -> float:
    """What single precision makes K z err by, over a change of z, from the largest row sum of |K|."""
    return SINGLE_ERROR * pull
