"""A dataset in an object store: one put is the commit, and the right to write is a lease.

A put replaces an object whole or not at all; there is no renaming. The lock is an object that is created only where
there is none, renewed while its owner lives, and void `LEASE` seconds after the last renewal, so a crash releases it.
Amazon's, Google's and Azure's stores can create so, and S3 servers that answer such a put with the status 412, in
whatever words. Some servers, and old packages, overwrite instead: the owner of the lock tries it (`_Lease.probe`) and
refuses these.

A lease is weaker than a lock of the kernel, and needs clocks that agree within some seconds. A driver that was
stopped for longer than its lease may find another at work; it notices before its next commit, and ends. If two
overlap for a moment, no datum is wrong: a shard has the same bytes whichever of them puts it, and one that is lost is
computed again.
"""

from __future__ import annotations

import contextlib
import errno
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from typing import Any, TypeVar

from stickslip.pipeline.errors import StoreError
from stickslip.pipeline.places.place import AT_ONCE, DATA, LOCK, TEMPORARY, Hold, Lock, Place, part, this_process

#: Seconds after its last renewal after which the lock of an object store is void.
LEASE = 60.0

#: Seconds after which the process that took over a void lock checks that it still owns it: another may have too.
SETTLE = 2.0

#: Bytes, some twenty lines, after which another part begins.
_PART = 10_000

#: Seconds between attempts at a request that fails without being refused; the store's own library has retried before.
PAUSES = (1.0, 3.0, 9.0)

#: Final answers of a store: asking again would change nothing.
_REFUSALS = (FileNotFoundError, FileExistsError, PermissionError, IsADirectoryError)
_REFUSED = {errno.EINVAL, errno.EPERM, errno.ENAMETOOLONG, errno.ENOSYS, getattr(errno, "EREMCHG", errno.ENOENT)}

#: Errors that botocore, which may not be installed, raises before it asks anything.
_UNASKED = {"NoCredentialsError", "PartialCredentialsError", "ParamValidationError"}

_T = TypeVar("_T")


class Prefix(Place):
    """The objects of a store under one prefix; `system` is fsspec's file system."""

    def __init__(self, address: str, system: Any, root: str) -> None:
        self.address, self.system, self.root = address, system, root

    def remedy(self, error: Exception) -> str:
        del error
        return "check the address, the credentials and the network"

    def below(self, name: str) -> Prefix:
        return Prefix(self.named(name), self.system, self.key(name))

    def check_parts(self) -> None:
        """An object is nothing but its bytes."""

    def named(self, name: str) -> str:
        return f"{self.address}/{name}"

    def key(self, name: str) -> str:
        """The path of a file in `system`."""
        return f"{self.root}/{name}"

    def read(self, name: str) -> bytes:
        return self._patiently(name, lambda: self.system.cat_file(self.key(name)))

    def read_each(self, names: Sequence[str]) -> Iterator[bytes | None]:
        with ThreadPoolExecutor(AT_ONCE) as pool:  # most of the time of a request is waiting
            for start in range(0, len(names), AT_ONCE):
                yield from pool.map(self._read_if_there, names[start : start + AT_ONCE])

    def sizes(self, names: Sequence[str]) -> list[int | None]:
        """Of few objects each is asked for; of many all are listed."""
        if len(names) <= AT_ONCE:
            with ThreadPoolExecutor(AT_ONCE) as pool:
                return list(pool.map(self._size, names))
        sizes = {}
        with contextlib.suppress(FileNotFoundError):
            for entry in self._patiently(DATA, lambda: self.system.ls(self.key(DATA), detail=True)):
                sizes[entry["name"].strip("/")] = int(entry["size"] or 0)
        return [sizes.get(self.key(name).strip("/")) for name in names]

    def _size(self, name: str) -> int | None:
        with contextlib.suppress(FileNotFoundError):
            return int(self._patiently(name, lambda: self.system.info(self.key(name)))["size"] or 0)
        return None

    def replace(self, name: str, content: bytes) -> None:
        self._patiently(name, lambda: self.system.pipe_file(self.key(name), content))

    def remove(self, name: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            self._patiently(name, lambda: self.system.rm_file(self.key(name)))

    def names(self) -> list[str]:
        listed_keys = []
        for folder in (self.root, self.key(DATA)):
            with contextlib.suppress(FileNotFoundError):
                listed_keys += self._patiently(DATA, partial(self.system.ls, folder, detail=False))
        keys = {key.strip("/").removeprefix(self.root.strip("/")).strip("/") for key in listed_keys}
        return sorted(keys - {""})

    @contextlib.contextmanager
    def own(self) -> Iterator[Hold]:
        lease = _Lease(self)
        lease.take()
        try:
            lease.probe()
            yield lease
        finally:
            lease.give_back()

    @contextlib.contextmanager
    def record(self, name: str) -> Iterator[Callable[[bytes], None]]:
        """As a directory's; objects cannot grow, so each line rewrites the last part, which is kept small."""
        number, lines = len(self._parts(name)), b""

        def append(line: bytes) -> None:
            nonlocal number, lines
            if len(lines) > _PART:
                number, lines = number + 1, b""
            self.replace(part(name, number), lines + line)
            lines += line

        yield append

    def create(self, name: str, content: bytes) -> None:
        """Put an object where there is none, if the store can tell."""

        def put() -> None:
            try:
                self.system.pipe_file(self.key(name), content, mode="create")
            except OSError as error:
                if _status(error) == HTTPStatus.PRECONDITION_FAILED:  # s3fs asks for Amazon's words too
                    raise FileExistsError(errno.EEXIST, str(error)) from error
                raise

        self._patiently(name, put)

    def _patiently(self, name: str, request: Callable[[], _T]) -> _T:
        for pause in (*PAUSES, None):
            try:
                return request()
            except Exception as error:  # the library of each store has errors of its own
                is_refusal = isinstance(error, _REFUSALS) or getattr(error, "errno", None) in _REFUSED
                is_refusal |= type(error).__name__ in _UNASKED
                if is_refusal or pause is None:
                    raise _refused(error, self.named(name)) from error
                time.sleep(pause)
        raise AssertionError("unreachable")


def _status(error: BaseException | None) -> int | None:
    """The HTTP status of an error of botocore's, or of one that was raised from it."""
    while error is not None:
        response = getattr(error, "response", None)
        if isinstance(response, dict):
            return response.get("ResponseMetadata", {}).get("HTTPStatusCode")
        error = error.__cause__ or error.__context__
    return None


def _refused(error: Exception, file: str) -> OSError:
    """An error of a store's library as the `OSError` that a file system would raise."""
    words = " ".join(str(getattr(error, "strerror", None) or error or type(error).__name__).split())
    if isinstance(error, _REFUSALS):
        number = {FileNotFoundError: errno.ENOENT, FileExistsError: errno.EEXIST}.get(type(error), errno.EACCES)
    else:
        number = getattr(error, "errno", None) or errno.EIO
    return OSError(number, words, file)


@dataclass
class _Lease(Hold):
    """The lock object of a prefix: its owner, when it expires, and the owner's notes."""

    place: Prefix
    token: str = field(default_factory=lambda: uuid.uuid4().hex)
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._until = 0.0
        self._lost: str | None = None
        self._ended = threading.Event()
        self._turn = threading.Lock()

    def take(self) -> None:
        """Create the lock, or take over one that is void, and renew it from now on."""
        self._create()
        threading.Thread(target=self._renewals, daemon=True, name="stickslip-lease").start()

    def _create(self) -> None:
        until = time.time() + LEASE
        lock = self._found()
        is_taken_over = lock is not None
        if lock is not None:
            if lock.remaining:
                raise self._refusal(lock)
            self.place.remove(LOCK)
        try:
            self.place.create(LOCK, self._content(until))
        except OSError as error:  # also if only the answer to our put was lost
            lock = self._found()
            if lock is None and not isinstance(error, FileExistsError):
                raise
            if lock is None or lock.token != self.token:  # none: it was there, and has been given back since
                raise self._refusal(lock) from error
        if is_taken_over:
            time.sleep(SETTLE)
            lock = self._found()
            if lock is None or lock.token != self.token:
                raise self._refusal(lock)
        self._until = until

    def probe(self) -> None:
        """Create an object twice: the second time must fail."""
        name = f"{TEMPORARY}{self.token}"
        try:
            self.place.create(name, b"")  # tried again, it may meet what its first attempt put
            self.place.create(name, b"")
        except FileExistsError:
            return
        finally:
            self.place.remove(name)
        self._renew()
        self.check()  # whoever took over while this process was stopped has removed the object too
        raise StoreError(
            f"{self.place}: expected a store that refuses to create an object where one is, got one that overwrites "
            f"it: it ignores the request's condition (If-None-Match in S3), so that two drivers could write at once; "
            f"update the store or its package (s3fs: 2024.12 or newer), or choose a directory"
        )

    def _refusal(self, lock: Lock | None) -> StoreError:
        owner, remaining = (lock.owner, lock.remaining) if lock is not None else ("another process", LEASE)
        return StoreError(
            f"{self.place}: expected to be its only writer, got a lock held by {owner}; wait for it to end, or "
            f"choose another directory; if it has died, its lease ends in {remaining:.0f} s: run the same scene "
            f"again then"
        )

    def _content(self, until: float) -> bytes:
        lines = [this_process(), f"lease {until:.3f} {self.token}", *self.notes]
        return "".join(f"{line}\n" for line in lines).encode()

    def _found(self) -> Lock | None:
        try:
            return Lock.parse(self.place.read(LOCK))
        except FileNotFoundError:
            return None

    def _renewals(self) -> None:
        while not self._ended.wait(LEASE / 4):
            with contextlib.suppress(OSError):  # the next one may get through; `check` looks at the time
                self._renew()

    def _renew(self) -> None:
        with self._turn:
            if self._ended.is_set() or self._lost is not None:
                return
            lock = self._found()
            if lock is None or lock.token != self.token:
                self._lost = lock.owner if lock is not None else "a process that has ended"
                return
            until = time.time() + LEASE
            self.place.replace(LOCK, self._content(until))
            self._until = until

    def note(self, line: str) -> None:
        self.notes.append(line)
        with contextlib.suppress(OSError):
            self._renew()

    def check(self) -> None:
        if self._lost is None and time.time() > self._until - LEASE / 2:
            self._renew()  # this process was stopped for a while, or the store did not answer
        if self._lost is not None:
            raise StoreError(
                f"{self.place}: expected to be its only writer, lost the lock to {self._lost}, after more than "
                f"{LEASE:.0f} s without a sign of life from here; finished shards are kept: rerun the scene "
                f"when the other has ended"
            )

    def give_back(self) -> None:
        self._ended.set()
        with self._turn, contextlib.suppress(OSError):
            lock = self._found()
            if lock is not None and lock.token == self.token:
                self.place.remove(LOCK)
