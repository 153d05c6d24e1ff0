"""The README says what works: its commands and its Python are run, on a small dataset in place of the big one."""

import re
import shlex
from pathlib import Path

import pytest

from workflows.cli import main

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
    assert setup[1].endswith("python -m pytest")


@pytest.mark.parametrize("command", COMMANDS)
def test_command(command, dataset, small_scene, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    argv = [
        {"runs/cascades": str(dataset), "runs/mine": str(dataset)}.get(word, word)
        for word in shlex.split(command.replace("workflows/scenes/quick.toml", str(small_scene)))
    ]
    assert argv[0] == "stickslip"
    assert main(argv[1:]) == 0
    assert capsys.readouterr().out.strip()


@pytest.mark.parametrize("number", range(len(blocks("python"))))
def test_python(number, dataset, monkeypatch):
    code = blocks("python")[number].replace("runs/cascades", str(dataset))
    exec(compile(code, f"README.md, block {number + 1}", "exec"), {})


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
