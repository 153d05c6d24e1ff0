"""Questions of a user's own: planted answers on the page, and what is refused."""

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

from stickslip.analysis import (
    Alert,
    Answer,
    Basis,
    Code,
    Comparison,
    Difference,
    Estimate,
    Lack,
    Level,
    Lifetime,
    Outcomes,
    Picture,
    Quantity,
    Reason,
    Study,
    build,
    named,
    panel,
    wilson,
)
from stickslip.analysis.ensemble import Recorded
from stickslip.analysis.findings.finding import Family
from stickslip.analysis.page.own import OwnError, own_answer
from stickslip.analysis.page.parts import Answered, ask
from stickslip.analysis.questions import BESIDE_SCENES, QUESTIONS, RENAMED, refuse_unknown, renamed
from tests.analysis.designs import Data
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


LENGTH = Quantity("length", "length of <it>")


def answered(rng):
    """An answer, with the number that it states."""
    value = float(rng.uniform(0.1, 0.9))
    length = Estimate(value, value - 0.05, value + 0.05)
    rows = pd.DataFrame([{"name_of": "a<b", **named("length", length), "n_runs": 5, "at": 0.25, "is_long": True}])
    answer = Answer(
        findings=[Level(LENGTH, length, "x\x1b = -1\n<long>", basis=Basis(5)), Level(LENGTH, length, "x = 1")],
        alerts=[Alert.of(Code.FEW, n=5, units="<runs>")],
        paragraph="It is not\n<wide>.",
        tables={"lengths": rows},
        figures={"line": Picture(partial(drawn, [1, 2]), "A <line>.")},
    )
    return answer, value


def own(given, key=KEY, doc=DOC):
    """What `own_answer` makes of an answer of a function with a docstring."""

    def question(study):
        return given

    question.__doc__ = doc
    return own_answer(key, question, given, told)


def page_of(study, *own):
    """The report in which these questions are answered beside ours."""
    answers = [*(ask(study, key) for key in QUESTIONS), *own]
    return build(study.data, study.settings, "Title", "About it.", {}, lambda _: answers)


def shown(page):
    return re.sub(r'src="data:[^"]*"', 'src=""', page.partition("<h1>")[2])


@pytest.mark.usefixtures("undrawn")
def test_a_planted_answer_leads_the_page(study, rng):
    found, value = answered(rng)
    report = page_of(study, own(found))
    page = shown(report.html)
    said = f"{value:.3f} ({value - 0.05:.3f} to {value + 0.05:.3f})"
    assert page.startswith("How long is it?</h1>")
    assert '<p class="about">Title: About it.</p>' in page
    places = [
        page.index(text)
        for text in (
            f"Length of &lt;it&gt;, x = \u22121 &lt;long&gt;: {said}.",
            "It is not &lt;wide&gt;.",
            "<figcaption>A &lt;line&gt;.",
            "5\u00a0systems", "5 &lt;runs&gt;: intervals are wide", '<details id="own:question">',
            "A length is measured. It is not a time.", "a&lt;b",
        )
    ]  # fmt: skip
    assert places == sorted(places)
    part = page[places[-3] :].partition("</details>")[0]
    heads = re.findall(r"<th(?: [^>]*)?>(.*?)</th>", part)
    assert heads == ["name of", "length", "n runs", "at", "is long"]
    cells = re.findall(r"<td[^>]*>(.*?)</td>", part)
    assert cells == ["a&lt;b", said, "5", "0.25", "yes"]
    assert "<long>" not in page + "<wide>" + "<it>"
    assert report.headline[:2] == ["How long is it?", f"Length of <it>, x = \u22121 <long>: {said}."]
    assert {"own-question-lengths"} <= set(report.tables)
    assert {"report/own-question-lengths.parquet", "report/figures/own-question-line.svg"} <= set(contents(report))
    assert report.problems == {}


@pytest.mark.usefixtures("undrawn")
def test_it_stands_where_the_scene_asks_it(study, rng):
    object.__setattr__(study.settings, "question", ("cascades", KEY))
    page = shown(page_of(study, own(answered(rng)[0])).html)
    assert page.startswith("Title</h1>")
    said = re.findall(r'<p class="lead">(.*?)</p>', page, re.DOTALL)
    assert any(text.startswith("Length of ") for text in said)
    assert len(said) <= 3
    assert page.index("A &lt;line&gt;.") < page.index("<details") < page.index("a&lt;b")


@pytest.mark.usefixtures("undrawn")
def test_no_answer_is_a_line_and_the_page_stands(study):
    lacking = own(Answer(findings=[Lack("the <length>", Reason.NO_MOTION)]))
    failed = Answered("own:other", {}, problem="expected <this>, got that")
    object.__setattr__(study.settings, "question", (KEY, "own:other", "own:third"))
    report = page_of(study, lacking, failed)
    page = shown(report.html)
    assert page.startswith("Title</h1>")
    assert "Asked but not answered: How long is it? The &lt;length&gt;: no run is in motion.</p>" in page
    (*said,) = re.findall(r'<p class="lead">(.*?)</p>', page)
    assert said[0] == "The answer to own:other: its code failed (expected &lt;this&gt;, got that)."
    assert len(said) > 1, "then what was answered"
    (lack,) = [finding for finding in report.findings["findings"] if finding["question"] == "own:other"]
    assert (lack["leads"], lack["kind"]) == (True, "Lack")
    assert "own:third was not run; stickslip report DIR --own runs the code beside the scene.</p>" in page
    assert report.problems == {"own:other": "expected <this>, got that"}
    asked_nothing = build(study.data, study.settings, "Title", "", {})
    for key in (KEY, "own:other", "own:third"):
        assert f"{key} was not run" in shown(asked_nothing.html)


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


SIZE = Quantity("size", "size")
YES = Level(SIZE, Estimate(3.0))
A = partial(Answer, findings=[YES])


@pytest.mark.parametrize(("found", "words"), [
    (None, r"expected a stickslip.analysis.Answer, got None; if .* return Answer\(findings=\[Lack\("),
    ("It is long.", r"expected a stickslip.analysis.Answer, got a str; return Answer\(findings=\[Level\("),
    (Answer(), r"findings: expected the answer first, got none; return Answer\(findings=\[Level\("),
    (Answer({"sentence": "Yes."}), r"findings: expected a list, got a dict; write"),
    (Answer(findings=YES), r"findings: expected a list, got a Level; write"),
    (A(n_lead=4), r"n_lead: expected 1 to 3, got 4; correct it"),
    (Answer(findings=["Yes."]), r"findings\[0\]: expected Level or Change or .*, got a str"),
    (Answer(findings=[YES, Level("size", Estimate(3.0))]), r"\[1\].quantity: expected Quantity, got a str"),
    (Answer(findings=[Level(SIZE, 3.0)]), r"findings\[0\].estimate: expected Estimate, got a float"),
    (Answer(findings=[Level(SIZE, Estimate())]), r"\[0\].estimate: expected a value, got Estimate\(no .* a Lack"),
    (Answer(findings=[Level(SIZE, Estimate(np.inf))]), r"estimate.value: expected a finite number, got inf"),
    (Answer(findings=[Lack("it", "why")]), r"findings\[0\].reason: expected Reason, got a str"),
    (Answer(findings=[Level(SIZE, Estimate(3.0), basis=Basis(True))]), r"n: expected an integer, got a bool"),
    (Answer(findings=[Level(SIZE, Estimate(3.0), 4)]), r"findings\[0\].where: expected Place, got an int"),
    (Answer(findings=[Outcomes("it", "h")]), r"findings\[0\].equal: expected a list, got a str"),
    (A(alerts=["!"]), r"alerts\[0\]: expected an Alert, got a str; write Alert.of\(Code.FEW, n=3"),
    (A(alerts=[Alert.of(Code.FEW, n=3)]), r"alerts\[0\]: expected the numbers of '.*', got 'units'; add them"),
    (A(paragraph=3), r"paragraph: expected a text, got an int"),
    (A(tables=pd.DataFrame()), r"tables: expected a dictionary, got a DataFrame"),
    (A(tables={"a/b": pd.DataFrame()}), r"tables: expected names of letters, .*, got 'a/b'; rename it"),
    (A(figures={"..": 3}), r"figures: expected names of letters, digits and underscores, got '\.\.'"),
    (A(figures={"a" * 250: 3}), r"figures: expected names of at most 40 letters, got aaa.*; shorten it"),
])  # fmt: skip
def test_what_is_no_answer_is_refused(found, words):
    with pytest.raises(OwnError, match=words):
        own(found)


@pytest.mark.parametrize(("found", "words"), [
    (A(tables={"a": [1]}), r"tables\['a'\]: expected a pandas.DataFrame, got a list"),
    (A(tables={"a": pd.DataFrame([[1]])}), r"tables\['a'\]: expected columns with different names, got"),
    (A(tables={"a": pd.DataFrame({"x": [1, "b"]})}), r"tables\['a'\]: column 'x': .*, got int, str"),
    (A(tables={"a": pd.DataFrame({"x": [[1]]})}), r"tables\['a'\]: column 'x': .*, got list"),
    (A(tables={"a": pd.DataFrame({"x": [np.inf]})}), r"expected finite numbers, got inf; write None"),
    (A(figures={"a": Picture(figure_of_nothing, "A")}), r"figures\['a'\]: expected a .*Figure, .* an int"),
    (A(figures={"a": figure_of_nothing}), r"expected a Picture\(recipe, caption\), got a function"),
])  # fmt: skip
def test_a_figure_or_table_that_cannot_be_shown_is_left_out(found, words):
    made = own(found)
    (line,) = made.missing
    assert re.search(words, line), line
    assert not made.answer.tables
    assert not made.figures


def test_numbers_of_numpy_become_plain():
    level = Level(SIZE, Estimate(np.float32(3.0), np.int64(1), 4.0), basis=Basis(np.int64(5)))
    (found,) = own(Answer(findings=(level,))).answer.findings
    numbers = [found.estimate.value, found.estimate.low, found.basis.n]
    assert [(type(number), number) for number in numbers] == [(float, 3.0), (float, 1.0), (int, 5)]
    difference = Difference(Estimate(0.1, 0.05, 0.2), is_same=np.False_, family=Family(3, 0.01))
    level = Level(SIZE, Estimate(3.0), comparison=Comparison("it", difference))
    assert own(Answer(findings=[level])).answer.findings == (level,)
    lifetime = Lifetime(SIZE, Estimate(9.0, 7.0))
    assert own(Answer(findings=[lifetime])).answer.findings == (lifetime,)
    with pytest.raises(OwnError, match="estimate: expected a value"):
        own(Answer(findings=[replace(lifetime, estimate=Estimate())]))


def leaves():
    raise SystemExit(0)


def test_foreign_bytes_stay_out_of_page_and_files(study):
    figure = Figure()
    figure.suptitle("a\x00\x1b[31m")
    words = pd.Series(["a\ud800\x07"], dtype=object)
    table = pd.DataFrame({"x\x1b": words, "x\x1b_low": [1.0], "x\x1b_high": [2.0], "is": [True], "is_low": [0.1]})
    made = own(A(tables={"t": table}, figures={"f": Picture(figure, "F"), "left": Picture(leaves, "L")}))
    (line,) = made.missing
    assert line.startswith("figures['left']: ")
    report = page_of(study, made, own(Answer(findings=[Lack("why\ud800\x1b", Reason.DRIFT)]), "own:other", ""))
    for content in contents(report).values():
        assert not {0x00, 0x1B} & {*content} or content[:4] == b"PAR1"
    assert report.tables["own-question-t"].iloc[0, 0] == "a"


def test_a_figure_may_be_one_that_is_drawn_already():
    figure = Figure()
    figure.subplots().plot([1, 2])
    made = own(A(figures={"line": Picture(figure, "A line.")}), doc="")
    assert made.figures["own-question-line"].svg.lstrip().startswith("<?xml")
    assert made.title == "question"  # it has no docstring


def test_numbers_of_a_table_have_nulls_and_a_named_index_stays():
    given = pd.DataFrame(
        {"x": [1.5, np.nan], "k": [3, 4], "t": [None, "b"], "none": [None, None], "is": [np.True_, None]},
        index=pd.Index([10, 20], name="belt"),
    )
    made = own(A(tables={"t": given}), "a.b:c").answer.tables["a-b-c-t"]
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
    with pytest.raises(ValueError, match=r"'n', a column of data\.members; give its numbers by member_id"):
        study.mean(group, "n")
    setting = group.at
    assert setting["n"] == group.key["n"]
    with pytest.raises(KeyError, match=r"expected n or a key of the scene that may be swept, .*got 'belt_sped'"):
        setting["belt_sped"]
    assert study.mean(group, {names[1]: float("nan")}).reason == "no matrix has data"
    has = {name: k == 2 for k, name in enumerate(names)} | {names[0]: None}
    share = study.share(group, has)
    assert (share.value, share.low, share.high) == (0.25, *wilson(1, 4, 0.95))
    assert study.share(group, {}).reason == "no run has data"
