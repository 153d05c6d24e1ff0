"""Null models: what is closed agrees with simulation, what is broken is broken and the rest is kept."""

from itertools import permutations

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis import Law, over_matrices, random_order, sizes, window
from stickslip.analysis.stats.cascades import SAMPLED, Window, laws
from stickslip.analysis.stats.estimates import LN2, gamma, gamma_difference
from stickslip.analysis.stats.nulls import (
    BlockSteps,
    block_steps,
    draws_each,
    independent_sums,
    rotated,
    rotations,
    triggered,
)

EVENTS = Law("events")


def balanced(n_exits, t_stop=100.0):
    """A window with as many exits as entries, in strict alternation: the order is far from random."""
    steps = np.tile([1, -1], n_exits)
    t = np.concatenate(([0.0], np.linspace(0.01, t_stop - 0.01, steps.size)))
    return window(t, 10 + np.concatenate(([0], np.cumsum(steps))), 0.0, t_stop)


def test_random_order_of_as_many_exits_as_entries_gives_ln_2():
    tally = random_order(balanced(2000), (), 100, np.random.default_rng(5))[EVENTS]
    rate, error = tally.rate()
    assert error < 0.005
    assert abs(rate - LN2) < 4 * error + 1 / 2000
    shares = tally.histogram[1:6] / tally.histogram.sum()
    np.testing.assert_allclose(shares, 0.5 ** np.arange(1, 6), rtol=0.03)


def test_random_order_agrees_with_every_order_listed():
    """Six changes: all 20 orders of three exits and three entries, counted without the code under test."""
    totals, counts = [], []
    for order in set(permutations("+++---")):
        runs = "".join(order).split("+")[1:-1]  # what stands before the first entry and after the last is cut
        totals.append(sum(len(run) for run in runs))
        counts.append(sum(len(run) > 0 for run in runs))
    draws = 20_000
    tally = random_order(balanced(3), (), draws, np.random.default_rng(2))[EVENTS]
    for exact, drawn in ((totals, tally.totals), (counts, tally.counts)):
        assert abs(drawn.mean() - np.mean(exact)) < 4 * np.std(exact) / np.sqrt(draws)


def test_simultaneous_exits_are_not_taken_as_given_by_chance():
    """Exits three at a time: by events they are cascades, and random order of single exits does not keep them."""
    steps = np.tile([1, 1, 1, -3], 500)
    t = np.arange(steps.size + 1) / steps.size
    win = window(t, 10 + np.concatenate(([0], np.cumsum(steps))), 0.0, 1.1)
    rate, error = random_order(win, (), 50, np.random.default_rng(0))[EVENTS].rate()
    assert abs(rate - LN2) < 4 * error + 1 / 1500


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
            null = random_order(win, (), 5, rng)[EVENTS].sums().sum(axis=0)
            sums.append([found.sum(), found.size, *null])
        against = over_matrices(gamma_difference, np.array(sums, dtype=float), 0.95)
        assert against.low is not None
        assert against.high is not None
        alarms += not against.low <= 0 <= against.high
    # 5% of 400 with a standard deviation of 1.1 points: three of them.
    assert 0.017 <= alarms / n_ensembles <= 0.083


@pytest.mark.parametrize("per_step", [0.5, 1.0, 6.0])
def test_sampled_chance_has_the_rates_of_independent_sampled_steps(per_step):
    """Changes at random times in random order: steps of the samples are independent, Skellam(m / 2, m / 2).

    A falling run then is geometric with q = P(step < 0), and its drop has the mean of a fall times the mean
    length: chance gives a different gamma for each definition and dt, which is why none stands without them.
    """
    n_changes, t_stop = 20_000, 1000.0
    t = np.sort(np.random.default_rng(6).uniform(0, t_stop, n_changes))
    path = np.concatenate(([0], np.cumsum(np.tile([1, -1], n_changes // 2))))
    dt = per_step * t_stop / n_changes
    win = window(np.concatenate(([0.0], t)), path, 0.0, t_stop)
    tallies = random_order(win, (dt,), 20, np.random.default_rng(1))
    step = stats.skellam(per_step / 2, per_step / 2)
    falls = -np.arange(-60, 0)
    p_fall = step.cdf(-1)
    mean_fall = np.dot(falls, step.pmf(-falls)) / p_fall
    expected = {
        "length": -np.log(p_fall),
        "drop": -np.log1p(-(1 - p_fall) / mean_fall),
        "decreases": LN2,
    }
    for definition, rate in expected.items():
        assert tallies[Law(definition, dt)].rate()[0] == pytest.approx(rate, rel=0.03)


def test_random_order_is_reproducible():
    one, two = (random_order(balanced(50), (1.0,), 10, np.random.default_rng(9)) for _ in range(2))
    assert all(np.array_equal(one[law].sums(), two[law].sums()) for law in one)


def test_monte_carlo_error_shrinks_with_the_number_of_orders():
    errors = [
        random_order(balanced(200), (), draws, np.random.default_rng(4))[EVENTS].rate()[1] for draws in (20, 2000)
    ]
    assert errors[1] == pytest.approx(errors[0] / 10, rel=0.5)  # 20 draws give their own error to about 16%


def poisson_window(exits, entries, t_stop, seed):
    """Independent Poisson exits and entries at the given rates."""
    rng = np.random.default_rng(seed)
    numbers = rng.poisson([exits * t_stop, entries * t_stop])
    t = rng.uniform(0, t_stop, numbers.sum())
    step = np.repeat([-1, 1], numbers)
    order = np.argsort(t)
    return Window(0.0, t_stop, 0, t[order], step[order])


@pytest.mark.parametrize(("exits", "entries"), [(1.0, 1.0), (1.5, 1.0), (0.7, 1.4)])
def test_closed_form_of_independent_exits_and_entries_agrees_with_simulation(exits, entries):
    t_stop = 60_000.0
    win = poisson_window(exits, entries, t_stop, 3)
    n_exits, n_entries = np.sum(win.step < 0), np.sum(win.step > 0)
    for law in laws((0.2, 1.0, 5.0), (0.3, 2.0)):
        found = sizes(win, law)
        total, count = independent_sums(law, n_exits, n_entries, t_stop)
        assert len(found) == pytest.approx(count, rel=4 / np.sqrt(count)), law
        error = found.std() / np.sqrt(len(found))
        assert abs(found.mean() - total / count) < 4 * error, law


def test_length_by_chance_is_geometric_with_the_probability_of_a_fall():
    win = poisson_window(1.2, 1.0, 60_000.0, 4)
    fall = stats.skellam(1.2 * 0.5, 1.0 * 0.5).sf(0)
    shares = np.bincount(sizes(win, Law("length", 0.5)))[1:5]
    expected = len(sizes(win, Law("length", 0.5))) * (1 - fall) * fall ** np.arange(4)
    np.testing.assert_allclose(shares, expected, atol=4 * np.sqrt(expected.max()))
    assert gamma(independent_sums(Law("length", 0.5), 1200, 1000, 1000.0)[None])[0] == pytest.approx(-np.log(fall))


def test_without_exits_or_entries_chance_has_no_cascade():
    assert independent_sums(EVENTS, 0, 5, 10.0).tolist() == [0.0, 0.0]
    assert independent_sums(Law("drop", 1.0), 5, 0, 10.0).tolist() == [0.0, 0.0]
    with pytest.raises(ValueError, match="law"):
        independent_sums(Law("drop"), 5, 5, 10.0)


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


def test_rotation_breaks_what_blocks_share():
    """Two blocks that always change together: turned, they hardly ever do."""
    one = alternating(1, 40, 100.0, 5)
    both = BlockSteps(0.0, 100.0, np.repeat(one.t, 2), np.tile([0, 1], 40), np.repeat(one.step, 2))
    assert sizes(both.window(), EVENTS).min() == 2
    tally = rotations(both, (), 200, np.random.default_rng(0))[EVENTS]
    assert tally.histogram[1] > 0.3 * tally.histogram.sum()


def test_rotation_of_many_slow_blocks_is_what_independence_gives():
    """Each block changes twice: nothing of its own order is left, so all definitions have the closed form."""
    steps = alternating(4000, 2, 2000.0, 6)
    dts, taus = (0.2, 1.0), (0.3,)
    tallies = rotations(steps, dts, 40, np.random.default_rng(7), taus)
    for law, tally in tallies.items():
        rate, error = tally.rate()
        expected = gamma(independent_sums(law, 4000, 4000, 2000.0)[None])[0]
        assert rate == pytest.approx(expected, abs=4 * error + 0.003), law
    assert set(tallies) == set(laws(dts, taus))
    assert {law.definition for law in tallies} == {"events", *SAMPLED, "clusters"}


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


def test_clusters_in_random_order_have_their_closed_form():
    win = poisson_window(1.0, 1.0, 4000.0, 10)
    tally = random_order(win, (), 20, np.random.default_rng(0), (0.5,))[Law("clusters", tau=0.5)]
    expected = gamma(independent_sums(Law("clusters", tau=0.5), np.sum(win.step < 0), 1, 4000.0)[None])[0]
    assert tally.rate()[0] == pytest.approx(expected, rel=0.05)


def test_large_groups_need_fewer_draws_of_each_run():
    assert [draws_each(200, n, least=20) for n in (0, 1, 20, 40, 10_000)] == [200, 200, 200, 100, 20]
    assert draws_each(5, 10_000, least=20) == 5  # never more than asked for


def test_skellam_in_closed_form_against_scipy():
    for a, b in ((30, 20), (900, 905), (1, 1)):
        law, span = Law("drop", 0.5), 50.0
        decrease = stats.skellam(a / span * 0.5, b / span * 0.5)
        falls = np.arange(1, 400)
        total, count = independent_sums(law, a, b, span) / (span / 0.5)
        assert total == pytest.approx(np.sum(falls * decrease.pmf(falls)), rel=1e-9)
        assert count == pytest.approx(decrease.sf(0) * (1 - decrease.sf(0)), rel=1e-9)
