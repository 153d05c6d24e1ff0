"""Does gamma depend on the definition of a cascade? gamma by each, over what chance gives when counted alike."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from stickslip.analysis.answer import Answer, F, I, Row, S, frame
from stickslip.analysis.ensemble import Group, Study
from stickslip.analysis.questions.cascades import PAPER_GAMMA
from stickslip.analysis.stats import cascades
from stickslip.analysis.stats.cascades import DEFINITIONS, SAMPLED, Window
from stickslip.analysis.stats.effects import LESS, MORE, over_null, together
from stickslip.analysis.stats.estimates import gamma, over_matrices
from stickslip.analysis.stats.nulls import DRAWS, Sums, block_steps, random_order, rotations
from stickslip.analysis.style import CYCLE, GREY, panel

ORDER, BLOCKS = "order", "blocks"  # nulls: random order, and rotation of blocks
STEEPER, SHALLOWER = "steeper", "shallower"
_OVER = {"gamma": F, "over": F, "low": F, "high": F, "p_value": F, "p_adjusted": F, "verdict": S}
_DEFINITIONS: Mapping[str, str] = {
    "group": S, "threshold": F, "definition": S, "dt": F, "n_cascades": I, "n_matrices": I,
    "gamma": F, "gamma_low": F, "gamma_high": F, "reason": S,
    **{f"{null}_{name}": dtype for null in (ORDER, BLOCKS) for name, dtype in _OVER.items()},
}  # fmt: skip


@dataclass
class _Sheet:
    """Sums of a group under one threshold: by law, observed and by each null, a row a matrix."""

    group: Group
    threshold: float | None = None
    observed: Sums = field(default_factory=dict)
    nulls: dict[str, Sums] = field(default_factory=lambda: {ORDER: {}, BLOCKS: {}})

    def add(self, to: Sums, row: int, found: Sums) -> None:
        for law, one in found.items():
            to.setdefault(law, np.zeros((len(self.group.units), 2)))[row] += one


def answer(study: Study) -> Answer:
    """gamma by every definition and sampling step, and over random order and independent blocks counted alike."""
    judged = study.judged()
    if not judged:
        code, facts = study.refusal()
        return Answer(facts, lack=code)
    rows = [row for group in judged for sheet in _sheets(study, group) for row in _rows(sheet, study)]
    table = {"definitions": frame(_DEFINITIONS, rows)}
    lead = [row for row in rows if row["group"] == judged[0].label and row["threshold"] is None]
    null = BLOCKS if any(row["blocks_low"] is not None for row in lead) else ORDER
    compared = [row for row in lead if row[f"{null}_low"] is not None]
    sampled = [row for row in compared if row["definition"] in SAMPLED]
    if not sampled:
        return Answer({}, lack="few samples", tables=table)
    steps = _few(study.settings.dt)
    over = [row[f"{null}_over"] for row in compared]
    facts = {
        "group": judged[0].label, "null": null, "steps": steps, "middle": steps[len(steps) // 2],
        "least": min(sampled, key=lambda row: row["gamma"]), "most": max(sampled, key=lambda row: row["gamma"]),
        "over_least": min(over), "over_most": max(over),
        "order_most": max(lead, key=lambda row: row["order_over"] or 0.0),
        "n_compared": len(compared), "draws": min(study.settings.resamples, DRAWS),
        "n_differ": sum(row[f"{null}_verdict"] in (STEEPER, SHALLOWER) for row in compared),
        "brief": [_brief(lead, name, steps) for name in DEFINITIONS],
        "paper": PAPER_GAMMA,
        "at_paper": [row for row in sampled if row["gamma_low"] <= PAPER_GAMMA <= row["gamma_high"]],
        "thresholds": _thresholds([row for row in rows if row["threshold"] is not None]),
    }  # fmt: skip
    drawn = (ORDER, BLOCKS) if null == BLOCKS else (ORDER,)
    return Answer(facts, tables=table, figures={f"over_{one}": partial(over_chance, lead, one) for one in drawn})


def _few(dts: Sequence[float]) -> list[float]:
    """Three steps at most for the page: the shortest, the middle one and the longest."""
    some = sorted(dts)
    return some if len(some) <= 3 else [some[0], some[len(some) // 2], some[-1]]


def _sheets(study: Study, group: Group) -> list[_Sheet]:
    """What a group's runs give, and then what they give under each further threshold; all in one pass."""
    settings, events = study.settings, study.data.events
    own, further = _Sheet(group), dict[float, _Sheet]()
    dts = sorted({*settings.dt, *settings.map_dt})
    for row, member_id, win in study.windows(group):
        own.add(own.observed, row, _observed(win, dts))
        own.add(own.nulls[ORDER], row, random_order(win, dts))
        if member_id in events:
            steps = block_steps(*events[member_id], win.t_start, win.t_stop)
            draws, rng = min(settings.resamples, DRAWS), study.generator(member_id)
            own.add(own.nulls[BLOCKS], row, rotations(steps, dts, draws, rng))
        for threshold, other in study.by_threshold(member_id, win.t_stop).items():
            sheet = further.setdefault(threshold, _Sheet(group, threshold))
            sheet.add(sheet.observed, row, _observed(other, settings.dt))
            sheet.add(sheet.nulls[ORDER], row, random_order(other, settings.dt))
    return [own, *(further[threshold] for threshold in sorted(further))]


def _observed(win: Window, dts: Iterable[float]) -> Sums:
    found = cascades.sums(win.step)
    for dt in dts:
        found |= cascades.sums(win.sampled(dt), dt)
    return found


def _rows(sheet: _Sheet, study: Study) -> list[Row]:
    """One row a law; all comparisons with one null are judged together."""
    confidence = study.settings.confidence
    rows = []
    for law, observed in sheet.observed.items():
        seen = observed[:, 1] > 0
        rate = over_matrices(gamma, observed[seen], confidence)
        rows.append({
            "group": sheet.group.label, "threshold": sheet.threshold, "definition": law.definition, "dt": law.dt,
            "n_cascades": int(observed[:, 1].sum()), "n_matrices": int(seen.sum()),
            "gamma": rate.value, "gamma_low": rate.low, "gamma_high": rate.high, "reason": rate.reason or None,
        })  # fmt: skip
    for null, sums in sheet.nulls.items():
        chance = [sums.get(law, np.zeros_like(observed)) for law, observed in sheet.observed.items()]
        effects = together([
            over_null(gamma, observed[seen], one[seen], confidence)
            for observed, one in zip(sheet.observed.values(), chance, strict=True) for seen in [observed[:, 1] > 0]
        ])  # fmt: skip
        for row, one, effect in zip(rows, chance, effects, strict=True):
            verdict = effect.verdict(1 - confidence)
            row |= {
                f"{null}_gamma": over_matrices(gamma, one, confidence).value, f"{null}_over": effect.ratio.value,
                f"{null}_low": effect.ratio.low, f"{null}_high": effect.ratio.high, f"{null}_p_value": effect.p,
                f"{null}_p_adjusted": effect.p_adjusted,
                f"{null}_verdict": {MORE: STEEPER, LESS: SHALLOWER}.get(verdict, verdict),
            }  # fmt: skip
    return rows


def _brief(rows: Sequence[Row], definition: str, steps: Sequence[float]) -> Row:
    """One row a definition: gamma at a few steps, and over chance at the middle one."""
    own = {row["dt"]: row for row in rows if row["definition"] == definition}
    alone = own.get(None)  # `events` know no step
    middle = alone or own[steps[len(steps) // 2]]
    return middle | {f"gamma_{k}": (alone or own[step])["gamma"] for k, step in enumerate(steps)}


def _thresholds(rows: Sequence[Row]) -> Row | None:
    """How far the threshold moves gamma at most, by one definition and step, and gamma over random order."""
    moved = []
    for law in dict.fromkeys((row["definition"], row["dt"]) for row in rows):
        some = [row for row in rows if (row["definition"], row["dt"]) == law and row["order_over"] is not None]
        if len(some) > 1:
            rates, over = ([row[key] for row in some] for key in ("gamma", "order_over"))
            moved.append((max(rates) / min(rates), max(over) / min(over), law))
    if not moved:
        return None
    rate, over, (definition, dt) = max(moved)
    every = [row["threshold"] for row in rows]
    return {"low": min(every), "high": max(every), "definition": definition, "dt": dt, "rate": rate, "over": over}


@panel()
def over_chance(ax: Axes, rows: Sequence[Row], null: str) -> None:
    """gamma over what `ORDER` or `BLOCKS` gives, against the sampling step, by definition; the band is `events`.

    The rows are those of the table `definitions` of one group.
    """
    ax.axhline(1.0, linestyle="--", color=GREY, linewidth=1)
    known = [row for row in rows if row[f"{null}_low"] is not None]
    for row in known:
        if row["dt"] is None:
            ax.axhspan(row[f"{null}_low"], row[f"{null}_high"], color=GREY, alpha=0.3, linewidth=0, label="events")
    for k, name in enumerate(SAMPLED):
        some = sorted((row for row in known if row["definition"] == name), key=lambda row: row["dt"])
        if some:
            dt, value, low, high = (
                np.array([row[key] for row in some])
                for key in ("dt", *(f"{null}_{x}" for x in ("over", "low", "high")))
            )
            ax.errorbar(
                dt * 1.03 ** (k - 1.5), value, yerr=[value - low, high - value], label=name, color=CYCLE[k],
                fmt="oDs^"[k], linestyle=("-", "-", "--", "--")[k], markersize=3, linewidth=0.9,
            )  # fmt: skip
    ax.set_xscale("log")
    steps = sorted({row["dt"] for row in known if row["dt"] is not None})
    ax.set_xticks(steps[:: max(1, -(-len(steps) // 5))])
    ax.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.minorticks_off()
    over = {ORDER: "random order", BLOCKS: "independent blocks"}[null]
    ax.set(xlabel="sampling step dt", ylabel=f"γ / γ by {over}")
    both = [row[f"{n}_{end}"] for row in rows for n in (ORDER, BLOCKS) for end in ("low", "high")]
    ends = [x for x in both if x is not None]
    ax.set_ylim(min(0.99, *ends) - 0.01, min(max(1.01, *ends) + 0.01, 2.5))
    ax.legend(loc="upper left", fontsize=7)
