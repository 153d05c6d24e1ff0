"""What chance gives: null models for cascades, each with one thing kept and one thing broken.

=================  =======================================  =============================================
model              kept                                     broken
=================  =======================================  =============================================
fair order         nothing                                  all: exits and entries by the toss of a coin
random order       times of change, share of exits          which of the changes are exits
finite pool        number of blocks, mean n_stick           all else: blocks with constant rates (`stats.pool`)
rotation           each block's own series of events        the blocks' timing relative to each other
=================  =======================================  =============================================

Fair order gives `events` P(k) = 2^-k, gamma = ln 2 (`stats.estimates.LN2`). The finite pool has gamma by `events` in
closed form too, random order the expected cascades by every definition. Rotation is simulated. It is the null of "no
coupling": it keeps that a block cannot let go twice without having stuck in between, and the block's own rhythm.
`stats.pool` says which null answers which question.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from stickslip.analysis.stats import cascades
from stickslip.analysis.stats.cascades import Law, Window

#: Rotations of each run at most. They scatter as the run does, so d of them add a share of 1 / d to the variance of a
#: difference from chance: 10 widen intervals by 5%. The intervals contain it, each matrix being set against its own.
DRAWS = 10
Sums = dict[Law, np.ndarray]  # total size and number of cascades, the two columns that `estimates.gamma` reads

# ------------------------------------------------------------------------------------------- random order


def random_order(win: Window, dts: Sequence[float]) -> Sums:
    """Expected cascades if each change is an exit with the observed share of exits, whatever the others are.

    The times stay, so a step of dt with k changes falls by 2X - k, X ~ Binomial(k, p), independently of the other
    steps; p is the share of exits. With f, u and o the probabilities that a step falls, rises and does neither:

    - `length`, `drop`: a step that falls is the last of its run with probability 1 - f of the next step;
    - `decreases`, `descent`: with the probability x that the next step which moves rises, x_j = u_j + o_j x_j+1;
    - the sizes of all runs add up to the number of falling steps, or to E[2X - k; 2X > k].

    Parameters
    ----------
    win : Window
    dts : sequence of float
    """
    times = np.abs(win.step)  # a change by k counts as k changes
    n_changes, n_exits = int(times.sum()), int(np.maximum(-win.step, 0).sum())
    p = n_exits / max(n_changes, 1)
    found: Sums = {Law("events"): np.array([n_exits, n_exits * (1 - p)])}
    for dt in dts:
        changes = win.sampled(dt, times).astype(np.int64)
        falls, rises, depths = _binomial_step(np.arange(changes.max(initial=0) + 1), p)
        fall = falls[changes]
        last = np.sum(fall[:-1] * (1 - fall[1:]))
        found[Law("drop", dt)] = np.array([depths[changes[:-1]].sum(), last])
        found[Law("length", dt)] = np.array([fall[:-1].sum(), last])
        changes = changes[changes > 0]
        fall, rise = falls[changes], rises[changes]
        last = np.sum(fall[:-1] * _next_rises(rise[1:], 1 - fall[1:] - rise[1:]))
        found[Law("descent", dt)] = np.array([depths[changes[:-1]].sum(), last])
        found[Law("decreases", dt)] = np.array([fall[:-1].sum(), last])
    return found


def _binomial_step(k: np.ndarray, p: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """P(2X > k), P(2X < k) and E[2X - k; 2X > k], X ~ Binomial(k, p)."""
    half = k // 2
    fall = np.where(k > 0, special.bdtrc(half, k, p), 0.0)
    rise = np.where(k > 0, special.bdtr(np.maximum(k - half - 1, 0), np.maximum(k, 1), p), 0.0)
    # E[X; X > h] = k p P(Binomial(k - 1, p) >= h)
    enough = np.where(half > 0, special.bdtrc(np.maximum(half - 1, 0), np.maximum(k - 1, 0), p), 1.0)
    return fall, rise, k * (2 * p * enough - fall)


def _next_rises(rise: np.ndarray, still: np.ndarray) -> np.ndarray:
    """x_j = rise_j + still_j x_j+1, 0 after the last: that the first step from j on which moves rises."""
    found, still, reach = rise.copy(), still.copy(), 1
    while reach < len(found) and still.max() > 1e-15:  # composed over 1, 2, 4, ... steps
        found[:-reach] += still[:-reach] * found[reach:]
        still[:-reach] *= still[reach:]
        still[-reach:] = 0.0
        reach *= 2
    return found


# --------------------------------------------------------------------------------------- rotation of blocks


@dataclass(frozen=True)
class BlockSteps:
    """Exits and entries of each block in (t_start, t_stop], in order of time; crossings are left out.

    Attributes
    ----------
    t_start, t_stop : float
    t : ndarray, shape (m,)
    block : ndarray of int, shape (m,)
    step : ndarray of int, shape (m,)
        -1 for an exit, +1 for an entry.
    """

    t_start: float
    t_stop: float
    t: np.ndarray
    block: np.ndarray
    step: np.ndarray

    @property
    def span(self) -> float:
        return self.t_stop - self.t_start

    def exits(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and blocks of the exits."""
        is_exit = self.step < 0
        return self.t[is_exit], self.block[is_exit]

    def window(self) -> Window:
        """The changes as a window of n_stick; its level is not known and stands as zero."""
        return Window(self.t_start, self.t_stop, 0, self.t, self.step)


def block_steps(
    t: np.ndarray, block: np.ndarray, mode: np.ndarray, initial_mode: np.ndarray, t_start: float, t_stop: float
) -> BlockSteps:
    """Exits and entries of each block, from the events of a run.

    Parameters
    ----------
    t, block, mode : ndarray, shape (m,)
        Events in order of time: the block's mode (-1, 0, +1) from t on; it sticks where that is 0.
    initial_mode : ndarray, shape (n,)
    t_start, t_stop : float

    Raises
    ------
    ValueError
        If the times fall or are not one with the blocks and modes.
    """
    if not len(t) == len(block) == len(mode):
        raise ValueError(f"t, block, mode: expected one length, got {len(t)}, {len(block)} and {len(mode)}")
    if (np.diff(t) < 0).any():
        raise ValueError("t: expected times that do not decrease; sort the events by time")
    by_block = in_order(block)
    sticks = (np.asarray(mode) == 0).astype(np.int64)
    before = np.empty_like(sticks)
    before[by_block[1:]] = sticks[by_block[:-1]]
    is_first = np.concatenate(([True], np.diff(block[by_block]) != 0))[: len(t)]
    firsts = by_block[is_first]
    before[firsts] = np.asarray(initial_mode)[block[firsts]] == 0
    step = sticks - before
    kept = (step != 0) & (t > t_start) & (t <= t_stop)
    return BlockSteps(float(t_start), float(t_stop), t[kept], block[kept], step[kept])


def in_order(block: np.ndarray) -> np.ndarray:
    """What sorts blocks, and leaves the order of those that are the same."""
    is_small = len(block) == 0 or block.max() < 2**16  # of such numbers it takes a tenth of the time
    return np.argsort(block.astype(np.uint16) if is_small else block, kind="stable")


def rotated(steps: BlockSteps, rng: np.random.Generator) -> BlockSteps:
    """A surrogate without coupling: each block's series turned in the window by a random amount of its own.

    Taken as periodic, a block's rhythm, its numbers and the order of its events stay; how the blocks stand to
    each other is drawn anew. Where a block does not end the window as it began it, the seam would add one exit
    or entry that nobody saw: it is dropped, so that the surrogate has exactly the observed exits and entries
    (its path may then leave 0..n, where only falls are counted). In 20 runs of n = 200 over 400 units the seams
    would have added 1.3% of changes; kept or dropped, gamma by `events` came out the same to 0.0001.
    """
    t = steps.t_start + _turned(steps, rng)
    order = np.argsort(t)
    return BlockSteps(steps.t_start, steps.t_stop, t[order], steps.block[order], steps.step[order])


def _turned(steps: BlockSteps, rng: np.random.Generator) -> np.ndarray:
    """Times since t_start of the steps of such a surrogate, in their old order."""
    n_blocks = int(steps.block.max()) + 1 if len(steps.block) else 0
    shift = rng.uniform(0, steps.span, n_blocks)
    return (steps.t - steps.t_start + shift[steps.block]) % steps.span


def rotated_steps(steps: BlockSteps, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The steps of such a surrogate without their blocks, in a quarter of the time: times since t_start, and changes.

    Numbers above zero sort as their bits do: the last bit of a time says what the step is, and is sorted with it.
    """
    bits = _turned(steps, rng).view(np.int64)
    bits &= -2
    bits |= steps.step < 0
    bits.sort()
    return bits.view(np.float64), 1 - 2 * (bits & 1)


def rotations(steps: BlockSteps, dts: Sequence[float], draws: int, rng: np.random.Generator) -> Sums:
    """Cascades if the blocks did not act on each other: all those of `draws` surrogates by `rotated`."""
    found: Sums = {law: np.zeros(2) for law in cascades.laws(dts)}
    steps_of = {dt: int(steps.span / dt * (1 + 1e-12)) for dt in dts}
    for _ in range(draws):
        t, step = rotated_steps(steps, rng)
        drawn, nets = cascades.sums(step), dict[float, np.ndarray]()
        for dt in sorted(dts):
            finer, k = _divisor(dt, nets)
            if k:
                whole = nets[finer][: len(nets[finer]) // k * k]
                nets[dt] = whole.reshape(-1, k) @ np.ones(k)
            else:
                nets[dt] = np.bincount((t / dt).astype(np.int64), step, steps_of[dt])
            drawn |= cascades.sums(nets[dt][: steps_of[dt]], dt)
        for law, one in drawn.items():
            found[law] += one
    return found


def _divisor(dt: float, finer: Iterable[float]) -> tuple[float, int]:
    """The longest of some shorter steps that dt is a multiple of, and which; 0 if there is none."""
    multiples = ((one, round(dt / one)) for one in finer)
    return max(((one, k) for one, k in multiples if abs(k * one - dt) < 1e-12 * dt), default=(dt, 0))


def triggered(steps: BlockSteps, share: float, delay: float, rng: np.random.Generator) -> BlockSteps:
    """Positive control: a surrogate by `rotated` in which a share of the exits is made to follow others.

    round(share * exits) of them, drawn at random, move to an exponential delay (mean `delay`) after one of the
    exits that stay, each drawn at random; one that would fall beyond the window goes on at its start. A moved
    exit stays with its block.
    """
    free = rotated(steps, rng)
    exits = np.flatnonzero(free.step < 0)
    rng.shuffle(exits)
    n_moved = min(round(share * len(exits)), len(exits) - 1) if len(exits) else 0
    if n_moved <= 0:
        return free
    moved, stay = exits[:n_moved], exits[n_moved:]
    t = free.t.copy()
    t[moved] = t[rng.choice(stay, n_moved)] + rng.exponential(delay, n_moved)
    t = free.t_start + (t - free.t_start) % free.span
    order = np.argsort(t, kind="stable")
    return BlockSteps(free.t_start, free.t_stop, t[order], free.block[order], free.step[order])
