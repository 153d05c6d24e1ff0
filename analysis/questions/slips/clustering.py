"""Whether exits cluster: counts of exits in windows, pairs of exits close in time, variance and power of n_stick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import Answer, F, Question, Row, S, frame
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.models.clustering import FANO, PAIRS, POWER, VARIANCE, Part, measure, periods
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats import student
from stickslip.analysis.stats.compare import UNKNOWN, WITHIN
from stickslip.analysis.stats.effects import LESS, MORE, Effect, over_null, together
from stickslip.analysis.stats.estimates import Undefined
from stickslip.analysis.style import over_blocks, panel

SLOW = 100.0  # longer periods belong to the slow rhythm, which is another question
BELOW_SLOW = (50.0, SLOW)  # the adjacent band, where blocks hold each other back
PRIMARY = 40.0  # the window of the primary question, about a block's own cycle
WINDOWS = (0.5, 1.0, 5.0, 20.0, PRIMARY, 80.0)  # of the Fano factors
LEAST_WINDOWS = 20  # of one length in a run
CURVE = 20  # bands of the figure
SOON = 0.2  # in mean gaps between exits: an exit that another one sets off comes sooner
POWERED = 0.8  # power at which an effect counts as one that would have been shown
MOST_DRAWN = 2  # groups in the figure
PAIRS_MARGIN = 0.05  # of pairs, for which a scene declares no margin; everything else has that of the variance
_CLUSTERING: Mapping[str, str] = {
    "group": S, "kind": S, "above": F, "upto": F, "observed": F, "by_rotation": F, "ratio": F, "low": F, "high": F,
    "p_value": F, "p_adjusted": F, "verdict": S, "reason": S,
}  # fmt: skip
_SPECTRUM: Mapping[str, str] = {"group": S, "above": F, "upto": F, "ratio": F, "low": F, "high": F}


@dataclass(frozen=True)
class _Measured:
    """What was measured on a group.

    `runs`, shape (G, p, 2), holds the parts and then the bands of the figure, one row a matrix. `n_exits` is the mean
    number of exits of a matrix, `gap` the mean time between exits.
    """

    group: Group
    parts: list[Part]
    bands: list[Part]
    runs: np.ndarray
    n_exits: float
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
    margin = study.margins.get("variance", 0.0)
    rows = {one.group.label: _rows(one, level, margin) for one in measured}
    spectra = {one.group.label: _spectrum(one, level) for one in measured}
    tables = {
        "clustering": frame(_CLUSTERING, [row for some in rows.values() for row in some]),
        "spectrum": frame(_SPECTRUM, [row for some in spectra.values() for row in some]),
    }
    lead, label = measured[0], measured[0].group.label
    of = {kind: [row for row in rows[label] if row["kind"] == kind] for kind in (POWER, VARIANCE, FANO, PAIRS)}
    leading = _largest(rows[label])
    facts = {
        "group": label, "rows": rows[label], "of": of, "lead": leading,
        "windows": sorted(of[FANO], key=lambda row: row["upto"]), "first": rows[label][0],
        "pairs": _code(of[PAIRS]), "apart": _apart(of[PAIRS], 1 - level),
        "close": _closest(of[PAIRS], lead, level, len(rows[label]) - 1), "powered": POWERED,
        "margin": margin, "pairs_margin": PAIRS_MARGIN, "n_groups": len(rows), "n_drawn": min(len(rows), MOST_DRAWN),
        "is_short": _is_short(leading),
        "same": [rows[one.group.label][0] for one in measured[1:] if one.group.n_moving == len(one.group)][:2],
        "is_drawn": any(row["ratio"] is not None for row in spectra[label]),
    }  # fmt: skip
    first = list(spectra)[:MOST_DRAWN]
    drawn = {one.label: spectra[one.label] for one in study.groups if one.label in first}  # n in ascending order
    return Answer(facts, tables=tables, figures={"spectrum": partial(spectrum, drawn)})


def _parts(span: float, taus: Sequence[float]) -> list[Part]:
    """What is tested; first the primary question, exits in windows of the length closest to `PRIMARY`."""
    shortest, longest = periods(span)
    beside = [Part(POWER, BELOW_SLOW[1], BELOW_SLOW[0])] if shortest <= BELOW_SLOW[0] and longest >= SLOW else []
    lengths = sorted((one for one in WINDOWS if one * LEAST_WINDOWS <= span), key=lambda one: abs(one - PRIMARY))
    counts = [Part(FANO, length) for length in lengths]
    return [*counts, *beside, Part(VARIANCE), *(Part(PAIRS, tau) for tau in taus if 2 * tau <= span)]


def _measured(study: Study, group: Group) -> _Measured:
    span = float(group.key["t_end"]) - study.settings.t_burn
    parts = _parts(span, study.settings.tau)
    shortest, longest = periods(span)
    longest = min(longest, SLOW)
    edges = np.geomspace(max(shortest, min(1.0, longest / 2)), longest, CURVE + 1).tolist()
    bands = [Part(POWER, high, low) for low, high in pairwise([*edges[:-1], longest])]
    n_columns = 2 * len([*parts, *bands])
    found = study.sums(group, partial(_of_run, (*parts, *bands)), n_columns + 1)
    runs = found[:, :n_columns].reshape(len(found), -1, 2)
    n_exits, n_runs = found[:, n_columns:].sum(axis=0)
    seen = runs[:, :, 1].any(axis=1)
    return _Measured(group, parts, bands, runs[seen], n_exits / max(seen.sum(), 1), n_runs * span / max(n_exits, 1))


def _of_run(parts: Sequence[Part], run: Run) -> np.ndarray | None:
    """`measure` of a run and its number of exits; None without events, or with fewer than two exits."""
    if run.steps is None:
        return None
    try:
        return np.append(measure(run.steps, parts), np.sum(run.steps.step < 0))
    except Undefined:
        return None


def _effect(rows: np.ndarray, confidence: float, margin: float = 0.0) -> Effect:
    return over_null(lambda sums: sums[:, 0], rows[:, :1], rows[:, 1:], confidence, margin)


def _rows(one: _Measured, confidence: float, margin: float) -> list[Row]:
    """One row a part. The first is the primary question; the others are judged together."""
    margins = [PAIRS_MARGIN if part.kind == PAIRS else margin for part in one.parts]
    effects = together([_effect(one.runs[:, k], confidence, of) for k, of in enumerate(margins)], 1)
    rows = []
    for k, (part, effect) in enumerate(zip(one.parts, effects, strict=True)):
        observed, by_rotation = one.runs[:, k].mean(axis=0)
        row: Row = {
            "group": one.group.label, "kind": part.kind, "above": part.above, "upto": part.upto,
            "observed": float(observed), "by_rotation": float(by_rotation), "ratio": effect.ratio.value,
            "low": effect.ratio.low, "high": effect.ratio.high, "p_value": effect.p, "p_adjusted": effect.p_adjusted,
            "verdict": effect.verdict(1 - confidence), "shown": effect.shown, "reason": effect.ratio.reason or None,
        }  # fmt: skip
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
    """The row that leads: the primary question if it differs from chance, else the largest effect that is shown."""
    common = [row for row in rows if row["kind"] != PAIRS]
    differ = [row for row in common if row["verdict"] in (MORE, LESS)]
    if common[0] in differ or not differ or _is_short(common[0]):
        return common[0]
    return max(differ, key=lambda row: row["shown"])


def _is_short(row: Row) -> bool:
    """Whether runs are too short for the primary question, so that its place is taken by one that nobody asked."""
    return (row["upto"] or 0.0) < PRIMARY / 2


def _code(rows: Sequence[Row]) -> str:
    """Verdict on pairs of exits: that of the first gap that differs from chance, else within, else unknown."""
    found = [row["verdict"] for row in rows]
    shown = [one for one in found if one in (MORE, LESS)]
    return shown[0] if shown else WITHIN if WITHIN in found else UNKNOWN


def _apart(rows: Sequence[Row], alpha: float) -> Row | None:
    """The row where pairs differ most from chance, even if within the margin; None if no difference is shown."""
    shown = [row for row in rows if row["p_adjusted"] is not None and row["p_adjusted"] < alpha]
    return max(shown, key=lambda row: row["shown"], default=None)


def _closest(rows: Sequence[Row], lead: _Measured, confidence: float, n_tests: int) -> Row | None:
    """Bound on the share of exits that another exit set off, within the least gap that is long enough for it.

    Each such exit adds a pair to those of rotation. `share` is the bound: the upper end of the interval, but no less
    than if there were as many pairs as under rotation, since data with few pairs by luck would exclude too much
    (Cowan, Cranmer, Gross and Vitells 2011, arXiv:1105.3166). `seen` is the share that would have been shown with
    probability `POWERED`, by Holm's rule as the first of `n_tests` tests.
    """
    known = sorted((row for row in rows if row["high"] is not None), key=lambda row: row["upto"])
    row = next((row for row in known if row["upto"] >= SOON * lead.gap), None)
    if row is None:
        return None
    dof = len(lead.runs) - 1
    half = 0.5 * np.log(row["high"] / row["low"])
    error, pairs_an_exit = half / student.half_width(confidence, dof), row["by_rotation"] / lead.n_exits
    far = student.half_width(1 - (1 - confidence) / n_tests, dof) + student.quantile(POWERED, dof)
    share, seen = (
        float(np.expm1(log_ratio) * pairs_an_exit) for log_ratio in (max(np.log(row["high"]), half), far * error)
    )
    return row | {"share": share, "seen": seen}


@panel()
def spectrum(ax: Axes, groups: Mapping[str, Sequence[Row]]) -> None:
    """Power of n_stick over that of independent blocks, against the period; rows of the table `spectrum` by group."""
    drawn = over_blocks(ax, groups)
    for k, (label, _, period, ratio, low, high, colour) in enumerate(drawn):
        ax.fill_between(period, low, high, color=colour, alpha=0.18, linewidth=0)
        ax.plot(
            period, ratio, color=colour, marker="os"[k % 2], markersize=3.2, label=label,
            markerfacecolor=(colour, "white")[k % 2],
        )  # fmt: skip


QUESTION = Question(answer, share=0.23, of_cascades=True)
