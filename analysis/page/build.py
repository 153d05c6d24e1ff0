"""The report: one self-contained HTML page, its tables as Parquet and CSV, its figures as SVG and PDF."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import pandas as pd

from stickslip.analysis.answer import Answer, places
from stickslip.analysis.ensemble import Data, Study
from stickslip.analysis.findings.alerts import Alert, Code
from stickslip.analysis.findings.finding import Lack, Reason
from stickslip.analysis.findings.numbers import signs
from stickslip.analysis.findings.words import plural
from stickslip.analysis.groups import Group
from stickslip.analysis.members import ENGINE_KEYS, START, SYSTEM_KEYS, noun
from stickslip.analysis.page import AS_TEXT, FINDINGS, FORMULA, PAGE
from stickslip.analysis.page.data import data_table
from stickslip.analysis.page.layout import Page, Panel, Section
from stickslip.analysis.page.layout import Table as PageTable
from stickslip.analysis.page.parts import Answered, Drawn, Part, ask, engine_laws, findings_json, part
from stickslip.analysis.questions import is_own, package_questions, question, refuse_unknown
from stickslip.analysis.rows import frame_by
from stickslip.analysis.settings import AnalysisSettings
from stickslip.pipeline.design.values import text
from stickslip.sim.engines import SETTINGS
from stickslip.sim.engines.contract import Number

OF_DATA = 2  # the largest rank of alerts that are shown although their question does not lead
LONG = 100_000  # rows from which on a table is for programs alone: no CSV
MOST_SAID = 3  # answers on the first screen
MOST_ALERTS = 3  # in order of rank
#: What columns of the table of groups are called on a page.
CALLED = {
    "group": "setting",
    "matrices": "systems",
    "members": "runs",
    "finished": "ran to t_end",
    "quiet": "sliding, may stick again",
}
#: How many of what a group has.
COUNTS: Mapping[str, Callable[[Group], int | None]] = {
    "matrices": lambda group: group.column("matrix").nunique(),
    "starts": lambda group: group.column("unit").nunique() if group.unit == START else None,
    "members": len,
    "finished": lambda group: int(group.is_finished.sum()),
    "quiet": lambda group: group.n_quiet,
}
_TEXTS = ("coupling", "file", "back_slip", "values")  # of systems


class Report(NamedTuple):
    """A finished report.

    Attributes
    ----------
    html : str
        The whole page, with its images inside.
    tables : mapping of str to DataFrame
        All tables, with nulls where a column does not apply or a number could not be computed.
    headline : sequence of str
        The main statements, for a terminal.
    figures : mapping of str to Drawn
    findings : mapping
        What the page says, in plain values.
    problems : mapping of str to str
        Why questions of the user's own have no answer, or not all of it, by name.
    """

    html: str
    tables: Mapping[str, pd.DataFrame]
    headline: Sequence[str]
    figures: Mapping[str, Drawn] = MappingProxyType({})
    findings: Mapping[str, object] = MappingProxyType({})
    problems: Mapping[str, str] = MappingProxyType({})

    def files(self) -> dict[str, Callable[[], bytes]]:
        """What makes the contents of each of the report's files, by path: all at once may be large.

        The page comes last: once it exists, all that it names exists.
        """
        contents: dict[str, Callable[[], bytes]] = {}
        for name, table in self.tables.items():
            contents[f"report/{name}.parquet"] = partial(_parquet, table)
            if len(table) <= LONG:
                contents[f"report/{name}.csv"] = partial(_csv, table)
        contents[FINDINGS] = partial(_json, self.findings)
        for name, figure in self.figures.items():
            contents[f"report/figures/{name}.svg"] = figure.svg.encode
            if figure.pdf is not None:
                contents[f"report/figures/{name}.pdf"] = partial(bytes, figure.pdf)
        return contents | {PAGE: self.html.encode}


def _parquet(table: pd.DataFrame) -> bytes:
    buffer = io.BytesIO()
    table.to_parquet(buffer, index=False)
    return buffer.getvalue()


def _csv(table: pd.DataFrame) -> bytes:
    plain = table.astype(dict.fromkeys(table.select_dtypes("category"), object))
    return str(plain.replace(FORMULA, AS_TEXT, regex=True).to_csv(index=False)).encode()


def _json(value: Mapping[str, object]) -> bytes:
    return (json.dumps({**value}, indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode()


def build(
    data: Data,
    settings: AnalysisSettings,
    title: str,
    about: str,
    provenance: Mapping[str, str],
    answers: Callable[[Study], Iterable[Answered | None]] | None = None,
    made_from: str = "",
) -> Report:
    """Report on an ensemble.

    Parameters
    ----------
    data, settings : Data and AnalysisSettings
        The members and their records; `series` of every member that did not fail.
    title, about, provenance : str, str and mapping of str to str
        Shown at the head of the page, and where the data come from, as given; escaped.
    answers : callable, optional
        Returns what `ask` returns for each question of this package, then that of each of the user's own that was
        run; default: asks the former one after the other.
    made_from : str, optional
        Digest of all this, kept at the head of the page.

    Raises
    ------
    ValueError
        If members, series or settings contradict each other; names the column, member or setting.
    """
    refuse_unknown(settings.question)
    study = Study(data, settings)
    asked = answers or (lambda study: [ask(study, key) for key in package_questions(settings.question)])
    by_key = {question.key: question for question in asked(study) if question is not None}
    questions = [_with_problem(question) if question.problem else question for question in by_key.values()]
    parts = [part(question, settings.units) for question in questions]
    lacking = [piece for piece in parts if piece.answer.is_lack]
    leading, folded = _in_order(study, [piece for piece in parts if not piece.answer.is_lack])
    failed = [piece for piece in lacking if by_key[piece.key].problem and piece.key in settings.question]
    as_asked = sorted([*failed, *leading], key=lambda piece: (*settings.question, piece.key).index(piece.key))
    lead, panels = _lead(as_asked), _panels(leading)
    title, about = _title(leading, title, about)
    groups = groups_table(study)
    laws, is_told = engine_laws(study.groups)  # one alone is named in the table of settings
    sources = {file: digest for question in questions for file, digest in question.sources.items()}
    sections = [
        *(piece.section(panels, piece.lead[0] in lead, k == 0) for k, piece in enumerate(leading)),
        *(piece.section(panels, False, False) for piece in folded),
        _provenance(study, groups, lacking, sources, provenance, laws * (not is_told)),
    ]
    page = Page(
        title, about, lead, panels, leading[0].head if leading else PageTable(),
        _alerts(study, leading, [piece for piece in parts if piece not in leading]),
        [*[laws] * is_told, *_notes(settings.question, by_key, {piece.key: piece for piece in lacking})], sections,
        {"made-from": made_from} | ({"own-questions": "run"} if sources else {}),
        leading[0].answer.paragraph if leading else "",
    )  # fmt: skip
    return Report(
        page.html,
        {"groups": groups} | {name: table for answer in questions for name, table in answer.answer.tables.items()},
        [title, *lead],
        {name: figure for question in questions for name, figure in question.figures.items()},
        findings_json(title, lead, [*leading, *folded, *lacking]),
        {key: text for key, question in by_key.items() if (text := question.problem or "; ".join(question.missing))},
    )


def _title(leading: Sequence[Part], title: str, about: str) -> tuple[str, str]:
    """Title and lines below it; a question of the user's own that leads has the page."""
    if leading and is_own(leading[0].key):
        title, about = leading[0].title, _joined(title, about)
    return title, about or (leading[0].title if leading else "")


def _with_problem(question: Answered) -> Answered:
    """A question of the user's own that failed, with what it lacks for an answer."""
    return replace(
        question, answer=Answer([Lack(f"the answer to {question.key}", Reason.CODE_FAILED, question.problem)])
    )


def _notes(asked: Iterable[str], questions: Mapping[str, Answered], lacking: Mapping[str, Part]) -> Iterator[str]:
    """What was asked and has no answer, or not all of it, and why."""
    for key in asked:
        answer = questions.get(key)
        if answer is None and is_own(key):
            yield f"{key} was not run; stickslip report DIR --own runs the code beside the scene."
        elif answer is None:
            name = question(key).title or key
            yield f"Asked but not answered: {name}: nothing that it needs was run or recorded."
        elif key in lacking and not answer.problem:
            yield from (f"Asked but not answered: {answer.title} {text}" for text in lacking[key].lead)
        if answer is not None and answer.missing:
            yield f"Left out of the answer: {key}: {'; '.join(answer.missing)}."


def _lead(leading: Sequence[Part]) -> list[str]:
    """The answer: the first finding of each question and, as far as there is room, what else leads them."""
    leads = [page.lead for page in leading[:MOST_SAID]]
    n_of = [1] * len(leads)
    for n in range(2, MOST_SAID + 1):
        for k, texts in enumerate(leads):
            if n <= len(texts) and sum(n_of) < MOST_SAID:
                n_of[k] = n
    return [text for texts, n in zip(leads, n_of, strict=True) for text in texts[:n]]


def _panels(leading: Sequence[Part]) -> list[Panel]:
    """The figures of the first screen: two of one question, or one of each of two."""
    n = 2 if len(leading) == 1 else 1
    return [panel for page in leading[:2] for panel in page.panels[:n]]


def _provenance(
    study: Study,
    groups: pd.DataFrame,
    lacking: Sequence[Part],
    sources: Mapping[str, str],
    origin: Mapping[str, str],
    law: str,
) -> Section:
    """How the page was made: settings, the engine's `law` if it is one, what has no answer, and the data's origin."""
    settings, units = study.settings, f"{noun(study.unit)}s" + " of one system" * (study.unit == START)
    measured = f"in {settings.units}" if settings.units else "dimensionless"
    texts = [
        f"Statistics use t = {settings.at(settings.t_burn)} to the end of each run. Intervals are"
        f" {100 * settings.confidence:g}% intervals over independent {units}: Wilson for shares and"
        f" survival, jackknife otherwise. Quantities are {measured}. {law}".rstrip(),
        *(f"Not answered: {page.title} {text}" for page in lacking for text in page.lead),
    ]
    notes = [
        "".join(f"{name}: {value}. " for name, value in origin.items()),
        *(f"Code beside the scene: {file} (sha256 {digest})." for file, digest in sources.items()),
        "Findings: report/findings.json. Tables: report/*.parquet. Figures: report/figures/.",
    ]
    # changed copies are in no group
    table = groups.drop(columns="perturbation_size").dropna(axis="columns", how="all")
    table = table.assign(group=[str(place) or label for label, place in places(study).items()])
    alike = [name for name in table if name not in ("group", *COUNTS) and len({*table[name]}) == 1]
    if alike:
        shared = signs(", ".join(f"{name} = {text(table[name].iloc[0])}" for name in alike))
        notes.insert(0, f"{'All settings share' if len(groups) > 1 else 'The setting has'} {shared}.")
        table = table.drop(columns=alike)
    n_copies = len(study.data.table) - len(study.data.table.unchanged)
    return Section(
        "made",
        "How was it made?",
        plural(len(study.data.table), "run") + f", {n_copies:,} of them of changed copies" * bool(n_copies) + ".",
        texts,
        table=data_table("groups", table.rename(columns=CALLED)),
        notes=notes,
    )


def _joined(title: str, about: str) -> str:
    """A scene's title, before what it is about."""
    return f"{title}{' ' if title.endswith('?') else ': '}{about}" if title and about else title or about


def _in_order(study: Study, answered: list[Part]) -> tuple[list[Part], list[Part]]:
    """The answers that lead the page, in their order, and the others in the order of the page."""
    keys = {page.key for page in answered}
    primary = [key for key in study.settings.question if key in keys] or _primary(study, answered)
    leading = [page for key in primary for page in answered if page.key == key] or answered[:1]
    return leading, [page for page in answered if page not in leading]


def _alerts(study: Study, leading: Sequence[Part], others: Sequence[Part]) -> list[str]:
    """The most important alerts: all of the answers that lead, and of the others those that are about the data."""
    alerts = [Alert.of(Code.ONE_SYSTEM)] if study.unit == START else []
    alerts += [alert for page in leading for alert in page.answer.alerts]
    alerts += [alert for page in others for alert in page.answer.alerts if alert.code.rank <= OF_DATA]
    by_subject: dict[object, str] = {}
    for alert in sorted(alerts, key=lambda alert: alert.code.rank):
        by_subject.setdefault(alert.subject, signs(str(alert)))
    return [*by_subject.values()][:MOST_ALERTS]


def _primary(study: Study, answered: Sequence[Part]) -> tuple[str, ...]:
    """Questions that lead where the scene names none: that of the lowest rank that may, and those beside it."""
    ours = {page.key: question(page.key) for page in answered if not is_own(page.key)}
    ranked = [(entry.rank, key) for key, entry in ours.items() if entry.rank is not None and entry.leads(study)]
    if not ranked:
        return ()
    best = min(ranked)[1]
    return (best, *ours[best].beside(study))


def groups_table(study: Study) -> pd.DataFrame:
    """Table of the groups: system, settings of the engine, and numbers of members and matrices."""
    columns: dict[str, tuple[type, Callable[[Group], object]]] = {
        "group": (str, lambda group: group.label),
        "n": (int, lambda group: group.key["n"]),
        **{name: (int, count) for name, count in COUNTS.items()},
        **{name: _of_key(name, name in _TEXTS) for name in SYSTEM_KEYS if name != "n"},
        **{name: _of_key(name, not isinstance(SETTINGS.get(name), Number)) for name in ENGINE_KEYS},
    }
    return frame_by(columns, study.groups)


def _of_key(name: str, is_text: bool) -> tuple[type, Callable[[Group], object]]:
    """The column of a key of groups."""
    if not is_text:
        return float, lambda group: group.key[name]
    return str, lambda group: "" if group.key[name] is None else str(group.key[name])
