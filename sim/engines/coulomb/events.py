"""When a block's mode ends: the first root of its event functions, and the fast exclusion check.

A bound by the sum of |coefficients| excludes most blocks; the others go to `sim.numerics.roots`, which misses no
root.
"""

from __future__ import annotations

import math
from typing import TypeAlias

from stickslip.sim.engines.coulomb.expansion import Expansion
from stickslip.sim.engines.coulomb.model import Model
from stickslip.sim.engines.coulomb.sticking import UNDECIDED_BOTH, push
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.roots import roots

#: Of a block: its mode, zeros and side, as `Expansion` has them; v, R v, static friction and the closed side.
Face: TypeAlias = tuple[int, int, int]
Bounds: TypeAlias = tuple[float, float, float, int]
#: The largest power of a time: a coefficient that is zero is also zero at any distance.
_MOST = 1e300
NEVER = math.inf


@inner
def enclose(series: Floats, slips: Floats, order: int, h: float, reach: Floats, n: int) -> None:
    """Bounds of how far the event functions of n blocks deviate in h from their tangents, from their coefficients.

    F has two orders less than z: it is needed to the accuracy of w', not of w.
    """
    power = min(h * h, _MOST)
    for i in range(n):
        reach[i] = (1.0 - slips[i]) * power * abs(series[2, i])
    for k in range(3, order + 1):
        of_slip, of_stick = k * power, min(power * h, _MOST)
        for i in range(n):
            reach[i] += (slips[i] * of_slip + (1.0 - slips[i]) * of_stick) * abs(series[k, i])
        power = of_stick


@inner
def _excluded(face: Face, first: tuple[float, float, float], bounds: Bounds, h: float, reach: float) -> bool:
    """The fast exclusion check: whether a block's event functions have no root within h.

    `first` has the first three coefficients of its series; the functions deviate by at most `reach` from their
    tangents.
    """
    mode, zeros, side = face
    c0, c1, c2 = first
    v, drag, static, closed = bounds
    if mode != 0:
        gap = mode * (c1 - v)
        return zeros == 0 and min(gap, gap + mode * 2.0 * c2 * h) > reach
    force = drag + c0
    return side == 0 and max(push(closed, force), push(closed, force + c1 * h)) + reach < static


@inner
def _root(
    face: Face, series: Floats, column: int, bounds: Bounds, horizon: tuple[int, float], room: tuple[Floats, Floats]
) -> float:
    """Time to the first root of a block's event functions within h, `NEVER` if there is none; see `_excluded` first.

    Its series is this column; `horizon` has the order and h; `room` is workspace.
    """
    mode, zeros, side = face
    v, drag, static, closed = bounds
    order, h = horizon
    poly, places = room
    if mode != 0:
        degree = order - 1 - zeros
        power = 1.0
        for k in range(degree + 1):
            j = k + zeros
            c = (j + 1) * series[j + 1, column]
            if j == 0:
                c -= v
            poly[k] = mode * c * power
            power = min(power * h, _MOST)
        return h * places[0] if roots(poly, degree, places) > 0 else NEVER
    force = drag + series[0, column]
    first = NEVER
    for sigma in (-1, 1):  # both within h, so that a mirror image has the same bytes
        if sigma == closed:
            continue
        skip = zeros if side in (sigma, UNDECIDED_BOTH) else 0
        degree = order - 2 - skip
        if degree < 1:
            continue
        if skip == 0:
            poly[0] = static + sigma * force
        else:
            poly[0] = sigma * series[skip, column]
        power = h
        for k in range(1, degree + 1):
            poly[k] = sigma * series[k + skip, column] * power
            power = min(power * h, _MOST)
        if poly[0] != 0.0 and roots(poly, degree, places) > 0:
            first = min(first, h * places[0])
    return first


@inner
def next_event(
    model: Model,
    expansion: Expansion,
    i: int,
    face: Face,
    series: Floats,
    column: int,
    reach: float,
    horizon: tuple[int, float],
) -> float:
    """The time to the next event of block i; its series, of which `reach` is known, is that column."""
    first, v = (series[0, column], series[1, column], series[2, column]), model.belt_speed[i]
    bounds = v, model.damping[i] * v, model.static[i], model.closed[i]
    if _excluded(face, first, bounds, horizon[1], reach):
        return NEVER
    return _root(face, series, column, bounds, horizon, (expansion.poly, expansion.places))
