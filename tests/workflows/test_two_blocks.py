"""The chart of two blocks: closed forms of its map, cycles, claims judged by what was measured."""

import re
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from stickslip.workflows.gallery import load_chart
from stickslip.workflows.gallery.charts import runner
from stickslip.workflows.gallery.field import two_blocks
from stickslip.workflows.gallery.field.two_blocks import End, Measured, Pair, Together, Unequal
from tests.independent import Case, follow

TINY = """
chart = "two_blocks"
pairs = 6
episodes = 60
tried = 2
unequal_pairs = 2
"""


# the map


def test_blocks_alike_are_one_block(rng):
    """Its period by the closed form of one block, K = 1, R = 0."""
    pair = Pair(rng.uniform(0.1, 10.0), rng.uniform(0.1, 1.0), rng.uniform(0.01, 0.2))
    quake, a = pair.next(0.0), pair.drop / pair.speed
    assert quake.size == 2
    assert abs(quake.after) < 1e-13
    assert quake.wait == pytest.approx(2 * a + 2 * (np.pi - np.arctan(a)), abs=1e-9)


def test_a_block_that_slips_alone_swings_about_its_rest(rng):
    """Its own frequency is sqrt(1 + k), and it slips 2 drop / (1 + k) on a belt that stands still."""
    k, drop, speed = rng.uniform(0.1, 1.0), rng.uniform(0.1, 0.5), 1e-7
    pair = Pair(k, drop, speed)
    start = 0.8 * pair.widest
    quake = pair.next(start)
    assert quake.size == 1
    assert abs(quake.after - start) == pytest.approx(2 * drop / (1 + k), abs=1e-5)
    assert np.sign(quake.after - start) == -np.sign(start)  # who is stretched more goes back


def test_the_map_is_odd(rng):
    pair = Pair(rng.uniform(0.1, 10.0), 0.3, 1e-4)
    for difference in rng.uniform(-1, 1, 5) * pair.widest:
        one, other = pair.next(difference), pair.next(-difference)
        assert other.after == pytest.approx(-one.after, abs=1e-9)
        assert (one.size, other.wait) == (other.size, pytest.approx(one.wait, abs=1e-4))


def test_the_homogeneous_cycle_grows_by_the_closed_form(rng):
    found = [two_blocks.homogeneous(Pair(k, rng.uniform(0.1, 1.0), 1e-4)) for k in rng.uniform(0.2, 10.0, 30)]
    apart = [one.multiplier / one.closed - 1 for one in found if one.closed > 1000]
    assert len(apart) > 10
    assert np.median(np.abs(apart)) < 0.02
    assert np.max(np.abs(apart)) < 0.1


@pytest.mark.parametrize("m", [2, 3, 4])
def test_it_grows_little_only_where_the_difference_swings_whole_times(m):
    k, drop, speed = (m * m - 1) / 2, 0.3, 1e-4
    assert two_blocks.multiplier(k, drop, speed) < 1e-8
    assert two_blocks.homogeneous(Pair(k, drop, speed)).multiplier < 100
    assert two_blocks.homogeneous(Pair(1.1 * k, drop, speed)).multiplier > 1000


def test_on_a_belt_that_stands_still_a_difference_becomes_its_root():
    k, drop = 1.0, 0.3
    omega = np.sqrt(1 + 2 * k)
    for difference in (1e-5, 1e-7):
        after = Pair(k, drop, 1e-8).next(difference).after
        root = np.sqrt(2 * drop / k * difference) * abs(np.sin(np.pi * omega))
        assert abs(after) == pytest.approx(root, rel=0.01)


def test_an_orbit_is_that_of_a_method_that_shares_no_code(rng):
    """Two episodes by the independent engine, from a start on a fast belt."""
    pair = Pair(rng.uniform(0.2, 8.0), 0.3, 0.02)
    start = rng.uniform(-0.5, 0.5) * pair.widest
    first, second = islice(pair.orbit(start), 2)
    z = 0.5 * start * np.array([1.0, -1.0])
    z += pair.speed - (pair.system.static + pair.system.stiffness @ z).min()
    case = Case.of(pair.system.stiffness, 0.0, 1.0, -pair.speed, z, -pair.speed, 1 + pair.drop)
    for quake, t in ((first, 1 + first.wait - 1e-3), (second, 1 + first.wait + second.wait - 1e-3)):
        found = follow(case, t)  # until just before the next one
        assert found.z[0] - found.z[1] == pytest.approx(quake.after, abs=1e-8)


# cycles


@pytest.mark.parametrize(
    ("coupling", "start", "kind", "sizes"),
    [(0.3, 0.2, "alone in turns", "1, 1"), (2.3, 0.18, "mirrored", "2, 2"), (6.0, 0.029, "the same", "2")],
)
def test_each_kind_of_cycle(coupling, start, kind, sizes):
    pair = Pair(coupling, 0.3, 1e-4)
    found = two_blocks.end(pair, start, 100, 0.01)
    assert (found.kind, found.sizes, found.n_cycle) == (kind, sizes, len(sizes.split(", ")))
    assert found.survives is (kind != "alone in turns")
    if kind == "alone in turns":
        assert found.multiplier == pytest.approx(1.0, abs=1e-6)
    else:
        assert found.multiplier < 0.9
    quakes = two_blocks._cycle(pair, start, 100)
    assert sum(quake.wait for quake in quakes) == found.period
    belt = found.period * pair.speed  # a cycle slips what the belt moves: no difference of stretch is left over
    assert quakes[-1].after == pytest.approx(quakes[0].before, abs=1e-7)
    assert 0 < belt < 2 * 2 * (1 + pair.drop)


def test_the_exponent_of_a_cycle_is_not_asked_for():
    assert two_blocks.chaos(Pair(1.0, 0.3, 1e-4), 0.3).n_cycle == 2
    found = two_blocks.chaos(Pair(0.694635, 0.3, 1e-4, 2.25), 0.3)
    assert found.n_cycle is None
    assert found.low < found.exponent < found.high


# claims and page

END = End(1.0, 0.5, "alone in turns", 2, 0.4, "1, 1", 8000.0, 1.0, False)


def plain(**changes):
    ends = [END] * 40 + [replace(END, kind="the same", n_cycle=1, sizes="2", multiplier=0.3, survives=True)] * 60
    found = Measured([Together(1.0, 500.0, 501.0)] * 100, ends, [Unequal(1.0, 2)] * 10)
    return replace(found, **changes)


def verdicts(**changes):
    return {claim.__name__: claim(plain(**changes))["verdict"] for claim in two_blocks._CLAIMS}


def test_claims_hold_where_they_should():
    assert verdicts() == {
        "unstable": "reproduced", "no_smoothing": "reproduced", "two_cycles": "reproduced",
        "structurally_unstable": "reproduced", "only_cycles": "reproduced", "chaos_if_unequal": "cannot be told",
    }  # fmt: skip


@pytest.mark.parametrize(("claim", "changes", "verdict"), [
    ("unstable", {"homogeneous": [Together(1.5, 0.5, 0.5)] * 100}, "not reproduced"),
    ("unstable", {"homogeneous": [Together(1.0, 5.0, 5.0)] * 10}, "cannot be told"),
    ("no_smoothing", {"ends": [replace(END, kind="together")] * 100}, "not reproduced"),
    ("two_cycles", {"ends": [END] * 100}, "cannot be told"),  # of one kind none was seen
    ("two_cycles", {"ends": [replace(END, n_cycle=5, kind="longer")] * 100}, "not reproduced"),
    ("structurally_unstable", {"ends": [replace(END, survives=True)] * 100}, "not reproduced"),
    ("structurally_unstable", {"ends": [replace(END, survives=None)] * 100}, "cannot be told"),
    ("only_cycles", {"ends": [End(1.0, 0.5, "none found")] * 100}, "not reproduced"),
    ("chaos_if_unequal", {"unequal": [Unequal(1.0, 2)] * 10 + [Unequal(1.0, None, 0.2, 0.1, 0.3)] * 5}, "reproduced"),
])  # fmt: skip
def test_a_claim_is_judged_by_what_was_measured(claim, changes, verdict):
    assert verdicts(**changes)[claim] == verdict


def test_the_page(tmp_path):
    file = tmp_path / "tiny.toml"
    file.write_text(TINY)
    scene = load_chart(file)
    report = runner.report(scene, scene.measure(lambda line: None))
    assert report.html.count('class="verdict ') == len(report.tables["claims"]) == 6
    assert not re.search(r">\s*(nan|inf|None)\s*<", report.html)
    assert set(report.tables) == {"claims", "ends", "homogeneous", "unequal"}
    assert len(report.tables["ends"]) == 6
    assert report.headline[1].startswith("Of 6 claims ")
