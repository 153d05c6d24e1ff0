"""From a dataset to its report: the one place where the pipeline's rooms hand over to the analysis."""

from __future__ import annotations

from collections.abc import Callable

from stickslip.analysis import AnalysisSettings, Report, build
from stickslip.analysis.report.comparison import Ensemble, compare
from stickslip.analysis.report.page import PAGE, Image, on_demand
from stickslip.analysis.report.section import Data, Recipe
from stickslip.pipeline import Scene, Status, StoreError, dataset_scene, status
from stickslip.pipeline.query import all_events, by_threshold, members, separations, series
from stickslip.pipeline.storage import Directory, Where, place_of
from stickslip.version import __version__


def report(path: Where, drawn_by: Callable[[Recipe], Image] = on_demand) -> tuple[Report, Status]:
    """Build the report of the dataset at `path` from the dataset alone, under the settings of its scene.

    `drawn_by` has the figures drawn, as in `analysis.build`: `workflows.drawing.Drawing` does so beside the
    statistics.

    Raises
    ------
    pipeline.StoreError
        If there is no readable dataset, or no member of it is done yet.
    """
    scene, found = _opened(path)
    frame = members(path)
    provenance = _provenance(scene, found)
    picked = sorted(set(frame.picked_for.dropna()))
    provenance["tolerances"] = f"picked for {' and '.join(picked)} where not given" if picked else "given"
    data = Data(
        frame,
        series={member_id: (t, n_stick) for member_id, t, n_stick in series(path)},
        events={member_id: (e.t, e.block, e.mode, e.initial_mode) for member_id, e in all_events(path)},
        separations={member_id: (t, distance) for member_id, t, distance in separations(path)},
        thresholds={(member_id, c): (t, n_stick) for member_id, c, t, n_stick in by_threshold(path)},
    )
    return build(data, _settings(scene), scene.title or name_of(path), scene.about, provenance, drawn_by), found


def compared(path: Where, other: Where) -> Report:
    """Set the statistics of two datasets side by side, under the settings and margins of the first one's scene.

    Raises
    ------
    pipeline.StoreError
        If one is no readable dataset, or no member of it is done yet.
    ValueError
        If they have nothing in common.
    """
    places = (path, other)
    opened = [_opened(where) for where in places]
    names = [name_of(where) for where in places]
    if names[0] == names[1]:
        names = [str(place_of(where)) for where in places]
    ensembles = [
        Ensemble(
            name,
            Data(members(where), {member_id: (t, n_stick) for member_id, t, n_stick in series(where)}),
            scene.analysis.t_burn,
            scene.analysis.margins.model_dump(),
            _provenance(scene, found),
        )
        for where, name, (scene, found) in zip(places, names, opened, strict=True)
    ]
    return compare(ensembles[0], ensembles[1], _settings(opened[0][0]))


def _opened(path: Where) -> tuple[Scene, Status]:
    scene, found = dataset_scene(path), status(path)
    if found.n_done == 0:
        raise StoreError(f"{path}: no member is done yet; run the scene first")
    return scene, found


def name_of(path: Where) -> str:
    """The last part of a directory or an address."""
    return str(place_of(path)).rstrip("/").rpartition("/")[2]


def _settings(scene: Scene) -> AnalysisSettings:
    return AnalysisSettings(
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


def _provenance(scene: Scene, found: Status) -> dict[str, str]:
    return {
        "stickslip": __version__,
        "scene": scene.hash,
        "seed": str(scene.run.seed),
        "members": f"{found.n_done} of {found.n_members}",
        "coupling": scene.system.coupling,
    }


def write(built: Report, where: Where) -> str:
    """Write a report into a directory or to an address, the page last; return the name of the page.

    Raises
    ------
    OSError
        If a file cannot be written; files already there stay whole.
    """
    place = place_of(where)
    if isinstance(place, Directory):
        place.path.mkdir(parents=True, exist_ok=True)
    for name, content in built.files().items():
        place.replace(name, content)
    return place.named(PAGE)
