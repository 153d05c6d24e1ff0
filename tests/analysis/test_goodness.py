"""The truncated rate, the test of fit, the line through the log histogram, the share between matrices."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis.stats.estimates import Undefined, gamma, jackknife
from stickslip.analysis.stats.families import truncate
from stickslip.analysis.stats.goodness import (
    between_share,
    goodness,
    least_squares,
    line,
    quotients,
    rate,
    truncated_gamma,
)

spec = importlib.util.spec_from_file_location("law_studies", Path(__file__).with_name("law_studies.py"))
studies = importlib.util.module_from_spec(spec)
spec.loader.exec_module(studies)


def test_without_truncation_it_is_gamma():
    sums = np.array([[37.0, 20.0], [1000.0, 400.0], [100.0, 99.0]])
    np.testing.assert_allclose(truncated_gamma(1, 2000)(sums), gamma(sums), rtol=1e-12)


@pytest.mark.parametrize("k_min", [1, 2, 5])
@pytest.mark.parametrize("planted", [-0.4, 0.0, 0.01, 0.7, 3.0])
def test_the_mean_of_the_truncated_law_gives_its_rate_back(k_min, planted):
    k = np.arange(k_min, 13.0)
    shares = np.exp(-planted * k) / np.exp(-planted * k).sum()
    assert truncated_gamma(k_min, 12)(np.array([[shares @ k, 1.0]]))[0] == pytest.approx(planted, abs=1e-8)


def test_truncation_removes_the_bias_of_ignoring_it():
    """Rate 0.2 on 1..8: the untruncated estimate would say 0.36."""
    k = np.arange(1.0, 9.0)
    sizes = np.random.default_rng(1).choice(k.astype(int), (20, 500), p=np.exp(-0.2 * k) / np.exp(-0.2 * k).sum())
    found = rate(*studies.counted(sizes, k_max=8), 0.95)
    assert found.low < 0.2 < found.high
    assert gamma(np.array([[sizes.sum(), sizes.size]]))[0] > 0.3


def test_rates_without_a_value_are_reasons():
    for sums, reason in (([0.0, 0.0], "no cascade of 3"), ([9.0, 3.0], "size 3"), ([24.0, 3.0], "size 8")):
        with pytest.raises(Undefined, match=reason):
            truncated_gamma(3, 8)(np.array([sums]))


@pytest.mark.parametrize("k_min", [1, 3])
def test_interval_of_the_truncated_rate_covers(k_min):
    covered, width = studies.rate_coverage(studies.TRUE["spread 0.03"], 20, 300, k_min)
    assert abs(covered - 0.95) <= 3 * np.sqrt(0.05 * 0.95 / 300)
    assert width == pytest.approx(1, abs=0.13)  # a standard deviation of 300 is known to 4%


@pytest.mark.long
@pytest.mark.parametrize("name", ["serial 0.3", "spread 0.03"])
def test_false_alarms_of_the_fit_with_dependent_sizes(name):
    share = studies.rejections(studies.TRUE[name], 20, 300, seed=1)
    assert abs(share[0] - 0.05) <= 3 * np.sqrt(0.05 * 0.95 / 300)
    assert share[1] <= share[0]  # rejected wherever the tail is cut


@pytest.mark.parametrize("name", ["mixture of 0.55 and 0.95", "power law 2.06", "cut-off power law, alpha 0.2"])
def test_other_laws_are_rejected(name):
    assert studies.rejections(studies.FALSE[name], 20, 20)[1] >= 0.9


def test_independent_cascades_would_be_a_wrong_null():
    """Sizes in equal pairs: a chi-square test of the same shares, cascades independent, alarms far too often."""
    hits = np.zeros(2)
    for one in range(200):
        rng = np.random.default_rng([5, one])
        sizes, counts = studies.counted(np.repeat(studies.dependent_sizes(rng, 20, n_cascades=300), 4, axis=1))
        hits[0] += goodness(sizes, counts, 0.95, rng).verdict(0.05) == "rejected"
        pooled = counts.sum(axis=0)
        fitted = rate(sizes, counts, 0.95).value
        shares = -np.expm1(-fitted) * np.exp(-fitted * (sizes - 1))
        seen, expected = (np.append(x[:6], x[6:].sum()) for x in (pooled, pooled.sum() * shares))
        hits[1] += np.sum((seen - expected) ** 2 / expected) > 11.07  # 95% quantile, 5 degrees of freedom
    assert hits[0] / 200 <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 200)
    assert hits[1] / 200 > 0.5


def test_the_gap_is_that_of_the_distribution_functions():
    sizes, counts = studies.counted(studies.FALSE["mixture of 0.55 and 0.95"](np.random.default_rng(3), 20))
    found = goodness(sizes, counts, 0.95, np.random.default_rng(0))
    shares = counts.sum(axis=0) / counts.sum()
    fitted = rate(sizes, counts, 0.95).value
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


def test_few_matrices_are_not_enough_and_it_says_how_many_are():
    sizes = studies.dependent_sizes(np.random.default_rng(0), 5)
    found = goodness(*studies.counted(sizes), 0.95, np.random.default_rng(0))
    assert (found.p_value, found.verdict(0.05)) == (None, "not enough data")
    assert found.gap is not None
    assert "5 matrices, where a test at this level needs 6" in found.reason
    few = goodness(*studies.counted(sizes[:, :8]), 0.95, np.random.default_rng(0))
    assert "two smallest" in few.reason


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


def test_line_is_the_least_squares_slope_over_the_sizes_seen():
    sizes, counts = np.arange(1.0, 7.0), np.array([[50, 30, 10, 0, 3, 1], [8, 4, 2, 1, 0, 0]])
    expected = [-np.polyfit(sizes[row > 0], np.log(row[row > 0]), 1)[0] for row in counts]
    np.testing.assert_allclose(line(sizes, counts), expected)


def test_the_line_is_biased_and_the_bias_is_measured():
    planted, slopes = 0.7, []
    for one in range(200):
        rng = np.random.default_rng([9, one])
        sizes, counts = studies.counted(rng.geometric(1 - np.exp(-planted), (1, 2000)))
        slopes.append(line(sizes, counts)[0])
    found = least_squares(sizes, counts, np.random.default_rng(0))
    assert np.mean(slopes) < planted - 0.03
    # 200 slopes that scatter by 0.07, and a bias taken at the fitted rate, not the planted one
    assert found.bias == pytest.approx(np.mean(slopes) - planted, abs=3 * np.std(slopes) / np.sqrt(200) + 0.005)


@pytest.mark.parametrize("spread", [0.0, 0.048, 0.2])
def test_share_between_matrices(spread):
    value, low, high = studies.share_study(20, spread, 150, serial=0.0).T
    # Closed form: a shift of the scores by s moves gamma by 0.62 s; within, gamma has the error (1 - q) / sqrt(q n).
    within = (1 - np.exp(-0.7)) ** 2 / (np.exp(-0.7) * studies.N_CASCADES)
    share = (0.62 * spread) ** 2 / ((0.62 * spread) ** 2 + within)
    covered = np.mean((low <= share + 0.02) & (share - 0.02 <= high))
    assert covered >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / 150)  # its width: by hand below
    if spread == 0.2:
        assert value.mean() == pytest.approx(share, abs=0.05)
        assert (low > 0).all()


def test_share_between_by_hand():
    """1 - W / V, and V / W over 1 - share an F with matrices - 1 and stretches - matrices degrees of freedom."""
    parts = [
        np.array(rows, dtype=float) for rows in ([[9, 4], [7, 4]], [[30, 6], [22, 6], [25, 6]], [[5, 4], [6, 4]])
    ]
    values, errors = np.array([jackknife(gamma, part) for part in parts]).T
    ratio = values.var(ddof=1) / np.mean(errors**2)
    found = between_share(parts, 0.5)
    assert found.value == pytest.approx(1 - 1 / ratio)
    assert (found.low, found.high) == pytest.approx([1 - stats.f(2, 4).ppf(q) / ratio for q in (0.75, 0.25)])
    assert 0 < found.low < found.high < 1


def test_share_between_needs_three_matrices_with_a_gamma():
    found = between_share([np.array([[3.0, 2.0], [1.0, 1.0]])] * 5, 0.95)
    assert found.value is None
    assert "0 of 5 matrices" in found.reason


def test_truncated_histograms_of_no_cascade_have_reasons():
    sizes, counts = truncate(np.zeros((3, 5), dtype=int), 1, 10)
    assert rate(sizes, counts, 0.95).value is None
    assert goodness(sizes, counts, 0.95, np.random.default_rng(0)).reason
    assert quotients(sizes, counts, 0.95) == []
