"""The chart of the paper's figures: its scenes, known values in its tables, words that follow the numbers."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from stickslip.pipeline import run_scene
from stickslip.sim import EventSeries, simulate
from stickslip.workflows.charts import load_chart, runner
from stickslip.workflows.charts.peers import random_ratios
from stickslip.workflows.commands import main
from stickslip.workflows.paper import claims, figures_1_2, figures_3_to_5
from stickslip.workflows.scenes import shipped

TINY = """
chart = "paper"
figures = [1, 2, 3, 4, 5, 6]
title = "A tiny <chart>"
n = [5, 20]
draws = 2
t_end = 30.0
t_shown = 20.0
sensitivity_n = [5, 20]
sets = 2
sizes = [0.01, 0.1]
long_n = 40
long_matrices = 3
long_t_end = 60.0
t_burn = 5.0
dt = [0.1, 1.0]
claims = true
survival_n = [5, 20]
survival_matrices = 2
survival_t_end = 300.0
certificate_n = 5
certificate_draws = 3
certificate_t_end = 300.0
blocks = 8
workers = 1
seed = 0
"""

ROOT = Path(__file__).parents[2]
SCENES = [*(f"fig{k}" for k in range(1, 7)), "paper"]


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    file = tmp_path_factory.mktemp("paper") / "tiny.toml"
    file.write_text(TINY)
    return file


@pytest.fixture(scope="module")
def scene(scene_file):
    return load_chart(scene_file)


@pytest.fixture(scope="module")
def measured(scene):
    """The ensemble without workers of its own: what the pipeline does with them is tested there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(claims, "run_scene", lambda *of, **_: run_scene(*of[:3], 0))
        return scene.measure(lambda line: None)


@pytest.fixture(scope="module")
def report(scene, measured, page):
    """Without what is drawn, which is looked at figure by figure."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(runner.FORMS, "picture", lambda draw: "")
        return page(scene, measured)


# ---------------------------------------------------------------------------------------------- the scenes


@pytest.mark.parametrize("name", SCENES)
def test_shipped_scenes_have_their_figures(name):
    scene = load_chart(shipped()[name])
    assert scene.figures == (tuple(range(1, 7)) if name == "paper" else (int(name[3:]),))
    assert scene.claims == (name == "paper")


def test_the_shipped_certificate_is_tried_often_enough():
    """At n = 20 and 50 every draw is certified, so that 200 certified runs are continued to t = 2000."""
    scene = load_chart(shipped()["paper"])
    assert {20, 50} <= set(scene.certificate_n)
    assert scene.certificate_draws >= 100
    assert scene.certificate_t_end == 2000.0


BAD = {
    "no such figure": ("figures = [1, 2, 3, 4, 5, 6]", "figures = [1, 7]", "figures[1]: expected", "got 7"),
    "shown beyond the end": ("t_shown = 20.0", "t_shown = 40.0", "t_shown: expected", "got 40"),
    "nothing after the burn": ("t_burn = 5.0", "t_burn = 60.0", "t_burn: expected", "got 60"),
    "no such flag": ("claims = true", 'claims = "yes"', "claims: expected", "got 'yes'"),
}


@pytest.mark.parametrize("mistake", BAD)
def test_a_bad_chart_is_refused_with_key_and_remedy_and_nothing_is_written(mistake, refuse):
    refuse(TINY, *BAD[mistake])


# ---------------------------------------------------------------------------------------------- known values


def test_stick_interval_of_figure_1(measured):
    """AUDIT, one block: [(-mu - rho v) / kappa, (mu - rho v) / kappa], exit at (sgn(v) mu - rho v) / kappa."""
    for one, v in zip(measured.portraits, (-0.5, 0.5), strict=True):
        assert one.v == v
        np.testing.assert_allclose(
            [*one.stick, one.exit], [-1 - 0.1 * v, 1 - 0.1 * v, np.sign(v) - 0.1 * v], atol=1e-12
        )
        (leaving,) = (w for _, w, is_exit in one.paths if is_exit)
        assert abs(leaving[-1]) < abs(v)  # after the exit |w| < |v|


def test_corners_of_figure_2(report):
    """AUDIT, table of two blocks."""
    table = report.tables["corners"].set_index(["sign", "lambda_1", "lambda_2"])
    for key, z, folds in [
        ((1, 1, 1), (-0.752411575562701, -0.6077170418006431), ("visible", "visible")),
        ((1, 1, -1), (-0.43086816720257237, 0.4212218649517685), ("visible", "invisible")),
        ((-1, 1, 1), (-1.3170731707317074, -0.21951219512195122), ("visible", "visible")),
        ((-1, -1, -1), (1.6097560975609757, 0.2682926829268293), ("invisible", "invisible")),
    ]:
        row = table.loc[key]
        np.testing.assert_allclose(row[["z_1", "z_2"]].astype(float), z, atol=1e-10)
        assert (row.fold_1, row.fold_2) == folds
    assert len(table) == 8


def test_exits_of_figure_2(measured):
    """AUDIT, two blocks: from the middle, block 2 and then block 1; from the double exit both at once."""
    for one, second in zip(measured.parallelograms, (0.8162276148517664, 0.8202362716222801), strict=True):
        a, b, _ = one.paths
        assert [(t, block) for t, block, _ in a.events] == [(pytest.approx(0.5625), 1), (pytest.approx(second), 0)]
        assert [(t, block) for t, block, _ in b.events] == [(pytest.approx(0.5), 0), (pytest.approx(0.5), 1)]


def test_eq_8_as_printed_is_no_corner(measured):
    """AUDIT, misprints, (8): wrong for either sign, by more than the whole width of the region at s = +1."""
    for one in measured.parallelograms:
        assert min(corner.misprint for corner in one.corners) > 1.5


def test_modes_of_figure_6(measured):
    """AUDIT, hidden dynamics, G = 0.5."""
    coulomb, modified = measured.blow_ups
    (mode,) = coulomb.modes
    np.testing.assert_allclose(mode, (-0.5, 0.5, True), atol=1e-12)
    q = -0.258652022504152763
    np.testing.assert_allclose(modified.modes, [(-0.5, 0, True), (q, -q, False), (0, 0.5, True)], atol=1e-12)


def test_two_blocks_from_entry_to_exit(report):
    """AUDIT, hidden dynamics: basins of (1, 1) and (-1, -1), saddle-node at t = 0.0047988, exit at t = 0.3125."""
    table = report.tables["hidden"]
    right, left = (table[table.from_side == side] for side in (1, -1))
    assert right.kind.tolist() == ["entry", "entry", "exit", "exit"]
    assert left.kind.tolist() == ["entry", "entry", "jump", "exit", "exit"]
    np.testing.assert_allclose(right[["lambda_1_after", "lambda_2_after"]].iloc[1], [0.0, 0.5], atol=1e-10)
    np.testing.assert_allclose(left[["lambda_1_after", "lambda_2_after"]].iloc[1], [-0.5, 0.0], atol=1e-10)
    assert left.t.iloc[2] == pytest.approx(0.0047988, abs=5e-8)
    for run in (right, left):
        first, second = run[run.kind == "exit"].itertuples()
        assert (first.block, first.t) == (1, pytest.approx(0.3125, abs=1e-10))
        assert second.block == 0


def test_static_friction_above_kinetic_leaves_two_futures(measured):
    """AUDIT, uniqueness. Two solutions for 1 < |F| / mu < r, z from -(r + rho v) / kappa to -(1 + rho v) / kappa."""
    (one,) = measured.undetermined
    r, rho, v = one.ratio, 0.1, -0.5
    expected = [[-r - rho * v, -1 - rho * v], [1 - rho * v, r - rho * v]]
    np.testing.assert_allclose(one.open, expected, atol=1e-9)
    assert one.n_coulomb == 1
    stick, slip = one.futures
    assert (stick.begins, slip.begins) == ("sticks on", "slips at once to the right")
    assert (stick.t[0], stick.z[0], stick.w[0]) == (slip.t[0], slip.z[0], slip.w[0]) == (0.0, one.z, v)
    assert stick.events[0] == (pytest.approx((-r - rho * v - one.z) / v, abs=1e-9), "exit")
    assert slip.events == []
    assert np.ptp(slip.w[-140:]) < 0.5 * np.ptp(stick.w[-140:])  # one comes to rest, the other sticks and slips on


def test_the_future_that_slips_is_the_exact_engines(measured):
    """Where it slips Coulomb's friction acts: from just beyond the belt, the closed form is the engine's run."""
    (one,) = measured.undetermined
    slip = one.futures[1]
    run = simulate(figures_1_2.single(one.v), one.z, one.v, slip.t[-1], tol=1e-12, stop_early=False)
    assert run.z[0] == pytest.approx(slip.z[-1], abs=1e-8)


def test_runs_around_a_double_exit_stay_close(measured):
    assert len(measured.uniqueness) == claims.DIRECTIONS
    assert all(pair.n_events >= 2 for pair in measured.uniqueness)  # both blocks leave
    assert max(pair.apart for pair in measured.uniqueness) < 3 * claims.APART


def test_no_single_block_sticks_again(measured):
    (one,) = measured.one_block
    assert one.n_blocks == 8
    assert 0 < one.n_exits <= 8
    assert one.n_again == 0


def test_small_groups_come_to_rest_by_certificate(measured, report):
    """AUDIT, section 4: n = 20 ends in n_stick = 0, linearly stable in every draw; and no certificate is false."""
    for row in measured.survival:
        assert (row.certified, row.moving, row.stable) == (2, 0, 2)
    certificate = report.tables["certificate"]
    assert (certificate.n_after == 0).all()
    assert (certificate.t_certified > certificate.t_last).all()


# ---------------------------------------------------------------------------------------------- the parts


def events(t, block, mode, initial, t_end):
    return EventSeries(np.array(t), np.array(block), np.array(mode), np.array(initial), 0.0, t_end)


@pytest.mark.parametrize(
    ("outcome", "t_last", "n_last", "expected"),
    [
        ("collapsed", 10.0, 0, "certified"),
        ("finished", 10.0, 0, "silent"),
        ("finished", 90.0, 0, "sustained"),  # too late to tell
        ("finished", 10.0, 3, "sustained"),
        ("diverged", 10.0, 0, "diverged"),
        ("failed", 10.0, 0, "failed"),
    ],
)
def test_fates(outcome, t_last, n_last, expected):
    assert figures_3_to_5.fate(outcome, np.array([0.0, t_last]), np.array([5, n_last]), 100.0) == expected


def test_a_late_event_is_not_yet_apart_but_a_missing_one_is():
    """A unit of time with one block more or less on average: a delay of 0.5 never is, an absence at t = 4 is at 5."""

    class Planted:
        def __init__(self, exits):
            self.events = events(exits, range(len(exits)), [1] * len(exits), [0, 0], 10.0)

        def n_stick(self, times):
            return self.events.n_stick(times)

    base = Planted([2.0, 4.0])
    assert figures_3_to_5.apart_from(Planted([2.5, 4.0]), base) is None
    assert figures_3_to_5.apart_from(Planted([2.0]), base) == pytest.approx(5.0, abs=0.1)


def test_perturbations_of_figure_4_are_those_of_an_ensemble(scene):
    """One draw goes the same way at every size, and by at most the size."""
    base = scene.system(20, 0)
    small, large = (scene.perturbed(20, size, 0).stiffness - base.stiffness for size in (0.01, 0.1))
    np.testing.assert_allclose(large, 10 * small, atol=1e-12)
    assert 0 < np.abs(small).max() <= 0.01 * 0.2 * (1 + 1e-12)
    r = random_ratios(scene.seed, 200, 1)
    assert (r > 0).all()
    assert (r <= 1).all()


# ---------------------------------------------------------------------------------------------- words


@pytest.fixture
def said(scene, measured, page, undrawn):
    """The lead of the page, of what was measured but for some changes: the lines that begin with some words."""

    def lines(head, **changes):
        found = page(scene, replace(measured, **changes)).headline
        return [line.removeprefix(head) for line in found if line.startswith(head)]

    return lines


def draw(**changes):
    row = figures_3_to_5.Draw(20, 0, "coulomb", "certified", 40, 6, 0.5, 25.0, 60.0, 0, 0.0)
    return replace(row, **changes)


def test_words_of_figure_3_follow_the_draws(said):
    head = "Figure 3, n_stick of one draw: n = 20: "
    other = [draw(n=5), draw(n=5, law="sigmoid"), draw(law="sigmoid")]
    draws = [*other, draw(), draw(n_first=9, t_last=80.0), draw(fate="silent", t_last=70.0)]
    (words,) = said(head, figure3=draws)
    assert words.startswith("6 to 9 blocks stick at first")
    assert "3 of 3 (44 to 100%) end with n_stick = 0, 2 of them by certificate" in words
    assert "last event at t = 60 to 80 (median 70)" in words
    draws = [*other, draw(fate="sustained", mean=31.5), draw(fate="diverged", mean=None)]
    (words,) = said(head, figure3=draws)
    assert "0 of 2 (0 to 66%) end with n_stick = 0; 1 keep on, with 31.5 blocks" in words
    assert "certificate" not in words
    assert "1 diverged" in words


def survival(**changes):
    row = claims.Survival(100, 20, 7, 3, 10, 0, 0, 7, 0, 0)
    return replace(row, **changes)


def test_words_of_the_survival_curve_keep_fates_apart(said):
    (words,) = said("Claims: Fates of", survival=[survival()])
    assert "7 at rest by certificate, 3 silent without one, 10 sustained, 0 diverged" in words
    assert "3 have an unstable all-slip state" in words
    assert "none of the linearly stable draws still move." in words
    (words,) = said("Claims: Fates of", survival=[survival(stable_moving=1, failed=2)])
    assert "1 of the linearly stable draws still moves." in words
    assert "2 failed" in words
    (words,) = said("Claims: Escape", survival=[survival(), survival(n=200, diverged=5)])
    assert "5 of 20 (11 to 47%) at n = 200. A run that is sustained so far need not be bounded." in words


def test_a_false_alarm_is_said(said):
    rows = [claims.Certified(5, k, "collapsed", 10.0, 30.0 + k, 0) for k in range(3)]
    (words,) = said("Claims: Certificate: ", certificate=rows)
    assert "none of them had a further event" in words
    assert "21 units of time after the last event in the median, 22 at most" in words
    alarmed = [*rows, replace(rows[0], n_after=2)]
    assert "1 of them had a further event" in said("Claims: Certificate: ", certificate=alarmed)[0]
    assert claims.lateness(alarmed)[0]["alarms"] == 1
    uncertified = [replace(rows[0], outcome="finished", t_certified=None, n_after=None)]
    assert said("Claims: Certificate: ", certificate=uncertified) == ["none of 1 runs was certified."]


def test_claims_that_fail_are_said(said, measured):
    apart = [replace(measured.uniqueness[0], apart=1e-3)]
    unique, again, *_ = said("Claims: ", uniqueness=apart, one_block=[claims.OneBlock(8, 6, 2)])
    assert "come apart: at most 0.001 apart" in unique
    assert "sticks again in 2." in again
    unique, again, *_ = said("Claims: ")
    assert "stay together" in unique
    assert "never sticks again: no cycle" in again


def cascade(**changes):
    row = figures_3_to_5.Cascades("coulomb", "events", None, 10, 9000, 0.7, 0.69, 0.71, 0.695, None)
    return replace(row, **changes)


def test_words_of_the_law_give_all_definitions_and_pick_none(said):
    head = "Figure 5, long runs and the law of cascades: "
    rows = [cascade(), cascade(definition="length", dt=1.0, gamma=0.9, low=0.7, high=1.1)]
    (words,) = said(head, cascades=rows)
    assert "γ = 0.7 to 0.9 over 2 definitions of size; the paper's 0.74 lies in the interval of 1" in words
    assert "0.900 at dt = 1" in words
    assert "random order gives 0.695, within the interval" in words
    (words,) = said(head, cascades=[cascade(gamma0=0.6)])
    assert "lies in the interval of none" in words
    assert "random order gives 0.600, outside the interval" in words
    nothing = cascade(gamma=None, low=None, high=None, gamma0=None, reason="too few")
    assert "no cascades to fit" in said(head, cascades=[nothing])[0]


def test_words_of_figure_4_say_what_collapsed(said):
    row = figures_3_to_5.Change("(iv)", 200, "10 %, draw 0", 0.1, "sustained", 2.0, 30.0, 31.0)
    quiet = replace(row, t_apart=None, label="1 %", fate="certified", mean=0.0)
    (words,) = said("Figure 4, sensitivity: ", figure4=[row, quiet])
    assert "1 of 2 come apart from the unperturbed run, at t = 2" in words
    assert "0 to 30 beside 31" in words
    assert "none sticks at the end: 1 %" in words


def test_words_of_an_open_future_name_each_and_pick_none(said, measured):
    head = "Figure 6, hidden dynamics: Static"
    (words,) = said(head)
    assert "there are 2 forward solutions: it sticks on until t = 0.5" in words
    assert "or it slips at once to the right, and never sticks again" in words
    assert "none is picked here" in words
    assert "the same state has 1;" in words
    (found,) = measured.undetermined
    (words,) = said(head, undetermined=[replace(found, futures=found.futures[:1])])
    assert "there is 1 forward solution: it sticks on" in words
    assert "none is picked" not in words


def test_words_of_the_slow_runs_name_a_jump_only_where_there_is_one(said, measured):
    head = "Figure 6, hidden dynamics: The modified law from entry to exit"
    (words,) = said(head)
    assert "at t = 0.0047988 the mode meets the saddle and is gone: a jump" in words
    assert "this one ends by a jump" in words
    assert "jump" not in said(head, slow_runs=measured.slow_runs[:1])[0]


# ---------------------------------------------------------------------------------------------- drawings


def labelled(figure):
    """Every axes that is shown has a name, and those of the bottom row and left column theirs."""
    shown = [ax for ax in figure.axes if ax.axison]
    assert any(ax.get_xlabel() for ax in shown)
    assert any(ax.get_ylabel() for ax in shown)
    return shown


@pytest.mark.parametrize(
    ("number", "panels"),
    [
        (1, ["v = −0.5", "v = 0.5"]),
        (2, ["s = +1, eq. (6) as printed", "s = −1, what section 3 goes on with",
             *(f"({case}) s = +1" for case in "abc")]),
        (3, ["(i) n = 5", "(ii) n = 20"]),
        (4, ["(i) n = 5, r redrawn", "(ii) n = 20, r redrawn", "(iii) n = 20, constants moved by 1 %",
             "(iv) n = 20, constants moved by more"]),
        (5, ["(i) matrix 0", "(i) matrix 1", "(ii) events", "(ii) length, dt = 1"]),
        (6, ["(a) Coulomb law", "(b) modified law"]),
    ],
)  # fmt: skip
def test_each_drawing_has_its_panels(number, panels, scene, measured):
    drawn = scene.show(measured).facts["drawn"]
    assert [ax.get_title(loc="left") for ax in labelled(drawn[number]())] == panels


def test_what_figure_6_leaves_open_is_drawn_beside_it(scene, measured):
    drawn = scene.show(measured).facts["drawn"]
    titles = [ax.get_title(loc="left") for name in ("slow", "open") for ax in labelled(drawn[name]())]
    assert titles == ["(c) at first", "(d) to the exit", "(e) static above kinetic", "(f) runs from one state"]


def test_curves_of_one_drawing_differ_in_colour(measured):
    for ax in figures_3_to_5.figure4(measured.traces).axes:
        colours = [line.get_color() for line in ax.lines]
        assert len(set(colours)) == len(colours) == 3


def test_the_survival_curve_shows_shares_with_intervals():
    rows = [survival(n=n, sustained=moving, certified=20 - moving, silent=0) for n, moving in ((20, 0), (200, 20))]
    assert claims.share(0, 20) == (0.0, 0.0, pytest.approx(0.161, abs=1e-3))  # Wilson
    (ax,) = claims.survival_curve(rows, 2000.0).axes
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("number of blocks n", "share of draws")
    moving, *_ = (container.lines[0] for container in ax.containers)
    assert moving.get_ydata().tolist() == [0.0, 1.0]


# ---------------------------------------------------------------------------------------------- end to end


def test_the_page_has_every_figure_and_table(report, scene):
    page = report.html
    assert "A tiny &lt;chart&gt;" in page
    for number in range(1, 7):
        assert f"<h2>Figure {number}:" in page
    assert "<h2>Claims</h2>" in page
    assert page.count("As in the paper:") == page.count("Not as in the paper:") == 6
    assert "All quantities and axes are dimensionless." in page
    assert "https://" not in page
    assert not re.search(r">\s*(nan|inf|None)\s*<", page)
    assert {
        "corners",
        "figure3",
        "figure4",
        "cascades",
        "hidden",
        "futures",
        "claims",
        "survival",
        "certificate",
    } == set(report.tables)
    figure3 = report.tables["figure3"]
    assert len(figure3) == len(scene.n) * scene.draws * 2
    assert (figure3.n_first <= figure3.n).all()


def test_a_scene_of_one_figure_counts_no_claims(tmp_path, capsys, in_this_process):
    file, out = tmp_path / "one.toml", tmp_path / "out"
    file.write_text('chart = "paper"\nfigures = 2\nseed = 0\n')
    assert main(["run", str(file), "--out", str(out)]) == 0
    assert "block 2 at t = 0.5625" in capsys.readouterr().out
    assert "Claims" not in (out / "report.html").read_text()
    assert [f.stem for f in (out / "report").glob("*.parquet")] == ["corners"]
    assert len(pd.read_parquet(out / "report" / "corners.parquet")) == 8
    assert len(json.loads((out / "report" / "tables.json").read_text())["corners"]) == 8


def test_the_table_of_futures_holds_each_with_its_events(report, tmp_path):
    report.tables["futures"].to_parquet(tmp_path / "futures.parquet")
    futures = pd.read_parquet(tmp_path / "futures.parquet").set_index("begins")
    assert futures.index.tolist() == ["sticks on", "slips at once to the right"]
    assert futures.events["sticks on"][:3].tolist() == ["exit", "entry", "exit"]
    assert len(futures.t_events["slips at once to the right"]) == 0


def test_modes_are_followed_without_a_leap(measured):
    """Within a segment lambda moves on; only the jump leaps: from the lost mode to the other."""
    right, left = measured.slow_runs
    for run, leaps in ((right, 0), (left, 1)):
        steps = np.abs(np.diff(np.array(run.lam), axis=1)).max(axis=0)
        assert np.count_nonzero(steps > 0.1) == leaps
    stable = {(t, x) for t, x, _, is_stable in measured.branches[0].points if is_stable}
    saddles = [t for t, *_, is_stable in measured.branches[0].points if not is_stable]
    assert max(saddles) < 0.0047988095
    assert len(stable) > len(saddles)


# ---------------------------------------------------------------------------------------------- workflows/paper.md


def test_every_test_named_on_the_page_of_misprints_exists():
    """A name after `::` belongs to the file linked last before it; every row of the table has one."""
    page = ROOT / "workflows" / "paper.md"
    named = re.findall(r"\]\(([^)]+\.py)\)|::(test_\w+)", page.read_text())
    file = None
    for link, name in named:
        if link:
            file = page.parent / link
            assert file.is_file(), link
        else:
            assert re.search(rf"^def {name}\(", file.read_text(), flags=re.MULTILINE), f"{file.name}::{name}"
    rows = [line for line in page.read_text().splitlines() if line.startswith("|")][2:]
    assert len(rows) >= 14
    assert all("::test_" in row for row in rows)
