"""Whether a report is up to date, without loading the code that makes one."""

from __future__ import annotations

import hashlib

from stickslip.analysis.page import OF_OWN, PAGE
from stickslip.pipeline.dataset.opened import Opened
from stickslip.pipeline.dataset.program import version_of
from stickslip.pipeline.errors import StoreError
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.place import Where

#: The files of a report, one a line, with their sha256; while it is written, the first line says so, and those of
#: the one before follow.
LIST, UNFINISHED = "report/files.txt", "(unfinished)"


def name_of(path: Where) -> str:
    """The last part of a directory or an address."""
    return str(place_of(path)).rstrip("/").rpartition("/")[2]


def made_from(opened: Opened) -> str:
    """Digest of all that a report depends on: data, scene, program."""
    title = opened.scene.title or name_of(opened.place)
    words = f"{title} {opened.scene.model_dump_json()} {program()} {opened.manifest.digest}"
    return hashlib.sha256(words.encode()).hexdigest()


def program() -> str:
    """The version of the program and a digest of all code that makes a report."""
    return version_of(("analysis", "workflows/scenes"))


def is_current(opened: Opened) -> bool:
    """Whether the report in a dataset was made from its present data and settings, by this program.

    Whether what a user's own questions are answered by is as it was is not looked at.

    Raises `StoreError` if it is, but data that it was made from are gone or cut.
    """
    is_made = made_from(opened).encode() in _head(opened)
    if is_made and (lost := opened.lost):
        raise StoreError(
            f"{opened.place}: expected the {len(opened.manifest.shards)} shards that its report was made from, got"
            f" {len(lost)} of them missing or of another size, {lost[0]} first; rerun the scene to rebuild them"
        )
    return is_made


def has_own(opened: Opened) -> bool:
    """Whether a user's own questions were run for the report in a dataset."""
    return OF_OWN.encode() in _head(opened)


def _head(opened: Opened) -> bytes:
    page, listed = opened.place.read_each([PAGE, LIST])
    if page is None or listed is None or listed.startswith(UNFINISHED.encode()):
        return b""
    return page[:2000]
