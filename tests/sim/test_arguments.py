"""Arrays as users have them: the same numbers in any layout are the same system."""

import numpy as np
import pandas as pd
import pytest

from stickslip.sim import System, simulate
from stickslip.sim.attractors import attractor
from stickslip.sim.numerics.arguments import apart, number

UNIT = System([[1.0]], 0.1)


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
    for n in rng.integers(20, 200, 3):
        k = rng.normal(size=(n, n))
        first = System(k, 1.0).row_sums
        for other in layouts(k):
            assert System(other, 1.0).row_sums.tobytes() == first.tobytes()


NULLABLE = ("Float64", "float64[pyarrow]", "Int64", "int64[pyarrow]", object)


@pytest.mark.parametrize("kind", NULLABLE)
def test_tables_of_nullable_types_are_taken_and_a_gap_is_refused_where_it_is(kind):
    k = np.array([[2.0, -1.0], [-1.0, 2.0]])
    frame = pd.DataFrame(k).astype(kind)
    system = System(frame, pd.Series([1, 2]).astype(kind))
    np.testing.assert_array_equal(system.stiffness, k)
    np.testing.assert_array_equal(system.damping, [1.0, 2.0])
    frame.iloc[1, 0] = pd.NA
    with pytest.raises((TypeError, ValueError), match=r"stiffness: expected .*(<NA> at \(1, 0\)|NaN)"):
        System(frame, 0.1)


@pytest.mark.parametrize("entry", [True, "2.0", None, 1j, np.bool_(True)])
def test_objects_that_are_no_numbers_are_refused(entry):
    with pytest.raises(TypeError, match=r"damping: expected .* at 1\)"):
        System(np.eye(2), np.array([1.0, entry], dtype=object))


@pytest.mark.parametrize("low", [0.0, 0.3, 1e-300, -1e300, 123456.0])
def test_numbers_that_differ_look_different(low):
    for n_ulps in (1, 10**6, 10**12):
        high = low + n_ulps * np.spacing(low)
        texts = apart(low, high, low)
        assert texts[0] == texts[2] != texts[1]
        np.testing.assert_allclose([float(text) for text in texts], [low, high, low], rtol=1e-5)


def test_round_numbers_stay_short():
    assert apart(0.3, 0.1) == ("0.3", "0.1")
    assert apart(1 / 3, 1 / 3) == ("0.333333", "0.333333")
    assert apart(1 / 3, np.inf, digits=2) == ("0.33", "inf")


ABOVE = float(np.nextafter(0.3, 1.0))


@pytest.mark.parametrize(("refused", "words"), [
    (lambda: simulate(UNIT, 0.0, 0.0, 0.3, t_eval=[0.0, ABOVE]), ["[0.0, 0.3]", f"got {ABOVE!r};"]),
    (lambda: simulate(UNIT, 0.0, 0.0, 1.0, t_eval=[ABOVE, 0.3]), [f"got 0.3 after {ABOVE!r}; sort"]),
    (lambda: simulate(UNIT, 0.0, 0.0, 1.0, t_eval=[np.nan]), ["[0, 1]", "got nan;"]),
    (lambda: simulate(UNIT, 0.0, 0.0, 1.0, t_eval=[[0.5]]), ["shape (1, 1)"]),
    (lambda: System([[1.0]], 0.1, friction=ABOVE, static=0.3), [f"got 0.3 below {ABOVE!r} "]),
    (lambda: number("x", 0.3, ABOVE), [f"({ABOVE!r}, inf)"]),
    (lambda: simulate(UNIT, 0.0, 0.0, 0.3).plot(span=(0.0, ABOVE)), ["[0.0, 0.3]", f"got 0.0, {ABOVE!r}"]),
    (lambda: attractor(simulate(UNIT, 0.0, 0.0, 0.3), UNIT, ABOVE), ["[0.0, 0.3]", f"got {ABOVE!r}"]),
])  # fmt: skip
def test_messages_show_where_numbers_differ(refused, words):
    with pytest.raises(ValueError, match=":") as error:
        refused()
    assert all(word in str(error.value) for word in words), error.value
