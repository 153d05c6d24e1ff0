"""The one place that decides how kernels are compiled and cached.

Decisions, and why:

- ``nogil=True``: a kernel works on arrays only, so several threads may run it at once.
- ``fastmath`` off, ``parallel`` off: reordered sums would make the order of events depend on the machine's
  vector width; an ensemble is parallel over members, never inside one.
- ``error_model="numpy"``: a division needs no branch; kernels check their own denominators.
- kernels count no references to arrays, an atomic operation for each array of each tuple that is passed on, a third
  of the exact engine's time. Python holds all arrays: a kernel makes none, but small ones by `arithmetic.room`, and
  takes none from a tuple by its number.
- only a kernel is optimised and compiled to machine code, with all that is linked into it: numba would do both for
  every function that it calls, which is half of the time of a cold start. What is linked into it is called from
  there alone, and LLVM is told so.
- the cache directory is named by a digest of all source files that kernels come from: numba's own check sees only a
  change in the file of a kernel, not in a constant or a callee of another file, and would run stale code.
- a compiled kernel is kept in a file of its own that ends in its sha256. numba's own files, numbered through an
  index, raise or crash when truncated, run code with flipped bits, and confuse two kernels that two processes compile
  at once. A file that does not match is compiled anew; a kernel that cannot be written is used without a file; a file
  that others could have written is refused (`stickslip.sim.kernels.cache`).
"""

from __future__ import annotations

import contextlib
import hashlib
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import numba
import numpy as np
from numba import types
from numba.core.codegen import JITCodeLibrary, get_host_cpu_features
from numba.core.compiler import Compiler, CompileResult
from numba.core.runtime import rtsys

from stickslip.sim.kernels.cache import CacheFiles, cache_directory
from stickslip.sim.kernels.emit import IS_COMPILED, is_reference

Function = TypeVar("Function", bound=Callable[..., Any])
#: Whether a register holds eight float64, by the features that numba compiles for.
HAS_WIDE_REGISTERS = "+avx512f" in (numba.config.CPU_FEATURES or get_host_cpu_features())  # type: ignore[attr-defined]


def _jit(function: Callable[..., Any], **options: Any) -> Any:
    policy: Any = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": False}
    return numba.njit(**policy, **options)(function)


class _KernelCache:
    """What numba asks of the cache of a kernel; `CacheFiles` decides where and how it is kept."""

    cache_path = property(lambda self: str(cache_directory()))

    def __init__(self, function: Callable[..., Any]) -> None:
        self._code = hashlib.sha256(function.__code__.co_code).hexdigest(), function.__code__.co_firstlineno
        self._files = CacheFiles(cache_directory(), f"{function.__module__}.{function.__qualname__}")

    def _key(self, signature: Any, target: Any) -> Any:
        return signature, target.codegen().magic_tuple(), self._code

    def load_overload(self, signature: Any, target: Any) -> Any:
        """The kept kernel. numba would first load all that it needs to compile, which takes half a second."""
        rtsys.initialize(target)  # compiled code may call it
        entry = self._files.load(self._key(signature, target))
        return None if entry is None else CompileResult._rebuild(target, *entry)

    def save_overload(self, signature: Any, compiled: Any) -> None:
        try:
            self._files.save(self._key(signature, compiled.target_context), compiled._reduce())
        except OSError as error:
            _warn_uncached(error)


class _Library(JITCodeLibrary):
    """Code whose named tuples, which are passed on by address, nothing else changes."""

    def add_ir_module(self, module: Any) -> None:
        for function in module.functions:
            for argument in function.args:
                if is_reference(argument):
                    argument.add_attribute("noalias")
        super().add_ir_module(module)


class _Whole(_Library):
    """The code of a kernel, with that of all that it calls.

    What is linked into it is private, so that LLVM knows all calls of a function: one that is called in one place
    becomes part of it, however long it is, and others lose the parameters that they do not use. (An internal one
    would keep its name, by which the process finds it for a function of numba's own that calls the same, with all
    parameters.)
    """

    def __init__(self, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self.enable_object_caching()  # as machine code, to be kept

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions:
            if function.linkage.name == "linkonce_odr":  # it was linked in
                function.linkage = "private"
        super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        with _interrupts():
            super()._finalize_final_module()


@contextlib.contextmanager
def _interrupts() -> Iterator[None]:
    """Raise at the end an interrupt that comes while LLVM calls Python, where it would be printed and lost."""
    before, interrupts = sys.unraisablehook, list[BaseException]()

    def keep(event: Any) -> None:
        if isinstance(event.exc_value, KeyboardInterrupt):
            interrupts.append(event.exc_value)
        else:
            before(event)

    sys.unraisablehook = keep
    try:
        yield
    finally:
        sys.unraisablehook = before
    if interrupts:
        raise interrupts[0]


class _Part(_Library):
    """The code of an `inner` function, which is linked into that of a kernel and optimised there."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _Compiler(Compiler):
    """Compiles into a library of its own."""

    library: type[JITCodeLibrary]

    def _compile_core(self) -> Any:
        self.state.library = self.library(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        return super()._compile_core()


class _KernelCompiler(_Compiler):
    """Compiles a kernel with all that it calls."""

    library = _Whole


class _PartCompiler(_Compiler):
    """Compiles to a `_Part`, whose entry point nobody calls: any built-in function that equals no other."""

    library = _Part

    def _compile_core(self) -> Any:
        self.state.flags.no_compile = True
        result = super()._compile_core()
        entry = [].clear
        self.state.targetctx.insert_user_function(entry, result.fndesc, [result.library])
        return result._replace(entry_point=entry)


def _warn_uncached(error: OSError) -> None:
    warnings.warn(
        f"kernels are compiled anew in every process: the cache directory {cache_directory()} cannot be written"
        f" ({error.strerror}); make room there, or set NUMBA_CACHE_DIR to another directory",
        stacklevel=3,
    )


def inner(function: Function) -> Function:
    """Compile a function of numbers and arrays that kernels call, and Python cannot.

    It becomes part of each `kernel` that needs it, without a wrapper for Python, machine code or a file of its own,
    which take time. numba takes types from calls; annotations are for readers, and for mypy, which checks calls.
    """
    if not IS_COMPILED:
        return function
    compiled = _jit(function, no_cpython_wrapper=True, pipeline_class=_PartCompiler)
    template = compiled.get_call_template
    # numba would compile it for each literal number in a call
    compiled.get_call_template = lambda args, kws: template([types.unliteral(kind) for kind in args], kws)
    return compiled


def code_of(kernel: Any, *arguments: Any) -> Any:
    """The machine code of a kernel that has been called with arguments of these types; it asks for no types.

    numba asks for that of each array in each call of a kernel, which takes longer than a small system runs.
    """
    return kernel.overloads[tuple(map(numba.typeof, arguments))].entry_point if IS_COMPILED else kernel


def one_of(functions: Sequence[Callable[..., Any]]) -> Any:
    """For kernels, ``f(number, *arguments)``: the function of that number. All take and return the same types."""
    if not IS_COMPILED:
        return lambda number, *arguments: functions[number](*arguments)
    first, tail = inner(functions[0]), functions[1:]
    if not tail:
        return inner(lambda number, *arguments: first(*arguments))
    of_tail = one_of(tail)

    @inner
    def choose(number: int, *arguments: Any) -> Any:
        if number == 0:
            return first(*arguments)
        return of_tail(number - 1, *arguments)

    return choose


def kernel(function: Function) -> Function:
    """Compile a function of numbers and arrays that Python calls, with all that it calls, and keep it on disk."""
    if not IS_COMPILED:
        return np.errstate(all="ignore")(function)  # numbers as machine code has them
    compiled = _jit(function, pipeline_class=_KernelCompiler)
    compiled._cache = _KernelCache(function)
    return compiled
