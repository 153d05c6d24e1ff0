"""Methods compared: each setting of the same systems with the finest, by statistics and by whole laws."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip.analysis.answer import Row, named
from stickslip.analysis.catalogues import MARGIN, Catalogues
from stickslip.analysis.contrast import Statistic, contrast, judge
from stickslip.analysis.ensemble import Study
from stickslip.analysis.models.episodes import QUANTITIES, RATE, Catalogue
from stickslip.analysis.models.laws import Difference, difference_of_order, distance_of_shares, largest_gap
from stickslip.analysis.stats.compare import AGREE, DIFFER, UNKNOWN
from stickslip.analysis.stats.estimates import Estimate, Undefined
from stickslip.pipeline.design.labels import Label, Part
from stickslip.pipeline.design.values import text
from stickslip.sim.engines import ENGINES
from stickslip.sim.engines.contract import Engine, Number

#: From which on a number is not shown as a power of ten.
_SMALL = 0.01
#: Margins of laws: three episodes in a hundred for a distribution function, a quarter of the shares of first blocks,
#: 0.1 for a correlation. Twenty systems of a thousand episodes each can exclude differences as large.
GAP, DISTANCE, CORRELATION = 0.03, 0.25, 0.1


@dataclass(frozen=True)
class Compared:
    """A law by which methods are compared.

    Attributes
    ----------
    of : callable
        From the catalogue of a run and the number of blocks to values.
    difference : callable
        Of the values of pairs of runs, one of `models.laws`.
    margin : float
    join : callable
        Joins the values of the runs of one system.
    """

    of: Callable[[Catalogue, int], np.ndarray]
    difference: Callable[[list[tuple[np.ndarray, np.ndarray]], float, float, np.random.Generator], Difference]
    margin: float
    join: Callable[[list[np.ndarray]], np.ndarray] = np.concatenate


LAWS: Mapping[str, Compared] = {
    "magnitudes": Compared(lambda run, _: run.magnitude, largest_gap, GAP),
    "sizes": Compared(lambda run, _: run.size, largest_gap, GAP),
    "quiet times": Compared(lambda run, _: run.quiet, largest_gap, GAP),
    "first blocks": Compared(Catalogue.first_blocks, distance_of_shares, DISTANCE, lambda runs: np.sum(runs, axis=0)),
    "order in time": Compared(lambda run, _: run.sizes_and_quiets, difference_of_order, CORRELATION),
}


def names(found: Sequence[Catalogues]) -> list[str]:
    """Names of groups by what distinguishes them: method, place in a sweep and number of blocks."""
    of_one_size = len({one.group.key["n"] for one in found}) == 1
    engines = {ENGINES[one.group.key["engine"]] for one in found}
    shared = {("", engine.title) for engine in engines if engine.is_exact and len(engines) == 1}
    return [_method(one.group.name, ENGINES[one.group.key["engine"]], of_one_size, shared) for one in found]


def _method(label: Label, engine: type[Engine], of_one_size: bool, shared: Collection[Part]) -> str:
    """Name of a method from the label of its group, without what all groups share."""
    numbers = {name: one.symbol for name, one in engine.settings().items() if isinstance(one, Number) and one.symbol}
    words: list[str] = []
    for name, value in label.parts:
        if (name, value) in shared or (name == "n" and of_one_size):
            continue
        said = numbers.get(name, name)
        if name in numbers and words and words[-1] == engine.title:  # one word for both
            said = f"{engine.method} {said}"
            words.pop()
        shown = _power(float(value)) if numbers.get(name) == "\u03b5" else value
        words.append(f"{said} = {shown}".replace("e-0", "e-").replace(" = ", "\u00a0=\u00a0") if name else value)
    return ", ".join(words) or engine.title


def _power(number: float) -> str:
    """A number, below a hundredth as a power of ten, such as 2.5e-4."""
    if number >= _SMALL:
        return text(number)
    exponent = math.floor(math.log10(number))
    return f"{number / 10.0**exponent:g}e{exponent}"


def against_reference(by_system: Sequence[Sequence[Catalogues]], level: float) -> list[list[Row]]:
    """Contrasts of each setting with the first of the same systems, judged together; a list a setting."""
    statistics = [Statistic(name, quantity.of, MARGIN) for name, quantity in QUANTITIES.items()]
    made = []
    for reference, *others in by_system:
        if not reference.is_judged:
            continue
        some = [
            [
                {"setting": other.label, "reference": reference.label}
                | contrast(statistic, reference.sample, other.sample, True, level).row()
                | {"is_share": False}
                for statistic in statistics
            ]
            for other in others
        ]
        judge([row for rows in some for row in rows], 1 - level)
        made += some
    return made


def by_laws(study: Study, by_system: Sequence[Sequence[Catalogues]]) -> list[Row]:
    """Every law of each setting beside that of the first of the same systems, judged together, setting by setting."""
    made: list[Row] = []
    for reference, *others in by_system:
        rows = [
            {"setting": other.label, "reference": reference.label, "law": name}
            | _apart(study, reference, other, name, law)
            for other in others if reference.is_judged
            for name, law in LAWS.items()
        ]  # fmt: skip
        judge(rows, 1 - study.settings.confidence)
        made += rows
    return made


def _apart(study: Study, first: Catalogues, second: Catalogues, name: str, law: Compared) -> Row:
    """How far a law of two groups lies apart on the systems that both ran, not judged yet."""
    n, both = int(first.group.key["n"]), sorted(first.runs.keys() & second.runs.keys())
    pairs = [
        (
            law.join([law.of(run, n) for run in first.runs[unit]]),
            law.join([law.of(run, n) for run in second.runs[unit]]),
        )
        for unit in both
    ]
    row: Row = {"margin": law.margin, "verdict": UNKNOWN, "reason": None}
    row |= dict.fromkeys(("at", "below", "p_equivalent", "p_different", "p_floor"))
    try:
        found = law.difference(
            pairs, law.margin, study.settings.confidence, study.generator(f"{name} {second.label}")
        )
    except Undefined as why:
        return row | named("size", Estimate()) | {"reason": str(why)}
    return row | named("size", found.size) | {
        "at": found.at, "below": found.below, "relative": found.size.value, "p_equivalent": found.p_equivalent,
        "p_different": found.p_different, "p_floor": found.p_floor,
    }  # fmt: skip


def comparison(
    contrasts: Sequence[Sequence[Row]], compared: Sequence[Row], methods: Mapping[str, str]
) -> dict[str, Any]:
    """Facts of the comparison of methods, for the page.

    Parameters
    ----------
    contrasts : sequence of sequence of Row
        Those of `against_reference`.
    compared : sequence of Row
        Those of `by_laws`.
    methods : mapping of str to str
        Names of the groups' methods, by label.
    """
    settings = [_setting(rows, compared, methods) for rows in contrasts]
    return {
        "settings": settings, "has_pairs": bool(settings), "n_settings": len(settings),
        "agree": [one for one in settings if one["verdict"] == AGREE], "differ": _differing(settings),
        "untold": [one for one in settings if one["verdict"] == UNKNOWN and one["rows"]],
        "farthest": max((one for one in settings if one["rate"]["verdict"] == DIFFER), key=_rate_off, default=None),
        "n_tests": sum(row["p_equivalent"] is not None for row in compared),
        "references": {rows[0]["reference"] for rows in contrasts},
        "margins": {name: law.margin for name, law in LAWS.items()},
    }  # fmt: skip


def _setting(contrasts: Sequence[Row], compared: Sequence[Row], methods: Mapping[str, str]) -> Row:
    """One setting: the contrasts of its laws and of its rate, and the verdict on all laws that could be compared.

    It has no rows if no law could be compared.
    """
    label = contrasts[0]["setting"]
    rows = [row | {"method": methods[label]} for row in compared if row["setting"] == label]
    known = [row for row in rows if row["p_equivalent"] is not None]
    by = {verdict: [row["law"] for row in known if row["verdict"] == verdict] for verdict in (AGREE, DIFFER, UNKNOWN)}
    return {
        "setting": label, "method": methods[label], "rows": rows if known else [], "n_known": len(known),
        "agree": by[AGREE], "differ": by[DIFFER], "open": by[UNKNOWN],
        "verdict": DIFFER if by[DIFFER] else AGREE if known and len(by[AGREE]) == len(known) else UNKNOWN,
        "rate": next(row for row in contrasts if row["quantity"] == RATE),
    }  # fmt: skip


def _differing(settings: Sequence[Row]) -> list[Row]:
    """Methods that differ, grouped by the laws in which they do; no laws are named where it is in all compared."""
    found: dict[tuple[str, ...], list[Row]] = {}
    for one in settings:
        if one["differ"]:
            every = len(one["differ"]) == one["n_known"]
            found.setdefault(() if every else tuple(one["differ"]), []).append(one)
    return [
        {
            "laws": laws, "methods": [one["method"] for one in some],
            "is_all": all(one["n_known"] == len(one["rows"]) for one in some),
            "alone": next((row for row in some[0]["rows"] if row["law"] in laws), None) if len(some) == len(laws) == 1
            else None,
        }
        for laws, some in found.items()
    ]  # fmt: skip


def _rate_off(one: Row) -> float:
    """How far the rate is off; a setting without any episode comes last, as an alert says so."""
    off = one["rate"]["relative"]
    return -1.0 if off is None or off <= -1 else abs(float(off))
