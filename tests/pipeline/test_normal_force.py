"""A normal force that is not constant: refused by name, however it is written, and no friction is negative unsaid."""

import numpy as np
import pytest

from stickslip import Harmonic, Piecewise, System
from stickslip.pipeline import SceneError, parse_scene
from tests.scenes import COULOMB, ensemble

COURSE = Piecewise([0.0, 1.0], [1.0, 0.0])
TO_DO = r"no engine has friction that changes in time, or lift-off: run several constant values; a normal force that"


@pytest.mark.parametrize("name", ["friction", "static"])
@pytest.mark.parametrize("value", [COURSE, Harmonic(0.5, 1.0), [1.0, COURSE], lambda t: 1.0 + t])
def test_friction_that_changes_is_refused_in_python(name, value):
    with pytest.raises(TypeError, match=rf"{name}: expected numbers that are constant in time, got .*; {TO_DO}"):
        System(np.eye(2), 0.1, **{name: value})
    with pytest.raises(TypeError, match=rf"{name}: expected numbers that are constant in time"):
        System.from_physical(np.eye(2), 0.1, **{"friction": 0.4, "belt_speed": 0.1, "mass": 1.0, name: value})


@pytest.mark.parametrize("normal", [COURSE, -1.0, np.array([1.0, -1.0])])
def test_a_normal_load_is_constant_and_not_negative(normal):
    with pytest.raises((TypeError, ValueError), match=r"normal: expected"):
        System.from_physical(np.eye(2), 0.1, 0.4, 0.1, mass=1.0, normal=normal)


@pytest.mark.parametrize("keys", [
    "friction = {times = [0.0, 1.0], values = [1.0, 0.0]}",
    'friction = {table = "load.csv"}',
    "friction = {amplitude = 0.5, frequency = 1.0}",
    "friction = [1.0, {times = [0.0], values = [1.0]}]",
    "static = {times = [0.0, 1.0], values = [1.0, 2.0]}",
    "contacts = {blocks = [0], lift_off = true}",
    "contacts = [{block = 0, normal = 1.0}]",
    "normal = 2.0",
    "lift_off = true",
])  # fmt: skip
def test_a_scene_that_asks_for_it_is_told_what_to_do(keys):
    key = keys.partition(" ")[0]
    with pytest.raises(SceneError, match=rf"system\.{key}: expected .*; {TO_DO}"):
        parse_scene(ensemble(3, 2.0, 2, COULOMB).replace("n = 3", f"n = 3\n{keys}"))


@pytest.mark.parametrize("value", ["-1.0", "[1.0, -1.0]", "{uniform = [-1.0, 1.0]}", "{normal = [1.0, 0.1]}"])
def test_a_scene_draws_no_negative_friction(value):
    with pytest.raises(SceneError, match=r"system\.friction: expected"):
        parse_scene(ensemble(3, 2.0, 2, COULOMB).replace("n = 3", f"n = 3\nfriction = {value}"))
