"""What runs settle on, as columns of a dataset."""

import numpy as np
import pandas as pd
import pytest

from stickslip import Dataset
from stickslip.pipeline import SceneError, expand, parse_scene, query, run_ensemble, verify
from stickslip.sim.attractors import attractor
from stickslip.workflows.gallery.field.one_block import period
from tests.scenes import COULOMB, ON_BELTS, SIGMOID, ensemble

SOURCE = ensemble(
    [1, 3],
    300.0,
    1,
    COULOMB,
    SIGMOID,
    seed="SEED",
    system='coupling = "chain"\nkappa = 1.0\nleaf = 1.0\ndamping = [0.0, 0.5]\nstatic = 1.3\nbelt_speed = -0.2',
    start=f"{ON_BELTS}\ndraws = 2",
    rest="[record]\nattractor = true\nt_burn = 100.0",
)

LISTS = ["section_z", "section_w", "exits_z"]


@pytest.fixture(scope="module")
def scene(module_seed):
    return parse_scene(SOURCE.replace("SEED", str(module_seed)).encode())


def test_columns_are_what_sim_finds(scene, tmp_path):
    run_ensemble(scene, tmp_path / "out", workers=0)
    assert verify(tmp_path / "out") == []
    table = Dataset(tmp_path / "out").members.set_index("member_id")
    lists = {row["member_id"]: row for row in query.table(tmp_path / "out").to_pylist()}
    for member in expand(scene):
        row = table.loc[member.member_id]
        if member.engine == "sigmoid":
            assert row[["attractor", "attractor_reason", "period", "multiplier"]].isna().all()
            assert [lists[member.member_id][name] for name in LISTS] == [None] * len(LISTS)
            continue
        settings = dict(member.settings)
        found = attractor(member.simulate(), member.system(), 100.0, **settings)
        starts = [np.broadcast_to(one, row.n).tolist() for one in member.start()]
        assert [lists[member.member_id][name] for name in ("start_z", "start_w")] == starts
        assert row.attractor == found.kind
        if found.kind == "periodic":
            assert row[["period", "multiplier"]].tolist() == [found.period, found.multiplier]
            assert row[["exits_per_period", "events_per_period"]].tolist() == [found.n_exits, found.n_events]
            values = [lists[member.member_id][name] for name in LISTS]
            assert values == [x.tolist() for x in (*found.section, found.at_exits())]
            assert row.exits_block == found.busiest
        else:
            assert pd.isna(row.period)
            assert pd.isna(row.exits_block)
    one = table[(table.n == 1) & (table.engine == "coulomb") & (table.damping == 0.0)]
    assert one.period.to_numpy() == pytest.approx([period(0.3, 0.2)] * 2, rel=1e-9)
    heavy = table[(table.n == 1) & (table.engine == "coulomb") & (table.damping == 0.5)]
    assert set(heavy.attractor) == {"sliding"}  # damping takes more than the drop gives
    counted = query.sql(tmp_path / "out", "SELECT count(*) AS k FROM members WHERE attractor = 'periodic'")
    assert counted.k[0] == (table.attractor == "periodic").sum()


def test_a_scene_without_exact_events_is_refused():
    alone = SOURCE.replace("SEED", "0").replace('[[engine]]\nname = "coulomb"\n', "")
    with pytest.raises(SceneError, match="attractor: expected an engine of the exact law, got 'sigmoid' alone"):
        parse_scene(alone.encode())
