"""`datapackage.json`: what a dataset is, and each of its columns, for whoever has no stickslip.

A Data Package of the Open Knowledge Foundation (specs.frictionlessdata.io), without a word on machines.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from stickslip.pipeline.dataset.schema import schema_of
from stickslip.pipeline.design.column import Column, Kind
from stickslip.pipeline.places.manifest import Manifest
from stickslip.pipeline.places.place import DATA, SCENE
from stickslip.pipeline.scene.scene import Scene
from stickslip.version import __version__

CITE = f"The stickslip authors: stickslip {__version__}, software under the licence MIT"

#: Types of Frictionless, of what is no list.
_TYPES: dict[Kind, str] = {
    "number": "number",
    "whole": "integer",
    "count": "integer",
    "yes or no": "boolean",
    "text": "string",
}


def package_of(scene: Scene, manifest: Manifest) -> bytes:
    """The text of `datapackage.json`, a pure function of the scene and of the shards that are done."""
    words: dict[str, Any] = dict(scene.recording.meaning)
    words |= {"symbols": json.loads(words["symbols"]), "programs": manifest.programs, "t_burn": scene.analysis.t_burn}
    columns = zip(scene.recording.columns, schema_of(scene.recording), strict=True)
    fields = [_field(column, stored.metadata) for column, stored in columns]
    runs = {
        "name": "runs",
        "title": "one row a run; lists along one dimension belong together",
        "path": [f"{DATA}/{name}" for name in sorted(manifest.shards)],
        "format": "parquet",
        "mediatype": "application/vnd.apache.parquet",
        "schema": {"primaryKey": "member_id", "fields": fields},
    }
    described = {"name": "scene", "title": "what was run, and how", "path": SCENE, "format": "toml"}
    package = {
        "profile": "data-package",
        "name": f"stickslip-{scene.hash[:12]}",
        "id": scene.hash,
        "title": scene.title,
        "description": scene.about,
        "licenses": [{"name": scene.licence}] if scene.licence else None,
        "cite": CITE,
        "meaning": words,
        "resources": [runs, described],
    }
    kept = {key: value for key, value in package.items() if value not in (None, "")}
    return f"{json.dumps(kept, indent=1, ensure_ascii=False)}\n".encode()


def _field(column: Column, metadata: Mapping[bytes, bytes]) -> dict[str, Any]:
    """A column as a field of Frictionless, with what its shards say of it."""
    field: dict[str, Any] = {
        "name": column.name,
        "type": _TYPES.get(column.kind, "array"),
        "constraints": {"required": not column.nullable},
    }
    field |= {key.decode(): words.decode() for key, words in metadata.items()}
    return field | ({"along": column.along} if column.along else {})
