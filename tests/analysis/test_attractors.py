"""Shares of what runs settle on: planted ones come back, with intervals in closed form; nobody else counts."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm

from stickslip.analysis import Study
from stickslip.analysis.ensemble import Recorded
from stickslip.analysis.findings.alerts import Code
from stickslip.analysis.findings.finding import Alike, Attracting, Bound, Regime, Share, Verdict
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.models.attractors import Cycle, alike, plane
from stickslip.analysis.questions.runs import fates
from stickslip.analysis.questions.runs.fate_figures import LOOKS
from stickslip.analysis.questions.runs.settled import PREDICATES, Outcome, stretches
from stickslip.sim import System, simulate
from stickslip.sim.attractors.result import Kind
from tests.analysis.designs import Data
from tests.analysis.reports import of_kind

SERIES = (np.array([0.0, 150.0]), np.array([3, 2]))
KINDS = 3 * ["sliding"] + 5 * ["periodic"] + ["irregular", "undecided"]
PERIODS = [None] * 3 + [2.0, 4.0, 6.0, 7.0, 9.0] + [None] * 2


#: Numbers of a run that a record of attractors keeps.
NUMBERS = ("period", "multiplier", "exits_per_period", "events_per_period")
#: Of what attracts beside them, and where that ends.
ENDS = ("critical_rate", "critical_frequency", "stability_changes", "motion_ends_below", "motion_ends_above")


@pytest.fixture
def planted_runs(planted):
    """An ensemble of rows of members, with numbers and lists of the record among their columns."""

    def of(rows):
        table = pd.DataFrame([planted.member(f"m{k}", 0, n=1) | {"attractor_reason": None, "exits_block": 0} | row
                              for k, row in enumerate(rows)])  # fmt: skip
        names = table["member_id"].tolist()
        recorded = {name: Recorded(name, {one: row.get(name) for one, row in zip(names, rows, strict=True)})
                    for name in (*NUMBERS, *(name for name in ENDS if name in table))}  # fmt: skip
        kept = {"section_z", "section_w", "start_z", "start_w", "exits_z", "critical_shape"}
        lists = {name: {one: np.array(row[name]) for one, row in zip(names, rows, strict=True) if name in row}
                 for name in kept}  # fmt: skip
        table = table.drop(columns=[name for name in (*NUMBERS, *ENDS, *kept) if name in table])
        ran = [one for one, row in zip(names, rows, strict=True) if row.get("outcome") != "failed"]
        return Data(table, dict.fromkeys(ran, SERIES), recorded=recorded, lists=lists)

    return of


@pytest.fixture
def data(planted_runs):
    def of(kinds=KINDS, periods=PERIODS, **changes):
        rows = [{"matrix": k, "n": 4, "attractor": kind, "period": period} | changes
                for k, (kind, period) in enumerate(zip(kinds, periods, strict=True))]  # fmt: skip
        failed = {"matrix": len(rows), "n": 4, "attractor": None, "outcome": "failed", "reason": "planted"}
        return planted_runs([*rows, failed])

    return of


Z = norm.ppf(0.975)


def wilson(has, of):
    """The two shares p at which |has / of - p| = Z sqrt(p (1 - p) / of)."""
    a, b, c = 1 + Z**2 / of, -(2 * has / of + Z**2 / of), (has / of) ** 2
    return np.sort(np.roots([a, b, c]))


def shares(answered):
    return {share.key: share for share in of_kind(answered, Share)}


def said(answered):
    return [sentence(finding) for finding in answered.findings[: answered.n_lead]]


def test_shares_and_periods(data, settings):
    answered = fates.answer(Study(data(), settings))
    n_of = {"sliding": 3, "periodic": 5, "irregular": 1, "undecided": 1, "others": 2}
    assert {key: round(10 * share.estimate.value) for key, share in shares(answered).items()} == n_of
    for key, share in shares(answered).items():  # the undecided run may have each of the other outcomes
        ends = wilson(n_of[key], 10)[0], wilson(n_of[key] + (key not in ("undecided", "others")), 10)[1]
        np.testing.assert_allclose([share.estimate.low, share.estimate.high], ends, rtol=1e-9)
        assert share.basis.n == 10
    table = answered.tables["fates"].set_index("outcome")
    assert table["n_runs"].to_dict() == {key: n for key, n in n_of.items() if key != "others"}
    assert table["period"].dropna().to_dict() == {"periodic": 6.0}
    assert said(answered) == [
        "50% (24 to 83%) of runs end on a limit cycle.",
        "30% (11 to 69%) of runs end in steady sliding.",
        "20% (6 to 51%) of runs stay irregular or are undecided.",
    ]


def test_runs_of_one_matrix_are_no_independent_trials(data, settings):
    """Two matrices of ten runs each, all of one kind: the interval is that of two trials."""
    whole = data(10 * ["rest"] + 10 * ["periodic"], 20 * [None])
    whole = replace(whole, table=whole.members.assign(matrix=[0] * 10 + [1] * 10 + [2]))
    estimate = shares(fates.answer(Study(whole, settings)))["rest"].estimate
    np.testing.assert_allclose([estimate.low, estimate.high], wilson(1, 2), rtol=1e-9)


def test_the_question_is_of_attractors_where_they_are_recorded(data, settings):
    kept = data()
    for other in (Data(kept.members.drop(columns="attractor"), kept.series), data([None] * 10)):
        assert set(fates.answer(Study(other, settings)).tables["fates"]["outcome"]) == {"sustained"}
    study = Study(kept, settings)
    assert fates.QUESTION.leads(study)
    assert shares(fates.answer(study)).keys() == {*KINDS, "others"}
    undecided = fates.answer(Study(data(2 * ["undecided"] + 8 * ["rest"], 10 * [None]), settings))
    assert {alert.code: dict(alert.numbers) for alert in undecided.alerts}[Code.UNDECIDED] == {"n": 2, "of": 10}


def test_every_kind_of_attractor_has_words_and_a_look():
    assert {*get_args(Kind)} <= {*PREDICATES} == {*LOOKS}


# ---------------------------------------------------------------------------------------------- basins


def cycle(period, w, exits=1, z=0.0, multiplier=0.5):
    return {
        "attractor": "periodic", "period": period, "exits_per_period": exits, "events_per_period": 2 * exits,
        "multiplier": multiplier, "section_z": [z], "section_w": [w],
    }  # fmt: skip


SLIDES = {"attractor": "sliding"}


def started(z, w, **settled):
    return {"start_z": [z], "start_w": [w], "z0": z, "w0": w} | settled


@pytest.fixture
def basin(planted_runs, rng):
    """Random starts: those of |z| < 1 slide, those above go to a fast cycle, those below to a slow one."""
    starts = rng.uniform(-2, 2, (400, 2))
    ends = [SLIDES if abs(z) < 1 else cycle(*((3.0, 0.5) if z > 0 else (7.0, 0.9)), 2) for z, _ in starts]
    rows = [started(z, w, start_draw=k, drawn="z = uniform(-2, 2); w = uniform(-2, 2)") | end
            for k, ((z, w), end) in enumerate(zip(starts, ends, strict=True))]  # fmt: skip
    return planted_runs(rows), starts


def test_cycles_of_one_system_are_told_apart_with_their_shares(basin, settings):
    data, starts = basin
    answered = fates.answer(Study(data, settings))
    rows = answered.tables["fates"].set_index("period")
    fast, slow = (starts[:, 0] >= 1).sum(), (starts[:, 0] <= -1).sum()
    assert (rows.loc[3.0, "n_runs"], rows.loc[7.0, "n_runs"]) == (fast, slow)
    assert set(rows["cycle"].dropna()) == {1, 2}
    (share,) = (share for share in of_kind(answered, Share) if share.predicate == "end on the cycle of period 7")
    np.testing.assert_allclose([share.estimate.low, share.estimate.high], wilson(slow, 400), rtol=1e-9)
    assert (share.things, share.basis.n, share.basis.unit) == ("starts", 400, "start")


def test_a_period_that_all_starts_share_has_no_interval(planted_runs, settings):
    starts = [started(0.1 * k, 0.0, start_draw=k, drawn="z = uniform(0, 1)") for k in range(8)]
    answered = fates.answer(Study(planted_runs([start | cycle(3.5081, 0.5) for start in starts]), settings))
    (period,) = of_kind(answered, Alike)
    assert (period.value, period.among) == (3.5081, "from all 8 starts")
    other = [start | cycle(3.5081 + 0.1 * (k == 0), 0.5) for k, start in enumerate(starts)]
    assert not of_kind(fates.answer(Study(planted_runs(other), settings)), Alike)


def test_a_share_is_set_beside_the_published_one(basin, settings):
    data, starts = basin
    has = np.abs(starts[:, 0]) < 1
    low, high = wilson(has.sum(), 400)
    for value, verdict in ((has.mean(), Verdict.OPEN), (low - 0.01, Verdict.MORE), (high + 0.01, Verdict.LESS)):
        study = Study(data, replace(settings, published={"sliding": value}))
        comparison = shares(fates.answer(study))["sliding"].comparison
        assert comparison.difference.verdict is verdict
        assert comparison.difference.estimate.low == pytest.approx(low - value)
    none = shares(fates.answer(Study(data, replace(settings, published={"torus": 0.2}))))["torus"]
    assert (none.estimate.value, none.comparison.difference.verdict) == (0.0, Verdict.LESS)


def test_the_basin_has_a_mark_for_each_start_and_shares_in_its_legend(basin, settings):
    data, starts = basin
    answered = fates.answer(Study(data, settings))
    (ax,) = answered.figures["basin"].recipe().axes
    shown = {len(line.get_xdata()): line for line in ax.lines}
    z = starts[:, 0]
    assert set(shown) == {(abs(z) < 1).sum(), (z >= 1).sum(), (z <= -1).sum()}
    assert len({line.get_marker() for line in ax.lines}) == 3
    (sliding,) = [line for line in ax.lines if line.get_color() == "#0072B2"]
    assert sorted(sliding.get_xdata()) == sorted(z[abs(z) < 1])
    words = [text.get_text() for text in ax.figure.legends[0].get_texts()]
    low, high = 100 * wilson((abs(z) < 1).sum(), 400)
    assert f"steady sliding: {100 * (abs(z) < 1).mean():.1f}% ({low:.1f} to {high:.1f}%)" in words
    assert any(entry.startswith("cycle, period 7: ") for entry in words)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("displacement z at start", "velocity w at start")


def test_starts_of_a_grid_and_of_a_line_are_one_setting(planted_runs, settings):
    z, w = np.linspace(-1, 1, 5), np.linspace(0, 3, 4)
    for ws, label in ((w, "velocity w at start"), (w[:1], "")):
        rows = [started(a, b) | (SLIDES if a + b > 0.5 else cycle(3.0, 0.5)) for a in z for b in ws]
        answered = fates.answer(Study(planted_runs(rows), settings))
        assert set(answered.tables["fates"]["of"]) == {5 * len(ws)}
        assert not of_kind(answered, Regime)
        (ax,) = answered.figures["basin"].recipe().axes
        (sliding,) = [line for line in ax.lines if line.get_color() == "#0072B2"]
        assert len(sliding.get_xdata()) == (np.add.outer(ws, z) > 0.5).sum()
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("displacement z at start", label)


def test_what_varies_of_the_starts(rng):
    one, other = rng.normal(size=(2, 6))
    belt = np.full((6, 2), -0.1)
    found = plane(np.column_stack([one, other]), belt)
    assert found.names == ("displacement z of block 0", "displacement z of block 1")
    assert (found.points == np.column_stack([one, other])).all()
    assert plane(np.column_stack([one, one]), belt).names == ("displacement z of all blocks",)
    assert plane(np.column_stack([one, 0 * one]), np.column_stack([0 * one, one])).names == (
        "displacement z of block 0 and velocity w of block 1",
    )
    assert plane(rng.normal(size=(6, 3)), np.zeros((6, 3))) is None
    assert plane(np.zeros((6, 2)), belt) is None


def test_cycles_are_one_wherever_they_drift():
    def at(shift, period=2.0, events=4):
        return Cycle(events, 2, period, np.array([0.1, 0.5]) + shift, np.array([-0.2, 0.3]))

    assert alike([at(0.0, 5.0), at(0.0), at(70.0), at(0.0, events=6), at(-3.0)]) == [2, 1, 1, 3, 1]
    assert alike([]) == []


# ---------------------------------------------------------------------------------------------- along a key


@pytest.fixture
def swept(planted_runs):
    """Five starts at each of twelve belts: a cycle of one exit, then of two, none decided at 8, then steady sliding.

    The multiplier of the first comes to one at v = 4.5, by a line.
    """

    def at(v, k):
        if v <= 4:
            return cycle(3.0, 0.1, 1, multiplier=0.1 + v / 5) | {"exits_z": [0.5]}
        if v <= 7:
            return cycle(6.0, 0.1, 2) | {"exits_z": [0.5 + v / 10, 0.5 - v / 10]}
        if v == 8:
            return {"attractor": "undecided", "attractor_reason": f"few events, at {v}; lengthen the run"}
        return SLIDES

    return planted_runs([
        started(0.1 * k, 0.0, start_draw=k, drawn="z = uniform(0, 1)", belt_speed=float(v)) | at(v, k)
        for v in range(1, 13) for k in range(5)
    ])  # fmt: skip


def test_where_along_a_key_attractors_change(swept, settings):
    answered = fates.answer(Study(swept, settings))
    assert said(answered) == [
        "At belt_speed = 1 to 7, all 35 starts (lower bound 57% at each) end on a limit cycle.",
        "At belt_speed = 9 to 12, all 20 starts (lower bound 57% at each) end in steady sliding.",
        "At belt_speed = 1 to 4, all 20 starts (lower bound 57% at each) end on a limit cycle of 1 exit per period.",
    ]
    regimes = of_kind(answered, Regime)
    assert (
        sentence(regimes[3])
        == "At belt_speed = 5 to 7, all 15 starts (lower bound 57% at each) end on a limit cycle of 2 exits per"
        " period."
    )
    for regime in regimes:
        assert regime.share.low == pytest.approx(wilson(5, 5)[0])  # of five starts
    table = answered.tables["fates"].set_index(["setting", "outcome"])
    multipliers = table.xs("periodic", level="outcome")["multiplier"].astype(float)
    np.testing.assert_allclose(multipliers, [0.3, 0.5, 0.7, 0.9, 0.5, 0.5, 0.5])


def test_the_figures_along_a_key(swept, settings):
    figures = fates.answer(Study(swept, settings)).figures
    (ax,) = figures["fates"].recipe().axes
    assert [bar.get_width() for bar in ax.containers[0]] == [0.0] * 8 + [1.0] * 4  # sliding
    above, middle, below = figures["bifurcation"].recipe().axes
    (line,) = above.lines
    expected = [(v, 0.5) for v in range(1, 5)] + [(v, 0.5 + s * v / 10) for v in range(5, 8) for s in (1, -1)]
    np.testing.assert_allclose(sorted(zip(*line.get_data(), strict=True)), sorted(expected))  # five runs, one dot
    np.testing.assert_allclose(middle.lines[0].get_ydata(), [0.3, 0.5, 0.7, 0.9, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(below.lines[0].get_ydata(), [3.0] * 4 + [6.0] * 3)
    assert "Left out: 25 runs" in figures["bifurcation"].caption
    assert [*figures][:2] == ["fates", "bifurcation"]


def test_stretches_bridge_what_is_not_known_only_between_alikes():
    a, b = Outcome("sliding"), Outcome("periodic")
    outcomes = [(), (a,), (), (a,), (), (b,), (a, b)]
    assert stretches(outcomes) == [slice(1, 4), slice(5, 6), slice(6, 7)]


# ---------------------------------------------------------------------------------------------- over two keys


@pytest.fixture
def over_two(planted_runs):
    """Five starts at each of 5 belts and 3 static frictions: a cycle up to v = 1, 2, 3, then steady sliding."""

    def at(v, k):
        return cycle(3.0, 0.1, 1) | {"exits_z": [0.5]} if v <= k + 1 else SLIDES | {"section_z": [0.0]}

    return planted_runs([
        started(0.1 * s, 0.0, start_draw=s, drawn="z = uniform(0, 1)", belt_speed=float(v), static=1.2 + 0.2 * k)
        | at(v, k) for v in range(1, 6) for k in range(3) for s in range(5)
    ])  # fmt: skip


def test_each_value_of_a_second_key_has_its_regimes_and_the_ends_lead(over_two, settings):
    answered = fates.answer(Study(over_two, settings))
    assert said(answered) == [
        "At belt_speed = 1, static = 1.2, all 5 starts (lower bound 57%) end on a limit cycle.",
        "At belt_speed = 2 to 5, static = 1.2, all 20 starts (lower bound 57% at each) end in steady sliding.",
        "At belt_speed = 1 to 3, static = 1.6, all 15 starts (lower bound 57% at each) end on a limit cycle.",
    ]
    regimes = of_kind(answered, Regime)
    assert [dict(regime.where.parts)["static"] for regime in regimes] == ["1.2", "1.2", "1.6", "1.6", "1.4", "1.4"]


def test_the_figures_over_two_keys(over_two, settings):
    figures = fates.answer(Study(over_two, settings)).figures
    (ax,) = figures["fates"].recipe().axes
    cells = np.ma.filled(ax.collections[0].get_array(), -1).reshape(3, 5)
    assert [len(set(row[: k + 1])) for k, row in enumerate(cells)] == [1, 1, 1]
    assert [(row[k + 1 :] != row[0]).all() for k, row in enumerate(cells)] == [True] * 3
    above, *_ = figures["bifurcation"].recipe().axes
    drawn = {tuple(line.get_xdata()) for line in above.lines}
    assert drawn == {(1.0,), (2.0, 3.0, 4.0, 5.0)}  # exits of the cycle, and the slides


def test_what_is_certain_to_slide_for_ever_has_collapsed(over_two, settings):
    quiet = {name: (np.array([0.0, 1.0]), np.array([1, 0])) for name in over_two.members["member_id"]}
    study = Study(replace(over_two, series=quiet), settings)
    kinds = study.data.members.set_index("member_id")["attractor"]
    assert set(zip(kinds, study.motion.fates, strict=True)) == {("sliding", "collapsed"), ("periodic", "quiet")}


def test_values_that_differ_in_their_seventh_digit_are_told_apart(planted_runs, settings):
    belts = (3.210571, 3.210572, 3.210573)
    data = planted_runs([
        started(0.1 * s, 0.0, start_draw=s, drawn="z = uniform(0, 1)", belt_speed=v)
        | (SLIDES | {"section_z": [0.0]} if v == belts[-1] else cycle(3.0, 0.1, 1) | {"exits_z": [0.5]})
        for v in belts for s in range(5)
    ])  # fmt: skip
    answered = fates.answer(Study(data, settings))
    assert said(answered) == [
        "At belt_speed = 3.210571 and 3.210572, all 10 starts (lower bound 57% at each) end on a limit cycle.",
        "At belt_speed = 3.210573, all 5 starts (lower bound 57%) end in steady sliding.",
    ]
    assert answered.tables["fates"]["of"].tolist() == [5, 5, 5]


def test_runs_that_are_undecided_are_not_among_all(planted_runs, settings):
    data = planted_runs([
        started(0.1 * s, 0.0, start_draw=s, drawn="z = uniform(0, 1)", belt_speed=float(v))
        | (cycle(3.0, 0.1, 1) | {"exits_z": [0.5]} if s < 2 else dict(attractor="undecided", attractor_reason="few"))
        for v in (1, 2) for s in range(5)
    ])  # fmt: skip
    answered = fates.answer(Study(data, settings))
    assert said(answered) == ["40% (12 to 100%) of starts end on a limit cycle."]


# ---------------------------------------------------------------------------------------------- what attracts where


def along_belts(planted_runs, columns, matrices=1):
    """Steady sliding is stable from v = 2.5 on; of four starts at v = 4 three end in cycles, which last to 4.1."""

    def at(v, s):
        rate = {"critical_rate": 0.1 * (2.5 - v), "critical_frequency": 2.0, "critical_shape": [1.0]}
        ends = dict.fromkeys(ENDS[2:]) | ({"stability_changes": 2.5} if v == 2 else {})
        if v <= 4 and (s or v < 4):
            ends |= {"motion_ends_above": 4.2 - 0.1 * s} if v == 4 else {}
            return cycle(3.0, 0.1, 1) | {"exits_z": [0.5]} | rate | ends
        return SLIDES | {"section_z": [0.0]} | rate | ends

    rows = [
        started(0.1 * s, 0.0, start_draw=s, drawn="z = uniform(0, 1)", belt_speed=float(v)) | at(v, s)
        | {"matrix": s % matrices} for v in range(1, 7) for s in range(4)
    ]  # fmt: skip
    kept = {name for row in rows for name in row} - ({*ENDS} - {*columns})
    return planted_runs([{name: value for name, value in row.items() if name in kept} for row in rows])


@pytest.mark.parametrize(
    ("columns", "sentence"),
    [
        (
            ENDS,
            "both attract at belt_speed = 2.5 to 4.1. The lower end is known from linear stability, the upper from"
            " runs to t = 1000.",
        ),
        (ENDS[:2], "both attract at belt_speed = 3 to 4."),
    ],
)
def test_where_steady_sliding_and_stick_slip_both_attract_leads(planted_runs, settings, columns, sentence):
    """Also where no start ends in steady sliding, as at v = 3."""
    answered = fates.answer(Study(along_belts(planted_runs, columns), settings))
    assert said(answered)[0] == f"Steady sliding and stick-slip {sentence}"
    stability = answered.tables["stability"]
    assert stability["n_stable"].tolist() == [0, 0, 1, 1, 1, 1]
    assert stability["frequency"].tolist() == [2.0] * 6
    assert stability["blocks"].tolist() == ["0"] * 6
    ends = answered.tables["boundaries"]
    is_refined = len(columns) > 2
    assert ends["found_by"].tolist() == ["linear stability", "runs to t = 1000"] * is_refined
    assert ends["value"].tolist() == pytest.approx([2.5, 4.1] * is_refined)


def test_stick_slip_that_is_followed_to_a_value_attracts_there_though_no_start_finds_it(planted_runs, settings):
    """At v = 3 all starts slide; the cycle of v = 2 lasts up to there, and that of v = 4 down to there, to 4.5."""
    rows = []
    for v in (2, 3, 4, 5):
        ends = {"stability_changes": None, "motion_ends_below": None, "motion_ends_above": 4.5 if v == 4 else None}
        fate = cycle(3.0, 0.1, 1) | {"exits_z": [0.5]} if v in (2, 4) else SLIDES | {"section_z": [0.0]}
        rows += [started(0.1 * s, 0.0, start_draw=s, drawn="z", belt_speed=float(v)) | fate | ends for s in range(4)]
    answered = fates.answer(Study(planted_runs(rows), settings))
    each = {finding.attractors: finding for finding in of_kind(answered, Attracting)}
    stretch = each["stick-slip",]
    assert (stretch.low, stretch.high, stretch.high_by) == ("2", "4.5", Bound.RUNS)
    assert [level.estimate.value for level in stretch.ends] == [4.5]
    cut = [row | ({"motion_ends_above": None} if row["belt_speed"] == 4.0 else {}) for row in rows]
    answered = fates.answer(Study(planted_runs([*cut, *(row | {"belt_speed": 6.0} for row in rows[-4:])]), settings))
    each = {finding.attractors: finding for finding in of_kind(answered, Attracting)}
    assert (each["stick-slip",].high, each["stick-slip",].high_by) == ("5", Bound.FOLLOWED)


def test_what_attracts_is_said_of_one_system_alone(planted_runs, settings):
    answered = fates.answer(Study(along_belts(planted_runs, ENDS, matrices=4), settings))
    assert not of_kind(answered, Attracting)
    assert answered.tables["stability"]["n_systems"].tolist() == [4] * 6


def test_without_these_records_nothing_of_it_is_said(over_two, settings):
    tables = fates.answer(Study(over_two, settings)).tables
    assert tables["stability"].empty
    assert tables["boundaries"].empty


# ---------------------------------------------------------------------------------------------- a typical run


def test_the_cycle_nearest_the_median_is_drawn_with_its_frequency(planted_runs, settings):
    """Of periods 5, 7 and 20 that of 7 is run again: a block whose spectrum peaks at one over its period."""
    block = System([[1.0]], 0.0, 1.0, -0.2, static=1.3)
    run = simulate(block, 0.0, -0.2, t_end=420.0, t_eval=np.linspace(100.0, 420.0, 4096))
    asked = []

    def again(name, since, n):
        asked.append((name, since))
        return run.events, run.samples

    data = planted_runs([cycle(period, 0.1, 1) | {"matrix": k} for k, period in enumerate((5.0, 7.0, 20.0))])
    picture = fates.answer(Study(replace(data, again=again), settings)).figures["typical_periodic"]
    assert asked == [("m1", settings.t_burn)]
    assert "run m1, whose period is nearest the median of 3 runs" in picture.caption
    plane, _, spectrum = picture.recipe().axes
    frequency, density = spectrum.lines[0].get_data()
    period = np.diff(run.events.t[run.events.is_exit])[-1]  # 7.32
    assert frequency[np.argmax(density)] == pytest.approx(1.0 / period, abs=4.0 / 320.0)
    assert plane.lines[0].get_ydata().min() == pytest.approx(-0.2, abs=1e-3)
    assert "typical_periodic" not in fates.answer(Study(data, settings)).figures
