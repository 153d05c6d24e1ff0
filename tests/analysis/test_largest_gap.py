"""Two methods by the gap of their laws: in closed form, and how often they are told apart."""

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis.models.largest_gap import distance, largest_gap
from stickslip.analysis.stats import flips
from stickslip.analysis.stats.estimates import Undefined
from tests.analysis import studies
from tests.chance import agrees


def times(some, n):
    return [some] * n


def test_the_largest_gap_is_that_of_kolmogorov_and_smirnov(rng):
    """1 to 10 against 4 to 13: at 3 the first has 0.3 and the second nothing."""
    found = largest_gap(times((np.arange(1, 11), np.arange(4, 14)), 8), 0.95, rng)
    assert (found.size.value, found.size.low, found.size.high) == pytest.approx((0.3, 0.3, 0.3))
    assert found.p_different == found.p_floor == 2 / 2**8


def test_the_largest_gap_is_found_between_the_quantiles_at_which_it_is_tested(rng):
    """It lies at one of 3,000 jumps."""
    a, b = rng.normal(size=2000), rng.normal(0.05, size=1000)
    found = largest_gap(times((a, b), 8), 0.95, rng)
    assert found.size.value == pytest.approx(stats.ks_2samp(a, b).statistic, rel=1e-12)
    assert found.size.low <= found.size.value <= found.size.high


def test_values_at_which_many_are_equal_count_as_below(rng):
    found = largest_gap(times((np.array([0, 0, 0, 1]), np.array([0, 1, 1, 1])), 8), 0.95, rng)
    assert found.size.value == pytest.approx(0.5)


def test_the_upper_end_of_one_difference_is_students(rng):
    shifts = rng.normal(1.0, 0.1, 9)
    found = distance(0.3 * shifts[:, None] / 9, np.full(9, 1 / 9), 0.95, rng)
    known = 0.3 * (shifts.mean() + stats.t(8).isf(0.025) * stats.sem(shifts))
    assert found.size.high == pytest.approx(known)


def test_differences_that_go_either_way_are_none(rng):
    low, high = np.arange(10), np.arange(5, 15)
    found = largest_gap([(low, high), (high, low)] * 6, 0.95, rng)
    assert found.size.value == pytest.approx(0.0)
    assert found.p_different == 1


def test_a_system_that_one_method_has_no_value_of_is_left_out(rng):
    pair = (np.arange(1, 11), np.arange(4, 14))
    found = largest_gap([*times(pair, 8), (np.arange(5), np.zeros(0))], 0.95, rng)
    assert found.size.value == pytest.approx(0.3)


def test_swaps_change_neither_gap_nor_p(rng):
    """Which method comes first is a matter of names."""
    pairs = studies.shifted(rng, 0.1, 0.5)
    one, other = (largest_gap(some, 0.95, np.random.default_rng(0)) for some in (pairs, [(b, a) for a, b in pairs]))
    assert (one.size.value, one.size.low, one.p_different) == pytest.approx(
        (other.size.value, other.size.low, other.p_different)
    )


def test_too_few_systems_give_no_verdict(rng):
    with pytest.raises(Undefined, match="few matrices"):
        largest_gap(times((np.arange(9), np.arange(9)), 5), 0.95, rng)


def test_what_is_one_value_by_both_is_no_agreement(rng):
    with pytest.raises(Undefined, match="one value"):
        largest_gap(times((np.ones(5), np.ones(9)), 8), 0.95, rng)


def test_one_law_is_told_apart_in_a_twentieth_and_another_more_often(rng, monkeypatch):
    """Series that remember three values, of 12 systems."""
    monkeypatch.setattr(flips, "PATTERNS", 500)
    hits, held = [], 0
    for shift in (0.0, 0.2):
        how, answer = studies.PLANTED_LAWS[f"gap, shift {shift:g}, rho 0.7"]
        found = [largest_gap(studies.shifted(rng, *how), 0.95, rng) for _ in range(60)]
        hits.append(sum(one.p_different < 0.05 for one in found))
        held += sum(one.size.low <= answer <= one.size.high for one in found)
    assert agrees(hits[0], 60, 0.03, 0.07)
    assert agrees(hits[1], 60, 0.8, 1.0)
    assert agrees(held, 120, 0.93, 1.0)
