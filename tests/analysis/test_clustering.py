"""Clustering beyond chance: closed forms against simulation, false alarms, what was planted is found."""

from itertools import combinations

import numpy as np
import pandas as pd
import pytest
from stickslip.analysis.groups import fill, groups
from stickslip.analysis.questions.clustering_section import clustering_section, verdict
from stickslip.analysis.questions.map_section import crossings, map_section
from stickslip.analysis.report.section import Data
from stickslip.analysis.report.tables import records

from stickslip.analysis import AnalysisSettings
from stickslip.analysis.stats.cascades import Window, spans
from stickslip.analysis.stats.clustering import (
    chance_within,
    excess,
    fano,
    independent_variation,
    long_durations,
    measure,
    moments,
    n_windows,
    own_gaps,
    pairs,
    pairs_in_random_order,
    rotated_spans,
    steps_of_series,
    variation,
    variation_difference,
)
from stickslip.analysis.stats.estimates import gamma_difference, over_matrices, ratio
from stickslip.analysis.stats.nulls import BlockSteps, rotated, triggered

T = 200.0
TAUS = (0.05, 0.2, 1.0, 3.0)
WINDOWS = (1.0, 5.0, 20.0)


def renewal_blocks(rng, n=40, t_stop=T):
    """Independent blocks that stick and slip by turns, rates over a factor of 10: about 900 exits in 200 units.

    Times of sticking are gamma of shape 3, of slipping of shape 1.5, so that a block's exits keep apart.
    """
    stick = 10 ** rng.uniform(0, 1, n)
    slip = stick * rng.uniform(1, 4, n)
    n_cycles = int(2 * (t_stop + 50) / 2) + 20
    times = np.stack(
        [rng.gamma(3, stick[:, None] / 3, (n, n_cycles)), rng.gamma(1.5, slip[:, None] / 1.5, (n, n_cycles))], axis=-1
    ).reshape(n, -1)
    t = np.cumsum(times, axis=1) - 50 - 10 * rng.uniform(0, 5, (n, 1))  # begun long before
    step = np.broadcast_to(np.tile([-1, 1], n_cycles), t.shape)
    block = np.broadcast_to(np.arange(n)[:, None], t.shape)
    inside = (t > 0) & (t <= t_stop)
    order = np.argsort(t[inside])
    return BlockSteps(0.0, t_stop, t[inside][order], block[inside][order], step[inside][order])


def judged(runs, confidence=0.95):
    """Whether the interval of each effect misses zero, from one `Clustering` a matrix."""
    found = {}
    for k, tau in enumerate(TAUS):
        found[f"pairs {tau:g}"] = over_matrices(excess, np.array([run.pairs[k] for run in runs]), confidence)
    for k, length in enumerate(WINDOWS):
        rows = np.array([[run.fano[k, 0] - run.fano[k, 1], 1.0] for run in runs])
        found[f"fano {length:g}"] = over_matrices(ratio, rows, confidence)
    found["events"] = over_matrices(gamma_difference, np.array([run.events for run in runs]), confidence)
    for name in ("durations", "waits"):
        rows = np.array([getattr(run, name) for run in runs])
        found[name] = over_matrices(variation_difference, rows, confidence)
    return {name: not one.low <= 0 <= one.high for name, one in found.items()}


def study(ensembles, matrices=20, share=0.0, draws=10, delay=0.1, first=0):
    """Share of planted ensembles in which each effect is called different from zero.

    With share = 0 the blocks are independent and these are false alarms; otherwise they are the power against
    so many triggered exits.
    """
    calls = []
    for ensemble in range(first, first + ensembles):
        runs = []
        for matrix in range(matrices):
            rng = np.random.default_rng([ensemble, matrix])
            steps = renewal_blocks(rng)
            if share:
                steps = triggered(steps, share, delay * T / np.sum(steps.step < 0), rng)
            runs.append(measure(steps, TAUS, WINDOWS, rotated_spans(steps, draws, rng)))
        calls.append(judged(runs))
    return {name: float(np.mean([call[name] for call in calls])) for name in calls[0]}


# ------------------------------------------------------------------------------------------- estimators


def test_pairs_counted_by_hand():
    t = np.array([0.0, 1.0, 1.0, 2.5, 6.0])
    assert pairs(t, (0.5, 1.0, 1.5, 1.6, 100.0)).tolist() == [1, 1, 3, 5, 10]  # less than tau: a gap of tau is none
    assert pairs(np.zeros(0), (1.0,)).tolist() == [0]


def test_pairs_and_fano_of_rotation_agree_with_simulation():
    steps = renewal_blocks(np.random.default_rng(0), n=12)
    t, block = steps.exits()
    own = own_gaps(t, block, T)
    taus, tiles, draws = (0.1, 1.0, 10.0, 150.0), (100, 20, 2), 2000
    rng = np.random.default_rng(1)
    turned = [rotated(steps, rng).exits()[0] for _ in range(draws)]
    for closed, drawn in (
        (own.pairs(taus), np.array([pairs(one, taus) for one in turned])),
        ([own.fano(k) for k in tiles], np.array([[fano(one, 0.0, T, k) for k in tiles] for one in turned])),
    ):
        assert (np.abs(drawn.mean(0) - closed) < 4 * drawn.std(0) / np.sqrt(draws)).all()


def test_exits_each_of_its_own_block_are_a_poisson_process():
    win = Window(0.0, 10.0, 5, np.array([1.0, 2.0, 3.0, 7.0]), np.array([-2, 1, -1, 1]))
    t, block = steps_of_series(win).exits()
    own = own_gaps(t, block, 10.0)
    assert own.pairs((1.0, 20.0)) == pytest.approx([3 * 0.19, 3.0])  # three pairs; 2x - x^2 at x = 0.1
    assert own.fano(5) == pytest.approx(1.0)
    assert chance_within((5.0,), 10.0) == pytest.approx([0.75])


def test_pairs_in_random_order_agree_with_every_order_listed():
    win = Window(0.0, 10.0, 5, np.array([1.0, 1.5, 3.0, 7.0]), np.array([-2, 1, -1, 1]))
    times = np.array([1.0, 1.0, 1.5, 3.0, 7.0])
    counts = [pairs(np.array(chosen), (1.0,))[0] for chosen in combinations(times, 3)]
    assert pairs_in_random_order(win, (1.0,)) == pytest.approx([np.mean(counts)])


def test_windows_tile_the_span():
    assert [n_windows(length, 10.0) for length in (1.0, 3.0, 4.0, 100.0)] == [10, 3, 2, 2]
    assert fano(np.arange(10) + 0.5, 0.0, 10.0, 5) == 0.0
    assert fano(np.array([0.1, 0.2, 0.3, 0.4]), 0.0, 4.0, 4) == pytest.approx(4.0)  # counts 4 0 0 0


@pytest.mark.parametrize("entries", [20_000, 40_000])
def test_spans_of_poisson_exits_and_entries_vary_as_derived(entries):
    rng = np.random.default_rng(2)
    t = rng.uniform(0, 1.0, 20_000 + entries)
    order = np.argsort(t)
    found = spans(Window(0.0, 1.0, 0, t[order], np.repeat([-1, 1], [20_000, entries])[order]))
    durations, waits = (variation(moments(values)[None])[0] for values in (long_durations(found), found.waiting))
    expected = independent_variation(20_000, entries)
    assert (durations, waits) == pytest.approx(expected, rel=0.03)  # of 7,000 and more: 1.2% each
    assert long_durations(found).mean() == pytest.approx(1 / entries, rel=0.05)


def test_independent_blocks_are_rarely_called_clustered():
    # 60 ensembles at 5%: standard deviation 2.8 points, three of them; the full study stands with `excess`.
    alarms = study(60, draws=5)
    assert max(alarms.values()) <= 0.05 + 3 * 0.028
    assert np.mean(list(alarms.values())) >= 0.02  # intervals far too wide would give none


def test_triggered_exits_are_seen():
    power = study(15, share=0.05, draws=5, first=5000)
    assert power["pairs 0.05"] == 1.0  # 100% in the full study
    assert power["events"] >= 0.7  # 95% in the full study: three standard deviations of 5.6 points below


# ------------------------------------------------------------------------------------------ the section


def as_data(planted, runs, with_events=True, thresholds=()):
    """Runs given as `BlockSteps` as an ensemble: a matrix each."""
    rows, series, events, by_threshold = [], {}, {}, {}
    for matrix, steps in enumerate(runs):
        member_id = f"run-{matrix:02d}"
        rows.append(planted.member(member_id, matrix, t_end=T, t_stop=T))
        first = np.unique(steps.block, return_index=True)
        sticks = np.zeros(40, dtype=bool)
        sticks[first[0]] = steps.step[first[1]] < 0
        t = np.concatenate(([0.0], steps.t))
        n_stick = sticks.sum() + np.concatenate(([0], np.cumsum(steps.step)))
        series[member_id] = (t, n_stick)
        if with_events:
            mode = np.where(steps.step > 0, 0, 1).astype(np.int8)
            events[member_id] = (steps.t, steps.block, mode, np.where(sticks, 0, 1).astype(np.int8))
        for c in thresholds:
            by_threshold[member_id, c] = (t[:: round(2 * c)], n_stick[:: round(2 * c)])
    data = Data(pd.DataFrame(rows), series, events, {}, by_threshold)
    settings = AnalysisSettings(20.0, (0.5,), 2, 0.95, 0)
    found = groups(data.members)
    for group in found:
        fill(group, series, settings)
    return data, found


def ask(data, found):
    return clustering_section(
        data, found, t_burn=20.0, taus=TAUS, lengths=WINDOWS, resamples=3, repeats=4, confidence=0.95, seed=1
    )


def coupled(steps, share, delay, rng):
    """Some exits moved to shortly after an exit of another block, each between its own entry and the next one.

    Unlike in `triggered`, blocks still stick and slip by turns, as the modes of a run must.
    """
    t, exits = steps.t.copy(), np.flatnonzero(steps.step < 0)
    for k in rng.permutation(exits)[: round(share * len(exits))]:
        entries = steps.t[(steps.block == steps.block[k]) & (steps.step > 0)]
        low = max(entries[entries < steps.t[k]], default=0.0)
        high = min(entries[entries > steps.t[k]], default=T)
        after = t[exits[steps.block[exits] != steps.block[k]]] + rng.exponential(delay)
        after = after[(after > low) & (after < high)]
        t[k] = rng.choice(after) if len(after) else t[k]
    order = np.argsort(t)
    return BlockSteps(steps.t_start, steps.t_stop, t[order], steps.block[order], steps.step[order])


def planted_runs(share, n_matrices=10):
    runs = []
    for matrix in range(n_matrices):
        rng = np.random.default_rng([17, matrix])
        steps = renewal_blocks(rng)
        runs.append(coupled(steps, share, 0.1 * T / np.sum(steps.step < 0), rng) if share else steps)
    return runs


def table(section, name):
    return records(next(one.frame for one in section.tables if one.name == name))


def test_section_finds_the_share_that_was_planted(planted):
    section = ask(*as_data(planted, planted_runs(0.1)))
    assert "exits cluster beyond chance" in section.statements[0].lower()
    rows = [row for row in table(section, "pairs") if row["null"] == "rotation of blocks"]
    assert rows[0]["is_beyond_chance"]
    assert rows[0]["share_alike"] == pytest.approx(0.1, abs=0.03)  # excess to 8%, control to 5% of itself
    assert 0 < rows[0]["share_seen"] < 0.05


def test_section_says_what_would_have_been_seen(planted):
    section = ask(*as_data(planted, planted_runs(0.0)))
    assert "not distinguishable from chance" in section.statements[0]
    assert "would have been seen" in section.statements[0]
    assert {row["null"] for row in table(section, "events_by_null")} == {
        "rotation of blocks", "independent exits", "random order", "fair order",
    }  # fmt: skip
    again = ask(*as_data(planted, planted_runs(0.0)))
    assert section.statements == again.statements
    for one, other in zip(section.tables, again.tables, strict=True):
        pd.testing.assert_frame_equal(one.frame, other.frame)
        assert not any(value != value for row in records(one.frame) for value in row.values())  # null, never NaN


def test_section_without_events_takes_independent_exits_and_says_so(planted):
    section = ask(*as_data(planted, planted_runs(0.0), with_events=False))
    assert {row["null"] for row in table(section, "pairs")} == {"independent exits", "random order"}
    assert any("record events" in text for text in section.assumptions)


def test_section_with_too_little_data_gives_reasons(planted):
    alone = ask(*as_data(planted, planted_runs(0.0, 1)))
    assert "not enough data: one matrix only" in alone.statements[0]
    still = BlockSteps(0.0, T, np.array([3.0]), np.array([0]), np.array([-1]))
    none = ask(*as_data(planted, [still, still]))
    assert "not enough data: no run has two exits" in none.statements[0]
    assert none.pictures == ()


def row_of_pairs(**changes):
    row = {
        "null": "rotation of blocks", "tau": 0.1, "excess": 0.2, "excess_low": 0.1, "excess_high": 0.3,
        "is_beyond_chance": True, "share_alike": 0.03, "share_seen": 0.01, "reason": None,
    }  # fmt: skip
    return row | changes


def test_verdict_changes_with_the_numbers():
    assert "as 3% triggered exits would give" in verdict([row_of_pairs()], (0.02, 0.2), 0.95)
    assert "as more than 20% triggered" in verdict([row_of_pairs(share_alike=None)], (0.02, 0.2), 0.95)
    apart = row_of_pairs(excess=-0.2, excess_low=-0.3, excess_high=-0.1)
    assert "keep apart" in verdict([apart], (0.2,), 0.95)
    unseen = row_of_pairs(excess_low=-0.1, is_beyond_chance=False, share_seen=None)
    assert "not even 20%" in verdict([unseen], (0.02, 0.2), 0.95)
    rhythm = verdict([row_of_pairs(), row_of_pairs(tau=5.0, excess=0.15, share_seen=None)], (0.2,), 0.95)
    assert "not triggering" in rhythm


# ---------------------------------------------------------------------------------------------- the map


def test_map_gives_every_definition_and_threshold(planted):
    data, found = as_data(planted, planted_runs(0.0, 4), thresholds=(0.5, 1.0))
    section = map_section(data, found, t_burn=20.0, dt=(0.1, 0.5, 2.0), taus=(0.2,), resamples=3)
    own, by_threshold = table(section, "gamma_by_definition"), table(section, "gamma_map")
    assert len(own) == 1 + 4 * 3 + 1
    assert len(by_threshold) == 2 * len(own)
    # Thinned by one, the threshold 0.5 is the members' own series.
    for a, b in zip(own, by_threshold, strict=False):
        assert (a["definition"], a["dt"], a["gamma"], a["gamma_independent"]) == (
            b["definition"], b["dt"], b["gamma"], b["gamma_independent"],
        )  # fmt: skip
    assert len(section.pictures) == 2
    plain = map_section(*as_data(planted, planted_runs(0.0, 4), with_events=False), t_burn=20.0, dt=(0.5,))
    assert {row["null"] for row in table(plain, "gamma_by_definition")} == {"random order"}
    assert len(plain.pictures) == 1


def test_map_of_nothing_says_so(planted):
    still = BlockSteps(0.0, T, np.array([3.0]), np.array([0]), np.array([-1]))
    section = map_section(*as_data(planted, [still, still]), t_burn=20.0, dt=(0.5,), taus=(0.2,), resamples=2)
    assert "Not enough data" in section.statements[0]
    assert section.pictures == ()


def test_crossings_are_interpolated_in_log_dt():
    rows = [{"dt": dt, "gamma": value} for dt, value in ((0.1, 1.0), (1.0, 0.5), (10.0, None), (100.0, 1.0))]
    assert crossings(rows, "gamma", 0.75) == pytest.approx([10**-0.5, 10.0])
    assert crossings(rows, "gamma", 2.0) == []
