"""Where members stand in the design of their ensemble: by what they are, in datasets that grow, and in older ones."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from pandas import DataFrame
from pandas.testing import assert_frame_equal

from stickslip.pipeline import StoreError, expand, extend, parse_scene, query, run_ensemble, verify
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.design.design import Kind, Unit
from stickslip.pipeline.ensemble.numbering import Numbering
from stickslip.pipeline.scene.columns import DESIGN
from stickslip.workflows import reporting

#: A finished dataset of the version before the design was kept.
EARLIER = Path(__file__).parent / "earlier"

HEAD = """
[system]
coupling = "antisymmetric"
n = [4, 5]
friction = {friction}
static = [{{ratio = 1.2}}, {{ratio = 1.5}}]
[start]
z = {z}
w = "belt"
draws = {draws}
[run]
t_end = 30.0
matrices = {matrices}
seed = {seed}
[[engine]]
name = "coulomb"
tol = 1e-6
[[engine]]
name = "sigmoid"
eps = {eps}
rtol = 1e-5
atol = 1e-5
ratio = "uniform"
ratio_draws = 2
[perturbation]
sizes = [0.01, 0.05]
draws = 2
readings = ["relative"]
[twins]
sizes = [1e-6]
[analysis]
t_burn = 5.0
dt = [1.0]
"""
KEYS = {
    "friction": "[0.8, 1.0]", "z": "{uniform = [-0.5, 0.5]}", "draws": 2, "matrices": 2, "seed": "[7, 8]",
    "eps": "0.05",
}  # fmt: skip


def scene(**keys):
    return parse_scene(HEAD.format(**KEYS | keys).encode())


def numbered(*scenes):
    """The numbering of the last of some scenes that grew from each other, and its members."""
    found = None
    for one in scenes:
        found = Numbering(expand(one).ensemble, found)
    return found, expand(scenes[-1])


def same(numbers, values):
    """Whether numbers differ just where values do."""
    pairs = set(zip(numbers.tolist(), values, strict=True))
    return len(pairs) == len({number for number, _ in pairs}) == len({value for _, value in pairs})


def check(numbering, members):
    """Coordinates beside what members are."""
    of = numbering.of(members.places)
    every = list(members)
    change = [(m.change.reading, m.change.size, m.change.twin_size) for m in every]
    assert same(of.point, [(m.n, m.term("friction"), m.term("static"), m.begin.z0, m.begin.w0) for m in every])
    assert same(of.method, [(m.engine, m.settings) for m in every])
    assert same(of.change, change)
    assert same(of.unit, [(m.source.matrix, m.source.seed) for m in every])
    number = dict(zip(of.base[of.change == 0].tolist(), np.array(every)[of.change == 0], strict=True))
    unmoved = every[0].change
    for member, base in zip(every, of.base.tolist(), strict=True):
        assert replace(member, change=unmoved, member_id="") == replace(number[base], member_id="")


def test_coordinates_say_what_members_are():
    numbering, members = numbered(scene())
    check(numbering, members)
    design = numbering.design
    assert [axis.name for axis in design.axes] == ["friction", "static"]
    assert {source.unit for source in design.sources} == {Unit.MATRIX}
    assert [change.kind for change in design.changes] == [Kind.NOTHING, Kind.CONSTANTS, Kind.CONSTANTS, Kind.START]
    of = numbering.of(members.places)
    for k in (0, len(members) // 2, len(members) - 1):
        point = design.point(int(of.point[k]))
        assert point.n == members[k].n
        assert point.at[0] == (members[k].term("friction"),)  # noqa: PD008


@pytest.mark.parametrize("grown", [
    {"matrices": 3},
    {"draws": 3},
    {"seed": "[5, 7, 8]"},
    {"friction": "[0.8, 0.9, {uniform = [0.8, 1.2]}, 1.0]"},
    {"eps": "[0.02, 0.05]"},
    {"matrices": 3, "seed": "[5, 7, 8]", "friction": "[0.7, 0.8, 1.0]", "eps": "[0.02, 0.05]"},
])  # fmt: skip
def test_what_had_a_number_keeps_it(grown):
    before, _ = numbered(scene())
    numbering, members = numbered(scene(), scene(**grown))
    check(numbering, members)
    was, now = before.of(np.arange(len(before.ensemble))), numbering.of(numbering.kept)
    for name, mine, theirs in zip(was._fields, was, now, strict=True):
        np.testing.assert_array_equal(mine, theirs, err_msg=name)
    if "friction" in grown:
        points = {numbering.design.point(k).at for k in range(numbering.design.n_points)}
        assert [numbering.design.point(k) for k in range(8)] == [before.design.point(k) for k in range(8)]
        assert len(points) == numbering.design.n_points / 2


@pytest.mark.parametrize(
    ("keys", "unit", "n_units"),
    [
        ({"matrices": 1, "seed": "7", "draws": 3}, Unit.START, 3),
        ({"matrices": 1, "seed": "7", "draws": 1}, Unit.MATRIX, 1),
        ({"matrices": 1, "draws": 3}, Unit.MATRIX, 2),
        (
            {"matrices": 1, "seed": "7", "draws": 3, "z": "[0.1, {uniform = [-0.5, 0.5]}]"},
            Unit.START,
            4,
        ),  # and the matrix
    ],
)
def test_the_starts_of_one_system_are_units_where_they_are_drawn(keys, unit, n_units):
    numbering, members = numbered(scene(**keys))
    of, design = numbering.of(members.places), numbering.design
    assert ({source.unit for source in design.sources}, len(np.unique(of.unit))) == ({unit}, n_units)
    is_drawn = {int(point): member.begin.draw is not None for point, member in zip(of.point, members, strict=True)}
    for point, drawn in is_drawn.items():
        assert design.point(point).unit == (unit if drawn else Unit.MATRIX)


def test_a_million_members_are_numbered_without_going_through_them():
    """The expansion of a large scene holds its points and its draws, not its members."""
    numbering, members = numbered(scene(matrices=15_625))
    assert len(members) == 9_000_000
    some = np.arange(0, len(members), 9)
    of = numbering.of(some)
    assert (of.base <= some).all()
    assert len(np.unique(of.point)) == 8


def rows(path):
    """All rows of a dataset, in the order of its shards."""
    shards = sorted((path / "data").glob("*.parquet"))
    return [row for shard in shards for row in pq.read_table(shard).to_pylist()]


def test_a_dataset_says_it_of_each_row_and_in_its_manifest(tmp_path):
    path, names = tmp_path / "data", [column.name for column in DESIGN]
    small = {"friction": "1.0", "seed": "7", "draws": 1, "z": "0.1"}
    text = HEAD.replace("draws = {draws}\n[run]", "[run]")
    stages = [parse_scene(text.format(**KEYS | small | {"matrices": k}).encode()) for k in (1, 2)]
    for stage in stages:
        run_ensemble(stage, path, workers=0)
    numbering, _ = numbered(*stages)
    opened = open_dataset(path)
    assert opened.manifest.design == numbering.design.as_json() == opened.design.as_json()
    kept = rows(path)
    assert [[row[name] for row in kept] for name in names] == [
        column.tolist() for column in opened.coordinates(sorted(opened.manifest.shards))
    ]
    number = {row["design_base"]: row for row in kept if row["design_change"] == 0}
    assert sorted(number) == [k for k, row in enumerate(kept) if row["design_change"] == 0]
    for row in kept:
        base = number[row["design_base"]]
        shared = ("n", "matrix", "static", "engine", "ratio_draw", "design_point", "design_unit")
        assert all(row[name] == base[name] for name in shared)
    assert verify(path) == []
    # a manifest that says another design is none of this scene
    manifest = opened.manifest.model_copy(update={"design": opened.design.as_json() | {"axes": []}})
    (path / "manifest.json").write_bytes(manifest.to_bytes())
    for read in (verify, query.members):
        with pytest.raises(StoreError, match="expected the design of its scene"):
            read(path)


def test_a_dataset_of_the_version_before_goes_on(tmp_path):
    """It opens, verifies, reports, resumes, grows and is extended; the rows that it had stay what they are."""
    path = shutil.copytree(EARLIER, tmp_path / "data")
    assert verify(path) == []
    before, opened = rows(path), open_dataset(path)
    assert opened.manifest.design is None
    assert "design_point" not in before[0]
    assert query.members(path)["design_point"].isna().all()
    numbering, members = numbered(opened.scene)
    told = [column.tolist() for column in opened.coordinates(sorted(opened.manifest.shards))]
    assert told == [column.tolist() for column in numbering.of(members.places)]
    tables = reporting.report(path).tables

    next((path / "data").iterdir()).unlink()
    run_ensemble(opened.scene, path, workers=0, accept_version=True)
    assert verify(path) == []
    again = rows(path)
    columns = [name for name in before[0] if name not in ("n_steps", "n_rejected", "n_products")]
    # exact runs, with tol = 1e-6, have other series at events by now; sigmoid ones, with 1e-5, another step control
    for is_exact, tol in ((True, 1e-7), (False, 1e-4)):
        old, new = (
            DataFrame([row for row in part if (row["engine"] == "coulomb") == is_exact], columns=columns)
            for part in (before, again)
        )
        assert_frame_equal(new, old, rtol=tol, atol=tol)
    assert {row.get("design_point") is None for row in again} == {True, False}
    for name, table in reporting.report(path).tables.items():
        assert_frame_equal(table, tables[name], rtol=1e-4, atol=1e-9)

    more = path.with_name("more")
    extend(path, {"end": True}, more, workers=0, accept_version=True)
    assert verify(more) == []
    assert not query.members(more)["design_point"].isna().any()
