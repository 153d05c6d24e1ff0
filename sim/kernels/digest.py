"""Digests that identify compiled kernels, without loading numba."""

from __future__ import annotations

import hashlib
import os
from functools import cache
from importlib.metadata import version
from pathlib import Path

_SOURCES = Path(__file__).parent.parent
#: The rooms that kernels are compiled from: none calls what runs are shown, followed or explained by.
_COMPILED = ("engines", "kernels", "numerics", "systems")


@cache
def source_digest() -> str:
    """Digest of the sources of kernels, as loaded by this process; equal ones compile to the same."""
    digest = hashlib.sha256()
    for source in sorted(file for room in _COMPILED for file in (_SOURCES / room).rglob("*.py")):
        digest.update(f"{source.parent.name}/{source.name}".encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


@cache
def kernel_digest() -> str:
    """Digest of the sources and the version of numba (numba itself adds the CPU to its keys)."""
    return hashlib.sha256(f"{version('numba')} {source_digest()}".encode()).hexdigest()[:16]


def is_compiled() -> bool:
    """Whether kernels are compiled; else they are run as Python, and sums have other last digits."""
    return os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0")
