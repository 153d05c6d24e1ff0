"""How results are shown in a notebook: small tables, and drawings on matplotlib axes.

Only this module of `sim` uses matplotlib, and it loads it only when something is drawn.
"""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes

    from stickslip.sim.runs.series import EventSeries

#: Mode -> what the block does, and a colour: distinguishable with every common form of colour blindness.
_MODES = {0: ("sticks", "#0072B2"), 1: ("slips right", "#DDDDDD"), -1: ("slips left", "#E69F00")}

#: More intervals than this are drawn as pixels, also in a vector drawing.
_VECTORS = 5000


def table(head: str, rows: Mapping[str, object]) -> str:
    """An HTML table of names and values under a head; all text is escaped."""
    lines = (f"<tr><th>{escape(name)}</th><td>{escape(str(value))}</td></tr>" for name, value in rows.items())
    return f"<table><thead><tr><th colspan=2>{escape(head)}</th></tr></thead><tbody>{''.join(lines)}</tbody></table>"


def span(values: np.ndarray) -> str:
    """The one value that an array holds, or its least and greatest."""
    low, high = float(values.min()), float(values.max())
    return f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"


def draw_n_stick(events: EventSeries, ax: Axes | None, style: Mapping[str, Any]) -> Axes:
    """n_stick(t) as steps, on `ax` or on a new pyplot figure; `style` goes to `Axes.step`."""
    ax = _axes(ax)
    t, n_stick = events.change_points()
    ax.step(np.append(t, events.t_end), np.append(n_stick, n_stick[-1]), where="post", **style)
    ax.set(xlabel="time t (dimensionless)", ylabel="$n_{stick}$")
    ax.set_ylim(bottom=0)
    return ax


def draw_modes(events: EventSeries, ax: Axes | None) -> Axes:
    """One row a block, coloured by its mode, on `ax` or on a new pyplot figure."""
    from matplotlib.collections import PolyCollection
    from matplotlib.ticker import MaxNLocator

    ax = _axes(ax)
    block, mode, start, stop = _stays(events)
    for value, (label, colour) in _MODES.items():
        here = mode == value
        left, right, low = start[here], stop[here], block[here] - 0.5
        corners = np.stack([left, low, right, low, right, low + 1, left, low + 1], axis=-1).reshape(-1, 4, 2)
        rectangles = PolyCollection(list(corners), facecolors=colour, linewidths=0, label=label)
        rectangles.set_rasterized(len(block) > _VECTORS)
        ax.add_collection(rectangles)
    ax.set(
        xlabel="time t (dimensionless)",
        ylabel="block",
        xlim=(events.t_start, max(events.t_end, np.nextafter(events.t_start, np.inf))),
    )
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.yaxis.set_major_formatter(lambda block, _: f"{block:.0f}" if block < events.n else "")
    legend = ax.legend(
        loc="upper left",
        ncols=len(_MODES),
        frameon=False,
        borderaxespad=0.0,
        fontsize="small",
        handlelength=1.0,
        handletextpad=0.4,
        columnspacing=1.0,
    )
    # space for it above the last block: outside the axes it would overlap, or be cut off
    share = min(legend.get_window_extent().height / ax.get_window_extent().height, 0.5)
    ax.set_ylim(-0.5, -0.5 + events.n / (1.0 - share))
    return ax


def picture(events: EventSeries) -> str:
    """n_stick(t) above the modes of the blocks, as an HTML image."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    draw_n_stick(events, above, {})
    draw_modes(events, below)
    above.set_xlabel("")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=100)
    return f'<img alt="n_stick and modes" src="data:image/png;base64,{b64encode(stream.getvalue()).decode()}"/>'


def _stays(events: EventSeries) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Block, mode, start and stop of every interval of a block in one mode, block by block."""
    block = np.concatenate((np.arange(events.n), events.block))
    mode = np.concatenate((events.initial_mode, events.mode))
    start = np.concatenate((np.full(events.n, events.t_start), events.t))
    order = np.argsort(block, kind="stable")
    block, mode, start = block[order], mode[order], start[order]
    stop = np.append(start[1:], events.t_end)
    stop[np.append(block[1:] != block[:-1], True)] = events.t_end
    return block, mode, start, stop


def _axes(ax: Axes | None) -> Axes:
    """The axes given, or those of a new figure: pyplot's, which a notebook shows."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]
