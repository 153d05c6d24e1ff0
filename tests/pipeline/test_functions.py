"""Systems by a function of the user's: what it is given, what is kept of it, and what is refused."""

from __future__ import annotations

import os
import shutil
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from stickslip import sim
from stickslip.pipeline import SceneError, StoreError, expand, load_scene, query, run_ensemble, status, verify
from stickslip.pipeline.own import function, trial
from stickslip.pipeline.own.files import name_beside
from stickslip.pipeline.running.ends import end_of
from stickslip.workflows.commands import main
from stickslip.workflows.reporting import study_of
from tests.processes import python
from tests.scenes import ENDING, own_law

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


def test_a_function_may_have_a_law_of_friction_of_its_own(tmp_path):
    """In a module beside it: the members are runs of `simulate` with that law, in a worker too."""
    own = OWN.replace("import numpy as np\n", "import numpy as np\nfrom lorentz import Lorentz\n")
    own = own.replace("belt_speed=-0.3)", "belt_speed=-0.3, weakening=Lorentz(4.0))")
    scene = written(tmp_path, SCENE.replace("[3, 4]", "3"), own)
    (tmp_path / "lorentz.py").write_text(own_law())
    loaded = load_scene(scene)
    assert sorted(loaded.system.module.beside) == ["beside.py", "lorentz.py", "own.py"]
    run_ensemble(loaded, tmp_path / "out", workers=1)
    table = query.members(tmp_path / "out").set_index("member_id")
    assert set(table.outcome) <= {"finished", "collapsed"}, table.reason.tolist()
    made = {"__name__": "lorentz"}
    exec(compile(own_law(), "lorentz.py", "exec", dont_inherit=True), made)
    for member in expand(loaded):
        system = member.system()
        assert repr(system.weakening) == "Lorentz(sharpness=4.0)"
        run = sim.simulate(system.changed(weakening=made["Lorentz"](4.0)), -0.7, -0.4, 5.0, tol=1e-6)
        assert table.n_exits[member.member_id] == run.events.counts()["n_exits"]
        t, _ = query.n_stick(tmp_path / "out", member.member_id)
        assert t.tolist() == run.events.change_points()[0].tolist()


HIDING = {
    "random.py": ("import random\n", ""),
    "fractions.py": ("import fractions\n", "x = 1 / 0\n"),
    "networkx/__init__.py": ("def late():\n    from networkx import Graph\n", ""),
    "colorsys.py": ("from helper import x\n", "x = 1\n"),
}


@pytest.mark.parametrize("name", HIDING)
def test_a_file_that_hides_a_module_that_is_imported_is_refused(name, tmp_path):
    """Which of the two an import gets depends on what the process has loaded."""
    line, content = HIDING[name]
    scene = written(tmp_path, own=line + OWN)
    (tmp_path / "helper.py").write_text("import colorsys\nx = 1\n")
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(content)
    with pytest.raises(SceneError, match=rf"^system\.coupling: expected no file beside .*, got {name}; rename it$"):
        load_scene(scene)


def test_a_function_whose_module_hides_what_it_imports_is_refused(tmp_path):
    scene = written(tmp_path, SCENE.replace("own:draw", "numpy:draw"))
    (tmp_path / "own.py").rename(tmp_path / "numpy.py")
    with pytest.raises(SceneError, match=r"got numpy\.py; rename it"):
        load_scene(scene)


def test_a_file_that_nobody_imports_hides_nothing(tmp_path):
    scene = written(tmp_path)
    (tmp_path / "calendar.py").write_text("")
    assert sorted(load_scene(scene).system.module.beside) == ["beside.py", "own.py"]


def test_a_function_makes_the_systems(tmp_path):
    scene = load_scene(written(tmp_path))
    assert scene.extent == "2 gap"
    members = expand(scene)
    assert len({member.member_id for member in members}) == len(members) == scene.n_members == 8
    assert members[0].member_id.startswith(f"n3-own:draw-{scene.system.module.sha256[:12]}-m000-gap=0.5-coulomb")
    for member in members:
        rng = np.random.default_rng(np.random.SeedSequence(0, spawn_key=(0, member.n, member.source.matrix)))
        gap = dict(member.source.parameters)["gap"]
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


def test_blocks_may_start_on_the_belt_that_a_function_made(tmp_path):
    file = written(tmp_path, SCENE.replace("w = -0.4", 'w = "belt"'))
    starts = [member.start()[1] for member in expand(load_scene(file))]
    assert starts
    assert all((w == -0.3).all() for w in starts)
    run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    assert verify(tmp_path / "out") == []
    table = query.members(tmp_path / "out")
    assert (table.outcome != "failed").all()
    assert (table.w0 == -0.3).all()  # one number fits every block


def test_a_dataset_of_a_function_has_its_parameters_and_grows_from_another_folder(tmp_path, content):
    file = written(tmp_path / "here")
    run_ensemble(load_scene(file), tmp_path / "out", workers=0)
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


def test_a_module_that_changes_while_it_runs_is_said_by_who_needs_it(tmp_path):
    scene = load_scene(written(tmp_path))
    written(tmp_path, own=OWN.replace("-0.3", "-0.2"))
    run = expand(scene)[0]
    function._module.cache_clear()
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


@pytest.mark.long
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
    done = python("-c", code, cwd=tmp_path, env={**os.environ, "PYTHONPATH": where})
    assert done.returncode == 0, done.stderr
    assert "failed" not in done.stdout


LAZY = OWN.replace("    K = ", "    from late.part import STIFF as late\n    stiff = late\n    K = ")
BY_PATH = OWN.replace(
    "    K = ",
    "    from importlib import util\n    from pathlib import Path\n"
    "    spec = util.spec_from_file_location('any', Path(__file__).parent / 'late' / 'part.py')\n"
    "    part = util.module_from_spec(spec)\n    spec.loader.exec_module(part)\n    stiff = part.STIFF\n    K = ",
)
DATA = OWN.replace("    K = ", "    stiff = np.loadtxt(__file__.replace('own.py', 'data.txt'), usecols=2)\n    K = ")


@pytest.mark.parametrize(
    ("own", "name"), [(OWN, "beside.py"), (LAZY, "late/part.py"), (BY_PATH, "late/part.py"), (DATA, "data.txt")]
)
def test_a_module_that_the_function_loads_is_part_of_the_scene(own, name, tmp_path, content, monkeypatch):
    monkeypatch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    (tmp_path / "late").mkdir()
    (tmp_path / "late" / "part.py").write_text("STIFF = 1.5\n")
    (tmp_path / "data.txt").write_text("STIFF = 1.5\n")
    scene = load_scene(written(tmp_path, own=own))
    assert name in scene.system.module.beside
    written_at = os.stat(tmp_path / name).st_mtime_ns
    run_ensemble(scene, tmp_path / "out", workers=0)
    assert verify(tmp_path / "out") == []
    before = content(tmp_path / "out")
    file = written(tmp_path, SCENE.replace("matrices = 2", "matrices = 3"), own)
    (tmp_path / name).write_text("STIFF = 2.5\n")  # of the same size, and in the same second
    later = 2_000_000_000 if own is BY_PATH else 0  # which Python loads by itself, and so from what it compiled then
    os.utime(tmp_path / name, ns=(written_at + later,) * 2)
    with pytest.raises(StoreError, match=r"system\.beside"):
        run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    assert content(tmp_path / "out") == before
    (problem,) = verify(tmp_path / "out")
    assert f"{name}, which the function reads, as it was" in problem
    assert all(2.4 <= member.system().stiffness[0, 0] <= 2.6 for member in expand(load_scene(file)))


def test_a_link_beside_the_scene_is_beside_it(tmp_path):
    file = written(tmp_path / "scene")
    (tmp_path / "scene" / "beside.py").rename(tmp_path / "shared.py")
    (tmp_path / "scene" / "beside.py").symlink_to("../shared.py")
    scene = load_scene(file)
    assert "beside.py" in scene.system.module.beside
    (tmp_path / "shared.py").write_text("STIFF = 2.5\n")
    with pytest.raises(SceneError, match=r"beside\.py, which the function reads, as it was"):
        expand(scene)[0].system()


def test_a_file_that_is_read_for_each_system_is_looked_at_for_each(tmp_path):
    (tmp_path / "data.txt").write_text("STIFF = 1.5\n")
    first, *_, last = expand(load_scene(written(tmp_path, own=DATA)))
    assert first.system().stiffness[0, 0] < 2.0
    (tmp_path / "data.txt").write_text("STIFF = 2.5\n")
    with pytest.raises(SceneError, match=r"data\.txt, which the function reads, as it was"):
        last.system()


def test_what_is_loaded_only_later_fails_its_members(tmp_path):
    later = OWN.replace("    K = ", "    if gap == 1.0:\n        from other import STIFF as stiff\n    K = ")
    file = written(tmp_path, own=later)
    (tmp_path / "other.py").write_text("STIFF = 2.5\n")
    done = run_ensemble(load_scene(file), tmp_path / "out", workers=0)
    assert done.outcomes["failed"] == 4
    table = query.members(tmp_path / "out", filters=[("outcome", "=", "failed")])
    assert all("other.py" in reason and "import it at the top" in reason for reason in table.reason)
    assert "other" not in sys.modules


def test_what_is_installed_is_not_beside_a_scene_above_it():
    import statistics  # of Python, which may lie in the user's home as the scene does

    for module in (statistics, pytest):
        file = Path(module.__file__).resolve()
        assert name_beside(str(file), Path(file.anchor)) is None


def test_scenes_in_other_folders_keep_their_modules_apart(tmp_path, monkeypatch):
    members = []
    for name, stiff in (("one", 1.5), ("other", 2.5)):
        file = written(tmp_path / name)
        (tmp_path / name / "beside.py").write_text(f"STIFF = {stiff}\n")
        members.append((expand(load_scene(file))[0], stiff))
    callers = types.ModuleType("beside")
    monkeypatch.setitem(sys.modules, "beside", callers)
    for member, stiff in 2 * members:
        assert abs(member.system().stiffness[0, 0] - stiff) <= 0.1
        assert sys.modules["beside"] is callers


@pytest.mark.parametrize(("line", "words"), [
    ("import os; return System(gap * np.frombuffer(os.urandom(n * n), np.uint8).reshape(n, n), 0.1)", "that differ"),
    ("import os; return System(np.eye(n), 0.1, 1.0 + int.from_bytes(os.urandom(6), 'big'))", "that differ"),
    ("return System(np.eye(n), np.eye(n) + int.from_bytes(os.urandom(6)) * (1.0 - np.eye(n)))", "that differ"),
    ("return System(SEED * np.eye(n), 0.1)", "that differ"),
    ("import os; os.fork(); return System(np.eye(n), 0.1)", "may not fork"),
    ("raise type('Odd', (Exception,), {'__str__': lambda self: 7})", "Odd: its message cannot be had (Type"),
    ("raise KeyboardInterrupt", "KeyboardInterrupt"),
    ("raise ValueError('\\x1b[31mred\\x07' + 'x' * 1000)", r"ValueError: \x1b[31mred\x07xxx"),
    ("import time; time.sleep(60)", "within 1 s, its process died (signal SIGKILL)"),
    ("import os; os._exit(3)", "exit code 3"),
])  # fmt: skip
def test_a_function_that_misbehaves_when_it_is_tried_is_refused_in_a_line(line, words, tmp_path, monkeypatch):
    monkeypatch.setattr(trial, "LONGEST_TRIAL", 1.0 if "sleep" in line else 40.0)
    head = "import os\nimport numpy as np\nfrom stickslip import System\nSEED = 1.0 + int.from_bytes(os.urandom(6))\n"
    with pytest.raises(SceneError) as refusal:
        load_scene(written(tmp_path, own=own(line, head)))
    assert words in str(refusal.value)
    assert str(refusal.value).isprintable()
    assert len(str(refusal.value)) < 600


@pytest.mark.parametrize("fork", ["os.fork()", "ctypes.CDLL(None).fork()"])
def test_what_a_function_forks_does_not_go_on_in_the_place_of_its_process(fork, tmp_path):
    head = "import ctypes\nimport os\nimport numpy as np\nfrom stickslip import System\n"
    lines = f"if gap == 1.0: {fork}\n    return System(np.eye(n), 0.1)"
    file = written(tmp_path, own=own(lines, head))
    code = (
        "import sys\nfrom stickslip.pipeline import expand, load_scene\n"
        "expand(load_scene(sys.argv[1]))[-1].system()\nprint('made', flush=True)"
    )
    done = python("-c", code, str(file), check=True)
    assert done.stdout == "made\n"


ODD = "type('BaseOdd', (Exception,), {'__str__': lambda self: 7})"


@pytest.mark.long
def test_a_function_that_ends_its_worker_fails_its_members_alone(tmp_path):
    errors = {1.0: "SystemExit(3)", 2.0: "KeyboardInterrupt", 3.0: "BaseException(7)", 4.0: ODD}
    lines = "".join(f"if gap == {gap}: raise {error}\n    " for gap, error in errors.items())
    head = "import numpy as np\nfrom stickslip import System\n"
    text = SCENE.replace("[0.5, 1.0]", str([0.5, *errors]))
    file = written(tmp_path, text, own(f"{lines}return System(np.eye(n), 0.1)", head))
    done = run_ensemble(load_scene(file), tmp_path / "out", workers=1)
    assert done.outcomes["failed"] == 4 * len(errors)
    table = query.members(tmp_path / "out", filters=[("outcome", "=", "failed")])
    assert table.groupby("gap").size().to_dict() == dict.fromkeys(errors, 4)
    words = {gap: "BaseOdd" if error == ODD else error[:10] for gap, error in errors.items()}
    assert all(words[row.gap] in row.reason for row in table.itertuples())


def test_a_function_goes_on_where_a_dataset_ended(tmp_path):
    file = written(tmp_path, SCENE.replace(ENDING, "") + ENDING + "\n[record]\nend = true\n")
    run_ensemble(load_scene(file), tmp_path / "first", workers=0)
    (tmp_path / "next.toml").write_text(SCENE.replace("z = -0.7\nw = -0.4", 'dataset = "first"'))
    ends = query.ends(tmp_path / "first")
    members = expand(load_scene(tmp_path / "next.toml"))
    for one, old in zip(members, expand(load_scene(file)), strict=True):
        z, w = one.start(end_of(one))
        assert np.array_equal(z, ends[old.member_id][0])
        assert np.array_equal(w, ends[old.member_id][1])
        assert np.array_equal(one.system().stiffness, old.system().stiffness)
        run = one.simulate(end=end_of(one))
        again = sim.simulate(one.system(), z, w, t_end=5.0, tol=1e-6)
        assert run.z.tolist() == again.z.tolist()
