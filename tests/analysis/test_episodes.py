"""Episodes: planted rates, exponents and regularities are found; methods are told apart within systems."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import brentq

from stickslip.analysis import Study, build, measures
from stickslip.analysis import catalogue as as_catalogue
from stickslip.analysis.findings.alerts import Code
from stickslip.analysis.findings.finding import Change, Fit, KeyChange, Law, Level, Outcomes, Reason, Verdict, levels
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.models import magnitudes
from stickslip.analysis.models.episodes import CREEP, OCCUPANCY, QUANTITIES, RATE, REST, SIZE, SLIP, STORED, Catalogue
from stickslip.analysis.models.magnitudes import Picture
from stickslip.analysis.questions.runs.changes import answer as changes_of
from stickslip.analysis.questions.slips import episodes
from stickslip.analysis.stats import enough
from tests.analysis.designs import Data
from tests.analysis.reports import of_kind

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture
def settings(settings):
    return replace(settings, t_burn=200.0)


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


TOOK = 0.05  # what a planted episode takes


def starts(quiet, rate):
    """Of episodes at a rate, after quiet times in units of their mean."""
    return np.cumsum(quiet * (1 / rate - TOOK)) + TOOK * np.arange(len(quiet))


def catalogue(rng, rate, moments, t_stop=1000.0):
    start = starts(rng.exponential(size=int(2 * rate * t_stop + 50)), rate)
    start = start[start < t_stop]
    moment = moments(rng, len(start))
    size = np.ones(len(start), int)
    return Catalogue(0.0, t_stop, start, np.full(len(start), TOOK), size, moment, t_stop)


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
                start = starts(apart, rate * factor * of_system)
                start = start[start < planted.t_end - 0.1]
                moment = (moments or power_law(1.0))(rng, len(start))
                size = np.minimum(1 + moment.astype(int), 200)
                first = rng.integers(20, size=len(start))
                table.append(pd.DataFrame({"member_id": member, "start": start, "end": start + TOOK, "size": size,
                                           "moment": moment, "first_block": first}))  # fmt: skip
        return Data(pd.DataFrame(rows), series, episodes=pd.concat(table, ignore_index=True))

    return make


EXACT = {"exact": ({}, 1.0)}


def test_a_data_set_without_episodes_is_not_asked(planted, settings):
    rows, series = planted.ensemble({"coulomb": 0.7}, 4)
    assert episodes.answer(Study(Data(rows, series), settings)) is None


def asked(data, settings):
    return episodes.answer(Study(data, settings))


def rows_of(answer):
    """Statistics by method."""
    table = answer.tables["episodes"].set_index("method")
    return {method: row.to_dict() for method, row in table.iterrows()}


def codes(answer):
    return [alert.code for alert in answer.alerts]


def test_rate_and_exponent_are_found(planted_episodes, strict):
    answer = asked(planted_episodes(EXACT, rate=3.0), strict)
    (rate,) = (level for level in of_kind(answer, Level) if level.quantity is episodes.WORDS[RATE])
    (law,), lead = of_kind(answer, Law), rows_of(answer)["exact"]
    assert answer.findings[0] is law
    assert lead["basis"] in enough.JUDGED
    assert rate.estimate.low < 3.1
    assert rate.estimate.high > 2.9
    assert lead["picture"] == Picture.POWER
    assert lead["least"] == pytest.approx(0.0, abs=0.5)
    assert law.predicate.startswith("follow a power law from M = ")
    assert law.parameter.quantity is episodes.B_VALUE
    assert lead["b_low"] < 1.0 < lead["b_high"]
    assert lead["b_positive_low"] < 1.0 < lead["b_positive_high"]
    upper = answer.tables["episode_b"]
    assert upper["least"].diff().dropna().tolist() == pytest.approx([0.5] * (len(upper) - 1))
    assert (upper["b_low"] < 1.0).all()
    assert (upper["b_high"] > 1.0).all()


def law_of(systems, declared=None):
    return magnitudes.magnitudes_of([np.log10(moments) for moments in systems], 0.95, declared)


def test_on_a_declared_range_b_is_of_the_same_magnitudes_whatever_is_above(rng):
    """A density that bends at m = 10, from b = 0.5 to 1.5; one of two catalogues goes on to larger events."""

    def bent(m, most):
        below = rng.uniform(size=m) < 0.6
        steep = (rng.uniform(size=m) * (1 - most**-1.5) + most**-1.5) ** (-1 / 1.5)
        flat = (1 - rng.uniform(size=m) * (1 - 10**-0.5)) ** -2
        return np.where(below, flat, 10 * steep)

    short, long = ([bent(m, most) for _ in range(20)] for m, most in ((500, 10.0), (5000, 1000.0)))
    laws = [law_of(systems, (0.0, 1.0)) for systems in (short, long)]
    for law in laws:
        assert (law.picture, law.least, law.most) == (magnitudes.Picture.DECLARED, 0.0, 1.0)
        assert law.b.low - 0.1 < 0.5 < law.b.high + 0.1
    found = [law_of(systems) for systems in (short, long)]
    assert {(law.least, law.most) for law in found} != {(0.0, 1.0)}


def test_the_size_of_a_misfit_does_not_depend_on_how_much_is_known(rng):
    """A mixture of two power laws: its distance from the law that is nearest, by quadrature of the densities."""

    def mixed(m):
        return np.where(rng.uniform(size=m) < 0.5, *(rng.uniform(size=(2, m)) ** -np.array([[2.0], [0.8]])))

    laws = [law_of([mixed(m) for _ in range(20)], (0.0, 2.0)) for m in (1000, 20000)]
    few, many = (magnitudes.misfit(law, 0.95, rng) for law in laws)
    x = np.linspace(0.0, 2.0, 20001)
    below = np.mean([(1 - 10 ** (-b * x)) for b in (0.5, 1.25)], axis=0)
    density = np.gradient(below, x)
    mean = np.trapezoid(density * x, x) / below[-1]
    b = brentq(lambda b: 1 / (b * np.log(10)) - 2 / (10 ** (2 * b) - 1) - mean, 0.1, 3.0)
    distance = np.abs(below / below[-1] - (1 - 10 ** (-b * x)) / (1 - 10 ** (-2 * b))).max()
    assert 0.005 < distance < 0.05
    for misfit in (few, many):
        width = misfit.high - misfit.low  # beside it: the chance to miss is far below one in a million
        assert misfit.low - width <= distance <= misfit.high + width
    assert many.high - many.low < 0.5 * (few.high - few.low)
    exact = law_of([rng.uniform(size=2000) ** -1.25 for _ in range(20)], (0.0, 2.0))
    assert magnitudes.misfit(exact, 0.95, rng).high < 0.02


def test_which_episodes_b_is_of_is_said(planted_episodes, settings, strict, rng):
    data = planted_episodes(EXACT, rate=6.0)
    is_single = rng.uniform(size=len(data.episodes)) < 0.7
    table = data.episodes.assign(moment=data.episodes["moment"].where(~is_single, 0.5))
    answer = asked(replace(data, episodes=table), strict)
    (law,) = of_kind(answer, Law)
    shares = {finding.quantity.key: finding.estimate for finding in of_kind(answer, Level)}
    assert law.scope.estimate.low < 0.3 < law.scope.estimate.high + 0.03
    assert shares["below_range"].value + law.scope.estimate.value == pytest.approx(1.0, abs=1e-4)
    assert shares["atom"].low < 0.7 < shares["atom"].high + 0.01
    usual = asked(replace(data, episodes=table), settings)  # a distance has no interval as sure as that
    misfits = [level.estimate for level in of_kind(usual, Level) if level.quantity is episodes.MISFIT]
    assert len(misfits) == sum(law.scope is not None for law in of_kind(usual, Law))  # chance rejects one in twenty
    assert all(misfit.high < 0.1 for misfit in misfits)
    declared = asked(replace(data, episodes=table), replace(strict, magnitude_range=(0.0, 1.0)))
    b, scope = declared.findings[:2]
    assert (b.quantity, scope.quantity) == (episodes.B_VALUE, episodes.IN_RANGE)
    assert str(b.where) == "M = 0.0 to 1.0, as declared"
    assert b.estimate.low < 1.0 < b.estimate.high + 0.05


def test_a_cut_off_and_an_exponential_are_told_from_a_power_law(planted_episodes, strict):
    laws = {
        name: of_kind(asked(planted_episodes(EXACT, rate=6.0, moments=moments, n_matrices=24), strict), Law)[0]
        for name, moments in {
            "cut off": power_law(0.5, 30.0),
            "exponential": lambda rng, m: 1.0 + rng.exponential(20.0, m),
        }.items()
    }
    assert laws["cut off"].predicate.startswith("follow a power law with an exponential cut-off from M = ")
    assert laws["cut off"].parameter.quantity.name == "b-value of a power law with an exponential cut-off"
    assert ": b-value 0." in sentence(laws["cut off"]), "the sentence names the law once"
    assert laws["cut off"].parameter.estimate.low < 0.5 < laws["cut off"].parameter.estimate.high
    assert laws["exponential"].fit is Fit.FAILS
    assert laws["exponential"].parameter.estimate.value == pytest.approx(21.0, rel=0.05)
    assert "mean moment" not in sentence(laws["exponential"]), "it says nothing about the law"


def as_moving(data):
    """The ensemble with series in which a block slips during each episode."""
    series = {}
    of_member = dict(list(data.episodes.groupby("member_id", sort=False)))
    for member, n in zip(data.members["member_id"], data.members["n"], strict=True):
        start, end = of_member[member][["start", "end"]].to_numpy().T
        t = np.append(start, end)
        order = np.argsort(t, kind="stable")
        slipping = np.cumsum(np.repeat([1, -1], len(start))[order])
        series[member] = np.append(0.0, t[order]), np.append(n, n - np.minimum(slipping, 1))
    return replace(data, series=series)


def test_a_planted_share_of_time_is_found_and_a_fast_drive_is_an_alert(planted_episodes, strict):
    """Half an episode a unit of time, each of 0.05; stretched to 0.4, with overlaps, 1 - exp(-0.2) of it."""
    slow = planted_episodes(EXACT)
    table = slow.episodes
    fast = replace(slow, episodes=table.assign(end=table["start"] + 0.4))
    for data, share, is_fast in ((as_moving(slow), 0.025, False), (as_moving(fast), 1 - np.exp(-0.2), True)):
        answer = asked(data, strict)
        lead = rows_of(answer)["exact"]
        assert lead[f"{OCCUPANCY}_low"] < 1.02 * share
        assert lead[f"{OCCUPANCY}_high"] > 0.98 * share
        assert (Code.OVERLAP in codes(answer)) is is_fast


def test_every_size_of_a_chain_has_its_law(planted_episodes, strict, rng):
    """A power law for the larger chain, which leads, and for the smaller one exponential moments."""
    sizes = {name: ({"n": n}, 1.0) for name, n in (("small", 100), ("large", 200))}
    data = planted_episodes(sizes, rate=4.0, n_matrices=30)
    is_small = data.episodes["member_id"].str.endswith("small")
    moment = data.episodes["moment"].where(~is_small, 1.0 + rng.exponential(20.0, len(is_small)))
    answer = asked(replace(data, episodes=data.episodes.assign(moment=moment)), strict)
    large, small = of_kind(answer, Law)
    assert (str(large.parameter.where), str(small.parameter.where)) == ("n = 200", "n = 100")
    assert (large.parameter.quantity, small.parameter.quantity) == (episodes.B_VALUE, episodes.MOMENT)
    assert large.parameter.estimate.low < 1.0 < large.parameter.estimate.high


def test_no_power_law_is_told_where_moments_scatter_about_a_mean(planted_episodes, strict):
    humped = planted_episodes(EXACT, 24, 3.0, lambda rng, m: 1.0 + rng.gamma(3.0, 20.0, m))
    assert rows_of(asked(humped, strict))["exact"]["picture"] in (Picture.NONE, Picture.OPEN)


@pytest.mark.parametrize("few", [{"rate": 1e-9, "n_matrices": 5}, {"rate": 3.0, "n_matrices": 1}])
def test_episodes_that_cannot_be_judged_have_a_page(planted_episodes, settings, few):
    """None at all; and of one system, which has no interval."""
    data = planted_episodes(EXACT, **few)
    for question in ((), ("fates",), ("episodes",)):
        html = build(data, replace(settings, question=question), "A chain", "", {}).html
        assert ("Some block is slipping" in html) or few["n_matrices"] > 1


def test_episodes_that_become_more_are_said_to_whichever_question_leads(planted_episodes, settings):
    """At one of two speeds half of the episodes in the first half of the time are left out."""
    speeds = {str(v): ({"belt_speed": v}, 1.0) for v in (-0.1, -0.2)}
    data = planted_episodes(speeds, rate=3.0, n_matrices=20)
    table = data.episodes
    is_early = table["start"] < 0.5 * (settings.t_burn + float(data.members["t_end"].iloc[0]))
    is_out = is_early & table["member_id"].str.endswith("-0.2") & (np.arange(len(table)) % 2 == 0)
    data = replace(data, episodes=table[~is_out])
    for question in ((), ("changes",), ("episodes",)):
        top, _, _ = build(data, replace(settings, question=question), "A chain", "", {}).html.partition("<details")
        assert "still drifts after t_burn = 200" in top, question
    # an alert says so too, if none that matter more take its place: by chance n_stick may seem to drift
    measured = build(data, settings, "A chain", "", {}).tables["sweep_measures"]
    of_b = measured[measured["measure"] == measures.B].set_index("belt_speed")["reason"].fillna("")
    assert of_b[-0.2] == "the rate of episodes drifts"
    assert of_b[-0.1] != "the rate of episodes drifts"


def test_a_method_is_told_of_where_the_one_it_is_compared_with_drifts(planted_episodes, planted, settings):
    """Of exact events half of the first half are left out, of the smoothed ones none."""
    data = planted_episodes(EXACT | {"smoothed": (planted.sigmoid, 1.0)}, rate=3.0, n_matrices=20)
    table = data.episodes
    is_early = table["start"] < 0.5 * (settings.t_burn + float(data.members["t_end"].iloc[0]))
    is_out = is_early & table["member_id"].str.endswith("exact") & (np.arange(len(table)) % 2 == 0)
    data = replace(data, episodes=table[~is_out])
    answer = asked(data, settings)
    assert answer.findings[0].parameter.where.parts[0] == ("", "sigmoid")
    assert rows_of(answer)["exact"]["basis"] == enough.DRIFTS
    assert Code.DRIFT in codes(answer)


@pytest.mark.parametrize("share", [0.45, 0.8])
def test_an_atom_of_single_blocks_is_no_magnitude_of_completeness(planted_episodes, strict, rng, share):
    """As single blocks of a chain that share their friction; the others have a power law."""
    data = planted_episodes(EXACT, rate=6.0)
    is_single = rng.uniform(size=len(data.episodes)) < share
    table = data.episodes.assign(moment=data.episodes["moment"].where(~is_single, 0.5))
    (row,) = asked(replace(data, episodes=table), strict).tables["episodes"].to_dict("records")
    assert (row["picture"], row["n_episodes"]) == (Picture.POWER, np.count_nonzero(table["start"] >= 200.0))
    assert row["atom"] == pytest.approx(share, abs=0.05)
    assert row["least"] == pytest.approx(0.0, abs=0.5)
    assert row["b_low"] < 1.0 < row["b_high"]


def test_what_changes_with_the_number_of_blocks_has_a_verdict(planted_episodes, settings):
    """Sizes of 2 and 3, then of 4 and 6; as many on either chain, but twice the blocks."""
    sizes = {name: ({"n": n}, 1.0) for name, n in (("small", 100), ("large", 200))}
    data = planted_episodes(sizes, rate=2.0, n_matrices=20)
    table = data.episodes
    of_size = (2 + np.arange(len(table)) % 2) * np.where(table["member_id"].str.endswith("large"), 2, 1)
    data = replace(data, episodes=table.assign(size=of_size))
    changes = of_kind(asked(data, settings), Change)
    assert [(change.quantity, change.difference.verdict) for change in changes] == [
        (episodes.WORDS[SIZE], Verdict.MORE),
        (episodes.BY_TRAVEL, Verdict.LESS),
    ]
    assert {change.keys for change in changes} == {(KeyChange("n", "100", "200"),)}
    relative = [change.difference.estimate.value for change in changes]
    assert relative == pytest.approx([1.0, -0.5], abs=0.1)
    alike, _ = of_kind(asked(replace(data, episodes=data.episodes.assign(size=2)), settings), Change)
    assert (alike.difference.verdict, alike.difference.estimate.value) == (Verdict.OPEN, 0.0)


@pytest.mark.parametrize(("stick", "ratio", "speed"), [("manifold", "one", 6.9078), ("manifold", "uniform", None)])
def test_what_counts_as_stuck_is_told_in_speeds_of_the_belt(planted_episodes, planted, settings, stick, ratio, speed):
    smooth = planted.sigmoid | {"eps": 1e-3, "stick": stick, "ratio": ratio, "belt_speed": -1e-3}
    data = planted_episodes({"exact": ({"belt_speed": -1e-3}, 1.0), "smooth": (smooth, 1.0)})
    answer = asked(data, settings)
    found = answer.tables["episodes"].set_index("method")["stuck_below"]
    assert found["exact"] is pd.NA
    assert found.iloc[1] is pd.NA if speed is None else found.iloc[1] == pytest.approx(speed, rel=1e-4)
    if speed is not None:  # its episodes cannot be counted: an alert says so, and no row compares them
        assert Code.BLURRED in codes(answer)
        where = {str(level.where) for level in of_kind(answer, Level) if "creep" not in level.quantity.name}
        assert not [place for place in where if "sigmoid" in place]


def test_where_all_moments_are_alike_there_is_no_power_law(planted_episodes, settings):
    """As of one block: they are one atom, yet how often they come is known."""
    data = planted_episodes(EXACT, moments=lambda rng, m: np.full(m, 1.05))
    answer = episodes.answer(Study(data, settings))
    assert answer.findings[0].fit is Fit.FAILS
    assert answer.findings[0].predicate.endswith("less than a decade")
    assert len(levels(answer.findings[0])) == 1
    assert answer.tables["episode_rates"]["magnitude"].tolist() == pytest.approx([0.0])


def test_slips_either_way_all_count(planted_episodes, strict, rng):
    """On a belt at rest a force drives blocks either way: half of the moments are below zero."""
    data = planted_episodes({"exact": ({"belt_speed": 0.0}, 1.0)})
    signs = rng.choice([-1.0, 1.0], len(data.episodes))
    both = replace(data, episodes=data.episodes.assign(moment=data.episodes["moment"] * signs))
    found, known = (rows_of(asked(one, strict))["exact"] for one in (both, data))
    assert {**found} == {**known}
    assert found["share of slip in episodes"] is None
    assert found["n_episodes"] == (data.episodes["start"] >= 200.0).sum()


def test_an_episode_whose_slips_cancel_is_in_no_statistic(planted_episodes, strict):
    """As on belts that go opposite ways: it has no magnitude."""
    data = planted_episodes(EXACT)
    none = data.episodes.iloc[::40].assign(start=lambda table: table["start"] + 0.01, moment=0.0)
    more = pd.concat([data.episodes, none]).sort_values(["member_id", "start"], ignore_index=True)
    found, known = (asked(replace(data, episodes=one), strict).tables["episodes"] for one in (more, data.episodes))
    pd.testing.assert_frame_equal(found, known)


def test_an_episode_that_does_not_end_is_motion(planted_episodes, settings):
    """From t = 500 to the end, 1000: no episode has that time."""
    data = as_moving(planted_episodes(EXACT))
    for name, (t, n_stick) in data.series.items():
        before = t < 500.0
        data.series[name] = np.append(t[before], 500.0), np.append(n_stick[before], 0)
    lead = rows_of(asked(data, settings))["exact"]
    share = (1000.0 - 500.0) / (1000.0 - settings.t_burn)
    assert share < lead[OCCUPANCY] < share + 0.05


def test_methods_are_held_against_exact_events(planted_episodes, planted, strict):
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
    answer = asked(data, strict)
    different, undecided = of_kind(answer, Outcomes)
    assert answer.findings[:2] == [different, undecided]
    assert (different.other, different.different) == ("the exact law", ("sigmoid with eps ≥ 1e-3",))
    assert (different.at_largest, different.largest.comparison.difference.estimate.value) == (
        "sigmoid with eps = 0.01", -1.0
    )  # fmt: skip
    assert undecided.undecided == ("sigmoid with eps = 1e-5",)
    assert undecided.largest.comparison.difference.verdict in (Verdict.OPEN, Verdict.OPEN_AMONG_MANY)
    levels = [level for level in of_kind(answer, Level) if level.quantity is episodes.WORDS[RATE]]
    rates = {re.sub(", (ratio|stick) = [^,]*", "", str(level.where)): level for level in levels}
    off = {where: level.comparison.difference for where, level in rates.items() if where != "exact"}
    assert off["sigmoid, eps = 1e-3"].verdict is Verdict.MORE
    assert off["sigmoid, eps = 1e-3"].estimate.value == pytest.approx(0.33, abs=0.05)
    assert off["sigmoid, eps = 0.01"].estimate.value == -1.0
    assert rates["exact"].comparison is None
    assert Code.BLURRED not in codes(answer)


def test_a_method_that_keeps_the_episodes_may_lose_slip_onsets(planted_episodes, planted, settings):
    """One changes n_stick half as often in the same episodes: it differs, and the first finding says in what.

    By time steps, in which onsets and arrests cancel, they are not counted.
    """
    methods = {"half": planted.sigmoid | {"eps": 1e-4}, "steps": {"engine": "moreau", "step": 0.01, "tol": None}}
    data = planted_episodes(EXACT | {name: (method, 1.0) for name, method in methods.items()}, rate=3.0)
    of_exact = dict(list(data.episodes.groupby("member_id", sort=False)))
    episodes_of, series = [], {}
    for member in data.members["member_id"]:
        exact = f"{member.partition('-')[0]}-exact"
        episodes_of.append(of_exact[exact].assign(member_id=member))
        t, n_stick = data.series[exact]
        n_kept = len(t) if member == exact else len(t) // 2
        series[member] = t[:n_kept], n_stick[:n_kept]
    data = replace(data, series=series, episodes=pd.concat(episodes_of, ignore_index=True))
    different, alike = of_kind(asked(data, settings), Outcomes)
    assert re.match(
        r"Sigmoid.* with eps = 1e-4 gives [\d.]+% \(.*\) fewer slip onsets than the exact law\.", sentence(different)
    )
    assert alike.undecided == ("moreau with step = 0.01",)
    assert "onsets" not in alike.scope
    (distance, *_) = (level for level in of_kind(asked(data, settings), Level) if level.quantity.key == "magnitudes")
    assert (distance.comparison.other, distance.comparison.difference) == ("the exact law", None)
    assert sentence(distance).endswith(", compared with the exact law.")


def test_a_method_that_keeps_rate_and_magnitudes_may_stretch_episodes(planted_episodes, planted, strict, rng):
    """It differs, and that is said; of the others the largest difference is, not the one that is known least."""
    steps = {f"h{step}": planted.sigmoid | {"eps": step} for step in (1e-5, 1e-4, 1e-3)}
    data = planted_episodes(EXACT | {name: (method, 1.0) for name, method in steps.items()}, rate=3.0)
    table = data.episodes.assign(end=lambda rows: rows["start"] + TOOK * rng.uniform(0.5, 1.5, len(rows)))
    of_exact = table[table["member_id"].str.endswith("-exact")]
    longer = of_exact.assign(
        member_id=of_exact["member_id"].str.replace("exact", "h0.001"),
        end=of_exact["start"] + rng.uniform(1.0, 1.1, len(of_exact)) * (of_exact["end"] - of_exact["start"]),
    )
    table = pd.concat([table[~table["member_id"].str.endswith("h0.001")], longer], ignore_index=True)
    answer = asked(replace(data, episodes=table), strict)
    different, undecided = of_kind(answer, Outcomes)
    assert different.different == ("sigmoid with eps = 1e-3",)
    assert re.search(
        r"gives a mean duration of episodes [45]\.\d+% .* higher than the exact law", sentence(different)
    )
    contrasts = answer.tables["episode_contrasts"]
    is_told = ~contrasts["setting"].str.contains("0.001|1e-3") & contrasts["quantity"].ne(SLIP)
    largest = contrasts.loc[is_told, "relative"].abs().max()
    assert abs(undecided.largest.difference.estimate.value) >= largest - 1e-12  # slip onsets are compared too
    assert "duration" in undecided.scope


def test_a_test_that_few_systems_leave_without_power_costs_the_others_nothing(planted_episodes, planted, settings):
    """Six systems have no p-value of swaps below 2 / 2^6: rates are judged among themselves."""
    engines = EXACT | {
        f"smooth {eps}": (planted.sigmoid | {"eps": eps}, factor) for eps, factor in ((1e-3, 1.5), (1e-2, 1.0))
    }
    answer = asked(planted_episodes(engines, n_matrices=6, rate=3.0), settings)
    laws, contrasts = (answer.tables[name] for name in ("episode_methods", "episode_contrasts"))
    assert laws["p_different_holm"].isna().all()
    rates = contrasts[contrasts["quantity"] == RATE].sort_values("p_different")
    assert rates["p_different_holm"].iloc[0] == pytest.approx(2 * rates["p_different"].iloc[0])
    assert len(of_kind(answer, Outcomes)[0].different) == 1


@pytest.mark.parametrize(
    ("cases", "left_out"),
    [({"exact": 1.0, "smooth": 1.0}, {"gamma"}), ({"slow": -0.1, "fast": -0.2}, {"gamma", "mean n_stick"})],
)
def test_where_episodes_are_recorded_gamma_is_not_asked_about(cases, left_out, planted_episodes, planted, settings):
    """It is of cascades, which no such page has; a sweep compares the episodes instead."""
    engines = EXACT | {"smooth": (planted.sigmoid, 1.0)}
    data = planted_episodes(
        {name: ({"belt_speed": v}, 1.0) for name, v in cases.items()} if "slow" in cases else engines
    )
    asking = replace(settings, margins={"mean": 0.1, "gamma": 0.05})
    with_episodes, without = (
        set(changes_of(Study(one, asking)).tables["changes"]["quantity"])
        for one in (data, replace(data, episodes=None))
    )
    assert without - with_episodes == left_out


def test_along_a_sweep_each_setting_is_held_against_exact_events_of_its_own_systems(
    planted_episodes, planted, settings
):
    """On a faster belt episodes come half as often again, under either engine."""
    slow, fast = ({"belt_speed": speed} for speed in (-0.1, -0.2))
    exact = {"slow": (slow, 1.0), "fast": (fast, 1.5)}
    smoothed = {f"{name} smoothed": (planted.sigmoid | key, factor) for name, (key, factor) in exact.items()}
    data = planted_episodes(exact | smoothed, rate=2.0, moments=power_law(1.0, 30.0))
    answer = asked(data, settings)
    contrasts = answer.tables["episode_contrasts"]
    relative = contrasts.loc[contrasts["quantity"] == RATE, "relative"]
    assert relative.tolist() == pytest.approx([0.0, 0.0], abs=0.1)
    assert len(of_kind(answer, Outcomes)) == 2
    assert of_kind(asked(planted_episodes(exact, rate=2.0), settings), Outcomes) == []


def test_methods_are_named_as_they_are_written(planted_episodes, planted, settings):
    """With what tells them apart in a sweep, and n where there are several."""
    moreau = {"engine": "moreau", "step": 0.1, "tol": None}
    for more, names in (
        ({}, {"exact", "sigmoid, eps = 0.03", "moreau, step = 0.1"}),
        ({"kappa": [0.2, 0.3]}, {"exact, kappa = 0.2", "sigmoid, kappa = 0.2, eps = 0.03"}),
        ({"n": [100, 200]}, {"n = 100, exact", "n = 200, sigmoid, eps = 0.03", "n = 100, moreau, step = 0.1"}),
    ):
        points = [{key: value} for key, values in more.items() for value in values] or [{}]
        engines = {
            f"{name}-{k}": (key | at, 1.0)
            for k, at in enumerate(points)
            for name, key in (("exact", {}), ("smoothed", planted.sigmoid), ("stepped", moreau))
        }
        table = episodes.answer(Study(planted_episodes(engines, n_matrices=4), settings)).tables["episodes"]
        found = {re.sub(", (ratio|stick) = [^,]*", "", name) for name in table["method"]}
        assert names <= found


def test_few_systems_few_episodes_and_a_drift_are_refused(planted_episodes, settings, rng):
    few = episodes.answer(Study(planted_episodes(EXACT, n_matrices=3), settings))
    rare = episodes.answer(Study(planted_episodes(EXACT, rate=0.01), settings))
    slow = episodes.answer(
        Study(
            planted_episodes(EXACT, gaps=lambda size: np.geomspace(0.1, 10.0, size) * rng.exponential(1, size)),
            settings,
        )
    )
    reasons = [finding.reason for one in (few, rare, slow) for finding in one.findings]
    assert reasons == [Reason.FEW_UNITS, Reason.FEW_EPISODES, Reason.DRIFT]
    bases = [one.tables["episodes"]["basis"].item() for one in (few, rare, slow)]
    assert bases == [enough.FEW_MATRICES, enough.FEW_CASCADES, enough.DRIFTS]


@pytest.mark.parametrize("carried", [0.3, -0.1])
def test_slip_stored_strain_and_creep_are_all_of_the_travel(rng, carried):
    """Between the begins of the first and the last episode, of a planted share that creeps."""
    n_episodes, creep, rate = 40, 0.2, 2.5
    start = np.sort(rng.uniform(10.0, 90.0, n_episodes))
    travel = rate * (start[-1] - start[0])
    moment = rng.exponential(size=n_episodes)
    moment[:-1] *= (1 - creep - carried) * travel / moment[:-1].sum()
    at = 7.0 + carried * travel * np.append(np.sort(rng.uniform(size=n_episodes - 1)), 1.0)
    at[0] = 7.0
    size = np.ones(n_episodes, int)
    run = Catalogue(0.0, 100.0, start, np.zeros(n_episodes), size, moment, 100 * rate, 0.0, at)
    found = {name: np.divide(*one.sums(run)) for name, one in {**QUANTITIES, **REST}.items()}
    expected = {SLIP: 1 - creep - carried, STORED: carried, CREEP: creep}
    assert {name: found[name] for name in expected} == pytest.approx(expected)
    unknown = replace(run, carried=None)
    assert np.isnan(REST[CREEP].sums(unknown)[0])
    assert QUANTITIES[SLIP].sums(unknown) == QUANTITIES[SLIP].sums(run)


@pytest.mark.parametrize(
    ("creep", "words"), [(0.0, "at most 1.0 \u00d7 10\u207b\u2077%."), (0.1, ": 10.0% in all 12 systems.")]
)
def test_creep_that_is_rounding_is_a_limit(planted_episodes, planted, settings, creep, words):
    """Blocks are carried as far as the belt, but for their slip and a planted share of creep."""
    data = planted_episodes(EXACT | {"sigmoid": (planted.sigmoid, 1.0)})
    table = data.episodes
    slipped = table.groupby("member_id")["moment"].cumsum() - table["moment"]
    carried = -(200 * 0.2 * (1 - creep) * table["start"] - slipped)
    answer = asked(replace(data, episodes=table.assign(z_sum=carried)), settings)
    of_travel = [episodes.WORDS[name] for name in (SLIP, STORED, CREEP)]
    said = [level for level in of_kind(answer, Level) if level.quantity in of_travel]
    assert [level.quantity for level in said] == [*of_travel[:2], of_travel[0], of_travel[2]], (
        "parts of one travel together"
    )
    assert sentence(said[-1]).endswith(words)


def hues_of(figure):
    """Colours by the names in a legend."""
    (legend,) = figure.legends
    handles = zip(legend.get_texts(), legend.legend_handles, strict=True)
    return {text.get_text(): handle.get_color() for text, handle in handles}


@pytest.mark.drawn
def test_a_setting_has_one_hue_in_all_figures(planted_episodes, planted, settings):
    eps = (1e-3, 1e-5, 1e-4)
    study = Study(
        planted_episodes(EXACT | {f"{value:g}": (planted.sigmoid | {"eps": value}, 1.0) for value in eps}), settings
    )
    magnitudes, contrasts = (
        hues_of(answer.figures[name].recipe())
        for answer, name in ((episodes.answer(study), "magnitudes"), (changes_of(study), "contrasts"))
    )
    assert len({*magnitudes.values()}) == 4
    assert contrasts == {name: hue for name, hue in magnitudes.items() if name != "exact"}


@pytest.mark.drawn
def test_the_page_draws_its_figures(planted_episodes, planted, settings):
    engines = EXACT | {"sigmoid": (planted.sigmoid, 1.2)}
    made = build(planted_episodes(engines), replace(settings, question=("episodes",)), "A chain", "", {})
    assert {"magnitudes", "recurrence"} <= made.figures.keys()
    come = "(at times not told from those of|at more regular times than|in clusters, unlike) a Poisson process. "
    assert re.match(rf"Large events \(M ≥ [-\d.]+, exact\) come {come}", made.figures["recurrence"].caption)
    assert made.figures["magnitudes"].caption.startswith("Lines: power laws, each on its range. Above: ")
    assert "magnitudes" in build(planted_episodes(EXACT), settings, "A chain", "", {}).figures


def test_a_catalogue_has_the_columns_of_catalogues():
    table = pd.DataFrame({
        "member_id": ["a", "a", "b"], "start": [1.5, 2.5, 0.25], "end": [2.0, 3.0, 1.0], "size": [1, 2, 3],
        "moment": [10.0, 0.0, -0.1], "first_block": [7, 8, 9],
    })  # fmt: skip
    found = as_catalogue(table)
    of_obspy = ["id", "time", "lat", "lon", "dep", "magtype", "mag"]
    assert list(found) == [*of_obspy, "member_id", "origin", "nucleation", "moment", "extent", "duration"]
    assert found["duration"].tolist() == [0.5, 0.75]
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
