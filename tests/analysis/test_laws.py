"""Two methods by whole laws: gaps, shares and order in closed form, and how often they are told apart."""

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis.models import laws
from stickslip.analysis.stats import flips
from stickslip.analysis.stats.estimates import Undefined
from tests.analysis import studies
from tests.chance import agrees


def times(some, n):
    return [some] * n


def test_the_largest_gap_is_that_of_kolmogorov_and_smirnov(rng):
    """1 to 10 against 4 to 13: at 3 the first has 0.3 and the second nothing."""
    found = laws.largest_gap(times((np.arange(1, 11), np.arange(4, 14)), 8), 0.95, rng)
    assert (found.size.value, found.size.low, found.size.high) == pytest.approx((0.3, 0.3, 0.3))
    assert 3 <= found.at <= 10
    assert found.below == pytest.approx(-0.3)
    assert found.p_different == found.p_floor == 2 / 2**8


def test_differences_that_go_either_way_are_none(rng):
    low, high = np.arange(10), np.arange(5, 15)
    found = laws.largest_gap([(low, high), (high, low)] * 6, 0.95, rng)
    assert found.size.value == pytest.approx(0.0)
    assert found.p_different == 1


def test_a_system_that_one_method_has_no_value_of_is_left_out(rng):
    pair = (np.arange(1, 11), np.arange(4, 14))
    found = laws.largest_gap([*times(pair, 8), (np.arange(5), np.zeros(0))], 0.95, rng)
    assert found.size.value == pytest.approx(0.3)


def test_swaps_change_neither_gap_nor_p(rng):
    """Which method comes first is a matter of names."""
    pairs = studies.shifted(rng, 0.1, 0.5)
    one, other = (
        laws.largest_gap(some, 0.95, np.random.default_rng(0)) for some in (pairs, [(b, a) for a, b in pairs])
    )
    assert (one.size.value, one.size.low, one.p_different) == pytest.approx(
        (other.size.value, other.size.low, other.p_different)
    )


def test_shares_that_are_swapped_in_every_system_are_as_far_apart_as_can_be(rng):
    first, second = np.array([[6, 0], [6, 0]]), np.array([[0, 6], [0, 6]])
    found = laws.distance_of_shares([(first, second), (second, first)] * 6, 0.95, rng)
    assert found.size.value == pytest.approx(np.sqrt(2))
    assert found.p_different == found.p_floor == 1 / 2**12


def test_an_estimate_below_zero_makes_no_interval_short(rng):
    """Shares that go to one side in one half and to the other in the next: zero, and its error beyond."""
    flat, tilts = np.full((2, 2), 50), rng.integers(5, 20, 12)
    pairs = [(flat, 50 + tilt * np.array([[1, -1], [-1, 1]])) for tilt in tilts]
    found = laws.distance_of_shares(pairs, 0.95, rng)
    apart = -2 * (tilts / 100) ** 2
    scale = np.array([np.sum(np.prod(b / 100, axis=0)) + 0.5 for _, b in pairs]) / 2
    left_out = (apart.sum() - apart) / (scale.sum() - scale)
    error = np.sqrt(11 / 12 * np.sum((left_out - left_out.mean()) ** 2))
    assert (found.size.value, found.size.low) == (0.0, 0.0)
    assert found.size.high == pytest.approx(np.sqrt(stats.t.ppf(0.975, 11) * error))


def test_order_is_told_apart_by_its_sign(rng):
    up, down = (np.column_stack([np.arange(9), np.arange(9)[::step]]) for step in (1, -1))
    found = laws.difference_of_order(times((up, down), 8), 0.95, rng)
    assert found.size.value == pytest.approx(-2)
    assert found.p_different == found.p_floor == 2 / 2**8


@pytest.mark.parametrize("test", [laws.largest_gap, laws.difference_of_order])
def test_too_few_systems_give_no_verdict(test, rng):
    some = np.column_stack([np.arange(9), np.arange(9)])
    with pytest.raises(Undefined, match="few matrices"):
        test(times((some, some), 5), 0.95, rng)


def test_what_is_one_value_by_both_is_no_agreement(rng):
    with pytest.raises(Undefined, match="one value"):
        laws.largest_gap(times((np.ones(5), np.ones(9)), 8), 0.95, rng)
    counts = np.array([[0, 3], [0, 4]])
    with pytest.raises(Undefined, match="one value"):
        laws.distance_of_shares(times((counts, counts), 8), 0.95, rng)


@pytest.mark.parametrize("name", ["gap, shift {}, rho 0.7", "shares, mixed {}", "order, 0.3 to {}"])
def test_one_law_is_told_apart_in_a_twentieth_and_another_more_often(name, rng, monkeypatch):
    """Series that remember three values, of 12 systems."""
    monkeypatch.setattr(flips, "PATTERNS", 500)
    same, other = {"gap": (0, 0.2), "sha": (0, 0.2), "ord": (0.3, 0.4)}[name[:3]]
    hits, held = [], 0
    for value in (same, other):
        test, draw, how, answer = studies.PLANTED_LAWS[name.format(f"{value:g}")]
        found = [test(draw(rng, *how), 0.95, rng) for _ in range(60)]
        hits.append(sum(one.p_different < 0.05 for one in found))
        held += sum(one.size.low <= answer <= one.size.high for one in found)
    assert agrees(hits[0], 60, 0.03, 0.07)
    assert agrees(hits[1], 60, 0.8, 1.0)
    assert agrees(held, 120, 0.93, 1.0)
