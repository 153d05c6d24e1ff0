"""Windows of many runs in flat arrays, against loops over the levels of each."""

import itertools

import numpy as np
import pytest

from stickslip.analysis import window
from stickslip.analysis.series.windows import NoSeries, Stack, in_parts, windows
from stickslip.analysis.stats.effective import correlation_times

T_BURN = 2.0


def drawn(rng, n_runs):
    """Series whose times often tie, lie on the edges of windows and of their parts, or change nothing."""
    for _ in range(n_runs):
        n = int(rng.integers(1, 40))
        t = np.concatenate(([0.0], np.sort(rng.integers(0, 81, n - 1) / 8.0)))
        yield (t, rng.integers(0, 5, n)), 4.0 + rng.integers(0, 25) / 4.0


def levels(points, t_stop):
    """Level by level: from when, until when, and n_stick; those that only touch the window's end are kept."""
    t, n_stick = points
    found = []
    for k, level in enumerate(n_stick):
        until = t[k + 1] if k + 1 < len(t) else np.inf
        if t[k] > t_stop or (until <= T_BURN and k + 1 < len(t)):
            continue
        if found and found[-1][2] == level:
            found[-1] = (found[-1][0], min(until, t_stop), level)
        else:
            found.append((max(t[k], T_BURN), min(until, t_stop), level))
    return found


def complete_falls(path):
    """Depths of maximal runs of steps down that begin after a step up and end before one."""
    depths, top = [], None
    for before, after in itertools.pairwise(path):
        if after > before:
            if top is not None and before < top:
                depths.append(top - before)
            top = after
    return depths


def test_every_sum_is_that_of_a_loop_over_levels(rng):
    series, t_stop = zip(*drawn(rng, 200), strict=True)
    runs = windows(Stack.of(series), T_BURN, t_stop)
    tau, (run, depth), parts = correlation_times(runs), runs.falls, runs.means(5)
    for k, (points, end) in enumerate(zip(series, t_stop, strict=True)):
        one = levels(points, end)
        lasted, level = np.array([b - a for a, b, _ in one]), np.array([n for _, _, n in one], dtype=float)
        mean = lasted @ level / (end - T_BURN)
        assert runs.mean[k] == pytest.approx(mean, abs=1e-12)
        assert runs.variance[k] == pytest.approx(lasted @ (level - mean) ** 2 / (end - T_BURN), abs=1e-12)
        edges = np.linspace(T_BURN, end, 6)
        by_part = [
            sum(n * max(0.0, min(b, high) - max(a, low)) for a, b, n in one) / (high - low)
            for low, high in itertools.pairwise(edges)
        ]
        np.testing.assert_allclose(parts[k], by_part, atol=1e-12)
        assert sorted(depth[run == k]) == sorted(complete_falls(level))
        assert runs.exits[k] == sum(max(a - b, 0) for a, b in itertools.pairwise(level))
        alone = window(*points, T_BURN, end)
        assert tau[k] == pytest.approx(correlation_times(alone.alone)[0], rel=1e-9)


@pytest.mark.parametrize("t_start", [0.0, 0.1, 1e3])
def test_a_level_that_begins_at_an_edge_holds_there_whatever_the_quotient_rounds_to(t_start):
    for count in range(2, 200):
        edges = t_start + 1.0 / count * np.arange(count)
        runs = windows(Stack.of([(edges, np.arange(count) % 2)]), t_start, [t_start + 1.0])
        edges = t_start + runs.span / count * np.arange(count)  # as the window has them
        runs = windows(Stack.of([(edges, np.arange(count) % 2)]), t_start, [t_start + 1.0])
        np.testing.assert_array_equal(runs.at(count)[0, :-1], np.arange(count))


def test_some_runs_are_taken_by_their_places(rng):
    series, t_stop = zip(*drawn(rng, 50), strict=True)
    runs, some = windows(Stack.of(series), T_BURN, t_stop), rng.permutation(50)[:20]
    taken = runs.take(some)
    for name in ("mean", "variance", "exits"):
        np.testing.assert_array_equal(getattr(taken, name), getattr(runs, name)[some])


def test_stacks_in_parts_are_the_same_runs(rng):
    """Of so many runs and change points at most, whatever the parts that come in; a long run is a part by itself."""
    series = [points for points, _ in drawn(rng, 200)]
    edges = np.sort(rng.integers(0, 201, 9))
    given = [Stack.of(series[a:b]) for a, b in itertools.pairwise([0, *edges.tolist(), 200])]
    for most_runs, most_points in ((1, 1000), (7, 60), (1000, 100), (1000, 100_000), (3, 1)):
        parts = list(in_parts(given, most_runs, most_points))
        for part in parts:
            assert len(part) == 1 or (len(part) <= most_runs and len(part.t) <= most_points)
        whole = Stack.joined(parts)
        for name in ("first", "t", "n_stick"):
            np.testing.assert_array_equal(getattr(whole, name), getattr(Stack.of(series), name))
        assert len(parts) <= max(200 / most_runs, 2 * len(whole.t) / most_points) + 1
    some = rng.permutation(200)[:50]
    for name in ("first", "t", "n_stick"):
        np.testing.assert_array_equal(
            getattr(whole.take(some), name), getattr(Stack.of([series[k] for k in some]), name)
        )
    assert whole.last[0].tolist() == [t[-1] for t, _ in series]


@pytest.mark.parametrize(("points", "word"), [
    (([0.0, 1.0], [1]), "one length"),
    (([0.0, 1.0], [1.0, 2.0]), "expected integers"),
    (([0.0, 3.0, 2.5], [1, 2, 1]), "do not decrease"),
    (([0.0, np.nan], [1, 2]), "expected finite"),
    (([2.5, 3.0], [1, 2]), "at or before t_start"),
])  # fmt: skip
def test_what_is_no_series_is_refused_by_its_place(points, word):
    good = (np.array([0.0, 3.0]), np.array([2, 1]))
    with pytest.raises(NoSeries, match=word) as caught:
        windows(Stack.of([good, (np.array(points[0]), np.array(points[1])), good]), T_BURN, [5.0, 5.0, 5.0])
    assert caught.value.place == 1
