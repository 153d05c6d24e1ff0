"""From a dataset to its report: the one place where the pipeline's rooms hand over to the analysis."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from stickslip.analysis import AnalysisSettings, Data, Report, Study, build
from stickslip.analysis.report import PAGE
from stickslip.analysis.report.comparison import Ensemble, compare
from stickslip.analysis.report.page import Answered
from stickslip.pipeline import Scene, Status, StoreError, dataset_scene, status
from stickslip.pipeline.errors import printable
from stickslip.pipeline.places.directory import Directory
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.manifest import read_manifest
from stickslip.pipeline.places.place import Where
from stickslip.pipeline.query import all_events, by_threshold, episodes, members, separations, series
from stickslip.pipeline.scene.quantity import short
from stickslip.version import __version__
from stickslip.workflows.fresh import made_from, name_of
from stickslip.workflows.scenes import with_known_questions

#: Who puts the questions of a dataset: its path, its study, and whom to tell how many are answered.
Asking = Callable[[str, Study, Callable[[int, int], None]], list[Answered | None]]


@lru_cache(maxsize=1)
def study_of(path: str) -> Study:
    """A dataset with what its scene declares; the last one is kept, with its groups filled."""
    return Study(_data(path), _settings(dataset_scene(path)))


def _data(path: Where) -> Data:
    """A dataset as the analysis sees it, its series read where they are asked for."""
    table = members(path)
    scene = dataset_scene(path)
    table["matrix"] += scene.run.matrices * table["seed"].map(_seeds(scene).index)  # another seed is other systems
    if names := list(scene.system.parameters or ()):
        rows = zip(*(table[name].map(short) for name in names), strict=True)
        words = ["; ".join(map("{} = {}".format, names, row)) for row in rows]
        table = table.drop(columns=names).assign(parameters=words)  # one may have a name that analysis gives a column
    for name in ("file", "parameters", "reason"):  # words from outside, which pages and figures show
        if name in table and table[name].notna().any():
            table[name] = table[name].map(printable if name == "reason" else _drawable, na_action="ignore")
    return Data(
        table,
        series=series(path),
        events=all_events(path),
        separations=separations(path),
        thresholds=by_threshold(path),
        episodes=episodes(path) if scene.record.episodes else None,
    )


def _drawable(text: str) -> str:
    """Words that are valid in HTML and SVG; matplotlib takes what is between two dollars for a formula."""
    return printable(text).replace("$", r"\$")


def report(
    path: Where, asking: Asking | None = None, on_answer: Callable[[int, int], None] = lambda *_: None
) -> Report:
    """Build the report of the dataset at `path` from the dataset alone, under the settings of its scene.

    Raises
    ------
    pipeline.StoreError
        If there is no readable dataset, or no member of it is done yet.
    """
    scene, found = _opened(path)
    return build(
        _data(path), _settings(scene), printable(scene.title or name_of(path)), printable(scene.about),
        _provenance(scene, found),
        None if asking is None else (lambda study: asking(str(path), study, on_answer)), made_from(path),
    )  # fmt: skip


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
            printable(name),
            _data(where),
            scene.analysis.t_burn,
            scene.analysis.margins.model_dump(),
            _provenance(scene, found),
            read_manifest(where).digest,
        )
        for where, name, (scene, found) in zip(places, names, opened, strict=True)
    ]
    return compare(ensembles[0], ensembles[1], _settings(opened[0][0]))


def _opened(path: Where) -> tuple[Scene, Status]:
    scene, found = dataset_scene(path), status(path)
    if found.n_done == 0:
        raise StoreError(f"{path}: no member is done yet; run the scene first")
    return scene, found


def _seeds(scene: Scene) -> tuple[int, ...]:
    return scene.run.seed if isinstance(scene.run.seed, tuple) else (scene.run.seed,)


def _settings(scene: Scene) -> AnalysisSettings:
    with_known_questions(scene, "scene")
    asked = scene.analysis.model_dump() | {"seed": _seeds(scene)[0], "map_dt": scene.analysis.map_dt or ()}
    return AnalysisSettings(**asked)


def _provenance(scene: Scene, found: Status) -> dict[str, str]:
    return {
        "stickslip": __version__,
        "scene": scene.hash,
        "seed": ", ".join(map(str, _seeds(scene))),
        "members": f"{found.n_done} of {found.n_members}",
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
        (place.path / "report" / "figures").mkdir(parents=True, exist_ok=True)
    for name, content in built.files().items():
        place.replace(name, content)
    return place.named(PAGE)
