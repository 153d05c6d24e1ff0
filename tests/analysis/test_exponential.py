"""Whether sizes are exponential: planted laws, and what is said of them."""

import dataclasses

import numpy as np
import pytest

from stickslip.analysis import Data, Study
from stickslip.analysis.models import pool
from stickslip.analysis.questions.slips import exponential
from stickslip.analysis.report.formats import environment
from tests.analysis import studies
from tests.chance import ERRORS, agrees


def study_of(planted, settings, law, rng, n_matrices=12, n_cascades=1500):
    """Cascades of planted sizes, an entry for each exit: n_stick by turns falls by a size and rises as far."""
    members, series = planted.ensemble({"coulomb": 0.7}, n_matrices)
    for name in series:
        sizes = studies.of_law(rng, law, n_cascades)
        steps = np.concatenate([[-k, k] for k in sizes])
        t = np.sort(rng.uniform(0, planted.t_end, len(steps)))
        series[name] = np.concatenate(([0.0], t)), 100 + np.concatenate(([0], np.cumsum(steps)))
    return Study(Data(members, series), settings)


def said(answer):
    words = environment().get_template("exponential.html").module
    return str(words.lack(answer.facts, answer.lack) if answer.lack else words.answer(answer.facts))


def test_an_exponential_is_not_told_from_one_in_most_cases(planted, settings, rng):
    found = [
        exponential.answer(study_of(planted, settings, studies.geometric(0.7, 100), rng)).facts["lead"]["verdict"]
        for _ in range(8)
    ]
    assert agrees(found.count("within"), len(found), 0.95)


@pytest.mark.parametrize(
    ("law", "verdict", "error"),
    [
        pytest.param(pool.law(30, 4.875, 30), "less", 0.013, id="pool of 30 blocks"),
        pytest.param((studies.geometric(0.5) + studies.geometric(1.1)) / 2, "more", 0.028, id="gamma 0.5 or 1.1"),
    ],
)
def test_other_laws_are_told_from_an_exponential(planted, settings, rng, law, verdict, error):
    law = law[:150] / law[:150].sum()
    excess = studies.excess_of(law)
    assert abs(excess) > exponential.MARGIN + ERRORS * error  # else some would lie within the margin
    found = exponential.answer(study_of(planted, settings, law, rng))
    lead = found.facts["lead"]
    assert lead["verdict"] == verdict
    assert lead["variance"] - 1 == pytest.approx(excess, abs=ERRORS * error)
    assert ("below" if verdict == "less" else "above") in said(found)
    quotients = found.tables["over_fit"]
    mean = law @ np.arange(1, len(law) + 1)
    assert quotients["value"].iloc[0] == pytest.approx(law[0] * mean, abs=0.05)
    assert (quotients["low"] <= quotients["value"]).all()


def test_the_pool_stands_beside_it(planted, settings, rng):
    study = study_of(planted, settings, studies.geometric(0.7, 100), rng)
    lead = exponential.answer(study).facts["lead"]
    mean = study.groups[0].mean(0.95).value
    assert lead["pool"] == pytest.approx(1 + pool.excess(200, mean))
    assert lead["over_pool"] == pytest.approx(lead["variance"] - lead["pool"], abs=1e-6)


def test_a_lower_cut_off_leaves_small_cascades_out_and_an_exponential_one(planted, settings, rng):
    law = studies.geometric(0.7, 100)
    law[0] *= 3
    whole = exponential.answer(study_of(planted, settings, law, rng)).facts["lead"]
    cut = exponential.answer(study_of(planted, dataclasses.replace(settings, smallest=2), law, rng)).facts["lead"]
    assert whole["verdict"] == "more"
    assert cut["variance"] == pytest.approx(1.0, abs=0.15)
    assert cut["smallest"] == 2
    assert cut["pool"] is None


def test_too_little_data_has_reasons(planted, settings, rng):
    few = exponential.answer(study_of(planted, settings, studies.geometric(0.7, 100), rng, n_matrices=2))
    assert "too few matrices" in said(few)
    ones = exponential.answer(study_of(planted, settings, np.array([1.0]), rng))
    assert "one size" in said(ones)


def test_a_single_block_has_cascades_of_one_size(planted, settings, rng):
    """It enters and leaves in turns, and there is no other block to stick, nor a pool of them."""
    members, series = planted.ensemble({"coulomb": 0.7}, 4)
    members["n"] = 1
    for name in series:
        t = np.sort(rng.uniform(0, planted.t_end, 400))
        series[name] = np.concatenate(([0.0], t)), np.concatenate(([1], np.tile([0, 1], 200)))
    found = exponential.answer(Study(Data(members, series), settings))
    assert "one size" in said(found)
