"""The chart of limits: its cases, its limits and its words."""

import numpy as np
import pandas as pd
import pytest

from stickslip.workflows.commands import main
from stickslip.workflows.gallery.charts import limit, runner
from stickslip.workflows.gallery.charts.limit import Cost, Measured, time_over_limits

TINY = """
chart = "limit"
n = [4]
chain_n = [10]
tolerances = 1e-5
t_end = 1.0
repeats = 2
"""


def planted(n, seconds):
    """100 products of 1 microsecond each by numpy, of 10 by arithmetic alone."""
    return Cost(
        systems="random", n=n, method="exact", way="", n_products=100, arithmetic_seconds=1e-5, n_runs=1,
        seconds=seconds, seconds_min=seconds, seconds_max=seconds, product_seconds=1e-6,
        products=seconds / 1e-6, products_min=seconds / 1e-6, products_max=seconds / 1e-6,
    )  # fmt: skip


def test_the_answer_is_what_is_nearest_to_its_products_and_what_is_farthest(scene):
    report = runner.report(scene, Measured([planted(5, 3e-4), planted(2000, 2.5e-5)], 1e10))
    assert report.headline[1:] == [
        "Least is left at n = 2,000, exact: the run takes 0.25 times as long as its products by numpy would.",
        "Most is left at n = 5, exact: 3 times.",
    ]


def test_the_figure_has_a_row_a_run():
    (ax,) = time_over_limits([planted(5, 3e-4), planted(2000, 2.5e-5)]).axes
    np.testing.assert_allclose([line.get_xdata() for line in ax.lines[:2]], [[3.0, 0.25], [30.0, 2.5]])


def test_no_product_of_matrices_is_faster_than_its_arithmetic():
    """The rate is that of the machine: within a million and 10^13 operations a second of one thread."""
    assert 1e6 < limit.arithmetic() < 1e13


def test_a_tiny_chart_end_to_end(scene_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["run", str(scene_file), "--out", str(out)]) == 0
    assert "Least is left at" in capsys.readouterr().out
    costs = pd.read_parquet(out / "report" / "costs.parquet")
    assert list(costs["method"]) == [
        "exact, tol = 1e-05",
        "sigmoid, r = 1",
        "sigmoid, r uniform",
        "exact, tol = 1e-05",
    ]
    entries = np.array([16, 16, 16, 28])
    ratio = costs["arithmetic_seconds"] / (2 * entries * costs["n_products"])
    assert ratio.to_numpy() == pytest.approx(ratio[0])
    assert (costs["products"] > 0).all(), "also where K is sparse"
