"""A dataset speaks for itself: read by pyarrow and DuckDB alone, its systems are rebuilt, and a run is made again."""

import json
import os
import re
import socket

import duckdb
import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.integrate import solve_ivp

from stickslip import Dataset
from stickslip.pipeline import load_scene, parse_scene, run_ensemble, verify
from stickslip.pipeline.places.manifest import Commit, read_manifest
from stickslip.pipeline.scene.meaning import meaning
from stickslip.sim.systems.couplings import COUPLINGS
from stickslip.sim.systems.graphs import GRAPHS

SCENE = """\
title = "Five blocks"
about = "Does a dataset speak for itself?"
licence = "CC-BY-4.0"
[system]
coupling = "chain"
n = 5
kappa = 2.0
leaf = 1.0
damping = 0.3
friction = {uniform = [0.8, 1.2]}
static = {ratio = 1.2}
[start]
z = {uniform = [-1, 1]}
w = 0.0
[run]
t_end = 12.0
matrices = 3
seed = 7
[[engine]]
name = "coulomb"
tol = 1e-12
[record]
constants = true
events = true
[analysis]
t_burn = 2.0
dt = 0.5
"""


@pytest.fixture
def dataset(tmp_path):
    out = tmp_path / "out"
    run_ensemble(parse_scene(SCENE), out, workers=0)
    return out


def slips(row):
    """The changes of mode of a run, from the constants of its row, by DOP853: shares no code with the package."""
    n = row["n"]
    K = np.zeros((n, n))
    K[row["constant_row"], row["constant_column"]] = row["constant_stiffness"]
    names = ("damping", "friction", "static", "belt_speed")
    R, mu, static, v = (np.array(row[f"constant_{name}"]) for name in names)
    y, t = np.concatenate((row["constant_z0"], row["constant_w0"])), 0.0
    mode, found = np.sign(y[n:] - v), []

    def rate(_, y, mode):
        z, w = np.split(y, 2)
        push = -R * w - K @ z - mu * mode
        return np.concatenate((w, np.where(mode == 0, 0.0, push)))

    def change(k, mode):
        def event(_, y, *others):
            return (y[n + k] - v[k]) * mode if mode else abs(R[k] * v[k] + K[k] @ y[:n]) - static[k]

        event.terminal, event.direction = True, -1 if mode else 1
        return event

    while True:
        events = [change(k, mode[k]) for k in range(n)]
        options = {"args": (mode.copy(),), "events": events, "rtol": 1e-11, "atol": 1e-13, "max_step": 0.05}
        run = solve_ivp(rate, (t, row["t_end"]), y, "DOP853", **options)
        t, y = run.t[-1], run.y[:, -1].copy()
        if run.status == 0:
            return found
        k = next(k for k in range(n) if len(run.t_events[k]))
        force = R[k] * v[k] + K[k] @ y[:n]
        sticks = mode[k] != 0 and abs(force) <= static[k]
        mode[k] = 0.0 if sticks else -np.sign(force)
        # a whole step past the zero of its event, which would be found again
        y[n + k] = v[k] + 1e-12 * mode[k]
        found.append((t, k, int(mode[k])))


def test_a_run_is_made_again_from_the_dataset_alone(dataset):
    files = dataset / "data" / "*.parquet"
    rows = duckdb.sql(f"SELECT * FROM '{files}' ORDER BY member_id").to_arrow_table().to_pylist()
    assert len(rows) == 3
    for row in rows:
        found = slips(row)
        events = list(zip(row["event_t"], row["event_block"], row["event_mode"], strict=True))
        assert len(found) == len(events) > 5
        assert [event[1:] for event in found] == [event[1:] for event in events]
        np.testing.assert_allclose([t for t, *_ in found], [t for t, *_ in events], atol=1e-6)


def test_the_metadata_say_what_the_numbers_mean(dataset):
    (file, *_) = sorted((dataset / "data").glob("*.parquet"))
    metadata = {key.decode(): value.decode() for key, value in pq.read_schema(file).metadata.items()}
    assert "lambda_i in Sign(z_i' - v_i)" in metadata["equation"]
    assert json.loads(metadata["symbols"])["K"].startswith("stiffness")
    assert metadata["coupling"].endswith("block i is tied to i + 1, with free ends")
    assert metadata["units"].startswith("dimensionless")
    assert metadata["seed"].startswith("7:")
    assert metadata["program"].startswith("stickslip ")


def test_the_package_has_each_column_and_nothing_of_the_machine(dataset):
    package = json.loads((dataset / "datapackage.json").read_text())
    runs, scene = package["resources"]
    assert [str(dataset / path) for path in runs["path"]] == sorted(map(str, (dataset / "data").iterdir()))
    schema = pq.read_schema(dataset / runs["path"][0])
    fields = {field["name"]: field for field in runs["schema"]["fields"]}
    assert list(fields) == schema.names
    for field in schema:
        assert fields[field.name]["description"] == field.metadata[b"description"].decode()
        assert (fields[field.name]["type"] == "array") == str(field.type).startswith("list")
        assert fields[field.name]["constraints"]["required"] == (not field.nullable)
    assert {fields[name]["along"] for name in ("event_t", "event_block", "event_mode")} == {"event"}
    assert package["licenses"] == [{"name": "CC-BY-4.0"}]
    assert package["meaning"]["t_burn"] == 2.0
    assert re.fullmatch(r"[-a-z0-9._/]+", package["name"])
    assert (dataset / scene["path"]).exists()
    for file in dataset.rglob("*"):
        content = file.read_bytes() if file.is_file() else b""
        assert socket.gethostname().encode() not in content or len(socket.gethostname()) < 4, file
        assert b'"pid"' not in content, file
        assert f"process {os.getpid()}".encode() not in content, file


def test_verify_sees_a_package_that_changed_and_a_rerun_heals_it(dataset, content):
    before = content(dataset)
    assert verify(dataset) == []
    for damage, words in (
        (lambda file: file.write_text("{}"), "expected sha256 .*, got .*"),
        (lambda file: file.unlink(), "missing"),
        (lambda file: os.truncate(file, 2**30), r"cannot be read \(File too large\)"),
    ):
        damage(dataset / "datapackage.json")
        (problem,) = verify(dataset)
        assert re.search(rf"datapackage\.json: {words}; rerun the scene", problem)
        run_ensemble(parse_scene(SCENE), dataset, workers=0)
        assert content(dataset) == before


def test_what_only_words_change_is_said_anew(dataset):
    before = (dataset / "datapackage.json").read_text()
    run_ensemble(parse_scene(SCENE.replace("t_burn = 2.0", "t_burn = 3.0")), dataset, workers=0)
    assert (dataset / "datapackage.json").read_text() == before.replace('"t_burn": 2.0', '"t_burn": 3.0')
    assert verify(dataset) == []


def test_datasets_without_it_open_and_stay_as_they_are(dataset, content):
    manifest = read_manifest(dataset)
    manifest.package = None
    (dataset / "manifest.json").write_bytes(manifest.to_bytes())
    (dataset / "datapackage.json").unlink()
    before = content(dataset)
    assert verify(dataset) == []
    run_ensemble(parse_scene(SCENE), dataset, workers=0)
    assert content(dataset) == before


def test_extend_writes_it_too(dataset, tmp_path):
    Dataset(dataset).extend({"waiting": True}, tmp_path / "more", workers=0)
    package = json.loads((tmp_path / "more" / "datapackage.json").read_text())
    assert "waiting_mean" in {field["name"] for field in package["resources"][0]["schema"]["fields"]}
    assert verify(tmp_path / "more") == []


def test_commits_of_earlier_versions_are_read():
    entry = {"sha256": "0" * 64, "rows": 1, "bytes": 1, "first": "a", "last": "a", "outcomes": {}}
    values = {"shard": "shard-00000-0123456789ab.parquet", "entry": entry, "program": "p", "seconds": 1.0}
    old = Commit.model_validate(values | {"host": "there", "pid": 7})
    assert Commit.parse(old.line.strip()) == old
    assert b"host" not in Commit.model_validate(values).line


@pytest.mark.parametrize("name", [*COUPLINGS, *GRAPHS])
def test_each_coupling_has_words(name):
    scene = parse_scene(SCENE.replace('"chain"', f'"{name}"').replace("leaf = 1.0\n", ""))
    words = dict(meaning(scene.system, 0, None))["coupling"]
    assert words.startswith(f"{name}: K")
    assert len(words) > len(name) + 20


def test_a_licence_and_a_title_are_no_part_of_the_data(tmp_path):
    (tmp_path / "mine.toml").write_text(SCENE.replace("CC-BY-4.0", "CC0-1.0").replace("Five", "Some"))
    assert load_scene(tmp_path / "mine.toml").hash == parse_scene(SCENE).hash
