"""From a scene file to a dataset and back: which runs, where they run, how they are kept and found.

Reading is in `pipeline.query`: ``query.members(path)``, ``query.n_stick(path, member_id)``, ``query.sql(...)``.
"""

from pipeline import query
from pipeline.audit import Status, status, verify
from pipeline.interrupt import Interrupted, interruptible
from pipeline.manifest import StoreError, dataset_scene
from pipeline.members import Batch, Member, batches, expand
from pipeline.query import QueryError
from pipeline.scene import Scene, SceneError, load_scene, parse_scene
from pipeline.schedule import Progress, ScheduleError, run_member, run_scene

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
