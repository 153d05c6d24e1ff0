"""Slow common motion: closed forms against integrals; what was planted comes back, and nothing else."""

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest

from stickslip.analysis.findings.alerts import Code
from stickslip.analysis.findings.finding import Change, Fit, Lack, Law, Level, Reason, Scale, Verdict
from stickslip.analysis.findings.numbers import limit
from stickslip.analysis.findings.place import EVERYWHERE
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.models import common_motion
from stickslip.analysis.models.common_motion import LEAST_HARMONICS, Shown
from stickslip.analysis.questions.slips import collective
from stickslip.analysis.questions.slips.slow_motion import CYCLES, Slow, slow_motion
from stickslip.analysis.series.nulls import BlockSteps
from stickslip.analysis.stats.estimates import Estimate
from stickslip.pipeline.design.units import Units
from stickslip.workflows.scenes import rhythm as scene
from tests.analysis import studies
from tests.analysis.test_clustering import study_of
from tests.chance import ERRORS, agrees

SPAN = 2400.0


def motion_of(data, rng):
    return common_motion.common_motion(data, 0.95, rng)


def integral(frequency, span, period, quality):
    """4 int (1 - t / span) R(t) cos(2 pi f t) dt by quadrature, R from the real form of the underdamped solution."""
    w0 = 2 * np.pi / period
    g = w0 / (2 * quality)
    w = np.sqrt(complex(w0**2 - g**2))
    t = np.linspace(0, span, 400_001)
    r = (np.exp(-g * t) * (np.cos(w * t) + g / w * np.sin(w * t))).real
    return [4 * np.trapezoid((1 - t / span) * r * np.cos(2 * np.pi * f * t), t) for f in frequency]


@pytest.mark.parametrize("quality", [0.3, 0.501, 1.2, 6.0])
def test_the_expected_periodogram_is_its_integral(quality):
    frequency = np.array([0, 1, 5, 20]) / SPAN
    found = common_motion.expected(frequency, SPAN, 470.0, quality)
    assert found == pytest.approx(integral(frequency, SPAN, 470.0, quality), rel=1e-5)
    columns = common_motion.expected(frequency, SPAN, np.array([[300.0], [470.0]]), np.array([[2.0], [quality]]))
    assert columns[1] == pytest.approx(found)


def test_critical_damping_is_no_exception():
    near = [common_motion.expected(np.arange(1, 9) / SPAN, SPAN, 470.0, q) for q in (0.4999, 0.5, 0.5001)]
    assert near[1] == pytest.approx((near[0] + near[2]) / 2, rel=1e-5)


@pytest.mark.parametrize("quality", [0.3, 1.2, 6.0])
def test_the_spectrum_has_variance_one_and_is_what_long_windows_show(quality):

    def spectrum(frequency):
        """As the module's first lines have it."""
        w, w0 = 2 * np.pi * frequency, 2 * np.pi / 470.0
        g = w0 / (2 * quality)
        return 8 * g * w0**2 / ((w0**2 - w**2) ** 2 + 4 * g**2 * w**2)

    frequency = np.arange(200_000) * 1e-6
    assert np.trapezoid(spectrum(frequency), frequency) == pytest.approx(1, rel=1e-3)
    some = np.array([1.0, 2.0, 4.0]) * 1e-3
    assert common_motion.expected(some, 1e8, 470.0, quality) == pytest.approx(spectrum(some), rel=1e-4)


def test_the_periodogram_is_that_of_the_path(rng):
    steps = studies.blocks_run(rng, n=5)
    t, level = np.concatenate(([0.0], steps.t, [steps.span])), np.concatenate(([0], np.cumsum(steps.step)))
    for k in (1, 2, 7):
        w = 2 * np.pi * k / steps.span
        pieces = (np.exp(-1j * w * t[1:]) - np.exp(-1j * w * t[:-1])) / (-1j * w)
        power = 2 * abs(level @ pieces) ** 2 / steps.span
        assert common_motion.periodogram(steps, k)[0, -1] == pytest.approx(power, rel=1e-9)
    alone = BlockSteps(0.0, steps.span, steps.t, np.zeros_like(steps.block), steps.step)
    observed, own = common_motion.periodogram(alone, 9)
    assert own == pytest.approx(observed)


def test_blocks_turned_in_time_have_the_power_of_the_blocks_added_up(rng):
    steps, m, draws = studies.blocks_run(rng, n=12), 6, 400
    order = np.argsort(steps.block, kind="stable")
    place = np.empty_like(order)
    place[order] = np.concatenate([np.arange(k) for k in np.bincount(steps.block)])
    whole = place < np.bincount(steps.block)[steps.block] // 2 * 2  # each block ends as it began: no seam
    steps = dataclasses.replace(steps, t=steps.t[whole], block=steps.block[whole], step=steps.step[whole])
    own, drawn = common_motion.periodogram(steps, m)[1], np.empty((draws, m))
    for row in drawn:
        t = (steps.t + rng.uniform(0, steps.span, 12)[steps.block]) % steps.span
        order = np.argsort(t)
        row[:] = common_motion.periodogram(
            dataclasses.replace(steps, t=t[order], block=steps.block[order], step=steps.step[order]), m
        )[0]
    assert (np.abs(drawn.mean(axis=0) - own) < ERRORS * drawn.std(axis=0) / np.sqrt(draws)).all()


def exact(span, period, quality, g=20, m=22):
    """The expectation itself, the same of every matrix."""
    frequency, own = np.arange(1, m + 1) / span, np.full((g, m), 220.0)
    observed = 11.0 * common_motion.expected(frequency, span, period, quality) + 100.0
    return common_motion.Spectra(span, np.tile(observed, (g, 1)), own, np.full(g, 30.0), np.ones(g))


@pytest.mark.parametrize(("period", "quality"), [(470.0, 1.2), (700.0, 0.8), (300.0, 4.0), (400.0, 0.4)])
@pytest.mark.parametrize("span", [1400.0, 2400.0, 8400.0])
def test_the_fit_finds_what_there_is_whatever_the_length_of_the_window(period, quality, span):
    data = exact(span, period, quality, m=common_motion.n_harmonics(span, 108.0))
    found = np.exp(common_motion.best(span, data.observed[0], data.independent[0]))
    assert found == pytest.approx([11.0, period, quality, 100 / 220], rel=2e-3)


def test_numbers_of_a_known_oscillator(rng):
    found = motion_of(exact(SPAN, 470.0, 1.2), rng)
    assert found.shown is Shown.SLOW
    assert found.goodness.deviance == pytest.approx(0.0, abs=1e-3)
    assert found.goodness.dof == 22 - 4
    value = {name: estimate.value for name, estimate in found.estimates.items()}
    assert (value["period"], value["quality"]) == pytest.approx((470.0, 1.2), rel=1e-3)
    at_mean = integral([0.0], SPAN, 470.0, 1.2)[0] / (2 * SPAN)  # variance of the mean of a window
    assert value["share"] == pytest.approx(11 / (30 + 11 * at_mean), rel=1e-3)


def test_an_interval_of_three_matrices_is_that_of_t_with_two_degrees_of_freedom(rng):
    """On the log scale; sqrt(2 / 3 sum of squares) is the jackknife's error."""
    data = exact(SPAN, 470.0, 1.2, g=3)
    data = dataclasses.replace(data, observed=data.observed * np.array([[0.9], [1.0], [1.15]]))
    found = motion_of(data, rng)
    logs = np.log(found.values["variance"])
    half = 4.302652729696142 * np.sqrt(2 / 3 * np.sum((logs[1:] - logs[1:].mean()) ** 2))
    ends = found.estimates["variance"].low, found.estimates["variance"].high
    assert np.log(ends) == pytest.approx([logs[0] - half, logs[0] + half], rel=1e-9)


def test_overdamped_motion_is_slow_and_a_motion_slower_than_the_window_is_said_to_be(rng):
    overdamped = motion_of(exact(SPAN, 470.0, 0.45), rng)
    assert overdamped.shown is Shown.SLOW
    slow = motion_of(exact(SPAN, 1800.0, 2.0), rng)
    assert (slow.shown, slow.period) == (Shown.SHORT, pytest.approx(1800.0, rel=0.01))


def test_the_deviance_is_that_of_chance_if_the_fit_is_the_spectrum_and_large_if_it_is_not(rng):
    """Its mean is that of chi-squared; beside a line that no damped oscillator has, it is beyond."""
    fits = [motion_of(one, rng).goodness for one in studies.rhythmic(rng, 40, SPAN, 470.0, 1.2)]
    assert agrees(sum(fit.p_value < 0.05 for fit in fits), 40, 0.01, 0.1)
    deviance = np.array([fit.deviance for fit in fits])
    assert abs(deviance.mean() - fits[0].dof) < 1.5 + ERRORS * np.sqrt(2 * fits[0].dof / 40)
    for one in studies.rhythmic(rng, 3, SPAN, 470.0, 1.2):
        observed = one.observed.copy()
        observed[:, 12] += 4 * observed[:, 5]
        assert motion_of(dataclasses.replace(one, observed=observed), rng).goodness.p_value < 1e-4


def test_blocks_without_a_common_motion_are_told_so(rng):
    p = np.array(
        [common_motion.p_value(one, rng) for one in studies.rhythmic(rng, 40, SPAN, 470.0, 1.2, variance=0.0)]
    )
    assert agrees(int(np.sum(p <= 0.05)), 40, 0.05)


def test_several_runs_of_a_matrix_are_no_more_surrogates_than_they_are(rng):
    """The mean of four runs scatters half as much, under the null too."""
    runs = [rng.standard_exponential((20, 4, 22)).mean(axis=1) * 220.0 for _ in range(60)]
    data = [common_motion.Spectra(SPAN, one, np.full((20, 22), 220.0), np.ones(20), np.full(20, 4.0)) for one in runs]
    assert agrees(sum(common_motion.p_value(one, rng) <= 0.05 for one in data), 60, 0.05)


# ------------------------------------------------------------------------------------------------ the question


def point(keys, period, rng, error=0.03):
    """A group whose periods without one matrix each have an error of that size."""
    off = error / np.sqrt(19) * rng.standard_normal(20)
    logs = np.log(period) + np.concatenate(([error * rng.standard_normal()], off))
    values = {name: np.exp(logs) for name in scene.NUMBERS}
    estimates = {name: Estimate(float(np.exp(logs[0]))) for name in scene.NUMBERS}
    found = common_motion.CommonMotion(Shown.SLOW, 0.001, estimates=estimates, values=values)
    keys = {"n": 200, "kappa": 0.2, "rho": 3.5, "belt_speed": -0.2, "engine": "coulomb"} | keys
    label = f"n = {keys['n']}, {keys['engine']}, belt_speed = {keys['belt_speed']:g}"
    return Slow(SimpleNamespace(key=keys, label=label), list(range(20)), None, 36.0, found)


def without(slow, n):
    """The group without the first n of its matrices."""
    values = {name: np.delete(logs, np.s_[1 : n + 1]) for name, logs in slow.fit.values.items()}
    return dataclasses.replace(slow, units=slow.units[n:], motion=dataclasses.replace(slow.fit, values=values))


def test_changes_are_those_planted(rng):
    periods = {(150, -0.1): 440, (175, -0.1): 400, (200, -0.1): 360, (150, -0.2): 500, (175, -0.2): 504,
               (200, -0.2): 508}  # fmt: skip
    points = [point({"n": n, "belt_speed": v}, period, rng, 0.005) for (n, v), period in periods.items()]
    lines = [line for key in scene.KEYS for line in scene.along(key, points)]
    assert [(line.key, str(line.at), len(line.groups)) for line in lines] == [
        ("n", "belt_speed = -0.1", 3), ("n", "belt_speed = -0.2", 3),
        ("belt_speed", "n = 150", 2), ("belt_speed", "n = 175", 2), ("belt_speed", "n = 200", 2),
    ]  # fmt: skip
    changes = scene.changes(lines, "system", 0.95)
    along_speed, along_n = (change for change in changes if change.quantity.key == "period")
    size = (360 / 440 * 508 / 500) ** 0.5 - 1  # an average of logarithms over the settings of the other key
    assert along_n.difference.estimate.value == pytest.approx(size, abs=0.02)
    assert along_n.difference.verdict is Verdict.LESS
    assert along_n.keys[0].first == "150"
    assert (str(along_n.where), str(along_speed.where)) == (
        "averaged over belt_speed = -0.1 and -0.2", "averaged over n = 150, 175 and 200",
    )  # fmt: skip
    assert (along_n.before.value, along_n.after.value) == pytest.approx(
        [(a * b) ** 0.5 for a, b in ((440, 500), (360, 508))], rel=0.02
    )
    (_, of_share) = (change for change in changes if change.quantity.key == "share")
    assert of_share.difference.scale is Scale.ABSOLUTE  # percentage points
    assert of_share.difference.estimate.value == pytest.approx((360 - 440 + 508 - 500) / 2, abs=20)
    assert along_n.difference.family.n == len(scene.NUMBERS) * 2
    # each is of the systems that give both of its ends
    *groups, last = lines[0].groups
    fewer = lines[0]._replace(groups=[*groups, without(last, 9)])
    assert [change.basis.n for change in scene.changes([fewer, lines[1]], "system", 0.95)] == 3 * [11]
    # lines with other ends are no part of the average
    shorter = lines[1]._replace(groups=lines[1].groups[1:])
    of_each = scene.changes([lines[0], shorter], "system", 0.95)[:2]
    assert [str(change.where) for change in of_each] == ["belt_speed = -0.1", "belt_speed = -0.2"]


def test_intervals_of_averaged_changes_hold_what_is_planted(rng):
    held = 0
    for _ in range(200):
        points = [
            point({"n": n, "belt_speed": v}, 450 * (n / 150) ** -0.6, rng) for n in (150, 200) for v in (-0.1, -0.2)
        ]
        (change, *_) = scene.changes(scene.along("n", points), "system", 0.95)
        estimate = change.difference.estimate
        held += estimate.low <= (200 / 150) ** -0.6 - 1 <= estimate.high
    assert agrees(held, 200, 0.95)


def test_a_common_mode_of_blocks_is_said_with_its_share_and_the_goodness_of_its_fit(planted, rng):
    study = study_of(planted, [studies.blocks_run(rng, depth=0.6, period=80.0) for _ in range(12)])
    found = collective.answer(study)
    law = found.findings[0]
    assert re.match(
        r"Blocks move together slowly(, but not as a damped oscillator \(\S+% of the variance.*\): period of the fit"
        r" [\d.]+|(, in a broad peak)? \([\d.]+% of the variance of the number sticking\): Q = [\d.]+, natural period"
        r" [\d.]+ \([\d.]+ to [\d.]+\))\.",
        sentence(law),
    )
    assert law.scope.quantity.name.startswith("share of the variance of the number of sticking blocks")
    assert found.n_lead == 1
    motion = slow_motion(study, study.groups[0])
    levels = [law.parameter, law.departure, *(finding for finding in found.findings if isinstance(finding, Level))]
    value_of = {level.quantity.key: level.estimate.value for level in levels}
    assert law.scope.estimate.value == motion.fit.estimates["share"].value
    for name in ("quality", "period"):
        assert value_of[name] == motion.fit.estimates[name].value
    assert value_of["deviance"] == motion.goodness.deviance
    assert [alert.code for alert in found.alerts] == ([Code.MISFIT] if motion.goodness.p_value < 0.05 else [])
    assert f"{motion.goodness.dof} degrees of freedom, p-value " in str(law.departure.where)
    assert found.figures["collective"].recipe().axes
    (alone,) = scene.question(study).findings
    assert alone.reason is Reason.ONE_VALUE


def test_the_settings_that_the_fit_misses_are_named_whichever_leads(planted, rng, monkeypatch):
    """Of three p-values, 0.39, 0.037 and 0.003, all together have 0.002, and the first two 0.07."""
    deviances = {-0.2: 40.0, -0.15: 55.0, -0.1: 66.6}

    def planted_misfit(study, group):
        motion = slow_motion(study, group)
        goodness = common_motion.Goodness(deviances[group.key["belt_speed"]], 38)
        return dataclasses.replace(motion, motion=dataclasses.replace(motion.fit, goodness=goodness))

    monkeypatch.setattr("stickslip.analysis.questions.slips.slow_motion.slow_motion", planted_misfit)
    runs = [studies.blocks_run(rng, depth=0.6, period=80.0) for _ in range(8)]
    study = study_of(planted, runs, settings=[{"belt_speed": speed} for speed in deviances])
    keys = {change.keys[0] for change in scene.question(study).findings if isinstance(change, Change)}
    assert {(key.first, key.second) for key in keys} == {("-0.2", "-0.15")}, "the third is not compared"
    found = collective.answer(study)
    laws = {str(law.parameter.where): law for law in found.findings if isinstance(law, Law)}
    assert {where: law.fit for where, law in laws.items()} == {
        "belt_speed = -0.2": Fit.HOLDS, "belt_speed = -0.15": Fit.HOLDS, "belt_speed = -0.1": Fit.CLOSE,
    }  # fmt: skip
    assert [law.departure.estimate.value for law in laws.values()] == [*deviances.values()]
    fits, missed = laws["belt_speed = -0.2"], laws["belt_speed = -0.1"]
    assert "but not as a damped oscillator" in sentence(missed)
    assert (missed.parameter.estimate.low, missed.scope.estimate.high) == (None, None), "of no law that holds"
    assert re.search(r"slowly(, in a broad peak)? .*: Q = [\d.]+, natural period [\d.]+ \(", sentence(fits))
    (legend,) = found.figures["collective"].recipe().legends
    assert [": Q = " in text.get_text() for text in legend.get_texts()] == [True, True, False]
    (alert,) = found.alerts
    assert str(alert).startswith(
        "A damped oscillator misses the slow spectrum at belt_speed = -0.1 (p-value 0.0023 of 3 settings together)"
    )


def test_windows_that_are_too_short_are_said_to_be(planted, rng):
    study = study_of(planted, [studies.blocks_run(rng) for _ in range(8)], t_burn=studies.SPAN - 120.0)
    motion = slow_motion(study, study.groups[0])
    assert (motion.motion, motion.shown) == (None, Shown.SHORT)
    if study.judged():
        lacks = [one for one in collective.answer(study).findings if isinstance(one, Lack)]
        assert [lack.reason for lack in lacks] == [Reason.SHORT_WINDOW]
        assert f"{limit(motion.needed(study.settings.t_burn))}" in lacks[0].detail


def test_the_time_that_may_suffice_is_more_than_there_was(settings):
    """Ten harmonics of ten cycles end at 10.33: runs to t = 10 have been."""
    short = Slow(None, [0, 1], None, cycle=9.6 / LEAST_HARMONICS / CYCLES, motion=None)
    for units, until in ((Units(), "11"), (Units("s", "m", "kg"), "11 s")):
        lack = collective._lacking(short, EVERYWHERE, dataclasses.replace(settings, t_burn=0.73, units=units))
        assert lack.detail == f"runs to t = {until} may suffice"
