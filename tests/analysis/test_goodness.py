"""The test of fit, each size over the fitted law, the line through the log histogram."""

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis.stats.estimates import Undefined, gamma
from stickslip.analysis.stats.families import truncate
from stickslip.analysis.stats.goodness import REJECTED, UNKNOWN, goodness, quotients
from tests.analysis import studies
from tests.chance import agrees


def rate(counts):
    sizes = np.arange(1, counts.shape[1] + 1)
    return float(gamma(np.array([[counts.sum(axis=0) @ sizes, counts.sum()]], dtype=float))[0])


@pytest.mark.long
@pytest.mark.parametrize("name", ["serial 0.3", "spread 0.03"])
def test_false_alarms_of_the_fit_with_dependent_sizes(name, rng):
    share = studies.rejections(studies.TRUE[name], 20, 600, rng)
    assert agrees(round(600 * share[0]), 600, 0.04, 0.06)
    assert share[1] <= share[0]  # rejected wherever the tail is cut


@pytest.mark.parametrize("name", ["mixture of 0.55 and 0.95", "power law 2.06", "cut-off power law, alpha 0.2"])
def test_other_laws_are_rejected(name, rng):
    assert agrees(round(20 * studies.rejections(studies.FALSE[name], 20, 20, rng)[1]), 20, 0.95, 1.0)


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
    assert min(found.p_values) >= 1 / 10_000  # the signs as observed are one of the patterns: never zero


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
            held += quotient["low"] <= 1 <= quotient["high"]
            total += 1
            if quotient["size"] == 1:
                ones.append((quotient["value"], quotient["high"] - quotient["value"]))
    # Sizes of one ensemble depend on each other: at worst as if each of the 60 were one trial.
    assert abs(held / total - 0.95) <= 3 * np.sqrt(0.05 * 0.95 / 60)
    values, halves = np.array(ones).T  # 60 know a standard deviation to 9%
    assert halves.mean() / (stats.t.ppf(0.975, 19) * values.std(ddof=1)) == pytest.approx(1, abs=0.28)


def test_the_interval_of_a_quotient_by_hand():
    """Three matrices of one mean and number: nothing is projected off, and each has its own quotient."""
    sizes, counts = np.arange(1.0, 5.0), np.array([[850, 350, 150, 150], [720, 520, 200, 60], [785, 435, 175, 105.0]])
    first = quotients(sizes, counts, 0.95)[0]
    own = counts[:, 0] / 800  # 1500 cascades each, of which 8 in 15 have size 1 at rate ln 2
    assert first["value"] == pytest.approx(own.mean())
    assert first["high"] - first["value"] == pytest.approx(4.302652730 * own.std(ddof=1) / np.sqrt(3))  # t, 2 degrees


def test_histograms_of_no_cascade_have_reasons():
    sizes, counts = truncate(np.zeros((3, 5), dtype=int), 1, 10)
    assert goodness(sizes, counts, 0.95, np.random.default_rng(0)).reason
    with pytest.raises(Undefined):
        quotients(sizes, counts, 0.95)
