"""How fast displaced starts move away from their base: rows of growth rates, over matrices and of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stickslip.analysis.pairs import START, Comparison, Setting
from stickslip.analysis.report.section import Data, Rows, Separation
from stickslip.analysis.report.tables import F, I, S
from stickslip.analysis.stats import student
from stickslip.analysis.stats.sensitivity import BLOCKS, CEILING, Growth, amplification_gap, growth, saturation

GROWTH_COLUMNS = {
    "setting": S, "n": I, "engine": S, "eps": F, "size": F, "n_pairs": I, "n_runaway": I, "n_fitted": I, "rate": F,
    "low": F, "high": F, "between_matrices": F, "slowest": F, "fastest": F, "e_fold": F, "e_fold_low": F,
    "e_fold_high": F, "t_first": F, "t_last": F, "late_minus_early": F, "late_low": F, "late_high": F,
    "amplification_gap": F, "ceiling": F, "is_above_error": "boolean", "n_growing": I, "n_shrinking": I, "n_open": I,
    "runaways": S, "reason": S,
}  # fmt: skip
RATE_COLUMNS = {
    "setting": S, "n": I, "engine": S, "eps": F, "size": F, "matrix": I, "rate": F, "low": F, "high": F, "verdict": S,
}  # fmt: skip
GROWS, SHRINKS, WITHIN_ERROR, RUNAWAY = "grows", "shrinks", "within its error", "run away"  # of one draw
ABOVE_ERROR = 10.0  # a displacement of so many tolerances of the sigmoid engine stands out from its errors


def is_kept(outcome: Mapping[str, str], *member_ids: str) -> bool:
    """Whether all of these runs can be compared to the end: a runaway is kept apart, a failed run has no series."""
    return all(outcome[member] not in ("diverged", "failed") for member in member_ids)


def growth_rows(
    data: Data, setting: Setting, outcome: Mapping[str, str], scale: float | None, confidence: float
) -> tuple[Rows, Rows]:
    """Growth rates of displaced starts, and by matrix; the amplification against that of the size to be read."""
    kept = _kept(data, setting, outcome)
    twins = [comparison for comparison in setting.comparisons if comparison.change.kind == START]
    if not twins or not kept or scale is None:
        return [], []
    rtol = setting.key["rtol"]
    above = [one for one in twins if rtol is None or one.change.size >= ABOVE_ERROR * rtol]
    reference = (above or twins)[0]
    ceiling = CEILING * scale
    rows, rates = [], []
    t_half = student.half_width(confidence, BLOCKS - 1)
    identity = {"setting": setting.label, **{name: setting.key[name] for name in ("n", "engine", "eps")}}
    for comparison in twins:
        found = growth(comparison, kept, ceiling, confidence)
        size = comparison.change.size
        away = [pair.matrix for pair in comparison.pairs if not is_kept(outcome, pair.base, pair.changed)]
        draws: Rows = [
            {
                **identity, "size": size, "matrix": matrix, "rate": rate, "low": rate - t_half * found.errors[matrix],
                "high": rate + t_half * found.errors[matrix],
            }
            for matrix, rate in found.rates.items()
        ]  # fmt: skip
        for draw in draws:
            draw["verdict"] = GROWS if draw["low"] > 0 else SHRINKS if draw["high"] < 0 else WITHIN_ERROR
        verdicts = [draw["verdict"] for draw in draws]
        rows.append(
            {
                **identity, "size": size, "n_pairs": len(comparison.pairs), "n_runaway": len(away),
                "runaways": ", ".join(str(matrix) for matrix in away) or None, "ceiling": ceiling,
                "is_above_error": comparison in above,
                "amplification_gap": _gap(reference, comparison, kept, ceiling), **_rate_columns(found),
                "n_growing": verdicts.count(GROWS), "n_shrinking": verdicts.count(SHRINKS),
                "n_open": verdicts.count(WITHIN_ERROR),
            }
        )  # fmt: skip
        rates += draws
        rates += [{**identity, "size": size, "matrix": matrix, "rate": None, "verdict": RUNAWAY} for matrix in away]
    return rows, rates


def _kept(data: Data, setting: Setting, outcome: Mapping[str, str]) -> dict[str, Separation]:
    """Separations by changed member, runaways left out."""
    found = {
        pair.changed: data.separations[pair.changed]
        for comparison in setting.comparisons
        for pair in comparison.pairs
        if is_kept(outcome, pair.base, pair.changed) and pair.changed in data.separations
    }
    return {member: one for member, one in found.items() if len(one[1])}


def saturations(data: Data, some: Sequence[Setting], outcome: Mapping[str, str]) -> dict[int, float]:
    """By n, the largest over its settings: where growth is slow, no pair of a setting may live to saturate."""
    scales: dict[int, float] = {}
    for setting in some:
        kept = {member: distance for member, (_, distance) in _kept(data, setting, outcome).items()}
        if kept:
            n = int(setting.key["n"])
            scales[n] = max(scales.get(n, 0.0), _scale(setting, kept))
    return scales


def _scale(setting: Setting, distances: Mapping[str, np.ndarray]) -> float:
    """The largest, over the changes, of the distance at which pairs saturate."""
    by_change = [
        [distances[pair.changed] for pair in comparison.pairs if pair.changed in distances]
        for comparison in setting.comparisons
    ]
    return max(saturation(some) for some in by_change if some)


def _gap(first: Comparison, second: Comparison, kept: Mapping[str, Any], ceiling: float) -> float | None:
    if first is second:
        return None
    of_first = {pair.matrix: pair.changed for pair in first.pairs}
    gaps = [
        amplification_gap(kept[of_first[pair.matrix]], kept[pair.changed], ceiling)
        for pair in second.pairs
        if pair.changed in kept and of_first.get(pair.matrix) in kept
    ]
    known = [gap for gap in gaps if gap is not None]
    return max(known) if known else None


def _rate_columns(found: Growth) -> dict[str, Any]:
    rate, values = found.rate, list(found.rates.values())
    row: dict[str, Any] = {
        "n_fitted": len(values), "rate": rate.value, "low": rate.low, "high": rate.high,
        "between_matrices": float(np.std(values, ddof=1)) if len(values) > 1 else None,
        "slowest": min(values, default=None), "fastest": max(values, default=None), "t_first": found.t_first,
        "t_last": found.t_last, "late_minus_early": found.change.value, "late_low": found.change.low,
        "late_high": found.change.high, "reason": rate.reason or None,
    }  # fmt: skip
    if rate.value is not None and rate.value > 0:
        row["e_fold"] = 1 / rate.value
        if rate.low is not None and rate.high is not None and rate.low > 0:
            row["e_fold_low"], row["e_fold_high"] = 1 / rate.high, 1 / rate.low
    return row


def best(rows: Rows) -> Rows:
    """Of each setting the row to be read: the smallest displacement above the errors has the longest linear range."""
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        if row["rate"] is not None and row["is_above_error"]:
            found.setdefault(row["setting"], row)
    return list(found.values())
