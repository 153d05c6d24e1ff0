"""Pairs of runs that part at a planted rate, and the horizon of n_stick."""

import importlib.util
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from stickslip.analysis.questions.sensitivity_section import sensitivity_section
from stickslip.analysis.report.section import Data

from stickslip.analysis.pairs import CONSTANTS, RATIOS, START, settings
from stickslip.analysis.stats.sensitivity import (
    BLOCKS,
    amplification_gap,
    horizon,
    linear_range,
    mean_difference,
    median_interval,
    redraw_difference,
    slope,
    slope_error,
)

_spec = importlib.util.spec_from_file_location("twin_studies", Path(__file__).with_name("twin_studies.py"))
studies = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(studies)


def test_mean_difference_against_the_integral_by_hand():
    # |difference| is 2 on [0, 1), 1 on [1, 1.5), 3 on [1.5, 3): windows of one unit have means 2, (0.5 + 1.5), 3
    first = np.array([0.0, 1.0]), np.array([5, 4])
    second = np.array([0.0, 1.5]), np.array([3, 1])
    assert mean_difference(first, second, np.arange(4.0)) == pytest.approx([2.0, 2.0, 3.0])
    assert mean_difference(second, first, np.arange(4.0)) == pytest.approx([2.0, 2.0, 3.0])


def test_redraw_difference_is_the_mean_over_all_pairs():
    rng = np.random.default_rng(0)
    values = rng.integers(0, 50, 7)
    bases = [(np.zeros(1), np.array([value])) for value in values]
    pairs = [abs(a - b) for i, a in enumerate(values) for b in values[:i]]
    assert redraw_difference(bases, np.array([1.0])) == pytest.approx(np.mean(pairs))
    with pytest.raises(ValueError, match="two runs"):
        redraw_difference(bases[:1], np.array([1.0]))


def test_slope_recovers_the_rate_in_the_linear_range_alone():
    t = np.linspace(0, 1000, 501)
    grown = 1e-10 * np.exp(0.03 * t)
    distance = np.minimum(grown, 1.0) + 1e-10 * np.exp(-t)  # an early transient, and saturation at one
    one = slope((t, distance), 1e-2)
    assert one.rate == pytest.approx(0.03, rel=1e-3)
    assert one.late - one.early == pytest.approx(0, abs=1e-4)
    assert one.t_last < np.log(1e8) / 0.03 + 2
    assert slope((t, np.full(501, 1e-10)), 1e-2) is None
    assert linear_range(np.array([1, 2, 4, 8, 16, 8]), 3, 10) == slice(2, 4)


def test_error_of_one_slope_on_a_random_walk():
    """Increments of a drifting random walk are independent, its residuals are not: coverage of one slope."""
    rng = np.random.default_rng(2)
    t, hits = np.linspace(0, 1000, 201), 0
    for _ in range(400):
        log = 0.012 * t + np.cumsum(0.2 * rng.standard_normal(201))
        error = slope_error(t, log)
        hits += abs(np.polyfit(t, log, 1)[0] - 0.012) < stats.t.ppf(0.975, BLOCKS - 1) * error
    assert abs(hits / 400 - 0.95) < 0.033  # three binomial errors


def test_draws_are_told_apart_by_their_own_error(planted):
    """Four draws grow, two shrink after they have grown, one wanders, and one runs away."""
    rng = np.random.default_rng(3)
    t = np.linspace(0, 1000, 501)
    members, series, separations = _planted(planted)
    for matrix in range(8):
        trend = [0.012, 0.012, 0.012, 0.012, -0.004, -0.004, 0.0, 0.0][matrix] * t
        noise = np.cumsum((0.3 if matrix == 6 else 0.01) * rng.standard_normal(501))
        for size in (1e-10, 1e-6):
            separations[f"m{matrix}-t{size:g}"] = t, size * np.exp(5 * (t > 0) + trend + noise)
    members.loc[members["member_id"].str.startswith("m7-t"), "outcome"] = "diverged"
    data = Data(members, series, {}, separations)
    section = sensitivity_section(data, t_burn=600.0, confidence=0.95, scale=1e6)
    tables = {table.name: table.frame for table in section.tables}
    row = tables["growth"].iloc[0]
    assert (row["n_growing"], row["n_shrinking"], row["n_open"], row["n_runaway"]) == (4, 2, 1, 1)
    assert row["runaways"] == "7"
    draws = tables["growth_rates"].query("size == 1e-10").set_index("matrix")["verdict"]
    assert draws[7] == "run away"
    assert "4 grow beyond their own error, 2 shrink, 1 do neither; 1 ran away" in " ".join(section.statements)


def test_displacements_below_the_errors_of_the_sigmoid_are_not_read(planted):
    members, series, separations = _planted(planted)
    kept = members["perturbation_size"] == 0
    members = members[kept].assign(**{**planted.sigmoid, "ratio": "one", "rtol": 1e-8})
    section = sensitivity_section(Data(members, series, {}, separations), t_burn=600.0, confidence=0.95)
    growth = section.tables[0].frame
    assert growth["is_above_error"].tolist() == [False, True]
    assert "displaced by 1e-06" in " ".join(section.statements)
    assert "displaced by 1e-10" not in " ".join(section.statements)


def test_integration_error_shows_in_the_amplification():
    t = np.linspace(0, 500, 251)
    growth = np.exp(0.02 * t)
    assert amplification_gap((t, 1e-10 * growth), (t, 1e-4 * growth), 1.0) == pytest.approx(0, abs=1e-9)
    error = 1e-9 * t / 500  # does not scale with the displacement
    assert amplification_gap((t, 1e-10 * growth + error), (t, 1e-4 * growth), 1.0) > 0.1


def test_horizon_and_its_median():
    edges = np.arange(5.0)
    assert horizon(np.array([0, 1, 3, 0.0]), edges, 2) == 2.0
    assert np.isinf(horizon(np.zeros(4), edges, 2))
    # order statistics 6 and 15 of 20: P(Binomial(20, 1/2) <= 5) = 0.0207, P(<= 6) = 0.058
    assert median_interval(np.arange(1, 21), 0.95) == (10.5, 6.0, 15.0)
    assert median_interval([1.0, 2.0, np.inf], 0.95) == (2.0, None, None)


def test_coverage_of_the_growth_rate():
    # 100 ensembles at 95%: 95 +- 6.6 points is three binomial errors
    assert abs(studies.growth_coverage(100, seed=1) - 0.95) < 0.066


def _planted(planted, rate=0.02):
    rng = np.random.default_rng(0)
    rows, series, separations = [], {}, {}
    t = np.linspace(0, 1000, 501)
    for matrix in range(8):
        base = f"m{matrix}"
        rows.append(planted.member(base, matrix))
        series[base] = planted.runs(rng, 800, 0.69)
        own = rate + 0.001 * rng.standard_normal()
        for size in (1e-10, 1e-6):
            rows.append(planted.member(f"{base}-t{size:g}", matrix, twin_size=size))
            series[rows[-1]["member_id"]] = series[base]
            separations[rows[-1]["member_id"]] = t, np.minimum(size * np.exp(own * t), 1.0)
        rows.append(planted.member(f"{base}-p", matrix, perturbation_size=0.01, perturbation_reading="relative"))
        times, values = series[base]  # follows the base up to t = 300, then parts from it for good
        changed = np.sort(np.append(times, 300.0))
        at = np.searchsorted(times, changed, side="right") - 1
        series[f"{base}-p"] = changed, values[at] + np.where(changed >= 300, 60, 0)
    return pd.DataFrame(rows), series, separations


def test_section_on_planted_pairs(planted):
    members, series, separations = _planted(planted)
    section = sensitivity_section(Data(members, series, {}, separations), t_burn=600.0, confidence=0.95)
    tables = {table.name: table.frame for table in section.tables}
    growth = tables["growth"]
    assert growth["low"][0] <= 0.02 <= growth["high"][0]
    assert growth["e_fold"][0] == pytest.approx(50, rel=0.05)
    of_constants = tables["horizons"].query("kind == 'constants'").iloc[0]
    assert of_constants["median"] == 300
    text = " ".join(section.statements)
    assert "integration error is not its cause" in text
    assert "the reverse of" in text
    for frame in tables.values():
        assert not any(
            isinstance(v, float) and np.isnan(v) for v in frame.to_numpy(dtype=object, na_value=None).ravel()
        )


def test_statements_change_with_the_numbers(planted):
    members, series, separations = _planted(planted, rate=-0.01)
    for matrix in range(8):  # the changed run leaves at once and comes back
        t, values = series[f"m{matrix}"]
        series[f"m{matrix}-p"] = t, np.where(t < 300, values + 30, values)
    section = sensitivity_section(Data(members, series, {}, separations), t_burn=600.0, confidence=0.95)
    text = " ".join(section.statements)
    assert "paths differ at short times and agree at long ones" in text
    assert "no growth rate" in text
    assert "the reverse of" not in text


def test_a_runaway_is_kept_apart(planted):
    members, series, separations = _planted(planted)
    members.loc[members["member_id"] == "m0-t1e-10", "outcome"] = "diverged"
    section = sensitivity_section(Data(members, series, {}, separations), t_burn=600.0, confidence=0.95)
    growth = section.tables[0].frame
    assert (growth["n_runaway"][0], growth["n_fitted"][0]) == (1, 7)
    assert "1 pair in which a run ran away or failed" in " ".join(section.statements)


def test_none_without_changed_members(planted):
    members, series = planted.ensemble({"coulomb": 0.69}, 3)
    assert sensitivity_section(Data(members, series), t_burn=100.0, confidence=0.95) is None


def test_pairs_of_every_kind(planted):
    uniform = {**planted.sigmoid, "ratio": "uniform"}
    rows = [
        planted.member("c0", 0), planted.member("c0-p", 0, perturbation_size=0.05),
        planted.member("c0-t", 0, twin_size=1e-6), planted.member("c0-pt", 0, twin_size=1e-6, perturbation_size=0.05),
        planted.member("s0", 0, **uniform, ratio_draw=0), planted.member("s1", 0, **uniform, ratio_draw=1),
        planted.member("s1-p", 0, **uniform, ratio_draw=1, perturbation_size=0.05),
        planted.member("d9", 9, perturbation_size=0.05),
    ]  # fmt: skip
    found = {
        (c.change.kind, p.base, p.changed): c.change
        for setting in settings(pd.DataFrame(rows))
        for c in setting.comparisons
        for p in c.pairs
    }
    assert set(found) == {
        (CONSTANTS, "c0", "c0-p"), (START, "c0", "c0-t"), (RATIOS, "s0", "s1"), (CONSTANTS, "s1", "s1-p"),
    }  # fmt: skip
    assert found[CONSTANTS, "c0", "c0-p"].reading == "scale"
    # with a member of equal ratios, that one is the base of every draw
    equal = planted.member("one", 0, **{**planted.sigmoid, "ratio": "one"})
    (sigmoid,) = [s for s in settings(pd.DataFrame([*rows, equal])) if s.key["engine"] == "sigmoid"]
    (ratios,) = [c for c in sigmoid.comparisons if c.change.kind == RATIOS]
    assert {(p.base, p.changed) for p in ratios.pairs} == {("one", "s0"), ("one", "s1")}
