"""The report's section on long-term robustness: tables, verdicts in words, and the forest of differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip.analysis.groups import generator
from stickslip.analysis.pairs import Comparison, Setting, settings
from stickslip.analysis.questions.robustness_words import ENDS, lead_words, statements_of, verdict_words
from stickslip.analysis.questions.survival_section import fates
from stickslip.analysis.report import change_figures, words
from stickslip.analysis.report.section import Column, Data, Rows, Section, Table
from stickslip.analysis.report.tables import F, I, S, typed
from stickslip.analysis.stats.cascades import window
from stickslip.analysis.stats.compare import (
    EQUIVALENT,
    OPEN,
    Compared,
    judge_together,
    matrices_needed,
    share_over_matrices,
    verdict,
)
from stickslip.analysis.stats.quantities import BAND, LABELS
from stickslip.analysis.stats.robustness import (
    Result,
    Summary,
    compare,
    period_by_redraw,
    period_counts,
    redrawn,
    summary,
    value_of,
)

_SCHEMA = {
    "setting": S, "n": I, "engine": S, "kind": S, "reading": S, "size": F, "change": S, "quantity": S,
    "n_matrices": I, "base": F, "changed": F, "difference": F, "low": F, "high": F, "narrow_low": F,
    "narrow_high": F, "margin": F, "p_equivalent": F, "p_different": F, "p_equivalent_holm": F,
    "p_different_holm": F, "verdict": S, "matrices_needed": I, "typical": F, "noise": F, "redraw": F,
    "against_redraw": F, "against_low": F, "against_high": F, "statement": S,
}  # fmt: skip
_RUNS = {
    "setting": S, "change": S, "n_runs": I, "n_matrices": I, "n_compared": I, "n_collapsed": I, "n_diverged": I,
    "n_silent": I, "n_failed": I, "correlation_time": F, "effective_samples": F, "n_short": I,
}  # fmt: skip
_FREQUENCY = {
    "setting": S, "kind": S, "reading": S, "size": F, "change": S, "event": S, "n_runs": I, "n_matrices": I,
    "n_events": I, "share": F, "low": F, "high": F, "effective_runs": F, "share_base": F, "share_redraw": F,
}  # fmt: skip


@dataclass(frozen=True)
class _Judged:
    """One comparison with its runs' summaries and results by quantity."""

    setting: Setting
    comparison: Comparison
    results: list[Result]


def robustness_section(
    data: Data, *, t_burn: float, margins: Mapping[str, float], confidence: float, seed: int = 0
) -> Section | None:
    """Long-term robustness: changed runs against their bases by equivalence tests; None without changed members.

    Parameters
    ----------
    data : Data
        `members`, and `series` of the finished ones.
    t_burn : float
        Statistics use [t_burn, t_end].
    margins : mapping of str to float
        By name of `LABELS` in `analysis.stats.quantities`, relative to the base (`distribution`: to the base's
        standard deviation in time). Only these quantities are judged.
    confidence : float
        Of every interval; the tests are made at alpha = 1 - confidence.
    seed : int
        Root of the random exchanges that the distributions are compared with.

    Raises
    ------
    ValueError
        If a margin's name is unknown or a margin is not positive.
    """
    for name, margin in margins.items():
        if name not in LABELS:
            raise ValueError(f"margins: expected names among {', '.join(LABELS)}, got {name!r}")
        if not margin > 0:
            raise ValueError(f"margins: expected {name} > 0, got {margin!r}; 0.1 allows 10% of the base")
    some = [setting for setting in settings(data.members) if setting.comparisons]
    if not some or not margins:
        return None
    alpha = 1 - confidence
    fate = fates(data)
    tests: Rows = []
    runs_rows: Rows = []
    frequencies: Rows = []
    statements: list[str] = []
    notes: list[str] = []
    lead: list[str] = []
    panels = []
    for setting in some:
        runs = _summaries(data, setting, t_burn)
        judged = [
            _Judged(
                setting,
                comparison,
                [
                    compare(comparison, runs, name, margin, confidence, _rng(seed, comparison))
                    for name, margin in margins.items()
                ],
            )
            for comparison in setting.comparisons
        ]
        rows = _test_rows(judged, alpha)
        tests += rows + _redraw_rows(setting, runs, margins, alpha)
        counts = [_frequency_rows(one, runs, fate, setting, confidence) for one in setting.comparisons]
        frequencies += [row for part in counts for row in part]
        runs_rows += _runs_rows(data, setting, runs, fate, t_burn)
        answers, less = statements_of(setting, rows, [row for part in counts for row in part], confidence)
        statements += answers
        notes += less
        lead += lead_words(setting, rows, [row for part in counts for row in part], is_first=not lead)
        shown = [row for row in rows if row["difference"] is not None]
        if shown:
            panels.append((setting.label, shown))
    return Section(
        title="Long-term robustness",
        question="Do runs with changed constants, stiffness ratios or start keep the statistics of their base?",
        statements=tuple(f"{text}." for text in (*statements, *notes)),
        lead=tuple(f"{text}." for text in lead),
        method=_method(t_burn, margins, confidence),
        tables=_tables(tests, runs_rows, frequencies),
        pictures=(change_figures.forest(panels),) if panels else (),
        of_changes=True,
        assumptions=_assumptions(tests, runs_rows),
    )


def _rng(seed: int, comparison: Comparison) -> np.random.Generator:
    return generator(seed, f"{comparison.setting}: {comparison.change}")


def _summaries(data: Data, setting: Setting, t_burn: float) -> dict[str, Summary]:
    """Of the runs that reached t_end and still change after t_burn."""
    wanted = {pair.base for c in setting.comparisons for pair in c.pairs} | set(setting.bases.values())
    wanted |= {pair.changed for c in setting.comparisons for pair in c.pairs}
    finished = data.members[(data.members["outcome"] == "finished") & data.members["member_id"].isin(wanted)]
    found = {}
    for member_id, t_end in zip(finished["member_id"], finished["t_end"], strict=True):
        one = summary(window(*data.series[member_id], t_burn, float(t_end)), int(setting.key["n"]))
        if one is not None:
            found[str(member_id)] = one
    return found


def _identity(setting: Setting, comparison: Comparison) -> dict[str, Any]:
    change = comparison.change
    return {
        "setting": setting.label, "n": setting.key["n"], "engine": setting.key["engine"], "kind": change.kind,
        "reading": change.reading, "size": change.size or None, "change": str(change),
    }  # fmt: skip


def _test_rows(judged: Sequence[_Judged], alpha: float) -> Rows:
    """One row a comparison and quantity; Holm's rule over all rows of the setting, each kind of test by itself."""
    rows = []
    for one in judged:
        untested = [result for result in one.results if result.test is None]
        # one row with the reason where no quantity can be compared
        results = untested[:1] if len(untested) == len(one.results) else one.results
        rows += [_identity(one.setting, one.comparison) | _result_row(result, alpha) for result in results]
    judge_together(rows, alpha)
    for row in rows:
        if row["p_equivalent"] is None:
            continue
        spread = row["error"] * np.sqrt(row["n_matrices"])
        if row["verdict"] == OPEN:
            row["matrices_needed"] = matrices_needed(spread, row["margin"], alpha / row["n_tests"])
        row["statement"] = verdict_words(row)
    return rows


def _result_row(result: Result, alpha: float) -> dict[str, Any]:
    names: tuple[str, ...] = ("quantity", "n_matrices", "base", "changed", "typical", "noise", "redraw")
    names += ("against_redraw", "against_low", "against_high")
    row: dict[str, Any] = {name: getattr(result, name) for name in names}
    if result.test is None:
        return row | {
            "difference": None, "p_equivalent": None, "p_different": None, "verdict": OPEN,
            "statement": f"not enough data: {result.reason}",
        }  # fmt: skip
    return row | _test_row(result.test, alpha)


def _test_row(test: Compared, alpha: float) -> dict[str, Any]:
    (low, high), (narrow_low, narrow_high) = test.interval(1 - alpha), test.interval(1 - 2 * alpha)
    return {
        "difference": test.difference, "error": test.error, "low": low, "high": high, "narrow_low": narrow_low,
        "narrow_high": narrow_high, "margin": test.margin, "p_equivalent": test.p_equivalent,
        "p_different": test.p_different,
    }  # fmt: skip


def _redraw_rows(setting: Setting, runs: Mapping[str, Summary], margins: Mapping[str, float], alpha: float) -> Rows:
    """The unpaired test on every second matrix against the others: what it says when everything is redrawn."""
    bases = [runs[base] for base in setting.bases.values() if base in runs]
    rows = []
    for name, margin in margins.items():
        test = redrawn(bases, name, margin)
        if test is None:
            continue
        row = {
            "setting": setting.label, "n": setting.key["n"], "engine": setting.key["engine"], "kind": "redraw",
            "change": "all matrices redrawn", "quantity": name, "n_matrices": len(bases), **_test_row(test, alpha),
        }  # fmt: skip
        row["verdict"] = row["by_itself"] = verdict(test.p_equivalent, test.p_different, alpha)
        row["statement"] = verdict_words(row)
        rows.append(row)
    return rows


def _runs_rows(
    data: Data, setting: Setting, runs: Mapping[str, Summary], fate: Mapping[str, str], t_burn: float
) -> Rows:
    span = dict(zip(data.members["member_id"], data.members["t_end"] - t_burn, strict=True))
    groups = [("none", list(setting.bases.values()), len(setting.bases))]
    groups += [(str(c.change), [p.changed for p in c.pairs], c.n_matrices) for c in setting.comparisons]
    rows = []
    for change, ids, n_matrices in groups:
        taus = {member: value_of("correlation_time", runs[member].whole[None])[0] for member in ids if member in runs}
        found = [fate[member] for member in ids]
        rows.append(
            {
                "setting": setting.label, "change": change, "n_runs": len(ids), "n_matrices": n_matrices,
                "n_compared": len(taus), **{f"n_{name}": found.count(name) for name in
                                            ("collapsed", "diverged", "silent", "failed")},
                "correlation_time": float(np.mean(list(taus.values()))) if taus else None,
                "effective_samples": sum(float(span[m]) / (2 * tau) for m, tau in taus.items()) if taus else None,
                "n_short": sum(runs[member].is_short for member in taus),
            }
        )  # fmt: skip
    return rows


def _frequency_rows(
    comparison: Comparison, runs: Mapping[str, Summary], fate: Mapping[str, str], setting: Setting, confidence: float
) -> Rows:
    """How often changed runs show a period near 20, or end in each fate; beside the bases and a redraw."""
    identity = _identity(setting, comparison)
    bases = [runs[base] for base in setting.bases.values() if base in runs]
    rows = []
    counts = period_counts(comparison, runs)
    if len(counts):
        rows.append(
            identity | _share_row("period near 20", counts, confidence) | {"share_redraw": period_by_redraw(bases)}
        )
    for name, event in ENDS.items():
        by_matrix: dict[int, np.ndarray] = {}
        for pair in comparison.pairs:
            if fate[pair.changed] != "failed":
                hit = np.array([fate[pair.changed] == name, 1.0])
                by_matrix[pair.matrix] = by_matrix.get(pair.matrix, np.zeros(2)) + hit
        if by_matrix:
            of_base = [fate[base] == name for base in setting.bases.values() if fate[base] != "failed"]
            rows.append(
                identity
                | _share_row(event, np.array(list(by_matrix.values())), confidence)
                | {"share_base": float(np.mean(of_base)) if of_base else None}
            )
    return rows


def _share_row(event: str, counts: np.ndarray, confidence: float) -> dict[str, Any]:
    share, low, high, trials = share_over_matrices(counts, confidence)
    return {
        "event": event, "n_runs": int(counts[:, 1].sum()), "n_matrices": len(counts),
        "n_events": int(counts[:, 0].sum()), "share": share, "low": low, "high": high, "effective_runs": trials,
    }  # fmt: skip


def _method(t_burn: float, margins: Mapping[str, float], confidence: float) -> str:
    declared = ", ".join(f"{LABELS[name]} {words.percent(margin)}" for name, margin in margins.items())
    alpha = words.percent(1 - confidence)
    return (
        f"Each quantity is taken on t >= {t_burn:g} and set against the base of the same matrix: two one-sided t "
        f"tests at {alpha}, jackknife errors over matrices, margins declared beforehand ({declared}; the "
        "distribution's in "
        "standard deviations of n_stick in time; it is tested by random exchanges of changed and base). "
        "Equivalent: the tests reject both margins, be there a difference "
        "within them or none. Different: not equivalent, and the test of no difference rejects. Not enough data: "
        "neither. Both kinds of p-value are adjusted by Holm's rule over all changes and quantities of one setting; "
        "the intervals are not. Matrices needed: for power 0.8 at no difference and the strictest step of that rule. "
        "Noise: how two runs of one matrix would differ by the length of the window alone, from the halves of each "
        "run; where oscillations outlast a half it is too low. Redraw: how two different matrices differ. A period "
        f"near 20: the share of the variance in periods {BAND[0]:g} to {BAND[1]:g} is over twice the base's. Several "
        "draws of one matrix are averaged, and count in a frequency for as many runs as their scatter over matrices "
        "allows."
    )


def _assumptions(tests: Rows, runs_rows: Rows) -> tuple[str, ...]:
    left = sum(row["n_runs"] - row["n_compared"] for row in runs_rows)
    total = sum(row["n_runs"] for row in runs_rows)
    short = sum(row["n_short"] for row in runs_rows)
    compared = sum(row["n_compared"] for row in runs_rows)
    found = [
        "Only runs that reach t_end in motion are compared: "
        + (f"{left} of {total} are left out, and sameness of the others does not cover them." if left else "all do.")
    ]
    if compared:
        found.append(
            f"The window should be long against the correlation time: in {short} of {compared} runs it holds fewer "
            "than "
            "20 of them. The tests rest on the scatter over matrices, not on these times."
        )
    control = [row for row in tests if row["kind"] == "redraw"]
    if control:
        same = sum(row["verdict"] == EQUIVALENT for row in control)
        found.append(
            f"Control: with all matrices redrawn (every second against the others, unpaired) {same} of "
            f"{len(control)} "
            "quantities are called equivalent at these margins."
        )
    return tuple(found)


def _tables(tests: Rows, runs_rows: Rows, frequencies: Rows) -> tuple[Table, ...]:
    percent = words.percent
    return (
        Table(
            "robustness",
            "Changed runs against their bases. Differences are relative to the base.",
            typed(_SCHEMA, tests),
            (
                Column("setting", "setting"), Column("change", "change"), Column("quantity", "quantity"),
                Column("matrices", "n_matrices"), Column("base", "base"),
                Column("difference", "difference", show=words.signed_percent),
                Column("typical", "typical", show=percent), Column("noise", "noise", show=percent),
                Column("redraw", "redraw", show=percent), Column("typical / redraw", "against_redraw", 2),
                Column("verdict", "statement"),
            ),
        ),
        Table(
            "robustness_frequency",
            "How often changed runs show the paper's observations, and each fate.",
            typed(_FREQUENCY, frequencies),
            (
                Column("setting", "setting"), Column("change", "change"), Column("event", "event"),
                Column("of runs", "n_runs"), Column("events", "n_events"), Column("share", "share", show=percent),
                Column("low", "low", show=percent), Column("high", "high", show=percent),
                Column("bases", "share_base", show=percent), Column("redraw", "share_redraw", show=percent),
            ),
        ),
        Table(
            "robustness_runs",
            "Runs behind the comparison, and how many independent samples in time they hold: T / (2 tau) each.",
            typed(_RUNS, runs_rows),
            (
                Column("setting", "setting"), Column("change", "change"), Column("runs", "n_runs"),
                Column("compared", "n_compared"), Column("collapsed", "n_collapsed"), Column("silent", "n_silent"),
                Column("run away", "n_diverged"), Column("correlation time", "correlation_time"),
                Column("effective samples", "effective_samples"),
            ),
        ),
    )  # fmt: skip
