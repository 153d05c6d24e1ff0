"""Members that killed their worker: each runs again in its own process; one that dies twice gets a row saying so."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

from stickslip.pipeline.dataset.result import Result
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.machine.processes import Child, ChildDied
from stickslip.pipeline.running.worker import Order, compute, failed, run_members
from stickslip.pipeline.scene.columns import Recording


def compute_alone(order: Order) -> Result:
    """As `compute`, with members that run in a process of their own.

    When it dies, the member it was at is run again, in another; if that dies too, the member's row says so.
    """
    return compute(*order, _run_alone)


def _run_alone(members: Sequence[Member], recording: Recording) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    process: Child | None = None
    with contextlib.ExitStack() as started:
        for member in members:
            for is_second in (False, True):
                process = process or started.enter_context(Child(_run_members))
                try:
                    found += process(([member], recording))
                    break
                except ChildDied as death:
                    process = None
                    if is_second:
                        found.append(failed(member, f"its worker died ({death})"))
    return found


def _run_members(task: tuple[list[Member], Recording]) -> list[dict[str, Any]]:
    return run_members(*task)
