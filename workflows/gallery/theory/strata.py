"""Strata: where the folds of several sticking blocks meet, how many there are, and which are exits.

With r of n blocks stuck, folds of k of them meet in C(r, k) 2^k strata of dimension 2n - r - k (section 4, counts
corrected); they are points, corners of the sticking region, only for r = k = n. See `folds` for one.

The damping must be diagonal; a full one is refused (ValueError). Blocks are numbered from 0. Everything is
dimensionless.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, product
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.numerics.arguments import Floats, integer, per_block
from stickslip.sim.numerics.arithmetic import ROUNDING
from stickslip.sim.systems.system import System, require_plain
from stickslip.workflows.gallery.theory.folds import Visibility, require_blocks, stiffness_rows, visibility_of

#: Of a stratum: all its folds are visible, all invisible, some of each; or one is degenerate.
Kind: TypeAlias = Literal["exit", "entry", "mixed", "degenerate"]
TwoFold: TypeAlias = Literal["visible-visible", "invisible-invisible", "mixed", "degenerate"]

_TWO_FOLDS: dict[Kind, TwoFold] = {
    "exit": "visible-visible",
    "entry": "invisible-invisible",
    "mixed": "mixed",
    "degenerate": "degenerate",
}


@dataclass(frozen=True, eq=False)
class Stratum:
    """Where the folds of k blocks meet while r blocks stick: {z : normals z = offsets}.

    Attributes
    ----------
    system : System
    stuck : tuple of int
        The r blocks that stick.
    blocks : tuple of int
        Those of them, k, that are at a fold.
    sides : tuple of int
        lambda of each on its fold, +1 or -1.
    """

    system: System = field(repr=False)
    stuck: tuple[int, ...]
    blocks: tuple[int, ...]
    sides: tuple[int, ...]

    def __post_init__(self) -> None:
        require_plain(self.system, "`stickslip.workflows.gallery.theory.strata`")

    @cached_property
    def normals(self) -> Floats:
        """Rows of K, shape (k, n)."""
        return stiffness_rows(self.system, self.blocks)

    @cached_property
    def offsets(self) -> Floats:
        """-side mu - R v of each fold, shape (k,)."""
        return self._forces(self.blocks, dict(zip(self.blocks, self.sides, strict=True)))

    @property
    def point(self) -> Floats:
        """The point of the stratum with the least norm, shape (n,): the corner itself if k = n.

        The other sticking blocks may not be able to stick there: `inner_point` is a point at which they can.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the folds do not meet: their normals are dependent.
        """
        return self._solution[0]

    @property
    def basis(self) -> Floats:
        """Orthonormal directions within the stratum, shape (n - k, n), or more rows if normals are dependent."""
        return self._solution[1]

    @property
    def dimension(self) -> int:
        """Of the stratum in phase space: 2n - r - k, or more if normals are dependent."""
        return self.system.n - len(self.stuck) + len(self.basis)

    @cached_property
    def inner_point(self) -> Floats:
        """The least-norm point of the stratum at which the other sticking blocks have F = 0; shape (n,).

        Raises
        ------
        numpy.linalg.LinAlgError
            If there is none: rows of K of the sticking blocks are dependent.
        """
        sides = dict(zip(self.blocks, self.sides, strict=True))
        return _meet(stiffness_rows(self.system, self.stuck), self._forces(self.stuck, sides), self.stuck)[0]

    def visibility(self, velocity: ArrayLike | None = None) -> tuple[Visibility, ...]:
        """Of each fold, by the third derivative of its block, which is the same all over the stratum.

        Parameters
        ----------
        velocity : float or array_like, shape (n,), optional
            Velocities of the blocks; those of sticking ones are not read. Not needed if all stick.

        Raises
        ------
        TypeError, ValueError
            If the velocity has the wrong type or shape, or is missing while a block slips.
        """
        w = _velocity(self.system, self.stuck, velocity)
        third = -(self.normals @ w)
        third[np.abs(third) <= ROUNDING * np.abs(self.normals).sum(axis=1) * np.abs(w).max()] = 0.0
        return tuple(visibility_of(side * x) for side, x in zip(self.sides, third, strict=True))

    def kind(self, velocity: ArrayLike | None = None) -> Kind:
        """All folds visible ("exit"), all invisible ("entry"), or both ("mixed"), for a given drift.

        Where a third derivative vanishes it is "degenerate", and `visibility` of a state decides by higher ones.
        Arguments and errors as of `Stratum.visibility`.
        """
        seen = set(self.visibility(velocity))
        if "degenerate" in seen:
            return "degenerate"
        if len(seen) == 2:
            return "mixed"
        return "exit" if "visible" in seen else "entry"

    def two_fold(self, velocity: ArrayLike | None = None) -> TwoFold:
        """The local type of a stratum of two folds; arguments as of `Stratum.visibility`.

        Raises
        ------
        ValueError
            If other than two folds meet here.
        """
        if len(self.blocks) != 2:
            raise ValueError(f"blocks: expected a stratum of two folds, got one of {len(self.blocks)}")
        return _TWO_FOLDS[self.kind(velocity)]

    @cached_property
    def _solution(self) -> tuple[Floats, Floats]:
        return _meet(self.normals, self.offsets, self.blocks)

    def _forces(self, blocks: tuple[int, ...], sides: dict[int, int]) -> Floats:
        """(K z)_i of blocks at the folds of `sides`, and with F_i = 0 otherwise."""
        at = list(blocks)
        sigma = np.array([sides.get(i, 0) for i in blocks], dtype=np.float64)
        return -sigma * self.system.friction[at] - self.system.damping[at] * self.system.belt_speed


def n_strata(n_stuck: int, n_folds: int) -> int:
    """How many strata there are where folds of k of r sticking blocks meet: C(r, k) 2^k, exactly.

    All exist if the rows of K of the sticking blocks are independent; the two folds of a block without friction
    coincide, and both are counted.

    Raises
    ------
    TypeError, ValueError
        If these are no integers with 0 <= n_folds <= n_stuck.
    """
    r = integer("n_stuck", n_stuck, 0, None)
    k = integer("n_folds", n_folds, 0, r)
    return math.comb(r, k) * 2**k


def strata(system: System, n_folds: int, stuck: Sequence[int] | None = None) -> Iterator[Stratum]:
    """Iterate over the strata where the folds of `n_folds` of the sticking blocks meet; see `n_strata`.

    Parameters
    ----------
    system : System
    n_folds : int
        k, from 1 to the number of sticking blocks.
    stuck : sequence of int, optional
        The blocks that stick; all if not given.

    Returns
    -------
    iterator of Stratum
        In lexicographic order of the blocks, then of the sides with +1 first. Each is solved on demand.

    Raises
    ------
    TypeError, ValueError
        If there is no such block, one is named twice, or `n_folds` is out of range.
    """
    held = _stuck(system, stuck)
    k = integer("n_folds", n_folds, 1, len(held))
    return (
        Stratum(system, held, blocks, sides)
        for blocks in combinations(held, k)
        for sides in product((1, -1), repeat=k)
    )


def corners(system: System) -> Iterator[Stratum]:
    """The 2^n corners of the region where all blocks stick, K z = -(side mu + R v) (eq. 8 for any n), lazily.

    Raises
    ------
    numpy.linalg.LinAlgError
        If K is singular: its folds do not all meet, and there are no corners.
    """
    n = system.n
    rank = _rank(np.linalg.svd(_unit(stiffness_rows(system, range(n)))[0], compute_uv=False), n)
    if rank < n:
        raise np.linalg.LinAlgError(
            f"system: expected a non-singular stiffness, whose folds meet in corners, got rank {rank} for {n} blocks"
        )
    return strata(system, n)


def parallelogram(system: System) -> tuple[Stratum, Stratum, Stratum, Stratum]:
    """The corners of the region where two blocks stick (eq. 7), counter-clockwise from sides (+1, +1).

    Raises
    ------
    ValueError
        If the system has other than two blocks.
    numpy.linalg.LinAlgError
        If K is singular: the region is then an unbounded strip, or empty.
    """
    require_blocks(system, 2)
    first, clockwise, counter, last = corners(system)  # ++, +-, -+, --
    if np.linalg.det(stiffness_rows(system, (0, 1))) < 0.0:  # lambda runs the other way round than z
        clockwise, counter = counter, clockwise
    return first, counter, last, clockwise


def _meet(rows: Floats, offsets: Floats, blocks: tuple[int, ...]) -> tuple[Floats, Floats]:
    """The least-norm point of {z : rows z = offsets}, and an orthonormal basis of its directions, by rows."""
    unit, norms = _unit(rows)
    target = offsets / norms
    left, sizes, right = np.linalg.svd(unit)
    rank = _rank(sizes, rows.shape[1])
    if rank == rows.shape[1]:
        point = np.linalg.solve(unit, target)
    else:
        point = right[:rank].T @ ((left[:, :rank].T @ target) / sizes[:rank])
    miss = np.abs(unit @ point - target)
    if rank < len(rows) and (miss > ROUNDING * rows.shape[1] * (np.abs(target) + np.abs(point).max())).any():
        raise np.linalg.LinAlgError(
            f"blocks: expected folds that meet, got those of {blocks}, whose {len(rows)} normals have rank {rank}"
        )
    return np.asarray(point, dtype=np.float64), np.asarray(right[rank:], dtype=np.float64)


def _unit(rows: Floats) -> tuple[Floats, Floats]:
    """Rows scaled to norm one (zero rows stay), and their norms, so that angles, not sizes, decide the rank."""
    norms = np.asarray(np.linalg.norm(rows, axis=1), dtype=np.float64)
    norms[norms == 0.0] = 1.0
    return rows / norms[:, None], norms


def _rank(sizes: NDArray[np.floating[Any]], n: int) -> int:
    """Number of singular values that are above rounding."""
    return int(np.count_nonzero(sizes > n * np.finfo(np.float64).eps * sizes.max()))


def _stuck(system: System, stuck: Sequence[int] | None) -> tuple[int, ...]:
    require_plain(system, "`stickslip.workflows.gallery.theory.strata`")
    if stuck is None:
        return tuple(range(system.n))
    held = sorted(integer("stuck", i, 0, system.n - 1) for i in stuck)
    if len(set(held)) < len(held):
        raise ValueError(f"stuck: expected every block once, got {list(stuck)}")
    return tuple(held)


def _velocity(system: System, stuck: tuple[int, ...], velocity: ArrayLike | None) -> Floats:
    """w of all blocks, v where they stick."""
    if velocity is None:
        if len(stuck) < system.n:
            raise ValueError(
                f"velocity: expected the velocities of all blocks, since {system.n - len(stuck)} slip, got None"
            )
        velocity = system.belt_speed
    w = per_block("velocity", velocity, system.n).copy()
    w[list(stuck)] = system.belt_speed
    return w
