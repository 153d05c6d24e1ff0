"""The chart of stability: its schema, its rule, stability functions against closed forms, its words and its page."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.workflows.commands import main
from stickslip.workflows.gallery.charts import runner
from stickslip.workflows.gallery.charts.peers import METHODS
from stickslip.workflows.gallery.charts.stability import Cell, Column, Map, Measured, judged, maps_of

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
seed = 1
"""


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
    "right and wrong overlap": ("1e-3]\nsteps", "2e-3]\nsteps", "tolerances[1]: expected a value less", "got 0.002"),
    "no patience": ("patience = 30.0", "patience = 0.0", "patience: expected a value greater than 0", "got 0.0"),
}


@pytest.mark.parametrize("mistake", BAD)
def test_a_bad_chart_is_refused_with_key_and_remedy_and_nothing_is_written(mistake, refuse):
    refuse(TINY, *BAD[mistake])


# ---------------------------------------------------------------------------------------------- the rule


ASKED = Cell(axis="layer", stiffness=10.0, method="planted", tolerance=1e-4)
STEP = replace(ASKED, tolerance=None, step=0.1)


@pytest.mark.parametrize(("cell", "error", "outcome"), [
    (ASKED, 1e-12, "right"),
    (ASKED, 9e-4, "right"),  # 10 times the tolerance
    (ASKED, 2e-3, "rough"),
    (ASKED, 2e-2, "wrong"),
    (STEP, 9e-4, "right"),  # up to 1e-3
    (STEP, 2e-3, "rough"),
    (STEP, 2e-2, "wrong"),
])  # fmt: skip
def test_the_rule_on_a_planted_error(cell, error, outcome):
    assert judged(replace(cell, error=error), 1e-12).outcome == outcome


def test_what_did_not_end_well_keeps_its_words():
    failed = replace(ASKED, outcome="failed", reason="lost its way")
    assert judged(failed, 1e-12) == failed


def test_nothing_is_judged_beyond_what_the_references_agree_to():
    found = judged(replace(ASKED, error=2e-3), 2e-3)
    assert found.outcome == "not judged"
    assert "2.0e-03" in found.reason


# ---------------------------------------------------------------------------------------------- end to end


@pytest.mark.long
def test_a_tiny_chart_end_to_end(scene_file, tmp_path, capsys):
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
    timed = cells[cells.apart.notna() & (cells.tolerance == 1e-6)]
    # two axes of the exact law, one of the smoothed, with two stiffnesses each
    assert dict(timed.method.value_counts()) == {"coulomb engine": 4, "DP5 with events": 4, "sigmoid engine": 2}
    assert timed.parted_at.isna().all()
    assert (timed.apart < 1e-4).all()  # a simple crossing turns an error of w into one of t


# ---------------------------------------------------------------------------------------------- the words


def planted(outcome, error, reason=None):
    def cell(stiffness, method, setting, outcome, error, **more):
        by = {"step": setting} if method == "Moreau-Jean" else {"tolerance": setting}
        return Cell(axis="layer", stiffness=stiffness, method=method, outcome=outcome, error=error, **by, **more)

    cells = [
        cell(10.0, "sigmoid engine", 1e-3, "right", 2e-3, apart=1e-5),
        cell(1e3, "sigmoid engine", 1e-3, outcome, error, reason=reason, parted_at=0.5, apart=2e-5),
        cell(10.0, "SciPy RK45", 1e-6, "right", 1e-6),
        cell(1e3, "SciPy RK45", 1e-6, "right", 1e-6),
        cell(10.0, "Moreau-Jean", 0.1, "right", 1e-4),
        cell(1e3, "Moreau-Jean", 0.1, "wrong", 0.2),
    ]
    return Measured(cells, [Column(axis="layer", stiffness=10.0, floor=1e-12)])


def test_words_follow_the_cells(scene, said, undrawn):
    wrong, failed = (
        " ".join([*report.headline, *said(report)])
        for outcome in (("wrong", 0.5), ("failed", None, "stalled"))
        for report in [runner.report(scene, planted(*outcome))]
    )
    assert "The sigmoid engine is wrong without a word in 1 of its cells" in wrong
    assert "sigmoid engine in 1 of 2 cells (from stiffness 1e+3, tolerance 1e-3; error up to 5e-1)" in wrong
    assert "error is at most 500 times its tolerance (at 1e+3" in wrong
    assert "The sigmoid engine is nowhere wrong without a word; of its 2 cells 1 right and 1 failed" in failed
    assert "Failing with a message: sigmoid engine in 1." in failed
    for text in (wrong, failed):
        assert "Of 2 other methods 1 return an answer that is wrong as a success somewhere: Moreau-Jean." in text
        assert "to the end in 1 of 2 cells, and up to where it parts from them within 2e-5 in time" in text


def test_every_outcome_has_a_look_of_its_own():
    outcomes = ("right", "rough", "wrong", "failed", "too slow", "not judged")
    cells = [
        Cell(axis="layer", stiffness=10.0 ** (k + 1), method="a", tolerance=1e-3, outcome=outcome, error=1e-4)
        for k, outcome in enumerate(outcomes)
    ]
    (ax,) = [ax for ax in maps_of([Map("layer", "a", cells)]).axes if ax.patches]
    looks = {(patch.get_facecolor(), text.get_text()) for patch, text in zip(ax.patches, ax.texts, strict=True)}
    assert len(looks) == len(outcomes)
