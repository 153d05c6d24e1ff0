"""Whether a report is still that of its data: found without loading what makes one."""

from __future__ import annotations

import hashlib
from pathlib import Path

from stickslip.analysis import report
from stickslip.analysis.report import PAGE
from stickslip.pipeline.dataset.opened import stored_scene
from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.manifest import read_manifest
from stickslip.pipeline.places.place import Where
from stickslip.version import __version__


def name_of(path: Where) -> str:
    """The last part of a directory or an address."""
    return str(place_of(path)).rstrip("/").rpartition("/")[2]


def made_from(path: Where) -> str:
    """Digest of what a report depends on: data, scene, program.

    Raises
    ------
    pipeline.StoreError, pipeline.SceneError
        If there is no manifest or no scene.
    """
    scene = stored_scene(path)
    words = f"{scene.title or name_of(path)} {scene.model_dump_json()} {__version__} {read_manifest(path).digest}"
    digest = hashlib.sha256(words.encode())
    folder = Path(report.__file__).parents[1]
    for file in sorted(file for file in folder.rglob("*") if file.suffix in (".py", ".html", ".css")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def is_current(path: Where) -> bool:
    """Whether the report at `path` was made from these data, settings and program.

    Raises
    ------
    pipeline.StoreError
        If there is no manifest.
    """
    (page,) = place_of(path).read_each([PAGE])
    try:
        return page is not None and made_from(path).encode() in page[:2000]
    except SceneError:  # said in full where the report is made
        return False
