"""What the clustering of exits comes to in each group: sums over runs, and the rows of the tables made from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stickslip.analysis.groups import Group, generator, windows
from stickslip.analysis.report.section import Data
from stickslip.analysis.report.tables import F, I, S
from stickslip.analysis.stats import student
from stickslip.analysis.stats.cascades import Law, Spans, Window, spans
from stickslip.analysis.stats.clustering import (
    Clustering,
    chance_within,
    control,
    excess,
    independent_variation,
    long_durations,
    measure,
    pairs_in_random_order,
    rotated_spans,
    steps_of_series,
    variation,
    variation_difference,
)
from stickslip.analysis.stats.estimates import LN2, Estimate, gamma, gamma_difference, over_matrices, ratio
from stickslip.analysis.stats.nulls import block_steps, independent_sums, random_order, rotated

B = "boolean"
SCHEMAS: Mapping[str, Mapping[str, Any]] = {
    "pairs": {
        "group": S, "null": S, "tau": F, "n_matrices": I, "n_exits": I, "n_pairs": F, "n_pairs_null": F,
        "excess": F, "excess_low": F, "excess_high": F, "is_beyond_chance": B, "share_alike": F,
        "share_seen": F, "reason": S,
    },
    "fano": {
        "group": S, "null": S, "window": F, "n_matrices": I, "fano": F, "fano_low": F, "fano_high": F,
        "fano_null": F, "difference": F, "low": F, "high": F, "is_beyond_chance": B, "reason": S,
    },
    "events_by_null": {
        "group": S, "null": S, "n_matrices": I, "gamma": F, "gamma_null": F, "difference": F, "low": F, "high": F,
        "is_beyond_chance": B, "reason": S,
    },
    "spans": {
        "group": S, "quantity": S, "null": S, "n": I, "mean": F, "mean_null": F, "variation": F,
        "variation_low": F, "variation_high": F, "variation_independent": F, "variation_null": F,
        "difference": F, "low": F, "high": F, "is_beyond_chance": B, "reason": S,
    },
    "control": {
        "group": S, "share": F, "statistic": S, "scale": F, "value": F, "low": F, "high": F, "seen": F,
    },
}  # fmt: skip
ROTATION, INDEPENDENT, ORDER, FAIR = "rotation of blocks", "independent exits", "random order", "fair order"
TAIL_DRAWS = 5  # rotations a run for the drawn tails of durations and waiting times
POWER = 0.8  # a share counts as one that would have been seen if it is seen in so many of such ensembles


@dataclass
class Gathered:
    """One group: sums a matrix, of the data and of each control; rows are added over the runs of a matrix."""

    label: str
    null: str
    n_exits: int = 0
    rows: dict[int, dict[str, np.ndarray]] = field(default_factory=dict)
    controls: dict[tuple[float, int], dict[int, dict[str, np.ndarray]]] = field(default_factory=dict)
    tails: dict[str, list[np.ndarray]] = field(default_factory=dict)

    def sums(self, name: str) -> np.ndarray:
        """Rows of one quantity, a matrix each."""
        return np.array([row[name] for row in self.rows.values()])


def _put(into: dict[int, dict[str, np.ndarray]], row: int, values: Mapping[str, np.ndarray]) -> None:
    held = into.setdefault(row, {name: np.zeros_like(value, dtype=np.float64) for name, value in values.items()})
    for name, value in values.items():
        held[name] += value


def _parts(found: Clustering) -> dict[str, np.ndarray]:
    names = ("pairs", "fano", "events", "durations", "waits")
    return {name: getattr(found, name) for name in names}


def gather(
    data: Data,
    group: Group,
    *,
    t_burn: float,
    taus: Sequence[float],
    lengths: Sequence[float],
    shares: Sequence[float],
    delay: float,
    resamples: int,
    repeats: int,
    seed: int,
) -> Gathered:
    """Measure every finished run of a group, and its positive controls."""
    has_events = all(member_id in data.events for _, member_id, _ in windows(group, data.series, t_burn))
    found = Gathered(group.label, ROTATION if has_events else INDEPENDENT)
    for row, member_id, win in windows(group, data.series, t_burn):
        rng = generator(seed, f"{member_id} clustering")
        events = data.events[member_id] if has_events else None
        steps = steps_of_series(win) if events is None else block_steps(*events, win.t_start, win.t_stop)
        null = rotated_spans(steps, resamples, rng)
        run = measure(steps, taus, lengths, null)
        if run is None:
            continue
        found.n_exits += int(np.sum(steps.step < 0))
        _put(found.rows, row, _parts(run) | _by_other_nulls(win, taus, resamples, rng))
        _add_tails(found, "observed", spans(steps.window()))
        for _ in range(TAIL_DRAWS):
            _add_tails(found, "chance", spans(rotated(steps, rng).window()))
        controls = control(steps, shares, delay, taus, lengths, null, repeats, rng)
        for share, runs in zip(shares, controls, strict=True):
            for k, one in enumerate(runs):
                _put(found.controls.setdefault((share, k), {}), row, _parts(one))
    return found


def _by_other_nulls(
    win: Window, taus: Sequence[float], resamples: int, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    law = Law("events")
    n_exits, n_entries = (int(np.maximum(sign * win.step, 0).sum()) for sign in (-1, 1))
    span = win.t_stop - win.t_start
    shuffled = random_order(win, (), resamples, rng)[law].sums().sum(axis=0)
    return {
        INDEPENDENT: 0.5 * n_exits * (n_exits - 1) * chance_within(taus, span),
        ORDER: pairs_in_random_order(win, taus),
        "events independent": independent_sums(law, n_exits, n_entries, span),
        "events order": shuffled,
        "changes": np.array([n_exits, n_entries], dtype=np.float64),
    }


def _add_tails(found: Gathered, of: str, one: Spans) -> None:
    found.tails.setdefault(f"durations {of}", []).append(long_durations(one))
    found.tails.setdefault(f"waits {of}", []).append(one.waiting)


# ------------------------------------------------------------------------------------------------- tables


def _misses_zero(one: Estimate) -> bool | None:
    return None if one.low is None or one.high is None else not one.low <= 0 <= one.high


#: An excess over fewer expected pairs than this, all matrices together, is not judged.
FEW_PAIRS = 20


def pairs_rows(found: Gathered, taus: Sequence[float], confidence: float) -> list[dict[str, Any]]:
    """Excess of pairs over each null; against the first also the share of triggered exits that would give it."""
    if not found.rows:
        return []
    observed = found.sums("pairs")
    nulls = {found.null: observed[:, :, 1]}
    nulls |= {name: found.sums(name) for name in (INDEPENDENT, ORDER) if name != found.null}
    rows = []
    for null, expected in nulls.items():
        for k, tau in enumerate(taus):
            one = over_matrices(excess, np.column_stack([observed[:, k, 0], expected[:, k]]), confidence)
            if expected[:, k].sum() < FEW_PAIRS:
                one = Estimate(one.value, reason=f"fewer than {FEW_PAIRS} pairs expected by chance")
            alike, seen = _shares(found, k, one, confidence) if null == found.null else (None, None)
            rows.append(
                {
                    "group": found.label, "null": null, "tau": tau, "n_matrices": len(observed),
                    "n_exits": found.n_exits, "n_pairs": float(observed[:, k, 0].sum()),
                    "n_pairs_null": float(expected[:, k].sum()), "excess": one.value, "excess_low": one.low,
                    "excess_high": one.high, "is_beyond_chance": _misses_zero(one), "share_alike": alike,
                    "share_seen": seen, "reason": one.reason or None,
                }
            )  # fmt: skip
    return rows


def _shares(found: Gathered, k: int, one: Estimate, confidence: float) -> tuple[float | None, float | None]:
    """Share of triggered exits that gives as large an excess, and the smallest that would have been seen.

    Seen: its mean excess is so many standard errors that its interval excludes zero in `POWER` of such ensembles;
    the standard error is the larger one of the data's and the controls'. Both shares by interpolation between the
    controls, starting from none at none; None where that would have to go beyond the largest control.
    """
    shares = sorted({share for share, _ in found.controls})
    means, errors = [0.0], []
    n_matrices = len(found.rows)
    if n_matrices < 2 or one.low is None or one.high is None or not shares:
        return None, None
    t_half = student.half_width(confidence, n_matrices - 1)
    for share in shares:
        effects = [
            over_matrices(excess, np.array([row["pairs"][k] for row in rows.values()]), confidence)
            for (other, _), rows in found.controls.items()
            if other == share
        ]
        ends = [(each.value, each.low) for each in effects if each.value is not None and each.low is not None]
        if len(ends) < len(effects):
            return None, None
        means.append(float(np.mean([value for value, _ in ends])))
        errors.append(float(np.mean([value - low for value, low in ends])) / t_half)
    needed = (t_half + student.quantile(POWER, n_matrices - 1)) * max((one.high - one.low) / 2 / t_half, errors[0])
    if (np.diff(means) <= 0).any():  # the controls do not rank: this tau is no measure of triggering
        return None, None

    def share_of(value: float | None) -> float | None:
        return (
            float(np.interp(value, means, [0.0, *shares])) if value is not None and 0 < value <= means[-1] else None
        )

    return share_of(one.value), share_of(needed)


def fano_rows(found: Gathered, lengths: Sequence[float], confidence: float) -> list[dict[str, Any]]:
    """Fano factor of exits against the length of windows, observed minus null."""
    if not found.rows:
        return []
    sums = found.sums("fano")
    rows = []
    for k, length in enumerate(lengths):
        one = over_matrices(ratio, sums[:, k][:, [0, 2]], confidence)
        null = over_matrices(ratio, sums[:, k][:, [1, 2]], confidence)
        less = np.column_stack([sums[:, k, 0] - sums[:, k, 1], sums[:, k, 2]])
        gap = over_matrices(ratio, less, confidence)
        rows.append(
            {
                "group": found.label, "null": found.null, "window": length, "n_matrices": len(sums),
                "fano": one.value, "fano_low": one.low, "fano_high": one.high, "fano_null": null.value,
                "difference": gap.value, "low": gap.low, "high": gap.high,
                "is_beyond_chance": _misses_zero(gap), "reason": gap.reason or None,
            }
        )  # fmt: skip
    return rows


def _gamma_minus_ln2(sums: np.ndarray) -> np.ndarray:
    return gamma(sums) - LN2


def events_rows(found: Gathered, confidence: float) -> list[dict[str, Any]]:
    """gamma by `events` against every null model."""
    if not found.rows:
        return []
    sums = found.sums("events")
    kept = sums[:, 1] > 0
    observed = sums[kept, :2]
    rate = over_matrices(gamma, observed, confidence)
    nulls = {
        found.null: sums[kept, 2:],
        INDEPENDENT: found.sums("events independent")[kept],
        ORDER: found.sums("events order")[kept],
    }
    against = {
        null: (over_matrices(gamma, by_chance, confidence), np.hstack([observed, by_chance]))
        for null, by_chance in nulls.items()
    }
    rows = []
    for null in (*nulls, FAIR):
        value: float | None = LN2
        if null == FAIR:
            gap = over_matrices(_gamma_minus_ln2, observed, confidence)
        else:
            value, gap = against[null][0].value, over_matrices(gamma_difference, against[null][1], confidence)
        rows.append(
            {
                "group": found.label, "null": null, "n_matrices": int(kept.sum()), "gamma": rate.value,
                "gamma_null": value, "difference": gap.value, "low": gap.low, "high": gap.high,
                "is_beyond_chance": _misses_zero(gap), "reason": gap.reason or None,
            }
        )  # fmt: skip
    return rows


def spans_rows(found: Gathered, confidence: float) -> list[dict[str, Any]]:
    """Durations of cascades of two exits and more, and waiting times from start to start, by `events`."""
    if not found.rows:
        return []
    n_exits, n_entries = found.sums("changes").sum(axis=0)
    independent = independent_variation(int(n_exits), int(n_entries))
    rows = []
    for name, quantity, by_poisson in (
        ("durations", "duration", independent[0]),
        ("waits", "waiting time", independent[1]),
    ):
        sums = found.sums(name)
        sums = sums[(sums[:, 0] > 1) & (sums[:, 3] > 1)]
        one = over_matrices(variation, sums[:, :3], confidence)
        null = over_matrices(variation, sums[:, 3:], confidence)
        gap = over_matrices(variation_difference, sums, confidence)
        n, total, n_null, total_null = sums[:, [0, 1, 3, 4]].sum(axis=0) if len(sums) else np.zeros(4)
        rows.append(
            {
                "group": found.label, "quantity": quantity, "null": found.null, "n": int(n),
                "mean": total / n if n else None, "mean_null": total_null / n_null if n_null else None,
                "variation": one.value, "variation_low": one.low, "variation_high": one.high,
                "variation_independent": by_poisson, "variation_null": null.value, "difference": gap.value,
                "low": gap.low, "high": gap.high, "is_beyond_chance": _misses_zero(gap),
                "reason": gap.reason or None,
            }
        )  # fmt: skip
    return rows


def control_rows(
    found: Gathered, taus: Sequence[float], lengths: Sequence[float], confidence: float
) -> list[dict[str, Any]]:
    """What each share of triggered exits shows: mean value and ends over repetitions, and how often it is seen."""
    rows = []
    for share in sorted({share for share, _ in found.controls}):
        repeats = [list(held.values()) for (other, _), held in found.controls.items() if other == share]
        for statistic, scales in (("pairs", taus), ("fano", lengths), ("gamma by events", (None,))):
            for k, scale in enumerate(scales):
                seen = [_control_value(statistic, k, one, confidence) for one in repeats]
                known = [one for one in seen if one[0].low is not None]
                if not known:
                    continue
                value, low, high = (
                    float(np.mean([getattr(one, end) + shift for one, shift in known]))
                    for end in ("value", "low", "high")
                )
                rows.append(
                    {
                        "group": found.label, "share": share, "statistic": statistic, "scale": scale,
                        "value": value, "low": low, "high": high,
                        "seen": float(np.mean([bool(_misses_zero(one)) for one, _ in known])),
                    }
                )  # fmt: skip
    return rows


def _control_value(
    statistic: str, k: int, rows: Sequence[Mapping[str, np.ndarray]], confidence: float
) -> tuple[Estimate, float]:
    """Effect against the null, and what is added to it to show it: the null's Fano factor or gamma."""
    if statistic == "pairs":
        return over_matrices(excess, np.array([row["pairs"][k] for row in rows]), confidence), 0.0
    if statistic == "fano":
        sums = np.array([row["fano"][k] for row in rows])
        less = np.column_stack([sums[:, 0] - sums[:, 1], sums[:, 2]])
        return over_matrices(ratio, less, confidence), float(sums[:, 1].sum() / sums[:, 2].sum())
    sums = np.array([row["events"] for row in rows])
    null = over_matrices(gamma, sums[:, 2:], confidence)
    return over_matrices(gamma_difference, sums, confidence), null.value or 0.0
