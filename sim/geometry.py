"""The geometry of sticking, for any number of blocks: regions, folds, and the strata where folds meet.

While block i sticks, friction holds F_i = R_i v + (K z)_i with

    lambda_i = -F_i / mu_i,    and it can stick where |lambda_i| <= 1        (eq. 5, and eq. 7 for any n)

The two bounds, lambda_i = sigma = +-1, are *folds*: planes in z on which the motion that slips in direction sigma
touches w_i = v. Its third derivative there,

    z_i''' = -(K w)_i,    w_j = v for a block that sticks        (eq. 9, for any n and either sign of coupling)

says on which side of sticking that motion lies: sigma z_i''' > 0 and it leaves, the fold is *visible* and ends the
sticking; sigma z_i''' < 0 and it comes back, the fold is *invisible*; at zero the next order decides.

Blocks are numbered from 0. Everything is dimensionless.
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

from sim.arguments import Floats, floats, number, per_block
from sim.kernels import ROUNDING
from sim.system import System
from sim.taylor import ORDER_MAX

Visibility: TypeAlias = Literal["visible", "invisible", "degenerate"]
#: Of a stratum: all its folds are visible, all invisible, some of each; or one is degenerate.
Kind: TypeAlias = Literal["exit", "entry", "mixed", "degenerate"]
TwoFold: TypeAlias = Literal["visible-visible", "invisible-invisible", "mixed", "degenerate"]

_TWO_FOLDS: dict[Kind, TwoFold] = {
    "exit": "visible-visible",
    "entry": "invisible-invisible",
    "mixed": "mixed",
    "degenerate": "degenerate",
}


def two_blocks(
    kappa1: float, kappa2: float, kappa12: float, rho: ArrayLike, mu: ArrayLike, v: float, s: int = 1
) -> System:
    """The pair of blocks of eq. (6).

    Parameters
    ----------
    kappa1, kappa2, kappa12 : float
        Springs to the fixed apparatus, and the one between the blocks.
    rho, mu : float or array_like, shape (2,)
        Damping and friction.
    v : float
        Speed of the belt.
    s : +1 or -1
        +1: the coupling of eq. (6) as printed; -1: kappa12 -> -kappa12, with which eq. (7) is as printed.

    Raises
    ------
    TypeError, ValueError
        If an argument is no finite number, or `s` neither +1 nor -1.
    """
    k1, k2 = number("kappa1", kappa1), number("kappa2", kappa2)
    k12 = number("kappa12", kappa12) * _sign("s", s)
    return System([[k1 + k12, -k12], [-k12, k2 + k12]], rho, mu, v)


def sticking_lambda(system: System, z: ArrayLike) -> Floats:
    """lambda_i = -F_i / mu_i that would hold each block on the belt (eq. 5).

    Parameters
    ----------
    system : System
    z : array_like, shape (n,) or (m, n)
        One state or m of them.

    Returns
    -------
    ndarray, of the shape of z
        Of a block without friction: 0 where F_i = 0, else infinite.

    Raises
    ------
    TypeError, ValueError
        If z has the wrong type or shape, or is not finite.
    """
    forces = _forces(system, z)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = -forces / system.friction
    share[forces == 0.0] = 0.0
    return share


def can_stick(system: System, z: ArrayLike) -> NDArray[np.bool_]:
    """Whether each block can stick, |F_i| <= mu_i (eq. 7 for any n); z, shape and errors as of `sticking_lambda`."""
    return np.abs(_forces(system, z)) <= system.friction


@dataclass(frozen=True, eq=False)
class Fold:
    """A plane that bounds where a block can stick: {z : normal . z = offset}, on which F_i = -side mu_i.

    Attributes
    ----------
    block : int
    side : +1 or -1
        lambda_i on the fold, and the direction in which the block slips where it leaves through it.
    normal : ndarray, shape (n,)
        Row i of K.
    offset : float
        -side mu_i - R_i v.
    """

    block: int
    side: int
    normal: Floats
    offset: float

    def height(self, z: ArrayLike) -> float:
        """normal . z - offset = F_i + side mu_i: zero on the fold, of the sign of `side` where the block sticks."""
        return float(self.normal @ per_block("z", z, len(self.normal)) - self.offset)

    def time(self, z: ArrayLike, velocity: ArrayLike) -> float:
        """Time until z, moving with a constant velocity, meets the plane; negative if it lies behind.

        With all blocks stuck the velocity is that of the belt. Infinite if z moves along the plane and off it; zero
        if it moves within it.
        """
        n = len(self.normal)
        start, direction = per_block("z", z, n), per_block("velocity", velocity, n)
        height, rate = self.height(start), float(self.normal @ direction)
        size = float(np.abs(self.normal).sum())
        if abs(rate) > ROUNDING * size * float(np.abs(direction).max()):
            return -height / rate + 0.0
        return 0.0 if abs(height) <= ROUNDING * (size * float(np.abs(start).max()) + abs(self.offset)) else math.inf

    def distance(self, z: ArrayLike, velocity: ArrayLike) -> float:
        """Length of the straight way in z to the plane along a velocity; signs and infinity as of `time`."""
        time = self.time(z, velocity)
        length = float(np.linalg.norm(per_block("velocity", velocity, len(self.normal))))
        return time * length if length > 0.0 else time  # at rest: 0 on the plane, else infinite


def fold(system: System, block: int, side: int) -> Fold:
    """The fold of a block at lambda_i = side.

    Raises
    ------
    TypeError, ValueError
        If there is no such block, or `side` is neither +1 nor -1.
    """
    i, sigma = _integer("block", block, 0, system.n - 1), _sign("side", side)
    offset = -sigma * system.friction[i] - system.damping[i] * system.belt_speed
    return Fold(i, sigma, _rows(system, [i])[0], float(offset))


def folds(system: System) -> Iterator[Fold]:
    """All 2n folds, by block, side +1 first."""
    return (fold(system, i, side) for i in range(system.n) for side in (1, -1))


@dataclass(frozen=True, eq=False)
class DriftExit:
    """The end of a time in which all blocks stick.

    Attributes
    ----------
    time : float
        From the start of the drift.
    z : ndarray, shape (n,)
        The exit point E.
    blocks : tuple of int
        Those that leave at this time; more than one where folds meet.
    sides : tuple of int
        The direction in which each of them slips.
    """

    time: float
    z: Floats
    blocks: tuple[int, ...]
    sides: tuple[int, ...]


def drift_exit(system: System, z: ArrayLike) -> DriftExit | None:
    """The first exit from sticking with all blocks stuck, when z drifts with the belt: z(t) = z + v t.

    F_i grows by v sum_j K_ij in unit time, so block i leaves where F_i = mu_i or -mu_i. At the exit point every
    visible fold counts (see `visibility`), and what rounding cannot tell from a fold is on it.

    Parameters
    ----------
    system : System
    z : float or array_like, shape (n,)
        A state in which every block can stick.

    Returns
    -------
    DriftExit or None
        None if no block ever leaves: the belt is at rest, or the drift changes no force.

    Raises
    ------
    TypeError, ValueError
        If z has the wrong type or shape, is not finite, or a block cannot stick there.
    """
    start = per_block("z", z, system.n)
    force, slack = system.holding_force(start), _slack(system, start)
    _require_hold(system, "z", force, slack, np.ones(system.n, dtype=bool))
    drift = np.full(system.n, system.belt_speed)
    rate = system.stiffness @ drift
    leaving = np.flatnonzero(np.abs(rate) > ROUNDING * system.row_sums * abs(system.belt_speed))
    if len(leaving) == 0:
        return None
    speed, toward = np.abs(rate[leaving]), np.sign(rate[leaving])
    times = np.maximum((system.friction[leaving] - toward * force[leaving]) / speed, 0.0)
    end = start + drift * times.min()
    # not the first of the times alone: one that leaves can take along others that rested on their folds
    contacts = [c for c in visibility(system, end, drift, np.zeros(system.n)) if c.visibility == "visible"]
    return DriftExit(float(times.min()), end, tuple(c.block for c in contacts), tuple(c.side for c in contacts))


@dataclass(frozen=True)
class StickInterval:
    """Where one block can stick, low <= z <= high, and where it leaves: `exit`, None if the belt is at rest."""

    low: float
    high: float
    exit: float | None


def stick_interval(system: System) -> StickInterval:
    """Stick interval and exit point E of one block: z = (-+mu - rho v) / kappa (section 2), the end it drifts to.

    Raises
    ------
    ValueError
        If the system has more than one block.
    numpy.linalg.LinAlgError
        If kappa = 0: F does not depend on z, and the block sticks everywhere or nowhere.
    """
    _require_blocks(system, 1)
    kappa = float(_rows(system, [0])[0, 0])
    if kappa == 0.0:
        raise np.linalg.LinAlgError("system: expected a stiffness that bounds z, got 0")
    v = system.belt_speed
    mu, drag = float(system.friction[0]), float(system.damping[0] * v)
    low, high = sorted(((-mu - drag) / kappa, (mu - drag) / kappa))
    return StickInterval(low, high, None if v == 0.0 else low if v < 0.0 else high)


@dataclass(frozen=True)
class Contact:
    """A block at one of its folds, and what the motion that slips in direction `side` does from there.

    Attributes
    ----------
    block : int
    side : +1 or -1
    visibility : "visible", "invisible" or "degenerate"
        It leaves, it returns, or no derivative that can be told from zero decides.
    order : int
        Of the first derivative of z_i that does not vanish, 3 unless that is zero; 0 if degenerate.
    derivative : float
        Its value on the slip side; 0 if degenerate.
    """

    block: int
    side: int
    visibility: Visibility
    order: int
    derivative: float


def visibility(system: System, z: ArrayLike, w: ArrayLike, mode: ArrayLike) -> tuple[Contact, ...]:
    """Every block that is at a fold in a given state, and whether it leaves: its motion goes on with slip if visible.

    A block is at a fold if it sticks, or slips with w_i = v, and |F_i| = mu_i up to rounding. There it moves alike
    with and without slip until the first derivative of F_i that does not vanish; that one decides. All such
    blocks are decided together, order by order: one that leaves moves the others, from its third derivative on.

    Parameters
    ----------
    system : System
    z : float or array_like, shape (n,)
    w : float or array_like, shape (n,)
        Velocities; those of sticking blocks are not read.
    mode : array_like of -1, 0, +1, shape (n,)
        0 for a block that sticks, or its direction of slip.

    Returns
    -------
    tuple of Contact
        By block. A block without friction has both folds at F_i = 0: it appears with both sides.
        Of a degenerate contact the derivatives of F_i vanish up to order 30, as far as the exact engine reads them.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or shape, or a mode cannot hold: no friction is large enough to stick, or
        w_i - v contradicts the direction of slip.
    """
    z, mode = per_block("z", z, system.n), _modes(system, mode)
    v, mu, damping = system.belt_speed, system.friction, system.damping
    now, then = z, np.where(mode == 0, v, per_block("w", w, system.n))  # Taylor coefficients of two orders in a row
    force, slack = system.holding_force(z), _slack(system, z)
    _require_hold(system, "mode", force, slack, mode == 0)
    _require_slip(system, force, slack, then, mode)

    is_open = (then == v) & (np.abs(np.abs(force) - mu) <= slack)
    contacts, side = np.flatnonzero(is_open), -np.sign(force)
    is_free = mu <= slack
    slips = (mode != 0) & ~is_open
    order, derivative = np.zeros(system.n, dtype=int), np.zeros(system.n)
    pull = system.stiffness @ z + mu * mode
    for k in range(ORDER_MAX - 1):
        if k > 0:
            pull = system.stiffness @ now
            decided = is_open & (np.abs(pull) > ROUNDING * system.row_sums * np.abs(now).max())
            order[decided] = k + 2
            derivative[decided] = -math.factorial(k) * pull[decided]
            slips |= decided & (is_free | (side * pull < 0.0))
            is_open &= ~decided
        if not is_open.any():
            break
        after = np.where(slips, -(damping * (k + 1) * then + pull) / ((k + 2) * (k + 1)), 0.0)
        now, then = then, after
    return tuple(
        Contact(int(i), sigma, _visibility(sigma * derivative[i]), int(order[i]), float(derivative[i]))
        for i in contacts
        for sigma in ((1, -1) if is_free[i] else (int(side[i]),))
    )


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

    @cached_property
    def normals(self) -> Floats:
        """Rows of K, shape (k, n)."""
        return _rows(self.system, self.blocks)

    @cached_property
    def offsets(self) -> Floats:
        """-side mu - R v of each fold, shape (k,)."""
        return self._forces(self.blocks, dict(zip(self.blocks, self.sides, strict=True)))

    @property
    def point(self) -> Floats:
        """The point of the stratum with the least norm, shape (n,): the corner itself if k = n.

        Other blocks that stick need not be able to stick there: `inner_point` is one where they can.

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
        """The least-norm point of the stratum at which nothing pulls the other sticking blocks, F = 0; shape (n,).

        Raises
        ------
        numpy.linalg.LinAlgError
            If there is none: rows of K of the sticking blocks are dependent.
        """
        sides = dict(zip(self.blocks, self.sides, strict=True))
        return _meet(_rows(self.system, self.stuck), self._forces(self.stuck, sides), self.stuck)[0]

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
        return tuple(_visibility(side * x) for side, x in zip(self.sides, third, strict=True))

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

    Every one exists if the rows of K of the sticking blocks are independent; a block without friction has its two
    folds in one place, and both are counted.

    Raises
    ------
    TypeError, ValueError
        If these are no integers with 0 <= n_folds <= n_stuck.
    """
    r = _integer("n_stuck", n_stuck, 0, None)
    k = _integer("n_folds", n_folds, 0, r)
    return math.comb(r, k) * 2**k


def strata(system: System, n_folds: int, stuck: Sequence[int] | None = None) -> Iterator[Stratum]:
    """The strata where the folds of `n_folds` of the sticking blocks meet, one after the other; see `n_strata`.

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
        In lexicographic order of the blocks, then of the sides with +1 first. Each is solved when asked to.

    Raises
    ------
    TypeError, ValueError
        If there is no such block, one is named twice, or `n_folds` is out of range.
    """
    held = _stuck(system, stuck)
    k = _integer("n_folds", n_folds, 1, len(held))
    return (
        Stratum(system, held, blocks, sides)
        for blocks in combinations(held, k)
        for sides in product((1, -1), repeat=k)
    )


def n_strata_by_kind(
    system: System, n_folds: int, stuck: Sequence[int] | None = None, velocity: ArrayLike | None = None
) -> dict[Kind, int]:
    """How many strata are exits, entries, mixed or degenerate (`Stratum.kind`), without enumerating them; exactly.

    Of q sticking blocks whose third derivative does not vanish each has one visible and one invisible fold: k of
    them meet in C(q, k) exits, as many entries, and C(q, k) (2^k - 2) mixed strata. Arguments and errors as of
    `strata` and `Stratum.visibility`.
    """
    held = _stuck(system, stuck)
    k = _integer("n_folds", n_folds, 1, len(held))
    w = _velocity(system, held, velocity)
    moves = np.abs(system.stiffness @ w) > ROUNDING * system.row_sums * np.abs(w).max()
    each = math.comb(int(np.count_nonzero(moves[list(held)])), k)
    return {
        "exit": each,
        "entry": each,
        "mixed": each * (2**k - 2),
        "degenerate": n_strata(len(held), k) - each * 2**k,
    }


def corners(system: System) -> Iterator[Stratum]:
    """The 2^n corners of the region where all blocks stick, K z = -(side mu + R v) (eq. 8 for any n), lazily.

    Raises
    ------
    numpy.linalg.LinAlgError
        If K is singular: its folds do not all meet, and there are no corners.
    """
    n = system.n
    rank = _rank(np.linalg.svd(_unit(_rows(system, range(n)))[0], compute_uv=False), n)
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
    _require_blocks(system, 2)
    first, clockwise, counter, last = corners(system)  # ++, +-, -+, --
    if np.linalg.det(_rows(system, (0, 1))) < 0.0:  # lambda runs round the other way than z
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
    """Rows scaled to norm one (zero rows stay), and their norms: angles, not sizes, are to tell the rank."""
    norms = np.asarray(np.linalg.norm(rows, axis=1), dtype=np.float64)
    norms[norms == 0.0] = 1.0
    return rows / norms[:, None], norms


def _rank(sizes: NDArray[np.floating[Any]], n: int) -> int:
    """Number of singular values that rounding does not explain."""
    return int(np.count_nonzero(sizes > n * np.finfo(np.float64).eps * sizes.max()))


def _visibility(outward: float) -> Visibility:
    if outward == 0.0:
        return "degenerate"
    return "visible" if outward > 0.0 else "invisible"


def _rows(system: System, blocks: Sequence[int]) -> Floats:
    """Rows of K, dense, shape (len(blocks), n)."""
    rows = system.stiffness[list(blocks)]
    return rows if isinstance(rows, np.ndarray) else np.asarray(rows.toarray())


def _forces(system: System, z: ArrayLike) -> Floats:
    """F_i = R_i v + (K z)_i of one state or of many."""
    n = system.n
    states = floats("z", z, f"numbers of shape ({n},) or (m, {n})")
    if states.ndim not in (1, 2) or states.shape[-1] != n:
        raise ValueError(f"z: expected shape ({n},) or (m, {n}), got shape {states.shape}")
    if not np.isfinite(states).all():
        raise ValueError("z: expected finite values, got NaN or infinity")
    return np.asarray(system.damping * system.belt_speed + (system.stiffness @ states.T).T)


def _slack(system: System, z: Floats) -> Floats:
    """What rounding may do to |F_i| - mu_i, shape (n,); the exact engine allows the same."""
    held = np.abs(system.damping * system.belt_speed) + system.row_sums * np.abs(z).max() + system.friction
    return np.asarray(ROUNDING * held)


def _require_hold(system: System, name: str, force: Floats, slack: Floats, sticks: NDArray[np.bool_]) -> None:
    too_much = sticks & (np.abs(force) > system.friction + slack)
    if too_much.any():
        i = int(np.flatnonzero(too_much)[0])
        raise ValueError(
            f"{name}: expected |F| <= mu of every sticking block, got |F| = {abs(force[i])} > mu = "
            f"{system.friction[i]} for block {i}, which slips"
        )


def _require_slip(system: System, force: Floats, slack: Floats, w: Floats, mode: NDArray[np.int8]) -> None:
    """A slipping block moves the way its mode says, or is about to: w = v and friction cannot hold it."""
    gap = mode * (w - system.belt_speed)
    is_held = (mode != 0) & (gap == 0.0) & (-mode * force < system.friction - slack)
    wrong = (gap < 0.0) | is_held
    if wrong.any():
        i = int(np.flatnonzero(wrong)[0])
        raise ValueError(
            f"mode: expected the direction of slip, got {mode[i]} for block {i} with"
            f" w - v = {w[i] - system.belt_speed} and F = {force[i]}"
        )


def _require_blocks(system: System, n: int) -> None:
    if system.n != n:
        raise ValueError(f"system: expected n = {n}, got n = {system.n}; `corners` and `strata` take any")


def _modes(system: System, mode: ArrayLike) -> NDArray[np.int8]:
    array = per_block("mode", mode, system.n)
    if not np.isin(array, (-1, 0, 1)).all():
        raise ValueError(f"mode: expected -1, 0 or +1 for every block, got {array.tolist()}")
    return array.astype(np.int8)


def _stuck(system: System, stuck: Sequence[int] | None) -> tuple[int, ...]:
    if stuck is None:
        return tuple(range(system.n))
    held = sorted(_integer("stuck", i, 0, system.n - 1) for i in stuck)
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


def _integer(name: str, value: Any, low: int, high: int | None) -> int:
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name}: expected an integer, got {value!r}")
    if value < low or (high is not None and value > high):
        span = f"at least {low}" if high is None else f"from {low} to {high}"
        raise ValueError(f"{name}: expected an integer {span}, got {value}")
    return int(value)


def _sign(name: str, value: Any) -> int:
    if isinstance(value, bool | np.bool_) or value not in (-1, 1):
        raise ValueError(f"{name}: expected +1 or -1, got {value!r}")
    return int(value)
