"""Null models: what is closed agrees with simulation, what is broken is broken and the rest is kept."""

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis import Law, over_matrices, sizes, window
from stickslip.analysis.series import nulls
from stickslip.analysis.series.cascades import Window, laws
from stickslip.analysis.series.nulls import BlockSteps, block_steps, rotated
from stickslip.analysis.stats.estimates import LN2, gamma
from tests.chance import SURE, agrees

EVENTS = Law("events")


def poisson_window(exits, entries, t_stop, rng):
    """Independent Poisson exits and entries at the given rates."""
    numbers = rng.poisson([exits * t_stop, entries * t_stop])
    t = rng.uniform(0, t_stop, numbers.sum())
    step = np.repeat([-1, 1], numbers)
    order = np.argsort(t)
    return Window(0.0, t_stop, 0, t[order], step[order])


def test_the_toss_of_a_coin_gives_ln_2(rng):
    runs = [sizes(poisson_window(1.0, 1.0, 2_000.0, rng), EVENTS) for _ in range(30)]
    found = over_matrices(gamma, np.array([[one.sum(), len(one)] for one in runs], dtype=float), SURE)
    assert found.low < LN2 < found.high


@pytest.mark.long
def test_fair_series_are_rarely_called_different_from_chance(planted):
    n_ensembles, n_matrices = 400, 20
    alarms = 0
    for ensemble in range(n_ensembles):
        sums = []
        for matrix in range(n_matrices):
            rng = np.random.default_rng([ensemble, matrix])
            t, n_stick = planted.runs(rng, 200, LN2)
            win = window(t, n_stick, 100.0, planted.t_end)
            found = sizes(win, EVENTS)
            sums.append([found.sum(), found.size])
        against = over_matrices(gamma, np.array(sums, dtype=float), 0.95)
        assert against.low is not None
        assert against.high is not None
        alarms += not against.low <= LN2 <= against.high
    assert agrees(alarms, n_ensembles, 0.05)


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
    assert len(rotated(empty, np.random.default_rng(0))[0]) == 0


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


def test_rotation_keeps_each_block_up_to_its_shift():
    for block in range(12):
        before = alternating(1, 7, 50.0, block)
        t, is_exit = rotated(before, np.random.default_rng(2))
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
    total, count = nulls.sums(both, (), 200, rng)[EVENTS]
    assert total / count < 1.8


@pytest.mark.parametrize("dt", [0.2, 1.0, 3.0])
def test_rotation_of_many_slow_blocks_is_what_independence_gives(dt, rng):
    """Each block changes twice: nothing of its own order is left, and steps of the samples are Skellam(2 dt, 2 dt).

    A falling run then is geometric with q = P(step < 0), and its drop has the mean of a fall times the mean
    length: chance gives a different gamma for each definition and dt, which is why none stands without them.
    """
    steps = alternating(4000, 2, 2000.0, 6)
    draws = [nulls.sums(steps, (dt,), 1, rng) for _ in range(40)]
    assert set(draws[0]) == set(laws((dt,)))
    step = stats.skellam(2 * dt, 2 * dt)
    falls = -np.arange(-60, 0)
    p_fall = step.cdf(-1)
    mean_fall = np.dot(falls, step.pmf(-falls)) / p_fall
    expected = {"length": -np.log(p_fall), "drop": -np.log1p(-(1 - p_fall) / mean_fall), "decreases": LN2,
                "descent": -np.log1p(-0.5 / mean_fall)}  # fmt: skip
    for law, rate in ((EVENTS, LN2), *((Law(name, dt), rate) for name, rate in expected.items())):
        found = over_matrices(gamma, np.array([one[law] for one in draws]), SURE)
        assert found.low - 0.005 < rate < found.high + 0.005, law
