"""The truncated rate, the test of fit, the line through the log histogram, the share between matrices."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from analysis.fits import Undefined, gamma
from analysis.law.families import truncate
from analysis.law.goodness import between_share, goodness, least_squares, line, quotients, rate, truncated_gamma

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
    covered = studies.rate_coverage(studies.TRUE["spread 0.03"], 20, 300, k_min)
    assert covered >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / 300)


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


def test_the_bound_holds_the_true_gap_as_often_as_it_says():
    """The mixture's own gap: that of its distribution function from the exponential of its mean."""
    k = np.arange(1.0, 40.0)
    true = 1 - 0.5 * (np.exp(-0.55 * k) + np.exp(-0.95 * k))
    mean = 0.5 * sum(1 / (1 - np.exp(-g)) for g in (0.55, 0.95))
    gap = np.abs(true - (1 - (1 - 1 / mean) ** k)).max()
    held = 0
    for one in range(100):
        rng = np.random.default_rng([6, one])
        counts = studies.counted(studies.FALSE["mixture of 0.55 and 0.95"](rng, 20))
        held += goodness(*counts, 0.95, rng).bound >= gap
    assert held >= 90


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
    for one in range(60):
        rng = np.random.default_rng([7, one])
        for quotient in quotients(*studies.counted(studies.TRUE["serial 0.3"](rng, 20)), 0.95):
            held += quotient.low <= 1 <= quotient.high
            total += 1
    # Sizes of one ensemble depend on each other: at worst as if each of the 60 were one trial.
    assert abs(held / total - 0.95) <= 3 * np.sqrt(0.05 * 0.95 / 60)


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
    assert covered >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / 150)
    if spread == 0.2:
        assert value.mean() == pytest.approx(share, abs=0.05)
        assert (low > 0).all()


def test_share_between_needs_three_matrices_with_a_gamma():
    found = between_share([np.array([[3.0, 2.0], [1.0, 1.0]])] * 5, 0.95)
    assert found.value is None
    assert "0 of 5 matrices" in found.reason


def test_truncated_histograms_of_no_cascade_have_reasons():
    sizes, counts = truncate(np.zeros((3, 5), dtype=int), 1, 10)
    assert rate(sizes, counts, 0.95).value is None
    assert goodness(sizes, counts, 0.95, np.random.default_rng(0)).reason
    assert quotients(sizes, counts, 0.95) == []
