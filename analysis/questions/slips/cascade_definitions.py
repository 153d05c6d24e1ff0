"""Other definitions of a cascade: the decay rate by each, against the sampling step."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from stickslip.analysis.answer import Answer, Picture
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.rows import frame_of
from stickslip.analysis.series import cascades
from stickslip.analysis.series.cascades import SAMPLED
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats.estimates import Estimate, gamma, over_matrices, with_ends
from stickslip.analysis.style import CYCLE, GREY, bars, panel
from stickslip.pipeline.design.units import DIMENSIONLESS, Units

_CAPTION = (
    "By other definitions of a cascade the decay rate depends on the sampling step. Size by drop: the fall of n_stick"
    " over successive samples that fall; by length: the number of these samples; by descent and decreases: the drop"
    " and the length where samples may also stay level. Band: slip onsets, without sampling."
)


class Defined(NamedTuple):
    """The decay rate by a definition: a row of the table `definitions`."""

    group: str
    definition: str
    dt: float | None
    n_cascades: int
    n_matrices: int
    gamma: Estimate


def compared(study: Study, group: Group) -> Answer:
    """The decay rate of a group by every definition and sampling step."""
    rows = _rows(study, group)
    table = {"definitions": frame_of(Defined, rows)}
    if len({row.dt for row in rows if row.dt is not None and row.gamma.low is not None}) < 2:
        return Answer(tables=table)
    picture = Picture(partial(by_step, rows, study.settings.units), _CAPTION)
    return Answer(tables=table, figures={"definitions": picture})


def _rows(study: Study, group: Group) -> list[Defined]:
    dts = sorted({*study.settings.dt, *study.settings.map_dt})
    laws = cascades.laws(dts)
    flat = study.sums(group, partial(_of_run, dts), 2 * len(laws))
    rows = []
    for law, sums in zip(laws, np.hsplit(flat[:, :-1], len(laws)), strict=True):
        counted = sums[sums[:, 1] > 0]
        rate = over_matrices(gamma, counted, study.settings.confidence)
        rows.append(Defined(group.label, law.definition, law.dt, int(counted[:, 1].sum()), len(counted), rate))
    return rows


def _of_run(dts: Sequence[float], run: Run) -> np.ndarray:
    """`cascades.sums` of a run by every definition, law by law."""
    sums = cascades.sums(run.win.step)
    for dt in dts:
        sums |= cascades.sums(run.win.sampled(dt), dt)
    return np.concatenate([sums[law] for law in cascades.laws(dts)])


@panel()
def by_step(ax: Axes, rows: Sequence[Defined], units: Units = DIMENSIONLESS) -> None:
    """The decay rate against the sampling step, one line a definition; the band is `events`."""
    for row in rows:
        if row.dt is None and row.gamma.low is not None and row.gamma.high is not None:
            ax.axhspan(row.gamma.low, row.gamma.high, color=GREY, alpha=0.3, linewidth=0, label="events")
    for k, definition in enumerate(SAMPLED):
        points = [row for row in rows if row.definition == definition and row.gamma.low is not None]
        form, ends = ("o-", "D-", "s--", "^--")[k], with_ends(row.gamma for row in points)
        dt = [row.dt for row in points if row.dt is not None]
        bars(ax, dt, ends, fmt=form, label=definition, color=CYCLE[k], markersize=3, linewidth=0.9)
    steps = sorted({row.dt for row in rows if row.dt is not None})
    ax.set(xscale="log", xlabel=units.label("sampling step dt", "time"), ylabel="decay rate")
    ax.set_xticks(steps[:: max(1, -(-len(steps) // 5))])
    ax.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.minorticks_off()
    ax.figure.legend(loc="outside upper center", ncols=3)
