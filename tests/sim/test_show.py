"""What a notebook shows of a run: short words, tables, drawings on the axes it is given."""

from functools import cache

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.sparse
from matplotlib.figure import Figure

from stickslip.sim import EventSeries, Samples, System, draw_system, simulate
from stickslip.sim.runs import show

SYSTEM = draw_system("antisymmetric", n=30, seed=0)


@cache
def kept():
    """A run; none is made while tests are collected, which would compile in one process."""
    return simulate(SYSTEM, -0.7, -0.4, 20.0, t_eval=[0.0, 10.0, 20.0])


#: Block 0 sticks, slips right at 1, sticks at 3; block 1 slips left to the end, 4.
PLANTED = EventSeries(
    t=np.array([1.0, 3.0]),
    block=np.array([0, 0], dtype=np.int32),
    mode=np.array([1, 0], dtype=np.int8),
    initial_mode=np.array([0, -1], dtype=np.int8),
    t_start=0.0,
    t_end=4.0,
)


def test_words_are_one_short_line():
    run = kept()
    for thing in SYSTEM, run, run.events, run.samples, run.stats, Samples.blank(np.empty(0), 0), PLANTED:
        assert "\n" not in repr(thing)
        assert len(repr(thing)) < 90
        assert repr(thing).startswith(type(thing).__name__)
    assert repr(run.samples) == "Samples(n=30, 3 times on [0, 20])"
    assert f"{len(run.events)} events" in repr(run)


def cells(thing):
    import xml.etree.ElementTree as ET

    table = ET.fromstring(thing._repr_html_().replace("colspan=2", 'colspan="2"'))  # well formed
    return {row.find("th").text: row.find("td").text for row in next(table.iter("tbody"))}


def test_tables():
    assert cells(PLANTED) == {"events": "2", "entries": "1", "exits": "1", "crossings": "0"}
    assert cells(kept())["outcome"] == "finished at t = 20"
    assert int(cells(kept())["n_stick at the end"]) == kept().n_stick(20.0)
    sparse = System(stiffness=scipy.sparse.eye_array(3, format="csr"), damping=[1.0, 2.0, 3.0])
    assert cells(sparse) == {
        "stiffness K": "|K_ij| up to 1, sparse with 3 entries",
        "damping R": "1 to 3",
        "friction mu": "1",
        "belt speed v": "-0.2",
    }
    assert "<b>" not in show.table("<b>", {"<b>": "<b>"})


def test_a_run_shows_its_picture(clean):
    import base64

    _, _, image = kept()._repr_html_().partition("data:image/png;base64,")
    assert base64.b64decode(image.partition('"')[0]).startswith(b"\x89PNG")
    assert '<img alt="n_stick and modes"' in kept()._repr_html_()


@pytest.fixture
def clean():
    """Nothing of pyplot's is touched but the figures that a test says."""
    before, settings = plt.get_fignums(), dict(matplotlib.rcParams)
    yield
    assert dict(matplotlib.rcParams) == settings
    assert plt.get_fignums() == before


@pytest.mark.parametrize("shown", [kept, lambda: kept().events], ids=["run", "events"])
def test_axes_given_are_drawn_on_and_returned(shown, clean):
    figure = Figure()
    left, right = figure.subplots(1, 2)
    assert shown().plot(ax=right) is right
    assert not left.has_data()
    assert right.has_data()
    figure.savefig("/dev/null", format="png")


@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (1, 2)])
def test_the_legend_covers_nothing(shape, clean):
    """It is inside the axes, over the last block, so that it covers neither blocks nor a neighbour's labels."""
    figure = Figure()
    ax = kept().events.plot(ax=figure.subplots(*shape, squeeze=False)[-1, 0])
    figure.savefig("/dev/null", format="png")
    box, axes = ax.get_legend().get_window_extent(), ax.get_window_extent()
    assert axes.x0 <= box.x0 < box.x1 <= axes.x1
    assert ax.transData.transform((0.0, kept().events.n - 0.5))[1] <= box.y0 + 1.0  # a pixel
    assert box.y1 <= axes.y1 + 1.0
    labels = [label.get_text() for label in ax.get_yticklabels() if label.get_text()]
    assert max(map(int, labels)) < kept().events.n


@pytest.mark.parametrize("shown", [kept, lambda: kept().events], ids=["run", "events"])
def test_without_axes_a_new_figure_is_drawn(shown, clean):
    mine, _ = plt.subplots()
    ax = shown().plot()
    assert ax.figure is not mine
    assert plt.gcf() is ax.figure
    plt.close(ax.figure)
    plt.close(mine)


def test_the_steps_are_n_stick(clean):
    ax = kept().plot(ax=Figure().subplots(), color="black", label="mine")
    (line,) = ax.lines
    assert (line.get_label(), line.get_color()) == ("mine", "black")
    t, n_stick = line.get_data()
    np.testing.assert_array_equal(n_stick, kept().n_stick(t))
    assert t[-1] == 20.0


def test_rectangles_are_the_stays(clean):
    """Area and place of each mode, by hand from the planted events."""
    ax = PLANTED.plot(ax=Figure().subplots())
    found = {
        patch.get_label(): [[*one.min(axis=0), *one.max(axis=0)] for one in patch.get_path().to_polygons()]
        for patch in ax.patches
    }
    assert found == {
        "sticks": [[0.0, -0.5, 1.0, 0.5], [3.0, -0.5, 4.0, 0.5]],
        "slips right": [[1.0, -0.5, 3.0, 0.5]],
        "slips left": [[0.0, 0.5, 4.0, 1.5]],
    }
    area = sum((right - left) * (top - low) for boxes in found.values() for left, low, right, top in boxes)
    assert area == PLANTED.n * (PLANTED.t_end - PLANTED.t_start)
