"""What `stickslip status` prints: how far a run is, who writes it, what is damaged and what failed."""

from __future__ import annotations

import socket
import sys
import time

from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.dataset.status import Status, status
from stickslip.pipeline.errors import command, printable
from stickslip.pipeline.places.place import Where
from stickslip.workflows.printed import unescaped
from stickslip.workflows.progress import EVERY, clock, pace

#: Seconds between two looks at a run.
_LOOK = 2.0


def say(directory: Where) -> Status:
    """Print the status of a dataset, and return it."""
    state = status(directory)
    print("\n".join(_status_lines(state)))
    return state


def watch(directory: Where) -> Status:
    """Print the status of a dataset repeatedly until no process writes it, and return the last one."""
    opened = open_dataset(directory)
    last: list[str] = []
    while True:
        opened = opened.again()
        state = status(opened)
        lines = _status_lines(state)
        if sys.stdout.isatty() and last:
            print(f"\x1b[{len(last)}F\x1b[J", end="", file=unescaped(sys.stdout))  # over the last ones
        if lines != last or sys.stdout.isatty():
            print("\n".join(lines), flush=True)
        last = lines
        if state.running is None:
            return state
        time.sleep(_LOOK if sys.stdout.isatty() else EVERY)


def _status_lines(state: Status) -> list[str]:
    outcomes = ", ".join(f"{count} {outcome}" for outcome, count in state.outcomes.items()) or "none yet"
    lines = [
        f"members {state.n_done} of {state.n_members} done: {outcomes}",
        f"shards  {state.n_shards_done} of {state.n_shards}, {state.n_bytes / 1e6:.2f} MB",
    ]
    if state.n_damaged:
        which = command("verify", state.path)
        lines.append(
            f"damaged {state.n_damaged} of these shards, or missing, with {state.n_lost} of the members:"
            f" `{which}` says which"
        )
    if state.running is not None:
        elapsed = clock(time.time() - state.running.began)
        # a store's lock is a lease, which its owner renews
        is_seen = "://" in state.path or state.running.owner.endswith(f" on {socket.gethostname()}")
        said = "" if is_seen else ", as its lock says: only there it can be seen to live"
        lines.append(f"running {state.running.owner}{said}, {elapsed}{pace(state.rate, state.eta)}")
        lines += [f"dask    {state.running.dashboard}"] * (state.running.dashboard is not None)
    elif not state.is_complete:
        lines.append("running nothing: rerun the scene to resume")
    return lines + [f"failed  {count}: {printable(reason)}" for reason, count in state.failures.items()]
