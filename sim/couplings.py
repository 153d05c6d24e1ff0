"""Named random ensembles of stiffness and damping, and perturbations of them; every draw from a seed.

All start from U, an n x n matrix uniform in [-kappa, kappa], and R uniform in [rho, 2 rho]. The paper's text
allows several readings of how K follows from U; only `antisymmetric` gives all of its figure 3.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from stickslip.sim.arguments import Floats, integer
from stickslip.sim.system import System


def _on_diagonal(off: Floats, diagonal: Floats) -> Floats:
    np.fill_diagonal(off, diagonal)
    return off


def _strict_triangle(u: Floats) -> Floats:
    upper = np.triu(u, 1)
    return upper - upper.T


def _springs(u: Floats) -> Floats:
    """Eq. (6) on the complete graph: -kappa_ij off the diagonal, kappa_i + sum_j kappa_ij on it."""
    kappa = np.triu(np.abs(u), 1)
    kappa += kappa.T
    return np.diag(np.abs(np.diag(u)) + kappa.sum(axis=1)) - kappa


#: name -> K as a function of U
_RULES: Mapping[str, Callable[[Floats], Floats]] = MappingProxyType(
    {
        # non-reciprocal coupling, grounding springs positive: the paper's ensemble
        "antisymmetric": lambda u: _on_diagonal((u - u.T) / 2, np.abs(np.diag(u))),
        # the other readings of the text
        "antisymmetric_triangle": lambda u: _on_diagonal(_strict_triangle(u), np.abs(np.diag(u))),
        "signed_diagonal": lambda u: _on_diagonal((u - u.T) / 2, np.diag(u)),
        "full": lambda u: u.copy(),
        "symmetric": lambda u: _on_diagonal((u + u.T) / 2, np.abs(np.diag(u))),
        # reciprocal springs between all pairs: positive definite, always stable
        "springs": _springs,
    }
)

COUPLINGS: tuple[str, ...] = tuple(_RULES)

#: what "random values on the order of 1%" of the constants (section 4) may mean; see `perturb_system`
READINGS: tuple[str, ...] = ("scale", "relative", "damping matrix")


def _rule(coupling: str) -> Callable[[Floats], Floats]:
    if coupling not in _RULES:
        raise ValueError(f"coupling: expected one of {', '.join(COUPLINGS)}, got {coupling!r}")
    return _RULES[coupling]


def _generator(seed: int | np.random.SeedSequence) -> np.random.Generator:
    if not isinstance(seed, np.random.SeedSequence):
        integer("seed", seed, 0, None)  # None would differ every time
    return np.random.default_rng(seed)


def _uniform(n: int, rng: np.random.Generator, kappa: float, rho: tuple[float, float]) -> tuple[Floats, Floats]:
    """R in [rho[0], rho[1]] (n,), then U in [-kappa, kappa] (n, n), from one generator in this order."""
    damping = rng.uniform(*rho, n)
    return rng.uniform(-kappa, kappa, (n, n)), damping


def _relative_change(coupling: str, stiffness: Floats, u: Floats) -> Floats:
    """What a factor 1 + u on every free constant of the ensemble changes K by.

    A constant stands in one place of K (`full`), or in K_ij and K_ji: the factor is then that of the upper triangle.
    The diagonal of `springs` is a sum: the spring to the ground, which is the sum of the row of K, and the others.
    """
    if coupling == "full":
        return stiffness * u
    change = stiffness * (np.triu(u) + np.triu(u, 1).T)
    if coupling == "springs":
        np.fill_diagonal(change, 0.0)
        np.fill_diagonal(change, stiffness.sum(axis=1) * np.diag(u) - change.sum(axis=1))
    return change


def draw_system(
    coupling: str,
    n: int,
    seed: int | np.random.SeedSequence,
    *,
    kappa: float = 0.2,
    rho: float = 3.5,
    friction: ArrayLike = 1.0,
    belt_speed: float = -0.2,
) -> System:
    """Draw K and R from a named ensemble (section 4 of the paper; dimensionless).

    Parameters
    ----------
    coupling : str
        One of `COUPLINGS`.
    n : int
        Number of blocks.
    seed : int or numpy.random.SeedSequence
        At least 0; the same seed gives the same system.
    kappa, rho : float
        Scales: stiffnesses in [-kappa, kappa], dampings in [rho, 2 rho].
    friction, belt_speed
        As in `System`.

    Raises
    ------
    TypeError
        If n or the seed is no integer.
    ValueError
        If the name is unknown, n < 1, or the seed, kappa or rho is negative.
    """
    rule = _rule(coupling)
    n, rng = integer("n", n, 1, None), _generator(seed)
    if not (kappa >= 0 and rho >= 0):
        raise ValueError(f"kappa, rho: expected numbers >= 0, got {kappa} and {rho}")
    u, damping = _uniform(n, rng, kappa, (rho, 2 * rho))
    return System(rule(u), damping, friction, belt_speed)


def perturb_system(
    system: System,
    coupling: str,
    size: float,
    seed: int | np.random.SeedSequence,
    *,
    reading: str = "scale",
    kappa: float = 0.2,
    rho: float = 3.5,
) -> System:
    """Move every constant by the order of `size`, keeping the structure of the ensemble (figure 4 iii, iv).

    One seed goes the same way at every size. The paper's text allows several readings:

    - ``"scale"``: by up to `size` of its scale. K + S(dU) with dU uniform in [-size kappa, size kappa] and S the
      ensemble's rule (signed on the diagonal); R + dR with dR uniform in [-size rho, size rho].
    - ``"relative"``: by up to `size` of itself. Every free constant, of K and of R, times 1 + size u, u uniform in
      [-1, 1]; entries of K that are one constant, such as K_ij = -K_ji, share their u.
    - ``"damping matrix"``: as "scale", and noise uniform in [-size rho, size rho] on every entry of the damping
      matrix off its diagonal: `System.cross_damping`, for the sigmoid engine alone.

    Parameters
    ----------
    system : System
        As drawn by `draw_system`.
    coupling : str
        The ensemble it was drawn from.
    size : float
        At least 0; below 1 for "relative", so that no constant changes its sign.
    seed : int or numpy.random.SeedSequence
    reading : str
        One of `READINGS`.
    kappa, rho : float
        As in `draw_system`; not used by "relative".

    Raises
    ------
    TypeError
        If the seed is no integer.
    ValueError
        If `size` is out of range, the seed negative, a name unknown, the coupling is `springs` and the reading not
        "relative", or the system is of no ensemble: K sparse, or the damping not diagonal.
    """
    if reading not in READINGS:
        raise ValueError(f"reading: expected one of {', '.join(READINGS)}, got {reading!r}")
    rule = _rule(coupling)
    if not size >= 0:
        raise ValueError(f"size: expected a number >= 0, got {size}")
    if reading == "relative" and size >= 1:
        raise ValueError(
            f"size: expected less than 1 for reading='relative', got {size}: constants would change sign"
        )
    if coupling == "springs" and reading != "relative":
        raise ValueError(
            "coupling: a perturbation of `springs` would make some springs negative; use reading='relative', or scale"
            " kappa instead"
        )
    if not isinstance(system.stiffness, np.ndarray):
        raise ValueError("system: expected a dense stiffness, as drawn by draw_system, got a sparse one")
    if system.cross_damping is not None:
        raise ValueError("system: expected a diagonal damping, as drawn by draw_system, got a full matrix")
    n, rng = system.n, _generator(seed)
    if reading == "relative":
        u, r = _uniform(n, rng, 1.0, (-1.0, 1.0))
        stiffness = system.stiffness + size * _relative_change(coupling, system.stiffness, u)
        return System(stiffness, system.damping * (1.0 + size * r), system.friction, system.belt_speed)
    du, dr = _uniform(n, rng, size * kappa, (-size * rho, size * rho))
    stiffness, damping = system.stiffness + _on_diagonal(rule(du), np.diag(du)), system.damping + dr
    if reading == "damping matrix":
        damping = _on_diagonal(rng.uniform(-size * rho, size * rho, (n, n)), damping)
    return System(stiffness, damping, system.friction, system.belt_speed)
