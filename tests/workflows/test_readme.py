"""The README says what works: its commands and its Python are run, on a small dataset in place of the big one."""

import re
import shlex
from pathlib import Path

import pytest

from stickslip.workflows.commands import main

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)


COMMANDS = [
    line.removeprefix(".venv/bin/")
    for block in blocks("sh")
    for line in block.splitlines()
    if line.startswith(".venv/bin/stickslip")
]


def test_a_newcomer_needs_two_commands():
    setup = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("python3 -m venv")]
    assert len(setup) == 2
    assert "stickslip run cascades" in setup[0]
    assert setup[1].endswith("python -m pytest -n 2")


def test_commands(dataset, small_scene, tmp_path, monkeypatch, capsys):
    """In the order of the page; the scene that `init` writes is replaced by a smaller one before it is run."""
    monkeypatch.chdir(tmp_path)
    said = [shlex.split(command) for command in COMMANDS]
    assert {argv[1] for argv in said} >= {"init", "run", "report", "query"}
    for argv in said:
        assert argv[0] == "stickslip"
        assert main([{"runs/cascades": str(dataset)}.get(word, word) for word in argv[1:]]) == 0, argv
        assert capsys.readouterr().out.strip()
        if argv[1] == "init":
            (tmp_path / argv[2]).write_text(small_scene.read_text())


@pytest.mark.parametrize("number", range(len(blocks("python"))))
def test_python(number, dataset):
    code = blocks("python")[number].replace("runs/cascades", str(dataset))
    exec(compile(code, f"README.md, block {number + 1}", "exec"), {})
