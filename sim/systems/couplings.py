"""Named random ensembles of stiffness and damping, and perturbations of them; every draw from a seed.

All start from U, an n x n matrix uniform in [-kappa, kappa], and R uniform in [rho, 2 rho]. The paper's text
allows several readings of how K follows from U; only `antisymmetric` gives all of its figure 3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from stickslip.sim.numerics.arguments import Floats, did_you_mean, integer, per_block
from stickslip.sim.numerics.session import numpy_arithmetic
from stickslip.sim.systems.graphs import GRAPHS, drawn_edges, spring_matrix
from stickslip.sim.systems.system import System

if TYPE_CHECKING:
    import scipy.sparse


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
    return np.diag(np.abs(u.diagonal()) + kappa.sum(axis=1)) - kappa


def _in_pairs(stiffness: Floats, u: Floats) -> Floats:
    """K_ij and K_ji are one constant: the factor is that of the upper triangle."""
    return stiffness * (np.triu(u) + np.triu(u, 1).T)


def _of_springs(stiffness: Floats, u: Floats) -> Floats:
    """The diagonal is a sum: the spring to the ground, which is the row sum of K, and the other springs."""
    change = _in_pairs(stiffness, u)
    np.fill_diagonal(change, 0.0)
    return _on_diagonal(change, stiffness.sum(axis=1) * np.diag(u) - change.sum(axis=1))


#: what "random values on the order of 1%" of the constants (section 4) may mean; see `perturb_system`
Reading = Literal["scale", "relative", "damping matrix"]
READINGS: tuple[Reading, ...] = get_args(Reading)


@dataclass(frozen=True, kw_only=True)
class Coupling:
    """How an ensemble makes K."""

    #: From U, shape (n, width), uniform in [-kappa, kappa], to K, dense or sparse. For the readings "scale" and
    #: "damping matrix" it is linear in U off the diagonal.
    rule: Callable[[Floats], Floats | scipy.sparse.sparray]
    words: str = ""  #: the rule in symbols, for those who have the data alone
    width: int | None = None  #: random numbers for each block; None: n
    readings: tuple[Reading, ...] = READINGS  #: those of `READINGS` that keep the structure of K
    #: From K and U, uniform in [-1, 1], to the change of K by a factor 1 + U_ij on each free constant.
    relative: Callable[[Floats, Floats], Floats] = _in_pairs

    def shape(self, n: int) -> tuple[int, int]:
        """The shape of U for n blocks."""
        return n, n if self.width is None else self.width

    @property
    def is_dense(self) -> bool:
        """Whether K is a dense array."""
        return isinstance(self.rule(np.zeros(self.shape(2))), np.ndarray)


#: All there are, by name: a line here makes one known to `draw_system`, scenes, datasets and reports.
COUPLINGS: dict[str, Coupling] = {
    # non-reciprocal coupling, grounding springs positive: the paper's ensemble
    "antisymmetric": Coupling(
        words="K_ij = (U_ij - U_ji) / 2 = -K_ji, K_ii = |U_ii|",
        rule=lambda u: _on_diagonal((u - u.T) / 2, np.abs(u.diagonal())),
    ),
    # the other readings of the text
    "antisymmetric_triangle": Coupling(
        words="K_ij = U_ij = -K_ji for i < j, K_ii = |U_ii|",
        rule=lambda u: _on_diagonal(_strict_triangle(u), np.abs(u.diagonal())),
    ),
    "signed_diagonal": Coupling(
        words="K_ij = (U_ij - U_ji) / 2 = -K_ji, K_ii = U_ii",
        rule=lambda u: _on_diagonal((u - u.T) / 2, u.diagonal()),
    ),
    "full": Coupling(words="K = U", rule=np.copy, relative=np.multiply),
    "symmetric": Coupling(
        words="K_ij = (U_ij + U_ji) / 2, K_ii = |U_ii|",
        rule=lambda u: _on_diagonal((u + u.T) / 2, np.abs(u.diagonal())),
    ),
    # reciprocal springs between all pairs: positive definite, always stable; another reading makes some negative
    "springs": Coupling(
        words="K_ij = K_ji = -|U_ij| for i < j, K_ii = |U_ii| + sum_j |K_ij|",
        rule=_springs,
        readings=("relative",),
        relative=_of_springs,
    ),
}


def _coupling(name: str) -> Coupling:
    if name not in COUPLINGS:
        known = (*COUPLINGS, *GRAPHS)
        raise ValueError(f"coupling: expected one of {', '.join(known)}, got {name!r}{did_you_mean(name, known)}")
    return COUPLINGS[name]


def _generator(seed: int | np.random.SeedSequence) -> np.random.Generator:
    if not isinstance(seed, np.random.SeedSequence):
        integer("seed", seed, 0, None)  # None would draw a new system every time
    return np.random.default_rng(seed)


def _uniform(
    shape: tuple[int, int], rng: np.random.Generator, kappa: float, rho: tuple[float, float]
) -> tuple[Floats, Floats]:
    """U in [-kappa, kappa] of that shape and R in [rho[0], rho[1]] (n,), from one generator: R comes first."""
    damping = rng.uniform(*rho, shape[0])
    return rng.uniform(-kappa, kappa, shape), damping


@numpy_arithmetic()
def draw_system(
    coupling: str,
    n: int,
    seed: int | np.random.SeedSequence,
    *,
    kappa: float = 0.2,
    leaf: ArrayLike = 0.1,
    degree: float = 4.0,
    rewiring: float = 0.1,
    rho: float | None = 3.5,
    damping: ArrayLike | None = None,
    **arguments: Any,
) -> System:
    """Draw K and R from a named ensemble (section 4 of the paper), or by a named graph (dimensionless).

    Parameters
    ----------
    coupling : str
        One of `COUPLINGS`, or of `stickslip.sim.systems.graphs.GRAPHS`, whose K is sparse.
    n : int
        Number of blocks.
    seed : int or numpy.random.SeedSequence
        At least 0; the same seed gives the same system.
    kappa, rho : float
        Scales: stiffnesses in [-kappa, kappa], of a graph kappa between neighbours; dampings in [rho, 2 rho].
    leaf, degree, rewiring
        Of a graph: stiffness of each block's leaf spring, one number or shape (n,); mean number of neighbours, at
        most n - 1; the probability that a spring of `small_world` is rewired.
    damping
        R itself, as in `System`, in the place of a draw with rho; K does not depend on it.
    **arguments
        ``friction``, ``belt_speed`` and other arguments of `System`.

    Raises
    ------
    TypeError
        If n or the seed is no integer.
    ValueError
        If the name is unknown, n < 1, the seed or a scale is negative, or the graph has no such degree or rewiring.
    """
    n = integer("n", n, 1, None)
    scale = 0.0 if damping is not None or rho is None else rho
    for name, value in (("kappa", kappa), ("degree", degree), ("rho", scale)):
        if not value >= 0:
            raise ValueError(f"{name}: expected a number >= 0, got {value}")
    stiffness: Floats | scipy.sparse.sparray
    if coupling in GRAPHS:
        rng = _generator(seed)
        drawn = rng.uniform(scale, 2 * scale, n)
        edges = drawn_edges(coupling, n, rng, degree, rewiring)
        stiffness = spring_matrix(edges, kappa, per_block("leaf", leaf, n))
    else:
        stiffness, drawn = draw_constants(coupling, n, seed, kappa, scale)
    return System(stiffness, drawn if damping is None else damping, **arguments)


def draw_constants(
    coupling: str, n: int, seed: int | np.random.SeedSequence, kappa: float, rho: float
) -> tuple[Floats, Floats]:
    """K and R of `draw_system` alone, of one of `COUPLINGS`."""
    kind = _coupling(coupling)
    u, damping = _uniform(kind.shape(n), _generator(seed), kappa, (rho, 2 * rho))
    return kind.rule(u), damping


@numpy_arithmetic()
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
    """Perturb every constant by the order of `size`, keeping the structure of the ensemble (figure 4 iii, iv).

    One seed gives one direction, at every size. The paper's text allows several readings:

    - ``"scale"``: by up to `size` of its scale. K + S(dU) with dU uniform in [-size kappa, size kappa] and S the
      ensemble's rule (signed on the diagonal); R + dR with dR uniform in [-size rho, size rho].
    - ``"relative"``: by up to `size` of itself. Every free constant, of K and of R, times 1 + size u, u uniform in
      [-1, 1]; entries of K that are one constant, such as K_ij = -K_ji, share their u.
    - ``"damping matrix"``: as "scale", and noise uniform in [-size rho, size rho] on every entry of the damping
      matrix off its diagonal: `System.cross_damping`.

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
        If `size` is out of range, the seed negative, a name unknown, the reading none of the coupling's, or
        the system is of no ensemble: K sparse, or the damping not diagonal.
    """
    _require_perturbable(system, coupling, size, reading)
    kind = _coupling(coupling)
    rng, shape = _generator(seed), (system.n, system.n)
    if reading == "relative":
        u, r = _uniform(shape, rng, 1.0, (-1.0, 1.0))
        stiffness = system.stiffness + size * kind.relative(system.stiffness, u)
        return system.changed(stiffness=stiffness, damping=system.damping * (1.0 + size * r))
    du, dr = _uniform(shape, rng, size * kappa, (-size * rho, size * rho))
    stiffness, damping = system.stiffness + _on_diagonal(kind.rule(du), np.diag(du)), system.damping + dr
    if reading == "damping matrix":
        damping = _on_diagonal(rng.uniform(-size * rho, size * rho, shape), damping)
    return system.changed(stiffness=stiffness, damping=damping)


def _require_perturbable(system: System, coupling: str, size: float, reading: str) -> None:
    """ValueError as of `perturb_system`."""
    if reading not in READINGS:
        raise ValueError(f"reading: expected one of {', '.join(READINGS)}, got {reading!r}")
    kind = _coupling(coupling)
    if reading not in kind.readings:
        raise ValueError(
            f"reading: expected {' or '.join(kind.readings) or 'none at all'}, which keeps what `{coupling}` is, got"
            f" {reading!r}"
        )
    if not size >= 0:
        raise ValueError(f"size: expected a number >= 0, got {size}")
    if reading == "relative" and size >= 1:
        raise ValueError(
            f"size: expected less than 1 for reading='relative', got {size}: constants would change sign"
        )
    if not isinstance(system.stiffness, np.ndarray):
        raise ValueError("system: expected a dense stiffness, as drawn by draw_system, got a sparse one")
    if system.cross_damping is not None:
        raise ValueError("system: expected a diagonal damping, as drawn by draw_system, got a full matrix")
