"""Processes beside this one: they load what it has loaded, and outlive nobody."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import math
import os
import shutil
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stickslip.pipeline import expand
from stickslip.pipeline.ensemble.pack import Batch
from stickslip.pipeline.machine import processes
from stickslip.pipeline.machine.processes import Child, ChildDied, ErrorStream, environment_kept
from stickslip.pipeline.machine.scratch import scratch
from stickslip.pipeline.running.worker import compute, compute_alone
from tests.processes import is_running, python, until


def test_a_file_of_the_users_is_no_module_of_ours(scene, tmp_path, monkeypatch):
    """Where a user works there may be a sim.py."""
    for name in ("sim", "pipeline", "pickle"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(3)\n")
    monkeypatch.chdir(tmp_path)
    batch = Batch(0, expand(scene)[:2], scene.recording)
    here, there = compute(batch), compute_alone((batch, None))
    assert there.shard == here.shard


def test_a_member_whose_process_dies_is_run_again_and_fails_if_that_dies_too(scene, monkeypatch):
    batch = Batch(0, expand(scene)[:3], scene.recording)
    names, begun = [member.member_id for member in batch.members], []

    class Mortal(contextlib.nullcontext):
        def __enter__(self):
            return self

        def __call__(self, function, members, recording):
            begun.append(members[0].member_id)
            if begun.count(begun[-1]) <= {names[0]: 1, names[1]: 2}.get(begun[-1], 0):
                raise ChildDied("signal 9")
            return function(members, recording)

    monkeypatch.setattr("stickslip.pipeline.running.worker.Child", Mortal)
    assert compute_alone((batch, None)).commit.entry.outcomes == {"finished": 2, "failed": 1}
    assert begun == [names[0]] * 2 + [names[1]] * 2 + [names[2]]


def hang(file):
    """In a child: say who it is, and never answer."""
    Path(file).write_text(str(os.getpid()))
    time.sleep(99)


def leave(code):
    os._exit(code)


def test_it_ends_with_its_parent_in_the_middle_of_its_work(tmp_path):
    pid = tmp_path / "pid"
    code = (
        "from stickslip.pipeline.machine.processes import Child; from tests.pipeline.test_processes import hang\n"
        f"Child()(hang, {str(pid)!r})"
    )
    with subprocess.Popen([sys.executable, "-c", code], env=processes._environment()) as parent:
        until(lambda: pid.exists() and pid.read_text() != "")
        os.kill(parent.pid, signal.SIGKILL)
    until(lambda: not is_running(int(pid.read_text())))


def test_it_answers_one_question_after_the_other_and_says_how_it_died():
    with Child() as child:
        assert [child(math.factorial, n) for n in range(5)] == [1, 1, 2, 6, 24]
        assert child(math.comb, 5, 2) == 10
        with pytest.raises(ChildDied, match="exit code 1"):  # it raised
            child(math.factorial, "five")
        with pytest.raises(ChildDied, match="exit code 1"):
            child(math.factorial, 5)
    with Child() as child, pytest.raises(ChildDied, match="exit code 3"):
        child(leave, 3)
    with Child() as child:
        pass
    assert not is_running(child.pid)


def test_it_has_some_time_to_start(tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text("import time; time.sleep(999)\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.setattr(processes, "_FIRST_SECONDS", 1.0)
    with Child() as child, pytest.raises(ChildDied, match="signal SIGKILL"):
        child(math.factorial, 3)


FORKING = """
import json, os, signal, sys
sys.path.remove("")  # as in a program that is installed
from stickslip.pipeline.machine.processes import forked_workers, frugal

def about():
    there = dict(os.environ), sorted(signal.pthread_sigmask(signal.SIG_BLOCK, ()))
    return os.getppid(), "stickslip.pipeline.running.preload" in sys.modules, *there

before = dict(os.environ)
with frugal(), forked_workers():
    from stickslip.pipeline.running import cluster
    with cluster.local(2) as client:
        found = list(client.run(about).values())
assert dict(os.environ) == before
with cluster.local(1) as client:  # as ever
    print(json.dumps([os.getpid(), found, client.submit(os.getppid).result()]))
"""


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux")
def test_workers_of_a_program_are_forked_from_what_has_loaded_all_and_goes_with_it(tmp_path, monkeypatch):
    for name in ("sim", "numba", "queue", "stickslip"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(3)\n")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    (room := tmp_path / ("t" * 120)).mkdir()  # longer than a socket's path may be
    monkeypatch.setenv("TMPDIR", str(room))
    command = [sys.executable, "-c", FORKING]
    done = subprocess.run(command, cwd=tmp_path, env=processes._environment(), capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    driver, found, later = json.loads(done.stdout)
    (server,) = {parent for parent, *_ in found}
    assert server != driver == later
    for _, is_loaded, environment, signals in found:
        assert is_loaded
        assert environment["OMP_NUM_THREADS"] == "1"
        assert signals == sorted([signal.SIGINT, signal.SIGTERM])
    assert not is_running(server)
    assert not any(room.iterdir())


def test_the_environment_is_as_it_was(monkeypatch):
    monkeypatch.setenv("STICKSLIP_THERE", "1")
    monkeypatch.setenv("STICKSLIP_GONE", "1")
    before = dict(os.environ)
    with environment_kept():
        os.environ |= {"STICKSLIP_THERE": "2", "STICKSLIP_NEW": "3"}
        del os.environ["STICKSLIP_GONE"]
    assert dict(os.environ) == before


def test_the_path_holds_the_working_directory_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", "/else"])
    assert processes._environment()["PYTHONPATH"] == f"{tmp_path}{os.pathsep}/else"


# ------------------------------------------------------------------------------------------ directories


def scratch_of_a_process(parent, how):
    """In a child: hold a directory with files in it, and end without a word."""
    with scratch(str(parent)) as own:
        (Path(own.path) / "folder").mkdir()
        (Path(own.path) / "folder" / "file").write_text("left")
        print(own.path, flush=True)
        how()


def beside(parent, how):
    code = (
        "import os, signal, sys, time; from pathlib import Path;"
        " from tests.pipeline.test_processes import scratch_of_a_process;"
        f" scratch_of_a_process({str(parent)!r}, lambda: {how})"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env=processes._environment(),
    )  # fmt: skip


def test_what_killed_processes_left_is_swept_and_nothing_else(tmp_path):
    with beside(tmp_path, "os.kill(os.getpid(), signal.SIGKILL)") as killed:
        left = Path(killed.stdout.readline().strip())
    outside = tmp_path / "outside"
    (outside / "folder").mkdir(parents=True)
    link = tmp_path / f"{left.name}link"
    link.symlink_to(outside)
    (left / "folder" / "link").symlink_to(outside)
    file = tmp_path / f"{left.name}file"
    file.write_text("no directory")
    elsewhere = tmp_path / "-2-".join(left.name.rsplit("-", 1))  # of another machine
    elsewhere.mkdir()
    with beside(tmp_path, "input()") as living:
        its = Path(living.stdout.readline().strip())
        assert not left.exists()
        with scratch(str(tmp_path)) as own:
            assert Path(own.path).stat().st_mode & 0o777 == 0o700
            assert set(tmp_path.iterdir()) == {outside, link, file, elsewhere, its, Path(own.path)}
        living.communicate("\n")
    assert set(tmp_path.iterdir()) == {outside, link, file, elsewhere}
    assert (outside / "folder").is_dir()


def test_a_directory_that_cannot_be_locked_is_no_hindrance(tmp_path, monkeypatch):
    def refused(*_):
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr(fcntl, "flock", refused)
    with scratch(str(tmp_path)) as own, scratch(str(tmp_path)) as other:
        assert own.path != other.path
        assert len(list(tmp_path.iterdir())) == 2
    assert not any(tmp_path.iterdir())


def test_a_directory_goes_in_which_a_process_still_writes_as_it_is_removed(tmp_path, monkeypatch):
    remove = shutil.rmtree

    def removed(path, **how):
        monkeypatch.setattr(shutil, "rmtree", remove)
        remove(path, **how)
        (Path(path) / "late").mkdir(parents=True)  # where a folder that is not empty stays

    with scratch(str(tmp_path)):
        monkeypatch.setattr(shutil, "rmtree", removed)
    assert not any(tmp_path.iterdir())


# ------------------------------------------------------------------------------------------ standard streams

PRINTS = "import sys; [print(f'line {k}', file=sys.stderr) for k in range(100_000)]"


def test_what_processes_say_as_they_start_is_held_and_then_passed_on(capfd):
    with ErrorStream() as errors:
        with errors.instead():
            subprocess.run([sys.executable, "-c", "import sys; print('first', file=sys.stderr)"], check=True)
        print("not from there", file=sys.stderr)
        until(lambda: bool(errors._held))
        assert capfd.readouterr().err == "not from there\n"
        errors.pass_on()
        with errors.instead():
            subprocess.run([sys.executable, "-c", "import sys; print('then', file=sys.stderr)"], check=True)
    assert capfd.readouterr().err == "first\nthen\n"


def test_of_what_processes_said_as_they_died_the_last_lines_are_told(capfd):
    with ErrorStream() as errors:
        with errors.instead():
            subprocess.run([sys.executable, "-c", PRINTS + "; raise SystemExit('the last')"], check=False)
        assert errors.last_lines() == [*(f"line {k}" for k in range(99_996, 100_000)), "the last"]
    assert capfd.readouterr().err == ""


STREAMS = """
import os, sys
from stickslip.pipeline.machine.processes import open_streams
open_streams()
print("out", flush=True)
print("err", file=sys.stderr)
opened = os.open(os.devnull, os.O_RDONLY)
os._exit(0 if opened > 2 and sys.stdin.read() == "" and all(map(os.get_inheritable, range(3))) else 1)
"""


@pytest.mark.parametrize("closed", ["", "0<&-", "1>&-", "2>&-", "1>&- 2>&-", "0<&- 1>&- 2>&-"])
def test_no_file_gets_the_number_of_a_stream_that_is_closed(closed):
    done = subprocess.run(
        ["sh", "-c", f'exec "$0" -c "$1" {closed}', sys.executable, STREAMS],
        env=processes._environment(), stdin=subprocess.DEVNULL, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0
    assert done.stdout == "out\n" * ("1" not in closed)
    assert done.stderr == "err\n" * ("2>" not in closed)


# ------------------------------------------------------------------------------------------ signals

BUSY = """
import hashlib, time
from stickslip.pipeline.machine import signals
with signals.interruptible(is_program=True), signals.last_act(lambda: print("last", flush=True)):
    try:
        print("busy", flush=True)
        time.sleep(999)
    except signals.Interrupted:  # somebody swallows it, and goes on for a quarter of an hour in compiled code
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_signal_ends_a_program_whatever_it_is_at(number):
    with subprocess.Popen(
        [sys.executable, "-c", BUSY], env=processes._environment(), stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "busy\n"
        process.send_signal(number)
        said, _ = process.communicate(timeout=500)
    assert (process.returncode, said) == (128 + number, "last\n")


AT_ONCE = """
import multiprocessing
from stickslip.pipeline.machine import processes, signals
with processes.forked_workers():
    kept = multiprocessing.get_context("spawn").Queue()
    signals.end_at_once(2)
"""


def test_a_program_that_ends_at_once_leaves_no_words_of_semaphores():
    done = python("-c", AT_ONCE, env=processes._environment(), timeout=60)
    assert (done.returncode, done.stderr) == (130, "")


LEAVING = """
import atexit, hashlib, sys, time
from stickslip.pipeline.machine import signals
class Endless:  # as Python ends, in compiled code
    def __del__(self):
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)
endless = Endless()
atexit.register(print, "kept")
try:
    with signals.interruptible(is_program=True):
        print("busy", flush=True)
        time.sleep(999)
except signals.Interrupted as asked:
    signals.leave(asked.exit_code)
"""


def test_a_program_that_a_signal_ends_does_not_wait_for_pythons_own_end():
    with subprocess.Popen(
        [sys.executable, "-c", LEAVING], env=processes._environment(), stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "busy\n"
        process.send_signal(signal.SIGTERM)
        try:
            said, _ = process.communicate(timeout=60)
        finally:
            process.kill()
    assert (process.returncode, said) == (128 + signal.SIGTERM, "kept\n")


def test_a_hangup_that_is_ignored_stays_so():
    code = BUSY.replace("time.sleep(999)", "input()")
    with subprocess.Popen(
        ["nohup", sys.executable, "-c", code],
        env=processes._environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout.readline() == "busy\n"
        process.send_signal(signal.SIGHUP)
        process.communicate("\n", timeout=500)
    assert process.returncode == 0


def test_a_scratch_directory_can_be_opened_whatever_the_umask(tmp_path):
    before = os.umask(0o777)
    try:
        with scratch(str(tmp_path)) as directory:
            assert stat.S_IMODE(os.stat(directory.path).st_mode) == 0o700
    finally:
        os.umask(before)
    assert [*tmp_path.iterdir()] == []


def test_a_fork_server_that_was_stopped_does_not_outlive_a_program_that_ends_at_once():
    code = (
        "import os, signal\n"
        "from stickslip.pipeline.machine import processes, signals\n"
        "with processes.forked_workers():\n"
        "    print(processes.forks._pid, flush=True)\n"
        "    os.kill(processes.forks._pid, signal.SIGSTOP)\n"
        "    signals.end_at_once(signal.SIGTERM)\n"
    )
    done = python("-c", code)
    assert done.returncode == 143
    until(lambda: not is_running(int(done.stdout)), 20.0)
