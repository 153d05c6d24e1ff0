"""The tables of a report: estimates with their intervals, made from the groups' sums; nulls, never NaN."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.groups import ENGINE_KEYS, OUTCOMES, Group
from stickslip.analysis.report import words
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.stats.estimates import (
    SHORT_WINDOW,
    Estimate,
    Undefined,
    add_histograms,
    gamma,
    gamma_difference,
    over_matrices,
    ratio,
)
from stickslip.analysis.stats.nulls import NullTally
from stickslip.sim.engines import SETTINGS
from stickslip.sim.engines.contract import Number

S, I, F = "string", "Int64", "Float64"  # noqa: E741  nullable types: a null, never NaN, where nothing applies
SCHEMAS: dict[str, dict[str, str]] = {
    "law": {
        "group": S, "n": I, "engine": S, "perturbation_size": F, "definition": S, "dt": F,
        "n_cascades": I, "n_matrices": I, "mean_size": F, "gamma": F, "gamma_low": F, "gamma_high": F,
        "gamma0": F, "gamma0_error": F, "difference": F, "difference_low": F, "difference_high": F,
        "verdict": S, "statement": S,
    },
    "groups": {
        "group": S, **dict.fromkeys(("n", "matrices", "members", "finished", "quiet"), I), "coupling": S,
        **dict.fromkeys(("belt_speed", "kappa", "rho", "t_end", "perturbation_size"), F),
        **{name: F if isinstance(SETTINGS.get(name), Number) else S for name in ENGINE_KEYS},
    },
    "outcomes": {
        "group": S, "outcome": S, "n_members": I, "n_matrices": I, "n_before_burn": I,
        "t_stop_min": F, "t_stop_max": F, "n_reasons": I, "reason": S,
    },
    "n_stick": {
        "group": S, "n_matrices": I, "n_runs": I, "mean": F, "low": F, "high": F, "variance_in_time": F,
        "correlation_time": F, "effective_samples": F, "reason": S,
    },
    "burn_in": {
        "group": S, "n_matrices": I, "mean_first_half": F, "mean_second_half": F, "difference": F,
        "low": F, "high": F, "statement": S,
    },
    "sizes": {
        "group": S, "definition": S, "dt": F, "size": I, "n_cascades": I, "share": F, "share_low": F,
        "share_high": F, "share_fit": F, "share_chance": F,
    },
}  # fmt: skip


def frame(name: str, rows: Iterable[Mapping[str, object]]) -> pd.DataFrame:
    """Rows as a data frame with the declared columns and nullable types of the table `name`."""
    return typed(SCHEMAS[name], rows)


def typed(schema: Mapping[str, str], rows: Iterable[Mapping[str, object]]) -> pd.DataFrame:
    """Rows as a data frame with the columns and nullable types of a schema; what a row lacks is null."""
    listed = list(rows)
    columns: dict[str, Any] = dict(schema)  # pandas' stubs know each dtype by its literal name only
    return pd.DataFrame(
        {column: pd.array([row.get(column) for row in listed], dtype=dtype) for column, dtype in columns.items()}
    )


def records(table: pd.DataFrame) -> list[dict[Any, Any]]:
    """Rows of a table as dictionaries of plain Python values, None for null."""
    return table.astype(object).where(table.notna(), None).to_dict(orient="records")


def law_table(found: list[Group], settings: AnalysisSettings) -> pd.DataFrame:
    """The cascade law: gamma by definition and dt, what chance gives, the difference with its interval."""
    rows = []
    for group in found:
        for law, data in group.by_law.items():
            with_cascades = data.sums[data.sums[:, 1] > 0]
            rate = over_matrices(gamma, with_cascades[:, :2], settings.confidence)
            against = over_matrices(gamma_difference, with_cascades, settings.confidence)
            gamma0, gamma0_error = _chance(data.null)
            if not len(with_cascades):
                against = Estimate(reason=_no_cascades(group))
            n_cascades = int(data.sums[:, 1].sum())
            row = {
                "group": group.label,
                **{name: group.key[name] for name in ("n", "engine", "perturbation_size")},
                "definition": law.definition, "dt": law.dt, "n_cascades": n_cascades,
                "n_matrices": len(with_cascades),
                "mean_size": float(data.sums[:, 0].sum()) / n_cascades if n_cascades else None,
                "gamma": rate.value, "gamma_low": rate.low, "gamma_high": rate.high,
                "gamma0": gamma0, "gamma0_error": gamma0_error,
                "difference": against.value, "difference_low": against.low, "difference_high": against.high,
            }  # fmt: skip
            row["verdict"], row["statement"] = words.verdict(against, gamma0, settings.confidence)
            rows.append(row)
    return frame("law", rows)


def _chance(null: NullTally) -> tuple[float | None, float | None]:
    try:
        return null.rate()
    except Undefined:  # then the paired difference is undefined too, and its reason stands in the statement
        return None, None


def _no_cascades(group: Group) -> str:
    if not group.matrices:
        return "no run reached t_end"
    if group.n_quiet == len(group.taus):
        return "n_stick does not change after t_burn in any finished run"
    return "no complete cascade after t_burn in any finished run"


def groups_table(found: list[Group]) -> pd.DataFrame:
    """What each group is: its system, its engine's settings, and how many members and matrices it has."""
    counts: list[dict[str, object]] = [
        {
            "group": group.label,
            "members": len(group.members),
            "matrices": group.members["matrix"].nunique(),
            "finished": int((group.members["outcome"] == "finished").sum()),
            "quiet": group.n_quiet,
        }
        for group in found
    ]
    texts = {column for column, dtype in SCHEMAS["groups"].items() if dtype == S}
    rows = []
    for count, group in zip(counts, found, strict=True):
        key = {name: str(v) if name in texts and v is not None else v for name, v in group.key.items()}
        rows.append({**key, **count})
    return frame("groups", rows)


def outcomes_table(found: list[Group], settings: AnalysisSettings) -> pd.DataFrame:
    """Members by outcome; `n_before_burn` of them stopped before t_burn, `reason` is the most common one."""
    rows = []
    for group in found:
        for outcome in OUTCOMES:
            some = group.members[group.members["outcome"] == outcome]
            if some.empty:
                continue
            t_stop, reasons = some["t_stop"].dropna(), some["reason"].dropna().astype(str)
            common = reasons[reasons != ""].value_counts()
            ties = sorted(common.index[common == common.max()]) if len(common) else []
            rows.append(
                {
                    "group": group.label,
                    "outcome": outcome,
                    "n_members": len(some),
                    "n_matrices": some["matrix"].nunique(),
                    "n_before_burn": int((t_stop < settings.t_burn).sum()),
                    "t_stop_min": float(t_stop.min()) if len(t_stop) else None,
                    "t_stop_max": float(t_stop.max()) if len(t_stop) else None,
                    "n_reasons": len(common),
                    "reason": ties[0] if ties else None,
                }
            )
    return frame("outcomes", rows)


def n_stick_table(found: list[Group], settings: AnalysisSettings) -> pd.DataFrame:
    """Time mean of n_stick by matrix, its mean over matrices, and how many independent samples there are."""
    rows = []
    for group in found:
        mean = over_matrices(ratio, _matrix_means(group)[:, [0, 4]], settings.confidence)
        known = [tau for tau in group.taus if tau.value is not None]
        span = float(group.key["t_end"]) - settings.t_burn
        short = sum(tau.reason != "" for tau in known)
        reasons = [mean.reason] if mean.reason else []
        if short:
            reasons.append(
                f"{short} of {len(known)} runs hold fewer than {SHORT_WINDOW:g} correlation times: "
                "tau may be too low and the effective samples too many"
            )
        if group.n_quiet:
            reasons.append(f"n_stick does not change after t_burn in {group.n_quiet} runs")
        rows.append(
            {
                "group": group.label,
                "n_matrices": len(group.matrices),
                "n_runs": len(group.taus),
                "mean": mean.value,
                "low": mean.low,
                "high": mean.high,
                "variance_in_time": (float(_matrix_means(group)[:, 3].mean()) if group.matrices else None),
                "correlation_time": float(np.mean([tau.value for tau in known])) if known else None,
                "effective_samples": (sum(span / (2 * tau.value) for tau in known if tau.value) if known else None),
                "reason": "; ".join(reasons) or None,
            }
        )
    return frame("n_stick", rows)


def _matrix_means(group: Group) -> np.ndarray:
    """Rows of `Group.means` averaged over the runs of each matrix: every matrix weighs the same."""
    return group.means / group.means[:, 4:] if len(group.means) else group.means


def drift(group: Group, confidence: float) -> Estimate:
    """Mean n_stick in the second half of the window after t_burn minus the first, paired over matrices."""
    means = _matrix_means(group)
    return over_matrices(ratio, np.column_stack([means[:, 2] - means[:, 1], means[:, 4]]), confidence)


def burn_in_table(found: list[Group], settings: AnalysisSettings) -> pd.DataFrame:
    """Mean n_stick in the first and second half of the window after t_burn, paired over matrices."""
    rows = []
    for group in found:
        means = _matrix_means(group)
        moved = drift(group, settings.confidence)
        rows.append(
            {
                "group": group.label,
                "n_matrices": len(means),
                "mean_first_half": float(means[:, 1].mean()) if len(means) else None,
                "mean_second_half": float(means[:, 2].mean()) if len(means) else None,
                "difference": moved.value,
                "low": moved.low,
                "high": moved.high,
                "statement": words.burn_in(moved),
            }
        )
    return frame("burn_in", rows)


def sizes_table(found: list[Group], settings: AnalysisSettings) -> pd.DataFrame:
    """Share of each size: observed with an interval over matrices, fitted, and by chance."""
    rows = []
    for group in found:
        for law, data in group.by_law.items():
            if not data.sums[:, 1].sum():
                continue
            n_sizes = max(len(histogram) for histogram in data.histograms)
            by_matrix = np.array([add_histograms(h, np.zeros(n_sizes, np.int64)) for h in data.histograms])
            by_matrix = by_matrix[data.sums[:, 1] > 0]
            rate = over_matrices(gamma, data.sums[:, :2], settings.confidence).value
            n_null = int(data.null.histogram.sum())
            for size in range(1, n_sizes):
                columns = np.column_stack([by_matrix[:, size], by_matrix.sum(axis=1)]).astype(float)
                share = over_matrices(ratio, columns, settings.confidence)
                at_chance = int(data.null.histogram[size]) if size < len(data.null.histogram) else 0
                rows.append(
                    {
                        "group": group.label,
                        "definition": law.definition,
                        "dt": law.dt,
                        "size": size,
                        "n_cascades": int(by_matrix[:, size].sum()),
                        "share": share.value,
                        "share_low": None if share.low is None else max(share.low, 0.0),
                        "share_high": None if share.high is None else min(share.high, 1.0),
                        "share_fit": (None if rate is None else float(-np.expm1(-rate) * np.exp(-rate * (size - 1)))),
                        "share_chance": at_chance / n_null if n_null else None,
                    }
                )
    return frame("sizes", rows)
