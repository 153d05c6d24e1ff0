"""Figures drawn beside the statistics are those drawn without it, whatever becomes of the process that draws."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from stickslip.analysis.report import figures
from stickslip.analysis.report.page import on_demand
from stickslip.workflows.drawing import Drawing
from tests.processes import is_running, until


def levels(count: int) -> partial[Figure]:
    """A recipe as the report has them: a function of `analysis`, and plain data."""
    row = {"definition": "events", "n_cascades": 1, "share": 0.5, "share_low": None, "share_high": None}
    rows = [row | {"size": size + 1, "share_fit": 0.5, "share_chance": 0.4} for size in range(count)]
    return partial(figures.distributions, rows, {"events": f"{count} sizes"})


def failing() -> Figure:
    raise ZeroDivisionError("no figure")


def test_images_are_those_drawn_here() -> None:
    recipes = [levels(count) for count in range(1, 6)]
    with Drawing() as draw:
        images = [draw(recipe) for recipe in recipes]
        assert [image() for image in images] == [on_demand(recipe)() for recipe in recipes]
        assert images[2]() == images[2]()  # as often as asked


@pytest.mark.parametrize("seconds", [0.0, 0.4, 0.8, 1.2])
def test_a_dead_process_costs_no_figure(seconds: float) -> None:
    """Killed before it has loaded what it needs, while it draws, or when it has drawn some."""
    with Drawing() as draw:
        images = [draw(levels(count)) for count in range(1, 6)]
        time.sleep(seconds)
        draw._child.kill()
        assert [image() for image in images] == [on_demand(levels(count))() for count in range(1, 6)]


def test_an_error_of_a_recipe_is_heard_here() -> None:
    with Drawing() as draw:
        image = draw(failing)
        with pytest.raises(ZeroDivisionError, match="no figure"):
            image()


def test_the_process_outlives_neither_its_use_nor_its_owner() -> None:
    with Drawing() as draw:
        assert is_running(draw._child.pid)
    assert not is_running(draw._child.pid)

    code = (
        "import time; from stickslip.workflows.drawing import Drawing\n"
        "drawing = Drawing(); print(drawing._child.pid, flush=True); time.sleep(60)"
    )
    root = Path(__file__).parents[2]
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=root) as owner:
        assert owner.stdout is not None
        drawer = int(owner.stdout.readline())
        os.kill(owner.pid, signal.SIGKILL)
    until(lambda: not is_running(drawer))
