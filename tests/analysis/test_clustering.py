"""Clustering beyond chance: closed forms against simulation, and what was planted is said."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import AnalysisSettings, Data, Study
from stickslip.analysis.models.clustering import FANO, PAIRS, Part, fano, measure, n_windows, own_gaps, pairs
from stickslip.analysis.questions.slips import clustering, counting, definitions
from stickslip.analysis.report.formats import environment
from stickslip.analysis.series.nulls import BlockSteps, rotated
from stickslip.analysis.stats.compare import WITHIN
from stickslip.analysis.stats.effects import MORE
from stickslip.analysis.tables import records
from tests.analysis import studies
from tests.chance import agrees

SPAN = studies.SPAN


def test_pairs_counted_by_hand():
    t = np.array([0.0, 1.0, 1.0, 2.5, 6.0])
    assert [pairs(t, tau) for tau in (0.5, 1.0, 1.5, 1.6, 100.0)] == [1, 1, 3, 5, 10]  # a gap of tau is none
    assert pairs(np.zeros(0), 1.0) == 0


def test_pairs_and_fano_of_rotation_agree_with_simulation(rng):
    steps = studies.blocks_run(rng, n=12)
    own = own_gaps(*steps.exits(), SPAN, SPAN / 2)
    taus, tiles, draws = (0.1, 1.0, 10.0, 150.0, 300.0), (100, 20, 2), 1000
    turned = [t[step < 0] for t, step in (rotated(steps, rng) for _ in range(draws))]
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


def said(question, answer):
    words = environment().get_template(f"{question}.html").module
    return str(words.lack(answer.facts, answer.lack) if answer.lack else words.answer(answer.facts))


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


def test_independent_blocks_are_not_said_to_cluster(planted, rng):
    runs = [studies.blocks_run(rng) for _ in range(10)]
    found = clustering.answer(study_of(planted, runs))
    first = found.facts["first"]
    assert first["p_value"] == first["p_adjusted"]  # the primary question
    assert 0.5 < first["ratio"] < 2
    assert 0 < found.facts["close"]["share"] < 0.1
    if found.facts["pairs"] == WITHIN and found.facts["apart"] is None:
        assert "o excess of exits close in time is shown" in said("clustering", found)


def test_a_common_slow_mode_leads_and_exits_do_not_set_each_other_off(planted, rng):
    runs = [studies.blocks_run(rng, depth=0.6) for _ in range(10)]
    found = clustering.answer(study_of(planted, runs))
    assert found.facts["lead"] is found.facts["first"]
    assert found.facts["lead"]["verdict"] == MORE
    assert "move slowly together: the number of exits in windows of 20" in said("clustering", found)


def test_exits_that_follow_others_are_seen(planted, rng):
    runs = [followers(rng, studies.blocks_run(rng), 0.3) for _ in range(10)]
    found = clustering.answer(study_of(planted, runs))
    assert found.facts["pairs"] == MORE
    assert said("clustering", found).strip().startswith("Exits set each other off")


def test_exits_that_follow_others_make_cascades_larger_than_of_the_same_blocks_made_independent(planted, rng):
    runs = [followers(rng, studies.blocks_run(rng), 0.3) for _ in range(10)]
    lead = counting.answer(study_of(planted, runs)).facts["lead"]
    assert lead["coupling_high"] < 0
    assert lead["verdict"] == "shallower"


def test_the_share_of_followers_that_is_not_excluded_holds_the_planted_one(rng):
    """Each follower is a pair more; of an exponential delay 0.865 is below twice its mean."""
    runs = [studies.triggered(studies.blocks_run(rng), 0.1, 0.1, rng) for _ in range(10)]
    part, n_exits = Part(PAIRS, 0.2), float(np.mean([np.sum(steps.step < 0) for steps in runs]))
    rows = np.array([measure(steps, [part]) for steps in runs])
    measured = clustering._Measured(SimpleNamespace(label=""), [part], [], rows, n_exits, gap=1.0)
    pairs = clustering._rows(measured, 0.99999, 0.25)
    close = clustering._closest(pairs, measured, 0.99999, 5)
    assert 0.0865 < close["share"] < 0.25
    assert clustering._closest(pairs, dataclasses.replace(measured, gap=2.0), 0.99999, 5) is None


def test_the_bound_of_followers_is_not_tight_by_luck(rng):
    """Pairs of true ratio 1 + share / pairs an exit: the bound holds the share, never falls below the error, and
    what is said to be seen is shown by the first of Holm's tests in four of five data sets."""
    error, pairs_an_exit, n_exits, n_tests, sets = 0.003, 0.275, 1000.0, 10, 400
    measured = clustering._Measured(
        SimpleNamespace(label=""), [Part(PAIRS, 0.2)], [], np.zeros((20, 1, 2)), n_exits, gap=1.0
    )

    def closest(share):
        ratio = np.log1p(share / pairs_an_exit) + error * np.sqrt(20) * rng.standard_normal(20)
        by_rotation = np.full(20, pairs_an_exit * n_exits)
        rows = np.stack([by_rotation * np.exp(ratio), by_rotation], axis=1)[:, None]
        (row,) = clustering._rows(dataclasses.replace(measured, runs=rows), 0.95, 0.25)
        return clustering._closest([row], measured, 0.95, n_tests), row["p_value"]

    every = [closest(0.0006)[0] for _ in range(sets)]
    assert agrees(sum(row["share"] >= 0.0006 for row in every), sets, 0.95, 1.0)
    own_errors = [np.sqrt(row["high"] / row["low"]) - 1.0 for row in every]  # half of the interval of the logarithm
    assert all(row["share"] >= 0.999 * own * pairs_an_exit for row, own in zip(every, own_errors, strict=True))
    seen = np.mean([row["seen"] for row in every])
    assert agrees(sum(closest(seen)[1] <= 0.05 / n_tests for _ in range(sets)), sets, 0.7, 0.88)


def test_without_events_it_says_what_to_record(planted, rng):
    runs = [studies.blocks_run(rng) for _ in range(5)]
    found = clustering.answer(study_of(planted, runs, with_events=False))
    assert "events = true" in said("clustering", found)


def test_too_little_data_gives_reasons(planted, rng):
    one = [studies.blocks_run(rng)]
    still = [BlockSteps(0.0, SPAN, np.array([30.0]), np.array([0]), np.array([-1]))] * 6
    for question in (clustering, definitions):
        name = question.__name__.rpartition(".")[2]
        assert "too few matrices" in said(name, question.answer(study_of(planted, one)))
        assert "nothing is counted" in said(name, question.answer(study_of(planted, still)))


def test_an_answer_is_the_same_twice(planted, rng):
    runs = [studies.blocks_run(rng) for _ in range(5)]
    for question in (clustering, definitions):
        one, other = (question.answer(study_of(planted, runs)) for _ in range(2))
        for name, table in one.tables.items():
            pd.testing.assert_frame_equal(table, other.tables[name])
            assert all(value == value for row in records(table) for value in row.values())  # null, never NaN


# ------------------------------------------------------------------------------------------- definitions


def test_every_definition_and_step_has_its_row(planted, rng):
    found = definitions.answer(study_of(planted, [studies.blocks_run(rng) for _ in range(6)]))
    table = found.tables["definitions"]
    assert len(table) == 1 + 4 * 2
    assert table["over"].between(0.8, 1.2).all()
    assert "against independent blocks" in said("definitions", found)


def test_a_difference_beyond_the_margin_is_told_from_one_whose_interval_reaches_within_it():
    """The margin of gamma is 1%, of the logarithm: below, it ends at 1 / 1.01 = 0.9901."""
    rows = [
        {"verdict": verdict, "over_low": low, "over_high": high}
        for verdict, low, high in (
            ("steeper", 1.011, 1.03), ("steeper", 1.009, 1.03), ("shallower", 0.97, 0.9902),
            ("shallower", 0.97, 0.9900), ("shallower", 0.98, 0.995), ("within", 0.995, 1.005),
            ("cannot be told", 1.02, 1.05),
        )
    ]  # fmt: skip
    found = definitions.counts(rows)
    assert found == {"n_beyond": 2, "n_about": 3, "n_alike": 1, "n_open": 1}


def test_no_definition_is_said_to_lie_within_the_margin_unless_it_is_shown(planted, rng):
    found = definitions.answer(study_of(planted, [studies.blocks_run(rng) for _ in range(6)]))
    words = environment().get_template("definitions.html").module
    facts = found.facts | {"n_beyond": 5, "n_about": 3, "n_alike": 0, "n_open": 1}
    part = words.part(facts, lambda *_: "")
    assert "5 differ from them by more than 1% over the whole interval, 3 by about 1%: a difference is shown" in part
    assert "None is shown to lie within 1%; for 1 it cannot be told." in part


def test_without_events_gamma_stands_alone(planted, rng):
    found = definitions.answer(study_of(planted, [studies.blocks_run(rng) for _ in range(6)], with_events=False))
    assert found.facts["over"] == []
    assert list(found.figures) == ["definitions"]
    assert "how often." in said("definitions", found)


def test_more_map_steps_are_in_the_table(planted, rng):
    study = study_of(planted, [studies.blocks_run(rng) for _ in range(5)])
    study = Study(study.data, dataclasses.replace(study.settings, map_dt=(0.2, 1.0, 4.0)))
    table = definitions.answer(study).tables["definitions"]
    assert sorted(table["dt"].dropna().unique()) == [0.2, 0.5, 1.0, 2.0, 4.0]


def test_a_fano_factor_says_its_window(planted, rng):
    found = clustering.answer(study_of(planted, [studies.blocks_run(rng) for _ in range(5)]))
    rows = found.facts["of"][FANO]
    assert [row["upto"] for row in rows] == [20.0, 5.0, 1.0, 0.5]  # 580 units hold twenty windows of 20, not of 40
    assert found.facts["first"] is rows[0]
