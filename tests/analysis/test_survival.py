"""Fates and survival: textbook numbers, identities, and what is never called a collapse."""

import numpy as np
import pandas as pd
import pytest
from stickslip.analysis.questions.survival_section import TITLE, fates, survival_section
from stickslip.analysis.report.section import Data, Section

from stickslip.analysis.report.page import _leading
from stickslip.analysis.stats.fates import COLLAPSED, DIVERGED, ENDS, SILENT, SUSTAINED, fate, median, survival


def test_survival_against_the_textbook():
    # Freireich et al. 1963, the 6-MP arm, as tabulated in Kalbfleisch and Prentice
    ended = [6, 6, 6, 7, 10, 13, 16, 22, 23]
    censored = [6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
    curve = survival(ended + censored, [COLLAPSED] * 9 + [SUSTAINED] * 12, 0.95)
    assert curve.t.tolist() == [0, 6, 7, 10, 13, 16, 22, 23]
    assert curve.survival == pytest.approx([1, 0.857, 0.807, 0.753, 0.690, 0.627, 0.538, 0.448], abs=5e-4)
    # Greenwood's error of S(23) is 0.135 (ibid.); on the log-log scale 0.188 to 0.680
    assert (curve.low[-1], curve.high[-1]) == pytest.approx((0.188, 0.680), abs=1e-3)
    assert median(curve) == 23


def test_incidences_and_survival_add_up_to_one():
    rng = np.random.default_rng(0)
    times = rng.integers(1, 30, 60).astype(float)
    ends = rng.choice([*ENDS, SUSTAINED], 60)
    curve = survival(times, ends, 0.95)
    assert sum(curve.incidence.values()) + curve.survival == pytest.approx(np.ones(len(curve.t)))


def test_incidence_without_censoring_is_the_share():
    curve = survival([1, 2, 3, 4, 9, 9], [COLLAPSED, DIVERGED, COLLAPSED, SILENT, SUSTAINED, SUSTAINED], 0.95)
    assert [curve.incidence[end][-1] for end in ENDS] == pytest.approx([2 / 6, 1 / 6, 1 / 6])


def test_none_or_all_ended_have_an_interval():
    for end, share in ((SUSTAINED, 1.0), (COLLAPSED, 0.0)):
        curve = survival(np.full(20, 5.0), [end] * 20, 0.95)
        assert curve.survival[-1] == share
        assert curve.high[-1] - curve.low[-1] == pytest.approx(0.161, abs=1e-3)  # Wilson's of 0 in 20
    with pytest.raises(ValueError, match="non-empty"):
        survival([], [], 0.95)


def test_fates_by_their_last_change():
    silent, sticking = (np.array([0.0, 700.0]), np.array([3, 0])), (np.array([0.0, 700.0]), np.array([3, 1]))
    assert fate("finished", silent, 1000.0) == SILENT
    assert fate("finished", silent, 900.0) == SUSTAINED  # quiet for less than a quarter
    assert fate("finished", sticking, 1000.0) == SUSTAINED
    assert fate("collapsed", silent, 1000.0) == COLLAPSED
    assert fate("diverged", silent, 1000.0) == DIVERGED
    assert fate("failed", None, 1000.0) == "failed"


def _data(planted, outcomes):
    rows, series = [], {}
    for matrix, outcome in enumerate(outcomes):
        stop = 400.0 if outcome == "diverged" else 1000.0
        real = "finished" if outcome in (SILENT, SUSTAINED) else outcome
        rows.append(planted.member(f"m{matrix}", matrix, outcome=real, t_stop=stop, growth_rate=0.01))
        last = {SUSTAINED: 990.0, DIVERGED: 390.0}.get(outcome, 50.0 + matrix)
        series[f"m{matrix}"] = np.array([0.0, last]), np.array([3, 0])
    return Data(pd.DataFrame(rows), series)


def test_section_keeps_the_fates_apart(planted):
    data = _data(planted, [COLLAPSED] * 4 + [SILENT] * 2 + [DIVERGED] * 3 + [SUSTAINED] * 11)
    assert sorted(fates(data).values()).count(SILENT) == 2
    section = survival_section(data, confidence=0.95)
    row = section.tables[0].frame.iloc[0]
    assert [row[f"n_{end}"] for end in ENDS] == [4, 2, 3]
    assert row["sustained"] == pytest.approx(11 / 20)
    assert row["collapsed"] == pytest.approx(4 / 20)  # neither silence nor a runaway counts
    assert (row["first_end"], row["last_end"]) == (50.0, 400.0)
    assert row["n_unstable"] == 20
    (text,) = section.statements
    said, linear = section.lead
    assert (
        "4 stopped sticking for good (certified), 2 went silent without a certificate, 3 ran away, 11 stayed" in said
    )
    assert linear.startswith("The state in which all blocks slip: of the 20 draws in which it is unstable, 4 stop")
    assert "4 collapsed (certified), 2 went silent without a certificate, 3 ran away" in text


def test_statements_change_with_the_numbers(planted):
    (text,) = survival_section(_data(planted, [SUSTAINED] * 20), confidence=0.95).statements
    assert "all stayed in motion" in text
    assert "collapsed" not in text
    assert (
        survival_section(_data(planted, [SUSTAINED] * 20), confidence=0.95)
        .lead[0]
        .startswith("To t = 1000 all 20 runs stayed in motion; nothing is said of later times")
    )


def test_linear_growth_is_set_beside_the_fate(planted):
    data = _data(planted, [COLLAPSED] * 4 + [SILENT] + [SUSTAINED] * 5)
    data.members.loc[:3, "growth_rate"] = -0.01
    section = survival_section(data, confidence=0.95)
    assert section.lead[1] == (
        "The linear growth of the state in which all blocks slip goes with the fate: of the 4 draws in which it is "
        "stable, 4 stopped sticking for good (certified); of the 6 draws in which it is unstable, 1 went silent "
        "without a certificate, 5 stayed in motion."
    )
    table = {one.name: one.frame for one in section.tables}["fates"]
    assert table["fate"].tolist() == [COLLAPSED] * 4 + [SILENT] + [SUSTAINED] * 5


def test_fates_lead_a_report_whose_runs_mostly_ended(planted):
    parted = Section("Changes", "?", (), (), "", of_changes=True)
    for outcomes, expected in (
        ([COLLAPSED] * 6 + [SUSTAINED] * 4, [TITLE, "Changes"]),
        ([COLLAPSED] * 4 + [SUSTAINED] * 6, ["Changes"]),
    ):
        data = _data(planted, outcomes)
        answered = [parted, survival_section(data, confidence=0.95)]
        assert [section.title for section in _leading(answered, data)] == expected
