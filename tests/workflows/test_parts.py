"""A dataset whose parts are links, pipes or sockets: refused by name; nothing outside is touched, nothing waits."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import threading

import pytest

from stickslip.pipeline import StoreError
from stickslip.pipeline.places import plain
from stickslip.pipeline.places.directory import Directory
from stickslip.workflows.commands import main

SECONDS = 60
PRECIOUS = b"precious\nand not ended"


def link(path, outside):
    path.symlink_to(outside)


def pipe(path, outside):
    os.mkfifo(path)


def unix_socket(path, outside):
    with socket.socket(socket.AF_UNIX) as bound:
        here = os.open(path.parent, os.O_RDONLY)  # whose path may be too long for a socket
        try:
            bound.bind(f"/proc/self/fd/{here}/{path.name}")
        finally:
            os.close(here)


def hard_link(path, outside):
    os.link(outside, path)


KINDS = {"a link": link, "a pipe": pipe, "a socket": unix_socket}

READERS = {
    "status": ["status", "{d}"],
    "verify": ["verify", "{d}"],
    "query": ["query", "{d}", "SELECT count(*), sum(len(t)) FROM shards"],
    "export": ["export", "{d}", "--netcdf", "{o}"],
    "extend": ["extend", "{d}", "--record", "end", "--out", "{o}", "--workers", "1"],
    "compare": ["report", "{d}", "--compare", "{x}"],
    "compared": ["report", "{x}", "--compare", "{d}", "--out", "{o}"],
}
WRITERS = {"run": ["run", "{s}", "--out", "{d}", "--workers", "1", "--no-report"], "report": ["report", "{d}"]}
#: The parts that every command looks at, and those that a report alone is made of.
PARTS = ("scene.toml", "manifest.json", "timings.jsonl", ".lock", "data", "report", "report.html")
OF_REPORTS = ("report/files.txt", "report/figures")


@pytest.fixture
def place(dataset, tmp_path):
    """A copy of a dataset to be spoilt, and what lies outside it: a file and another dataset."""
    (tmp_path / "outside").write_bytes(PRECIOUS)
    shutil.copytree(dataset, tmp_path / "theirs")
    return shutil.copytree(dataset, tmp_path / "d")


def contents(folder):
    return {file: file.read_bytes() for file in folder.rglob("*") if not file.is_symlink() and file.is_file()}


def spoil(place, part, make):
    """Put something else where a part is."""
    path = place / part
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    inner = place.parent / "theirs" / part
    make(path, inner if inner.is_dir() else place.parent / "outside")


def refused(words, place, small_scene, expected, capsys):
    """One line, quickly, beside progress; nothing outside has changed."""
    outside = place.parent
    names = {"d": place, "o": outside / "o.nc", "x": outside / "theirs", "s": small_scene}
    before = {file: content for file, content in contents(outside).items() if place not in file.parents}
    signal.alarm(SECONDS)  # ends all: a command that waits cannot be interrupted otherwise
    code = main([word.format_map(names) for word in words])
    signal.alarm(0)
    said = capsys.readouterr().err
    assert code in (1, 2)
    lines = [line for line in said.splitlines() if not line.startswith("report: ")]  # progress, if it takes a second
    assert len(lines) == 1
    assert expected in lines[0]
    assert {file: content for file, content in contents(outside).items() if place not in file.parents} == before


@pytest.mark.parametrize("what", KINDS)
@pytest.mark.parametrize("part", PARTS)
def test_what_is_no_plain_part_is_refused_by_name(part, what, place, small_scene, capsys):
    spoil(place, part, KINDS[what])
    kept = contents(place)
    for words in (READERS | WRITERS).values():
        refused(words, place, small_scene, f"{place / part}: expected ", capsys)
        assert contents(place) == kept


@pytest.mark.parametrize("what", KINDS)
@pytest.mark.parametrize("part", OF_REPORTS)
def test_a_report_is_written_to_plain_files(part, what, place, small_scene, capsys):
    (place / "report.html").unlink()  # else it is up to date
    spoil(place, part, KINDS[what])
    refused(WRITERS["report"], place, small_scene, f"{place / part}: expected ", capsys)


@pytest.mark.parametrize("what", KINDS)
def test_a_shard_is_a_plain_file(what, place, small_scene, capsys):
    shard = next((place / "data").iterdir())
    shutil.copy(shard, place.parent / "outside")  # the same bytes, elsewhere
    spoil(place, f"data/{shard.name}", KINDS[what])
    for name in ("status", "verify", "query", "export", "run"):
        refused((READERS | WRITERS)[name], place, small_scene, f"{shard}: expected a file, got {what}", capsys)


def test_a_comparison_stays_in_its_dataset(place, small_scene, capsys):
    (place / "compared").symlink_to(place.parent)
    refused(READERS["compare"], place, small_scene, f"{place / 'compared'}: expected a directory, got a link", capsys)


@pytest.mark.parametrize("part", ["timings.jsonl", ".lock"])
def test_what_is_changed_in_place_has_one_name(part, place, small_scene, capsys):
    """As `cp -al` makes two."""
    next((place / "data").iterdir()).unlink()
    (place.parent / "outside").write_text("process 77 on elsewhere\n")
    spoil(place, part, hard_link)
    refused(WRITERS["run"], place, small_scene, f"{place / part}: expected a file with one name", capsys)


def test_a_dataset_may_be_reached_through_a_link(place, tmp_path, capsys):
    (tmp_path / "link").symlink_to(place)
    (place / "notes").symlink_to("nowhere")  # what is no part of it is nobody's business
    assert main(["verify", str(tmp_path / "link")]) == 0
    assert main(["report", str(tmp_path / "link")]) == 0


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can have links of another user")
@pytest.mark.parametrize("is_above", [False, True])
@pytest.mark.parametrize("words", [*READERS.values(), *WRITERS.values()])
def test_a_link_of_another_user_does_not_lead_to_a_dataset(words, is_above, place, small_scene, tmp_path, capsys):
    """Else a run would write, and an answer for others would tell, what is in a dataset of this user alone."""
    link = tmp_path / "link"
    link.symlink_to(place.parent if is_above else place)
    os.chown(link, 1234, 1234, follow_symlinks=False)
    refused(words, link / place.name if is_above else link, small_scene, f"got the link {link} of the user", capsys)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can have links of another user")
def test_a_link_of_another_user_leads_to_what_is_that_users_and_makes_nothing_elsewhere(place, tmp_path):
    (private := tmp_path / "private").mkdir()
    for name, folder in (("to theirs", place), ("to ours", private)):
        (tmp_path / name).symlink_to(folder)
        os.chown(tmp_path / name, 1234, 1234, follow_symlinks=False)
    os.chown(place, 1234, 1234)
    assert main(["verify", str(tmp_path / "to theirs")]) == 0
    assert main(["report", str(tmp_path / "to theirs")]) == 0
    with pytest.raises(StoreError, match="got the link"):
        Directory(tmp_path / "to ours" / "a" / "b").make()
    assert not [*private.iterdir()]
    Directory(tmp_path / "to theirs" / "a" / "b").make()
    assert (place / "a" / "b").is_dir()


def test_names_of_unfinished_copies_are_not_guessed(tmp_path):
    names = set()
    for _ in range(2):
        with plain.folder(tmp_path) as directory, plain.Replacement("x", directory, tmp_path / "x"):
            (left,) = tmp_path.iterdir()
            names.add(left.name)
    assert not [*tmp_path.iterdir()]
    assert len(names) == 2


def exchanging(stop, path, others):
    """Put other things in the place of one, again and again."""
    aside = path.with_name(f"{path.name} aside")
    while not stop.is_set():
        for other in others:
            os.rename(path, aside)
            with contextlib.suppress(OSError):  # a folder has been made in its place meanwhile
                os.rename(other, path)
                os.rename(path, other)
            put_back(aside, path)


def put_back(aside, path):
    while True:
        try:
            return os.rename(aside, path)
        except OSError:
            shutil.rmtree(path, ignore_errors=True)


def test_no_race_leads_outside(tmp_path):
    """Between a look and what it allows: a folder that is a link at times, files that are links and pipes."""
    outside, inside, n_tries = tmp_path / "outside", tmp_path / "d", 300
    for folder in (outside, inside / "data"):
        folder.mkdir(parents=True)
        for name in ("read", "written", "removed"):
            (folder / name).write_bytes(PRECIOUS if folder == outside else b"mine")
    others = [inside / name for name in ("link", "file link", "pipe")]
    others[0].symlink_to(outside)
    others[1].symlink_to(outside / "read")
    os.mkfifo(others[2])
    before, stop, place, results = contents(outside), threading.Event(), Directory(inside), {b"mine": 0, "refused": 0}
    attack = [
        threading.Thread(target=exchanging, args=(stop, inside / "data", others[:1])),
        threading.Thread(target=exchanging, args=(stop, inside / "x", others[1:])),
    ]
    (inside / "x").write_bytes(b"mine")
    for thread in attack:
        thread.start()
    try:
        signal.alarm(SECONDS)
        for act in (
            lambda: place.read("data/read"),
            lambda: place.read("x"),
            lambda: place.replace("data/written", b"mine") or b"mine",
            lambda: place.remove("data/removed") or b"mine",
            lambda: place.names() and b"mine",
            lambda: place.sizes(["data/read", "x"]) and b"mine",
        ):
            for _ in range(n_tries):
                try:
                    results[act()] += 1
                except (StoreError, OSError):
                    results["refused"] += 1
        signal.alarm(0)
    finally:
        stop.set()
        for thread in attack:
            thread.join()
    assert min(results.values()) > 0
    assert contents(outside) == before
