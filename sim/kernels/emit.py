"""Pieces of kernels that are vectors: written once, emitted as LLVM's instructions or run by NumPy.

A piece is a function of a `Code` and its arguments: numbers are `Lane` and `Index`, arrays `Array`, with the
operators of Python. While a kernel is compiled it is called once, and emits what kernels then do. Under
``NUMBA_DISABLE_JIT=1`` it is called by the kernels themselves, with NumPy's numbers and arrays: slow, but a debugger
stops in it, and coverage sees its lines.

Nothing else in the package knows LLVM.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from hashlib import sha256
from inspect import Parameter, Signature, signature
from typing import Any, ClassVar, NamedTuple, TypeAlias, TypeVar, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, models, register_model
from numba.np.arrayobj import populate_array
from numpy.typing import NDArray

from stickslip.sim.kernels.digest import is_compiled

#: Whether kernels are compiled; else they are run as Python.
IS_COMPILED = is_compiled()

_DOUBLE, _INTEGER, _SHORT = ir.DoubleType(), ir.IntType(64), ir.IntType(32)
_FUSED = ("contract",)


class Index:
    """A whole number in the code being emitted."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def _new(self, operation: Callable[[Any, Any], Any], other: Index | int) -> Index:
        operand = other.value if isinstance(other, Index) else _INTEGER(other)
        return Index(self.builder, operation(self.value, operand))

    def __add__(self, other: Index | int) -> Index:
        return self._new(self.builder.add, other)

    def __sub__(self, other: Index | int) -> Index:
        return self._new(self.builder.sub, other)

    def __mul__(self, other: Index | int) -> Index:
        return self._new(self.builder.mul, other)


class Lane:
    """A number, or several side by side, in the code being emitted; or the result of a comparison."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def _operand(self, other: Lane | float) -> Any:
        if isinstance(other, Lane):
            return other.value
        kind = self.value.type
        number = float(other)
        return ir.Constant(kind, [number] * kind.count if isinstance(kind, ir.VectorType) else number)

    def _fused(self, operation: Callable[..., Any], left: Any, right: Any) -> Lane:
        return Lane(self.builder, operation(left, right, flags=_FUSED))

    def __add__(self, other: Lane | float) -> Lane:
        return self._fused(self.builder.fadd, self.value, self._operand(other))

    def __sub__(self, other: Lane | float) -> Lane:
        return self._fused(self.builder.fsub, self.value, self._operand(other))

    def __rsub__(self, other: float) -> Lane:
        return self._fused(self.builder.fsub, self._operand(other), self.value)

    def __mul__(self, other: Lane | float) -> Lane:
        return self._fused(self.builder.fmul, self.value, self._operand(other))

    def __truediv__(self, other: Lane | float) -> Lane:
        return self._fused(self.builder.fdiv, self.value, self._operand(other))

    def __rtruediv__(self, other: float) -> Lane:
        return self._fused(self.builder.fdiv, self._operand(other), self.value)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> Lane:
        return self * -1.0

    def __lt__(self, other: Lane | float) -> Lane:
        return Lane(self.builder, self.builder.fcmp_ordered("<", self.value, self._operand(other)))

    def __gt__(self, other: Lane | float) -> Lane:
        return Lane(self.builder, self.builder.fcmp_ordered(">", self.value, self._operand(other)))

    def __and__(self, other: Lane) -> Lane:
        return Lane(self.builder, self.builder.and_(self.value, other.value))

    def __or__(self, other: Lane) -> Lane:
        return Lane(self.builder, self.builder.or_(self.value, other.value))

    def call(self, name: str, *others: Lane | float) -> Lane:
        """An intrinsic of LLVM, e.g. fabs."""
        kind = self.value.type
        number = kind.element if isinstance(kind, ir.VectorType) else kind
        bits = 64 if number == _DOUBLE else 32
        suffix = f"v{kind.count}f{bits}" if isinstance(kind, ir.VectorType) else f"f{bits}"
        function = cgutils.get_or_insert_function(
            self.builder.module, ir.FunctionType(kind, [kind] * (1 + len(others))), f"llvm.{name}.{suffix}"
        )
        operands = [self._operand(other) for other in others]
        return Lane(self.builder, self.builder.call(function, [self.value, *operands]))


class Array:
    """An array in the code being emitted, in C order; its numbers are counted through all its axes.

    Attributes
    ----------
    shape : list of Index
    """

    def __init__(self, context: Any, builder: Any, kind: Any, value: Any) -> None:
        array = context.make_array(kind)(context, builder, value)
        self._builder, self._data, self._bytes = builder, array.data, kind.dtype.bitwidth // 8
        self.shape = [Index(builder, length) for length in cgutils.unpack_tuple(builder, array.shape)]

    def __getitem__(self, place: Index) -> Any:
        """One number: an `Index` if the array has whole ones, else a `Lane`."""
        value = self._builder.load(self._builder.gep(self._data, [place.value]))
        return (Index if isinstance(value.type, ir.IntType) else Lane)(self._builder, value)

    def load(self, place: Index, width: int) -> Lane:
        """So many numbers from a place on."""
        value = self._builder.load(self._pointer(place, width))
        value.align = self._bytes
        return Lane(self._builder, value)

    def gather(self, places: Lane, first: int = 0) -> Lane:
        """The numbers at some places, counted from a first; these are whole numbers as float64."""
        builder, kind = self._builder, places.value.type

        def number(place: Any) -> Any:
            place = builder.add(builder.fptosi(place, _INTEGER), _INTEGER(first))
            return builder.load(builder.gep(self._data, [place]))

        if not isinstance(kind, ir.VectorType):
            return Lane(builder, number(places.value))
        numbers = ir.Constant(kind, ir.Undefined)
        for k in range(kind.count):
            place = builder.extract_element(places.value, _SHORT(k))
            numbers = builder.insert_element(numbers, number(place), _SHORT(k))
        return Lane(builder, numbers)

    def store(self, place: Index, lane: Lane) -> None:
        pointer = self._pointer(place, lane.value.type.count)
        self._builder.store(lane.value, pointer).align = self._bytes

    def _pointer(self, place: Index, width: int) -> Any:
        pointer = self._builder.gep(self._data, [place.value])
        return self._builder.bitcast(pointer, ir.VectorType(self._data.type.pointee, width).as_pointer())


class Cell:
    """A variable in the code being emitted."""

    def __init__(self, lane: Lane) -> None:
        self._builder, self._place = lane.builder, cgutils.alloca_once(lane.builder, lane.value.type)
        self.value = lane

    @property
    def value(self) -> Lane:
        return Lane(self._builder, self._builder.load(self._place))

    @value.setter
    def value(self, lane: Lane) -> None:
        self._builder.store(lane.value, self._place)


#: One row, or one a node: what a table declares its names by.
Row = Any
Nodes = Any


class Table:
    """The rows of an `array` by name: a view, shape (..., columns), or (..., nodes, columns) of those one a node.

    A subclass declares them in their order, each as a `Row` or as `Nodes`. It stays one array of two dimensions: it
    is passed as one, and vectors of neighbouring columns are read at once.
    """

    #: The first row of each name, and the number of its rows; 0: one, a vector.
    places: ClassVar[dict[str, tuple[int, int]]]
    n_rows: ClassVar[int]

    def __init_subclass__(cls, nodes: int) -> None:
        cls.places, cls.n_rows = {}, 0
        for name, kind in cls.__annotations__.items():
            count = nodes if kind == "Nodes" else 0
            cls.places[name] = first, _ = cls.n_rows, count
            cls.n_rows += max(count, 1)
            setattr(cls, name, _rows_of(slice(first, first + count) if count else first))

    def __init__(self, array: NDArray[Any]) -> None:
        self.array = array


def _rows_of(rows: int | slice) -> property:
    """Of a table, these rows: read as a view, assigned to in place."""
    index = ..., rows, slice(None)

    def get(table: Table) -> Any:
        return table.array[index]

    def assign(table: Table, value: Any) -> None:
        table.array[index] = value

    return property(get, assign)


Kind = TypeVar("Kind", bound=Table)


class View(NamedTuple):
    """What a piece is handed of a table."""

    places: dict[str, tuple[int, int]]
    array: Array


class Code:
    """What pieces are emitted by."""

    def __init__(self, context: Any, builder: Any) -> None:
        self._context, self._builder = context, builder

    def argument(self, kind: Any, value: Any) -> Any:
        """An argument of a piece as it is handed one; of an empty named tuple, its class."""
        if isinstance(kind, Reference):
            kind, place = kind.whole, self._context.get_value_type(kind.whole).as_pointer()
            value = self._builder.load(self._builder.bitcast(value, place))
        if isinstance(kind, types.NamedTuple) and len(kind) > 0:
            fields = cgutils.unpack_tuple(self._builder, value)
            return kind.instance_class(*map(self.argument, kind.types, fields))
        if isinstance(kind, Named):
            array = self._builder.extract_value(value, 0)
            return View(kind.places, Array(self._context, self._builder, kind.array, array))
        if isinstance(kind, types.Array):
            return Array(self._context, self._builder, kind, value)
        if isinstance(kind, types.Integer):
            return Index(self._builder, value)
        return Lane(self._builder, value) if isinstance(kind, types.Float) else kind.instance_class

    def result(self, kind: types.Type, value: Any) -> Any:
        """What a piece returns as LLVM has it."""
        if value is None:
            return self._context.get_dummy_value() if kind == types.void else self._context.get_constant(kind, 0)
        if isinstance(value, tuple):
            return self._context.make_tuple(self._builder, kind, [lane.value for lane in value])
        return value.value

    def loop(self, n: Index, body: Callable[[Index], None]) -> None:
        """``body(k)`` for k < n."""
        with cgutils.for_range(self._builder, n.value) as loop:
            body(Index(self._builder, loop.index))

    def cell(self, lane: Lane) -> Cell:
        """A variable with a first value."""
        return Cell(lane)

    def zeros(self, width: int, dtype: type[np.floating]) -> Lane:
        """So many numbers side by side, all zero."""
        kind = ir.VectorType(_DOUBLE if dtype is np.float64 else ir.FloatType(), width)
        return Lane(self._builder, ir.Constant(kind, [0.0] * width))

    def spread(self, number: Lane, width: int) -> Lane:
        """A number, so many times side by side."""
        undefined = ir.Constant(ir.VectorType(number.value.type, width), ir.Undefined)
        first = self._builder.insert_element(undefined, number.value, _SHORT(0))
        zeros = ir.Constant(ir.VectorType(_SHORT, width), [0] * width)
        return Lane(self._builder, self._builder.shuffle_vector(first, undefined, zeros))

    def fused(self, a: Lane, b: Lane, c: Lane) -> Lane:
        """a b + c, rounded once where a processor can."""
        return a.call("fmuladd", b, c)

    def bits(self, condition: Lane) -> Index:
        """Bit k says whether a condition holds in lane k."""
        word = self._builder.bitcast(condition.value, ir.IntType(condition.value.type.count))
        return Index(self._builder, self._builder.zext(word, _INTEGER))

    def word(self, x: Lane) -> Index:
        """The 64 bits of a number."""
        return Index(self._builder, self._builder.bitcast(x.value, _INTEGER))

    def number(self, word: Index) -> Lane:
        """The number with these 64 bits."""
        return Lane(self._builder, self._builder.bitcast(word.value, _DOUBLE))


# ---------------------------------------------------------------------------------------------- the same by NumPy


class _PlainArray:
    """`Array` of NumPy."""

    def __init__(self, array: NDArray[Any]) -> None:
        self.shape, self._numbers = array.shape, array.reshape(-1, copy=False)

    def __getitem__(self, place: int) -> Any:
        return self._numbers[place]

    def load(self, place: int, width: int) -> NDArray[Any]:
        return self._numbers[place : place + width].copy()

    def gather(self, places: NDArray[Any], first: int = 0) -> NDArray[Any]:
        return self._numbers[np.asarray(places, np.int64) + first]

    def store(self, place: int, lane: NDArray[Any]) -> None:
        self._numbers[place : place + len(lane)] = lane


class _PlainCell:
    """`Cell` of NumPy."""

    def __init__(self, value: Any) -> None:
        self.value = value


class _Plain:
    """`Code` that is run at once."""

    cell = _PlainCell

    def argument(self, value: Any) -> Any:
        match value:
            case Table():
                return View(value.places, cast(Array, _PlainArray(value.array)))
            case np.ndarray():
                return _PlainArray(value)
            case tuple():
                return type(value)(*map(self.argument, value)) if value else type(value)
        return value

    def loop(self, n: int, body: Callable[[int], None]) -> None:
        for k in range(n):
            body(k)

    def zeros(self, width: int, dtype: type[np.floating]) -> NDArray[Any]:
        return np.zeros(width, dtype)

    def spread(self, number: Any, width: int) -> NDArray[Any]:
        return np.full(width, number)

    def fused(self, a: Any, b: Any, c: Any) -> Any:
        return a * b + c

    def bits(self, condition: NDArray[np.bool_]) -> int:
        return int(np.packbits(condition, bitorder="little")[0])

    def word(self, x: float) -> np.int64:
        return np.float64(x).view(np.int64)

    def number(self, word: int) -> np.float64:
        return np.int64(word).view(np.float64)


def emitted(piece: Callable[..., Any], result: types.Type = types.void) -> Any:
    """A piece, ``piece(code, *arguments)``, as a function of its arguments that kernels call.

    `result` is the type of what it returns: nothing, a number, or a tuple of numbers; of an int64, None is 0.
    """
    if not IS_COMPILED:
        plain: Any = _Plain()

        @wraps(piece)
        def run(*arguments: Any) -> Any:
            value = piece(plain, *map(plain.argument, arguments))
            return 0 if value is None else value

        return run

    def typed(_: Any, *kinds: types.Type) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            code = Code(context, builder)
            return code.result(signature.return_type, piece(code, *map(code.argument, signature.args, arguments)))

        return result(*(types.intp if isinstance(kind, types.Integer) else kind for kind in kinds)), codegen

    typed.__signature__ = Signature(  # type: ignore[attr-defined]
        [Parameter("typing_context", Parameter.POSITIONAL_OR_KEYWORD), *[*signature(piece).parameters.values()][1:]]
    )
    return intrinsic(typed)


# ---------------------------------------------------------------------------------------------- what is no arithmetic


Number: TypeAlias = Any  #: a `Lane`, or several numbers of NumPy


def where(condition: Number, yes: Number, no: Number | float) -> Number:
    """`yes` where the condition holds, else `no`."""
    if not isinstance(condition, Lane):
        return np.where(condition, yes, no)
    return Lane(condition.builder, condition.builder.select(condition.value, yes.value, yes._operand(no)))


def absolute(x: Number) -> Number:
    return x.call("fabs") if isinstance(x, Lane) else np.abs(x)


def copysign(size: Number, sign: Number) -> Number:
    """A number >= 0 with the sign of another."""
    return size.call("copysign", sign) if isinstance(size, Lane) else np.copysign(size, sign)


def times_power_of_two(x: Number, shifted: Number) -> Number:
    """x 2^k for the integer k that stands in the lowest bits of `shifted` (a number near 1.5 2^52)."""
    if not isinstance(x, Lane):
        return np.ldexp(x, np.asarray(shifted - 1.5 * 2.0**52, np.int64))
    kind, builder = x.value.type, x.builder
    is_vector = isinstance(kind, ir.VectorType)
    bits = ir.VectorType(_INTEGER, kind.count) if is_vector else _INTEGER
    places = ir.Constant(bits, [52] * kind.count if is_vector else 52)
    exponent = builder.shl(builder.bitcast(shifted.value, bits), places)
    return Lane(builder, builder.bitcast(builder.add(builder.bitcast(x.value, bits), exponent), kind))


# ---------------------------------------------------------------------------------------------- arrays


def _room(_: Any, rows: Any, columns: Any) -> Any:
    kind = types.Array(types.float64, 2, "C")
    shape = rows.literal_value, columns.literal_value

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = cgutils.alloca_once(builder, _DOUBLE, size=shape[0] * shape[1])
        return _array(context, builder, kind, data, [*map(_INTEGER, shape)], [_INTEGER(8 * shape[1]), _INTEGER(8)])

    return kind(rows, columns), codegen


def _array(context: Any, builder: Any, kind: Any, data: Any, shape: list[Any], strides: list[Any]) -> Any:
    array = context.make_array(kind)(context, builder)
    populate_array(array, data, shape, strides, _INTEGER(kind.dtype.bitwidth // 8), None)
    return array._getvalue()


#: ``room(rows, columns)``, two literals: a float64 array on the stack, gone when the function returns.
room: Any = intrinsic(prefer_literal=True)(_room) if IS_COMPILED else lambda rows, columns: np.empty((rows, columns))


# ---------------------------------------------------------------------------------------------- named tuples


_ADDRESS = ir.IntType(8).as_pointer()


class Reference(types.Type):
    """A named tuple by its address: passed by value, each of its words would be an argument of each call."""

    def __init__(self, whole: Any) -> None:
        self.whole, self.class_name = whole, whole.instance_class.__name__
        # not by its fields: names of functions have those of the types of their arguments
        super().__init__(name=f"{self.class_name}.{sha256(str(whole).encode()).hexdigest()[:16]}")

    def kind_of(self, name: str) -> Any:
        """The type of a field, which, if it is a tuple, is by reference too."""
        kind = self.whole.types[self.whole.fields.index(name)]
        return Reference(kind) if isinstance(kind, types.BaseTuple) and len(kind) > 0 else kind


@register_model(Reference)
class _ReferenceModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Reference) -> None:
        super().__init__(manager, kind, _ADDRESS)  # type: ignore[no-untyped-call]


@infer_getattr
class _FieldsOfReference(AttributeTemplate):
    key = Reference

    def generic_resolve(self, kind: Reference, name: str) -> Any:  # type: ignore[override]
        return kind.kind_of(name) if name in kind.whole.fields else None


@lower_getattr_generic(Reference)  # type: ignore[untyped-decorator]
def _field(context: Any, builder: Any, kind: Reference, value: Any, name: str) -> Any:
    place = builder.bitcast(value, context.get_value_type(kind.whole).as_pointer())
    place = cgutils.gep_inbounds(builder, place, 0, kind.whole.fields.index(name))
    if isinstance(kind.kind_of(name), Reference):
        return builder.bitcast(place, _ADDRESS)
    return builder.load(place)


def _refer(_: Any, kind: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = cgutils.alloca_once(builder, arguments[0].type)
        builder.store(arguments[0], place)
        return builder.bitcast(place, _ADDRESS)

    return Reference(kind)(kind), codegen


def is_reference(argument: Any) -> bool:
    """Whether an argument of a function is a `Reference`: numba numbers the words of all others with a pointer."""
    return bool(argument.type == _ADDRESS and argument.name.count(".") == 1)


#: ``by_reference(whole)``: a named tuple on the stack, by its address, which no function returns.
by_reference: Any = intrinsic(_refer) if IS_COMPILED else lambda whole: whole


# ---------------------------------------------------------------------------------------------- tables


class Named(types.Type):
    """An array whose rows have names, in a kernel."""

    def __init__(self, table: type[Table], array: types.Array) -> None:
        self.places, self.array = table.places, array
        super().__init__(name=f"{table.__name__}({array})")


@register_model(Named)
class _NamedModel(models.StructModel):
    def __init__(self, manager: Any, kind: Named) -> None:
        super().__init__(manager, kind, [("array", kind.array)])  # type: ignore[no-untyped-call]


@infer_getattr
class _RowsOfNamed(AttributeTemplate):
    key = Named

    def generic_resolve(self, kind: Named, name: str) -> Any:  # type: ignore[override]
        if name in kind.places:
            return types.Array(kind.array.dtype, 2 if kind.places[name][1] else 1, "C")
        return None


@lower_getattr_generic(Named)  # type: ignore[untyped-decorator]
def _rows(context: Any, builder: Any, kind: Named, value: Any, name: str) -> Any:
    first, count = kind.places[name]
    whole = context.make_array(kind.array)(context, builder, builder.extract_value(value, 0))
    columns = cgutils.unpack_tuple(builder, whole.shape)[1]
    row_bytes, number_bytes = cgutils.unpack_tuple(builder, whole.strides)
    data = builder.gep(whole.data, [builder.mul(columns, _INTEGER(first))])
    shape, strides = ([_INTEGER(count)] * bool(count)) + [columns], ([row_bytes] * bool(count)) + [number_bytes]
    return _array(context, builder, types.Array(kind.array.dtype, len(shape), "C"), data, shape, strides)


def named(table: type[Kind]) -> Callable[[NDArray[Any]], Kind]:
    """For kernels, ``f(array)``: the array by the names of a table. Its rows are arrays, and cost nothing to make."""
    if not IS_COMPILED:
        return table

    @intrinsic
    def apply(_: Any, array: Any) -> Any:
        kind = Named(table, array)

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.insert_value(cgutils.get_null_value(context.get_value_type(kind)), arguments[0], 0)

        return kind(array), codegen

    return cast(Callable[[NDArray[Any]], Kind], apply)
