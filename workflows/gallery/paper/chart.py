"""The chart `paper`: the paper's six figures, computed again, and its claims, judged.

Exact law unless a law is named; dimensionless.
"""

from __future__ import annotations

from functools import partial

import pandas as pd

from stickslip.analysis.answer import Recipe
from stickslip.workflows.gallery.charts import Say, Shown
from stickslip.workflows.gallery.charts.claims import table
from stickslip.workflows.gallery.charts.runner import frame
from stickslip.workflows.gallery.paper import claims, figure_6, figures_1_2, figures_3_to_5
from stickslip.workflows.gallery.paper.asked import Asked, Measured
from stickslip.workflows.gallery.paper.figure_6 import SlowEvent
from stickslip.workflows.gallery.paper.figures_1_2 import ONE, Corner
from stickslip.workflows.gallery.paper.figures_3_to_5 import Cascades, Pairing, Row
from stickslip.workflows.gallery.paper.runs import run_all


class PaperScene(Asked):
    """A scene with ``chart = "paper"``; dimensionless."""

    libraries = ("scipy",)

    def measure(self, say: Say) -> Measured:
        """The measurements that the figures show and the claims are judged by."""
        measured = Measured(*([] for _ in Measured.__dataclass_fields__))
        if 1 in self.figures:
            measured.portraits.extend(map(figures_1_2.portrait, (-ONE[3], ONE[3])))
        if 2 in self.figures:
            measured.parallelograms.extend((figures_1_2.parallelogram(1), figures_1_2.parallelogram(-1)))
            measured.uniqueness.append(figures_1_2.uniqueness())
        if 6 in self.figures:
            measured.blow_ups.extend(figure_6.blow_ups())
            measured.slow_runs.extend(figure_6.slow_run(side) for side in (1, -1))
            measured.modes.extend(figure_6.modes_in_time())
        asks = list(dict.fromkeys(self.asks()))
        paths = []
        for k, path in enumerate(run_all(asks, self.seed, self.eps, self.workers), start=1):
            paths.append(path)
            measured.traces.extend(figures_3_to_5.traces(path, self.t_shown, self.n))
            if k % 20 == 0 or k == len(asks):
                say(f"{k} of {len(asks)} runs")
        measured.runs.extend(figures_3_to_5.rows(paths, self.t_burn))
        measured.pairings.extend(figures_3_to_5.pairings(paths, self.t_burn))
        if 5 in self.figures:
            measured.cascades.extend(figures_3_to_5.cascade_laws(paths, self.n[-1], self.dt, self.t_burn))
        return measured

    def show(self, measured: Measured) -> Shown:
        """Tables: `claims`; and of the figures asked for `corners`, `runs`, `cascades`, `paths`, `hidden`."""
        judged = claims.judge(self, measured)
        corners = [corner for parallelogram in measured.parallelograms for corner in parallelogram.corners]
        slow = [event for run in measured.slow_runs for event in run.events]
        tables: dict[str, pd.DataFrame] = {"claims": table(judged)}
        tables |= {
            name: frame(rows, row)
            for name, rows, row in (
                ("corners", corners, Corner),
                ("runs", measured.runs, Row),
                ("cascades", measured.cascades, Cascades),
                ("paths", measured.pairings, Pairing),
                ("hidden", slow, SlowEvent),
            )
            if rows
        }
        recipes: dict[int, list[Recipe]] = {
            1: [partial(figures_1_2.phase_portrait, portrait) for portrait in measured.portraits],
            2: [
                *(partial(figures_1_2.region, parallelogram) for parallelogram in measured.parallelograms),
                *(partial(figures_1_2.velocities, parallelogram) for parallelogram in measured.parallelograms[:1]),
            ],
            3: figures_3_to_5.panels(measured.traces, 3),
            4: figures_3_to_5.panels(measured.traces, 4),
            5: figures_3_to_5.panels(measured.traces, 5),
            6: [partial(figure_6.fast_flow, flow) for flow in measured.blow_ups],
        }
        if 4 in self.figures:
            recipes[4].append(partial(figures_3_to_5.escape_times, measured.runs, self.t_few))
        if 5 in self.figures:
            recipes[5].append(partial(figures_3_to_5.size_law, measured.cascades))
        if 6 in self.figures:
            recipes[6].append(partial(figure_6.slow_modes, measured.modes, measured.slow_runs))
        figures = {
            f"figure{number}_{k}": recipe
            for number in self.figures
            for k, recipe in enumerate(recipes[number], start=1)
        }
        facts = {"claims": judged, "pair": figures_1_2, "force": figure_6.FORCE, "panels": list(figures)}
        return Shown(facts, tables, figures)
