"""What chance gives: null models for cascades, each with one thing kept and one thing broken.

=================  =======================================  =============================================
model              kept                                     broken
=================  =======================================  =============================================
fair order         nothing                                  all: exits and entries by the toss of a coin
random order       times of change, numbers of exits and    which of the changes are exits
                   entries
independent        rates of exits and entries               all else: two Poisson processes
finite pool        number of blocks, mean n_stick           all else: blocks with constant rates (`stats.pool`)
rotation           each block's own series of events        the blocks' timing relative to each other
=================  =======================================  =============================================

Fair order gives `events` P(k) = 2^-k, gamma = ln 2 (`stats.estimates.LN2`). The finite pool has gamma by `events` in
closed form too, `independent` by every definition (`independent_sums`). Random order and rotation are simulated.
Rotation is the null of "no coupling": it keeps that a block cannot let go twice without having stuck in between, and
the block's own rhythm. `stats.pool` says which null answers which question.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from stickslip.analysis.stats.cascades import SAMPLED, Law, Window, cluster_sizes, sizes_of_path
from stickslip.analysis.stats.estimates import add_histograms, gamma, jackknife


@dataclass
class NullTally:
    """Cascades of one definition under a null model, added up over its draws and over members.

    Attributes
    ----------
    totals, counts : ndarray, shape (draws,)
        Total size and number of cascades of each draw.
    histogram : ndarray of int
        histogram[k] is the number of cascades of size k over all draws.
    """

    totals: np.ndarray
    counts: np.ndarray
    histogram: np.ndarray = field(default_factory=lambda: np.zeros(1, dtype=np.int64))

    def __iadd__(self, other: NullTally) -> NullTally:
        self.totals = self.totals + other.totals
        self.counts = self.counts + other.counts
        self.histogram = add_histograms(self.histogram, other.histogram)
        return self

    def add(self, draw: int, found: np.ndarray) -> None:
        """Put in the sizes found in one draw."""
        self.totals[draw] += found.sum()
        self.counts[draw] += len(found)
        self.histogram = add_histograms(self.histogram, np.bincount(found))

    def sums(self) -> np.ndarray:
        """Totals and counts as the two columns that `gamma` reads, shape (draws, 2)."""
        return np.column_stack([self.totals, self.counts])

    def rate(self) -> tuple[float, float]:
        """gamma under the null and its Monte-Carlo error; raises `Undefined` where there is none."""
        return jackknife(gamma, self.sums())


Tallies = dict[Law, NullTally]
PLENTY = 20  # runs of a group; with more, each needs fewer draws


def draws_each(asked: int, n_runs: int, least: int) -> int:
    """Draws of a null model for each run of a group: `asked`, or as many in all as `PLENTY` runs would have.

    The draws of a run scatter as the run itself does, so d of them add a share of at most about 1 / d to the
    variance of a difference from chance, whatever the number of runs: 20 widen intervals by 2.5%, 10 by 5%. The
    intervals contain it, since each matrix is set against its own draws.
    """
    return min(asked, max(least, asked * PLENTY // max(n_runs, 1)))


def random_order(
    win: Window, dts: tuple[float, ...], draws: int, rng: np.random.Generator, taus: tuple[float, ...] = ()
) -> Tallies:
    """Cascades in random order: the window's own change times, its exits and entries shuffled over them.

    The null hypothesis is that the order is exchangeable. Times of change and the numbers of exits and
    entries stay as observed; a change by k counts as k changes at one time, so simultaneous exits are not
    taken as given. The random path may leave 0..n: only falls are counted, their level is not used. With as
    many exits as entries `events` gives P(k) = 2^-k, gamma = ln 2, up to terms of order one over the number
    of events.

    On 1000 planted ensembles of 20 exchangeable series (540 changes each), the 95% interval of the paired
    difference from chance missed zero in 4.7% by `events` and in 4.5 to 5.8% by the sampled definitions.

    Parameters
    ----------
    win : Window
    dts : tuple of float
        Sampling steps of the sampled definitions.
    draws : int
        Number of random orders.
    rng : numpy.random.Generator
    taus : tuple of float
        Gaps of `clusters`.
    """
    unit = win.unit_steps()
    grid_index = {dt: unit.grid_index(dt) for dt in dts}
    tallies: Tallies = {}
    signs = unit.step.copy()
    for draw in range(draws):
        rng.shuffle(signs)
        _tally(tallies, draws, draw, sizes_of_path(np.concatenate(([0], np.cumsum(signs))), grid_index))
        _tally_clusters(tallies, draws, draw, unit, unit.t[signs < 0], taus)
    return tallies


def _tally(tallies: Tallies, draws: int, draw: int, found: Mapping[Law, np.ndarray]) -> None:
    for law, sizes in found.items():
        if law not in tallies:
            tallies[law] = NullTally(np.zeros(draws), np.zeros(draws))
        tallies[law].add(draw, sizes)


def _tally_clusters(
    tallies: Tallies, draws: int, draw: int, win: Window, exits: np.ndarray, taus: tuple[float, ...]
) -> None:
    found = {Law("clusters", tau=tau): cluster_sizes(exits, tau, win.t_start, win.t_stop) for tau in taus}
    _tally(tallies, draws, draw, found)


# ------------------------------------------------------------------------------- independent, in closed form


def independent_sums(law: Law, n_exits: int, n_entries: int, span: float) -> np.ndarray:
    """Expected total size and number of cascades if exits and entries are two independent Poisson processes.

    With rates a of exits and b of entries, the decrease of n_stick over dt is W = Poisson(a dt) - Poisson(b dt)
    (Skellam), independent from step to step. With f = P(W > 0) for a fall, u = P(W < 0) for a rise, and
    E[W; W > 0] = a dt P(W >= 0) - b dt P(W >= 2) (Stein and Chen's identity on both Poisson numbers):

    - `length`: a fall goes on with probability f, so P(k) = (1 - f) f^(k-1), gamma0 = -log f;
    - `decreases`: the same among steps that move, q = f / (f + u), gamma0 = -log q;
    - `drop`, `descent`: sums of as many falls, mean size E[W | W > 0] / (1 - f) and E[W | W > 0] / (1 - q):
      not geometric, and gamma0 = -log(1 - 1/mean) is what the estimator gives;
    - `events`: q = a / (a + b), gamma0 = -log q, which is ln 2 at equal rates;
    - `clusters`: the next exit comes within tau with probability q = 1 - exp(-a tau), gamma0 = -log q.

    Parameters
    ----------
    law : Law
    n_exits, n_entries : int
        Numbers observed in a window of length `span`.

    Returns
    -------
    ndarray, shape (2,)
        The columns that `stickslip.analysis.stats.estimates.gamma` reads; zero where no cascade is ever complete.
    """
    if n_exits == 0 or n_entries == 0:
        return np.zeros(2)
    if law.definition == "events":
        return np.array([n_exits, n_exits * n_entries / (n_exits + n_entries)])
    if law.tau is not None:
        return np.array([n_exits, n_exits * np.exp(-n_exits / span * law.tau)])
    if law.dt is None or law.definition not in SAMPLED:
        raise ValueError(f"law: expected `events`, `clusters` or a sampled definition with its dt, got {law!r}")
    a, b, n_steps = n_exits / span * law.dt, n_entries / span * law.dt, span / law.dt
    # Skellam's distribution function is the non-central chi-square's (Johnson 1959, Biometrika 46, 352)
    fall, rise, fall_by_two = (
        float(special.chndtr(*of)) for of in ((2 * a, 2, 2 * b), (2 * b, 2, 2 * a), (2 * a, 4, 2 * b))
    )
    has_plateaus = law.definition in ("descent", "decreases")
    goes_on = fall / (fall + rise) if has_plateaus else fall
    is_drop = law.definition in ("drop", "descent")
    total = a * (1 - rise) - b * fall_by_two if is_drop else fall
    return n_steps * np.array([total, fall * (1 - goes_on)])


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
    by_block = np.argsort(block, kind="stable")
    sticks = (np.asarray(mode) == 0).astype(np.int64)
    before = np.empty_like(sticks)
    before[by_block[1:]] = sticks[by_block[:-1]]
    is_first = np.concatenate(([True], np.diff(block[by_block]) != 0))[: len(t)]
    firsts = by_block[is_first]
    before[firsts] = np.asarray(initial_mode)[block[firsts]] == 0
    step = sticks - before
    kept = (step != 0) & (t > t_start) & (t <= t_stop)
    return BlockSteps(float(t_start), float(t_stop), t[kept], block[kept], step[kept])


def rotated(steps: BlockSteps, rng: np.random.Generator) -> BlockSteps:
    """A surrogate without coupling: each block's series turned in the window by a random amount of its own.

    Taken as periodic, a block's rhythm, its numbers and the order of its events stay; how the blocks stand to
    each other is drawn anew. Where a block does not end the window as it began it, the seam would add one exit
    or entry that nobody saw: it is dropped, so that the surrogate has exactly the observed exits and entries
    (its path may then leave 0..n, where only falls are counted). In 20 runs of n = 200 over 400 units the seams
    would have added 1.3% of changes; kept or dropped, gamma by `events` came out the same to 0.0001.
    """
    n_blocks = int(steps.block.max()) + 1 if len(steps.block) else 0
    shift = rng.uniform(0, steps.span, n_blocks)
    t = steps.t_start + (steps.t - steps.t_start + shift[steps.block]) % steps.span
    order = np.argsort(t, kind="stable")
    return BlockSteps(steps.t_start, steps.t_stop, t[order], steps.block[order], steps.step[order])


def rotations(
    steps: BlockSteps, dts: tuple[float, ...], draws: int, rng: np.random.Generator, taus: tuple[float, ...] = ()
) -> Tallies:
    """Cascades if the blocks did not act on each other: `draws` surrogates by `rotated`, by every definition."""
    tallies: Tallies = {}
    for draw in range(draws):
        win = rotated(steps, rng).window()
        _tally(tallies, draws, draw, sizes_of_path(win.path(), {dt: win.grid_index(dt) for dt in dts}))
        _tally_clusters(tallies, draws, draw, win, win.exits(), taus)
    return tallies


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
