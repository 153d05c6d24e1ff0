"""What all charts share: a page of what was measured, with tables and figures, and scenes that are refused."""

import os
import subprocess
import sys
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from pydantic import Field

from stickslip.pipeline.machine.processes import ONE_THREAD
from stickslip.workflows import gallery
from stickslip.workflows.commands import main
from stickslip.workflows.gallery.charts import ChartScene, Several, Shown, cost, formats, runner
from stickslip.workflows.scenes import chart_of, shipped


@dataclass(frozen=True)
class Row:
    n: int
    value: float | None
    count: int | None = None


@dataclass(frozen=True)
class Measured:
    rows: list[Row]
    events: list[tuple[float, str]]


class PlantedScene(ChartScene):
    chart: Literal["planted"] = Field(description="kind of the chart")
    n: int = Field(description="number of blocks", examples=[20])
    eps: Several[float] = Field(default=(), description="widths")

    def extent(self):
        return "nothing"

    def measure(self, say) -> Measured:
        say(f"measuring {self.n}")
        return Measured([Row(self.n, 0.5), Row(self.n, None, 3)], [(1.0, "entry")])

    def show(self, measured):
        def draw():
            return Figure()

        return Shown({"n_rows": len(measured.rows)}, runner.frames(measured, "rows"), {"drawn": draw})


TEMPLATE = """{% extends "chart.html" %}
{% from "macros.html" import figure %}
{% block answer %}
<li>There are {{ n_rows }} &lt;rows&gt;,
 the first {{ measured.rows[0].value|power }}.</li>
{% endblock %}
{% block chart %}
{% call figure("drawn", "nothing") %}Nothing.{% endcall %}
{{ table(cells(measured.rows, [("n", "n", "%d"), ("value", "value", "%.1e")])) }}
{% endblock %}
"""


@pytest.fixture
def planted(tmp_path, monkeypatch):
    """The file of a scene of a chart of our making, and where its report goes."""
    (tmp_path / "planted.html").write_text(TEMPLATE)
    (tmp_path / "scene.toml").write_text('chart = "planted"\ntitle = "A planted <chart>"\nn = 5\n')
    monkeypatch.setitem(gallery.CHARTS, "planted", f"{__name__}:PlantedScene")
    monkeypatch.setattr(gallery, "chart", lambda name: PlantedScene)
    monkeypatch.setattr(runner, "_folder", lambda scene: tmp_path)
    return tmp_path / "scene.toml", tmp_path / "out"


def run(planted, capsys):
    file, out = planted
    assert main(["run", str(file), "--out", str(out)]) == 0
    return capsys.readouterr()


def test_the_page_its_headline_and_its_tables(planted, capsys):
    printed = run(planted, capsys)
    assert "A planted <chart>\nThere are 2 <rows>, the first 5e-1.\n" in printed.out
    assert "measuring 5" in printed.err
    page = (planted[1] / "report.html").read_text()
    assert "A planted &lt;chart&gt;" in page
    assert '<td data-head="value">5.0e-01</td>' in page  # an exponent keeps its sign as it is written
    assert '<td data-head="value">–</td>' in page
    assert {file.name for file in (planted[1] / "report" / "figures").iterdir()} == {"drawn.svg", "drawn.pdf"}
    rows = pd.read_parquet(planted[1] / "report" / "rows.parquet", dtype_backend="pyarrow")
    assert [*zip(rows["value"].fillna(0.0), rows["count"].fillna(0), strict=True)] == [(0.5, 0), (0.0, 3)]


ONE_THREADED = """
import os, sys
from stickslip.workflows.commands import main
from stickslip.workflows.commands.run import Run

def count(self, arguments):
    import numba
    import numpy as np
    np.ones((500, 500)) @ np.ones((500, 500))
    return numba.config.NUMBA_NUM_THREADS - 1 or len(os.listdir("/proc/self/task")) - 1

Run.__call__ = count
sys.exit(main(["run", "speed_accuracy"]))
"""


def test_the_command_that_measures_has_one_thread():
    """Libraries are loaded once it has said so."""
    free = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
    assert subprocess.run([sys.executable, "-c", ONE_THREADED], env=free).returncode == 0


BAD = {
    "unknown chart": ('"planted"', '"plant"', "chart: expected 'limit' or 'one_block' or ", "got 'plant'"),
    "unknown key": ("n = 5", "n = 5\nnumber = 5", "number: unknown key", "remove it"),
    "missing key": ("n = 5\n", "", "n: expected the number of blocks", "add `n = 20`"),
    "wrong type": ("n = 5", 'n = "five"', "n: expected", "e.g. `n = 20`"),
    "twice the same": ("n = 5", "n = 5\neps = [0.1, 0.1]", "eps: expected each value once", "0.1"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", BAD)
def test_a_bad_chart_is_refused_with_key_and_remedy_and_nothing_is_written(mistake, planted, refuse):
    refuse(planted[0].read_text(), *BAD[mistake])


@pytest.mark.parametrize("name", sorted(name for name, file in shipped().items() if chart_of(file)))
def test_what_ships_explains_its_keys(name):
    file = shipped()[name]
    lines = [line for line in file.read_text().splitlines() if " = " in line and not line.startswith("#")]
    assert all("#" in line for line in lines)
    if not name.startswith("fig"):  # one of the paper's, which leaves most to the defaults
        assert {line.split(" = ")[0] for line in lines} == set(type(gallery.load_chart(file)).model_fields)


@pytest.mark.parametrize("name", ["one_block", "two_blocks"])
def test_a_scene_of_the_field_is_what_its_keys_say_by_default(name):
    shown, other = gallery.load_chart(shipped()[name]), {"about", "minutes", "title"}
    assert shown.model_dump(exclude=other) == type(shown)(chart=name).model_dump(exclude=other)


@pytest.mark.parametrize(
    ("name", "extent"),
    [
        ("fig3", "figure 3 of the paper"),
        ("limit", "28 runs, each beside its limits"),
        ("scaling", "6 random systems with either engine and 5 chains"),
        ("speed_accuracy", "12 methods on 6 problems"),
        ("stability", " cells, in one process"),
    ],
)
def test_dry_run_measures_and_writes_nothing(name, extent, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["run", name, "--dry-run"]) == 0
    assert extent in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("value", "words"), [(1234.0, "1,200"), (99.6, "100"), (12.4, "12"), (5.44, "5.4"), (0.0123, "0.012")]
)
def test_a_count_has_two_digits(value, words):
    assert formats.count(value) == words


def test_minus_signs():
    assert formats.minus("v = -0.5, (-1, .5), 1e-06, fixed-step, {+, -}") == (
        "v = −0.5, (−1, .5), 1e-06, fixed-step, {+, −}"
    )


def test_runs_are_timed_until_one_takes_too_long():
    ran = []
    found, timing = cost.timed(lambda: ran.append(None) or len(ran), cost.Product(np.eye(3)), 4)
    assert found == timing.n_runs == len(ran) == 4
    assert 0 < timing.seconds_min <= timing.seconds <= timing.seconds_max
    assert 0 < timing.products_min <= timing.products <= timing.products_max
    assert cost.timed(lambda: None, None, 4, longest=0.0)[1].n_runs == 1
    assert cost.timed(lambda: None, None, 4)[1].products is None
