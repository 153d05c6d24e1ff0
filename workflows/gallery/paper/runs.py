"""Random systems from the paper's start: which runs are asked for, and n_stick of each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from stickslip import sim
from stickslip.analysis.models.fates import is_all_slip
from stickslip.analysis.series.nulls import block_steps
from stickslip.pipeline.ensemble.member import MATRIX, PERTURBATION
from stickslip.pipeline.running.executor import Children
from stickslip.pipeline.scene.engine_table import TOLERANCES
from stickslip.workflows.gallery.charts.peers import W0, Z0, Floats, random_ratios, seed_of

#: The ensemble that gives all of figure 3; the constants of section 4.
ENSEMBLE = "antisymmetric"
#: How K may be drawn as the text has it, by coupling.
OF_TEXT = (ENSEMBLE, "antisymmetric_triangle", "signed_diagonal", "full", "symmetric", "springs")
SCALES: Mapping[str, float] = MappingProxyType({"kappa": 0.2, "rho": 3.5, "friction": 1.0, "belt_speed": -0.2})
#: Sigmoids of slope one in the middle that no engine has.
SIGMOIDS: Mapping[str, Callable[[Floats], Floats]] = MappingProxyType(
    {
        "tanh": np.tanh,
        "algebraic": lambda u: u / np.sqrt(1.0 + u * u),
        "arctan": lambda u: 2.0 / np.pi * np.arctan(0.5 * np.pi * u),
    }
)
#: Runs that escape are stiff and short: at this tolerance they leave within 0.1 of when they do at 1e-4.
_ESCAPE_TOLERANCE = 1e-3
#: n_stick of those sigmoids is sampled so often.
_STEP = 0.1
#: What the seeds of changed details are for, beside the words in `stickslip.pipeline.ensemble.member`.
_DETAIL = 1001


@dataclass(frozen=True)
class Ask:
    """One run: system `matrix` of the ensemble at n, or of another coupling, with something about it changed.

    Attributes
    ----------
    study, setting : str
        What it is for, and which of the study's settings it has.
    law : str
        "coulomb", "sigmoid" (the engines), or one of `SIGMOIDS` by SciPy.
    scale, factor
        Which of `SCALES` is multiplied by what; none if `scale` is empty.
    detail : str
        "start" or "friction": drawn for each block; "r": the widths of the sigmoid drawn.
    reading, size, draw
        Of a perturbation, as `sim.perturb_system` takes them; none if `reading` is empty.
    keeps_exits
        Whether its `Path` says which block lets go when.
    """

    study: str
    setting: str
    n: int
    matrix: int
    t_end: float
    law: str = "coulomb"
    coupling: str = ENSEMBLE
    scale: str = ""
    factor: float = 1.0
    detail: str = ""
    reading: str = ""
    size: float = 0.0
    draw: int = 0
    keeps_exits: bool = False


#: Times and blocks of exits, each (m,).
Exits = tuple[Floats, np.ndarray]


class Path(NamedTuple):
    """n_stick of a run at its change points, and when it ended; times and blocks of its exits if they are asked for.

    `growth_rate` is that of the all-slip state, of a run by the exact law that has not ended but does not stick over
    its last quarter.
    """

    ask: Ask
    outcome: str
    t: Floats
    n_stick: np.ndarray
    t_stop: float
    exits: Exits | None = None
    growth_rate: float | None = None


def run_all(asks: Sequence[Ask], seed: int, eps: float, workers: int) -> Iterator[Path]:
    """Each run, in order, by so many processes, of which this is one."""
    paths: dict[int, Path] = {}
    n_given = 0
    with Children(workers - 1, _load) as processes:
        for results in processes.map(partial(run, seed=seed, eps=eps), asks):
            paths |= results
            while n_given in paths:
                yield paths.pop(n_given)
                n_given += 1


def _load() -> None:
    """In a child: what runs need is loaded with this module."""


def system(ask: Ask, seed: int) -> sim.System:
    scales = {name: value * (ask.factor if name == ask.scale else 1.0) for name, value in SCALES.items()}
    friction: Floats | float = scales.pop("friction")
    if ask.detail == "friction":
        friction = friction * _generator(ask, seed).uniform(0.8, 1.2, ask.n)
    drawn_system = sim.draw_system(
        ask.coupling, ask.n, seed_of(seed, MATRIX, ask.n, ask.matrix), friction=friction, **scales
    )
    if not ask.reading:
        return drawn_system
    key = seed_of(seed, PERTURBATION, ask.n, ask.matrix, ask.draw)
    return sim.perturb_system(drawn_system, ask.coupling, ask.size, key, reading=ask.reading)


def _generator(ask: Ask, seed: int) -> np.random.Generator:
    return np.random.default_rng(seed_of(seed, _DETAIL, ask.n, ask.matrix))


def run(ask: Ask, seed: int, eps: float) -> Path:
    """Run it from the paper's start."""
    blocks = system(ask, seed)
    if ask.law in SIGMOIDS:
        return Path(ask, *smoothed(blocks, SIGMOIDS[ask.law], eps, ask.t_end))
    z0: Floats | float = _generator(ask, seed).uniform(-1.0, 1.0, ask.n) if ask.detail == "start" else Z0
    picked = TOLERANCES["statistics"]
    if ask.law == "coulomb":
        result = sim.simulate(blocks, z0, W0, ask.t_end, tol=picked["tol"], stop_early="always")
    else:
        ratio = random_ratios(seed, ask.n, ask.draw) if ask.detail == "r" else 1.0
        rtol, atol = picked["rtol"], picked["atol"]
        if blocks.cross_damping is not None:
            rtol = atol = _ESCAPE_TOLERANCE
        result = sim.simulate(blocks, z0, W0, ask.t_end, engine="sigmoid", eps=eps, ratio=ratio, rtol=rtol, atol=atol)
    events = result.events
    t, n_stick = events.change_points()
    exits = rate = None
    if ask.keeps_exits:
        exits = block_steps(events.t, events.block, events.mode, events.initial_mode, 0.0, events.t_end).exits
    if ask.law == "coulomb" and result.outcome == "finished" and is_all_slip(t[-1], n_stick[-1], ask.t_end):
        rate = float(np.linalg.eigvals(blocks.slip_matrix()).real.max())
    return Path(ask, result.outcome, t, n_stick, events.t_end, exits, rate)


def smoothed(
    blocks: sim.System, sigmoid: Callable[[Floats], Floats], eps: float, t_end: float
) -> tuple[str, Floats, np.ndarray, float]:
    """Outcome, times, n_stick and end of a run under a sigmoid, by SciPy.

    The friction is mu sigmoid((w - v) / eps); a block sticks as under the sigmoid engine.
    """
    n, mu, v = blocks.n, blocks.friction, blocks.belt_speed
    stiffness = np.asarray(blocks.stiffness)

    def rate(t: float, y: Floats) -> Floats:
        w = y[n:]
        return np.concatenate((w, -stiffness @ y[:n] - blocks.damping * w - mu * sigmoid((w - v) / eps)))

    times = _STEP * np.arange(round(t_end / _STEP) + 1)
    start = np.concatenate((np.full(n, Z0), np.full(n, W0)))
    solution = solve_ivp(rate, (0.0, times[-1]), start, t_eval=times, rtol=1e-6, atol=1e-6)
    z, w = solution.y[:n], solution.y[n:]
    is_held = np.abs(blocks.damping[:, None] * v + stiffness @ z) < mu[:, None]
    n_stick = (is_held & (np.abs(w - v) < eps * np.log(1.0 / eps))).sum(axis=0)
    return "finished", solution.t, n_stick, float(solution.t[-1])
