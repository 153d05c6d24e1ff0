"""The chart of the paper: its scenes, known values in its tables, claims judged by what was measured."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis.page.parts import Drawn
from stickslip.sim import simulate
from stickslip.workflows.commands import main
from stickslip.workflows.gallery import load_chart
from stickslip.workflows.gallery.charts import runner
from stickslip.workflows.gallery.charts.peers import W0, Z0, random_ratios
from stickslip.workflows.gallery.paper import claims, figures_1_2, figures_3_to_5, runs
from stickslip.workflows.gallery.paper.figures_3_to_5 import Cascades, Pairing, Row
from stickslip.workflows.gallery.paper.runs import Ask
from stickslip.workflows.gallery.paper.runs import Path as Run
from stickslip.workflows.scenes import shipped

TINY = """
chart = "paper"
figures = [1, 2, 3, 4, 5, 6]
title = "A tiny <chart>"
n = [5, 20]
draws = 2
beyond = 25
matrices = 3
t_end = 60.0
t_burn = 5.0
t_shown = 20.0
few = 1
t_few = 30.0
noise = [0.01, 0.05, 0.1]
escapes = 2
changed = 2
dt = [0.1, 1.0]
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
    return scene.measure(lambda line: None)


@pytest.fixture(scope="module")
def report(scene, measured):
    """Without what is drawn, which is looked at figure by figure."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "draw", lambda *_, **__: Drawn(""))
        return runner.report(scene, measured)


# ---------------------------------------------------------------------------------------------- the scenes


@pytest.mark.parametrize("name", SCENES)
def test_shipped_scenes_have_their_figures(name):
    scene = load_chart(shipped()[name])
    assert scene.figures == (tuple(range(1, 7)) if name == "paper" else (int(name[3:]),))
    assert scene.n == (20, 100, 200)


BAD = {
    "no such figure": ("figures = [1, 2, 3, 4, 5, 6]", "figures = [1, 7]", "figures[1]: expected", "got 7"),
    "shown beyond the end": ("t_shown = 20.0", "t_shown = 40.0", "t_shown: expected", "got 40"),
    "nothing after the burn": ("t_burn = 5.0", "t_burn = 60.0", "t_burn: expected", "got 60"),
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
        a, b = (one.runs[case].events for case in "ab")
        assert [*zip(a.t, a.block, strict=True)] == [(pytest.approx(0.5625), 1), (pytest.approx(second), 0)]
        assert [*zip(b.t, b.block, strict=True)] == [(pytest.approx(0.5), 0), (pytest.approx(0.5), 1)]


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


def test_runs_around_a_double_exit_stay_close_and_a_law_that_is_not_monotone_has_two_futures(measured):
    """AUDIT, uniqueness."""
    (one,) = measured.uniqueness
    assert len(one.apart) == figures_1_2.DIRECTIONS
    assert min(one.n_events) >= 2  # both blocks leave
    assert max(one.apart) < 3 * figures_1_2.APART
    assert (one.coulomb, one.static) == (1, 2)


def test_modes_are_followed_without_a_leap(measured):
    """Within a segment lambda moves on; only the jump leaps: from the lost mode to the other."""
    right, left = measured.slow_runs
    for run, leaps in ((right, 0), (left, 1)):
        steps = np.abs(np.diff(np.array(run.lam), axis=1)).max(axis=0)
        assert np.count_nonzero(steps > 0.1) == leaps
    saddles = [t for t, _, is_stable in measured.modes if not is_stable]
    assert max(saddles) < 0.0047988095


# ---------------------------------------------------------------------------------------------- the runs


def test_the_sigmoid_by_scipy_is_the_engines():
    """tanh, until the errors of both have grown: the same blocks stick."""
    ask = Ask("sigmoids", "", 20, 0, 30.0)
    times, n_stick = runs.smoothed(runs.system(ask, 3), np.tanh, 0.03, 30.0)[1:3]
    run = simulate(runs.system(ask, 3), Z0, W0, 30.0, engine="sigmoid", eps=0.03, rtol=1e-8, atol=1e-8)
    assert (n_stick != run.n_stick(times)).mean() < 0.01


def test_workers_give_the_same_runs_in_order():
    asks = [Ask("long", "", n, matrix, 20.0) for n in (12, 5) for matrix in range(2)]
    there, here = (list(runs.run_all(asks, 4, 0.03, workers)) for workers in (2, 1))
    assert [path.ask for path in there] == asks
    for one, other in zip(there, here, strict=True):
        np.testing.assert_array_equal(one.t, other.t)
        np.testing.assert_array_equal(one.n_stick, other.n_stick)


@pytest.mark.parametrize("name", sorted(runs.SIGMOIDS))
def test_every_sigmoid_is_odd_with_slope_one_and_ends_at_one(name):
    phi = runs.SIGMOIDS[name]
    u = np.array([1e-6, 0.5, 3.0])
    np.testing.assert_array_equal(phi(-u), -phi(u))
    assert phi(u)[0] == pytest.approx(1e-6, rel=1e-9)
    assert phi(np.array([1e9]))[0] == pytest.approx(1.0)


def test_perturbations_are_those_of_an_ensemble():
    """One draw goes the same way at every size, and by at most the size; only the dampings' reading couples them."""
    ask = Ask("constants", "", 20, 0, 1.0, "sigmoid", reading="scale")
    base, small, large = (runs.system(replace(ask, size=size), 0) for size in (0.0, 0.01, 0.1))
    moved = small.stiffness - base.stiffness
    np.testing.assert_allclose(large.stiffness - base.stiffness, 10 * moved, atol=1e-12)
    assert 0 < np.abs(moved).max() <= 0.01 * 0.2 * (1 + 1e-12)
    noisy = runs.system(replace(ask, reading="damping matrix", size=0.1), 0)
    assert large.cross_damping is None
    assert 0 < np.abs(noisy.cross_damping).max() <= 0.1 * 3.5
    r = random_ratios(0, 200, 1)
    assert (r > 0).all()
    assert (r <= 1).all()


def test_runs_that_slip_for_good_have_their_certificate():
    """One of 100 blocks that ends at t = 112; unless asked for, a test that costs more than it saves is left out."""
    assert runs.run(Ask("long", "", 100, 6, 300.0), 0, 0.03).outcome == "collapsed"


def test_halving_friction_is_doubling_the_speed_of_the_belt():
    """In units of length of mu: the same events, of a start that is scaled as well."""
    half = runs.system(Ask("keys", "", 12, 0, 1.0, scale="friction", factor=0.5), 0)
    fast = runs.system(Ask("keys", "", 12, 0, 1.0, scale="belt_speed", factor=2.0), 0)
    one, other = simulate(half, Z0, W0, 40.0), simulate(fast, 2 * Z0, 2 * W0, 40.0)
    assert len(one.events) > 0
    np.testing.assert_allclose(one.events.t, other.events.t, atol=1e-6)


# ---------------------------------------------------------------------------------------------- the parts


def planted(t, n_stick, t_stop=10.0, **changes):
    return Run(
        Ask("base", "", 20, 0, t_stop, "sigmoid", **changes), "finished", np.array(t), np.array(n_stick), t_stop
    )


def test_a_late_event_is_not_yet_apart_but_a_missing_one_is():
    """A unit of time with one block more or less on average: a delay of 0.5 never is, an absence at 9 is at 10."""
    base = planted([0.0, 7.0, 9.0], [2, 1, 0], 15.0)
    assert figures_3_to_5.apart_from(planted([0.0, 7.5, 9.0], [2, 1, 0], 15.0), base, 1.0) is None
    assert figures_3_to_5.apart_from(planted([0.0, 7.0], [2, 1], 15.0), base, 1.0) == pytest.approx(10.0, abs=0.1)


def test_the_period_of_a_planted_oscillation():
    t = np.arange(0.0, 400.0, 0.5)
    n_stick = np.round(40 + 15 * np.sin(2 * np.pi * t / 22.0)).astype(int)
    period, swing = figures_3_to_5.oscillation(planted(t, n_stick, 400.0))
    assert period == pytest.approx(22.0, rel=0.02)
    assert swing == pytest.approx(15 / 2**0.5, rel=0.03)
    assert figures_3_to_5.oscillation(planted(t, n_stick, 120.0)) == (None, None)


# ---------------------------------------------------------------------------------------------- claims and words


@pytest.fixture
def judged(scene, measured):
    """The claims of what was measured but for some changes, by name."""

    def found(**changes):
        return {one["claim"]: one for one in claims.judge(scene, replace(measured, **changes))}

    return found


@pytest.fixture
def told(scene, measured, undrawn):
    """The lines of the table of claims, as text by claim."""

    def found(**changes):
        html = runner.report(scene, replace(measured, **changes)).html
        rows = re.findall(r"<tr>(<td data-head=\"claim\".*?)</tr>", html, flags=re.DOTALL)
        texts = [[" ".join(re.sub(r"<[^>]*>", "", cell).split()) for cell in row.split("</td>")] for row in rows]
        return {text[0]: text[1:4] for text in texts}

    return found


def row(study, fate="sustained", **changes):
    mean = 30.0 if fate == "sustained" else None
    plain = Row(study, "", "coulomb", 20, 0, 0.0, fate, 60.0, 50.0, mean, None, None, None)
    return replace(plain, **changes)


def others(measured, *studies):
    return [one for one in measured.runs if one.study not in studies]


def test_fates_are_counted_with_wilsons_interval(judged, measured):
    rows = [row("long", n=5, fate="collapsed", t_last=t) for t in (30.0, 35.0, 40.0, 45.0, 50.0, 60.0)]
    rest = judged(runs=[*others(measured, "long", "details"), *rows, row("long"), row("long", n=25, fate="diverged")])
    few = rest["few_come_to_rest"]
    assert (few["found"], few["tried"], few["verdict"], few["ends"][-1]) == (6, 6, "reproduced", 60.0)
    assert few["low"] == pytest.approx(0.610, abs=1e-3)
    assert rest["more_come_to_rest"]["verdict"] == "not reproduced"  # they end long before t = 150
    fewer = judged(runs=[*others(measured, "long", "details"), *rows[:4], row("long")])
    assert fewer["more_come_to_rest"]["verdict"] == "cannot be told"  # the median of four times has no interval
    assert rest["many_keep_on"]["beyond"]["found"] == 1


@pytest.mark.parametrize(("fates", "verdict"), [
    (("sustained",) * 3, "cannot be told"),
    (("sustained", "collapsed", "sustained"), "cannot be told"),  # 6 to 79%: it may be most
    (("sustained",) * 9 + ("collapsed",), "reproduced"),
    (("sustained",) * 9 + ("lull",), "cannot be told"),  # a lull is not an end
    (("sustained",) * 5 + ("quiet",) * 5, "cannot be told"),
    (("sustained", "diverged", "sustained"), "corrected"),
])  # fmt: skip
def test_a_run_away_is_no_collapse(fates, verdict, judged, measured):
    rows = [row("long", fate, matrix=k) for k, fate in enumerate(fates)]
    found = judged(runs=[*others(measured, "long", "details"), *rows, row("long", n=5), row("long", n=25)])[
        "some_collapse"
    ]
    assert found["verdict"] == verdict


def test_collapse_at_ten_percent_is_run_away_or_rest(judged, measured):
    def verdict(fate):
        ends = fate if isinstance(fate, tuple) else (fate, fate)
        rows = [
            row(study, end, size=0.1, matrix=k, law="sigmoid", t_stop=80.0 + k)
            for study, end in zip(("dampings", "scaled"), ends, strict=True)
            for k in range(8)
        ]
        return judged(runs=[*others(measured, "dampings", "scaled"), *rows])["collapse_at_strongest"]["verdict"]

    assert [verdict(fate) for fate in ("collapsed", "quiet", "sustained")] == [
        "reproduced", "cannot be told", "not reproduced",
    ]  # fmt: skip
    assert verdict(("diverged", "sustained")) == "cannot be told"  # two readings of what is moved
    assert verdict(("collapsed", "sustained")) == "cannot be told"
    assert verdict(("collapsed", "quiet")) == "cannot be told"


def test_what_changes_the_fate_is_a_key_parameter(judged, measured):
    bases = [row("long", matrix=0), row("long", n=5), row("long", n=25)]

    def verdict(*key):
        rows = [
            row("keys", "diverged" if name in key else "sustained", setting=f"{name} {factor}")
            for name in runs.SCALES
            for factor in ("0.5", "2")
        ]
        return judged(runs=[*others(measured, "keys", "long", "details"), *bases, *rows])["key_parameters"]["verdict"]

    assert verdict("kappa", "rho", "belt_speed") == "reproduced"
    assert verdict("kappa", "rho", "belt_speed", "friction") == "corrected"
    assert verdict("kappa", "rho") == "cannot be told"  # few runs show no fate that never changes


def lasting(means, ends=()):
    """Runs of the study: mean n_stick by setting and matrix; fates other than in motion by (setting, matrix)."""
    return [
        row("lasting", dict(ends).get((name, k), "sustained"), setting=name, matrix=k, mean=mean)
        for name, some in means.items()
        for k, mean in enumerate(some)
    ]


def test_a_small_change_is_held_against_another_start_and_another_matrix(judged, measured, rng):
    """Means of matrices from 22 to 38; a run adds an error of 1. A fresh matrix is no small change."""
    of_matrix = 30 + rng.permutation(np.linspace(-8.0, 8.0, 20))

    def found(r=of_matrix, constants=of_matrix, ends=()):
        own = {"unchanged": of_matrix, "start": of_matrix, "r": r, "constants": constants}
        means = {name: mean + rng.normal(size=20) for name, mean in own.items()}
        return judged(runs=[*others(measured, "lasting"), *lasting(means, ends)])["robust"]

    same = found()
    assert same["verdict"] == "reproduced"
    assert same["rms"]["start"] == pytest.approx(2**0.5 / 30, rel=0.75)
    for end, tried in (("collapsed", 18), ("quiet", 18), ("lull", 20)):  # a lull is motion
        one = found(ends=[(("r", 0), end), (("start", 1), end)])
        assert one["tried"] == tried
        assert [one["moving"][name]["found"] for name in ("r", "constants")] == [tried // 20 + 19, 20]
    moved = found(of_matrix + 9.0)
    assert moved["verdict"] == "not reproduced"
    assert moved["rms"]["change"] == pytest.approx(
        (2 + 9.0**2 / 2) ** 0.5 / 30, rel=0.2
    )  # of two changes one does it
    rank = np.argsort(np.argsort(of_matrix))  # values of other matrices, with correlations of 0.04 and -0.13
    redrawn = found(*(np.sort(of_matrix)[(rank + shift) % 20] for shift in (4, 5)))
    assert redrawn["verdict"] == "not reproduced"
    assert redrawn["value"] == pytest.approx(1.0, abs=0.9)


def test_a_change_is_not_told_from_a_redraw_where_matrices_are_not(judged, told, measured):
    """All have the mean 30; their runs from either start differ by 4."""
    error = np.resize([2.0, -2.0], 20)
    means = {"unchanged": 30 + error, "start": 30 - error, "r": np.full(20, 30.0), "constants": np.full(20, 30.0)}
    runs = {"runs": [*others(measured, "lasting"), *lasting(means)]}
    one = judged(**runs)["robust"]
    assert (one["verdict"], one["value"]) == ("cannot be told", None)
    assert told(**runs)["Robust in the long term"][1].endswith(
        "Mean nstick of two runs differs (root mean square, 20 matrices) by 13% from another start, 6.7% with such a"
        " change, 9.4% with another matrix: the runs are too short to tell matrices apart, and so to tell a"
        " change from a redraw"
    )
    few = judged(runs=others(measured, "lasting"))["robust"]
    assert (few["verdict"], few["rms"]) == ("cannot be told", None)


def test_small_changes_are_sensitive_if_under_each_most_matrices_part_in_the_time_that_is_drawn(
    judged, told, measured
):
    """t_shown is 20."""

    def changed(r, constants):
        times = {"r": r, "constants": constants}
        rows = [
            row("lasting", setting=one, matrix=k, t_apart=t)
            for one, some in times.items()
            for k, t in enumerate(some)
        ]
        return {"runs": [*others(measured, "lasting"), *rows]}

    early, late = [10.0 + k / 10 for k in range(8)], [30.0] * 8
    assert judged(**changed(early, early))["sensitive"]["verdict"] == "reproduced"
    assert judged(**changed(early, late))["sensitive"]["verdict"] == "not reproduced"
    assert judged(**changed(early, [None] * 8))["sensitive"]["verdict"] == "not reproduced"
    assert judged(**changed(early, [*early[:4], *late[:4]]))["sensitive"]["verdict"] == "cannot be told"
    assert told(**changed(early, late))["Sensitive in the short term"][1] == (
        "r redrawn: 8 of 8 (68 to 100%) part by t = 20, at t = 10 to 11;"
        " constants moved by 1%: 0 of 8 (0 to 32%) part by t = 20"
    )


def test_a_changed_run_is_held_against_the_unchanged_one_of_its_matrix():
    """Matrix 1 parts from its own unchanged run at 12, not from that of matrix 0; the level is half of 4 blocks."""
    ask = Ask("lasting", "unchanged", 20, 0, 40.0, "sigmoid")

    def run(study, setting, matrix, *steps):
        t, n_stick = np.array(steps).T
        return Run(
            replace(ask, study=study, setting=setting, matrix=matrix), "finished", t, n_stick.astype(int), 40.0
        )

    paths = [
        *(run("long", "", matrix, (0.0, 2 + 4 * matrix)) for matrix in (0, 1)),
        run("lasting", "unchanged", 0, (0.0, 2)),
        run("lasting", "unchanged", 1, (0.0, 6)),
        run("lasting", "r", 0, (0.0, 2)),
        run("lasting", "r", 1, (0.0, 6), (11.0, 8)),
    ]
    apart = {
        (one.setting, one.matrix): one.t_apart for one in figures_3_to_5.rows(paths, 5.0) if one.study == "lasting"
    }
    assert apart == {
        ("unchanged", 0): None, ("unchanged", 1): None, ("r", 0): None, ("r", 1): pytest.approx(12.0, abs=0.1),
    }  # fmt: skip


def test_paths_that_share_no_more_exits_than_chance_have_nothing_in_common(judged, told, rng):
    def pairings(of_path, mean=30.0):
        return [
            Pairing(k, 2000, int(rng.binomial(2000, of_path)), 120.0, 30.0 + k, mean + k, 2000, 1000, 2010 + k, 1000)
            for k in range(6)
        ]

    claim = "Unpredictable, but repeatable: other paths, the same law"
    assert judged(pairings=pairings(0.06))["paths_and_laws"]["verdict"] == "reproduced"
    assert judged(pairings=pairings(0.5))["paths_and_laws"]["verdict"] == "not reproduced"
    assert judged(pairings=pairings(0.06, mean=40.0))["paths_and_laws"]["verdict"] == "not reproduced"
    assert "by chance 6.0% would (6 matrices)" in told(pairings=pairings(0.06))[claim][1]
    assert told(pairings=[])[claim][1:] == ["too few runs under both laws", "cannot be told"]


def test_exits_that_two_runs_share_are_counted_by_hand():
    """Of block 0, 10.0 and 10.9 lie within a unit, 20 and 22 do not; at 30 it is another block."""
    ask = Ask("long", "", 2, 3, 40.0)
    t, n_stick = np.array([0.0, 10.0, 20.0, 30.0]), np.array([2, 1, 2, 1])
    exact = Run(ask, "finished", t, n_stick, 40.0, (np.array([10.0, 20.0, 30.0]), np.array([0, 0, 1])))
    smoothed = replace(ask, law="sigmoid")
    other = Run(smoothed, "finished", t, n_stick, 40.0, (np.array([10.9, 22.0, 30.0]), np.array([0, 0, 0])))
    (one,) = figures_3_to_5.pairings([exact, other], 0.0)
    assert (one.matrix, one.n_exits, one.shared) == (3, 3, 1)
    assert one.by_chance == pytest.approx(2 * 6 / 40)  # of block 0 three exits, two units of time about each
    assert figures_3_to_5.pairings([exact], 0.0) == []


def test_another_sigmoid_matters_if_it_is_shown_to_move_the_mean_by_more_than_the_margin(judged, told, measured):
    def changed(*means, ends=0):
        rows = [
            row("sigmoids", law=law, matrix=k, mean=mean)
            for k, more in enumerate(means)
            for law, mean in (("sigmoid", 30.0 + k), ("algebraic", 30.0 + k), ("arctan", 30.0 + k + more))
        ]
        rows = [replace(one, fate="diverged") if one.law == "arctan" and one.matrix < ends else one for one in rows]
        return {"runs": [*others(measured, "sigmoids"), *rows]}

    assert judged(**changed(5.0, 5.5, 6.0))["sigmoid"]["verdict"] == "not reproduced"
    assert judged(**changed(5.0, -5.5, 1.0))["sigmoid"]["verdict"] == "cannot be told"
    assert judged(**changed(4.0, 5.0, 6.0))["sigmoid"]["verdict"] == "cannot be told"  # 16% (8 to 24%)
    assert judged(**changed(1.5, 2.5, 3.5))["sigmoid"]["verdict"] == "cannot be told"  # 8% (0.03 to 16%)
    assert judged(**changed(0.5, -0.5, 0.1))["sigmoid"]["verdict"] == "reproduced"  # within 10%
    alike = (0.5, -0.5, 0.1, 0.2)
    assert judged(**changed(*alike, ends=1))["sigmoid"]["verdict"] == "cannot be told"  # 25% (5 to 70%) run away
    assert judged(**changed(*alike, ends=3))["sigmoid"]["verdict"] == "not reproduced"  # 75% (30 to 95%)
    _, words, verdict = told(**changed(5.0, 5.5, 6.0))["The precise choice of sigmoid typically does not matter"]
    assert "algebraic: still stick and slip" in words
    assert "arctan: still stick and slip, nstick +18%" in words
    assert verdict == "not reproduced"


@pytest.mark.parametrize(("periods", "verdict"), [
    ((19.0, 20.0, 21.0, 20.5, 19.5, 20.0, 20.2, 20.8), "reproduced"),
    ((19.0, 20.0, 28.0, 29.0, 30.0, 23.0, 27.0, 22.0), "cannot be told"),
    ((28.0, 29.0, 30.0, 28.5, 29.5, 30.5, 31.0, 29.0), "not reproduced"),
])  # fmt: skip
def test_a_period_is_the_papers_if_half_of_the_runs_are_shown_to_be_near(periods, verdict, judged, measured):
    rows = [
        row("dampings", size=0.05, matrix=k, law="sigmoid", period=one, swing=9.0) for k, one in enumerate(periods)
    ]
    assert judged(runs=[*others(measured, "dampings"), *rows])["oscillations"]["verdict"] == verdict


@pytest.mark.parametrize(("period", "swing", "words"), [
    (20.0, 5.0, ". The period is not new, only the swing grows"),
    (20.0, 9.0, ". The period is not new"),
    (40.0, 5.0, ""),
])  # fmt: skip
def test_a_period_that_runs_have_without_noise_is_not_new(period, swing, words, told, measured):
    rows = [
        row(study, size=size, law="sigmoid", period=of, swing=wide)
        for study, size, of, wide in (("base", 0.0, period, swing), ("dampings", 0.05, 21.0, 9.0))
    ]
    assert told(runs=[*others(measured, "dampings", "base"), *rows])["Oscillations of period 20 at 5%"][1] == (
        f"by noise on all n² dampings: none (matrix 0), period {period:.0f}, nstick ±{swing:.0f};"
        f" 5%, period 21, nstick ±9{words}"
    )


def test_the_law_has_a_gamma_a_definition_and_none_is_picked(judged, told):
    one = Cascades("events", None, 10, 9000, 14, 0.7, 0.69, 0.71, None, [[50, 20, 10]])
    many = [one] + [
        replace(one, definition=name, dt=dt, gamma=gamma, low=gamma - 0.02, high=gamma + 0.02)
        for name, dt, gamma in (
            ("length", 0.1, 1.28), ("length", 1.0, 0.9), ("decreases", 0.1, 0.7), ("decreases", 1.0, 0.76),
        )
    ]  # fmt: skip
    assert judged(cascades=many)["gamma"]["verdict"] == "cannot be told"  # 0.68 to 1.3 holds the paper's and more
    assert told(cascades=many)["γ ≈ 0.74"][1] == (
        "by falls, as the paper counts, 0.70 to 0.76 if pauses are bridged, so 0.74 at a step between 0.1 and 1;"
        " 0.90 to 1.28 if a pause ends a cascade. By events 0.700. The paper does not say which, nor its step"
    )
    for ends, verdict in (((0.72, 0.75), "reproduced"), ((0.81, 0.83), "not reproduced")):
        rows = [one, *(replace(of, low=ends[0], high=ends[1]) for of in many[1:])]
        assert judged(cascades=rows)["gamma"]["verdict"] == verdict


def test_the_law_is_an_exponential_if_it_is_by_every_reading_of_the_papers_words(judged, told):
    """By events alone it is not enough: the paper counts by falls."""
    one = Cascades("events", None, 10, 9000, 14, 0.7, 0.69, 0.71, None, [[50, 20, 10]], -0.03, -0.04, -0.02)

    def rows(*excesses):
        read = [("decreases", 0.1), ("decreases", 1.0), ("length", 0.1), ("length", 1.0)]
        return {"cascades": [one] + [
            replace(one, definition=name, dt=dt, excess=of, excess_low=of - 0.02, excess_high=of + 0.02)
            for (name, dt), of in zip(read, excesses, strict=True)
        ]}  # fmt: skip

    assert judged(**rows(-0.05, -0.05, -0.02, -0.05))["form"]["verdict"] == "reproduced"
    assert judged(**rows(-0.05, -0.17, -0.02, -0.13))["form"]["verdict"] == "cannot be told"
    assert judged(**rows(-0.15, -0.17, -0.14, -0.13))["form"]["verdict"] == "not reproduced"
    assert told(**rows(-0.05, -0.17, -0.02, -0.13))["The frequency of cascades falls off as exp(−γ Δn)"][1] == (
        "the variance of sizes is −3.0% (−4.0% to −2.0%) off an exponential's by events (alike: within 10%)."
        " By falls, as the paper counts, it is −5.0% to −17% if pauses are bridged, −2.0% to −13% if a pause ends a"
        " cascade, by the step"
    )


def test_clusters_would_make_the_law_shallower_than_the_toss_of_a_coin(judged, told):
    one = Cascades("events", None, 10, 9000, 14, 0.7, 0.69, 0.71, None, [[50, 20, 10]])
    assert judged(cascades=[one])["clusters"]["verdict"] == "not reproduced"
    assert judged(cascades=[replace(one, gamma=0.5, low=0.45, high=0.55)])["clusters"]["verdict"] == "reproduced"
    nothing = replace(one, gamma=None, low=None, high=None, reason="too few", counts=[[]])
    assert told(cascades=[nothing])["Clusters of exits make the cascades"][1] == "too few cascades"


def test_a_jump_is_told_only_where_there_is_one(told, measured):
    name = "A sticking mode ends where it leaves the box"
    assert told()[name][1:] == [
        "also inside: it meets the saddle at t = 0.0048 and jumps (v = −1, from F₁ = −F₂ = 0.5)",
        "corrected",
    ]
    assert told(slow_runs=measured.slow_runs[:1])[name][2] == "reproduced"


# ---------------------------------------------------------------------------------------------- drawings


@pytest.mark.long
def test_each_figure_has_its_panels(scene, measured):
    titles = {}
    for name, recipe in scene.show(measured).figures.items():
        figure = recipe()
        assert any(ax.get_xlabel() for ax in figure.axes)
        titles.setdefault(name.partition("_")[0], []).append(figure.axes[0].get_title(loc="left"))
    assert titles == {
        "figure1": ["(i) v = −0.5", "(ii) v = 0.5"],
        "figure2": ["s = +1, eq. (6)", "s = −1, section 3", "(a) s = +1"],
        "figure3": ["n = 5", "n = 20"],
        "figure4": [
            "(i) n = 5, r redrawn", "(ii) n = 20, r redrawn", "(iii) constants moved",
            "(iv) all n² dampings moved", "(v) escape under noise on all n² dampings",
        ],
        "figure5": ["(i)", "(ii) by events"],
        "figure6": ["(a) Coulomb law", "(b) modified law", "(c) modified law in slow time"],
    }  # fmt: skip


def test_curves_of_one_panel_differ_in_colour(measured):
    for recipe in figures_3_to_5.panels(measured.traces, 4):
        for ax in recipe().axes:
            colours = [line.get_color() for line in ax.lines]
            assert len(set(colours)) == len(colours) >= 3


# ---------------------------------------------------------------------------------------------- end to end


def test_the_page_has_every_claim_figure_and_table(report, scene):
    page = report.html
    assert "A tiny &lt;chart&gt;" in page
    for number in range(1, 7):
        assert f'<h2 id="figure{number}">Figure {number},' in page
    assert page.count("As in the paper:") == page.count("<b>Differs:</b>") == 6
    assert "https://" not in page
    assert not re.search(r">\s*(nan|inf|None)\s*<", page)
    assert set(report.tables) == {"claims", "corners", "runs", "cascades", "paths", "hidden"}
    table = report.tables["claims"]
    assert page.count('class="verdict ') == len(table) == 22
    assert set(table.verdict) <= {"reproduced", "corrected", "not reproduced", "cannot be told"}
    assert report.headline[1].startswith("Of 22 claims ")
    assert len(report.tables["runs"]) == len(set(scene.asks()))


def test_a_scene_of_one_figure_judges_its_claims_alone(tmp_path, capsys):
    file, out = tmp_path / "one.toml", tmp_path / "out"
    file.write_text('chart = "paper"\nfigures = 2\nseed = 0\n')
    assert main(["run", str(file), "--out", str(out)]) == 0
    assert "Of 3 claims 0 reproduced, 2 corrected, 1 not reproduced" in capsys.readouterr().out
    assert {f.stem for f in (out / "report").glob("*.parquet")} == {"claims", "corners"}
    assert len(pd.read_parquet(out / "report" / "corners.parquet")) == 8
    assert {f.name for f in (out / "report" / "figures").glob("*.svg")} == {f"figure2_{k}.svg" for k in (1, 2, 3)}


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
