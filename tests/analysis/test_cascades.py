"""Cascade sizes: counted by hand, and unchanged by what cannot matter."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stickslip.analysis import Law, laws, sample, sizes, window
from stickslip.analysis.series.cascades import spans, sums

EVENTS = Law("events")
# Change points counted by hand. Steps: -1 -1 | +1 | -1 0 -1 | +2 | -3 | +1 | -1 (cut)
T = np.array([0.0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10])
N = np.array([9, 8, 7, 8, 7, 7, 6, 8, 5, 6, 5])


def test_events_counted_by_hand():
    # The first run (9 -> 7) may have begun before the window, the last (6 -> 5) may go on after it.
    assert sizes(window(T, N, 0.0, 12.0), EVENTS).tolist() == [2, 3]


def test_t_burn_cuts_the_run_it_falls_into():
    assert sizes(window(T, N, 4.5, 12.0), EVENTS).tolist() == [3]  # from 7 -> 6 on, that run is incomplete
    assert sizes(window(T, N, 3.5, 12.0), EVENTS).tolist() == [3]  # begins with the first change seen: cut too
    assert sizes(window(T, N, 2.5, 12.0), EVENTS).tolist() == [2, 3]  # the entry at t = 3 is seen


def test_sampled_definitions_counted_by_hand():
    # samples 5 6 4 4 3 3 2 1 2 1, steps +1 -2 0 -1 0 -1 -1 +1 -1; changes fall between the samples
    samples = np.array([5, 6, 4, 4, 3, 3, 2, 1, 2, 1])
    t = np.concatenate(([0.0], np.arange(1, 10) - 0.5))
    win = window(t, samples, 0.0, 9.0)
    assert sizes(win, Law("drop", 1.0)).tolist() == [2, 1, 2]
    assert sizes(win, Law("length", 1.0)).tolist() == [1, 1, 2]
    assert sizes(win, Law("decreases", 1.0)).tolist() == [4]
    assert sizes(win, Law("descent", 1.0)).tolist() == [5]
    assert sizes(win, EVENTS).tolist() == [5]


def test_a_sample_at_a_change_sees_the_new_value_and_the_last_value_holds_to_the_end():
    t, n = np.array([0.0, 1.0, 2.0]), np.array([3, 5, 4])
    assert sample(t, n, np.array([0.0, 0.999, 1.0, 1.5, 2.0, 50.0])).tolist() == [3, 3, 5, 5, 4, 4]
    with pytest.raises(ValueError, match="grid"):
        sample(t, n, np.array([-0.1]))


def grid(win, dt):
    """Times of the samples."""
    return win.t_start + dt * np.arange(win.n_steps(dt) + 1)


def test_grid_keeps_its_last_sample_where_rounding_would_lose_it():
    win = window(np.array([0.0]), np.array([1]), 0.0, 0.3)  # 0.3 / 0.1 < 3 in floating point
    np.testing.assert_allclose(grid(win, 0.1), [0.0, 0.1, 0.2, 0.3])


def test_samples_see_the_changes_up_to_and_at_their_time(rng):
    for dt in (0.1, 0.3, 0.7):
        at = np.sort(np.concatenate((rng.uniform(0, 9, 40), dt * rng.integers(1, 9 // dt, 20))))  # some on the grid
        win = window(np.concatenate(([0.0], at)), np.arange(61), 0.0, 9.0)
        index = np.searchsorted(at, grid(win, dt), side="right")
        np.testing.assert_array_equal(win.grid_index(dt), index)
        np.testing.assert_array_equal(win.sampled(dt), np.diff(win.path()[index]))


def test_windows_that_meet_share_no_change_and_lose_none():
    whole = window(T, N, 0.0, 10.0)
    assert whole.t.tolist() == [1, 2, 3, 4, 6, 7, 8, 9, 10]  # (0, 10], and at 5 nothing changes
    cut = window(T, N, 0.0, 4.0), window(T, N, 4.0, 10.0)
    assert [one.t.tolist() for one in cut] == [[1, 2, 3, 4], [6, 7, 8, 9, 10]]
    assert [one.path()[[0, -1]].tolist() for one in cut] == [[9, 7], [7, 5]]
    assert whole.means(5)[:2].mean() == pytest.approx(cut[0].time_mean())


def test_mean_and_variance_in_time_are_exact():
    win = window(np.array([0.0, 2.0, 3.0]), np.array([7, 4, 10]), 1.0, 5.0)  # 7 for 1, 4 for 1, 10 for 2
    assert win.time_mean() == pytest.approx(31 / 4)
    assert win.time_variance() == pytest.approx((49 + 16 + 200) / 4 - (31 / 4) ** 2)
    assert win.means(2).tolist() == pytest.approx([11 / 2, 10])


@st.composite
def change_points(draw):
    n = draw(st.lists(st.integers(0, 6), min_size=2, max_size=40))
    gaps = draw(st.lists(st.integers(1, 8), min_size=len(n) - 1, max_size=len(n) - 1))
    return np.concatenate(([0], np.cumsum(gaps))) / 8.0, np.array(n)  # eighths: shifts and sums are exact


@given(change_points())
def test_sizes_agree_with_a_plain_walk(series):
    t, n = series
    win = window(t, n, 0.0, t[-1] + 1)
    samples = sample(t, n, grid(win, 0.5)).tolist()
    for definition, values in (("events", n.tolist()), ("drop", samples), ("length", samples)):
        law = EVENTS if definition == "events" else Law(definition, 0.5)
        assert sizes(win, law).tolist() == walk(values, definition)
    moved = [b for a, b in zip([None, *samples], samples, strict=False) if a != b]
    assert sizes(win, Law("decreases", 0.5)).tolist() == walk(moved, "length")
    assert sizes(win, Law("descent", 0.5)).tolist() == walk(moved, "drop")


def walk(values, definition):
    """Runs of falling steps, one step at a time; `events` does not see plateaus."""
    found, size, is_seen = [], 0, False
    for before, after in pairwise(values):
        if after < before:
            size += 1 if definition == "length" else before - after
        elif after > before or definition != "events":
            if size and is_seen:
                found.append(size)
            size, is_seen = 0, True
    return found


@pytest.mark.parametrize(("t", "n", "start", "stop", "named"), [
    ([0.0, 1.0], [1], 0.0, 2.0, "n_stick"),
    ([], [], 0.0, 2.0, "n_stick"),
    ([0.0, 1.0], [1.0, 2.0], 0.0, 2.0, "integers"),
    ([1.0, 0.0], [1, 2], 1.0, 2.0, "decrease"),
    ([0.0, np.nan], [1, 2], 0.0, 2.0, "finite"),
    ([0.0, 1.0], [1, 2], 2.0, 2.0, "t_start"),
    ([0.5, 1.0], [1, 2], 0.0, 2.0, "at or before"),
])  # fmt: skip
def test_bad_series_are_refused_by_name(t, n, start, stop, named):
    with pytest.raises(ValueError, match=named):
        window(np.array(t), np.array(n, dtype=None if n else int), start, stop)


@pytest.mark.parametrize("law", [Law("drops", 1.0), Law("events", 1.0), Law("drop")])
def test_bad_laws_are_refused(law):
    with pytest.raises(ValueError, match=r"definition|dt"):
        sizes(window(T, N, 0.0, 12.0), law)


def test_an_exit_and_an_entry_at_one_instant_cancel():
    t, n = np.array([0.0, 3.0, 5.0, 6.0, 9.0]), np.array([9, 8, 8, 7, 8])  # at 5 one block left and one came
    win = window(t, n, 0.0, 10.0)
    assert (win.t.tolist(), win.step.tolist()) == ([3.0, 6.0, 9.0], [-1, -1, 1])


def test_spans_of_cascades_counted_by_hand():
    found = spans(window(T, N, 0.0, 12.0))  # the cascades of `test_events_counted_by_hand`
    assert found.size.tolist() == [2, 3]
    assert found.start.tolist() == [4.0, 8.0]
    assert found.stop.tolist() == [6.0, 8.0]


def test_laws_say_their_scales_and_keep_their_order():
    assert [str(law) for law in laws((0.5,))] == [
        "events", "drop, dt = 0.5", "length, dt = 0.5", "descent, dt = 0.5", "decreases, dt = 0.5",
    ]  # fmt: skip
    assert Law("drop", 0.1) < Law("drop", 0.3) < Law("length", 0.1)


@given(st.lists(st.integers(-3, 3), max_size=60))
def test_sums_are_those_of_the_sizes(steps):
    """At one change a unit of time, the changes themselves are the steps of dt = 1."""
    path = 100 + np.concatenate(([0], np.cumsum(np.array(steps, dtype=np.int64))))
    win = window(np.arange(len(path)) - 0.5, path, -0.5, len(path) - 0.5)
    found = sums(np.array(steps), 1.0) | sums(win.step)
    assert set(found) == set(laws((1.0,)))
    for law, one in found.items():
        each = sizes(window(np.arange(len(path)) - 0.5, path, 0.0, len(path) - 1.0), law) if len(path) > 1 else []
        assert one.tolist() == [np.sum(each), len(each)], law
