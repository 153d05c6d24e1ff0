"""Laws of sizes: planted parameters come back at the maximum of the likelihood, with the jackknife of refitting."""

import numpy as np
import pytest
from scipy import stats

from stickslip.analysis.stats.estimates import Undefined
from stickslip.analysis.stats.families import CUT_OFF, EXPONENTIAL, POWER_LAW, log_shares, maximise, parameter
from tests.analysis import studies

SIZES = np.arange(1.0, 201.0)
PLANTED = [
    (EXPONENTIAL, (0.7,)),
    (EXPONENTIAL, (0.02,)),
    (POWER_LAW, (2.5,)),
    (CUT_OFF, (1.2, 0.1)),
    (CUT_OFF, (0.0, 0.7)),
    (CUT_OFF, (-0.5, 1.0)),
]


@pytest.mark.parametrize(("family", "theta"), PLANTED)
@pytest.mark.parametrize("k_min", [1, 3])
def test_planted_parameters_come_back_at_a_maximum_of_the_likelihood(family, theta, k_min):
    sizes = SIZES[k_min - 1 :]
    shares = np.exp(log_shares(family, sizes, theta))
    counts = np.random.default_rng(1).multinomial(20_000, shares).astype(float)
    fit = maximise(family, sizes, counts)
    assert fit.free == list(range(len(theta)))
    assert fit.log_likelihood == pytest.approx(np.dot(counts, np.log(fit.shares())))
    assert fit.log_likelihood >= np.dot(counts, log_shares(family, sizes, theta))
    error = np.sqrt(np.diag(np.linalg.inv(counts.sum() * fit.information())))
    assert (np.abs(fit.theta - theta) < 4 * error).all()
    assert np.abs(counts @ fit.scores() * error).max() < 1e-6  # of an error from the top


@pytest.mark.parametrize(("family", "theta"), PLANTED)
def test_scores_and_information_are_the_derivatives_of_the_likelihood(family, theta):
    counts = np.random.default_rng(1).multinomial(20_000, np.exp(log_shares(family, SIZES, theta)))
    fit = maximise(family, SIZES, counts.astype(float))
    steps = 1e-5 * np.eye(len(theta))
    up, down = ([log_shares(family, SIZES, fit.theta + sign * step) for step in steps] for sign in (1, -1))
    np.testing.assert_allclose(fit.scores().T, (np.array(up) - down) / 2e-5, atol=1e-4)
    curved = (np.array(up) - 2 * np.log(fit.shares()) + down) / 1e-10  # the same for every size
    np.testing.assert_allclose(np.diag(fit.information()), -curved[:, 0], rtol=1e-2)


def test_families_are_the_laws_that_scipy_knows():
    """Without truncation to speak of: k_max is far out in the tail."""
    k = SIZES.astype(int)
    for family, theta, shares in (
        (EXPONENTIAL, (0.7,), stats.geom(1 - np.exp(-0.7)).pmf(k)),
        (POWER_LAW, (2.5,), stats.zipfian(2.5, 200).pmf(k)),
    ):
        np.testing.assert_allclose(np.exp(log_shares(family, SIZES, theta)), shares, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("k_min", [1, 4])
def test_the_cut_off_power_law_holds_the_others(k_min):
    sizes = SIZES[k_min - 1 :]
    for family, theta, within in ((EXPONENTIAL, (0.7,), (0.0, 0.7)), (POWER_LAW, (2.5,), (2.5, 0.0))):
        np.testing.assert_allclose(log_shares(CUT_OFF, sizes, within), log_shares(family, sizes, theta), rtol=1e-12)


def test_a_tail_heavier_than_any_power_law_has_no_cut_off():
    lifted = 1e4 * np.exp(log_shares(POWER_LAW, SIZES, (2.5,))) * (1 + 0.02 * np.log(SIZES) ** 2)
    fit, power = maximise(CUT_OFF, SIZES, lifted), maximise(POWER_LAW, SIZES, lifted)
    assert (fit.theta[1], fit.free) == (0.0, [0])
    assert fit.theta[0] == pytest.approx(power.theta[0])
    assert fit.log_likelihood == pytest.approx(power.log_likelihood)
    assert parameter(fit, 1, np.array([lifted, lifted]), 0.95).low is None
    assert parameter(fit, 0, np.array([lifted, lifted]), 0.95).low is not None


def test_what_cannot_be_fitted_is_refused():
    with pytest.raises(Undefined, match="one size"):
        maximise(POWER_LAW, SIZES, 7.0 * (SIZES == 3))
    with pytest.raises(Undefined, match="two sizes"):
        maximise(CUT_OFF, SIZES, 7.0 * (SIZES <= 2))
    with pytest.raises(Undefined, match="no cascade"):
        maximise(POWER_LAW, SIZES, 0.0 * SIZES)


@pytest.mark.parametrize("which", [0, 1])
def test_a_parameter_has_the_jackknife_of_refitting(which):
    sizes, counts = studies.counted(studies.dependent_sizes(np.random.default_rng(4), 12, spread=0.1))
    found = parameter(maximise(CUT_OFF, sizes, counts.sum(axis=0)), which, counts, 0.95)
    left = [maximise(CUT_OFF, sizes, counts.sum(axis=0) - one).theta[which] for one in counts]
    error = np.sqrt(11 / 12 * np.sum((left - np.mean(left)) ** 2))
    assert found.high - found.value == pytest.approx(stats.t.ppf(0.975, 11) * error, rel=0.02)
    assert parameter(maximise(CUT_OFF, sizes, counts[0]), which, counts[:1], 0.95).reason == "one matrix"
