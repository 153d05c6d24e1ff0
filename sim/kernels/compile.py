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
  processes compile at once. What does not match is compiled anew; what cannot be written is used without; what others
  could have written is refused (`stickslip.sim.kernels.cache`).
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numba
from numba._dynfunc import make_function
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.runtime import rtsys
from numba.core.targetconfig import ConfigStack
from numba.core.types import Type, unliteral
from numba.core.types.functions import BaseFunction

from stickslip.sim.kernels.cache import KernelFiles, cache_directory

_jit: Any = numba.njit
_POLICY: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


class _Locator(_CacheLocator):
    """What a kernel's files are called after; where they lie is decided by `KernelFiles` alone."""

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
        self._cache_file: Any = KernelFiles(cache_directory(), f"{function.__module__}.{function.__qualname__}")

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


def _warn_uncached(error: OSError) -> None:
    warnings.warn(
        f"kernels are compiled anew in every process: the cache directory {cache_directory()} cannot be written"
        f" ({error.strerror}); make room there, or set NUMBA_CACHE_DIR to another directory",
        stacklevel=3,
    )


def inner(function: Callable[..., Any] | None = None, *, counts: bool = False, inlined: bool = False) -> Any:
    """Compile a function of numbers and arrays that kernels call, and Python cannot.

    It becomes part of each `kernel` that needs it: no wrapper for Python, no machine code and no file of its own,
    which take time. What is called in one place with large tuples may be `inlined` there: else LLVM, which does not
    know that the place is the only one, passes each of their arrays by its parts.
    """
    if function is None:
        return partial(inner, counts=counts, inlined=inlined)
    no_wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    compiled = _jit(**_POLICY, **no_wrappers, _nrt=counts, forceinline=inlined, pipeline_class=_PartCompiler)(
        function
    )
    template = compiled.get_call_template
    # numba would compile it for each number that is written out in a call
    compiled.get_call_template = lambda args, kws: template([unliteral(kind) for kind in args], kws)
    return compiled


def one_of(functions: Sequence[Callable[..., Any]]) -> Any:
    """For kernels, ``f(number, *arguments)``: the function of that number; all take and return the same types."""
    first, others = inner(functions[0]), functions[1:]
    if not others:

        @inner
        def only(number, *arguments):  # type: ignore[no-untyped-def]
            return first(*arguments)

        return only
    rest = one_of(others)

    @inner
    def choose(number, *arguments):  # type: ignore[no-untyped-def]
        if number == 0:
            return first(*arguments)
        return rest(number - 1, *arguments)

    return choose


def kernel(function: Callable[..., Any] | None = None, *, counts: bool = False) -> Any:
    """Compile a function of numbers and arrays that Python calls, with all that it calls, and keep the result."""
    if function is None:
        return partial(kernel, counts=counts)
    compiled = _jit(**_POLICY, _nrt=counts, no_cfunc_wrapper=True, pipeline_class=_KernelCompiler)(function)
    compiled._cache = _KernelCache(function)
    return compiled
