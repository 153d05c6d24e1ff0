"""Episodes: planted rates, exponents and regularities are found; methods are told apart within systems."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis import Data, Study, build
from stickslip.analysis import catalogue as as_catalogue
from stickslip.analysis.questions import engines, episodes, sweep
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.episodes import (
    FITTED,
    OCCUPANCY,
    QUANTITIES,
    RATE,
    RECURRENCE,
    Catalogue,
    completeness,
    in_classes,
    laws_of_moments,
)
from stickslip.analysis.stats.estimates import over_matrices
from stickslip.analysis.stats.families import maximise, parameter
from tests.chance import SURE, agrees

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture
def settings(settings):
    return replace(settings, t_burn=200.0)


@pytest.fixture
def strict(settings):
    """At 0.95 the true law is rejected of one planted ensemble in twenty."""
    return replace(settings, confidence=SURE)


def power_law(b, cut_off=None):
    """Moments from 1 on: a Pareto law with exponent b; beyond a cut-off thinned by exp(-m / cut_off)."""

    def draw(rng, m):
        kept = np.zeros(0)
        while len(kept) < m:
            found = rng.uniform(size=m) ** (-1 / b)
            kept = np.append(
                kept, found if cut_off is None else found[rng.uniform(size=m) < np.exp(-found / cut_off)]
            )
        return kept[:m]

    return draw


def catalogue(rng, rate, moments, t_stop=1000.0):
    start = np.cumsum(rng.exponential(1 / rate, int(2 * rate * t_stop + 50)))
    start = start[start < t_stop]
    moment = moments(rng, len(start))
    size = np.ones(len(start), int)
    return Catalogue(0.0, t_stop, start, np.full(len(start), 0.05), size, moment, t_stop, size)


@pytest.fixture
def planted_episodes(planted, rng):
    """Runs of some systems under some engines: `moments` draws, `gaps` draws the times between, of mean one."""

    def make(engines, n_matrices=12, rate=0.5, moments=None, gaps=None, n_steps=200):
        rows, series, table = [], {}, []
        for matrix in range(n_matrices):
            of_system = np.exp(0.1 * rng.normal())
            for name, (key, factor) in engines.items():
                member = f"m{matrix}-{name}"
                rows.append(planted.member(member, matrix, **key))
                series[member] = planted.runs(rng, n_steps, 0.7)
                apart = (gaps or rng.exponential)(size=int(2 * rate * planted.t_end + 50))
                start = np.cumsum(apart) / (rate * factor * of_system)
                start = start[start < planted.t_end - 0.1]
                moment = (moments or power_law(1.0))(rng, len(start))
                size = np.minimum(1 + moment.astype(int), 200)
                first = rng.integers(20, size=len(start))
                table.append(pd.DataFrame({"member_id": member, "start": start, "end": start + 0.05, "size": size,
                                           "moment": moment, "first_block": first}))  # fmt: skip
        return Data(pd.DataFrame(rows), series, episodes=pd.concat(table, ignore_index=True))

    return make


EXACT = {"exact": ({}, 1.0)}


def test_a_data_set_without_episodes_is_not_asked(planted, settings):
    rows, series = planted.ensemble({"coulomb": 0.7}, 4)
    assert episodes.answer(Study(Data(rows, series), settings)) is None


def test_rate_and_exponent_are_found(planted_episodes, strict):
    facts = episodes.answer(Study(planted_episodes(EXACT), strict)).facts
    lead = facts["lead"]
    assert lead["basis"] in enough.JUDGED
    assert lead[f"{RATE}_low"] < 0.52
    assert lead[f"{RATE}_high"] > 0.48
    assert lead["b"] == pytest.approx(1.0, abs=0.1)
    assert facts["least"] == pytest.approx(0.1)
    assert facts["moments"]["exponent"].value == pytest.approx(1.0, abs=0.15)
    assert facts["moments"]["law"] in (episodes.POWER, episodes.UNKNOWN)


def test_a_cut_off_and_an_exponential_are_told_from_a_power_law(planted_episodes, strict, rng):
    found = {
        name: episodes.answer(Study(planted_episodes(EXACT, rate=3.0, moments=moments), strict)).facts["moments"]
        for name, moments in {
            "cut off": power_law(0.5, 30.0),
            "exponential": lambda rng, m: 1.0 + rng.exponential(20.0, m),
        }.items()
    }
    assert found["cut off"]["law"] == episodes.CUT_OFF
    assert found["cut off"]["exponent"].low < 0.55
    assert found["cut off"]["exponent"].high > 0.45
    assert found["exponential"]["law"] == episodes.EXPONENTIAL


def test_intervals_cover(rng):
    """Of 400 ensembles of twelve systems each."""
    planted = {RATE: 0.3 * np.exp(0.005), "b": 1.0, RECURRENCE: 1.0, "law": 0.5}
    held, with_cut_off = dict.fromkeys(planted, 0), laws_of_moments(0.0, 30.0)[1]
    for _ in range(400):
        runs = [catalogue(rng, 0.3 * np.exp(0.1 * rng.normal()), power_law(1.0)) for _ in range(12)]
        for name in (RATE, "b", RECURRENCE):
            one = QUANTITIES[name]
            found = over_matrices(one.of, np.array([one.sums(run, 0.0) for run in runs]), 0.95)
            held[name] += found.low <= planted[name] <= found.high
        counts = np.array([in_classes(np.log10(power_law(0.5, 30.0)(rng, 200)), 0.0, 125) for _ in range(12)])
        fit = maximise(with_cut_off, np.arange(1.0, 126.0), counts.sum(axis=0))
        found = parameter(fit, 0, counts, 0.95)
        held["law"] += found.low <= planted["law"] <= found.high
    print(held)
    assert all(agrees(n_held, 400, 0.93, 0.97) for n_held in held.values())


def test_intervals_cover_wherever_the_least_moment_lies_in_its_class(rng):
    """Of 200 ensembles of 20 systems, 2000 episodes each: Aki's b, and that of the power law with a cut-off."""
    of_aki, b, held = QUANTITIES["b"], 2.0, np.zeros(2, int)
    for _ in range(200):
        moments = 10 ** rng.uniform(-3, -2) * power_law(b)(rng, 40_000).reshape(20, 2000)
        magnitudes, start = np.log10(moments), np.arange(2000.0)
        least = completeness(magnitudes.ravel())
        one = start.astype(int)
        runs = [Catalogue(0.0, 2000.0, start, start, one, row, 2000.0, one) for row in moments]
        aki = over_matrices(of_aki.of, np.array([of_aki.sums(run, least) for run in runs]), 0.95)
        n_classes = int((magnitudes.max() - least) / FITTED) + 1
        counts = np.array([in_classes(row, least, n_classes) for row in magnitudes])
        law = laws_of_moments(least, float(np.mean(moments[magnitudes >= least])))[1]
        fit = maximise(law, np.arange(1.0, n_classes + 1), counts.sum(axis=0))
        held += [one.low <= b <= one.high for one in (aki, parameter(fit, 0, counts, 0.95))]
    print(held)
    assert all(agrees(int(n_held), 200, 0.93, 0.97) for n_held in held)


def test_classes_are_narrow_enough_for_an_exponential():
    """Of its exact shares from its mean on, the exponent is -1 to a tenth of the error that 4e5 episodes leave."""
    edges = np.arange(0.0, 1.3, FITTED)
    shares = -np.diff(np.exp(-(10.0**edges)))
    fit = maximise(laws_of_moments(0.0, 1.0)[1], np.arange(1.0, len(edges)), shares)
    assert fit.theta[0] == pytest.approx(-1.0, abs=0.003)


def test_a_planted_share_of_time_is_found_and_a_fast_drive_is_an_alert(planted_episodes, strict):
    """Half an episode a unit of time, each of 0.05; stretched to 0.4 they fill 20% of it."""
    slow = planted_episodes(EXACT)
    table = slow.episodes
    fast = replace(slow, episodes=table.assign(end=table["start"] + 0.4))
    for data, share, is_fast in ((slow, 0.025, False), (fast, 0.2, True)):
        facts = episodes.answer(Study(data, strict)).facts
        lead = facts["lead"]
        assert lead[f"{OCCUPANCY}_low"] < 1.02 * share
        assert lead[f"{OCCUPANCY}_high"] > 0.98 * share
        assert bool(facts["fast"]) is is_fast
        html = build(data, replace(strict, question=("episodes",)), "A chain", "", {}).html
        assert ("the drive is not slow" in html) is is_fast


def test_b_is_led_with_where_it_does_not_depend_on_the_least_magnitude(planted_episodes, strict):
    """A power law has one b, an exponential another at each M_c: log10(e) / b = E log10(m / m_c)."""
    for moments, is_one in ((power_law(1.0), True), (lambda rng, m: 1.0 + rng.exponential(20.0, m), False)):
        data = planted_episodes(EXACT, rate=4.0, moments=moments)
        facts = episodes.answer(Study(data, strict)).facts
        assert len(facts["b"]) > 1
        assert facts["has_b"] is is_one
        html = build(data, replace(strict, question=("episodes",)), "A chain", "", {}).html
        assert ("There is no one b" in html) is not is_one


def test_a_law_may_differ_where_its_mean_does_not(planted_episodes, planted, settings):
    """Sizes of 1 to 3 by exact events, 2 alone by the other method: both have the mean 2."""
    data = planted_episodes(EXACT | {"other": (planted.sigmoid, 1.0)}, rate=2.0)
    table = data.episodes
    sizes = np.where(table["member_id"].str.endswith("exact"), 1 + np.arange(len(table)) % 3, 2)
    facts = episodes.answer(Study(replace(data, episodes=table.assign(size=sizes)), settings)).facts
    (other,) = facts["settings"]
    assert other["differ"] == ["sizes"]
    assert next(row for row in other["rows"] if row["law"] == "sizes")["size"] == pytest.approx(1 / 3, abs=0.02)
    assert facts["differ"] == [{"laws": ("sizes",), "methods": [other["method"]]}]


def test_where_all_moments_are_alike_no_law_is_named(planted_episodes, settings):
    """As of one block: none lies above the fullest class, yet how often they come is known."""
    data = planted_episodes(EXACT, moments=lambda rng, m: np.full(m, 1.05))
    answer = episodes.answer(Study(data, settings))
    assert answer.facts["lead"]["b"] is None
    assert answer.facts["moments"]["law"] == episodes.UNKNOWN
    assert answer.tables["episode_rates"]["magnitude"].tolist() == pytest.approx([0.0])
    assert "cannot be told" in build(data, replace(settings, question=("episodes",)), "A chain", "", {}).html


def test_slips_either_way_all_count(planted_episodes, strict, rng):
    """On a belt at rest a force drives blocks either way: half of the moments are below zero."""
    data = planted_episodes({"exact": ({"belt_speed": 0.0}, 1.0)})
    signs = rng.choice([-1.0, 1.0], len(data.episodes))
    both = replace(data, episodes=data.episodes.assign(moment=data.episodes["moment"] * signs))
    found, known = (episodes.answer(Study(one, strict)) for one in (both, data))
    assert found.facts["lead"] == known.facts["lead"]
    assert found.facts["lead"]["share of slip in episodes"] is None
    assert found.facts["lead"]["n_episodes"] == (data.episodes["start"] >= 200.0).sum()


def test_an_episode_whose_slips_cancel_is_in_no_statistic(planted_episodes, strict):
    """As on belts that go opposite ways: it has no magnitude."""
    data = planted_episodes(EXACT)
    none = data.episodes.iloc[::40].assign(start=lambda table: table["start"] + 0.01, moment=0.0)
    more = pd.concat([data.episodes, none]).sort_values(["member_id", "start"], ignore_index=True)
    found, known = (episodes.answer(Study(replace(data, episodes=one), strict)) for one in (more, data.episodes))
    assert found.facts["lead"] == known.facts["lead"]
    assert found.facts["least"] == known.facts["least"]


def test_regularity(planted_episodes, settings, rng):
    found = {
        name: episodes.answer(Study(planted_episodes(EXACT, gaps=gaps), settings)).facts["lead"]["regularity"]
        for name, gaps in {
            "clock": lambda size: rng.uniform(0.8, 1.2, size),
            "clusters": lambda size: rng.exponential(1.0, size) ** 2 / 2,
        }.items()
    }
    assert found == {"clock": episodes.REGULAR, "clusters": episodes.CLUSTERED}


def test_recurrence_of_a_few_is_their_coefficient_of_variation(rng):
    """Of the sample, with n - 1 for the mean that it is measured from; over runs it is squares that are averaged."""
    quantity = QUANTITIES[RECURRENCE]
    sums = []
    for n in range(3, 9):
        gaps = rng.exponential(1.0, n)
        start = np.concatenate([[0.5], 0.5 + np.cumsum(gaps)])
        one = np.ones(n + 1)
        sums.append(
            quantity.sums(Catalogue(0.0, 100.0, start, one, one.astype(int), one, 100.0, one.astype(int)), 0.0)
        )
        np.testing.assert_allclose(quantity.of(np.array(sums[-1:])), np.std(gaps, ddof=1) / gaps.mean())
    two = one[:2]
    few = Catalogue(0.0, 9.0, start[:2], two, two.astype(int), two, 9.0, two.astype(int))
    assert quantity.sums(few, 0.0) == (0.0, 0.0)


def test_methods_are_held_against_exact_events(planted_episodes, planted, settings):
    """One keeps the rate, one has a third more, one has none at all."""
    engines = EXACT | {
        "fine": (planted.sigmoid | {"eps": 1e-5}, 1.0),
        "coarse": (planted.sigmoid | {"eps": 1e-3}, 1.33),
    }
    data = planted_episodes(engines, rate=3.0, moments=power_law(1.0, 30.0))
    is_creep = {"eps": 1e-2}
    rows = data.members[data.members["member_id"].str.endswith("coarse")]
    creep = rows.assign(**is_creep, member_id=rows["member_id"] + "r")
    data = Data(
        pd.concat([data.members, creep], ignore_index=True),
        dict(data.series) | {f"{name}r": data.series[name] for name in rows["member_id"]},
        episodes=data.episodes,
    )
    answer = episodes.answer(Study(data, settings))
    found = {one["setting"].split("eps = ")[1].split(",")[0]: one for one in answer.facts["settings"]}
    rate = {eps: one["rate"] for eps, one in found.items()}
    assert rate["1e-05"]["verdict"] == "agree"
    assert rate["0.001"]["verdict"] == "differ"
    assert rate["0.001"]["relative"] == pytest.approx(0.33, abs=0.05)
    assert rate["0.01"]["relative"] == -1
    assert [found[eps]["differ"] for eps in ("1e-05", "0.001")] == [[], ["waiting times"]]
    assert found["0.01"]["rows"] == []
    assert answer.facts["farthest"]["setting"] == found["0.001"]["setting"]
    over = answer.tables["episode_rates"].set_index("group")
    assert over.loc[found["0.001"]["setting"], "over"].iloc[0] == pytest.approx(1.33, abs=0.06)
    words = build(data, replace(settings, question=("episodes",)), "A chain", "", {})
    assert any(" more (" in line and "1e-5" in line for line in words.headline)
    assert "No episode at all: sigmoid \u03b5\u00a0=\u00a00.01" in words.html


@pytest.mark.parametrize(("question", "table"), [(engines, "engines"), (sweep, "sweep_changes")])
def test_where_episodes_are_recorded_gamma_is_not_asked_about(question, table, planted_episodes, planted, settings):
    """It is of cascades, which no such page has."""
    cases = {
        engines: EXACT | {"smooth": (planted.sigmoid, 1.0)},
        sweep: {"slow": ({"belt_speed": -0.1}, 1.0), "fast": ({"belt_speed": -0.2}, 1.0)},
    }
    data, asking = planted_episodes(cases[question]), replace(settings, margins={"mean": 0.1, "gamma": 0.05})
    asked = [
        set(question.answer(Study(one, asking)).tables[table]["quantity"])
        for one in (data, replace(data, episodes=None))
    ]
    assert asked[1] - asked[0] == {"gamma"}


def test_along_a_sweep_each_setting_is_held_against_exact_events_of_its_own_systems(
    planted_episodes, planted, settings
):
    """On a faster belt episodes come half as often again, under either engine."""
    slow, fast = ({"belt_speed": speed} for speed in (-0.1, -0.2))
    exact = {"slow": (slow, 1.0), "fast": (fast, 1.5)}
    smoothed = {f"{name} smoothed": (planted.sigmoid | key, factor) for name, (key, factor) in exact.items()}
    data = planted_episodes(exact | smoothed, rate=2.0, moments=power_law(1.0, 30.0))
    answer = episodes.answer(Study(data, settings))
    rates = [one["rate"] for one in answer.facts["settings"]]
    assert [one["relative"] for one in rates] == pytest.approx([0.0, 0.0], abs=0.1)
    over = answer.tables["episode_rates"].dropna(subset="over").groupby("group")["over"].first()
    assert over.tolist() == pytest.approx([1.0, 1.0], abs=0.1)
    html = build(data, replace(settings, question=("episodes",)), "A chain", "", {}).html
    assert html.count(">reference<") == 2
    assert "exact events on the same systems" in html
    alone = planted_episodes(exact, rate=2.0)
    assert "reference" not in build(alone, replace(settings, question=("episodes",)), "A chain", "", {}).html


def test_methods_are_named_as_they_are_written(planted_episodes, planted, settings):
    """With what tells them apart in a sweep, and n where there are several."""
    moreau = {"engine": "moreau", "step": 0.1, "tol": None}
    for more, names in (
        ({}, {"exact", "sigmoid \u03b5 = 0.03", "time steps h = 0.1"}),
        ({"kappa": [0.2, 0.3]}, {"exact, kappa = 0.2", "sigmoid, kappa = 0.2, \u03b5 = 0.03"}),
        ({"n": [100, 200]}, {"n = 100, exact", "n = 200, sigmoid \u03b5 = 0.03", "n = 100, time steps h = 0.1"}),
    ):
        points = [{key: value} for key, values in more.items() for value in values] or [{}]
        engines = {
            f"{name}-{k}": (key | at, 1.0)
            for k, at in enumerate(points)
            for name, key in (("exact", {}), ("smoothed", planted.sigmoid), ("stepped", moreau))
        }
        table = episodes.answer(Study(planted_episodes(engines, n_matrices=4), settings)).tables["episodes"]
        found = {re.sub(", (ratio|stick) = [^,]*", "", name.replace("\u00a0", " ")) for name in table["method"]}
        assert names <= found


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_where_none_can_be_judged_the_one_with_the_most_episodes_is_told_of(
    planted_episodes, planted, settings, factor
):
    few = episodes.answer(
        Study(planted_episodes(EXACT | {"smoothed": (planted.sigmoid, factor)}, n_matrices=3), settings)
    )
    counts = few.tables["episodes"].set_index("method")["n_episodes"]
    assert counts.idxmax() == few.facts["best"]["method"]
    assert len(counts) == 2


def test_few_systems_few_episodes_and_a_drift_are_refused(planted_episodes, settings, rng):
    few = episodes.answer(Study(planted_episodes(EXACT, n_matrices=3), settings))
    rare = episodes.answer(Study(planted_episodes(EXACT, rate=0.01), settings))
    slow = episodes.answer(
        Study(
            planted_episodes(EXACT, gaps=lambda size: np.geomspace(0.1, 10.0, size) * rng.exponential(1, size)),
            settings,
        )
    )
    assert [one.lack for one in (few, rare, slow)] == [enough.FEW_MATRICES, enough.FEW_CASCADES, enough.DRIFTS]
    for one in (few, rare, slow):
        assert one.tables["episodes"]["basis"].tolist() == [one.lack]


def test_completeness_is_one_class_above_the_fullest():
    assert completeness(np.array([0.31, 0.42, 0.44, 0.47, 0.55, 1.2])) == pytest.approx(0.5)


@pytest.mark.drawn
def test_the_page_draws_its_figures(planted_episodes, planted, settings):
    engines = EXACT | {"sigmoid": (planted.sigmoid, 1.2)}
    made = build(planted_episodes(engines), replace(settings, question=("episodes",)), "A chain", "", {})
    assert {"episode_rates", "episode_rates_over"} <= made.figures.keys()
    assert "one_catalogue" in build(planted_episodes(EXACT), settings, "A chain", "", {}).figures


def test_a_catalogue_has_the_columns_of_catalogues():
    table = pd.DataFrame({
        "member_id": ["a", "a", "b"], "start": [1.5, 2.5, 0.25], "end": [2.0, 3.0, 1.0], "size": [1, 2, 3],
        "moment": [10.0, 0.0, -0.1], "first_block": [7, 8, 9],
    })  # fmt: skip
    found = as_catalogue(table)
    assert list(found) == ["id", "time", "lat", "lon", "dep", "magtype", "mag"]
    assert found["id"].tolist() == ["a-0", "b-0"]
    assert found["mag"].tolist() == pytest.approx([1.0, -1.0])
    assert found["time"].dt.strftime("%S.%f").tolist() == ["01.500000", "00.250000"]
    assert as_catalogue(table.drop(columns="member_id"))["id"].tolist() == ["run-0", "run-1"]


def test_what_is_no_table_of_episodes_is_refused_as_a_catalogue():
    with pytest.raises(TypeError, match=r"^episodes: expected a DataFrame with the columns .*, got list; write"):
        as_catalogue([1.0])
    with pytest.raises(
        ValueError, match=r"^episodes: expected the columns .*, found no moment, first_block in start;"
    ):
        as_catalogue(pd.DataFrame({"start": [1.0]}))
