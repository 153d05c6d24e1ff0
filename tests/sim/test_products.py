"""Runs are the same whatever makes the products: panels in float64, in float32, or sparse columns."""

from functools import reduce

import numpy as np
import pytest
from scipy.sparse import csc_array

from stickslip.sim import System, simulate
from tests.independent import Case
from tests.systems import draw_case, made


@pytest.mark.parametrize(
    ("law", "allowed"),
    [
        ({"engine": "coulomb", "tol": 1e-10}, 1e-8),
        ({"engine": "sigmoid", "eps": 0.03, "rtol": 1e-8, "atol": 1e-8}, 1e-6),
    ],
)
@pytest.mark.parametrize("storage", [np.array, csc_array])
def test_blocks_go_their_own_way_in_any_company(law, allowed, storage, rng):
    """Systems put together without springs between them, enough for products in float32.

    Of 1,970 draws by the exact law and 1,164 by the smoothed one states differed by 0.0011 and 0.014 of what is
    allowed at most, and the medians of times by less. There is no bound of all times: an event is late by the error
    over its slope, which may be as small as one likes. A stick that comes to be, or not, is about as deep as the
    error: among some hundred events a draw, a chance of 1e-8.
    """
    groups = []
    while sum(case.n for case in groups) < 48:
        groups.append(draw_case(rng, family="chain", damping=(0.5, 4.0), friction=(0.1, 1.0), terms=["static"]))
    system = made(reduce(Case.beside, groups))
    system = system.changed(stiffness=storage(system.stiffness))
    start = (np.concatenate([getattr(case, name) for case in groups]) for name in ("z0", "w0"))
    together = simulate(system, *start, 15.0, **law)
    first, late = 0, []
    for case in groups:
        alone = simulate(made(case), case.z0, case.w0, 15.0, **law)
        mine = slice(first, first + case.n)
        np.testing.assert_allclose(together.z[mine], alone.z, rtol=0, atol=allowed)
        np.testing.assert_allclose(together.w[mine], alone.w, rtol=0, atol=allowed)
        events, its = together.events, alone.events
        is_mine = (events.block >= first) & (events.block < mine.stop)
        assert events.block[is_mine].tolist() == (its.block + first).tolist()
        assert events.mode[is_mine].tolist() == its.mode.tolist()
        late.append(np.abs(events.t[is_mine] - its.t))
        first = mine.stop
    assert np.median(np.concatenate(late)) < allowed


@pytest.mark.parametrize(
    "law",
    [
        {"engine": "coulomb", "tol": 1e-10},
        {"engine": "sigmoid", "eps": 0.03, "rtol": 1e-8, "atol": 1e-8},
        {"engine": "moreau", "step": 1e-3},
    ],
    ids=lambda law: law["engine"],
)
def test_a_sparse_matrix_that_is_not_symmetric_pulls_as_it_says(law):
    """The last of three blocks stays at z = 1 and pulls the first; none pulls the others: z = -t^2 / 2, w = -t."""
    system = System(csc_array(([1.0], ([0], [2])), shape=(3, 3)), 0.0, 0.0)
    run = simulate(system, [0.0, 0.0, 1.0], 0.0, 2.0, **law)
    np.testing.assert_allclose((run.z, run.w), [[-2.0, 0.0, 1.0], [-2.0, 0.0, 0.0]], rtol=0, atol=1e-6)
