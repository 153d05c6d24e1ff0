"""Static friction above the kinetic: the system, and what both engines make of it."""

import numpy as np
import pytest

from stickslip.sim import System, draw_system, perturb_system, simulate
from stickslip.sim.engines import ENGINES
from stickslip.sim.theory import blowup, folds, slow_time, strata
from stickslip.sim.theory.laws import Coulomb

# the system


def test_static_friction_left_out_is_the_kinetic():
    system = System(np.eye(3), 0.1, [0.5, 1.0, 0.0])
    assert system.static is system.friction
    assert not system.is_static_above
    same = System(np.eye(3), 0.1, 1.0, static=1.0)
    assert not same.is_static_above
    assert repr(same) == repr(System(np.eye(3), 0.1))
    assert same._repr_html_() == System(np.eye(3), 0.1)._repr_html_()


def test_static_friction_is_a_number_or_one_a_block():
    assert System(np.eye(2), 0.1, static=1.3).static.tolist() == [1.3, 1.3]
    system = System(np.eye(2), 0.1, [1.0, 0.5], static=[1.0, 0.75])
    assert system.is_static_above
    assert "static 0.75 to 1" in repr(system)
    assert "<th>static friction</th><td>0.75 to 1</td>" in system._repr_html_()
    with pytest.raises(ValueError, match="read-only"):
        system.static[0] = 2.0


def test_static_friction_goes_where_the_system_goes():
    system = draw_system("antisymmetric", 4, 0, static=1.5)
    assert perturb_system(system, "antisymmetric", 0.01, 1).static.tolist() == [1.5] * 4
    plain = draw_system("antisymmetric", 4, 0)
    np.testing.assert_array_equal(system.holding_force(0.3), plain.holding_force(0.3))
    np.testing.assert_array_equal(system.rest_state(1), plain.rest_state(1))


@pytest.mark.parametrize(
    ("static", "error", "message"),
    [
        (0.9, ValueError, "static: expected at least the kinetic friction, got 0.9 below 1 at block 0"),
        ([2.0, 2.0, 0.5], ValueError, "static: .* got 0.5 below 1 at block 2; raise it"),
        ([2.0, 2.0], ValueError, r"static: expected a number or an array of shape \(3,\)"),
        (np.inf, ValueError, "static: expected finite values"),
        ("high", TypeError, "static: expected a number or 3 numbers"),
    ],
)
def test_static_frictions_that_cannot_be_are_refused(static, error, message):
    with pytest.raises(error, match=message):
        System(np.eye(3), 0.1, static=static)


@pytest.mark.parametrize(
    "call",
    [
        lambda s: list(folds.folds(s)),
        lambda s: folds.can_stick(s, [0.0, 0.0]),
        lambda s: strata.corners(s),
        lambda s: blowup.continuations(s, Coulomb(), 0.0, 0.0),
        lambda s: slow_time.follow(s, Coulomb(), 0.0, 0.0, 1.0),
    ],
)
def test_what_is_written_for_one_friction_says_so(call):
    system = System([[1.0, 0.2], [-0.2, 1.0]], 0.1, 1.0, static=[1.0, 1.25])
    with pytest.raises(ValueError, match=r"static: expected the kinetic friction, .* got 1.25 above 1 at block 1"):
        call(system)


@pytest.mark.parametrize("engine", [name for name, kind in ENGINES.items() if not kind.takes_static])
def test_an_engine_without_it_says_so(engine):
    with pytest.raises(
        ValueError, match=f"static: .* the one friction that engine='{engine}' takes, got 1.3 above 1"
    ):
        simulate(System([[1.0]], 0.0, static=1.3), 0.0, 0.0, 1.0, engine=engine)
