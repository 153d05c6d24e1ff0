"""The page of the chart `paper`: each figure beside the paper's, and what its text claims beside the counts."""

from __future__ import annotations

from dataclasses import asdict
from itertools import product

import pandas as pd
from jinja2 import Environment

from stickslip.analysis import Report
from stickslip.analysis.report.figures import embedded
from stickslip.analysis.report.page import page_environment
from stickslip.analysis.report.words import capital
from stickslip.workflows.charts import Kind
from stickslip.workflows.paper import claim_words, words
from stickslip.workflows.paper import figures as paper_figures
from stickslip.workflows.paper.claims import Survival
from stickslip.workflows.paper.measure import Measured, measure
from stickslip.workflows.paper.scene import LAWS, PaperScene


def build(scene: PaperScene, measured: Measured) -> Report:
    """The figures, their captions, the claims and the tables.

    Tables: `corners`, `figure3`, `figure4`, `cascades`, `hidden`, `futures`, those of the figures asked for; of the
    claims `claims`, `survival`, `certificate`.

    Parameters
    ----------
    scene : PaperScene
    measured : Measured
        What `stickslip.workflows.paper.measure` found for that scene.
    """
    drawings = {
        1: lambda: words.figure1(measured),
        2: lambda: words.figure2(measured),
        3: lambda: words.figure3(scene, measured),
        4: lambda: words.figure4(scene, measured),
        5: lambda: words.figure5(scene, measured),
        6: lambda: words.figure6(measured),
    }
    drawn = [drawings[number]() for number in scene.figures]
    answer = {f"Figure {one.number}, {one.title}": _lines(scene, measured, one) for one in drawn}
    if scene.claims:
        answer["Claims"] = claim_words.claim_words(scene, measured)
    answer = {title: [words.minus(line) for line in lines] for title, lines in answer.items()}
    survival, curve = measured.survival, None
    if survival:
        moving, stable, diverged = (claim_words.shares(survival, name) for name in ("moving", "stable", "diverged"))
        curve = embedded(paper_figures.survival(moving, stable, diverged, scene.survival_t_end))
    draws = product(scene.n, LAWS) if measured.figure3 else ()
    html = _environment().get_template("paper.html").render(
        scene=scene,
        answer=answer,
        drawings=[(one, embedded(one.figure), [(embedded(f), text) for f, text in one.beside]) for one in drawn],
        draws=[(n, law, words.figure3_words(measured.figure3, n, law)) for n, law in draws],
        measured=measured,
        survival=survival,
        curve=curve,
        late=claim_words.lateness(measured),
        level=f"{100 * words.CONFIDENCE:g}%",
        law_name=words.curve_name,
        versions=measured.versions,
    )  # fmt: skip
    headline = [scene.title, *(f"{title}: {line}" for title, lines in answer.items() for line in lines)]
    return Report(html, _tables(scene, measured), headline)


def _tables(scene: PaperScene, measured: Measured) -> dict[str, pd.DataFrame]:
    tables: dict[str, pd.DataFrame] = {}
    if 3 in scene.figures:
        tables["figure3"] = pd.DataFrame(map(asdict, measured.figure3))
    if scene.claims:
        tables["claims"] = pd.DataFrame(map(asdict, claim_words.claims(measured))).astype({"found": "Int64"})
        tables["survival"] = pd.DataFrame([asdict(row) | _moving(row) for row in measured.survival])
        tables["certificate"] = pd.DataFrame(map(asdict, measured.certificate)).astype({"n_after": "Int64"})
    if 4 in scene.figures:
        tables["figure4"] = pd.DataFrame(map(asdict, measured.figure4))
    if 5 in scene.figures:
        tables["cascades"] = pd.DataFrame(map(asdict, measured.cascades))
    if 2 in scene.figures:
        tables["corners"] = pd.DataFrame(
            [
                {"sign": one.sign, "lambda_1": a, "lambda_2": b, "z_1": x, "z_2": y, "fold_1": f, "fold_2": g}
                for one in measured.parallelograms
                for a, b, x, y, f, g in one.corners
            ]
        )
    if 6 in scene.figures:
        tables["hidden"] = pd.DataFrame(
            [
                {"from_side": run.side, "t": t, "kind": kind, "cause": cause, "block": block}
                | {f"lambda_{k + 1}_{when}": lam[k] for when, lam in (("before", a), ("after", b)) for k in range(2)}
                for run in measured.slow_runs
                for t, kind, cause, block, a, b in run.events
            ]
        )
        tables["futures"] = pd.DataFrame(
            [
                {"ratio": one.ratio, "v": one.v, "z": one.z, "begins": future.begins, "t_end": future.t[-1]}
                | {"t_events": [t for t, _ in future.events], "events": [kind for _, kind in future.events]}
                for one in measured.undetermined
                for future in one.futures
            ]
        )
    return tables


def _moving(row: Survival) -> dict[str, float]:
    value, low, high = words.share(row.moving, row.n_draws)
    return {"moving": row.moving, "moving_share": value, "moving_low": low, "moving_high": high}


def _lines(scene: PaperScene, measured: Measured, one: words.Drawing) -> list[str]:
    """The statements at the page's head on one figure."""
    if one.number == 3:
        return [f"n = {n}: {words.figure3_words(measured.figure3, n)}" for n in scene.n]
    if one.number == 4:
        return words.change_words(measured.figure4)
    if one.number == 5:
        return words.law_words(measured.cascades)
    return [capital(one.same), *(text for _, text in one.beside)]


def _environment() -> Environment:
    environment = page_environment("stickslip.workflows.paper", "stickslip.workflows.charts")
    environment.filters["minus"] = words.minus
    return environment


def _extent(scene: PaperScene) -> str:
    numbers = ", ".join(map(str, scene.figures))
    also = " and its claims" if scene.claims else ""
    return f"figure{'s' if len(scene.figures) > 1 else ''} {numbers} of the paper{also}"


KIND = Kind(PaperScene, _extent, measure, Measured.restore, build)
