"""Charts: scenes that are measured in one process on one core, where an ensemble is run.

A kind of chart is a schema of its scene, a measurement and a page. What was measured is plain values in a
dataclass, which crosses from the process that measures as JSON.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.scene import MINUTES
from stickslip.pipeline.toml import Positive, StrictTable, as_scene, parse_toml, read_source

if TYPE_CHECKING:
    from stickslip.analysis import Report

#: Told of each thing as it is done.
Say = Callable[[str], None]


class ChartError(RuntimeError):
    """The measurement ended before it was done."""


class ChartScene(StrictTable):
    """The keys that every chart has."""

    title: str = Field(default="", description="one line for the report's head")
    about: str = Field(default="", description="what the scene is for")
    minutes: Positive | None = Field(default=None, description=MINUTES, examples=[1.0])
    seed: int = Field(default=0, ge=0, lt=2**63, description="seed of all random draws", examples=[0])


@dataclass(frozen=True)
class Kind:
    """One kind of chart.

    Attributes
    ----------
    scene : subclass of ChartScene
    extent : function of a scene to str
        What would be measured, for a dry run.
    measure : function of (scene, say) to a dataclass of plain values
    restore : function of that dataclass's values, as JSON gives them back, to the dataclass
    build : function of (scene, measured) to a Report
    """

    scene: type[ChartScene]
    extent: Callable[[Any], str]
    measure: Callable[[Any, Say], Any]
    restore: Callable[[dict[str, Any]], Any]
    build: Callable[[Any, Any], Report]


#: The module of each kind, which holds it as KIND: loaded when it is asked for.
KINDS = {
    "paper": "stickslip.workflows.paper.page",
    "scaling": "stickslip.workflows.charts.scaling_page",
    "speed_accuracy": "stickslip.workflows.charts.speed_accuracy_page",
    "stability": "stickslip.workflows.charts.stability_page",
    "statistics": "stickslip.workflows.charts.statistics_page",
}


def kind(chart: str) -> Kind:
    """The kind of chart of that name; KeyError if there is none."""
    found: Kind = import_module(KINDS[chart]).KIND
    return found


def load_chart(file: Path) -> tuple[Kind, Any]:
    """Read a scene file that `stickslip.workflows.scenes.chart_of` found to be a chart: its kind and its scene.

    Raises
    ------
    SceneError
        If it is not a scene of a known chart; one line a problem.
    """
    table = parse_toml(read_source(file), str(file))
    if table["chart"] not in KINDS:
        raise SceneError(
            f"{file}: chart: expected {' or '.join(map(repr, KINDS))}, got {table['chart']!r}; without the key"
            " `chart` it is an ensemble"
        )
    found = kind(table["chart"])
    return found, as_scene(found.scene, table, str(file))
