"""One name: files of a user's that are named as our folders are break nothing."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.fixture
def users_own(tmp_path, monkeypatch):
    """A folder in which a user keeps files that are named as our folders are."""
    for name in ("sim.py", "pipeline.py", "workflows.py", "analysis/__init__.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("raise SystemExit('the user's own')\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "how", [*(pytest.param(how, marks=pytest.mark.long) for how in ("script", "-c", "command")), "-m"]
)
def test_a_users_files_break_nothing(how, users_own, small_scene):
    code = (
        "if __name__ == '__main__':\n"
        "    from stickslip import members, run_scene, simulate, System\n"
        "    print(simulate(System([[1.0]], 0.5), -3.0, 0.0, 5.0).outcome)\n"
        f"    file = {str(small_scene)!r}\n"
        "    run_scene(file, 'out', workers=1)\n"
        "    print(len(members('out')))\n"
    )
    (users_own / "mine.py").write_text(code)
    run = ["run", str(small_scene), "--out", "out", "--workers", "1"]
    command = {
        "script": [sys.executable, "mine.py"],
        "-c": [sys.executable, "-c", code],
        "-m": [sys.executable, "-m", "stickslip", *run],
        "command": [str(Path(sys.executable).with_name("stickslip")), *run, "--no-report"],
    }[how]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (users_own / "out" / "manifest.json").exists()
