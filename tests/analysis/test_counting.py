"""What of gamma is counting, and what coupling: closed forms, identities, and planted pools."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from stickslip.analysis import AnalysisSettings, Data, Study
from stickslip.analysis.models import counting, pool
from stickslip.analysis.questions.slips import cascades
from stickslip.analysis.questions.slips import counting as question
from stickslip.analysis.report.formats import environment
from stickslip.analysis.report.page import plain
from stickslip.analysis.series.cascades import Window
from stickslip.analysis.series.nulls import BlockSteps
from stickslip.analysis.stats.estimates import LN2
from tests.analysis import studies
from tests.chance import agrees

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.mark.parametrize("p", [0.1, 0.162, 0.5, 0.8])
def test_the_pool_is_above_the_coin_by_one_over_four_variances(p):
    """To first order: the error falls as one over the variance, for every share that sticks."""
    off = []
    for n in (1_000, 10_000):
        variance = n * p * (1 - p)
        off.append((pool.gamma(n, n * p) - LN2) * variance - 0.25)
        assert pool.slope(n, n * p) * 4 * variance == pytest.approx(1, abs=2 / n / min(p, 1 - p))
    assert abs(off[1]) < 0.002
    assert off[0] == pytest.approx(10 * off[1], rel=0.1)


@pytest.mark.parametrize(("n", "mean"), [(200, 32.4), (30, 3.0), (5, 4.0)])
def test_the_pools_slope_is_that_of_its_states(n, mean):
    """Regression over all states, each weighted by how often a change finds it."""
    p, k = mean / n, np.arange(n + 1)
    out, into = (1 - p) * k, p * (n - k)
    weight = stats.binom.pmf(k, n, p) * (out + into)
    weight /= weight.sum()
    off, exit_next = k - weight @ k, out / (out + into)
    assert pool.slope(n, mean) == pytest.approx(weight @ (off * exit_next) / (weight @ off**2), rel=1e-9)


def test_the_slope_is_one_over_four_variances_of_any_series_that_returns(rng):
    """As many changes go from k + 1 to k as back, whatever makes them."""
    step = rng.permutation(np.repeat([-1, 1], 500))
    win = Window(0.0, 1001.0, 0, np.arange(1.0, 1001.0), step)
    before = win.path()[:-1]
    product, _ = counting.slope_sums(win)
    assert product == pytest.approx(len(before) / 4)
    halves = before.reshape(2, -1).mean(axis=1)
    expected = 0.25 / (before.var() + (halves[0] - halves[1]) ** 2 / 4)
    assert product / counting.slope_sums(win)[1] == pytest.approx(expected)


def test_lulls_are_cut_out_and_nothing_else():
    t = np.array([1.0, 2.0, 40.0, 41.0, 50.0, 51.0])
    block, step = np.array([0, 1, 1, 1, 0, 1]), np.array([-1, -1, 1, -1, 1, 1])
    win, steps = Window(0.0, 90.0, 2, t, step), BlockSteps(0.0, 90.0, t, block, step)
    cut, of_blocks, lull = counting.without_lulls(win, steps)  # 2 to 40; 41 to 50 is short
    assert lull == 38.0
    assert cut.t.tolist() == of_blocks.t.tolist() == [1.0, 2.0, 2.0, 3.0, 12.0, 13.0]
    assert (cut.t_stop, of_blocks.t_stop, cut.level) == (52.0, 52.0, 2)
    assert cut.path().tolist() == win.path().tolist()
    late = Window(0.0, 90.0, 1, np.array([60.0]), np.array([-1]))
    cut, _, lull = counting.without_lulls(late, BlockSteps(0.0, 90.0, late.t, np.array([0]), late.step))
    assert (cut.t_stop, lull) == (60.0, 30.0), "a lull that lasts to the end"
    busy = Window(0.0, 90.0, 3, t, step)
    assert counting.without_lulls(busy, steps)[0] is busy


def test_the_parts_add_up(rng):
    rows = np.array([counting.run_sums(*run, 3, rng) for run in studies.two_state_blocks(rng, 20, 0.3, 0.05, 400, 5)])
    whole = rows.sum(axis=0, keepdims=True)
    found = {name: float(of(whole)[0]) for name, of in counting.parts(20).items()}
    assert found["excess"] == pytest.approx(found["counting"] + found["habits"] + found["coupling"])
    assert found["independent"] == pytest.approx(found["counting"] + found["habits"])


def test_intervals_of_the_parts_hold_the_planted_ones(rng):
    """Alike blocks without memory, where coupling and habits are zero; and two kinds of coupling."""
    for row in studies.study("counting", int(rng.integers(2**32)), 60):
        assert row.is_covered(), row


# ------------------------------------------------------------------------------------------------- the question


#: As much data as shows a coupling of 0.1 at n = 20 by five of its standard errors more than a verdict asks for.
PLENTY = {"matrices": 20, "changes": 9000}


def study_of(planted, n, pull, rng, matrices=8, changes=3000):
    """Two-state blocks as an ensemble, for each of some n; 0.3 n stick."""
    rows, series, events = [], {}, {}
    for size in n:
        for matrix, (win, steps) in enumerate(studies.two_state_blocks(rng, size, 0.3, pull, changes, matrices)):
            name = f"{size}-{matrix}"
            rows.append(planted.member(name, matrix, n=size, t_end=win.t_stop, t_stop=win.t_stop))
            sticks = np.zeros(size, dtype=bool)
            blocks, first = np.unique(steps.block, return_index=True)
            sticks[blocks] = steps.step[first] < 0
            sticks[np.setdiff1d(np.arange(size), blocks)[: win.level - sticks.sum()]] = True
            series[name] = np.append(0.0, win.t), win.path()
            mode = np.where(steps.step > 0, 0, 1).astype(np.int8)
            events[name] = steps.t, steps.block, mode, np.where(sticks, 0, 1).astype(np.int8)
    members = pd.DataFrame(rows)
    members["t_end"] = members["t_end"].min()
    settings = AnalysisSettings(1.0, (0.5,), 10, 0.95, 0)
    return Study(Data(members, series, events), settings)


def said(answer, macro="answer"):
    words = environment().get_template("counting.html").module
    return plain(str(words.lack(answer.facts, answer.lack) if answer.lack else getattr(words, macro)(answer.facts)))


def test_independent_blocks_are_counting_alone(planted, rng):
    found = [question.answer(study_of(planted, (40,), 0.0, rng)) for _ in range(8)]
    leads = [one.facts["lead"] for one in found if not one.lack]
    assert {one.lack for one in found if one.lack} <= {"drifts"}  # a false alarm of 5%: more than 3 of 8 are 4e-4
    assert len(leads) > 4
    assert agrees(sum(lead["verdict"] in ("within", "cannot be told") for lead in leads), len(leads), 0.95, 1.0)
    lead = leads[0]
    assert lead["counting"] == pytest.approx(pool.gamma(40, lead["mean"]) / LN2 - 1)
    assert lead["slope_of_pool"] == pytest.approx(0.03, rel=0.1)


def test_coupling_is_told_by_the_number_of_blocks(planted, rng):
    study = study_of(planted, (20, 40), 0.1, rng, **PLENTY)
    found = question.answer(study)
    assert [row["n"] for row in found.facts["alike"]] == [20, 40]
    assert [row["verdict"] for row in found.facts["alike"]] == ["steeper", "steeper"]
    assert found.facts["lead"]["slope_verdict"] == "steeper"
    words = said(found)
    assert words.startswith("At n = 40, exact, γ is ")
    assert "the memoryless null of 40 blocks, contributes +" in words
    assert re.search(r"Coupling contributes \+[0-9.]+ \(.*\) at n = 20", words)
    figure = found.figures["counting"]()
    assert [ax.get_ylabel() for ax in figure.axes] == [question.EXCESS, question.SCALED]
    (one,) = question.answer(study_of(planted, (40,), 0.1, rng)).figures["counting"]().axes
    labels = {text.get_text() for text in one.get_legend().texts}
    assert labels == {"fair-coin null", "memoryless null", "independent blocks", "runs"}


def test_within_the_margin_is_said_with_it_though_coupling_is_shown(planted, rng, monkeypatch):
    monkeypatch.setattr(question, "GAMMA_MARGIN", 0.3)
    found = question.answer(study_of(planted, (40,), 0.1, rng, **PLENTY))
    assert found.facts["lead"]["coupling_low"] > 0
    assert found.facts["lead"]["verdict"] == "within"
    assert "within 30%" in said(found, "main")


def test_what_is_missing_is_said(planted, rng):
    study = study_of(planted, (40,), 0.0, rng, matrices=2)
    assert "too few matrices" in said(question.answer(study))
    assert question.answer(Study(replace(study.data, events={}), study.settings)) is None


def test_gamma_is_held_against_one_pool_lulls_or_none(planted, rng):
    """Of four blocks, slowed down so that n_stick rests at zero for long: both questions take the same mean."""
    study = study_of(planted, (4,), 0.0, rng)
    slow = 100.0
    series = {name: (slow * t, n_stick) for name, (t, n_stick) in study.data.series.items()}
    events = {name: (slow * t, *rest) for name, (t, *rest) in study.data.events.items()}
    members = study.data.members.assign(t_end=slow * study.data.members["t_end"])
    study = Study(Data(members.assign(t_stop=members["t_end"]), series, events), study.settings)
    row, law = (question.answer(study).tables["counting"].iloc[0], cascades.answer(study).tables["law"].iloc[0])
    assert row["in_lulls"] > 0.05
    assert law["over_pool"] / LN2 == pytest.approx(row["excess"] - row["counting"], abs=1e-9)
