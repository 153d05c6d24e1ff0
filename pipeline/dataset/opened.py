"""Opening a dataset to read: its scene, its manifest, and the shards that the manifest lists.

A dataset is opened once and handed on as `Opened`, so that all that is read of it is of one moment. Functions that
take a path also take an `Opened`.

Parquet's own checksums cover its pages, not its footer, and cannot tell that a file took another's place. So every
shard is checked against its sha256 in the manifest, and read from the bytes that were checked.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from stickslip.pipeline.dataset.schema import in_units, schema_of
from stickslip.pipeline.dataset.sound import Sound, check_file, check_members, told_of
from stickslip.pipeline.design.design import Coordinates, Design
from stickslip.pipeline.ensemble.numbering import Numbering
from stickslip.pipeline.ensemble.pack import Batch, PlanError, number_of, tasks
from stickslip.pipeline.errors import QueryError, SceneError, StoreError, shortened
from stickslip.pipeline.places.directory import Directory
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.manifest import DamagedManifest, Manifest, read_manifest, read_shards
from stickslip.pipeline.places.place import DATA, MANIFEST, SCENE, Place, Where
from stickslip.pipeline.records import TABLES
from stickslip.pipeline.scene.columns import Recording
from stickslip.pipeline.scene.scene import Scene, parse_scene
from stickslip.sim.numerics.arguments import did_you_mean

if TYPE_CHECKING:
    import pandas as pd


#: Members from which on processes share the runs: going through these is most of a report, and what is known of the
#: members fills the memory.
MANY = 20_000
#: Bytes of data from which more processes answer: each takes a second of its core to load what it needs.
_LARGE = 50_000_000


@dataclass(frozen=True)
class Opened:
    """A dataset at one moment: where it lies, its scene, and its manifest with what the record adds to it."""

    place: Place
    scene: Scene
    manifest: Manifest

    def __getstate__(self) -> dict[str, Any]:
        """What goes to another process: the rest, as its tasks, is found there."""
        return {"place": self.place, "scene": self.scene, "manifest": self.manifest}

    @cached_property
    def tasks(self) -> list[Batch]:
        """The shards that it consists of, done or not.

        Raises `DamagedManifest` if the manifest's packing is not of the scene's members.
        """
        return planned(self.place, self.scene, self.manifest)

    @property
    def design(self) -> Design:
        """What its members were made to differ in; of a dataset that grew, by its last scene."""
        return numbering_of(self.tasks).design

    def coordinates(self, shards: Sequence[str]) -> Coordinates:
        """Where the members of some shards stand in the design, in order."""
        numbering, coordinates = numbering_of(self.tasks), []
        for name in shards:
            batch = self.tasks[number_of(name)]
            assert batch.numbering is not None
            coordinates.append(numbering.of(numbering.here(batch.numbering, batch.members.places)))
        return Coordinates.joined(coordinates)

    @property
    def n_members(self) -> int:
        """How many members it is to have, by its manifest."""
        return sum(map(sum, self.manifest.packing))

    @property
    def n_done(self) -> int:
        """How many of them are done."""
        return sum(shard.rows for shard in self.manifest.shards.values())

    @property
    def is_small(self) -> bool:
        """Whether one process looks through it, with all of it in memory."""
        n_bytes = sum(shard.bytes for shard in self.manifest.shards.values())
        return self.n_done < MANY and n_bytes < _LARGE

    def in_parts(self, n_least: int) -> list[list[str]]:
        """The shards that the manifest lists, neighbours together, of so many members at least but for the last."""
        groups: list[list[str]] = []
        n_rows = n_least
        for name, shard in sorted(self.manifest.shards.items()):
            if n_rows >= n_least:
                groups.append([])
                n_rows = 0
            groups[-1].append(name)
            n_rows += shard.rows
        return groups

    @property
    def folder(self) -> Path:
        """Where files and code of its scene are looked for first; for an object store, the working directory."""
        return self.place.path if isinstance(self.place, Directory) else Path()

    @cached_property
    def recording(self) -> Recording:
        """What it keeps of its members."""
        return self.scene.recording

    @cached_property
    def schema(self) -> pa.Schema:
        """Its columns."""
        return schema_of(self.recording)

    @cached_property
    def sound(self) -> Sound:
        """What its values can be."""
        return Sound(self.scene)

    def stored(self, columns: Sequence[str], shards: Sequence[str] | None = None) -> Iterator[tuple[str, pa.Table]]:
        """Name and some columns of each shard, or of some, as they are kept, in the order of their names.

        A file is read once: what is checked is what is used, whoever exchanges it meanwhile.

        Raises `StoreError` if a shard is not what was written, was changed since the dataset was opened, or is not
        there; or its values are none that the scene gives.
        """
        listed = self.manifest.shards
        names = sorted(listed) if shards is None else shards
        unknown = next((name for name in names if name not in listed), None)
        if unknown is not None:
            raise StoreError(f"{self.file(unknown)}: not in the manifest any more; rerun the scene to rebuild it")
        with reading(self.place):
            for name, content, problem in read_shards(self.place, {name: listed[name] for name in names}):
                if problem and read_manifest(self.place).shards.get(name) != listed[name]:
                    raise StoreError(
                        f"{self.file(name)}: expected the shard that was listed when the dataset was opened, got"
                        " what a run has changed since; rerun the command"
                    )
                if problem:
                    raise StoreError(f"{self.file(name)}: {problem}; rerun the scene to rebuild it")
                yield name, self.read(name, content, columns)

    def file(self, name: str) -> str:
        """A shard as messages show it."""
        return self.place.named(f"{DATA}/{name}")

    def read(self, name: str, content: bytes, columns: Sequence[str]) -> pa.Table:
        """Some columns of a shard; null where data of an earlier version lack them.

        Raises `StoreError` if what it holds is not what this program writes of the scene.
        """
        shard = self.manifest.shards[name]
        known = shard.sha256, shard.rows, self.manifest.scene_hash
        values = *known, *columns
        with told_of(self.file(name)):
            if known not in _sound:
                check_file(content, self.schema, shard.rows)
                _sound.add(known)
            with pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True) as file:
                # a thread of Arrow's may outlive its library, and end the process
                table = file.read([*dict.fromkeys([*columns, "n", "outcome"])], use_threads=False)
            if values not in _sound:
                self.sound.check(table)
                _sound.add(values)
        fields = [self.schema.field(column) for column in columns]
        there = set(table.column_names)
        arrays = [table[field.name] if field.name in there else pa.nulls(len(table), field.type) for field in fields]
        return pa.table(arrays, schema=pa.schema(fields))

    def check(self) -> None:
        """Check all shards; raises as `stored`."""
        for _ in self.stored(()):
            pass

    def rows(
        self, columns: Sequence[str], condition: pc.Expression | None = None, shards: Sequence[str] | None = None
    ) -> Iterator[pa.Table]:
        """Some columns of some rows of each shard, in the units of the scene, in which the condition is too.

        Raises `StoreError` as `stored`; `pyarrow.ArrowException` if the condition is not on the dataset's columns.
        """
        needed = [*dict.fromkeys([*columns, *_fields(condition, self.schema)])]
        for _, stored in self.stored(needed, shards):
            table = in_units(stored, self.recording)
            yield (table if condition is None else table.filter(condition)).select(list(columns))

    def table(
        self, columns: Sequence[str], condition: pc.Expression | None = None, shards: Sequence[str] | None = None
    ) -> pa.Table:
        """As `rows`, in one table."""
        empty = self.schema.empty_table().select(list(columns)).replace_schema_metadata(None)
        return pa.concat_tables([empty, *self.rows(columns, condition, shards)])

    def check_members(self, name: str, table: pa.Table) -> None:
        """See that the rows of a shard, all of them, are of the members that the scene gives it.

        Raises `StoreError` if they are not.
        """
        batch = self.tasks[number_of(name)]
        with told_of(self.file(name)):
            check_members(table, batch.members, batch.coordinates)

    @property
    def lost(self) -> list[str]:
        """The shards whose files are gone or have another size than was written, in the order of their names.

        Raises `StoreError` if that cannot be told.
        """
        shards = dict(sorted(self.manifest.shards.items()))
        try:
            sizes = self.place.sizes([f"{DATA}/{name}" for name in shards])
        except OSError as error:
            why = f"{error.strerror}); {self.place.remedy(error)}"
            raise StoreError(f"{self.place}: shards cannot be read ({why}, then try again") from error
        return [name for name, size in zip(shards, sizes, strict=True) if size != shards[name].bytes]

    def again(self) -> Opened:
        """The dataset as it is now; its scene is read again only if it is another.

        Raises `StoreError` as `open_dataset`.
        """
        manifest = read_manifest(self.place)
        if manifest.scene_hash != self.manifest.scene_hash:
            return open_dataset(self.place)
        again = replace(self, manifest=manifest)
        if manifest.packing == self.manifest.packing:  # else it has grown
            vars(again)["tasks"] = self.tasks
        return again


#: What this process has checked of shards: sha256, number of rows and hash of the scene, of the head; of values, and
#: the columns that were read together.
_sound: set[tuple[object, ...]] = set()


def _fields(condition: pc.Expression | None, schema: pa.Schema) -> list[str]:
    """The columns that a condition is on: without one of them it has no meaning."""
    if condition is None:
        return []
    import pyarrow.dataset as ds  # it loads pandas

    def binds(columns: pa.Schema) -> bool:
        try:
            ds.dataset(columns.empty_table()).scanner(filter=condition)
        except pa.ArrowInvalid:
            return False
        return True

    ds.dataset(schema.empty_table()).scanner(filter=condition)  # says what is wrong with it, if anything is
    return [name for k, name in enumerate(schema.names) if not binds(schema.remove(k))]


def open_dataset(path: Where | Opened) -> Opened:
    """The dataset at `path`; one that is open already is returned as it is.

    Raises `StoreError` if there is none, its scene cannot be read, or it is not the one of the data.
    """
    if isinstance(path, Opened):
        return path
    place = place_of(path)
    manifest = read_manifest(place)
    try:
        scene = stored_scene(place)
    except SceneError as error:
        raise StoreError(f"{error}; rerun the scene with this directory to restore it") from None
    if scene.hash != manifest.scene_hash:
        raise StoreError(
            f"{place.named(SCENE)}: expected the scene of these data (hash {manifest.scene_hash[:12]}), "
            f"got another (hash {scene.hash[:12]}); restore the file"
        )
    opened = Opened(place, scene, manifest)
    opened.tasks  # noqa: B018  refuses a manifest that says something else than its scene
    return opened


def stored_scene(place: Place) -> Scene:
    """The scene that lies at a place.

    Raises `SceneError` if there is none, or it is not a scene.
    """
    file = place.named(SCENE)
    try:
        source = place.read(SCENE)
    except FileNotFoundError:
        raise SceneError(f"{file}: expected a scene file, found nothing there") from None
    except OSError as error:
        raise SceneError(f"{file}: cannot be read ({error.strerror}); {place.remedy(error)}") from error
    return parse_scene(source, file)


def planned(place: Place, scene: Scene, manifest: Manifest) -> list[Batch]:
    """The shards that a dataset of a scene consists of, done or not.

    Raises `DamagedManifest` if the manifest's packing is not of the scene's members.
    """
    try:
        plan = tasks(scene, manifest.earlier, manifest.packing)
    except PlanError as error:
        raise DamagedManifest(
            f"{place.named(MANIFEST)}: expected the packing of the scene's members, got {error}; use the "
            f"version of stickslip that began it, or choose another directory"
        ) from None
    if manifest.design not in (None, numbering_of(plan).design.as_json()):  # data of an earlier version have none
        raise DamagedManifest(
            f"{place.named(MANIFEST)}: expected the design of its scene, got another; use the version of stickslip"
            " that began it"
        )
    return plan


def numbering_of(plan: Sequence[Batch]) -> Numbering:
    """How the members of shards are numbered, by the last scene that they grew to."""
    assert plan[-1].numbering is not None
    return plan[-1].numbering


def dataset_scene(path: Where | Opened) -> Scene:
    """The scene of the dataset at `path`; raises as `open_dataset`."""
    return open_dataset(path).scene


def rows_that_failed(opened: Opened, shards: Sequence[str]) -> list[tuple[str, str]]:
    """Id and reason of each member of some shards that failed, in order."""
    rows = opened.table(["member_id", "reason"], pc.field("outcome") == "failed", shards)
    return list(zip(*(rows[name].to_pylist() for name in ("member_id", "reason")), strict=True))


@contextlib.contextmanager
def reading(place: Place) -> Iterator[None]:
    """Turn the errors of a shard that cannot be fetched into a `StoreError` that says what to do."""
    try:
        yield
    except OSError as error:
        remedy = "" if isinstance(place, Directory) else f"{place.remedy(error)}, or "
        words = shortened(str(error), 400)
        raise StoreError(
            f"{place}: a shard cannot be read ({words}); {remedy}rerun the scene to rebuild it"
        ) from error


@cache
def _nullable() -> dict[pa.DataType, Any]:
    """Types of pandas that tell null from NaN, and keep integers integers."""
    import pandas as pd  # it takes a quarter of a second to load, which no run needs

    return {
        pa.int32(): pd.Int32Dtype(),
        pa.int64(): pd.Int64Dtype(),
        pa.float64(): pd.Float64Dtype(),
        pa.bool_(): pd.BooleanDtype(),
        pa.string(): pd.StringDtype(),
    }


def frame(table: pa.Table, nullable: Sequence[str] | None = None) -> pd.DataFrame:
    """A table as a data frame: columns that hold nulls, or those named, have a nullable type (NA, never NaN)."""
    if nullable is None:
        nullable = [name for name in table.column_names if table[name].null_count]
    plain = [field for field in table.schema if field.name not in nullable and field.type in _nullable()]
    kinds = {field.name: str if pa.types.is_string(field.type) else field.type.to_pandas_dtype() for field in plain}
    return table.to_pandas(types_mapper=_nullable().get).astype(kinds)


def not_recorded(name: str) -> QueryError:
    """The error for a table, a key of `TABLES`, that the scene does not record."""
    return QueryError(f"{name}: expected a dataset with {name}, got one without; set {TABLES[name]}")


def near(word: str, names: Sequence[str]) -> str:
    """What `word` may stand for, as the end of a message."""
    return did_you_mean(word, names) or f"; there are {', '.join(names[:10])}{', ...' * (len(names) > 10)}"
