"""Tables of numbers whose rows have names, for Python, for kernels and for the formulas of `lanes`.

A table stays one array of two dimensions: it is passed as one, and vectors of neighbouring columns are read at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import intrinsic, register_model
from numba.np.arrayobj import make_array, populate_array
from numpy.typing import NDArray

#: One row, or one a node: what a table declares its names by.
Row = Any
Nodes = Any


class Table:
    """The rows of an array by name: a view, shape (..., columns), or (..., nodes, columns) of those one a node.

    A subclass declares them in their order, each as a `Row` or as `Nodes`.
    """

    places: ClassVar[dict[str, tuple[int, int]]]  #: the first row of a name, and how many there are; 0: one, a vector
    n_rows: ClassVar[int]
    __slots__ = ("array",)

    def __init_subclass__(cls, nodes: int) -> None:
        cls.places, cls.n_rows = {}, 0
        for name, kind in cls.__annotations__.items():
            count = nodes if kind == "Nodes" else 0
            cls.places[name] = first, _ = cls.n_rows, count
            cls.n_rows += max(count, 1)
            setattr(cls, name, _rows(slice(first, first + count) if count else first))

    def __init__(self, array: NDArray[Any]) -> None:
        self.array = array


def _rows(rows: int | slice) -> property:
    """Of a table, these rows: read as a view, assigned to in place."""
    index = ..., rows, slice(None)

    def get(table: Table) -> Any:
        return table.array[index]

    def assign(table: Table, value: Any) -> None:
        table.array[index] = value

    return property(get, assign)


class Named(types.Type):
    """A table in a kernel."""

    def __init__(self, table: type[Table], array: Any) -> None:
        self.table, self.array = table, array
        super().__init__(name=f"{table.__name__}({array})")


@register_model(Named)
class _NamedModel(models.StructModel):
    def __init__(self, manager: Any, kind: Named) -> None:
        super().__init__(manager, kind, [("array", kind.array)])  # type: ignore[no-untyped-call]


@infer_getattr
class _RowsOfNamed(AttributeTemplate):
    key = Named

    def generic_resolve(self, kind: Named, name: str) -> Any:  # type: ignore[override]
        if name in kind.table.places:
            return types.Array(kind.array.dtype, 2 if kind.table.places[name][1] else 1, "C")
        return None


@lower_getattr_generic(Named)  # type: ignore[untyped-decorator]
def _row(context: Any, builder: Any, kind: Named, value: Any, name: str) -> Any:
    first, count = kind.table.places[name]
    whole = make_array(kind.array)(context, builder, builder.extract_value(value, 0))
    columns, (row_bytes, bytes_a_number) = (
        cgutils.unpack_tuple(builder, whole.shape)[1],
        cgutils.unpack_tuple(builder, whole.strides),
    )
    data = builder.gep(whole.data, [builder.mul(columns, context.get_constant(types.intp, first))])
    shape, strides = [columns], [bytes_a_number]
    if count:
        shape, strides = [context.get_constant(types.intp, count), columns], [row_bytes, bytes_a_number]
    rows = make_array(types.Array(kind.array.dtype, len(shape), "C"))(context, builder)
    populate_array(rows, data, shape, strides, whole.itemsize, None)
    return rows._getvalue()


def named(table: type[Table]) -> Callable[..., Any]:
    """For kernels, ``f(array)``: the array by these names. Its rows are arrays, and cost nothing to make."""

    @intrinsic
    def apply(typing_context, array):  # type: ignore[no-untyped-def]
        kind = Named(table, array)

        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            return builder.insert_value(cgutils.get_null_value(context.get_value_type(kind)), arguments[0], 0)

        return kind(array), codegen

    result: Callable[..., Any] = apply
    return result
