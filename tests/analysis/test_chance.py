"""Null models: what is closed agrees with simulation, what is broken is broken and the rest is kept."""

from itertools import product

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis import Law, over_matrices, random_order, sizes, window
from stickslip.analysis.stats.cascades import Window, laws
from stickslip.analysis.stats.estimates import LN2, gamma, paired_difference
from stickslip.analysis.stats.nulls import BlockSteps, block_steps, rotated, rotations, triggered

EVENTS = Law("events")


def poisson_window(exits, entries, t_stop, rng):
    """Independent Poisson exits and entries at the given rates."""
    numbers = rng.poisson([exits * t_stop, entries * t_stop])
    t = rng.uniform(0, t_stop, numbers.sum())
    step = np.repeat([-1, 1], numbers)
    order = np.argsort(t)
    return Window(0.0, t_stop, 0, t[order], step[order])


def rate(sums):
    return float(gamma(sums[None])[0])


@pytest.mark.parametrize(("exits", "entries"), [(1.0, 1.0), (1.5, 1.0), (0.7, 1.4)])
def test_random_order_leaves_independent_exits_and_entries_as_they_are(exits, entries, rng):
    """Poisson exits and entries are in random order from the start: each definition sees no difference."""
    dts = (0.2, 1.0, 5.0)
    runs = [poisson_window(exits, entries, 2_000.0, rng) for _ in range(30)]
    expected = [random_order(win, dts) for win in runs]
    for law in laws(dts):
        rows = np.array([
            [found.sum(), len(found), *chance[law]]
            for win, chance in zip(runs, expected, strict=True) for found in [sizes(win, law)]
        ])  # fmt: skip
        against = over_matrices(paired_difference(gamma), rows, 0.9999)
        assert against.low < 0 < against.high, law


def test_random_order_agrees_with_every_order_listed():
    """Twelve changes in eight steps, all orders weighed by p: how many runs of falls end, and what they add up to."""
    t = np.array([0.1, 0.2, 1.5, 2.1, 2.2, 2.3, 4.4, 4.5, 5.5, 6.1, 6.2, 7.3])
    win = Window(0.0, 8.0, 5, t, np.array([-1, 1, -1, -1, 1, -1, -1, 1, -1, -1, 1, -1]))
    p, expected = 8 / 12, {law: np.zeros(2) for law in laws((1.0,))}
    for order in product((-1, 1), repeat=12):
        weight = np.prod([p if side < 0 else 1 - p for side in order])
        net = np.bincount(t.astype(int), order, 8)
        moved = net[net != 0]
        for steps, depth, length in ((net, "drop", "length"), (moved, "descent", "decreases")):
            ends = np.sum((steps[:-1] < 0) & (steps[1:] >= 0))
            # only what a later step is there to end is counted
            last = (
                len(steps) - 1 if steps is net else int(np.flatnonzero(np.bincount(t.astype(int), minlength=8))[-1])
            )
            heard = steps[:-1] if steps is net else net[:last]
            expected[Law(depth, 1.0)] += weight * np.array([-np.minimum(heard, 0).sum(), ends])
            expected[Law(length, 1.0)] += weight * np.array([np.sum(heard < 0), ends])
    found = random_order(win, (1.0,))
    for law, one in expected.items():
        if law != EVENTS:
            np.testing.assert_allclose(found[law], one, rtol=1e-9, err_msg=str(law))
    assert found[EVENTS].tolist() == pytest.approx([8, 8 * 4 / 12])


def test_random_order_of_as_many_exits_as_entries_gives_ln_2():
    steps = np.tile([1, -1], 2000)  # in strict alternation: the order is far from random
    win = Window(0.0, 100.0, 10, np.linspace(0.01, 99.99, 4000), steps)
    assert rate(random_order(win, ())[EVENTS]) == pytest.approx(LN2)


def test_simultaneous_exits_are_not_taken_as_given_by_chance():
    """Exits three at a time: by events they are cascades, and random order of single exits does not keep them."""
    win = Window(0.0, 1.1, 10, np.arange(1, 2001) / 2000, np.tile([1, 1, 1, -3], 500))
    assert rate(random_order(win, ())[EVENTS]) == pytest.approx(LN2)


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
            sums.append([found.sum(), found.size, *random_order(win, ())[EVENTS]])
        against = over_matrices(paired_difference(gamma), np.array(sums, dtype=float), 0.95)
        assert against.low is not None
        assert against.high is not None
        alarms += not against.low <= 0 <= against.high
    # 5% of 400 with a standard deviation of 1.1 points: three of them.
    assert 0.017 <= alarms / n_ensembles <= 0.083


@pytest.mark.parametrize("per_step", [0.5, 1.0, 6.0])
def test_sampled_chance_has_the_rates_of_independent_sampled_steps(per_step, rng):
    """Changes at random times in random order: steps of the samples are independent, Skellam(m / 2, m / 2).

    A falling run then is geometric with q = P(step < 0), and its drop has the mean of a fall times the mean
    length: chance gives a different gamma for each definition and dt, which is why none stands without them.
    """
    n_changes, t_stop = 20_000, 1000.0
    dt = per_step * t_stop / n_changes
    win = Window(0.0, t_stop, 0, np.sort(rng.uniform(0, t_stop, n_changes)), np.tile([1, -1], n_changes // 2))
    found = random_order(win, (dt,))
    step = stats.skellam(per_step / 2, per_step / 2)
    falls = -np.arange(-60, 0)
    p_fall = step.cdf(-1)
    mean_fall = np.dot(falls, step.pmf(-falls)) / p_fall
    expected = {"length": -np.log(p_fall), "drop": -np.log1p(-(1 - p_fall) / mean_fall), "decreases": LN2}
    for definition, one in expected.items():
        assert rate(found[Law(definition, dt)]) == pytest.approx(one, rel=0.03)


@pytest.mark.parametrize("steps", [[], [-1], [1, 1]])
def test_without_exits_and_entries_chance_has_no_cascade(steps):
    win = Window(0.0, 10.0, 5, np.arange(1.0, len(steps) + 1), np.array(steps, dtype=np.int64))
    found = random_order(win, (1.0, 20.0))
    assert found[EVENTS][1] == 0
    assert all(np.isfinite(one).all() for one in found.values())


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
    assert len(rotated(empty, np.random.default_rng(0)).t) == 0


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
    steps = alternating(12, 7, 50.0, 1)
    turned = rotated(steps, np.random.default_rng(2))
    assert (np.diff(turned.t) >= 0).all()
    for block in range(12):
        before, after = ((one.t[one.block == block], one.step[one.block == block]) for one in (steps, turned))
        gaps = [np.diff(t, append=t[0] + 50.0) for t, _ in (before, after)]  # on the circle
        fits = [
            np.allclose(np.roll(gaps[0], k), gaps[1]) and np.array_equal(np.roll(before[1], k), after[1])
            for k in range(7)
        ]
        assert any(fits)


def test_rotation_breaks_what_blocks_share(rng):
    """Two blocks that always change together: turned, they hardly ever do, and cascades of one are common."""
    one = alternating(1, 40, 100.0, 5)
    both = BlockSteps(0.0, 100.0, np.repeat(one.t, 2), np.tile([0, 1], 40), np.repeat(one.step, 2))
    assert sizes(both.window(), EVENTS).min() == 2
    total, count = rotations(both, (), 200, rng)[EVENTS]
    assert total / count < 1.8


def test_rotation_of_many_slow_blocks_is_what_independence_gives(rng):
    """Each block changes twice: nothing of its own order is left, so all definitions give what random order gives."""
    steps = alternating(4000, 2, 2000.0, 6)
    dts = (0.2, 1.0)
    draws = [rotations(steps, dts, 1, rng) for _ in range(40)]
    expected = random_order(steps.window(), dts)
    assert set(draws[0]) == set(laws(dts))
    for law in draws[0]:
        found = over_matrices(gamma, np.array([one[law] for one in draws]), 0.9999)
        assert found.low - 0.003 < rate(expected[law]) < found.high + 0.003, law


def test_triggered_exits_follow_others_and_nothing_is_lost():
    steps = alternating(100, 20, 200.0, 8)
    rng = np.random.default_rng(9)
    planted = triggered(steps, 0.2, 1e-4, rng)
    assert np.bincount(planted.block).tolist() == np.bincount(steps.block).tolist()
    assert planted.step.sum() == steps.step.sum()
    gaps = np.diff(planted.exits()[0])
    # 1000 exits at a mean gap of 0.2: a gap below 1e-3 by chance 5 times, and 200 were put there
    assert 190 <= np.sum(gaps < 1e-3) <= 225
    none = triggered(steps, 0.0, 1e-4, rng)
    assert np.sum(np.diff(none.exits()[0]) < 1e-3) < 20
