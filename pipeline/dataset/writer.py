"""Writing a dataset: one owner, atomic commits; the manifest and its record alone decide what is done."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from types import TracebackType
from typing import Self

from stickslip.pipeline.dataset.opened import Opened, numbering_of, planned, stored_scene
from stickslip.pipeline.dataset.package import package_of
from stickslip.pipeline.dataset.program import program
from stickslip.pipeline.ensemble.pack import Batch, grows, lacked, pack, tasks
from stickslip.pipeline.errors import SceneError, StoreError, command, remedy
from stickslip.pipeline.machine.signals import last_act, unbroken
from stickslip.pipeline.places.directory import Directory
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.manifest import (
    SHARD,
    Commit,
    DamagedManifest,
    Manifest,
    Result,
    Shard,
    read_commits,
    read_manifest,
    read_shards,
)
from stickslip.pipeline.places.place import (
    DATA,
    LOCK,
    MANIFEST,
    PACKAGE,
    SCENE,
    TEMPORARY,
    TIMINGS,
    Lock,
    Place,
    Where,
)
from stickslip.pipeline.places.plain import unfinished
from stickslip.pipeline.records import End
from stickslip.pipeline.scene.scene import Scene
from stickslip.pipeline.scene.source import parse_toml

log = logging.getLogger(__name__)

#: Seconds that a program which ends at once spends on cleaning up in a store, which may not answer.
_LAST_SECONDS = 1.5

#: Names that this program makes: of shards; of what it is writing, on any machine, or tries in a store.
_OURS = re.compile(f"{DATA}/{SHARD}")
_WRITTEN = "|".join([SHARD, *map(re.escape, (MANIFEST, SCENE, PACKAGE))])
_BEGUN = re.compile(f"({DATA}/)?{unfinished(f'({_WRITTEN})', '[^/]+')}|{re.escape(TEMPORARY)}[0-9a-f]{{32}}")

#: Keys that a refusal names at most, of those by which a scene differs from that of the data.
_SHOWN = 5


class Store:
    """The right to write the dataset at `path`, for the length of a with-block.

    Creates the dataset, resumes it, or extends it by what its scene has grown by: leftovers of a crash are removed, a
    lost manifest is rebuilt from the record of the commits, damaged shards are forgotten (and so computed again), and
    `todo` says what is to be computed. Raises `ValueError` if the scene's source is that of other data; `StoreError`
    on entering: the directory belongs to another scene, to something else, to another version or to a running
    process; or it cannot be written. Nothing is changed then.

    Parameters
    ----------
    path : str, Path or Place
        A directory or an address; see `stickslip.pipeline.places.place`.
    scene : Scene
        Its `source` is kept beside the data.
    retry_failed : bool
        Whether shards with failed members are to be computed again; they stay until they are replaced.
    accept_version : bool
        Whether to resume data that another version of the program began, or take rows over; numbers may differ.
    programs : sequence of str
        Those that wrote data of which rows are taken over.
    """

    def __init__(
        self,
        path: Where,
        scene: Scene,
        retry_failed: bool = False,
        accept_version: bool = False,
        programs: Sequence[str] = (),
    ) -> None:
        self.place, self.scene = place_of(path), scene.from_source
        self._retry_failed, self._accept_version, self._programs = retry_failed, accept_version, programs
        self._held = contextlib.ExitStack()
        self._lost = self._was_cut = False
        self._record: Callable[[bytes], None] | None = None

    @property
    def done(self) -> dict[str, Shard]:
        """The shards that are committed."""
        return dict(self._manifest.shards)

    @property
    def opened(self) -> Opened:
        """The dataset as it stands."""
        opened = Opened(self.place, self.scene, self._manifest.model_copy(update={"shards": self.done}))
        vars(opened)["tasks"] = self.tasks
        return opened

    def __enter__(self) -> Self:
        with _explained(self.place):
            self._check()
        try:
            with _explained(self.place):
                with unbroken():
                    self._hold = self._held.enter_context(self.place.own())
                self._manifest = self._check()  # once more: another process may have come first
                self._open()
        except BaseException:
            self._held.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with unbroken(), self._held:
            if error is None:  # else the manifest and its record stand as they are
                with _explained(self.place):
                    self._finish()

    def _finish(self) -> None:
        """Write what the dataset says of itself, and then the manifest, after the last commit."""
        manifest, is_new = self._manifest, self._record is not None or self._lost or self._was_cut
        package = package_of(self.scene, manifest)
        digest = hashlib.sha256(package).hexdigest()
        is_as_written = manifest.package in (None, digest) and not manifest.fault_of_package(self.place)
        if is_as_written and not is_new:  # data of an earlier version have none
            return
        manifest.recorded_from, manifest.package = None, digest
        self._hold.check()
        self.place.replace(PACKAGE, package)
        self.place.replace(MANIFEST, self._manifest.to_bytes())

    def _sweep(self) -> None:
        """Remove what a commit that is cut short has written; what takes too long is left to the next run."""

        def sweep() -> None:
            with contextlib.suppress(OSError, StoreError):
                for leftover in self._leftovers(read_manifest(self.place)):
                    self._remove(leftover)
            self._hold.give_back()

        if isinstance(self.place, Directory):
            sweep()
            return
        aside = threading.Thread(target=sweep, daemon=True)
        aside.start()
        aside.join(_LAST_SECONDS)

    def _leftovers(self, manifest: Manifest) -> list[str]:
        """What a crash may have left: files that were being written, and shards that were not committed."""
        names = {f"{DATA}/{name}" for name in manifest.shards}
        unlisted = [name for name in self.place.names() if _OURS.fullmatch(name) or _BEGUN.fullmatch(name)]
        return [name for name in unlisted if name not in names]

    def _remove(self, name: str) -> None:
        with contextlib.suppress(OSError):
            self.place.remove(name)

    @cached_property
    def _fresh(self) -> Manifest:
        return Manifest(scene_hash=self.scene.hash, packing=[list(pack(self.scene, None))])

    def _check(self) -> Manifest:
        """The manifest found here, or a new one if nothing is here; else a refusal."""
        self.place.check_parts()
        names = self.place.names()
        self._check_owner(names)
        if MANIFEST not in names:
            # a crash before the first manifest leaves no more than these
            strangers = [name for name in names if name not in (LOCK, DATA, TIMINGS) and not _BEGUN.fullmatch(name)]
            if not strangers:
                return self._fresh
            return self._recorded(
                StoreError(
                    f"{self.place}: expected a dataset or an empty directory, got files ({strangers[0]}) but no "
                    f"{MANIFEST}; choose another directory"
                )
            )
        try:
            manifest = read_manifest(self.place, is_forgiving=True)
        except DamagedManifest as error:
            return self._recorded(error)
        return manifest if manifest.scene_hash == self.scene.hash else self._grown(manifest)

    def _check_owner(self, names: Sequence[str]) -> None:
        """Refuse a lock that this program never writes and, where nothing else is of a dataset, such a record."""
        (lock,) = self.place.read_each([LOCK]) if LOCK in names else (None,)
        foreign = [] if lock is None or Lock.is_one(lock) else [(LOCK, "lock")]
        if TIMINGS in names and MANIFEST not in names and not any(map(_OURS.fullmatch, names)):
            *lines, tail = self.place.read_record(TIMINGS).split(b"\n")
            if None in map(Commit.parse, lines) or not Commit.can_begin(tail):
                foreign.append((TIMINGS, "record of commits"))
        for name, what in foreign:
            raise StoreError(
                f"{self.place.named(name)}: expected a {what} of this program, got something else; remove it, or"
                " choose another directory"
            )

    def _recorded(self, refusal: StoreError) -> Manifest:
        """The manifest as the record of the commits has it, if the directory is this scene's; else the refusal."""
        try:
            if stored_scene(self.place).hash != self.scene.hash:
                raise refusal
        except SceneError:
            raise refusal from None
        self._lost = True
        manifest = self._fresh.model_copy(deep=True)
        names = {batch.name for batch in tasks(self.scene, [], manifest.packing)}
        for commit in read_commits(self.place):
            if commit.shard in names:
                manifest.shards[commit.shard] = commit.entry
                if commit.program not in manifest.programs:
                    manifest.programs.append(commit.program)
        return manifest

    def _grown(self, manifest: Manifest) -> Manifest:
        """The manifest of a dataset of a smaller scene, extended; a refusal if the scene differs otherwise."""
        stored: Scene | None = None
        with contextlib.suppress(SceneError):
            stored = stored_scene(self.place)
        if stored is None or stored.hash != manifest.scene_hash or not grows(stored, self.scene):
            columns = [] if stored is None else lacked(stored, self.scene)
            if columns:
                command_line = command("extend", str(self.place), "--scene", "SCENE", "--out", "DIR")
                remedy = f"run it into another directory: `{command_line}` takes over what is here"
                if self._programs:  # it is `extend` that asks
                    remedy = "choose another directory than that of other data"
                raise StoreError(
                    f"{self.place}: expected runs with the columns of the data on disk, got a scene that adds some "
                    f"with {', '.join(columns)}, which these data lack; {remedy}"
                )
            raise StoreError(
                f"{self.place}: expected the dataset of this scene (hash {self.scene.hash[:12]}), or of a part of "
                f"it, got that of another (hash {manifest.scene_hash[:12]}){self._difference(stored)}; choose "
                f"another directory, or restore what differs{self._on_from_ends(stored)}"
            )
        return Manifest(
            scene_hash=self.scene.hash,
            programs=manifest.programs,
            earlier=[*manifest.earlier, stored.source],
            packing=[*manifest.packing, list(pack(self.scene, stored))],
            shards=manifest.shards,
        )

    def _on_from_ends(self, stored: Scene | None) -> str:
        """What to do for longer runs, if that is what the scene asks for."""
        if stored is None or self.scene.run.t_end <= stored.run.t_end:
            return ""
        condition = "" if stored.keeps(End) else " of a dataset that keeps them (`end = true` under [record])"
        return (
            "; a run that goes on is not, to the last bit, one in one piece, so these are not lengthened: another"
            f" scene can start at their ends, with `dataset` under [start]{condition}"
        )

    def _difference(self, stored_scene: Scene | None) -> str:
        """How the stored scene differs, if it can be read."""
        if stored_scene is None:
            return ""
        stored, keys_here = (_flat(scene.data_keys()) for scene in (stored_scene, self.scene))
        explicit = {key for scene in (self.scene, stored_scene) for key in _flat(parse_toml(scene.source, ""))}
        differing = [key for key in stored | keys_here if stored.get(key) != keys_here.get(key)]
        # keys that were written first, then those that follow from them
        keys = sorted(differing, key=lambda key: (key not in explicit, key))
        lines = [
            f"; {key}: {_told(keys_here.get(key))} here, {_told(stored.get(key))} there" for key in keys[:_SHOWN]
        ]
        return "".join(lines) + (f"; and {len(keys) - _SHOWN} keys more" if len(keys) > _SHOWN else "")

    def look(self) -> tuple[list[Batch], list[Batch]]:
        """All shards, and those that a run would compute; the dataset is neither taken nor changed.

        Raises `StoreError` as on entering, if a run would be refused.
        """
        with _explained(self.place):
            self._manifest = self._check()
            self._plan(self._manifest)
        return self.tasks, self.todo

    def _plan(self, manifest: Manifest) -> None:
        """What the shards are, and which of them are to be computed."""
        self.tasks = planned(self.place, self.scene, manifest)
        foreign = sorted(manifest.shards.keys() - {batch.name for batch in self.tasks})
        if foreign:
            raise StoreError(
                f"{self.place}: expected the shards of this scene, got {foreign[0]}; use the version of "
                f"stickslip that began it, or choose another directory"
            )
        manifest.design = numbering_of(self.tasks).design.as_json()
        self._forget_damaged(manifest.shards)
        failed = {name for name, shard in manifest.shards.items() if self._retry_failed and shard.n_failed}
        self.todo = [batch for batch in self.tasks if batch.name not in manifest.shards or batch.name in failed]
        if self.todo:
            manifest.programs = self._with_this_program(manifest)

    def _forget_damaged(self, shards: dict[str, Shard]) -> None:
        """Leave out shards whose files are not what was written."""
        for name, _, problem in read_shards(self.place, dict(shards)):
            if problem:
                log.warning("%s: %s; recomputing it", self.place.named(f"{DATA}/{name}"), problem)
                del shards[name]

    def _with_this_program(self, manifest: Manifest) -> list[str]:
        """The programs whose numbers a dataset may hold, once this one adds to it; or a refusal."""
        programs = [*dict.fromkeys([*(manifest.programs if manifest.shards else []), *self._programs])]
        if program() in programs:
            return programs
        if (manifest.shards or self._programs) and not self._accept_version:
            raise StoreError(
                f"{self.place}: expected data of this version of the program ({program()}), got data of another "
                f"({', '.join(programs) or 'unknown'}), whose numbers may differ; use that version, "
                f"choose another directory, or mix them with --accept-version"
            )
        return [*programs, program()]

    def _open(self) -> None:
        manifest = self._manifest
        self._plan(manifest)
        if self._lost:
            log.warning("%s: lost; rebuilt from %s", self.place.named(MANIFEST), TIMINGS)
        self._held.enter_context(last_act(self._sweep))
        with unbroken():
            for leftover in self._leftovers(manifest):
                self.place.remove(leftover)
            self._was_cut = manifest.recorded_from is not None  # by a kill, perhaps after the last commit
            manifest.recorded_from = None
            if self.todo:
                manifest.package = None  # until the run has ended
                self._record = self._held.enter_context(self.place.record(TIMINGS))
                manifest.recorded_from = len(self.place.read_record(TIMINGS))
            # the manifest first: it makes the directory a dataset
            self.place.replace(MANIFEST, manifest.to_bytes())
            self.place.replace(SCENE, self.scene.source.encode())

    def note(self, line: str) -> None:
        """Add a line to the lock, for processes that ask who is writing."""
        self._hold.note(line)

    def commit(self, *results: Result) -> list[Shard]:
        """Make shards part of the dataset: their bytes, each in one step, then their lines of the record in another.

        Raises `StoreError` if one cannot be written, or the right to write was lost; the dataset is then as it was
        before.
        """
        shards = {result.name: result.commit.entry for result in results}
        assert self._record is not None  # there is something to do
        with unbroken(), _explained(self.place):
            self._hold.check()
            try:
                self.place.replace_each({f"{DATA}/{result.name}": result.shard for result in results})
                self._record(b"".join(result.commit.line for result in results))
                self._manifest.shards.update(shards)
            except BaseException:
                for name in shards.keys() - self._manifest.shards.keys():
                    self._remove(f"{DATA}/{name}")
                raise
        return list(shards.values())


def _told(value: object) -> str:
    """A value of a scene as an error shows it: of a sha256 the beginning."""
    if isinstance(value, str) and re.fullmatch("[0-9a-f]{64}(, version [0-9]+)?", value):
        return f"sha256 {value[:12]}{value[64:]}"
    return repr(value)


def _flat(values: object, key: str = "") -> dict[str, object]:
    if isinstance(values, dict):
        pairs = [(f"{key}.{name}" if key else name, value) for name, value in values.items()]
    elif isinstance(values, list) and any(isinstance(value, dict) for value in values):
        pairs = [(f"{key}[{i}]", value) for i, value in enumerate(values)]
    else:
        return {key: values}
    return {path: leaf for name, value in pairs for path, leaf in _flat(value, name).items()}


@contextlib.contextmanager
def _explained(path: Place) -> Iterator[None]:
    """Turn errors of the operating system, or of a store, into a `StoreError` that says what to do."""
    try:
        yield
    except OSError as error:
        what_to_do = f"{remedy(error)}, then rerun the scene: finished shards are kept"
        if isinstance(error, FileNotFoundError):  # it was there when the run began
            what_to_do = f"{path} was moved or removed: bring it back, and rerun the scene to resume"
        raise StoreError(f"{error.filename or path}: cannot be written ({error.strerror}); {what_to_do}") from error
