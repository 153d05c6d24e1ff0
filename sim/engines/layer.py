"""Who sticks under the smoothed law, and when that changes: events in a step, by the layer |w - v| < band around v.

`stickslip.sim.engines.sigmoid` says what the two definitions of sticking are. On a step w - v and F are cubics.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.arguments import Floats
from stickslip.sim.engines.compile import inner
from stickslip.sim.engines.loop import Law
from stickslip.sim.engines.roots import insert_roots
from stickslip.sim.engines.sticking import mode_of
from stickslip.sim.system import Columns

#: A step this many times longer than the relaxation time delta / mu of the layer does not resolve it.
UNRESOLVED = 2.0
#: Places on the bounds of its bands that a block can pass in a step: five cubics, and one at the start.
PASSES = 16


class Smooth(NamedTuple):
    """The smoothed law of a system, and how closely and how far it is followed."""

    law: Law
    delta: Floats
    springs: Floats  #: K_ii, or 0 if that is negative
    cross: Columns  #: N
    rough: float  #: what K in float32 may cost, over the largest number that it is multiplied with
    longest: float  #: step
    rtol: float
    atol: float
    t_end: float


class Point(NamedTuple):
    """Where the blocks are at one instant, and what pulls them: K z + N w, and its rate."""

    z: Floats
    w: Floats
    rate: Floats  #: w'
    force: Floats
    force_rate: Floats


class Sticking(NamedTuple):
    """Definitions of sticking, a row each, the run's own first: |w - v| < band and, or not, |F| < mu."""

    bands: Floats
    by_force: NDArray[np.bool_]
    modes: NDArray[np.int8]
    calm: NDArray[np.bool_]  #: room to work in: blocks whose mode does not change in a step
    slope0: Floats  #: h w' at both ends of a step, cut where w - v is known to be monotone
    slope1: Floats


@inner
def _marks(y0, d0, y1, d1, bound, marks, n_marks, poly, where):  # type: ignore[no-untyped-def]
    """Add the places in (0, 1] where a cubic, given by values and slopes at both ends, passes a bound."""
    start, end = y0 - bound, y1 - bound
    # Bernstein coefficients: no change of sign, no root
    second, third = start + d0 / 3.0, end - d1 / 3.0
    if (start > 0.0 and second > 0.0 and third > 0.0 and end > 0.0) or (
        start < 0.0 and second < 0.0 and third < 0.0 and end < 0.0
    ):
        return n_marks
    poly[0] = start
    poly[1] = d0
    poly[2] = 3.0 * (end - start) - 2.0 * d0 - d1
    poly[3] = 2.0 * (start - end) + d0 + d1
    return insert_roots(poly, 3, marks, n_marks, where)


@inner
def between(y0, d0, y1, d1, x):  # type: ignore[no-untyped-def]
    """Value at x in [0, 1] of the cubic given by values and slopes at both ends."""
    y = 1.0 - x
    return y * y * ((1.0 + 2.0 * x) * y0 + x * d0) + x * x * ((1.0 + 2.0 * y) * y1 - y * d1)


@inner
def _slopes(y0, d0, y1, d1, is_monotone):  # type: ignore[no-untyped-def]
    """End slopes of a cubic, cut to [0, 3] times its mean slope where it is known to be monotone.

    The bound under which a cubic cannot overshoot: F. N. Fritsch and R. E. Carlson, SIAM Journal on Numerical
    Analysis 17 (1980) 238-246, doi:10.1137/0717021.
    """
    mean = y1 - y0
    low, high = min(0.0, 3.0 * mean), max(0.0, 3.0 * mean)
    cut0 = d0 if d0 > low else low
    cut1 = d1 if d1 > low else low
    cut0 = cut0 if cut0 < high else high
    cut1 = cut1 if cut1 < high else high
    return (cut0, cut1) if is_monotone else (d0, d1)


@inner
def _side(y0, d0, y1, d1, bound):  # type: ignore[no-untyped-def]
    """Side of (-bound, bound) to which a cubic keeps, by the hull of its Bernstein coefficients.

    +1 above, -1 below, 0 inside, 2 if that cannot be said; without branches, so that a loop is vectorised.
    """
    second, third = y0 + d0 / 3.0, y1 - d1 / 3.0
    above = (y0 >= bound) & (second >= bound) & (third >= bound) & (y1 >= bound)
    below = (y0 <= -bound) & (second <= -bound) & (third <= -bound) & (y1 <= -bound)
    inside = (abs(y0) < bound) & (abs(second) < bound) & (abs(third) < bound) & (abs(y1) < bound)
    return 1 if above else (-1 if below else (0 if inside else 2))


@inner
def step_events(smooth, sticking, d, h, now, new, t, t_next, events, n_recorded):  # type: ignore[no-untyped-def]
    """Record all changes of mode by definition d in a step from t to t_next, block by block.

    Returns the number of events recorded in all. The modes by this definition are brought up to date, and the slopes
    of `sticking` are the end slopes of w in the step.

    w - v and F are cubics on the step. Every place where one of them passes a bound is found; between two such
    places the mode is constant.
    """
    damping, friction, v, delta = smooth.law.damping, smooth.law.friction, smooth.law.belt_speed, smooth.delta
    band, by_force, mode = sticking.bands[d], sticking.by_force[d], sticking.modes[d]
    calm, slope0, slope1 = sticking.calm, sticking.slope0, sticking.slope1
    w, rate, force, force_rate = now.w, now.rate, now.force, now.force_rate
    new_w, new_rate, new_force, new_force_rate = new.w, new.rate, new.force, new.force_rate
    n = len(w)
    for i in range(n):
        drag = damping[i] * v
        wide = band[i] if friction[i] > 0.0 else 0.0
        # A step that touches the layer without resolving it relaxes in it, monotone; its end slopes are off by what
        # the stiffness makes of the error of w, and would carry the cubic out of the layer and back.
        gap0, gap1 = w[i] - v, new_w[i] - v
        relaxes = (min(abs(gap0), abs(gap1)) < wide) & (h * friction[i] > UNRESOLVED * delta[i])
        slope0[i], slope1[i] = _slopes(gap0, h * rate[i], gap1, h * new_rate[i], relaxes)
        by_speed = _side(gap0, slope0[i], gap1, slope1[i], wide)
        pull, new_pull = h * force_rate[i], h * new_force_rate[i]
        held = _side(drag + force[i], pull, drag + new_force[i], new_pull, friction[i])
        calm[i] = (by_speed == mode[i]) & ((by_speed != 0) | (held == 0) | (not by_force))
    poly, where, marks = np.empty(4), np.empty(3), np.empty(PASSES)
    for i in range(n):
        if calm[i]:
            continue
        gap0, gap1 = w[i] - v, new_w[i] - v
        rate0, rate1 = slope0[i], slope1[i]
        force0, force1 = damping[i] * v + force[i], damping[i] * v + new_force[i]
        pull0, pull1 = h * force_rate[i], h * new_force_rate[i]
        n_marks = _marks(gap0, rate0, gap1, rate1, 0.0, marks, np.int64(0), poly, where)
        if friction[i] > 0.0:
            for sign in (-1.0, 1.0):
                n_marks = _marks(gap0, rate0, gap1, rate1, sign * band[i], marks, n_marks, poly, where)
                if by_force:
                    bound = sign * friction[i]
                    n_marks = _marks(force0, pull0, force1, pull1, bound, marks, n_marks, poly, where)
        for k in range(n_marks + 1):
            left = marks[k - 1] if k > 0 else 0.0
            right = marks[k] if k < n_marks else 1.0
            if right <= left:
                continue
            middle = 0.5 * (left + right)
            gap = between(gap0, rate0, gap1, rate1, middle)
            pull = between(force0, pull0, force1, pull1, middle)
            after = mode_of(gap, pull, friction[i], band[i], by_force)
            if after != mode[i]:
                events.t[n_recorded] = min(t + h * left, t_next)  # rounding may pass the end of the run
                events.block[n_recorded] = d * n + i
                events.mode[n_recorded] = after
                mode[i] = after
                n_recorded += 1
    return n_recorded
