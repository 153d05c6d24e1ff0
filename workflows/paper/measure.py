"""The paper's figures, computed again, and what its text says of them, counted.

Exact law unless a law is named; dimensionless.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import product
from typing import Any, get_args, get_type_hints

from stickslip.workflows.charts import Say
from stickslip.workflows.charts.alone import versions
from stickslip.workflows.paper.blocks import ONE, Parallelogram, Path2, Portrait, parallelogram, portrait
from stickslip.workflows.paper.claims import (
    Certified,
    OneBlock,
    Pair,
    Survival,
    around_a_double_exit,
    certified,
    one_block,
    survival,
)
from stickslip.workflows.paper.hidden import (
    BlowUp,
    Branches,
    Future,
    SlowRun,
    Undetermined,
    blow_ups,
    branches,
    slow_run,
    undetermined,
)
from stickslip.workflows.paper.runs import (
    Cascades,
    Change,
    Draw,
    Sizes,
    Trace,
    draw,
    long_runs,
    sensitivity,
    trace,
)
from stickslip.workflows.paper.scene import LAWS, PaperScene


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of; plain values, which JSON carries. Empty where a figure is not asked for."""

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
    versions: dict[str, str]

    @classmethod
    def restore(cls, found: dict[str, Any]) -> Measured:
        hints = get_type_hints(cls)
        values = dict(found)
        for name in (field.name for field in fields(cls) if field.name != "versions"):
            row: type = get_args(hints[name])[0]
            values[name] = [row(**one) for one in found[name]]
        values["parallelograms"] = [
            Parallelogram(one["sign"], one["corners"], [Path2(**path) for path in one["paths"]])
            for one in found["parallelograms"]
        ]
        values["undetermined"] = [
            Undetermined(**one | {"futures": [Future(**future) for future in one["futures"]]})
            for one in found["undetermined"]
        ]
        return cls(**values)


def measure(scene: PaperScene, say: Say) -> Measured:
    """Compute all that the figures of a scene show and the text claims, in this process but for the ensembles."""
    asked = scene.figures
    traces: list[Trace] = []
    draws: list[Draw] = []
    changes: list[Change] = []
    laws: list[Cascades] = []
    sizes: list[Sizes] = []
    if 3 in asked:
        for n, matrix, law in product(scene.n, range(scene.draws), LAWS):
            run = scene.run(scene.system(n, matrix), scene.t_end, law)
            draws.append(draw(run, n, matrix, law, scene.t_end))
            if matrix == 0:
                traces.append(trace(run, 3, f"n = {n}", law, scene.t_shown))
        say(f"figure 3: {len(draws)} runs")
    if 4 in asked:
        for shown_trace, change in sensitivity(scene):
            traces.append(shown_trace)
            changes += [] if change is None else [change]
        say(f"figure 4: {len(changes)} changes")
    if 5 in asked:
        for law in LAWS:
            rows, shown, counts = long_runs(scene, law)
            laws, traces, sizes = laws + rows, traces + shown, sizes + counts
            say(f"figure 5: {scene.long_matrices} runs, {law}")
    uniqueness, one_blocks, fates, certificate = _claims(scene, say) if scene.claims else ([], [], [], [])
    return Measured(
        portraits=[portrait(v) for v in (-ONE[3], ONE[3])] if 1 in asked else [],
        parallelograms=[parallelogram(1), parallelogram(-1)] if 2 in asked else [],
        traces=traces,
        figure3=draws,
        figure4=changes,
        cascades=laws,
        sizes=sizes,
        uniqueness=uniqueness,
        one_block=one_blocks,
        survival=fates,
        certificate=certificate,
        blow_ups=blow_ups() if 6 in asked else [],
        slow_runs=(slow_runs := [slow_run(side) for side in (1, -1)] if 6 in asked else []),
        branches=[branches(slow_runs[0].t[-1])] if 6 in asked else [],
        undetermined=[undetermined()] if 6 in asked else [],
        versions=versions("scipy", "dask"),
    )


def _claims(scene: PaperScene, say: Say) -> tuple[list[Pair], list[OneBlock], list[Survival], list[Certified]]:
    fates = survival(scene)
    say(f"survival: {sum(row.n_draws for row in fates)} runs")
    rows = [certified(scene, n, k) for n in scene.certificate_n for k in range(scene.certificate_draws)]
    say(f"certificate: {len(rows)} runs")
    return around_a_double_exit(), [one_block(scene)], fates, rows
