"""What the bytes of a system file hold: NumPy's .npy and .npz, SciPy's sparse .npz, Matrix Market.

A file may come from anywhere, and be damaged. The sizes that it claims are compared with the bytes that are there and
with the memory of this machine before anything of that size is allocated, and pickles are never loaded.
"""

from __future__ import annotations

import io
import math
import re
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from stickslip.pipeline.machine.memory import lack
from stickslip.pipeline.scene.other_files import OtherKind, kind_of
from stickslip.pipeline.scene.toml import MAX_BLOCKS

#: The array of texts that names blocks.
NAMES = "names"

#: What `scipy.sparse.save_npz` writes of every sparse matrix.
_SPARSE = {"data", "shape", "format"}
#: What it writes besides, by the format: where the entries stand.
_PLACES = {
    "csc": ("indices", "indptr"),
    "csr": ("indices", "indptr"),
    "coo": ("row", "col"),
    "dia": ("offsets",),
}

#: Longest header that Python's parser is given; that of an array of numbers is shorter.
_MAX_HEADER = 1000

#: Bytes for each entry of a dense array of at most eight bytes a number: the file's, `System`'s and a kernel's copy.
_BYTES_OF_ENTRY = 24

#: Bytes that an array may always have, and how many times those that it takes in a compressed file: by more shrinks
#: only what is nothing but zeros.
_SMALL, _RATIO = 2**28, 100

#: The largest whole number up to which float64 has all.
_MOST_WHOLE = 2**53

#: A number of Matrix Market as NumPy's parser of text is to read it.
_FIELDS = {"real": "f8", "double": "f8", "integer": "i8", "unsigned-integer": "u8"}
#: The factor from an entry to the one across the diagonal; None: the file has both.
_SYMMETRIES = {"general": None, "symmetric": 1, "skew-symmetric": -1}


def arrays_of(content: bytes, names: Sequence[str], matrix: str = "stiffness") -> dict[str, Any]:
    """The arrays that a system file holds, by name: its matrix, dense or sparse, and some of those in `names`.

    Numbers beside them are `parameters`, by name, and texts by the name `NAMES` those of the blocks.

    The readers of Python and NumPy raise exceptions of many kinds for damaged files; none of them crashes. Raises
    `OtherKind` if it is a file of another kind that K can be read from; `ValueError` if it is no such file, or does
    not hold what it claims; `Exception` if it is damaged.
    """
    readers = {b"PK": _npz, b"\x93NUMPY": _npy_alone, b"%%MatrixMarket": _matrix_market}
    kind = kind_of(content)
    if kind is not None:
        raise OtherKind(kind)
    for magic, reader in readers.items():
        if content.startswith(magic):
            return reader(content, names, matrix)
    raise ValueError("something else" if content else "it is empty")


def _npy_alone(content: bytes, _: Sequence[str], matrix: str) -> dict[str, Any]:
    return {matrix: _npy(matrix, io.BytesIO(content), len(content))}


def _npy(name: str, stream: IO[bytes], size: int, kinds: str = "iuf") -> np.ndarray:
    """The array of an .npy file of `size` bytes."""
    version = npy.read_magic(stream)
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    if version not in readers:  # the third is for names of fields
        raise ValueError(f"{name}: expected version 1 or 2 of the format .npy, got {version[0]}.{version[1]}")
    with warnings.catch_warnings(action="error"):  # of a header that NumPy would guess at
        shape, is_fortran, kind = readers[version](stream, max_header_size=_MAX_HEADER)
    if kind.kind not in kinds:
        raise ValueError(
            f"{name}: expected an array of {'text' if kinds in 'SU' else 'real numbers'}, got one of"
            f" type {kind}; pickles are not read"
        )
    claimed, n_bytes = math.prod(shape) * kind.itemsize, size - stream.tell()
    if min(shape, default=0) < 0 or claimed != n_bytes:
        raise ValueError(f"{name}: expected {claimed} bytes, for the shape {shape} of {kind}, got {n_bytes}")
    _fits(name, math.prod(shape) * max(_BYTES_OF_ENTRY, 3 * kind.itemsize))
    array = np.frombuffer(stream.read(), kind).reshape(shape, order="F" if is_fortran else "C")
    _check_whole(name, array)
    return array


def _check_whole(name: str, array: np.ndarray) -> None:
    """Refuse whole numbers that change where they become the numbers of a matrix."""
    if array.dtype.kind in "iu" and array.size and max(int(array.max()), -int(array.min())) > _MOST_WHOLE:
        raise ValueError(
            f"{name}: expected whole numbers up to 2^53, which float64 has, got larger ones; save floats"
        )


def _fits(name: str, needed: int) -> None:
    problem = lack(needed, "an array that takes")
    if problem:
        raise ValueError(f"{name}: {problem}")


def _npz(content: bytes, allowed: Sequence[str], matrix: str) -> dict[str, Any]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members: dict[str, zipfile.ZipInfo] = {}
        for info in archive.infolist():
            key = info.filename.removesuffix(".npy")
            if key in members:
                raise ValueError(f"expected each array once, got {key!r} twice")
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{key}: expected a compression that NumPy writes, got number {info.compress_type}")
            members[key] = info

        def read(key: str, kinds: str = "iuf", n_most: int | None = None) -> np.ndarray:
            size = members[key].file_size
            if n_most is not None and size > 16 * n_most + _MAX_HEADER:
                raise ValueError(f"{key}: expected at most {n_most} of them, got {size} bytes")
            limit = max(_SMALL, _RATIO * members[key].compress_size)
            if size > limit:
                raise ValueError(
                    f"{key}: expected at most {limit / 1e6:.0f} MB in {members[key].compress_size} bytes, got"
                    f" {size / 1e6:.0f} MB; save a sparse K, by scipy.sparse.save_npz"
                )
            with archive.open(members[key]) as stream:
                return _npy(key, stream, size, kinds)

        texts = {NAMES: read(NAMES, "U").ravel().tolist()} if NAMES in members else {}
        members.pop(NAMES, None)
        if len(members) == 1:
            return texts | {matrix: read(next(iter(members)))}
        form = _format(read("format", "S", 1)) if members.keys() >= _SPARSE else ""
        is_sparse = members.keys() >= {*_PLACES[form]} if form else False
        names = members.keys() - ({*_SPARSE, *_PLACES[form], "_is_array"} if is_sparse else {matrix})
        parameter_names = [name for name in sorted(names - {*allowed}) if name.isidentifier()]
        numbers = {name: read(name) for name in parameter_names if members[name].file_size <= _MAX_HEADER + 16}
        parameters = {name: float(number.item()) for name, number in numbers.items() if number.size == 1}
        names -= parameters.keys()
        if not names <= {*allowed} or not (is_sparse or matrix in members):
            raise ValueError(
                f"expected an array `{matrix}`, or a sparse matrix as scipy.sparse.save_npz writes it, and of "
                f"{', '.join(allowed)}, and numbers by other names, got {', '.join(sorted(members)) or 'nothing'}"
            )
        if is_sparse:
            n = _square(read("shape", "i", 2).tolist())
            places = {key: read(key, "i", 2 * n if key in ("indptr", "offsets") else None) for key in _PLACES[form]}
            stiffness = _sparse(form, read("data"), places, n)
        else:
            stiffness = read(matrix)
            n = max(stiffness.shape, default=1)
        arrays: dict[str, Any] = {
            name: read(name, n_most=n * n if name == "damping" else n) for name in sorted(names)
        }
        return arrays | texts | {matrix: stiffness} | ({"parameters": parameters} if parameters else {})


def _format(array: np.ndarray) -> str:
    """The format that a sparse matrix was saved in."""
    form: str = array.item().decode("ascii", "replace")
    if form not in _PLACES:
        raise ValueError(f"format: expected one of {', '.join(_PLACES)}, got {form}; save K.tocsc()")
    return form


def _sparse(form: str, data: np.ndarray, places: Mapping[str, np.ndarray], n: int) -> Any:
    """A sparse matrix from its parts; that indices are in range is for `System` to see, wherever a K comes from."""
    from scipy import sparse  # takes a tenth of a second to load

    if form == "dia":
        return _by_diagonals(data, places["offsets"], n)
    for key, array in (("data", data), *places.items()):
        expected = (n + 1,) if key == "indptr" else (data.size,)
        if array.shape != expected:
            raise ValueError(f"{key}: expected the shape {expected}, got {array.shape}")
    if form == "coo":
        row, column = (place.astype(np.int64) + 1 for place in places.values())
        return _of_entries(row, column, data, n, None, "entry {}".format)
    indices, indptr = places.values()
    if indptr[-1] != data.size:
        raise ValueError(f"indptr: expected {data.size} at its end, the number of entries, got {indptr[-1]}")
    return {"csc": sparse.csc_array, "csr": sparse.csr_array}[form]((data, indices, indptr), (n, n))


def _by_diagonals(data: np.ndarray, offsets: np.ndarray, n: int) -> Any:
    """A sparse matrix from its diagonals, whose entries lie under their column."""
    from scipy import sparse  # as above

    if data.ndim != 2 or offsets.shape != data.shape[:1]:
        raise ValueError(f"offsets: expected one for each row of data, shape {data.shape}, got {offsets.shape}")
    if len(np.unique(offsets)) != len(offsets):
        raise ValueError("offsets: expected each diagonal once, got one twice")
    return sparse.dia_array((data, offsets), (n, n)).tocsc()


def _square(shape: Sequence[int]) -> int:
    """The number of blocks of a matrix of a shape, which has to be square."""
    if not isinstance(shape, list) or len(shape) != 2 or shape[0] != shape[1] or not 0 < shape[0] <= MAX_BLOCKS:
        raise ValueError(f"stiffness: expected a square matrix of at most {MAX_BLOCKS} blocks, got the shape {shape}")
    return shape[0]


def _matrix_market(content: bytes, _: Sequence[str], matrix: str) -> dict[str, Any]:
    """K of the format that math.nist.gov/MatrixMarket/formats.html describes.

    SciPy's reader, in compiled code of its own, can crash on what is damaged; NumPy's parser of text does not.
    """
    lines = io.BytesIO(content)
    banner = lines.readline(_MAX_HEADER).decode("ascii").lower().split()
    match banner:
        case ["%%matrixmarket", "matrix", "coordinate" | "array" as layout, field, symmetry] if (
            field in _FIELDS and symmetry in _SYMMETRIES
        ):
            pass
        case _:
            raise ValueError(
                f"expected `%%MatrixMarket matrix`, coordinate or array, {', '.join(_FIELDS)}, and"
                f" {', '.join(_SYMMETRIES)}, got {' '.join(banner)!r}"
            )
    head = next((line for line in lines if line.strip() and not line.startswith(b"%")), b"")
    if not re.fullmatch(rb"(\s*\d{1,15}){%d}\s*" % (3 if layout == "coordinate" else 2), head):
        raise ValueError(f"expected a line of the sizes of the matrix, got {head[:60]!r}")
    *shape, entries = map(int, head.split()) if layout == "coordinate" else (*map(int, head.split()), -1)
    n, sign = _square(shape), _SYMMETRIES[symmetry]
    below = int(sign == -1)  # a skew one has no diagonal
    if layout == "array":
        entries = n * n if sign is None else (n - below) * (n + 1 - below) // 2
    columns = ("row", "column") if layout == "coordinate" else ()
    kind = np.dtype([*((name, "i8") for name in columns), ("value", _FIELDS[field])])
    begin, body = lines.tell(), lines.read()
    table = np.empty(0, kind)
    if body.strip():
        with warnings.catch_warnings(action="error"):  # of a number that NumPy would round
            table = np.loadtxt(io.BytesIO(body), kind, None, encoding="ascii", ndmin=1)
    if table.size != entries:
        raise ValueError(f"expected {entries} entries, as its line of sizes says, got {table.size}")
    _check_whole("stiffness", table["value"])
    values = table["value"].astype(np.float64)
    if layout == "coordinate":

        def line(entry: int) -> str:
            filled = [k for k, text in enumerate(body.splitlines()) if text.strip()]
            above = len(content[:begin].splitlines())
            return f"line {above + 1 + filled[entry]}"

        return {matrix: _of_entries(table["row"], table["column"], values, n, sign, line)}
    _fits("stiffness", _BYTES_OF_ENTRY * n * n)
    if sign is None:
        return {matrix: values.reshape((n, n), order="F")}
    column, row = np.triu_indices(n, below)  # by columns, from the diagonal down
    stiffness = np.zeros((n, n))
    stiffness[row, column], stiffness[column, row] = values, sign * values
    return {matrix: stiffness}


def _of_entries(
    row: np.ndarray,
    column: np.ndarray,
    values: np.ndarray,
    n: int,
    sign: int | None,
    where: Callable[[int], str],
) -> Any:
    """A sparse matrix from its entries, whose rows and columns count from one; `where` says where an entry stands."""
    from scipy import sparse  # as above

    outside = (np.minimum(row, column) < 1) | (np.maximum(row, column) > n)
    if outside.any():
        k = int(np.argmax(outside))
        raise ValueError(f"expected rows and columns from 1 to {n}, got ({row[k]}, {column[k]}) at {where(k)}")
    row, column = row - 1, column - 1
    if sign is not None:
        across = row != column
        if sign == -1 and not across.all():
            k = int(np.argmin(across))
            raise ValueError(f"expected no entry on the diagonal of a skew-symmetric matrix, got one at {where(k)}")
        mirrored = np.isin(row * n + column, column[across] * n + row[across])
        if mirrored.any():
            k = int(np.flatnonzero(mirrored)[-1])
            raise ValueError(
                f"expected one triangle of a symmetric matrix, got ({row[k] + 1}, {column[k] + 1}) at {where(k)} and"
                f" ({column[k] + 1}, {row[k] + 1}) too; leave out one triangle, or write general in its first line"
            )
        row, column = np.concatenate([row, column[across]]), np.concatenate([column, row[across]])
        values = np.concatenate([values, sign * values[across]])
    return sparse.coo_array((values, (row, column)), (n, n))
