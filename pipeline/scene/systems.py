"""Systems of the user's own: read from files, or made by a function. Checked once, known by a digest from then on."""

from __future__ import annotations

import fnmatch
import glob
import inspect
import os
import pickle
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from stickslip.pipeline.errors import SceneError, printable
from stickslip.pipeline.own import function as own
from stickslip.pipeline.own.files import content_of, digest
from stickslip.pipeline.own.function import OwnFunction
from stickslip.pipeline.own.trial import Trial, tried
from stickslip.pipeline.scene.graph_files import graph_of
from stickslip.pipeline.scene.other_files import OtherKind
from stickslip.pipeline.scene.source import MAX_FILES
from stickslip.pipeline.scene.system_files import NAMES, arrays_of
from stickslip.pipeline.scene.toml import shown
from stickslip.sim.numerics.arguments import per_block
from stickslip.sim.runs.blocks import named
from stickslip.sim.systems.system import System
from stickslip.sim.systems.terms import OF_BLOCKS

#: What a file may hold in addition to `stiffness`, each with a number a block.
BY_BLOCK = (*OF_BLOCKS, "z0", "w0")

#: The number of a realisation: what a file says, or what a function is given that takes it.
REALISATION = "realisation"

#: Entries of directories at most that are looked at for a pattern.
_MAX_ENTRIES = 100_000

#: What errors call the file, and the function.
_PATH, KEY = "system.path", "system.coupling"


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
    parameters: tuple[tuple[str, float], ...] = ()
    is_graph: bool = False  #: whether it holds a graph, and no K
    copy: int = 0  #: how many files before it are equal to it: realisations that came out the same

    @property
    def word(self) -> str:
        """What stands for it in a member's name."""
        return f"K{self.sha256[:12]}" + f"_{self.copy}" * (self.copy > 0)

    @property
    def realisation(self) -> int | None:
        """The number of the realisation, if it says so."""
        number = dict(self.parameters).get(REALISATION)
        return None if number is None else int(number)

    def matrix(self, draw: int) -> int:
        """The number of a draw of what the file leaves open: files of one realisation share it, from version 3 on.

        Else it depends on the content: other files change nothing. Below 2^63; in version 1 below 2^28, where two of
        some 20,000 files are likely to share one.
        """
        if self.version > 2:
            return int(digest(f"realisation {self.realisation} {draw}".encode())[:16], 16) >> 1
        which = f"{self.sha256} {draw}" + f" {self.copy}" * (self.copy > 0)
        word = digest(which.encode())
        return int(word[:7], 16) if self.version == 1 else int(word[:16], 16) >> 1


@dataclass(frozen=True, slots=True)
class SystemFunction(OwnFunction):
    """A function that makes systems."""

    is_sparse: bool = field(compare=False, kw_only=True)

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
    paths_by_name = {}
    for name in names:
        paths = [os.path.join(place, name) for place in places]
        # absolute: a worker may have been started in another directory; `resolve` raises where links are a circle
        paths_by_name[name] = os.path.realpath(next(filter(os.path.isfile, paths), paths[0]))
    return paths_by_name


def read(file: SystemFile) -> Mapping[str, Any]:
    """What a file holds, by name.

    Raises `SceneError` if it is gone, or not what it was.
    """
    return _read(file.at, file.sha256, file.is_graph)


@lru_cache(maxsize=2)
def _read(at: str, sha256: str, is_graph: bool) -> Mapping[str, Any]:
    content = content_of(Path(at), _PATH)
    actual = digest(content)
    if actual != sha256:
        raise SceneError(
            f"system.path: expected {at} as it was when the scene was read (sha256 {sha256[:12]}), got another "
            f"(sha256 {actual[:12]}); restore the file, or run the scene with it into another directory"
        )
    return _arrays(at, content, is_graph)


def look_again(origin: SystemFile | OwnFunction) -> None:
    """See that a file or a function of the user's own is as it was when the scene was read.

    Raises `SceneError` if it is gone, or another.
    """
    if isinstance(origin, SystemFile):
        read(origin)
    else:
        own.look_again(origin)


def _arrays(name: str, content: bytes, is_graph: bool) -> dict[str, Any]:
    try:
        return graph_of(content, BY_BLOCK) if is_graph else arrays_of(content, BY_BLOCK)
    except OtherKind as error:
        also = 'write coupling = "graph", which reads it, or ' * error.kind.is_graph
        raise SceneError(
            f"system.path: {name}: expected an .npz, .npy or Matrix Market file of K, got {error}; {also}convert it"
            f" in Python, and name what that writes: {error.line(name)}"
        ) from None
    except Exception as error:  # readers raise a dozen kinds of errors for damaged files, which no list names
        if is_graph:
            raise SceneError(
                f"system.path: {name}: expected a graph: rows i, j and perhaps a weight, GraphML, or an adjacency"
                f" matrix as .npz, .npy, Matrix Market or CSV ({_line(error)}); correct the file, or the path"
            ) from error
        raise SceneError(
            f"system.path: {name}: expected a whole .npz, .npy or Matrix Market file of K ({_line(error)}); "
            f'write it again, as numpy.savez("K.npz", stiffness=K) does, or correct the path'
        ) from error


def _line(error: Exception) -> str:
    """The message of an error, in a line."""
    why = printable(" ".join(str(error).split())) or type(error).__name__
    return why if len(why) < 300 else f"{why[:297]}..."  # it may show an array


def _checked(name: str, content: bytes, is_graph: bool) -> dict[str, Any]:
    """What a scene says of a file that was read, as plain values."""
    arrays = _arrays(name, content, is_graph)
    make = partial(System.from_graph, arrays["edges"]) if is_graph else partial(System, arrays["stiffness"])
    try:
        system = make(**{"damping": 0.0} | {k: arrays[k] for k in OF_BLOCKS if k in arrays})
        for key in ("z0", "w0"):
            per_block(key, arrays.get(key, 0.0), system.n)
        names = named(arrays.get(NAMES, ()), system.n)
    except (TypeError, ValueError, MemoryError) as error:
        raise SceneError(f"system.path: {name}: {_line(error)}") from None
    return {
        "sha256": digest(content),
        "n": system.n,
        "scale": float(abs(system.stiffness).max()),
        "entries": system.stiffness.size,
        "is_sparse": not isinstance(system.stiffness, np.ndarray),
        "arrays": [key for key in BY_BLOCK if key in arrays],
        "version": 3 if REALISATION in arrays.get("parameters", {}) else 2,
        **({"parameters": arrays["parameters"]} if "parameters" in arrays else {}),
        **({NAMES: [*names]} if names else {}),
    }


def look_at_files(pattern: str, folder: Path, is_graph: bool = False) -> dict[str, dict[str, Any]]:
    """Digest and facts of each file that a pattern matches, by its name beside the scene, as plain values.

    From then on the scene can be read without them, and a changed file makes another scene. Raises `SceneError` if
    there is no such file, or it holds no system.
    """
    files = [folder / pattern] if os.path.isfile(folder / pattern) else _glob(folder, pattern)
    if not files and os.path.isdir(folder / pattern):
        raise SceneError(f"system.path: expected a file, got the directory {pattern!r}; name a file in it")
    if not files:
        raise SceneError(
            f"system.path: expected a file, or several by a pattern such as K*.npz, got {shown(pattern)}, which names"
            f" none in {folder.resolve()}; correct the path"
        )
    is_beside = not Path(pattern).is_absolute()
    names = [file.relative_to(folder).as_posix() if is_beside else file.as_posix() for file in files]
    odd = next((name for name in names if not name.isprintable()), None)
    if odd is not None:  # what is no UTF-8 a scene could not name
        raise SceneError(f"system.path: expected files with printable names, got {odd!a}; rename it")
    return {
        name: _checked(str(file), content_of(file, _PATH), is_graph) for name, file in zip(names, files, strict=True)
    }


def _glob(folder: Path, pattern: str) -> list[Path]:
    """The files that a pattern names, as Python's glob finds them, of a bounded number of entries of directories."""
    files: set[Path] = set()
    n_left, places = _MAX_ENTRIES, [(folder, Path(pattern).parts)]
    while places and n_left >= 0 and len(files) <= MAX_FILES:
        place, patterns = places.pop()
        if not patterns:
            files.update([place] if os.path.isfile(place) else [])
            continue
        pattern_part, later_parts = patterns[0], patterns[1:]
        if not glob.has_magic(pattern_part):
            places.append((place / pattern_part, later_parts))
            continue
        entries = _entries(place, n_left + 1)
        n_left -= len(entries)
        is_folder = {
            name: is_folder for name, is_folder in entries.items() if name[0] != "." or pattern_part[0] == "."
        }
        if pattern_part == "**":
            places.append((place, later_parts))
            places += [
                (place / name, patterns if is_folder[name] else ())
                for name in is_folder
                if is_folder[name] or not later_parts
            ]
        else:
            places += [(place / name, later_parts) for name in fnmatch.filter(is_folder, pattern_part)]
    if n_left < 0 or len(files) > MAX_FILES:
        what = f"more than {MAX_FILES}" if n_left >= 0 else f"for which more than {_MAX_ENTRIES} would be looked at"
        raise SceneError(
            f"system.path: expected at most {MAX_FILES} files, got {what}, by {shown(pattern)}; narrow it"
        )
    return sorted(files)


def _entries(place: Path, limit: int) -> dict[str, bool]:
    """Names in a directory, at most so many, and whether each is a directory itself; none if it cannot be read."""
    try:
        with os.scandir(place) as entries:
            return {entry.name: entry.is_dir() for entry in islice(entries, limit)}
    except OSError:
        return {}


# ---------------------------------------------------------------------------------------------- functions


def make(
    function: OwnFunction,
    n: int,
    rng: np.random.Generator,
    parameters: Mapping[str, float],
    is_trial: bool = False,
    realisation: int = 0,
) -> System:
    """A system of n blocks by a function of the user's; one that takes `realisation` is given its number.

    Raises `SceneError` if the module or the function is gone or has changed, it returned no system of n blocks, or it
    loads a module beside the scene that it did not load when it was tried.
    """

    def work(systemt: Callable[..., Any]) -> Any:
        asks = REALISATION in inspect.signature(systemt).parameters
        return systemt(n, rng, **{**({REALISATION: realisation} if asks else {}), **parameters})

    system = own.use(function, work, is_trial)
    if not isinstance(system, System) or system.n != n:
        got = f"one of {system.n}" if isinstance(system, System) else type(system).__name__
        raise SceneError(f"{KEY}: {function.name}: expected it to return a stickslip.System of {n} blocks, got {got}")
    return system


def tried_function(function: SystemFunction, n: int, parameters: Mapping[str, float]) -> dict[str, Any]:
    """What a scene says of a function that has made a system, twice and in another process too, as plain values.

    Raises `SceneError` if that goes wrong, the systems differ, or it takes longer than
    `pipeline.own.trial.LONGEST_TRIAL`.
    """
    return tried(
        Trial(
            KEY,
            function.at,
            partial(_attempt, function, n, dict(parameters)),
            f"{function.name}({n}, rng{''.join(f', {k}={v!r}' for k, v in parameters.items())})",
            "a stickslip.System",
            "expected the same system each time for the same rng, got two that differ; draw from rng alone",
        )
    )


def _attempt(function: OwnFunction, n: int, parameters: Mapping[str, float]) -> tuple[bytes, dict[str, Any]]:
    """All that determines a system that a function makes, and facts of it."""
    system = make(function, n, np.random.default_rng(0), parameters, is_trial=True)
    stiffness = system.stiffness
    return pickle.dumps(_parts(system)), {
        "is_sparse": not isinstance(stiffness, np.ndarray),
        "entries_by_block": stiffness.size / n,
        **({NAMES: [*system.names]} if system.names else {}),
        "means": means_of(system),
    }


def means_of(system: System) -> dict[str, float]:
    """What `Scales.of` takes of a system."""
    diagonal = float(np.mean(system.stiffness.diagonal()))
    return {"mass": float(system.mass.mean()), "stiffness": diagonal, "friction": float(system.friction.mean())}


def _parts(system: System) -> list[Any]:
    """All that determines a system."""
    matrices = [_content(matrix) for matrix in (system.stiffness, system.cross_damping)]
    rest = [getattr(system, name) for name in (*OF_BLOCKS, "force", "back_slip", "names")]
    return [*matrices, *rest, repr(system.weakening)]  # a law of the user's own may not be pickled


def _content(matrix: Any) -> Any:
    """All that a matrix holds, dense or sparse."""
    return (
        matrix if matrix is None or isinstance(matrix, np.ndarray) else [matrix.data, matrix.indices, matrix.indptr]
    )
