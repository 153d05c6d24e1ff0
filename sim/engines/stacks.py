"""Stacks of runs, whose arrays have an axis more in front: a kernel advances each by a slice."""

from __future__ import annotations

import operator
from typing import Any, Generic, NamedTuple, TypeVar

from numba import types
from numba.extending import intrinsic

from stickslip.sim.engines import course
from stickslip.sim.engines.course import Events, Precheck, State
from stickslip.sim.kernels.compile import inner
from stickslip.sim.kernels.emit import IS_COMPILED
from stickslip.sim.numerics.arguments import Ints

Model = TypeVar("Model")
Work = TypeVar("Work")
Goal = TypeVar("Goal")
Slip = TypeVar("Slip", int, Ints)


class Stack(NamedTuple, Generic[Model, Work, Goal, Slip]):
    """Runs that one call advances, as `frame` takes them. Arrays have a place for each run; see `course.by_run`."""

    model: Model
    work: Work
    goal: Goal
    state: State
    slip: Slip  #: of the pre-check
    precheck: Precheck  #: of the first
    events_a_step: int  #: the most that one step can record


def _type_of_run(kind: Any) -> Any:
    """The type of one run's part, from that of a stack's."""
    if isinstance(kind, types.Array):
        return kind.copy(ndim=kind.ndim - 1) if kind.ndim > 1 else kind.dtype
    if not hasattr(kind, "instance_class"):
        return kind
    fields = [
        _type_of_run(part) if course.is_by_run(kind.instance_class, name) else part
        for name, part in zip(kind.fields, kind.types, strict=True)
    ]
    return types.BaseTuple.from_types(fields, kind.instance_class)


def _emit_run(context: Any, builder: Any, kind: Any, value: Any, k: Any) -> Any:
    of_run = _type_of_run(kind)
    if of_run == kind:
        return value
    if isinstance(kind, types.Array):
        return context.get_function(operator.getitem, of_run(kind, types.intp))(builder, (value, k))
    fields = [builder.extract_value(value, place) for place in range(len(kind.fields))]
    fields = [
        _emit_run(context, builder, part, field, k) if course.is_by_run(kind.instance_class, name) else field
        for name, part, field in zip(kind.fields, kind.types, fields, strict=True)
    ]
    return context.make_tuple(builder, of_run, fields)


def _run_of(typing_context: Any, stack: Any, k: Any) -> Any:
    """Run k of a stack, as tuples of views."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _emit_run(context, builder, stack, *arguments)

    return _type_of_run(stack)(stack, types.intp), codegen


run_of: Any = intrinsic(_run_of) if IS_COMPILED else course.of_run


@inner
def rest_of(events: Events, slices: Ints, k: int) -> Events:
    """What is left of the buffers of a stack for the events of run k."""
    n_recorded, n_all_stuck = 0, 0
    for j in range(k):
        n_recorded += slices[j, 1]
        n_all_stuck += slices[j, 2]
    t, block, mode, touch, all_stuck = events
    return Events(
        t[n_recorded:], block[n_recorded:], mode[n_recorded:], touch[n_recorded:], all_stuck[:, n_all_stuck:]
    )


@inner
def note_slice(slices: Ints, k: int, status: int, n_recorded: int, counters: Ints) -> None:
    """Note why run k of a stack ended its slice, and how many events and all-stuck intervals it recorded."""
    slices[k, 0], slices[k, 1], slices[k, 2] = status, n_recorded, counters[course.N_ALL_STUCK]
