"""The section on the law of cascade sizes: the exponential's rate, how well it fits, and its rivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from stickslip.analysis.groups import Group, generator
from stickslip.analysis.report import words
from stickslip.analysis.report.law_figures import Panel, quotient_panels
from stickslip.analysis.report.section import Column, Picture, Section, Table
from stickslip.analysis.report.tables import F, I, S, typed
from stickslip.analysis.stats.cascades import Law
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.stats.families import EXPONENTIAL, RIVALS, Fit, maximise, truncate
from stickslip.analysis.stats.goodness import (
    CUTS,
    Goodness,
    LeastSquares,
    Quotient,
    between_share,
    goodness,
    least_squares,
    quotients,
    rate,
)
from stickslip.analysis.stats.rivals import Rival, rivals

TAIL = 5  # the share of cascades of so many blocks or more is what a rival is compared by
PANELS = 6  # groups drawn
EVENTS = Law("events")
FIT_SCHEMA = {
    "group": S, "definition": S, "dt": F, "tau": F, "k_min": I, "k_max": I, "n_cascades": I, "n_matrices": I,
    "gamma": F, "gamma_low": F, "gamma_high": F, "gap": F, "gap_at": I, "gap_bound": F, "p_value": F,
    "p_least": F, "p_most": F, "verdict": S, "line": F, "line_bias": F,
    "line_spread": F, "between": F, "between_low": F, "between_high": F, "reason": S,
}  # fmt: skip
RIVAL_SCHEMA = {
    "group": S, "definition": S, "dt": F, "tau": F, "rival": S, "parameters": S, "gain": F, "gain_low": F,
    "gain_high": F, "likelihood_ratio": F, "extra": S, "extra_value": F, "extra_low": F, "extra_high": F,
    "tail": F, "tail_exponential": F, "tail_observed": F, "p_value": F, "p_adjusted": F, "verdict": S, "reason": S,
}  # fmt: skip
#: For a rival that holds the exponential: name of its extra parameter, and whether it is kept as a logarithm.
EXTRA = {
    "cut-off power law": ("alpha", False),
    "stretched exponential": ("beta", True),
    "negative binomial": ("r", True),
}


@dataclass(frozen=True)
class Judged:
    """All that is known of the sizes of one group by one definition; `reason` where there is no fit."""

    group: Group
    law: Law
    sizes: np.ndarray
    counts: np.ndarray
    gamma: Estimate
    goodness: Goodness
    between: Estimate
    line: LeastSquares | None
    base: Fit | None
    rivals: tuple[Rival, ...]

    @property
    def head(self) -> dict[str, Any]:
        return {
            "group": self.group.label, "definition": self.law.definition, "dt": self.law.dt,
            "tau": self.law.tau,
        }  # fmt: skip


def judge(group: Group, law: Law, *, confidence: float, k_min: int, seed: int) -> Judged:
    """Fit, goodness, rivals, the line and the share between matrices of one group by one definition.

    Raises
    ------
    ValueError
        If a size is larger than n, the number of blocks, or k_min is not in 1..n - 1.
    """
    data = group.by_law[law]
    rng = generator(seed, f"{group.label} / {law}")
    longest = max((len(one) for one in data.histograms), default=1)
    by_matrix = np.zeros((len(data.histograms), longest), dtype=np.int64)
    for row, one in zip(by_matrix, data.histograms, strict=True):
        row[: len(one)] = one
    sizes, counts = truncate(by_matrix, k_min, int(group.key["n"]))
    fitted = rate(sizes, counts, confidence)
    found = goodness(sizes, counts, confidence, rng)
    between = between_share(data.parts, confidence)
    if fitted.value is None or np.count_nonzero(counts.sum(axis=0)) < 2:
        return Judged(group, law, sizes, counts, fitted, found, between, None, None, ())
    line = least_squares(sizes, counts, rng)
    base = maximise(EXPONENTIAL, sizes, counts.sum(axis=0))
    others = tuple(rivals(sizes, counts, confidence))
    return Judged(group, law, sizes, counts, fitted, found, between, line, base, others)


def law_section(found: Sequence[Group], *, confidence: float = 0.95, k_min: int = 1, seed: int = 0) -> Section:
    """Are the sizes of cascades exponential, at which rate, and does another law describe them better?

    Parameters
    ----------
    found : sequence of Group
        Filled groups.
    confidence : float
    k_min : int
        Lower cut-off: cascades of fewer blocks are left out.
    seed : int
        Of the random signs and the simulated histograms.

    Raises
    ------
    ValueError
        If k_min is out of range.
    """
    level = 1 - confidence
    shown = list(found)
    judged = [
        judge(group, law, confidence=confidence, k_min=k_min, seed=seed)
        for group in shown
        for law in sorted(group.by_law, key=lambda law: law != EVENTS)
        if law.tau is None  # a block may let go twice in a cluster: n is no bound of its size
    ]
    events = [one for one in judged if one.law == EVENTS]
    fits = typed(FIT_SCHEMA, [_fit_row(one, level) for one in judged])
    rows = [row for one in judged for row in _rival_rows(one)]
    of_events = [row for row in rows if row["definition"] == EVENTS.definition]
    sampled = [row for row in rows if row["definition"] != EVENTS.definition]
    return Section(
        title="The law of the sizes",
        question="Are the sizes of cascades exponential, and does another law describe them better?",
        # groups that the fit could be tested on first: long lists are folded on the page
        statements=tuple(
            line
            for one in sorted(events, key=lambda one: (one.goodness.p_value is None, one.base is None))
            for line in _statements(one, confidence)
        ),
        lead=tuple(_statements(one, confidence)[0] for one in events if one.gamma.value is not None),
        method=(
            f"Likelihood of P(size = k) ~ exp(-gamma k), k = {k_min} to n, with intervals from leaving out matrices. "
            "The fit is tested by the largest gap between observed and fitted distribution function in units of its "
            "standard error, against random signs of each matrix's part; p is how often these give as large a gap, a "
            f"range where it depends on whether the tail is cut where {_numbers(CUTS)} cascades are expected beyond. "
            "A rival's gain is the mean over cascades of the log-likelihood under it minus that under the "
            "exponential, in nats (natural logarithms). One that holds the exponential is judged by its "
            f"extra parameter, another by Vuong's test, over matrices and adjusted for {len(RIVALS)} rivals."
        ),
        tables=(
            Table("law_fit", "The exponential by each definition.", fits, _fit_columns(), len(fits)),
            Table(
                "law_rivals", f"Rivals of the exponential, event by event; P(≥ {TAIL}) under each.",
                typed(RIVAL_SCHEMA, of_events), _rival_columns(), len(of_events),
            ),
            Table("law_rivals_sampled", "Rivals on samples.", typed(RIVAL_SCHEMA, sampled)),
        ),
        pictures=tuple(_pictures(events, confidence)),
        assumptions=tuple(_assumptions(events, level)),
    )  # fmt: skip


def _numbers(numbers: Sequence[int]) -> str:
    """Several numbers in a sentence."""
    return ", ".join(map(str, numbers[:-1])) + f" and {numbers[-1]}"


def _fit_row(one: Judged, level: float) -> dict[str, Any]:
    line, fit = one.line, one.goodness
    reasons = dict.fromkeys(text for text in (one.gamma.reason, fit.reason, one.between.reason) if text)
    return {
        **one.head, "k_min": int(one.sizes[0]), "k_max": int(one.sizes[-1]), "n_cascades": int(one.counts.sum()),
        "n_matrices": int(np.count_nonzero(one.counts.sum(axis=1))),
        "gamma": one.gamma.value, "gamma_low": one.gamma.low, "gamma_high": one.gamma.high,
        "gap": fit.gap, "gap_at": fit.at, "gap_bound": fit.bound, "p_value": fit.p_value,
        "p_least": fit.p_least, "p_most": fit.p_most, "verdict": fit.verdict(level),
        "line": line and line.slope, "line_bias": line and line.bias,
        "line_spread": line and line.spread, "between": one.between.value, "between_low": one.between.low,
        "between_high": one.between.high, "reason": "; ".join(reasons) or None,
    }  # fmt: skip


def _antilog(x: float | None) -> float | None:
    """exp(x); null where it leaves float64, as a bound does that few matrices leave open."""
    return None if x is None or x > np.log(np.finfo(np.float64).max) else float(np.exp(x))


def _rival_rows(one: Judged) -> list[dict[str, Any]]:
    total = one.counts.sum()
    observed = float(one.counts[:, one.sizes >= TAIL].sum() / total) if total else None
    rows = []
    for rival in one.rivals:
        fit, (extra, is_log) = rival.fit, EXTRA.get(rival.family.name, (None, False))
        ends = [rival.extra.value, rival.extra.low, rival.extra.high]
        value, low, high = (_antilog(x) if is_log else x for x in ends)
        rows.append({
            **one.head, "rival": rival.family.name,
            "parameters": fit and ", ".join(f"{name} = {words.number(x)}" for name, x in fit.parameters.items()),
            "gain": rival.gain, "gain_low": rival.gain_low, "gain_high": rival.gain_high,
            "likelihood_ratio": rival.likelihood_ratio,
            "extra": extra, "extra_value": value, "extra_low": low, "extra_high": high,
            "tail": fit and fit.tail(TAIL), "tail_exponential": one.base and one.base.tail(TAIL),
            "tail_observed": observed, "p_value": rival.p_value, "p_adjusted": rival.p_adjusted,
            "verdict": rival.verdict, "reason": rival.reason or (fit and fit.border) or None,
        })  # fmt: skip
    return rows


def _fit_columns() -> tuple[Column, ...]:
    return (
        Column("group", "group"), Column("definition", "definition"), Column("dt", "dt"),
        Column("cascades", "n_cascades"), Column("matrices", "n_matrices"), Column("gamma", "gamma"),
        Column("interval", ("gamma_low", "gamma_high")), Column("largest gap", "gap", 2), Column("at size", "gap_at"),
        Column("at most", "gap_bound", 2), Column("p, least", "p_least", show=words.p_text),
        Column("p, most", "p_most", show=words.p_text), Column("exponential", "verdict"),
        Column("line through the log histogram: no estimate", "line"),
        Column("its bias", "line_bias", show=words.signed),
        Column("between matrices", "between", show=words.percent), Column("note", "reason"),
    )  # fmt: skip


def _rival_columns() -> tuple[Column, ...]:
    return (
        Column("group", "group"), Column("rival", "rival"), Column("parameters", "parameters"),
        Column("gain, nats a cascade", "gain", show=words.signed), Column("interval", ("gain_low", "gain_high")),
        Column("likelihood ratio", "likelihood_ratio"), Column("extra", "extra"),
        Column("its interval", ("extra_low", "extra_high")), Column(f"P(≥ {TAIL})", "tail"),
        Column("exponential's", "tail_exponential"), Column("observed", "tail_observed"),
        Column("p, adjusted", "p_adjusted", show=words.p_text), Column("against the exponential", "verdict"),
        Column("note", "reason"),
    )  # fmt: skip


def _statements(one: Judged, confidence: float) -> list[str]:
    label, n = one.group.label, int(np.count_nonzero(one.counts.sum(axis=1)))
    if one.gamma.value is None:
        return [f"{label}: Event by event, not enough data: {one.gamma.reason}."]
    parts = [_fit_sentence(one, n, confidence), _rival_sentence(one), _line_sentence(one), _between_sentence(one)]
    return [f"{label}: {words.sentence(part)}" for part in parts if part]


def _fit_sentence(one: Judged, n: int, confidence: float) -> str:
    fit, cut = one.goodness, "" if one.sizes[0] == 1 else f", sizes from {one.sizes[0]:.0f}"
    rate_text = (
        f"gamma = {words.number(one.gamma.value)} ({words.interval_at(confidence, one.gamma.low, one.gamma.high)})"
    )
    if fit.gap is None or fit.bound is None or fit.p_least is None or fit.p_most is None:
        return f"event by event{cut}, {rate_text}; whether the exponential fits cannot be told: {fit.reason}"
    verdict = {
        "rejected": "the exponential is rejected",
        "not rejected": "the exponential is not rejected",
        "undecided": "whether the exponential is rejected depends on where the tail is cut",
    }[fit.verdict(1 - confidence)]
    at = words.p_is(fit.p_least, fit.p_most)
    if " to " in at and fit.verdict(1 - confidence) != "undecided":
        at += " by where the tail is cut"
    size = (
        f"observed and fitted P(size ≤ k) differ by {words.number(fit.gap, 2)} at most (k = {fit.at}), and a "
        f"difference above {words.number(fit.bound, 2)} is excluded"
    )
    return f"event by event{cut} {verdict} ({at}, {words.count(n, 'matrix')}): {size}. With {rate_text}"


def _rival_sentence(one: Judged) -> str:
    known = [rival for rival in one.rivals if rival.gain is not None]
    if not known or one.base is None:
        return ""
    better = [rival for rival in known if rival.verdict == "better"]
    worse = [rival for rival in known if rival.verdict == "worse"]
    best = max(known, key=lambda rival: rival.gain or 0.0)
    assert best.gain is not None
    assert best.fit is not None
    tails = (
        f"P(size ≥ {TAIL}) is {words.number(best.fit.tail(TAIL))} under it and "
        f"{words.number(one.base.tail(TAIL))} under the exponential"
    )
    gain = f"{words.number(best.gain, 2)} nats a cascade"
    if better:
        names = _listed([rival.family.name for rival in better])
        verb = "describes" if len(better) == 1 else "describe"
        text = f"{names} {verb} the sizes better, the {best.family.name} by {gain}: {tails}"
    elif best.gain > 0:
        text = (
            f"no rival is shown to describe the sizes better; the {best.family.name} comes nearest, with {gain}, "
            f"where {tails}"
        )
    else:
        text = "no rival describes the sizes better"
    if worse:
        losses = _listed([f"{rival.family.name} by {words.number(-(rival.gain or 0.0), 2)}" for rival in worse])
        text += f". The exponential describes them better than {losses} nats a cascade"
    return text


def _listed(names: Sequence[str]) -> str:
    named = [f"the {name}" for name in names]
    return named[0] if len(named) == 1 else f"{', '.join(named[:-1])} and {named[-1]}"


def _line_sentence(one: Judged) -> str:
    line = one.line
    if line is None or one.gamma.value is None:
        return ""
    return (
        f"a straight line through the log histogram, the paper's way, reads {words.number(line.slope)}; on "
        f"exponential sizes in the same number it is off by {words.signed(line.bias)} on average and scatters by "
        f"{words.number(line.spread, 2)}: it is no estimate of gamma"
    )


def _between_sentence(one: Judged) -> str:
    between = one.between
    if between.value is None or between.low is None or between.high is None:
        return f"how much of the spread of gamma lies between matrices cannot be told: {between.reason}"
    if between.low > 0:
        return (
            f"{words.percent(between.value)} of the variance of the matrices' own gamma lies between matrices "
            f"({words.percent(between.low)} to {words.percent(between.high)}), beyond what the runs' length explains"
        )
    return (
        "no spread of gamma between matrices is shown beyond what the runs' length explains; up to "
        f"{words.percent(between.high)} of the variance of the matrices' own gamma is not excluded"
    )


def _pictures(events: Sequence[Judged], confidence: float) -> list[Picture]:
    panels = []
    for one in events:
        seen: list[Quotient] = quotients(one.sizes, one.counts, confidence)
        if one.base is None or not seen:
            continue
        at = np.array([quotient.size for quotient in seen]) - int(one.sizes[0])
        base = one.base.log_shares()
        lines = [
            (rival.family.name, np.exp(rival.fit.log_shares() - base)[at])
            for rival in one.rivals
            if rival.fit is not None
        ]
        panels.append(Panel(one.group.label, seen, lines))
    if not panels:
        return []
    left = f" The first {PANELS} of {len(panels)} groups." if len(panels) > PANELS else ""
    return [
        Picture(
            partial(quotient_panels, panels[:PANELS]),
            "Share of cascades of each size, event by event, over the share that the fitted exponential gives: 1 is "
            "the exponential. Intervals over matrices; a rival that leaves the panel is far off." + left,
            "Observed over fitted share against size, with rival laws as lines.",
        )
    ]


def _assumptions(events: Sequence[Judged], level: float) -> list[str]:
    tests = [one for one in events if one.goodness.p_value is not None]
    out = [
        "Matrices are independent after t_burn; cascades within one need not be. Sizes are counted only if the whole "
        "cascade lies in the window."
    ]
    if tests:
        verdicts = [one.goodness.verdict(level) for one in tests]
        out.append(
            f"{words.count(len(tests), 'test')} of fit at {words.percent(level)}: {verdicts.count('rejected')} "
            f"rejected, {verdicts.count('undecided')} undecided; if the law held, about "
            f"{words.number(level * len(tests), 2)} would be rejected by luck. The tests of the sampled "
            "definitions come on top."
        )
    spread = [one for one in events if one.between.low is not None]
    if spread:
        shown = sum((one.between.low or 0.0) > 0 for one in spread)
        out.append(
            "One gamma for all matrices: a spread between them would make the pooled sizes a mixture. "
            f"It is shown in {shown} of {words.count(len(spread), 'group')}."
        )
    border = [f"{one.group.label}, {rival.family.name}: {rival.fit.border}" for one in events for rival in one.rivals
              if rival.fit is not None and rival.fit.border]  # fmt: skip
    if border:
        out.append(f"Likelihoods that run to a border: {'; '.join(border)}.")
    return out
