"""Why the decay rate of cascade sizes is not ln 2: finite size, blocks' own dynamics, coupling.

    gamma / ln 2 - 1 = finite size + own dynamics + coupling

    finite size     pool - ln 2       as many two-state blocks, of which finitely many can let go (`models.pool`)
    own dynamics    shifted - pool    the runs' own blocks, which have dynamics of their own, but ignore each other
    coupling        runs - shifted    what shifting each block's series in time breaks (`nulls.rotated`)

For independent blocks, with or without memory, coupling is zero; for equal blocks without memory, own dynamics are
zero too.

Lulls, which are stretches longer than `LULL` in which no block sticks, are cut out first. Nothing can let go in a
lull, yet it would count as time in which fewer blocks stick, and shifting would fill it with events of other blocks.
Every block slips at both ends of a lull, so its series continue across the cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator, PercentFormatter

from stickslip.analysis.answer import Answer, Picture, lack
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import (
    Basis,
    Comparison,
    Difference,
    Finding,
    Form,
    Lack,
    Level,
    Quantity,
    Reason,
)
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.groups import Group
from stickslip.analysis.members import ENGINE_KEYS, SYSTEM_KEYS, noun
from stickslip.analysis.models import pool
from stickslip.analysis.models.motion import lulls
from stickslip.analysis.questions.slips.cascades import (
    effects,
    gamma_shifted,
    mean_n_stick,
    of_pool,
    over_coin,
    sum_of,
)
from stickslip.analysis.series import nulls
from stickslip.analysis.series.cascades import Window, spans
from stickslip.analysis.series.nulls import BlockSteps
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import LN2, Estimate, Statistic, over_matrices, ratio, with_ends
from stickslip.analysis.style import EXACT, GREEN, GREY, SMOOTHED, bars, forest, panel

OVER_COIN, VARIANCE, SCALED = r"$\gamma/\ln 2-1$", "$nq(1-q)$", r"$nq(1-q)\,(\gamma/\ln 2-1)$"  # on the axes
#: Largest number of times that a run's blocks are shifted: their rate is known that much better than the run's.
SHIFTS = 30
WHAT = "the parts of the decay rate"
RISE = Quantity("rise", "increase of the probability of a slip onset per sticking block", Form.SHARE)

#: Columns of `run_sums`: those of `cascades.Sums.rows`, and the sums of the slope.
SLOPE, N_COLUMNS = slice(8, 10), 10


@dataclass(frozen=True)
class Counted:
    """A group without its lulls; `is_judged`, whether the runs allow a statistic of a steady state.

    `rows`, shape (G, N_COLUMNS), are the `run_sums` of the systems that have cascades, `estimates` by the names of
    `parts`.
    """

    group: Group
    rows: np.ndarray
    is_judged: bool
    share_in_lulls: float
    estimates: dict[str, Estimate]

    @property
    def n(self) -> int:
        """Number of blocks."""
        return int(self.group.key["n"])

    @property
    def variance(self) -> float:
        """n q (1 - q), where a share q of the blocks sticks."""
        mean = float(mean_n_stick(self.rows.sum(axis=0, keepdims=True))[0])
        return mean * (1 - mean / self.n)

    @property
    def others(self) -> list[object]:
        """What a group shares with groups of other n."""
        return [self.group.key[name] for name in (*SYSTEM_KEYS, *ENGINE_KEYS) if name != "n"]

    @property
    def couplings(self) -> list[Estimate]:
        """Of each system whose sizes have decay rates: not all of them are 1, nor of its time-shifted blocks."""
        n_cascades, size = self.rows[:, [0, 3]], self.rows[:, [1, 4]]
        is_known = ((size > n_cascades) & (n_cascades > 0)).all(axis=1)
        return [Estimate(float(value)) for value in parts(self.n)["coupling"](self.rows[is_known])]


def question(study: Study) -> Answer | None:
    """Why is the decay rate not ln 2?

    Differences of decay rates are relative to ln 2, that of p = 1/2. Finite size sets independent two-state
    blocks, as many and with the same mean number sticking, apart from ln 2. Each block's own dynamics sets
    time-shifted blocks apart from two-state blocks, and coupling sets the runs apart from time-shifted blocks.
    Stretches longer than 20 in which no block sticks are left out.
    """
    if not study.data.events:
        return Answer(findings=[Lack(WHAT, Reason.NOT_RECORDED, "events")])
    groups = [counts for group in study.groups if (counts := counted(study, group)) is not None]
    groups = [counts for counts in groups if counts.estimates["coupling"].low is not None]
    judged = [counts for counts in groups if counts.is_judged]
    if not judged:
        return Answer(findings=[Lack(WHAT, Reason.NOTHING_COUNTED) if study.judged() else lack(study, WHAT)])
    lead = min(
        judged, key=lambda counts: (len(counts.group) > counts.group.n_moving, -counts.n)
    )  # no survivors first
    alike = sorted((counts for counts in groups if counts.others == lead.others), key=lambda counts: counts.n)
    leads = [lead, *(counts for counts in reversed(alike) if counts is not lead and counts.is_judged)]
    unit, is_swept = noun(study.unit), len(leads) > 1
    findings: list[Finding] = [
        sum_of(counts.estimates, _where(counts, is_swept), Basis(len(counts.rows), unit)) for counts in leads
    ]
    slope = Comparison("independent two-state blocks", Difference(lead.estimates["rise_over_two_state"]))
    basis = Basis(len(lead.rows), unit)
    findings.append(Level(RISE, lead.estimates["rise"], _where(lead, is_swept), slope, basis))
    return Answer(findings=findings, figures={"counting": _picture(alike, lead, unit)})


def _picture(groups: Sequence[Counted], lead: Counted, unit: str) -> Picture:
    """The excess of several numbers of blocks, or the coupling of each system of one."""
    if len(groups) == 1:
        coupling = lead.estimates["coupling"]
        n_above = sum((coupled.value or 0.0) > 0.0 for coupled in lead.couplings)
        recipe = partial(forest, lead.couplings, coupling, "coupling, relative to ln 2", (0.0, "none"))
        return Picture(
            recipe,
            f"Coupling is positive in {n_above} of {len(lead.couplings)} {unit}s; diamond and band: all together.",
        )
    faint = "" if all(counts.is_judged for counts in groups) else " Faint: not in a steady state."
    return Picture(
        partial(by_number, groups),
        "Coupling sets runs apart from time-shifted blocks, and each block's own dynamics time-shifted from "
        f"two-state blocks. Below, times n q (1 − q), q the share that sticks, finite size is constant.{faint}",
    )


def _where(counts: Counted, is_swept: bool) -> Place:
    return Place.key("n", str(counts.n)) if is_swept else EVERYWHERE


def counted(study: Study, group: Group) -> Counted | None:
    """The parts of a group without its lulls; None if it has no events."""
    level = study.settings.confidence
    flat = study.sums(group, partial(_of_run, min(study.settings.resamples, SHIFTS)), N_COLUMNS + 6)
    rows, halves, spans = np.hsplit(flat[:, :-1], (N_COLUMNS, N_COLUMNS + 4))
    in_lulls, total = spans.sum(axis=0)
    n_cascades = rows[:, 0]
    rows, halves = rows[n_cascades > 0], halves[n_cascades > 0]
    if not len(rows):
        return None
    basis = enough.basis(halves[:, :3] / halves[:, 3:], int(n_cascades.sum()), level)
    estimates = {
        name: over_matrices(statistic, rows, level) for name, statistic in parts(int(group.key["n"])).items()
    }
    return Counted(group, rows, basis.code in enough.JUDGED, float(in_lulls / total), estimates)


def _of_run(draws: int, run: Run) -> np.ndarray | None:
    """`run_sums` of a run without its lulls, `enough.halves` and 1, its time in lulls and all of its time.

    None without events. Of a run of which nothing is left, all but the times are 0.
    """
    if run.steps is None:
        return None
    cut, steps, lull = without_lulls(run.win, run.steps)
    times = [lull, run.win.t_stop - run.win.t_start]
    if not len(cut.t):
        return np.concatenate([np.zeros(N_COLUMNS + 4), times])
    halves = enough.halves(cut.alone, np.array([np.nan]))[0]  # what is cut has no period
    return np.concatenate([run_sums(cut, steps, draws, run.generator()), halves, [1.0], times])


# ---------------------------------------- statistics


def without_lulls(win: Window, steps: BlockSteps) -> tuple[Window, BlockSteps, float]:
    """A window and its blocks' changes with the lulls cut out, and the total length of the lulls."""
    edges = np.concatenate(([win.t_start], win.t, [win.t_stop]))
    cut = np.concatenate(([0.0], np.cumsum(lulls(win.alone))))
    total = float(cut[-1])
    if not total:
        return win, steps, 0.0
    t_stop = win.t_stop - total
    of_steps = cut[np.searchsorted(edges, steps.t, side="right") - 1]
    return (
        Window(win.t_start, t_stop, win.level, win.t - cut[1:-1], win.step),
        replace(steps, t_stop=t_stop, t=np.minimum(steps.t - of_steps, t_stop)),
        total,
    )


def slope_sums(win: Window) -> np.ndarray:
    """Sums of products and of squares, for the slope of P(the next change is an exit | n_stick) within a run.

    Squares about a run's own mean are too small by the variance of that mean, a share 2 tau / T; squares about the
    means of its halves are too small by twice as much. Their difference is added, which leaves an error of second
    order in tau / T.
    """
    level, is_exit = win.path()[:-1].astype(np.float64), win.step < 0
    if len(level) < 2:
        return np.zeros(2)
    level -= level.mean()
    early, second = np.array_split(level, 2)
    late_bias = len(level) * (early.mean() - second.mean()) ** 2 / 4
    return np.array([level @ (is_exit - is_exit.mean()), level @ level + late_bias])


def run_sums(win: Window, steps: BlockSteps, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Sums of a run without lulls, shape (N_COLUMNS,), which add over runs and matrices.

    `steps` are the changes of `win`, block by block, which are shifted `draws` times.
    """
    span, size = win.t_stop - win.t_start, spans(win).size
    observed, shifted = [len(size), size.sum(), size @ size], nulls.moments(steps, draws, rng)
    return np.concatenate([observed, shifted, [win.time_mean() * span, span], slope_sums(win)])


def parts(n: int) -> dict[str, Statistic]:
    """The excess of gamma over ln 2 and its parts by name, as statistics of rows of `run_sums`."""
    return {
        **effects(n),
        "time_shifted": partial(over_coin, gamma_shifted),
        "rise": lambda rows: ratio(rows[:, SLOPE]),
        "rise_over_two_state": lambda rows: ratio(rows[:, SLOPE]) / of_pool(n, rows, pool.slope) - 1,
    }


# ---------------------------------------- figures


def _lines(ax: Axes, groups: Sequence[Counted], scaled: bool) -> None:
    """The excess of runs and of three nulls against n q (1 - q); times it if `scaled`, which levels finite size.

    Groups that are not judged are faint.
    """
    x, is_judged = np.array([counts.variance for counts in groups]), np.array([counts.is_judged for counts in groups])
    fine = np.geomspace(x.min() / 1.5, x.max() * 1.5, 60)
    scale, of_line = (x, np.ones(len(fine))) if scaled else (np.ones(len(x)), 1 / fine)
    ax.axhline(0.0, linestyle="--", color=GREY, linewidth=1, label="p = 1/2")
    ax.plot(fine, 0.25 / LN2 * of_line, color=GREEN, linewidth=0.8)
    finite = np.array([counts.estimates["finite_size"].value for counts in groups], dtype=np.float64)
    ax.plot(x, finite * scale, "D", color=GREEN, markersize=3.5, label="two-state: finite size")
    forms = (
        ("time_shifted", "s", SMOOTHED, "white", "time-shifted: own dynamics too"),
        ("excess", "o", EXACT, EXACT, "runs: coupling too"),
    )
    for name, mark, colour, face, label in forms:
        ends = with_ends(counts.estimates[name] for counts in groups) * scale
        for which, alpha, words in ((is_judged, 1.0, label), (~is_judged, 0.35, "")):
            look = {"fmt": mark, "color": colour, "markerfacecolor": face, "label": words, "alpha": alpha}
            bars(ax, x[which], ends[:, which], markersize=3.8, linewidth=0.9, **look)
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(lambda tick, _: f"{tick:g}")
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set(xlim=(fine[0], fine[-1]))


@panel(nrows=2, height=3.6, sharex=True)
def by_number(axes: Sequence[Axes], groups: Sequence[Counted]) -> None:
    """The excess over ln 2 of the runs and of three nulls at several n; below, times n q (1 - q)."""
    top, below = axes
    _lines(top, groups, scaled=False)
    _lines(below, groups, scaled=True)
    for k, counts in enumerate(groups):
        number = f"n = {counts.n}" if k == 0 else str(counts.n)
        place = (counts.variance, 1.0)
        top.annotate(
            number, place, xycoords=("data", "axes fraction"), ha="center", va="top", fontsize=6.5, color=GREY
        )
    top.yaxis.set_major_formatter(PercentFormatter(1.0))
    top.set(ylabel=OVER_COIN)
    below.set(xlabel=VARIANCE, ylabel=SCALED)
    handles, names = below.get_legend_handles_labels()
    below.figure.legend(handles, names, loc="outside upper center", ncols=2, columnspacing=1.0)
