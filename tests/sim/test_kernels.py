"""What the engines share: roots of polynomials that were planted."""

import numba
import numpy as np
import pytest

from stickslip.sim.numerics.roots import roots


@numba.njit
def found_in(coefficients, room):
    found = np.empty(room)
    return found[: roots(coefficients, len(coefficients) - 1, found)]


@pytest.mark.parametrize("planted", [[1.0], [0.5, 1.0], [0.25, 0.5, 0.75], [0.5, 0.5 + 2.0**-30], [1.25], []])
def test_planted_roots_are_found_in_order(planted):
    """Those at 0.5 and the like lie on the border of two halves, and count once."""
    inside = [root for root in planted if root <= 1]
    coefficients = np.polynomial.polynomial.polyfromroots(planted)
    np.testing.assert_allclose(found_in(coefficients, 8), inside, rtol=1e-12)
    assert found_in(coefficients, 1).tolist() == found_in(coefficients, 8)[:1].tolist()  # as there is room for


def test_no_root_is_lost_or_made_up_where_rounding_decides_on_which_side_of_a_border_it_lies(rng):
    places = np.setdiff1d(np.arange(-8, 25), [0, 16]) / 16  # at 1 itself rounding decides whether it is inside
    for _ in range(5000):
        planted = np.sort(rng.choice(places, rng.integers(1, 6), replace=False))
        coefficients = rng.choice([-3.0, -0.1, 0.1, 1.0]) * np.polynomial.polynomial.polyfromroots(planted)
        inside = planted[(planted > 0) & (planted < 1)]
        found = found_in(coefficients, 8)
        assert len(found) == len(inside), planted
        np.testing.assert_allclose(found, inside, rtol=0, atol=1e-10)
