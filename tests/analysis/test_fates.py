"""Fates and survival: textbook numbers, identities, planted hazards, and what is never called an end."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import AnalysisSettings, Study
from stickslip.analysis.findings.alerts import Code
from stickslip.analysis.findings.finding import Lack, Level, Lifetime, Regime, Share, levels
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.members import _WEAKENING, Proofs, may_be_proved
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
    survival,
)
from stickslip.analysis.questions.runs.fates import DELAY, QUESTION, answer
from stickslip.analysis.stats.shares import share_over_matrices, wilson
from stickslip.analysis.stats.survival import kaplan_meier, median
from stickslip.pipeline.design.values import Course, Push, Pushes, Values
from tests.analysis import studies
from tests.analysis.designs import Data
from tests.analysis.reports import of_kind

EPS = np.finfo(float).eps
SETTINGS = AnalysisSettings(t_burn=100.0, dt=(0.5,), resamples=2, confidence=0.95, seed=0)
NOT_FOUND = "there is no proof that no block does"
NOT_SOUGHT = "a proof that no block does was sought only where it saves time (set collapse = true under [record])"


def test_survival_against_the_textbook():
    # Freireich et al. 1963, the 6-MP arm, as tabulated in Kalbfleisch and Prentice
    ended = [6, 6, 6, 7, 10, 13, 16, 22, 23]
    censored = [6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
    t, share, low, high = kaplan_meier(np.array(ended + censored, dtype=float), np.arange(21) < 9, 0.95)
    assert t.tolist() == [0, 6, 7, 10, 13, 16, 22, 23]
    assert share == pytest.approx([1, 0.857, 0.807, 0.753, 0.690, 0.627, 0.538, 0.448], abs=5e-4)
    # Greenwood's error of S(23) is 0.135 (ibid.): Rothman's interval, with z^2 over the effective number of runs
    of_z = 1.96**2 * 0.135**2 / (0.448 * 0.552)
    half_width = 1.96 * 0.135 * np.sqrt(1 + of_z / (4 * 0.448 * 0.552))
    expected = [(0.448 + of_z / 2 + sign * half_width) / (1 + of_z) for sign in (-1, 1)]
    assert [low[-1], high[-1]] == pytest.approx(expected, abs=2e-3)
    half = median(np.array(ended + censored, dtype=float), np.arange(21) < 9, 0.95)
    # of 21 tosses at most 5 are heads with 0.013, at most 6 with 0.039: the sixth smallest, 9, on
    assert (half.value, half.low, half.high) == (23, 9, None)


def test_a_share_has_one_interval_on_its_curve_and_in_the_table(planted):
    """Three of four still stick at the end, and one slides without a proof."""
    plan = {20: [QUIET] * 4, 100: [QUIET] + [SUSTAINED] * 3}
    answered = asked(of_sizes(planted, plan))
    (share,) = [one for one in of_kind(answered, Share) if one.key == SUSTAINED]
    t_last, t_end = np.full(4, 50.0), np.full(4, 1000.0)
    curve = survival(np.array(plan[100]), t_last, t_end, t_end, 0.95).curve
    assert tuple(float(column[-1]) for column in curve[1:]) == ends(share.estimate)
    assert ends(share.estimate) == (0.75, 0.301, 1.0)
    n_left = np.array([4, 3, 2, 1, 0])
    _, _, *band = kaplan_meier(np.arange(1.0, 5.0), np.full(4, True), 0.95)
    assert np.transpose(band) == pytest.approx(np.array([wilson(n, 4, 0.95) for n in n_left]))


def test_what_runs_do_has_one_name_in_sentences_and_tables(planted):
    """Sliding that may yet end is said with its time at both settings, also where some go on."""
    answered = asked(of_sizes(planted, {20: [QUIET] * 4, 100: [QUIET] * 3 + [SUSTAINED]}))
    names = {row.quantity.name for finding in answered.findings for row in levels(finding)}
    assert {name for name in names if "may stick again" in name} == {
        "share of runs that slide at t = 1000 but may stick again"
    }
    caption = answered.figures["survival"].caption
    assert caption.startswith("Curves step down at the last event of each run that slides at its end. Share of runs")
    assert caption.endswith("; their upper ends count runs that may stick again as still going.")


def test_steady_sliding_is_the_share_that_is_proved_and_bounds_count_the_unproved_on_either_side(planted):
    """Eight of 20 are proved, four slide without a proof, six stick and slip, and two will."""
    plan = {100: [COLLAPSED] * 8 + [QUIET] * 4 + [SUSTAINED] * 6 + [LULL] * 2, 150: [SUSTAINED] * 20}
    answered = asked(of_sizes(planted, plan))
    (regime,) = (sentence(found) for found in of_kind(answered, Regime) if str(found.where) == "n = 100")
    assert regime.startswith("At n = 100, 40% (22 to 78%) of 20 runs end in steady sliding. The others slide at t = ")
    assert regime.endswith("= 1000 but may stick again, still stick and slip or slide but will stick again.")
    (curve,) = survival_of(answered, "n = 100")
    assert curve.get_ydata()[-1] == pytest.approx(8 / 20), "that stick and slip, or will"
    found = shares(answered)
    assert ends(found[SUSTAINED, "n = 100"].estimate) == (6 / 20, wilson(6, 20, 0.95)[0], wilson(10, 20, 0.95)[1])
    assert ends(found[QUIET, "n = 100"].estimate) == (4 / 20, *wilson(4, 20, 0.95))
    assert ends(found["stable_sliding", "n = 100"].estimate) == (8 / 12, wilson(8, 12, 0.95)[0], 1.0)
    assert "(unless it will stick again)" in answered.figures["survival"].caption


def survival_of(answered, label):
    (ax,) = answered.figures["survival"].recipe().axes
    return [line for line in ax.lines if line.get_label() == label]


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
    t, share, _, _ = survival(fates_of, t_last, t_end, t_end, 0.95, units).curve
    assert t.tolist() == [0.0, 10.0, 50.0]
    assert share == pytest.approx([1.0, 18 / 24, 9 / 24])
    half = survival(fates_of, t_last, t_end, t_end, 0.95, units).median
    assert half.value == 50.0
    assert (half.low, half.high) == (50.0, None)


def test_one_unit_is_one_trial_and_an_end_holds_until_the_last_time_that_allows_it():
    fates_of, t = np.full(40, COLLAPSED, dtype=object), np.arange(1.0, 41.0)
    _, share, low, high = survival(fates_of, t, t, np.full(40, 99.0), 0.95, np.zeros(40, int)).curve
    k = int(np.argmin(np.abs(share - 0.5)))
    assert (low[k], high[k]) == pytest.approx(wilson(0.5, 1.0, 0.95))
    # 60 of each of two units end at 1, so that both agree, then 40 of one at 2: half may yet last
    t_last = np.concatenate([np.ones(60), np.full(40, 2.0), np.ones(60), np.full(40, 50.0)])
    how = np.where(t_last < 50.0, COLLAPSED, SUSTAINED)
    half = survival(how, t_last, np.full(200, 50.0), np.full(200, 50.0), 0.95, np.repeat([0, 1], 100)).median
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


def test_half_of_an_even_number_is_the_lower_middle_time():
    """For six, the product 5/6 4/5 3/4 is not one half to the last digit."""
    assert [median(np.arange(1.0, n + 1), np.full(n, True), 0.95).value for n in range(1, 40)] == [
        (n + 1) // 2 for n in range(1, 40)
    ]
    assert median(np.zeros(0), np.zeros(0, dtype=bool), 0.95).value is None


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


def beside(data, other, **columns):
    """Two ensembles as one, the second one's members with other values of some columns."""
    more = other.members.assign(member_id="s" + other.members["member_id"], **columns)
    series = dict(data.series) | {f"s{name}": points for name, points in other.series.items()}
    return Data(pd.concat([data.members, more], ignore_index=True), series)


def asked(data):
    return answer(Study(data, SETTINGS))


def shares(answered):
    return {(share.key, str(share.where)): share for share in of_kind(answered, Share)}


def codes(answered):
    return {alert.code: dict(alert.numbers) for alert in answered.alerts}


def ends(estimate):
    return pytest.approx((estimate.value, estimate.low, estimate.high), abs=1e-3)


def test_fates_are_kept_apart(planted):
    plan = [COLLAPSED] * 4 + [QUIET] * 2 + [DIVERGED] * 3 + [SUSTAINED] * 9 + [LULL] * 2 + ["failed"]
    answered = asked(data_of(planted, plan))
    rows = answered.tables["fates"].set_index("outcome")
    assert rows["n_runs"].to_dict() == {"sliding": 4, QUIET: 2, "escaping": 3, SUSTAINED: 9, LULL: 2}
    assert set(rows["of"]) == {20}
    # Wilson's of 9 in 20 begins at 0.258, that of 11 in 20 ends at 0.742
    found = shares(answered)
    assert ends(found[SUSTAINED, ""].estimate) == (9 / 20, 0.258, 0.742)
    assert found[LULL, ""].estimate.value == pytest.approx(2 / 20)
    assert found["sliding", ""].estimate.value == pytest.approx(4 / 20)
    assert found["escaping", ""].estimate.value == pytest.approx(3 / 20)
    assert sentence(answered.findings[0]) == "45% (26 to 74%) of runs still stick and slip at t = 1000."
    assert codes(answered)[Code.FAILED] == {"n": 1, "of": 21}
    assert codes(answered)[Code.UNCERTIFIED] == {"n": 2, "of": 20, "why": NOT_SOUGHT}


@pytest.mark.parametrize(
    "force",
    [
        {"force_amplitude": 25.0, "force_frequency": 15.0},
        {"belt_speed": None, "values": {"belt_speed": Course((0.0, 1.0), (0.2, 0.4))}},
        {"values": {"forces": Pushes((Push((1.0, 2.0, 0.0), None, None),))}},
    ],
)
def test_a_proof_that_cannot_exist_is_not_asked_for(planted, force):
    """Under a force that changes, or on such a belt, no record makes one."""
    setting = {"values": Values(), "belt_speed": -0.2, "force_frequency": None} | dict.fromkeys(_WEAKENING) | force
    setting["values"] = Values(dict(setting["values"]).items())
    assert not may_be_proved(setting)
    plain = data_of(planted, [QUIET] * 2 + [SUSTAINED] * 9)
    assert codes(asked(plain))[Code.UNCERTIFIED]["why"] == NOT_SOUGHT
    forced = Data(plain.members.assign(force_amplitude=25.0, force_frequency=15.0), plain.series)
    assert codes(asked(forced))[Code.UNCERTIFIED]["why"] == Proofs.NONE_EXISTS


def test_a_share_of_one_system_has_no_interval_in_words_and_rows(planted):
    answered = asked(data_of(planted, [COLLAPSED]))
    shares = of_kind(answered, Share)
    assert shares
    for share in shares:
        assert ends(share.estimate) == (1.0, None, None)
        assert "(1 system, no interval)" in sentence(share)


def test_survival_counts_certified_ends_and_growth_alone(planted):
    answered = asked(data_of(planted, [COLLAPSED] * 4 + [SUSTAINED] * 5 + [DIVERGED] * 3 + [LULL] * 8))
    (ax,) = answered.figures["survival"].recipe().axes
    (line,) = ax.lines
    assert line.get_xdata().tolist() == [0, 50, 51, 52, 53, 400, 1000]  # last events, and when three left every bound
    assert line.get_ydata().tolist() == pytest.approx([1, 0.95, 0.9, 0.85, 0.8, 0.65, 0.65])
    assert len(ax.collections) == 1, "with its interval"


def test_survival_takes_runs_without_a_certificate_either_way():
    """Four of ten ended by t = 53; five more did by t = 58, or not at all."""
    hows = np.array([COLLAPSED] * 4 + [QUIET] * 5 + [SUSTAINED])
    t_end = np.full(10, 1000.0)
    t, share, low, high = survival(hows, np.arange(50.0, 60.0), t_end, t_end, 0.95).curve
    least, most = (kaplan_meier(np.arange(50.0, 60.0), np.arange(10) < n_ended, 0.95) for n_ended in (9, 4))
    assert (t[-1], share[-1], low[-1], high[-1]) == (58, pytest.approx(0.1), least[2][-1], most[3][-1])


def test_a_certificate_that_is_late_is_no_other_fate(planted):
    """Two laws whose runs all slip from the same events on; under one of them few are certified in time."""
    late = data_of(planted, [COLLAPSED] * 9 + [QUIET] * 11)
    both = beside(data_of(planted, [COLLAPSED] * 20), late, **planted.sigmoid)
    answered = asked(Data(both.members.assign(t_collapse=None), both.series))
    exact, smooth = of_kind(answered, Lifetime)
    assert (exact.estimate.value, exact.estimate.low, exact.estimate.high) == (59.0, 55.0, 64.0)
    assert (smooth.estimate.value, smooth.estimate.low, smooth.estimate.high) == (59.0, 55.0, None)
    assert codes(answered)[Code.UNCERTIFIED] == {"n": 11, "of": 40, "why": NOT_FOUND}
    # Wilson's of 9 in 20 begins at 0.258; proofs are no random part, so each engine says its share
    of_exact, of_sigmoid = answered.findings[0], answered.findings[2]
    assert sentence(of_exact) == "All 20 runs (lower bound 83.9%) end in steady sliding, exact."
    assert sentence(of_sigmoid).startswith("45% (26 to 100%) of runs end in steady sliding, sigmoid")


def test_last_events_are_compared_system_by_system(planted, rng):
    """Under the sigmoid each comes 3 later, but for scatter; few have a certificate there, and one goes on."""
    data = data_of(planted, [COLLAPSED] * 40)
    other = data_of(planted, [COLLAPSED] * 10 + [QUIET] * 29 + [SUSTAINED])
    shifts = 3.0 + rng.uniform(-1.0, 1.0, 40)
    for (name, (t, n_stick)), shift in zip([*other.series.items()], shifts, strict=True):
        other.series[name] = t + np.array([0.0, shift]), n_stick
    answered = asked(beside(data, other, **planted.sigmoid))
    (delay,) = [level for level in of_kind(answered, Level) if level.quantity.key == DELAY.key]
    assert sentence(delay).startswith("Median of the delays of the last event, system by system")
    assert (delay.estimate.value, delay.basis.n) == (pytest.approx(np.median(shifts[:39])), 39)
    in_order = np.sort(shifts[:39])  # 13th of 39 by tosses
    assert (delay.estimate.low, delay.estimate.high) == pytest.approx((in_order[12], in_order[26]))


def test_a_run_that_has_not_moved_is_not_in_motion(planted):
    """Of 20 blocks that all stick from the start on; one that has slipped, and sticks again, may be loaded."""
    data = data_of(planted, [SUSTAINED] * 20)
    series = {
        name: (np.array([0.0]), np.array([200])) if k < 15 else (np.array([0.0, 30.0]), np.array([199, 200]))
        for k, name in enumerate(data.series)
    }
    answered = asked(Data(data.members, series))
    assert sentence(answered.findings[0]) == "All 20 runs (lower bound 83.9%) are stuck at t = 1000."
    assert fate("finished", series["200-0"], 1000.0, n=200) == UNMOVED
    assert fate("finished", series["200-0"], 1000.0, n=201) == SUSTAINED


@pytest.mark.parametrize(
    ("plan", "value", "low"),
    [
        ([QUIET] * 4, 51.0, None),
        ([COLLAPSED] * 2 + [DIVERGED] + [QUIET] * 4, 54.0, 50.0),
        ([COLLAPSED] + [QUIET] + [SUSTAINED] * 4, None, None),
    ],
)
def test_half_that_may_have_ended_is_not_said_to_be_fewer(planted, plan, value, low):
    """Where all are sliding, half may well have ended: only certificates are missing."""
    lifetimes = of_kind(asked(data_of(planted, plan)), Lifetime)
    assert [(found.estimate.value, found.estimate.low) for found in lifetimes] == [(value, low)] * bool(value)


def test_without_a_growth_rate_a_lull_cannot_be_told(planted):
    """Nor where friction hangs on the speed of slip, of which the rate says nothing."""
    data = data_of(planted, [LULL] * 5 + [SUSTAINED] * 5)
    assert codes(asked(data))[Code.TEMPORARY] == {"n": 5, "of": 10}
    for changes in ({"growth_rate": None}, {"weakening_speed": 0.5}, planted.sigmoid):
        answered = asked(Data(data.members.assign(**changes), data.series))
        why = Proofs.NONE_EXISTS.value if "weakening_speed" in changes else NOT_SOUGHT
        assert codes(answered)[Code.UNCERTIFIED] == {"n": 5, "of": 10, "why": why}


def test_what_all_runs_do_has_a_bound(planted):
    """Wilson's interval of 20 in 20 begins at 0.839."""
    for fate_of, key in ((SUSTAINED, SUSTAINED), (DIVERGED, "escaping")):
        answered = asked(data_of(planted, [fate_of] * 20))
        assert ends(shares(answered)[key, ""].estimate) == (1.0, 0.839, 1.0)
    assert [type(finding) for finding in asked(data_of(planted, ["failed"] * 2)).findings] == [Lack]


def test_when_half_have_ended_is_said_with_the_end(planted):
    """Half of 20 have left every bound by t = 400, and 8 go on; where all do the same it is no second sentence."""
    plan = {100: [SUSTAINED] * 20, 250: [DIVERGED] * 12 + [SUSTAINED] * 8, 300: [DIVERGED] * 20}
    answered = asked(of_sizes(planted, plan))
    assert answered.n_lead == 3
    lifetimes = of_kind(answered, Lifetime)
    assert sentence(lifetimes[0]).startswith("Median time to unbounded growth at n = 250: 400")
    alone = of_kind(asked(data_of(planted, [COLLAPSED] * 20)), Lifetime)
    assert [sentence(found) for found in alone] == ["Median time to sliding: 59.0 (55.0 to 64.0)."]


def test_curves_that_coincide_are_one_and_bands_do_not_cover_each_other(planted):
    plan = {20: [COLLAPSED] * 5, 100: [SUSTAINED] * 5, 150: [SUSTAINED] * 5, 250: [DIVERGED] * 3 + [SUSTAINED] * 2}
    (ax,) = asked(of_sizes(planted, plan)).figures["survival"].recipe().axes
    assert [line.get_label() for line in ax.lines] == ["n = 20", "n = 100 and 150", "n = 250"]
    (band,) = ax.collections
    assert band.get_datalim(ax.transData).x0 == 400.0, "not where all are known to last"


@pytest.mark.parametrize("n_held", [20, 5, 1])
def test_runs_whose_blocks_all_stick_are_not_said_to_move(planted, n_held):
    """On a belt at rest they are at rest; nothing but n_stick tells them."""
    data = data_of(planted, [SUSTAINED] * 20)
    held = {f"200-{k}": (np.array([0.0, 740.0]), np.array([3, 200])) for k in range(n_held)}
    late = {
        f"200-{k}": (np.array([0.0, 760.0]), np.array([3, 200])) for k in range(n_held, 20)
    }  # for too short a time
    answered = asked(replace(data, series=dict(data.series) | held | late))
    assert shares(answered)[UNMOVED, ""].estimate.value == pytest.approx(n_held / 20)
    assert shares(answered).keys() == {(UNMOVED, ""), *([(SUSTAINED, "")] if n_held < 20 else [])}


def test_methods_that_agree_are_said_once_and_are_one_system(planted):
    data = data_of(planted, [SUSTAINED] * 20)
    answered = asked(beside(data, data, **planted.sigmoid))
    assert answered.n_lead == 1
    (share,) = of_kind(answered, Share)
    assert (share.basis.n, share.n, str(share.where)) == (20, 40, "")


def test_points_of_a_sweep_share_their_matrices(planted):
    data = data_of(planted, [SUSTAINED] * 20)
    answered = asked(beside(data, data, belt_speed=-0.4))
    (share,) = of_kind(answered, Share)
    assert ends(share.estimate) == (1.0, 0.839, 1.0)
    assert share.basis.n == 20


def test_the_fates_of_two_laws_are_not_added_up(planted):
    data = data_of(planted, [SUSTAINED] * 12)
    answered = asked(beside(data, data_of(planted, [SUSTAINED] * 4 + [DIVERGED] * 8), **planted.sigmoid))
    found = {(key, where.partition(",")[0]): share.estimate.value for (key, where), share in shares(answered).items()}
    assert {pair: value for pair, value in found.items() if pair[1]} == {
        (SUSTAINED, "exact"): 1.0, (SUSTAINED, "sigmoid"): pytest.approx(1 / 3),
        ("escaping", "sigmoid"): pytest.approx(2 / 3), ("unstable_escaping", "exact"): 0.0,
    }  # fmt: skip
    assert answered.n_lead == 3, "what the two do, and how long the second lasts"


@pytest.mark.parametrize(("rate", "how"), [(1e-4, LULL), (-1e-4, QUIET)])
def test_a_lull_is_part_of_the_mean_and_a_run_that_slides_so_far_is_not(planted, rng, rate, how):
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
        Study(Data(pd.DataFrame(part), series), SETTINGS).groups[0] for part in (rows, rows[::2], rows[1::2])
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


def of_sizes(planted, plan):
    parts = [data_of(planted, outcomes, n) for n, outcomes in plan.items()]
    members = pd.concat([part.members for part in parts], ignore_index=True)
    return Data(members, {name: points for part in parts for name, points in part.series.items()})


def regimes_of(answered):
    return [sentence(regime) for regime in of_kind(answered, Regime)]


def test_sizes_are_grouped_by_what_all_their_runs_do(planted):
    plan = {20: [COLLAPSED] * 5, 50: [COLLAPSED] * 5, 100: [SUSTAINED] * 5, 250: [DIVERGED] * 4 + [SUSTAINED]}
    answered = asked(of_sizes(planted, plan))
    assert regimes_of(answered) == [
        "At n = 20 and 50, all 10 runs (lower bound 57% at each) end in steady sliding.",
        "At n = 100, all 5 runs (lower bound 57%) still stick and slip at t = 1000.",
        "At n = 250, 80% (38 to 96%) of 5 runs grow without limit; the others still stick and slip at t = 1000.",
    ]
    # Wilson's of 5 in 5: the systems of 20 and of 50 blocks are not counted together
    lows = [regime.share.low for regime in of_kind(answered, Regime)]
    assert lows == [pytest.approx(0.566, abs=1e-3)] * 2 + [pytest.approx(0.376, abs=1e-3)]
    assert list(answered.figures)[:2] == ["fates", "survival"]
    found = shares(answered)
    assert found[SUSTAINED, "n = 250"].estimate.value == pytest.approx(0.2)
    assert ("escaping", "n = 250") not in found  # the regime has said it
    assert {place for key, place in found if key == "stable_sliding"} == {"n = 20", "n = 50"}
    unstable = {place: share.estimate.value for (key, place), share in found.items() if key == "unstable_escaping"}
    assert unstable == {"n = 100": 0.0, "n = 250": 0.8}
    assert (found["stable_sliding", "n = 20"].estimate.value, found["stable_sliding", "n = 20"].basis.n) == (1.0, 5)
    for picture in answered.figures.values():
        assert picture.recipe().axes


def test_many_changes_along_a_key_are_counted(planted):
    by_turns = {n: [COLLAPSED if k % 2 else SUSTAINED] * 4 for k, n in enumerate(range(10, 80, 10))}
    assert regimes_of(asked(of_sizes(planted, by_turns))) == [
        "At 4 of 7 values of n: all 16 runs (lower bound 51% at each) still stick and slip at t = 1000.",
        "At n = 20, 40 and 60, all 12 runs (lower bound 51% at each) end in steady sliding.",
    ]


def test_a_drift_is_an_alert_even_of_few_cascades(planted):
    t = np.arange(0.0, 1000.0)
    rising = {f"200-{k}": (t, np.arange(1000) // 10 + k) for k in range(5)}
    data = data_of(planted, [SUSTAINED] * 5)
    assert codes(asked(Data(data.members, rising)))[Code.DRIFT]["t_burn"] == 100.0


def test_the_question_leads_where_most_runs_ended(planted):
    for outcomes, leads in (([COLLAPSED] * 6 + [SUSTAINED] * 4, True), ([COLLAPSED] * 4 + [SUSTAINED] * 6, False)):
        assert QUESTION.leads(Study(data_of(planted, outcomes), SETTINGS)) == leads


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
    answered = asked(data)
    assert set(answered.tables["fates"]["of"]) == {400}, "starts that are drawn tell no settings apart"
    slides = np.abs(z) < 1
    is_proved = slides & (np.arange(400) % 2 == 1)
    (low, _), (_, high) = (wilson(chosen.sum(), 400, 0.95) for chosen in (is_proved, slides))
    share = shares(answered)["sliding", ""]
    assert (is_proved.mean(), low, high) == ends(share.estimate)
    assert (share.things, share.basis.n) == ("starts", 400)
    (ax,) = answered.figures["basin"].recipe().axes
    drawn = {
        line.get_color(): sorted(zip(*line.get_data(), strict=True)) for line in ax.lines if len(line.get_xdata())
    }
    assert sorted(zip(z[is_proved], w[is_proved], strict=True)) == drawn["#0072B2"]
    assert sum(map(len, drawn.values())) == 400


def test_starts_that_are_not_known_show_no_basin(planted, rng):
    """Datasets of before have no numbers of starts that were drawn."""
    answered = asked(starts(planted, rng, 50, z0=None, w0=None)[0])
    assert ("sliding", "") in shares(answered)
    assert "basin" not in answered.figures
