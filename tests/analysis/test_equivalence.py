"""Equivalence of two means, shares and their intervals: closed forms and textbooks."""

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis.stats.compare import (
    equivalence_test,
    mean_difference,
    share_over_matrices,
    wilson,
)
from stickslip.analysis.stats.estimates import ratio
from stickslip.analysis.stats.multiplicity import holm


def test_the_tests_agree_with_their_intervals():
    for difference in np.linspace(-0.2, 0.2, 41):
        test = equivalence_test(difference, 0.03, 19, 0.1)
        low, high = test.interval(0.90)
        assert (test.p_equivalent < 0.05) == (low > -0.1 and high < 0.1)
        low, high = test.interval(0.95)
        assert (test.p_different < 0.05) == (not low <= 0 <= high)


def test_independent_is_welch():
    rng = np.random.default_rng(0)
    first, second = rng.normal(0, 1, 12), rng.normal(0.5, 3, 20)
    sums = (np.column_stack([values, np.ones_like(values)]) for values in (first, second))
    difference, error, dof = mean_difference(ratio, *sums, paired=False)
    known = stats.ttest_ind(second, first, equal_var=False)
    assert difference / error == pytest.approx(known.statistic)
    assert dof == pytest.approx(known.df)


def test_holm_against_the_textbook():
    # sorted 0.005, 0.01, 0.03, 0.04 times 4, 3, 2, 1, made monotone (Holm 1979)
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])


def test_wilson_against_scipy():
    for k in (0, 3, 20):
        known = stats.binomtest(k, 20).proportion_ci(0.95, method="wilson")
        assert wilson(k, 20, 0.95) == pytest.approx((known.low, known.high))


def test_runs_of_one_matrix_are_not_independent():
    alike = np.array([[3, 3], [0, 3]] * 10)  # draws of a matrix agree: 20 trials, not 60
    _, _, _, trials = share_over_matrices(alike, 0.95)
    assert trials == pytest.approx(20, abs=1.1)


def test_what_the_runs_of_matrices_are_worth_by_hand():
    """Shares 1, 0, 1/2, 1/2 of two runs each: residuals 1, -1, 0, 0, variance 4/3 * 2 / 64 = 1/24 of 1/4."""
    share, low, high, trials = share_over_matrices(np.array([[2, 2], [0, 2], [1, 2], [1, 2]]), 0.95)
    assert (share, trials) == (0.5, pytest.approx(6))
    assert (low, high) == pytest.approx(wilson(3, 6, 0.95))
