"""Members that may kill their process, run where that hurts nobody: in a process of their own."""

from __future__ import annotations

import pickle
import signal
import sys
import time
from collections.abc import Sequence
from typing import Any

from stickslip.pipeline.design import Batch, Member
from stickslip.pipeline.processes import Child, answering, end_with_the_parent
from stickslip.pipeline.schema import Recording, Result, as_result, failed_row, row


def compute_alone(batch: Batch, recording: Recording) -> Result:
    """As `shards.compute`, in a process that tells of each member as it ends.

    When it dies, the member it was at is run again, alone; if that process dies too, the member's row says so.
    """
    start = time.perf_counter()
    rows: list[dict[str, Any]] = []
    is_suspected = False
    while len(rows) < len(batch.members):
        rest = batch.members[len(rows) :]
        group = rest[:1] if is_suspected else rest
        found, end = _rows_of_a_process(group, recording)
        rows += found
        if is_suspected and not found:
            rows.append(failed_row(group[0], f"its worker died ({end})"))
        is_suspected = not is_suspected and len(found) < len(group)
    return as_result(batch, recording, rows, start)


def _rows_of_a_process(members: Sequence[Member], recording: Recording) -> tuple[list[dict[str, Any]], str]:
    """The rows of the members that were run before the process ended, and how it ended."""
    with Child("from stickslip.pipeline.worker import serve; serve()") as process:
        rows = []
        try:
            pickle.dump((tuple(members), recording), process.to_it)
            process.to_it.flush()  # and left open: closed, it says that nobody waits any more
            for _ in members:
                rows.append(pickle.load(process.from_it))
        except (BrokenPipeError, EOFError, pickle.UnpicklingError):  # it is dead, perhaps in the middle of a row
            pass
    code = process.returncode
    return rows, f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def serve() -> None:
    """Run the members that come in, and write the row of each at once."""
    answer = answering()
    members, recording = pickle.load(sys.stdin.buffer)
    end_with_the_parent()
    for member in members:
        pickle.dump(row(member, recording), answer)
        answer.flush()
