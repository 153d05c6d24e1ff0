"""Ensembles from Python: run a scene with a progress bar, and look at its dataset."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stickslip.pipeline import Scene, Status, expand, extend, query, run_ensemble, status
from stickslip.pipeline.dataset.opened import dataset_scene, near, open_dataset
from stickslip.pipeline.errors import QueryError
from stickslip.pipeline.places.place import Where
from stickslip.workflows.progress import Watch
from stickslip.workflows.scenes import find, load, with_known_questions

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from distributed import Client
    from numpy.typing import NDArray

    from stickslip.pipeline.ensemble.member import Member
    from stickslip.sim import EventSeries

#: Members among whose names one is looked for that is like an unknown one.
MOST_NEAR = 10_000


@dataclass(frozen=True)
class Dataset:
    """The dataset at a directory or an address; each access reads its present state.

    Raises
    ------
    StoreError
        If there is no readable dataset.
    """

    path: Where

    def __post_init__(self) -> None:
        open_dataset(self.path)

    @property
    def scene(self) -> Scene:
        """The scene that made it."""
        return dataset_scene(self.path)

    @property
    def status(self) -> Status:
        """Its progress: counts, outcomes, failures."""
        return status(self.path)

    @property
    def members(self) -> pd.DataFrame:
        """One row a member: parameters, outcome, counts; see `stickslip.members`."""
        return query.members(self.path)

    def member(self, member_id: str) -> Member:
        """One member: its `system()` and `start()`, drawn anew, and its run, `simulate()`.

        A function that makes its system is looked for in the working directory, and run by `system` in this process.

        Raises
        ------
        QueryError
            If the scene has no such member.
        """
        members = expand(self.scene)
        place = next((k for k, name in enumerate(members.ids()) if name == member_id), None)
        if place is None:
            known = list(islice(members.ids(), MOST_NEAR))
            raise QueryError(f"member_id: expected a member of the scene, got {member_id!r}{near(member_id, known)}")
        return members[place]

    def n_stick(self, member_id: str) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Times, and how many blocks of a member stick from each to the next; see `stickslip.n_stick`."""
        return query.n_stick(self.path, member_id)

    def events(self, member_id: str) -> EventSeries:
        """Every event of a member, where the scene records them; see `stickslip.pipeline.query.events`."""
        return query.events(self.path, member_id)

    @property
    def episodes(self) -> pd.DataFrame:
        """One row an episode, where the scene records them; see `stickslip.pipeline.query.episodes`."""
        return query.episodes(self.path)

    @property
    def clusters(self) -> pd.DataFrame:
        """One row a connected part of an episode; see `stickslip.pipeline.query.clusters`."""
        return query.clusters(self.path)

    @property
    def profiles(self) -> pd.DataFrame:
        """One row a block of a cluster, with its slip; see `stickslip.pipeline.query.profiles`."""
        return query.profiles(self.path)

    def query(self, sql: str) -> pd.DataFrame:
        """The answer to a question in SQL; see `stickslip.sql`."""
        return query.sql(self.path, sql)

    def extend(self, record: Mapping[str, Any], out: Where, workers: int = 2, *, quiet: bool = False) -> Dataset:
        """Another dataset with more records, as `stickslip.pipeline.extend` makes it.

        With the progress on the standard error.

        Parameters
        ----------
        record : mapping of str to value
            Keys under [record], as in ``{"waiting": True, "t_burn": 50.0}``.
        out : str, Path or Place
            Directory of the new dataset, or its address.
        workers : int
            Local processes; 0 computes in this one.
        quiet : bool
            Whether to show nothing.

        Raises
        ------
        SceneError, StoreError, ValueError, ScheduleError
            As there.
        """
        with nullcontext() if quiet else Watch(out) as watch:
            extend(self.path, record, out, workers, on_progress=watch)
        return Dataset(out)

    def findings(self) -> pd.DataFrame:
        """What the page of the report says, one row a quantity at a setting.

        Returns
        -------
        DataFrame
            question, leads (whether it stands on the first screen), sentence, quantity, setting, estimate, low, high,
            compared_with, compared_value, compared_low, compared_high (its own value, where no other row has that),
            difference, difference_low, difference_high, scale ("relative" to it, or "absolute"), margin,
            verdict, n and unit (of the independent units); null where there is none.

        Raises
        ------
        StoreError
            If there is no report yet, or it is one of an earlier version.
        """
        from stickslip.workflows.reporting import findings

        return findings(self.path)

    def report(self, own: bool = False, pdf: bool = False) -> str:
        """Write the report, unless it is up to date; returns the name of its page.

        Parameters
        ----------
        own : bool
            Whether to answer the scene's questions `module:function`. That runs the code beside the scene, or beside
            the dataset; the report is then always made again. A question that fails is a warning, and a line of the
            page.
        pdf : bool
            Whether to draw figures as PDF too; the report is then always made again.
        """
        from stickslip.analysis.page import PAGE
        from stickslip.workflows import own_questions, reporting
        from stickslip.workflows.asking import Asking
        from stickslip.workflows.fresh import is_current

        opened = open_dataset(self.path)
        if is_current(opened) and not pdf and not (own and own_questions.names(opened.scene)):
            return opened.place.named(PAGE)
        with Asking(opened.folder if own else None, pdf, opened=opened) as asking, Watch(opened.place) as watch:
            built = reporting.report(opened, asking, watch.answered)
        for name, problem in built.problems.items():
            warnings.warn(f"{name}: {problem}", stacklevel=2)
        return reporting.write(built, opened.place)


def run_scene(
    scene: Scene | str | Path,
    out: Where,
    workers: int = 2,
    scheduler: str | Client | None = None,
    *,
    retry_failed: bool = False,
    accept_version: bool = False,
    quiet: bool = False,
) -> Dataset:
    """Run a scene as `stickslip.pipeline.run_ensemble` does, with its progress on the standard error.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, a scene file, or the name of one that ships.
    out, workers, scheduler, retry_failed, accept_version
        As there.
    quiet : bool
        Whether to show nothing.

    Raises
    ------
    SceneError
        If the scene cannot be used; one line a problem.
    ValueError, StoreError, AddressError, ScheduleError
        As there.
    """
    loaded = with_known_questions(scene, "scene") if isinstance(scene, Scene) else load(find(str(scene)))
    with nullcontext() if quiet else Watch(out) as watch:
        run_ensemble(loaded, out, workers, scheduler, watch, retry_failed, accept_version)
    return Dataset(out)
