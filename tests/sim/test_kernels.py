"""What the engines share: roots of polynomials that were planted, polynomials about another origin, arrays."""

import itertools
from collections import namedtuple

import numba
import numpy as np
import pytest
from scipy.interpolate import BPoly, PPoly

from stickslip.sim.engines.coulomb.events import enclose
from stickslip.sim.engines.coulomb.taylor import _known_step
from stickslip.sim.engines.waveform.layout import ORDER
from stickslip.sim.engines.waveform.pieces import _NEVER, _first_fall, _series_of_u
from stickslip.sim.kernels.compile import kernel
from stickslip.sim.numerics.arithmetic import aligned_zeros
from stickslip.sim.numerics.horner import shift_rows, values_and_slopes
from stickslip.sim.numerics.roots import roots, to_bernstein


@numba.njit
def found_in(coefficients, room):
    found = np.empty(room)
    return found[: roots(coefficients, len(coefficients) - 1, found)]


@pytest.mark.parametrize(
    "planted", [[1.0], [0.5, 1.0], [0.25, 0.5, 0.75], [0.5, 0.5 + 2.0**-30], [1.25], [], [0.4375, 0.875, 1.125]]
)
def test_planted_roots_are_found_in_order(planted):
    """Those at 0.5 and the like lie on the border of two halves, and count once; the last has no curvature where the
    search of its second root begins."""
    inside = [root for root in planted if root <= 1]
    coefficients = np.polynomial.polynomial.polyfromroots(planted)
    np.testing.assert_allclose(found_in(coefficients, 8), inside, rtol=1e-12)
    assert found_in(coefficients, 1).tolist() == found_in(coefficients, 8)[:1].tolist()  # as there is room for


def test_no_root_is_lost_or_made_up_where_rounding_decides_on_which_side_of_a_border_it_lies(rng):
    places = np.setdiff1d(np.arange(-8, 25), [0, 16]) / 16  # at 1 itself rounding decides whether it is inside
    for _ in range(1000):
        planted = np.sort(rng.choice(places, rng.integers(1, 6), replace=False))
        coefficients = rng.choice([-3.0, -0.1, 0.1, 1.0]) * np.polynomial.polynomial.polyfromroots(planted)
        inside = planted[(planted > 0) & (planted < 1)]
        found = found_in(coefficients, 8)
        assert len(found) == len(inside), planted
        assert np.abs(found - inside).max(initial=0.0) < 1e-10


@pytest.mark.parametrize("touch", [0.028, 0.173, 0.179])
def test_a_touch_that_rounding_has_on_both_sides_of_a_border_counts_once(touch):
    """(x - touch)^2, as rounded, ends one interval with a root and has one at the start of the next."""
    assert found_in(np.array([touch * touch, -2.0 * touch, 1.0]), 8).tolist() == [pytest.approx(touch, abs=1e-8)]


@kernel
def falls_at(poly, noise, places):
    return _first_fall(poly, len(poly) - 1, noise, places)


@pytest.mark.parametrize(
    ("poly", "place"),
    [
        ([0.25, -1.0], 0.25),
        ([0.0, 0.5, -1.0], 0.5),
        ([1.0, -0.5], _NEVER),
        ([1.0, -1.0 + 2.0**-40], 1.0),  # but for noise
        ([0.0, 0.0, 0.0], _NEVER),
        ([0.0, -1.0, 3.0], 0.0),
        ([-(2.0**-40), -1.0, 3.0], 0.0),
        ([-0.25, 2.5, -4.0], 0.5),  # up at 1/8
        ([-0.25, 2.5], _NEVER),
        ([-1.0, 0.5], _NEVER),
    ],
)
def test_the_first_place_at_which_a_polynomial_falls_through_zero(poly, place):
    """One that begins below zero has fallen unless it rises first, and then falls where it comes down again."""
    assert falls_at(np.array(poly), 2.0**-39, np.empty(8)) == pytest.approx(place, abs=1e-12)


@kernel
def slip_of(force, drag, u, series):
    return _series_of_u(force, 1.0, drag, force[0], u, 1.0, 0.0, series)


@pytest.mark.parametrize(("drag", "is_cut"), [(1.0, True), (-1.0, True), (1e-3, False)])
def test_the_series_of_slip_is_that_of_the_linear_equation(drag, is_cut):
    """u' = -drag u - 2 + 3 x, without friction, from u = 0.5: to its last order, or to where terms are rounding."""
    series = np.empty(ORDER + 1)
    order = slip_of(np.array([2.0, -3.0, 0.0, 0.0, 0.0, 0.0]), drag, 0.5, series)
    a = 3.0 / drag
    b = -(2.0 + a) / drag
    assert (order == ORDER) == is_cut
    size = 4.0 if is_cut else 1e7  # a and b cancel
    assert series[: order + 1].sum() == pytest.approx(a + b + (0.5 - b) * np.exp(-drag), abs=1e-14 * size)


@numba.njit
def reach_of(series, slips, h):
    reach = np.empty(len(slips))
    enclose(series, slips, len(series) - 1, h, reach, len(slips))
    return reach


@pytest.mark.parametrize("order", [4, 9, 17])
def test_event_functions_leave_their_tangents_by_their_bound_at_most(order, rng):
    """z' of a block that slips and F of one that sticks, to all orders: by all of it where no terms cancel."""
    series, h = rng.uniform(0.1, 1.0, (order + 1, 2)), rng.uniform(0.2, 2.0)
    z, force = (np.polynomial.Polynomial(column) for column in series.T)
    far = [of(h) - of.coef[0] - of.coef[1] * h for of in (z.deriv(), force)]
    for signs in (np.ones((order + 1, 2)), rng.choice([-1.0, 1.0], (order + 1, 2))):
        np.testing.assert_allclose(reach_of(signs * series, np.array([1.0, 0.0]), h), far, rtol=1e-13)


@kernel
def bernstein_of(coefficients, bernstein):
    to_bernstein(coefficients, len(coefficients) - 1, bernstein)


def test_roots_of_random_polynomials_are_exact_to_rounding_and_none_is_missed(rng):
    """Values in extended precision; the unit is the change of a root by rounding of the terms, and its own."""
    n_found, grid = 0, np.linspace(0, 1, 1025)
    grid_powers = np.vander(grid, 24, increasing=True)
    for _ in range(800):
        degree = int(rng.integers(1, 24))
        coefficients = rng.normal(size=degree + 1) * np.exp(-rng.uniform(0, 2) * np.arange(degree + 1))
        coefficients[0] *= 10.0 ** -rng.choice([0, 0, 3, 12, 30])  # roots near zero are as exact
        found, exact = found_in(coefficients, 24), coefficients.astype(np.longdouble)
        assert found_in(-coefficients, 24).tobytes() == found.tobytes()
        value = np.polynomial.Polynomial(exact)
        slope, size = value.deriv(), np.polynomial.Polynomial(np.abs(coefficients))
        for x in found[found < 1]:
            unit = 2.0**-52 * (size(x) + x * abs(slope(x)))
            assert abs(value(np.longdouble(x))) <= 2 * unit, (coefficients, x)
        values = grid_powers[:, : degree + 1] @ coefficients
        is_told = np.abs(values) > 1e-12 * (grid_powers[:, : degree + 1] @ np.abs(coefficients))
        signs = np.where(is_told, np.sign(values), 0).astype(int)
        has_root = signs[:-1] * signs[1:] < 0
        counts = np.histogram(found, grid)[0]
        assert (counts[has_root] % 2 == 1).all(), coefficients
        n_found += len(found)
    assert n_found > 80


@pytest.mark.parametrize("degree", [2, 16, 40])
def test_roots_of_powers_to_which_steps_of_newtons_method_hardly_come(degree):
    for sign, least in itertools.product((-1.0, 1.0), (1e-3, 1e-20, 1e-44)):
        coefficients = sign * np.array([-least, *np.zeros(degree - 1), 1.0])
        np.testing.assert_allclose(found_in(coefficients, 8), [least ** (1 / degree)], rtol=1e-14)


@pytest.mark.parametrize("degree", [1, 2, 7, 40])
def test_bernstein_coefficients_are_those_of_scipy(degree, rng):
    coefficients = rng.normal(size=degree + 1)
    found = np.empty(degree + 1)
    bernstein_of(coefficients, found)
    of_scipy = BPoly.from_power_basis(PPoly(coefficients[::-1, np.newaxis], [0.0, 1.0])).c[:, 0]
    np.testing.assert_allclose(found, of_scipy, rtol=0, atol=1e-13 * np.abs(coefficients).sum())


@kernel
def shifted(rows, first, last, order, steps):
    shift_rows(rows, first, last, order, steps)


@kernel
def evaluated(rows, order, steps, values):
    values_and_slopes(rows, order, steps, values)


@pytest.mark.parametrize("n", [1, 7, 16, 37])
def test_polynomials_about_another_origin_are_those_of_numpy(n, rng):
    for order in rng.integers(2, 33, 3):
        first, last = np.sort(rng.integers(0, n + 1, 2))
        steps, rows = rng.uniform(-1.5, 1.5, n), rng.normal(size=(int(order) + 3, n))  # rows beyond do not count
        polynomials = [np.polynomial.Polynomial(rows[: order + 1, i]) for i in range(n)]
        values = np.empty((2, n))
        evaluated(rows, order, steps, values)
        sizes = [np.polynomial.Polynomial(np.abs(one.coef)) for one in polynomials]
        for i, (one, size) in enumerate(zip(polynomials, sizes, strict=True)):
            at = abs(steps[i])
            assert abs(values[0, i] - one(steps[i])) <= 1e-14 * size(at)
            assert abs(values[1, i] - one.deriv()(steps[i])) <= 1e-14 * order * size.deriv()(at)
        before = rows.copy()
        shifted(rows, first, last, order, steps)
        for i, (one, size) in enumerate(zip(polynomials, sizes, strict=True)):
            if first <= i < last:
                there, most = (
                    p(np.polynomial.Polynomial([x, 1.0])).coef for p, x in ((one, steps[i]), (size, abs(steps[i])))
                )
                assert (np.abs(rows[: order + 1, i] - there) <= 1e-14 * order * most).all()
                assert (rows[order + 1 :, i] == before[order + 1 :, i]).all()
            else:
                assert (rows[:, i] == before[:, i]).all()


def test_a_shift_of_one_block_is_the_same_to_the_byte_in_any_company(rng):
    rows, steps = rng.normal(size=(14, 37)), rng.uniform(-1.0, 1.0, 37)
    alone = rows.copy()
    shifted(rows, 0, 37, 13, steps)
    for i in range(37):
        shifted(alone, i, i + 1, 13, steps)
    assert (alone == rows).all()


@pytest.mark.parametrize("shape", [(1,), (3, 0, 5), (2, 7, 16)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_arrays_begin_with_a_line_of_the_cache(shape, dtype):
    kept = [aligned_zeros(shape, dtype) for _ in range(20)]
    assert all(one.ctypes.data % 64 == 0 for one in kept if one.size)
    assert all(one.shape == shape and one.dtype == dtype and not one.any() for one in kept)


PLAIN = namedtuple("PLAIN", "shape")(None)  # what is asked of an expansion


@numba.njit
def step_on(plain, order, last, before):
    return _known_step(plain, plain, order, last, before, 0.9, 1e-8)


@pytest.mark.parametrize(("last", "before"), [(3.0, 0.0), (0.0, 2.0), (3.0, 40.0), (40.0, 3.0), (0.0, 0.0)])
def test_a_step_ends_where_one_of_the_last_two_terms_of_w_comes_to_the_error_allowed(last, before):
    """w = sum_k k c_k s^(k - 1), to c_32 here; without such terms it is the one aimed at."""
    step = step_on(PLAIN, 32, last, before)
    most = max(32 * last * step**31, 31 * before * step**30)
    assert most == pytest.approx(1e-8 if last or before else 0.0)
    assert step <= 0.9
