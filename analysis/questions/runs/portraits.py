"""A typical run of each kind of motion that attracts: phase portrait, time trace and spectrum. Part of `fates`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis import pictures as kinds
from stickslip.analysis.answer import Picture
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.words import plural
from stickslip.analysis.models.attractors import IRREGULAR, PERIODIC, TORUS
from stickslip.analysis.questions.runs.settled import Grid, Setting
from stickslip.analysis.style import panel
from stickslip.pipeline.design.units import DIMENSIONLESS, Units
from stickslip.sim.runs.run import Samples
from stickslip.sim.runs.series import EventSeries

_SAMPLES, _NUMBERS = 16384, 4e6  # of a run, and of all its blocks
_LINE = 6000  # samples in a line, at most
_LOW, _HIGH = 0.1, 20.0  # frequencies of a spectrum, in turns


class Look(NamedTuple):
    """How runs of a kind are drawn, and the number whose median says which is typical."""

    number: str
    words: str
    turns: int
    see: str


_LOOKS = {
    PERIODIC: Look(
        "period", "period", 4, "A cycle closes in the plane, and has peaks at multiples of its frequency."
    ),
    TORUS: Look("deviation_rate", "deviation rate", 40, "A torus fills a band of the plane, and has narrow peaks."),
    IRREGULAR: Look("deviation_rate", "deviation rate", 40, "Irregular motion never closes; its spectrum is broad."),
}


def pictures(study: Study, grid: Grid) -> dict[str, Picture]:
    """One for each kind of motion; of data that cannot be run again by themselves, none."""
    figures: dict[str, Picture] = {}
    if study.data.again is None:
        return figures
    members, settings = study.data.table.own, study.settings
    for kind, look in _LOOKS.items():
        chosen = _typical(study, grid, kind)
        if chosen is None:
            continue
        setting, row, n_runs = chosen
        name, block = str(members["member_id"].iloc[row]), members["exits_block"].iloc[row]
        n_samples = int(np.clip(_NUMBERS / int(setting.groups[0].key["n"]), 1024, _SAMPLES))
        motion = study.data.again(name, settings.t_burn, n_samples)
        if motion is None:
            continue
        block = 0 if np.ma.is_masked(block) or block != block else int(block)
        turn = float(study.number("period")[row]) if kind == PERIODIC else _mean_turn(motion[0], block)
        called = settings.names[block] if settings.names else f"block {block}"
        which = f", whose {look.words} is nearest the median of {plural(n_runs, 'run')}" if n_runs > 1 else ""
        caption = (
            f"{look.see} Top to bottom: phase portrait, velocity and its spectrum, of {called} in run {name}{which}."
            " Broad lines: it sticks."
        )
        recipe = partial(portrait, *motion, block, turn, look.turns, settings.units)
        figures[f"typical_{kind}"] = Picture(recipe, caption)
    return figures


def _typical(study: Study, grid: Grid, kind: str) -> tuple[Setting, int, int] | None:
    """The run of a kind whose number is nearest the median of all, with its setting, and how many these are."""
    pairs = [
        (setting, int(row))
        for setting in grid.settings
        if setting.is_recorded
        for row in setting.runs.rows[setting.runs.kinds == kind]
    ]
    if not pairs:
        return None
    numbers = study.number(_LOOKS[kind].number)[[row for _, row in pairs]]
    nearest = int(np.argmin(np.nan_to_num(np.abs(numbers - np.nanmedian(numbers)), nan=np.inf)))
    return *pairs[nearest], len(pairs)


def _mean_turn(events: EventSeries, block: int) -> float:
    """The mean time between slip onsets of a block, or the whole if there are none."""
    n_onsets = int((events.is_exit & (events.block == block)).sum())
    return (events.t_end - events.t_start) / max(n_onsets, 1)


@panel(7.0, nrows=3, gridspec_kw={"height_ratios": (3, 2, 2)})
def portrait(
    axes: Sequence[Axes],
    events: EventSeries,
    samples: Samples,
    block: int,
    turn: float,
    n_turns: int,
    units: Units = DIMENSIONLESS,
) -> None:
    """A block's velocity against its displacement, and in time, over the last turns of a run; and its spectrum."""
    plane, trace, spectrum = axes
    shown = min(n_turns * turn, _LINE * (samples.t[1] - samples.t[0]), samples.t[-1] - samples.t[0])
    span = float(samples.t[-1] - shown), float(samples.t[-1])
    kinds.phase(plane, events, samples, block=block, span=span)
    kinds.time(trace, events, samples, of="w", blocks=[block], span=span)
    kinds.spectrum(spectrum, events, samples, block=block, span=(float(samples.t[0]), span[1]))
    z, w = units.label("displacement z", "length"), units.label("velocity w", "speed")
    plane.set(xlabel=z, ylabel=w)
    trace.set(ylabel=w)
    frequencies, density = map(np.asarray, spectrum.lines[0].get_data())
    inside = (frequencies >= _LOW / turn) & (frequencies <= _HIGH / turn)
    low, high = density[inside].min(initial=np.inf), density[inside].max(initial=0.0)
    if 0.0 < low < high:
        spectrum.set(xlim=(_LOW / turn, _HIGH / turn), ylim=(low / 2.0, 2.0 * high))
    spectrum.set(ylabel="power density")
