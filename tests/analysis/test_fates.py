"""Fates and survival: textbook numbers, identities, planted hazards, and what is never called an end."""

import math
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import AnalysisSettings, Data, Study, build
from stickslip.analysis.ensemble import Recorded
from stickslip.analysis.models.fates import (
    COLLAPSED,
    DIVERGED,
    LULL,
    QUIET,
    SUSTAINED,
    UNMOVED,
    bounded_share,
    ends_at,
    fate,
    half_ended,
    kaplan_meier,
    median,
    survival,
)
from stickslip.analysis.questions.runs.fates import answer
from stickslip.analysis.report.formats import environment
from stickslip.analysis.report.page import MOST_ALERTS, _primary, _Shown
from stickslip.analysis.stats.compare import share_over_matrices, wilson
from tests.analysis import studies

pytestmark = pytest.mark.usefixtures("undrawn")

EPS = np.finfo(float).eps
SETTINGS = AnalysisSettings(t_burn=100.0, dt=(0.5,), resamples=2, confidence=0.95, seed=0)
WORDS = environment().get_template("fates.html").module


def test_survival_against_the_textbook():
    # Freireich et al. 1963, the 6-MP arm, as tabulated in Kalbfleisch and Prentice
    ended = [6, 6, 6, 7, 10, 13, 16, 22, 23]
    censored = [6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
    t, share, low, high = kaplan_meier(np.array(ended + censored, dtype=float), np.arange(21) < 9, 0.95)
    assert t.tolist() == [0, 6, 7, 10, 13, 16, 22, 23]
    assert share == pytest.approx([1, 0.857, 0.807, 0.753, 0.690, 0.627, 0.538, 0.448], abs=5e-4)
    # Greenwood's error of S(23) is 0.135 (ibid.); on the log-log scale 0.188 to 0.680
    assert (low[-1], high[-1]) == pytest.approx((0.188, 0.680), abs=1e-3)
    half = median(np.array(ended + censored, dtype=float), np.arange(21) < 9, 0.95)
    # of 21 tosses at most 5 are heads with 0.013, at most 6 with 0.039: the sixth smallest, 9, on
    assert (half.value, half.low, half.high) == (23, 9, None)


def test_runs_of_one_unit_count_together_in_the_interval_of_survival(rng):
    """At each time it is that of a share of runs, counted by unit; ends of several runs may be at one time.

    Of what a unit moves the share by, the fourth powers (left - share n)^4 are sums of terms that come to 16 n^4 at
    most and are rounded three times each; ends of the interval change by less, relative to them. So rounding is below
    48 eps times how far they cancel: by nearly 10^5 where the first run ends.
    """
    units = np.sort(rng.integers(0, 12, 60))
    ended = rng.random(60) < 0.7
    times = np.where(ended, np.round(rng.exponential(5.0, 60) + np.repeat(rng.exponential(5.0, 12), 5), 0), 99.0)
    t, share, low, high = kaplan_meier(times, ended, 0.95, units)
    n_of = np.bincount(units)
    for k in range(len(t)):
        left = np.bincount(units, ~(ended & (times <= t[k])))
        counts = np.column_stack([left, n_of])[n_of > 0]
        moved = counts @ [1.0, -left.sum() / 60]
        cancelling = np.sum(counts[:, 1] ** 4) / np.sum(moved**4) if 0 < left.sum() < 60 else 1.0
        expected = share_over_matrices(counts, 0.95)[:3]
        assert (share[k], low[k], high[k]) == pytest.approx(expected, rel=0, abs=50 * EPS * max(cancelling, 100.0))


def test_survival_and_its_median_are_of_all_starts_of_a_matrix():
    """Of 4 starts in each of 6 matrices, the first ends at once; the others go on, in half of the matrices."""
    fates_of = np.repeat([[COLLAPSED] + [SUSTAINED] * 3, [COLLAPSED] * 4], 3, axis=0).ravel()
    t_last = np.where(np.arange(24) % 4 == 0, 10.0, 50.0)
    units, t_end = np.repeat(np.arange(6), 4), np.full(24, 1000.0)
    t, share, _, _ = survival(fates_of, t_last, t_end, t_end, 0.95, units)
    assert t.tolist() == [0.0, 10.0, 50.0]
    assert share == pytest.approx([1.0, 18 / 24, 9 / 24])
    half = half_ended(fates_of, t_last, t_end, t_end, 0.95, units)
    assert half.value == 50.0
    assert (half.low, half.high) == (50.0, None)


def test_one_unit_is_one_trial_and_an_end_holds_until_the_last_time_that_allows_it():
    fates_of, t = np.full(40, COLLAPSED, dtype=object), np.arange(1.0, 41.0)
    _, share, low, high = survival(fates_of, t, t, np.full(40, 99.0), 0.95, np.zeros(40, int))
    k = int(np.argmin(np.abs(share - 0.5)))
    assert (low[k], high[k]) == pytest.approx(wilson(0.5, 1.0, 0.95))
    # 60 of each of two units end at 1, so that both agree, then 40 of one at 2: half may yet last
    t_last = np.concatenate([np.ones(60), np.full(40, 2.0), np.ones(60), np.full(40, 50.0)])
    how = np.where(t_last < 50.0, COLLAPSED, SUSTAINED)
    half = half_ended(how, t_last, np.full(200, 50.0), np.full(200, 50.0), 0.95, np.repeat([0, 1], 100))
    assert (half.value, half.high) == (1.0, None)


def covered(n, confidence):
    """Chance that a median lies between the k-th smallest and the k-th largest of n times, by counting tosses.

    Also that for k + 1, and k; times are 1 to n.
    """
    found = median(np.arange(1.0, n + 1), np.full(n, True), confidence)
    k = int(found.low or 0)
    assert found.high == (n + 1 - k if k else None)
    return *(1 - 2 * sum(math.comb(n, j) for j in range(m)) / 2**n for m in (k, k + 1)), k


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.95, 0.99])
def test_the_interval_of_a_median_is_the_narrowest_of_order_statistics_with_the_confidence(confidence):
    for n in range(1, 60):
        least, narrower, _ = covered(n, confidence)
        assert least >= confidence > narrower


def test_few_times_have_no_interval_of_their_median():
    """All of five lie on one side with 2 / 32, of six with 2 / 64."""
    assert [covered(n, 0.95)[2] for n in range(1, 10)] == [0, 0, 0, 0, 0, 1, 1, 1, 2]


def test_half_of_an_even_number_is_the_lower_middle_time():
    """For six, the product 5/6 4/5 3/4 is not one half to the last digit."""
    assert [median(np.arange(1.0, n + 1), np.full(n, True), 0.95).value for n in range(1, 40)] == [
        (n + 1) // 2 for n in range(1, 40)
    ]
    assert median(np.zeros(0), np.zeros(0, dtype=bool), 0.95).value is None


@pytest.mark.parametrize("n", [3, 4, 5, 6, 7, 8])
def test_the_interval_of_a_median_covers_it_with_few_runs(rng, n):
    """Times end at an increasing hazard, and most runs are followed for 1.2 medians only; an open end is no miss."""
    draws, missed = 2000, np.zeros(2)
    for t in rng.weibull(1.7, (draws, n)) / np.log(2) ** (1 / 1.7):
        t_end = np.where(rng.random(n) < 0.6, 1.2, 9.0)
        found = median(np.minimum(t, t_end), t <= t_end, 0.95)
        missed += (found.low or 0.0) > 1.0, (found.high or np.inf) < 1.0
    # each side of 2.5% at most, and five errors of that share
    assert (missed / draws < 0.025 + 5 * np.sqrt(0.025 * 0.975 / draws)).all()


@pytest.mark.parametrize("has_ended", [False, True])
def test_none_or_all_ended_have_an_interval(has_ended):
    _, share, low, high = kaplan_meier(np.full(20, 5.0), np.full(20, has_ended), 0.95)
    assert share[-1] == 1.0 - has_ended
    assert high[-1] - low[-1] == pytest.approx(0.161, abs=1e-3)  # Wilson's of 0 in 20


def test_ends_at_zero_count_once():
    """Of ten runs three never stick at all, and one ends at 5."""
    times, ended = np.array([0.0] * 3 + [5.0] + [9.0] * 6), np.arange(10) < 4
    t, share, low, high = kaplan_meier(times, ended, 0.95)
    assert t.tolist() == [0, 5]
    assert share == pytest.approx([0.7, 0.6])
    assert (low < share).all()
    assert (share < high).all()
    assert median(times, ended, 0.95).value is None
    assert median(times, np.arange(10) < 3, 0.95).value is None
    assert median(np.append(np.zeros(6), times[3:7]), np.arange(10) < 7, 0.95).value == 0.0


def test_fates_by_their_last_change_and_the_growth_rate():
    slipping, sticking = (np.array([0.0, 700.0]), np.array([3, 0])), (np.array([0.0, 700.0]), np.array([3, 1]))
    assert [fate("finished", slipping, 1000.0, rate) for rate in (1e-4, -1e-4, 0.0, 1e-12, np.nan, None)] == [
        LULL, QUIET, QUIET, QUIET, QUIET, QUIET,
    ]  # fmt: skip
    assert fate("finished", slipping, 900.0) == SUSTAINED  # for less than a quarter
    assert fate("finished", sticking, 1000.0) == SUSTAINED
    assert fate("collapsed", slipping, 1000.0) == COLLAPSED
    assert fate("diverged", slipping, 1000.0) == DIVERGED
    assert fate("failed", None, 1000.0) == "failed"


def test_only_what_is_certain_is_an_end():
    hows = np.array([COLLAPSED, DIVERGED, LULL, QUIET, SUSTAINED])
    t_stop = np.array([230.0, 230.0, 1000.0, 1000.0, 1000.0])  # certified 80 units after its last event
    times, ended = ends_at(hows, np.full(5, 150.0), t_stop, np.full(5, 1000.0))
    assert times.tolist() == [150.0, 230.0, 1000.0, 1000.0, 1000.0]
    assert ended.tolist() == [True, True, False, False, False]


def test_what_cannot_be_told_widens_the_interval_of_a_share():
    """Wilson's of 5 in 20 begins at 0.112, that of 9 in 20 ends at 0.658."""
    found = bounded_share(np.array([[1, 0, 1]] * 5 + [[0, 1, 1]] * 4 + [[0, 0, 1]] * 11), 0.95)
    assert (found.value, found.low, found.high) == pytest.approx((0.25, 0.112, 0.658), abs=1e-3)


def test_the_interval_of_survival_covers_a_planted_hazard(rng):
    """Watched to t = 2,000, lulls censored there; `studies` has the whole study."""
    rows = list(studies.survival_study(rng, 150))
    assert not [row for row in rows if not row.is_covered() or not row.is_unbiased()]


def test_the_interval_of_survival_covers_it_where_certificates_come_late(rng):
    """By 1,000 units on average: many that ended are quiet at t_end; censored, their curve would be 0.1 too high."""
    rows = list(studies.survival_study(rng, 150, delay=1000.0))
    assert not [row for row in rows if not row.is_covered(high=1.0)]
    assert not [row for row in rows if not row.is_unbiased()]


def data_of(planted, outcomes, n=200):
    rows, series = [], {}
    for matrix, outcome in enumerate(outcomes):
        stop = {DIVERGED: 400.0, "failed": None}.get(outcome, 1000.0)
        real = "finished" if outcome in (LULL, QUIET, SUSTAINED) else outcome
        rate = -0.01 if outcome in (COLLAPSED, QUIET) else 0.01
        rows.append(planted.member(f"{n}-{matrix}", matrix, n=n, outcome=real, t_stop=stop, growth_rate=rate))
        last = {SUSTAINED: 990.0, DIVERGED: 390.0}.get(outcome, 50.0 + matrix)
        series[f"{n}-{matrix}"] = np.array([0.0, last]), np.array([3, 0])
    return Data(pd.DataFrame(rows), series)


def asked(data):
    return answer(Study(data, SETTINGS))


def test_fates_are_kept_apart(planted):
    plan = [COLLAPSED] * 4 + [QUIET] * 2 + [DIVERGED] * 3 + [SUSTAINED] * 9 + [LULL] * 2 + ["failed"]
    found = asked(data_of(planted, plan))
    row = found.tables["fates"].iloc[0]
    assert [row[f"n_{end}"] for end in (COLLAPSED, QUIET, DIVERGED, SUSTAINED, LULL)] == [4, 2, 3, 9, 2]
    assert (row["n_moving"], row["n_runs"], row["n_failed"]) == (11, 20, 1)
    assert row["moving"] == pytest.approx(11 / 20)
    said = WORDS.answer(found.facts)
    # Wilson's of 11 in 20 begins at 0.342, that of 13 in 20 ends at 0.819
    assert "11 of 20 runs at n = 200 are in motion at t = 1000 (34% to 82%); " in said
    assert "4 slip for good, 3 ran away and 2 are quiet" in said
    alerts = WORDS.alerts(found.facts)
    assert "1 of 21 runs failed" in alerts
    assert "2 of 11 runs in motion are in a lull: no block has stuck for the last quarter" in alerts
    assert (
        "2 of 20 runs are quiet: a certificate is still missing at t = 1000; no block has stuck since t = 55"
        in alerts
    )
    assert (
        "cannot be told, as slipping all together is stable, but not certified to last. They are in no mean" in alerts
    )
    assert "are of the runs that are in motion at t = 1000: 11 of 20 at n = 200." in alerts
    assert 'class="ok"' not in alerts


def test_survival_counts_certified_ends_and_run_away_alone(planted):
    found = asked(data_of(planted, [COLLAPSED] * 4 + [SUSTAINED] * 5 + [DIVERGED] * 3 + [LULL] * 8))
    curve = found.tables["survival_curves"]
    assert curve["t"].tolist() == [0, 50, 51, 52, 53, 400]  # last events, and when three left every bound
    assert curve["survival"].tolist() == pytest.approx([1, 0.95, 0.9, 0.85, 0.8, 0.65])
    assert found.tables["runs"].groupby("fate")["t"].max().to_dict() == {
        COLLAPSED: 53, DIVERGED: 400, LULL: 1000, SUSTAINED: 1000,
    }  # fmt: skip


def test_survival_takes_quiet_runs_either_way(planted):
    """Four of ten ended by t = 53; five more did by t = 58, or not at all."""
    curve = asked(data_of(planted, [COLLAPSED] * 4 + [QUIET] * 5 + [SUSTAINED])).tables["survival_curves"]
    least, most = (kaplan_meier(np.arange(50.0, 60.0), np.arange(10) < n_ended, 0.95) for n_ended in (9, 4))
    last = curve.iloc[-1]
    assert (last["t"], last["survival"], last["low"], last["high"]) == (
        58,
        pytest.approx(0.1),
        least[2][-1],
        most[3][-1],
    )


def test_a_certificate_that_is_late_is_no_other_fate(planted):
    """Two laws whose runs all slip from the same events on; under one of them few are certified in time."""
    data, other = data_of(planted, [COLLAPSED] * 20), data_of(planted, [COLLAPSED] * 9 + [QUIET] * 11)
    late = other.members.assign(member_id="s" + other.members["member_id"], **planted.sigmoid)
    series = dict(data.series) | {f"s{name}": points for name, points in other.series.items()}
    found = asked(Data(pd.concat([data.members, late]), series))
    said = WORDS.answer(found.facts)
    assert "At t = 1000 no block sticks in any of the 40 runs." in said
    half = "59.0 (55.0 to 64.0) under the exact law, 59.0 (55.0 or later) under the sigmoid"
    assert f"had their last event by t = {half}." in said
    assert "slip for good" not in said
    rows = found.tables["fates"].set_index("engine")
    assert rows["median"].tolist() == [59.0, 59.0]
    assert pd.isna(rows.loc["sigmoid", "median_most"]), "not half are certified"
    part = WORDS.part(found.facts, lambda *_: "")
    assert "quiet runs count as ended at their last events" in part
    assert "Ran away" not in part
    assert "11 under the sigmoid" in WORDS.alerts(found.facts)
    assert [row["engine"] for row in found.facts["rated"]] == ["coulomb"], "the rate is that of constant friction"


def test_last_events_are_compared_system_by_system(planted, rng):
    """Under the sigmoid each comes 3 later, but for scatter; few have a certificate there, and one goes on."""
    data = data_of(planted, [COLLAPSED] * 40)
    other = data_of(planted, [COLLAPSED] * 10 + [QUIET] * 29 + [SUSTAINED])
    late = other.members.assign(member_id="s" + other.members["member_id"], **planted.sigmoid)
    shifts = 3.0 + rng.uniform(-1.0, 1.0, 40)
    series = dict(data.series)
    for (name, (t, n_stick)), shift in zip(other.series.items(), shifts, strict=True):
        series[f"s{name}"] = t + np.array([0.0, shift]), n_stick
    (row,) = asked(Data(pd.concat([data.members, late]), series)).tables["last_events"].to_dict("records")
    assert (row["n_systems"], row["n_open"]) == (39, 1)
    assert row["shift"] == pytest.approx(np.median(shifts[:39]))
    in_order = np.sort(shifts[:39])
    assert (row["shift_low"], row["shift_high"]) == pytest.approx(
        (in_order[12], in_order[26])
    )  # 13th of 39 by tosses


def test_a_run_that_has_not_moved_is_not_in_motion(planted):
    """Of 20 blocks that all stick from the start on; one that has slipped, and sticks again, may be loaded."""
    data = data_of(planted, [SUSTAINED] * 20)
    series = {
        name: (np.array([0.0]), np.array([200])) if k < 15 else (np.array([0.0, 30.0]), np.array([199, 200]))
        for k, name in enumerate(data.series)
    }
    found = asked(Data(data.members, series))
    row = found.tables["fates"].iloc[0]
    assert (row["n_unmoved"], row["n_moving"], row["n_held"]) == (15, 5, 5)
    assert row["moving"] == pytest.approx(0.25)
    assert row["moving_high"] < 0.5
    assert "15 have not moved" in WORDS.answer(found.facts)
    none = asked(Data(data.members, dict.fromkeys(series, (np.array([0.0]), np.array([200])))))
    assert "No block of 20 runs has moved by t = 1000" in WORDS.answer(none.facts)
    assert fate("finished", series["200-0"], 1000.0, n=200) == UNMOVED
    assert fate("finished", series["200-0"], 1000.0, n=201) == SUSTAINED


def test_half_that_may_have_ended_is_not_said_to_be_fewer(planted):
    """Where all are quiet, half may well have ended: only certificates are missing."""
    for plan, words in (
        ([QUIET] * 4, "51.0 (no interval)"),
        ([COLLAPSED] * 2 + [DIVERGED] + [QUIET] * 4, "54.0 (50.0 or later)"),
        ([COLLAPSED] + [QUIET] + [SUSTAINED] * 4, "not reached: 1 certified, 1 quiet"),
        ([COLLAPSED] + [SUSTAINED] * 4, "not reached<"),
    ):
        main = WORDS.main(asked(data_of(planted, plan)).facts)
        assert f">{words}" in main
        assert "fewer than half" not in main


def test_without_a_growth_rate_a_lull_cannot_be_told(planted):
    """Nor where friction hangs on the speed of slip, of which the rate says nothing."""
    data = data_of(planted, [LULL] * 5 + [SUSTAINED] * 5)
    constant = "as where friction depends on the speed of slip, blocks may move on without a stick"
    for changes, why in (
        ({"growth_rate": None}, "as no growth rate of the all-slip state is recorded"),
        ({"weakening_speed": 0.5}, constant),
        (planted.sigmoid, constant),
    ):
        found = asked(Data(data.members.assign(**changes), data.series))
        assert found.tables["fates"][["n_quiet", "n_lull"]].iloc[0].tolist() == [5, 0]
        assert f"cannot be told, {why}" in WORDS.alerts(found.facts)


def test_what_all_runs_do_has_a_bound(planted):
    """Wilson's interval of 20 in 20 begins at 0.839."""
    found = asked(data_of(planted, [SUSTAINED] * 20))
    said = "came to slip for good or ran away by t = 1000 (95%: at most 16% of such systems)"
    assert f"Not one of 20 systems {said}." in WORDS.answer(found.facts)
    assert '<li class="ok">All 20 runs reached t = 1000' in WORDS.alerts(found.facts)
    none = asked(data_of(planted, [DIVERGED] * 20))
    assert "No run of 20 sticks and slips at t = 1000 (at most 16% of such systems do)" in WORDS.answer(none.facts)
    failed = asked(data_of(planted, ["failed"] * 2))
    assert "all 2 runs failed" in WORDS.answer(failed.facts)


@pytest.mark.parametrize("n_held", [20, 5, 1])
def test_runs_whose_blocks_all_stick_are_not_said_to_move(planted, n_held):
    """On a belt at rest they are at rest; nothing but n_stick tells them."""
    data = data_of(planted, [SUSTAINED] * 20)
    held = {f"200-{k}": (np.array([0.0, 740.0]), np.array([3, 200])) for k in range(n_held)}
    late = {
        f"200-{k}": (np.array([0.0, 760.0]), np.array([3, 200])) for k in range(n_held, 20)
    }  # for too short a time
    found = asked(replace(data, series=dict(data.series) | held | late))
    assert found.tables["fates"]["n_held"].tolist() == [n_held]
    said, alerts = WORDS.answer(found.facts), WORDS.alerts(found.facts)
    assert ("Not one of 20 systems" in said) == (n_held < 20)
    assert ("In all 20 runs every block has stuck to its belt for the last quarter" in said) == (n_held == 20)
    assert f"{n_held} of 20 runs that count as in motion {'is' if n_held == 1 else 'are'} held" in alerts
    assert "held" not in WORDS.alerts(asked(data_of(planted, [SUSTAINED] * 20)).facts)


def test_two_engines_on_one_matrix_are_one_system(planted):
    data = data_of(planted, [SUSTAINED] * 20)
    twice = data.members.assign(member_id="s" + data.members["member_id"], **planted.sigmoid)
    series = dict(data.series) | {f"s{name}": points for name, points in data.series.items()}
    found = asked(Data(pd.concat([data.members, twice]), series))
    assert found.facts["total"]["runs"] == 40
    assert found.facts["share"].low == pytest.approx(0.839, abs=1e-3)


@pytest.mark.parametrize("kinds", [[SUSTAINED] * 5, [COLLAPSED] * 5, [COLLAPSED] * 3 + [SUSTAINED] * 2])
@pytest.mark.parametrize("unit", ["matrix", "start"])
def test_intervals_are_called_by_their_level(planted, kinds, unit):
    study = Study(data_of(planted, kinds), replace(SETTINGS, confidence=0.999))
    words = environment()
    words.globals["unit"] = unit
    template, facts = words.get_template("fates.html").module, answer(study).facts
    said = template.answer(facts) + template.main(facts)
    assert "99.9%" in said
    assert "95%" not in said


def test_points_of_a_sweep_share_their_matrices(planted):
    data = data_of(planted, [SUSTAINED] * 20)
    other = data.members.assign(member_id="s" + data.members["member_id"], belt_speed=-0.4)
    series = dict(data.series) | {f"s{name}": points for name, points in data.series.items()}
    found = asked(Data(pd.concat([data.members, other]), series))
    said = WORDS.answer(found.facts)
    assert "Not one of 40 runs of 20 systems came to slip for good" in said
    assert "(95%: at most 16% of such systems)" in said


def test_the_fates_of_two_laws_are_not_added_up(planted):
    data = data_of(planted, [SUSTAINED] * 12)
    other = data_of(planted, [SUSTAINED] * 4 + [DIVERGED] * 8)
    away = other.members.assign(member_id="s" + other.members["member_id"], **planted.sigmoid)
    series = dict(data.series) | {f"s{name}": points for name, points in other.series.items()}
    found = asked(Data(pd.concat([data.members, away]), series))
    counts = {row["system"].split(", ")[1]: (row["n_moving"], row["n_diverged"]) for row in found.facts["systems"]}
    assert counts == {"exact": (12, 0), "sigmoid": (4, 8)}
    said = WORDS.answer(found.facts)
    assert (
        "12 of 12 runs at n = 200, exact are in motion at t = 1000 (76% to 100%); 4 of 12 at n = 200, sigmoid" in said
    )
    assert "16" not in said
    assert "8 ran away" not in said


@pytest.mark.parametrize(("rate", "how"), [(1e-4, LULL), (-1e-4, QUIET)])
def test_a_lull_is_part_of_the_mean_and_a_quiet_run_is_not(planted, rng, rate, how):
    """Half of the runs stop sticking at t = 300; their window begins at t = 100."""
    rows, series = [], {}
    for matrix in range(16):
        t, n_stick = planted.runs(rng, 4000, 0.69)
        n_stick = n_stick - n_stick.min() + 20
        if matrix % 2:
            t, n_stick = np.append(t[t < 300.0], 300.0), np.append(n_stick[t < 300.0], 0)
        rows.append(planted.member(f"m{matrix}", matrix, growth_rate=rate))
        series[f"m{matrix}"] = t, n_stick
    every, alone, still = (
        Study(Data(pd.DataFrame(some), series), SETTINGS).groups[0] for some in (rows, rows[::2], rows[1::2])
    )
    assert every.fates.tolist() == [SUSTAINED, how] * 8
    n_moving = 16 if how == LULL else 8
    assert (len(every.finished), len(every.moving), every.n_quiet) == (16, n_moving, 16 - n_moving)
    if how == QUIET:
        assert every.mean(0.95) == alone.mean(0.95)
        assert (every.units == alone.units).all()
        assert (every.sums("gamma").rows == alone.sums("gamma").rows).all()
    else:
        assert every.mean(0.95).value == pytest.approx((alone.mean(0.95).value + still.mean(0.95).value) / 2)


def test_sizes_are_set_side_by_side_with_the_linear_growth_rate(planted):
    plan = {20: [COLLAPSED] * 3 + [QUIET] * 2, 100: [SUSTAINED] * 5, 250: [DIVERGED] * 4 + [SUSTAINED]}
    parts = [data_of(planted, outcomes, n) for n, outcomes in plan.items()]
    members = pd.concat([part.members for part in parts], ignore_index=True)
    found = asked(Data(members, {name: points for part in parts for name, points in part.series.items()}))
    said = WORDS.answer(found.facts)
    assert "every run at n = 100 still sticks and slips (5 of 5, 95% interval 57% to 100%). At n = 20, 3 of 5" in said
    assert "3 of 5 slip for good and 2 of 5 are quiet; at n = 250, 4 of 5 have run away by t = 1000." in said
    noted = WORDS.main(found.facts)
    assert "3 of 5 runs with a stable all-slip state were certified to slip for good; a certificate needs" in noted
    assert "so the 10 others could not be." in noted
    assert "n = 100 lie" not in WORDS.survival_caption(found.facts), "one group is one line"
    assert [(row["state"], row["n_runs"], row["n_collapsed"]) for row in found.facts["linear"]] == [
        ("stable", 5, 3),
        ("unstable", 10, 0),
    ]
    assert found.tables["runs"]["fate"].tolist()[:5] == [COLLAPSED] * 3 + [QUIET] * 2
    for recipe in found.figures.values():
        assert recipe().axes


def test_a_drift_is_an_alert_even_of_few_cascades(planted):
    t = np.arange(0.0, 1000.0)
    rising = {f"200-{k}": (t, np.arange(1000) // 10 + k) for k in range(5)}
    data = data_of(planted, [SUSTAINED] * 5)
    alerts = WORDS.alerts(asked(Data(data.members, rising)).facts)
    assert "drifts after t = 100, by +45" in alerts
    assert "without drift" not in alerts


def test_fates_lead_a_report_whose_runs_mostly_ended(planted):
    shown = [_Shown("fates", {}), _Shown("robustness", {})]
    for outcomes, leads in (
        ([COLLAPSED] * 6 + [SUSTAINED] * 4, "fates"),
        ([COLLAPSED] * 4 + [SUSTAINED] * 6, "robustness"),
    ):
        assert _primary(Study(data_of(planted, outcomes), SETTINGS), shown)[0] == leads


@pytest.mark.drawn
def test_a_page_has_few_alerts_and_what_is_well_comes_last(planted):
    outcomes = ["failed"] + [COLLAPSED] + [SUSTAINED] * 2
    report = build(data_of(planted, outcomes), SETTINGS, "A study", "", {})
    (alerts,) = re.findall(r'<ul class="alerts".*?</ul>', report.html, re.DOTALL)
    assert 1 <= alerts.count("<li") <= MOST_ALERTS
    assert "1 of 4 runs failed" in alerts


def starts(planted, rng, n_starts, **columns):
    """Starts of one block, drawn, of which those with |z| < 1 come to slide; half of these are certified."""
    z, w = rng.uniform(-2, 2, n_starts), rng.uniform(0, 2, n_starts)
    rows, series = [], {}
    for k in range(n_starts):
        outcome = "collapsed" if abs(z[k]) < 1 and k % 2 else "finished"
        row = planted.member(f"s{k}", 0, n=1, outcome=outcome, start_draw=k, z0=z[k], w0=w[k])
        rows.append(row | {"drawn": "z = uniform(-2, 2); w = uniform(0, 2)"} | columns)
        series[f"s{k}"] = np.array([0.0, 50.0 if abs(z[k]) < 1 else 990.0]), np.array([1, 0])
    return Data(pd.DataFrame(rows), series), z, w


def test_starts_of_one_block_show_their_basin(planted, rng):
    data, z, w = starts(planted, rng, 400)
    found = asked(data)
    assert len(found.tables["fates"]) == 1, "starts that are drawn tell no groups apart"
    slides = np.abs(z) < 1
    low, high = wilson(slides.sum(), 400, 0.95)
    page = build(data, replace(SETTINGS, question=("fates",)), "Starts", "", {})
    assert page.headline[1] == (
        f"{slides.sum()} of 400 starts ({100 * slides.mean():.1f}%, {100 * low:.1f}% to {100 * high:.1f}%) "
        "came to slip for good or had no stick from t = 750 to t = 1000; the others stick and slip."
    )
    points = found.facts["basin"]["points"]
    assert sorted(map(tuple, points["no late stick"])) == sorted(zip(z[slides], w[slides], strict=True))
    assert sum(map(len, points.values())) == 400
    (ax,) = found.figures["basin"]().axes
    assert sorted(len(line.get_xdata()) for line in ax.lines) == sorted([slides.sum(), (~slides).sum()])
    assert "no late stick: none from t = 750 to t = 1000" in page.html
    assert "basin" in page.figures
    assert found.tables["fates"]["kappa_n"].isna().all(), "one block has no springs to others"
    assert "κ n" not in page.html
    assert "effective samples" not in page.html, "starts of one system share its cycle"
    assert "γ" not in re.sub(r"<details id=.made.*", "", page.html, flags=re.DOTALL), "one block has no cascades"


def test_a_grid_of_starts_shows_its_basin_too(planted, rng):
    """Swept, not drawn: each start is a group, and all are one picture; of n blocks that start alike as of one."""
    data, *_ = starts(planted, rng, 30, n=20, drawn=None, start_draw=None)
    basin = asked(data).facts["basin"]
    assert (basin["n"], basin["of"]) == (30, 30)


def test_swept_starts_are_counted_together_and_quiet_ones_on_a_cycle_are_said(planted, rng):
    """Each start is a setting of one run: what every run of one does is nothing to tell."""
    data, z, _ = starts(planted, rng, 30, drawn=None, start_draw=None)
    is_quiet = (np.abs(z) < 1) & (data.members["outcome"] == "finished").to_numpy()
    exits = {name: 0.0 if quiet else 1.0 for name, quiet in zip(data.members["member_id"], is_quiet, strict=True)}
    own = {"exits_per_period": Recorded("exits in a period", exits)}
    facts = asked(Data(data.members, data.series, recorded=own)).facts
    assert facts["n_on_cycle"] == is_quiet.sum()
    words = environment().get_template("fates.html").module
    said = re.sub(r"\s+", " ", str(words.answer(facts))).strip()
    assert said.startswith(f"{(np.abs(z) >= 1).sum()} of 30 runs, one at each setting, are in motion at t = ")
    assert f"{is_quiet.sum()} of them" in str(words.alerts(facts)) or not is_quiet.any()


@pytest.mark.parametrize("columns", [{"z0": None, "w0": None}, {"w0": 0.5}])
def test_starts_that_are_not_known_or_do_not_vary_show_no_basin(planted, rng, columns):
    """Datasets of before have no numbers of starts that were drawn."""
    page = build(starts(planted, rng, 50, **columns)[0], replace(SETTINGS, question=("fates",)), "Starts", "", {})
    assert " of 50 starts (" in page.headline[1]
    assert "basin" not in page.figures
