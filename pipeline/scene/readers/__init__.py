"""Readers of files of numbers, one class a format; a file is told by its content.

A file may come from anywhere, and be damaged. The sizes that it claims are compared with the bytes that are there and
with the memory of this machine before anything of that size is allocated, and pickles are never loaded.
"""

from __future__ import annotations

from stickslip.pipeline.scene.other_files import OtherKind, kind_of
from stickslip.pipeline.scene.readers.mat import Mat
from stickslip.pipeline.scene.readers.matrix_market import MatrixMarket
from stickslip.pipeline.scene.readers.npz import Npy, Npz
from stickslip.pipeline.scene.readers.reader import Reader
from stickslip.pipeline.scene.readers.text import Text

#: The formats that are read; the last takes what no other does.
READERS: tuple[type[Reader], ...] = (Npz, Npy, MatrixMarket, Mat, Text)

#: Their names, for messages.
FORMATS = f"{', '.join(reader.name for reader in READERS[:-1])} or {READERS[-1].name}"


def reader_of(content: bytes) -> type[Reader]:
    """The reader of a file.

    Raises `OtherKind` if it is a file of another kind that numbers can be brought from, `ValueError` if it is empty.
    """
    if not content:
        raise ValueError("it is empty")
    kind = kind_of(content)
    if kind is not None:
        raise OtherKind(kind)
    return next(reader for reader in READERS if content.startswith(reader.magic))
