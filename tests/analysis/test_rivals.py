"""Families recover what was planted, say what they run to, and rivals are told apart as often as they should be."""

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis.stats.estimates import Undefined
from stickslip.analysis.stats.families import (
    CUT_OFF,
    EXPONENTIAL,
    LOGNORMAL,
    NEGATIVE_BINOMIAL,
    POWER_LAW,
    RIVALS,
    STRETCHED,
    derivatives,
    log_shares,
    maximise,
    truncate,
)
from stickslip.analysis.stats.rivals import rivals
from tests.analysis import studies

SIZES = np.arange(1.0, 201.0)
PLANTED = [
    (EXPONENTIAL, (0.7,)),
    (POWER_LAW, (2.5,)),
    (CUT_OFF, (1.2, 0.1)),
    (CUT_OFF, (0.0, 0.7)),
    (STRETCHED, (0.2, -0.6)),
    (STRETCHED, (0.4, 0.3)),
    (NEGATIVE_BINOMIAL, (1.0, -0.7)),
    (NEGATIVE_BINOMIAL, (1.0, 1.0)),
    (LOGNORMAL, (0.0, 0.5)),
]


@pytest.mark.parametrize(("family", "theta"), PLANTED)
@pytest.mark.parametrize("k_min", [1, 3])
def test_planted_parameters_come_back_at_a_maximum_of_the_likelihood(family, theta, k_min):
    sizes = SIZES[k_min - 1 :]
    shares = np.exp(log_shares(family, sizes, theta))
    counts = np.random.default_rng(1).multinomial(20_000, shares).astype(float)
    fit = maximise(family, sizes, counts)
    assert fit.border == ""
    assert fit.log_likelihood >= np.dot(counts, log_shares(family, sizes, theta))
    score, information = derivatives(family, sizes, fit.theta, fit.free)
    error = np.sqrt(np.diag(np.linalg.inv(np.tensordot(counts, information, 1))))
    assert (np.abs(fit.theta - theta) < 4 * error).all()
    assert np.abs(counts @ score * error).max() < 1e-3  # a thousandth of an error from the top


def test_families_are_the_laws_that_scipy_knows():
    """Without truncation to speak of: k_max is far out in the tail."""
    k = SIZES.astype(int)
    known = [
        (EXPONENTIAL, (0.7,), stats.geom(1 - np.exp(-0.7)).pmf(k)),
        (NEGATIVE_BINOMIAL, (np.log(2.0), np.log(0.5)), stats.nbinom(0.5, 0.5 / 2.5).pmf(k - 1)),
        (POWER_LAW, (2.5,), stats.zipfian(2.5, 200).pmf(k)),
        (
            STRETCHED,
            (np.log(2.0), np.log(0.7)),
            np.diff(stats.weibull_min(0.7, scale=2.0).cdf(np.append(k - 1, 200))),
        ),
    ]
    for family, theta, shares in known:
        np.testing.assert_allclose(np.exp(log_shares(family, SIZES, theta)), shares, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("family", [CUT_OFF, STRETCHED, NEGATIVE_BINOMIAL])
@pytest.mark.parametrize("k_min", [1, 4])
def test_nested_rivals_hold_the_exponential(family, k_min):
    sizes = SIZES[k_min - 1 :]
    gamma = 0.7
    other = {"cut-off power law": gamma, "stretched exponential": -np.log(gamma),
             "negative binomial": -np.log(np.expm1(gamma))}[family.name]  # fmt: skip
    theta = (0.0, other) if family.null == 0 else (other, 0.0)
    np.testing.assert_allclose(
        log_shares(family, sizes, theta), log_shares(EXPONENTIAL, sizes, (gamma,)), rtol=1e-6, atol=1e-9
    )


def test_a_likelihood_that_runs_to_a_border_says_to_which():
    power = np.exp(log_shares(POWER_LAW, SIZES, (2.5,)))
    lifted = 1e4 * power * (1 + 0.02 * np.log(SIZES) ** 2)  # heavier than any power law
    for family in (CUT_OFF, LOGNORMAL):
        fit = maximise(family, SIZES, lifted)
        assert "power law" in fit.border
        assert fit.log_likelihood == pytest.approx(maximise(POWER_LAW, SIZES, lifted).log_likelihood, abs=1e-4)
    assert maximise(LOGNORMAL, SIZES, lifted).parameters == {}  # mu and sigma are infinite
    poisson = 1e4 * stats.poisson(1.0).pmf(SIZES - 1)
    assert "Poisson" in maximise(NEGATIVE_BINOMIAL, SIZES, poisson).border


def test_what_cannot_be_fitted_is_refused():
    with pytest.raises(Undefined, match="one size"):
        maximise(POWER_LAW, SIZES, 7.0 * (SIZES == 3))
    with pytest.raises(Undefined, match="no cascade"):
        maximise(POWER_LAW, SIZES, 0.0 * SIZES)
    with pytest.raises(ValueError, match="k_max: expected at least the largest size, 9"):
        truncate(np.bincount([1, 2, 9]), 1, 5)
    with pytest.raises(ValueError, match="k_min: expected 1 <= k_min"):
        truncate(np.bincount([1, 2, 9]), 0, 50)


def test_truncation_keeps_the_sizes_between_the_cut_offs():
    sizes, counts = truncate(np.array([[0, 5, 3, 2], [0, 1, 0, 4]]), 2, 6)
    assert sizes.tolist() == [2, 3, 4, 5, 6]
    assert counts.tolist() == [[3, 2, 0, 0, 0], [0, 4, 0, 0, 0]]


def test_a_law_that_is_planted_beats_the_exponential():
    sizes = studies.draw(np.random.default_rng(2), 20, lambda k: k**-0.8 * np.exp(-0.3 * k))
    found = {one.family.name: one for one in rivals(*studies.counted(sizes), 0.95)}
    best = found["cut-off power law"]
    assert best.verdict == "better"
    assert best.extra.low < 0.8 < best.extra.high
    assert best.gain == max(one.gain for one in found.values())
    assert found["power law"].verdict == "worse"


def test_tiny_differences_are_seen_as_tiny():
    """Half a million cascades show a power law's factor of k^-0.05; it is worth 1e-4 nats a cascade."""
    sizes = studies.draw(np.random.default_rng(2), 100, lambda k: k**-0.05 * np.exp(-0.68 * k), n_cascades=5000)
    found = rivals(*studies.counted(sizes), 0.95)[0]
    assert found.verdict == "better"
    assert 0 < found.gain < 1e-4


def test_the_extra_parameter_has_the_jackknife_of_refitting():
    sizes, counts = studies.counted(studies.dependent_sizes(np.random.default_rng(4), 12, spread=0.1))
    for family in (CUT_OFF, STRETCHED, NEGATIVE_BINOMIAL):
        found = rivals(sizes, counts, 0.95, [family])[0]
        left = [maximise(family, sizes, counts.sum(axis=0) - one).theta[family.null] for one in counts]
        error = np.sqrt(11 / 12 * np.sum((left - np.mean(left)) ** 2))
        assert found.extra.high - found.extra.value == pytest.approx(stats.t.ppf(0.975, 11) * error, rel=0.02)


def test_too_little_data_is_said():
    sizes, counts = studies.counted([[1, 2, 3, 1, 1, 2]])
    for one in rivals(sizes, counts, 0.95):
        assert one.verdict == "cannot be told"
        assert "one matrix" in one.reason or "border" in one.reason
    empty = rivals(*studies.counted([[1, 1], [1, 1]]), 0.95)
    assert {one.reason for one in empty} == {"one size only"}


def test_holm_is_applied_over_the_rivals():
    found = rivals(*studies.counted(studies.dependent_sizes(np.random.default_rng(8), 20)), 0.95)
    by_p = sorted(found, key=lambda one: one.p_value)
    running = 0.0
    for factor, one in zip(range(len(RIVALS), 0, -1), by_p, strict=True):
        running = max(running, min(1.0, factor * one.p_value))
        assert one.p_adjusted == pytest.approx(running)


@pytest.mark.long
def test_false_alarms_of_nested_rivals_with_dependent_sizes(rng):
    share = studies.rival_rejections(studies.TRUE["spread 0.03"], 20, 150, rng, families=[CUT_OFF])[0]
    assert share <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 150)


@pytest.mark.long
def test_false_alarms_of_vuong_halfway_between_two_laws(rng):
    share = studies.rival_rejections(studies.halfway(POWER_LAW), 20, 300, rng, families=[POWER_LAW])[0]
    assert abs(share - 0.05) <= 3 * np.sqrt(0.05 * 0.95 / 300)
