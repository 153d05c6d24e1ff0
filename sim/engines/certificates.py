"""When the fate of a run is known before its end: certified collapse, which is followed, and escape."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.course import Precheck
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.systems.once import once_a_system
from stickslip.sim.systems.system import System

#: A run is tested for escape when its state exceeds this many times max(1, |v|, start), and at each doubling.
_ESCAPE_FACTOR = 30.0
#: A run that may end early and whose escape cannot be certified counts as diverged when |w| exceeds this many times
#: the same scale and the all-slip system is unstable: friction is bounded by mu, so the motion there is that of the
#: linear system. (Not |z|: a block that sticks rides the belt as far as the run is long.)
_DIVERGENCE_FACTOR = 1e6
#: Beyond this no run can be followed much longer in float64: it ends, even if it was not to end early.
BEYOND_NUMBERS = 1e100

#: The largest number of blocks whose eigenvalues are computed (2 n x 2 n, dense: a second or two). For more, nothing
#: is certified, and a run that passes the bound counts as diverged.
_EIGENVALUES_MAX = 500

#: The rounding of an eigenvalue, over |A| and its condition number, the length of its row of T^-1: real parts closer
#: to zero count as zero. Rounding spreads m nearly equal eigenvalues over a circle of radius about 1e-16^(1/m).
_EIGENVALUE_ROUNDING = 32 * np.finfo(np.float64).eps

#: Unit eigenvectors are no usable basis if an entry of the inverse of their matrix exceeds this: its rounding, 1e-16
#: of it, would decide.
_DEFECTIVE = 1e10

#: Slack for the rounding of the eigenvectors: the force of friction is taken this much larger.
_CERTAIN = 1.01

#: The rounding of a motion that is a sum of eigenmodes, relative to the sum of their magnitudes.
_SUM_ROUNDING = 16 * np.finfo(np.float64).eps

#: Shares of the belt's speed that are tried as a bound of |w|.
_SHARES = np.geomspace(1.0, 1e-6, 256)

#: Where tanh'' is largest: 1 / cosh^2 is concave below.
_INFLECTION = 0.66

_NEVER = float("inf")


def is_small(system: System) -> bool:
    """Whether eigenvalues are computed of a system of that size."""
    return system.n <= _EIGENVALUES_MAX


def _sizes(systems: Sequence[System], z: Floats, w: Floats) -> Floats:
    """The largest of |z|, |w|, belts and forces at the starts of runs, shape (m, n), and 1."""
    scales = [
        max(1.0, system.fastest_belt, float(system.most_force.max()) if system.force else 0.0) for system in systems
    ]
    return np.maximum(scales, np.maximum(np.abs(z), np.abs(w)).max(axis=1))


@np.errstate(over="ignore")  # beyond float64 there is no bound, and the engine says so of the state
def escape_bounds(systems: Sequence[System], z: Floats, w: Floats) -> Floats:
    """By run, from starts of shape (m, n): the |z| or |w| at which it is first tested for escape."""
    return _ESCAPE_FACTOR * _sizes(systems, z, w)


@np.errstate(over="ignore")  # as above
def divergence_bound(system: System, z: Floats, w: Floats) -> float:
    """The |w| at which a run from this start has diverged: far above that of a block that swings back from z."""
    (size,) = _sizes([system], z[np.newaxis], w[np.newaxis])
    return float(_DIVERGENCE_FACTOR * max(size, np.abs(z).max() * system.fastest_rate))


def escape(system: System, z: Floats, w: Floats) -> str:
    """Why a run grows for ever from this state, under either law; empty if that is not certain.

    With A the all-slip matrix, A T = T Lambda, x = (z, w) and c = T^-1 x, friction enters as a force of at most mu_k,
    the static friction, and an external force is one of at most f_k:

        c_j' = Lambda_j c_j - sum_k T^-1_{j, n+k} (mu_k + f_k) lambda_k,    |lambda_k| <= 1,

    whichever blocks stick and however belts move. Once |c_j| Re Lambda_j > sum_k |T^-1_{j, n+k}| (mu_k + f_k) for one
    j, |c_j| grows for ever.
    """
    if system.n > _EIGENVALUES_MAX:
        return ""
    eigenmodes = _eigenmodes(system)
    if np.isinf(eigenmodes.inverse).any() or not system.back_slip:  # what bars a side is a force without bound
        return ""
    size = np.abs(eigenmodes.inverse @ np.concatenate((z, w)))
    friction = np.abs(eigenmodes.inverse[:, system.n :]) @ (system.most_resistance + system.most_force)
    rates = np.where(eigenmodes.eigenvalues.real > eigenmodes.rounding, eigenmodes.eigenvalues.real, 0.0)
    margin = size * rates - _CERTAIN * friction
    mode = int(np.argmax(margin))
    if not margin[mode] > 0:
        return ""
    times = size[mode] * rates[mode] / friction[mode] if friction[mode] > 0 else _NEVER
    return f"a mode that grows at the rate {rates[mode]:.3g} is {times:.3g} times as far out as friction can hold it"


def cost_of(task: Task, least: float) -> float:
    """What a certificate of collapse costs, in products of a dense K: measured, n = 2 to 400, within a factor of two.

    `least` is the cost for few blocks. 0 if the task asks for one whenever all blocks slip.
    """
    return 0.0 if task.certify else least + 120.0 * task.system.n


def grows(system: System) -> bool:
    """Whether the all-slip system is unstable (beyond the rounding of its eigenvalues), or too large to tell."""
    if not system.back_slip:
        return False
    if system.n > _EIGENVALUES_MAX:
        return True
    eigenmodes = _eigenmodes(system)
    return bool((eigenmodes.eigenvalues.real > eigenmodes.rounding).any())


def divergence_reason(z: Floats, w: Floats, t: float, bound: float) -> str:
    """Which block passed the bound, and when."""
    size = np.maximum(np.abs(z), np.abs(w))
    block = int(np.argmax(~(size <= bound)))
    return f"|z| or |w| of block {block} passed {bound:.3g} at t = {t:.6g}"


def steady_sliding(system: System, z: Floats, w: Floats, mode: NDArray[np.int8]) -> str:
    """Why blocks slip for ever from this state, w tending to 0, under the exact law; empty if that is not certain.

    As in `Collapse`, but each block may have its own belt, of constant speed, and friction may fall with speed: A is
    that at rest, and friction deviates from its tangent there by rho_k(r_k) at most while |w_k| <= r_k < |v_k|. Then
    |w_i| stays below r_i if the eigenmodes and B rho(r) together are below.
    """
    slip = -np.sign(system.belt_speed_at(0.0))
    if not (slip * mode > 0).all() or system.n > _EIGENVALUES_MAX:
        return ""
    if (sliding := _sliding(system)) is None:
        return ""
    reach = sliding.sizes @ np.abs(sliding.inverse @ np.concatenate((z - sliding.rest, w)))
    if not (is_below := (_CERTAIN * reach < sliding.bound).all(axis=1)).any():
        return ""
    within = float(_SHARES[is_below].min())
    return f"all blocks slip; |w| stays below {within:.3g} of the belt's speed, as the all-slip system decays"


@dataclass(frozen=True, eq=False)
class _Sliding:
    """What `steady_sliding` takes of a system: of T, the rows of w, as sizes; T^-1; the rest; r less B rho(r)."""

    sizes: Floats
    inverse: NDArray[np.complex128]
    rest: Floats
    bound: Floats


@once_a_system
def _sliding(system: System) -> _Sliding | None:
    """None if not all eigenmodes decay, or there is no state of rest."""
    unit, speed = system.of_unit_mass, np.broadcast_to(np.abs(system.belt_speed_at(0.0)), system.n)
    if system.weakening is None:
        eigenmodes = _eigenmodes(unit)
    else:
        eigenmodes = _Eigenmodes(unit.slip_matrix(unit.kinetic_slope(speed)))
    if not eigenmodes.decay:
        return None
    try:
        rest = unit.rest_under(unit.kinetic(speed) * np.sign(system.belt_speed_at(0.0)))
    except np.linalg.LinAlgError:
        return None
    bound = speed * _SHARES[:, np.newaxis]
    if system.weakening is not None:
        tangent = unit.kinetic_slope(speed) * bound
        deviation = np.maximum(
            *(np.abs(unit.kinetic(speed + s * bound) - unit.kinetic(speed) - s * tangent) for s in (-1, 1))
        )
        most = np.maximum.accumulate(deviation[::-1])[::-1]  # of all smaller |w|
        bound = bound - _CERTAIN * most @ eigenmodes.response()[unit.n :].T
    return _Sliding(eigenmodes.sizes[unit.n :], eigenmodes.inverse, rest, bound)


@dataclass(frozen=True)
class Flow:
    """The motion of blocks that slip for ever: x(t) = rest + T exp(Lambda t) c, x = (z, w), t from now."""

    rest: Floats
    vectors: NDArray[np.complex128]
    eigenvalues: NDArray[np.complex128]
    coefficients: NDArray[np.complex128]

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """z and w, shape (m, n) each, at times from now, shape (m,)."""
        times = np.minimum(times, 1e300 / max(1.0, np.abs(self.eigenvalues).max()))  # all has faded long before
        modes = (np.exp(np.multiply.outer(times, self.eigenvalues)) * self.coefficients) @ self.vectors.T
        n = len(self.rest)
        return self.rest + modes.real[:, :n], modes.real[:, n:]


@dataclass(frozen=True)
class Certificate:
    """Whether no block sticks again, with the motion to the end, or with the time after which to ask again."""

    is_certain: bool
    reason: str = ""
    flow: Flow | None = None
    ask_again_after: float = _NEVER


class _Eigenmodes:
    """Eigenvalues and eigenvectors of the all-slip system, A T = T Lambda.

    `rounding` bounds the error of each Lambda_j. It and T^-1 are infinite if A is defective, or too nearly so.
    `sizes` and `inverse_sizes` are |T_ij| and |T^-1_ij|, `growth` is max Re Lambda, and `decay` says whether all
    eigenmodes decay, beyond rounding, and are distinct.
    """

    def __init__(self, matrix: Floats) -> None:
        eigenvalues, vectors = np.linalg.eig(matrix)
        eigenvalues, vectors = eigenvalues.astype(np.complex128), vectors.astype(np.complex128)
        try:
            inverse = np.linalg.inv(vectors)
        except np.linalg.LinAlgError:
            inverse = np.full_like(vectors, np.inf)
        sizes = np.abs(inverse)
        if not sizes.max() < _DEFECTIVE:  # no certificate by these bounds
            inverse, sizes = np.full_like(vectors, np.inf), np.full_like(matrix, np.inf)
        self.eigenvalues: NDArray[np.complex128] = eigenvalues
        self.vectors: NDArray[np.complex128] = vectors
        self.inverse: NDArray[np.complex128] = inverse
        self.sizes, self.inverse_sizes = np.abs(self.vectors), sizes
        lengths = np.sqrt((sizes * sizes).sum(axis=1))
        self.rounding = _EIGENVALUE_ROUNDING * np.linalg.norm(matrix) * lengths
        self.growth = float(self.eigenvalues.real.max())
        self.decay = bool((self.eigenvalues.real < -self.rounding).all())

    def response(self) -> Floats:
        """Bounds the |z_i|, |w_i| that unit forces cause: sum_j |T_ij| |T^-1_{j, n+k}| / |Re Lambda_j|, (2n, n)."""
        n = len(self.eigenvalues) // 2
        return np.asarray((self.sizes / np.abs(self.eigenvalues.real)) @ self.inverse_sizes[:, n:])


@once_a_system
def _eigenmodes(system: System) -> _Eigenmodes:
    return _Eigenmodes(system.slip_matrix())


def _rise(x: Floats) -> Floats:
    """sech^2 x, the slope of tanh."""
    return np.asarray(1.0 / np.cosh(np.minimum(x, 300.0)) ** 2)


class Smoothed:
    """What certificates need of the smoothed friction law under a belt: the same for all runs that have both.

    `speed` is |v|, `delta` has the widths of the layer, shape (n,), and `hidden` c of the law s(tanh x) with
    s = l + c l (1 - l^2), shape (n,), or None for tanh x. A block sticks in a layer around v of the half-width `band`
    at most, by the run's own definition, and `widest` by any whose events are recorded.
    """

    def __init__(
        self, speed: float, delta: Floats, hidden: Floats | None = None, band: float = 0.0, widest: float = 0.0
    ) -> None:
        self.speed, self.band, self.widest, self._given = speed, band, max(band, widest), (delta, hidden)

    @cached_property
    def _laws(self) -> tuple[Floats, Floats]:
        """delta and c, shape (1,) if all blocks have one law."""
        delta, hidden = self._given
        c = np.zeros_like(delta) if hidden is None else hidden
        is_one = (delta == delta[0]).all() and (c == c[0]).all()
        return (delta[:1], c[:1]) if is_one else (delta, c)

    @property
    def is_one(self) -> bool:
        """Whether all blocks have one law: `at_rest` and `slope` then have shape (1,), else (n,)."""
        return len(self._laws[0]) == 1

    @cached_property
    def _rise(self) -> Floats:
        return _rise(self.speed / self._laws[0])

    @cached_property
    def at_rest(self) -> Floats:
        """Friction at rest, over mu."""
        delta, c = self._laws
        lam = np.tanh(self.speed / delta)
        return np.asarray(lam + c * lam * self._rise)

    @cached_property
    def slope(self) -> Floats:
        """The slope of friction there, over mu."""
        delta, c = self._laws
        return np.asarray(self._rise * (1.0 + c * (3.0 * self._rise - 2.0)) / delta)

    @cached_property
    def bends(self) -> list[tuple[Floats, Floats]]:
        """Bounds r of |w|, shape (m,), below `band`, and below `widest`, with rho(r) / mu by rows of all bounds."""
        delta, c = (row[:, np.newaxis] for row in self._laws)
        rise, steepness = self._rise[:, np.newaxis], np.abs(1.0 - 2.0 * c)
        slope = (steepness * rise + 3.0 * c * rise**2) / delta

        def concave(u: Floats | float) -> Floats:
            lam = np.tanh(u / delta)
            return steepness * lam + c * (3.0 * lam - lam * lam * lam) if c.any() else lam

        at_rest = concave(self.speed)

        def bend(band: float) -> tuple[Floats, Floats]:
            r = (self.speed - band) * _SHARES
            bend = np.abs(at_rest - concave(self.speed - r) - slope * r)
            if (band < _INFLECTION * delta).any():  # then the deviation may be larger on the other side
                bend = np.maximum(bend, np.abs(concave(self.speed + r) - at_rest - slope * r))
            return r, bend

        of_band = bend(self.band)
        return [of_band, of_band if self.widest == self.band else bend(self.widest)]


class Friction(NamedTuple):
    """Smooth friction as a function of u = w - v, shape (n,), and its slope."""

    force: Callable[[Floats], Floats]
    slope: Callable[[Floats], Floats]


class Settling:
    """Certifies that all blocks come to rest, w = 0, under smooth friction and constant forces, and follows them.

    The motion is that linearised at rest, x' = A x, as long as friction deviates from its tangent by little. With
    |w_i| <= r by its eigenmodes, and rho_k the largest deviation of friction for |w_k| <= 2 r, that causes a w of at
    most B rho, as in `Collapse`; if that is below r, |w_i| <= 2 r for ever. Where no spring pulls z stays as it is.
    Speeds of the belts, and external forces, have shape (n,); `allowed` is the error of the motion that is followed.
    """

    def __init__(self, system: System, belt: Floats, force: Floats, friction: Friction, allowed: float) -> None:
        self._belt, self._friction, self._allowed = belt, friction, allowed
        self._slope, pull = friction.slope(-belt), force - friction.force(-belt)
        stiffness = system.slip_matrix()[system.n :, : system.n] * -1.0
        rest, _, rank, _ = np.linalg.lstsq(stiffness, pull)
        self._rest: Floats = rest.astype(np.float64, copy=False)
        holds = np.abs(stiffness @ self._rest - pull).max() <= _SUM_ROUNDING * system.n * np.abs(pull).max()
        eigenmodes = self._eigenmodes = _Eigenmodes(system.slip_matrix(self._slope))
        still = np.abs(eigenmodes.eigenvalues) <= eigenmodes.rounding
        decays = (eigenmodes.eigenvalues.real < -eigenmodes.rounding) & ~still
        self._is_stable = bool(holds and (decays | still).all() and still.sum() == system.n - rank)
        if self._is_stable:
            eigenmodes.eigenvalues[still], eigenmodes.vectors[system.n :, still] = 0.0, 0.0
            rates = np.abs(eigenmodes.eigenvalues.real)
            rates[still] = rates.min(where=~still, initial=np.inf)
            self._response = (eigenmodes.sizes / rates) @ eigenmodes.inverse_sizes[:, system.n :]

    def flow(self, z: Floats, w: Floats) -> tuple[Flow, float, float] | None:
        """The motion from a state, shape (n,) each, and bounds of |z - rest| and |w|; None if that is not certain."""
        if not self._is_stable:
            return None
        n, eigenmodes = len(z), self._eigenmodes
        coefficients = eigenmodes.inverse @ np.concatenate((z - self._rest, w))
        decaying = np.where(eigenmodes.eigenvalues == 0.0, 0.0, np.abs(coefficients))
        reach = eigenmodes.sizes @ decaying
        r = float(reach[n:].max())
        u, step = -self._belt, 2.0 * r * np.concatenate((_SHARES, -_SHARES))[:, np.newaxis]
        deviation = np.abs(self._friction.force(u + step) - self._friction.force(u) - self._slope * step).max(axis=0)
        strays = _CERTAIN * self._response @ deviation
        if not (strays[n:].max() <= r and strays.max() <= self._allowed):
            return None
        flow = Flow(self._rest, eigenmodes.vectors, eigenmodes.eigenvalues, coefficients)
        return flow, float((reach + strays)[:n].max()), 2.0 * r


class Collapse:
    """Certifies that no block of a system sticks again when all slip one way, and follows it from there.

    With x' = A x + const the all-slip system, stable, A T = T Lambda, c = T^-1 (x - x_rest): each |c_j| decays, so

        |w_i(t)| <= sum_j |T_{w_i, j}| |c_j|        for ever,

    and below |v| no w_i comes back to the belt's speed. Under the smoothed law A is linearised about its own rest,
    K z = mu tanh(|v| / delta): damping R + mu sech^2(v / delta) / delta. While every |w_k| <= r < |v| the law, which
    is concave there, deviates from its tangent by at most

        rho_k(r) = mu_k (tanh(|v| / delta_k) - tanh((|v| - r) / delta_k) - sech^2(v / delta_k) r / delta_k)

    This adds B rho(r) to the bound, B_ik = sum_j |T_{w_i, j}| |T^-1_{j, n+k}| / |Re Lambda_j|. The collapse is
    certain if the sum stays below r for some r that leaves |v| by at least the band in which a block sticks. The
    motion to the end is the sum of the eigenmodes once z and w deviate from it by no more than `allowed`.

    A law with a peak, s(l) = l + c l (1 - l^2) of l = tanh x, curves down or up, but no more than the concave
    |1 - 2 c| l + c (3 l - l^3), whose deviation from its tangent bounds its own.

    `allowed` is the error of the motion that is followed, and `cost` that of a certificate, in products of K: if that
    is 0, one is asked for whenever all blocks slip, see `course`.
    """

    def __init__(self, system: System, allowed: float, law: Smoothed | None = None, cost: float = 0.0) -> None:
        self._system, self._allowed, self._law = system, allowed, law
        # else slipping blocks are not linear, or rest, w = 0, lies across the belt's speed or in the layer
        may = system.has_one_belt and system.weakening is None and system.n <= _EIGENVALUES_MAX
        may = may and (0.0 if law is None else law.band) < abs(system.belt_speed)
        #: By which kernels see for themselves that a certificate is out of reach, or not to be had.
        self.precheck = Precheck.blank((system.belt_speed < 0) - (system.belt_speed > 0) if may else 0, cost)

    def certify(self, z: Floats, w: Floats) -> Certificate:
        """Certificate of a state, shape (n,) each, in which all blocks slip in the direction `precheck.slip`."""
        n, eigenmodes = self._system.n, self._eigenmodes
        self.precheck = self.precheck._replace(cost=0.0)  # to ask again costs little
        if not eigenmodes.decay or (rest := self._rest) is None:
            return Certificate(False)
        coefficients = eigenmodes.inverse @ np.concatenate((z - rest, w))
        reach = float((eigenmodes.sizes[n:] @ np.abs(coefficients)).max())
        limit, limit_of_flow = self._limits
        reason = ""
        if reach < limit:
            reason = (
                f"all blocks slip; |w| stays below {reach:.3g} of at most {limit:.3g}, as the all-slip system decays"
            )
        flow = None
        if reach < limit_of_flow:
            at_rest = np.concatenate((np.abs(z) + np.abs(rest), np.abs(w)))
            rounding = (eigenmodes.sizes @ (eigenmodes.inverse_sizes @ at_rest)).max() * _SUM_ROUNDING
            if rounding <= self._allowed:
                flow = Flow(rest, eigenmodes.vectors, eigenmodes.eigenvalues, coefficients)
        wanted = limit_of_flow if reach < limit else limit
        if flow is not None or wanted <= 0 or reach < wanted:
            return Certificate(bool(reason), reason, flow)
        if not reason and limit >= limit_of_flow:
            inverse, slip, room = eigenmodes.inverse, self.precheck.slip, np.empty(2 * n)
            parts = np.array([inverse.real, inverse.imag])
            self.precheck = Precheck(parts, eigenmodes.sizes[n:], rest, slip, limit, eigenmodes.growth, 0.0, room)
        # the slowest eigenmode must decay from `reach` to what is wanted: no use in asking much earlier
        return Certificate(bool(reason), reason, None, 0.25 * math.log(reach / wanted) / -eigenmodes.growth)

    @cached_property
    def _eigenmodes(self) -> _Eigenmodes:
        """Of the system linearised at rest, where all blocks slip."""
        if self._law is None:
            return _eigenmodes(self._system)
        return _Eigenmodes(self._system.slip_matrix(self._system.friction * self._law.slope))

    @cached_property
    def _rest(self) -> Floats | None:
        """z at rest under friction in that direction; None if K is singular."""
        share = np.ones(self._system.n) if self._law is None else self._law.at_rest
        try:
            return self._system.rest_under(-self._system.friction * (self.precheck.slip * share))
        except np.linalg.LinAlgError:
            return None

    @cached_property
    def _limits(self) -> tuple[float, float]:
        """Bounds of |w_i| by the eigenmodes alone: for the certificate, and for following the motion."""
        speed, law, n = abs(self._system.belt_speed), self._law, self._system.n
        if law is None:
            return speed, speed
        response = self._eigenmodes.response() * self._system.friction
        if law.is_one:
            response = response.sum(axis=1, keepdims=True)

        def tried(r: Floats, bend: Floats) -> tuple[Floats, Floats]:
            """How far the eigenmodes may reach, and how far the motion then deviates from them, for each bound r."""
            deviation = response @ bend
            of_w = deviation[n:].max(axis=0)
            return r - of_w, np.maximum(of_w, deviation[:n].max(axis=0))

        of_own, of_widest = law.bends
        own, deviation = tried(*of_own)
        limit = float(own.max(initial=0.0))
        if law.widest >= speed:
            return limit, 0.0
        wide, deviation = (own, deviation) if of_widest is of_own else tried(*of_widest)
        return limit, float(np.where(deviation <= self._allowed, wide, 0.0).max(initial=0.0))
