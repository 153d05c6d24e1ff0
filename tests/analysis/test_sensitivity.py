"""Pairs of runs that part at a planted rate, and when they have parted."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Lack, Level, Lifetime, Reason, Share, levels
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.models.growth import growth
from stickslip.analysis.pairs import CONSTANTS, RATIOS, START, level
from stickslip.analysis.pairs import settings as sorted_settings
from stickslip.analysis.questions.runs.sensitivity import HALF, answer
from stickslip.analysis.series import parting
from tests.analysis.designs import Data

T_END = 1000.0


def test_mean_gap_against_the_integral_by_hand():
    # |difference| is 2 on [0, 1), 1 on [1, 1.5), 3 on [1.5, 3): windows of one unit have means 2, (0.5 + 1.5), 3
    first = np.array([0.0, 1.0]), np.array([5, 4])
    second = np.array([0.0, 1.5]), np.array([3, 1])
    assert parting.mean_gap(first, second, np.arange(4.0)) == pytest.approx([2.0, 2.0, 3.0])
    assert parting.mean_gap(second, first, np.arange(4.0)) == pytest.approx([2.0, 2.0, 3.0])


def test_the_level_is_the_mean_over_all_pairs(rng):
    values = rng.integers(0, 50, 7)
    bases = [(np.zeros(1), np.array([value])) for value in values]
    pairs = [abs(a - b) for i, a in enumerate(values) for b in values[:i]]
    assert parting.level(parting.counts(bases, [5.0] * 7, 50, 1.0, 5.0)) == pytest.approx(np.mean(pairs))
    # the last run is known to t = 3 alone: half of the time its pairs count, then those of the others
    others = [abs(a - b) for i, a in enumerate(values[:6]) for b in values[:i]]
    expected = 0.5 * np.mean(pairs) + 0.5 * np.mean(others)
    assert parting.level(parting.counts(bases, [5.0] * 6 + [3.0], 50, 1.0, 5.0)) == pytest.approx(expected)
    assert parting.level(parting.counts(bases[:1], [5.0], 50, 1.0, 5.0)) == 0


def test_the_level_is_of_all_matrices_however_they_end(rng, planted, settings):
    """A certificate changes no path; where most runs settle, two matrices show no lasting difference."""
    data = ensemble(rng, planted, 0.01)
    (setting,) = sorted_settings(data.table)
    known = level(Study(data, settings), setting)
    for n_certified in (4, 8):
        some = data.members["member_id"].isin([f"m{k}" for k in range(n_certified)])
        outcomes = data.members["outcome"].where(~some, "collapsed")
        study = Study(Data(data.members.assign(outcome=outcomes), data.series, {}, data.separations), settings)
        assert level(study, setting) == (known if n_certified == 4 else None)


def test_what_was_not_measured_is_not_said_to_be_unknown(rng, planted, settings):
    data = ensemble(rng, planted, 0.01, t_part=2 * T_END)
    copies = data.members["twin_size"].notna()
    changed = data.members.assign(twin_size=None, perturbation_size=np.where(copies, 0.01, 0.0))
    parted, rate = answer(Study(Data(changed, data.series), settings)).findings
    assert (parted.estimate.value, rate.reason) == (1.0, Reason.NOT_RUN)
    assert sentence(parted) == (
        f"All 12 copies (lower bound 76%) do not differ {HALF} up to t = 1000."
        " Setting: n = 200, exact, with all constants changed by up to 1%."
    )
    settled = answer(Study(Data(changed.assign(outcome="collapsed"), data.series), settings)).findings
    assert [finding.reason for finding in settled] == [Reason.NOT_RUN, Reason.NO_REFERENCE]
    unrecorded = answer(Study(replace(data, separations={}), settings)).findings
    assert [type(finding) for finding in unrecorded] == [Share, Lack]
    assert unrecorded[1].reason is Reason.NOT_RECORDED


def test_a_run_has_parted_when_the_mean_of_the_last_span_reaches_half_of_the_level():
    base = np.zeros(1), np.array([10])
    moved = np.array([0.0, 50.0]), np.array([10, 14])  # apart by 4 from t = 50 on
    gaps = parting.gap(base, moved, 100.0)
    assert parting.parted_at(gaps, 4.0) == 60.0  # ten of the last twenty units
    assert parting.parted_at(gaps, 8.0) == 70.0
    assert parting.parted_at(gaps, 8.1) is None
    assert len(parting.gap(base, moved, 10.0)) == 0


def ensemble(rng, planted, rate, g=12, size=1e-6, t_part=400.0, **settings):
    """Matrices with one displaced start: distances exp(rate t), and a path that is the base's until t_part."""
    rows, series, separations = [], {}, {}
    times = np.arange(0.0, T_END + 1, 5.0)
    for matrix in range(g):
        own = rng.integers(0, 60, 2 * int(T_END))
        for name, extra in ((f"m{matrix}", {"twin_size": None}), (f"m{matrix}-t", {"twin_size": size})):
            rows.append(planted.member(name, matrix, **settings, **extra))
        t = np.arange(0.0, T_END, 0.5)
        series[f"m{matrix}"] = t, own
        series[f"m{matrix}-t"] = t, np.where(t < t_part, own, rng.integers(0, 60, len(own)))
        noise = np.cumsum(0.01 * rng.standard_normal(len(times)))
        separations[f"m{matrix}-t"] = times, size * np.exp(rate * times + noise)
    return Data(pd.DataFrame(rows), series, {}, separations)


@pytest.mark.parametrize(("rate", "verdict"), [(0.01, "grow"), (-0.0128, "shrink")])
def test_rates_have_their_sign(rng, planted, strict, rate, verdict):
    found = answer(Study(ensemble(rng, planted, rate), strict))
    lead, parted = found.findings
    assert lead.quantity.name == f"time in which initial differences of 1e-6 {verdict} e-fold"
    assert sentence(lead).startswith(f"At n = 200, exact, initial differences of 1e-6 {verdict} e-fold every ")
    assert lead.estimate.low < 1 / abs(rate) < lead.estimate.high
    assert isinstance(parted, Lifetime)
    assert list(found.figures) == ["growth"]
    assert "up to a distance of 0.03" in found.figures["growth"].caption
    (legend,) = found.figures["growth"].recipe().legends
    assert [text.get_text() for text in legend.get_texts()] == ["n = 200, exact, initial distance 1e-6"]


def test_a_rate_that_may_be_zero_is_a_rate(rng, planted, settings):
    lead = answer(Study(ensemble(rng, planted, 0.0), settings)).findings[0]
    assert isinstance(lead, Level)
    assert lead.quantity.key in ("rate", "e_fold")
    assert (lead.quantity.key == "rate") == (lead.estimate.low <= 0.0 <= lead.estimate.high)


def test_runs_too_short_for_a_rate_have_none():
    """All of them end before the range in which rates are taken."""
    times = np.arange(10.0)
    found = growth(times, [1e-6 * np.exp(0.1 * times)] * 3, [0, 1, 2], 100.0, 100.0, (1e-9, 1e-2), 0.95)
    assert (found.rate.value, found.rate.reason) == (None, "no pair in range")


def test_displacements_below_the_errors_of_a_smoothed_law_tell_nothing(rng, planted, settings):
    smoothed = {**planted.sigmoid, "ratio": "one"}
    found = answer(Study(ensemble(rng, planted, 0.001, size=1e-8, **smoothed), settings))
    (lack,) = [finding for finding in found.findings if isinstance(finding, Lack)]
    assert (lack.reason, lack.detail) == (Reason.OUT_OF_RANGE, "0 of 12")


def test_pairs_that_are_a_selection_tell_nothing(rng, planted, settings):
    data = ensemble(rng, planted, 0.01)
    for matrix in range(4):
        times, distance = data.separations[f"m{matrix}-t"]
        data.separations[f"m{matrix}-t"] = times[:30], distance[:30]
    lack = answer(Study(data, settings)).findings[-1]
    assert (lack.reason, lack.detail) == (Reason.OUT_OF_RANGE, "8 of 12")


def test_when_copies_part(rng, planted, settings):
    _, parted = answer(Study(ensemble(rng, planted, 0.01), settings)).findings
    assert isinstance(parted, Lifetime)
    assert parted.estimate.value == pytest.approx(410, abs=10)
    _, parted = answer(Study(ensemble(rng, planted, 0.01, t_part=2 * T_END), settings)).findings
    (row,) = levels(parted)
    assert (row.quantity.name, row.basis.n) == (f"share of copies that do not differ {HALF} up to t = 1000", 12)
    assert (row.estimate.value, row.estimate.low, row.estimate.high) == pytest.approx((1.0, 0.757, 1.0), abs=1e-3)


def test_runs_that_ran_away_are_watched_until_then(rng, planted, settings):
    data = ensemble(rng, planted, 0.01)
    away = data.members["member_id"].isin([f"m{k}-t" for k in range(4)])
    members = data.members
    members.loc[away, ["outcome", "t_stop"]] = ["diverged", 300.0]
    parted = answer(Study(replace(data, table=members), settings)).findings[1]
    # until then they count among those at risk
    assert isinstance(parted, Lifetime)
    assert parted.basis.n == 12
    assert "4 of 12 grew without limit first" in str(parted.where)
    apart = ensemble(rng, planted, 0.01, t_part=2 * T_END)
    members = apart.members
    members.loc[away, ["outcome", "t_stop"]] = ["diverged", 300.0]
    parted = answer(Study(replace(apart, table=members), settings)).findings[1]
    assert sentence(parted).startswith(f"67% (39 to 86%) of copies do not differ {HALF} up to t = 1000")
    members.loc[members["twin_size"].notna(), ["outcome", "t_stop"]] = ["diverged", 300.0]
    assert answer(Study(replace(apart, table=members), settings)).findings[-1].reason is Reason.NO_REFERENCE


def test_nothing_to_compare(planted, settings):
    assert answer(Study(Data(*planted.ensemble({"coulomb": 0.69}, 3)), settings)) is None


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
        (c.change.kind, rows[p.base]["member_id"], rows[p.changed]["member_id"]): c.change
        for setting in sorted_settings(Data(pd.DataFrame(rows), {}).table)
        for c in setting.comparisons
        for p in c.pairs
    }
    assert set(found) == {
        (CONSTANTS, "c0", "c0-p"), (START, "c0", "c0-t"), (RATIOS, "s0", "s1"), (CONSTANTS, "s1", "s1-p"),
    }  # fmt: skip
    assert found[CONSTANTS, "c0", "c0-p"].reading == "scale"
    # with a member of equal ratios, that one is the base of every draw
    equal = planted.member("one", 0, **{**planted.sigmoid, "ratio": "one"})
    rows += [equal]
    members = Data(pd.DataFrame(rows), {}).table
    (sigmoid,) = [s for s in sorted_settings(members) if s.key["engine"] == "sigmoid"]
    (ratios,) = [c for c in sigmoid.comparisons if c.change.kind == RATIOS]
    found = {(rows[p.base]["member_id"], rows[p.changed]["member_id"]) for p in ratios.pairs}
    assert found == {("one", "s0"), ("one", "s1")}
