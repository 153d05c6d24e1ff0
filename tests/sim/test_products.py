"""Runs are the same whatever makes the products: panels in float64, in float32, or sparse columns."""

from itertools import count

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.sparse import csc_array

from stickslip.sim import System, simulate
from stickslip.sim.numerics import products
from tests.fuzz.draw import draw
from tests.fuzz.judge import exact_truth
from tests.independent import Undecided
from tests.systems import made


def drawn(n_cases):
    """Short cases of the fuzz for the exact engine, of a new seed, without ties, each with what an error comes to."""
    seed = int(np.random.SeedSequence().generate_state(1)[0])
    print("seed", seed)
    for number in count():
        trial = draw(seed, number)
        is_tied = trial.family in ("identical", "integers")
        if (
            is_tied
            or trial.engine != "coulomb"
            or trial.settings["tol"] < 1e-12
            or trial.t_end * trial.case.rate > 30
        ):
            continue
        try:
            truth = exact_truth(trial.case, np.array([trial.t_end]), trial.t_end, 1e-7, trial.rng())
        except Undecided:
            continue
        yield trial, truth.unit[-1]
        n_cases -= 1
        if n_cases == 0:
            return


def test_products_in_float32_cost_the_exact_engine_less_than_its_tolerance(monkeypatch):
    """Only systems of some size are worth them; here all have them."""
    n_changed = 0
    for n_before, (trial, unit) in enumerate(drawn(40)):  # of three, by chance none may change
        if n_before >= 3 and n_changed > 0:
            break
        case, runs = trial.case, []
        system = made(case)
        for smallest in (1, 1000):
            monkeypatch.setattr(products, "_SMALL", smallest)
            runs.append(simulate(system, case.z0, case.w0, trial.t_end, stop_early=False, **trial.settings))
        single, double = (np.concatenate((run.z, run.w)) for run in runs)
        allowed = trial.settings["tol"] * unit
        np.testing.assert_allclose(single, double, rtol=0, atol=allowed, err_msg=trial.words())
        n_changed += (single != double).any()
    assert n_changed > 0


@pytest.mark.parametrize(
    ("law", "allowed"),
    [
        ({"engine": "coulomb", "tol": 1e-10}, 1e-8),
        ({"engine": "sigmoid", "eps": 0.03, "rtol": 1e-8, "atol": 1e-8}, 1e-6),
    ],
)
@pytest.mark.parametrize("storage", [np.array, csc_array])
def test_blocks_go_their_own_way_in_any_company(law, allowed, storage):
    """Systems put together without springs between them, enough for products in float32."""
    seed = np.random.SeedSequence().entropy
    print("seed", seed)
    rng = np.random.default_rng(seed)
    groups = []
    while sum(len(k) for k, *_ in groups) < 48:
        n = rng.integers(1, 7)
        k = rng.normal(size=(n, n)) * rng.choice([0.3, 1.0, 3.0])
        k, mu = k @ k.T / n, rng.uniform(0.1, 1, n)
        static = mu * rng.choice([1.0, 1.3], n)
        groups.append((k, rng.uniform(0.5, 4, n), mu, static, rng.normal(size=n), rng.normal(size=n)))
    ks, *each = zip(*groups, strict=True)
    r, mu, static, z0, w0 = map(np.concatenate, each)
    together = simulate(System(storage(block_diag(*ks)), r, mu, -0.2, static), z0, w0, 15.0, **law)
    first, late = 0, []
    for k, r, mu, static, z0, w0 in groups:
        alone = simulate(System(k, r, mu, -0.2, static), z0, w0, 15.0, **law)
        mine = slice(first, first + len(k))
        np.testing.assert_allclose(together.z[mine], alone.z, rtol=0, atol=allowed)
        np.testing.assert_allclose(together.w[mine], alone.w, rtol=0, atol=allowed)
        events, its = together.events, alone.events
        is_mine = (events.block >= first) & (events.block < mine.stop)
        assert events.block[is_mine].tolist() == (its.block + first).tolist()
        assert events.mode[is_mine].tolist() == its.mode.tolist()
        late.append(np.abs(events.t[is_mine] - its.t))
        first = mine.stop
    assert np.median(np.concatenate(late)) < allowed
    assert np.concatenate(late).max() < 1000 * allowed  # a block that nearly touches its belt sees it much later
