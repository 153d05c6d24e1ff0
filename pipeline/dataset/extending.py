"""Extending a finished dataset by records: the same members, a row each, with more columns.

The new shards are written beside the others, and the manifest lists them apart, as an `Extension`: until the last is
there, the dataset is what it was, for readers and after a crash. Then one replacement of the manifest makes the new
shards the dataset. Its scene's file follows, and the old shards are removed; if a crash comes between, whoever writes
next does the rest. What there is in the end has the bytes of a run that had these records from the start.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, lru_cache

import pyarrow as pa

from stickslip.pipeline.dataset.opened import Opened, numbering_of, open_dataset, reading
from stickslip.pipeline.dataset.writer import Store, begun
from stickslip.pipeline.ensemble.pack import Batch, pack, tasks
from stickslip.pipeline.errors import StoreError
from stickslip.pipeline.places.manifest import Extension, Manifest, Shard, read_manifest
from stickslip.pipeline.places.place import MANIFEST, SCENE
from stickslip.pipeline.scene.scene import Scene

#: Old shards that are in memory at once: members of a new one are in a few of them.
_SHARDS_KEPT = 8


class Extending(Store):
    """The right to add records to the dataset that was opened, for the length of a with-block.

    Parameters
    ----------
    before : Opened
    scene : Scene
        That of the dataset, with more records.
    accept_version : bool
        Whether to extend data of another version of the program; numbers may differ.

    Raises
    ------
    StoreError
        As `Store`; or if the dataset is not finished, a shard is damaged, it has changed since it was opened, or an
        extension by other records was begun.
    """

    def __init__(self, before: Opened, scene: Scene, accept_version: bool = False) -> None:
        super().__init__(before.place, scene, accept_version=accept_version)
        self.before = before
        self._read = lru_cache(_SHARDS_KEPT)(self._read_shard)

    @property
    def _extension(self) -> Extension:
        assert self._manifest.extension is not None
        return self._manifest.extension

    @property
    def _shards(self) -> dict[str, Shard]:
        return self._manifest.shards if self._manifest.extension is None else self._extension.shards

    def _check(self) -> Manifest:
        manifest = read_manifest(self.place, is_forgiving=True)
        if (manifest.scene_hash, manifest.shards) != (self.before.manifest.scene_hash, self.before.manifest.shards):
            raise StoreError(
                f"{self.place}: expected the dataset as it was when it was opened, got one that was changed since;"
                " rerun the command"
            )
        return manifest

    def _plan(self, manifest: Manifest) -> None:
        missing = [batch for batch, _ in self.before.tasks if batch.name not in manifest.shards]
        if missing:
            raise StoreError(
                f"{self.place}: expected a finished dataset, got {len(manifest.shards)} of"
                f" {len(self.before.tasks)} shards; rerun its scene first"
            )
        self.before.check()
        found, source = manifest.extension, self.scene.source
        if found is not None and found.scene != source:
            raise begun(self.place, manifest)
        if found is None:
            found = Extension(scene=source, packing=list(pack(self.scene, None)), programs=[])
        manifest.extension = found
        self.tasks = tasks(self.scene, [], [found.packing])
        self._forget_damaged(found.shards)
        self.todo = [task for task in self.tasks if task[0].name not in found.shards]
        found.programs = self._with_this_program(manifest) if self.todo else found.programs

    def _end_extension(self, manifest: Manifest) -> None:
        """Not this one: whatever another left was done before."""

    def _keep_scene(self) -> None:
        """The scene stays until the dataset is another."""

    def _finish(self) -> None:
        """Make the new shards the dataset: the first step decides, and the others can be done again."""
        extension = self._extension
        if len(extension.shards) < len(self.tasks):
            super()._finish()
            return
        self._hold.check()
        self._manifest = Manifest(
            scene_hash=self.scene.hash,
            programs=extension.programs,
            packing=[extension.packing],
            shards=extension.shards,
            scene=extension.scene,
            design=numbering_of(self.tasks).design.as_json(),
        )
        self.place.replace(MANIFEST, self._manifest.to_bytes())
        self.place.replace(SCENE, self.scene.source.encode())
        self._remove_leftovers(self._manifest)
        self._manifest.scene = None
        self.place.replace(MANIFEST, self._manifest.to_bytes())

    # ------------------------------------------------------------------------------------------ rows that are there

    def rows(self, batch: Batch) -> pa.Table:
        """The rows of a new shard's members, in their order, as they were kept.

        Raises
        ------
        StoreError
            If a shard cannot be read.
        """
        names = list(batch.members.ids())
        shards = sorted({self._shard_of[name] for name in names})
        table = pa.concat_tables([self._read(shard) for shard in shards])
        at = {name: k for k, name in enumerate(table["member_id"].to_pylist())}
        return table.take([at[name] for name in names]).combine_chunks()

    @cached_property
    def _shard_of(self) -> Mapping[str, str]:
        return {name: batch.name for batch, _ in self.before.tasks for name in batch.members.ids()}

    def _read_shard(self, name: str) -> pa.Table:
        source = self.before.shards([name])
        with reading(self.place):
            return source.to_table(use_threads=False)  # a thread of Arrow's may outlive its library


class _GivingUp(Store):
    """The right to forget an extension that was begun: nothing is computed, and the data stay as they are."""

    def _plan(self, manifest: Manifest) -> None:
        manifest.extension = None
        self.tasks, self.todo = [], []


def give_up(path: Opened) -> None:
    """Remove what is done of an extension that was begun; the dataset stays what it is.

    Raises
    ------
    StoreError
        If none was begun, or it cannot be written.
    """
    if path.manifest.extension is None:
        raise StoreError(f"{path.place}: expected an extension that was begun, got none; there is nothing to give up")
    with _GivingUp(path.place, path.scene):
        pass


def ended(path: Opened) -> Opened:
    """A dataset, after the rest of an extension that a crash left is done.

    Raises
    ------
    StoreError
        If it cannot be written.
    """
    if path.manifest.scene is None:
        return path
    with Store(path.place, path.scene):
        pass
    return open_dataset(path.place)
