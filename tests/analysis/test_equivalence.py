"""Differences of two means, shares and their intervals: closed forms and textbooks."""

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis.stats import student
from stickslip.analysis.stats.compare import Compared, against, bounded_difference, bounded_ratio, mean_difference
from stickslip.analysis.stats.estimates import Undefined, over_matrices, ratio
from stickslip.analysis.stats.multiplicity import holm
from stickslip.analysis.stats.shares import Proportion, mean_share, mean_within, share_over_matrices, wilson


def test_the_test_agrees_with_its_interval():
    for difference in np.linspace(-0.2, 0.2, 41):
        test = Compared(difference, 0.03, 19)
        low, high = test.interval(0.95)
        assert (test.p_different < 0.05) == (not low <= 0 <= high)


def test_independent_is_welch():
    rng = np.random.default_rng(0)
    first, second = rng.normal(0, 1, 12), rng.normal(0.5, 3, 20)
    sums = (np.column_stack([values, np.ones_like(values)]) for values in (first, second))
    test = mean_difference(ratio, *sums, paired=False)
    known = stats.ttest_ind(second, first, equal_var=False)
    assert test.difference / test.error == pytest.approx(known.statistic)
    assert (test.dof, test.p_different) == pytest.approx((known.df, known.pvalue))


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
    """Shares 1/2 + e of four runs each, e = 1/4, -1/4, 0 thrice each: variance 9/8 * 6 / 16 / 81 = 1/192, of 1/4.

    The kurtosis is 9 * 6 / 6^2 = 1.5, below that of nine normal numbers: the variance has 8 degrees of freedom.
    """
    counts = np.repeat([[3, 4], [1, 4], [2, 4]], 3, axis=0)
    share, low, high, trials = share_over_matrices(counts, 0.95)
    most = stats.norm.isf(0.025) ** 2 / stats.t(8).isf(0.025) ** 2 * 48
    assert (share, trials) == (0.5, pytest.approx(most))
    assert (low, high) == pytest.approx(wilson(most / 2, most, 0.95))


def test_runs_that_agree_too_well_are_worth_no_more_than_they_are():
    """One of two runs in each of ten systems: they do not scatter, but there are twenty runs."""
    share, low, high, trials = share_over_matrices([[1, 2]] * 10, 0.95)
    assert (share, low, high, trials) == (0.5, *wilson(10, 20, 0.95), 20)


def test_scatter_that_a_few_matrices_make_is_hardly_known():
    """Of n, one differs: its distance is n - 1 times that of the others, and the kurtosis n - 2 + 1 / (n - 1)."""
    for n in (3, 5, 12, 100):
        far, near = (n - 1.0) ** 2, 1.0
        concentration = (far**2 + (n - 1) * near**2) / (far + (n - 1) * near) ** 2
        normal = 3 * (n - 1) / (n + 1)
        kurtosis = n - 2 + 1 / (n - 1)
        dof = student.dof_of_scatter(n, concentration)
        assert dof == pytest.approx((n - 1) * (normal - 1) / (kurtosis - 1))
        assert 1.6 < dof <= 2.1
        assert student.dof_of_scatter(n, 1 / n) == n - 1  # half of them above, half below
    assert student.dof_of_scatter(2, 0.5) == student.dof_of_scatter(1, 0.0) == 1
    assert student.worth(1.959963984540054, np.inf) == pytest.approx(1.0)


def test_what_all_systems_share_is_exact_but_for_a_bound_that_runs_reach_or_not():
    """12 systems at worst agree within themselves: as many trials. A share of time is no count of such."""
    known = stats.binomtest(0, 12).proportion_ci(0.95, method="wilson")
    none = mean_within(np.array([[0.0, 1.0]] * 12), 1.0, 0.95)
    assert (none.value, none.low, none.high) == (0.0, 0.0, pytest.approx(known.high))
    all_of_it = mean_within(np.array([[5.0, 1.0]] * 12), 5.0, 0.95)
    assert (all_of_it.value, all_of_it.low, all_of_it.high) == (5.0, pytest.approx(5 * (1 - known.high)), 5.0)
    for share in (0.0, 0.5, 1.0):
        alike = mean_share(np.array([[share, 1.0]] * 12), 1.0, 0.95)
        assert (alike.value, alike.low, alike.high) == (share, share, share)
    alone = mean_share(np.array([[0.0, 1.0]]), 1.0, 0.95)
    assert (alone.low, alone.reason) == (None, "one matrix")


def test_shares_far_from_their_bounds_have_students_interval(rng):
    """With the degrees of freedom that the kurtosis of the shares leaves their variance."""
    values = 0.5 + 1e-3 * rng.standard_normal(12)
    far = (values - values.mean()) ** 2
    dof = student.dof_of_scatter(12, np.sum(far**2) / far.sum() ** 2)
    half = stats.t(dof).isf(0.025) * values.std(ddof=1) / np.sqrt(12)
    share = mean_within(np.column_stack([values, np.ones(12)]), 1.0, 0.95)
    assert share.value == pytest.approx(values.mean())
    assert (share.low, share.high) == pytest.approx((share.value - half, share.value + half), abs=1e-5)


def test_rows_without_data_are_no_systems(rng):
    sums = np.column_stack([rng.poisson(30.0, 8), rng.integers(5, 9, 8)]).astype(float)
    sums[:, 0] = np.minimum(sums[:, 0], sums[:, 1] - 1)
    padded = np.insert(sums, [0, 3, 8], 0.0, axis=0)
    assert over_matrices(ratio, padded, 0.95) == over_matrices(ratio, sums, 0.95)
    assert share_over_matrices(padded, 0.95) == share_over_matrices(sums, 0.95)
    assert mean_within(padded, 1.0, 0.95) == mean_within(sums, 1.0, 0.95)
    assert against(lambda rows: ratio(rows) - 0.5, padded) == against(lambda rows: ratio(rows) - 0.5, sums)
    assert over_matrices(ratio, padded[:2], 0.95).reason == "one matrix"


def test_a_ratio_of_bounded_means_inverts_the_interval_of_a_difference(rng):
    """With shares a and b and r an end, an end of the interval of b - r a, by Newcombe, is zero."""
    rows = [np.column_stack([rng.beta(2, b, 30), np.ones(30)]) for b in (5, 3)]
    z = stats.norm.isf(0.025)
    test = bounded_ratio(*rows, False, 1.0)
    p, q = (Proportion.of(some) for some in rows)
    (low_p, high_p), (low_q, high_q) = p.ends(z), q.ends(z)
    low, high = (end + 1.0 for end in test.interval(0.95))
    assert q.share - low * p.share == pytest.approx(np.hypot(q.share - low_q, low * (high_p - p.share)))
    assert high * p.share - q.share == pytest.approx(np.hypot(high_q - q.share, high * (p.share - low_p)))
    assert min(map(abs, test.interval(1 - test.p_different))) == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(Undefined, match="first value is zero"):
        bounded_ratio(0.0 * rows[0] + [0.0, 1.0], rows[1], True, 1.0)


def test_paired_means_differ_by_their_pairs():
    """Eight systems lose 0.1 to 0.4 of their blocks, from all of them: paired, that is far from none."""
    lost = np.linspace(0.1, 0.4, 8)
    first, second = (np.column_stack([3.0 * some, np.ones(8)]) for some in (np.ones(8), 1.0 - lost))
    test, known = bounded_difference(first, second, True, 3.0), stats.ttest_1samp(-3.0 * lost, 0.0)
    assert (test.difference, test.p_different) == (pytest.approx(-0.75), pytest.approx(known.pvalue))
    assert bounded_ratio(first, second, True, 3.0).interval(0.95) == pytest.approx(
        [end / 3.0 for end in test.interval(0.95)]
    )
    low, high = bounded_difference(first, first, True, 3.0).interval(0.95)
    assert low == -high < -0.1  # none differs, of so few
