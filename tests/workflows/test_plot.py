"""`stickslip plot`: a picture of a member from its dataset."""

import argparse
import re

import matplotlib.pyplot as plt
import pytest

from stickslip import Dataset
from stickslip.analysis import pictures
from stickslip.pipeline import parse_scene, run_ensemble
from stickslip.workflows.commands import main
from stickslip.workflows.commands.plot import Plot
from tests.scenes import ENDING

SOURCE = f"""\
start = "rest"
[system]
coupling = "grid"
n = 6
weakening = {{law = "rational", rate = 2.0}}
back_slip = false
[run]
t_end = 20.0
matrices = 2
[record]
events = true
{ENDING}"""


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    path = tmp_path_factory.mktemp("plot")
    run_ensemble(parse_scene(SOURCE.encode()), path / "out", workers=0)
    run_ensemble(parse_scene(SOURCE.replace("events = true", "").encode()), path / "bare", workers=0)
    return path


@pytest.fixture
def member(kept):
    return Dataset(kept / "out").members.member_id[0]


@pytest.mark.parametrize(
    ("kind", "name", "begins"),
    [("space_time", "a.svg", b"<?xml"), ("n_stick", "a.pdf", b"%PDF"), ("slip", "a.PNG", b"\x89PNG")],
)
def test_a_picture_is_a_file_and_twice_the_same(kept, member, tmp_path, kind, name, begins, capsys):
    contents = set()
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        file = tmp_path / folder / name
        more = ["--kind", kind, "--span", "5", "15"]
        assert main(["plot", str(kept / "out"), member, *more, "--out", str(file)]) == 0
        assert capsys.readouterr().out == f"picture {file}\n"
        contents.add(file.read_bytes())
    assert len(contents) == 1
    assert contents.pop().startswith(begins)


def test_the_help_names_the_kinds_that_need_no_samples(kept, member):
    """Those that it names are drawn, and the others ask for samples."""
    series = Dataset(kept / "out").events(member)
    parser = argparse.ArgumentParser()
    Plot().add_arguments(parser)
    said = next(action.help for action in parser._actions if action.dest == "kind")
    named = set(re.findall(r"\w+", said)) & set(pictures.KINDS)
    for kind in named:
        plt.close(series.plot(kind, **({"width": 3} if kind == "slip" else {})).figure)
    for kind in set(pictures.KINDS) - named:
        with pytest.raises(ValueError, match="t_eval"):
            series.plot(kind)


@pytest.mark.parametrize(("arguments", "says"), [
    (["out", "{member}", "--kind", "space-time", "--out", "a.svg"], "--kind: expected one of n_stick, space_time"),
    (["out", "{member}", "--kind", "phase", "--out", "a.svg"], "--kind: 'phase' draws the state at given times"),
    (["out", "{member}", "--span", "5", "2", "--out", "a.svg"], "--span: expected two times, rising"),
    (["out", "{member}", "--out", "a.gif"], "--out: expected a file named .svg, .pdf, .png, got a.gif"),
    (["out", "{member}", "--out", "out/data/a.svg"], "--out: expected a file outside the dataset"),
    (["out", "{member}", "--out", "nowhere/a.svg"], "does not exist"),
    (["out", "nobody", "--out", "a.svg"], "member_id: expected a member that is done, got 'nobody'"),
    (["bare", "{member}", "--out", "a.svg"], "events: expected a dataset with events"),
])  # fmt: skip
def test_what_cannot_be_drawn_is_refused(kept, member, monkeypatch, arguments, says, capsys):
    monkeypatch.chdir(kept)
    assert main(["plot", *(one.format(member=member) for one in arguments)]) == 2
    assert says in capsys.readouterr().err
    assert not list(kept.glob("a.*"))


def test_a_map_of_slips_is_of_a_grid_alone(tmp_path, capsys):
    run_ensemble(parse_scene(SOURCE.replace('"grid"', '"chain"').encode()), tmp_path / "out", workers=0)
    member = Dataset(tmp_path / "out").members.member_id[0]
    assert main(["plot", str(tmp_path / "out"), member, "--kind", "slip", "--out", str(tmp_path / "a.svg")]) == 2
    assert "--kind: 'slip' is a map of a grid, and these blocks form none" in capsys.readouterr().err
