"""Scenes under adiabatic loading: rows are those of `simulate`, and what has no meaning is refused."""

import numpy as np
import pytest

from stickslip import simulate
from stickslip.pipeline import SceneError, expand, parse_scene, query, run_ensemble, verify
from stickslip.workflows import reporting

SCENE = """\
[system]
coupling = "chain"
n = 10
kappa = 4.0
leaf = 1.0
damping = 0.1
static = {uniform = [1.1, 1.5]}
belt_speed = -0.001
[start]
z = {uniform = [-0.1, 0.1]}
w = "belt"
[run]
t_end = 8000.0
matrices = 4
load = "adiabatic"
[[engine]]
name = "coulomb"
tol = 1e-8
[record]
episodes = true
events = true
end = true
[analysis]
question = "episodes"
t_burn = 500.0
dt = 1.0
"""


def test_rows_are_those_of_simulate_and_the_page_has_them(tmp_path):
    scene = parse_scene(SCENE)
    run_ensemble(scene, tmp_path / "out", workers=0)
    assert verify(tmp_path / "out") == []
    table = query.members(tmp_path / "out")
    assert set(table.load) == {"adiabatic"}
    rows = query.episodes(tmp_path / "out")
    for member in expand(scene):
        run = simulate(member.system(), *member.start(), 8000.0, load="adiabatic", tol=1e-8)
        mine = rows[rows.member_id == member.member_id]
        np.testing.assert_array_equal(mine.start, run.loaded.t)
        np.testing.assert_array_equal(mine.elapsed, run.loaded.elapsed)
        np.testing.assert_array_equal(mine.moment, run.loaded.moment)
    answer = reporting.report(tmp_path / "out")
    reporting.write(answer, tmp_path / "out")
    assert "slow the belt" not in (tmp_path / "out" / "report.html").read_text()


def test_other_scenes_keep_their_columns_and_hashes():
    moving, waiting = parse_scene(SCENE.replace('load = "adiabatic"\n', "")), parse_scene(SCENE)
    names = [{column.name for column in scene.recording.columns} for scene in (moving, waiting)]
    assert names[1] - names[0] == {"load", "episode_elapsed"}
    assert "load" not in moving.data_keys()["run"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("end = true", "energy = true"), r'record\.energy: expected none with load = "adiabatic"'),
        (('"adiabatic"', '"slow"'), r"run\.load: .*adiabatic"),
    ],
)
def test_what_has_no_meaning_is_refused_when_the_scene_is_read(change, words):
    with pytest.raises(SceneError, match=words):
        parse_scene(SCENE.replace(*change))


UNIFORM = "{uniform = [1.1, 1.5]}"


@pytest.mark.parametrize(("old", "new", "words"), [
    ('"coulomb"\ntol = 1e-8', '"sigmoid"\neps = 1e-4', r"engine\[0\]: .*exact law with load .*sig"),
    (f"static = {UNIFORM}\n", "", r"system\.static: expected above .* got none"),
    (UNIFORM, "[{ratio = 1.0}, {ratio = 1.2}]", r"system\.static: expected above .* got 1 times"),
    (UNIFORM, '1.2\nweakening = {law = "stribeck", speed = 0.5}', r"system\.weakening: .*stribeck"),
    ("-0.001", "[-0.001, 0.0]", r"system\.belt_speed: expected one that loads .* got 0"),
    ("-0.001", "-0.001\nforce = {amplitude = 1.0, frequency = 1.0, phase = 0.0}", r"system\.force: expected none"),
])  # fmt: skip
def test_what_cannot_be_loaded_is_refused_before_a_run(old, new, words, tmp_path):
    scene = parse_scene(SCENE.replace(old, new))
    with pytest.raises(SceneError, match=words):
        run_ensemble(scene, tmp_path / "out", workers=0)
    assert not (tmp_path / "out").exists()
