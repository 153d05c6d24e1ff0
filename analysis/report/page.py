"""The report: one self-contained HTML page, the same tables as Parquet and JSON, and a headline to print."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from stickslip.analysis.groups import Group, check, fill, groups, windows
from stickslip.analysis.pairs import is_changed, unchanged
from stickslip.analysis.questions.clustering_section import clustering_section
from stickslip.analysis.questions.engines_section import engines_section
from stickslip.analysis.questions.law_section import law_section
from stickslip.analysis.questions.map_section import map_section
from stickslip.analysis.questions.robustness_section import robustness_section
from stickslip.analysis.questions.sensitivity_section import sensitivity_section
from stickslip.analysis.questions.survival_section import TITLE as FATES
from stickslip.analysis.questions.survival_section import survival_section
from stickslip.analysis.report import figures, words
from stickslip.analysis.report.section import LABELS, Data, Recipe, Section, Series
from stickslip.analysis.report.tables import (
    burn_in_table,
    groups_table,
    law_table,
    n_stick_table,
    outcomes_table,
    records,
    sizes_table,
)
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.stats.cascades import DEFINITIONS, SAMPLED, spans

QUESTION = (
    "When blocks held by dry friction let go, do they go in cascades, or as they would if exits and entries came in "
    "random order? What is gamma in the law frequency ∝ exp(−gamma · size)?"
)
MOST_LED = 2  # groups whose cascades the first screen speaks of; the others follow below
N_DRAWS = 3  # draws shown of n_stick(t), as in figure 5 of the paper
LONG = 14  # rows of a table that a reader has to ask for
PAGE = "report.html"  # among the files of a report
SIZES_SHOWN = 12  # rows of the size table on the page; all are in the Parquet file


@dataclass(frozen=True)
class Report:
    """A finished report.

    Attributes
    ----------
    html : str
        The whole page, images inside.
    tables : dict of str to DataFrame
        Every table, with nulls where a column does not apply or a number could not be computed.
    headline : list of str
        The main statements, for a terminal.
    """

    html: str
    tables: dict[str, pd.DataFrame]
    headline: list[str]

    def files(self) -> dict[str, bytes]:
        """What the report consists of, by path: report/<table>.parquet, report/tables.json, report.html.

        The page comes last: written in this order, whoever finds it finds its tables.
        """
        found = {f"report/{name}.parquet": table.to_parquet(index=False) for name, table in self.tables.items()}
        as_json = {name: records(table) for name, table in self.tables.items()}
        found["report/tables.json"] = f"{json.dumps(as_json, indent=1, allow_nan=False)}\n".encode()
        return found | {PAGE: self.html.encode()}


#: Gives a figure as the address of an image.
Image = Callable[[], str]


def on_demand(recipe: Recipe) -> Image:
    """A figure that is drawn when its image is asked for."""
    return lambda: figures.embedded(recipe())


def sections(data: Data, found: list[Group], settings: AnalysisSettings) -> Iterator[Section]:
    """Every question that the data can be asked, answered; `found` are the filled groups of unchanged members."""
    sampled: dict[str, Any] = {"t_burn": settings.t_burn, "confidence": settings.confidence}
    seeded = sampled | {"seed": settings.seed}
    answers: tuple[Callable[[], Section | None], ...] = (
        partial(sensitivity_section, data, **sampled),
        partial(robustness_section, data, margins=settings.margins, **seeded),
        partial(law_section, found, k_min=settings.smallest, confidence=settings.confidence, seed=settings.seed),
        partial(map_section, data, found, dt=settings.map_dt, taus=settings.tau, **seeded),
        partial(clustering_section, data, found, taus=settings.tau, **seeded),
        partial(engines_section, data, found, margins=settings.margins, **sampled),
        partial(survival_section, data, confidence=settings.confidence),
    )
    for answer in answers:
        section = answer()
        if section is not None:
            yield section


def build(
    data: Data,
    settings: AnalysisSettings,
    title: str,
    about: str,
    provenance: Mapping[str, str],
    drawn_by: Callable[[Recipe], Image] = on_demand,
) -> Report:
    """Analyse an ensemble and say what was found.

    Parameters
    ----------
    data : Data
        Members and what they recorded; the `series` of every member that did not fail.
    settings : AnalysisSettings
    title, about : str
        Shown at the head of the page, escaped.
    provenance : mapping of str to str
        What the data came from, shown as given, escaped.
    drawn_by : callable, optional
        Given each figure's recipe as soon as its data are there, returns what gives the image when the page is
        filled: by default it is drawn then.

    Raises
    ------
    ValueError
        If members, series or settings contradict each other, naming the column, member or setting.
    """
    check(data.members, data.series, settings)
    found = groups(unchanged(data.members))  # changed ones are looked at beside these, and pooled with nothing
    for group in found:
        fill(group, data.series, settings)
    tables = {
        "law": law_table(found, settings),
        "groups": groups_table(found),
        "outcomes": outcomes_table(found, settings),
        "n_stick": n_stick_table(found, settings),
        "burn_in": burn_in_table(found, settings),
        "sizes": sizes_table(found, settings),
    }
    rows = {name: records(table) for name, table in tables.items()}
    law = rows["law"]
    trajectories = _trajectories(found, data.series, settings, drawn_by)
    forests = _forests(law, drawn_by)
    distributions = _distributions(found, rows["sizes"], settings, drawn_by)
    answered, images = [], {}
    for section in sections(data, found, settings):
        answered.append(section)
        images[section.title] = [drawn_by(picture.recipe) for picture in section.pictures]
    tables |= {table.name: table.frame for section in answered for table in section.tables}
    answer = {group.label: _answer(group.label, rows, settings) for group in found}
    paper = words.paper_sentence(law)
    leading = _leading(answered, data)
    lead = [line for section in leading for line in section.lead] or _cascade_lead(rows, answered, settings)
    alarms = [line for section in answered for line in section.alarms]
    page = _environment().get_template("report.html")
    html = page.render(
        title=title,
        about=about,
        panels=[] if leading else _panels(found, data.series, rows, settings, drawn_by),
        alerts=_alerts(rows),
        question=" ".join(section.question for section in leading) or QUESTION,
        alarms=alarms,
        lead=lead,
        answer=answer,
        leading=[_rendered(section, images[section.title]) for section in leading],
        sections=[_rendered(section, images[section.title]) for section in answered if section not in leading],
        paper=paper,
        paper_gamma=words.PAPER_GAMMA,
        sampled={
            group.label: words.sentence(words.sampled_sentence([row for row in law if row["group"] == group.label]))
            for group in found
        },
        luck=words.many_rows(sum(row["difference_low"] is not None for row in law), settings.confidence),
        chance=words.chance_check(law),
        law=law,
        rows=rows,
        settings=settings,
        level=words.percent(settings.confidence),
        definitions={name: DEFINITIONS[name] for name in _definitions(law, settings)},
        trajectories=trajectories,
        forests=forests,
        distributions=distributions,
        provenance=provenance,
    )
    return Report(html, tables, [*alarms, title, *lead])


def _definitions(law: Sequence[Mapping[str, Any]], settings: AnalysisSettings) -> list[str]:
    """Every definition of a cascade on the page: those of the law, and by gaps where the scene declares some."""
    return [*dict.fromkeys(row["definition"] for row in law), *(["clusters"] if settings.tau else [])]


def _leading(answered: Sequence[Section], data: Data) -> list[Section]:
    """The sections that answer what the scene is for; none where that is the law of cascades."""
    of_changes = [section for section in answered if section.of_changes]
    of_fates = [section for section in answered if section.title == FATES]
    bases = data.members[~is_changed(data.members)]
    if bases["outcome"].isin(["collapsed", "diverged"]).mean() > 0.5:  # how they ended is what there is to tell
        return of_fates + of_changes
    asks_fates = "growth_rate" in data.members and bool(data.members["growth_rate"].notna().any())
    return of_changes or (of_fates if asks_fates else [])


def _cascade_lead(
    rows: Mapping[str, list[dict[str, Any]]], answered: Sequence[Section], settings: AnalysisSettings
) -> list[str]:
    """Cascades of the largest groups of blocks that have any; of the first of them also what the sections say."""
    events = [row for row in rows["law"] if row["definition"] == "events"]
    drifting = {row["group"] for row in rows["burn_in"] if words.is_drifting(row)}
    known = [row for row in events if row["gamma"] is not None] or events
    largest = [row for row in known if row["n"] == max(row["n"] for row in known)][:MOST_LED]
    lines = []
    for row in largest:
        caveat = "; n_stick drifts after t_burn" if row["group"] in drifting and row["gamma"] is not None else ""
        said = words.law_answer(row) if row["gamma"] is not None else words.events_sentence(row, settings.confidence)
        said = words.sentence(said + caveat)
        lines.append(f"{row['group']}: {said}")
    for section in answered:
        of_group = [line for row in largest for line in section.lead if line.startswith(f"{row['group']}: ")]
        lines += (of_group or list(section.lead))[:1]
    return lines


def _rendered(section: Section, images: Sequence[Image]) -> dict[str, Any]:
    """A section in the plain values that the page is filled with."""
    shown = []
    for table in section.tables:
        rows = records(table.frame)
        if table.columns and rows:
            label = table.columns[0].key if table.columns[0].key in LABELS else None
            columns = table.columns[1:] if label else table.columns
            set_right = [(column, column.is_number(rows)) for column in columns]
            cells = [
                (row[label] if label else None, [(column.text(row), is_number) for column, is_number in set_right])
                for row in rows[: table.max_rows]
            ]
            shown.append(
                {
                    "caption": table.caption,
                    "name": table.name,
                    "heads": [(column.heading, is_number) for column, is_number in set_right],
                    "rows": cells,
                    "is_long": len(cells) > LONG and not table.is_open,
                    "n_more": max(len(rows) - table.max_rows, 0),
                }
            )
    return {
        "title": section.title,
        "question": section.question,
        "statements": section.statements,
        "lead": section.lead,
        "method": section.method,
        "assumptions": section.assumptions,
        "pictures": list(zip(images, section.pictures, strict=True)),
        "tables": shown,
    }


def _answer(label: str, rows: Mapping[str, list[dict[str, Any]]], settings: AnalysisSettings) -> list[str]:
    """The statements on one group, most important first."""
    law = [row for row in rows["law"] if row["group"] == label]
    outcomes = [row for row in rows["outcomes"] if row["group"] == label]
    (mean,) = (row for row in rows["n_stick"] if row["group"] == label)
    (group,) = (row for row in rows["groups"] if row["group"] == label)
    (events,) = (row for row in law if row["definition"] == "events")
    about_runs = words.left_out(outcomes, group["quiet"])
    (moved,) = (row for row in rows["burn_in"] if row["group"] == label)
    if events["gamma"] is None:
        return [words.sentence(f"{words.events_sentence(events, settings.confidence)}; {about_runs}")]
    if mean["mean"] is not None:
        about_runs = f"{words.mean_n_stick(mean)}; {about_runs}"
    found = [words.events_sentence(events, settings.confidence), about_runs]
    if words.is_drifting(moved):
        found.insert(1, f"take gamma with care: n_stick {moved['statement']}")
    return [words.sentence(text) for text in found]


def _panels(
    found: Sequence[Group],
    series: Series,
    rows: Mapping[str, list[dict[str, Any]]],
    settings: AnalysisSettings,
    drawn_by: Callable[[Recipe], Image],
) -> list[tuple[Image, str]]:
    """The first figure, with what it shows: a run, and the law of the groups that the answer speaks of."""
    law = {row["group"]: row for row in rows["law"] if row["definition"] == "events" and row["gamma"] is not None}
    shown = [group for group in found if group.label in law]
    shown = [group for group in shown if group.key["n"] == max(other.key["n"] for other in shown)][:MOST_LED]
    if not shown:
        return []
    _, member_id, win = next(iter(windows(shown[0], series, settings.t_burn)))
    cascades = spans(win)
    largest = int(np.argmax(cascades.size)) if len(cascades.size) else None
    one = None
    if largest is not None:
        one = int(cascades.size[largest]), float(cascades.start[largest]), float(cascades.stop[largest])
    t, n_stick = series[member_id]
    by_size = [
        (group.label, [row for row in rows["sizes"] if row["group"] == group.label and row["definition"] == "events"])
        for group in shown
    ]
    return [
        (drawn_by(partial(figures.one_run, t, n_stick, win.t_stop, settings.t_burn, one)), "n_stick against time"),
        (
            drawn_by(partial(figures.size_law, by_size, [law[group.label] for group in shown])),
            "share of cascades by size, with fit and chance",
        ),
    ]


def _alerts(rows: Mapping[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """What a reader must know before believing the numbers, as facts for the template."""
    n_members = sum(row["n_members"] for row in rows["outcomes"])
    finished = sum(row["n_members"] for row in rows["outcomes"] if row["outcome"] == "finished")
    return {
        "drifts": [row for row in rows["burn_in"] if words.is_drifting(row)],
        "n_groups": len(rows["burn_in"]),
        "few": sorted({row["n_matrices"] for row in rows["n_stick"] if 0 < row["n_matrices"] < words.FEW}),
        "n_members": n_members,
        "n_left_out": n_members - finished,
        "n_failed": sum(row["n_members"] for row in rows["outcomes"] if row["outcome"] == "failed"),
    }


def _trajectories(
    shown: list[Group], series: Series, settings: AnalysisSettings, drawn_by: Callable[[Recipe], Image]
) -> dict[str, Any] | None:
    """n_stick(t) of the first draws for the first group of each n and engine."""
    firsts: dict[tuple[Any, Any], Group] = {}
    for group in shown:
        firsts.setdefault((group.key["n"], group.key["engine"]), group)
    panels = []
    for group in firsts.values():
        one_each = group.members.drop_duplicates("matrix")
        with_series = one_each[[member_id in series for member_id in one_each["member_id"]]].head(N_DRAWS)
        draws = []
        for member_id, matrix, outcome, t_stop in zip(
            *(with_series[name] for name in ("member_id", "matrix", "outcome", "t_stop")), strict=True
        ):
            t, n_stick = series[member_id]
            end = float(t[-1]) if pd.isna(t_stop) else float(t_stop)
            state = "" if outcome == "finished" else f" ({outcome})"
            draws.append((f"matrix {matrix}{state}", t, n_stick, end))
        if draws:
            panels.append((group.label, draws))
    if not panels:
        return None
    left = len(shown) - len(panels)
    caption = (
        f"n_stick, the number of blocks that stick, for the first {N_DRAWS} draws of the matrix. Grey: "
        f"the time before t_burn = {settings.t_burn:g}, which no statistic uses."
    )
    if left:
        caption += f" {words.count(left, 'further group')} not drawn."
    return {"caption": caption, "src": drawn_by(partial(figures.trajectories, panels, settings.t_burn))}


def _forests(law: list[dict[str, Any]], drawn_by: Callable[[Recipe], Image]) -> list[dict[str, Any]]:
    """One figure of gamma for each n that has any."""
    found = []
    for n in sorted({row["n"] for row in law}):
        some = [row for row in law if row["n"] == n]
        if any(row["gamma"] is not None for row in some):
            caption = (
                f"n = {n}: gamma by definition and sampling step, with intervals over matrices; black ticks: "
                "the same definition on the same change times in random order."
            )
            found.append({"caption": caption, "src": drawn_by(partial(figures.forest, some))})
    return found


def _distributions(
    shown: list[Group], sizes: list[dict[str, Any]], settings: AnalysisSettings, drawn_by: Callable[[Recipe], Image]
) -> list[dict[str, Any]]:
    """Figure and table of the sizes in each group that has several; sampled definitions at the first dt."""
    dt = settings.dt[0]
    titles = {name: name if name == "events" else f"{name},\ndt = {dt:g}" for name in ("events", *SAMPLED)}
    found: list[dict[str, Any]] = []
    for group in shown:
        rows = [row for row in sizes if row["group"] == group.label and row["dt"] in (None, dt)]
        seen = Counter(row["definition"] for row in rows if row["n_cascades"])
        if max(seen.values(), default=0) < 2:  # one size by every definition is no distribution
            continue
        events = [row for row in rows if row["definition"] == "events"]
        found.append(
            {
                "label": group.label,
                "src": drawn_by(partial(figures.distributions, rows, titles)),
                "fit": words.sentence(f"events: {words.fit_sentence(events)}"),
                "rows": events[:SIZES_SHOWN],
                "n_more": max(len(events) - SIZES_SHOWN, 0),
            }
        )
    return found


_TEMPLATES = PackageLoader("stickslip.analysis.report", "templates")


def page_environment(*packages: str) -> Environment:
    """Where templates of some packages' pages are found, and how they are filled: escaped, nothing undefined.

    All of them extend `page.html`, which lies here and holds the style.
    """
    return Environment(
        loader=ChoiceLoader([*(PackageLoader(package, ".") for package in packages), _TEMPLATES]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _environment() -> Environment:
    environment = page_environment()
    environment.filters["number"] = words.number
    environment.globals["interval"] = words.interval
    return environment
