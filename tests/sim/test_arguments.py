"""Arrays as users have them: the same numbers in any layout are the same system, and a mask is not lost."""

import warnings

import numpy as np
import pytest
from scipy import sparse

from stickslip.sim import Harmonic, Piecewise, System, simulate


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


masked = np.ma.masked_array([1.0, 2.0], [False, True])


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("stiffness", lambda: System(np.ma.masked_array(np.eye(2), np.eye(2)), 1.0)),
        ("stiffness", lambda: System([masked, masked], 1.0)),
        ("damping", lambda: System(np.eye(2), masked)),
        ("damping", lambda: System(np.eye(2), np.ma.masked_array(np.eye(2), np.eye(2)))),
        ("friction", lambda: System(np.eye(2), 1.0, masked)),
        ("belt_speed", lambda: System(np.eye(2), 1.0, 1.0, masked)),
        ("static", lambda: System(np.eye(2), 1.0, 1.0, static=masked)),
        ("mass", lambda: System(np.eye(2), 1.0, mass=masked)),
        ("force", lambda: System(np.eye(2), 1.0, force=masked)),
        ("force", lambda: System(np.eye(2), 1.0, force=[masked, Harmonic(1.0, 1.0)])),
        ("amplitude", lambda: Harmonic(masked, 1.0)),
        ("times", lambda: Piecewise(masked, [1.0, 2.0])),
        ("values", lambda: Piecewise([1.0, 2.0], masked)),
        ("z0", lambda: simulate(System(np.eye(2), 1.0), masked, 0.0, 1.0)),
        ("w0", lambda: simulate(System(np.eye(2), 1.0), 0.0, masked, 1.0)),
        ("t_eval", lambda: simulate(System(np.eye(2), 1.0), 0.0, 0.0, 3.0, t_eval=masked)),
        ("t_end", lambda: simulate(System(np.eye(2), 1.0), 0.0, 0.0, np.ma.masked)),
        ("modes", lambda: simulate(System(np.eye(2), 1.0), 0.0, 0.0, 3.0, modes=masked)),
    ],
)
def test_a_masked_array_is_refused_by_name(name, call):
    with pytest.raises(TypeError, match=f"^{name}: .*masked array"):
        call()


@pytest.mark.parametrize("value", [np.longdouble("1e4000"), np.frombuffer(b"\x01\x00\xa0\x7f", np.float32)[0]])
def test_what_float64_does_not_hold_is_told_in_an_error_alone(value):
    with warnings.catch_warnings(action="error"), pytest.raises(ValueError, match="expected finite entries"):
        System(np.full((2, 2), value), damping=0.1)
