"""Whether data fit into the memory of this machine."""

from __future__ import annotations

#: Copies of what is read: Arrow's, NumPy's and a frame's.
COPIES = 3
#: Bytes that fit any machine: for less, its memory is not looked up, which loads Dask.
_SMALL = 2**27


def lack(n_bytes: int, what: str) -> str:
    """Why data of so many bytes cannot be held, as the end of a message that calls them `what`; "" if they can."""
    if n_bytes <= _SMALL:
        return ""
    from distributed.system import MEMORY_LIMIT

    if n_bytes <= MEMORY_LIMIT:
        return ""
    return f"expected what this machine can hold, {MEMORY_LIMIT / 1e9:.3g} GB, got {what} {n_bytes / 1e9:.3g} GB"
