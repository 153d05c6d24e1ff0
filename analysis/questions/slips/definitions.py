"""Whether gamma depends on the definition of a cascade: gamma by each, and over that of independent blocks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from stickslip.analysis.answer import Answer, F, I, Question, Row, S, frame
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.questions.slips.cascades import GAMMA_MARGIN, PAPER_GAMMA, SHALLOWER, STEEP, STEEPER
from stickslip.analysis.series import cascades
from stickslip.analysis.series.cascades import DEFINITIONS, SAMPLED, Window
from stickslip.analysis.series.nulls import DRAWS, Sums, rotations
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats.effects import over_null, together
from stickslip.analysis.stats.estimates import gamma, over_matrices
from stickslip.analysis.style import CYCLE, GREY, panel

_DEFINITIONS: Mapping[str, str] = {
    "group": S, "definition": S, "dt": F, "n_cascades": I, "n_matrices": I, "gamma": F, "gamma_low": F,
    "gamma_high": F, "reason": S, "chance": F, "over": F, "over_low": F, "over_high": F, "p_value": F,
    "p_adjusted": F, "verdict": S,
}  # fmt: skip


def answer(study: Study) -> Answer:
    """gamma by every definition and sampling step and, if events are recorded, over that of independent blocks."""
    judged = study.judged()
    if not judged:
        code, facts = study.refusal()
        return Answer(facts, lack=code)
    rows = [row for group in judged for row in _rows(group, study)]
    table = {"definitions": frame(_DEFINITIONS, rows)}
    lead = [row for row in rows if row["group"] == judged[0].label]
    sampled = [row for row in lead if row["definition"] in SAMPLED and row["gamma_low"] is not None]
    if not sampled:
        return Answer({}, lack="few samples", tables=table)
    steps = _few(study.settings.dt)
    compared = [row for row in lead if row["over_low"] is not None]
    facts = {
        "group": judged[0].label, "steps": steps, "middle": steps[len(steps) // 2],
        "least": min(sampled, key=lambda row: row["gamma"]), "most": max(sampled, key=lambda row: row["gamma"]),
        "over": sorted(row["over"] for row in compared), "draws": min(study.settings.resamples, DRAWS),
        **counts(compared),
        "margin": GAMMA_MARGIN,
        "brief": [_brief(lead, name, steps) for name in DEFINITIONS],
        "paper": PAPER_GAMMA if judged[0].key["coupling"] == "antisymmetric" else None,
        "is_drawn": len({row["dt"] for row in sampled}) > 1,
        "spans": {name: _span(sampled, name) for name in ("length", "decreases")},
    }  # fmt: skip
    figures = {"definitions": partial(by_step, lead, "gamma", "γ")} if facts["is_drawn"] else {}
    if compared and figures:
        figures["over_blocks"] = partial(by_step, lead, "over", "γ / independent blocks")
    return Answer(facts, tables=table, figures=figures)


def counts(compared: Sequence[Row]) -> dict[str, int]:
    """Number of ratios by what is shown of them.

    `n_beyond`: the whole interval lies beyond the margin, which is one of the logarithm. `n_about`: the ratio is
    shown not to be 1 and its estimate is beyond the margin, but not its whole interval. `n_alike`: a ratio beyond the
    margin is excluded. `n_open`: none of these.
    """
    differ = [row for row in compared if row["verdict"] in (STEEPER, SHALLOWER)]
    most = 1 + GAMMA_MARGIN
    n_beyond = sum(row["over_low"] > most or row["over_high"] < 1 / most for row in differ)
    n_alike = sum(row["verdict"] == STEEP.same for row in compared)
    n_about = len(differ) - n_beyond
    return {
        "n_beyond": n_beyond, "n_about": n_about, "n_alike": n_alike,
        "n_open": len(compared) - len(differ) - n_alike,
    }  # fmt: skip


def _span(rows: Sequence[Row], definition: str) -> tuple[float, float] | None:
    """Least and largest gamma of a definition over its sampling steps."""
    found = [row["gamma"] for row in rows if row["definition"] == definition]
    return (min(found), max(found)) if found else None


def _few(dts: Sequence[float]) -> list[float]:
    """At most three steps for the page: the shortest, the middle one and the longest."""
    some = sorted(dts)
    return some if len(some) <= 3 else [some[0], some[len(some) // 2], some[-1]]


def _sums(study: Study, group: Group) -> tuple[Sums, Sums]:
    """Sums by law of a group's runs, and of independent blocks: one row a matrix, zero where nothing is known."""
    dts = sorted({*study.settings.dt, *study.settings.map_dt})
    laws = cascades.laws(dts)
    found = study.sums(group, partial(_of_run, dts, min(study.settings.resamples, DRAWS)), 4 * len(laws))
    both = found[:, :-1].reshape(-1, 2, len(laws), 2)
    observed, chance = ({law: both[:, k, i] for i, law in enumerate(laws)} for k in range(2))
    return observed, chance


def _of_run(dts: Sequence[float], draws: int, run: Run) -> np.ndarray:
    """Sums of every law of a run, and of its rotations; these are 0 without events."""
    laws, none = cascades.laws(dts), np.zeros(2)
    chance = {} if run.steps is None else rotations(run.steps, dts, draws, run.generator())
    return np.concatenate([sums.get(law, none) for sums in (_observed(run.win, dts), chance) for law in laws])


def _observed(win: Window, dts: Iterable[float]) -> Sums:
    found = cascades.sums(win.step)
    for dt in dts:
        found |= cascades.sums(win.sampled(dt), dt)
    return found


def _rows(group: Group, study: Study) -> list[Row]:
    """One row for each law of sizes; all are judged together."""
    confidence = study.settings.confidence
    observed, chance = _sums(study, group)
    seen = {law: sums[:, 1] > 0 for law, sums in observed.items()}
    effects = together([over_null(gamma, observed[law][some], chance[law][some], confidence, GAMMA_MARGIN)
                        for law, some in seen.items()])  # fmt: skip
    rows = []
    for (law, some), effect in zip(seen.items(), effects, strict=True):
        rate = over_matrices(gamma, observed[law][some], confidence)
        rows.append({
            "group": group.label, "definition": law.definition, "dt": law.dt,
            "n_cascades": int(observed[law][:, 1].sum()), "n_matrices": int(some.sum()),
            "gamma": rate.value, "gamma_low": rate.low, "gamma_high": rate.high, "reason": rate.reason or None,
            "chance": over_matrices(gamma, chance[law], confidence).value, "over": effect.ratio.value,
            "over_low": effect.ratio.low, "over_high": effect.ratio.high, "p_value": effect.p,
            "p_adjusted": effect.p_adjusted, "verdict": effect.verdict(1 - confidence, STEEP),
        })  # fmt: skip
    return rows


def _brief(rows: Sequence[Row], definition: str, steps: Sequence[float]) -> Row:
    """One row for a definition: gamma at a few steps, and over chance at the middle one."""
    own = {row["dt"]: row for row in rows if row["definition"] == definition}
    alone = own.get(None)  # `events` has no step
    middle = alone or own[steps[len(steps) // 2]]
    return middle | {f"gamma_{k}": (alone or own[step])["gamma"] for k, step in enumerate(steps)}


@panel()
def by_step(ax: Axes, rows: Sequence[Row], name: str, what: str) -> None:
    """The column `gamma` or `over` against the sampling step, one line a definition; the band is `events`.

    The rows are those of one group in the table `definitions`.
    """
    known = [row for row in rows if row[f"{name}_low"] is not None]
    if name == "over":
        ax.axhline(1.0, linestyle="--", color=GREY, linewidth=1)
    for row in known:
        if row["dt"] is None:
            ax.axhspan(row[f"{name}_low"], row[f"{name}_high"], color=GREY, alpha=0.3, linewidth=0, label="events")
    for k, definition in enumerate(SAMPLED):
        some = sorted((row for row in known if row["definition"] == definition), key=lambda row: row["dt"])
        if some:
            dt, value, low, high = (np.array([row[key] for row in some])
                                    for key in ("dt", name, f"{name}_low", f"{name}_high"))  # fmt: skip
            ax.errorbar(
                dt, value, yerr=[value - low, high - value], label=definition, color=CYCLE[k],
                fmt="oDs^"[k], linestyle=("-", "-", "--", "--")[k], markersize=3, linewidth=0.9,
            )  # fmt: skip
    ax.set_xscale("log")
    steps = sorted({row["dt"] for row in known if row["dt"] is not None})
    ax.set_xticks(steps[:: max(1, -(-len(steps) // 5))])
    ax.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.minorticks_off()
    ax.set(xlabel="sampling step dt", ylabel=what)
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize=7)


QUESTION = Question(answer, share=0.12, of_cascades=True)
