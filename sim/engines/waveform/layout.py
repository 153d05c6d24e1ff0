"""The data of the kernels: the numbers of each block, by name; the model, constant in a run; the workspace.

There are n blocks, p is n rounded up to whole vectors, and m definitions of sticking; a step has five nodes.
"""

from __future__ import annotations

from functools import lru_cache
from threading import get_ident
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines.course import Buffers, by_run
from stickslip.sim.engines.forcing import Forcing
from stickslip.sim.engines.stacks import Stack
from stickslip.sim.engines.waveform.control import Control
from stickslip.sim.engines.waveform.matrices import Matrix
from stickslip.sim.kernels.emit import Nodes, Row, Table, named
from stickslip.sim.numerics.arguments import Floats, Ints
from stickslip.sim.numerics.lanes import NARROW
from stickslip.sim.numerics.panels import SINGLE_HEIGHT
from stickslip.sim.numerics.radau import STAGES


class Blocks(Table, nodes=STAGES):
    """The numbers that formulas read and write of each block, by columns, on its present step; u = w - v."""

    # of the step
    h: Row  #: its length
    u0: Row  #: u at its start
    z0: Row  #: z at its start
    # of the block
    damping: Row  #: R
    steep: Row  #: 1 / delta
    friction: Row  #: kinetic friction of a block that begins to slip
    belt: Row  #: v
    drag: Row  #: the part of F from damping at the belts' speeds
    # of the step
    tolerance: Row  #: the error allowed
    reach: Row  #: of the block: |u| / delta beyond which friction is kinetic, to the tolerance
    done: Row  #: 1 if Newton's method has converged, or is not used
    error: Row
    allowed: Row  #: the `error` allowed: the tolerance, or less near a peak of friction
    suspect: Row  #: 1 if u may have passed the layer undetected
    low: Row  #: bounds of u on a macro step
    high: Row
    low_force: Row  #: bounds of F
    high_force: Row
    force0: Row  #: F at the start
    speed_before: Row  #: |w| a step before
    was_split: Row  #: 1 if the block took substeps in the last macro step
    moved: Row  #: the change of w by the last change of F, at most, over tolerance
    tail: Row  #: the change of w by the leading coefficient of F, at most, over tolerance
    # of a substep: where it starts, and its length, as shares of the macro step
    start: Row
    length: Row
    # of the block
    peak: Row  #: the u at which friction has its peak; infinite if it has none
    hidden: Row  #: c of the law
    static: Row  #: static friction, that of the peak
    fine: Row  #: the error allowed in a step near the peak, over tolerance
    far: Row  #: friction at the limit of fast slip, over `friction`
    weakening: Row  #: steepness of the weakening, over 1 / delta
    closed: Row  #: the side to which the block does not slip; 0: none
    # of a substep: its length if it is accepted, else 0
    taken: Row
    # under the set-valued law
    mode: Row
    lag: Row  #: the time by which an error of F moves its w at an exit, or zero
    # of the block
    passed: Row  #: the weight of the error of a step that jumped the layer
    of_tail: Row  #: the weight of the tail of F where the block comes to its layer or may leave it
    at_peak: Row  #: the error allowed in a step at the peak, over its u
    row_sum: Row  #: of |K|
    # of the step
    noise: Row  #: the rounding of F
    z_macro: Row  #: z at the start of the macro step
    u_macro: Row
    # at the nodes
    f: Nodes
    u: Nodes
    z: Nodes
    kept_f: Nodes  #: F + g of the last macro step
    kept_u: Nodes  #: of that, too
    kept_z: Nodes  #: that of which F was
    z_before: Nodes  #: of the last iteration
    z_near: Nodes  #: a z whose product with K is known to double precision
    product: Nodes  #: of K with it
    change: Nodes  #: of z since; then that of F, by products in single precision and beside K z
    mean_u: Nodes  #: the L2 projection of u
    # by powers of the place in the macro step
    g: Nodes  #: F
    moment: Nodes  #: the integrals of z - z(0)
    moment_u: Nodes


#: Rows that are copied into a lane when a block begins substeps.
OF_BLOCK = tuple(
    Blocks.places[name][0]
    for name in (
        "u0", "z0", "damping", "steep", "friction", "belt", "tolerance", "reach", "hidden", "peak", "fine", "far",
        "weakening", "closed", "passed", "at_peak", "static",
    )
)  # fmt: skip


class Shared(Table, nodes=STAGES):
    """Numbers that formulas read, the same for all blocks: the first of a row, or a square of rows."""

    weights: Nodes  #: from values at the nodes of the last step to predictions at those of this one
    h: Row  #: the macro step
    atol: Row  #: inside
    rtol: Row
    safety: Row  #: the safety factor
    size: Row  #: the largest |z| at the start
    unit: Row  #: the time in which an error of w counts as one of z: the step, or 1 if an error of z does not count


#: For kernels: tables by these names.
blocks, shared = named(Blocks), named(Shared)


class Exact(NamedTuple):
    """The set-valued law's own numbers."""

    tol: float  #: the error of w allowed in a step, over its scale
    decay: float  #: the rate at which errors of w fade, at least
    fastest_belt: float


class Model(NamedTuple):
    """What is constant in a run, except the numbers of each block in `Blocks`."""

    law: NamedTuple  #: the friction law; kernels are compiled for its type
    exact: Exact | None  #: of the set-valued law; None: the law is smooth
    stiffness: Matrix  #: K
    cross: Matrix  #: N
    has_cross: bool
    forcing: Forcing
    bands: Floats  #: shape (m, n): by each definition, the |u| below which a block sticks
    borne: Floats  #: shape (m, n): kinetic friction there
    by_force: NDArray[np.bool_]  #: shape (m,): by each definition, whether |F| must also be below static friction


class Substeps(NamedTuple):
    """Substeps of the present macro step, in the order in which they were taken."""

    block: NDArray[np.int64]
    after: NDArray[np.int64]  #: the next of the same block; -1: none
    start: Floats  #: as a share of the macro step
    length: Floats
    z: Floats  #: at the start
    u: Floats  #: at the start and the nodes, shape (..., 6)


class Repeated(NamedTuple):
    """Substeps of the last iteration, as `Substeps` has them."""

    after: NDArray[np.int64]
    length: Floats
    u: Floats


#: The order of the series of u under the set-valued law.
ORDER = 16


class Changes(NamedTuple):
    """Under the set-valued law: the changes of mode on the present macro step, those of one block in order.

    And of each piece, which is a substep, the series of u.
    """

    x: Floats  #: their places, as shares of the step
    block: NDArray[np.int64]
    mode: NDArray[np.int8]
    slope: Floats  #: F', or zero where static friction is above the kinetic
    braked: Floats  #: w' just before
    n: NDArray[np.int64]  #: how many there are, shape (1,)
    series: Floats  #: of u on each piece, shape (..., 17)
    order: NDArray[np.int64]
    share: Floats  #: the length of a piece, over that of its series


class Lanes(NamedTuple):
    """Blocks that take substeps side by side, one a lane."""

    table: Floats  #: see `Blocks`
    block: NDArray[np.int64]  #: -1: the lane is free
    again: NDArray[np.int64]  #: the substep of the last iteration to repeat; -1: none
    last: NDArray[np.int64]  #: the last substep; -1: none


class Span(NamedTuple):
    """The times of a step, or a substep, from the start of the piece."""

    start: float
    length: float
    end: float  #: that of the macro step, to the last bit


@by_run("table", "modes", "next_h")
class Workspace(NamedTuple):
    """What changes in a run, beside its state, and scratch arrays."""

    table: Floats  #: see `Blocks`, shape (rows, p)
    shared: Floats  #: see `Shared`
    lanes: Lanes
    product: Floats  #: of N with u at the nodes, shape (5, p)
    single: NDArray[np.float32]  #: shape (5, p), as the next
    single_product: NDArray[np.float32]
    forcing: Floats  #: at the nodes, shape (5, n), or (0, n) if there is none
    modes: NDArray[np.int8]  #: by each definition of sticking, shape (m, n)
    modes_before: NDArray[np.int8]  #: by the first, shape (n,)
    is_split: NDArray[np.bool_]  #: whether a block takes substeps, shape (n,)
    split: NDArray[np.int64]  #: the blocks that do; under the set-valued law, those off their prediction
    next_h: Floats  #: a block's next substep, shape (n,)
    next_h_before: Floats  #: at the start of the macro step
    end_u: Floats  #: u and z at the end of a block's last substep, shape (n,)
    end_z: Floats
    end_mode: Floats  #: under the set-valued law, its mode there
    begins: NDArray[np.int64]  #: a block's first substep; -1: none, shape (n,)
    substeps: Substeps
    repeated: Repeated
    changes: Changes
    there: Buffers  #: the state at an instant at which all blocks come to stick, or one leaves

    @classmethod
    def of(
        cls, table: Floats, modes: NDArray[np.int8], has_forcing: bool, most: int, is_exact: bool = False
    ) -> Workspace:
        """A workspace for the tables and the modes at the start of a stack, for at most so many substeps.

        A stack shares it but for these and `next_h`, and all runs of a thread but for these and `shared`.
        """
        m, _, n = modes.shape
        common = _workspace(n, table.shape[-1], has_forcing, most, is_exact, get_ident())
        of_stack = np.zeros((Shared.n_rows, STAGES))
        return common._replace(table=table, shared=of_stack, modes=modes, next_h=np.empty((m, n)))


#: Some runs as a stack, and one of them.
Runs: TypeAlias = Stack[Model, Workspace, Control[Floats], Ints]
Run: TypeAlias = Stack[Model, Workspace, Control[float], int]


@lru_cache(maxsize=8)
def _workspace(n: int, width: int, has_forcing: bool, most: int, is_exact: bool, thread: int) -> Workspace:
    """What runs of a thread share: for a small system it takes longer to make than a run."""
    most_changes, most_repeated = (most, 0) if is_exact else (0, most)
    (block, order), (x, slope, braked, share) = np.empty((2, most_changes), np.int64), np.empty((4, most_changes))
    (of_substep, after), (start, length, z) = np.empty((2, most), np.int64), np.empty((3, most))
    wide, none = -(-n // SINGLE_HEIGHT) * SINGLE_HEIGHT, np.empty((0, 0))
    count, modes, series = np.zeros(1, np.int64), np.empty(most_changes, np.int8), np.empty((most_changes, ORDER + 1))
    after_repeated, length_repeated = np.empty(most_repeated, np.int64), np.empty(most_repeated)
    return Workspace(
        table=none,
        shared=none,
        lanes=Lanes(np.empty((Blocks.n_rows, NARROW)), *np.empty((3, NARROW), np.int64)),
        product=np.zeros((STAGES, width)),
        single=np.zeros((STAGES, wide), np.float32),
        single_product=np.zeros((STAGES, wide), np.float32),
        forcing=np.zeros((STAGES if has_forcing else 0, n)),
        modes=none.astype(np.int8),
        modes_before=np.zeros(n, np.int8),
        is_split=np.zeros(n, np.bool_),
        split=np.empty(n, np.int64),
        next_h=none,
        next_h_before=np.empty(n),
        end_u=np.empty(n),
        end_z=np.empty(n),
        end_mode=np.empty(n),
        begins=np.empty(n, np.int64),
        substeps=Substeps(of_substep, after, start, length, z, np.empty((most_repeated, STAGES + 1))),
        repeated=Repeated(after_repeated, length_repeated, np.empty((most_repeated, STAGES + 1))),
        changes=Changes(x, block, modes, slope, braked, count, series, order, share),
        there=Buffers(np.empty(1), np.empty((1, n)), np.empty((1, n))),
    )
