"""Systems of the user's own: read from files, or made by a function. Checked once, known by a digest from then on."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import importlib.util
import io
import pickle
import sys
import threading
import types
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from stickslip.pipeline.errors import SceneError, foreign
from stickslip.pipeline.processes import Child, ChildDied
from stickslip.sim.arguments import did_you_mean, per_block
from stickslip.sim.system import System

#: Arguments of `System` that are a number a block; and what a file may hold beside `stiffness`.
OF_BLOCKS = ("damping", "friction", "static", "mass", "belt_speed")
BY_BLOCK = (*OF_BLOCKS, "z0", "w0")

#: Seconds that a function has for two systems when a scene is read.
LONGEST_TRIAL = 40.0

#: The modules beside a scene that this process has loaded, as they were then.
_held: dict[Path, str] = {}

#: What NumPy's files begin with: an .npz is a zip file.
_MAGIC = (b"PK", b"\x93NUMPY")

#: The parts of a sparse matrix as `scipy.sparse.save_npz` names them.
_SPARSE = {"data", "indices", "indptr", "shape", "format"}

_EXPECTED = "an array `stiffness`, or a sparse K as scipy.sparse.save_npz writes it, and of " + ", ".join(BY_BLOCK)


class ChangedError(SceneError):
    """What systems come from is there, and is not what it was."""


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

    @property
    def word(self) -> str:
        """What stands for it in a member's name."""
        return f"K{self.sha256[:12]}"

    def matrix(self, draw: int) -> int:
        """The number of a draw of what the file leaves open: of its content, so that other files move nothing."""
        return int(hashlib.sha256(f"{self.sha256} {draw}".encode()).hexdigest()[:7], 16)


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


def located(name: str, folder: Path) -> Path:
    """Where a file lies that a scene names: beside it, or above, as its copy in a dataset may lie deeper."""
    places = (folder, *folder.resolve().parents)
    # from the root: a worker may have been started in another directory
    return next((place / name for place in places if (place / name).is_file()), folder / name).resolve()


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
        _beside_again(_root(origin.at, origin.beside), origin.beside)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SceneError(
            f"system.path: {path} cannot be read ({error.strerror}); restore it, or correct the path"
        ) from None


def _arrays(name: str, content: bytes) -> dict[str, Any]:
    stream = io.BytesIO(content)
    try:
        if name.endswith((".mtx", ".mtx.gz")):
            from scipy.io import mmread  # takes a tenth of a second to load

            return {"stiffness": mmread(stream)}
        if not content.startswith(_MAGIC):
            raise ValueError("something else")  # of which NumPy says that it is a pickle
        found = np.load(stream, allow_pickle=False)
        if isinstance(found, np.ndarray):
            return {"stiffness": found}
        arrays = {key: found[key] for key in found.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        why = " ".join(str(error).split())
        raise SceneError(f"system.path: {name}: expected an .npz, .npy or Matrix Market file, got: {why}") from None
    if arrays.keys() >= _SPARSE:
        from scipy import sparse  # as above

        parts = {key: arrays.pop(key) for key in _SPARSE}
        arrays.pop("_is_array", None)
        kind = {b"csc": sparse.csc_array, b"csr": sparse.csr_array}.get(bytes(parts["format"].item()))
        if kind is None:
            raise SceneError(f"system.path: {name}: expected the format csc or csr, got {parts['format'].item()!r}")
        arrays["stiffness"] = kind((parts["data"], parts["indices"], parts["indptr"]), parts["shape"])
    elif "stiffness" not in arrays and len(arrays) == 1:
        arrays = {"stiffness": next(iter(arrays.values()))}
    unknown = sorted(arrays.keys() - {"stiffness", *BY_BLOCK})
    if unknown or "stiffness" not in arrays:
        raise SceneError(f"system.path: {name}: expected {_EXPECTED}, got {', '.join(sorted(arrays)) or 'nothing'}")
    return arrays


def _checked(name: str, content: bytes) -> dict[str, Any]:
    """What a scene says of a file once it is read, as plain values."""
    arrays = _arrays(name, content)
    try:
        system = System(arrays["stiffness"], **{"damping": 0.0} | {k: arrays[k] for k in OF_BLOCKS if k in arrays})
        for key in ("z0", "w0"):
            per_block(key, arrays.get(key, 0.0), system.n)
    except (TypeError, ValueError) as error:
        why = " ".join(str(error).split())  # it may show an array
        raise SceneError(f"system.path: {name}: {why if len(why) < 300 else f'{why[:297]}...'}") from None
    return {
        "sha256": _digest(content),
        "n": system.n,
        "scale": float(abs(system.stiffness).max()),
        "entries": system.stiffness.size,
        "is_sparse": not isinstance(system.stiffness, np.ndarray),
        "arrays": [key for key in BY_BLOCK if key in arrays],
    }


def look_at_files(pattern: str, folder: Path) -> dict[str, dict[str, Any]]:
    """What the files that a pattern names are now, by their names beside the scene, as plain values.

    From then on the scene is known without them, and a file that changes is another scene.

    Raises
    ------
    SceneError
        If there is no such file, or it holds no system.
    """
    found = [folder / pattern] if (folder / pattern).is_file() else _glob(folder, pattern)
    if not found:
        raise SceneError(f"system.path: expected a file, or several by a pattern such as K*.npz, got {pattern!r}, "
                         f"which names none in {folder.resolve()}; correct the path")  # fmt: skip
    is_beside = not Path(pattern).is_absolute()
    names = [file.relative_to(folder).as_posix() if is_beside else file.as_posix() for file in found]
    return {name: _checked(str(file), _content(file)) for name, file in zip(names, found, strict=True)}


def _glob(folder: Path, pattern: str) -> list[Path]:
    found = (folder / name for name in glob.glob(pattern, root_dir=folder, recursive=True))
    return sorted(file for file in found if file.is_file())


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


def make(function: SystemFunction, n: int, rng: np.random.Generator, parameters: Mapping[str, float]) -> System:
    """A system of n blocks by a function of the user's.

    Raises
    ------
    SceneError
        If the module or the function is gone, or not what it was; or what it returned is no such system.
    """
    with _found_first(function.at):
        try:
            found = _function(function.name, function.at, function.sha256, function.beside)(n, rng, **parameters)
        except (SystemExit, GeneratorExit) as error:  # which would end a worker
            raise RuntimeError(foreign(error)) from error
        except KeyboardInterrupt as error:
            if threading.current_thread() is threading.main_thread():  # it may be the user's
                raise
            raise RuntimeError(foreign(error)) from error
    if not isinstance(found, System) or found.n != n:
        got = f"one of {found.n}" if isinstance(found, System) else type(found).__name__
        raise SceneError(
            f"system.coupling: {function.name}: expected it to return a stickslip.System of {n} blocks, got {got}"
        )
    return found


def tried(function: SystemFunction, n: int, parameters: Mapping[str, float]) -> dict[str, Any]:
    """What a scene says of a function once it has made a system, twice, in a process of its own, as plain values.

    Raises
    ------
    SceneError
        If that goes wrong, the two differ, or it takes longer than `LONGEST_TRIAL`.
    """
    call = f"system.coupling: {function.name}({n}, rng{''.join(f', {k}={v!r}' for k, v in parameters.items())})"
    with Child(_try) as child:
        limit = threading.Timer(LONGEST_TRIAL, child.kill)
        limit.start()
        try:
            problem, found = child((function, n, dict(parameters)))
        except ChildDied as death:
            problem, found = (
                f"{call}: expected a stickslip.System within {LONGEST_TRIAL:g} s, its process died "
                f"({death}); correct the function",
                {},
            )
        finally:
            limit.cancel()
    if problem:
        raise SceneError(
            problem if problem.startswith("system.coupling") else f"{call}: {problem}; correct the function"
        )
    return found


def _try(task: tuple[SystemFunction, int, dict[str, float]]) -> tuple[str, dict[str, Any]]:
    """In a child: what is wrong with a function, or else what it made and loaded."""
    function, n, parameters = task
    before = set(sys.modules)
    sys.addaudithook(_no_fork)
    try:
        systems = [make(function, n, np.random.default_rng(0), parameters) for _ in range(2)]
    except SceneError as error:
        return str(error), {}
    except BaseException as error:  # noqa: BLE001  whatever it is, it is told in a line
        return f"expected a stickslip.System, got {foreign(error)}", {}
    if pickle.dumps(_parts(systems[0])) != pickle.dumps(_parts(systems[1])):
        return "expected the same system each time for the same rng, got two that differ; draw from rng alone", {}
    stiffness = systems[0].stiffness
    is_sparse = not isinstance(stiffness, np.ndarray)
    loaded = _beside(function, set(sys.modules) - before)
    return "", {"is_sparse": is_sparse, "entries_by_block": stiffness.size / n, "beside": loaded}


def _parts(system: System) -> list[Any]:
    """All that a system is given."""
    stiffness = system.stiffness
    dense = stiffness if isinstance(stiffness, np.ndarray) else [stiffness.data, stiffness.indices, stiffness.indptr]
    rest = [getattr(system, name) for name in (*OF_BLOCKS, "force", "weakening", "back_slip")]
    return [dense, *rest]


def _no_fork(event: str, _: tuple[Any, ...]) -> None:
    if event in ("os.fork", "os.forkpty"):
        raise RuntimeError("a function that makes systems may not fork")


def _beside(function: SystemFunction, names: set[str]) -> dict[str, str]:
    """The sha256 of each of some modules that lies in the scene's folder or below, by its path there."""
    root, installed = Path(function.at), Path(sys.prefix).resolve()
    files = {Path(file).resolve() for name in names if (file := getattr(sys.modules.get(name), "__file__", None))}
    files = {file for file in files if file.is_relative_to(root) and not file.is_relative_to(installed)}
    ours = Path(__file__).resolve().parents[1]
    found = {f.relative_to(root).as_posix(): _digest(_content(f)) for f in files if not f.is_relative_to(ours)}
    return dict(sorted(found.items()))


def _beside_again(root: Path, beside: tuple[tuple[str, str], ...]) -> None:
    """See that the modules that a function loads are as they were; what this process has of others is forgotten."""
    for name, sha256 in beside:
        file = root / name
        if not file.is_file() or _digest(_content(file)) != sha256:
            raise (ChangedError if file.is_file() else SceneError)(
                f"system.coupling: expected {file}, which the function loads, as it was when the scene was read "
                f"(sha256 {sha256[:12]}), found {'another' if file.is_file() else 'none'}; if it was changed, run "
                f"the scene into another directory"
            )
        if _held.setdefault(file, sha256) != sha256:
            for key in [k for k, one in sys.modules.items() if getattr(one, "__file__", None) == str(file)]:
                del sys.modules[key]
            _held[file] = sha256


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
    """The function, of a module that is loaded under a name of its own, so that what is on disk is what is called."""
    module, _, attribute = name.partition(":")
    file = _module_file(module, at, sha256)
    _beside_again(_root(at, beside), beside)
    loaded = types.ModuleType(f"_own_{module}_{sha256[:12]}")
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
    """The folder that the modules beside a scene lie in: that one, or above it, as its copy may lie deeper."""
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
    except (ImportError, ValueError):  # of a package that is not there, or by a name that is none
        return None
    return Path(spec.origin) if spec is not None and spec.has_location and spec.origin else None


@contextlib.contextmanager
def _found_first(folder: str) -> Iterator[None]:
    """Within: what a module imports is looked for beside it first."""
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        sys.path.remove(folder)
