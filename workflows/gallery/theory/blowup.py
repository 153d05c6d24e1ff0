"""Hidden dynamics of a discontinuity: the blow-up and its sticking modes (slow time: `slow_time` beside this).

Inside the layer lambda_j = phi((w_j - v) / eps_j), phi = tanh, and on the fast time of eq. (13), positive factors
kept,

    lambda_j' = (phi' / eps_j) f_j(F; lambda),    f = -F - mu s(lambda)     (s by the laws of `laws`)

Sticking modes are its equilibria, eq. (14). The factors move neither modes nor saddles, but they change basins and,
where eigenvalues are complex or there are more than two switches, can change stability. Dimensionless.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp

from stickslip.sim.numerics.arguments import Floats, per_block
from stickslip.sim.runs.run import IntegrationError
from stickslip.sim.systems.system import System, require_plain
from stickslip.workflows.gallery.theory.laws import Slips, SwitchingLaw

ModeKind = Literal["node", "focus", "saddle", "degenerate", "slip"]

#: 1 - |lambda| where a block enters a layer from slip, in the place of the limit 0
ENTRY_DEPTH = 1e-9
#: limits of one run of the fast system; a slow passage past a lost mode takes a tenth of them
MAX_EVALUATIONS = 20_000
#: |f| / mu at which the fast system counts as caught in an unstable mode
ON_BORDER = 1e-10
#: real parts below this share of the largest eigenvalue are zero
DEGENERATE = 1e-12


@dataclass(frozen=True, eq=False)
class Mode:
    """A forward continuation of the blocks from one state.

    Attributes
    ----------
    lam : float64, shape (m,)
    slip : int8, shape (m,)
        0 for a block that sticks, else the direction in which it slips.
    eigenvalues : complex128, shape (number of sticking blocks,)
        Of (phi' / eps) df/dlambda over the sticking blocks, by falling real part.
    kind : "node", "focus", "saddle", "degenerate" or "slip"
        Degenerate: an eigenvalue without a real part, as at a saddle-node or on a face. Slip: no block sticks.
    is_stable : bool
        Whether the fast system is attracted from all directions, within the blocks that stick.
    """

    lam: Floats
    slip: Slips
    eigenvalues: NDArray[np.complex128]
    kind: ModeKind
    is_stable: bool


@dataclass(frozen=True, eq=False)
class Settled:
    """The point at which the fast system comes to rest.

    Attributes
    ----------
    lam : float64, shape (m,)
    slip : int8, shape (m,)
        0 for a block that sticks; +1, -1 for one that left through the face lambda_i = +1, -1 (or was slipping).
    is_stable : bool
        False if the entry lies on the boundary of basins, or within about 1e-10 of it, and ends in an unstable mode.
    """

    lam: Floats
    slip: Slips
    is_stable: bool


@dataclass(frozen=True, eq=False, init=False)
class Blowup:
    """The fast system (13) of m switches.

    Parameters
    ----------
    law : SwitchingLaw
    friction : float or array_like, shape (m,)
        mu > 0.
    eps : float or array_like, shape (m,)
        Relative widths of the layers, > 0.

    Raises
    ------
    ValueError
        If mu or eps is not positive, or the law is for another number of switches.
    """

    law: SwitchingLaw
    friction: Floats
    eps: Floats

    def __init__(self, law: SwitchingLaw, friction: ArrayLike, eps: ArrayLike = 1.0) -> None:
        m = np.size(friction) if law.size is None or np.ndim(friction) else law.size
        for name, value in (("friction", friction), ("eps", eps)):
            array = per_block(name, value, m)
            if (array <= 0).any():
                raise ValueError(f"{name}: expected positive numbers, got {array.min()}; a switch needs both")
            object.__setattr__(self, name, array)
        if law.size not in (None, m):
            raise ValueError(f"law: {type(law).__name__} is for {law.size} blocks, got {m}")
        object.__setattr__(self, "law", law)

    def factor(self, lam: Floats) -> Floats:
        """phi' / eps of eq. (13), shape (m,)."""
        return np.asarray((1 - lam**2) / self.eps)

    def rhs(self, force: Floats, lam: Floats) -> Floats:
        """lambda' on the fast time, eq. (13) with its factors, shape (m,)."""
        return self.factor(lam) * self.law.accelerations(force, self.friction, lam)

    def mode(self, lam: Floats, slip: Slips) -> Mode:
        """An equilibrium and its stability within the blocks that stick."""
        free = np.flatnonzero(slip == 0)
        if not len(free):
            return Mode(lam, slip, np.empty(0, dtype=np.complex128), "slip", True)
        factor = self.factor(lam)[free]
        jacobian = factor[:, None] * self.law.jacobian(self.friction, lam)[np.ix_(free, free)]
        values = np.linalg.eigvals(jacobian).astype(np.complex128)
        values = values[np.argsort(-values.real)]
        kind: ModeKind
        if (np.abs(values.real) <= DEGENERATE * np.abs(values).max()).any():
            kind = "degenerate"
        elif values[0].real > 0 > values[-1].real:
            kind = "saddle"
        else:
            kind = "focus" if (values.imag != 0).any() else "node"
        return Mode(lam, slip, values, kind, bool(kind != "degenerate" and values[0].real < 0))

    def sticking_modes(self, force: ArrayLike, slip: ArrayLike = 0) -> tuple[Mode, ...]:
        """All equilibria of (14) in the closed box, with the blocks of `slip` slipping and the others stuck.

        Complete for the laws of `laws`.

        Parameters
        ----------
        force : float or array_like, shape (m,)
            F.
        slip : int or array_like, shape (m,)
            0 where a block sticks, else +1 or -1.

        Raises
        ------
        IntegrationError
            If a law's zeros could not be decided.
        """
        slips = self._slips(slip)
        target = -per_block("force", force, len(slips)) / self.friction
        zeros = self.law.zeros(target, slips)
        return tuple(self.mode(lam, slips) for lam in zeros[np.lexsort(zeros.T[::-1])])

    def continuations(self, force: ArrayLike, slip: ArrayLike = 0) -> tuple[Mode, ...]:
        """All forward continuations of blocks that are on the belt (slip_i = 0): stable modes and possible slips.

        Every block sticks or slips; sticking blocks are in a stable mode, and for a block that begins to slip f_i is
        strictly in the direction of its slip. At a fold f_i = 0, which excludes the slip.
        """
        slips, m = self._slips(slip), len(self.friction)
        load = per_block("force", force, m)
        modes = []
        for choice in product(*([0, 1, -1] if s == 0 else [s] for s in slips.tolist())):
            trial = np.array(choice, dtype=np.int8)
            starts = (trial != 0) & (slips == 0)
            for mode in self.sticking_modes(load, trial):
                away = self.law.accelerations(load, self.friction, mode.lam) * trial > 0
                if mode.is_stable and away[starts].all():
                    modes.append(mode)
        return tuple(modes)

    def settle(self, force: ArrayLike, entry: ArrayLike, slip: ArrayLike = 0) -> Settled:
        """Run the fast system from an entry point to where it settles.

        Parameters
        ----------
        force : float or array_like, shape (m,)
        entry : float or array_like, shape (m,)
            lambda in the closed box; on a face the block enters from slip, just inside it.
        slip : int or array_like, shape (m,)
            Blocks that slip already keep lambda_i = slip_i.

        Raises
        ------
        ValueError
            If the entry is outside the box.
        IntegrationError
            If it has not come to rest in 2^14 of its time units or 20,000 evaluations: a cycle, perhaps.
        """
        slips, m = self._slips(slip), len(self.friction)
        load, start = per_block("force", force, m), per_block("entry", entry, m)
        if (np.abs(start) > 1).any():
            raise ValueError(f"entry: expected lambda in [-1, 1], got {start.tolist()}")
        free = slips == 0

        def box(u: Floats) -> Floats:
            lam = slips.astype(np.float64)
            lam[free] = np.tanh(u)
            return lam

        def rhs(_: float, u: Floats) -> Floats:
            return (self.law.accelerations(load, self.friction, box(u)) / self.eps)[free]

        u = np.arctanh(np.clip(start, ENTRY_DEPTH - 1, 1 - ENTRY_DEPTH)[free])
        unit = float(self.eps.max() / self.friction.min())
        t, n_evaluations = 0.0, 0
        for span in (*2.0 ** np.arange(2, 14), 0.0):
            settled = self._at_rest(load, box(u), slips, 1e-9 if span else 1e-4)
            if settled is not None:
                return settled
            if not span or n_evaluations > MAX_EVALUATIONS:
                break
            run = solve_ivp(rhs, (t, t + span * unit), u, method="LSODA", rtol=1e-10, atol=1e-12)
            if not run.success:
                raise IntegrationError(
                    f"the fast system at F = {load.tolist()}, lambda = {box(u).tolist()}: {run.message}"
                )
            u, t = run.y[:, -1], run.t[-1]
            n_evaluations += run.nfev
        raise IntegrationError(
            f"the fast system at F = {load.tolist()} does not come to rest from lambda = {start.tolist()} in"
            f" {t / unit:g} time units, it is at {box(u).tolist()}: a cycle, or a force on the brink of two modes"
        )

    def _at_rest(self, load: Floats, lam: Floats, slip: Slips, tol: float) -> Settled | None:
        """The equilibrium that the fast system approaches."""
        f = f_before = self.law.accelerations(load, self.friction, lam)
        scale = float(np.max(self.friction))
        leaving = (slip == 0) & (1 - np.abs(lam) < 10 * ENTRY_DEPTH) & (f * lam > tol * scale)
        slipping = np.where(leaving, np.sign(lam), slip).astype(np.int8)
        free = np.flatnonzero(slipping == 0)
        if (np.abs(f[free]) > tol * scale).any():
            return None
        point = np.where(slipping != 0, slipping, lam).astype(np.float64)
        for _ in range(8 if len(free) else 0):
            jacobian = self.law.jacobian(self.friction, point)[np.ix_(free, free)]
            step = np.linalg.lstsq(jacobian, -self.law.accelerations(load, self.friction, point)[free])[0]
            point[free] = np.clip(point[free] + step, -1.0, 1.0)
        f = self.law.accelerations(load, self.friction, point)
        is_near = np.abs(point - lam).max() < 1e-2 and (np.abs(f[free]) < 1e-9 * scale).all()
        if not is_near or not (f * slipping > 0)[leaving].all():
            return None
        if not len(free):
            return Settled(point, slipping, True)
        # the factors vanish on a face: a floor keeps the sign that they give just inside it
        factor = np.maximum(1 - point[free] ** 2, 1e-6) / self.eps[free]
        jacobian = self.law.jacobian(self.friction, point)[np.ix_(free, free)]
        is_stable = bool(np.linalg.eigvals(factor[:, None] * jacobian).real.max() < 0)
        if not is_stable and np.abs(f_before[free]).max() > ON_BORDER * scale:
            return None  # it may be passing the equilibrium
        return Settled(point, slipping, is_stable)

    def _slips(self, slip: ArrayLike) -> Slips:
        array = per_block("slip", slip, len(self.friction))
        if not np.isin(array, (-1, 0, 1)).all():
            raise ValueError(f"slip: expected -1, 0 or +1 for each block, got {array.tolist()}")
        return array.astype(np.int8)


def continuations(system: System, law: SwitchingLaw, z: ArrayLike, w: ArrayLike) -> tuple[Mode, ...]:
    """All forward continuations of a state: one if the state determines its future, more if it does not.

    Coulomb's law has one everywhere except at folds (-Sign is monotone). Under static friction above kinetic, ratio
    r, a block with 1 < |F| / mu < r has two: it goes on sticking, or it slips. Blocks with w_i = v are on the belt.

    Returns
    -------
    tuple of Mode
        See `Blowup.continuations`.

    Raises
    ------
    ValueError
        If an argument is of the wrong shape or size, the damping is not diagonal, or static friction is above
        the kinetic.
    """
    blowup = Blowup(law, system.friction)
    z, w = per_block("z", z, system.n), per_block("w", w, system.n)
    return blowup.continuations(total_force(system, z, w), np.sign(w - system.belt_speed))


def total_force(system: System, z: Floats, w: Floats) -> Floats:
    """F_i = R_i w_i + (K z)_i; ValueError if the damping is not diagonal, or static friction above."""
    require_plain(system, "`stickslip.workflows.gallery.theory.blowup`")
    return np.asarray(system.damping * w + system.stiffness @ z, dtype=np.float64)
