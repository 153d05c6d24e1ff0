"""Whether t_burn is long enough: planted transients are found, and steady series at the nominal rate."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import Study, members
from stickslip.analysis.burn_in import UNSEEN, estimates, geweke
from stickslip.analysis.ensemble import Recorded
from stickslip.analysis.models.motion import early_and_late
from stickslip.analysis.questions.runs import fates
from stickslip.analysis.series.windows import Stack, windows
from tests.analysis.designs import Data
from tests.chance import SURE, agrees

N, T_END, T_BURN, DECAY = 200, 1000.0, 100.0, 80.0


def series(rng, excess):
    """n_stick of one system about its own level, plus what is left of a transient, shape (1000,), t = 0 to 999."""
    noise = np.repeat(rng.normal(scale=6.0, size=50), 20)  # it remembers 20 units of time
    level = 60 + rng.normal(scale=5.0) + excess * np.exp(-np.arange(T_END) / DECAY)
    return np.arange(T_END), np.clip(np.rint(level + noise + rng.normal(size=1000)), 0, N).astype(int)


def ensembles(planted, rng, excesses, n_systems=20):
    """A group for each excess, told by kappa = 0.1, 0.2, ..."""
    rows, runs = [], {}
    for group, excess in enumerate(excesses, start=1):
        for k in range(n_systems):
            name = f"k{group}-m{k}"
            rows.append(planted.member(name, k, n=N, t_end=T_END, t_stop=T_END, kappa=0.1 * group))
            runs[name] = series(rng, excess)
    return Data(pd.DataFrame(rows), runs)


def ensemble(planted, rng, excess, n_systems=20):
    return ensembles(planted, rng, [excess], n_systems)


@pytest.fixture
def settings(settings):
    return replace(settings, t_burn=T_BURN)


def of_groups(data, settings):
    study = Study(data, settings)
    return geweke(study, study.groups)


def test_early_is_the_first_tenth_and_late_the_last_half():
    """One more block sticks at each unit of time."""
    ramp = windows(Stack.of([(np.arange(100.0), np.arange(100))]), 0.0, [100.0])
    assert early_and_late(ramp, np.array([np.nan])).tolist() == [[4.5, 74.5]]


def test_the_period_of_a_force_is_worked_out_once_a_setting(planted, settings, rng, monkeypatch):
    asked = []
    monkeypatch.setattr(members, "force_period", lambda setting: asked.append(setting) or np.nan)
    study = Study(ensembles(planted, rng, [0.0, 0.0], 4), settings)
    assert [len(study.ended(np.arange(4))), len(study.ended(np.arange(4, 8)))] == [4, 4]
    assert len(asked) == 2


def test_under_a_force_both_are_whole_periods(rng):
    """Of 100 a tenth is 10: the first period of 12, 10 or 50, and the last four, five or one."""
    t = np.arange(100.0)
    ramps = windows(Stack.of([(t, np.arange(100))] * 4), 0.0, [100.0] * 4)
    whole = [[5.5, 75.5], [4.5, 74.5], [24.5, 74.5], [4.5, 74.5]]  # two periods of 51 it has not
    assert early_and_late(ramps, np.array([12.0, 10.0, 50.0, 51.0])) == pytest.approx(np.array(whole))
    times = np.sort(np.append(0.0, rng.uniform(0.0, 100.0, 300)))
    level = rng.integers(0, 50, 301)
    (means,) = windows(Stack.of([(times, level)]), 7.0, [93.0]).means_of_ends(np.array([11.3]), np.array([31.9]))
    ends = [windows(Stack.of([(times, level)]), *ends).mean[0] for ends in ((7.0, [18.3]), (61.1, [93.0]))]
    assert means == pytest.approx(ends)


def forced(planted, settings, frequency, shown):
    """Of 20 systems, which stick for the first half of each of 14.3 periods."""
    period, t_end = 2.0 * np.pi / frequency, T_BURN + 14.3 * 2.0 * np.pi / frequency
    t = np.append(0.0, T_BURN + period / 2.0 * np.arange(29))
    rows = [planted.member(f"m{k}", k, n=N, t_end=t_end, t_stop=t_end, **shown) for k in range(20)]
    runs = {f"m{k}": (t, np.append(0, np.tile([20 + k % 3, k % 2], 15)[:29])) for k in range(20)}
    (row,) = of_groups(Data(pd.DataFrame(rows), runs), settings)
    return row


def test_a_settled_response_to_a_harmonic_force_has_no_transient(planted, settings):
    """The first tenth of the window is 1.43 periods of the force, and sticks for more than half of its time."""
    row = forced(planted, settings, 0.15, {"force_amplitude": 25.0, "force_frequency": 0.15})
    assert not row.is_short
    assert abs(row.early.value) < 1e-9
    assert forced(planted, settings, 0.15, {}).is_short, "of no force the program knows no period"


def test_steady_series_are_called_too_short_at_the_nominal_rate(planted, settings, rng):
    found = of_groups(ensembles(planted, rng, [0.0] * 200), settings)
    assert agrees(sum(row.p_value < 0.05 for row in found), 200, 0.05)


def test_a_transient_that_no_digit_of_the_mean_shows_is_none(planted, settings, rng):
    """One more block sticks for one or two units of time in all systems, whose levels are four apart."""
    rows = [planted.member(f"m{k}", k, n=N, t_end=T_END, t_stop=T_END) for k in range(20)]
    t = np.arange(T_END)
    more = [(t > T_BURN) & (t < T_BURN + 3.0 + 2.0 * (k % 2)) for k in range(20)]
    flips = [np.where((t % 2 == 0) | more[k], 90 - 4 * k, 89 - 4 * k) for k in range(20)]
    (row,) = of_groups(Data(pd.DataFrame(rows), {f"m{k}": (t, flips[k]) for k in range(20)}), settings)
    assert 0.0 < row.early.value < 0.05
    assert row.p_adjusted < 1e-6
    assert (row.is_short, row.reason) == (False, UNSEEN)


def test_a_transient_is_found_and_its_size(planted, strict, rng):
    """100 exp(-t / 80) from t = 100 on: 100 * 80 / 90 (exp(-100 / 80) - exp(-190 / 80)) in the first tenth."""
    (row,) = of_groups(ensemble(planted, rng, 100.0), strict)
    planted_early = 100.0 * DECAY / 90.0 * (np.exp(-100 / DECAY) - np.exp(-190 / DECAY))
    assert row.is_short
    assert row.early.low < planted_early < row.early.high
    late = replace(strict, t_burn=600.0)
    assert not of_groups(ensemble(planted, rng, 100.0), late)[0].is_short


def test_several_groups_are_tested_together(planted, strict, rng):
    """Holm's rule: of nine steady groups and one with a transient, that alone."""
    data = ensembles(planted, rng, [100.0 * (k == 3) for k in range(10)])
    found = of_groups(data, strict)
    assert [row.is_short for row in found] == [k == 3 for k in range(10)]
    assert all(row.p_adjusted >= row.p_value for row in found)


def test_estimates_for_other_values_of_t_burn(planted, strict, rng):
    data = ensemble(planted, rng, 100.0)
    study = Study(data, strict)
    rows = {row.t_burn: row for row in estimates(study, study.groups[0])}
    assert [*rows] == [0.0, 50.0, 100.0, 212.5, 325.0, 550.0]
    for t_burn, row in rows.items():
        by_hand = []
        for t, n_stick in data.series.values():
            lasts = np.diff(np.append(t, T_END)) - np.clip(t_burn - t, 0.0, 1.0)
            by_hand.append(np.average(n_stick, weights=np.where(t + 1.0 > t_burn, lasts, 0.0)))
        assert row.value.value == pytest.approx(np.mean(by_hand))
        assert row.is_chosen == (t_burn == T_BURN)
    (group,) = study.groups
    assert rows[T_BURN].value.value == pytest.approx(group.mean(SURE).value)
    assert rows[T_BURN].p_value < 1 - SURE < rows[550.0].p_value


def test_what_is_averaged_is_tested(planted, strict, rng):
    """Four in five runs stop at t = 200, quiet: no mean of n_stick has them, but one of a number of each run does."""
    data = ensemble(planted, rng, 0.0)
    ended = {}
    for k, (name, (t, n_stick)) in enumerate(data.series.items()):
        ended[name] = (t[:201], np.append(n_stick[:200], 0)) if k % 5 else (t, n_stick)
    alone = Data(data.members, ended)
    (row,) = of_groups(alone, strict)
    assert (row.n_runs, row.n_members, row.n_systems, row.is_short) == (4, 20, 4, False)
    numbers = {"heat": Recorded("heat", dict.fromkeys(ended, 1.0))}
    study = Study(Data(data.members, ended, recorded=numbers), strict)
    (row,) = geweke(study, study.groups)
    assert (row.n_runs, row.n_members, row.n_systems, row.is_short) == (20, 20, 20, True)
    mean = [row for row in estimates(study, study.groups[0]) if row.is_chosen]
    assert [row.n_systems for row in mean] == [20]
    assert fates.answer(study).tables["burn_in"]["n_runs"].tolist() == [20]


def test_copies_of_runs_are_no_systems(planted, settings, rng):
    """Two starts of each system that are alike; what drifts is n_stick, also where episodes are counted."""
    once = ensemble(planted, rng, 0.0, n_systems=6)
    copies = [planted.member(f"{m}-{k}", m, n=N, start_draw=k, kappa=0.1) for m in range(6) for k in (0, 1)]
    names = [row["member_id"] for row in copies]
    start = np.arange(50.0, T_END, 200.0)
    episodes = pd.DataFrame({"member_id": np.repeat(names, len(start)), "start": np.tile(start, len(names))})
    runs = [run for run in once.series.values() for _ in (0, 1)]
    twice = Data(pd.DataFrame(copies), dict(zip(names, runs, strict=True)), episodes=episodes)
    study = Study(twice, settings)
    (alone,), (row,) = of_groups(once, settings), geweke(study, study.groups)
    assert (row.n_systems, row.early, row.p_value) == (6, pytest.approx(alone.early), pytest.approx(alone.p_value))
    rows = {row.t_burn: row for row in estimates(study, study.groups[0])}
    assert {row.n_systems for row in rows.values()} == {6}
    assert rows[T_BURN].p_value == pytest.approx(alone.p_value)
    assert rows[T_BURN].value.value == pytest.approx(study.groups[0].mean(0.95).value)


def at_rest(planted, rng, data):
    """The same runs, and nine groups of twenty that never move, each run at a level of its own; all are averaged."""
    rows, series = data.members.to_dict("records"), dict(data.series)
    for group in range(9):
        for k in range(20):
            name = f"rest{group}-m{k}"
            rows.append(planted.member(name, k, n=N, t_end=T_END, t_stop=T_END, kappa=2.0 + group))
            series[name] = (np.zeros(1), rng.integers(0, N, size=1, endpoint=True))
    return Data(pd.DataFrame(rows), series, recorded={"heat": Recorded("heat", dict.fromkeys(series, 1.0))})


def test_groups_at_rest_are_not_tested_and_dilute_nothing(planted, settings, rng):
    """Their first tenth is their last half; if they were tested, the p-value of what moves would be tenfold."""
    for t_burn in rng.uniform(50.0, 300.0, size=20):  # sums of rounded times
        data = at_rest(planted, rng, ensemble(planted, rng, 30.0))
        moves, *rests = of_groups(data, replace(settings, t_burn=float(t_burn)))
        assert moves.p_adjusted == moves.p_value > 0.0
        assert [(row.p_value, row.early.value, row.is_short, row.reason) for row in rests] == 9 * [
            (None, 0.0, False, "at rest")
        ]


def test_runs_that_come_to_rest_later_show_nothing_from_then_on(planted, settings, rng):
    """100 exp(-t / 80) rounds to 0 from t = 424 on: an early tenth from 325 on has it, one from 550 on has not."""
    rows, series = [], {}
    left = np.rint(100.0 * np.exp(-np.arange(T_END) / DECAY)).astype(int)
    for k, level in enumerate(rng.integers(0, 100, size=20)):
        rows.append(planted.member(f"m{k}", k, n=N, t_end=T_END, t_stop=T_END))
        series[f"m{k}"] = (np.arange(T_END), level + left)
    recorded = {"heat": Recorded("heat", dict.fromkeys(series, 1.0))}
    study = Study(Data(pd.DataFrame(rows), series, recorded=recorded), settings)
    by_t_burn = estimates(study, study.groups[0])
    assert {row.t_burn for row in by_t_burn if row.p_value is None} == {550.0}
    (row,) = geweke(study, study.groups)
    assert row.is_short


def test_an_alert_says_that_t_burn_is_too_short(planted, settings, rng):
    found = fates.answer(Study(ensemble(planted, rng, 100.0), settings))
    assert dict(found.alerts[0].numbers) == {
        "what": "The number of sticking blocks",
        "where": " (n = 200, exact)",
        "t_burn": 100.0,
    }
    assert "by_t_burn" in found.figures
    assert found.tables["burn_in"]["is_short"].tolist() == [True]


def test_three_systems_tell_nothing(planted, settings, rng):
    (row,) = of_groups(ensemble(planted, rng, 100.0, n_systems=3), settings)
    assert (row.is_short, row.p_value, row.reason) == (False, None, "few matrices")
