"""How one block is solved on a macro step with F given: in one step, or in substeps of its own.

`step.py` calls `solve_blocks` and `probe_blocks`, which give u and z at the nodes, the blocks that took substeps, and
where those ended. The formulas are those of `collocation.py`, on blocks side by side.
"""

from __future__ import annotations

from typing import NamedTuple

from stickslip.sim.engines.waveform import control
from stickslip.sim.engines.waveform.collocation import (
    finish,
    finish_of,
    gather,
    gather_u,
    newton,
    newton_of,
    prepare,
    probe,
    probe_of,
)
from stickslip.sim.engines.waveform.layout import OF_BLOCK, Blocks, Lanes, Model, Repeated, Workspace, blocks
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.arithmetic import copy
from stickslip.sim.numerics.lanes import NARROW, WIDTH
from stickslip.sim.numerics.radau import PROJECT, STAGES, TO_POWERS


@inner
def _split(work: Workspace, first: int, failed: int, n_split: int, anew: bool) -> int:
    """List those of `WIDTH` blocks that are not accepted, if `anew` with those listed before; returns how many."""
    is_split = work.is_split
    for lane in range(min(WIDTH, len(is_split) - first)):
        i = first + lane
        if anew if is_split[i] else ((failed >> lane) & 1) == 1:
            is_split[i] = True
            work.split[n_split] = i
            n_split += 1
    return n_split


@inner
def _in_one_step(law: NamedTuple, work: Workspace) -> int:
    """Solve all blocks in one step; returns how many are listed for substeps, including those marked before."""
    block, n = blocks(work.table), len(work.is_split)
    n_split, is_any_split = 0, False
    for i in range(n):
        block.done[i] = 1.0 if work.is_split[i] else 0.0
        is_any_split = is_any_split or work.is_split[i]
    for first in range(0, n, WIDTH):
        for _ in range(control.MOST_NEWTON):
            if newton(block, first, law) == 0:
                break
        failed = finish(block, first, law)
        if is_any_split or failed != 0:
            n_split = _split(work, first, failed, n_split, True)
    return n_split


@inner
def probe_blocks(law: NamedTuple, work: Workspace, n_split: int) -> int:
    """List also the blocks whose step fails the error test off the nodes; returns how many are listed."""
    block = blocks(work.table)
    for first in range(0, len(work.is_split), WIDTH):
        failed = probe(block, first, law)
        if failed != 0:
            n_split = _split(work, first, failed, n_split, False)
    return n_split


@inner
def solve_blocks(model: Model, work: Workspace, h: float, is_last: bool) -> tuple[int, int]:
    """Solve every block on a macro step, F at the nodes given.

    Returns the number of blocks that took substeps, and of substeps, or -1 - i if block i cannot be solved. In the
    last iteration all blocks are tested off the nodes.
    """
    n_split = _in_one_step(model.law, work)
    if is_last:
        n_split = probe_blocks(model.law, work, n_split)
    for k in range(n_split):
        work.next_h[work.split[k]] = work.next_h_before[work.split[k]]
    return n_split, _substep(model, work, n_split, h)


@inner
def keep_substeps(work: Workspace, n_substeps: int) -> None:
    """Keep the substeps of an iteration for the next."""
    substeps, repeated = work.substeps, work.repeated
    for k in range(n_substeps):
        repeated.after[k], repeated.length[k] = substeps.after[k], substeps.length[k]
        copy(substeps.u[k], repeated.u[k])


@inner
def _clear(lanes: Lanes) -> None:
    """Free all lanes, and fill them with harmless numbers."""
    table, in_lanes = lanes.table, blocks(lanes.table)
    for lane in range(NARROW):
        for row in range(len(table)):
            table[row, lane] = 0.0
        in_lanes.h[lane] = 1.0
        in_lanes.steep[lane] = 1.0
        lanes.block[lane], lanes.again[lane], lanes.last[lane] = -1, -1, -1


@inner
def _enter(work: Workspace, i: int, lane: int, h: float) -> None:
    """Put block i into a lane, at the start of the macro step."""
    lanes, block, in_lanes = work.lanes, blocks(work.table), blocks(work.lanes.table)
    lanes.block[lane], lanes.again[lane], lanes.last[lane] = i, work.begins[i], -1
    for row in OF_BLOCK:
        lanes.table[row, lane] = work.table[row, i]
    for p in range(STAGES):
        value = 0.0
        for k in range(STAGES):
            value += TO_POWERS[p, k] * block.f[k, i]
        in_lanes.g[p, lane] = value
        in_lanes.moment[p, lane] = 0.0
        in_lanes.moment_u[p, lane] = 0.0
    in_lanes.start[lane] = 0.0
    in_lanes.z_macro[lane], in_lanes.u_macro[lane] = block.z0[i], block.u0[i]
    in_lanes.length[lane] = min(work.next_h[i] / h, 1.0)


@inner
def _set_lengths(lanes: Lanes, before: Repeated, h: float) -> None:
    """Set the lengths of the next substeps: as in the iteration before, or such that no rest is short."""
    in_lanes = blocks(lanes.table)
    for lane in range(NARROW):
        in_lanes.done[lane] = 1.0 if lanes.block[lane] < 0 else 0.0
        if lanes.block[lane] >= 0:
            rest = 1.0 - in_lanes.start[lane]
            length = in_lanes.length[lane]
            if lanes.again[lane] >= 0:
                length = before.length[lanes.again[lane]]
            elif length > control.SUBSTEP_TAKES_ALL * rest:
                length = rest
            elif length > 0.5 * rest:
                length = 0.5 * rest
            in_lanes.length[lane] = length
            in_lanes.h[lane] = length * h


@inner
def _solve(lanes: Lanes, before: Repeated, model: Model) -> None:
    """Take a substep in every lane, with the result of the iteration before as first guess, and test it."""
    in_lanes = blocks(lanes.table)
    prepare(in_lanes, 0, model.law)
    for lane in range(NARROW):
        if lanes.again[lane] >= 0:
            for k in range(STAGES):
                in_lanes.u[k, lane] = before.u[lanes.again[lane], 1 + k]
    for _ in range(control.MOST_NEWTON_OF_SUBSTEP):
        if newton_of(in_lanes, 0, model.law) == 0:
            break
    finish_of(in_lanes, 0, model.law)
    probe_of(in_lanes, 0, model.law)
    for lane in range(NARROW):
        accepted = lanes.block[lane] >= 0 and in_lanes.done[lane] > 0.5 and in_lanes.suspect[lane] < 0.5
        accepted = accepted and in_lanes.error[lane] <= in_lanes.allowed[lane]
        in_lanes.taken[lane] = in_lanes.length[lane] if accepted else 0.0
    gather(in_lanes, 0, model.law)
    if model.has_cross:
        gather_u(in_lanes, 0, model.law)


@inner
def _factor(in_lanes: Blocks, lane: int) -> float:
    """The ratio of the next substep to this one."""
    if in_lanes.done[lane] < 0.5:
        return control.SHRINK_UNSOLVED
    factor = control.SAFETY * (in_lanes.allowed[lane] / max(in_lanes.error[lane], 1e-300)) ** (1.0 / STAGES)
    return min(max(factor, control.SHRINK_SUBSTEP), control.GROW_SUBSTEP)


@inner
def _move_on(work: Workspace, lane: int, place: int) -> None:
    """Store an accepted substep in this place, and go to its end."""
    lanes, in_lanes, substeps = work.lanes, blocks(work.lanes.table), work.substeps
    i, last, again = lanes.block[lane], lanes.last[lane], lanes.again[lane]
    start, length = in_lanes.start[lane], in_lanes.length[lane]
    substeps.block[place], substeps.after[place] = i, -1
    if last < 0:
        work.begins[i] = place
    else:
        substeps.after[last] = place
    lanes.last[lane] = place
    substeps.start[place], substeps.length[place] = start, length
    substeps.z[place], substeps.u[place, 0] = in_lanes.z0[lane], in_lanes.u0[lane]
    for k in range(STAGES):
        substeps.u[place, 1 + k] = in_lanes.u[k, lane]
    if again >= 0:
        lanes.again[lane] = work.repeated.after[again]
    if lanes.again[lane] < 0:
        in_lanes.length[lane] = length * _factor(in_lanes, lane)
    in_lanes.u0[lane] = in_lanes.u[STAGES - 1, lane]
    in_lanes.z0[lane] = in_lanes.z[STAGES - 1, lane]
    in_lanes.start[lane] = start + length


@inner
def _project(moments: Floats, since: Floats, lane: int, values: Floats, i: int) -> None:
    """The L2 projection, at the nodes of the macro step, from the moments in a lane."""
    for k in range(STAGES):
        value = since[lane]
        for p in range(STAGES):
            value += PROJECT[k, p] * moments[p, lane]
        values[k, i] = value


@inner
def _leave(model: Model, work: Workspace, lane: int, h: float) -> None:
    """Free the lane of a block that has reached the end of the macro step, and store its result."""
    lanes, in_lanes, block = work.lanes, blocks(work.lanes.table), blocks(work.table)
    i = lanes.block[lane]
    work.end_u[i], work.end_z[i] = in_lanes.u0[lane], in_lanes.z0[lane]
    work.next_h[i] = in_lanes.length[lane] * h
    block.u[STAGES - 1, i] = in_lanes.u0[lane]  # whether it has come to its layer
    _project(in_lanes.moment, in_lanes.z_macro, lane, block.z, i)
    if model.has_cross:
        _project(in_lanes.moment_u, in_lanes.u_macro, lane, block.mean_u, i)
    lanes.block[lane], lanes.again[lane] = -1, -1
    in_lanes.h[lane] = 1.0
    in_lanes.steep[lane] = 1.0
    in_lanes.friction[lane] = 0.0
    for k in range(STAGES):
        in_lanes.g[k, lane] = 0.0


@inner
def _substep(model: Model, work: Workspace, n_split: int, h: float) -> int:
    """Solve the listed blocks in substeps, side by side. Returns the number of substeps, or -1 - i if block i fails.

    A block repeats the substeps of the last iteration, with their results as first guesses, as long as they pass.
    """
    lanes, in_lanes, before = work.lanes, blocks(work.lanes.table), work.repeated
    n_substeps, n_entered, n_left = 0, 0, n_split
    _clear(lanes)
    while n_left > 0:
        for lane in range(NARROW):
            if lanes.block[lane] < 0 and n_entered < n_split:
                _enter(work, work.split[n_entered], lane, h)
                n_entered += 1
        _set_lengths(lanes, before, h)
        _solve(lanes, before, model)
        for lane in range(NARROW):
            i = lanes.block[lane]
            if i < 0:
                continue
            if in_lanes.taken[lane] == 0.0:
                length = in_lanes.length[lane]
                in_lanes.length[lane] = length * min(_factor(in_lanes, lane), control.HALVE)
                lanes.again[lane] = -1
                if not length > control.SHORTEST_SUBSTEP:
                    return -1 - i
                continue
            if n_substeps == len(work.substeps.block):
                return -1 - i
            _move_on(work, lane, n_substeps)
            n_substeps += 1
            if in_lanes.start[lane] >= 1.0 - control.NOTHING_LEFT:
                _leave(model, work, lane, h)
                n_left -= 1
    return n_substeps
