"""Whether two datasets are the same: their statistics side by side, or one sentence if their runs are equal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip.analysis.answer import Answer, B, I, Question, Row, S, frame
from stickslip.analysis.contrast import CHANGES, Contrast, contrast, judged, sample, shares, statistics
from stickslip.analysis.ensemble import Data, Study
from stickslip.analysis.findings.finding import Alike, Decided, Form, Lack, Quantity, Reason, Truth
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import capital, plural
from stickslip.analysis.groups import Group
from stickslip.analysis.measures import KEYS, Measure, measures
from stickslip.analysis.members import ENGINE_KEYS, START, SYSTEM_KEYS, noun
from stickslip.analysis.outcomes import Beside, Setting, forest, outcome, outcomes
from stickslip.analysis.page import parts
from stickslip.analysis.page.build import Report
from stickslip.analysis.page.layout import Page, Table
from stickslip.analysis.settings import AnalysisSettings
from stickslip.pipeline.design.labels import apart

#: Keys that two settings must share: with another n or coupling, a statistic is not the same quantity.
SHARED = ("n", "coupling")
#: Columns that say what a member is, in addition to the numbers of draws that its name has.
_IDENTITY = (*SYSTEM_KEYS, *ENGINE_KEYS, "seed", "z_start", "w_start", "twin_size", "perturbation_reading")
MOST_NAMED = 3  # members without a partner
_TABLE: Mapping[str, str] = {**CHANGES, "is_paired": B}
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
    if _is_same(first, second):
        runs = Quantity("runs", f"runs that {first.name} and {second.name} both hold", Form.COUNT)
        same = Decided(Truth.YES, Alike(runs, len(first.data.table), "to the last digit"))
        return _report(first, second, Answer(findings=[same]))
    mine, theirs = (_study(each, settings, first.name) for each in (first, second))
    matches, *left = matched(first.name, mine.groups, second.name, theirs.groups)
    measured = _both(mine, theirs)
    asked = [
        *(measure.statistic for measure, _ in measured),
        *statistics(mine.margins, mine.compared & theirs.compared),
        *shares(),
    ]
    found: list[tuple[Match, Contrast]] = []
    for match in matches:
        pair = sample(match.first), sample(match.second)
        for held, group, some in zip(pair, (match.first, match.second), zip(*measured, strict=True), strict=False):
            held.sums.update({measure.name: measure.of(group).sums for measure in some})
        found += [(match, contrast(each, *pair, match.is_paired, settings.confidence)) for each in asked]
    together = judged([one for _, one in found], 1 - settings.confidence)
    contrasts = [(match, one) for (match, _), one in zip(found, together, strict=True)]
    rows = [
        {"kind": "dataset", "setting": match.second.label, "reference": match.first.label,
         "is_paired": match.is_paired, **one.row()}
        for match, one in contrasts
    ]  # fmt: skip
    alone = [
        {"dataset": which.name, "setting": group.label, "member_id": name}
        for k, (which, some) in enumerate(zip((first, second), left, strict=True))
        for group, names in [
            *(match.alone(k) for match in matches),
            *((one, one.column("member_id").tolist()) for one in some),
        ]
        for name in names
    ]
    unmatched = [
        {"dataset": which.name, "setting": group.label, "members": len(group)}
        for which, some in zip((first, second), left, strict=True)
        for group in some
    ]
    tables = {
        "compared": frame(_TABLE, rows), "unmatched": frame(_UNMATCHED, unmatched), "alone": frame(_ALONE, alone),
    }  # fmt: skip
    notes = _notes(first, second, settings, matches, unmatched, alone, noun(mine.unit))
    return _report(first, second, _answer(first, second, contrasts, tables, noun(mine.unit)), notes)


def _answer(
    first: Ensemble,
    second: Ensemble,
    contrasts: Sequence[tuple[Match, Contrast]],
    tables: Mapping[str, Any],
    unit: str,
) -> Answer:
    """Whether two ensembles agree, and every statistic of each setting."""
    known = [(match, one) for match, one in contrasts if one.is_known and not one.reason]
    if not known:
        what = f"whether {first.name} and {second.name} agree"
        return Answer(findings=[Decided(Truth.UNDECIDED, Lack(what, Reason.FEW_UNITS))], tables=tables)
    labels = [match.second.name for match, _ in known]
    names = dict(zip(labels, apart(labels), strict=True))
    placed: dict[Setting, list[Beside]] = {}
    for match, one in known:
        where = names[match.second.name]
        said = f"{second.name} ({where})" if where else second.name
        placed.setdefault(Setting(said), []).append(Beside(one, Place.of(where)))
    if len({outcome([one.contrast for one in some]) for some in placed.values()}) == 1:  # no setting to tell apart
        placed = {Setting(second.name): [one for some in placed.values() for one in some]}
    grouped, *others = outcomes(first.name, placed, unit)
    is_open = any(one.undecided for one in (grouped, *others))
    truth = Truth.NO if grouped.different else Truth.UNDECIDED if is_open else Truth.YES
    if truth is Truth.UNDECIDED:  # what is undecided is why
        others, grouped = [grouped, *others[:-1]] if others else [], (others or [grouped])[-1]
    every = [one for some in placed.values() for one in some]
    levels = [one.contrast.level(one.where, first.name, unit) for one in every]
    return Answer(
        findings=[Decided(truth, grouped), *others, *levels],
        n_lead=1 + len(others),
        tables=tables,
        figures=forest(every, f"Differences of {second.name} from {first.name}"),
        method=f"Verdicts are adjusted for {len(known)} comparisons (Holm), intervals are not.",
    )


def _notes(
    first: Ensemble, second: Ensemble, settings: AnalysisSettings, matches: Sequence[Match],
    unmatched: Sequence[Row], alone: Sequence[Row], unit: str,
) -> list[str]:  # fmt: skip
    """What is compared with what, and what is left out."""
    notes = []
    for match in matches:
        how = f"each {unit} is compared with itself" if match.is_paired else "the systems are drawn independently"
        differs = ", ".join(f"{name} = {_short(a)} against {_short(b)}" for name, (a, b) in match.differs.items())
        where = f"{match.first.label}: " if len(matches) > 1 else ""
        notes.append(f"{where}{how}{f'; another setting: {differs}' if differs else ''}.")
    notes += [
        f"{row['setting']} of {row['dataset']} has no counterpart ({plural(row['members'], 'run')})."
        for row in unmatched
    ]
    for which in (first, second):
        lost = [str(row["member_id"]) for row in alone if row["dataset"] == which.name]
        if lost:
            has = "has" if len(lost) == 1 else "have"
            shown = ", ".join(lost[:MOST_NAMED]) + (", ..." if len(lost) > MOST_NAMED else "")
            notes.append(f"{plural(len(lost), 'member')} of {which.name} {has} no partner: {shown}.")
    if first.t_burn != second.t_burn:
        notes.append(f"t_burn = {first.t_burn:g} is that of {first.name}; {second.name} declares {second.t_burn:g}.")
    others = sorted(name for name, margin in second.margins.items() if settings.margins.get(name, margin) != margin)
    if others:
        notes.append(f"Margins are those of {first.name}; {second.name} declares others for {', '.join(others)}.")
    return [capital(note) for note in notes]


def _short(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _both(one: Study, other: Study) -> list[tuple[Measure, Measure]]:
    """What two studies both measure, beyond n_stick, of which more is compared."""
    theirs = {measure.name: measure for measure in measures(other, one)}
    return [(mine, theirs[mine.name]) for mine in measures(one, other) if mine.name in {*theirs} - {*KEYS}]


def _report(first: Ensemble, second: Ensemble, answer: Answer, notes: Sequence[str] = ()) -> Report:
    title = f"{first.name} beside {second.name}"
    entry = Question(lambda _: answer, title="Do two datasets agree?")
    question = parts.answered("compare", entry, answer, with_pdf=True)
    compared = parts.part(question)
    origin = [
        f"{which.name}: " + "".join(f"{name}: {value}. " for name, value in which.provenance.items())
        for which in (first, second)
    ]
    inside = compared.section((), True, False)
    made = inside._replace(
        key="made",
        title="How was it made?",
        summary=f"{first.name} and {second.name}.",
        texts=[answer.method, *origin],
        panels=(),
        table=Table(),
    )
    page = Page(title, compared.title, compared.lead, (), compared.panels, inside.table, notes=notes, sections=[made])
    findings = parts.findings_json(title, compared.lead, [compared])
    return Report(page.html, answer.tables, compared.lead, question.figures, findings)


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
