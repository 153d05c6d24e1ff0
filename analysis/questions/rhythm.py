"""Does n_stick have a slow rhythm? Its period, quality and share of the variance, and their laws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from scipy import special

from stickslip.analysis.answer import Answer, F, Row, S, frame, named
from stickslip.analysis.ensemble import Group, Study
from stickslip.analysis.stats import rhythm, student
from stickslip.analysis.stats.effects import over_null
from stickslip.analysis.stats.estimates import Estimate, jackknife_error
from stickslip.analysis.stats.multiplicity import holm
from stickslip.analysis.stats.nulls import block_steps
from stickslip.analysis.stats.rhythm import (
    LEAST_HARMONICS,
    LEAST_PERIODS,
    NONE,
    NUMBERS,
    SHORT,
    SLOW,
    SWINGS,
    Spectra,
)
from stickslip.analysis.style import over_blocks, panel

CYCLES = 3.0  # of a block: a motion that takes longer is slow
LAWS = ("period", "quality", "share")  # numbers whose laws are asked for
KEYS = ("n", "kappa", "rho", "belt_speed")  # along which
LEAST_POINTS = 3  # of a law
MOST_DRAWN = 2  # groups in the figure
_ORDER = (SWINGS, SLOW, NONE, SHORT)  # what leads
RISES, FALLS, UNKNOWN = "rises", "falls", "cannot be told"
_RHYTHM: Mapping[str, str] = {
    "group": S, "verdict": S, "p_value": F, "cycle": F, "n_windows": F, "span": F, "needed": F,
    **{f"{name}{end}": F for name in NUMBERS for end in ("", "_low", "_high")}, "reason": S,
}  # fmt: skip
_SPECTRUM: Mapping[str, str] = {"group": S, "above": F, "upto": F, "ratio": F, "low": F, "high": F, "model": F}
_LAW: Mapping[str, str] = {
    "number": S, "key": S, "first_value": F, "last_value": F, "n_points": F, "first": F, "last": F, "exponent": F,
    "low": F, "high": F, "p_value": F, "p_adjusted": F, "p_misfit": F, "verdict": S,
}  # fmt: skip


@dataclass(frozen=True)
class _Measured:
    """A group's spectra, the mean time between two exits of a block, and what is found; None of a short window."""

    group: Group
    units: list[int]
    data: Spectra
    cycle: float
    found: rhythm.Rhythm | None

    def logs(self, name: str, units: Sequence[int]) -> list[float]:
        """Logarithms of a number of `NUMBERS`: of all, and without each of some units, which need not be its own."""
        assert self.found is not None
        whole, *left_out = np.log(self.found.values[name]).tolist()
        of = dict(zip(self.units, left_out, strict=True))
        return [whole, *(of.get(unit, whole) for unit in units)]


def answer(study: Study) -> Answer:
    """Whether blocks swing slowly together."""
    if not study.data.events:
        return Answer(lack="no events")
    judged = study.judged()
    if not judged:
        code, facts = study.refusal()
        return Answer(facts, lack=code)
    measured = [one for group in judged for one in [_measured(study, group)] if one is not None]
    if not measured:
        return Answer(lack="no events")
    level, t_burn = study.settings.confidence, study.settings.t_burn
    rows = [_row(one, t_burn) for one in measured]
    laws = _laws(measured, rows, level)
    spectra = {one.group.label: _bands(one, level) for one in measured if one.found is not None}
    tables = {
        "rhythm": frame(_RHYTHM, rows), "rhythm_laws": frame(_LAW, laws),
        "rhythm_spectrum": frame(_SPECTRUM, [row for some in spectra.values() for row in some]),
    }  # fmt: skip
    lead = min(rows, key=lambda row: _ORDER.index(row["verdict"]))  # of like ones the first
    facts = {
        "lead": lead, "rows": rows, "laws": laws, "cycles": CYCLES, "n_surrogates": rhythm.SURROGATES,
        "level": 1 - level,
    }  # fmt: skip
    if lead["verdict"] == SHORT and lead["p_value"] is None:
        return Answer(facts, lack="short", tables=tables)
    in_order = sorted(spectra, key=lambda label: label != lead["group"])
    drawn = {label: spectra[label] for label in in_order[:MOST_DRAWN]}
    return Answer(facts, tables=tables, figures={"rhythm": partial(spectrum, drawn)})


def _measured(study: Study, group: Group) -> _Measured | None:
    span = float(group.key["t_end"]) - study.settings.t_burn
    runs = []
    for row, member_id, win in study.windows(group):
        if member_id in study.data.events:
            steps = block_steps(*study.data.events[member_id], win.t_start, win.t_stop)
            if (steps.step < 0).any():
                runs.append((row, steps, win.time_variance()))
    cycles = [len(np.unique(steps.exits()[1])) * span / np.sum(steps.step < 0) for _, steps, _ in runs]
    if len({row for row, _, _ in runs}) < 2:
        return None
    cycle = float(np.mean(cycles))
    m = rhythm.n_harmonics(span, CYCLES * cycle)
    sums, variance, n_runs = (
        np.zeros((len(group.units), 2, m)),
        np.zeros(len(group.units)),
        np.zeros(len(group.units)),
    )
    for row, steps, var in runs:
        sums[row] += rhythm.periodogram(steps, m)
        variance[row] += var
        n_runs[row] += 1
    seen = n_runs > 0
    means, n_runs = sums[seen] / n_runs[seen, None, None], n_runs[seen]
    data = Spectra(span, means[:, 0], means[:, 1], variance[seen] / n_runs, n_runs)
    rng = study.generator(f"rhythm of {group.label}")
    found = rhythm.rhythm(data, study.settings.confidence, rng) if m >= LEAST_HARMONICS else None
    units = [unit for unit, is_seen in zip(group.units, seen, strict=True) if is_seen]
    return _Measured(group, units, data, cycle, found)


def _row(one: _Measured, t_burn: float) -> Row:
    """What a group shows; `needed` is the t_end that could tell, where this one cannot."""
    found, span = one.found, one.data.span
    row: Row = {"group": one.group.label, "cycle": one.cycle, "span": span, "n_windows": float(one.data.n_runs.sum())}
    if found is None:
        row |= {"verdict": SHORT, "p_value": None, "needed": t_burn + LEAST_HARMONICS * CYCLES * one.cycle}
    else:
        needed = None if found.verdict != SHORT else t_burn + 2 * LEAST_PERIODS * (found.period or span)
        row |= {"verdict": found.verdict, "p_value": found.p, "needed": needed}
    estimates = {} if found is None else found.found
    for name in NUMBERS:
        row |= named(name, estimates.get(name, Estimate()))
    return row | {"reason": next((one.reason for one in estimates.values() if one.reason), None)}


# ------------------------------------------------------------------------------------------------- laws


def _laws(measured: Sequence[_Measured], rows: Sequence[Row], confidence: float) -> list[Row]:
    """Each number as a power of each key that groups differ in; all are judged together."""
    known = [one for one, row in zip(measured, rows, strict=True) if row["verdict"] in (SWINGS, SLOW)]
    laws = [law for key in KEYS for name in LAWS for law in [_law(name, key, known, confidence)] if law]
    for law, p in zip(laws, holm([law["p_value"] for law in laws]), strict=True):
        is_shown = p <= 1 - confidence
        law |= {"p_adjusted": float(p), "verdict": (RISES if law["exponent"] > 0 else FALLS) if is_shown else UNKNOWN}
    return laws


def _law(name: str, key: str, known: Sequence[_Measured], confidence: float) -> Row | None:
    """The exponent of a number in |key|, one for all sets of groups that differ in this key alone.

    Least squares of the logarithms, weighted by the errors of the points; its error is from leaving out a matrix
    everywhere at once, as groups share draws.
    """
    sets: dict[tuple[object, ...], list[_Measured]] = {}
    for one in known:
        if one.group.key[key]:
            others = tuple(value for other, value in one.group.key.items() if other != key)
            sets.setdefault(others, []).append(one)
    points = [(one, k) for k, some in enumerate(sets.values()) for one in some if len(some) > 1]
    at = np.array([abs(float(one.group.key[key])) for one, _ in points])
    if len(set(at.tolist())) < LEAST_POINTS:
        return None
    units = sorted({unit for one, _ in points for unit in one.units})
    x, y = np.log(at), np.array([one.logs(name, units) for one, _ in points])
    means = [float(np.exp(y[at == end, 0].mean())) for end in (at.min(), at.max())]
    weight = np.array([jackknife_error(np.array(one.logs(name, one.units)[1:])) ** -2 for one, _ in points])
    of_set = np.array([k for _, k in points])
    for k in set(of_set.tolist()):  # each has a level of its own
        own = of_set == k
        share = weight[own] / weight[own].sum()
        x[own], y[own] = x[own] - share @ x[own], y[own] - share @ y[own]
    slopes = (weight * x) @ y / (weight @ x**2)
    slope, its_error, dof = float(slopes[0]), jackknife_error(slopes[1:]), len(units) - 1
    half, n_free = student.half_width(confidence, dof) * its_error, len(points) - len(set(of_set.tolist())) - 1
    return {
        "number": name, "key": key, "n_points": len(points), "first_value": float(at.min()), "first": means[0],
        "last_value": float(at.max()), "last": means[1], "exponent": slope, "low": slope - half, "high": slope + half,
        "p_value": student.two_sided(slope / its_error, dof),
        "p_misfit": float(special.chdtrc(n_free, weight @ (y[:, 0] - slope * x) ** 2)),
    }  # fmt: skip


# ---------------------------------------------------------------------------------------------- the figure


def _bands(one: _Measured, confidence: float) -> list[Row]:
    """Power over that of independent blocks, by bands of whole harmonics, and what is fitted, at their middle."""
    data, rows, begin = one.data, list[Row](), 0
    while begin < len(data.frequency):
        some = slice(begin, end := min(begin + 1 + begin // 5, len(data.frequency)))
        observed, own = (power[:, some].sum(axis=1, keepdims=True) for power in (data.observed, data.independent))
        ratio = over_null(lambda sums: sums[:, 0], observed, own, confidence).ratio
        above, upto = (data.span / (0.5 + edge) for edge in (end, begin))
        model = None
        if one.found is not None and one.found.values:
            variance, period, quality, left = (
                float(one.found.values[name][0]) for name in ("variance", "period", "quality", "left")
            )
            swing = variance * rhythm.spectrum(data.frequency[some], period, quality)
            model = float(left + swing.mean() / data.independent[:, some].mean())
        rows.append({"group": one.group.label, "above": above, "upto": upto, "ratio": ratio.value, "low": ratio.low,
                     "high": ratio.high, "model": model})  # fmt: skip
        begin = end
    return rows


@panel()
def spectrum(ax: Axes, groups: Mapping[str, Sequence[Row]]) -> None:
    """Power of n_stick over that of independent blocks, against the period; rows of `rhythm_spectrum` by group."""
    drawn = over_blocks(ax, groups, "lower right")
    for k, (label, seen, period, ratio, low, high, colour) in enumerate(drawn):
        ax.errorbar(
            period * 1.02**k, ratio, yerr=[ratio - low, high - ratio], color=colour, fmt="os"[k % 2], markersize=3,
            linewidth=0.9, label=label, markerfacecolor=(colour, "white")[k % 2],
        )  # fmt: skip
        if all(row["model"] is not None for row in seen):
            ax.plot(period, [row["model"] for row in seen], color=colour)
