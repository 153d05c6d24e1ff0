"""How changed runs part from their base: differences of n_stick by band of time, horizons, and the curves drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip.analysis.pairs import Comparison, Setting
from stickslip.analysis.questions.growth_rates import is_kept
from stickslip.analysis.report.change_figures import Line
from stickslip.analysis.report.section import Data, Rows
from stickslip.analysis.report.tables import F, I, S
from stickslip.analysis.stats.estimates import over_matrices, ratio
from stickslip.analysis.stats.sensitivity import horizon, mean_difference, median_interval, redraw_difference

WINDOW = 1.0  # width of the windows in which n_stick is compared
_DRAWN = 120  # points of a curve
PARTING_COLUMNS = {
    "setting": S, "kind": S, "reading": S, "size": F, "change": S, "t_from": F, "t_to": F, "n_matrices": I,
    "difference": F, "low": F, "high": F, "redraw": F, "of_redraw": F, "of_late": F,
}  # fmt: skip
HORIZON_COLUMNS = {
    "setting": S, "kind": S, "reading": S, "size": F, "change": S, "n_pairs": I, "n_runaway": I, "n_matrices": I,
    "n_parted": I, "level": F, "median": F, "low": F, "high": F, "statement": S,
}  # fmt: skip


@dataclass(frozen=True)
class Paths:
    """What a setting's series give: the level of parting, and how two different matrices differ in each window."""

    edges: np.ndarray
    redraw: np.ndarray  # (windows,)
    late: float


def paths_of(data: Data, setting: Setting, outcome: Mapping[str, str], t_burn: float) -> Paths | None:
    """The windows of a setting, and how far two of its matrices lie apart in each; None with fewer than two runs."""
    bases = [data.series[base] for base in setting.bases.values() if is_kept(outcome, base)]
    if len(bases) < 2:
        return None
    edges = np.arange(0.0, float(setting.key["t_end"]) + 0.5 * WINDOW, WINDOW)
    redraw = redraw_difference(bases, edges[:-1] + 0.5 * WINDOW)
    late = redraw[edges[:-1] >= t_burn]
    return Paths(edges, redraw, float(late.mean()) if len(late) else 0.0)


def parting_rows(
    data: Data,
    setting: Setting,
    outcome: Mapping[str, str],
    paths: Paths | None,
    declared: tuple[float, float, float, tuple[float, ...]],
) -> tuple[Rows, Rows, list[Line]]:
    """Differences of n_stick by band of time, horizons, and curves."""
    t_burn, confidence, level, bands = declared
    t_end = float(setting.key["t_end"])
    edges = paths.edges if paths else np.arange(0.0, t_end + 0.5 * WINDOW, WINDOW)
    starts = [start for start in bands if start < t_burn] + [t_burn]
    parting: Rows = []
    horizons: Rows = []
    curves = []
    for comparison in setting.comparisons:
        change = comparison.change
        identity = {
            "setting": setting.label, "kind": change.kind, "reading": change.reading, "size": change.size or None,
            "change": str(change),
        }  # fmt: skip
        by_matrix: dict[int, list[np.ndarray]] = {}
        for pair in comparison.pairs:
            if is_kept(outcome, pair.base, pair.changed):
                first, second = data.series[pair.base], data.series[pair.changed]
                by_matrix.setdefault(pair.matrix, []).append(mean_difference(first, second, edges))
        horizons.append(identity | _horizon_row(comparison, by_matrix, paths, edges, (level, confidence)))
        if not by_matrix:
            continue
        gaps = np.array([np.mean(some, axis=0) for some in by_matrix.values()])
        for t_from, t_to in zip(starts, [*starts[1:], t_end], strict=True):
            inside = (edges[:-1] >= t_from) & (edges[:-1] < t_to)
            if inside.any():
                parting.append(identity | _band_row(gaps, inside, paths, (t_from, t_to), confidence))
        step = -(-gaps.shape[1] // _DRAWN)
        whole = gaps.shape[1] // step * step
        coarse = gaps.mean(axis=0)[:whole].reshape(-1, step).mean(axis=1)
        curves.append((_family(comparison), str(change), edges[:whole:step] + 0.5 * step * WINDOW, coarse))
    return parting, horizons, curves


def _band_row(
    gaps: np.ndarray, inside: np.ndarray, paths: Paths | None, band: tuple[float, float], confidence: float
) -> dict[str, Any]:
    mean = gaps[:, inside].mean(axis=1)
    found = over_matrices(ratio, np.column_stack([mean, np.ones_like(mean)]), confidence)
    redraw = float(paths.redraw[inside].mean()) if paths else None
    assert found.value is not None
    return {
        "t_from": band[0], "t_to": band[1], "n_matrices": len(gaps), "difference": found.value, "low": found.low,
        "high": found.high, "redraw": redraw, "of_redraw": found.value / redraw if redraw else None,
        "of_late": found.value / paths.late if paths and paths.late else None,
    }  # fmt: skip


def _horizon_row(
    comparison: Comparison,
    by_matrix: Mapping[int, Sequence[np.ndarray]],
    paths: Paths | None,
    edges: np.ndarray,
    declared: tuple[float, float],
) -> dict[str, Any]:
    """Median over matrices (of each, over its draws) of the horizon; what is beyond the run is null."""
    level, confidence = declared
    kept = sum(len(some) for some in by_matrix.values())
    row: dict[str, Any] = {
        "n_pairs": len(comparison.pairs), "n_runaway": len(comparison.pairs) - kept, "n_matrices": len(by_matrix),
    }  # fmt: skip
    if paths is None or not paths.late or not by_matrix:
        why = (
            "fewer than two matrices have a run to compare" if paths is None
            else "late in the run two different matrices do not differ" if not paths.late
            else "no pair reaches its end without running away"
        )  # fmt: skip
        return row | {"statement": f"not enough data: {why}"}
    bar = level * paths.late
    times = [[horizon(gap, edges, bar) for gap in some] for some in by_matrix.values()]
    middle, low, high = median_interval([float(np.median(some)) for some in times], confidence)
    row |= {
        "n_parted": sum(bool(np.isfinite(t)) for some in times for t in some), "level": bar,
        **{
            name: value if value is not None and np.isfinite(value) else None
            for name, value in (("median", middle), ("low", low), ("high", high))
        },
    }  # fmt: skip
    end = f"{edges[-1]:g}"
    if not np.isfinite(middle):
        return row | {"statement": f"n_stick can be foretold to the end, t = {end}, in the median of matrices"}
    if low is None or high is None:
        return row | {"statement": f"parted at t = {middle:.0f} in the median; too few matrices for an interval"}
    upto = f"{high:.0f}" if np.isfinite(high) else f"beyond {end}"
    return row | {"statement": f"parted at t = {middle:.0f} ({low:.0f} to {upto}) in the median of matrices"}


def distances(data: Data, setting: Setting, outcome: Mapping[str, str]) -> list[Line]:
    """Median distance over the pairs that are still watched, where at least half of them are."""
    lines = []
    for comparison in setting.comparisons:
        some = [
            data.separations[pair.changed]
            for pair in comparison.pairs
            if is_kept(outcome, pair.base, pair.changed) and pair.changed in data.separations
        ]
        some = [one for one in some if len(one[0])]
        if not some:
            continue
        longest = sorted(some, key=lambda one: len(one[0]))[len(some) // 2]
        m = len(longest[0])
        stack = np.full((len(some), m), np.nan)
        for k, (_, distance) in enumerate(some):
            stack[k, : min(m, len(distance))] = distance[:m]
        middle = np.nanmedian(stack, axis=0)
        pick = np.unique(np.linspace(0, m - 1, _DRAWN).astype(int))
        pick = pick[middle[pick] > 0]
        lines.append((_family(comparison), str(comparison.change), longest[0][pick], middle[pick]))
    return lines


def _family(comparison: Comparison) -> str:
    return f"{comparison.change.kind} {comparison.change.reading}"
