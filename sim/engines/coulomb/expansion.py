"""The data of series: those of all blocks about the present instant, and the window in which they hold."""

from __future__ import annotations

from functools import lru_cache
from threading import get_ident
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import course
from stickslip.sim.engines.coulomb import control
from stickslip.sim.engines.coulomb.model import SpeedWeakening
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.products import Room
from stickslip.sim.systems.weakening.pieces import N_TERMS


class Window(NamedTuple):
    """The series of a window: their order, how far they hold, and their error."""

    order: int
    span: float  #: its length, over which an error `allowed` of w grows into one of z
    allowed: float
    z_max: float  #: bounds |z|


class Shape(NamedTuple):
    """How friction falls with speed, and the series of S for n blocks."""

    law: SpeedWeakening
    series: Floats  #: S_k by rows, shape (1, orders, n), followed by the other series that the law keeps
    scale: Floats  #: of x: the steepness times the direction of slip
    x0: Floats


@course.by_run("mode", "touching", "leaves", "known_mode", "initial_mode")
class Expansion(NamedTuple):
    """The series of n blocks about the present instant, which of them stick from then on, and workspace.

    Of a stack, series and workspace are shared: no run's series outlives a slice.
    """

    series: Floats  #: by rows: c_k of a block that slips, and, once all are expanded, F - R v of one that sticks
    forces: Floats  #: while they are expanded: K c_k and the like of N, less the coefficients of external forces
    stuck_z: Floats  #: z of a block that sticks
    mode: NDArray[np.int8]
    slips: Floats  #: 1 where a block slips, else 0
    touching: NDArray[np.bool_]  #: whether a block slips with w = v, so that it is to be decided
    leaves: NDArray[np.int8]  #: the side to which a block that could stick leaves, if that is known, else 0
    zeros: NDArray[np.int64]  #: leading coefficients of its event function that vanish; if it sticks, on its `side`
    side: NDArray[np.int64]  #: of the interval |F| < m at which F is; 0: at neither
    column: Floats
    last: Floats
    pull: Floats  #: the coefficients of F - R v of one block
    change: Floats
    sizes: Floats
    steps: Floats  #: how far a block is from the origin of its series
    values: Floats  #: value and slope of its series there
    shape: Shape | None  #: None if friction does not fall with speed
    room: Room
    known_mode: NDArray[np.int8]  #: as recorded so far
    initial_mode: NDArray[np.int8]
    reach: Floats  #: how far a block's event function can deviate in a step from its tangent at the start
    near: Floats  #: the rounding of w - v in a step
    poly: Floats  #: of the search for events, as the next
    places: Floats  #: of roots

    @classmethod
    def of(cls, mode: NDArray[np.int8], law: SpeedWeakening | None) -> Expansion:
        """No series yet; blocks of mode 0 are to be decided.

        Of a stack, with `mode` of shape (m, n). What stacks share, all runs of a thread share.
        """
        n, shape = mode.shape[-1], None
        if law is not None:
            n_series = 1 if law.pieces is None else N_TERMS
            shape = Shape(law, np.full((n_series, control.ORDER_MAX + 1, n), np.nan), *np.zeros((2, n)))
        return _workspace(n, get_ident())._replace(
            mode=mode,
            touching=mode == 0,
            leaves=np.zeros(mode.shape, np.int8),
            shape=shape,
            known_mode=mode.copy(),
            initial_mode=mode.copy(),
        )


@lru_cache(maxsize=8)
def _workspace(n: int, thread: int) -> Expansion:
    """What runs of a thread share: for a small system it takes longer to make than a run."""
    orders = control.ORDER_MAX + 1
    series, forces = np.full((2, orders, n), np.nan)  # a coefficient used before it was computed would show
    stuck_z, slips, column, last, steps, reach, near = np.zeros((7, n))
    zeros, side = np.zeros((2, n), np.int64)
    pull, change, poly = np.zeros((3, orders))
    no_mode, values = np.zeros((0, n), np.int8), np.zeros((2, n))
    return Expansion(
        series, forces, stuck_z, no_mode, slips, no_mode != 0, no_mode, zeros, side, column, last, pull, change,
        np.zeros(2), steps, values, None, Room.of(n), no_mode, no_mode, reach, near, poly, np.zeros(1),
    )  # fmt: skip
