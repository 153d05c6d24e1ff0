"""Whether two datasets are the same: their statistics side by side, or one sentence if their runs are equal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from stickslip.analysis.answer import B, I, Row, S, frame
from stickslip.analysis.contrast import (
    SCHEMA,
    contrast,
    judge,
    sample,
    shares,
    statistics,
    told,
)
from stickslip.analysis.ensemble import Data, Study
from stickslip.analysis.groups import Group
from stickslip.analysis.measures import KEYS, Measure, measures
from stickslip.analysis.members import ENGINE_KEYS, START, SYSTEM_KEYS
from stickslip.analysis.questions.runs.engines import contrasts, summary
from stickslip.analysis.report.formats import environment
from stickslip.analysis.report.page import Report, draw, plain
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.stats.compare import AGREE, DIFFER, UNKNOWN
from stickslip.pipeline.design.labels import apart

#: Keys that two settings must share: with another n or coupling, a statistic is not the same quantity.
SHARED = ("n", "coupling")
#: Columns that say what a member is, in addition to the numbers of draws that its name has.
_IDENTITY = (*SYSTEM_KEYS, *ENGINE_KEYS, "seed", "z_start", "w_start", "twin_size", "perturbation_reading")
SAME = "same"
_TABLE: Mapping[str, str] = {"setting": S, "other": S, "is_paired": B, **SCHEMA}
_UNMATCHED = {"dataset": S, "setting": S, "members": I}
_ALONE = {"dataset": S, "setting": S, "member_id": S}


@dataclass(frozen=True)
class Ensemble:
    """A dataset to compare.

    Attributes
    ----------
    name : str
        Its name on the page.
    data : Data
        Members need the column `seed`.
    t_burn : float
    margins : mapping of str to float
        The margins that its scene declares.
    provenance : mapping of str to str
    digest : str
        Digest of all its data; equal digests mean equal data.
    """

    name: str
    data: Data
    t_burn: float
    margins: Mapping[str, float]
    provenance: Mapping[str, str]
    digest: str = ""


@dataclass(frozen=True)
class Match:
    """Two settings to compare; `differs` maps each key in which they differ to both values."""

    first: Group
    second: Group
    differs: dict[str, tuple[Any, Any]]
    is_paired: bool

    def alone(self, k: int) -> tuple[Group, list[str]]:
        """One of the two, by its number, and its members without a partner, if partners are what is compared."""
        mine, theirs = (self.first, self.second)[:: 1 - 2 * k]
        lacks = ~mine.column("unit").isin(theirs.column("unit")) & self.is_paired
        return mine, mine.column("member_id")[lacks].tolist()


def compare(first: Ensemble, second: Ensemble, settings: AnalysisSettings) -> Report:
    """Report that compares two ensembles, under the settings of the first.

    Raises
    ------
    ValueError
        If they have no settings to compare, or an ensemble contradicts itself or the settings.
    """
    facts: dict[str, Any] = {
        "first": first, "second": second, "settings": settings, "n_runs": len(first.data.table), "verdict": SAME,
        "matches": [], "tested": [], "from_zero": [], "unmatched": [],
    }  # fmt: skip
    if _is_same(first, second):
        return _report(facts, {})
    one, other = (_study(each, settings, first.name) for each in (first, second))
    matches, *left = matched(first.name, one.groups, second.name, other.groups)
    measured = _both(one, other)
    asked = [*(mine.statistic for mine, _ in measured), *statistics(one.margins), *shares()]
    found: list[tuple[Match, list[Row]]] = []
    for match in matches:
        pair = sample(match.first), sample(match.second)
        for held, group, some in zip(pair, (match.first, match.second), zip(*measured, strict=True), strict=False):
            held.sums.update({measure.name: measure.of(group).sums for measure in some})
        found.append((match, [contrast(each, *pair, match.is_paired, settings.confidence) for each in asked]))
    where = apart([match.first.name for match in matches])
    rows = [
        row | {"setting": match.first.label, "other": match.second.label, "is_paired": match.is_paired, "at": at}
        for (match, some), at in zip(found, where, strict=True)
        for row in some
    ]
    names = {mine.name for mine, _ in measured}
    from_zero = [row for row in rows if row["quantity"] in names and row["relative"] is None and row["difference"]]
    for row in from_zero:
        row |= {"p_equivalent": 1.0, "p_different": row["p_absolute"]}
    judge(rows, 1 - settings.confidence)
    shown = told(rows)
    verdicts = {row["verdict"] for row in (*shown, *from_zero)} or {UNKNOWN}
    unmatched = [
        {"dataset": which.name, "setting": group.label, "members": len(group)}
        for which, some in zip((first, second), left, strict=True)
        for group in some
    ]
    alone = [
        {"dataset": which.name, "setting": group.label, "member_id": name}
        for k, (which, some) in enumerate(zip((first, second), left, strict=True))
        for group, names in [
            *(match.alone(k) for match in matches),
            *((one, one.column("member_id").tolist()) for one in some),
        ]
        for name in names
    ]
    facts |= {
        "verdict": next(one for one in (DIFFER, UNKNOWN, AGREE) if one in verdicts),
        "all": summary(shown) if shown else None,
        "matches": [
            {"first": match.first.label, "second": match.second.label, "differs": match.differs,
             "is_paired": match.is_paired, "rows": [row for row in shown if row["setting"] == match.first.label]}
            for match in matches
        ],
        "from_zero": from_zero,
        "has_other_systems": any(match.is_paired and match.differs.keys() & {*SYSTEM_KEYS} for match in matches),
        "n_paired": sum(match.is_paired for match in matches),
        "unmatched": unmatched,
        "alone": [[row["member_id"] for row in alone if row["dataset"] == one.name] for one in (first, second)],
        "other_margins": sorted(
            name for name, margin in second.margins.items() if settings.margins.get(name, margin) != margin
        ),
    }  # fmt: skip
    facts["unit"] = one.unit
    return _report(facts, {
        "compared": frame(_TABLE, rows), "unmatched": frame(_UNMATCHED, unmatched), "alone": frame(_ALONE, alone),
    })  # fmt: skip


def _both(one: Study, other: Study) -> list[tuple[Measure, Measure]]:
    """What two studies both measure, beyond n_stick, of which more is compared."""
    theirs = {measure.name: measure for measure in measures(other, one)}
    return [(mine, theirs[mine.name]) for mine in measures(one, other) if mine.name in {*theirs} - {*KEYS}]


def _report(facts: Mapping[str, Any], tables: dict[str, Any]) -> Report:
    filled = environment()
    drawn = {}
    some = next((match["rows"] for match in facts["matches"] if match["rows"]), None)
    if some:
        drawn["contrasts"] = draw(partial(contrasts, some), with_pdf=True)
    page = filled.get_template("compare.html").render(**facts, figures=drawn)
    said = plain(filled.get_template("contrasts.html").module.compared(facts))  # type: ignore[attr-defined]
    return Report(page, tables, [said], drawn)


def _is_same(first: Ensemble, second: Ensemble) -> bool:
    """Whether both hold the same runs, by the digests of their data or else by every change of n_stick.

    What a member is must be the same too, as runs that stick throughout have no changes, and so must what records of
    one name keep.
    """
    if first.digest and first.digest == second.digest:
        return True
    one, two = (each.data.members.set_index("member_id") for each in (first, second))
    mine, theirs = first.data.recorded, second.data.recorded
    if any(mine[name].values != theirs[name].values for name in mine.keys() & theirs.keys()):
        return False
    if set(one.index) != set(two.index):
        return False
    for name in (*_IDENTITY, "outcome"):
        a, b = one[name].astype(object), two[name].reindex(one.index).astype(object)
        if not ((a == b) | (a.isna() & b.isna())).all():
            return False
    return all(
        all(np.array_equal(a, b) for a, b in zip(points, second.data.series[name], strict=True))
        for name, points in first.data.series.items()
    )


def _study(one: Ensemble, settings: AnalysisSettings, whose: str) -> Study:
    try:
        return Study(one.data, settings)
    except ValueError as error:
        raise ValueError(f"{one.name}, under the settings of {whose}: {error}") from None


def matched(
    first: str, mine: Sequence[Group], second: str, theirs: Sequence[Group]
) -> tuple[list[Match], list[Group], list[Group]]:
    """Pairs of settings of two datasets, each matched with the one that differs in the fewest keys.

    They must share `SHARED`. Units are paired if both datasets drew the same ones: the same `seed`, coupling, n and
    matrix give the same random system up to the scales kappa and rho, and starts are the same for the same system.

    Parameters
    ----------
    first, second : str
        Names of the datasets.
    mine, theirs : sequence of Group
        Groups of unchanged members.

    Returns
    -------
    matches, left_first, left_second
        The last two are the settings without a counterpart.

    Raises
    ------
    ValueError
        If no setting of one can be compared with one of the other.
    """
    keys = (*SYSTEM_KEYS, *ENGINE_KEYS)
    near = sorted(
        (sum(a.key[name] != b.key[name] for name in keys), i, j)
        for i, a in enumerate(mine)
        for j, b in enumerate(theirs)
        if all(a.key[name] == b.key[name] for name in SHARED)
    )
    if not near:
        has = ["; ".join(dict.fromkeys(_shared(group) for group in some)) for some in (mine, theirs)]
        raise ValueError(
            f"{first} and {second}: expected settings that share {' and '.join(SHARED)}, got {has[0]} in "
            f"{first} and {has[1]} in {second}; run a scene with the same n and coupling to compare them"
        )
    found: dict[int, int] = {}
    for _, i, j in near:
        if i not in found and j not in found.values():
            found[i] = j
    matches = []
    for i, j in sorted(found.items(), key=lambda pair: -mine[pair[0]].key["n"]):
        a, b = mine[i], theirs[j]
        differs = {name: (a.key[name], b.key[name]) for name in keys if a.key[name] != b.key[name]}
        matches.append(Match(a, b, differs, _draws(a) == _draws(b)))
    return (
        matches,
        [group for i, group in enumerate(mine) if i not in found],
        [group for j, group in enumerate(theirs) if j not in found.values()],
    )


def _shared(group: Group) -> str:
    return ", ".join(f"{name} = {group.key[name]}" for name in SHARED)


def _draws(group: Group) -> tuple[object, ...]:
    """What identifies the draws of a group's units: the seed and the kind of unit; for starts, the system too."""
    of = set(group.column("matrix")) if group.unit == START else None
    return {group.table.settings[k]["seed"] for k in group.column("setting").unique()}, group.unit, of
