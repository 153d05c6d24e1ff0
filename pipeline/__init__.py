"""From a scene file to a dataset and back: which runs, where they run, how they are kept and found.

Reading is in `pipeline.query`: ``query.members(path)``, ``query.n_stick(path, member_id)``, ``query.sql(...)``.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline import query
    from pipeline.audit import Status, status, verify
    from pipeline.cluster import ScheduleError
    from pipeline.interrupt import Interrupted, interruptible
    from pipeline.manifest import dataset_scene
    from pipeline.members import Batch, Member, batches, expand
    from pipeline.place import StoreError
    from pipeline.query import QueryError
    from pipeline.scene import Scene, SceneError, load_scene, parse_scene
    from pipeline.schedule import Progress, run_member, run_scene

__all__ = [
    "Batch",
    "Interrupted",
    "Member",
    "Progress",
    "QueryError",
    "Scene",
    "SceneError",
    "ScheduleError",
    "Status",
    "StoreError",
    "batches",
    "dataset_scene",
    "expand",
    "interruptible",
    "load_scene",
    "parse_scene",
    "query",
    "run_member",
    "run_scene",
    "status",
    "verify",
]

# Each room is loaded when a name of it is first asked for: scenes need neither dask nor pandas, which take a second.
_ROOMS = {
    "audit": ("Status", "status", "verify"),
    "cluster": ("ScheduleError",),
    "interrupt": ("Interrupted", "interruptible"),
    "manifest": ("dataset_scene",),
    "members": ("Batch", "Member", "batches", "expand"),
    "place": ("StoreError",),
    "query": ("QueryError",),
    "scene": ("Scene", "SceneError", "load_scene", "parse_scene"),
    "schedule": ("Progress", "run_member", "run_scene"),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}


if not TYPE_CHECKING:  # a checker would take it that every name exists

    def __getattr__(name: str) -> Any:
        if name == "query":
            return import_module("pipeline.query")
        if name not in _ROOM_OF:
            raise AttributeError(f"module 'pipeline' has no attribute {name!r}")
        found = globals()[name] = getattr(import_module(f"pipeline.{_ROOM_OF[name]}"), name)
        return found

    def __dir__() -> list[str]:
        return __all__
