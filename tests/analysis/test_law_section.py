"""The section's words follow the data: rejected, not rejected, undecided, not enough data."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
from stickslip.analysis.questions.law_section import EVENTS, judge, law_section
from stickslip.analysis.report.tables import records

from stickslip.analysis import groups
from stickslip.analysis.stats.cascades import Law
from stickslip.analysis.stats.goodness import Goodness


def filled(members, series, settings):
    found = groups.groups(members)
    for group in found:
        groups.fill(group, series, settings)
    return found


@pytest.fixture
def exponential(planted, settings):
    return filled(*planted.ensemble({"coulomb": 0.7}, 20, seed=1), settings)


def mixed(planted, settings, n_matrices=20):
    """Runs whose falls are of rate 0.4 or 1.6, at random."""
    rows, series = [], {}
    for matrix in range(n_matrices):
        rng = np.random.default_rng([7, matrix])
        lengths = rng.geometric(1 - np.exp(-rng.choice([0.4, 1.6], 1600)))
        steps = np.repeat((-1) ** np.arange(1600), lengths)
        t = np.concatenate(([0.0], np.sort(rng.uniform(0, planted.t_end, len(steps)))))
        rows.append(planted.member(f"m{matrix}", matrix))
        series[f"m{matrix}"] = t, 1000 + np.concatenate(([0], np.cumsum(steps)))
    return filled(pd.DataFrame(rows), series, settings)


def test_an_exponential_is_not_rejected_and_the_words_say_how_much_is_left_open(exponential):
    section = law_section(exponential)
    fit = records(section.tables[0].frame)[0]
    assert (fit["definition"], fit["verdict"], fit["n_matrices"]) == ("events", "not rejected", 20)
    assert fit["gamma_low"] < 0.7 < fit["gamma_high"]
    assert "the exponential is not rejected (p = " in section.statements[0]
    assert "is excluded" in section.statements[0]
    assert "no rival" in section.statements[1].lower()
    assert "better than the power law by" in section.statements[1]
    assert "no estimate of gamma" in section.statements[2]
    assert len(section.pictures) == 1


def test_groups_whose_fit_can_be_tested_are_spoken_of_first(planted, settings):
    members, series = planted.ensemble({"coulomb": 0.7, "sigmoid": 0.7}, 8)
    kept = members[(members["engine"] == "sigmoid") | (members["matrix"] < 2)]  # two matrices are too few to test
    section = law_section(filled(kept, series, settings))
    assert [line.split(":")[0] for line in section.statements] == sorted(
        (line.split(":")[0] for line in section.statements), reverse=True
    )
    assert "is not rejected" in section.statements[0]
    assert section.tables[0].frame["group"][0] == "n = 200, coulomb"  # tables keep the order of groups


def test_a_mixture_is_rejected_and_the_better_rival_named(planted, settings):
    section = law_section(mixed(planted, settings))
    assert "the exponential is rejected (p = < 0.001" not in section.statements[0]
    assert "the exponential is rejected (p < 0.001, 20 matrices)" in section.statements[0]
    assert "the sizes better, the" in section.statements[1]
    rows = records(section.tables[1].frame)
    best = max(rows, key=lambda row: row["gain"])
    assert best["verdict"] == "better"
    assert abs(best["tail"] - best["tail_observed"]) < abs(best["tail_exponential"] - best["tail_observed"])


def test_a_test_that_hangs_on_the_cut_of_the_tail_is_undecided(exponential, monkeypatch):
    found = Goodness(0.004, 2, 0.009, 0.055, 0.036, 0.055, 20)
    assert found.verdict(0.05) == "undecided"
    assert found.verdict(0.06) == "rejected"
    assert found.verdict(0.03) == "not rejected"
    monkeypatch.setattr("stickslip.analysis.questions.law_section.goodness", lambda *_: found)
    section = law_section(exponential)
    assert "depends on where the tail is cut (p = 0.036 to 0.055, 20 matrices)" in section.statements[0]
    assert "1 undecided" in section.assumptions[1]


def test_few_matrices_no_matrix_and_no_cascade_are_said(planted, settings):
    few = law_section(filled(*planted.ensemble({"coulomb": 0.7}, 4), settings))
    assert "cannot be told: 4 matrices, where a test at this level needs 6" in few.statements[0]
    still = {"q": (np.array([0.0]), np.array([3]))}
    none = law_section(filled(pd.DataFrame([planted.member("q", 0)]), still, settings))
    assert none.statements == ("n = 200, coulomb: Event by event, not enough data: no matrix has data.",)
    assert none.pictures == ()
    lost = planted.member("d", 0, outcome="diverged")
    assert "not enough data" in law_section(filled(pd.DataFrame([lost]), {}, settings)).statements[0]


def test_tables_have_null_and_never_nan(planted, settings):
    for found in (mixed(planted, settings, 1), mixed(planted, settings, 3)):
        for table in law_section(found).tables:
            for row in records(table.frame):
                assert not any(isinstance(value, float) and not np.isfinite(value) for value in row.values())
                for column in table.columns:
                    assert "nan" not in column.text(row)


def test_every_definition_has_its_row(planted, settings):
    members, series = planted.ensemble({"coulomb": 0.7}, 6)
    section = law_section(filled(members, series, settings))
    frame = section.tables[0].frame
    assert len(set(frame["group"])) == 1
    assert set(frame["dt"].dropna()) == set(settings.dt)
    assert frame["definition"].iloc[0] == "events"
    assert len(section.tables[1].frame) == 5
    assert len(section.tables[2].frame) == 5 * (len(frame) - 1)


def test_the_lower_cut_off_leaves_small_cascades_out(exponential):
    section = law_section(exponential, k_min=3)
    fit = records(section.tables[0].frame)[0]
    histograms = exponential[0].by_law[EVENTS].histograms
    assert fit["k_min"] == 3
    assert fit["n_cascades"] == sum(int(one[3:].sum()) for one in histograms)
    assert fit["gamma_low"] < 0.7 < fit["gamma_high"]  # an exponential keeps its rate above any cut-off
    assert "sizes from 3" in section.statements[0]


def test_the_section_is_the_same_twice_and_in_any_order_of_groups(planted, settings):
    found = filled(*planted.ensemble({"coulomb": 0.7, "sigmoid": 0.6}, 8), settings)
    one, two = law_section(found), law_section(found[::-1])
    assert set(one.statements) == set(two.statements)
    first = judge(found[0], Law("events"), confidence=0.95, k_min=1, seed=0).goodness
    assert first == judge(found[0], Law("events"), confidence=0.95, k_min=1, seed=0).goodness
    other = judge(found[0], Law("events"), confidence=0.95, k_min=1, seed=1).goodness
    assert dataclasses.replace(first, p_value=None, p_least=None, p_most=None, bound=None) == dataclasses.replace(
        other, p_value=None, p_least=None, p_most=None, bound=None
    )


def test_a_cut_off_out_of_range_is_refused(exponential):
    with pytest.raises(ValueError, match="k_min: expected 1 <= k_min < k_max = 200, got 0"):
        law_section(exponential, k_min=0)


def test_parts_are_consecutive_and_add_up_to_the_sums(exponential):
    for data in exponential[0].by_law.values():
        for parts, sums in zip(data.parts, data.sums, strict=True):
            assert len(parts) == groups.PARTS
            np.testing.assert_array_equal(parts.sum(axis=0), sums[:2])
