"""The geometry of sticking, for any number of blocks: regions, folds, visibility (`strata`: where folds meet).

While block i sticks, friction holds F_i = R_i v + (K z)_i with

    lambda_i = -F_i / mu_i,    and it can stick where |lambda_i| <= 1        (eq. 5, and eq. 7 for any n)

The two bounds, lambda_i = sigma = +-1, are *folds*: planes in z on which the motion that slips in direction sigma
touches w_i = v. Its third derivative there,

    z_i''' = -(K w)_i,    w_j = v for a block that sticks        (eq. 9, for any n and either sign of coupling)

says on which side of sticking that motion lies: sigma z_i''' > 0 and it leaves, the fold is *visible* and ends the
sticking; sigma z_i''' < 0 and it comes back, the fold is *invisible*; at zero the next order decides.

The damping is diagonal throughout; another is refused (ValueError). Blocks are numbered from 0. Everything is
dimensionless.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.engines.coulomb.control import ORDER_MAX
from stickslip.sim.numerics.arguments import Floats, floats, integer, number, per_block, sign
from stickslip.sim.numerics.arithmetic import ROUNDING
from stickslip.sim.systems.system import System, require_plain

Visibility: TypeAlias = Literal["visible", "invisible", "degenerate"]


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
    k12 = number("kappa12", kappa12) * sign("s", s)
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


def fold(system: System, block: int, side: int) -> Fold:
    """The fold of a block at lambda_i = side.

    Raises
    ------
    TypeError, ValueError
        If there is no such block, or `side` is neither +1 nor -1.
    """
    require_plain(system, "`stickslip.workflows.gallery.theory.folds`")
    i, sigma = integer("block", block, 0, system.n - 1), sign("side", side)
    offset = -sigma * system.friction[i] - system.damping[i] * system.belt_speed
    return Fold(i, sigma, stiffness_rows(system, [i])[0], float(offset))


def folds(system: System) -> Iterator[Fold]:
    """All 2n folds, by block, side +1 first."""
    return (fold(system, i, side) for i in range(system.n) for side in (1, -1))


@dataclass(frozen=True, eq=False)
class DriftExit:
    """The end of an all-stuck interval.

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

    F_i grows by v sum_j K_ij in unit time, so block i leaves where F_i = mu_i or -mu_i. At the exit point all visible
    folds are taken together (see `visibility`); a distance from a fold within rounding counts as zero.

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
    require_plain(system, "`stickslip.workflows.gallery.theory.folds`")
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
    # not the first time alone: a block that leaves can move others off their folds
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
    require_blocks(system, 1)
    kappa = float(stiffness_rows(system, [0])[0, 0])
    if kappa == 0.0:
        raise np.linalg.LinAlgError("system: expected a stiffness that bounds z, got 0")
    v = system.belt_speed
    mu, drag = float(system.friction[0]), float(system.damping[0] * v)
    low, high = sorted(((-mu - drag) / kappa, (mu - drag) / kappa))
    return StickInterval(low, high, None if v == 0.0 else low if v < 0.0 else high)


@dataclass(frozen=True)
class Contact:
    """A block at one of its folds, and the motion from there that slips in direction `side`.

    Attributes
    ----------
    block : int
    side : +1 or -1
    visibility : "visible", "invisible" or "degenerate"
        It leaves, it returns, or all derivatives are zero within rounding.
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
    """The blocks at a fold in a given state, and whether each leaves: a visible fold begins a slip.

    A block is at a fold if it sticks, or slips with w_i = v, and |F_i| = mu_i up to rounding. Its motion is the
    same with and without slip up to the first derivative of F_i that does not vanish, which decides. All such blocks
    are decided together, order by order: one that leaves moves the others, from its third derivative on.

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
    require_plain(system, "`stickslip.workflows.gallery.theory.folds`")
    z, mode = per_block("z", z, system.n), _modes(system, mode)
    v, mu, damping = system.belt_speed, system.friction, system.damping
    now, then = (
        z,
        np.where(mode == 0, v, per_block("w", w, system.n)),
    )  # Taylor coefficients of two consecutive orders
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
        Contact(int(i), sigma, visibility_of(sigma * derivative[i]), int(order[i]), float(derivative[i]))
        for i in contacts
        for sigma in ((1, -1) if is_free[i] else (int(side[i]),))
    )


def visibility_of(outward: float) -> Visibility:
    """Visibility by the sign of a derivative that is positive if it leads away from sticking."""
    if outward == 0.0:
        return "degenerate"
    return "visible" if outward > 0.0 else "invisible"


def stiffness_rows(system: System, blocks: Sequence[int]) -> Floats:
    """Rows of K, dense, shape (len(blocks), n)."""
    rows = system.stiffness[list(blocks)]
    return rows if isinstance(rows, np.ndarray) else np.asarray(rows.toarray())


def _forces(system: System, z: ArrayLike) -> Floats:
    """F_i = R_i v + (K z)_i of one state or of many."""
    require_plain(system, "`stickslip.workflows.gallery.theory.folds`")
    n = system.n
    states = floats("z", z, f"numbers of shape ({n},) or (m, {n})")
    if states.ndim not in (1, 2) or states.shape[-1] != n:
        raise ValueError(f"z: expected shape ({n},) or (m, {n}), got shape {states.shape}")
    if not np.isfinite(states).all():
        raise ValueError("z: expected finite values, got NaN or infinity")
    return np.asarray(system.damping * system.belt_speed + (system.stiffness @ states.T).T)


def _slack(system: System, z: Floats) -> Floats:
    """A bound of the rounding of |F_i| - mu_i, shape (n,), the same as in the exact engine."""
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
    """ValueError unless slipping blocks move as their modes say, or begin to: w = v, not held by friction."""
    gap = mode * (w - system.belt_speed)
    is_held = (mode != 0) & (gap == 0.0) & (-mode * force < system.friction - slack)
    wrong = (gap < 0.0) | is_held
    if wrong.any():
        i = int(np.flatnonzero(wrong)[0])
        raise ValueError(
            f"mode: expected the direction of slip, got {mode[i]} for block {i} with"
            f" w - v = {w[i] - system.belt_speed} and F = {force[i]}"
        )


def require_blocks(system: System, n: int) -> None:
    """ValueError unless the system has n blocks."""
    if system.n != n:
        raise ValueError(f"system: expected n = {n}, got n = {system.n}; `corners` and `strata` take any")


def _modes(system: System, mode: ArrayLike) -> NDArray[np.int8]:
    array = per_block("mode", mode, system.n)
    if not np.isin(array, (-1, 0, 1)).all():
        raise ValueError(f"mode: expected -1, 0 or +1 for every block, got {array.tolist()}")
    return array.astype(np.int8)
