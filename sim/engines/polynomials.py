"""For kernels: a law that is data, the `Pieces` of S, in the place of code for S and its series."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from stickslip.sim.engines.course import by_run
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.lanes import Lane, where
from stickslip.sim.systems.weakening.pieces import MOST, N_TERMS, Pieces

#: Steps of the bisection for the time at which x leaves its piece, and the places that are looked at first.
_BISECTIONS, _LOOKED_AT = 50, 8


@by_run()
class Polynomials(NamedTuple):
    """`Pieces`, filled up to 256 with such as begin at infinity; shape (256,)."""

    start: Any  #: arrays, as the next; of a formula those of `emit`
    low: Any
    high: Any
    centre: Any
    terms: Any  #: by powers, shape (12, 256)

    @classmethod
    def of(cls, pieces: Pieces) -> Polynomials:
        lacking = MOST + 1 - len(pieces.start)
        start, low, high, centre = (np.append(row, np.full(lacking, np.inf)) for row in pieces.places)
        return cls(start, low, high, centre, np.pad(pieces.terms, ((0, lacking), (0, 0))).T.copy())

    def on_lanes(self, x: Lane) -> tuple[Lane, Lane]:
        """S and its derivative, of x >= 0."""
        place, step = x * 0.0, (MOST + 1) // 2
        while step > 0:
            further = place + float(step)
            place = where(x < self.start.gather(further), place, further)
            step //= 2
        step_of = x - self.centre.gather(place)
        value, slope = self.terms.gather(place, (MOST + 1) * (N_TERMS - 1)), x * 0.0
        for power in reversed(range(N_TERMS - 1)):
            slope = slope * step_of + value
            value = value * step_of + self.terms.gather(place, (MOST + 1) * power)
        return value, slope


@inner
def place_of(pieces: Polynomials, x: float) -> int:
    """The number of the piece of x."""
    place, step = 0, (MOST + 1) // 2
    while step > 0:
        if x >= pieces.start[place + step]:
            place += step
        step //= 2
    return place


@inner
def value_of(pieces: Polynomials, x: float) -> float:
    """S of x."""
    place, value = place_of(pieces, x), 0.0
    for power in range(N_TERMS - 1, -1, -1):
        value = value * (x - pieces.centre[place]) + pieces.terms[power, place]
    return value


@inner
def begin_series(pieces: Polynomials, x0: Floats, series: Floats) -> None:
    """Put the coefficient of S by the m-th power of x - x0 into row m of `series`, where k = 0."""
    for i in range(len(x0)):
        place = place_of(pieces, x0[i])
        step = x0[i] - pieces.centre[place]
        for m in range(N_TERMS):
            series[m, 0, i] = pieces.terms[m, place]
        for m in range(N_TERMS - 1):  # Taylor's shift
            for power in range(N_TERMS - 2, m - 1, -1):
                series[power, 0, i] += step * series[power + 1, 0, i]


@inner
def extend_series(k: int, z: Floats, scale: Floats, series: Floats) -> None:
    """S_k, k >= 1: the sum of these coefficients times those of (x - x0)^m, which stand in row m, m >= 1."""
    n = len(scale)
    for i in range(n):
        series[1, k, i] = scale[i] * (k + 1) * z[k + 1, i]
        series[0, k, i] = series[1, 0, i] * series[1, k, i]
    m = 2
    while m < N_TERMS and m <= k:
        for i in range(n):
            series[m, k, i] = 0.0
        j = 1
        while j <= k - m + 1:
            for i in range(n):
                series[m, k, i] += series[1, j, i] * series[m - 1, k - j, i]
            j += 1
        for i in range(n):
            series[0, k, i] += series[m, 0, i] * series[m, k, i]
        m += 1


@inner
def left_at(pieces: Polynomials, series: Floats, scale: float, x0: float, i: int, order: int, h: float) -> float:
    """The first time, at most h, at which x of a block leaves what its polynomial holds for."""
    place, reach, power = place_of(pieces, x0), 0.0, 1.0
    for k in range(1, order):
        power *= h
        reach += abs(scale * (k + 1) * series[k + 1, i]) * power
    low, high = pieces.low[place], pieces.high[place]
    if x0 + reach <= high and x0 - reach >= low:
        return h
    part = h / _LOOKED_AT
    last, now = x0, x0
    for k in range(_LOOKED_AT):
        before, after = k * part, (k + 1) * part
        x = _at(series, scale, x0, i, order, after)
        if low <= x <= high and (now - last) * (x - now) < 0.0:  # it turned, about where a parabola does
            before, turn = before - part, before + 0.5 * part * (last - x) / (last - 2.0 * now + x)
            last, now, x = now, x, _at(series, scale, x0, i, order, turn)
            after = turn
        else:
            last, now = now, x
        if x > high or x < low:
            for _ in range(_BISECTIONS):
                middle = 0.5 * (before + after)
                x = _at(series, scale, x0, i, order, middle)
                before, after = (before, middle) if x > high or x < low else (middle, after)
            return after
    return h


@inner
def _at(series: Floats, scale: float, x0: float, i: int, order: int, s: float) -> float:
    """x of a block at a time s into its series."""
    x = 0.0
    for k in range(order - 1, 0, -1):
        x = (x + (k + 1) * series[k + 1, i]) * s
    return x0 + scale * x
