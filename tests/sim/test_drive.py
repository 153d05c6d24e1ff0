"""Mass, belts by block, and forces from outside."""

import numpy as np
import pytest

from stickslip import Harmonic, Piecewise, System, draw_system, perturb_system
from stickslip.sim.theory import folds

# the system


def test_what_is_left_out_changes_nothing():
    system = System(np.eye(3), 0.1)
    assert system.mass.tolist() == [1.0] * 3
    assert system.force == ()
    assert system.has_one_belt
    assert not system.has_mass
    assert not system.changes
    nothing = System(np.eye(3), 0.1, belt_speed=[-0.2] * 3, mass=1, force=[Harmonic(0.0, 3.0), 0.0])
    assert System(np.eye(3), 0.1, force=[]).force == ()
    assert repr(nothing) == repr(system)
    assert nothing._repr_html_() == system._repr_html_()
    assert nothing.belt_speed == -0.2


def test_forces_add_up():
    force = [1.0, Harmonic([1.0, 2.0], 3.0, 0.5), Piecewise([0.0, 2.0], [0.0, 4.0]), Harmonic(2.0, 0.0, 0.0)]
    system = System(np.eye(2), 0.1, force=force)
    t = np.array([-1.0, 0.5, 1.0, 3.0])
    linear = np.array([0.0, 1.0, 2.0, 4.0])
    expected = 3.0 + np.outer(np.cos(3 * t + 0.5), [1.0, 2.0]) + linear[:, None]
    np.testing.assert_allclose(system.force_at(t), expected, rtol=1e-15)
    np.testing.assert_allclose(system.force_at(0.5), expected[1], rtol=1e-15)
    assert [term.is_constant for term in system.force] == [True, False, False]
    assert system.changes
    assert not System(np.eye(2), 0.1, force=[1.0, 2.0]).changes


def test_belts_are_one_or_one_a_block():
    several = System(np.eye(2), 0.1, belt_speed=[-0.2, 0.3])
    assert not several.has_one_belt
    assert not several.changes
    assert several.belt_speed_at([0.0, 1.0]).tolist() == [[-0.2, 0.3]] * 2
    moving = System(np.eye(2), 0.1, belt_speed=Piecewise([0.0, 1.0], [0.0, -0.5]))
    assert moving.changes
    assert moving.belt_speed.values.shape == (2, 2)
    assert moving.belt_speed_at(0.5).tolist() == [-0.25, -0.25]
    assert System(np.eye(2), 0.1, belt_speed=Piecewise([0.0, 1.0], [-0.5, -0.5])).belt_speed == -0.5


def test_a_system_says_what_drives_it():
    system = System(
        np.eye(2), 0.1, mass=[1, 2], force=[Harmonic(1.0, 0.5), 2.0], belt_speed=Piecewise([0, 1], [0, -1])
    )
    assert repr(system) == (
        "System(n=2, K dense, mass 1 to 2, force 2 + 1 cos(0.5 t), belt_speed=-1 to 0 in 2 times)"
    )
    assert "<th>mass</th><td>1 to 2</td>" in system._repr_html_()
    assert repr(Harmonic(1, [0.5, 2])) == "Harmonic(amplitude=1, frequency=[0.5, 2. ], phase=0)"
    assert repr(Piecewise([0, 1], [0, 2])) == "Piecewise(times=[0., 1.], values=[0., 2.])"


def test_what_drives_a_system_goes_where_it_goes():
    drive = {"mass": 2.0, "force": [Harmonic(1.0, 2.0)], "belt_speed": [-0.1, 0.2, 0.0, 1.0], "static": 1.5}
    system = draw_system("antisymmetric", 4, 0, **drive)
    for other in (perturb_system(system, "antisymmetric", 0.01, 1), system.changed(damping=3.0)):
        assert other.mass.tolist() == [2.0] * 4
        assert other.static.tolist() == [1.5] * 4
        assert other.belt_speed.tolist() == [-0.1, 0.2, 0.0, 1.0]
        np.testing.assert_array_equal(other.force_at(0.3), system.force_at(0.3))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"mass": 0.0}, ValueError, "mass: expected m > 0, got 0 for block 0"),
        ({"mass": [1.0, -1.0]}, ValueError, "mass: expected m > 0, got -1 for block 1"),
        ({"mass": np.inf}, ValueError, "mass: expected finite values"),
        ({"force": [1.0, 2.0, 3.0]}, ValueError, r"force: expected a number or an array of shape \(2,\)"),
        ({"force": "strong"}, TypeError, "force: expected a number or 2 numbers"),
        ({"force": Harmonic([1.0] * 3, 1.0)}, ValueError, r"force: amplitude: .* got shape \(3,\)"),
        ({"force": Piecewise([0.0, 1.0], [[1.0] * 3] * 2)}, ValueError, r"force: values: expected shape \(k,\) or"),
        ({"belt_speed": [1.0, 2.0, 3.0]}, ValueError, "belt_speed: expected a number or an array of shape"),
        ({"belt_speed": Harmonic(1.0, 1.0)}, TypeError, "belt_speed: expected a number, 2 numbers or a Piecewise"),
        ({"belt_speed": np.nan}, ValueError, "belt_speed: expected finite values"),
    ],
)
def test_drives_that_cannot_be_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        System(np.eye(2), 0.1, **arguments)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Harmonic(np.inf, 1.0), "amplitude: expected finite numbers, got inf"),
        (lambda: Harmonic([[1.0]], 1.0), r"amplitude: expected a number, or one a block, got shape \(1, 1\)"),
        (lambda: Piecewise([0.0, 0.0], [1.0, 2.0]), "times: expected at least one, and each after the one before"),
        (lambda: Piecewise([], []), "times: expected at least one"),
        (lambda: Piecewise([0.0, 1.0], [1.0]), r"values: expected shape \(2,\) or \(2, n\)"),
    ],
)
def test_what_is_no_function_of_time_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("drive", [{"mass": 2.0}, {"force": 1.0}, {"belt_speed": [-0.1, -0.2]}])
def test_what_is_written_for_one_belt_says_so(drive):
    with pytest.raises(ValueError, match=rf"{next(iter(drive))}: expected .*, all that .*folds. takes"):
        list(folds.folds(System([[1.0, 0.2], [-0.2, 1.0]], 0.1, **drive)))
