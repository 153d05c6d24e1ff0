"""What an engine does not run is refused before a scene is run, not member by member."""

import pytest

from stickslip.pipeline import Scene, SceneError, run_ensemble


def scene(system, *engines):
    return Scene(
        system={"coupling": "chain", "n": 3, "static": 1.3} | system,
        start={"z": 0.0, "w": "belt"},
        run={"t_end": 10.0, "matrices": 1},
        engine=[{"name": name} for name in engines],
        analysis={"t_burn": 1.0, "dt": 0.5},
    )


ASKED = {
    "force": ({"force": {"amplitude": [0.0, 0.1], "frequency": 1.0}}, "none"),
    "force by times": ({"force": {"times": [0.0, 1.0], "values": [0.0, 0.1]}}, "none"),
    "belt_speed": ({"belt_speed": {"times": [0.0, 1.0], "values": [-0.1, -0.2]}}, "one number"),
    "belt_speed of each block": ({"belt_speed": {"uniform": [-0.2, -0.1]}}, "one number"),
    "weakening": ({"weakening": {"law": "rational", "rate": 1.0}}, "none"),
    "back_slip": ({"back_slip": False}, "true"),
}


@pytest.mark.parametrize("key", ASKED)
def test_what_an_engine_does_not_take_is_refused(key, tmp_path):
    system, expected = ASKED[key]
    with pytest.raises(
        SceneError, match=rf"^system\.{key.split()[0]}: expected {expected}.* name = \"moreau\" takes, got"
    ):
        run_ensemble(scene(system, "coulomb", "moreau"), tmp_path / "out", workers=0)
    assert not (tmp_path / "out").exists()
    scene(system, "coulomb", "sigmoid").check_engines()


def test_what_it_takes_is_not():
    taken = {"mass": 2.0, "belt_speed": [-0.1, -0.2], "force": {"amplitude": 0.0, "frequency": 1.0}}
    scene(taken, "coulomb", "moreau").check_engines()


def test_a_belt_that_keeps_its_speed_is_one_number(tmp_path):
    steady = scene({"belt_speed": {"times": [0.0, 1.0], "values": [-0.2, -0.2]}, "static": None}, "moreau")
    status = run_ensemble(steady, tmp_path / "out", workers=0)
    assert not status.failures
