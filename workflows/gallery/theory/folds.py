"""The geometry of sticking: where blocks can stick, and the folds and corners that bound it.

While block i sticks, friction holds F_i = R_i v + (K z)_i with

    lambda_i = -F_i / mu_i,    and it can stick where |lambda_i| <= 1        (eq. 5, and eq. 7 for any n)

The two bounds, lambda_i = sigma = +-1, are *folds*: planes in z on which the motion that slips in direction sigma
touches w_i = v. Its third derivative there,

    z_i''' = -(K w)_i,    w_j = v for a block that sticks        (eq. 9, for any n and either sign of coupling)

says on which side of sticking that motion lies: sigma z_i''' > 0 and it leaves, the fold is *visible* and ends the
sticking; sigma z_i''' < 0 and it comes back, the fold is *invisible*; at zero a higher order decides.

The damping is diagonal throughout; another is refused (ValueError). Everything is dimensionless.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.numerics.arguments import Floats, floats, number, sign
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
    kappa = float(_dense(system)[0, 0])
    if kappa == 0.0:
        raise np.linalg.LinAlgError("system: expected a stiffness that bounds z, got 0")
    v = system.belt_speed
    mu, drag = float(system.friction[0]), float(system.damping[0] * v)
    low, high = sorted(((-mu - drag) / kappa, (mu - drag) / kappa))
    return StickInterval(low, high, None if v == 0.0 else low if v < 0.0 else high)


@dataclass(frozen=True, eq=False)
class Corner:
    """A point at which every block is at a fold.

    Attributes
    ----------
    sides : tuple of int
        lambda of each block, +1 or -1.
    point : ndarray, shape (n,)
    visibility : tuple of "visible", "invisible" or "degenerate"
        Of the fold of each block, by its third derivative with all blocks on the belt.
    """

    sides: tuple[int, ...]
    point: Floats
    visibility: tuple[Visibility, ...]


def corners(system: System) -> Iterator[Corner]:
    """The 2^n corners of the region where all blocks stick, K z = -(side mu + R v) (eq. 8 for any n), lazily.

    Raises
    ------
    numpy.linalg.LinAlgError
        If K is singular: its folds do not all meet, and there are no corners.
    """
    require_plain(system, "`stickslip.workflows.gallery.theory.folds`")
    stiffness = _dense(system)
    rank = np.linalg.matrix_rank(stiffness)
    if rank < system.n:
        raise np.linalg.LinAlgError(
            f"system: expected a non-singular stiffness, whose folds meet in corners, got rank {rank} for"
            f" {system.n} blocks"
        )
    third = -stiffness.sum(axis=1) * system.belt_speed
    third[np.abs(third) <= ROUNDING * system.row_sums * abs(system.belt_speed)] = 0.0
    drag = system.damping * system.belt_speed
    return (
        Corner(
            sides,
            np.linalg.solve(stiffness, -np.array(sides) * system.friction - drag),
            tuple(_visibility(side * derivative) for side, derivative in zip(sides, third, strict=True)),
        )
        for sides in product((1, -1), repeat=system.n)
    )


def parallelogram(system: System) -> tuple[Corner, Corner, Corner, Corner]:
    """The corners of the region where two blocks stick (eq. 7), counter-clockwise from sides (+1, +1).

    Raises
    ------
    ValueError
        If the system has other than two blocks.
    numpy.linalg.LinAlgError
        If K is singular: the region is then an unbounded strip, or empty.
    """
    _require_blocks(system, 2)
    start, clockwise, counter, opposite = corners(system)  # ++, +-, -+, --
    if np.linalg.det(_dense(system)) < 0.0:  # lambda runs the other way round than z
        clockwise, counter = counter, clockwise
    return start, counter, opposite, clockwise


def _visibility(outward: float) -> Visibility:
    """By the sign of a derivative that is positive if it leads away from sticking."""
    if outward == 0.0:
        return "degenerate"
    return "visible" if outward > 0.0 else "invisible"


def _dense(system: System) -> Floats:
    stiffness = system.stiffness
    return stiffness if isinstance(stiffness, np.ndarray) else np.asarray(stiffness.toarray())


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


def _require_blocks(system: System, n: int) -> None:
    if system.n != n:
        raise ValueError(f"system: expected n = {n}, got n = {system.n}; `corners` takes any")
