"""The law of cascade sizes: gamma event by event, against fair order and against a finite pool of blocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, NullLocator

from stickslip.analysis.answer import Answer, F, I, Question, Row, S, frame, named
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.models import pool
from stickslip.analysis.series.cascades import spans
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.compare import UNKNOWN, WITHIN, Words, against, mean_within
from stickslip.analysis.stats.estimates import LN2, Estimate, Statistic, Undefined, gamma, over_matrices
from stickslip.analysis.stats.families import gamma_up_to, truncate
from stickslip.analysis.style import EXACT, GREEN, GREY, SMOOTHED, panel, size_axis
from stickslip.pipeline.design.labels import engine_name

#: Relative margin within which gamma counts as that of chance, whatever margin a scene declares between engines.
GAMMA_MARGIN = 0.01
PAPER_GAMMA = 0.74  # figure 5 of the paper, where f is proportional to exp(-gamma dn)
STEEPER, SHALLOWER = "steeper", "shallower"
STEEP = Words(WITHIN, STEEPER, SHALLOWER)
MOST_DRAWN = 2  # groups in the figure
SHOWN = 0.06  # largest relative error of a share that is drawn over the coin's
_LAW: Mapping[str, str] = {
    "group": S, "n": I, "engine": S, "n_matrices": I, "n_cascades": I, "gamma": F, "gamma_low": F, "gamma_high": F,
    "chance": F, "difference": F, "difference_low": F, "difference_high": F, "verdict": S, "gamma_pool": F,
    "over_pool": F, "over_pool_low": F, "over_pool_high": F, "pool_verdict": S, "basis": S,
}  # fmt: skip
_SIZES: Mapping[str, str] = {
    "group": S, "size": I, "n_cascades": I, "share": F, "share_low": F, "share_high": F, "fit": F, "chance": F,
    "pool": F,
}  # fmt: skip


def answer(study: Study) -> Answer:
    """How cascade sizes fall off, and whether differently from the toss of a coin and from a pool of blocks."""
    level = study.settings.confidence
    made = [(group, _law_row(group, level)) for group in study.groups]
    sizes = [row for group, _ in made for row in _size_rows(group, level)]
    tables = {"law": frame(_LAW, [row for _, row in made]), "sizes": frame(_SIZES, sizes)}
    by_label = {row["group"]: row for _, row in made}
    judged = [(group, by_label[group.label]) for group in study.judged()]
    judged = [(group, row) for group, row in judged if row["gamma_low"] is not None]
    facts: dict[str, Any] = {
        "rows": [row for _, row in made],
        "t_burn": study.settings.t_burn,
        "margin": GAMMA_MARGIN,
    }
    if not judged:
        best = max(made, key=lambda one: one[1]["n_cascades"])[1]
        return Answer(facts | {"best": best}, lack=best["basis"], tables=tables)
    lead = [(group, row) for group, row in judged if group.key["n"] == judged[0][0].key["n"]]
    group, row = lead[0]
    facts |= {
        "lead": row,
        "paper": PAPER_GAMMA if group.key["coupling"] == "antisymmetric" else None,
        "bounded": _bounded(group, row["gamma"]),
        "only": int(seen[0]) + 1 if len(seen := np.flatnonzero(group.counts.sum(axis=0))) == 1 else None,
        "refused": [row for _, row in made if row["basis"] not in enough.JUDGED],
        "sizes": [one for one in sizes if one["group"] == group.label],
        "is_by_engine": len({row["n"] for row in by_label.values()})
        == 1
        < len({row["engine"] for row in by_label.values()}),
    }
    drawn = partial(
        size_law,
        [(one.label, [size for size in sizes if size["group"] == one.label]) for one, _ in lead[:MOST_DRAWN]],
        row,
    )
    unit, run = _one_run(study, group)
    facts["unit_drawn"] = unit
    figures = {"one_run": partial(one_run, *run), "size_law": drawn}
    return Answer(facts, tables=tables, figures=figures)


def _law_row(group: Group, confidence: float) -> Row:
    """gamma of a group against ln 2 and against the pool, each with its interval over matrices."""
    sums, basis = group.sums("gamma").rows, group.basis(confidence)
    some = sums[:, 1] > 0
    rate = over_matrices(gamma, sums[some], confidence)
    row: Row = {
        "group": group.label, "n": group.key["n"], "engine": group.key["engine"], "n_matrices": int(some.sum()),
        "n_cascades": int(sums[:, 1].sum()), "gamma": rate.value, "gamma_low": rate.low, "gamma_high": rate.high,
        "chance": LN2, **named("difference", _less(rate, LN2)), "gamma_pool": None, **named("over_pool", Estimate()),
        "verdict": UNKNOWN, "pool_verdict": UNKNOWN, "basis": basis.code, "drift": basis.drift,
        "n_runs": len(group), "n_moving": group.n_moving, "law": engine_name(group.key["engine"]),
    }  # fmt: skip
    if basis.code in enough.JUDGED:
        row["verdict"] = verdict_on(lambda of: gamma(of) - LN2, sums[some], GAMMA_MARGIN * LN2, confidence)
    mean = group.pool_mean
    if rate.value is not None and mean is not None and pool.is_one(group.key["n"], mean):
        rows = np.hstack([sums, group.stuck])[some]
        over, of_pool = (
            over_matrices(pool.against(group.key["n"]), rows, confidence),
            pool.gamma(group.key["n"], mean),
        )
        row |= {"gamma_pool": of_pool, **named("over_pool", over)}
        if basis.code in enough.JUDGED:
            row["pool_verdict"] = verdict_on(pool.against(group.key["n"]), rows, GAMMA_MARGIN * of_pool, confidence)
    return row


def _bounded(group: Group, gamma: float) -> float | None:
    """gamma of the exponential law of sizes up to n, where that is another one; None if it cannot be found either."""
    n = int(group.key["n"])
    found = gamma_up_to(*truncate(np.pad(group.counts.sum(axis=0), (1, 0)), 1, max(n, 2)))
    if found is None or abs(found - gamma) <= GAMMA_MARGIN * gamma:
        return None
    return round(found, 12)  # of equal counts 0


def _less(estimate: Estimate, number: float) -> Estimate:
    value, low, high = (None if x is None else x - number for x in (estimate.value, estimate.low, estimate.high))
    return Estimate(value, low, high)


def verdict_on(difference: Statistic, rows: np.ndarray, margin: float, confidence: float) -> str:
    """Verdict on a difference of gamma, one of `STEEP` or `UNKNOWN`, by the rule of `stats.compare`."""
    try:
        return against(difference, rows, margin).verdict(confidence, STEEP)
    except Undefined:
        return UNKNOWN


def _size_rows(group: Group, confidence: float) -> list[Row]:
    """Share of each size: observed with its interval over matrices, fitted, by the toss of a coin and in the pool."""
    counts = group.counts
    counts = counts[counts.sum(axis=1) > 0]
    if not len(counts):
        return []
    totals = counts.sum(axis=1)
    rate = over_matrices(gamma, group.sums("gamma").counted.rows, confidence).value
    n, mean = int(group.key["n"]), group.pool_mean
    by_pool = pool.law(n, mean, counts.shape[1]) if mean is not None and pool.is_one(n, mean) else None
    rows = []
    for size, column in enumerate(counts.T, start=1):
        share = mean_within(np.column_stack([column, totals]).astype(float), 1.0, confidence)
        rows.append(
            {
                "group": group.label,
                "size": size,
                "n_cascades": int(column.sum()),
                **named("share", share),
                "fit": None if rate is None else float(-np.expm1(-rate) * np.exp(-rate * (size - 1))),
                "chance": 0.5**size,
                "pool": None if by_pool is None else float(by_pool[size - 1]),
            }
        )
    return rows


def _one_run(study: Study, group: Group) -> tuple[int, tuple[Any, ...]]:
    """Unit of the first run of a group, and the arguments of `one_run`: that run, with its largest cascade."""
    row, member_id, win = next(iter(study.windows(group)))
    found = spans(win)
    one = None
    if len(found.size):
        k = int(np.argmax(found.size))
        one = int(found.size[k]), float(found.start[k]), float(found.stop[k])
    return group.units[row], (*study.runs.points(member_id), win.t_stop, study.settings.t_burn, one)


_Span = tuple[int, float, float]  # of a cascade: size, first exit, last exit


@panel()
def one_run(
    ax: Axes, t: np.ndarray, n_stick: np.ndarray, t_stop: float, t_burn: float, cascade: _Span | None
) -> None:
    """n_stick(t) of one run from its change points, with the burn-in shaded and one cascade enlarged."""
    t, n_stick = np.append(t, t_stop), np.append(n_stick, n_stick[-1])
    ax.step(t, n_stick, where="post", color=EXACT, linewidth=0.5, rasterized=True)
    ax.axvspan(0, t_burn, color=GREY, alpha=0.13, linewidth=0)
    ax.text(t_burn / 2, 0.02, "left out", transform=ax.get_xaxis_transform(), ha="center", color=GREY, fontsize=7)
    ax.set(xlim=(0, max(t_stop, t_burn)), ylim=(0, None), xlabel="time t", ylabel="blocks that stick, $n_{stick}$")
    if cascade is not None:
        size, first, last = cascade
        wide = max(4 * (last - first), 1e-6)
        seen = (t >= first - wide) & (t <= last + wide)
        ax.set_ylim(0, 2.1 * n_stick[t > t_burn].max())
        inset = ax.inset_axes((0.38, 0.6, 0.6, 0.36))
        inset.step(t[seen], n_stick[seen], where="post", color=EXACT, linewidth=0.9)
        let_go = (t >= first) & (t <= last)
        start = np.flatnonzero(let_go)[0]
        inset.step(
            np.append(first, t[let_go]), np.append(n_stick[start - 1], n_stick[let_go]), where="post",
            color=SMOOTHED, linewidth=1.8,
        )  # fmt: skip
        inset.set_title(f"one cascade, size {size}", color=SMOOTHED, fontsize=7, loc="right")
        inset.tick_params(labelsize=6)
        inset.xaxis.set_major_locator(MaxNLocator(nbins=3))
        inset.yaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))


@panel(nrows=2, height_ratios=(1.0, 1.3))
def size_law(axes: Sequence[Axes], laws: Sequence[tuple[str, Sequence[Row]]], fitted: Row) -> None:
    """Share of cascades of each size for some groups, on a log axis with the fit; below, the same over the coin's.

    The lower axes show only sizes whose shares are known to within `SHOWN`, so that the difference of gamma is
    visible. `laws` are rows of the table `sizes` by group; `fitted` is the first group's row of `law`.
    """
    top, below = axes
    largest, widest, ends = 1, 1, [1.0]
    for k, (label, rows) in enumerate(laws):
        seen = [row for row in rows if row["n_cascades"] >= 5 and row["share_low"]]
        if not seen:
            continue
        sizes = np.array([row["size"] for row in seen], dtype=float)
        share, less, more = (np.array([row["share" + end] for row in seen]) for end in ("", "_low", "_high"))
        largest, chance = max(largest, int(sizes[-1])), 0.5**sizes
        form: Any = {"fmt": "os"[k % 2], "color": (EXACT, SMOOTHED)[k % 2], "markersize": 3, "linewidth": 0.8}
        form["markerfacecolor"] = form["color"] if k % 2 == 0 else "white"
        at = sizes + 0.12 * k
        top.errorbar(at, share, yerr=[share - less, more - share], label=label, **form)
        known = more - less < 2 * SHOWN * share
        over, less, more = (x[known] / chance[known] for x in (share, less, more))
        below.errorbar(at[known], over, yerr=[over - less, more - over], **form)
        widest, ends = max(widest, *sizes[known].astype(int), 1), [*ends, *less, *more]
    grid = np.arange(1, largest + 1)
    fit, low, high = (
        None if fitted[name] is None else -np.expm1(-fitted[name]) * np.exp(-fitted[name] * (grid - 1))
        for name in ("gamma", "gamma_low", "gamma_high")
    )
    if fit is not None:
        top.plot(grid, fit, color=EXACT, linewidth=1)
        below.plot(grid, fit * 2.0**grid, color=EXACT, linewidth=1, label="fit")
    if low is not None and high is not None:
        below.fill_between(grid, low * 2.0**grid, high * 2.0**grid, color=EXACT, alpha=0.2, linewidth=0)
    by_pool = [row for row in laws[0][1] if row["pool"] is not None]
    if by_pool:
        sizes = np.array([row["size"] for row in by_pool])
        over = np.array([row["pool"] for row in by_pool]) * 2.0**sizes
        below.plot(sizes, over, ":", color=GREEN, linewidth=1.4, label="memoryless null")
    below.axhline(1.0, linestyle="--", color=GREY, linewidth=1, label="fair-coin null")
    top.set_yscale("log")
    top.yaxis.set_minor_locator(NullLocator())
    top.set(xlabel="cascade size s", ylabel="share, f")
    margin = 0.08 * (max(ends) - min(ends)) + 0.002
    below.set(ylabel="f / fair coin", xlabel="cascade size s", ylim=(min(ends) - margin, max(ends) + margin))
    size_axis(top, largest)
    size_axis(below, widest)
    if top.get_legend_handles_labels()[0]:  # no size may be known well enough
        top.legend(loc="upper right", fontsize=7)
    below.legend(loc="lower left", fontsize=7)


QUESTION = Question(answer, share=0.05, of_cascades=True, rank=5, beside=("exponential", "collective", "fates"))
