"""Bifurcation diagrams: z at slip onsets along a swept key, above multipliers and periods of cycles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import Picture
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import plural
from stickslip.analysis.models.attractors import IRREGULAR, PERIODIC, REST, SLIDING, TORUS
from stickslip.analysis.questions.runs.coexistence import Boundary
from stickslip.analysis.questions.runs.settled import Grid, Setting
from stickslip.analysis.style import GREY, panel
from stickslip.pipeline.design.units import DIMENSIONLESS, Units
from stickslip.sim.numerics.arguments import Floats

MOST_DIAGRAMS = 3  # at values of a second key
SPLIT = "Branches split where a cycle gets more exits."
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


class Sections(NamedTuple):
    """What a diagram shows, values of the key and numbers, shape (2, m): z by what runs settle on, and of cycles."""

    z: Mapping[str, Floats]
    multiplier: Floats
    period: Floats
    n_left_out: int
    title: str = "z"
    ends: Sequence[float] = ()


def pictures(study: Study, grid: Grid, boundaries: Sequence[Boundary] = ()) -> dict[str, Picture]:
    """The diagrams of some lines along the first axis, if its values are numbers, with ends of attraction."""
    lines = [
        line
        for line in grid.recorded_lines
        if {PERIODIC, TORUS, IRREGULAR} & {kind for setting in line for kind in setting.runs.kinds}
    ]
    places = np.unique(np.linspace(0, len(lines) - 1, min(len(lines), MOST_DIAGRAMS)).round().astype(int))
    figures: dict[str, Picture] = {}
    units = study.settings.units
    for k in places:
        setting = lines[k][0]
        places_on_line = {str(setting.where) for setting in lines[k]}
        ends = sorted({boundary.value for boundary in boundaries if boundary.setting in places_on_line})
        sections = _sections(study, lines[k])._replace(ends=ends)
        where = grid.beside(setting) + Place.of(setting.method)
        left_out = f" Left out: {plural(sections.n_left_out, 'run')}, undecided or without limit."
        caption = (
            f"{'Dashed: where steady sliding or stick-slip begins or ceases to attract.' if ends else SPLIT}"
            " z of the block with most exits, at its exits;"
            f" below, the largest multiplier and the period of each cycle{f' ({where})' if where else ''}."
            f"{left_out * bool(sections.n_left_out)}"
        )
        name = f"bifurcation_{len(figures) + 1}" if figures else "bifurcation"
        recipe = partial(bifurcation, units.label_of_key(grid.axes[0].name), sections, str(where), units)
        figures[name] = Picture(recipe, caption)
    return figures


def _sections(study: Study, line: Sequence[Setting]) -> Sections:
    """z at exits or, of what has none, at the section of the block that has most exits; numbers of cycles."""
    exits_z, section_z = study.data.lists["exits_z"], study.data.lists["section_z"]
    members = study.data.table.own
    rows = np.concatenate([setting.runs.rows for setting in line])
    kinds = np.concatenate([setting.runs.kinds for setting in line])
    values = np.array([setting.at[0][0] for setting in line], dtype=np.float64)
    x = np.repeat(values, [len(setting.runs.rows) for setting in line])
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
    multiplier, period = (_dots(x, study.number(name)[rows]) for name in ("multiplier", "period"))
    z = {kind: _dots(*np.transpose(points)) for kind, points in pairs.items() if points}
    title = f"z of {study.settings.names[block]}" if study.settings.names else "z"
    return Sections(z, multiplier, period, n_left_out, title)


def _dots(x: Floats, y: Floats) -> Floats:
    """Points that are known and of which none lies on another, as many runs have one cycle; shape (2, m)."""
    x, y = x[~np.isnan(y)], y[~np.isnan(y)]
    dot = _ONE_DOT * max(np.ptp(y) if len(y) else 0.0, 1e-9 * np.abs(y).max(initial=1.0))
    places = np.unique(np.column_stack([x, np.round(y / dot)]), axis=0, return_index=True)[1]
    return np.stack([x, y])[:, np.sort(places)]


@panel(5.2, nrows=3, sharex=True, gridspec_kw={"height_ratios": (3, 1, 1)})
def bifurcation(
    axes: Sequence[Axes], key: str, sections: Sections, title: str = "", units: Units = DIMENSIONLESS
) -> None:
    """z at exits against a key, and z of what has none, above multipliers and periods of cycles."""
    above, middle, below = axes
    n_points = sum(points.shape[1] for points in sections.z.values())
    size = float(np.clip(60.0 / np.sqrt(n_points), 0.8, 3.0))
    for kind, points in sections.z.items():
        colour, mark, words = _MARKS[kind]
        width, edge = (size, 0.0) if mark == "o" else (max(size, 2.0), 0.7 * (mark == "x"))
        is_image = n_points > _VECTORS
        above.plot(*points, mark, color=colour, label=words, ms=width, markeredgewidth=edge, rasterized=is_image)
    above.set(ylabel=units.label(sections.title, "length"), title=title)
    if len(sections.z) > 1:
        above.figure.legend(loc="outside upper left", ncols=3, handletextpad=0.1, markerscale=2.0)
    for ax, name, points in ((middle, "multiplier", sections.multiplier), (below, "period", sections.period)):
        ax.plot(*points, "o", color="black", ms=1.8, markeredgewidth=0, rasterized=points.shape[1] > _VECTORS)
        top = max(points[1].max(initial=0.0), float(name == "multiplier")) or 1.0
        ax.set(ylabel=units.label(name, "time") if name == "period" else name, ylim=(-0.08 * top, 1.1 * top))
    for ax, end in product(axes, sections.ends):
        ax.axvline(end, color=GREY, linewidth=0.8, linestyle="--")
    middle.axhline(1.0, color=GREY, linewidth=0.8, linestyle="--")
    x = np.concatenate([points[0] for points in sections.z.values()])
    below.set(xlabel=key, xscale="log" if x.min() > 0 and x.max() > _DECADES * x.min() else "linear")
    above.figure.align_ylabels(list(axes))
