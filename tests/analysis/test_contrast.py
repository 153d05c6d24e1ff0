"""Two settings set side by side: closed forms, false alarms on planted data, and verdicts that follow the numbers."""

from functools import partial

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from stickslip.analysis import AnalysisSettings, Study
from stickslip.analysis.contrast import Share, Statistic, contrast, judged, turns
from stickslip.analysis.findings.finding import Course, Scale, Verdict
from stickslip.analysis.measures import ENDS, SHORT_WINDOW, of_windows
from stickslip.analysis.stats.compare import bounded_difference
from stickslip.analysis.stats.enough import FEW_MATRICES
from stickslip.analysis.stats.estimates import UnitSums, gamma, ratio
from tests.analysis.designs import Data
from tests.chance import agrees

MEAN = Statistic("mean", ratio, 0.1)
SHARE = Share("share")
SETTINGS = AnalysisSettings(t_burn=100.0, dt=(0.5,), resamples=2, confidence=0.95, seed=0)


def of(values, first=0):
    rows = np.column_stack([values, np.ones(len(values))])
    return UnitSums(first + np.arange(len(rows)), rows)


def verdicts(contrasts):
    return [found.verdict for found in judged(contrasts, 0.05)]


def ends(estimate):
    return estimate.low, estimate.high


def test_paired_by_the_t_interval_of_differences():
    rng = np.random.default_rng(0)
    a, b = rng.normal(30, 2, 12), rng.normal(31, 2, 12)
    found = contrast(MEAN, of(a), of(b), True, 0.95)
    low, high = stats.ttest_rel(b, a).confidence_interval(0.95)
    assert ends(found.absolute) == pytest.approx((low, high))
    assert found.relative.value == pytest.approx(b.mean() / a.mean() - 1)


def test_independent_by_welch():
    rng = np.random.default_rng(1)
    a, b = rng.normal(30, 2, 12), rng.normal(60, 5, 20)
    found = contrast(MEAN, of(a), of(b, first=100), False, 0.95)
    low, high = stats.ttest_ind(b, a, equal_var=False).confidence_interval(0.95)
    assert ends(found.absolute) == pytest.approx((low, high))
    assert (found.n_first, found.n_second) == (12, 20)
    # the quotient b / a to first order: the error of a counts b / a times
    errors = a.std(ddof=1) / np.sqrt(12) * b.mean() / a.mean() ** 2, b.std(ddof=1) / np.sqrt(20) / a.mean()
    assert found.relative.value == pytest.approx(b.mean() / a.mean() - 1)
    dof = np.hypot(*errors) ** 4 / (errors[0] ** 4 / 11 + errors[1] ** 4 / 19)
    half = stats.t.ppf(0.975, dof) * np.hypot(*errors)
    assert (found.relative.high - found.relative.low) / 2 == pytest.approx(half)


def test_only_shared_matrices_are_pairs():
    found = contrast(MEAN, of([1.0, 2.0, 4.0, 5.0, 6.0]), of([3.0, 4.0, 9.0, 8.0, 7.0], first=1), True, 0.95)
    assert (found.n_first, found.first.value, found.second.value) == (4, 4.25, 6.0)
    apart = contrast(MEAN, of([1.0, 2.0]), of([3.0, 4.0], first=10), True, 0.95)
    assert (apart.n_first, apart.reason, apart.is_known) == (0, FEW_MATRICES, False)


def test_shares_differ_by_newcombes_interval():
    """Independent: method 10 of Newcombe (1998), Table II (a), 56 of 70 and 48 of 80: 0.0524 to 0.3339.

    Paired: of 20 with 2, 5, 1 and 12 of each kind, by the formula with phi = (ad - bc - n / 2) / sqrt(...).
    """
    many, few = (of(np.arange(n) < k, first=first) for k, n, first in ((56, 70, 100), (48, 80, 0)))
    found = contrast(SHARE, few, many, False, 0.95)
    assert found.absolute.value == pytest.approx(0.2)
    assert ends(found.absolute) == pytest.approx((0.0524, 0.3339), abs=5e-5)
    first, second = np.repeat([[1, 1, 0, 0], [1, 0, 1, 0]], (2, 5, 1, 12), axis=1)
    paired = contrast(SHARE, of(first), of(second), True, 0.95)
    (p, low_p, high_p), (q, low_q, high_q) = (
        (k / 20, *stats.binomtest(k, 20).proportion_ci(0.95, method="wilson")) for k in (7, 3)
    )
    phi = (2 * 12 - 5 * 1 - 20 / 2) / np.sqrt(7 * 13 * 3 * 17)
    low = np.sqrt((q - low_q) ** 2 - 2 * phi * (q - low_q) * (high_p - p) + (high_p - p) ** 2)
    high = np.sqrt((high_q - q) ** 2 - 2 * phi * (high_q - q) * (p - low_p) + (p - low_p) ** 2)
    assert ends(paired.absolute) == pytest.approx((q - p - low, q - p + high))
    assert ends(paired.first) == pytest.approx((low_p, high_p))


def test_tests_of_shares_invert_their_interval():
    """At the level 1 - p an end of the interval is zero."""
    first, second = np.arange(40) < 20, np.arange(40) % 4 == 0
    counts = [np.column_stack([has, np.ones(40)]).astype(float) for has in (first, second)]
    for paired in (True, False):
        test = bounded_difference(*counts, paired, is_counted=True)
        assert test.interval(1 - test.p_different)[1] == pytest.approx(0.0, abs=1e-9)


def test_shares_of_none_and_none_are_not_exactly_known():
    none = of(np.zeros(20))
    high = stats.binomtest(0, 20).proportion_ci(0.95, method="wilson").high
    for paired in (False, True):
        found = contrast(SHARE, none, none, paired, 0.95)
        assert ends(found.absolute) == pytest.approx((-high, high))
        assert found.first.high == pytest.approx(high)
        assert not found.is_known


def test_many_comparisons_are_judged_together():
    rng = np.random.default_rng(5)
    found = [contrast(MEAN, of(rng.normal(1, 0.5, 20)), of(rng.normal(1, 0.5, 20)), True, 0.95) for _ in range(200)]
    shown = {Verdict.MORE, Verdict.LESS}
    alone = [verdicts([one])[0] in shown for one in found]
    together = judged(found, 0.05)
    assert 2 <= sum(alone) <= 20  # 5% of 200 by luck
    assert not any(one.is_shown for one in together)
    assert {one.family.n for one in together} == {200}
    assert all(one.family.p_different >= one.p_different for one in together)


def test_verdicts_follow_the_numbers():
    rng = np.random.default_rng(6)
    base = rng.normal(30, 1, 20)
    second = [
        (of(base + rng.normal(0, 0.1, 20)), Verdict.EQUAL),
        (of(1.3 * base), Verdict.MORE),
        (of(rng.normal(30, 20, 20)), Verdict.OPEN),
    ]
    for other, verdict in second:
        assert verdicts([contrast(MEAN, of(base), other, True, 0.95)]) == [verdict]
    bare = Statistic("mean", ratio)  # no margin: nothing is equal
    assert verdicts([contrast(bare, of(base), of(base + rng.normal(0, 0.1, 20)), True, 0.95)]) == [Verdict.OPEN]
    ones = UnitSums(np.arange(4), np.full((4, 2), 9.0))
    found = contrast(Statistic("gamma", gamma, 0.05), ones, ones, True, 0.95)
    assert (found.verdict, found.is_known) == (Verdict.UNJUDGED, False)
    assert "size 1" in found.reason


def test_what_is_zero_within_its_interval_has_no_ratio():
    rng = np.random.default_rng(7)
    about_zero, above = of(rng.normal(0.0, 1.0, 12)), of(rng.normal(9.0, 1.0, 12))
    found = contrast(MEAN, about_zero, above, True, 0.95)
    assert found.relative.value is None
    assert (found.difference.scale, verdicts([found])) == (Scale.ABSOLUTE, [Verdict.MORE])
    few = contrast(MEAN, of([1.0, 2.0]), of([3.0, 5.0]), True, 0.95)
    assert (few.absolute.value, few.verdict, few.reason) == (2.5, Verdict.UNJUDGED, FEW_MATRICES)


def test_no_ratio_has_an_interval_below_minus_100_percent():
    """Of what is positive: by the scatter of a first value near zero, or as Student's interval of 2.3 / 10 does."""
    first, second = of([0.1, 0.2, 0.3, 8.0]), of([0.1, 9.0, 0.2, 12.0], first=10)
    found = contrast(Statistic("mean", ratio, 0.1, least=0.0), first, second, False, 0.95)
    assert found.difference.scale is Scale.ABSOLUTE
    assert found.first.low == 0.0
    first = of([10.0, 10.0, 10.1, 9.9])
    beyond = contrast(MEAN, first, of([0.1, 0.1, 0.1, 9.0]), True, 0.95)
    assert (beyond.relative.value, beyond.difference.scale) == (None, Scale.ABSOLUTE)
    assert beyond.absolute.low < -10.0
    assert contrast(MEAN, first, of([0.1, 0.1, 0.2, 0.1]), True, 0.95).relative.low > -1.0
    assert contrast(MEAN, first, of([-3.1, -3.1, -3.1, 9.0]), True, 0.95).relative.low < -1.0  # not positive


def test_a_sample_is_the_planted_one(planted):
    """Square waves between a and a + 2: mean a + 1, variance 1, one exit every 5 units, cascades of size 2."""
    t = np.arange(0.0, planted.t_end, 2.5)
    wave = np.arange(t.size) % 2
    quiet = np.array([0.0, 300.0]), np.array([5, 0])
    members = pd.DataFrame(
        [planted.member(f"m{k}", k) for k in range(3)]
        + [
            planted.member("m3", 3, outcome="collapsed", t_stop=310.0),
            planted.member("m4", 4),
            planted.member("m5", 5, outcome="diverged", t_stop=200.0),
            planted.member("m6", 6, outcome="failed", t_stop=None),
            planted.member("m2 again", 2, outcome="diverged", t_stop=200.0),  # shares have all runs of a matrix
            planted.member("m7", 7, outcome="failed", t_stop=None),
            planted.member("m7 again", 7, outcome="collapsed", t_stop=310.0),  # that did not fail
        ]
    )
    series = {f"m{k}": (t, a + 2 * wave) for k, a in enumerate((10, 12, 20))}
    series |= {name: quiet for name in ("m3", "m4", "m5", "m2 again", "m7 again")}
    study = Study(Data(members, series), SETTINGS)
    sums = {measure.name: measure.of(study.groups[0]).sums for measure in (*of_windows(study), *ENDS)}
    means = sums["mean n_stick"]
    assert means.units.tolist() == [0, 1, 2]  # m4 is quiet and in shares alone
    assert means.rows[:, 0] == pytest.approx([11, 13, 21])
    assert sums["variance of n_stick in time"].rows[:3, 0] == pytest.approx([1, 1, 1])
    assert sums["exit rate"].rows[:3, 0] == pytest.approx(2 / 5, rel=0.01)
    total, count = study.groups[0].sums("gamma").rows[0]  # which three matrices do not have compared
    assert total == 2 * count
    shares = {name: of_units.rows.T.tolist() for name, of_units in sums.items() if name.startswith("share")}
    assert shares == {  # failed runs are in none
        "share of runs with no late stick": [[0, 0, 0, 1, 1, 0, 1], [1, 1, 2, 1, 1, 1, 1]],
        "share of runs that run away": [[0, 0, 1, 0, 0, 1, 0], [1, 1, 2, 1, 1, 1, 1]],
    }


def test_a_correlation_time_longer_than_the_window_can_tell_is_not_judged(planted):
    """A slow decline outlasts the window: its time is that of the window, the same in every run."""
    t = np.arange(0.0, planted.t_end, 2.0)
    members = pd.DataFrame([planted.member(f"m{k}", k) for k in range(4)])
    series = {f"m{k}": (t, np.rint(60 + k - t / 20).astype(int)) for k in range(4)}
    steeper = {name: (t, n_stick - t.astype(int) // 99) for name, (t, n_stick) in series.items()}
    studies = [Study(Data(members, some), SETTINGS) for some in (series, steeper)]
    (measure,) = of_windows(studies[0], ["correlation_time"])
    first, second = (measure.of(study.groups[0]) for study in studies)
    judged = partial(contrast, measure.statistic, first.sums, paired=True, confidence=0.95, withheld=first.withheld)
    assert judged(second.sums).reason == SHORT_WINDOW
    assert not judged(first.sums).reason


# ---------------------------------------------------------------------------------------------- along a key


def turns_of(means, rng, n=20):
    """Those of a quantity with such means, of systems that differ by more than the values do, with noise of 0.5."""
    systems = rng.normal(0.0, 5.0, n)
    values = [of(mean + systems + rng.normal(0.0, 0.5, n)) for mean in means]
    level = 1.0 - 0.05 / (len(means) * (len(means) - 1) / 2)

    def verdict(i, j):
        return contrast(Statistic("mean", ratio), values[i], values[j], True, level).verdict

    found = turns([float(sums.rows[:, 0].mean()) for sums in values], verdict)
    return [(course, means[extreme[0]], means[shown]) for course, extreme, shown in found]


def test_neighbours_may_share_an_extreme():
    """Whole numbers, known to the last."""
    values = [10, 3, 3, 4, 9, 5, 2]

    def verdict(i, j):
        return Verdict.MORE if values[j] > values[i] else Verdict.LESS if values[j] < values[i] else Verdict.OPEN

    assert turns(values, verdict) == [(Course.MINIMUM, range(1, 3), 3), (Course.MAXIMUM, range(4, 5), 5)]


def test_what_turns_on_the_way_does_not_rise_or_fall(rng):
    assert turns_of([16.4, 9.05, 9.94, 10.63], rng) == [(Course.MINIMUM, 9.05, 9.94)]
    assert turns_of([16.4, 20.0, 24.0, 10.63], rng) == [(Course.MAXIMUM, 24.0, 10.63)]
    assert turns_of([16.4, 9.0, 24.0, 16.5], rng) == [(Course.MINIMUM, 9.0, 24.0), (Course.MAXIMUM, 24.0, 16.5)]
    assert turns_of([16.4, 12.0, 10.0, 9.0], rng) == []


def test_a_peak_between_values_that_fall_is_a_turn(rng):
    """A resonance: no value lies on one side of both ends."""
    assert turns_of([27.4, 7.0, 11.3, 3.1, 1.9], rng) == [(Course.MINIMUM, 7.0, 11.3), (Course.MAXIMUM, 11.3, 3.1)]


@pytest.mark.parametrize("means", [[10.0] * 6, [16.0, 12.0, 9.0, 9.0, 9.0, 9.0]])
def test_what_is_flat_or_falls_turns_by_chance_in_a_twentieth_at_most(means, rng):
    n_turns = sum(turns_of(means, rng) != [] for _ in range(100))
    assert agrees(n_turns, 100, 0.0, 0.05)
