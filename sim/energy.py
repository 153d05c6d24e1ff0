"""Energy of a run under the exact law, segment by segment.

    d/dt (w M w / 2 + z K_s z / 2) = belt + outside - damping - heat + coupling

Its belt does the work v_i f_i on block i, f_i the friction on it: -mu_i sigma_i in slip, `System.holding_force` in
stick, where it balances all else. Forces from outside do theirs. Damping takes w R w; the contact takes heat,
-f_i (w_i - v_i), none in stick. Springs store z K_s z / 2, K_s the symmetric part of K; the skew part, couplings that
are not reciprocal, gives -w K_a z.

Between two events all of this is analytic, so Gauss's quadrature on the states of the series takes it to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.arguments import Floats
from stickslip.sim.drive import Piecewise
from stickslip.sim.run import Run
from stickslip.sim.series import EventSeries
from stickslip.sim.system import System

#: Gauss's nodes a segment, and its length in units of 1 / |eigenvalue|: what is left out is below 1e-12 of a segment.
_NODES, _REACH = 8, 2.0
#: Friction that falls with the speed of slip asks for this many times the rate at which static friction passes it.
_BENDS = 4.0


@dataclass(frozen=True, eq=False)
class Energy:
    """Energy at the times between which it is summed, each of shape (m,); `t` has every event's instant.

    Attributes
    ----------
    t : float64
        From the start of the run to its end.
    kinetic, elastic : float64
        w M w / 2 and z K_s z / 2.
    belt, outside : float64
        Work of the belts, and of forces from outside, on the blocks since the start.
    damping, heat : float64
        What damping and the contacts took since the start.
    coupling : float64
        What couplings that are not reciprocal gave since the start.
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
        """What is there beyond what came in and went out, shape (m,): zero, but for the run's own error."""
        stored = self.kinetic + self.elastic
        return stored - stored[0] - (self.belt + self.outside - self.damping - self.heat + self.coupling)

    def __repr__(self) -> str:
        return f"Energy({len(self.t)} times on [{self.t[0]:g}, {self.t[-1]:g}])"


def times(system: System, series: EventSeries) -> Floats:
    """Where `energy` needs the state of a run with these events: to be its ``t_eval``, which changes nothing else."""
    edges = _edges(system, series)
    inside = edges[:-1, None] + np.diff(edges)[:, None] * _GAUSS[0]
    return np.append(np.column_stack([edges[:-1], inside]).ravel(), edges[-1])


def energy(system: System, run: Run) -> Energy:
    """Energy and its balance along a run of the exact engine, sampled at ``t_eval=times(system, run.events)``.

    Raises
    ------
    ValueError
        If the samples are others.
    """
    edges, samples, n = _edges(system, run.events), run.samples, system.n
    if not np.array_equal(samples.t, times(system, run.events)):
        raise ValueError(
            f"run: expected samples at the {len(times(system, run.events))} times that `times` gives, got"
            f" {len(samples)} others; run again with t_eval=times(system, run.events)"
        )
    at_edges = slice(None, None, _NODES + 1)
    symmetric, skew = (system.stiffness + system.stiffness.T) / 2, (system.stiffness - system.stiffness.T) / 2
    z, w = samples.z[at_edges], samples.w[at_edges]
    stored = 0.5 * (system.mass * w * w).sum(axis=1), 0.5 * (z * (symmetric @ z.T).T).sum(axis=1)
    shape = len(edges) - 1, _NODES + 1, n
    z, w = samples.z[:-1].reshape(shape)[:, 1:], samples.w[:-1].reshape(shape)[:, 1:]
    mode = _modes(run.events, edges)[:, None]
    t, flat = samples.t[:-1].reshape(shape[:2])[:, 1:], (-1, n)
    v, pull = system.belt_speed_at(t), system.force_at(t)
    gain = system.belt_speed.slope_at(t) if isinstance(system.belt_speed, Piecewise) else 0.0

    def times_matrix(matrix: object, x: Floats) -> Floats:
        return np.asarray((matrix @ x.reshape(flat).T).T).reshape(x.shape)  # type: ignore[operator]

    holding = system.damping * v + times_matrix(system.stiffness, z) - pull + system.mass * gain
    force = np.where(mode == 0, holding, -system.kinetic(w - v) * mode)
    powers = (
        (force * v).sum(axis=2),
        (pull * w).sum(axis=2),
        (system.damping * w * w).sum(axis=2),
        np.where(mode == 0, 0.0, force * (v - w)).sum(axis=2),
        -(w * times_matrix(skew, z)).sum(axis=2),
    )
    lengths = np.diff(edges)[:, None] * _GAUSS[1]
    flows = (np.append(0.0, np.cumsum((power * lengths).sum(axis=1))) for power in powers)
    return Energy(edges, *stored, *flows)


def _gauss() -> tuple[Floats, Floats]:
    """Nodes and weights on [0, 1]."""
    x, weights = np.polynomial.legendre.leggauss(_NODES)
    return (x + 1) / 2, weights / 2


_GAUSS = _gauss()


def _edges(system: System, series: EventSeries) -> Floats:
    """The start, the instants of events and bends, the end, and as many places between as segments must be short."""
    bends = np.concatenate(
        [np.empty(0), *(x.times for x in (*system.force, system.belt_speed) if isinstance(x, Piecewise))]
    )
    bends = bends[(bends > series.t_start) & (bends < series.t_end)]
    instants = np.unique(np.concatenate(([series.t_start], series.t, bends, [series.t_end])))
    rate = system.rates.max()
    if system.weakening is not None:
        rate += _BENDS * system.weakening.steepness * (system.static / system.mass).max()
    parts = np.maximum(np.ceil(np.diff(instants) * (rate / _REACH)), 1).astype(int)
    start = np.repeat(instants[:-1], parts)
    share = np.concatenate([np.arange(k) / k for k in parts]) if len(parts) else np.empty(0)
    return np.append(start + share * np.repeat(np.diff(instants), parts), instants[-1])


def _modes(series: EventSeries, edges: Floats) -> NDArray[np.int8]:
    """Modes of all blocks on each segment, shape (len(edges) - 1, n)."""
    modes = np.empty((len(edges) - 1, series.n), dtype=np.int8)
    mode, done = series.initial_mode.copy(), 0
    for k, upto in enumerate(np.searchsorted(series.t, edges[:-1], side="right")):
        mode[series.block[done:upto]] = series.mode[done:upto]
        modes[k], done = mode, upto
    return modes
