"""Figures 3 to 5: n_stick(t) of random systems, under either law, perturbed, and over long times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from stickslip import sim
from stickslip.analysis.questions.cascades import PAPER_GAMMA
from stickslip.analysis.stats import cascades, estimates, fates
from stickslip.analysis.stats.nulls import NullTally, random_order
from stickslip.analysis.style import CYCLE, GREY, STYLE, blank, subplots
from stickslip.pipeline.design import MATRIX
from stickslip.workflows.charts.peers import random_ratios, seed_of
from stickslip.workflows.paper.systems import LAWS, Law, PaperSystems

Fate = Literal["certified", "silent", "sustained", "diverged", "failed"]

#: Blocks stick "at first" up to this time: the rush of entries is over, few have let go.
EARLY = 5.0
#: Two runs of figure 4 are apart once n_stick differs by this much on average over so much time, sampled this often:
#: an event that comes a little later is no more than that.
_APART_BLOCKS, _APART_WINDOW, _APART_DT = 1.0, 1.0, 0.05
#: Random orders drawn for each run by the null model of the cascades.
_RESAMPLES = 40


@dataclass(frozen=True)
class Trace:
    """n_stick(t) as drawn in one panel of figure 3, 4 or 5: n_stick[k] holds on [t[k], t[k+1])."""

    figure: int
    panel: str
    n: int
    label: str
    t: list[float]
    n_stick: list[int]
    t_stop: float


@dataclass(frozen=True)
class Draw:
    """One run of figure 3: a row of the table `figure3`.

    `n_first` is the most blocks that stick up to t = `EARLY`, first at `t_first`; `t_all_slip` is when none sticks
    for the first time after it, null if never; `t_last` the last event, null if there is none; `mean` that of the
    second half of the time, null for a run that diverged.
    """

    n: int
    matrix: int
    law: Law
    fate: Fate
    n_events: int
    n_first: int
    t_first: float
    t_all_slip: float | None
    t_last: float | None
    n_stick_end: int
    mean: float | None


@dataclass(frozen=True)
class Change:
    """One perturbed run of figure 4 beside the unperturbed: a row of the table `figure4`.

    `t_apart` is when n_stick is first apart (`apart_from`), null if it never is; means are those of the second half
    of the time.
    """

    panel: str
    n: int
    label: str
    size: float | None
    fate: Fate
    t_apart: float | None
    mean: float | None
    mean_unperturbed: float | None


@dataclass(frozen=True)
class Cascades:
    """The exponential law by one definition: a row of the table `cascades`; null, with a reason, where there is none.

    `gamma` over all matrices with its interval; `gamma0` under random order.
    """

    law: Law
    definition: str
    dt: float | None
    n_matrices: int
    n_cascades: int
    gamma: float | None
    low: float | None
    high: float | None
    gamma0: float | None
    reason: str | None


@dataclass(frozen=True)
class Sizes:
    """Figure 5 (ii): how many cascades there are of each size from 1, of one run by one definition."""

    label: str
    definition: str
    counts: list[int]


def fate(outcome: str, t: np.ndarray, n_stick: np.ndarray, t_end: float) -> Fate:
    """What became of a run, from its outcome and the change points of n_stick."""
    found = fates.fate(outcome, (t, n_stick), t_end)
    return "certified" if found == fates.COLLAPSED else cast(Fate, found)


def _mean(run: sim.Run, t_end: float) -> float | None:
    """Time mean of n_stick over the second half; None for a run that diverged."""
    if run.outcome == "diverged":
        return None
    return cascades.window(*run.events.change_points(), 0.5 * t_end, t_end).time_mean()


def draw(run: sim.Run, n: int, matrix: int, law: Law, t_end: float) -> Draw:
    """The row of one run."""
    t, n_stick = run.events.change_points()
    first = int(np.argmax(np.where(t <= EARLY, n_stick, -1)))
    slips = np.flatnonzero(n_stick[first:] == 0)
    events = run.events.t
    return Draw(
        n, matrix, law, fate(run.outcome, t, n_stick, t_end), len(events), int(n_stick[first]), float(t[first]),
        float(t[first + slips[0]]) if len(slips) and n_stick[first] else None,
        float(events[-1]) if len(events) else None, int(n_stick[-1]), _mean(run, t_end),
    )  # fmt: skip


def trace(run: sim.Run, figure: int, panel: str, label: str, t_shown: float) -> Trace:
    """What is drawn of a run."""
    t, n_stick = run.events.change_points()
    seen = t <= t_shown
    stop = min(t_shown, run.events.t_end)
    return Trace(figure, panel, run.events.n, label, t[seen].tolist(), n_stick[seen].tolist(), stop)


def sensitivity(scene: PaperSystems) -> Iterator[tuple[Trace, Change | None]]:
    """Figure 4, panel by panel; each begins with the unperturbed run, which is no change."""
    last = scene.sensitivity_n[-1]
    smallest = scene.sizes[0]
    ratio_panels = [(n, f"({'ivx'[:1] * (k + 1)}) n = {n}, r redrawn") for k, n in enumerate(scene.sensitivity_n)]
    bases = {n: scene.run(scene.system(n, 0), scene.t_end, "sigmoid") for n in scene.sensitivity_n}

    def changed(panel: str, n: int, label: str, size: float | None, run: sim.Run) -> tuple[Trace, Change]:
        base = bases[n]
        t, n_stick = run.events.change_points()
        row = Change(
            panel, n, label, size, fate(run.outcome, t, n_stick, scene.t_end), apart_from(run, base),
            _mean(run, scene.t_end), _mean(base, scene.t_end),
        )  # fmt: skip
        return trace(run, 4, panel, label, scene.t_shown), row

    def base_of(panel: str, n: int) -> tuple[Trace, None]:
        return trace(bases[n], 4, panel, "unperturbed", scene.t_shown), None

    for n, panel in ratio_panels:
        yield base_of(panel, n)
        for draw in range(scene.sets):
            run = scene.run(scene.system(n, 0), scene.t_end, "sigmoid", ratio=random_ratios(scene.seed, n, draw))
            yield changed(panel, n, f"r, draw {draw}", None, run)
    panels = {
        f"(iii) n = {last}, constants moved by {100 * smallest:g} %": [
            (smallest, draw) for draw in range(scene.sets)
        ],
        f"(iv) n = {last}, constants moved by more": [(size, 0) for size in scene.sizes],
    }
    for panel, moves in panels.items():
        yield base_of(panel, last)
        for size, draw in moves:
            run = scene.run(scene.perturbed(last, size, draw), scene.t_end, "sigmoid")
            yield changed(panel, last, f"{100 * size:g} %, draw {draw}", size, run)


def apart_from(run: sim.Run, base: sim.Run) -> float | None:
    """When n_stick of two runs first differs by a block or more on average over a unit of time; None if never."""
    end = min(run.events.t_end, base.events.t_end)
    times = np.arange(0.0, end, _APART_DT)
    width = round(_APART_WINDOW / _APART_DT)
    total = np.cumsum(np.abs(run.n_stick(times) - base.n_stick(times)))
    apart = np.flatnonzero(total[width:] - total[:-width] >= _APART_BLOCKS * width)
    return float(times[width + apart[0]]) if len(apart) else None


def long_runs(scene: PaperSystems, law: Law) -> tuple[list[Cascades], list[Trace], list[Sizes]]:
    """Figure 5 under one law: gamma by every definition, the runs that are drawn, and their cascades by size."""
    laws = cascades.laws(scene.dt)
    sums: dict[cascades.Law, list[tuple[int, int]]] = {one: [] for one in laws}
    chance: dict[cascades.Law, NullTally] = {}
    shown: list[Trace] = []
    sizes: list[Sizes] = []
    rng = np.random.default_rng(seed_of(scene.seed, MATRIX, scene.long_n))
    for matrix in range(scene.long_matrices):
        run = scene.run(scene.system(scene.long_n, matrix), scene.long_t_end, law, "statistics")
        if matrix < scene.sets and law == LAWS[0]:
            shown.append(trace(run, 5, f"(i) matrix {matrix}", law, scene.long_t_end))
        if run.outcome == "diverged":
            continue
        window = cascades.window(*run.events.change_points(), scene.t_burn, scene.long_t_end)
        for one in laws:
            found = cascades.sizes(window, one)
            sums[one].append((int(found.sum()), len(found)))
            if matrix < scene.sets and law == LAWS[0] and one in (cascades.Law("events"), laws_by_samples(scene)):
                sizes.append(Sizes(f"matrix {matrix}", str(one), np.bincount(found)[1:].tolist()))
        for one, tally in random_order(window, scene.dt, _RESAMPLES, rng).items():
            chance[one] = tally if one not in chance else chance[one].__iadd__(tally)
    return [_law(law, one, np.array(sums[one]), chance.get(one)) for one in laws], shown, sizes


def laws_by_samples(scene: PaperSystems) -> cascades.Law:
    """The paper's own definition: successive increments of time in which n_stick decreases, at the longest step."""
    return cascades.Law("length", scene.dt[-1])


def _law(law: Law, one: cascades.Law, sums: np.ndarray, chance: NullTally | None) -> Cascades:
    found = estimates.over_matrices(estimates.gamma, sums, 0.95)
    gamma0 = None
    reason = found.reason
    if chance is not None:
        try:
            gamma0, _ = chance.rate()
        except estimates.Undefined as undefined:
            reason = reason or f"chance: {undefined}"
    return Cascades(
        law, one.definition, one.dt, len(sums), int(sums[:, 1].sum()) if len(sums) else 0, found.value, found.low,
        found.high, gamma0, reason or None,
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------- what they did


def draws_in_numbers(draws: Sequence[Draw], n: int, law: Law) -> dict[str, Any]:
    """Of the draws at one n: who sticks first, when the last event is, how many end with none stuck."""
    some = [row for row in draws if (row.n, row.law) == (n, law)]
    quiet = [row for row in some if row.fate in ("certified", "silent")]
    return {
        "n": n,
        "law": law,
        "n_draws": len(some),
        "n_first": [row.n_first for row in some],
        "t_first": [row.t_first for row in some],
        "quiet": len(quiet),
        "certified": sum(row.fate == "certified" for row in some),
        "diverged": sum(row.fate == "diverged" for row in some),
        "t_last": [row.t_last for row in quiet if row.t_last is not None],
        "means": [row.mean for row in some if row.mean is not None and row.fate == "sustained"],
    }


def changes_in_numbers(changes: Sequence[Change]) -> list[dict[str, Any]]:
    """For each panel of figure 4 what became of the perturbed runs beside the unperturbed one."""
    panels = {row.panel: [other for other in changes if other.panel == row.panel] for row in changes}
    return [
        {
            "panel": panel,
            "n_runs": len(some),
            "t_apart": [row.t_apart for row in some if row.t_apart is not None],
            "means": [row.mean for row in some if row.mean is not None],
            "unperturbed": some[0].mean_unperturbed,
            "quiet": [row.label for row in some if row.fate in ("certified", "silent")],
            "diverged": [row.label for row in some if row.fate == "diverged"],
        }
        for panel, some in panels.items()
    ]


def laws_in_numbers(rows: Sequence[Cascades]) -> list[dict[str, Any]]:
    """For each friction law gamma by all definitions, and where the paper's lies."""
    found = []
    for law in dict.fromkeys(row.law for row in rows):
        some = [row for row in rows if row.law == law and row.gamma is not None]
        inside = sum(
            row.low is not None and row.high is not None and row.low <= PAPER_GAMMA <= row.high for row in some
        )
        found.append({
            "law": law,
            "gammas": [row.gamma for row in some],
            "inside": inside,
            "length": [row for row in some if row.definition == "length"],
            "events": next((row for row in some if row.definition == "events"), None),
        })  # fmt: skip
    return found


# ---------------------------------------------------------------------------------------------- drawings


def curve_name(label: str) -> str:
    return {"coulomb": "exact law", "sigmoid": "sigmoid, r = 1"}.get(label, label)


def figure3(traces: Sequence[Trace]) -> Figure:
    return n_stick_panels(traces, 3, numerals=("i", "ii", "iii", "iv", "v", "vi"))


def figure4(traces: Sequence[Trace]) -> Figure:
    return n_stick_panels(traces, 4, columns=2)


def _panels(traces: Sequence[Trace], figure: int) -> dict[str, list[Trace]]:
    found: dict[str, list[Trace]] = {}
    for trace in traces:
        if trace.figure == figure:
            found.setdefault(trace.panel, []).append(trace)
    return found


def n_stick_panels(traces: Sequence[Trace], number: int, columns: int = 1, numerals: Sequence[str] = ()) -> Figure:
    """n_stick(t), one panel each with a legend of its curves.

    The first curve is thick and grey if more than two are drawn, as what the others are held against.
    """
    panels = _panels(traces, number)
    rows = -(-len(panels) // columns)
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(rows, columns, 0.4 + 1.9 * rows)
        for ax in axes.flat[len(panels) :]:
            ax.set_axis_off()
        for k, (ax, (title, curves)) in enumerate(zip(axes.flat, panels.items(), strict=False)):
            _curves(ax, curves)
            ax.set(title=f"({numerals[k]}) {title}" if k < len(numerals) else title, xlabel="time t")
            ax.set_ylabel("$n_{stick}$")
            ax.legend(loc="upper right", ncols=2 if len(curves) > 3 else 1, fontsize=7, handlelength=1.6)
    return figure


def _curves(ax: Axes, curves: Sequence[Trace]) -> None:
    with_base = len(curves) > 2
    for k, one in enumerate(curves):
        is_base = with_base and k == 0
        # thousands of steps: a picture inside the SVG keeps the report small
        ax.step(
            np.append(one.t, one.t_stop), np.append(one.n_stick, one.n_stick[-1]), where="post", rasterized=True,
            label=curve_name(one.label), color=GREY if is_base else CYCLE[(k - with_base) % len(CYCLE)],
            linewidth=2.0 if is_base else 0.8, alpha=0.55 if is_base else 1.0,
        )  # fmt: skip
    ax.set_xlim(0, max(one.t_stop for one in curves))
    ax.set_ylim(0, max(1.0, 1.35 * max(max(one.n_stick) for one in curves)))
    ax.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=5))


def figure5(traces: Sequence[Trace], cascades: Sequence[Cascades], sizes: Sequence[Sizes]) -> Figure:
    """(i) n_stick over long times; (ii) cascades of each size on a log axis, a panel a definition.

    Lines of slope -gamma, the exact law's and the paper's, go through the mean of the sizes 1.
    """
    runs = _panels(traces, 5)
    fitted = {_definition(row): row.gamma for row in cascades if row.law == LAWS[0]}
    by_law: dict[str, list[Sizes]] = {}
    for some in sizes:
        if any(some.counts):
            by_law.setdefault(some.definition, []).append(some)
    with matplotlib.rc_context(STYLE):
        figure = blank(1.0 + 1.05 * len(runs) + 2.6)
        grid = figure.add_gridspec(len(runs) + 1, len(by_law), height_ratios=[1.0] * len(runs) + [2.3])
        above: list[Axes] = []
        for k, (title, curves) in enumerate(runs.items()):
            ax = figure.add_subplot(grid[k, :], sharex=above[0] if above else None)
            above.append(ax)
            _curves(ax, curves)
            ax.set(title=title, ylabel="$n_{stick}$")
        if above:
            above[-1].set_xlabel("time t")
        for k, (name, series) in enumerate(by_law.items()):
            ax = figure.add_subplot(grid[-1, k])
            ax.set(title=f"(ii) {name}", yscale="log", xlabel="size of cascade Δ$n_{stick}$")
            for j, one in enumerate(series):
                seen = [(size, count) for size, count in enumerate(one.counts, 1) if count]
                ax.plot(*zip(*seen, strict=True), "os^v"[j % 4], color=CYCLE[j], markersize=3.5, label=one.label)
            level = np.mean([one.counts[0] for one in series])
            ends = np.array([1.0, max(len(one.counts) for one in series)])
            lines = [(fitted.get(name), "black", "-", "fit"), (PAPER_GAMMA, GREY, "--", "paper")]
            for gamma, colour, dash, label in lines:
                if gamma is not None:
                    label += f", γ = {gamma:.2f}"
                    ax.plot(ends, level * np.exp(-gamma * (ends - 1)), color=colour, linestyle=dash, label=label)
            ax.set_ylim(0.6, 2.0 * max(max(one.counts) for one in series))
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
            ax.legend(fontsize=7)
            if k == 0:
                ax.set_ylabel("number of cascades f")
    return figure


def _definition(row: Cascades) -> str:
    return row.definition if row.dt is None else f"{row.definition}, dt = {row.dt:g}"
