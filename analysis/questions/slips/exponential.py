"""Whether the law of cascade sizes is exponential: its variance beside that of nulls, each size, and rival laws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import Answer, F, I, Question, Row, S, frame, named
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.models import pool
from stickslip.analysis.series.cascades import EVENTS, Window
from stickslip.analysis.series.cascades import sizes as cascade_sizes
from stickslip.analysis.series.nulls import DRAWS, rotated
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats.compare import against
from stickslip.analysis.stats.dispersion import excess, moments
from stickslip.analysis.stats.effects import MANY
from stickslip.analysis.stats.estimates import Estimate, Undefined, over_matrices, paired_difference
from stickslip.analysis.stats.families import CUT_OFF, EXPONENTIAL, POWER_LAW, gamma_up_to, maximise, truncate
from stickslip.analysis.stats.goodness import goodness, quotients
from stickslip.analysis.style import EXACT, GREY, SMOOTHED, panel, size_axis

MARGIN = 0.1  # of the variance of sizes, for which a scene declares no margin
MOST_DRAWN = 2  # groups in the figure
WHOLE = 10.0  # an exponential up to n blocks is as good as one without a bound if gamma n is larger
_EXPONENTIAL: Mapping[str, str] = {
    "group": S, "smallest": I, "n_cascades": I, "n_matrices": I, "variance": F, "variance_low": F, "variance_high": F,
    "verdict": S, "pool": F, "over_pool": F, "over_pool_low": F, "over_pool_high": F, "rotation": F,
    "over_rotation": F, "over_rotation_low": F, "over_rotation_high": F, "gamma": F, "gap": F, "gap_at": I,
    "p_value": F, "p_floor": F, "fit": S, "reason": S,
}  # fmt: skip
_QUOTIENTS: Mapping[str, str] = {
    "group": S, "size": I, "n_cascades": I, "share": F, "fit": F, "value": F, "low": F, "high": F, "pool": F,
}  # fmt: skip


def answer(study: Study) -> Answer:
    """How far the variance of sizes lies from an exponential's, and how well other laws fit."""
    judged = study.judged()
    if not judged:
        code, facts = study.refusal()
        return Answer(facts, lack=code)
    smallest, level = study.settings.smallest, study.settings.confidence
    found = []
    for group in judged:
        sizes, counts = _cut(group, smallest)
        row = _row(study, group, sizes, counts)
        if row["variance_low"] is not None:
            found.append((group, row, sizes, counts))
    if not found:
        return Answer({"smallest": smallest}, lack="one size")
    group, lead, sizes, counts = found[0]
    alike = [one for one in found if one[0].key["n"] == group.key["n"]]
    each = {one.label: _quotients(one, k, some, level) for one, _, k, some in alike}
    rows = [row for _, row, _, _ in found]
    tables = {
        "exponential": frame(_EXPONENTIAL, rows),
        "over_fit": frame(_QUOTIENTS, [row for some in each.values() for row in some]),
    }
    drawn = dict(list(each.items())[:MOST_DRAWN])
    off, *ends = (lead[key] - 1 for key in ("variance", "variance_low", "variance_high"))
    facts = {
        "lead": lead, "off": off, "low": ends[0], "high": ends[1], "is_shown": not ends[0] <= 0 <= ends[1],
        "margin": MARGIN, "rows": rows, "is_cut": lead["gamma"] is not None and lead["gamma"] * sizes[-1] < WHOLE,
        "over": {key: Estimate(*(lead[f"over_{key}{end}"] for end in ("", "_low", "_high")))
                 for key in ("pool", "rotation")},
        "n": group.key["n"], "rivals": _gains(sizes, counts.sum(axis=0)),
    }  # fmt: skip
    return Answer(facts, tables=tables, figures={"over_fit": partial(over_fit, drawn)})


def _cut(group: Group, smallest: int) -> tuple[np.ndarray, np.ndarray]:
    """Sizes from the smallest on, shape (K,), and the number of cascades of each in each matrix, shape (G, K)."""
    counts = group.counts[group.counts.sum(axis=1) > 0]
    return truncate(np.pad(counts, ((0, 0), (1, 0))), smallest, max(int(group.key["n"]), smallest + 1))


def _row(study: Study, group: Group, sizes: np.ndarray, counts: np.ndarray) -> Row:
    """Row of the table `exponential`: a group's variance of sizes, that of the nulls, and the fit."""
    level = study.settings.confidence
    over = over_matrices(excess, moments(counts), level)
    fit = goodness(sizes, counts, level, study.generator(group.label))
    row: Row = {
        "group": group.label, "smallest": int(sizes[0]), "n_cascades": int(counts.sum()), "n_matrices": len(counts),
        "variance": None, "variance_low": None, "variance_high": None, "verdict": None,
        **_pool(group, sizes, counts, level), **_rotation(study, group, sizes, counts),
        "gamma": gamma_up_to(sizes, counts.sum(axis=0)), "gap": fit.gap, "gap_at": fit.at,
        "p_value": fit.p_value, "p_floor": fit.p_floor, "fit": fit.verdict(1 - level),
        "reason": over.reason or fit.reason or None,
    }  # fmt: skip
    if over.value is None or over.low is None or over.high is None:
        return row
    row |= {"variance": 1 + over.value, "variance_low": 1 + over.low, "variance_high": 1 + over.high}
    row["verdict"] = against(excess, moments(counts), MARGIN).verdict(level, MANY)
    return row


def _pool(group: Group, sizes: np.ndarray, counts: np.ndarray, confidence: float) -> Row:
    """Variance of the pool's sizes over an exponential's, and how far the runs lie from it."""
    n, mean = int(group.key["n"]), group.pool_mean
    known, over = sizes[0] == 1 and pool.is_one(n, mean), Estimate()
    if known:
        stuck = group.stuck[group.counts.sum(axis=1) > 0]
        over = over_matrices(pool.excess_against(n), np.hstack([moments(counts), stuck]), confidence)
    value = 1 + pool.excess(n, mean) if known and mean is not None else None
    return {"pool": value, **named("over_pool", over)}


def _rotation(study: Study, group: Group, sizes: np.ndarray, counts: np.ndarray) -> Row:
    """The same ratio for the runs' own blocks if they ignore each other, and how far the runs lie from it."""
    of = partial(_of_run, int(sizes[0]), min(study.settings.resamples, DRAWS))
    sums = study.sums(group, of, 3)[:, :3]
    sums = sums[group.counts.sum(axis=1) > 0]
    seen = sums[:, 0] > 0
    value, over = over_matrices(excess, sums[seen], study.settings.confidence).value, Estimate()
    if value is not None:
        both = np.hstack([moments(counts), sums])[seen]
        over = over_matrices(paired_difference(excess), both, study.settings.confidence)
    return {"rotation": None if value is None else 1 + value, **named("over_rotation", over)}


def _of_run(least: int, draws: int, run: Run) -> np.ndarray | None:
    """Sums of `moments`, from a least size on, of a run's rotations, shape (3,); None without events."""
    if run.steps is None:
        return None
    sums, rng = np.zeros(3), run.generator()
    for _ in range(draws):
        t, step = rotated(run.steps, rng)
        found = cascade_sizes(Window(0.0, run.steps.span, 0, t, step), EVENTS)
        sums += moments(np.bincount(found, minlength=least + 1)[least:])
    return sums


def _quotients(group: Group, sizes: np.ndarray, counts: np.ndarray, confidence: float) -> list[Row]:
    """Share of each size over that of the fitted exponential, for the runs and for the pool."""
    try:
        found = quotients(sizes, counts, confidence)
    except Undefined:
        return []
    n, mean = int(group.key["n"]), group.pool_mean
    law = pool.law(n, mean, int(sizes[-1])) if mean is not None and sizes[0] == 1 and pool.is_one(n, mean) else None
    return [
        {"group": group.label, **one, "pool": None if law is None else float(law[one["size"] - 1] / one["fit"])}
        for one in found
    ]


def _gains(sizes: np.ndarray, counts: np.ndarray) -> dict[str, float]:
    """Log-likelihood per cascade, in nats, of a power law and of one with a cut-off, minus the exponential's."""
    try:
        base, *others = (maximise(law, sizes, counts) for law in (EXPONENTIAL, POWER_LAW, CUT_OFF))
    except Undefined:
        return {}
    return {one.family.name: (one.log_likelihood - base.log_likelihood) / counts.sum() for one in others}


@panel()
def over_fit(ax: Axes, groups: Mapping[str, Sequence[Row]]) -> None:
    """Each size's share over the fitted exponential's, with the pool's law; rows of the table `over_fit` by group."""
    ax.axhline(1.0, color=GREY, linewidth=0.8)
    largest = 1
    for k, (label, rows) in enumerate(groups.items()):
        seen = [row for row in rows if row["low"] is not None]
        if not seen:
            continue
        size = np.array([row["size"] for row in seen], dtype=float)
        value, low, high = (np.array([row[key] for row in seen]) for key in ("value", "low", "high"))
        largest = max(largest, int(size[-1]))
        ax.errorbar(
            size + 0.12 * k, value, yerr=[value - low, high - value], label=label, fmt="os"[k % 2],
            color=(EXACT, SMOOTHED)[k % 2], markerfacecolor=(EXACT, "white")[k % 2], markersize=3.5, lw=0.9,
        )  # fmt: skip
        if k == 0 and seen[0]["pool"] is not None:
            ax.plot(size, [row["pool"] for row in seen], "--", color=GREY, label="memoryless null")
    ax.set(xlabel="cascade size s", ylabel="share / fitted exponential", ylim=(0.4, 1.4))
    size_axis(ax, largest)
    ax.legend(loc="lower left", fontsize=7)


QUESTION = Question(answer, share=0.08, of_cascades=True)
