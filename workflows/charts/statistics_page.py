"""From the measured biases to the page: the loosest setting that is sufficient, what it saves, and what remains."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby

import numpy as np
import pandas as pd
from jinja2 import Environment

from stickslip.analysis import Report
from stickslip.analysis.report.figures import embedded
from stickslip.analysis.report.page import page_environment
from stickslip.analysis.report.words import count, number, percent, sentence, signed
from stickslip.analysis.stats.estimates import Estimate
from stickslip.workflows.charts import Kind
from stickslip.workflows.charts import figures as chart_figures
from stickslip.workflows.charts.peers import Model
from stickslip.workflows.charts.statistics import (
    METHODS,
    REFERENCES,
    STATISTICS,
    Compared,
    Measured,
    StatisticsScene,
    compared,
    finished,
    loosest_of,
    measure,
    paired,
)

LAWS: dict[Model, str] = {"coulomb": "Exact law", "sigmoid": "Sigmoid"}
#: Costs that differ by less than this factor are not called different.
_ALIKE = 1.05

#: Value, low and high in units of a sampling error; and what the figure takes.
_Ends = tuple[float, float, float]
_Drawn = list[tuple[str, list[tuple[list[chart_figures.Biases], _Ends | None]]]]


@dataclass(frozen=True)
class _Setting:
    """One setting of one method with its rows, one a statistic."""

    method: str
    setting: float
    products: float | None
    rows: list[Compared]

    @property
    def is_sufficient(self) -> bool:
        return all(row.is_sufficient for row in self.rows)

    @property
    def failing(self) -> list[Compared]:
        """Rows that are not sufficient; those that are shown to move by the most sampling errors first."""

        def moved(row: Compared) -> float:
            if row.low is None or row.high is None or not row.sampling_error:
                return 0.0
            return max(row.low, -row.high, 0.0) / row.sampling_error

        return sorted((row for row in self.rows if not row.is_sufficient), key=moved, reverse=True)

    def __str__(self) -> str:
        return _asked(self.method, self.setting)


def _named(method: str) -> str:
    return method if method == "Moreau-Jean" else f"the {method}"


def _asked(method: str, setting: float) -> str:
    key = {"coulomb engine": "tol", "sigmoid engine": "rtol = atol", "Moreau-Jean": "h"}[method]
    return f"{key} = {_short(method, setting)}"


def _short(method: str, setting: float) -> str:
    return f"{setting:g}" if method == "Moreau-Jean" else np.format_float_scientific(setting, trim="-", exp_digits=1)


def _settings(rows: Iterable[Compared]) -> dict[str, list[_Setting]]:
    """By method, from the tightest to the loosest; references are left out."""
    found: dict[str, list[_Setting]] = {}
    charted = (row for row in rows if not row.is_reference)
    for (method, setting), some in groupby(charted, key=lambda row: (row.method, row.setting)):
        mine = list(some)
        found.setdefault(method, []).append(_Setting(method, setting, mine[0].products, mine))
    return found


# ---------------------------------------------------------------------------------------------- words


def _count(products: float) -> str:
    return f"{float(f'{products:.2g}'):,.0f}"


def _interval(found: Estimate, allowed: float | None) -> str:
    """A bias with its interval, to about a hundredth of the sampling error: what is smaller is 0."""
    if found.value is None:
        return f"unknown ({found.reason})"
    words = [_rounded(number, allowed) for number in (found.value, found.low, found.high) if number is not None]
    return (
        f"{words[0]} ({words[1]} to {words[2]})" if len(words) == 3 else f"{words[0]} (no interval: {found.reason})"
    )


def _rounded(value: float, allowed: float | None) -> str:
    if not allowed:
        return signed(value)
    decimals = max(2 - math.floor(math.log10(allowed)), 0)
    return f"{value:+.{decimals}f}" if round(value, decimals) else "0"


def _bias(row: Compared) -> str:
    return _interval(Estimate(row.bias, row.low, row.high, row.reason or ""), row.sampling_error)


def _saved(mine: float, other: float) -> str:
    """The first cost against the second, in words."""
    if max(mine, other) < _ALIKE * min(mine, other):
        return "about as many"
    return f"{other / mine:.2g} times less" if mine < other else f"{mine / other:.2g} times more"


def _loosest(settings: Sequence[_Setting], found: float | None) -> list[str]:
    """How loose a method may be, what that saves, what remains, and why no looser."""
    method, tightest = settings[0].method, settings[0]
    if found is None:
        return [f"No setting of {_named(method)} asked for here is sufficient: {_why(tightest)}.", _alone(settings)]
    sufficient = [one for one in settings if one.setting <= found]
    mine = sufficient[-1]
    words = f"{_named(method)} may be as loose as {mine}"
    if mine.products is not None and tightest.products is not None:
        words += f": {_count(mine.products)} products a run"
        if mine is not tightest:
            words += (
                f", {_saved(mine.products, tightest.products)} than the {_count(tightest.products)} at {tightest}"
            )
        known = [(one.products, one) for one in sufficient if one.products is not None]
        cheapest, where = min(known, key=lambda pair: pair[0])
        if cheapest * _ALIKE < mine.products:
            words += f"; tighter and yet cheaper is {where} with {_count(cheapest)}"
            if where is not tightest:
                words += f", {_saved(cheapest, tightest.products)} than at {tightest}"
    if mine is tightest:
        words += "; that is the tightest asked for"
    lines = [f"{words}.", f"What remains at {mine}: {'; '.join(map(_against, mine.rows))}."]
    looser = settings[len(sufficient) :]
    lines.append(_alone(settings))
    if looser:
        lines.append(f"No looser: {_why(looser[0])}.")
    else:
        lines.append(f"Nothing looser than {mine} was asked for.")
    return lines


def _alone(settings: Sequence[_Setting]) -> str:
    """How loose the method may be for each statistic alone."""
    method = settings[0].method
    rows = [row for one in settings for row in one.rows]
    found = {name: loosest_of([row for row in rows if row.statistic == name])[method] for name in STATISTICS}
    parts = [
        f"{name} {'nowhere here' if setting is None else f'at {_asked(method, setting)}'}"
        for name, setting in found.items()
    ]
    return f"The loosest for one statistic alone: {'; '.join(parts)}."


def _against(row: Compared) -> str:
    return f"{row.statistic} {_bias(row)}{_allowed(row.sampling_error)}"


def _allowed(error: float | None) -> str:
    return "" if error is None else f" against ±{number(error, 2)}"


def _why(setting: _Setting) -> str:
    """What fails at a setting, and whether a move is shown or merely not excluded."""
    first, *rest = setting.failing
    if first.bias is None or first.low is None or first.high is None or first.sampling_error is None:
        return f"at {setting} nothing can be said ({first.reason})"
    words = f"at {setting} the bias of {first.statistic} is {_bias(first)}"
    if max(first.low, -first.high) > first.sampling_error:
        words += f", beyond the sampling error of {number(first.sampling_error, 2)}"
    elif first.low > 0 or first.high < 0:
        words += f", shown, though it may lie within the sampling error of {number(first.sampling_error, 2)}"
    else:
        words += (
            f": none is shown, but one beyond the sampling error of {number(first.sampling_error, 2)} is not excluded"
        )
    if rest:
        words += f"; {', '.join(row.statistic for row in rest)} {'fails' if len(rest) == 1 else 'fail'} as well"
    return words


def _between_methods(chosen: dict[str, _Setting | None]) -> list[str]:
    """Moreau-Jean against the engine that solves the same law, where both are sufficient."""
    engine, stepping = chosen.get("coulomb engine"), chosen.get("Moreau-Jean")
    if engine is None or stepping is None or engine.products is None or stepping.products is None:
        return []
    return [
        f"For that, Moreau-Jean at {stepping} takes {_saved(stepping.products, engine.products)} products than the"
        f" coulomb engine at {engine}."
    ]


def _studies(study: int) -> list[int]:
    """Numbers of matrices: a quarter, half and all of a study."""
    return sorted({max(study // 4, 2), max(study // 2, 2), study})


def _smaller(by_study: dict[int, dict[str, list[_Setting]]]) -> str:
    """What studies of fewer matrices, which err by more, allow."""
    parts = []
    for study, by_method in by_study.items():
        found = loosest_of([row for settings in by_method.values() for one in settings for row in one.rows])
        asked = (
            f"{name} {'nowhere here' if one is None else f'at {_asked(name, one)}'}" for name, one in found.items()
        )
        parts.append(f"with {count(study, 'matrix')}, {', '.join(asked)}")
    return f"The loosest that is sufficient: {'; '.join(parts)}."


def _laws(differences: dict[str, Estimate], allowed: dict[str, float | None], eps: float, study: int) -> str:
    """What the choice of the law does to each statistic, beside what is allowed to the numerics."""
    parts = []
    for statistic, found in differences.items():
        error = allowed[statistic]
        parts.append(f"{statistic} {_interval(found, error)}{_allowed(error)}")
    return (
        f"The choice of the law does this: the sigmoid at eps = {eps:g} minus the exact law, against the exact law's"
        f" sampling error with {count(study, 'matrix')}: {'; '.join(parts)}."
    )


# ---------------------------------------------------------------------------------------------- the page


def build(scene: StatisticsScene, measured: Measured) -> Report:
    """The chart, its statements and its tables: `settings`, `loosest`, `laws`, `runs`.

    Parameters
    ----------
    scene : StatisticsScene
    measured : Measured
        What `stickslip.workflows.charts.statistics.measure` found for that scene.
    """
    rows = compared(measured)
    by_method = _settings(rows)
    found = loosest_of(rows)
    chosen = {
        method: next((one for one in settings if one.setting == found[method]), None)
        for method, settings in by_method.items()
    }
    references = {model: [row for row in rows if row.is_reference and row.model == model] for model in LAWS}
    allowed = {row.statistic: row.sampling_error for row in references["coulomb"]}
    differences = _between_laws(measured)
    by_study = {study: _settings(compared(replace(measured, study=study))) for study in _studies(measured.study)}
    answer = {
        name: [line for method, settings in by_method.items() if METHODS[method] == model
               for line in _loosest(settings, found[method])]
        for model, name in LAWS.items()
    }  # fmt: skip
    answer["Exact law"] += _between_methods(chosen)
    answer["Size of the study"] = [_smaller(by_study)]
    answer["Between the laws"] = [_laws(differences, allowed, scene.eps, measured.study)]
    answer = {name: [sentence(line) for line in lines] for name, lines in answer.items()}
    unfinished = [ran for ran in measured.runs if ran.outcome != "finished"]
    html = _environment().get_template("statistics.html").render(
        scene=scene,
        answer=answer,
        level=percent(measured.confidence),
        src=embedded(chart_figures.statistics_cost(_drawn(by_method, differences, allowed), list(LAWS.values()))),
        statistics=list(STATISTICS),
        laws={LAWS[model]: _of(by_method, model) for model in LAWS},
        references={LAWS[model]: (_asked(*REFERENCES[model]), REFERENCES[model][0], rows)
                    for model, rows in references.items()},
        differences=differences,
        unfinished=unfinished,
        n_runs=len(measured.runs),
        versions=measured.versions,
    )  # fmt: skip
    tables = {
        "settings": pd.DataFrame(map(asdict, rows)),
        "loosest": pd.DataFrame(
            [
                {"study": study, **row}
                for study, by_name in by_study.items()
                for settings in by_name.values()
                for row in _loosest_rows(settings)
            ]
        ),
        "laws": pd.DataFrame(
            [
                {
                    "statistic": name,
                    "difference": one.value,
                    "low": one.low,
                    "high": one.high,
                    "reason": one.reason or None,
                }
                for name, one in differences.items()
            ]
        ),
        "runs": pd.DataFrame(map(asdict, measured.runs)).astype({"total_size": "Int64", "n_cascades": "Int64"}),
    }
    headline = [scene.title, *(f"{name}: {line}" for name, lines in answer.items() for line in lines)]
    return Report(html, tables, headline)


def _between_laws(measured: Measured) -> dict[str, Estimate]:
    """Sigmoid minus exact law, each at its reference, on the matrices where both finished."""
    sigmoid, exact = (finished(measured, *REFERENCES[model]) for model in ("sigmoid", "coulomb"))
    both = sorted(sigmoid.keys() & exact.keys())
    pair = [sigmoid[matrix] for matrix in both], [exact[matrix] for matrix in both]
    return {statistic: paired(statistic, *pair, measured.confidence) for statistic in STATISTICS}


def _loosest_rows(settings: Sequence[_Setting]) -> Iterator[dict[str, object]]:
    """For one method: first for all statistics together (statistic is null), then for each alone."""
    method, tightest = settings[0].method, settings[0]
    rows = [row for one in settings for row in one.rows]
    for statistic in (None, *STATISTICS):
        found = loosest_of([row for row in rows if statistic in (None, row.statistic)])[method]
        mine = next((one for one in settings if one.setting == found), None)
        yield {
            "model": METHODS[method],
            "method": method,
            "statistic": statistic,
            "setting": found,
            "products": None if mine is None else mine.products,
            "tightest": tightest.setting,
            "tightest_products": tightest.products,
        }


def _of(by_method: dict[str, list[_Setting]], model: Model) -> list[_Setting]:
    return [one for method, settings in by_method.items() if METHODS[method] == model for one in settings]


def _drawn(
    by_method: dict[str, list[_Setting]], differences: dict[str, Estimate], allowed: dict[str, float | None]
) -> _Drawn:
    """The figure's points, in units of each law's own sampling error; what has no interval is not drawn."""
    found: _Drawn = []
    for statistic in STATISTICS:
        panels: list[tuple[list[chart_figures.Biases], _Ends | None]] = []
        for model in LAWS:
            methods = [
                points
                for method, settings in by_method.items()
                if METHODS[method] == model and (points := _points(method, statistic, settings)) is not None
            ]
            line = _scaled(differences[statistic], allowed[statistic]) if model == "sigmoid" else None
            panels.append((methods, line))
        found.append((statistic, panels))
    return found


def _scaled(found: Estimate, error: float | None) -> _Ends | None:
    if found.value is None or found.low is None or found.high is None or not error:
        return None
    return found.value / error, found.low / error, found.high / error


def _points(method: str, statistic: str, settings: Sequence[_Setting]) -> chart_figures.Biases | None:
    points = []
    for one in settings:
        (row,) = (row for row in one.rows if row.statistic == statistic)
        ends = _scaled(Estimate(row.bias, row.low, row.high), row.sampling_error)
        if ends is not None and row.products is not None:
            points.append((row.products, *ends, _short(method, one.setting)))
    if not points:
        return None
    return chart_figures.Biases(method, method != "Moreau-Jean", *map(list, zip(*points, strict=True)))


def _environment() -> Environment:
    environment = page_environment("stickslip.workflows.charts")
    environment.filters["count"] = _count
    environment.filters["number"] = number
    environment.filters["bias"] = _bias
    return environment


KIND = Kind(
    StatisticsScene,
    lambda scene: (
        f"{sum(map(len, scene.settings.values()))} settings of {sum(map(bool, scene.settings.values()))} methods"
        f" on {count(scene.matrices, 'matrix')}"
    ),
    measure,
    Measured.restore,
    build,
)
