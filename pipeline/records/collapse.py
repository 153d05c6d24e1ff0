"""Record of when it is certain that no block sticks again."""

from __future__ import annotations

from typing import Any

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Record


class CollapseRecord(Record):
    """The time from which on all blocks slip for ever: see `stickslip.sim.engines.certificates.Collapse`."""

    name = "collapse"
    words = (
        "whether each run is tested for collapse whenever all blocks slip, even where that costs more than it saves"
    )
    is_certified = True
    columns = (
        Column(
            "number",
            "t_collapse",
            "from when on it is certain that no block sticks again; null if that is not",
            least=0.0,
            absent="no collapse is certain",
            is_averaged=False,
            dimension="time",
        ),
    )

    def of(self, result: Made) -> dict[str, Any]:
        return {"t_collapse": result.run.t_collapse}
