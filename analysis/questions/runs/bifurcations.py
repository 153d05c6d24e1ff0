"""Bifurcation diagrams: z at slip onsets along a swept key, above multipliers and periods of cycles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import Picture
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import plural
from stickslip.analysis.models.attractors import IRREGULAR, PERIODIC, REST, SLIDING, TORUS
from stickslip.analysis.questions.runs.settled import Grid, Setting
from stickslip.analysis.style import GREY, panel
from stickslip.sim.numerics.arguments import Floats

MOST_DIAGRAMS = 3  # at values of a second key
_ONE_DOT = 1e-3  # of the range of values: what is closer is drawn once
_VECTORS = 2000  # more marks than this are a bitmap inside the SVG
_DECADES = 30.0  # largest over least value from which an axis is logarithmic
#: How z is drawn by what a run settles on, at exits or, of what has none, at its section: colour, mark, and name.
_MARKS = {
    PERIODIC: ("black", "o", "cycle, at exits"),
    TORUS: ("#009E73", "o", "torus, at exits"),
    IRREGULAR: ("#6A3D9A", "o", "irregular, at exits"),
    SLIDING: ("#0072B2", "x", "steady sliding"),
    REST: ("#9ECAE1", "D", "at rest"),
}


class Points(NamedTuple):
    """Values against a key: at which of its values, shape (m,), and what."""

    x: Floats
    y: Floats

    @classmethod
    def apart(cls, pairs: Sequence[tuple[float, float]]) -> Points:
        """Points of which none lies on another: many runs have one cycle."""
        points = np.array(pairs, dtype=np.float64).reshape(-1, 2)
        dot = _ONE_DOT * max(
            np.ptp(points[:, 1]) if len(points) else 0.0, 1e-9 * np.abs(points[:, 1]).max(initial=1.0)
        )
        dots = np.column_stack([points[:, 0], np.round(points[:, 1] / dot)])
        places = np.sort(np.unique(dots, axis=0, return_index=True)[1])
        return cls(*points[places].T)

    @classmethod
    def known(cls, x: Floats, y: Floats) -> Points:
        """As `apart`, without those that are NaN."""
        return cls.apart([*zip(x[~np.isnan(y)].tolist(), y[~np.isnan(y)].tolist(), strict=True)])


class Sections(NamedTuple):
    """What a diagram shows: z by what runs settle on, and the multipliers and periods of cycles."""

    z: Mapping[str, Points]
    multiplier: Points
    period: Points
    n_left_out: int


def pictures(study: Study, grid: Grid) -> dict[str, Picture]:
    """The diagrams of some lines along the first axis, if its values are numbers."""
    lines = [
        line for line in _lines(grid) if {PERIODIC, TORUS, IRREGULAR} & {kind for s in line for kind in s.runs.kinds}
    ]
    places = np.unique(np.linspace(0, len(lines) - 1, min(len(lines), MOST_DIAGRAMS)).round().astype(int))
    figures: dict[str, Picture] = {}
    for k in places:
        setting = lines[k][0]
        sections, where = _sections(study, lines[k]), grid.beside(setting) + Place.of(setting.method)
        left_out = f" Left out: {plural(sections.n_left_out, 'run')}, undecided or without limit."
        caption = (
            "Branches split where a cycle gets more exits. z of the block with most exits, at its exits;"
            f" below, the largest multiplier and the period of each cycle{f' ({where})' if where else ''}."
            f"{left_out * bool(sections.n_left_out)}"
        )
        name = f"bifurcation_{len(figures) + 1}" if figures else "bifurcation"
        figures[name] = Picture(partial(bifurcation, grid.axes[0].name, sections, str(where)), caption)
    return figures


def _lines(grid: Grid) -> Iterator[list[Setting]]:
    """Lines of settings along numbers, of which it is recorded what their runs settle on."""
    if grid.axes and grid.axes[0].x is not None:
        for settings in grid.methods.values():
            recorded = [setting for setting in settings if setting.is_recorded]
            yield from grid.lines(recorded) if recorded else ()


def _sections(study: Study, line: Sequence[Setting]) -> Sections:
    """z at exits or, of what has none, at the section of the block that has most exits; numbers of cycles."""
    exits_z, section_z = study.data.lists["exits_z"], study.data.lists["section_z"]
    members = study.data.table.own
    rows = np.concatenate([setting.runs.rows for setting in line])
    kinds = np.concatenate([setting.runs.kinds for setting in line])
    x = np.repeat([_number(setting) for setting in line], [len(setting.runs.rows) for setting in line])
    names = members["member_id"].to_numpy(object)[rows]
    blocks = members["exits_block"].iloc[rows][[name in exits_z for name in names]].mode()
    block = int(blocks.iloc[0]) if len(blocks) else 0
    pairs: dict[str, list[tuple[float, float]]] = {kind: [] for kind in _MARKS}
    n_left_out = 0
    for value, name, kind in zip(x.tolist(), names, kinds, strict=True):
        if name in exits_z:
            pairs[kind] += [(value, z) for z in exits_z[name].tolist()]
        elif name in section_z:
            pairs[kind].append((value, float(section_z[name][block])))
        else:
            n_left_out += 1
    multiplier, period = (Points.known(x, study.number(name)[rows]) for name in ("multiplier", "period"))
    z = {kind: Points.apart(points) for kind, points in pairs.items() if points}
    return Sections(z, multiplier, period, n_left_out)


def _number(setting: Setting) -> float:
    value = setting.at[0][0]
    assert isinstance(value, int | float)  # as all are along an axis of numbers
    return float(value)


@panel(5.2, nrows=3, sharex=True, gridspec_kw={"height_ratios": (3, 1, 1)})
def bifurcation(axes: Sequence[Axes], key: str, sections: Sections, title: str = "") -> None:
    """z at exits against a key, and z of what has none, above multipliers and periods of cycles."""
    above, middle, below = axes
    n_points = sum(len(points.x) for points in sections.z.values())
    size = float(np.clip(60.0 / np.sqrt(n_points), 0.8, 3.0))
    for kind, points in sections.z.items():
        colour, mark, words = _MARKS[kind]
        edge = 0.7 * (mark == "x")
        above.plot(*points, mark, color=colour, label=words, markersize=max(size, 2.0) if mark != "o" else size,
                   markeredgewidth=edge, rasterized=n_points > _VECTORS)  # fmt: skip
    above.set(ylabel="z", title=title)
    if len(sections.z) > 1:
        above.figure.legend(loc="outside upper left", ncols=3, handletextpad=0.1, markerscale=2.0)
    for ax, name, points in ((middle, "multiplier", sections.multiplier), (below, "period", sections.period)):
        ax.plot(*points, "o", color="black", markersize=1.8, markeredgewidth=0, rasterized=len(points.x) > _VECTORS)
        top = max(points.y.max(initial=0.0), float(name == "multiplier")) or 1.0
        ax.set(ylabel=name, ylim=(-0.08 * top, 1.1 * top))
    middle.axhline(1.0, color=GREY, linewidth=0.8, linestyle="--")
    x = np.concatenate([points.x for points in sections.z.values()])
    below.set(xlabel=key, xscale="log" if x.min() > 0 and x.max() > _DECADES * x.min() else "linear")
    above.figure.align_ylabels(list(axes))
