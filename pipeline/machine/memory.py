"""Whether data fit into the memory of this machine."""

from __future__ import annotations

import os

#: Copies of what is read: Arrow's, NumPy's and a frame's.
COPIES = 3
#: Bytes that fit any machine: for less, its memory is not looked up, which loads Dask.
_SMALL = 2**27


#: How many times the bytes that a file takes on its disk it may have: one with more is nothing but holes.
_RATIO = 100


def is_hollow(status: os.stat_result) -> bool:
    """Whether a file has far more bytes than its disk keeps of it, as a sparse one."""
    return status.st_size > max(_SMALL, _RATIO * 512 * status.st_blocks)


def lack(n_bytes: int, what: str) -> str:
    """Why data of so many bytes cannot be held, as the end of a message that calls them `what`; "" if they can."""
    if n_bytes <= _SMALL:
        return ""
    from distributed.system import MEMORY_LIMIT

    if n_bytes <= MEMORY_LIMIT:
        return ""
    return f"expected what this machine can hold, {MEMORY_LIMIT / 1e9:.3g} GB, got {what} {n_bytes / 1e9:.3g} GB"
