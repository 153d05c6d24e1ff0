"""Before the first run: a scene begun by the command, and the schema that editors use."""

import errno
import json
import os
import re
import tomllib
from importlib.metadata import version

import jsonschema
import pytest

import stickslip
from stickslip import analysis, pipeline, sim
from stickslip.analysis.questions import QUESTIONS
from stickslip.pipeline import Scene, load_scene
from stickslip.pipeline.design.values import DISTRIBUTIONS
from stickslip.pipeline.scene.engine_table import TOLERANCES
from stickslip.pipeline.scene.toml import json_schema
from stickslip.sim import COUPLINGS
from stickslip.workflows.commands import main
from stickslip.workflows.gallery import CHARTS
from stickslip.workflows.gallery import chart as chart_scene
from stickslip.workflows.scaffold import SCHEMA, schema_text
from stickslip.workflows.scenes import chart_of, find, shipped
from tests.pipeline.conftest import SOURCE
from tests.pipeline.test_scene import BAD
from tests.processes import python


def problems(schema, table):
    return [error.message for error in jsonschema.Draft7Validator(schema).iter_errors(table)]


@pytest.mark.parametrize("name", shipped())
def test_what_ships_is_as_the_schema_says(name):
    chart = chart_of(find(name))
    schema = json_schema(Scene if chart is None else chart_scene(chart))
    jsonschema.Draft7Validator.check_schema(schema)
    assert problems(schema, tomllib.loads(find(name).read_text())) == []


@pytest.mark.parametrize("mistake", [
    "unknown key",
    "unknown table",
    "key of the other engine",
    "missing table",
    "missing key",
    "text for a number",
    "number for a count",
    "negative n",
    "huge n",
    "empty n",
    "negative step",
    "huge seed",
    "unknown coupling",
    "unknown engine",
])  # fmt: skip
def test_the_schema_sees(mistake):
    """Before the command does."""
    old, new, _ = BAD[mistake]
    small = SOURCE.decode()
    assert problems(json_schema(Scene), tomllib.loads(small)) == []
    assert problems(json_schema(Scene), tomllib.loads(small.replace(old, new)))


def test_every_form_that_the_scene_takes_the_schema_takes(small_scene, tmp_path):
    """A number for a list, one engine as a plain table, what is left out."""
    text = small_scene.read_text().replace('[[engine]]\nname = "sigmoid"\n', "").replace("[[engine]]", "[engine]")
    text = text.replace("dt = [0.5]", "dt = 1").replace("n = 12", "n = [12, 13]")
    text = text.replace("[record]\nevents = true\n", '[perturbation]\nreadings = "relative"\nsizes = 0.1\n')
    file = tmp_path / "other.toml"
    file.write_text(text)
    assert load_scene(file).n_members == 2 * 3 * 2
    assert problems(json_schema(Scene), tomllib.loads(text)) == []


@pytest.mark.parametrize("start", ['"rest"', '{dataset = "runs/first"}', '{z = "end", w = "belt"}', "{z = 0.0}"])
def test_the_schema_knows_every_start(start, small_scene):
    text = re.sub(r"^\[start\]\nz = .*\nw = .*\n", "", small_scene.read_text(), flags=re.MULTILINE)
    found = problems(json_schema(Scene), tomllib.loads(f"start = {start}\n{text}"))
    assert bool(found) == (start == "{z = 0.0}")


def test_every_key_is_described():
    """What an editor shows beside a key; tables are described by themselves."""
    for schema in [json_schema(Scene), *(json_schema(chart_scene(chart)) for chart in CHARTS)]:
        tables = [schema, *schema.get("$defs", {}).values()]
        for table in tables:
            for key, found in table.get("properties", {}).items():
                assert found.get("description") or "$ref" in found or "const" in found, key
        assert "null" not in json.dumps(schema)  # TOML has none


@pytest.mark.parametrize("name", ["mine", "mine.toml"])
def test_init_writes_a_scene_that_runs_and_refuses_to_write_over_it(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["init", name]) == 0
    said = capsys.readouterr().out
    text = (tmp_path / "mine.toml").read_text()
    assert text.startswith(f"#:schema ./{SCHEMA}\n")
    assert (tmp_path / SCHEMA).read_text() == schema_text(None)
    assert load_scene("mine.toml").hash == load_scene(find("quick")).hash
    assert "minutes" not in tomllib.loads(text)  # of the machine that measured `quick`
    for line in text.splitlines():
        assert re.match(r"\s*$|#|\[\[?\w+\]\]?|\w+ = .+ # .+|name = ", line), line  # every key has its comment
    command = re.search(r"stickslip (run mine.toml --dry-run)", said)[1]
    assert main(command.split()) == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["mine.toml", SCHEMA]
    (tmp_path / "mine.toml").write_text("mine")
    assert main(["init", name]) == 2
    assert "which exists; choose another" in capsys.readouterr().err
    assert (tmp_path / "mine.toml").read_text() == "mine"
    (tmp_path / "scenes").mkdir()
    assert main(["init", "scenes"]) == 2
    assert "got the directory 'scenes'; name a file in it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "code", "words"),
    [
        (["init", "none/mine.toml"], 1, "none'; the folder does not exist: create it or choose another"),
        (["init", f"{'x' * 300}.toml"], 1, "; its name or path is too long: shorten it, then rerun the command"),
        (["init", "/proc/self/stat/mine.toml"], 1, "; what it has for a folder is none: correct the path"),
        (["schema", "stabilty"], 2, "expected one of limit, one_block, paper, "),
    ],
)
def test_what_cannot_be_written(argv, code, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(argv) == code
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_schema_is_printed(capsys):
    assert main(["schema"]) == 0
    printed = json.loads(capsys.readouterr().out)
    named = printed["$defs"]["AnalysisTable"]["properties"]["question"]["anyOf"]
    for name in (named[0], named[1]["items"]):  # which pipeline does not know
        known, own = name.pop("anyOf")
        assert known == {"enum": list(QUESTIONS)}
        name |= own
    assert printed == json_schema(Scene)
    assert main(["schema", "stability"]) == 0
    assert "stiffness" in json.loads(capsys.readouterr().out)["properties"]


def listed(chart, capsys):
    """The lines of `schema --keys`, by path; a path may stand in the tables of several engines."""
    assert main(["schema", *([chart] if chart else []), "--keys"]) == 0
    _, *lines = capsys.readouterr().out.splitlines()
    return [line.split(maxsplit=1) for line in lines if re.match(r"[a-z_.]+ .*\)$", line)]


def paths(table, path=""):
    for key, value in table.items():
        for found in value if isinstance(value, list) else [value]:
            if isinstance(found, dict) and not found.keys() & {*DISTRIBUTIONS, "times"}:
                yield from paths(found, f"{path}{key}.")
            elif key != "name":
                yield path + key


@pytest.mark.parametrize("name", shipped())
def test_the_list_of_keys_has_all_that_scenes_use(name, capsys):
    known = {path for path, _ in listed(chart_of(find(name)), capsys)}
    assert set(paths(tomllib.loads(find(name).read_text()))) <= known


def test_the_list_of_keys_is_the_schema(capsys):
    schema = json_schema(Scene)
    fields = [field for table in [schema, *schema["$defs"].values()] for field in table["properties"].items()]
    keys = [key for key, field in fields if key != "name" and "$ref" not in json.dumps(field)]
    found = listed(None, capsys)
    assert sorted(path.rpartition(".")[2] for path, _ in found) == sorted(keys)
    words = dict(found)
    assert all(f'"{name}"' in words["system.coupling"] for name in COUPLINGS)
    assert words["run.purpose"].endswith('("statistics", "paths")')
    assert re.fullmatch(r"required, e\.g\. 1000\.0 +end of each run \(number > 0\)", words["run.t_end"])
    for key in ("tol", "rtol", "atol"):
        picked = [f"{tolerances[key]:g}" for tolerances in TOLERANCES.values()]
        assert words[f"engine.{key}"].startswith(f"picked, {picked[0]} or {picked[1]} ")


def test_one_import_has_the_contract():
    assert {*sim.__all__, "__version__", "Scene", "run_scene", "members", "n_stick", "gamma"} <= set(
        stickslip.__all__
    )
    assert all(getattr(stickslip, name) is getattr(sim, name) for name in sim.__all__)
    assert stickslip.__version__ == version("stickslip")


@pytest.mark.parametrize(
    ("package", "room", "heavy"),
    [
        (stickslip, "stickslip.sim", {"dask", "pandas", "pyarrow", "matplotlib"}),
        (pipeline, "stickslip.pipeline.scene.scene", {"dask", "pandas", "pyarrow"}),
        (analysis, "stickslip.analysis.style", {"pandas", "scipy.stats", "jinja2"}),
    ],
)
def test_a_package_loads_its_rooms_as_they_are_asked_for(package, room, heavy):
    assert len(package.__all__) > 10
    assert all(getattr(package, name) is not None for name in package.__all__)
    with pytest.raises(AttributeError, match="nonesuch"):
        package.nonesuch  # noqa: B018  # asking is the test
    code = f"import sys, {room}; sys.exit(', '.join({heavy!r} & set(sys.modules)) or 0)"
    done = python("-c", code)
    assert done.returncode == 0, done.stderr


def test_a_full_disk_leaves_no_part_of_a_new_scene(tmp_path, monkeypatch, capsys):
    """Else a later `init` would keep a schema that was cut short."""
    fsync, calls = os.fsync, []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert main(["init", str(tmp_path / "mine.toml")]) == 1
    assert "No space left on device" in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == []
    assert main(["init", str(tmp_path / "mine.toml")]) == 0
    assert (tmp_path / SCHEMA).read_text() == schema_text(None)
