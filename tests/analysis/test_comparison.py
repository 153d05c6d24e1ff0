"""Two ensembles side by side: planted equal and unequal ones, what is set beside what, and refusals."""

import io
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import AnalysisSettings, Study
from stickslip.analysis.findings.finding import Verdict
from stickslip.analysis.page.comparison import Ensemble, compare, matched
from stickslip.analysis.stats.estimates import LN2
from tests.analysis.designs import Data
from tests.analysis.reports import contents

pytestmark = pytest.mark.usefixtures("undrawn")

MARGINS = {"mean": 0.1, "variance": 0.25, "rate": 0.1, "correlation_time": 0.5, "gamma": 0.05}
SETTINGS = AnalysisSettings(t_burn=100.0, dt=(0.5,), resamples=20, confidence=0.95, seed=0, margins=MARGINS)


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


def text_of(report):
    shown = re.sub(r'src="data:[^"]*"|<style>.*?</style>', "", report.html, flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", shown))


def test_equal_data_is_said_at_once(planted):
    pair = [replace(ensemble(planted, name, draw=draw), digest="d") for draw, name in enumerate(("one", "other"))]
    report = compare(*pair, SETTINGS)
    assert report.headline == ["Yes: runs that one and other both hold: 20, the same to the last digit."]
    assert report.tables == report.figures == {}
    assert compare(*(replace(one, digest="") for one in pair), SETTINGS).tables


def test_where_no_run_is_in_motion_that_is_the_reason(planted):
    pair = [ensemble(planted, name, draw=draw) for draw, name in enumerate(("one", "other"))]
    ended = [replace(one, data=Data(one.data.members.assign(outcome="collapsed"), one.data.series)) for one in pair]
    (said,) = compare(*ended, SETTINGS).headline
    assert said == "Undecided: whether one and other agree: no run is in motion."


@pytest.mark.parametrize(
    ("key", "values", "note"),
    [
        ("friction", (10.0, 20.0), "another setting: friction = 10 against 20."),
        ("t_end", (1600.0, 1700.0), "another setting: t_end = 1600 against 1700."),
        ("z0", (0.0, 0.1), "another setting: z0 = 0 against 0.1."),
        ("seed", (0, 1), "drawn independently"),
    ],
)
def test_what_is_set_otherwise_is_said(planted, key, values, note):
    pair = [ensemble(planted, name, n_matrices=4, **{key: value}) for name, value in zip("ab", values, strict=True)]
    assert note in text_of(compare(*pair, SETTINGS))


def test_a_planted_gamma_is_found_and_named(planted):
    """Rates 0.69 and 0.55: gamma differs by 20%, against a margin of 5%."""
    for seed in (0, 1):  # paired, and with other random systems
        first, second = ensemble(planted, "first"), ensemble(planted, "second", rate=LN2 - 0.14, draw=1, seed=seed)
        report = compare(first, second, SETTINGS)
        table = report.tables["changes"].set_index("quantity")
        row = table.loc["gamma"]
        assert row["verdict"] == Verdict.LESS
        assert row["relative_low"] < -0.14 / LN2 < row["relative_high"]
        assert report.headline[0].startswith("No: second gives a ")
        assert ("each system is compared with itself" in text_of(report).lower()) == (seed == 0)


def test_equal_laws_are_seldom_called_different_and_few_matrices_not_the_same(planted):
    different = 0
    for k in range(10):
        pair = ensemble(planted, "a", draw=2 * k), ensemble(planted, "b", draw=2 * k + 1, seed=1)
        found = set(compare(*pair, SETTINGS).tables["changes"]["verdict"])
        different += not found.isdisjoint({Verdict.MORE, Verdict.LESS})
    assert different <= 2  # family-wise 5% of 10: three or more with a chance of 1.2%
    few = [ensemble(planted, name, draw=draw, n_matrices=3) for draw, name in enumerate("ab")]
    report = compare(*few, SETTINGS)
    assert report.headline == [
        "Undecided: whether a and b agree: too few independent units for an interval."
    ]  # fmt: skip
    assert set(report.tables["changes"]["verdict"]) == {Verdict.UNJUDGED}


def test_settings_that_differ_are_matched_by_what_they_share(planted):
    first = ensemble(planted, "first", engines=("coulomb", "sigmoid"), n_matrices=4)
    second = ensemble(planted, "second", engines=("sigmoid", "coulomb"), n_matrices=4, draw=1)
    members = second.data.members.assign(kappa=0.3)
    members.loc[members["engine"] == "sigmoid", "eps"] = 0.01
    second = replace(second, data=replace(second.data, table=members))
    mine, theirs = (Study(one.data, SETTINGS).groups for one in (first, second))
    matches = matched("first", mine, "second", theirs)
    engines = [[group.key["engine"] for group in match[:2]] for match in matches]
    assert sorted(engines) == [["coulomb"] * 2, ["sigmoid"] * 2]
    assert "another setting: kappa = 0.2 against 0.3, eps = 0.03 against 0.01" in text_of(
        compare(first, second, SETTINGS)
    )
    report = compare(ensemble(planted, "alone", n_matrices=4), second, SETTINGS)
    assert set(report.tables["alone"]["setting"]) == {"n = 200, sigmoid, eps = 0.01, stick = convergent"}


def test_each_difference_is_told_with_its_setting(planted):
    """At the first of three belt speeds n_stick is half as large, and nowhere else."""

    def of(name, draw, level):
        parts = [ensemble(planted, name, draw=draw, level=level if k == 0 else 100, belt_speed=-0.1 * (k + 1))
                 for k in range(3)]  # fmt: skip
        tables = [one.data.members.assign(member_id=lambda t, k=k: t["member_id"] + f"-{k}")
                  for k, one in enumerate(parts)]  # fmt: skip
        series = {f"{m}-{k}": points for k, one in enumerate(parts) for m, points in one.data.series.items()}
        return replace(parts[0], data=Data(pd.concat(tables, ignore_index=True), series))

    report = compare(of("first", 0, 100), of("second", 1, 50), SETTINGS)
    assert report.headline[0].startswith("No: second (belt_speed = \u22120.1) gives ")


def test_members_without_a_partner_are_named(planted):
    """Matrices 4 and 5 are in the first alone; with other seeds nobody has a partner, and none is missed."""
    first, second = ensemble(planted, "first", n_matrices=6), ensemble(planted, "second", draw=1, n_matrices=4)
    report = compare(first, second, SETTINGS)
    assert report.tables["alone"].to_dict("list") == {
        "dataset": ["first"] * 2, "setting": ["n = 200, exact"] * 2, "member_id": ["coulomb-004", "coulomb-005"],
    }  # fmt: skip
    assert "2 members of first have no partner: coulomb-004, coulomb-005." in text_of(report)
    turned = compare(second, first, SETTINGS)
    assert turned.tables["alone"]["dataset"].tolist() == ["first"] * 2
    other = compare(first, ensemble(planted, "second", draw=1, n_matrices=4, seed=1), SETTINGS)
    assert other.tables["alone"].empty
    more = compare(ensemble(planted, "more", n_matrices=4, engines=("coulomb", "sigmoid")), second, SETTINGS)
    assert "4 members of more have no partner: sigmoid-000, sigmoid-001, sigmoid-002, ..." in text_of(more)
    assert more.tables["alone"]["member_id"].tolist() == [f"sigmoid-{k:03d}" for k in range(4)]


def test_margins_and_t_burn_of_the_first_are_used_and_said(planted):
    first, second = (
        ensemble(planted, name, draw=draw, n_matrices=4) for draw, name in enumerate(("first", "second"))
    )
    other = replace(second, t_burn=50.0, margins=MARGINS | {"gamma": 0.01})
    plain, changed = (compare(first, one, SETTINGS) for one in (second, other))
    pd.testing.assert_frame_equal(changed.tables["changes"], plain.tables["changes"])
    assert "Margins are those of first; second declares others for gamma." in text_of(changed)
    assert "t_burn = 100 is that of first; second declares 50." in text_of(changed)
    assert "declares others" not in text_of(plain)


def test_nothing_in_common_is_refused_with_what_there_is(planted):
    first, second = ensemble(planted, "first", n_matrices=2), ensemble(planted, "second", n_matrices=2, n=20, draw=1)
    with pytest.raises(ValueError, match=r"share n and coupling, got n = 200, .* in first and n = 20, .* in second"):
        compare(first, second, SETTINGS)
    short = ensemble(planted, "short", n_matrices=3, t_end=80.0)
    with pytest.raises(ValueError, match="short, under the settings of first: t_burn"):
        compare(first, short, SETTINGS)


@pytest.mark.drawn
def test_the_page_is_whole_and_the_same_twice(planted):
    first, second = ensemble(planted, "<first>", n_matrices=4), ensemble(planted, "second", draw=1, n_matrices=4)
    one, two = (compare(first, second, SETTINGS) for _ in range(2))
    assert contents(one) == contents(two)
    assert "<first>" not in one.html
    assert not re.search(r"\bnan\b|\bNone\b", text_of(one))
    back = pd.read_parquet(io.BytesIO(contents(one)["report/changes.parquet"]))
    assert len(back) == 7


def test_without_a_margin_nothing_agrees(planted):
    """The same law with the same systems: all that is declared is within, and what is not is undecided."""
    first, second = (ensemble(planted, name, draw=draw) for draw, name in enumerate("ab"))
    wide = compare(first, second, replace(SETTINGS, margins={"rate": 0.9}))
    assert wide.headline[0].startswith("Yes: b agrees with a")
    bare = compare(first, second, replace(SETTINGS, margins={}))
    assert bare.headline[0].startswith("Undecided: no difference from a is shown for b (20 systems)")
