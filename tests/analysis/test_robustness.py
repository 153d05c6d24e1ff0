"""Planted changes of planted matrices: effects on single systems and on their mean."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import signal

from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Lack, Level, Outcomes, Reason, Share, Verdict
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.page.build import build
from stickslip.analysis.questions.runs.changes import answer
from stickslip.analysis.stats import components
from stickslip.analysis.stats.estimates import Estimate
from tests.analysis.designs import Data

pytestmark = pytest.mark.usefixtures("undrawn")

T_END = 1000.0
MATRICES = 40  # so many are told apart at the confidence of `strict`


def paths(rng, levels):
    """n_stick about a level each: a fast wander, on steps of one unit."""
    values = signal.lfilter([0.8], [1.0, -0.6], rng.standard_normal((len(levels), int(T_END))), axis=1)
    n_stick = np.clip(np.rint(np.asarray(levels)[:, None] + 3 * values), 0, 200).astype(np.int64)
    return [(np.arange(T_END), one) for one in n_stick]


def ensemble(rng, planted, change, spread=2.0, twins=(1e-3, 1e-2), g=MATRICES):
    """Matrices with levels of their own: base, replicates, and a copy at the level that `change` makes of it."""
    own = 100 + spread * rng.permutation(np.linspace(-1.7, 1.7, g))
    kinds = [({}, own), *(({"twin_size": size}, own) for size in twins)]
    kinds.append(({"perturbation_size": 0.1, "perturbation_reading": "scale"}, change(own)))
    rows, series = [], {}
    for extra, levels in kinds:
        for matrix, path in enumerate(paths(rng, levels)):
            name = "-".join([f"m{matrix}", *map(str, extra.values())])
            rows.append(planted.member(name, matrix, **({"twin_size": None} | extra)))
            series[name] = path
    return Data(pd.DataFrame(rows), series)


def to_and_fro(own):
    """Every second matrix up, the others down: far for a matrix, nothing for their mean."""
    return own + 8.0 * (-1.0) ** np.arange(len(own))


def asked(data, settings):
    """The answer, and its effects of a change on single systems, that on the mean number of sticking blocks first."""
    found = answer(Study(data, settings))
    return found, levels(found, "theta")


def levels(found, key):
    return [one for one in found.findings if isinstance(one, Level) and one.quantity.key == key]


def test_the_effect_on_single_systems_is_not_that_on_their_mean(rng, planted, strict):
    found, effects = asked(ensemble(rng, planted, lambda own: own), strict)
    assert isinstance(found.findings[0], Outcomes)
    assert (effects[0].estimate.value, effects[0].estimate.low) == (None, None)  # no share, but a limit
    assert 0.0 < effects[0].estimate.high < 0.25
    named = (
        "Mean square change of the mean number of sticking blocks of a system, relative to that between two systems"
    )
    assert sentence(effects[0]).startswith(f"{named}: at most ")
    assert "constants changed by up to" in str(effects[0].where)
    # the mean over matrices stays, which a comparison of ensembles would pass
    found, effects = asked(ensemble(rng, planted, to_and_fro), strict)
    assert effects[0].estimate.value > 1.0
    assert effects[0].estimate.low > 0.25
    changed = found.tables["changes"].set_index("quantity").loc["mean n_stick"]
    assert changed["relative"] == pytest.approx(0.0, abs=0.01)
    assert changed["verdict"] == Verdict.OPEN
    (within,) = asked(ensemble(rng, planted, lambda own: own), replace(strict, margins={"mean": 0.05}))[0].findings[
        :1
    ]
    assert within.equal == ("a change of all constants of 10%",)


def test_matrices_that_are_alike_tell_nothing(rng, planted, settings):
    _, effects = asked(ensemble(rng, planted, lambda own: own, spread=0.0), settings)
    assert all(one.estimate.high > 0.25 for one in effects if "sticking blocks" in one.quantity.name)


@pytest.mark.parametrize(
    ("theta", "said"),
    [
        (Estimate(0.2, -0.5, 1.44), None),
        (Estimate(0.2, -0.5, 0.36), Estimate(high=0.36)),
        (Estimate(1.3, 0.4, 2.2), Estimate(1.3, 0.4, 2.2)),
    ],
)
def test_a_limit_beyond_the_effect_of_another_system_is_none(rng, planted, settings, monkeypatch, theta, said):
    """Such an effect can be told neither from none nor from another system's."""
    against = components.Against(theta, 1.0, 1.0, 2.0)
    monkeypatch.setattr(components, "against_redraw", lambda *of_change: against)
    effects = asked(ensemble(rng, planted, lambda own: own), settings)[1]
    assert {effect.estimate for effect in effects} == ({said} if said else set())


def test_without_replicates_there_is_no_effect_on_single_systems(rng, planted, settings):
    found, effects = asked(ensemble(rng, planted, lambda own: own, twins=()), settings)
    assert not effects
    assert found.tables["changes"]["relative"].notna().all()
    # a start that has not parted from its base is no replicate
    close = ensemble(rng, planted, lambda own: own, twins=(1e-10,))
    close.series.update({f"m{m}-1e-10": close.series[f"m{m}"] for m in range(MATRICES)})
    assert not asked(close, settings)[1]


def test_runs_that_do_not_reach_the_end_leave_their_matrix_out(rng, planted, strict):
    data = ensemble(rng, planted, lambda own: own)
    members = data.members
    members.loc[members["member_id"].isin(["m3", "m5-0.01", "m7-0.1-scale"]), "outcome"] = "diverged"
    found, effects = asked(replace(data, table=members), strict)
    assert effects[0].basis.n == MATRICES - 3
    assert found.findings[0].largest.basis.n == MATRICES - 2, "another start of the system is no part of it"


def test_the_unchanged_systems_are_those_of_the_rest_of_the_page(rng, planted, settings):
    """Copies from other starts, 5 higher here, tell how far starts scatter, and are no part of the mean."""
    data = ensemble(rng, planted, lambda own: own)
    raised = {name: (t, n + 5 * ("-0.0" in name)) for name, (t, n) in data.series.items()}
    study = Study(replace(data, series=raised), settings)
    changed = answer(study).tables["changes"].set_index("quantity").loc["mean n_stick"]
    (unchanged,) = [group for group in study.groups if len(group) == MATRICES]
    assert changed["first"] == pytest.approx(unchanged.mean(settings.confidence).value)


def test_too_few_matrices_and_no_motion_have_their_reasons(rng, planted, settings):
    few = asked(ensemble(rng, planted, lambda own: own, g=3), settings)[0].findings
    assert few == [Lack("the effect of a changed system", Reason.FEW_UNITS)]
    data = ensemble(rng, planted, lambda own: own)
    outcomes = ["collapsed" if matrix < 3 else "failed" for matrix in data.members["matrix"]]
    none = asked(replace(data, table=data.members.assign(outcome=outcomes)), settings)[0].findings
    assert none == [Lack("the effect of a changed system", Reason.NO_MOTION)]
    assert answer(Study(Data(*planted.ensemble({"coulomb": 0.69}, 3)), settings)) is None


def test_of_runs_that_ended_it_says_how_copies_end(rng, planted, settings):
    """Last events shift by one unit; every fourth copy keeps on, another has no certificate."""
    rows, series = [], {}
    own = rng.permutation(np.arange(100.0, 100.0 + 10 * MATRICES, 10))
    for matrix, last in enumerate(own):
        for name, size, t in ((f"m{matrix}", 0.0, last), (f"m{matrix}-p", 0.01, last + 1 - 2 * (matrix % 2))):
            outcome = "finished" if size and matrix % 4 < 2 else "collapsed"
            rows.append(planted.member(name, matrix, perturbation_size=size, outcome=outcome, twin_size=None))
            series[name] = np.array([0.0, T_END - 10 if size and matrix % 4 == 0 else t]), np.array([5, 0])
    found, _ = asked(Data(pd.DataFrame(rows), series), settings)
    otherwise, shift = found.findings[:2]
    assert isinstance(otherwise, Share)
    assert (otherwise.estimate.value, otherwise.basis.n) == (0.25, MATRICES)
    assert otherwise.estimate.low > 0.1
    assert shift.quantity.name == "median absolute shift of the last event"
    assert (shift.estimate.value, shift.estimate.low, shift.estimate.high) == pytest.approx((1, 1, 1))


def test_a_shift_is_that_of_half_of_the_runs_not_of_means_over_copies(planted, settings):
    """Of three copies of each system one shifts by seven units, the others by one."""
    rows, series, names = [], {}, ("", "-a", "-b", "-c")
    for matrix in range(MATRICES):
        for draw, (name, later) in enumerate(zip(names, (0.0, 1.0, 1.0, 7.0), strict=True)):
            terms = {"perturbation_size": 0.01 * bool(name), "perturbation_draw": draw, "twin_size": None}
            rows.append(planted.member(f"m{matrix}{name}", matrix, outcome="collapsed", **terms))
            series[f"m{matrix}{name}"] = np.array([0.0, 200.0 + later]), np.array([5, 0])
    found, _ = asked(Data(pd.DataFrame(rows), series), settings)
    (shift,) = levels(found, "shift")
    assert (shift.estimate.value, shift.estimate.low, shift.basis.n) == pytest.approx((1, 1, MATRICES))


@pytest.mark.drawn
def test_the_page_says_it(rng, planted, settings):
    data = ensemble(rng, planted, to_and_fro)
    report = build(data, replace(settings, question=("changes",)), "T", "", {})
    assert "What changes, and by how much?" in report.html
    assert "robustness" in report.figures


def test_a_shift_without_an_interval_has_a_page(rng, planted, settings):
    """Few matrices about zero: Fieller's interval does not exist."""
    for g in (3, 4, 5):
        data = ensemble(rng, planted, lambda own: own + rng.normal(0, 30, len(own)), spread=30.0, g=g)
        report = build(data, replace(settings, question=("changes",)), "T", "", {})
        said = "What changes, and by how much?" if g > 3 else "The effect of a changed system"
        assert said in report.html
