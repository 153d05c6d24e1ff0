"""The guide says what works: its code runs, on small data, its words are the program's, its links lead somewhere."""

from __future__ import annotations

import doctest
import os
import re
import shlex
import sys
import tomllib
import types
from collections import Counter
from pathlib import Path
from urllib.parse import urlsplit

import matplotlib
import numpy as np
import pandas as pd
import pytest
from scipy import stats

from stickslip import Dataset
from stickslip.analysis.findings.finding import Verdict
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.members import OUTCOMES
from stickslip.analysis.models.fates import fate
from stickslip.analysis.questions import QUESTIONS, question
from stickslip.pipeline import SceneError, expand, load_scene, parse_scene, query, run_ensemble
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.records import RECORDS
from stickslip.pipeline.scene import engine_table
from stickslip.sim import IntegrationError, System, draw_system, simulate
from stickslip.sim.engines import ENGINES
from stickslip.sim.systems import couplings
from stickslip.sim.systems.graphs import GRAPHS, Graph
from stickslip.workflows import own_questions
from stickslip.workflows.commands import main
from stickslip.workflows.gallery import CHARTS
from stickslip.workflows.reporting import study_of
from tests.processes import computed_here, python
from tests.scenes import own_law
from tests.sim.contract import require_rules

ROOT = Path(__file__).parents[2]
PAGES = {file.stem: file for file in (ROOT / "docs").rglob("*.md")}
TEXTS = sorted(
    file
    for pattern in ("*.md", "docs/**/*.md", "workflows/**/*.md")
    for file in ROOT.glob(pattern)
    if "_build" not in file.parts
)


#: Files that the page on extending has its reader write.
ADDED = {"largest", "pauses", "width"}


def page(name: str) -> str:
    return PAGES[name].read_text()


def blocks(text: str, language: str) -> list[str]:
    """Fenced code of a language, without the indentation that a list gives it."""
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```", text, flags=re.DOTALL | re.MULTILINE)
    return [re.sub(rf"^{indent}", "", code, flags=re.MULTILINE) for indent, code in found]


def block(name: str, language: str, words: str = "") -> str:
    """The only code of a page that is in this language and has these words."""
    (code,) = (code for code in blocks(page(name), language) if words in code)
    return code


def run_python(name: str, words: str = "") -> dict[str, object]:
    sys.modules["guide"] = guide = types.ModuleType("guide")  # where a dataclass looks for its module
    exec(compile(block(name, "python", words), f"{name}.md", "exec"), guide.__dict__)
    return guide.__dict__


def commands(name: str) -> list[list[str]]:
    lines = [line for block in blocks(page(name), "sh") for line in block.splitlines()]
    return [shlex.split(line)[1:] for line in lines if line.startswith("stickslip ")]


def edited(scene: str, changes: str) -> str:
    """A scene with the lines of the same keys in place of its own."""
    for line in changes.splitlines():
        key = line.partition(" = ")[0]
        scene, n = re.subn(rf"^{key} = .*$", lambda _, line=line: line, scene, flags=re.MULTILINE)
        assert n == 1, line
    return scene


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A directory in which the newcomer's page has been worked through, with fewer matrices and shuffles."""
    place = tmp_path_factory.mktemp("first")
    changes = block("first-run", "toml")
    assert changes.count("matrices = 6") == 1
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        computed_here(patch)
        begin, *rest = commands("first-run")
        assert main(begin) == 0
        scene = edited(Path("mine.toml").read_text(), changes)
        Path("six.toml").write_text(scene)
        Path("mine.toml").write_text(edited(scene, "matrices = 2\nresamples = 20"))
        assert [main(command) for command in rest] == [0] * len(rest)
    return place


# ---------------------------------------------------------------------------------------------- the pages


@pytest.mark.parametrize("name", sorted(name for name, file in PAGES.items() if ">>> " in file.read_text()))
def test_sessions(name):
    """What follows >>> gives what is printed under it."""
    test = doctest.DocTestParser().get_doctest("\n".join(blocks(page(name), "pycon")), {}, name, f"{name}.md", 0)
    assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test).failed == 0


def test_first_scene_does_what_the_page_says(first):
    said = [words[0] for words in commands("first-run")]
    assert {"init", "run", "status", "query"} <= set(said)
    assert (first / "runs" / "mine" / "report.html").stat().st_size > 10_000


@pytest.mark.long
def test_scenes_do_what_the_page_says(here, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = re.findall(r"[Tt]his is `(\w+\.toml)`", page("scenes"))
    for name, scene in zip(names, blocks(page("scenes"), "toml"), strict=True):
        Path(name).write_text(scene)
    run_python("scenes", "K.npz")
    Path("own.py").write_text(block("scenes", "python", "def draw"))
    assert [main(command) for command in commands("scenes")] == [0] * 11
    assert query.members("runs/more").attractor.notna().all()


@pytest.mark.long
def test_sweeps_do_what_the_page_says(here, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("sweep", "starts"):
        Path(f"{name}.toml").write_text(block("sweeps", "toml", {"sweep": "belt_speed", "starts": "draws"}[name]))
    assert [main(command) for command in commands("sweeps")] == [0] * 5
    said = capsys.readouterr().out
    (grid,) = re.findall(r"`(grid +.*?)`", page("sweeps"))
    assert f"\n{grid}\n" in said
    assert "friction = uniform(0.8, 1.2); z = uniform(-1, 1); w = normal(0, 0.1)" in said
    members = query.members("runs/sweep")
    (name,) = re.findall(r"`(n20-m.*?)`", page("sweeps"))
    assert name in set(members.member_id)
    assert members.groupby(["friction", "belt_speed"]).size().tolist() == [2] * 6
    groups = study_of("runs/sweep").groups  # the page tells the settings apart
    assert len({(group.key["friction"], group.key["belt_speed"]) for group in groups}) == len(groups) == 6


def test_first_scene_in_python(first, monkeypatch):
    monkeypatch.chdir(first)
    names = run_python("first-run", "import members")
    assert len(names["table"]) == 8
    assert len(names["t"]) == len(names["count"]) > 1
    monkeypatch.setitem(matplotlib.rcParams, "backend", "agg")
    assert run_python("first-run", "draw_system")["run"].outcome == "finished"


@pytest.mark.long
def test_first_scene_as_a_script(first, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(block("first-run", "python", "run_scene("))
    (tmp_path / "mine.toml").write_bytes((first / "mine.toml").read_bytes())
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = python(str(script), cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("8 members {")
    outcomes = re.findall(r"^\| `(\w+)` \|", page("first-run"), flags=re.MULTILINE)
    assert set(outcomes) == set(OUTCOMES)
    assert next((tmp_path / "runs" / "mine" / "data").iterdir()).read_bytes() == (
        next((first / "runs" / "mine" / "data").iterdir()).read_bytes()
    )


def test_first_scene_counts_the_members(first):
    """The page's numbers are those of the scene that it makes."""
    scene = parse_scene((first / "six.toml").read_bytes())
    assert f"make {scene.n_members} members" in page("first-run")
    table = blocks(page("first-run"), "text")[0].splitlines()[1:]
    assert sum(int(row.split()[-1]) for row in table) == scene.n_members


def test_first_scene_gets_the_answer_that_the_page_gives(first, tmp_path):
    """With its six matrices: the table of outcomes, and who still moves at the end."""
    source = (first / "six.toml").read_bytes()
    run_ensemble(parse_scene(source), tmp_path / "mine", workers=0)
    (command,) = (words for words in commands("first-run") if words[0] == "query")
    rows = [tuple(map(str, row)) for row in query.sql(tmp_path / "mine", command[2]).itertuples(index=False)]
    assert rows == [tuple(line.split()) for line in blocks(page("first-run"), "text")[0].splitlines()[1:]]
    series = query.series(tmp_path / "mine")
    fates = Counter(
        (row.n, fate(row.outcome, series[row.member_id], 200.0))
        for row in query.members(tmp_path / "mine").itertuples()
    )
    assert fates == {(60, "collapsed"): 5, (60, "quiet"): 7, (120, "quiet"): 1, (120, "sustained"): 11}


def test_the_questions_are_those_of_a_report():
    listed = re.findall(r"^\| ([^|]+\?) \| `(\w+)` \|", page("reading"), flags=re.MULTILINE)
    titles = {key: question(key).title for key in QUESTIONS}
    assert {key: name for name, key in listed} == titles


def test_the_records_are_those_of_a_scene():
    section = page("scenes").partition("\n## Records")[2].partition("\n## ")[0]
    columns = {record.name: {column.name for column in record.columns} for record in RECORDS}
    assert columns.keys() - re.findall(r"`(\w+)[ `]", section) == {"contacts", "thresholds"}  # no keys of [record]
    for name, words in re.findall(r"^\| `(\w+) = .*?` \| (.*) \|$", section, flags=re.MULTILINE):
        assert {*re.findall(r"`(\w+)`", words)} - columns[name] <= {"amplitude_bit"}, name


def test_the_words_of_a_difference_are_those_of_findings():
    table = page("reading").partition("| interval of the difference | words |")[2].partition("\n\n")[0]
    words = re.findall(r"\*([a-z ]+)\*", table)
    source = "\n".join(file.read_text() for file in (ROOT / "analysis").rglob("*.py"))
    assert {"above", "below", "within", "no difference"} <= set(words)
    assert [word for word in words if f" {word} " not in source and f'"{word}"' not in source] == []


def test_a_drill_string_from_toml_to_page(tmp_path, monkeypatch, capsys):
    """At which speeds it sticks and slips, how far the bit swings, with which period: in seconds and radians."""
    monkeypatch.chdir(tmp_path)
    computed_here(monkeypatch)
    Path("drill.toml").write_text(block("systems", "toml"))
    assert [main(command) for command in commands("systems")] == [0, 0]
    lead = (
        "Steady sliding and stick-slip both attract at drive_speed = 2 to 5.0 rad/s; the upper end is known from"
        " grazing of the cycle."
    )
    assert lead in capsys.readouterr().out
    table = query.members("runs/drill").sort_values("drive_speed")
    assert table["attractor"].tolist() == ["periodic", "periodic", "sliding"]
    dataset = Dataset("runs/drill")
    for row in table.itertuples():
        member = dataset.member(row.member_id)
        run, scales = member.simulate(), dataset.scene.scales
        if row.attractor == "periodic":
            onsets = run.events.t[run.events.is_exit & (run.events.block == 19)] * scales.time
            assert row.period == pytest.approx(np.diff(onsets)[-1], rel=1e-6)
    page = Path("runs/drill/report.html").read_text()
    assert "mean amplitude of bit (rad)" in page
    assert "Quantities are in s, rad, kg m^2." in page
    assert "dimensionless" not in page


def test_a_record_of_a_function(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    computed_here(monkeypatch)
    Path("mine.py").write_text(block("own", "python", "class Measured"))
    Path("quiet.toml").write_text(block("own", "toml", "mine:quiet"))
    assert [main(command) for command in commands("own")] == [0] * 3
    assert "hare of blocks that never slip after t_burn rises by " in capsys.readouterr().out
    table = query.members("runs/quiet")
    assert table.own_problem.isna().all()
    assert 0 < table.stuck_share.mean() < 1
    assert (table.last_exit.isna() == (table.stuck_share == 1)).all()


def test_a_law_of_friction_in_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("lorentz.py").write_text(own_law())
    found = run_python("systems", "from lorentz import")
    assert found["stops"] == pytest.approx(26.0, rel=1e-12)
    assert abs(float(capsys.readouterr().out)) < 1e-10


def test_the_numbers_of_a_report_in_python(first, monkeypatch):
    monkeypatch.chdir(first)
    answer = run_python("reading")["answer"]
    assert set(answer.verdict.dropna()) <= {*Verdict}
    assert answer.sentence.str.endswith(".").all()
    assert len(answer) > 0


def test_the_tolerances_are_those_that_are_picked():
    from stickslip.pipeline.scene.engine_table import TOLERANCES

    rows = re.findall(r"^\| .*? \| (1e-\d+) \| (1e-\d+) \|$", page("engines"), flags=re.MULTILINE)[:2]
    assert [tuple(map(float, row)) for row in rows] == [(t["tol"], t["rtol"]) for t in TOLERANCES.values()]


# ---------------------------------------------------------------------------------------------- extending


def test_a_coupling_is_one_line(monkeypatch):
    line = block("extending", "python", '"row"')
    new = eval(f"{{{line}}}", vars(couplings))
    ((name, coupling),) = new.items()
    monkeypatch.setitem(couplings.COUPLINGS, name, coupling)
    k = draw_system(name, 9, 5).stiffness
    assert np.count_nonzero(k) == 9 + 16
    np.testing.assert_array_equal(np.triu(k, 1), -np.tril(k, -1).T)
    source = (ROOT / "workflows" / "scenes" / "quick.toml").read_text().replace('"antisymmetric"', f'"{name}"')
    scene = parse_scene(source.encode())
    assert scene.system.bytes_of_system >= draw_system(name, max(scene.system.n), 5).stiffness.nbytes
    assert next(iter(expand(scene))).simulate().outcome in ("finished", "collapsed")
    with pytest.raises(SceneError, match=r"keep what coupling = \"row\" is, \[\"relative\"\], got"):
        parse_scene(source.encode() + b"[perturbation]\nsizes = 0.1\n")


@pytest.mark.parametrize("takes", [("degree",), ()])
def test_a_graph_is_one_line(takes, monkeypatch):
    """Its mean degree is a key of a scene, and swept, if it says that it has one."""
    monkeypatch.setitem(GRAPHS, "other", Graph(GRAPHS["network"].pairs, takes))
    source = (
        '[system]\ncoupling = "other"\nn = 12\ndegree = [2.0, 4.0]\n[start]\nz = 0.1\nw = 0.0\n'
        '[run]\nt_end = 1.0\nmatrices = 1\n[[engine]]\nname = "coulomb"\n[analysis]\nt_burn = 0.1\ndt = 0.1\n'
    )
    if not takes:
        with pytest.raises(SceneError, match='degree: expected none with coupling = "other"'):
            parse_scene(source)
        return
    few, many = (member.system().stiffness.nnz for member in expand(parse_scene(source)))
    assert (few, many) == (12 + 12 * 2, 12 + 12 * 4)


def test_a_question_is_a_file(first):
    study = study_of(str(first / "runs" / "mine"))
    found = run_python("extending", "QUESTION")["QUESTION"].answer(study)
    pauses = found.tables["pauses"]
    assert len(pauses) == sum(group.n_runs for group in study.groups) > 0
    means = pauses.groupby("group").pause.mean()  # each system has one run
    assert {str(level.where): level.estimate.value for level in found.findings} == pytest.approx(
        means.to_dict(), rel=1e-12
    )
    assert sentence(found.findings[0]).startswith("Longest time without a change of n_stick, ")


def test_a_question_of_ones_own_is_a_function_beside_the_scene(tmp_path, monkeypatch):
    """Its sentence is that of the dataset: the means over matrices, by another way."""
    Path(tmp_path / "mine.toml").write_text(block("own", "toml", "own:question"))
    Path(tmp_path / "own.py").write_text(block("own", "python", "def question"))
    run_ensemble(load_scene(tmp_path / "mine.toml"), tmp_path / "out", workers=0)
    monkeypatch.setattr(sys, "stdin", sys.stdin)  # restored at the end
    (task,) = own_questions.tasks(open_dataset(tmp_path / "out"), tmp_path / "out", with_pdf=False)
    found = own_questions.answer(task)
    assert found.problem == ""
    means = query.members(tmp_path / "out").groupby("belt_speed")["stick_share"].mean()
    table = found.answer.tables["own-question-shares"].set_index("belt_speed")
    np.testing.assert_allclose(table["share"].astype(float), means.loc[table.index], rtol=1e-12)
    first, *levels = found.answer.findings
    assert first.estimate.value == pytest.approx(means.max(), rel=1e-12)
    assert first.where == Place.key("belt_speed", f"{means.idxmax():g}")
    assert len(levels) == len(means)
    assert found.title == "At which belt speed do blocks stick longest?"
    assert [*found.figures] == ["own-question-shares"]
    exec(block("own", "python", "def question") + block("own", "python", "def paired"), names := {})
    (change,) = names["paired"](study_of(tmp_path / "out")).findings
    by_belt = query.members(tmp_path / "out").pivot_table(index="matrix", columns="belt_speed", values="stick_share")
    known = stats.ttest_rel(by_belt[-0.1], by_belt[-0.2]).confidence_interval()
    assert change.difference.estimate.low == pytest.approx(known.low)
    assert sentence(change).startswith("Share of the time that a block sticks rises by ")


def test_a_chart_is_a_file_and_a_template(tmp_path, monkeypatch, capsys):
    named = re.search(r'`"width": "stickslip.workflows.gallery.charts.(width:\w+)"`', page("extending"))[1]
    (tmp_path / "width.py").write_text(block("extending", "python", "class WidthScene"))
    (tmp_path / "width.html").write_text(block("extending", "jinja", "chart.html"))
    scene = block("extending", "toml")
    (tmp_path / "width.toml").write_text(scene)
    assert {"about", "minutes"} <= set(tomllib.loads(scene))  # without which no scene ships
    assert all("#" in line for line in scene.strip().splitlines())
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(CHARTS, "width", named)
    assert main(["run", str(tmp_path / "width.toml"), "--out", str(tmp_path / "out")]) == 0
    title, thin, wide, *_ = capsys.readouterr().out.splitlines()
    assert title == "What a thin layer costs"
    assert thin.startswith("A sigmoid of width 0.001 takes ")
    costs = pd.read_parquet(tmp_path / "out" / "report" / "costs.parquet")
    assert costs.products[0] > costs.products[1] > 0
    assert f" {costs.products[1]:.0f} products" in wide


def test_an_engine_is_a_class_with_its_settings(monkeypatch, rng):
    engine = run_python("extending", "class FixedStep")["FixedStep"]
    monkeypatch.setitem(ENGINES, engine.name, engine)
    system = draw_system("antisymmetric", 5, 3)
    run = simulate(system, -0.7, -0.4, 2.0, engine="fixed_step", eps=0.1, step=0.001, t_eval=[1.0, 2.0])
    exact = simulate(system, -0.7, -0.4, 2.0, engine="sigmoid", eps=0.1, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(run.z, exact.z, atol=1e-8)
    np.testing.assert_array_equal(run.samples.z[1], run.z)
    table = engine_table._table(engine).model_validate({"name": "fixed_step", "step": 0.01})
    assert table.settings == {"eps": 0.03, "step": 0.01}
    with pytest.raises(ValueError, match="greater than 0"):
        engine_table._table(engine).model_validate({"name": "fixed_step", "step": 0.0})
    with pytest.raises(ValueError, match=r"^step: expected a number in \(0, inf\)"):
        simulate(system, -0.7, -0.4, 2.0, engine="fixed_step", step=0.0)
    require_rules("fixed_step", rng, step=0.01)
    with pytest.warns(RuntimeWarning), pytest.raises(IntegrationError, match="no finite state at t = 100; take"):
        simulate(System([[-400.0]], 0.0, 1.0, -0.2), 1.0, 0.0, 100.0, engine="fixed_step", step=0.01)


def test_what_the_steps_name_is_there():
    """Names in the text; those of the examples stand in their code."""
    text = re.sub(r"^ *```.*?^ *```", "", page("extending"), flags=re.DOTALL | re.MULTILINE)
    files = (
        file
        for floor in ("sim", "pipeline", "analysis", "workflows", "tests")
        for file in (ROOT / floor).rglob("*.py")
    )
    source = "\n".join(file.read_text() for file in files if file != Path(__file__))
    named = set(re.findall(r"`(?:[a-z]+\.)*([A-Za-z_]\w+)`", text))
    assert {"COUPLINGS", "CHARTS", "QUESTIONS", "Several"} <= named
    assert [name for name in sorted(named) if not re.search(rf"\b{name}\b", source)] == []


# ---------------------------------------------------------------------------------------------- names and links


def test_every_command_is_one_that_exists(capsys):
    for file in TEXTS:
        for block in blocks(file.read_text(), "sh"):
            for line in block.replace("\\\n", "").splitlines():
                words = shlex.split(line, comments=True)
                if words and words[0].endswith("stickslip"):
                    with pytest.raises(SystemExit) as ended:
                        main([words[1], "--help"])
                    assert ended.value.code == 0, f"{file.name}: {line}"


def test_every_extra_is_one_that_exists():
    extras = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])
    for file in TEXTS:
        for named in re.findall(r'(?:stickslip|\.)\[([\w,]+)\]"', file.read_text()):
            assert set(named.split(",")) <= extras, f"{file.name}: {named}"


def test_every_file_that_is_named_is_there():
    for file in TEXTS:
        if file.name != "CHANGELOG.md":  # which says what was, too
            for named in re.findall(
                r"`((?:sim|pipeline|analysis|workflows|tests|docs)/[a-z_/]+\.\w+)`", file.read_text()
            ):
                assert (ROOT / named).exists() or Path(named).stem in ADDED, f"{file.name}: {named}"


def anchors(file: Path) -> set[str]:
    """Of the headings, as they are made into addresses."""
    headings = re.findall(
        r"^#+ (.*)$", re.sub(r"```.*?```", "", file.read_text(), flags=re.DOTALL), flags=re.MULTILINE
    )
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("file", TEXTS, ids=lambda file: str(file.relative_to(ROOT)))
def test_links(file):
    """Inside the project: file and heading are there. Elsewhere: the form of an address, as no network is needed."""
    text = re.sub(r"```.*?```", "", file.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(<?([^)\s>]+)>?\)", text):
        address = urlsplit(target)
        if address.scheme:
            assert address.scheme == "https", target
            assert re.fullmatch(r"[\w-]+(\.[\w-]+)+", address.netloc), target
            continue
        where = (file.parent / address.path).resolve() if address.path else file
        assert where.exists(), target
        assert not address.fragment or address.fragment in anchors(where), target
