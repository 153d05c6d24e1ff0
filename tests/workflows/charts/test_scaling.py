"""The chart of cost and size: its schema, its systems, what is measured, exponents, words."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import scipy.sparse

from stickslip import sim
from stickslip.pipeline import parse_scene
from stickslip.workflows.charts import runner, scaling
from stickslip.workflows.charts.scaling import (
    Cost,
    Group,
    Measured,
    ScalingScene,
    Throughput,
    cost_against_size,
    growth,
)
from stickslip.workflows.commands import main

TINY = """
chart = "scaling"
title = "A tiny <chart>"
n = [4, 60, 80, 120]
events = 60
t_most = 20.0
matrices = 3
repeats = 2
chain_n = [10, 200]
sigmoid_n = [5, 10, 20]
sigmoid_t = 1.0
ensemble_n = 6
ensemble_t_end = 3.0
members = 2
workers = 1
"""


@pytest.fixture
def in_process(monkeypatch):
    """The ensemble without workers of its own: what the pipeline does with them is tested there."""

    def throughput(scene, say):
        seconds, n_failed = scaling._pipeline(scene, "coulomb", {"tol": scene.tol}, workers=0)
        return [
            Throughput(
                "coulomb", "picked", scene.ensemble_n, scene.ensemble_t_end, 2, 1, n_failed, seconds, 2 * seconds
            )
        ]

    monkeypatch.setattr(scaling, "throughput", throughput)


def silent(line):
    pass


# ---------------------------------------------------------------------------------------------- the scene


BAD = {
    "no blocks": ("n = [4, 60, 80, 120]", "n = [4, 0]", "n[1]: expected", "got 0"),
    "no worker": ("workers = 1", "workers = 0", "workers: expected a value greater", "got 0"),
    "tolerance too fine": ("members = 2", "tol = 1e-17", "tol: expected a value greater", "got 1e-17"),
}


@pytest.mark.parametrize("mistake", BAD)
def test_a_bad_chart_is_refused_with_key_and_remedy_and_nothing_is_written(mistake, refuse):
    refuse(TINY, *BAD[mistake])


# ---------------------------------------------------------------------------------------------- the systems


def test_random_systems_are_an_ensembles_and_alike_in_the_force_that_couples_a_block(scene):
    """The root of the mean sum of squares in a row is kappa sqrt(n) sqrt(1/6): here that of n = 200, kappa = 0.2."""
    member = scene.model_copy(update={"ensemble_n": 200, "members": 1})
    (found,) = scaling_members(member)
    np.testing.assert_array_equal(scene.random(200, 0).stiffness, found.system().stiffness)
    for n in (50, 800):
        stiffness = scene.random(n, 0).stiffness - np.diag(np.diag(scene.random(n, 0).stiffness))
        # U uniform: (U - U^T) / 2 has variance kappa^2 / 6
        assert np.sqrt((stiffness**2).sum(axis=1).mean()) == pytest.approx(0.2 * math.sqrt(200 / 6), rel=0.05)


def scaling_members(scene):
    from stickslip.pipeline import expand

    return expand(parse_scene(scaling.ensemble_source(scene, "coulomb", {"tol": 1e-10})))


def test_a_chain_couples_neighbours_alone_and_stays_sparse(scene):
    system = scene.chain(10_000, 0)
    assert scipy.sparse.issparse(system.stiffness)
    rows, columns = system.stiffness.nonzero()
    assert np.abs(rows - columns).max() == 1
    assert scaling.stored(system.stiffness) == system.stiffness.nnz == 3 * 10_000 - 2
    assert system.columns.dense.size == 0  # the kernels stream the sparse form
    below, above = system.stiffness.diagonal(-1), system.stiffness.diagonal(1)
    np.testing.assert_array_equal(below, -above)


def test_a_chain_is_measured_without_a_dense_matrix(scene, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a chain became dense")

    monkeypatch.setattr(scipy.sparse.csc_array, "toarray", refuse)
    monkeypatch.setattr(scaling, "Product", refuse)
    row = scaling.exact_cost(scene, "chain", 3000)
    assert (row.outcome, row.n_entries, row.products) == ("measured", 8998, None)


# ---------------------------------------------------------------------------------------------- measuring


def test_a_run_has_the_events_asked_for(scene):
    row = scaling.exact_cost(scene, "random", 120)
    assert (row.n_rest, row.n_diverged) == (0, 0)
    assert row.n_events == pytest.approx(60, abs=1)  # the last may fall beyond the end by a rounding
    assert 0 < row.t <= scene.t_most
    assert 0 < row.seconds_min <= row.seconds <= row.seconds_max
    assert 0 < row.products_min <= row.products <= row.products_max


def planted_systems(monkeypatch, stiffness, damping):
    monkeypatch.setattr(ScalingScene, "random", lambda self, n, matrix: sim.System(stiffness, damping))


def test_blocks_that_come_to_rest_are_measured_to_their_last_event(scene, monkeypatch):
    """Uncoupled blocks, R = 1, v = -0.2, k = 0.1: each sticks until its spring holds against friction, then rests.

    Sticking ends where |R v + k z| = mu, z = -8: at the speed of the belt that is after t_burn = 5.
    """
    planted_systems(monkeypatch, 0.1 * np.eye(2), 1.0)
    long = scene.model_copy(update={"t_most": 200.0, "matrices": 1})
    row = scaling.exact_cost(long, "random", 2)
    assert (row.outcome, row.n_rest, row.n_matrices) == ("measured", 1, 1)
    run = sim.simulate(long.random(2, 0), -0.7, -0.4, 205.0, tol=1e-10)
    assert row.n_events == int((run.events.t > 5.0).sum()) > 0
    assert row.t == pytest.approx(run.events.t[-1] - 5.0, rel=1e-9)


def test_blocks_that_never_stick_leave_a_row_with_a_reason(scene, monkeypatch):
    """Free blocks: from w = 0 the speed falls to -mu / R = -0.1, and the belt's -0.2 is not reached."""
    planted_systems(monkeypatch, np.zeros((2, 2)), 10.0)
    monkeypatch.setattr(scaling, "W0", 0.0)
    row = scaling.exact_cost(scene, "random", 2)
    assert (row.outcome, row.n_tried, row.n_rest) == ("failed", 3, 3)
    assert row.reason == "no event after t_burn in 3 matrices"
    assert row.seconds is None


def test_systems_that_diverge_leave_a_row_with_a_reason(scene, monkeypatch):
    planted_systems(monkeypatch, -9.0 * np.eye(2), 0.1)
    row = scaling.exact_cost(scene, "random", 2)
    assert (row.outcome, row.n_diverged) == ("failed", 3)
    row = scaling.sigmoid_cost(scene, 2)
    assert (row.outcome, row.n_diverged, row.seconds) == ("failed", 1, None)


def test_an_engine_that_cannot_go_on_leaves_a_row_with_its_words(scene, monkeypatch):
    def stall(*_, **__):
        raise sim.IntegrationError("stalled at t = 1")

    monkeypatch.setattr(sim, "simulate", stall)
    for row in (scaling.exact_cost(scene, "chain", 5), scaling.sigmoid_cost(scene, 5)):
        assert (row.outcome, row.reason, row.seconds) == ("failed", "stalled at t = 1", None)


def test_a_tiny_chart_end_to_end(scene_file, tmp_path, capsys, in_process, in_this_process):
    out = tmp_path / "out"
    assert main(["run", str(scene_file), "--out", str(out)]) == 0
    assert "Random systems, exact engine: an event goes as" in capsys.readouterr().out
    page = (out / "report.html").read_text()
    assert "A tiny &lt;chart&gt;" in page
    assert not re.search(r"\b(nan|inf|None)\b", re.sub(r"data:image[^\"]*", "", page))
    assert "https://" not in page
    tables = {name: pd.read_parquet(out / "report" / f"{name}.parquet") for name in ("costs", "growth")}
    costs = tables["costs"].set_index(["system", "engine", "n"]).sort_index()
    assert len(costs) == 4 + 2 + 3
    assert costs.products["chain"].isna().all()
    assert costs.n_events["random", "coulomb", 120] == pytest.approx(60, abs=1)
    assert costs.t["random", "sigmoid"].tolist() == [1.0] * 3
    as_json = json.loads((out / "report" / "tables.json").read_text())
    assert len(as_json["growth"]) == len(tables["growth"]) == 13
    assert as_json["throughput"][0]["n_failed"] == 0


def test_the_ensemble_runs_on_workers(scene, monkeypatch):
    """Here on those that are there; a run that starts its own is the pipeline's."""
    pipeline, started = scaling._pipeline, []

    def without_start(*asked, **where):
        if "scheduler" in where:
            return pipeline(*asked, **where)
        started.append(where)
        return 1.0, 0

    monkeypatch.setattr(scaling, "_pipeline", without_start)
    found = scaling.throughput(scene, silent)
    assert started == [{"workers": 1}] * 4
    assert [(row.engine, row.tolerance, row.n_members, row.n_workers, row.n_failed) for row in found] == [
        ("coulomb", "1e-10", 2, 1, 0),
        ("coulomb", "picked", 2, 1, 0),
        ("sigmoid", "1e-06", 2, 1, 0),
        ("sigmoid", "picked", 2, 1, 0),
    ]
    assert all(row.seconds > 0 and row.seconds_with_start > 0 for row in found)


def test_the_ensemble_is_the_scenes(scene):
    settings = {"eps": scene.eps, "rtol": scene.rtol, "atol": scene.rtol}
    ensemble = parse_scene(scaling.ensemble_source(scene, "sigmoid", settings))
    (engine,) = ensemble.engines
    assert (engine.name, engine.eps, engine.rtol, engine.atol, engine.ratio) == ("sigmoid", 0.03, 1e-6, 1e-6, "one")
    assert (ensemble.system.n, ensemble.run.matrices, ensemble.run.t_end) == ((6,), 2, 3.0)
    assert ensemble.system.kappa == pytest.approx(0.2 * math.sqrt(200 / 6))


# ---------------------------------------------------------------------------------------------- exponents, words


def test_planted_exponents_are_recovered():
    n = [100, 200, 500, 1000, 2000]
    found = growth(n, [3e-7 * m**1.5 for m in n], "random", "coulomb", "seconds per event", 1.0)
    assert found.exponent == pytest.approx(1.5, rel=1e-12)
    assert found.last == pytest.approx(1.5, rel=1e-12)
    assert found.standard_error == pytest.approx(0.0, abs=1e-7)
    assert (found.n_points, found.n_min, found.n_max) == (5, 100, 2000)


def test_the_interval_covers_the_planted_exponent_as_often_as_it_says():
    """2000 draws with scatter: 95% +- 3 binomial errors (0.5% each) of them."""
    rng, n = np.random.default_rng(0), [100, 200, 500, 1000, 2000]
    fits = [
        growth(n, list(np.array(n) ** 2 * np.exp(0.3 * rng.normal(size=5))), "", "", "", 2.0) for _ in range(2000)
    ]
    assert np.mean([fit.low <= 2.0 <= fit.high for fit in fits]) == pytest.approx(0.95, abs=0.015)


def test_two_points_give_no_exponent_but_a_reason():
    found = growth([10, 20], [1.0, 2.0], "chain", "coulomb", "seconds per event", 1.0)
    assert (found.exponent, found.low, found.last) == (None, None, None)
    assert "takes three n, got 2" in found.reason


@pytest.fixture(autouse=True)
def without_figures(undrawn):
    """What is drawn is looked at by itself."""


def planted(scene, event=1.0, time=2.0, scatter=(1.0, 1.0, 1.0, 1.0), **changes):
    """Random systems whose event costs n^event, with n^(time - event) events a unit of time; sigmoid steps n^2."""
    costs = [
        Cost("random", "coulomb", n, n_matrices=1, n_entries=n * n, t=10.0, n_events=round(10 * n ** (time - event)),
             n_steps=4000, n_products=1000, seconds=1e-5 * off * n**time, seconds_min=1e-5 * n**time,
             seconds_max=2e-5 * n**time, products=5e3, products_min=4e3, products_max=6e3,
             product_seconds=1e-9 * n * n, n_runs=5)
        for n, off in zip((100, 200, 400, 800), scatter, strict=True)
    ]  # fmt: skip
    rest = replace(costs[0], n=20, n_tried=40, n_matrices=38, n_rest=39, seconds=77.0)
    smooth = replace(costs[1], engine="sigmoid", n_products=500, seconds=2.0, product_seconds=2e-3)
    chain = replace(costs[0], system="chain", outcome="failed", reason="it broke", seconds=None)
    measured = Measured(
        [rest, *costs, chain, smooth],
        [Throughput("coulomb", "1e-10", 200, 1000.0, 40, 2, 0, 24.0, 30.0)],
    )
    return runner.report(scene, runner.Measurement("", {}, replace(measured, **changes)))


@pytest.fixture
def line(said):
    def found(report, words):
        (one,) = (line for line in said(report) if words in line)
        return one

    return found


def test_words_follow_the_exponents(scene, line):
    as_claimed, steeper = planted(scene, 1.0, 2.0), planted(scene, 1.5, 2.5)
    assert "It goes as n^1.00 ± 0.00" in line(as_claimed, "An event costs 100 µs at n = 100 and 800 µs at n = 800")
    assert "It goes as n^2.00" in line(as_claimed, "A unit of time costs")
    assert "n^1.50" in line(steeper, "An event costs")
    assert line(steeper, "An event costs").endswith(": above n^1.")
    assert line(steeper, "A unit of time costs").endswith(": above n^2.")
    assert line(planted(scene, 0.5, 1.5), "A unit of time costs").endswith(": below n^2.")


def test_a_claim_inside_the_interval_is_not_excluded(scene, line):
    report = planted(scene, scatter=(1.1, 0.9, 1.15, 0.95))
    assert line(report, "An event costs").endswith("n^1 is not excluded.")


def test_systems_at_rest_and_rows_that_failed_are_named_and_left_out(scene, line):
    report = planted(scene)
    assert "n = 20 (39 of 40)" in line(report, "came to rest")
    assert "n = 100 was not measured: it broke." in line(report, "Chains, exact engine: n = 100")
    table = report.tables["growth"].set_index(["system", "engine", "quantity"])
    assert table.n_points["random", "coulomb", "seconds per event"] == 4
    assert table.n_points["chain", "coulomb", "seconds per event"] == 0
    assert "it broke" in report.html


def test_throughput_words(scene, line):
    report = planted(scene)
    words = line(report, "The coulomb engine at 1e-10 runs")
    assert "runs 100 members a minute on 2 workers that are there, 80 when they have to be started" in words
    slow = [Throughput("coulomb", "1e-10", 200, 1000.0, 40, 1, 3, 24.0, 20.0)]
    words = line(planted(scene, throughput=slow), "The coulomb engine at 1e-10 runs")
    assert "1 worker that" in words
    assert "3 failed" in words
    assert "the start is lost in the scatter" in words


def test_points_that_do_not_count_are_hollow():
    """Seconds a unit of time are n / 10: the fit passes the three that count."""
    rows = [
        Cost("random", "coulomb", n, n_rest=int(n == 10), t=1.0, n_events=n, seconds=seconds, seconds_min=seconds,
             seconds_max=seconds) for n, seconds in ((10, 1e-3), (20, 2e-3), (40, 4e-3), (80, 8e-3))
    ]  # fmt: skip
    fit = growth([20, 40, 80], [2e-3, 4e-3, 8e-3], "random", "coulomb", "seconds per unit of time", 2.0)
    group = Group("random", "coulomb", rows, {"seconds per unit of time": fit})
    rows[0] = replace(rows[0], n_products=6, product_seconds=1e-4)
    _, time, share = cost_against_size([group]).axes
    hollow = [drawn.get_xdata()[0] for drawn in time.lines if drawn.get_markerfacecolor() == "white"]
    assert hollow == [10]
    (fit,) = (drawn for drawn in time.lines if drawn.get_linestyle() == "--" and len(drawn.get_xdata()) == 3)
    np.testing.assert_allclose(fit.get_ydata(), [2.0, 4.0, 8.0])
    np.testing.assert_allclose(share.lines[-1].get_xydata(), [[10, 0.4]])
