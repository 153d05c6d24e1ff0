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
#: Variables of numba that change no machine code; all others, such as ``NUMBA_OPT``, are taken to.
_NO_CODE = {"NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT", "NUMBA_NUM_THREADS"}


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
    """Digest of the sources, and of numba's version and variables (numba itself adds the CPU to its keys)."""
    names = sorted(name for name in os.environ if name.startswith("NUMBA_") and name not in _NO_CODE)
    settings = [f"{name}={os.environ[name]}" for name in names]
    return hashlib.sha256(" ".join([version("numba"), source_digest(), *settings]).encode()).hexdigest()[:16]


def is_compiled() -> bool:
    """Whether kernels are compiled; else they are run as Python, and sums have other last digits."""
    return os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0")
