"""The report: its sentences follow the numbers, nothing is invented, nothing crashes."""

import io
import json
import math
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from stickslip.analysis.questions.clustering_section import clustering_section

from stickslip.analysis import AnalysisSettings, Data, build
from stickslip.analysis.report.page import on_demand
from stickslip.analysis.stats.estimates import LN2
from stickslip.analysis.stats.families import RIVALS
from stickslip.analysis.stats.rivals import rivals


@pytest.fixture(autouse=True)
def few_controls(monkeypatch):
    """Positive controls of clustering and rival laws, most of a report's time, have tests of their own."""
    few = partial(clustering_section, resamples=5, repeats=2)
    monkeypatch.setattr("stickslip.analysis.questions.law_section.rivals", partial(rivals, families=RIVALS[:1]))
    monkeypatch.setattr("stickslip.analysis.report.page.clustering_section", few)


def undrawn(recipe):
    """Half of a report's time is drawing, which a few tests look at and the others leave out."""
    return lambda: "data:image/svg+xml;base64,"


def report_of(data, settings, title="Planted", about="Planted series.", provenance=None, draw=undrawn):
    members, series = data
    return build(Data(members, series), settings, title, about, provenance or {"scene": "planted"}, draw)


def text_of(report):
    """What a reader sees, without images, style and tags."""
    html = re.sub(r'src="data:[^"]*"', "", report.html)
    return re.sub(r"\s+", " ", re.sub(r"<style>.*?</style>|<[^>]+>", " ", html, flags=re.DOTALL))


def assert_honest(report):
    """No number that is none, in the page, the headline or the tables."""
    shown = text_of(report) + " ".join(report.headline)
    assert not re.search(r"(?i:\b(nan|inf|infinity|nat)\b)|<NA>|\bNone\b", shown)
    for table in report.tables.values():
        for column in table:
            for value in table[column].dropna():
                assert not (isinstance(value, float) and not math.isfinite(value)), column


def law(report, definition="events", engine="coulomb"):
    table = report.tables["law"]
    return table[(table["definition"] == definition) & (table["engine"] == engine)].iloc[0]


def test_fair_series_are_not_told_from_chance_and_clustered_ones_are(planted, settings):
    fair, clustered = (report_of(planted.ensemble({"coulomb": rate}, 20), settings) for rate in (LN2, LN2 - 0.12))
    assert law(fair)["verdict"] == "not distinguishable"
    assert law(fair)["difference_low"] < 0 < law(fair)["difference_high"]
    assert "not told apart from random order" in fair.headline[1]
    found = law(clustered)
    assert found["verdict"] == "differs"
    assert found["gamma_low"] < LN2 - 0.12 < found["gamma_high"]
    assert "shallower than in random order" in clustered.headline[1]
    assert "shallower" not in fair.headline[1]
    share = 100 * abs(found["difference"]) / found["gamma0"]
    assert f"that is {share:.3g}% of gamma0" in text_of(clustered)
    for report in (fair, clustered):
        assert_honest(report)


def test_anticlustered_series_have_smaller_cascades(planted, settings):
    report = report_of(planted.ensemble({"coulomb": LN2 + 0.3}, 10), settings)
    assert law(report)["verdict"] == "differs"
    assert "smaller cascades" in law(report)["statement"]


def test_engines_are_compared_on_the_matrices_they_share(planted, settings):
    members, series = planted.ensemble({"coulomb": LN2, "sigmoid": LN2}, 8)
    # One series a matrix, the sigmoid's higher by 2 throughout: the paired bias is exactly 2.
    for matrix in range(8):
        t, n_stick = series[f"coulomb-{matrix:03d}"]
        series[f"sigmoid-{matrix:03d}"] = (t, n_stick + 2)
    lost = members["member_id"] == "sigmoid-003"
    members.loc[lost, ["outcome", "reason", "t_stop"]] = ["diverged", "grew without bound", 40.0]
    report = report_of((members, series), replace(settings, margins={"mean": 0.1, "gamma": 0.05}))
    table = report.tables["engines"]
    mean = table[table["quantity"] == "mean n_stick"].iloc[0]
    assert (mean["reference"], mean["n_matrices"]) == ("n = 200, coulomb", 7)
    assert mean["difference"] == pytest.approx(2)
    assert mean["difference_high"] - mean["difference_low"] == pytest.approx(0, abs=1e-9)
    gammas = table[table["quantity"] == "gamma (events)"].iloc[0]
    assert gammas["difference"] == pytest.approx(0, abs=1e-12)
    assert f"{mean['setting']}: Against coulomb on the same 7 matrices" in " ".join(report.headline)
    assert mean["statement"] in text_of(report)


def test_mean_n_stick_is_the_planted_mean(planted, settings):
    """Square waves between a and a + 2, a another number for each matrix: means a + 1, their t interval."""
    levels = np.array([10, 12, 17, 21])
    t = np.arange(0.0, planted.t_end, 2.5)
    members = pd.DataFrame([planted.member(f"m{k}", k) for k in range(4)])
    series = {f"m{k}": (t, a + 2 * (np.arange(t.size) % 2)) for k, a in enumerate(levels)}
    row = report_of((members, series), settings).tables["n_stick"].iloc[0]
    half = 3.182446305 * levels.std(ddof=1) / 2
    assert [row["mean"], row["low"], row["high"]] == pytest.approx([16, 16 - half, 16 + half])
    assert row["variance_in_time"] == pytest.approx(1)


def test_burn_in_table_sees_a_drift(planted, settings):
    t, drifting = np.arange(0.0, 1000.0), np.arange(1000) // 10
    members = pd.DataFrame([planted.member(f"m{k}", k) for k in range(5)])
    series = {f"m{k}": (t, drifting + k) for k in range(5)}
    row = report_of((members, series), settings).tables["burn_in"].iloc[0]
    assert row["difference"] == pytest.approx(45)
    assert "drifts by +45" in row["statement"]
    fair = report_of(planted.ensemble({"coulomb": LN2}, 20, n_steps=80), settings)
    assert "is not excluded" in fair.tables["burn_in"].iloc[0]["statement"]
    assert "take gamma with care" not in text_of(fair)
    assert "n_stick drifts" not in fair.headline[1]


def test_a_drift_is_said_beside_gamma(planted, settings):
    members, series = planted.ensemble({"coulomb": LN2}, 5)
    series = {name: (t, n_stick + t.astype(int)) for name, (t, n_stick) in series.items()}
    report = report_of((members, series), settings)
    assert report.headline[1].endswith("; n_stick drifts after t_burn.")
    text = text_of(report)
    said = text.index("n = 200, coulomb: Take gamma with care: n_stick drifts by +4")
    gamma, mean = (text.index(f"n = 200, coulomb: {words}", said - 600) for words in ("Event", "Mean"))
    assert gamma < said < mean


def test_long_lists_begin_with_the_groups_that_have_data(planted, settings):
    members, series = planted.ensemble({"coulomb": LN2}, 7, n_steps=400)
    for matrix in range(7):
        name = f"few-{matrix}"
        members.loc[len(members)] = planted.member(name, matrix, n=20)
        series[name] = (np.array([0.0, 500.0]), np.array([3, 2]))
    html = report_of((members, series), settings).html
    for title in (
        "the-law-of-the-sizes",
        "gamma-by-definition,-step-and-threshold",
        "do-exits-cluster-beyond-chance?",
    ):
        listed = re.findall("<li>(n = .*?),", html.partition(f'<h2 id="{title}">')[2].partition("<h2")[0])
        assert listed[0] == "n = 200", title
        assert "n = 20" in listed


def test_members_that_stopped_are_counted_and_never_pooled(planted, settings):
    members, series = planted.ensemble({"coulomb": LN2}, 6)
    before = report_of((members, series), settings)
    stopped = pd.DataFrame(
        [
            planted.member("c1", 6, outcome="collapsed", reason="certified", t_stop=50.0),
            planted.member("c2", 7, outcome="collapsed", reason="certified", t_stop=400.0),
            planted.member("d1", 8, outcome="diverged", reason="grew without bound", t_stop=300.0),
            planted.member("f1", 9, outcome="failed", reason="worker lost", t_stop=None),
        ]
    )
    clustered = planted.runs(np.random.default_rng(0), 800, 0.2)
    with_stopped = series | {"c1": (np.array([0.0]), np.array([0])), "c2": clustered, "d1": clustered}
    after = report_of((pd.concat([members, stopped]), with_stopped), settings)
    pd.testing.assert_frame_equal(before.tables["law"], after.tables["law"])
    pd.testing.assert_frame_equal(before.tables["n_stick"], after.tables["n_stick"])
    outcomes = after.tables["outcomes"].set_index("outcome")
    assert outcomes["n_members"].to_dict() == {"finished": 6, "collapsed": 2, "diverged": 1, "failed": 1}
    assert outcomes.loc["collapsed", "n_before_burn"] == 1
    assert "6 of 10 runs reached t_end; left out: 2 collapsed (1 before t_burn), 1 diverged, 1 failed" in text_of(
        after
    )
    assert "worker lost" in text_of(after)
    assert_honest(after)


def test_perturbed_members_are_pooled_with_nothing(planted, settings):
    members, series = planted.ensemble({"coulomb": LN2}, 5)
    twins = members.assign(member_id=members["member_id"] + "-p", perturbation_size=0.05)
    for twin in twins["member_id"]:
        series[twin] = series[twin.removesuffix("-p")]
    report = report_of((pd.concat([members, twins]), series), replace(settings, margins={"mean": 0.1}))
    alone = report_of((members, series), settings)
    pd.testing.assert_frame_equal(report.tables["law"], alone.tables["law"])
    assert set(report.tables["robustness"]["n_matrices"]) == {5}


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
        "n = 20, coulomb",
        "n = 200, coulomb",
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


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("one matrix", "one matrix only, so no interval"),
        ("two matrices", "2 matrices"),
        ("nothing changes", "n_stick does not change after t_burn in any finished run"),
        ("only ones", "every cascade has size 1, so gamma has no finite value"),
        ("no complete cascade", "no complete cascade after t_burn in any finished run"),
        ("all failed", "no run reached t_end"),
        ("all collapsed", "0 of 2 runs reached t_end; left out: 2 collapsed (2 before t_burn)"),
    ],
)
def test_too_little_data_is_said_and_breaks_nothing(scarce, settings, name, words):
    report = report_of(scarce[name], settings, draw=on_demand)
    assert words in text_of(report)
    said = "To t = 1000, n = 200, coulomb: all stopped sticking for good" if name == "all collapsed" else words
    assert said in " ".join(report.headline)
    if name == "nothing changes":
        assert "2 runs reached t_end; after t_burn no block sticks or slips anew in 2 of them" in text_of(report)
    if name != "two matrices":
        assert set(report.tables["law"]["verdict"]) == {"not enough data"}
        # of runs that ended by themselves the headline says how they did
        assert "not enough data" in (text_of(report) if name == "all collapsed" else " ".join(report.headline))
    seen = report.tables["sizes"].query("definition == 'events' and n_cascades > 0")
    assert ("size (events)" in text_of(report)) == (len(seen) > 1)  # neither a head without a table nor a law of one
    assert_honest(report)
    assert list(report.files())[-1] == "report.html"


def test_the_report_twice_is_the_same_bytes_whatever_the_order_of_rows(planted, settings):
    members, series = planted.ensemble({"coulomb": LN2, "sigmoid": 0.6}, 3)
    backwards = dict(reversed(series.items()))
    one = report_of((members, series), settings, draw=on_demand)
    two = report_of((members.iloc[::-1], backwards), settings, draw=on_demand)
    assert one.html == two.html
    assert one.headline == two.headline
    assert {"report.html", "report/law.parquet", "report/tables.json"} <= one.files().keys()
    assert one.files() == two.files()


def test_another_seed_changes_chance_only_within_its_error(planted, settings):
    members, series = planted.ensemble({"coulomb": LN2}, 4)
    other = AnalysisSettings(settings.t_burn, settings.dt, settings.resamples, settings.confidence, seed=1)
    one, two = (law(report_of((members, series), each)) for each in (settings, other))
    assert one["gamma"] == two["gamma"]
    assert one["gamma0"] != two["gamma0"]
    assert abs(one["gamma0"] - two["gamma0"]) < 4 * math.hypot(one["gamma0_error"], two["gamma0_error"])


def test_written_tables_read_back_with_nulls(planted, settings):
    report = report_of(planted.ensemble({"coulomb": LN2}, 1), settings)
    files = report.files()
    assert files["report.html"].decode() == report.html

    def refuse(constant):
        raise AssertionError(constant)

    stored = json.loads(files["report/tables.json"], parse_constant=refuse)
    assert list(stored) == list(report.tables)
    assert stored["law"][0]["dt"] is None
    assert stored["law"][0]["gamma_low"] is None
    assert stored["law"][0]["gamma"] == law(report)["gamma"]
    for name, table in report.tables.items():
        back = pd.read_parquet(io.BytesIO(files[f"report/{name}.parquet"]), dtype_backend="numpy_nullable")
        pd.testing.assert_frame_equal(back, table, check_dtype=False)


def test_what_users_write_is_escaped(planted, settings):
    hostile = "<script>alert('x')</script> & \"q\" {{ 7 * 7 }}"
    members, series = planted.ensemble({"coulomb": LN2}, 2)
    members.loc[0, ["outcome", "reason"]] = ["failed", hostile]
    report = report_of((members, series), settings, hostile, hostile, {hostile: hostile})
    assert "<script>alert" not in report.html
    assert report.html.count("&lt;script&gt;") >= 5
    assert "49" not in re.findall(r"<h1>(.*?)</h1>", report.html)[0]


def test_the_page_needs_nothing_from_elsewhere(planted, settings):
    html = report_of(planted.ensemble({"coulomb": LN2}, 2), settings, draw=on_demand).html
    sources = re.findall(r'(?:src|href)="([^#].{4})', html)
    assert sources
    assert set(sources) == {"data:"}
    assert "url(" not in html


def test_every_gamma_stands_with_its_definition_and_the_null(planted, settings):
    text = text_of(report_of(planted.ensemble({"coulomb": LN2}, 3), settings))
    assert "dt and threshold not stated" in text
    assert "gamma0 (chance)" in text
    assert "exits and entries independent and in equal numbers give ln 2 = 0.6931" in text
    assert "9 comparisons with chance" in text  # events, and four sampled definitions at two dt


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (lambda m, s: (m.drop(columns="outcome"), s), "outcome"),
        (lambda m, s: (m.iloc[:0], s), "at least one row"),
        (lambda m, s: (pd.concat([m, m]), s), "more than once"),
        (lambda m, s: (m.assign(outcome="done"), s), "'done'"),
        (lambda m, s: (m.assign(t_end=100.0), s), "t_burn"),
        (lambda m, s: (m, {}), "coulomb-000"),
        (lambda m, s: (m.assign(outcome="collapsed"), {}), "the collapsed member 'coulomb-000'"),
        (lambda m, s: (m, s | {"coulomb-001": (np.array([500.0]), np.array([1]))}), "coulomb-001"),
    ],
)
def test_contradictory_input_is_refused_by_name(planted, settings, spoil, named):
    with pytest.raises(ValueError, match=named):
        report_of(spoil(*planted.ensemble({"coulomb": LN2}, 2)), settings)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"t_burn": -1.0}, "t_burn"),
        ({"t_burn": math.nan}, "t_burn"),
        ({"dt": ()}, "dt"),
        ({"dt": (1.0, 1.0)}, "dt"),
        ({"dt": (0.0,)}, "dt"),
        ({"resamples": 1}, "resamples"),
        ({"confidence": 95.0}, "confidence"),
        ({"seed": -1}, "seed"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(changes, named):
    good = {"t_burn": 0.0, "dt": (1.0,), "resamples": 10, "confidence": 0.95, "seed": 0}
    with pytest.raises(ValueError, match=named):
        AnalysisSettings(**(good | changes))
