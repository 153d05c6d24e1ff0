"""Names of a function's parameters: every word of Python and of SQL is a column like others, or refused in a line."""

from __future__ import annotations

import keyword

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stickslip.pipeline import SceneError, expand, load_scene, parse_scene, query, run_ensemble
from stickslip.pipeline.dataset.schema import encode, schema_of
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.query.database import quoted, views
from stickslip.pipeline.running.worker import columns, run_members
from stickslip.pipeline.scene.columns import COLUMNS, misnamed
from stickslip.workflows.commands import main
from stickslip.workflows.reporting import study_of
from tests.pipeline.test_functions import SCENE, written

duckdb = pytest.importorskip("duckdb")

#: A function that takes any names, and multiplies by the one value that it is given.
ANY = (
    "from stickslip import System\n\ndef draw(n, rng, **given):\n"
    "    (value,) = set(given.values())\n    return System(value * rng.random((n, n)), 0.1, 1.0, -0.3)\n"
)
#: Names that are none of the words of a language.
ATTRIBUTES = [name for name in dir(Member) if not name.startswith("__")]
OTHERS = ["parameters", "law", "index", "level_0", "rowid", "rng", "z", "w", "__filename", "a b", "1a", "ﬁ", "", "ö"]


def every_name():
    words = [word for (word,) in duckdb.sql("SELECT keyword_name FROM duckdb_keywords()").fetchall()]
    python = [*keyword.kwlist, *keyword.softkwlist]
    base = [*map(str.lower, words), *python, *(column.name for column in COLUMNS), *ATTRIBUTES, *OTHERS]
    return sorted({form for word in base for form in (word, word.upper())})


def with_names(*names):
    """The same two values under each name."""
    given, tied = ", ".join(f"'{name}' = [0.5, 1.0]" for name in names), f"zip = [{list(names)}]" if names[1:] else ""
    return (
        SCENE.replace("{gap = [0.5, 1.0]}", f"{{{given}}}")
        .replace("n = [3, 4]", "n = 3")
        .replace("matrices = 2", f"matrices = 1\n{tied}")
    )


#: In each run of the tests, and of `-m long`, of all words.
_SOME, _MORE = 40, 500
_KNOWN = {"cost", "order", "select", "ORDER", "group", "task", "base", "system", "source", "settings"}
_BARRED = {"N", "n", "end", "END", "start", "z", "for", "None", "rng", "MATRIX", "__filename"}


@pytest.mark.parametrize("how_many", [_SOME, pytest.param(_MORE, marks=pytest.mark.long)])
def test_every_word_is_a_column_with_its_values_or_refused_in_a_line(how_many, tmp_path, rng):
    """One run is made; its parameter is then given each name in turn."""
    words = sorted({*rng.choice(every_name(), how_many).tolist()} | _KNOWN | _BARRED)
    scene = load_scene(written(tmp_path, with_names("gap"), ANY))
    members = expand(scene)
    found = run_members(members, scene.recording)
    ran, refused = set(), set()
    connection = duckdb.connect(":memory:", config={"threads": 1})
    for name in words:
        text = scene.source.replace("'gap'", f"'{name}'")
        assert text.count(f"'{name}' = [") == 1
        try:
            other = parse_scene(text.encode(), folder=tmp_path)
        except SceneError as error:
            (line,) = str(error).splitlines()
            assert "system.parameters" in line, line
            assert repr(name) in line, line
            assert "choose another" in line, line
            refused.add(name)
            continue
        ran.add(name)
        recording, of_name = other.recording, expand(other)
        assert [dict(member.source.parameters) for member in of_name] == [{name: 0.5}, {name: 1.0}]
        rows = pq.read_table(pa.BufferReader(encode(columns(of_name, found, recording), schema_of(recording))))
        assert rows[name].to_pylist() == [0.5, 1.0], name
        connection.register("shards", rows)
        connection.execute(f"CREATE OR REPLACE VIEW members AS {views(schema_of(recording), None)['members']}")
        asked = f"SELECT {quoted(name)} AS value, min(n), max(n) FROM members GROUP BY {quoted(name)} ORDER BY 1"
        assert connection.execute(asked).fetchall() == [(0.5, 3, 3), (1.0, 3, 3)], name
    assert ran >= _KNOWN
    assert refused >= _BARRED
    assert {name for name in refused if misnamed([name]) is None} == set()


def test_names_go_from_the_scene_to_query_filter_and_report(tmp_path, monkeypatch, capsys):
    names = ["cost", "order", "SELECT", "group", "from_", "system", "parameters", "origin", "member", "x" * 255]
    file = written(tmp_path, with_names(*names), ANY)
    monkeypatch.chdir(tmp_path)
    run_ensemble(load_scene(file), "out", workers=0)
    assert main(["query", "out", "SELECT n, n_events FROM members"]) == 0
    assert len(study_of("out").groups) == 2
    for name in names:
        query_ = f'SELECT "{name}" AS value, count(*) AS k FROM members GROUP BY "{name}" ORDER BY "{name}"'
        assert main(["query", "out", query_, "--out", "answer.csv"]) == 0
        assert np.genfromtxt("answer.csv", delimiter=",", skip_header=1).tolist() == [[0.5, 1.0], [1.0, 1.0]], name
        assert query.members("out", filters=[(name, "=", 1.0)])[name].tolist() == [1.0]
    netcdf = pytest.importorskip("netCDF4")
    assert main(["export", "out", "--netcdf", "out.nc"]) == 0
    with netcdf.Dataset("out.nc") as held:
        assert [held[name][:].tolist() for name in names] == [[0.5, 1.0]] * len(names)


@pytest.mark.parametrize(
    "name",
    ["end", "a b", "change_row_size", "ö" * 128],
)
def test_a_name_that_clashes_is_refused_before_anything_is_written(name, tmp_path, monkeypatch, capsys):
    written(tmp_path, with_names(name), ANY)
    monkeypatch.chdir(tmp_path)
    assert main(["run", "mine.toml", "--out", "out"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "system.parameters" in line
    assert "choose another" in line
    assert len(line) < 250
    assert not (tmp_path / "out").exists()


def test_every_dimension_that_grows_is_refused_as_a_name():
    netcdf = pytest.importorskip("stickslip.workflows.netcdf")
    assert all(misnamed([name]) is not None for name in netcdf._SAMPLES.values())


def test_names_that_differ_in_case_alone_are_refused(tmp_path):
    text = with_names("gap").replace("'gap' = ", "'Gap' = 1.0, 'gap' = ")
    with pytest.raises(SceneError, match=r"system\.parameters: .* got 'gap': another parameter has it"):
        load_scene(written(tmp_path, text, ANY))
