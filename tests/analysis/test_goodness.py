"""The test of fit, each size over the fitted law, the line through the log histogram."""

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis.stats.estimates import Undefined, gamma
from stickslip.analysis.stats.families import truncate
from stickslip.analysis.stats.goodness import REJECTED, UNKNOWN, goodness, quotients
from tests.analysis import studies


def rate(counts):
    sizes = np.arange(1, counts.shape[1] + 1)
    return float(gamma(np.array([[counts.sum(axis=0) @ sizes, counts.sum()]], dtype=float))[0])


@pytest.mark.long
@pytest.mark.parametrize("name", ["serial 0.3", "spread 0.03"])
def test_false_alarms_of_the_fit_with_dependent_sizes(name, rng):
    share = studies.rejections(studies.TRUE[name], 20, 300, rng)
    assert abs(share[0] - 0.05) <= 3 * np.sqrt(0.05 * 0.95 / 300)
    assert share[1] <= share[0]  # rejected wherever the tail is cut


@pytest.mark.parametrize("name", ["mixture of 0.55 and 0.95", "power law 2.06", "cut-off power law, alpha 0.2"])
def test_other_laws_are_rejected(name, rng):
    assert studies.rejections(studies.FALSE[name], 20, 20, rng)[1] >= 0.9


def test_independent_cascades_would_be_a_wrong_null():
    """Sizes in equal pairs: a chi-square test of the same shares, cascades independent, alarms far too often."""
    hits = np.zeros(2)
    for one in range(200):
        rng = np.random.default_rng([5, one])
        sizes, counts = studies.counted(np.repeat(studies.dependent_sizes(rng, 20, n_cascades=300), 4, axis=1))
        hits[0] += goodness(sizes, counts, 0.95, rng).verdict(0.05) == REJECTED
        pooled = counts.sum(axis=0)
        fitted = rate(counts)
        shares = -np.expm1(-fitted) * np.exp(-fitted * (sizes - 1))
        seen, expected = (np.append(x[:6], x[6:].sum()) for x in (pooled, pooled.sum() * shares))
        hits[1] += np.sum((seen - expected) ** 2 / expected) > 11.07  # 95% quantile, 5 degrees of freedom
    assert hits[0] / 200 <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 200)
    assert hits[1] / 200 > 0.5


def test_the_gap_is_that_of_the_distribution_functions():
    sizes, counts = studies.counted(studies.FALSE["mixture of 0.55 and 0.95"](np.random.default_rng(3), 20))
    found = goodness(sizes, counts, 0.95, np.random.default_rng(0))
    shares = counts.sum(axis=0) / counts.sum()
    fitted = rate(counts)
    gaps = np.abs(np.cumsum(shares) - (1 - np.exp(-fitted * sizes)))
    assert found.gap == pytest.approx(gaps.max(), abs=1e-9)
    assert found.at == sizes[gaps.argmax()]
    assert found.bound > found.gap
    assert found.p_least >= 1 / 10_000  # the signs as observed are one of the patterns: never zero


def test_the_bound_by_hand():
    """Eight matrices of each of two kinds, all with the mean 26/15 of rate ln 2 on 1..4: nothing is projected off.

    P(size <= k) is 8, 12, 14 in 15 under the fit; in 24,000 cascades the two kinds are off it by 50, 0, -50 and by
    -80, 40, 40 each. A part is half their difference from the mean of all, times the root of 16/15; its signed sum
    is that of 16 signs, which is 8 or less in 97.9% and 6 or less in 92.3%: a reach of 8 / 4 standard errors.
    """
    sizes, counts = np.arange(1.0, 5.0), np.repeat([[850, 350, 150, 150], [720, 520, 200, 60]], 8, axis=0)
    found = goodness(sizes, counts.astype(float), 0.95, np.random.default_rng())
    assert (found.gap, found.at) == (pytest.approx(8 * 40 / 24_000), 2)
    assert found.bound == pytest.approx((8 * 30 + 8 / 4 * 4 * np.sqrt(16 / 15) * 65) / 24_000)


def test_the_bound_holds_the_true_gap_as_often_as_it_says_and_is_no_wider_than_that_takes():
    """The mixture's own gap: that of its distribution function from the exponential of its mean."""
    k = np.arange(1.0, 40.0)
    true = 1 - 0.5 * (np.exp(-0.55 * k) + np.exp(-0.95 * k))
    mean = 0.5 * sum(1 / (1 - np.exp(-g)) for g in (0.55, 0.95))
    gap = np.abs(true - (1 - (1 - 1 / mean) ** k)).max()
    found = []
    for one in range(100):
        rng = np.random.default_rng([6, one])
        counts = studies.counted(studies.FALSE["mixture of 0.55 and 0.95"](rng, 20))
        found.append(goodness(*counts, 0.95, rng))
    bounds, gaps = np.array([(one.bound, one.gap) for one in found]).T
    assert np.mean(bounds >= gap) >= 0.9
    # one size alone takes 2 standard errors, five to ten that hardly depend on each other 2.9
    assert 1.7 < np.mean(bounds - gaps) / gaps.std() < 3.5


def test_few_matrices_or_cascades_are_not_enough():
    sizes = studies.dependent_sizes(np.random.default_rng(0), 5)
    found = goodness(*studies.counted(sizes), 0.95, np.random.default_rng(0))
    assert (found.p_value, found.verdict(0.05), found.reason) == (None, UNKNOWN, "few matrices")
    assert found.gap is not None
    few = goodness(*studies.counted(sizes[:, :8]), 0.95, np.random.default_rng(0))
    assert few.reason == "few cascades"


def test_quotients_are_one_for_the_fitted_law_and_their_intervals_cover():
    held = total = 0
    ones = []
    for one in range(60):
        rng = np.random.default_rng([7, one])
        for quotient in quotients(*studies.counted(studies.TRUE["serial 0.3"](rng, 20)), 0.95):
            held += quotient.low <= 1 <= quotient.high
            total += 1
            if quotient.size == 1:
                ones.append((quotient.value, quotient.high - quotient.value))
    # Sizes of one ensemble depend on each other: at worst as if each of the 60 were one trial.
    assert abs(held / total - 0.95) <= 3 * np.sqrt(0.05 * 0.95 / 60)
    values, halves = np.array(ones).T  # 60 know a standard deviation to 9%
    assert halves.mean() / (stats.t.ppf(0.975, 19) * values.std(ddof=1)) == pytest.approx(1, abs=0.28)


def test_the_interval_of_a_quotient_by_hand():
    """Three matrices of one mean and number: nothing is projected off, and each has its own quotient."""
    sizes, counts = np.arange(1.0, 5.0), np.array([[850, 350, 150, 150], [720, 520, 200, 60], [785, 435, 175, 105.0]])
    first = quotients(sizes, counts, 0.95)[0]
    own = counts[:, 0] / 800  # 1500 cascades each, of which 8 in 15 have size 1 at rate ln 2
    assert first.value == pytest.approx(own.mean())
    assert first.high - first.value == pytest.approx(4.302652730 * own.std(ddof=1) / np.sqrt(3))  # t, 2 degrees


def test_histograms_of_no_cascade_have_reasons():
    sizes, counts = truncate(np.zeros((3, 5), dtype=int), 1, 10)
    assert goodness(sizes, counts, 0.95, np.random.default_rng(0)).reason
    with pytest.raises(Undefined):
        quotients(sizes, counts, 0.95)
