"""The mechanical system: blocks on a belt, coupled by springs, held by dry friction.

    z_i'' + R_i z_i' + (K z)_i + mu_i lambda_i = 0,    lambda_i in Sign(z_i' - v)        (eq. 10 of the paper)

A full damping matrix C = diag(R) + N adds (N z')_i, N with zero diagonal. With static friction above the kinetic,
a block sticks while |mu_i lambda_i| is at most its static friction. Masses m_i multiply z_i'' (by default one),
external forces f_i(t) stand on the right side, and each block may have its own belt, of speed v_i(t). Everything is
dimensionless.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.numerics.arguments import Floats, apart, flag, floats, number, per_block
from stickslip.sim.numerics.session import numpy_arithmetic
from stickslip.sim.numerics.sparse import by_columns, is_sparse
from stickslip.sim.runs import show
from stickslip.sim.runs.blocks import named, numbered
from stickslip.sim.systems import graphs
from stickslip.sim.systems.drive import Force, Harmonic, Piecewise, Term, belt, direction, forces
from stickslip.sim.systems.driven import driven
from stickslip.sim.systems.scales import Scales
from stickslip.sim.systems.weakening import LAWS, Weakening

if TYPE_CHECKING:  # takes a tenth of a second to load, and few systems need it
    import scipy.sparse


#: What follows from a system, but not from K and R: `System.pattern` shares it.
_OF_OTHERS = (
    "n", "is_plain", "is_static_above", "slip_friction", "most_friction", "back_slip", "has_mass", "has_one_belt",
    "changes", "belt_at_zero", "fastest_belt",
)  # fmt: skip
#: What is to be done where a normal force is not constant.
NORMAL_FORCE = (
    "no engine has friction that changes in time, or lift-off: run several constant values; a normal force that"
    " follows another block, and stays above 0, is a part of K (in the guide: a contact whose normal force varies)"
)
#: Of a product of two numbers, over its size, with some room.
_ROUNDING = 1e-15
#: The most blocks of which the norm of C is computed, some hundredth of a second.
_MOST_OF_NORM = 200


@dataclass(frozen=True, eq=False, init=False)
class System:
    """n blocks: stiffness K, damping R, friction mu, the belt speed v, and external forces (dimensionless).

    Parameters
    ----------
    stiffness : array_like or scipy.sparse matrix, shape (n, n)
        K, any matrix: symmetric for springs, with a skew part for non-reciprocal couplings.
    damping : float, array_like, shape (n,) or (n, n), or scipy.sparse matrix
        R, the diagonal of the damping matrix C, or C itself. Of either sign: R < 0 feeds a motion, as friction
        that falls with the speed of slip does in linear theory.
    friction : float or array_like, shape (n,)
        mu >= 0, kinetic friction; a block with mu = 0 slides freely, except to a closed side.
    belt_speed : float, array_like, shape (n,), or Piecewise
        v; the paper takes v < 0. One for all blocks or one for each, constant or piecewise linear in time.
    static : float or array_like, shape (n,), optional
        Static friction, at least the kinetic of a block that begins to slip; by default that.
    mass : float or array_like, shape (n,)
        m > 0.
    force : float, array_like, shape (n,), Harmonic, Piecewise, or list of these, optional
        The external force on each block; a list with a `Harmonic` or a `Piecewise` in it is a sum.
    weakening : Weakening, optional
        How kinetic friction falls with the speed of slip |w - v|; see `stickslip.sim.systems.weakening`.
    back_slip : bool
        Whether a block may slip either way. If not, none gets ahead of its belt (w < v for v < 0, w > v for v > 0):
        friction holds it against any force to that side, and a block that sticks leaves to the other side, to which
        the belt loads it.
    names : sequence of str, optional
        A name for each block: a letter, then letters, digits and _.

    Attributes
    ----------
    belt_speed : float, ndarray, shape (n,), or Piecewise
        A number where all blocks have one belt of constant speed, (n,) where speeds differ, `Piecewise` with values
        of shape (k, n) where they change.
    mass : ndarray, shape (n,)
    force : tuple of Harmonic and Piecewise
        Its terms, by block: first the constant one, a `Piecewise` of one time, then those that change; empty if none.
    closed : ndarray of int8, shape (n,)
        The side, -1 or +1, to which a block may not slip; 0 where it may slip either way.
    static : ndarray, shape (n,)
        Static friction; where it was left out, the kinetic of a block that begins to slip.
    has_static : bool
        Whether static friction was given.
    damping : ndarray, shape (n,)
        R, also of a full matrix.
    cross_damping : ndarray or csc_array, shape (n, n), or None
        N = C - diag(R), sparse as C was; None if that is zero.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or shape, is not finite, a friction is negative, a static friction is
        below the kinetic, or left out beside a law that falls from it, or a mass is not positive.
    """

    stiffness: Floats | scipy.sparse.csc_array
    damping: Floats
    cross_damping: Floats | scipy.sparse.csc_array | None
    friction: Floats
    belt_speed: Any  # Any: code for one belt of constant speed takes it as a number
    static: Floats
    has_static: bool
    mass: Floats
    force: tuple[Term, ...]
    weakening: Weakening | None
    closed: NDArray[np.int8]
    names: tuple[str, ...]

    def __init__(
        self,
        stiffness: ArrayLike | scipy.sparse.sparray | scipy.sparse.spmatrix,
        damping: ArrayLike,
        friction: ArrayLike = 1.0,
        belt_speed: ArrayLike | Piecewise = -0.2,
        static: ArrayLike | None = None,
        *,
        mass: ArrayLike = 1.0,
        force: Force = None,
        weakening: Weakening | None = None,
        back_slip: bool = True,
        names: Sequence[str] = (),
    ) -> None:
        matrix = _matrix("stiffness", stiffness, "a square matrix")
        n = matrix.shape[0]
        for name, value in (("friction", friction), ("static", static), ("mass", mass)):
            _require_constant(name, value)
        mu = per_block("friction", friction, n, "mu >= 0")
        diagonal, cross = _damping(damping, n)
        values = vars(self)
        values.update(stiffness=matrix, damping=diagonal, cross_damping=cross, friction=mu)
        values.update(belt_speed=belt(belt_speed, n), has_static=static is not None)
        values.update(weakening=_weakening(weakening, static))
        values.update(static=_static(static, mu, self.weakening))
        if self.weakening is not None:
            self.weakening.require_friction(*self.slip_friction)
        values.update(mass=per_block("mass", mass, n, "m > 0"), force=forces(force, n))
        values.update(closed=_closed(back_slip, self.belt_speed, n), names=named(names, n))

    @classmethod
    def from_physical(
        cls,
        stiffness: ArrayLike | scipy.sparse.sparray | scipy.sparse.spmatrix,
        damping: ArrayLike,
        friction: ArrayLike,
        belt_speed: ArrayLike | Piecewise,
        *,
        mass: ArrayLike,
        normal: ArrayLike = 1.0,
        static: ArrayLike | None = None,
        scales: Scales | None = None,
        **others: Any,
    ) -> tuple[System, Scales]:
        """The dimensionless system of blocks in SI units, and the scales by which its results are brought back.

        Parameters
        ----------
        stiffness : array_like or scipy.sparse matrix, shape (n, n)
            In N/m.
        damping : float or array_like, shape (n,) or (n, n)
            In N s/m.
        friction, static : float or array_like, shape (n,)
            Coefficients; or forces in N, if `normal` is left out.
        belt_speed : float, array_like, shape (n,), or Piecewise
            In m/s; times in s.
        mass : float or array_like, shape (n,)
            In kg.
        normal : float or array_like, shape (n,)
            Normal loads in N.
        scales : Scales, optional
            By default those of `Scales.of`: mean mass, diagonal entry of K and kinetic friction are 1.
        **others
            `force` in N, with frequencies in radians a second; `weakening`, with speeds in m/s; `back_slip`.

        Raises
        ------
        TypeError, ValueError
            As `System`; or if a normal load is negative, or there is nothing by which to scale.
        """
        coefficients = cls(stiffness, damping, friction, belt_speed, static, mass=mass, **others)
        _require_constant("normal", normal)
        load = per_block("normal", normal, coefficients.n, "normal >= 0")
        physical = coefficients.changed(
            friction=coefficients.friction * load, static=None if static is None else coefficients.static * load
        )
        chosen = Scales.of(physical) if scales is None else scales
        return chosen.dimensionless(physical), chosen

    @classmethod
    def from_graph(
        cls,
        graph: Any,
        *,
        kappa: float = 1.0,
        leaf: ArrayLike = 0.0,
        damping: ArrayLike = 0.0,
        n: int | None = None,
        **arguments: Any,
    ) -> System:
        """Springs along a graph, and a leaf spring for each block: K = kappa L + diag(leaf), sparse.

        Parameters
        ----------
        graph : networkx.Graph, scipy.sparse matrix or array_like
            Undirected: of networkx, whose nodes in their order are the blocks, with `weight` of its edges, one where
            there is none; a symmetric adjacency, shape (n, n), of weights; or edges, shape (m, 2) or (m, 3), as rows
            i, j and a weight, each pair once.
        kappa : float
            Stiffness of a spring of weight one.
        leaf : float or array_like, shape (n,)
            Stiffness between each block and the ground.
        damping
            As in `System`.
        n : int, optional
            Number of blocks, if edges leave out the last.
        **arguments
            ``friction``, ``belt_speed`` and other arguments of `System`.

        Raises
        ------
        TypeError, ValueError
            If the graph is directed, has a loop or a pair twice, or as `System`.
        """
        edges = graphs.edges_of(graph, n)
        matrix = graphs.spring_matrix(edges, number("kappa", kappa), per_block("leaf", leaf, edges.n))
        return cls(matrix, damping, **arguments)

    @cached_property
    def n(self) -> int:
        """Number of blocks."""
        return int(self.stiffness.shape[0])

    def block(self, name: str | int) -> int:
        """The number of a block, from 0, by its name or its number; ValueError if there is none."""
        return numbered("block", name, self.names, self.n)

    def driven(self, block: str | int, spring: float, speed: float | Piecewise, **others: float) -> System:
        """The system in the frame of a drive, which draws a block along through a spring; eqs. in `systems.driven`.

        Displacements are those from where the drive has come; blocks that turn with it have w = 0.

        Parameters
        ----------
        block : str or int
        spring : float
            Stiffness of the spring, > 0; K is without it.
        speed : float or Piecewise
            Of the drive, linear between times; belt speeds of this system are against the ground, 0 for what rests.
            The frame of a `Piecewise` has its last speed, if it comes to that, or its mean.
        **others
            `damping` of the spring, by default 0; and of a harmonic part of the speed, amplitude cos(frequency t +
            phase), its `amplitude`, `frequency` > 0 and `phase`.

        Raises
        ------
        TypeError, ValueError
            If there is no such block, an argument is no such number, or a spring ties a block to the ground while the
            drive moves away: K 1 is not 0.
        """
        require_within(CARRIED, self, "the frame of a drive")
        return driven(self, block, spring, speed, **others)

    @cached_property
    def is_plain(self) -> bool:
        """Whether it is that of eq. (10) with a dense K: such systems differ in their numbers alone."""
        return isinstance(self.stiffness, np.ndarray) and not any(feature.is_in(self) for feature in BEYOND.values())

    @cached_property
    def is_static_above(self) -> bool:
        """Whether any block has a static friction above the kinetic that it begins to slip with."""
        return self.has_static and bool((self.static > self.slip_friction[0]).any())

    @cached_property
    def slip_friction(self) -> tuple[Floats, Floats]:
        """Kinetic friction of a block that begins to slip, and at the limit of fast slip, shape (n,) each."""
        if self.weakening is None:
            return self.friction, self.friction
        near, far = self.weakening.checked_ends(self.friction, self.static)
        near.flags.writeable = False  # as all others: kernels are compiled anew for what is not
        return near, far

    @numpy_arithmetic()
    def kinetic(self, slip: ArrayLike) -> Floats:
        """Kinetic friction at the speeds of slip w - v, shape (..., n); (n,) if it does not depend on them."""
        near, far = self.slip_friction
        if self.weakening is None:
            return near
        return far + (near - far) * self.weakening.shape(self.weakening.steepness * np.abs(slip))

    @numpy_arithmetic()
    def kinetic_slope(self, slip: ArrayLike) -> Floats:
        """How `kinetic` changes with |w - v|, at the speeds of slip w - v, shape (..., n)."""
        if self.weakening is None:
            return np.zeros_like(slip, dtype=np.float64)
        near, far = self.slip_friction
        steepness, tiny = self.weakening.steepness, 1e-30  # a complex step, with no cancellation
        shape = self.weakening.shape(steepness * np.abs(slip) + 1j * tiny)
        return np.asarray((near - far) * steepness * (shape.imag / tiny))

    @cached_property
    def most_resistance(self) -> Floats:
        """Bounds friction in stick and slip, shape (n,)."""
        if self.weakening is None:
            return self.static
        near, far = self.slip_friction
        return np.maximum(self.static, far + (near - far) * self.weakening.largest)

    @cached_property
    def back_slip(self) -> bool:
        """Whether every block may slip either way."""
        return not self.closed.any()

    @cached_property
    def has_mass(self) -> bool:
        """Whether any block has a mass other than one."""
        return bool((self.mass != 1.0).any())

    @cached_property
    def has_one_belt(self) -> bool:
        """Whether all blocks have one belt of constant speed."""
        return isinstance(self.belt_speed, float)

    @cached_property
    def changes(self) -> bool:
        """Whether a force or the speed of a belt depends on time."""
        return isinstance(self.belt_speed, Piecewise) or not all(term.is_constant for term in self.force)

    def force_at(self, times: ArrayLike) -> Floats:
        """The external force at times of any shape: that shape, followed by (n,)."""
        total = np.zeros((*np.shape(times), self.n))
        for term in self.force:
            total += term.at(times)
        return total

    def belt_speed_at(self, times: ArrayLike) -> Floats:
        """The belt speeds at times of any shape: that shape, followed by (n,)."""
        moving = isinstance(self.belt_speed, Piecewise)
        return np.broadcast_to(self.belt_speed.at(times) if moving else self.belt_speed, (*np.shape(times), self.n))

    @cached_property
    def belt_at_zero(self) -> Floats:
        """The belt speeds at t = 0, shape (n,)."""
        belt = np.empty(self.n)  # `broadcast_to` takes ten times as long
        belt[:] = self.belt_speed.at(0.0) if isinstance(self.belt_speed, Piecewise) else self.belt_speed
        return belt

    @property
    def has_friction(self) -> NDArray[np.bool_]:
        """Whether each block has friction, shape (n,): a block without is in no contact with its belt."""
        return self.static > 0

    def at_rest(self, t: float) -> Floats:
        """Velocities at a time, shape (n,), of blocks that ride their belts: 0 of a block without friction."""
        return np.where(self.has_friction, self.belt_speed_at(t), 0.0)

    @cached_property
    def fastest_belt(self) -> float:
        """The largest |v| at any time, of blocks with friction; of all if none has.

        Where a block has no friction its belt drives nothing, however fast it is.
        """
        if self.has_one_belt:
            return abs(self.belt_speed)
        speeds = self.belt_speed.values if isinstance(self.belt_speed, Piecewise) else self.belt_speed
        rubs = self.has_friction
        return float(np.abs(speeds[..., rubs] if rubs.any() else speeds).max())

    @cached_property
    def most_force(self) -> Floats:
        """Bounds |f_i| at all times, shape (n,)."""
        bounds = (
            np.abs(term.amplitude) if isinstance(term, Harmonic) else np.abs(term.values).max(axis=0)
            for term in self.force
        )
        return np.asarray(sum(bounds, np.zeros(self.n)))

    @property
    def of_unit_mass(self) -> System:
        """The system with the same motion and unit masses: each block's equation divided by its mass."""
        return self._divided_by_mass if self.has_mass else self  # a reference to itself would keep it alive

    @cached_property
    def _divided_by_mass(self) -> System:
        share = 1.0 / self.mass
        return self.changed(
            stiffness=_rows_times(self.stiffness, share),
            damping=_rows_times(self.damping_matrix, share),
            friction=self.friction * share,
            static=self.static * share if self.has_static else None,
            mass=1.0,
            force=[term.scaled(share) for term in self.force],
        )

    @property
    def damping_matrix(self) -> Any:
        """C, dense or sparse, shape (n, n); R, shape (n,), where C is diagonal."""
        cross = self.cross_damping
        if cross is None:
            return self.damping
        if isinstance(cross, np.ndarray):
            return cross + np.diag(self.damping)
        from scipy.sparse import diags_array

        return diags_array(self.damping) + cross

    def damping_force(self, w: Floats) -> Floats:
        """C w, with which damping acts against velocities of shape (..., n): that shape."""
        force = self.damping * w
        if self.cross_damping is None:
            return force
        return np.asarray(force + (self.cross_damping @ w.reshape(-1, self.n).T).T.reshape(w.shape))

    @cached_property
    def entries_a_row(self) -> float:
        """The mean number of entries of K in a row that are not zero."""
        stiffness = self.stiffness
        entries = stiffness if isinstance(stiffness, np.ndarray) else stiffness.data
        return float(np.count_nonzero(entries)) / self.n

    @cached_property
    def row_sums(self) -> Floats:
        """sum_j |K_ij|, shape (n,), which bounds the rounding of (K x)_i."""
        return _row_sums(self.stiffness)

    @cached_property
    def cross_sums(self) -> Floats:
        """sum_j |N_ij|, shape (n,), of the damping between blocks."""
        return np.zeros(self.n) if self.cross_damping is None else _row_sums(self.cross_damping)

    def holding_force(self, z: ArrayLike, w: ArrayLike | None = None, t: float | None = None) -> Floats:
        """The force that friction holds while block i sticks, -mu_i lambda_i, shape (n,).

        F_i = R_i v_i + (K z)_i + (N w)_i - f_i + m_i v_i'. The velocities `w` are needed with cross damping only;
        that of block i does not enter F_i. The time is needed where a force or a belt speed depends on it.

        Raises
        ------
        TypeError, ValueError
            If an argument has the wrong type or shape, or `w` or `t` is needed and missing.
        """
        if self.changes and t is None:
            raise ValueError("t: expected the time, on which forces or belts depend, got None; pass it")
        at = 0.0 if t is None else number("t", t)
        force = self.damping * self.belt_speed_at(at) + self.stiffness @ per_block("z", z, self.n)
        if self.force:
            force -= self.force_at(at)
        if isinstance(self.belt_speed, Piecewise):
            force += self.mass * self.belt_speed.slope_at(at)
        if self.cross_damping is None:
            return force
        if w is None:
            raise ValueError("w: expected the velocities, on which cross damping depends, got None; pass them")
        return np.asarray(force + self.cross_damping @ per_block("w", w, self.n))

    def slip_matrix(self, drag: Floats | float = 0.0) -> Floats:
        """A of the all-slip system x' = A x + b, x = (z, w), each block's row divided by its mass; shape (2n, 2n).

        `drag`, the slope of friction with speed, is added to R.
        """
        n = self.n
        stiffness = self.stiffness if isinstance(self.stiffness, np.ndarray) else self.stiffness.toarray()
        damping = np.diag(self.damping + drag)
        if self.cross_damping is not None:
            damping = damping + self.cross_damping  # a sparse one too
        matrix = np.zeros((2 * n, 2 * n))
        np.fill_diagonal(matrix[:n, n:], 1.0)
        matrix[n:, :n], matrix[n:, n:] = -stiffness, -damping
        if self.has_mass:
            matrix[n:] /= self.mass[:, np.newaxis]
        return matrix

    def rest_state(self, slip: ArrayLike) -> Floats:
        """Rest state with block i slipping in direction slip_i: K z = f - mu slip, the fixed point at w = 0.

        Raises
        ------
        ValueError
            If a force depends on time: there is no rest state.
        numpy.linalg.LinAlgError
            If K is singular: the blocks then drift and there is no rest state.
        """
        if not all(term.is_constant for term in self.force):
            raise ValueError("force: expected a constant one, under which blocks may rest, got one that changes")
        return self.rest_under(-self.friction * per_block("slip", slip, self.n))

    def rest_under(self, friction: Floats) -> Floats:
        """As `rest_state`, from the forces of friction, shape (n,), under constant external forces."""
        force = friction + self.force_at(0.0) if self.force else friction
        if isinstance(self.stiffness, np.ndarray):
            return np.asarray(np.linalg.solve(self.stiffness, force), dtype=np.float64)
        from scipy.sparse.linalg import splu  # with csgraph it takes a tenth of a second to load

        try:
            return np.asarray(splu(self.stiffness).solve(force), dtype=np.float64)
        except RuntimeError as error:  # what SuperLU raises for a singular matrix
            raise np.linalg.LinAlgError(str(error)) from error

    @cached_property
    def rates(self) -> Floats:
        """Rates of change: the largest sum_k |C_jk| + (sum_k |K_jk|)^(1/2) of blocks connected with each, shape (n,).

        Masses divide C and K. Where entries of a full C differ in sign that is too much by the root of n, so
        that |C| + |K|^(1/2) by spectral norms counts if it is less, |K|^2 at most the largest row sum times the
        largest column sum; what of C is of blocks that slip has no larger norm. The frequency of a force on one of
        the blocks counts if it is larger. Blocks are connected if K or C couples them, in either direction and over
        any number of other blocks.
        """
        if self.has_mass:
            return self.of_unit_mass.rates
        own, cross = np.abs(self.damping) + np.sqrt(self.row_sums), self.cross_damping
        if cross is not None:
            own = own + self.cross_sums
            if self.n <= _MOST_OF_NORM:
                whole, of_k = self.damping_matrix, np.sqrt(self.row_sums.max() * _row_sums(self.stiffness.T).max())
                whole = whole if isinstance(whole, np.ndarray) else whole.toarray()
                own = np.minimum(own, np.linalg.norm(whole, 2) + np.sqrt(of_k))
        for term in self.force:
            if isinstance(term, Harmonic):
                own = np.maximum(own, np.abs(term.frequency) * (term.amplitude != 0.0))
        if isinstance(self.stiffness, np.ndarray) and self.stiffness.all():
            return np.full(self.n, own.max())
        from scipy.sparse import csgraph, csr_array  # as above

        ties = csr_array(self.stiffness)
        if cross is not None:
            ties = abs(ties) + abs(csr_array(cross))
        _, group = csgraph.connected_components(ties, directed=True, connection="weak")
        fastest = np.zeros(self.n)
        np.maximum.at(fastest, group, own)
        return np.asarray(fastest[group])

    @cached_property
    def fastest_rate(self) -> float:
        """The largest of `rates`."""
        return float(self.rates.max())

    @cached_property
    def least_damping(self) -> float:
        """The least R_i; of a full C a bound of the least eigenvalue of its symmetric part, by Gershgorin."""
        cross = self.cross_damping
        if cross is None:
            return float(self.damping.min())
        return float((self.damping - 0.5 * (self.cross_sums + _row_sums(cross.T))).min())

    @cached_property
    def most_friction(self) -> float:
        """The largest mu_i."""
        return float(self.friction.max())

    def changed(self, **arguments: Any) -> System:
        """The same system with other arguments, by name; a static friction that was left out stays the kinetic.

        Without back slip the closed sides stay as they are, also on another belt.
        """
        named = {**self._arguments(), **arguments}
        return System(**named) if "back_slip" in arguments else _with_sides(named, self.closed)

    def _arguments(self) -> dict[str, Any]:
        """By which another is made as this one, but for `back_slip`."""
        return {
            "stiffness": self.stiffness,
            "damping": self.damping_matrix,
            "friction": self.friction,
            "belt_speed": self.belt_speed,
            "static": self.static if self.has_static else None,
            "mass": self.mass,
            "force": self.force,
            "weakening": self.weakening,
            "names": self.names,
        }

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy is made anew: pickled arrays could be written to, and all that follows from them would travel."""
        return _with_sides, (self._arguments(), self.closed)

    def pattern(self) -> Callable[[Floats, Floats], System]:
        """A function of a dense K and of R, shape (n,), new arrays: the same system with these.

        It takes a tenth of the time of `changed`: all else, and what follows from it, is shared.
        """
        names = {field.name for field in fields(self)} - {"stiffness", "damping"}
        shared = {name: getattr(self, name) for name in names.union(_OF_OTHERS)}

        def system(stiffness: Floats, damping: Floats) -> System:
            if not np.isfinite(stiffness).all():
                raise ValueError("stiffness: expected finite entries, got NaN or infinity")
            stiffness.flags.writeable = damping.flags.writeable = False
            other = object.__new__(System)
            vars(other).update(shared, stiffness=stiffness, damping=damping)
            return other

        return system

    def __repr__(self) -> str:
        kind = "dense" if isinstance(self.stiffness, np.ndarray) else f"sparse, {self.stiffness.nnz} entries"
        damping = "" if self.cross_damping is None else ", C full"
        static = f", static {show.span(self.static)}" if (self.static > self.friction).any() else ""
        weakening = "" if self.weakening is None else f", {self.weakening}"
        one_way = "" if self.back_slip else ", no back slip"
        mass = f", mass {show.span(self.mass)}" if self.has_mass else ""
        force = f", force {self._forces()}" if self.force else ""
        terms = f"K {kind}{damping}{static}{weakening}{one_way}{mass}{force}"
        return f"System(n={self.n}, {terms}, belt_speed={self._belts()})"

    def _belts(self, numbers: str = "") -> str:
        """Speeds of the belts in a few words."""
        if self.has_one_belt:
            return format(self.belt_speed, numbers)
        if isinstance(self.belt_speed, Piecewise):
            return f"{show.span(self.belt_speed.values)} in {len(self.belt_speed.times)} times"
        return show.span(self.belt_speed)

    def _forces(self) -> str:
        """External forces in a few words."""
        return " + ".join(
            f"{show.span(term.amplitude)} cos({show.span(term.frequency)} t)"
            if isinstance(term, Harmonic)
            else show.span(term.values) + ("" if term.is_constant else f" in {len(term.times)} times")
            for term in self.force
        )

    def _repr_html_(self) -> str:
        sparse = "" if isinstance(self.stiffness, np.ndarray) else f", sparse with {self.stiffness.nnz} entries"
        rows = {
            "stiffness K": f"|K_ij| up to {abs(self.stiffness).max():.6g}{sparse}",
            "damping R": show.span(self.damping) + ("" if self.cross_damping is None else ", C full"),
            "friction mu": show.span(self.friction),
        }
        if (self.static > self.friction).any():
            rows["static friction"] = show.span(self.static)
        if self.has_mass:
            rows["mass"] = show.span(self.mass)
        if self.force:
            rows["force"] = self._forces()
        if self.weakening is not None:
            rows["weakening"] = str(self.weakening)
        if not self.back_slip:
            rows["back slip"] = "none"
        rows["belt speed v"] = self._belts(".6g")
        return show.table(f"system of {self.n} block{'s' * (self.n > 1)}", rows)


def _with_sides(arguments: dict[str, Any], closed: NDArray[np.int8]) -> System:
    """The system with these arguments and closed sides."""
    system = System(**arguments)
    object.__setattr__(system, "closed", closed)
    return system


def work_out(systems: Sequence[System]) -> None:
    """Compute `row_sums` and `rates` of plain systems of one size together: one by one it takes longer."""
    stiffness = np.array([system.stiffness for system in systems])
    sums = abs(stiffness).sum(axis=2)
    own = np.abs([system.damping for system in systems]) + np.sqrt(sums)
    rates, is_tied = np.broadcast_to(own.max(axis=1, keepdims=True), own.shape), (stiffness != 0.0).all(axis=(1, 2))
    for k, system in enumerate(systems):
        system.__dict__["row_sums"] = sums[k]
        if is_tied[k]:  # else `rates` finds the connected components
            system.__dict__["rates"] = rates[k]


def _highest_static(system: System) -> str:
    block = int(np.argmax(system.static - system.friction))
    return "{} above {} at block {}".format(*apart(system.static[block], system.friction[block]), block)


def _first_cross_damping(system: System) -> str:
    cross = system.cross_damping
    assert cross is not None
    block, other = min(zip(*cross.nonzero(), strict=True))
    return f"{cross[block, other]:g} at row {block}, column {other}"


class Beyond(NamedTuple):
    """Something that eq. (10) does not have."""

    is_in: Callable[[System], bool]  #: whether a system has it
    argument: str  #: of `System`, that gives it
    expected: str  #: what stands there without it; `{}` is who does not take it
    came: Callable[[System], str]  #: what a system has there, in words
    remedy: str = "leave it out"


#: What a system may have beyond eq. (10), by the name under which an engine says that it takes it.
BEYOND = {
    "static": Beyond(
        lambda system: system.is_static_above,
        "static", "the kinetic friction, the one friction that {} takes", _highest_static,
    ),
    "weakening": Beyond(
        lambda system: system.weakening is not None,
        "weakening", "none, as {} needs", lambda system: str(system.weakening),
    ),
    "back_slip": Beyond(
        lambda system: not system.back_slip,
        "back_slip", "True, all that {} takes", lambda system: "False",
    ),
    "mass": Beyond(
        lambda system: system.has_mass,
        "mass", "1, all that {} takes", lambda system: show.span(system.mass),
    ),
    "force": Beyond(
        lambda system: bool(system.force),
        "force", "none, all that {} takes", lambda system: f"{len(system.force)} of them",
    ),
    "belt_speed": Beyond(
        lambda system: not system.has_one_belt,
        "belt_speed", "one constant number, all that {} takes", lambda system: system._belts(),
    ),
    "damping matrix": Beyond(
        lambda system: system.cross_damping is not None,
        "damping", "a diagonal matrix, all that {} takes", _first_cross_damping,
        "leave out what is off the diagonal, or use engine='sigmoid'",
    ),
}  # fmt: skip


#: Of `BEYOND`, what `driven` brings into the frame of a drive, and `slip_matrix` contains or need not.
CARRIED = frozenset({"static", "weakening", "back_slip", "mass", "force", "belt_speed", "damping matrix"})


def _beyond(takes: Collection[str], system: System) -> Iterator[Beyond]:
    """What the system has of `BEYOND` that is not in `takes`."""
    if not system.is_plain:
        yield from (feature for name, feature in BEYOND.items() if name not in takes and feature.is_in(system))


def is_within(takes: Collection[str], system: System) -> bool:
    """Whether all that the system has of `BEYOND` is in `takes`."""
    return not any(_beyond(takes, system))


def require_within(takes: Collection[str], system: System, what: str) -> None:
    """ValueError if the system has something of `BEYOND` that is not in `takes`; `what` is who does not take it."""
    for feature in _beyond(takes, system):
        expected = feature.expected.format(what)
        raise ValueError(f"{feature.argument}: expected {expected}, got {feature.came(system)}; {feature.remedy}")


def require_plain(system: System, what: str) -> None:
    """ValueError if the system is not that of eq. (10), with a diagonal damping and one friction."""
    require_within((), system, what)


def _rows_times(matrix: Any, share: Floats) -> Any:
    """The rows of a dense or sparse matrix, or numbers, shape (n,), times those of `share`, shape (n,)."""
    if not is_sparse(matrix):
        return matrix * (share if matrix.ndim == 1 else share[:, np.newaxis])
    from scipy.sparse import diags_array

    return diags_array(share) @ matrix


def _row_sums(matrix: Any) -> Floats:
    """Sums of magnitudes by row, shape (n,), of a dense or sparse matrix."""
    return np.asarray(abs(matrix).sum(axis=1), dtype=np.float64).reshape(matrix.shape[0])


def _static(static: ArrayLike | None, mu: Floats, weakening: Weakening | None) -> Floats:
    """Static friction by block, from the argument, or the kinetic."""
    friction = mu if weakening is None else weakening.checked_ends(mu, mu)[0]
    if static is None:
        friction.flags.writeable = False
        return friction
    held = per_block("static", static, len(friction))
    if friction is not mu:  # a product, which rounding may put to either side of what was given
        held = np.where(np.abs(held - friction) <= _ROUNDING * friction, friction, held)
        held.flags.writeable = False
    if (held < friction).any():
        block = int(np.argmax(friction - held))
        low, high = apart(held[block], friction[block])
        raise ValueError(
            f"static: expected at least the kinetic friction, got {low} below {high} at block {block}; raise it, or"
            " leave it out for the same"
        )
    return held


def _require_constant(name: str, value: Any) -> None:
    """TypeError if what is to be a number changes in time."""
    parts = value if isinstance(value, list | tuple) else [value]
    changing = [part for part in parts if isinstance(part, Piecewise | Harmonic) or callable(part)]
    if changing:
        raise TypeError(f"{name}: expected numbers that are constant in time, got {changing[0]!r}; {NORMAL_FORCE}")


def _weakening(weakening: Weakening | None, static: ArrayLike | None) -> Weakening | None:
    """The weakening, checked; None if there is none."""
    if weakening is None:
        return None
    if not isinstance(weakening, Weakening):
        known = " or ".join(f"{law.__name__}({', '.join(law.parameters())})" for law in LAWS.values())
        raise TypeError(
            f"weakening: expected {known}, Curve(function) or another Weakening, got {weakening!r}; left out: none"
        )
    weakening.require_static(static)
    return weakening


def _closed(back_slip: bool, belt_speed: Any, n: int) -> NDArray[np.int8]:
    """The closed side of each block, 0 for none."""
    if flag("back_slip", back_slip):
        return np.zeros(n, dtype=np.int8)
    speeds = np.atleast_2d(belt_speed.values if isinstance(belt_speed, Piecewise) else belt_speed)
    goes = direction(np.broadcast_to(speeds, (len(speeds), n)))
    if not goes.all():
        raise ValueError(
            f"back_slip: expected True for a belt that rests or turns, as that of block {int(np.argmin(goes != 0))}:"
            " it loads to neither side, or to both; got False"
        )
    return goes


def _matrix(name: str, value: Any, expected: str, n: int | None = None) -> Any:
    """A square matrix of finite numbers, dense or CSC, of n rows if n is given."""
    matrix = by_columns(name, value) if is_sparse(value) else floats(name, value, f"{expected} of numbers")
    rows = matrix.shape[0] if n is None and matrix.ndim == 2 else n
    if matrix.shape != (rows, rows) or rows == 0:
        raise ValueError(f"{name}: expected {expected}, got shape {matrix.shape}")
    entries = matrix if isinstance(matrix, np.ndarray) else matrix.data
    if not np.isfinite(entries).all():
        raise ValueError(f"{name}: expected finite entries, got NaN or infinity")
    entries.flags.writeable = False
    return matrix


def _damping(damping: Any, n: int) -> tuple[Floats, Any]:
    """R and N, from a damping given as a number, by block, or as a matrix."""
    if not is_sparse(damping):
        damping = floats("damping", damping, f"a number, {n} numbers or a matrix")
        if damping.ndim != 2:
            return per_block("damping", damping, n), None
    whole = _matrix("damping", damping, f"a matrix of shape ({n}, {n})", n)
    diagonal = per_block("damping", whole.diagonal(), n)
    if isinstance(whole, np.ndarray):
        cross = whole - np.diag(diagonal)
        cross.flags.writeable = False
        return diagonal, cross if cross.any() else None
    from scipy.sparse import csc_array, diags_array

    cross = csc_array(whole - diags_array(diagonal))
    cross.eliminate_zeros()
    cross.data.flags.writeable = False
    return diagonal, cross if cross.nnz else None
