"""An answer as a MATLAB file: a variable a column, of numbers, of cells with texts, or of cells with lists."""

from __future__ import annotations

import io
import re

import numpy as np
import pyarrow as pa

from stickslip.pipeline import QueryError

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,62}")


def encoded(table: pa.Table) -> bytes:
    """The bytes of a file of version 5, which MATLAB, Octave and `scipy.io.loadmat` read.

    Null is NaN, and an empty text or list. Raises `QueryError` if a column has another type, or a name that MATLAB
    does not take, or is too large for this version.
    """
    from scipy import io as files  # it takes a tenth of a second to load

    for name in table.column_names:
        if not _NAME.fullmatch(name):
            raise QueryError(
                f"--format: expected columns with names of at most 63 letters, digits and underscores for mat, got"
                f" {name!r}; name it in the query, as in SELECT count(*) AS runs"
            )
    buffer = io.BytesIO()
    columns = {name: _column(name, table[name]) for name in table.column_names}
    try:
        files.savemat(buffer, columns, do_compression=True, oned_as="column")
    except files.matlab.MatWriteError as error:
        raise QueryError(f"--format: {error}; ask for less, or for parquet") from error
    return buffer.getvalue()


def _column(name: str, values: pa.ChunkedArray) -> np.ndarray:
    kind = values.type
    if pa.types.is_decimal(kind):  # as sums of whole numbers are
        kind, values = pa.float64(), values.cast(pa.float64())
    if _is_number(kind):
        numbers = values.cast(pa.float64()).fill_null(np.nan) if values.null_count else values
        return np.asarray(numbers.to_numpy())
    is_text = pa.types.is_string(kind) or pa.types.is_large_string(kind)
    if not is_text and not (pa.types.is_list(kind) and _is_number(kind.value_type)):
        raise QueryError(
            f"--format: expected numbers, texts or lists of numbers for mat, got {name!r}, which holds"
            f" {kind}; cast or unnest it in the query"
        )
    cells = np.empty((len(values), 1), dtype=object)
    for row, value in enumerate(values.to_pylist()):
        cells[row, 0] = value or "" if is_text else np.array(value or [], dtype=np.float64)
    return cells


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)
