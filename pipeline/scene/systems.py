"""Systems of the user's own: read from files, or made by a function. Checked once, known by a digest from then on."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import importlib.abc
import importlib.machinery
import importlib.util
import os
import pickle
import stat
import sys
import threading
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from stickslip.pipeline.errors import SceneError, foreign, printable
from stickslip.pipeline.machine.processes import Child, ChildDied
from stickslip.pipeline.scene.system_files import arrays_of
from stickslip.sim.numerics.arguments import did_you_mean, per_block
from stickslip.sim.systems.system import System
from stickslip.sim.systems.terms import OF_BLOCKS

#: What a file may hold in addition to `stiffness`, each with a number a block.
BY_BLOCK = (*OF_BLOCKS, "z0", "w0")

#: Seconds that a function has for two systems when a scene is read.
LONGEST_TRIAL = 40.0

#: Prefix of the names under which modules of functions are loaded.
_OWN = "_own_"

#: Held while a function makes a system: the threads of a process share its table of modules.
_alone = threading.RLock()


class ChangedError(SceneError):
    """A file or a module that systems come from has changed."""


@dataclass(frozen=True, slots=True)
class SystemFile:
    """A file that a system is read from: its name beside the scene, the sha256 of its bytes, and where it lies."""

    name: str
    sha256: str
    at: str = field(compare=False)
    scale: float
    entries: int
    is_sparse: bool
    arrays: tuple[str, ...]
    version: int

    @property
    def word(self) -> str:
        """What stands for it in a member's name."""
        return f"K{self.sha256[:12]}"

    def matrix(self, draw: int) -> int:
        """The number of a draw of what the file leaves open. It depends on the content: other files change nothing.

        Below 2^63; in version 1 below 2^28, where two of some 20,000 files are likely to share one.
        """
        digest = hashlib.sha256(f"{self.sha256} {draw}".encode()).hexdigest()
        return int(digest[:7], 16) if self.version == 1 else int(digest[:16], 16) >> 1


@dataclass(frozen=True, slots=True)
class SystemFunction:
    """A function that makes systems: `module:function`, the sha256 of its file, and the folder that it lies in."""

    name: str
    sha256: str
    at: str = field(compare=False)
    is_sparse: bool = field(compare=False)
    #: The modules in the scene's folder that it loads: paths there, and the sha256 of each.
    beside: tuple[tuple[str, str], ...] = ()

    @property
    def word(self) -> str:
        """What stands for it in a member's name."""
        return f"{self.name}-{self.sha256[:12]}"

    def matrix(self, draw: int) -> int:
        """The number of a draw."""
        return draw


def located(names: Iterable[str], folder: Path) -> dict[str, str]:
    """The paths of files that a scene names: beside it, or above, as its copy in a dataset may lie deeper."""
    places = (folder, *folder.resolve().parents)
    at = {}
    for name in names:
        paths = [os.path.join(place, name) for place in places]
        # absolute: a worker may have been started in another directory; `resolve` raises where links are a circle
        at[name] = os.path.realpath(next(filter(os.path.isfile, paths), paths[0]))
    return at


def read(file: SystemFile) -> Mapping[str, Any]:
    """What a file holds, by name.

    Raises
    ------
    SceneError
        If it is gone, or not what it was.
    """
    return _read(file.at, file.sha256)


@lru_cache(maxsize=2)
def _read(at: str, sha256: str) -> Mapping[str, Any]:
    content = _content(Path(at))
    digest = _digest(content)
    if digest != sha256:
        raise SceneError(
            f"system.path: expected {at} as it was when the scene was read (sha256 {sha256[:12]}), got another "
            f"(sha256 {digest[:12]}); restore the file, or run the scene with it into another directory"
        )
    return _arrays(at, content)


def look_again(origin: SystemFile | SystemFunction) -> None:
    """See that what systems come from is as it was when the scene was read.

    Raises
    ------
    SceneError
        If it is gone, or another.
    """
    if isinstance(origin, SystemFile):
        read(origin)
    else:
        module = origin.name.partition(":")[0]
        _module_file(module, origin.at, origin.sha256)
        _check_beside(_root(origin.at, origin.beside), origin.beside)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _content(path: Path) -> bytes:
    try:
        # a pipe that nobody writes to would block
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
            facts = os.fstat(file.fileno())
            if not stat.S_ISREG(facts.st_mode):
                raise SceneError(
                    f"system.path: expected a file, got {path}, which is not a regular file; correct the path"
                )
            content = file.read(facts.st_size + 1)
    except OSError as error:
        raise SceneError(
            f"system.path: {path} cannot be read ({error.strerror}); restore it, or correct the path"
        ) from None
    if len(content) != facts.st_size:
        raise SceneError(
            f"system.path: expected {facts.st_size} bytes in {path}, got {'others' if content else 'none'}; write the"
            " file before it is read"
        )
    return content


def _arrays(name: str, content: bytes) -> dict[str, Any]:
    try:
        return arrays_of(content, BY_BLOCK)
    except Exception as error:  # readers raise a dozen kinds of errors for damaged files, which no list names
        raise SceneError(
            f"system.path: {name}: expected a whole .npz, .npy or Matrix Market file of K ({_line(error)}); "
            f"write it again, or correct the path"
        ) from error


def _line(error: Exception) -> str:
    """The message of an error, in a line."""
    why = printable(" ".join(str(error).split())) or type(error).__name__
    return why if len(why) < 300 else f"{why[:297]}..."  # it may show an array


def _checked(name: str, content: bytes) -> dict[str, Any]:
    """What a scene says of a file that was read, as plain values."""
    arrays = _arrays(name, content)
    try:
        system = System(arrays["stiffness"], **{"damping": 0.0} | {k: arrays[k] for k in OF_BLOCKS if k in arrays})
        for key in ("z0", "w0"):
            per_block(key, arrays.get(key, 0.0), system.n)
    except (TypeError, ValueError, MemoryError) as error:
        raise SceneError(f"system.path: {name}: {_line(error)}") from None
    return {
        "sha256": _digest(content),
        "n": system.n,
        "scale": float(abs(system.stiffness).max()),
        "entries": system.stiffness.size,
        "is_sparse": not isinstance(system.stiffness, np.ndarray),
        "arrays": [key for key in BY_BLOCK if key in arrays],
        "version": 2,
    }


def look_at_files(pattern: str, folder: Path) -> dict[str, dict[str, Any]]:
    """Digest and facts of each file that a pattern matches, by its name beside the scene, as plain values.

    From then on the scene can be read without them, and a changed file makes another scene.

    Raises
    ------
    SceneError
        If there is no such file, or it holds no system.
    """
    found = [folder / pattern] if os.path.isfile(folder / pattern) else _glob(folder, pattern)
    if not found and os.path.isdir(folder / pattern):
        raise SceneError(f"system.path: expected a file, got the directory {pattern!r}; name a file in it")
    if not found:
        raise SceneError(f"system.path: expected a file, or several by a pattern such as K*.npz, got {pattern!r}, "
                         f"which names none in {folder.resolve()}; correct the path")  # fmt: skip
    is_beside = not Path(pattern).is_absolute()
    names = [file.relative_to(folder).as_posix() if is_beside else file.as_posix() for file in found]
    odd = next((name for name in names if not name.isprintable()), None)
    if odd is not None:  # what is no UTF-8 a scene could not name
        raise SceneError(f"system.path: expected files with printable names, got {odd!a}; rename it")
    return {name: _checked(str(file), _content(file)) for name, file in zip(names, found, strict=True)}


def _glob(folder: Path, pattern: str) -> list[Path]:
    found = (folder / name for name in glob.glob(pattern, root_dir=folder, recursive=True))
    return sorted(file for file in found if os.path.isfile(file))


# ---------------------------------------------------------------------------------------------- functions


def look_at_module(name: str, folder: Path) -> str:
    """The sha256 of the file of the module in `module:function`, beside the scene or installed.

    Raises
    ------
    SceneError
        If there is none.
    """
    module = name.partition(":")[0]
    file = _file_of(module, folder)
    if file is None:
        raise SceneError(
            f"system.coupling: expected the module {module!r} beside the scene, in {folder.resolve()}, or installed, "
            f"found none; write it there as {module.replace('.', '/')}.py, or correct the name"
        )
    return _digest(_content(file))


def make(
    function: SystemFunction,
    n: int,
    rng: np.random.Generator,
    parameters: Mapping[str, float],
    is_trial: bool = False,
) -> System:
    """A system of n blocks by a function of the user's.

    Raises
    ------
    SceneError
        If the module or the function is gone or has changed, it returned no system of n blocks, or it loads a module
        beside the scene that it did not load when it was tried.
    """
    process = os.getpid()
    with _alone, _own_modules(function, is_trial):
        try:
            found = _function(function.name, function.at, function.sha256, function.beside)(n, rng, **parameters)
        except Exception:
            raise
        except BaseException as error:  # it would end a worker
            if isinstance(error, KeyboardInterrupt) and threading.current_thread() is threading.main_thread():
                raise  # it may be the user's
            raise RuntimeError(foreign(error)) from error
        finally:
            if os.getpid() != process:  # a copy, which the function has forked: it would go on as a worker for ever
                os._exit(1)
    # modules stay as they were loaded; other files are read again
    _check_beside(_root(function.at, function.beside), [one for one in function.beside if not _module_of(one[0])])
    if not isinstance(found, System) or found.n != n:
        got = f"one of {found.n}" if isinstance(found, System) else type(found).__name__
        raise SceneError(
            f"system.coupling: {function.name}: expected it to return a stickslip.System of {n} blocks, got {got}"
        )
    return found


def tried(function: SystemFunction, n: int, parameters: Mapping[str, float]) -> dict[str, Any]:
    """What a scene says of a function that has made a system, twice and in another process too, as plain values.

    Raises
    ------
    SceneError
        If that goes wrong, the systems differ, or it takes longer than `LONGEST_TRIAL`.
    """
    call = f"system.coupling: {function.name}({n}, rng{''.join(f', {k}={v!r}' for k, v in parameters.items())})"
    with ThreadPoolExecutor(1) as aside, Child(_try) as child, Child(_try) as other:
        limits = [threading.Timer(LONGEST_TRIAL, each.kill) for each in (child, other)]
        for limit in limits:
            limit.start()
        try:
            # what a module draws when it is loaded, or what depends on the order of a set, differs between processes
            again = aside.submit(other, (function, n, dict(parameters), 1))
            problem, found = child((function, n, dict(parameters), 2))
            if not problem and found.pop("digest") != again.result()[1].get("digest"):
                problem, found = again.result()[0] or _DIFFER, {}
        except ChildDied as death:
            problem, found = (
                f"{call}: expected a stickslip.System within {LONGEST_TRIAL:g} s, its process died "
                f"({death}); correct the function",
                {},
            )
        finally:
            for limit in limits:
                limit.cancel()
    if problem:
        raise SceneError(
            problem if problem.startswith("system.coupling") else f"{call}: {problem}; correct the function"
        )
    return found


def _try(task: tuple[SystemFunction, int, dict[str, float], int]) -> tuple[str, dict[str, Any]]:
    """In a child, call a function some times: what is wrong with it, or else facts of what it made and read."""
    function, n, parameters, times = task
    audit = _Audit()
    sys.addaudithook(audit)
    try:
        systems = [make(function, n, np.random.default_rng(0), parameters, is_trial=True) for _ in range(times)]
    except SceneError as error:
        return str(error), {}
    except BaseException as error:  # noqa: BLE001  whatever it is, it is told in a line
        return f"expected a stickslip.System, got {foreign(error)}", {}
    digests = {_digest(pickle.dumps(_parts(system))) for system in systems}
    if len(digests) > 1:
        return _DIFFER, {}
    stiffness = systems[0].stiffness
    return "", {
        "is_sparse": not isinstance(stiffness, np.ndarray),
        "entries_by_block": stiffness.size / n,
        "beside": _beside(function, audit),
        "digest": digests.pop(),
    }


_DIFFER = "expected the same system each time for the same rng, got two that differ; draw from rng alone"


def _parts(system: System) -> list[Any]:
    """All that determines a system."""
    stiffness = system.stiffness
    dense = stiffness if isinstance(stiffness, np.ndarray) else [stiffness.data, stiffness.indices, stiffness.indptr]
    rest = [getattr(system, name) for name in (*OF_BLOCKS, "cross_damping", "force", "back_slip")]
    return [dense, *rest, repr(system.weakening)]  # a law of the user's own may not be pickled


class _Audit:
    """A hook of Python's audit while a function is tried: refuses forks, and notes the files that are opened."""

    def __init__(self) -> None:
        self.read: set[str] = set()
        self.written: set[str] = set()
        self._modules = set(sys.modules)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        match event, arguments:
            case (("os.fork" | "os.forkpty"), _):
                raise RuntimeError("a function that makes systems may not fork")
            case "open", (str() | bytes() as file, _, int() as flags):
                paths = self.read if flags & os.O_ACCMODE == os.O_RDONLY else self.written
                paths.add(os.path.abspath(os.fsdecode(file)))

    @property
    def files(self) -> set[str]:
        """What was read, and not written; of compiled modules the audit hears nothing."""
        modules = [sys.modules.get(name) for name in set(sys.modules) - self._modules]
        loaded = {file for module in modules if (file := getattr(module, "__file__", None))}
        return (self.read | loaded) - self.written


def _beside(function: SystemFunction, audit: _Audit) -> dict[str, str]:
    """The sha256 of each file that was read and lies in the scene's folder or below, by its path there."""
    root, found = Path(function.at), {}
    for name in {name for file in audit.files if (name := _name_beside(file, root)) is not None}:
        with contextlib.suppress(SceneError):  # it is gone, or no plain file
            found[name] = _digest(_content(root / name))
    return dict(sorted(found.items()))


def _name_beside(file: str, root: Path) -> str | None:
    """The path of a file within a scene's folder; None if it lies elsewhere, is installed or hidden."""
    if "__pycache__" in file:
        try:
            file = importlib.util.source_from_cache(file)
        except ValueError:
            return None
    if _is_installed(Path(file).resolve()):
        return None
    # a link there counts, even if it leads out of it
    for path in (Path(file), Path(file).parent.resolve() / Path(file).name):
        if path.is_relative_to(root):
            name = path.relative_to(root)
            return None if any(part.startswith(".") for part in name.parts) else name.as_posix()
    return None


def _is_installed(file: Path) -> bool:
    """Whether a file is of this package, of one that is installed, or of Python, which may lie in the user's home."""
    places = (Path(__file__).resolve().parents[1], Path(sys.prefix), Path(sys.base_prefix))
    is_package = not {"site-packages", "dist-packages"}.isdisjoint(file.parts)
    return is_package or any(file.is_relative_to(place.resolve()) for place in places)


def _check_beside(root: Path, beside: Iterable[tuple[str, str]]) -> None:
    """See that the files that a function reads are as they were."""
    for name, sha256 in beside:
        file = root / name
        if not file.is_file() or _digest_now(file) != sha256:
            raise (ChangedError if file.is_file() else SceneError)(
                f"system.coupling: expected {file}, which the function reads, as it was when the scene was read "
                f"(sha256 {sha256[:12]}), found {'another' if file.is_file() else 'none'}; if it was changed, run "
                f"the scene into another directory"
            )


def _digest_now(file: Path) -> str:
    """The sha256 of a file, which is read again if it may have changed."""
    facts = file.stat()
    return _digest_once(file, facts.st_ino, facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns)


@lru_cache(maxsize=64)
def _digest_once(file: Path, *_: int) -> str:
    return _digest(_content(file))


def _module_file(module: str, at: str, sha256: str) -> Path:
    """The file of a module as it was when the scene was read: in a folder, above it, or installed."""
    folders = dict.fromkeys((Path(at), *Path(at).parents, Path()))
    files = [file for folder in folders if (file := _file_of(module, folder)) is not None]
    file = next((file for file in files if _digest(_content(file)) == sha256), None)
    if file is None:
        raise (ChangedError if files else SceneError)(
            f"system.coupling: expected the module {module!r} as it was when the scene was read (sha256 "
            f"{sha256[:12]}), in {at} or installed, found {'another' if files else 'none'}; on a cluster, "
            f"let the workers have it there; if it was changed, run the scene into another directory"
        )
    return file


@lru_cache(maxsize=8)
def _function(name: str, at: str, sha256: str, beside: tuple[tuple[str, str], ...]) -> Callable[..., object]:
    """The function; its module is loaded under a name of its own, so that the file on disk is what runs."""
    module, _, attribute = name.partition(":")
    file = _module_file(module, at, sha256)
    _check_beside(_root(at, beside), beside)
    loaded = types.ModuleType(f"{_OWN}{module}_{sha256[:12]}")
    loaded.__file__, loaded.__package__ = str(file), module.rpartition(".")[0]
    sys.modules[loaded.__name__] = loaded  # where a dataclass looks for its own
    exec(compile(_content(file), str(file), "exec"), loaded.__dict__)
    found = getattr(loaded, attribute, None)
    if not callable(found):
        known = [key for key, value in vars(loaded).items() if isinstance(value, types.FunctionType)]
        near = did_you_mean(attribute, known) or f"; it has {', '.join(known) or 'none'}"
        raise SceneError(f"system.coupling: expected a function {attribute!r} in {file}, found none{near}")
    return found


def _root(at: str, beside: tuple[tuple[str, str], ...]) -> Path:
    """The folder of the modules beside a scene: the scene's, or one above it, as its copy may lie deeper."""
    places = (Path(at), *Path(at).parents)
    return next((place for place in places if all((place / name).is_file() for name, _ in beside)), Path(at))


def _file_of(module: str, folder: Path) -> Path | None:
    """The file of a module in a folder, or where Python finds it."""
    path = folder / module.replace(".", "/")
    beside = next((one for one in (path.with_suffix(".py"), path / "__init__.py") if one.is_file()), None)
    if beside is not None:
        return beside
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):  # its package is not there, or its name is not one
        return None
    return Path(spec.origin) if spec is not None and spec.has_location and spec.origin else None


class _Source(importlib.machinery.SourceFileLoader):
    """Compiles the file on disk each time.

    Python would take compiled code for that of another file of the same size that was written in the same second.
    """

    def get_code(self, fullname: str) -> types.CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


class _FromSource(importlib.abc.MetaPathFinder):
    """Finds modules as Python does; those beside a scene are read by `_Source`."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if (
            spec is not None
            and isinstance(spec.loader, importlib.machinery.SourceFileLoader)
            and _name_beside(spec.loader.path, self._root) is not None
        ):
            spec.loader = _Source(fullname, spec.loader.path)
        return spec


@lru_cache(maxsize=8)
def _modules(root: Path, beside: tuple[tuple[str, str], ...]) -> dict[str, types.ModuleType]:
    """The modules beside a scene that this process has loaded for its function, by name; filled by `_own_modules`."""
    return {}


@contextlib.contextmanager
def _own_modules(function: SystemFunction, is_trial: bool) -> Iterator[None]:
    """Within: a function's imports are looked for beside its scene first.

    The modules there are the function's own: others of the same names, of another scene or the caller, are set aside.

    Raises
    ------
    SceneError
        If it loaded modules there that it did not load when it was tried: nobody would notice if they changed.
    """
    root = _root(function.at, function.beside)
    own, finder = _modules(root, function.beside), _FromSource(root)
    names, before = _names(name for name, _ in function.beside), set(sys.modules)
    aside = {name: sys.modules.pop(name) for name in names & before}
    sys.modules.update(own)
    sys.path.insert(0, str(root))
    sys.meta_path.insert(sys.meta_path.index(importlib.machinery.PathFinder), finder)
    late: dict[str, str] = {}
    try:
        yield
    finally:
        sys.path.remove(str(root))
        sys.meta_path.remove(finder)
        if not is_trial:
            late = _loaded_beside(set(sys.modules) - before - names, root)
        for name in late:
            sys.modules.pop(name, None)
        own.update((name, sys.modules.pop(name)) for name in names & set(sys.modules))
        sys.modules.update(aside)
    if late:
        raise SceneError(
            f"system.coupling: {function.name}: expected it to load {min(late.values())} when it is tried, with the "
            f"least n and the first parameters, got it loaded later; import it at the top of the module"
        )


def _loaded_beside(names: Iterable[str], root: Path) -> dict[str, str]:
    """The files of those modules that lie beside the scene, without the function's own."""
    files = {name: getattr(sys.modules.get(name), "__file__", None) for name in names if not name.startswith(_OWN)}
    return {name: file for name, file in files.items() if file and _name_beside(file, root) is not None}


def _names(files: Iterable[str]) -> set[str]:
    """The names of modules by their files, and of the packages that they lie in: `a.b` and `a` of a/b.py."""
    names: set[str] = set()
    for file in files:
        path = Path(_module_of(file))
        parts = path.parts[:-1] if path.name == "__init__" else path.parts
        names.update(".".join(parts[:k]) for k in range(1, len(parts) + 1))
    return names


def _module_of(file: str) -> str:
    """The name of a module's file without its ending; "" for other files."""
    endings = sorted(importlib.machinery.all_suffixes(), key=len, reverse=True)
    ending = next(filter(file.endswith, endings), None)
    return "" if ending is None else file.removesuffix(ending)
