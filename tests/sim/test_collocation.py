"""The collocation engine against independent references, and its parts by their definitions."""

import secrets

import numba
import numpy as np
import pytest
import scipy.sparse

from stickslip.sim import System, draw_system, simulate
from stickslip.sim.engines import collocation, lanes, panels, radau
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.sigmoid import Sigmoid
from stickslip.sim.run import Samples
from tests.fuzz.draw import draw as draw_trial
from tests.fuzz.judge import judge
from tests.sim import radau as reference
from tests.sim import test_sigmoid_accuracy
from tests.sim.test_sigmoid_accuracy import FAMILIES, PASSING, draw


def run(system, z0, w0, t_end, t_eval=(), *, t_start=0.0, stop_early=True, engine="sigmoid", **settings):
    """`simulate` by this engine."""
    n, times = system.n, np.asarray(t_eval, float)
    z, w = (np.array(np.broadcast_to(np.asarray(x, float), n)) for x in (z0, w0))
    task = Task(system, z, w, float(t_start), float(t_end), Samples.blank(times, n), stop_early)
    return collocation.integrate(task, Sigmoid(**settings))


def test_the_method_by_its_definition():
    """Polynomials of degree 4 are integrated to each node, of degree 8 to the end; projection and hull."""
    rng = np.random.default_rng(secrets.randbits(32))
    p = np.polynomial.Polynomial(rng.normal(size=5))
    np.testing.assert_allclose(radau.WEIGHTS @ p(radau.NODES), p.integ()(radau.NODES), atol=1e-13)
    np.testing.assert_allclose(radau.INVERSE @ p.integ()(radau.NODES), p(radau.NODES), atol=1e-11)
    high = np.polynomial.Polynomial(rng.normal(size=9))
    assert radau.LAST @ high(radau.NODES) == pytest.approx(high.integ()(1.0), abs=1e-13)
    moments = [(p * np.polynomial.Polynomial.basis(k)).integ()(1.0) for k in range(5)]
    np.testing.assert_allclose(radau.PROJECT @ moments, p(radau.NODES), atol=1e-10)
    legendre = np.polynomial.legendre.Legendre(rng.normal(size=5), domain=[0, 1])
    np.testing.assert_allclose(radau.TO_LEGENDRE @ legendre(radau.NODES), legendre.coef, atol=1e-12)
    q = np.polynomial.Polynomial(rng.normal(size=6))
    hull = radau.TO_BERNSTEIN @ q(radau.ALL_NODES)
    values = q(np.linspace(0.0, 1.0, 200))
    assert hull.min() <= values.min() + 1e-12
    assert hull.max() >= values.max() - 1e-12
    np.testing.assert_allclose(radau.AT_PLACES @ p(radau.NODES), p(radau.PLACES), atol=1e-12)
    np.testing.assert_allclose(radau.ALL_AT_PLACES @ q(radau.ALL_NODES), q(radau.PLACES), atol=1e-12)


@pytest.mark.parametrize("n", [1, 7, 8, 33, 200])
@pytest.mark.parametrize("single", [False, True])
def test_products_in_panels_are_plain_products(n, single):
    rng = np.random.default_rng(secrets.randbits(32))
    multiply, dtype = panels.products(5, single), np.float32 if single else np.float64
    apply = numba.njit(lambda k, x, y: multiply(k, x, y))
    matrix, width = rng.normal(size=(n, n)), -(-n // 16) * 16
    packed = panels.panels(matrix, panels.SINGLE_HEIGHT if single else panels.HEIGHT, dtype)
    x, y = np.zeros((5, width), dtype), np.zeros((5, width), dtype)
    x[:, :n] = rng.normal(size=(5, n))
    apply(packed, x, y)
    np.testing.assert_allclose(y[:, :n], x[:, :n] @ matrix.T, atol=n * (1e-5 if single else 1e-14))


def test_the_law_and_its_slope():
    law = lanes.on_number(lanes.smooth_sign)
    apply = numba.njit(lambda x: law(x))
    x = np.concatenate(([0.0], np.geomspace(1e-12, 400.0, 1000), -np.geomspace(1e-12, 400.0, 1000)))
    values = np.array([apply(one) for one in x])
    assert np.abs(values[:, 0] - np.tanh(x)).max() <= 2 * np.finfo(float).eps
    assert np.abs(values[:, 1] - 1 / np.cosh(np.clip(x, -300, 300)) ** 2).max() < 1e-15


def multiples(*case):
    """Largest error at the samples over tolerance and sensitivity, where two references agree."""
    return [pair[1] for pair in test_sigmoid_accuracy.multiples(*case, integrate=run) if pair]


def test_random_systems_keep_to_the_tolerance():
    seed = secrets.randbits(32)
    print(f"seed {seed}")
    found = []
    for number in range(16):
        rng = np.random.default_rng([seed, number])
        found += multiples(*draw(FAMILIES[number % len(FAMILIES)], rng, 4.0), (1e-3, 1e-5, 1e-7, 1e-9), rng)
    print(len(found), np.median(found), max(found))
    assert len(found) > 32
    assert np.median(found) < 1
    assert max(found) < 10


@pytest.mark.parametrize("case", PASSING)
def test_a_layer_passed_at_speed_is_seen(case):
    tol, system, z, w, delta, t_end = PASSING[case]
    times = np.linspace(0.0, t_end, 60)[1:]
    start = (np.array([z]), np.array([w]), np.array([delta]))
    assert max(multiples(system, *start, times, (tol, 1e-2 * tol), np.random.default_rng(0))) < 5


def test_a_layer_just_after_the_start_of_a_step_is_seen():
    """Nodes and the places between them then lie on one side: it cost 40,000 tolerances."""
    system, delta = System([[487.2]], 0.0, 1.0, 0.0), 0.00108
    times = np.linspace(0.0, 0.02, 9)[1:]
    for w in 2.79 + 0.002 * np.arange(30):
        exact = reference.states(system, 1.036, w, delta, times, 1e-12, 0.01)
        got = run(system, 1.036, w, 0.02, times, eps=delta, rtol=1e-9, atol=1e-9).samples
        assert np.abs(np.stack([got.z, got.w], axis=1) - exact).max() < 1e-9 * 20 * 10


@pytest.mark.parametrize(("seed", "number"), [(3864865147, 1311), (2340751905, 1071), (4198940115, 830)])
def test_what_the_other_engine_missed(seed, number):
    """Cases of the fuzz that cost it 115 to 276 tolerances."""
    verdict = judge(draw_trial(seed, number), run)
    assert verdict.failures == []
    assert verdict.worst < 2


@pytest.mark.long
def test_cross_damping():
    rng = np.random.default_rng(secrets.randbits(32))
    damping = np.diag(rng.uniform(0.5, 1.5, 6)) + rng.uniform(-0.4, 0.4, (6, 6))
    system = System(draw_system("antisymmetric", 6, 3).stiffness, damping, 1.0, -0.2)
    times = np.linspace(0.0, 8.0, 9)[1:]
    exact = reference.states(system, -0.7, -0.4, 0.02, times, 1e-11, 0.02)
    got = run(system, -0.7, -0.4, 8.0, times, eps=0.02, rtol=1e-7, atol=1e-7).samples
    assert np.abs(np.stack([got.z, got.w], axis=1) - exact).max() < 1e-5


def series(events):
    order = np.lexsort((events.t, events.block))
    return events.block[order].tolist(), events.mode[order].tolist(), events.t[order]


@pytest.mark.parametrize("stick", ["manifold", "threshold"])
def test_events_are_those_of_the_other_engine(stick):
    system = draw_system("antisymmetric", 30, 5)
    settings = {"eps": 0.02, "ratio": np.linspace(0.05, 1.0, 30), "stick": stick, "thresholds": [0.3, 0.9, 1.7]}
    got = run(system, -0.7, -0.4, 25.0, rtol=1e-8, atol=1e-8, stop_early=False, **settings)
    other = simulate(system, -0.7, -0.4, 25.0, engine="sigmoid", rtol=1e-9, atol=1e-9, stop_early=False, **settings)
    for a, b in (
        (got.events, other.events),
        *((got.by_threshold[c], other.by_threshold[c]) for c in (0.3, 0.9, 1.7)),
    ):
        (block, mode, t), (other_block, other_mode, other_t) = series(a), series(b)
        assert (block, mode) == (other_block, other_mode)
        np.testing.assert_allclose(t, other_t, atol=1e-4)


def test_sparse_is_dense_and_renumbering_renumbers():
    system, rng = draw_system("antisymmetric", 21, 7), np.random.default_rng(secrets.randbits(32))
    sparse = System(scipy.sparse.csr_array(system.stiffness), system.damping, 1.0, system.belt_speed)
    order = rng.permutation(21)
    other = System(system.stiffness[np.ix_(order, order)], system.damping[order], 1.0, system.belt_speed)
    a, b, c = (run(s, -0.7, -0.4, 12.0, rtol=1e-8, atol=1e-8) for s in (system, sparse, other))
    np.testing.assert_allclose(b.z, a.z, atol=1e-11)
    np.testing.assert_allclose(c.z, a.z[order], atol=1e-11)
    assert len(a.events) == len(b.events) == len(c.events)


def test_the_same_run_again_is_the_same_to_the_last_bit():
    system = draw_system("antisymmetric", 12, 1)
    a, b = (run(system, -0.7, -0.4, 15.0, t_eval=times) for times in ((), np.linspace(0.0, 15.0, 40)))
    assert a.z.tobytes() == b.z.tobytes()
    assert a.events.t.tobytes() == b.events.t.tobytes()


def test_a_collapse_is_certified_and_followed():
    system = System([[1.0]], 3.0, 1.0, -0.2)
    stopped, whole = (run(system, 3.0, 1.0, 60.0, eps=0.01, stop_early=stop) for stop in (True, False))
    assert stopped.outcome == "collapsed"
    assert stopped.stats.n_steps < whole.stats.n_steps
    np.testing.assert_allclose(stopped.z, whole.z, atol=1e-5)
