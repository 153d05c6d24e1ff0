"""The page of columns: its lines read a dataset as this package does; NetCDF holds it whole, and xarray opens it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import xarray

from stickslip.pipeline import parse_scene, query, run_ensemble
from stickslip.pipeline.ensemble import pack
from stickslip.pipeline.scene.columns import COLUMNS
from stickslip.workflows.commands import main
from stickslip.workflows.netcdf import _SAMPLES
from tests.scenes import COULOMB, SIGMOID, ensemble

PAGE = (Path(__file__).parents[2] / "docs" / "guide" / "columns.md").read_text()
LINES = {re.search(r"import (\w+)", block)[1]: block for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)}
SOURCE = ensemble(
    [6],
    30.0,
    3,
    COULOMB,
    SIGMOID,
    rest="[record]\nevents = true\nepisodes = true\nend = true",
    analysis="t_burn = 5.0\ndt = 0.5",
)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    path = tmp_path_factory.mktemp("columns") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pack, "TARGET_COST", 1e-9)
        run_ensemble(parse_scene(SOURCE.encode()), path, workers=0)
    assert len(list((path / "data").iterdir())) == 6  # a member each
    return path


@pytest.fixture(scope="module")
def exported(kept):
    file = kept.parent / "out.nc"
    assert main(["export", str(kept), "--netcdf", str(file)]) == 0
    return file


@pytest.mark.parametrize("tool", LINES)
def test_a_line_of_the_page_reads_a_dataset_without_this_package(tool, kept, request):
    file = request.getfixturevalue("exported") if tool == "xarray" else ""
    names: dict[str, object] = {}
    exec(LINES[tool].replace("runs/quick", str(kept)).replace("quick.nc", str(file)), names)
    answer = names["answer"]
    if hasattr(answer, "to_pandas"):
        answer = answer.to_pandas()
    if hasattr(answer, "columns"):
        answer = answer.set_index("engine")["n_exits"]
    expected = query.members(kept).groupby("engine")["n_exits"].mean()
    assert dict(answer) == pytest.approx(dict(expected))


def test_netcdf_holds_a_dataset_whole(kept, exported):
    with xarray.open_dataset(exported) as found:
        table = query.members(kept)
        for name in table:
            own, theirs = table[name], found[name].to_series().reset_index(drop=True)
            null = own.isna().to_numpy()
            assert (theirs[null].isna() | (theirs[null] == "")).all(), name
            assert list(theirs[~null]) == list(own[~null]), name
        t, event_t = (
            np.split(found[name].to_numpy(), np.cumsum(found[f"{along}_row_size"].to_numpy())[:-1])
            for name, along in (("t", "change"), ("event_t", "event"))
        )
        for k, member_id in enumerate(table["member_id"]):
            assert np.array_equal(t[k], query.n_stick(kept, member_id)[0])
            assert np.array_equal(event_t[k], query.events(kept, member_id).t)
        assert found["change_row_size"].attrs["sample_dimension"] == "change"
        assert found["n_stick"].attrs["long_name"].startswith("number of sticking blocks")


def test_every_column_has_its_place_on_the_page_and_in_the_file():
    assert {column.name for column in COLUMNS if column.is_list} == {*_SAMPLES, "by_threshold"}


@pytest.mark.parametrize("out", ["{kept}/out.nc", "out.nc", "data/../out.nc", "{link}/out.nc"])
def test_a_file_in_the_dataset_is_refused(out, kept, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(kept)
    (tmp_path / "link").symlink_to(kept)
    assert main(["export", str(kept), "--netcdf", out.format(kept=kept, link=tmp_path / "link")]) == 2
    assert "outside the dataset" in capsys.readouterr().err
    assert not (kept / "out.nc").exists()
