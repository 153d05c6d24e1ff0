"""Blocks that are drawn along by a drive, as a drill string is turned from the top, in the frame of the drive.

A spring k with a dashpot c ties block b to a point that moves as X(t), X' = V + A cos(omega t + phi), X(0) = 0. With
x = V t + z the blocks of m x'' + C x' + K x + mu lambda = f, lambda in Sign(x' - v), obey

    m z'' + (C + c e_b e_b') z' + (K + k e_b e_b') z + mu lambda = f - C 1 V + e_b (k Y + c Y'),

lambda in Sign(z' - (v - V)), where Y = (A / omega) (sin(omega t + phi) - sin phi), if no block is tied to the ground:
K 1 = 0, unless V = 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from stickslip.sim.numerics.arguments import number
from stickslip.sim.systems.drive import Harmonic, Piecewise

if TYPE_CHECKING:
    from stickslip.sim.systems.system import System

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
    if isinstance(speed, Piecewise | Harmonic):
        raise TypeError(
            f"speed: expected a number, got {speed!r}: in the frame of a drive whose speed changes linearly forces"
            " jump, which no term does; a harmonic part is given by amplitude, frequency and phase"
        )
    b, k = system.block(block), number("spring", spring, above=0.0)
    v, c, omega = number("speed", speed), number("damping", damping), number("frequency", frequency, above=0.0)
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
    belt = system.belt_speed
    return system.changed(
        stiffness=_plus(system.stiffness, k * tie),
        damping=_plus(system.damping_matrix, c * tie),
        belt_speed=Piecewise(belt.times, belt.values - v) if isinstance(belt, Piecewise) else belt - v,
        force=forces,
        **({} if system.back_slip else {"back_slip": False}),
    )


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
