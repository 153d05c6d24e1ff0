"""What a Parquet file says of itself: its footer, and whether the head of each page fits it.

A reader makes room for what each page says of itself: one of a few bytes may say that it holds 2^31 values. And where
statistics are of another type than their column, Arrow ends the process, or waits for ever. Both are structs of
Thrift's compact protocol (github.com/apache/thrift, doc/specs/thrift-compact-protocol.md), of the fields in
parquet.thrift (github.com/apache/parquet-format).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import pyarrow.parquet as pq

#: Values by the number and the type of their field: a reader leaves out one of another type than it expects.
_Struct: TypeAlias = dict[tuple[int, int], Any]

#: Types of Thrift: truths, which have no bytes of their own, whole numbers by their bits, and others.
_TRUTHS, _BYTE, _WIDTHS, _INT32, _INT64, _BINARY, _LIST, _STRUCT = (1, 2), 3, {4: 16, 5: 32, 6: 64}, 5, 6, 8, 9, 12
#: How deep structs lie in one another.
_DEPTH = 6
#: Types of the elements of lists by the depth of their struct and their field: a reader takes them for granted.
_ELEMENTS = {
    **dict.fromkeys(((0, 2), (0, 4), (0, 5), (0, 7), (1, 1), (1, 4), (3, 8), (3, 13)), _STRUCT),
    (3, 2): _INT32,
    (3, 3): _BINARY,
    (4, 2): _INT64,
    (4, 3): _INT64,
}

#: Bytes of the head of a page at most: there is room for two texts, shortened.
_HEAD = 2**16
#: By the type of a page, the field of its head about values, or a dictionary.
_VALUES, _DICTIONARY = 0, 2
_PARTS = {_VALUES: (5, _STRUCT), _DICTIONARY: (7, _STRUCT)}
#: PLAIN, PLAIN_DICTIONARY, RLE, RLE_DICTIONARY and BYTE_STREAM_SPLIT, whose values take what their number and bytes
#: say; the others store the difference to the text before.
_ENCODINGS = (0, 2, 3, 8, 9)

#: Fields of what a footer says of a column's pages, but for keys and filters, which this program does not write.
_FIELDS = {1, 2, 3, 4, 5, 6, 7, 9, 11, 12, 13, 16}
#: Types of Parquet by their number, and how bytes are a value of them.
_TYPES = ("BOOLEAN", "INT32", "INT64", "INT96", "FLOAT", "DOUBLE", "BYTE_ARRAY")
_FORMATS = {"BOOLEAN": "<?", "INT32": "<i", "INT64": "<q", "DOUBLE": "<d"}

#: What a damaged footer raises here; UnicodeDecodeError is a ValueError.
_DAMAGE = (IndexError, KeyError, ValueError, struct.error)


class Chunk(NamedTuple):
    """The pages of one column in one group of rows.

    Attributes
    ----------
    path : str
        The column, with a point between the levels of lists.
    first, end : int
        Bytes of the file.
    n_bytes : int
        Bytes of the pages before they were compressed, with their heads.
    n_nulls : int or None
        As the statistics say.
    lows, highs : sequence
        The least and the greatest value, likewise: by a rule that is outdated, and by that of today.
    """

    path: str
    n_rows: int
    n_values: int
    first: int
    end: int
    n_bytes: int
    n_nulls: int | None
    lows: Sequence[Any]
    highs: Sequence[Any]


def chunks(content: bytes, schema: pq.ParquetSchema) -> list[Chunk]:
    """The columns of each group of rows of a file that Arrow can open.

    Raises `ValueError` if its footer is not as this program writes it.
    """
    start = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    leaves = [schema.column(k) for k in range(len(schema))]
    try:
        footer, _ = _struct(content[start:-8])
        return [
            _chunk(column, leaf, group[3, _INT64])
            for group in footer[4, _LIST]
            for column, leaf in zip(group[1, _LIST], leaves, strict=True)
        ]
    except _DAMAGE:
        raise ValueError("expected a footer as this program writes it, got another") from None


def _chunk(column: _Struct, leaf: pq.ColumnSchema, n_rows: int) -> Chunk:
    facts = column[3, _STRUCT]
    statistics, lengths = (facts.get((field, _STRUCT), {}) for field in (12, 16))
    bounds = [_value_of(statistics.get((field, _BINARY)), leaf.physical_type) for field in (2, 6, 1, 5)]
    levels = {(2, _LIST): leaf.max_repetition_level, (3, _LIST): leaf.max_definition_level}
    is_ours = (
        {field for field, _ in column} <= {2, 3}  # else it is in another file, or encrypted
        and {field for field, _ in facts} <= _FIELDS
        and _TYPES[facts[1, _INT32]] == leaf.physical_type
        and ((1, _INT64) not in lengths or leaf.physical_type == "BYTE_ARRAY")
        and all(len(lengths.get(field, ())) in (0, level + 1) for field, level in levels.items())
    )
    if not is_ours:
        raise ValueError
    first = min(start for start in (facts[9, _INT64], facts.get((11, _INT64), 0)) if start)
    return Chunk(
        leaf.path,
        n_rows,
        facts[5, _INT64],
        first,
        first + facts[7, _INT64],
        facts[6, _INT64],
        statistics.get((3, _INT64)),
        [low for low in bounds[:2] if low is not None],
        [high for high in bounds[2:] if high is not None],
    )


def _value_of(content: bytes | None, kind: str) -> str | int | float | None:
    """The value of a type of Parquet that bytes are, or ValueError."""
    if content is None:
        return None
    return content.decode() if kind == "BYTE_ARRAY" else struct.unpack(_FORMATS[kind], content)[0]


def fault_of_pages(content: bytes, chunk: Chunk) -> str:
    """How a column's pages differ from what the footer says, or this program writes; "" if they do not."""
    try:
        n_values, n_bytes = _sizes(content, chunk)
    except _DAMAGE:
        return f"{chunk.path}: expected pages of known kinds up to the end of the column, got others"
    if (n_values, n_bytes) != (chunk.n_values, chunk.n_bytes) or not 0 <= chunk.n_rows <= n_values:
        return (
            f"{chunk.path}: expected {chunk.n_values} values in {chunk.n_bytes} bytes for {chunk.n_rows} rows, as its"
            f" footer says, got {n_values} in {n_bytes}"
        )
    return ""


def _sizes(content: bytes, chunk: Chunk) -> tuple[int, int]:
    """Values of a column's pages, and their bytes before they were compressed, with their heads."""
    n_values = n_bytes = 0
    place, end = chunk.first, chunk.end
    if not 0 < place < end <= len(content):
        raise ValueError
    while place < end:
        head, n_head = _struct(content[place : min(place + _HEAD, end)])
        kind, uncompressed, compressed = (head[field, _INT32] for field in (1, 2, 3))
        detail = head[_PARTS[kind]]
        n_own, encoding = detail[1, _INT32], detail[2, _INT32]
        if min(uncompressed, compressed, n_own) < 0 or encoding not in _ENCODINGS:
            raise ValueError
        if kind == _VALUES:
            n_values += n_own
        elif n_own > chunk.n_values:
            raise ValueError
        n_bytes += n_head + uncompressed
        place += n_head + compressed
    if place > end:
        raise ValueError
    return n_values, n_bytes


def _struct(content: bytes, place: int = 0, depth: int = 0) -> tuple[_Struct, int]:
    """The fields of a struct, and where it ends."""
    fields: _Struct = {}
    number = 0
    while kind := content[place] & 15:
        step = content[place] >> 4
        place += 1
        if step:
            number += step
        else:
            number, place = _whole(content, place, 16)
        if (number, kind) in fields or depth > _DEPTH:
            raise ValueError
        if kind == _LIST:
            fields[number, kind], place = _list(content, place, depth, _ELEMENTS.get((depth, number)))
        elif kind in _TRUTHS:
            fields[number, kind] = kind
        else:
            fields[number, kind], place = _value(content, place, depth, kind)
    return fields, place + 1


def _list(content: bytes, place: int, depth: int, expected: int | None) -> tuple[list[Any], int]:
    kind, n = content[place] & 15, content[place] >> 4
    place += 1
    if n == 15:
        n, place = _varint(content, place)
    if kind != expected:
        raise ValueError
    values = []
    for _ in range(n):
        value, place = _value(content, place, depth, kind)
        values.append(value)
    return values, place


def _value(content: bytes, place: int, depth: int, kind: int) -> tuple[Any, int]:
    if kind in _WIDTHS:
        return _whole(content, place, _WIDTHS[kind])
    if kind == _STRUCT:
        return _struct(content, place, depth + 1)
    if kind == _BINARY:
        length, place = _varint(content, place)
        return content[place : place + length], place + length
    if kind == _BYTE:
        return content[place], place + 1
    raise ValueError


def _whole(content: bytes, place: int, n_bits: int) -> tuple[int, int]:
    """A whole number with its sign, and where it ends."""
    value, place = _varint(content, place)
    if value >> n_bits:  # a reader would leave out the rest
        raise ValueError
    return (value >> 1) ^ -(value & 1), place


def _varint(content: bytes, place: int) -> tuple[int, int]:
    """A number whose bytes have seven bits each, ten bytes at most, and where it ends."""
    byte = content[place]
    value, n_bits = byte & 127, 7
    while byte > 127 and n_bits < 70:
        place += 1
        byte = content[place]
        value |= (byte & 127) << n_bits
        n_bits += 7
    if byte > 127:
        raise ValueError
    return value, place + 1
