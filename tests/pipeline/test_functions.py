"""Systems by a function of the user's: what it is given, what is kept of it, and what is refused."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from stickslip import sim
from stickslip.pipeline import (
    SceneError,
    StoreError,
    expand,
    load_scene,
    query,
    run_ensemble,
    status,
    systems,
    verify,
)
from stickslip.workflows.commands import main
from stickslip.workflows.reporting import study_of
from tests.scenes import ENDING

OWN = """\
import numpy as np
from beside import STIFF
from stickslip import System

def draw(n, rng, gap, stiff=STIFF):
    K = stiff * np.eye(n) + gap * rng.uniform(-0.1, 0.1, (n, n))
    return System(K, damping=rng.uniform(0.1, 0.2, n), friction=rng.uniform(0.8, 1.2, n), belt_speed=-0.3)
"""

SCENE = (
    """\
[system]
coupling = "own:draw"
n = [3, 4]
parameters = {gap = [0.5, 1.0]}
[start]
z = -0.7
w = -0.4
[run]
t_end = 5.0
matrices = 2
"""
    + ENDING
)


def written(folder, text=SCENE, own=OWN):
    folder.mkdir(exist_ok=True)
    (folder / "own.py").write_text(own)
    (folder / "beside.py").write_text("STIFF = 1.5\n")
    (folder / "mine.toml").write_text(text)
    return folder / "mine.toml"


def test_a_function_makes_the_systems(tmp_path):
    scene = load_scene(written(tmp_path))
    assert scene.extent == "2 gap"
    members = expand(scene)
    assert len({member.member_id for member in members}) == len(members) == scene.n_members == 8
    assert members[0].member_id.startswith(f"n3-own:draw-{scene.system.module.sha256[:12]}-m000-gap=0.5-coulomb")
    for member in members:
        rng = np.random.default_rng(np.random.SeedSequence(0, spawn_key=(0, member.n, member.matrix)))
        gap = dict(member.parameters)["gap"]
        system = member.system()
        assert np.array_equal(
            system.stiffness, 1.5 * np.eye(member.n) + gap * rng.uniform(-0.1, 0.1, (member.n,) * 2)
        )
        assert np.array_equal(system.damping, rng.uniform(0.1, 0.2, member.n))
        assert np.array_equal(system.friction, rng.uniform(0.8, 1.2, member.n))
        assert system.belt_speed == -0.3


def test_what_the_scene_gives_takes_the_place_of_the_functions(tmp_path):
    text = SCENE.replace(
        "n = [3, 4]", "n = 3\nfriction = [0.5, {uniform = [1, 2]}]\nbelt_speed = -0.1\ndamping = 0.0"
    )
    for member in expand(load_scene(written(tmp_path, text))):
        system = member.system()
        assert not system.is_static_above
        assert system.belt_speed == -0.1
        assert not system.damping.any()
        assert (system.friction == 0.5).all() or (system.friction >= 1.0).all()


def test_a_dataset_of_a_function_is_the_same_on_workers_and_has_its_parameters(tmp_path, content):
    file = written(tmp_path / "here")
    run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    run_ensemble(load_scene(file), tmp_path / "two", workers=2)
    assert content(tmp_path / "two") == content(tmp_path / "out")
    assert str(tmp_path) not in (tmp_path / "out" / "scene.toml").read_text()
    table = query.members(tmp_path / "out")
    assert table.groupby(["n", "gap"]).size().tolist() == [2] * 4
    assert set(table.coupling) == {"own:draw"}
    assert table[["kappa", "rho", "friction", "belt_speed"]].isna().all(axis=None)
    assert query.sql(tmp_path / "out", "SELECT gap FROM members GROUP BY gap ORDER BY gap").gap.tolist() == [0.5, 1.0]
    assert len(study_of(str(tmp_path / "out")).groups) == 4
    # grown, from another folder: what is done is kept
    before = content(tmp_path / "out" / "data")
    moved = shutil.move(tmp_path / "here", tmp_path / "there")
    (moved / "mine.toml").write_text(SCENE.replace("[0.5, 1.0]", "[0.5, 1.0, 2.0]"))
    run_ensemble(load_scene(moved / "mine.toml"), tmp_path / "out", workers=0)
    assert before.items() <= content(tmp_path / "out" / "data").items()
    assert (verify(tmp_path / "out"), status(tmp_path / "out").n_done) == ([], 12)


def test_a_function_that_changed_is_another_scene(tmp_path, content):
    run_ensemble(load_scene(written(tmp_path)), tmp_path / "out", workers=0)
    before = content(tmp_path / "out")
    file = written(tmp_path, own=OWN.replace("-0.3", "-0.2"))
    with pytest.raises(StoreError, match=r"system\.module: sha256 [0-9a-f]{12} here, sha256 [0-9a-f]{12} there"):
        run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    assert content(tmp_path / "out") == before
    assert {member.system().belt_speed for member in expand(load_scene(file))} == {-0.2}


def test_a_module_that_changes_while_it_runs_is_said_by_who_needs_it(tmp_path):
    scene = load_scene(written(tmp_path))
    written(tmp_path, own=OWN.replace("-0.3", "-0.2"))
    run = expand(scene)[0]
    systems._function.cache_clear()
    with pytest.raises(SceneError, match=r"expected the module 'own' as it was .* found another; on a cluster"):
        run.system()
    with pytest.raises(SceneError, match=r"expected the module 'own' as it was .* found another"):
        run_ensemble(scene, tmp_path / "out", workers=0)  # a word, and no row of a failed member
    assert not list((tmp_path / "out").glob("data/*"))


def test_the_copy_of_the_scene_in_a_dataset_finds_its_module_above(tmp_path, capsys):
    file = written(tmp_path)
    run_ensemble(load_scene(file), tmp_path / "runs" / "mine", workers=0)
    first = expand(load_scene(file))[0].member_id
    assert main(["run", str(tmp_path / "runs" / "mine" / "scene.toml"), "--only", first]) == 0
    assert first in capsys.readouterr().out


def test_a_sparse_matrix_of_a_function_is_one_for_memory_and_time(tmp_path):
    own = "import scipy.sparse\nfrom stickslip import System\n\n\ndef draw(n, rng):\n"
    sparse = own + "    return System(scipy.sparse.eye_array(n), 0.1)\n"
    text = SCENE.replace("parameters = {gap = [0.5, 1.0]}\n", "").replace("[3, 4]", "[3, 20000]")
    scene = load_scene(written(tmp_path, text, sparse))
    assert scene.system.bytes_of_system < 1e7
    dense = own + "    return System(scipy.sparse.eye_array(n).toarray(), 0.1)\n"
    other = load_scene(written(tmp_path, text, dense))
    assert other.system.bytes_of_system > 1e9
    assert expand(other)[-1].cost > 5 * expand(scene)[-1].cost


def own(line, of="from stickslip import System\n"):
    return f"{of}def draw(n, rng, gap):\n    {line}\n"


#: What is written in the place of what, in the scene or as the module, and words of the refusal.
BAD = {
    "no module": ("own:draw", "owns:draw", OWN, ["the module 'owns' beside the scene", "owns.py"]),
    "no function": ("own:draw", "own:drew", OWN, ["a function 'drew'", "did you mean 'draw'"]),
    "no name": ("own:draw", "own.py:draw(3)", OWN, ["module:function", "'own.py:draw(3)'"]),
    "syntax": ("", "", "def draw(:\n", ["SyntaxError"]),
    "import": ("", "", "import nonesuch_at_all\n", ["ModuleNotFoundError", "nonesuch_at_all"]),
    "raises": ("", "", own("raise KeyError('a\\nb')"), ["KeyError", "own:draw(3, rng, gap=0.5)"]),
    "exits": ("", "", own("raise SystemExit(3)"), ["SystemExit"]),
    "an array": ("", "", own("return np.eye(n)", "import numpy as np\n"), ["of 3 blocks, got ndarray"]),
    "another n": ("", "", own("return System([[1.0]], 0.1)"), ["of 3 blocks, got one of 1"]),
    "nan": ("", "", own("return System([[float('nan')]], 0.1)"), ["ValueError: stiffness: expected finite"]),
    "unknown parameter": ("gap = [", "gop = [", OWN, ["TypeError", "gop"]),
    "a column's name": ("gap = [", "matrix = [", OWN, ["system.parameters", "'matrix'", "choose another"]),
    "a text": ("gap = [0.5, 1.0]", 'gap = "wide"', OWN, ["system.parameters.gap", "a finite number", "'wide'"]),
    "a scale": ("n = [3, 4]", "n = 3\nkappa = 0.2", OWN, ["system.kappa", "own:draw", "[system.parameters]"]),
    "parameters of none": ('"own:draw"', '"full"', OWN, ["system.parameters", 'coupling = "full"']),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_function_of_systems_is_refused_in_a_line_and_nothing_is_written(
    case, tmp_path, capsys, monkeypatch
):
    old, new, module, words = BAD[case]
    assert not old or SCENE.count(old) == 1
    written(tmp_path, SCENE.replace(old, new) if old else SCENE, module)
    monkeypatch.chdir(tmp_path)
    before = sorted(one.name for one in tmp_path.iterdir())
    assert main(["run", "mine.toml"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(word in line for word in words), line
    print(line)
    assert sorted(one.name for one in tmp_path.iterdir() if one.name != "__pycache__") == before


def test_a_scene_is_code_and_its_dataset_is_not(tmp_path, monkeypatch, capsys):
    """As the README says: whatever `run` does runs the module; reading what came of it does not."""
    file, mark = written(tmp_path, own=f"{OWN}\nopen(__file__ + '.run', 'a').close()\n"), tmp_path / "own.py.run"
    member = expand(load_scene(file))[0].member_id
    monkeypatch.chdir(tmp_path)
    for more in (["--dry-run"], ["--only", member], ["--workers", "1", "--no-report"]):
        mark.unlink()
        systems._function.cache_clear()
        assert main(["run", "mine.toml", *more]) == 0
        assert mark.exists(), more
    mark.unlink()
    systems._function.cache_clear()
    for read in (["status"], ["verify"], ["report"], ["query"]):
        assert main([*read, "runs/mine", *["SELECT n FROM members"][: read == ["query"]]]) == 0
    assert not mark.exists()


def test_a_function_of_an_installed_package(tmp_path):
    """As a cluster has it: not beside the scene."""
    package = tmp_path / "site" / "lab"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "parts.py").write_text("BELT = -0.4\n")
    (package / "systems.py").write_text(
        "from stickslip import System\nfrom .parts import BELT\n\n"
        "def draw(n, rng, gap):\n    return System(gap * rng.random((n, n)), 0.1, 1.0, BELT)\n"
    )
    file = written(tmp_path / "scene", SCENE.replace("own:draw", "lab.systems:draw"))
    code = (
        f"from stickslip.pipeline import expand, load_scene, run_ensemble\nif __name__ == '__main__':\n"
        f"    scene = load_scene({str(file)!r})\n    assert expand(scene)[0].system().belt_speed == -0.4\n"
        f"    print(run_ensemble(scene, 'out', workers=1).outcomes)\n"
    )
    where = os.pathsep.join([str(tmp_path / "site"), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": where},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "failed" not in done.stdout


def test_a_system_is_the_functions_own(tmp_path):
    member = expand(load_scene(written(tmp_path)))[-1]
    run = sim.simulate(member.system(), -0.7, -0.4, t_end=5.0, tol=1e-6)
    assert member.simulate().events.t.tolist() == run.events.t.tolist()
