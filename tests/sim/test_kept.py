"""What others may have put into the kernel cache is not run: it is refused by name, whatever way it came there."""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import re
import shutil
import signal
import stat
import tempfile
from pathlib import Path

import pytest

from stickslip.sim.kernels.cache import CacheError, CacheFiles
from stickslip.sim.kernels.digest import kernel_digest
from tests.processes import python, until
from tests.scenes import COULOMB, ensemble

#: A user that owns nothing; tests that need one are run by root, who can become any.
OTHER = 65534
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can have files of another user")


class Planted:
    """What writes a file when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.makedirs, (str(self.mark), 0o777, True)


@pytest.fixture
def top():
    """A directory that every user may pass through, unlike `tmp_path`, and in which only its owner may write."""
    top = Path(tempfile.mkdtemp(prefix="stickslip-kept-"))
    top.chmod(0o755)
    yield top
    shutil.rmtree(top)


@pytest.fixture
def cache(top):
    """A cache as a run has it, below directories that could be another's; it holds one kernel."""
    cache = top / "base" / "stickslip" / "digest"
    files(cache).save("key", "own")
    return cache


@pytest.fixture
def mark(top):
    """Made by whoever runs a planted file."""
    (top / "marks").mkdir(mode=0o777)
    (top / "marks").chmod(0o777)
    return top / "marks" / "run"


def files(cache):
    return CacheFiles(cache, "a")


def planted(mark):
    """A forged kernel, with the checksum that it should have."""
    data = pickle.dumps(Planted(mark))
    return data + hashlib.sha256(data).digest()


def kernel_of(cache):
    return cache / files(cache)._file("key")


def refused(cache, mark, where=None):
    """Loading raises, names what is wrong and the remedy, in one line; nothing was run."""
    with pytest.raises(CacheError, match=re.escape(f"got {where or cache}, ")) as refusal:
        files(cache).load("key")
    assert not mark.exists()
    assert "NUMBA_CACHE_DIR" in str(refusal.value)
    assert "\n" not in str(refusal.value)
    with pytest.raises(CacheError):
        files(cache).save("other", 1)


def test_a_forged_kernel_is_run_where_it_is_ones_own(cache, mark):
    """So the tests below could fail."""
    kernel_of(cache).write_bytes(planted(mark))
    files(cache).load("key")
    assert mark.exists()


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o770, 0o757])
@pytest.mark.parametrize("above", range(3))
def test_a_directory_that_others_may_write(cache, mark, mode, above):
    """One may pass through a sticky directory, where others cannot move what is ours; in the cache they could add."""
    kernel_of(cache).write_bytes(planted(mark))
    spoilt = (cache, *cache.parents)[above]
    spoilt.chmod(mode)
    if above and mode & stat.S_ISVTX:
        kernel_of(cache).unlink()
        assert files(cache).load("key") is None
    else:
        refused(cache, mark, spoilt)


def test_a_file_that_others_may_write_or_that_is_a_link_or_a_pipe(cache, mark, top):
    (top / "elsewhere").write_bytes(planted(mark))
    file = kernel_of(cache)
    for mode in (0o666, 0o664, 0o646, 0o777):
        file.write_bytes(planted(mark))
        file.chmod(mode)
        with pytest.raises(CacheError, match=re.escape(str(file))):
            files(cache).load("key")
    for make in (lambda: file.symlink_to(top / "elsewhere"), lambda: os.mkfifo(file), lambda: file.mkdir()):
        file.unlink()
        make()
        with pytest.raises(CacheError, match=r"a link|no plain file"):
            files(cache).load("key")
        if file.is_dir():
            file.rmdir()
            file.touch()
    assert not mark.exists()


def test_ones_own_link_is_followed_to_where_others_may_not_write(cache, mark, top):
    (top / "link").symlink_to("base/stickslip")
    (top / "link2").symlink_to(top / "other" / ".." / "link")
    (top / "other").mkdir()
    assert files(top / "link2" / "digest").load("key") == "own"
    kernel_of(cache).write_bytes(planted(mark))
    (top / "base").chmod(0o777)
    refused(top / "link2" / "digest", mark, top / "base")
    (top / "base").chmod(0o755)
    (top / "loop").symlink_to("loop")
    assert files(top / "loop" / "digest").load("key") is None  # as any directory that cannot be opened
    with pytest.raises(OSError, match="levels of symbolic links"):
        files(top / "loop" / "digest").save("key", 1)


def test_what_is_missing_is_made_for_this_user_to_write(top):
    before = os.umask(0)
    try:
        files(top / "a" / "b").save("key", 1)
    finally:
        os.umask(before)
    assert files(top / "a" / "b").load("key") == 1
    made = [top / "a", *(top / "a").rglob("*")]
    assert len(made) == 3
    assert not any(one.stat().st_mode & 0o022 for one in made)


@pytest.mark.parametrize("swapped", ["file", "digest", "stickslip", "base", pytest.param("link", marks=as_root)])
def test_what_is_swapped_between_any_two_calls_is_not_run(cache, mark, top, monkeypatch, swapped):
    """After each call by which the cache is looked at, in turn, what others may write stands in the place of ours."""
    file, forged = kernel_of(cache), top / "forged"
    genuine = {"file": file, "digest": cache, "base": cache.parents[1]}.get(swapped, cache.parent)
    if swapped == "file":
        forged.write_bytes(planted(mark))
    else:
        shutil.copytree(genuine, forged)
        (forged / file.relative_to(genuine)).write_bytes(planted(mark))
    # what another user would have put there: here told from ours by its mode, so that any user can run the test
    forged.chmod(0o755 if swapped == "link" else 0o777)
    if swapped == "link":  # another's, to what looks like ours
        forged.rename(top / "unpacked")
        forged.symlink_to(top / "unpacked")
        given(forged)
    aside = top / "aside"
    names = ("open", "stat", "fstat", "readlink", "read")
    calls = {name: getattr(os, name) for name in names}
    n_calls, at, outcomes = 0, 0, set()

    def counted(name):
        def call(*args, **kwargs):
            nonlocal n_calls
            n_calls += 1
            try:
                return calls[name](*args, **kwargs)
            finally:
                if n_calls == at:
                    genuine.rename(aside)
                    forged.rename(genuine)

        return call

    while n_calls >= at:
        at, n_calls = at + 1, 0
        with monkeypatch.context() as patch:
            for name in names:
                patch.setattr(os, name, counted(name))
            try:
                outcomes.add(files(cache)._read("key"))
            except CacheError:
                outcomes.add("refused")
        if n_calls >= at:
            genuine.rename(forged)
            aside.rename(genuine)
        assert not mark.exists(), f"after call {at}"
    assert outcomes - {None} == {"own", "refused"}
    assert at > 10


# ---------------------------------------------------------------------------------------------- another user


def given(path):
    os.chown(path, OTHER, OTHER, follow_symlinks=False)


@as_root
@pytest.mark.parametrize("above", range(3))
@pytest.mark.parametrize("is_link", [False, True])
def test_a_directory_or_a_link_of_another_user(cache, mark, top, above, is_link):
    """A link could lead to anything that we own, as an archive that we unpacked."""
    kernel_of(cache).write_bytes(planted(mark))
    spoilt = (cache, *cache.parents)[above]
    if is_link:
        spoilt.rename(top / "moved")
        spoilt.symlink_to(top / "moved")
    given(spoilt)
    refused(cache, mark, spoilt)


@as_root
def test_a_file_of_another_user(cache, mark, top):
    file = kernel_of(cache)
    (top / "theirs").write_bytes(planted(mark))
    given(top / "theirs")
    for make in (os.link, os.symlink, shutil.move):
        file.unlink()
        make(top / "theirs", file)
        with pytest.raises(CacheError, match=re.escape(str(file))):
            files(cache).load("key")
        assert not mark.exists()


@contextlib.contextmanager
def as_other(act):
    """Within: another user does something in a process of its own."""
    child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.setgid(OTHER)
            os.setuid(OTHER)
            act()
        finally:
            os._exit(0)
    try:
        yield child
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


@as_root
def test_another_user_takes_what_is_its_own_or_roots(cache, top):
    said = top / "said"
    said.touch()
    said.chmod(0o666)
    shutil.copytree(cache, top / "nobodys")
    for one in (top / "nobodys", *(top / "nobodys").iterdir()):
        os.chown(one, 1234, 1234)
    (top / "scratch").mkdir()
    (top / "scratch").chmod(0o1777)  # as of the temporary files of all

    def act():
        files(top / "scratch" / "its").save("key", "its")
        found = [files(top / "scratch" / "its").load("key"), files(cache).load("key")]
        try:
            files(top / "nobodys").load("key")
        except CacheError:
            found.append("refused")
        said.write_text(" ".join(found))

    with as_other(act):
        until(said.read_text)
    assert said.read_text() == "its own refused"
    with pytest.raises(CacheError):  # and root that of nobody else
        files(top / "scratch" / "its").load("key")


# ---------------------------------------------------------------------------------------------- the command


def test_a_run_says_so_in_one_line(top):
    scene, cache = top / "scene.toml", top / "cache"
    scene.write_text(ensemble([3], 2.0, 1, COULOMB))
    cache.mkdir()
    cache.chmod(0o777)
    words = ["-P", "-m", "stickslip", "run", str(scene), "--out", str(top / "out"), "--workers", "1"]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(Path(__file__).parents[2])}
    done = python(*words, env=environment, timeout=500)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("stickslip: kernel cache ")
    assert f"got {cache}, one that others may write (mode 777); set NUMBA_CACHE_DIR" in line
    assert not list(cache.rglob("*.nbc"))


def test_a_worker_elsewhere_does_not_make_failed_members_of_it(monkeypatch):
    """The run ends, with the words; rows that say "failed" would be kept."""
    from stickslip.pipeline import expand, parse_scene
    from stickslip.pipeline.running import worker

    def refuse(*_):
        raise CacheError("kernel cache /scratch/x")

    members = expand(parse_scene(ensemble([3], 2.0, 1, COULOMB).encode()))
    monkeypatch.setattr(worker, "_loaded", set())
    monkeypatch.setattr(worker, "_kept", refuse)
    with pytest.raises(CacheError, match="/scratch/x"):
        worker.load_kernels(members)
    assert str(pickle.loads(pickle.dumps(CacheError("a")))) == "a"


@pytest.mark.parametrize("settings", ["opt: '0'", "disable_jit: 1", "opt: ["])
def test_settings_of_numba_in_the_working_directory_are_refused(top, settings):
    """Anybody may have put them there, and kernels are compiled and kept as they say."""
    (top / ".numba_config.yaml").write_text(settings)
    (top / "scene.toml").write_text(ensemble([3], 2.0, 1, COULOMB))
    words = ["-P", "-m", "stickslip", "run", "scene.toml", "--out", "out", "--workers", "1"]
    done = python(*words, cwd=top, env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}, timeout=500)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"stickslip: {top}/.numba_config.yaml: expected no file of this name")


def test_kernels_are_kept_by_the_settings_that_they_were_compiled_with(monkeypatch):
    digests = [kernel_digest.__wrapped__()]
    for name in ("NUMBA_NUM_THREADS", "NUMBA_OPT", "NUMBA_BOUNDSCHECK"):
        monkeypatch.setenv(name, "1")
        digests.append(kernel_digest.__wrapped__())
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3
