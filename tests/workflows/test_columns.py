"""The page of columns: its lines read a dataset as this package does; NetCDF holds it whole, and xarray opens it."""

from __future__ import annotations

import re
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray

from stickslip.pipeline import parse_scene, query, run_ensemble
from stickslip.pipeline.ensemble import member, pack
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


KEPT = ("events", "episodes", "clusters", "end", "energy", "attractor", "critical_mode")
MIXED = ensemble(
    2,
    300.0,
    3,
    COULOMB,
    SIGMOID,
    system='coupling = "chain"\ndamping = [0.1, 0.2]\nbelt_speed = -0.1\nweakening = {law = "rational", rate = 2.0}',
    start='z = {uniform = [-1.0, 1.0]}\nw = "belt"\ndraws = 1',
    rest="\n".join(["[twins]\nsizes = 0.1\n[record]\nseparation = 2.0", *(f"{name} = true" for name in KEPT)]),
    analysis="t_burn = 20.0\ndt = 0.5",
)


def test_each_list_has_its_own_lengths_in_netcdf(tmp_path, monkeypatch):
    """Runs on a cycle and on none, by engines that have it and that have not, with a twin and without, and failed."""
    task = member.Member.task

    def fragile(member, *arguments):
        if member.row()["matrix"] == 2:
            raise ZeroDivisionError("planted")
        return task(member, *arguments)

    monkeypatch.setattr(member.Member, "task", fragile)
    monkeypatch.setattr(pack, "TARGET_COST", 0.1)
    out, file = tmp_path / "out", tmp_path / "out.nc"
    run_ensemble(parse_scene(MIXED.encode()), out, workers=0)
    assert len(list((out / "data").iterdir())) > 1
    # of others see `test_constants.py`, and the tests of adiabatic loading
    kept = [name for name in _SAMPLES if not name.startswith("constant_") and name != "episode_elapsed"]
    lists = query.table(out, ["attractor", *kept]).to_pydict()
    assert {"periodic", None} < set(lists.pop("attractor"))
    assert all(any(lengths := [len(one or ()) for one in lists[name]]) and 0 in lengths for name in lists)
    assert main(["export", str(out), "--netcdf", str(file)]) == 0
    with netCDF4.Dataset(file) as found:
        counts = {name.removesuffix("_row_size"): found[name][:] for name in found.variables if "_row_size" in name}
        for name, values in lists.items():
            (along,) = found[name].dimensions
            parts = np.split(found[name][:].filled(np.nan), np.cumsum(counts[along])[:-1])
            for part, value in zip(parts, values, strict=True):
                np.testing.assert_array_equal(part, np.array(value or [], dtype=float))
