"""Times that the end of a run may cut off: published and closed forms, and what is refused."""

from functools import partial

import numpy as np
import pytest

from stickslip.analysis.models.fates import SUSTAINED, survival
from stickslip.analysis.models.times import Times, median_difference
from stickslip.analysis.stats.compare import mean_difference
from stickslip.analysis.stats.estimates import Undefined, over_matrices, ratio
from stickslip.analysis.stats.shares import mean_within, wilson

#: Weeks of remission under 6-MP (Freireich and others 1963; Gehan 1965): seen to end, and followed without.
ENDED, FOLLOWED = [6, 6, 6, 7, 10, 13, 16, 22, 23], [6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
REMISSION = Times.of_runs(np.arange(21), np.array(ENDED + FOLLOWED, dtype=float), np.arange(21) < 9)


def seen(times, runs=1):
    units = np.repeat(np.arange(len(times) // runs), runs)
    return Times.of_runs(units, np.asarray(times, dtype=float), np.ones(len(times), dtype=bool))


def test_published_remissions():
    """Median 23 weeks; mean to week 35 23.29, its error 2.83 by Greenwood (R's survival, `rmean = 35`)."""
    found = REMISSION.median(0.95)
    assert (found.value, REMISSION.n_censored) == (23.0, 12)
    mean = over_matrices(ratio, REMISSION.restricted(35.0).rows, 0.95)
    assert mean.value == pytest.approx(23.287, abs=1e-3)
    scatter = REMISSION.restricted(35.0).rows[:, 0].std(ddof=1) / np.sqrt(21)
    assert scatter == pytest.approx(2.83, rel=0.05)


def test_pseudo_values_are_those_of_leaving_out_a_unit(rng):
    """The jackknife's, but for terms of the second order; with units of several runs, and ties."""
    times, cut = np.ceil(10 * rng.exponential(1.0, 600)), rng.uniform(5.0, 40.0, 600)
    units = np.arange(600) // 3
    every = Times.of_runs(units, np.minimum(times, cut), times <= cut)
    values = every.restricted(15.0).rows[:, 0]
    left_out = [
        every.within(seen(np.ones(200)))
        .of_runs(units[units != unit], np.minimum(times, cut)[units != unit], (times <= cut)[units != unit])
        .restricted(15.0)
        .rows[:, 0]
        .mean()
        for unit in range(200)
    ]
    exact = 200 * values.mean() - 199 * np.array(left_out)
    assert np.abs(values - exact).max() < 0.1 * exact.std()


def test_where_nothing_is_cut_off_the_restricted_mean_is_the_mean(rng):
    """Each value is a sum of 40 terms, of 5 times the longest time in all, of shares with 80 roundings."""
    times = rng.exponential(10.0, 40)
    same = partial(np.testing.assert_allclose, rtol=0, atol=5 * (40 + 80) * np.finfo(float).eps * times.max())
    same(seen(times).restricted(1e3).rows[:, 0], times)
    same(seen(times).restricted(12.0).rows[:, 0], np.minimum(times, 12.0))
    same(seen(times, 4).restricted(1e3).rows[:, 0], times.reshape(-1, 4).mean(axis=1))


def test_the_same_systems_are_paired(rng):
    """Systems differ by far more than the change: only pairs show it."""
    own = 10.0 * np.exp(rng.standard_normal(60))
    first, second = seen(own * 1.001), seen(1.05 * own)
    for differ in (
        lambda paired: median_difference(first, second, paired, is_relative=True),
        lambda paired: mean_difference(ratio, first.restricted(1e4).rows, second.restricted(1e4).rows, paired),
    ):
        together, apart = differ(True), differ(False)
        assert together.difference > 0
        assert together.error < 0.3 * apart.error


def test_what_half_of_the_runs_do_not_have_is_not_reached():
    few = Times.of_runs(np.arange(20), np.full(20, 10.0), np.arange(20) < 6)
    found = few.median(0.95)
    assert (found.value, found.high) == (None, None)
    assert found.reason == "not reached: 70% without it at t = 10"
    with pytest.raises(Undefined, match="not reached: 70%"):
        median_difference(few, seen(np.arange(1.0, 21.0)), True)
    assert few.restricted(10.0).rows[:, 0].mean() == pytest.approx(10.0)
    none = Times.of_runs(np.arange(4), np.full(4, 10.0), np.zeros(4, dtype=bool))
    assert none.median(0.95).reason == "not reached: 100% without it at t = 10"
    np.testing.assert_array_equal(none.restricted(8.0).rows[:, 0], 8.0)
    for limit in (12.0, 0.0, np.nan, np.inf):
        with pytest.raises(ValueError, match=rf"limit: expected a time > 0 .*, at most 10, got {limit:g}; change it"):
            none.restricted(limit)


def test_a_median_that_no_run_has_is_later_than_all_were_followed():
    """Six systems of three runs, of which none has it by t = 10, or four have: half of them have it later."""
    units = np.repeat(np.arange(6), 3)
    none = Times.of_runs(units, np.full(18, 10.0), np.zeros(18, dtype=bool))
    assert none.median(0.95).low == 10.0
    few = Times.of_runs(units, np.where(np.arange(18) % 5, 10.0, 4.0), np.arange(18) % 5 == 0)
    assert (few.median(0.95).value, few.median(0.95).high) == (None, None)
    assert few.median(0.95).low == 10.0
    early = Times.of_runs(units, np.repeat([2.0, 10.0], 9), np.zeros(18, dtype=bool))  # half of them not for long
    assert early.median(0.95).low == 2.0
    hows = np.full(18, SUSTAINED, dtype=object)
    assert survival(hows, np.full(18, 9.0), np.full(18, 10.0), np.full(18, 10.0), 0.95, units).median.low == 10.0


def test_a_restricted_mean_has_an_interval_however_few_runs_have_it():
    """The time that is lost, over the limit, lies between 0 and 1: none of 12 has it, and one, at 4 of 10."""
    alone = np.arange(12)
    none = Times.of_runs(alone, np.full(12, 10.0), np.zeros(12, dtype=bool)).restricted(10.0).rows
    found = mean_within(none, 10.0, 0.95)
    assert (found.value, found.high) == (10.0, 10.0)
    assert found.low == pytest.approx(10.0 * wilson(12, 12, 0.95)[0])
    first = Times.of_runs(alone, np.where(alone == 0, 4.0, 10.0), alone == 0).restricted(10.0).rows
    one = mean_within(first, 10.0, 0.95)
    assert one.value == pytest.approx(9.5)
    assert one.low < found.low
    assert 9.5 < one.high < 10.0


def test_one_system_has_no_interval():
    """One run of a system with one time: of other systems it says nothing."""
    for is_counted in (False, True):
        alone = mean_within(np.array([[1.0, 1.0]]), 4.0, 0.95, is_counted)
        assert (alone.value, alone.low, alone.high, alone.reason) == (1.0, None, None, "one matrix")


def test_many_times_alike_are_compared():
    """Three quarters of the runs of one setting have it at once; of the other, spread over 8 to 12."""
    first = seen([0.0] * 30 + [1.0] * 10)
    second = seen(np.linspace(8.0, 12.0, 40))
    found = median_difference(first, second, False)
    assert found.difference == pytest.approx(10.0, abs=0.1)
    assert 0 < found.error < 1.0
    assert found.dof == 39
    with pytest.raises(Undefined, match="the first value is zero"):
        median_difference(first, second, False, is_relative=True)
    same = median_difference(seen([3.0] * 20), seen([3.0] * 20), True)
    assert (same.difference, same.error) == (0.0, 0.0)


def test_a_median_is_known_no_better_than_from_as_many_independent_runs():
    """Of nearly all systems one run is below the median and the other above, so that their shares hardly differ."""
    quantiles = (np.arange(40) + 0.5) / 40
    pairs = np.column_stack([quantiles[:20], quantiles[:19:-1]])
    pairs[[0, 1], [1, 0]] = pairs[[1, 0], [0, 1]]  # both low, and both high
    alike, independent = seen(pairs.ravel(), 2), seen(pairs.ravel())
    errors = [median_difference(times, times, False).error for times in (alike, independent)]
    assert errors[0] == pytest.approx(errors[1], rel=0.1)


def test_settings_together_keep_their_runs():
    first, second = seen([1.0, 2.0, 3.0]), seen([4.0, 5.0, 6.0, 7.0])
    both = Times.together([first, second])
    assert (len(both), len(both.times)) == (4, 7)
    assert both.median(0.5).value == 4.0
    assert both.rows.tolist() == [[5.0, 2.0], [7.0, 2.0], [9.0, 2.0], [7.0, 1.0]]
    assert second.within(first).times.tolist() == [4.0, 5.0, 6.0]


def test_the_error_of_a_median_is_that_of_the_mirror_image(rng):
    """The curve is read between its steps, half way up: else late times would count otherwise than early ones."""
    drawn, units = rng.weibull(1.5, 41), np.arange(41)
    early, late = (Times.of_runs(units, t, np.ones(41, dtype=bool)) for t in (drawn, 9.0 - drawn))
    errors = [median_difference(times, times, paired=False).error for times in (early, late)]
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)
