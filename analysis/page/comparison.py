"""Whether two datasets are the same: their statistics side by side, or one sentence if their data are equal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from stickslip.analysis.answer import Answer, Question
from stickslip.analysis.by_key import by_key
from stickslip.analysis.contrast import contrast
from stickslip.analysis.ensemble import Data, Study
from stickslip.analysis.findings.finding import Alike, Decided, Form, Quantity, Truth
from stickslip.analysis.findings.place import Place, told_apart
from stickslip.analysis.findings.words import capital, listed, plural
from stickslip.analysis.groups import Group
from stickslip.analysis.measures import ENDS, KEYS, Measure, measures, of_windows
from stickslip.analysis.members import ENGINE_KEYS, START, SYSTEM_KEYS, noun
from stickslip.analysis.outcomes import forest, outcome, outcomes
from stickslip.analysis.page import parts
from stickslip.analysis.page.build import Report
from stickslip.analysis.page.layout import Page, Section
from stickslip.analysis.rows import frame_of
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.steps import Kind, Step, Variant, few, judged_together, table_of
from stickslip.pipeline.design.values import text

#: Keys that two settings must share: with another n or coupling, a statistic is not the same quantity.
SHARED = ("n", "coupling")
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


class Match(NamedTuple):
    """Two settings to compare; paired if both have the same units."""

    first: Group
    second: Group
    is_paired: bool


class Alone(NamedTuple):
    """A member without a partner."""

    dataset: str
    setting: str
    member_id: str


def compare(first: Ensemble, second: Ensemble, settings: AnalysisSettings) -> Report:
    """Report that compares two ensembles, under the settings of the first.

    Raises `ValueError` if they have no settings to compare, or an ensemble contradicts itself or the settings.
    """
    if first.digest and first.digest == second.digest:
        runs = Quantity("runs", f"runs that {first.name} and {second.name} both hold", Form.COUNT)
        same = Decided(Truth.YES, Alike(runs, len(first.data.table), "to the last digit"))
        return _report(first, second, Answer(findings=[same]), [])
    studies = [_study(ensemble, settings, first.name) for ensemble in (first, second)]
    groups = [study.groups for study in studies]
    matches = matched(first.name, groups[0], second.name, groups[1])
    measured, unit = _both(*studies), noun(studies[0].unit)
    where = told_apart([match.second.label for match in matches])
    unjudged = [
        step
        for match in matches
        for step in _steps(match, measured, second.name, where[match.second.label], settings.confidence)
    ]
    steps = judged_together(unjudged, 1 - settings.confidence)
    lost = [row for k, ensemble in enumerate((first, second)) for row in _lost(ensemble.name, groups[k], k, matches)]
    tables = {"changes": table_of(steps), "alone": frame_of(Alone, lost)}
    both_sides = [group for side in groups for group in side]
    laws, is_told = parts.engine_laws(both_sides)  # one needs no name
    notes = [*_of_matches(matches, unit), *_of_lost(lost), *_of_settings(first, second, settings), *[laws] * is_told]
    answer = replace(_answer(first.name, second.name, steps, both_sides, unit), tables=tables)
    return _report(first, second, answer, notes)


def _study(ensemble: Ensemble, settings: AnalysisSettings, whose: str) -> Study:
    try:
        return Study(ensemble.data, settings)
    except ValueError as error:
        raise ValueError(f"{ensemble.name}, under the settings of {whose}: {error}") from None


def _both(first: Study, second: Study) -> list[tuple[Measure, Measure]]:
    """What two studies both measure: what both record, all quantities of n_stick, and how runs end."""
    theirs = {measure.name: measure for measure in measures(second, first) if measure.name not in KEYS}
    recorded = [(mine, theirs[mine.name]) for mine in measures(first, second) if mine.name in theirs]
    windows = [measure for measure in of_windows(first) if measure.key in second.compared]
    return [*recorded, *((measure, measure) for measure in (*windows, *ENDS))]


def _steps(
    match: Match, measured: Sequence[tuple[Measure, Measure]], name: str, where: Place, confidence: float
) -> Iterator[Step]:
    """Each statistic of a setting beside that of its counterpart."""
    setting = Variant(f"{name} ({where})" if where else name)
    for mine, theirs in measured:
        reference, changed = mine.of(match.first), theirs.of(match.second)
        withheld = reference.withheld or changed.withheld
        difference = contrast(
            mine.statistic, reference.sums, changed.sums, match.is_paired, confidence, withheld=withheld
        )
        labels = match.second.label, match.first.label
        yield Step(Kind.DATASET, *labels, difference, where=where, name=setting)


def _answer(first: str, second: str, steps: Sequence[Step], groups: Sequence[Group], unit: str) -> Answer:
    """Whether two ensembles agree, and every statistic of each setting."""
    judged = [step for step in steps if step.contrast.is_known and not step.contrast.reason]
    if not judged:
        return Answer(findings=[Decided(Truth.UNDECIDED, few(f"whether {first} and {second} agree", groups))])
    grouped = judged
    if len({*map(outcome, by_key(judged, lambda step: step.name).values())}) == 1:  # no setting to tell apart
        grouped = [replace(step, name=Variant(second)) for step in judged]
    lead, *further = outcomes(first, grouped, unit, "setting")
    is_open = any(finding.undecided for finding in (lead, *further))
    truth = Truth.NO if lead.different else Truth.UNDECIDED if is_open else Truth.YES
    return Answer(
        findings=[Decided(truth, lead), *further, *(step.level(first, unit) for step in judged)],
        n_lead=1 + len(further),
        figures=forest(None, judged, f"differences of {second} from {first}"),
        method=f"Verdicts are adjusted for {len(judged)} comparisons (Holm), intervals are not.",
    )


def _lost(dataset: str, groups: Sequence[Group], k: int, matches: Sequence[Match]) -> Iterator[Alone]:
    """The members of the first or second dataset without a partner, where partners are compared."""
    for group in groups:
        names = group.column("member_id")
        for match in matches:
            mine, theirs = (match.second, match.first) if k else (match.first, match.second)
            if mine is group:
                names = names[~group.column("unit").isin(theirs.column("unit")) & match.is_paired]
        yield from (Alone(dataset, group.label, str(name)) for name in names)


def _of_matches(matches: Sequence[Match], unit: str) -> Iterator[str]:
    """What is compared with what, settings that are compared alike together."""

    def sentence(match: Match) -> str:
        how = f"Each {unit} is compared with itself" if match.is_paired else "The systems are drawn independently"
        first, second = match.first.key, match.second.key
        differ = [
            f"{name} = {text(first[name])} against {text(second[name])}"
            for name in _differ(match.first, match.second)
        ]
        return how + (f"; another setting: {', '.join(differ)}" if differ else "")

    by_sentence = by_key(matches, sentence)
    for words, alike in by_sentence.items():
        yield f"{words}{f' ({listed([match.first.label for match in alike])})' if len(by_sentence) > 1 else ''}."


def _of_lost(lost: Sequence[Alone]) -> Iterator[str]:
    """Members without a partner, the first of each dataset by name."""
    for dataset, rows in by_key(lost, lambda row: row.dataset).items():
        names = [row.member_id for row in rows]
        listing = ", ".join(names[:MOST_NAMED]) + (", ..." if len(names) > MOST_NAMED else "")
        has = "has" if len(names) == 1 else "have"
        yield f"{plural(len(names), 'member')} of {dataset} {has} no partner: {listing}."


def _of_settings(first: Ensemble, second: Ensemble, settings: AnalysisSettings) -> Iterator[str]:
    """Which of the settings of the analysis, all those of the first, differ from those of the second."""
    if first.t_burn != second.t_burn:
        yield f"t_burn = {first.t_burn:g} is that of {first.name}; {second.name} declares {second.t_burn:g}."
    names = sorted(name for name, margin in second.margins.items() if settings.margins.get(name, margin) != margin)
    if names:
        yield f"Margins are those of {first.name}; {second.name} declares others for {', '.join(names)}."


def _report(first: Ensemble, second: Ensemble, answer: Answer, notes: Sequence[str]) -> Report:
    title = f"{first.name} beside {second.name}"
    entry = Question(lambda _: answer, title="Do two datasets agree?")
    question = parts.answered("compare", entry, answer, with_pdf=True)
    answered = parts.part(question)
    inside = answered.section((), True, False)
    origins = [
        f"{ensemble.name}: " + "".join(f"{name}: {value}. " for name, value in ensemble.provenance.items())
        for ensemble in (first, second)
    ]
    summary = f"{first.name} and {second.name}."
    origin = Section("made", "How was it made?", summary, [answer.method, *origins], notes=inside.notes)
    capitals = [*map(capital, notes)]
    page = Page(
        title, answered.title, answered.lead, answered.panels, inside.table, notes=capitals, sections=[origin]
    )
    findings = parts.findings_json(title, answered.lead, [answered])
    return Report(page.html, answer.tables, answered.lead, question.figures, findings)


def matched(first: str, mine: Sequence[Group], second: str, theirs: Sequence[Group]) -> list[Match]:
    """Settings of two datasets, each matched with the one that differs in the fewest keys.

    They must share `SHARED`. Units are paired if both datasets drew the same ones: the same `seed`, coupling, n and
    matrix give the same random system up to the scales kappa and rho, and starts are the same for the same system.

    Parameters
    ----------
    first, second : str
        Names of the datasets.
    mine, theirs : sequence of Group
        Groups of unchanged members.

    Raises
    ------
    ValueError
        If no setting of one can be compared with one of the other.
    """
    shared = [[tuple(group.key[name] for name in SHARED) for group in groups] for groups in (mine, theirs)]
    candidates = sorted(
        (len(_differ(group, partner)), i, j)
        for i, group in enumerate(mine)
        for j, partner in enumerate(theirs)
        if shared[0][i] == shared[1][j]
    )
    if not candidates:
        has = ["; ".join(f"n = {n}, coupling = {coupling}" for n, coupling in dict.fromkeys(keys)) for keys in shared]
        raise ValueError(
            f"{first} and {second}: expected settings that share {' and '.join(SHARED)}, got {has[0]} in "
            f"{first} and {has[1]} in {second}; run a scene with the same n and coupling to compare them"
        )
    matches: dict[int, int] = {}
    for _, i, j in candidates:
        if i not in matches and j not in matches.values():
            matches[i] = j
    pairs = [(mine[i], theirs[j]) for i, j in sorted(matches.items())]
    pairs.sort(key=lambda pair: -pair[0].key["n"])
    return [Match(group, partner, _draws(group) == _draws(partner)) for group, partner in pairs]


def _differ(first: Group, second: Group) -> list[str]:
    """The keys in which two groups differ."""
    return [name for name in (*SYSTEM_KEYS, *ENGINE_KEYS) if first.key[name] != second.key[name]]


def _draws(group: Group) -> tuple[object, ...]:
    """What identifies the draws of a group's units: the seed and the kind of unit; for starts, the system too."""
    systems = set(group.column("matrix")) if group.unit == START else None
    return {group.table.settings[k]["seed"] for k in group.column("setting").unique()}, group.unit, systems
