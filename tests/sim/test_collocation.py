"""The parts of the sigmoid engine by their definitions, and what its steps of a block's own must not miss."""

import numba
import numpy as np
import pytest
from numba import types

from stickslip.sim import System, simulate
from stickslip.sim.engines import sigmoid_law
from stickslip.sim.kernels.emit import emitted
from stickslip.sim.numerics import panels, radau
from stickslip.sim.systems.friction import hidden_term
from tests.fuzz.draw import draw
from tests.fuzz.judge import judge
from tests.sim import radau as reference


def test_the_method_by_its_definition(rng):
    """Polynomials of degree 4 are integrated to each node, of degree 8 to the end; projection and hull."""
    p = np.polynomial.Polynomial(rng.normal(size=5))
    np.testing.assert_allclose(radau.WEIGHTS @ p(radau.NODES), p.integ()(radau.NODES), atol=1e-13)
    np.testing.assert_allclose(radau.INVERSE @ p.integ()(radau.NODES), p(radau.NODES), atol=1e-11)
    high = np.polynomial.Polynomial(rng.normal(size=9))
    assert radau.LAST @ high(radau.NODES) == pytest.approx(high.integ()(1.0), abs=1e-13)
    moments = [(p * np.polynomial.Polynomial.basis(k)).integ()(1.0) for k in range(5)]
    np.testing.assert_allclose(radau.PROJECT @ moments, p(radau.NODES), atol=1e-10)
    legendre = np.polynomial.legendre.Legendre(rng.normal(size=5), domain=[0, 1])
    np.testing.assert_allclose(radau.TO_LEGENDRE @ legendre(radau.NODES), legendre.coef, atol=1e-12)
    constant = radau.TO_LEGENDRE[1:].sum(axis=1)
    np.testing.assert_allclose(constant, 0.0, atol=2e-15)  # F of 1000 is known to 1e-13: so must its changes be
    q = np.polynomial.Polynomial(rng.normal(size=6))
    hull = radau.TO_BERNSTEIN @ q(radau.ALL_NODES)
    values = q(np.linspace(0.0, 1.0, 200))
    assert hull.min() <= values.min() + 1e-12
    assert hull.max() >= values.max() - 1e-12
    np.testing.assert_allclose(radau.AT_PLACES @ p(radau.NODES), p(radau.PLACES), atol=1e-12)
    np.testing.assert_allclose(radau.ALL_AT_PLACES @ q(radau.ALL_NODES), q(radau.PLACES), atol=1e-12)


@pytest.mark.parametrize("single", [False, True])
def test_products_in_panels_are_plain_products(single, rng):
    """Of five vectors, and of a pair over the columns listed."""
    of_pairs = panels.SINGLE_PAIR_HEIGHT if single else panels.PAIR_HEIGHT
    multiply, of_pair = panels.products(5, single), panels.listed_products(2, of_pairs, single)
    all_of = numba.njit(lambda k, x, y: multiply(k, x, y))
    listed_of = numba.njit(lambda k, x, y, columns, m: of_pair(k, x, y, columns, m))
    dtype, height = (np.float32, panels.SINGLE_HEIGHT) if single else (np.float64, panels.HEIGHT)
    for n in (1, 7, 33, 200):
        matrix, width, atol = rng.normal(size=(n, n)), -(-n // 16) * 16, n * (1e-5 if single else 1e-14)
        x, y = np.zeros((5, width), dtype), np.zeros((5, width), dtype)
        x[:, :n] = rng.normal(size=(5, n))
        all_of(panels.panels(matrix, height, dtype), x, y)
        np.testing.assert_allclose(y[:, :n], x[:, :n] @ matrix.T, atol=atol)
        listed = rng.permutation(n)[: (n + 1) // 2]
        x, y = rng.normal(size=(2, n)).astype(dtype), np.zeros((2, -(-n // of_pairs) * of_pairs), dtype)
        listed_of(panels.panels(matrix, of_pairs, dtype), x, y, listed, len(listed))
        np.testing.assert_allclose(y[:, :n], x[:, listed] @ matrix[:, listed].T, atol=atol)


def test_the_error_of_products_in_single_precision_is_as_large_as_told(rng):
    """Sums of 200 terms of one sign: roundings of single terms are half a unit, those of sums add up to several."""
    matrix, x = rng.uniform(0.5, 1.0, size=(200, 200)), np.zeros((1, 208), np.float32)
    x[:, :200] = rng.uniform(0.5, 1.0, 200)
    y = np.zeros((1, 208), np.float32)
    multiply = panels.products(1, True)
    numba.njit(lambda k, x, y: multiply(k, x, y))(panels.panels(matrix, panels.SINGLE_HEIGHT, np.float32), x, y)
    error = np.abs(y[0, :200] - matrix @ x[0, :200].astype(np.float64))
    bound = panels.SINGLE_ERROR * matrix.sum(axis=1) * x.max()
    assert 0.02 < (error / bound).max() < 1.0


def test_the_law_and_its_slope():
    of_number = numba.njit(lambda x, c: sigmoid_law.sign_of_number(x, c))
    x = np.concatenate(([0.0], np.geomspace(1e-12, 400.0, 300), -np.geomspace(1e-12, 400.0, 300)))
    lam, rise = np.tanh(x), 1 / np.cosh(np.clip(x, -300, 300)) ** 2
    peaked = emitted(lambda code, x, c: sigmoid_law.peaked_sign(x, c), types.UniTuple(types.float64, 2))
    of_both = numba.njit(lambda x, c: peaked(x, c))
    for ratio in (1.0, 1.3, 3.0):
        c = float(hidden_term(ratio))
        values = np.array([of_both(each, c) for each in x])
        s = lam + c * lam * rise
        assert np.abs(values[:, 0] - s).max() <= (2 + 8 * c) * np.finfo(float).eps
        assert np.abs(values[:, 1] - rise * (1 + c * (3 * rise - 2))).max() < (1 + 8 * c) * 1e-15
        assert np.abs([of_number(each, c) for each in x] - s).max() <= (2 + 8 * c) * np.finfo(float).eps
        assert np.abs(s).max() == pytest.approx(ratio, abs=3e-3)


def test_a_layer_just_after_the_start_of_a_step_is_seen():
    """Nodes and the places between them then lie on one side: it cost 40,000 tolerances."""
    system, delta = System([[487.2]], 0.0, 1.0, 0.0), 0.00108
    times = np.linspace(0.0, 0.02, 9)[1:]
    for w in 2.79 + 0.012 * np.arange(5):
        exact = reference.states(system, 1.036, w, delta, times, 1e-12, 0.01)
        got = simulate(
            system, 1.036, w, 0.02, t_eval=times, engine="sigmoid", eps=delta, rtol=1e-9, atol=1e-9
        ).samples
        assert np.abs(np.stack([got.z, got.w], axis=1) - exact).max() < 1e-9 * 20 * 10


def test_errors_that_add_up_undamped_stay_small():
    """A case of the fuzz that cost a method of order four 115 tolerances."""
    verdict = judge(draw(3864865147, 1311, terms=()))
    assert verdict.failures == []
    assert verdict.worst < 6


def test_a_collapse_is_certified_and_followed():
    system = System([[1.0]], 3.0, 1.0, -0.2)
    stopped, whole = (
        simulate(system, 3.0, 1.0, 60.0, engine="sigmoid", eps=0.01, stop_early=stop) for stop in ("always", False)
    )
    assert stopped.outcome == "collapsed"
    assert stopped.stats.n_steps < whole.stats.n_steps
    np.testing.assert_allclose(stopped.z, whole.z, atol=1e-5)
