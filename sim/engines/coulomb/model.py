"""What the kernels of the exact engine know of a system."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines.coulomb import control
from stickslip.sim.engines.forcing import Drive, Forcing
from stickslip.sim.engines.polynomials import Polynomials
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.products import Pairs
from stickslip.sim.systems.system import Columns, System
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
    weakening: SpeedWeakening | None
    belt_speed: Floats
    forcing: Forcing
    cross: Cross | None

    @classmethod
    def of(cls, system: System, pairs: Pairs, drive: Drive) -> Model:
        near, far = system.slip_friction
        weakens, weakening = None, system.weakening
        if weakening is not None:
            share = np.divide(far, near, out=np.ones(system.n), where=near > 0)
            number = 0 if weakening.is_data else SERIES_OF.index(type(weakening))
            pieces = Polynomials.of(weakening.pieces) if weakening.is_data else None
            weakens = SpeedWeakening(share, weakening.steepness, number, weakening.is_entire, pieces)
        return cls(
            system.columns,
            pairs,
            system.row_sums,
            system.damping,
            near,
            system.static,
            system.closed,
            weakens,
            drive.belt_speed,
            drive.forcing,
            Cross.of(system),
        )


@inner
def coupling(cross, i):  # type: ignore[no-untyped-def]
    """sum_j |N_ij| of block i."""
    if cross is None:
        return 0.0
    return cross.row_sums[i]


@inner
def fastest_belt(model):  # type: ignore[no-untyped-def]
    """The largest |v| now, as of `System.fastest_belt`."""
    v, static, of_all, found = model.belt_speed, model.static, 0.0, -1.0
    for i in range(len(v)):
        of_all = max(of_all, abs(v[i]))
        if static[i] > 0.0:
            found = max(found, abs(v[i]))
    return found if found >= 0.0 else of_all
