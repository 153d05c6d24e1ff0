"""Writing a dataset: one owner, atomic commits, a manifest that alone decides what is done."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from pipeline.manifest import (
    DATA,
    LOCK,
    MANIFEST,
    SCENE,
    TEMPORARY,
    TIMINGS,
    Manifest,
    Shard,
    StoreError,
    json_line,
    read_manifest,
)
from pipeline.scene import Scene, SceneError, load_scene
from pipeline.shards import Result

log = logging.getLogger(__name__)


class Store:
    """The right to write the dataset at `path`, for the length of a with-block.

    Creates the dataset or resumes it: leftovers of a crash are removed, damaged shards are forgotten (and so
    computed again), and `done` says what need not be computed.

    Raises
    ------
    StoreError
        On entering: the directory belongs to another scene, to something else, or to a running process; or it
        cannot be written. Nothing is changed then.
    """

    def __init__(self, path: Path, scene: Scene, source: bytes) -> None:
        self.path, self.scene, self.source = path, scene, source
        self.data = path / DATA

    @property
    def done(self) -> frozenset[str]:
        """Names of the shards that are committed."""
        return frozenset(self._manifest.shards)

    def __enter__(self) -> Store:
        with _explained(self.path):
            self._check()
            self.data.mkdir(parents=True, exist_ok=True)
            self._lock = _acquire(self.path / LOCK)
        try:
            with _explained(self.path):
                self._manifest = self._check()  # once more: another process may have come first
                self._open()
        except BaseException:
            self._release()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._timings.close()
        self._release()

    def _release(self) -> None:
        # removed while still held: whoever opened it meanwhile sees that the name is gone, and tries again
        with contextlib.suppress(OSError):
            (self.path / LOCK).unlink()
        os.close(self._lock)

    def _check(self) -> Manifest:
        """The manifest found here, or a new one if nothing is here; else a refusal."""
        fresh = Manifest(scene_hash=self.scene.hash)
        if not self.path.exists():
            return fresh
        if not self.path.is_dir():
            raise StoreError(f"{self.path}: expected a directory, got a file; choose another directory")
        if not (self.path / MANIFEST).exists():
            # a crash before the first manifest leaves no more than these
            if all(entry.name in (LOCK, DATA) or _is_temporary(entry) for entry in self.path.iterdir()) and not (
                self.data.exists() and any(self.data.iterdir())
            ):
                return fresh
            raise StoreError(
                f"{self.path}: expected a dataset or an empty directory, got files but no {MANIFEST}; "
                f"choose another directory"
            )
        manifest = read_manifest(self.path)
        if manifest.scene_hash != self.scene.hash:
            raise StoreError(
                f"{self.path}: expected the dataset of this scene (hash {self.scene.hash[:12]}), got that of "
                f"another (hash {manifest.scene_hash[:12]}){self._difference()}; choose another directory, "
                f"or restore the scene"
            )
        return manifest

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
        for leftover in [*self.path.iterdir(), *self.data.iterdir()]:
            if _is_temporary(leftover) or (_is_shard(leftover) and leftover.name not in self._manifest.shards):
                leftover.unlink()
        for name, shard in list(self._manifest.shards.items()):
            problem = shard.damage(self.data / name)
            if problem:
                log.warning("%s: %s; computing it again", self.data / name, problem)
                del self._manifest.shards[name]
        # the manifest first: it makes the directory a dataset
        _replace(self.path / MANIFEST, self._manifest.to_bytes())
        _replace(self.path / SCENE, self.source)
        timings = self.path / TIMINGS
        if timings.exists():
            whole = timings.read_bytes().rpartition(b"\n")
            os.truncate(timings, len(whole[0]) + len(whole[1]))  # a line that a crash cut short goes
        self._timings = open(timings, "a", encoding="utf-8")  # noqa: SIM115  closed by __exit__

    def commit(self, result: Result) -> None:
        """Make a shard part of the dataset: bytes, name, manifest, each in one step, in this order.

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
        )
        with _explained(self.path):
            _replace(self.data / result.name, result.shard)
            self._manifest.shards[result.name] = shard
            _replace(self.path / MANIFEST, self._manifest.to_bytes())
            timing = {"shard": result.name, "seconds": result.seconds, "host": result.host, "pid": result.pid}
            self._timings.write(json_line(timing) + "\n")
            self._timings.flush()


def _flat(values: object, key: str = "") -> dict[str, object]:
    if isinstance(values, dict):
        pairs = [(f"{key}.{name}" if key else name, value) for name, value in values.items()]
    elif isinstance(values, list) and any(isinstance(value, dict) for value in values):
        pairs = [(f"{key}[{i}]", value) for i, value in enumerate(values)]
    else:
        return {key: values}
    return {path: leaf for name, value in pairs for path, leaf in _flat(value, name).items()}


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
            owner = os.read(descriptor, 200).decode(errors="replace").strip()
            os.close(descriptor)
            raise StoreError(
                f"{file.parent}: expected to be its only writer, got a lock held by "
                f"{owner or 'another process'}; wait for it to end, or choose another directory"
            ) from None
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), os.stat(file)):
                os.truncate(descriptor, 0)
                os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
                return descriptor
        os.close(descriptor)  # its last owner removed it between our opening and our locking


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
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
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
