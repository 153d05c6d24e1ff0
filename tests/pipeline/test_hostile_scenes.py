"""Scenes that would take for ever to read: refused in one line, before that."""

from __future__ import annotations

import glob
import os

import pytest

from stickslip.pipeline import SceneError, load_scene
from stickslip.pipeline.scene import systems
from tests.scenes import COULOMB, ensemble

SCENE = ensemble(4, 5.0, 4, COULOMB)
OF_FILES = SCENE.replace('"antisymmetric"\nn = 4', '"file"\npath = "{}"\nrho = 3.5').replace("matrices = 4\n", "")
MANY = 200_000

SCENES = {
    "dots": (f"a{'.a' * MANY} = 1\n{SCENE}", "line 1: expected a key of at most 20 parts"),
    "dots of a table": (f"{SCENE}[a{' . a' * MANY}]", "expected a key of at most 20 parts"),
    "dots between quotes": ("a = {" + '"a".' * MANY + "a = 1}\n" + SCENE, "line 1: expected a key of at most"),
    "lines": ("\n" * MANY + SCENE, "expected at most 100000 lines, got "),
    "keys": (f"{SCENE}x = {{{', '.join(f'k{k} = 1' for k in range(5000))}}}",
        "analysis.x: expected at most 1000 keys"),
    "tables": (SCENE + f"[[engine]]\n{COULOMB}\n" * 2000, "engine: expected at most 1000 tables, got 2001"),
    "bytes": (f'title = "{"x" * 5_000_000}"\n{SCENE}', "expected at most 4000000 bytes"),
    "brackets": (f"title = {'[' * MANY}\n{SCENE}", "expected TOML"),
    "braces": (f"title = {'{a = ' * MANY}\n{SCENE}", "expected TOML"),
    "values": (SCENE.replace("n = 4", f"n = 4\nkappa = {[0.1] * MANY}"), "expected 1 to 1000 values, got 200000"),
    "all files": (OF_FILES.format("/**/*"), "system.path: expected no **, got '/**/*'; write * for each folder"),
    "all directories": (OF_FILES.format("/*/*/*/*/*/*/x*"), "system.path: expected at most 10000 files, among 1"),
    "a long pattern": (OF_FILES.format("*a" * 3000), "system.path: expected a file, or several by a pattern"),
    "a key that is a command to a terminal": (SCENE + '["\\u001b[31m\\n"]\n', r"\x1b[31m: unknown key of a scene"),
    "a hexadecimal seed without an end": (SCENE.replace("[run]\n", f"[run]\nseed = 0x{'f' * 100_000}\n"),
        "expected TOML"),
    "a long name": (SCENE.replace("z = -0.7\nw = -0.4", f'dataset = "{"../" * MANY}"'),
        "start.dataset: expected a path, got OSError"),
    "a name that no path has": (SCENE.replace("z = -0.7\nw = -0.4", 'dataset = "a\\u0000"'),
        "start.dataset: expected a path, got ValueError"),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_a_hostile_scene_is_refused_in_one_line(name, tmp_path):
    text, expected = SCENES[name]
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(SceneError) as refusal:
        load_scene(tmp_path / "scene.toml")
    assert expected in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 500


def test_a_pipe_that_nobody_writes_to_is_an_empty_scene(tmp_path):
    os.mkfifo(tmp_path / "scene.toml")
    with pytest.raises(SceneError, match="system: expected a table, found none"):
        load_scene(tmp_path / "scene.toml")


def test_patterns_name_what_they_name_in_python(tmp_path, rng):
    folders = [tmp_path]
    for name in ("a", "ab", ".hidden", "[x]"):
        folders += [folder / name for folder in folders if len(folder.parts) < len(tmp_path.parts) + 3]
    for folder in folders:
        folder.mkdir(exist_ok=True)
        for name in rng.choice(["K.npz", "K1.npz", ".K.npz", "a.mtx", "b[1].npz"], 3, replace=False):
            (folder / name).touch()
    (tmp_path / "link").symlink_to(tmp_path / "a")
    for pattern in (
        "*", "*.npz", "*/*.npz", "a/*/K*.npz", "*/*/[Kb]*", "*/a*/*.mtx", "a*/../*.npz", "[[]x]/*", "no/*",
        "*/b[[]1].npz", "lin?/K*", str(tmp_path / "*/K?.npz"),
    ):  # fmt: skip
        found = glob.glob(pattern, root_dir=tmp_path)
        files = {tmp_path / name for name in found if os.path.isfile(tmp_path / name)}
        assert systems._matching(tmp_path, pattern) == sorted(files), pattern
