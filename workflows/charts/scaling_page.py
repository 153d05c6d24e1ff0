"""From measured costs to the page: exponents of growth, and whether they are those of the claim."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import pandas as pd
from jinja2 import Environment
from matplotlib.figure import Figure
from scipy.stats import linregress, t

from stickslip.analysis import Report
from stickslip.analysis.report.figures import embedded
from stickslip.analysis.report.page import page_environment
from stickslip.workflows.charts import Kind
from stickslip.workflows.charts import figures as chart_figures
from stickslip.workflows.charts.scaling import Cost, Lockstep, Measured, ScalingScene, Throughput, measure

#: The level of the intervals.
CONFIDENCE = 0.95

#: What a row has of a quantity; None where it has none.
Quantity = Callable[[Cost], float | None]


@dataclass(frozen=True)
class Growth:
    """value ~ n^exponent, fitted by least squares of log value on log n: a row of the table `growth`.

    `low` and `high` are the interval at `CONFIDENCE` (Student's t), `last` the exponent between the two largest n
    alone. Null, with a reason, where there are too few n. `claim` is the exponent expected; null where there is none.
    """

    system: str
    engine: str
    quantity: str
    claim: float | None
    n_points: int
    n_min: int | None = None
    n_max: int | None = None
    exponent: float | None = None
    standard_error: float | None = None
    low: float | None = None
    high: float | None = None
    last: float | None = None
    reason: str | None = None


def growth(
    n: Sequence[int], values: Sequence[float], system: str, engine: str, quantity: str, claim: float | None = None
) -> Growth:
    """Fit an exponent to values > 0 at distinct, ascending n."""
    found = Growth(system, engine, quantity, claim, len(n))
    if len(n) < 3:
        return replace(found, reason=f"an exponent with an error takes three n, got {len(n)}")
    x, y = np.log(n), np.log(values)
    line = linregress(x, y)
    half = float(t.ppf(0.5 * (1 + CONFIDENCE), len(n) - 2) * line.stderr)
    exponent = float(line.slope)
    return replace(
        found,
        n_min=n[0],
        n_max=n[-1],
        exponent=exponent,
        standard_error=float(line.stderr),
        low=exponent - half,
        high=exponent + half,
        last=float((y[-1] - y[-2]) / (x[-1] - x[-2])),
    )


# ---------------------------------------------------------------------------------------------- quantities


def _over(part: float | None, whole: float | None) -> float | None:
    return part / whole if part is not None and whole else None


def _per_event(row: Cost) -> float | None:
    return _over(row.seconds, row.n_events)


def _per_time(row: Cost) -> float | None:
    return _over(row.seconds, row.t)


def _per_step(row: Cost) -> float | None:
    return _over(row.seconds, row.n_steps)


def _event_rate(row: Cost) -> float | None:
    return _over(row.n_events, row.t)


def _product_rate(row: Cost) -> float | None:
    return _over(row.n_products, row.t)


def _step_rate(row: Cost) -> float | None:
    return _over(row.n_steps, row.t)


def _product(row: Cost) -> float | None:
    return row.product_seconds


#: quantity -> how a row has it
QUANTITIES: dict[str, Quantity] = {
    "seconds per event": _per_event,
    "seconds per unit of time": _per_time,
    "seconds per step": _per_step,
    "seconds per product": _product,
    "products per event": lambda row: _over(row.products, row.n_events),
    "products per unit of time": lambda row: _over(row.products, row.t),
    "events per unit of time": _event_rate,
    "products with K per event": lambda row: _over(row.n_products, row.n_events),
    "products with K per unit of time": _product_rate,
}

#: (system, engine) -> quantity -> the exponent claimed: an event costs O(n), a unit of time O(n^2), beside events
#: and, as their rate is O(n), with them; a product O(n^2). None: fitted, nothing claimed.
FITTED: dict[tuple[str, str], dict[str, float | None]] = {
    ("random", "coulomb"): {
        "seconds per event": 1.0,
        "seconds per unit of time": 2.0,
        "seconds per product": 2.0,
        "products per event": -1.0,
        "products per unit of time": 0.0,
        "events per unit of time": None,
        "products with K per unit of time": None,
    },
    ("chain", "coulomb"): {
        "seconds per event": 1.0,
        "seconds per unit of time": 2.0,
        "events per unit of time": None,
        "products with K per unit of time": None,
    },
    ("random", "sigmoid"): {"seconds per step": 2.0, "seconds per unit of time": None},
}


def is_fitted(row: Cost) -> bool:
    """Whether a row counts for the exponents: measured, and no system in it came to rest."""
    return row.outcome == "measured" and row.n_rest == 0


def _rows(measured: Measured, system: str, engine: str) -> list[Cost]:
    return [row for row in measured.costs if (row.system, row.engine) == (system, engine)]


def _fit(measured: Measured, system: str, engine: str, quantity: str, claim: float | None) -> Growth:
    values = [(row.n, QUANTITIES[quantity](row)) for row in _rows(measured, system, engine) if is_fitted(row)]
    known = sorted((n, value) for n, value in values if value)
    return growth([n for n, _ in known], [value for _, value in known], system, engine, quantity, claim)


# ---------------------------------------------------------------------------------------------- words


def _seconds(value: float) -> str:
    for unit, name in ((1.0, "s"), (1e-3, "ms")):
        if value >= unit:
            return f"{value / unit:.3g} {name}"
    return f"{value / 1e-6:.3g} µs"


def _count(value: float) -> str:
    return f"{float(f'{value:.3g}'):,.0f}" if value >= 100 else f"{value:.2g}"


def exponent_words(fit: Growth) -> str:
    """An exponent with its error, and whether its interval holds the one claimed."""
    if fit.exponent is None or fit.low is None or fit.high is None:
        return f"a power of n that is not known ({fit.reason})"
    words = f"n^{fit.exponent:.2f} ± {fit.standard_error:.2f} ({fit.last:.2f} between the two largest n)"
    if fit.claim is None:
        return words
    within = f"{words}; {CONFIDENCE:.0%} interval {fit.low:.2f} to {fit.high:.2f}"
    if fit.low <= fit.claim <= fit.high:
        return f"{within}: n^{fit.claim:g} is not excluded"
    return f"{within}: {'above' if fit.exponent > fit.claim else 'below'} n^{fit.claim:g}"


def _over_which(fit: Growth) -> list[str]:
    """Over which n the exponents are fitted."""
    if fit.n_min is None or fit.n_max is None:
        return []
    return [f"Exponents ± standard errors are fitted over {fit.n_points} n from {fit.n_min:,} to {fit.n_max:,}."]


def _range(rows: Sequence[Cost], quantity: Quantity, show: Callable[[float], str]) -> str:
    """A quantity at the smallest and at the largest n."""
    known = [(row.n, value) for row in rows if (value := quantity(row)) is not None]
    return " and ".join(f"{show(value)} at n = {n:,}" for n, value in dict.fromkeys((known[0], known[-1])))


def _exact_words(rows: Sequence[Cost], fits: dict[str, Growth], entries: str) -> list[str]:
    kept = [row for row in rows if is_fitted(row)]
    if not kept:
        return []
    of = {quantity: exponent_words(fit) for quantity, fit in fits.items()}
    return [
        f"An event costs {_range(kept, _per_event, _seconds)}. It goes as {of['seconds per event']}.",
        f"A unit of time costs {_range(kept, _per_time, _seconds)}. It goes as {of['seconds per unit of time']}.",
        f"A unit of time holds {_range(kept, _event_rate, _count)} events, going as {of['events per unit of time']}, "
        f"and takes {_range(kept, _product_rate, _count)} products with K, each of {entries}, going as "
        f"{of['products with K per unit of time']}.",
    ]


def _random_words(rows: Sequence[Cost], fits: dict[str, Growth]) -> list[str]:
    lines = _exact_words(rows, fits, "n^2 entries")
    kept = [row for row in rows if is_fitted(row)]
    if kept:
        of = {quantity: exponent_words(fit) for quantity, fit in fits.items()}
        lines += [
            f"One product of numpy takes {_range(kept, _product, _seconds)}, going as {of['seconds per product']}.",
            f"In products of that n an event goes as {of['products per event']}; a unit of time as "
            f"{of['products per unit of time']}.",
        ]
    return lines + _over_which(fits["seconds per event"]) + _left_out(rows)


def _chain_words(rows: Sequence[Cost], fits: dict[str, Growth]) -> list[str]:
    lines = _exact_words(rows, fits, "the entries that are kept")
    known = [(row.n, row.n_entries) for row in rows if row.n_entries is not None]
    if known:
        n, entries = known[-1]
        lines.append(
            f"K of {n:,} blocks keeps {entries:,} entries, {entries / n:.2f} a block; dense it has {n**2:,}."
        )
    return lines + _over_which(fits["seconds per event"]) + _left_out(rows)


def _left_out(rows: Sequence[Cost]) -> list[str]:
    """Which n do not count for the exponents, and why."""
    lines = []
    rest = [row for row in rows if row.outcome == "measured" and row.n_rest]
    if rest:
        which = ", ".join(f"n = {row.n:,} ({row.n_rest} of {row.n_matrices})" for row in rest)
        lines.append(f"Left out of the exponents, as systems came to rest: {which}.")
    lines += [f"n = {row.n:,} was not measured: {row.reason}." for row in rows if row.outcome != "measured"]
    diverged = [row for row in rows if row.outcome == "measured" and row.n_diverged]
    lines += [f"n = {row.n:,}: {row.n_diverged} diverged; measured before." for row in diverged]
    return lines


def _sigmoid_words(rows: Sequence[Cost], fits: dict[str, Growth]) -> list[str]:
    kept = [row for row in rows if is_fitted(row)]
    lines = []
    if kept:
        of = {quantity: exponent_words(fit) for quantity, fit in fits.items()}
        lines = [
            f"A step costs {_range(kept, _per_step, _seconds)}. It goes as {of['seconds per step']}.",
            f"A unit of time takes {_range(kept, _step_rate, _count)} steps and costs "
            f"{_range(kept, _per_time, _seconds)}. It goes as {of['seconds per unit of time']}.",
        ]
    return lines + _over_which(fits["seconds per step"]) + _left_out(rows)


def a_minute(n_members: int, seconds: float) -> float:
    return 60.0 * n_members / seconds


def _at(row: Throughput) -> str:
    return "at the tolerances picked for statistics" if row.tolerance == "picked" else f"at {row.tolerance}"


def _throughput_words(row: Throughput) -> str:
    words = (
        f"The {row.engine} engine {_at(row)} runs {_count(a_minute(row.n_members, row.seconds))} members a minute "
        f"on {row.n_workers} worker{'s' if row.n_workers > 1 else ''} that are there, "
        f"{_count(a_minute(row.n_members, row.seconds_with_start))} when they have to be started"
    )
    if row.seconds_with_start <= row.seconds:
        words += " (each measured once: the start is lost in the scatter)"
    return f"{words}; n = {row.n:,}, t_end = {row.t_end:g}, {row.n_members} members, {row.n_failed} failed."


def lockstep_words(rows: Sequence[Lockstep], smooth: Cost) -> str:
    """What runs that share K could gain at most: of the products of a run, what sharing a product saves."""
    best = min(rows, key=lambda row: row.share)
    if smooth.n_products is None or smooth.product_seconds is None or smooth.seconds is None:
        return f"What lockstep could gain is not known: the sigmoid run of n = {smooth.n:,} failed ({smooth.reason})."
    share = min(1.0, smooth.n_products * smooth.product_seconds / smooth.seconds)
    saved = share * (1.0 - min(1.0, best.share))
    return (
        f"A product shared by {best.n_vectors} vectors costs each {best.share:.2g} of one alone (n = {best.n:,}), "
        f"and products at that price are {share:.0%} of a sigmoid run, so lockstep could save at most {saved:.0%} of "
        f"it, a factor of {1.0 / (1.0 - saved):.2g}."
    )


# ---------------------------------------------------------------------------------------------- the page

_TITLES = {
    ("random", "coulomb"): "Random systems, exact engine",
    ("chain", "coulomb"): "Chains, exact engine",
    ("random", "sigmoid"): "Random systems, sigmoid engine",
}
_WORDS = {
    ("random", "coulomb"): _random_words,
    ("chain", "coulomb"): _chain_words,
    ("random", "sigmoid"): _sigmoid_words,
}


def build(scene: ScalingScene, measured: Measured) -> Report:
    """The chart, its statements and its tables: `costs`, `growth`, `throughput`, `lockstep`.

    Parameters
    ----------
    scene : ScalingScene
    measured : Measured
        What `stickslip.workflows.charts.scaling.measure` found for that scene.
    """
    fits = {
        which: {quantity: _fit(measured, *which, quantity, claim) for quantity, claim in quantities.items()}
        for which, quantities in FITTED.items()
    }
    answer = {_TITLES[which]: _WORDS[which](_rows(measured, *which), fits[which]) for which in FITTED}
    answer["Ensemble"] = [
        *map(_throughput_words, measured.throughput),
        lockstep_words(measured.lockstep, measured.smooth),
    ]
    all_fits = [fit for quantities in fits.values() for fit in quantities.values()]
    costs = measured.costs if measured.smooth in measured.costs else [*measured.costs, measured.smooth]
    html = _environment().get_template("scaling.html").render(
        scene=scene,
        answer=answer,
        src=embedded(_figure(measured, fits)),
        growth=all_fits,
        costs=[(row, {name: value(row) for name, value in QUANTITIES.items()}) for row in costs],
        throughput=[
            (row, a_minute(row.n_members, row.seconds), a_minute(row.n_members, row.seconds_with_start))
            for row in measured.throughput
        ],
        lockstep=measured.lockstep,
        versions=measured.versions,
    )  # fmt: skip
    tables = {
        "costs": _costs_table(costs),
        "growth": pd.DataFrame(map(asdict, all_fits)).astype({"n_min": "Int64", "n_max": "Int64"}),
        "throughput": pd.DataFrame(map(asdict, measured.throughput)),
        "lockstep": pd.DataFrame(map(asdict, measured.lockstep)),
    }
    headline = [scene.title, *(f"{title}: {line}" for title, lines in answer.items() for line in lines)]
    return Report(html, tables, headline)


def _costs_table(costs: Sequence[Cost]) -> pd.DataFrame:
    counts = dict.fromkeys(("n_entries", "n_events", "n_steps", "n_products"), "Int64")
    return pd.DataFrame(map(asdict, costs)).astype(counts)


def _figure(measured: Measured, fits: dict[tuple[str, str], dict[str, Growth]]) -> Figure:
    names = {
        ("random", "coulomb"): "random systems, exact",
        ("random", "sigmoid"): "random systems, sigmoid",
        ("chain", "coulomb"): "chains, exact",
    }
    panels = []
    for label, quantity, unit, slope in (
        ("time per event (µs)", "seconds per event", 1e-6, 1.0),
        ("time per unit of time (ms)", "seconds per unit of time", 1e-3, 2.0),
    ):
        curves = [
            (name, _points(_rows(measured, *which), QUANTITIES[quantity], unit), fits[which][quantity].exponent)
            for which, name in names.items()
            if quantity in fits[which]
        ]
        panels.append((label, curves, slope))
    return chart_figures.scaling(panels, [(row.n_vectors, row.share) for row in measured.lockstep])


def _points(rows: Sequence[Cost], quantity: Quantity, unit: float) -> chart_figures.Points:
    """Value, least and most in that unit."""
    points = []
    for row in rows:
        value = quantity(row)
        if value and row.seconds and row.seconds_min and row.seconds_max:
            each = value / row.seconds / unit
            least, most = each * row.seconds_min, each * row.seconds_max
            points.append((row.n, each * row.seconds, least, most, is_fitted(row)))
    return points


def _environment() -> Environment:
    environment = page_environment("stickslip.workflows.charts")
    environment.filters["count"] = _count
    environment.filters["time"] = _seconds
    return environment


def _extent(scene: ScalingScene) -> str:
    return (
        f"{len(scene.n)} random systems and {len(scene.chain_n)} chains with the exact engine, "
        f"{len(scene.sigmoid_n)} with the sigmoid engine, and an ensemble of {scene.members} members of each on "
        f"{scene.workers} workers"
    )


KIND = Kind(ScalingScene, _extent, measure, Measured.restore, build)
