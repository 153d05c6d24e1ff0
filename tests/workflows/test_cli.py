"""The command as a person meets it: what it prints, what it leaves, its exit codes."""

import json
import subprocess
import sys

import pandas as pd
import pytest

from pipeline import load_scene
from workflows.cli import main
from workflows.scenes import find, shipped


def test_run_leaves_data_and_a_report(dataset, capsys):
    page = (dataset / "report.html").read_text()
    assert "A small &lt;scene&gt;" in page
    assert "<scene>" not in page
    assert "http://" not in page.replace("http://www.w3.org", "")  # self-contained: nothing is fetched
    assert "https://" not in page
    law = pd.read_parquet(dataset / "report" / "law.parquet")
    assert {"coulomb", "sigmoid"} <= set(law["engine"])
    as_json = json.loads((dataset / "report" / "tables.json").read_text())
    assert len(as_json["law"]) == len(law)


def test_status_and_verify(dataset, capsys):
    assert main(["status", str(dataset)]) == 0
    assert "6 of 6 done" in capsys.readouterr().out
    assert main(["verify", str(dataset)]) == 0


def test_running_again_computes_nothing_and_changes_no_byte(dataset, small_scene, capsys):
    before = {file: file.read_bytes() for file in dataset.rglob("*") if file.is_file()}
    assert main(["run", str(small_scene), "--out", str(dataset)]) == 0
    assert {file: file.read_bytes() for file in dataset.rglob("*") if file.is_file()} == before


def test_the_report_needs_the_dataset_alone(dataset, capsys):
    before = (dataset / "report.html").read_bytes()
    (dataset / "report.html").unlink()
    assert main(["report", str(dataset)]) == 0
    assert (dataset / "report.html").read_bytes() == before


def test_verify_finds_a_damaged_shard(small_scene, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["run", str(small_scene), "--out", str(out), "--workers", "1"]) == 0
    shard = next((out / "data").iterdir())
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    assert main(["verify", str(out)]) == 1
    assert shard.name in capsys.readouterr().out


def test_query(dataset, capsys):
    assert main(["query", str(dataset), "SELECT engine, count(*) AS n FROM members GROUP BY engine ORDER BY 1"]) == 0
    lines = capsys.readouterr().out.split("\n")
    assert lines[1].split() == ["coulomb", "3"]
    assert lines[2].split() == ["sigmoid", "3"]


@pytest.mark.parametrize(
    "sql",
    ["SELECT * FROM nothing", "SELECT * FROM read_csv('/etc/passwd')", "COPY members TO 'stolen.csv'", "not SQL"],
)
def test_a_wrong_query_is_refused(dataset, sql, capsys):
    before = (dataset / "manifest.json").read_bytes()
    assert main(["query", str(dataset), sql]) == 2
    error = capsys.readouterr().err
    assert error.startswith("stickslip: ")
    assert "root:" not in error
    assert (dataset / "manifest.json").read_bytes() == before


BAD = {
    "unknown key": ("matrices = 3", "matrixes = 3", "matrixes", "matrices"),
    "wrong type": ("t_end = 40.0", 't_end = "long"', "run.t_end", "number"),
    "negative n": ("n = 12", "n = -12", "system.n", "got -12"),
    "missing table": ("[start]\nz = -0.7\nw = -0.4\n", "", "start", "add [start]"),
    "not TOML": ("[system]", "[system", "line", ""),
}


@pytest.mark.parametrize("mistake", BAD)
def test_a_bad_scene_is_refused_with_key_and_remedy_and_nothing_is_written(mistake, small_scene, tmp_path, capsys):
    old, new, key, remedy = BAD[mistake]
    bad = tmp_path / "bad.toml"
    text = small_scene.read_text()
    assert old in text
    bad.write_text(text.replace(old, new))
    out = tmp_path / "out"
    assert main(["run", str(bad), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert key in error
    assert remedy in error
    assert "Traceback" not in error
    assert not out.exists()


@pytest.mark.parametrize("argv", [["run", "no-such-scene"], ["run", "missing.toml"], ["status", "nowhere"]])
def test_what_is_not_there(argv, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(argv) in (1, 2)
    assert capsys.readouterr().err.startswith("stickslip: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("workers", ["0", "-1", "two", "1.5"])
def test_workers_are_counted_from_one(workers, small_scene, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["run", str(small_scene), "--workers", workers])
    assert "--workers" in capsys.readouterr().err


def test_dry_run_writes_nothing(shipped_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["run", shipped_scene, "--dry-run"]) == 0
    assert f"{load_scene(find(shipped_scene)).n_members} members" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


def test_scenes_lists_all_that_ship(capsys):
    assert main(["scenes"]) == 0
    lines = capsys.readouterr().out.strip().split("\n")
    assert [line.split()[0] for line in lines] == list(shipped())
    assert {"quick", "cascades"} <= set(shipped())


def test_help_loads_no_heavy_library():
    """Cold start: --help must not wait for dask, pandas or matplotlib."""
    code = (
        "import sys\nfrom workflows.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'dask', 'pandas', 'pyarrow', 'matplotlib', 'numba', 'numpy'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "examples:" in done.stdout
