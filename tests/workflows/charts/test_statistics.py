"""The chart of statistics against cost: planted verdicts, intervals in closed form, recorded modes, its words."""

import json
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from stickslip import sim
from stickslip.workflows.charts import load_chart, statistics
from stickslip.workflows.charts.cost import Product
from stickslip.workflows.charts.statistics import (
    METHODS,
    REFERENCES,
    STATISTICS,
    Choice,
    Compared,
    Difference,
    Measured,
    Ran,
    Setting,
    bias_against_cost,
    choices_of,
    compared,
    paired,
    sampling_error,
)
from stickslip.workflows.commands import main
from stickslip.workflows.scenes import shipped

TINY = """
chart = "statistics"
title = "A tiny <chart>"
n = 12
eps = 0.03
t_end = 40.0
t_burn = 1.0
matrices = 4
study = 3
coulomb_tolerances = [1e-8, 1e-3]
sigmoid_tolerances = [1e-6, 1e-2]
steps = [0.1, 0.01]
confidence = 0.9
seed = 1
"""


def silent(line):
    pass


# ---------------------------------------------------------------------------------------------- planted runs

N_MATRICES, STUDY = 40, 20
#: What each setting of the coulomb engine adds to mean n_stick, and the scatter of that over matrices.
CLEAN = {1e-10: (0.0, 1e-6), 1e-8: (0.0, 0.01), 1e-4: (0.0, 0.1), 1e-3: (2.5, 0.1)}


def planted(settings=CLEAN, method="coulomb engine", **changes):
    """Runs with a known bias of mean n_stick; references scatter by 1 over matrices; all else is equal."""
    rng = np.random.default_rng(0)
    runs = []
    for matrix in range(N_MATRICES):
        base = Ran(
            matrix, method, 0.0, "finished", None, 30.0 + rng.normal(), 5.0 + 0.3 * rng.normal(),
            0.027 + 0.001 * rng.normal(), 2000 + int(100 * rng.normal()), 1000, 5000.0, 0.4,
        )  # fmt: skip
        for name, tightest in REFERENCES.values():
            runs.append(replace(base, method=name, setting=tightest))
        for k, (setting, (bias, scatter)) in enumerate(settings.items()):
            noisy = base.mean + bias + scatter * rng.normal()
            runs.append(replace(base, setting=setting, mean=noisy, products=4000.0 / 2**k))
    return Measured(runs, **({"study": STUDY, "confidence": 0.95} | changes))


def rows_of(measured, setting):
    rows = (row for row in compared(measured) if (row.method, row.setting) == ("coulomb engine", setting))
    return {row.statistic: row for row in rows}


def loosest(measured):
    """The loosest sufficient setting by method."""
    found = {name: choice.loosest() for name, choice in choices_of(compared(measured)).items()}
    return {name: one and one.setting for name, one in found.items()}


def test_a_bias_of_zero_is_sufficient_and_a_clear_one_is_not():
    measured = planted()
    for setting in (1e-10, 1e-8, 1e-4):
        assert all(row.is_sufficient for row in rows_of(measured, setting).values())
    clear = rows_of(measured, 1e-3)
    assert not clear["mean n_stick"].is_sufficient
    assert clear["mean n_stick"].bias == pytest.approx(2.5, abs=0.1)
    assert clear["exit rate"].is_sufficient
    assert clear["exit rate"].bias == 0.0
    assert loosest(measured) == {"coulomb engine": 1e-4}


def test_a_bias_that_noise_could_hide_is_not_sufficient():
    """No bias at all, but a scatter of 4: 4 t / sqrt(40) = 1.3 is more than the sampling error of about 0.47."""
    measured = planted({1e-10: (0.0, 0.01), 1e-4: (0.0, 4.0)})
    row = rows_of(measured, 1e-4)["mean n_stick"]
    assert row.high - row.low > 2 * row.sampling_error
    assert not row.is_sufficient
    assert loosest(measured) == {"coulomb engine": 1e-10}


def test_every_tighter_setting_must_be_sufficient_too():
    assert loosest(planted({1e-10: (0.0, 0.1), 1e-6: (3.0, 0.1), 1e-3: (0.0, 0.1)})) == {"coulomb engine": 1e-10}
    assert loosest(planted({1e-10: (3.0, 0.1), 1e-3: (0.0, 0.1)})) == {"coulomb engine": None}


def test_one_statistic_that_moves_is_enough():
    """Sizes of cascades doubled: gamma falls, means stay."""
    measured = planted()
    runs = [replace(ran, total_size=2 * ran.total_size) if ran.setting == 1e-4 else ran for ran in measured.runs]
    measured = replace(measured, runs=runs)
    assert [name for name, row in rows_of(measured, 1e-4).items() if not row.is_sufficient] == ["gamma (events)"]
    assert rows_of(measured, 1e-4)["gamma (events)"].bias < 0
    assert loosest(measured) == {"coulomb engine": 1e-8}


def test_a_larger_study_allows_less():
    """The sampling error goes with one over the root: a bias of 0.3 passes beside 0.47 and fails beside 0.2."""
    shifted = {1e-10: (0.0, 0.01), 1e-4: (0.3, 0.01)}
    assert loosest(planted(shifted)) == {"coulomb engine": 1e-4}
    assert loosest(planted(shifted, study=100)) == {"coulomb engine": 1e-10}


def test_a_run_that_does_not_finish_makes_its_setting_insufficient():
    measured = planted()
    runs = [
        Ran(3, ran.method, ran.setting, "diverged", "far out") if (ran.matrix, ran.setting) == (3, 1e-4) else ran
        for ran in measured.runs
    ]
    rows = rows_of(replace(measured, runs=runs), 1e-4)
    assert all(row.bias is None and not row.is_sufficient for row in rows.values())
    assert rows["mean n_stick"].reason == "1 of 40 runs did not finish; matrix 3 diverged: far out"
    assert loosest(replace(measured, runs=runs)) == {"coulomb engine": 1e-8}


def test_a_matrix_whose_reference_did_not_finish_takes_no_part():
    measured = planted()
    reference = REFERENCES["coulomb"]
    runs = [
        Ran(3, *reference, "collapsed", "at rest")
        if (ran.matrix, ran.method, ran.setting) == (3, *reference)
        else ran
        for ran in measured.runs
    ]
    rows = rows_of(replace(measured, runs=runs), 1e-4)
    assert {row.n_matrices for row in rows.values()} == {N_MATRICES - 1}
    assert all(row.is_sufficient for row in rows.values())


def test_intervals_are_those_of_the_paired_t_test_and_of_the_mean():
    measured = planted({1e-4: (0.4, 0.5)})
    runs = [ran for ran in measured.runs if ran.setting == 1e-4]
    others = [ran for ran in measured.runs if (ran.method, ran.setting) == REFERENCES["coulomb"]]
    found = paired("mean n_stick", runs, others, 0.95)
    expected = stats.ttest_rel([ran.mean for ran in runs], [ran.mean for ran in others]).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), rel=1e-9)

    scatter = np.std([ran.mean for ran in others], ddof=1)
    for study in (5, 20, N_MATRICES):
        half = stats.t.ppf(0.975, study - 1) * scatter / study**0.5
        assert sampling_error("mean n_stick", others, study, 0.95).value == pytest.approx(half, rel=1e-9)


def test_gamma_of_the_planted_sizes():
    """gamma = -log(1 - 1 / mean size): of twice the sizes minus of the sizes."""
    runs = [Ran(m, "coulomb engine", 1e-4, "finished", None, 1.0, 1.0, 1.0, size, 10, 1.0, 1.0)
            for m, size in enumerate((18, 22, 20))]  # fmt: skip
    doubled = [replace(ran, total_size=2 * ran.total_size) for ran in runs]
    assert paired("gamma (events)", doubled, runs, 0.95).value == pytest.approx(np.log(0.5) - np.log(0.75))
    single = [replace(ran, total_size=ran.n_cascades) for ran in runs]
    found = paired("gamma (events)", single, runs, 0.95)
    assert found.value is None
    assert "every cascade has size 1" in found.reason


# ---------------------------------------------------------------------------------------------- the scene


def test_the_tightest_settings_are_the_defaults_of_the_shipped_ensembles():
    scene = load_chart(shipped()["statistics"])
    assert [scene.coulomb_tolerances[0], scene.sigmoid_tolerances[0]] == [1e-10, 1e-6]


BAD = {
    "burn-in too long": ("t_burn = 1.0", "t_burn = 40.0", "t_burn: expected less than t_end = 40", "shorten"),
    "one matrix": ("matrices = 4", "matrices = 1", "matrices: expected a value greater", "got 1"),
    "too loose": ("1e-3]", "1e-2]", "coulomb_tolerances[1]: expected a value less", "got 0.01"),
    "too tight": ("[1e-6,", "[1e-8,", "sigmoid_tolerances[0]: expected a value greater", "got 1e-08"),
}


@pytest.mark.parametrize("mistake", BAD)
def test_a_bad_chart_is_refused_with_key_and_remedy_and_nothing_is_written(mistake, refuse):
    refuse(TINY, *BAD[mistake])


# ---------------------------------------------------------------------------------------------- measuring


def test_a_tiny_chart_end_to_end(scene_file, tmp_path, capsys, in_this_process):
    out = tmp_path / "out"
    assert main(["run", str(scene_file), "--out", str(out)]) == 0
    assert "Exact law, the coulomb engine: " in capsys.readouterr().out
    page = (out / "report.html").read_text()
    assert "A tiny &lt;chart&gt;" in page
    assert not re.search(r"\b(nan|inf|None)\b", page.split("</figure>")[1])
    assert "https://" not in page

    runs = pd.read_parquet(out / "report" / "runs.parquet")
    assert len(runs) == 4 * (2 + 6)
    done = runs[runs.outcome == "finished"]
    assert len(done)
    assert (done.products > 0).all()
    assert runs.reason[runs.outcome != "finished"].notna().all()
    settings = pd.read_parquet(out / "report" / "settings.parquet")
    assert len(settings) == (2 + 6) * len(STATISTICS)
    assert set(settings.method) == set(METHODS)
    tight = settings[(settings.method == "coulomb engine") & (settings.setting == 1e-8)]
    assert tight.bias.abs().max() < 1e-4  # of a path that is right the statistics are
    chosen = pd.read_parquet(out / "report" / "loosest.parquet")
    assert len(chosen) == 2 * len(METHODS) * (1 + len(STATISTICS))  # studies of 2 and of 3 matrices
    chosen = chosen[chosen.statistic.isna() & (chosen.study == 3)].set_index("method")
    assert list(chosen.index) == list(METHODS)
    assert chosen.tightest["coulomb engine"] == 1e-8
    as_json = json.loads((out / "report" / "tables.json").read_text())
    assert {row["bias"] for row in as_json["settings"] if row["is_reference"]} == {None}


def test_statistics_of_a_run_by_hand(scene_file, monkeypatch):
    """Two of ten blocks stick from t = 2 to 3, one of them from 5 on; a stick before the window, from 0.2 to 0.4."""
    events = sim.EventSeries(
        np.array([0.2, 0.4, 2.0, 2.0, 3.0, 3.0, 5.0]), np.array([0, 0, 0, 1, 0, 1, 0], np.int32),
        np.array([0, 1, 0, 0, 1, 1, 0], np.int8), -np.ones(10, np.int8), 0.0, 5.0,
    )  # fmt: skip
    run = sim.Run(np.zeros(10), np.zeros(10), 5.0, events, "finished", "", sim.Stats(1, 0, 1, 7))
    monkeypatch.setattr(statistics, "_run", lambda *args: run)
    scene = load_chart(scene_file).model_copy(update={"t_burn": 1.0, "t_end": 5.0})
    system = sim.System(np.eye(10), 1.0)
    found = statistics._ran(scene, system, Product(np.eye(10)), 0, "coulomb engine", 1e-4)
    assert (found.mean, found.deviation) == pytest.approx((0.5, 0.75**0.5))  # a quarter of the time at 2
    assert found.exit_rate == pytest.approx(2 / 10 / 4)
    assert (found.total_size, found.n_cascades) == (2, 1)


# ---------------------------------------------------------------------------------------------- the words


def test_words_say_how_loose_what_it_saves_and_why_no_looser(scene, page, said, undrawn):
    report = page(scene, planted())
    first, remains, by_statistic, looser = said(report)[:4]
    assert first.startswith("Exact law: The coulomb engine may be as loose as tol = 1e-4: 1,000 products a run")
    assert "4 times less than the 4,000 at tol = 1e-10" in first
    assert "What remains at tol = 1e-4: mean n_stick" in remains
    assert "mean n_stick at tol = 1e-4; sd of n_stick at tol = 1e-3;" in by_statistic
    assert "at tol = 1e-3 the bias of mean n_stick is +2.5" in looser
    assert "beyond the sampling error" in looser


def test_words_change_when_nothing_is_sufficient_or_everything_is(scene, page, said, undrawn):
    assert "No setting of the coulomb engine" in said(page(scene, planted({1e-10: (3.0, 0.1)})))[0]
    lines = said(page(scene, planted({1e-10: (0.0, 0.1)})))
    assert lines[0].endswith("that is the tightest asked for.")
    assert "Nothing looser than tol = 1e-10 was asked for" in lines[3]


def test_noise_is_not_called_a_move(scene, page, said, undrawn):
    lines = said(page(scene, planted({1e-10: (0.0, 0.01), 1e-4: (0.0, 4.0)})))
    assert "none is shown, but one beyond the sampling error" in lines[3]


def test_a_tighter_setting_that_is_cheaper_is_named(scene, page, said, undrawn):
    measured = planted()
    runs = [replace(ran, products=300.0) if ran.setting == 1e-8 else ran for ran in measured.runs]
    first = said(page(scene, replace(measured, runs=runs)))[0]
    assert "tighter and yet cheaper is tol = 1e-8 with 300, 13 times less than at tol = 1e-10" in first


def test_methods_for_the_same_law_are_compared_where_both_are_sufficient(scene, page, said, undrawn):
    engine = planted({1e-10: (0.0, 0.1)})
    stepping = [ran for ran in planted({0.1: (0.0, 0.1)}, "Moreau-Jean").runs if ran.setting == 0.1]
    measured = replace(engine, runs=engine.runs + [replace(ran, products=12000.0) for ran in stepping])
    lines = said(page(scene, measured))
    assert "Exact law: Moreau-Jean may be as loose as h = 0.1" in "".join(lines)
    assert any("Moreau-Jean at h = 0.1 takes 3 times more products than the coulomb engine" in line for line in lines)


def test_the_figure_holds_every_point_and_the_band():
    """The band of the laws' difference, and points of which a looser one costs more than a tighter one."""
    points = zip((1e-8, 1e-6, 1e-4), (4.0, 1.0, 2.0), (0.0, 0.5, -30.0), (0.1, 0.3, 10.0), strict=True)
    settings = [
        Setting("coulomb engine", setting, cost, [
            Compared("coulomb", "coulomb engine", setting, name, 5, 1.0, bias, bias - half, bias + half, 1.0, cost,
                     is_sufficient=False)
            for name in STATISTICS
        ])
        for setting, cost, bias, half in points
    ]  # fmt: skip
    differences = [Difference(name, 0.5, 0.1, 0.9, None, 1.0) for name in STATISTICS]
    exact, sigmoid, *_ = bias_against_cost({"coulomb engine": Choice("coulomb engine", settings)}, differences).axes
    assert exact.get_ylim()[0] < -40.0
    assert {text.get_text(): text.get_va() for text in exact.texts} == {
        "1e-8": "top",
        "1e-6": "top",
        "1e-4": "bottom",
    }
    line = next(line for line in exact.lines if len(line.get_xdata()) == 3)
    assert list(line.get_ydata()) == [0.0, 0.5, -30.0]
    assert [line.get_ydata()[0] for line in sigmoid.lines] == [0.5]


def test_a_diverged_run_is_on_the_page_with_its_reason(scene, page, said, undrawn):
    measured = planted()
    lost = Ran(0, "Moreau-Jean", 0.3, "diverged", "|z| passed 1e+12")
    html = page(scene, replace(measured, runs=[*measured.runs, lost])).html
    assert "diverged: |z| passed 1e+12" in html
    assert "No setting of Moreau-Jean" in html
