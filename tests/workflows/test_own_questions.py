"""Questions of a user's own, from the scene to the page: where their code runs, where not, and what can go wrong."""

import hashlib
import re
import sys
from pathlib import Path
from shutil import copytree

import pytest

from stickslip.analysis.findings.words import sentence
from stickslip.analysis.page import parts
from stickslip.pipeline import load_scene, run_ensemble
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.machine.processes import Child
from stickslip.workflows import asking, own_questions, reporting
from stickslip.workflows.commands import main
from stickslip.workflows.dataset import Dataset
from stickslip.workflows.own_questions import Task, answer, put
from tests.scenes import COULOMB, ensemble

MARK = "import pathlib; pathlib.Path(__file__).with_name('ran').touch()\n"
OWN = MARK + (
    'import beside\n\n\ndef question(study):\n    """How many?"""\n    print("printed")\n'
    "    from stickslip.analysis import Alike, Answer, Form, Quantity\n"
    '    runs = Quantity("n", "number of runs", Form.COUNT)\n'
    '    return Answer(findings=[Alike(runs, beside.count(study), "at any time")])\n'
)
BESIDE = "def count(study):\n    return len(study.data.members)\n"
ASKING = 't_burn = 1.0\ndt = 0.5\nquestion = ["own:question", "fates"]'


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a scene, its own question, and its dataset without a report, for which nothing of it was run."""
    place = tmp_path_factory.mktemp("own")
    (place / "mine.toml").write_text(ensemble(5, 8.0, 3, COULOMB, analysis=ASKING))
    (place / "own.py").write_text(OWN)
    (place / "beside.py").write_text(BESIDE)
    run_ensemble(load_scene(place / "mine.toml"), place / "runs" / "mine", workers=0)
    assert not (place / "ran").exists()
    return place


@pytest.fixture
def alone(monkeypatch, place):
    """No processes but those of questions of the user's own, and no mark of these; no figures of ours."""
    monkeypatch.setattr(asking, "MOST_PROCESSES", 1)
    monkeypatch.setattr(parts, "draw", lambda *_, **__: parts.Drawn("<svg/>"))
    (place / "ran").unlink(missing_ok=True)
    (place / "runs" / "mine" / "report.html").unlink(missing_ok=True)


def made(place):
    return (place / "runs" / "mine" / "report.html").read_text()


@pytest.mark.usefixtures("alone")
def test_readers_run_none_of_it_and_a_report_says_so(place, capsys):
    out = str(place / "runs" / "mine")
    reading = [
        ["status", out], ["verify", out], ["query", out, "SELECT count(*) FROM members"], ["report", out],
        ["report", out, "--compare", out],
    ]  # fmt: skip
    assert [main(command) for command in reading] == [0] * len(reading)
    said = capsys.readouterr().out
    line = f"note: own:question was not run; `stickslip report {out} --own` runs the code beside the scene\n"
    assert said.count(line) == 1
    assert "own:question was not run; stickslip report DIR --own runs the code" in made(place)
    assert main(["report", out]) == 0
    said = capsys.readouterr().out
    assert "unchanged" in said
    assert line in said
    Dataset(out).report()
    assert not (place / "ran").exists()
    assert main(["report", out, "--compare", out, "--own"]) == 2
    assert "--own: expected without --compare" in capsys.readouterr().err


@pytest.mark.usefixtures("alone")
def test_own_answers_it_and_the_page_names_its_files(place, capsys):
    out = str(place / "runs" / "mine")
    assert main(["report", out, "--own"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("How many?\nNumber of runs: 3, the same at any time.\n")
    assert "printed" not in said
    assert (place / "ran").exists()
    for name in ("own.py", "beside.py"):
        assert f"{name} (sha256 {sha256(place / name)})" in made(place)
    (place / "ran").unlink()
    assert main(["report", out]) == 0  # what is there is of these data
    assert "unchanged\n" in capsys.readouterr().out
    assert "Number of runs: 3" in made(place)
    assert not (place / "ran").exists()


@pytest.mark.usefixtures("alone", "here")
def test_who_adds_a_record_is_told_how_the_page_answers_its_questions(place, tmp_path, capsys):
    out = str(tmp_path / "more")
    asked = ["--record", "stick_share", "--out", out, "--workers", "1"]
    assert main(["extend", str(place / "runs" / "mine"), *asked]) == 0
    assert f"`stickslip report {out} --own` runs the code beside the scene" in capsys.readouterr().out


def sha256(file):
    return hashlib.sha256(file.read_bytes()).hexdigest()


@pytest.mark.usefixtures("alone")
def test_a_run_refuses_code_that_cannot_be_loaded_before_it_begins(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(ensemble(5, 8.0, 1, COULOMB, analysis=ASKING))
    assert main(["run", "mine.toml", "--workers", "1"]) == 2
    error = capsys.readouterr().err
    assert "mine.toml: analysis.question: own:question: expected the module 'own' beside the scene, in " in error
    assert not Path("runs").exists()


@pytest.mark.long
def test_a_run_answers_it_and_an_edited_one_is_answered_anew(tmp_path, capsys, monkeypatch):
    """The whole command, with its processes; one that fails, or never ends, leaves the page of the others."""
    monkeypatch.setattr(own_questions, "LONGEST", 5.0)
    asked = ASKING.replace('["own:question",', '["own:question", "own:endless",')
    file, out = tmp_path / "mine.toml", str(tmp_path / "runs" / "mine")
    file.write_text(ensemble(5, 8.0, 3, COULOMB, analysis=asked))
    (tmp_path / "beside.py").write_text(BESIDE)
    (tmp_path / "own.py").write_text(f"{OWN}\n\ndef endless(study):\n    while True: pass\n")
    assert main(["run", str(file), "--out", out, "--workers", "1"]) == 1
    said = capsys.readouterr()
    assert said.out.startswith("How many?\nNumber of runs: 3, the same at any time.\n")
    assert "failed  own:endless: expected an answer within 5 s, got none; correct the function\n" in said.err
    shown = Path(out, "report.html").read_text()
    assert "The answer to own:endless: its code failed (expected an answer within 5 s, got none" in shown
    assert '<details id="fates">' in shown
    (tmp_path / "own.py").write_text(OWN.replace("of runs", "of members") + "\n\nendless = question\n")
    assert main(["run", str(file), "--out", out, "--workers", "1"]) == 0
    assert capsys.readouterr().out.startswith("How many?\nNumber of members: 3")


def test_editing_a_question_makes_no_other_data(place, tmp_path):
    """Its code determines no number: a run resumes, and a finished one stays what it is."""
    before = load_scene(place / "mine.toml").hash
    other = ASKING.replace("own:question", "own:another")
    (tmp_path / "mine.toml").write_text(ensemble(5, 8.0, 3, COULOMB, analysis=other))
    (tmp_path / "own.py").write_text("another = 1 +\n")
    scene = load_scene(tmp_path / "mine.toml")
    assert scene.hash == before
    copytree(place / "runs" / "mine", tmp_path / "runs" / "mine")
    assert run_ensemble(scene, tmp_path / "runs" / "mine", workers=0).n_done == 3


# ---------------------------------------------------------------------------------------------- in the child


@pytest.fixture
def asked(place, tmp_path, monkeypatch):
    """What a module's question answers, in this process."""
    study = reporting.study_of(place / "runs" / "mine")
    monkeypatch.setattr(reporting, "study_of", lambda _, whole: study)
    monkeypatch.setattr(sys, "stdin", sys.stdin)  # restored at the end

    def ask(code, **files):
        for name, text in {"own.py": code, **files}.items():
            (tmp_path / name).write_text(text)
        return answer(Task("own:question", str(tmp_path), open_dataset(place / "runs" / "mine")))

    return ask


ANSWER = (
    "from stickslip.analysis import *\ndef question(study):\n    return Answer("
    "findings=[Level(Quantity('size', 'size'), Estimate(3.0))]"
)


@pytest.mark.parametrize(("code", "words"), [
    ("def question(study):\n    x = 1\n    return x / 0\n", r"raised ZeroDivisionError: .* \(own.py, line 3\)$"),
    ("1 / 0", r"it raised ZeroDivisionError: .* \(own.py, line 1\)$"),
    ("def question(:", r"it raised SyntaxError: "),
    ("def questoin(study): pass", r"expected a function 'question' in .*own.py, found none.*'questoin'"),
    ("import nothing_like_it", r"it raised ModuleNotFoundError: .*nothing_like_it"),
    ("def question(study):\n    raise SystemExit(0)", r"it raised RuntimeError: SystemExit: 0"),
    ("def question(study): return input()", r"it raised EOFError"),
    ("def question(study): pass", r"expected a stickslip.analysis.Answer, got None"),
])  # fmt: skip
def test_what_goes_wrong_is_a_line_that_says_where(asked, code, words):
    found = asked(code)
    assert re.search(words, found.problem), found.problem
    assert "\n" not in found.problem
    assert list(found.sources) == ["own.py"]


def test_what_cannot_be_drawn_or_shown_is_left_out_and_the_answer_stands(asked, monkeypatch):
    monkeypatch.setattr(parts, "draw", lambda recipe, _: recipe() and parts.Drawn("<svg/>"))
    figures = "'a': Picture(lambda: 1 / 0, 'A'), 'c': Picture(Figure(), 'C')"
    tables = "'d': pd.DataFrame({'n': [1]}), 'f': []"
    code = "import pandas as pd\nfrom matplotlib.figure import Figure\n" + ANSWER
    found = asked(f"{code},\n    figures={{{figures}}}, tables={{{tables}}})")
    expected = [
        r"figures\['a'\]: expected a Picture.*, but it raised ZeroDivisionError: .* \(own.py, line 6\)",
        r"tables\['f'\]: expected a pandas.DataFrame, got a list",
    ]
    for line, words in zip(found.missing, expected, strict=True):
        assert re.fullmatch(words, line), line
    assert not found.problem
    assert [sentence(finding) for finding in found.answer.findings] == ["Size: 3.00."]
    assert [*found.figures] == ["own-question-c"]
    assert [*found.answer.tables] == ["own-question-d"]


def test_it_is_found_above_the_dataset_and_what_it_loads_is_named(asked, tmp_path):
    deeper = tmp_path / "runs" / "mine"
    deeper.mkdir(parents=True)
    code = "def question(study):\n    import late\n    return late.said"
    late = f"{ANSWER})\nsaid = question(0)\n"
    found = asked(code, **{"late.py": late})
    assert found.sources == {name: sha256(tmp_path / name) for name in ("own.py", "late.py")}
    found = answer(Task("own:question", str(deeper), open_dataset))
    assert found.answer.findings
    sys.modules.pop("late")


@pytest.mark.parametrize(
    ("function", "seconds", "words"),
    [(repr, 0.01, "got none; correct"), (sys._clear_type_cache, 60.0, r"its process ended \(exit code 1\)")],
)
def test_a_process_that_gives_no_answer_is_told(function, seconds, words, monkeypatch):
    monkeypatch.setattr(own_questions, "answer", function)
    with Child() as child:
        found = put(child, Task("own:question", "."), seconds)
    assert re.search(rf"^expected an answer within {seconds:g} s, {words}", found.problem)


def test_names_are_those_with_a_module(place):
    scene = load_scene(place / "mine.toml")
    assert own_questions.names(scene) == ("own:question",)
