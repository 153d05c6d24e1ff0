"""The test of fit, each size over the fitted law, the line through the log histogram."""

import numpy as np
import pytest

from stickslip.analysis.stats.estimates import gamma
from stickslip.analysis.stats.goodness import REJECTED, UNKNOWN, goodness
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


def test_histograms_of_no_cascade_have_reasons():
    assert goodness(np.arange(1.0, 11.0), np.zeros((3, 10)), 0.95, np.random.default_rng(0)).reason
