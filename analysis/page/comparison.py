"""Whether two datasets are the same: their statistics side by side, or one sentence if their runs are equal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from stickslip.analysis.answer import Answer, Picture, Question, Table
from stickslip.analysis.contrast import contrast
from stickslip.analysis.ensemble import Data, Study
from stickslip.analysis.findings.finding import Alike, Decided, Form, Quantity, Truth
from stickslip.analysis.findings.words import capital, plural
from stickslip.analysis.groups import Group
from stickslip.analysis.measures import ENDS, KEYS, Measure, measures, of_windows
from stickslip.analysis.members import ENGINE_KEYS, START, SYSTEM_KEYS, noun
from stickslip.analysis.outcomes import forest, outcome, outcomes
from stickslip.analysis.page import parts
from stickslip.analysis.page.build import Report
from stickslip.analysis.page.layout import Page, Section
from stickslip.analysis.rows import frame_of
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.steps import Kind, Setting, Step, few, judged_together, table_of
from stickslip.pipeline.design.labels import apart

#: Keys that two settings must share: with another n or coupling, a statistic is not the same quantity.
SHARED = ("n", "coupling")
#: Columns that say what a member is, in addition to the numbers of draws that its name has.
_IDENTITY = (*SYSTEM_KEYS, *ENGINE_KEYS, "seed", "z_start", "w_start", "twin_size", "perturbation_reading")
MOST_NAMED = 3  # members without a partner


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


class Alone(NamedTuple):
    """A member without a partner."""

    dataset: str
    setting: str
    member_id: str


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
    studies = [_study(ensemble, settings, first.name) for ensemble in (first, second)]
    matches, *left = matched(first.name, studies[0].groups, second.name, studies[1].groups)
    asked = _both(*studies)
    labels = [match.second.name for match in matches]
    names = dict(zip(labels, apart(labels), strict=True))
    alone = [
        step
        for match in matches
        for step in _steps(match, asked, second.name, names[match.second.name], settings.confidence)
    ]
    steps = judged_together(alone, 1 - settings.confidence)
    unit = noun(studies[0].unit)
    lost = [*_alone(matches, left, (first.name, second.name))]
    tables = {"changes": table_of(steps), "alone": frame_of(Alone, lost)}
    notes = _notes(first, second, settings, matches, left, lost, unit)
    return _report(first, second, _answer(first, second, steps, tables, unit), notes)


def _steps(
    match: Match, asked: Sequence[tuple[Measure, Measure]], name: str, where: str, confidence: float
) -> Iterator[Step]:
    """Each statistic of a setting beside that of its counterpart; all of them are judged together."""
    setting = Setting(f"{name} ({where})" if where else name)
    for mine, theirs in asked:
        before, after = mine.of(match.first), theirs.of(match.second)
        withheld = before.withheld or after.withheld
        found = contrast(mine.statistic, before.sums, after.sums, match.is_paired, confidence, withheld=withheld)
        yield Step(Kind.DATASET, match.second.label, match.first.label, found, where=where, name=setting)


def _answer(
    first: Ensemble, second: Ensemble, steps: Sequence[Step], tables: Mapping[str, Table], unit: str
) -> Answer:
    """Whether two ensembles agree, and every statistic of each setting."""
    known = [step for step in steps if step.contrast.is_known and not step.contrast.reason]
    if not known:
        lack = few(f"whether {first.name} and {second.name} agree", len(steps))
        return Answer(findings=[Decided(Truth.UNDECIDED, lack)], tables=tables)
    by_setting = {step.name: [other for other in known if other.name == step.name] for step in known}
    told = known
    if len({*map(outcome, by_setting.values())}) == 1:  # no setting to tell apart
        told = [replace(step, name=Setting(second.name)) for step in known]
    grouped, *others = outcomes(first.name, told, unit)
    is_open = any(finding.undecided for finding in (grouped, *others))
    truth = Truth.NO if grouped.different else Truth.UNDECIDED if is_open else Truth.YES
    if truth is Truth.UNDECIDED and others:  # what is undecided is why
        others, grouped = [grouped, *others[:-1]], others[-1]
    return Answer(
        findings=[Decided(truth, grouped), *others, *(step.level(first.name, unit) for step in known)],
        n_lead=1 + len(others),
        tables=tables,
        figures=forest(known, f"Differences of {second.name} from {first.name}"),
        method=f"Verdicts are adjusted for {len(known)} comparisons (Holm), intervals are not.",
    )


def _alone(matches: Sequence[Match], left: Sequence[Sequence[Group]], names: Sequence[str]) -> Iterator[Alone]:
    """Members without a partner: those of one setting of a pair alone, if partners are compared, and of the rest."""
    for k, name in enumerate(names):
        for match in matches:
            mine, theirs = (match.first, match.second)[:: 1 - 2 * k]
            lacks = ~mine.column("unit").isin(theirs.column("unit")) & match.is_paired
            yield from (Alone(name, mine.label, member_id) for member_id in mine.column("member_id")[lacks])
        for group in left[k]:
            yield from (Alone(name, group.label, member_id) for member_id in group.column("member_id"))


def _notes(
    first: Ensemble,
    second: Ensemble,
    settings: AnalysisSettings,
    matches: Sequence[Match],
    left: Sequence[Sequence[Group]],
    alone: Sequence[Alone],
    unit: str,
) -> list[str]:
    """What is compared with what, and what is left out."""
    notes = []
    for match in matches:
        how = f"each {unit} is compared with itself" if match.is_paired else "the systems are drawn independently"
        differs = ", ".join(f"{name} = {_short(a)} against {_short(b)}" for name, (a, b) in match.differs.items())
        where = f"{match.first.label}: " if len(matches) > 1 else ""
        notes.append(f"{where}{how}{f'; another setting: {differs}' if differs else ''}.")
    for dataset, groups in zip((first, second), left, strict=True):
        notes += [
            f"{group.label} of {dataset.name} has no counterpart ({plural(len(group), 'run')})." for group in groups
        ]
    for dataset in (first, second):
        lost = [row.member_id for row in alone if row.dataset == dataset.name]
        if lost:
            has = "has" if len(lost) == 1 else "have"
            shown = ", ".join(lost[:MOST_NAMED]) + (", ..." if len(lost) > MOST_NAMED else "")
            notes.append(f"{plural(len(lost), 'member')} of {dataset.name} {has} no partner: {shown}.")
    if first.t_burn != second.t_burn:
        notes.append(f"t_burn = {first.t_burn:g} is that of {first.name}; {second.name} declares {second.t_burn:g}.")
    others = sorted(name for name, margin in second.margins.items() if settings.margins.get(name, margin) != margin)
    if others:
        notes.append(f"Margins are those of {first.name}; {second.name} declares others for {', '.join(others)}.")
    return [capital(note) for note in notes]


def _short(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _both(first: Study, second: Study) -> list[tuple[Measure, Measure]]:
    """What two studies both measure: what both record, all quantities of n_stick, and how runs end."""
    theirs = {measure.name: measure for measure in measures(second, first) if measure.name not in KEYS}
    recorded = [(mine, theirs[mine.name]) for mine in measures(first, second) if mine.name in theirs]
    windows = [measure for measure in of_windows(first) if measure.key in second.compared]
    return [*recorded, *((measure, measure) for measure in (*windows, *ENDS))]


def _report(first: Ensemble, second: Ensemble, answer: Answer, notes: Sequence[str] = ()) -> Report:
    title = f"{first.name} beside {second.name}"
    pictures = {name: picture for name, picture in answer.figures.items() if isinstance(picture, Picture)}
    figures = {name: parts.draw(picture.recipe, True) for name, picture in pictures.items()}
    entry = Question(lambda _: answer, title="Do two datasets agree?")
    compared = parts.part(parts.answered("compare", entry, answer, figures))
    origin = [
        f"{which.name}: " + "".join(f"{name}: {value}. " for name, value in which.provenance.items())
        for which in (first, second)
    ]
    made = Section(
        "made",
        "How was it made?",
        f"{first.name} and {second.name}.",
        [*compared.texts, *origin],
        notes=compared.notes,
    )
    whole = Page(
        title, compared.title, compared.lead, (), compared.panels, compared.table, notes=notes, sections=[made]
    )
    told = parts.findings_json(title, compared.lead, [compared])
    return Report(whole.html, answer.tables, [*compared.lead], figures, findings=told)


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
