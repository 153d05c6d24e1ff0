"""What the bytes of a file beside a scene hold: a matrix with arrays by block, or what changes in time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stickslip.pipeline.scene.readers import reader_of
from stickslip.pipeline.scene.readers.reader import Reader, in_child
from stickslip.pipeline.scene.readers.text import Text
from stickslip.sim.numerics.sparse import is_sparse

#: The array of texts that names blocks.
NAMES = "names"
#: What mechanics calls some arrays.
SYMBOLS = {"K": "stiffness", "C": "damping", "M": "mass"}
#: What to do with a text of two or three columns.
_EDGES = 'if it lists edges, coupling = "graph" reads it'
#: What of two arrays the times are called.
_TIMES = ("times", "time", "t")


def arrays_of(content: bytes, names: Sequence[str], matrix: str = "stiffness", variable: str = "") -> dict[str, Any]:
    """The arrays that a system file holds, by name: its matrix, dense or sparse, and some of those in `names`.

    Numbers beside them are `parameters`, by name, and texts by the name `NAMES` those of the blocks. Without `names`
    the matrix is all that is read, and a `variable` is what the file calls it.

    Raises `OtherKind` if it is a file of another kind that K can be read from; `ValueError` if it is no such file, or
    does not hold what it claims; `Exception` if it is damaged.
    """
    reader = reader_of(content)
    task = _arrays, reader, content, tuple(names), matrix, variable
    return in_child(*task) if reader.may_crash else _arrays(*task[1:])


def _arrays(kind: type[Reader], content: bytes, allowed: Sequence[str], matrix: str, variable: str) -> dict[str, Any]:
    reader = kind(content)
    there = ", ".join(name or "a matrix without a name" for name in reader.names) or "nothing"
    if variable and variable not in reader.names:
        raise ValueError(
            f"expected an array {variable!r}, got {there if any(reader.names) else 'one without a name'}"
        )
    if variable:
        return {matrix: _shaped(matrix, reader.read(variable))}
    texts = {NAMES: reader.texts(NAMES)} if NAMES in reader.names and allowed else {}
    names = [name for name in reader.names if name not in texts]
    if len(names) == 1:
        array = _shaped(matrix, reader.read(names[0]))
        is_square = array.shape in ((1,), array.shape[-1:] * 2)
        if kind is Text and matrix == "stiffness" and not is_square and array.shape[-1] <= 3:
            raise ValueError(f"expected a square matrix, got the shape {array.shape}; {_EDGES}")
        return texts | {matrix: array}
    called = {SYMBOLS.get(name, name) or matrix: name for name in names}
    if len(called) < len(names):
        raise ValueError(f"expected each array once, got {there}; remove one")
    others = called.keys() - {matrix}
    strange = sorted(others - {*allowed}) if allowed else []
    numbers = {name: reader.number(called[name]) for name in strange if name.isidentifier()}
    parameters = {name: number for name, number in numbers.items() if number is not None}
    if matrix not in called or {*strange} - parameters.keys():
        symbol = next((f" or `{symbol}`" for symbol, name in SYMBOLS.items() if name == matrix), "")
        also = f", and of {', '.join(allowed)}, and numbers by other names" if allowed else ""
        raise ValueError(
            f"expected an array `{matrix}`{symbol}, or a sparse matrix as scipy.sparse.save_npz writes it{also}, got"
            f' {there}; save these alone, or say which by a name after a colon, as in {matrix} = "file:K"'
        )
    values: dict[str, Any] = {matrix: _shaped(matrix, reader.read(called[matrix]))}
    beside = sorted(others - {*strange}) if allowed else ()
    arrays = {name: _shaped(name, reader.read(called[name])) for name in beside}
    return arrays | texts | values | ({"parameters": parameters} if parameters else {})


def _shaped(name: str, array: Any) -> Any:
    """An array as `System` takes it: a mass matrix as its diagonal; all but masses and dampings as they are."""
    if name != "mass" or array.ndim < 2:
        return array
    if array.shape[0] == array.shape[1]:
        diagonal = array.diagonal()
        off = (array.toarray() if is_sparse(array) else array) - np.diag(diagonal)
        if not abs(off).max() > 0.0:
            return np.asarray(diagonal, dtype=np.float64)
        row, column = (int(k[0]) for k in off.nonzero())
        raise ValueError(
            f"mass: expected a mass for each block, or a diagonal matrix, got {off[row, column]:g} at row {row + 1},"
            f" column {column + 1}; lump it, as by M.sum(axis=1)"
        )
    raise ValueError(f"mass: expected a mass for each block, or a diagonal matrix, got the shape {array.shape}")


def series_of(content: bytes, columns: Sequence[str | int] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Two rows of numbers of one length that a file holds, as times and values, shape (k,) each.

    Text has two columns, or more with `columns` that name two; other files an array of two columns or two arrays.

    Raises as `arrays_of`.
    """
    reader = reader_of(content)
    task = _series, reader, content, tuple(columns)
    first, second = in_child(*task) if reader.may_crash else _series(*task[1:])
    return first, second


def _series(kind: type[Reader], content: bytes, columns: Sequence[str | int]) -> tuple[np.ndarray, np.ndarray]:
    reader = kind(content)
    names = [*reader.names]
    if not columns and len(names) > 1:
        times = [name for name in names if name in _TIMES]
        if len(names) > 2 or len(times) != 1:
            raise ValueError(f'expected two arrays, got {", ".join(names)}; name two, as columns = ["t", "v"]')
        columns = (*times, *(name for name in names if name not in times))
    rows = reader.columns(columns)
    if len(rows) != 2:
        raise ValueError(f'expected two columns, got {len(rows)}; name two, as columns = ["t", "v"]')
    first, second = (np.asarray(row, dtype=np.float64) for row in rows)
    if len(first) != len(second):
        raise ValueError(f"expected as many times as values, got {len(first)} and {len(second)}")
    return first, second
