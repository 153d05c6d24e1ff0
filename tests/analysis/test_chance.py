"""Null models: what is closed agrees with simulation, what is broken is broken and the rest is kept."""

import numpy as np
import pytest

from stickslip.analysis import Law, over_matrices, sizes
from stickslip.analysis.series import nulls
from stickslip.analysis.series.cascades import Window
from stickslip.analysis.series.nulls import BlockSteps, block_steps, rotated
from stickslip.analysis.stats.estimates import LN2, gamma
from tests.chance import SURE

EVENTS = Law("events")


# Blocks 0 sticks at first, 1 and 2 slip. Exits: 0 at 1 and 7; entries: 1 at 2, 0 at 3; crossing: 2 at 4.
MODES = {
    "t": np.array([1.0, 2.0, 3.0, 4.0, 7.0]),
    "block": np.array([0, 1, 0, 2, 0]),
    "mode": np.array([1, 0, 0, -1, -1]),
    "initial_mode": np.array([0, -1, 1]),
}


def test_exits_and_entries_of_blocks_counted_by_hand():
    steps = block_steps(**MODES, t_start=0.0, t_stop=8.0)
    assert steps.t.tolist() == [1.0, 2.0, 3.0, 7.0]
    assert steps.block.tolist() == [0, 1, 0, 0]
    assert steps.step.tolist() == [-1, 1, 1, -1]
    later = block_steps(**MODES, t_start=2.0, t_stop=6.0)  # what came before still says which mode an event ends
    assert (later.t.tolist(), later.step.tolist()) == ([3.0], [1])
    meet = [block_steps(**MODES, t_start=start, t_stop=stop).t.tolist() for start, stop in ((0.0, 3.0), (3.0, 7.0))]
    assert meet == [[1.0, 2.0, 3.0], [7.0]]  # (t_start, t_stop]
    empty = block_steps(*(np.array([], dtype=int),) * 3, np.zeros(2), 0.0, 1.0)
    assert len(rotated(empty, np.random.default_rng(0))) == 0


def test_bad_events_are_refused():
    with pytest.raises(ValueError, match="decrease"):
        block_steps(**(MODES | {"t": MODES["t"][::-1]}), t_start=0.0, t_stop=8.0)
    with pytest.raises(ValueError, match="one length"):
        block_steps(**(MODES | {"t": MODES["t"][1:]}), t_start=0.0, t_stop=8.0)


def alternating(n_blocks, n_changes, span, seed):
    """Blocks that change at random times of their own, each by turns."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0, span, (n_blocks, n_changes)), axis=1)
    step = np.broadcast_to(np.tile([-1, 1], n_changes)[:n_changes], t.shape)
    block = np.broadcast_to(np.arange(n_blocks)[:, None], t.shape)
    order = np.argsort(t.ravel())
    return BlockSteps(0.0, span, t.ravel()[order], block.ravel()[order], step.ravel()[order])


def times_of(places, span):
    """Times and whether they are exits, of places as `rotated` gives them: the last bit is one for an exit."""
    return (places >> 1) * (span / 2**31), (places & 1).astype(bool)


def test_rotation_keeps_each_block_up_to_its_shift():
    for block in range(12):
        before = alternating(1, 7, 50.0, block)
        t, is_exit = times_of(rotated(before, np.random.default_rng(2)), 50.0)
        assert (np.diff(t) >= 0).all()
        gaps = [np.diff(times, append=times[0] + 50.0) for times in (before.t, t)]  # on the circle
        assert any(
            np.allclose(np.roll(gaps[0], k), gaps[1]) and np.array_equal(np.roll(before.step < 0, k), is_exit)
            for k in range(7)
        )


def test_rotation_breaks_what_blocks_share(rng):
    """Two blocks that always change together: turned, they hardly ever do, and cascades of one are common."""
    one = alternating(1, 40, 100.0, 5)
    both = BlockSteps(0.0, 100.0, np.repeat(one.t, 2), np.tile([0, 1], 40), np.repeat(one.step, 2))
    assert sizes(both.window(), EVENTS).min() == 2
    count, total, _ = nulls.moments(both, 200, rng)
    assert total / count < 1.8


def test_rotation_of_many_slow_blocks_is_the_toss_of_a_coin(rng):
    """Each block changes twice: nothing of its own order is left."""
    steps = alternating(4000, 2, 2000.0, 6)
    draws = np.array([nulls.moments(steps, 1, rng)[[1, 0]] for _ in range(40)])
    found = over_matrices(gamma, draws, SURE)
    assert found.low - 0.005 < LN2 < found.high + 0.005


def test_moments_are_those_of_the_sizes_of_a_surrogate():
    steps = alternating(30, 41, 100.0, 7)
    t, is_exit = times_of(rotated(steps, np.random.default_rng(8)), 100.0)
    k = sizes(Window(0.0, 100.0, 0, t, np.where(is_exit, -1, 1)), EVENTS)
    for least, some in ((1, k), (3, k[k > 2] - 2)):
        expected = len(some), some.sum(), some @ some
        assert nulls.moments(steps, 1, np.random.default_rng(8), least).tolist() == [*expected]
