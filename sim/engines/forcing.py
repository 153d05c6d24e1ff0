"""External forces, and belts whose speeds change, as the engines take them: piece by piece, as series or values.

A *piece* of a run lies between two times at which a force or a belt speed has a bend. Every belt then has a speed v +
a s, s from the start of the piece. With y = z - a s^2 / 2 its belt has the constant speed v, and the engines solve

    y'' + R y' + (N y') + K y + mu lambda = g(s),    lambda in Sign(y' - v),
    g = f - a - (R + N) a s - K a s^2 / 2,

f the external force: g is a polynomial plus harmonics. The force on friction, F = R v + K y + N y' - g, is the same
in both frames. A piece is divided where y and z would be far apart.

The clock of every engine is s: the rounding of a time depends on its distance from the start of its piece, not from
t = 0. An instant at a bend belongs to the piece that begins there, so a run that ends at one has a last piece of no
length.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.arithmetic import ROUNDING
from stickslip.sim.systems.drive import Harmonic, Piecewise
from stickslip.sim.systems.system import System

#: The rounding of a time or a phase, over that of a sum.
_OF_PHASE = np.finfo(np.float64).eps / ROUNDING
#: The largest distance of y and z, over the travel of a belt in the shortest time scale. Chosen; no measurement.
_APART = 100.0


#: Pieces that are worked out at once: of a measured series, NumPy's calls for each would take most of a run.
_AT_ONCE = 256

_NOTHING = np.empty((0, 0))


class Piece(NamedTuple):
    """One piece: where it ends, whether it is the last, and at its start the values and slopes, shape (n,) each."""

    end: float
    is_last: bool
    force: Floats
    force_slope: Floats
    speed: Floats
    gain: Floats


#: What is one piece, in which nothing changes.
_WHOLE = Piece(0.0, True, *[_NOTHING] * 4)


class Forcing(NamedTuple):
    """g of the present piece, sum_p poly_p s^p + sum_m amplitude_m cos(frequency_m s + phase_m); changed in place."""

    poly: Floats  #: shape (3, n)
    amplitude: Floats  #: shape (m, n), as the next
    frequency: Floats
    phase: Floats  #: at the start of the piece
    waves: Floats  #: the coefficients of the harmonics, shape (2 m, n)
    noise: Floats  #: sums of the magnitudes of the terms of each coefficient, by order, shape (orders, n)

    @classmethod
    def none(cls, *several: int) -> Forcing:
        """No force, on so many runs: arrays of no length, and not None, for which kernels would be compiled again."""
        return cls(*[np.empty((*several, 0, 0))] * 6)


@inner
def acts(forcing: Forcing) -> bool:
    """Whether there is a force."""
    return len(forcing.poly) > 0


@inner
def begin(forcing: Forcing, s: float) -> None:
    """Prepare the coefficients of the series about the time s."""
    amplitude, frequency, phase, waves = forcing.amplitude, forcing.frequency, forcing.phase, forcing.waves
    m = len(amplitude)
    for j in range(m):
        for i in range(amplitude.shape[1]):
            angle = frequency[j, i] * s + phase[j, i]
            waves[j, i] = amplitude[j, i] * math.cos(angle)
            waves[m + j, i] = amplitude[j, i] * math.sin(angle)


@inner
def take_off(forcing: Forcing, s: float, k: int, forces: Floats) -> float:
    """Subtract the k-th coefficient of g about s from that of K z, both shape (n,); k counts up from 0 after `begin`.

    Returns the largest coefficient.
    """
    if not acts(forcing):
        return 0.0
    poly, waves, noise = forcing.poly, forcing.waves, forcing.noise[k]
    frequency, phase = forcing.frequency, forcing.phase
    m, most = len(frequency), 0.0
    for i in range(len(forces)):
        value, size = 0.0, 0.0
        if k < 3:
            for p in range(k, 3):
                factor = (2.0 if k == 1 and p == 2 else 1.0) * poly[p, i]
                term = factor * s ** (p - k)
                value += term
                size += abs(term) * (1.0 + _OF_PHASE * (p - k))
        for j in range(m):
            cosine, sine = waves[j, i], waves[m + j, i]
            value += cosine
            size += (abs(cosine) + abs(sine)) * (1.0 + _OF_PHASE * abs(frequency[j, i] * s + phase[j, i]))
            factor = frequency[j, i] / (k + 1)
            waves[j, i], waves[m + j, i] = -sine * factor, cosine * factor
        forces[i] -= value
        noise[i] = size
        most = max(most, abs(value))
    return most


@inner
def may_change(forcing: Forcing, s: float, h: float) -> float:
    """A bound of the change of g from s to s + h."""
    poly, amplitude, frequency, most = forcing.poly, forcing.amplitude, forcing.frequency, 0.0
    for i in range(poly.shape[1]):
        change = abs(poly[1, i] + 2.0 * s * poly[2, i]) * h + abs(poly[2, i]) * h * h
        for j in range(len(amplitude)):
            change += abs(amplitude[j, i]) * min(2.0, abs(frequency[j, i]) * h)
        most = max(most, change)
    return most


@inner
def value_at(forcing: Forcing, s: float, values: Floats) -> None:
    """g at the time s, shape (n,), of a force that acts."""
    poly, amplitude, frequency, phase = forcing.poly, forcing.amplitude, forcing.frequency, forcing.phase
    for i in range(len(values)):
        value = poly[0, i] + s * (poly[1, i] + s * poly[2, i])
        for j in range(len(amplitude)):
            value += amplitude[j, i] * math.cos(frequency[j, i] * s + phase[j, i])
        values[i] = value


class Drive:
    """External forces and belts of a run: its pieces, and what kernels read of the present one.

    Attributes
    ----------
    belt_speed : float64, shape (n,)
        v of the present piece; changed in place, as `forcing` is.
    forcing : Forcing
        None acts if there is no external force, and no belt changes its speed; see `is_forced`.
    start, end, length : float
        Of the present piece.
    is_last, is_instant : bool
        An instant is the last piece of a run that ends at a bend; its events depend on what comes after.
    ahead, instant : float
        The time from there to the next bend, and the rounding of the end.
    fastest : float
        The largest frequency of a force.
    """

    forcing = Forcing.none()
    fastest, is_instant, ahead, instant = 0.0, False, 0.0, 0.0
    _gains, _is_carried = _NOTHING, False

    def __init__(self, system: System, t_start: float, t_end: float, orders: int) -> None:
        self._system, self._starts, self._ends = system, list[float](), list[float]()
        self._moves = isinstance(system.belt_speed, Piecewise)
        if not (self._moves or system.force):
            self.belt_speed, self._next = system.belt_at_zero, iter([_WHOLE._replace(end=t_end)])
            self._enter(t_start)
            return
        n, self.belt_speed = system.n, np.array(system.belt_speed_at(t_start))
        self._bends = [term for term in system.force if isinstance(term, Piecewise)]
        self._waves = [term for term in system.force if isinstance(term, Harmonic)]
        amplitude, frequency = (
            np.array([getattr(wave, name) for wave in self._waves]).reshape(-1, n)
            for name in ("amplitude", "frequency")
        )
        m = len(self._waves)
        self.forcing = Forcing(
            np.zeros((3, n)), amplitude, frequency, np.zeros((m, n)), np.zeros((2 * m, n)), np.zeros((orders, n))
        )
        self.fastest = max((float(np.abs(w.frequency[w.amplitude != 0.0]).max()) for w in self._waves), default=0.0)
        changing = [term for term in self._bends if not term.is_constant]
        knots = [term.times for term in (*changing, *((system.belt_speed,) if self._moves else ()))]
        inside = self._knots = np.unique(np.concatenate(knots)) if knots else np.empty(0)
        self._next = self._pieces(t_start, np.append(inside[(inside > t_start) & (inside <= t_end)], t_end))
        self._enter(t_start)

    @property
    def is_forced(self) -> bool:
        """Whether a force acts."""
        return len(self.forcing.poly) > 0

    @property
    def is_steady(self) -> bool:
        """Whether belts and forces are constant from the start of the present piece to the end of the run."""
        forcing = self.forcing
        return self.is_last and not (self._is_carried or forcing.poly[1:].any() or forcing.amplitude.any())

    def value(self) -> Floats:
        """g at the start of the present piece, shape (n,)."""
        forcing = self.forcing
        return forcing.poly[0] + (forcing.amplitude * np.cos(forcing.phase)).sum(axis=0)

    def go_on(self, z: Floats, w: Floats) -> None:
        """Go on to the next piece; the state, at the end of this one, is put into its frame in place."""
        u = w - self.belt_speed
        if self._is_carried:
            z[:] = self._place(self.end, z)
        self._enter(self.end)
        w[:] = self.belt_speed + u

    def of_user(self, t: float | Floats, z: Floats, w: Floats) -> tuple[Floats, Floats]:
        """The user's z and w from those of the present piece, shape (n,) at a time, (m, n) at m times.

        A block that sticks has its belt's speed at that time to the last bit.
        """
        if not self._is_carried:
            return z, w
        return self._place(t, z), self._system.belt_speed_at(t) + (w - self.belt_speed)

    def _place(self, t: float | Floats, z: Floats) -> Floats:
        """The user's z, of a piece in which belts change their speed."""
        s = np.expand_dims(t - self.start, -1)
        place: Floats = z + 0.5 * s * s * self._gains
        return place

    def place_all_stuck(self, all_stuck: Floats) -> None:
        """Put sums of z, the second row, at the times in the first, from the frame of the piece into the user's."""
        if not all_stuck.size:
            return
        if self._is_carried:
            all_stuck[1] += 0.5 * all_stuck[0] ** 2 * self._gains.sum()
        all_stuck[0] = times(self.start, self.end, all_stuck[0])

    def time(self, s: float) -> float:
        """The time at s of the present piece."""
        return self.end if s >= self.length else min(self.start + s, self.end)

    def times(self, counts: list[int], s: Floats) -> Floats:
        """As `time`, for s in all pieces so far, with `counts` of them in each."""
        if len(counts) == 1:
            return times(self.start, self.end, s)
        return times(np.repeat(self._starts, counts), np.repeat(self._ends, counts), s)

    def _enter(self, t: float) -> None:
        """Enter the next piece, which begins at t."""
        system, forcing = self._system, self.forcing
        self.start = t
        piece = next(self._next)
        self.end, self.is_last = piece.end, piece.is_last
        self.length = self.end - t
        if self._ends and t == self.end:
            self.is_instant, self.instant = True, 0.25 * float(np.spacing(abs(t)))
            self.ahead = float(np.append(self._knots[self._knots > t], np.inf)[0]) - t
        if self.is_forced:
            forcing.poly[0], forcing.poly[1], forcing.poly[2] = piece.force, piece.force_slope, 0.0
            for phase, wave in zip(forcing.phase, self._waves, strict=True):
                phase[:] = wave.phase_at(t)
            if self._moves:
                gains = self._gains = piece.gain
                self._is_carried = bool(gains.any())
                self.belt_speed[:] = piece.speed
                cross = 0.0 if system.cross_damping is None else system.cross_damping @ gains
                forcing.poly[0] -= gains
                forcing.poly[1] -= system.damping * gains + cross
                forcing.poly[2] -= 0.5 * (system.stiffness @ gains)
        self._starts.append(t)
        self._ends.append(self.end)

    def _pieces(self, start: float, ends: Floats) -> Iterator[Piece]:
        """The pieces from a time on between bends, each divided where it would be too long."""
        for first in range(0, len(ends), _AT_ONCE):
            bends = np.append(start if first == 0 else ends[first - 1], ends[first : first + _AT_ONCE])
            cuts = self._cut(bends)
            force, force_slope = np.zeros((len(cuts) - 1, self._system.n)), np.zeros((len(cuts) - 1, self._system.n))
            for term in self._bends:
                force += term.at(cuts[:-1])
                force_slope += term.slope_at(cuts[:-1])
            speed = gain = np.empty((len(cuts) - 1, 0))
            if self._moves:
                speeds = self._system.belt_speed
                speed, gain = speeds.at(cuts[:-1]), speeds.slope_at(cuts[:-1])
            is_last = first + _AT_ONCE >= len(ends)
            for k, end in enumerate(cuts[1:].tolist()):
                yield Piece(end, is_last and k == len(cuts) - 2, force[k], force_slope[k], speed[k], gain[k])

    def _cut(self, bends: Floats) -> Floats:
        """Ends of pieces: bends, and between them places where belts would be carried too far."""
        rate, lengths = self._system.fastest_rate, np.diff(bends)
        if not (self._moves and rate > 0):
            return bends
        speeds = self._system.belt_speed
        gains = np.abs(speeds.slope_at(bends[:-1])).max(axis=1)
        sizes = np.abs(speeds.at(bends)).max(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            longest = np.sqrt(2 * _APART * np.maximum(sizes[:-1], sizes[1:]) / (rate * gains))
            parts = np.where((gains > 0) & (lengths > 0), np.ceil(lengths / longest), 1.0).astype(np.int64).tolist()
        cuts = bends[:1].tolist()
        for part, start, end in zip(parts, bends[:-1].tolist(), bends[1:].tolist(), strict=True):
            cuts += [start + (end - start) * (k / part) for k in range(1, part)]
            cuts.append(end)
        return np.array(cuts)


def times(start: float | Floats, end: float | Floats, s: float | Floats) -> Floats:
    """The times at s of pieces with these bounds, which are the user's to the last bit."""
    if isinstance(start, float) and start == 0.0:
        return np.asarray(s)
    return np.where(s >= end - start, end, np.minimum(start + s, end))
