"""What of gamma is counting, and what coupling: closed forms, identities, and planted pools."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis import Study
from stickslip.analysis.findings.finding import Lack, Parts, Reason
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.models import pool
from stickslip.analysis.questions.slips import cascades
from stickslip.analysis.series.cascades import Window
from stickslip.analysis.series.nulls import BlockSteps
from stickslip.analysis.stats.estimates import LN2
from stickslip.workflows.scenes import counting
from tests.analysis import studies
from tests.analysis.blocks import coupled_blocks
from tests.analysis.designs import Data
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
    assert found["excess"] == pytest.approx(found["finite_size"] + found["own_dynamics"] + found["coupling"])
    assert found["time_shifted"] == pytest.approx(found["finite_size"] + found["own_dynamics"])


def test_intervals_of_the_parts_hold_the_planted_ones(rng):
    """Alike blocks without memory, where coupling and habits are zero; and two kinds of coupling."""
    for row in studies.study("counting", int(rng.integers(2**32)), 60):
        assert row.is_covered(), row


# ------------------------------------------------------------------------------------------------- the question


#: As much data as shows a coupling of 0.1 at n = 20 by five of its standard errors more than a verdict asks for.
PLENTY = {"matrices": 20, "changes": 9000}


def estimates(finding):
    """The parts of a decomposition, by name."""
    return {level.quantity.key: level.estimate for level in (finding.whole, *finding.parts)}


def test_independent_blocks_are_finite_size_alone(planted, rng):
    answers = [counting.question(coupled_blocks(planted, (40,), 0.0, rng)) for _ in range(8)]
    known = [answer.findings[0] for answer in answers if not isinstance(answer.findings[0], Lack)]
    assert {answer.findings[0].reason for answer in answers if isinstance(answer.findings[0], Lack)} <= {Reason.DRIFT}
    assert len(known) > 4  # a false alarm of drift has 5%: more than 3 of 8 are 4e-4
    parts = [estimates(finding) for finding in known]
    assert agrees(sum(part["coupling"].low <= 0 <= part["coupling"].high for part in parts), len(parts), 0.95)
    for part in parts:
        assert part["finite_size"].value == pytest.approx(pool.gamma(40, 12.0) / LN2 - 1, rel=0.1)


def test_coupling_is_told_by_the_number_of_blocks(planted, rng):
    answer = counting.question(coupled_blocks(planted, (20, 40), 0.1, rng, **PLENTY))
    sums = [finding for finding in answer.findings if isinstance(finding, Parts)]
    assert [str(finding.whole.where) for finding in sums] == ["n = 40", "n = 20"]
    for finding in sums:
        each = estimates(finding)
        assert each["coupling"].low > 0.0
        assert each["excess"].value == pytest.approx(
            sum(each[name].value for name in ("finite_size", "own_dynamics", "coupling"))
        )
    assert re.fullmatch(
        r"At n = 40, coupling raises the decay rate by [0-9.]+% \([0-9.]+ to [0-9.]+%\)\. Finite size adds"
        r" \+[0-9.]+% \(.*%\), each block's own dynamics adds .*%\)\.",
        sentence(sums[0]),
    )
    figure = answer.figures["counting"].recipe()
    assert [ax.get_ylabel() for ax in figure.axes] == [counting.OVER_COIN, counting.SCALED]
    labels = {text.get_text() for text in figure.legends[0].texts}
    assert labels == {"p = 1/2", "two-state: finite size", "time-shifted: own dynamics too", "runs: coupling too"}
    one = counting.question(coupled_blocks(planted, (40,), 0.1, rng))
    (axes,) = one.figures["counting"].recipe().axes
    assert len(axes.lines[0].get_xdata()) == 8
    assert list(axes.lines[1].get_xdata()) == [estimates(one.findings[0])["coupling"].value]


def test_what_is_missing_is_said(planted, rng):
    study = coupled_blocks(planted, (40,), 0.0, rng, matrices=2)
    assert counting.question(study).findings[0].reason is Reason.FEW_UNITS
    unrecorded = Study(replace(study.data, events={}), study.settings)
    assert counting.question(unrecorded).findings[0].reason is Reason.NOT_RECORDED


def test_the_rate_is_held_against_one_pool_lulls_or_none(planted, rng):
    """Of four blocks, slowed down so that n_stick rests at zero for long: both questions take the same mean."""
    study = coupled_blocks(planted, (4,), 0.0, rng)
    slow = 100.0
    series = {name: (slow * t, n_stick) for name, (t, n_stick) in study.data.series.items()}
    events = {name: (slow * t, *rest) for name, (t, *rest) in study.data.events.items()}
    members = study.data.members.assign(t_end=slow * study.data.members["t_end"])
    study = Study(Data(members.assign(t_stop=members["t_end"]), series, events), study.settings)
    part, law = counting.counted(study, study.groups[0]), cascades.answer(study).tables["law"].iloc[0]
    assert part.share_in_lulls > 0.05
    over_pool = part.estimates["excess"].value - part.estimates["finite_size"].value
    assert (law["gamma"] - law["gamma_pool"]) / LN2 == pytest.approx(over_pool, abs=1e-9)
