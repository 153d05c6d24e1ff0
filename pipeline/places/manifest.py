"""The ledger of a dataset: which shards are done, and whether their files are what was written.

OUT/scene.toml         exact copy of the scene file
OUT/manifest.json      the shards that are done, with sha256, rows and outcomes; how members are packed; which
                       programs wrote. Written when a run begins and when it ends; in between the record completes it
OUT/data/*.parquet     the shards, one a batch
OUT/timings.jsonl      the record, one line a commit: the shard's entry in the manifest; and seconds, which are no
                       part of the data. A lost manifest is rebuilt from it
OUT/datapackage.json   what the dataset and its columns are, for other programs; written when a run ends
OUT/.lock              held by the process that writes; a crash releases it

OUT is a directory or an address of an object store, where the same files are objects (see `pipeline.places.place`).
"""

from __future__ import annotations

import builtins
import contextlib
import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Annotated, Final, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError, model_validator

from stickslip.pipeline.errors import StoreError, shortened
from stickslip.pipeline.places.directory import Directory
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.place import DATA, MANIFEST, PACKAGE, TIMINGS, Place, Where

#: Version of what a dataset holds, and how; kept in every shard and in the manifest.
SCHEMA_VERSION: Final = 3

#: The largest number of bytes or rows, as Arrow and file systems count.
_LARGEST: Final = 2**63 - 1
Count = Annotated[int, Field(ge=1, le=_LARGEST)]
Outcome = Annotated[str, Field(pattern=r"^(finished|collapsed|diverged|failed)$")]


class Shard(BaseModel):
    """A shard that is done, as the manifest knows it."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    rows: Count
    bytes: Count
    first: str
    last: str
    outcomes: dict[Outcome, Count]

    @property
    def n_failed(self) -> int:
        """Members of the shard that failed."""
        return self.outcomes.get("failed", 0)

    def damage(self, content: builtins.bytes | int | None) -> str:
        """What is wrong with the shard's file, as `Place.read_sized` gives it; "" if nothing is."""
        if content is None:
            return "missing"
        if isinstance(content, int):
            return f"expected {self.bytes} bytes, got {content}"
        digest = hashlib.sha256(content).hexdigest()
        return "" if digest == self.sha256 else f"expected sha256 {self.sha256[:12]}, got {digest[:12]}"


def read_shards(place: Place, shards: Mapping[str, Shard]) -> Iterator[tuple[str, builtins.bytes, str]]:
    """Name, content and damage of each shard's file, in order; the content is empty if its size is another."""
    files = place.read_sized({f"{DATA}/{name}": shard.bytes for name, shard in shards.items()})
    for (name, shard), content in zip(shards.items(), files, strict=True):
        yield name, content if isinstance(content, bytes) else b"", shard.damage(content)


#: The names of shards; the pattern keeps a foreign manifest from naming files outside the dataset.
SHARD: Final = r"shard-[0-9]{5,10}-[0-9a-f]{12}\.parquet"
ShardName = Annotated[str, Field(pattern=f"^{SHARD}$")]


class Manifest(BaseModel):
    """The shards that are done, by name, the scene that they belong to, and how its members are packed.

    `earlier` holds the sources of the scenes that this one grew from; `packing`, for each of these and for the scene
    itself, the number of members of each shard that it added (see `ensemble.pack.tasks`). `programs` are the
    versions of the program whose numbers the shards may hold. `recorded_from`, while a run goes on or after it was
    killed, is the byte of the record at which its own commits begin. `design` is what the ensemble was made to differ
    in, as `pipeline.design.design.Design.as_json` says it; data of an earlier version lack it.
    `package` is the sha256 of `datapackage.json`, once a run has written that.
    """

    model_config = ConfigDict(strict=True, extra="forbid")
    schema_version: Literal[3] = SCHEMA_VERSION
    scene_hash: str
    programs: list[str] = []
    earlier: list[str] = []
    packing: list[list[Count]]
    shards: dict[ShardName, Shard] = {}
    recorded_from: Annotated[int, Field(ge=0, le=_LARGEST)] | None = None
    design: dict[str, JsonValue] | None = None
    package: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None

    @model_validator(mode="after")
    def _one_packing_a_scene(self) -> Manifest:
        if len(self.packing) != len(self.earlier) + 1:
            raise ValueError(f"expected the packing of {len(self.earlier) + 1} scenes, got {len(self.packing)}")
        return self

    def fault_of_package(self, place: Place) -> str:
        """How the file `datapackage.json` differs from what was written; "" if it does not, or never was."""
        if self.package is None:
            return ""
        try:
            checksum = hashlib.sha256(place.read(PACKAGE)).hexdigest()
        except FileNotFoundError:
            return "missing"
        except OSError as error:
            return f"cannot be read ({error.strerror})"
        return "" if checksum == self.package else f"expected sha256 {self.package[:12]}, got {checksum[:12]}"

    @property
    def digest(self) -> str:
        """Digest of all data."""
        digest = hashlib.sha256()
        for name, shard in sorted(self.shards.items()):
            digest.update(f"{name} {shard.sha256}".encode())
        return digest.hexdigest()

    def to_bytes(self) -> bytes:
        """JSON that begins with a digest of the rest, a line a shard, sorted: the same shards give the same bytes."""
        head = self.model_dump(exclude={"shards"}, exclude_none=True)
        lines = [f"{json.dumps(key)}: {json.dumps(head[key], separators=(',', ':'))}" for key in sorted(head)]
        shards = [f"{json.dumps(name)}: {_json(self.shards[name].model_dump())}" for name in sorted(self.shards)]
        table = "{\n" + ",\n".join(shards) + "\n}" if shards else "{}"
        body = (",\n".join([*lines, f'"shards": {table}']) + "\n}\n").encode()
        return _checked(body) + body


def _checked(body: bytes) -> bytes:
    return f'{{\n"check": "{hashlib.sha256(body).hexdigest()}",\n'.encode()


def _json(values: dict[str, object]) -> str:
    """JSON with sorted keys: the same values give the same text."""
    return json.dumps(values, sort_keys=True)


#: How the line of a commit begins.
_HEAD: Final = b'{"check": "'


class Commit(BaseModel):
    """A line of the record of the commits: a shard as it was written, by which program, when and where."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)
    shard: ShardName
    entry: Shard
    program: str
    seconds: float
    host: str | None = None  #: of earlier versions, as `pid`
    pid: int | None = None

    @property
    def line(self) -> bytes:
        """JSON with a digest of the rest."""
        values = self.model_dump(exclude_none=True)
        return f"{_json(values | {'check': hashlib.sha256(_json(values).encode()).hexdigest()[:16]})}\n".encode()

    @classmethod
    def parse(cls, line: bytes) -> Commit | None:
        """The commit in a line; None if it is damaged, or of a version that kept only times."""
        # no JSON, no table, too deep; pydantic's is a ValueError too
        with contextlib.suppress(ValueError, AttributeError, RecursionError):
            commit = cls.model_validate({key: value for key, value in json.loads(line).items() if key != "check"})
            return commit if json.loads(commit.line) == json.loads(line) else None
        return None

    @staticmethod
    def can_begin(tail: bytes) -> bool:
        """Whether a last line, which a crash may have cut short, is the beginning of a commit's."""
        return tail[: len(_HEAD)] == _HEAD[: len(tail)]


class Result(NamedTuple):
    """A computed batch: the bytes of its shard, and the line of the record that says so."""

    shard: builtins.bytes
    commit: Commit

    @property
    def name(self) -> str:
        """The name of the shard."""
        return self.commit.shard


def read_commits(path: Where) -> Iterator[Commit]:
    """The commits of a dataset in order; damaged lines are left out, and a lost record has none."""
    with contextlib.suppress(OSError):
        for line in place_of(path).read_record(TIMINGS).split(b"\n"):
            if (commit := Commit.parse(line)) is not None:
                yield commit


_HEALED_BY_RUNNING = f"rerun the scene with this directory: what {TIMINGS} confirms is kept, the rest is recomputed"


class DamagedManifest(StoreError):
    """The manifest is there and cannot be understood."""


def read_manifest(path: Where, is_forgiving: bool = False) -> Manifest:
    """The manifest of the dataset at `path`, with what the record adds to it.

    Raises `StoreError` if there is none or it cannot be read; `DamagedManifest` if it, or the record, cannot be
    understood.

    Parameters
    ----------
    is_forgiving : bool
        Whether to leave out damaged lines of the record, for a caller that recomputes what they confirmed.
    """
    place = place_of(path)
    manifest = _manifest(place)
    if manifest.recorded_from is None:
        return manifest
    try:
        content = place.read_record(TIMINGS)
    except OSError as error:
        raise StoreError(
            f"{place.named(TIMINGS)}: cannot be read ({error.strerror}); {place.remedy(error)}"
        ) from error
    *lines, tail = content[manifest.recorded_from :].split(b"\n")
    commits = [Commit.parse(line) for line in lines]
    if (None in commits or len(content) < manifest.recorded_from) and not is_forgiving:
        raise DamagedManifest(
            f"{place.named(TIMINGS)}: expected the commits of a run that goes on or was killed, got damaged lines; "
            f"{_HEALED_BY_RUNNING}"
        )
    commits.append(Commit.parse(tail))  # most often nothing, or what a crash cut short
    manifest.shards.update({commit.shard: commit.entry for commit in commits if commit is not None})
    return manifest


def _manifest(place: Place) -> Manifest:
    """The manifest as it is stored."""
    file = place.named(MANIFEST)
    place.check_parts()
    try:
        content = place.read(MANIFEST)
    except (FileNotFoundError, NotADirectoryError):
        state, remedy = f"no {MANIFEST}", f"name the directory of a run, or {_HEALED_BY_RUNNING}"
        if isinstance(place, Directory) and not place.path.is_dir():
            state = "a file" if place.path.exists() else "no such directory"
            remedy = "name the directory of a run"
        raise StoreError(f"{place}: expected a dataset, found {state}; {remedy}") from None
    except OSError as error:
        raise StoreError(f"{file}: cannot be read ({error.strerror}); {place.remedy(error)}") from error
    body = content[len(_checked(b"")) :]
    is_whole = content == _checked(body) + body
    _same_version(file, content, is_whole)
    try:
        if is_whole:
            return Manifest.model_validate_json(b"{" + body)
        problem = "its check does not fit"
    except ValidationError as error:
        fault = error.errors()[0]
        problem = shortened(f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}", 200)
    raise DamagedManifest(f"{file}: expected a manifest, got something damaged ({problem}); {_HEALED_BY_RUNNING}")


def _same_version(file: str, content: bytes, is_whole: bool) -> None:
    """Refuse an undamaged manifest of another version of the schema."""
    try:
        document = json.loads(content)
        version, is_checked = document["schema_version"], "check" in document
    except (ValueError, TypeError, LookupError, RecursionError):
        return
    if version != SCHEMA_VERSION and (is_whole or not is_checked):
        raise StoreError(
            f"{file}: expected a dataset of schema version {SCHEMA_VERSION}, got one of version {version}; use "
            f"the version of stickslip that began it, or choose another directory"
        )
