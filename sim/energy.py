"""Energy of a run under the exact law, segment by segment.

    d/dt (w M w / 2 + z K_s z / 2) = belt + outside - damping - heat + coupling

The belt of block i does work on it at the rate v_i f_i, f_i the friction on the block: -mu_i sigma_i in slip,
`System.holding_force` in stick, where it balances all other forces. External forces do work too. Damping takes w C w;
the contact dissipates -f_i (w_i - v_i), which is zero in stick. Springs store z K_s z / 2, K_s the symmetric part of
K; the skew part, non-reciprocal coupling, supplies -w K_a z.

Between two events all of this is analytic, so Gauss quadrature on the states of the series is exact to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.engines import DEFAULT, ENGINES
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.session import numpy_arithmetic
from stickslip.sim.runs.run import Run, Samples
from stickslip.sim.runs.series import EventSeries
from stickslip.sim.simulation import simulate
from stickslip.sim.systems.drive import Piecewise
from stickslip.sim.systems.system import System

#: Gauss nodes a segment, and its length in units of 1 / |eigenvalue|: the error is below 1e-12 of a segment.
_NODES, _REACH = 8, 2.0
_NODES_AND_WEIGHTS = np.polynomial.legendre.leggauss(_NODES)
#: The nodes and weights on [0, 1].
_GAUSS = (_NODES_AND_WEIGHTS[0] + 1) / 2, _NODES_AND_WEIGHTS[1] / 2
#: A transient of heavy damping, at any rate, is resolved by segments of this share of the time since it began: where
#: they are long for its rate, it has decayed. Damping is heavy if it exceeds this many times the root of a row sum of
#: |K|.
_SHARE, _HEAVY = 0.5, 4.0
#: Where friction falls with the speed of slip, segments are first divided for this many times the rate at which
#: static friction carries a block through that fall; see `_finer`.
_BENDS = 4.0
#: Samples of displacements that are kept at a time, 16 bytes each with their velocities, and that are processed at a
#: time, some hundred bytes each.
_ROOM, _AT_A_TIME = 2**23, 2**17
#: The most segments of a run: with five blocks they take a minute and a half, and a gigabyte.
_MOST = 2**22


class TooLongError(ValueError):
    """A run is too long for the rates of its blocks: its energy takes more segments than time and memory allow."""


@dataclass(frozen=True, eq=False)
class Energy:
    """Energy at the ends of the segments over which it is summed, shape (m,) each; `t` includes every event.

    Attributes
    ----------
    t : float64
        From the start of the run to its end.
    kinetic, elastic : float64
        w M w / 2 and z K_s z / 2.
    belt, outside : float64
        Work of the belts, and of external forces, on the blocks since the start.
    damping, heat : float64
        Energy dissipated by damping and by the contacts since the start.
    coupling : float64
        Energy supplied by non-reciprocal coupling since the start.
    """

    t: Floats
    kinetic: Floats
    elastic: Floats
    belt: Floats
    outside: Floats
    damping: Floats
    heat: Floats
    coupling: Floats

    @property
    def imbalance(self) -> Floats:
        """Stored energy less its start and all flows, shape (m,): zero, but for the error of the run."""
        stored = self.kinetic + self.elastic
        return stored - stored[0] - (self.belt + self.outside - self.damping - self.heat + self.coupling)

    def __repr__(self) -> str:
        return f"Energy({len(self.t)} times on [{self.t[0]:g}, {self.t[-1]:g}])"


@numpy_arithmetic()
def energy(system: System, run: Run, z0: ArrayLike, w0: ArrayLike, **settings: Any) -> Energy:
    """Energy and its balance along a run of the exact engine, which is repeated for samples of its state.

    Where there are too many samples to keep (some 4,000 events of 200 blocks), it is repeated for each part of them:
    a path may be chaotic, and no other run, not even one that begins at a sample, has the same path.

    Parameters
    ----------
    system : System
    run : Run
        ``simulate(system, z0, w0, t_end, **settings)``
    z0, w0 : float or array_like, shape (n,)
    **settings

    Raises
    ------
    ValueError
        If the run has another start or other settings, if it diverged, or if its engine is not exact.
    TooLongError
        If it takes more than 4,194,304 segments, from event to event or of 2 / rate, where the rate leaves out heavy
        damping. So many occur where a run takes no steps, as after a collapse.
    """
    engine = settings.get("engine", DEFAULT)
    if engine not in ENGINES or not ENGINES[engine].is_exact:
        raise ValueError(f"engine: expected one of the exact law, got {engine!r}")
    if run.outcome == "diverged":
        raise ValueError(f"run: expected one that does not diverge, got one that does by t = {run.t_end:g}")
    series = run.events
    edges, stored, flows = _edges(system, series), [], []
    longest, at_a_time = (max(room // ((_NODES + 1) * system.n), 1) for room in (_ROOM, _AT_A_TIME))
    transposed = system.stiffness.T
    symmetric, skew = (system.stiffness + transposed) / 2, (system.stiffness - transposed) / 2
    first = 0
    while first < max(len(edges) - 1, 1):
        edges_of_part = edges[first : first + longest + 1]
        rerun = simulate(
            system, z0, w0, series.t_end, t_start=series.t_start, t_eval=_nodes(edges_of_part), **settings
        )
        pairs = (rerun.events.t, series.t), (rerun.z, run.z), (rerun.w, run.w)
        if any(a.tobytes() != b.tobytes() for a, b in pairs):
            raise ValueError(
                "run: expected that of this start and these settings, got another; pass those it was made with"
            )
        finer = edges_of_part if system.weakening is None else _finer(system, edges_of_part, rerun.samples)
        if len(finer) > len(edges_of_part):
            edges = np.concatenate([edges[:first], finer, edges[first + longest + 1 :]])
            continue
        modes = series.modes_at(edges_of_part[:-1])
        z, w = rerun.samples.z[:: _NODES + 1], rerun.samples.w[:: _NODES + 1]
        within = slice(None if first + longest >= len(edges) - 1 else -1)  # else the next part begins with it
        stored.append(
            [0.5 * (system.mass * w * w).sum(axis=1)[within], 0.5 * (z * (symmetric @ z.T).T).sum(axis=1)[within]]
        )
        for k in range(0, max(len(edges_of_part) - 1, 1), at_a_time):
            m = min(at_a_time, len(edges_of_part) - 1 - k)
            power = _powers(system, skew, modes[k : k + m], rerun.samples, k * (_NODES + 1))
            flows.append((power * (np.diff(edges_of_part[k : k + m + 1])[:, None] * _GAUSS[1])).sum(axis=2))
        first += longest
    since = (np.append(0.0, np.cumsum(flow)) for flow in np.concatenate(flows, axis=1))
    return Energy(edges, *np.concatenate(stored, axis=1), *since)


def _powers(system: System, skew: Any, mode: NDArray[np.int8], samples: Samples, first: int) -> Floats:
    """The rates of the five flows of `Energy`, at the nodes of the segments from a sample on, shape (5, m, nodes)."""
    shape = len(mode), _NODES + 1, system.n
    its = slice(first, first + shape[0] * shape[1])
    z, w = samples.z[its].reshape(shape)[:, 1:], samples.w[its].reshape(shape)[:, 1:]
    t, mode = samples.t[its].reshape(shape[:2])[:, 1:], mode[:, None]
    v, pull = system.belt_speed_at(t), system.force_at(t)
    gain = system.belt_speed.slope_at(t) if isinstance(system.belt_speed, Piecewise) else 0.0

    def times_matrix(matrix: Any, x: Floats) -> Floats:
        return np.asarray((matrix @ x.reshape(-1, system.n).T).T).reshape(x.shape)

    drag = system.damping_force(w)  # a block that sticks has w = v
    holding = drag + times_matrix(system.stiffness, z) - pull + system.mass * gain
    force = np.where(mode == 0, holding, -system.kinetic(w - v) * mode)
    return np.array(
        [
            (force * v).sum(axis=2),
            (pull * w).sum(axis=2),
            (w * drag).sum(axis=2),
            np.where(mode == 0, 0.0, force * (v - w)).sum(axis=2),
            -(w * times_matrix(skew, z)).sum(axis=2),
        ]
    )


def _nodes(edges: Floats) -> Floats:
    """The edges, and the Gauss nodes between them."""
    inside = edges[:-1, None] + np.diff(edges)[:, None] * _GAUSS[0]
    return np.append(np.column_stack([edges[:-1], inside]).ravel(), edges[-1])


def _edges(system: System, series: EventSeries) -> Floats:
    """The start, events and bends, the end, and as many places between them as make the segments short enough.

    An eigenvalue x of slipping blocks has |x| |x + R_j| <= k_j, the sum of |K_jk| over k, for at least one block j,
    that of the largest component of its eigenvector. If R_j > 4 k_j^(1/2), |x| is below k_j^(1/2), or x within as
    much of -R_j: a transient that begins at an instant, after which segments grow. Where damping couples blocks no R
    counts as heavy.
    """
    bends = np.concatenate(
        [np.empty(0), *(x.times for x in (*system.force, system.belt_speed) if isinstance(x, Piecewise))]
    )
    bends = bends[(bends > series.t_start) & (bends < series.t_end)]
    instants = np.unique(np.concatenate(([series.t_start], series.t, bends, [series.t_end])))
    unit = system.of_unit_mass
    is_heavy = (unit.damping > _HEAVY * np.sqrt(unit.row_sums)) & (unit.cross_damping is None)
    lasting = unit.changed(damping=np.where(is_heavy, 0.0, unit.damping)) if is_heavy.any() else unit
    fall = 0.0
    if system.weakening is not None:
        fall = _BENDS * system.weakening.steepest * (system.static / system.mass).max()
    slow, fast = lasting.fastest_rate + fall, unit.fastest_rate + fall
    if slow < fast:
        instants = _graded(instants, _REACH / fast, _REACH / max(slow, 1e-300))
    return _divided(instants, np.ceil(np.diff(instants) * (slow / _REACH)))


def _graded(instants: Floats, shortest: float, longest: float) -> Floats:
    """The instants, each followed by places whose distances grow from the shortest segment to the longest."""
    top = min(longest / _SHARE, np.diff(instants).max(initial=0.0))
    steps = np.ceil(np.log(max(top / shortest, 1.0)) / np.log1p(_SHARE)) + 1
    after = shortest * (1.0 + _SHARE) ** np.arange(steps)
    counts = np.searchsorted(after, np.diff(instants))
    _require_few(counts.sum() + len(instants), instants)
    places = [start + after[:count] for start, count in zip(instants, counts, strict=False)]
    return np.unique(np.concatenate([instants, *places]))


def _finer(system: System, edges: Floats, samples: Samples) -> Floats:
    """The edges of a part of the run, refined where friction falls too fast for the nodes to resolve.

    Springs may pull by far more than static friction, and so change the speed of a block within a segment.

    A shape S(x) of `stickslip.sim.systems.weakening`, x = steepness |w - v|, is resolved where x changes by at most
    1 + x, or within a piece of it.
    """
    assert system.weakening is not None
    x = system.weakening.steepness * np.abs(samples.w - system.belt_speed_at(samples.t))
    inside = x[:-1].reshape(len(edges) - 1, _NODES + 1, system.n)
    within = np.concatenate([inside, x[_NODES + 1 :: _NODES + 1, np.newaxis]], axis=1)
    low, high = within.min(axis=1), within.max(axis=1)
    return _divided(edges, np.ceil(system.weakening.bends(low, high)).max(axis=1))


def _divided(edges: Floats, parts: Floats) -> Floats:
    """The edges, with each segment divided into as many equal parts, at least one."""
    _require_few(np.maximum(parts, 1).sum(), edges)
    counts = np.maximum(parts, 1).astype(int)
    start = np.repeat(edges[:-1], counts)
    share = np.concatenate([np.arange(k) / k for k in counts]) if len(counts) else np.empty(0)
    return np.append(start + share * np.repeat(np.diff(edges), counts), edges[-1])


def _require_few(n_segments: float, edges: Floats) -> None:
    """TooLongError for more segments than a run may have."""
    if n_segments > _MOST:
        length = edges[-1] - edges[0]
        raise TooLongError(
            f"run: expected one of at most {_MOST:,} segments, got {n_segments:.3g} in a time of {length:g}, as its"
            " blocks can change that fast or have as many events; take its energy up to an earlier t_end"
        )
