"""From a dataset to its report: the one place where the pipeline's rooms hand over to the analysis."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from itertools import starmap

import numpy as np
import pandas as pd
import pyarrow as pa

from stickslip.analysis import AnalysisSettings, Data, Report, Study, build
from stickslip.analysis.ensemble import Numbers, Recorded
from stickslip.analysis.members import READ, Members
from stickslip.analysis.page import FINDINGS, PAGE
from stickslip.analysis.page.comparison import Ensemble, compare
from stickslip.analysis.page.parts import Answered, Row, Said
from stickslip.analysis.questions import renamed
from stickslip.analysis.rows import frame_of
from stickslip.analysis.session import defaults
from stickslip.pipeline import Scene, StoreError, expand
from stickslip.pipeline.dataset.opened import Opened, open_dataset
from stickslip.pipeline.design.design import Coordinates
from stickslip.pipeline.errors import printable
from stickslip.pipeline.places.directory import Directory
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.place import Where
from stickslip.pipeline.query import (
    Shards,
    all_events,
    by_threshold,
    episodes,
    lists,
    members_in_parts,
    scalar_names,
    separations,
    series,
)
from stickslip.pipeline.scene.columns import DESIGN
from stickslip.pipeline.scene.systems import SystemFile
from stickslip.sim.runs.run import Samples
from stickslip.sim.runs.series import EventSeries
from stickslip.version import __version__
from stickslip.workflows.fresh import LIST, UNFINISHED, made_from, name_of
from stickslip.workflows.scenes import with_known_questions

#: A line of `LIST`, whoever wrote it: a sha256 and a name, as `sha256sum` writes them.
_LISTED = re.compile(r"([0-9a-f]{64})  (report/(?:tables\.json|(?:figures/)?[\w-]+\.(?:parquet|csv|svg|pdf)))")

#: Columns of members that no question of this package looks at.
_UNASKED = (
    "perturbation_draw", "picked_for", "reproduce", "n_stick_end", "n_events", "n_entries", "n_exits", "n_crossings",
    "n_steps", "n_rejected", "n_products", "drawn", *(column.name for column in DESIGN),
)  # fmt: skip

#: Beyond this a number counts as none: float64 does not hold the products of which statistics are sums.
_LARGEST = 1e100
_BEYOND = f"beyond {_LARGEST:g}, of which there are no statistics"

#: Who puts the questions of a dataset: the dataset, its study, and whom to tell how many are answered.
Asking = Callable[[Opened, Study, Callable[[int, int], None]], list[Answered | None]]


def study_of(path: Where | Opened, whole: bool = False) -> Study:
    """A dataset with what its scene declares; `whole`: with columns that no question of this package looks at."""
    opened = open_dataset(path)
    return Study(_data(opened, whole), _settings(opened.scene))


def _data(opened: Opened, whole: bool = False, at_once: bool = False) -> Data:
    """A dataset as the analysis sees it, its series read where they are asked for."""
    scene, names, shards = opened.scene, scalar_names(opened), Shards(opened, at_once)
    columns_kept = [column for record in scene.records_in_order for column in record.kept if column.is_number]
    values, problems = {column.name: list[np.ndarray]() for column in columns_kept}, dict[str, dict[str, str]]()
    by_users = () if scene.own_record is None else scene.own_record.kept
    all_of_users = ",".join(column.name for column in by_users)
    systems = _systems(scene)

    def prepared(frame: pd.DataFrame, coordinates: Coordinates) -> pd.DataFrame:
        for name, columns in values.items():
            numbers = frame[name].to_numpy(np.float64, na_value=np.nan)
            is_beyond = np.abs(numbers) > _LARGEST
            if is_beyond.any():
                problems.setdefault(name, {}).update(dict.fromkeys(frame["member_id"][is_beyond], _BEYOND))
            columns.append(np.where(is_beyond, np.nan, numbers))
        if by_users:
            failed = frame[frame["own_problem"].notna()]
            # data of an earlier version do not say of which columns: of any
            lost = failed["own_lost"] if "own_lost" in failed else [all_of_users] * len(failed)
            for member_id, why, names in zip(failed["member_id"], failed["own_problem"], lost, strict=True):
                for name in names.split(","):
                    problems.setdefault(name, {})[member_id] = printable(why)
        if systems:
            frame["system"] = [systems[of_file] for of_file in zip(frame["file"], frame["matrix"], strict=True)]
        return _prepared(scene, frame).assign(**coordinates._asdict())

    columns = (column for record in scene.records for column in record.columns)
    with_members = partial(  # before these are read: `at_once` all but lists is read with them
        Data,
        series=series(shards),
        events=all_events(shards),
        separations=separations(shards),
        thresholds=by_threshold(shards),
        lists={column.name: lists(opened, column.name) for column in columns if column.kind == "numbers"},
    )
    # the design has parameters, which may have a name that the analysis gives a column
    names_read = [name for name in names if name not in scene.parameters and (whole or name not in _UNASKED)]
    table = Members.of(starmap(prepared, members_in_parts(shards, names_read)), opened.design)
    pa.default_memory_pool().release_unused()  # else what reading took would stay taken, 150 bytes a member
    recorded = {
        column.name: Recorded(
            printable(column.words),
            Numbers(table, np.concatenate(values.pop(column.name))),
            column.least,
            printable(column.absent),
            problems.get(column.name, {}),
            printable(column.words) if column in by_users else column.called,  # a user's is called what they say
            bool(column.title),
            column.kind == "yes or no",
            None if column.until is None else column.until.start(scene.record_t_burn),
            column.of_gaps,
            column.most,
            column.dimension,
        )
        for column in columns_kept
    }
    return with_members(
        table,
        episodes=episodes(opened) if scene.record.episodes else None,
        recorded=recorded,
        is_loaded=scene.run.load is not None,
        again=partial(_again, opened),
    )


def _again(opened: Opened, member_id: str, since: float, n: int) -> tuple[EventSeries, Samples] | None:
    """A member run again: its events, and n states from a time to its end, in the units of the data.

    None where its system or its start is no part of the dataset: a reader of it runs no code and opens no file.
    """
    members = expand(opened.scene)
    member = next(member for name, member in zip(members.ids(), members, strict=True) if name == member_id)
    if member.source.origin is not None or member.begin.ends is not None:
        return None
    length, speed = member.state_scales
    time = length / speed
    run = member.simulate(np.linspace(min(since / time, member.t_end), member.t_end, n))
    states, events = run.samples, run.events
    scaled = replace(events, t=events.t * time, t_start=events.t_start * time, t_end=events.t_end * time)
    return replace(scaled, unit=opened.scene.unit_names.time), Samples(
        states.t * time, states.z * length, states.w * speed
    )


def _systems(scene: Scene) -> dict[tuple[str, int], str]:
    """What systems from files are called, by file and number: by the file, and the draw if there are several."""
    files = [origin for _, origin in scene.sources if isinstance(origin, SystemFile)]
    draws = range(scene.run.matrices)
    return {
        (file.name, file.matrix(k)): printable(file.name) + f", draw {k}" * (len(draws) > 1)
        for file in files
        for k in draws
    }


def _prepared(scene: Scene, table: pd.DataFrame) -> pd.DataFrame:
    """Some members as the analysis sees them."""
    kept = {column.name for record in scene.records for column in record.kept if column.is_number}
    own = set() if scene.own_record is None else {column.name for column in scene.own_record.kept}
    table = table.drop(columns=[*(kept | own) - {*READ}])  # analysis may add one of that name
    table["matrix"] += scene.run.matrices * table["seed"].map(_seeds(scene).index)  # another seed is other systems
    for name in ("file", "reason"):  # words from outside, which pages and figures show
        if name in table and table[name].notna().any():
            table[name] = table[name].map(printable if name == "reason" else _drawable, na_action="ignore")
    return table


def _drawable(text: str) -> str:
    """Words that are valid in HTML and SVG; matplotlib takes what is between two dollars for a formula."""
    return printable(text).replace("$", r"\$")


@defaults()
def report(
    path: Where | Opened, asking: Asking | None = None, on_answer: Callable[[int, int], None] = lambda *_: None
) -> Report:
    """Build the report of the dataset at `path` from the dataset alone, under the settings of its scene.

    Raises `pipeline.StoreError` if there is no readable dataset, no member of it is done yet, or a run replaces what
    the report reads.
    """
    opened = _begun(path)
    scene = opened.scene
    return build(
        _data(opened, at_once=opened.is_small),
        _settings(scene),
        printable(scene.title or name_of(opened.place)),
        printable(scene.about),
        _provenance(opened),
        None if asking is None else (lambda study: asking(opened, study, on_answer)),
        made_from(opened),
    )


@defaults()
def compared(path: Where, other: Where) -> Report:
    """Set the statistics of two datasets side by side, under the settings and margins of the first one's scene.

    Raises `pipeline.StoreError` if one is no readable dataset, no member of it is done yet, or a run replaces what is
    compared; `ValueError` if they have nothing in common.
    """
    places = (path, other)
    begun = [_begun(where) for where in places]
    names = [name_of(where) for where in places]
    if names[0] == names[1]:
        names = [str(place_of(where)) for where in places]
    ensembles = [
        Ensemble(
            printable(name),
            _data(opened),
            opened.scene.analysis.t_burn,
            opened.scene.analysis.margins.declared,
            _provenance(opened),
            opened.manifest.digest,
        )
        for name, opened in zip(names, begun, strict=True)
    ]
    first, second = (opened.scene.unit_names for opened in begun)
    if first != second:
        raise ValueError(f"expected two datasets in the same units, got {first or 'none'} and {second or 'none'}")
    return compare(ensembles[0], ensembles[1], _settings(begun[0].scene))


def _begun(path: Where | Opened) -> Opened:
    """A dataset of which some members are done."""
    opened = open_dataset(path)
    if opened.n_done == 0:
        raise StoreError(f"{opened.place}: no member is done yet; run the scene first")
    return opened


def _seeds(scene: Scene) -> tuple[int, ...]:
    return scene.run.seed if isinstance(scene.run.seed, tuple) else (scene.run.seed,)


def _settings(scene: Scene) -> AnalysisSettings:
    with_known_questions(scene, "scene")
    declared = scene.analysis
    changed = {
        "seed": _seeds(scene)[0],
        "map_dt": declared.map_dt or (),
        "margins": declared.margins.declared,
        "question": renamed(declared.question),
        "published": declared.published.declared,
        "names": scene.system.block_names,
        "units": scene.unit_names,
        **({} if scene.scales is None else {"time": scene.scales.time, "tau": _tau(scene)}),
    }
    return AnalysisSettings(**(declared.model_dump() | changed))


def _tau(scene: Scene) -> tuple[float, ...]:
    """Gaps as the scene declares them; those that are left out are dimensionless."""
    declared = scene.analysis
    assert scene.scales is not None
    unit = 1.0 if "tau" in declared.model_fields_set else scene.scales.time
    return tuple(unit * tau for tau in declared.tau)


def _provenance(opened: Opened) -> dict[str, str]:
    scene = opened.scene
    return {
        "stickslip": __version__,
        "scene": scene.hash,
        "seed": ", ".join(map(str, _seeds(scene))),
        "members": f"{opened.n_done} of {opened.n_members}",
    }


@defaults()
def findings(where: Where) -> pd.DataFrame:
    """The findings of a report, as `stickslip.Dataset.findings` has them."""
    opened = open_dataset(where)
    (content,) = opened.place.read_each([FINDINGS])
    if content is None:
        raise StoreError(f"{opened.place}: expected {FINDINGS}, got no such file; `stickslip report DIR` writes it")
    try:
        rows = [
            (Said(finding["question"], finding["leads"], finding["sentence"]), row)
            for finding in json.loads(content)["findings"]
            for row in [Row(**values) for values in finding["rows"]] or [Row()]
        ]
        tables = frame_of(Said, (head for head, _ in rows)), frame_of(Row, (row for _, row in rows))
        unsaid = ["form"] + ["measured_in"] * (not opened.scene.unit_names)
        return pd.concat(tables, axis="columns").drop(columns=unsaid)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise StoreError(
            f"{opened.place}: {FINDINGS} is damaged ({error}); `stickslip report DIR` writes it"
        ) from None


@defaults()
def write(built: Report, where: Where) -> str:
    """Write a report into a directory or to an address; return the name of the page.

    The page comes after what it names; then files of earlier reports are removed that this one lacks, as all list
    theirs in `report/files.txt`, each with the sha256 that it has to have: a file that somebody else put there stays.
    One that is killed on the way leaves a list of all that may be there, which says so.

    Raises `OSError` if a file cannot be written; files already there stay whole.
    """
    place = place_of(where)
    if isinstance(place, Directory):
        place.make()
        place.remove_left()
    files, (listing,) = built.files(), place.read_each([LIST])
    lines = [] if listing is None else listing.decode(errors="replace").splitlines()
    earlier = {match[2]: match[1] for line in lines if (match := _LISTED.fullmatch(line))}
    digests: dict[str, str] = {}

    def content(name: str) -> bytes:
        data = files[name]()
        digests[name] = hashlib.sha256(data).hexdigest()
        return data

    place.replace(LIST, _lines([UNFINISHED], earlier))
    place.replace_all({name: partial(content, name) for name in files})
    for name, sha256 in earlier.items():
        (stored,) = place.read_each([name]) if name not in files else [None]
        if stored is not None and hashlib.sha256(stored).hexdigest() == sha256:
            place.remove(name)
    place.replace(LIST, _lines([], digests))
    return place.named(PAGE)


def _lines(first: Iterable[str], files: Mapping[str, str]) -> bytes:
    return "".join(f"{line}\n" for line in (*first, *(f"{files[name]}  {name}" for name in files))).encode()
