"""A small scene, its undisturbed dataset, and the ways to run it badly."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from stickslip.pipeline import expand, parse_scene, run_ensemble, verify
from stickslip.pipeline.dataset.program import program
from stickslip.pipeline.ensemble import pack
from stickslip.pipeline.places.manifest import read_manifest
from stickslip.pipeline.places.place import MANIFEST, PACKAGE, SCENE
from tests.scenes import ensemble

ROOT = Path(__file__).parents[2]
INJECT = Path(__file__).parent / "inject"

#: The command without its report, which takes longer than the small scene.
COMMAND = """
import sys
from stickslip.workflows.commands import main, run
run.write_report = lambda *_: True
sys.exit(main())
"""

#: Small batches: a small scene then has many shards.
TARGET_COST = 3.5e-3

#: Seconds for what takes some on a machine that has nothing else to do; what still runs then is taken to hang.
PATIENCE = 1200.0

SOURCE = ensemble([5, 3], 4.0, 5, seed=7, title="faults", analysis="t_burn = 1.0\ndt = 0.5\nresamples = 2").encode()


class Unshown(Exception):
    """The fault cannot be made here; the message says why."""


def content(path: Path) -> dict[str, bytes]:
    """Every byte of a dataset but the timings and the report, by file."""
    files = [file for file in path.rglob("*") if file.is_file() and file.relative_to(path).parts[0] != "report"]
    names = {str(file.relative_to(path)): file for file in files}
    return {
        name: file.read_bytes()
        for name, file in names.items()
        if not name.startswith("timings") and name != "report.html"
    }


@dataclass
class World:
    """A directory to work in, a scene, its undisturbed dataset, and chance that can be repeated."""

    directory: Path
    seed: int = 0
    source: bytes = SOURCE
    reference: dict[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        pack.TARGET_COST = TARGET_COST
        self.random = random.Random(self.seed)
        self.program = program()  # found once, before anything forks
        self.scene = parse_scene(self.source)
        self.scene_file = self.directory / "scene.toml"
        self.scene_file.write_bytes(self.source)
        members = expand(self.scene)
        self.hung = {member.member_id: "hang" for member in members[len(members) // 2 :]}  #: victims that never end
        for member in members[:2]:  # kernels are loaded before anything forks
            member.simulate()
        self.undisturbed = self.directory / "undisturbed"
        assert self.fork(lambda: self.run(self.undisturbed)) == 0
        start = time.perf_counter()  # of a second one, which has nothing to compile
        assert self.fork(lambda: self.run(self.directory / "timed")) == 0
        self.seconds = time.perf_counter() - start
        self.reference = content(self.undisturbed)
        assert len(self.reference) > 8

    def run(self, out: Path | str) -> None:
        run_ensemble(self.scene, out, workers=0)

    def copy(self, name: str = "out", of: Path | None = None) -> Path:
        """A copy of a dataset, the undisturbed one if none is named, to be spoilt."""
        out = self.directory / name
        shutil.rmtree(out, ignore_errors=True)
        return Path(shutil.copytree(of or self.undisturbed, out))

    # ------------------------------------------------------------------------------- processes

    def start(self, act: Callable[[], None], said: Path | None = None) -> int:
        """Run a function in a child of this process, which has no threads; its process number. Words go to `said`."""
        sys.stdout.flush()
        child = os.fork()
        if child:
            return child
        code = 70
        try:
            words = io.StringIO()
            logging.disable()
            try:
                act()
                code = 0
            except BaseException:  # noqa: BLE001  whatever it was, the parent is told
                words.write(traceback.format_exc())
                code = 1
            if said is not None:
                said.write_text(words.getvalue())
            elif code:
                sys.stderr.write(words.getvalue())
        finally:
            os._exit(code)

    def fork(self, act: Callable[[], None], said: Path | None = None) -> int:
        """Run a function in a child and wait for it: 0, 1 if it raised, less than 0 if a signal ended it."""
        return wait(self.start(act, said))

    def command(
        self, *arguments: str, environment: dict[str, str] | None = None, **faults: object
    ) -> subprocess.Popen:
        """The program's own command in a process group of its own, with faults as `inject` knows them."""
        plan = {"target_cost": TARGET_COST, **faults}
        return subprocess.Popen(
            [sys.executable, "-c", COMMAND, *map(str, arguments)],
            env={
                **os.environ,
                "PYTHONPATH": f"{INJECT}{os.pathsep}{ROOT}",
                "STICKSLIP_FAULTS": json.dumps(plan),
                **(environment or {}),
            },
            cwd=self.directory,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    # ------------------------------------------------------------------------------- checks

    def check(self, out: Path) -> None:
        """The dataset is, byte for byte, the undisturbed one; nothing else lies about; the audit finds nothing."""
        found = content(out)
        assert found.keys() == self.reference.keys(), sorted(found.keys() ^ self.reference.keys())
        differing = [name for name in found if found[name] != self.reference[name]]
        assert not differing, differing

        def audit() -> None:
            assert verify(out) == [], verify(out)

        assert self.fork(audit) == 0

    def resume(self, out: Path) -> None:
        """Run the scene to its end, undisturbed, and check it."""
        assert self.fork(lambda: self.run(out)) == 0
        self.check(out)

    def check_no_strays(self, out: Path) -> None:
        """What an orderly end leaves: shards that the manifest knows, no lock, nothing half-written."""
        found = set(content(out))
        known = {f"data/{name}" for name in read_manifest(out).shards} | {MANIFEST, PACKAGE, SCENE}
        assert found <= known, sorted(found - known)


def wait(child: int, timeout: float = PATIENCE) -> int:
    """The exit code of a child; it is killed, and the test fails, if it does not end."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    raise AssertionError(f"still running after {timeout} s")


def end_of(process: subprocess.Popen) -> tuple[int, str, str]:
    """Exit code and words of a command; its whole group is killed, and the test fails, if it does not end."""
    try:
        out, err = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, err = process.communicate(timeout=10)
        raise AssertionError(f"still running after {PATIENCE} s\n{out}\n{err}") from None
    return process.returncode, out, err


def children(pid: int) -> list[int]:
    """The workers of a command, which are forked from a process that it started."""
    parents = {}
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if b"forkserver" in (process / "cmdline").read_bytes():
                parents[int(process.name)] = int((process / "stat").read_text().rpartition(")")[2].split()[1])
    return [child for child, parent in parents.items() if parents.get(parent) == pid]


@contextlib.contextmanager
def small_disk(size: str) -> Iterator[Path]:
    """A file system of its own in memory, of so many bytes.

    Raises
    ------
    Unshown
        If it cannot be mounted, which needs root.
    """
    place = Path(tempfile.mkdtemp(prefix="stickslip-disk-"))
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(place)],
        capture_output=True,
        text=True,
        check=False,
    )
    try:
        if done.returncode:
            raise Unshown(f"needs the right to mount a file system ({done.stderr.strip()})")
        try:
            yield place
        finally:
            subprocess.run(["umount", "-l", str(place)], check=True)
    finally:
        place.rmdir()


def remount(place: Path, how: str) -> None:
    """Change a mounted file system: "ro", "rw"."""
    subprocess.run(["mount", "-o", f"remount,{how}", str(place)], check=True, capture_output=True)
