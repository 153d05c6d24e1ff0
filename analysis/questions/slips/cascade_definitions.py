"""Other definitions of a cascade: the decay rate by each, and over that of the same blocks shifted in time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import groupby
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from stickslip.analysis.answer import F, I, Picture, Row, S, frame, named
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Difference, Family, Outcomes, Verdict
from stickslip.analysis.findings.words import listed, sentence
from stickslip.analysis.groups import Group
from stickslip.analysis.series import cascades, nulls
from stickslip.analysis.series.cascades import SAMPLED, Law
from stickslip.analysis.series.nulls import DRAWS
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats.effects import Effect, over_null, together
from stickslip.analysis.stats.estimates import Estimate, gamma, over_matrices
from stickslip.analysis.style import CYCLE, GREY, panel

SHIFTED, EVERY = "time-shifted blocks", "every definition"
_WORDS = (
    "drop: blocks that let go over samples that all fall; length: number of such samples; descent and decreases: the "
    "same, with pauses allowed; events: without samples"
)
_DEFINITIONS: Mapping[str, str] = {
    "group": S, "definition": S, "dt": F, "n_cascades": I, "n_matrices": I, "gamma": F, "gamma_low": F,
    "gamma_high": F, "reason": S, "chance": F, "over": F, "over_low": F, "over_high": F, "p_value": F,
    "p_adjusted": F, "verdict": S,
}  # fmt: skip


class Compared(NamedTuple):
    """What is said of the definitions."""

    findings: list[Outcomes]
    tables: dict[str, pd.DataFrame]
    figures: dict[str, Picture]


def compared(study: Study, group: Group) -> Compared:
    """The decay rate of a group by every definition and sampling step, beside that of blocks shifted in time."""
    rows, verdicts = _rows(study, group)
    table = {"definitions": frame(_DEFINITIONS, rows)}
    steps = {row["dt"] for row in rows if row["dt"] is not None and row["gamma_low"] is not None}
    if len(steps) < 2:
        return Compared([], table, {})
    outcomes = [_outcomes(verdicts)] if verdicts else []
    said = " ".join(sentence(outcome) for outcome in outcomes)
    caption = f"By other definitions of a cascade the decay rate depends on the sampling step. {said} {_WORDS}."
    return Compared(outcomes, table, {"definitions": Picture(partial(by_step, rows), caption)})


def _rows(study: Study, group: Group) -> tuple[list[Row], dict[Law, Verdict]]:
    """Rows of the table `definitions`, and the verdict on each law that can be compared; all are judged together."""
    level, margin = study.settings.confidence, study.margins.get("gamma")
    dts = sorted({*study.settings.dt, *study.settings.map_dt})
    laws = cascades.laws(dts)
    found = study.sums(group, partial(_of_run, dts, min(study.settings.resamples, DRAWS)), 4 * len(laws))
    sums = found[:, :-1].reshape(-1, 2, len(laws), 2)
    known = [sums[sums[:, 0, k, 1] > 0, :, k] for k in range(len(laws))]  # (G, 2, 2): observed, shifted
    effects = together([over_null(gamma, one[:, 0], one[:, 1], level, margin or 0.0) for one in known])
    rows, verdicts = [], dict[Law, Verdict]()
    n_tests = sum(effect.p is not None for effect in effects)
    for law, one, effect in zip(laws, known, effects, strict=True):
        rate = over_matrices(gamma, one[:, 0], level)
        if effect.p is not None:
            verdicts[law] = _difference(effect, margin, n_tests, 1 - level).verdict
        rows.append({
            "group": group.label, "definition": law.definition, "dt": law.dt,
            "n_cascades": int(one[:, 0, 1].sum()), "n_matrices": len(one), **named("gamma", rate),
            "reason": rate.reason or None, "chance": over_matrices(gamma, one[:, 1], level).value,
            **named("over", effect.ratio), "p_value": effect.p, "p_adjusted": effect.p_adjusted,
            "verdict": verdicts.get(law),
        })  # fmt: skip
    return rows, verdicts


def _of_run(dts: Sequence[float], draws: int, run: Run) -> np.ndarray:
    """Sums of every law of a run, and of its blocks shifted in time; these are 0 without events."""
    laws, none = cascades.laws(dts), np.zeros(2)
    observed = cascades.sums(run.win.step)
    for dt in dts:
        observed |= cascades.sums(run.win.sampled(dt), dt)
    shifted = {} if run.steps is None else nulls.sums(run.steps, dts, draws, run.generator())
    return np.concatenate([sums.get(law, none) for sums in (observed, shifted) for law in laws])


def _difference(effect: Effect, margin: float | None, n_tests: int, alpha: float) -> Difference:
    """A ratio of decay rates as their relative difference, one of many."""
    value, low, high = effect.ratio.value, effect.ratio.low, effect.ratio.high
    assert value is not None
    assert low is not None
    assert high is not None
    family = Family(n_tests, effect.p_adjusted or 0.0, effect.p_equivalent_adjusted or 0.0, alpha)
    return Difference(Estimate(value - 1, low - 1, high - 1), margin=margin, family=family)


def _outcomes(verdicts: Mapping[Law, Verdict]) -> Outcomes:
    """The sampling steps by the outcome that all definitions have there; undecided where they have no one outcome."""
    steps = sorted({law.dt for law in verdicts if law.dt is not None})
    of_step = {dt: {_outcome(verdict) for law, verdict in verdicts.items() if law.dt == dt} for dt in steps}
    ranges: dict[str, list[str]] = {"equal": [], "different": [], "undecided": []}
    for outcome, run in groupby(steps, lambda dt: next(iter(of_step[dt])) if len(of_step[dt]) == 1 else "undecided"):
        every = [f"{dt:g}" for dt in run]
        ranges[outcome].append(" to ".join(dict.fromkeys((every[0], every[-1]))))
    equal, different, undecided = (
        (f"{which} at dt = {listed(ranges[name])}",) if ranges[name] else ()
        for name, which in (("equal", EVERY), ("different", EVERY), ("undecided", "some definitions"))
    )
    return Outcomes(SHIFTED, equal, different, undecided)


def _outcome(verdict: Verdict) -> str:
    if verdict in (Verdict.EQUAL, Verdict.SAME):
        return "equal"
    return "different" if verdict in (Verdict.MORE, Verdict.LESS) else "undecided"


def by_step(rows: Sequence[Row]) -> Figure:
    """The decay rate against the sampling step, one line a definition, and below over that of blocks shifted in time.

    The rows are those of the table `definitions`; the band is `events`. What is not known is not drawn.
    """
    ratios = {"gamma": "decay rate", "over": "over time-shifted"}
    known = {name: what for name, what in ratios.items() if any(row[f"{name}_low"] is not None for row in rows)}
    return panel(nrows=len(known), sharex=True, squeeze=False)(_by_step)(known, rows)


def _by_step(grid: np.ndarray, drawn: Mapping[str, str], rows: Sequence[Row]) -> None:
    axes: Sequence[Axes] = grid.ravel().tolist()
    for ax, (name, what) in zip(axes, drawn.items(), strict=True):
        known = [row for row in rows if row[f"{name}_low"] is not None]
        for row in known:
            if row["dt"] is None:
                ax.axhspan(
                    row[f"{name}_low"], row[f"{name}_high"], color=GREY, alpha=0.3, linewidth=0, label="events"
                )
        for k, definition in enumerate(SAMPLED):
            line = sorted((row for row in known if row["definition"] == definition), key=lambda row: row["dt"])
            if line:
                columns = ("dt", name, f"{name}_low", f"{name}_high")
                dt, value, low, high = (np.array([row[column] for row in line]) for column in columns)
                ax.errorbar(
                    dt, value, yerr=[value - low, high - value], label=definition, color=CYCLE[k],
                    fmt="oDs^"[k], linestyle=("-", "-", "--", "--")[k], markersize=3, linewidth=0.9,
                )  # fmt: skip
        ax.set(xscale="log", ylabel=what)
    if "over" in drawn:
        axes[-1].axhline(1.0, linestyle="--", color=GREY, linewidth=1)
    steps = sorted({row["dt"] for row in rows if row["dt"] is not None})
    axes[-1].set_xticks(steps[:: max(1, -(-len(steps) // 5))])
    axes[-1].xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    axes[-1].xaxis.set_minor_formatter(NullFormatter())
    axes[-1].minorticks_off()
    axes[-1].set_xlabel("sampling step dt")
    axes[0].figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
