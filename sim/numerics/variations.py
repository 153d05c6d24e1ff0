"""Deviations from a motion, carried along it from event to event, many at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.kernels.compile import kernel
from stickslip.sim.kernels.emit import Array, Code, Index, Lane, emitted
from stickslip.sim.numerics.arguments import Floats, Ints
from stickslip.sim.numerics.arithmetic import copy
from stickslip.sim.numerics.panels import HEIGHT, listed_products

#: The most terms of a series.
_ORDERS = 40
#: Rows of a matrix that are multiplied at a time.
_ROWS = 4
_product = listed_products(_ROWS, HEIGHT, False)


@emitted
def _next_term(
    code: Code, share: Lane, pulled: Array, c: Index, drags: Array, drag: Index, powers: Index, series: Array,
    row: Index, moved: Array, i: Index, n: Index,
) -> None:  # fmt: skip
    """The next term of z_i and w_i, for the columns of a panel, from that of w_i, and what pulls at the block."""
    force, times = code.cell(pulled.load(c * HEIGHT, HEIGHT)), code.spread(share, HEIGHT)

    def resist(power: Index) -> None:
        w = series.load((row - power * n * 2) * HEIGHT, HEIGHT)
        force.value = code.fused(-w, code.spread(drags[drag + power * n], HEIGHT), force.value)

    code.loop(powers, resist)
    z, w = series.load(row * HEIGHT, HEIGHT) * times, force.value * times
    for place, total, term in ((row + n, i, z), (row + n * 2, i + n, w)):
        series.store(place * HEIGHT, term)
        moved.store(total * HEIGHT, moved.load(total * HEIGHT, HEIGHT) + term)


class Course(NamedTuple):
    """Stays, in which the same blocks slip, with what begins each, and steps of them.

    An event multiplies the deviation of w of its block; that of an exit becomes that of its F times the factor.
    """

    block: Ints  #: of the event that begins each stay, shape (m,); -1: none
    factor: Floats  #: shape (m,)
    is_exit: NDArray[np.bool_]  #: shape (m,)
    first: Ints  #: step of each, shape (m,)
    counts: Ints  #: of its steps, shape (m,)
    n_slip: Ints  #: how many blocks slip, shape (m,)
    order: Ints  #: the blocks, those that slip first, shape (m, n)
    lengths: Floats  #: of steps, shape (q,)
    orders: Ints  #: of their series, shape (q,)
    drags: Floats  #: d by powers of the share of a step that is over, shape (q, powers, n)


def carried(deviations: Floats, pull: Floats, course: Course, start: int, end: int) -> Floats:
    """Deviations (z, w), shape (2n, m), carried over the stays from one to before another.

    Of a block that slips, z' = w and w' = A (z, w) - d w; of others none change. A is `pull`, shape (n, 2n), without
    what of w_i pulls at block i, which is part of d.
    """
    (n, width), m = pull.shape, deviations.shape[1]
    panels = np.zeros((-(-m // HEIGHT), width, HEIGHT))
    for k in range(m):
        panels[k // HEIGHT, :, k % HEIGHT] = deviations[:, k]
    room = np.empty((_ORDERS + 1, 1, width, HEIGHT)), np.empty((n + _ROWS, width)), np.empty((_ROWS, HEIGHT))
    _carry(panels, pull, bool(pull[:, n:].any()), course, start, end, *room, np.empty(width, dtype=np.int64))
    return panels.swapaxes(0, 1).reshape(width, -1)[:, :m]


@kernel
def _carry(
    panels: Floats, pull: Floats, has_cross: bool, course: Course, start: int, end: int, series: Floats, rows: Floats,
    product: Floats, columns: Ints,
) -> None:  # fmt: skip
    n, n_powers = len(pull), course.drags.shape[1]
    for stay in range(start, end):
        block, factor, is_exit = course.block[stay], course.factor[stay], course.is_exit[stay]
        for p in range(len(panels) if block >= 0 else 0):
            moved = panels[p]
            for k in range(HEIGHT):
                moved[n + block, k] *= 0.0 if is_exit else factor
            for j in range(2 * n if is_exit else 0):
                for k in range(HEIGHT):
                    moved[n + block, k] += factor * pull[block, j] * moved[j, k]

        n_slip = course.n_slip[stay]
        n_w = n_slip if has_cross else 0
        for a in range(n):
            i = course.order[stay, a]
            if a < n_slip:
                copy(pull[i], rows[a])
                columns[a] = n + i
            columns[n_w + a] = i

        for q in range(course.first[stay], course.first[stay] + course.counts[stay]):
            for p in range(len(panels)):
                moved = panels[p]
                for i in range(2 * n):
                    copy(moved[i], series[0, 0, i])
                for order in range(1, course.orders[q] + 1):
                    n_moving, powers = n_w + (n if order == 1 else n_slip), min(order, n_powers)
                    for a in range(0, n_slip, _ROWS):
                        _product(series[order - 1], rows[a : a + _ROWS], product, columns, n_moving)
                        for c in range(min(_ROWS, n_slip - a)):
                            i = columns[n_w + a + c]
                            drag, row = q * n_powers * n + i, (order - 1) * 2 * n + n + i
                            share = course.lengths[q] / order
                            _next_term(share, product, c, course.drags, drag, powers, series, row, moved, i, n)
