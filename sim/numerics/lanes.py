"""Formulas for several blocks at once, written once in Python and emitted as vector instructions.

A formula is a function of numbers. It is called while a kernel is compiled, with `Lane` objects as its numbers, and
emits SIMD code for `WIDTH` numbers side by side; its loops are unrolled. LLVM splits the vectors where a processor
has shorter ones or none, and fuses products and sums where it can. No operation goes across lanes, so the result of a
block does not depend on its neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from stickslip.sim.numerics.tables import Named

#: Numbers side by side: four float64 fill a register of AVX2.
WIDTH = 4
ALL = 2**WIDTH - 1

_DOUBLE, _INTEGER = ir.DoubleType(), ir.IntType(64)
_FUSED = ("contract",)


class Lane:
    """A number, or `WIDTH` of them, in the code being emitted; or the result of a comparison."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def _new(self, value: Any) -> Lane:
        return Lane(self.builder, value)

    def _of(self, other: Lane | float) -> Any:
        if isinstance(other, Lane):
            return other.value
        kind = self.value.type
        number = float(other)
        return ir.Constant(kind, [number] * kind.count if isinstance(kind, ir.VectorType) else number)

    def __add__(self, other: Lane | float) -> Lane:
        return self._new(self.builder.fadd(self.value, self._of(other), flags=_FUSED))

    def __sub__(self, other: Lane | float) -> Lane:
        return self._new(self.builder.fsub(self.value, self._of(other), flags=_FUSED))

    def __rsub__(self, other: float) -> Lane:
        return self._new(self.builder.fsub(self._of(other), self.value, flags=_FUSED))

    def __mul__(self, other: Lane | float) -> Lane:
        return self._new(self.builder.fmul(self.value, self._of(other), flags=_FUSED))

    def __truediv__(self, other: Lane | float) -> Lane:
        return self._new(self.builder.fdiv(self.value, self._of(other), flags=_FUSED))

    def __rtruediv__(self, other: float) -> Lane:
        return self._new(self.builder.fdiv(self._of(other), self.value, flags=_FUSED))

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> Lane:
        return self * -1.0

    def __lt__(self, other: Lane | float) -> Lane:
        return self._new(self.builder.fcmp_ordered("<", self.value, self._of(other)))

    def __gt__(self, other: Lane | float) -> Lane:
        return self._new(self.builder.fcmp_ordered(">", self.value, self._of(other)))

    def __and__(self, other: Lane) -> Lane:
        return self._new(self.builder.and_(self.value, other.value))

    def __or__(self, other: Lane) -> Lane:
        return self._new(self.builder.or_(self.value, other.value))

    def call(self, name: str, *others: Lane | float) -> Lane:
        """An intrinsic of LLVM, e.g. fabs."""
        kind = self.value.type
        suffix = f"v{kind.count}f64" if isinstance(kind, ir.VectorType) else "f64"
        function = cgutils.get_or_insert_function(
            self.builder.module, ir.FunctionType(kind, [kind] * (1 + len(others))), f"llvm.{name}.{suffix}"
        )
        return self._new(self.builder.call(function, [self.value, *(self._of(other) for other in others)]))

    def times_power_of_two(self, shifted: Lane) -> Lane:
        """self 2^k for the integer k that stands in the lowest bits of `shifted` (a number near 1.5 2^52)."""
        kind = self.value.type
        vector = isinstance(kind, ir.VectorType)
        bits = ir.VectorType(_INTEGER, kind.count) if vector else _INTEGER
        places = ir.Constant(bits, [52] * kind.count if vector else 52)
        exponent = self.builder.shl(self.builder.bitcast(shifted.value, bits), places)
        return self._new(
            self.builder.bitcast(self.builder.add(self.builder.bitcast(self.value, bits), exponent), kind)
        )


def where(condition: Lane, yes: Lane, no: Lane | float) -> Lane:
    """`yes` where the condition holds, else `no`."""
    return yes._new(yes.builder.select(condition.value, yes.value, yes._of(no)))


def absolute(x: Lane) -> Lane:
    return x.call("fabs")


def greater(x: Lane, y: Lane | float) -> Lane:
    """The greater of two; the second if one is NaN."""
    other = y if isinstance(y, Lane) else x._new(x._of(y))
    return where(x > other, x, other)


def less(x: Lane, y: Lane | float) -> Lane:
    """The less of two; the second if one is NaN."""
    other = y if isinstance(y, Lane) else x._new(x._of(y))
    return where(x < other, x, other)


def total(terms: list[Lane]) -> Lane:
    """Their sum, by pairs: the terms of each pair wait for each other only."""
    while len(terms) > 1:
        pairs = [a + b for a, b in zip(terms[::2], terms[1::2], strict=False)]
        terms = pairs + terms[len(pairs) * 2 :]
    return terms[0]


def dot(weights: Any, terms: list[Lane]) -> Lane:
    """sum_k weights_k terms_k, in order, each step one instruction; weights of zero are left out."""
    kept = [(float(weight), term) for weight, term in zip(weights, terms, strict=True) if weight != 0.0]
    result = kept[0][1] * kept[0][0]
    for weight, term in kept[1:]:
        result = result + term * weight
    return result


_LOG2_E = 1.4426950408889634
# ln 2 in two parts, the first with 21 trailing zero bits, so that k times it is exact
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10
_SHIFT = 1.5 * 2.0**52


def exponential(x: Lane) -> Lane:
    """exp(x) for -700 < x < 700: 2^k exp(f), |f| <= ln(2) / 2, by its series to f^12 (the next adds 2e-16)."""
    shifted = x * _LOG2_E + _SHIFT
    k = shifted - _SHIFT
    f = (x - k * _LN2_HIGH) - k * _LN2_LOW
    powers = [f]
    terms: list[Any] = [1.0 / math.factorial(j) for j in range(13)]
    while len(terms) > 1:  # by pairs, with f, f^2, f^4, ...
        pairs = [powers[-1] * b + a for a, b in zip(terms[::2], terms[1::2], strict=False)]
        terms = pairs + terms[len(pairs) * 2 :]
        powers.append(powers[-1] * powers[-1])
    return terms[0].times_power_of_two(shifted)


class Rows:
    """The rows of a table at some columns, by name, as a formula reads and writes them: a list, if one a node."""

    def __init__(self, context: Any, builder: Any, kind: Named, table: Any, column: Any) -> None:
        array = context.make_array(kind.array)(context, builder, builder.extract_value(table, 0))
        vars(self).update(
            _places=kind.table.places,
            _builder=builder,
            _data=array.data,
            _stride=cgutils.unpack_tuple(builder, array.shape)[1],
            _column=column,
        )

    def _at(self, row: int) -> Any:
        index = self._builder.add(self._builder.mul(self._stride, _INTEGER(row)), self._column)
        return self._builder.bitcast(
            self._builder.gep(self._data, [index]), ir.VectorType(_DOUBLE, WIDTH).as_pointer()
        )

    def _load(self, row: int) -> Lane:
        value = self._builder.load(self._at(row))
        value.align = 8
        return Lane(self._builder, value)

    def __getattr__(self, name: str) -> Any:
        first, count = self._places[name]
        return [self._load(first + k) for k in range(count)] if count else self._load(first)

    def __setattr__(self, name: str, value: Lane | list[Lane]) -> None:
        first, _ = self._places[name]
        for k, lane in enumerate([value] if isinstance(value, Lane) else value):
            self._builder.store(lane.value, self._at(first + k)).align = 8


class Numbers:
    """Numbers that are the same in every lane, by name: the first of a row, or all, where there is one row a node."""

    def __init__(self, context: Any, builder: Any, kind: Named, table: Any) -> None:
        made = context.make_array(kind.array)(context, builder, builder.extract_value(table, 0))
        self._places, self._builder, self._data = kind.table.places, builder, made.data
        self._stride = cgutils.unpack_tuple(builder, made.shape)[1]

    def __getattr__(self, name: str) -> Any:
        first, count = self._places[name]
        return [[self._load(first + k, j) for j in range(count)] for k in range(count)] or self._load(first, 0)

    def _load(self, row: int, column: int) -> Lane:
        builder, kind = self._builder, ir.VectorType(_DOUBLE, WIDTH)
        index = builder.add(builder.mul(self._stride, _INTEGER(row)), _INTEGER(column))
        undefined = ir.Constant(kind, ir.Undefined)
        one = builder.insert_element(undefined, builder.load(builder.gep(self._data, [index])), ir.IntType(32)(0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
        return Lane(builder, builder.shuffle_vector(one, undefined, zeros))


def on_rows(formula: Callable[[Any, Any], Lane | None]) -> Any:
    """A formula on rows of a table, for kernels.

    ``f(table, column, given)`` works on `WIDTH` columns from `column` on. `given` is a table of numbers, or an empty
    named tuple, whose class the formula gets, so that it can emit code for that class alone. If the formula returns a
    condition, f returns a number whose bit k says whether it holds in column k: `ALL` if it does in all.
    """

    @intrinsic
    def apply(typing_context, table, column, given):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            kind = signature.args[2]
            condition = formula(
                Rows(context, builder, signature.args[0], *arguments[:2]),
                Numbers(context, builder, kind, arguments[2]) if isinstance(kind, Named) else kind.instance_class,
            )
            if condition is None:
                return _INTEGER(0)
            return builder.zext(builder.bitcast(condition.value, ir.IntType(WIDTH)), _INTEGER)

        return types.int64(table, types.intp, given), codegen

    return apply


def on_number(formula: Callable[[Lane], tuple[Lane, Lane]]) -> Any:
    """A formula from a number to two numbers, for kernels."""

    @intrinsic
    def apply(typing_context, x):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            results = formula(Lane(builder, arguments[0]))
            return context.make_tuple(builder, signature.return_type, [result.value for result in results])

        return types.UniTuple(types.float64, 2)(types.float64), codegen

    return apply
