"""Engines, tolerances and thresholds on the same matrices: planted biases, the loosest tolerance that is enough."""

import numpy as np
import pandas as pd
import pytest
from stickslip.analysis.groups import groups
from stickslip.analysis.questions.engines_section import engines_section
from stickslip.analysis.report.section import Data

from stickslip.analysis import AnalysisSettings, build

MARGINS = {"mean": 0.1, "rate": 0.1, "gamma": 0.05}


def study(planted, shifts, n_matrices=8, **thresholds):
    """Runs that are the first setting's, higher by a shift of their own; `shifts` by (engine, tolerance)."""
    rows, series, by_threshold = [], {}, {}
    for (engine, tolerance), shift in shifts.items():
        for matrix in range(n_matrices):
            name = f"{engine}-{tolerance:g}-{matrix}"
            own = planted.sigmoid | {"rtol": tolerance, "atol": tolerance} if engine == "sigmoid" else {
                "tol": tolerance}  # fmt: skip
            rows.append(planted.member(name, matrix, **own))
            rng = np.random.default_rng(matrix)
            t, n_stick = planted.runs(rng, 600, 0.69)
            series[name] = t, n_stick - n_stick.min() + 40 + 2 * matrix + shift
            for c, lower in thresholds.get("thresholds", {}).items():
                by_threshold[name, c] = t, series[name][1] - lower
    members = pd.DataFrame(rows)
    data = Data(members, series, thresholds=by_threshold)
    return engines_section(data, groups(members), t_burn=100.0, margins=MARGINS, confidence=0.95)


def test_the_sigmoid_is_set_against_the_exact_law(planted):
    section = study(planted, {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 2})
    (table,) = section.tables
    row = table.frame.set_index("quantity").loc["mean n_stick"]
    assert row["reference"] == "n = 200, coulomb"
    assert row["difference"] == pytest.approx(2)
    assert row["difference_high"] - row["difference_low"] == pytest.approx(0, abs=1e-9)
    assert row["n_matrices"] == 8
    assert row["verdict"] == "equivalent"
    assert "share collapsed (certified)" not in set(table.frame["quantity"])  # the sigmoid certifies none
    far = study(planted, {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 20})
    assert "gone quiet if collapsed or silent" in table.caption
    assert "1 differs: mean n_stick, +" in far.statements[0]
    assert "differ" not in section.statements[0].replace("different", "")


def test_the_loosest_sufficient_tolerance_is_named(planted):
    """Sampling error of the mean, from levels 0, 2, ..., 14 over 8 matrices: t(7) sqrt(6 / 2) = 4.1 and more."""
    shifts = {("coulomb", 1e-10): 0, ("coulomb", 1e-6): 0, ("coulomb", 1e-4): 1, ("coulomb", 1e-2): 9}
    section = study(planted, shifts)
    (said,) = section.lead
    assert "is that of n = 200, coulomb, tol = 0.0001, the setting this scene should use" in said
    assert "1 looser one not shown to be sufficient" in said
    none = study(planted, {("coulomb", 1e-10): 0, ("coulomb", 1e-6): 9})
    assert "No looser tolerance is shown to be sufficient: the bias of mean n_stick" in none.lead[0]


def test_thresholds_are_set_against_the_own_definition_of_the_same_runs(planted):
    section = study(planted, {("sigmoid", 1e-5): 0}, thresholds={0.5: 4, 2.0: -4})
    (table,) = section.tables
    assert table.name == "thresholds"
    rows = table.frame[table.frame["quantity"] == "mean n_stick"].set_index("threshold")
    assert rows["difference"].to_dict() == pytest.approx({0.5: -4.0, 2.0: 4.0})
    assert not any(name.startswith("share") for name in table.frame["quantity"])
    assert "c = 0.5 to 2 on the same runs, move mean n_stick by -" in section.statements[0]


def test_one_setting_is_nothing_to_compare(planted):
    assert study(planted, {("coulomb", 1e-6): 0}) is None


def two_laws(planted, change, eps=0.03):
    """Both laws on the same matrices, where `change` makes the exact law's series out of the sigmoid's."""
    rows, series = [], {}
    for matrix in range(8):
        t, n_stick = planted.runs(np.random.default_rng(matrix), 600, 0.69)
        for name, own, path in (
            (f"c-{matrix}", {}, change(n_stick, np.random.default_rng([matrix, 1]))),
            (f"s-{matrix}", planted.sigmoid | {"eps": eps}, n_stick),
        ):
            rows.append(planted.member(name, matrix, **own))
            series[name] = t, path
    return Data(pd.DataFrame(rows), series)


def alarms(*planting, **how):
    data = two_laws(*planting, **how)
    found = groups(data.members)
    return engines_section(data, found, t_burn=100.0, margins=MARGINS, confidence=0.95).alarms


def test_engines_that_disagree_beyond_smoothing_raise_an_alarm(planted):
    """A state that runs off to hundreds sticks never, or now and then for nothing."""
    assert "mean n_stick is 0.00 under" in alarms(planted, lambda n_stick, _: np.zeros_like(n_stick))[0]
    assert alarms(planted, lambda n_stick, rng: rng.permutation(n_stick) // 3)


def test_an_alarm_is_the_first_thing_said(planted):
    data = two_laws(planted, lambda n_stick, _: np.zeros_like(n_stick))
    settings = AnalysisSettings(t_burn=100.0, dt=(0.5,), resamples=2, confidence=0.95, seed=0, margins=MARGINS)
    report = build(data, settings, "A study", "", {})
    assert report.headline[0].startswith("The numerics are suspect, not the physics: ")
    assert report.html.index("The numerics are suspect") < report.html.index("<h1>")


def test_engines_that_agree_raise_no_alarm(planted):
    """The same, a shift of 3%, and one of 40% that eps = 0.3 may well explain."""
    assert not alarms(planted, lambda n_stick, _: n_stick)
    shift = round(0.03 * float(planted.runs(np.random.default_rng(0), 600, 0.69)[1].mean()))
    assert not alarms(planted, lambda n_stick, _: n_stick + shift)
    assert not alarms(planted, lambda n_stick, _: n_stick + 13 * shift, eps=0.3)
