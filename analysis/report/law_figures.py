"""The figure of the law of cascades: what is seen over what the exponential gives, size by size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stickslip.analysis.report.figures import CYCLE, GREY, STYLE, size_axis, subplots
from stickslip.analysis.stats.goodness import Quotient

_DASHES = ("-", "--", ":", "-.", (0, (5, 1)))


class Panel(NamedTuple):
    """A group: observed over fitted share by size, and each rival's share over the exponential's."""

    title: str
    observed: Sequence[Quotient]
    rivals: Sequence[tuple[str, np.ndarray]]


def quotient_panels(panels: Sequence[Panel]) -> Figure:
    """Share of cascades over the exponential's share, by size, with intervals over matrices; rivals as lines.

    Parameters
    ----------
    panels : sequence of Panel
        At least one; each rival's array goes with the sizes of `observed`.
    """
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(rows, columns, 0.8 + 2.3 * rows, sharey=True)
        for ax, panel in zip(axes.flat, panels, strict=False):
            _panel(ax, panel)
        for ax in axes.flat[len(panels) :]:
            ax.set_axis_off()
        for ax in axes[:, 0]:
            ax.set_ylabel("share / exponential's share")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def _panel(ax: Axes, panel: Panel) -> None:
    sizes = np.array([one.size for one in panel.observed])
    value = np.array([one.value for one in panel.observed])
    ends = [(one.value, one.value) if one.low is None else (one.low, one.high) for one in panel.observed]
    low, high = np.array(ends, dtype=float).T
    ax.axhline(1.0, color=GREY, linewidth=0.8)
    for k, (name, quotient) in enumerate(panel.rivals):
        ax.plot(sizes, quotient, label=name, color=CYCLE[k % len(CYCLE)], linestyle=_DASHES[k % len(_DASHES)])
    ax.errorbar(
        sizes, value, yerr=[value - low, high - value], fmt="o", markersize=3.5, color="black", linewidth=0.9,
        label="observed, interval over matrices",
    )  # fmt: skip
    reach = 1.15 * max(0.2, float(np.max(np.abs(np.concatenate([low, high]) - 1.0))))
    ax.set_ylim(max(0.0, 1.0 - reach), 1.0 + reach)  # set by the data: a rival that is far off leaves the panel
    ax.set_title(panel.title)
    ax.set_xlabel("size of a cascade")
    size_axis(ax, int(sizes[-1]))
