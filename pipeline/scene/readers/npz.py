"""NumPy's .npy and .npz, and SciPy's sparse .npz."""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from stickslip.pipeline.scene.readers.entries import of_entries
from stickslip.pipeline.scene.readers.reader import BYTES_OF_ENTRY, Reader, check_whole, fits, square

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

#: Bytes that an array may always have, and how many times those that it takes in a compressed file: by more shrinks
#: only what is nothing but zeros.
_SMALL, _RATIO = 2**28, 100


class Npy(Reader):
    """One array, without a name."""

    name, magic = "an .npy", b"\x93NUMPY"

    def read(self, name: str, n_most: int | None = None) -> np.ndarray:
        """The array."""
        return _npy("stiffness", io.BytesIO(self._content), len(self._content))


class Npz(Reader):
    """Several arrays, of which a sparse matrix takes up some."""

    name, magic = "an .npz", b"PK"

    def __init__(self, content: bytes) -> None:
        super().__init__(content)
        self._archive = zipfile.ZipFile(io.BytesIO(content))
        self._members: dict[str, zipfile.ZipInfo] = {}
        for info in self._archive.infolist():
            key = info.filename.removesuffix(".npy")
            if key in self._members:
                raise ValueError(f"expected each array once, got {key!r} twice")
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{key}: expected a compression that NumPy writes, got number {info.compress_type}")
            self._members[key] = info
        self._form = _format(self._array("format", "S", 1)) if self._members.keys() >= _SPARSE else ""
        if self._form and not self._members.keys() >= {*_PLACES[self._form]}:
            self._form = ""

    @property
    def names(self) -> Sequence[str]:
        """The names of its arrays; "" is that of the sparse matrix."""
        if not self._form:
            return [*self._members]
        parts = {*_SPARSE, *_PLACES[self._form], "_is_array"}
        return ["", *(name for name in self._members if name not in parts)]

    def read(self, name: str, n_most: int | None = None) -> Any:
        """An array, or the sparse matrix."""
        if name:
            return self._array(name, "iuf", n_most)
        n = square(self._array("shape", "i", 2).tolist())
        places = {
            key: self._array(key, "i", 2 * n if key in ("indptr", "offsets") else None) for key in _PLACES[self._form]
        }
        return _sparse(self._form, self._array("data"), places, n)

    def number(self, name: str) -> float | None:
        """A single number by its name; None if there are several."""
        if self._members[name].file_size > _MAX_HEADER + 16:
            return None
        array = self._array(name)
        return float(array.item()) if array.size == 1 else None

    def texts(self, name: str) -> list[str]:
        """A list of texts by its name."""
        texts: list[str] = self._array(name, "U").ravel().tolist()
        return texts

    def _array(self, key: str, kinds: str = "iuf", n_most: int | None = None) -> np.ndarray:
        size = self._members[key].file_size
        if n_most is not None and size > 16 * n_most + _MAX_HEADER:
            raise ValueError(f"{key}: expected at most {n_most} of them, got {size} bytes")
        limit = max(_SMALL, _RATIO * self._members[key].compress_size)
        if size > limit:
            raise ValueError(
                f"{key}: expected at most {limit / 1e6:.0f} MB in {self._members[key].compress_size} bytes, got"
                f" {size / 1e6:.0f} MB; save a sparse K, by scipy.sparse.save_npz"
            )
        with self._archive.open(self._members[key]) as stream:
            return _npy(key, stream, size, kinds)


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
    fits(name, math.prod(shape) * max(BYTES_OF_ENTRY, 3 * kind.itemsize))
    array = np.frombuffer(stream.read(), kind).reshape(shape, order="F" if is_fortran else "C")
    check_whole(name, array)
    return array


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
        return of_entries(row, column, data, n, None, "entry {}".format)
    indices, indptr = places.values()
    if indptr[-1] != data.size:
        raise ValueError(f"indptr: expected {data.size} at its end, the number of entries, got {indptr[-1]}")
    return {"csc": sparse.csc_array, "csr": sparse.csr_array}[form]((data, indices, indptr), (n, n))


def _by_diagonals(data: np.ndarray, offsets: np.ndarray, n: int) -> Any:
    """A sparse matrix from its diagonals, whose entries lie under their column."""
    from scipy import sparse  # as below

    if data.ndim != 2 or offsets.shape != data.shape[:1]:
        raise ValueError(f"offsets: expected one for each row of data, shape {data.shape}, got {offsets.shape}")
    if len(np.unique(offsets)) != len(offsets):
        raise ValueError("offsets: expected each diagonal once, got one twice")
    return sparse.dia_array((data, offsets), (n, n)).tocsc()
