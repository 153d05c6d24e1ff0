"""The one place that decides how kernels are compiled and cached.

Decisions, and why:

- ``nogil=True``: a kernel touches arrays only, so threads of a caller may run several runs at once.
- ``fastmath`` off, ``parallel`` off: reordered sums would make the order of events depend on the machine's
  vector width; an ensemble is parallel over members, never inside one.
- ``error_model="numpy"``: a division needs no branch; kernels check their own denominators.
- ``_nrt=False``: kernels count no references to arrays, an atomic operation for each array of each tuple that is
  passed on, a third of the exact engine's time. Python holds all arrays. What makes one of its own, or takes one from
  a tuple by its number, has to count: ``counts=True`` (or, for small ones, `arithmetic.room`).
- only a kernel is optimised and made machine code, with all that is linked into it: numba would do both at every
  call on the way up, half of the time of a cold start.
- while a kernel is compiled, what an operation on some types is gets looked up once: numba tries a dozen candidates
  wherever one stands, a quarter of the time.
- the cache lives in a directory named by a digest of every source file of ``sim``: numba's own check sees
  a change in the file of a kernel only, not in a constant or a callee of another file, and would run stale code.
- a compiled kernel is kept in a file of its own that ends in its sha256. numba's own files, numbered through an
  index, raise or crash when truncated, run what a flipped bit made of them, and mix up two kernels that two
  processes compile at once. What does not match is compiled anew; what cannot be written is used without.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import pickle
import time
import uuid
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numba
from numba._dynfunc import make_function
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.targetconfig import ConfigStack
from numba.core.types import Type, unliteral
from numba.core.types.functions import BaseFunction

from stickslip.sim.engines.sources import cache_directory

_config: Any = numba.config


def _usable_cache() -> Path | None:
    directory = cache_directory()
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        _warn_uncached(error)
        return None
    return directory


#: Seconds to wait for a process that compiles; it takes half a minute or so, and may be stuck.
_PATIENCE = 180.0
_DIGEST_SIZE = hashlib.sha256().digest_size
_jit: Any = numba.njit
_POLICY: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


class _KernelFiles:
    """Compiled kernels on disk, each in a file named by its key; what numba asks of the files of its caches."""

    def __init__(self, directory: Path, name: str) -> None:
        self._directory, self._name = directory, name
        self._locks: dict[str, contextlib.ExitStack] = {}

    def _file(self, key: object) -> Path:
        return self._directory / f"{self._name}.{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.nbc"

    def load(self, key: object) -> Any:
        """What was saved under a key; None if nothing, or if a byte of it has changed: compile it then.

        If another process does so now, wait and load its own.
        """
        kept = self._read(key)
        if kept is None and repr(key) not in self._locks:
            self._locks[repr(key)] = self._alone(key)
            kept = self._read(key)
            if kept is not None:
                self._locks.pop(repr(key)).close()
        return kept

    def _alone(self, key: object) -> contextlib.ExitStack:
        """Until this is closed no other process compiles it, unless nothing can be locked, or it takes too long."""
        held = contextlib.ExitStack()
        with contextlib.suppress(OSError):
            lock = os.open(self._file(key).with_suffix(".lock"), os.O_RDONLY | os.O_CREAT, 0o644)
            held.callback(os.close, lock)
            end = time.monotonic() + _PATIENCE
            while time.monotonic() < end:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    time.sleep(0.05)
        return held

    def _read(self, key: object) -> Any:
        try:
            content = self._file(key).read_bytes()
        except OSError:
            return None
        data, digest = content[:-_DIGEST_SIZE], content[-_DIGEST_SIZE:]
        return pickle.loads(data) if hashlib.sha256(data).digest() == digest else None

    def save(self, key: object, kernel: object) -> None:
        data = dumps(kernel)
        temporary = self._directory / f"{self._name}.{uuid.uuid4().hex}.tmp"
        try:
            temporary.write_bytes(data + hashlib.sha256(data).digest())
            os.replace(temporary, self._file(key))
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        finally:
            self._locks.pop(repr(key), contextlib.ExitStack()).close()

    def flush(self) -> None:
        for file in self._directory.glob(f"{self._name}.*.nbc"):
            file.unlink(missing_ok=True)


class _KernelCache(FunctionCache):
    def __init__(self, function: Callable[..., Any], directory: Path) -> None:
        super().__init__(function)
        self._cache_file: Any = _KernelFiles(directory, self._impl.filename_base)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """What is kept; before, numba would load all that it may need to compile, which takes half a second."""
        rtsys.initialize(target)  # which compiled code may call
        return self._load_overload(signature, target)

    def save_overload(self, signature: Any, compiled: Any) -> None:
        try:
            super().save_overload(signature, compiled)
        except OSError as error:
            _warn_uncached(error)


@contextlib.contextmanager
def _types_once() -> Iterator[None]:
    """Until this ends, numba finds once what an operation on some types is; its lock keeps other threads out."""
    functions: Any = BaseFunction
    find = functions.get_call_type
    found: dict[Any, Any] = {}

    def find_once(function: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws or not all(isinstance(arg, Type) for arg in args):  # a number that is written out: 1 would be True
            return find(function, context, args, kws)
        key = function, context, tuple(args), ConfigStack().top().nrt
        if key not in found:
            found[key] = find(function, context, args, kws)
        return found[key]

    functions.get_call_type = find_once
    try:
        yield
    finally:
        functions.get_call_type = find


class _KernelCompiler(Compiler):
    """Compiles a kernel, with all that it calls."""

    def _compile_core(self) -> Any:
        with _types_once():
            return super()._compile_core()


class _Part(JITCodeLibrary):
    """What an `inner` function is compiled to: code that is linked into a kernel's, and optimised there."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _PartCompiler(Compiler):
    """Compiles to a `_Part`; what numba then knows the function by cannot be called."""

    def _compile_core(self) -> Any:
        target = self.state.targetctx
        self.state.flags.no_compile = True
        self.state.library = _Part(target.codegen(), self.state.func_id.func_qualname)
        result = super()._compile_core()
        entry = make_function(numba, "", "", 0, result.environment, ())
        target.insert_user_function(entry, result.fndesc, [result.library])
        return result._replace(entry_point=entry)


def _warn_uncached(error: Exception) -> None:
    why = error.strerror if isinstance(error, OSError) else error
    warnings.warn(
        f"kernels are compiled anew in every process: the cache directory {cache_directory()} cannot be written"
        f" ({why}); make room there, or set NUMBA_CACHE_DIR to another directory",
        stacklevel=3,
    )


_CACHE = _usable_cache()


def inner(function: Callable[..., Any] | None = None, *, counts: bool = False) -> Any:
    """Compile a function of numbers and arrays that kernels call, and Python cannot.

    It becomes part of each `kernel` that needs it: no wrapper for Python, no machine code and no file of its own,
    which take time.
    """
    if function is None:
        return partial(inner, counts=counts)
    no_wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    compiled = _jit(**_POLICY, **no_wrappers, _nrt=counts, pipeline_class=_PartCompiler)(function)
    template = compiled.get_call_template
    # numba would compile it for each number that is written out in a call
    compiled.get_call_template = lambda args, kws: template([unliteral(kind) for kind in args], kws)
    return compiled


def kernel(function: Callable[..., Any] | None = None, *, counts: bool = False) -> Any:
    """Compile a function of numbers and arrays that Python calls, with all that it calls, and keep the result."""
    if function is None:
        return partial(kernel, counts=counts)
    # numba reads the directory when a function is decorated, so other users of numba keep their own
    previous = _config.CACHE_DIR
    _config.CACHE_DIR = "" if _CACHE is None else str(_CACHE)
    try:
        compiled = _jit(**_POLICY, _nrt=counts, no_cfunc_wrapper=True, pipeline_class=_KernelCompiler)(function)
        if _CACHE is not None:
            compiled._cache = _KernelCache(function, _CACHE)
    except RuntimeError as error:  # numba found no directory that it may write
        _warn_uncached(error)
    finally:
        _config.CACHE_DIR = previous
    return compiled
