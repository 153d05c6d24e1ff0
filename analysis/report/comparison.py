"""Are two ensembles the same? Their statistics side by side, setting by setting, with three verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from stickslip.analysis.groups import ENGINE_KEYS, SYSTEM_KEYS, Group, check, groups
from stickslip.analysis.pairs import unchanged
from stickslip.analysis.questions.contrast import (
    COMPARED,
    SHARE_MARGIN,
    SHARES_ADJUSTED,
    contrast,
    in_words,
    judged,
    sample,
    size_in_words,
    statistics,
)
from stickslip.analysis.report import change_figures, words
from stickslip.analysis.report.figures import embedded
from stickslip.analysis.report.page import Report, page_environment
from stickslip.analysis.report.section import Data
from stickslip.analysis.report.tables import F, I, S, records, typed
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.stats.compare import DIFFERENT, EQUIVALENT, OPEN

#: What two settings must share: statistics of groups of another size or ensemble are not the same quantity.
SHARED = ("n", "coupling")
_SCHEMA = {
    "setting": S, "differs_in": S, "is_paired": "boolean", "quantity": S, "n_first": I, "n_second": I,
    "first": F, "first_low": F, "first_high": F, "second": F, "second_low": F, "second_high": F, "difference": F,
    "difference_low": F, "difference_high": F, "relative": F, "relative_low": F, "relative_high": F, "margin": F,
    "p_equivalent": F, "p_different": F, "p_equivalent_holm": F, "p_different_holm": F, "verdict": S, "statement": S,
}  # fmt: skip
_UNMATCHED = {"dataset": S, "setting": S, "members": I}


@dataclass(frozen=True)
class Ensemble:
    """A dataset to compare: `name` is how the page calls it."""

    name: str
    data: Data
    t_burn: float
    margins: Mapping[str, float]
    provenance: Mapping[str, str]


@dataclass(frozen=True)
class Match:
    """Two settings set side by side; `differs` maps each key in which they differ to both values."""

    first: Group
    second: Group
    differs: dict[str, tuple[Any, Any]]
    is_paired: bool


def matched(first: Ensemble, second: Ensemble) -> tuple[list[Match], list[Group], list[Group]]:
    """Settings of unchanged members, each with the one of the other ensemble that differs in the fewest keys.

    They must share `SHARED`. Matrices are pairs where seed and start of the random numbers are one: the same `seed`,
    coupling, n and matrix give the same random system up to the scales kappa and rho.

    Returns
    -------
    matches, left_first, left_second
        The last two are the settings without counterpart.

    Raises
    ------
    ValueError
        If no setting of one can be set beside one of the other.
    """
    mine, theirs = (_groups(one.data.members) for one in (first, second))
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
            f"{first.name} and {second.name}: expected settings that share {' and '.join(SHARED)}, got {has[0]} in "
            f"{first.name} and {has[1]} in {second.name}; run a scene with the same n and coupling to compare them"
        )
    found: dict[int, int] = {}
    for _, i, j in near:
        if i not in found and j not in found.values():
            found[i] = j
    matches = []
    for i, j in sorted(found.items()):
        a, b = mine[i], theirs[j]
        differs = {name: (a.key[name], b.key[name]) for name in keys if a.key[name] != b.key[name]}
        matches.append(Match(a, b, differs, _seeds(a) == _seeds(b)))
    return (
        matches,
        [group for i, group in enumerate(mine) if i not in found],
        [group for j, group in enumerate(theirs) if j not in found.values()],
    )


def _groups(members: pd.DataFrame) -> list[Group]:
    return groups(unchanged(members))


def _shared(group: Group) -> str:
    return ", ".join(f"{name} = {group.key[name]}" for name in SHARED)


def _seeds(group: Group) -> set[int]:
    return {int(seed) for seed in group.members["seed"]}


def compare(first: Ensemble, second: Ensemble, settings: AnalysisSettings) -> Report:
    """Set two ensembles side by side under the settings of the first.

    Parameters
    ----------
    first, second : Ensemble
        Members need the column `seed`.
    settings : AnalysisSettings
        t_burn, dt, margins and confidence hold for both.

    Raises
    ------
    ValueError
        If they have no setting to compare, or an ensemble contradicts itself or the settings.
    """
    for one in (first, second):
        try:
            check(one.data.members, one.data.series, settings)
        except ValueError as error:
            under = "" if one is first else f", under the settings of {first.name}"
            raise ValueError(f"{one.name}{under}: {error}") from None
    matches, *left = matched(first, second)
    found, labels = [], []
    for match in matches:
        pair = [
            sample(group.label, group.members, one.data, settings.t_burn)
            for group, one in ((match.first, first), (match.second, second))
        ]
        for statistic in statistics(settings.margins):
            found.append(contrast(statistic, pair[0], pair[1], match.is_paired, settings.confidence))
            labels.append(match)
    rows = judged(found, 1 - settings.confidence)
    for row, match in zip(rows, labels, strict=True):
        row |= {"setting": match.first.label, "differs_in": _differs(match) or None, "is_paired": match.is_paired}
        row["statement"] = in_words(row)
    table = typed(_SCHEMA, rows)
    unmatched = typed(
        _UNMATCHED,
        [
            {"dataset": one.name, "setting": group.label, "members": len(group.members)}
            for one, some in zip((first, second), left, strict=True)
            for group in some
        ],
    )
    lead = _answer(rows, matches, first, second)
    panels = [
        (label, [row for row in rows if row["setting"] == label and row["p_equivalent"] is not None])
        for label in dict.fromkeys(row["setting"] for row in rows)
    ]
    panels = [panel for panel in panels if panel[1]]
    picture = change_figures.contrasts(
        panels,
        f"{second.name} minus {first.name} in units of the declared margin (band), with the interval of the "
        f"equivalence test. {change_figures.HOW_TO_READ}",
    ) if panels else None  # fmt: skip
    html = page_environment().get_template("compare.html").render(
        title=f"{first.name} and {second.name}",
        lead=lead,
        src=embedded(picture.recipe()) if picture else None,
        picture=picture,
        settings_rows=[(match, _differs(match), _pairing(match)) for match in matches],
        blocks=[(label, [_shown(row) for row in rows if row["setting"] == label]) for label in
                dict.fromkeys(row["setting"] for row in rows)],
        unmatched=records(unmatched),
        notes=_notes(rows, first, second, settings),
        first=first,
        second=second,
        n_tests=words.count(_tested(rows), "comparison"),
        level=words.percent(settings.confidence),
    )  # fmt: skip
    return Report(html, {"compared": table, "unmatched": unmatched}, lead)


def _tested(rows: Sequence[Mapping[str, Any]]) -> int:
    """How many there is data for: what p-values are adjusted for."""
    return sum(row["p_equivalent"] is not None for row in rows)


def _differs(match: Match) -> str:
    parts = []
    for name, values in match.differs.items():
        shown = ["none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
                 for value in values]  # fmt: skip
        parts.append(f"{name} = {shown[0]} against {shown[1]}")
    return ", ".join(parts)


def _pairing(match: Match) -> str:
    if match.is_paired:
        return "paired: the same random systems"
    return "independent: other random systems"


def _answer(rows: Sequence[Mapping[str, Any]], matches: Sequence[Match], *of: Ensemble) -> list[str]:
    """Are these two the same? One answer, then what differs, what is open, and how they were set side by side."""
    by = {verdict: [row for row in rows if row["verdict"] == verdict] for verdict in (EQUIVALENT, DIFFERENT, OPEN)}
    names = f"{of[0].name} and {of[1].name}"
    tested = words.count(len(rows), "comparison")
    settings = words.count(len(matches), "setting")
    same, other, unknown = (len(by[verdict]) for verdict in (EQUIVALENT, DIFFERENT, OPEN))
    if not unknown and not other:
        is_one = all(row["relative"] == 0 for row in rows)
        how = "the same to the last digit, matrix by matrix" if is_one else "equivalent within the declared margins"
        lines = [f"Yes: {names} are {how} in all {tested} of {settings}."]
    elif other:
        lines = [f"No: {names} differ in {other} of {tested} of {settings}; {same} are equivalent, {unknown} open."]
    elif same:
        lines = [
            f"Not enough data to tell: {names} are equivalent in {same} of {tested} of {settings}, and "
            f"{unknown} are open; none is shown to differ."
        ]
    else:
        lines = [f"Not enough data: in none of {tested} of {settings} can {names} be told apart or called the same."]
    if other:
        worst = sorted(by[DIFFERENT], key=lambda row: -abs(row["relative"]) / row["margin"])[:3]
        listed = "; ".join(f"{row['quantity']} ({row['setting']}) {size_in_words(row)}" for row in worst)
        lines.append(f"The largest differences in units of their margins: {listed}.")
    known = [row for row in by[OPEN] if row["p_equivalent"] is not None]
    alone = [row["by_itself"] for row in known if row["by_itself"] != OPEN]
    if alone:
        each = " and ".join(f"{alone.count(verdict)} {verdict}" for verdict in dict.fromkeys(alone))
        lines.append(
            f"Taken by themselves, of the {unknown} open ones {each} would be; adjusted for "
            f"{words.count(_tested(rows), 'comparison')} they are not."
        )
    if known and not other:
        widest = max(known, key=lambda row: (row["narrow_high"] - row["narrow_low"]) / row["margin"])
        lines.append(f"The least is known of {widest['quantity']} ({widest['setting']}): {widest['statement']}.")
    for match in matches:
        if match.differs:
            lines.append(f"{match.first.label} is set beside another setting: {_differs(match)}.")
    paired = sum(match.is_paired for match in matches)
    if paired == len(matches):
        lines.append("Both have the same random systems (seed, coupling and n are one), so matrices are pairs.")
    elif paired:
        lines.append(f"In {paired} of {settings} both have the same random systems, and matrices are pairs there.")
    else:
        lines.append("Their random systems are drawn independently, so matrices are no pairs.")
    return lines


def _shown(row: Mapping[str, Any]) -> dict[str, str]:
    """The cells of a row of the page's table."""
    show = words.percent if row["is_share"] else words.number
    cells = {name: "–" if row[name] is None else show(row[name]) for name in ("first", "second")}
    for name in ("first", "second"):
        low, high = row[f"{name}_low"], row[f"{name}_high"]
        cells[name] += "" if low is None or high is None else f" ({show(low)} to {show(high)})"
    n_first, n_second = row["n_first"], row["n_second"]
    matrices = str(n_first) if n_first == n_second else f"{n_first}, {n_second}"
    for name in ("p_equivalent_holm", "p_different_holm"):
        cells[name] = "–" if row.get(name) is None else words.p_text(row[name])
    return {"quantity": row["quantity"], "matrices": matrices, **cells, "statement": row["statement"]}


def _notes(
    rows: Sequence[Mapping[str, Any]], first: Ensemble, second: Ensemble, settings: AnalysisSettings
) -> list[str]:
    declared = [
        f"{one.label} {words.percent(settings.margins[name])}"
        for name, one in COMPARED.items()
        if name in settings.margins
    ]
    of_values = [f"{', '.join(declared)} of the first value"] if declared else []
    notes = [
        f"Margins and t_burn = {settings.t_burn:g} are those of {first.name}: "
        + "; ".join([*of_values, f"shares of runs {100 * SHARE_MARGIN:.0f} points."])
    ]
    other = [
        f"{name} {words.percent(second.margins[name])}"
        for name in COMPARED
        if name in second.margins and second.margins[name] != settings.margins.get(name)
    ]
    if other:
        notes.append(f"{second.name} declares other margins, which are not used: {', '.join(other)}.")
    if second.t_burn != settings.t_burn:
        notes.append(f"{second.name} declares t_burn = {second.t_burn:g}, which is not used.")
    notes.append(
        f"All {words.count(_tested(rows), 'comparison')} that there is data for are judged together: p-values are "
        "adjusted by Holm's rule, so that equal ensembles are called different anywhere in at most "
        f"{words.percent(1 - settings.confidence)} of cases; the intervals ({words.percent(settings.confidence)}) "
        "are not."
    )
    notes.append(
        "Matrices are the independent units. Statistics other than shares hold for runs that reached t_end. Shares "
        "are of one run a matrix: a run has gone quiet if no block sticks and nothing changes over its last quarter, "
        "and has collapsed only where that is certified. Their differences are "
        f"estimated {SHARES_ADJUSTED}."
    )
    return notes
