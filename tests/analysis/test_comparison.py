"""Two ensembles side by side: planted equal and unequal ones, what is set beside what, and refusals."""

import io
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from stickslip.analysis.report.comparison import Ensemble, compare, matched

from stickslip.analysis import AnalysisSettings, Data
from stickslip.analysis.stats.estimates import LN2

MARGINS = {"mean": 0.1, "variance": 0.25, "rate": 0.1, "correlation_time": 0.5, "gamma": 0.05}
SETTINGS = AnalysisSettings(t_burn=100.0, dt=(0.5,), resamples=20, confidence=0.95, seed=0, margins=MARGINS)


@pytest.fixture(autouse=True)
def undrawn(request, monkeypatch):
    if "drawn" not in request.node.name:
        monkeypatch.setattr(
            "stickslip.analysis.report.comparison.embedded", lambda figure: "data:image/svg+xml;base64,"
        )


def ensemble(planted, name, rate=LN2, draw=0, seed=0, n_matrices=20, level=100, engines=("coulomb",), **changes):
    """One run a matrix; `seed` names the random systems, `draw` the noise in their series."""
    rows, series = [], {}
    for engine in engines:
        for matrix in range(n_matrices):
            rng = np.random.default_rng([seed, draw, matrix, len(engine)])
            member = f"{engine}-{matrix:03d}"
            own = planted.sigmoid if engine == "sigmoid" else {}
            rows.append(planted.member(member, matrix, **own, seed=seed) | changes)
            t, n_stick = planted.runs(rng, 1600, rate)
            series[member] = t, n_stick - n_stick.min() + level
    return Ensemble(name, Data(pd.DataFrame(rows), series), SETTINGS.t_burn, MARGINS, {"scene": name})


def test_one_ensemble_is_the_same_as_itself(planted):
    one = ensemble(planted, "one")
    report = compare(one, one, SETTINGS)
    table = report.tables["compared"]
    assert set(table["verdict"]) == {"equivalent"}
    assert table["is_paired"].all()
    assert report.headline[0].startswith("Yes: one and one are the same to the last digit")


def test_a_planted_gamma_is_found_and_named(planted):
    """Rates 0.69 and 0.55: gamma differs by 20%, against a margin of 5%."""
    for seed in (0, 1):  # paired, and with other random systems
        first, second = ensemble(planted, "first"), ensemble(planted, "second", rate=LN2 - 0.14, draw=1, seed=seed)
        report = compare(first, second, SETTINGS)
        table = report.tables["compared"].set_index("quantity")
        row = table.loc["gamma (events)"]
        assert row["verdict"] == "different"
        assert row["relative_low"] < -0.14 / LN2 < row["relative_high"]
        assert row["is_paired"] == (seed == 0)
        assert report.headline[0].startswith("No: first and second differ in")
        assert ("matrices are pairs" in report.headline[-1]) == (seed == 0)


def test_equal_laws_are_seldom_called_different_and_few_matrices_not_the_same(planted):
    different = 0
    for k in range(10):
        pair = ensemble(planted, "a", draw=2 * k), ensemble(planted, "b", draw=2 * k + 1, seed=1)
        different += "different" in set(compare(*pair, SETTINGS).tables["compared"]["verdict"])
    assert different <= 2  # family-wise 5% of 10: three or more with a chance of 1.2%
    few = [ensemble(planted, name, draw=draw, n_matrices=3) for draw, name in enumerate("ab")]
    report = compare(*few, SETTINGS)
    assert not report.headline[0].startswith("Yes")
    assert "different" not in set(report.tables["compared"]["verdict"])


def test_settings_that_differ_are_matched_by_what_they_share(planted):
    first = ensemble(planted, "first", engines=("coulomb", "sigmoid"), n_matrices=3)
    second = ensemble(planted, "second", engines=("sigmoid", "coulomb"), n_matrices=3)
    second.data.members["kappa"] = 0.3
    is_sigmoid = second.data.members["engine"] == "sigmoid"
    second.data.members.loc[is_sigmoid, "eps"] = 0.01
    matches, left_first, left_second = matched(first, second)
    differs = {match.first.key["engine"]: match.differs for match in matches}
    assert differs == {"coulomb": {"kappa": (0.2, 0.3)}, "sigmoid": {"kappa": (0.2, 0.3), "eps": (0.03, 0.01)}}
    assert not left_first
    assert not left_second
    report = compare(first, second, SETTINGS)
    assert any("kappa = 0.2 against 0.3, eps = 0.03 against 0.01" in line for line in report.headline)
    alone = ensemble(planted, "alone", n_matrices=3)
    report = compare(alone, second, SETTINGS)
    assert report.tables["unmatched"]["setting"].tolist() == ["n = 200, sigmoid, eps = 0.01, stick = convergent"]


def test_margins_and_t_burn_of_the_first_are_used_and_said(planted):
    first, second = (ensemble(planted, name, n_matrices=3) for name in ("first", "second"))
    other = Ensemble("second", second.data, 50.0, MARGINS | {"gamma": 0.01}, {})
    report = compare(first, other, SETTINGS)
    pd.testing.assert_frame_equal(report.tables["compared"], compare(first, second, SETTINGS).tables["compared"])
    html = report.html
    assert "second declares other margins, which are not used: gamma 1%" in html
    assert "second declares t_burn = 50, which is not used" in html
    assert "declares other margins" not in compare(first, second, SETTINGS).html


def test_nothing_in_common_is_refused_with_what_there_is(planted):
    first, second = ensemble(planted, "first", n_matrices=2), ensemble(planted, "second", n_matrices=2, n=20)
    with pytest.raises(ValueError, match=r"share n and coupling, got n = 200, .* in first and n = 20, .* in second"):
        compare(first, second, SETTINGS)
    short = ensemble(planted, "short", n_matrices=2, t_end=80.0)
    with pytest.raises(ValueError, match="short, under the settings of first: t_burn"):
        compare(first, short, SETTINGS)


def test_the_drawn_page_is_whole_and_the_same_twice(planted):
    first, second = ensemble(planted, "<first>", n_matrices=4), ensemble(planted, "second", draw=1, n_matrices=4)
    one, two = (compare(first, second, SETTINGS) for _ in range(2))
    assert one.html == two.html
    assert "<first>" not in one.html
    assert "nan" not in one.html.split("base64")[0]
    back = pd.read_parquet(io.BytesIO(one.files()["report/compared.parquet"]))
    assert len(back) == 8


def test_what_the_first_declares_no_margin_for_is_left_out(planted):
    first, second = (ensemble(planted, name, draw=draw, n_matrices=3) for draw, name in enumerate("ab"))
    some = replace(SETTINGS, margins={"rate": 0.1})
    report = compare(replace(first, margins=some.margins), second, some)
    assert report.tables["compared"]["quantity"].tolist()[0] == "exit rate"
    assert len(report.tables["compared"]) == 1 + 3
    assert "exit rate 10% of the first value; shares of runs 20 points." in report.html
    assert "b declares other margins, which are not used: mean 10%" in report.html


def test_bars_that_adjusting_takes_back_are_explained(planted):
    """The same series, raised by what gives a t of 2.9 with 5 degrees of freedom: p = 0.03, adjusted 0.2."""
    first, second = (ensemble(planted, name, n_matrices=6) for name in ("first", "second"))
    for raised, (name, (t, n_stick)) in zip((40, 5, 30, 0, 45, 10), first.data.series.items(), strict=True):
        second.data.series[name] = t, n_stick + raised
    report = compare(first, second, SETTINGS)
    table = report.tables["compared"].set_index("quantity")
    alone = table[(table["p_different"] < 0.05) & (table["verdict"] == "not enough data")]
    assert list(alone.index) == ["mean n_stick"]
    assert "different by itself, not after adjustment for 7 comparisons" in alone["statement"].iloc[0]
    assert "1 different would be; adjusted for 7 comparisons they are not" in report.html
    assert "p different, adjusted" in report.html
