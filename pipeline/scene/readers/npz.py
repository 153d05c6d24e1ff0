"""NumPy's .npy and .npz, and SciPy's sparse .npz, by their own readers."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from stickslip.pipeline.scene.readers.reader import Reader, check_whole, fits, square

#: What `scipy.sparse.save_npz` writes of every sparse matrix, and where entries stand.
_SPARSE = {"data", "shape", "format"}
_PLACES = {"indices", "indptr", "row", "col", "offsets"}
#: The formats of sparse matrices that are read: SciPy checks, or `System` does, where their entries stand.
_FORMATS = (b"csc", b"csr", b"coo", b"dia")

#: Bytes that an array may always have, and how many times those that it takes in a compressed file: by more shrinks
#: only what is nothing but zeros.
_SMALL, _RATIO = 2**28, 100
#: Copies of what is read: the file's, `System`'s and a kernel's.
_COPIES = 3


class Npy(Reader):
    """One array, without a name."""

    name, magic = "an .npy", b"\x93NUMPY"

    def read(self, name: str) -> np.ndarray:
        """The array."""
        fits("stiffness", _COPIES * len(self._content))
        stream = io.BytesIO(self._content)
        array = np.load(stream)
        if stream.read(1):
            raise ValueError(f"stiffness: expected the shape {array.shape} to take all bytes, got more")
        return _numbers("stiffness", array)


class Npz(Reader):
    """Several arrays, of which a sparse matrix takes up some."""

    name, magic = "an .npz", b"PK"

    def __init__(self, content: bytes) -> None:
        super().__init__(content)
        self._arrays = np.load(io.BytesIO(content))
        self._sizes: dict[str, int] = {}
        for info in self._arrays.zip.infolist():
            key = info.filename.removesuffix(".npy")
            limit = max(_SMALL, _RATIO * info.compress_size)
            if key in self._sizes:
                raise ValueError(f"expected each array once, got {key!r} twice")
            if info.file_size > limit:
                raise ValueError(
                    f"{key}: expected at most {limit / 1e6:.0f} MB in {info.compress_size} bytes, got"
                    f" {info.file_size / 1e6:.0f} MB; save a sparse K, by scipy.sparse.save_npz"
                )
            self._sizes[key] = info.file_size
        self._is_sparse = self._sizes.keys() >= _SPARSE

    @property
    def names(self) -> Sequence[str]:
        """The names of its arrays; "" is that of the sparse matrix."""
        if not self._is_sparse:
            return [*self._sizes]
        return ["", *(name for name in self._sizes if name not in _SPARSE | _PLACES | {"_is_array"})]

    def read(self, name: str) -> Any:
        """An array, or the sparse matrix."""
        if name:
            return _numbers(name, self._array(name))
        from scipy import sparse  # takes a tenth of a second to load

        fits("stiffness", _COPIES * sum(self._sizes.values()))
        shape, form = (self._array(key) for key in ("shape", "format"))
        square(shape.tolist() if shape.size == 2 else [])
        if form.item() not in _FORMATS:
            known = ", ".join(name.decode() for name in _FORMATS)
            raise ValueError(f"format: expected one of {known}, got {form.item()!r}; save K.tocsc()")
        for key in sorted(_PLACES & self._sizes.keys()):
            if (kind := self._array(key).dtype).kind not in "iu":  # SciPy takes True for 1
                raise ValueError(f"{key}: expected integers, got an array of type {kind}; save K.tocsc()")
        matrix = sparse.load_npz(io.BytesIO(self._content))  # that indices are in range is for `System` to see
        _numbers("data", matrix.data)
        return matrix if form.item() in _FORMATS[:2] else matrix.tocsc()

    def texts(self, name: str) -> list[str]:
        """A list of texts by its name."""
        array = self._array(name)
        if array.dtype.kind != "U":
            raise ValueError(f"{name}: expected an array of text, got one of type {array.dtype}")
        texts: list[str] = array.ravel().tolist()
        return texts

    def _array(self, key: str) -> np.ndarray:
        fits(key, _COPIES * self._sizes[key])
        array = self._arrays[key]
        if not isinstance(array, np.ndarray):
            raise ValueError(f"{key}: expected an array, got something else")
        return array


def _numbers(name: str, array: np.ndarray) -> np.ndarray:
    """Real numbers."""
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name}: expected an array of real numbers, got one of type {array.dtype}")
    check_whole(name, array)
    return array
