"""Figures show the data they are given, all of it, and are the same bytes twice."""

import numpy as np
import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG

from stickslip.analysis.report import change_figures, figures
from stickslip.analysis.stats.compare import DIFFERENT, OPEN

SIZES = [
    {
        "definition": "events", "dt": None, "size": size, "n_cascades": count, "share": count / 10,
        "share_low": None if count < 3 else count / 20, "share_high": None if count < 3 else count / 5,
        "share_fit": 0.5**size, "share_chance": 0.4**size,
    }
    for size, count in ((1, 7), (2, 0), (3, 3))
]  # fmt: skip


def law_row(group, definition, dt, gamma, half, gamma0):
    low, high = (None, None) if half is None else (gamma - half, gamma + half)
    return {
        "group": group, "definition": definition, "dt": dt, "gamma": gamma, "gamma_low": low, "gamma_high": high,
        "gamma0": gamma0,
    }  # fmt: skip


LAW = [
    law_row("a", "events", None, 0.6, 0.1, 0.69),
    law_row("a", "drop", 0.5, 1.2, None, None),
    law_row("b", "events", None, None, None, None),
]


def draws(*ends):
    return [(f"matrix {k}", np.array([0.0, 1.0]), np.array([3, 5]), end) for k, end in enumerate(ends)]


def trajectories():
    return figures.trajectories([("short", draws(30.0)), ("long", draws(1000.0, 400.0))], t_burn=600.0)


def distributions():
    return figures.distributions(SIZES, {"events": "events", "drop": "drop, dt = 1"})


def forest():
    return figures.forest(LAW)


def test_trajectories_show_every_run_to_its_end():
    figure = trajectories()
    assert all(ax.get_xlim() == (0, 1000) for ax in figure.axes if ax.axison)
    drawn = figure.axes[2].lines[0]
    assert drawn.get_drawstyle() == "steps-post"  # n_stick[k] holds on [t[k], t[k+1])
    assert drawn.get_xdata().tolist() == [0, 1, 1000]
    assert drawn.get_ydata().tolist() == [3, 5, 5]


def test_trajectories_fit_into_their_row():
    """n_stick of the second draw rises higher than that of the first, whose axis it shares."""
    low, high = (("", np.array([0.0, 1.0]), np.array([0, top]), 10.0) for top in (5, 50))
    figure = figures.trajectories([("a", [low, high])], t_burn=1.0)
    assert all(ax.get_ylim()[0] == 0 and ax.get_ylim()[1] > 50 for ax in figure.axes)


def test_one_size_alone_has_one_tick():
    figure = figures.distributions(SIZES[:1], {"events": "events"})
    FigureCanvasSVG(figure)
    figure.draw_without_rendering()
    (ax,) = figure.axes
    low, high = ax.get_xlim()
    assert [tick for tick in ax.get_xticks() if low <= tick <= high] == [1]


def test_distribution_leaves_out_sizes_that_never_occur():
    ax = distributions().axes[0]
    chance, fit, observed = ax.lines[:3]
    assert observed.get_xdata().tolist() == [1, 3]
    assert observed.get_ydata().tolist() == [0.7, 0.3]
    assert fit.get_ydata().tolist() == [0.5, 0.25]  # 0.125 lies below half the smallest share seen
    assert chance.get_ydata().tolist() == pytest.approx([0.4, 0.16])
    assert ax.get_ylim()[1] > 0.7


def test_distribution_says_when_there_is_no_cascade():
    assert [text.get_text() for text in distributions().axes[1].texts] == ["no cascade"]


def test_forest_has_a_row_a_law_and_marks_chance_only_where_it_is_known():
    (ax,) = forest().axes
    assert [label.get_text() for label in ax.get_yticklabels()] == ["events", "drop, dt = 0.5"]
    ticks = [line for line in ax.lines if line.get_marker() == "|" and len(line.get_xdata())]
    assert [line.get_xdata().tolist() for line in ticks] == [[0.69]]


@pytest.mark.parametrize("draw", [trajectories, distributions, forest])
def test_a_figure_twice_is_the_same_bytes_without_a_date(draw):
    one, two = figures.svg(draw()), figures.svg(draw())
    assert one == two
    assert "<dc:date>" not in one


def test_a_difference_beyond_the_axis_is_an_arrowhead_at_its_edge():
    of = {"margin": 0.1, "verdict": DIFFERENT}
    rows = [
        of | {"quantity": "far", "relative": 1.5, "narrow_low": 1.2, "narrow_high": 1.8},
        of | {"quantity": "near", "relative": 0.2, "narrow_low": 0.1, "narrow_high": 0.3, "verdict": OPEN},
    ]
    (ax,) = change_figures.contrasts([("n = 200", rows)], "").recipe().axes
    points = {line.get_marker(): line.get_xdata().tolist() for line in ax.lines if len(line.get_xdata()) == 1}
    assert points[">"] == [ax.get_xlim()[1]] == [6]
    assert points["D"] == [2]
