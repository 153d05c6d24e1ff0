"""Loaded by every Python process that has this directory on its path: makes the faults that it is asked for.

STICKSLIP_FAULTS asks, in JSON: `target_cost`; `sleep`, seconds a member; `victims`, member_id: exit, kill, segfault,
hang. Driver, workers and the processes that workers start are reached alike, and the program knows nothing of it.
"""

import json
import os

_plan = json.loads(os.environ.get("STICKSLIP_FAULTS", "{}"))


def _die(how: str) -> None:
    import ctypes
    import signal
    import time

    if how == "hang":
        time.sleep(1e6)
    if how == "exit":
        os._exit(3)
    if how == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if how == "segfault":
        ctypes.string_at(0)
    raise ValueError(how)


with open("/proc/self/cmdline") as _command:
    _is_helper = "resource_tracker" in _command.read()


def _inject() -> None:
    import time

    from stickslip.pipeline.ensemble import member, pack

    pack.TARGET_COST = _plan["target_cost"]
    task = member.Member.task

    def faulty(self: member.Member, *arguments: object) -> object:
        time.sleep(_plan.get("sleep", 0.0))
        if self.member_id in _plan.get("victims", {}):
            _die(_plan["victims"][self.member_id])
        return task(self, *arguments)

    member.Member.task = faulty


if _plan and not _is_helper:
    try:
        _inject()
    except BaseException:  # noqa: BLE001  Python would go on without the faults
        import traceback

        traceback.print_exc()
        os._exit(70)
