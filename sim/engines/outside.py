"""Forces from outside, and belts whose speeds change, as the engines take them: piece by piece, by series or values.

Between the times at which a force or a speed has a bend, a *piece*, every belt has a speed v + a s, s from the start
of the piece. With y = z - a s^2 / 2 the belts keep to v, and what the engines follow is

    y'' + R y' + (N y') + K y + mu lambda = g(s),    g = f - a - (R + N) a s - K a s^2 / 2,    lambda in Sign(y' - v),

f the force from outside: g is a polynomial and harmonics. What friction holds, F = R v + K y + N y' - g, is the same
in both frames. A piece is cut where y and z would be far apart.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from stickslip.sim.arguments import Floats
from stickslip.sim.drive import Harmonic, Piecewise
from stickslip.sim.engines.arithmetic import ROUNDING
from stickslip.sim.engines.compile import inner
from stickslip.sim.system import System

#: What rounding does to a time or a phase, over what it does to a sum.
_OF_PHASE = np.finfo(np.float64).eps / ROUNDING
#: How far y and z may be apart, over what a belt moves in the shortest time scale.
_APART = 100.0


class Outside(NamedTuple):
    """g of the present piece: sum_p poly_p s^p + sum_m amplitude_m cos(frequency_m t + phase_m), in place."""

    poly: Floats  #: shape (3, n)
    start: Floats  #: of the piece, shape (1,)
    amplitude: Floats  #: shape (m, n), as the next
    frequency: Floats
    phase: Floats
    waves: Floats  #: room for the coefficients of the harmonics, shape (2 m, n)
    noise: Floats  #: the sizes of what each coefficient is summed up from, by order as a series, shape (orders, n)


@inner
def begin(outside, t):  # type: ignore[no-untyped-def]
    """Prepare the coefficients about the time t."""
    if outside is None:
        return
    amplitude, frequency, phase, waves = outside.amplitude, outside.frequency, outside.phase, outside.waves
    m = len(amplitude)
    for j in range(m):
        for i in range(amplitude.shape[1]):
            angle = frequency[j, i] * t + phase[j, i]
            waves[j, i] = amplitude[j, i] * math.cos(angle)
            waves[m + j, i] = amplitude[j, i] * math.sin(angle)


@inner
def take_off(outside, t, k, forces):  # type: ignore[no-untyped-def]
    """Take the k-th coefficient of g about t off the k-th of K z, both shape (n,); k counts up from 0 after `begin`.

    Returns the largest coefficient.
    """
    if outside is None:
        return 0.0
    poly, waves, noise = outside.poly, outside.waves, outside.noise[k]
    frequency, phase = outside.frequency, outside.phase
    s, m, most = t - outside.start[0], len(frequency), 0.0
    for i in range(len(forces)):
        value, size = 0.0, 0.0
        if k < 3:
            for p in range(k, 3):
                factor = (2.0 if k == 1 and p == 2 else 1.0) * poly[p, i]
                term = factor * s ** (p - k)
                value += term
                size += abs(term)
                if p > k:
                    size += _OF_PHASE * abs((p - k) * factor * s ** (p - k - 1) * t)
        for j in range(m):
            cosine, sine = waves[j, i], waves[m + j, i]
            value += cosine
            size += (abs(cosine) + abs(sine)) * (1.0 + _OF_PHASE * abs(frequency[j, i] * t + phase[j, i]))
            factor = frequency[j, i] / (k + 1)
            waves[j, i], waves[m + j, i] = -sine * factor, cosine * factor
        forces[i] -= value
        noise[i] = size
        most = max(most, abs(value))
    return most


@inner
def may_change(outside, t, h):  # type: ignore[no-untyped-def]
    """Bounds what g changes by from t to t + h."""
    if outside is None:
        return 0.0
    poly, amplitude, frequency = outside.poly, outside.amplitude, outside.frequency
    s, most = t - outside.start[0], 0.0
    for i in range(poly.shape[1]):
        change = abs(poly[1, i] + 2.0 * s * poly[2, i]) * h + abs(poly[2, i]) * h * h
        for j in range(len(amplitude)):
            change += abs(amplitude[j, i]) * min(2.0, abs(frequency[j, i]) * h)
        most = max(most, change)
    return most


@inner
def value_at(outside, t, values):  # type: ignore[no-untyped-def]
    """g at the time t, shape (n,)."""
    if outside is None:
        return
    poly, amplitude, frequency, phase = outside.poly, outside.amplitude, outside.frequency, outside.phase
    s = t - outside.start[0]
    for i in range(len(values)):
        value = poly[0, i] + s * (poly[1, i] + s * poly[2, i])
        for j in range(len(amplitude)):
            value += amplitude[j, i] * math.cos(frequency[j, i] * t + phase[j, i])
        values[i] = value


class Drive:
    """The pieces of a run, and what kernels read of the present one.

    Attributes
    ----------
    belt_speed : float64, shape (n,)
        v of the present piece, as `outside` kept in place.
    outside : Outside or None
        None if there is no force from outside, and no belt changes its speed.
    t_end : float
        Of the present piece.
    is_last : bool
    fastest : float
        The largest frequency of a force.
    """

    def __init__(self, system: System, t_start: float, t_end: float, orders: int) -> None:
        n = system.n
        self._system, self._moves = system, isinstance(system.belt_speed, Piecewise)
        self.belt_speed = np.empty(n)
        self.belt_speed[:] = system.belt_speed.at(t_start) if self._moves else system.belt_speed
        self._gains, self._is_carried = np.zeros(n), False
        self.outside: Any = None
        self.fastest, self.t_end, self.is_last = 0.0, t_end, True
        if not (self._moves or system.force):
            return
        self._bends = [term for term in system.force if isinstance(term, Piecewise)]
        waves = [term for term in system.force if isinstance(term, Harmonic)]
        amplitude, frequency, phase = (
            np.array([getattr(wave, name) for wave in waves]).reshape(len(waves), n)
            for name in ("amplitude", "frequency", "phase")
        )
        room = np.zeros((3, n)), np.array([t_start]), np.zeros((2 * len(waves), n)), np.zeros((orders, n))
        self.outside = Outside(*room[:2], amplitude, frequency, phase, *room[2:])
        self.fastest = max((float(np.abs(w.frequency[w.amplitude != 0.0]).max()) for w in waves), default=0.0)
        knots = [term.times for term in (*self._bends, *((system.belt_speed,) if self._moves else ()))]
        inside = np.unique(np.concatenate(knots)) if knots else np.empty(0)
        self._ends = self._cut(t_start, [*inside[(inside > t_start) & (inside < t_end)], t_end])
        self.t_end, self.is_last = next(self._ends)
        self._enter(t_start)

    def value(self) -> Floats:
        """g at the start of the present piece, shape (n,)."""
        s = self.outside
        return s.poly[0] + (s.amplitude * np.cos(s.frequency * s.start[0] + s.phase)).sum(axis=0)

    def go_on(self, z: Floats, w: Floats) -> None:
        """To the next piece, from a state at the end of this one, which is put into its frame in place."""
        t, u = self.t_end, w - self.belt_speed
        z[:] = self.of_user(t, z, w)[0]
        self.t_end, self.is_last = next(self._ends)
        self._enter(t)
        w[:] = self.belt_speed + u

    def of_user(self, t: float | Floats, z: Floats, w: Floats) -> tuple[Floats, Floats]:
        """The user's z and w from those of the present piece, shape (n,) at a time, (m, n) at m times.

        A block that sticks has its belt's speed at that time to the last bit.
        """
        if not self._is_carried:
            return z, w
        s = np.expand_dims(t - self.outside.start[0], -1)
        return z + 0.5 * s * s * self._gains, self._system.belt_speed_at(t) + (w - self.belt_speed)

    def place_stills(self, stills: Floats) -> None:
        """Put sums of z, the second row, at the times of the first, into the user's frame in place."""
        if self._is_carried:
            stills[1] += 0.5 * (stills[0] - self.outside.start[0]) ** 2 * self._gains.sum()

    def _enter(self, t: float) -> None:
        system, outside = self._system, self.outside
        outside.start[0] = t
        outside.poly[:] = 0.0
        for term in self._bends:
            outside.poly[0] += term.at(t)
            outside.poly[1] += term.slope_at(t)
        if self._moves:
            gains = self._gains = system.belt_speed.slope_at(t)
            self._is_carried = bool(gains.any())
            self.belt_speed[:] = system.belt_speed.at(t)
            cross = 0.0 if system.cross_damping is None else system.cross_damping @ gains
            outside.poly[0] -= gains
            outside.poly[1] -= system.damping * gains + cross
            outside.poly[2] -= 0.5 * (system.stiffness @ gains)

    def _cut(self, start: float, ends: list[float]) -> Iterator[tuple[float, bool]]:
        """The ends of pieces that are short enough, and whether each is the last."""
        rate = float(self._system.rates.max())
        for k, end in enumerate(ends):
            parts = 1
            if self._moves and rate > 0 and end > start:
                speeds = self._system.belt_speed
                gain = float(np.abs(speeds.slope_at(start)).max())
                speed = float(np.abs(speeds.at([start, end])).max())
                if gain > 0:
                    parts = max(1, math.ceil((end - start) / math.sqrt(2 * _APART * speed / (rate * gain))))
            for part in range(1, parts):
                yield start + (end - start) * (part / parts), False
            yield end, k == len(ends) - 1
            start = end
