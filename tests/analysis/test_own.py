"""Questions of a user's own: planted answers on the page, laid out or in a template's words, and what is refused."""

import re
import sys
from dataclasses import replace
from functools import partial
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from scipy import stats

from stickslip.analysis import Answer, Data, Estimate, Study, build, named, panel, wilson, with_interval
from stickslip.analysis.answer import Picture
from stickslip.analysis.ensemble import Recorded
from stickslip.analysis.findings.finding import Level, Quantity
from stickslip.analysis.questions import BESIDE_SCENES, QUESTIONS, RENAMED, refuse_unknown, renamed
from stickslip.analysis.report.own import OwnError, spoken
from stickslip.analysis.report.page import Spoken, ask
from tests.analysis.reports import contents

KEY = "own:question"
DOC = """How   long is it?

A length is
measured.

It is not a time."""


@pytest.fixture
def study(planted, settings):
    """Five matrices; each run has a number, its matrix."""
    members, series = planted.ensemble({"coulomb": 0.7}, 5, n_steps=400)
    object.__setattr__(settings, "question", (KEY, "cascades"))
    return Study(Data(members, series), settings)


@panel()
def drawn(ax, y):
    ax.plot(y)


def answered(rng):
    """An answer, with the number that it states."""
    value = float(rng.uniform(0.1, 0.9))
    length = Estimate(value, value - 0.05, value + 0.05)
    rows = pd.DataFrame([{"name_of": "a<b", **named("length", length), "n_runs": 5, "at": 0.25, "is_long": True}])
    facts = {"sentence": f"It is {with_interval(length)} &\x1b -1\n<long>.", "caption": "A line."}
    return Answer(facts, tables={"lengths": rows}, figures={"line": partial(drawn, [1, 2])}), value


def page_of(study, *own):
    """The report in which these questions are answered beside ours."""
    answers = [*(ask(study, key) for key in QUESTIONS), *own]
    return build(study.data, study.settings, "Title", "About it.", {}, lambda _: answers)


def shown(page):
    return re.sub(r'src="data:[^"]*"', 'src=""', page.partition("<h1>")[2])


@pytest.mark.usefixtures("undrawn")
def test_a_planted_answer_leads_the_page(study, rng):
    found, value = answered(rng)
    report = page_of(study, spoken(study, KEY, found, DOC, None, told))
    page = shown(report.html)
    first, figure, table, rest = (
        page.index(one) for one in ("&amp; \u22121 &lt;long&gt;.</li>", "<figcaption>A line.", "a&lt;b", "<nav>")
    )
    assert page.startswith("How long is it?</h1>")
    assert '<p class="question">Title: About it.</p>' in page
    assert 0 < page.index(f"It is {value:.3f} ({value - 0.05:.3f} to {value + 0.05:.3f})") < first
    assert first < figure < table < rest
    assert "<figure" not in page[: figure - 200]
    shown_table = page[page.rindex("<table", 0, table) :].partition("</table>")[0]
    heads = re.findall(r"<th(?: [^>]*)?>(.*?)</th>", shown_table)
    assert heads == ["name of", "length", "interval", "n runs", "at", "is long"]
    cells = re.findall(r"<td[^>]*>(.*?)</td>", shown_table)
    assert cells == ["a&lt;b", f"{value:.3f}", f"{value - 0.05:.3f} to {value + 0.05:.3f}", "5", "0.25", "yes"]
    part = page[page.index('<details id="own:question">') :].partition("</details>")[0]
    assert re.findall(r"<p>(.*?)</p>", part) == ["A length is measured.", "It is not a time."]
    assert "Kept as report/own-question-lengths.parquet and report/figures/own-question-line.svg." in part
    assert report.headline[:2] == [
        "How long is it?",
        f"It is {with_interval(Estimate(value, value - 0.05, value + 0.05))} & \u22121 <long>.",
    ]
    assert {"own-question-lengths"} <= set(report.tables)
    assert {"report/own-question-lengths.parquet", "report/figures/own-question-line.svg"} <= set(contents(report))
    assert report.problems == {}
    assert report.not_run == []


@pytest.mark.usefixtures("undrawn")
def test_it_stands_where_the_scene_asks_it(study, rng):
    object.__setattr__(study.settings, "question", ("cascades", KEY))
    found, _ = answered(rng)
    page = shown(page_of(study, spoken(study, KEY, found, DOC, None, told)).html)
    assert page.startswith("Title</h1>")
    said = re.findall(r"<li>(.*?)</li>", page.partition('<ul class="answer">')[2].partition("</ul>")[0], re.DOTALL)
    assert said[1].startswith("It is ")
    assert len(said) == 2
    part = page[page.index('<details id="own:question">') :].partition("</details>")[0]
    assert "<figure" in part
    assert "a&lt;b" in part


@pytest.mark.usefixtures("undrawn")
def test_a_template_has_the_words_and_escapes(study, rng, tmp_path):
    (tmp_path / "beside.html").write_text("{% macro twice(x) %}{{ x }}{{ x }}{% endmacro %}")
    (tmp_path / "question.html").write_text(
        '{% import "beside.html" as beside %}{% set name = "How <wide>?" %}'
        "{% macro answer(a) %}{{ beside.twice(a.word) }} at {{ a.mean|with_interval }} over {{ unit|plural }}"
        "{% endmacro %}"
        '{% macro panel(a, figure) %}{{ figure("line", a.word) }}{% endmacro %}'
        '{% macro alerts(a) %}<li data-rank="1">{{ a.word }} beware</li>{% endmacro %}'
    )
    found, _ = answered(rng)
    own = Answer({"word": "<i>'&", "mean": Estimate(2.0, 1.0, 3.0)}, tables=found.tables, figures=found.figures)
    page = shown(page_of(study, spoken(study, KEY, own, DOC, tmp_path / "question.html", told)).html)
    assert page.startswith("How &lt;wide&gt;?</h1>")
    assert "<li>&lt;i&gt;&#39;&amp;&lt;i&gt;&#39;&amp; at 2.00 (1.00 to 3.00) over matrices</li>" in page
    assert 'alt="&lt;i&gt;&#39;&amp;"' in page
    assert "&lt;i&gt;&#39;&amp; beware</li>" in page
    assert "<i>&" not in page
    assert "<i>'" not in page
    assert "a&lt;b" in page  # the table, of which the template says nothing


@pytest.mark.usefixtures("undrawn")
def test_no_answer_is_a_line_and_the_page_stands(study):
    lacking = spoken(study, KEY, Answer(lack="No run is <long>."), DOC, None, told)
    failed = Spoken("own:other", {}, problem="expected <this>, got that")
    object.__setattr__(study.settings, "question", (KEY, "own:other", "own:third"))
    report = page_of(study, lacking, failed)
    page = shown(report.html)
    assert page.startswith("Title</h1>")
    assert "Asked, but not answered: How long is it? No run is &lt;long&gt;.</p>" in page
    assert "Asked, but not answered: own:other: expected &lt;this&gt;, got that.</p>" in page
    assert (
        "own:third was not run; <code>stickslip report DIR --own</code> runs the code beside the scene.</p>" in page
    )
    assert report.problems == {"own:other": "expected <this>, got that"}
    assert report.not_run == ["own:third"]
    asked_nothing = build(study.data, study.settings, "Title", "", {})
    assert asked_nothing.not_run == [KEY, "own:other", "own:third"]


def shortest(study):
    """How short is it?

    It is measured,
    twice."""
    length = Level(Quantity("length", "least length"), Estimate(0.25, 0.2, 0.3))
    return Answer(findings=(length,), figures={"lengths": Picture(partial(drawn, [1, 2]), "A line.")})


@pytest.mark.usefixtures("undrawn")
def test_a_question_beside_a_scene_that_ships_is_always_run_where_it_is_named(study, monkeypatch):
    module = module_from_spec(ModuleSpec(f"{BESIDE_SCENES}planted", None))
    module.shortest, module.nothing = shortest, lambda _: None
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(RENAMED, "planted", f"{module.__name__}:shortest")
    names = renamed(["planted", f"{module.__name__}:nothing"])
    assert names == (f"{module.__name__}:shortest", f"{module.__name__}:nothing")
    object.__setattr__(study.settings, "question", names)
    report = build(study.data, study.settings, "Title", "About it.", {})
    page = shown(report.html)
    assert page.startswith("Title</h1>")
    assert "How short is it?" in page
    assert "<p>It is measured, twice.</p>" in page
    assert report.headline == ["Title", "Least length: 0.250 (0.200 to 0.300)."]
    assert set(report.figures) >= {"lengths"}
    assert report.not_run == []
    refuse_unknown(["planted", *names])
    for wrong in (f"{module.__name__}:shorter", f"{BESIDE_SCENES}other:shortest"):
        with pytest.raises(ValueError, match=f"question: expected .* or module:function, got '{wrong}'"):
            refuse_unknown([wrong])
    assert names[0] not in {answer.key for answer in map(partial(ask, study), QUESTIONS) if answer}


def told(error, expected):
    """An error in a line, as the process of a question puts it."""
    return f"{error} for {expected}"


def figure_of_nothing():
    return 3


S = {"sentence": "Yes."}


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (None, r"expected a stickslip.analysis.Answer, got None; return Answer\(lack='why'\)"),
        ("It is long.", r"expected a stickslip.analysis.Answer, got a str; return one"),
        (Answer(), r"facts\['sentence'\]: expected a text, .*, got facts of nothing; add it, or .* of a template"),
        (Answer({"mean": 3}), r"facts\['sentence'\]: .*, got facts of mean"),
        (Answer({"sentence": 3}), r"facts\['sentence'\]: .*, got a int"),
        (Answer({"sentence": "Yes.", "caption": 3}), r"facts\['caption'\]: expected a text, .*, got a int"),
        (Answer("Yes."), r"facts: expected a dictionary, got a str"),
        (Answer(S, lack=3), r"lack: expected text, got a int"),
        (Answer(S, tables=pd.DataFrame()), r"tables: expected a dictionary, got a DataFrame"),
        (Answer(S, tables={"a/b": pd.DataFrame()}), r"tables: expected names of letters, .*, got 'a/b'; rename it"),
        (Answer(S, figures={"..": 3}), r"figures: expected names of letters, digits and underscores, got '\.\.'"),
    ],
)
def test_what_is_no_answer_is_refused(study, found, words):
    with pytest.raises(OwnError, match=words):
        spoken(study, KEY, found, DOC, None, told)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (Answer(S, tables={"a": [1]}), r"tables\['a'\]: expected a pandas.DataFrame, got a list"),
        (Answer(S, tables={"a": pd.DataFrame([[1]])}), r"tables\['a'\]: expected columns with different names, got"),
        (Answer(S, tables={"a": pd.DataFrame({"x": [1, "b"]})}), r"tables\['a'\]: column 'x': .*, got int, str"),
        (Answer(S, tables={"a": pd.DataFrame({"x": [[1]]})}), r"tables\['a'\]: column 'x': .*, got list"),
        (Answer(S, tables={"a": pd.DataFrame({"x": [np.inf]})}), r"expected finite numbers, got inf; write None"),
        (Answer(S, figures={"a": figure_of_nothing}), r"figures\['a'\]: expected a matplotlib Figure, .*, got a int"),
    ],
)
def test_a_figure_or_table_that_cannot_be_shown_is_left_out(study, found, words):
    made = spoken(study, KEY, found, DOC, None, told)
    assert made.said["answer"] == "Yes."
    (line,) = made.missing
    assert re.search(words, line), line
    assert not made.tables
    assert not made.figures


def leaves():
    raise SystemExit(0)


def test_foreign_bytes_stay_out_of_page_and_files(study):
    figure = Figure()
    figure.suptitle("a\x00\x1b[31m")
    words = pd.Series(["a\ud800\x07"], dtype=object)
    table = pd.DataFrame({"x\x1b": words, "x\x1b_low": [1.0], "x\x1b_high": [2.0], "is": [True], "is_low": [0.1]})
    found = Answer(S, tables={"t": table}, figures={"f": figure, "left": leaves})
    made = spoken(study, KEY, found, DOC, None, told)
    (line,) = made.missing
    assert line.startswith("figures['left']: ")
    report = page_of(study, made, spoken(study, "own:other", Answer(lack="why\ud800\x1b"), "", None, told))
    for content in contents(report).values():
        assert not {0x00, 0x1B} & {*content} or content[:4] == b"PAR1"
    assert report.tables["own-question-t"].iloc[0, 0] == "a"
    with pytest.raises(OwnError, match="at most 40 letters, got aaa"):
        spoken(study, KEY, Answer(S, figures={"a" * 250: figure}), DOC, None, told)


def test_a_figure_may_be_one_that_is_drawn_already(study):
    figure = Figure()
    figure.subplots().plot([1, 2])
    made = spoken(study, KEY, Answer(S, figures={"line": figure}), "", None, told)
    assert made.figures["own-question-line"].svg.lstrip().startswith("<?xml")
    assert made.said["name"] == KEY  # it has no docstring


def test_numbers_of_a_table_have_nulls_and_a_named_index_stays(study):
    given = pd.DataFrame(
        {"x": [1.5, np.nan], "k": [3, 4], "t": [None, "b"], "none": [None, None], "is": [np.True_, None]},
        index=pd.Index([10, 20], name="belt"),
    )
    made = spoken(study, "a.b:c", Answer(S, tables={"t": given}), DOC, None, told).tables["a.b-c-t"]
    assert {name: str(dtype) for name, dtype in made.dtypes.items()} == {
        "belt": "Int64", "x": "Float64", "k": "Int64", "t": "string", "none": "string", "is": "boolean",
    }  # fmt: skip
    assert made.isna().sum().to_dict() == {"belt": 0, "x": 1, "k": 0, "t": 1, "none": 2, "is": 1}


def test_a_mean_and_a_share_have_intervals_over_matrices(study, rng):
    """The t interval of the means of matrices, and Wilson's; a run without a number is in neither."""
    (group,) = study.groups
    names = list(group.members["member_id"])
    numbers = dict(zip(names, rng.normal(3.0, 1.0, 5).tolist(), strict=True)) | {names[0]: None}
    known = np.array([numbers[name] for name in names[1:]])
    found = study.mean(group, numbers)
    half = stats.t.ppf(0.975, 3) * known.std(ddof=1) / 2
    np.testing.assert_allclose([found.value, found.low, found.high], known.mean() + half * np.array([0, -1, 1]))
    assert study.mean(group, {names[1]: 2.0}).reason == "one matrix"
    recorded = {"speed": Recorded("a speed", numbers, least=found.value)}
    by_name = Study(replace(study.data, recorded=recorded), study.settings).mean(group, "speed")
    assert (by_name.value, by_name.low, by_name.high) == (found.value, found.value, found.high)
    with pytest.raises(
        ValueError, match=r"numbers: expected a number that a record keeps \(there is none\), got 'sped'"
    ):
        study.mean(group, "sped")
    assert study.mean(group, {names[1]: float("nan")}).reason == "no matrix has data"
    has = {name: k == 2 for k, name in enumerate(names)} | {names[0]: None}
    share = study.share(group, has)
    assert (share.value, share.low, share.high) == (0.25, *wilson(1, 4, 0.95))
    assert study.share(group, {}).reason == "no run has data"
