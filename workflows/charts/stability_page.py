"""From the measured cells to the page: where each method is right, where it fails and how, and what theory says."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from statistics import median

import numpy as np
import pandas as pd
from jinja2 import Environment

from stickslip.analysis import Report
from stickslip.analysis.report.figures import embedded
from stickslip.analysis.report.page import page_environment
from stickslip.workflows.charts import Kind
from stickslip.workflows.charts import figures as chart_figures
from stickslip.workflows.charts.hard_cases import EPS, EXACT_TOLERANCE, TOLERANCE, Verdict
from stickslip.workflows.charts.peers import METHODS
from stickslip.workflows.charts.stability import LAWS, Axis, Cell, Measured, StabilityScene, measure
from stickslip.workflows.charts.tableaus import TABLEAUS, Tableau

#: What each axis is called above its maps, and along them.
TITLES: dict[Axis, tuple[str, str]] = {
    "layer": ("The smoothed law: stiffness of the layer", "stiffness μ / δ"),
    "bond": ("The exact law: one stiff bond", "stiffness of one bond"),
    "damping": ("The exact law: one block's damping", "factor of one damping"),
}
#: The figures: each the maps of one law.
_FIGURES: dict[str, tuple[Axis, ...]] = {"The smoothed law": ("layer",), "The exact law": ("bond", "damping")}
#: Stiffnesses and the longest step at which orders are measured: not stiff at all, and far stiffer than a step.
_MILD, _STIFF, _H = 1.0, 1e4, 0.1
#: The shares of a limit within which, and beyond which, cells of a fixed step are told apart.
_WITHIN, _BEYOND = 0.5, 2.0
_OURS = {method.name for method in METHODS if method.is_ours}
_CONTROL = {method.name: method.control for method in METHODS}
#: Explicit methods whose step is set by stability once the layer is stiff: cost grows as the stiffness.
_EXPLICIT = ("CyRK DOP853", "SciPy DOP853", "SciPy RK45")


# ---------------------------------------------------------------------------------------------- words


def _listed(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _power(number: float) -> str:
    return np.format_float_scientific(number, precision=1, trim="-", exp_digits=1)


def _round(number: float) -> str:
    """Two digits."""
    return f"{float(f'{number:.2g}'):,g}"


def _maps(cells: Iterable[Cell]) -> dict[str, list[Cell]]:
    found: dict[str, list[Cell]] = {}
    for cell in cells:
        if cell.outcome != "absent":
            found.setdefault(cell.method, []).append(cell)
    return found


def _count(cells: Iterable[Cell], outcome: str) -> int:
    return sum(cell.outcome == outcome for cell in cells)


def _where_right(maps: dict[str, list[Cell]], factor: float) -> str:
    """How many cells each method has right, and how far an engine's error goes past its tolerance."""
    ranked = sorted(maps.items(), key=lambda one: -_count(one[1], "right") / len(one[1]))
    counts = [f"{name} in {_count(cells, 'right')} of {len(cells)}" for name, cells in ranked]
    words = [f"Right: {_listed(counts)} cells."]
    for name in _OURS & set(maps):
        asked = [c for c in maps[name] if c.error is not None and c.tolerance is not None]
        if not asked:
            continue
        worst = max(asked, key=lambda c: (c.error or 0.0) / (c.tolerance or 1.0))
        assert worst.error is not None
        assert worst.tolerance is not None
        past = worst.error / worst.tolerance
        words.append(
            f"The {name}'s error is at most {_round(past)} times its tolerance (at {_power(worst.stiffness)},"
            f" tolerance {_power(worst.tolerance)})"
            + (f", above the {factor:g} that count as right." if past > factor else ".")
        )
        largest = max(cell.error or 0.0 for cell in asked)
        words.append(f"Its largest error on the map is {_power(largest)}.")
    return " ".join(words)


def _setting(cell: Cell) -> str:
    if cell.tolerance is not None:
        return f"tolerance {_power(cell.tolerance)}"
    return f"h = {cell.step:g}"


def _where_failing(maps: dict[str, list[Cell]]) -> str:
    """Who is wrong without a word, who fails with one, who takes too long."""
    silent, words = [], []
    for name, cells in maps.items():
        wrong = [cell for cell in cells if cell.outcome == "wrong"]
        if wrong:
            first = min(wrong, key=lambda cell: cell.stiffness)
            errors = [cell.error for cell in wrong if cell.error is not None]
            worst = f"error up to {_power(max(errors))}" if errors else "no finite z"
            silent.append(
                f"{name} in {len(wrong)} of {len(cells)} cells (from stiffness {_power(first.stiffness)},"
                f" {_setting(first)}; {worst})"
            )
    words.append(f"Wrong without a word: {'; '.join(silent)}." if silent else "No method is wrong without a word.")
    for outcome, told in (("failed", "Failing with a message"), ("too slow", "Too slow")):
        counts = [f"{name} in {_count(cells, outcome)}" for name, cells in maps.items() if _count(cells, outcome)]
        words.append(
            f"{told}: {_listed(counts)}."
            if counts
            else f"None is {'too slow' if outcome == 'too slow' else 'failing with a message'}."
        )
    return " ".join(words)


def _fixed_limit(axis: Axis, method: str) -> tuple[float, float] | None:
    """(limit, power): a fixed step is stable for h < limit / stiffness ** power; None where theory sets no limit."""
    if axis == "layer" and method == "RK4":
        return TABLEAUS["RK4"].stable_to, 1.0
    if axis == "bond" and method == "Moreau-Jean":  # the midpoint rule on z'' = -2 k z, k the bond's stiffness
        return 2.0 / math.sqrt(2.0), 0.5
    return None


def _fixed_words(axis: Axis, name: str, cells: list[Cell]) -> str:
    """What a fixed step does within and beyond its limit."""
    limit = _fixed_limit(axis, name)
    if limit is None:
        return ""
    share = {cell: (cell.step or 0.0) * cell.stiffness ** limit[1] / limit[0] for cell in cells}
    inside = [cell for cell in cells if share[cell] < _WITHIN and cell.error is not None]
    outside = [cell for cell in cells if share[cell] > _BEYOND and cell.outcome not in ("too slow", "not judged")]
    law = "h μ / δ" if axis == "layer" else "h √k"
    words = f"{name} is stable for {law} < {limit[0]:.3f}"
    if inside:
        words += f": within half of that its error is at most {_power(max(cell.error or 0.0 for cell in inside))}"
    if outside:
        told = Counter(cell.outcome for cell in outside)
        ratios = [cell.error / cell.step for cell in outside if cell.error is not None and cell.step is not None]
        words += f"; beyond twice that {told['failed']} of {len(outside)} runs fail with a message"
        if ratios:
            words += (
                f", the others go on with an error of {median(ratios):.1g} h in the middle of them"
                f" ({told['wrong']} wrong, {told['rough']} rough, {told['right']} right)"
            )
    return f"{words}."


def _growth(cells: list[Cell], tolerance: float) -> float | None:
    """Cost at the stiffest cell that was finished over that at the one before, to the power of one decade."""
    row = [c for c in cells if c.tolerance == tolerance and c.error is not None and c.seconds]
    row.sort(key=lambda cell: cell.stiffness)
    if len(row) < 2:
        return None
    (a, b), (s, t) = ([cell.stiffness for cell in row[-2:]], [cell.seconds or 1.0 for cell in row[-2:]])
    return float((t / s) ** (1.0 / math.log10(b / a)))


def _theory(axis: Axis, maps: dict[str, list[Cell]], scene: StabilityScene) -> str:
    words = [_fixed_words(axis, name, cells) for name, cells in maps.items()]
    if axis == "layer":
        growths = [
            f"{_round(growth)} ({name})"
            for name in _EXPLICIT
            if name in maps
            if (growth := _growth(maps[name], scene.tolerances[0])) is not None
        ]
        if growths:
            words.append(
                "An explicit method's step is held by stability to a multiple of δ / μ, so its cost grows tenfold a"
                f" decade; measured at the finest tolerance, from the last two columns finished: {_listed(growths)}."
            )
        ours, trapezoid = TABLEAUS["sigmoid engine (ESDIRK)"], TABLEAUS["trapezoid"]
        limit = abs(round(ours.factor(math.inf), 12))  # rounding apart
        words.append(
            "The trapezoid rule is A-stable and does not damp"
            f" (R → {trapezoid.factor(math.inf):g}); the engine's method does (R → {limit:g})"
            f" but loses order in a stiff layer: {ours.order(_MILD, _H):.1f} falls to {ours.order(_STIFF, _H):.1f},"
            f" as Radau's {TABLEAUS['Radau'].order(_MILD, _H):.1f} to {TABLEAUS['Radau'].order(_STIFF, _H):.1f}."
        )
    elif "coulomb engine" in maps:
        growth = _growth(maps["coulomb engine"], scene.tolerances[0])
        reason, most = {
            "bond": ("steps shorten with the fastest frequency, √k, so its cost grows about 3.2 times a decade", "k"),
            "damping": ("series are explicit in R, so its cost grows about tenfold a decade", "R"),
        }[axis]
        words.append(
            f"The coulomb engine's {reason} of {most}"
            + (f"; measured, from the last two columns finished: {_round(growth)}." if growth else ".")
        )
    return " ".join(word for word in words if word)


def _in_short(groups: dict[Axis, dict[str, list[Cell]]], cases: Sequence[Verdict]) -> list[str]:
    """Who is wrong without a word anywhere: the engines by name, then the others."""
    silent: Counter[str] = Counter()
    for maps in groups.values():
        for name, cells in maps.items():
            silent[name] += _count(cells, "wrong")
    cases_wrong = Counter(case.method for case in cases if case.answer == "wrong")
    lines = []
    for name in (method.name for method in METHODS if method.is_ours):
        if name not in silent and not any(case.method == name for case in cases):
            continue
        cells = [cell for maps in groups.values() for cell in maps.get(name, [])]
        others = [f"{_count(cells, outcome)} {outcome}" for outcome in ("rough", "failed", "too slow", "not judged")]
        found = silent[name] + cases_wrong[name]
        head = f"wrong without a word in {found} of its cells and cases" if found else "nowhere wrong without a word"
        told = _listed([f"{_count(cells, 'right')} right", *(word for word in others if not word.startswith("0 "))])
        lines.append(f"The {name} is {head}; of its {len(cells)} cells {told}.")
    peers = [name for name in silent if name not in _OURS]
    guilty = [name for name in peers if silent[name] + cases_wrong[name]]
    lines.append(
        f"Of {len(peers)} other methods {len(guilty)} return an answer that is wrong as a success somewhere"
        + (f": {_listed(guilty)}." if guilty else ".")
    )
    return lines


def _cases_words(cases: Sequence[Verdict]) -> list[str]:
    """What became of the hard cases, method by method."""
    lines = []
    for method in dict.fromkeys(case.method for case in cases):
        mine = [case for case in cases if case.method == method]
        told = Counter(case.answer for case in mine)
        line = f"{method}: right in {told['right']} of {len(mine)} hard cases"
        for answer, words in (
            ("refused", "an error with a message in"),
            ("too slow", "too slow in"),
            ("wrong", "wrong in"),
        ):
            which = [case.case for case in mine if case.answer == answer]
            if which:
                line += f"; {words} {len(which)} ({_listed(which)})"
        lines.append(f"{line}.")
    return lines


# ---------------------------------------------------------------------------------------------- the page


def _limit_line(
    axis: Axis, method: str, stiffness: Sequence[float], steps: Sequence[float]
) -> list[tuple[float, float]]:
    """The part of a limit that lies in the map."""
    limit = _fixed_limit(axis, method)
    if limit is None or len(stiffness) < 2 or len(steps) < 2:
        return []
    at = np.geomspace(stiffness[0], stiffness[-1], 400)
    h = limit[0] / at ** limit[1]
    return [(float(x), float(y)) for x, y in zip(at, h, strict=True) if steps[0] <= y <= steps[-1]]


def _drawn(axis: Axis, maps: dict[str, list[Cell]]) -> list[chart_figures.Map]:
    drawn = []
    for name, cells in maps.items():
        is_step = _CONTROL.get(name) == "step"
        stiffness = sorted({cell.stiffness for cell in cells})
        points = [(c.stiffness, (c.step if is_step else c.tolerance) or 0.0, str(c.outcome), c.error) for c in cells]
        settings = sorted({setting for _, setting, *_ in points})
        line = _limit_line(axis, name, stiffness, settings)
        drawn.append(chart_figures.Map(name, TITLES[axis][1], is_step, stiffness, settings, points, line))
    return drawn


def _linear() -> tuple[
    list[tuple[str, bool, list[float], list[float]]], list[tuple[str, bool, bool, list[float], list[float]]]
]:
    x = np.geomspace(0.1, 1e6, 400).tolist()
    factors = [(t.name, t.is_ours, x, [abs(t.factor(value)) for value in x]) for t in TABLEAUS.values()]
    steps = [_H / 2**k for k in range(6)]
    damping: list[Tableau] = [t for t in TABLEAUS.values() if math.isinf(t.stable_to)]
    errors = [
        (t.name, t.is_ours, stiffness == _STIFF, steps, [t.error(stiffness, h) for h in steps])
        for t in damping
        for stiffness in (_MILD, _STIFF)
    ]
    return factors, errors


def build(scene: StabilityScene, measured: Measured) -> Report:
    """The maps, the theory, the hard cases and their tables: `cells`, `references`, `cases`.

    Parameters
    ----------
    scene : StabilityScene
    measured : Measured
        What `stickslip.workflows.charts.stability.measure` found for that scene.
    """
    groups = {axis: _maps(cell for cell in measured.cells if cell.axis == axis) for axis in LAWS}
    groups = {axis: maps for axis, maps in groups.items() if maps}
    answer = {"In short": _in_short(groups, measured.cases)}
    answer |= {
        TITLES[axis][0]: [_where_right(maps, scene.factor), _where_failing(maps), _theory(axis, maps, scene)]
        for axis, maps in groups.items()
    }
    if measured.cases:
        answer["Hard cases"] = _cases_words(measured.cases)
    pictures = []
    for title, axes in _FIGURES.items():
        drawn = [one for axis in axes if axis in groups for one in _drawn(axis, groups[axis])]
        if drawn:
            pictures.append((title, embedded(chart_figures.stability_maps(drawn))))
    absent = sorted({f"{c.method} ({c.reason})" for c in measured.cells if c.outcome == "absent"})
    html = _environment().get_template("stability.html").render(
        scene=scene,
        answer=answer,
        pictures=pictures,
        theory=embedded(chart_figures.linear_theory(*_linear())),
        limits=[(t.name, t.stable_to) for t in TABLEAUS.values()],
        mild=_MILD,
        stiff=_STIFF,
        cases=_by_case(measured.cases),
        case_methods=list(dict.fromkeys(case.method for case in measured.cases)),
        eps=EPS,
        tolerance=TOLERANCE,
        exact_tolerance=EXACT_TOLERANCE,
        cells=measured.cells,
        references=measured.references,
        absent=absent,
        versions=measured.versions,
    )  # fmt: skip
    tables = {
        "cells": pd.DataFrame(map(asdict, measured.cells)),
        "references": pd.DataFrame(map(asdict, measured.references)),
        "cases": pd.DataFrame(map(asdict, measured.cases), columns=list(Verdict.__dataclass_fields__)).astype(
            {"n_events": "Int64", "n_known": "Int64"}
        ),
    }
    headline = [scene.title, *(f"{title}: {line}" for title, lines in answer.items() for line in lines)]
    return Report(html, tables, headline)


def _by_case(cases: Sequence[Verdict]) -> list[tuple[Verdict, dict[str, Verdict]]]:
    """Each case once, with its verdicts by method."""
    found: dict[str, dict[str, Verdict]] = {}
    for case in cases:
        found.setdefault(case.case, {})[case.method] = case
    return [(next(iter(mine.values())), mine) for mine in found.values()]


def _environment() -> Environment:
    environment = page_environment("stickslip.workflows.charts")
    environment.filters["power"] = _power
    return environment


def _extent(scene: StabilityScene) -> str:
    found = sum(
        len(columns) * len(scene.steps if method.control == "step" else scene.tolerances)
        for axis, columns in scene.axes.items()
        for method in METHODS
        if method.model == LAWS[axis]
    )
    return f"{found} cells{' and the hard cases' if scene.cases else ''}"


KIND = Kind(StabilityScene, _extent, measure, Measured.restore, build)
