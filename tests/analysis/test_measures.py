"""What a sweep measures beyond n_stick: planted trends of recorded numbers and of episodes are found and told."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import special

from stickslip.analysis import Study, build, measures
from stickslip.analysis.ensemble import Recorded
from stickslip.analysis.findings.finding import Change, Course, Verdict
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.grid import balanced
from stickslip.analysis.page.comparison import Ensemble, compare
from stickslip.analysis.questions.runs.changes import answer as changes_of
from stickslip.analysis.stats.estimates import UnitSums
from stickslip.analysis.stats.shares import wilson
from tests.analysis.designs import Data
from tests.analysis.studies import renewals

pytestmark = pytest.mark.usefixtures("undrawn")
SPEEDS = [-0.3, -0.2, -0.1]
WORDS = "share of blocks that never slipped"


@pytest.fixture
def settings(settings):
    return replace(settings, margins={"mean": 0.02, "gamma": 0.05})


@pytest.fixture
def recorded(planted, rng):
    """Of each matrix a run at each point of a grid, and the numbers `columns` = {name: f(rng, matrix, *values)}."""

    def make(columns, n_matrices=8, axes=None, changes=(), **data):
        axes = axes or {"belt_speed": SPEEDS}
        grid = np.array(np.meshgrid(*axes.values(), indexing="ij")).reshape(len(axes), -1).T
        rows, series, found = [], {}, {name: {} for name in columns}
        for matrix in range(n_matrices):
            one = planted.runs(rng, 400, 0.7)
            for k, values in enumerate(grid):
                name = f"m{matrix}-{k}"
                point = dict(zip(axes, values.tolist(), strict=True))
                rows.append(planted.member(name, matrix, **point | dict(changes).get(name, {})))
                if rows[-1]["outcome"] != "failed":
                    series[name] = one
                for column, of in columns.items():
                    found[column][name] = None if rows[-1]["outcome"] == "failed" else of(rng, matrix, *values)
        own = {name: Recorded(WORDS, values) for name, values in found.items()}
        return Data(pd.DataFrame(rows), series, recorded=own, **data)

    return make


def rows_of(answer, quantity):
    table = answer.tables["changes"]
    return table[table["quantity"] == quantity].set_index("second_value")


def measured(answer):
    """Each measure at each point, without the share of runs that stick late."""
    table = answer.tables["sweep_measures"]
    return table[table["measure"] != measures.STICKING]


def said(answer):
    """The first sentence."""
    return sentence(answer.findings[0])


def alerts(answer):
    return " ".join(map(str, answer.alerts))


def test_a_recorded_number_leads_in_its_words(recorded, settings):
    """The matrices differ by 1, the change is 0.5 and alternates by 0.01: only pairs of a matrix show it."""
    data = recorded({"never_left": lambda rng, matrix, v: 10 + matrix + 2.5 * v + 0.01 * (matrix % 2) * (v > -0.2)})
    answer = changes_of(Study(data, settings))
    row = rows_of(answer, "mean never_left").loc["-0.1"]
    assert row["difference"] == pytest.approx(0.505)
    assert row["difference_low"] < 0.505 < row["difference_high"] < 0.52
    assert row["verdict"] == Verdict.MORE
    assert set(answer.tables["changes"]["quantity"]) == {"mean never_left"}, "neither n_stick nor gamma"
    assert answer.findings[0].quantity.definition == WORDS
    steep = recorded({"never_left": lambda rng, matrix, v: 10 + matrix + 50 * v})
    text = said(changes_of(Study(steep, settings)))
    assert re.match(r"Mean never_left rises from \S+ to \S+, by ", text)
    assert text.endswith(" as |belt_speed| goes from 0.3 to 0.1.")
    page = build(steep, settings, "Own", "", {})
    assert next(iter(page.figures)) == "sweep_of_never_left"
    assert page.headline[1].startswith("Mean never_left")


def test_cascades_are_measured_too_where_they_are_asked_for(recorded, settings):
    data = recorded({"amplitude": lambda rng, matrix, v: 1 + matrix})
    names = [one.name for one in measures.measures(Study(data, replace(settings, question=("cascades",))))]
    assert names == ["mean amplitude", measures.GAMMA, measures.MEAN]
    assert [one.name for one in measures.measures(Study(data, settings))] == ["mean amplitude"]
    bare = replace(data, recorded={})
    assert [one.name for one in measures.measures(Study(bare, settings))] == [measures.MEAN, measures.GAMMA]


def test_the_growth_rate_stands_behind_what_is_recorded_for_its_own_sake(recorded, settings):
    data = recorded({"growth_rate": lambda rng, matrix, v: -v, "amplitude": lambda rng, matrix, v: 1.0 + matrix})
    members = data.members.assign(growth_rate=-data.members["belt_speed"])
    data = Data(members, data.series, recorded=data.recorded)
    found = measures.measures(Study(data, settings))
    assert [one.name for one in found] == ["mean amplitude", "mean growth_rate"]
    alone = replace(data, recorded={"growth_rate": data.recorded["growth_rate"]})
    assert [one.name for one in measures.measures(Study(alone, settings))] == [measures.MEAN, measures.GAMMA]


@pytest.mark.parametrize(
    ("values", "verdict"),
    [((0.0, 0.5, 1.0), Verdict.MORE), ((-2.0, -1.5, -1.0), Verdict.MORE), ((-1.0, 0.0, 1.0), Verdict.MORE),
     ((3.0, 0.0, 0.0), Verdict.LESS), ((-1.0, -2.0, -3.0), Verdict.LESS), ((0.0, 0.0, 0.0), Verdict.SAME)],
)  # fmt: skip
def test_a_change_has_the_sign_of_the_difference(recorded, settings, values, verdict):
    """From zero, below zero and through it, where a ratio has no sign of its own or no value."""
    at = dict(zip(SPEEDS, values, strict=True))
    data = recorded({"work": lambda rng, matrix, v: at[v] * (1 + 0.01 * matrix)})
    answer = changes_of(Study(data, settings))
    assert rows_of(answer, "mean work").loc["-0.1", "verdict"] == verdict
    words = {Verdict.MORE: " rises ", Verdict.LESS: " falls ", Verdict.SAME: " is the same in every run "}
    assert words[verdict] in said(answer)


def test_a_change_of_the_size_of_the_tolerance_is_none(recorded, settings):
    """Every run has tol = 1e-10: 1e-11 of the number may be its error, and 1e-8 is not."""
    for change, is_same in ((1e-11, True), (1e-8, False)):
        data = recorded({"work": lambda rng, matrix, v, by=change: 3.0 * (1 + by * (v > -0.2))})
        data = replace(data, table=data.members.assign(tol=1e-10))
        row = rows_of(changes_of(Study(data, settings)), "mean work").loc["-0.1"]
        assert (row["verdict"] == Verdict.SAME) is is_same
        assert pd.isna(row["p_different"]) is is_same
    rest = recorded({"work": lambda rng, matrix, v: {-0.3: 1e-14 * matrix, -0.2: 1.0, -0.1: 1e-13 * matrix}[v]})
    row = rows_of(changes_of(Study(rest, settings)), "mean work").loc["-0.1"]
    assert row["verdict"] == Verdict.SAME, "beside runs that move, ten times nothing is nothing"


def test_a_gap_in_one_matrix_is_no_scatter_between_matrices(recorded, settings):
    """The same change in all matrices at each drop, which matters far more; one run of one matrix has no value."""
    axes = {"belt_speed": [-0.3, -0.1], "static": [1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 1.8, 1.9]}

    def work(rng, matrix, v, static):
        return None if (matrix, v, static) == (2, -0.1, 1.4) else 10 * static**3 + (v > -0.2) * static

    row = rows_of(changes_of(Study(recorded({"work": work}, axes=axes), settings)), "mean work").loc["-0.1"]
    assert row["n_first"] == 8
    assert row["difference"] == pytest.approx(np.mean([1.1, 1.2, 1.3, 1.5, 1.6, 1.7, 1.8, 1.9]))
    assert row["difference_high"] - row["difference_low"] == pytest.approx(0, abs=1e-9)
    assert row["first_high"] - row["first_low"] == pytest.approx(0, abs=1e-9)


def test_values_are_balanced_by_leaving_out_what_lacks_most():
    full = np.arange(6)
    for have, rows, units in (
        ([full, full], [0, 1], full),
        ([full, full[:2], full], [0, 2], full),
        ([full[1:], full[1:], full[1:], full], [0, 1, 2, 3], full[1:]),
        ([full[:3], full[3:]], [0, 1], full),  # nothing without gaps: as they are
        ([full[:2]], [0], full[:2]),
        ([], [], full[:0]),
    ):
        balance, common = balanced([UnitSums(some, np.ones((len(some), 2))) for some in have])
        assert balance == rows
        assert common.units.tolist() == units.tolist()


def test_each_change_is_told_between_the_values_that_it_is_between(recorded, settings):
    """Of `late`, two matrices have a value at the first point, and four at the second."""
    data = recorded({
        "early": lambda rng, matrix, v: 1.0 + matrix + 50 * (v + 0.3),
        "late": lambda rng, matrix, v: None if matrix >= {-0.3: 2, -0.2: 4, -0.1: 8}[v] else 3.0 + matrix - 20 * v,
    })  # fmt: skip
    answer = changes_of(Study(data, settings))
    ends = {
        one.quantity.key: one for one in answer.findings if isinstance(one, Change) and one.keys[0].second == "-0.1"
    }
    assert (ends["mean early"].keys[0].first, ends["mean early"].basis.n) == ("-0.3", 8)
    late = ends["mean late"]
    assert (late.keys[0].first, late.basis.n, late.before.value, late.after.value) == ("-0.2", 4, 8.5, 6.5)


def test_no_interval_goes_below_what_a_number_is_never_below(recorded, settings):
    """One matrix in eight moves at all: 1 with a standard error of 1."""
    data = recorded({"amplitude": lambda rng, matrix, v: 8.0 * (matrix == 0) * (1 - v)})
    low = {}
    for least in (None, 0.0):
        own = {"amplitude": data.recorded["amplitude"]._replace(least=least)}
        answer = changes_of(Study(replace(data, recorded=own), settings))
        row = rows_of(answer, "mean amplitude").loc["-0.1"]
        low[least is not None] = (row["first_low"], *measured(answer)["estimate_low"])
        assert row["first_high"] > row["first"] == pytest.approx(1.3)
        assert row[["relative", "relative_low", "relative_high"]].isna().all(), (
            "the first is 0 within its uncertainty"
        )
        assert "%" not in said(answer)
    assert max(low[False]) < 0
    assert set(low[True]) == {0.0}


def test_runs_without_a_value_are_counted_and_named(recorded, settings):
    lost = {"m2-1": {"outcome": "failed", "reason": "no more memory", "t_stop": None}}
    holes = {(0, -0.3): None, (1, -0.3): np.nan, (4, -0.3): np.inf}
    data = recorded({"period": lambda rng, matrix, v: holes.get((matrix, v), 2.0 + v)}, changes=lost)
    answer = changes_of(Study(data, settings))
    table = measured(answer)
    assert list(table["n_without"]) == [3, 1, 0]
    assert list(table["n_units"]) == [5, 7, 8]
    assert list(table["estimate"]) == pytest.approx([1.7, 1.8, 1.9])
    assert table.notna().all()[["estimate", "estimate_low", "estimate_high"]].all()
    assert "4 of 24 runs have no mean period and are left out there: its record gives none." in alerts(answer)


def test_a_run_that_failed_to_be_measured_is_not_one_without_such_a_number(recorded, settings):
    data = recorded({"period": lambda rng, matrix, v: None if matrix < 2 else 2.0 + v})
    column = data.recorded["period"]._replace(
        absent="on no cycle, or undecided", problems={"m0-0": "mine:one: KeyError: 'a'"}
    )
    answer = changes_of(Study(replace(data, recorded={"period": column}), settings))
    assert measured(answer)["n_without"].sum() == 6
    assert "1 of 24 runs have no mean period and are left out there: mine:one: KeyError" in alerts(answer)


@pytest.mark.parametrize("n_matrices", [1, 3])
def test_of_few_systems_the_values_are_told_and_that_they_are_few(recorded, settings, n_matrices):
    data = recorded({"amplitude": lambda rng, matrix, v: 5 * abs(v) + 0.01 * matrix}, n_matrices)
    answer = changes_of(Study(data, settings))
    first = answer.findings[0]
    assert (first.difference.verdict, first.basis.n) == (Verdict.UNJUDGED, n_matrices)
    assert said(answer).endswith(f"; {n_matrices} system{'s' * (n_matrices > 1)}, no interval.")
    row = rows_of(answer, "mean amplitude").loc["-0.1"]
    assert row["difference"] == pytest.approx(-1.0)
    assert row["verdict"] == Verdict.UNJUDGED
    assert pd.isna(row["p_different"])
    assert "sweep_of_amplitude" in answer.figures


def test_two_swept_keys_are_told_apart(recorded, settings):
    axes = {"kappa": [0.01, 0.1, 1.0], "belt_speed": [-0.2, -0.1]}
    data = recorded({"speed": lambda rng, matrix, kappa, v: 100 * kappa + 1e-3 * matrix + 0.02 * v}, axes=axes)
    answer = changes_of(Study(data, settings))
    assert list(answer.figures) == ["sweep_of_speed"]
    found = {one.keys[0].key: one.difference.verdict for one in answer.findings[: answer.n_lead]}
    assert found == {"kappa": Verdict.MORE, "belt_speed": Verdict.MORE}
    assert answer.findings[0].keys[0].key == "kappa", "the larger one leads"
    along = answer.figures["sweep_of_speed"].recipe().axes[0]
    assert (along.get_xscale(), along.get_yscale()) == ("log", "log"), "both span two decades"
    assert len(measured(answer)) == 6


def planted_episodes(rng, members, rates, b):
    """Poisson episodes at a rate by belt speed, sizes of mean 3, moments of a Pareto law with an exponent by speed.

    Without an exponent they are of a Pareto law and, a quarter of them, near 1000: b falls towards that, as none may.
    """
    table = []
    for name, v, t_end in zip(members["member_id"], members["belt_speed"], members["t_end"], strict=True):
        start = np.cumsum(rng.exponential(1 / rates[v], int(3 * rates[v] * t_end) + 60))
        start = start[start < t_end]
        m = len(start)
        moment = rng.uniform(size=m) ** (-1 / b[v]) if v in b else 1.0 + rng.exponential(100.0, m)
        table.append(pd.DataFrame({
            "member_id": name, "start": start, "end": start, "size": 1 + rng.poisson(2, m),
            "moment": moment, "first_block": 0,
        }))  # fmt: skip
    return pd.concat(table, ignore_index=True)


def test_rate_size_and_b_of_episodes_lead_and_b_only_where_it_holds(recorded, strict, rng):
    rates = {-0.3: 1.5, -0.2: 1.0, -0.1: 0.5}
    data = recorded({})
    data = replace(data, episodes=planted_episodes(rng, data.members, rates, {-0.3: 0.8, -0.2: 0.8}))
    answer = changes_of(Study(data, strict))
    table = measured(answer).pivot_table(index="belt_speed", columns="measure", values="estimate")
    assert table["rate of episodes"].to_dict() == pytest.approx(rates, rel=0.15)
    assert list(table["mean size of episodes"]) == pytest.approx([3.0] * 3, rel=0.1)
    assert list(table["b of episodes"])[:2] == pytest.approx([0.8] * 2, rel=0.25)
    assert pd.isna(table["b of episodes"].iloc[2])
    assert list(rows_of(answer, "b of episodes").index) == ["-0.2"], "no trend to where no b holds"
    assert rows_of(answer, "rate of episodes").loc["-0.1", "verdict"] == Verdict.LESS
    leading = [sentence(finding) for finding in answer.findings[: answer.n_lead]]
    assert re.match(r"No change of the b-value of the episodes \(M = 0\.\d to \S+\) is shown", leading[0])
    assert leading[1].startswith("Rate of episodes falls from 1."), "no change of b is shown"
    lacks = " is not given at {} of 3 points: "
    assert lacks.format(1) + "no power law is shown" in alerts(answer)
    few = replace(data, episodes=data.episodes[data.episodes.index % 100 == 0])
    assert lacks.format(3) + "no power law is shown: too few systems or events" in alerts(
        changes_of(Study(few, strict))
    )


def test_two_datasets_are_compared_in_what_both_record(recorded, settings):
    def ensemble(name, **columns):
        data = recorded({key: lambda rng, matrix, v, x=x: x + 0.01 * matrix * (x != 0) for key, x in columns.items()})
        return Ensemble(name, replace(data, table=data.members.assign(seed=0)), settings.t_burn, settings.margins, {})

    first, second = ensemble("a", amplitude=1.0, gone=2.0, left=0.0), ensemble("b", amplitude=1.5, left=0.3)
    found = compare(first, second, settings)
    table = found.tables["changes"].groupby("quantity")["verdict"].unique()
    assert list(table["mean amplitude"]) == [Verdict.MORE]
    assert list(table["mean left"]) == [Verdict.MORE], "from zero there is no ratio, but a difference"
    assert "mean gone" not in table
    assert found.headline[0].startswith("No: b ")
    ones = Recorded(WORDS, dict.fromkeys(first.data.members["member_id"], 1.0))
    other = replace(first, name="c", data=replace(first.data, recorded={"left": ones}))
    assert compare(first, replace(first, name="d"), settings).headline == ["Yes: d agrees with a."]
    assert not compare(first, other, settings).headline[0].startswith("Yes"), "the same runs, another record"


def test_what_is_beyond_both_ends_of_a_key_is_told(recorded, settings):
    """A resonance: at the middle speed five times as much as at the first, at the last half as much."""
    at = {-0.3: 1.0, -0.2: 5.0, -0.1: 0.5}
    answer = changes_of(Study(recorded({"swing": lambda rng, m, v: at[v] + 0.01 * rng.normal()}), settings))
    (change,) = answer.findings[: answer.n_lead]
    assert (change.keys[0].second, change.difference.verdict) == ("-0.1", Verdict.LESS)
    (turn,) = change.turns
    assert turn.course is Course.MAXIMUM
    assert turn.estimate.value == pytest.approx(5.0, abs=0.05)
    steady = recorded({"swing": lambda rng, m, v: 5.0 + 10 * v + 0.01 * rng.normal()})
    assert changes_of(Study(steady, settings)).n_lead == 1


def test_averages_are_over_values_that_have_one_throughout(recorded, settings):
    """Of two friction coefficients one has no period at some starts: averages would jump there."""
    axes = {"z0": [0.0, 1.0, 2.0, 3.0], "w0": [0.0, 1.0, 2.0], "friction": [1.0, 2.0]}

    def period(rng, matrix, z, w, friction):
        return None if friction == 2.0 and z > 1.5 else 6.0 + friction

    data = recorded({"period": period}, n_matrices=1, axes=axes)
    figures = changes_of(Study(data, settings)).figures
    (ax, *_) = figures["sweep_of_period"].recipe().axes
    assert {*np.concatenate([line.get_ydata() for line in ax.lines if len(line.get_ydata()) > 2])} == {7.0}


def test_a_change_at_some_values_of_another_key_says_at_which(recorded, settings):
    """A period at every belt where kappa = 0.1, and where kappa = 0.2, 0.3 at the first one alone."""
    axes = {"belt_speed": SPEEDS, "kappa": [0.1, 0.2, 0.3]}
    data = recorded(
        {"period": lambda _, matrix, v, k: 3 + v + 0.01 * matrix if k < 0.15 or v < -0.25 else None}, axes=axes
    )
    data = replace(data, recorded={"period": data.recorded["period"]._replace(absent="not on a cycle")})
    answer = changes_of(Study(data, settings))
    assert said(answer).endswith("as |belt_speed| goes from 0.3 to 0.1 at kappa = 0.1.")
    places = {one.keys[0].key: str(one.where) for one in answer.findings[: answer.n_lead]}
    assert places == {"belt_speed": "kappa = 0.1", "kappa": "belt_speed = -0.3"}
    whole = recorded({"amplitude": lambda _, matrix, v, k: 3 + v + 0.01 * matrix}, axes=axes)
    assert "values of kappa" not in said(changes_of(Study(whole, settings)))


def holds(row, name, answer):
    """Whether an interval at `SURE` holds a number, widened by a fifth: all of a test fail less than once in 10^6."""
    value, low, high = (row[f"{name}{end}"] for end in ("", "_low", "_high"))
    high = np.inf if pd.isna(high) else high  # of a median: not reached
    return value - 1.2 * (value - low) < answer < value + 1.2 * (high - value)


def test_the_first_time_is_right_however_short_the_runs_are(recorded, strict, rng):
    """The same draws to t = 10, 50 and 300: Weibull's law with the exponent 1.5, of means 7.65 and 19.2.

    To 10 most runs of the second have none: the mean of those that have is far too small, the mean up to 10 is not.
    """
    scales = np.array([7.65, 19.2]) / special.gamma(1 + 1 / 1.5)
    medians, n = scales * np.log(2) ** (1 / 1.5), 200
    drawn = scales * rng.weibull(1.5, (n, 2))
    axes = {"belt_speed": [-0.2, -0.1]}
    for t_end in (10.0, 50.0, 300.0):
        times = np.where(drawn <= t_end, drawn, np.nan)
        data = recorded({"first": lambda _, matrix, v, t=times: t[matrix, int(v > -0.15)]}, n, axes)
        first = data.recorded["first"]._replace(since=0.0, called="time of the first exit", says_it=True)
        study = Study(
            Data(data.members.assign(t_end=t_end, t_stop=t_end), data.series, recorded={"first": first}),
            replace(strict, t_burn=5.0),
        )
        table = measured(changes_of(study)).set_index(["measure", "belt_speed"])
        changes = rows_of(changes_of(study), "restricted mean first").loc["-0.1"]
        area = special.gamma(1 / 1.5) * special.gammainc(1 / 1.5, (t_end / scales) ** 1.5) * scales / 1.5
        for k, v in enumerate((-0.2, -0.1)):
            row = table.loc["restricted mean first", v]
            assert holds(row, "estimate", area[k])
            assert row[["n_units", "n_censored", "n_without"]].tolist() == [n, np.isnan(times[:, k]).sum(), 0]
            row = table.loc["median first", v]
            if pd.isna(row["estimate"]):
                assert row["reason"] == measures.NOT_REACHED
                assert (t_end, v) == (10.0, -0.1)
            else:
                assert holds(row, "estimate", medians[k])
        assert holds(changes, "difference", area[1] - area[0])
        answer = changes_of(study)
        if t_end == 10.0:
            seen = times[:, 1][np.isfinite(times[:, 1])]
            assert seen.mean() + 5 * seen.std() / np.sqrt(len(seen)) < 19.2
            # whether it is shown to rise is chance at this confidence
            assert said(answer).startswith("Restricted mean of the time of the first exit up to 10 ")
            assert "is not given at 1 of 2 points" in alerts(answer)
        else:
            change = rows_of(changes_of(study), "median first").loc["-0.1"]
            assert holds(change, "difference", medians[1] - medians[0])
            assert said(answer).startswith("Median time of the first exit ")


def test_a_run_that_ended_early_was_followed_until_then(recorded, settings):
    """What ran away or failed, and what is certain never to stick again, where that counts."""
    changes = {
        "m0-0": {"outcome": "diverged", "t_stop": 200.0},
        "m1-0": {"outcome": "failed", "t_stop": None},
        "m2-0": {"outcome": "collapsed", "t_stop": 300.0},
    }
    data = recorded({"first": lambda _, matrix, v: None if matrix < 5 else 50.0}, changes=changes)
    for problem in ("mine:first: KeyError: 'a'", "mine:first: expected a finite number for first, got nan"):
        first = data.recorded["first"]._replace(since=10.0, problems={"m3-0": problem})
        study = Study(replace(data, recorded={"first": first}), settings)
        group = study.groups[0]
        times, is_known = study.times(group, "first")
        assert is_known.tolist() == [True, False, True, False, True, True, True, True]
        assert times.of_unit.tolist() == [0, 2, 4, 5, 6, 7]
        assert times.times.tolist() == [190.0, 990.0, 990.0, 50.0, 50.0, 50.0]
        assert study.limit("first") == 990.0
        (measure, _) = measures.measures(study)
        assert measure.of(group).missing == {"m1-0": "failed", "m3-0": problem}
        assert study.median(group, "first").value == 50.0
        assert study.restricted_mean(group, "first", 100.0).value == pytest.approx(75.0)
        with pytest.raises(
            ValueError, match=r"numbers: expected a number of which means .* study\.median\(group, 'f"
        ):
            study.mean(group, "first")
    with pytest.raises(ValueError, match="name: expected a time that the end of a run may cut off, got 'work'"):
        Study(recorded({"work": lambda *_: 1.0}), settings).median(group, "work")


def test_waiting_times_are_right_however_short_the_windows_are(planted, strict, rng):
    """The same draws, 100 units and then 10, 50 and 300: eight blocks whose exits are 19.2 apart on average.

    The mean of the times that lie in a window of 10 whole is below 10.
    """
    axes = (-0.2, -0.1)
    exits = {(k, v): run for v in axes for k, run in enumerate(renewals(rng, 100, 8, 19.2, 400.0))}
    for window in (10.0, 50.0, 300.0):
        rows, series = [], {}
        for (k, v), t in exits.items():
            name = f"m{k}-{v}"
            t = t[t < 100.0 + window]
            rows.append(planted.member(name, k, belt_speed=v, n=8, t_end=100.0 + window, t_stop=100.0 + window))
            steps = np.concatenate([t, t + 1e-6])  # each comes to rest at once
            order = np.argsort(steps)
            levels = 8 + np.cumsum(np.repeat([-1, 1], len(t))[order])
            series[name] = np.append(0.0, steps[order]), np.append(8, levels)
        short = dict.fromkeys(series, window / 3)
        own = {
            "waiting_mean": Recorded(WORDS, short, of_gaps="mean"),
            "waiting_cv": Recorded(WORDS, dict.fromkeys(series, 0.3), of_gaps="scatter"),
        }
        table = measured(changes_of(Study(Data(pd.DataFrame(rows), series, recorded=own), strict)))
        means = table[table["measure"] == "mean waiting_mean"]
        assert all(holds(row, "estimate", 19.2) for _, row in means.iterrows())
        assert means["estimate_high"].max() < 32.0, "nor are they wide"
        scatter = table[table["measure"] == "mean waiting_cv"]
        assert scatter["estimate"].isna().all()
        assert set(scatter["reason"]) == {"fewer than 50 exits per block: long times are cut off"}


def test_waiting_times_are_of_blocks_with_friction(planted, settings, rng):
    rows = [planted.member(f"m{k}-{v}", k, belt_speed=v, n_contacts=50) for k in range(6) for v in (-0.2, -0.1)]
    series = {row["member_id"]: planted.runs(rng, 400, 0.7) for row in rows}
    own = {"waiting_mean": Recorded(WORDS, dict.fromkeys(series, 1.0), of_gaps="mean")}
    means = []
    for members in (pd.DataFrame(rows), pd.DataFrame(rows).drop(columns="n_contacts")):
        table = measured(changes_of(Study(Data(members, series, recorded=own), settings)))
        means.append(table["estimate"].to_numpy(float))
    np.testing.assert_allclose(means[1], 4.0 * means[0])  # of 200


def test_a_share_has_one_interval_everywhere(recorded, settings):
    """None of 20, and half of the systems in all three of their runs: as many trials as systems."""
    data = recorded({"lifts": lambda _, matrix, v: float(v > -0.15 and matrix % 2)}, 20, {"belt_speed": [-0.2, -0.1]})
    data = replace(data, recorded={"lifts": data.recorded["lifts"]._replace(is_share=True)})
    known = dict(data.recorded["lifts"].values)
    study = Study(data, settings)
    answer = changes_of(study)
    table = measured(answer).set_index("belt_speed")
    row = rows_of(answer, "share lifts").loc["-0.1"]
    for k, (name, v) in enumerate((("first", -0.2), ("second", -0.1))):
        (group,) = (one for one in study.groups if one.key["belt_speed"] == v)
        share = study.mean(group, "lifts")
        assert share == study.share(group, {name: None if x is None else bool(x) for name, x in known.items()})
        ends = (share.low, share.high)
        assert ends == pytest.approx(wilson(10 * k, 20, 0.95))
        assert ends == tuple(table.loc[v, ["estimate_low", "estimate_high"]])
        assert ends == tuple(row[[f"{name}_low", f"{name}_high"]])
    assert row["verdict"] == Verdict.MORE
    assert 0.2 < row["difference_low"] < row["difference"] == 0.5
    several = Study(
        Data(
            pd.concat([data.members.assign(member_id=data.members["member_id"] + f"-{k}") for k in range(3)]),
            {f"{name}-{k}": one for name, one in data.series.items() for k in range(3)},
            recorded={"lifts": Recorded(WORDS, {
                f"{name}-{k}": x for name, x in known.items() for k in range(3)
            }, is_share=True)},
        ),
        settings,
    )  # fmt: skip
    again = changes_of(several)
    assert rows_of(again, "share lifts").loc["-0.1"].to_dict() == row.to_dict()
    assert measured(again)["estimate_high"].tolist() == table["estimate_high"].tolist()
    first, second = (
        Ensemble(name, replace(data, table=data.members.assign(seed=seed)), 100.0, {}, {})
        for name, seed in (("a", 0), ("b", 0))
    )
    other = {name: 1.0 - x if name.endswith("-0") else x for name, x in known.items()}
    lifted = replace(second.data, recorded={"lifts": data.recorded["lifts"]._replace(values=other)})
    found = compare(first, replace(second, data=lifted), settings).tables["changes"]
    found = found[found["quantity"] == "share lifts"]
    assert found["first_high"].tolist() == table["estimate_high"].tolist()


def test_a_share_of_blocks_has_the_same_interval_everywhere(recorded, settings):
    """None has it at the first speed, and at the second half of the blocks of each; what is never above 1 says so."""
    shares = {-0.2: 0.0, -0.1: 0.5}
    data = recorded(
        {"held": lambda _, matrix, v: shares[v] + 0.01 * (v > -0.2) * matrix}, 12, {"belt_speed": [*shares]}
    )
    data = replace(data, recorded={"held": data.recorded["held"]._replace(least=0.0, most=1.0)})
    study = Study(data, settings)
    answer = changes_of(study)
    table = measured(answer).set_index("belt_speed")
    none, half = (next(one for one in study.groups if one.key["belt_speed"] == v) for v in shares)
    ends = study.mean(none, "held")
    assert (ends.low, ends.high) == (0.0, 0.0)
    assert table.loc[-0.2, "estimate_high"] == ends.high
    assert study.mean(none, dict.fromkeys(data.recorded["held"].values, 0.0), 0.0, 1.0) == ends
    row = rows_of(answer, "mean held").loc["-0.1"]
    assert (row["first_high"], row["second_low"]) == (ends.high, table.loc[-0.1, "estimate_low"])
    assert (row["verdict"], row["difference"]) == (Verdict.MORE, pytest.approx(0.555))
    assert 0.52 < row["difference_low"] < 0.555
    assert study.mean(half, "held").high - study.mean(half, "held").low < 0.06


def test_each_row_has_a_value_or_a_reason(recorded, settings):
    axes = {"belt_speed": SPEEDS}
    names = ("plain", "lifts", "time", "share", "waiting_mean", "waiting_cv")
    data = recorded({name: lambda _, matrix, v: 0.5 if v < -0.2 else None for name in names}, 5, axes)
    kinds = {"lifts": {"is_share": True}, "time": {"since": 0.0, "problems": dict.fromkeys(data.series, "mine")},
             "share": {"least": 0.0, "most": 1.0}, "waiting_mean": {"of_gaps": "mean"},
             "waiting_cv": {"of_gaps": "scatter"}}  # fmt: skip
    own = {name: data.recorded[name]._replace(**kinds.get(name, {})) for name in names}
    still = {name: (np.array([0.0]), np.array([200])) for name in data.series}
    study = Study(replace(data, recorded=own, series=still), replace(settings, question=("cascades",)))
    table = measured(changes_of(study))
    assert table["measure"].nunique() == len(names) + 3  # two of a time, and those of n_stick
    lacks = table["estimate"].isna()
    assert 0 < lacks.sum() < len(table)
    assert table["reason"][lacks].notna().all()
    assert table["reason"][~lacks & table["estimate_low"].isna()].notna().all()
