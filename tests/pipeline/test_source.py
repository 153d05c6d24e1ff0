"""A scene from Python is the scene of a file: written as one, it is read back as the same."""

from __future__ import annotations

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stickslip.pipeline import Scene, parse_scene
from stickslip.pipeline.toml import written
from stickslip.workflows.scenes import chart_of, shipped

ENSEMBLES = {name: file for name, file in shipped().items() if chart_of(file) is None}
PLAIN = st.one_of(st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False, allow_infinity=False),
                  st.text(st.characters(exclude_categories=["Cs"])))  # fmt: skip
VALUES = st.recursive(PLAIN, lambda inner: st.lists(inner) | st.dictionaries(st.text("abc -."), inner, max_size=2))


@pytest.mark.parametrize("name", ENSEMBLES)
def test_a_scene_that_is_written_is_read_back(name):
    read = parse_scene(ENSEMBLES[name].read_bytes())
    assert read.source == ENSEMBLES[name].read_bytes()
    built = Scene(**tomllib.loads(ENSEMBLES[name].read_text()))
    again = parse_scene(built.source)
    assert again.model_dump() == built.model_dump() == read.model_dump()
    assert again.hash == read.hash


@given(st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), VALUES))
def test_what_is_written_as_toml_is_read_back(tables):
    assert tomllib.loads(written(tables)) == tables
