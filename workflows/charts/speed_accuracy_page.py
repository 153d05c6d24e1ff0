"""From the measured costs to the page: who is cheapest, by what factor, whether a tolerance means what it says."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import get_args

import numpy as np
import pandas as pd
from jinja2 import Environment

from stickslip.analysis import Report
from stickslip.analysis.report.figures import embedded
from stickslip.analysis.report.page import page_environment
from stickslip.workflows.charts import Kind
from stickslip.workflows.charts import figures as chart_figures
from stickslip.workflows.charts.peers import METHODS, Model
from stickslip.workflows.charts.speed_accuracy import Cost, Measured, Reference, SpeedScene, measure

#: Errors at which methods are compared: the first two in words, all in the table.
TARGETS = (1e-4, 1e-6, 1e-8)
#: What reading K costs a product at least, in products: two vectors share a pass over it, or it is in float32.
_LEAST = 0.5
_OURS = {method.name for method in METHODS if method.is_ours}
_SCIPY = {method.name for method in METHODS if method.is_scipy}


def products_at(errors: Sequence[float], products: Sequence[float], target: float) -> float | None:
    """Cost at which a method's error is reliably at most `target`.

    Points are in order of tolerance, from the coarsest. After the last point whose error is above the target the
    cost is read off the line to the next point, log against log; a point below the target by luck, with one above
    it at a finer tolerance, does not count. A later point that is cheaper still does.

    Parameters
    ----------
    errors, products : sequence of float, > 0
    target : float

    Returns
    -------
    float or None
        None if the method did not get there.
    """
    above = [k for k, error in enumerate(errors) if error > target]
    first = above[-1] + 1 if above else 0
    if first == len(errors):
        return None
    found = list(products[first:])
    if above:
        e, c = np.log(errors[first - 1 : first + 1]), np.log(products[first - 1 : first + 1])
        found.append(float(np.exp(c[0] + (c[1] - c[0]) * (np.log(target) - e[0]) / (e[1] - e[0]))))
    return min(found)


@dataclass(frozen=True)
class _Panel:
    """One problem: the sigmoid at one n and ratio, beside the exact law at that n."""

    n: int
    ratio: str
    curves: dict[str, list[Cost]]
    reference: Reference
    exact: Reference

    @property
    def title(self) -> str:
        return f"n = {self.n}, {'r = 1' if self.ratio == 'one' else 'r uniform in (0, 1]'}"

    def at(self, target: float, model: Model = "sigmoid") -> dict[str, float | None]:
        """Products at an error, by method of a law; None where it was not reached."""
        return {
            name: products_at(*_points(curve), target)
            for name, curve in self.curves.items()
            if curve[0].model == model
        }


def _points(curve: Iterable[Cost]) -> tuple[list[float], list[float]]:
    pairs = [(c.error, c.products) for c in curve if c.error is not None and c.products is not None]
    return [error for error, _ in pairs], [products for _, products in pairs]


def _panels(measured: Measured) -> list[_Panel]:
    exact = {reference.n: reference for reference in measured.references if reference.model == "coulomb"}
    found = []
    for reference in measured.references:
        if reference.ratio is None:
            continue
        curves: dict[str, list[Cost]] = {}
        for cost in measured.costs:
            if cost.n == reference.n and cost.ratio in (None, reference.ratio):
                curves.setdefault(cost.method, []).append(cost)
        found.append(_Panel(reference.n, reference.ratio, curves, reference, exact[reference.n]))
    return found


# ---------------------------------------------------------------------------------------------- words


def _count(products: float) -> str:
    return f"{float(f'{products:.2g}'):,.0f}"


def _power(error: float) -> str:
    return np.format_float_scientific(error, trim="-", exp_digits=1)


def _cheapest(panel: _Panel, target: float) -> str:
    """Who is cheapest at an error, by what factor over the next and over the best of SciPy."""
    costs = sorted((cost, name) for name, cost in panel.at(target).items() if cost is not None)
    if not costs:
        return f"No method reached an error of {_power(target)}."
    (best, name), rest = costs[0], costs[1:]
    words = f"At an error of {_power(target)} the cheapest is the {name} with {_count(best)} products"
    if not rest:
        return f"{words}; no other method got there."
    words += f", {rest[0][0] / best:.2g} times less than the next, {rest[0][1]} ({_count(rest[0][0])})"
    scipy = next(((cost, other) for cost, other in rest[1:] if other in _SCIPY), None)
    if scipy is not None and rest[0][1] not in _SCIPY and name not in _SCIPY:
        words += f", and {scipy[0] / best:.2g} times less than the best of SciPy, {scipy[1]} ({_count(scipy[0])})"
    behind = [(cost, other) for cost, other in costs if other in _OURS and other != name]
    if behind:
        words += f"; the {behind[0][1]} takes {_count(behind[0][0])}"
    return f"{words}."


def _exact(panel: _Panel) -> str:
    """What the exact law costs, by each of its methods."""
    words = []
    for name, cost in panel.at(TARGETS[1], "coulomb").items():
        if cost is not None:
            words.append(f"the {name} takes {_count(cost)} products for an error of {_power(TARGETS[1])}")
            continue
        errors, products = _points(panel.curves[name])
        if errors:
            best = int(np.argmin(errors))
            words.append(f"{name} comes to {errors[best]:.1e} in {_count(products[best])}")
    return f"The exact law: {'; '.join(words)}." if words else "The exact law could not be measured."


def _tolerance(panel: _Panel) -> str:
    """Whether a tolerance of the engines means what it says."""
    words = []
    for name in sorted(_OURS & set(panel.curves), reverse=True):
        ratios = [
            c.error / c.tolerance for c in panel.curves[name] if c.error is not None and c.tolerance is not None
        ]
        if ratios:
            words.append(f"the {name}'s error is {min(ratios):.2g} to {max(ratios):.2g} times the tolerance")
    return f"{'; '.join(words).capitalize()}." if words else "The engines could not be measured."


# ---------------------------------------------------------------------------------------------- the page


def build(scene: SpeedScene, measured: Measured) -> Report:
    """The chart, its statements and its tables: `costs`, `at_error`, `references`.

    Parameters
    ----------
    scene : SpeedScene
    measured : Measured
        What `stickslip.workflows.charts.speed_accuracy.measure` found for that scene.
    """
    panels = _panels(measured)
    answer = {
        panel.title: [_cheapest(panel, TARGETS[0]), _cheapest(panel, TARGETS[1]), _exact(panel), _tolerance(panel)]
        for panel in panels
    }
    at_error = [
        {"n": panel.n, "ratio": panel.ratio, "model": model, "method": name, "error": target, "products": products}
        for panel in panels
        for model in get_args(Model)
        for target in TARGETS
        for name, products in panel.at(target, model).items()
    ]
    html = _environment().get_template("speed_accuracy.html").render(
        scene=scene,
        answer=answer,
        src=embedded(chart_figures.speed_accuracy([_drawn(panel) for panel in panels])),
        at_error=[(panel.title, _by_method(panel)) for panel in panels],
        targets=TARGETS,
        costs=measured.costs,
        references=measured.references,
        absent=sorted({f"{c.method} ({c.reason})" for c in measured.costs if c.outcome == "absent"}),
        versions=measured.versions,
    )  # fmt: skip
    tables = {
        "costs": pd.DataFrame(map(asdict, measured.costs)),
        "at_error": pd.DataFrame(at_error),
        "references": pd.DataFrame(map(asdict, measured.references)).astype({"n_events": "Int64"}),
    }
    headline = [scene.title, *(f"{title}: {line}" for title, lines in answer.items() for line in lines)]
    return Report(html, tables, headline)


def _by_method(panel: _Panel) -> list[tuple[str, list[float | None]]]:
    """Products at each target, one row a method."""
    at = [panel.at(target, "coulomb") | panel.at(target) for target in TARGETS]
    return [(name, [column[name] for column in at]) for name in at[0]]


def _drawn(panel: _Panel) -> tuple[str, list[chart_figures.Curve], float | None, int | None]:
    curves: list[chart_figures.Curve] = []
    for name, curve in panel.curves.items():
        errors, products = _points(curve)
        if errors:
            done = [cost for cost in curve if cost.error is not None]
            least = [_LEAST * cost.computed for cost in done if cost.computed is not None and name in _OURS]
            is_bound = [cost.is_bound for cost in done]
            curves.append(chart_figures.Curve(name, name in _OURS, products, errors, is_bound, least))
    return panel.title, curves, panel.reference.floor, panel.exact.n_events


def _environment() -> Environment:
    environment = page_environment("stickslip.workflows.charts")
    environment.filters["count"] = _count
    environment.filters["power"] = _power
    return environment


KIND = Kind(
    SpeedScene,
    lambda scene: f"{len(METHODS)} methods on {len(scene.n) * (1 + len(scene.ratios))} problems",
    measure,
    Measured.restore,
    build,
)
