"""Whether n_stick has a slow rhythm: its period, quality and share of the variance, and how these scale with keys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from scipy import special

from stickslip.analysis.answer import Answer, F, Question, Row, S, frame, named
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.members import ENGINE_KEYS
from stickslip.analysis.models import rhythm
from stickslip.analysis.models.rhythm import (
    LEAST_HARMONICS,
    LEAST_PERIODS,
    NONE,
    NUMBERS,
    OSCILLATES,
    SHORT,
    SLOW,
    Spectra,
)
from stickslip.analysis.questions.runs.sweep import FALLS, RISES, curves
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats import student
from stickslip.analysis.stats.compare import UNKNOWN, equivalence_test
from stickslip.analysis.stats.effects import over_null
from stickslip.analysis.stats.estimates import Estimate, jackknife_error
from stickslip.analysis.stats.multiplicity import holm
from stickslip.analysis.style import over_blocks, panel
from stickslip.pipeline.design.labels import engine_name
from stickslip.pipeline.design.values import shown
from stickslip.sim.engines import place

CYCLES = 3.0  # of a block: motion of longer periods is slow
SCALED = ("period", "quality", "share")  # numbers that may go as a power of a key
KEYS = ("n", "kappa", "rho", "belt_speed")  # whose powers are fitted
LEAST_POINTS = 3  # to fit a power
LEAST_FACTOR = 2.0  # least ratio of the largest to the smallest value of a key, to claim a power of it
LEAST_P = 0.05  # least p-value of the misfit, and of one exponent for all settings, to claim a power
MOST_DRAWN = 3  # groups in the figure
LARGER, SMALLER = "larger", "smaller"  # verdicts between engines, along which nothing rises
ENGINE = "engine"  # changes are also compared between engines
_ORDER = (OSCILLATES, SLOW, NONE, SHORT)  # the first verdict found leads
_RHYTHM: Mapping[str, str] = {
    "group": S, "verdict": S, "p_value": F, "p_floor": F, "cycle": F, "n_windows": F, "span": F, "needed": F,
    **{f"{name}{end}": F for name in NUMBERS for end in ("", "_low", "_high")}, "reason": S,
}  # fmt: skip
_SPECTRUM: Mapping[str, str] = {"group": S, "above": F, "upto": F, "ratio": F, "low": F, "high": F, "model": F}
_POWERS: Mapping[str, str] = {
    "number": S, "key": S, "first_value": F, "last_value": F, "n_points": F, "exponent": F, "low": F, "high": F,
    "p_value": F, "p_adjusted": F, "p_misfit": F, "p_apart": F,
}  # fmt: skip
_CHANGE: Mapping[str, str] = {
    "number": S, "key": S, "at": S, "first_value": S, "last_value": S, "first": F, "last": F, "change": F, "low": F,
    "high": F, "p_value": F, "p_adjusted": F, "verdict": S,
}  # fmt: skip


@dataclass(frozen=True)
class _Measured:
    """A group's spectra, the mean cycle of a block, from exit to exit, and the rhythm; None if windows are short."""

    group: Group
    units: list[int]
    data: Spectra
    cycle: float
    found: rhythm.Rhythm | None

    def logs(self, name: str, units: Sequence[int]) -> list[float]:
        """Logarithm of one of `NUMBERS` from all units and with each of `units` left out; others change nothing."""
        assert self.found is not None
        whole, *left_out = np.log(self.found.values[name]).tolist()
        of = dict(zip(self.units, left_out, strict=True))
        return [whole, *(of.get(unit, whole) for unit in units)]


def answer(study: Study) -> Answer:
    """Whether blocks oscillate together slowly."""
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
    known = [one for one, row in zip(measured, rows, strict=True) if row["verdict"] in (OSCILLATES, SLOW)]
    known.sort(key=lambda one: int(one.group.key["n"]))
    changes = _changes(known, level)
    laws = [one for key in KEYS for name in SCALED for one in [_power_law(name, key, known, level)] if one]
    for one, p in zip(laws, holm([one["p_value"] for one in laws]), strict=True):
        one["p_adjusted"] = float(p)
    spectra = {one.group.label: _bands(one, level) for one in measured if one.found is not None}
    tables = {
        "rhythm": frame(_RHYTHM, rows), "rhythm_changes": frame(_CHANGE, changes), "rhythm_laws": frame(_POWERS,
        laws), "rhythm_spectrum": frame(_SPECTRUM, [row for some in spectra.values() for row in some]),
    }  # fmt: skip
    lead = min(rows, key=lambda row: _ORDER.index(row["verdict"]))  # of like ones the first
    told = _told(changes, lead["group"])
    facts = {
        "lead": lead, "rows": rows, "laws": [one for one in laws if _is_power(one, 1 - level)],
        "changes": changes, "told": told,
        "cycles": CYCLES, "n_surrogates": rhythm.SURROGATES, "level": 1 - level,
    }  # fmt: skip
    if lead["verdict"] == SHORT and lead["p_value"] is None:
        return Answer(facts, lack="short", tables=tables)
    compared = [lead["group"], *(one["groups"][end] for one in told for end in (0, -1))]
    in_order = sorted(spectra, key=lambda label: compared.index(label) if label in compared else len(compared))
    drawn = {group.label: spectra[group.label] for group in study.groups if group.label in in_order[:MOST_DRAWN]}
    figures, along = {"rhythm": partial(spectrum, drawn)}, _along(told, changes)
    if along:
        figures["rhythm_period"] = partial(curves, "natural period", *_lines(along, rows))
    facts |= {"n_drawn": len(drawn), "along": along[0]["key"] if along else None}
    return Answer(facts, tables=tables, figures=figures)


def _measured(study: Study, group: Group) -> _Measured | None:
    """The spectra and the rhythm of a group; None if fewer than two units have exits."""
    span = float(group.key["t_end"]) - study.settings.t_burn
    cycles, n_runs = study.sums(group, _cycle, 1).T
    seen = n_runs > 0
    if np.count_nonzero(seen) < 2:
        return None
    cycle = float(cycles.sum() / n_runs.sum())
    m = rhythm.n_harmonics(span, CYCLES * cycle)
    found = study.sums(group, partial(_spectrum, m), 2 * m + 1)[seen]
    sums, variance, n_runs = found[:, : 2 * m].reshape(-1, 2, m), found[:, 2 * m], found[:, -1]
    means = sums / n_runs[:, None, None]
    data = Spectra(span, means[:, 0], means[:, 1], variance / n_runs, n_runs)
    rng = study.generator(f"rhythm of {group.label}")
    law = rhythm.rhythm(data, study.settings.confidence, rng) if m >= LEAST_HARMONICS else None
    units = [unit for unit, is_seen in zip(group.units, seen, strict=True) if is_seen]
    return _Measured(group, units, data, cycle, law)


def _cycle(run: Run) -> np.ndarray | None:
    """Time in which each block that lets go does so once, on average; None for a run without exits or events."""
    if run.steps is None or not (run.steps.step < 0).any():
        return None
    return np.array([len(np.unique(run.steps.exits()[1])) * run.steps.span / np.sum(run.steps.step < 0)])


def _spectrum(m: int, run: Run) -> np.ndarray | None:
    """`periodogram` of a run, and its variance in time; None as `_cycle`."""
    if run.steps is None or not (run.steps.step < 0).any():
        return None
    return np.append(rhythm.periodogram(run.steps, m), run.win.time_variance())


def _row(one: _Measured, t_burn: float) -> Row:
    """Row of the table `rhythm`; `needed` is the t_end that may suffice where this one does not."""
    found, span = one.found, one.data.span
    row: Row = {
        "group": one.group.label,
        "n_runs": len(one.group),
        "n_moving": one.group.n_moving,
        "cycle": one.cycle,
        "span": span,
        "n_windows": float(one.data.n_runs.sum()),
    }
    if found is None:
        row |= {
            "verdict": SHORT,
            "p_value": None,
            "p_floor": None,
            "needed": t_burn + LEAST_HARMONICS * CYCLES * one.cycle,
        }
    else:
        needed = None if found.verdict != SHORT else t_burn + 2 * LEAST_PERIODS * (found.period or span)
        row |= {"verdict": found.verdict, "p_value": found.p, "p_floor": rhythm.P_FLOOR, "needed": needed}
    estimates = {} if found is None else found.found
    for name in NUMBERS:
        row |= named(name, estimates.get(name, Estimate()))
    return row | {"reason": next((one.reason for one in estimates.values() if one.reason), None)}


# ------------------------------------------------------------------------------------- changes and laws


def _alike(key: str, known: Sequence[_Measured]) -> list[list[_Measured]]:
    """Sets of two or more groups that differ in one key only, sorted by it; for `ENGINE`, the exact one first."""
    own = ENGINE_KEYS if key == ENGINE else (key,)
    sets: dict[tuple[object, ...], list[_Measured]] = {}
    for one in known:
        if key == ENGINE or one.group.key[key]:
            others = tuple(value for other, value in one.group.key.items() if other not in own)
            sets.setdefault(others, []).append(one)
    order = _place if key == ENGINE else lambda one: float(one.group.key[key])
    return [sorted(some, key=order) for some in sets.values() if len(some) > 1]


def _place(one: _Measured) -> int:
    return place(one.group.key["engine"])


def _changes(known: Sequence[_Measured], confidence: float) -> list[Row]:
    """Change of each number between the first and the last of groups that differ in one key, by Holm's rule."""
    varied = [name for name in KEYS if len({one.group.key[name] for one in known}) > 1]
    engines = {one.group.key["engine"] for one in known}
    found = [
        _change(name, key, some, confidence)
        | {"at": _others(some[0], [other for other in varied if other != key], key != ENGINE and len(engines) > 1)}
        for name in SCALED for key in (*KEYS, ENGINE) for some in _alike(key, known)
    ]  # fmt: skip
    for row, p in zip(found, holm([row["p_value"] for row in found]), strict=True):
        more, less = (LARGER, SMALLER) if row["key"] == ENGINE else (RISES, FALLS)
        shown = more if row["change"] > 0 else less
        row |= {"p_adjusted": float(p), "verdict": shown if p < 1 - confidence else UNKNOWN}
    return found


def _others(one: _Measured, names: Sequence[str], by_engine: bool) -> str | None:
    """The values, as text, that groups which differ in one key share of the other varied keys; None if none vary."""
    of_engine = [engine_name(one.group.key["engine"])] if by_engine else []
    return ", ".join([f"{name} = {shown(one.group.key[name])}" for name in names] + of_engine) or None


def _change(name: str, key: str, some: Sequence[_Measured], confidence: float) -> Row:
    """Relative change of a number from the first to the last of some groups.

    For its error a matrix is left out of both at once, as they share draws.
    """
    units = sorted({unit for one in (some[0], some[-1]) for unit in one.units})
    logs = np.array(some[-1].logs(name, units)) - np.array(some[0].logs(name, units))
    test = equivalence_test(float(logs[0]), jackknife_error(logs[1:]), len(units) - 1, 0.0)
    values = [one.group.label if key == ENGINE else shown(one.group.key[key]) for one in some]
    numbers = [float(np.exp(one.logs(name, ())[0])) for one in some]
    return {
        "number": name, "key": key, "values": values, "numbers": numbers, "groups": [one.group.label for one in some],
        "first_value": values[0], "last_value": values[-1], "first": numbers[0], "last": numbers[-1],
        **dict(zip(("change", "low", "high"), np.expm1([test.difference, *test.interval(confidence)]).tolist(),
                   strict=True)),
        "p_value": test.p_different,
    }  # fmt: skip


def _told(changes: Sequence[Row], lead: str) -> list[Row]:
    """Changes of the natural period that are shown, go one way, and involve the leading group; where they are not."""
    of_period = [row for row in changes if row["number"] == "period" and row["key"] != ENGINE]
    return [
        row | {"not_at": [one["at"] for one in of_period
                          if one["key"] == row["key"] and one["verdict"] != row["verdict"]]}
        for row in of_period
        if lead in row["groups"] and row["verdict"] != UNKNOWN and len(set(np.sign(np.diff(row["numbers"])))) == 1
    ]  # fmt: skip


def _along(told: Sequence[Row], changes: Sequence[Row]) -> list[Row]:
    """Changes of the natural period with one key: that of the first change told, else the first that varies."""
    of_period = [row for row in changes if row["number"] == "period" and row["key"] != ENGINE]
    key = next((row["key"] for row in (*told, *of_period)), None)
    return [row for row in of_period if row["key"] == key]


def _lines(
    along: Sequence[Row], rows: Sequence[Row]
) -> tuple[str, list[float], list[str], list[tuple[str, list[Estimate | None]]]]:
    """Arguments of `curves`: a key, its values, and the natural period along it, one line for each other setting."""
    by_label = {row["group"]: row for row in rows}
    ticks = sorted({value for row in along for value in row["values"]}, key=float)
    lines = []
    for one in along:
        found = {value: by_label[label] for value, label in zip(one["values"], one["groups"], strict=True)}
        at = [found.get(value) for value in ticks]
        line = [
            None if row is None else Estimate(*(row[f"period{end}"] for end in ("", "_low", "_high"))) for row in at
        ]
        lines.append((one["at"] or "", line))
    return along[0]["key"], [float(value) for value in ticks], ticks, lines


def _power_law(name: str, key: str, known: Sequence[_Measured], confidence: float) -> Row | None:
    """The exponent of a number as a power of |key|, common to all sets of groups that differ in this key only.

    By least squares of the logarithms, weighted by the errors of the points. Errors come from leaving out a matrix
    everywhere at once, as groups share draws. `p_misfit` is the p-value of the points' scatter about the lines,
    `p_apart` that of the differences between the sets' own exponents (Hotelling's T^2; null for one set).
    """
    sets = _alike(key, known)
    points = [(one, k) for k, some in enumerate(sets) for one in some]
    at = np.array([abs(float(one.group.key[key])) for one, _ in points])
    if len(set(at.tolist())) < LEAST_POINTS:
        return None
    units = sorted({unit for one, _ in points for unit in one.units})
    x, y = np.log(at), np.array([one.logs(name, units) for one, _ in points])
    weight = np.array([jackknife_error(np.array(one.logs(name, one.units)[1:])) ** -2 for one, _ in points])
    own = np.array([k for _, k in points])[:, None] == np.arange(len(sets))  # each set has a level of its own
    share = own * weight[:, None] / (weight @ own)
    x, y = x - own @ (share.T @ x), y - own @ (share.T @ y)
    by_set = (own.T @ (weight[:, None] * x[:, None] * y)) / (own.T @ (weight * x**2))[:, None]
    slopes = (weight * x) @ y / (weight @ x**2)
    slope, its_error, dof = float(slopes[0]), jackknife_error(slopes[1:]), len(units) - 1
    half, n_free = student.half_width(confidence, dof) * its_error, len(points) - len(sets) - 1
    return {
        "number": name, "key": key, "n_points": len(points), "first_value": float(at.min()),
        "last_value": float(at.max()), "exponent": slope, "low": slope - half, "high": slope + half,
        "p_value": student.two_sided(slope / its_error, dof),
        "p_misfit": float(special.chdtrc(n_free, weight @ (y[:, 0] - slope * x) ** 2)),
        "p_apart": _p_apart(by_set),
    }  # fmt: skip


def _p_apart(slopes: np.ndarray) -> float | None:
    """p-value of the null that some sets have one slope, from slopes of shape (k, 1 + G).

    Columns are the slopes from all matrices, and with each left out. None for one set, or too few matrices.
    """
    apart, n = slopes[1:] - slopes[0], slopes.shape[1] - 1
    k = len(apart)
    if not 0 < k < n:
        return None
    off = apart[:, 1:] - apart[:, 1:].mean(axis=1, keepdims=True)
    square = apart[:, 0] @ np.linalg.solve((n - 1) / n * off @ off.T, apart[:, 0])
    return float(special.fdtrc(k, n - k, (n - k) / (k * (n - 1)) * square))


def _is_power(found: Row, alpha: float) -> bool:
    """Whether a number may be called a power of a key: it is shown over a wide range, and one exponent fits all."""
    fits = min(found["p_misfit"], 1.0 if found["p_apart"] is None else found["p_apart"]) >= LEAST_P
    return bool(fits and found["p_adjusted"] < alpha and found["last_value"] >= LEAST_FACTOR * found["first_value"])


# ---------------------------------------------------------------------------------------------- the figure


def _bands(one: _Measured, confidence: float) -> list[Row]:
    """Power over that of independent blocks in bands of harmonics, beside that of the fit."""
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
    drawn = over_blocks(ax, groups)
    for k, (label, seen, period, ratio, low, high, colour) in enumerate(drawn):
        ax.errorbar(
            period, ratio, yerr=[ratio - low, high - ratio], color=colour, fmt="os^"[k % 3], markersize=3,
            linewidth=0.9, label=label, markerfacecolor=(colour, "white", "white")[k % 3],
        )  # fmt: skip
        if all(row["model"] is not None for row in seen):
            ax.plot(period, [row["model"] for row in seen], color=colour)


QUESTION = Question(answer, share=0.08, of_cascades=True)
