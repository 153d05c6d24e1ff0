"""MATLAB's .mat of versions 4 to 7, by SciPy's reader."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from stickslip.pipeline.scene.readers.reader import BYTES_OF_ENTRY, Reader, check_whole, fits

#: What MATLAB calls what is no array of numbers, in words.
_NO_NUMBERS = {
    "char": "text",
    "cell": "cells; save the matrix in them as a variable",
    "struct": "a struct; save its field as a variable",
    "object": "an object",
    "opaque": "an object, as a table or a string is; save table2array of it",
    "function": "a function",
    "logical": "truth values; save double of it",
}


class Mat(Reader):
    """Several variables, as MATLAB, Octave and `scipy.io.savemat` save them."""

    name, magic, may_crash = "a .mat", b"MATLAB 5", True

    def __init__(self, content: bytes) -> None:
        from scipy import io as files  # it takes a tenth of a second to load

        super().__init__(content)
        self._shapes = {name: (shape, kind) for name, shape, kind in files.whosmat(io.BytesIO(content))}

    @property
    def names(self) -> Sequence[str]:
        """The names of its variables."""
        return [*self._shapes]

    def read(self, name: str) -> Any:
        """A variable, dense or sparse."""
        shape, kind = self._shapes[name]
        if kind in _NO_NUMBERS:
            raise ValueError(f"{name}: expected an array of real numbers, got {_NO_NUMBERS[kind]}")
        if len(shape) > 2:
            raise ValueError(f"{name}: expected a row or a matrix, got the shape {shape}")
        if kind != "sparse":
            fits(name, BYTES_OF_ENTRY * math.prod(shape))
        array = self._load(name)
        if np.iscomplexobj(array):
            raise ValueError(f"{name}: expected real numbers, got complex ones; save real({name})")
        if kind == "sparse":
            return array.tocsc()
        check_whole(name, array)
        return array.reshape(-1) if 1 in shape else array

    def texts(self, name: str) -> list[str]:
        """The rows of a text, or the texts in cells."""
        if self._shapes[name][1] not in ("char", "cell"):
            raise ValueError(f"{name}: expected texts, got {self._shapes[name][1]}")
        return [str(np.asarray(text).item()).strip() for text in self._load(name).ravel()]

    def _load(self, name: str) -> Any:
        from scipy import io as files

        return files.loadmat(io.BytesIO(self._content), variable_names=[name])[name]
