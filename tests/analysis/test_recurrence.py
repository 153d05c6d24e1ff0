"""Times between large events: planted renewals that windows cut off, planted aftershocks and predictability."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis.models.episodes import Catalogue
from stickslip.analysis.models.recurrence import _products, recurrence
from tests.chance import SURE, agrees

MEAN, SPAN = 10.0, 200.0


def run(start, moment, t_start=0.0, t_stop=SPAN):
    """A catalogue of events that take no time, in order, within the window."""
    order = np.argsort(start)
    start, moment = np.asarray(start)[order], np.asarray(moment)[order]
    inside = (start >= t_start) & (start < t_stop)
    n = int(inside.sum())
    return Catalogue(t_start, t_stop, start[inside], np.zeros(n), np.ones(n, int), moment[inside], 1.0)


def renewals(rng, shape, t_stop=SPAN):
    """Large events of a renewal process of gamma times in its steady state, which the window cuts at both ends."""
    times = -20 * MEAN + np.cumsum(rng.gamma(shape, MEAN / shape, int(40 + 2 * t_stop / MEAN)))
    return times[(times >= 0) & (times < t_stop)]


@pytest.mark.parametrize("shape", [1.0, 4.0])
def test_mean_and_scatter_are_covered_though_windows_cut_times_off(rng, shape):
    """Windows of twenty mean times; 12 systems. The ends that are cut off are long ones."""
    held = np.zeros(2, int)
    for _ in range(60):
        systems = [[run(at, np.full(len(at), 100.0))] for at in (renewals(rng, shape) for _ in range(12))]
        found = recurrence(systems, 1.0, 0.95)
        assert found.n_cut == 12
        for k, (estimate, planted) in enumerate(((found.mean, MEAN), (found.cv, shape**-0.5))):
            held[k] += estimate.low <= planted <= estimate.high
    assert all(agrees(int(n), 60, 0.88, 0.98) for n in held), held


def test_the_mean_of_times_that_lie_in_the_window_would_be_too_short(rng):
    """Windows of six mean times, and 400 of them: a Poisson process has the mean, and one hazard at all times."""
    many = (renewals(rng, 1.0, 6 * MEAN) for _ in range(400))
    systems = [[run(at, np.ones(len(at)), t_stop=6 * MEAN)] for at in many]
    inside = np.concatenate([np.diff(runs[0].start) for runs in systems])
    found = recurrence(systems, 0.0, SURE)
    assert inside.mean() < 0.9 * MEAN
    assert found.mean.low < MEAN < found.mean.high
    hazard = [each for each in found.bins if each.what == "hazard"]
    assert len(hazard) == 7
    assert all(each.relative.low < 1.0 < each.relative.high for each in hazard)


def test_times_between_are_from_end_to_begin_but_where_events_take_no_time_of_the_belt():
    """A clock of ten units, whose events last four; 12 systems."""
    start = np.arange(5.0, SPAN, 10.0)
    for is_loaded, between in ((False, 6.0), (True, 10.0)):
        event = run(start, np.ones(len(start)))
        event = replace(event, duration=np.full(len(start), 4.0), is_loaded=is_loaded)
        found = recurrence([[event]] * 12, 0.0, 0.95)
        assert found.mean.value == pytest.approx(between, rel=1e-12)


def test_an_interval_is_over_systems_and_a_bin_without_events_has_the_limit_of_a_poisson_count(rng):
    """Copies of a run in a system tell no more; a clock never rings in the first quarter of its period."""
    runs = [run(at, rng.uniform(1.0, 2.0, len(at))) for at in (renewals(rng, 4.0) for _ in range(8))]
    once, twice = (recurrence([[one] * n for one in runs], 0.0, 0.95) for n in (1, 2))
    for name in ("mean", "cv", "before", "after"):
        alone, copied = (getattr(found, name) for found in (once, twice))
        assert (copied.value, copied.low, copied.high) == pytest.approx((alone.value, alone.low, alone.high))
    clock = run(np.arange(5.0, SPAN, 10.0), np.ones(20))
    hazard = recurrence([[clock]] * 12, 0.0, 0.95).bins[0]
    assert (hazard.n_events, hazard.relative.low) == (0, 0.0)
    assert hazard.relative.high == pytest.approx(stats.chi2.isf(0.025, 2) / 2 / (0.25 * 12 * 20))


def test_equal_moments_share_their_rank(rng):
    for values in (rng.normal(size=9), rng.integers(0, 4, 30), np.ones(3)):
        rank = (stats.rankdata(values) - (len(values) + 1) / 2) / len(values)
        np.testing.assert_allclose(_products(values, -values), rank @ rank * np.array([1, 1, -1]), rtol=1e-14)


def test_windows_too_short_for_a_mean_say_so(rng):
    systems = [[run(rng.uniform(0, MEAN / 2, 2), np.ones(2), t_stop=MEAN / 2)] for _ in range(20)]
    found = recurrence(systems, 0.0, 0.95)
    assert found.cv.value is None
    assert "too short" in found.cv.reason
    assert found.bins == []
    few = recurrence([[run([], [])], [run([1.0, 2.0], [1.0, 1.0])]], 0.0, 0.95)
    assert few.mean.reason.startswith("fewer than")


def test_activity_after_and_before_large_events_is_as_planted(rng):
    """Small events at a rate of 5, at twice that in the first tenth of each time after a large one."""
    systems = []
    for _ in range(16):
        large = renewals(rng, 4.0)
        small = rng.uniform(0, SPAN, rng.poisson(5 * SPAN))
        shocks = np.concatenate([at + rng.uniform(0, 1.0, rng.poisson(5.0)) for at in large])
        start = np.concatenate([large, small, shocks])
        systems.append([run(start, np.append(np.full(len(large), 100.0), np.full(len(small) + len(shocks), 0.1)))])
    found = recurrence(systems, 0.0, SURE)
    after, before = ({each.high: each for each in found.bins if each.what == what} for what in ("after", "before"))
    at_rest = after[1.0].relative
    for edge in (0.02, 0.05):
        assert after[edge].relative.low < 2 * at_rest.high
        assert after[edge].relative.high > 2 * at_rest.low
        assert before[edge].relative.low < at_rest.high
        assert before[edge].relative.value < after[edge].relative.value
    assert after[0.05].relative.low > at_rest.high


@pytest.mark.parametrize("side", ["before", "after"])
def test_predictability_is_told_from_chance(rng, side):
    """The moment is the time on one side, and has nothing to do with that on the other."""
    systems = []
    for _ in range(20):
        start = renewals(rng, 2.0, 2 * SPAN)
        waits = np.diff(start)
        moment = 2.0 + (np.append(MEAN, waits) if side == "before" else np.append(waits, MEAN))
        systems.append([run(start, moment, t_stop=2 * SPAN)])
    found = recurrence(systems, 0.0, SURE)
    known, chance = (found.before, found.after) if side == "before" else (found.after, found.before)
    assert known.value == pytest.approx(1.0)
    assert chance.low < 0.1
    assert chance.high > -0.1
    assert abs(chance.value) < 0.5
