"""Kept kernels: what was saved comes back, or nothing does."""

from __future__ import annotations

import ctypes
import math
import os
import sys
import threading
import types
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numba
import numpy as np
import pytest

from stickslip import draw_system, simulate
from stickslip.sim.engines import several
from stickslip.sim.kernels import cache as kept
from stickslip.sim.kernels import compile as compiling
from stickslip.sim.kernels import digest
from stickslip.sim.kernels.cache import CacheFiles, cache_directory
from stickslip.sim.kernels.compile import inner, kernel
from stickslip.sim.simulation import as_engine, as_task


@pytest.fixture
def files(tmp_path):
    return CacheFiles(tmp_path, "a")


def no_space(*_, **__):
    raise OSError(28, "No space left on device")


def test_what_is_compiled_is_of_the_rooms_that_name_its_files():
    """Else a change of it would run what was compiled before."""
    rooms = Path(digest.__file__).parents[1]
    compiled = {file for file in rooms.rglob("*.py") if "kernels.compile import" in file.read_text()}
    assert {file.relative_to(rooms).parts[0] for file in compiled} == set(digest._COMPILED) - {"kernels", "systems"}


def test_a_kernel_comes_back_under_its_own_key(files, tmp_path):
    files.save(("float64", "x86"), {"code": b"1"})
    files.save(("int64", "x86"), {"code": b"2"})
    again = CacheFiles(tmp_path, "a")
    assert again.load(("float64", "x86")) == {"code": b"1"}
    assert again.load(("int64", "x86")) == {"code": b"2"}
    assert again.load(("int64", "arm")) is None
    assert CacheFiles(tmp_path, "b").load(("int64", "x86")) is None
    files.flush()
    assert again.load(("int64", "x86")) is None


def test_a_kernel_of_a_law_from_a_module_that_is_gone_is_compiled_anew(files, monkeypatch):
    module = types.ModuleType("a_law_of_ones_own")
    exec("class Law: pass", module.__dict__)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    files.save("key", module.Law())
    assert isinstance(files.load("key"), module.Law)
    monkeypatch.delitem(sys.modules, module.__name__)
    assert files.load("key") is None


def test_who_waits_for_a_kernel_takes_the_one_that_was_compiled_meanwhile(files, tmp_path, monkeypatch):
    waits, saved = threading.Event(), threading.Event()
    monkeypatch.setattr(kept.time, "sleep", lambda _: (waits.set(), saved.wait(60)))
    assert files.load("key") is None  # who asks first compiles it
    with ThreadPoolExecutor() as other:
        found = other.submit(CacheFiles(tmp_path, "a").load, "key")
        waits.wait(60)
        files.save("key", "compiled")
        saved.set()
        assert found.result() == "compiled"


def test_whatever_is_damaged_or_half_written_is_not_loaded(files, tmp_path, monkeypatch):
    files.save("key", list(range(50)))
    file = next(tmp_path.iterdir())
    whole = file.read_bytes()
    for size in range(0, len(whole), 7):
        file.write_bytes(whole[:size])
        assert files.load("key") is None
    for place in range(0, len(whole), 7):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        assert files.load("key") is None
    files.save("key", "healed")
    assert files.load("key") == "healed"
    file.unlink()
    monkeypatch.setattr(os, "replace", no_space)
    with pytest.raises(OSError, match="No space left"):
        files.save("key", 1)
    assert [file.suffix for file in tmp_path.iterdir()] == [".lock"]


def test_a_kernel_that_cannot_be_kept_is_used_without(monkeypatch):
    monkeypatch.setattr(CacheFiles, "save", no_space)

    @kernel
    def double(x):
        return 2 * x

    with pytest.warns(UserWarning, match=r"compiled anew in every process.*No space left.*NUMBA_CACHE_DIR"):
        assert double(3) == 6
    assert not list(cache_directory().glob("test_compile*.nbc"))


@pytest.fixture
def uncached(monkeypatch):
    """Kernels are compiled anew, and not kept."""
    monkeypatch.setattr(CacheFiles, "load", lambda self, key: None)
    monkeypatch.setattr(CacheFiles, "save", lambda self, key, data: None)


def chain(arguments, added, length):
    """A part of kernels: x becomes its sine and what is added, again and again."""
    places = {"math": math, "__name__": __name__}
    exec(f"def chain({arguments}):\n" + f"    x = math.sin(x) + {added}\n" * length + "    return x", places)
    return inner(places["chain"])


@pytest.mark.usefixtures("uncached")
def test_a_function_that_a_kernel_calls_in_one_place_becomes_part_of_it():
    """However long it is: 300 sines are far more than LLVM takes into a caller that may not be the only one."""
    part = chain("x", "0.5", 300)

    @kernel
    def whole(x):
        return part(x)

    x = 0.25
    for _ in range(300):
        x = math.sin(x) + 0.5
    assert whole(0.25) == pytest.approx(x, rel=1e-12)
    code = whole.inspect_llvm(whole.signatures[0]).splitlines()
    assert not [line for line in code if line.startswith("define") and "chain" in line]


@pytest.mark.usefixtures("uncached")
def test_a_part_of_a_kernel_is_whole_for_what_is_compiled_after_it():
    """Within a kernel it loses what it does not use; a function of numba's own calls it with all, not that one."""
    part = chain("rest, x", "rest[-1]", 50)

    @kernel
    def whole(rest, x):
        return part(rest, x), part(rest, 2.0 * x)

    @numba.njit
    def other(rest, x):
        return part(rest, x)

    rest = np.array([7.0, 0.5])
    assert whole(rest, 0.25)[1] == other(rest, 0.5)


@pytest.mark.usefixtures("uncached")
def test_an_interrupt_of_a_callback_from_the_compiler_is_not_lost(monkeypatch):
    """ctypes prints what its callbacks raise, and goes on."""

    @ctypes.CFUNCTYPE(None)
    def interrupted():
        raise KeyboardInterrupt

    @kernel
    def double(x):
        return 2 * x

    with monkeypatch.context() as patch:
        patch.setattr(compiling.JITCodeLibrary, "_finalize_final_module", lambda self: interrupted())
        with pytest.raises(KeyboardInterrupt):
            double(3)
    assert double(3) == 6


@pytest.mark.parametrize("engine", ["coulomb", "sigmoid"])
def test_plain_systems_of_any_size_are_of_one_type(engine, monkeypatch):
    """Of these numba is asked once: the code for a type would read arrays of another as if they were its own."""
    kinds = set()

    def code_of(kernel, *arguments):
        def code(*arguments):
            kinds.add(tuple(map(numba.typeof, arguments)))
            kernel(*arguments)

        kinds.add(tuple(map(numba.typeof, arguments)))
        return code

    monkeypatch.setattr(several, "_CODE", {})
    monkeypatch.setattr(several, "code_of", code_of)
    for n in (1, 2, 3, 4, 5, 8, 9):
        systems = [draw_system("antisymmetric", n, seed) for seed in range(3)]
        kind = as_engine(engine, {})
        for times in ((), [0.0, 1.0]):
            simulate(
                systems[0], -0.7, np.linspace(-0.4, 0.0, n), 2.0, engine=engine, t_eval=times, stop_early="always"
            )
        for run in kind.prepare([as_task(kind, system, -0.7, -0.4, 2.0) for system in systems]):
            run()
    assert len(kinds) == 1
