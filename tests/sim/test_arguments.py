"""Arrays as users have them: the same numbers in any layout are the same system."""

import numpy as np
import pytest
from scipy import sparse

from stickslip.sim import System, simulate


def layouts(k):
    """The same entries, laid out otherwise."""
    wide = np.zeros((2 * len(k), 3 * len(k)))
    wide[::2, ::3] = k
    yield np.asfortranarray(k)
    yield wide[::2, ::3]
    yield np.ascontiguousarray(k[::-1, ::-1])[::-1, ::-1]
    yield k.astype(">f8")
    yield k.tolist()


def test_sums_do_not_depend_on_the_layout(rng):
    for n in rng.integers(20, 200, 10):
        k = rng.normal(size=(n, n))
        first = System(k, 1.0).row_sums
        for other in layouts(k):
            assert System(other, 1.0).row_sums.tobytes() == first.tobytes()


@pytest.mark.parametrize("engine", ["coulomb", "sigmoid"])
def test_the_layout_of_arrays_does_not_show(engine, rng):
    for n in (3, 8, 30):
        k = np.diag(rng.uniform(0, 0.2, n)) + 0.1 * (np.tri(n) - np.tri(n).T) * rng.uniform(-1, 1, (n, n))
        damping, z0 = rng.uniform(3.5, 7, n), rng.uniform(-1, 1, n)
        first = simulate(System(k, damping), z0, -0.2, 20.0, engine=engine)
        for other in layouts(k):
            run = simulate(System(other, damping), z0, -0.2, 20.0, engine=engine)
            assert run.z.tobytes() == first.z.tobytes()
            assert run.events.t.tobytes() == first.events.t.tobytes()


def test_a_sparse_matrix_stays_as_it_was_given(rng):
    k = sparse.csc_array(rng.uniform(1, 2, (4, 4)))
    k.indices[:2], k.data[:2] = k.indices[1::-1].copy(), k.data[1::-1].copy()  # out of order
    indices, data = k.indices.copy(), k.data.copy()
    given = System(k, 3.5).stiffness.toarray()
    np.testing.assert_array_equal(k.indices, indices)
    np.testing.assert_array_equal(k.data, data)
    np.testing.assert_array_equal(k.toarray(), given)
