"""The command as a person meets it: what it prints, what it leaves, its exit codes."""

import csv
import io
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
import tomllib
from collections import Counter
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stickslip import workflows
from stickslip.analysis import Report
from stickslip.analysis.page.comparison import compare
from stickslip.pipeline import Progress, load_scene, query
from stickslip.pipeline.dataset import opened
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.dataset.status import Pace, Tally
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.running import estimate
from stickslip.pipeline.scene import scene as scene_module
from stickslip.workflows import export
from stickslip.workflows.commands import main
from stickslip.workflows.commands.scenes import Scenes
from stickslip.workflows.fresh import is_current
from stickslip.workflows.progress import Watch
from stickslip.workflows.reporting import compared, write
from stickslip.workflows.scenes import find, shipped
from tests.processes import python, seconds_of, until
from tests.scenes import COULOMB, ensemble


def test_run_leaves_data_and_a_report(dataset, capsys):
    page = (dataset / "report.html").read_text()
    assert "A small &lt;scene&gt;" in page
    assert "<scene>" not in page
    assert "http://" not in page.replace("http://www.w3.org", "")  # self-contained: nothing is fetched
    assert "https://" not in page
    groups = pd.read_parquet(dataset / "report" / "groups.parquet")
    assert {"coulomb", "sigmoid"} <= set(groups["engine"])


def test_a_report_of_blocks_that_are_driven_and_barred(here, tmp_path, capsys):
    scene = tmp_path / "driven.toml"
    scene.write_text("""
start = "rest"
[system]
coupling = "chain"
n = 5
static = 1.5
mass = [1.0, {uniform = [0.8, 1.2]}]
force = {amplitude = [0.5, 1.0], frequency = {uniform = [0.9, 1.1]}}
weakening = {law = "rational", rate = 2.0}
back_slip = false
[run]
t_end = 40.0
matrices = 3
[[engine]]
name = "coulomb"
[record]
episodes = true
energy = true
[analysis]
t_burn = 5.0
dt = 0.5
""")
    out = tmp_path / "out"
    assert main(["run", str(scene), "--out", str(out), "--workers", "1"]) == 0
    assert [*pd.read_parquet(out / "report" / "groups.parquet")["back_slip"]] == ["barred"] * 4
    assert "barred" in (out / "report.html").read_text()
    members = query.members(out)
    stored = sum(members[f"{kind}_energy_end"] - members[f"{kind}_energy_start"] for kind in ("kinetic", "elastic"))
    came = members["belt_work"] + members["force_work"] + members["coupling_work"]
    assert (stored - came + members["damping_loss"] + members["friction_loss"]).abs().max() < 1e-4


def test_status_and_verify(dataset, capsys):
    assert main(["status", str(dataset)]) == 0
    assert "6 of 6 done" in capsys.readouterr().out
    assert main(["verify", str(dataset)]) == 0
    assert "every shard that is done is as the manifest says\n" in capsys.readouterr().out


def test_running_again_computes_nothing_and_changes_no_byte(dataset, small_scene, capsys):
    before = {file: file.read_bytes() for file in dataset.rglob("*") if file.is_file()}
    assert main(["run", str(small_scene), "--out", str(dataset)]) == 0
    assert {file: file.read_bytes() for file in dataset.rglob("*") if file.is_file()} == before


def test_the_report_needs_the_dataset_alone(dataset, capsys):
    before = (dataset / "report.html").read_bytes()
    (dataset / "report.html").unlink()
    assert main(["report", str(dataset)]) == 0
    assert (dataset / "report.html").read_bytes() == before


def test_query(dataset, capsys):
    assert main(["query", str(dataset), "SELECT engine, count(*) AS n FROM members GROUP BY engine ORDER BY 1"]) == 0
    lines = capsys.readouterr().out.split("\n")
    assert lines[1].split() == ["coulomb", "3"]
    assert lines[2].split() == ["sigmoid", "3"]


QUESTION = "SELECT member_id, n, tol, n_exits FROM members ORDER BY member_id"


def test_an_answer_as_csv(dataset, tmp_path, capsysbinary):
    assert main(["query", str(dataset), QUESTION, "--format", "csv"]) == 0
    written = capsysbinary.readouterr().out
    rows = list(csv.DictReader(io.StringIO(written.decode())))
    frame = query.members(dataset).sort_values("member_id")
    assert [row["member_id"] for row in rows] == list(frame["member_id"])
    assert [int(row["n_exits"]) for row in rows] == list(frame["n_exits"])
    assert {row["tol"] for row in rows} == {"", "1e-10"}  # null is empty
    file = tmp_path / "answer.csv"
    assert main(["query", str(dataset), QUESTION, "--out", str(file)]) == 0
    assert file.read_bytes() == written
    other = tmp_path / "other"
    other.touch()
    assert file.stat().st_mode == other.stat().st_mode


def test_an_answer_as_parquet(dataset, tmp_path, capsysbinary):
    file = tmp_path / 'it\'s an "answer".parquet'
    assert main(["query", str(dataset), "SELECT member_id, t, n_stick FROM n_stick", "--out", str(file)]) == 0
    found = pq.read_table(file)
    member_id = found["member_id"][0].as_py()
    t, n_stick = query.n_stick(dataset, member_id)
    frame = found.to_pandas().query("member_id == @member_id")
    assert list(frame["t"]) == list(t)
    assert list(frame["n_stick"]) == list(n_stick)
    assert main(["query", str(dataset), QUESTION, "--format", "parquet"]) == 0
    assert pq.read_table(io.BytesIO(capsysbinary.readouterr().out)).num_rows == 6
    assert list(tmp_path.iterdir()) == [file]


def test_a_terminal_is_told_nothing_by_data(dataset, tmp_path, capsys):
    asked = """SELECT 'a' || chr(27) || '[2Jé' AS "x\x1b[31m", [chr(155), chr(8238)] AS y, chr(7) AS z"""
    assert main(["query", str(dataset), asked]) == 0
    out = capsys.readouterr().out
    assert all(c.isprintable() or c == "\n" for c in out)
    for words in (r"x\x1b[31m", r"a\x1b[2Jé", r"\x9b", r"\u202e", r"\x07"):
        assert words in out
    assert main(["query", str(dataset), "SELECT chr(27)::INTEGER"]) == 2
    assert "\x1b" not in capsys.readouterr().err
    file = tmp_path / "a.csv"
    assert main(["query", str(dataset), "SELECT chr(27) AS a", "--out", str(file)]) == 0
    assert file.read_bytes() == b'"a"\n"\x1b"\n'  # for programs, as it is


@pytest.mark.parametrize("value", ["1", "0.5", "'a'", "true", "[1]", "DATE '2020-01-01'"])
def test_a_table_has_one_word_for_no_value(value, dataset, capsys):
    assert main(["query", str(dataset), f"SELECT {value} AS a UNION ALL SELECT NULL ORDER BY a NULLS LAST"]) == 0
    assert capsys.readouterr().out.split()[-1] == "NULL"


def test_a_long_table_says_what_it_leaves_out(dataset, capsys):
    assert main(["query", str(dataset), "SELECT range FROM range(1234)"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + 1000 + 1
    assert lines[-1] == "... 234 rows more: --format csv has them all"
    assert main(["query", str(dataset), "SELECT n FROM members WHERE n < 0"]) == 0
    assert capsys.readouterr().out == "no rows (n)\n"


def test_a_long_table_that_comes_in_pieces_is_cut_where_one_in_a_piece_is(tmp_path):
    pieces = pa.table({"k": range(1800)}).to_batches(max_chunksize=600)
    export.write(pa.RecordBatchReader.from_batches(pieces[0].schema, pieces), "table", tmp_path / "k.txt", "data")
    head, *rows, more = (tmp_path / "k.txt").read_text().splitlines()
    assert (head.split(), [int(row) for row in rows]) == (["k"], list(range(1000)))
    assert more == "... 800 rows more: --format csv has them all"


@pytest.mark.parametrize(("sql", "more", "words"), [
    ("SELECT list(n) AS ns FROM members", ["--format", "csv"], ["'ns'", "unnest it", "parquet"]),
    (QUESTION, ["--out", "{dataset}/manifest.json", "--format", "csv"], ["--out", "outside the dataset"]),
    (QUESTION, ["--out", "{dataset}/data/new.csv"], ["--out", "outside the dataset"]),
    (QUESTION, ["--out", "{here}"], ["--out", "directory", "name a file"]),
    (QUESTION, ["--out", "{here}/none/a.csv"],
        ["--out", "(No such file or directory); the folder does not exist: create it"]),
    ("SELECT n / 0, error('late') FROM members", ["--out", "{here}/a.csv"], ["query: ", "late"]),
    (QUESTION, ["--out", "{here}/a.xlsx"], ["--out", ".csv, .parquet, .mat or .txt", "a.xlsx", "--format"]),
    ("SELECT INTERVAL 1 DAY AS d", ["--out", "{here}/a.csv"], ["--format", "csv can hold", "cast them"]),
    ("SELECT INTERVAL 1 DAY AS d", ["--out", "{here}/a.parquet"], ["--format", "parquet can hold"]),
])  # fmt: skip
def test_an_answer_that_cannot_be_written(sql, more, words, dataset, tmp_path, capsys):
    before = (dataset / "manifest.json").read_bytes()
    more = [word.format(dataset=dataset, here=tmp_path) for word in more]
    refused(["query", str(dataset), sql, *more], words, capsys)
    assert list(tmp_path.iterdir()) == []
    assert (dataset / "manifest.json").read_bytes() == before


def test_an_answer_follows_links(dataset, tmp_path):
    target, link = tmp_path / "target.csv", tmp_path / "link.csv"
    link.symlink_to(target)
    assert main(["query", str(dataset), QUESTION, "--out", str(link)]) == 0
    assert link.is_symlink()
    assert target.read_text()


def test_an_answer_with_no_place_to_go(dataset, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", None)
    assert main(["query", str(dataset), QUESTION]) == 2
    assert "the standard output is closed" in capsys.readouterr().err


def test_a_chart_has_no_members(capsys, tmp_path):
    for option in (["--only", "x"], ["--retry-failed"]):
        assert main(["run", "fig1", "--out", str(tmp_path / "out"), *option]) == 2
        assert "expected none with a chart" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["a.csv", "a.CSV"])
def test_the_name_says_the_form_unless_another_is_asked_for(name, dataset, tmp_path):
    file = tmp_path / name
    assert main(["query", str(dataset), QUESTION, "--out", str(file)]) == 0
    assert file.read_text().startswith('"member_id","n"')
    assert main(["query", str(dataset), QUESTION, "--out", str(file.with_suffix(".dat")), "--format", "csv"]) == 0
    assert file.with_suffix(".dat").read_bytes() == file.read_bytes()
    assert main(["query", str(dataset), QUESTION, "--out", str(file.with_suffix(".txt"))]) == 0
    assert file.with_suffix(".txt").read_text().split()[:2] == ["member_id", "n"]


def test_who_reads_an_answer_may_stop_and_a_full_disk_is_called_so(dataset):
    question = ["query", str(dataset), "FROM n_stick, range(1000)", "--format", "csv"]
    command = [sys.executable, "-m", "stickslip", *question]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        said = process.stderr.read()
    assert (process.returncode, said) == (1, "")
    with open("/dev/full", "wb") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("stickslip: [Errno 28] No space left on device; make room")
    assert "shard" not in done.stderr


def test_a_command_has_one_thread_and_leaves_the_environment_as_it_was(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    seen = {}
    monkeypatch.setattr(Scenes, "__call__", lambda self, arguments: seen.update(os.environ) or 0)
    before = dict(os.environ)
    assert main(["scenes"]) == 0
    assert seen["OMP_NUM_THREADS"] == seen["OPENBLAS_NUM_THREADS"] == "1"
    assert dict(os.environ) == before


def test_an_interrupted_query(dataset, tmp_path):
    endless = "SELECT sum(a.t * b.range * c.range) FROM n_stick a, range(1000000) b, range(1000000) c"
    command = [sys.executable, "-m", "stickslip", "query", str(dataset), endless, "--out", str(tmp_path / "a.csv")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until(lambda: "duckdb" in Path(f"/proc/{process.pid}/maps").read_text())
    loaded = seconds_of(process.pid)
    until(lambda: seconds_of(process.pid) > loaded + 1.0)  # it has asked
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=500)
    assert (process.returncode, out, err) == (143, "", "\ninterrupted; no answer was written\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("sql", ["SELECT * FROM read_csv('/etc/passwd')", "not SQL"])
def test_a_wrong_query_is_refused(dataset, sql, capsys):
    before = (dataset / "manifest.json").read_bytes()
    assert main(["query", str(dataset), sql]) == 2
    error = capsys.readouterr().err
    assert error.startswith("stickslip: ")
    assert "root:" not in error
    assert (dataset / "manifest.json").read_bytes() == before


# whole files that are no scenes
BAD_FILES = {
    "empty file": (lambda small: b"", ["system", "add [system]"]),
    "NUL in the text": (lambda small: small.replace(b"<scene>", b"\x00"), ["TOML", "correct that line"]),
    "byte order mark": (lambda small: b"\xef\xbb\xbf" + small, ["byte order mark", "save the file as UTF-8 without"]),
    "not UTF-8": (lambda small: small.replace(b"small", b"sm\xe4ll"), ["UTF-8", "line 1"]),
    "UTF-16": (lambda small: small.decode().encode("utf-16"), ["UTF-8", "save the file as UTF-8"]),
    "JSON": (lambda small: b'{"system": {"n": 12}}', ["TOML", "correct that line"]),
}


def refused(argv, words, capsys):
    """The command ends with code 2 and one message that holds these words in one line."""
    assert main(argv) == 2
    streams = capsys.readouterr()
    assert streams.out == ""
    assert streams.err.startswith("stickslip: ")
    assert "Traceback" not in streams.err
    assert any(all(word in line for word in words) for line in streams.err.splitlines()), streams.err


def check_bad(content, words, folder, capsys):
    bad = folder / "bad.toml"
    bad.write_bytes(content)
    for more in ([], ["--dry-run"]):
        refused(["run", str(bad), "--out", str(folder / "out"), *more], words, capsys)
    assert list(folder.iterdir()) == [bad]
    assert bad.read_bytes() == content


@pytest.mark.parametrize(("old", "new", "words"), [
    ("matrices = 3", "matrixes = 3", ["bad.toml: run.matrixes", "did you mean 'matrices'"]),
    ("n = 12", "n = 0\ncolour = 1", ["bad.toml: system.n", "greater than or equal to 1"]),
    ("[analysis]", '[analysis]\nquestion = "collectives"',
        ["bad.toml: analysis.question: expected one of", "'collective'"]),
])  # fmt: skip
def test_a_bad_scene_is_refused_in_its_words_and_nothing_is_written(old, new, words, small_scene, tmp_path, capsys):
    """Which mistakes there are, `tests/pipeline/test_scene.py` has."""
    check_bad(small_scene.read_text().replace(old, new).encode(), words, tmp_path, capsys)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("n = 12", "n = [12, 100_000]", ["system.n", "n = 100000", "240 GB", "each has 2 GB", "lower n"]),
        ("t_end = 40.0", "t_end = 4e3", ["record.separation", "3.84 GB", "each has 2 GB", "lengthen the step"]),
    ],
)
def test_what_no_worker_can_hold_is_refused(old, new, words, small_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("stickslip.pipeline.running.estimate.MEMORY_LIMIT", 4e9)
    small = small_scene.read_text().replace("[record]", "[twins]\nsizes = 0.1\n[record]\nseparation = 4e-4")
    check_bad(small.replace(old, new).encode(), words, tmp_path, capsys)


@pytest.mark.parametrize("kind", BAD_FILES)
def test_a_file_that_is_no_scene_is_refused(kind, small_scene, tmp_path, capsys):
    content, words = BAD_FILES[kind]
    check_bad(content(small_scene.read_bytes()), words, tmp_path, capsys)


def test_a_directory_where_data_do_not_belong_is_refused(small_scene, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    scene = tmp_path / "scene.toml"
    scene.write_bytes(small_scene.read_bytes())
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    source = Path(workflows.__file__).parents[1]
    for out, words in (
        (source / "pipeline", ["--out", "inside the program", "choose another"]),
        (source / "workflows" / "scenes" / "data", ["--out", "inside the program"]),
        (tmp_path / "file", ["--out", "got the file", "choose another"]),
        (tmp_path, ["--out", "where the scene file is", "choose another"]),
    ):
        for more in ([], ["--dry-run"]):
            refused(["run", str(scene), "--out", str(out), *more], words, capsys)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before
    assert not (source / "workflows" / "scenes" / "data").exists()


@pytest.mark.parametrize("name", [b"\xff", b"a\xc3"])
def test_names_that_data_cannot_have_are_refused_before_anything_is_computed(
    name, small_scene, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    scene = Path(os.fsdecode(name + b".toml"))
    shutil.copy(small_scene, scene)
    for argv, argument in (([str(scene)], "SCENE"), ([str(small_scene), "--out", os.fsdecode(name)], "--out")):
        words = [f"{argument}: expected a name in UTF-8, got ", ascii(scene.stem)[:-1]]
        refused(["run", *argv], words, capsys)
    assert list(tmp_path.iterdir()) == [tmp_path / scene]


@pytest.mark.parametrize("name", ["..toml", "...toml"])
def test_a_scene_whose_data_would_be_the_folder_of_all_data_is_refused(
    name, small_scene, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    shutil.copy(small_scene, name)
    refused(["run", name], [f"SCENE: expected a name that data can have under runs/, got '{name}'"], capsys)
    assert list(tmp_path.iterdir()) == [tmp_path / name]


@pytest.mark.parametrize("argv", [["run", "no-such-scene"], ["run", "missing.toml"], ["status", "nowhere"]])
def test_what_is_not_there(argv, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(argv) in (1, 2)
    assert capsys.readouterr().err.startswith("stickslip: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("more", "words"),
    [
        *((["--workers", count], "--workers") for count in ("0", "-1", "two", "1.5")),
        (["--scheduler", "tcp://127.0.0.1:9", "--workers", "2"], "--workers: not allowed with argument --scheduler"),
        (["--workers=1", "--scheduler", "tcp://127.0.0.1:9"], "--scheduler: not allowed with argument --workers"),
    ],
)
def test_workers_are_counted_from_one_and_are_here_or_there(more, words, small_scene, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["run", str(small_scene), *more])
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("address", ["nonsense", "tcp://127.0.0.1:9", ""])
def test_a_wrong_address_is_refused_before_anything_is_done(address, dataset, small_scene, tmp_path, capsys):
    before = {file: file.stat().st_mtime_ns for file in dataset.rglob("*")}
    for out in (tmp_path / "out", dataset):  # to do, or done
        argv = ["run", str(small_scene), "--out", str(out), "--scheduler", address]
        refused(argv, ["scheduler: expected the address", repr(address), "`dask scheduler`"], capsys)
    assert list(tmp_path.iterdir()) == []
    assert {file: file.stat().st_mtime_ns for file in dataset.rglob("*")} == before
    for more in (["--dry-run"], ["--only", "n12-m000-coulomb-1e-10"]):
        refused([*argv, *more], ["--scheduler, --slurm: expected none with", "leave it out"], capsys)


def test_a_run_without_a_report(here, small_scene, dataset, tmp_path, monkeypatch, capsys):
    out = tmp_path / "a run"
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "stickslip.workflows.reporting", None)  # nothing of it is loaded
        assert main(["run", str(small_scene), "--out", str(out), "--workers", "1", "--no-report"]) == 0
    assert f"write it with: stickslip report '{out}'" in capsys.readouterr().out
    assert not (out / "report.html").exists()
    assert main(["report", str(out)]) == 0
    assert (out / "report.html").read_bytes() == (dataset / "report.html").read_bytes()


def test_the_status_of_a_run_that_goes_on(dataset, tmp_path, capsys):
    """A lock file as a driver leaves it: this process."""
    copy = shutil.copytree(dataset, tmp_path / "copy")
    cost = sum(batch.cost for batch in open_dataset(copy).tasks)
    pace = Pace(time.time() - 10.0, 2, cost / 3, 0, 1)
    began = f"began {time.time() - 15.0}"
    lines = [
        f"process {os.getpid()} on {socket.gethostname()}",
        began,
        pace.line,
        "dashboard http://there:1/status",
        "",
    ]
    (copy / ".lock").write_text("\n".join(lines))
    assert main(["status", str(copy)]) == 0
    said = capsys.readouterr().out
    assert re.search(
        rf"^running process {os.getpid()} on .*, 00:1[5-9], 0.\d+ members/s, 00:00 to go$", said, re.MULTILINE
    )
    assert "dask    http://there:1/status\n" in said
    lines[0] = f"process 4194304 on {socket.gethostname()}"  # no process has this number
    (copy / ".lock").write_text("\n".join(lines))
    assert main(["status", str(copy), "--watch"]) == 0  # ends: nobody is at work
    said = capsys.readouterr().out
    assert "6 of 6 done: " in said
    assert "running" not in said


@pytest.mark.parametrize(
    "lock",
    [
        "process 1 on other\nbegan nan",
        "process 1 on other\nbegan -inf",
        "process 1 on other\nbegan",
        f"process 1 on other\nbegan 1\npace 1 -{'9' * 400} 0 0 0",
        "process 1 on other\nbegan 1\npace 1 0 nan 0 0",
        f"process {'9' * 5000} on {socket.gethostname()}\nbegan 1",
        f"process \u0661 on {socket.gethostname()}\nbegan 1",
        "my mail program\nbegan 1",
    ],
)
def test_what_no_driver_writes_is_no_lock(lock, dataset, tmp_path, capsys):
    copy = shutil.copytree(dataset, tmp_path / "copy")
    (copy / ".lock").write_text(f"{lock}\n")
    assert main(["status", str(copy)]) == 0
    said = capsys.readouterr().out
    assert "6 of 6 done: " in said
    assert "running" not in said


def test_a_run_in_which_a_member_fails_ends_with_an_error_and_how_to_run_that_alone(
    here, tmp_path, monkeypatch, capsys
):
    def fragile(member, *arguments, task=Member.task):
        if member.source.matrix == 1:
            raise ZeroDivisionError("planted")
        return task(member, *arguments)

    (tmp_path / "scene.toml").write_text(ensemble(3, 2.0, 3, COULOMB))
    words = [str(tmp_path / "scene.toml"), "--out", str(tmp_path / "out"), "--workers", "1", "--no-report"]
    with monkeypatch.context() as patch:
        patch.setattr(Member, "task", fragile)
        assert main(["run", *words]) == 1
    error = capsys.readouterr().err
    assert "failed  1: ZeroDivisionError: planted\n" in error
    assert f"--only {query.members(tmp_path / 'out').member_id[1]}\n" in error
    assert main(["run", *words, "--retry-failed"]) == 0


@pytest.mark.parametrize(("old", "new"), [("t_burn = 1.0", "t_burn = 2.0"), ("A small", "Another")])
def test_a_report_is_up_to_date_until_its_scene_asks_otherwise(old, new, dataset, tmp_path):
    copy = shutil.copytree(dataset, tmp_path / "copy")
    assert is_current(open_dataset(copy))
    scene = copy / "scene.toml"
    scene.write_text(scene.read_text().replace(old, new))
    assert not is_current(open_dataset(copy))


def test_the_status_of_a_dataset_that_has_lost_a_shard(dataset, tmp_path, capsys):
    copy = shutil.copytree(dataset, tmp_path / "a copy")
    shard = next((copy / "data").iterdir())
    for damage in (lambda: shard.write_bytes(shard.read_bytes()[:-1]), shard.unlink):
        damage()
        assert main(["status", str(copy)]) == 1
        said = capsys.readouterr().out
        assert f"damaged 1 of these shards, or missing, with 6 of the members: `stickslip verify '{copy}'`" in said
        assert main(["report", str(copy)]) == 1, "not even where the page is up to date"
        assert f"1 of them missing or of another size, {shard.name} first" in capsys.readouterr().err
    assert main(["status", str(dataset)]) == 0
    assert "damaged" not in capsys.readouterr().out


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.rglob("*.*")}


@pytest.mark.parametrize("n_synced", range(6))
def test_a_report_that_cannot_be_written_leaves_the_old_one_whole(n_synced, tmp_path, monkeypatch):
    """A disk that is full after so many files and names: of the new report there is a list at most."""
    old, new = (Report(f"<{k}>", {"law": pd.DataFrame({"gamma": [0.7 + k]})}, []) for k in range(2))
    place = tmp_path / "deep" / "er"
    write(old, place)
    before = contents(place)
    assert before.keys() == {"law.parquet", "law.csv", "findings.json", "report.html", "files.txt"}
    fsync, calls = os.fsync, []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) > n_synced:
            raise OSError(28, "No space left on device")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write(new, place)
    after = contents(place)
    assert after == before | {"files.txt": after["files.txt"]}  # without its list the report is made again
    monkeypatch.undo()
    write(new, place)
    assert contents(place)["report.html"] == b"<1>"


def test_progress_in_words(tmp_path):
    stream = io.StringIO()
    with Watch(tmp_path, stream) as watch:
        for n_done, shards in ((4, 1), (10, 2)):
            tally = Tally(10, n_done, {"finished": n_done}, 2, shards, 1000, 5.0, n_done / 2)
            for waiting in ("workers", "workers", "the first shard") if n_done == 4 else (None,):
                rate, eta = (2.0, 0.0) if waiting is None else (None, None)
                watch(Progress(**vars(tally), elapsed=3.0 * (n_done > 4), last_shard=None, rate=rate, eta=eta,
                               waiting=waiting))  # fmt: skip
    assert stream.getvalue().splitlines() == [
        "4 of 10 members are there already",
        "4/10 members, 1/2 shards, 00:00, waiting for workers",
        "4/10 members, 1/2 shards, 00:00, waiting for the first shard",
        "10/10 members, 2/2 shards, 00:03, 2 members/s, 00:00 to go",
    ]


def test_one_bar_shows_the_run_and_then_its_report(tmp_path):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    stream = Terminal()
    tally = Tally(10, 10, {"finished": 10}, 2, 2, 1000, 5.0, 5.0)
    with Watch(tmp_path, stream) as watch:
        watch(Progress(**vars(tally), elapsed=3.0, last_shard=None))
        watch.answered(3, 8)
        watch.close()
        assert stream.getvalue().endswith("\r")  # what follows begins a line
    shown = stream.getvalue().split("\r")
    assert any("10/10 members" in line for line in shown)
    assert any("report: 3/8 questions" in line for line in shown)


def test_dry_run_writes_nothing(shipped_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(estimate, "PILOT", 0.1)  # seconds; what it estimates is tested elsewhere
    assert main(["run", shipped_scene, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert re.search(rf": {load_scene(find(shipped_scene)).n_members} members in \d+ shards?, into ", said)
    clock = r"(\d+:\d+|\d+:\d+:\d+)"
    time_line = re.search(rf"^time +{clock} \({clock} to {clock}\) on [12] workers?, ", said, re.MULTILINE)
    low, middle, high = (
        sum(60**k * int(x) for k, x in enumerate(reversed(time_line[i].split(":")))) for i in (2, 1, 3)
    )
    assert low <= middle <= high
    assert re.search(r"^disk +\S+ MB \(\S+ to \S+\)$", said, re.MULTILINE)
    assert list(tmp_path.iterdir()) == []


def test_one_member_is_run_and_nothing_written(dataset, small_scene, tmp_path, monkeypatch, capsys):
    row = query.members(dataset, columns=["member_id", "outcome", "n_events"]).iloc[1]
    monkeypatch.chdir(tmp_path)
    assert main(["run", str(small_scene), "--only", row.member_id]) == 0
    shown = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.strip().split("\n"))
    assert (shown["member_id"], shown["outcome"], int(shown["n_events"])) == tuple(row)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr("stickslip.pipeline.ensemble.member.Member.task", None)
    assert main(["run", str(small_scene), "--only", row.member_id]) == 1
    assert "reason             TypeError: 'NoneType' object is not callable" in capsys.readouterr().out
    assert main(["run", str(small_scene), "--only", "n7"]) == 2
    assert "--only: member_id: expected a member of the scene, such as 'n12-m000-coulomb" in capsys.readouterr().err


def test_scenes_lists_all_that_ship(capsys):
    assert main(["scenes"]) == 0
    lines = capsys.readouterr().out.strip().split("\n")
    head, *scenes = lines[: lines.index("")]
    assert head.split() == ["scene", "members", "time", "about"]
    assert [line.split()[0] for line in scenes] == list(shipped())
    assert {"quick", "cascades"} <= set(shipped())
    quick = next(line for line in scenes if line.startswith("quick")).split()
    assert int(quick[1]) == load_scene(find("quick")).n_members
    assert quick[3] == "s"  # seconds


@pytest.mark.parametrize("scene", shipped())
def test_what_ships_says_its_time(scene):
    assert 0.01 < tomllib.loads(find(scene).read_text())["minutes"] < 20


#: What is said without data, and what it loads none of besides what is heavy for all.
LIGHT = [
    (["--help"], {"numpy"}, "exit codes:"),
    (["run", "--help"], {"numpy"}, "examples:"),
    (["--version"], {"numpy"}, f"stickslip {version('stickslip')}"),
    (["scenes"], set(), "cascades"),
    (["schema"], set(), "$defs"),
]
LIGHTLY = f"""
import sys
from stickslip.workflows.commands import main
for argv, heavy, _ in {LIGHT}:
    try:
        main(argv)
    except SystemExit:
        pass
    heavy |= {{"dask", "distributed", "pandas", "pyarrow", "matplotlib"}}
    if loaded := heavy & set(sys.modules):
        sys.exit(f"{{argv}}: {{loaded}}")
"""


def test_what_needs_no_data_loads_no_heavy_library():
    """Cold start: nobody waits for dask, pandas or matplotlib to be told what there is."""
    done = python("-c", LIGHTLY)
    assert done.returncode == 0, done.stderr
    assert all(words in done.stdout for _, _, words in LIGHT)


def test_two_datasets_side_by_side(dataset, tmp_path, capsys):
    out = tmp_path / "compared"
    assert main(["report", str(dataset), "--compare", str(dataset), "--out", str(out)]) == 0
    assert "to the last digit" in capsys.readouterr().out
    assert not list(out.glob("report/*.parquet"))


def test_two_datasets_are_compared_under_the_settings_of_the_first(dataset, tmp_path, monkeypatch):
    undigested = lambda one, other, settings: compare(replace(one, digest=""), other, settings)  # noqa: E731
    monkeypatch.setattr("stickslip.workflows.reporting.compare", undigested)
    other = shutil.copytree(dataset, tmp_path / "other")
    scene = (other / "scene.toml").read_text().replace("t_burn = 1.0", "t_burn = 20.0").replace("[0.5]", "[1.0]")
    (other / "scene.toml").write_text(scene + "[analysis.margins]\nmean = 0.9\n")
    alone, first, second = (
        compared(*pair).tables["changes"] for pair in ((dataset, dataset), (dataset, other), (other, dataset))
    )
    pd.testing.assert_frame_equal(first, alone)
    assert (second["margin"][0], second["first"][0]) != (first["margin"][0], first["first"][0])


@pytest.mark.parametrize(
    ("more", "code", "words"),
    [
        (["--compare", "nowhere"], 1, "expected a dataset"),
        (["--out", "somewhere"], 2, "--out: expected with --compare alone"),
    ],
)
def test_comparisons_that_cannot_be(dataset, capsys, more, code, words):
    assert main(["report", str(dataset), *more]) == code
    assert words in capsys.readouterr().err


def test_a_dataset_with_no_member_done_has_no_report_yet(dataset, tmp_path, monkeypatch, capsys):
    dataset = shutil.copytree(dataset, tmp_path / "begun")
    (dataset / "report.html").unlink()
    monkeypatch.setattr("stickslip.pipeline.dataset.opened.Opened.n_done", 0)
    for more in ([], ["--compare", str(dataset)]):
        assert main(["report", str(dataset), *more]) == 1
        assert "no member is done yet; run the scene first" in capsys.readouterr().err


def test_a_comparison_never_takes_the_place_of_a_dataset(dataset, capsys):
    assert main(["report", str(dataset), "--compare", str(dataset), "--out", str(dataset)]) == 2
    assert "holds an ensemble" in capsys.readouterr().err


@pytest.mark.parametrize(("command", "n_opened"), [
    ("report .", 1),
    ("report . --compare ../other", 2),
    ("status .", 1),
    ("verify .", 1),
    ("query . 'SELECT count(*) FROM members'", 1),
    ("export . --netcdf ../one.nc", 1),
])  # fmt: skip
def test_a_command_opens_each_dataset_once_and_parses_its_scene_once(
    command, n_opened, dataset, tmp_path, monkeypatch, capsys
):
    for name in ("one", "other"):
        shutil.copytree(dataset, tmp_path / name)
        (tmp_path / name / "report.html").unlink()
    monkeypatch.chdir(tmp_path / "one")
    counts = Counter()

    def count(module, name):
        function = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *given, **more: counts.update([name]) or function(*given, **more))

    count(opened, "parse_scene")
    count(opened, "read_manifest")
    assert main(shlex.split(command)) == 0
    assert counts == {"parse_scene": n_opened, "read_manifest": n_opened}


def test_a_run_parses_its_scene_once_and_once_for_its_report(here, small_scene, tmp_path, monkeypatch):
    parsed = []
    as_scene = scene_module.as_scene
    monkeypatch.setattr(scene_module, "as_scene", lambda *given: parsed.append(given) or as_scene(*given))
    for more, n in ((["--no-report"], 1), ([], 2)):
        parsed.clear()
        assert main(["run", str(small_scene), "--out", str(tmp_path / "out"), "--workers", "1", *more]) == 0
        assert len(parsed) == n


def test_commands_to_copy_quote_names_with_spaces(here, tmp_path, small_scene, capsys):
    """What is printed to be run again is split by a shell into the words that were meant."""
    named = tmp_path / "my scenes" / "one scene.toml"
    assert main(["init", str(named.parent.with_name("a b.toml"))]) == 0
    said = capsys.readouterr().out
    for line in (line for line in said.splitlines() if line.strip().startswith("stickslip run")):
        assert shlex.split(line)[2] == str(tmp_path / "a b.toml")
    assert "`stickslip run 'a b.toml' --dry-run`" in (tmp_path / "a b.toml").read_text()
    named.parent.mkdir()
    shutil.copy(small_scene, named)
    out = str(tmp_path / "my data")
    assert main(["run", str(named), "--out", out, "--workers", "1", "--no-report"]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("report"))
    assert shlex.split(line.partition(": ")[2]) == ["stickslip", "report", out]


@pytest.mark.parametrize("words", ["--help", "run --help", "--version"])
def test_help_that_cannot_be_written_is_one_line(words):
    done = subprocess.run(
        f'"{sys.executable}" -m stickslip {words} > /dev/full', shell=True, capture_output=True, text=True
    )
    assert done.returncode == 1
    assert done.stderr.startswith("stickslip: ")
    assert "No space left on device" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_terminal_that_lacks_letters_shows_their_numbers(small_scene, tmp_path):
    scene = shutil.copy(small_scene, tmp_path / "ж.toml")
    done = python(
        "-m",
        "stickslip",
        "run",
        str(scene),
        "--dry-run",
        env=os.environ | {"PYTHONIOENCODING": "ascii"},
        cwd=tmp_path,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "\\u0436" in done.stdout


def test_a_backend_of_the_session_is_none_of_ours(dataset, tmp_path):
    copy = shutil.copytree(dataset, tmp_path / "copy")
    done = python("-m", "stickslip", "report", str(copy), env=os.environ | {"MPLBACKEND": "bogus"})
    assert (done.returncode, "Traceback" in done.stderr) == (0, False)


def test_a_damaged_configuration_of_dask_is_one_line(small_scene, tmp_path):
    (tmp_path / "dask.yaml").write_text("- a")
    words = ("run", str(small_scene), "--workers", "1", "--out", str(tmp_path / "out"))
    done = python("-m", "stickslip", *words, env=os.environ | {"DASK_CONFIG": str(tmp_path)})
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert str(tmp_path / "dask.yaml") in done.stderr


def test_a_working_directory_that_was_removed_is_named_for_that(tmp_path):
    gone = f'mkdir gone && cd gone && rmdir ../gone && "{sys.executable}" -m stickslip run quick --workers 1'
    done = subprocess.run(gone, shell=True, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (
        1, "stickslip: expected a working directory, got one that was removed; go to another\n",
    )  # fmt: skip
