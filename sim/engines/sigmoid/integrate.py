"""A run of the sigmoid engine: the model and workspace of its kernels, from a system and the settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import certificates, course, several
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.forcing import Forcing
from stickslip.sim.engines.frame import frame
from stickslip.sim.engines.polynomials import Polynomials
from stickslip.sim.engines.sigmoid_law import Peaked, Steady
from stickslip.sim.engines.waveform import control as limits
from stickslip.sim.engines.waveform.events import PASSES
from stickslip.sim.engines.waveform.layout import Blocks, Model, Shared, Workspace
from stickslip.sim.engines.waveform.matrices import NONE, Matrix, matrices_of, matrix_of
from stickslip.sim.engines.waveform.runs import WaveformRuns, tables_of
from stickslip.sim.engines.waveform.step import way
from stickslip.sim.numerics.arguments import Floats, per_block
from stickslip.sim.runs.run import Run
from stickslip.sim.systems.friction import hidden_term, over_kinetic, turning_point
from stickslip.sim.systems.once import once_a_system
from stickslip.sim.systems.system import System
from stickslip.sim.systems.weakening import LAW_OF

if TYPE_CHECKING:
    from stickslip.sim.engines.sigmoid.settings import Sigmoid


#: Over the width of the layer: only where all |w| are below may it be certain that blocks come to rest.
_NEAR_REST = 0.1
#: The x up to which a peak of friction is looked for: beyond, tanh x is one.
_WIDEST = 20.0


def runs(tasks: Sequence[Task], engine: Sigmoid) -> list[Callable[[], Run]]:
    """The runs of some tasks: see `Engine.prepare`.

    Raises
    ------
    ValueError
        If there is not one ratio a block, the layer is too wide for its definition of sticking, or a block has
        static friction but no kinetic.
    IntegrationError
        Of a run: if the step shrinks to rounding.
    """
    return several.runs(tasks, partial(_Runs, engine), partial(_alone, engine))


def _alone(engine: Sigmoid, task: Task) -> Run:
    return _Runs(engine, [task]).go_on(0)


class _Layer(NamedTuple):
    """The smoothed friction law of a system, and the first definition of sticking; arrays have shape (n,)."""

    law: NamedTuple
    delta: Floats
    hidden: Floats  #: c of the law
    peak: Floats  #: the |w - v| at which friction has its peak
    band: Floats  #: a block sticks below this |w - v|
    is_manifold: bool  #: whether |F| must also be below static friction
    widest: float  #: the largest delta
    has_peak: bool  #: whether a peak matters
    is_closed: bool  #: whether a side is

    @classmethod
    def of(cls, system: System, engine: Sigmoid) -> _Layer:
        """The layer; ValueError if it is too wide for its definition of sticking."""
        delta = per_block("ratio", engine.ratio, system.n, "r_i > 0") * engine.eps
        is_manifold = engine.stick == "manifold"
        if is_manifold and not (delta < 1).all():
            raise ValueError(
                f"eps, ratio: stick='manifold' needs ratio * eps < 1, got {delta.max():g}; use stick='threshold'"
            )
        band = delta * np.log(1 / delta) if is_manifold else engine.threshold * delta
        law, hidden, peak = _law(system)
        if system.weakening is not None:
            peak = _peak(system, delta, hidden, peak)
        peak, is_closed = peak * delta, bool(system.closed.any())
        has_peak = bool((peak < np.inf).any())
        return cls(law, delta, hidden, peak, band, is_manifold, float(delta.max()), has_peak, is_closed)


def _friction(system: System, layer: _Layer) -> certificates.Friction:
    """Friction of each block; on a closed side the tangent at the belt's speed."""
    delta, hidden = layer.delta, layer.hidden
    steep = (1.0 + hidden) * system.slip_friction[0] / delta

    def force(u: Floats) -> Floats:
        friction = over_kinetic(np.tanh(u / delta), hidden) * system.kinetic(u)
        return np.where(u * system.closed > 0, steep * u, friction)

    def slope(u: Floats) -> Floats:
        lam = np.tanh(u / delta)
        rise = 1.0 - lam * lam
        rises = rise * (1.0 + hidden * (3.0 * rise - 2.0)) / delta * system.kinetic(u)
        falls = np.abs(over_kinetic(lam, hidden)) * system.kinetic_slope(u)
        return np.where(u * system.closed > 0, steep, rises + falls)

    return certificates.Friction(force, slope)


def _inside(engine: Sigmoid) -> tuple[float, float, float]:
    """The internal tolerances, absolute and relative, and the safety factor; see `control`."""
    rtol, atol = limits.CALIBRATION * engine.rtol, limits.CALIBRATION * engine.atol
    return atol, rtol, limits.safety_factor(atol + rtol)


class _Given(NamedTuple):
    """What follows from the systems of some tasks and the settings. Arrays are by task and block, as of a stack."""

    layer: _Layer
    inside: tuple[float, float, float]  #: see `_inside`
    tables: Floats  #: see `tables_of`
    models: Model  #: without forces
    smoothed: list[certificates.Smoothed]
    allowed: list[float]  #: the error in the motion after a collapse
    stalled: str

    @classmethod
    def of(cls, systems: Sequence[System], engine: Sigmoid) -> _Given:
        system = systems[0]  # if it is not plain, it is the only one
        layer, inside = _Layer.of(system, engine), _inside(engine)
        tables, belts = tables_of(systems), [one.fastest_belt for one in systems]
        block = Blocks(tables[..., : system.n])
        _fill_in_the_law(block, system, layer, engine)
        by_force = np.array([layer.is_manifold, *(False for _ in engine.thresholds)])
        bands = np.array([layer.band, *(c * layer.delta for c in engine.thresholds)])
        bands = bands * (block.friction > 0.0)[:, np.newaxis]  # without friction no block sticks
        borne = np.empty_like(bands)
        for k, one in enumerate(systems):
            borne[k] = one.kinetic(bands[k])
        of_law = list(zip(belts, bands.max(axis=(1, 2)).tolist(), strict=True))
        widest_own = float(layer.band.max())
        smoothed = {
            (speed, widest): certificates.Smoothed(speed, layer.delta, layer.hidden, widest_own, widest)
            for speed, widest in set(of_law)
        }
        forcing, is_by_force = Forcing.none(len(systems)), np.tile(by_force, (len(systems), 1))
        models = Model(layer.law, None, *_matrices(systems), forcing, bands, borne, is_by_force)
        stalled = (
            f"the step fell to the rounding of time (rtol = {engine.rtol:g}, atol = {engine.atol:g}); use"
            " engine='coulomb', or raise rtol and atol by tens, which helps unless a belt or a force jumps"
        )
        allowed = [engine.atol + engine.rtol * belt for belt in belts]
        return cls(layer, inside, tables, models, [smoothed[key] for key in of_law], allowed, stalled)


def _fill_in_the_law(block: Blocks, system: System, layer: _Layer, engine: Sigmoid) -> None:
    """Fill in the rows of the smoothed friction law."""
    near, (atol, _, safety) = block.friction, _inside(engine)
    block.steep, block.hidden, block.peak = 1.0 / layer.delta, layer.hidden, layer.peak
    block.passed = limits.PASSED * safety
    block.of_tail = max(1.0, limits.OF_TAIL / safety)
    block.at_peak = limits.OF_ROOT * np.sqrt(engine.atol + engine.rtol)
    fine = np.minimum(limits.FINE * layer.delta ** (2.0 / 3.0), 1.0)
    block.fine = np.where(layer.peak < np.inf, fine, 1.0)
    if system.weakening is not None:
        block.weakening = system.weakening.steepness * layer.delta
        block.far = np.divide(system.slip_friction[1], near, out=np.ones_like(near), where=near > 0)
    # beyond this friction is kinetic, to the tolerance
    block.reach = 1.0 + 0.5 * np.log1p(2.0 * near * (1.0 + 2.0 * layer.hidden) / (safety * atol))


@once_a_system
def _given(system: System, engine: Sigmoid) -> _Given:
    return _Given.of([system], engine)


class _Runs(WaveformRuns):
    kernel = staticmethod(frame(way, __name__))

    def __init__(self, engine: Sigmoid, tasks: Sequence[Task]) -> None:
        systems = self.systems = [task.system for task in tasks]
        system = systems[0]
        given = _given(system, engine) if len(tasks) == 1 else _Given.of(systems, engine)
        super().__init__(tasks, given.tables)
        self.engine, self.is_of_one_type, self.stalled = engine, system.is_plain, given.stalled
        layer, (atol, _, self.safety) = given.layer, given.inside
        self.layer, self.models, self.thresholds = layer, given.models, engine.thresholds
        self.longest = atol / (limits.CREEP * layer.widest)
        if self.drives[0].is_forced:
            self.models = self.models._replace(forcing=course.stack([self.drives[0].forcing]))
        self.modes = _modes(self.block, self.models.bands, layer)
        self.initial_modes = self.modes.copy()
        self.collapse = [
            certificates.Collapse(task.system, error, smoothed, certificates.cost_of(task, limits.CERTIFICATE))
            for task, error, smoothed in zip(tasks, given.allowed, given.smoothed, strict=True)
        ]
        steps = self.begin_clocks(self.modes, atol)
        self.states.counters[:, course.N_PRODUCTS] = 1 if system.cross_damping is None else 2
        n_substeps = 16 * system.n + 256
        self.events_a_step = PASSES * (system.n + n_substeps) * self.modes.shape[1]
        self.work = Workspace.of(self.tables, self.modes, self.drives[0].is_forced, n_substeps)
        self.work.next_h[:], common = limits.FIRST_SUBSTEP * steps[:, np.newaxis], Shared(self.work.shared)
        common.atol, common.rtol, common.safety = given.inside
        self.states.clock[:, limits.JUMPED] = 1.0
        self.settling: dict[int, certificates.Settling] = {}

    def alone(self, k: int) -> Run:
        return _alone(self.engine, self.tasks[k])

    def settles(self, k: int) -> certificates.Flow | None:
        """The motion to the end, if all blocks come to rest without another event by any definition of sticking."""
        system, drive, engine, (z, w, *_) = self.systems[k], self.drives[k], self.engine, self.state(k)
        if np.abs(w).max() > _NEAR_REST * self.layer.widest or not certificates.is_small(system):
            return None
        friction, belt, bands = _friction(system, self.layer), drive.belt_speed, self.models.bands[k]
        if k not in self.settling:
            force = drive.value() if drive.is_forced else np.zeros(system.n)
            allowed = engine.atol + engine.rtol * system.fastest_belt
            self.settling[k] = certificates.Settling(system, belt, force, friction, allowed)
        if (found := self.settling[k].flow(z, w)) is None:
            return None
        flow, of_z, of_w = found
        pull = -friction.force(-belt) + system.damping * belt
        spread = system.row_sums * of_z
        if system.cross_damping is not None:
            spread = spread + system.cross_sums * of_w
        block = Blocks(self.tables[k : k + 1, :, : system.n].copy())
        for u in (-belt - of_w, -belt + of_w):
            for force in (pull - spread, pull + spread):
                block.u0, block.force0 = u, force
                if (_modes(block, bands, self.layer) != self.modes[k]).any():
                    return None
        return flow


def _law(system: System) -> tuple[NamedTuple, Floats, Floats]:
    """The friction law, its c by block, and the x at which it has its peak.

    Raises
    ------
    ValueError
        If a block without kinetic friction has a static one, or a side that is closed.
    """
    friction, weakening = system.slip_friction[0], system.weakening
    law: NamedTuple = Peaked()
    if weakening is not None:
        kinds = [kind for kind, known in LAW_OF.items() if known is type(weakening)]
        law = kinds[0]() if kinds else Polynomials.of(weakening.pieces)
    elif not system.back_slip:
        law = Steady()
    if not system.back_slip and (friction[system.closed != 0] == 0).any():
        block = int(np.flatnonzero((friction == 0) & (system.closed != 0))[0])
        raise ValueError(
            f"back_slip: engine='sigmoid' bars a side by friction that grows, got none at block {block}; give it a"
            " small kinetic friction"
        )
    if not system.is_static_above:
        return law, np.zeros(system.n), np.full(system.n, np.inf)
    if (friction[system.static > friction] == 0).any():
        block = int(np.flatnonzero((friction == 0) & (system.static > 0))[0])
        raise ValueError(
            f"static: engine='sigmoid' smooths the ratio of static to kinetic friction, got {system.static[block]:g}"
            f" above 0 at block {block}; give it a small kinetic friction"
        )
    ratio = np.divide(system.static, friction, out=np.ones(system.n), where=friction > 0)
    hidden = hidden_term(ratio)
    lam = turning_point(hidden)
    return law, hidden, np.arctanh(lam, out=np.full(system.n, np.inf), where=lam < 1)


def _peak(system: System, delta: Floats, hidden: Floats, of_static: Floats) -> Floats:
    """The x at which a law with weakening has its peak; infinite where that does not matter.

    Where friction rises with speed throughout the layer, its peak is that of the static friction, if it has one.
    """
    assert system.weakening is not None
    near, far = system.slip_friction
    low, high = np.zeros(system.n), np.full(system.n, _WIDEST)
    for _ in range(6):  # to some 1e-8
        x = np.linspace(low, high, 64)
        lam = np.tanh(x)
        best = (over_kinetic(lam, hidden) * system.kinetic(delta * x)).argmax(axis=0)
        step = (high - low) / 63
        low, high = low + step * np.maximum(best - 1, 0), low + step * np.minimum(best + 1, 63)
    is_steep = (near - far) * system.weakening.steepness > limits.STEEP
    peak = np.where(is_steep | (hidden > 0.0), 0.5 * (low + high), np.inf)
    return np.where(high < _WIDEST, peak, of_static)


def _modes(block: Blocks, bands: Floats, layer: _Layer) -> NDArray[np.int8]:
    """Modes at the start, by each definition, shape (tasks, definitions, n)."""
    u, pull = block.u0, block.force0
    if layer.is_closed:
        closed = block.closed
        u, pull = np.where(u * closed > 0, 0.0, u), np.where(pull * closed < 0, 0.0, pull)
    held, side = np.abs(u)[:, np.newaxis] < bands, np.sign(u)
    if layer.is_manifold:
        held[:, 0] &= np.abs(pull) < block.static
        if layer.has_peak:
            held[:, 0] &= ~((np.abs(u) > block.peak) & (-pull * side > block.friction))
    side = np.where(u != 0, side, -np.sign(pull))  # at the belt's speed, the side to which it goes next
    return np.where(held, 0, side[:, np.newaxis]).astype(np.int8)


def _matrices(systems: Sequence[System]) -> tuple[Matrix, Matrix, bool]:
    """K and N of a stack, and whether there is an N."""
    if len(systems) == 1:
        return matrices_of(systems[0])
    none: Matrix = course.stack([NONE] * len(systems))
    of_all = matrix_of(np.array([one.stiffness for one in systems]))
    return none._replace(panels=of_all.panels, single_panels=of_all.single_panels), none, False
