"""Equivalence: closed forms, false alarms and power on planted data, and verdicts that follow the numbers."""

import importlib.util
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from stickslip.analysis.questions.robustness_section import robustness_section
from stickslip.analysis.report.section import Data

from stickslip.analysis.stats.cascades import window
from stickslip.analysis.stats.compare import (
    DIFFERENT,
    EQUIVALENT,
    OPEN,
    equivalence_test,
    matrices_needed,
    mean_difference,
    power,
    share_over_matrices,
    wilson,
)
from stickslip.analysis.stats.estimates import ratio
from stickslip.analysis.stats.multiplicity import holm
from stickslip.analysis.stats.quantities import band_share
from stickslip.analysis.stats.robustness import summary, time_shares, wasserstein

_spec = importlib.util.spec_from_file_location("twin_studies", Path(__file__).with_name("twin_studies.py"))
studies = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(studies)

MARGINS = {"mean": 0.1, "variance": 0.25, "rate": 0.1, "gamma": 0.05, "distribution": 0.5}


def test_the_tests_agree_with_their_intervals():
    for difference in np.linspace(-0.2, 0.2, 41):
        test = equivalence_test(difference, 0.03, 19, 0.1)
        low, high = test.interval(0.90)
        assert (test.p_equivalent < 0.05) == (low > -0.1 and high < 0.1)
        low, high = test.interval(0.95)
        assert (test.p_different < 0.05) == (not low <= 0 <= high)
    with pytest.raises(ValueError, match="margin"):
        equivalence_test(0.0, 0.1, 19, 0.0)


def test_independent_is_welch():
    rng = np.random.default_rng(0)
    first, second = rng.normal(0, 1, 12), rng.normal(0.5, 3, 20)
    sums = (np.column_stack([values, np.ones_like(values)]) for values in (first, second))
    difference, error, dof = mean_difference(ratio, *sums, paired=False)
    known = stats.ttest_ind(second, first, equal_var=False)
    assert difference / error == pytest.approx(known.statistic)
    assert dof == pytest.approx(known.df)


def test_holm_against_the_textbook():
    # sorted 0.005, 0.01, 0.03, 0.04 times 4, 3, 2, 1, made monotone (Holm 1979)
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])


def test_wilson_against_scipy():
    for k in (0, 3, 20):
        known = stats.binomtest(k, 20).proportion_ci(0.95, method="wilson")
        assert wilson(k, 20, 0.95) == pytest.approx((known.low, known.high))


def test_runs_of_one_matrix_are_not_independent():
    alike = np.array([[3, 3], [0, 3]] * 10)  # draws of a matrix agree: 20 trials, not 60
    _, _, _, trials = share_over_matrices(alike, 0.95)
    assert trials == pytest.approx(20, abs=1.1)
    # 1500 ensembles at 95%: three binomial errors are 1.7 points, and Wilson's own error is a point
    assert abs(studies.share_coverage(ensembles=1500, seed=2) - 0.95) < 0.027


def test_what_the_runs_of_matrices_are_worth_by_hand():
    """Shares 1, 0, 1/2, 1/2 of two runs each: residuals 1, -1, 0, 0, variance 4/3 * 2 / 64 = 1/24 of 1/4."""
    share, low, high, trials = share_over_matrices(np.array([[2, 2], [0, 2], [1, 2], [1, 2]]), 0.95)
    assert (share, trials) == (0.5, pytest.approx(6))
    assert (low, high) == pytest.approx(wilson(3, 6, 0.95))


def test_matrices_needed_is_the_first_with_the_power():
    found = matrices_needed(0.2, 0.1, 0.05)
    assert power(found, 0.2, 0.1, 0.05) >= 0.8 > power(found - 1, 0.2, 0.1, 0.05)
    assert matrices_needed(30.0, 0.01, 0.05) is None


@pytest.mark.long
@pytest.mark.parametrize("quantity", ["mean", "variance", "gamma"])
def test_alarms_and_power_on_planted_differences(quantity):
    _, spread, margin = studies.OBSERVED[quantity]
    # 1500 ensembles: three binomial errors at 5% are 1.7 points, at 30% 3.5 points
    at_margin = studies.verdicts(quantity, margin, ensembles=1500, seed=1)
    none = studies.verdicts(quantity, 0.0, ensembles=1500, seed=1)
    assert at_margin[EQUIVALENT] < 0.05 + 0.02
    assert none[DIFFERENT] < 0.05 + 0.02
    assert none[EQUIVALENT] == pytest.approx(power(20, spread, margin, 0.05), abs=0.045)


@pytest.mark.long
def test_alarms_and_power_of_the_test_of_distributions():
    none, _ = studies.distance_verdicts(0.0, ensembles=300, pool=300, seed=1)
    assert none == pytest.approx(0.05, abs=0.045)  # three binomial errors of 300, and the pool's
    far, same = studies.distance_verdicts(4.0, margin=1.25, ensembles=50, pool=300, seed=1)
    assert far == 1.0
    assert same == 0.0


def test_band_share_of_a_pure_oscillation():
    t = np.arange(0, 400, 0.1)

    def share(period):
        values = np.rint(100 + 50 * np.sin(2 * np.pi * t / period)).astype(int)
        return band_share(window(t, values, 0.0, 400.0))

    assert share(20.0) > 0.98
    assert share(8.0) < 0.02
    assert share(60.0) < 0.05


def test_shares_of_time_and_their_distance():
    shares = time_shares(window([0.0, 1.0, 3.0], [2, 0, 2], 0.0, 4.0), 3)
    assert shares == pytest.approx([0.5, 0, 0.5, 0])
    other = time_shares(window([0.0], [3], 0.0, 4.0), 3)
    # half of the mass moves by three, half by one
    assert wasserstein(shares, other) == pytest.approx(2.0)
    known = stats.wasserstein_distance([0, 2], [3, 3], [0.5, 0.5], [0.5, 0.5])
    assert wasserstein(shares, other) == pytest.approx(known)


def test_no_summary_of_a_run_at_rest():
    assert summary(window([0.0], [0], 0.0, 10.0), 5) is None


def _members(planted, change, n_matrices=12, ends=None):
    """Runs of one law in pairs; `change` makes the changed series of (rng, matrix)."""
    rows, series = [], {}
    for matrix in range(n_matrices):
        rng = np.random.default_rng([5, matrix])
        rows.append(planted.member(f"b{matrix}", matrix))
        series[f"b{matrix}"] = _path(studies.oscillating(rng, t_end=1000.0))
        outcome = "finished" if ends is None else ends[matrix]
        extra = {"perturbation_size": 0.10, "perturbation_reading": "scale", "outcome": outcome, "n_stick_end": 0}
        rows.append(planted.member(f"p{matrix}", matrix, **extra))
        series[f"p{matrix}"] = change(rng, matrix)
    return Data(pd.DataFrame(rows), series)


def _path(win):
    return np.concatenate(([win.t_start], win.t)), win.path()


def _section(data, margins=MARGINS, seed=0):
    return robustness_section(data, t_burn=0.0, margins=margins, confidence=0.95, seed=seed)


def test_same_law_is_equivalent_and_another_is_different(planted):
    same = _section(_members(planted, lambda rng, _: _path(studies.oscillating(rng, t_end=1000.0))))
    rows = same.tables[0].frame.query("kind == 'constants'").set_index("quantity")
    assert rows.loc["mean", "verdict"] == EQUIVALENT
    assert (rows["verdict"] != DIFFERENT).all()
    other = _section(_members(planted, lambda rng, _: _path(studies.oscillating(rng, t_end=1000.0, shift=6.0))))
    rows = other.tables[0].frame.query("kind == 'constants'").set_index("quantity")
    assert rows.loc["mean", "verdict"] == DIFFERENT
    assert rows.loc["distribution", "verdict"] == DIFFERENT
    assert rows.loc["mean", "difference"] == pytest.approx(6 / 32, abs=0.03)
    assert "Different at every size" in " ".join(other.statements)
    assert "different at" not in " ".join(same.statements)


def test_few_matrices_are_not_enough_and_say_how_many_are(planted):
    data = _members(planted, lambda rng, _: _path(studies.oscillating(rng, t_end=1000.0)), n_matrices=4)
    section = _section(data, {"mean": 0.01})
    row = section.tables[0].frame.iloc[0]
    assert row["verdict"] == OPEN
    assert row["matrices_needed"] > 4
    assert "matrices would be needed" in row["statement"]


def test_the_same_path_is_not_robustness(planted):
    data = _members(
        planted, lambda rng, matrix: _path(studies.oscillating(np.random.default_rng([5, matrix]), 1000.0))
    )
    assert "still follow the path of their base" in " ".join(_section(data).statements)


def test_fates_are_frequencies_and_a_runaway_is_no_collapse(planted):
    ends = ["collapsed"] * 6 + ["diverged"] * 2 + ["finished"] * 4
    stop = np.array([0.0, 1.0]), np.array([3, 0])
    data = _members(
        planted,
        lambda rng, m: stop if ends[m] != "finished" else _path(studies.oscillating(rng, t_end=1000.0)),
        ends=ends,
    )
    section = _section(data)
    rows = section.tables[1].frame.set_index("event")
    assert (rows.loc["total collapse", "n_events"], rows.loc["runaway", "n_events"]) == (6, 2)
    assert rows.loc["total collapse", "low"] == pytest.approx(wilson(6, 12, 0.95)[0])
    assert "6 of 12 runs" in " ".join(section.statements)
    assert "8 of 24 are left out" in " ".join(section.assumptions)


def test_all_at_rest_is_no_equivalence(planted):
    stop = np.array([0.0, 1.0]), np.array([3, 0])
    section = _section(_members(planted, lambda rng, m: stop, ends=["collapsed"] * 12))
    assert section.tables[0].frame.query("kind == 'constants'")["verdict"].tolist() == [OPEN]
    assert "nothing to compare after t_burn: of 12 changed runs 12 in total collapse" in " ".join(section.statements)


def test_refusals_and_none(planted):
    data = _members(planted, lambda rng, _: _path(studies.oscillating(rng, t_end=1000.0)), n_matrices=2)
    with pytest.raises(ValueError, match="mode"):
        _section(data, {"mode": 0.1})
    with pytest.raises(ValueError, match="mean > 0"):
        _section(data, {"mean": 0.0})
    members, series = planted.ensemble({"coulomb": 0.69}, 3)
    assert _section(Data(members, series)) is None
