"""From a dataset to its report: the one place where the pipeline's rooms hand over to the analysis."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

from analysis import AnalysisSettings, Report, build
from analysis.section import Data
from pipeline import Status, dataset_scene, status
from pipeline.query import all_events, by_threshold, members, separations, series


def report(path: Path) -> tuple[Report, Status]:
    """Build the report of the dataset at `path` from the dataset alone, under the settings of its scene.

    Raises
    ------
    pipeline.StoreError
        If there is no readable dataset.
    ValueError
        If no member is there yet.
    """
    scene, found = dataset_scene(path), status(path)
    if found.n_done == 0:
        raise ValueError(f"{path}: no member is done yet; run the scene first")
    settings = AnalysisSettings(
        t_burn=scene.analysis.t_burn,
        dt=scene.analysis.dt,
        resamples=scene.analysis.resamples,
        confidence=scene.analysis.confidence,
        seed=scene.run.seed,
        map_dt=scene.analysis.map_dt or (),
        tau=scene.analysis.tau,
        smallest=scene.analysis.smallest,
        margins=scene.analysis.margins.model_dump(),
    )
    provenance = {
        "stickslip": version("stickslip"),
        "scene": scene.hash,
        "seed": str(scene.run.seed),
        "members": f"{found.n_done} of {found.n_members}",
        "coupling": scene.system.coupling,
    }
    frame = members(path)
    picked = sorted(set(frame.picked_for.dropna()))
    provenance["tolerances"] = f"picked for {' and '.join(picked)} where not given" if picked else "given"
    data = Data(
        frame,
        series={member_id: (t, n_stick) for member_id, t, n_stick in series(path)},
        events={member_id: (e.t, e.block, e.mode, e.initial_mode) for member_id, e in all_events(path)},
        separations={member_id: (t, distance) for member_id, t, distance in separations(path)},
        thresholds={(member_id, c): (t, n_stick) for member_id, c, t, n_stick in by_threshold(path)},
    )
    return build(data, settings, scene.title or path.name, scene.about, provenance), found
