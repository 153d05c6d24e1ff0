"""Clustering beyond chance: closed forms against simulation, and what was planted is said."""

from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import AnalysisSettings, Study
from stickslip.analysis.findings.finding import Lack, Law, Level, Reason, Share
from stickslip.analysis.findings.place import EVERYWHERE
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.members import records, shift_unit
from stickslip.analysis.models.clustering import measure, own_gaps, pairs
from stickslip.analysis.questions.slips import cascades, collective, triggering
from stickslip.analysis.series.nulls import BlockSteps, rotated
from stickslip.pipeline.design.units import Units
from stickslip.pipeline.design.values import Course, Push, Pushes, Values
from tests.analysis import studies
from tests.analysis.designs import Data
from tests.analysis.test_chance import times_of
from tests.chance import SURE, agrees

SPAN = studies.SPAN


def test_pairs_counted_by_hand():
    t = np.array([0.0, 1.0, 1.0, 2.5, 6.0])
    assert [pairs(t, tau) for tau in (0.5, 1.0, 1.5, 1.6, 100.0)] == [1, 1, 3, 5, 10]  # a gap of tau is none
    assert pairs(np.zeros(0), 1.0) == 0


def test_pairs_of_rotation_agree_with_simulation(rng):
    steps = studies.blocks_run(rng, n=12)
    own = own_gaps(*steps.exits, SPAN, SPAN / 2)
    taus, draws = (0.1, 1.0, 10.0, 150.0, 300.0), 1000
    surrogates = [times_of(rotated(steps, rng), SPAN) for _ in range(draws)]
    drawn = np.array([[pairs(t[is_exit], tau) for tau in taus] for t, is_exit in surrogates])
    assert (np.abs(drawn.mean(0) - [*map(own.pairs, taus)]) < 5 * drawn.std(0) / np.sqrt(draws)).all()


def test_exits_each_of_its_own_block_are_a_poisson_process():
    own = own_gaps(np.array([1.0, 1.0, 3.0]), np.arange(3), 10.0, 5.0)
    assert own.pairs(1.0) == pytest.approx(3 * 0.19)  # three pairs; 2x - x^2 at x = 0.1


def test_gaps_are_those_on_the_circle_below_the_reach():
    found = own_gaps(np.array([0.5, 3.0, 3.5, 9.5]), np.array([0, 1, 0, 0]), 10.0, 3.5)
    assert sorted(found.gaps) == [1.0, 3.0]  # 9.5 to 0.5, 0.5 to 3.5; 3.5 to 9.5 is 4 the other way
    assert found.counts.tolist() == [3, 1]


# ------------------------------------------------------------------------------------------ the questions


def study_of(planted, runs, with_events=True, t_burn=20.0, settings=({},), confidence=0.95):
    """Runs given as `BlockSteps` as an ensemble: a matrix each, the same at each of some settings."""
    rows, series, events = [], {}, {}
    for (k, setting), (matrix, steps) in product(enumerate(settings), enumerate(runs)):
        member_id = f"run-{k}-{matrix:02d}"
        rows.append(planted.member(member_id, matrix, t_end=SPAN, t_stop=SPAN, **setting))
        blocks, first = np.unique(steps.block, return_index=True)
        sticks = np.zeros(200, dtype=bool)
        sticks[blocks] = steps.step[first] < 0
        t = np.concatenate(([0.0], steps.t))
        n_stick = sticks.sum() + np.concatenate(([0], np.cumsum(steps.step)))
        series[member_id] = (t, n_stick)
        if with_events:
            mode = np.where(steps.step > 0, 0, 1).astype(np.int8)
            events[member_id] = (steps.t, steps.block, mode, np.where(sticks, 0, 1).astype(np.int8))
    return Study(Data(pd.DataFrame(rows), series, events), AnalysisSettings(t_burn, (0.5, 2.0), 5, confidence, 0))


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


PERIOD = 5.0
FORCED = {"force_amplitude": 1.0, "force_frequency": 2.0 * np.pi / PERIOD}


def driven(rng, own, shared=0.0, n=12):
    """Blocks that a force lets go once in each of its periods, late by scatter of their own or that they share.

    Each sticks again a little later.
    """
    k = int(SPAN / PERIOD) - 1
    late = 1.0 + own * rng.uniform(-1.0, 1.0, (n, k)) + shared * rng.uniform(-1.0, 1.0, k)
    slips = PERIOD * np.arange(k) + late + np.linspace(0.0, 0.3, n)[:, None]
    t = np.stack([slips, slips + 0.6], axis=2).ravel()
    block, step, order = np.repeat(np.arange(n), 2 * k), np.tile([-1, 1], n * k), np.argsort(t)
    return BlockSteps(0.0, SPAN, t[order], block[order], step[order])


def nulls_of(planted, runs, setting):
    """Pairs and the decay rate of runs relative to time-shifted blocks."""
    study = study_of(planted, runs, settings=(setting,))
    (group,) = study.judged()
    (row,) = cascades.answer(study).tables["law"].to_dict("records")
    return [pairs.ratio for pairs in triggering.exits_of(study, group).pairs], row


def test_a_phase_that_a_force_gives_to_all_blocks_is_no_excess_over_time_shifted_blocks(planted, rng):
    """Without the period the same runs have one; blocks that are late together have it with the period too."""
    alone, together = ([driven(rng, *scatter) for _ in range(8)] for scatter in ((0.5,), (0.05, 0.5)))
    ratios, law = nulls_of(planted, alone, FORCED)
    assert all(abs(ratio.value - 1.0) < 0.1 for ratio in ratios)
    assert abs(law["over_shifted"]) < 0.05
    assert nulls_of(planted, alone, {})[0][-1].low > 1.5
    ratios, law = nulls_of(planted, together, FORCED)
    assert all(ratio.low > 1.1 for ratio in ratios[:2])
    assert law["over_shifted_high"] < -0.1


@pytest.mark.parametrize(("own", "period"), [(0.0, PERIOD), (0.5, SPAN / 6.0)])
def test_where_shifts_tell_nothing_of_coupling_there_is_no_null(planted, rng, own, period):
    """Blocks that do the same in each period of the force, and a force of six periods."""
    force = FORCED | {"force_frequency": 2.0 * np.pi / period}
    study = study_of(planted, [driven(rng, own) for _ in range(8)], settings=(force,))
    (lack,) = collective.answer(study).findings
    assert lack.reason is Reason.NO_SHIFT
    answered = cascades.answer(study)
    assert Reason.NO_SHIFT.value in answered.method
    assert not [finding for finding in answered.findings if "shifted" in sentence(finding)]


def test_blocks_are_shifted_by_the_period_that_all_forces_share():
    unforced = {"values": Values(), "force_frequency": None}
    forces = [Pushes(tuple(Push((1.0, x, 0.0), None, None) for x in (1.0, ratio))) for ratio in (1.5, 2.0**0.5)]
    shared, incommensurate = (unforced | {"values": Values({"forces": pushes}.items())} for pushes in forces)
    belt = {"values": Values({"belt_speed": Course((0.0, 1.0), (0.2, 0.4))}.items())}
    assert [shift_unit(setting) for setting in (unforced, unforced | {"force_frequency": 0.0})] == [0.0, 0.0]
    assert shift_unit(unforced | {"force_frequency": 2.0}) == pytest.approx(np.pi)
    assert shift_unit(shared) == pytest.approx(4.0 * np.pi)
    assert np.isnan([shift_unit(setting) for setting in (incommensurate, unforced | belt)]).all()


@pytest.mark.parametrize("tau", [0.1, 2.0, PERIOD, 12.0, 250.0])
def test_pairs_of_rotation_by_periods_agree_with_simulation(rng, tau):
    steps = replace(driven(rng, 0.5, n=6), t_stop=SPAN, n_periods=int(SPAN / PERIOD))
    ((_, expected),) = measure(steps, [tau])
    surrogates = [times_of(rotated(steps, rng), SPAN) for _ in range(300)]
    drawn = np.array([pairs(t[is_exit], tau) for t, is_exit in surrogates])
    assert abs(drawn.mean() - expected) < 5 * drawn.std() / np.sqrt(300) + 1e-9


def exits_of(planted, runs):
    study = study_of(planted, runs)
    return triggering.exits_of(study, study.judged()[0])


def test_pairs_of_independent_blocks_are_judged_together(planted, rng):
    exits = exits_of(planted, [studies.blocks_run(rng) for _ in range(10)])
    assert [one.tau for one in exits.pairs] == [0.05, 0.2, 1.0]
    assert {one.difference.family.n for one in exits.pairs} == {3}
    assert all(0.5 < one.ratio.value < 2 for one in exits.pairs)
    (found,) = triggering.triggered(exits, EVERYWHERE, "system")
    assert found.estimate.high < 0.1 if is_limit(found) else found.estimate.low < 0.05
    if is_limit(found):
        assert found.predicate == "trigger another within 0.05"


def test_the_time_is_in_the_units_of_the_scene(planted, rng):
    """0.05 of a scale of 1/320 s, and 0.05 itself, without one."""
    exits = exits_of(planted, [studies.blocks_run(rng) for _ in range(10)])
    first = exits.pairs[0]
    assert exits.within(first) == "within 0.05"
    seconds = exits._replace(units=Units("s", "m", "kg"), pairs=[first._replace(tau=0.05 / 320)])
    (level,) = seconds.levels(EVERYWHERE, "system")
    assert level.quantity.name == "mean number of slip onsets within 1.56e-4 s after one"


def test_exits_that_follow_others_are_seen(planted, rng):
    runs = [followers(rng, studies.blocks_run(rng), 0.3) for _ in range(10)]
    (found,) = triggering.triggered(exits_of(planted, runs), EVERYWHERE, "system")
    assert 0 < found.estimate.low < found.estimate.value < 0.5


def test_exits_that_follow_others_make_cascades_larger_than_of_the_same_blocks_made_independent(planted, rng):
    runs = [followers(rng, studies.blocks_run(rng), 0.3) for _ in range(10)]
    row = cascades.answer(study_of(planted, runs)).tables["law"].iloc[0]
    assert row["over_shifted_high"] < 0


def is_limit(share):
    return share.estimate.value is None


def planted_pairs(rows, n_exits, gap, confidence):
    pairs = triggering.compare("", rows, np.full(len(rows), n_exits), [0.2], confidence)
    return triggering.Exits(pairs, len(rows), gap)


def test_the_share_of_exits_that_trigger_others_holds_the_planted_one(rng):
    """Each triggered exit is a pair more; of an exponential delay 0.865 is below twice its mean."""
    runs = [studies.triggered(studies.blocks_run(rng), 0.1, 0.1, rng) for _ in range(10)]
    n_exits = float(np.mean([np.sum(steps.step < 0) for steps in runs]))
    rows = np.array([measure(steps, [0.2]) for steps in runs])
    (found,) = triggering.triggered(planted_pairs(rows, n_exits, 1.0, 0.99999), EVERYWHERE, "system")
    assert 0.0865 < found.estimate.high < 0.25
    if is_limit(found):
        assert triggering.triggered(planted_pairs(rows, n_exits, 2.0, 0.99999), EVERYWHERE, "system") == []


def test_the_limit_is_not_tight_by_luck(rng):
    """Pairs of true ratio 1 + share / pairs an exit: the limit holds the share, and never falls below the error."""
    error, pairs_an_exit, n_exits, sets = 0.003, 0.275, 1000.0, 400
    held = 0
    for _ in range(sets):
        ratio = np.log1p(0.0006 / pairs_an_exit) + error * np.sqrt(20) * rng.standard_normal(20)
        by_rotation = np.full(20, pairs_an_exit * n_exits)
        pairs_rows = np.stack([by_rotation * np.exp(ratio), by_rotation], axis=1)
        exits = planted_pairs(pairs_rows[:, None], n_exits, 1.0, 0.95)
        (found,) = triggering.triggered(exits, EVERYWHERE, "system")
        held += found.estimate.high >= 0.0006
        if is_limit(found):
            effect = exits.pairs[0].ratio
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
        one, other = (collective.answer(study_of(planted, runs, confidence=SURE)) for _ in range(2))  # or some drift
        assert one.findings == other.findings
        assert len(sentence(one.findings[0]).split()) <= 25
        lead = one.findings[0]
        assert isinstance(lead, Law | Level | Share | Lack)
        if isinstance(lead, Lack) and lead.reason is Reason.NOT_SHOWN:
            assert "has no peak relative to" in one.figures["collective"].caption
        assert set(one.tables) == {"clustering", "spectrum"}
        for name, table in one.tables.items():
            pd.testing.assert_frame_equal(table, other.tables[name])
            assert all(value == value for row in records(table) for value in row.values())  # null, never NaN
