"""Figures 3 to 5: n_stick(t) of random systems, unchanged, changed, and over long times; its cascades."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.signal import periodogram

from stickslip.analysis.by_key import by_key
from stickslip.analysis.models import fates
from stickslip.analysis.series import cascades
from stickslip.analysis.stats import dispersion, estimates, survival
from stickslip.analysis.style import CYCLE, EXACT, GREY, SMOOTHED, panel, size_axis
from stickslip.workflows.gallery.charts.claims import CONFIDENCE, Claim
from stickslip.workflows.gallery.charts.peers import Floats
from stickslip.workflows.gallery.paper.runs import Exits, Path

PAPER_GAMMA = 0.74  # figure 5, where f is proportional to exp(-gamma dn)
#: Two runs are apart once n_stick differs over a window so wide, on average, by half of what it does between two
#: matrices; sampled so often.
_APART, _APART_WINDOW, _APART_DT = 0.5, 1.0, 0.05
#: Exits of one block under two laws are the same exit if they are no further apart.
_TOGETHER = 1.0
#: Not before this time: that is the rush of entries, which a width moves at once.
_RUSH = 5.0
#: The period of n_stick is that of the highest peak of its spectrum, the ends of the run left out; sampled so often.
_ENDS, _PERIOD_DT, _PERIODS = 50.0, 0.25, (3.0, 60.0)
#: Matrices drawn in figure 5; sizes of the noise in figure 4 (iv).
_DRAWN, _NOISE_DRAWN = 3, (0.01, 0.02, 0.05, 0.1)


@dataclass(frozen=True)
class Row:
    """One run of a random system: a row of the table `runs`, with null for what does not apply.

    `t_last` is its last event, `mean` the time mean of n_stick after t_burn; `t_apart`, of the study "lasting", when
    n_stick parts from that of the same matrix unchanged; `period` and `swing`, its standard deviation, are those of
    n_stick but for the ends of the run.
    """

    study: str
    setting: str
    law: str
    n: int
    matrix: int
    size: float
    fate: str
    t_stop: float
    t_last: float
    mean: float | None
    t_apart: float | None
    period: float | None
    swing: float | None


@dataclass(frozen=True)
class Trace:
    """n_stick(t) as drawn in one panel: n_stick[k] holds on [t[k], t[k+1])."""

    figure: int
    panel: str
    label: str
    t: Floats
    n_stick: np.ndarray
    t_stop: float


@dataclass(frozen=True)
class Cascades:
    """The exponential law of cascade sizes by one definition, exact engine: a row of the table `cascades`.

    `gamma` over all matrices with its interval, null with a reason where there is none; `counts` from size 1 on, of
    the first matrices; `excess`, the variance of sizes over an exponential's less one.
    """

    definition: str
    dt: float | None
    n_matrices: int
    n_cascades: int
    largest: int
    gamma: float | None
    low: float | None
    high: float | None
    reason: str | None
    counts: list[list[int]]
    excess: float | None = None
    excess_low: float | None = None
    excess_high: float | None = None


@dataclass(frozen=True)
class Pairing:
    """The same matrix under the exact law and the sigmoid, once their paths have parted: a row of the table `paths`.

    Of `n_exits` under the exact law, `shared` have an exit of the same block under the sigmoid within a unit of time,
    `by_chance` if either were turned in time by a random amount; and of each the mean n_stick, and the total size and
    the number of cascades by events.
    """

    matrix: int
    n_exits: int
    shared: int
    by_chance: float
    mean: float
    mean_smoothed: float
    size: int
    cascades: int
    size_smoothed: int
    cascades_smoothed: int


def rows(paths: Sequence[Path], t_burn: float) -> list[Row]:
    """A row for each run, in order."""
    bases = {
        path.ask.matrix: path for path in paths if (path.ask.study, path.ask.setting) == ("lasting", "unchanged")
    }
    n = max((base.ask.n for base in bases.values()), default=0)
    long = [path for path in paths if path.ask.study == "long" and path.ask.n == n]
    threshold = _APART * _between_matrices(long, t_burn)
    table = []
    for path in paths:
        ask = path.ask
        base = bases[ask.matrix] if ask.study == "lasting" and ask.setting != "unchanged" and threshold > 0 else None
        fate = fates.fate(path.outcome, (path.t, path.n_stick), ask.t_end, path.growth_rate, ask.n)
        mean = None
        if fate != fates.DIVERGED and path.t_stop > t_burn:
            mean = cascades.window(path.t, path.n_stick, t_burn, path.t_stop).time_mean()
        period, swing = oscillation(path) if ask.study in ("dampings", "base") else (None, None)
        table.append(Row(
            ask.study, ask.setting, ask.law, ask.n, ask.matrix, ask.size, fate, path.t_stop, float(path.t[-1]), mean,
            apart_from(path, base, threshold) if base is not None else None, period, swing,
        ))  # fmt: skip
    return table


def _between_matrices(paths: Sequence[Path], t_burn: float) -> float:
    """How much n_stick differs on average between runs of different matrices, after t_burn."""
    times = np.arange(t_burn, min((path.t_stop for path in paths), default=t_burn), 1.0)
    values = [cascades.sample(path.t, path.n_stick, times) for path in paths]
    differences = [np.abs(values_a - values_b).mean() for values_a, values_b in pairwise(values)]
    return float(np.mean(differences)) if differences and len(times) else 0.0


def apart_from(path: Path, base: Path, blocks: float) -> float | None:
    """When n_stick of two runs first differs by so many blocks on average over a window; None if never."""
    times = np.arange(_RUSH, min(path.t_stop, base.t_stop), _APART_DT)
    width = round(_APART_WINDOW / _APART_DT)
    values, base_values = (cascades.sample(run.t, run.n_stick, times) for run in (path, base))
    total = np.cumsum(np.abs(values - base_values))
    windows = np.flatnonzero(total[width:] - total[:-width] >= blocks * width)
    return float(times[width + windows[0]]) if len(windows) else None


def oscillation(path: Path) -> tuple[float | None, float | None]:
    """Period of the highest peak of the spectrum of n_stick, and its standard deviation; None for a short run."""
    times = np.arange(_ENDS, path.t_stop - _ENDS, _PERIOD_DT)
    if len(times) * _PERIOD_DT < _PERIODS[1]:
        return None, None
    sampled = cascades.sample(path.t, path.n_stick, times)
    frequency, power = periodogram(sampled, 1.0 / _PERIOD_DT, "hann", 8 * len(times), "linear")
    band = (frequency > 1.0 / _PERIODS[1]) & (frequency < 1.0 / _PERIODS[0])
    return float(1.0 / frequency[band][np.argmax(power[band])]), float(sampled.std())


def traces(path: Path, t_shown: float, n: Sequence[int]) -> Iterator[Trace]:
    """What is drawn of each run, by panel."""
    ask, largest = path.ask, n[-1]
    if ask.study == "long" and ask.n == largest and ask.matrix < _DRAWN:
        yield _trace(path, 5, "(i)", f"matrix {ask.matrix}", ask.t_end)
    if ask.matrix:
        return
    if ask.study in ("long", "base") and ask.n in n:
        yield _trace(path, 3, f"n = {ask.n}", "exact" if ask.study == "long" else "sigmoid", t_shown)
    if ask.study in ("base", "r") and ask.n in (n[0], largest):
        panel = f"({'i' if ask.n == n[0] else 'ii'}) n = {ask.n}, r redrawn"
        yield _trace(path, 4, panel, ask.setting or "unchanged", t_shown)
    if ask.n == largest and ask.study in ("base", "constants"):
        yield _trace(path, 4, "(iii) constants moved", ask.setting or "unchanged", t_shown)
    if ask.n == largest and (ask.study == "base" or (ask.study == "dampings" and ask.size in _NOISE_DRAWN)):
        label = f"{100 * ask.size:g}%" if ask.size else "unchanged"
        yield _trace(path, 4, "(iv) all n² dampings moved", label, 0.5 * ask.t_end)


def _trace(path: Path, figure: int, panel: str, label: str, t_shown: float) -> Trace:
    early = path.t <= t_shown
    return Trace(figure, panel, label, path.t[early], path.n_stick[early], min(t_shown, path.t_stop))


def cascade_laws(paths: Sequence[Path], n: int, dt: tuple[float, ...], t_burn: float) -> list[Cascades]:
    """The exponential law of the long runs at n, by every definition."""
    windows = [
        cascades.window(path.t, path.n_stick, t_burn, path.t_stop)
        for path in paths
        if path.ask.study == "long" and path.ask.n == n and path.outcome != "diverged" and path.t_stop > t_burn
    ]
    laws = cascades.laws(dt) if windows else []
    return [_law(law, [cascades.sizes(window, law) for window in windows]) for law in laws]


def _law(law: cascades.Law, sizes: Sequence[np.ndarray]) -> Cascades:
    sums = np.array([(run.sum(), len(run)) for run in sizes])
    rate = estimates.over_matrices(estimates.gamma, sums, CONFIDENCE)
    longest = int(max(run.max(initial=1) for run in sizes))
    spread = dispersion.moments(np.array([np.bincount(run, minlength=longest + 1)[1:] for run in sizes]))
    over = estimates.over_matrices(dispersion.excess, spread, CONFIDENCE)
    return Cascades(
        law.definition, law.dt, len(sums), int(sums[:, 1].sum()), int(max(run.max(initial=0) for run in sizes)),
        rate.value, rate.low, rate.high, rate.reason or None,
        [np.bincount(run)[1:].tolist() for run in sizes[:_DRAWN]], over.value, over.low, over.high,
    )  # fmt: skip


def pairings(paths: Sequence[Path], t_from: float) -> list[Pairing]:
    """Of each matrix that ran to its end under both laws with its exits kept."""
    ended = [(path, path.exits) for path in paths if path.exits is not None and path.outcome == "finished"]
    exact, smoothed = (
        {path.ask.matrix: (path, exits) for path, exits in ended if path.ask.law == law}
        for law in ("coulomb", "sigmoid")
    )
    return [_pairing(*exact[k], *smoothed[k], t_from) for k in sorted(exact.keys() & smoothed.keys())]


def _pairing(exact: Path, exits: Exits, smoothed: Path, exits_smoothed: Exits, t_from: float) -> Pairing:
    t_to = min(exact.t_stop, smoothed.t_stop)
    (mine, of_mine), (theirs, of_theirs) = exits, exits_smoothed
    n_exits, shared, by_chance = 0, 0, 0.0
    for block in range(exact.ask.n):
        a, b = (
            t[(blocks == block) & (t > t_from) & (t <= t_to)] for t, blocks in ((mine, of_mine), (theirs, of_theirs))
        )
        edges = np.concatenate(([-np.inf], b, [np.inf]))
        place = np.searchsorted(b, a)
        n_exits += len(a)
        shared += int(np.count_nonzero(np.minimum(a - edges[place], edges[place + 1] - a) <= _TOGETHER))
        # turned by a random amount, an exit falls within so much of one with the share of time that is
        covered = np.minimum(np.diff(b), 2 * _TOGETHER).sum() + 2 * _TOGETHER if len(b) else 0.0
        by_chance += len(a) * min(float(covered) / (t_to - t_from), 1.0)
    windows = [cascades.window(path.t, path.n_stick, t_from, t_to) for path in (exact, smoothed)]
    sums = [[int(x) for x in cascades.sums(win.step)[cascades.Law("events")]] for win in windows]
    mean, mean_smoothed = (win.time_mean() for win in windows)
    return Pairing(exact.ask.matrix, n_exits, shared, by_chance, mean, mean_smoothed, *sums[0], *sums[1])


def escapes(runs: Sequence[Row], t_end: float) -> list[Claim]:
    """By size of the noise on all dampings: runs, how many left, and the median time of escape with its interval."""
    table: list[Claim] = []
    noisy = [run for run in runs if run.study == "dampings"]
    for size in sorted({row.size for row in noisy}):
        rows = [row for row in noisy if row.size == size]
        escaped = np.array([row.fate == fates.DIVERGED for row in rows])
        times = np.where(escaped, [row.t_stop for row in rows], t_end)
        half = survival.median(times, escaped, CONFIDENCE)
        count = {"size": size, "runs": len(rows), "left": int(escaped.sum())}
        table.append(count | {"median": half.value, "low": half.low, "high": half.high})
    return table


# ---------------------------------------------------------------------------------------------- drawings


def panels(traces: Sequence[Trace], number: int) -> list[Callable[[], Figure]]:
    """The panels of n_stick(t) of a figure."""
    by_panel = by_key((trace for trace in traces if trace.figure == number), lambda trace: trace.panel)
    order = sorted(by_panel, key=lambda title: (len(title), title) if number == 3 else (0, title))
    return [partial(n_stick_panel, title, by_panel[title]) for title in order]


def n_stick_panel(title: str, curves: Sequence[Trace]) -> Figure:
    """n_stick(t): curves over each other, or below each other in figure 5."""
    if curves[0].figure == 5:
        stacked = [[curve] for curve in curves]
    else:
        stacked = [sorted(curves, key=lambda curve: (curve.label != "unchanged", curve.label))]
    return panel(nrows=len(stacked), sharex=True, squeeze=False)(_n_stick)(title, stacked)


def _n_stick(axes: np.ndarray, title: str, stacked: Sequence[Sequence[Trace]]) -> None:
    for ax, curves in zip(axes.flat, stacked, strict=True):
        _curves(ax, curves)
    if stacked[0][0].figure != 5:
        axes[0, 0].legend(loc="upper right", ncols=2, fontsize=7, handlelength=1.6)
    axes[0, 0].set_title(title)
    axes[-1, 0].set_xlabel("time t")
    axes[0, 0].figure.supylabel("blocks that stick, $n_{stick}$", fontsize=9)


def _curves(ax: Axes, curves: Sequence[Trace]) -> None:
    """The first is thick and grey if more than two are drawn, as what the others are held against."""
    with_base = len(curves) > 2
    base, other = (GREY, 1.8, 0.55), (0.7, 1.0)
    looks = [base] * with_base + [(colour, *other) for colour in (EXACT, SMOOTHED, *CYCLE[2:])]
    for k, curve in enumerate(curves):
        colour, width, alpha = looks[k]
        # thousands of steps: a picture inside the SVG keeps the report small
        ax.step(
            np.append(curve.t, curve.t_stop), np.append(curve.n_stick, curve.n_stick[-1]), where="post",
            rasterized=True, label=curve.label, color=colour, linewidth=width, alpha=alpha,
        )  # fmt: skip
    ax.set_xlim(0, max(curve.t_stop for curve in curves))
    ax.set_ylim(0, max(1.0, 1.35 * max(curve.n_stick.max() for curve in curves)))
    ax.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=4))


@panel()
def escape_times(ax: Axes, runs: Sequence[Row], t_end: float) -> None:
    """When runs escape against the size of the noise on all dampings, with the median and its interval.

    Runs that are still there at the end are hollow, at t_end.
    """
    noisy = [run for run in runs if run.study == "dampings"]
    for has_left, label in ((True, "escapes"), (False, "still there at the end")):
        rows = [row for row in noisy if (row.fate == fates.DIVERGED) == has_left]
        ax.plot([100 * row.size for row in rows], [row.t_stop for row in rows], "o", color=EXACT, markersize=4,
                markerfacecolor=EXACT if has_left else "white", linestyle="none", label=label)  # fmt: skip
    for row in escapes(runs, t_end):
        value = row["median"]
        if value is not None:
            ends = [[value - (row["low"] or value)], [(row["high"] or t_end) - value]]
            ax.errorbar([112 * row["size"]], [value], yerr=ends, fmt="s", color=SMOOTHED, markersize=4, capsize=2)
    ax.errorbar([], [], fmt="s", color=SMOOTHED, markersize=4, label="median")
    title = "(v) escape under noise on all n² dampings"
    ax.set(xscale="log", yscale="log", xlabel="noise on every damping, % of ρ", ylabel="time of escape", title=title)
    sizes = sorted({100 * row.size for row in noisy})
    ax.set_xticks(sizes, [f"{size:g}" for size in sizes])
    ax.minorticks_off()
    ax.legend(loc="lower left", fontsize=7)


def by_definition(rows: Sequence[Cascades], definition: str) -> Cascades | None:
    """The row of a definition, at its longest step."""
    return next((row for row in reversed(rows) if row.definition == definition), None)


@panel(ncols=2, sharey=True)
def size_law(axes: Sequence[Axes], rows: Sequence[Cascades]) -> None:
    """Cascades of each size on a log axis, by events and by falls; the fits and the paper's law."""
    for ax, definition in zip(axes, ("events", "length"), strict=True):
        law = by_definition(rows, definition)
        if law is None or not any(map(any, law.counts)):
            continue
        for j, counts in enumerate(law.counts):
            points = [(size, count) for size, count in enumerate(counts, 1) if count]
            ax.plot(*zip(*points, strict=True), "os^"[j], color=CYCLE[j], markersize=3, label=f"matrix {j}")
        level = np.mean([counts[0] for counts in law.counts if counts])
        ends = np.array([1.0, max(map(len, law.counts))])
        for gamma, colour, dash, label in ((law.gamma, "black", "-", "fit"), (PAPER_GAMMA, GREY, "--", "paper")):
            if gamma is not None:
                law_of_size = level * np.exp(-gamma * (ends - 1))
                ax.plot(ends, law_of_size, dash, color=colour, label=f"{label}, γ = {gamma:.2f}")
        ax.set(yscale="log", ylim=(0.6, None), xlabel="size Δ$n_{stick}$")
        ax.set_title("(ii) by events" if definition == "events" else f"(ii) by falls, step {law.dt:g}")
        size_axis(ax, int(ends[1]))
        ax.legend(fontsize=6)
    axes[0].set_ylabel("number of cascades f")
