"""n_stick by further definitions of sticking, from the same run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Record
from stickslip.sim.engines import SETTINGS
from stickslip.sim.engines.contract import Numbers
from stickslip.sim.runs.series import summaries


def has_several(settings: Mapping[str, Any]) -> bool:
    """Whether an engine with some settings has event series by further definitions of sticking."""
    return any(value for name, value in settings.items() if isinstance(SETTINGS[name], Numbers))


class Thresholds(Record):
    """n_stick where a block sticks if |w - v| < threshold r_i eps."""

    name = "thresholds"
    words = ""
    asked_by = '`thresholds = [0.5, 1.0, 2.0]` under [[engine]] name = "sigmoid"'
    columns = (
        Column(
            "n_stick by",
            "by_threshold",
            "t and n_stick of the same run where a block sticks if |w - v| < threshold r_i eps; null if not sigmoid",
        ),
    )

    @classmethod
    def asked(cls, keys: Mapping[str, Any], settings: Mapping[str, Any]) -> Self | None:
        return cls() if has_several(settings) else None

    def of(self, result: Made) -> dict[str, Any]:
        by_threshold = result.run.by_threshold
        if not by_threshold:
            return {}
        changes = zip(by_threshold, summaries([*by_threshold.values()]), strict=True)
        return {
            "by_threshold": [{"threshold": c, "t": summary.t, "n_stick": summary.n_stick} for c, summary in changes]
        }
