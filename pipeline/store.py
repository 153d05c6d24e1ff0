"""Writing a dataset: one owner, atomic commits, a manifest that alone decides what is done."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import logging
import os
import socket
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from types import TracebackType

from pipeline.interrupt import last_act, unbroken
from pipeline.manifest import (
    DATA,
    LOCK,
    MANIFEST,
    SCENE,
    TEMPORARY,
    TIMINGS,
    DamagedManifest,
    Manifest,
    Shard,
    StoreError,
    checked_line,
    read_commits,
    read_manifest,
)
from pipeline.members import expand
from pipeline.plan import PlanError, grows, pack, tasks
from pipeline.scene import Scene, SceneError, load_scene
from pipeline.shards import Result, program

log = logging.getLogger(__name__)


class Store:
    """The right to write the dataset at `path`, for the length of a with-block.

    Creates the dataset, resumes it, or extends it by what its scene has grown by: leftovers of a crash are removed,
    a lost manifest is made again from the record of the commits, damaged shards are forgotten (and so computed
    again), and `todo` says what is to be computed.

    Parameters
    ----------
    path : Path
    scene : Scene
    source : bytes
        The scene file.
    retry_failed : bool
        Whether shards with failed members are to be computed again; they stay until they are replaced.
    accept_version : bool
        Whether to go on with what another version of the program began, whose numbers may differ.

    Raises
    ------
    StoreError
        On entering: the directory belongs to another scene, to something else, to another version or to a running
        process; or it cannot be written. Nothing is changed then.
    """

    def __init__(
        self, path: Path, scene: Scene, source: bytes, retry_failed: bool = False, accept_version: bool = False
    ) -> None:
        self.path, self.scene, self.source = path, scene, source
        self.data = path / DATA
        self._retry_failed, self._accept_version = retry_failed, accept_version
        self._held = contextlib.ExitStack()
        self._lost = False

    @property
    def done(self) -> frozenset[str]:
        """Names of the shards that are committed."""
        return frozenset(self._manifest.shards)

    @property
    def n_failed(self) -> int:
        """Members that failed, so far."""
        return sum(shard.n_failed for shard in self._manifest.shards.values())

    def __enter__(self) -> Store:
        with _explained(self.path):
            self._check()
            self.data.mkdir(parents=True, exist_ok=True)
        try:
            with _explained(self.path):
                with unbroken():
                    self._held.callback(os.close, _acquire(self.path / LOCK))
                    # removed while held: whoever opened it meanwhile sees that the name is gone, and tries again
                    self._held.callback(_unlink, self.path / LOCK)
                self._manifest = self._check()  # once more: another process may have come first
                self._open()
        except BaseException:
            self._held.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with unbroken():
            self._held.close()

    def _sweep(self) -> None:
        """Leave no trace of a commit that is cut short."""
        for leftover in self._leftovers(read_manifest(self.path)):
            _unlink(leftover)
        _unlink(self.path / LOCK)

    def _leftovers(self, manifest: Manifest) -> list[Path]:
        files = [*self.path.iterdir(), *self.data.iterdir()]
        return [
            file for file in files if _is_temporary(file) or (_is_shard(file) and file.name not in manifest.shards)
        ]

    @cached_property
    def _fresh(self) -> Manifest:
        return Manifest(scene_hash=self.scene.hash, packing=[list(pack(self.scene, set()))])

    def _check(self) -> Manifest:
        """The manifest found here, or a new one if nothing is here; else a refusal."""
        if not self.path.exists():
            return self._fresh
        if not self.path.is_dir():
            raise StoreError(f"{self.path}: expected a directory, got a file; choose another directory")
        if not (self.path / MANIFEST).exists():
            # a crash before the first manifest leaves no more than these
            if all(entry.name in (LOCK, DATA) or _is_temporary(entry) for entry in self.path.iterdir()) and not (
                self.data.exists() and any(self.data.iterdir())
            ):
                return self._fresh
            return self._recorded(
                StoreError(
                    f"{self.path}: expected a dataset or an empty directory, got files but no {MANIFEST}; "
                    f"choose another directory"
                )
            )
        try:
            manifest = read_manifest(self.path)
        except DamagedManifest as error:
            return self._recorded(error)
        return manifest if manifest.scene_hash == self.scene.hash else self._grown(manifest)

    def _recorded(self, refusal: StoreError) -> Manifest:
        """The manifest as the record of the commits has it, if the directory is this scene's; else the refusal."""
        try:
            if load_scene(self.path / SCENE).hash != self.scene.hash:
                raise refusal
        except SceneError:
            raise refusal from None
        self._lost = True
        manifest = self._fresh.model_copy(deep=True)
        names = {batch.name for batch, _ in tasks(self.scene, [], manifest.packing)}
        for commit in read_commits(self.path / TIMINGS):
            if commit.name in names:
                manifest.shards[commit.name] = commit.shard
                if commit.program not in manifest.programs:
                    manifest.programs.append(commit.program)
        return manifest

    def _grown(self, manifest: Manifest) -> Manifest:
        """The manifest of a dataset of a smaller scene, extended; a refusal if the scene differs otherwise."""
        refusal = StoreError(
            f"{self.path}: expected the dataset of this scene (hash {self.scene.hash[:12]}), or of a part of it, got "
            f"that of another (hash {manifest.scene_hash[:12]}){self._difference()}; choose another directory, "
            f"or restore the scene"
        )
        try:
            stored = load_scene(self.path / SCENE)
        except SceneError:
            raise refusal from None
        if stored.hash != manifest.scene_hash or not grows(stored, self.scene):
            raise refusal
        known = {member.member_id for member in expand(stored)}
        return Manifest(
            scene_hash=self.scene.hash,
            programs=manifest.programs,
            earlier=[*manifest.earlier, (self.path / SCENE).read_bytes().decode()],
            packing=[*manifest.packing, list(pack(self.scene, known))],
            shards=manifest.shards,
        )

    def _difference(self) -> str:
        """How the stored scene differs, if it can be read."""
        try:
            stored = _flat(load_scene(self.path / SCENE).data_keys())
        except SceneError:
            return ""
        wanted = _flat(self.scene.data_keys())
        keys = [key for key in sorted(stored | wanted) if stored.get(key) != wanted.get(key)]
        return "".join(f"; {key}: {wanted.get(key)!r} here, {stored.get(key)!r} there" for key in keys[:5])

    def _open(self) -> None:
        manifest = self._manifest
        try:
            self.tasks = tasks(self.scene, manifest.earlier, manifest.packing)
        except PlanError as error:
            raise StoreError(
                f"{self.path / MANIFEST}: expected the packing of the scene's members, got {error}; go on with the "
                f"version of stickslip that began it, or choose another directory"
            ) from error
        foreign = sorted(manifest.shards.keys() - {batch.name for batch, _ in self.tasks})
        if foreign:
            raise StoreError(
                f"{self.path}: expected the shards of this scene, got {foreign[0]}; go on with the version of "
                f"stickslip that began it, or choose another directory"
            )
        for name, shard in list(manifest.shards.items()):
            problem = shard.damage(self.data / name)
            if problem:
                log.warning("%s: %s; computing it again", self.data / name, problem)
                del manifest.shards[name]
        again = {name for name, shard in manifest.shards.items() if self._retry_failed and shard.n_failed}
        self.todo = [task for task in self.tasks if task[0].name not in manifest.shards or task[0].name in again]
        if self.todo and program() not in manifest.programs:
            if manifest.shards and not self._accept_version:
                raise StoreError(
                    f"{self.path}: expected data of this version of the program ({program()}), got data of another "
                    f"({', '.join(manifest.programs) or 'unknown'}), whose numbers may differ; go on with that, "
                    f"choose another directory, or mix them by --accept-version"
                )
            manifest.programs = [*(manifest.programs if manifest.shards else []), program()]
        if self._lost:
            log.warning("%s: lost; made again from %s", self.path / MANIFEST, TIMINGS)
        self._held.enter_context(last_act(self._sweep))
        with unbroken():
            for leftover in self._leftovers(manifest):
                leftover.unlink()
            # the manifest first: it makes the directory a dataset
            _replace(self.path / MANIFEST, manifest.to_bytes())
            _replace(self.path / SCENE, self.source)
            timings = self.path / TIMINGS
            if timings.exists():
                whole = timings.read_bytes().rpartition(b"\n")
                os.truncate(timings, len(whole[0]) + len(whole[1]))  # a line that a crash cut short goes
            self._timings = os.open(timings, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            self._held.callback(os.close, self._timings)

    def note(self, line: str) -> None:
        """Leave a word in the lock, for those who look who is writing."""
        with contextlib.suppress(OSError), open(self.path / LOCK, "a", encoding="utf-8") as lock:
            lock.write(line + "\n")

    def commit(self, result: Result) -> None:
        """Make a shard part of the dataset: bytes, name, record, manifest, each in one step, in this order.

        Raises
        ------
        StoreError
            If it cannot be written; the dataset is then as it was before.
        """
        shard = Shard(
            sha256=hashlib.sha256(result.shard).hexdigest(),
            rows=len(result.member_ids),
            bytes=len(result.shard),
            first=result.member_ids[0],
            last=result.member_ids[-1],
            outcomes=result.outcomes,
        )
        record = {
            "shard": result.name,
            "seconds": result.seconds,
            "host": result.host,
            "pid": result.pid,
            "program": result.program,
            "entry": shard.model_dump(),
        }
        before = self._manifest.shards.get(result.name)
        with unbroken(), _explained(self.path):
            try:
                _replace(self.data / result.name, result.shard)
                _write(self._timings, (checked_line(record) + "\n").encode())
                self._manifest.shards[result.name] = shard
                _replace(self.path / MANIFEST, self._manifest.to_bytes())
            except BaseException:
                if before is None:
                    self._manifest.shards.pop(result.name, None)
                    _unlink(self.data / result.name)
                raise


def _flat(values: object, key: str = "") -> dict[str, object]:
    if isinstance(values, dict):
        pairs = [(f"{key}.{name}" if key else name, value) for name, value in values.items()]
    elif isinstance(values, list) and any(isinstance(value, dict) for value in values):
        pairs = [(f"{key}[{i}]", value) for i, value in enumerate(values)]
    else:
        return {key: values}
    return {path: leaf for name, value in pairs for path, leaf in _flat(value, name).items()}


def _unlink(file: Path) -> None:
    with contextlib.suppress(OSError):
        file.unlink(missing_ok=True)


def _is_temporary(file: Path) -> bool:
    return file.name.startswith(TEMPORARY)


def _is_shard(file: Path) -> bool:
    return file.parent.name == DATA and file.name.startswith("shard-") and file.suffix == ".parquet"


def _acquire(file: Path) -> int:
    """An exclusive lock on a file, as a descriptor that holds it until it is closed."""
    while True:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(descriptor, 200).decode(errors="replace").partition("\n")[0]
            os.close(descriptor)
            raise StoreError(
                f"{file.parent}: expected to be its only writer, got a lock held by "
                f"{owner or 'another process'}; wait for it to end, or choose another directory"
            ) from None
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), os.stat(file)):
                os.truncate(descriptor, 0)
                with contextlib.suppress(OSError):  # a full disk: whoever is refused is not told by whom
                    os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
                return descriptor
        os.close(descriptor)  # its last owner removed it between our opening and our locking


def _write(descriptor: int, line: bytes) -> None:
    """Append a line, whole or not at all."""
    size = os.fstat(descriptor).st_size
    try:
        if os.write(descriptor, line) < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except BaseException:
        with contextlib.suppress(OSError):
            os.ftruncate(descriptor, size)
        raise


def _replace(file: Path, content: bytes) -> None:
    """Give a file new content in one step that a crash cannot divide."""
    temporary = file.with_name(TEMPORARY + file.name)
    try:
        with open(temporary, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, file)
    except BaseException:
        _unlink(temporary)
        raise
    directory = os.open(file.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn the operating system's refusals into words that say what to do."""
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"{error.filename or path}: cannot be written ({error.strerror}); make room or make {path} "
            f"writable, then run the same scene again: the shards that are done are kept"
        ) from error
