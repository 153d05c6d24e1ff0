"""Figures of the law of cascade sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, NullLocator

from stickslip.analysis.answer import Row
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.style import EXACT, GREEN, GREY, SMOOTHED, panel, size_axis

SHOWN = 0.06  # largest relative error of a share that is drawn over the coin's
FEWEST = 5  # cascades of a size that is drawn


class Largest(NamedTuple):
    """The largest cascade of a run: size, times of its first exit and of its last."""

    size: int
    first: float
    last: float


@panel()
def one_run(
    ax: Axes, t: np.ndarray, n_stick: np.ndarray, t_stop: float, t_burn: float, largest: Largest | None
) -> None:
    """n_stick(t) of one run from its change points, with the burn-in shaded and one cascade enlarged."""
    t, n_stick = np.append(t, t_stop), np.append(n_stick, n_stick[-1])
    ax.step(t, n_stick, where="post", color=EXACT, linewidth=0.5, rasterized=True)
    ax.axvspan(0, t_burn, color=GREY, alpha=0.13, linewidth=0)
    ax.text(t_burn / 2, 0.02, "left out", transform=ax.get_xaxis_transform(), ha="center", color=GREY)
    ax.set(xlim=(0, max(t_stop, t_burn)), ylim=(0, None), xlabel="time t", ylabel="blocks that stick, $n_{stick}$")
    if largest is None:
        return
    size, first, last = largest
    wide = max(4 * (last - first), 1e-6)
    seen = (t >= first - wide) & (t <= last + wide)
    ax.set_ylim(0, 2.1 * n_stick[t > t_burn].max())
    inset = ax.inset_axes((0.38, 0.6, 0.6, 0.36))
    inset.step(t[seen], n_stick[seen], where="post", color=EXACT, linewidth=0.9)
    falls = (t >= first) & (t <= last)
    start = np.flatnonzero(falls)[0]
    at, level = np.append(first, t[falls]), np.append(n_stick[start - 1], n_stick[falls])
    inset.step(at, level, where="post", color=SMOOTHED, linewidth=1.8)
    inset.set_title(f"one cascade, size {size}", color=SMOOTHED, fontsize=8, loc="right")
    inset.xaxis.set_major_locator(MaxNLocator(nbins=3))
    inset.yaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))


@panel(nrows=2, height_ratios=(1.0, 1.3))
def size_law(axes: Sequence[Axes], laws: Mapping[str, Sequence[Row]], rate: Estimate) -> None:
    """Share of cascades of each size for some groups, on a log axis with the fit; below, the same over the coin's.

    The lower axes show only sizes whose shares are known to within `SHOWN`, so that the difference of the decay rate
    is visible. `laws` are rows of the table `sizes` by group, and `rate` is the first group's.
    """
    top, below = axes
    smallest = next(iter(laws.values()))[0]["size"]
    largest, widest, ends = smallest, smallest, [1.0]
    for k, (label, rows) in enumerate(laws.items()):
        seen = [row for row in rows if row["n_cascades"] >= FEWEST and row["share_low"]]
        if not seen:
            continue
        sizes = np.array([row["size"] for row in seen], dtype=float)
        share, low, high, chance = (
            np.array([row[name] for row in seen]) for name in ("share", "share_low", "share_high", "chance")
        )
        form: Any = {"fmt": "os"[k % 2], "color": (EXACT, SMOOTHED)[k % 2], "markersize": 3, "linewidth": 0.8}
        form["markerfacecolor"] = form["color"] if k % 2 == 0 else "white"
        at = sizes + 0.12 * k
        top.errorbar(at, share, yerr=[share - low, high - share], label=label, **form)
        known = high - low < 2 * SHOWN * share
        over, low, high = (x[known] / chance[known] for x in (share, low, high))
        below.errorbar(at[known], over, yerr=[over - low, high - over], **form)
        largest, widest = max(largest, int(sizes[-1])), max(widest, *sizes[known].astype(int), 1)
        ends += [*low, *high]
    grid = np.arange(largest - smallest + 1)

    def fitted(gamma: float) -> np.ndarray:
        return np.asarray(-np.expm1(-gamma) * np.exp(-gamma * grid))

    if rate.value is not None:
        top.plot(grid + smallest, fitted(rate.value), color=EXACT, linewidth=1)
        below.plot(
            grid + smallest, fitted(rate.value) * 2.0 ** (grid + 1), color=EXACT, linewidth=1, label="exponential"
        )
    if rate.low is not None and rate.high is not None:
        first, last = (fitted(end) * 2.0 ** (grid + 1) for end in (rate.low, rate.high))
        below.fill_between(grid + smallest, first, last, color=EXACT, alpha=0.2, linewidth=0)
    two_state = [row for row in next(iter(laws.values())) if row["pool"] is not None]
    if two_state:
        over = np.array([row["pool"] / row["chance"] for row in two_state])
        below.plot(
            [row["size"] for row in two_state], over, ":", color=GREEN, linewidth=1.4, label="two-state blocks"
        )
    below.axhline(1.0, linestyle="--", color=GREY, linewidth=1, label="fair coin")
    top.set_yscale("log")
    top.yaxis.set_minor_locator(NullLocator())
    margin = 0.08 * (max(ends) - min(ends)) + 0.002
    top.set(ylabel="share, f")
    below.set(xlabel="blocks in a cascade, s", ylabel="f / fair coin", ylim=(min(ends) - margin, max(ends) + margin))
    size_axis(top, largest)
    size_axis(below, widest)
    if len(laws) > 1 and top.get_legend_handles_labels()[0]:  # no size may be known well enough
        top.legend(loc="upper right")
    below.figure.legend(*below.get_legend_handles_labels(), loc="outside upper center", ncols=3)
