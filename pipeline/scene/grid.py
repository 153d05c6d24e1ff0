"""The grid of a sweep: its axes, from the keys that hold lists."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

from stickslip.pipeline.design.design import Axis
from stickslip.pipeline.design.values import Quantity, order
from stickslip.pipeline.scene.toml import once
from stickslip.sim.numerics.arguments import did_you_mean


def axes(quantities: Mapping[str, Quantity | None], together: Sequence[Sequence[str]] = ()) -> tuple[Axis, ...]:
    """The axes of the grid that some keys span, in their order: one for each list; those named together share one.

    Raises `ValueError` if a name in `together` has no list or is there twice, or lists that go together differ in
    length.
    """
    lists = {key: value for key, value in quantities.items() if isinstance(value, tuple)}
    keys_together = list(itertools.chain.from_iterable(together))
    singles = [names for names in together if len(names) < 2]
    if singles:
        raise ValueError(f'expected two keys or more to go together, as [["kappa", "rho"]], got {list(singles[0])!r}')
    for key in once(keys_together, n_least=0):
        if key not in lists:
            hint = f"; lists are there for {', '.join(lists)}" if lists else "; write lists, or remove it"
            raise ValueError(f"expected keys that hold lists, got {key!r}{did_you_mean(key, lists) or hint}")
    grid: list[Axis] = []
    for key in lists:
        keys = next((tuple(sorted(names, key=list(lists).index)) for names in together if key in names), (key,))
        if keys[0] != key:
            continue
        lengths = [len(lists[name]) for name in keys]
        if len(set(lengths)) > 1:
            lengths_of = ", ".join(f"{length} of {name}" for name, length in zip(keys, lengths, strict=True))
            raise ValueError(f"expected lists of one length to go together, got {lengths_of} values; make them equal")
        grid.append(Axis(keys, tuple(sorted(zip(*(lists[name] for name in keys), strict=True), key=order))))
    return tuple(grid)
