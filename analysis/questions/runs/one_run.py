"""What one run looks like: which block slips when, drawn from its events, or n_stick(t) where none are recorded.

Asked of small ensembles that record events, and of others if the scene names it: a picture of one run in thousands is
no statistic of them.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis import pictures
from stickslip.analysis.answer import Answer, Picture, Question
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Finding, Form, Lack, Level, Quantity, Reason, Share
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import plural
from stickslip.analysis.models.fates import DIVERGED, FAILED
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.style import EXACT, panel
from stickslip.pipeline.design.units import DIMENSIONLESS, Units
from stickslip.sim.runs.series import EventSeries
from stickslip.sim.systems.graphs import grid_width

NAME = "one_run"
MOST_MEMBERS = 12  # of an ensemble in which a run is drawn unasked
ONSETS = Quantity("n_exits", "number of slip onsets", Form.COUNT)
STICKING = Quantity("stick_share", "mean share of time that a block sticks", Form.SHARE)


def answer(study: Study) -> Answer | None:
    """The first unchanged run, one that finished if there is one."""
    data = study.data
    if NAME not in study.settings.question and (len(data.table) > MOST_MEMBERS or not data.events):
        return None
    table = data.table.at(data.table.unchanged).together
    ran = table[table["outcome"] != FAILED]
    if ran.empty:
        return Answer(findings=[Lack("the picture of a run", Reason.ALL_FAILED)])
    finished = ran[ran["outcome"] == "finished"]
    run = (ran if finished.empty else finished).iloc[0]
    name, n, t_end = str(run["member_id"]), int(run["n"]), float(run["t_end"])
    if run["outcome"] == DIVERGED:
        t_end = float(run["t_stop"])
    t, n_stick = study.runs.points(name)
    where = Place.words(f"one run of {plural(n, 'block')} from t = 0 to {study.settings.at(t_end)}")
    findings: list[Finding] = [_sticking(t, n_stick / n, t_end, where)]
    if name in data.events:
        names, unit = study.settings.names, study.settings.units.time
        events = EventSeries(*data.events[name], t_start=0.0, t_end=t_end, names=names, unit=unit)
        findings = [*_slips(events, where), *findings]
        width = grid_width(n) if run["coupling"] == "grid" else None
        rows = "; in a grid, the blocks of a row lie side by side" if width else ""
        caption = f"Which block slips when, and which way, in run {name}: each row is a block{rows}."
        picture = Picture(partial(space_time, events, width), caption)
    else:
        caption = f"Number of sticking blocks n_stick(t) in run {name}. Recorded events would show which block slips."
        picture = Picture(partial(steps, t, n_stick, t_end, study.settings.units), caption)
    chosen = "finished" if len(finished) else "was begun"
    method = (
        f"Run {name} is the first of {len(table)} that {chosen}, and stands for no other. "
        "The command stickslip plot DIR MEMBER --span T0 T1 --out picture.svg draws any run, or a part of one."
    )
    return Answer(findings=findings, figures={NAME: picture}, method=method)


def _sticking(t: np.ndarray, share: np.ndarray, t_end: float, where: Place) -> Finding:
    if not t_end:
        return Lack(STICKING.name, Reason.SHORT_WINDOW)
    return Level(STICKING, Estimate(float(np.diff(np.append(t, t_end)) @ share / t_end)), where)


def _slips(events: EventSeries, where: Place) -> list[Finding]:
    """How often blocks begin to slip, and how many ever do."""
    slips = events.initial_mode != 0
    slips[events.block[events.mode != 0]] = True
    return [
        Level(ONSETS, Estimate(int(events.is_exit.sum())), where),
        Share("slip", "blocks", "slip", Estimate(float(np.mean(slips)))),
    ]


@panel()
def space_time(ax: Axes, events: EventSeries, width: int | None) -> None:
    """Which block slips when, and which way."""
    pictures.space_time(ax, events, width=width)
    ax.set_xlabel(f"time t ({events.unit})" if events.unit else "time t")


@panel()
def steps(ax: Axes, t: np.ndarray, n_stick: np.ndarray, t_end: float, units: Units = DIMENSIONLESS) -> None:
    """n_stick of the run."""
    pictures.steps(ax, t, n_stick, t_end, (0.0, t_end), color=EXACT, linewidth=0.9)
    ax.set_xlabel(units.label("time t", "time"))


QUESTION = Question(answer, title="What does one run look like?")
