"""Shares of what runs settle on: planted ones come back, with intervals in closed form; nobody else counts."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm

from stickslip.analysis import Data, Study, build
from stickslip.analysis.ensemble import Recorded
from stickslip.analysis.questions.attractors import answer
from stickslip.analysis.report.formats import environment

SERIES = (np.array([0.0, 150.0]), np.array([3, 2]))
KINDS = 3 * ["sliding"] + 5 * ["periodic"] + ["irregular", "undecided"]
PERIODS = [None] * 3 + [2.0, 4.0, 6.0, 7.0, 9.0] + [None] * 2


@pytest.fixture
def data(planted):
    def of(kinds=KINDS, periods=PERIODS, **changes):
        rows = [planted.member(f"m{k}", k, n=4, attractor=kind, **changes) for k, kind in enumerate(kinds)]
        rows.append(planted.member("failed", len(rows), n=4, attractor=None, outcome="failed", reason="planted"))
        names = [row["member_id"] for row in rows]
        recorded = {"period": Recorded("of a cycle", dict(zip(names, [*periods, None], strict=True)))}
        return Data(pd.DataFrame(rows), dict.fromkeys(names[:-1], SERIES), recorded=recorded)

    return of


Z = norm.ppf(0.975)


def wilson(has, of):
    """The two shares p at which |has / of - p| = Z sqrt(p (1 - p) / of)."""
    a, b, c = 1 + Z**2 / of, -(2 * has / of + Z**2 / of), (has / of) ** 2
    return np.sort(np.roots([a, b, c]))


def test_shares_and_periods(data, settings):
    found = answer(Study(data(), settings))
    rows = {row["attractor"]: row for row in found.facts["rows"]}
    assert {kind: (row["n_runs"], row["of"]) for kind, row in rows.items()} == {
        "sliding": (3, 10), "periodic": (5, 10), "irregular": (1, 10), "undecided": (1, 10),
    }  # fmt: skip
    for row in rows.values():
        assert row["share"] == row["n_runs"] / 10
        np.testing.assert_allclose([row["share_low"], row["share_high"]], wilson(row["n_runs"], 10), rtol=1e-9)
    assert [rows["periodic"][f"period_{one}"] for one in ("least", "median", "most")] == [2.0, 6.0, 9.0]
    assert rows["sliding"]["period_median"] is None
    table = found.tables["attractors"]
    assert table["n_runs"].sum() == 10
    assert table["period_median"].notna().sum() == 1


def test_runs_of_one_matrix_are_no_independent_trials(planted, data, settings):
    """Two matrices of ten runs each, all of one kind: the interval is that of two trials."""
    whole = data(10 * ["rest"] + 10 * ["periodic"], 20 * [None])
    whole.members["matrix"] = [0] * 10 + [1] * 10 + [2]
    whole = Data(whole.members, whole.series, recorded=whole.recorded)
    rows = answer(Study(whole, settings)).facts["rows"]
    np.testing.assert_allclose([rows[0]["share_low"], rows[0]["share_high"]], wilson(1, 2), rtol=1e-9)


def test_it_is_asked_where_attractors_are_kept(data, settings):
    kept = data()
    assert answer(Study(Data(kept.members.drop(columns="attractor"), kept.series), settings)) is None
    asking = replace(settings, question=("attractors",))
    assert answer(Study(Data(kept.members.drop(columns="attractor"), kept.series), asking)).lack == "no record"
    smoothed = data([None] * 10)
    assert answer(Study(smoothed, settings)).lack == "none exact"


@pytest.mark.usefixtures("undrawn")
def test_it_leads_the_page(data, settings):
    page = build(data(), settings, "Planted", "", {}).html
    assert "Of 10 runs, 30.0% slide steadily (10.8% to 60.3%), 50.0% settle on a cycle (23.7% to 76.3%)" in page
    assert "10.0% stay irregular" in page
    assert "What do runs settle on?" in page


@pytest.mark.parametrize("reason", ["no record", "none exact"])
def test_words_of_what_is_lacking(reason):
    module = environment("stickslip.analysis.report").get_template("attractors.html").module
    assert module.lack({}, reason).strip()
