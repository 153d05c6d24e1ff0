"""Opening a dataset to read: its scene, its manifest, and the shards that the manifest lists.

A dataset is opened once and handed on as `Opened`, so that all that is read of it is of one moment. Functions that
take a path also take an `Opened`.

Parquet's own checksums cover its pages, not its footer, and cannot tell that a file took another's place. So every
shard is checked against its sha256 in the manifest before it is read.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from stickslip.pipeline.dataset.schema import schema_of
from stickslip.pipeline.dataset.sound import Sound, fault_of_design, fault_of_file, fault_of_members
from stickslip.pipeline.design.design import Coordinates, Design
from stickslip.pipeline.ensemble.numbering import Numbering
from stickslip.pipeline.ensemble.pack import PlanError, Task, number_of, tasks
from stickslip.pipeline.errors import QueryError, SceneError, StoreError, command, printable, shortened
from stickslip.pipeline.places.directory import Directory
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.manifest import DamagedManifest, Manifest, read_manifest, read_shards
from stickslip.pipeline.places.place import DATA, MANIFEST, SCENE, Place, Where
from stickslip.pipeline.records import TABLES
from stickslip.pipeline.scene.scene import Scene, parse_scene
from stickslip.sim.numerics.arguments import did_you_mean

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow.dataset as ds


@dataclass(frozen=True)
class Opened:
    """A dataset at one moment: where it lies, its scene, and its manifest with what the record adds to it."""

    place: Place
    scene: Scene
    manifest: Manifest

    def __getstate__(self) -> dict[str, Any]:
        """What goes to another process: its tasks, that a worker gets without their numbering, are planned there."""
        return {name: value for name, value in self.__dict__.items() if name != "tasks"}

    @cached_property
    def tasks(self) -> list[Task]:
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
            batch, _ = self.tasks[number_of(name)]
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

    def shards(self, names: Sequence[str] | None = None) -> ds.Dataset:
        """The shards that the manifest lists, or some of them, as one Arrow dataset, in the order of their names.

        Raises `StoreError` if a shard is not what was written, or the manifest's packing or design is not that of its
        scene.
        """
        import pyarrow.dataset as ds  # it loads pandas

        names = sorted(self.manifest.shards) if names is None else list(names)
        self.check(names)
        checked = ds.ParquetFragmentScanOptions(page_checksum_verification=True)
        with reading(self.place):
            return ds.dataset(
                [self.place.key(f"{DATA}/{name}") for name in names],
                schema=schema_of(self.scene.recording),
                filesystem=self.place.arrow,
                format=ds.ParquetFileFormat(default_fragment_scan_options=checked),
            )

    @property
    def lost(self) -> list[str]:
        """The shards whose files are gone or have another size than was written, in the order of their names."""
        shards = dict(sorted(self.manifest.shards.items()))
        marks = self.place.marks([f"{DATA}/{name}" for name in shards])
        return [name for name, mark in zip(shards, marks, strict=True) if not mark or mark.size != shards[name].bytes]

    def check(self, names: Sequence[str] | None = None) -> None:
        """Check some shards, or all, against the manifest; a checked one is read again only if its file has changed.

        Raises `StoreError` if one is not what was written, was changed since the dataset was opened, or is not there.
        """
        place, shards = self.place, self.manifest.shards
        files = {name: f"{DATA}/{name}" for name in (shards if names is None else names)}
        marks = dict(zip(files, place.marks(list(files.values())), strict=True))
        unknown = next((name for name in files if name not in shards), None)
        if unknown is not None:
            raise StoreError(
                f"{place.named(files[unknown])}: not in the manifest any more; rerun the scene to rebuild it"
            )

        def is_checked(name: str) -> bool:
            return marks[name] is not None and _checked.get(place.named(files[name])) == (
                shards[name].sha256,
                marks[name],
            )

        new = {name: shards[name] for name in files if not is_checked(name)}
        with reading(place):
            for name, content, mark, problem in read_shards(place, new):
                if problem and read_manifest(place).shards.get(name) != shards[name]:
                    raise StoreError(
                        f"{place.named(files[name])}: expected the shard that was listed when the dataset was "
                        f"opened, got what a run has changed since; rerun the command"
                    )
                if problem:
                    raise StoreError(f"{place.named(files[name])}: {problem}; rerun the scene to rebuild it")
                problem = fault_of_file(content, schema_of(self.scene.recording), shards[name].rows)
                if problem:
                    raise StoreError(f"{place.named(files[name])}: {problem}; {NOT_OURS}")
                _checked[place.named(files[name])] = (shards[name].sha256, mark)

    @cached_property
    def sound(self) -> Sound:
        """What its values can be."""
        return Sound(self.scene)

    def checked(self, table: pa.Table) -> pa.Table:
        """Columns of some rows, once they are found to be what the scene can give.

        Raises `StoreError` if they are not.
        """
        problem = self.sound.fault(table)
        if problem:
            which = command("verify", str(self.place))
            raise StoreError(f"{self.place}: {printable(problem)}; `{which}` names the shard: {NOT_OURS}")
        return table

    def check_members(self, table: pa.Table, shards: Sequence[str]) -> None:
        """See that rows of some shards, all of them, are of the members that the scene gives these.

        Raises `StoreError` if they are not.
        """
        row = 0
        for name in shards:
            batch, _ = self.tasks[number_of(name)]
            n_rows = len(batch.members)
            problem = fault_of_members(table.slice(row, n_rows), batch.members, batch.coordinates)
            row += n_rows
            if problem:
                raise StoreError(f"{self.place.named(f'{DATA}/{name}')}: {printable(problem)}; {NOT_OURS}")

    def again(self) -> Opened:
        """The dataset as it is now; its scene is read again only if it is another.

        Raises `StoreError` as `open_dataset`.
        """
        manifest = read_manifest(self.place)
        same = manifest.scene_hash == self.manifest.scene_hash
        return replace(self, manifest=manifest) if same else open_dataset(self.place)


#: What to do about a shard that its manifest knows and that cannot be.
NOT_OURS = "this program did not write it so: remove it, and rerun the scene to rebuild it"

#: Files whose content this process has checked: the sha256 that it has, and how the file was marked then.
_checked: dict[str, tuple[str, object]] = {}


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


def planned(place: Place, scene: Scene, manifest: Manifest) -> list[Task]:
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
    if problem := fault_of_design(manifest.design, numbering_of(plan).design):
        raise DamagedManifest(f"{place.named(MANIFEST)}: {problem}; use the version of stickslip that began it")
    return plan


def numbering_of(plan: Sequence[Task]) -> Numbering:
    """How the members of shards are numbered, by the last scene that they grew to."""
    assert plan[-1][0].numbering is not None
    return plan[-1][0].numbering


def dataset_scene(path: Where | Opened) -> Scene:
    """The scene of the dataset at `path`; raises as `open_dataset`."""
    return open_dataset(path).scene


def dataset(path: Where | Opened, shards: Sequence[str] | None = None) -> ds.Dataset:
    """The shards that the manifest lists, or some of them, as one Arrow dataset, in the order of their names.

    Raises `StoreError` if there is no readable dataset at `path`, or a shard is not what was written.
    """
    return open_dataset(path).shards(shards)


def rows_that_failed(opened: Opened, shards: Sequence[str]) -> list[tuple[str, str]]:
    """Id and reason of each member of some shards that failed, in order."""
    source = opened.shards(shards)
    with reading(opened.place):
        import pyarrow.compute as pc  # takes a while to load; a run without failures does not need it

        rows = source.to_table(["member_id", "reason"], filter=pc.field("outcome") == "failed")
    return list(zip(*(rows[name].to_pylist() for name in ("member_id", "reason")), strict=True))


@contextlib.contextmanager
def reading(place: Place) -> Iterator[None]:
    """Turn the errors of a damaged or missing shard into a `StoreError` that says what to do."""
    try:
        yield
    except (OSError, pa.ArrowInvalid) as error:  # a missing file, a page with a wrong checksum, a truncated file
        if isinstance(error, pa.ArrowInvalid) and "Parquet" not in str(error):
            raise
        raise unreadable(place, error) from error


def unreadable(place: Place, error: Exception) -> StoreError:
    """The error for a dataset with a shard that cannot be read."""
    remedy = "" if isinstance(place, Directory) else f"{place.remedy(error)}, or "
    words = shortened(str(error).partition(" Detail: Python exception")[0], 400)  # of Arrow: a traceback follows
    return StoreError(f"{place}: a shard cannot be read ({words}); {remedy}rerun the scene to rebuild it")


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
