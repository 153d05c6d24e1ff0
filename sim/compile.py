"""The one place that decides how kernels are compiled and cached.

Decisions, and why:

- ``nogil=True``: a kernel touches arrays only, so threads of a caller may run several runs at once.
- ``fastmath`` off, ``parallel`` off: reordered sums would make the order of events depend on the machine's
  vector width; an ensemble is parallel over members, never inside one.
- ``error_model="numpy"``: a division needs no branch; kernels check their own denominators.
- ``no_rewrites=True``: kernels hold no array expressions, and looking for them takes time.
- the cache lives in a directory named by a digest of every source file of ``sim``: numba's own check sees
  a change in the file of a kernel only, not in a constant or a callee of another file, and would run stale code.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

_config: Any = numba.config
_SOURCES = Path(__file__).parent


def _digest() -> str:
    """Digest of the sources of ``sim`` and the version of numba (numba itself adds the CPU to its keys)."""
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(_SOURCES.glob("*.py")):
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def cache_directory() -> Path:
    """Where compiled kernels are kept: ``$NUMBA_CACHE_DIR`` or the user's cache, below it ``stickslip/<digest>``."""
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "stickslip" / _digest()


def _usable_cache() -> Path | None:
    directory = cache_directory()
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        warnings.warn(
            f"kernels are compiled anew in every process: the cache directory {directory} cannot be made"
            f" ({error.strerror}); set NUMBA_CACHE_DIR to a writable directory",
            stacklevel=2,
        )
        return None
    return directory


_CACHE = _usable_cache()
_jit: Any = numba.njit
_POLICY: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_rewrites": True}


def clear_cache() -> None:
    """Remove the compiled kernels of this version; the next call compiles them again."""
    shutil.rmtree(cache_directory(), ignore_errors=True)
    cache_directory().mkdir(parents=True, exist_ok=True)


def inner(function: Callable[..., Any]) -> Any:
    """Compile a function of numbers and arrays that kernels call, and Python cannot.

    It becomes part of each `kernel` that needs it: no wrapper for Python and no file of its own, which take time.
    """
    return _jit(**_POLICY, no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function of numbers and arrays that Python calls, with all that it calls, and keep the result."""
    # numba reads the directory when a function is decorated, so other users of numba keep their own
    previous = _config.CACHE_DIR
    _config.CACHE_DIR = "" if _CACHE is None else str(_CACHE)
    try:
        return _jit(**_POLICY, cache=_CACHE is not None)(function)
    finally:
        _config.CACHE_DIR = previous
