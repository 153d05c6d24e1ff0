"""A scene from Python is the scene of a file: written as one, it is read back as the same."""

from __future__ import annotations

import re
import tomllib

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stickslip.pipeline import Scene, SceneError, load_scene, parse_scene
from stickslip.pipeline.scene.toml import as_tuple, plain, written
from stickslip.workflows.scenes import chart_of, shipped

ENSEMBLES = {name: file for name, file in shipped().items() if chart_of(file) is None}
PLAIN = st.one_of(st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False, allow_infinity=False),
                  st.text(st.characters(exclude_categories=["Cs"])))  # fmt: skip
VALUES = st.recursive(PLAIN, lambda inner: st.lists(inner) | st.dictionaries(st.text("abc -."), inner, max_size=2))


@pytest.mark.parametrize("name", ENSEMBLES)
def test_a_scene_that_is_written_is_read_back(name):
    read = parse_scene(ENSEMBLES[name].read_bytes())
    assert read.source.encode() == ENSEMBLES[name].read_bytes()
    built = Scene(**tomllib.loads(ENSEMBLES[name].read_text()))
    again = parse_scene(built.source)
    assert again.model_dump() == built.model_dump() == read.model_dump()
    assert again.hash == read.hash


@settings(max_examples=40)
@given(st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), VALUES))
def test_what_is_written_as_toml_is_read_back(tables):
    assert tomllib.loads(written(tables)) == tables


TABLES = {
    "system": {"coupling": "antisymmetric", "n": np.int64(5), "belt_speed": -np.array([0.1, 0.2])},
    "start": {"z": {"uniform": (-1, 1)}, "w": -0.4, "draws": 2},
    "run": {"t_end": 5.0, "matrices": 2, "seed": np.arange(2)},
    "engine": {"name": "sigmoid", "eps": np.array([0.03, 0.1])},
    "analysis": {"t_burn": 1.0, "dt": 0.5},
}


def test_a_scene_is_built_in_python_and_copied_with_changes():
    scene = Scene(**TABLES)
    assert scene.extent == "2 belt_speed x 2 seed x 2 draws of the start x 2 engines"
    assert parse_scene(scene.source).hash == scene.hash
    other = scene.changed(run={"t_end": 9.0, "seed": None}, title="longer", engine=[{"name": "coulomb"}])
    assert (other.run.t_end, other.run.seed, other.run.matrices, other.title) == (9.0, 0, 2, "longer")
    assert [engine.name for engine in other.engines] == ["coulomb"]
    assert scene.run.t_end == 5.0
    assert scene.changed().hash == scene.hash
    again = Scene(**TABLES | {"system": scene.system, "run": scene.run})
    assert again.hash == scene.hash


@pytest.mark.parametrize("several", [pd.Series, pd.Index, range, lambda *_: pd.array([0, 1, 2], dtype="Int64")])
def test_series_and_ranges_are_lists(several):
    run = {"t_end": 5.0, "matrices": 2, "seed": several(range(3)) if several is not range else range(3)}
    assert Scene(**TABLES | {"run": run}).hash == Scene(**TABLES | {"run": run | {"seed": [0, 1, 2]}}).hash


@pytest.mark.parametrize(
    ("tables", "key"),
    [
        ({"title": "bad\ud800"}, "title"),
        ({"run": {"t_end": 5.0, "matrices": 2, "bad\udcff": 1}}, "run"),
        ({"engine": [{"name": "coulomb\udcff"}]}, "engine[0].name"),
        ({"system": {"coupling": "file", "path": "K\udcff.npz"}}, "system.path"),
    ],
)
def test_a_text_that_no_file_can_hold_is_refused_by_its_key(tables, key):
    with pytest.raises(SceneError, match=rf"^{re.escape(key)}: expected text, got '.*\\ud"):
        Scene(**TABLES | tables)
    with pytest.raises(SceneError, match=rf"^{re.escape(key)}: expected text"):
        Scene(**TABLES).changed(**tables)


def test_the_source_is_text():
    assert isinstance(Scene(**TABLES).source, str)
    text = "# Ümlaut\r\n" + Scene(**TABLES).source.replace("\n", "\r\n")
    assert parse_scene(text.encode()).source == text  # to the byte


@pytest.mark.parametrize("wrong", [
    {"run": {"t_end": -1.0, "matrices": 2}},
    {"system": {"coupling": "antisymetric", "n": 5}},
    {"system": {"coupling": "file", "path": "nonesuch.npz", "n": 5}},
    {"system": {"coupling": "nonesuch:draw", "n": 5}},
    {"run": {"t_end": [5.0, 6.0], "matrices": 2}},
    {"colour": 3},
    {"engine": [{"name": "sigmoid", "eps": "0.03"}]},
    {"analysis": {"t_burn": 9.0, "dt": 0.5}},
])  # fmt: skip
def test_errors_in_python_are_those_of_a_file(wrong, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tables = plain(TABLES | wrong)
    (tmp_path / "mine.toml").write_text(written(tables | {"engine": as_tuple(tables["engine"])}))
    with pytest.raises(SceneError) as of_file:
        load_scene("mine.toml")
    with pytest.raises(SceneError) as of_python:
        Scene(**tables)
    assert str(of_python.value) == str(of_file.value).removeprefix("mine.toml: ")
    with pytest.raises(SceneError) as of_copy:
        Scene(**TABLES).changed(**wrong)
    assert str(of_copy.value) == str(of_python.value)
