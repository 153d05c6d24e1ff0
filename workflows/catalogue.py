"""The events of a dataset as one earthquake catalogue, in CSV."""

from __future__ import annotations

import os
from pathlib import Path

from stickslip.analysis import catalogue
from stickslip.pipeline import query
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.design.units import TIMES
from stickslip.pipeline.places.place import Where
from stickslip.workflows.export import whole


def write(dataset: Where, out: str | os.PathLike[str]) -> None:
    """Write a row an event: a cluster where the scene records `clusters`, else an episode; with what is swept.

    Columns are those of `stickslip.analysis.catalogue`, member_id, matrix, and each of the keys of systems and of
    engines whose values differ.

    Raises `QueryError` if the scene records neither, or the file cannot be written or is part of the dataset;
    `StoreError` if there is no readable dataset.
    """
    opened = open_dataset(dataset)
    design = opened.design
    events = query.clusters(opened) if opened.scene.record.clusters else query.episodes(opened)
    keys = ["n", "file", "seed", "engine", *(key for axis in design.axes for key in axis.keys)]
    keys += [name for method in design.methods for name, _ in method.settings]
    scalars = query.scalar_names(opened)
    known = [key for key in dict.fromkeys(keys) if key in scalars]
    members = query.members(opened, ["member_id", "matrix", *known])
    told = [key for key in known if members[key].nunique(dropna=False) > 1]
    table = catalogue(events, TIMES.get(opened.scene.unit_names.time, 1.0))
    rows = members.set_index("member_id")[["matrix", *told]].loc[table["member_id"]].reset_index(drop=True)
    rows = rows.rename(columns={name: f"{name}_of_member" for name in rows if name in table})
    with whole(Path(out), dataset, "--catalogue") as stream:
        table.join(rows).to_csv(stream, index=False, date_format="%Y-%m-%dT%H:%M:%S.%fZ")
