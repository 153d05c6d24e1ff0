"""Blocks that are drawn along by a drive, as a drill string is turned from the top, in the frame of the drive.

A spring k with a dashpot c ties block b to a point that moves as X(t), X' = V + A cos(omega t + phi), X(0) = 0. With
x = V t + z the blocks of m x'' + C x' + K x + mu lambda = f, lambda in Sign(x' - v), obey

    m z'' + (C + c e_b e_b') z' + (K + k e_b e_b') z + mu lambda = f - C 1 V + e_b (k Y + c Y'),

lambda in Sign(z' - (v - V)), where Y = (A / omega) (sin(omega t + phi) - sin phi), if no block is tied to the ground:
K 1 = 0, unless V = 0.

Of a speed U(t) that is linear between times V is the speed of the frame: the last, if U comes to it before the last
time, else the mean of U over its times. Y' has the term U - V, and Y its integral, a parabola between times, which is
joined linearly at more of them: to `_BENT` of its size, or at distances of `_SHORT` of the system's shortest time, by
which Y is off by _SHORT^2 / 8 of what the acceleration U' of the drive stretches the stiffest spring.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from stickslip.sim.numerics.arguments import Floats, number
from stickslip.sim.systems.drive import Harmonic, Piecewise

if TYPE_CHECKING:
    from stickslip.sim.systems.system import System

#: See above.
_BENT, _SHORT = 1e-6, 0.02
#: So many times as long as its times a speed holds before and after.
_FAR = 1e6
#: Rounding of a row of K that sums to zero, relative to the sum of its magnitudes.
_ROUNDING = 1e-12


def driven(
    system: System,
    block: str | int,
    spring: float,
    speed: Any,
    damping: float = 0.0,
    amplitude: float = 0.0,
    frequency: float = 1.0,
    phase: float = 0.0,
) -> System:
    """As `System.driven`."""
    if isinstance(speed, Harmonic):
        raise TypeError(
            f"speed: expected a number or a Piecewise, got {speed!r}; a harmonic part is given by amplitude,"
            " frequency and phase"
        )
    b, k = system.block(block), number("spring", spring, above=0.0)
    course = _varying(speed)
    v = number("speed", speed) if course is None else _frame(course)
    c, omega = number("damping", damping), number("frequency", frequency, above=0.0)
    swing, phi = number("amplitude", amplitude), number("phase", phase)
    ones, tie = np.ones(system.n), np.zeros(system.n)
    tie[b] = 1.0
    _require_free(system, v)
    drag = system.damping_matrix
    drag = drag if drag.ndim == 1 else drag @ ones
    sway = swing / omega
    forces = [*system.force, -v * drag - k * sway * np.sin(phi) * tie]
    if swing:
        forces += [Harmonic(k * sway * tie, omega, phi - 0.5 * np.pi), Harmonic(c * swing * tie, omega, phi)]
    if course is not None:
        times, ahead = _ahead(course, v, system.fastest_rate)
        forces.append(Piecewise(times, np.multiply.outer(k * ahead + c * (course.at(times) - v), tie)))
    belt = system.belt_speed
    return system.changed(
        stiffness=_plus(system.stiffness, k * tie),
        damping=_plus(system.damping_matrix, c * tie),
        belt_speed=Piecewise(belt.times, belt.values - v) if isinstance(belt, Piecewise) else belt - v,
        force=forces,
        **({} if system.back_slip else {"back_slip": False}),
    )


def _varying(speed: Any) -> Piecewise | None:
    """A speed that changes in time; None if it is a number."""
    if not isinstance(speed, Piecewise):
        return None
    if speed.values.ndim > 1:
        raise ValueError(f"speed: expected one value at each time, got the shape {speed.values.shape}")
    return speed


def _frame(speed: Piecewise) -> float:
    """The speed of the frame of a drive whose speed changes."""
    first, *_, last = speed.times if len(speed.times) > 1 else (*speed.times, *speed.times)
    if speed.is_constant or speed.values[-2] == speed.values[-1]:
        return float(speed.values[-1])
    return float(speed.integral(last)) / float(last - first)


def _ahead(speed: Piecewise, frame: float, rate: float) -> tuple[Floats, Floats]:
    """Times, shape (m,), and how far the drive is ahead of the frame then, 0 at t = 0; linear between them."""
    t, far = speed.times, _FAR * max(float(np.ptp(speed.times)), float(np.abs(speed.times).max()))
    length, change = np.diff(t), np.abs(np.diff(speed.values))
    bend = 0.125 * length * change  # the largest distance of a parabola from its chord
    size = max(float(np.abs(speed.integral(t) - frame * (t - t[0])).max()), float(bend.max(initial=0.0)))
    parts = np.ceil(np.sqrt(bend / (_BENT * size))).astype(np.int64) if size else np.ones(len(length), np.int64)
    parts = np.maximum(np.minimum(parts, np.ceil(length * rate / _SHORT).astype(np.int64)), 1)
    starts = np.repeat(t[:-1], parts)
    place = np.arange(len(starts)) - np.repeat(np.cumsum(parts) - parts, parts)
    inner = starts + place * np.repeat(length / parts, parts)
    ends = [t[-1:]] + [t[-1:] + far] * bool(speed.values[-1] != frame)
    times = np.unique(np.concatenate([t[:1] - far, inner, *ends, [0.0]]))
    ahead = speed.integral(times) - frame * times
    return times, ahead - ahead[np.searchsorted(times, 0.0)]


def _require_free(system: System, speed: float) -> None:
    """ValueError if a spring ties a block to the ground, from which the drive moves away."""
    sums = system.stiffness @ np.ones(system.n)
    tied = np.abs(sums) > _ROUNDING * system.row_sums
    if speed and tied.any():
        k = int(np.argmax(tied))
        called = system.names[k] if system.names else k
        raise ValueError(
            "stiffness: expected springs between blocks alone, as the drive moves away from the ground: rows that"
            f" sum to 0, got {sums[k]:g} at block {called}; leave out that spring (`leaf = 0` of a graph)"
        )


def _plus(matrix: Any, diagonal: np.ndarray) -> Any:
    """A matrix, dense, sparse or its diagonal, with something more on the diagonal."""
    if isinstance(matrix, np.ndarray):
        return matrix + (diagonal if matrix.ndim == 1 else np.diag(diagonal))
    from scipy.sparse import diags_array  # a sparse matrix has loaded it

    return matrix + diags_array(diagonal)
