"""What one run looks like: which block slips when, drawn from its events, or n_stick(t) where none are recorded.

Asked of small ensembles that record events, and of others if the scene names it: a picture of one run in thousands is
no statistic of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import Answer, Question, Row
from stickslip.analysis.ensemble import Study
from stickslip.analysis.models.fates import DIVERGED, FAILED
from stickslip.analysis.style import EXACT, panel
from stickslip.sim.runs import pictures
from stickslip.sim.runs.series import EventSeries
from stickslip.sim.systems.graphs import grid_width

NAME = "one_run"
MOST_MEMBERS = 12  # of an ensemble in which a run is drawn unasked
NONE_RAN = "none ran"
_BESIDE = 0.1  # of the duration of an episode, which is drawn before and after it
_LONG = 0.5  # of the run


def answer(study: Study) -> Answer | None:
    """The first unchanged run, one that finished if there is one."""
    data = study.data
    if NAME not in study.settings.question and (len(data.table) > MOST_MEMBERS or not data.events):
        return None
    table = data.table.at(data.table.unchanged).together
    ran = table[table["outcome"] != FAILED]
    if ran.empty:
        return Answer(lack=NONE_RAN)
    finished = ran[ran["outcome"] == "finished"]
    run = (ran if finished.empty else finished).iloc[0]
    name, n, t_end = str(run["member_id"]), int(run["n"]), float(run["t_end"])
    if run["outcome"] == DIVERGED:
        t_end = float(run["t_stop"])
    t, n_stick = study.runs.points(name)
    mean = float(np.diff(np.append(t, t_end)) @ n_stick / (t_end * n)) if t_end else None
    facts: dict[str, Any] = {
        "run": name, "n": n, "n_runs": len(table), "t_end": t_end, "sticks": mean, "least": int(n_stick.min()),
        "most": int(n_stick.max()), "events": None, "episode": None,
        "is_finished": not finished.empty, "t_burn": study.settings.t_burn,
    }  # fmt: skip
    if name not in data.events:
        return Answer(facts, figures={NAME: partial(steps, t, n_stick, t_end)})
    events = EventSeries(*data.events[name], t_start=0.0, t_end=t_end)
    width = grid_width(n) if run["coupling"] == "grid" else None
    figures = {NAME: partial(space_time, events, None, width)}
    facts |= {"events": _counts(events), "width": width, "episode": _largest(study, name, t_end)}
    if facts["episode"] is not None:
        figures["one_episode"] = partial(space_time, events, facts["episode"]["span"], width)
    return Answer(facts, figures=figures)


def _counts(events: EventSeries) -> Mapping[str, int]:
    """Numbers of exits and of blocks that never slip, and the block with most exits."""
    slips = events.initial_mode != 0
    slips[events.block[events.mode != 0]] = True
    exits = np.bincount(events.block[events.is_exit], minlength=events.n)
    return {
        "n_exits": int(exits.sum()), "n_never": int((~slips).sum()), "block": int(exits.argmax()),
        "of_block": int(exits.max()),
    }  # fmt: skip


def _largest(study: Study, name: str, t_end: float) -> Row | None:
    """The episode after t_burn with the largest moment, and the time to draw; None if there is none to look into.

    An episode of one block, or one that takes most of the run, shows nothing that is not seen already.
    """
    if study.data.episodes is None:
        return None
    own = study.data.episodes[study.data.episodes["member_id"] == name]
    is_short = own["end"] - own["start"] < _LONG * t_end
    own = own[is_short & (own["start"] >= study.settings.t_burn) & (own["size"] > 1)]
    if own.empty:
        return None
    row = own.iloc[int(own["moment"].abs().to_numpy().argmax())]
    start, end = float(row["start"]), float(row["end"])
    beside = _BESIDE * (end - start)
    return {"start": start, "end": end, "size": int(row["size"]), "moment": float(row["moment"]),
            "span": (max(start - beside, 0.0), min(end + beside, t_end))}  # fmt: skip


@panel()
def space_time(ax: Axes, events: EventSeries, span: tuple[float, float] | None, width: int | None) -> None:
    """Which block slips when, and which way."""
    pictures.space_time(ax, events, span=span, width=width)
    ax.set_xlabel("time t")


@panel()
def steps(ax: Axes, t: np.ndarray, n_stick: np.ndarray, t_end: float) -> None:
    """n_stick of the run."""
    pictures.steps(ax, t, n_stick, t_end, (0.0, t_end), color=EXACT, linewidth=0.9)
    ax.set_xlabel("time t")


QUESTION = Question(answer)
