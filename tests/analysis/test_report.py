"""The report: every question on planted and on scarce data; nothing is invented, nothing crashes, nothing leaks."""

import io
import json
import math
import re
from dataclasses import replace
from html import unescape

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import AnalysisSettings, build
from stickslip.analysis.findings.numbers import signs
from stickslip.analysis.stats.estimates import LN2
from stickslip.sim.engines import ENGINES
from tests.analysis.designs import Data
from tests.analysis.reports import contents

pytestmark = pytest.mark.usefixtures("undrawn")


def report_of(data, settings, title="Planted", about="Planted series.", provenance=None):
    members, series = data
    return build(Data(members, series), settings, title, about, provenance or {"scene": "planted"})


def text_of(report):
    """What a reader sees, without images, style and tags."""
    html = re.sub(r'src="data:[^"]*"', "", report.html)
    return re.sub(r"\s+", " ", re.sub(r"<style>.*?</style>|<script>.*?</script>|<[^>]+>", " ", html, flags=re.DOTALL))


def assert_honest(report):
    """No number that is none, in the page, the headline or the tables."""
    shown = text_of(report) + " ".join(report.headline)
    assert not re.search(r"(?i:\b(nan|inf|infinity|nat)\b)|<NA>|\bNone\b", shown)
    for table in report.tables.values():
        for column in table:
            for value in table[column].dropna():
                assert not (isinstance(value, float) and not math.isfinite(value)), column


def law(report, engine="coulomb"):
    table = report.tables["law"]
    return table[table["engine"] == engine].iloc[0]


def test_groups_are_named_by_what_sets_them_apart(planted, settings):
    rows = [
        planted.member("a", 0, **planted.sigmoid),
        planted.member("b", 0, **(planted.sigmoid | {"eps": 0.01})),
        planted.member("c", 0, n=20),
        planted.member("d", 0),
    ]
    series = {name: planted.runs(np.random.default_rng(0), 200, LN2) for name in "abcd"}
    table = report_of((pd.DataFrame(rows), series), settings).tables["groups"]
    assert table["group"].tolist() == [
        "n = 20, exact",
        "n = 200, exact",
        "n = 200, sigmoid, eps = 0.01, stick = convergent",
        "n = 200, sigmoid, eps = 0.03, stick = convergent",
    ]


@pytest.fixture
def scarce(planted):
    """Ensembles with too little in them, by name: (members, series)."""
    member, still = planted.member, (np.array([0.0]), np.array([7]))
    ones = (np.arange(0.0, 1000.0, 5.0), np.arange(200) % 2)  # one exit, one entry, and so on
    failed = {"outcome": "failed", "reason": "out of memory", "t_stop": None}
    collapsed = {"outcome": "collapsed", "reason": "certified", "t_stop": 30.0}
    fall = (np.arange(0.0, 1000.0, 10.0), np.arange(100, 0, -1))  # one run that never ends: cut at both sides
    return {
        "one matrix": planted.ensemble({"coulomb": LN2}, 1),
        "two matrices": planted.ensemble({"coulomb": LN2}, 2, n_steps=32),
        "nothing changes": (pd.DataFrame([member("a", 0), member("b", 1)]), {"a": still, "b": still}),
        "only ones": (pd.DataFrame([member("a", 0), member("b", 1)]), {"a": ones, "b": ones}),
        "no complete cascade": (pd.DataFrame([member("a", 0), member("b", 1)]), {"a": fall, "b": fall}),
        "all failed": (pd.DataFrame([member("a", 0, **failed), member("b", 1, **failed)]), {}),
        "all collapsed": (
            pd.DataFrame([member("a", 0, **collapsed), member("b", 1, **collapsed)]),
            {"a": still, "b": still},
        ),
    }


@pytest.mark.parametrize("name", [
    "one matrix",
    "two matrices",
    "nothing changes",
    "only ones",
    "no complete cascade",
    "all failed",
    "all collapsed",
])  # fmt: skip
def test_too_little_data_is_said_and_breaks_nothing(scarce, settings, name):
    report = report_of(scarce[name], settings)
    assert "Not answered:" in text_of(report)
    assert not {"enough", "drift unknown"} & set(report.tables["law"]["basis"])
    assert_honest(report)
    assert list(contents(report))[-1] == "report.html"
    assert len(text_of(report).split()) < 900


def test_what_is_asked_and_has_no_answer_is_said_at_the_top(planted, scarce, settings):
    """Of data without episodes, and of too few matrices for gamma."""
    said = "Asked but not answered: "
    whole = planted.ensemble({"coulomb": LN2}, 8)
    assert said not in text_of(report_of(whole, replace(settings, question=("cascades",))))
    text = text_of(report_of(whole, replace(settings, question=("episodes", "cascades"))))
    assert text.count(said) == 1
    text = text_of(report_of(scarce["two matrices"], replace(settings, question=("cascades",))))
    assert f"{said}How do cascade sizes fall off? The decay rate of cascade sizes: too few" in text


@pytest.mark.drawn
def test_the_report_twice_is_the_same_bytes_whatever_the_order_of_rows(planted, settings):
    members, series = planted.ensemble({"coulomb": LN2, "sigmoid": 0.6}, 8)
    one = report_of((members, series), settings)
    two = report_of((members.iloc[::-1], dict(reversed(series.items()))), settings)
    assert one.html == two.html
    assert one.headline == two.headline
    assert contents(one) == contents(two)
    assert {"report.html", "report/law.parquet", "report/findings.json"} <= contents(one).keys()
    sources = re.findall(r'(?:src|href)="([^#].{4})', one.html)
    assert set(sources) == {"data:"}
    assert "url(" not in one.html


def test_members_that_stopped_enter_no_statistic(planted, settings):
    members, series = planted.ensemble({"coulomb": LN2}, 6)
    stopped = [
        planted.member("c1", 6, outcome="collapsed", reason="certified", t_stop=50.0),
        planted.member("d1", 8, outcome="diverged", reason="grew without bound", t_stop=300.0),
        planted.member("f1", 9, outcome="failed", reason="worker lost", t_stop=None),
    ]
    more = series | {"c1": (np.array([0.0]), np.array([0])), "d1": planted.runs(np.random.default_rng(0), 800, 0.2)}
    before = report_of((members, series), settings)
    after = report_of((pd.concat([members, pd.DataFrame(stopped)]), more), settings)
    for table in ("law", "sizes"):
        pd.testing.assert_frame_equal(before.tables[table], after.tables[table])
    assert_honest(after)


def test_perturbed_members_are_pooled_with_nothing(planted, settings):
    members, series = planted.ensemble({"coulomb": LN2}, 5)
    twins = members.assign(member_id=members["member_id"] + "-p", perturbation_size=0.05)
    more = series | {twin: series[twin.removesuffix("-p")] for twin in twins["member_id"]}
    report, alone = (report_of(data, settings) for data in ((pd.concat([members, twins]), more), (members, series)))
    pd.testing.assert_frame_equal(report.tables["law"], alone.tables["law"])


def test_written_tables_read_back_with_nulls(planted, settings):
    report = report_of(planted.ensemble({"coulomb": LN2}, 1), settings)
    files = contents(report)
    assert files["report.html"].decode() == report.html

    def refuse(constant):
        raise AssertionError(constant)

    assert json.loads(files["report/findings.json"], parse_constant=refuse)["findings"]
    for name, table in report.tables.items():
        back = pd.read_parquet(io.BytesIO(files[f"report/{name}.parquet"]), dtype_backend="numpy_nullable")
        pd.testing.assert_frame_equal(back, table, check_dtype=False)


def test_a_changed_member_without_a_series_is_refused_by_name(planted, settings):
    members, series = planted.ensemble({"coulomb": LN2}, 5)
    copies = members.assign(member_id="copy of " + members["member_id"], perturbation_size=0.01)
    with pytest.raises(ValueError, match="change points of the member 'copy of coulomb-000', got none"):
        report_of((pd.concat([members, copies]), series), settings)


def test_what_users_write_is_escaped(planted, settings):
    hostile = "<script>alert('x')</script> & \"q\" {{ 7 * 7 }}"
    members, series = planted.ensemble({"coulomb": LN2}, 5)
    members.loc[0, ["outcome", "reason"]] = ["failed", hostile]
    members["coupling"] = hostile
    report = report_of((members, series), settings, hostile, hostile, {hostile: hostile})
    assert "<script>alert" not in report.html
    assert report.html.count("&lt;script&gt;") >= 5
    assert "49" not in re.findall(r"<h1>(.*?)</h1>", report.html)[0]


def test_a_question_that_there_is_not_is_refused_by_name(scarce, settings):
    with pytest.raises(
        ValueError, match=r"question: expected one of changes, .*, got 'collectives'; did you mean 'collective'"
    ):
        report_of(scarce["two matrices"], replace(settings, question=("fates", "collectives")))


@pytest.mark.parametrize(("spoil", "named"), [
    (lambda m, s: (pd.concat([m, m]), s), "more than once"),
    (lambda m, s: (m.assign(t_end=100.0), s), "t_burn"),
    (lambda m, s: (m, {}), "coulomb-000"),
    (lambda m, s: (m.assign(outcome="collapsed"), {}), "of the member 'coulomb-000'"),
    (lambda m, s: (m, s | {"coulomb-001": (np.array([500.0]), np.array([1]))}), "coulomb-001"),
])  # fmt: skip
def test_contradictory_input_is_refused_by_name(planted, settings, spoil, named):
    with pytest.raises(ValueError, match=named):
        report_of(spoil(*planted.ensemble({"coulomb": LN2}, 2)), settings)


@pytest.mark.parametrize(("changes", "named"), [
    ({"t_burn": -1.0}, "t_burn"),
    ({"t_burn": math.nan}, "t_burn"),
    ({"dt": ()}, "dt"),
    ({"dt": (1.0, 1.0)}, "dt"),
    ({"dt": (0.0,)}, "dt"),
    ({"resamples": 1}, "resamples"),
    ({"confidence": 95.0}, "confidence"),
    ({"confidence": 0.9999999999999999}, "confidence: expected a number from 0.5 to 0.999999"),
    ({"confidence": 0.49}, "confidence"),
    ({"seed": -1}, "seed"),
])  # fmt: skip
def test_settings_out_of_range_are_refused_by_name(changes, named):
    good = {"t_burn": 0.0, "dt": (1.0,), "resamples": 10, "confidence": 0.95, "seed": 0}
    with pytest.raises(ValueError, match=named):
        AnalysisSettings(**(good | changes))


def test_the_page_says_what_an_engine_is_where_it_names_one(planted, settings):
    """Below the alerts, where engines are told apart; one alone stands in the table of settings."""
    for engines, section in ((("coulomb", "sigmoid"), ""), (("coulomb",), "How was it made?")):
        shown = unescape(text_of(report_of(planted.ensemble(dict.fromkeys(engines, 0.7), 5), settings)))
        assert {name for name in ENGINES if signs(ENGINES[name].about) in shown} == {*engines}
        assert shown.index(ENGINES["coulomb"].about) > shown.index(section)
