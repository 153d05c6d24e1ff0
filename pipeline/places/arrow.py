"""How Arrow reads the files of a directory: each opened by us, as a plain file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
from pyarrow.fs import FileInfo, FileType, FSSpecHandler, PyFileSystem

if TYPE_CHECKING:
    from stickslip.pipeline.places.directory import Directory


class _Files(FSSpecHandler):  # type: ignore[misc]  # whose other methods, which write, have nothing to work on
    """The files of a directory, to read, by their paths."""

    def __init__(self, place: Directory) -> None:
        self._place = place

    def __eq__(self, files: object) -> bool:
        return isinstance(files, _Files) and str(self._place) == str(files._place)

    def __ne__(self, files: object) -> bool:
        return not self == files

    def get_type_name(self) -> str:
        return "plain files"

    def normalize_path(self, path: str) -> str:
        return path

    def get_file_info(self, paths: Sequence[str]) -> list[FileInfo]:
        return [FileInfo(path, FileType.File) for path in paths]

    def open_input_file(self, path: str) -> Any:
        descriptor = self._place.opened(str(Path(path).relative_to(self._place.path)))
        try:
            return pa.OSFile(f"/dev/fd/{descriptor}")
        finally:
            os.close(descriptor)

    open_input_stream = open_input_file


def file_system(place: Directory) -> PyFileSystem:
    """The file system through which Arrow reads in a directory."""
    return PyFileSystem(_Files(place))
