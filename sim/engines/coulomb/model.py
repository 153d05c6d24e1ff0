"""What the kernels of the exact engine know of a system."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines.coulomb import control
from stickslip.sim.engines.forcing import Drive, Forcing
from stickslip.sim.engines.polynomials import Polynomials
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.products import Pairs
from stickslip.sim.systems.system import Columns, System
from stickslip.sim.systems.weakening import LAWS, Weakening, kind_of

#: The laws whose series all kernels can extend, as these number them. Kernels are compiled apart for any other law.
SERIES_OF = [law for law in LAWS.values() if law.recurrence is not None]


class SpeedWeakening(NamedTuple):
    """How friction weakens with the speed of slip; see `stickslip.sim.systems.weakening.law`."""

    far: Floats  #: kinetic friction of a slip without bound, over that of a block that begins to slip
    steepness: float
    law: Any  #: its number in `SERIES_OF`, or the empty tuple of its kind
    is_entire: bool
    pieces: Polynomials | None  #: of a law without a `recurrence`, in the place of `law`


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
            weakens = SpeedWeakening(share, weakening.steepness, *_series_of(weakening))
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


def _series_of(weakening: Weakening) -> tuple[Any, bool, Polynomials | None]:
    """What the series of a law are from, as `SpeedWeakening` has it."""
    law = type(weakening)
    if law in SERIES_OF:
        return SERIES_OF.index(law), weakening.is_entire, None
    if law.recurrence is not None:
        return kind_of(law)(), weakening.is_entire, None
    return 0, False, Polynomials.of(weakening.pieces)


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
