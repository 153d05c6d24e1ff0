"""What the kernels of the exact engine know of a system."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import course
from stickslip.sim.engines.coulomb import control
from stickslip.sim.engines.forcing import Drive, Forcing
from stickslip.sim.engines.polynomials import Polynomials
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.products import Pairs
from stickslip.sim.numerics.sparse import Columns
from stickslip.sim.systems.once import once_a_system
from stickslip.sim.systems.system import System
from stickslip.sim.systems.weakening import LAW_OF

#: The laws whose series all kernels can extend by code, as these number them.
SERIES_OF = [*LAW_OF.values()]


class SpeedWeakening(NamedTuple):
    """How friction weakens with the speed of slip; see `stickslip.sim.systems.weakening.law`."""

    far: Floats  #: kinetic friction of a slip without bound, over that of a block that begins to slip
    steepness: float
    law: int  #: its number in `SERIES_OF`
    is_entire: bool
    pieces: Polynomials | None  #: of any other law


@once_a_system
def weakening_of(system: System) -> SpeedWeakening | None:
    """None if friction does not weaken."""
    if (weakening := system.weakening) is None:
        return None
    near, far = system.slip_friction
    share = np.divide(far, near, out=np.ones(system.n), where=near > 0)
    number = 0 if weakening.is_data else SERIES_OF.index(type(weakening))
    pieces = Polynomials.of(weakening.pieces) if weakening.is_data else None
    return SpeedWeakening(share, weakening.steepness, number, weakening.is_entire, pieces)


class Cross(NamedTuple):
    """The damping between blocks: N, and workspace."""

    columns: Columns
    row_sums: Floats
    product: Floats
    moving: NDArray[np.int64]
    noise: Floats  #: by order, the sums of the magnitudes of the terms of each coefficient of N w

    @classmethod
    def of(cls, system: System) -> Cross | None:
        """None if C is diagonal."""
        if system.cross_damping is None:
            return None
        n, matrix = system.n, system.cross_damping
        if not isinstance(system.stiffness, np.ndarray):
            from scipy.sparse import csc_array  # a sparse K has loaded it

            matrix = csc_array(matrix)
        return cls(
            Columns.of(matrix),
            system.cross_sums,
            np.zeros(n),
            np.zeros(n, np.int64),
            np.zeros((control.ORDER_MAX + 1, n)),
        )


class Model(NamedTuple):
    """What is constant in a piece of a run. numba types its fields by position.

    A field that is None is compiled away, with all that depends on it: functions test for None first.
    """

    columns: Columns
    pairs: Pairs
    row_sums: Floats
    damping: Floats
    friction: Floats  #: kinetic, of a block that begins to slip
    static: Floats
    closed: NDArray[np.int8]  #: the side to which no block slips, 0 if there is none
    belt_speed: Floats
    forcing: Forcing
    cross: Cross | None

    @classmethod
    def of(cls, systems: Sequence[System], drives: Sequence[Drive]) -> Model:
        """Of a stack of plain systems, or of one."""
        if len(systems) > 1:
            return cls._of(systems)
        (system,), (drive,) = systems, drives
        model = _of_alone(system)
        if drive.is_forced:
            model = model._replace(belt_speed=drive.belt_speed[np.newaxis], forcing=course.stack([drive.forcing]))
        return model if system.cross_damping is None else model._replace(cross=course.stack([Cross.of(system)]))

    @classmethod
    def _of(cls, systems: Sequence[System]) -> Model:
        """As they are if no force acts, and without damping between blocks."""
        first, m = systems[0], len(systems)
        rows = [(s.row_sums, s.damping, s.slip_friction[0], s.static, s.belt_at_zero) for s in systems]
        row_sums, damping, near, static, belt = np.array(rows).swapaxes(0, 1).copy()
        if isinstance(first.stiffness, np.ndarray):
            dense = np.array([system.stiffness for system in systems])
            none = np.empty((m, 0), np.int32)
            columns = Columns(np.array(dense.swapaxes(1, 2), order="C"), none, none, np.empty((m, 0)))
        else:
            dense, columns = np.empty((m, 0, 0)), course.stack([Columns.of(first.stiffness)])
        return cls(
            columns,
            Pairs.of(dense, row_sums),
            row_sums,
            damping,
            near,
            static,
            np.array([system.closed for system in systems]),
            belt,
            Forcing.none(m),
            None,
        )


@once_a_system
def _of_alone(system: System) -> Model:
    return Model._of([system])


@inner
def coupling(cross: Cross | None, i: int) -> float:
    """sum_j |N_ij| of block i."""
    if cross is None:
        return 0.0
    return cross.row_sums[i]


@inner
def fastest_belt(model: Model) -> float:
    """The largest |v| now, as of `System.fastest_belt`."""
    v, static, of_all, rubbing = model.belt_speed, model.static, 0.0, -1.0
    for i in range(len(v)):
        of_all = max(of_all, abs(v[i]))
        if static[i] > 0.0:
            rubbing = max(rubbing, abs(v[i]))
    return rubbing if rubbing >= 0.0 else of_all
