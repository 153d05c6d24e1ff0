"""The gallery: scenes that are measured in one process, in a room each for charts, the paper and the field; theory.

A chart is named here, in `CHARTS`; what all of them have is in `stickslip.workflows.gallery.charts`.
"""

from __future__ import annotations

from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.scene.source import parse_toml, read_source
from stickslip.pipeline.scene.toml import as_scene

if TYPE_CHECKING:
    from stickslip.analysis import Report
    from stickslip.workflows.gallery.charts import ChartScene

#: Where the scene of each chart is, loaded when it is asked for. A line here, and the command knows a chart.
CHARTS = {
    "limit": "stickslip.workflows.gallery.charts.limit:LimitScene",
    "one_block": "stickslip.workflows.gallery.field.one_block:OneBlockScene",
    "paper": "stickslip.workflows.gallery.paper.chart:PaperScene",
    "scaling": "stickslip.workflows.gallery.charts.scaling:ScalingScene",
    "speed_accuracy": "stickslip.workflows.gallery.charts.speed_accuracy:SpeedScene",
    "stability": "stickslip.workflows.gallery.charts.stability:StabilityScene",
    "two_blocks": "stickslip.workflows.gallery.field.two_blocks:TwoBlocksScene",
}


def chart(name: str) -> type[ChartScene]:
    """The scene of the chart of that name; KeyError if there is none."""
    scene: type[ChartScene] = resolve_name(CHARTS[name])
    return scene


def load_chart(file: Path) -> ChartScene:
    """Read a scene file that `stickslip.workflows.scenes.chart_of` found to be a chart.

    Raises `SceneError` if it is not a scene of a known chart; one line a problem.
    """
    table = parse_toml(read_source(file), str(file))
    if table["chart"] not in CHARTS:
        raise SceneError(
            f"{file}: chart: expected {' or '.join(map(repr, CHARTS))}, got {table['chart']!r}; without the key"
            " `chart` it is an ensemble"
        )
    return as_scene(chart(table["chart"]), table, str(file))


def report(scene: ChartScene, measured: Any) -> Report:
    """The page of a chart, from the result of its `measure`."""
    from stickslip.workflows.gallery.charts import runner

    return runner.report(scene, measured)
