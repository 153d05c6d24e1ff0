"""What changes along a sweep: planted changes are found, told by key, against the first value and unit by unit."""

import re
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import Study, build, measures
from stickslip.analysis.findings.finding import Change as Changed
from stickslip.analysis.findings.finding import Course, Lack, Level, Reason, Threshold, Verdict
from stickslip.analysis.findings.place import EVERYWHERE
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.grid import axes_of
from stickslip.analysis.members import Members
from stickslip.analysis.questions.runs.changes import answer as changes_of
from stickslip.analysis.stats import enough
from stickslip.pipeline.design.design import Axis, Change, Design, Method, Source, Unit
from stickslip.pipeline.design.labels import apart, labels
from stickslip.pipeline.design.values import Distribution, Ratio, Values, rank
from tests.analysis.designs import Data, members

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture
def settings(settings):
    return replace(settings, margins={"mean": 0.02, "gamma": 0.05})


@pytest.fixture
def swept(planted, rng):
    """Of each matrix one series, at each point of a grid raised by what `shift` says of the point.

    Every other one is the mirror image of the one before, so that all together do not drift.
    """

    def make(axes, shift, n_matrices=8, **fixed):
        rows, series = [], {}
        for matrix in range(n_matrices):
            if matrix % 2 == 0:
                t, walk = planted.runs(rng, 600, 0.7, level=0)
            n_stick = 300 + int(rng.integers(100)) + (-1) ** matrix * walk
            for k, values in enumerate(product(*axes.values())):
                point, name = dict(zip(axes, values, strict=True)), f"m{matrix}-{k}"
                rows.append(planted.member(name, matrix, n=500, **fixed | point))
                series[name] = t, n_stick + round(shift(point, matrix))
        return Data(pd.DataFrame(rows), series)

    return make


def changes(answer, quantity=measures.MEAN):
    """The contrast of the last value of each key with the first."""
    table = answer.tables["changes"]
    return {row.key: row for row in table[table["quantity"] == quantity].itertuples()}


BELT = [-0.1, -0.15, -0.2, -0.25, -0.3, -0.35, -0.4, -0.5]


def test_a_change_along_eight_values_is_found_within_matrices(swept, settings):
    """The matrices differ by 100; the change is 30, and it alternates by 1."""
    data = swept({"belt_speed": BELT}, lambda at, matrix: 75 * (at["belt_speed"] + 0.5) + matrix % 2)
    answer = changes_of(Study(data, settings))
    row = changes(answer)["belt_speed"]
    assert (row.verdict, row.first_value, row.second_value) == (Verdict.MORE, "-0.5", "-0.1")
    assert row.difference == pytest.approx(30)
    assert row.difference_low - 1e-9 <= 30 <= row.difference_high + 1e-9 < 31
    assert changes(answer, measures.GAMMA)["belt_speed"].verdict == Verdict.SAME
    wide = build(data, replace(settings, margins={"mean": 0.2}), "Wide", "", {}).headline[1]
    assert re.search(r"rises by [6-9]\.\d+% \([^-]*\) as \|belt_speed\| goes .* within the margin of 20%", wide)
    first, base = answer.findings[0], answer.findings[answer.n_lead]
    assert isinstance(first, Changed)
    assert len(sentence(first).split()) <= 25
    assert isinstance(base, Level)
    assert len([one for one in answer.findings if one.quantity == first.quantity]) == len(BELT)
    table = answer.tables["sweep_measures"].query("measure == 'mean n_stick'")
    assert list(table["belt_speed"]) == sorted(BELT)  # as "first" and "last" are meant
    assert (table["n_units"] == 8).all()


def test_what_falls_and_rises_again_has_a_minimum(swept, settings):
    """By 60 at -0.3, where the ends are level."""
    data = swept({"belt_speed": BELT}, lambda at, _: -60 * (1 - ((at["belt_speed"] + 0.3) / 0.2) ** 2))
    change = next(finding for finding in changes_of(Study(data, settings)).findings if isinstance(finding, Changed))
    assert (change.quantity.key, [turn.course for turn in change.turns]) == (measures.MEAN, [Course.MINIMUM])
    assert re.search(r"has a minimum of .* near \|belt_speed\| = 0.3. It falls from \S+ and rises", sentence(change))


def test_a_resonance_is_no_fall(swept, settings):
    """It falls from -0.1 to -0.3 and from -0.35 to -0.5, and its end is the lowest."""
    level = dict(zip(BELT, [90, 70, 50, 30, 10, 60, 20, 0], strict=True))
    answer = changes_of(Study(swept({"belt_speed": BELT}, lambda at, _: level[at["belt_speed"]]), settings))
    change = next(finding for finding in answer.findings if isinstance(finding, Changed))
    assert [(turn.course, str(turn.near)) for turn in change.turns] == [
        (Course.MAXIMUM, "|belt_speed| = 0.35"), (Course.MINIMUM, "|belt_speed| = 0.3"),
    ]  # fmt: skip
    caption = answer.figures["sweep_mean"].caption
    assert "has a maximum near |belt_speed| = 0.35 and a minimum near 0.3." in caption
    further = (finding for finding in answer.findings[1:] if finding.quantity.key == measures.MEAN)
    n_turns = {finding.keys[0].second: len(finding.turns) for finding in further if isinstance(finding, Changed)}
    assert n_turns == {"-0.4": 0, "-0.35": 0, "-0.3": 1, "-0.25": 2, "-0.2": 2, "-0.15": 2}


def test_a_share_that_is_nowhere_else_than_at_both_ends_has_a_minimum_between(swept, settings):
    """All runs are in motion at -0.4 and -0.1, and none between."""
    data = swept({"belt_speed": [-0.4, -0.3, -0.2, -0.1]}, lambda at, matrix: 0, n_matrices=20)
    at = data.members["belt_speed"]
    data = ended(data, (at == -0.2) | (at == -0.3), "collapsed")
    change = next(finding for finding in changes_of(Study(data, settings)).findings if isinstance(finding, Changed))
    assert [str(turn.near) for turn in change.turns] == ["|belt_speed| = 0.3 to 0.2"]
    assert "near |belt_speed| = 0.3 to 0.2. It falls from 100.0% and rises to 100.0%" in sentence(change)


@pytest.mark.parametrize(("n_late", "n_turns", "second"), [(18, 1, "-0.1"), (6, 0, "-0.2")])
def test_a_share_that_comes_back_does_not_fall_to_its_last_value(swept, settings, n_late, n_turns, second):
    """Of 20 runs all are in motion at -0.4 and -0.3, none at -0.2, some at -0.1."""
    data = swept({"belt_speed": [-0.4, -0.3, -0.2, -0.1]}, lambda at, matrix: 0, n_matrices=20)
    at, matrix = data.members["belt_speed"], data.members["matrix"]
    data = ended(data, (at == -0.2) | ((at == -0.1) & (matrix >= n_late)), "collapsed")
    change = next(finding for finding in changes_of(Study(data, settings)).findings if isinstance(finding, Changed))
    assert change.quantity.key == measures.STICKING
    assert (len(change.turns), change.keys[0].second) == (n_turns, second)
    assert change.turns or change.after.value == 0.0


def test_of_one_system_nothing_is_judged_and_nothing_has_an_interval(swept, settings):
    answer = changes_of(Study(swept({"belt_speed": BELT[:3]}, lambda at, _: 0, n_matrices=1), settings))
    assert "comparisons" not in answer.method
    table = answer.tables["sweep_measures"]
    assert "share" in " ".join(table["measure"])
    assert table["estimate"].notna().any()
    assert table[["estimate_low", "estimate_high"]].isna().all(axis=None)


def test_opposite_changes_are_not_the_same(swept, settings):
    data = swept({"belt_speed": [-0.2, -0.1]}, lambda at, m: (30 if m % 2 else -30) * int(at["belt_speed"] == -0.1))
    row = changes(changes_of(Study(data, settings)))["belt_speed"]
    assert abs(row.difference) < 1e-9 < row.difference_high
    assert row.verdict == Verdict.OPEN


def test_a_grid_tells_which_key_it_is(swept, settings):
    axes = {"kappa": [0.2, 0.25], "friction": [0.8, 0.9, 1.0, 1.1, 1.2], "belt_speed": [-0.1, -0.2, -0.3]}
    data = swept(axes, lambda at, matrix: 40 * at["friction"] + 400 * (at["kappa"] - 0.2) + matrix % 3)
    answer = changes_of(Study(data, settings))
    found = changes(answer)
    assert {key: row.verdict for key, row in found.items()} == {
        "kappa": Verdict.MORE,
        "friction": Verdict.MORE,
        "belt_speed": Verdict.SAME,
    }
    assert found["kappa"].difference == pytest.approx(20)
    assert found["friction"].difference == pytest.approx(16)
    assert {row.n_first for row in found.values()} == {8}, "a unit counts once, whatever the grid"
    assert [(one.keys[0].key, one.difference.verdict) for one in answer.findings[: answer.n_lead]] == [
        ("kappa", Verdict.MORE), ("friction", Verdict.MORE), ("belt_speed", Verdict.SAME),
    ]  # fmt: skip
    assert len(answer.tables["sweep_measures"].query("measure == 'share of runs that stick late'")) == 30
    report = build(data, settings, "Grid", "", {})
    assert "as kappa goes from 0.2 to 0.25" in report.headline[1]
    assert "sweep_mean" in report.figures
    assert "&lt;" not in report.html


def test_rows_of_two_settings_are_told_apart(planted, swept, settings):
    """Of two engines each value has two rows; of one engine the page names none."""
    exact = swept({"belt_speed": [-0.1, -0.2]}, lambda at, matrix: matrix)
    rows = exact.members.assign(**planted.sigmoid, member_id=exact.members["member_id"] + "s")
    both = Data(
        pd.concat([exact.members, rows], ignore_index=True),
        dict(exact.series) | {f"{name}s": one for name, one in exact.series.items()},
    )
    found = [one for one in changes_of(Study(both, settings)).findings if isinstance(one, Changed)]
    assert {str(one.where) for one in found} == {"exact", "sigmoid, eps = 0.03, stick = convergent"}
    alone = [one for one in changes_of(Study(exact, settings)).findings if isinstance(one, Changed)]
    assert {one.where for one in alone} == {EVERYWHERE}


def test_no_change_is_not_told_as_one(swept, settings, rng):
    noise = {key: rng.standard_normal() for key in product(range(8), BELT)}
    data = swept({"belt_speed": BELT}, lambda at, matrix: 3 * noise[matrix, at["belt_speed"]])
    table = changes_of(Study(data, settings)).tables["changes"]
    assert (table["p_different_holm"] >= table["p_different"]).dropna().all()
    told = table[table["verdict"].isin([Verdict.MORE, Verdict.LESS])]
    assert (told["p_different_holm"] < 0.05).all()
    assert table.loc[table["quantity"] == measures.MEAN, "relative"].abs().max() < 0.05


def ended(data, some, outcome):
    """The same data, but some runs ended at t = 50."""
    members = data.members
    members.loc[some, ["outcome", "t_stop"]] = outcome, 50.0
    return replace(data, table=members)


def test_shares_of_runs_that_stick_late(swept, settings):
    data = swept({"belt_speed": [-0.1, -0.2, -0.3]}, lambda at, matrix: 0, n_matrices=20)
    data = ended(data, data.members["belt_speed"] == -0.3, "collapsed")
    answer = changes_of(Study(data, settings))
    row = changes(answer, measures.STICKING)["belt_speed"]
    assert (row.verdict, row.first, row.second, row.difference) == (Verdict.MORE, 0.0, 1.0, 1.0)
    assert 0.5 < row.difference_low < row.difference_high <= 1
    mean = changes(answer)["belt_speed"]
    assert (mean.first_value, mean.verdict) == ("-0.2", Verdict.SAME), "against the first that has runs"
    first = answer.findings[0]
    assert isinstance(first, Threshold)
    assert (first.is_end, first.key, first.last, first.first) == (False, "belt_speed", "-0.3", "-0.2")
    assert sentence(first) == "Stick-slip begins between belt_speed = \u22120.3 and \u22120.2, in all 20 systems."
    some = ended(data, data.members["member_id"].isin(["m0-0", "m1-0"]), "collapsed")  # at -0.1 two runs
    assert not any(isinstance(one, Threshold) for one in changes_of(Study(some, settings)).findings)


def test_motion_that_ends_for_most_runs_is_a_change_of_their_share(swept, settings):
    data = swept({"belt_speed": [-0.1, -0.2]}, lambda at, matrix: 0, n_matrices=20)
    data = ended(data, (data.members["belt_speed"] == -0.2) & (data.members["matrix"] > 2), "collapsed")
    first = changes_of(Study(data, settings)).findings[0]
    assert isinstance(first, Changed)
    assert sentence(first).startswith("Share of runs still in stick-slip rises from 15% to 100%, by 85 (")


def test_shares_of_few_runs_that_do_not_differ_are_not_shown_to_be_alike(swept, settings):
    """The same matrices end at both speeds: of five that says little, whatever the difference seen."""
    data = swept({"belt_speed": [-0.1, -0.2]}, lambda at, matrix: 0, n_matrices=5)
    data = ended(data, data.members["matrix"] < 2, "collapsed")
    row = changes(changes_of(Study(data, settings)), measures.STICKING)["belt_speed"]
    assert (row.difference, row.verdict) == (0.0, Verdict.OPEN)
    assert row.difference_low < -0.3 < 0.3 < row.difference_high


def test_as_many_units_as_are_needed_are_enough(swept, settings):
    """Of the first value one run less is known than an interval needs, of the others just as many."""
    data = swept(
        {"belt_speed": [-0.3, -0.2, -0.1]},
        lambda at, matrix: matrix * (1 + int(at["belt_speed"] == -0.1)),
        n_matrices=enough.LEAST_MATRICES,
    )
    data = ended(data, data.members["member_id"] == "m0-0", "collapsed")
    found = changes(changes_of(Study(data, settings)))["belt_speed"]
    assert (found.first_value, found.second_value) == ("-0.2", "-0.1")
    assert found.n_first == found.n_second == enough.LEAST_MATRICES
    assert not pd.isna(found.p_different)


def test_keys_that_go_together_are_one_axis_and_distributions_are_values(swept, settings):
    pairs = [(0.1, 1.0), (0.2, 2.0), (0.3, 3.0)]
    data = swept({"kappa": [0.1, 0.2, 0.3]}, lambda at, matrix: 0)
    together = data.members.assign(rho=data.members["kappa"].map(dict(pairs)))
    design = Design(
        (Axis(("kappa", "rho"), tuple(pairs)),), (), (Source(500, None, Unit.MATRIX),), frozenset(),
        (Method("coulomb", (("tol", 1e-10),)),), (Change(),),
    )  # fmt: skip
    point = together["kappa"].map({kappa: k for k, (kappa, _) in enumerate(pairs)})
    places = {"point": point, "unit": together["matrix"], "method": 0, "change": 0, "base": np.arange(len(together))}
    swept_together = Members.of([together.assign(**places)], design)
    (axis,) = axes_of(Study(Data(swept_together, data.series), settings).groups)
    assert axis == Axis(("kappa", "rho"), tuple(pairs))
    assert set(changes(changes_of(Study(Data(swept_together, data.series), settings)))) == {"kappa with rho"}
    laws = {0.1: 1.0, 0.2: Distribution("uniform", 0.9, 1.1), 0.3: Distribution("uniform", 0.8, 1.2)}
    drawn = data.members.assign(kappa=0.2, friction=data.members["kappa"].map(laws))
    (axis,) = axes_of(Study(Data(drawn, data.series), settings).groups)
    assert axis.texts == ["1", "uniform(0.9, 1.1)", "uniform(0.8, 1.2)"], "wider ones last"


def test_parameters_of_a_function_are_swept(swept, settings):
    data = swept({"kappa": [0.1, 0.2]}, lambda at, matrix: 300 * at["kappa"] + matrix % 2)
    table = data.members.assign(gap=data.members["kappa"].map({0.1: 1.0, 0.2: 2.5}), a=2.0, kappa=None)
    answer = changes_of(Study(Data(members(table, parameters=("gap", "a")), data.series), settings))
    row = changes(answer)["gap"]
    assert (row.verdict, row.first_value, row.second_value) == (Verdict.MORE, "1", "2.5")
    assert row.difference == pytest.approx(30)


def test_nothing_swept_is_not_asked_and_too_few_is_said(planted, swept, settings):
    members, series = planted.ensemble({"coulomb": 0.7, "sigmoid": 0.7}, 5)
    assert set(changes_of(Study(Data(members, series), settings)).tables["changes"]["kind"]) == {"law"}
    alone = swept({"belt_speed": [-0.1, -0.2]}, lambda at, matrix: 0, n_matrices=1)
    first = changes_of(Study(alone, settings)).findings[0]
    assert (first.difference.verdict, first.basis.n) == (Verdict.SAME, 1)
    still = ended(alone, alone.members["matrix"] == 0, "collapsed")
    (lack,) = changes_of(Study(still, settings)).findings
    assert lack == Lack("what changes with belt_speed", Reason.NO_MOTION)


@pytest.mark.drawn
@pytest.mark.parametrize("key", ["belt_speed", "friction"])
def test_figures_draw_what_the_table_says(swept, settings, key):
    """Where values are numbers they stand to scale, where they are distributions they are named."""
    speeds = [-0.4, -0.3, -0.1]
    data = swept(
        {"belt_speed": speeds, "kappa": [0.2, 0.3]},
        lambda at, _: 100 * (at["kappa"] + speeds.index(at["belt_speed"])),
    )
    places = np.abs(speeds)
    if key == "friction":
        laws = {speed: Distribution("uniform", 0.0, 0.1 * (k + 1)) for k, speed in enumerate(speeds)}
        drawn = data.members["belt_speed"].map(laws)
        data = Data(data.members.assign(belt_speed=-0.1, friction=drawn), data.series)
        places = np.arange(3)
    answer = changes_of(Study(data, settings))
    table = answer.tables["sweep_measures"].query("measure == 'mean n_stick'")
    means = [table[table["kappa"].astype(float) == kappa]["estimate"].astype(float) for kappa in (0.2, 0.3)]
    assert all((np.diff(some) > 0).all() for some in means)
    axes = answer.figures["sweep_mean"].recipe().axes[0]
    assert [str(line.get_label()) for line in axes.containers] == ["kappa = 0.2", "kappa = 0.3"]
    for line, mean in zip(axes.containers, means, strict=True):
        np.testing.assert_allclose(line.lines[0].get_ydata(), mean)
        np.testing.assert_allclose(np.asarray(line.lines[0].get_xdata(), float), places, atol=0.01 * np.ptp(places))
    if key == "friction":
        assert [label.get_text() for label in axes.get_xticklabels()] == [*map(str, laws.values())]
        return
    away = ended(data, data.members["kappa"] == 0.3, "diverged")
    assert {"sweep_mean", "sweep_gamma"} <= set(build(away, settings, "Drawn", "", {}).figures)


def test_a_change_in_several_settings_is_told_of_all_of_them(swept, settings):
    """By size of the system: each has its sentence, and no range over them is made."""
    some = [swept({"belt_speed": [-0.2, -0.1]}, lambda at, matrix, k=k: k * (at["belt_speed"] == -0.1) + matrix % 2)
            for k in (1, 20)]  # fmt: skip
    members = [one.members.assign(n=n, member_id=one.members["member_id"] + f"-{n}")
               for one, n in zip(some, (500, 600), strict=True)]  # fmt: skip
    series = {f"{name}-{n}": run for one, n in zip(some, (500, 600), strict=True) for name, run in one.series.items()}
    answer = changes_of(Study(Data(pd.concat(members, ignore_index=True), series), settings))
    lead = answer.findings[: answer.n_lead]
    assert {str(one.where): one.difference.verdict for one in lead} == {
        "n = 500": Verdict.EQUAL, "n = 600": Verdict.MORE,
    }  # fmt: skip


def test_settings_are_in_the_order_of_their_numbers_and_widths():
    uniform, normal = (partial(Distribution, name) for name in ("uniform", "normal"))
    in_order = [
        [1.0, uniform(0.9, 1.1), uniform(0.8, 1.1), uniform(0.5, 1.05), uniform(0.0, 1.0)],
        [normal(1.0, 0.1), normal(0.5, 0.2)],
        ["K-1.npy", "K-9.npy", "K-10.npy"],
        ["n3-s2", "n4-s1", "n5-s1"],
        [-2.0, -1.0, 3.0, None, uniform(0.9, 1.1), Ratio(1.2, "friction"), Ratio(uniform(1.1, 1.4), "friction")],
    ]
    for values in in_order:
        assert sorted(reversed(values), key=rank) == values
    pairs = [(0.2, uniform(0.8, 1.1)), (0.3, uniform(0.8, 1.2))]
    both = labels([planted_key(kappa=kappa, values=Values([("friction", law)])) for kappa, law in pairs])
    assert both[0] == "n = 2, exact, kappa = 0.2, friction = uniform(0.8, 1.1)"
    assert apart(both, always=1)[1] == "n = 2, kappa = 0.3, friction = uniform(0.8, 1.2)"


def planted_key(**changes):
    fixed = {"n": 2, "kappa": 0.2, "friction": None, "perturbation_size": 0.0, "engine": "coulomb"}
    return fixed | {"tol": 1e-8} | changes
