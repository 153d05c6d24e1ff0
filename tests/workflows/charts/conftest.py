"""The tiny chart that a file of tests is about: its text is `TINY` there."""

import pytest

from stickslip.workflows.gallery import load_chart


@pytest.fixture
def scene_file(request, tmp_path):
    file = tmp_path / "tiny.toml"
    file.write_text(request.module.TINY)
    return file


@pytest.fixture
def scene(scene_file):
    return load_chart(scene_file)
