"""Two settings set side by side: closed forms, false alarms on planted data, and verdicts that follow the numbers."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from stickslip.analysis.questions.contrast import (
    Sample,
    Statistic,
    contrast,
    in_words,
    judged,
    sample,
    statistics,
    verdict_words,
)
from stickslip.analysis.report.section import Data

from stickslip.analysis.stats.compare import DIFFERENT, EQUIVALENT, OPEN, judge_together, power
from stickslip.analysis.stats.estimates import gamma, ratio

MEAN = Statistic("mean", ratio, 0.1)
SHARE = Statistic("share", ratio, 0.2, is_share=True)
MARGINS = {"mean": 0.1, "variance": 0.25, "rate": 0.1, "correlation_time": 0.5, "gamma": 0.05, "band": 0.5}


def of(values, name="mean", first=0):
    return Sample(name, {name: {first + k: np.array([value, 1.0]) for k, value in enumerate(values)}})


def test_paired_by_the_t_interval_of_differences():
    rng = np.random.default_rng(0)
    a, b = rng.normal(30, 2, 12), rng.normal(31, 2, 12)
    found = contrast(MEAN, of(a), of(b), True, 0.95)
    low, high = stats.ttest_rel(b, a).confidence_interval(0.95)
    assert (found.difference.low, found.difference.high) == pytest.approx((low, high))
    assert found.test.difference == pytest.approx(b.mean() / a.mean() - 1)


def test_independent_by_welch():
    rng = np.random.default_rng(1)
    a, b = rng.normal(30, 2, 12), rng.normal(60, 5, 20)
    found = contrast(MEAN, of(a), of(b, first=100), False, 0.95)
    low, high = stats.ttest_ind(b, a, equal_var=False).confidence_interval(0.95)
    assert (found.difference.low, found.difference.high) == pytest.approx((low, high))
    assert (found.n_first, found.n_second) == (12, 20)
    # the quotient b / a to first order: the error of a counts b / a times
    errors = a.std(ddof=1) / np.sqrt(12) * b.mean() / a.mean() ** 2, b.std(ddof=1) / np.sqrt(20) / a.mean()
    assert found.test.difference == pytest.approx(b.mean() / a.mean() - 1)
    assert found.test.error == pytest.approx(np.hypot(*errors))
    assert found.test.dof == pytest.approx(np.hypot(*errors) ** 4 / (errors[0] ** 4 / 11 + errors[1] ** 4 / 19))


def test_only_shared_matrices_are_pairs():
    found = contrast(MEAN, of([1.0, 2.0, 4.0]), of([3.0, 4.0, 9.0], first=1), True, 0.95)
    assert (found.n_first, found.first.value, found.second.value) == (2, 3.0, 3.5)
    apart = contrast(MEAN, of([1.0, 2.0]), of([3.0, 4.0], first=10), True, 0.95)
    assert apart.test is None
    assert "0 matrices in which both have something to count" in apart.reason


def test_shares_of_none_and_none_are_not_exactly_known():
    # Agresti and Caffo: one success and one failure more in each, so 1/22 and 1/22
    none = of(np.zeros(20), "share")
    found = contrast(SHARE, none, none, False, 0.95)
    half = stats.norm.ppf(0.975) * np.sqrt(2 * (1 / 22) * (21 / 22) / 22)
    assert (found.difference.low, found.difference.high) == pytest.approx((-half, half))
    paired = contrast(SHARE, none, none, True, 0.95)  # Agresti and Min: half a pair more in each cell
    assert paired.test.error == pytest.approx(np.sqrt(1 / 22 / 22))


@pytest.mark.parametrize("paired", [True, False])
def test_alarms_on_planted_values(paired):
    rng = np.random.default_rng(3)
    names = {(0.0, DIFFERENT): 0, (0.1, EQUIVALENT): 0, (-0.1, EQUIVALENT): 0, (0.0, EQUIVALENT): 0}
    for _ in range(300):
        for shift in (0.0, 0.1, -0.1):
            own = 1 + 0.1 * rng.standard_normal(20)
            second = own if paired else 1 + 0.1 * rng.standard_normal(20)
            values = [rng.gamma(100, 0.01, 20) * own, rng.gamma(100, 0.01, 20) * second * (1 + shift)]
            (row,) = judged([contrast(MEAN, *map(of, values), paired, 0.95)], 0.05)
            for verdict in (DIFFERENT, EQUIVALENT):
                if (shift, verdict) in names:
                    names[shift, verdict] += row["verdict"] == verdict
    # three binomial errors of 300 at 5% are 3.8 points
    assert all(names[key] / 300 < 0.05 + 0.038 for key in names if key != (0.0, EQUIVALENT))
    assert names[0.0, DIFFERENT] / 300 > 0.05 - 0.038
    spread = 0.1 * np.sqrt(2 if paired else 4)  # a matrix's own part drops out of a pair
    assert names[0.0, EQUIVALENT] / 300 == pytest.approx(power(20, spread, 0.1, 0.05), abs=0.09)


@pytest.mark.parametrize("paired", [True, False])
def test_alarms_on_planted_shares(paired):
    rng = np.random.default_rng(4)
    alarms, wrongly_same = 0, 0
    for _ in range(400):
        a, b = rng.random(20) < 0.3, rng.random(20) < 0.3
        c = rng.random(20) < 0.5  # off by the margin
        one, two, three = (of(values.astype(float), "share") for values in (a, b, c))
        alarms += judged([contrast(SHARE, one, two, paired, 0.95)], 0.05)[0]["verdict"] == DIFFERENT
        wrongly_same += judged([contrast(SHARE, one, three, paired, 0.95)], 0.05)[0]["verdict"] == EQUIVALENT
    assert abs(alarms / 400 - 0.05) < 0.033  # three binomial errors
    assert wrongly_same / 400 < 0.05 + 0.033


def test_many_comparisons_are_judged_together():
    rng = np.random.default_rng(5)
    found = [contrast(MEAN, of(rng.normal(1, 0.5, 20)), of(rng.normal(1, 0.5, 20)), True, 0.95) for _ in range(200)]
    alone = [judged([one], 0.05)[0]["verdict"] for one in found]
    together = [row["verdict"] for row in judged(found, 0.05)]
    assert 2 <= alone.count(DIFFERENT) <= 20  # 5% of 200 by luck
    assert together.count(DIFFERENT) == 0


def test_words_follow_the_verdict():
    rng = np.random.default_rng(6)
    base = rng.normal(30, 1, 20)
    for factor, said in ((1.0, "the same number in every matrix"), (1.3, "beyond the margin of 10%")):
        (row,) = judged([contrast(MEAN, of(base), of(factor * base), True, 0.95)], 0.05)
        assert said in in_words(row)
    noisy = of(rng.normal(30, 20, 20))
    (row,) = judged([contrast(MEAN, of(base), noisy, True, 0.95)], 0.05)
    assert in_words(row).startswith(OPEN)
    ones = Statistic("gamma", gamma, 0.05)
    (row,) = judged([contrast(ones, *[Sample("a", {"gamma": {k: np.array([9.0, 9.0]) for k in range(3)}})] * 2,
                              True, 0.95)], 0.05)  # fmt: skip
    assert in_words(row) == "not enough data: every cascade has size 1, so gamma has no finite value"


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
        ]
    )
    series = {f"m{k}": (t, a + 2 * wave) for k, a in enumerate((10, 12, 20))} | {"m3": quiet, "m4": quiet}
    found = sample("all", members, Data(members, series), 100.0)
    matrices, rows = found.rows("mean n_stick")
    assert matrices.tolist() == [0, 1, 2, 4]
    assert rows[:, 0] == pytest.approx([11, 13, 21, 200 / 900 * 5])
    assert found.rows("variance of n_stick in time")[1][:3, 0] == pytest.approx([1, 1, 1])
    assert found.rows("exit rate")[1][:3, 0] == pytest.approx(2 / 5, rel=0.01)
    total, count = found.rows("gamma (events)")[1][0]
    assert total == 2 * count
    shares = {name: found.rows(name)[1][:, 0].tolist() for name in found.sums if name.startswith("share")}
    assert shares == {
        "share collapsed (certified)": [0, 0, 0, 1, 0, 0],  # the failed run is in none
        "share gone quiet": [0, 0, 0, 1, 1, 0],
        "share run away": [0, 0, 0, 0, 0, 1],
    }


def test_what_has_no_margin_is_not_compared():
    assert len(statistics(MARGINS)) == 5 + 3
    assert len(statistics({"mean": 0.1})) == 1 + 3


def test_a_correlation_time_longer_than_the_window_can_tell_is_not_judged(planted):
    """A slow decline outlasts the window: its time is that of the window, the same in every run."""
    t = np.arange(0.0, planted.t_end, 2.0)
    members = pd.DataFrame([planted.member(f"m{k}", k) for k in range(4)])
    series = {f"m{k}": (t, np.rint(60 + k - t / 20).astype(int)) for k in range(4)}
    found, other = (
        sample("decline", members, Data(members, some), 100.0)
        for some in (series, {name: (t, n_stick - t.astype(int) // 99) for name, (t, n_stick) in series.items()})
    )
    one = next(one for one in statistics(MARGINS) if one.name == "correlation time")
    assert "in 4 of 4 runs the window is too short for it" in contrast(one, found, other, True, 0.95).reason
    assert not contrast(one, found, found, True, 0.95).reason


def test_a_verdict_that_adjusting_takes_back_is_said_with_its_p_value():
    rows = [
        {"p_equivalent": 1.0, "p_different": 0.02, "margin": 0.1},
        {"p_equivalent": 0.02, "p_different": 0.4, "margin": 0.1},
        {"p_equivalent": 0.02, "p_different": 0.001, "margin": 0.1},
        {"p_equivalent": 0.5, "p_different": 0.5, "margin": 0.1},
        {"p_equivalent": None, "p_different": None},
    ]
    judge_together(rows, 0.05)
    assert [row.get("verdict") for row in rows] == [OPEN, OPEN, DIFFERENT, OPEN, None]
    ends = [(-0.54, -0.07), (-0.05, 0.09), (0.02, 0.08), (-0.5, 0.9)]
    said = [verdict_words(row, "x", low, high, "10%") for row, (low, high) in zip(rows, ends, strict=False)]
    assert said == [
        "not enough data: x against a margin of 10%; different by itself, not after adjustment for 4 comparisons "
        "(adjusted p = 0.06)",  # Holm: the second smallest of four, three times itself
        "not enough data: x against a margin of 10%; equivalent by itself, not after adjustment for 4 comparisons "
        "(adjusted p = 0.08)",
        "different: x, equivalent by itself, not after adjustment for 4 comparisons (adjusted p = 0.08)",
        "not enough data: x against a margin of 10%",
    ]
