"""Where attraction ends between the values of a sweep: closed forms, whatever the grid."""

import numpy as np
import pytest

from stickslip.pipeline import SceneError, expand, extend, load_scene, parse_scene, query, run_ensemble, verify

SCENE = """\
[system]
coupling = "chain"
n = 1
kappa = 1.0
leaf = 1.0
damping = 0.1
friction = 0.5
static = {ratio = 2.0}
belt_speed = [1.1, 1.9, 1.5]
weakening = {law = "stribeck", speed = 0.5}
[start]
z = [2.0]
w = 0.0
[run]
t_end = 300.0
matrices = 1
[[engine]]
name = "coulomb"
[record]
attractor = true
critical_mode = true
refine = 0.01
t_burn = 100.0
[analysis]
t_burn = 100.0
dt = 0.5
"""
#: Steady sliding is stable while damping outweighs the fall of friction: R > exp(-v / 0.5).
LEAST = 0.5 * np.log(1 / 0.1)


@pytest.fixture(scope="module")
def refined(tmp_path_factory):
    out = tmp_path_factory.mktemp("refined") / "out"
    run_ensemble(parse_scene(SCENE.encode()), out, workers=0)
    return query.members(out).sort_values("belt_speed").set_index("belt_speed")


def test_steady_sliding_ends_at_its_closed_form(refined):
    assert refined["stability_changes"][1.1] == pytest.approx(LEAST, abs=0.005)
    assert refined["stability_changes"][[1.5, 1.9]].isna().all()
    slope = -np.exp(-refined.index.to_numpy() / 0.5)
    np.testing.assert_allclose(refined["critical_rate"], -(0.1 + slope) / 2, rtol=1e-9)
    np.testing.assert_allclose(refined["critical_frequency"], np.sqrt(1 - ((0.1 + slope) / 2) ** 2), rtol=1e-9)


def test_stick_slip_is_followed_to_its_end(refined):
    """`tests/sim/test_continuation.py` follows it in steps of 0.02: it lasts beyond 1.8 and not to 1.9."""
    assert refined["attractor"].tolist() == ["periodic", "periodic", "sliding"]
    assert refined["motion_ends_above"].isna().tolist() == [True, False, True]
    assert 1.8 < refined["motion_ends_above"][1.5] < 1.9
    assert refined["motion_ends_below"].isna().all()


def test_systems_between_two_points_are_those_of_a_scene_there():
    """With all that depends on the key, as a ratio, and the same draws."""
    text = SCENE.replace("friction = 0.5", "friction = [0.5, 0.7]").replace(
        "belt_speed = [1.1, 1.9, 1.5]", "belt_speed = 1.5"
    )
    text = text.replace("n = 1\n", "n = 3\n").replace("damping = 0.1", "damping = {uniform = [0.1, 0.2]}")
    low, high = expand(parse_scene(text.encode()))
    assert low.neighbours[0] is high.neighbours[1] is None
    (between,) = expand(parse_scene(text.replace("[0.5, 0.7]", "0.6").replace("refine = 0.01\n", "").encode()))
    for member, neighbour in ((low, low.neighbours[1]), (high, high.neighbours[0])):
        system, expected = member.towards(neighbour)(0.5), between.system()
        for name in ("friction", "static", "damping"):
            np.testing.assert_allclose(getattr(system, name), getattr(expected, name), rtol=1e-14)


def test_a_function_with_a_full_damping_matrix_is_refined_along_its_parameter(tmp_path):
    """Two blocks tied by a dashpot d: their common motion is damped by 0.02 + d, and 0.1 has to outweigh the fall."""
    (tmp_path / "tied.py").write_text(
        "import numpy as np\nfrom stickslip import Stribeck, System\n\n\ndef draw(n, rng, drag):\n"
        "    c = drag * np.array([[2.0, -1.0], [-1.0, 2.0]])\n"
        "    return System(np.eye(2), c, 0.5, 1.5, static=1.0, weakening=Stribeck(0.5))\n"
    )
    text = SCENE[: SCENE.index("kappa")] + SCENE[SCENE.index("[start]") :]
    text = text.replace('"chain"\nn = 1', '"tied:draw"\nn = 2\nparameters = {drag = [0.02, 0.08]}')
    (tmp_path / "scene.toml").write_text(text.replace("t_end = 300.0", "t_end = 150.0"))
    run_ensemble(load_scene(tmp_path / "scene.toml"), tmp_path / "out", workers=0)
    table = query.members(tmp_path / "out").sort_values("drag")
    assert table["stability_changes"].iloc[0] == pytest.approx(np.exp(-3.0), abs=0.005)
    assert verify(tmp_path / "out") == []


def test_it_can_be_added_without_a_run(tmp_path):
    text = SCENE.replace("critical_mode = true\nrefine = 0.01\n", "events = true\nend = true\n")
    run_ensemble(parse_scene(text.encode()), tmp_path / "plain", workers=0)
    extend(tmp_path / "plain", {"refine": 0.01}, tmp_path / "out", workers=0)
    anew = SCENE.replace("critical_mode = true\n", "events = true\nend = true\n")
    run_ensemble(parse_scene(anew.encode()), tmp_path / "anew", workers=0)
    assert query.table(tmp_path / "out").equals(query.table(tmp_path / "anew"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("belt_speed = [1.1, 1.9, 1.5]", "belt_speed = 1.5", "record.refine: expected a list of numbers"),
        ("refine = 0.01", "refine = 0.0", "record.refine"),
        ("refine = 0.01", "refine = true", "record.refine"),
    ],
)
def test_what_cannot_be_refined_is_refused(old, new, words):
    with pytest.raises(SceneError, match=words):
        parse_scene(SCENE.replace(old, new).encode())
