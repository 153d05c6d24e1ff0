"""When the fate of a run is known before its end: collapse certified, escape certified or seen."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from sim.arguments import Floats
from sim.system import System

#: Whether a run escapes is asked when its state exceeds this many times max(1, |v|, start), then at each doubling.
_ESCAPE_FACTOR = 30.0
#: A run whose escape cannot be certified is called diverged when its state exceeds this many times the same and the
#: all-slip system is unstable: friction is bounded by mu, so out there the motion is that of the linear system.
_DIVERGENCE_FACTOR = 1e6

#: Eigenvalues are wanted of systems up to this many blocks (2 n x 2 n, dense: seconds). Beyond, nothing is certified,
#: and what passes the bound counts as diverged.
_EIGENVALUES_MAX = 1000

#: Real parts closer to zero than this share of the largest eigenvalue are not told from zero.
_EIGENVALUE_ROUNDING = 1e-12

#: Slack for the rounding of the eigenvectors, by which what friction can hold is taken larger.
_CERTAIN = 1.01

_NEVER = float("inf")


def escape_bounds(system: System, z: Floats, w: Floats) -> tuple[float, float]:
    """Sizes of |z| or |w| of a run from this start: from where to ask for its escape, where to call it diverged."""
    start = max(1.0, abs(system.belt_speed), float(np.abs(z).max()), float(np.abs(w).max()))
    return _ESCAPE_FACTOR * start, _DIVERGENCE_FACTOR * start


def escape(system: System, z: Floats, w: Floats) -> str:
    """Why a run grows for ever from this state, under either law; empty if that is not certain.

    With A the all-slip matrix, A T = T Lambda, x = (z, w) and c = T^-1 x, friction enters as a force of at most mu_k:

        c_j' = Lambda_j c_j - sum_k T^-1_{j, n+k} mu_k lambda_k,    |lambda_k| <= 1,

    whatever sticks. So once |c_j| Re Lambda_j > sum_k |T^-1_{j, n+k}| mu_k for one j, |c_j| grows and keeps growing.
    """
    if system.n > _EIGENVALUES_MAX:
        return ""
    modes = _modes(system)
    if np.isinf(modes.inverse).any():
        return ""
    size = np.abs(modes.inverse @ np.concatenate((z, w)))
    held = np.abs(modes.inverse[:, system.n :]) @ system.friction
    rates = np.where(modes.rates > _EIGENVALUE_ROUNDING * modes.largest, modes.rates, 0.0)
    margin = size * rates - _CERTAIN * held
    mode = int(np.argmax(margin))
    if not margin[mode] > 0:
        return ""
    times = size[mode] * rates[mode] / held[mode] if held[mode] > 0 else _NEVER
    return f"a mode that grows at the rate {rates[mode]:.3g} is {times:.3g} times as far out as friction can hold it"


def grows(system: System) -> bool:
    """Whether the all-slip system is unstable (up to the rounding of its eigenvalues), or too large to tell."""
    if system.n > _EIGENVALUES_MAX:
        return True
    modes = _modes(system)
    return modes.growth > _EIGENVALUE_ROUNDING * modes.largest


def divergence_reason(z: Floats, w: Floats, t: float, bound: float) -> str:
    """Which block left the bound, and when."""
    size = np.maximum(np.abs(z), np.abs(w))
    block = int(np.argmax(~(size <= bound)))
    return f"|z| or |w| of block {block} passed {bound:.3g} at t = {t:.6g}"


@dataclass(frozen=True)
class Certificate:
    """Whether all blocks slip for ever, and if not, after how long it is worth asking again."""

    is_certain: bool
    reason: str
    ask_again_after: float


@dataclass(frozen=True)
class _Modes:
    """The all-slip system A T = T Lambda.

    Re Lambda (2n), its maximum, max |Lambda|, |T| for the velocities (n, 2n), T^-1 (2n, 2n; infinite if A is
    defective), and the bound on |w_i| that unit forces on the blocks cause,
    sum_j |T_{w_i, j}| |T^-1_{j, n+k}| / |Re Lambda_j| (n, n).
    """

    rates: Floats
    growth: float
    largest: float
    velocity_parts: Floats
    inverse: NDArray[np.complex128]
    response: Floats


_MODES: WeakKeyDictionary[System, _Modes] = WeakKeyDictionary()


def _modes(system: System) -> _Modes:
    if system not in _MODES:
        eigenvalues, vectors = np.linalg.eig(system.slip_matrix())
        velocity_parts = np.abs(vectors[system.n :])
        growth, largest = float(eigenvalues.real.max()), float(np.abs(eigenvalues).max())
        try:
            inverse = np.linalg.inv(vectors)
        except np.linalg.LinAlgError:  # a defective matrix: no certificate by this bound
            nothing = np.full_like(vectors, np.inf)
            _MODES[system] = _Modes(eigenvalues.real, growth, largest, velocity_parts, nothing, velocity_parts)
            return _MODES[system]
        with np.errstate(divide="ignore", invalid="ignore"):  # looked at only when every mode decays
            response = (velocity_parts / np.abs(eigenvalues.real)) @ np.abs(inverse[:, system.n :])
        _MODES[system] = _Modes(eigenvalues.real, growth, largest, velocity_parts, inverse, response)
    return _MODES[system]


class Collapse:
    """Certifies that no block of a system sticks again when all slip one way.

    With x' = A x + const the all-slip system, stable, A T = T Lambda, c = T^-1 (x - x_rest): each |c_j| decays, so

        |w_i(t)| <= sum_j |T_{w_i, j}| |c_j|        for ever,

    and below |v| no w_i comes back to the belt's speed. The smoothed law differs from the sign by at most
    2 mu_k exp(-2 m / delta_k) while every |w_k| stays below |v| - m, which adds to the bound
    sum_j |T_{w_i, j}| / |Re Lambda_j| sum_k |T^-1_{j, n+k}| 2 mu_k exp(-2 m / delta_k): certain if for some margin
    m, no less than the band in which a block sticks, the sum stays below |v| - m.

    Parameters
    ----------
    system : System
    band : float or ndarray, shape (n,)
        Half-width of the layer around v in which a block may stick (0 for the Coulomb law).
    delta : ndarray, shape (n,), optional
        Widths of the smoothed law; None for the Coulomb law.
    """

    def __init__(self, system: System, band: Floats | float = 0.0, delta: Floats | None = None) -> None:
        self._system, self._delta = system, delta
        self._widest = float(np.max(band))
        self._rests: dict[int, Floats | None] = {}

    def certify(self, z: Floats, w: Floats, slip: int) -> Certificate:
        """Whether it is certain of a state, shape (n,) each, in which all blocks slip in the direction +1 or -1."""
        system = self._system
        if slip * system.belt_speed >= 0 or self._widest >= abs(system.belt_speed):
            return Certificate(False, "", _NEVER)  # w = 0, the rest, is across the belt or in the layer
        if system.n > _EIGENVALUES_MAX:
            return Certificate(False, "", _NEVER)
        modes = _modes(system)
        if not modes.growth < -_EIGENVALUE_ROUNDING * modes.largest or np.isinf(modes.inverse).any():
            return Certificate(False, "", _NEVER)
        rest = self._rest(slip)
        if rest is None:
            return Certificate(False, "", _NEVER)
        coefficients = np.abs(modes.inverse @ np.concatenate((z - rest, w)))
        reach, limit = float((modes.velocity_parts @ coefficients).max()), self._limit
        if reach < limit:
            reason = (
                f"all blocks slip; |w| stays below {reach:.3g} of at most {limit:.3g}, as the all-slip system decays"
            )
            return Certificate(True, reason, 0.0)
        if limit <= 0:
            return Certificate(False, "", _NEVER)
        # the slowest mode must decay from `reach` to `limit`: no use in asking much earlier
        return Certificate(False, "", 0.25 * float(np.log(reach / limit)) / -modes.growth)

    def _rest(self, slip: int) -> Floats | None:
        """Where all blocks rest that slip one way; None if K is singular."""
        if slip not in self._rests:
            try:
                self._rests[slip] = self._system.rest_state(np.full(self._system.n, slip))
            except np.linalg.LinAlgError:
                self._rests[slip] = None
        return self._rests[slip]

    @cached_property
    def _limit(self) -> float:
        """What every |w_i| must stay below: |v| less the best margin."""
        speed, margin = abs(self._system.belt_speed), self._widest
        if self._delta is not None:
            margins = np.linspace(self._widest, speed, 64, endpoint=False)
            forces = 2 * self._system.friction * np.exp(-2 * margins[:, None] / self._delta)
            slack = speed - margins - (forces @ _modes(self._system).response.T).max(axis=1)
            margin = speed - float(slack.max())
        return speed - margin
