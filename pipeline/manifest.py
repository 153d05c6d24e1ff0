"""The manifest of a dataset: the shards that are done, and whether their files still are what was written.

OUT/scene.toml         exact copy of the scene file
OUT/manifest.json      the shards that are done: sha256, rows, bytes, first and last member
OUT/data/*.parquet     the shards, one a batch
OUT/timings.jsonl      seconds, host and process of each batch: apart from the data, which ignore them
OUT/.lock              held by the process that writes; a crash releases it
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.scene import Scene, SceneError, load_scene
from pipeline.shards import SCHEMA_VERSION

SCENE, MANIFEST, TIMINGS, LOCK, DATA = "scene.toml", "manifest.json", "timings.jsonl", ".lock", "data"
#: What the names of files begin with while they are being written.
TEMPORARY = ".tmp-"


class StoreError(RuntimeError):
    """The dataset cannot be written or read. The message says which file, why, and what to do."""


class Shard(BaseModel):
    """A shard that is done, as the manifest knows it."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    rows: Annotated[int, Field(ge=1)]
    bytes: Annotated[int, Field(ge=1)]
    first: str
    last: str

    def damage(self, file: Path) -> str:
        """What is wrong with the bytes of the shard's file: "" if nothing."""
        try:
            content = file.read_bytes()
        except FileNotFoundError:
            return "missing"
        if len(content) != self.bytes:
            return f"expected {self.bytes} bytes, got {len(content)}"
        digest = hashlib.sha256(content).hexdigest()
        return "" if digest == self.sha256 else f"expected sha256 {self.sha256[:12]}, got {digest[:12]}"


# the pattern keeps a foreign manifest from naming files outside the dataset
ShardName = Annotated[str, Field(pattern=r"^shard-\d{5,}-[0-9a-f]{12}\.parquet$")]


class Manifest(BaseModel):
    """The shards that are done, by name, and the scene that they belong to."""

    model_config = ConfigDict(strict=True, extra="forbid")
    schema_version: Literal[2] = SCHEMA_VERSION
    scene_hash: str
    shards: dict[ShardName, Shard] = {}

    def to_bytes(self) -> bytes:
        """JSON, one line a shard, sorted: the same shards give the same bytes."""
        shards = [f"{json.dumps(name)}: {json_line(self.shards[name].model_dump())}" for name in sorted(self.shards)]
        listed = "{\n" + ",\n".join(shards) + "\n}" if shards else "{}"
        head = f'"scene_hash": {json.dumps(self.scene_hash)},\n"schema_version": {self.schema_version}'
        return f'{{\n{head},\n"shards": {listed}\n}}\n'.encode()


def json_line(values: dict[str, object]) -> str:
    """JSON with sorted keys: the same values give the same text."""
    return json.dumps(values, sort_keys=True)


def read_manifest(path: Path) -> Manifest:
    """The manifest of the dataset at `path`.

    Raises
    ------
    StoreError
        If there is none, or it cannot be read.
    """
    file = path / MANIFEST
    try:
        return Manifest.model_validate_json(file.read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        raise StoreError(f"{path}: expected a dataset, found no {MANIFEST}; name the directory of a run") from None
    except OSError as error:
        raise StoreError(f"{file}: cannot be read ({error.strerror}); check its permissions") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise StoreError(
            f"{file}: expected a manifest, got something damaged{where and f' at {where}'} ({first['msg']}); "
            f"restore it from a copy, or delete {path} and run the scene again"
        ) from None


def dataset_scene(path: Path) -> Scene:
    """The scene of the dataset at `path`.

    Raises
    ------
    StoreError
        If there is no dataset, its scene cannot be read, or it is not the one of the data.
    """
    manifest = read_manifest(path)
    try:
        scene = load_scene(path / SCENE)
    except SceneError as error:
        raise StoreError(f"{error}; restore the scene by running it once more with this directory") from None
    if scene.hash != manifest.scene_hash:
        raise StoreError(
            f"{path / SCENE}: expected the scene of these data (hash {manifest.scene_hash[:12]}), "
            f"got another (hash {scene.hash[:12]}); restore the file"
        )
    return scene
