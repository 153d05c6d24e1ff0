"""The one place that decides how kernels are compiled and cached.

Decisions, and why:

- ``nogil=True``: a kernel works on arrays only, so several threads may run it at once.
- ``fastmath`` off, ``parallel`` off: reordered sums would make the order of events depend on the machine's
  vector width; an ensemble is parallel over members, never inside one.
- ``error_model="numpy"``: a division needs no branch; kernels check their own denominators.
- ``_nrt=False``: kernels count no references to arrays, an atomic operation for each array of each tuple that is
  passed on, a third of the exact engine's time. Python holds all arrays. A function that makes an array, or takes one
  from a tuple by its number, must count: ``counts=True`` (or, for small arrays, `arithmetic.room`).
- only a kernel is optimised and compiled to machine code, with all that is linked into it: numba would do both for
  every function that it calls, which is half of the time of a cold start. What is linked into it is called from
  there alone, and LLVM is told so.
- while a kernel is compiled, an operation is resolved once for each set of argument types: numba tries a
  dozen candidates at each place, which is a quarter of the time.
- the cache directory is named by a digest of all source files that kernels come from: numba's own check sees only a
  change in the file of a kernel, not in a constant or a callee of another file, and would run stale code.
- a compiled kernel is kept in a file of its own that ends in its sha256. numba's own files, numbered through an
  index, raise or crash when truncated, run code with flipped bits, and confuse two kernels that two processes compile
  at once. A file that does not match is compiled anew; a kernel that cannot be written is used without a file; a file
  that others could have written is refused (`stickslip.sim.kernels.cache`).
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import Any

import numba
import numpy as np
from llvmlite.binding import Linkage
from numba._dynfunc import make_function
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.targetconfig import ConfigStack
from numba.core.types import Integer, Type, unliteral
from numba.core.types.functions import BaseFunction

from stickslip.sim.kernels.cache import CacheFiles, cache_directory
from stickslip.sim.kernels.emit import IS_COMPILED

_jit: Any = numba.njit
_POLICY: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


class _Locator(_CacheLocator):
    """Names the files of a kernel; `CacheFiles` alone decides where they are."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file, self._lineno = file, function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _Locator:
        return cls(function, file)

    def ensure_cache_path(self) -> None:
        pass

    def get_cache_path(self) -> str:
        return str(cache_directory())

    def get_source_stamp(self) -> str:
        return ""  # the directory is named by the sources

    def get_disambiguator(self) -> str:
        return str(self._lineno)


class _Kept(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012  as numba has it


class _KernelCache(FunctionCache):
    _impl_class = _Kept

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file: Any = CacheFiles(cache_directory(), f"{function.__module__}.{function.__qualname__}", dumps)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """The kept kernel. numba would first load all that it needs to compile, which takes half a second."""
        rtsys.initialize(target)  # compiled code may call it
        return self._load_overload(signature, target)

    def save_overload(self, signature: Any, compiled: Any) -> None:
        try:
            super().save_overload(signature, compiled)
        except OSError as error:
            _warn_uncached(error)


@contextlib.contextmanager
def _types_once() -> Iterator[None]:
    """Within this, numba resolves an operation on given types once; its lock keeps other threads out."""
    functions: Any = BaseFunction
    find = functions.get_call_type
    found: dict[Any, Any] = {}

    def find_once(function: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws or not all(isinstance(arg, Type) for arg in args):  # a literal number: 1 would equal True
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


class _Whole(JITCodeLibrary):
    """The code of a kernel, with that of all that it calls.

    What is linked into it is private, so that LLVM knows all calls of a function: one that is called in one place
    becomes part of it, however long it is, and others lose the parameters that they do not use. (An internal one
    would keep its name, by which the process finds it for a function of numba's own that calls the same, with all
    parameters.) Else a few instructions more, anywhere, decide that a function is called, and each call copies the
    parts of its tuples, some 460 words: the sigmoid's kernel took half as long again.
    """

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions:
            if function.linkage == Linkage.linkonce_odr:  # it was linked in
                function.linkage = Linkage.private
        super()._optimize_final_module()


class _KernelCompiler(Compiler):
    """Compiles a kernel with all that it calls."""

    def _compile_core(self) -> Any:
        self.state.library = _Whole(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        self.state.library.enable_object_caching()
        with _types_once():
            return super()._compile_core()


class _Part(JITCodeLibrary):
    """The code of an `inner` function, which is linked into that of a kernel and optimised there."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _PartCompiler(Compiler):
    """Compiles to a `_Part`; the entry point that numba needs for it cannot be called."""

    def _compile_core(self) -> Any:
        target = self.state.targetctx
        self.state.flags.no_compile = True
        self.state.library = _Part(target.codegen(), self.state.func_id.func_qualname)
        result = super()._compile_core()
        entry = make_function(numba, "", "", 0, result.environment, ())
        target.insert_user_function(entry, result.fndesc, [result.library])
        return result._replace(entry_point=entry)


def _warn_uncached(error: OSError) -> None:
    warnings.warn(
        f"kernels are compiled anew in every process: the cache directory {cache_directory()} cannot be written"
        f" ({error.strerror}); make room there, or set NUMBA_CACHE_DIR to another directory",
        stacklevel=3,
    )


def inner(function: Callable[..., Any] | None = None, *, counts: bool = False) -> Any:
    """Compile a function of numbers and arrays that kernels call, and Python cannot.

    It becomes part of each `kernel` that needs it, without a wrapper for Python, machine code or a file of its own,
    which take time.
    """
    if function is None:
        return partial(inner, counts=counts)
    if not IS_COMPILED:
        return function
    no_wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    compiled = _jit(**_POLICY, **no_wrappers, _nrt=counts, pipeline_class=_PartCompiler)(function)
    template = compiled.get_call_template
    # numba would compile it for each literal number in a call
    compiled.get_call_template = lambda args, kws: template([unliteral(kind) for kind in args], kws)
    return compiled


def one_of(functions: Sequence[Callable[..., Any]], others: Callable[[type[Any]], Callable[..., Any]]) -> Any:
    """For kernels, ``f(which, *arguments)``: the function of that number, or that of an empty named tuple's class.

    All take and return the same types. `others` gives the function of a class, for which kernels are compiled.
    """
    if not IS_COMPILED:
        return lambda which, *arguments: (others(type(which)) if which == () else functions[which])(*arguments)
    numbered = _numbered(functions)
    of_class = cache(lambda kind: _numbered([others(kind)]))
    template, overload = numbered.get_call_template, numbered.get_overload

    def is_numbered(kinds: Sequence[Any]) -> bool:
        return isinstance(kinds[0], Integer)

    numbered.get_call_template = lambda args, kws: (
        template if is_numbered(args) else of_class(args[0].instance_class).get_call_template
    )(args, kws)
    numbered.get_overload = lambda args: (
        overload if is_numbered(args) else of_class(args[0].instance_class).get_overload
    )(args)
    return numbered


def _numbered(functions: Sequence[Callable[..., Any]]) -> Any:
    """The function of a number; of one function, whatever stands there."""
    first, others = inner(functions[0]), functions[1:]
    if not others:

        @inner
        def only(number, *arguments):  # type: ignore[no-untyped-def]
            return first(*arguments)

        return only
    rest = _numbered(others)

    @inner
    def choose(number, *arguments):  # type: ignore[no-untyped-def]
        if number == 0:
            return first(*arguments)
        return rest(number - 1, *arguments)

    return choose


def kernel(function: Callable[..., Any] | None = None, *, counts: bool = False) -> Any:
    """Compile a function of numbers and arrays that Python calls, with all that it calls, and keep it on disk."""
    if function is None:
        return partial(kernel, counts=counts)
    if not IS_COMPILED:
        return np.errstate(all="ignore")(function)  # numbers as machine code has them
    compiled = _jit(**_POLICY, _nrt=counts, no_cfunc_wrapper=True, pipeline_class=_KernelCompiler)(function)
    compiled._cache = _KernelCache(function)
    return compiled
