"""Shares of what runs settle on: planted ones come back, with intervals in closed form; nobody else counts."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm

from stickslip.analysis import Data, Study, build
from stickslip.analysis.ensemble import Recorded
from stickslip.analysis.models import attractors
from stickslip.analysis.models.attractors import Cycle, Range, alike, plane, ranges
from stickslip.analysis.questions.runs.attractor_figures import LOOKS, WORDS
from stickslip.analysis.questions.runs.attractors import answer
from stickslip.analysis.report.formats import environment
from stickslip.sim.attractors.result import Kind

pytestmark = pytest.mark.usefixtures("undrawn")

SERIES = (np.array([0.0, 150.0]), np.array([3, 2]))
KINDS = 3 * ["sliding"] + 5 * ["periodic"] + ["irregular", "undecided"]
PERIODS = [None] * 3 + [2.0, 4.0, 6.0, 7.0, 9.0] + [None] * 2


#: Numbers of a run that a record of attractors keeps.
NUMBERS = ("period", "multiplier", "exits_per_period", "events_per_period")


@pytest.fixture
def planted_runs(planted):
    """An ensemble of rows of members, with numbers and lists of the record among their columns."""

    def of(rows):
        table = pd.DataFrame([planted.member(f"m{k}", 0, n=1) | {"attractor_reason": None, "exits_block": 0} | row
                              for k, row in enumerate(rows)])  # fmt: skip
        names = table["member_id"].tolist()
        recorded = {name: Recorded(name, {one: row.get(name) for one, row in zip(names, rows, strict=True)})
                    for name in NUMBERS}  # fmt: skip
        kept = {"section_z", "section_w", "start_z", "start_w", "exits_z"}
        lists = {name: {one: np.array(row[name]) for one, row in zip(names, rows, strict=True) if name in row}
                 for name in kept}  # fmt: skip
        table = table.drop(columns=[name for name in (*NUMBERS, *kept) if name in table])
        ran = [one for one, row in zip(names, rows, strict=True) if row.get("outcome") != "failed"]
        return Data(table, dict.fromkeys(ran, SERIES), recorded=recorded, lists=lists)

    return of


@pytest.fixture
def data(planted_runs):
    def of(kinds=KINDS, periods=PERIODS, **changes):
        rows = [{"matrix": k, "n": 4, "attractor": kind, "period": period} | changes
                for k, (kind, period) in enumerate(zip(kinds, periods, strict=True))]  # fmt: skip
        failed = {"matrix": len(rows), "n": 4, "attractor": None, "outcome": "failed", "reason": "planted"}
        return planted_runs([*rows, failed])

    return of


Z = norm.ppf(0.975)


def wilson(has, of):
    """The two shares p at which |has / of - p| = Z sqrt(p (1 - p) / of)."""
    a, b, c = 1 + Z**2 / of, -(2 * has / of + Z**2 / of), (has / of) ** 2
    return np.sort(np.roots([a, b, c]))


def test_shares_and_periods(data, settings):
    found = answer(Study(data(), settings))
    rows = {row["attractor"]: row for row in found.facts["rows"]}
    assert {kind: (row["n_runs"], row["of"]) for kind, row in rows.items()} == {
        "sliding": (3, 10), "periodic": (5, 10), "irregular": (1, 10), "undecided": (1, 10),
    }  # fmt: skip
    for row in rows.values():
        assert row["share"] == row["n_runs"] / 10
        np.testing.assert_allclose([row["share_low"], row["share_high"]], wilson(row["n_runs"], 10), rtol=1e-9)
    assert [rows["periodic"][f"period_{one}"] for one in ("least", "median", "most")] == [2.0, 6.0, 9.0]
    assert rows["sliding"]["period_median"] is None
    table = found.tables["attractors"]
    assert table["n_runs"].sum() == 10
    assert table["period_median"].notna().sum() == 1


def test_runs_of_one_matrix_are_no_independent_trials(planted, data, settings):
    """Two matrices of ten runs each, all of one kind: the interval is that of two trials."""
    whole = data(10 * ["rest"] + 10 * ["periodic"], 20 * [None])
    whole = replace(whole, table=whole.members.assign(matrix=[0] * 10 + [1] * 10 + [2]))
    rows = answer(Study(whole, settings)).facts["rows"]
    np.testing.assert_allclose([rows[0]["share_low"], rows[0]["share_high"]], wilson(1, 2), rtol=1e-9)


def test_it_is_asked_where_attractors_are_kept(data, settings):
    kept = data()
    assert answer(Study(Data(kept.members.drop(columns="attractor"), kept.series), settings)) is None
    asking = replace(settings, question=("attractors",))
    assert answer(Study(Data(kept.members.drop(columns="attractor"), kept.series), asking)).lack == "no record"
    smoothed = data([None] * 10)
    assert answer(Study(smoothed, settings)).lack == "none exact"


def test_it_leads_the_page(data, settings):
    page = build(data(), settings, "Planted", "", {})
    said = page.headline[1]
    assert "Of 10 runs, 30.0% slide steadily (10.8% to 60.3%), 50.0% settle on a cycle (23.7% to 76.3%)" in said
    assert "10.0% stay irregular" in said
    assert "What do runs settle on?" in page.html


def test_every_kind_of_attractor_has_words_and_a_look():
    assert get_args(Kind) == attractors.KINDS
    does = environment("stickslip.analysis.report").get_template("attractors.html").module.does
    for kind in attractors.KINDS:
        assert WORDS[kind] in does(kind).strip()
        assert kind in LOOKS


@pytest.mark.parametrize("reason", ["no record", "none exact"])
def test_words_of_what_is_lacking(reason):
    module = environment("stickslip.analysis.report").get_template("attractors.html").module
    assert module.lack({}, reason).strip()


# ---------------------------------------------------------------------------------------------- basins


def cycle(period, w, exits=1, z=0.0, multiplier=0.5):
    return {
        "attractor": "periodic", "period": period, "exits_per_period": exits, "events_per_period": 2 * exits,
        "multiplier": multiplier, "section_z": [z], "section_w": [w],
    }  # fmt: skip


SLIDES = {"attractor": "sliding"}


def started(z, w, **settled):
    return {"start_z": [z], "start_w": [w], "z0": z, "w0": w} | settled


@pytest.fixture
def basin(planted_runs, rng):
    """Random starts: those of |z| < 1 slide, those above go to a fast cycle, those below to a slow one."""
    starts = rng.uniform(-2, 2, (400, 2))
    ends = [SLIDES if abs(z) < 1 else cycle(*((3.0, 0.5) if z > 0 else (7.0, 0.9)), 2) for z, _ in starts]
    rows = [started(z, w, start_draw=k, drawn="z = uniform(-2, 2); w = uniform(-2, 2)") | end
            for k, ((z, w), end) in enumerate(zip(starts, ends, strict=True))]  # fmt: skip
    return planted_runs(rows), starts


def test_cycles_of_one_system_are_told_apart_with_their_shares(basin, settings):
    data, starts = basin
    found = answer(Study(data, settings))
    rows = {(row["attractor"], row["period_median"]): row for row in found.facts["rows"]}
    fast, slow = (starts[:, 0] >= 1).sum(), (starts[:, 0] <= -1).sum()
    assert rows["periodic", 3.0]["n_runs"] == fast
    assert rows["periodic", 7.0]["n_runs"] == slow
    assert {row["cycle"] for row in rows.values()} == {None, 1, 2}
    row = rows["periodic", 7.0]
    np.testing.assert_allclose([row["share_low"], row["share_high"]], wilson(slow, 400), rtol=1e-9)
    page = build(data, replace(settings, question=("attractors",)), "Planted", "", {}).html
    assert "Of 400 starts, " in page
    assert "settle on the cycle of period 3.000" in page


def test_the_basin_has_a_mark_for_each_start_and_shares_in_its_legend(basin, settings):
    data, starts = basin
    found = answer(Study(data, settings))
    (ax,) = found.figures["basin_of_attractors"]().axes
    shown = {len(line.get_xdata()): line for line in ax.lines}
    z = starts[:, 0]
    assert set(shown) == {(abs(z) < 1).sum(), (z >= 1).sum(), (z <= -1).sum()}
    marks = {line.get_marker() for line in ax.lines}
    assert len(marks) == 3
    (sliding,) = [line for line in ax.lines if line.get_color() == "#0072B2"]
    assert sorted(sliding.get_xdata()) == sorted(z[abs(z) < 1])
    words = [text.get_text() for text in ax.figure.legends[0].get_texts()]
    low, high = 100 * wilson((abs(z) < 1).sum(), 400)
    assert f"slide steadily: {25 * (abs(z) < 1).mean() * 4:.1f}% ({low:.1f} to {high:.1f})" in words
    assert any(one.startswith("cycle, period 7, 2 exits: ") for one in words)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("displacement z at start", "velocity w at start")


def test_starts_on_a_grid_are_cells_of_one_picture(planted_runs, settings):
    """Each start is swept, so that it is a group elsewhere; here all are one."""
    z, w = np.linspace(-1, 1, 5), np.linspace(0, 3, 4)
    rows = [started(a, b) | (SLIDES if a + b > 1 else cycle(3.0, 0.5)) for a in z for b in w]
    found = answer(Study(planted_runs(rows), settings))
    assert len(found.facts["groups"]) == 1
    assert found.facts["basin"]["is_grid"]
    (ax,) = found.figures["basin_of_attractors"]().axes
    mesh = ax.collections[0]
    slides = np.add.outer(w, z) > 1
    assert (mesh.get_array().reshape(4, 5) == np.where(slides, 0, 1)).all()
    # cells are centred on the starts; a line runs between cells that differ
    assert ax.dataLim.intervalx == pytest.approx([-1.25, 1.25])
    assert len(ax.collections[1].get_segments()) == (np.diff(slides, axis=0) != 0).sum() + np.diff(slides).sum()
    assert found.facts["along"] is None


def test_starts_along_a_line_are_a_strip(planted_runs, settings):
    rows = [started(a, 0.5) | (SLIDES if a < 0.5 else cycle(3.0, 0.5)) for a in (0.0, 1.0, 2.0, 4.0)]
    found = answer(Study(planted_runs(rows), settings))
    (ax,) = found.figures["basin_of_attractors"]().axes
    bars = sorted((bar.get_x(), bar.get_x() + bar.get_width()) for bar in ax.patches)
    assert bars == [(-0.5, 0.5), (0.5, 1.5), (1.5, 3.0), (3.0, 5.0)]
    assert ax.get_xlabel() == "displacement z at start"


def test_what_varies_of_the_starts(rng):
    one, other = rng.normal(size=(2, 6))
    belt = np.full((6, 2), -0.1)
    found = plane(np.column_stack([one, other]), belt)
    assert found.names == ("displacement z of block 0", "displacement z of block 1")
    assert (found.points == np.column_stack([one, other])).all()
    assert plane(np.column_stack([one, one]), belt).names == ("displacement z of all blocks",)
    assert plane(np.column_stack([one, 0 * one]), np.column_stack([0 * one, one])).names == (
        "displacement z of block 0 and velocity w of block 1",
    )
    assert plane(rng.normal(size=(6, 3)), np.zeros((6, 3))) is None
    assert plane(np.zeros((6, 2)), belt) is None


def test_cycles_are_one_wherever_they_drift(rng):
    def at(shift, period=2.0, events=4):
        return Cycle(events, 2, period, np.array([0.1, 0.5]) + shift, np.array([-0.2, 0.3]))

    assert alike([at(0.0, 5.0), at(0.0), at(70.0), at(0.0, events=6), at(-3.0)]) == [2, 1, 1, 3, 1]
    assert alike([]) == []


# ---------------------------------------------------------------------------------------------- along a key


@pytest.fixture
def swept(planted_runs):
    """Five starts at each of twelve belts: a cycle of one exit, then of two, none decided at 8, then steady sliding.

    The multiplier of the first comes to one at v = 4.5, by a line.
    """

    def at(v, k):
        if v <= 4:
            return cycle(3.0, 0.1, 1, multiplier=0.1 + v / 5) | {"exits_z": [0.5]}
        if v <= 7:
            return cycle(6.0, 0.1, 2) | {"exits_z": [0.5 + v / 10, 0.5 - v / 10]}
        if v == 8:
            return {"attractor": "undecided", "attractor_reason": f"few events, at {v}; lengthen the run"}
        return SLIDES

    return planted_runs([
        started(0.1 * k, 0.0, start_draw=k, drawn="z = uniform(0, 1)", belt_speed=float(v)) | at(v, k)
        for v in range(1, 13) for k in range(5)
    ])  # fmt: skip


def test_where_along_a_key_attractors_change(swept, settings):
    found = answer(Study(swept, settings))
    told = [(row["first"], row["last"], row["on"]) for row in found.facts["along"]["lines"][0]["told"]]
    assert told == [("1", "7", ("periodic",)), ("9", "12", ("sliding",))]
    ranges = found.tables["attractor_ranges"]
    assert ranges["attractors"].tolist() == ["periodic, 1 exit a period", "periodic, 2 exits a period", "sliding"]
    np.testing.assert_allclose(ranges["least_share"].astype(float), wilson(5, 5)[0], rtol=1e-9)  # of five starts
    (change,) = found.facts["along"]["lines"][0]["changes"]
    assert (change["before"], change["after"], change["last"], change["first"]) == ("1", "2", "4", "5")
    assert change["at"] == pytest.approx(4.5)
    page = build(swept, replace(settings, question=("attractors",)), "Planted", "", {})
    assert page.headline[1] == (
        "Up to belt_speed = 7 all 35 runs settle on a cycle (95%: at least 56.6% of such starts); from belt_speed = 9"
        " on all 20 runs slide steadily (95%: at least 56.6% of such starts). The cycle's exits a period go from 1 to"
        " 2 between belt_speed = 4 and 5; its multiplier comes to one at 4.5000."
    )
    assert found.facts["why_undecided"] == [("few events, at 8", 5)]


def test_the_figures_along_a_key(swept, settings):
    found = answer(Study(swept, settings))
    (ax,) = found.figures["attractors"]().axes
    assert [bar.get_height() for bar in ax.containers[0]] == [0.0] * 8 + [1.0] * 4  # sliding
    above, middle, below = found.figures["bifurcation"]().axes
    (line,) = above.lines
    expected = [(v, 0.5) for v in range(1, 5)] + [(v, 0.5 + s * v / 10) for v in range(5, 8) for s in (1, -1)]
    np.testing.assert_allclose(sorted(zip(*line.get_data(), strict=True)), sorted(expected))  # five runs, one dot
    np.testing.assert_allclose(middle.lines[0].get_ydata(), [0.3, 0.5, 0.7, 0.9, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(below.lines[0].get_ydata(), [3.0] * 4 + [6.0] * 3)


def test_ranges_bridge_what_is_not_known_only_between_alikes():
    assert ranges([(), ("a",), (), ("a",), (), ("b",), ("a", "b")]) == [
        Range(1, 3, ("a",)), Range(5, 5, ("b",)), Range(6, 6, ("a", "b"))
    ]  # fmt: skip


# ---------------------------------------------------------------------------------------------- over two keys


@pytest.fixture
def over_two(planted_runs):
    """Five starts at each of 5 belts and 3 static frictions: a cycle up to v = 1, 2, 3, then steady sliding."""

    def at(v, k):
        return cycle(3.0, 0.1, 1) | {"exits_z": [0.5]} if v <= k + 1 else SLIDES | {"section_z": [0.0]}

    return planted_runs([
        started(0.1 * s, 0.0, start_draw=s, drawn="z = uniform(0, 1)", belt_speed=float(v), static=1.2 + 0.2 * k)
        | at(v, k) for v in range(1, 6) for k in range(3) for s in range(5)
    ])  # fmt: skip


@pytest.mark.drawn
def test_the_page_covers_each_value_of_a_second_key(over_two, settings):
    page = build(over_two, replace(settings, question=("attractors",)), "Planted", "", {})
    said = page.headline[1]
    assert said.startswith(
        "The belt_speed up to which all runs settle on a cycle rises from 1 at static = 1.2 to 3 at static = 1.6. "
        "The belt_speed from which on all runs slide steadily rises from 2 at static = 1.2 to 4 at static = 1.6. "
    )
    assert said.endswith("all runs slide steadily at 9 and settle on a cycle at 6.")
    ranges = page.tables["attractor_ranges"]
    assert ranges[["static", "first", "last"]].to_numpy().tolist() == [
        [1.2, "1", "1"], [1.2, "2", "5"], [1.4, "1", "2"], [1.4, "3", "5"], [1.6, "1", "3"], [1.6, "4", "5"],
    ]  # fmt: skip


def test_each_of_few_settings_has_its_own_sentences_and_pictures(planted_runs, settings):
    """The first n turns at v = 1, 2, 3 of the three static frictions, the second at 2, 3, 4."""
    data = planted_runs([
        started(0.1 * s, 0.0, start_draw=s, drawn="z = uniform(0, 1)", belt_speed=float(v), static=1.2 + 0.2 * k, n=n)
        | (cycle(3.0, 0.1, 1) | {"exits_z": [0.5]} if v <= k + n else SLIDES | {"section_z": [0.0]})
        for n in (1, 2) for v in range(1, 6) for k in range(3) for s in range(5)
    ])  # fmt: skip
    said = build(data, replace(settings, question=("attractors",)), "Planted", "", {}).headline[1]
    for n in (1, 2):
        up_to = f"At n = {n}, exact, the belt_speed up to which all runs settle on a cycle rises from {n} at static"
        on = f"There the belt_speed from which on all runs slide steadily rises from {n + 1} at static = 1.2"
        assert f"{up_to} = 1.2 to {n + 2} at static = 1.6. {on} to {n + 3} at static = 1.6." in said
    figures = answer(Study(data, settings)).figures
    assert [name for name in figures if name.startswith("attractors")] == ["attractors", "attractors_2"]
    assert len([name for name in figures if name.startswith("bifurcation")]) == 6


def test_a_line_that_does_the_same_throughout_turns_nowhere(planted_runs, settings):
    """A cycle up to v = 1 and 3, at the third static friction at all belts."""
    data = planted_runs([
        started(0.1 * s, 0.0, start_draw=s, drawn="z = uniform(0, 1)", belt_speed=float(v), static=1.2 + 0.2 * k)
        | (cycle(3.0, 0.1, 1) | {"exits_z": [0.5]} if v <= last else SLIDES | {"section_z": [0.0]})
        for v in range(1, 6) for k, last in enumerate((1, 3, 5)) for s in range(5)
    ])  # fmt: skip
    said = build(data, replace(settings, question=("attractors",)), "Planted", "", {}).headline[1]
    assert said.startswith(
        "The belt_speed up to which all runs settle on a cycle rises from 1 at static = 1.2 to 3 at static = 1.4; at "
        "1 of the 3 values of static they do so throughout. The belt_speed from which on all runs slide steadily "
        "rises from 2 at static = 1.2 to 4 at static = 1.4; at 1 of the 3 values of static there is none. "
    )


def test_the_figures_over_two_keys(over_two, settings):
    figures = answer(Study(over_two, settings)).figures
    assert [name for name in figures if name != "basin_of_attractors"] == [
        "attractors", "bifurcation", "bifurcation_2", "bifurcation_3",
    ]  # fmt: skip
    (ax,) = figures["attractors"]().axes
    cells = np.ma.filled(ax.collections[0].get_array(), -1).reshape(3, 5)
    assert [len(set(row[: k + 1])) for k, row in enumerate(cells)] == [1, 1, 1]
    assert [(row[k + 1 :] != row[0]).all() for k, row in enumerate(cells)] == [True] * 3
    above, *_ = figures["bifurcation"]().axes
    drawn = {tuple(line.get_xdata()) for line in above.lines}
    assert drawn == {(1.0,), (2.0, 3.0, 4.0, 5.0)}  # exits of the cycle, and the slides


def test_what_is_certain_to_slide_for_ever_has_collapsed(over_two, settings):
    quiet = {name: (np.array([0.0, 1.0]), np.array([1, 0])) for name in over_two.members["member_id"]}
    study = Study(replace(over_two, series=quiet), settings)
    kinds = study.data.members.set_index("member_id")["attractor"]
    fates = set(zip(kinds, study.motion.fates, strict=True))
    assert fates == {("sliding", "collapsed"), ("periodic", "quiet")}


def test_values_that_differ_in_their_seventh_digit_are_told_apart(planted_runs, settings):
    belts = (3.210571, 3.210572, 3.210573)
    data = planted_runs([
        started(0.1 * s, 0.0, start_draw=s, drawn="z = uniform(0, 1)", belt_speed=v)
        | (SLIDES | {"section_z": [0.0]} if v == belts[-1] else cycle(3.0, 0.1, 1) | {"exits_z": [0.5]})
        for v in belts for s in range(5)
    ])  # fmt: skip
    page = build(data, replace(settings, question=("attractors",)), "Planted", "", {})
    assert page.headline[1].startswith("Up to belt_speed = 3.210572 all 10 runs settle on a cycle (")
    assert "; at belt_speed = 3.210573 all 5 runs slide steadily (" in page.headline[1]
    assert page.tables["fates"]["n_runs"].tolist() == [5, 5, 5]
    assert len(page.tables["groups"]) == 3


def test_over_two_keys_runs_that_are_undecided_are_not_among_all(planted_runs, settings):
    data = planted_runs([
        started(0.1 * s, 0.0, start_draw=s, drawn="z = uniform(0, 1)", belt_speed=float(v), static=1.2 + 0.2 * k)
        | (cycle(3.0, 0.1, 1) | {"exits_z": [0.5]} if s == 0 else dict(attractor="undecided", attractor_reason="few"))
        for v in (1, 2) for k in (0, 1) for s in range(5)
    ])  # fmt: skip
    page = build(data, replace(settings, question=("attractors",)), "Planted", "", {})
    assert "all runs that are decided settle on a cycle" in page.headline[1]
    assert "all runs settle" not in page.headline[1]
