"""The chart of cost and size: its schema, its systems, what is measured, exponents, words."""

import math
import re

import numpy as np
import pandas as pd
import pytest
import scipy.sparse

from stickslip import sim
from stickslip.pipeline import expand
from stickslip.workflows.commands import main
from stickslip.workflows.gallery.charts import runner, scaling
from stickslip.workflows.gallery.charts.scaling import Cost, Measured, Throughput, cost_against_size

TINY = """
chart = "scaling"
title = "A tiny <chart>"
n = [4, 60, 120]
chain_n = [10, 200]
t_run = 1.0
repeats = 2
ensemble_n = 6
ensemble_t_end = 3.0
members = 2
workers = 1
"""


# ---------------------------------------------------------------------------------------------- the scene


BAD = {
    "no blocks": ("\nn = [4, 60, 120]", "\nn = [4, 0]", "n[1]: expected", "got 0"),
    "no worker": ("workers = 1", "workers = 0", "workers: expected a value greater", "got 0"),
    "tolerance too fine": ("members = 2", "tol = 1e-17", "tol: expected a value greater", "got 1e-17"),
}


@pytest.mark.parametrize("mistake", BAD)
def test_a_bad_chart_is_refused_with_key_and_remedy_and_nothing_is_written(mistake, refuse):
    refuse(TINY, *BAD[mistake])


# ---------------------------------------------------------------------------------------------- the systems


def test_random_systems_are_an_ensembles_and_alike_in_the_force_that_couples_a_block(scene):
    """The root of the mean sum of squares in a row is kappa sqrt(n) sqrt(1/6): here that of n = 200, kappa = 0.2."""
    one = scene.model_copy(update={"ensemble_n": 200, "members": 1})
    (member,) = expand(scaling.ensemble(one, "coulomb", tol=1e-10))
    np.testing.assert_array_equal(scene.drawn("random", 200).stiffness, member.system().stiffness)
    for n in (50, 800):
        stiffness = scene.drawn("random", n).stiffness
        stiffness = stiffness - np.diag(np.diag(stiffness))
        # U uniform: (U - U^T) / 2 has variance kappa^2 / 6
        assert np.sqrt((stiffness**2).sum(axis=1).mean()) == pytest.approx(0.2 * math.sqrt(200 / 6), rel=0.05)


def test_a_chain_couples_neighbours_alone_and_stays_sparse(scene):
    system = scene.drawn("chain", 10_000)
    assert scipy.sparse.issparse(system.stiffness)
    rows, columns = system.stiffness.nonzero()
    assert np.abs(rows - columns).max() == 1
    assert scipy.sparse.issparse(system.stiffness)  # the kernels stream the sparse form
    below, above = system.stiffness.diagonal(-1), system.stiffness.diagonal(1)
    np.testing.assert_array_equal(below, -above)


# ---------------------------------------------------------------------------------------------- measuring


def test_a_chain_is_measured_without_a_dense_matrix(scene, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a chain became dense")

    monkeypatch.setattr(scipy.sparse.csc_array, "toarray", refuse)
    monkeypatch.setattr(scaling, "Product", refuse)
    row = scaling.cost(scene, "chain", "coulomb", 3000)
    assert (row.reason, row.n_entries, row.products) == (None, 8998, None)


@pytest.mark.parametrize("engine", ["coulomb", "sigmoid"])
def test_a_run_has_the_events_of_its_time(scene, engine):
    row = scaling.cost(scene, "random", engine, 120)
    run = sim.simulate(scene.drawn("random", 120), -0.7, -0.4, 6.0, engine="coulomb", tol=1e-12)
    known = int((run.events.t > 5.0).sum())
    assert row.n_events == pytest.approx(known, abs=1 if engine == "coulomb" else 0.2 * known)
    assert row.t == 1.0
    assert row.n_runs == 2
    assert 0 < row.seconds_min <= row.seconds <= row.seconds_max
    assert 0 < row.products_min <= row.products <= row.products_max
    assert row.over_products > 0.1  # no engine reads K ten times as fast as numpy


def test_systems_that_diverge_leave_a_row_with_a_reason(scene, monkeypatch):
    fast = sim.System(-900.0 * np.eye(2), 0.1)
    monkeypatch.setattr(scaling.ScalingScene, "drawn", lambda self, system, n: fast)
    row = scaling.cost(scene.model_copy(update={"t_run": 100.0}), "random", "coulomb", 2)
    assert row.reason
    assert row.seconds is None


def test_an_engine_that_cannot_go_on_leaves_a_row_with_its_words(scene, monkeypatch):
    def stall(*_, **__):
        raise sim.IntegrationError("stalled at t = 1")

    monkeypatch.setattr(sim, "simulate", stall)
    row = scaling.cost(scene, "chain", "coulomb", 5)
    assert (row.reason, row.seconds) == ("stalled at t = 1", None)


def test_a_tiny_chart_end_to_end(scene_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["run", str(scene_file), "--out", str(out)]) == 0
    assert "Random systems, exact engine: an event costs" in capsys.readouterr().out
    page = (out / "report.html").read_text()
    assert "A tiny &lt;chart&gt;" in page
    assert not re.search(r"\b(nan|inf|None)\b", re.sub(r"data:image[^\"]*", "", page))
    assert "https://" not in page
    costs = pd.read_parquet(out / "report" / "costs.parquet").set_index(["system", "engine", "n"]).sort_index()
    assert len(costs) == 3 + 2 + 3
    assert costs.products["chain"].isna().all()
    throughput = pd.read_parquet(out / "report" / "throughput.parquet").set_index("engine")
    assert throughput[["n_members", "n_workers", "n_failed"]].T.to_dict("list") == {
        "coulomb": [2, 1, 0], "sigmoid": [2, 1, 0]
    }  # fmt: skip
    assert (throughput.seconds > 0).all()


def test_the_ensemble_is_the_scenes(scene):
    ensemble = scaling.ensemble(scene, "sigmoid", eps=scene.eps)
    (engine,) = ensemble.engines
    assert (engine.name, engine.eps, engine.picked_for, engine.ratio) == ("sigmoid", 0.03, "statistics", "one")
    assert (ensemble.system.n, ensemble.run.matrices, ensemble.run.t_end) == ((6,), 2, 3.0)
    assert ensemble.system.kappa == pytest.approx(0.2 * math.sqrt(200 / 6))


# ---------------------------------------------------------------------------------------------- words


@pytest.fixture(autouse=True)
def without_figures(undrawn):
    """What is drawn is looked at by itself."""


def planted_costs():
    """Random systems whose event costs 1e-6 n, with n events a unit of time."""
    return [
        Cost("random", "coulomb", n, n_entries=n * n, t=10.0, n_events=10 * n,
             n_products=1000, seconds=1e-5 * n**2, seconds_min=1e-5 * n**2, seconds_max=2e-5 * n**2,
             products=5e3, products_min=4e3, products_max=6e3, product_seconds=1e-9 * n * n, n_runs=5)
        for n in (100, 200, 400, 800)
    ]  # fmt: skip


def test_the_answer_has_the_ends_and_the_throughput(scene):
    failed = Cost("chain", "coulomb", 100, reason="it broke")
    report = runner.report(
        scene, Measured([*planted_costs(), failed], [Throughput("coulomb", 200, 1e3, 40, 2, 3, 24.0)])
    )
    _, cost, rate = report.headline
    assert cost == (
        "Random systems, exact engine: an event costs 100 µs at n = 100 and 800 µs at n = 800, a unit of time"
        " 10 ms at n = 100 and 640 ms at n = 800."
    )
    assert rate == "On 2 workers the coulomb engine runs 100 members a minute (n = 200, t_end = 1000)."
    assert "it broke" in report.html


def test_the_figure_shows_costs_and_those_over_products():
    event, time, over_products = cost_against_size({"one": planted_costs()}).axes
    np.testing.assert_allclose(time.lines[0].get_ydata(), [1e-3 * n**2 for n in (100, 200, 400, 800)])
    np.testing.assert_allclose(event.lines[0].get_ydata(), [n for n in (100, 200, 400, 800)])
    np.testing.assert_allclose(over_products.lines[0].get_ydata(), 10.0)
