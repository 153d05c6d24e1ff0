"""The catalogue of a dataset: a row an event, with the columns of earthquake catalogues, and what is swept."""

import numpy as np
import pandas as pd
import pytest

from stickslip import Dataset
from stickslip.pipeline import load_scene, parse_scene, run_ensemble, verify
from stickslip.workflows.commands import main
from tests.scenes import COULOMB, ON_BELTS, ensemble

SOURCE = ensemble(
    8,
    100.0,
    2,
    COULOMB,
    system='coupling = "chain"\nkappa = 4.0\nleaf = 1.0\ndamping = 0.0\nfriction = 1.0\n'
    "static = {uniform = [1.1, 1.5]}\nbelt_speed = [-0.02, -0.04]",
    start=ON_BELTS,
    rest="[record]\nRECORD",
)


def made(tmp_path, record):
    path = tmp_path / record.split()[0]
    run_ensemble(parse_scene(SOURCE.replace("RECORD", record).encode()), path, workers=0)
    assert verify(path) == []
    return path


def exported(path):
    out = path.parent / f"{path.name}.csv"
    assert main(["export", str(path), "--catalogue", str(out)]) == 0
    return pd.read_csv(out, parse_dates=["time"])


def test_a_row_a_cluster_or_an_episode(tmp_path):
    both = Dataset(made(tmp_path, "clusters = true\nepisodes = true"))
    whole, parts, slips = both.episodes, both.clusters, both.profiles
    sums = parts.groupby(["member_id", "episode"], sort=False)["moment"].sum()
    assert sums.to_numpy() == pytest.approx(whole["moment"].to_numpy(), abs=1e-8)
    of_block = slips.groupby(["member_id", "cluster"], sort=False)["slip"].agg(["sum", "size"])
    assert of_block["sum"].to_numpy() == pytest.approx(parts["moment"].to_numpy(), abs=1e-12)
    assert of_block["size"].tolist() == parts["size"].tolist()
    assert both.query("SELECT count(*) AS n FROM clusters")["n"].item() == len(parts)
    table = exported(both.path)
    assert len(table) == len(parts) > 20
    assert table["mag"].to_numpy() == pytest.approx(np.log10(parts["moment"].abs().to_numpy()))
    assert table["extent"].tolist() == parts["size"].tolist()
    assert table["nucleation"].tolist() == parts["first_block"].tolist()
    assert table["stress_drop"].to_numpy() == pytest.approx(parts["stress_drop"].to_numpy())
    assert table["duration"].to_numpy() == pytest.approx((parts["end"] - parts["start"]).to_numpy())
    assert (table["time"] - pd.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy() == pytest.approx(
        parts["start"].to_numpy(), abs=1e-6
    )
    speeds = both.members.set_index("member_id")["belt_speed"]
    assert table["belt_speed"].tolist() == speeds[parts["member_id"]].tolist()
    assert set(table["matrix"]) == {0, 1}
    alone = Dataset(made(tmp_path, "episodes = true"))
    assert len(exported(alone.path)) == len(alone.episodes)


def test_systems_from_files_are_told_by_their_names(tmp_path):
    stiffness = 9.0 * np.eye(8) - 4.0 * (np.eye(8, k=1) + np.eye(8, k=-1))
    for k in range(2):
        np.savez(tmp_path / f"K{k}.npz", stiffness=stiffness + 0.1 * k * np.eye(8))
    of_files = SOURCE.replace('"chain"\nkappa = 4.0\nleaf = 1.0', '"file"\npath = "K*.npz"')
    (tmp_path / "scene.toml").write_text(of_files.replace("RECORD", "episodes = true"))
    run_ensemble(load_scene(tmp_path / "scene.toml"), tmp_path / "out", workers=0)
    assert {*exported(tmp_path / "out")["file"]} == {"K0.npz", "K1.npz"}


def test_a_dataset_without_episodes_is_refused(tmp_path, capsys):
    path = made(tmp_path, "end = true")
    assert main(["export", str(path), "--catalogue", str(tmp_path / "out.csv")]) != 0
    assert "`episodes = true` under [record]" in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()
