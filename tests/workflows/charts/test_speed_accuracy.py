"""The chart of speed against accuracy: its schema, its methods, what is kept of a measurement, its words."""

import importlib.util
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from stickslip import sim
from stickslip.pipeline import expand, parse_scene
from stickslip.workflows.commands import main
from stickslip.workflows.gallery import load_chart
from stickslip.workflows.gallery.charts import peers, runner
from stickslip.workflows.gallery.charts.peers import (
    METHODS,
    Equations,
    GivenUp,
    Method,
    MethodError,
    Problem,
    Solution,
)
from stickslip.workflows.gallery.charts.speed_accuracy import (
    Cost,
    Measured,
    Panel,
    Standard,
    error_against_cost,
    products_at,
)
from stickslip.workflows.gallery.charts.trials import Reference, compared, referenced
from tests.scenes import SIGMOID, ensemble

TINY = """
chart = "speed_accuracy"
title = "A tiny <chart>"
n = 5
eps = 0.03
ratios = "uniform"
t_end = 2.0
tolerances = 1e-5
steps = 1e-3
repeats = 1
seconds_a_run = 60.0
seed = 1
"""

PEERS = [method for method in METHODS if method.model == "sigmoid" and method.is_installed]


@pytest.fixture
def without_extra(monkeypatch):
    """As if the extra `bench` were not installed."""
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "stickslip.workflows.gallery.charts.peers.find_spec",
        lambda name: None if name in ("CyRK", "sksundae", "diffrax") else find(name),
    )


def silent(line):
    pass


# ---------------------------------------------------------------------------------------------- the scene


def test_the_system_is_that_of_an_ensemble_with_the_same_seed(scene_file):
    smooth = f'{SIGMOID}\nratio = "uniform"'
    (member,) = expand(parse_scene(ensemble(5, 2.0, 1, smooth, seed=1).encode()))
    problem = load_chart(scene_file).problem(5, "uniform")
    np.testing.assert_array_equal(problem.system.stiffness, member.system().stiffness)
    np.testing.assert_array_equal(problem.delta, 0.03 * member.ratios())
    np.testing.assert_array_equal(problem.start, np.repeat([member.begin.z0, member.begin.w0], 5))


BAD = {
    "negative n": ("n = 5", "n = [5, -5]", "n[1]: expected", "got -5"),
    "tolerance too fine": ("1e-5", "[1e-5, 1e-13]", "tolerances[1]: expected a value greater", "got 1e-13"),
    "unknown ratio": ('"uniform"', '["one", "two"]', "ratios[1]: expected 'one' or 'uniform'", "got 'two'"),
}


@pytest.mark.parametrize("mistake", BAD)
def test_a_bad_chart_is_refused_with_key_and_remedy_and_nothing_is_written(mistake, refuse):
    refuse(TINY, *BAD[mistake])


# ---------------------------------------------------------------------------------------------- the methods


def problem_of_three(t_end=5.0):
    """Stiff in one block, mild in another, and one block without friction."""
    system = sim.System(
        np.array([[0.4, 0.1, -0.2], [-0.1, 0.3, 0.05], [0.2, -0.05, 0.2]]), [3.0, 0.5, 1.0], [1.0, 0.6, 0.0], -0.3
    )
    return Problem(system, np.array([0.002, 0.1, 0.03]), -0.7, -0.4, t_end)


def test_right_hand_side_and_derivatives_of_one_block_are_the_equations():
    """By hand: z' = w, w' = -R w - k z - mu tanh((w - v) / delta), dw'/dw = -R - mu / delta sech^2."""
    equations = Equations(Problem(sim.System([[0.5]], 2.0, 0.7, -0.2), np.array([0.3]), 0.0, 0.0, 1.0))
    y = np.array([1.5, 0.1])
    force = 2.0 * 0.1 + 0.5 * 1.5 + 0.7 * np.tanh(1.0)
    np.testing.assert_allclose(equations(0.0, y), [0.1, -force], rtol=1e-15)
    drag = 2.0 + 0.7 / 0.3 / np.cosh(1.0) ** 2
    np.testing.assert_allclose(equations.jacobian(0.0, y), [[0.0, 1.0], [-0.5, -drag]], rtol=1e-15)


def test_the_jacobian_times_a_vector_is_the_jacobian():
    problem = problem_of_three()
    equations, rng = Equations(problem), np.random.default_rng(0)
    y, direction = np.append(rng.normal(size=3), -0.3 + 0.01 * rng.normal(size=3)), rng.normal(size=6)
    product = equations.along(equations.drag(y), direction)
    np.testing.assert_allclose(product, equations.jacobian(0.0, y) @ direction, rtol=1e-13)


#: It compiles for ten seconds.
_SLOW = {"CyRK DOP853": pytest.mark.long}


@pytest.mark.parametrize("method", [pytest.param(one, marks=_SLOW.get(one.name, ()), id=one.name) for one in PEERS])
def test_every_method_solves_the_same_equations(method):
    """Against the sigmoid engine's neighbour in the list: two codes that share nothing agree at a tight tolerance."""
    problem = problem_of_three()
    check = peers.method("SciPy Radau")
    z = method.prepare(problem)(1e-9 if method.control == "tolerance" else 1e-4).z
    assert z.shape == (3,)
    np.testing.assert_allclose(z, check.prepare(problem)(1e-11).z, atol=3e-7)


def test_the_plain_method_with_events_finds_those_of_the_exact_engine():
    """A code that shares nothing with the engine, whose error falls with its tolerance."""
    problem = replace(problem_of_three(), system=sim.draw_system("antisymmetric", 5, 0), t_end=25.0)
    known = peers.solved("coulomb engine", 1e-13, problem)
    for tolerance in (1e-5, 1e-9):
        solution = peers.solved("DP5 with events", tolerance, problem)
        assert compared(solution.events, known.events) == (None, pytest.approx(0.0, abs=100.0 * tolerance))
        np.testing.assert_allclose(solution.z, known.z, atol=10.0 * tolerance)


def test_a_run_is_given_up_when_patience_ends():
    solve = peers.method("SciPy RK45").prepare(replace(problem_of_three(), patience=0.0))
    with pytest.raises(GivenUp, match="after 0 s"):
        solve(1e-6)


# ---------------------------------------------------------------------------------------------- measuring


def test_a_tiny_chart_end_to_end(scene_file, tmp_path, capsys, without_extra):
    out = tmp_path / "out"
    assert main(["run", str(scene_file), "--out", str(out)]) == 0
    assert " comes to an error of 1e-4 with " in capsys.readouterr().out

    page = (out / "report.html").read_text()
    assert "A tiny &lt;chart&gt;" in page
    assert "CyRK DOP853 (CyRK is not installed)" in page
    assert not re.search(r"\b(nan|inf)\b", page.split("</figure>")[1], flags=re.IGNORECASE)
    assert "https://" not in page

    costs = pd.read_parquet(out / "report" / "costs.parquet")
    assert set(costs.method) == {method.name for method in METHODS}
    measured = costs[costs.outcome == "measured"]
    assert set(costs.outcome) == {"measured", "absent"}
    assert set(costs.method[costs.outcome == "absent"]) == {"CyRK DOP853", "CVODE BDF-GMRES", "diffrax Tsit5"}
    assert costs.reason[costs.outcome == "absent"].notna().all()
    assert costs.ratio[costs.model == "coulomb"].isna().all()
    assert (measured.products > 0).all()
    assert (measured.error > 0).all()
    assert (measured.error < 1e-3).all()  # a hundred times the tolerance asked for: no method is off its equations
    assert costs.error[costs.outcome == "absent"].isna().all()


def chart_with(monkeypatch, scene_file, *methods, **changes):
    """Rows of a method of our making beside those that make the references."""
    needed = [method for method in METHODS if method.is_ours or method.name == "SciPy DOP853"]
    monkeypatch.setattr(peers, "METHODS", (*needed, *methods))
    return load_chart(scene_file).model_copy(update=changes).measure(silent)


def rows_of(measured, name):
    return [cost for cost in measured.costs if cost.method == name]


def test_a_method_past_its_time_limit_yields_rows_with_a_reason(monkeypatch, scene_file):
    measured = chart_with(monkeypatch, scene_file, seconds_a_run=1e-9, tolerances=(1e-6, 1e-4, 1e-3), repeats=4)
    first, *finer = rows_of(measured, "sigmoid engine")
    assert (first.tolerance, first.outcome, first.n_runs) == (
        1e-3,
        "measured",
        1,
    )  # not stopped, so known; not repeated
    assert [(row.tolerance, row.outcome) for row in finer] == [(1e-4, "too slow"), (1e-6, "too slow")]
    assert all("at 0.001: more than 1e-09 s" in row.reason for row in finer)
    assert all(row.error is None and row.products is None for row in finer)
    given_up = rows_of(measured, "SciPy DOP853")
    assert [row.outcome for row in given_up] == ["too slow"] * 3
    assert given_up[0].reason == "given up after 5e-09 s"


def test_a_method_that_fails_yields_a_row_with_its_reason_and_is_asked_on(monkeypatch, scene_file):
    def prepare(problem):
        def solve(tolerance):
            if tolerance > 1e-5:
                raise MethodError("lost its way")
            return Solution(np.full(problem.system.n, np.inf if tolerance < 1e-7 else 0.0))

        return solve

    method = Method("wanderer", "sigmoid", prepare)
    measured = chart_with(monkeypatch, scene_file, method, tolerances=(1e-8, 1e-6, 1e-3))
    rows = rows_of(measured, "wanderer")
    assert [row.outcome for row in rows] == ["failed", "measured", "wrong"]
    assert [row.reason for row in rows] == ["lost its way", None, "z at t_end is not finite, returned as a success"]


def test_no_error_below_the_floor_is_claimed(monkeypatch, scene_file):
    """A method that returns the reference itself is known to err by no more than the references disagree."""
    engine = peers.method("sigmoid engine")
    method = Method("oracle", "sigmoid", lambda problem: lambda tolerance: engine.prepare(problem)(1e-12))
    measured = chart_with(monkeypatch, scene_file, method)
    (row,) = rows_of(measured, "oracle")
    (reference,) = (reference for reference in measured.references if reference.model == "sigmoid")
    assert row.is_bound
    assert row.error == reference.floor > 0


def test_a_reference_that_is_checked_by_itself_is_known_to_rounding():
    setting, problem = ("coulomb engine", 1e-6), peers.random_problem(0, 2, 1.0, 0.1, "one")
    reference, solution = referenced(Reference(), setting, setting, problem)
    assert reference.floor == np.spacing(np.abs(solution.z).max()) > 0


def test_repeats_are_counted_and_their_spread_kept(monkeypatch, scene_file):
    measured = chart_with(monkeypatch, scene_file, repeats=3)
    for row in measured.costs:
        assert row.n_runs == 3
        assert 0 < row.products_min <= row.products <= row.products_max


def series(*events, n=2):
    t, block, mode = (np.array(column) for column in zip(*events, strict=True))
    return sim.EventSeries(t, block, mode.astype(np.int8), np.ones(n, dtype=np.int8), 0.0, 10.0)


def test_events_are_compared_block_by_block():
    known = series((1.0, 0, 0), (1.0, 1, 0), (2.0, 0, 1), (3.0, 1, -1), (5.0, 1, 0))
    swapped = series((1.0 - 1e-9, 1, 0), (1.0, 0, 0), (2.0, 0, 1), (3.0, 1, -1), (5.0 + 1e-8, 1, 0))
    assert compared(swapped, known) == (None, pytest.approx(1e-8, rel=1e-6))
    other = series((1.0 - 1e-9, 1, 0), (1.0, 0, 0), (2.0, 0, 1), (3.5, 1, 1), (5.0 + 1e-8, 1, 0))
    assert compared(other, known) == (3.0, pytest.approx(1e-9, rel=1e-6))
    assert compared(series((1.0, 0, 0), (1.0, 1, 0), (2.0, 0, 1), (3.0, 1, -1)), known) == (5.0, 0.0)


# ---------------------------------------------------------------------------------------------- the words


def test_products_on_a_planted_line():
    """error = 1 / products^2, that is products = error^-1/2, at points off the targets."""
    errors = [3e-3, 2e-5, 7e-7]
    products = [error**-0.5 for error in errors]
    for target in (1e-3, 1e-4, 1e-6):
        assert products_at(errors, products, target) == pytest.approx(target**-0.5, rel=1e-12)
    assert products_at(errors, products, 1e-8) is None
    assert products_at(errors, products, 1.0) == products[0]  # its coarsest is already better


def test_luck_at_a_coarse_tolerance_does_not_count():
    assert products_at([1e-6, 1e-2, 1e-4], [10.0, 20.0, 40.0], 1e-3) == pytest.approx(20 * 2**0.5)


def test_a_finer_point_that_is_cheaper_counts():
    assert products_at([1e-2, 1e-4, 1e-6], [10.0, 1000.0, 50.0], 1e-4) == 50.0


def planted():
    """Costs on planted lines: the sigmoid engine at 1000, CyRK at 3000 and SciPy DOP853 at 8000 products."""
    costs = [
        Cost(n=5, ratio="uniform", model="sigmoid", method=name, tolerance=tol, error=2 * tol, products=cost)
        for name, cost in (("sigmoid engine", 1e3), ("CyRK DOP853", 3e3), ("SciPy DOP853", 8e3))
        for tol in (1e-3, 1e-7)
    ]
    costs.append(replace(costs[0], method="SciPy Radau", outcome="too slow", reason="given up after 5 s",
                         error=None, products=None))  # fmt: skip
    references = [
        Standard(n=5, ratio=None, model="coulomb", floor=1e-14, n_events=12),
        Standard(n=5, ratio="uniform", model="sigmoid", floor=1e-12),
    ]
    return Measured(costs, references)


def test_words_say_who_is_cheapest_and_by_what_factor(scene_file, said, undrawn):
    report = runner.report(load_chart(scene_file), planted())
    (tolerance,) = said(report)
    for line, error in zip(report.headline[1:], ("1e-4", "1e-6"), strict=True):
        assert f"the sigmoid engine comes to an error of {error} with 1,000 products, 3 times less than" in line
        assert line.endswith("the next, CyRK DOP853.")
    assert '<td data-head="1e-6">8,000</td>' in report.html
    assert "the sigmoid engine's error is 2 to 2 times the tolerance" in tolerance.lower()
    assert report.html.count("given up after 5 s") == 1
    at_error = report.tables["at_error"].set_index(["method", "error"]).products
    assert at_error["CyRK DOP853", 1e-4] == pytest.approx(3e3)
    assert np.isnan(at_error["SciPy Radau", 1e-4])  # a null, in the table as it is kept


def test_every_method_of_the_chart_has_a_line_of_its_own():
    curves = {
        method.name: [
            Cost(n=5, ratio="one", model=method.model, method=method.name, tolerance=1e-4, error=error,
                 is_bound=error < 1e-5, products=cost)
            for cost, error in ((1e3, 1e-4), (2e3, 1e-6))
        ]
        for method in METHODS
    }  # fmt: skip
    (ax,) = error_against_cost([Panel(5, "one", curves, 1e-6, 12)]).axes
    lines = [line for line in ax.lines if line.get_label() in curves]
    assert len(lines) == len(METHODS)
    assert len({(line.get_color(), line.get_marker()) for line in lines}) == len(METHODS)
    hollow = [line for line in ax.lines if line.get_markerfacecolor() == "white"]
    assert [line.get_ydata()[0] for line in hollow] == [1e-6] * len(METHODS)  # the bounds, and nothing else


# ---------------------------------------------------------------------------------------------- the command


def test_a_chart_does_not_overwrite_an_ensemble(scene_file, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "manifest.json").write_text("{}")
    assert main(["run", str(scene_file), "--out", str(tmp_path / "out")]) == 2
    assert "holds an ensemble" in capsys.readouterr().err
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["manifest.json"]


def test_a_chart_takes_no_scheduler(scene_file, capsys):
    assert main(["run", str(scene_file), "--scheduler", "tcp://nowhere:1"]) == 2
    assert "--scheduler, --slurm: expected none" in capsys.readouterr().err
