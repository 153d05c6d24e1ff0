"""Do exits cluster? A slow motion that blocks share, counts of exits in windows, and pairs of exits close in time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from stickslip.analysis.answer import Answer, F, Row, S, frame
from stickslip.analysis.ensemble import Group, Study
from stickslip.analysis.stats.clustering import FANO, PAIRS, POWER, VARIANCE, Part, measure, periods
from stickslip.analysis.stats.effects import AS_CHANCE, LESS, MORE, Effect, over_null, together
from stickslip.analysis.stats.estimates import Undefined
from stickslip.analysis.stats.nulls import block_steps, triggered
from stickslip.analysis.style import EXACT, GREY, SMOOTHED, panel

SLOW = 100.0  # the period above which motion is called slow: five of the blocks' own
BELOW_SLOW = (50.0, SLOW)  # the band next to it, where blocks hold each other back
WINDOWS = (0.5, 1.0, 5.0, 20.0, 40.0, 80.0)  # of the Fano factors
LEAST_WINDOWS = 20  # of one length in a run
CURVE = 20  # bands of the figure
FOLLOW, DELAY = 0.02, 0.1  # positive control: share of exits that follow another, after so many mean gaps
MOST_DRAWN = 2  # groups in the figure
_CLUSTERING: Mapping[str, str] = {
    "group": S, "kind": S, "above": F, "upto": F, "observed": F, "by_rotation": F, "ratio": F, "low": F, "high": F,
    "p_value": F, "p_adjusted": F, "verdict": S, "control": F, "control_low": F, "control_high": F, "reason": S,
}  # fmt: skip
_SPECTRUM: Mapping[str, str] = {"group": S, "above": F, "upto": F, "ratio": F, "low": F, "high": F}


@dataclass(frozen=True)
class _Measured:
    """What a group's runs give, (G, p, 2) for its parts and the bands of the figure, a row a matrix.

    `control` is that of the positive control, for the pairs alone; `gap` the mean time between exits.
    """

    group: Group
    parts: list[Part]
    bands: list[Part]
    runs: np.ndarray
    control: np.ndarray
    gap: float


def answer(study: Study) -> Answer:
    """Whether blocks move together slowly, and whether exits bring on others at once."""
    if not study.data.events:
        return Answer(lack="no events")
    judged = study.judged()
    if not judged:
        code, facts = study.refusal()
        return Answer(facts, lack=code)
    measured = [one for group in judged for one in [_measured(study, group)] if len(one.runs) > 1]
    if not measured:
        return Answer(lack="no events")
    level = study.settings.confidence
    rows = {one.group.label: _rows(one, level) for one in measured}
    spectra = {one.group.label: _spectrum(one, level) for one in measured}
    tables = {
        "clustering": frame(_CLUSTERING, [row for some in rows.values() for row in some]),
        "spectrum": frame(_SPECTRUM, [row for some in spectra.values() for row in some]),
    }
    lead, label = measured[0], measured[0].group.label
    of = {kind: [row for row in rows[label] if row["kind"] == kind] for kind in (POWER, VARIANCE, FANO, PAIRS)}
    known = [row for row in spectra[label] if row["ratio"] is not None]
    facts = {
        "group": label, "rows": rows[label], "of": of, "lead": _largest(rows[label]), "slow": SLOW,
        "pairs": _code(of[PAIRS]), "close": _closest(of[PAIRS], DELAY * lead.gap), "follow": FOLLOW, "delay": DELAY,
        "same": [row for other, some in rows.items() if other != label for row in some[:1]][:2],
        "peak": max(known, key=lambda row: row["ratio"], default=None),
        "n_slow": (float(lead.group.key["t_end"]) - study.settings.t_burn) / SLOW,
    }  # fmt: skip
    drawn = dict(list(spectra.items())[:MOST_DRAWN])
    return Answer(facts, tables=tables, figures={"spectrum": partial(spectrum, drawn)})


def _parts(span: float, taus: Sequence[float]) -> list[Part]:
    """What is tested: the power of slow motion first, if the window holds two such periods."""
    shortest, longest = periods(span)
    slow = [Part(POWER, longest, SLOW)] if shortest <= SLOW <= longest / 2 else []
    beside = (
        [Part(POWER, BELOW_SLOW[1], BELOW_SLOW[0])] if shortest <= BELOW_SLOW[0] < BELOW_SLOW[1] <= longest else []
    )
    counts = [Part(FANO, length) for length in WINDOWS if length * LEAST_WINDOWS <= span]
    return [*slow, *beside, Part(VARIANCE), *counts, *(Part(PAIRS, tau) for tau in taus if 2 * tau <= span)]


def _measured(study: Study, group: Group) -> _Measured:
    span = float(group.key["t_end"]) - study.settings.t_burn
    parts = _parts(span, study.settings.tau)
    shortest, longest = periods(span)
    edges = np.geomspace(max(shortest, min(1.0, longest / 2)), longest, CURVE + 1).tolist()
    bands = [Part(POWER, high, low) for low, high in pairwise([*edges[:-1], longest])]
    pairs = [part for part in parts if part.kind == PAIRS]
    n_rows, n_exits, n_runs = len(group.units), 0, 0
    runs, control = np.zeros((n_rows, len(parts) + len(bands), 2)), np.zeros((n_rows, len(pairs), 2))
    for row, member_id, win in study.windows(group):
        if member_id not in study.data.events:
            continue
        steps = block_steps(*study.data.events[member_id], win.t_start, win.t_stop)
        mean_gap = span / max(int(np.sum(steps.step < 0)), 1)
        follow = triggered(steps, FOLLOW, DELAY * mean_gap, study.generator(member_id))
        try:
            runs[row] += measure(steps, [*parts, *bands])
            control[row] += measure(follow, pairs)
        except Undefined:  # fewer than two exits have no gap and no rhythm
            continue
        n_exits, n_runs = n_exits + int(np.sum(steps.step < 0)), n_runs + 1
    seen = runs[:, :, 1].any(axis=1)
    return _Measured(group, parts, bands, runs[seen], control[seen], n_runs * span / max(n_exits, 1))


def _effect(rows: np.ndarray, confidence: float) -> Effect:
    return over_null(lambda sums: sums[:, 0], rows[:, :1], rows[:, 1:], confidence)


def _rows(one: _Measured, confidence: float) -> list[Row]:
    """One row a part. Slow motion is the primary question; all others are judged together."""
    slow = int(bool(one.parts) and one.parts[0].above == SLOW)
    effects = together([_effect(one.runs[:, k], confidence) for k in range(len(one.parts))], slow)
    first = next((k for k, part in enumerate(one.parts) if part.kind == PAIRS), 0)
    rows = []
    for k, (part, effect) in enumerate(zip(one.parts, effects, strict=True)):
        observed, by_rotation = one.runs[:, k].mean(axis=0)
        row: Row = {
            "group": one.group.label, "kind": part.kind, "above": part.above, "upto": part.upto,
            "observed": float(observed), "by_rotation": float(by_rotation), "ratio": effect.ratio.value,
            "low": effect.ratio.low, "high": effect.ratio.high, "p_value": effect.p, "p_adjusted": effect.p_adjusted,
            "verdict": effect.verdict(1 - confidence), "shown": effect.shown, "control": None, "control_low": None,
            "control_high": None, "reason": effect.ratio.reason or None,
        }  # fmt: skip
        if part.kind == PAIRS:
            would = _effect(one.control[:, k - first], confidence).ratio
            row |= {"control": would.value, "control_low": would.low, "control_high": would.high}
        rows.append(row)
    return rows


def _spectrum(one: _Measured, confidence: float) -> list[Row]:
    rows = []
    for k, band in enumerate(one.bands, start=len(one.parts)):
        ratio = _effect(one.runs[:, k], confidence).ratio
        rows.append({"group": one.group.label, "above": band.above, "upto": band.upto, "ratio": ratio.value,
                     "low": ratio.low, "high": ratio.high})  # fmt: skip
    return rows


def _largest(rows: Sequence[Row]) -> Row:
    """What leads: slow motion if it differs from chance, else the largest effect that is shown, else the first."""
    common = [row for row in rows if row["kind"] != PAIRS]
    differ = [row for row in common if row["verdict"] in (MORE, LESS)]
    if common[0] in differ or not differ:
        return common[0]
    return max(differ, key=lambda row: row["shown"])


def _code(rows: Sequence[Row]) -> str:
    """Whether exits close in time are more, fewer or as many as chance gives, in the first gap that differs."""
    return next((row["verdict"] for row in rows if row["verdict"] in (MORE, LESS)), AS_CHANCE)


def _closest(rows: Sequence[Row], delay: float) -> Row | None:
    """The least gap that holds most exits which follow after a mean delay, and the share of them not excluded."""
    wide = sorted((row for row in rows if row["high"] is not None and row["control"]), key=lambda row: row["upto"])
    if not wide:
        return None
    row = next((row for row in wide if row["upto"] >= 2 * delay), wide[-1])
    gain = row["control"] - 1
    return row | {"share": FOLLOW * max(row["high"] - 1, 0.0) / gain if gain > 0 else None}


@panel()
def spectrum(ax: Axes, groups: Mapping[str, Sequence[Row]]) -> None:
    """Power of n_stick over that of independent blocks, against the period; rows of the table `spectrum` by group."""
    ax.axhline(1.0, linestyle="--", color=GREY, linewidth=1)
    for k, (label, rows) in enumerate(groups.items()):
        seen = [row for row in rows if row["low"] is not None]
        period = np.array([np.sqrt(row["above"] * row["upto"]) for row in seen])
        ratio, low, high = (np.array([row[key] for row in seen]) for key in ("ratio", "low", "high"))
        colour = (EXACT, SMOOTHED)[k % 2]
        ax.fill_between(period, low, high, color=colour, alpha=0.18, linewidth=0)
        ax.plot(
            period, ratio, color=colour, marker="os"[k % 2], markersize=3.2, label=label,
            markerfacecolor=(colour, "white")[k % 2],
        )  # fmt: skip
    ax.set(xscale="log", yscale="log", xlabel="period", ylabel="power / independent blocks")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axis.set_major_formatter(lambda x, _: f"{x:g}")
        axis.set_minor_locator(NullLocator())
    ax.legend(loc="upper left", fontsize=7)
