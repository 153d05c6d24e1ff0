"""Matrix Market, as math.nist.gov/MatrixMarket/formats.html describes it."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from stickslip.pipeline.scene.readers.reader import BYTES_OF_ENTRY, Reader, check_whole, fits, square

#: A number of Matrix Market as NumPy's parser of text is to read it.
_FIELDS = {"real": "f8", "double": "f8", "integer": "i8", "unsigned-integer": "u8"}
#: The factor from an entry to the one across the diagonal; None: the file has both.
_SYMMETRIES = {"general": None, "symmetric": 1, "skew-symmetric": -1}
#: Longest first line that is read.
_MAX_BANNER = 1000


class MatrixMarket(Reader):
    """One matrix, without a name.

    SciPy's reader, in compiled code of its own, can crash on what is damaged; NumPy's parser of text does not.
    """

    name, magic = "Matrix Market", b"%%MatrixMarket"

    def read(self, name: str) -> Any:
        """The matrix, dense or sparse, as it is written."""
        content = self._content
        lines = io.BytesIO(content)
        banner = lines.readline(_MAX_BANNER).decode("ascii").lower().split()
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
        n, sign = square(shape), _SYMMETRIES[symmetry]
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
        check_whole("stiffness", table["value"])
        values = table["value"].astype(np.float64)
        if layout == "coordinate":

            def line(entry: int) -> str:
                filled = [k for k, text in enumerate(body.splitlines()) if text.strip()]
                above = len(content[:begin].splitlines())
                return f"line {above + 1 + filled[entry]}"

            return _of_entries(table["row"], table["column"], values, n, sign, line)
        fits("stiffness", BYTES_OF_ENTRY * n * n)
        if sign is None:
            return values.reshape((n, n), order="F")
        column, row = np.triu_indices(n, below)  # by columns, from the diagonal down
        stiffness = np.zeros((n, n))
        stiffness[row, column], stiffness[column, row] = values, sign * values
        return stiffness


def _of_entries(
    row: np.ndarray, column: np.ndarray, values: np.ndarray, n: int, sign: int | None, line: Callable[[int], str]
) -> Any:
    """A sparse matrix from its entries, whose rows and columns count from one; `line` says where an entry stands."""
    from scipy import sparse  # takes a tenth of a second to load

    outside = (np.minimum(row, column) < 1) | (np.maximum(row, column) > n)
    if outside.any():
        k = int(np.argmax(outside))
        raise ValueError(f"expected rows and columns from 1 to {n}, got ({row[k]}, {column[k]}) at {line(k)}")
    if sign is not None:
        across = row != column
        if sign == -1 and not across.all():
            k = int(np.argmin(across))
            raise ValueError(f"expected no entry on the diagonal of a skew-symmetric matrix, got one at {line(k)}")
        mirrored = np.isin(row * n + column, column[across] * n + row[across])
        if mirrored.any():
            k = int(np.flatnonzero(mirrored)[-1])
            raise ValueError(
                f"expected one triangle of a symmetric matrix, got ({row[k]}, {column[k]}) at {line(k)} and"
                f" ({column[k]}, {row[k]}) too; leave out one triangle, or write general in its first line"
            )
        row, column = np.concatenate([row, column[across]]), np.concatenate([column, row[across]])
        values = np.concatenate([values, sign * values[across]])
    return sparse.coo_array((values, (row - 1, column - 1)), (n, n))
