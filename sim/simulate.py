"""`simulate`: a system and a start in, an event series out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from inspect import Parameter, signature
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from stickslip.sim.arguments import did_you_mean, floats, number, per_block
from stickslip.sim.run import Run, Samples
from stickslip.sim.system import System

Engine = Literal["coulomb", "sigmoid"]


def simulate(
    system: System,
    z0: ArrayLike,
    w0: ArrayLike,
    t_end: float,
    *,
    t_start: float = 0.0,
    t_eval: ArrayLike = (),
    engine: Engine = "coulomb",
    **settings: object,
) -> Run:
    """Follow a system of blocks from a start state to `t_end` (dimensionless).

    Parameters
    ----------
    system : System
    z0, w0 : float or array_like, shape (n,)
        Displacements and velocities at `t_start`.
    t_end, t_start : float
    t_eval : array_like, shape (m,)
        Times in [t_start, t_end], not decreasing, at which to keep the state: see `Run.samples`.
    engine : "coulomb" or "sigmoid"
        The exact set-valued law, or mu tanh((w - v) / (ratio eps)) in its place.
    **settings
        both: ``stop_early`` (True: ask whether a collapse or an escape is certain; a run that collapsed then goes on
        without steps, one that escapes ends); coulomb: ``tol`` (see
        `stickslip.sim.engines.coulomb.integrate`);
        sigmoid: ``eps``, ``ratio``, ``rtol``, ``atol``, ``stick``, ``threshold``, ``thresholds`` (see
        `stickslip.sim.engines.sigmoid.integrate`).

    Returns
    -------
    Run

    Raises
    ------
    TypeError, ValueError
        If an argument is unknown, or of the wrong kind, shape or size; the message names it.
    IntegrationError
        If the engine cannot go on.
    """
    from stickslip.sim.engines import coulomb, sigmoid  # they load numba, which takes half a second

    engines: dict[str, Callable[..., Run]] = {"coulomb": coulomb.integrate, "sigmoid": sigmoid.integrate}
    if not isinstance(system, System):
        raise TypeError(f"system: expected a sim.System, got {type(system).__name__}")
    if engine not in get_args(Engine):
        raise ValueError(f"engine: expected one of {', '.join(get_args(Engine))}, got {engine!r}")
    _check_names(settings, engine, engines)
    t_start, t_end = number("t_start", t_start), number("t_end", t_end)
    if t_end < t_start:
        raise ValueError(f"t_end: expected a time not before t_start = {t_start}, got {t_end}")
    z, w = per_block("z0", z0, system.n), per_block("w0", w0, system.n)
    times = floats("t_eval", t_eval, "an array of times")
    if times.ndim != 1 or not (np.diff(times) >= 0).all() or not ((times >= t_start) & (times <= t_end)).all():
        raise ValueError(
            f"t_eval: expected times in [{t_start:g}, {t_end:g}] in rising order, got {t_eval!r}; sort them,"
            " and leave out what lies outside"
        )
    return engines[engine](system, z, w, t_start, t_end, Samples.blank(times, system.n), **settings)


def _check_names(settings: Mapping[str, object], engine: str, engines: Mapping[str, Callable[..., Run]]) -> None:
    """TypeError for a setting that the engine does not take; it says what does, or what may have been meant."""
    takes = {name: _keywords(integrate) for name, integrate in engines.items()}
    for name in settings:
        if name not in takes[engine]:
            other = next((other for other in engines if name in takes[other]), None)
            remedy = did_you_mean(name, takes[engine] + _keywords(simulate))
            remedy = remedy or (f'; write engine="{other}"' if other else "; leave it out")
            known = ", ".join(takes[engine])
            raise TypeError(f'{name}: unknown to the engine "{engine}", which takes {known}{remedy}')


@cache  # small systems run in milliseconds
def _keywords(function: Callable[..., Run]) -> tuple[str, ...]:
    parameters = signature(function).parameters.values()
    return tuple(parameter.name for parameter in parameters if parameter.kind is Parameter.KEYWORD_ONLY)
