"""Methods tried on a problem, one setting after the other, and held against a reference: in z, and in events."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Literal, TypeVar

import numpy as np

from stickslip import sim
from stickslip.workflows.gallery.charts.cost import Product, Timing, timed
from stickslip.workflows.gallery.charts.peers import GivenUp, Method, MethodError, Problem, Solution, solved, warm

Outcome = Literal["measured", "right", "rough", "wrong", "not judged", "failed", "too slow", "absent"]
#: The name of a method and a tolerance.
Setting = tuple[str, float]


@dataclass(frozen=True, kw_only=True)
class Trial(Timing):
    """One method at one setting on one problem.

    `tolerance` is null for a method of a fixed step, which has `step` instead; both where nothing came to be asked;
    the numbers where the outcome does not give them. With `is_bound` the error is at most `error`. `computed` counts
    the products with K that the method says it took, null if it does not. Its events are those of the reference,
    block by block, before `parted_at`, their times within `apart`; null are both of a method that has no events, and
    `parted_at` where all are.
    """

    method: str = ""
    tolerance: float | None = None
    step: float | None = None
    outcome: Outcome = "measured"
    reason: str | None = None
    error: float | None = None
    is_bound: bool = False
    computed: int | None = None
    parted_at: float | None = None
    apart: float | None = None


@dataclass(frozen=True, kw_only=True)
class Reference:
    """The reference for the errors on one problem.

    `floor` is max |z - z_check| at t_end; null, with a reason, if one of the two could not be computed.
    """

    reference: str = ""
    check: str = ""
    floor: float | None = None
    n_events: int | None = None
    reason: str | None = None


Row = TypeVar("Row", bound=Trial)
Known = TypeVar("Known", bound=Reference)


def referenced(row: Known, by: Setting, check: Setting, problem: Problem) -> tuple[Known, Solution | None]:
    """A run as well as it can be had, and how well a second computation agrees."""
    row = replace(row, reference="{} at {:g}".format(*by), check="{} at {:g}".format(*check))
    try:
        solution = solved(*by, problem)
        check_z = solved(*check, problem).z
    except (MethodError, sim.IntegrationError) as error:
        return replace(row, reason=str(error)), None
    # two computations may agree to the bit, yet no less than rounding is claimed
    floor = float(max(np.abs(solution.z - check_z).max(), np.spacing(np.abs(solution.z).max())))
    return replace(row, floor=floor, n_events=None if solution.events is None else len(solution.events)), solution


def trials(
    row: Row,
    method: Method,
    problem: Problem,
    reference: Reference,
    known: Solution | None,
    settings: tuple[float, ...],
    longest: float,
    product: Product | None = None,
    repeats: int = 1,
) -> Iterator[Row]:
    """One row a tolerance or step, from the coarsest; none is tried after a run of more than `longest` seconds."""
    row = replace(row, method=method.name)
    if not method.is_installed:
        yield replace(row, outcome="absent", reason=f"{method.package} is not installed")
        return
    if known is None:
        yield replace(row, outcome="not judged", reason=f"no reference: {reference.reason}")
        return
    solve = method.prepare(problem)
    warm(method, problem, settings[-1])
    too_slow: str | None = None
    for setting in reversed(settings):
        trial = replace(row, step=setting) if method.control == "step" else replace(row, tolerance=setting)
        if too_slow is not None:
            yield replace(trial, outcome="too slow", reason=too_slow)
            continue
        start = time.perf_counter()
        try:
            solution, timing = timed(partial(solve, setting), product, repeats, longest)
        except (MethodError, sim.IntegrationError) as failure:
            took = time.perf_counter() - start
            outcome: Outcome = "too slow" if isinstance(failure, GivenUp) else "failed"
            yield replace(trial, outcome=outcome, reason=str(failure))
        else:
            took = timing.seconds or 0.0
            result = replace(trial, computed=solution.n_products, **asdict(timing))
            yield _judged(result, solution, known, reference.floor or 0.0)
        if took > longest:
            too_slow = f"took {took:.2g} s at {setting:g}: more than {longest:g} s"


def _judged(row: Row, solution: Solution, reference: Solution, floor: float) -> Row:
    error = float(np.abs(solution.z - reference.z).max())
    if not np.isfinite(error):
        return replace(row, outcome="wrong", reason="z at t_end is not finite, returned as a success")
    row = replace(row, error=max(error, floor), is_bound=error <= floor)
    if solution.events is None or reference.events is None:
        return row
    parted_at, distance = compared(solution.events, reference.events)
    return replace(row, parted_at=parted_at, apart=distance)


def compared(found: sim.EventSeries, reference: sim.EventSeries) -> tuple[float | None, float]:
    """When the first block's events are no longer the known ones, if ever, and how far their times are off before."""
    parted, shared = math.inf, []
    for block in range(reference.n):
        mine, its = (np.flatnonzero(series.block == block) for series in (found, reference))
        n = min(len(mine), len(its))
        alike = np.append(found.mode[mine[:n]] == reference.mode[its[:n]], len(mine) == len(its))
        shared.append(np.column_stack([found.t[mine[:n]], reference.t[its[:n]]]))
        if not alike.all():
            place = int(np.argmin(alike))
            later = [
                series.t[events[place]] for series, events in ((found, mine), (reference, its)) if place < len(events)
            ]
            parted = min(parted, *later)
    times = np.vstack(shared)
    times = times[times.max(axis=1) < parted]
    return None if parted == math.inf else parted, float(np.abs(times[:, 0] - times[:, 1]).max(initial=0.0))
