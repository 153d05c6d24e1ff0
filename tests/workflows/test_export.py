"""What leaves a dataset as a file: whole or not at all, with every null, and readable whatever things are called."""

from __future__ import annotations

import base64
import contextlib
import os
import pty
import re
import resource
import shutil
import signal
import socket
import stat
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import netCDF4
import numpy as np
import pandas as pd
import pytest
from scipy.io import loadmat

from stickslip.analysis.page.build import Report
from stickslip.analysis.page.parts import Drawn
from stickslip.pipeline import parse_scene, query, run_ensemble
from stickslip.pipeline.ensemble import member
from stickslip.pipeline.errors import command
from stickslip.workflows.commands import main
from stickslip.workflows.export import whole
from stickslip.workflows.reporting import write
from tests.faults.world import Unshown, small_disk
from tests.scenes import COULOMB, ensemble


@pytest.fixture(scope="module")
def some_failed(tmp_path_factory):
    """A dataset in which members of three blocks failed, and so have nulls."""
    task = member.Member.task

    def fragile(member, *args):
        if member.n == 3:
            raise ZeroDivisionError("planted")
        return task(member, *args)

    path = tmp_path_factory.mktemp("some") / "failed"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(member.Member, "task", fragile)
        run_ensemble(parse_scene(ensemble([3, 5], 8.0, 4, COULOMB).encode()), path, workers=0)
    return path


def test_a_null_is_not_a_zero_in_netcdf(some_failed, tmp_path):
    assert main(["export", str(some_failed), "--netcdf", str(tmp_path / "a.nc")]) == 0
    table = query.members(some_failed)
    failed = (table["outcome"] == "failed").to_numpy()
    assert 0 < failed.sum() < len(failed)
    n_whole_numbers = 0
    with netCDF4.Dataset(tmp_path / "a.nc") as file:
        for name in ("n_events", "n_exits", "n_stick_end", "n_steps", "t_stop"):
            found = file[name][:]
            assert np.array_equal(np.ma.getmaskarray(found), failed), name
            assert np.array_equal(found.compressed(), table[name][~failed]), name
            raw = file[name]
            raw.set_auto_mask(False)
            is_whole = raw.dtype.kind in "iu"
            n_whole_numbers += is_whole
            assert not is_whole or (raw[:][failed] == raw._FillValue).all(), name
            assert not (raw[:][failed] == 0).any(), name
    assert n_whole_numbers >= 4


FORMS = {
    "a.nc": ["export", "{dataset}", "--netcdf"],
    "a.csv": ["query", "{dataset}", "SELECT range, range * range FROM range(30000)", "--out"],
    "a.parquet": ["query", "{dataset}", "SELECT range, random() FROM range(30000)", "--out"],
}


def one_line_and_nothing_left(arguments, out, reason, capsys):
    before = sorted(out.parent.iterdir())
    assert main([*arguments, str(out)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"stickslip: {arguments[-1]}: {out.resolve()} cannot be written ({reason})"), line
    assert sorted(out.parent.iterdir()) == before


@pytest.mark.parametrize("name", FORMS)
def test_a_full_disk_is_one_line(name, some_failed, capsys):
    arguments = [word.format(dataset=some_failed) for word in FORMS[name]]
    with contextlib.ExitStack() as mounted:
        try:
            disk = mounted.enter_context(small_disk("128k"))
        except Unshown as why:
            pytest.skip(str(why))
        (disk / name).write_text("old")
        for room in (0, 8, 32):  # from a file that cannot be begun to one that cannot be ended
            free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
            (disk / "ballast").write_bytes(bytes(free - 1024 * room))
            one_line_and_nothing_left(arguments, disk / name, "No space left on device", capsys)
            (disk / "ballast").unlink()
            assert (disk / name).read_text() == "old"


@pytest.mark.parametrize("name", FORMS)
def test_a_file_that_may_not_be_so_large_is_one_line(name, some_failed, tmp_path, capsys):
    """As a full disk is, and no right to mount one is needed."""
    arguments = [word.format(dataset=some_failed) for word in FORMS[name]]
    (tmp_path / name).write_text("old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, hard))
    try:
        one_line_and_nothing_left(arguments, tmp_path / name, "File too large", capsys)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / name).read_text() == "old"
    assert main([*arguments, str(tmp_path / name)]) == 0


def test_what_is_no_file_is_refused(some_failed, tmp_path, capsys):
    """And a pipe that nobody reads is not waited for."""
    os.mkfifo(tmp_path / "a.csv")
    for arguments in FORMS.values():
        more = [] if arguments[0] == "export" else ["--format", "csv"]
        for out in ("/dev/full", str(tmp_path / "a.csv")):
            assert main([*(word.format(dataset=some_failed) for word in arguments), out, *more]) == 2
            assert f"expected a file, got {out}, a pipe or a device" in capsys.readouterr().err


def test_an_export_is_on_the_disk_before_its_name_and_the_name_before_it_ends(some_failed, tmp_path, monkeypatch):
    calls, replace = [], os.replace

    def fsync(descriptor):
        found = os.fstat(descriptor)
        calls.append(("sync", "directory" if stat.S_ISDIR(found.st_mode) else found.st_size))

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", lambda old, new, **at: (calls.append(("name", new)), replace(old, new, **at)))
    with whole(tmp_path / "file", some_failed) as stream:
        stream.write(b"x" * 100_000)
    assert calls == [("sync", 100_000), ("name", "file"), ("sync", "directory")]


@pytest.mark.parametrize("name", FORMS)
def test_what_a_killed_export_left_goes_with_the_next(name, some_failed, tmp_path):
    arguments = [word.format(dataset=some_failed) for word in FORMS[name]]
    child = os.fork()
    if child == 0:
        with whole(tmp_path / name, some_failed) as stream:
            stream.write(b"half")
            stream.flush()
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    (left,) = tmp_path.iterdir()
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as living:
        begun, chance = f".tmp-{name}-{socket.gethostname()}-", "0123456789abcdef"
        assert re.fullmatch(rf"{re.escape(begun)}{child}-[0-9a-f]{{16}}", left.name)
        kept = {
            f"{begun}{living.pid}-{chance}",  # under way
            f".tmp-{name}-elsewhere-{child}-{chance}",  # of another machine, whose processes nobody here knows
            f".tmp-{name}x-{socket.gethostname()}-{child}-{chance}",  # of another file
            f"{begun}{child}-notes",
            f"{begun}notes",
        }
        for one in kept:
            (tmp_path / one).touch()
        assert main([*arguments, str(tmp_path / name)]) == 0
        assert {one.name for one in tmp_path.iterdir()} == kept | {name}
        living.communicate(b"\n")


def test_a_name_that_netcdf_cannot_say(some_failed, tmp_path, capsys):
    assert main(["export", str(some_failed), "--netcdf", str(tmp_path / "a\udcff.nc")]) == 0
    assert "a\\udcff.nc" in capsys.readouterr().out
    assert main(["export", str(some_failed), "--netcdf", str(tmp_path / "a.nc")]) == 0
    assert (tmp_path / "a\udcff.nc").read_bytes() == (tmp_path / "a.nc").read_bytes()


# ---------------------------------------------------------------------------------------------- names on pages

#: Of directories. No text of XML: a control character; an escape sequence for terminals.
OUT = "runsa\x01ba\x1b[31mb"
#: Of files. Markup; the end of a comment; mathtext.
NAMES = ("<b>&--a", "a$x_$b", "$a")


@pytest.mark.parametrize("argv", [
    ["run", "{0}.toml", "--dry-run"],
    ["run", "none{0}.toml"],
    ["run", "{0}.toml", "--only", "{0}"],
    ["status", "{0}"],
    ["verify", "{0}"],
    ["plot", "{0}", "m", "--out", "a.svg"],
    ["init", "{0}/{0}"],
    ["init", "{0}.toml"],
    ["{0}"],
])  # fmt: skip
def test_no_message_obeys_a_name(argv, small_scene, tmp_path, monkeypatch, capsys):
    """Whatever prints it: a command, what reads options, or the log."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(small_scene, f"{OUT}.toml")
    with contextlib.suppress(SystemExit):
        main([word.format(OUT) for word in argv])
    said = "".join(capsys.readouterr())
    assert r"a\x1b[31mb" in said
    assert all(c.isprintable() or c == "\n" for c in said)


def test_a_command_that_is_shown_names_the_same_file():
    words = ["a\x1b[31m'b\\", "plain", "with space"]
    shown = command(*words)
    assert shown.isprintable()
    said = subprocess.run(
        ["bash", "-c", shown.replace("stickslip", "printf '%s\\n'", 1)], capture_output=True, text=True
    )
    assert said.stdout.split("\n")[:-1] == words


ASKED = "SELECT chr(27) || '[31mé' AS a, 1 AS \"b\x1b\""


def test_csv_obeys_nothing_in_a_terminal(dataset):
    """A file, or a program, has the bytes as they are."""
    reader, writer = pty.openpty()
    words = [sys.executable, "-m", "stickslip", "query", str(dataset), ASKED, "--format", "csv"]
    done = subprocess.run(words, stdout=writer, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL)
    assert done.returncode == 0, done.stderr
    assert os.read(reader, 1 << 12).decode().splitlines() == ['"a","b\\x1b"', '"\\x1b[31mé",1']
    os.close(reader)
    os.close(writer)
    assert subprocess.run(words, capture_output=True).stdout.decode() == '"a","b\x1b"\n"\x1b[31mé",1\n'


def test_files_with_any_name_leave_pages_and_figures_that_open(here, rng, tmp_path, capsys):
    (tmp_path / "K").mkdir()
    for name, strength in zip(NAMES, (0.01, 0.2, 0.2), strict=True):  # some die at once, which makes figures
        u = rng.uniform(-strength, strength, (20, 20))
        np.save(tmp_path / "K" / f"{name}.npy", (u - u.T) / 2 + 0.1 * np.eye(20))
    scene, out = tmp_path / "s.toml", tmp_path / OUT
    source = ensemble(20, 20.0, len(NAMES), COULOMB, title="", analysis="t_burn = 1.0\ndt = 0.5\nresamples = 50")
    scene.write_text(source.replace('"antisymmetric"', '"file"\npath = "K/*.npy"\nrho = 3.5\nfriction = [0.8, 1.0]'))
    assert main(["run", str(scene), "--out", str(out), "--workers", "1"]) == 0
    said = capsys.readouterr().out.replace(str(out), "")
    assert all(c.isprintable() or c == "\n" for c in said)
    figures = sorted((out / "report" / "figures").glob("*.svg"))
    page = (out / "report.html").read_text()
    inline = re.findall(r"data:image/svg\+xml;base64,([A-Za-z0-9+/=]+)", page)
    assert len(inline) >= len(figures) > 0
    drawn = [figure.read_bytes() for figure in figures]
    for svg in (*drawn, *map(base64.b64decode, inline)):
        ElementTree.fromstring(svg)
    assert any(re.search(rb"a\\?\$x_", svg) for svg in drawn), "no figure shows a name"
    assert not set(page) & {c for c in OUT if not c.isprintable()}
    assert r"a\x01b" in page.partition("</title>")[0]
    pdf = [figure.with_suffix(".pdf") for figure in figures]
    assert not any(figure.exists() for figure in pdf)
    assert main(["report", str(out), "--pdf"]) == 0
    assert all(figure.read_bytes().startswith(b"%PDF") for figure in pdf)
    assert main(["report", str(out)]) == 0
    assert capsys.readouterr().out.endswith("unchanged\n")
    notes = out / "report" / "notes.csv"
    notes.write_text("the user's own")
    with open(out / "report" / "files.txt", "a") as listed:  # whoever wrote it
        for name in (f"report/{notes.name}", "report/../manifest.json", "manifest.json"):
            listed.write(f"{'0' * 64}  {name}\n{name}\n")
    write(Report("", {}, [], {figures[0].stem: Drawn("<svg/>")}), out)
    left = {file.name for file in (out / "report").rglob("*") if file.is_file()}
    kept = {figures[0].name, "findings.json", "files.txt", notes.name}
    assert left == kept, "others are of another report"
    assert (out / "manifest.json").exists()


def test_a_text_in_csv_is_no_formula(some_failed, tmp_path):
    file, texts = tmp_path / "a.csv", ["=1+1", "+1", "-x", "@a", "\tq", "\r"]
    columns = ", ".join(f"'{text}' AS words_{k}" for k, text in enumerate(texts))
    query = f"SELECT {columns}, -1 AS number, 'a=b' AS other"
    assert main(["query", str(some_failed), query, "--out", str(file)]) == 0
    found = pd.read_csv(file, lineterminator="\n").iloc[0].tolist()
    assert found == [*(f"'{text}" for text in texts), -1, "a=b"]


def test_matlab_reads_numbers_texts_lists_and_nulls(some_failed, tmp_path):
    """As `scipy.io.loadmat` does; what it reads is what `query.sql` has."""
    asked = (
        "SELECT member_id, n, n_stick_end, reason, n > 3 AS is_large, sum(n) OVER () AS whole, [n, NULL] AS pair"
        " FROM members ORDER BY member_id"
    )
    assert main(["query", str(some_failed), asked, "--out", str(tmp_path / "a.mat")]) == 0
    stored, table = loadmat(tmp_path / "a.mat"), query.sql(some_failed, asked)
    for name in ("n", "is_large", "whole", "n_stick_end"):
        expected = table[name].to_numpy(np.float64, na_value=np.nan)
        np.testing.assert_array_equal(stored[name].ravel(), expected)
    assert np.isnan(stored["n_stick_end"]).any()
    for name in ("member_id", "reason"):
        texts = [cell[0] if cell.size else "" for cell in stored[name].ravel()]
        assert texts == table[name].fillna("").tolist()
    np.testing.assert_array_equal(stored["pair"][0, 0].ravel(), [table["n"][0], np.nan])


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ("SELECT count(*) FROM members", "got 'count_star()'; name it in the query"),
        ("SELECT {'a': 1} AS both FROM members", "got 'both', which holds struct"),
    ],
)
def test_what_matlab_cannot_hold_is_refused_by_name(asked, words, some_failed, tmp_path, capsys):
    assert main(["query", str(some_failed), asked, "--out", str(tmp_path / "a.mat")]) != 0
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can have links of another user")
@pytest.mark.parametrize("owner", [0, 1234])
@pytest.mark.parametrize("is_folder", [False, True])
def test_no_link_of_another_user_is_followed(owner, is_folder, some_failed, tmp_path, capsys):
    private = tmp_path / "private"
    private.mkdir()
    (private / "a.csv").write_text("precious")
    link = tmp_path / "link"
    link.symlink_to(private if is_folder else private / "a.csv")
    os.chown(link, owner, owner, follow_symlinks=False)
    out = link / "a.csv" if is_folder else link
    code = main(["query", str(some_failed), "SELECT 1 AS one", "--format", "csv", "--out", str(out)])
    assert code == (2 if owner else 0)
    assert ("precious" in (private / "a.csv").read_text()) == bool(owner)
    assert (f"got the link {link} of the user with the id 1234" in capsys.readouterr().err) == bool(owner)


def test_links_that_lead_round_are_one_line(some_failed, tmp_path, capsys):
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    for out in (tmp_path / "a", tmp_path / "a" / "c.csv"):
        for words in (["query", str(some_failed), "SELECT 1", "--format", "csv"], ["run", "quick", "--yes"]):
            assert main([*words, "--out", str(out)]) in (1, 2)
            assert capsys.readouterr().err.count("\n") == 1


def test_an_answer_to_a_closed_stream_is_refused(dataset):
    command = f'"{sys.executable}" -m stickslip query "{dataset}" "SELECT 1" >&-'
    done = subprocess.run(command, shell=True, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (
        2, "stickslip: the standard output is closed; name a file by --out\n",
    )  # fmt: skip
