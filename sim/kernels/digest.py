"""Digests that identify compiled kernels, without loading numba: of their sources, and of a user's functions."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Iterator
from functools import cache
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

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


def code_digest(*functions: Callable[..., Any] | None) -> str:
    """Digest of functions and of what they use by name: functions, constants, the files of modules and classes.

    Comments and the place in a file do not count.

    Raises
    ------
    TypeError
        If a function uses something of which it cannot be said whether it changes.
    """
    return hashlib.sha256("\n".join(_parts(functions, [])).encode()).hexdigest()[:16]


def _parts(value: Any, seen: list[Any]) -> Iterator[str]:
    """What a value consists of, in words; `seen` are the functions that came before."""
    yield type(value).__name__
    match value:
        case FunctionType() if value in seen:
            yield str(seen.index(value))
        case FunctionType():
            seen.append(value)
            cells = (cell.cell_contents for cell in value.__closure__ or ())
            used = [(name, value.__globals__[name]) for name in _names(value.__code__) if name in value.__globals__]
            defaults = (value.__defaults__, tuple((value.__kwdefaults__ or {}).items()))
            yield from _parts((value.__code__, *cells, *used, *defaults), seen)
        case CodeType():
            yield f"{value.co_code.hex()} {value.co_names} {value.co_argcount}"
            yield from _parts(value.co_consts, seen)
        case tuple() | list():
            for one in value:
                yield from _parts(one, seen)
        case np.ndarray():
            yield f"{value.dtype} {value.shape} {value.tobytes().hex()}"
        case ModuleType() | type():
            module = value if isinstance(value, ModuleType) else sys.modules[value.__module__]
            file = module.__dict__.get("__file__") or ""
            yield repr(value.__name__)
            yield hashlib.sha256(Path(file).read_bytes() if file.endswith(".py") else b"").hexdigest()
        case None | bool() | int() | float() | complex() | str() | bytes() | np.generic() | np.ufunc():
            yield repr(value)
        case BuiltinFunctionType():
            yield repr(value)
        case _:
            from numba.extending import is_jitted  # who asks for a digest has loaded it, to compile

            if not is_jitted(value):
                raise TypeError(f"expected functions that use numbers, arrays, functions or modules, got {value!r}")
            yield from _parts(value.py_func, seen)


def _names(code: CodeType) -> list[str]:
    """The global names that code may use, with those of functions inside it."""
    return sorted({*code.co_names, *chain(*(_names(one) for one in code.co_consts if isinstance(one, CodeType)))})
