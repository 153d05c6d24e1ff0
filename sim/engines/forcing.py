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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines.contract import Task
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats, Ints
from stickslip.sim.numerics.arithmetic import ROUNDING, largest
from stickslip.sim.systems.drive import Harmonic, Piecewise

#: The rounding of a time or a phase, over that of a sum.
_OF_PHASE = np.finfo(np.float64).eps / ROUNDING
#: The largest distance of y and z, over the travel of a belt in the shortest time scale. Chosen; no measurement.
_APART = 100.0


#: Pieces that are worked out at once, and how many numbers of theirs: of a small system a call of a kernel takes as
#: long as some twenty steps.
_AT_ONCE, _ROOM = 1024, 2**20

#: Rows of the table of a piece: beside g the belts' v and a, R v + N v, and by how much a differs from that of the
#: piece before; then the phases of the harmonics at its start.
BELT, GAIN, DRAG, JUMP, PHASE = range(3, 8)


class Pieces(NamedTuple):
    """The pieces that a kernel goes through, in order of time; the last of them are ahead."""

    bounds: Floats  #: start, end and length of each, shape (3, k); see `Drive.instant`
    tables: Floats  #: shape (k, 8 + m, n)
    counts: Ints  #: of events, and of ends of all-stuck intervals, that are recorded in each, shape (k, 2)
    n_ahead: Ints  #: how many are ahead, shape (1,)
    samples: Floats  #: the times of all samples of the run


class Forcing(NamedTuple):
    """g of the present piece, sum_p poly_p s^p + sum_m amplitude_m cos(frequency_m s + phase_m); changed in place."""

    poly: Floats  #: shape (3, n)
    amplitude: Floats  #: shape (m, n), as the next
    frequency: Floats
    phase: Floats  #: at the start of the piece
    waves: Floats  #: the coefficients of the harmonics, shape (2 m, n)
    noise: Floats  #: sums of the magnitudes of the terms of each coefficient, by order, shape (orders, n)
    table: Floats  #: of the present piece; poly and phase are rows of it
    pieces: Pieces

    @classmethod
    def none(cls, *several: int) -> Forcing:
        """No force, on so many runs: arrays of no length, and not None, for which kernels would be compiled again."""
        row, table, tables = (np.empty((*several, *[0] * ndim)) for ndim in (1, 2, 3))
        pieces = Pieces(table, tables, table.astype(np.int64), np.zeros((*several, 1), np.int64), row)
        return cls(table, table, table, table, table, table, table, pieces)


@inner
def acts(forcing: Forcing) -> bool:
    """Whether there is a force."""
    return len(forcing.poly) > 0


@inner
def begin(forcing: Forcing, s: float) -> None:
    """Prepare the coefficients of the series about the time s."""
    amplitude, frequency, phase, waves = forcing.amplitude, forcing.frequency, forcing.phase, forcing.waves
    m = len(amplitude)
    known, cosine, sine = 0.0, 1.0, 0.0
    for j in range(m):
        for i in range(amplitude.shape[1]):
            angle = frequency[j, i] * s + phase[j, i]
            if angle != known:  # most forces push all blocks in phase
                known, cosine, sine = angle, math.cos(angle), math.sin(angle)
            waves[j, i], waves[m + j, i] = amplitude[j, i] * cosine, amplitude[j, i] * sine


@inner
def take_off(forcing: Forcing, s: float, k: int, forces: Floats) -> float:
    """Subtract the k-th coefficient of g about s from that of K z, both shape (n,); k counts up from 0 after `begin`.

    Returns the largest coefficient.
    """
    if not acts(forcing):
        return 0.0
    poly, waves, noise = forcing.poly, forcing.waves, forcing.noise[k]
    frequency, phase, m, n = forcing.frequency, forcing.phase, len(forcing.frequency), len(forces)
    for i in range(n):
        noise[i] = 0.0
    for p in range(k, 3):
        factor = (2.0 if k == 1 and p == 2 else 1.0) * s ** (p - k)
        for i in range(n):
            noise[i] += factor * poly[p, i]
    for j in range(m):
        for i in range(n):
            noise[i] += waves[j, i]
    most = largest(noise)
    for i in range(n):
        forces[i] -= noise[i]
        noise[i] = 0.0
    for p in range(k, 3):
        factor = (2.0 if k == 1 and p == 2 else 1.0) * abs(s) ** (p - k) * (1.0 + _OF_PHASE * (p - k))
        for i in range(n):
            noise[i] += factor * abs(poly[p, i])
    for j in range(m):
        for i in range(n):
            cosine, sine, factor = waves[j, i], waves[m + j, i], frequency[j, i] / (k + 1)
            noise[i] += (abs(cosine) + abs(sine)) * (1.0 + _OF_PHASE * abs(frequency[j, i] * s + phase[j, i]))
            waves[j, i], waves[m + j, i] = -sine * factor, cosine * factor
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
    """External forces and belts of a run: its pieces, and what kernels read and change of the present one."""

    belt_speed: Floats  #: v of the present piece, shape (n,); changed in place, as `forcing` is
    forcing = Forcing.none()  #: none acts if no force does, and no belt changes its speed; see `is_forced`
    is_last: bool  #: whether no piece follows on those that are ahead of the kernel: the last is ahead alone
    #: The rounding of the end, if the last piece has no length but is not the first: its events depend on what comes
    #: after. Else -1.
    instant = -1.0
    fastest = 0.0  #: the largest frequency of a force

    def __init__(self, task: Task, orders: int) -> None:
        system, t_start = task.system, task.t_start
        self._system, self._is_by_steps = system, orders == 0
        self._moves = isinstance(system.belt_speed, Piecewise)
        if not (self._moves or system.force):
            self.belt_speed, self.is_last = system.belt_at_zero, True
            self._bounds = np.array([[t_start], [task.t_end], [task.length]])
            return
        n = system.n
        self._bends = [term for term in system.force if isinstance(term, Piecewise)]
        self._waves = [term for term in system.force if isinstance(term, Harmonic)]
        amplitude, frequency = (
            np.array([getattr(wave, name) for wave in self._waves]).reshape(-1, n)
            for name in ("amplitude", "frequency")
        )
        self.fastest = max((float(np.abs(w.frequency[w.amplitude != 0.0]).max()) for w in self._waves), default=0.0)
        changing = [term for term in self._bends if not term.is_constant]
        knots = [term.times for term in (*changing, *((system.belt_speed,) if self._moves else ()))]
        inside = self._knots = np.unique(np.concatenate(knots)) if knots else np.empty(0)
        ends = np.append(inside[(inside > t_start) & (inside <= task.t_end)], task.t_end)
        m, cuts = len(self._waves), np.array([t_start])
        table = np.zeros((PHASE + m, n))
        most = max(min(_AT_ONCE, _ROOM // table.size), 2) if self._moves or len(ends) > 1 else 1
        if 1 < most >= len(ends):  # few pieces have a short table
            cuts, ends = np.append(cuts, self._cut(np.append(cuts, ends))), ends[:0]
            most = max(min(most, len(cuts) - 2), 2)
        bounds = self._bounds = np.full((3, most), -np.inf)
        tables, counts = np.zeros((most, *table.shape)), np.zeros((most, 2), np.int64)
        pieces = Pieces(bounds, tables, counts, np.zeros(1, np.int64), task.samples.t)
        waves, noise = np.zeros((2 * m, n)), np.zeros((orders, n))
        self.forcing = Forcing(table[:3], amplitude, frequency, table[PHASE:], waves, noise, table, pieces)
        self.belt_speed, self._batches = table[BELT], self._cuts(cuts, ends, most)
        self._over: list[tuple[NDArray[Any], ...]] = []
        self._prepare()
        pieces.n_ahead[0] -= 1
        table[:] = tables[self._place]

    @property
    def is_forced(self) -> bool:
        """Whether a force acts."""
        return len(self.forcing.poly) > 0

    @property
    def is_steady(self) -> bool:
        """Whether belts and forces are constant from the start of the present piece to the end of the run."""
        forcing = self.forcing
        changes = (forcing.poly[1:], forcing.amplitude, forcing.table[GAIN:DRAG])
        return self.is_last and not any(change.any() for change in changes)

    @property
    def _place(self) -> int:
        """Of the present piece among those of the kernel."""
        return self._bounds.shape[1] - 1 - int(self.forcing.pieces.n_ahead[0])

    @property
    def length(self) -> float:
        """Of the present piece."""
        return float(self._bounds[2, self._place])

    def value(self) -> Floats:
        """g at the start of the present piece, shape (n,)."""
        forcing = self.forcing
        return forcing.poly[0] + (forcing.amplitude * np.cos(forcing.phase)).sum(axis=0)

    def go_on(self) -> None:
        """Put the next pieces ahead of the kernel, which has come to the end of those before."""
        self._note()
        self._prepare()

    def of_user(self, t: float | Floats, z: Floats, w: Floats) -> tuple[Floats, Floats]:
        """The user's z and w: shape (n,) at a time in the present piece, (m, n) at m times, after the last `go_on`.

        A block that sticks has its belt's speed at that time to the last bit.
        """
        if not self._moves:
            return z, w
        tables = self.forcing.pieces.tables
        place = self._place if np.ndim(t) == 0 else np.searchsorted(self._bounds[1], t)
        s = np.expand_dims(t - self._bounds[0, place], -1)
        # of a belt that stops, s may be of any size, and a is 0
        return z + 0.5 * s * (s * tables[place, GAIN]), self._system.belt_speed_at(t) + (w - tables[place, BELT])

    def time(self, s: float) -> float:
        """The time at s of the present piece."""
        start, end, length = self._bounds[:, self._place].tolist()
        return end if s >= length else min(start + s, end)

    def of_all(self, s: Floats, all_stuck: Floats) -> tuple[NDArray[np.intp], Floats]:
        """The piece and the time of each event in all pieces so far, from its s, shape (m,).

        Also puts sums of z, the second row of `all_stuck`, at the s in the first, into the user's frame and time.
        """
        if self._bounds.shape[1] == 1:  # one piece, in which no belt changes its speed
            only, last = self._bounds[:2, 0].tolist()
            all_stuck[0] = times(only, last, all_stuck[0])
            return np.zeros(len(s), np.intp), times(only, last, s)
        self._note()
        (start, end, _), gain, counts = (np.concatenate(part, -1) for part in zip(*self._over, strict=True))
        of_event, of_stuck = (np.arange(len(start)).repeat(count) for count in counts)
        all_stuck[1] += 0.5 * all_stuck[0] * (all_stuck[0] * gain[of_stuck])
        all_stuck[0] = times(start[of_stuck], end[of_stuck], all_stuck[0])
        return of_event, times(start[of_event], end[of_event], s)

    def _note(self) -> None:
        """Keep of the pieces of the kernel their bounds, a summed over the blocks, and counts."""
        bounds, tables, counts = self.forcing.pieces[:3]
        self._over.append((bounds.copy(), tables[:, GAIN].sum(axis=1), counts.T.copy()))

    def _prepare(self) -> None:
        """Fill in the next pieces; those of an earlier batch that stay before them have no counts."""
        system, pieces, (bounds, self.is_last) = self._system, self.forcing.pieces, next(self._batches)
        k = pieces.n_ahead[0] = len(bounds) - 1
        pieces.counts[:] = 0
        (start, end, length), tables = pieces.bounds[:, -k:], pieces.tables[-k:]
        start[:], end[:] = bounds[:-1], bounds[1:]
        length[:] = end - start
        if self.is_last and self._over and start[0] == end[0]:
            self.instant = 0.25 * float(np.spacing(abs(end[0])))
            if self._is_by_steps:
                length[0] = np.append(self._knots[self._knots > end[0]], np.inf)[0] - end[0]
        poly, belt, gain = tables[:, :3].swapaxes(0, 1), tables[:, BELT], tables[:, GAIN]
        poly[:] = 0.0
        for term in self._bends:
            poly[0] += term.at(start)
            poly[1] += term.slope_at(start)
        for place, wave in enumerate(self._waves, PHASE):
            tables[:, place] = wave.phase_at(start[:, np.newaxis])
        belt[:] = system.belt_speed_at(start)
        tables[:, DRAG] = self._damped(belt)
        if self._moves:
            gain[:] = system.belt_speed.slope_at(start)
            tables[:, JUMP] = np.diff(gain, axis=0, prepend=self.forcing.table[np.newaxis, GAIN])
            poly[0] -= gain
            poly[1] -= self._damped(gain)
            poly[2] -= 0.5 * (system.stiffness @ gain.T).T

    def _damped(self, speed: Floats) -> Floats:
        """R v + N v for speeds, shape (k, n)."""
        cross = self._system.cross_damping
        drag: Floats = self._system.damping * speed
        return drag if cross is None else drag + (cross @ speed.T).T

    def _cuts(self, cuts: Floats, ends: Floats, most: int) -> Iterator[tuple[Floats, bool]]:
        """Bounds of pieces, at most so many at once, these cuts first; and whether it is the last, alone."""
        while len(ends) or len(cuts) > most + 1:
            if len(cuts) > most + 1:
                yield cuts[: most + 1], False
                cuts = cuts[most:]
            else:
                cuts, ends = np.append(cuts, self._cut(np.append(cuts[-1], ends[:most]))), ends[most:]
        if len(cuts) > 2:
            yield cuts[:-1], False
        yield cuts[-2:], True

    def _cut(self, bends: Floats) -> Floats:
        """Ends of pieces: bends but the first, and between them places where belts would be carried too far."""
        rate, lengths = self._system.fastest_rate, np.diff(bends)
        if not (self._moves and rate > 0):
            return bends[1:]
        speeds = self._system.belt_speed
        gains = np.abs(speeds.slope_at(bends[:-1])).max(axis=1)
        sizes = np.abs(speeds.at(bends)).max(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            longest = np.sqrt(2 * _APART * np.maximum(sizes[:-1], sizes[1:]) / (rate * gains))
            parts = np.where((gains > 0) & (lengths > 0), np.ceil(lengths / longest), 1.0).astype(np.int64)
        first, last, length, part = (np.repeat(x, parts) for x in (bends[:-1], bends[1:], lengths, parts))
        k = np.arange(1, len(part) + 1) - np.repeat(parts.cumsum() - parts, parts)
        return np.where(k == part, last, first + length * (k / part))


def times(start: float | Floats, end: float | Floats, s: float | Floats) -> Floats:
    """The times at s of pieces with these bounds, which are the user's to the last bit."""
    if isinstance(start, float) and start == 0.0:
        return np.asarray(s)
    return np.where(s >= end - start, end, np.minimum(start + s, end))
