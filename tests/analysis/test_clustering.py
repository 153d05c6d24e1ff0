"""Clustering beyond chance: closed forms against simulation, and what was planted is said."""

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import AnalysisSettings, Study
from stickslip.analysis.findings.finding import Basis, Lack, Level, Reason, Share, Verdict
from stickslip.analysis.findings.place import EVERYWHERE
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.members import records
from stickslip.analysis.models.clustering import Kind, Part, fano, measure, n_windows, own_gaps, pairs
from stickslip.analysis.questions.slips import cascades, collective, triggering
from stickslip.analysis.series.nulls import BlockSteps, rotated
from tests.analysis import studies
from tests.analysis.designs import Data
from tests.chance import agrees

SPAN = studies.SPAN


def test_pairs_counted_by_hand():
    t = np.array([0.0, 1.0, 1.0, 2.5, 6.0])
    assert [pairs(t, tau) for tau in (0.5, 1.0, 1.5, 1.6, 100.0)] == [1, 1, 3, 5, 10]  # a gap of tau is none
    assert pairs(np.zeros(0), 1.0) == 0


def test_pairs_and_fano_of_rotation_agree_with_simulation(rng):
    steps = studies.blocks_run(rng, n=12)
    own = own_gaps(*steps.exits, SPAN, SPAN / 2)
    taus, tiles, draws = (0.1, 1.0, 10.0, 150.0, 300.0), (100, 20, 2), 1000
    turned = [t[is_exit] for t, is_exit in (rotated(steps, rng) for _ in range(draws))]
    closed = [*map(own.pairs, taus), *map(own.fano, tiles)]
    drawn = np.array(
        [[*(pairs(one, tau) for tau in taus), *(fano(one, 0.0, SPAN, k) for k in tiles)] for one in turned]
    )
    assert (np.abs(drawn.mean(0) - closed) < 5 * drawn.std(0) / np.sqrt(draws)).all()


def test_exits_each_of_its_own_block_are_a_poisson_process():
    own = own_gaps(np.array([1.0, 1.0, 3.0]), np.arange(3), 10.0, 5.0)
    assert own.pairs(1.0) == pytest.approx(3 * 0.19)  # three pairs; 2x - x^2 at x = 0.1
    assert own.fano(5) == pytest.approx(1.0)


def test_gaps_are_those_on_the_circle_below_the_reach():
    found = own_gaps(np.array([0.5, 3.0, 3.5, 9.5]), np.array([0, 1, 0, 0]), 10.0, 3.5)
    assert sorted(found.gaps) == [1.0, 3.0]  # 9.5 to 0.5, 0.5 to 3.5; 3.5 to 9.5 is 4 the other way
    assert found.counts.tolist() == [3, 1]


def test_windows_tile_the_span():
    assert [n_windows(length, 10.0) for length in (1.0, 3.0, 4.0, 100.0)] == [10, 3, 2, 2]
    assert fano(np.arange(10) + 0.5, 0.0, 10.0, 5) == 0.0
    assert fano(np.array([0.1, 0.2, 0.3, 0.4]), 0.0, 4.0, 4) == pytest.approx(4.0)  # counts 4 0 0 0


# ------------------------------------------------------------------------------------------ the questions


def study_of(planted, runs, with_events=True, thresholds=()):
    """Runs given as `BlockSteps` as an ensemble: a matrix each."""
    rows, series, events, by_threshold = [], {}, {}, {}
    for matrix, steps in enumerate(runs):
        member_id = f"run-{matrix:02d}"
        rows.append(planted.member(member_id, matrix, t_end=SPAN, t_stop=SPAN))
        blocks, first = np.unique(steps.block, return_index=True)
        sticks = np.zeros(200, dtype=bool)
        sticks[blocks] = steps.step[first] < 0
        t = np.concatenate(([0.0], steps.t))
        n_stick = sticks.sum() + np.concatenate(([0], np.cumsum(steps.step)))
        series[member_id] = (t, n_stick)
        if with_events:
            mode = np.where(steps.step > 0, 0, 1).astype(np.int8)
            events[member_id] = (steps.t, steps.block, mode, np.where(sticks, 0, 1).astype(np.int8))
        for c in thresholds:
            by_threshold.setdefault(member_id, {})[c] = (t, n_stick)
    settings = AnalysisSettings(20.0, (0.5, 2.0), 5, 0.95, 0)
    return Study(Data(pd.DataFrame(rows), series, events, {}, by_threshold), settings)


def followers(rng, steps, share):
    """Some exits moved to shortly after an exit of another block, between their own entry and the next one.

    Unlike in `studies.triggered`, blocks still stick and slip by turns, as the modes of a run must.
    """
    t, exits = steps.t.copy(), np.flatnonzero(steps.step < 0)
    entries = [np.append(steps.t[(steps.block == i) & (steps.step > 0)], SPAN) for i in range(steps.block.max() + 1)]
    for k in rng.permutation(exits)[: round(share * len(exits))]:
        own = entries[steps.block[k]]
        after_it = int(np.searchsorted(own, steps.t[k]))
        low, high = own[after_it - 1] if after_it else 0.0, own[after_it]
        after = t[exits[steps.block[exits] != steps.block[k]]] + rng.exponential(0.05)
        after = after[(after > low) & (after < high)]
        t[k] = rng.choice(after) if len(after) else t[k]
    order = np.argsort(t)
    return BlockSteps(steps.t_start, steps.t_stop, t[order], steps.block[order], steps.step[order])


def exits_of(planted, runs):
    study = study_of(planted, runs)
    return triggering.exits_of(study, study.judged()[0])


def test_the_primary_comparison_of_independent_blocks_is_not_adjusted(planted, rng):
    exits = exits_of(planted, [studies.blocks_run(rng) for _ in range(10)])
    first, *others = exits.compared
    assert first.part == Part(Kind.FANO, 20.0)  # 580 units hold twenty windows of 20, not of 40
    assert first.difference.family is None
    assert 0.5 < first.ratio.value < 2
    assert {one.difference.family.n for one in others} == {len(others)}
    (found,), _ = triggering.triggered(exits, EVERYWHERE, "system")
    assert found.estimate.high < 0.1 if is_limit(found) else found.estimate.low < 0.05
    if is_limit(found):
        assert found.predicate == "trigger another within 0.05"


def test_a_common_slow_mode_has_more_exits_in_some_windows(planted, rng):
    exits = exits_of(planted, [studies.blocks_run(rng, depth=0.6) for _ in range(10)])
    first = exits.compared[0]
    assert first.difference.verdict is Verdict.MORE
    said = sentence(first.level(EVERYWHERE, Basis(10)))
    assert said.startswith("Counts of slip onsets in windows of 20 vary ")
    assert said.endswith(" for time-shifted blocks.")


def test_exits_that_follow_others_are_seen(planted, rng):
    runs = [followers(rng, studies.blocks_run(rng), 0.3) for _ in range(10)]
    (found,), _ = triggering.triggered(exits_of(planted, runs), EVERYWHERE, "system")
    assert 0 < found.estimate.low < found.estimate.value < 0.5


def test_exits_that_follow_others_make_cascades_larger_than_of_the_same_blocks_made_independent(planted, rng):
    runs = [followers(rng, studies.blocks_run(rng), 0.3) for _ in range(10)]
    row = cascades.answer(study_of(planted, runs)).tables["law"].iloc[0]
    assert row["over_shifted_high"] < 0


def is_limit(share):
    return share.estimate.value is None


def planted_pairs(rows, n_exits, gap, confidence):
    compared = triggering.compare("", rows, [Part(Kind.FANO, 20.0), Part(Kind.PAIRS, 0.2)], confidence)
    return triggering.Exits(None, compared, [], len(rows), n_exits, gap)


def test_the_share_of_exits_that_trigger_others_holds_the_planted_one(rng):
    """Each triggered exit is a pair more; of an exponential delay 0.865 is below twice its mean."""
    runs = [studies.triggered(studies.blocks_run(rng), 0.1, 0.1, rng) for _ in range(10)]
    n_exits = float(np.mean([np.sum(steps.step < 0) for steps in runs]))
    rows = np.array([measure(steps, [Part(Kind.FANO, 20.0), Part(Kind.PAIRS, 0.2)]) for steps in runs])
    (found,), _ = triggering.triggered(planted_pairs(rows, n_exits, 1.0, 0.99999), EVERYWHERE, "system")
    assert 0.0865 < found.estimate.high < 0.25
    if is_limit(found):
        assert triggering.triggered(planted_pairs(rows, n_exits, 2.0, 0.99999), EVERYWHERE, "system") == ([], None)


def test_the_limit_is_not_tight_by_luck(rng):
    """Pairs of true ratio 1 + share / pairs an exit: the limit holds the share, and never falls below the error."""
    error, pairs_an_exit, n_exits, sets = 0.003, 0.275, 1000.0, 400
    held = 0
    for _ in range(sets):
        ratio = np.log1p(0.0006 / pairs_an_exit) + error * np.sqrt(20) * rng.standard_normal(20)
        by_rotation = np.full(20, pairs_an_exit * n_exits)
        pairs_rows = np.stack([by_rotation * np.exp(ratio), by_rotation], axis=1)
        exits = planted_pairs(np.stack([pairs_rows, pairs_rows], axis=1), n_exits, 1.0, 0.95)
        (found,), _ = triggering.triggered(exits, EVERYWHERE, "system")
        held += found.estimate.high >= 0.0006
        if is_limit(found):
            effect = exits.compared[1].ratio
            half = np.sqrt(effect.high / effect.low) - 1.0  # of the interval of the logarithm
            assert found.estimate.high >= 0.999 * half * pairs_an_exit
    assert agrees(held, sets, 0.95, 1.0)


def test_without_events_it_says_what_to_record(planted, rng):
    runs = [studies.blocks_run(rng) for _ in range(5)]
    (lack,) = collective.answer(study_of(planted, runs, with_events=False)).findings
    assert (lack.reason, lack.detail) == (Reason.NOT_RECORDED, "set events = true under [record]")


def test_too_little_data_has_its_reason(planted, rng):
    still = [BlockSteps(0.0, SPAN, np.array([30.0]), np.array([0]), np.array([-1]))] * 6
    for runs, reason in (([studies.blocks_run(rng)], Reason.FEW_UNITS), (still, Reason.NO_MOTION)):
        (lack,) = collective.answer(study_of(planted, runs)).findings
        assert lack.reason is reason


def test_the_answer_leads_with_one_number_and_is_the_same_twice(planted, rng):
    for depth in (0.0, 0.6):
        runs = [studies.blocks_run(rng, depth=depth) for _ in range(6)]
        one, other = (collective.answer(study_of(planted, runs)) for _ in range(2))
        assert one.findings == other.findings
        assert len(sentence(one.findings[0]).split()) <= 25
        lead = one.findings[0]
        assert isinstance(lead, Level | Share | Lack)
        assert set(one.tables) == {"clustering", "spectrum"}
        for name, table in one.tables.items():
            pd.testing.assert_frame_equal(table, other.tables[name])
            assert all(value == value for row in records(table) for value in row.values())  # null, never NaN
