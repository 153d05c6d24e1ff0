"""Whether the pages of a Parquet file hold what its footer says of them, found without reading a value.

A reader makes room for what each page says of itself: one of a few bytes may say that it holds 2^31 values. The head
of a page is a struct of Thrift's compact protocol (github.com/apache/thrift, doc/specs/thrift-compact-protocol.md),
with the fields of parquet.thrift (github.com/apache/parquet-format). Arrow reads the footer.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import pyarrow.parquet as pq

#: Values by the number and the type of their field: a reader leaves out one of another type than it expects.
_Struct: TypeAlias = dict[tuple[int, int], Any]

#: Types of Thrift: truths, which have no bytes of their own, whole numbers by their bits, and others.
_TRUTHS, _WIDTHS, _INT32, _BINARY, _STRUCT = (1, 2), {4: 16, 5: 32, 6: 64}, 5, 8, 12
#: How deep structs lie in one another.
_DEPTH = 3

#: Bytes of the head of a page at most: there is room for two texts, shortened.
_HEAD = 2**16
#: By the type of a page, the field of its head about values, or a dictionary.
_VALUES, _DICTIONARY = 0, 2
_PARTS = {_VALUES: (5, _STRUCT), _DICTIONARY: (7, _STRUCT)}
#: PLAIN, PLAIN_DICTIONARY, RLE, RLE_DICTIONARY and BYTE_STREAM_SPLIT, whose values take what their number and bytes
#: say; the others store the difference to the text before.
_ENCODINGS = (0, 2, 3, 8, 9)


class UnsoundError(ValueError):
    """What a shard holds is not what this program writes of its scene."""


def check_pages(content: bytes, column: pq.ColumnChunkMetaData, n_rows: int) -> None:
    """Raise `UnsoundError` if the pages of a column differ from what the footer says, or this program writes.

    Parameters
    ----------
    content : bytes
        All of the file.
    column : pyarrow.parquet.ColumnChunkMetaData
        One column of one group of rows.
    n_rows : int
        Of the group.
    """
    name = column.path_in_schema
    try:
        n_values, n_bytes = _sizes(content, column)
    except (IndexError, KeyError, ValueError):
        raise UnsoundError(f"{name}: expected pages of known kinds up to the end of the column, got others") from None
    stated = column.num_values, column.total_uncompressed_size
    if (n_values, n_bytes) != stated or not 0 <= n_rows <= n_values:
        raise UnsoundError(
            f"{name}: expected {stated[0]} values in {stated[1]} bytes for {n_rows} rows, as its footer says, got"
            f" {n_values} in {n_bytes}"
        )


def _sizes(content: bytes, column: pq.ColumnChunkMetaData) -> tuple[int, int]:
    """Values of a column's pages, and their bytes before they were compressed, with their heads."""
    n_values = n_bytes = 0
    place = min(filter(None, (column.data_page_offset, column.dictionary_page_offset)))
    end = place + column.total_compressed_size
    if column.file_path or not 0 < place < end <= len(content):
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
        elif n_own > column.num_values:
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
        if kind in _TRUTHS:
            fields[number, kind] = kind
        elif kind in _WIDTHS:
            fields[number, kind], place = _whole(content, place, _WIDTHS[kind])
        elif kind == _STRUCT:
            fields[number, kind], place = _struct(content, place, depth + 1)
        elif kind == _BINARY:
            length, place = _varint(content, place)
            fields[number, kind], place = content[place : place + length], place + length
        else:
            raise ValueError
    return fields, place + 1


def _whole(content: bytes, place: int, n_bits: int) -> tuple[int, int]:
    """A whole number with its sign, and where it ends."""
    value, place = _varint(content, place)
    if value >> n_bits:  # a reader would leave out the rest
        raise ValueError
    return (value >> 1) ^ -(value & 1), place


def _varint(content: bytes, place: int) -> tuple[int, int]:
    """A number whose bytes have seven bits each, ten bytes at most, and where it ends."""
    value = n_bits = 0
    while n_bits < 70:
        byte = content[place]
        place += 1
        value |= (byte & 127) << n_bits
        n_bits += 7
        if byte < 128:
            return value, place
    raise ValueError
