"""A digest of the sources of `sim`, which identifies the kernels compiled from them, without loading numba.

`sim/theory` is left out: no run depends on it.
"""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

_SOURCES = Path(__file__).parent.parent


@cache
def source_digest() -> str:
    """Digest of the sources of ``sim``, as loaded by this process; equal ones compute the same."""
    digest = hashlib.sha256()
    for source in sorted(source for source in _SOURCES.rglob("*.py") if source.parent.name != "theory"):
        digest.update(f"{source.parent.name}/{source.name}".encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


@cache
def kernel_digest() -> str:
    """Digest of the sources and the version of numba (numba itself adds the CPU to its keys)."""
    return hashlib.sha256(f"{version('numba')} {source_digest()}".encode()).hexdigest()[:16]
