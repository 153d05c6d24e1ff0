"""The report: one self-contained HTML page, its tables as Parquet and JSON, its figures as SVG and PDF."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from jinja2 import Environment
from jinja2.runtime import Macro
from markupsafe import Markup, escape

from stickslip.analysis.answer import LONG, F, I, Long, Picture, Recipe, S, Table, frame
from stickslip.analysis.ensemble import Data, Study
from stickslip.analysis.findings.alerts import Alert
from stickslip.analysis.findings.finding import Finding, Lack, Record
from stickslip.analysis.findings.finding import records as finding_records
from stickslip.analysis.findings.numbers import number, with_interval
from stickslip.analysis.findings.words import plural, sentence
from stickslip.analysis.members import ENGINE_KEYS, OPTIONAL, START, SYSTEM_KEYS, TOLERANCES
from stickslip.analysis.questions import QUESTIONS, is_own, package_questions, question, refuse_unknown
from stickslip.analysis.report import AS_TEXT, FORMULA, OF_OWN, PAGE
from stickslip.analysis.report.formats import environment
from stickslip.analysis.report.formats import table as as_table
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.style import pdf, svg
from stickslip.analysis.tables import records
from stickslip.sim.engines import SETTINGS
from stickslip.sim.engines.contract import Number
from stickslip.sim.systems.terms import TERMS

#: What a question's template may lack: macros, and up to which rank its alerts are about the data, so that they are
#: shown whatever question leads; a tick has the last.
OPTIONAL_WORDS = ("lack", "alarm", "alerts", "panels", "panel", "panel_caption", "main", "of_data")
_TICK = 9
MOST_SAID = 3  # answers on the first screen
_ROWS = 10_000  # of a table that is in the JSON of all; a longer one is read from a file of its own
MOST_ALERTS = 3  # in order of rank
_GROUPS: Mapping[str, str] = {
    "group": S, **dict.fromkeys(("n", "matrices", "starts", "members", "finished", "quiet"), I), "coupling": S,
    "file": S, "parameters": S,
    **dict.fromkeys(("belt_speed", "kappa", "rho", "t_end", "perturbation_size"), F),
    **dict.fromkeys((key for key in OPTIONAL if key not in ("file", "parameters")), F), "back_slip": S, "drawn": S,
    **{name: F if isinstance(SETTINGS.get(name), Number) else S for name in ENGINE_KEYS},
}  # fmt: skip


@dataclass(frozen=True)
class Drawn:
    """A drawn figure: the contents of its files in a report; as PDF if it was asked for."""

    svg: str
    pdf: bytes | None = None

    def address(self) -> str:
        """Data URL of the SVG, for an image inside the page; with inline SVGs, ids of two figures would clash."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.svg.encode()).decode('ascii')}"


@dataclass(frozen=True)
class Answered:
    """A question's answer with its figures drawn; made of plain values, so that another process may make it."""

    key: str
    facts: Mapping[str, Any]
    lack: str = ""
    tables: Mapping[str, Table] = field(default_factory=dict)
    figures: Mapping[str, Drawn] = field(default_factory=dict)
    findings: Sequence[Finding] = ()
    n_lead: int = 1
    alerts: Sequence[Alert] = ()
    method: str = ""
    captions: Mapping[str, str] = field(default_factory=dict)
    title: str = ""

    def figure(self, name: str, alt: str) -> Markup:
        """A figure as an image that is part of the page."""
        return Markup('<img src="{}" alt="{}">').format(self.figures[name].address(), alt)


@dataclass(frozen=True)
class Spoken(Answered):
    """An answer in words: of a question of the user's own, made where its code may run.

    Attributes
    ----------
    said : mapping of str to str
        The texts of its macros, by name, and its `name` and `question`.
    sources : mapping of str to str
        The files that it was made by, and the sha256 of each.
    problem : str
        Why there is neither an answer nor a `lack`: what was expected of the function, and what came.
    missing : tuple of str
        Figures, tables and the template, as far as they could not be made, and why, a line each.
    """

    said: Mapping[str, str] = field(default_factory=dict)
    sources: Mapping[str, str] = field(default_factory=dict)
    problem: str = ""
    missing: tuple[str, ...] = ()

    @property
    def words(self) -> SimpleNamespace:
        """Names and macros as those of a template."""
        macros = {name: _saying(text) for name, text in self.said.items() if text}
        needed = dict.fromkeys(("answer", "part", "panel_caption"), _saying(""))
        titles = {name: self.said[name] for name in ("name", "question")}
        return SimpleNamespace(**(dict.fromkeys(OPTIONAL_WORDS) | needed | macros | titles))


def _saying(text: str) -> Callable[..., Markup]:
    return lambda *_: Markup(text)  # made by a template, which escapes


def prepare() -> None:
    """Compile the templates in advance, while a process is idle."""
    filled = environment()
    for name in ("report", *(key for key in QUESTIONS if not question(key).title)):
        filled.get_template(f"{name}.html")


def ask(study: Study, key: str, with_pdf: bool = False) -> Answered | None:
    """Answer to a question of this package; None if such data do not raise it, as one block has no cascades."""
    entry = question(key)
    found = entry.answer(study) if entry.is_asked_of(study) else None
    if found is None:
        return None
    pictures = {
        name: some if isinstance(some, Picture) else Picture(some, "") for name, some in found.figures.items()
    }
    figures = {name: draw(picture.recipe, with_pdf) for name, picture in pictures.items()}
    captions = {name: picture.caption for name, picture in pictures.items()}
    told = found.findings, found.n_lead, found.alerts, found.method or entry.method, captions, entry.title
    lack = "lack" if found.findings and all(isinstance(some, Lack) for some in found.findings) else found.lack
    return Answered(key, found.facts, lack, found.tables, figures, *told)


def draw(recipe: Recipe, with_pdf: bool) -> Drawn:
    """A figure drawn as SVG, and as PDF."""
    figure = recipe()
    return Drawn(svg(figure), pdf(figure) if with_pdf else None)


@dataclass(frozen=True)
class Report:
    """A finished report.

    Attributes
    ----------
    html : str
        The whole page, with its images inside.
    tables : mapping of str to Table
        All tables, with nulls where a column does not apply or a number could not be computed.
    headline : list of str
        The main statements, for a terminal.
    figures : dict of str to Drawn
    problems : dict of str to str
        Why questions of the user's own have no answer, or not all of it, by name.
    not_run : list of str
        Questions of the user's own that were not run.
    """

    html: str
    tables: Mapping[str, Table]
    headline: list[str]
    figures: dict[str, Drawn] = field(default_factory=dict)
    problems: dict[str, str] = field(default_factory=dict)
    not_run: list[str] = field(default_factory=list)

    def files(self) -> dict[str, Callable[[], bytes]]:
        """What makes the contents of each of the report's files, by path: all at once may be large.

        The page comes last: once it exists, all that it names exists.
        """
        made: dict[str, Callable[[], bytes]] = {}
        for name, table in self.tables.items():
            made[f"report/{name}.parquet"] = partial(_parquet, table)
            if not isinstance(table, Long) and len(table) <= LONG:
                made[f"report/{name}.csv"] = partial(_csv, table)
        made["report/tables.json"] = partial(_json, self.tables)
        for name, drawn in self.figures.items():
            made[f"report/figures/{name}.svg"] = drawn.svg.encode
            if drawn.pdf is not None:
                made[f"report/figures/{name}.pdf"] = partial(bytes, drawn.pdf)
        return made | {PAGE: self.html.encode}

    def gone(self) -> list[str]:
        """Files that a report which listed none may have, and this one lacks, by path."""
        return [f"report/figures/{name}.pdf" for name, drawn in self.figures.items() if drawn.pdf is None]


def _parquet(table: Table) -> bytes:
    written = pa.BufferOutputStream()
    writer: pq.ParquetWriter | None = None
    for part in table if isinstance(table, Long) else [table]:
        rows = pa.Table.from_pandas(part, preserve_index=False)
        writer = writer or pq.ParquetWriter(written, rows.schema)
        writer.write_table(rows)
    assert writer is not None  # a table that is long has a part
    writer.close()
    return written.getvalue().to_pybytes()


def _csv(table: pd.DataFrame) -> bytes:
    plain = table.astype(dict.fromkeys(table.select_dtypes("category"), object))
    return str(plain.replace(FORMULA, AS_TEXT, regex=True).to_csv(index=False)).encode()


def _json(tables: Mapping[str, Table]) -> bytes:
    """Tables of up to `_ROWS` rows as JSON lists of rows, one row a line."""
    encode = json.JSONEncoder(allow_nan=False).encode
    listed = []
    for name, table in tables.items():
        if not isinstance(table, Long) and len(table) <= _ROWS:
            rows = ",\n".join(map(encode, records(table)))
            listed.append(f"{encode(name)}: [\n{rows}\n]")
    return ("{\n" + ",\n".join(listed) + "\n}\n").encode()


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
    data : Data
        The members and their records; `series` of every member that did not fail.
    settings : AnalysisSettings
    title, about : str
        Shown at the head of the page, escaped.
    provenance : mapping of str to str
        Where the data come from, shown as given, escaped.
    answers : callable, optional
        Returns what `ask` returns for each question of this package that is asked, in their order, and a `Spoken`
        for each of the user's own that was run; default: asks the former one after the other.
    made_from : str, optional
        Digest of all this, kept at the head of the page.

    Raises
    ------
    ValueError
        If members, series or settings contradict each other; names the column, member or setting.
    """
    refuse_unknown(settings.question)
    study = Study(data, settings)
    made = [ask(study, key) for key in package_questions(settings.question)] if answers is None else answers(study)
    own = {one.key: one for one in made if isinstance(one, Spoken)}
    problems = {key: one.problem for key, one in own.items() if one.problem}
    missing = {key: "; ".join(one.missing) for key, one in own.items() if one.missing}
    not_run = [key for key in settings.question if is_own(key) and key not in own]
    found = [one for one in made if one is not None and one.key not in problems]
    groups = groups_table(study)
    filled = environment()
    filled.globals["unit"] = study.unit
    shown = [_shown(filled, one) for one in found]
    leading, others = _in_order(study, [one for one in shown if not one.lack])
    if leading and leading[0].key in own:  # the page is the user's
        title, about = leading[0].words.name, _joined(title, about)
    said = [one.says(one.words.answer) for one in leading[:MOST_SAID]]
    alarms = [text for one in (*leading, *others) if (text := one.says(one.words.alarm))]
    raised = {one.key for one in shown}
    page = filled.get_template("report.html").render(
        title=title,
        about=about,
        leading=leading,
        leading_answers=_safe(said),
        answered=[*leading, *others],
        lacking=[one for one in shown if one.lack],
        asked_in_vain=[one for one in shown if one.lack and one.key in settings.question],
        not_raised=[_words(filled, key) for key in settings.question if not is_own(key) and key not in raised],
        problems=problems,
        missing=missing,
        not_run=not_run,
        mark_of_own=Markup(OF_OWN),
        sources={file: digest for one in own.values() for file, digest in one.sources.items()},
        alarms=_safe(alarms),
        alerts=_safe(_alerts(leading, [one for one in shown if one not in leading])),
        primary=[one.words.name for one in leading],
        settings=settings,
        members=len(data.table),
        groups=records(groups),
        group_columns=group_columns(),
        provenance=provenance,
        made_from=made_from,
    )
    tables = {"groups": groups} | {name: table for one in found for name, table in one.tables.items()}
    figures = {name: drawn for one in found for name, drawn in one.figures.items()}
    headline = [*(plain(text) for text in alarms), title, *(plain(text) for text in said)]
    return Report(page, tables, headline, figures, problems | missing, not_run)


def _joined(title: str, about: str) -> str:
    """A scene's title, before what it is about."""
    return f"{title}{' ' if title.endswith('?') else ': '}{about}" if title and about else title or about


def _words(filled: Environment, key: str) -> SimpleNamespace:
    """The names and macros of a question's template; None for each of `OPTIONAL_WORDS` that it lacks."""
    title = question(key).title
    words = {"name": title} if title else vars(filled.get_template(f"{key}.html").module)
    return SimpleNamespace(**(dict.fromkeys(OPTIONAL_WORDS) | words))


@dataclass(frozen=True)
class _Shown(Answered):
    """An answer with the words of its template."""

    words: SimpleNamespace = field(default_factory=SimpleNamespace)

    def says(self, macro: Macro | None) -> str:
        """Text of a macro of the template on the facts; empty if the template lacks the macro."""
        return "" if macro is None else str(macro(self.facts)).strip()


def _shown(filled: Environment, one: Answered) -> _Shown:
    words = _of_findings(one) if one.findings else one.words if isinstance(one, Spoken) else _words(filled, one.key)
    return _Shown(one.key, one.facts, one.lack, one.tables, one.figures, words=words)


def _of_findings(one: Answered) -> SimpleNamespace:
    """The words of an answer that consists of findings, in the form of those of a template."""
    names = [*one.figures]
    shown = _figures(one, names[:2])
    rows = [record for finding in one.findings for record in finding_records(finding)]
    table = _findings_table(rows) if rows else Markup("")
    part = Markup("<p>{}</p>").format(one.method) + _figures(one, names[2:])
    texts = {
        "answer": escape(" ".join(sentence(finding) for finding in one.findings[: one.n_lead])),
        "lack": escape(" ".join(sentence(finding) for finding in one.findings)),
        "alerts": Markup("\n").join(
            Markup('<li data-rank="{}">{}</li>').format(alert.code.rank, str(alert)) for alert in one.alerts
        ),
        "panels": shown, "main": table, "part": part, "panel_caption": "",
    }  # fmt: skip
    macros = {name: _saying(text) for name, text in texts.items()}
    titles = {"name": one.title, "question": one.title, "of_data": 1}
    return SimpleNamespace(**(dict.fromkeys(OPTIONAL_WORDS) | macros | titles))


def _figures(one: Answered, names: Sequence[str]) -> Markup:
    return Markup("").join(
        Markup('<figure class="one">{}<figcaption>{}</figcaption></figure>').format(
            one.figure(name, one.captions[name]), one.captions[name]
        )
        for name in names
    )


def _findings_table(rows: Sequence[Record]) -> Markup:
    """The table of findings, whose columns are left out where they hold nothing."""
    shown = [
        {
            "what": row.quantity,
            "where": row.setting or None,
            "estimate": None if row.estimate is None else with_interval(Estimate(*row[2:5]), row.form),
            "compared with": row.compared_with or None,
            "difference": row.difference and number(row.difference),
            "verdict": row.verdict or None,
            "from": None if row.n is None else plural(row.n, row.unit),
        }
        for row in rows
    ]
    return as_table(shown, [(name, name, None) for name in shown[0]], kind="stack")


def _in_order(study: Study, answered: list[_Shown]) -> tuple[list[_Shown], list[_Shown]]:
    """The answers that lead the page, in their order, and the others in the order of the page."""
    known = {one.key for one in answered}
    primary = [key for key in study.settings.question if key in known] or _primary(study, answered)
    leading = [one for key in primary for one in answered if one.key == key] or answered[:1]
    return leading, [one for one in answered if one not in leading]


def _alerts(leading: Sequence[_Shown], others: Sequence[_Shown]) -> list[str]:
    """The most important alerts, as list items: all of the answers that lead, and those of data of the others."""
    warned = [(item, _TICK) for one in leading for item in _items(one)]
    warned += [(item, one.words.of_data) for one in others if one.words.of_data for item in _items(one)]
    return sorted(dict.fromkeys(item for item, upto in warned if _rank(item) <= upto), key=_rank)[:MOST_ALERTS]


def _items(one: _Shown) -> list[str]:
    return re.findall(r"<li.*?</li>", one.says(one.words.alerts), re.DOTALL)


def _rank(alert: str) -> int:
    """Rank of an alert, as its template gives it; a tick has none and comes last."""
    given = re.match(r'<li data-rank="(\d)"', alert)
    return int(given[1]) if given else _TICK


def _safe(texts: Sequence[str]) -> list[Markup]:
    return [Markup(text) for text in texts]  # made by templates, which escape


def plain(text: str) -> str:
    """Text of a template's result without tags, for a terminal."""
    return html.unescape(re.sub(r"\s+", " ", re.sub(r"<[^>]*>", "", text.replace("<sub>", "_")))).strip()


def _primary(study: Study, answered: Sequence[_Shown]) -> tuple[str, ...]:
    """Questions that lead where the scene names none: that of the lowest rank that may, and those beside it."""
    ours = {one.key: question(one.key) for one in answered if not is_own(one.key)}
    ranked = [(one.rank, key) for key, one in ours.items() if one.rank is not None and one.leads(study)]
    if not ranked:
        return ()
    first = min(ranked)[1]
    return (first, *ours[first].beside)


def group_columns() -> list[tuple[str, str, str | None]]:
    """Columns of the table of groups: heading, key, and how values are shown; the page leaves out empty ones."""
    titles = {term.name: term.title for term in TERMS}
    of_system = [name for name in SYSTEM_KEYS if name in titles]
    return [
        *((name, name, None) for name in ("group", "coupling")),
        *((titles[name], name, "g") for name in of_system),
        ("back slip", "back_slip", None),
        ("drawn", "drawn", None),
        *((name, name, "g") for name in ("t_end", *TOLERANCES)),
        *((name, name, None) for name in ("file", "parameters")),
        *((name, name, "n") for name in ("members", "matrices", "starts")),
    ]


def groups_table(study: Study) -> pd.DataFrame:
    """Table of the groups: system, settings of the engine, and numbers of members and matrices."""
    texts = {column for column, dtype in _GROUPS.items() if dtype == S}
    rows = []
    for group in study.groups:
        key = {name: str(v) if name in texts and v is not None else v for name, v in group.key.items()}
        rows.append(
            key
            | {
                "group": group.label,
                "members": len(group),
                "matrices": group.column("matrix").nunique(),
                "starts": group.column("unit").nunique() if group.unit == START else None,
                "finished": int(group.is_finished.sum()),
                "quiet": group.n_quiet,
            }
        )
    return frame(_GROUPS, rows)
