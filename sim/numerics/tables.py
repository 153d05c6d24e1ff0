"""Tables of numbers whose rows have names, for Python, for kernels and for the formulas of `lanes`.

A table stays one array of two dimensions: it is passed as one, and vectors of neighbouring columns are read at once.
"""

from __future__ import annotations

from typing import Any, ClassVar

from stickslip.sim.kernels.emit import ByName
from stickslip.sim.kernels.emit import named as named

#: One row, or one a node: what a table declares its names by.
Row = Any
Nodes = Any


class Table(ByName):
    """The rows of an array by name: a view, shape (..., columns), or (..., nodes, columns) of those one a node.

    A subclass declares them in their order, each as a `Row` or as `Nodes`.
    """

    n_rows: ClassVar[int]

    def __init_subclass__(cls, nodes: int) -> None:
        cls.places, cls.n_rows = {}, 0
        for name, kind in cls.__annotations__.items():
            count = nodes if kind == "Nodes" else 0
            cls.places[name] = first, _ = cls.n_rows, count
            cls.n_rows += max(count, 1)
            setattr(cls, name, _rows(slice(first, first + count) if count else first))


def _rows(rows: int | slice) -> property:
    """Of a table, these rows: read as a view, assigned to in place."""
    index = ..., rows, slice(None)

    def get(table: Table) -> Any:
        return table.array[index]

    def assign(table: Table, value: Any) -> None:
        table.array[index] = value

    return property(get, assign)
