"""Systems of the user's own: read from files, or made by a function. Checked once, known by a digest from then on."""

from __future__ import annotations

import contextlib
import fnmatch
import glob
import inspect
import os
import pickle
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from stickslip.pipeline.design.values import Measured
from stickslip.pipeline.errors import SceneError, printable
from stickslip.pipeline.own import function as own
from stickslip.pipeline.own.files import content_of, digest
from stickslip.pipeline.own.function import OwnFunction
from stickslip.pipeline.own.trial import Trial, tried
from stickslip.pipeline.scene.graph_files import graph_of
from stickslip.pipeline.scene.other_files import OtherKind
from stickslip.pipeline.scene.readers import FORMATS, reader_of
from stickslip.pipeline.scene.readers.text import Text
from stickslip.pipeline.scene.source import MAX_FILES, REALISATION
from stickslip.pipeline.scene.system_files import NAMES, arrays_of, series_of
from stickslip.pipeline.scene.system_table import FileTable
from stickslip.pipeline.scene.toml import shown
from stickslip.sim.numerics.arguments import per_block
from stickslip.sim.runs.blocks import PATTERN, named
from stickslip.sim.systems.drive import Piecewise
from stickslip.sim.systems.system import System
from stickslip.sim.systems.terms import OF_BLOCKS

#: What a file may hold in addition to `stiffness`, each with a number a block.
BY_BLOCK = (*OF_BLOCKS, "z0", "w0")

#: What may come from a file each.
_MATRIX = "stiffness"
_PARTS = {_MATRIX, *BY_BLOCK}

#: Entries of directories at most that are looked at for a pattern.
_MAX_ENTRIES = 100_000

#: What errors call the file, a table of friction, and the function.
_PATH, _TABLE, KEY = "system.path", "system.weakening.table", "system.coupling"
#: Bytes of a table of friction at most.
_MOST_OF_TABLE = 100_000


class FilePart(NamedTuple):
    """A file of an array of a system: the name of the array, where the file lies, and what that calls it."""

    array: str
    at: str
    variable: str


@dataclass(frozen=True, slots=True)
class SystemFile:
    """A file that a system is read from: its name beside the scene, and the sha256 of its bytes."""

    name: str
    sha256: str
    version: int
    is_graph: bool  #: whether it holds a graph, and no K
    copy: int  #: how many files before it are equal to it: realisations that came out the same
    facts: FileTable = field(compare=False)  #: what it held when the scene was read
    #: The file itself, and those of more arrays: `sha256` is of all.
    parts: tuple[FilePart, ...] = field(compare=False)

    @property
    def word(self) -> str:
        """What stands for it in a member's name."""
        return f"K{self.sha256[:12]}" + f"_{self.copy}" * (self.copy > 0)

    @property
    def is_sparse(self) -> bool:
        """Whether its matrix is sparse."""
        return self.facts.is_sparse

    @property
    def realisation(self) -> int | None:
        """The number of the realisation, if it says so."""
        number = self.facts.parameters.get(REALISATION)
        return None if number is None else int(number)

    def look_again(self) -> None:
        """See that it is as it was when the scene was read; raises as `read`."""
        read(self)

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


def located(name: str, folder: Path) -> str:
    """The path of a file that a scene names: beside it, or above, as its copy in a dataset may lie deeper."""
    paths = [os.path.join(place, name) for place in (folder, *folder.resolve().parents)]
    # absolute: a worker may have been started in another directory; `resolve` raises where links are a circle
    return os.path.realpath(next(filter(os.path.isfile, paths), paths[0]))


def read(file: SystemFile) -> Mapping[str, Any]:
    """What a file holds, by name.

    Raises `SceneError` if it is gone, or not what it was.
    """
    return _read(file.parts, file.sha256, file.is_graph)


@lru_cache(maxsize=2)
def _read(parts: tuple[FilePart, ...], sha256: str, is_graph: bool) -> Mapping[str, Any]:
    contents = {array: _Content(at, content_of(Path(at), _PATH), variable) for array, at, variable in parts}
    actual = _digest(contents)
    if actual != sha256:
        raise SceneError(
            f"system.path: expected {parts[0].at} as it was when the scene was read (sha256 {sha256[:12]}), got"
            f" another (sha256 {actual[:12]}); restore the file, or run the scene with it into another directory"
        )
    *_, (_, arrays) = _read_in_turn(contents, is_graph)
    return arrays


class _Content(NamedTuple):
    """What a file holds, by which name it is called, and what it calls the array that is read of it."""

    name: str
    bytes: bytes
    variable: str


def _digest(contents: Mapping[str, _Content]) -> str:
    """The sha256 of a file; or of several, with what they call the arrays."""
    if len(contents) == 1 and not contents[_MATRIX].variable:
        return digest(contents[_MATRIX].bytes)
    words = [f"{array} {content.variable} {digest(content.bytes)}" for array, content in sorted(contents.items())]
    return digest("\n".join(words).encode())


def _read_in_turn(contents: Mapping[str, _Content], is_graph: bool) -> Iterator[tuple[str, dict[str, Any]]]:
    """The name of each file, and what it and those before it hold."""
    arrays: dict[str, Any] = {}
    for array, (name, content, variable) in contents.items():
        if array in arrays:
            first = contents[_MATRIX].name
            raise SceneError(f"system.path: expected `{array}` in one file, got it in {first} too; remove one")
        if is_graph:
            with _naming(_PATH, name, "a graph"):
                arrays = graph_of(content, BY_BLOCK)
        elif array == _MATRIX:
            with _naming(_PATH, name, "K"):
                arrays = arrays_of(content, BY_BLOCK, variable=variable)
        else:
            with _naming(f"{_PATH}.{array}", name, array):
                arrays |= arrays_of(content, (), array, variable)
        yield name, arrays


def look_at_series(key: str, table: Mapping[str, Any], folder: Path, t_end: object) -> dict[str, Any]:
    """The table of a `Measured`, with what its file holds; `key` is what errors begin with.

    Raises `SceneError` if the file cannot be read, or does not hold times that increase, from 0 to the end of the
    runs, `t_end` if that is a number, and values.
    """
    name, columns = table["table"], table.get("columns", [])
    content = content_of(folder / name, key)
    times, values = read_series(key, name, content, columns)
    if not (np.diff(times) > 0).all():
        k = int(np.argmin(np.diff(times) > 0))
        raise SceneError(
            f"{key}: {name}: expected times that increase, got {times[k + 1]:.15g} after {times[k]:.15g} in row"
            f" {k + 2} of the numbers; leave one out"
        )
    last = t_end if isinstance(t_end, int | float) else float(times[-1])
    for time, value, is_short in ((0.0, values[0], times[0] > 0.0), (last, values[-1], times[-1] < last)):
        if is_short:
            rest = f" take `t_end = {times[-1]:.15g}`, or" if time else " subtract the first from all, or"
            raise SceneError(
                f"{key}: {name}: expected values from 0 to t_end = {last:.15g}, got them from {times[0]:.15g} to"
                f" {times[-1]:.15g};{rest} say what it is there by a row, as {time:.15g}, {value:.15g} for a constant"
            )
    facts = {"sha256": digest(content), "n": len(times), "extremes": [float(values.min()), float(values.max())]}
    return {**table, "series": facts}


@lru_cache(maxsize=4)
def read_measured(value: Measured) -> Piecewise:
    """The series of a file, as it was when the scene was read.

    Raises `SceneError` if it is gone, or another.
    """
    content = content_of(Path(value.at), value.table)
    if digest(content) != value.sha256:
        raise SceneError(
            f"{value.table}: expected {value.at} as it was when the scene was read (sha256 {value.sha256[:12]}), got"
            " another; restore the file, or run the scene with it into another directory"
        )
    return Piecewise(*read_series(value.table, value.at, content, value.columns))


@contextlib.contextmanager
def _naming(key: str, name: str, what: str) -> Iterator[None]:
    """Within: what goes wrong with a file is a `SceneError` with its name, and with what it was to hold."""
    try:
        yield
    except OtherKind as error:
        also = 'write coupling = "graph", which reads it, or ' * error.kind.is_graph
        raise SceneError(
            f"{key}: {name}: expected {FORMATS} of {what}, got {error}; {also}convert it"
            f" in Python, and name what that writes: {error.line(name)}"
        ) from None
    except Exception as error:  # readers raise a dozen kinds of errors for damaged files, which no list names
        if what == "a graph":
            raise SceneError(
                f"{key}: {name}: expected a graph: rows i, j and perhaps a weight, GraphML, or an adjacency"
                f" matrix as .npz, .npy, Matrix Market or CSV ({_line(error)}); correct the file, or the path"
            ) from error
        raise SceneError(
            f"{key}: {name}: expected {FORMATS} of {what} ({_line(error)}); correct the file, or the path"
        ) from error


def read_series(key: str, name: str, content: bytes, columns: Sequence[str | int] = ()) -> tuple[Any, Any]:
    """Two rows of numbers of one length, shape (k,) each, that a file holds; `key` is what errors begin with.

    Raises `SceneError` if it does not.
    """
    with _naming(key, name, "two columns of numbers"):
        return series_of(content, columns)


def read_friction_table(name: str, folder: Path) -> dict[str, list[float]]:
    """The columns of a file beside a scene, of `speeds` of slip and `coefficients` of friction.

    Raises `SceneError` if the file cannot be read, or does not hold two columns of numbers.
    """
    content = content_of(folder / name, _TABLE)
    if len(content) > _MOST_OF_TABLE:
        raise SceneError(
            f"{_TABLE}: expected at most {_MOST_OF_TABLE} bytes in {name}, got {len(content)}; leave out values"
        )
    speeds, coefficients = read_series(_TABLE, name, content)
    return {"speeds": speeds.tolist(), "coefficients": coefficients.tolist()}


def _line(error: Exception) -> str:
    """The message of an error, in a line."""
    why = printable(" ".join(str(error).split())) or type(error).__name__
    return why if len(why) < 300 else f"{why[:297]}..."  # it may show an array


def _checked(contents: Mapping[str, _Content], is_graph: bool) -> dict[str, Any]:
    """What a scene says of a file that was read, and of more with it, as plain values."""
    for file, arrays in _read_in_turn(contents, is_graph):  # what does not fit is of the last one
        make = partial(System.from_graph, arrays["edges"]) if is_graph else partial(System, arrays["stiffness"])
        try:
            checked = make(**{"damping": 0.0} | {k: arrays[k] for k in OF_BLOCKS if k in arrays})
            for key in ("z0", "w0"):
                per_block(key, arrays.get(key, 0.0), checked.n)
            names = named(arrays.get(NAMES, ()), checked.n)
        except (TypeError, ValueError, MemoryError) as error:
            raise SceneError(f"system.path: {file}: {_line(error)}") from None
    return {
        "sha256": _digest(contents),
        "n": checked.n,
        "scale": float(abs(checked.stiffness).max()),
        "entries": checked.stiffness.size,
        "is_sparse": not isinstance(checked.stiffness, np.ndarray),
        "arrays": [key for key in BY_BLOCK if key in arrays],
        "version": 3 if REALISATION in arrays.get("parameters", {}) else 2,
        **({"parameters": arrays["parameters"]} if "parameters" in arrays else {}),
        **({NAMES: [*names]} if names else {}),
        **({"variable": variable} if (variable := contents[_MATRIX].variable) else {}),
    }


def is_path(path: object) -> TypeGuard[str | dict[str, str]]:
    """Whether something names files as `look_at_files` takes them; what does not is refused later."""
    if not isinstance(path, dict):
        return isinstance(path, str)
    return "stiffness" in path and all(isinstance(file, str) for file in path.values()) and {*path} <= _PARTS


def split(path: str, folder: Path) -> tuple[str, str]:
    """The file and the variable that a scene names, as in "model.mat:K"; "" if it names a file alone."""
    file, _, variable = path.rpartition(":")
    return (file, variable) if file and variable.isidentifier() and not (folder / path).exists() else (path, "")


def look_at_files(
    path: str | Mapping[str, str], folder: Path, table: Mapping[str, Any], is_graph: bool = False
) -> dict[str, dict[str, Any]]:
    """Digest and facts of each file that a pattern matches, by its name beside the scene, as plain values.

    From then on the scene can be read without them, and a changed file makes another scene. `path` may name one file
    for each of several arrays; `table` is that of [system]. Raises `SceneError` if there is no such file, it holds no
    system, or blocks have other names there, or if nothing says what the damping beside a K is.
    """
    paths = {"stiffness": path} if isinstance(path, str) else dict(path)
    file_of_k = paths.pop("stiffness")
    pattern, variable = (file_of_k, "") if is_graph else split(file_of_k, folder)
    files = [folder / pattern] if os.path.isfile(folder / pattern) else _matching(folder, pattern)
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
    others, keys = {}, {}
    for array, other in paths.items():
        name, of_other = split(other, folder)
        keys[array] = [name, of_other]
        others[array] = _Content(name, content_of(folder / name, f"{_PATH}.{array}"), of_other)
    facts = {}
    for name, file in zip(names, files, strict=True):
        contents = {_MATRIX: _Content(str(file), content_of(file, _PATH), variable), **others}
        facts[name] = _checked(contents, is_graph) | ({"others": keys} if keys else {})
        if not (is_graph or "damping" in facts[name]["arrays"] or {"damping", "rho", "rayleigh"} & {*table}):
            raise SceneError(
                f"system.damping: expected that of the blocks whose K is in {name}, found none there; add `damping ="
                ' 0.0`, or `rayleigh = [a, b]`, its file, as path = {stiffness = "K.csv", damping = "C.csv"}, or'
                " `rho = 3.5`, which draws it"
            )
        for content in () if is_graph else contents.values():
            _check_headings(content, table[NAMES] if isinstance(table.get(NAMES), list) else ())
    return facts


def _check_headings(content: _Content, names: Sequence[object]) -> None:
    """Refuse names of blocks that are not those by which a text of numbers calls its rows or columns."""
    for labels in Text(content.bytes).labels if names and reader_of(content.bytes) is Text else ():
        if len(labels) == len(names) and all(re.fullmatch(PATTERN, label) for label in labels):
            for k, (label, name) in enumerate(zip(labels, names, strict=True)):
                if label != name:
                    raise SceneError(
                        f"system.names: expected {label!r} for block {k}, as {Path(content.name).name} calls it, got"
                        f" {shown(name)}; write names in the order of the file, or take its headings away"
                    )


def _matching(folder: Path, pattern: str) -> list[Path]:
    """The files that a pattern names; `*`, `?` and `[` stand for parts of names that do not begin with a dot."""
    if "**" in pattern:
        raise SceneError(f"system.path: expected no **, got {shown(pattern)}; write * for each folder of the path")
    places, n_seen = [folder], 0
    for word in Path(pattern).parts:
        if not glob.has_magic(word):
            places = [place / word for place in places]
            continue
        entries = [place / name for place in places for name in _names(place)]
        places = [place for place in entries if fnmatch.fnmatch(place.name, word) and place.name[0] != "."]
        n_seen += len(entries)
        if n_seen > _MAX_ENTRIES or len(places) > MAX_FILES:
            raise SceneError(
                f"system.path: expected at most {MAX_FILES} files, among {_MAX_ENTRIES} names, got more, by"
                f" {shown(pattern)}; narrow it"
            )
    return sorted(filter(os.path.isfile, places))


def _names(folder: Path) -> list[str]:
    """Names in a folder, no more than one beyond what is looked at; none if it cannot be read."""
    try:
        with os.scandir(folder) as entries:
            return [entry.name for entry in islice(entries, _MAX_ENTRIES + 1)]
    except OSError:
        return []


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
        # what `Scales.of` takes of it
        "means": {
            "mass": float(system.mass.mean()),
            "stiffness": float(np.mean(stiffness.diagonal())),
            "friction": float(system.friction.mean()),
        },
    }


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
