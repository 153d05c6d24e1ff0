"""Engines, tolerances and thresholds on the same matrices: planted biases, grouped by how they come out."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import AnalysisSettings, Study, measures
from stickslip.analysis.contrast import Contrast, Share, Statistic
from stickslip.analysis.findings.finding import Lack, Outcomes, Reason, Scale, Verdict, levels
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.outcomes import differences, forest
from stickslip.analysis.questions.runs.changes import answer
from stickslip.analysis.stats.estimates import Estimate, ratio
from stickslip.analysis.steps import Kind, Step
from stickslip.analysis.style import EXACT
from tests.analysis.designs import Data

SETTINGS = AnalysisSettings(
    t_burn=100.0, dt=(0.5,), resamples=2, confidence=0.95, seed=0, margins={"mean": 0.1, "rate": 0.1, "gamma": 0.05}
)
NO_MARGINS = replace(SETTINGS, margins={})


def asked(planted, shifts, thresholds=(), n_matrices=8, settings=SETTINGS):
    """Runs that are the first setting's, higher by a shift of their own; `shifts` by (engine, tolerance)."""
    rows, series, by_threshold = [], {}, {}
    for (engine, tolerance), shift in shifts.items():
        for matrix in range(n_matrices):
            name = f"{engine}-{tolerance:g}-{matrix}"
            of_sigmoid = planted.sigmoid | {"rtol": tolerance, "atol": tolerance}
            rows.append(planted.member(name, matrix, **(of_sigmoid if engine == "sigmoid" else {"tol": tolerance})))
            t, n_stick = planted.runs(np.random.default_rng(matrix), 600, 0.69)
            series[name] = t, n_stick - n_stick.min() + 40 + 2 * matrix + shift
            for c, lower in dict(thresholds).items():
                by_threshold.setdefault(name, {})[c] = t, series[name][1] - lower
    return answer(Study(Data(pd.DataFrame(rows), series, thresholds=by_threshold), settings))


def table_of(found, quantity="mean n_stick"):
    table = found.tables["changes"]
    return table[table["quantity"] == quantity]


def test_the_sigmoid_is_set_against_the_exact_law(planted):
    found = asked(planted, {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 2})
    (row,) = table_of(found).itertuples()
    assert row.reference == "n = 200, exact"
    assert row.difference == pytest.approx(2)
    assert row.difference_high - row.difference_low == pytest.approx(0, abs=1e-9)
    assert (row.n_first, row.verdict) == (8, Verdict.EQUAL)
    far = asked(planted, {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 8})
    lead = far.findings[0]
    assert (lead.different, lead.equal, lead.undecided) == (("sigmoid",), (), ())
    assert lead.largest.quantity.name == "mean number of sticking blocks"
    said = sentence(lead)
    assert re.match(r"Sigmoid gives [\d.]+% \([^)]*\) more sticking blocks than the exact law", said)
    assert len(said.split()) <= 25
    assert not far.alerts


def test_settings_agree_only_within_margins_that_are_declared(planted):
    """One of 40 and more in each system: within a margin of a tenth, and without one a difference."""
    shifts = {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 1}
    lead = asked(planted, shifts).findings[0]
    assert (lead.equal, lead.different) == (("sigmoid",), ())
    bare = asked(planted, shifts, settings=replace(SETTINGS, margins={})).findings[0]
    assert (bare.different, bare.equal) == (("sigmoid",), ())
    same = asked(planted, dict.fromkeys(shifts, 0), settings=replace(SETTINGS, margins={}))
    assert same.findings[0].equal == ("sigmoid",)
    assert set(table_of(same)["verdict"]) == {Verdict.SAME}


def test_a_difference_that_is_shown_is_one_whether_or_not_it_is_beyond_the_margin(planted):
    """Four of 40 and more, in each system alike, against a margin within the interval."""
    shifts = {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 4}
    (first,) = table_of(asked(planted, shifts)).itertuples()
    margin = float(first.relative + first.relative_high) / 2
    found = asked(planted, shifts, settings=replace(SETTINGS, margins=SETTINGS.margins | {"mean": margin}))
    (row,) = table_of(found).itertuples()
    assert row.verdict == Verdict.MORE
    assert row.p_different_holm < 1e-4


def test_tolerances_are_grouped_by_outcome(planted):
    """Of means of 40 and more, with a margin of a tenth: 1 is within, 9 is beyond."""
    shifts = {("coulomb", 1e-10): 0, ("coulomb", 1e-6): 0, ("coulomb", 1e-4): 1, ("coulomb", 1e-2): 9}
    different, equal, *_ = asked(planted, shifts).findings
    assert different.other == equal.other == "the tightest tolerance"
    assert equal.equal == ("exact with tol up to 1e-4",)
    assert different.different == ("exact with tol = 0.01",)


def test_thresholds_are_set_against_the_own_definition_of_the_same_runs(planted):
    found = asked(planted, {("sigmoid", 1e-5): 0}, thresholds={0.5: 4, 2.0: -4})
    rows = table_of(found)
    assert set(found.tables["changes"]["kind"]) == {"threshold"}
    assert dict(zip(rows["second_value"], rows["difference"], strict=True)) == pytest.approx({"0.5": -4.0, "2": 4.0})
    assert found.findings[0].other == "its own definition of sticking"


def test_engines_are_compared_by_further_definitions_of_sticking_too(planted):
    """4 of 40 and more are a tenth and less, beyond no margin; 12 are beyond."""
    shifts = {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 0}
    found = asked(planted, shifts, thresholds={0.5: 1, 2.0: -12})
    rows = table_of(found).query("kind == 'threshold'")
    assert set(rows["reference"]) == {"n = 200, exact"}
    assert dict(zip(rows["second_value"], rows["difference"], strict=True)) == pytest.approx({"0.5": -1.0, "2": 12.0})
    assert dict(zip(rows["second_value"], rows["verdict"], strict=True)) == {"0.5": Verdict.EQUAL, "2": Verdict.MORE}
    different = [name for one in found.findings if isinstance(one, Outcomes) for name in one.different]
    assert "sigmoid with threshold = 2" in different


def test_how_runs_end_is_compared_too(planted):
    rows, series = [], {}
    for engine in ("coulomb", "sigmoid"):
        for matrix in range(12):
            name, away = f"{engine}-{matrix}", engine == "sigmoid" and matrix % 3 == 0
            ends = {"outcome": "diverged", "t_stop": 900.0} if away else {}
            rows.append(planted.member(name, matrix, **(planted.sigmoid if engine == "sigmoid" else {}), **ends))
            t, n_stick = planted.runs(np.random.default_rng(matrix), 600, 0.69)
            series[name] = t, n_stick - n_stick.min() + 40 + 2 * matrix
    found = answer(Study(Data(pd.DataFrame(rows), series), SETTINGS))
    (mean,), (away,) = (
        table_of(found, name).itertuples() for name in ("mean n_stick", "share of runs that run away")
    )
    assert (mean.n_first, mean.verdict) == (8, Verdict.SAME)
    assert (away.n_first, away.first, away.second) == (12, 0.0, pytest.approx(1 / 3))


def test_one_setting_is_nothing_to_compare_and_three_matrices_are_too_few(planted):
    assert asked(planted, {("coulomb", 1e-6): 0}) is None
    few = asked(planted, {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 2}, n_matrices=3)
    assert few.findings[0].undecided == ("sigmoid",)
    assert set(few.tables["changes"]["verdict"]) == {Verdict.UNJUDGED}


def test_where_no_run_is_in_motion_that_is_the_reason(planted):
    """However many systems there are."""
    members, series = planted.ensemble({"coulomb": 0.69, "sigmoid": 0.69}, 12)
    study = Study(Data(members.assign(outcome="collapsed"), series), SETTINGS)
    assert answer(study).findings == [Lack("how far statistics of motion differ between engines", Reason.NO_MOTION)]


def test_where_most_blocks_stick_those_that_slip_are_compared(planted):
    """Beside a bound of 200, and not where the scene has a margin of what sticks."""
    shifts = {("coulomb", 1e-6): 100, ("sigmoid", 1e-5): 102}
    found = asked(planted, shifts, settings=NO_MARGINS)
    (row,) = table_of(found, measures.MEAN_SLIPPING).itertuples()
    assert not len(table_of(found))
    assert row.difference == pytest.approx(-2)
    names = {level.quantity.name for finding in found.findings for level in levels(finding)}
    assert "mean number of slipping blocks" in names
    assert "mean number of sticking blocks" not in names
    for further, settings in ((shifts, SETTINGS), ({key: shift - 90 for key, shift in shifts.items()}, NO_MARGINS)):
        assert len(table_of(asked(planted, further, settings=settings))) == 1


def test_the_axis_holds_all_differences_and_the_interval_of_one_may_go_on_beyond():
    mean = Statistic("mean", ratio, 0.1)

    def beside(name, value, half):
        estimate = Estimate(value, value - half, value + half)
        found = Contrast(replace(mean, name=name), 8, 8, Estimate(1.0), Estimate(2.0), estimate, estimate)
        return Step(Kind.LAW, "", "", found)

    rows = [beside("far", 1.5, 2.0), beside("near", 0.02, 0.1), beside("shown", 0.2, 0.1)]
    (ax,) = differences(rows).axes
    cut, far, near, shown = (line for line in ax.lines if len(line.get_xdata()) == 1)
    assert (cut.get_marker(), cut.get_xdata().tolist()) == (">", [ax.get_xlim()[1]])
    assert (far.get_marker(), far.get_xdata().tolist()) == ("o", [150.0])
    assert 150.0 < ax.get_xlim()[1] < 350.0
    assert (near.get_xdata().tolist(), near.get_markerfacecolor()) == ([2.0], "white")
    assert (shown.get_xdata().tolist(), shown.get_markerfacecolor()) == ([20.0], EXACT)
    assert ax.get_xlabel() == "difference in %"
    share = {"statistic": Share("share", ratio), "scale": Scale.ABSOLUTE}
    of_share = [replace(row, contrast=replace(row.contrast, **share)) for row in rows[:2]]
    assert list(forest(None, [*rows[:2], of_share[0]], "differences")) == ["contrasts"], "one mark is no figure"
    (ax,) = forest(None, [*rows, *of_share], "differences")["contrasts_of_shares"].recipe().axes
    assert ax.get_xlabel() == "difference in percentage points"
    assert forest(None, rows, "differences")["contrasts"].caption.startswith("Filled marks are significant")
    assert forest(None, rows[:2], "differences")["contrasts"].caption.startswith("There are no significant")
