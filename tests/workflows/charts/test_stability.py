"""The chart of stability: its schema, its rule, stability functions against closed forms, its words and its page."""

import json
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.workflows.charts import peers
from stickslip.workflows.charts.hard_cases import Verdict
from stickslip.workflows.charts.peers import METHODS, GivenUp, Method, MethodError, Solution
from stickslip.workflows.charts.stability import Cell, Map, Measured, Reference, classified, stability_maps
from stickslip.workflows.commands import main

TINY = """
chart = "stability"
title = "A tiny <chart>"
n = 3
t_end = 2.0
stiffness = [10.0, 1e3]
factors = [1.0, 1e4]
tolerances = [1e-6, 1e-3]
steps = [0.1, 1e-3]
patience = 30.0
cases = false
seed = 1
"""


def silent(line):
    pass


# ---------------------------------------------------------------------------------------------- the scene


def test_each_axis_makes_stiff_what_it_says(scene):
    mild, stiff = (scene.problem("layer", s) for s in (10.0, 1e3))
    np.testing.assert_allclose(mild.system.friction / mild.delta, 10.0)
    np.testing.assert_allclose(stiff.system.friction / stiff.delta, 1e3)
    bond, damping = scene.problem("bond", 1e4).system, scene.problem("damping", 1e4).system
    apart = bond.stiffness - mild.system.stiffness
    np.testing.assert_allclose(apart, 1e4 * np.array([[1, -1, 0], [-1, 1, 0], [0, 0, 0]]), atol=1e-11)
    np.testing.assert_allclose(damping.damping / mild.system.damping, [1e4, 1, 1])


BAD = {
    "layer too wide": ("[10.0, 1e3]", "[1.0, 1e3]", "stiffness[0]: expected a value greater than 1", "got 1.0"),
    "twice the same": ("[0.1, 1e-3]", "[0.1, 0.1]", "steps: expected each value once", "0.1"),
    "right and wrong overlap": ("seed = 1", "wrong_above = 1e-3", "wrong_above: expected at least 0.01", "got 0.001"),
    "no patience": ("patience = 30.0", "patience = 0.0", "patience: expected a value greater than 0", "got 0.0"),
}


@pytest.mark.parametrize("mistake", BAD)
def test_a_bad_chart_is_refused_with_key_and_remedy_and_nothing_is_written(mistake, refuse):
    refuse(TINY, *BAD[mistake])


# ---------------------------------------------------------------------------------------------- the rule


def answering(z):
    return lambda setting: Solution(np.array(z))


def failing(error):
    def solve(setting):
        raise error

    return solve


ASKED = Cell("layer", 10.0, "planted", 1e-4, None, "not judged")
STEP = replace(ASKED, tolerance=None, step=0.1)


@pytest.mark.parametrize(
    ("cell", "error", "outcome"),
    [
        (ASKED, 0.0, "right"),
        (ASKED, 9e-4, "right"),  # factor = 10 times the tolerance
        (ASKED, 2e-3, "rough"),
        (ASKED, 2e-2, "wrong"),
        (STEP, 9e-4, "right"),  # right_below = 1e-3
        (STEP, 2e-3, "rough"),
        (STEP, 2e-2, "wrong"),
    ],
)
def test_the_rule_on_a_planted_error(scene, cell, error, outcome):
    found = classified(scene, answering([1.0, 2.0 - error]), 1e-4, np.array([1.0, 2.0]), 1e-12, cell)
    assert found.outcome == outcome
    assert found.error == pytest.approx(max(error, 1e-12), rel=1e-9)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_success_that_is_no_number_is_wrong(scene, number):
    found = classified(scene, answering([1.0, number]), 1e-4, np.array([1.0, 2.0]), 1e-12, ASKED)
    assert (found.outcome, found.error) == ("wrong", None)
    assert "not finite" in found.reason


def test_failing_and_slow_keep_their_words(scene):
    failed = classified(scene, failing(MethodError("lost its way")), 1e-4, np.zeros(2), 1e-12, ASKED)
    slow = classified(scene, failing(GivenUp("given up after 1 s")), 1e-4, np.zeros(2), 1e-12, ASKED)
    assert (failed.outcome, failed.reason) == ("failed", "lost its way")
    assert (slow.outcome, slow.reason) == ("too slow", "given up after 1 s")


def test_nothing_is_judged_beyond_what_the_references_agree_to(scene):
    found = classified(scene, answering([1.0]), 1e-4, np.array([1.0]), 2e-3, ASKED)
    assert found.outcome == "not judged"
    assert "2.0e-03" in found.reason


def maps_with(monkeypatch, scene, *methods):
    needed = [m for m in METHODS if m.is_ours or m.name == "SciPy Radau"]
    monkeypatch.setattr(peers, "METHODS", (*needed, *methods))
    names = {method.name for method in methods}
    return [cell for cell in scene.measure(silent).cells if cell.method in names]


def test_a_step_too_short_and_a_compiled_run_too_long_are_not_started(monkeypatch, scene):
    asked = []

    def prepare(problem):
        def solve(setting):
            if problem.t_end == scene.t_end:
                asked.append((round(1 / problem.delta[0]), setting))
            return Solution(np.zeros(3))

        return solve

    few = scene.model_copy(update={"max_steps": 20, "factors": (), "patience": 1e-12})
    step = Method("planted step", "sigmoid", prepare, control="step")
    compiled = Method("planted", "sigmoid", prepare, "CyRK")
    cells = maps_with(monkeypatch, few, step, compiled)
    assert asked == [(10, 0.1), (1000, 0.1), (10, 1e-3), (10, 1e-6)]
    slow = {(c.method, c.stiffness, c.step or c.tolerance): c.reason for c in cells if c.outcome == "too slow"}
    assert set(slow) == {
        ("planted step", 10.0, 1e-3), ("planted step", 1e3, 1e-3), ("planted", 1e3, 1e-3), ("planted", 1e3, 1e-6),
    }  # fmt: skip
    assert slow["planted step", 10.0, 1e-3] == "not started: 2,000 steps"
    assert slow["planted", 1e3, 1e-6].startswith("not started: took")


def test_the_limit_of_rk4_is_its_root():
    """The real root of 1 - x + x^2/2 - x^3/6 + x^4/24 = 1."""
    root = next(r.real for r in np.roots([1 / 24, -1 / 6, 1 / 2, -1]) if abs(r.imag) < 1e-12)
    assert Map("layer", "RK4", []).limit == (pytest.approx(root, abs=1e-9), 1.0)


# ---------------------------------------------------------------------------------------------- end to end


@pytest.mark.long
def test_a_tiny_chart_end_to_end(scene_file, tmp_path, capsys, in_this_process):
    out = tmp_path / "out"
    assert main(["run", str(scene_file), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "The coulomb engine is nowhere wrong without a word" in printed
    page = (out / "report.html").read_text()
    assert "A tiny &lt;chart&gt;" in page
    assert "https://" not in page
    assert not re.search(r"\b(nan|inf|none)\b", re.sub(r'src="[^"]*"', "", page).split("References")[1])

    cells = pd.read_parquet(out / "report" / "cells.parquet")
    assert set(cells.method) == {method.name for method in METHODS}
    fine = cells[(cells.tolerance == 1e-6) & (cells.axis == "layer") & (cells.stiffness == 10.0)]
    assert (fine.error < 1e-3).all()  # every method solves the same equations
    assert (cells[cells.axis != "layer"].error.dropna() < 0.1).all()
    references = pd.read_parquet(out / "report" / "references.parquet")
    assert (references.floor < 1e-8).all()
    assert references.to_exact[references.axis == "layer"].is_monotonic_decreasing
    as_json = json.loads((out / "report" / "tables.json").read_text())
    assert len(as_json["cells"]) == len(cells)
    assert as_json["cases"] == []


# ---------------------------------------------------------------------------------------------- the words


def planted(outcome, error, reason=None):
    cells = [
        Cell("layer", 10.0, "sigmoid engine", 1e-3, None, "right", 2e-3, None, 0.1),
        Cell("layer", 1e3, "sigmoid engine", 1e-3, None, outcome, error, reason, 0.1),
        Cell("layer", 10.0, "SciPy RK45", 1e-6, None, "right", 1e-6, None, 0.1),
        Cell("layer", 1e3, "SciPy RK45", 1e-6, None, "right", 1e-6, None, 0.5),
        Cell("layer", 10.0, "RK4", None, 0.1, "right", 1e-4, None, 0.1),
        Cell("layer", 1e3, "RK4", None, 0.1, "wrong", 0.2, None, 0.1),
    ]
    cases = [Verdict("edge", "why", "how", "sigmoid engine", "refused", reason="no way")]
    return Measured(cells, [Reference("layer", 10.0, "a", "b", 1e-12, 0.1)], cases, [])


def test_words_follow_the_cells(scene, page, said, undrawn):
    wrong, failed = (
        " ".join([*report.headline, *said(report)])
        for outcome in (("wrong", 0.5), ("failed", None, "stalled"))
        for report in [page(scene, planted(*outcome))]
    )
    assert "The sigmoid engine is wrong without a word in 1 of its cells and cases" in wrong
    assert "sigmoid engine in 1 of 2 cells (from stiffness 1e+3, tolerance 1e-3; error up to 5e-1)" in wrong
    assert "error is at most 500 times its tolerance (at 1e+3" in wrong
    assert "The sigmoid engine is nowhere wrong without a word; of its 2 cells 1 right and 1 failed" in failed
    assert "Failing with a message: sigmoid engine in 1." in failed
    for text in (wrong, failed):
        assert "Of 2 other methods 1 return an answer that is wrong as a success somewhere: RK4." in text
        assert "2.2 (SciPy RK45)" in text  # 5 times in two decades
        assert "beyond twice that 0 of 1 runs fail with a message, the others go on with an error of 2 h" in text
        assert "sigmoid engine: right in 0 of 1 hard cases; an error with a message in 1 (edge)." in text


def test_every_outcome_has_a_look_of_its_own():
    outcomes = ("right", "rough", "wrong", "failed", "too slow", "not judged")
    cells = [Cell("layer", 10.0 ** (k + 1), "a", 1e-3, None, outcome, 1e-4) for k, outcome in enumerate(outcomes)]
    (ax,) = [ax for ax in stability_maps([Map("layer", "a", cells)]).axes if ax.patches]
    looks = {(patch.get_facecolor(), text.get_text()) for patch, text in zip(ax.patches, ax.texts, strict=True)}
    assert len(looks) == len(outcomes)


def test_the_limit_is_drawn_where_it_is(monkeypatch):
    """h = 2 / stiffness passes the centres of the cells (20, 0.1), (200, 0.01) and (2000, 0.001)."""
    monkeypatch.setattr(Map, "limit", (2.0, 1.0))
    cells = [
        Cell("layer", stiffness, "RK4", None, step, "right", 1e-4)
        for stiffness in (20.0, 200.0, 2000.0)
        for step in (1e-3, 1e-2, 1e-1)
    ]
    (drawn,) = next(ax for ax in stability_maps([Map("layer", "RK4", cells)]).axes if ax.patches).lines
    x, y = drawn.get_xdata(), drawn.get_ydata()
    np.testing.assert_allclose(x + y, 2.0, atol=1e-12)
    assert (x.min(), x.max()) == pytest.approx((0.0, 2.0), abs=0.01)
