"""K, C and M from a file each, and what changes in time from a file: as the same numbers in Python."""

import numpy as np
import pytest
import scipy.io

from stickslip import Piecewise, System
from stickslip.pipeline import SceneError, expand, load_scene, query, run_ensemble
from stickslip.pipeline.scene import systems
from tests.scenes import ENDING

N = 3
K = np.array([[1.5, -1.5, 0.0], [-1.5, 3.0, -1.5], [0.0, -1.5, 1.5]])
C, M = 0.1 * K, np.array([1.0, 2.0, 4.0])
TIMES, VALUES = np.linspace(0.0, 8.0, 17), 0.25 + 0.125 * np.array([0, 1, 3, 2] * 4 + [1.0])
SCENE = """\
[units]
time = "s"
length = "mm"
mass = "g"
[system]
coupling = "file"
path = {stiffness = "K.csv", damping = "model.mat:Cd", mass = "M.csv"}
names = ["top", "pipe", "bit"]
contacts = ["bit"]
friction = 0.5
force = {table = "log.csv", columns = ["t", "F"], blocks = ["pipe"]}
drive = {block = "top", spring = 2.0, speed = {table = "speed.csv"}}
[start]
z = 0.0
w = "belt"
[run]
t_end = 8.0
matrices = 1
"""


@pytest.fixture
def scene(tmp_path):
    np.savetxt(tmp_path / "K.csv", K, delimiter=";")
    np.savetxt(tmp_path / "M.csv", M)
    scipy.io.savemat(tmp_path / "model.mat", {"Kd": K, "Cd": C})
    rows = np.column_stack([TIMES, VALUES])
    np.savetxt(tmp_path / "speed.csv", rows, delimiter=",", header="t,v", comments="")
    np.savetxt(tmp_path / "log.csv", np.column_stack([rows, 2 * VALUES]), delimiter=",", header="t,v,F", comments="")
    (tmp_path / "mine.toml").write_text(SCENE + ENDING)
    return tmp_path / "mine.toml"


def test_a_system_of_many_files_is_that_of_its_numbers(scene, content):
    text = scene.read_text()
    loaded = load_scene(scene)
    (member,) = expand(loaded)
    force = Piecewise(TIMES, np.multiply.outer(2 * VALUES, [0.0, 1.0, 0.0]))
    ground = System(K, C, [0.0, 0.0, 0.5], 0.0, mass=M, force=[force], names=["top", "pipe", "bit"])
    expected = loaded.scales.dimensionless(ground.driven("top", 2.0, Piecewise(TIMES, VALUES)))
    found = member.system()
    for key in ("stiffness", "damping", "cross_damping", "mass", "friction", "belt_speed"):
        np.testing.assert_array_equal(getattr(found, key), getattr(expected, key), err_msg=key)
    t = np.linspace(0.0, 20.0, 301) / loaded.scales.time
    np.testing.assert_allclose(found.force_at(t), expected.force_at(t), rtol=1e-12, atol=1e-12)
    run_ensemble(loaded, scene.parent / "here", workers=0)
    run_ensemble(loaded, scene.parent / "there", workers=1)
    assert content(scene.parent / "here") == content(scene.parent / "there")
    drawn = query.members(scene.parent / "here").drawn[0]
    assert "drive_speed = 17 values of speed.csv from 0.25 to 0.625" in drawn
    (scene.parent / "again.csv").write_bytes((scene.parent / "speed.csv").read_bytes())
    scene.write_text(text.replace("speed.csv", "again.csv"))
    assert load_scene(scene).hash == loaded.hash


@pytest.mark.parametrize("file", ["K.csv", "M.csv", "log.csv", "speed.csv"])
def test_another_file_is_another_scene_and_is_not_run_for_the_old(file, scene):
    old = load_scene(scene)
    content = (scene.parent / file).read_text()
    (scene.parent / file).write_text(content + " \n")
    assert load_scene(scene).hash != old.hash
    systems._read.cache_clear()
    systems.read_measured.cache_clear()
    with pytest.raises(SceneError, match=r"as it was when the scene was read .* got another"):
        run_ensemble(old, scene.parent / "out", workers=0)
    (scene.parent / file).unlink()
    with pytest.raises(SceneError, match=r"cannot be read|names none in"):
        load_scene(scene)


@pytest.mark.parametrize(("old", "new", "words"), [
    ('stiffness = "K.csv", ', "", r"system\.path: expected a file for `stiffness`.*got those of damping, mass"),
    ("damping =", "dampng =", r"system\.path"),
    ("model.mat:Cd", "model.mat", r"system\.path\.damping: model\.mat: .*`damping` or `C`.* got Kd, Cd"),
    ("model.mat:Cd", "model.mat:C", r"expected an array 'C', got Kd, Cd"),
    ('columns = ["t", "F"], ', "", r"system\.force: log\.csv: .*expected two columns, got 3; name two"),
    ('{table = "speed.csv"}', '[{table = "speed.csv"}]', r"drive\.speed: expected no course in a list"),
    ('{table = "speed.csv"}', '{table = "M.csv"}', r"system\.drive\.speed: M\.csv: .*two columns, got 1"),
    ('{table = "speed.csv"}', "{table = 3}", r"drive\.speed: expected the name of a file of two columns"),
    ('{table = "log.csv"', '{times = [0.0], table = "log.csv"', r"system\.force: expected amplitude and"),
    ("friction = 0.5", 'friction = {table = "speed.csv"}', r"system\.friction: expected"),
    ("damping = ", "C = ", r"system\.path: expected the name of a file, or files of stiffness, .*'C'"),
    ('damping = "model.mat:Cd", ', "", r"system\.damping: expected that .* K is in K\.csv, found none there; add"),
    ("t_end = 8.0", "t_end = 8.5", r"force: log\.csv: expected values from 0 to t_end = 8\.5, .* 0 to 8; take"),
])  # fmt: skip
def test_what_does_not_fit_is_refused(old, new, words, scene):
    scene.write_text(scene.read_text().replace(old, new))
    with pytest.raises(SceneError, match=words):
        load_scene(scene)


@pytest.mark.parametrize(("file", "numbers", "words"), [
    ("K.csv", np.ones((3, 4)), r"path: \S*/K\.csv: stiffness: expected .* \(3, 4\)"),
    ("M.csv", -M, r"path: M\.csv: mass: expected"),
])  # fmt: skip
def test_of_several_files_the_wrong_one_is_named(file, numbers, words, scene):
    np.savetxt(scene.parent / file, numbers, delimiter=";")
    with pytest.raises(SceneError, match=words):
        load_scene(scene)


def test_times_that_do_not_increase_are_refused_by_row(scene):
    (scene.parent / "speed.csv").write_text("t,v\n0,1\n2,1\n2,1\n")
    with pytest.raises(SceneError, match=r"speed\.csv: expected times that increase, got 2 after 2 in row 3"):
        load_scene(scene)


def test_a_series_that_begins_late_or_ends_early_is_refused_until_a_row_says_what_follows(scene):
    speed, text = scene.parent / "speed.csv", scene.read_text()
    scene.write_text(text.replace("t_end = 8.0", "t_end = 12.5").replace("force = {table", "# {table"))
    with pytest.raises(
        SceneError, match=r"take `t_end = 8`, or say what .* by a row, as 12\.5, 0\.375 for a constant"
    ):
        load_scene(scene)
    speed.write_text(speed.read_text() + "12.5, 0.375\n")
    assert load_scene(scene).system.drive.speed.n_values == len(TIMES) + 1
    np.savetxt(speed, np.column_stack([TIMES + 1000.0, VALUES]), delimiter=",")
    with pytest.raises(SceneError, match=r"from 1000 to 1008; subtract the first from all, or .* as 0, 0\.25 for"):
        load_scene(scene)


@pytest.mark.parametrize("damping", ["damping = 0.0", "rho = 1.0", "rayleigh = [0.0, 0.1]"])
def test_damping_beside_a_stiffness_from_a_file_may_be_said_in_the_scene(damping, scene):
    scene.write_text(
        scene.read_text().replace('damping = "model.mat:Cd", ', "").replace("[start]", f"{damping}\n[start]")
    )
    assert load_scene(scene).n_members == 1


@pytest.mark.parametrize(("head", "label", "words"), [
    ("top,pipe,bit", "", ""),
    (",top,pipe,bit", "top pipe bit", ""),
    ("k1 N/m,k2 N/m,k3 N/m", "", ""),  # no names
    ("top,bit,pipe", "", "expected 'bit' for block 1, as K.csv calls it, got 'pipe'; write names in the order"),
    (",top,pipe,bit", "top pipe Bit", "expected 'Bit' for block 2, as K.csv calls it, got 'bit'"),
    ("top,pipe,bit", "pipe top bit", "expected 'pipe' for block 0"),
])  # fmt: skip
def test_names_are_those_by_which_a_file_calls_its_blocks(head, label, words, scene):
    rows = [",".join(map(str, row)) for row in K]
    rows = [f"{name},{row}" for name, row in zip(label.split(), rows, strict=True)] if label else rows
    (scene.parent / "K.csv").write_text("\n".join([head, *rows]))
    if not words:
        assert load_scene(scene).system.block_names == ("top", "pipe", "bit")
        return
    with pytest.raises(SceneError, match=f"system.names: {words}"):
        load_scene(scene)
