"""The mechanical system: blocks on a belt, coupled by springs, held by dry friction.

    z_i'' + R_i z_i' + (K z)_i + mu_i lambda_i = 0,    lambda_i in Sign(z_i' - v)        (eq. 10 of the paper)

A full damping matrix C = diag(R) + N adds (N z')_i, N with zero diagonal; only the sigmoid engine takes it. Static
friction above kinetic: a block that sticks is held while |mu_i lambda_i| is at most its static friction.
Everything is dimensionless: the mass of every block is scaled to one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from stickslip.sim import show
from stickslip.sim.arguments import Floats, floats, number, per_block


class Columns(NamedTuple):
    """K by columns as the exact engine takes it: K transposed or, when this is empty, CSC."""

    dense: Floats
    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    data: Floats


@dataclass(frozen=True, eq=False, init=False)
class System:
    """n blocks: stiffness K, damping R, friction mu and the speed v of the belt (dimensionless).

    Parameters
    ----------
    stiffness : array_like or scipy.sparse matrix, shape (n, n)
        K, any matrix: symmetric for springs, with a skew part for non-reciprocal couplings.
    damping : float or array_like, shape (n,) or (n, n)
        R, the diagonal of the damping matrix C, or C itself, dense.
    friction : float or array_like, shape (n,)
        mu >= 0, kinetic friction; a block with mu = 0 slides freely.
    belt_speed : float
        v; the paper takes v < 0.
    static : float or array_like, shape (n,), optional
        Static friction, at least the kinetic; left out it is the kinetic.

    Attributes
    ----------
    static : ndarray, shape (n,)
        What holds a block that sticks; `friction` itself where it was left out.
    damping : ndarray, shape (n,)
        R, also of a full matrix.
    cross_damping : ndarray, shape (n, n), or None
        N = C - diag(R); None if that is zero.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or shape, is not finite, a friction is negative, or a static friction is
        below the kinetic.
    """

    stiffness: Floats | scipy.sparse.csc_array
    damping: Floats
    cross_damping: Floats | None
    friction: Floats
    belt_speed: float
    static: Floats

    def __init__(
        self,
        stiffness: ArrayLike | scipy.sparse.sparray | scipy.sparse.spmatrix,
        damping: ArrayLike,
        friction: ArrayLike = 1.0,
        belt_speed: float = -0.2,
        static: ArrayLike | None = None,
    ) -> None:
        if scipy.sparse.issparse(stiffness):
            matrix = scipy.sparse.csc_array(stiffness)
            matrix = scipy.sparse.csc_array(
                (floats("stiffness", matrix.data, "real entries"), matrix.indices, matrix.indptr), matrix.shape
            )
            matrix.sum_duplicates()
            entries = matrix.data
        else:
            matrix = floats("stiffness", stiffness, "a square matrix of numbers")
            entries = matrix
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or matrix.shape[0] == 0:
            raise ValueError(f"stiffness: expected a square matrix, got shape {matrix.shape}")
        if not np.isfinite(entries).all():
            raise ValueError("stiffness: expected finite entries, got NaN or infinity")
        entries.flags.writeable = False
        n = matrix.shape[0]
        mu = per_block("friction", friction, n)
        if (mu < 0).any():
            block = int(np.flatnonzero(mu < 0)[0])
            raise ValueError(f"friction: expected mu >= 0, got {mu[block]} for block {block}")
        object.__setattr__(self, "stiffness", matrix)
        diagonal, cross = _damping(damping, n)
        object.__setattr__(self, "damping", diagonal)
        object.__setattr__(self, "cross_damping", cross)
        object.__setattr__(self, "friction", mu)
        object.__setattr__(self, "belt_speed", number("belt_speed", belt_speed))
        object.__setattr__(self, "static", _static(static, mu))

    @cached_property
    def n(self) -> int:
        """Number of blocks."""
        return int(self.stiffness.shape[0])

    @cached_property
    def is_static_above(self) -> bool:
        """Whether any block has a static friction above its kinetic."""
        return self.static is not self.friction and bool((self.static > self.friction).any())

    @cached_property
    def columns(self) -> Columns:
        """K by columns, the form in which the kernels stream it."""
        if isinstance(self.stiffness, np.ndarray):
            none = np.empty(0, dtype=np.int32)
            # a copy always: kernels are compiled anew for what is read-only
            return Columns(np.array(self.stiffness.T, order="C"), none, none, np.empty(0))
        csc = self.stiffness
        indptr, indices = csc.indptr.astype(np.int32), csc.indices.astype(np.int32)
        return Columns(np.empty((0, 0)), indptr, indices, csc.data.copy())

    @cached_property
    def row_sums(self) -> Floats:
        """sum_j |K_ij|, shape (n,): bounds what rounding does to (K x)_i."""
        return np.asarray(abs(self.stiffness).sum(axis=1), dtype=np.float64).reshape(self.n)

    def holding_force(self, z: ArrayLike, w: ArrayLike | None = None) -> Floats:
        """F_i = R_i v + (K z)_i + (N w)_i, shape (n,): what friction holds while block i sticks, -mu_i lambda_i.

        The velocities `w` are needed with cross damping only; that of block i does not enter F_i.

        Raises
        ------
        TypeError, ValueError
            If an argument has the wrong type or shape, or `w` is needed and missing.
        """
        force = self.damping * self.belt_speed + self.stiffness @ per_block("z", z, self.n)
        if self.cross_damping is None:
            return force
        if w is None:
            raise ValueError("w: expected the velocities, on which cross damping depends, got None; pass them")
        return np.asarray(force + self.cross_damping @ per_block("w", w, self.n))

    def slip_matrix(self) -> Floats:
        """A of the all-slip system x' = A x + const, x = (z, w); shape (2n, 2n)."""
        n = self.n
        stiffness = self.stiffness if isinstance(self.stiffness, np.ndarray) else self.stiffness.toarray()
        damping = np.diag(self.damping)
        if self.cross_damping is not None:
            damping += self.cross_damping
        matrix = np.zeros((2 * n, 2 * n))
        np.fill_diagonal(matrix[:n, n:], 1.0)
        matrix[n:, :n], matrix[n:, n:] = -stiffness, -damping
        return matrix

    def rest_state(self, slip: ArrayLike) -> Floats:
        """Rest state with block i slipping in direction slip_i: K z = -mu slip, the fixed point of eq. (10) at w = 0.

        Raises
        ------
        numpy.linalg.LinAlgError
            If K is singular: the blocks then drift and there is no rest state.
        """
        force = -self.friction * per_block("slip", slip, self.n)
        if isinstance(self.stiffness, np.ndarray):
            return np.asarray(np.linalg.solve(self.stiffness, force), dtype=np.float64)
        try:
            return np.asarray(splu(self.stiffness).solve(force), dtype=np.float64)
        except RuntimeError as error:  # what SuperLU raises for a singular matrix
            raise np.linalg.LinAlgError(str(error)) from error

    @cached_property
    def rates(self) -> Floats:
        """How fast blocks can change: the largest |R_j| + (sum_k |K_jk|)^(1/2) of those each is tied to, shape (n,).

        Blocks are tied if K leads from one to the other, either way and over any number of blocks.
        """
        own = np.abs(self.damping) + np.sqrt(self.row_sums)
        if isinstance(self.stiffness, np.ndarray) and self.stiffness.all():
            return np.full(self.n, own.max())
        _, group = connected_components(scipy.sparse.csr_array(self.stiffness), directed=True, connection="weak")
        fastest = np.zeros(self.n)
        np.maximum.at(fastest, group, own)
        return np.asarray(fastest[group])

    def changed(self, **arguments: Any) -> System:
        """The same blocks with other arguments, by name; a static friction that was left out stays the kinetic."""
        cross = self.cross_damping
        own = {
            "stiffness": self.stiffness,
            "damping": self.damping if cross is None else cross + np.diag(self.damping),
            "friction": self.friction,
            "belt_speed": self.belt_speed,
            "static": None if self.static is self.friction else self.static,
        }
        return System(**{**own, **arguments})

    def linearised(self, friction: Floats, slope: Floats) -> System:
        """The same blocks, slipping, with friction mu `friction` and damping R + mu `slope`, both of shape (n,)."""
        damping = self.damping + self.friction * slope
        if self.cross_damping is not None:
            damping = self.cross_damping + np.diag(damping)
        return System(self.stiffness, damping, self.friction * friction, self.belt_speed)

    def __repr__(self) -> str:
        kind = "dense" if isinstance(self.stiffness, np.ndarray) else f"sparse, {self.stiffness.nnz} entries"
        damping = "" if self.cross_damping is None else ", C full"
        static = f", static {show.span(self.static)}" if self.is_static_above else ""
        return f"System(n={self.n}, K {kind}{damping}{static}, belt_speed={self.belt_speed})"

    def _repr_html_(self) -> str:
        sparse = "" if isinstance(self.stiffness, np.ndarray) else f", sparse with {self.stiffness.nnz} entries"
        rows = {
            "stiffness K": f"|K_ij| up to {abs(self.stiffness).max():.6g}{sparse}",
            "damping R": show.span(self.damping) + ("" if self.cross_damping is None else ", C full"),
            "friction mu": show.span(self.friction),
        }
        if self.is_static_above:
            rows["static friction"] = show.span(self.static)
        rows["belt speed v"] = f"{self.belt_speed:.6g}"
        return show.table(f"system of {self.n} block{'s' * (self.n > 1)}", rows)


def require_diagonal_damping(system: System, what: str) -> None:
    """ValueError if the system has cross damping, naming what cannot do with it."""
    if system.cross_damping is not None:
        block, other = np.argwhere(system.cross_damping)[0]
        raise ValueError(
            f"system: expected a diagonal damping matrix, all that {what} takes, got"
            f" {system.cross_damping[block, other]:g} at row {block}, column {other}; leave out what is off the"
            " diagonal, or use engine='sigmoid'"
        )


def require_one_friction(system: System, what: str) -> None:
    """ValueError if static friction is above the kinetic, naming what cannot do with it."""
    if system.is_static_above:
        block = int(np.argmax(system.static - system.friction))
        raise ValueError(
            f"static: expected the kinetic friction, the one friction that {what} takes, got"
            f" {system.static[block]:g} above {system.friction[block]:g} at block {block}; leave it out"
        )


def require_plain(system: System, what: str) -> None:
    """ValueError if the system is not that of eq. (10), with a diagonal damping and one friction."""
    require_diagonal_damping(system, what)
    require_one_friction(system, what)


def _static(static: ArrayLike | None, friction: Floats) -> Floats:
    """Static friction by block, from what was given beside the kinetic."""
    if static is None:
        return friction
    held = per_block("static", static, len(friction))
    if (held < friction).any():
        block = int(np.argmax(friction - held))
        raise ValueError(
            f"static: expected at least the kinetic friction, got {held[block]:g} below {friction[block]:g} at block"
            f" {block}; raise it, or leave it out for the same"
        )
    return held


def _damping(damping: ArrayLike, n: int) -> tuple[Floats, Floats | None]:
    """R and N of a damping given as a number, by block, or as a matrix."""
    cross = floats("damping", damping, f"a number, {n} numbers or a dense matrix")
    if cross.ndim != 2:
        return per_block("damping", cross, n), None
    if cross.shape != (n, n):
        raise ValueError(f"damping: expected a matrix of shape ({n}, {n}), got shape {cross.shape}")
    if not np.isfinite(cross).all():
        raise ValueError("damping: expected finite entries, got NaN or infinity")
    diagonal = per_block("damping", np.diag(cross), n)
    np.fill_diagonal(cross, 0.0)
    cross.flags.writeable = False
    return diagonal, cross if cross.any() else None
