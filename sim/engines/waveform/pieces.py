"""How one block is solved on a macro step under the set-valued law, F given: piece by piece, from event to event.

F is the polynomial of degree five through its values at the start and the nodes. A block that sticks does so until
|F| passes its static friction m. One that slips to the side s obeys

    u' = -R u - F - mu s,    u = w - v,

whose power series needs F and u alone, and ends where u comes to zero: there the block sticks if |F| < m, else it
goes on to the other side. z is the integral of u + v; to the macro step, whose polynomials are of degree four, a
block gives the L2 projection of its z.

An exit is late by the error of F over F', and with static friction above the kinetic w is then off by m - mu times
that, however short the step is: its `lag` is (m - mu) / |F'|.

Blocks to which nothing happens are most: `slide` takes them side by side. Coefficients here are of powers of x, the
place in the macro step, over its length.
"""

from __future__ import annotations

import numpy as np

from stickslip.sim.engines.course import Events, touch
from stickslip.sim.engines.waveform import control
from stickslip.sim.engines.waveform.collocation import slide
from stickslip.sim.engines.waveform.layout import ORDER, Blocks, Changes, Model, Span, Substeps, Workspace, blocks
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.arithmetic import copy, room
from stickslip.sim.numerics.lanes import WIDTH
from stickslip.sim.numerics.radau import ALL_TO_POWERS, PROJECT, STAGES
from stickslip.sim.numerics.roots import BINOMIALS, horner, roots

#: Terms of a series below this share of the largest, or of the error of w allowed, are left out.
_LEAST, _LEAST_OF_ERROR = 1e-17, 1e-3
#: The integral over [0, 1] of the power k times the power q, 1 / (k + q + 1).
_MOMENTS = 1.0 / np.add.outer(np.arange(ORDER + 2), np.arange(1.0, STAGES + 1.0))
#: What a piece ends with.
_NOTHING, _EXIT, _STOP = range(3)
_NEVER = 2.0


@inner
def _first_fall(poly: Floats, degree: int, noise: float, places: Floats) -> float:
    """The first place in [0, 1] at which a polynomial falls through zero, or below it where it starts; else `_NEVER`.

    At the end it has fallen if it is below its `noise`.

    Where it begins below zero, by the rounding or the error of F, and rises, it has not fallen.
    """
    spread = 0.0
    for k in range(1, degree + 1):
        spread += abs(poly[k])
    if poly[0] - spread > noise:
        return _NEVER
    skip = 0
    while skip < degree and poly[skip] == 0.0:
        skip += 1
    if skip == degree:
        return _NEVER
    if poly[skip] > 0.0:
        if roots(poly[skip:], degree - skip, places[:1]) > 0:
            return places[0]
        return 1.0 if horner(poly, degree, 1.0) <= noise else _NEVER
    if skip > 0 or poly[1] <= 0.0:
        return 0.0
    for k in range(roots(poly, degree, places)):
        slope = 0.0
        for j in range(degree, 0, -1):
            slope = slope * places[k] + j * poly[j]
        if slope < 0.0:
            return places[k]
    return _NEVER


@inner
def _begin_force(block: Blocks, i: int, force: Floats) -> None:
    """The powers of F of block i about the start of the macro step."""
    for p in range(STAGES + 1):
        value = ALL_TO_POWERS[p, 0] * block.force0[i]
        for k in range(STAGES):
            value += ALL_TO_POWERS[p, k + 1] * block.f[k, i]
        force[p] = value


@inner
def _move_on(force: Floats, x: float) -> None:
    """The powers of F about a place x further on."""
    for k in range(STAGES + 1):
        for j in range(STAGES - 1, k - 1, -1):
            force[j] += x * force[j + 1]


@inner
def _until_exit(force: Floats, static: float, left: float, poly: Floats, places: Floats) -> float:
    """The place at which a block that sticks is let go, over what is left of the step, or `_NEVER`."""
    first = _NEVER
    for sign in (-1.0, 1.0):
        power = 1.0
        for p in range(STAGES + 1):
            poly[p] = -sign * force[p] * power
            power *= left
        poly[0] += static
        first = min(first, _first_fall(poly, STAGES, 0.0, places))
    return first


@inner
def _series_of_u(
    force: Floats, h: float, drag: float, push: float, u: float, length: float, least: float, series: Floats
) -> int:
    """The powers of u over a length h, scaled to it: (k + 1) u_k+1 = -R h u_k - h F_k - h mu s, the last for k = 0.

    `drag` is R h and `push` is h (F + mu s) at the start: a block that is let go at |F| = mu has none, to the last
    bit.
    `force` is in powers of x, and `length` over the macro step. Returns the order beyond which terms, which then fall
    like those of an exponential, are rounding, or below the `least`.
    """
    series[0], most = u, abs(u)
    power = length
    for k in range(ORDER):
        pull = drag * series[k]
        if k == 0:
            pull += push
        elif k <= STAGES:
            pull += h * force[k] * power
        series[k + 1] = -pull * _MOMENTS[k, 0]
        most = max(most, abs(series[k + 1]))
        if k >= STAGES and abs(series[k + 1]) <= max(_LEAST * most, least):
            return k
        power *= length
    return ORDER


@inner
def _gather(
    moments: Floats,
    local: Floats,
    travel: float,
    piece: tuple[float, float, float],
    belt: float,
    slip: tuple[Floats, int, float],
) -> float:
    """Add a piece, which begins `travel` from the start of the macro step, to the moments of z.

    Returns how far the block moves on it. Its `slip` is a share of a series; where it sticks the order is -1. `local`
    is workspace.
    """
    (x, length, h), (series, order, share) = piece, slip
    by_belt = h * length * belt
    for q in range(STAGES):
        local[q] = travel * _MOMENTS[0, q] + by_belt * _MOMENTS[1, q]
    by_slip, power = 0.0, h * length
    for k in range(order + 1):
        term = power * series[k] * _MOMENTS[k, 0]
        by_slip += term
        for q in range(STAGES):
            local[q] += term * _MOMENTS[k + 1, q]
        power *= share
    # from powers of the place in the piece to those of the place in the macro step
    power = length
    for q in range(STAGES):
        weight = power * local[q]
        for p in range(q, STAGES):
            moments[p] += BINOMIALS[p, q] * weight
            weight *= x
        power *= length
    return by_belt + by_slip


@inner
def _keep(
    pieces: Substeps,
    changes: Changes,
    place: int,
    piece: tuple[int, float, float, float, float],
    series: Floats,
    order: int,
) -> None:
    """Store a piece as a substep, and its series; where it sticks the order is -1."""
    i, x, length, share, z = piece
    pieces.block[place], pieces.start[place], pieces.length[place], pieces.z[place] = i, x, length, z
    changes.share[place], changes.order[place] = share, order
    for k in range(order + 1):
        changes.series[place, k] = series[k]


@inner
def _solve_block(work: Workspace, i: int, h: float, n_pieces: int) -> int:
    """Solve block i on the macro step; returns the number of pieces so far, of all blocks, or -1 - i if it fails."""
    block, pieces, changes, scratch = blocks(work.table), work.substeps, work.changes, room(5, 24)
    force, series, poly, places, moments = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    damping, mu, static, belt = block.damping[i], block.friction[i], block.static[i], block.belt[i]
    u, z, mode, x, z0 = block.u0[i], block.z0[i], block.mode[i], 0.0, block.z0[i]
    is_let_go, lag, least = False, 0.0, _LEAST_OF_ERROR * block.tolerance[i]
    _begin_force(block, i, force)
    for p in range(STAGES):
        moments[p] = 0.0
    for _ in range(control.MOST_PIECES):
        left = 1.0 - x
        if left <= control.NOTHING_LEFT:
            break
        event, order = _NOTHING, -1
        if mode == 0.0:
            first = _until_exit(force, static, left, poly, places)
            event = _EXIT if first < _NEVER else _NOTHING
        else:
            if abs(damping) * h * left > control.LONGEST_SERIES:
                left = control.LONGEST_SERIES / (abs(damping) * h)
            push = 0.0 if is_let_go and static == mu else h * left * (force[0] + mu * mode)
            order = _series_of_u(force, h, h * left * damping, push, u, left, least, series)
            for k in range(order + 1):
                poly[k] = mode * series[k]
            first = _first_fall(poly, order, control.AT_BELT * abs(belt), places)
            event = _STOP if first < _NEVER else _NOTHING
        share = first if event != _NOTHING else 1.0
        length = share * left
        if length > 0.0:
            if n_pieces == len(pieces.block):
                return -1 - i
            _keep(pieces, changes, n_pieces, (i, x, length, share, z), series, order)
            n_pieces += 1
            if mode != 0.0:
                u = horner(series, order, share)
            z += _gather(moments, poly, z - z0, (x, length, h), belt, (series, order, share))
            x += length
            _move_on(force, length)
        is_let_go = event == _EXIT
        if is_let_go and static > mu and h * (static - mu) > lag * abs(force[1]):
            lag = h * (static - mu) / abs(force[1]) if force[1] != 0.0 else np.inf
        if event != _NOTHING:
            u = 0.0
            new = 0.0 if event == _STOP and abs(force[0]) < static else (-1.0 if force[0] > 0.0 else 1.0)
            if new != mode:
                count = changes.n[0]
                if count == len(changes.x):
                    return -1 - i
                changes.x[count], changes.block[count], changes.mode[count] = x, i, np.int8(new)
                changes.slope[count] = force[1] / h if static == mu else 0.0
                changes.braked[count] = force[0] + mu * mode
                changes.n[0] = count + 1
            mode = new
    else:
        return -1 - i
    work.end_u[i], work.end_z[i], work.end_mode[i] = u, z, mode
    block.lag[i] = lag
    for k in range(STAGES):
        value = z0
        for p in range(STAGES):
            value += PROJECT[k, p] * moments[p]
        block.z[k, i] = value
    return n_pieces


@inner
def solve_exactly(model: Model, work: Workspace, h: float) -> tuple[int, int]:
    """Solve every block on a macro step, F at the nodes given; see `substeps.solve_blocks`."""
    block, n = blocks(work.table), len(work.is_split)
    n_split, n_pieces = 0, 0
    work.changes.n[0] = 0
    for first in range(0, n, WIDTH):
        ends = slide(block, first, model.law)
        for lane in range(min(WIDTH, n - first)):
            i = first + lane
            work.is_split[i] = ((ends >> lane) & 1) == 1
            if work.is_split[i]:
                n_split += 1
                n_pieces = _solve_block(work, i, h, n_pieces)
                if n_pieces < 0:
                    return n_split, n_pieces
    return n_split, n_pieces


@inner
def slip_at(changes: Changes, place: int, inside: float) -> tuple[float, float]:
    """u at a share of a piece, and its mean since the piece began."""
    series, order, x = changes.series[place], changes.order[place], changes.share[place] * inside
    u, mean = 0.0, 0.0
    for k in range(order, -1, -1):
        u, mean = u * x + series[k], mean * x + series[k] / (k + 1)
    return u, mean


@inner
def record_changes(work: Workspace, span: Span, error: float, events: Events, n_recorded: int) -> int:
    """Record the changes of mode on a macro step, `error` that of w; returns how many are recorded."""
    changes, mode, block = work.changes, work.modes[0], blocks(work.table)
    copy(mode, work.modes_before)
    for k in range(changes.n[0]):
        i, new = changes.block[k], changes.mode[k]
        events.t[n_recorded] = min(span.start + span.length * changes.x[k], span.end)
        events.block[n_recorded], events.mode[n_recorded] = i, new
        events.touch[n_recorded] = touch(mode[i], new, changes.slope[k], changes.braked[k], block.row_sum[i], error)
        mode[i] = new
        n_recorded += 1
    return n_recorded
