"""Rows of numbers as text: CSV of any kind, and what `numpy.savetxt` and instruments write."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence

import numpy as np

from stickslip.pipeline.scene.readers.reader import BYTES_OF_ENTRY, Reader, fits
from stickslip.pipeline.scene.toml import MAX_BLOCKS

#: By the bytes at the beginning.
_ENCODINGS = {b"\xef\xbb": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
#: Characters of a row of numbers: of most blocks, all digits of each.
_LONGEST = 30 * MAX_BLOCKS


class Text(Reader):
    """Rows of numbers parted by commas, semicolons, tabs or blanks; headings and comments before them are left out.

    Where semicolons, tabs or blanks part them, numbers may have decimal commas. A square matrix may have labels.
    """

    name, magic = "a CSV file", b""

    def __init__(self, content: bytes) -> None:
        super().__init__(content)
        text = _decoded(content)
        lines = [
            (k, line.strip())
            for k, line in enumerate(text.splitlines(), 1)
            if line.strip() and not line.lstrip().startswith(("#", "%"))
        ]
        if not lines or "\0" in text or len(lines[-1][1]) > _LONGEST:
            raise ValueError("something else")
        self._separator = mark = _separator(lines[-1][1])
        self._has_commas = mark != "," and any("," in line for _, line in lines)
        if mark is not None and all(line.endswith(mark) for _, line in lines):
            lines = [(k, line[: -len(mark)]) for k, line in lines]
        self._width = len(self._cells(lines[-1][1]))
        first = next((k for k, (_, line) in enumerate(lines) if self._has_numbers(line)), None)
        if first is None or not any(self._is_row(line) for _, line in lines):
            raise ValueError("something else")
        self._heads = [self._cells(line) for _, line in lines[:first]]
        self._lines = lines[first:]

    def read(self, name: str = "") -> np.ndarray:
        """All numbers; of a square matrix with labels, those beside these. A row or a column has shape (n,)."""
        self._check_heads()
        cells = self._cells(self._lines[0][1])
        for numbered in (0, 1):  # columns that pandas has numbered, beside its index or not
            names = [""] * numbered + [str(k) for k in range(self._width - numbered)]
            if cells == names and len(self._lines) == len(names) + 1 - numbered:
                self._heads, self._lines = [cells], self._lines[1:]
                break
        has_labels = bool(self._heads) or not self._is_number(cells[0])
        is_labelled = has_labels and self._width == len(self._lines) + 1
        table = self._numbers(range(1 if is_labelled else 0, self._width))
        return table.reshape(-1) if 1 in table.shape else table

    @property
    def labels(self) -> list[list[str]]:
        """Texts beside the numbers that have one for each column, or, before them, each row."""
        first = 0 if self._is_number(self._cells(self._lines[0][1])[0]) else 1
        rows = [[self._cells(line)[0] for _, line in self._lines]] * first
        return rows + [head[len(head) - self._width + first :] for head in self._heads]

    def columns(self, names: Sequence[str | int]) -> list[np.ndarray]:
        """Some columns, by their headings, or by number from 0; all if none are named."""
        self._check_heads()
        return [*self._numbers([self._place(name) for name in names] or range(self._width)).T]

    def _check_heads(self) -> None:
        """Refuse a line of another length that is no heading: all its cells are numbers."""
        odd = next((head for head in self._heads if all(map(self._is_number, head))), None)
        if odd is not None:
            raise ValueError(f"expected {self._width} columns, as in the last line, got {', '.join(odd)}; correct it")

    def _place(self, name: str | int) -> int:
        """The place of a column."""
        if isinstance(name, int):
            if not 0 <= name < self._width:
                raise ValueError(f"expected a column from 0 to {self._width - 1}, got {name}")
            return name
        heads = [head for head in self._heads if len(head) == self._width]
        places = [head.index(name) for head in heads if head.count(name) == 1]
        if not places:
            there = ", ".join(map(repr, heads[-1])) if heads else "none with a heading; give numbers from 0"
            raise ValueError(f"expected a column {name!r}, got {there}")
        return places[0]

    def _parted(self, line: str) -> list[str]:
        """A line at its separators, as `_numbers` reads it: one between quotes parts nothing."""
        if self._separator is None:
            return line.split()
        try:
            (cells,) = csv.reader([line], delimiter=self._separator, skipinitialspace=True)
        except csv.Error as error:
            raise ValueError(f"expected numbers and headings, got a line with a {error}") from error
        return cells

    def _cells(self, line: str) -> list[str]:
        return [cell.strip().strip("\"'").strip() for cell in self._parted(line)]

    def _has_numbers(self, line: str) -> bool:
        """Whether a line has a number where others have one, so that it is no heading."""
        cells = self._cells(line)
        return len(cells) == self._width and any(map(self._is_number, cells))

    def _is_row(self, line: str) -> bool:
        """Whether a line is all numbers, but for a label before them."""
        cells = self._cells(line)
        return len(cells) == self._width and all(map(self._is_number, cells[1:] or cells))

    def _is_number(self, cell: str) -> bool:
        try:
            return math.isfinite(float(self._plain(cell)))
        except ValueError:
            return False

    def _plain(self, text: str) -> str:
        return text.replace(",", ".") if self._has_commas else text

    def _numbers(self, places: Sequence[int]) -> np.ndarray:
        """The numbers of some columns, shape (rows, columns)."""
        fits("rows of numbers", BYTES_OF_ENTRY * len(self._lines) * self._width)
        for number, line in self._lines:
            if (n_cells := len(self._parted(line))) != self._width:
                raise ValueError(
                    f"line {number}: expected {self._width} columns, as in the last line, got {n_cells}; correct it"
                )
        lines = [self._plain(line) for _, line in self._lines]
        try:
            table = np.loadtxt(
                lines, delimiter=self._separator, ndmin=2, comments=None, usecols=places, quotechar='"'
            )
        except ValueError as error:
            raise self._problem(places) from error
        if not np.isfinite(table).all():
            raise self._problem(places)
        return table

    def _problem(self, places: Sequence[int]) -> ValueError:
        """What is wrong with the first cell that is no number."""
        for number, line in self._lines:
            cells = self._cells(line)
            for place in places:
                if not self._is_number(cells[place]):
                    return ValueError(
                        f"line {number}, column {place + 1}: expected a finite number, got {cells[place][:40]!r};"
                        " correct it"
                    )
        return ValueError("expected numbers in plain digits, got others")


def _decoded(content: bytes) -> str:
    """The text; numbers are the same in all encodings of one byte, so headings may be in any."""
    try:
        return content.decode(_ENCODINGS.get(content[:2], "utf-8"))
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _separator(line: str) -> str | None:
    """What parts the numbers of a line; None: blanks."""
    for mark in (";", "\t"):
        if mark in line:
            return mark
    is_between = "," in line and not any(" " in cell.strip() for cell in line.split(","))
    return "," if is_between else None
