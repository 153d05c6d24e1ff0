"""Tests by flipping signs: exact where all patterns can be tried, and never below their floor."""

import itertools

import numpy as np
import pytest

from stickslip.analysis.stats import flips


@pytest.mark.parametrize("n", [1, 5, 8, 13])
def test_every_pattern_is_tried_once_where_they_are_few(n, rng):
    found = flips.patterns(n, rng)
    assert {tuple(row) for row in found} == set(itertools.product((-1.0, 1.0), repeat=n))
    assert len(found) == 2**n
    assert (found[0] == 1).all()


def test_of_many_systems_some_patterns_are_drawn(rng):
    found = flips.patterns(30, rng)
    assert found.shape == (flips.PATTERNS, 30)
    assert (found[0] == 1).all()


@pytest.mark.parametrize("n", [6, 8, 13, 14, 20])
def test_the_most_extreme_has_the_floor_and_no_less(n, rng):
    """All systems on one side: two patterns of 2^n, that and its mirror image, are as extreme."""
    for _ in range(20 if n > 13 else 1):
        sums = np.abs(flips.patterns(n, rng) @ np.ones(n))
        assert flips.p_value(sums, flips.floor(n)) >= flips.floor(n)
    assert flips.floor(n) == pytest.approx(max(2.0 ** (1 - n), 1e-4))
    if n <= 13:
        assert flips.p_value(sums, flips.floor(n)) == flips.floor(n) == 2 / 2**n
