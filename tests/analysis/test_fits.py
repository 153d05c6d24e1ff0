"""Estimates recover what was planted, intervals cover as often as they say."""

import math

import numpy as np
import pytest

from stickslip.analysis import (
    correlation_time,
    gamma,
    named,
    over_matrices,
    share_over_matrices,
    sizes,
    wilson,
    window,
    with_interval,
)
from stickslip.analysis.series import cascades
from stickslip.analysis.stats import families, student
from stickslip.analysis.stats.compare import mean_difference
from stickslip.analysis.stats.estimates import Estimate, Undefined, ratio


def test_gamma_is_the_maximum_of_the_likelihood():
    total, n = 37.0, 20.0
    rates = np.linspace(0.3, 1.5, 120_001)
    log_likelihood = n * np.log(-np.expm1(-rates)) - rates * (total - n)
    assert gamma(np.array([[total, n]]))[0] == pytest.approx(rates[log_likelihood.argmax()], abs=1e-5)


def test_undefined_rates_are_reasons_not_numbers():
    with pytest.raises(Undefined, match="size 1"):
        gamma(np.array([[5.0, 5.0]]))
    with pytest.raises(Undefined, match="no complete cascade"):
        gamma(np.array([[0.0, 0.0]]))
    ones = over_matrices(gamma, np.array([[5.0, 5.0], [3.0, 3.0]]), 0.95)
    assert (ones.value, ones.low) == (None, None)
    assert "size 1" in ones.reason
    # All that is not size 1 lies in one matrix: a value, but nothing to measure its spread with.
    lone = over_matrices(gamma, np.array([[9.0, 5.0], [3.0, 3.0]]), 0.95)
    assert lone.value is not None
    assert lone.low is None
    assert "left out" in lone.reason


def test_one_matrix_has_no_interval_and_none_has_no_value():
    one = over_matrices(gamma, np.array([[9.0, 5.0]]), 0.95)
    assert one.value == pytest.approx(-np.log(4 / 9))
    assert one.low is None
    assert "one matrix" in one.reason
    assert over_matrices(gamma, np.zeros((0, 2)), 0.95).reason == "no matrix has data"


def test_interval_of_a_mean_is_the_t_interval():
    values = np.array([1.0, 2.0, 4.0, 7.0])
    found = over_matrices(ratio, np.column_stack([values, np.ones(4)]), 0.95)
    half = 3.182446305 * values.std(ddof=1) / 2  # t quantile for 3 degrees of freedom, from tables
    assert (found.low, found.high) == pytest.approx((3.5 - half, 3.5 + half))


def test_paired_difference_removes_what_both_share():
    rng = np.random.default_rng(3)
    shared = rng.uniform(150, 250, 20)
    first, second = (np.column_stack([shared + more, np.full(20, 100.0)]) for more in (0, 1))
    paired = mean_difference(gamma, first, second, paired=True)
    low, high = paired.interval(0.95)
    alone = over_matrices(gamma, second, 0.95)
    assert alone.low is not None
    assert alone.high is not None
    assert paired.difference < 0  # larger sizes, smaller gamma
    assert high - low < 0.05 * (alone.high - alone.low)


def test_correlation_time_says_when_it_cannot_be_known():
    still = correlation_time(window(np.array([0.0]), np.array([3]), 0.0, 10.0))
    assert still.value is None
    assert "does not change" in still.reason
    ramp = correlation_time(window(np.arange(100.0), np.arange(100), 0.0, 100.0))
    assert ramp.reason == "short window"


@pytest.mark.parametrize("dof", [0, -1.0, float("nan")])
def test_degrees_of_freedom_are_positive(dof):
    for ask in (
        lambda: student.half_width(0.95, dof),
        lambda: student.quantile(0.5, dof),
        lambda: student.below(1.0, dof),
        lambda: student.two_sided(1.0, dof),
    ):
        with pytest.raises(ValueError, match="dof: expected degrees of freedom > 0, got"):
            ask()


def test_infinite_degrees_of_freedom_are_the_normal_distribution():
    assert student.half_width(0.95, math.inf) == pytest.approx(1.959963984540054)
    assert student.two_sided(1.959963984540054, math.inf) == pytest.approx(0.05)


WINDOW = window([0.0, 1.0], [1, 0], 0.0, 2.0)
ROWS = np.array([[50.0, 25.0], [30.0, 20.0], [40.0, 22.0]])


@pytest.mark.parametrize("level", [95, 0, 1.0, -0.5, np.nan, "95%"])
def test_a_confidence_that_is_none_is_refused(level):
    for ask in (
        lambda: wilson(3, 10, level),
        lambda: over_matrices(gamma, ROWS, level),
        lambda: over_matrices(gamma, ROWS[:1], level),  # which needs none
        lambda: share_over_matrices([[1, 2], [2, 2]], level),
    ):
        with pytest.raises(ValueError, match=r"^confidence: expected a number between 0 and 1, got .*; write 0\.95$"):
            ask()


@pytest.mark.parametrize(("sums", "why"), [
    ([3, 1, 2, 5], r"expected numbers of shape \(matrices, 2\), got \[3, 1, 2, 5\]; make a row for each matrix"),
    (np.array([[3.0, 1, 2, 5]]), r"expected numbers of shape \(matrices, 2\), got array\(\[\[3., 1., 2., 5.\]\]\)"),
    ([[np.nan, 3.0]], "expected finite numbers, got nan in row 0, column 0"),
    ([[9.0, 3.0], [3.0, np.inf]], "expected finite numbers, got inf in row 1, column 1"),
    ([[3.0, -3.0]], "expected counts >= 0 in column 1, got -3 in row 0"),
    ([[3.0, 5.0]], "expected sizes >= 1, whose total is at least their number, got a total of 3 for 5"),
    ("abc", r"expected numbers of shape \(matrices, 2\), got 'abc'"),
])  # fmt: skip
def test_what_is_no_sums_of_sizes_is_refused(sums, why):
    with pytest.raises(ValueError, match=f"^sums: {why}"):
        gamma(sums)


@pytest.mark.parametrize(("ask", "name"), [
    (lambda: wilson(np.nan, 10, 0.95), "successes, trials"),
    (lambda: wilson("3", 10, 0.95), "successes"),
    (lambda: wilson(3, True, 0.95), "trials"),
    (lambda: wilson([3], 10, 0.95), "successes"),
    (lambda: over_matrices("gamma", ROWS, 0.95), "statistic"),
    (lambda: Estimate(1, 3, 2), "low, high"),
    (lambda: Estimate("1"), "value"),
    (lambda: named("mean", 1.0), "estimate"),
    (lambda: with_interval(1.0), "estimate"),
    (lambda: sizes(WINDOW, "events"), "law"),
    (lambda: sizes([1, 2], cascades.EVENTS), "win"),
    (lambda: correlation_time([1, 2]), "win"),
    (lambda: cascades.Law("drop", "0.5"), "dt"),
    (lambda: window([0, 1], [1, -1], 0, 2), "n_stick"),
    (lambda: window(["0", "1"], [1, 0], 0, 2), "t"),
    (lambda: window([0, 1], [1, 0], "0", 2), "t_start"),
    (lambda: cascades.sample("01", [1, 0], [0.5]), "t"),
    (lambda: cascades.sample([0.0], [1], ["0.5"]), "grid"),
    (lambda: wilson(1, np.inf, 0.95), "successes, trials"),
    (lambda: wilson(-1, 10, 0.95), "successes, trials"),
    (lambda: wilson(0, 0, 0.95), "successes, trials"),
    (lambda: share_over_matrices([[3, 2]], 0.95), "counts"),
    (lambda: share_over_matrices(np.zeros((0, 2)), 0.95), "counts"),
    (lambda: share_over_matrices([[np.nan, 2]], 0.95), "counts"),
    (lambda: over_matrices(ratio, [[1.0, np.inf]], 0.95), "sums"),
    (lambda: over_matrices(ratio, [1.0, 2.0], 0.95), "sums"),
    (lambda: Estimate(0.8, np.nan, 0.9), "low"),
    (lambda: cascades.laws([0.0]), "dt"),
    (lambda: cascades.Law("drop", np.nan), "dt"),
    (lambda: cascades.sample(np.array([0.0]), np.array([1]), np.array([np.nan])), "grid"),
    (lambda: cascades.sample(np.zeros(0), np.zeros(0, int), np.array([1.0])), "t"),
    (lambda: cascades.window([0, 1], [1, 2], 0, np.inf), "t_stop"),
    (lambda: families.maximise(families.EXPONENTIAL, np.arange(1.0, 4.0), np.array([5, np.nan, 1])), "counts"),
    (lambda: families.maximise(families.EXPONENTIAL, np.arange(1.0, 4.0), np.array([5, 1])), "counts"),
])  # fmt: skip
def test_statistics_refuse_what_they_cannot_mean(ask, name):
    with pytest.raises(ValueError, match=f"^{name}: expected .*, got .*; "):
        ask()
