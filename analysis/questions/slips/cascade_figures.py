"""Figures of the law of cascade sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from stickslip.analysis.by_key import by_key
from stickslip.analysis.findings.numbers import signs
from stickslip.analysis.findings.words import by_ends, listed
from stickslip.analysis.stats.estimates import Estimate, with_ends
from stickslip.analysis.style import EXACT, GREEN, GREY, SMOOTHED, bars, panel, size_axis
from stickslip.pipeline.design.units import DIMENSIONLESS, Units

SHOWN = 0.2  # largest relative error of a share that is drawn relative to p = 1/2
FEWEST = 5  # cascades of a size that is drawn


class Size(NamedTuple):
    """The share of cascades of a size, observed, by the fit and of two-state blocks: a row of the table `sizes`."""

    group: str
    size: int
    n_cascades: int
    share: Estimate
    fit: float | None
    pool: float | None

    @property
    def is_seen(self) -> bool:
        return self.n_cascades >= FEWEST and bool(self.share.low)

    @property
    def is_known(self) -> bool:
        """Whether the share is known well enough to be drawn relative to p = 1/2."""
        value, low, high = self.share.value or 0.0, self.share.low or 0.0, self.share.high or 1.0
        return self.is_seen and high - low < 2 * SHOWN * value


class Largest(NamedTuple):
    """The largest cascade of a run: size, times of its first exit and of its last."""

    size: int
    first: float
    last: float


@panel()
def one_run(
    ax: Axes,
    t: np.ndarray,
    n_stick: np.ndarray,
    t_stop: float,
    t_burn: float,
    largest: Largest | None,
    units: Units = DIMENSIONLESS,
) -> None:
    """n_stick(t) of one run from its change points, with the burn-in shaded and one cascade enlarged."""
    t, n_stick = np.append(t, t_stop), np.append(n_stick, n_stick[-1])
    ax.step(t, n_stick, where="post", color=EXACT, linewidth=0.5, rasterized=True)
    ax.axvspan(0, t_burn, color=GREY, alpha=0.13, linewidth=0)
    ax.set(xlim=(0, max(t_stop, t_burn)), ylim=(0, None), ylabel="sticking blocks")
    ax.set_xlabel(units.label("time t", "time"))
    if largest is None:
        return
    size, begin, end = largest
    wide = max(4 * (end - begin), 1e-6)
    is_near = (t >= begin - wide) & (t <= end + wide)
    ax.set_ylim(0, 2.1 * n_stick[t > t_burn].max())
    inset = ax.inset_axes((0.38, 0.6, 0.6, 0.36))
    inset.step(t[is_near], n_stick[is_near], where="post", color=EXACT, linewidth=0.9)
    falls = (t >= begin) & (t <= end)
    start = np.flatnonzero(falls)[0]
    times, level = np.append(begin, t[falls]), np.append(n_stick[start - 1], n_stick[falls])
    inset.step(times, level, where="post", color=SMOOTHED, linewidth=1.8)
    inset.set_title(f"one cascade, size {size}", color=SMOOTHED, loc="right")
    inset.xaxis.set_major_locator(MaxNLocator(nbins=3))
    inset.yaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))


def size_law(laws: Mapping[str, Sequence[Size]], rate: Estimate) -> Figure:
    """Share of cascades of each size for some groups, on a log axis with the fit; below, relative to p = 1/2.

    Both axes show only sizes whose shares are known to within `SHOWN`, so that the difference of the decay rate is
    visible; where not even two are, there is the upper one alone, with all sizes. `rate` is the first group's.
    """
    if is_split(laws):
        return panel(nrows=2, height_ratios=(1.0, 1.3), sharex=True)(_size_law)(laws, shown(laws), rate)
    return panel(squeeze=False)(_size_law)(laws, shown(laws), rate)


def is_split(laws: Mapping[str, Sequence[Size]]) -> bool:
    """Whether two sizes or more can be drawn relative to p = 1/2."""
    return any(sum(size.is_known for size in sizes) > 1 for sizes in laws.values())


def shown(laws: Mapping[str, Sequence[Size]]) -> dict[str, list[Size]]:
    """The sizes that are drawn."""
    split = is_split(laws)
    return {
        label: [size for size in sizes if (size.is_known if split else size.is_seen)] for label, sizes in laws.items()
    }


def departure(sizes: Sequence[Size], of_which: str) -> str:
    """At which of the sizes drawn shares lie below and above the fit, if two or more do.

    And whether two-state blocks have such shares. A share alone lies there by chance.
    """
    below = [size for size in sizes if size.fit is not None and (size.share.high or 1.0) < size.fit]
    above = [size for size in sizes if size.fit is not None and (size.share.low or 0.0) > size.fit]
    if len(below) + len(above) < 2:
        return ""
    fit = iter(("the fitted geometric distribution", "it"))
    sides = [f"{side} {next(fit)} at {_at(off)}" for side, off in (("below", below), ("above", above)) if off]
    alike = all((size.share.low or 0.0) <= (size.pool or 0.0) <= (size.share.high or 1.0) for size in below + above)
    likeness = ", like those of independent two-state blocks" * alike
    return f"Shares{of_which} lie {' and '.join(sides)}{likeness}. "


def _at(sizes: Sequence[Size]) -> str:
    """Sizes in words, three neighbours or more by the first and the last: "s = 1, 4 and 7 to 9"."""
    stretches = by_key(enumerate(size.size for size in sizes), lambda pair: pair[1] - pair[0]).values()
    return f"s = {listed([name for stretch in stretches for name in by_ends([f'{size}' for _, size in stretch])])}"


def _size_law(
    axes: np.ndarray, laws: Mapping[str, Sequence[Size]], drawn: Mapping[str, Sequence[Size]], rate: Estimate
) -> None:
    top, *below = axes.ravel()
    smallest = next(iter(laws.values()))[0].size
    largest = max((law.size for sizes in drawn.values() for law in sizes), default=smallest)
    grid = np.arange(largest - smallest + 1)
    sizes, coin = grid + smallest, 2.0 ** -(grid + 1)

    def fitted(gamma: float) -> np.ndarray:
        return np.asarray(-np.expm1(-gamma) * np.exp(-gamma * grid))

    for ax in (top, *below):
        over = coin if ax is not top else np.ones(len(grid))
        ends = [1.0]
        for k, (label, shares) in enumerate(drawn.items()):
            k_sizes = np.array([law.size for law in shares], dtype=int)
            of_shares = with_ends(law.share for law in shares) / over[k_sizes - smallest]
            form: Any = {"fmt": "os"[k % 2], "color": (EXACT, SMOOTHED)[k % 2], "markersize": 3, "linewidth": 0.8}
            form["markerfacecolor"] = form["color"] if k % 2 == 0 else "white"
            bars(ax, k_sizes + 0.12 * k, of_shares, label=signs(label), **form)
            ends += [*of_shares[1:].flat]
        if rate.value is not None:
            ax.plot(sizes, fitted(rate.value) / over, color=EXACT, linewidth=1, label="geometric, fit")
        if rate.low is not None and rate.high is not None:
            fit_low, fit_high = (fitted(end) / over for end in (rate.low, rate.high))
            ax.fill_between(sizes, fit_low, fit_high, color=EXACT, alpha=0.2, linewidth=0)
        two_state = [law.pool for law in next(iter(laws.values()))[: len(grid)] if law.pool is not None]
        if two_state:
            pooled = np.array(two_state) / over[: len(two_state)]
            ax.plot(sizes[: len(two_state)], pooled, ":", color=GREEN, linewidth=1.4, label="two-state blocks")
        ax.plot(sizes, coin / over, "--", color=GREY, linewidth=1, label="geometric, p = 1/2")
        if ax is not top:
            margin = 0.08 * (max(ends) - min(ends)) + 0.002
            ax.set(ylabel="over p = 1/2", ylim=(min(ends) - margin, max(ends) + margin))
    top.set_yscale("log")
    top.yaxis.set_minor_locator(NullLocator())
    if below:
        is_narrow = coin[0] < 100.0 * coin[-1]  # of a decade or two, one tick or none would show
        top.yaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if is_narrow else (1.0,), numticks=4))
        top.yaxis.set_major_formatter(lambda x, _: f"{x:g}")
    top.set(ylabel="share, f")
    last_axes = (top, *below)[-1]
    last_axes.set(xlabel="blocks in a cascade, s")
    size_axis(last_axes, largest)
    last_axes.figure.legend(*last_axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
