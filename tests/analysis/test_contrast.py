"""Two settings set side by side: closed forms, false alarms on planted data, and verdicts that follow the numbers."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from stickslip.analysis import AnalysisSettings, Data, Study
from stickslip.analysis.contrast import (
    SHORT_WINDOW,
    Sample,
    Share,
    Statistic,
    contrast,
    judge,
    sample,
    shares,
    statistics,
    told,
)
from stickslip.analysis.report.formats import environment
from stickslip.analysis.stats.compare import AGREE, DIFFER, UNKNOWN, bounded_difference
from stickslip.analysis.stats.enough import FEW_MATRICES
from stickslip.analysis.stats.estimates import UnitSums, gamma, ratio

MEAN = Statistic("mean", ratio, 0.1)
SHARE = Share("share")
SETTINGS = AnalysisSettings(t_burn=100.0, dt=(0.5,), resamples=2, confidence=0.95, seed=0)
MARGINS = {"mean": 0.1, "variance": 0.25, "rate": 0.1, "correlation_time": 0.5, "gamma": 0.05, "band": 0.5}


def of(values, name="mean", first=0):
    rows = np.column_stack([values, np.ones(len(values))])
    return Sample({name: UnitSums(first + np.arange(len(rows)), rows)})


def judged(rows):
    judge(rows, 0.05)
    return rows


def test_paired_by_the_t_interval_of_differences():
    rng = np.random.default_rng(0)
    a, b = rng.normal(30, 2, 12), rng.normal(31, 2, 12)
    found = contrast(MEAN, of(a), of(b), True, 0.95)
    low, high = stats.ttest_rel(b, a).confidence_interval(0.95)
    assert (found["difference_low"], found["difference_high"]) == pytest.approx((low, high))
    assert found["relative"] == pytest.approx(b.mean() / a.mean() - 1)


def test_independent_by_welch():
    rng = np.random.default_rng(1)
    a, b = rng.normal(30, 2, 12), rng.normal(60, 5, 20)
    found = contrast(MEAN, of(a), of(b, first=100), False, 0.95)
    low, high = stats.ttest_ind(b, a, equal_var=False).confidence_interval(0.95)
    assert (found["difference_low"], found["difference_high"]) == pytest.approx((low, high))
    assert (found["n_first"], found["n_second"]) == (12, 20)
    # the quotient b / a to first order: the error of a counts b / a times
    errors = a.std(ddof=1) / np.sqrt(12) * b.mean() / a.mean() ** 2, b.std(ddof=1) / np.sqrt(20) / a.mean()
    assert found["relative"] == pytest.approx(b.mean() / a.mean() - 1)
    dof = np.hypot(*errors) ** 4 / (errors[0] ** 4 / 11 + errors[1] ** 4 / 19)
    half = stats.t.ppf(0.975, dof) * np.hypot(*errors)
    assert (found["relative_high"] - found["relative_low"]) / 2 == pytest.approx(half)


def test_only_shared_matrices_are_pairs():
    found = contrast(MEAN, of([1.0, 2.0, 4.0, 5.0, 6.0]), of([3.0, 4.0, 9.0, 8.0, 7.0], first=1), True, 0.95)
    assert (found["n_first"], found["first"], found["second"]) == (4, 4.25, 6.0)
    apart = contrast(MEAN, of([1.0, 2.0]), of([3.0, 4.0], first=10), True, 0.95)
    assert (apart["n_first"], apart["reason"], apart["relative"]) == (0, FEW_MATRICES, None)


def test_shares_differ_by_newcombes_interval():
    """Independent: method 10 of Newcombe (1998), Table II (a), 56 of 70 and 48 of 80: 0.0524 to 0.3339.

    Paired: of 20 with 2, 5, 1 and 12 of each kind, by the formula with phi = (ad - bc - n / 2) / sqrt(...).
    """
    many, few = (of(np.arange(n) < k, "share", first=first) for k, n, first in ((56, 70, 100), (48, 80, 0)))
    found = contrast(SHARE, few, many, False, 0.95)
    assert found["difference"] == pytest.approx(0.2)
    assert (found["difference_low"], found["difference_high"]) == pytest.approx((0.0524, 0.3339), abs=5e-5)
    first, second = np.repeat([[1, 1, 0, 0], [1, 0, 1, 0]], (2, 5, 1, 12), axis=1)
    paired = contrast(SHARE, of(first, "share"), of(second, "share"), True, 0.95)
    (p, low_p, high_p), (q, low_q, high_q) = (
        (k / 20, *stats.binomtest(k, 20).proportion_ci(0.95, method="wilson")) for k in (7, 3)
    )
    phi = (2 * 12 - 5 * 1 - 20 / 2) / np.sqrt(7 * 13 * 3 * 17)
    low = np.sqrt((q - low_q) ** 2 - 2 * phi * (q - low_q) * (high_p - p) + (high_p - p) ** 2)
    high = np.sqrt((high_q - q) ** 2 - 2 * phi * (high_q - q) * (p - low_p) + (p - low_p) ** 2)
    assert (paired["difference_low"], paired["difference_high"]) == pytest.approx((q - p - low, q - p + high))
    assert (paired["first_low"], paired["first_high"]) == pytest.approx((low_p, high_p))


def test_tests_of_shares_invert_their_interval():
    """At the level 1 - p an end of the interval is zero; at 1 - 2 p, the nearer margin."""
    first, second = np.arange(40) < 20, np.arange(40) % 4 == 0
    counts = [np.column_stack([has, np.ones(40)]).astype(float) for has in (first, second)]
    for paired in (True, False):
        test = bounded_difference(*counts, paired, 0.4, is_counted=True)
        assert test.interval(1 - test.p_different)[1] == pytest.approx(0.0, abs=1e-9)
        assert test.interval(1 - 2 * test.p_equivalent)[0] == pytest.approx(-0.4, abs=1e-9)


def test_shares_of_none_and_none_are_not_exactly_known():
    none = of(np.zeros(20), "share")
    high = stats.binomtest(0, 20).proportion_ci(0.95, method="wilson").high
    for paired in (False, True):
        found = contrast(SHARE, none, none, paired, 0.95)
        assert (found["difference_low"], found["difference_high"]) == pytest.approx((-high, high))
        assert found["first_high"] == pytest.approx(high)
        assert not told([found])


@pytest.mark.parametrize("paired", [True, False])
def test_alarms_on_planted_values(paired):
    rng = np.random.default_rng(3)
    names = {(0.0, DIFFER): 0, (0.1, AGREE): 0, (-0.1, AGREE): 0, (0.0, AGREE): 0}
    n_small = 0  # by their p, whatever the margin
    for _ in range(300):
        for shift in (0.0, 0.1, -0.1):
            own = 1 + 0.1 * rng.standard_normal(20)
            second = own if paired else 1 + 0.1 * rng.standard_normal(20)
            values = [rng.gamma(100, 0.01, 20) * own, rng.gamma(100, 0.01, 20) * second * (1 + shift)]
            (row,) = judged([contrast(MEAN, *map(of, values), paired, 0.95)])
            n_small += shift == 0.0 and row["p_different"] < 0.05
            for verdict in (DIFFER, AGREE):
                if (shift, verdict) in names:
                    names[shift, verdict] += row["verdict"] == verdict
    # three binomial errors of 300 at 5% are 3.8 points
    assert all(names[key] / 300 < 0.05 + 0.038 for key in names if key != (0.0, AGREE))
    assert abs(n_small / 300 - 0.05) < 0.038
    spread = 0.1 * np.sqrt(2 if paired else 4)  # a matrix's own part drops out of a pair
    of_t = stats.t(19)  # its power at no difference, for a known spread
    power = 2 * of_t.cdf(0.1 * np.sqrt(20) / spread - of_t.ppf(0.95)) - 1
    assert names[0.0, AGREE] / 300 == pytest.approx(power, abs=0.09)


@pytest.mark.parametrize("paired", [True, False])
def test_alarms_on_planted_shares(paired):
    rng = np.random.default_rng(4)
    alarms, wrongly_same = 0, 0
    for _ in range(400):
        a, b = rng.random(20) < 0.3, rng.random(20) < 0.3
        c = rng.random(20) < 0.5  # off by the margin
        one, two, three = (of(values.astype(float), "share") for values in (a, b, c))
        alarms += judged([contrast(SHARE, one, two, paired, 0.95)])[0]["verdict"] == DIFFER
        wrongly_same += judged([contrast(SHARE, one, three, paired, 0.95)])[0]["verdict"] == AGREE
    assert abs(alarms / 400 - 0.05) < 0.033  # three binomial errors
    assert wrongly_same / 400 < 0.05 + 0.033


def test_many_comparisons_are_judged_together():
    rng = np.random.default_rng(5)
    found = [contrast(MEAN, of(rng.normal(1, 0.5, 20)), of(rng.normal(1, 0.5, 20)), True, 0.95) for _ in range(200)]
    alone = [judged([one])[0]["verdict"] for one in found]
    together = [row["verdict"] for row in judged(found)]
    assert 2 <= alone.count(DIFFER) <= 20  # 5% of 200 by luck
    assert together.count(DIFFER) == 0


def test_verdicts_follow_the_numbers():
    rng = np.random.default_rng(6)
    base = rng.normal(30, 1, 20)
    second = [(of(base), AGREE), (of(1.3 * base), DIFFER), (of(rng.normal(30, 20, 20)), UNKNOWN)]
    for other, verdict in second:
        (row,) = judged([contrast(MEAN, of(base), other, True, 0.95)])
        assert row["verdict"] == verdict
    ones = Sample({"gamma": UnitSums(np.arange(4), np.full((4, 2), 9.0))})
    (row,) = judged([contrast(Statistic("gamma", gamma, 0.05), ones, ones, True, 0.95)])
    assert (row["verdict"], row["relative"]) == (UNKNOWN, None)
    assert "size 1" in row["reason"]


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
    found = sample(study.groups[0])
    means = found.of("mean n_stick")
    assert means.units.tolist() == [0, 1, 2]  # m4 is quiet and in shares alone
    assert means.rows[:, 0] == pytest.approx([11, 13, 21])
    assert found.of("variance of n_stick in time").rows[:3, 0] == pytest.approx([1, 1, 1])
    assert found.of("exit rate").rows[:3, 0] == pytest.approx(2 / 5, rel=0.01)
    total, count = found.of("gamma").rows[0]
    assert total == 2 * count
    shares = {name: found.of(name).rows.T.tolist() for name in found.sums if name.startswith("share")}
    assert shares == {  # failed runs are in none
        "share of runs with no late stick": [[0, 0, 0, 1, 1, 0, 1], [1, 1, 2, 1, 1, 1, 1]],
        "share of runs that run away": [[0, 0, 1, 0, 0, 1, 0], [1, 1, 2, 1, 1, 1, 1]],
    }


def test_what_has_no_margin_is_not_compared():
    assert len(statistics(MARGINS)) == 5
    assert [one.name for one in statistics({"mean": 0.1})] == ["mean n_stick"]
    assert len(shares()) == 2


def test_a_correlation_time_longer_than_the_window_can_tell_is_not_judged(planted):
    """A slow decline outlasts the window: its time is that of the window, the same in every run."""
    t = np.arange(0.0, planted.t_end, 2.0)
    members = pd.DataFrame([planted.member(f"m{k}", k) for k in range(4)])
    series = {f"m{k}": (t, np.rint(60 + k - t / 20).astype(int)) for k in range(4)}
    steeper = {name: (t, n_stick - t.astype(int) // 99) for name, (t, n_stick) in series.items()}
    studies = [Study(Data(members, some), SETTINGS) for some in (series, steeper)]
    found, other = (sample(study.groups[0]) for study in studies)
    one = next(one for one in statistics(MARGINS) if one.name == "correlation time")
    assert contrast(one, found, other, True, 0.95)["reason"] == SHORT_WINDOW
    assert not contrast(one, found, found, True, 0.95)["reason"]


def test_no_interval_is_shown_that_reaches_below_minus_100_percent():
    """Of a correlation time, which is positive; what may be negative, and a difference of shares, keep theirs."""
    words = environment().get_template("contrasts.html").module
    row = {"quantity": "correlation time", "relative": 2.94, "relative_low": -1.95, "relative_high": 7.83,
           "is_share": False, "first": 1.0, "second": 3.94, "margin": 0.1, "verdict": "cannot be told",
           "open": ""}  # fmt: skip
    assert words.size(row) == "+294% (no interval)"
    assert words.size(row | {"second": -2.0}) == "+294% (−195% to +783%)"
    assert words.size(row | {"relative_low": -0.95}) == "+294% (−95% to +783%)"
    assert words.size(row | {"relative_low": -1.0, "is_share": True}) == "+294 points (−100 to +783)"
    shown = words.side_by_side([row, row | {"quantity": "gamma", "relative_low": 0.1}], "a", "b", "")
    assert [("−195%" in one, "+783%" in one) for one in shown.split("<tr>")[2:]] == [(False, False), (False, True)]
