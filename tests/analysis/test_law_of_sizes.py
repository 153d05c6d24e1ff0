"""The law of cascade sizes: planted laws and couplings, and the findings that come of them."""

import dataclasses
import re
from functools import partial

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import Study
from stickslip.analysis.findings.alerts import Code
from stickslip.analysis.findings.finding import Fit, Lack, Law, Level, Reason, Verdict, levels
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.measures import of_windows
from stickslip.analysis.members import records
from stickslip.analysis.models import pool
from stickslip.analysis.questions.runs.engines import between_engines
from stickslip.analysis.questions.slips import cascade_definitions, cascades
from stickslip.analysis.questions.slips.cascade_figures import Size, departure
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.components import between
from stickslip.analysis.stats.estimates import LN2, Estimate, gamma, over_matrices
from tests.analysis import studies
from tests.analysis.blocks import coupled_blocks
from tests.analysis.designs import Data
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


def law_of(answer):
    """The first finding."""
    law = answer.findings[0]
    assert isinstance(law, Law)
    return law


def found(answer, key, other=""):
    """The level of a quantity, beside something."""
    rows = [
        row for one in answer.findings if isinstance(one, Level) for row in levels(one) if row.quantity.key == key
    ]
    return next((row for row in rows if row.comparison is None or row.comparison.other == other), None)


def verdict(level):
    return level.comparison.difference.verdict


def test_a_geometric_law_shows_no_departure_in_most_cases(planted, settings, rng):
    studies_of = [study_of(planted, settings, studies.geometric(0.7, 100), rng) for _ in range(8)]
    laws = [law_of(cascades.answer(study)) for study in studies_of]
    assert {law.fit for law in laws} == {Fit.CLOSE}
    assert agrees(sum(verdict(law.departure) is Verdict.OPEN for law in laws), len(laws), 0.95)


@pytest.mark.parametrize(("law", "fit", "side", "error"), [
    pytest.param(pool.law(30, 4.875, 30), Fit.CLOSE, Verdict.LESS, 0.013, id="pool of 30 blocks"),
    pytest.param(
        (studies.geometric(0.5) + studies.geometric(1.1)) / 2, Fit.CLOSE, Verdict.MORE, 0.028, id="two rates"
    ),
    pytest.param(np.arange(1.0, 101) ** -2.5, Fit.FAILS, Verdict.MORE, 1.0, id="power law"),
])  # fmt: skip
def test_the_variance_tells_other_laws_from_a_geometric_one(planted, settings, rng, law, fit, side, error):
    law = law[:100] / law[:100].sum()
    answer = cascades.answer(study_of(planted, settings, law, rng))
    assert law_of(answer).fit is fit
    departure = found(answer, "variance", cascades.GEOMETRIC)
    assert departure == law_of(answer).departure
    assert verdict(departure) is side
    assert departure.comparison.difference.estimate.value == pytest.approx(studies.excess_of(law), abs=ERRORS * error)
    said = sentence(answer.findings[0])
    assert ("do not fall off" if fit is Fit.FAILS else "fall off nearly geometrically: decay rate ") in said


@pytest.mark.parametrize(
    ("rate", "side"), [(LN2, Verdict.OPEN), (LN2 - 0.12, Verdict.LESS), (LN2 + 0.3, Verdict.MORE)]
)
def test_the_interval_alone_tells_the_rate_from_that_of_a_coin(planted, settings, rate, side):
    answer = cascades.answer(Study(Data(*planted.ensemble({"coulomb": rate}, 20)), settings))
    level = law_of(answer).parameter
    assert level.estimate.low < rate < level.estimate.high
    assert verdict(level) is side
    assert level.basis.n == 20
    assert level.comparison.difference.estimate.value == pytest.approx(level.estimate.value / LN2 - 1)
    assert len(sentence(answer.findings[0]).split()) <= 25


def test_rates_are_equal_only_within_a_margin_that_the_scene_declares(planted, settings):
    data = Data(*planted.ensemble({"coulomb": LN2 + 0.02}, 20))
    verdicts = [
        verdict(law_of(cascades.answer(Study(data, dataclasses.replace(settings, margins=margins)))).parameter)
        for margins in ({}, {"gamma": 0.2}, {"mean": 0.5})
    ]
    assert verdicts[1] is Verdict.EQUAL
    assert verdicts[0] is verdicts[2] is not Verdict.EQUAL


def test_each_of_many_settings_is_beside_ln_2_before_any_is_beside_other_nulls(planted, rng):
    n = range(12, 21)
    answer = cascades.answer(coupled_blocks(planted, n, 0.0, rng, changes=1500))
    rows = [level for finding in answer.findings for level in levels(finding)]
    law = answer.tables["law"]
    steady = [f"n = {size}" for size in law["n"][law["basis"] != "drifts"]]
    assert {str(level.where) for level in rows} == set(steady)
    others = [level.comparison.other for level in rows if str(level.where) != steady[-1]]
    n_others = len(steady) - 1
    assert others[:n_others] == ["ln 2"] * n_others


def test_a_smallest_size_leaves_smaller_cascades_out_and_a_geometric_law(planted, settings, rng):
    law = studies.geometric(0.7, 100)
    law[0] *= 3
    study = study_of(planted, settings, law, rng)
    assert verdict(found(cascades.answer(study), "variance", cascades.GEOMETRIC)) is Verdict.MORE
    cut = cascades.answer(Study(study.data, dataclasses.replace(settings, smallest=2)))
    row = cut.tables["law"].iloc[0]
    assert row["gamma"] == pytest.approx(0.7, abs=0.06)
    assert row["variance"] == pytest.approx(1.0, abs=0.15)
    assert row["smallest"] == 2
    assert row[["gamma_pool", "gamma_shifted"]].isna().all()
    assert cut.tables["sizes"]["size"].min() == 2


def test_coupling_makes_the_planted_part_of_the_excess(planted, rng):
    """Blocks that hold each other back have more than finite size gives them; alone they have that and no more."""
    coupled, alone = (
        cascades.answer(coupled_blocks(planted, (20,), pull, rng, matrices=20, changes=9000)) for pull in (0.1, 0.0)
    )
    row, shifted = coupled.tables["law"].iloc[0], found(coupled, "gamma", cascades.SHIFTED)
    assert verdict(shifted) is Verdict.MORE
    effects = coupled.findings[1]
    assert re.match(r"Coupling raises the decay rate by [\d.]+% \(", sentence(effects))
    assert sum(level.estimate.value for level in effects.parts) == pytest.approx(effects.whole.estimate.value)
    finite_size, own_dynamics, _ = (level.estimate for level in effects.parts)
    assert finite_size.value == pytest.approx(pool.gamma(20, 6.0) / np.log(2.0) - 1.0, abs=0.01)
    assert own_dynamics.value == pytest.approx(0.0, abs=0.03), "blocks without memory"
    assert sentence(alone.findings[1]).startswith("No effect of coupling on the decay rate is shown")
    assert row["gamma_pool"] == pytest.approx(pool.gamma(20, 6.0), abs=0.01)
    assert alone.tables["law"]["over_shifted"][0] == pytest.approx(0.0, abs=0.02)


def test_two_state_blocks_of_which_all_stick_have_no_rate():
    """Of two systems one has a block that slips: without it nothing does."""
    rows = np.zeros((2, 8))
    rows[:, 6:] = [[90.0, 10.0], [100.0, 10.0]]
    rate = over_matrices(partial(cascades.of_pool, 10), rows, 0.95)
    assert rate.value == pytest.approx(pool.gamma(10, 9.5))
    assert rate.reason == "one left out: all blocks always stick, or always slip"


def test_too_little_data_has_reasons(planted, settings, rng):
    def lack(study):
        (finding,) = cascades.answer(study).findings
        assert isinstance(finding, Lack)
        return finding.reason

    law = studies.geometric(0.7, 100)
    assert lack(study_of(planted, settings, law, rng, n_matrices=2)) is Reason.FEW_UNITS
    scarce = study_of(planted, settings, law, rng, n_cascades=12)
    assert lack(scarce) is Reason.FEW_CASCADES
    (rate,) = of_windows(scarce, ("gamma",))  # nor is it compared
    assert rate.of(scarce.groups[0]).withheld == enough.FEW_CASCADES
    for shares in ([1.0], [0.6, 0.4]):  # as of two blocks with friction, whatever others are there
        study = study_of(planted, settings, np.array(shares), rng)
        assert lack(study) is Reason.FEW_BLOCKS
        assert rate.of(study.groups[0]).withheld == enough.FEW_BLOCKS
    still = {name: (np.array([0.0]), np.array([0])) for name in planted.ensemble({"coulomb": 0.7}, 6)[1]}
    assert lack(Study(Data(planted.ensemble({"coulomb": 0.7}, 6)[0], still), settings)) is Reason.NO_MOTION


OFF = "Shares (exact) lie below the fitted geometric distribution at s = 1 and 4 to 7 and above it at s = 3"


@pytest.mark.parametrize(("bend", "two_state", "words"), [
    (0.8, 0.8, f"{OFF}, like those of independent two-state blocks. "), (0.8, 1.0, f"{OFF}. "), (1.0, 1.0, ""),
])  # fmt: skip
def test_the_figure_says_at_which_sizes_shares_leave_the_fit(bend, two_state, words):
    bends = {1: bend, 3: 1 / bend} | dict.fromkeys(range(4, 8), bend)
    shares = {size: 0.5**size * bends.get(size, 1.0) for size in range(1, 8)}
    sizes = [
        Size(
            "exact",
            size,
            1000,
            Estimate(share, 0.95 * share, 1.05 * share),
            0.5**size,
            share if two_state < 1 else 0.5**size,
        )
        for size, share in shares.items()
    ]
    assert departure(sizes, " (exact)") == words


def test_runs_that_ended_are_an_alert(planted, settings):
    members, series = planted.ensemble({"coulomb": LN2}, 8)
    ended = planted.member("c1", 8, outcome="collapsed", reason="certified", t_stop=50.0)
    more = series | {"c1": (np.array([0.0]), np.array([0]))}
    study = Study(Data(pd.concat([members, pd.DataFrame([ended])]), more), settings)
    (alert,) = cascades.answer(study).alerts
    assert alert.code is Code.SETTLED
    assert str(alert).startswith("1 of 9 runs ended in steady sliding")


def test_settings_beside_the_lead_are_levels_with_their_setting(planted, rng):
    answer = cascades.answer(coupled_blocks(planted, (20, 40), 0.0, rng))
    assert law_of(answer).parameter.where == Place.key("n", "40")
    others = [
        finding for finding in answer.findings if isinstance(finding, Level) and finding.where == Place.key("n", "20")
    ]
    assert {level.comparison.other for level in others} == {cascades.COIN, cascades.SHIFTED, cascades.TWO_STATE}
    assert list(answer.figures) == ["size_law", "decay_rates", "one_run"]  # one sampling step gives no curve
    law, each, run = (picture.caption for picture in answer.figures.values())
    assert "dotted: independent two-state blocks" in law
    assert law.endswith("1 of 2 settings are drawn.")
    assert re.search(r"The systems (are not shown to )?differ beyond sampling error \([^)]+%", each)
    assert run.endswith("at n = 40. Grey: before t_burn.")
    for picture in answer.figures.values():
        assert picture.recipe().axes


def test_the_rate_by_another_engine_stands_beside_that_of_the_exact_law(planted, settings):
    """As the page of changes judges it; the margin of the scene says when both agree."""
    study = Study(Data(*planted.ensemble({"coulomb": 0.7, "sigmoid": 0.5}, 8)), settings)
    law, other, *_ = cascades.answer(study).findings
    assert law.parameter.where == Place((("n", "200"), ("", "exact")))
    assert (other.comparison.other, other.comparison.difference.verdict) == ("the exact law", Verdict.LESS)
    (step,) = between_engines(study, "gamma")
    assert other.comparison.difference == step.contrast.difference
    assert re.search(r"sigmoid, .*, the decay rate is [\d.]+% \(.*\) less than for the exact law\.$", sentence(other))
    study = Study(
        Data(*planted.ensemble({"coulomb": 0.7, "sigmoid": 0.71}, 8)),
        dataclasses.replace(settings, margins={"gamma": 0.2}),
    )
    assert cascades.answer(study).findings[1].comparison.difference.verdict is Verdict.EQUAL


# ------------------------------------------------------------------------------------------- estimates


def test_the_rate_of_a_system_is_over_the_parts_of_its_run(rng):
    counts = rng.integers(20, 60, (6, cascades.PARTS))
    parts = np.stack([counts + rng.poisson(counts), counts], axis=2).astype(float)
    values, errors = cascades.of_systems(np.concatenate([parts, np.ones((1, cascades.PARTS, 2))]))
    assert np.isnan([values[-1], errors[-1]]).all(), "sizes of one alone have no rate"
    for system, value, error in zip(parts, values, errors, strict=False):
        rate = over_matrices(gamma, system, 0.95)
        assert (value, 2.2621571627 * error) == pytest.approx((rate.value, rate.high - rate.value))  # t, 9 degrees


def test_the_scatter_between_systems_is_the_planted_part(rng):
    """Of 20 systems with ten parts each; three quarters of the variance of their means lie between them."""
    held, none, n = 0, 0, 1000
    for _ in range(n):
        parts = rng.normal(0.0, 1.0, (20, 10)) + rng.normal(0.0, np.sqrt(0.3), (20, 1))
        errors = parts.std(axis=1, ddof=1) / np.sqrt(10)
        estimate = between(parts.mean(axis=1), errors, 9, 0.95)
        held += estimate.low <= 0.75 <= estimate.high
        alike = parts - parts.mean(axis=1, keepdims=True) + rng.normal(0.0, np.sqrt(0.1), (20, 1))
        none += between(alike.mean(axis=1), errors, 9, 0.95).low == 0.0
    assert agrees(held, n, 0.95)
    assert agrees(none, n, 0.975)
    assert between(np.ones(1), np.ones(1), 9, 0.95).value is None


# ------------------------------------------------------------------------------------------- definitions


def test_every_definition_and_step_has_its_row(planted, rng):
    study = coupled_blocks(planted, (20,), 0.0, rng)
    study = Study(study.data, dataclasses.replace(study.settings, map_dt=(0.2, 1.0)))
    one, other = (cascade_definitions.compared(study, study.groups[0]) for _ in range(2))
    table = one.tables["definitions"]
    assert sorted(table["dt"].dropna().unique()) == [0.2, 0.5, 1.0]
    assert len(table) == 1 + 4 * 3
    by_events = table["gamma"][table["definition"] == "events"].item()
    assert by_events == pytest.approx(cascades.answer(study).tables["law"]["gamma"].item())
    pd.testing.assert_frame_equal(table, other.tables["definitions"])
    assert all(value == value for row in records(table) for value in row.values())  # null, never NaN
    assert one.figures["definitions"].recipe().axes


def test_without_events_rates_stand_alone(planted, settings):
    answer = cascades.answer(Study(Data(*planted.ensemble({"coulomb": LN2}, 8)), settings))
    assert found(answer, "gamma", cascades.SHIFTED) is None
    assert "definitions" in answer.figures
