"""`simulate`: a system and a start in, an event series out."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.engines import ENGINES
from stickslip.sim.engines.adiabatic import Adiabatic
from stickslip.sim.engines.contract import Engine, Task
from stickslip.sim.numerics.arguments import Floats, apart, did_you_mean, floats, number, per_block
from stickslip.sim.numerics.session import numpy_arithmetic
from stickslip.sim.runs.run import Run, Samples
from stickslip.sim.systems.system import System, require_within

#: Keywords of `simulate` itself, to suggest where one is misspelt.
_KEYWORDS = ("t_start", "t_eval", "engine", "modes", "stop_early", "load")


@numpy_arithmetic()
def simulate(
    system: System,
    z0: ArrayLike,
    w0: ArrayLike,
    t_end: float,
    *,
    t_start: float = 0.0,
    t_eval: ArrayLike = (),
    engine: str = "coulomb",
    modes: ArrayLike | None = None,
    stop_early: bool | str = True,
    load: str | None = None,
    **settings: object,
) -> Run:
    """Follow a system of blocks from a start state to `t_end` (dimensionless).

    Parameters
    ----------
    system : System
    z0 : float or array_like, shape (n,)
        Displacements at `t_start`.
    w0 : float or array_like, shape (n,), or "belt"
        Velocities at `t_start`; "belt": each block has that of its belt then, and 0 if it has no friction.
    t_end, t_start : float
    t_eval : array_like, shape (m,)
        Times in [t_start, t_end], not decreasing, at which to keep the state: see `Run.samples`.
    engine : str
        "coulomb", the exact set-valued law; "sigmoid", mu tanh((w - v) / (ratio eps)) in its place; or "moreau",
        time stepping, to compare with; see `stickslip.sim.engines.ENGINES`.
    modes : array_like of int, shape (n,), optional
        For the exact engine, each block's mode at `t_start`: 0 sticks, +1 or -1 slips. They matter for blocks at the
        belt's speed with |F| above kinetic and not above static friction, which may slip; default: they stick.
        Where |F| is at static friction to the tolerance, as in a run that was cut at an event, the state decides.
    stop_early : bool or "always"
        Whether to test if a collapse or an escape is certain; a run that has collapsed then goes on without steps,
        one that escapes ends. A collapse is tested for where that pays: after all blocks have slipped for a while,
        if what is left of the run would cost as much as the test. "always": whenever all blocks slip, so that each
        run whose collapse can be certified has that outcome.
    load : "adiabatic" or None
        How the belt loads. None: at its speed. "adiabatic": it waits while any block slips and, once all stick,
        advances at once to the next instability, as a belt whose speed tends to zero. Times are the belt's travel
        over |v|; see `Run.loaded`. It takes the exact engine, and static friction above the kinetic.
    **settings
        coulomb: ``tol``; sigmoid: ``eps``, ``ratio``, ``rtol``, ``atol``, ``stick``, ``threshold``, ``thresholds``;
        moreau: ``step``. See `stickslip.sim.engines.ENGINES`, the classes `Coulomb`, `Sigmoid` and `Moreau`.

    Returns
    -------
    Run

    Raises
    ------
    TypeError, ValueError
        If an argument is unknown, or of the wrong kind, shape or size.
    IntegrationError
        If the engine cannot go on.
    """
    chosen = as_engine(engine, settings)
    task = as_task(chosen, system, z0, w0, t_end, t_start, t_eval, modes, stop_early)
    return with_names((chosen if load is None else loading(load, chosen)).integrate(task), system.names)


def with_names(run: Run, names: tuple[str, ...]) -> Run:
    """A run whose events have the names of the blocks."""
    return replace(run, events=replace(run.events, names=names)) if names else run


@lru_cache(maxsize=8)  # members of the same settings have one engine
def loading(load: str, engine: Engine) -> Adiabatic:
    """An engine under a way of loading, by its name."""
    if load != "adiabatic":
        raise ValueError(f'load: expected "adiabatic" or None, got {load!r}')
    return Adiabatic(engine)


def as_engine(name: str, settings: Mapping[str, Any]) -> Engine:
    """An engine by its name, with its settings; see `simulate`."""
    if name not in ENGINES:
        raise ValueError(f"engine: expected one of {', '.join(ENGINES)}, got {name!r}")
    _check_names(settings, name)
    known = {key: _hashable(value) for key, value in settings.items()}
    return ENGINES[name](**settings) if None in known.values() else _engine(ENGINES[name], **known)


def _hashable(value: Any) -> Any:
    """A number or a word as it is, and an array of a number a block as a tuple; None for another setting."""
    if type(value) is np.ndarray and value.dtype == np.float64 and value.ndim == 1:
        return tuple(value.tolist())
    return value if type(value) in (float, int, str) else None


@lru_cache(maxsize=64, typed=True)  # so that a system keeps what follows from it and its engine
def _engine(kind: type[Engine], /, **settings: Any) -> Engine:
    return kind(**settings)


def as_task(
    engine: Engine,
    system: System,
    z0: ArrayLike,
    w0: ArrayLike,
    t_end: float,
    t_start: float = 0.0,
    t_eval: ArrayLike = (),
    modes: ArrayLike | None = None,
    stop_early: bool | str = True,
) -> Task:
    """The task for an engine; see `simulate`."""
    if not isinstance(system, System):
        raise TypeError(f"system: expected a sim.System, got {type(system).__name__}")
    require_within(engine.taken(), system, f"engine={engine.name!r}")
    t_start, t_end = number("t_start", t_start), number("t_end", t_end)
    if t_end < t_start:
        raise ValueError(f"t_end: expected a time not before t_start = {t_start}, got {t_end}")
    if isinstance(w0, str):
        if w0 != "belt":
            raise ValueError(f'w0: expected a number, {system.n} numbers or "belt", got {w0!r}; write w0="belt"')
        w0 = system.at_rest(t_start)
    z, w = per_block("z0", z0, system.n), per_block("w0", w0, system.n)
    times = _times(t_eval, t_start, t_end)
    if modes is not None and not engine.is_exact:
        raise ValueError(f"modes: expected None with engine={engine.name!r}, where the state alone says who sticks")
    samples = Samples.blank(times, system.n)
    certify = isinstance(stop_early, str) and stop_early == "always"
    if not certify and not isinstance(stop_early, bool | np.bool_):
        raise TypeError(f'stop_early: expected True, False or "always", got {stop_early!r}')
    at_start = _modes(modes, system.n)
    return Task(system.of_unit_mass, z, w, t_start, t_end, samples, bool(stop_early), certify, at_start)


_NO_TIMES = np.empty(0)


def _times(t_eval: ArrayLike, t_start: float, t_end: float) -> Floats:
    """The times of samples; ValueError unless they are from `t_start` to `t_end` and do not decrease."""
    if isinstance(t_eval, tuple) and not t_eval:
        return _NO_TIMES
    times = floats("t_eval", t_eval, "an array of times")
    if times.shape == (0,):
        return times
    is_outside = ~((times >= t_start) & (times <= t_end))
    if times.ndim != 1:
        bounds, got = [*apart(t_start, t_end)], f"an array of shape {times.shape}; give it the shape (m,)"
    elif is_outside.any():
        *bounds, time = apart(t_start, t_end, times[is_outside][0])
        got = f"{time}; leave out what lies outside"
    elif (np.diff(times) < 0).any():
        k = int(np.argmax(np.diff(times) < 0))
        *bounds, before, after = apart(t_start, t_end, times[k], times[k + 1])
        got = f"{after} after {before}; sort them"
    else:
        return times
    raise ValueError(f"t_eval: expected times in [{bounds[0]}, {bounds[1]}] in rising order, got {got}")


def _modes(modes: ArrayLike | None, n: int) -> NDArray[np.int8] | None:
    """The modes of n blocks as the engine takes them."""
    if modes is None:
        return None
    numbers = floats("modes", modes, f"{n} of the numbers 0, +1 and -1")
    if numbers.shape != (n,) or not np.isin(numbers, (-1, 0, 1)).all():
        raise ValueError(f"modes: expected {n} of the numbers 0, +1 and -1, got {modes!r}")
    return numbers.astype(np.int8)


def _check_names(names: Collection[str], engine: str) -> None:
    """TypeError for a setting that the engine does not take; the message names an engine that does, or a spelling."""
    takes = tuple(ENGINES[engine].settings())
    for name in names:
        if name not in takes:
            other = next((other for other, kind in ENGINES.items() if name in kind.settings()), None)
            remedy = did_you_mean(name, takes + _KEYWORDS)
            remedy = remedy or (f'; write engine="{other}"' if other else "; leave it out")
            known = ", ".join((*takes, "stop_early"))
            raise TypeError(f'{name}: unknown to the engine "{engine}", which takes {known}{remedy}')
