"""Engines, tolerances and thresholds on the same matrices: planted biases, the loosest tolerance that is enough."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import AnalysisSettings, Data, Study, build
from stickslip.analysis.questions.runs.engines import answer, contrasts
from stickslip.analysis.report.formats import environment

SETTINGS = AnalysisSettings(
    t_burn=100.0, dt=(0.5,), resamples=2, confidence=0.95, seed=0, margins={"mean": 0.1, "rate": 0.1, "gamma": 0.05}
)
WORDS = environment().get_template("engines.html").module


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


def test_the_sigmoid_is_set_against_the_exact_law(planted):
    found = asked(planted, {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 2})
    row = found.tables["engines"].set_index("quantity").loc["mean n_stick"]
    assert row["reference"] == "n = 200, exact"
    assert row["difference"] == pytest.approx(2)
    assert row["difference_high"] - row["difference_low"] == pytest.approx(0, abs=1e-9)
    assert (row["n_first"], row["verdict"]) == (8, "agree")
    (law,) = found.facts["laws"]
    assert {row["quantity"] for row in law["rows"]} == {"mean n_stick", "exit rate", "gamma"}  # and no ends, none met
    assert "all 3 statistics agree" in WORDS.answer(found.facts)
    assert not WORDS.alerts(found.facts).strip()
    far = asked(planted, {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 8})
    assert "2 of 3 statistics agree; the mean n_stick differs by +" in WORDS.answer(far.facts)
    assert "higher than under the exact engine (margin 10%). Compare it within" in WORDS.alerts(far.facts)


def test_a_difference_that_is_shown_is_said_where_only_the_margin_cannot_be_told(planted):
    """Four of 40 and more, in each system alike, against a margin within the interval."""
    shifts = {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 4}
    first = asked(planted, shifts).tables["engines"].set_index("quantity").loc["mean n_stick"]
    margin = float(first["relative"] + first["relative_high"]) / 2
    found = asked(planted, shifts, settings=replace(SETTINGS, margins=SETTINGS.margins | {"mean": margin}))
    row = found.tables["engines"].set_index("quantity").loc["mean n_stick"]
    assert row["verdict"] == "cannot be told"
    assert row["p_different_holm"] < 1e-4
    said = " ".join(WORDS.answer(found.facts).split())
    assert "2 of 3 statistics can be said to agree; the mean n_stick differs by +" in said
    assert said.endswith(f"), perhaps within the margin of {100 * margin:g}%.")
    assert "cannot be told" not in said
    assert "differ, perhaps within the margin</td>" in WORDS.main(found.facts)
    assert "perhaps within: the estimate is within" in WORDS.main(found.facts)


def test_the_loosest_sufficient_tolerance_is_named(planted):
    """Of means of 40 and more, with a margin of a tenth: 1 is within, 9 is beyond."""
    shifts = {("coulomb", 1e-10): 0, ("coulomb", 1e-6): 0, ("coulomb", 1e-4): 1, ("coulomb", 1e-2): 9}
    (found,) = asked(planted, shifts).facts["tolerances"]
    assert (found["sufficient"], found["n_looser"]) == ("n = 200, exact, tol = 0.0001", 1)
    none = asked(planted, {("coulomb", 1e-10): 0, ("coulomb", 1e-6): 9})
    assert none.facts["tolerances"][0]["sufficient"] is None
    assert "is shown to be enough: the mean n_stick moves by +" in WORDS.answer(none.facts)


def test_thresholds_are_set_against_the_own_definition_of_the_same_runs(planted):
    found = asked(planted, {("sigmoid", 1e-5): 0}, thresholds={0.5: 4, 2.0: -4})
    rows = found.tables["engines"].query("quantity == 'mean n_stick'").set_index("threshold")
    assert set(found.tables["engines"]["kind"]) == {"threshold"}
    assert rows["difference"].to_dict() == pytest.approx({0.5: -4.0, 2.0: 4.0})
    assert "below 0.5 to 2 times r \u03b5 in the same runs, the sigmoid engine" in WORDS.answer(found.facts)


def test_engines_are_compared_by_further_definitions_of_sticking_too(planted):
    """4 of 40 and more are a tenth and less, beyond no margin; 12 are beyond."""
    shifts = {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 0}
    found = asked(planted, shifts, thresholds={0.5: 1, 2.0: -12})
    rows = found.tables["engines"].query("kind == 'threshold' and quantity == 'mean n_stick'").set_index("threshold")
    assert set(rows["reference"]) == {"n = 200, exact"}
    assert rows["difference"].to_dict() == pytest.approx({0.5: -1.0, 2.0: 12.0})
    assert rows["verdict"].to_dict() == {0.5: "agree", 2.0: "differ"}
    assert "in the mean n_stick (1 of 2 agree)" in WORDS.moved(found.facts["thresholds"][0])


def test_survivors_alone_are_compared_and_that_is_said(planted):
    rows, series = [], {}
    for engine in ("coulomb", "sigmoid"):
        for matrix in range(12):
            name, away = f"{engine}-{matrix}", engine == "sigmoid" and matrix % 3 == 0
            ends = {"outcome": "diverged", "t_stop": 900.0} if away else {}
            rows.append(planted.member(name, matrix, **(planted.sigmoid if engine == "sigmoid" else {}), **ends))
            t, n_stick = planted.runs(np.random.default_rng(matrix), 600, 0.69)
            series[name] = t, n_stick - n_stick.min() + 40 + 2 * matrix
    found = answer(Study(Data(pd.DataFrame(rows), series), SETTINGS))
    (law,) = found.facts["laws"]
    assert (law["n_moving"], law["n_runs"]) == (8, 12)
    said = WORDS.answer(found.facts)
    assert "on the 8 of 12 matrices in motion under both" not in said.split("; over all")[-1]
    assert "it cannot be told whether the share of runs that run away agrees (0 of 12 against 4 of 12)" in said
    # survivors are named where the statistic is one of them
    means = [row for row in law["rows"] if not row["is_share"]]
    only = law | {"rows": means, "unknown": means[:1], "agree": means[1:], "differ": [], "worst": means[0]}
    assert "on the 8 of 12 matrices in motion under both, " in WORDS.answer(found.facts | {"laws": [only]})


def test_one_setting_is_nothing_to_compare_and_three_matrices_are_too_few(planted):
    assert asked(planted, {("coulomb", 1e-6): 0}) is None
    few = asked(planted, {("coulomb", 1e-6): 0, ("sigmoid", 1e-5): 2}, n_matrices=3)
    assert few.lack == "few matrices"
    assert WORDS.lack(few.facts, few.lack).count("3 matrices")


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


def suspects(*planting, **how):
    return answer(Study(two_laws(*planting, **how), SETTINGS)).facts["suspects"]


def test_engines_that_disagree_beyond_smoothing_raise_an_alarm(planted):
    """A state that runs off to hundreds sticks never, or now and then for nothing."""
    (one,) = suspects(planted, lambda n_stick, _: np.zeros_like(n_stick))
    assert (one["quantity"], one["first"]) == ("mean n_stick", 0.0)
    assert suspects(planted, lambda n_stick, rng: rng.permutation(n_stick) // 3)


def test_an_alarm_is_the_first_thing_said(planted):
    data = two_laws(planted, lambda n_stick, _: np.zeros_like(n_stick))
    report = build(data, SETTINGS, "A study", "", {})
    assert report.headline[0].startswith("The numerics are suspect, not the physics: mean n_stick is 0")
    assert report.html.index("The numerics are suspect") < report.html.index("<h1>")


def test_engines_that_agree_raise_no_alarm(planted):
    """The same, a shift of 3%, and one of 40% that eps = 0.3 may well explain."""
    assert not suspects(planted, lambda n_stick, _: n_stick)
    shift = round(0.03 * float(planted.runs(np.random.default_rng(0), 600, 0.69)[1].mean()))
    assert not suspects(planted, lambda n_stick, _: n_stick + shift)
    assert not suspects(planted, lambda n_stick, _: n_stick + 13 * shift, eps=0.3)


def test_what_smoothing_may_explain_raises_no_alarm(planted):
    """A third less on a belt of which eps is a fifth; and under an eps of which a tenth agrees with the exact law."""

    def asked_of(belt, *laws):
        rows, series = [], {}
        for matrix in range(8):
            t, n_stick = planted.runs(np.random.default_rng(matrix), 600, 0.69)
            for name, own, share in laws:
                rows.append(planted.member(f"{name}-{matrix}", matrix, belt_speed=belt, **own))
                series[f"{name}-{matrix}"] = t, np.rint(share * (n_stick - n_stick.min() + 40)).astype(int)
        return answer(Study(Data(pd.DataFrame(rows), series), SETTINGS)).facts["suspects"]

    exact, smooth = ("c", {}, 1.0), ("s", planted.sigmoid | {"eps": 0.03}, 0.5)
    assert asked_of(-0.2, exact, smooth)
    assert not asked_of(-0.15, exact, smooth)
    assert not asked_of(-0.2, exact, smooth, ("t", planted.sigmoid | {"eps": 0.003}, 1.0))
    assert asked_of(-0.2, exact, smooth, ("t", planted.sigmoid | {"eps": 0.003}, 0.5))


def test_a_difference_beyond_the_axis_is_an_arrowhead_at_its_edge():
    of = {"margin": 0.1, "verdict": "differ", "open": ""}
    rows = [
        of | {"quantity": "far", "relative": 1.5, "narrow_low": 1.2, "narrow_high": 1.8},
        of
        | {"quantity": "near", "relative": 0.2, "narrow_low": 0.1, "narrow_high": 0.3, "verdict": "cannot be told"},
    ]
    (ax,) = contrasts(rows).axes
    points = {line.get_marker(): line.get_xdata().tolist() for line in ax.lines if len(line.get_xdata()) == 1}
    assert points[">"] == [ax.get_xlim()[1]] == [3]
    assert points["D"] == [2]
