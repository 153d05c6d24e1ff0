"""The chart `paper`: the paper's figures, computed again, and what its text says of them, counted.

Exact law unless a law is named; dimensionless.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from typing import Any

import pandas as pd

from stickslip.analysis.questions.cascades import PAPER_GAMMA
from stickslip.workflows.charts import Say, Shown
from stickslip.workflows.charts.runner import frame
from stickslip.workflows.paper import claims, figure_6, figures_1_2, figures_3_to_5
from stickslip.workflows.paper.claims import Certified, Claim, OneBlock, Pair, Survival
from stickslip.workflows.paper.figure_6 import BlowUp, Branches, SlowEvent, SlowRun, Undetermined
from stickslip.workflows.paper.figures_1_2 import ONE, Corner, Parallelogram, Portrait
from stickslip.workflows.paper.figures_3_to_5 import Cascades, Change, Draw, Sizes, Trace
from stickslip.workflows.paper.systems import LAWS, PaperSystems


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of. Empty where a figure is not asked for."""

    portraits: list[Portrait]
    parallelograms: list[Parallelogram]
    traces: list[Trace]
    figure3: list[Draw]
    figure4: list[Change]
    cascades: list[Cascades]
    sizes: list[Sizes]
    uniqueness: list[Pair]
    one_block: list[OneBlock]
    survival: list[Survival]
    certificate: list[Certified]
    blow_ups: list[BlowUp]
    slow_runs: list[SlowRun]
    branches: list[Branches]
    undetermined: list[Undetermined]


class PaperScene(PaperSystems):
    """A scene with ``chart = "paper"``."""

    libraries = ("scipy", "dask")

    def extent(self) -> str:
        numbers = ", ".join(map(str, self.figures))
        also = " and its claims" if self.claims else ""
        return f"figure{'s' if len(self.figures) > 1 else ''} {numbers} of the paper{also}"

    def measure(self, say: Say) -> Measured:
        """All that the figures show and the text claims, in this process but for the ensembles."""
        found = Measured(*([] for _ in Measured.__dataclass_fields__))
        if 1 in self.figures:
            found.portraits.extend(map(figures_1_2.portrait, (-ONE[3], ONE[3])))
        if 2 in self.figures:
            found.parallelograms.extend((figures_1_2.parallelogram(1), figures_1_2.parallelogram(-1)))
        if 3 in self.figures:
            for n, matrix, law in product(self.n, range(self.draws), LAWS):
                run = self.run(self.system(n, matrix), self.t_end, law)
                found.figure3.append(figures_3_to_5.draw(run, n, matrix, law, self.t_end))
                if matrix == 0:
                    found.traces.append(figures_3_to_5.trace(run, 3, f"n = {n}", law, self.t_shown))
            say(f"figure 3: {len(found.figure3)} runs")
        if 4 in self.figures:
            for trace, change in figures_3_to_5.sensitivity(self):
                found.traces.append(trace)
                found.figure4.extend([] if change is None else [change])
            say(f"figure 4: {len(found.figure4)} changes")
        if 5 in self.figures:
            for law in LAWS:
                rows, shown, counts = figures_3_to_5.long_runs(self, law)
                found.cascades.extend(rows)
                found.traces.extend(shown)
                found.sizes.extend(counts)
                say(f"figure 5: {self.long_matrices} runs, {law}")
        if self.claims:
            found.survival.extend(claims.survival(self))
            say(f"survival: {sum(row.n_draws for row in found.survival)} runs")
            asked = product(self.certificate_n, range(self.certificate_draws))
            found.certificate.extend(claims.certified(self, n, matrix) for n, matrix in asked)
            say(f"certificate: {len(found.certificate)} runs")
            found.uniqueness.extend(claims.around_a_double_exit())
            found.one_block.append(claims.one_block(self))
        if 6 in self.figures:
            found.blow_ups.extend(figure_6.blow_ups())
            found.slow_runs.extend(figure_6.slow_run(side) for side in (1, -1))
            found.branches.append(figure_6.branches(found.slow_runs[0].t[-1]))
            found.undetermined.append(figure_6.undetermined())
        return found

    def show(self, measured: Measured) -> Shown:
        """Tables: `corners`, `figure3`, `figure4`, `cascades`, `hidden`, `futures`, those of the figures asked for;
        of the claims `claims`, `survival`, `certificate`.
        """
        draws = product(self.n, LAWS) if measured.figure3 else ()
        drawn = {
            1: partial(figures_1_2.phase_portraits, measured.portraits),
            2: partial(figures_1_2.parallelograms, measured.parallelograms),
            3: partial(figures_3_to_5.figure3, measured.traces),
            4: partial(figures_3_to_5.figure4, measured.traces),
            5: partial(figures_3_to_5.figure5, measured.traces, measured.cascades, measured.sizes),
            6: partial(figure_6.fast_flows, measured.blow_ups),
            "slow": lambda: figure_6.slow_modes(measured.branches[0], measured.slow_runs),
            "open": lambda: figure_6.open_futures(measured.undetermined[0]),
            "survival": partial(claims.survival_curve, measured.survival, self.survival_t_end),
        }
        facts = {
            "drawn": drawn,
            "draws": [figures_3_to_5.draws_in_numbers(measured.figure3, n, law) for n, law in draws],
            "changes": figures_3_to_5.changes_in_numbers(measured.figure4),
            "laws": figures_3_to_5.laws_in_numbers(measured.cascades),
            "late": claims.lateness(measured.certificate),
            "share": claims.share,
            "level": claims.CONFIDENCE,
            "law_name": figures_3_to_5.curve_name,
            "paper_gamma": PAPER_GAMMA,
            "early": figures_3_to_5.EARLY,
            "pair": figures_1_2,
            "force": figure_6.FORCE,
            "claimed": claims,
        }
        return Shown(facts, self._tables(measured))

    def _tables(self, measured: Measured) -> dict[str, pd.DataFrame]:
        corners = [corner for one in measured.parallelograms for corner in one.corners]
        slow = [event for run in measured.slow_runs for event in run.events]
        futures = [
            {"ratio": one.ratio, "v": one.v, "z": one.z, "begins": future.begins, "t_end": future.t[-1]}
            | {"t_events": [t for t, _ in future.events], "events": [kind for _, kind in future.events]}
            for one in measured.undetermined
            for future in one.futures
        ]
        of_figures: dict[int, dict[str, Any]] = {
            2: {"corners": frame(corners, Corner)},
            3: {"figure3": frame(measured.figure3, Draw)},
            4: {"figure4": frame(measured.figure4, Change)},
            5: {"cascades": frame(measured.cascades, Cascades)},
            6: {"hidden": frame(slow, SlowEvent), "futures": pd.DataFrame(futures)},
        }
        tables = {name: table for number in self.figures for name, table in of_figures.get(number, {}).items()}
        if self.claims:
            counted = list(claims.claims(measured.uniqueness, measured.one_block, measured.survival))
            tables["claims"] = frame(counted, Claim)
            tables["survival"] = pd.DataFrame([asdict(row) | _moving(row) for row in measured.survival])
            tables["certificate"] = frame(measured.certificate, Certified)
        return tables


def _moving(row: Survival) -> dict[str, float]:
    value, low, high = claims.share(row.moving, row.n_draws)
    return {"moving": row.moving, "moving_share": value, "moving_low": low, "moving_high": high}
